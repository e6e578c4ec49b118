#!/usr/bin/env python3
"""Train the recurrent high policy on top of a frozen low policy, level by level.

python train_high.py                       complete training, on runs/low/policy or the shipped one
python train_high.py --low runs/low/policy
python train_high.py --init runs/high/policy --set env.commands.vx=[-1,0.8] --out runs/slow
python train_high.py --resume --out runs/high
"""

import argparse
import dataclasses
import functools
import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import torch as th
from tqdm import tqdm

from tdgc import __version__, policies
from tdgc.config import (
    NO_TEACHER,
    PRESETS,
    ConfigError,
    HighLevelConfig,
    HighTrainConfig,
    differences,
    to_dict,
    with_overrides,
)
from tdgc.errors import script
from tdgc.files import checksum, make_folder
from tdgc.learn.flags import Machine, add_arguments, configure
from tdgc.learn.imitation import Apprentice, TaughtPolicy
from tdgc.learn.ppo import LinearRate, check_batch, shared_keywords
from tdgc.learn.recurrent import FastRecurrentPolicy, FastRecurrentPPO, GaitNoise, exchange_memories
from tdgc.learn.run import Interruption, Phase, Run
from tdgc.parallel.vec import TaskVecEnv
from tdgc.policies import Policy
from tdgc.policies.files import files_of
from tdgc.policies.learning import MirroredHead
from tdgc.show import plots
from tdgc.sim.commands import INDEX, CommandDecoder, default_command
from tdgc.sim.locomotion import check_robot
from tdgc.sim.robot import Array
from tdgc.sim.terrain import EDITION
from tdgc.tasks.curriculum import check_rules
from tdgc.tasks.high_env import NavigationTask
from tdgc.tasks.high_observation import high_mirror, high_spaces, untold_column
from tdgc.tasks.leaps import measure_landing
from tdgc.tasks.manners import find_manner, manner_of, may_leap, within
from tdgc.tasks.pairing import PRETRAINED, load_low, mdp_of, paired
from tdgc.tasks.rules import episode_steps
from tdgc.tasks.statistics import summarise_high
from tdgc.tasks.teacher import Skill
from tdgc.tasks.tiles import check_tiles, left_out

#: Where train_low.py writes its policy by default.
TRAINED_LOW = Path("runs/low/policy")


def find_low() -> str:
    """Find the low policy of a finished run of train_low.py, or else the shipped one.

    Raises:
        PolicyFileError: the run's policy cannot be read.
    """
    if TRAINED_LOW.with_suffix(".json").exists():
        if "calibration" in policies.load(TRAINED_LOW).meta:
            return str(TRAINED_LOW)
        tqdm.write(
            f"{TRAINED_LOW} comes from an unfinished run, so the shipped low policy is used; "
            "--low selects it anyway"
        )
    return str(PRETRAINED / "low")


def with_low(config: HighTrainConfig, assignments: Sequence[str]) -> HighTrainConfig:
    """Add the low policy and its command ranges, so that ``assignments`` may narrow one of them.

    Raises:
        ValueError: a low policy that cannot be used.
    """
    chosen = [text for text in assignments if text.partition("=")[0].strip() == "low"]
    low = with_overrides(config, chosen).low
    low = find_low() if low is None else low
    env = dataclasses.replace(config.env, commands=load_low(low)[1].commands)
    return dataclasses.replace(config, low=low, env=env)


def pin_low(config: HighTrainConfig, path: str) -> HighTrainConfig:
    """Add the low policy's path and checksum to the configuration.

    Raises:
        ConfigError: the low policy is not the one that the run began with.
    """
    found = checksum(files_of(path)[0])
    if config.low_sha256 not in (None, found):
        raise ConfigError(f"{path} is not the low policy that this run began with")
    return dataclasses.replace(config, low=path, low_sha256=found)


def with_manner(config: HighTrainConfig, low: Policy, init: Path | None) -> HighTrainConfig:
    """Add how the teacher commands the low policy, if there is a teacher, and print where the
    command ranges limit it.

    Unless the manner is set, it is found by trials or, if training begins from a policy ``init``,
    taken from that policy's teacher.

    Raises:
        PolicyFileError, ConfigError: ``init`` cannot be read.
    """
    manner = config.imitation.teacher
    if manner is None and init is not None:
        manner = manner_of(policies.load(init), init)
    elif manner is None and config.imitation.steps:
        manner = find_manner(low, config.env, tqdm.write)
    if manner is None:
        return config
    ranges = paired(config.env, mdp_of(low)).commands
    assert ranges is not None  # ``paired`` has set them
    limited = within(manner, ranges)
    for change in differences(to_dict(limited), to_dict(manner), "imitation.teacher"):
        tqdm.write(f"the command ranges limit the teacher: {change}")
    imitation = dataclasses.replace(config.imitation, teacher=limited)
    return dataclasses.replace(config, imitation=imitation)


def start_action(config: HighTrainConfig) -> Array:
    """Compute the action for walking straight ahead in the default gait, (13,).

    Raises:
        ConfigError: invalid gaits, or a speed or swing height outside the decoder's bounds.
    """
    decoder = CommandDecoder(config.env.commands, config.env.action_limit, config.env.gaits)
    command = decoder.nearest(default_command())
    command[INDEX["vx"]] = config.start_speed
    if config.env.behaviour == "all":
        command[INDEX["swing_height"]] = config.start_swing
    try:
        return decoder.encode(command)
    except ValueError as error:
        raise ConfigError(f"'start_speed' or 'start_swing' is out of bounds: {error}") from None


def start_walking(policy: FastRecurrentPolicy, config: HighTrainConfig) -> None:
    """Make walking straight ahead in the default gait the untrained policy's mean action.

    Exploration then reaches goals by chance from the first episodes on. Around the middle of the
    bounds the robot would stand still in a random gait.
    """
    with th.no_grad():
        head = policy.action_net
        bias = (head.linear if isinstance(head, MirroredHead) else head).get_parameter("bias")
        bias.copy_(th.from_numpy(start_action(config)))
        policy.log_std[-1] = math.log(config.ppo.initial_gait_std)


def make_env(
    config: HighTrainConfig, low: Policy, taught: bool, led: float, machine: Machine
) -> TaskVecEnv:
    """Start the workers; ``led`` as in ``NavigationTask``, ``taught``: whether with a teacher."""
    env_config, skill = config.env, None
    if taught:
        landing, manner = None, config.imitation.teacher
        assert manner is not None  # ``with_manner`` has set it
        if may_leap(env_config):
            landing = measure_landing(low, mdp_of(low), manner.leap_speed)
            if landing is None:
                tqdm.write("the low policy falls when it leaps: the teacher walks over trenches")
        skill = Skill(landing, manner)
    return TaskVecEnv(
        functools.partial(NavigationTask, env_config, low, taught=skill, led=led),
        config.n_envs,
        config.workers,
        config.seed,
        high_spaces(env_config, taught),
        recover=True,
        timeout=machine.timeout,
        link=machine.link,
    )


def make_learner(
    learner: type[FastRecurrentPPO],
    policy: type[FastRecurrentPolicy],
    env: TaskVecEnv,
    config: HighTrainConfig,
    device: str,
    **changed: Any,
) -> FastRecurrentPPO:
    """Build a recurrent learner that starts by walking straight ahead.

    ``changed`` overrides keyword arguments of PPO.
    """
    ppo, exchange = config.ppo, None
    if ppo.memory_exchange:
        untold = untold_column(config.env)
        exchange = functools.partial(exchange_memories, share=ppo.memory_exchange, untold=untold)
    keywords = {
        "learning_rate": LinearRate(ppo.learning_rate, ppo.final_learning_rate),
        "desired_kl": ppo.desired_kl,
        "batch_size": ppo.n_steps * config.n_envs // ppo.minibatches,
        **shared_keywords(ppo),
        **changed,
    }
    model = learner(
        policy,
        env,
        policy_kwargs={
            "lstm_hidden_size": ppo.lstm,
            "encoder": ppo.encoder,
            "gait": GaitNoise(config.n_envs, len(config.env.gaits), ppo.gait_hold),
            "net_arch": {"pi": list(ppo.actor), "vf": list(ppo.critic)},
            "log_std_init": math.log(ppo.initial_std),
            "mirror": high_mirror(config.env) if ppo.mirror else None,
        },
        gait_ent_coef=ppo.gait_ent_coef,
        exchange=exchange,
        seed=config.seed,
        device=device,
        **keywords,
    )
    start_walking(cast(FastRecurrentPolicy, model.policy), config)
    return model


def build_imitation(
    config: HighTrainConfig, low: Policy, machine: Machine
) -> tuple[FastRecurrentPPO, TaskVecEnv]:
    """Build the apprentice, and workers with a teacher."""
    imitation = config.imitation
    mdp = dataclasses.replace(
        config.env, curriculum=imitation.curriculum, first_level=0, first_levels=config.env.levels
    )
    led = imitation.led * (min(imitation.steps, config.steps) // config.n_envs)
    shown = dataclasses.replace(config, env=mdp)
    env = make_env(shown, low, True, led, machine)
    model = make_learner(
        Apprentice, TaughtPolicy, env, config, machine.device,
        learning_rate=LinearRate(imitation.learning_rate, imitation.final_learning_rate),
        n_epochs=imitation.n_epochs,
        kept=imitation.kept,
        batch_size=config.ppo.n_steps * config.n_envs // imitation.minibatches,
    )  # fmt: skip
    return model, env


def build_reinforcement(
    config: HighTrainConfig, low: Policy, machine: Machine
) -> tuple[FastRecurrentPPO, TaskVecEnv]:
    """Build the learner and workers of reinforcement learning.

    They have a teacher if the imitation loss is kept.
    """
    if begins_hardest(config):
        mdp = dataclasses.replace(config.env, first_level=config.env.levels - 1, first_levels=1)
        config = dataclasses.replace(config, env=mdp)
    taught = bool(config.imitation.steps) and config.ppo.imitation_coef > 0.0
    env = make_env(config, low, taught, 0.0, machine)
    policy = TaughtPolicy if taught else FastRecurrentPolicy
    model = make_learner(FastRecurrentPPO, policy, env, config, machine.device)
    if taught:
        # The policy returns the loss as part of the entropy, which SB3 multiplies by ``ent_coef``.
        weight = config.ppo.imitation_coef / config.ppo.ent_coef
        cast(TaughtPolicy, model.policy).imitation_weight = weight
    return model, env


def begins_hardest(config: HighTrainConfig) -> bool:
    """Whether reinforcement learning starts on the hardest level."""
    return bool(config.imitation.steps) and config.imitation.levels_after == "hardest"


def phases(config: HighTrainConfig, low: Policy, machine: Machine) -> list[Phase]:
    """Return the phases: imitation of the teacher, if any, then reinforcement learning."""
    imitated = min(config.imitation.steps, config.steps)
    imitate = functools.partial(build_imitation, config, low, machine)
    learn = functools.partial(build_reinforcement, config, low, machine)
    first = [Phase("imitation", imitate, imitated)] if imitated else []
    return [*first, Phase("learning", learn, config.steps, begins_hardest(config))]


def check(config: HighTrainConfig, control_dt: float) -> None:
    """Refuse settings that would fail later or have no effect; ``control_dt`` s is the low
    policy's control step.

    Raises:
        ValueError: names the setting and what is allowed.
    """
    env, ppo = config.env, config.ppo
    check_tiles(env.families, env.levels)
    check_rules(env.window, env.threshold)
    if env.first_level + env.first_levels > env.levels:
        raise ConfigError(
            f"'env.first_level' and 'env.first_levels' must add up to at most {env.levels} levels, "
            f"not {env.first_level + env.first_levels}"
        )
    first = HighLevelConfig.first_level, HighLevelConfig.first_levels
    if (env.first_level, env.first_levels) != first:
        if config.imitation.steps:
            raise ConfigError(
                "'env.first_level' and 'env.first_levels' have no effect with imitation, which has "
                "its own levels; set imitation.steps to 0, or leave them"
            )
        if env.curriculum != "performance":
            raise ConfigError(
                "'env.first_level' and 'env.first_levels' have no effect with env.curriculum "
                f"{env.curriculum}"
            )
    parts = {"ppo": ppo.minibatches}
    if config.imitation.steps:
        parts["imitation"] = config.imitation.minibatches
    for name, minibatches in parts.items():
        if minibatches > config.n_envs:  # each holds whole rollouts of some robots
            raise ConfigError(
                f"'{name}.minibatches' must be at most the {config.n_envs} robots, "
                f"not {minibatches}"
            )
        steps = ppo.n_steps * config.n_envs // minibatches
        check_batch(f"'ppo.n_steps' times 'n_envs' per '{name}.minibatches'", steps)
        made = ppo.n_steps * config.n_envs // steps  # by SB3, which only knows their size
        if made != minibatches:
            raise ConfigError(
                f"'{name}.minibatches' cannot be {minibatches} with {config.n_envs} robots of "
                f"{ppo.n_steps} steps; {made} can"
            )
    episode_steps(env.episode_seconds, env.decimation * control_dt)
    if not ppo.ent_coef:  # SB3 multiplies both terms by it
        for name, used in (("gait_ent_coef", True), ("imitation_coef", config.imitation.steps)):
            if used and getattr(ppo, name):
                raise ConfigError(f"'ppo.{name}' needs 'ppo.ent_coef' above 0; or set it to 0")
    if ppo.encoder and ppo.lstm is None:
        raise ConfigError(
            "'ppo.encoder' must be [] if 'ppo.lstm' is null: its layers precede the LSTMs"
        )
    if ppo.mirror:
        high_mirror(env)
    start_action(config)


@script("train_high.py")
def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    add_arguments(parser, "runs/high", HighTrainConfig(), "decisions")
    high = parser.add_argument_group("high policy")
    high.add_argument(
        "--low", help="low policy (that of a finished run in runs/low, or else the shipped one)"
    )
    recipe = high.add_mutually_exclusive_group()
    recipe.add_argument(
        "--preset", choices=PRESETS, default="default",
        help="hyperparameters: default or the paper's (default)",
    )  # fmt: skip
    recipe.add_argument(
        "--no-teacher", action="store_true", help="reinforcement learning alone, without imitation"
    )
    args = parser.parse_args(arguments)
    preset = (*PRESETS[args.preset], *(NO_TEACHER if args.no_teacher else ()))
    if args.init is not None:
        preset += ("imitation.steps=0",)  # imitation would overwrite what that policy has learned
    if args.low is not None:
        args.assignments.append(f"low={json.dumps(args.low)}")
    if args.resume and (args.no_teacher or PRESETS[args.preset]):
        raise ConfigError("--resume keeps the run's settings: no --preset or --no-teacher")
    start = with_overrides(HighTrainConfig(), preset)
    config = configure(start if args.resume else with_low(start, args.assignments), args)
    path = find_low() if config.low is None else config.low
    low, low_config = load_low(path)
    config = pin_low(config, path)
    taught = config.imitation.steps or args.init is not None or args.resume
    if config.imitation.teacher is not None and not taught:
        raise ConfigError("'imitation.teacher' has no effect without imitation")
    tqdm.write(f"low policy: {path}")
    check_robot(low_config.robot, low_config.physics, config.env.randomisation)
    config = dataclasses.replace(config, env=paired(config.env, low_config))
    check(config, low_config.physics.control_dt)
    if missing := left_out(config.env.families, config.n_envs):
        tqdm.write(f"too few robots for all families: none is on {', '.join(missing)}")
    make_folder(args.out)
    interruption = Interruption(args.time_limit)
    config = with_manner(config, low, args.init)
    meta: dict[str, Any] = {
        "config": to_dict(config.env),
        "low": {"config": to_dict(low_config), "observation": low.actor_dim},
        "seed": config.seed,
        "code": __version__,
        "benchmark": EDITION,
    }
    if config.imitation.teacher is not None:
        meta["teacher"] = to_dict(config.imitation.teacher)
    run = Run(args.out, config, meta, summarise_high, interruption, args.init)
    run.train(phases(config, low, Machine.of(args)), args.resume)
    log = args.out / "log.jsonl"
    if log.exists():
        plots.decision_curve(log, args.out / "training.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
