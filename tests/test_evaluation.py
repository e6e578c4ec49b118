"""The protocol: cells, conditions, paired tiles, repeatability, and the script's table."""

from __future__ import annotations

import dataclasses
import errno
import hashlib
import json
import math
import os
import re
import shutil
import signal
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_drivers import save_high

import evaluate
from tdgc import policies
from tdgc.benchmark import evaluation, tracking
from tdgc.benchmark.drivers import BaselineDriver, HierarchyDriver, load_high
from tdgc.benchmark.evaluation import (
    BATCH,
    CONDITIONS,
    Batch,
    Cell,
    EpisodeLog,
    benchmarked,
    complete,
    plan,
    push_velocities,
    run_cell,
    tile_of,
)
from tdgc.benchmark.trace import Selection
from tdgc.benchmark.tracking import track_gait
from tdgc.benchmark.tuning import TunedDriver, Tuning
from tdgc.config import (
    CommandRanges,
    LowLevelConfig,
    PhysicsConfig,
    RandomisationConfig,
    TeacherConfig,
    to_dict,
)
from tdgc.errors import InputError, WorkerError
from tdgc.files import read_csv
from tdgc.parallel import cluster
from tdgc.show import gui
from tdgc.sim.bullet_world import BulletWorld
from tdgc.sim.commands import default_command
from tdgc.sim.gaits import GAIT_TABLE, GAITS
from tdgc.sim.locomotion import Locomotion
from tdgc.sim.robot import Array
from tdgc.sim.terrain import EDITION
from tdgc.sim.urdf import urdf_path
from tdgc.tasks import manners
from tdgc.tasks.executor import Executor
from tdgc.tasks.pairing import PRETRAINED, load_low, mdp_of
from tdgc.tasks.rules import OUTCOMES


@pytest.fixture(scope="module")
def low(low):
    """Here, the shipped low policy alone."""
    return low[0]


@pytest.fixture(scope="module")
def high(low, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_high(tmp_path_factory.mktemp("policy") / "high", (low, mdp_of(low)))


@pytest.fixture(scope="module")
def table(high: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results of the script with the default policies and two processes."""
    out = tmp_path_factory.mktemp("table")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluate, "SHIPPED_HIGH", high)
        assert evaluate.main([*SMALL, "--workers", "2", "--out", str(out)]) == 0
    return out


#: Flags of a short evaluation: robots fall into the first trench within seconds.
SMALL = ["--levels", "10", "--families", "gap", "--episodes", "2", "--seed", "3"]


def rows_of(folder: Path) -> list[dict[str, str]]:
    return read_csv(folder / "episodes.csv")


def test_plan_has_every_cell_once_and_fewer_episodes_off_nominal():
    cells = plan(["gp"], ["nominal", "mixed", "levels-11-12"], ["rough", "gap"], [6, 7], 100)
    count = {
        (c.condition, c.family, c.level): sum(
            d.count
            for d in cells
            if (d.condition, d.family, d.level) == (c.condition, c.family, c.level)
        )
        for c in cells
    }
    assert {k: v for k, v in count.items() if k[0] == "nominal"} == {
        ("nominal", f, lv): 100 for f in ("rough", "gap") for lv in (6, 7)
    }
    assert {k[1:] for k in count if k[0] == "mixed"} == {("mixed", 6), ("mixed", 7)}
    assert {k[2] for k in count if k[0] == "levels-11-12"} == {11, 12}
    assert {v for k, v in count.items() if k[0] != "nominal"} == {20}
    assert max(c.count for c in cells) == BATCH


def test_a_cell_is_complete_with_all_of_its_batches(low, monkeypatch):
    monkeypatch.setattr(evaluation, "BATCH", 1)
    monkeypatch.setattr(evaluation, "HORIZON", 0.02)
    cells = plan(["gp"], ["nominal", "pushes"], ["rough"], [6], 2)
    assert [(c.condition, c.first) for c in cells] == [
        ("nominal", 0),
        ("nominal", 1),
        ("pushes", 0),
    ]
    first, second, pushed = (run_cell(c, low, BaselineDriver(), seed=5)[0] for c in cells)
    assert complete([first], cells) == []
    assert complete([first, second], cells) == [first, second]
    assert complete([first, pushed], cells) == [pushed]


def test_conditions_are_the_benchmarks():
    assert list(CONDITIONS) == [
        "nominal", "levels-11-12", "mixed", "friction-0.4", "payload-3kg", "pushes", "motor-0.85",
        "armature-0.01", "latency-30ms", "physics-1000hz", "noise", "no-family", "mirrored",
    ]  # fmt: skip
    assert CONDITIONS["friction-0.4"].friction == 0.4
    assert CONDITIONS["payload-3kg"].payload == 3.0
    assert CONDITIONS["pushes"].push_speed == 0.75
    assert CONDITIONS["motor-0.85"].motor == 0.85
    assert CONDITIONS["armature-0.01"].armature == 0.01
    assert CONDITIONS["latency-30ms"].latency == 0.03


def test_physics_at_1000_hz_keeps_the_control_rate(low):
    config = mdp_of(low)
    fast = benchmarked(config, CONDITIONS["physics-1000hz"]).physics
    assert fast.substeps == 20 and fast.dt == pytest.approx(0.001)
    assert benchmarked(config, CONDITIONS["nominal"]).physics == PhysicsConfig()


def test_physics_is_the_benchmarks_whatever_a_policy_was_trained_in() -> None:
    easy = PhysicsConfig(control_dt=0.04, substeps=8, hold=1, friction=1.2, solver_iterations=50)
    found = benchmarked(LowLevelConfig(physics=easy), CONDITIONS["nominal"]).physics
    assert found == PhysicsConfig(control_dt=0.04, substeps=16)
    assert (found.dt, found.friction, found.hold) == (0.0025, 0.8, 2)
    # A control step that is no multiple of the joint control's gets a finer physics step.
    odd = PhysicsConfig(control_dt=0.0125, substeps=6)
    found = benchmarked(LowLevelConfig(physics=odd), CONDITIONS["nominal"]).physics
    assert (found.joint_steps, found.dt) == (3, pytest.approx(0.0125 / 6))


def test_pushes_have_their_size_and_are_paired():
    cell = Cell("gp", "pushes", "rough", 6, 0, 4)
    pushes = push_velocities(cell, 7, 0.75, 6)
    assert np.linalg.norm(pushes, axis=-1) == pytest.approx(np.full((4, 6), 0.75))
    other = push_velocities(dataclasses.replace(cell, policy="tdgc"), 7, 0.75, 6)
    assert np.array_equal(pushes, other)
    later = push_velocities(dataclasses.replace(cell, first=2, count=2), 7, 0.75, 6)
    assert np.array_equal(pushes[2:], later)


class Watcher(BaselineDriver):
    """A baseline that keeps the terrain, the goals and the poses it begins with."""

    def begin(self, loco: Locomotion, goal: Array, *told: Any) -> None:
        super().begin(loco, goal, *told)
        assert loco.world.field is not None
        start = loco.world.state
        poses = [start.position, start.quaternion, start.q]
        self.given = [loco.world.field.heights.copy(), goal.copy(), *(x.copy() for x in poses)]


def test_every_policy_gets_the_same_tiles_starts_and_goals(low, monkeypatch):
    monkeypatch.setattr(evaluation, "HORIZON", 0.02)
    given = []
    for policy, seed in (("gp", 5), ("tdgc", 5), ("tdgc", 6)):
        driver = Watcher()
        run_cell(Cell(policy, "nominal", "rough", 8, 3, 2), low, driver, seed)
        given.append(driver.given)
    for mine, same, other in zip(*given, strict=True):
        assert np.array_equal(mine, same)
        assert other is given[2][-1] or not np.array_equal(mine, other)  # joints start alike
    tile = tile_of(5, "rough", 8, 4)
    assert np.array_equal(given[0][0][161:], tile.heights)
    assert given[0][1][1] == pytest.approx(tile.goal + [8.05, 0.0])


def test_an_episode_alone_and_twice(low, monkeypatch):
    monkeypatch.setattr(evaluation, "HORIZON", 1.0)
    cell = Cell("gp", "nominal", "rough", 6, 3, 2)
    first, second = (run_cell(cell, low, BaselineDriver(), seed=5) for _ in range(2))
    for k, (a, b) in enumerate(zip(first, second, strict=True)):
        assert a.row() == b.row() and np.array_equal(a.track, b.track)
        assert a.outcome == "timeout" and a.time_s == pytest.approx(1.0)
        tile = tile_of(5, "rough", 6, 3 + k)
        assert a.track.shape == (6, 3)  # at 0, 0.2, ..., 0.8 s and at the end
        assert a.track[0] == pytest.approx(tile.start, abs=1e-6)
        assert a.goal == pytest.approx(tile.goal)
        direct = np.linalg.norm(np.diff(a.track[:, :2], axis=0), axis=1).sum()
        assert 0.1 < direct <= a.path_m + 1e-9  # the path is longer than its chords


class Told(BaselineDriver):
    """A baseline that keeps the robots, their clocks at the start and what it is told."""

    def begin(self, loco: Locomotion, goal: Array, *told: Any) -> None:
        super().begin(loco, goal, *told)
        self.loco, self.told, self.clock = loco, told, loco.clock.clock.copy()


def test_noise_follows_from_the_episode(low, monkeypatch):
    """An episode's clock, sensors and probes are the same alone, in a batch, for any policy."""
    monkeypatch.setattr(evaluation, "HORIZON", 0.1)
    runs = {}
    for key, policy, condition, first, count in (
        ("batch", "gp", "noise", 2, 3),
        ("other policy", "tdgc", "noise", 2, 3),
        ("alone", "gp", "noise", 3, 1),
        ("exact", "gp", "nominal", 2, 3),
    ):
        driver = Told()
        run_cell(Cell(policy, condition, "rough", 6, first, count), low, driver, seed=5)
        noise = driver.told[1]
        probes = None if noise is None else noise.draws.uniform(-1.0, 1.0, (count, 4))
        runs[key] = (driver.clock, driver.loco.targets[0], probes)
    for mine, same, alone in zip(runs["batch"], runs["other policy"], runs["alone"], strict=True):
        assert np.array_equal(mine, same)
        assert mine[1:2] == pytest.approx(alone, abs=1e-5)  # other batch sizes round differently
    assert len(set(runs["batch"][0])) == 3 and (runs["exact"][0] == 0.0).all()
    assert runs["exact"][2] is None
    # Noise of 0.01 rad in the joint angles shows in the joint targets.
    assert np.abs(runs["batch"][1] - runs["exact"][1]).max() > 0.01


def test_noise_is_that_of_training_and_all_probes_are_late():
    noise = CONDITIONS["noise"].noise
    assert noise == dataclasses.replace(RandomisationConfig(), probe_delay=1.0)
    assert noise.noise_probes == 0.02 and noise.scale == 1.0


def test_without_a_family_it_is_unknown(low, monkeypatch):
    monkeypatch.setattr(evaluation, "HORIZON", 0.02)
    for condition, told in (("nominal", "rough"), ("no-family", "unknown")):
        driver = Told()
        run_cell(Cell("gp", condition, "rough", 6, 0, 1), low, driver, seed=5)
        assert driver.told == (told, None)


def test_a_mirrored_tile_is_walked_in_mirror_image(low, monkeypatch):
    """Agreement is to 0.03 m and rad, because Bullet's triangles and solver are not symmetric."""
    monkeypatch.setattr(evaluation, "HORIZON", 1.0)
    tracks = [
        run_cell(Cell("gp", condition, "tilt", 6, 3, 1), low, BaselineDriver(), seed=5)[0].track
        for condition in ("nominal", "mirrored")
    ]
    image = np.array([0.0, 8.0, 0.0]) + tracks[1] * [1.0, -1.0, -1.0]
    np.testing.assert_allclose(image[0], tracks[0][0], atol=1e-6)
    np.testing.assert_allclose(image[-1], tracks[0][-1], atol=0.03)
    assert np.hypot(*(tracks[0][-1] - tracks[0][0])[:2]) > 0.2


class Recorder(HierarchyDriver):
    """A hierarchy that keeps its commands."""

    def begin(self, loco: Locomotion, goal: Array, *told: Any) -> None:
        super().begin(loco, goal, *told)
        self.said: list[Array] = []

    def command(self, step: int) -> Array:
        self.said.append(super().command(step))
        return self.said[-1]


def test_shares_are_of_the_gaits_commanded(low, high, monkeypatch):
    monkeypatch.setattr(evaluation, "HORIZON", 1.0)
    driver = Recorder(*load_high(high, low, mdp_of(low)))
    episodes = run_cell(Cell("tdgc", "nominal", "rough", 0, 0, 2), low, driver, seed=0)
    assert np.count_nonzero(episodes[0].shares) > 1
    for k, episode in enumerate(episodes):
        said = np.array(driver.said)[: round(episode.time_s / 0.02), k, 12:]
        for embedding, share in zip(GAIT_TABLE, episode.shares, strict=True):
            assert share == pytest.approx(np.mean((said == embedding).all(axis=1)))
        assert sum(episode.shares) == pytest.approx(1.0)


def test_tracking_measures_against_the_command(low):
    result = track_gait(low, "trot", episodes=2, seed=0)
    assert set(result) == {"velocity_rmse", "yaw_rate_rmse", "contact_match"}
    # A policy that stood still would be off by the commands' own spread, sqrt((1 + 0.36) / 3).
    assert 0.0 < result["velocity_rmse"] < math.sqrt((1.0 + 0.36) / 3.0)
    assert 0.5 < result["contact_match"] <= 1.0


# ------------------------------------------------------------------ the script


def test_results_have_a_row_and_a_track_an_episode(table):
    rows = rows_of(table)
    assert list(rows[0]) == [
        "policy", "condition", "family", "level", "episode", "seed", "outcome", "time_s", "path_m",
        "energy_j",
        *(f"share_{gait}" for gait in GAITS),
    ]  # fmt: skip
    assert [(r["policy"], r["episode"]) for r in rows] == [
        ("tdgc", "0"), ("tdgc", "1"), ("gp", "0"), ("gp", "1"),
    ]  # fmt: skip
    assert all(r["outcome"] in OUTCOMES and 0.0 < float(r["time_s"]) <= 20.0 for r in rows)
    assert all(float(r["share_trot"]) == 1.0 for r in rows[2:])
    with np.load(table / "trajectories.npz") as data:
        assert data["counts"].sum() == len(data["poses"])
        times = np.array([float(r["time_s"]) for r in rows])
        assert data["counts"].tolist() == (np.ceil(times / 0.2 - 1e-6) + 1).tolist()
        starts = data["poses"][np.cumsum(data["counts"]) - data["counts"]]
        assert np.array_equal(starts[:2], starts[2:])  # paired
        assert np.array_equal(data["goals"][:2], data["goals"][2:])
    summary = json.loads((table / "summary.json").read_text(encoding="utf-8"))
    assert (
        list(summary) == ["tdgc", "gp", "paired", "editions"]
        and summary["gp"]["nominal"]["gap"]["10"]["n"] == 2
    )
    figures = {path.name for path in table.glob("*.png")}
    assert figures == {"success.png", "gaits.png", "headings.png", "trajectories.png"}


def test_the_table_does_not_depend_on_the_processes(table, low, high, tmp_path):
    """Two processes and one give the same rows; so does a cell run in this one, after others."""
    flags = ["--policies", "tdgc,gp", "--high", str(high), "--workers", "1"]
    assert evaluate.main([*SMALL, *flags, "--out", str(tmp_path)]) == 0
    for name in ("episodes.csv", "summary.json"):
        assert (tmp_path / name).read_bytes() == (table / name).read_bytes()
    with np.load(table / "trajectories.npz") as one, np.load(tmp_path / "trajectories.npz") as two:
        assert all(np.array_equal(one[key], two[key]) for key in ("poses", "counts", "goals"))
    driver = HierarchyDriver(*load_high(high, low, mdp_of(low)))
    here = run_cell(Cell("tdgc", "nominal", "gap", 10, 0, 2), low, driver, seed=3)
    assert [{k: str(v) for k, v in e.row().items()} for e in here] == rows_of(table)[:2]


@pytest.mark.usefixtures("in_process")
def test_without_a_high_level_the_baseline_runs_alone(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(evaluate, "SHIPPED_HIGH", tmp_path / "none")
    monkeypatch.setattr(evaluation, "HORIZON", 0.2)
    flags = ["--levels", "10", "--families", "gap", "--episodes", "1", "--workers", "1"]
    assert evaluate.main([*flags, "--out", str(tmp_path / "out")]) == 0
    assert {row["policy"] for row in rows_of(tmp_path / "out")} == {"gp"}
    capsys.readouterr()
    assert evaluate.main(["--policies", "tdgc"]) == 2
    message = "no high policy is shipped: give one with --high, or --policies gp"
    assert capsys.readouterr().err == f"evaluate.py: {message}\n"


ALONE = (
    "--tracking is of the low policy alone, on a plane: "
    "no --policies, --conditions, --families, --levels or --high"
)
NOT_OF_TRACKING = (
    ("--policies", "gp"),
    ("--conditions", "nominal"),
    ("--families", "all"),
    ("--levels", "6-10"),
    ("--high", "elsewhere/high"),
)
GUI_DRIVE = "--gui drive is of the low policy alone: no --policies or --high"
GUI_CONDITION = "--gui shows the nominal condition: no --conditions"


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--policies", "wtw"], "unknown policy 'wtw'; allowed: all, tdgc, gp, cues, teacher"),
        (["--families", "gap,gap"], "family 'gap' is named twice"),
        (["--levels", "6-8,7"], "--levels '6-8,7' names a level twice"),
        (["--levels", "13"], "--levels '13' must name levels from 0 to 12, upwards"),
        (["--levels", "high"], "cannot read --levels 'high'; write e.g. 6-10 or 0,5,10"),
        (["--levels", "6-"], "cannot read --levels '6-'; write e.g. 6-10 or 0,5,10"),
        (["--levels", "9-6,3"], "--levels '9-6,3' must name levels from 0 to 12, upwards"),
        (["--policies", ""], "unknown policy ''; allowed: all, tdgc, gp, cues, teacher"),
        *((["--tracking", *flag], ALONE) for flag in NOT_OF_TRACKING),
        *(
            (["--gui", mode, "--conditions", "pushes"], GUI_CONDITION)
            for mode in ("drive", "watch")
        ),
        *(
            (["--gui", "drive", flag, value], GUI_DRIVE)
            for flag, value in (("--policies", "gp"), ("--high", "elsewhere/high"))
        ),
        (["--workers", "0"], "--workers must be at least 1, not 0"),
        (["--seed", "-1"], "--seed must lie in [0, 2**32), not -1"),
        (["--high", "nowhere/high"], "nowhere/high.json: no such file"),
        (
            ["--policies", "gp", "--high", "nowhere/high"],
            "--high has no effect: gp uses no high policy",
        ),
        (["--policies", "all,cues"], "'all' must stand alone, not in 'all,cues'"),
        (["--families", "all,no.npy"], "'all' must stand alone, not in 'all,no.npy'"),
        (
            ["--gui", "watch", "--policies", "gp,tdgc", "--set", "decoder.vx.high=0.6"],
            "--gui watch shows the first policy, gp, but --tune and --set change tdgc",
        ),
        (["--video", "3", "--episodes", "2"], "--video must lie in [0, --episodes], not 3"),
        (["--video", "-1"], "--video must lie in [0, --episodes], not -1"),
        (["--video", "--tracking"], "--tracking has no episodes to film: no --video"),
        (["--gui", "--video"], "--gui only shows the robot: no --tracking, --trace or --video"),
        (
            ["--policies", "gp", "--set", "decision_rate=5"],
            "--tune and --set change tdgc, which is not among the policies",
        ),
        (
            ["--set", "vx=1"],
            "unknown configuration key 'vx'; allowed: decoder, decision_rate, safety",
        ),
        (["--set", "vx"], "cannot read --set 'vx'; write key=value, e.g. a.b=0.5"),
        (["--tune", "none.json"], "none.json: No such file or directory"),
        (
            ["--set", "decoder.vx.high=1.5"],
            "decoder.vx.high=1.5: the low policy was trained on [-1.0, 1.2]",
        ),
        (
            ["--tracking", "--set", "decision_rate=5"],
            "--tracking is of the low policy alone: no --trace, --tune or --set",
        ),
        (["--trace", "0"], "--trace must be all, failed or a number from 1, not '0'"),
        (
            ["--tracking", "--trace", "all"],
            "--tracking is of the low policy alone: no --trace, --tune or --set",
        ),
    ],
)
def test_flags_that_cannot_be_used(flags, message, capsys):
    assert evaluate.main(flags) == 2
    assert capsys.readouterr().err == f"evaluate.py: {message}\n"


def test_a_cluster_without_cpus_is_refused(monkeypatch, capsys):
    monkeypatch.setattr(cluster, "connect", lambda address: 0)
    assert evaluate.main(["--policies", "gp", "--cluster", "auto"]) == 2
    said = "evaluate.py: the cluster's 0 CPUs are too few for 1 workers\n"
    assert capsys.readouterr().err == said


def test_two_maps_whose_files_would_have_the_same_names(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name in ("my map.npy", "my-map.npy"):
        np.save(name, np.zeros((161, 161)))
    assert evaluate.main(["--policies", "gp", "--families", "my map.npy,my-map.npy"]) == 2
    said = "files of 'my map.npy' and 'my-map.npy' would have the same names"
    assert capsys.readouterr().err == f"evaluate.py: {said}\n"


def test_a_policy_of_the_wrong_kind(high, capsys):
    assert evaluate.main(["--low", str(high)]) == 2
    assert capsys.readouterr().err.endswith("high: not a low policy of this package\n")
    for policy in ("tdgc", "teacher"):  # whose manner of walking is in the file
        assert evaluate.main(["--policies", policy, "--high", str(PRETRAINED / "low")]) == 2
        assert capsys.readouterr().err.endswith("low: not a high policy of this package\n")


def test_an_evaluation_checks_itself():
    """``Evaluation`` itself refuses what the flags refuse."""
    whole = evaluate.Evaluation.of(evaluate.parse(["--policies", "gp", "--workers", "1"]))
    assert (whole.mode, whole.levels, whole.policies) == ("table", (6, 7, 8, 9, 10), ("gp",))
    for change, message in (
        ({"mode": "watch", "cluster": "auto"}, "--gui shows a robot of this machine"),
        ({"mode": "drive", "tuning": Tuning()}, "--gui drive is of the low policy alone"),
        ({"mode": "tracking", "filmed": 1}, "--tracking has no episodes to film"),
        ({"policies": ("tdgc",), "high": None}, "no high policy is shipped"),
    ):
        with pytest.raises(ValueError, match=re.escape(message)):
            dataclasses.replace(whole, **change)


@pytest.mark.usefixtures("in_process")
def test_the_teacher_leads_on_any_terrain(tmp_path):
    """On a user's map it leaps over a trench and finds the gate in a wall; it also leads on two
    families in one tile, and where the family is not told."""
    x, y = np.meshgrid(np.arange(161) * 0.05, np.arange(161) * 0.05, indexing="ij")
    heights = np.where(np.abs(x - 3.0) < 0.11, -0.6, 0.0)
    heights[(np.abs(x - 5.0) < 0.11) & (np.abs(y - 4.0) < 0.8)] = 0.5
    course = tmp_path / "course.npy"
    np.save(course, heights)
    out = tmp_path / "out"
    flags = ["--policies", "teacher", "--conditions", "no-family", "--workers", "1"]
    flags += ["--families", f"{course},mixed", "--levels", "10", "--episodes", "2"]
    assert evaluate.main([*flags, "--out", str(out)]) == 0
    own, mixed = (
        [row for row in read_csv(out / "episodes.csv") if row["family"] == family]
        for family in (str(course), "mixed")
    )
    assert {row["outcome"] for row in own} == {"reached"}
    assert mixed and all(float(row["path_m"]) > 3.0 for row in mixed)


@pytest.mark.usefixtures("quick_landing")
def test_the_scripts_command_as_the_teacher_of_the_high_policy_did(low, tmp_path, capsys):
    """A high policy of another robot had a teacher that walked, stepped and leapt differently."""
    config, high = mdp_of(low), tmp_path / "high"
    header = json.loads((PRETRAINED / "high.json").read_text(encoding="utf-8"))
    flags = ["--policies", "teacher", "--families", "stair", "--workers", "1", "--high", str(high)]
    shutil.copy(PRETRAINED / "high.safetensors", tmp_path)
    walked = []
    for taught in (TeacherConfig(), TeacherConfig(0.9, 3.3, 1.0)):
        header["meta"]["teacher"] = to_dict(taught)
        high.with_suffix(".json").write_text(json.dumps(header), encoding="utf-8")
        asked = evaluate.Evaluation.of(evaluate.parse(flags))
        (driver,) = asked.drivers(low, config).values()
        (episode,) = run_cell(Cell("teacher", "nominal", "rough", 2, 0, 1), low, driver, 0)
        walked.append(episode.path_m / episode.time_s)
    assert walked[1] > 1.3 * walked[0]  # 0.9 m/s and 0.6 m/s, but for the ends
    del header["meta"]["teacher"]["leap_speed"]
    high.with_suffix(".json").write_text(json.dumps(header), encoding="utf-8")
    assert evaluate.main(flags) == 2
    assert "high, meta.teacher: the key 'leap_speed' is missing" in capsys.readouterr().err


def test_without_a_high_policy_the_scripts_try_out_what_suits_the_low_policy(
    low, monkeypatch, capsys
):
    def arrives(low: Any, env: Any, manner: TeacherConfig, family: str) -> int:
        return 48 * (manner.walk_speed == 0.9 if family == "stair" else manner.leap_speed == 1.0)

    monkeypatch.setattr(manners, "arrivals", arrives)
    asked = evaluate.Evaluation.of(evaluate.parse(["--policies", "teacher"]))
    skill = dataclasses.replace(asked, high=None).skill(low, mdp_of(low))
    assert skill.manner == TeacherConfig(0.9, 3.3, 1.0)
    said = capsys.readouterr().out.splitlines()
    assert said[0] == "there is no high policy: trying out how the low policy walks and leaps best"
    assert said[-1] == "trial: 48 of 48 robots leap over trenches at 1 m/s"


def test_the_window_shows_the_tuned_policy(monkeypatch):
    flags = ["--gui", "watch", "--workers", "1", "--policies", "tdgc"]
    shown = []
    monkeypatch.setattr(gui, "watch", lambda low, driver, cell, seed: shown.append((driver, cell)))
    assert evaluate.main(flags) == evaluate.main([*flags, "--set", "safety.max_speed=0.3"]) == 0
    (plain, first), (tuned, second) = shown
    assert (first.policy, second.policy) == ("tdgc", "tdgc-tuned")
    assert not isinstance(plain, TunedDriver) and isinstance(tuned, TunedDriver)


def test_the_baseline_keeps_to_what_the_low_policy_was_trained_on(low):
    narrow = dataclasses.replace(CommandRanges(), vx=(-0.3, 0.3))
    config = dataclasses.replace(mdp_of(low), commands=narrow)
    asked = evaluate.Evaluation.of(evaluate.parse(["--policies", "gp", "--workers", "1"]))
    assert asked.drivers(low, config)["gp"].bounds == narrow


def test_the_robot_is_read_for_diagnoses_alone(low, monkeypatch):
    monkeypatch.setattr(evaluation, "HORIZON", 0.04)
    read, robots = evaluate.read_geometry, []
    monkeypatch.setattr(
        evaluate, "read_geometry", lambda robot: robots.append(robot) or read(robot)
    )
    cell, drivers = Cell("gp", "nominal", "rough", 6, 0, 1), {"gp": BaselineDriver()}
    plain = evaluate.run_one(cell, low, drivers, 5, 0, None)
    assert (robots, plain.diagnoses, plain.traces) == ([], [], [])
    traced = evaluate.run_one(cell, low, drivers, 5, 0, Selection.parse("failed"))
    assert robots == [mdp_of(low).robot]
    assert (
        [d.outcome for d in traced.diagnoses] == [t.outcome for t in traced.traces] == ["timeout"]
    )


# ------------------------------------------------------------------ stopped

RunJobs = Callable[[Callable[[Any], Any], Sequence[Any], int], Iterator[Any]]


def stopped(after: int, error: BaseException | None) -> RunJobs:
    """A ``run_jobs`` that does the first ``after`` jobs and then raises ``error``; without one, the
    process gets a SIGTERM."""

    def run_jobs(work: Callable[[Any], Any], jobs: Sequence[Any], workers: int) -> Iterator[Any]:
        yield from map(work, jobs[:after])
        if error is not None:
            raise error
        os.kill(os.getpid(), signal.SIGTERM)
        yield from map(work, jobs[after:])

    return run_jobs


def answer(flags: list[str]) -> int | str | None:
    """The script's exit status."""
    try:
        return evaluate.main(flags)
    except SystemExit as end:
        return end.code


#: Flags of two policies with two cells each; with ``BATCH`` 1, a cell is two batches.
FOUR = ["--levels", "9,10", "--families", "gap", "--episodes", "2", "--workers", "1"]
DIED = "a process died, perhaps out of memory"
BLOWN = "Cell(...): a robot's position is not finite"


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (KeyboardInterrupt(), "stopped by Ctrl-C"),
        (WorkerError(DIED), DIED),
        (FloatingPointError(BLOWN), BLOWN),
        (InputError("terrain 'no.npy' cannot be read"), "terrain 'no.npy' cannot be read"),
        (OSError(errno.ENOSPC, "No space left on device"), "[Errno 28] No space left on device"),
        (MemoryError(), "MemoryError"),
        (None, "stopped by SIGTERM"),
    ],
)
def test_what_is_complete_is_kept(error, reason, high, tmp_path, monkeypatch, capsys):
    """Stopped before the last batch, an evaluation drops only the last cell, which lacks half."""
    before = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(evaluation, "BATCH", 1)
    monkeypatch.setattr(evaluation, "HORIZON", 0.04)
    monkeypatch.setattr(evaluate, "run_jobs", stopped(7, error))
    status = 2 if isinstance(error, InputError) else 1
    assert answer([*FOUR, "--high", str(high), "--out", str(tmp_path)]) == status
    said = capsys.readouterr()
    lines = [line for line in said.err.splitlines() if line.startswith("evaluate.py")]
    assert lines == [f"evaluate.py: {reason}; the table has 6 of 8 episodes"]
    assert "Traceback" not in said.err
    assert [(r["policy"], r["level"], r["episode"]) for r in rows_of(tmp_path)] == [
        ("tdgc", "9", "0"), ("tdgc", "9", "1"), ("tdgc", "10", "0"), ("tdgc", "10", "1"),
        ("gp", "9", "0"), ("gp", "9", "1"),
    ]  # fmt: skip
    summary = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert list(summary) == ["tdgc", "gp", "editions"]  # not paired: different tiles
    assert summary["gp"]["nominal"]["mean"]["n"] == 2 and "gp, nominal" in said.out
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"episodes.csv", "summary.json", "trajectories.npz"}
    assert signal.getsignal(signal.SIGTERM) is before


def test_without_a_complete_cell_there_is_no_table(tmp_path, monkeypatch, capsys):
    """The files of an earlier evaluation are removed as well."""
    old = ["episodes.csv", "summary.json", "trajectories.npz", "report.html", "diagnosis.csv"]
    old += ["success.png", "gaits.png", "headings.png", "trajectories.png", "notes.txt"]
    for name in old:
        (tmp_path / name).touch()
    monkeypatch.setattr(evaluation, "BATCH", 1)
    monkeypatch.setattr(evaluation, "HORIZON", 0.04)
    monkeypatch.setattr(evaluate, "run_jobs", stopped(1, WorkerError(DIED)))
    assert evaluate.main([*FOUR, "--policies", "gp", "--out", str(tmp_path)]) == 1
    said = f"evaluate.py: {DIED}; no table, as 0 of 4 episodes are of complete cells"
    assert capsys.readouterr().err.splitlines()[-1] == said
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def test_results_stay_if_the_robot_cannot_be_loaded(low, tmp_path, capsys):
    text = urdf_path(mdp_of(low).robot).read_text()
    box = '<geometry><box size="0.42 0.15 0.11"/></geometry>'
    mesh = text.replace(box, '<geometry><mesh filename="absent.obj"/></geometry>')
    assert mesh != text
    (tmp_path / "robot.urdf").write_text(mesh)
    robot = {**low.meta["config"]["robot"], "urdf": str(tmp_path / "robot.urdf")}
    config = {**low.meta["config"], "robot": robot}
    policies.save_copy(tmp_path / "low", low, {**low.meta, "config": config})
    (tmp_path / "summary.json").write_text("earlier")
    flags = ["--policies", "gp", "--low", str(tmp_path / "low"), "--out", str(tmp_path)]
    assert evaluate.main([*FOUR, *flags]) == 2
    said = capsys.readouterr().err
    assert said.startswith("evaluate.py: ") and said.count("\n") == 1 and "robot.urdf" in said
    assert (tmp_path / "summary.json").read_text() == "earlier"


@pytest.mark.parametrize(
    ("meta", "message"),
    [
        ({"benchmark": "2"}, "'benchmark' must be"),
        ({"config": {"gyro": False}}, "its configuration gives 87 observations, it takes 90"),
    ],
)
def test_results_stay_if_the_low_policy_cannot_be_used(
    meta, message, low, tmp_path, monkeypatch, capsys
):
    config = {**low.meta["config"], **meta.get("config", {})}
    policies.save_copy(tmp_path / "low", low, {**low.meta, **meta, "config": config})
    for mode, name in (("--policies=gp", "summary.json"), ("--tracking", "tracking.json")):
        (tmp_path / name).write_text("earlier")
        flags = [mode, "--low", str(tmp_path / "low"), "--out", str(tmp_path)]
        assert evaluate.main(["--episodes", "1", "--workers", "1", *flags]) == 2
        said = capsys.readouterr().err
        assert message in said and said.count("\n") == 1
        assert (tmp_path / name).read_text() == "earlier"


@pytest.mark.usefixtures("in_process")
def test_scripts_say_that_a_low_policy_cannot_leap(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(evaluate, "measure_landing", lambda *_: None)
    monkeypatch.setattr(evaluation, "HORIZON", 0.04)
    flags = ["--families", "gap", "--levels", "6", "--episodes", "1", "--workers", "1"]
    assert evaluate.main([*flags, "--policies", "teacher", "--out", str(tmp_path)]) == 0
    said = "the low policy falls when it leaps: scripts walk over trenches\n"
    assert said in capsys.readouterr().out


def test_a_results_folder_that_cannot_be_made_is_refused_at_once(tmp_path, monkeypatch, capsys):
    """Before the walks and leaps of a low policy without a high one are tried out."""
    monkeypatch.setattr(evaluate, "find_manner", None)
    monkeypatch.setattr(evaluate, "SHIPPED_HIGH", tmp_path / "none")
    (tmp_path / "file").touch()
    assert evaluate.main(["--policies", "teacher", "--out", str(tmp_path / "file" / "out")]) == 2
    assert "cannot be used: Not a directory" in capsys.readouterr().err


def test_ctrl_c_stops_what_called_the_script_too(tmp_path, monkeypatch):
    """The script raises ``SystemExit``; after a status the ablation would run its next trial."""
    monkeypatch.setattr(evaluate, "run_jobs", stopped(0, KeyboardInterrupt()))
    with pytest.raises(SystemExit):
        evaluate.main([*FOUR, "--policies", "gp", "--out", str(tmp_path)])


def test_a_tracking_that_is_stopped_is_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(evaluate, "run_jobs", stopped(0, FloatingPointError(BLOWN)))
    assert evaluate.main(["--tracking", "--workers", "1", "--out", str(tmp_path)]) == 1
    assert capsys.readouterr().err == f"evaluate.py: {BLOWN}\n"


def test_a_training_may_rewrite_the_policy_meanwhile(low, tmp_path, monkeypatch):
    monkeypatch.setattr(evaluation, "HORIZON", 0.04)
    high = save_high(tmp_path / "high", (low, mdp_of(low)), meta={"benchmark": 2})

    def run_jobs(work: Callable[[Any], Any], jobs: Sequence[Any], workers: int) -> Iterator[Any]:
        high.with_suffix(".json").write_text("{", encoding="utf-8")
        yield from map(work, jobs)

    monkeypatch.setattr(evaluate, "run_jobs", run_jobs)
    flags = ["--policies", "tdgc", "--high", str(high), "--out", str(tmp_path / "out")]
    assert evaluate.main([*FOUR, *flags]) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))
    assert summary["editions"]["high"] == 2 and summary["tdgc"]["nominal"]["mean"]["n"] == 4


@pytest.mark.usefixtures("in_process", "quick_landing")
def test_cues_are_a_policy_of_the_script(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(evaluation, "HORIZON", 0.2)
    flags = ["--levels", "4", "--families", "pillar", "--episodes", "1", "--workers", "1"]
    assert evaluate.main([*flags, "--policies", "cues", "--out", str(tmp_path)]) == 0
    assert [row["policy"] for row in rows_of(tmp_path)] == ["cues"]
    assert "cues, nominal" in capsys.readouterr().out


# ------------------------------------------------------------------ what reaches the robots


class Stand:
    """Driver that keeps the default command and notes the steps."""

    def __init__(self):
        self.steps = []

    def begin(self, loco, *_):
        self.loco = loco

    def command(self, step):
        self.steps.append(step)
        return self.loco.command


@pytest.mark.parametrize(
    ("name", "friction", "payload", "delay", "armature", "motor"),
    [
        ("nominal", 0.8, 0.0, 0.0, 0.0, 1.0),
        ("friction-0.4", 0.4, 0.0, 0.0, 0.0, 1.0),
        ("payload-3kg", 0.8, 3.0, 0.0, 0.0, 1.0),
        ("latency-30ms", 0.8, 0.0, 0.03, 0.0, 1.0),
        ("armature-0.01", 0.8, 0.0, 0.0, 0.01, 1.0),
        ("motor-0.85", 0.8, 0.0, 0.0, 0.0, 0.85),
    ],
)
def test_a_condition_reaches_the_robots(name, friction, payload, delay, armature, motor):
    """In Bullet itself, where Bullet can say."""
    batch = Batch(Cell("gp", name, "rough", 6, 0, 2), LowLevelConfig(), 0)
    world = batch.loco.world
    for body, client in zip(world._bodies, world._client_of, strict=True):
        mass, mu, *_ = client.getDynamicsInfo(body, -1)
        assert (mass, mu) == pytest.approx((world.state.geometry.trunk_mass + payload, friction))
        inertia = client.getDynamicsInfo(body, -1)[2]
        share = mass / world.state.geometry.trunk_mass  # the payload is spread over the trunk
        # The rotors of the hips turn about the trunk's longitudinal axis.
        assert inertia[0] == pytest.approx(share * 0.016147 + 4.0 * armature)
    assert batch.loco.delay.tolist() == [delay] * 2
    assert world.strength[:, 0].tolist() == [motor] * 2
    world.close()


def test_robots_are_pushed_every_three_seconds(monkeypatch):
    monkeypatch.setattr(evaluation, "HORIZON", 6.2)
    driver, pushes, push = Stand(), [], BulletWorld.push

    def note(world, index, velocity):
        pushes.append((len(driver.steps), np.array(index), np.array(velocity)))
        push(world, index, velocity)

    monkeypatch.setattr(BulletWorld, "push", note)
    cell = Cell("gp", "pushes", "rough", 0, 0, 2)
    run_cell(cell, load_low(PRETRAINED / "low")[0], driver, 5)
    drawn = push_velocities(cell, 5, 0.75, 3)
    assert [steps for steps, *_ in pushes] == [150, 300]  # control steps of 20 ms
    for k, (_, index, velocity) in enumerate(pushes):
        np.testing.assert_array_equal(velocity, drawn[index, k])


def test_the_sensors_noise_reaches_the_low_policy(monkeypatch):
    monkeypatch.setattr(evaluation, "HORIZON", 0.1)
    given, make = [], evaluation.Executor

    def note(loco, low, noise):
        given.append(noise)
        return make(loco, low, noise)

    monkeypatch.setattr(evaluation, "Executor", note)
    for name in ("noise", "nominal"):
        cell = Cell("gp", name, "rough", 6, 0, 2)
        run_cell(cell, load_low(PRETRAINED / "low")[0], Stand(), 5)
    assert given[0] is not None and given[1] is None


def test_a_robot_that_blows_up_spoils_its_cell(low, monkeypatch):
    """Its position is not finite; neighbours would fall through the ground from now on."""

    class Burst(BaselineDriver):
        def begin(self, loco, *rest):
            super().begin(loco, *rest)
            loco.world.strength[1] = np.nan

    monkeypatch.setattr(evaluation, "HORIZON", 0.2)
    with np.errstate(invalid="ignore"):
        with pytest.raises(FloatingPointError, match=r"^Cell\(.*position is not finite$"):
            run_cell(Cell("gp", "nominal", "rough", 0, 0, 2), low, Burst(), 5)
        with pytest.raises(FloatingPointError, match="diverged"):
            for loco in tracking.walk_on_plane(low, 2, 0.2, 0):
                loco.world.strength[0] = np.nan


def test_the_tracking_table_names_each_gaits_result(monkeypatch):
    monkeypatch.setattr(tracking, "track_gait", lambda low, gait, n, seed: {"of": (gait, n, seed)})
    monkeypatch.setattr(tracking, "count_falls", lambda low, n, seed: {"falls": (n, seed)})
    found = tracking.tracking(None, 10, 4, 1, lambda work, jobs, workers: map(work, jobs))
    assert found == {"gaits": {g: {"of": (g, 10, 4)} for g in GAITS}, "falls": (6, 4)}


def test_the_path_is_what_was_walked():
    low, config = load_low(PRETRAINED / "low")
    batch = Batch(Cell("gp", "nominal", "rough", 0, 0, 2), config, 0)
    log, executor = EpisodeLog(batch), Executor(batch.loco, low, batch.sensors)
    command = np.tile(default_command(), (2, 1))
    command[:, 0] = 0.5
    places = [batch.loco.world.state.position[:, :2].copy()]
    for step in range(100):
        executor.step(command, batch.live)
        log.add(step)
        batch.judge(step)
        places.append(batch.loco.world.state.position[:, :2].copy())
    batch.loco.world.close()
    walked = np.linalg.norm(np.diff(places, axis=0), axis=2).sum(axis=0)
    assert walked.min() > 0.5
    assert [episode.path_m for episode in log.episodes()] == pytest.approx(walked.tolist())


def test_falls_are_counted_once_per_robot(monkeypatch):
    """The time of a robot ends with its fall."""
    monkeypatch.setattr(tracking, "_FALL_SECONDS", 0.2)
    monkeypatch.setattr(tracking, "is_fallen", lambda world: np.array([True, False, False]))
    found = tracking.count_falls(load_low(PRETRAINED / "low")[0], 3, 0)
    assert found["falls"] == 1 and found["minutes"] == pytest.approx(2 * 0.2 / 60)
    assert found["falls_per_10_min"] == pytest.approx(10 / found["minutes"])


def test_the_shipped_policy_turns_as_commanded():
    """A robot that stands still is off by 0.58 rad/s, one that turns the other way by 0.98."""
    assert track_gait(load_low(PRETRAINED / "low")[0], "trot", 4, 0)["yaw_rate_rmse"] < 0.4


#: SHA-256 of the fourth tile of level 8 of ``--seed 0``: heights, start and goal to a micrometre.
EDITION_2 = {
    "rough": "710d38a250afa6ce",
    "pillar": "e5c880703eaaca55",
    "stair": "11de3079796fec17",
    "gap": "07f5fd0ad187b330",
    "tilt": "d0251895101818ba",
    "mixed": "61b6ae090450f4ff",
}


@pytest.mark.parametrize("family", EDITION_2)
def test_the_tiles_of_this_edition_never_change(family):
    """Other tiles would be another benchmark, whose results cannot be compared with these."""
    assert EDITION == 2
    tile = tile_of(0, family, 8, 3)
    values = np.concatenate([tile.heights.ravel(), tile.start, tile.goal]).round(6) + 0.0
    digest = hashlib.sha256(values.astype("<f8").tobytes()).hexdigest()
    assert digest.startswith(EDITION_2[family])
