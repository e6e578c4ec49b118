"""Terrain of TDGC-Bench: a family, a difficulty and a generator -> a tile.

A tile lists its features (trenches, risers, pillars, slope), for the low policy's training, the
diagnosis, and to test what reads them from the heights. A family may also be a user's height map.
"""

import functools
import re
import zlib
from collections.abc import Sequence

import numpy as np

from tdgc.errors import InputError
from tdgc.sim.families import (
    ALL_FAMILIES,
    BAND,
    CLUTTER,
    DITCHES,
    FAMILIES,
    MAX_DIFFICULTY,
    SURFACES,
    Relief,
    blend_in,
    check_difficulty,
    difficulty_parameter,
)
from tdgc.sim.tile import (
    HEIGHT_RANGE,
    TILE_SAMPLES,
    WHOLE_ZONE,
    ZONE,
    Features,
    FloatArray,
    Section,
    Tile,
    draw_start_goal,
    halves,
)

#: Edition of TDGC-Bench that these tiles belong to; it draws a layout for every tile.
EDITION = 2

#: A family name with this ending is the path of a user's height map, see ``height_map``.
MAP_ENDING = ".npy"

# Of Ditches, which are our own addition: even the shortest part has room for two trenches.
SHORTEST_PART = 1.5  # m

# First entry of every tile's seed. It differs between the streams, so that no training tile is ever
# an evaluation tile, whatever the seeds. Any two different values would do.
TRAIN_STREAM = 1
EVAL_STREAM = 2


def make_tile(family: str, difficulty: float, rng: np.random.Generator) -> Tile:
    """Generate one tile.

    Args:
        family: one of ``ALL_FAMILIES``, or the path of a height map, whose heights are multiplied
            by d.
        difficulty: d in [0, 1.2], level / 10; the curriculum ends at 1.
        rng: the only source of randomness: the same state gives the same tile.

    Raises:
        ValueError: an unknown family, an unusable height map, or a difficulty outside [0, 1.2].
    """
    check_family(family)
    check_difficulty(difficulty)
    start, goal = draw_start_goal(rng)
    parts: tuple[str, ...] = (family,)
    sections: tuple[Section, ...] = (WHOLE_ZONE,)
    if family == "mixed":
        first, second = rng.choice(len(FAMILIES), size=2, replace=False)
        parts, sections = (FAMILIES[first], FAMILIES[second]), halves(sum(ZONE) / 2)
    elif family == DITCHES:
        parts = (CLUTTER, "gap") if rng.uniform() < 0.5 else ("gap", CLUTTER)
        begin, end = ZONE
        sections = halves(rng.uniform(begin + SHORTEST_PART, end - SHORTEST_PART))

    heights = np.zeros((TILE_SAMPLES, TILE_SAMPLES))
    support = np.zeros((TILE_SAMPLES, TILE_SAMPLES))
    features = Features()
    for part, section in zip(parts, sections, strict=True):
        if is_map(part):
            relief = Relief(difficulty * blend_in(section, BAND)[:, None] * height_map(part))
        else:
            relief = SURFACES[part](section, difficulty_parameter(part, difficulty), rng)
        heights += relief.heights
        support += relief.heights if relief.support is None else relief.support
        features += relief.features
    return Tile(
        heights.astype(np.float32),
        support.astype(np.float32),
        start,
        goal,
        family,
        float(difficulty),
        parts,
        features,
    )


def is_map(family: str) -> bool:
    """Whether a family is the path of a user's height map."""
    return family.endswith(MAP_ENDING)


def may_have_trenches(family: str) -> bool:
    """Whether tiles of a family may have trenches."""
    return is_map(family) or family in ("gap", "mixed", DITCHES)


@functools.lru_cache
def height_map(path: str) -> FloatArray:
    """Heights (161, 161) in m from a file, as used at difficulty 1.

    Only the zone and its transition bands use them; the platforms are flat.

    Raises:
        InputError: the file is missing or does not hold such heights.
    """
    try:
        heights = np.load(path, allow_pickle=False)
    except Exception as error:  # whatever a damaged file brings about, such as a SyntaxError
        raise InputError(f"terrain '{path}' cannot be read as a NumPy file: {error}") from error
    shape = (TILE_SAMPLES, TILE_SAMPLES)
    real = isinstance(heights, np.ndarray) and heights.dtype.kind in "fiu"
    if not real or heights.shape != shape or not np.isfinite(heights).all():
        raise InputError(f"terrain '{path}' must hold finite heights in m, an array {shape}")
    limit = HEIGHT_RANGE[1] / MAX_DIFFICULTY
    heights = heights.astype(np.float64)
    if np.abs(heights).max() > limit:
        raise InputError(f"terrain '{path}' must stay within {limit:g} m of the platforms' height")
    return heights


def family_number(family: str) -> int:
    """Number of a family, below 2**32, as part of its tiles' seeds; maps go by their heights."""
    if is_map(family):
        return zlib.crc32(height_map(family).tobytes()) | 2**31  # above those of ALL_FAMILIES
    return ALL_FAMILIES.index(family)


def file_label(family: str) -> str:
    """A family's name in a form that is safe in file names."""
    return re.sub(r"[^\w.-]", "-", family)


def tile_rng(
    seed: int, family: str, level: int, index: int, stream: int = TRAIN_STREAM
) -> np.random.Generator:
    """Generator for tile number ``index`` of a family and level, unique to this tile and stream.

    Raises:
        ValueError: an unknown family, or a number outside [0, 2**32).
    """
    check_family(family)
    entropy = (stream, int(seed), family_number(family), int(level), int(index))
    # A number of more than 32 bits would take two words, so that different entropies could collide.
    if not all(0 <= number < 2**32 for number in entropy):
        raise ValueError(f"stream, seed, level and index must lie in [0, 2**32), got {entropy}")
    return np.random.default_rng(np.random.SeedSequence(entropy))


def check_family(family: str, beside: Sequence[str] = ()) -> None:
    """Check that tiles of a family can be made; the names in ``beside`` are allowed as well.

    Raises:
        ValueError: an unknown name, or an unusable height map.
    """
    if is_map(family):
        height_map(family)
    elif family not in (*ALL_FAMILIES, *beside):
        allowed = ", ".join((*beside, *ALL_FAMILIES, f"FILE{MAP_ENDING}"))
        raise ValueError(f"unknown terrain family {family!r}; choose from {allowed}")
