"""Traces: they match what happened; files are read back unchanged, or refused."""

from __future__ import annotations

import dataclasses
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from test_drivers import CONFIG, save_high
from test_evaluation import SMALL

import evaluate
from tdgc.benchmark import evaluation, trace
from tdgc.benchmark.behaviour import MEANS
from tdgc.benchmark.drivers import BaselineDriver, Driver, HierarchyDriver, load_high
from tdgc.benchmark.evaluation import Batch, Cell, Episode, run_cell
from tdgc.benchmark.trace import COLUMNS, Selection, Trace, TraceError, Tracer
from tdgc.config import HighLevelConfig, HighRewardConfig
from tdgc.files import read_csv
from tdgc.sim.commands import CONTINUOUS, INDEX, NAMES, CommandDecoder
from tdgc.sim.gaits import FEET, GAITS
from tdgc.sim.locomotion import Locomotion
from tdgc.sim.robot import Array
from tdgc.tasks.low_rewards import commanded_gravity
from tdgc.tasks.probes import NUM_PROBES, PROBES, height_probes

ROOT = Path(__file__).resolve().parents[1]
HOLD = 5  # control steps per decision


class Notes(Tracer):
    """A tracer that also keeps each robot's state at every control step."""

    def begin(self, batch: Batch) -> None:
        super().begin(batch)
        self.goal, self.seen = batch.goal, [self._note(batch.loco)]
        self.probes = height_probes(batch.loco, PROBES[HighLevelConfig().probes])

    def step(self, step: int, live: Any) -> None:
        super().step(step, live)
        self.seen.append(self._note(self._loco))

    @staticmethod
    def _note(loco: Locomotion) -> dict[str, Array]:
        s = loco.world.state
        return {
            "position": s.position.copy(),
            "yaw": s.yaw.copy(),
            "lin_vel": s.lin_vel.copy(),
            "velocity": s.heading_vel.copy(),
            "turn": s.ang_vel[:, 2].copy(),
            "gravity": s.gravity.copy(),
            "height": loco.world.trunk_height(),
            "touch": s.foot_force > 1.0,
            "wanted": loco.clock.contact > 0.5,
            "probes": height_probes(loco, PROBES[HighLevelConfig().probes]),
            "power": np.abs(s.torque * s.qd).sum(axis=1),
            "force": np.column_stack([s.trunk_force, s.leg_force]),
            "command": loco.command.copy(),
            "carried out": loco.carried_out.copy(),
        }

    def over(self, decision: int, name: str, k: int) -> Array:
        """Values of ``name`` for robot ``k`` in the control steps after a decision."""
        first = HOLD * decision + 1
        return np.array([note[name][k] for note in self.seen[first : first + HOLD]])


def watch(driver: Driver, cell: Cell, low: Any) -> tuple[Notes, list[Trace], list[Episode]]:
    notes = Notes(driver)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluation, "HORIZON", 1.04)  # 52 steps: the last decision is cut short
        episodes = run_cell(cell, low, driver, 5, [notes])
    return notes, notes.traces(), episodes


@pytest.fixture(scope="module")
def watched_high(low, tmp_path_factory: pytest.TempPathFactory):
    return load_high(save_high(tmp_path_factory.mktemp("policy") / "high", low), *low)


@pytest.fixture(scope="module")
def watched(low, watched_high):
    """The notes, traces and episodes of a high policy whose decisions change quickly."""
    driver = HierarchyDriver(*watched_high)
    return watch(driver, Cell("tdgc", "nominal", "rough", 8, 3, 2), low[0])


# ------------------------------------------------------------------ what a trace says


def test_a_row_a_decision_and_one_for_the_end(watched):
    notes, traces, episodes = watched
    for k, (t, e) in enumerate(zip(traces, episodes, strict=True)):
        place = (t.policy, t.condition, t.family, t.level, t.episode, t.seed, t.outcome)
        assert place == ("tdgc", "nominal", "rough", 8, 3 + k, 5, e.outcome)
        assert list(t.columns) == [c.name for c in COLUMNS]
        assert {len(values) for values in t.columns.values()} == {12}
        assert t["time"] == pytest.approx([*np.arange(0.0, 1.01, 0.1), 1.04])
        assert t["seconds"][1:] == pytest.approx([0.1] * 10 + [0.04])
        assert [t["base_x"][-1], t["base_y"][-1], t["yaw"][-1]] == pytest.approx(e.track[-1])
        for decision in range(11):
            position = notes.seen[HOLD * decision]["position"][k]
            away = np.linalg.norm(notes.goal[k] - position[:2])
            assert t["goal_distance"][decision] == pytest.approx(away)
            assert t["base_z"][decision] == pytest.approx(position[2])


def test_decisions_are_those_of_the_policy_and_what_they_decode_to(watched):
    notes, traces, _ = watched
    decoder = CommandDecoder(CONFIG.commands)
    for k, t in enumerate(traces):
        actions = np.stack([t[f"action_{name}"] for name in (*CONTINUOUS, "gait")], axis=1)
        commands = np.stack([t[f"command_{name}"] for name in NAMES], axis=1)
        asked = commands.copy()
        asked[:, INDEX["frequency"]] = t["asked_frequency"]
        assert asked[:-1] == pytest.approx(decoder.decode(actions[:-1]), abs=1e-6)
        given = [notes.seen[HOLD * decision + 1]["command"][k] for decision in range(11)]
        assert asked[:-1] == pytest.approx(np.array(given), abs=1e-6)
        done = [notes.seen[HOLD * decision + 1]["carried out"][k] for decision in range(11)]
        assert commands[:-1] == pytest.approx(np.array(done), abs=1e-6)
        # Gaits change all the time here, and each begins at 3.5 Hz or faster.
        assert (t["command_frequency"] - t["asked_frequency"])[:-1].max() > 0.1
        assert t["gait"][:-1].tolist() == [GAITS[g] for g in decoder.gait(actions[:-1])]
        assert np.isnan(actions[-1]).all() and np.isnan(commands[-1]).all()
        assert t["gait"][-1] is None
    assert len({t["gait"][i] for t in traces for i in range(11)}) > 1


def test_commands_at_their_bounds_are_marked(low):
    class Extreme(BaselineDriver):
        def command(self, step: int) -> Array:
            command = super().command(step)
            command[:, [INDEX["vx"], INDEX["vy"]]] = 1.2, -0.6
            return command

    _, (t,), _ = watch(Extreme(), Cell("gp", "nominal", "rough", 0, 0, 1), low[0])
    marked = {name: set(t[f"at_bound_{name}"][:-1].tolist()) for name in CONTINUOUS}
    ends = {"vx": {1.0}, "vy": {-1.0}, "power_weight": {-1.0}}  # the last by default
    assert {name: marked.pop(name) for name in ends} == ends
    del marked["yaw_rate"]  # depends on the goal
    assert set().union(*marked.values()) == {0.0}


def test_cues_are_what_the_high_level_was_told(watched):
    notes, traces, _ = watched
    for k, t in enumerate(traces):
        assert set(t["family"]) == {"rough"}
        assert [t[f"probe_{i:02d}"][0] for i in range(32)] == pytest.approx(notes.probes[k])
        assert np.isnan(t["probe_00"][-1])  # the end has no decision


@pytest.mark.parametrize("probes", ["graded", "lines", "staggered"])
def test_it_says_where_the_probes_are(low, tmp_path, probes: str):
    config = dataclasses.replace(CONFIG, probes=probes)
    driver = HierarchyDriver(*load_high(save_high(tmp_path / "high", low, config), *low))
    _, (t,), _ = watch(driver, Cell("tdgc", "nominal", "stair", 8, 3, 1), low[0])
    trace.write(t, tmp_path)
    found = trace.read(tmp_path / t.file_name).probes
    places = np.array([place.split(",") for place in found.split(" ")], dtype=float)
    np.testing.assert_allclose(places, PROBES[probes], atol=1e-9)
    _, (blind,), _ = watch(BaselineDriver(), Cell("gp", "nominal", "stair", 8, 3, 1), low[0])
    assert blind.probes == ""


def test_cues_are_those_of_the_condition(low, watched_high):
    """With noise, probes are off by up to 2 cm and one decision late."""
    driver = HierarchyDriver(*watched_high)
    notes, traces, _ = watch(driver, Cell("tdgc", "noise", "stair", 8, 3, 2), low[0])
    for k, t in enumerate(traces):
        told = np.array([[t[f"probe_{i:02d}"][d] for i in range(32)] for d in range(3)])
        for decision, seen in enumerate((0, 0, 1)):
            off = np.abs(told[decision] - notes.seen[HOLD * seen]["probes"][k])
            assert 0.01 < off.max() <= 0.02 + 1e-6
    _, (t, _), _ = watch(driver, Cell("tdgc", "no-family", "stair", 8, 3, 2), low[0])
    assert set(t["family"]) == {"unknown"}


def test_execution_is_measured_since_the_decision_before(watched, low):
    notes, traces, _ = watched
    standing = low[1].robot.base_height
    for k, t in enumerate(traces):
        assert np.isnan(t["error_vx"][0]) and np.isnan(t["power"][0])
        for decision in range(11):
            command = notes.over(decision, "command", k)
            velocity, turn = notes.over(decision, "velocity", k), notes.over(decision, "turn", k)
            row = {name: values[decision + 1] for name, values in t.columns.items()}
            for j, name in enumerate(("vx", "vy")):
                expected = np.mean(velocity[:, j] - command[:, j])
                assert row[f"error_{name}"] == pytest.approx(expected, abs=1e-6)
            expected = np.mean(turn - command[:, INDEX["yaw_rate"]])
            assert row["error_yaw_rate"] == pytest.approx(expected, abs=1e-6)
            gx, gy, gz = notes.over(decision, "gravity", k).T
            height = notes.over(decision, "height", k) - standing
            for name, values in (
                ("pitch", np.arcsin(gx)), ("roll", np.arctan2(-gy, -gz)), ("body_height", height)
            ):  # fmt: skip
                expected = np.mean(values - command[:, INDEX[name]])
                assert row[f"error_{name}"] == pytest.approx(expected, abs=1e-6)
            touch, wanted = notes.over(decision, "touch", k), notes.over(decision, "wanted", k)
            for f, foot in enumerate(FEET):
                assert row[f"contact_{foot}"] == pytest.approx(touch[:, f].mean())
                assert row[f"match_{foot}"] == pytest.approx((touch == wanted)[:, f].mean())
            force = notes.over(decision, "force", k).max(axis=0)
            assert row["trunk_force"] == pytest.approx(force[0])
            assert row["leg_force"] == pytest.approx(force[1:].max())
            assert row["power"] == pytest.approx(notes.over(decision, "power", k).mean(), rel=1e-5)


def test_tilt_undoes_commanded_gravity():
    pitch, roll = np.array([0.3, -0.2]), np.array([-0.1, 0.2])
    np.testing.assert_allclose(trace.tilt(commanded_gravity(pitch, roll)), [pitch, roll])


def test_energy_of_an_episode_is_its_power_over_time(watched):
    _, traces, episodes = watched
    for t, e in zip(traces, episodes, strict=True):
        assert e.energy_j == pytest.approx(np.sum(t["power"][1:] * t["seconds"][1:]), rel=1e-5)
        assert e.energy_j > 10.0  # 12 kg walking for a second


def test_reward_terms_are_those_of_the_paper(watched):
    """They follow from the other columns by the formulas of Sec. IV-B."""
    notes, traces, _ = watched
    c, dt = HighRewardConfig(), 0.1
    low, high = np.array(dataclasses.astuple(CONFIG.commands)).T
    for k, t in enumerate(traces):
        p = np.clip(1.0 - t["goal_distance"][1:] / 8.0, 0.0, 1.0)
        expected = c.goal_distance * dt * (p + 1.0 - np.exp(-3.0 * p))
        assert t["reward_goal_distance"][1:] == pytest.approx(expected, rel=1e-5)
        expected = c.face * dt * np.cos(t["goal_bearing"][1:])
        assert t["reward_face"][1:] == pytest.approx(expected, rel=1e-4)
        assert t["reward_alive"][1:] == pytest.approx(c.alive * dt)
        actions = np.stack([t[f"action_{name}"] for name in (*CONTINUOUS, "gait")], axis=1)
        clipped = np.vstack([np.zeros(13), np.clip(actions[:-1], -1.0, 1.0)])
        expected = c.action_rate * dt * np.sum(np.diff(clipped, axis=0) ** 2, axis=1)
        assert t["reward_action_rate"][1:] == pytest.approx(expected, rel=1e-4)
        commands = np.stack([t[f"command_{name}"] for name in NAMES], axis=1)[:-1]
        commands[:, INDEX["frequency"]] = t["asked_frequency"][:-1]
        shares = np.hstack([(commands[:, :12] - low) / (high - low), 2.0 * commands[:, 12:]])
        expected = c.command_rate * dt * np.mean(np.diff(shares, axis=0) ** 2, axis=1)
        assert t["reward_command_rate"][2:] == pytest.approx(expected, rel=1e-4)
        for decision in range(11):
            force = notes.over(decision, "force", k).max(axis=0)
            expected = c.contact_force * dt * np.sum(np.maximum(force - 1.0, 0.0))
            assert t["reward_contact_force"][decision + 1] == pytest.approx(expected, abs=1e-6)
            now = notes.seen[min(HOLD * (decision + 1), 52)]
            slow = np.linalg.norm(now["lin_vel"][k]) < 0.1
            assert t["reward_laziness"][decision + 1] == pytest.approx(c.laziness * dt * slow)


def test_the_baseline_has_no_actions_and_no_cues(low):
    notes, traces, _ = watch(BaselineDriver(), Cell("gp", "nominal", "rough", 8, 3, 2), low[0])
    empty = [f"action_{name}" for name in (*CONTINUOUS, "gait")]
    empty += [f"probe_{i:02d}" for i in range(32)] + ["reward_action_rate"]
    for k, t in enumerate(traces):
        assert all(np.isnan(t[name]).all() for name in empty)
        assert set(t["family"]) == {None}
        assert set(t["gait"][:-1]) == {"trot"}
        assert t["command_vx"][0] == pytest.approx(notes.seen[1]["command"][k, 0])
        assert np.array_equal(t["at_bound_frequency"][:-1], np.zeros(11))


def test_robots_that_end_early_have_short_traces(low):
    """Two robots with dead motors fall while the third continues; each has its own end."""

    class Limp(BaselineDriver):
        def begin(self, loco: Locomotion, goal: Array, *told: Any) -> None:
            super().begin(loco, goal, *told)
            loco.world.strength[:2] = 0.0

    _, traces, episodes = watch(Limp(), Cell("gp", "nominal", "rough", 0, 0, 3), low[0])
    assert [e.outcome for e in episodes] == ["fell", "fell", "timeout"]
    for t, e in zip(traces, episodes, strict=True):
        steps = round(e.time_s / 0.02)
        assert t.outcome == e.outcome
        assert len(t["time"]) == -(-steps // HOLD) + 1
        assert t["time"][-1] == pytest.approx(e.time_s)
        assert np.isnan(t["command_vx"][-1]) and not np.isnan(t["command_vx"][-2])
        assert t["seconds"][1:].sum() == pytest.approx(e.time_s)


# ------------------------------------------------------------------ files


def same(a: Trace, b: Trace) -> bool:
    values = zip(a.columns.items(), b.columns.items(), strict=True)
    alike = all(
        m == n and (x.tolist() == y.tolist() if x.dtype == object else np.array_equal(x, y, True))
        for (m, x), (n, y) in values
    )
    meta = [f.name for f in dataclasses.fields(Trace) if f.name != "columns"]
    return alike and all(getattr(a, name) == getattr(b, name) for name in meta)


def test_a_file_holds_the_trace_and_says_what_it_is(watched, tmp_path):
    t = watched[1][0]
    path = trace.write(t, tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["tdgc_nominal_rough_08_003.parquet"]
    assert same(trace.read(path), t)
    schema = pq.read_schema(path)
    for c in COLUMNS:
        about = {k.decode(): v.decode() for k, v in schema.field(c.name).metadata.items()}
        assert (about["unit"], about["description"]) == (c.unit, c.meaning)
        assert schema.field(c.name).type in (pa.float32(), pa.string())  # scalars only
    meta = {k.decode(): v.decode() for k, v in schema.metadata.items()}
    assert meta["format"] == "tdgc-trace" and meta["version"] == "4"
    assert (meta["outcome"], meta["seed"], meta["episode"]) == (t.outcome, "5", "3")
    assert pq.read_table(path)["command_vx"].null_count == 1  # the end has no decision


def test_files_that_are_no_traces_are_refused(watched, tmp_path):
    with pytest.raises(TraceError, match=r"none.parquet: no such file$"):
        trace.read(tmp_path / "none.parquet")
    text = tmp_path / "text.parquet"
    text.write_text("time,vx\n0,1\n", encoding="utf-8")
    with pytest.raises(TraceError, match=r"text.parquet: damaged, or not a Parquet file$"):
        trace.read(text)
    other = tmp_path / "other.parquet"
    pq.write_table(pa.table({"time": [0.0]}), other)
    with pytest.raises(TraceError, match=r"other.parquet: not a trace of this package$"):
        trace.read(other)
    path = trace.write(watched[1][0], tmp_path)
    table = pq.read_table(path)
    meta = table.schema.metadata
    pq.write_table(table.replace_schema_metadata(meta | {b"version": b"1"}), other)
    with pytest.raises(TraceError, match=r"a trace of version 1, this package reads 4$"):
        trace.read(other)
    moved = table.schema.field("probe_00").with_metadata({"unit": "m", "description": "elsewhere"})
    place = table.schema.get_field_index("probe_00")
    for wrong in (
        table.drop_columns(["yaw"]),
        table.slice(0, 1),
        table.cast(table.schema.set(place, moved)),
    ):
        pq.write_table(wrong, other)
        with pytest.raises(TraceError, match=r"columns are not those of a trace of version 4$"):
            trace.read(other)
    lacking = {k: v for k, v in meta.items() if k != b"seed"}
    pq.write_table(table.replace_schema_metadata(lacking), other)
    with pytest.raises(TraceError, match=r"does not identify its episode$"):
        trace.read(other)


def test_a_damaged_file_is_refused_in_one_line(watched, tmp_path):
    t = watched[1][0]
    path = trace.write(t, tmp_path)
    content = path.read_bytes()
    rng = np.random.default_rng(0)
    for size in (0, 4, len(content) // 2, len(content) - 1):
        path.write_bytes(content[:size])
        with pytest.raises(TraceError, match=r"^[^\n]*damaged, or not a Parquet file$"):
            trace.read(path)
    refused = 0
    for place in rng.integers(4, len(content) - 8, 60):
        flipped = bytearray(content)
        flipped[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(flipped)
        try:
            found = trace.read(path)
        except TraceError as error:
            assert "\n" not in str(error)
            refused += 1
        else:  # the bit was redundant, or in the writer's name or the words of the metadata
            assert all(np.array_equal(found[c.name], t[c.name], c.unit != "") for c in COLUMNS)
    assert refused > 20


def test_no_half_file_is_left_behind(watched, tmp_path):
    t = watched[1][0]
    (tmp_path / t.file_name).mkdir()  # so that the file cannot replace it
    with pytest.raises(OSError):
        trace.write(t, tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == [t.file_name]


def test_the_table_in_the_docs_is_the_codes():
    text = (ROOT / "docs" / "trace.md").read_text(encoding="utf-8")
    rows = [line for line in text.split("## Columns")[1].splitlines() if line.startswith("| `")]
    wanted = []
    for c in COLUMNS:
        named, meaning = f"`{c.name}`", c.meaning.replace("|", "\\|")
        if c.name.startswith("probe_"):  # one row for all
            named = f"`probe_00` to `probe_{NUM_PROBES - 1}`"
            meaning = re.sub(r"probe \d+", "each probe", meaning)
        row = f"| {named} | {c.unit or 'name'} | {meaning} |"
        if row not in wanted:
            wanted.append(row)
    assert rows == wanted


# ------------------------------------------------------------------ the script


def test_selection(watched):
    t = watched[1][0]  # episode 3, a timeout
    reached = dataclasses.replace(t, outcome="reached")
    assert Selection.parse("all").includes(reached)
    assert Selection.parse("failed").includes(t) and not Selection.parse("failed").includes(reached)
    assert Selection.parse("4").includes(reached) and not Selection.parse("3").includes(t)
    for text in ("", "0", "-1", "1.5", "some", "٣"):
        with pytest.raises(TraceError, match="must be all, failed or a number from 1"):
            Selection.parse(text)


@pytest.mark.usefixtures("in_process")
def test_the_script_writes_what_was_asked_for(tmp_path, capsys):
    flags = [*SMALL, "--policies", "gp", "--workers", "1", "--out", str(tmp_path)]
    assert evaluate.main([*flags, "--trace", "failed"]) == 0
    rows = read_csv(tmp_path / "episodes.csv")
    failed = [r for r in rows if r["outcome"] != "reached"]
    assert failed
    written = [trace.read(p) for p in sorted((tmp_path / "traces").iterdir())]
    assert [(str(t.episode), t.outcome) for t in written] == [
        (r["episode"], r["outcome"]) for r in failed
    ]
    diagnosed = read_csv(tmp_path / "diagnosis.csv")
    assert [(d["episode"], d["outcome"]) for d in diagnosed] == [
        (r["episode"], r["outcome"]) for r in failed
    ]
    said = capsys.readouterr().out
    assert "largest possible gain: gap, decisions, 100.0 points" in said
    walked = read_csv(tmp_path / "behaviour.csv")  # of all episodes, failed or not
    assert [(w["episode"], w["trot"]) for w in walked] == [(r["episode"], "1.0000") for r in rows]
    assert list(walked[0])[-len(MEANS) :] == list(MEANS)
    assert "how gp walks, nominal" in said
    # Fewer traces in the same folder: the old ones are removed.
    assert evaluate.main([*flags, "--trace", "1"]) == 0
    assert [p.name for p in (tmp_path / "traces").iterdir()] == ["gp_nominal_gap_10_000.parquet"]
    assert read_csv(tmp_path / "diagnosis.csv") == diagnosed  # of all failures, as before
    # Without traces the table is the same, and no stale diagnosis or trace remains.
    before = (tmp_path / "episodes.csv").read_bytes()
    assert evaluate.main(flags) == 0
    assert (tmp_path / "episodes.csv").read_bytes() == before
    assert not (tmp_path / "diagnosis.csv").exists() and not list((tmp_path / "traces").iterdir())
    assert not (tmp_path / "behaviour.csv").exists()


def test_without_pyarrow_the_script_says_what_to_install(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "pyarrow", None)  # as if it were not installed
    assert evaluate.main(["--trace", "all", "--out", str(tmp_path / "out")]) == 2
    message = "a trace needs pyarrow: install the extra 'trace', "
    message += "pip install -c constraints.txt -e '.[trace]'"
    assert capsys.readouterr().err == f"evaluate.py: {message}\n"
    assert not (tmp_path / "out").exists()
