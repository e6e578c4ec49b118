"""Figures from files: rows and logs in, PNG out. Nothing here simulates or trains."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")  # no display needed

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from tdgc.gaits import GAITS

_COLOURS = {"tdgc": "tab:blue", "gp": "tab:orange"}


def _save(figure: Figure, out: Path) -> None:
    figure.tight_layout()
    figure.savefig(out, dpi=120)
    plt.close(figure)


def success_by_level(summary: Path, out: Path) -> None:
    """Success by family and level with 95 % intervals, one panel a family (summary.json)."""
    table: dict[str, Any] = json.loads(summary.read_text(encoding="utf-8"))
    panels = [
        (policy, condition, family)
        for policy, conditions in table.items()
        for condition, families in conditions.items()
        for family in families
        if family != "mean"
    ]
    names = list(dict.fromkeys(family for _, _, family in panels))
    figure, axes = plt.subplots(
        1, len(names), figsize=(2.6 * len(names) + 0.6, 2.9), sharey=True, squeeze=False
    )
    for axis, name in zip(axes[0], names, strict=True):
        for policy, condition, family in panels:
            if family != name:
                continue
            cells = {k: v for k, v in table[policy][condition][family].items() if k != "mean"}
            levels = [int(k) for k in cells]
            rates = [100 * c["rate"] for c in cells.values()]
            # max: at 0 and 100 % an end of the interval is the rate, but for rounding.
            below = [100 * max(0.0, c["rate"] - c["ci_low"]) for c in cells.values()]
            above = [100 * max(0.0, c["ci_high"] - c["rate"]) for c in cells.values()]
            label = policy if condition == "nominal" else f"{policy}, {condition}"
            colour = _COLOURS.get(policy) if condition == "nominal" else None
            axis.errorbar(
                levels, rates, [below, above], marker="o", capsize=2, label=label, color=colour
            )
        axis.set_title(name)
        axis.set_xlabel("level")
        axis.grid(alpha=0.3)
        axis.set_ylim(-3, 103)
    axes[0, 0].set_ylabel("success (%)")
    axes[0, -1].legend(fontsize=7)
    _save(figure, out)


def training_curve(log: Path, out: Path) -> None:
    """The low level's run: reward, tracking and contact by gait, terrain levels (log.jsonl)."""
    rows = [json.loads(line) for line in log.read_text(encoding="utf-8").splitlines()]
    steps = [row["steps"] / 1e6 for row in rows]

    def draw(axis: Any, key: str, label: str) -> None:
        points = [(s, row[key]) for s, row in zip(steps, rows, strict=True) if key in row]
        if points:
            axis.plot(*zip(*points, strict=True), label=label)

    figure, axes = plt.subplots(2, 3, figsize=(12, 6), sharex=True)
    panels = [
        ("reward a step", [("reward/total", "total")]),
        ("velocity RMSE (m/s)", [(f"tracking/{g}_velocity_rmse", g) for g in GAITS]),
        ("yaw rate RMSE (rad/s)", [(f"tracking/{g}_yaw_rate_rmse", g) for g in GAITS]),
        ("contact as desired", [(f"tracking/{g}_contact_match", g) for g in GAITS]),
        ("falls a minute", [("falls_per_minute", "all")]),
        ("terrain level", [(k, k[6:]) for k in rows[-1] if k.startswith("level/")]),
    ]
    for axis, (title, series) in zip(axes.ravel(), panels, strict=True):
        for key, label in series:
            draw(axis, key, label)
        axis.set_title(title)
        axis.grid(alpha=0.3)
        if len(series) > 1:
            axis.legend(fontsize=7)
    for axis in axes[1]:
        axis.set_xlabel("million control steps")
    _save(figure, out)
