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

import argparse
import functools
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from tdgc.benchmark import behaviour, diagnosis, tuning
from tdgc.benchmark.behaviour import Behaviour
from tdgc.benchmark.cues import CuesLaw
from tdgc.benchmark.diagnosis import Diagnosis, diagnose
from tdgc.benchmark.drivers import BaselineDriver, Driver, HierarchyDriver, TeacherDriver, load_high
from tdgc.benchmark.evaluation import CONDITIONS, Cell, Episode, plan, run_cell
from tdgc.benchmark.flags import add_arguments, choose, resolve
from tdgc.benchmark.recording import Recorder, Recording
from tdgc.benchmark.results import (
    EDITIONS,
    ROBOT,
    Training,
    describe,
    editions_of,
    make_room,
    robot_changes,
    salvage,
    write_results,
)
from tdgc.benchmark.trace import Selection, Trace, Tracer, write
from tdgc.benchmark.tracking import tracking
from tdgc.benchmark.tuning import TunedDriver, Tuning
from tdgc.config import HighLevelConfig, LowLevelConfig
from tdgc.errors import require, script
from tdgc.files import make_folder, write_csv, write_json
from tdgc.parallel import cluster
from tdgc.parallel.cluster import CLUSTER_HELP
from tdgc.parallel.cores import usable_cores
from tdgc.parallel.jobs import RunJobs, run_jobs
from tdgc.policies import Policy
from tdgc.show import film, gui, plots, report
from tdgc.sim.bullet_world import BulletWorld
from tdgc.sim.geometry import read_geometry
from tdgc.tasks.leaps import measure_landing
from tdgc.tasks.manners import find_manner, manner_of, within
from tdgc.tasks.pairing import PRETRAINED, MisfitError, load_low, mdp_of
from tdgc.tasks.teacher import Skill

POLICIES = ("tdgc", "gp")
TEACHER = "teacher"
CUES = "cues"
ALL_POLICIES = (*POLICIES, CUES, TEACHER)
_LOW_ALONE = ("tracking", "drive")  # modes without a driver
TUNED = "tdgc-tuned"  # evaluated beside "tdgc" if there is a tuning
SHIPPED_HIGH = PRETRAINED / "high"


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    groups = add_arguments(parser, "runs/evaluation")
    groups.episodes.add_argument(
        "--conditions", help=f"all, or comma-separated: {', '.join(CONDITIONS)} (nominal)"
    )
    who = groups.policies
    who.add_argument(
        "--policies",
        help="comma-separated: tdgc (the hierarchy), gp (the scripted baseline), cues (a script "
        "that sees what tdgc sees), teacher (the teacher of train_high.py, which knows the heights "
        "of the tile); all means tdgc,gp (all)",
    )
    who.add_argument(
        "--low", type=Path, default=PRETRAINED / "low", help="low policy (the shipped one)"
    )
    who.add_argument("--high", type=Path, help="high policy (the shipped one)")
    who.add_argument(
        "--tune", type=Path, metavar="FILE", help="tuning to compare with the original"
    )
    who.add_argument(
        "--set",
        dest="assignments",
        metavar="KEY=VALUE",
        action="append",
        default=[],
        help="change the tuning, e.g. decoder.vx.high=0.6; may be repeated",
    )
    look = groups.looked_at.add_argument
    look("--tracking", action="store_true", help="measure the low policy alone, on a plane")
    look(
        "--trace",
        metavar="WHICH",
        help="trace decisions and diagnose failures; write the traces of all episodes, of those "
        "that failed, or of the first N of each cell: all, failed or N",
    )
    look(
        "--gui",
        nargs="?",
        const="drive",
        choices=gui.MODES,
        help="open Bullet's window instead, on the first tile of the first family and level: "
        "drive the low policy with sliders (drive), or watch the first policy decide (watch); "
        "--episodes, --workers and --out have no effect then",
    )
    groups.machine.add_argument("--cluster", metavar="ADDRESS", help=CLUSTER_HELP)
    return parser.parse_args(arguments)


@dataclass(frozen=True)
class Evaluation:
    """The options of an evaluation: what is run and what is shown of it.

    Attributes:
        mode: a table of episodes; the low policy's tracking; or Bullet's window, to drive or watch.
        policies, conditions, families, levels: names and numbers, without duplicates.
        episodes: number per cell.
        low, high: files of the policies.
        seed: of the evaluation's tiles.
        tuning: to be compared with the untuned ``tdgc``; None for no comparison.
        traced: which episodes' traces are written; None for no traces and no diagnoses.
        filmed: number of episodes of each cell that are filmed.
        cluster: address of a cluster that runs the episodes; None for this machine.
        workers: number of processes.
        out: results folder.

    Raises:
        ValueError: values that cannot be used, or not together.
    """

    mode: Literal["table", "tracking", "drive", "watch"]
    policies: tuple[str, ...]
    conditions: tuple[str, ...]
    families: tuple[str, ...]
    levels: tuple[int, ...]
    episodes: int
    low: Path
    high: Path | None
    seed: int
    tuning: Tuning | None
    traced: Selection | None
    filmed: int
    cluster: str | None
    workers: int
    out: Path

    def __post_init__(self) -> None:
        if self.traced is not None:
            require("a trace", ("pyarrow",), "trace")
        if "tdgc" in self.policies and self.high is None and self.mode not in _LOW_ALONE:
            raise ValueError("no high policy is shipped: give one with --high, or --policies gp")
        self._check_mode()
        if self.tuning is not None and "tdgc" not in self.policies:
            raise ValueError("--tune and --set change tdgc, which is not among the policies")
        if self.mode == "watch" and self.tuning is not None and self.policies[0] != "tdgc":
            raise ValueError(
                f"--gui watch shows the first policy, {self.policies[0]}, but --tune and --set "
                "change tdgc"
            )

    def _check_mode(self) -> None:
        if self.mode in gui.MODES:
            if self.cluster is not None:
                raise ValueError("--gui shows a robot of this machine: no --cluster")
            if self.filmed or self.traced is not None:
                raise ValueError("--gui only shows the robot: no --tracking, --trace or --video")
        if self.mode == "drive" and self.tuning is not None:
            raise ValueError("--gui drive is of the low policy alone: no --tune or --set")
        if self.mode == "tracking":
            if self.filmed:
                raise ValueError("--tracking has no episodes to film: no --video")
            if self.traced is not None or self.tuning is not None:
                raise ValueError(
                    "--tracking is of the low policy alone: no --trace, --tune or --set"
                )

    @classmethod
    def of(cls, flags: argparse.Namespace) -> "Evaluation":
        """Build the evaluation that the flags ask for.

        Raises:
            ValueError: flags that cannot be read, or an evaluation that is not possible.
            OSError: a file that cannot be read.
        """
        if flags.gui is not None and flags.tracking:
            raise ValueError("--gui only shows the robot: no --tracking, --trace or --video")
        if flags.gui == "drive" and (flags.policies is not None or flags.high is not None):
            raise ValueError("--gui drive is of the low policy alone: no --policies or --high")
        if flags.gui is not None and flags.conditions is not None:
            raise ValueError("--gui shows the nominal condition: no --conditions")
        episodes = flags.policies, flags.conditions, flags.families, flags.levels, flags.high
        if flags.tracking and any(flag is not None for flag in episodes):
            raise ValueError(
                "--tracking is of the low policy alone, on a plane: "
                "no --policies, --conditions, --families, --levels or --high"
            )
        shipped = SHIPPED_HIGH if SHIPPED_HIGH.with_suffix(".json").is_file() else None
        high = flags.high or shipped
        automatic = flags.workers == "auto"
        resolve(flags)
        default = "gp" if high is None else "all"
        asked = default if flags.policies is None else flags.policies
        conditions = "nominal" if flags.conditions is None else flags.conditions
        tuned = flags.tune is not None or flags.assignments
        evaluation = cls(
            mode=flags.gui or ("tracking" if flags.tracking else "table"),
            policies=choose(asked, ALL_POLICIES, POLICIES, "policy"),
            conditions=choose(conditions, tuple(CONDITIONS), tuple(CONDITIONS), "condition"),
            families=flags.families,
            levels=flags.levels,
            episodes=flags.episodes,
            low=flags.low,
            high=high,
            seed=flags.seed,
            tuning=tuning.load(flags.tune, flags.assignments) if tuned else None,
            traced=Selection.parse(flags.trace) if flags.trace is not None else None,
            filmed=flags.video,
            cluster=flags.cluster,
            workers=flags.workers,
            out=flags.out,
        )
        if flags.high is not None and evaluation.policies == ("gp",):
            raise ValueError("--high has no effect: gp uses no high policy")
        if flags.cluster is None:
            return evaluation
        cores = cluster.connect(flags.cluster)  # only once the evaluation is known to be valid
        cluster.check_workers(1, cores)
        return replace(evaluation, workers=cores) if automatic else evaluation

    @property
    def run_jobs(self) -> RunJobs:
        """The function that distributes jobs to processes, here or in the cluster."""
        return run_jobs if self.cluster is None else cluster.run_jobs

    def skill(self, low: Policy, config: LowLevelConfig) -> Skill:
        """What the scripts have to know of the low policy.

        They command it as the high policy's teacher did. Without a high policy that fits, the best
        speeds are found by trials.

        Raises:
            ValueError: the high policy's file cannot be used.
        """
        try:
            if self.high is None:
                raise MisfitError("there is no high policy")
            high, _ = load_high(self.high, low, config)
        except MisfitError as error:
            print(f"{error}: trying out how the low policy walks and leaps best")
            manner = within(find_manner(low, HighLevelConfig(), print), config.commands)
        else:
            manner = manner_of(high, self.high)
        landing = measure_landing(low, config, manner.leap_speed)
        if landing is None:
            print("the low policy falls when it leaps: scripts walk over trenches")
        return Skill(landing, manner)

    def drivers(self, low: Policy, config: LowLevelConfig) -> dict[str, Driver]:
        """Make the driver of each policy; the tuned one follows ``tdgc``.

        Raises:
            ValueError: a high policy that does not fit the low one, or a tuning that does not fit
                them.
        """
        if self.mode in _LOW_ALONE:
            return {}
        drivers: dict[str, Driver] = {}
        if "tdgc" in self.policies:  # refuse a misfit before anything is tried out
            assert self.high is not None
            pair = load_high(self.high, low, config)
        skill = functools.cache(lambda: self.skill(low, config))  # may be found by trials
        for name in self.policies:
            if name == "gp":
                drivers[name] = BaselineDriver(bounds=config.commands)
            elif name == TEACHER:
                drivers[name] = TeacherDriver(config, skill())
            elif name == CUES:
                mdp = HighLevelConfig(commands=config.commands)
                drivers[name] = HierarchyDriver(CuesLaw(config, skill(), mdp), mdp)
            else:
                drivers[name] = HierarchyDriver(*pair)
                if self.tuning is not None:
                    drivers[TUNED] = TunedDriver(*pair, config, self.tuning)
        return drivers


@dataclass(frozen=True)
class Ran:
    """The results of a batch.

    Attributes:
        episodes: all of the batch.
        recordings: of the episodes to be filmed.
        diagnoses: of failures; empty if nothing is traced.
        behaviours: of all episodes; empty if nothing is traced.
        traces: those to be written.
    """

    episodes: list[Episode]
    recordings: list[Recording]
    diagnoses: list[Diagnosis]
    behaviours: list[Behaviour]
    traces: list[Trace]


def run_one(
    cell: Cell,
    low: Policy,
    drivers: Mapping[str, Driver],
    seed: int,
    filmed: int,
    traced: Selection | None,
) -> Ran:
    """Run a batch. It writes no files, because it may run on another machine."""
    driver = drivers[cell.policy]
    recorder = Recorder(driver, filmed)
    if traced is None:
        episodes = run_cell(cell, low, driver, seed, [recorder])
        return Ran(episodes, recorder.recordings(), [], [], [])
    tracer = Tracer(driver)
    episodes = run_cell(cell, low, driver, seed, [tracer, recorder])
    traces, hips = tracer.traces(), float(read_geometry(mdp_of(low).robot).hips[0, 0])
    return Ran(
        episodes,
        recorder.recordings(),
        [diagnose(trace, hips) for trace in traces if trace.outcome != "reached"],
        [behaviour.behaviour(trace) for trace in traces],
        [trace for trace in traces if traced.includes(trace)],
    )


def run_table(
    evaluation: Evaluation, low: Policy, drivers: Mapping[str, Driver], trained_on: Training
) -> list[str]:
    """Run all cells and write all results, in place of those of an earlier table.

    Args:
        evaluation: what to run.
        low: the low policy.
        drivers: of all policies, by name.
        trained_on: what the policies were trained on.

    Returns:
        What could not be written, one line each.

    Raises:
        BaseException: what stopped it; the table of the complete cells is written first.
    """
    e, out = evaluation, evaluation.out
    folders = {"films": e.filmed > 0, "traces": e.traced is not None}
    make_room(out, report.DERIVED, folders)
    cells = plan(list(drivers), e.conditions, e.families, e.levels, e.episodes)
    work = functools.partial(
        run_one, low=low, drivers=drivers, seed=e.seed, filmed=e.filmed, traced=e.traced
    )
    episodes: list[Episode] = []
    recordings: list[Recording] = []
    diagnoses: list[Diagnosis] = []
    behaviours: list[Behaviour] = []
    with salvage(out, episodes, cells, trained_on) as bar:
        for ran in e.run_jobs(work, cells, e.workers):
            for trace in ran.traces:
                write(trace, out / "traces")
            episodes += ran.episodes
            recordings += ran.recordings
            diagnoses += ran.diagnoses
            behaviours += ran.behaviours
            bar.update(len(ran.episodes))
    print(describe(write_results(out, episodes, trained_on)))
    if e.traced is not None:
        diagnosis.write(diagnoses, out / "diagnosis.csv")
        print(f"\n{diagnosis.describe(diagnoses, episodes)}")
        write_csv(out / "behaviour.csv", behaviours[0].row(), (b.row() for b in behaviours))
        print(f"\n{behaviour.describe(behaviours)}")
    if e.tuning is not None:
        effect = tuning.effect(episodes, "tdgc", TUNED)
        result = {"tuning": tuning.record(e.tuning), "effect": effect}
        write_json(out / "tuning.json", result)
        print_effect(effect)
    # Only now, as figures can be drawn again from the files.
    plots.success_by_level(out / "summary.json", out / "success.png")
    plots.gait_shares(out, out / "gaits.png")
    plots.headings(out, out / "headings.png")
    plots.trajectories(out, out / "trajectories.png")
    print(f"\ntables and figures are in {out}")
    painters = e.workers if e.cluster is None else usable_cores()
    problems = film.produce(recordings, out / "films", painters) if recordings else []
    try:
        print(f"report: {report.write(out)}")
    except OSError as error:
        problems.append(f"no {report.NAME}: {error}")
    return problems


def training(low: Policy, drivers: Mapping[str, Driver]) -> Training:
    """What the policies were trained on.

    Raises:
        InputError: the edition that a policy names is not a number.
    """
    used = {"low": low.meta}
    pair = drivers.get("tdgc")
    if isinstance(pair, HierarchyDriver) and isinstance(pair.high, Policy):
        used["high"] = pair.high.meta
    return Training(editions_of(used), robot_changes(mdp_of(low)))


def print_effect(effect: dict[str, Any]) -> None:
    """Print the effect of a tuning: success, speed and energy with and without it."""
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


def run_tracking(evaluation: Evaluation, low: Policy, trained_on: Training) -> None:
    """Measure the low policy alone, print the results and write tracking.json."""
    e = evaluation
    result = tracking(low, e.episodes, e.seed, e.workers, e.run_jobs)
    about = {EDITIONS: trained_on.editions, ROBOT: trained_on.robot}
    write_json(e.out / "tracking.json", result | about)
    print("gait    velocity RMSE  yaw rate RMSE  contact match")
    for gait, r in result["gaits"].items():
        print(
            f"{gait:<8}{r['velocity_rmse']:9.3f} m/s{r['yaw_rate_rmse']:9.3f} rad/s"
            f"{100 * r['contact_match']:13.1f} %"
        )
    print(f"{result['falls_per_10_min']:.2f} falls in 10 minutes ({result['minutes']:.1f} walked)")
    for text in trained_on.robot:
        print(f"not the benchmark's robot: {text}")


def run_window(evaluation: Evaluation, low: Policy, drivers: Mapping[str, Driver]) -> None:
    """Show a robot on the first tile of the first family and level until the window is closed."""
    policy = next(iter(drivers), "")  # nobody drives but the user
    if policy == "tdgc" and TUNED in drivers:
        policy = TUNED
    cell = Cell(policy, "nominal", evaluation.families[0], evaluation.levels[0], 0, 1)
    try:
        if evaluation.mode == "drive":
            gui.drive(low, cell, evaluation.seed)
        else:
            gui.watch(low, drivers[policy], cell, evaluation.seed)
    except KeyboardInterrupt:
        pass  # equivalent to closing the window


@script("evaluate.py")
def main(arguments: list[str] | None = None) -> int:
    evaluation = Evaluation.of(parse(arguments))
    low, config = load_low(evaluation.low)
    # Fail before anything takes long or earlier results are removed.
    BulletWorld(1, config.robot, config.physics).close()
    if evaluation.mode not in gui.MODES:
        make_folder(evaluation.out)
    drivers = evaluation.drivers(low, config)
    trained_on = training(low, drivers)
    problems: list[str] = []
    if evaluation.mode == "tracking":
        run_tracking(evaluation, low, trained_on)
    elif evaluation.mode == "table":
        problems = run_table(evaluation, low, drivers, trained_on)
    else:
        run_window(evaluation, low, drivers)
    for problem in problems:
        print(f"evaluate.py: {problem}", file=sys.stderr)
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
