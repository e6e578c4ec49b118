"""Figures (PNG) from result files, logs and recordings. Nothing here simulates or trains."""

import json
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib

matplotlib.use("Agg")  # no display needed

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator

from tdgc.benchmark import behaviour
from tdgc.benchmark.evaluation import POSE_SECONDS, tile_of
from tdgc.benchmark.recording import Recording, runs_of_equal, spans
from tdgc.benchmark.results import policies_of
from tdgc.files import atomic, read_csv
from tdgc.sim.commands import CONTINUOUS, INDEX, UNITS, gait_index
from tdgc.sim.gaits import FEET, GAITS
from tdgc.sim.robot import Array
from tdgc.sim.tile import TILE_SIZE
from tdgc.tasks.rules import GOAL_RADIUS

# Okabe and Ito's palette, whose colours colour-blind readers can distinguish.
POLICY_COLOURS = {
    "tdgc": "#0072B2", "tdgc-tuned": "#009E73", "gp": "#D55E00", "cues": "#CC79A7",
    "teacher": "#555555", "tdgc-mujoco": "#56B4E9",
}  # fmt: skip
GAIT_COLOURS = ("#56B4E9", "#E69F00", "#009E73", "#CC79A7")
_GROUND = LinearSegmentedColormap.from_list("ground", ["#ffffff", "#707070"])  # low to high

_SECTORS = 24  # of 15 degrees each
_DRAWN = 3  # episodes per family and policy in the figure of trajectories


def _save(figure: Figure, out: Path) -> None:
    try:
        with atomic(out) as partial:
            figure.savefig(partial, dpi=120, format="png")
    finally:
        plt.close(figure)


def _caption(figure: Figure, text: str) -> None:
    """Add a caption below the panels, wrapped to the figure's width."""
    # Letters of 9 points are half as wide as tall: 16 to the inch, less a margin.
    letters = int(14 * figure.get_size_inches()[0])
    figure.supxlabel(textwrap.fill(text, letters), fontsize=9)


# ---------------------------------------------------------------------------- evaluation


class _Run(NamedTuple):
    """A row of episodes.csv, with goal (2,) and track (n, 3) from trajectories.npz."""

    row: dict[str, str]
    goal: Array
    track: Array


def _read(folder: Path) -> list[_Run]:
    """Read the episodes of the first condition in a results folder."""
    rows = read_csv(folder / "episodes.csv")
    with np.load(folder / "trajectories.npz") as data:
        tracks = np.split(data["poses"], np.cumsum(data["counts"])[:-1])
        runs = [_Run(*parts) for parts in zip(rows, data["goals"], tracks, strict=True)]
    return [run for run in runs if run.row["condition"] == rows[0]["condition"]]


def _name_condition(figure: Figure, runs: Sequence[_Run]) -> None:
    """Title a figure with the condition of its episodes, unless that is nominal."""
    condition = runs[0].row["condition"]
    if condition != "nominal":
        figure.suptitle(f"condition {condition}")


def _names(runs: Sequence[_Run], column: str) -> list[str]:
    """Distinct values of a column, in order of appearance."""
    return list(dict.fromkeys(run.row[column] for run in runs))


def _of(runs: Sequence[_Run], policy: str, family: str) -> list[_Run]:
    return [r for r in runs if (r.row["policy"], r.row["family"]) == (policy, family)]


def _panels(rows: int, columns: int, size: tuple[float, float], **more: Any) -> tuple[Figure, Any]:
    """A figure of ``size`` (width, height) in inches with axes (rows, columns)."""
    return plt.subplots(rows, columns, figsize=size, squeeze=False, layout="constrained", **more)


def success_by_level(summary: Path, out: Path) -> None:
    """Plot success with 95 % intervals by level, from summary.json.

    There is a row per condition and a column per family.
    """
    table = policies_of(json.loads(summary.read_text(encoding="utf-8")))
    first = next(iter(table.values()))  # every policy is run in the same cells
    families = {name: [f for f in rates if f != "mean"] for name, rates in first.items()}
    columns = max(map(len, families.values()))
    size = 1.4 + 2.0 * columns, 0.6 + 2.2 * len(families)
    figure, axes = _panels(len(families), columns, size, sharey=True)
    for row, (condition, names) in zip(axes, families.items(), strict=True):
        row[0].set_ylabel(f"{condition}\nsuccess (%)")
        for axis, family in zip(row, names, strict=False):
            for k, (policy, rates) in enumerate(table.items()):
                cells = {int(lv): c for lv, c in rates[condition][family].items() if lv != "mean"}
                middle = np.array([100 * c["rate"] for c in cells.values()])
                ends = np.array([[c["ci_low"], c["ci_high"]] for c in cells.values()]).T * 100
                axis.errorbar(
                    np.array(list(cells)) + 0.16 * (k - 0.5 * (len(table) - 1)),
                    middle,
                    # At 0 and 100 % one end of the interval equals the rate, except for rounding.
                    np.maximum(0.0, [middle - ends[0], ends[1] - middle]),
                    marker="os"[k % 2],
                    markersize=4,
                    capsize=2,
                    label=policy,
                    color=POLICY_COLOURS[policy],
                )
                axis.set_xticks(list(cells))
            axis.set(title=family, xlabel="level", ylim=(-3, 103))
            axis.grid(alpha=0.3)
        for axis in row[len(names) :]:
            axis.set_axis_off()
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right upper")
    _save(figure, out)


def gait_shares(folder: Path, out: Path) -> None:
    """Plot the share of time in each gait by family, with a panel per policy."""
    runs = _read(folder)
    names, families = _names(runs, "policy"), _names(runs, "family")
    size = 1.2 + 4.2 * len(names), 1.2 + 0.45 * len(families)
    figure, axes = _panels(1, len(names), size, sharey=True)
    for axis, policy in zip(axes[0], names, strict=True):
        for y, family in enumerate(families):
            rows = [run.row for run in _of(runs, policy, family)]
            seconds = [float(row["time_s"]) for row in rows]
            shares = [
                100 * np.average([float(row[f"share_{gait}"]) for row in rows], weights=seconds)
                for gait in GAITS
            ]
            ends = np.cumsum(shares)
            axis.barh([y] * len(GAITS), shares, left=ends - shares, color=GAIT_COLOURS)
            for end, share in zip(ends, shares, strict=True):
                if share >= 8.0:  # room for the number
                    axis.text(end - share / 2, y, f"{share:.0f}", ha="center", va="center")
        axis.set_yticks(range(len(families)), families)
        axis.set(title=policy, xlabel="share of the time (%)", xlim=(0, 100))
    axes[0, 0].invert_yaxis()
    patches = [Patch(color=colour) for colour in GAIT_COLOURS]
    figure.legend(patches, GAITS, loc="outside right center")
    _name_condition(figure, runs)
    _save(figure, out)


def heading_to_travel(track: Array) -> Array:
    """``behaviour.heading_to_travel`` while the robot moves, (k,) rad.

    Args:
        track: (n, 3) as in ``tdgc.benchmark.evaluation.Episode``. The last pose is left out,
            because it may come less than ``POSE_SECONDS`` after the one before.
    """
    x, y, yaw = track[:-1].T
    angles = behaviour.heading_to_travel(x, y, yaw, POSE_SECONDS)
    return angles[np.isfinite(angles)]


def headings(folder: Path, out: Path) -> None:
    """Plot headings relative to the direction of travel, by policy (rows) and family (columns)."""
    runs = _read(folder)
    names, families = _names(runs, "policy"), _names(runs, "family")
    size = 0.6 + 2.4 * len(families), 0.7 + 2.5 * len(names)
    figure, axes = _panels(len(names), len(families), size, subplot_kw={"projection": "polar"})
    width = 2 * np.pi / _SECTORS
    edges = np.linspace(-np.pi, np.pi, _SECTORS + 1) + 0.5 * width  # centre a sector straight ahead
    for row, policy in zip(axes, names, strict=True):
        for axis, family in zip(row, families, strict=True):
            angles = np.concatenate(
                [heading_to_travel(run.track) for run in _of(runs, policy, family)]
            )
            shifted = np.where(angles < edges[0], angles + 2 * np.pi, angles)
            counts, _ = np.histogram(shifted, edges)
            shares = 100 * counts / max(1, len(angles))
            axis.bar(
                edges[:-1] + 0.5 * width, shares, width, color=POLICY_COLOURS[policy], alpha=0.8
            )
            axis.set_theta_zero_location("N")
            axis.set_xticks(np.arange(4) * np.pi / 2, ["ahead", "left", "back", "right"])
            axis.tick_params(labelsize=7, pad=-1)
            axis.yaxis.set_major_locator(MaxNLocator(3, integer=True))
            axis.set_rlabel_position(135)
            axis.set_title(f"{policy}, {family}", fontsize=9)
    _name_condition(figure, runs)
    _caption(
        figure,
        "Heading of the body against its direction of travel (up); radius: share of that time (%)",
    )
    _save(figure, out)


def trajectories(folder: Path, out: Path) -> None:
    """Plot the base's path from above on the hardest level of each family.

    There is a row per family, with the first episodes of each policy.
    """
    runs = [run for run in _read(folder) if int(run.row["episode"]) < _DRAWN]
    hardest = {run.row["family"]: 0 for run in runs}
    for run in runs:
        hardest[run.row["family"]] = max(hardest[run.row["family"]], int(run.row["level"]))
    runs = [run for run in runs if int(run.row["level"]) == hardest[run.row["family"]]]
    columns = len(runs) // len(hardest)
    size = 1.6 + 2.1 * columns, 0.9 + 2.3 * len(hardest)
    figure, axes = _panels(len(hardest), columns, size, sharex=True, sharey=True)
    for row, (family, level) in zip(axes, hardest.items(), strict=True):
        mine = [run for run in runs if run.row["family"] == family]
        tiles = [
            tile_of(
                int(run.row["seed"]), family, level, int(run.row["episode"]), run.row["condition"]
            ).heights
            for run in mine
        ]
        low, high = float(np.min(tiles)), float(np.max(tiles))
        for axis, run, heights in zip(row, mine, tiles, strict=True):
            ground = axis.imshow(
                heights.T,
                origin="lower",
                extent=(0, TILE_SIZE, 0, TILE_SIZE),
                cmap=_GROUND,
                vmin=low,
                vmax=high,
            )
            _draw_track(axis, run)
        row[0].set_ylabel(f"{family}, level {level}\ny (m)")
        figure.colorbar(ground, ax=row, label="height (m)", shrink=0.9, pad=0.01)
    for axis in axes[-1]:
        axis.set_xlabel("x (m)")
    axes[0, 0].set(xlim=(0, TILE_SIZE), ylim=(0, TILE_SIZE))
    _name_condition(figure, runs)
    _caption(
        figure,
        "Arrows: heading of the body, once a second. Cross: end of an episode that did not reach "
        "the goal (dashed).",
    )
    _save(figure, out)


def _draw_track(axis: Any, run: _Run) -> None:
    """Draw the base's path, its heading once a second, the goal and the outcome."""
    colour = POLICY_COLOURS[run.row["policy"]]
    white = [withStroke(linewidth=3.5, foreground="white")]
    x, y, yaw = run.track.T
    axis.plot(x, y, color=colour, linewidth=1.6, path_effects=white)
    second = slice(None, None, round(1.0 / POSE_SECONDS))
    axis.quiver(
        x[second], y[second], np.cos(yaw[second]), np.sin(yaw[second]),
        color=colour, scale=14, width=0.012, headwidth=4, zorder=3,
    )  # fmt: skip
    axis.plot(x[0], y[0], "o", color=colour, markersize=5)
    if run.row["outcome"] != "reached":
        axis.plot(x[-1], y[-1], "X", color="black", markersize=7, clip_on=False)
    axis.add_patch(Circle(tuple(run.goal), GOAL_RADIUS, fill=False, linestyle="--"))
    outcome = run.row["outcome"].replace("_", " ")
    axis.set_title(f"{run.row['policy']}: {outcome}, {float(run.row['time_s']):.1f} s", fontsize=8)


# ---------------------------------------------------------------------------- one episode

MEASURED = "#D55E00"
DESIRED = "#B0CDEB"  # desired contact, drawn behind the actual one


def sheet(recording: Recording, out: Path) -> None:
    """Plot one episode over time: gait, contacts (Hildebrand), base height and all commands.

    Measured values are drawn together with their commands; dotted lines are the bounds.
    """
    r = recording
    ends: Array = r.dt * np.arange(1.0, len(r.command) + 1.0)
    standing = r.robot.base_height
    # Gait and contacts, then the four commands with measured values, then the others.
    ratios = [1.7] + [1.0] * 4 + [0.6] * (len(CONTINUOUS) - 4)
    figure, axes = plt.subplots(
        len(ratios), 1, figsize=(12, 13.5), sharex=True, height_ratios=ratios
    )
    figure.subplots_adjust(left=0.11, right=0.985, top=0.965, bottom=0.065, hspace=0.12)
    _draw_contacts(axes[0], r)
    h = INDEX["body_height"]  # added to the standing height
    _draw_command(axes[1], ends, standing + r.command[:, h], standing + r.bounds[h], r.height)
    axes[1].set_ylabel("base height\n(m)")
    rest = [j for j in range(len(CONTINUOUS)) if j != h]
    for axis, j in zip(axes[2:], rest, strict=True):
        measured = r.velocity[:, j] if j < r.velocity.shape[1] else None
        _draw_command(axis, ends, r.command[:, j], r.bounds[j], measured)
        unit = "" if UNITS[j] == "1" else f" ({UNITS[j]})"
        axis.set_ylabel(f"{CONTINUOUS[j].replace('_', ' ')}\n{unit}".strip())
    for axis in axes:
        axis.yaxis.label.set(rotation=0, ha="right", va="center", fontsize=8)
        axis.yaxis.set_label_coords(-0.045, 0.5)
        axis.tick_params(labelsize=7)
        axis.grid(axis="x", alpha=0.3)
    axes[-1].set_xlabel("time (s)", fontsize=8)
    axes[-1].set_xlim(0.0, ends[-1])
    figure.suptitle(f"{r.policy}: {r.ending}   ({r.where}, seed {r.seed})", fontsize=11, y=0.99)
    handles = [
        *(Patch(color=GAIT_COLOURS[g], label=GAITS[g]) for g in np.unique(gait_index(r.command))),
        Patch(color=DESIRED, label="contact desired"),
        Patch(color="black", label="in contact"),
        Line2D([], [], color="black", label="commanded"),
        Line2D([], [], color=MEASURED, label="measured"),
        Line2D([], [], color="0.5", linestyle=":", label="bounds"),
    ]
    figure.legend(handles=handles, loc="lower center", ncols=len(handles), fontsize=8)
    _save(figure, out)


def _draw_contacts(axis: Any, r: Recording) -> None:
    """Draw the gait as a band, and below it a row per foot with desired and actual contact."""
    for a, b, gait in runs_of_equal(gait_index(r.command)):
        axis.broken_barh([(a * r.dt, (b - a) * r.dt)], (-0.75, 0.55), color=GAIT_COLOURS[gait])
    for foot in range(len(FEET)):
        for flags, thick, colour in (
            (r.desired[:, foot], 0.84, DESIRED),
            (r.contact[:, foot], 0.36, "black"),
        ):
            bars = [(a * r.dt, (b - a) * r.dt) for a, b in spans(flags)]
            axis.broken_barh(bars, (foot + 0.5 - thick / 2, thick), color=colour, linewidth=0)
    axis.set_yticks([-0.475, *(np.arange(len(FEET)) + 0.5)], ["gait", *FEET])
    axis.set_ylim(len(FEET), -0.85)


def _draw_command(
    axis: Any, ends: Array, command: Array, bounds: Array, measured: Array | None
) -> None:
    """Draw a command over time, with its bounds and its measured value."""
    for bound in bounds:
        axis.axhline(bound, color="0.5", linestyle=":", linewidth=1)
    seen = [command, bounds]
    if measured is not None:
        axis.plot(ends, measured, color=MEASURED, linewidth=0.9)
        seen.append(measured)
    # A command holds for the whole control step at whose end it was recorded.
    axis.stairs(command, np.append(0.0, ends), baseline=None, color="black", linewidth=1.2)
    bottom, top = min(map(np.min, seen)), max(map(np.max, seen))
    margin = 0.12 * (top - bottom) or 0.1  # a pinned command has one value only
    axis.set_ylim(bottom - margin, top + margin)
    axis.yaxis.set_major_locator(MaxNLocator(2 if measured is None else 4))


# ---------------------------------------------------------------------------- training


def training_curve(log: Path, out: Path) -> None:
    """Plot a run of the low policy: reward, tracking, contact, falls and levels (log.jsonl)."""
    panels: list[tuple[str, dict[str, str] | str]] = [
        ("reward per step", {"reward/total": "total"}),
        ("velocity RMSE (m/s)", {f"tracking/{g}_velocity_rmse": g for g in GAITS}),
        ("yaw rate RMSE (rad/s)", {f"tracking/{g}_yaw_rate_rmse": g for g in GAITS}),
        ("contact as scheduled", {f"tracking/{g}_contact_match": g for g in GAITS}),
        ("falls per minute", {"falls_per_minute": "all"}),
        ("terrain level", "level/{}"),
    ]
    _curves(log, out, panels, "million control steps")


def decision_curve(log: Path, out: Path) -> None:
    """Plot a run of the high policy: reward, success, levels and pronk by family (log.jsonl).

    A dotted line marks the end of imitation. Until then, success is that of the episodes that the
    teacher does not drive.
    """
    panels: list[tuple[str, dict[str, str] | str]] = [
        ("reward per decision", {"reward/total": "total"}),
        ("success", "success/{}"),
        ("level", "level/{}"),
        ("share of decisions in pronk", "gait/{}_pronk"),
    ]
    _curves(log, out, panels, "million decisions")


def ablation(table: Path, out: Path) -> None:
    """Plot the success of each variant with 95 % intervals, from ablation.json.

    If a variant has several seeds, each is a dot. If ``full`` is among the variants, a dotted line
    marks its success for comparison.
    """
    every: list[dict[str, Any]] = json.loads(table.read_text(encoding="utf-8"))["rows"]
    rows = [row for row in every if "n" in row]
    height = 1.0 + 0.3 * max(len(rows), 1)
    figure, axis = plt.subplots(figsize=(7.5, height), layout="constrained")
    for y, row in enumerate(rows):
        rate, low, high = (100 * row[key] for key in ("rate", "ci_low", "ci_high"))
        ends = [[max(0.0, rate - low)], [max(0.0, high - rate)]]
        axis.barh(y, rate, xerr=ends, capsize=2, color=POLICY_COLOURS["tdgc"], alpha=0.6)
        if len(row["seeds"]) > 1:
            axis.plot([100 * r for r in row["seeds"].values()], [y] * len(row["seeds"]), "k.")
        if row["name"] == "full":
            axis.axvline(rate, color="0.5", linestyle=":")
    axis.set_yticks(range(len(rows)), [f"{row['name']}: {row['what']}" for row in rows], fontsize=8)
    axis.invert_yaxis()
    axis.set(xlabel="success (%)", xlim=(0, 100))
    axis.grid(alpha=0.3, axis="x")
    _save(figure, out)


def _curves(
    log: Path, out: Path, panels: Sequence[tuple[str, dict[str, str] | str]], unit: str
) -> None:
    """Plot panels of log values against steps.

    Args:
        log: rows of JSON.
        out: the figure's file.
        panels: (title, {key of a row: label}) each; instead of the dict, a key with {} stands for
            one curve per family of the run.
        unit: label of the x axis.
    """
    rows = [json.loads(line) for line in log.read_text(encoding="utf-8").splitlines()]
    keys = dict.fromkeys(key for row in rows for key in row if key.startswith("level/"))
    families = [key.removeprefix("level/") for key in keys]
    columns = (len(panels) + 1) // 2
    figure, axes = plt.subplots(2, columns, figsize=(12, 6), sharex=True, layout="constrained")
    imitated = [row["steps"] / 1e6 for row in rows if "train/imitation_loss" in row]
    for axis, (title, series) in zip(axes.ravel(), panels, strict=True):
        if isinstance(series, str):
            series = {series.format(family): family for family in families}
        for key, label in series.items():
            points = [(row["steps"] / 1e6, row[key]) for row in rows if key in row]
            if points:
                axis.plot(*zip(*points, strict=True), label=label)
        if len(axis.lines) > 1:
            axis.legend(fontsize=7)
        if imitated:
            axis.axvline(imitated[-1], color="0.5", linestyle=":")
        axis.set_title(title)
        axis.grid(alpha=0.3)
    for axis in axes[1]:
        axis.set_xlabel(unit)
    _save(figure, out)
