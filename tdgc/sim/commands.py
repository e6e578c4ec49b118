"""The 15 commands, and the decoder D that maps 13 actions to them (paper Sec. IV-B)."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tdgc.config import CommandRanges
from tdgc.sim.gaits import GAITS, gait_embedding

#: Unit and meaning of each command, in order. ``power_weight`` is the auxiliary, and the last three
#: are the gait embedding e(g), see ``tdgc.sim.gaits``.
COMMANDS: dict[str, tuple[str, str]] = {
    "vx": ("m/s", "velocity ahead, in the frame that turns by yaw alone"),
    "vy": ("m/s", "velocity to the left, in the same frame"),
    "yaw_rate": ("rad/s", "positive turns left"),
    "body_height": ("m", "added to the standing height"),
    "frequency": ("Hz", "gait cycles per second"),
    "duration": ("1", "duty factor: share of the cycle that a foot spends in stance"),
    "swing_height": ("m", "apex of a swing foot above the ground"),
    "pitch": ("rad", "positive is nose down"),
    "roll": ("rad", "positive is left side up"),
    "stance_width": ("m", "between left and right footholds; 0.25 is the robot's own stance"),
    "stance_length": ("m", "between front and rear footholds; 0.38 is the robot's own stance"),
    "power_weight": ("1/W", "price of mechanical power in training"),
    "phase": ("1", "share of a cycle between diagonal pairs of feet: 0.5 in trot"),
    "offset": ("1", "share of a cycle between front and rear pair: 0.5 in the gait bound"),
    "bound": ("1", "share of a cycle between left and right pair: 0.5 in pace"),
}
CONTINUOUS = tuple(f.name for f in dataclasses.fields(CommandRanges))
NAMES = tuple(COMMANDS)
UNITS = tuple(unit for unit, _ in COMMANDS.values())
NUM_ACTIONS = len(CONTINUOUS) + 1  # 12 continuous ones and the gait channel
NUM_COMMANDS = len(NAMES)
VELOCITIES = ("vx", "vy", "yaw_rate")  # the first three
#: Position of each command in the vector, by name.
INDEX = {name: i for i, name in enumerate(NAMES)}
#: Commands that change sign in a left-right mirror.
SIDEWAYS = ("vy", "yaw_rate", "roll")


def default_command() -> NDArray[np.float64]:
    """Command to stand still in trot with moderate behaviour parameters, (15,).

    The swing height of 0.08 m and the frequency of 3 Hz are the defaults of Walk These Ways; the
    footholds are under the hips.
    """
    command = np.zeros(NUM_COMMANDS)
    command[INDEX["frequency"]] = 3.0
    command[INDEX["duration"]] = 0.5
    command[INDEX["swing_height"]] = 0.08
    command[INDEX["stance_width"]] = 0.25
    command[INDEX["stance_length"]] = 0.38
    command[12:] = gait_embedding(0)
    return command


#: Unit in which the networks see a command's distance from its default, chosen so that inputs stay
#: within about [-1, 1], swing height up to 1.6; for most commands it is about half the range. The
#: embedding has a default of 0 here, so its entries become 0 or 1.
_OBSERVATION_UNIT: NDArray[np.float64] = np.array(
    [1.0, 0.5, 1.0, 0.1, 1.0, 0.1, 0.1, 0.3, 0.2, 0.1, 0.05, 0.002, 0.5, 0.5, 0.5]
)
_OBSERVATION_ZERO: NDArray[np.float64] = np.concatenate([default_command()[:12], np.zeros(3)])


def observed_command(command: NDArray[np.floating]) -> NDArray[np.float64]:
    """Normalise commands (..., 15) as the low policy's network sees them."""
    return (command - _OBSERVATION_ZERO) / _OBSERVATION_UNIT


def command_bounds(ranges: CommandRanges) -> NDArray[np.float64]:
    """Lower and upper bound of each continuous command, (12, 2)."""
    return np.array(dataclasses.astuple(ranges), dtype=np.float64)


class CommandDecoder:
    """The decoder D from 13 actions to 15 commands, affine with explicit bounds (paper Sec. IV-B).

    Attributes:
        names: the 15 command names.
        low, high: (15,) bounds l_j and u_j; those of the embedding are 0 and 0.5.
        units: the 15 units.
        action_limit: a_max, to which raw actions are clipped.
        gaits: indices of the gaits that the last action chooses from; all four by default.
    """

    names = NAMES
    units = UNITS

    def __init__(
        self,
        ranges: CommandRanges | None = None,
        action_limit: float = 1.0,
        gaits: Sequence[str] = GAITS,
    ) -> None:
        if not action_limit > 0.0:
            raise ValueError(f"action_limit must be positive, not {action_limit}")
        if not gaits or len(set(gaits)) < len(gaits) or not set(gaits) <= set(GAITS):
            raise ValueError(
                f"gaits must be some of {', '.join(GAITS)}, each once, not {list(gaits)}"
            )
        bounds = command_bounds(ranges or CommandRanges())
        self.low = np.concatenate([bounds[:, 0], np.zeros(3)])
        self.high = np.concatenate([bounds[:, 1], np.full(3, 0.5)])
        self.action_limit = action_limit
        self.gaits = np.array([GAITS.index(name) for name in gaits])

    def normalise(self, action: ArrayLike) -> NDArray[np.float64]:
        """x = clip(a, -a_max, a_max) / a_max.

        Raises:
            ValueError: a last axis other than 13, or a value that is not finite.
        """
        raw = np.asarray(action, dtype=np.float64)
        if raw.shape[-1:] != (NUM_ACTIONS,):
            raise ValueError(f"an action has {NUM_ACTIONS} values, not shape {raw.shape}")
        if not np.isfinite(raw).all():
            raise ValueError("an action must be finite; it has NaN or infinite values")
        return np.clip(raw, -self.action_limit, self.action_limit) / self.action_limit

    def gait(self, action: ArrayLike) -> NDArray[np.int64]:
        """g = clip(floor(2 (x_g + 1)), 0, 3): (..., 13) -> (...).

        With n gaits, n / 2 replaces 2, n - 1 replaces 3, and the result indexes ``gaits``.
        """
        x = self.normalise(action)[..., -1]
        n = len(self.gaits)
        place = np.clip(np.floor(0.5 * n * (x + 1.0)), 0, n - 1).astype(np.int64)
        return np.asarray(self.gaits[place])

    def decode(self, action: ArrayLike) -> NDArray[np.float64]:
        """c = [l + (x + 1) / 2 (u - l), e(g)]: (..., 13) -> (..., 15).

        Raises:
            ValueError: a last axis other than 13, or a value that is not finite.
        """
        x = self.normalise(action)[..., :-1]
        low, high = self.low[:12], self.high[:12]
        continuous = low + 0.5 * (x + 1.0) * (high - low)
        return np.concatenate([continuous, gait_embedding(self.gait(action))], axis=-1)

    def encode(self, command: ArrayLike) -> NDArray[np.float64]:
        """The midpoint of all actions that decode to ``command``: (..., 15) -> (..., 13).

        Raises:
            ValueError: a command outside its bounds, which the message names, or a gait that is not
                one of ``gaits``.
        """
        c = np.asarray(command, dtype=np.float64)
        for j, name in enumerate(CONTINUOUS):
            inside = (self.low[j] <= c[..., j]) & (c[..., j] <= self.high[j])
            if not inside.all():
                worst = c[..., j][~inside].flat[0]
                raise ValueError(f"{name} {worst} is outside [{self.low[j]}, {self.high[j]}]")
        is_gait = gait_index(c)[..., None] == self.gaits
        if not is_gait.any(axis=-1).all():
            names = ", ".join(GAITS[g] for g in self.gaits)
            gait = GAITS[gait_index(c)[~is_gait.any(axis=-1)].flat[0]]
            raise ValueError(f"gait {gait} is none of {names}")
        low, high = self.low[:12], self.high[:12]
        free = high > low
        x = np.where(free, 2.0 * (c[..., :12] - low) / np.where(free, high - low, 1.0) - 1.0, 0.0)
        place = is_gait.argmax(axis=-1)[..., None]
        gait = (place + 0.5) / (0.5 * len(self.gaits)) - 1.0
        return self.action_limit * np.concatenate([x, gait], axis=-1)

    def nearest(self, command: ArrayLike) -> NDArray[np.float64]:
        """The nearest command within the bounds: (..., 15) -> (..., 15).

        A gait that is not one of ``gaits`` becomes the first of them.
        """
        c = np.clip(np.asarray(command, dtype=np.float64), self.low, self.high)
        gait = gait_index(c)
        known = np.isin(gait, self.gaits)
        c[..., 12:] = gait_embedding(np.where(known, gait, self.gaits[0]))
        return c


def gait_index(commands: NDArray[np.floating]) -> NDArray[np.int64]:
    """Gait index of commands (..., 15) -> (...), the inverse of ``gait_embedding``."""
    phase, offset, bound = (commands[..., i] > 0.25 for i in (12, 13, 14))
    return np.where(phase, 0, np.where(bound, 2, np.where(offset, 3, 1))).astype(np.int64)
