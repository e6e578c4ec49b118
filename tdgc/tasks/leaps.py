"""Leaps over trenches: pronk with landings planned to miss them.

In pronk the front feet land on one line and the rear feet on another. For a robot that steers
straight ahead, its speed, step frequency and stance length decide where these lines are. A trench
is therefore crossed by a plan of landings: dynamic programming over the coming strides yields a
value function over the position of the front feet, and frequency and stance length are chosen for
the best position within reach. Feet land close to Raibert's footholds; how far off differs between
low policies by a few centimetres, so it is measured.
"""

from contextlib import closing
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tdgc.config import CommandRanges, LowLevelConfig, RobotConfig
from tdgc.sim.bullet_world import BulletWorld
from tdgc.sim.commands import INDEX
from tdgc.sim.gaits import GAITS, PhaseClock, executed_frequency, gait_embedding
from tdgc.sim.locomotion import Locomotion
from tdgc.sim.robot import Array
from tdgc.sim.tile import TILE_SIZE
from tdgc.tasks.executor import Executor

if TYPE_CHECKING:  # the low policy's workers do not load PyTorch
    from tdgc.policies import Policy

#: Commands of a leap: speed in m/s, swing height in m, duty factor. Faster leaps have longer
#: strides, into which wider trenches fit: of 24 robots 5, 10 and 17 crossed level 10 at 1.0, 1.1
#: and 1.2 m/s. With a swing height of 5 cm a quarter fell in. All leaps at 2 Hz from rest ended in
#: a fall, so a slow robot's stride is priced as if it already had this speed (docs/experiments.md).
SPEED, SWING_HEIGHT, DURATION = 1.2, 0.07, 0.55
STRIDE = 0.39  # m, preferred stride of a leap: with longer ones robots trip at the start
#: m, longest commanded stride in pronk. A policy trained on strides of 0.6 m learned to nod in
#: them, and then in shorter ones too; one trained on strides up to 0.5 m did not. With landings
#: 1 cm off, 29 of 30 tiles of level 10 can be crossed with this limit, and 20 with 0.45 m.
LONGEST = 0.48
# m behind the last trench, at which leaping ends: the rear feet, 0.38 m behind the front ones, are
# across, too.
BEYOND = 0.5
# 1/s, yaw rate per rad of heading error, in a walk as in a leap; chosen by hand.
HEADING_GAIN = 1.5
_STEP = 0.01  # m, grid spacing of a plan
_STRIDES = np.arange(28, 47, 2)  # in units of _STEP: strides at 0.95 SPEED and 2.5 to 4 Hz
#: m from a trench's edge (its lip), beyond which a foot is safe. Of 40 robots that were told where
#: the trenches are, 3, 15 and 28 crossed level 10 with 0.12, 0.08 and 0.05 m.
CLEAR = 0.05
# Prices, chosen by hand: a foot in a trench must cost more than any other choice.
_FALL = 4.0  # a foot in a trench; a foot on the lip costs 1
_STRIDE_PRICE = 10.0  # 1/m^2, for the squared difference of a stride from STRIDE
_LENGTH_PRICE = 2.0  # 1/m^2, for the squared distance of rear feet from where the front stood
# A stride can be changed until this share of its cycle. After that the legs push off, and a change
# of the clock during push-off or flight throws the trunk off balance. So do changes from stride to
# stride, hence their price in 1/Hz^2. Of 24 tiles each of levels 6 and 10, a teacher crossed 12 and
# 4 with neither rule, 23 and 5 with the first alone (21 and 8 with 0.5 of the cycle), and 24 and 11
# with both at 0.5 of the cycle (docs/experiments.md).
_DECIDED, _CHANGE_PRICE = 0.4, 0.5
_PRONK = gait_embedding(GAITS.index("pronk"))
#: Commands that decide on the next stride: step frequency and stance length.
STRIDE_COMMANDS = [INDEX["frequency"], INDEX["stance_length"]]
# Numbers of values tried at each decision, evenly spaced over the command ranges. Neighbouring
# values move a landing by about a centimetre, the grid spacing of a plan.
FREQUENCIES, LENGTHS = 25, 11
# How leaping robots speed up, from two low policies: 0.8, 1.1 and 1.2 m/s at the first landings
# from rest, and 1.14 m/s in the long run when 1.2 is commanded. Without this model, landings at a
# trench right behind the start were misjudged by 7 cm.
_RISE, _REACHED = 0.3, 0.95  # time constant in s; share of the commanded speed that is reached
# Choices about as good as the best are averaged: the price that reduces a choice's weight by a
# factor of e, and how many Hz and m it may be from the best, so that a short leap is never averaged
# with a long one. Chosen by hand.
_TEMPERATURE, _NEAR = 0.05, (0.35, 0.03)
# m: with legs of 0.4 m, a foot can only land further from its foothold if the robot has blown up.
_REACH = 1.0


def lead(speed: Array, frequency: Array) -> Array:
    """How far ahead of their rest positions feet touch down, in m: half of the trunk's travel in a
    stance (Raibert), at ``speed`` in m/s and ``frequency`` in Hz."""
    return 0.5 * DURATION * speed / frequency


def speed_up(speed: Array, commanded: Array | float, time: Array | float) -> tuple[Array, Array]:
    """Distance in m that a trunk covers in ``time`` s, and its speed in m/s after that.

    The speed rises exponentially from ``speed`` to 0.95 of the ``commanded`` one; it never falls.
    """
    top = np.maximum(speed, _REACHED * commanded)
    left = np.exp(-time / _RISE)
    return top * time - (top - speed) * _RISE * (1.0 - left), top - (top - speed) * left


@dataclass
class Landing:
    """How far a low policy's feet land from Raibert's footholds in pronk, in m.

    Attributes:
        front: how far the front feet land ahead of their footholds.
        spread: how much further behind the front feet than commanded the rear feet land.
    """

    #: Zero until a landing has been seen.
    front: float = 0.0
    spread: float = 0.0

    def learn(
        self, loco: Locomotion, rows: NDArray[np.integer], before: Array, rate: float
    ) -> None:
        """Update the estimate from those of the robots ``rows`` (n,) that have just landed.

        Args:
            loco: robots that leap along x.
            rows: robots to be looked at. Landings in a gait's first cycle do not count: some robots
                only stand there.
            before: (n,) their clocks a control step ago.
            rate: weight of one landing in the estimate.
        """
        state = loco.world.state
        clock = loco.clock.clock[rows]
        middle = 0.2  # of a cycle: the middle of the shortest stance, 0.4, when all feet are down
        landed = (before < middle) & (clock >= middle) & (loco.clock.cycles[rows] >= 1.0)
        seen = rows[landed]
        if seen.size:
            feet = state.foot_position[seen, :, 0]
            command, speed = loco.executed()[seen], state.lin_vel[seen, 0]
            frequency, length = command[:, STRIDE_COMMANDS].T
            trunk = state.position[seen, 0] - clock[landed] / frequency * speed
            front, rear = feet[:, :2].mean(axis=1), feet[:, 2:].mean(axis=1)
            foothold = trunk + 0.5 * length + lead(speed, frequency)
            missed = np.stack([front - foothold, front - rear - length])
            missed = missed[:, (np.abs(missed) < _REACH).all(axis=0)]  # false for NaN, too
            if missed.size:
                weight = 1.0 - (1.0 - rate) ** missed.shape[1]
                mean = missed.mean(axis=1).tolist()
                self.front += weight * (mean[0] - self.front)
                self.spread += weight * (mean[1] - self.spread)


def foothold_risk(x: NDArray[np.floating], trenches: Array, clear: float = CLEAR) -> Array:
    """Price of a foot at ``x`` (...,) m, given the x of the lips of trenches, (k, 2) m.

    It is ``_FALL`` inside a trench; outside it falls from 1 at the lip to 0 at ``clear`` m from it.
    """
    if not len(trenches):
        return np.zeros_like(x)
    inside = np.minimum(x[..., None] - trenches[:, 0], trenches[:, 1] - x[..., None]).max(axis=-1)
    near = np.clip(1.0 + inside / clear, 0.0, 1.0) ** 2
    return np.where(inside > 0.0, _FALL, near)


def leaping(clock: PhaseClock) -> NDArray[np.bool_]:
    """Robots whose gait, as carried out, is that of leaps, (M,)."""
    return (clock.embedding == _PRONK).all(axis=1)


class Motion(NamedTuple):
    """State of n robots that leap, (n,) each.

    Attributes:
        x: m, position of the trunk on the axis that the lips of the trenches are given on.
        speed, commanded: m/s, forward speed and its command.
        clock: gait clock, 0 when the feet touch down.
        cycles: of the clock since the leap began, 0 before it.
        frequency, length: step frequency in Hz and stance length in m, as last commanded.
    """

    x: Array
    speed: Array
    commanded: Array
    clock: Array
    cycles: Array
    frequency: Array
    length: Array

    @classmethod
    def of(
        cls, loco: Locomotion, rows: NDArray[np.integer], x: Array, speed: Array, commanded: Array
    ) -> "Motion":
        """The motion of the robots ``rows`` (n,), with their own clocks and strides."""
        frequency, length = loco.command[rows][:, STRIDE_COMMANDS].T
        clock = loco.clock
        cycles = np.where(leaping(clock)[rows], clock.cycles[rows], 0.0)
        return cls(x, speed, commanded, clock.clock[rows], cycles, frequency, length)


class Lesson(NamedTuple):
    """How n robots should make their next stride, for a student to imitate.

    Among choices that are about equally good, the best one jumps for no reason that a student could
    observe, so ``frequency`` and ``length`` are means over such choices. But a student that is
    unsure between two ways of crossing a trench and takes their mean steps into the trench, so it
    also gets the prices.

    Attributes:
        frequency, length: (n,) step frequency in Hz and stance length in m.
        price: (n, FREQUENCIES, LENGTHS) how much more each choice costs than the best one; 0 for
            robots whose stride can no longer be changed.
    """

    frequency: Array
    length: Array
    price: Array


class LeapPlan:
    """Costs of landings for M robots, each of which leaps over trenches of its own.

    Args:
        num_robots: M.
        ranges: command ranges of the leaps.
        robot: whose first steps in a gait may be faster than commanded.
        clear: m from a lip, beyond which a foot is safe.
        speed: m/s, commanded.
    """

    def __init__(
        self,
        num_robots: int,
        ranges: CommandRanges,
        robot: RobotConfig,
        clear: float = CLEAR,
        speed: float = SPEED,
    ) -> None:
        low, high = ranges.stance_length
        self._clear, self._robot = clear, robot
        self._speed = min(speed, ranges.vx[1])
        self._lengths = np.linspace(low, high, LENGTHS)
        self._frequencies = np.linspace(*ranges.frequency, FREQUENCIES)
        self._x = _STEP * np.arange(1 + round(TILE_SIZE / _STEP))
        # Cost of landing with the front feet at each position and with each stance length, and of
        # all later strides.
        self._cost = np.zeros((num_robots, len(self._x), len(self._lengths)))

    def look(self, robot: int, trenches: ArrayLike, spread: float) -> None:
        """Plan for one robot; ``trenches`` (k, 2) m are the x of their lips in its tile's frame."""
        lips = np.asarray(trenches, dtype=np.float64).reshape(-1, 2)
        x, n = self._x, len(self._x)
        price = foothold_risk(x[:, None] - self._lengths - spread, lips, self._clear)
        price += _LENGTH_PRICE * (self._lengths + spread - STRIDE) ** 2
        price += foothold_risk(x, lips, self._clear)[:, None]
        value = np.zeros(n + _STRIDES[-1])
        after = np.concatenate([price.min(axis=1), np.zeros(_STRIDES[-1])])
        dear = _STRIDE_PRICE * (_STEP * _STRIDES - STRIDE) ** 2
        end = lips[-1, 1] + STRIDE if len(lips) else 0.0  # behind it no plan is needed
        for k in range(min(n, round(end / _STEP)) - 1, -1, -1):
            ahead = k + _STRIDES
            value[k] = np.min(dear + after[ahead] + value[ahead])
        self._cost[robot] = price + value[:n, None]

    def steps(
        self, rows: NDArray[np.integer], motion: Motion, landing: Landing
    ) -> tuple[Array, Array]:
        """Step frequency in Hz and stance length in m for the next landing, (n,) each.

        Args:
            rows: (n,) indices of the robots.
            motion: their state.
            landing: that of the low policy.
        """
        frequency, length = self._best(self._costs(rows, motion, landing))
        return self._held(motion, self._frequencies[frequency], self._lengths[length])

    def lesson(self, rows: NDArray[np.integer], motion: Motion, landing: Landing) -> "Lesson":
        """Like ``steps``, but for imitation: means of good choices, and the prices of all."""
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
        """Frequencies and lengths (n,); robots past ``_DECIDED`` of their cycle keep their own."""
        late = motion.clock >= _DECIDED
        return (
            np.where(late, np.clip(motion.frequency, *self._frequencies[[0, -1]]), frequency),
            np.where(late, np.clip(motion.length, *self._lengths[[0, -1]]), length),
        )

    def _best(self, cost: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        best = cost.reshape(len(cost), -1).argmin(axis=1)
        frequency, length = np.divmod(best, len(self._lengths))
        return frequency, length

    def _touchdown(self, motion: Motion) -> tuple[Array, Array]:
        """Time in s to the next landing with each frequency, and the frequency that is carried out
        then, (n, frequencies) each; see ``Locomotion.executed``."""
        asked, to_go = self._frequencies, 1.0 - motion.clock
        start, first = self._robot.start_frequency, self._robot.start_cycles
        now, then = (
            executed_frequency(asked, cycles[:, None], start, first)
            for cycles in (motion.cycles, motion.cycles + to_go)
        )
        hurried = np.clip(first - motion.cycles, 0.0, to_go)
        # It falls in proportion to the cycles, so the mean is right to within 2 %.
        time = hurried[:, None] / (0.5 * (now + then)) + (to_go - hurried)[:, None] / asked
        return time, then

    def _costs(self, rows: NDArray[np.integer], motion: Motion, landing: Landing) -> Array:
        """Cost of each frequency with each stance length, (n, frequencies, lengths)."""
        stride = np.maximum(motion.speed, self._speed)[:, None] / self._frequencies
        left, frequency = self._touchdown(motion)
        own = np.maximum(motion.speed, 0.0)[:, None]
        way, then = speed_up(own, motion.commanded[:, None], left)
        foothold = motion.x[:, None] + way + lead(then, frequency) + landing.front
        place = np.round((foothold[:, :, None] + 0.5 * self._lengths) / _STEP).astype(int)
        place = np.clip(place, 0, len(self._x) - 1)
        cost = self._cost[rows[:, None, None], place, np.arange(len(self._lengths))]
        dear = _STRIDE_PRICE * (stride - STRIDE) ** 2
        dear += _FALL * (motion.commanded[:, None] / self._frequencies > LONGEST)
        dear += _CHANGE_PRICE * (self._frequencies - motion.frequency[:, None]) ** 2
        return cost + dear[:, :, None]


def leap_command(
    command: Array, frequency: ArrayLike, length: ArrayLike, ranges: CommandRanges
) -> None:
    """Turn commands (n, 15) into leaps, in place: gait, swing height and duty factor, as near to
    those of a leap as ``ranges`` allow, and the given frequency and stance length."""
    command[:, INDEX["swing_height"]] = np.clip(SWING_HEIGHT, *ranges.swing_height)
    command[:, INDEX["duration"]] = np.clip(DURATION, *ranges.duration)
    command[:, INDEX["frequency"]] = frequency
    command[:, INDEX["stance_length"]] = length
    command[:, 12:] = _PRONK


def steer_leap(
    command: Array, bearing: Array, heading: Array, ranges: CommandRanges, speed: float
) -> None:
    """Set the velocities of commands (n, 15) of leaps, in place.

    The robots face straight across the trenches, so that both feet of a pair land on one line, and
    move sideways as needed to reach the goal.

    Args:
        command: changed in place.
        bearing, heading: (n,) rad, of the goal and the robots, from straight across the trenches.
        ranges: bounds of the velocities.
        speed: m/s.
    """
    wanted = (
        ("vx", speed * np.cos(bearing - heading)), ("vy", speed * np.sin(bearing - heading)),
        ("yaw_rate", -HEADING_GAIN * heading),
    )  # fmt: skip
    for name, value in wanted:
        command[:, INDEX[name]] = np.clip(value, *getattr(ranges, name))


_ROBOTS = 16  # number of robots in a measurement, which repeats to a few millimetres
# s, duration of the measurement, and of speeding up within it: five times ``_RISE``.
_SECONDS, _SETTLE = 6.0, 1.5
# Share of robots that must still be up after the measurement if the policy is to count as able to
# leap.
_STANDING = 0.5
_RATE = 0.02  # weight of a landing: after 180 of them 3 % of the initial estimate is left


def measure_landing(low: "Policy", config: LowLevelConfig, speed: float) -> Landing | None:
    """Measure where ``low`` lands when it leaps on a plane, with strides of 0.32 m to ``LONGEST``.

    Args:
        low: the low policy.
        config: its configuration.
        speed: m/s, commanded.

    Returns:
        The landing; None for a policy that cannot leap, with most robots fallen.
    """
    loco = Locomotion(BulletWorld(_ROBOTS, config.robot, config.physics), config)
    rows, dt = np.arange(_ROBOTS), config.physics.control_dt
    stride = np.linspace(0.32, LONGEST, _ROBOTS)
    loco.command[:, INDEX["vx"]] = speed = min(speed, config.commands.vx[1])
    frequency = np.clip(speed / stride, *config.commands.frequency)
    length = np.clip(stride, *config.commands.stance_length)
    leap_command(loco.command, frequency, length, config.commands)
    places = np.column_stack([np.zeros(_ROBOTS), 2.0 * rows])
    loco.place(rows, places, np.zeros(_ROBOTS), np.linspace(0.0, 1.0, _ROBOTS, endpoint=False))
    landing, up, executor = Landing(), rows, Executor(loco, low)
    with closing(loco.world):
        for step in range(round(_SECONDS / dt)):
            state = loco.world.state
            loco.command[:, INDEX["yaw_rate"]] = np.clip(-state.yaw, *config.commands.yaw_rate)
            before = loco.clock.clock.copy()
            executor.step(loco.command)
            up = np.flatnonzero(state.position[:, 2] > 0.5 * config.robot.base_height)
            if step * dt > _SETTLE and up.size:
                landing.learn(loco, up, before[up], _RATE)
    return landing if up.size >= _STANDING * _ROBOTS else None
