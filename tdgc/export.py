"""Export both policies as ONNX and TorchScript graphs, for a robot without this package.

    python -m tdgc.export --low runs/low/policy --high runs/high/policy --out runs/export

A graph holds everything between a robot's sensors and its joint targets: observation (Sec. IV-A,
IV-B), network, decoder, phase clock and joint targets. Next to ``low.onnx`` and ``low.pt``,
``low_interface.json`` describes the inputs and outputs with their order and units, and how the
joints are driven; likewise for ``high``, with the task. The robot's URDF and meshes are copied
there too. After writing, each pair of graphs drives a robot in the simulator for the length of an
episode, from the folder alone (``tdgc.deploy``), and its outputs are compared with those of the
policies.
"""

import argparse
import dataclasses
import io
import json
import shutil
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Collection, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

from tdgc import __version__
from tdgc.benchmark.drivers import HierarchyDriver, load_high
from tdgc.config import (
    CommandRanges,
    ConfigError,
    HighLevelConfig,
    LowLevelConfig,
    PhysicsConfig,
    RobotConfig,
)
from tdgc.deploy.controller import FORMATS, Controller, quiet
from tdgc.deploy.graphs import HighGraph, LowGraph, Signal
from tdgc.deploy.interface import VERSION, Table, interface_path
from tdgc.errors import require, script
from tdgc.files import checksum, make_folder, write_text
from tdgc.policies import Policy
from tdgc.sim.bullet_world import BulletWorld
from tdgc.sim.commands import (
    COMMANDS,
    CONTINUOUS,
    NAMES,
    VELOCITIES,
    CommandDecoder,
    default_command,
)
from tdgc.sim.gaits import FEET, GAIT_TABLE, GAITS
from tdgc.sim.geometry import Geometry, read_geometry
from tdgc.sim.locomotion import Locomotion, actor_layout
from tdgc.sim.robot import NUM_JOINTS, Array, nominal_height, nominal_pose, pd_torque
from tdgc.sim.terrain import make_tile
from tdgc.sim.tile import TileField
from tdgc.sim.urdf import JOINTS, mesh_path, read_urdf
from tdgc.tasks.executor import Executor
from tdgc.tasks.high_observation import SEMANTIC
from tdgc.tasks.pairing import PRETRAINED, load_low
from tdgc.tasks.probes import PROBE_RANGE, PROBES
from tdgc.tasks.rules import GOAL_RADIUS, GOING, outcome

#: Largest difference allowed between graphs and policies, in the units of the outputs: float32
#: networks of this size differ by about 1e-6 when two libraries sum in a different order.
TOLERANCE = 1e-5

# The extra `export` of setup.cfg; all but the first are only needed for the format onnx.
_PACKAGES = ("jsonschema", "onnx", "onnxruntime", "onnxscript")
_CHECKED_ON = "rough"  # a family on which every step differs from the previous one

#: Unit and meaning of what ``RandomisationConfig`` draws, by its names.
_DRAWN = {
    "friction": ("1", "coefficient of friction, feet on ground"),
    "payload": ("kg", "added to the trunk"),
    "motor_strength": ("1", "factor on torque limits and gains"),
    "joint_offset": ("rad", "error of each joint's zero"),
    "armature": ("kg m^2", "rotor inertia about each joint"),
    "joint_friction": ("N m", "dry friction of each joint"),
    "latency": ("s", "from joint targets to their effect"),
    "push_speed": ("m/s", "sudden change of the trunk's velocity, in any horizontal direction"),
    "noise_gravity": ("1", "error of each entry of 'gravity' in each step"),
    "noise_joint_angle": ("rad", "error of each entry of 'joint_angles' in each step"),
    "noise_joint_speed": ("rad/s", "error of each entry of 'joint_speeds' in each step"),
    "noise_gyro": ("rad/s", "error of each entry of 'gyro' in each step"),
    "noise_probes": ("m", "error of each entry of 'probes' in each decision"),
}


# ---------------------------------------------------------------------------------------------
# Writing


@dataclass(frozen=True)
class Pair:
    """Both policies and the MDPs they were trained on."""

    low: Policy
    low_config: LowLevelConfig
    high: Policy
    high_config: HighLevelConfig


def load_pair(low: str | Path, high: str | Path) -> Pair:
    """Load both policies from their files.

    Raises:
        ValueError: a file cannot be used, or the policies do not fit each other.
    """
    low_policy, low_config = load_low(low)
    high_policy, high_config = load_high(high, low_policy, low_config)
    if high_policy.kind != "lstm":
        raise ConfigError(f"{high}: only a recurrent high policy can be exported")
    return Pair(low_policy, low_config, high_policy, high_config)


# Contents of the two interface files, except ``files``. Their schema is
# ``tdgc/deploy/interface.schema.json``; ``urdf`` is the exported folder's copy.


def _low_table(pair: Pair, graph: LowGraph, urdf: Path) -> Table:
    config = pair.low_config
    robot, geometry = config.robot, read_geometry(config.robot)
    terms = actor_layout(robot, config.gyro)
    return _head("low", pair.low, graph, 1.0 / config.physics.control_dt) | {
        "commands": _commands(config.commands),
        "trained_for": _trained_for(config, config.physics, {term.noise for term in terms}),
        "feet": FEET,
        "frames": {
            "trunk": "ahead, left, up",
            "origin": "origin of the URDF's root link",
            "gravity_when_level": _quantity("1", [0.0, 0.0, -1.0]),
        },
        "robot": {
            "urdf": _file(urdf),
            "link_masses": _quantity("kg", geometry.masses),
            "total_mass": _quantity("kg", sum(geometry.masses.values())),
            "standing_height": _quantity("m", robot.base_height),
            "stance": {"unit": "m"} | dict(zip(("length", "width"), robot.stance, strict=True)),
        },
        "start": {
            "joint_angles": _quantity("rad", nominal_pose(robot).tolist()),
            "trunk_height": _quantity("m", nominal_height(robot, geometry)),
        },
        "joint_control": _joint_control(robot, geometry, config.physics),
    }


def _joint_control(robot: RobotConfig, geometry: Geometry, physics: PhysicsConfig) -> Table:
    return {
        "law": "torque = kp (target - angle) - kd speed, within the torque limit; 0 where it "
        "would drive a joint beyond its speed limit",
        "axes": "right-handed: hips about the axis ahead, thighs and calves about the one to "
        "the left; at 0 a leg is straight down",
        "rate": _quantity("Hz", physics.joint_steps / physics.control_dt),
        "kp": _quantity("N m/rad", [robot.kp] * NUM_JOINTS),
        "kd": _quantity("N m s/rad", [robot.kd] * NUM_JOINTS),
        "torque_limit": _quantity("N m", robot.torque_limit * 4),
        "speed_limit": _quantity("rad/s", robot.speed_limit * 4),
        "simulated_speed_limit": _quantity("rad/s", [min(robot.speed_limit)] * NUM_JOINTS),
        "joint_limits": {
            "unit": "rad",
            "low": geometry.joint_limits[:, 0].tolist(),
            "high": geometry.joint_limits[:, 1].tolist(),
        },
        "target_margin": _quantity("rad", robot.joint_margin),
    }


def _high_table(pair: Pair, graph: HighGraph) -> Table:
    config, physics, robot = pair.high_config, pair.low_config.physics, pair.low_config.robot
    step = config.decimation * physics.control_dt
    ranges = config.commands
    assert ranges is not None  # filled in by ``load_high``
    stand = CommandDecoder(ranges).nearest(default_command())
    stand[: len(VELOCITIES)] = 0.0  # stays where it is, even if ``ranges`` has no speed 0
    probes = any(signal.name == "probes" for signal in graph.inputs)
    trained_for = _trained_for(config, physics, {"noise_probes"} if probes else ())
    if probes:
        late = config.randomisation.scale * config.randomisation.probe_delay > 0.0
        trained_for.append(_range("probe_delay", "s", "age of 'probes'", 0.0, step * late))
    return _head("high", pair.high, graph, 1.0 / step) | {
        "order": [{"graph": "high", "every": config.decimation}, {"graph": "low", "every": 1}],
        "commands": _commands(ranges),
        "trained_for": trained_for,
        "decision": (*CONTINUOUS, "gait"),
        "families": SEMANTIC,
        "probes": {
            "ahead_left": _quantity("m", PROBES[config.probes].tolist()),
            "plane_below_trunk": _quantity("m", robot.base_height),
            "range": _quantity("m", PROBE_RANGE),
            "off_map": "nearest border",
        },
        "task": {
            "goal_radius": _quantity("m", GOAL_RADIUS),
            "horizon": _quantity("s", round(config.episode_seconds / step) * step),
            "family": {"scope": "whole tile", "otherwise": SEMANTIC[-1]},
            "after_goal": {
                "keep_deciding": _quantity("s", round(config.hold_seconds / step) * step),
                "then": "stand",
            },
            "after_horizon": "stand",
            "stand": {"order": "commands", "value": stand.tolist()},
        },
    }


def _quantity(unit: str, value: Any) -> Table:
    return {"unit": unit, "value": value}


def _range(name: str, unit: str, meaning: str, low: float, high: float) -> Table:
    return {"name": name, "unit": unit, "meaning": meaning, "low": low, "high": high}


def _head(name: str, policy: Policy, graph: LowGraph | HighGraph, rate: float) -> Table:
    """Fields that are the same in both interface files, or made in the same way."""

    def table(signal: Signal) -> Table:
        said = dataclasses.asdict(signal)
        form = {"shape": [said.pop("size")], "type": "float64"}
        return {"name": said.pop("name")} | form | said

    return {
        "version": VERSION,
        "graph": name,
        "package": f"tdgc {__version__}",
        "policy": {k: v for k, v in policy.meta.items() if k not in ("config", "low")},
        "normalisation": "inside",
        "rate": _quantity("Hz", rate),
        "inputs": [table(s) for s in graph.inputs],
        "outputs": [table(s) for s in graph.outputs],
        "joints": JOINTS,
        "gaits": [
            {"name": gait, **dict(zip(NAMES[12:], row, strict=True))}
            for gait, row in zip(GAITS, GAIT_TABLE.tolist(), strict=True)
        ],
    }


def _commands(ranges: CommandRanges) -> list[Table]:
    """Each command, in order, with its bounds; one of the gait embedding has its two values."""
    bounds = CommandDecoder(ranges)
    rows = zip(COMMANDS.items(), bounds.low.tolist(), bounds.high.tolist(), strict=True)
    return [
        _range(name, unit, meaning, low, high)
        if name in CONTINUOUS
        else {"name": name, "unit": unit, "meaning": meaning, "values": [low, high]}
        for (name, (unit, meaning)), low, high in rows
    ]


def _trained_for(
    config: LowLevelConfig | HighLevelConfig, physics: PhysicsConfig, noises: Collection[str | None]
) -> list[Table]:
    """Ranges of all that was randomised, with only those ``noises`` that the inputs had."""
    drawn, table = config.randomisation, []
    nominal = {"friction": physics.friction, "motor_strength": 1.0}  # of all others 0
    for name, (unit, meaning) in _DRAWN.items():
        if name in noises or not name.startswith("noise_"):
            value, middle = getattr(drawn, name), nominal.get(name, 0.0)
            ends = value if isinstance(value, tuple) else (-value, value)
            low, high = (middle + drawn.scale * (end - middle) for end in ends)
            table.append(_range(name, unit, meaning, low, high))
    return table


def write(pair: Pair, folder: Path, formats: Sequence[str]) -> None:
    """Write the graphs and interface files of both policies and the robot.

    ``folder`` must exist; graphs that an earlier export left there in other formats are deleted.

    Raises:
        ConfigError: the robot's URDF cannot be used or names a mesh that is missing.
        OSError: a file cannot be written.
    """
    low = LowGraph(pair.low, pair.low_config)
    high = HighGraph(pair.high, pair.high_config, pair.low_config)
    urdf = _copy_robot(pair.low_config.robot, folder)
    tables = {"low": _low_table(pair, low, urdf), "high": _high_table(pair, high)}
    graphs: dict[str, LowGraph | HighGraph] = {"low": low, "high": high}
    for name in graphs:  # first, so that none is left beside a new one of the other policy
        for suffix in FORMATS.values():
            (folder / (name + suffix)).unlink(missing_ok=True)
    for name, graph in graphs.items():
        files = {}
        for form, suffix in FORMATS.items():
            path = folder / (name + suffix)
            if form in formats:
                _write_graph(graph, path)
                files[form] = _file(path)
        text = json.dumps(tables[name] | {"files": files}, indent=2) + "\n"
        write_text(interface_path(folder, name), text)


def _file(path: Path) -> Table:
    """Reference to a file, as it stands in an interface file: name and checksum."""
    return {"file": path.name, "sha256": checksum(path)}


def _copy_robot(robot: RobotConfig, folder: Path) -> Path:
    """Copy a robot's URDF, and its meshes to ``meshes/``; return the path of the URDF's copy.

    The copy names the copied meshes; without meshes it is the same, byte for byte.
    """
    urdf = read_urdf(robot)
    names: dict[Path, str] = {}
    for mesh in urdf.root.iter("mesh"):
        name = mesh.get("filename", "")
        path = Path(mesh_path(name, urdf.path))
        if not (path.is_absolute() and path.is_file()):
            raise ConfigError(
                f"{urdf.path}: no mesh {name!r}; a mesh is named relative to the URDF, as "
                "package://PACKAGE/FILE above it, or by an absolute path"
            )
        # Numbered, as meshes from two folders may have one name.
        mesh.set("filename", names.setdefault(path.resolve(), f"meshes/{len(names)}_{path.name}"))
    copied = folder / urdf.path.name
    if copied.exists() and copied.samefile(urdf.path):
        raise ConfigError(
            f"'{folder}' holds the robot itself, {urdf.path}; export to another folder"
        )
    shutil.copyfile(urdf.path, copied)
    if names:
        (folder / "meshes").mkdir(exist_ok=True)
        for path, name in names.items():
            shutil.copyfile(path, folder / name)
        ElementTree.ElementTree(urdf.root).write(copied, encoding="utf-8")
    return copied


def _write_graph(graph: LowGraph | HighGraph, path: Path) -> None:
    example = tuple(th.full((s.size,), 0.5, dtype=th.float64) for s in graph.inputs)
    with quiet():
        if path.suffix == FORMATS["torchscript"]:
            traced = th.jit.trace(graph, example)  # type: ignore[no-untyped-call]
            content = io.BytesIO()  # written here, as PyTorch aborts the process on a full disk
            th.jit.save(traced, content)
            path.write_bytes(content.getvalue())
            return
        program = th.onnx.export(
            graph,
            example,
            input_names=[s.name for s in graph.inputs],
            output_names=[s.name for s in graph.outputs],
            dynamo=True,
            verbose=False,
        )
    assert program is not None
    model = program.model_proto
    # Without PyTorch's notes, which quote the source lines and their paths on this machine, the
    # same policy gives the same file everywhere.
    for node in model.graph.node:
        del node.metadata_props[:]
    path.write_bytes(model.SerializeToString())


# ---------------------------------------------------------------------------------------------
# Checking


@dataclass(frozen=True)
class Check:
    """Result of ``check``.

    Attributes:
        difference: largest difference between graphs and policies, in decision, commands, action,
            joint targets, joint torques and start pose.
        seconds: (control steps,) CPU time in the graphs: the low policy, and in every decimation-th
            step the high policy too. Between steps the simulator evicts the CPU caches.
        repeated: (control steps,) CPU time of the same steps, run back to back.
    """

    difference: float
    seconds: Array
    repeated: Array


def check(folder: Path, form: str, low: str | Path, high: str | Path) -> Check:
    """Let the graphs in ``folder`` drive a robot for the length of an episode next to the policies.

    Everything that drives the robot is read from the folder alone: sensors, probes, task, order and
    joint control. The policies see the same robot through the simulator's own observation, with
    their own configurations, clock and LSTM state. A robot that falls, collides, leaves its tile or
    reaches its goal starts again.

    Args:
        folder: folder that ``write`` wrote to.
        form: one of ``FORMATS``.
        low, high: the policies' paths.

    Raises:
        ValueError: the policies or the folder cannot be used.
    """
    pair, controller = load_pair(low, high), Controller(folder, form)
    driver = HierarchyDriver(pair.high, pair.high_config)
    field = TileField.of(make_tile(_CHECKED_ON, 0.5, np.random.default_rng(0)))
    physics = dataclasses.replace(pair.low_config.physics, control_dt=controller.dt)
    world = BulletWorld(1, controller.robot(), physics, field)
    # The robot is the folder's; it is observed as the policies' own configurations specify.
    loco = Locomotion(world, pair.low_config)
    start, goal, executor = field.starts, field.goals, Executor(loco, pair.low)
    differences: list[Array] = []
    seconds: list[float] = []
    log: list[tuple[bool, dict[str, Array]]] = []
    ended = True
    with closing(world):
        for _ in range(controller.horizon):
            if ended:
                controller.reset()
                loco.command[:] = default_command()
                loco.place(np.arange(1), start[:, :2], start[:, 2], np.zeros(1))
                differences.append(world.state.q[0] - nominal_pose(world.robot))
                driver.begin(loco, goal, _CHECKED_ON)
            readings = controller.sense(world.state, goal[0], _CHECKED_ON, world.ground_height)
            controller.step(readings)
            seconds.append(controller.seconds)
            log.append((ended, readings))
            driver.command(controller.count - 1)
            differences += _act(pair, controller, driver, executor)
            ended = bool(outcome(world, goal)[0] != GOING)
    repeated = []
    for begins, readings in log:
        if begins:
            controller.reset()
        controller.step(readings)
        repeated.append(controller.seconds)
    largest = np.abs(np.concatenate(differences)).max()
    return Check(float(largest), np.array(seconds), np.array(repeated))


def _act(
    pair: Pair, controller: Controller, driver: HierarchyDriver, executor: Executor
) -> list[Array]:
    """Carry out a step that controller and driver have decided on; return the differences between
    graphs and policies in it."""
    loco, limit = executor.loco, pair.low_config.robot.action_limit
    world = loco.world
    decoder = CommandDecoder(driver.bounds, pair.high_config.action_limit, pair.high_config.gaits)
    decision, low = controller.high.values["decision"], controller.low.values
    wanted = np.clip(executor.decide(controller.commands[None]), -limit, limit)
    error, speed = low["joint_targets"] - world.state.q, world.state.qd
    told, torque = (
        pd_torque(error, speed, world.strength, robot)
        for robot in (world.robot, pair.low_config.robot)
    )
    loco.act(low["action"][None])
    assert driver.action is not None
    return [
        decision - driver.action[0],
        controller.commands - decoder.decode(decision),
        low["action"] - wanted[0],
        low["joint_targets"] - loco.targets[0, 0],
        told[0] - torque[0],
    ]


def _report(form: str, result: Check) -> bool:
    """Print the result; return whether the difference is within ``TOLERANCE``."""
    (median, slow), (again, slow_again) = (
        1e3 * np.percentile(times, [50.0, 99.0]) for times in (result.seconds, result.repeated)
    )
    print(
        f"{form}: largest difference {result.difference:.1e} in {len(result.seconds)} control "
        f"steps; a step takes {median:.3f} ms (median; 99 % at most {slow:.3f} ms) interleaved "
        f"with the simulator's, {again:.3f} ms ({slow_again:.3f} ms) back to back"
    )
    good = result.difference <= TOLERANCE
    if not good:
        message = f"{form} differs by {result.difference:.1e}, allowed is {TOLERANCE:g}"
        print(f"tdgc.export: {message}", file=sys.stderr)
    return good


def _choose_formats(text: str) -> list[str]:
    names = list(dict.fromkeys(text.split(",")))
    for name in names:
        if name not in FORMATS:
            raise ValueError(f"unknown format '{name}'; allowed: {', '.join(FORMATS)}")
    onnx = "onnx" in names
    require(f"format {text}", _PACKAGES if onnx else _PACKAGES[:1], "export")
    return names


@script("tdgc.export")
def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m tdgc.export", description=(__doc__ or "").partition("\n")[0]
    )
    parser.add_argument("--low", type=Path, default=PRETRAINED / "low", help="low policy (shipped)")
    parser.add_argument(
        "--high", type=Path, default=PRETRAINED / "high", help="high policy (shipped)"
    )
    parser.add_argument("--out", type=Path, required=True, help="folder to write into")
    parser.add_argument(
        "--format", default=",".join(FORMATS), help=f"comma-separated ({','.join(FORMATS)})"
    )
    args = parser.parse_args(arguments)
    formats = _choose_formats(args.format)
    pair = load_pair(args.low, args.high)
    make_folder(args.out)
    write(pair, args.out, formats)
    th.set_num_threads(1)  # times are reported for one core
    good = [_report(form, check(args.out, form, args.low, args.high)) for form in formats]
    return 0 if all(good) else 1


if __name__ == "__main__":
    sys.exit(main())
