"""Diagnosis: planted faults are blamed on the right layer; each rule; the summary's numbers."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tdgc.benchmark import diagnosis, evaluation, planted
from tdgc.benchmark.diagnosis import (
    LIMITS,
    REACH,
    Diagnosis,
    describe,
    diagnose,
    features,
    has_looked,
    place_of,
)
from tdgc.benchmark.drivers import BaselineDriver, HierarchyDriver, TeacherDriver, load_high
from tdgc.benchmark.evaluation import Cell, Episode, run_cell, tile_of
from tdgc.benchmark.planted import Blindfold, SwappedBounds, WeakMotor, measured_limits
from tdgc.benchmark.trace import COLUMNS, Trace, Tracer
from tdgc.files import read_csv
from tdgc.tasks.leaps import Landing
from tdgc.tasks.pairing import PRETRAINED
from tdgc.tasks.probes import NUM_PROBES
from tdgc.tasks.teacher import Skill

HIPS = 0.183  # m ahead of the trunk's centre, of the shipped robot


@pytest.fixture(scope="module")
def pair(low):
    return load_high(PRETRAINED / "high", *low)


# ------------------------------------------------------------------ planted faults


def blamed(driver: HierarchyDriver, low: Any, cells: list[tuple[str, int, int]]) -> list[str]:
    """Layers blamed for the failures in ``cells``: (family, level, number of episodes)."""
    return [
        layer
        for family, level, count in cells
        for layer in planted.blamed(driver, low, family, level, count, HIPS)
    ]


@pytest.mark.parametrize("joint", ["FL_calf_joint", "RR_calf_joint"])
def test_a_broken_motor_is_the_executions_fault(joint, low, pair):
    layers = blamed(WeakMotor(*pair, joint), low[0], [("rough", 4, 4), ("pillar", 4, 2)])
    assert len(layers) >= 3 and layers.count("execution") >= 0.8 * len(layers)


@pytest.mark.parametrize("command", ["vx", "yaw_rate"])
def test_swapped_bounds_of_a_decoder_are_the_decisions_fault(command, low, pair):
    layers = blamed(SwappedBounds(*pair, command), low[0], [("rough", 4, 3), ("pillar", 4, 3)])
    assert len(layers) >= 3 and layers.count("decisions") >= 0.8 * len(layers)


def test_a_blindfold_is_the_decisions_fault(low, pair):
    layers = blamed(Blindfold(*pair), low[0], [("rough", 4, 4), ("pillar", 6, 4)])
    assert len(layers) >= 3 and layers.count("decisions") >= 0.8 * len(layers)


def test_a_blindfolds_trace_has_no_probes(low, pair, monkeypatch):
    monkeypatch.setattr(evaluation, "HORIZON", 1.0)
    (seen,) = planted.traced(HierarchyDriver(*pair), low[0], "rough", 0, 1, planted.SEED)
    (blind,) = planted.traced(Blindfold(*pair), low[0], "rough", 0, 1, planted.SEED)
    assert seen.probes and np.isfinite(seen["probe_00"][:-1]).all()
    assert not blind.probes and np.isnan(blind["probe_00"]).all()


def test_limits_are_measured_where_nothing_is_wrong():
    """One of 60 stretches, three per episode, has an error of 0.5 m/s; all others have 0.1."""
    traces = [walk(outcome="reached", seconds=7.0, error_vx=0.1) for _ in range(20)]
    traces[-1]["error_vx"][-20:] = 0.5
    velocity, turn = (measured_limits(traces, HIPS)[name] for name in ("velocity", "yaw rate"))
    assert turn == (0.0, 0.0)
    assert velocity[0] == pytest.approx(0.1)  # 1 of 60 stretches is less than 5 %
    errors = [*[0.1] * 19, 0.1 + 0.4 * 20 / 60]
    assert velocity[1] == pytest.approx(np.percentile(errors, 95), abs=1e-6)


def test_no_limits_without_an_episode_that_succeeded():
    assert set(measured_limits([], HIPS)) == set(LIMITS)
    assert np.isnan(list(measured_limits([], HIPS).values())).all()


def test_the_table_of_planted_faults(monkeypatch, capsys):
    small = {
        "FAULTS": [f for f in planted.FAULTS if f.name.startswith("a front calf's")],
        "FAMILIES": ("rough",),
        "EPISODES": 4,
        "LIMIT_SEEDS": (1,),
        "LIMIT_LEVELS": (2,),
        "LIMIT_EPISODES": 1,
    }
    for name, value in small.items():
        monkeypatch.setattr(planted, name, value)
    assert planted.main([]) == 0
    head, fault, total, _, walked, _, velocity, *_ = capsys.readouterr().out.splitlines()
    assert head.split() == ["fault", "layer", "rough"]
    assert fault.startswith("a front calf's motor at 2 % strength") and fault.endswith("4 of 4")
    assert total == "4 of 4 failures blamed on the layer at fault"
    assert walked == "without a fault, 95 % of 2 episodes that reached their goals"
    name, stretch, _, limit, episode, *_ = velocity.split()
    assert name == "velocity" and 0.0 < float(episode) < float(stretch) < 2.0 * float(limit)


def test_planting_refuses_a_pair_that_is_not_there(tmp_path, capsys):
    assert planted.main(["--high", str(tmp_path / "none")]) == 2
    out, err = capsys.readouterr()
    assert not out and err.count("\n") == 1 and str(tmp_path / "none") in err


# ------------------------------------------------------------------ the rules, one by one


def walk(
    family: str = "rough",
    level: int = 6,
    outcome: str = "left_tile",
    seconds: float = 6.0,
    track: tuple[tuple[float, float], tuple[float, float]] = ((0.8, 4.0), (5.0, 4.0)),
    **columns: float,
) -> Trace:
    """A trace of a straight walk from one end of ``track`` to the other, with constant columns.

    By default the goal lies straight ahead and every command is tracked exactly.
    """
    n = round(10 * seconds) + 1
    way = np.linspace(0.0, 1.0, n)
    values: dict[str, Any] = {
        c.name: np.zeros(n, np.float32) if c.unit else np.full(n, None, object) for c in COLUMNS
    }
    values["time"] = np.linspace(0.0, seconds, n, dtype=np.float32)
    values["seconds"][1:] = 0.1
    values["base_x"] = track[0][0] + way * (track[1][0] - track[0][0])
    values["base_y"] = track[0][1] + way * (track[1][1] - track[0][1])
    for name, value in ({"command_vx": 0.5} | columns).items():
        values[name][:] = value
    return Trace("tdgc", "nominal", family, level, 0, 0, outcome, values)


def verdict(trace: Trace) -> tuple[str, str]:
    found = diagnose(trace, HIPS)
    return found.layer, found.cause


def test_what_nothing_was_trained_on_is_the_terrains_fault():
    assert verdict(walk(level=11, outcome="fell")) == ("terrain", "never trained on")
    assert verdict(walk(family="mixed", error_vx=-2.0)) == ("terrain", "never trained on")
    assert verdict(walk(level=10, outcome="fell"))[0] == "execution"


def test_errors_beyond_the_limits_are_the_executions_fault():
    limit = LIMITS["velocity"].stretch
    assert verdict(walk(error_vx=-limit - 0.01)) == ("execution", "lost track of velocity")
    assert verdict(walk(error_vx=-limit + 0.01)) == ("decisions", "steered off the tile")
    assert verdict(walk(error_vx=0.8 * limit, error_vy=0.8 * limit))[0] == "execution"  # the norm
    limit = LIMITS["yaw rate"].stretch
    assert verdict(walk(error_yaw_rate=limit + 0.01)) == ("execution", "lost track of yaw rate")
    both = walk(error_pitch=LIMITS["tilt"].stretch + 0.01, error_yaw_rate=-limit - 0.01)
    assert verdict(both) == ("execution", "lost track of yaw rate and tilt")


def test_a_timeout_is_judged_by_all_of_it_and_other_ends_by_their_last_seconds():
    early = walk(outcome="timeout", seconds=20.0)
    early["error_vx"][11:60] = -0.9  # over 5 of 19 s: 0.23 m/s on average
    assert verdict(early) == ("execution", "lost track of velocity")
    assert verdict(dataclasses.replace(early, outcome="left_tile"))[0] == "decisions"
    late = walk(seconds=20.0)
    late["error_vx"][-20:] = -0.5  # over the last 2 of 19 s: 0.05 m/s
    assert verdict(late) == ("execution", "lost track of velocity")
    late = dataclasses.replace(late, outcome="timeout")
    assert verdict(late) == ("decisions", "found no way to the goal")


def held_at_a_pillar(outcome: str, free: float, **errors: float) -> Trace:
    """A walk of ``free`` s with tracking ``errors`` to a pillar, where it ends after 20 s."""
    px, py, diameter = tile_of(0, "pillar", 6, 0).features.pillars[0]
    x = px - 0.5 * diameter - 0.3
    n = round(10 * free)
    trace = walk("pillar", 6, outcome, 20.0, ((x, py), (x, py)))
    trace["base_x"][: n + 11] = 0.9
    for name, value in errors.items():
        trace[name][: n + 11] = value
    return trace


def test_a_timeout_that_is_hardly_tracked_is_judged_as_a_stretch() -> None:
    """Means over little time vary more, so 1.2 s before a pillar have the limit of 2 s, 0.24 m/s,
    not that of an episode, 0.13 m/s."""
    stuck = "decisions", "held up by a pillar"
    assert verdict(held_at_a_pillar("timeout", 1.2, error_vx=-0.16)) == stuck
    lost = "execution", "lost track of velocity"
    assert verdict(held_at_a_pillar("timeout", 3.0, error_vx=-0.16)) == lost
    assert verdict(held_at_a_pillar("timeout", 1.2, error_vx=-0.25)) == lost


def test_who_falls_at_a_pillar_was_steered_into_it() -> None:
    for outcome in ("fell", "collided"):
        assert verdict(held_at_a_pillar(outcome, 3.0)) == ("decisions", "steered into a pillar")


def test_speeding_up_from_rest_does_not_count():
    start = walk(seconds=1.5)
    start["error_vx"][1:11] = -1.0
    assert verdict(start)[0] == "decisions"
    short = diagnose(walk(seconds=0.8, error_vx=-1.0), HIPS)
    assert short.layer == "decisions" and "tracking not judged" in short.evidence


def test_a_fall_is_the_executions_fault_unless_the_command_led_elsewhere():
    on_the_way = ("execution", "lost its footing on the way to the goal")
    elsewhere = ("decisions", "lost its footing on the way elsewhere")
    for outcome in ("fell", "collided"):  # a trunk that hits a step has fallen, too
        assert verdict(walk("stair", outcome=outcome)) == on_the_way
        assert verdict(walk("stair", outcome=outcome, goal_bearing=1.8)) == elsewhere
        assert verdict(walk("stair", outcome=outcome, command_vx=-0.19)) == elsewhere


def test_who_leads_away_from_the_goal_is_not_judged_by_tracking():
    away = ("decisions", "led away from the goal")
    lost = ("execution", "lost track of velocity")
    for outcome in ("fell", "timeout", "left_tile"):
        assert verdict(walk(outcome=outcome, command_vx=-0.21, error_vx=0.3)) == away
        assert verdict(walk(outcome=outcome, command_vx=-0.19, error_vx=0.3)) == lost
        behind = {"command_vx": 0.5, "goal_bearing": 2.0}  # 0.5 cos 2 = -0.208
        assert verdict(walk(outcome=outcome, error_vx=0.3, **behind)) == away


def test_who_walks_blindly_into_a_trench_made_no_decision():
    """This takes a trace without any terrain cue; with cues, the usual rules apply."""
    lip = float(tile_of(0, "gap", 6, 0).features.trenches[0, 0])
    at_lip = ((lip - 1.5, 4.0), (lip - HIPS, 4.0))
    blind = {f"probe_{i:02d}": np.nan for i in range(NUM_PROBES)}
    for outcome in ("fell", "collided", "timeout"):
        seen = walk("gap", outcome=outcome, track=at_lip, error_vx=-0.5)
        assert verdict(seen) == ("execution", "lost track of velocity")
        unseen = walk("gap", outcome=outcome, track=at_lip, error_vx=-0.5, **blind)
        assert verdict(unseen) == ("decisions", "walked blindly into a trench")
        unseen["family"][:] = "unknown"  # which tells no more than nothing
        assert verdict(unseen) == ("decisions", "walked blindly into a trench")
        unseen["family"][:] = "gap"
        assert verdict(unseen) == verdict(seen)
    before = ((0.5, 4.0), (lip - HIPS - REACH - 0.05, 4.0))
    short = walk("gap", outcome="fell", track=before, error_vx=-0.5, **blind)
    assert verdict(short) == ("execution", "lost track of velocity")


def test_the_baseline_is_not_blamed_on_the_low_level_in_gap(low):
    driver = BaselineDriver()
    tracer = Tracer(driver)
    run_cell(Cell("gp", "nominal", "gap", 8, 0, 3), low[0], driver, planted.SEED, [tracer])
    failures = [diagnose(t, HIPS) for t in tracer.traces() if t.outcome != "reached"]
    assert len(failures) >= 2
    assert {f.cause for f in failures} == {"walked blindly into a trench"}


def test_a_trench_of_a_map_is_found(low, tmp_path):
    heights = np.zeros((161, 161))
    heights[70:76] = -0.6
    path = str(tmp_path / "trench.npy")
    np.save(path, heights)
    driver = BaselineDriver()
    tracer = Tracer(driver)
    run_cell(Cell("gp", "nominal", path, 10, 0, 2), low[0], driver, planted.SEED, [tracer])
    for trace in tracer.traces():
        found = diagnose(trace, HIPS)
        assert (found.layer, found.cause) == ("decisions", "walked blindly into a trench")
        assert found.feature.endswith("m from trench 1 of 1")


def test_the_teacher_is_not_blind(low, monkeypatch):
    monkeypatch.setattr(evaluation, "HORIZON", 1.0)
    driver = TeacherDriver(low[1], Skill(Landing()))
    tracer = Tracer(driver)
    run_cell(Cell("teacher", "nominal", "gap", 4, 0, 1), low[0], driver, planted.SEED, [tracer])
    (trace,) = tracer.traces()
    assert set(trace["family"]) == {None} and has_looked(trace)


def test_an_obstacle_of_a_map_is_the_decisions_fault(tmp_path):
    """A wall 0.4 m high across the tile; elsewhere on it the usual rules apply."""
    heights = np.zeros((161, 161))
    heights[80:84] = 0.4
    path = str(tmp_path / "wall.npy")
    np.save(path, heights)
    into = ((3.0, 4.0), (3.8, 4.0))
    assert verdict(walk(path, 10, "collided", track=into)) == (
        "decisions", "steered into an obstacle"
    )  # fmt: skip
    pushing = walk(path, 10, "timeout", track=((3.7, 4.0), (3.7, 4.0)), error_vx=-0.5)
    assert verdict(pushing) == ("decisions", "held up by an obstacle")
    away = walk(path, 10, "timeout", track=((0.8, 4.0), (1.0, 4.0)), error_vx=-0.5)
    assert verdict(away) == ("execution", "lost track of velocity")
    stairs = str(tmp_path / "stairs.npy")  # two steps of 16 cm, with a tread of 25 cm
    np.save(stairs, np.repeat([0.0, 0.16, 0.32], [80, 5, 76])[:, None] * np.ones(161))
    climbing = walk(stairs, 10, "collided", track=into)
    assert verdict(climbing) == ("execution", "lost its footing on the way to the goal")
    tripped = walk(path, 10, "collided", track=((0.8, 4.0), (2.5, 4.0)))
    assert verdict(tripped) == ("execution", "lost its footing on the way to the goal")


def test_an_obstacle_of_clutter_is_not_called_a_pillar():
    cluttered = (tile_of(0, "clutter", 6, n) for n in range(20))
    number, (px, y, diameter) = next(
        (n, tile.features.pillars[0])
        for n, tile in enumerate(cluttered)
        if len(tile.features.pillars)
    )
    x = px - 0.5 * diameter
    into = walk("clutter", outcome="collided", track=((x - 1.0, y), (x - 0.25, y)))
    hit = diagnose(dataclasses.replace(into, episode=number), HIPS)
    assert hit.cause == "steered into an obstacle"
    assert hit.feature == f"0.25 m from obstacle at ({px:.1f}, {y:.1f}) m"


def test_a_pillar_in_the_way_is_the_decisions_fault():
    pillars = tile_of(0, "pillar", 6, 0).features.pillars
    px, y, diameter = (float(v) for v in pillars[pillars[:, 0].argmin()])
    x = px - 0.5 * diameter  # near edge of the first pillar
    into = ((x - 1.0, y), (x - 0.25, y))
    hit = diagnose(walk("pillar", outcome="collided", track=into), HIPS)
    assert (hit.layer, hit.cause) == ("decisions", "steered into a pillar")
    assert hit.feature == f"0.25 m from pillar at ({px:.1f}, {y:.1f}) m"
    # A robot that pushes against it tracks no command, which is not the low policy's fault.
    pushing = walk("pillar", outcome="timeout", track=((x - 0.3, y), (x - 0.3, y)), error_vx=-0.5)
    assert verdict(pushing) == ("decisions", "held up by a pillar")
    # Away from all pillars on the same tile, it is the low policy's fault.
    away = walk("pillar", outcome="timeout", track=((0.8, 4.0), (1.0, 4.0)), error_vx=-0.5)
    assert verdict(away) == ("execution", "lost track of velocity")


def test_tipping_over_the_edge_does_not_count():
    off = walk(seconds=4.0, track=((4.0, 1.6), (4.0, 0.0)))
    off["error_roll"][off["base_y"] < 0.15] = 2.0
    assert verdict(off) == ("decisions", "steered off the tile")
    off["error_roll"][off["base_y"] < 0.6] = 2.0
    assert verdict(off)[0] == "execution"


def test_an_episode_that_succeeded_has_no_diagnosis():
    with pytest.raises(ValueError, match="has not failed"):
        diagnose(walk(outcome="reached"), HIPS)


def test_evidence_gives_the_numbers():
    found = diagnose(walk(error_vx=0.3, error_vy=0.4, at_bound_yaw_rate=-1.0), HIPS)
    assert found.evidence == (
        "in the last 2 s: velocity off by 0.50 m/s (limit 0.24); yaw rate off by 0.00 rad/s "
        "(limit 0.11); tilt off by 0.00 rad (limit 0.37); asked for +0.50 m/s towards the goal; "
        "yaw_rate at its bound 100 % of the time"
    )
    assert (found.time_s, found.place, found.seed) == (6.0, "zone", 0)


def test_the_limits_in_the_docs_are_the_codes():
    text = (Path(__file__).resolve().parents[1] / "docs" / "trace.md").read_text(encoding="utf-8")
    for name, limit in LIMITS.items():
        unit = limit.unit
        assert f"| {name} | {limit.stretch:g} {unit} | {limit.episode:g} {unit} |" in text


# ------------------------------------------------------------------ where


def test_places_along_the_tile():
    places = [place_of(x) for x in (0.5, 1.3, 1.5, 6.5, 6.6, 7.0)]
    assert places == [
        "start platform", "first transition", "zone", "zone", "second transition", "goal platform",
    ]  # fmt: skip


@pytest.mark.parametrize("family", ["gap", "stair"])
def test_features_are_where_the_tile_has_them(family):
    tile = tile_of(0, family, 8, 0)
    heights = tile.heights[:, 80]
    if family == "gap":  # trenches are where the ground is lowered
        lowered = 0.05 * np.flatnonzero(heights < -0.3)
        starts = lowered[np.diff(lowered, prepend=-1.0) > 0.1]
        assert len(starts) >= 3
        for k, x in enumerate(starts):
            ((name, distance),) = features(tile, float(x) + 0.05, 4.0)
            assert name == f"trench {k + 1} of {len(starts)}" and distance == 0.0
            ((_, distance),) = features(tile, float(x) - 0.3, 4.0)
            assert distance == pytest.approx(0.3, abs=0.05)
    else:  # steps are cells in which the height changes
        steps = 0.05 * np.flatnonzero(np.abs(np.diff(heights)) > 0.01)
        assert len(steps) >= 10
        for k, x in enumerate(steps):
            ((name, distance),) = features(tile, float(x), 4.0)
            assert name == f"step {k + 1} of {len(steps)}" and distance <= 0.051


def test_mixed_tiles_have_the_features_of_both_halves():
    kinds = {"gap": "trench", "stair": "step", "pillar": "pillar"}
    for episode in range(8):
        tile = tile_of(0, "mixed", 6, episode)
        found = {name.split()[0] for name, _ in features(tile, 4.0, 4.0)}
        assert found == {kinds[part] for part in tile.parts if part in kinds}


# ------------------------------------------------------------------ results


def test_rows_are_written_as_they_are(tmp_path: Path):
    path = tmp_path / "diagnosis.csv"
    rows = [diagnose(walk(), HIPS), diagnose(walk("gap", outcome="fell"), HIPS)]
    diagnosis.write(rows, path)
    expected = [{k: str(v) for k, v in dataclasses.asdict(row).items()} for row in rows]
    assert read_csv(path) == expected
    diagnosis.write([], path)
    header = ",".join(f.name for f in dataclasses.fields(Diagnosis))
    assert path.read_text(encoding="utf-8").splitlines() == [header]
    assert [p.name for p in tmp_path.iterdir()] == ["diagnosis.csv"]


def test_summary_says_where_most_is_to_be_won():
    def episode(family: str, outcome: str, policy: str = "tdgc") -> Episode:
        row = (policy, "nominal", family, 6, 0, 0, outcome, 1.0, 1.0, 1.0, (1.0, 0.0, 0.0, 0.0))
        return Episode(*row, np.zeros(2), np.zeros((1, 3)))

    episodes = [episode("stair", "fell")] * 3 + [episode("rough", "left_tile")] * 2
    episodes += [episode("stair", "left_tile")] + [episode("rough", "reached")] * 4
    episodes += [episode("rough", "reached", "gp")]
    rows = [diagnose(walk("stair", outcome="fell"), HIPS)] * 3 + [diagnose(walk("rough"), HIPS)] * 2
    rows.append(diagnose(walk("stair"), HIPS))
    lines = describe(rows, episodes).splitlines()
    assert lines[0] == "failures of tdgc, nominal: 6 of 10 episodes"
    assert lines[2].split() == "stair 6 1 3 0 lost its footing on the way to the goal (3)".split()
    assert lines[3].split() == "rough 6 2 0 0 steered off the tile (2)".split()
    assert lines[4] == "largest possible gain: stair, execution, 30.0 points of success"
    assert lines[5:] == ["failures of gp, nominal: 0 of 1 episodes"]
