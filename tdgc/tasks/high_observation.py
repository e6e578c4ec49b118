"""The high policy's observation o^H (paper Sec. IV-B): a table of terms, which also gives its size
and its mirror image."""

from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from tdgc.config import CommandRanges, ConfigError, HighLevelConfig
from tdgc.policies import Mirror
from tdgc.sim.commands import CONTINUOUS, NUM_ACTIONS, SIDEWAYS
from tdgc.sim.families import FAMILIES
from tdgc.sim.locomotion import SPEED_SCALE, Locomotion
from tdgc.sim.observation import (
    JOINT_FLIP,
    LEG_FLIP,
    VECTOR_FLIP,
    Flip,
    Term,
    columns,
    in_place,
    mirror,
    observe,
    width,
)
from tdgc.sim.robot import Array, to_goal, wrap_angle
from tdgc.sim.sensors import Noise
from tdgc.tasks.leaps import FREQUENCIES, LENGTHS
from tdgc.tasks.probes import NUM_PROBES, PROBE_RANGE, PROBE_SWAP, PROBES, HeightProbes
from tdgc.tasks.teacher import WAY

GOAL_SCALE = 1.0 / 8.0  # 1/m: scales distances to shares of the tile's length
#: What a teacher appends to an observation, and the width of each part: its actions; how the second
#: way around an obstacle differs in the actions ``WAY``, and how much longer it is; the prices of
#: strides.
GUIDANCE_PARTS = {
    "taught": NUM_ACTIONS,
    "aside": len(WAY),
    "dearer": 1,
    "price": FREQUENCIES * LENGTHS,
}
GUIDANCE = sum(GUIDANCE_PARTS.values())

#: The semantic cue: one-hot over the families and "unknown".
SEMANTIC = (*FAMILIES, "unknown")


def semantic_index(family: str) -> int:
    """Index of a family in ``SEMANTIC``; that of "unknown" if it is not listed."""
    return SEMANTIC.index(family if family in SEMANTIC else "unknown")


class HighSources(NamedTuple):
    """The sources of o^H for M robots.

    Attributes:
        loco: the robots.
        goal: (M, 2) m in the world.
        time_share: (M,) t / T_max.
        last_action: (M, 13), normalised.
        families: (M,) indices into ``SEMANTIC``.
        probes: (M, 32) m, from ``HeightProbes.read``.
        late: (M,) how many decisions ago the probes were measured.
        closing: (M,) m/s, speed towards the goal since the last decision.
    """

    loco: Locomotion
    goal: Array
    time_share: Array
    last_action: Array
    families: NDArray[np.int64]
    probes: Array
    late: NDArray[Any]
    closing: Array


def _goal(seen: HighSources) -> Array:
    state = seen.loco.world.state
    distance, direction = to_goal(state, seen.goal)
    bearing = wrap_angle(direction - state.yaw)
    return np.stack([GOAL_SCALE * distance, np.cos(bearing), np.sin(bearing)], axis=1)


def _joint_error(seen: HighSources) -> Array:
    return seen.loco.world.state.q - seen.loco.joint_offset - seen.loco.nominal


_FLIP_ACTION = in_place(*(-1.0 if name in SIDEWAYS else 1.0 for name in (*CONTINUOUS, "gait")))
_PROBES = Flip(PROBE_SWAP, (1.0,) * NUM_PROBES)
#: All terms of o^H, in order.
_TERMS: tuple[Term[HighSources], ...] = (
    Term("goal", 3, _goal, mirror=in_place(1.0, 1.0, -1.0)),
    Term("time_left", 1, lambda s: 1.0 - s.time_share[:, None]),
    Term("gravity", 3, lambda s: s.loco.world.state.gravity, mirror=VECTOR_FLIP),
    Term("joint_error", 12, _joint_error, mirror=JOINT_FLIP),
    Term("joint_speed", 12, lambda s: s.loco.world.state.qd, SPEED_SCALE, mirror=JOINT_FLIP),
    Term("last_action", 13, lambda s: s.last_action, mirror=_FLIP_ACTION),
    Term("clock", 4, lambda s: s.loco.clock.signal(), mirror=LEG_FLIP),
    Term("clock_cosine", 4, lambda s: s.loco.clock.cosine(), mirror=LEG_FLIP),
    Term("family", len(SEMANTIC), lambda s: np.eye(len(SEMANTIC))[s.families]),
    Term("probes", NUM_PROBES, lambda s: s.probes, 1.0 / PROBE_RANGE, mirror=_PROBES),
    Term("probe_age", 1, lambda s: s.late[:, None].astype(np.float64)),
    Term("closing_speed", 1, lambda s: s.closing[:, None]),
)


def high_layout(config: HighLevelConfig) -> tuple[Term[HighSources], ...]:
    """The terms of the high policy's observation o^H, in order."""
    geometric = config.cues in ("both", "geometric")
    optional = {
        "clock_cosine": config.clock == "both",
        "family": config.cues in ("both", "semantic"),
        "probes": geometric,
        "probe_age": geometric and config.probe_age,
        "closing_speed": config.closing_speed,
    }
    return tuple(term for term in _TERMS if optional.get(term.name, True))


class HighObserver:
    """Observes o^H of M robots from one decision to the next, in training as in evaluation.

    Args:
        loco: the robots.
        config: the MDP.
        noise: of the height probes; None for exact ones.

    Attributes:
        probes: the height probes.
        distance: (M,) m to the goal at the latest decision.
        closing: (M,) m/s towards the goal since the decision before; 0 at the start of an episode.
    """

    def __init__(self, loco: Locomotion, config: HighLevelConfig, noise: Noise | None) -> None:
        self._loco, self._layout = loco, high_layout(config)
        self._seconds = config.decimation * loco.physics.control_dt
        self.probes = HeightProbes(loco, PROBES[config.probes], noise)
        self.distance, self.closing = np.zeros((2, loco.num_robots))

    def begin(self, index: NDArray[np.integer], goal: Array) -> None:
        """Start new episodes for the robots ``index`` (n,); ``goal`` (M, 2) m in the world."""
        self.probes.begin(index)
        distance, _ = to_goal(self._loco.world.state, goal)
        self.distance[index], self.closing[index] = distance[index], 0.0

    def measure(self, goal: Array) -> None:
        """Measure ground and approach, once per decision after the first."""
        self.probes.measure()
        now, _ = to_goal(self._loco.world.state, goal)
        self.closing[:], self.distance[:] = (self.distance - now) / self._seconds, now

    def observe(
        self, goal: Array, time_share: Array, last_action: Array, families: NDArray[np.int64]
    ) -> NDArray[np.float32]:
        """o^H, (M, n); the arguments are those of ``HighSources``."""
        heights, late = self.probes.read(), self.probes.late
        sources = HighSources(
            self._loco, goal, time_share, last_action, families, heights, late, self.closing
        )
        return observe(self._layout, sources)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """State of the episodes under way, not copied."""
        return {
            "probes": self.probes.measured,
            "late": self.probes.late,
            "goal_distance": self.distance,
            "closing_speed": self.closing,
        }


def untold_column(config: HighLevelConfig) -> int | None:
    """Column of o^H that is 1 if the family is unknown; None without the semantic cue."""
    family = columns(high_layout(config)).get("family")
    return None if family is None else family.start + SEMANTIC.index("unknown")


def high_spaces(
    config: HighLevelConfig, taught: bool = False
) -> tuple[gym.spaces.Box, gym.spaces.Box]:
    """Observation space, with a teacher's guidance if ``taught``, and action space."""
    size = width(high_layout(config)) + taught * GUIDANCE
    limit = config.action_limit
    seen = gym.spaces.Box(-np.inf, np.inf, (size,), np.float32)
    return seen, gym.spaces.Box(-limit, limit, (NUM_ACTIONS,), np.float32)


def high_mirror(config: HighLevelConfig) -> Mirror:
    """Left-right mirror of the high policy's observations and actions.

    Raises:
        ConfigError: probes or command bounds that are not left-right symmetric.
    """
    if config.probes == "staggered" and config.cues in ("both", "geometric"):
        raise ConfigError(
            f"probes that are {config.probes} are not the same on both sides, as a symmetric "
            "policy needs them; ppo.mirror=false does without symmetry"
        )
    for name in SIDEWAYS:
        low, high = getattr(config.commands or CommandRanges(), name)
        if low != -high:
            raise ConfigError(
                f"commands.{name} must be the same to both sides for a symmetric policy, not "
                f"{[low, high]}; ppo.mirror=false does without symmetry"
            )
    return Mirror(*mirror(high_layout(config)), *_FLIP_ACTION)
