#!/usr/bin/env python3
"""Train the recurrent high level on top of a frozen low level, level by level.

python train_high.py                       the whole job, on the shipped low level
python train_high.py --low runs/low/policy
python train_high.py --init tdgc/pretrained/high --set env.commands.vx=[-1,0.8]
python train_high.py --resume --out runs/high
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import math
import sys
from typing import Any, cast

import torch as th

from tdgc import __version__
from tdgc.config import PRESETS, ConfigError, HighTrainConfig, to_dict
from tdgc.learn.imitation import Apprentice, ApprenticePolicy
from tdgc.learn.recurrent import FastRecurrentPolicy, FastRecurrentPPO
from tdgc.learn.training import Interruption, Phase, add_arguments, configure, run
from tdgc.parallel.vec import TaskVecEnv
from tdgc.parallel.worker import MakeLink, WorkerError
from tdgc.policies import Policy
from tdgc.policies.learning import MirroredHead
from tdgc.show import plots
from tdgc.sim.commands import INDEX, CommandDecoder, default_command
from tdgc.sim.terrain import EDITION
from tdgc.tasks.high_env import NavigationTask, high_mirror, load_low, paired, summarise
from tdgc.tasks.leaps import measure_landing
from tdgc.tasks.teacher import check_styles
from tdgc.tasks.tiles import check_families


def start_walking(policy: FastRecurrentPolicy, config: HighTrainConfig) -> None:
    """Let the untrained policy's mean action be walking straight on in the default gait.

    Its exploration then stumbles on goals from the first episodes; around the middle of the bounds
    it would stand still in a random gait.
    """
    command = default_command()
    command[INDEX["vx"]] = config.start_speed
    decoder = CommandDecoder(config.env.commands, config.env.action_limit)
    with th.no_grad():
        head = policy.action_net
        bias = (head.linear if isinstance(head, MirroredHead) else head).get_parameter("bias")
        bias.copy_(th.from_numpy(decoder.encode(command)))
        policy.log_std[-1] = math.log(config.ppo.initial_gait_std)


def build(
    config: HighTrainConfig,
    low: Policy,
    device: str,
    imitating: bool,
    timeout: float,
    link: MakeLink,
) -> tuple[FastRecurrentPPO, TaskVecEnv]:
    """Workers and learner of imitation, or of reinforcement learning."""
    guided = config.imitation.steps // config.n_envs if imitating else 0
    env_config = config.env
    if config.imitation.steps:  # what was imitated on all levels goes on on all
        env_config = dataclasses.replace(env_config, first_levels=env_config.levels)
    probe = NavigationTask(env_config, low, 1, seed=0, guided=guided)
    spaces = probe.observation_space, probe.action_space
    landing = None
    if guided and "gap" in env_config.families:
        landing = measure_landing(low, probe.low_config)
    probe.close()
    env = TaskVecEnv(
        functools.partial(NavigationTask, env_config, low, guided=guided, landing=landing),
        config.n_envs,
        config.workers,
        config.seed,
        spaces,
        recover=True,
        timeout=timeout,
        link=link,
    )
    ppo = config.ppo
    first, last = ppo.learning_rate, ppo.final_learning_rate
    learner, policy = (
        (Apprentice, ApprenticePolicy) if imitating else (FastRecurrentPPO, FastRecurrentPolicy)
    )
    model = learner(
        policy,
        env,
        learning_rate=(
            config.imitation.learning_rate
            if imitating
            else lambda remaining: last + remaining * (first - last)
        ),
        n_steps=ppo.n_steps,
        batch_size=ppo.n_steps * config.n_envs // ppo.minibatches,
        n_epochs=config.imitation.n_epochs if imitating else ppo.n_epochs,
        gamma=ppo.gamma,
        gae_lambda=ppo.gae_lambda,
        clip_range=ppo.clip_range,
        ent_coef=ppo.ent_coef,
        vf_coef=ppo.vf_coef,
        max_grad_norm=ppo.max_grad_norm,
        policy_kwargs={
            "lstm_hidden_size": ppo.lstm,
            "net_arch": {"pi": list(ppo.actor), "vf": list(ppo.critic)},
            "log_std_init": math.log(ppo.initial_std),
            "mirror": high_mirror(config.env) if ppo.mirror else None,
        },
        seed=config.seed,
        device=device,
    )
    start_walking(cast(FastRecurrentPolicy, model.policy), config)
    return model, env


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    add_arguments(parser, "runs/high")
    parser.add_argument("--low", help="low-level policy (the shipped one)")
    parser.add_argument(
        "--preset", choices=PRESETS, default="default", help="paper: the paper's hyperparameters"
    )
    args = parser.parse_args(arguments)
    args.assignments[:0] = PRESETS[args.preset]
    if args.init is not None and not args.resume:
        args.assignments.insert(0, "imitation.steps=0")  # it would unlearn what it begins with
    if args.low is not None:
        args.assignments.append(f"low={args.low}")
    try:
        config = configure(HighTrainConfig(), args)
        low, low_config = load_low(config.low)
        config = dataclasses.replace(config, env=paired(config.env, low_config))
        check_families(config.env.families)
        unknown = config.env.unknown_share
        if not 0.0 <= unknown <= 1.0:
            raise ConfigError(f"'env.unknown_share' must be from 0 to 1, not {unknown:g}")
        if config.imitation.steps:
            check_styles(config.env.families)
        meta: dict[str, Any] = {
            "config": to_dict(config.env),
            "low": {"config": to_dict(low_config), "observation": low.actor_dim},
            "seed": config.seed,
            "code": __version__,
            "benchmark": EDITION,
        }
        imitated = min(config.imitation.steps, config.steps)
        phases = [
            Phase(name, functools.partial(build, config, low, args.device, imitating), until)
            for name, imitating, until in (
                ("imitation", True, imitated),
                ("reinforcement", False, config.steps),
            )
            if until > 0
        ]
        run(args, config, phases, meta, summarise, Interruption(args.time_limit))
    except ValueError as error:
        print(f"train_high.py: {error}", file=sys.stderr)
        return 2
    except (WorkerError, OSError) as error:
        print(f"train_high.py: {error}", file=sys.stderr)
        return 1
    log = args.out / "log.jsonl"
    if log.exists():
        plots.decision_curve(log, args.out / "training.png")
    return 0


if __name__ == "__main__":
    sys.exit(main())
