"""Results: episodes -> rates with their intervals, and the files of a results folder."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tdgc.benchmark.evaluation import Episode


def wilson_interval(reached: int, n: int, z: float = 1.959964) -> tuple[float, float]:
    """Wilson score interval of a rate, 95 % by default (Wilson 1927)."""
    if not 0 <= reached <= n or n < 1:
        raise ValueError(f"need 0 <= reached <= n and n >= 1, not {reached} of {n}")
    rate = reached / n
    centre = (rate + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * np.sqrt(rate * (1 - rate) / n + z * z / (4 * n * n))
    return max(0.0, float(centre - half)), min(1.0, float(centre + half))


def success(rows: Sequence[Episode]) -> dict[str, float]:
    """How many episodes reached the goal: n, reached, rate, and its interval ci_low, ci_high."""
    n, reached = len(rows), sum(e.outcome == "reached" for e in rows)
    low, high = wilson_interval(reached, n)
    return {"n": n, "reached": reached, "rate": reached / n, "ci_low": low, "ci_high": high}


def summarise(episodes: Iterable[Episode]) -> dict[str, Any]:
    """summary.json: policy -> condition -> family -> level -> rates, and means.

    Beside the levels of a family stands ``"mean"`` over them, beside the families ``"mean"`` over
    all; cells are equally large, so these are means over cells too.
    """
    tree: dict[str, Any] = {}
    for e in episodes:
        families = tree.setdefault(e.policy, {}).setdefault(e.condition, {})
        families.setdefault(e.family, {}).setdefault(str(e.level), []).append(e)
    for conditions in tree.values():
        for families in conditions.values():
            everything: list[Episode] = []
            for levels in families.values():
                rows = [e for level in levels.values() for e in level]
                everything += rows
                for level, some in levels.items():
                    levels[level] = success(some)
                levels["mean"] = success(rows)
            families["mean"] = success(everything)
    return tree


def write_results(folder: Path, episodes: Sequence[Episode]) -> dict[str, Any]:
    """Write episodes.csv, summary.json and trajectories.npz into ``folder``; returns the summary.

    trajectories.npz holds the tracks in the order of episodes.csv: ``poses`` (N, 3), those of all
    episodes one after another, ``counts`` (E,), how many are each one's, and ``goals`` (E, 2).
    """
    with open(folder / "episodes.csv", "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(episodes[0].row()))
        writer.writeheader()
        writer.writerows(e.row() for e in episodes)
    np.savez_compressed(
        folder / "trajectories.npz",
        poses=np.concatenate([e.track for e in episodes]).astype(np.float32),
        counts=np.array([len(e.track) for e in episodes], dtype=np.int32),
        goals=np.array([e.goal for e in episodes], dtype=np.float32),
    )
    summary = summarise(episodes)
    (folder / "summary.json").write_text(json.dumps(summary, indent=2), encoding="utf-8")
    return summary
