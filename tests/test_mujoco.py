"""MuJoCo's robot and ground match Bullet's; an exported pair is evaluated and logged there."""

import csv
import dataclasses
import errno
import json
import re
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

from tdgc import diagnose, export
from tdgc import mujoco as runner
from tdgc.benchmark import evaluation, trace
from tdgc.benchmark.diagnosis import diagnose as judge
from tdgc.benchmark.evaluation import Cell, tile_of
from tdgc.benchmark.trace import NO_TILE, Tracer
from tdgc.config import ConfigError, RobotConfig
from tdgc.deploy import log
from tdgc.deploy.controller import Controller
from tdgc.deploy.log import LogError, LogWriter
from tdgc.errors import WorkerError
from tdgc.files import checksum, read_csv
from tdgc.sim import mujoco_world
from tdgc.sim.mujoco_world import MujocoConfig, MujocoWorld
from tdgc.sim.robot import Array, nominal_height, nominal_pose, yaw_quaternion
from tdgc.sim.tile import TileField
from tdgc.tasks.pairing import PRETRAINED

ROBOT = RobotConfig()
WEIGHT = 12.6 * 9.81


def make_world(
    family: str = "", level: int = 0, robot: RobotConfig = ROBOT, **settings: float
) -> MujocoWorld:
    """A robot on a tile of ``family``, or on level ground if that is empty."""
    field, config = TileField(1), MujocoConfig(**settings)  # type: ignore[arg-type]
    if family:
        field.place(0, tile_of(0, family, level, 0))
    return MujocoWorld(robot, config.physics(0.02, 200.0), field, config)


def place(world: MujocoWorld, height: float = 0.0, yaw: float = 0.0) -> None:
    """Place the robot at (1, 4) m in the nominal pose, its feet ``height`` m above level ground."""
    stand = nominal_height(world.robot, world.state.geometry)
    position, turn = np.array([[1.0, 4.0, height + stand]]), yaw_quaternion(np.array([yaw]))
    world.reset_robots([0], position, turn, nominal_pose(world.robot)[None])


def hold(world: MujocoWorld, seconds: float, pose: np.ndarray | None = None) -> None:
    targets = np.tile(nominal_pose(world.robot) if pose is None else pose, (3, 1, 1))
    for _ in range(round(seconds / 0.02)):
        world.step(targets, np.zeros(1), np.zeros((1, 12)))


# --- the world ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("family", "level"), [("rough", 10), ("stair", 8), ("gap", 9), ("tilt", 10)]
)
def test_the_ground_is_bullets_to_the_triangle(family: str, level: int) -> None:
    world = make_world(family, level)
    world.data.qpos[2] = 50.0
    mujoco.mj_forward(world.model, world.data)
    points = np.random.default_rng(0).uniform(0.1, 7.9, (300, 2))
    down, hit = np.array([0.0, 0.0, -1.0]), np.zeros(1, dtype=np.int32)
    found = [
        5.0
        - mujoco.mj_ray(
            world.model, world.data, np.array([x, y, 5.0]), down, None, 1, -1, hit, None
        )
        for x, y in points
    ]
    assert found == pytest.approx(world.ground_height(*points.T), abs=1e-6)


def test_the_robot_is_the_urdfs() -> None:
    world = make_world()
    model = world.model
    assert model.body_mass.sum() == pytest.approx(12.6) and model.nv == 18
    dofs = [model.joint(name).dofadr[0] for name in export.JOINTS]
    assert (model.dof_armature[dofs] == 0.01).all() and not model.dof_damping.any()
    rng = np.random.default_rng(1)
    q = rng.uniform([-0.8, -0.6, -2.8] * 4, [0.8, 4.0, -0.9] * 4)[None]
    turn = rng.normal(size=(1, 4))
    world.reset_robots([0], np.array([[1.0, 2.0, 3.0]]), turn / np.linalg.norm(turn), q)
    mujoco.mj_kinematics(model, world.data)
    spheres = world.data.geom_xpos
    for foot in world.state.foot_position[0]:
        assert np.linalg.norm(spheres - foot, axis=1).min() < 1e-9


def test_it_falls_as_things_fall() -> None:
    world = make_world()
    place(world, height=2.0)
    before = world.state.position[0, 2]
    hold(world, 0.4)
    assert before - world.state.position[0, 2] == pytest.approx(0.5 * 9.81 * 0.16, rel=0.01)
    assert world.state.lin_vel[0] == pytest.approx([0.0, 0.0, -9.81 * 0.4], abs=0.02)
    assert world.state.foot_force.sum() == world.state.trunk_force[0] == 0.0


def mean_force(world: MujocoWorld) -> float:
    """Mean force on all feet in a second in which the robot stands, N; it varies by 1 %."""
    forces = []
    for _ in range(50):
        hold(world, 0.02)
        forces.append(world.state.foot_force.sum())
    return float(np.mean(forces))


def test_it_stands_on_its_feet() -> None:
    world = make_world()
    place(world, yaw=0.7)
    hold(world, 2.0)
    state = world.state
    assert mean_force(world) == pytest.approx(WEIGHT, rel=0.005)
    assert (state.foot_force > 15.0).all() and not state.leg_force.any()
    assert state.yaw[0] == pytest.approx(0.7, abs=0.01)
    assert np.abs(state.q - nominal_pose(ROBOT)).max() < 0.3  # PD control has no integral term
    assert np.abs(state.torque).max() == pytest.approx(
        20.0 * np.abs(state.q - nominal_pose(ROBOT)).max(), rel=0.05
    )
    world.payload[0] = 3.0
    world.apply_dynamics([0])
    hold(world, 2.0)
    assert mean_force(world) == pytest.approx(WEIGHT + 3.0 * 9.81, rel=0.01)


def sunk(solref: float) -> float:
    """Greatest depth in m of a foot below the ground after a drop from 0.3 m."""
    world, deepest = make_world(solref=solref), 0.0
    place(world, height=0.3)
    for _ in range(30):
        hold(world, 0.02)
        deepest = max(deepest, 0.022 - world.state.foot_position[0, :, 2].min())
    return deepest


def test_hard_contacts_let_feet_sink_less() -> None:
    hard, soft = sunk(0.005), sunk(0.02)
    assert 0.0 < hard < 0.01 and soft > 2.0 * hard


def rebound(dampratio: float) -> float:
    """Upward speed in m/s of the feet 10 ms after the robot landed on them at 1 m/s."""
    config = MujocoConfig(dampratio=dampratio)
    world = MujocoWorld(ROBOT, config.physics(0.005, 200.0), TileField(1), config)
    place(world, height=0.003)
    world.push([0], np.array([[0.0, 0.0, -1.0]]))
    for _ in range(3):
        world.step(np.tile(nominal_pose(ROBOT), (2, 1, 1)), np.zeros(1), np.zeros((1, 12)))
    return float(world.state.foot_velocity[0, :, 2].mean())


def test_damped_contacts_let_feet_bounce_less() -> None:
    bouncing, damped = rebound(1.0), rebound(MujocoConfig().dampratio)
    assert bouncing > 0.08 and abs(damped) < 0.5 * bouncing


def test_it_lies_on_its_back() -> None:
    world = make_world()
    over = np.array([[1.0, 0.0, 0.0, 0.0]])  # half a turn about the forward axis
    world.reset_robots([0], np.array([[1.0, 4.0, 0.06]]), over, nominal_pose(ROBOT)[None])
    hold(world, 1.0)
    state = world.state
    assert state.position[0, 2] == pytest.approx(0.055, abs=0.005)  # half the trunk's height
    assert state.gravity[0, 2] > 0.99 and not state.foot_force.any()
    assert state.trunk_force[0] + state.leg_force.sum() == pytest.approx(WEIGHT, rel=0.05)
    assert state.trunk_force[0] > 40.0


def test_pushes_friction_and_rotors_do_what_they_say() -> None:
    world = make_world()
    place(world)
    world.push([0], np.array([[0.0, 0.5, 0.0]]))
    assert world.state.lin_vel[0, 1] == 0.5
    hold(world, 0.02)
    assert 0.1 < world.state.lin_vel[0, 1] < 0.5
    moved = []
    for armature in (0.0, 0.01, 0.03):
        world = make_world(armature=armature)
        place(world, height=2.0)
        world.step(np.full((3, 1, 12), 0.2) + nominal_pose(ROBOT), np.zeros(1), np.zeros((1, 12)))
        moved.append(world.state.qd[0, 2])
    assert moved[0] > 1.05 * moved[1] > 1.1 * moved[2] > 0.0, moved
    for friction in (0.05, 0.1):  # sliding, it loses mu g t of its speed
        world = make_world(friction=friction)
        place(world)
        hold(world, 1.0)
        world.push([0], np.array([[1.0, 0.0, 0.0]]))
        hold(world, 0.4)
        assert world.state.lin_vel[0, 0] == pytest.approx(1.0 - friction * 9.81 * 0.4, abs=0.15)


def test_joint_friction_stops_a_swinging_leg() -> None:
    limp = dataclasses.replace(ROBOT, kp=1e-9, kd=1e-9)
    speeds = []
    for friction in (0.0, 0.3):
        world = make_world(robot=limp, joint_friction=friction)
        place(world, height=3.0)
        world.data.qvel[8] = 5.0
        hold(world, 0.1)
        speeds.append(np.abs(world.state.qd).max())
    assert speeds[0] > 2.0 and speeds[1] < 0.7 * speeds[0]


def test_what_follows_depends_on_the_state_alone_once_contacts_are_forgotten() -> None:
    """As in Bullet, a world with a copied state then moves as the original does, bit for bit."""
    original, copy = make_world("rough", 8), make_world("rough", 8)
    place(original, height=0.2)
    hold(original, 0.5)
    for term in ("position", "quaternion", "lin_vel", "ang_vel", "q", "qd"):
        getattr(copy.state, term)[:] = getattr(original.state, term)
    moved = []
    for world in (original, copy):
        world.forget()
        hold(world, 0.2)
        moved.append([world.state.position, world.state.q, world.state.foot_force])
    np.testing.assert_array_equal(np.concatenate(moved[0], 1), np.concatenate(moved[1], 1))
    assert original.state.foot_force.sum() > 0.5 * WEIGHT


def test_a_simulation_that_diverges_does_not_start_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    world = make_world()
    place(world)
    world.data.qvel[0] = 1e12
    hold(world, 0.02)
    assert not np.isfinite(world.state.position).all()
    assert not list(tmp_path.iterdir())  # MuJoCo would log its warning there


def test_a_timestep_must_fit_the_control() -> None:
    physics = MujocoConfig(timestep=0.001).physics(0.02, 200.0)
    assert (physics.substeps, physics.hold, physics.joint_steps) == (20, 5, 4)
    with pytest.raises(ConfigError, match=r"'timestep' must divide .* 0.005 s, not 0.003"):
        MujocoConfig(timestep=0.003, solref=0.02).physics(0.02, 200.0)


@pytest.mark.parametrize("visual", [False, True])
def test_meshes_are_found_beside_the_urdf(visual: bool, tmp_path: Path) -> None:
    """Those of collision shapes, also where a window shows the visual shapes too."""
    text = (Path(export.__file__).parents[1] / ROBOT.urdf).read_text()
    box = '<collision><origin xyz="0 0 0" rpy="0 0 0"/><geometry><box size="0.42 0.15 0.11"/>'
    assert box in text
    mesh = '<collision><geometry><mesh filename="meshes/trunk.obj"/>'
    (tmp_path / "robot.urdf").write_text(text.replace(box, mesh))
    corners = "v 0.2 0 0\nv -0.2 0.1 0\nv -0.2 -0.1 0\nv 0 0 0.1\n"
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "trunk.obj").write_text(f"{corners}f 1 2 3\nf 1 3 4\nf 1 4 2\nf 2 4 3\n")
    robot = dataclasses.replace(ROBOT, urdf=str(tmp_path / "robot.urdf"))
    config = MujocoConfig()
    world = MujocoWorld(robot, config.physics(0.02, 200.0), TileField(1), config, visual)
    assert world.model.nmesh == 1


def test_a_urdf_that_mujoco_cannot_load_is_one_line(tmp_path: Path) -> None:
    text = (Path(export.__file__).parents[1] / ROBOT.urdf).read_text()
    box = '<geometry><box size="0.42 0.15 0.11"/></geometry>'
    assert box in text
    mesh = text.replace(box, '<geometry><mesh filename="absent.stl"/></geometry>')
    (tmp_path / "robot.urdf").write_text(mesh)
    with pytest.raises(ConfigError, match="MuJoCo cannot load it") as refused:
        make_world(robot=dataclasses.replace(ROBOT, urdf=str(tmp_path / "robot.urdf")))
    assert "\n" not in str(refused.value)


# --- an exported pair ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Export of the shipped pair."""
    path = tmp_path_factory.mktemp("export")
    export.write(export.load_pair(PRETRAINED / "low", PRETRAINED / "high"), path, ["onnx"])
    return path


@pytest.fixture(scope="module")
def controller(folder: Path) -> Controller:
    return Controller(folder)


def run(controller: Controller, family: str, **settings: float) -> tuple[trace.Trace, LogWriter]:
    """Run an episode on level 6; return the simulator's own trace of it and its log."""
    pair = runner.Deployed(controller, LogWriter(controller))
    assert pair.log is not None
    watcher, cell = Tracer(pair), Cell("tdgc", "nominal", family, 6, 0, 1)
    runner.run_episode(cell, pair, MujocoConfig(**settings), 0, [watcher])  # type: ignore[arg-type]
    return watcher.traces()[0], pair.log


@pytest.fixture(scope="module")
def slipped(
    controller: Controller, tmp_path_factory: pytest.TempPathFactory
) -> tuple[trace.Trace, Path]:
    """Trace and log of a robot on ice, which does not reach the goal."""
    truth, writer = run(controller, "rough", friction=0.03)
    assert truth.outcome != "reached"
    path = tmp_path_factory.mktemp("logs") / "ice.npz"
    writer.save(path)
    return truth, path


def test_a_log_has_what_the_simulator_knows_but_its_truth(
    controller: Controller, tmp_path: Path
) -> None:
    truth, writer = run(controller, "rough")
    writer.save(tmp_path / "walk.npz")
    seen = log.trace(log.read(tmp_path / "walk.npz", controller), controller, "fell")
    assert (seen.policy, seen.condition, seen.family) == ("tdgc", "walk", "rough")
    assert (seen.seed, seen.level) == (NO_TILE, NO_TILE)
    assert seen.probes == truth.probes and len(seen.probes.split()) == 32
    exact = [
        c.name for c in trace.COLUMNS if c.name.startswith(("action_", "command_", "at_bound_"))
    ]
    exact += [
        "time",
        "pitch",
        "roll",
        "goal_distance",
        "goal_bearing",
        "asked_frequency",
        "error_pitch",
        "error_roll",
    ]
    exact += [f"probe_{k:02d}" for k in range(32)] + ["seconds"]
    if seen["seconds"][-1] < 1.5 * controller.dt:  # no second step shows the clock's advance
        assert np.isnan(seen["command_frequency"][-2])
        seen["command_frequency"][-2] = truth["command_frequency"][-2]
    for name in exact:
        assert seen[name][:-1] == pytest.approx(truth[name][:-1], abs=1e-4, nan_ok=True), name
    for name in ("gait", "family"):
        assert list(seen[name][:-1]) == list(truth[name][:-1])
    # These agree on average over the episode: within a decision the trunk sways, which the
    # simulator samples.
    for name, rounding in (("vx", 0.01), ("vy", 0.01), ("yaw_rate", 0.01)):
        off = seen[f"error_{name}"][1:-1] - truth[f"error_{name}"][1:-1]
        assert abs(np.mean(off)) < rounding and np.std(off) < 0.1, name
    turning = edited(tmp_path / "walk.npz", tmp_path / "gyro.npz", yaw=None)
    drifting = log.trace(log.read(turning, controller), controller, "fell")
    for name in ("vx", "vy", "yaw_rate"):
        off = drifting[f"error_{name}"][1:-1] - truth[f"error_{name}"][1:-1]
        assert abs(np.mean(off)) < 0.03, name
    for name in ("base_x", "base_height", "power", "contact_FL", "trunk_force", "reward_alive"):
        assert np.isnan(seen[name]).all()


def test_the_graphs_give_what_the_log_says(
    controller: Controller, slipped: tuple[trace.Trace, Path]
) -> None:
    found = log.read(slipped[1], controller)
    same = dict.fromkeys(("decision", *log.GIVEN), (0.0, np.inf))
    assert log.replay(found, controller) == same
    found.values["joint_targets"][70] += 0.01
    differs = {"joint_targets": (pytest.approx(0.01), pytest.approx(1.4))}
    assert log.replay(found, controller) == same | differs


def edited(path: Path, out: Path, **values: np.ndarray | None) -> Path:
    """Copy a log with some values replaced, or removed where None."""
    table = dict(np.load(path)) | values
    np.savez(out, **{name: value for name, value in table.items() if value is not None})
    return out


def holed(array: np.ndarray, row: int) -> np.ndarray:
    array = array.astype(np.float64).copy()
    array[row] = np.nan
    return array


def test_nobody_knows_how_far_the_clock_went_in_a_last_step(
    controller: Controller, slipped: tuple[trace.Trace, Path], tmp_path: Path
) -> None:
    """The frequency carried out is NaN where a log ends one step after a decision.

    The last row lacks the values of ``log.GIVEN``, since no step followed.
    """
    short = {name: array[:62] for name, array in np.load(slipped[1]).items()}
    short |= {name: holed(short[name], 61) for name in log.GIVEN}
    path = edited(slipped[1], tmp_path / "short.npz", **short)
    frequency = log.trace(log.read(path, controller), controller, "fell")["command_frequency"]
    assert len(frequency) == 14 and np.isnan(frequency[-2])
    assert frequency[:-2] == pytest.approx(slipped[0]["command_frequency"][:12], abs=1e-4)


def test_a_log_with_gaps_is_refused(
    controller: Controller, slipped: tuple[trace.Trace, Path], tmp_path: Path
) -> None:
    whole = dict(np.load(slipped[1]))
    late = whole["time"].copy()
    late[31:] += 0.02
    for values, message in (
        ({"time": late}, "a gap at 0.60 s, where the next row is 0.040 s later and not 0.02 s"),
        ({"gravity": holed(whole["gravity"], 12)}, "a gap at 0.24 s: no gravity"),
        ({"commands": holed(whole["commands"], 13)}, "a gap at 0.26 s: no commands"),
        ({"probes": holed(whole["probes"], 20)}, "a gap at 0.40 s: no probes"),
        ({"decision": holed(whole["decision"], 20)}, "a gap at 0.40 s: no decision"),
        ({"family": None}, "lacks 'family'; it needs time, gravity, "),
        ({"goal": whole["goal"][:-1]}, "'goal' must be numbers"),
        ({"goal": whole["goal"].astype(str)}, "'goal' must be numbers"),
        ({"goal": whole["goal"] > 0.0}, "'goal' must be numbers, not of type bool"),
        ({name: array[:1] for name, array in whole.items()}, "needs two rows at least"),
    ):
        with pytest.raises(LogError) as refused:
            log.read(edited(slipped[1], tmp_path / "bad.npz", **values), controller)
        assert message in str(refused.value) and "\n" not in str(refused.value)
    for name, text in (("absent.npz", None), ("text.npz", "time"), ("text.csv", "time\nsoon")):
        if text is not None:
            (tmp_path / name).write_text(text)
        with pytest.raises(LogError, match=f"{name}: missing, or neither an .npz nor a .csv"):
            log.read(tmp_path / name, controller)


def test_a_csv_says_the_same(
    controller: Controller, slipped: tuple[trace.Trace, Path], tmp_path: Path
) -> None:
    whole = dict(np.load(slipped[1]))
    time = whole.pop("time")
    header = ["time", *(f"{name}_{k}" for name in whole for k in range(whole[name].shape[1]))]
    rows = np.column_stack([time, *whole.values()])
    with open(tmp_path / "ice.csv", "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows([["" if np.isnan(x) else repr(float(x)) for x in row] for row in rows])
    wanted, found = (log.read(path, controller) for path in (slipped[1], tmp_path / "ice.csv"))
    assert found.name == wanted.name and np.array_equal(found.decisions, wanted.decisions)
    for name, values in wanted.values.items():
        assert np.array_equal(found.values[name], values, equal_nan=True)


def test_what_a_log_does_not_know_is_said(
    controller: Controller, slipped: tuple[trace.Trace, Path], tmp_path: Path
) -> None:
    hips = 0.183
    seen = log.trace(log.read(slipped[1], controller), controller, "fell")
    found = judge(seen, hips)
    assert (found.place, found.feature) == ("", "")
    assert found.layer == "execution" and "velocity off by " in found.evidence
    missing = "trunk height, contacts, forces, place on a tile"
    assert found.evidence.endswith(f"; not known: {missing}")
    whole = log.read(slipped[1], controller)
    values = {name: x for name, x in whole.values.items() if name not in log.OPTIONAL}
    blind = dataclasses.replace(whole, values=values)
    found = judge(log.trace(blind, controller, "collided"), hips)
    assert found.evidence.endswith(f"; not known: velocity, yaw rate, {missing}")
    assert "yaw rate off" not in found.evidence and "tilt off by" in found.evidence


def test_the_end_is_told_or_seen(
    controller: Controller, slipped: tuple[trace.Trace, Path], tmp_path: Path
) -> None:
    whole = dict(np.load(slipped[1]))
    short = {name: array[:60] for name, array in whole.items()}
    cut = log.read(edited(slipped[1], tmp_path / "cut.npz", **short), controller)
    with pytest.raises(LogError, match=r"cut: ends at 1.18 s, .* m from the goal; say how with"):
        log.outcome(cut, controller)
    with pytest.raises(LogError, match="cut: comes no nearer to the goal than "):
        log.outcome(cut, controller, "reached")
    assert log.outcome(cut, controller, "collided") == "collided"
    goal = whole["goal"].copy()
    goal[-1] *= 0.05
    near = edited(slipped[1], tmp_path / "near.npz", goal=goal)
    reached = log.read(near, controller)
    assert log.outcome(reached, controller) == log.outcome(reached, controller, "reached")
    assert log.outcome(reached, controller) == "reached"
    assert log.outcome(reached, controller, "fell") == "fell"  # into the goal's circle
    assert log.outcome(reached, controller, "left_tile") == "left_tile"  # the simulator's tile
    with pytest.raises(LogError, match="near: reaches the goal, so it has not run out of time"):
        log.outcome(reached, controller, "timeout")


# --- the commands -------------------------------------------------------------------------------


def test_a_log_is_diagnosed(
    folder: Path,
    slipped: tuple[trace.Trace, Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    flags = ["--export", str(folder), "--out", str(tmp_path), "--outcome", "fell"]
    assert diagnose.main([str(slipped[1]), *flags]) == 0
    said = capsys.readouterr()
    assert "execution: lost track of " in said.out and "not known: trunk height" in said.out
    assert "commands, joint_targets match the graphs within 0.0e+00" in said.out
    traces = list(tmp_path.glob("*.parquet"))
    assert len(traces) == 1 and trace.read(traces[0]).outcome == "fell"
    assert [row["layer"] for row in read_csv(tmp_path / "diagnosis.csv")] == ["execution"]
    targets = np.load(slipped[1])["joint_targets"] + 0.01
    other = edited(slipped[1], tmp_path / "other.npz", joint_targets=targets)
    assert diagnose.main([str(other), *flags]) == 1
    wrong = "differs from the graphs: joint_targets from 0.00 s on, by up to 0.010: "
    assert wrong in capsys.readouterr().err
    assert diagnose.main([str(tmp_path / "absent.npz"), *flags]) == 2
    said = capsys.readouterr()
    assert said.err.startswith("tdgc.diagnose: ") and said.err.count("\n") == 1


def test_the_benchmark_writes_what_evaluate_writes(folder: Path, tmp_path: Path) -> None:
    flags = ["--export", str(folder), "--levels", "9", "--families", "rough,gap", "--log"]
    small = [*flags, "--episodes", "2", "--workers", "1", "--set", "armature=0.005"]
    stale = [tmp_path / name for name in ("report.html", "gaits.png", "diagnosis.csv")]
    for path in stale:  # of an evaluation in Bullet
        path.write_text("")
    assert runner.main([*small, "--set", "friction=0.7", "--out", str(tmp_path)]) == 0
    assert not [path.name for path in stale if path.exists()]
    rows = read_csv(tmp_path / "episodes.csv")
    where = [(row["policy"], row["family"], row["level"], row["episode"]) for row in rows]
    assert where == [(runner.POLICY, f, "9", k) for f in ("rough", "gap") for k in "01"]
    summary = json.loads((tmp_path / "summary.json").read_text())
    found = summary[runner.POLICY]["nominal"]["mean"]
    reached = sum(row["outcome"] == "reached" for row in rows)
    assert (found["n"], found["reached"]) == (4, reached)
    settings = json.loads((tmp_path / "mujoco.json").read_text())["mujoco"]
    assert (settings["armature"], settings["friction"], settings["solref"]) == (0.005, 0.7, 0.005)
    logs = sorted(path.name for path in (tmp_path / "logs").iterdir())
    assert logs == [f"tdgc-mujoco_nominal_{family}_09_000.npz" for family in ("gap", "rough")]
    # An episode depends on its tile and the settings alone, not on what ran before.
    one = Cell(runner.POLICY, "nominal", "gap", 9, 1, 1)
    config = MujocoConfig(armature=0.005, friction=0.7)
    episodes, _ = runner.run_cell(one, folder, config, 0, 0, tmp_path, 0)
    assert {key: str(value) for key, value in episodes[0].row().items()} == rows[3]


@pytest.mark.parametrize(
    ("after", "error", "message"),
    [
        (1, KeyboardInterrupt(), "stopped by Ctrl-C; the table has 1 of 2 episodes"),
        (1, WorkerError("a process died"), "a process died; the table has 1 of 2 episodes"),
        (
            0,
            OSError(errno.ENOSPC, "No space left on device"),
            "[Errno 28] No space left on device; "
            "no table, as 0 of 2 episodes are of complete cells",
        ),
    ],
)
def test_what_is_complete_when_it_is_stopped_is_kept(
    folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    after: int,
    error: BaseException,
    message: str,
) -> None:
    def run_jobs(work: Callable[[Cell], Any], jobs: Sequence[Cell], workers: int) -> Iterator[Any]:
        yield from map(work, jobs[:after])
        raise error

    monkeypatch.setattr(runner, "run_jobs", run_jobs)
    monkeypatch.setattr(evaluation, "HORIZON", 0.2)
    for name in ("episodes.csv", "summary.json", "trajectories.npz"):
        (tmp_path / name).touch()
    flags = ["--levels", "9", "--families", "rough,gap", "--episodes", "1", "--workers", "1"]
    given = ["--export", str(folder), *flags, "--out", str(tmp_path)]
    if isinstance(error, KeyboardInterrupt):  # a caller stops, too
        with pytest.raises(SystemExit, match=r"^1$"):
            runner.main(given)
    else:
        assert runner.main(given) == 1
    lines = capsys.readouterr().err.splitlines()
    assert lines[-1] == f"tdgc.mujoco: {message}" and "Traceback" not in "".join(lines)
    tables = {path.name for path in tmp_path.iterdir()} - {"mujoco.json"}
    if not after:
        assert not tables
        return
    assert tables == {"episodes.csv", "summary.json", "trajectories.npz"}
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert list(summary[runner.POLICY]["nominal"]) == ["rough", "mean"]
    assert summary["editions"] == {"tiles": 2, "low": 2, "high": 2}
    assert "robot" not in summary


def test_results_say_that_the_robot_is_not_the_benchmarks(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert runner.training(Controller(folder)).robot == []
    pair = shutil.copytree(folder, tmp_path / "export")
    path = pair / "low_interface.json"
    table = json.loads(path.read_text())
    table["joint_control"]["kp"]["value"] = [18.5] * 12
    for graph, rate in (("low", 40.0), ("high", 8.0)):
        named = pair / f"{graph}_interface.json"
        changed = table if graph == "low" else json.loads(named.read_text())
        changed["rate"]["value"] = rate
        named.write_text(json.dumps(changed))
    urdf = pair / table["robot"]["urdf"]["file"]
    urdf.write_text(urdf.read_text() + "<!-- mine -->")
    table["robot"]["urdf"]["sha256"] = checksum(urdf)
    path.write_text(json.dumps(table))
    changes = [f'robot.urdf="{urdf}", not "urdf/quadruped.urdf"', "robot.kp=18.5, not 20.0"]
    changes += ["physics.control_dt=0.025, not 0.02"]
    monkeypatch.setattr(evaluation, "HORIZON", 0.2)
    given = ["--levels", "9", "--families", "rough", "--episodes", "1", "--workers", "1"]
    out = tmp_path / "out"
    assert runner.main(["--export", str(pair), *given, "--out", str(out)]) == 0
    assert json.loads((out / "summary.json").read_text())["robot"] == changes


class StubViewer:
    """MuJoCo's viewer, which the user closes after ``steps`` steps."""

    def __init__(self, steps: int) -> None:
        self.cam, self.left, self.shown = SimpleNamespace(), steps, 0

    def __enter__(self) -> "StubViewer":
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def is_running(self) -> bool:
        self.left -= 1
        return self.left >= 0

    def sync(self) -> None:
        self.shown += 1


def test_closing_the_viewer_is_the_normal_end(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    viewer = StubViewer(3)
    monkeypatch.setattr(mujoco_world, "check_display", lambda: None)
    monkeypatch.setattr("mujoco.viewer.launch_passive", lambda *_, **__: viewer)
    command = ["--export", str(folder), "--families", "rough", "--levels", "6", "--gui"]
    assert runner.main(command) == 0
    assert viewer.shown == 3 and viewer.cam.trackbodyid == 1
    assert capsys.readouterr() == ("", "")


def test_the_viewer_needs_a_display(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setenv("DISPLAY", "")
    assert runner.main(["--export", str(folder), "--gui"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("tdgc.mujoco: a window needs ") and said.count("\n") == 1


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ("--export {0}/absent", "absent/low_interface.json: No such file"),
        ("--levels 13", "must name levels from 0 to 12"),
        ("--families moon", "unknown family 'moon'"),
        ("--episodes 0", "--episodes must be at least 1, not 0"),
        ("--video 3", "--video must lie in [0, --episodes], not 3"),
        ("--gui --log", "--gui only shows the robot: no --log"),
        ("--set gravity=0", "unknown configuration key 'gravity'"),
        ("--set cone=round", "'cone' must be one of elliptic, pyramidal"),
        ("--set dampratio=0", "'dampratio' must be above 0, not 0"),
        ("--set timestep=0", "'timestep' must be above 0, not 0"),
        ("--set armature=-0.1", "'armature' must be at least 0, not -0.1"),
        ("--set timestep=0.005", "'solref' must be at least twice 'timestep', 0.01 s, not 0.005"),
        (
            "--set timestep=0.003 --set solref=0.01",
            "'timestep' must divide the joint control's step",
        ),
        ("--set armature=NaN", "'armature' must be"),
        ("--export {0}/old", "an interface of version 1, this package reads "),
        (
            "--export {0}/brief",
            "/brief decides for 10 s only; the benchmark's episodes take up to 20",
        ),
        ("--export {0}/robot", "FL_calf_joint turns from -2.82 to -0.7 rad, that robot's from"),
    ],
)
def test_bad_input_is_one_line(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], flags: str, message: str
) -> None:
    for name in ("old", "robot", "brief"):
        shutil.copytree(folder, tmp_path / name)
    table = json.loads((folder / "low_interface.json").read_text())
    (tmp_path / "old" / "low_interface.json").write_text(json.dumps(table | {"version": 1}))
    table = json.loads((folder / "high_interface.json").read_text())
    table["task"]["horizon"]["value"] = 10.0
    (tmp_path / "brief" / "high_interface.json").write_text(json.dumps(table))
    urdf = (folder / "quadruped.urdf").read_text().replace('upper="-0.89"', 'upper="-0.7"')
    (tmp_path / "robot" / "quadruped.urdf").write_text(urdf)
    out = tmp_path / "out"
    given = ["--export", str(folder), "--episodes", "2", "--out", str(out)]
    assert runner.main([*given, *flags.format(tmp_path).split()]) == 2
    said = capsys.readouterr()
    assert said.err.startswith("tdgc.mujoco: ") and said.err.count("\n") == 1
    assert message in said.err and not out.exists()


def test_without_mujoco_it_says_what_to_install(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)  # as if it were not installed
    assert runner.main(["--export", str(folder)]) == 2
    said = capsys.readouterr()
    assert "needs mujoco: install the extra 'mujoco'" in said.err and said.err.count("\n") == 1


# --- the documents ------------------------------------------------------------------------------

DOCS = Path(__file__).resolve().parents[1] / "docs"


def first_cells(name: str, heading: str) -> list[str]:
    """Names in the first column of the table under a heading of a document."""
    section = (DOCS / name).read_text().split(f"# {heading}\n")[1].split("\n## ")[0]
    rows = [line.split("|")[1] for line in section.splitlines() if line.startswith("| `")]
    return [name for row in rows for name in re.findall("`([^`]+)`", row)]


def test_the_loop_in_the_document_is_the_controllers(folder: Path, controller: Controller) -> None:
    code = (DOCS / "deploy.md").read_text().split("```python\n")[1].split("```")[0]
    given: dict[str, Any] = {}
    exec(code, given)
    world, compared = make_world(), []
    place(world)
    controller.reset()

    def readings() -> dict[str, Any]:
        return controller.sense(world.state, np.array([7.0, 4.0]), "rough", world.ground_height)

    def send(targets: Array) -> None:
        compared.append(targets - controller.step(readings()))
        world.step(np.tile(targets, (3, 1, 1)), np.zeros(1), np.zeros((1, 12)))

    def sense(step: int) -> dict[str, Any]:
        return readings() | {"time_left": np.array([20.0 - 0.02 * step])}

    given["episode"](folder, sense, send, 12)
    np.testing.assert_allclose(compared, np.zeros((12, 12)), atol=1e-9)


def test_documents_name_what_there_is(
    controller: Controller, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = [field.name for field in dataclasses.fields(MujocoConfig)]
    assert first_cells("mujoco.md", "Physics") == settings
    logged = {"time", *log.layout(controller), "probe_age"}  # which not every policy takes
    assert set(first_cells("deploy.md", "Logs")) == logged
    with pytest.raises(SystemExit):
        runner.main(["--help"])
    flags = re.findall(r"^  (--[a-z-]+)", capsys.readouterr().out, flags=re.MULTILINE)
    assert set(first_cells("mujoco.md", "A second simulator")) == set(flags)
