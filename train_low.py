#!/usr/bin/env python3
"""Train the gait-conditioned low policy on a plane and on increasingly hard terrain; calibrate it.

python train_low.py                        the complete training
python train_low.py --time-limit 3600      stops after an hour
python train_low.py --resume --out runs/low
"""

import argparse
import dataclasses
import functools
import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch as th
from stable_baselines3 import PPO
from tqdm import tqdm

from tdgc import __version__, policies
from tdgc.calibration import LEAST_ROBOTS, calibrate
from tdgc.config import (
    ConfigError,
    LowLevelConfig,
    LowTrainConfig,
    RandomisationConfig,
    RobotConfig,
    read_json,
    to_dict,
    with_overrides,
)
from tdgc.errors import StoppedError, script
from tdgc.files import make_folder, write_json
from tdgc.learn.flags import Machine, add_arguments, configure
from tdgc.learn.ppo import NoiseScaledRate, check_batch, shared_keywords
from tdgc.learn.run import Interruption, Phase, Run
from tdgc.parallel.cores import usable_cores
from tdgc.parallel.vec import TaskVecEnv
from tdgc.policies import AsymmetricActorCriticPolicy, Correction, Policy
from tdgc.show import plots
from tdgc.sim.locomotion import actor_layout, check_robot
from tdgc.sim.observation import width
from tdgc.sim.robot import fitted
from tdgc.sim.terrain import EDITION, may_have_trenches
from tdgc.tasks.low_env import make_task
from tdgc.tasks.low_observation import low_mirror, low_spaces
from tdgc.tasks.rules import FALL_HEIGHT, episode_steps
from tdgc.tasks.statistics import summarise_low
from tdgc.tasks.tiles import check_tiles, left_out


def phases(config: LowTrainConfig, machine: Machine) -> list[Phase]:
    """Return the one phase of learning: robots on a plane, and on tiles with rising levels."""
    env = config.env
    # Feet cannot sink into a plane, so there a physics step may be as long as a torque is held.
    steps = env.physics.joint_steps
    physics = dataclasses.replace(env.physics, substeps=steps, hold=1)
    plane = dataclasses.replace(env, terrain="plane", physics=physics)
    tiles = dataclasses.replace(env, terrain="tiles")
    make = functools.partial(build, config, (plane, tiles), machine)
    return [Phase("learning to walk", make, config.steps)]


def check(config: LowTrainConfig) -> None:
    """Refuse settings that would fail later or have no effect.

    Raises:
        ValueError: names the setting and what is allowed.
    """
    if config.env.terrain != LowLevelConfig.terrain:
        raise ConfigError("'env.terrain' has no effect: robots train on both, see plane_share")
    usual, drawn = RandomisationConfig(), config.env.randomisation
    for name in ("noise_probes", "probe_delay"):
        if getattr(drawn, name) != getattr(usual, name):
            raise ConfigError(f"'env.randomisation.{name}' has no effect: the low policy is blind")
    if config.plane_share == 1.0:
        raise ConfigError("'plane_share' must be from 0 to below 1, not 1")
    check_batch("'ppo.batch_size'", config.ppo.batch_size)
    check_batch("'ppo.n_steps' times 'n_envs'", config.ppo.n_steps * config.n_envs)
    step = config.env.physics.control_dt
    episode_steps(config.env.episode_seconds, step)
    if config.env.command_seconds and not round(config.env.command_seconds / step):
        raise ConfigError(
            f"'env.command_seconds' must be 0 or last a step of {step:g} s, "
            f"not {config.env.command_seconds:g}"
        )
    if 0 < config.calibration.robots < LEAST_ROBOTS:
        raise ConfigError(
            f"'calibration.robots' must be 0 or at least {LEAST_ROBOTS}, "
            f"not {config.calibration.robots}"
        )
    lowest = config.env.robot.base_height + config.env.commands.body_height[0]
    if lowest <= FALL_HEIGHT:
        raise ConfigError(
            f"'env.robot.base_height' plus the lowest 'env.commands.body_height' must be above "
            f"{FALL_HEIGHT:g} m, below which a robot has fallen, not {lowest:.3g}"
        )
    check_tiles(config.env.families, config.env.levels)
    check_robot(config.env.robot, config.env.physics, config.env.randomisation)


def fit(config: LowTrainConfig, assignments: Sequence[str]) -> LowTrainConfig:
    """Adapt the configuration to another robot's URDF; assigned settings are kept.

    Raises:
        ConfigError: a URDF that does not fit.
    """
    if config.env.robot.urdf == RobotConfig().urdf:
        return config
    found = fitted(config.env.robot)
    fits = [f"env.robot.{name}={json.dumps(value)}" for name, value in found.items()]
    config = with_overrides(config, [*fits, *assignments])
    values = {name: json.dumps(getattr(config.env.robot, name)) for name in found}
    listed = " ".join(f"env.robot.{name}={value}" for name, value in values.items())
    tqdm.write(f"from {config.env.robot.urdf}: {listed}")
    return config


def finish(out: Path, config: LowTrainConfig, interruption: Interruption) -> None:
    """Run the last phase: replace the trained policy by its calibrated copy.

    The trained policy is kept as ``uncalibrated``. An interrupted calibration starts over when the
    run is resumed, with the same result. Without calibration the policy is only marked as final.

    Raises:
        ConfigError: the robots fall too often to be calibrated, or the policy was calibrated with
            other settings.
        WorkerError: a worker failed.
    """
    try:
        learned = policies.load(out / "policy")
    except policies.PolicyFileError:
        if not (out / "uncalibrated.json").exists():
            raise
        # Killed while the calibrated copy was being written.
        learned = policies.load(out / "uncalibrated")
    robots, done = config.calibration.robots, learned.meta.pop("calibration", None)
    if done is not None and (done["robots"] or not robots):
        if done["robots"] and not robots:
            raise ConfigError(
                f"'calibration.robots' is 0, but {out / 'policy'} is already calibrated; the "
                f"policy from before is {out / 'uncalibrated'}"
            )
        if done["robots"] != robots:
            raise ConfigError(
                f"{out / 'policy'} is already calibrated, with 'calibration.robots' "
                f"{done['robots']}, not {robots}; python -m tdgc.calibration --low "
                f"{out / 'uncalibrated'} does it again"
            )
        return
    correction: Correction | None = None
    facts: dict[str, Any] = {"robots": 0}
    if robots:
        found = _calibrate(out, config, learned, interruption)
        if found is None:
            return
        correction, facts = found
        policies.save_copy(out / "uncalibrated", learned, learned.meta)
    # A run that was trained before has the setting of then in its file.
    table = read_json(out / "config.json")
    write_json(out / "config.json", table | {"calibration": to_dict(config.calibration)})
    meta = {**learned.meta, "calibration": facts}
    policies.save_copy(out / "policy", learned, meta, correction)


def _calibrate(
    out: Path, config: LowTrainConfig, learned: Policy, interruption: Interruption
) -> tuple[Correction, dict[str, Any]] | None:
    """The correction of the policy ``learned`` and how good it is; None if interrupted."""
    with tqdm(desc="calibrating", total=100, bar_format="{desc}: {percentage:3.0f}%|{bar}|") as bar:

        def tick(share: float) -> None:
            bar.update(100.0 * share - bar.n)
            if interruption.due():
                raise StoppedError

        try:
            workers = min(config.workers, usable_cores())  # here, also after a run on a cluster
            return calibrate(learned, config.calibration.robots, workers, config.seed, tick)
        except StoppedError:
            interruption.tell(out)
            return None
        except ConfigError as error:
            raise ConfigError(
                f"{error}; --resume with --set calibration.robots=0 leaves the policy as it is"
            ) from None


def build(
    config: LowTrainConfig, env_config: tuple[LowLevelConfig, LowLevelConfig], machine: Machine
) -> tuple[PPO, TaskVecEnv]:
    """Build the learner and its workers."""
    env = TaskVecEnv(
        functools.partial(make_task, env_config, config.plane_share),
        config.n_envs,
        config.workers,
        config.seed,
        low_spaces(config.env),
        recover=True,
        timeout=machine.timeout,
        link=machine.link,
    )
    ppo = config.ppo
    rate = NoiseScaledRate(ppo.learning_rate, ppo.final_learning_rate, ppo.initial_std)
    model = PPO(
        AsymmetricActorCriticPolicy,
        env,
        learning_rate=rate,
        batch_size=ppo.batch_size,
        **shared_keywords(ppo),
        policy_kwargs={
            "actor_dim": width(actor_layout(config.env.robot, config.env.gyro)),
            "mirror": low_mirror(config.env) if ppo.mirror else None,
            "net_arch": {"pi": list(ppo.actor), "vf": list(ppo.critic)},
            "optimizer_kwargs": {"eps": ppo.adam_eps},
            "activation_fn": policies.ACTIVATIONS[ppo.activation],
            "log_std_init": float(th.tensor(ppo.initial_std).log()),
        },
        seed=config.seed,
        device=machine.device,
    )
    rate.log_std = model.policy.log_std
    return model, env


@script("train_low.py")
def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    add_arguments(parser, "runs/low", LowTrainConfig(), "control steps")
    args = parser.parse_args(arguments)
    config = configure(LowTrainConfig(), args)
    if not args.resume:
        config = fit(config, args.assignments)
    check(config)
    on_tiles = config.n_envs - math.floor(config.plane_share * config.n_envs)
    if missing := left_out(config.env.families, on_tiles):
        tqdm.write(f"too few robots for all families: none is on {', '.join(missing)}")
    fastest, crossing = config.env.commands.vx[1], config.env.crossing
    if any(map(may_have_trenches, config.env.families)) and fastest < crossing.leap_speed[1]:
        tqdm.write(
            f"the command ranges limit leaps over trenches to {fastest:g} m/s, "
            f"not env.crossing.leap_speed={list(crossing.leap_speed)}"
        )
    meta = {
        "config": to_dict(config.env),
        "seed": config.seed,
        "code": __version__,
        "benchmark": EDITION,
    }
    make_folder(args.out)
    interruption = Interruption(args.time_limit)
    run = Run(args.out, config, meta, summarise_low, interruption, args.init)
    calibrating = functools.partial(finish, args.out, config, interruption)
    run.train(phases(config, Machine.of(args)), args.resume, calibrating)
    log = args.out / "log.jsonl"
    if log.exists():
        plots.training_curve(log, args.out / "training.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
