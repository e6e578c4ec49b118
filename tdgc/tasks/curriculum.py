"""The curriculum over terrain levels: promotion and demotion of each environment (Sec. IV-C).

Each environment keeps the outcomes of its last W episodes. Once W are recorded, with c successes
among them and a threshold S, the paper's two rules apply::

    c >= S          ->  level = min(level + 1, L_max - 1)
    c <  W - S + 1  ->  level = max(level - 1, 0)

Levels run from 0 to L_max - 1, so ``max_level`` is the number of levels: 11 for levels 0 to 10.

The paper describes the window in two different ways. Its text has a *sliding* window that is reset
"after a level change"; its Algorithm 1 clears the window every time it is full. This module follows
the text: once the window is full, the rules are tried after every episode, and a window that leaves
the level unchanged keeps sliding. The two differ only for an environment that has held its level:
the text's version reacts within one episode, Algorithm 1 within W. At the top (or bottom) level a
further promotion (or demotion) changes nothing, so there, too, the window keeps sliding.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tdgc.state import State, copies, fill

Ints = NDArray[np.int64]


def check_rules(window: int, threshold: int) -> None:
    """Raise ``ValueError`` unless (window + 1) / 2 < threshold <= window.

    With a lower threshold, the same count could both promote and demote, or every count would do
    one of the two; with a higher one, nothing would ever promote.
    """
    if not (window + 1) / 2 < threshold <= window:
        raise ValueError(
            f"threshold must be above (window + 1) / 2 and at most window, "
            f"not {threshold} with a window of {window}"
        )


class Curriculum:
    """Levels and windows of ``n`` independent environments; ``max_level``, the number of levels, is
    at least 1.

    Attributes:
        levels: (n,), the level of each environment. ``push`` changes it; a caller with another
            curriculum may write levels in 0..max_level - 1 instead.
        outcomes: (n, window) of bool, oldest episode first; empty slots come first and are False.
        counts: (n,), how many slots are filled.
    """

    def __init__(
        self, n: int, window: int, threshold: int, max_level: int, start: ArrayLike = 0
    ) -> None:
        """Start all environments at level ``start``, one number or (n,), with empty windows.

        Raises:
            ValueError: invalid rules, see ``check_rules``, or a start outside the levels.
        """
        check_rules(window, threshold)
        self.window, self.threshold, self.max_level = window, threshold, max_level
        self.levels: Ints = np.broadcast_to(np.asarray(start, dtype=np.int64), n).copy()
        if n and not (0 <= self.levels.min() and self.levels.max() < max_level):
            raise ValueError(f"start must be in 0..{max_level - 1}, not {start!r}")
        self.outcomes: NDArray[np.bool_] = np.zeros((n, window), dtype=bool)
        self.counts: Ints = np.zeros(n, dtype=np.int64)

    def push(self, envs: Ints, successes: NDArray[np.bool_]) -> None:
        """Record one finished episode for each of the environments ``envs`` (k,), which are
        distinct, and update their levels; ``successes`` (k,).

        The order is that of Algorithm 1: push the outcome; if the window is full, count and
        update the level; if the level changed, clear the window.
        """
        self.outcomes[envs] = np.column_stack((self.outcomes[envs, 1:], successes))
        self.counts[envs] = np.minimum(self.counts[envs] + 1, self.window)
        full = envs[self.counts[envs] == self.window]
        count = self.outcomes[full].sum(axis=1)
        up, down = count >= self.threshold, count < self.window - self.threshold + 1
        level = np.clip(self.levels[full] + up - down, 0, self.max_level - 1)
        moved = full[level != self.levels[full]]
        self.levels[full] = level
        self.outcomes[moved], self.counts[moved] = False, 0

    def _arrays(self) -> dict[str, NDArray[Any]]:
        return {"levels": self.levels, "outcomes": self.outcomes, "counts": self.counts}

    def state_dict(self) -> State:
        """Copies of everything that ``push`` changes, for an exact resume."""
        return copies(self._arrays())

    def load_state_dict(self, state: State) -> None:
        """Resume from the ``state_dict`` of a curriculum with the same sizes and rules.

        Raises:
            ValueError: an array is missing or has another shape, or a level is out of range.
        """
        fill(self._arrays(), state)
        if np.any(self.levels >= self.max_level):
            raise ValueError(f"'levels' must be in 0..{self.max_level - 1}")
