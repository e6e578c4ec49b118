"""Diagnosis: why an episode failed, from its trace; which layer is to blame, and on what evidence.

- ``terrain``: the tile is of a kind that nothing was trained on.
- ``execution``: the low policy lost track of its commands, or the robot fell under a sane one.
- ``decisions``: the commands were carried out, and they led to the failure; or the robot walked
  into a trench that nothing had looked for.

Tracking is lost where its errors are larger than in all but a few stretches of episodes that
reached their goals: ``LIMITS``.
"""

import csv
import dataclasses
import io
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tdgc.benchmark.evaluation import Episode, EpisodeRecord, tile_of
from tdgc.benchmark.trace import NO_TILE, TRACKED, Trace
from tdgc.files import atomic
from tdgc.sim.robot import Array
from tdgc.sim.terrain import GOAL_BEGIN, MAX_LEVEL, START_END, TILE_SIZE, ZONE, Tile

LAYERS = ("decisions", "execution", "terrain")

#: m/s away from the goal, asked for on average while judged. In 165 episodes that reached it never
#: less than 0.4 m/s towards it was, and fast backwards is where tracking is worst.
AWAY = 0.2
LOOK_BACK = 2.0  # s before the end that are judged: four to eight gait cycles
SETTLE = 1.0  # s at the start that are not: speeding up from rest, as in the tracking test
#: m ahead of the hips: a foot that reaches out from there. With hips 0.18 m ahead of the trunk's
#: centre a trunk was hit at up to 0.25 m from a pillar's edge, and a robot held up by one stood at
#: up to 0.29 m.
REACH = 0.2


#: What a log of a real robot may lack, and a column of the trace that then is empty.
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
    """What an error of tracking stays below in episodes that succeed.

    Attributes:
        unit: of the error.
        stretch: for its mean over ``LOOK_BACK``.
        episode: for its mean over a whole episode, by which a timeout is judged.
    """

    unit: str
    stretch: float
    episode: float


#: The 95th percentiles of all stretches, and of all episodes, of 168 that reached their goals:
#: both policies, five episodes on levels 6 and 8 of each family, evaluation seeds 1 and 2. Stairs
#: make up the upper end.
LIMITS: dict[str, Limit] = {
    "velocity": Limit("m/s", 0.24, 0.13),
    "yaw rate": Limit("rad/s", 0.11, 0.08),
    "tilt": Limit("rad", 0.37, 0.14),
}


@dataclass(frozen=True)
class Diagnosis(EpisodeRecord):
    """A failed episode's row of diagnosis.csv.

    Attributes:
        time_s: s, when it ended.
        place: where on the tile: a platform, a transition or the zone.
        feature: the nearest trench, step or pillar and how far it is from the trunk; or empty.
        layer: one of ``LAYERS``.
        cause: what went wrong, in a few words; there is a small number of them.
        evidence: the numbers that say so.
    """

    time_s: float
    place: str
    feature: str
    layer: str
    cause: str
    evidence: str


def diagnose(trace: Trace, hips: float) -> Diagnosis:
    """Which layer failed in the episode of ``trace``, and why.

    Args:
        trace: of an episode that failed. Where it was on no tile, what a simulator alone knows is
            missing: the evidence says so.
        hips: m, how far ahead of the trunk's centre the robot's hips are.

    Raises:
        ValueError: it did not fail.
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
        **{field.name: getattr(trace, field.name) for field in dataclasses.fields(EpisodeRecord)},
        time_s=round(float(trace["time"][-1]), 2),
        place=place,
        feature=feature,
        layer=layer,
        cause=cause,
        evidence=evidence,
    )


def tile_under(trace: Trace) -> Tile | None:
    """The tile of an episode; None where it was on none."""
    if trace.seed == NO_TILE:
        return None
    return tile_of(trace.seed, trace.family, trace.level, trace.episode, trace.condition)


# ---------------------------------------------------------------------------- which layer


def _judge(trace: Trace, tile: Tile | None, hips: float) -> tuple[tuple[str, str], str]:
    """Layer and cause, and the evidence."""
    intervals = judged(trace)
    held, at_trench = held_up(trace, tile, hips), False
    if tile is not None:
        away = to_trenches(tile, trace["base_x"][-1]).min(initial=np.inf)
        at_trench = bool(away < hips + REACH) and trace.outcome != "left_tile"
    errors = tracking_errors(trace, intervals & free(trace, tile, hips))
    limits = {
        name: limit.episode if trace.outcome == "timeout" else limit.stretch
        for name, limit in LIMITS.items()
    }
    lost = [name for name, error in errors.items() if error > limits[name]]
    towards = asked_towards(trace, intervals)
    # Of a collision on no tile it is said, not measured, that it was not with the ground.
    tripped = trace.outcome == "collided" and tile is not None and not held[-1]
    down = trace.outcome == "fell" or tripped
    if trace.family == "mixed" or trace.level > MAX_LEVEL:
        blamed = "terrain", "never trained on"
    elif towards < -AWAY:
        blamed = "decisions", "led away from the goal"
    elif at_trench and not has_looked(trace):
        blamed = "decisions", "walked blindly into a trench"
    elif lost:
        blamed = "execution", f"lost track of {' and '.join(lost)}"
    elif down and towards > 0.0:
        blamed = "execution", "lost its footing on the way to the goal"
    elif down:
        blamed = "decisions", "lost its footing on the way elsewhere"
    elif trace.outcome == "collided":
        blamed = "decisions", f"steered into {'an obstacle' if tile is None else 'a pillar'}"
    elif trace.outcome == "left_tile":
        blamed = "decisions", "steered off the tile"
    elif held[-1]:
        blamed = "decisions", "held up by a pillar"
    else:
        blamed = "decisions", "found no way to the goal"
    return blamed, _evidence(trace, intervals, errors, limits, towards)


def judged(trace: Trace) -> NDArray[np.bool_]:
    """Which intervals between decisions, (n - 1,), an episode is judged by.

    A timeout by all of them, any other end by the last ``LOOK_BACK``; either without ``SETTLE``.
    """
    time = trace["time"].astype(np.float64)
    last = time[1:] > (0.0 if trace.outcome == "timeout" else time[-1] - LOOK_BACK)
    return np.asarray(last & settled(trace))


def settled(trace: Trace) -> NDArray[np.bool_]:
    """Intervals between decisions, (n - 1,), that begin after ``SETTLE``."""
    return np.asarray(trace["time"][:-1].astype(np.float64) > SETTLE - 1e-6)


def tracking_errors(trace: Trace, intervals: NDArray[np.bool_]) -> dict[str, float]:
    """Sizes of the mean errors over ``intervals`` (n - 1,), by the names of ``LIMITS``.

    A mean over gait cycles: what a trunk sways about its command does not count. Empty without an
    interval; an error that was not measured is left out.
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
    """Mean velocity commanded towards the goal over ``intervals`` (n - 1,), m/s."""
    bearing = trace["goal_bearing"][:-1]
    towards = trace["command_vx"][:-1] * np.cos(bearing) + trace["command_vy"][:-1] * np.sin(
        bearing
    )
    if not intervals.any():
        intervals = np.ones_like(intervals)
    return float(np.average(towards[intervals], weights=trace["seconds"][1:][intervals]))


def has_looked(trace: Trace) -> bool:
    """Whether the decisions looked at any cue of the terrain."""
    told = any(family is not None for family in trace["family"])
    return told or bool(np.isfinite(trace["probe_00"]).any())


def held_up(trace: Trace, tile: Tile | None, hips: float) -> NDArray[np.bool_]:
    """Where the trunk was so near to a pillar that it may have been held up by it, (n,)."""
    x, y = trace["base_x"], trace["base_y"]
    if tile is None:
        return np.zeros(len(x), dtype=bool)
    return np.asarray(to_pillars(tile, x, y).min(axis=1, initial=np.inf) < hips + REACH)


def free(trace: Trace, tile: Tile | None, hips: float) -> NDArray[np.bool_]:
    """Intervals, (n - 1,), in which tracking is judged: against a pillar or over the edge nothing
    is tracked, and that is no fault of who tracks."""
    return ~(held_up(trace, tile, hips) | near_edge(trace, hips))[1:]


def near_edge(trace: Trace, hips: float) -> NDArray[np.bool_]:
    """Where the trunk was within ``hips`` m of the tile's edge, (n,): feet have nothing there."""
    x, y = trace["base_x"], trace["base_y"]
    inside = np.minimum(np.minimum(x, TILE_SIZE - x), np.minimum(y, TILE_SIZE - y))
    return np.asarray(inside < hips)


def _evidence(
    trace: Trace,
    intervals: NDArray[np.bool_],
    errors: dict[str, float],
    limits: dict[str, float],
    towards: float,
) -> str:
    """The numbers that a diagnosis rests on, in words."""
    words = [
        f"{name} off by {error:.2f} {LIMITS[name].unit} (limit {limits[name]:g})"
        for name, error in errors.items()
    ] or ["tracking not judged: too short, at a pillar or at the edge"]
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
    """The part of the tile at ``x`` m along it."""
    if x < START_END:
        return "start platform"
    if x < ZONE[0]:
        return "first transition"
    if x <= ZONE[1]:
        return "zone"
    return "second transition" if x < GOAL_BEGIN else "goal platform"


def features(tile: Tile, x: float, y: float) -> Iterator[tuple[str, float]]:
    """The nearest trench, step and pillar of those that the tile has, each with its distance in m
    from (x, y) m in the tile's frame; numbered along the way."""
    found = tile.features
    if len(found.trenches):
        away = to_trenches(tile, x)
        yield f"trench {away.argmin() + 1} of {away.size}", float(away.min())
    if len(found.risers):
        away = np.abs(x - found.risers[:, 0])
        yield f"step {away.argmin() + 1} of {away.size}", float(away.min())
    if len(found.pillars):
        away = to_pillars(tile, x, y)
        px, py, _ = found.pillars[away.argmin()]
        yield f"pillar at ({px:.1f}, {py:.1f}) m", float(away.min())


def to_trenches(tile: Tile, x: ArrayLike) -> Array:
    """Distances along the way, in m, from ``x`` (...) m to the k trenches, (..., k)."""
    begin, end = tile.features.trenches.T
    along = np.asarray(x)[..., None]
    return np.asarray(np.maximum(np.maximum(begin - along, along - end), 0.0))


def to_pillars(tile: Tile, x: ArrayLike, y: ArrayLike) -> Array:
    """Distances in m from points (...) to the k pillars, (..., k)."""
    px, py, diameter = tile.features.pillars.T
    away = np.hypot(np.asarray(x)[..., None] - px, np.asarray(y)[..., None] - py)
    return np.asarray(np.maximum(away - 0.5 * diameter, 0.0))


# ---------------------------------------------------------------------------- results


def write(diagnoses: Sequence[Diagnosis], path: str | Path) -> None:
    """Write diagnosis.csv: a row a failed episode, whole or not at all."""
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, [f.name for f in dataclasses.fields(Diagnosis)])
    writer.writeheader()
    writer.writerows(dataclasses.asdict(d) for d in diagnoses)
    with atomic(Path(path)) as partial:
        partial.write_text(text.getvalue(), encoding="utf-8", newline="")


def count_failures(
    diagnoses: Sequence[Mapping[str, Any]], episodes: Sequence[Mapping[str, Any]]
) -> list[dict[str, Any]]:
    """Of each policy and condition its failures: by family and level, and where most is to be won.

    A layer's points are the failures that it is to blame for, in per cent of all episodes.

    Args:
        diagnoses: rows of diagnosis.csv.
        episodes: rows of episodes.csv, failed or not.
    """
    result = []
    for policy, condition in dict.fromkeys((e["policy"], e["condition"]) for e in episodes):
        mine = [d for d in diagnoses if (d["policy"], d["condition"]) == (policy, condition)]
        total = sum((e["policy"], e["condition"]) == (policy, condition) for e in episodes)
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
    """Failures by family and level, their layers and commonest cause, and where most is to be won.

    Args:
        diagnoses: of all failed episodes.
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
                f"most is to be won in {family}, by {layer}: {points:.1f} points of success"
            )
    return "\n".join(lines)
