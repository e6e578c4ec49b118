"""The tiles that both policies train on: one per robot, of the robot's family and level.

The seed and a tile's number determine the tile, so a checkpoint stores numbers instead of heights.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tdgc.sim.families import MAX_LEVEL, TRENCH_DEPTH
from tdgc.sim.terrain import TRAIN_STREAM, check_family, make_tile, tile_rng
from tdgc.sim.tile import TILE_SAMPLES, Tile, TileField
from tdgc.state import State, copies, fill

# Training tiles are 4 m wide, since Bullet keeps 600 bytes for each sample of a height field.
TILE_CROP = 2.0  # m, on either side
#: A training family besides those of ``tdgc.sim.families``: flat ground at height 0 on every level.
FLAT = "flat"
# Episodes on one tile while the level stays the same. A tile that is used too often is memorised,
# but loading a new one into Bullet takes 80 ms, a third of the time that 50 robots need for a
# decision. With 5 episodes, loading takes one percent of the total time.
_EPISODES = 5


def check_tiles(families: Sequence[str], levels: int) -> None:
    """Check that tiles of the families can be made, and that none is kept for evaluation: the
    benchmark reserves ``mixed`` and the highest levels as terrain that no policy has met.

    Raises:
        ValueError: no family, an unknown name, a height map that cannot be used, ``mixed``, or a
            number of levels that is not allowed.
    """
    if not families:
        raise ValueError("'env.families' must name at least one terrain family")
    if "mixed" in families:
        raise ValueError("'env.families' must not name 'mixed', which is kept for evaluation")
    for family in families:
        check_family(family, (FLAT,))
    if not 1 <= levels <= MAX_LEVEL + 1:
        raise ValueError(f"'env.levels' must be from 1 to {MAX_LEVEL + 1}, not {levels}")


def left_out(families: Sequence[str], robots: int) -> list[str]:
    """Families that no robot is on if ``robots`` of them are dealt to ``families`` in turn."""
    return [family for family in dict.fromkeys(families) if family not in families[:robots]]


def shallow(tile: Tile, level: int, shallowest: float) -> Tile:
    """The tile with shallower trenches and pits: their greatest depth grows with the square of the
    level, from ``shallowest`` m on level 0 to the full 60 cm on level 10.

    At full depth even the narrowest trench traps a leg for good, and a robot that falls at the
    first trench whatever it does learns nothing. A depth linear in the level grows too fast: trot
    crossed all trenches 5 cm deep, but only a fifth of those 11 cm deep. Only training uses this,
    never evaluation.
    """
    d = min(1.0, level / MAX_LEVEL)
    depth = shallowest + d * d * (TRENCH_DEPTH - shallowest)
    return dataclasses.replace(tile, heights=np.maximum(tile.heights, tile.support - depth))


class TrainingTiles:
    """One tile for each of M robots.

    Args:
        families: (M,) terrain family of each robot.
        seed: seed of the tiles.
        shallowest: m, depth of trenches on level 0, see ``shallow``; None: as in the benchmark.

    Attributes:
        field: M tiles.
        level, number, episodes: (M,) level of each robot's tile, the number it was drawn with (see
            ``tile_rng``), and how many episodes began on it.
        drawn: number of tiles drawn so far.
    """

    def __init__(self, families: Sequence[str], seed: int, shallowest: float | None = None) -> None:
        m = len(families)
        self.families, self._seed, self._shallowest = tuple(families), seed, shallowest
        self.field = TileField(m, crop=TILE_CROP)
        self._relief = np.array([family != FLAT for family in families])
        self.level = np.full(m, -1)  # none yet
        self.number = np.zeros(m, dtype=np.int64)
        self.episodes = np.zeros(m, dtype=np.int64)
        self.drawn = 0

    def draw(self, index: NDArray[np.integer], levels: NDArray[np.integer]) -> NDArray[np.integer]:
        """Draw new tiles for the robots ``index`` (n,) at their ``levels`` (M,). Returns the robots
        whose heights changed: a height map is one tile on every level."""
        index = index[self._relief[index]]
        self.number[index] = self.drawn + np.arange(len(index))
        self.drawn += len(index)
        self.level[index] = levels[index]
        self.episodes[index] = 0
        return self._place(index)

    def begin(self, index: NDArray[np.integer], levels: NDArray[np.integer]) -> NDArray[np.integer]:
        """Start new episodes for the robots ``index`` (n,), with new tiles for those whose level
        changed or whose tile is due for replacement. Returns the robots whose heights changed."""
        worn = (self.level[index] != levels[index]) | (self.episodes[index] >= _EPISODES)
        changed = self.draw(index[worn], levels)
        self.episodes[index] += 1
        return changed

    def _place(self, index: NDArray[np.integer]) -> NDArray[np.integer]:
        before = self._heights()[index]  # a copy
        for i in index:
            family, level = self.families[i], int(self.level[i])
            rng = tile_rng(self._seed, family, level, int(self.number[i]), TRAIN_STREAM)
            tile = make_tile(family, level / MAX_LEVEL, rng)
            if self._shallowest is not None:
                tile = shallow(tile, level, self._shallowest)
            self.field.place(int(i), tile)
        return index[(self._heights()[index] != before).any(axis=(1, 2))]

    def _heights(self) -> NDArray[np.float32]:
        """Heights of each robot's tile, (M, 161, n) m, as a view of the field."""
        return self.field.heights.reshape(len(self.families), TILE_SAMPLES, -1)

    def _arrays(self) -> dict[str, NDArray[np.int64]]:
        return {"level": self.level, "number": self.number, "episodes": self.episodes}

    def state_dict(self) -> State:
        """The tiles in use, as copies of their levels, numbers and episode counts."""
        return copies(self._arrays())

    def load_state_dict(self, state: State) -> None:
        """Rebuild the tiles of a ``state_dict``; the caller then loads the field into Bullet."""
        fill(self._arrays(), state)
        self._place(np.flatnonzero(self._relief))
