"""Gaits and their phase clock (paper Sec. IV-A; clock and schedule of Walk These Ways).

A gait is a triple (phase, offset, bound) of cycle fractions. At a clock g in [0, 1), the raw phases
of the feet, modulo 1, are

    FL  g + phase + offset + bound
    FR  g + offset
    RL  g + bound
    RR  g + phase

so ``phase`` pairs the diagonals (trot), ``offset`` sets the front pair against the rear (bound) and
``bound`` the left pair against the right (pace). The first half of a foot's warped phase is stance.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

FEET = ("FL", "FR", "RL", "RR")
GAITS = ("trot", "pronk", "pace", "bound")  # in the order of the paper's gait index

#: (phase, offset, bound) of each gait: the embedding e(g) of the command vector.
GAIT_TABLE: NDArray[np.float64] = np.array(
    [
        [0.5, 0.0, 0.0],  # trot: FL with RR, FR with RL
        [0.0, 0.0, 0.0],  # pronk: all four together
        [0.0, 0.0, 0.5],  # pace: left pair against right pair
        [0.0, 0.5, 0.0],  # bound: front pair against rear pair
    ]
)

#: Which of (phase, offset, bound) each foot adds to the clock; rows in the order of FEET.
_FOOT_OFFSETS: NDArray[np.float64] = np.array(
    [[1.0, 1.0, 1.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]
)

KAPPA = 0.07  # width of the smoothed contact schedule, in cycles (Walk These Ways)


def normal_cdf(x: NDArray[np.floating], scale: float) -> NDArray[np.float64]:
    """Cumulative normal distribution of ``x / scale`` by Zelen and Severo's 26.2.17.

    From Abramowitz and Stegun, with an error below 7.5e-8; numpy has no erf, and one function does
    not justify another dependency.
    """
    z = np.abs(np.asarray(x, dtype=np.float64)) / scale
    t = 1.0 / (1.0 + 0.2316419 * z)
    poly = t * (
        0.319381530 + t * (-0.356563782 + t * (1.781477937 + t * (-1.821255978 + t * 1.330274429)))
    )
    tail = np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi) * poly
    return np.where(np.asarray(x) >= 0.0, 1.0 - tail, tail)


def gait_embedding(gait: ArrayLike) -> NDArray[np.float64]:
    """e(g): gait indices (...) -> (phase, offset, bound) (..., 3).

    Raises:
        ValueError: an index outside 0..3.
    """
    index = np.asarray(gait, dtype=np.int64)
    if index.size and (index.min() < 0 or index.max() >= len(GAITS)):
        raise ValueError(f"gait index must be 0..{len(GAITS) - 1} ({', '.join(GAITS)})")
    return GAIT_TABLE[index]


def foot_phases(
    clock: NDArray[np.floating], embedding: NDArray[np.floating], duration: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Warped phase of each foot: (M,), (M, 3), (M,) -> (M, 4) in [0, 1).

    A foot is in stance while its raw phase is below ``duration`` (the duty factor); the warp maps
    stance to [0, 0.5) and swing to [0.5, 1).
    """
    raw = np.mod(clock[:, None] + embedding @ _FOOT_OFFSETS.T, 1.0)
    duty = duration[:, None]
    stance = raw * (0.5 / duty)
    swing = 0.5 + (raw - duty) * (0.5 / (1.0 - duty))
    return np.where(raw < duty, stance, swing)


def raw_phase(phase: NDArray[np.floating], duration: NDArray[np.floating]) -> NDArray[np.float64]:
    """The inverse of the warp of ``foot_phases``, of any shape: a foot's share of its cycle."""
    stance = phase * (duration / 0.5)
    swing = duration + (phase - 0.5) * ((1.0 - duration) / 0.5)
    return np.where(phase < 0.5, stance, swing)


def desired_contact(phases: NDArray[np.floating]) -> NDArray[np.float64]:
    """Smoothed contact schedule C of each foot: phases (..., 4) -> (..., 4) in [0, 1]."""
    return normal_cdf(phases, KAPPA) * (1.0 - normal_cdf(phases - 0.5, KAPPA)) + normal_cdf(
        phases - 1.0, KAPPA
    ) * (1.0 - normal_cdf(phases - 1.5, KAPPA))


def swing_profile(phases: NDArray[np.floating]) -> NDArray[np.float64]:
    """Height of a swing foot as a share of its apex: phases (..., 4) -> (..., 4), 0 in stance.

    The profile is half a sine. The triangle of Walk These Ways is lower wherever a foot may hit the
    edge of a step: on level 8 of Stair the same policy reached 33 % with it and 100 % with one cut
    off at two thirds, which has nearly the same mean height as half a sine (docs/experiments.md).
    """
    swing = np.clip(2.0 * phases - 1.0, 0.0, 1.0)
    return np.sin(np.pi * swing)


def begun(cycles: NDArray[np.floating], first: float) -> NDArray[np.float64]:
    """Completed share of a gait's ``first`` cycles after ``cycles`` of any shape; 1 if ``first`` is
    0."""
    return np.minimum(cycles / first, 1.0) if first > 0.0 else np.ones_like(cycles)


def executed_frequency(
    asked: NDArray[np.floating], cycles: NDArray[np.floating], start: float, first: float
) -> NDArray[np.float64]:
    """Frequency in Hz at which a gait is carried out after ``cycles`` if ``asked`` Hz is commanded.

    It begins at ``start`` Hz or faster and slows to the commanded one over the ``first`` cycles.
    ``asked`` and ``cycles`` are of shapes that broadcast.
    """
    return asked + (1.0 - begun(cycles, first)) * np.maximum(start - asked, 0.0)


class PhaseClock:
    """One clock per robot, g <- (g + dt f) mod 1, and the four foot phases derived from it.

    Attributes:
        clock: (M,) cycle fraction.
        embedding: (M, 3) e(g) of the current gait.
        cycles: (M,) cycles since that gait began.
        phases: (M, 4) warped foot phases as of the last ``advance`` or ``update``.
        contact: (M, 4) desired contact C at these phases.
    """

    def __init__(self, num_robots: int) -> None:
        self.clock = np.zeros(num_robots)
        self.embedding = np.zeros((num_robots, 3))
        self.cycles = np.zeros(num_robots)
        self.phases = np.zeros((num_robots, 4))
        self.contact = desired_contact(self.phases)

    def reset(self, index: NDArray[np.integer], clock: NDArray[np.floating] | float = 0.0) -> None:
        """Set the clock of the robots ``index`` and restart their gait; ``update`` then refreshes
        the phases."""
        self.clock[index] = clock
        self.cycles[index] = 0.0

    def advance(
        self,
        dt: float,
        frequency: NDArray[np.floating],
        embedding: NDArray[np.floating],
        duration: NDArray[np.floating],
    ) -> None:
        """Advance every clock by ``dt`` seconds at ``frequency`` (M,) Hz."""
        self.clock = np.mod(self.clock + dt * frequency, 1.0)
        self.cycles = self.cycles + dt * frequency
        self.update(embedding, duration)

    def update(self, embedding: NDArray[np.floating], duration: NDArray[np.floating]) -> None:
        """Recompute the foot phases after a change of gait or duty factor."""
        self.cycles[(embedding != self.embedding).any(axis=1)] = 0.0
        self.embedding[:] = embedding
        self.phases = foot_phases(self.clock, embedding, duration)
        self.contact = desired_contact(self.phases)

    def signal(self) -> NDArray[np.float64]:
        """phi_t: sin(2 pi phase) of each foot, (M, 4), as the low policy sees it."""
        return np.sin(2.0 * np.pi * self.phases)

    def cosine(self) -> NDArray[np.float64]:
        """cos(2 pi phase) of each foot, (M, 4): the sine alone takes each value twice per cycle."""
        return np.cos(2.0 * np.pi * self.phases)

    def swing(self, ramp: float) -> NDArray[np.float64]:
        """Height of each foot as a share of its apex, (M, 4), growing over a gait's first ``ramp``
        cycles: legs that are all drawn up before the trunk rises let it drop."""
        return begun(self.cycles, ramp)[:, None] * swing_profile(self.phases)
