"""When and how an episode ends (paper Sec. IV-C; TDGC-Bench, "Episode")."""

import numpy as np
from numpy.typing import NDArray

from tdgc.config import ConfigError
from tdgc.sim.robot import Array
from tdgc.sim.world import World

FALL_HEIGHT = 0.15  # m, trunk above the support surface (paper Sec. IV-C)
TRUNK_FORCE = 40.0  # N (paper Sec. IV-C)
GOAL_RADIUS = 0.5  # m (paper Sec. IV-C)
HORIZON = 20.0  # s (TDGC-Bench)

#: How an episode can end; ``GOING`` stands for one that continues.
OUTCOMES = ("reached", "fell", "collided", "left_tile", "timeout")
REACHED, FELL, COLLIDED, LEFT_TILE, TIMEOUT = range(len(OUTCOMES))
GOING = -1


def episode_steps(seconds: float, step: float) -> int:
    """Number of steps of ``step`` s in an episode of ``seconds``.

    Raises:
        ConfigError: the episode would not last a single step.
    """
    if round(seconds / step) < 1:
        raise ConfigError(f"'env.episode_seconds' must last a step of {step:g} s, not {seconds:g}")
    return round(seconds / step)


def outcome(
    world: World, goal: Array | None = None, time_is_up: NDArray[np.bool_] | bool = False
) -> NDArray[np.int64]:
    """How each robot's episode ends now, (M,): an index into ``OUTCOMES``, or ``GOING``.

    Failure takes precedence over success: a robot that falls into the goal has fallen. Robot i is
    on tile i of the world's field.

    Args:
        world: the robots; on a plane, which has no field, there is no tile to leave.
        goal: (M, 2) m in the world; only the horizontal distance counts. None: nothing is reached.
        time_is_up: (M,), or a single value for all robots.
    """
    x, y = world.state.position[:, :2].T
    ended = np.where(time_is_up, TIMEOUT, np.full(len(x), GOING))
    if goal is not None:
        ended[np.hypot(*(world.state.position[:, :2] - goal).T) < GOAL_RADIUS] = REACHED
    if world.field is not None:
        ended[~world.field.on_tile(np.arange(len(x)), x, y)] = LEFT_TILE
    ended[world.state.trunk_force > TRUNK_FORCE] = COLLIDED
    # Written so that a robot whose simulation has blown up (height NaN) counts as fallen, too.
    ended[~(world.trunk_height() >= FALL_HEIGHT)] = FELL
    return ended


def has_failed(ended: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which outcomes are failures: all except reaching the goal and running out of time, which
    truncates an episode."""
    return np.isin(ended, (FELL, COLLIDED, LEFT_TILE))


def is_fallen(world: World) -> NDArray[np.bool_]:
    """Whether each robot has fallen or collided, the failures of the body alone, (M,)."""
    return np.isin(outcome(world), (FELL, COLLIDED))
