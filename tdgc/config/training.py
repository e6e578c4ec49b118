"""Runs of train_low.py and train_high.py."""

from dataclasses import dataclass, field
from typing import Literal

from tdgc.config.high import HighLevelConfig
from tdgc.config.low import LowLevelConfig
from tdgc.config.settings import Count, NotNegative, Positive, Share, Whole


@dataclass(frozen=True)
class PPOConfig:
    """PPO and the networks of the low policy; see docs/experiments.md for what was compared."""

    # Times the mean standard deviation of the actions: as exploration shrinks, the same step of the
    # mean moves the policy further (the clipped share rose from 0.2 to 0.4 at a constant rate).
    learning_rate: Positive = 6e-4
    final_learning_rate: Positive = 1e-5  # reached linearly at the last step
    n_steps: Count = 32  # control steps a robot between updates
    batch_size: Count = 960  # a quarter of a rollout
    n_epochs: Count = 5
    gamma: Share = 0.99
    gae_lambda: Share = 0.95
    clip_range: Positive = 0.2
    ent_coef: NotNegative = 0.0005
    vf_coef: NotNegative = 0.5
    max_grad_norm: Positive = 1.0
    initial_std: Positive = 1.0
    # SB3's 1e-5 swallows the critic's gradients: rewards carry dt and are below 0.03 a step.
    adam_eps: Positive = 1e-8
    actor: tuple[Count, ...] = (256, 192)
    critic: tuple[Count, ...] = (256, 128)
    activation: Literal["elu", "relu", "tanh"] = "elu"
    mirror: bool = True  # policy and value exactly left-right symmetric


@dataclass(frozen=True)
class CalibrationConfig:
    """Calibration of the low policy (``tdgc.calibration``), the end of a run of train_low.py."""

    robots: Whole = 4800  # that walk to be measured; 0 leaves the policy as it is
    turns: Count = 60  # of 60 control steps each, in which the copy learns


@dataclass(frozen=True)
class LowTrainConfig:
    """A run of train_low.py: robots on a plane and on terrain, then calibration."""

    seed: Whole = 42  # the paper's
    n_envs: Count = 120
    workers: Count = 2
    steps: Count = 36_000_000  # of reinforcement learning, altogether
    # Of the robots, on the plane, where a step costs less than half of one on a tile; the others
    # cross tiles.
    plane_share: Share = 0.6
    log_steps: Count = 100_000
    checkpoint_seconds: NotNegative = 30.0  # with the update under way, less than a minute is lost
    env: LowLevelConfig = field(default_factory=LowLevelConfig)
    ppo: PPOConfig = field(default_factory=PPOConfig)
    calibration: CalibrationConfig = field(
        default_factory=CalibrationConfig, metadata={"before": {"robots": 0, "turns": 60}}
    )


@dataclass(frozen=True)
class RecurrentPPOConfig:
    """RecurrentPPO and the networks of the high policy: the paper's table but for the first two."""

    # With a deviation of 0.1 in all actions two fifths of the samples were clipped above 3e-4, and
    # the less noise, the sooner.
    learning_rate: Positive = 1.5e-4
    final_learning_rate: Positive = 5e-5  # reached linearly at the last step
    n_steps: Count = 24  # decisions a robot between updates
    minibatches: Count = 4
    n_epochs: Count = 5
    gamma: Share = 0.99
    gae_lambda: Share = 0.95
    clip_range: Positive = 0.2
    ent_coef: NotNegative = 1e-4
    vf_coef: NotNegative = 0.5
    max_grad_norm: Positive = 0.5
    # On tiles of Gap a teacher whose timing is exact reached 91 % of its goals; with this noise 88,
    # with 0.1 in all other actions 79, and with 0.1 in the gait, too, 57 %: a gait is 0.5 wide, so
    # that it changes once in a hundred decisions, and a leap in another gait ends in the trench.
    initial_std: Positive = 0.06
    initial_gait_std: Positive = 0.04  # of the gait channel: changes none
    # Decisions that the noise of the gait channel is held for, within an episode: what a gait is
    # worth shows in a second, not in a tenth of one.
    gait_hold: Count = field(default=1, metadata={"before": 1})
    # Bonus on the entropy of the gait alone, which falls linearly to nothing at the last step.
    gait_ent_coef: NotNegative = field(default=0.0, metadata={"before": 0.0})
    # Weight of the imitation's loss beside PPO's, where imitation came first.
    imitation_coef: NotNegative = field(default=10.0, metadata={"before": 0.0})
    # Of the robots that are not told their family, the share whose memories change places after
    # each rollout, 2.4 s: on ground that changes a policy then acts on what it sees. On ``mixed``
    # it was worth 6 to 9 points (docs/experiments.md).
    memory_exchange: Share = field(default=0.5, metadata={"before": 0.0})
    # Units of both LSTMs; null for a feed-forward policy. With 128 units each an update takes twice
    # as long, and what is learned is no better.
    lstm: Count | None = 64
    # Layers before either LSTM, whose output goes past it, too. Students of leaps reached 42 % of
    # their goals without, and 59 % with a layer of 128 units (docs/experiments.md).
    encoder: tuple[Count, ...] = field(default=(128,), metadata={"before": ()})
    mirror: bool = True  # policy and value exactly left-right symmetric
    actor: tuple[Count, ...] = (64,)
    critic: tuple[Count, ...] = (64,)


@dataclass(frozen=True)
class ImitationConfig:
    """Imitation of the scripted teacher, with which a run of train_high.py begins."""

    steps: Whole = 640_000  # decisions altogether; 0 leaves everything to reinforcement learning
    learning_rate: Positive = 2e-3
    final_learning_rate: Positive = 2e-4  # reached linearly at the last of the steps
    # Of each rollout 48 updates of half as many decisions. How little a frequency costs more than
    # the teacher's depends on the updates that there were: 0.19, 0.15 and 0.12 after 1, 4 and 10
    # thousand of them on the same 90,000 decisions (docs/experiments.md).
    n_epochs: Count = 24
    minibatches: Count = field(default=2, metadata={"before": 4})
    # Rollouts that it learns from, each minibatch from all of them. Of the newest alone students
    # learned strides at a price of 0.20, of the last 20 in two thirds of the time at one of 0.16
    # (docs/experiments.md).
    kept: Count = field(default=40, metadata={"before": 1})
    # How levels are chosen meanwhile, as ``env.curriculum`` has it afterwards: what the teacher
    # shows needs no easy beginning, and the hardest levels are where a student has most to learn.
    curriculum: Literal["performance", "uniform", "hardest"] = field(
        default="uniform", metadata={"before": "performance"}
    )
    # The levels that reinforcement learning begins on: those that robots are on when imitation
    # ends, or the hardest for all, from where their performance takes them down within 0.15 M
    # decisions; up from those kept takes 0.4 M.
    levels_after: Literal["kept", "hardest"] = field(default="hardest", metadata={"before": "kept"})


@dataclass(frozen=True)
class HighTrainConfig:
    """A run of train_high.py."""

    seed: Whole = 42
    n_envs: Count = 100
    workers: Count = 2
    steps: Count = 2_100_000  # decisions altogether: under 80 minutes on two cores
    log_steps: Count = 24_000
    checkpoint_seconds: NotNegative = 30.0  # with the update under way, less than a minute is lost
    start_speed: float = 0.5  # m/s: before any training it walks straight on in the default gait
    # m, of its feet then; 0.08 is the default of Walk These Ways.
    start_swing: NotNegative = field(default=0.08, metadata={"before": 0.08})
    # The low policy: by default what train_low.py left in runs/low, or else the shipped one.
    low: str | None = None
    # SHA-256 of its .json, where that of its weights stands, too: a run goes on with no other.
    low_sha256: str | None = field(default=None, metadata={"before": None})
    env: HighLevelConfig = field(default_factory=HighLevelConfig)
    imitation: ImitationConfig = field(default_factory=ImitationConfig)
    ppo: RecurrentPPOConfig = field(default_factory=RecurrentPPOConfig)


#: ``train_high.py --preset``: assignments before those of the flags. ``paper`` is the paper's
#: hyperparameter table and its synchronous loop.
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

#: ``train_high.py --no-teacher``: what reinforcement learning alone needs. Its noise has to find
#: what the teacher would have shown.
NO_TEACHER: tuple[str, ...] = (
    "imitation.steps=0",
    "ppo.initial_std=0.3",
    "ppo.initial_gait_std=0.4",
    "ppo.learning_rate=5e-4",
    "ppo.memory_exchange=0",
    "env.unknown_share=0",
    # With feet at 0.08 m it reached 67 % of the goals on Stair, with feet as high as gp's 98.5 %.
    "start_swing=0.19",
    # Standing at the start must not pay. With distances as shares of the tile's 8 m it is worth
    # more than walking on once 0.086 falls a second are to be expected, and the untrained policy
    # has 0.08; as shares of the distance between start and goal, from 0.24 on.
    "env.rewards.map_radius=6.5",
    # A trench of 60 cm ends whatever is tried at it.
    "env.shallowest_trench=0.05",
    # A second of a gait shows what it is worth. A bonus of the size that PPO takes for discrete
    # actions keeps the gaits that easy levels do not need until hard ones do.
    "ppo.gait_hold=10",
    "ppo.gait_ent_coef=0.01",
)
