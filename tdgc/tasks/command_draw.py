"""Commands drawn in training, and the curriculum that widens the velocity ranges of each gait."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from tdgc.config import LowLevelConfig
from tdgc.sim.commands import CONTINUOUS, INDEX, command_bounds, gait_index
from tdgc.sim.gaits import GAITS
from tdgc.sim.robot import Array
from tdgc.tasks.leaps import LONGEST

_FALLS = 256  # latest falls of a task's robots: those of a few minutes of walking
# The sums of ``statistics.by_gait`` that a gait is judged by; the first counts its samples.
_JUDGED = ("steps", "track_lin_vel", "track_yaw_rate", "match")
PRONK = GAITS.index("pronk")


class CommandDraw:
    """Draws commands; each gait starts with a share of the velocity ranges, which grows.

    Args:
        config: the MDP.
        rng: source of all random draws.
        training: start with ``command_start`` of the velocity ranges and widen them; otherwise the
            full ranges are used.

    Attributes:
        share: (4,) share of the velocity ranges that each gait uses.
        scores: (4, 4) sums for each gait since it was last judged: samples, tracking rewards of
            velocity and of yaw rate, and shares of feet in contact as desired.
        falls: (256, 13) gait and continuous commands during which robots fell, newest first; the
            gait of an empty row is -1.
    """

    def __init__(self, config: LowLevelConfig, rng: np.random.Generator, training: bool) -> None:
        self._config, self._rng, self._training = config, rng, training
        self._low, self._high = command_bounds(config.commands).T
        self.share = np.full(len(GAITS), config.command_start if training else 1.0)
        self.scores = np.zeros((len(GAITS), 4))
        self.falls = np.full((_FALLS, 1 + len(CONTINUOUS)), -1.0)

    def bounds(self, n: int) -> tuple[Array, Array, Array]:
        """Distribution of n free commands: gait probabilities, (n, 4), and lower and upper bounds
        of the continuous commands, (n, 12), before ``share`` scales the velocities."""
        gaits = np.tile(self._config.command_draw.gaits, (n, 1))
        return gaits, np.tile(self._low, (n, 1)), np.tile(self._high, (n, 1))

    def draw(
        self, gaits: Array, low: Array, high: Array, free: NDArray[np.bool_]
    ) -> tuple[NDArray[np.int64], Array, NDArray[np.bool_]]:
        """Draw gaits (n,) and continuous commands (n, 12) from such ``bounds``.

        Of the ``free`` commands (n,), some become leaps and some repeat commands during which a
        robot fell; the third result marks these repeats, (n,). In pronk the frequency is raised
        until strides are no longer than ``leaps.LONGEST``; where the highest one does not suffice,
        the speed is reduced.
        """
        n, rng, config = len(free), self._rng, self._config.command_draw
        gait = np.sum(rng.uniform(size=(n, 1)) > np.cumsum(gaits, axis=1)[:, :-1], axis=1)
        values = rng.uniform(low, high)
        leap = free & (rng.uniform(size=n) < config.leaps)
        gait[leap] = PRONK
        for name, shares in (("vx", config.leap_vx), ("frequency", config.leap_frequency)):
            j, share = INDEX[name], rng.uniform(*shares, int(leap.sum()))
            values[leap, j] = low[leap, j] + share * (high - low)[leap, j]
        values[:, :3] *= self.share[gait][:, None]
        values[rng.uniform(size=n) < config.standing, :3] = 0.0
        pronk, frequency = gait == PRONK, INDEX["frequency"]
        least = np.hypot(values[pronk, 0], values[pronk, 1]) / LONGEST
        slower = np.minimum(high[pronk, frequency] / np.maximum(least, 1e-9), 1.0)
        values[pronk, :2] *= slower[:, None]
        values[pronk, frequency] = np.maximum(values[pronk, frequency], slower * least)
        again = free & (rng.uniform(size=n) < config.retries)
        rows = self.falls[rng.integers(0, _FALLS, n)]
        again &= rows[:, 0] >= 0.0
        gait[again], values[again] = rows[again, 0].astype(np.int64), rows[again, 1:]
        return gait, values, again

    def remember(self, command: Array) -> None:
        """Store commands (n, 15) during which robots have just fallen."""
        fallen = np.column_stack([gait_index(command), command[:, : len(CONTINUOUS)]])
        self.falls = np.concatenate([fallen, self.falls])[:_FALLS]

    def judge(self, sums: Mapping[str, Array], num_robots: int) -> None:
        """Add the sums of a step of ``num_robots`` robots, as returned by ``by_gait``.

        A gait with enough samples is judged: if it was tracked well, its velocity ranges widen. Its
        sums then start again from zero.
        """
        config, weights = self._config.command_draw, self._config.rewards
        self.scores += np.stack([sums[name] for name in _JUDGED], axis=1)
        for g in np.flatnonzero(self.scores[:, 0] >= config.growth_steps * num_robots / len(GAITS)):
            samples, velocity, yaw_rate, contact = self.scores[g]
            # At least, not above: a term that is switched off must not keep all ranges narrow.
            good = velocity / samples >= config.growth_velocity * weights.track_lin_vel
            good &= yaw_rate / samples >= config.growth_yaw_rate * weights.track_yaw_rate
            good &= contact / samples > config.growth_contact
            if good and self._training:
                self.share[g] = min(1.0, self.share[g] + config.growth)
            self.scores[g] = 0.0

    def grown(self) -> Array:
        """How far the velocity ranges of each gait have grown, (4,), from 0 at the start to 1."""
        start = min(self._config.command_start, 1.0 - 1e-6)  # avoids 0 / 0 for a start at 1
        return (self.share - start) / (1.0 - start)
