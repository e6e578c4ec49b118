"""What the scripted law remembers of the high policy's cues: where the robot is and what it saw.

The high policy has its hidden state for that.
"""

import numpy as np
from numpy.typing import NDArray

from tdgc.sim.robot import Array, wrap_angle
from tdgc.sim.tile import GOAL_X, START_X, TILE_SIZE
from tdgc.tasks.planning import LOOK, between, cost_to_go, price_near
from tdgc.tasks.rules import GOAL_RADIUS


class Reckoning:
    """Estimates where M robots are on their tiles from the goal cue and the commands.

    Distance and bearing of the goal alone do not determine the heading. At the start only a sign
    is ambiguous, because starts and goals have known x. From then on, the heading follows from the
    change of the bearing, corrected for motion across the line to the goal. So there are two
    tracks, with the goal to the left or to the right of the tile's x direction as seen from the
    start; at first they are mirror images.

    Args:
        distance, bearing: (M,) m and rad, the goal cue at the start.

    Attributes:
        heading: (2, M) rad relative to the tile's x axis.
        position: (2, M, 2) m; x in the tile's frame, y relative to the goal.
    """

    def __init__(self, distance: Array, bearing: Array) -> None:
        aside = np.arccos(np.clip((GOAL_X - START_X) / np.maximum(distance, 1e-6), -1.0, 1.0))
        self.heading = np.stack([aside, -aside]) - bearing
        self._bearing = bearing
        self._place(distance, bearing)

    def move(self, distance: Array, bearing: Array, velocity: Array, dt: float) -> None:
        """Update the estimate with the goal cue ``dt`` s later, after ``velocity`` (M, 2) m/s in
        the heading frame was commanded."""
        sideways = velocity[:, 1] * np.cos(self._bearing) - velocity[:, 0] * np.sin(self._bearing)
        near = np.maximum(distance, GOAL_RADIUS)  # closer in, the bearing is uninformative
        turned = wrap_angle(bearing - self._bearing) + dt * sideways / near
        self.heading = wrap_angle(self.heading - turned)
        self._bearing = bearing
        self._place(distance, bearing)

    def _place(self, distance: Array, bearing: Array) -> None:
        direction = self.heading + bearing
        ahead = np.stack([np.cos(direction), np.sin(direction)], axis=-1)
        self.position = np.array([GOAL_X, 0.0]) - distance[:, None] * ahead

    def points(self, points: Array) -> Array:
        """Transform ``points`` (n, 2) m from the heading frame, on both tracks: (2, M, n, 2) m."""
        c, s = np.cos(self.heading)[..., None], np.sin(self.heading)[..., None]
        x, y = points.T
        return self.position[..., None, :] + np.stack([c * x - s * y, s * x + c * y], axis=-1)


class Profile:
    """What M robots have probed along x, on both tracks: ground or trench.

    A trench crosses the whole tile, so on the correct track all probes at one x agree.
    """

    _BIN = 0.01  # m, bin of the probes straight ahead, from which lips are found
    _WIDE = 0.05  # m, bin of all probes, by which the tracks are told apart
    _SURE = 2.0  # excess of disagreeing probes that rules out a track: a lip alone makes 1 or 2

    def __init__(self, num_robots: int) -> None:
        size = round((TILE_SIZE + 2.0) / self._BIN)
        self._line = np.zeros((2, 2, num_robots, size))  # track, ground or trench, robot, bin
        self._all = np.zeros((2, 2, num_robots, round(size * self._BIN / self._WIDE)))

    def add(self, x: Array, deep: NDArray[np.bool_], ahead: NDArray[np.bool_]) -> None:
        """Add probes at ``x`` (2, M, n) m on the two tracks.

        ``deep`` (M, n) marks those in a trench, and ``ahead`` (n,) those straight ahead, from
        which lips are found.
        """
        rows = np.arange(len(deep))[:, None]
        for counts, width, some in (
            (self._all, self._WIDE, np.ones_like(ahead)),
            (self._line, self._BIN, ahead),
        ):
            place = np.clip((x[..., some] / width).astype(int), 0, counts.shape[-1] - 1)
            for track in range(2):
                np.add.at(counts[track], (deep[:, some].astype(int), rows, place[track]), 1.0)

    def track(self) -> NDArray[np.int64]:
        """Return the track that each robot is on, (M,): 0, 1, or -1 while they cannot be told
        apart."""
        ground, deep = self._all[:, 0], self._all[:, 1]
        odd = np.sum(ground * deep / np.maximum(ground + deep, 1.0), axis=-1)
        return np.where(np.abs(odd[0] - odd[1]) < self._SURE, -1, odd.argmin(axis=0))

    def trenches(self, robot: int, track: int, widest: float) -> Array:
        """Return x of the lips of the trenches found, (k, 2) m; a trench whose end is out of sight
        is taken to be ``widest`` m wide."""
        ground, deep = self._line[track, :, robot]
        known = np.flatnonzero(ground + deep)
        inside = deep[known] > ground[known]
        change = np.flatnonzero(np.diff(inside))
        edges = 0.5 * self._BIN * (known[change] + known[change + 1] + 1)
        begins, ends = edges[inside[change + 1]], edges[~inside[change + 1]]
        ends = ends[ends > begins[0]] if begins.size else ends[:0]
        if ends.size < begins.size:
            ends = np.append(ends, begins[-1] + widest)
        return np.column_stack([begins, ends])

    def seen(self, robot: int, track: int) -> float:
        """Return the largest x in m that was probed straight ahead."""
        return float(np.flatnonzero(self._line[track, :, robot].sum(axis=0))[-1] * self._BIN)


class Obstacles:
    """Pillars that M robots have seen, and the way around them.

    Each robot keeps the cells in which it saw something tall and plans in a window around itself;
    beyond the window it assumes a straight way to the goal.
    """

    _CELL = 0.05  # m, grid of what was seen
    _STEP, _HALF = 0.1, 12  # cell in m, cells on either side: the window is 2.5 m wide
    _WIDE = 0.5  # m, distance from a pillar from which on it adds no cost
    _AHEAD = 0.02  # m per rad off the straight way, which breaks near ties in its favour
    _RAYS = np.linspace(-np.pi, np.pi, 48, endpoint=False)

    def __init__(self, num_robots: int) -> None:
        self._seen: list[set[tuple[int, int]]] = [set() for _ in range(num_robots)]
        axis = self._STEP * np.arange(-self._HALF, self._HALF + 1)
        self._window = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)

    def add(self, robot: int, points: Array) -> None:
        """Add ``points`` (n, 2) m at which something tall was seen."""
        self._seen[robot].update(map(tuple, np.round(points / self._CELL).astype(int).tolist()))

    def direction(self, robot: int, at: Array, goal: Array, ahead: float) -> float:
        """Return the direction in rad to take from ``at`` (2,) m to ``goal`` (2,) m.

        This is ``ahead`` rad, the straight way, if nothing was seen nearby or the goal is within
        ``LOOK``.
        """
        seen = self._CELL * np.array(sorted(self._seen[robot]), dtype=float).reshape(-1, 2)
        seen = seen[(np.abs(seen - at) < self._STEP * self._HALF + self._WIDE).all(axis=1)]
        if not seen.size or np.linalg.norm(goal - at) < LOOK:
            return ahead
        cells = at + self._window
        away = np.linalg.norm(cells[..., None, :] - seen, axis=-1).min(axis=-1)
        price = price_near(away, self._WIDE)
        straight = np.linalg.norm(cells - goal, axis=-1)
        cost = np.full(price.shape, np.inf)
        for edge in (np.s_[0], np.s_[-1], np.s_[:, 0], np.s_[:, -1]):
            cost[edge] = straight[edge] + self._STEP * (price[edge] - 1.0)
        home = straight < self._STEP
        cost[home] = straight[home]
        cost = cost_to_go(cost, self._STEP * price)
        rays = np.stack([np.cos(self._RAYS), np.sin(self._RAYS)], axis=-1)
        value = between(cost, self._HALF + LOOK / self._STEP * rays)
        value += self._AHEAD * np.abs(wrap_angle(self._RAYS - ahead))
        return float(self._RAYS[value.argmin()])
