#!/usr/bin/env python3
"""Train the gait-conditioned low level: first on the plane, then on rising terrain.

    python train_low.py                        the whole job
    python train_low.py --time-limit 3600      an hour of it
    python train_low.py --resume --out runs/low
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
import sys
import time
from pathlib import Path
from typing import Any

import torch as th
from stable_baselines3 import PPO

from tdgc import __version__, policies
from tdgc.config import (
    ConfigError,
    LowLevelConfig,
    LowTrainConfig,
    from_dict,
    to_dict,
    with_overrides,
)
from tdgc.low_env import LowLevelTask, summarise
from tdgc.policies import AsymmetricActorCriticPolicy
from tdgc.training import (
    CheckpointError,
    Interruption,
    MirroredRolloutBuffer,
    RunCallback,
    learn,
    load_learner,
    newest_checkpoint,
    restart,
    tensorboard_logger,
)
from tdgc.vec import TaskVecEnv


def make_task(config: LowLevelConfig, robots: int, seed: int) -> LowLevelTask:
    return LowLevelTask(config, robots, seed)


def phases(config: LowTrainConfig) -> list[tuple[LowLevelConfig, int]]:
    """The MDPs of a run, each with the number of steps at which it ends."""
    env = config.env
    physics = dataclasses.replace(env.physics, substeps=config.plane_substeps)
    plane = dataclasses.replace(env, terrain="plane", physics=physics)
    tiles = dataclasses.replace(env, terrain="tiles")
    return [(plane, min(config.plane_steps, config.steps)), (tiles, config.steps)]


def build(config: LowTrainConfig, env_config: LowLevelConfig, device: str) -> tuple[PPO, TaskVecEnv]:
    """Workers and learner of one phase."""
    probe = LowLevelTask(dataclasses.replace(env_config, terrain="plane"), 1, seed=0)
    env = TaskVecEnv(
        functools.partial(make_task, env_config),
        config.n_envs,
        config.workers,
        config.seed,
        (probe.observation_space, probe.action_space),
    )
    ppo = config.ppo
    first, last = ppo.learning_rate, ppo.final_learning_rate
    mirror: dict[str, Any] = {}
    if ppo.mirror:
        mirror = {
            "rollout_buffer_class": MirroredRolloutBuffer,
            "rollout_buffer_kwargs": {
                "observation_mirror": probe.observation_mirror,
                "action_mirror": probe.action_mirror,
            },
        }
    model = PPO(
        AsymmetricActorCriticPolicy,
        env,
        learning_rate=lambda remaining: last + remaining * (first - last),
        n_steps=ppo.n_steps,
        batch_size=ppo.batch_size,
        n_epochs=ppo.n_epochs,
        gamma=ppo.gamma,
        gae_lambda=ppo.gae_lambda,
        clip_range=ppo.clip_range,
        ent_coef=ppo.ent_coef,
        vf_coef=ppo.vf_coef,
        max_grad_norm=ppo.max_grad_norm,
        policy_kwargs={
            "actor_dim": probe.actor_dim,
            "net_arch": {"pi": list(ppo.actor), "vf": list(ppo.critic)},
            "activation_fn": policies.ACTIVATIONS[ppo.activation],
            "log_std_init": float(th.tensor(ppo.initial_std).log()),
        },
        seed=config.seed,
        device=device,
        **mirror,
    )
    probe.close()
    return model, env


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--seed", type=int, help="of everything random (42)")
    parser.add_argument("--n-envs", type=int, help="robots altogether")
    parser.add_argument("--workers", type=int, help="processes that simulate")
    parser.add_argument("--steps", type=int, help="control steps altogether")
    parser.add_argument("--time-limit", type=float, metavar="S", help="stop after S seconds")
    parser.add_argument("--device", default="cpu", help="where the learner runs (cpu)")
    parser.add_argument("--out", type=Path, default=Path("runs/low"), help="run folder (runs/low)")
    parser.add_argument("--resume", action="store_true", help="go on with the run in --out")
    parser.add_argument("--init", type=Path, help="start from this policy instead of anew")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="assignments",
        help="change the configuration, e.g. env.robot.kp=25 or ppo.n_steps=48",
    )  # fmt: skip
    return parser.parse_args(arguments)


def configure(args: argparse.Namespace) -> LowTrainConfig:
    """Configuration of the run: the folder's when resuming, else defaults, then the flags."""
    config = LowTrainConfig()
    stored = args.out / "config.json"
    if args.resume:
        if not stored.is_file():
            raise ConfigError(f"--resume: no run in '{args.out}' (config.json is missing)")
        config = from_dict(LowTrainConfig, json.loads(stored.read_text(encoding="utf-8")))
    elif stored.exists():
        raise ConfigError(f"'{args.out}' holds a run already; use --resume or another --out")
    flags = {k: getattr(args, k) for k in ("seed", "n_envs", "workers", "steps")}
    config = dataclasses.replace(config, **{k: v for k, v in flags.items() if v is not None})
    return with_overrides(config, args.assignments)


def main(arguments: list[str] | None = None) -> int:
    args = parse(arguments)
    try:
        config = configure(args)
        checkpoint = newest_checkpoint(args.out, print) if args.resume else None
    except (ConfigError, CheckpointError, ValueError) as error:
        print(f"train_low.py: {error}", file=sys.stderr)
        return 2
    args.out.mkdir(parents=True, exist_ok=True)
    (args.out / "config.json").write_text(json.dumps(to_dict(config), indent=2), encoding="utf-8")
    interruption = Interruption(args.time_limit)
    seconds = float(checkpoint[1]["seconds"]) if checkpoint else 0.0
    meta = {"config": to_dict(config.env), "seed": config.seed, "code": __version__}
    carried = checkpoint
    finished = True
    for number, (env_config, until) in enumerate(phases(config)):
        if carried is not None and int(carried[1]["num_timesteps"]) >= until:
            continue
        model, env = build(config, env_config, args.device)
        started = time.monotonic()
        try:
            model.set_logger(tensorboard_logger(args.out / "tensorboard"))
            callback = RunCallback(
                args.out, env, meta, summarise, interruption, config.log_steps,
                config.checkpoint_seconds, config.steps, seconds, number,
            )  # fmt: skip
            if carried is not None:
                load_learner(model, *carried)
                if carried[1]["phase"] == number:
                    env.load_state_dicts(carried[1]["workers"])
            elif args.init is not None:
                policies.load_into(args.init, model.policy)
            restart(model, env)
            finished = learn(model, callback, until)
            callback.checkpoint()
            carried = newest_checkpoint(args.out, print)
        finally:
            env.close()
        seconds += time.monotonic() - started
        if not finished:
            print(f"stopped by {interruption.reason}; --resume --out {args.out} goes on")
            break
    return 0


if __name__ == "__main__":
    sys.exit(main())
