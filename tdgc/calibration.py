"""Calibration: make a copy of a low policy that walks at the velocities it is commanded.

    python -m tdgc.calibration --low runs/low/uncalibrated --out runs/calibrated

A blind policy trained with random dynamics, pushes and penalties is slower than commanded. The
error differs between gaits but is repeatable: on the nominal robot the mean velocity at a command
is reproduced to 1 cm/s. So robots walk with commands of all kinds, and networks learn which
velocity each command leads to. A copy of the policy then learns, in the training MDP, to do at each
command what the original does at the command that leads to it. Observations and actions stay the
same.
"""

import argparse
import copy
import dataclasses
import functools
import itertools
import operator
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import cast

import numpy as np
import torch as th
from numpy.typing import NDArray
from torch import nn

from tdgc import policies
from tdgc.benchmark.tracking import draw_commands, walk_on_plane
from tdgc.config import (
    CalibrationConfig,
    CommandRanges,
    ConfigError,
    LowLevelConfig,
    LowTrainConfig,
)
from tdgc.errors import what_stopped
from tdgc.files import make_folder
from tdgc.parallel.cores import usable_cores, workers_flag
from tdgc.parallel.group import TaskGroup
from tdgc.parallel.jobs import run_jobs
from tdgc.parallel.worker import WorkerError
from tdgc.policies import Actor, Policy
from tdgc.sim.commands import (
    NAMES,
    NUM_COMMANDS,
    SIDEWAYS,
    command_bounds,
    gait_index,
    observed_command,
)
from tdgc.sim.gaits import GAITS
from tdgc.sim.observation import columns
from tdgc.sim.robot import Array, action_scale
from tdgc.tasks.low_env import LowLevelTask, make_task
from tdgc.tasks.pairing import load_low
from tdgc.tasks.rules import is_fallen

#: Maps the commands asked for to the commands to give instead, (n, 15) -> (n, 15).
Correction = Callable[[Array], Array]

#: Fewer robots whose walking is measured say nothing about the commands.
LEAST_ROBOTS = 64
_LEAST_WALKED = 8  # of them: four are held out to measure the networks' error
_STREAM = 3  # of random numbers; training and evaluation have others (``tdgc.sim.terrain``)
_BATCH = 400  # robots that walk at the same time
_WALK_SECONDS, _SETTLE_SECONDS = 3.5, 1.2  # the mean is over the rest
# Factors on the velocity ranges: responses are measured within the first, commands are corrected up
# to the second. The policy was never trained outside the ranges, and what it does far outside is of
# little use.
_MEASURED, _CORRECTED = 1.4, 1.2
# Weight of the squared change of a command in the corrector's loss: where the robot cannot go
# faster, asking for more must not pay.
_PULL = 0.1
# With one network instead of three, pace became worse: for commands that robots cannot follow its
# predictions were arbitrary, and nothing revealed it. The variance of three networks does.
_NETWORKS, _HIDDEN, _EPOCHS, _MINIBATCH = 3, (256, 128), 300, 256
_CORRECTIONS = 3000  # minibatches that the corrector is trained on
# Robots in distillation, and their share on a plane, as in training.
_ROBOTS, _PLANE_SHARE = 120, LowTrainConfig().plane_share
_TURN = 60  # control steps between updates
_KEPT = 40  # latest turns whose states are learned from
# Minibatches per turn, their size, and the learning rate of Adam, which falls to zero. With half as
# many, or at a rate of 3e-4, the student keeps more of the original's error (docs/experiments.md).
_UPDATES, _STATES, _RATE = 240, 1024, 2e-3
_WALKING, _FITTED = 0.3, 0.4  # approximate progress after walking and after fitting

_SIGN = np.where(np.isin(NAMES, SIDEWAYS), -1.0, 1.0)  # of commands under left-right mirroring


# ------------------------------------------------------------------ what a command leads to


def measure(low: Policy, robots: int, seed: int) -> tuple[Array, Array]:
    """Commands given to ``robots`` on a plane and their mean velocities, (n, 15) and (n, 3).

    Velocities are in the heading frame. Robots that fell are left out, so n may be smaller; it is 0
    if the simulation of one diverged, which spoils those of the others.
    """
    config = load_low(low)[1]
    rng = np.random.default_rng((_STREAM, seed))
    command = draw_commands(rng, config.commands, np.arange(robots) % len(GAITS))
    middle = command_bounds(config.commands)[:3].mean(axis=1)
    command[:, :3] = middle + _MEASURED * (command[:, :3] - middle)
    settle = round(_SETTLE_SECONDS / config.physics.control_dt)
    up, total, steps = np.ones(robots, dtype=bool), np.zeros((robots, 3)), 0
    try:
        for step, loco in enumerate(walk_on_plane(low, robots, _WALK_SECONDS, seed)):
            state = loco.world.state
            up &= ~is_fallen(loco.world)
            if step > settle:
                total += np.column_stack([state.heading_vel[:, :2], state.ang_vel[:, 2]])
                steps += 1
            loco.command[:] = command
    except FloatingPointError:
        return command[:0], total[:0]
    return command[up], total[up] / steps


def _float32(x: NDArray[np.floating]) -> th.Tensor:
    return th.from_numpy(x.astype(np.float32))


def _network(seed: int) -> nn.Sequential:
    """Network from commands, as ``ResponseModel.scaled`` gives them, to scaled velocity offsets."""
    sizes = (NUM_COMMANDS, *_HIDDEN)
    with th.random.fork_rng():
        th.manual_seed(seed)
        layers = [
            part for pair in itertools.pairwise(sizes) for part in (nn.Linear(*pair), nn.Tanh())
        ]
        return nn.Sequential(*layers, nn.Linear(sizes[-1], 3))


class ResponseModel:
    """An ensemble of networks, each of which predicts the mean velocity at a command.

    Attributes:
        error: root mean square error of their mean on a held-out eighth of the measurements, (3,)
            in m/s, m/s and rad/s.
    """

    def __init__(self, given: Array, reached: Array, ranges: CommandRanges, seed: int) -> None:
        self.ranges = ranges
        bounds = command_bounds(ranges)
        width = np.diff(bounds)[:, 0]
        self._zero = np.concatenate([bounds.mean(axis=1), np.full(3, 0.25)])
        self._unit = np.concatenate([0.5 * np.where(width > 0.0, width, 2.0), np.full(3, 0.25)])
        self._networks = [_network(3 * seed + k) for k in range(_NETWORKS)]
        self.error = self._fit(given, reached, np.random.default_rng(seed))

    def scaled(self, command: Array) -> th.Tensor:
        """Commands (n, 15) in the units of the networks: most are within [-1, 1]."""
        return _float32((command - self._zero) / self._unit)

    def velocities(self, scaled: th.Tensor) -> Array:
        """The first three columns of ``scaled`` (n, 3 or more) in m/s, m/s, rad/s, (n, 3)."""
        return self._unit[:3] * scaled[:, :3].double().numpy() + self._zero[:3]

    def predictions(self, x: th.Tensor) -> th.Tensor:
        """Scaled velocities that each network predicts at scaled commands, (networks, n, 3)."""
        return th.stack([x[:, :3] + network(x) for network in self._networks])

    def __call__(self, command: Array) -> Array:
        """Velocities at commands (n, 15), the mean of the networks' predictions, (n, 3)."""
        with th.inference_mode():
            return self.velocities(self.predictions(self.scaled(command)).mean(dim=0))

    @policies.one_thread()
    def _fit(self, given: Array, reached: Array, rng: np.random.Generator) -> Array:
        # Robots are dealt to the gaits in turn, so of eight rounds of gaits one is held out. (Those
        # that fell are missing from the rounds.)
        held = np.arange(len(given)) // len(GAITS) % 8 == 0
        # A mirrored robot responds to the mirrored command with the mirrored velocity.
        sign = np.array([np.ones(NUM_COMMANDS), _SIGN])[:, None]
        command = (sign * given[~held]).reshape(-1, NUM_COMMANDS)
        lack = (sign[..., :3] * (reached - given[:, :3])[~held]).reshape(-1, 3) / self._unit[:3]
        x, y = self.scaled(command), _float32(lack)
        for network in self._networks:
            optimiser = th.optim.AdamW(network.parameters(), lr=2e-3)
            rate = th.optim.lr_scheduler.CosineAnnealingLR(optimiser, _EPOCHS)
            for _ in range(_EPOCHS):
                order = th.from_numpy(rng.permutation(len(x)))
                for rows in th.split(order, _MINIBATCH):
                    # Gives the few robots that stumble less weight than a squared loss would.
                    loss = nn.functional.smooth_l1_loss(network(x[rows]), y[rows], beta=0.2)
                    optimiser.zero_grad()
                    loss.backward()  # type: ignore[no-untyped-call]
                    optimiser.step()
                rate.step()
        return np.asarray(np.sqrt(np.mean((self(given[held]) - reached[held]) ** 2, axis=0)))


class Corrector:
    """Corrects commands so that the robot moves at the velocities asked for, as far as possible.

    A network trained through the networks of the response: to make their mean what was asked, to
    keep to commands where they agree, and not to ask for more where more does not help.
    """

    @policies.one_thread()
    def __init__(self, response: ResponseModel, seed: int) -> None:
        self._response, self._network = response, _network(seed)
        rng = np.random.default_rng((_STREAM, seed))
        optimiser = th.optim.Adam(self._network.parameters(), lr=2e-3)
        rate = th.optim.lr_scheduler.CosineAnnealingLR(optimiser, _CORRECTIONS)
        for _ in range(_CORRECTIONS):
            gait = rng.integers(0, len(GAITS), _STATES)
            asked = response.scaled(draw_commands(rng, response.ranges, gait))
            given = self._correct(asked)
            expected = response.predictions(given)
            miss = expected.mean(dim=0) - asked[:, :3]
            doubt = expected.var(dim=0, unbiased=False)
            pull = _PULL * (given - asked)[:, :3].square()
            loss = (miss.square() + doubt + pull).mean()
            optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimiser.step()
            rate.step()

    def __call__(self, command: Array) -> Array:
        """(n, 15) -> (n, 15): changes the velocities only."""
        corrected = command.copy()
        with th.inference_mode():
            given = self._correct(self._response.scaled(command))
        corrected[:, :3] = self._response.velocities(given)
        return corrected

    def _correct(self, asked: th.Tensor) -> th.Tensor:
        velocity = asked[:, :3] + self._network(asked)
        # Commands outside the ranges remain possible, although those on the way over a tile are
        # within them.
        limit = asked[:, :3].abs().clamp(min=_CORRECTED)
        return th.cat([velocity.clamp(-limit, limit), asked[:, 3:]], dim=1)


# ------------------------------------------------------------------ the copy


def training_tasks(
    config: LowLevelConfig, robots: int, seed: int, plane_share: float
) -> list[LowLevelTask]:
    """The training MDP as late in a run: all commands, all levels, ``plane_share`` on a plane.

    On the plane, unlike in training, the physics is that of the tiles.
    """
    config = dataclasses.replace(config, command_start=1.0)
    plane, tiles = (dataclasses.replace(config, terrain=ground) for ground in ("plane", "tiles"))
    task = make_task((plane, tiles), plane_share, robots, seed)
    parts = task.tasks if isinstance(task, TaskGroup) else [task]
    tasks = [cast(LowLevelTask, part) for part in parts]
    rugged = tasks[-1]
    rugged.level[:] = np.arange(rugged.num_robots) % config.levels
    return tasks


def shown(
    low: Policy, correct: Correction, task: LowLevelTask
) -> tuple[NDArray[np.float32], Array]:
    """Observations of a task's robots, (M, n), and the actions to learn for them, (M, 12).

    With these actions the joint targets are those of ``low`` at the corrected commands.
    """
    loco = task.locomotion
    x = task.observe()[:, : low.actor_dim]
    asked, pose = loco.command, loco.pose()
    loco.command = asked.copy()
    loco.command[:, :3] = correct(loco.executed())[:, :3]
    change = loco.pose() - pose
    given, where = x.copy(), columns(loco.layout)
    given[:, where["command"]] = observed_command(loco.executed())
    given[:, where["joint_error"]] -= change
    if "pose" in where:
        given[:, where["pose"]] += change
    loco.command = asked
    return x, low.predict(given)[0] + change / action_scale(loco.robot)


@policies.one_thread()
def distil(
    low: Policy,
    correct: Correction,
    tasks: Sequence[LowLevelTask],
    turns: int,
    seed: int,
    tick: Callable[[float], None] = lambda share: None,
) -> tuple[Actor, float, float]:
    """Train a student, at first a copy of ``low``, to act as ``low`` does at corrected commands.

    The student acts, and learns from the states that it visits (DAgger, Ross et al. 2011). Commands
    last for seconds, so these states have few of them. It therefore also learns what to do in each
    state at another command of the same gait, drawn from the whole ranges.

    Returns:
        The student, and the root mean square of its difference in actions on the states of its
        first turn, before it has learned anything, and on those of its last, before that turn's
        updates.
    """
    student = copy.deepcopy(low.actor).requires_grad_(True)
    rng = np.random.default_rng((_STREAM, seed))
    optimiser = th.optim.Adam(student.parameters(), lr=_RATE)
    seen: list[tuple[th.Tensor, th.Tensor]] = []
    first = last = 0.0
    for task in tasks:
        task.reset(np.arange(task.num_robots))
    for turn in range(turns):
        lessons = []
        for _ in range(_TURN):
            for task in tasks:
                # The other command first: what is observed last sets the gait clock.
                loco, asked = task.locomotion, task.locomotion.command
                loco.command = draw_commands(rng, task.config.commands, gait_index(asked))
                other = shown(low, correct, task)
                loco.command = asked
                own = shown(low, correct, task)
                state, wanted = (_float32(part) for part in own)
                with th.inference_mode():
                    actions = student(state).numpy()
                _, terminated, truncated = task.step(np.clip(actions, low.low, low.high))
                if np.isfinite(task.locomotion.world.state.position).all():
                    task.reset(np.flatnonzero(terminated | truncated))
                else:  # a robot's simulation has blown up
                    task.restart()
                lessons += [(state, wanted), tuple(_float32(part) for part in other)]
        state, wanted = (th.cat(parts) for parts in zip(*lessons, strict=True))
        with th.inference_mode():
            last = float((student(state) - wanted).square().mean().sqrt())
        first = first if turn else last
        seen = [*seen[1 - _KEPT :], (state, wanted)]
        every, actions_wanted = (th.cat(parts) for parts in zip(*seen, strict=True))
        optimiser.param_groups[0]["lr"] = _RATE * (1.0 - turn / turns)
        for _ in range(_UPDATES):
            rows = th.from_numpy(rng.integers(0, len(every), _STATES))
            loss = (student(every[rows]) - actions_wanted[rows]).square().mean()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
        tick((turn + 1) / turns)
    return student, first, last


# ------------------------------------------------------------------ the script


def calibrate(
    low: Policy,
    calibration: CalibrationConfig,
    workers: int,
    seed: int,
    tick: Callable[[float], None] = lambda share: None,
    plane_share: float = _PLANE_SHARE,
) -> tuple[Actor, dict[str, float]]:
    """Measure responses, fit the networks and distil the copy.

    Args:
        low: the policy to calibrate.
        calibration: numbers of robots and turns.
        workers: processes in which the robots walk.
        seed: of everything random here.
        tick: called now and then with the share of the work done; what it raises ends the work.
        plane_share: of the robots that the copy learns from, as in training.

    Returns:
        The student, and facts about its calibration, whose keys include the units.

    Raises:
        ConfigError: fewer than ``_LEAST_WALKED`` robots walked without a fall.
        WorkerError: a worker failed.
    """
    config = load_low(low)[1]
    robots, turns = calibration.robots, calibration.turns
    counts = [min(_BATCH, robots - first) for first in range(0, robots, _BATCH)]
    jobs = [
        functools.partial(measure, low, count, seed * len(counts) + k)
        for k, count in enumerate(counts)
    ]
    walks = []
    for walk in run_jobs(operator.call, jobs, workers):
        walks.append(walk)
        tick(_WALKING * len(walks) / len(jobs))
    given, reached = (np.concatenate(parts) for parts in zip(*walks, strict=True))
    if len(given) < _LEAST_WALKED:
        raise ConfigError(
            f"only {len(given)} of {robots} robots walked without a fall, which is too few to "
            "calibrate; calibration.robots=0 leaves the policy as it is"
        )
    response = ResponseModel(given, reached, config.commands, seed)
    correct = Corrector(response, seed)
    tick(_FITTED)
    tasks = training_tasks(config, _ROBOTS, seed, plane_share)
    try:
        student, first, last = distil(
            low, correct, tasks, turns, seed, lambda done: tick(_FITTED + (1.0 - _FITTED) * done)
        )
    finally:
        for task in tasks:
            task.close()
    vx, vy, yaw_rate = response.error.tolist()
    return student, {
        "robots": robots, "turns": turns, "seed": seed, "walked": len(given),
        "error_vx_m_s": vx, "error_vy_m_s": vy, "error_yaw_rate_rad_s": yaw_rate,
        "action_difference_before": first, "action_difference_after": last,
    }  # fmt: skip


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m tdgc.calibration", description=(__doc__ or "").partition("\n")[0]
    )
    parser.add_argument(
        "--low", type=Path, required=True, help="low policy, with or without suffix"
    )
    parser.add_argument("--out", type=Path, required=True, help="where to write the copy")
    robots, turns = CalibrationConfig.robots, CalibrationConfig.turns
    parser.add_argument(
        "--robots", type=int, default=robots, help=f"number of robots measured ({robots})"
    )
    parser.add_argument(
        "--turns", type=int, default=turns,
        help=f"distillation rounds of {_TURN} control steps each ({turns})",
    )  # fmt: skip
    parser.add_argument(
        "--plane-share", type=float, default=_PLANE_SHARE, metavar="SHARE",
        help=f"share of the robots that are on a plane while distilling ({_PLANE_SHARE})",
    )  # fmt: skip
    parser.add_argument(
        "--workers", type=workers_flag, default="auto", metavar="N",
        help="simulation processes (one per core)",
    )  # fmt: skip
    parser.add_argument("--seed", type=int, default=42, help="random seed (42)")
    args = parser.parse_args(arguments)
    try:
        for name, least in (("robots", LEAST_ROBOTS), ("turns", 1), ("seed", 0)):
            if getattr(args, name) < least:
                raise ValueError(f"--{name} must be {least} or more, not {getattr(args, name)}")
        if not 0.0 <= args.plane_share < 1.0:
            raise ValueError(f"--plane-share must be from 0 to below 1, not {args.plane_share:g}")
        if args.workers != "auto" and args.workers < 1:
            raise ValueError(f"--workers must be 1 or more, not {args.workers}")
        low = load_low(args.low)[0]
        if low.meta.get("calibration", {}).get("robots"):
            raise ValueError(
                f"{args.low} is calibrated already; give the policy from before, which "
                "train_low.py keeps as 'uncalibrated' in its run folder"
            )
        make_folder(args.out.parent)
    except (ValueError, OSError) as error:
        print(f"tdgc.calibration: {error}", file=sys.stderr)
        return 2
    workers = usable_cores() if args.workers == "auto" else args.workers
    calibration = CalibrationConfig(args.robots, args.turns)
    try:
        student, facts = calibrate(
            low, calibration, workers, args.seed, plane_share=args.plane_share
        )
        policies.save_copy(args.out, low, student.tensors(), {**low.meta, "calibration": facts})
    except (ValueError, WorkerError, OSError) as error:
        print(f"tdgc.calibration: {what_stopped(error)}", file=sys.stderr)
        return 2 if isinstance(error, ValueError) else 1
    except KeyboardInterrupt as error:
        print(f"tdgc.calibration: {what_stopped(error)}", file=sys.stderr)
        sys.exit(1)  # instead of returning, so that a caller stops, too
    print(
        f"{facts['walked']:.0f} of {args.robots} robots walked; the fit predicts what commands "
        f"lead to within {facts['error_vx_m_s']:.3f} and {facts['error_vy_m_s']:.3f} m/s and "
        f"{facts['error_yaw_rate_rad_s']:.3f} rad/s; difference in actions "
        f"{facts['action_difference_before']:.3f} before and "
        f"{facts['action_difference_after']:.3f} after learning"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
