#!/usr/bin/env python3
"""Evaluate policies on TDGC-Bench: a table, episodes.csv, summary.json, figures and a report.

python evaluate.py --levels 6-10
python evaluate.py --tracking
python evaluate.py --policies gp --families stair,gap --levels 8 --episodes 20 --out runs/eval
python evaluate.py --trace failed
python evaluate.py --video 2
python evaluate.py --gui watch --families stair --levels 6
python evaluate.py --set decoder.vx.high=0.6 --set safety.max_tilt=0.5
"""

from __future__ import annotations

import argparse
import functools
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tqdm import tqdm

from tdgc.benchmark import diagnosis, tuning
from tdgc.benchmark.diagnosis import Diagnosis, diagnose
from tdgc.benchmark.drivers import BaselineDriver, Driver, HierarchyDriver, TeacherDriver, load_high
from tdgc.benchmark.evaluation import (
    CONDITIONS,
    Cell,
    Episode,
    low_config,
    plan,
    run_cell,
    spread,
)
from tdgc.benchmark.recording import Recorder, Recording, Together
from tdgc.benchmark.results import write_results
from tdgc.benchmark.trace import Selection, Trace, Tracer, check_installed, write
from tdgc.benchmark.tracking import tracking
from tdgc.benchmark.tuning import TunedDriver, Tuning
from tdgc.config import ConfigError, LowLevelConfig
from tdgc.parallel import cluster
from tdgc.parallel.cluster import CLUSTER_HELP
from tdgc.parallel.cores import usable_cores, workers_flag
from tdgc.parallel.worker import WorkerError
from tdgc.policies import Policy
from tdgc.show import film, gui, plots, report
from tdgc.sim.geometry import read_geometry
from tdgc.sim.terrain import ALL_FAMILIES, FAMILIES, MAP_ENDING, OOD_LEVELS, height_map, is_map
from tdgc.sim.world import WindowError
from tdgc.tasks.high_env import PRETRAINED, load_low
from tdgc.tasks.teacher import STYLES

POLICIES = ("tdgc", "gp")
TEACHER = "teacher"
TUNED = "tdgc-tuned"  # beside "tdgc" where there is a tuning
SHIPPED_HIGH = PRETRAINED / "high"


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--levels", default="6-10", help="e.g. 6-10 or 0,5,10 (6-10)")
    parser.add_argument(
        "--families",
        default="all",
        help=f"all, or of {', '.join(ALL_FAMILIES)} and files of heights, FILE{MAP_ENDING}",
    )
    parser.add_argument("--episodes", type=int, default=100, help="a cell (100)")
    parser.add_argument(
        "--policies",
        help="all, or of tdgc (the hierarchy), gp (the scripted baseline) and teacher (the script "
        "that tdgc imitated first, which is told where everything is; not among all); all where "
        "there is a high level, shipped or given by --high, and otherwise gp",
    )
    parser.add_argument(
        "--conditions", default="nominal", help=f"all, or of {', '.join(CONDITIONS)} (nominal)"
    )
    parser.add_argument("--low", type=Path, default=PRETRAINED / "low", help="low-level policy")
    parser.add_argument("--high", type=Path, help="high-level policy (the shipped one)")
    parser.add_argument("--tracking", action="store_true", help="the low level alone, on the plane")
    parser.add_argument(
        "--trace",
        metavar="WHICH",
        help="trace decisions and diagnose failures; write the traces of all episodes, of those "
        "that failed, or of the first N of each cell: all, failed or N",
    )
    parser.add_argument("--tune", type=Path, metavar="FILE", help="tuning to compare with none")
    parser.add_argument(
        "--set",
        dest="assignments",
        metavar="KEY=VALUE",
        action="append",
        default=[],
        help="change the tuning, e.g. decoder.vx.high=0.6; may be repeated",
    )
    parser.add_argument(
        "--video",
        type=int,
        nargs="?",
        const=1,
        default=0,
        metavar="N",
        help="films, sheets and strips of the first N episodes of each cell (1)",
    )
    parser.add_argument(
        "--gui",
        nargs="?",
        const="drive",
        choices=gui.MODES,
        help="Bullet's window instead of a table, on the first tile of the first family and level: "
        "drive the low level with sliders (drive), or watch the first policy decide (watch)",
    )
    parser.add_argument("--seed", type=int, default=0, help="of the evaluation's tiles (0)")
    parser.add_argument(
        "--workers", type=workers_flag, default="auto", metavar="N", help="processes (one a core)"
    )
    parser.add_argument("--cluster", metavar="ADDRESS", help=CLUSTER_HELP)
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


def load_tuning(args: argparse.Namespace) -> Tuning | None:
    """The tuning that ``--tune`` and ``--set`` ask for, None without either.

    Raises:
        ValueError: one that cannot be read.
    """
    if args.tune is None and not args.assignments:
        return None
    return tuning.load(args.tune, args.assignments)


def make_drivers(
    names: list[str],
    high: Path | None,
    low: Policy,
    config: LowLevelConfig,
    tuned: Tuning | None = None,
) -> dict[str, Driver]:
    """What drives the robots of each policy asked for, and of the tuned one after ``tdgc``.

    Raises:
        ValueError: no high level, one that does not fit the low level, or a tuning that fits
            neither.
    """
    if tuned is not None and "tdgc" not in names:
        raise ValueError("--tune and --set change tdgc, which is not among the policies")
    drivers: dict[str, Driver] = {}
    for name in names:
        if name == "gp":
            drivers[name] = BaselineDriver()
        elif name == TEACHER:
            drivers[name] = TeacherDriver(low, config)
        elif high is None:
            raise ValueError("no high level is shipped; give one with --high, or use --policies gp")
        else:
            pair = load_high(high, low, config)
            drivers[name] = HierarchyDriver(*pair)
            if tuned is not None:
                drivers[TUNED] = TunedDriver(*pair, config, tuned)
    return drivers


def run_one(
    cell: Cell,
    low: Policy,
    drivers: Mapping[str, Driver],
    seed: int,
    filmed: int,
    traced: Selection | None,
) -> tuple[list[Episode], list[Recording], list[Diagnosis], list[Trace]]:
    """A batch, with recordings of the cell's first ``filmed`` episodes; with ``traced`` also its
    diagnoses and the chosen traces. It writes nothing: it may run on another machine."""
    driver = drivers[cell.policy]
    recorder = Recorder(driver, seed, filmed)
    if traced is None:
        return run_cell(cell, low, driver, seed, recorder), recorder.recordings(), [], []
    tracer = Tracer(driver, seed)
    episodes = run_cell(cell, low, driver, seed, Together([tracer, recorder]))
    traces = tracer.traces()
    chosen = [trace for trace in traces if traced.includes(trace)]
    hips = float(read_geometry(low_config(low).robot).hips[0, 0])
    diagnoses = [diagnose(trace, hips) for trace in traces if trace.outcome != "reached"]
    return episodes, recorder.recordings(), diagnoses, chosen


def print_table(summary: dict[str, Any]) -> None:
    """Rates with intervals: a line a family and level, the means below."""
    for policy, conditions in summary.items():
        for condition, families in conditions.items():
            print(f"\n{policy}, {condition}")
            names = [f for f in families if f != "mean"]
            levels = list(families[names[0]])
            wide = max(8, *(len(name) + 1 for name in names))
            print("family".ljust(wide) + "".join(f"{level:>8}" for level in levels))
            for name in names:
                cells = "".join(f"{100 * families[name][lv]['rate']:7.1f}%" for lv in levels)
                print(name.ljust(wide) + cells)
            mean = families["mean"]
            rate, low, high = (100 * mean[key] for key in ("rate", "ci_low", "ci_high"))
            print(f"{'mean'.ljust(wide)}{rate:.1f} %  [{low:.1f}, {high:.1f}]  n={mean['n']}")


def run_tracking(low: Policy, args: argparse.Namespace) -> int:
    share_out = spread if args.cluster is None else cluster.spread
    result = tracking(low, args.episodes, args.seed, args.workers, share_out)
    (args.out / "tracking.json").write_text(json.dumps(result, indent=2), encoding="utf-8")
    print("gait    velocity RMSE  yaw rate RMSE  contact match")
    for gait, r in result["gaits"].items():
        print(
            f"{gait:<8}{r['velocity_rmse']:9.3f} m/s{r['yaw_rate_rmse']:9.3f} rad/s"
            f"{100 * r['contact_match']:13.1f} %"
        )
    print(f"{result['falls_per_10_min']:.2f} falls in 10 minutes ({result['minutes']:.1f} walked)")
    return 0


def print_effect(effect: dict[str, Any]) -> None:
    """What a tuning changed: success, speed and energy beside those without it."""
    for condition, found in effect.items():
        print(f"\nwhat the tuning changes, {condition}")
        print("policy       success       speed      energy")
        for policy in ("tdgc", TUNED):
            rates = found[policy]
            energy = rates["energy_per_metre"]
            cost = "-" if energy is None else f"{energy:.0f} J/m"
            speed = f"{rates['mean_speed']:.2f} m/s"
            print(f"{policy:<12}{100 * rates['rate']:6.1f} %{speed:>12}{cost:>12}")
        print(f"of {found['tdgc']['n']} episodes {found['gained']} gained, {found['lost']} lost")


def prepare(folder: Path, traced: bool, filmed: bool) -> None:
    """Make room for results: what an earlier run left and this one may not write goes away."""
    films = (old for kind in ("film", "sheet", "strip") for old in folder.glob(f"films/{kind}_*"))
    others = (folder / name for name in ("diagnosis.csv", "tuning.json", report.NAME))
    for old in (*folder.glob("traces/*.parquet"), *films, *others):
        old.unlink(missing_ok=True)
    if filmed:
        (folder / "films").mkdir(exist_ok=True)
    if traced:
        (folder / "traces").mkdir(exist_ok=True)


def run_table(
    low: Policy,
    drivers: Mapping[str, Driver],
    cells: list[Cell],
    args: argparse.Namespace,
    traced: Selection | None = None,
    tuned: Tuning | None = None,
) -> int:
    """Run all cells and write everything; the exit status, 1 where a film or report is missing."""
    work = functools.partial(
        run_one, low=low, drivers=drivers, seed=args.seed, filmed=args.video, traced=traced
    )
    share_out = spread if args.cluster is None else cluster.spread
    episodes: list[Episode] = []
    recordings: list[Recording] = []
    diagnoses: list[Diagnosis] = []
    with tqdm(total=sum(c.count for c in cells), unit="episode", dynamic_ncols=True) as bar:
        for rows, recorded, failures, traces in share_out(work, cells, args.workers):
            for trace in traces:
                write(trace, args.out / "traces")
            episodes += rows
            recordings += recorded
            diagnoses += failures
            bar.update(len(rows))
    summary = write_results(args.out, episodes)
    plots.success_by_level(args.out / "summary.json", args.out / "success.png")
    plots.gait_shares(args.out, args.out / "gaits.png")
    plots.headings(args.out, args.out / "headings.png")
    plots.trajectories(args.out, args.out / "trajectories.png")
    print_table(summary)
    if traced is not None:
        diagnosis.write(diagnoses, args.out / "diagnosis.csv")
        print(f"\n{diagnosis.describe(diagnoses, episodes)}")
    if tuned is not None:
        effect = tuning.compare(episodes, "tdgc", TUNED)
        result = {"tuning": tuning.record(tuned), "effect": effect}
        (args.out / "tuning.json").write_text(json.dumps(result, indent=2), encoding="utf-8")
        print_effect(effect)
    print(f"\ntables and figures are in {args.out}")
    painters = args.workers if args.cluster is None else usable_cores()
    problems = film.produce(recordings, args.out / "films", painters) if recordings else []
    try:
        print(f"all of it on one page: {report.write(args.out)}")
    except OSError as error:
        problems.append(f"no {report.NAME}: {error}")
    for problem in problems:
        print(f"evaluate.py: {problem}", file=sys.stderr)
    return 1 if problems else 0


def run_gui(
    low: Policy, drivers: Mapping[str, Driver], cell: Cell, args: argparse.Namespace
) -> int:
    try:
        if args.gui == "drive":
            gui.drive(low, cell, args.seed)
        else:
            gui.watch(low, drivers[cell.policy], cell, args.seed)
    except WindowError as error:
        print(f"evaluate.py: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        pass  # as good an end as closing the window
    return 0


def main(arguments: list[str] | None = None) -> int:
    args = parse(arguments)
    shipped = SHIPPED_HIGH.with_suffix(".json").is_file()
    high = args.high or (SHIPPED_HIGH if shipped else None)
    try:
        levels = choose_levels(args.levels)
        maps = tuple(name for name in args.families.split(",") if is_map(name))
        families = choose(args.families, (*ALL_FAMILIES, *maps), FAMILIES, "family")
        for name in maps:
            height_map(name)
        default = "gp" if high is None else "all"
        names = choose(args.policies or default, (*POLICIES, TEACHER), POLICIES, "policy")
        conditions = choose(args.conditions, tuple(CONDITIONS), tuple(CONDITIONS), "condition")
        met = (*families, *(name for name in conditions if name in ALL_FAMILIES))
        if TEACHER in names and not set(met) <= set(STYLES):
            strange = next(name for name in met if name not in STYLES)
            known = ", ".join(STYLES)
            raise ValueError(f"the {TEACHER} knows {known}; it cannot lead on {strange}")
        if args.gui is not None and args.cluster is not None:
            raise ValueError("--gui shows a robot of this machine: no --cluster")
        cores = usable_cores() if args.cluster is None else cluster.connect(args.cluster)
        if args.workers == "auto":
            args.workers = cores
        for flag, value in (("--episodes", args.episodes), ("--workers", args.workers)):
            if value < 1:
                raise ValueError(f"{flag} must be at least 1, not {value}")
        if not 0 <= args.seed < 2**32:
            raise ValueError(f"--seed must lie in [0, 2**32), not {args.seed}")
        traced = Selection.parse(args.trace) if args.trace is not None else None
        if traced is not None:
            check_installed()
        tuned = load_tuning(args)
        if not 0 <= args.video <= args.episodes:
            raise ValueError(f"--video must lie in [0, --episodes], not {args.video}")
        if args.gui is not None and (args.tracking or args.video or traced is not None):
            raise ValueError("--gui is only to be looked at: no --tracking, --trace or --video")
        if args.tracking and args.video:
            raise ValueError("--tracking has no episodes to film: no --video")
        if args.tracking and (traced is not None or tuned is not None):
            raise ValueError("--tracking is of the low level alone: no --trace, --tune or --set")
        low, config = load_low(args.low)
        read_geometry(config.robot)  # before the results of an earlier call are removed
        drivers = {} if args.tracking else make_drivers(names, high, low, config, tuned)
        args.out.mkdir(parents=True, exist_ok=True)
        if not args.tracking and args.gui is None:
            prepare(args.out, traced is not None, args.video > 0)
    except (ValueError, OSError) as error:
        print(f"evaluate.py: {error}", file=sys.stderr)
        return 2
    if args.gui is not None:
        first = Cell(next(iter(drivers)), "nominal", families[0], levels[0], 0, 1)
        return run_gui(low, drivers, first, args)
    try:
        if args.tracking:
            return run_tracking(low, args)
        cells = plan(list(drivers), conditions, families, levels, args.episodes)
        return run_table(low, drivers, cells, args, traced, tuned)
    except ConfigError as error:  # a robot that Bullet cannot load
        print(f"evaluate.py: {error}", file=sys.stderr)
        return 2
    except WorkerError as error:
        print(f"evaluate.py: {error}", file=sys.stderr)
        return 1


if __name__ == "__main__":
    sys.exit(main())
