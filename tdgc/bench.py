"""Measure data collection: control steps per second, Bullet's share of the time, memory per robot.

    python -m tdgc.bench --out runs/bench
    python -m tdgc.bench --load
    python -m tdgc.bench --update
    python -m tdgc.bench --cluster auto

Robots take random actions in the low policy's MDP, on a plane and on all levels of all families,
with one worker and with all. The table is printed and written to ``bench.json``. With ``--load``
there are 10, 100 and 1000 robots on the plane with 1 to 8 workers, and then the learner alone with
1 to 16 threads; the table goes to ``load.json``. With ``--update`` networks of the high policy's
default size, without encoder and mirroring, are updated by sb3-contrib's own pass and by the fast
one; the table goes to ``update.json``. With ``--cluster`` processes on this machine and Ray actors
take turns simulating robots on the plane; the table goes to ``cluster.json``.
"""

import argparse
import functools
import math
import os
import sys
import time
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
import torch as th
from numpy.typing import NDArray
from sb3_contrib import RecurrentPPO
from sb3_contrib.common.recurrent.buffers import RecurrentRolloutBuffer
from sb3_contrib.common.recurrent.type_aliases import RNNStates
from stable_baselines3.common.logger import Logger

from tdgc.config import HighTrainConfig, LowLevelConfig, LowTrainConfig
from tdgc.errors import InputError, script
from tdgc.files import make_folder, write_json
from tdgc.learn.recurrent import FastRecurrentPolicy, FastRecurrentPPO
from tdgc.parallel.cluster import CLUSTER_HELP, ActorLink, check_workers, connect
from tdgc.parallel.cores import auto_workers, usable_cores, workers_flag
from tdgc.parallel.vec import TaskVecEnv, without_episodes
from tdgc.parallel.worker import MakeLink, ProcessLink, memory_mb
from tdgc.policies import ACTIVATIONS, AsymmetricActorCriticPolicy, torch_threads
from tdgc.sim.families import FAMILIES
from tdgc.sim.locomotion import actor_layout
from tdgc.sim.observation import width
from tdgc.sim.robot import NUM_JOINTS
from tdgc.tasks.high_observation import high_spaces
from tdgc.tasks.low_env import LowLevelTask
from tdgc.tasks.low_observation import low_mirror, low_spaces

_COLUMNS = ("workers", "steps/s", "in Bullet", "MB/robot", "MB")
UPDATES = 80  # turns of ``--update``: many, because other work shares the cores
#: What ``--load`` compares.
LOAD_ROBOTS, LOAD_WORKERS, LOAD_THREADS = (10, 100, 1000), (1, 2, 4, 8), (1, 2, 4, 8, 16)
_SETTLE_STEPS = 20  # not timed, while robots drop onto their feet
_EPISODE = 100  # decisions, about the mean in the shipped high policy's training
_TURNS = 10  # of each place in a comparison
_ROBOTS, _SECONDS = 100, 10.0  # of a measurement, by default


def spread_levels(env: TaskVecEnv, levels: int) -> None:
    """Begin new episodes for all robots, spread over the levels as in training."""
    env.load_state_dicts(
        [
            {**without_episodes(state), "level": np.arange(len(state["level"])) % levels}
            for state in env.state_dicts()
        ]
    )


def make_env(
    config: LowLevelConfig, robots: int, workers: int, link: MakeLink = ProcessLink
) -> TaskVecEnv:
    task = functools.partial(LowLevelTask, config)
    return TaskVecEnv(task, robots, workers, 0, low_spaces(config), link=link)


def settle(env: TaskVecEnv, levels: int) -> NDArray[np.float32]:
    """Let the robots drop onto their feet; return random actions to repeat, (64, robots, 12)."""
    spread_levels(env, levels)
    shape = (64, env.num_envs, NUM_JOINTS)
    actions = np.random.default_rng(0).normal(0.0, 1.0, shape).astype(np.float32)
    for k in range(_SETTLE_STEPS):
        env.step(actions[k])
    return actions


def collect(env: TaskVecEnv, actions: NDArray[np.float32], seconds: float) -> tuple[int, float]:
    """Take steps for about ``seconds``; return their number and the time taken in s."""
    started, steps = time.perf_counter(), 0
    while time.perf_counter() - started < seconds:
        env.step(actions[steps % len(actions)])
        steps += 1
    return steps, time.perf_counter() - started


def measure(config: LowLevelConfig, robots: int, workers: int, seconds: float) -> dict[str, float]:
    """Collect for about ``seconds``: steps_per_s, bullet_share, mb_per_robot, mb_total.

    ``bullet_share`` is the time the workers spent inside Bullet's step, divided by the time they
    spent collecting, including waiting for actions.
    """
    env = make_env(config, robots, workers)
    try:
        actions = settle(env, config.levels)
        before = sum(s["bullet_seconds"] for s in env.stats())
        steps, elapsed = collect(env, actions, seconds)
        inside = sum(s["bullet_seconds"] for s in env.stats()) - before
        megabytes = sum(map(memory_mb, (os.getpid(), *env.worker_pids)))
    finally:
        env.close()
    return {
        "steps_per_s": steps * robots / elapsed,
        "bullet_share": inside / (elapsed * workers),
        "mb_per_robot": megabytes / robots,
        "mb_total": megabytes,
    }


def learn(config: LowTrainConfig, threads: int, seconds: float) -> float:
    """Control steps per second that the low policy's learner processes, over about ``seconds``.

    Each step is processed ``n_epochs`` times, in minibatches, forwards and backwards through both
    networks.
    """
    ppo, (observed, acted) = config.ppo, low_spaces(config.env)
    policy = AsymmetricActorCriticPolicy(
        observed,
        acted,
        lambda _: ppo.learning_rate,
        actor_dim=width(actor_layout(config.env.robot, config.env.gyro)),
        mirror=low_mirror(config.env) if ppo.mirror else None,
        net_arch={"pi": list(ppo.actor), "vf": list(ppo.critic)},
        activation_fn=ACTIVATIONS[ppo.activation],
    )
    seen = th.randn(ppo.batch_size, *observed.shape)
    actions = th.randn(ppo.batch_size, *acted.shape)

    def update() -> None:
        values, log_prob, _ = policy.evaluate_actions(seen, actions)
        policy.optimizer.zero_grad()
        th.autograd.backward((values.square() - log_prob).mean())
        policy.optimizer.step()

    with torch_threads(threads):
        update()  # not timed: the first update creates the optimiser's state
        started, updates = time.perf_counter(), 0
        while time.perf_counter() - started < seconds:
            update()
            updates += 1
        elapsed = time.perf_counter() - started
    return updates * ppo.batch_size / (elapsed * ppo.n_epochs)


def compare_updates() -> dict[str, float]:
    """Content of update.json: median times in s of the high policy's update after one rollout.

    ``stock`` is the update of sb3-contrib and ``fast`` that of ``FastRecurrentPPO``, at the default
    sizes. They take turns, ``UPDATES`` each. ``ratio`` is the median of the ratios stock / fast of
    the turns, because other work on the machine affects both.

    The rollout is noise; an episode starts anywhere, at one in ``_EPISODE`` decisions on average.
    """
    config = HighTrainConfig()
    ppo, envs = config.ppo, config.n_envs
    learners: dict[str, RecurrentPPO] = {}
    for name, learner, policy in (
        ("stock", RecurrentPPO, "MlpLstmPolicy"),
        ("fast", FastRecurrentPPO, FastRecurrentPolicy),
    ):
        model = learner(
            policy,
            None,  # type: ignore[arg-type]  # no environment, as when SB3 loads a file
            n_steps=ppo.n_steps,
            batch_size=ppo.n_steps * envs // ppo.minibatches,
            n_epochs=ppo.n_epochs,
            policy_kwargs={
                "lstm_hidden_size": ppo.lstm,
                "net_arch": {"pi": list(ppo.actor), "vf": list(ppo.critic)},
            },
            seed=config.seed,
            device="cpu",
            _init_setup_model=False,
        )
        model.observation_space, model.action_space = high_spaces(config.env)
        model.n_envs = envs
        model._setup_model()
        model.set_logger(Logger(folder=None, output_formats=[]))
        fill(model, np.random.default_rng(0))
        learners[name] = model
    taken: dict[str, list[float]] = {name: [] for name in learners}
    for _ in range(UPDATES + 1):  # the first one, not counted, creates the optimiser's state
        for name, model in learners.items():
            started = time.perf_counter()
            model.train()
            taken[name].append(time.perf_counter() - started)
    turns = {name: np.array(seconds[1:]) for name, seconds in taken.items()}
    result = {name: float(np.median(seconds)) for name, seconds in turns.items()}
    result["ratio"] = float(np.median(turns["stock"] / turns["fast"]))
    head("update", "seconds", "ratio")
    for name, ratio in (("stock", 1.0), ("fast", result["ratio"])):
        print(f"{name:<8}{result[name]:>11.3f}{ratio:>11.1f}")
    return result


def fill(model: RecurrentPPO, rng: np.random.Generator) -> None:
    """Fill the rollout buffer with noise."""
    buffer, envs = cast(RecurrentRolloutBuffer, model.rollout_buffer), model.n_envs
    sizes = [cast(tuple[int], s.shape)[0] for s in (model.observation_space, model.action_space)]
    buffer.reset()  # type: ignore[no-untyped-call]
    state = th.zeros(1, envs, buffer.hidden_state_shape[-1])
    for _ in range(buffer.buffer_size):
        buffer.add(
            rng.normal(size=(envs, sizes[0])),
            rng.normal(size=(envs, sizes[1])),
            rng.normal(size=envs),
            rng.random(envs) < 1.0 / _EPISODE,
            th.zeros(envs, 1),
            th.full((envs,), -15.0),
            lstm_states=RNNStates((state, state), (state, state)),
        )
    buffer.compute_returns_and_advantage(th.zeros(envs), np.zeros(envs))


def head(*names: str) -> None:
    print(names[0].ljust(8) + "".join(name.rjust(11) for name in names[1:]))


def collected(name: str, workers: int, row: dict[str, float]) -> None:
    """Print a line of the table."""
    share = f"{100 * row['bullet_share']:.0f} %"
    print(
        f"{name:<8}{workers:>11}{row['steps_per_s']:>11.0f}{share:>11}"
        f"{row['mb_per_robot']:>11.1f}{row['mb_total']:>11.0f}",
        flush=True,
    )


def compare_grounds(robots: int, workers: int, seconds: float) -> dict[str, Any]:
    """Content of bench.json: ground -> workers, "1" or "all" -> ``measure``."""
    result: dict[str, dict[str, dict[str, float]]] = {"plane": {}, "terrain": {}}
    head("ground", *_COLUMNS)
    for ground, rows in result.items():
        terrain: Literal["plane", "tiles"] = "plane" if ground == "plane" else "tiles"
        config = LowLevelConfig(terrain=terrain, families=FAMILIES)
        for name, number in (("1", 1), ("all", workers)):
            rows[name] = measure(config, robots, number, seconds)
            collected(ground, number, rows[name])
    return result


def compare_loads(seconds: float) -> dict[str, Any]:
    """Content of load.json.

    "collect" maps robots -> workers -> ``measure``, "learn" maps threads -> ``learn``, and "cores"
    is the number of usable cores.
    """
    collect: dict[str, dict[str, dict[str, float]]] = {}
    head("robots", *_COLUMNS)
    for robots in LOAD_ROBOTS:
        rows = collect.setdefault(str(robots), {})
        for workers in LOAD_WORKERS:
            rows[str(workers)] = measure(LowLevelConfig(), robots, workers, seconds)
            collected(str(robots), workers, rows[str(workers)])
    learned: dict[str, float] = {}
    print()
    head("threads", "steps/s")
    for threads in LOAD_THREADS:
        learned[str(threads)] = learn(LowTrainConfig(), threads, seconds)
        print(f"{threads:<8}{learned[str(threads)]:>11.0f}", flush=True)
    return {"cores": usable_cores(), "collect": collect, "learn": learned}


def compare_places(robots: int, workers: int, seconds: float) -> dict[str, Any]:
    """Content of cluster.json: the throughput of local processes and of Ray actors.

    "machine" and "cluster" each map to steps_per_s and ms_per_step. "overhead" is the cluster's
    extra time per step as a share of the machine's. "robots" and "workers" are the same for both.

    The two take turns, so that other work on the machine affects both.
    """
    links: dict[str, MakeLink] = {"machine": ProcessLink, "cluster": ActorLink}
    config = LowLevelConfig()
    envs: dict[str, TaskVecEnv] = {}
    result: dict[str, Any] = {"robots": robots, "workers": workers}
    try:
        for place, link in links.items():
            envs[place] = make_env(config, robots, workers, link)
        actions = {place: settle(env, config.levels) for place, env in envs.items()}
        sums = {place: np.zeros(2) for place in envs}
        for _ in range(_TURNS):
            for place, env in envs.items():
                sums[place] += collect(env, actions[place], seconds / _TURNS)
    finally:
        for env in envs.values():
            env.close()
    head("place", "workers", "steps/s", "ms a step")
    for place, (steps, elapsed) in sums.items():
        row = {"steps_per_s": steps * robots / elapsed, "ms_per_step": 1000.0 * elapsed / steps}
        result[place] = row
        print(f"{place:<8}{workers:>11}{row['steps_per_s']:>11.0f}{row['ms_per_step']:>11.1f}")
    result["overhead"] = result["cluster"]["ms_per_step"] / result["machine"]["ms_per_step"] - 1.0
    print(f"the cluster takes {100.0 * result['overhead']:.1f} % more time")
    return result


def check_flags(args: argparse.Namespace) -> None:
    """Check the flags, and fill in the defaults of those that were not given.

    Raises:
        InputError: something was given that the comparison does not use, or is not allowed.
    """
    own = {"load": ("robots", "workers"), "update": ("robots", "workers", "seconds")}
    for what, names in own.items():
        for name in names if getattr(args, what) else ():
            if getattr(args, name) is not None:
                raise InputError(f"--{what} has its own settings: no --{name}")
    for name, default in (("robots", _ROBOTS), ("workers", "auto"), ("seconds", _SECONDS)):
        if getattr(args, name) is None:
            setattr(args, name, default)
    if args.robots < 1:
        raise InputError(f"--robots must be at least 1, not {args.robots}")
    if not 0.0 < args.seconds < math.inf:
        raise InputError(f"--seconds must be above 0 and finite, not {args.seconds:g}")


def choose_workers(args: argparse.Namespace) -> int:
    """The number of workers that ``--workers`` asks for, after joining the cluster if one is given.

    Raises:
        InputError: the number is not allowed, or the cluster cannot be used.
    """
    cores = usable_cores() if args.cluster is None else connect(args.cluster)
    workers: int = args.workers
    if args.workers == "auto":
        workers = auto_workers(args.robots, min(cores, usable_cores()))
    if not 1 <= workers <= args.robots:
        raise InputError("--workers must be 1 to the number of robots")
    if args.cluster is not None:
        check_workers(workers, cores)
    return workers


@script("tdgc.bench")
def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m tdgc.bench", description=(__doc__ or "").partition("\n")[0]
    )
    parser.add_argument("--robots", type=int, help=f"number of robots ({_ROBOTS})")
    parser.add_argument(
        "--workers",
        type=workers_flag,
        metavar="N",
        help="number of workers to compare with one (one per core)",
    )
    parser.add_argument("--seconds", type=float, help=f"length of each measurement ({_SECONDS:g})")
    what = parser.add_mutually_exclusive_group()
    what.add_argument(
        "--load", action="store_true", help="vary the numbers of robots, workers and threads"
    )
    what.add_argument(
        "--update", action="store_true", help="compare the high policy's update with SB3's"
    )
    what.add_argument(
        "--cluster", metavar="ADDRESS", help=f"compare with local processes: {CLUSTER_HELP}"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("runs/bench"), help="results folder (runs/bench)"
    )
    args = parser.parse_args(arguments)
    check_flags(args)
    args.workers = choose_workers(args)
    make_folder(args.out)
    if args.load:
        name, result = "load.json", compare_loads(args.seconds)
    elif args.update:
        name, result = "update.json", compare_updates()
    elif args.cluster is not None:
        name, result = "cluster.json", compare_places(args.robots, args.workers, args.seconds)
    else:
        name, result = "bench.json", compare_grounds(args.robots, args.workers, args.seconds)
    write_json(args.out / name, result)
    return 0


if __name__ == "__main__":
    sys.exit(main())
