"""An exported folder holds all that a program needs, and the controller does what it says."""

import copy
import csv
import functools
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from jsonschema import Draft202012Validator

from tdgc import diagnose, export
from tdgc.config import RandomisationConfig, RobotConfig
from tdgc.deploy import log
from tdgc.deploy.controller import GRAPHS, Controller
from tdgc.deploy.interface import SCHEMA, ExportError, read_interface
from tdgc.deploy.log import LogError, LogWriter
from tdgc.files import checksum
from tdgc.sim.geometry import read_geometry
from tdgc.sim.robot import RobotState, nominal_pose
from tdgc.tasks.pairing import PRETRAINED

FORM = "torchscript"  # takes a tenth of the time to write


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Export of the shipped pair."""
    path = tmp_path_factory.mktemp("export")
    export.write(export.load_pair(PRETRAINED / "low", PRETRAINED / "high"), path, [FORM])
    return path


@pytest.fixture(scope="module")
def controller(folder: Path) -> Controller:
    return Controller(folder, FORM)


def state(controller: Controller, **values: Any) -> RobotState:
    """State of one upright robot 0.3 m above the origin, with ``values`` set."""
    made = RobotState.zeros(read_geometry(controller.robot()), 1)
    made.position[0, 2] = 0.3
    for name, value in values.items():
        getattr(made, name)[0] = value
    made.derive()
    return made


def level(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.zeros_like(x)


# --- the files ----------------------------------------------------------------------------------


def places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the paths of an interface's fields, except inside ``policy``, which is for people."""
    if path == ("policy",):
        return
    if isinstance(value, dict):
        for key, inner in value.items():
            yield (*path, key)
            yield from places(inner, (*path, key))
    elif isinstance(value, list):
        for k, inner in enumerate(value):
            yield from places(inner, (*path, k))


def test_the_schema_is_one_and_the_files_keep_to_it(folder: Path) -> None:
    schema = json.loads(SCHEMA.read_text())
    Draft202012Validator.check_schema(schema)
    for name in GRAPHS:
        table = json.loads((folder / f"{name}_interface.json").read_text())
        assert list(Draft202012Validator(schema).iter_errors(table)) == []
        assert read_interface(folder, name) == table


@pytest.mark.parametrize("name", GRAPHS)
def test_each_missing_field_is_refused_in_one_line(folder: Path, tmp_path: Path, name: str) -> None:
    whole = json.loads((folder / f"{name}_interface.json").read_text())
    # Neither the names of the links nor the choice of formats is prescribed.
    free = (("robot", "link_masses", "value"), ("files",))
    fields = [path for path in places(whole) if path[:-1] not in free]
    assert len(fields) > 150
    schema = Draft202012Validator(json.loads(SCHEMA.read_text()))
    for *above, last in fields:
        table = copy.deepcopy(whole)
        inner = table
        for key in above:
            inner = inner[key]
        del inner[last]
        (tmp_path / f"{name}_interface.json").write_text(json.dumps(table))
        with pytest.raises(ExportError) as refused:
            read_interface(tmp_path, name)
        message = str(refused.value)
        assert "\n" not in message and len(message) < 400
        assert "version" in message if last == "version" else str(last) in message, message
        assert not schema.is_valid(table)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"version": 4}, "an interface of version 4, this package reads 5; export the policies"),
        ({"version": None}, "an interface of version None"),
        ({"rate": {"unit": "ms", "value": 50}}, "rate.unit: 'Hz' was expected"),
        ({"rate": {"unit": "Hz", "value": 0}}, "rate.value: 0 is less than or equal to"),
        ({"joints": ["a"]}, "joints: "),
        ({"colour": "red"}, "'colour' was unexpected"),
        ({"files": {}}, "files: {} "),
    ],
)
def test_other_interfaces_are_refused(
    folder: Path, tmp_path: Path, change: dict[str, Any], message: str
) -> None:
    table = json.loads((folder / "low_interface.json").read_text()) | change
    (tmp_path / "low_interface.json").write_text(json.dumps(table))
    with pytest.raises(ExportError) as refused:
        read_interface(tmp_path, "low")
    assert message in str(refused.value) and "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("name", "path", "value", "message"),
    [
        ("high", "commands 0 name", "speed", "commands[0].name: 'vx' was expected"),
        ("low", "commands 4 unit", "1/s", "commands[4].unit: 'Hz' was expected"),
        ("high", "decision 3", "height", "decision: ['vx', 'vy', "),
        ("low", "gaits 1 phase", 0.5, "gaits[1]: {'name': 'pronk', 'phase': 0, 'offset': 0, "),
        ("low", "gaits 1 name", "trot", "gaits[1]: {'name': 'pronk', 'phase': 0, 'offset': 0, "),
        ("low", "start trunk_height value", np.nan, "trunk_height.value: nan is not of type 'num"),
        ("high", "commands 1 low", -np.inf, "commands[1].low: -inf is not of type 'number'"),
        ("high", "probes range value", 10**400, "probes.range.value: "),
        ("low", "commands 2 low", 2.0, "yaw_rate: low, 2, is above high, 1"),
        ("low", "trained_for 6 high", -1.0, "latency: low, 0, is above high, -1"),
        ("low", "joint_control joint_limits high 5", -3.0, "FR_calf_joint: low, -2.82, is above "),
        ("high", "families 5", None, "'family' has the size 6, its order 'families' has 5"),
        ("high", "probes ahead_left value 0", None, "the size 32, its order 'probes' has 31"),
        ("low", "outputs 0 shape 0", 11, "'last_action' has the size 12, its previous 'action' h"),
        ("low", "inputs 2 order", "decision", "the size 12, its order 'decision' has 0"),
        ("low", "inputs 7 previous", "next_phase", "'clock' has the size 1, its previous 'next_p"),
        ("low", "inputs 8 start 0", None, "'last_commands' has the size 15, its start has 14"),
        ("low", "inputs 6 source", "high.orders", "two exports: 'commands' has the shape [15], "),
        (
            "high",
            "commands 0 high",
            1.3,
            "come from two exports: high's bounds of vx exceed low's; expo",
        ),
        ("high", "probes plane_below_trunk value", 0.28, "two exports: their standing heights d"),
        ("high", "rate value", 20, "low runs at 50 Hz, which is not 5 times high's 20 Hz"),
        ("high", "task family otherwise", "sand", "task.family.otherwise is 'sand', no family"),
    ],
)
def test_fields_that_do_not_fit_are_refused_in_one_line(
    folder: Path, tmp_path: Path, name: str, path: str, value: Any, message: str
) -> None:
    """The field at a path set to another value, or removed."""
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    file = tmp_path / f"{name}_interface.json"
    inner = table = json.loads(file.read_text())
    *above, last = (int(key) if key.isdigit() else key for key in path.split())
    for key in above:
        inner = inner[key]
    if value is None:
        del inner[last]
    else:
        inner[last] = value
    file.write_text(json.dumps(table))
    with pytest.raises(ExportError) as refused:
        Controller(tmp_path, FORM)
    said = str(refused.value)
    assert message in said and "\n" not in said and len(said) < 400, said


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('lower="-2.82"', 'lower="-2.7"', "FL_calf_joint turns from -2.7 to -0.89 rad, that robot"),
        ('<mass value="5.6"/>', '<mass value="6"/>', "link trunk has 6 kg, that robot's 5.6"),
        ("A1/Go1 class", "A1 class", "joint limits and masses agree, its checksum does not"),
        ('xyz="0 0 -0.213"', 'xyz="0 0 -0.2"', "m high"),
    ],
)
def test_another_robot_is_refused(
    folder: Path, tmp_path: Path, old: str, new: str, message: str
) -> None:
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    urdf = tmp_path / "quadruped.urdf"
    urdf.write_text(urdf.read_text().replace(old, new))
    said = f"not the exported robot's URDF.*{message}.*; use that one, or"
    with pytest.raises(ExportError, match=said):
        Controller(tmp_path, FORM).robot()


def test_the_folder_brings_its_robot(
    folder: Path, controller: Controller, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(controller.low.table["robot"]["stance"], "width", 0.3)
    robot = controller.robot()
    assert robot.stance == (0.38, 0.3)
    assert Path(robot.urdf).parent == folder
    assert sum(read_geometry(robot).masses.values()) == pytest.approx(12.6)


# --- the controller -----------------------------------------------------------------------------


def test_sensing_is_in_the_frames_that_the_interface_names(controller: Controller) -> None:
    half = np.pi / 4.0
    left = np.array([0.0, 0.0, np.sin(half), np.cos(half)])  # a quarter turn to the left
    robot = state(controller, quaternion=left, ang_vel=[1.0, 0.0, 0.5], position=[2.0, 3.0, 0.35])
    seen = controller.sense(robot, np.array([2.0, 7.0]), "stair", lambda x, y: 0.1 * x + y)
    assert seen["gravity"] == pytest.approx([0.0, 0.0, -1.0])
    assert seen["goal"] == pytest.approx([4.0, 0.0])  # ahead
    assert seen["gyro"] == pytest.approx([0.0, -1.0, 0.5])
    assert seen["family"].tolist() == [0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
    # The first probe is 0.1 m ahead, so at (2.0, 3.1) in the world.
    assert seen["probes"][0] == pytest.approx(0.2 + 3.1 - (0.35 - 0.3))
    down = state(controller, quaternion=[0.0, np.sin(half / 2), 0.0, np.cos(half / 2)])
    assert controller.sense(down, np.ones(2), "?", level)["gravity"][0] > 0.7  # nose down
    assert controller.sense(down, np.ones(2), "?", level)["family"][-1] == 1.0


def test_graphs_run_in_order_and_hand_their_values_on(controller: Controller) -> None:
    robot, goal = state(controller), np.array([6.0, 0.0])
    controller.reset(0.3)
    decided, clocks = [], []
    for step in range(11):
        targets = controller.step(controller.sense(robot, goal, "rough", level))
        decided.append(controller.decided)
        clocks.append(controller.low.values["clock"][0])
        if controller.decided:
            assert controller.high.values["clock"][0] == clocks[-1]
            assert controller.high.values["time_left"][0] == pytest.approx(20.0 - 0.02 * step)
        assert np.array_equal(controller.low.values["commands"], controller.high.values["commands"])
        assert targets.shape == (12,)
    assert decided == [step % 5 == 0 for step in range(11)]
    assert clocks[0] == 0.3 and clocks[1] == pytest.approx(0.3 + 0.02 * 3.5, abs=0.02)
    controller.reset()
    controller.step(controller.sense(robot, goal, "rough", level))
    assert controller.high.values["clock"][0] == 0.0


@pytest.mark.parametrize("name", ["gyro", "probes", "goal"])
def test_a_reading_that_is_not_finite_is_refused_and_not_remembered(
    controller: Controller, name: str
) -> None:
    robot, goal = state(controller), np.array([6.0, 0.0])
    readings = controller.sense(robot, goal, "rough", level)
    controller.reset()
    expected = [controller.step(readings) for _ in range(11)]
    controller.reset()
    for step in range(11):
        if step in ((5,) if name == "probes" else (5, 6)):  # a decision, and a step without one
            broken = {**readings, name: np.full_like(readings[name], np.nan)}
            with pytest.raises(ExportError, match=rf"^'{name}' is not finite"):
                controller.step(broken)
        np.testing.assert_array_equal(controller.step(readings), expected[step])


@pytest.mark.parametrize("name", ["gyro", "probes", "goal"])
def test_a_missing_or_misshapen_reading_is_refused_and_not_remembered(
    controller: Controller, name: str
) -> None:
    readings = controller.sense(state(controller), np.array([6.0, 0.0]), "rough", level)
    controller.reset()
    expected = [controller.step(readings) for _ in range(6)]
    controller.reset()
    for step in range(6):
        if step in ((5,) if name == "probes" else (3, 5)):  # a step without a decision, and one
            lacking = {key: value for key, value in readings.items() if key != name}
            with pytest.raises(ExportError, match=f"the reading '{name}' is missing$"):
                controller.step(lacking)
            with pytest.raises(ExportError, match=f"^'{name}' must have the shape .*, not "):
                controller.step({**readings, name: np.zeros(40)})
        np.testing.assert_array_equal(controller.step(readings), expected[step])


def test_a_program_may_reuse_its_arrays(controller: Controller) -> None:
    """The speed at which the goal comes closer follows from its position at the last decision."""
    robot, ways = state(controller), []
    for reuse in (False, True):
        controller.reset()
        readings = controller.sense(robot, np.array([6.0, 0.0]), "gap", level)
        for step in range(11):
            goal = np.array([6.0 - 0.02 * step, 0.0])
            if reuse:
                readings["goal"][:] = goal
            else:
                readings = readings | {"goal": goal}
            controller.step(readings)
        ways.append(controller.high.values["decision"].copy())
    np.testing.assert_array_equal(*ways)


def test_it_stands_after_the_goal_and_after_the_horizon(controller: Controller) -> None:
    task = controller.high.table["task"]
    stand = np.array(task["stand"]["value"])
    assert stand[:3].tolist() == [0.0, 0.0, 0.0] and stand[12:].tolist() == [0.5, 0.0, 0.0]
    robot = state(controller)
    controller.reset()
    at, away = (controller.sense(robot, np.array([x, 0.0]), "rough", level) for x in (0.4, 5.0))
    for step in range(120):
        controller.step(at if step == 15 else away)
        standing = step >= 15 + 100  # 2 s, as it was trained to keep deciding
        assert controller.decided == (step % 5 == 0 and not standing)
        assert np.array_equal(controller.commands, stand) == standing
    controller.reset()
    controller.step(away)
    controller.count = controller.horizon - 1
    controller.step(away)
    assert not np.array_equal(controller.commands, stand)
    controller.step(away)
    assert np.array_equal(controller.commands, stand) and not controller.decided


def test_the_high_policy_stops_after_the_goal_never_before(folder: Path, tmp_path: Path) -> None:
    """Also if it is to stop as soon as the goal is reached."""
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    path = tmp_path / "high_interface.json"
    for seconds, steps in ((2.0, 100), (3 * 0.1, 15), (0.0, 0)):
        table = json.loads(path.read_text())
        table["task"]["after_goal"]["keep_deciding"]["value"] = seconds
        path.write_text(json.dumps(table))
        controller = Controller(tmp_path, FORM)
        assert not controller.over(0, None) and controller.over(controller.horizon, None)
        stopped = [controller.over(40 + step, 40) for step in range(102)]
        assert stopped.index(True) == steps


def test_a_graph_that_is_not_the_exports_is_refused(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    with pytest.raises(ExportError, match=r"its low policy was exported as torchscript, not onnx$"):
        Controller(tmp_path, "onnx")
    graph = tmp_path / "high.pt"
    graph.write_bytes((folder / "low.pt").read_bytes())
    with pytest.raises(ExportError, match=r"high.pt: not the graph that high_interface.json was"):
        Controller(tmp_path, FORM)
    graph.unlink()
    with pytest.raises(ExportError, match=r"high.pt: No such file or directory$"):
        Controller(tmp_path, FORM)
    graph.write_bytes(b"no graph")
    path = tmp_path / "high_interface.json"
    table = json.loads(path.read_text())
    table["files"][FORM]["sha256"] = checksum(graph)
    path.write_text(json.dumps(table))
    with pytest.raises(ExportError, match=r"high.pt: no TorchScript graph$"):
        Controller(tmp_path, FORM)


# --- logs ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def walk(controller: Controller, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Log of eleven steps of a robot that stays in place on rising ground."""
    robot, writer = state(controller), LogWriter(controller)
    controller.reset()
    readings = controller.sense(robot, np.array([5.0, 1.0]), "stair", lambda x, y: 0.1 * x)
    for _ in range(11):
        controller.step(readings)
        writer.add(readings)
    writer.end(readings)
    path = tmp_path_factory.mktemp("log") / "walk.npz"
    writer.save(path)
    return path


def columns(log: Path) -> dict[str, list[str]]:
    """Columns of a log in order, by name, as in a CSV file."""
    table = dict(np.load(log))
    entries = {"time": table.pop("time")}
    entries |= {f"{n}_{k}": x[:, k] for n, x in table.items() for k in range(x.shape[1])}
    return {n: ["" if np.isnan(v) else repr(float(v)) for v in x] for n, x in entries.items()}


def write_csv(path: Path, head: list[str], entries: list[list[str]]) -> Path:
    with open(path, "w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([head, *zip(*entries, strict=True)])
    return path


def test_columns_go_by_their_numbers(controller: Controller, walk: Path, tmp_path: Path) -> None:
    """Columns may be in any order, such as sorted: probes_0, probes_1, probes_10, probes_11."""
    entries = columns(walk)
    names = sorted(entries)
    assert names.index("probes_10") < names.index("probes_2")
    wanted = log.read(walk, controller)
    entries["motor_3"] = ["1"] * 12  # other columns are ignored
    for order in ([*names, "motor_3"], names[::-1]):
        path = write_csv(tmp_path / "walk.csv", order, [entries[name] for name in order])
        found = log.read(path, controller)
        for name, values in wanted.values.items():
            assert np.array_equal(found.values[name], values, equal_nan=True), name
    assert len(np.unique(wanted.values["probes"][0])) > 20  # so a wrong order would show


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("probes_7", "probes_32", "no column 'probes_7', but 'probes_32'"),
        ("family_0", "family_6", "no column 'family_0', but 'family_6'"),
        ("gravity_1", "gravity_2", "the column 'gravity_2' appears twice"),
        ("gravity_1", "gravity_02", "the column 'gravity_2' appears twice"),
        ("gravity_2", "gravitas", "'gravity' must be numbers (12, 3), not (12, 2)"),
    ],
)
def test_columns_with_gaps_or_twice_are_refused(
    controller: Controller, walk: Path, tmp_path: Path, old: str, new: str, message: str
) -> None:
    entries = columns(walk)
    head = [new if name == old else name for name in entries]
    path = write_csv(tmp_path / "bad.csv", head, list(entries.values()))
    with pytest.raises(LogError) as refused:
        log.read(path, controller)
    assert str(refused.value) == f"{path}: {message}"


def test_a_csv_of_a_spreadsheet_is_read(controller: Controller, walk: Path, tmp_path: Path) -> None:
    """Spreadsheets put a byte order mark first, and editors leave empty lines at the end."""
    entries = columns(walk)
    path = write_csv(tmp_path / "walk.csv", list(entries), list(entries.values()))
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes() + b"\r\n\r\n")
    found = log.read(path, controller)
    assert found.time == pytest.approx(0.02 * np.arange(12)) and len(found.decisions) == 3


def test_cues_and_decisions_are_in_the_rows_with_a_decision(walk: Path) -> None:
    table = np.load(walk)
    for name in log.DECIDED:
        rows = np.flatnonzero(np.isfinite(table[name]).any(axis=1))
        assert rows.tolist() == [0, 5, 10], name
    for name in log.GIVEN:
        assert np.isfinite(table[name][:-1]).all() and np.isnan(table[name][-1]).all(), name


@pytest.fixture(scope="module")
def arrival(
    controller: Controller, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, list[int]]:
    """Log of 130 steps that reaches the goal in row 13, and the rows with a decision."""
    robot, writer, decided = state(controller), LogWriter(controller), []
    controller.reset()
    for step in range(130):
        goal = np.array([0.4 if step == 13 else 5.0, 0.0])
        readings = controller.sense(robot, goal, "rough", level)
        controller.step(readings)
        writer.add(readings)
        decided += [step] if controller.decided else []
    writer.end(readings)
    path = tmp_path_factory.mktemp("log") / "arrival.npz"
    writer.save(path)
    return path, decided


def changed(path: Path, out: Path, **values: np.ndarray) -> Path:
    np.savez(out / "changed.npz", **(dict(np.load(path)) | values))
    return out / "changed.npz"


def test_decisions_are_due_until_the_controller_stands(
    controller: Controller, arrival: tuple[Path, list[int]], tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    path, decided = arrival
    assert decided == list(range(0, 113, 5))  # 13 steps, and 2 s at 50 Hz
    assert log.read(path, controller).decisions.tolist() == decided
    table = dict(np.load(path))
    for rows, like, message in (
        (slice(110, None), None, "a gap at 2.20 s: no decision; decisions are due every 0.1 s"),
        (slice(50, None), None, "a gap at 1.00 s: no decision; "),
        (slice(None), None, "has no decision"),
        (42, 40, "a gap at 0.84 s: a decision where none is due; "),
        (115, 40, "a gap at 2.30 s: a decision where none is due; "),
        (130, 40, "a gap at 2.60 s: a decision where none is due; "),  # the final row
    ):
        told = {name: table[name].copy() for name in log.DECIDED}
        for name, values in told.items():
            values[rows] = np.nan if like is None else table[name][like]
        with pytest.raises(LogError) as refused:
            log.read(changed(path, tmp_path, **told), controller)
        assert message in str(refused.value) and "\n" not in str(refused.value)
    away = np.tile([5.0, 0.0], (131, 1))  # the goal is never reached, so decisions must go on
    with pytest.raises(LogError, match=r"a gap at 2.30 s: no decision; decisions are due"):
        log.read(changed(path, tmp_path, goal=away), controller)
    monkeypatch.setattr(controller, "horizon", 113)
    assert log.read(changed(path, tmp_path, goal=away), controller).decisions.tolist() == decided
    monkeypatch.setattr(controller, "horizon", 110)
    with pytest.raises(LogError, match=r"a gap at 2.20 s: a decision where none is due; "):
        log.read(path, controller)


def test_a_last_row_cannot_have_a_decision(
    controller: Controller, walk: Path, tmp_path: Path
) -> None:
    """A log cut off in a row with a decision, which no step follows."""
    short = {name: values[:11] for name, values in np.load(walk).items()}
    with pytest.raises(LogError, match=r"a gap at 0.20 s: a decision where none is due; .* last"):
        log.read(changed(walk, tmp_path, **short), controller)


@pytest.mark.parametrize(("start", "told"), [(30.0, "30.00"), (1.7e9, "1700000000.00")])
def test_the_first_row_is_the_start_of_the_episode(
    controller: Controller, walk: Path, tmp_path: Path, start: float, told: str
) -> None:
    time = np.load(walk)["time"]
    assert log.read(changed(walk, tmp_path, time=time + 0.005), controller).time[0] == 0.005
    with pytest.raises(LogError, match=f"begins at {told} s, not at 0 s, where an episode starts"):
        log.read(changed(walk, tmp_path, time=time + start), controller)


def test_rows_may_be_late_but_not_missing(
    controller: Controller, walk: Path, tmp_path: Path
) -> None:
    time = np.load(walk)["time"]
    for late in (0.01, 0.017):
        for rows in (slice(5, 6), slice(5, None)):  # the next row catches up, or none does
            stamps = time.copy()
            stamps[rows] += late
            found = log.read(changed(walk, tmp_path, time=stamps), controller)
            assert np.array_equal(found.time, stamps)
    for stamps, message in (
        (np.append(time[:5], time[5:] + 0.02), "a gap at 0.08 s, where the next row is 0.040 s"),
        (np.append(time[:5], time[4:-1]), "a gap at 0.08 s, where the next row is 0.000 s later"),
        (np.append(time[:5], time[3:-2]), "a gap at 0.08 s, where the next row is -0.020 s later"),
        (np.arange(12) / 34.0, "its rows are 0.0294 s apart (median), not 0.02 s: the graphs must"),
        (np.arange(12) / 60.0, "its rows are 0.0167 s apart (median), not 0.02 s: the graphs must"),
        (1000.0 * time, "its rows are 20 s apart (median), not 0.02 s: the graphs must run at 50"),
    ):
        with pytest.raises(LogError) as refused:
            log.read(changed(walk, tmp_path, time=stamps), controller)
        assert message in str(refused.value) and "\n" not in str(refused.value)


@pytest.mark.parametrize("single", [True, False])
def test_single_entries_need_no_second_axis(
    controller: Controller, walk: Path, tmp_path: Path, single: bool
) -> None:
    names = ("time", "yaw", "clock", "probe_age")
    table = {name: np.load(walk)[name].reshape(12, *([] if single else [1])) for name in names}
    found, wanted = (
        log.read(path, controller) for path in (changed(walk, tmp_path, **table), walk)
    )
    assert np.array_equal(found.time, wanted.time)
    for name in names[1:]:
        assert np.array_equal(found.values[name], wanted.values[name], equal_nan=True)
    with pytest.raises(LogError, match=r"'time' must be numbers \(12, 1\), not \(3, 4\)$"):
        log.read(changed(walk, tmp_path, time=table["time"].reshape(3, 4)), controller)


STANDING = nominal_pose(RobotConfig())


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"gravity": [0.0, 0.0, -9.81]}, "'gravity' at 0.00 s is 9.81 long; it must be a unit vec"),
        ({"gravity": [0.0, 0.0, 1.0]}, "'gravity' is [0.0, 0.0, 1.0] in the first row; uprigh"),
        ({"gravity": [0.0, -1.0, 0.0]}, "upright it must be about [0.0, 0.0, -1.0], frames.grav"),
        ({"joint_angles": np.degrees(STANDING)}, "has 5.73 for FL_hip_joint, which turns from -0"),
        ({"joint_angles": -STANDING}, "has 1.5 for FL_calf_joint, which turns from -2.82 to -0.89"),
        ({"joint_speeds": [300.0] * 12}, "'joint_speeds' at 0.00 s means 300 rad/s, more than any"),
        (
            {"gyro": [0.0, 0.0, -57.3]},
            "'gyro' at 0.00 s means 57.3 rad/s, more than any robot's 35;",
        ),
        ({"family": [0.0] * 6}, "is [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]; it must be 1 for one of rough"),
        ({"family": [0.0, 0.5, 0.5, 0.0, 0.0, 0.0]}, "tilt, unknown and 0 for the others"),
        ({"family": [0.0, 0.0, 2.0, 0.0, 0.0, 0.0]}, "'family' at 0.00 s is [0.0, 0.0, 2.0, "),
    ],
)
def test_readings_in_another_unit_or_convention_are_refused(
    controller: Controller, walk: Path, tmp_path: Path, values: dict[str, Any], message: str
) -> None:
    table = {name: np.tile(value, (12, 1)) for name, value in values.items()}
    with pytest.raises(LogError) as refused:
        log.read(changed(walk, tmp_path, **table), controller)
    assert message in str(refused.value) and "\n" not in str(refused.value)


def test_a_heading_in_degrees_is_refused(
    controller: Controller, walk: Path, tmp_path: Path
) -> None:
    """Of a robot that turns by 1 rad/s, across the end of the range."""
    yaw = 3.0 + 0.02 * np.arange(12)
    around = (yaw + np.pi) % (2.0 * np.pi) - np.pi
    log.read(changed(walk, tmp_path, yaw=around[:, None]), controller)
    message = "'yaw' at 0.00 s means 57.3 rad/s, more than any robot's 35; it must be in rad"
    with pytest.raises(LogError, match=f"{message}$"):
        log.read(changed(walk, tmp_path, yaw=np.degrees(around)[:, None]), controller)


def test_a_writer_needs_no_heading(controller: Controller, tmp_path: Path) -> None:
    writer = LogWriter(controller)
    readings = controller.sense(state(controller), np.array([5.0, 1.0]), "stair", level)
    del readings["yaw"]
    controller.reset()
    for _ in range(6):
        controller.step(readings)
        writer.add(readings)
    writer.end(readings)
    writer.save(tmp_path / "blind.npz")
    found = log.read(tmp_path / "blind.npz", controller)
    assert "yaw" not in found.values and "gyro" in found.values


def test_a_log_of_noisy_sensors_and_a_fall_is_read(controller: Controller, tmp_path: Path) -> None:
    """With training's noise, on unknown ground, and upside down at the end."""
    config, rng = RandomisationConfig(), np.random.default_rng(0)
    writer = LogWriter(controller)
    controller.reset()
    for step in range(101):
        half = 0.5 * np.pi * max(0.0, 0.05 * step - 4.0)
        rolled = [np.sin(half), 0.0, 0.0, np.cos(half)]
        pose = state(controller, quaternion=rolled, q=STANDING)
        readings = controller.sense(pose, np.array([5.0, 1.0]), "?", level)
        for name, width in (
            ("gravity", config.noise_gravity),
            ("joint_angles", config.noise_joint_angle),
            ("joint_speeds", config.noise_joint_speed),
            ("gyro", config.noise_gyro),
            ("probes", config.noise_probes),
        ):
            readings[name] = readings[name] + rng.uniform(-width, width, readings[name].shape)
        if step == 100:
            writer.end(readings)
            break
        controller.step(readings)
        writer.add(readings)
    writer.save(tmp_path / "noisy.npz")
    found = log.read(tmp_path / "noisy.npz", controller)
    assert found.values["gravity"][-1, 2] > 0.9 and len(found.decisions) == 20
    assert log.trace(found, controller, "fell").family == "unknown"


def test_a_timeout_lasts_to_the_horizon(
    controller: Controller, walk: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = log.read(walk, controller)
    with pytest.raises(LogError, match=r"^walk: ends at 0.22 s, before the horizon of 20 s$"):
        log.outcome(found, controller, "timeout")
    assert log.outcome(found, controller, "fell") == "fell"
    with monkeypatch.context() as patch:  # the benchmark's, where the pair's is longer
        patch.setattr(log, "HORIZON", 0.22)
        assert log.outcome(found, controller, "timeout") == "timeout"
        with pytest.raises(LogError, match=r"^walk: ends at 0.22 s, .* m from the goal; say how"):
            log.outcome(found, controller)
    monkeypatch.setattr(controller, "horizon", 11)
    for told, ended in ((None, "timeout"), ("timeout", "timeout"), ("collided", "collided")):
        assert log.outcome(found, controller, told) == ended


def test_a_fall_after_the_episode_is_not_diagnosed(
    controller: Controller, arrival: tuple[Path, list[int]]
) -> None:
    """The last decision is that of row 110, 2 s after the goal; the log ends 0.4 s later."""
    found = log.read(arrival[0], controller)
    said = "^arrival: no decision after 2.20 s led to what happened at 2.60 s: it was no longer"
    with pytest.raises(LogError, match=said):
        log.trace(found, controller, "fell")
    assert log.trace(found, controller).outcome == "reached"


def test_each_value_is_compared_with_the_graphs(
    controller: Controller, arrival: tuple[Path, list[int]]
) -> None:
    found = log.read(arrival[0], controller)
    same = dict.fromkeys(("decision", "clock", "commands", "joint_targets"), (0.0, np.inf))
    assert log.replay(found, controller) == same
    for name, row, change in (
        ("decision", 20, 0.1),
        ("clock", 21, -0.3),
        ("commands", 22, 0.02),
        ("commands", 120, 0.02),  # while it stands
        ("joint_targets", 23, 0.01),
    ):
        before = found.values[name][row].copy()
        found.values[name][row] += change
        wanted = same | {name: (pytest.approx(abs(change)), pytest.approx(0.02 * row))}
        assert log.replay(found, controller) == wanted
        found.values[name][row] = before
    found.values["clock"] += 2.0  # whole cycles
    assert log.replay(found, controller)["clock"] == (pytest.approx(0.0, abs=1e-9), np.inf)
    found.values["decision"] += 0.004  # as rounding might
    assert log.replay(found, controller)["decision"] == (pytest.approx(0.004), np.inf)


@pytest.fixture
def torch_graphs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let tdgc.diagnose run TorchScript graphs, which these tests have exported."""
    monkeypatch.setattr(diagnose, "Controller", functools.partial(Controller, form=FORM))


@pytest.mark.usefixtures("torch_graphs")
def test_what_differs_from_the_graphs_is_named(
    folder: Path, walk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:  # fmt: skip
    commands = np.full((12, 15), 0.123)
    path = changed(walk, tmp_path, commands=commands)
    flags = ["--export", str(folder), "--outcome", "fell", "--out", str(tmp_path)]
    assert diagnose.main([str(path), *flags]) == 1
    said = capsys.readouterr().err
    off = np.abs(np.load(walk)["commands"][:-1] - 0.123).max()
    assert f"differs from the graphs: commands from 0.00 s on, by up to {off:.3f}: " in said
    assert "joint_targets" not in said and said.count("\n") == 1


@pytest.mark.usefixtures("torch_graphs")
def test_a_reached_goal_leaves_no_older_diagnosis(
    folder: Path, walk: Path, arrival: tuple[Path, list[int]], tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    flags = ["--export", str(folder), "--out", str(tmp_path)]
    assert diagnose.main([str(walk), *flags, "--outcome", "fell"]) == 0
    assert (tmp_path / "diagnosis.csv").is_file()
    assert diagnose.main([str(arrival[0]), *flags]) == 0
    said = capsys.readouterr().out
    assert "arrival: reached after " in said
    assert "decision, clock, commands, joint_targets match the graphs within " in said
    assert not (tmp_path / "diagnosis.csv").exists()


def damaged(walk: Path, out: Path, kind: str) -> Path:
    """Write a copy of a log as damaged by a full disk, a bad cable or the wrong tool."""
    data = walk.read_bytes()
    path = out / f"bad.{'csv' if 'CSV' in kind else 'npz'}"
    if kind == "truncated":
        path.write_bytes(data[: len(data) // 2])
    elif kind == "flipped":
        begin = data.index(b"gravity.npy") + 40
        path.write_bytes(data[:begin] + bytes(255 - b for b in data[begin:-2000]) + data[-2000:])
    elif kind == "one array":
        path = out / "bad.npy"
        np.save(path, np.ones(12))
    elif kind == "CSV without rows":
        write_csv(path, list(columns(walk)), [[] for _ in columns(walk)])
    elif kind == "CSV of longer rows":
        path.write_text("time,goal_0\n0,1,2,3\n1,1,2,3\n")
    elif kind == "CSV of nothing":
        path.write_text("")
    return path


@pytest.mark.usefixtures("torch_graphs")
@pytest.mark.parametrize(
    "kind",
    ["truncated", "flipped", "one array", "CSV of nothing", "CSV without rows",
     "CSV of longer rows"],
)  # fmt: skip
def test_a_damaged_log_is_one_line(
    kind: str, folder: Path, walk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:  # fmt: skip
    out, flags = tmp_path / "out", ["--export", str(folder), "--outcome", "fell"]
    assert diagnose.main([str(walk), *flags, "--out", str(out)]) == 0
    assert (out / "diagnosis.csv").is_file()
    capsys.readouterr()
    path = damaged(walk, tmp_path, kind)
    assert diagnose.main([str(path), *flags, "--out", str(tmp_path / "none")]) == 2
    said = capsys.readouterr()
    wrong = "missing, or neither an .npz nor a .csv of numbers"
    if kind == "CSV without rows":
        wrong = "needs two rows at least, each with its time"
    assert (said.out, said.err) == ("", f"tdgc.diagnose: {path}: {wrong}\n")
    assert not (tmp_path / "none").exists()


@pytest.mark.usefixtures("torch_graphs")
def test_a_diagnosis_that_cannot_be_written_is_one_line(
    folder: Path, walk: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:  # fmt: skip
    (tmp_path / "diagnosis.csv").mkdir()
    flags = ["--export", str(folder), "--outcome", "fell", "--out", str(tmp_path)]
    assert diagnose.main([str(walk), *flags]) == 1
    said = capsys.readouterr()
    assert said.err.startswith("tdgc.diagnose: ") and said.err.count("\n") == 1
    assert "Is a directory" in said.err
