"""Observations as tables of terms: what each one reads, its scale, noise and mirror image.

A layout is an ordered tuple of terms; rows, sizes, columns and mirrors follow from it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from tdgc.sim.sensors import Noise

S = TypeVar("S")


class Flip(NamedTuple):
    """How a vector looks in a left-right mirror: ``sign * x[..., source]``."""

    source: tuple[int, ...]
    sign: tuple[float, ...]


def in_place(*sign: float) -> Flip:
    """The flip of a vector whose entries keep their positions."""
    return Flip(tuple(range(len(sign))), sign)


#: Flips of (forward, left, up) vectors, of rotations about these axes, and of vectors with one
#: entry per leg or joint.
VECTOR_FLIP, RATE_FLIP = in_place(1.0, -1.0, 1.0), in_place(-1.0, 1.0, -1.0)
LEG_FLIP = Flip((1, 0, 3, 2), (1.0,) * 4)
JOINT_FLIP = Flip(
    tuple(3 * leg + j for leg in LEG_FLIP.source for j in range(3)), (-1.0, 1.0, 1.0) * 4
)


@dataclass(frozen=True)
class Term(Generic[S]):
    """One term of an observation.

    Attributes:
        name: its name in the layout.
        size: n, number of network inputs.
        read: source -> (M, n).
        scale: network input per unit read.
        noise: field of ``RandomisationConfig`` with the half-width of its noise, in the units read;
            None for a term that is not measured.
        mirror: its flip in a left-right mirror; None where that changes nothing.
    """

    name: str
    size: int
    read: Callable[[S], NDArray[Any]]
    scale: float = 1.0
    noise: str | None = None
    mirror: Flip | None = None


def width(layout: Sequence[Term[Any]]) -> int:
    """Total number of inputs."""
    return sum(term.size for term in layout)


def columns(layout: Sequence[Term[Any]]) -> dict[str, slice]:
    """The columns of each term in a row."""
    ends = pairwise(accumulate((term.size for term in layout), initial=0))
    return {term.name: slice(*place) for term, place in zip(layout, ends, strict=True)}


def mirror(layout: Sequence[Term[Any]]) -> Flip:
    """The flip of whole rows."""
    source: list[int] = []
    sign: list[float] = []
    for term in layout:
        flip = term.mirror or in_place(*(1.0,) * term.size)
        assert len(flip.source) == len(flip.sign) == term.size, term.name
        source += [len(sign) + i for i in flip.source]
        sign += flip.sign
    return Flip(tuple(source), tuple(sign))


def observe(
    layout: Sequence[Term[S]], source: S, noise: Noise | None = None
) -> NDArray[np.float32]:
    """Network inputs of M robots, (M, n); measured terms carry the ``noise``."""
    parts = []
    for term in layout:
        value = term.read(source)
        if noise is not None and term.noise is not None:
            value = value + noise.draw(getattr(noise.config, term.noise), value.shape)
        parts.append(term.scale * value)
    return np.concatenate(parts, axis=1).astype(np.float32)
