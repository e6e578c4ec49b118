"""An exported folder holds all that a program needs, and the controller does what it says."""

import copy
import csv
import functools
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from jsonschema import Draft202012Validator

from tdgc import diagnose, export
from tdgc.deploy import log
from tdgc.deploy.controller import GRAPHS, Controller
from tdgc.deploy.interface import SCHEMA, ExportError, read_interface
from tdgc.deploy.log import LogError, LogWriter
from tdgc.files import checksum
from tdgc.sim.geometry import read_geometry
from tdgc.sim.robot import RobotState
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
        ({"version": 2}, "an interface of version 2, this package reads 3; export the policies"),
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
    ("old", "new", "message"),
    [
        ('lower="-2.82"', 'lower="-2.7"', "FL_calf_joint turns from -2.7 to -0.89 rad, that robot"),
        ('<mass value="5.6"/>', '<mass value="6"/>', "link trunk has 6 kg, that robot's 5.6"),
        ("A1/Go1 class", "A1 class", "joint limits and masses agree, its checksum does not"),
        ('xyz="0 0 -0.213"', 'xyz="0 0 -0.2"', "m high"),
    ],
)
def test_another_robot_is_refused(
    folder: Path, tmp_path: Path, controller: Controller, old: str, new: str, message: str
) -> None:
    urdf = tmp_path / "other.urdf"
    urdf.write_text((folder / "quadruped.urdf").read_text().replace(old, new))
    with pytest.raises(ExportError, match=f"not the exported robot's URDF.*{message}"):
        controller.robot(urdf)


def test_the_folder_brings_its_robot(folder: Path, controller: Controller) -> None:
    robot = controller.robot()
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


def test_a_graph_that_is_not_the_exports_is_refused(folder: Path, tmp_path: Path) -> None:
    for path in folder.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
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


@pytest.mark.parametrize(
    "kind",
    ["truncated", "flipped", "one array", "CSV of nothing", "CSV without rows",
     "CSV of longer rows"],
)  # fmt: skip
def test_a_damaged_log_is_one_line(
    kind: str, folder: Path, walk: Path, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.setattr(diagnose, "Controller", functools.partial(Controller, form=FORM))
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


def test_a_diagnosis_that_cannot_be_written_is_one_line(
    folder: Path, walk: Path, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.setattr(diagnose, "Controller", functools.partial(Controller, form=FORM))
    (tmp_path / "diagnosis.csv").mkdir()
    flags = ["--export", str(folder), "--outcome", "fell", "--out", str(tmp_path)]
    assert diagnose.main([str(walk), *flags]) == 2
    said = capsys.readouterr()
    assert said.err.startswith("tdgc.diagnose: ") and said.err.count("\n") == 1
    assert "Is a directory" in said.err
