"""Leaps over trenches: pronk, its steps timed so that the feet land at either side.

With a stride of about the stance length front and rear feet land on the same lines, and a trench
fits between two of them. Where the feet of a low level land against its trunk is its own, to a few
centimetres, and decides how wide a trench it can cross; so it is measured.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from tdgc.config import LowLevelConfig
from tdgc.sim.commands import INDEX
from tdgc.sim.gaits import GAITS, gait_embedding
from tdgc.sim.locomotion import Locomotion
from tdgc.sim.robot import Array
from tdgc.sim.terrain import START_X, TRENCH_SPACING, trench_centres

if TYPE_CHECKING:  # the low level's workers do without PyTorch
    from tdgc.policies import Policy

#: m/s, what leaps are timed for while the robot is slower. At the 2 Hz of a start from rest they
#: threw every robot down.
LEAP_START = 1.0
_TIMING_GAIN = 1.5  # share of the frequency for each cycle that the feet are out of time

#: How the teacher leaps: m/s, and m between landings, of the swing and between front and rear feet.
#: Of 24 robots on level 10, whose trenches are 30 cm wide at the top, all cross; with strides of
#: 0.37 m two thirds do, with 0.36 m hardly any, with 0.40 m they trip at the start, and with feet
#: at 5 cm a quarter fall in (docs/experiments.md).
SPEED, STRIDE, SWING_HEIGHT, STANCE_LENGTH = 1.0, 0.39, 0.07, 0.36


@dataclass(frozen=True)
class Landing:
    """Where a low level lands in pronk, in m.

    Attributes:
        front: its front feet, ahead of the trunk as it is at clock 0.
        spread: its rear feet, so much further behind the front ones than commanded, since they
            touch down sooner.
    """

    front: float
    spread: float


_ROBOTS = 8  # that a landing is measured with: a few millimetres between two such measurements
_SLOWEST = 0.7  # share of the commanded speed at which they still get past all trenches

#: Of the low level of 22.7 million steps, for which later ones were trained to leap.
LANDING = Landing(0.20, 0.055)


def straddling_frequency(
    x: Array,
    speed: Array,
    clock: Array,
    stride: Array,
    length: Array,
    centres: Array,
    landing: Landing = LANDING,
) -> Array:
    """Step frequency in Hz at which pronk lands at either side of the trenches, (M,).

    Args:
        x: (M,) m, trunk along the tile.
        speed: (M,) m/s, forward.
        clock: (M,) the gait's, 0 where the feet touch down.
        stride, length: (M,) m, from one landing to the next, and between front and rear feet.
        centres: (M, n) m along the tile, of the trenches.
        landing: the low level's.

    Feed-forward keeps the stride; to it comes what brings the lines on which front and rear feet
    land half a stride before the centre of the nearest trench. Slower than ``LEAP_START``, a robot
    is timed for that.
    """
    front, rear = landing.front, landing.front - length - landing.spread + stride  # its next line
    line = x + 0.5 * (front + rear)
    nearest = np.abs(line[:, None] - centres).argmin(axis=1)
    trench = centres[np.arange(len(x)), nearest]
    late = np.mod((line - trench) / stride - clock, 1.0) - 0.5  # 0.5 turns -0.5 strides to 0
    timed_for = np.maximum(speed, LEAP_START)
    return np.asarray(timed_for / stride * (1.0 + _TIMING_GAIN * late))


def measure_landing(
    low: Policy, config: LowLevelConfig, decimation: int, assumed: Landing = LANDING
) -> Landing:
    """Where ``low`` lands when it leaps as the teacher has it, over trenches that are not there.

    Timed for the ``assumed`` landing, robots leap from rest along a plane. What they are off at
    each trench, in the mean, is due to the landing and to speeds that are not quite as commanded:
    at the first one they are still slow. With the landing returned, the largest of these errors is
    as small as it can be.

    Args:
        low: the low level, of ``config``.
        decimation: control steps a decision.
        assumed: hardly matters for what is found.

    Returns:
        The landing; ``assumed`` where no robot gets to a trench: such a low level cannot leap.
    """
    loco = Locomotion(_ROBOTS, config.robot, config.physics, None, config.gyro)
    rows, steps_per_s = np.arange(_ROBOTS), 1.0 / config.physics.control_dt
    centres = np.tile(trench_centres(0.5), (_ROBOTS, 1))
    loco.command[:, INDEX["vx"]] = SPEED
    loco.command[:, INDEX["swing_height"]] = SWING_HEIGHT
    loco.command[:, INDEX["stance_length"]] = STANCE_LENGTH
    loco.command[:, 12:] = gait_embedding(GAITS.index("pronk"))
    places = np.column_stack([np.full(_ROBOTS, START_X), 2.0 * rows])
    loco.place(rows, places, np.zeros(_ROBOTS), np.linspace(0.0, 1.0, _ROBOTS, endpoint=False))
    stride, length = np.full(_ROBOTS, STRIDE), np.full(_ROBOTS, STANCE_LENGTH)
    errors: list[list[float]] = [[] for _ in centres[0]]
    spreads: list[float] = []
    last_front = np.full(_ROBOTS, np.inf)
    middle = 0.5 * config.commands.duration[0]  # of the shortest stance: all feet are down
    distance = centres[0, -1] + TRENCH_SPACING - START_X
    try:
        for step in range(round(distance / (_SLOWEST * SPEED) * steps_per_s)):
            state = loco.world.state
            if step % decimation == 0:
                x, speed, clock = state.position[:, 0], state.heading_vel[:, 0], loco.clock.clock
                timed = straddling_frequency(x, speed, clock, stride, length, centres, assumed)
                j = INDEX["frequency"]
                loco.command[:, j] = np.clip(timed, *config.commands.frequency)
                loco.command[:, INDEX["yaw_rate"]] = np.clip(-state.yaw, *config.commands.yaw_rate)
            before = loco.clock.clock.copy()
            loco.act(low.predict(loco.observe())[0])
            feet = state.foot_position[..., 0]
            up = state.position[:, 2] > 0.5 * config.robot.base_height
            if not (up & (state.position[:, 0] < START_X + distance)).any():
                break  # fallen or there, all of them
            for i in np.flatnonzero(up & (before < middle) & (loco.clock.clock >= middle)):
                front, rear = feet[i, :2].mean(), feet[i, 2:].mean()
                # Front feet of the last landing and rear ones of this are to be on one line.
                off = 0.5 * (last_front[i] + rear) - (centres[i] - 0.5 * STRIDE)
                k = int(np.abs(off).argmin())
                if abs(off[k]) < 0.5 * STRIDE:
                    errors[k].append(off[k])
                    spreads.append(front - rear - STANCE_LENGTH)
                last_front[i] = front
    finally:
        loco.world.close()
    means = [np.mean(some) for some in errors if some]
    if not means:
        return assumed
    ahead = assumed.front - 0.5 * assumed.spread + 0.5 * (min(means) + max(means))
    spread = float(np.mean(spreads))
    return Landing(float(ahead + 0.5 * spread), spread)
