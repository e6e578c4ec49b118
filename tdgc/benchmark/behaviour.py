"""How robots walk: gaits, heading, speed, feet and posture in an episode, from its trace."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tdgc.benchmark.evaluation import EpisodeRecord
from tdgc.benchmark.trace import Trace
from tdgc.sim.gaits import GAITS
from tdgc.sim.robot import Array, wrap_angle

_MOVING = 0.1  # m/s, below which the direction of travel is undefined (v_th of the high rewards)
_COMMANDED = ("frequency", "swing_height", "stance_width")
#: Means over an episode, the columns of behaviour.csv behind those that identify it: shares of the
#: time in each gait; of the time in motion, more than 45 degrees away from the heading to a side,
#: and more than 135; m/s over the ground; commanded, Hz, m, m; height of the trunk above the
#: support surface, m; pitch, nose down positive, and the magnitude of roll, rad.
MEANS = (*GAITS, "sideways", "backward", "speed", *_COMMANDED, "height", "pitch", "roll")


@dataclass(frozen=True)
class Behaviour(EpisodeRecord):
    """An episode's row of behaviour.csv.

    Attributes:
        means: ``MEANS`` by name.
    """

    means: dict[str, float]

    def row(self) -> dict[str, Any]:
        """The row of behaviour.csv."""
        return self.identity | {name: f"{self.means[name]:.4f}" for name in MEANS}


def heading_to_travel(x: Array, y: Array, yaw: Array, seconds: Array | float) -> Array:
    """Heading relative to the direction of travel between n successive poses, (n - 1,) rad.

    At 0 the robot moves forwards, at pi backwards, at pi/2 to its right: the nose points to the
    left of the direction of travel. NaN while it hardly moves.

    Args:
        x, y: (n,) m.
        yaw: (n,) rad.
        seconds: s between poses, (n - 1,) or a scalar.
    """
    dx, dy = np.diff(x), np.diff(y)
    heading = yaw[:-1] + 0.5 * wrap_angle(np.diff(yaw))
    moving = np.hypot(dx, dy) > _MOVING * seconds
    return np.where(moving, wrap_angle(heading - np.arctan2(dy, dx)), np.nan)


def behaviour(trace: Trace) -> Behaviour:
    """Summarise how the robot walked in the episode of ``trace``, which was on a tile."""
    seconds = trace["seconds"][1:].astype(np.float64)
    x, y, yaw = (trace[name].astype(np.float64) for name in ("base_x", "base_y", "yaw"))
    covered = np.hypot(np.diff(x), np.diff(y))
    off = np.abs(heading_to_travel(x, y, yaw, seconds))
    moving, aside, behind = np.isfinite(off), off > np.pi / 4, off > 3 * np.pi / 4

    def mean(values: NDArray[np.floating] | NDArray[np.bool_]) -> float:
        return float(np.average(values, weights=seconds))

    def in_motion(flags: NDArray[np.bool_]) -> float:
        return float(seconds[flags].sum() / max(seconds[moving].sum(), 1e-9))

    means = {gait: mean(trace["gait"][:-1] == gait) for gait in GAITS}
    means |= {"sideways": in_motion(aside & ~behind), "backward": in_motion(behind)}
    means |= {"speed": float(covered.sum() / seconds.sum())}
    means |= {name: mean(trace[f"command_{name}"][:-1]) for name in _COMMANDED}
    means |= {"height": mean(trace["base_height"][:-1]), "pitch": mean(trace["pitch"][:-1])}
    means |= {"roll": mean(np.abs(trace["roll"][:-1]))}
    return Behaviour(**trace.identity, means=means)


def describe(rows: Sequence[Behaviour]) -> str:
    """Format the means over the episodes of each policy, condition, family and level."""
    lines: list[str] = []
    for policy, condition in dict.fromkeys((row.policy, row.condition) for row in rows):
        mine = [row for row in rows if (row.policy, row.condition) == (policy, condition)]
        wide = max(8, *(len(row.family) + 1 for row in mine))
        shares = (*GAITS, "sideways", "backward")
        lines.append(f"how {policy} walks, {condition}")
        lines.append(
            f"{'family'.ljust(wide)}level{''.join(f'{name:>10}' for name in shares)}"
            "     speed    steps   swing  stance  height  pitch   roll"
        )
        for family, level in dict.fromkeys((row.family, row.level) for row in mine):
            cell = [row.means for row in mine if (row.family, row.level) == (family, level)]
            m = {name: float(np.mean([means[name] for means in cell])) for name in MEANS}
            lines.append(
                f"{family.ljust(wide)}{level:>5}"
                f"{''.join(f'{100.0 * m[name]:>9.0f}%' for name in shares)}"
                f"{m['speed']:>6.2f} m/s{m['frequency']:>6.1f} Hz{m['swing_height']:>6.2f} m"
                f"{m['stance_width']:>6.2f} m{m['height']:>6.2f} m{m['pitch']:>7.2f}"
                f"{m['roll']:>7.2f}"
            )
    return "\n".join(lines)
