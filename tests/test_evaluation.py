"""The protocol: outcomes, intervals, paired tiles, repeatability, the baseline's law."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from tdgc import evaluation
from tdgc.commands import INDEX, default_command
from tdgc.evaluation import (
    BATCH,
    CONDITIONS,
    OUTCOMES,
    Cell,
    Episode,
    GaitPolicyDriver,
    GoToGoal,
    classify,
    low_config,
    physics_of,
    plan,
    push_velocities,
    run_cell,
    summarise,
    wilson_interval,
)
from tdgc.high_env import PRETRAINED
from tdgc.locomotion import Locomotion
from tdgc.policies import load
from tdgc.terrain import EVAL_STREAM, TileField, make_tile, tile_rng


@pytest.fixture(scope="module")
def low():
    return load(PRETRAINED / "low")


def test_wilson_interval_is_the_textbook_one():
    # Wilson's interval of 8 in 10 at 95 %: 0.4902 to 0.9433 (e.g. Newcombe 1998, method 3).
    low, high = wilson_interval(8, 10)
    assert low == pytest.approx(0.4902, abs=5e-5) and high == pytest.approx(0.9433, abs=5e-5)
    assert wilson_interval(0, 20)[0] == 0.0 and wilson_interval(20, 20)[1] == 1.0
    with pytest.raises(ValueError, match=r"0 <= reached <= n"):
        wilson_interval(3, 2)


def test_go_to_goal_turns_to_the_goal_and_slows_while_it_faces_away():
    law = GoToGoal(top_speed=0.8, distance_gain=1.0, heading_gain=1.5)
    position = np.zeros((4, 2))
    goal = np.array([[5.0, 0.0], [0.0, 5.0], [-5.0, 1e-9], [0.3, 0.0]])
    speed, turn = law.law(position, np.zeros(4), goal)
    assert speed == pytest.approx([0.8, 0.0, 0.0, 0.3], abs=1e-9)
    assert turn == pytest.approx([0.0, 1.0, 1.0, 0.0], abs=1e-9)  # 1.5 * pi/2 is above the bound
    _, right = law.law(np.zeros((1, 2)), np.array([0.4]), np.array([[5.0, 0.0]]))
    assert right == pytest.approx([-0.6])


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


def test_conditions_are_the_benchmarks():
    assert list(CONDITIONS) == [
        "nominal", "levels-11-12", "mixed", "friction-0.4", "payload-3kg", "pushes", "motor-0.85",
        "latency-30ms", "physics-1000hz",
    ]  # fmt: skip
    assert CONDITIONS["friction-0.4"].friction == 0.4
    assert CONDITIONS["payload-3kg"].payload == 3.0
    assert CONDITIONS["pushes"].push_speed == 0.75
    assert CONDITIONS["motor-0.85"].motor == 0.85
    assert CONDITIONS["latency-30ms"].latency == 0.03


def test_physics_at_1000_hz_keeps_the_control_rate(low):
    config = low_config(low)
    fast = physics_of(config, CONDITIONS["physics-1000hz"])
    assert fast.substeps == 20 and fast.dt == pytest.approx(0.001)
    assert physics_of(config, CONDITIONS["nominal"]).dt == pytest.approx(0.0025)


def test_pushes_have_their_size_and_are_paired():
    cell = Cell("gp", "pushes", "rough", 6, 0, 4)
    pushes = push_velocities(cell, 7, 0.75, 6)
    assert np.linalg.norm(pushes, axis=-1) == pytest.approx(np.full((4, 6), 0.75))
    other = push_velocities(dataclasses.replace(cell, policy="tdgc"), 7, 0.75, 6)
    assert np.array_equal(pushes, other)
    later = push_velocities(dataclasses.replace(cell, first=2, count=2), 7, 0.75, 6)
    assert np.array_equal(pushes[2:], later)


def test_outcomes_are_told_apart(low):
    config = low_config(low)
    field = TileField((5, 1))
    for k in range(5):
        field.place(k, 0, make_tile("rough", 0.0, tile_rng(0, "rough", 0, k, EVAL_STREAM)))
    loco = Locomotion(5, config.robot, config.physics, field)
    try:
        origin = field.origin(np.arange(5), 0)
        goal = field.goals[:, 0] + origin
        xy = origin + np.array([4.0, 4.0])
        xy[0] = goal[0] + [0.49, 0.0]
        xy[1] = origin[1] + [4.0, -0.01]
        loco.place(np.arange(5), xy, np.zeros(5), np.zeros(5))
        loco.world.state.trunk_force[2] = 40.1
        loco.world.state.position[3, 2] = 0.139  # the ground is within 1 cm of 0
        ends = classify(loco, goal, field)
        names = [OUTCOMES[i] if i >= 0 else "going" for i in ends]
        assert names == ["reached", "left_tile", "collided", "fell", "going"]
        loco.world.state.position[0, 2] = 0.1  # falling into the goal is falling
        assert OUTCOMES[classify(loco, goal, field)[0]] == "fell"
    finally:
        loco.world.close()


def test_the_same_seed_gives_the_same_episodes(low):
    cell = Cell("gp", "nominal", "rough", 0, 3, 2)
    first = run_cell(cell, low, GaitPolicyDriver(), seed=5)
    second = run_cell(cell, low, GaitPolicyDriver(), seed=5)
    assert [dataclasses.astuple(e) for e in first] == [dataclasses.astuple(e) for e in second]
    other = run_cell(cell, low, GaitPolicyDriver(), seed=6)
    assert [e.path_m for e in other] != [e.path_m for e in first]
    for e in first:
        assert e.family == "rough" and e.level == 0 and e.outcome in OUTCOMES
        assert 0.0 < e.time_s <= 20.0 and sum(e.shares) == pytest.approx(1.0)
        assert e.shares[0] == 1.0  # gp trots


def test_baseline_holds_the_default_behaviour_parameters(low):
    config = low_config(low)
    loco = Locomotion(1, config.robot, config.physics, None)
    try:
        driver = GaitPolicyDriver()
        loco.place(np.arange(1), np.zeros((1, 2)), np.zeros(1), np.zeros(1))
        driver.begin(loco, np.array([[6.5, 0.0]]))
        command = driver.command(0)[0]
        expected = default_command()
        expected[INDEX["vx"]] = driver.law.top_speed
        expected[INDEX["swing_height"]] = driver.law.swing_height
        assert command == pytest.approx(expected)
    finally:
        loco.world.close()


def test_summary_counts_and_averages():
    def row(family: str, level: int, outcome: str) -> Episode:
        return Episode("gp", "nominal", family, level, 0, 0, outcome, 1.0, 1.0)

    rows = [
        row("rough", 6, "reached"), row("rough", 6, "fell"),
        row("rough", 7, "reached"), row("rough", 7, "reached"),
        row("gap", 6, "timeout"), row("gap", 6, "left_tile"),
        row("gap", 7, "collided"), row("gap", 7, "reached"),
    ]  # fmt: skip
    table = summarise(rows)["gp"]["nominal"]
    assert table["rough"]["6"]["rate"] == 0.5 and table["rough"]["mean"]["rate"] == 0.75
    assert table["gap"]["mean"]["reached"] == 1
    assert table["mean"]["n"] == 8 and table["mean"]["rate"] == 0.5
    assert table["mean"]["ci_low"] < 0.5 < table["mean"]["ci_high"]


def test_tracking_measures_against_the_command(low):
    result = evaluation.track_gait(low, "trot", episodes=2, seed=0)
    assert set(result) == {"velocity_rmse", "yaw_rate_rmse", "contact_match"}
    # A policy that stood still would be off by the commands' own spread, sqrt((1 + 0.36) / 3).
    assert 0.0 < result["velocity_rmse"] < math.sqrt((1.0 + 0.36) / 3.0)
    assert 0.5 < result["contact_match"] <= 1.0
