"""Leaps over trenches: pronk whose landings are planned to miss them.

In pronk the front feet land on one line and the rear feet on another, and a robot that steers
straight on decides where by its speed, its step frequency and its stance length. So a trench is
crossed by a plan of landings: a value function over the place of the front feet, found by dynamic
programming over the strides to come, says what each place is worth, and frequency and stance length
are chosen for the best place within reach. Feet land about where Raibert's rule has them; by how
much a low policy misses that is its own, to a few centimetres, so it is measured.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

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

#: How leaps are made: m/s, m of swing, duty factor. The faster, the longer a stride and the wider
#: the trenches that fit in: of 24 robots 5, 10 and 17 crossed level 10 at 1.0, 1.1 and 1.2 m/s. Of
#: feet at 5 cm a quarter fell in. At the 2 Hz of a start from rest robots were thrown down, so a
#: stride of a slow one is priced as if it had this speed already (docs/experiments.md).
SPEED, SWING_HEIGHT, DURATION = 1.2, 0.07, 0.55
STRIDE = 0.39  # m, of leaps where nothing asks for another: longer ones trip at the start
#: m, of leaps altogether, as commanded. A policy that was trained on strides of 0.6 m learned to
#: nod in them, and then in shorter ones too; one that was trained up to 0.5 m did not. Where
#: landings are 1 cm off, 29 of 30 tiles of level 10 can be crossed so, and 20 with 0.45 m.
LONGEST = 0.48
BEYOND = 0.5  # m behind the last trench, where leaping ends
_TURN = 1.5  # 1/s, yaw rate per rad that a leap is off its heading; as in ``teacher.toward``
_STEP = 0.01  # m between the places of a plan
_STRIDES = np.arange(28, 47, 2)  # steps: what 0.95 SPEED reaches between 2.5 and 4 Hz
#: m from a lip, at which a foot is as good as anywhere. Of 40 robots that were told where trenches
#: are 3, 15 and 28 crossed level 10 with 0.12, 0.08 and 0.05 m.
CLEAR = 0.05
_FALL = 4.0  # price of a foot in a trench; one that lands on the lip costs 1
_STRIDE_PRICE = 10.0  # 1/m^2, of a stride that is not STRIDE
_LENGTH_PRICE = 2.0  # 1/m^2, of rear feet that do not land where the front feet stood
# A stride is decided until this share of its cycle: after that the legs push off, and a clock that
# changes while they do, or in the air, throws the trunk off balance. Changes from stride to stride
# do, too, hence their price in 1/Hz^2. Of 24 tiles of level 6 and of level 10 a teacher crossed 12
# and 4 without both, 23 and 5 with the first alone, and 24 and 11 with both (docs/experiments.md).
_DECIDED, _CHANGE_PRICE = 0.4, 0.5
FREQUENCIES, LENGTHS = 25, 11  # tried at each decision, evenly over the ranges of the commands
# How robots speed up, of two low policies: 0.8, 1.1 and 1.2 m/s at the first landings after a rest,
# and 1.14 m/s for 1.2 in the long run. Without it a trench right behind the start was misjudged by
# 7 cm.
_RISE, _REACHED = 0.3, 0.95  # s of the exponential; share of the commanded speed at its end
# What is about as good as the best choice: the price by which others count e times less, and how
# many Hz and m they may be away, so that leaping short is never mixed with leaping far.
_TEMPERATURE, _NEAR = 0.05, (0.35, 0.03)


def lead(speed: Array, frequency: Array) -> Array:
    """How far ahead of their places at rest feet touch down, m: half of what the trunk travels in a
    stance (Raibert), at ``speed`` in m/s and ``frequency`` in Hz."""
    return 0.5 * DURATION * speed / frequency


def speed_up(speed: Array, commanded: Array | float, time: Array | float) -> tuple[Array, Array]:
    """How far a trunk gets in ``time`` s, in m, and how fast it is then, in m/s: from ``speed``
    towards nearly the ``commanded`` one. It does not slow down."""
    top = np.maximum(speed, _REACHED * commanded)
    left = np.exp(-time / _RISE)
    return top * time - (top - speed) * _RISE * (1.0 - left), top - (top - speed) * left


@dataclass
class Landing:
    """By how much a low policy's feet miss Raibert's footholds when they land in pronk, in m.

    Attributes:
        front: its front feet, ahead of their footholds.
        spread: its rear feet, so much further behind the front ones than commanded.
    """

    #: Until something is known.
    front: float = 0.0
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
            command, speed = loco.executed()[seen], state.lin_vel[seen, 0]
            frequency, length = command[:, INDEX["frequency"]], command[:, INDEX["stance_length"]]
            trunk = state.position[seen, 0] - clock[landed] / frequency * speed
            front, rear = feet[:, :2].mean(axis=1), feet[:, 2:].mean(axis=1)
            foothold = trunk + 0.5 * length + lead(speed, frequency)
            weight = 1.0 - (1.0 - rate) ** seen.size
            self.front += weight * float(np.mean(front - foothold) - self.front)
            self.spread += weight * float(np.mean(front - rear - length) - self.spread)


def foothold_risk(x: NDArray[np.floating], trenches: Array, clear: float = CLEAR) -> Array:
    """Price of a foot at ``x`` (...,) m along trenches (k, 2) m, ``_FALL`` inside them and nothing
    from ``clear`` m on."""
    if not len(trenches):
        return np.zeros_like(x)
    inside = np.minimum(x[..., None] - trenches[:, 0], trenches[:, 1] - x[..., None]).max(axis=-1)
    near = np.clip(1.0 + inside / clear, 0.0, 1.0) ** 2
    return np.where(inside > 0.0, _FALL, near)


class Motion(NamedTuple):
    """Of n robots that leap, (n,) each.

    Attributes:
        x: m, of the trunk along the trenches.
        speed, commanded: m/s forward.
        clock: of the gait, 0 where feet touch down.
        frequency, length: Hz and m, of steps and stance, as commanded until now.
    """

    x: Array
    speed: Array
    commanded: Array
    clock: Array
    frequency: Array
    length: Array


class Lesson(NamedTuple):
    """How n robots should make their next stride, to be imitated.

    Of the choices about as good as the best one jumps about, for no reason that a student could
    see, so these are their means. But between two ways of crossing a trench lies its middle, and
    who is in doubt between them and takes a mean steps there; so it is told the prices, too.

    Attributes:
        frequency, length: (n,) Hz and m, of steps and stance.
        price: (n, FREQUENCIES, LENGTHS) what each choice costs more than the best one does; 0 for
            robots that have decided already.
    """

    frequency: Array
    length: Array
    price: Array


class LeapPlan:
    """What landings are worth, for M robots that each leap along trenches of their own.

    Args:
        num_robots: M.
        ranges: of the commands that leaps are made with.
        clear: m from a lip, at which a foot is as good as anywhere.
    """

    def __init__(self, num_robots: int, ranges: CommandRanges, clear: float = CLEAR) -> None:
        low, high = ranges.stance_length
        self._clear = clear
        self._speed = min(SPEED, ranges.vx[1])
        self._lengths = np.linspace(low, high, LENGTHS)
        self._frequencies = np.linspace(*ranges.frequency, FREQUENCIES)
        self._x = _STEP * np.arange(1 + round(TILE_SIZE / _STEP))
        # Price of front feet at each place, with each stance length, and of all that follows.
        self._cost = np.zeros((num_robots, len(self._x), len(self._lengths)))

    def look(self, robot: int, trenches: ArrayLike, spread: float) -> None:
        """Plan for one robot along ``trenches`` (k, 2) m, the x of their lips, in its own frame."""
        lips = np.asarray(trenches, dtype=np.float64).reshape(-1, 2)
        x, n = self._x, len(self._x)
        price = foothold_risk(x[:, None] - self._lengths - spread, lips, self._clear)
        price += _LENGTH_PRICE * (self._lengths + spread - STRIDE) ** 2
        price += foothold_risk(x, lips, self._clear)[:, None]
        value = np.zeros(n + _STRIDES[-1])
        after = np.concatenate([price.min(axis=1), np.zeros(_STRIDES[-1])])
        dear = _STRIDE_PRICE * (_STEP * _STRIDES - STRIDE) ** 2
        end = lips[-1, 1] + STRIDE if len(lips) else 0.0  # nothing is worth planning behind it
        for k in range(min(n, round(end / _STEP)) - 1, -1, -1):
            ahead = k + _STRIDES
            value[k] = np.min(dear + after[ahead] + value[ahead])
        self._cost[robot] = price + value[:n, None]

    def steps(
        self, rows: NDArray[np.integer], motion: Motion, landing: Landing
    ) -> tuple[Array, Array]:
        """Step frequency in Hz and stance length in m for the next landing, (n,) each.

        Args:
            rows: (n,) of the M robots.
            motion: theirs.
            landing: the low policy's.
        """
        frequency, length = self._best(self._costs(rows, motion, landing))
        return self._held(motion, self._frequencies[frequency], self._lengths[length])

    def lesson(self, rows: NDArray[np.integer], motion: Motion, landing: Landing) -> "Lesson":
        """As ``steps``, for who is to be imitated, and what other choices would cost."""
        cost = self._costs(rows, motion, landing)
        frequency, length = self._best(cost)
        off = np.abs(self._frequencies - self._frequencies[frequency][:, None])
        near = (off < _NEAR[0])[:, :, None]
        off = np.abs(self._lengths - self._lengths[length][:, None])
        alike = (off < _NEAR[1] + 1e-9)[:, None, :]
        price = cost - cost.min(axis=(1, 2), keepdims=True)
        weight = near * alike * np.exp(-price / _TEMPERATURE)
        weight /= weight.sum(axis=(1, 2), keepdims=True)
        price[motion.clock >= _DECIDED] = 0.0
        means = weight.sum(axis=2) @ self._frequencies, weight.sum(axis=1) @ self._lengths
        return Lesson(*self._held(motion, *means), price)

    def _held(self, motion: Motion, frequency: Array, length: Array) -> tuple[Array, Array]:
        """Frequencies and lengths (n,); those of now for robots that are about to take off."""
        late = motion.clock >= _DECIDED
        return (
            np.where(late, np.clip(motion.frequency, *self._frequencies[[0, -1]]), frequency),
            np.where(late, np.clip(motion.length, *self._lengths[[0, -1]]), length),
        )

    def _best(self, cost: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        best = cost.reshape(len(cost), -1).argmin(axis=1)
        frequency, length = np.divmod(best, len(self._lengths))
        return frequency, length

    def _costs(self, rows: NDArray[np.integer], motion: Motion, landing: Landing) -> Array:
        """Of each frequency and stance length, (n, frequencies, lengths)."""
        stride = np.maximum(motion.speed, self._speed)[:, None] / self._frequencies
        left = (1.0 - motion.clock)[:, None] / self._frequencies
        own = np.maximum(motion.speed, 0.0)[:, None]
        way, then = speed_up(own, motion.commanded[:, None], left)
        foothold = motion.x[:, None] + way + lead(then, self._frequencies) + landing.front
        place = np.round((foothold[:, :, None] + 0.5 * self._lengths) / _STEP).astype(int)
        place = np.clip(place, 0, len(self._x) - 1)
        cost = self._cost[rows[:, None, None], place, np.arange(len(self._lengths))]
        dear = _STRIDE_PRICE * (stride - STRIDE) ** 2
        dear += _FALL * (motion.commanded[:, None] / self._frequencies > LONGEST)
        dear += _CHANGE_PRICE * (self._frequencies - motion.frequency[:, None]) ** 2
        return np.asarray(cost + dear[:, :, None])


def leap_command(command: Array, frequency: ArrayLike, length: ArrayLike) -> None:
    """Turn commands (n, 15) into those of a leap, in place: gait, swing, frequency, length."""
    command[:, INDEX["swing_height"]] = SWING_HEIGHT
    command[:, INDEX["duration"]] = DURATION
    command[:, INDEX["frequency"]] = frequency
    command[:, INDEX["stance_length"]] = length
    command[:, 12:] = gait_embedding(GAITS.index("pronk"))


def steer_leap(command: Array, bearing: Array, heading: Array, ranges: CommandRanges) -> None:
    """Set the velocities of commands (n, 15) of leaps, in place.

    The robots face across the trenches, so that both feet of a pair land on one line, and go
    sideways to the goal.

    Args:
        command: to be changed.
        bearing, heading: (n,) rad of the goal and of the robots, against across the trenches.
        ranges: that they stay within.
    """
    wanted = (
        ("vx", SPEED * np.cos(bearing)), ("vy", SPEED * np.sin(bearing)),
        ("yaw_rate", -_TURN * heading),
    )  # fmt: skip
    for name, value in wanted:
        command[:, INDEX[name]] = np.clip(value, *getattr(ranges, name))


_ROBOTS = 16  # that a landing is measured with: a few millimetres between two such measurements
_SECONDS, _SETTLE = 6.0, 1.5  # s, of the measurement, and how much of it speeding up takes
_STANDING = 0.5  # share of the robots that are still up after the measurement, where leaps work
_RATE = 0.02  # of a landing in the measurement: after 180 of them 3 % of the start is left


def measure_landing(low: "Policy", config: LowLevelConfig) -> Landing | None:
    """Where ``low`` lands when it leaps along a plane, with strides of 0.32 m to ``LONGEST``.

    Args:
        low: the low policy, of ``config``.

    Returns:
        The landing; None for a policy that cannot leap: most robots have fallen.
    """
    loco = Locomotion(_ROBOTS, config.robot, config.physics, None, config.gyro)
    rows, dt = np.arange(_ROBOTS), config.physics.control_dt
    stride = np.linspace(0.32, LONGEST, _ROBOTS)
    loco.command[:, INDEX["vx"]] = speed = min(SPEED, config.commands.vx[1])
    length = np.clip(stride, *config.commands.stance_length)
    leap_command(loco.command, np.clip(speed / stride, *config.commands.frequency), length)
    places = np.column_stack([np.zeros(_ROBOTS), 2.0 * rows])
    loco.place(rows, places, np.zeros(_ROBOTS), np.linspace(0.0, 1.0, _ROBOTS, endpoint=False))
    landing, up = Landing(), rows
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
    return landing if up.size >= _STANDING * _ROBOTS else None
