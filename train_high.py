#!/usr/bin/env python3
"""Train the recurrent high level on top of a frozen low level, level by level.

python train_high.py                       the whole job, on the shipped low level
python train_high.py --low runs/low/policy
python train_high.py --resume --out runs/high
"""

from __future__ import annotations

import argparse
import functools
import math
import sys
from typing import Any, cast

import torch as th

from tdgc import __version__
from tdgc.commands import INDEX, CommandDecoder, default_command
from tdgc.config import PRESETS, HighLevelConfig, HighTrainConfig, to_dict
from tdgc.high_env import NavigationTask, check_pair, load_low, summarise
from tdgc.recurrent import FastRecurrentPolicy, FastRecurrentPPO
from tdgc.training import Phase, add_arguments, configure, run
from tdgc.vec import TaskVecEnv, WorkerError


def make_task(config: HighLevelConfig, low: str, robots: int, seed: int) -> NavigationTask:
    return NavigationTask(config, low, robots, seed)


def start_walking(policy: FastRecurrentPolicy, config: HighTrainConfig) -> None:
    """Let the untrained policy's mean action be walking straight on in the default gait.

    Its exploration then stumbles on goals from the first episodes; around the middle of the bounds
    it would stand still in a random gait.
    """
    command = default_command()
    command[INDEX["vx"]] = config.start_speed
    decoder = CommandDecoder(config.env.commands, config.env.action_limit)
    with th.no_grad():
        policy.action_net.get_parameter("bias").copy_(th.from_numpy(decoder.encode(command)))
        policy.log_std[-1] = math.log(config.ppo.initial_gait_std)


def build(
    config: HighTrainConfig, device: str, timeout: float
) -> tuple[FastRecurrentPPO, TaskVecEnv]:
    """Workers and learner."""
    probe = NavigationTask(config.env, config.low, 1, seed=0)
    spaces = probe.observation_space, probe.action_space
    probe.close()
    env = TaskVecEnv(
        functools.partial(make_task, config.env, config.low),
        config.n_envs,
        config.workers,
        config.seed,
        spaces,
        recover=True,
        timeout=timeout,
    )
    ppo = config.ppo
    model = FastRecurrentPPO(
        FastRecurrentPolicy,
        env,
        learning_rate=ppo.learning_rate,
        n_steps=ppo.n_steps,
        batch_size=ppo.n_steps * config.n_envs // ppo.minibatches,
        n_epochs=ppo.n_epochs,
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
    if args.low is not None:
        args.assignments.append(f"low={args.low}")
    try:
        config = configure(HighTrainConfig(), args)
        low, low_config = load_low(config.low)
        check_pair(config.env, low_config)
        meta: dict[str, Any] = {
            "config": to_dict(config.env),
            "low": {"config": to_dict(low_config), "observation": low.actor_dim},
            "seed": config.seed,
            "code": __version__,
        }
        phases = [Phase(functools.partial(build, config, args.device), config.steps)]
        run(args, config, phases, meta, summarise)
    except ValueError as error:
        print(f"train_high.py: {error}", file=sys.stderr)
        return 2
    except (WorkerError, OSError) as error:
        print(f"train_high.py: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
