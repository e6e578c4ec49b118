"""Diagnosis of a failed episode from its trace: the layer to blame, the cause and the evidence.

- ``terrain``: neither policy was trained on this kind of tile.
- ``execution``: the low policy failed to track its commands, or the robot fell although the
  commands were sensible.
- ``decisions``: the commands were carried out and led to the failure, or the robot walked into a
  trench that the policy had no cues to see.

Tracking counts as lost where its errors exceed ``LIMITS``, that is, where they are larger than in
all but a few stretches of episodes that reached their goals.
"""

import dataclasses
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike, NDArray

from tdgc.benchmark.evaluation import Episode, EpisodeRecord
from tdgc.benchmark.trace import NO_TILE, TRACKED, Trace
from tdgc.files import write_csv
from tdgc.sim.families import MAX_LEVEL, UNNAMED
from tdgc.sim.robot import Array
from tdgc.sim.terrain import is_map
from tdgc.sim.tile import CELL, GOAL_BEGIN, START_END, TILE_SIZE, ZONE, Tile
from tdgc.tasks.survey import corridor_at, find_trenches

LAYERS = ("decisions", "execution", "terrain")

#: m/s, mean commanded velocity away from the goal above which the decisions are to blame. In 165
#: episodes that reached the goal, the mean towards it was never below 0.4 m/s. Tracking is worst
#: when walking backwards fast; this rule precedes those on tracking errors.
AWAY = 0.2
LOOK_BACK = 2.0  # s, the judged stretch before the end: four to eight gait cycles
SETTLE = 1.0  # s at the start that are not judged: speeding up from rest, as in the tracking test
#: m, how far a foot reaches ahead of the hips. With hips 0.18 m ahead of the trunk's centre, the
#: centre was up to 0.25 m from a pillar's edge when the trunk hit it, and up to 0.29 m when the
#: robot was held up by a pillar.
REACH = 0.2
# m: on a user's map, ground that rises by this much within ``_STEEP`` cells, to this much above the
# ground under the trunk, is an obstacle. Steps of the benchmark are half as high at most, and
# stairs of them take more room.
_TALL, _STEEP = 0.3, 2


#: What the log of a real robot may lack, with a trace column that is empty if it does.
_TRUTH = {
    "velocity": "error_vx",
    "yaw rate": "error_yaw_rate",
    "trunk height": "base_height",
    "contacts": "contact_FL",
    "forces": "trunk_force",
    "place on a tile": "base_x",
}


@dataclass(frozen=True)
class Limit:
    """Bound that a tracking error stays below in successful episodes.

    Attributes:
        unit: unit of the error.
        stretch: limit on its mean over ``LOOK_BACK``.
        episode: limit on its mean over a whole episode, by which a timeout is judged if tracking
            can be judged for longer than that.
    """

    unit: str
    stretch: float
    episode: float


#: The 95th percentiles over all stretches, and over all episodes, of 168 that reached their goals:
#: both policies, five episodes on levels 6 and 8 of each family, evaluation seeds 1 and 2. The
#: largest errors are on stairs.
LIMITS: dict[str, Limit] = {
    "velocity": Limit("m/s", 0.24, 0.13),
    "yaw rate": Limit("rad/s", 0.11, 0.08),
    "tilt": Limit("rad", 0.37, 0.14),
}


@dataclass(frozen=True)
class Diagnosis(EpisodeRecord):
    """A failed episode's row of diagnosis.csv.

    Attributes:
        time_s: time of the end, in s.
        place: part of the tile: a platform, a transition or the zone.
        feature: the nearest trench, step or pillar and its distance from the trunk; may be empty.
        layer: one of ``LAYERS``.
        cause: what went wrong, in a few words from a small fixed set.
        evidence: the numbers that support it.
    """

    time_s: float
    place: str
    feature: str
    layer: str
    cause: str
    evidence: str


def diagnose(trace: Trace, hips: float) -> Diagnosis:
    """Determine which layer failed in the episode of ``trace``, and why.

    Args:
        trace: trace of a failed episode. If it was not on a tile, what only a simulator knows is
            missing, and the evidence lists it.
        hips: m, distance of the hips ahead of the trunk's centre.

    Raises:
        ValueError: the episode did not fail.
    """
    if trace.outcome == "reached":
        raise ValueError("an episode that reached its goal has not failed")
    tile, place, feature = tile_under(trace), "", ""
    if tile is not None:
        x, y = float(trace["base_x"][-1]), float(trace["base_y"][-1])
        found = sorted(features(tile, x, y), key=lambda feature: feature[1])
        place, feature = place_of(x), f"{found[0][1]:.2f} m from {found[0][0]}" if found else ""
    (layer, cause), evidence = _judge(trace, tile, hips)
    return Diagnosis(
        **trace.identity,
        time_s=round(float(trace["time"][-1]), 2),
        place=place,
        feature=feature,
        layer=layer,
        cause=cause,
        evidence=evidence,
    )


def tile_under(trace: Trace) -> Tile | None:
    """Return the tile of an episode; None if it was not on a tile."""
    return None if trace.seed == NO_TILE else trace.tile()


# ---------------------------------------------------------------------------- which layer


def _judge(trace: Trace, tile: Tile | None, hips: float) -> tuple[tuple[str, str], str]:
    """Return the layer and cause, and the evidence."""
    intervals = judged(trace)
    held, at_trench = held_up(trace, tile, hips), False
    if tile is not None and trace.outcome != "left_tile":
        away = to_trenches(tile, trace["base_x"][-1]).min(initial=np.inf)
        at_trench = bool(away < hips + REACH)
    tracked = intervals & free(trace, tile, hips)
    errors = tracking_errors(trace, tracked)
    # Means over a shorter time vary more, so they have the higher limits.
    whole = trace.outcome == "timeout" and trace["seconds"][1:][tracked].sum() > LOOK_BACK
    limits = {name: limit.episode if whole else limit.stretch for name, limit in LIMITS.items()}
    lost = [name for name, error in errors.items() if error > limits[name]]
    towards = asked_towards(trace, intervals)
    # Without a tile, the outcome is reported rather than measured: "collided" then means that the
    # robot did not hit the ground.
    hit = held[-1] or (trace.outcome == "collided" and tile is None)
    fallen = trace.outcome in ("fell", "collided")
    obstacle = "an obstacle" if tile is None else _obstacle(tile.family)
    if trace.family == "mixed" or trace.level > MAX_LEVEL:
        blamed = "terrain", "never trained on"
    elif towards < -AWAY:
        blamed = "decisions", "led away from the goal"
    elif at_trench and not has_looked(trace):
        blamed = "decisions", "walked blindly into a trench"
    elif lost:
        blamed = "execution", f"lost track of {' and '.join(lost)}"
    elif fallen and not hit and towards > 0.0:
        blamed = "execution", "lost its footing on the way to the goal"
    elif fallen and not hit:
        blamed = "decisions", "lost its footing on the way elsewhere"
    elif fallen:
        blamed = "decisions", f"steered into {obstacle}"
    elif trace.outcome == "left_tile":
        blamed = "decisions", "steered off the tile"
    elif held[-1]:
        blamed = "decisions", f"held up by {obstacle}"
    else:
        blamed = "decisions", "found no way to the goal"
    return blamed, _evidence(trace, intervals, errors, limits, towards)


def judged(trace: Trace) -> NDArray[np.bool_]:
    """Mask of the intervals between decisions, (n - 1,), by which an episode is judged.

    These are all intervals for a timeout and the last ``LOOK_BACK`` for any other end, in both
    cases without ``SETTLE``.
    """
    time = trace["time"].astype(np.float64)
    last = time[1:] > (0.0 if trace.outcome == "timeout" else time[-1] - LOOK_BACK)
    return last & settled(trace)


def settled(trace: Trace) -> NDArray[np.bool_]:
    """Mask of the intervals between decisions, (n - 1,), that begin after ``SETTLE``."""
    return trace["time"][:-1].astype(np.float64) > SETTLE - 1e-6


def tracking_errors(trace: Trace, intervals: NDArray[np.bool_]) -> dict[str, float]:
    """Magnitudes of the mean errors over ``intervals`` (n - 1,), keyed by the names of ``LIMITS``.

    Averaging over gait cycles cancels the sway of the trunk about its command. The result is empty
    if there is no interval; errors that were not measured are left out.
    """

    def mean(name: str) -> float:
        values = trace[f"error_{name}"][1:][intervals]
        return float(np.average(values, weights=trace["seconds"][1:][intervals]))

    if not intervals.any():
        return {}
    errors = {
        "velocity": float(np.hypot(mean("vx"), mean("vy"))),
        "yaw rate": abs(mean("yaw_rate")),
        "tilt": float(np.hypot(mean("pitch"), mean("roll"))),
    }
    return {name: error for name, error in errors.items() if np.isfinite(error)}


def asked_towards(trace: Trace, intervals: NDArray[np.bool_]) -> float:
    """Mean commanded velocity towards the goal over ``intervals`` (n - 1,), in m/s.

    Without any interval, the mean is over the whole episode.
    """
    bearing = trace["goal_bearing"][:-1]
    vx, vy = trace["command_vx"][:-1], trace["command_vy"][:-1]
    towards = vx * np.cos(bearing) + vy * np.sin(bearing)
    if not intervals.any():
        intervals = np.ones_like(intervals)
    return float(np.average(towards[intervals], weights=trace["seconds"][1:][intervals]))


def has_looked(trace: Trace) -> bool:
    """Whether the decisions were based on any terrain cue, or on the tile itself."""
    if trace.policy == "teacher":
        return True
    told = any(family not in (None, "unknown") for family in trace["family"])
    return told or bool(np.isfinite(trace["probe_00"]).any())


def held_up(trace: Trace, tile: Tile | None, hips: float) -> NDArray[np.bool_]:
    """Mask of the rows, (n,), in which a pillar, or an obstacle on a map, is near enough to hold up
    the robot."""
    x, y = trace["base_x"], trace["base_y"]
    if tile is None:
        return np.zeros(len(x), dtype=bool)
    if is_map(trace.family):
        return to_obstacles(tile, x, y) < hips + REACH
    return to_pillars(tile, x, y).min(axis=1, initial=np.inf) < hips + REACH


def free(trace: Trace, tile: Tile | None, hips: float) -> NDArray[np.bool_]:
    """Mask of the intervals, (n - 1,), in which tracking is judged.

    No policy can track its commands against an obstacle, or with the trunk within ``hips`` m of the
    tile's edge, where feet have no ground.
    """
    x, y = trace["base_x"], trace["base_y"]
    inside = np.minimum(np.minimum(x, TILE_SIZE - x), np.minimum(y, TILE_SIZE - y))
    return ~(held_up(trace, tile, hips) | (inside < hips))[1:]


def _evidence(
    trace: Trace,
    intervals: NDArray[np.bool_],
    errors: dict[str, float],
    limits: dict[str, float],
    towards: float,
) -> str:
    """Format the numbers that a diagnosis rests on."""
    words = [
        f"{name} off by {error:.2f} {LIMITS[name].unit} (limit {limits[name]:g})"
        for name, error in errors.items()
    ] or ["tracking not judged: too short, at an obstacle or at the edge"]
    words.append(f"asked for {towards:+.2f} m/s towards the goal")
    for name in TRACKED:
        share = np.sum(trace[f"at_bound_{name}"][:-1][intervals] != 0.0) / max(intervals.sum(), 1)
        if share > 0.5:
            words.append(f"{name} at its bound {100 * share:.0f} % of the time")
    if trace.seed == NO_TILE:
        missing = [what for what, name in _TRUTH.items() if np.isnan(trace[name]).all()]
        words.append(f"not known: {', '.join(missing)}")
    span = "all along" if trace.outcome == "timeout" else f"in the last {LOOK_BACK:g} s"
    return f"{span}: {'; '.join(words)}"


# ---------------------------------------------------------------------------- where on the tile


def place_of(x: float) -> str:
    """Name the part of the tile at ``x`` m along it."""
    if x < START_END:
        return "start platform"
    if x < ZONE[0]:
        return "first transition"
    if x <= ZONE[1]:
        return "zone"
    return "second transition" if x < GOAL_BEGIN else "goal platform"


def features(tile: Tile, x: float, y: float) -> Iterator[tuple[str, float]]:
    """Yield the nearest trench, step and pillar, if the tile has any, each with its distance in m
    from (x, y) m in the tile's frame. Trenches and steps are numbered along the tile."""
    found = tile.features
    away = to_trenches(tile, x)
    if away.size:
        yield f"trench {away.argmin() + 1} of {away.size}", float(away.min())
    if len(found.risers):
        away = np.abs(x - found.risers[:, 0])
        yield f"step {away.argmin() + 1} of {away.size}", float(away.min())
    if len(found.pillars):
        away = to_pillars(tile, x, y)
        px, py, _ = found.pillars[away.argmin()]
        name = _obstacle(tile.family).split()[1]
        yield f"{name} at ({px:.1f}, {py:.1f}) m", float(away.min())


def _obstacle(family: str) -> str:
    """What a family's obstacles are called, with its article; some of Clutter are walls or pits."""
    return "an obstacle" if family in UNNAMED or is_map(family) else "a pillar"


def trenches_of(tile: Tile) -> Array:
    """Lips of the tile's trenches, (k, 2) m. A map lists none, so they are looked for."""
    if not is_map(tile.family):
        return tile.features.trenches
    columns = CELL * np.arange(tile.heights.shape[1])
    return find_trenches(tile.heights.astype(np.float64), corridor_at(columns))[0]


def to_trenches(tile: Tile, x: ArrayLike) -> Array:
    """Distances along the tile, in m, from ``x`` (...) m to the k trenches, (..., k)."""
    begin, end = trenches_of(tile).T
    along = np.asarray(x)[..., None]
    return np.maximum(np.maximum(begin - along, along - end), 0.0)


def to_pillars(tile: Tile, x: ArrayLike, y: ArrayLike) -> Array:
    """Distances in m from points (...) to the surfaces of the k pillars, (..., k)."""
    px, py, diameter = tile.features.pillars.T
    away = np.hypot(np.asarray(x)[..., None] - px, np.asarray(y)[..., None] - py)
    return np.maximum(away - 0.5 * diameter, 0.0)


def to_obstacles(tile: Tile, x: Array, y: Array) -> Array:
    """Distances in m from points (n,) to the nearest wall, see ``_TALL``, that is higher than the
    ground at the point; infinite where there is none."""
    heights, n = tile.heights, len(tile.heights)
    around = sliding_window_view(np.pad(heights, _STEEP, mode="edge"), (2 * _STEEP + 1,) * 2)
    walls = np.argwhere(heights - around.min(axis=(2, 3)) > _TALL)
    tops = heights[tuple(walls.T)]
    at = np.stack([x, y], axis=1)
    under = heights[tuple(np.clip(np.rint(at / CELL), 0, n - 1).astype(int).T)]
    away = np.linalg.norm(CELL * walls - at[:, None], axis=2)
    return np.where(tops > under[:, None] + _TALL, away, np.inf).min(axis=1, initial=np.inf)


# ---------------------------------------------------------------------------- results


def write(diagnoses: Sequence[Diagnosis], path: Path) -> None:
    """Write diagnosis.csv atomically, one row per failed episode."""
    write_csv(path, [f.name for f in dataclasses.fields(Diagnosis)], map(vars, diagnoses))


def count_failures(
    diagnoses: Sequence[Mapping[str, Any]], episodes: Sequence[Mapping[str, Any]]
) -> list[dict[str, Any]]:
    """Count failures by policy, condition, family and level, and find where most can be gained.

    Most can be gained in the family and layer with the most failures. Their number is given in
    points: per cent of all episodes of the policy and condition.

    Args:
        diagnoses: rows of diagnosis.csv.
        episodes: rows of episodes.csv, failed or not.
    """
    result = []
    totals = Counter((e["policy"], e["condition"]) for e in episodes)
    for (policy, condition), total in totals.items():
        mine = [d for d in diagnoses if (d["policy"], d["condition"]) == (policy, condition)]
        cells = []
        for family, level in dict.fromkeys((d["family"], d["level"]) for d in mine):
            cell = [d for d in mine if (d["family"], d["level"]) == (family, level)]
            layers = Counter(d["layer"] for d in cell)
            cause, times = Counter(d["cause"] for d in cell).most_common(1)[0]
            cells.append(
                {
                    "family": family,
                    "level": level,
                    "layers": [layers[layer] for layer in LAYERS],
                    "cause": cause,
                    "times": times,
                }
            )
        worst = Counter((d["family"], d["layer"]) for d in mine).most_common(1)
        result.append(
            {
                "policy": policy,
                "condition": condition,
                "failures": len(mine),
                "total": total,
                "cells": cells,
                "most": [(*where, 100 * count / total) for where, count in worst],
            }
        )
    return result


def describe(diagnoses: Sequence[Diagnosis], episodes: Sequence[Episode]) -> str:
    """Describe failures by family and level with their causes, and where most can be gained.

    Args:
        diagnoses: those of all failed episodes.
        episodes: all episodes, failed or not.
    """
    lines: list[str] = []
    for run in count_failures([vars(d) for d in diagnoses], [vars(e) for e in episodes]):
        failed = f"{run['failures']} of {run['total']} episodes"
        lines.append(f"failures of {run['policy']}, {run['condition']}: {failed}")
        if not run["failures"]:
            continue
        head = "".join(f"{layer:>11}" for layer in LAYERS)
        wide = max(8, *(len(cell["family"]) + 1 for cell in run["cells"]))
        lines.append(f"{'family'.ljust(wide)}level{head}  commonest cause")
        for cell in run["cells"]:
            numbers = "".join(f"{count:>11}" for count in cell["layers"])
            cause = f"{cell['cause']} ({cell['times']})"
            lines.append(f"{cell['family'].ljust(wide)}{cell['level']:>5}{numbers}  {cause}")
        for family, layer, points in run["most"]:
            lines.append(
                f"largest possible gain: {family}, {layer}, {points:.1f} points of success"
            )
    return "\n".join(lines)
