"""Ways around obstacles on a grid: the cost of each place, and the least cost to go from there."""

import numpy as np

from tdgc.sim.robot import Array

#: m ahead, at which a robot compares costs in different directions: further than ``RADIUS``, so
#: that it sees the way out from where it is blocked.
LOOK = 0.35
#: m from an obstacle within which the way is blocked: half the trunk's diagonal and a little.
#: Pillars leave at least 0.6 m between them.
RADIUS = 0.28
# Cost per metre inside the radius and at its edge; 1 in the open. The way straight across an
# obstacle, at least 0.56 m, then costs more than 16 m in the open, two lengths of a tile.
# The second was chosen by hand.
_BLOCKED, _CLOSE = 30.0, 3.0
_AROUND = [(a, b) for a in (-1, 0, 1) for b in (-1, 0, 1) if (a, b) != (0, 0)]


def price_near(away: Array, wide: float) -> Array:
    """Cost per metre at ``away`` (...) m from an obstacle, which counts up to ``wide`` m."""
    near = np.clip((wide - away) / (wide - RADIUS), 0.0, 1.0)
    return np.where(away < RADIUS, _BLOCKED, 1.0 + (_CLOSE - 1.0) * near)


def cost_to_go(cost: Array, price: Array) -> Array:
    """Least cost of reaching an exit from each cell of a grid, (n, m).

    Args:
        cost: (n, m) final cost of each exit cell; inf elsewhere.
        price: (n, m) cost of a step from each cell to the next; a diagonal step is longer.
    """
    n, m = cost.shape
    while True:
        wide = np.pad(cost, 1, constant_values=np.inf)
        steps = [
            wide[1 + a : 1 + a + n, 1 + b : 1 + b + m] + np.hypot(a, b) * price for a, b in _AROUND
        ]
        settled = np.minimum(cost, np.min(steps, axis=0))
        if np.array_equal(settled, cost):
            return cost
        cost = settled


def between(grid: Array, at: Array) -> Array:
    """Bilinear interpolation of a grid (n, m) at (k, 2) points in units of cells: (k,)."""
    i, j = np.floor(at).astype(int).T
    a, b = at.T - (i, j)
    return (1 - a) * ((1 - b) * grid[i, j] + b * grid[i, j + 1]) + a * (
        (1 - b) * grid[i + 1, j] + b * grid[i + 1, j + 1]
    )
