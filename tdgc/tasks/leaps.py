"""Leaps over trenches: pronk whose landings are planned to miss them.

In pronk the front feet land on one line and the rear feet on another, and a robot that steers
straight on decides where by its step frequency and its stance length alone. So a trench is crossed
by a plan of landings: a value function over the place of the front feet, found by dynamic
programming over the strides to come, says what each place is worth, and the frequency is chosen
for the best place within reach. Where the feet of a low policy land against its trunk is its own,
to a few centimetres, so that is measured.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tdgc.config import CommandRanges, LowLevelConfig
from tdgc.sim.commands import INDEX
from tdgc.sim.gaits import GAITS, gait_embedding
from tdgc.sim.locomotion import Locomotion
from tdgc.sim.robot import Array
from tdgc.sim.terrain import TILE_SIZE

if TYPE_CHECKING:  # the low policy's workers do without PyTorch
    from tdgc.policies import Policy

#: How leaps are made: m/s, m of swing. Of feet at 5 cm a quarter fell in. At the 2 Hz of a start
#: from rest robots were thrown down, so a slow one is timed as if it had this speed already
#: (docs/experiments.md).
SPEED, SWING_HEIGHT = 1.0, 0.07
STRIDE = 0.39  # m, of leaps where nothing asks for another: longer ones trip at the start
_STEP = 0.01  # m between the places of a plan
_STRIDES = np.arange(28, 49, 2)  # steps: what 1 m/s reaches between 2 and 3.6 Hz
_CLEAR = 0.08  # m from a lip, at which a foot is as good as anywhere
_FALL = 4.0  # price of a foot in a trench; one that lands on the lip costs 1
_STRIDE_PRICE = 10.0  # 1/m^2, of a stride that is not STRIDE
_LENGTH_PRICE = 10.0  # 1/m^2, of rear feet that do not land where the front feet stood
_FREQUENCIES = 25  # that are tried at each decision


@dataclass
class Landing:
    """Where a low policy lands in pronk, in m.

    Attributes:
        front: its front feet, ahead of the trunk as it is at clock 0.
        spread: its rear feet, so much further behind the front ones than commanded.
    """

    #: Of the first edition's low policy; a measurement replaces it.
    front: float = 0.20
    spread: float = 0.0

    def learn(
        self, loco: Locomotion, rows: NDArray[np.integer], before: Array, rate: float
    ) -> None:
        """Move towards where the robots ``rows`` (n,) stand, those of them that have just landed.

        Args:
            loco: robots that leap along x.
            rows: that are to be looked at.
            before: (n,) their clocks a control step ago.
            rate: share of the way that one landing moves the estimate.
        """
        state = loco.world.state
        clock = loco.clock.clock[rows]
        middle = 0.2  # of a cycle: all feet are down in the shortest stance, 0.4
        landed = (before < middle) & (clock >= middle)
        seen = rows[landed]
        if seen.size:
            feet = state.foot_position[seen, :, 0]
            command = loco.executed()[seen]
            since = clock[landed] / command[:, INDEX["frequency"]]
            trunk = state.position[seen, 0] - since * state.lin_vel[seen, 0]
            front, rear = feet[:, :2].mean(axis=1), feet[:, 2:].mean(axis=1)
            weight = 1.0 - (1.0 - rate) ** seen.size
            self.front += weight * float(np.mean(front - trunk) - self.front)
            spread = front - rear - command[:, INDEX["stance_length"]]
            self.spread += weight * float(np.mean(spread) - self.spread)


def foothold_risk(x: NDArray[np.floating], trenches: Array) -> Array:
    """Price of a foot at ``x`` (...,) m along trenches (k, 2) m, ``_FALL`` inside them."""
    if not len(trenches):
        return np.zeros_like(x)
    inside = np.minimum(x[..., None] - trenches[:, 0], trenches[:, 1] - x[..., None]).max(axis=-1)
    near = np.clip(1.0 + inside / _CLEAR, 0.0, 1.0) ** 2
    return np.where(inside > 0.0, _FALL, near)


class LeapPlan:
    """What landings are worth, for M robots that each leap along trenches of their own.

    Args:
        num_robots: M.
        ranges: of the commands that leaps are made with.
    """

    def __init__(self, num_robots: int, ranges: CommandRanges) -> None:
        self._ranges = ranges
        low, high = ranges.stance_length
        self._lengths = np.linspace(low, high, 1 + round((high - low) / _STEP))
        self._frequencies = np.linspace(*ranges.frequency, _FREQUENCIES)
        n = 1 + round(TILE_SIZE / _STEP)
        self._x = _STEP * np.arange(n)
        # Price of landing at each place, of all that follows, and the stance length to land with.
        self._price = np.zeros((num_robots, n))
        self._value = np.zeros((num_robots, n))
        self._length = np.full((num_robots, n), min(max(STRIDE, low), high))

    def look(self, robot: int, trenches: ArrayLike, spread: float) -> None:
        """Plan for one robot along ``trenches`` (k, 2) m, the x of their lips, in its own frame."""
        lips = np.asarray(trenches, dtype=np.float64).reshape(-1, 2)
        x, n = self._x, len(self._x)
        rear = foothold_risk(x[:, None] - self._lengths - spread, lips)
        rear += _LENGTH_PRICE * (self._lengths + spread - STRIDE) ** 2
        best = rear.argmin(axis=1)
        price = foothold_risk(x, lips) + rear[np.arange(n), best]
        value = np.zeros(n + _STRIDES[-1])
        after = np.concatenate([price, np.zeros(_STRIDES[-1])])
        dear = _STRIDE_PRICE * (_STEP * _STRIDES - STRIDE) ** 2
        end = lips[-1, 1] + STRIDE if len(lips) else 0.0  # nothing is worth planning behind it
        for k in range(min(n, round(end / _STEP)) - 1, -1, -1):
            ahead = k + _STRIDES
            value[k] = np.min(dear + after[ahead] + value[ahead])
        self._price[robot], self._value[robot] = price, value[:n]
        self._length[robot] = self._lengths[best]

    def steps(
        self, rows: NDArray[np.integer], x: Array, speed: Array, clock: Array, landing: Landing
    ) -> tuple[Array, Array]:
        """Step frequency in Hz and stance length in m for the next landing, (n,) each.

        Args:
            rows: (n,) of the M robots.
            x, speed, clock: (n,) m of the trunk, m/s forward, and of the gait, 0 where feet touch
                down.
            landing: the low policy's.
        """
        fast = np.maximum(speed, SPEED)[:, None]
        stride = fast / self._frequencies
        # What the trunk still travels to the landing: at its own speed, not the one hoped for.
        to_go = (1.0 - clock)[:, None] / self._frequencies * np.maximum(speed, 0.0)[:, None]
        place = np.round((x[:, None] + landing.front + to_go) / _STEP).astype(int)
        place = np.clip(place, 0, len(self._x) - 1)
        cost = self._price[rows[:, None], place] + self._value[rows[:, None], place]
        best = (cost + _STRIDE_PRICE * (stride - STRIDE) ** 2).argmin(axis=1)
        chosen = place[np.arange(len(rows)), best]
        return self._frequencies[best], self._length[rows, chosen]


def leap_command(command: Array, frequency: ArrayLike, length: ArrayLike) -> None:
    """Turn commands (n, 15) into those of a leap, in place: gait, swing, frequency, length."""
    command[:, INDEX["swing_height"]] = SWING_HEIGHT
    command[:, INDEX["frequency"]] = frequency
    command[:, INDEX["stance_length"]] = length
    command[:, 12:] = gait_embedding(GAITS.index("pronk"))


_ROBOTS = 16  # that a landing is measured with: a few millimetres between two such measurements
_SECONDS, _SETTLE = 6.0, 1.5  # s, of the measurement, and how much of it speeding up takes
_RATE = 0.02  # of a landing in the measurement: after 180 of them 3 % of the start is left


def measure_landing(low: Policy, config: LowLevelConfig) -> Landing:
    """Where ``low`` lands when it leaps along a plane, with strides of 0.30 to 0.46 m.

    Args:
        low: the low policy, of ``config``.

    Returns:
        The landing; the first edition's where no robot stays up: such a policy cannot leap.
    """
    loco = Locomotion(_ROBOTS, config.robot, config.physics, None, config.gyro)
    rows, dt = np.arange(_ROBOTS), config.physics.control_dt
    stride = np.linspace(0.30, 0.46, _ROBOTS)
    loco.command[:, INDEX["vx"]] = min(SPEED, config.commands.vx[1])
    length = np.clip(stride, *config.commands.stance_length)
    leap_command(loco.command, np.clip(SPEED / stride, *config.commands.frequency), length)
    places = np.column_stack([np.zeros(_ROBOTS), 2.0 * rows])
    loco.place(rows, places, np.zeros(_ROBOTS), np.linspace(0.0, 1.0, _ROBOTS, endpoint=False))
    landing = Landing()
    try:
        for step in range(round(_SECONDS / dt)):
            state = loco.world.state
            loco.command[:, INDEX["yaw_rate"]] = np.clip(-state.yaw, *config.commands.yaw_rate)
            before = loco.clock.clock.copy()
            loco.act(low.predict(loco.observe())[0])
            up = np.flatnonzero(state.position[:, 2] > 0.5 * config.robot.base_height)
            if step * dt > _SETTLE and up.size:
                landing.learn(loco, up, before[up], _RATE)
    finally:
        loco.world.close()
    return landing
