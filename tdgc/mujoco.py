"""The benchmark in a second simulator: an exported pair on the same tiles, in MuJoCo.

    python -m tdgc.mujoco --export runs/export --levels 6-10 --families all --episodes 20

Everything that drives the robot is read from the exported folder alone: ONNX graphs, interface
files and URDF. Tiles, rules, tables and files are those of evaluate.py. The physics is MuJoCo's;
docs/mujoco.md lists its settings. It needs the extra ``mujoco``.
"""

import argparse
import dataclasses
import functools
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from tdgc.benchmark import flags
from tdgc.benchmark.drivers import Driver
from tdgc.benchmark.evaluation import Batch, Cell, Episode, Watcher, closed_loop, plan
from tdgc.benchmark.recording import Recorder, Recording
from tdgc.benchmark.results import (
    Training,
    describe,
    editions_of,
    make_room,
    robot_changes,
    salvage,
    write_results,
)
from tdgc.config import (
    HighLevelConfig,
    LowLevelConfig,
    PhysicsConfig,
    RobotConfig,
    to_dict,
    with_overrides,
)
from tdgc.deploy.controller import Controller
from tdgc.deploy.log import LogWriter
from tdgc.errors import require, script
from tdgc.files import checksum, write_json
from tdgc.parallel.jobs import run_jobs
from tdgc.show import film, report
from tdgc.sim.commands import INDEX
from tdgc.sim.display import WindowError
from tdgc.sim.locomotion import Locomotion
from tdgc.sim.robot import Array
from tdgc.sim.sensors import Noise
from tdgc.sim.tile import TileField
from tdgc.sim.urdf import urdf_path
from tdgc.tasks.rules import HORIZON

if TYPE_CHECKING:
    from tdgc.sim.mujoco_world import MujocoConfig

POLICY = "tdgc-mujoco"  # in the results, beside PyBullet's "tdgc"
_PACKAGES = ("jsonschema", "mujoco", "onnxruntime")  # the extra `mujoco` of setup.cfg


class Deployed(Driver):
    """An exported pair in the closed loop with one simulated robot, as both driver and executor.

    Args:
        controller: controller of the exported folder.
        log: log to write the steps to; None for no log.
    """

    def __init__(self, controller: Controller, log: LogWriter | None = None) -> None:
        self.controller, self.log = controller, log
        self.config = HighLevelConfig(decimation=controller.decimation, commands=controller.bounds)
        self.bounds = controller.bounds

    def begin(self, loco: Locomotion, goal: Array, family: str, noise: Noise | None = None) -> None:
        self._loco, self._goal, self._family = loco, goal[0], family
        table = self.controller.high.table
        if any(signal["name"] == "family" for signal in table["inputs"]):
            self.told = table["families"][int(self.readings()["family"].argmax())]
        self.controller.reset(float(loco.clock.clock[0]))

    def readings(self) -> dict[str, Array]:
        """The robot's current sensor and map readings."""
        world = self._loco.world
        return self.controller.sense(world.state, self._goal, self._family, world.ground_height)

    def command(self, step: int) -> Array:
        readings = self.readings()
        self._targets = self.controller.step(readings)
        if self.log is not None:
            self.log.add(readings)
        decided = self.controller.high.values
        self.action = decided["decision"][None]
        if "probes" in decided:
            self.probes = decided["probes"][None]
        return self.controller.commands[None]

    def step(self, commands: Array, rows: NDArray[np.integer] | None = None) -> None:
        """Apply the joint targets of the step that ``command`` ran."""
        loco, low = self._loco, self.controller.low.values
        loco.command[:], loco.carried_out = commands, commands.copy()
        went = np.mod(low["next_clock"] - low["clock"], 1.0)
        loco.carried_out[:, INDEX["frequency"]] = went / self.controller.dt
        loco.targets = np.concatenate([self._targets[None, None], loco.targets[:-1]])
        loco.world.step(loco.targets, loco.delay, loco.joint_offset)
        loco.clock.clock[:] = low["next_clock"]
        loco.update_clock()


@functools.lru_cache(maxsize=1)
def load(export: Path) -> Controller:
    """Load the pair in an exported folder, once per process."""
    return Controller(export)


def run_episode(
    cell: Cell,
    pair: Deployed,
    config: "MujocoConfig",
    seed: int,
    watchers: Sequence[Watcher],
    visual: bool = False,
) -> Episode:
    """Run the only episode of ``cell``.

    Args:
        cell: a cell with one episode.
        pair: the exported pair, which drives the robot.
        config: MuJoCo's settings.
        seed: seed of the evaluation's tiles.
        watchers: observers that are called at every control step.
        visual: keep the visual shapes, which only a window shows.

    Raises:
        ValueError: the robot or the settings cannot be used.
    """
    from tdgc.sim.mujoco_world import MujocoWorld

    controller, rate = pair.controller, pair.controller.low.table["joint_control"]["rate"]
    robot, physics = controller.robot(), config.physics(controller.dt, rate["value"])
    low = LowLevelConfig(robot=robot, physics=physics)
    batch = Batch(
        cell, low, seed, make_world=lambda f: MujocoWorld(robot, physics, f, config, visual)
    )
    (episode,) = closed_loop(pair, pair, batch, watchers)
    if pair.log is not None:
        pair.log.end(pair.readings())
    return episode


def run_cell(
    cell: Cell,
    export: Path,
    config: "MujocoConfig",
    seed: int,
    filmed: int,
    logs: Path,
    logged: int,
) -> tuple[list[Episode], list[Recording]]:
    """Run the episodes of a cell one after another.

    Records the first ``filmed`` episodes and writes logs of the first ``logged`` into ``logs``.
    """
    controller, episodes, recordings = load(export), [], list[Recording]()
    for number in range(cell.first, cell.first + cell.count):
        one = Cell(cell.policy, cell.condition, cell.family, cell.level, number, 1)
        pair = Deployed(controller, LogWriter(controller) if number < logged else None)
        recorder = Recorder(pair, filmed)
        episode = run_episode(one, pair, config, seed, [recorder])
        episodes.append(episode)
        recordings += recorder.recordings()
        if pair.log is not None:
            pair.log.save(logs / f"{episode.name}.npz")
    return episodes, recordings


def training(controller: Controller) -> Training:
    """What the exported pair was trained on.

    Raises:
        InputError: the edition is not a number.
    """
    robot, usual = controller.robot(), RobotConfig()
    if checksum(Path(robot.urdf)) == checksum(urdf_path(usual)):  # the folder has a copy
        robot = dataclasses.replace(robot, urdf=usual.urdf)
    physics = PhysicsConfig(control_dt=controller.dt)
    tables = {"low": controller.low.table["policy"], "high": controller.high.table["policy"]}
    return Training(
        editions_of(tables), robot_changes(LowLevelConfig(robot=robot, physics=physics))
    )


def run_table(args: argparse.Namespace, config: "MujocoConfig", trained_on: Training) -> list[str]:
    """Run all cells and write all results; return problems with the films, one line each.

    Raises:
        BaseException: what stopped it; the table of the complete cells is written first.
    """
    settings = {"export": str(args.export), "seed": args.seed, "mujoco": to_dict(config)}
    write_json(args.out / "mujoco.json", settings)
    cells = plan([POLICY], ["nominal"], args.families, args.levels, args.episodes)
    work = functools.partial(
        run_cell,
        export=args.export,
        config=config,
        seed=args.seed,
        filmed=args.video,
        logs=args.out / "logs",
        logged=args.log,
    )
    episodes: list[Episode] = []
    recordings: list[Recording] = []
    with salvage(args.out, episodes, cells, trained_on) as bar:
        for ran, recorded in run_jobs(work, cells, args.workers):
            episodes += ran
            recordings += recorded
            bar.update(len(ran))
    print(describe(write_results(args.out, episodes, trained_on)))
    print(f"\ntables are in {args.out}")
    return film.produce(recordings, args.out / "films", args.workers) if recordings else []


def show(args: argparse.Namespace, config: "MujocoConfig") -> None:
    """Show the first episode of the first family and level in MuJoCo's viewer.

    Raises:
        WindowError: there is no display.
    """
    from tdgc.sim.mujoco_world import Window

    cell = Cell(POLICY, "nominal", args.families[0], args.levels[0], 0, 1)
    with Window() as window:
        pair = Deployed(load(args.export))
        try:
            episode = run_episode(cell, pair, config, args.seed, [window], visual=True)
        except WindowError:
            return  # the window was closed
    print(f"{episode.outcome.replace('_', ' ')}, {episode.time_s:.1f} s")


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m tdgc.mujoco", description=(__doc__ or "").partition("\n")[0]
    )
    groups = flags.add_arguments(parser, "runs/mujoco")
    groups.policies.add_argument("--export", type=Path, required=True, help="folder of tdgc.export")
    groups.episodes.add_argument(
        "--set",
        dest="assignments",
        metavar="KEY=VALUE",
        action="append",
        default=[],
        help="change MuJoCo's settings, e.g. armature=0; may be repeated",
    )
    groups.looked_at.add_argument(
        "--log",
        type=int,
        nargs="?",
        const=1,
        default=0,
        metavar="N",
        help="logs of the first N episodes of each cell (none; 1 without N)",
    )
    groups.looked_at.add_argument(
        "--gui",
        action="store_true",
        help="open MuJoCo's viewer instead, on the first tile of the first family and level "
        "(--episodes, --workers and --out then have no effect)",
    )
    return parser.parse_args(arguments)


def check(args: argparse.Namespace) -> "MujocoConfig":
    """Check the flags and the exported folder; return MuJoCo's settings.

    Raises:
        ValueError: the flags or the exported folder cannot be used.
    """
    require("MuJoCo's benchmark", _PACKAGES, "mujoco")
    from tdgc.sim.mujoco_world import MujocoConfig, MujocoWorld

    flags.resolve(args)
    if not 0 <= args.log <= args.episodes:
        raise ValueError(f"--log must lie in [0, --episodes], not {args.log}")
    for flag, value in (("--video", args.video), ("--log", args.log)):
        if args.gui and value:
            raise ValueError(f"--gui only shows the robot: no {flag}")
    config = with_overrides(MujocoConfig(), args.assignments)
    controller = load(args.export)
    seconds = controller.horizon * controller.dt
    if seconds < HORIZON:
        raise ValueError(
            f"the pair of {args.export} decides for {seconds:g} s only; the benchmark's episodes "
            f"take up to {HORIZON:g} s"
        )
    rate = controller.low.table["joint_control"]["rate"]["value"]
    physics = config.physics(controller.dt, rate)
    MujocoWorld(controller.robot(), physics, TileField(1), config)  # whether MuJoCo can load it
    return config


@script("tdgc.mujoco")
def main(arguments: list[str] | None = None) -> int:
    args = parse(arguments)
    config = check(args)
    if args.gui:
        show(args, config)
        return 0
    trained_on = training(load(args.export))  # before earlier results are removed
    folders = {"logs": args.log > 0, "films": args.video > 0}
    make_room(args.out, report.DERIVED, folders)
    problems = run_table(args, config, trained_on)
    for problem in problems:
        print(f"tdgc.mujoco: {problem}", file=sys.stderr)
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
