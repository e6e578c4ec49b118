"""Recordings: everything needed to replay an episode, at every control step."""

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tdgc.benchmark.drivers import Driver
from tdgc.benchmark.evaluation import Batch, EpisodeRecord
from tdgc.config import RobotConfig
from tdgc.sim.commands import command_bounds
from tdgc.sim.robot import Array


@dataclass(frozen=True, eq=False)
class Recording(EpisodeRecord):
    """One episode; row i of the arrays is the robot after control step i of n.

    Attributes:
        robot: configuration of the robot.
        dt: length of a control step in s.
        bounds: (12, 2) bounds of the continuous commands.
        position, quaternion: pose of the trunk in the tile's frame, (n, 3) m and (n, 4).
        q: (n, 12) rad, joint angles.
        command: (n, 15) as carried out during the step.
        velocity: (n, 3) forward and left in m/s, yaw rate in rad/s, like the first commands.
        height: (n,) m, trunk above the support surface under it.
        contact, desired: (n, 4) whether each foot is in contact, and whether the gait desires it.
    """

    robot: RobotConfig
    dt: float
    bounds: Array
    position: Array
    quaternion: Array
    q: Array
    command: Array
    velocity: Array
    height: Array
    contact: NDArray[np.bool_]
    desired: NDArray[np.bool_]

    @property
    def ending(self) -> str:
        """Outcome and time of the end, as text for people."""
        return f"{self.outcome.replace('_', ' ')}, {len(self.command) * self.dt:.1f} s"


class Recorder:
    """A ``Watcher`` that records the first episodes of a family and level.

    Args:
        driver: the driver of the batch.
        count: episodes with a number below this are recorded.
    """

    def __init__(self, driver: Driver, count: int) -> None:
        self._driver, self._count = driver, count

    def begin(self, batch: Batch) -> None:
        self._batch, cell = batch, batch.cell
        self._rows = np.arange(max(0, min(cell.count, self._count - cell.first)))
        self._origin = np.pad(batch.origin[self._rows], ((0, 0), (0, 1)))
        self._kept: list[dict[str, NDArray[Any]]] = []

    def step(self, step: int, live: NDArray[np.intp]) -> None:
        rows, loco = self._rows, self._batch.loco
        if not np.isin(rows, live).any():
            return
        state = loco.world.state
        self._kept.append(
            {
                "position": state.position[rows] - self._origin,
                "quaternion": state.quaternion[rows],
                "q": state.q[rows],
                "command": loco.carried_out[rows],
                "velocity": np.column_stack([state.heading_vel[rows, :2], state.ang_vel[rows, 2]]),
                "height": loco.world.trunk_height()[rows],
                "contact": state.touching[rows],
                "desired": loco.clock.contact[rows] > 0.5,
            }
        )

    def recordings(self) -> list[Recording]:
        """Return the recordings of the last batch watched, in order."""
        batch, loco = self._batch, self._batch.loco
        result = []
        for k in self._rows.tolist():
            steps, fields = self._kept[: batch.steps[k]], batch.record(k)
            fields |= {key: np.array([step[key][k] for step in steps]) for key in steps[0]}
            fields |= {"robot": loco.robot, "dt": loco.physics.control_dt}
            result.append(Recording(**fields, bounds=command_bounds(self._driver.bounds)))
        return result


def spans(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the runs of True in ``flags`` (n,) as (begin, end), so that ``flags[begin:end]`` are
    all True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def runs_of_equal(values: NDArray[np.int64]) -> list[tuple[int, int, int]]:
    """Return the runs of equal ``values`` (n,) as (begin, end, value); together they cover all."""
    cuts = [0, *(np.flatnonzero(np.diff(values)) + 1).tolist(), len(values)]
    return [(a, b, int(values[a])) for a, b in itertools.pairwise(cuts)]
