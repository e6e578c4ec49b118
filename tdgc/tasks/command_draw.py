"""Commands drawn in training, and the curriculum that widens the velocity ranges of each gait."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from tdgc.config import LowLevelConfig
from tdgc.sim.commands import CONTINUOUS, INDEX, gait_index
from tdgc.sim.gaits import GAITS
from tdgc.sim.robot import Array
from tdgc.tasks.leaps import LONGEST

_FALLS = 256  # of a task's robots, the last ones: a few minutes of walking
# Of ``low_statistics.by_gait``, what a gait is judged by: samples, and sums over them.
_JUDGED = ("steps", "track_lin_vel", "track_yaw_rate", "match")
PRONK = GAITS.index("pronk")


class CommandDraw:
    """Draws commands; a gait begins with a share of the velocity ranges, which grows.

    Args:
        config: the MDP.
        rng: what is drawn from.
        training: begin with ``command_start`` of the velocity ranges, and let them grow; otherwise
            they are whole.

    Attributes:
        share: (4,) share of the velocity ranges that each gait uses.
        scores: (4, 4) sums for each gait since it was last judged: samples, what tracking of
            velocity and of yaw rate earned, and shares of feet in contact as desired.
        falls: (256, 13) gait and continuous commands that robots fell at, the last one first; gait
            -1 where there were none yet.
    """

    def __init__(self, config: LowLevelConfig, rng: np.random.Generator, training: bool) -> None:
        self._config, self._rng, self._training = config, rng, training
        bounds = [getattr(config.commands, name) for name in CONTINUOUS]
        self._low, self._high = np.array(bounds).T
        self.share = np.full(len(GAITS), config.command_start if training else 1.0)
        self.scores = np.zeros((len(GAITS), 4))
        self.falls = np.full((_FALLS, 1 + len(CONTINUOUS)), -1.0)

    def bounds(self, n: int) -> tuple[Array, Array, Array]:
        """What n free commands are drawn from: probabilities of the gaits, (n, 4), and lower and
        upper bounds of the continuous commands, (n, 12), of the velocities before they grow."""
        gaits, low, high = (
            np.tile(each, (n, 1))
            for each in (self._config.command_draw.gaits, self._low, self._high)
        )
        return gaits, low, high

    def draw(
        self, gaits: Array, low: Array, high: Array, free: NDArray[np.bool_]
    ) -> tuple[NDArray[np.int64], Array, NDArray[np.bool_]]:
        """Gaits (n,) and continuous commands (n, 12) from such ``bounds``, and which of them (n,)
        are tried again; of the ``free`` ones (n,) some leap, and some are what robots fell at. In
        pronk the steps are at least as quick as ``leaps.LONGEST`` asks for, and the speed is what
        the quickest of them allow."""
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
        """Commands (n, 15) that robots have just fallen at."""
        fallen = np.column_stack([gait_index(command), command[:, : len(CONTINUOUS)]])
        self.falls = np.concatenate([fallen, self.falls])[:_FALLS]

    def judge(self, sums: Mapping[str, Array], num_robots: int) -> None:
        """Add the sums of a step of M robots, as ``by_gait`` has them; widen the velocity ranges of
        a gait that was tracked well over enough of them, and judge it from the next step on."""
        config, weights = self._config.command_draw, self._config.rewards
        self.scores += np.stack([sums[name] for name in _JUDGED], axis=1)
        for g in np.flatnonzero(self.scores[:, 0] >= config.growth_steps * num_robots / len(GAITS)):
            samples, velocity, yaw_rate, contact = self.scores[g]
            good = velocity / samples > config.growth_velocity * weights.track_lin_vel
            good &= yaw_rate / samples > config.growth_yaw_rate * weights.track_yaw_rate
            good &= contact / samples > config.growth_contact
            if good and self._training:
                self.share[g] = min(1.0, self.share[g] + config.growth)
            self.scores[g] = 0.0

    def grown(self) -> Array:
        """How far the velocity ranges of each gait have grown, (4,), from 0 at the start to 1."""
        start = min(self._config.command_start, 1.0 - 1e-6)  # ranges whole from the start
        return (self.share - start) / (1.0 - start)
