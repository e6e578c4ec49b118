"""Success rates and paired differences on the same tiles, with their 95 % intervals."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

#: 95 % of a normal distribution lies within this many standard deviations of the mean.
Z_95 = 1.959964


def wilson_interval(reached: int, n: int, z: float = Z_95) -> tuple[float, float]:
    """Wilson score interval of a rate, 95 % by default (Wilson 1927).

    Raises:
        ValueError: ``reached`` or ``n`` is out of range.
    """
    if not 0 <= reached <= n or n < 1:
        raise ValueError(f"need 0 <= reached <= n and n >= 1, not {reached} of {n}")
    rate = reached / n
    centre = (rate + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * np.sqrt(rate * (1 - rate) / n + z * z / (4 * n * n))
    return max(0.0, float(centre - half)), min(1.0, float(centre + half))


def paired_interval(
    both: int, first: int, second: int, neither: int, z: float = Z_95
) -> tuple[float, float]:
    """Interval of the difference between two rates on the same tiles, the first minus the second.

    95 % by default: method 10 of Newcombe (1998, Statistics in Medicine 17, 2635-2650), which
    combines the Wilson intervals of both rates by their correlation.

    Args:
        both, first, second, neither: number of tiles on which both succeeded, only the first, only
            the second, or neither.
        z: quantile of the normal distribution.
    """
    n = both + first + second + neither
    one, other = (both + first) / n, (both + second) / n
    one_low, one_high = wilson_interval(both + first, n, z)
    other_low, other_high = wilson_interval(both + second, n, z)
    together = float(both * neither - first * second)
    if together > 0:  # Newcombe's continuity correction
        together = max(together - n / 2, 0.0)
    spread = (both + first) * (second + neither) * (both + second) * (first + neither)
    correlation = together / spread**0.5 if spread else 0.0

    def half(a: float, b: float) -> float:
        return max(a * a - 2.0 * correlation * a * b + b * b, 0.0) ** 0.5

    return (
        one - other - half(one - one_low, other_high - other),
        one - other + half(one_high - one, other - other_low),
    )


def rates(reached: ArrayLike) -> dict[str, float]:
    """Success rate of episodes, with its interval.

    Args:
        reached: whether each episode reached the goal, (n,), or (seeds, n) on the same n tiles.

    Returns:
        The number of episodes ``n``, the successes ``reached``, the ``rate``, and its interval
        ``ci_low``, ``ci_high``.
    """
    every = np.atleast_2d(np.asarray(reached, dtype=bool))
    n, good = every.size, int(every.sum())
    low, high = wilson_interval(good, n, Z_95 * design_factor(every))
    return {"n": n, "reached": good, "rate": good / n, "ci_low": low, "ci_high": high}


def difference(pairs: ArrayLike) -> dict[str, float]:
    """Difference between the success rates of two policies on the same tiles, with its interval.

    Args:
        pairs: whether the first and the second policy reached the goal of each tile, (n, 2), or
            (seeds, n, 2).

    Returns:
        The number of pairs ``n``, the goals ``gained`` (only the first policy reached it) and
        ``lost`` (only the second), the ``difference``, and its interval ``ci_low``, ``ci_high``.
    """
    both_sides = np.asarray(pairs, dtype=bool)
    one, other = np.atleast_2d(both_sides[..., 0]), np.atleast_2d(both_sides[..., 1])
    both, gained, lost, neither = (
        int(found.sum()) for found in (one & other, one & ~other, ~one & other, ~one & ~other)
    )
    z = Z_95 * design_factor(one.astype(float) - other)
    low, high = paired_interval(both, gained, lost, neither, z)
    return {
        "n": one.size,
        "gained": gained,
        "lost": lost,
        "difference": (gained - lost) / one.size,
        "ci_low": low,
        "ci_high": high,
    }


def design_factor(values: NDArray[Any]) -> float:
    """Factor by which the interval of a mean over ``values`` (seeds, n) is wider than it would be
    if each value came from its own tile.

    This is the square root of the design effect of cluster sampling; a cluster is the seeds on one
    tile. It is 1 with one seed or if the tile has no influence, and the root of the number of seeds
    if all of them always agree.
    """
    spread = values.var()
    share = values.mean(axis=0).var() / spread if spread > 0.0 else 1.0  # explained by the tiles
    return max(1.0, float(np.sqrt(len(values) * share)))
