"""Settings of a run of train_low.py or train_high.py."""

from dataclasses import dataclass, field
from typing import ClassVar, Literal

from tdgc.config.high import HighLevelConfig
from tdgc.config.low import LowLevelConfig
from tdgc.config.settings import Count, NotNegative, Positive, Seed, Share, Whole


@dataclass(frozen=True)
class PPOConfig:
    """PPO and the networks of the low policy; see docs/experiments.md for what was compared."""

    # Multiplied by the mean standard deviation of the actions: as exploration shrinks, the same
    # step of the mean changes the policy more (at a constant rate the clipped share rose from 0.2
    # to 0.4).
    learning_rate: Positive = 6e-4
    final_learning_rate: Positive = 1e-5  # reached linearly at the last step
    n_steps: Count = 32  # control steps per robot between updates
    batch_size: Count = 960  # a quarter of a rollout
    n_epochs: Count = 5
    gamma: Share = 0.99
    gae_lambda: Share = 0.95
    clip_range: Positive = 0.2
    ent_coef: NotNegative = 0.0005
    vf_coef: NotNegative = 0.5
    max_grad_norm: Positive = 1.0
    initial_std: Positive = 1.0
    # SB3's 1e-5 swamps the critic's gradients: rewards are scaled by dt and below 0.03 per step.
    adam_eps: Positive = 1e-8
    actor: tuple[Count, ...] = (256, 192)
    critic: tuple[Count, ...] = (256, 128)
    activation: Literal["elu", "relu", "tanh"] = "elu"
    mirror: bool = True  # policy and value exactly left-right symmetric


@dataclass(frozen=True)
class CalibrationConfig:
    """Calibration of the low policy (``tdgc.calibration``), the last phase of train_low.py."""

    #: Settings of earlier calibrations, which runs may have recorded.
    RETIRED: ClassVar[tuple[str, ...]] = ("turns",)

    robots: Whole = 4800  # robots whose walking is measured; 0: no calibration


@dataclass(frozen=True)
class LowTrainConfig:
    """A run of train_low.py: robots on a plane and on terrain, then calibration."""

    seed: Seed = 42  # the paper's
    n_envs: Count = 120
    workers: Count = 2
    steps: Count = 36_000_000  # control steps of reinforcement learning, over all robots
    # Share of the robots that train on the plane, where a step costs less than half as much as on
    # a tile; the others train on tiles.
    plane_share: Share = 0.6
    log_steps: Count = 100_000
    checkpoint_seconds: NotNegative = 30.0  # a crash loses this and one update: less than a minute
    env: LowLevelConfig = field(default_factory=LowLevelConfig)
    ppo: PPOConfig = field(default_factory=PPOConfig)
    calibration: CalibrationConfig = field(
        default_factory=CalibrationConfig, metadata={"before": {"robots": 0}}
    )


@dataclass(frozen=True)
class RecurrentPPOConfig:
    """RecurrentPPO and the networks of the high policy.

    From ``n_steps`` to ``ent_coef``, values are those of the paper's table.
    """

    # With a standard deviation of 0.1 in all actions, two fifths of the samples were clipped at
    # rates above 3e-4; with less noise, this happens at lower rates.
    # It falls over the whole run, so after imitation it begins at 1.2e-4, with the moments of Adam
    # that imitation leaves.
    learning_rate: Positive = 1.5e-4
    final_learning_rate: Positive = 5e-5  # reached linearly at the last step
    # KL divergence of an update; after an update beyond twice this, the actor's learning rate is
    # lowered, see ``tdgc.learn.recurrent.adapted_share``. null: no such limit.
    desired_kl: Positive | None = field(default=None, metadata={"before": None})
    n_steps: Count = 24  # decisions per robot between updates
    minibatches: Count = 4
    n_epochs: Count = 5
    gamma: Share = 0.99
    gae_lambda: Share = 0.95
    clip_range: Positive = 0.2
    ent_coef: NotNegative = 1e-4
    vf_coef: NotNegative = 0.5
    max_grad_norm: Positive = 0.5
    # On tiles of Gap a teacher with exact timing reached 91 % of its goals; with the noise of these
    # two settings 88 %, with 0.1 in all actions but the gait 79 %, and with 0.1 in the gait alone
    # 57 %. A gait's interval is 0.5 wide, so at 0.1 one decision in a hundred falls into another
    # gait, and a leap in another gait ends in the trench.
    initial_std: Positive = 0.06
    initial_gait_std: Positive = 0.04  # of the gait channel: too small to change the gait
    # Decisions for which the noise of the gait channel is held, within an episode: the worth of a
    # gait shows in a second, not in a tenth of one.
    gait_hold: Count = field(default=1, metadata={"before": 1})
    # Weight of a bonus on the entropy of the gait alone; it falls linearly to 0 at the last step.
    gait_ent_coef: NotNegative = field(default=0.0, metadata={"before": 0.0})
    # Weight of the imitation loss added to PPO's, in runs that begin with imitation.
    imitation_coef: NotNegative = field(default=10.0, metadata={"before": 0.0})
    # Share of the robots that are not told their family whose hidden states are exchanged after
    # each rollout (2.4 s): where the ground changes, the policy then acts on what it observes. On
    # ``mixed`` this gained 6 to 9 points (docs/experiments.md).
    memory_exchange: Share = field(default=0.5, metadata={"before": 0.0})
    # Units of each of the two LSTMs; null for a feed-forward policy. With 128 units an update takes
    # twice as long, and the policy is no better.
    lstm: Count | None = 64
    # Units of the layers before each LSTM; their output also bypasses it. Students of leaps reached
    # 42 % of their goals without, and 59 % with a layer of 128 units (docs/experiments.md).
    encoder: tuple[Count, ...] = field(default=(128,), metadata={"before": ()})
    mirror: bool = True  # policy and value exactly left-right symmetric
    actor: tuple[Count, ...] = (64,)
    critic: tuple[Count, ...] = (64,)


@dataclass(frozen=True)
class TeacherConfig:
    """The manner in which the teacher commands the low policy; the defaults suit the shipped one.

    What was tried is in docs/experiments.md.
    """

    walk_speed: Positive = 0.6  # m/s, on uneven ground
    step_frequency: Positive = 2.3  # Hz, on uneven ground
    # m/s, over trenches. The plan of strides is made for speeds of 1.0 and above.
    leap_speed: Positive = 1.2


#: The manner of the teachers of runs and policies that do not record one.
FIRST_TEACHER = {"walk_speed": 0.6, "step_frequency": 2.3, "leap_speed": 1.2}


@dataclass(frozen=True)
class ImitationConfig:
    """Imitation of the scripted teacher, the first phase of train_high.py."""

    steps: Whole = 640_000  # decisions over all robots; 0 for reinforcement learning alone
    # null: found by trials with the low policy before training, see ``tdgc.tasks.manners``. If any
    # of these is set, there are no trials, and the others have their defaults.
    teacher: TeacherConfig | None = field(default=None, metadata={"before": FIRST_TEACHER})
    # Share of these steps over which the teacher hands over. In the last quarter the student alone
    # drives, so that it learns in the states to which its own actions lead. Chosen by hand.
    led: Share = field(default=0.75, metadata={"before": 0.75})
    learning_rate: Positive = 2e-3
    final_learning_rate: Positive = 2e-4  # reached linearly at the last of these steps
    # With two minibatches, 48 updates per rollout, each on half as many decisions as the rollout
    # has. The excess cost of the student's step frequencies over the teacher's falls with the
    # number of updates: 0.19, 0.15 and 0.12 after 1, 4 and 10 thousand of them on the same 90,000
    # decisions (docs/experiments.md).
    n_epochs: Count = 24
    minibatches: Count = field(default=2, metadata={"before": 4})
    # Rollouts to learn from; each minibatch samples all of them. From the newest alone students
    # learned strides with a price of 0.20, from the last 20, in two thirds of the time, with one of
    # 0.16 (docs/experiments.md).
    kept: Count = field(default=40, metadata={"before": 1})
    # How levels are chosen during imitation; ``env.curriculum`` applies afterwards. Learning from a
    # teacher needs no easy start, and a student has most to learn on the hardest levels.
    curriculum: Literal["performance", "uniform", "hardest"] = field(
        default="uniform", metadata={"before": "performance"}
    )
    # Levels at which reinforcement learning starts: those of the robots at the end of imitation, or
    # the hardest for all. From the hardest, robots settle on their own levels within 0.15 M
    # decisions; climbing from the kept ones takes 0.4 M.
    levels_after: Literal["kept", "hardest"] = field(default="hardest", metadata={"before": "kept"})


@dataclass(frozen=True)
class HighTrainConfig:
    """A run of train_high.py."""

    seed: Seed = 42
    n_envs: Count = 100
    workers: Count = 2
    steps: Count = 2_100_000  # decisions over all robots: 80 minutes to 3 hours on two cores
    log_steps: Count = 24_000
    checkpoint_seconds: NotNegative = 30.0  # a crash loses this and one update: less than a minute
    start_speed: float = 0.5  # m/s: the untrained policy walks straight ahead in the default gait
    # m, swing height of the untrained policy; 0.08 is the default of Walk These Ways.
    start_swing: NotNegative = field(default=0.08, metadata={"before": 0.08})
    # Path of the low policy; null: that of a finished train_low.py run in runs/low, or else the
    # shipped one.
    low: str | None = None
    # SHA-256 of the low policy's .json file, which holds the checksum of its weights. A resumed run
    # refuses any other low policy.
    low_sha256: str | None = field(default=None, metadata={"before": None})
    env: HighLevelConfig = field(default_factory=HighLevelConfig)
    imitation: ImitationConfig = field(default_factory=ImitationConfig)
    ppo: RecurrentPPOConfig = field(default_factory=RecurrentPPOConfig)


#: ``train_high.py --preset``: assignments applied before those of the flags. ``paper`` is the
#: paper's hyperparameter table and its synchronous loop.
PRESETS: dict[str, tuple[str, ...]] = {
    "default": (),
    "paper": (
        "seed=42",
        "n_envs=100",
        "steps=48000000",  # 20,000 updates
        "env.decimation=1",
        "imitation.steps=0",
        "ppo.initial_std=0.3",
        "ppo.initial_gait_std=0.15",
        "ppo.n_steps=24",
        "ppo.learning_rate=1e-4",
        "ppo.final_learning_rate=1e-4",
        "ppo.ent_coef=1e-4",
        "ppo.gamma=0.99",
        "ppo.gae_lambda=0.95",
        "ppo.clip_range=0.2",
        "ppo.n_epochs=5",
        "ppo.minibatches=4",
        "ppo.lstm=128",
        "ppo.encoder=[]",
        "ppo.mirror=false",
        "ppo.actor=[128]",
        "ppo.critic=[128]",
        "ppo.memory_exchange=0",
        "env.unknown_share=0",
        'env.families=["rough","pillar","stair","gap","tilt"]',
    ),
}

#: ``train_high.py --no-teacher``: what reinforcement learning alone needs. Its noise has to
#: discover what the teacher would have demonstrated.
NO_TEACHER: tuple[str, ...] = (
    "imitation.steps=0",
    "ppo.initial_std=0.3",
    "ppo.initial_gait_std=0.4",
    # At 5e-4 an update changed the policy by a KL divergence of 0.04 to 0.11, at half of this by up
    # to 0.11 as soon as goals are reached. rsl_rl aims at 0.01.
    "ppo.learning_rate=2.5e-4",
    "ppo.desired_kl=0.015",
    "ppo.memory_exchange=0",
    "env.unknown_share=0",
    # The same number of robots on each family: by default three in eight are among trenches, where
    # they learn least.
    'env.families=["rough","pillar","stair","gap","tilt"]',
    # With feet at 0.08 m the policy reached 67 % of the goals on Stair; with feet as high as those
    # of the baseline, ``gp``, 98.5 %.
    "start_swing=0.19",
    # Standing at the start must not pay. With distances as shares of the tile's 8 m, standing is
    # worth more than walking once 0.086 falls per second are to be expected, and the untrained
    # policy has 0.08; with shares of the distance from start to goal, the threshold is 0.24.
    "env.rewards.map_radius=6.5",
    # A trench 60 cm deep ends every attempt to cross it.
    "env.shallowest_trench=0.05",
    # A second of a gait shows what it is worth. An entropy bonus as large as PPO's usual one for
    # discrete actions preserves gaits that easy levels do not need until hard levels do.
    "ppo.gait_hold=10",
    "ppo.gait_ent_coef=0.01",
)
