"""Calibration: make a copy of a low policy that walks at the velocities it is commanded.

    python -m tdgc.calibration --low runs/low/uncalibrated --out runs/calibrated

A blind policy trained with random dynamics, pushes and penalties does not walk as commanded. The
error differs between gaits but is repeatable: on the nominal robot the mean velocity at a command
is reproduced to 1 cm/s. So robots walk with commands of all kinds, and networks learn which
velocity each command leads to. Another network learns which command leads to the velocity that is
asked for. That network becomes part of the copy, and whatever drives the policy
(``tdgc.tasks.executor``, the exported graph) queries it first. The policy itself stays the same.
"""

import argparse
import functools
import itertools
import operator
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch as th
from torch import nn

from tdgc import policies
from tdgc.benchmark.tracking import draw_commands, walk_on_plane
from tdgc.config import CalibrationConfig, CommandRanges, ConfigError
from tdgc.errors import script
from tdgc.files import make_folder
from tdgc.parallel.cores import usable_cores, workers_flag
from tdgc.parallel.jobs import run_jobs
from tdgc.policies import Correction, Policy
from tdgc.policies.files import files_of
from tdgc.sim.commands import NAMES, NUM_COMMANDS, SIDEWAYS, CommandDecoder, command_bounds
from tdgc.sim.gaits import GAITS
from tdgc.sim.robot import Array
from tdgc.tasks.pairing import load_low, mdp_of
from tdgc.tasks.rules import is_fallen

#: Minimum number of robots measured, 16 with each gait: fewer say nothing about 12 commands.
LEAST_ROBOTS = 64
_LEAST_WALKED = 8  # of them without a fall: four are held out to measure the networks' error
_STREAM = 3  # of random numbers; training and evaluation have others (``tdgc.sim.terrain``)
_BATCH = 400  # robots that walk at the same time: the default number gives work to twelve cores
# s of walking, and s at its start that the mean leaves out; the rest is four cycles or more. Robots
# speed up within four times 0.3 s, see ``tdgc.tasks.leaps``.
_WALK_SECONDS, _SETTLE_SECONDS = 3.5, 1.2
# Factor on the velocity ranges. Commands are corrected up to ``correction.LIMIT``, 1.2, and nothing
# is known beyond what was measured.
_MEASURED = 1.4
# Weight of the squared change of a command in the correction's loss: where the robot cannot go
# faster, asking for more must not pay. Chosen by hand.
_PULL = 0.1
# With one network instead of three, pace became worse: for commands that robots cannot follow its
# predictions were arbitrary, and nothing revealed it. The variance of three networks does. What was
# tried is in docs/experiments.md; the other numbers were chosen by hand.
_NETWORKS, _HIDDEN, _EPOCHS, _MINIBATCH = 3, (256, 128), 300, 256
_CORRECTIONS, _COMMANDS = 3000, 1024  # minibatches that the correction learns from, and their size
_WALKING, _FITTED = 0.6, 0.8  # approximate progress after walking and after fitting

_SIGN = np.where(np.isin(NAMES, SIDEWAYS), -1.0, 1.0)  # of commands under left-right mirroring


# ------------------------------------------------------------------ what a command leads to


def measure(low: Policy, robots: int, seed: int) -> tuple[Array, Array]:
    """Commands given to ``robots`` on a plane and their mean velocities, (n, 15) and (n, 3).

    Velocities are in the heading frame. Robots that fell are left out, so n may be smaller; it is 0
    if the simulation of one diverged, which spoils those of the others.
    """
    config = mdp_of(low)
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
        zero, unit: (15,) middle and half width of the commands' ranges.
        error: root mean square error of their mean on a held-out eighth of the measurements, (3,)
            in m/s, m/s and rad/s.
    """

    def __init__(self, given: Array, reached: Array, ranges: CommandRanges, seed: int) -> None:
        self.ranges = ranges
        decoder = CommandDecoder(ranges)
        width = decoder.high - decoder.low
        self.zero = th.from_numpy(0.5 * (decoder.low + decoder.high))
        self.unit = th.from_numpy(0.5 * np.where(width > 0.0, width, 2.0))
        self._networks = [_network(3 * seed + k) for k in range(_NETWORKS)]
        self.error = self._fit(given, reached, np.random.default_rng(seed))

    def scaled(self, command: th.Tensor) -> th.Tensor:
        """Commands (n, 15) in the units of the networks: most are within [-1, 1]."""
        return ((command - self.zero) / self.unit).float()

    def predictions(self, x: th.Tensor) -> th.Tensor:
        """Scaled velocities that each network predicts at scaled commands, (networks, n, 3)."""
        return th.stack([x[:, :3] + network(x) for network in self._networks])

    def __call__(self, command: Array) -> Array:
        """Velocities at commands (n, 15), the mean of the networks' predictions, (n, 3)."""
        with th.inference_mode():
            scaled = self.predictions(self.scaled(th.from_numpy(command))).mean(dim=0)
            return np.asarray((self.zero[:3] + self.unit[:3] * scaled.double()).numpy())

    @policies.torch_threads(1)
    def _fit(self, given: Array, reached: Array, rng: np.random.Generator) -> Array:
        # Robots are dealt to the gaits in turn, so of eight rounds of gaits one is held out. (Those
        # that fell are missing from the rounds.)
        held = np.arange(len(given)) // len(GAITS) % 8 == 0
        # A mirrored robot responds to the mirrored command with the mirrored velocity.
        sign = np.array([np.ones(NUM_COMMANDS), _SIGN])[:, None]
        command = (sign * given[~held]).reshape(-1, NUM_COMMANDS)
        lack = (sign[..., :3] * (reached - given[:, :3])[~held]).reshape(-1, 3)
        x = self.scaled(th.from_numpy(command))
        y = (th.from_numpy(lack) / self.unit[:3]).float()
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


@policies.torch_threads(1)
def learn_correction(response: ResponseModel, seed: int) -> Correction:
    """Learn to correct commands so that robots move as they are asked to, as far as possible.

    The network is trained through the networks of the response: to make their mean what was asked,
    to keep to commands where they agree, and not to ask for more where more does not help.
    """
    network = _network(seed)
    linear = [layer for layer in network if isinstance(layer, nn.Linear)]
    tensors = {"zero": response.zero, "unit": response.unit, "sign": th.from_numpy(_SIGN)}
    for i, layer in enumerate(linear):
        tensors |= {f"{i}.weight": layer.weight, f"{i}.bias": layer.bias}
    correction = Correction((NUM_COMMANDS, *(layer.out_features for layer in linear)), tensors)
    correction.requires_grad_(True)
    rng = np.random.default_rng((_STREAM, seed))
    optimiser = th.optim.Adam(correction.parameters(), lr=2e-3)
    rate = th.optim.lr_scheduler.CosineAnnealingLR(optimiser, _CORRECTIONS)
    for _ in range(_CORRECTIONS):
        gait = rng.integers(0, len(GAITS), _COMMANDS)
        command = th.from_numpy(draw_commands(rng, response.ranges, gait))
        asked, given = response.scaled(command), response.scaled(correction(command))
        expected = response.predictions(given)
        miss = expected.mean(dim=0) - asked[:, :3]
        doubt = expected.var(dim=0, unbiased=False)
        pull = _PULL * (given - asked)[:, :3].square()
        loss = (miss.square() + doubt + pull).mean()
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        rate.step()
    return correction.requires_grad_(False)


# ------------------------------------------------------------------ the script


def calibrate(
    low: Policy,
    robots: int,
    workers: int,
    seed: int,
    tick: Callable[[float], None] = lambda share: None,
) -> tuple[Correction, dict[str, float]]:
    """Measure responses, and learn to correct them.

    Args:
        low: the policy to calibrate.
        robots: number of robots that walk.
        workers: number of processes in which they walk.
        seed: seed of all random numbers drawn here.
        tick: called repeatedly with the share of the work done; raising ends the work.

    Returns:
        The correction, and facts about the calibration, whose keys include the units.

    Raises:
        ConfigError: fewer than ``_LEAST_WALKED`` robots walked without a fall.
        WorkerError: a worker failed.
    """
    config = mdp_of(low)
    counts = [min(_BATCH, robots - first) for first in range(0, robots, _BATCH)]
    jobs = [
        functools.partial(measure, low, count, seed * len(counts) + k)
        for k, count in enumerate(counts)
    ]
    walks = []
    tick(0.0)
    for walk in run_jobs(operator.call, jobs, workers):
        walks.append(walk)
        tick(_WALKING * len(walks) / len(jobs))
    given, reached = (np.concatenate(parts) for parts in zip(*walks, strict=True))
    if len(given) < _LEAST_WALKED:
        raise ConfigError(
            f"only {len(given)} of {robots} robots walked without a fall, which is too few to "
            "calibrate"
        )
    response = ResponseModel(given, reached, config.commands, seed)
    tick(_FITTED)
    vx, vy, yaw_rate = response.error.tolist()
    return learn_correction(response, seed), {
        "robots": robots, "seed": seed, "walked": len(given),
        "error_vx_m_s": vx, "error_vy_m_s": vy, "error_yaw_rate_rad_s": yaw_rate,
    }  # fmt: skip


@script("tdgc.calibration")
def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m tdgc.calibration", description=(__doc__ or "").partition("\n")[0]
    )
    parser.add_argument(
        "--low", type=Path, required=True, help="low policy, with or without suffix"
    )
    parser.add_argument("--out", type=Path, required=True, help="where to write the copy")
    robots = CalibrationConfig.robots
    parser.add_argument(
        "--robots", type=int, default=robots, help=f"number of robots measured ({robots})"
    )
    parser.add_argument(
        "--workers", type=workers_flag, default="auto", metavar="N",
        help="simulation processes (one per core)",
    )  # fmt: skip
    parser.add_argument("--seed", type=int, default=42, help="random seed (42)")
    args = parser.parse_args(arguments)
    args.workers = usable_cores() if args.workers == "auto" else args.workers
    for name, least in (("robots", LEAST_ROBOTS), ("seed", 0), ("workers", 1)):
        if getattr(args, name) < least:
            raise ValueError(f"--{name} must be {least} or more, not {getattr(args, name)}")
    if args.seed >= 2**32:
        raise ValueError(f"--seed must be below 2**32, not {args.seed}")
    low = load_low(args.low)[0]
    if low.meta.get("calibration", {}).get("robots"):
        raise ValueError(
            f"{args.low} is calibrated already; give the policy from before, which "
            "train_low.py keeps as 'uncalibrated' in its run folder"
        )
    if files_of(args.out)[0].absolute() == files_of(args.low)[0].absolute():
        raise ValueError(f"--out would replace --low, {args.low}; give another path")
    make_folder(args.out.parent)
    correction, facts = calibrate(low, args.robots, args.workers, args.seed)
    policies.save_copy(args.out, low, {**low.meta, "calibration": facts}, correction)
    print(
        f"{facts['walked']:.0f} of {args.robots} robots walked; the fit predicts what commands "
        f"lead to within {facts['error_vx_m_s']:.3f} and {facts['error_vy_m_s']:.3f} m/s and "
        f"{facts['error_yaw_rate_rad_s']:.3f} rad/s"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
