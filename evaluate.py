#!/usr/bin/env python3
"""Evaluate policies on TDGC-Bench: a table, episodes.csv, summary.json and figures.

python evaluate.py --levels 6-10
python evaluate.py --tracking
python evaluate.py --policies gp --families stair,gap --levels 8 --episodes 20 --out runs/eval
"""

from __future__ import annotations

import argparse
import functools
import json
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tqdm import tqdm

from tdgc import plots
from tdgc.config import LowLevelConfig
from tdgc.drivers import BaselineDriver, Driver, HierarchyDriver, load_high
from tdgc.evaluation import (
    CONDITIONS,
    Cell,
    Episode,
    plan,
    run_cell,
    spread,
    tracking,
    write_results,
)
from tdgc.high_env import PRETRAINED, load_low
from tdgc.policies import Policy
from tdgc.terrain import ALL_FAMILIES, FAMILIES, OOD_LEVELS

POLICIES = ("tdgc", "gp")
SHIPPED_HIGH = PRETRAINED / "high"


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--levels", default="6-10", help="e.g. 6-10 or 0,5,10 (6-10)")
    parser.add_argument("--families", default="all", help=f"all, or of {', '.join(ALL_FAMILIES)}")
    parser.add_argument("--episodes", type=int, default=100, help="a cell (100)")
    parser.add_argument(
        "--policies",
        help="all, or of tdgc (the hierarchy), gp (the scripted baseline); all where there is a "
        "high level, shipped or given by --high, and otherwise gp",
    )
    parser.add_argument(
        "--conditions", default="nominal", help=f"all, or of {', '.join(CONDITIONS)} (nominal)"
    )
    parser.add_argument("--low", type=Path, default=PRETRAINED / "low", help="low-level policy")
    parser.add_argument("--high", type=Path, help="high-level policy (the shipped one)")
    parser.add_argument("--tracking", action="store_true", help="the low level alone, on the plane")
    parser.add_argument("--seed", type=int, default=0, help="of the evaluation's tiles (0)")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes")
    parser.add_argument("--out", type=Path, default=Path("runs/evaluation"), help="results folder")
    return parser.parse_args(arguments)


def choose(
    text: str, allowed: tuple[str, ...], everything: tuple[str, ...], what: str
) -> list[str]:
    """The names in a comma-separated flag; ``all`` stands for ``everything``."""
    names = list(everything) if text == "all" else text.split(",")
    for name in names:
        if name not in allowed:
            raise ValueError(f"unknown {what} '{name}'; allowed: all, {', '.join(allowed)}")
        if names.count(name) > 1:
            raise ValueError(f"{what} '{name}' is named twice")
    return names


def choose_levels(text: str) -> list[int]:
    """``6-10`` or ``0,5,10`` as a list of levels.

    Raises:
        ValueError: not numbers, outside 0-12, or one of them twice.
    """
    levels: list[int] = []
    for part in text.split(","):
        first, _, last = part.partition("-")
        try:
            levels += range(int(first), int(last or first) + 1)
        except ValueError as error:
            raise ValueError(f"cannot read --levels '{text}'; write e.g. 6-10 or 0,5,10") from error
    top = OOD_LEVELS[-1]
    if not levels or min(levels) < 0 or max(levels) > top:
        raise ValueError(f"--levels '{text}' must name levels from 0 to {top}")
    if len(set(levels)) < len(levels):
        raise ValueError(f"--levels '{text}' names a level twice")
    return levels


def make_drivers(
    names: list[str], high: Path | None, low: Policy, config: LowLevelConfig
) -> dict[str, Driver]:
    """What drives the robots of each policy asked for.

    Raises:
        ValueError: no high level, or one that does not fit the low level.
    """
    drivers: dict[str, Driver] = {}
    for name in names:
        if name == "gp":
            drivers[name] = BaselineDriver()
        elif high is None:
            raise ValueError("no high level is shipped; give one with --high, or use --policies gp")
        else:
            drivers[name] = HierarchyDriver(*load_high(high, low, config))
    return drivers


def run_one(cell: Cell, low: Policy, drivers: Mapping[str, Driver], seed: int) -> list[Episode]:
    return run_cell(cell, low, drivers[cell.policy], seed)


def print_table(summary: dict[str, Any]) -> None:
    """Rates with intervals: a line a family and level, the means below."""
    for policy, conditions in summary.items():
        for condition, families in conditions.items():
            print(f"\n{policy}, {condition}")
            names = [f for f in families if f != "mean"]
            levels = list(families[names[0]])
            print("family  " + "".join(f"{level:>8}" for level in levels))
            for name in names:
                cells = "".join(f"{100 * families[name][lv]['rate']:7.1f}%" for lv in levels)
                print(f"{name:<8}{cells}")
            mean = families["mean"]
            low, high = 100 * mean["ci_low"], 100 * mean["ci_high"]
            print(f"mean    {100 * mean['rate']:.1f} %  [{low:.1f}, {high:.1f}]  n={mean['n']}")


def run_tracking(low: Policy, args: argparse.Namespace) -> None:
    result = tracking(low, args.episodes, args.seed, args.workers)
    (args.out / "tracking.json").write_text(json.dumps(result, indent=2), encoding="utf-8")
    print("gait    velocity RMSE  yaw rate RMSE  contact match")
    for gait, r in result["gaits"].items():
        print(
            f"{gait:<8}{r['velocity_rmse']:9.3f} m/s{r['yaw_rate_rmse']:9.3f} rad/s"
            f"{100 * r['contact_match']:13.1f} %"
        )
    print(f"{result['falls_per_10_min']:.2f} falls in 10 minutes ({result['minutes']:.1f} walked)")


def run_table(
    low: Policy, drivers: Mapping[str, Driver], cells: list[Cell], args: argparse.Namespace
) -> None:
    work = functools.partial(run_one, low=low, drivers=drivers, seed=args.seed)
    episodes: list[Episode] = []
    with tqdm(total=sum(c.count for c in cells), unit="episode", dynamic_ncols=True) as bar:
        for rows in spread(work, cells, args.workers):
            episodes += rows
            bar.update(len(rows))
    summary = write_results(args.out, episodes)
    plots.success_by_level(args.out / "summary.json", args.out / "success.png")
    plots.gait_shares(args.out, args.out / "gaits.png")
    plots.headings(args.out, args.out / "headings.png")
    plots.trajectories(args.out, args.out / "trajectories.png")
    print_table(summary)
    print(f"\ntables and figures are in {args.out}")


def main(arguments: list[str] | None = None) -> int:
    args = parse(arguments)
    shipped = SHIPPED_HIGH.with_suffix(".json").is_file()
    high = args.high or (SHIPPED_HIGH if shipped else None)
    try:
        levels = choose_levels(args.levels)
        families = choose(args.families, ALL_FAMILIES, FAMILIES, "family")
        default = "gp" if high is None else "all"
        names = choose(args.policies or default, POLICIES, POLICIES, "policy")
        conditions = choose(args.conditions, tuple(CONDITIONS), tuple(CONDITIONS), "condition")
        for flag, value in (("--episodes", args.episodes), ("--workers", args.workers)):
            if value < 1:
                raise ValueError(f"{flag} must be at least 1, not {value}")
        if not 0 <= args.seed < 2**32:
            raise ValueError(f"--seed must lie in [0, 2**32), not {args.seed}")
        low, config = load_low(args.low)
        drivers = {} if args.tracking else make_drivers(names, high, low, config)
        args.out.mkdir(parents=True, exist_ok=True)
    except (ValueError, OSError) as error:
        print(f"evaluate.py: {error}", file=sys.stderr)
        return 2
    if args.tracking:
        run_tracking(low, args)
    else:
        run_table(low, drivers, plan(names, conditions, families, levels, args.episodes), args)
    return 0


if __name__ == "__main__":
    sys.exit(main())
