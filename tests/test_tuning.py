"""Tuning: what limits do to commands, what is refused, and the effect compared with none."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_drivers import save_high
from test_evaluation import rows_of

import evaluate
from tdgc.benchmark.drivers import HierarchyDriver, load_high
from tdgc.benchmark.evaluation import Episode
from tdgc.benchmark.tuning import (
    DecoderTuning,
    Limits,
    TunedDriver,
    Tuning,
    check,
    effect,
    load,
    record,
    tuned_ranges,
)
from tdgc.config import CommandRanges, ConfigError, HighLevelConfig, LowLevelConfig
from tdgc.sim.bullet_world import BulletWorld
from tdgc.sim.commands import CONTINUOUS, INDEX, gait_index
from tdgc.sim.gaits import GAITS
from tdgc.sim.locomotion import Locomotion
from tdgc.sim.robot import Array

LOW = LowLevelConfig()
HIGH = HighLevelConfig(commands=LOW.commands)


@pytest.fixture(scope="module")
def pair(low, tmp_path_factory: pytest.TempPathFactory):
    """A high policy with random weights whose gaits and commands vary."""
    return load_high(save_high(tmp_path_factory.mktemp("policy") / "high", low), *low)


@pytest.fixture(scope="module")
def loco(low):
    """Twenty robots, each with its own heading and pose, so that each gets its own commands."""
    m = 20
    robots = Locomotion(BulletWorld(m, low[1].robot, low[1].physics), low[1])
    rng = np.random.default_rng(0)
    robots.place(np.arange(m), np.zeros((m, 2)), rng.uniform(-3.0, 3.0, m), rng.uniform(size=m))
    robots.world.state.q += rng.normal(scale=0.5, size=(m, 12))
    yield robots
    robots.world.close()


def commands(driver: HierarchyDriver, loco: Locomotion, steps: int = 1) -> Array:
    """Commands (steps, 20, 15) of robots whose state does not change."""
    driver.begin(loco, np.tile([6.5, 0.0], (loco.num_robots, 1)), "rough")
    return np.array([driver.command(step).copy() for step in range(steps)])


def tuned(pair: Any, *assignments: str) -> TunedDriver:
    return TunedDriver(*pair, LOW, load(None, assignments))


# ------------------------------------------------------------------ what a tuning does


def test_a_bound_clips_and_does_not_rescale(pair, loco):
    free = commands(HierarchyDriver(*pair), loco)[0]
    limited = commands(tuned(pair, "decoder.vx.high=0.5", "decoder.vy.low=-0.1"), loco)[0]
    expected = free.copy()
    expected[:, INDEX["vx"]] = np.minimum(free[:, INDEX["vx"]], 0.5)
    expected[:, INDEX["vy"]] = np.maximum(free[:, INDEX["vy"]], -0.1)
    assert limited == pytest.approx(expected, abs=1e-12)
    assert 0 < np.count_nonzero(limited != free) < 40  # some are clipped, the others unchanged


def test_only_allowed_gaits_the_nearest_on_the_action(pair, loco):
    driver = HierarchyDriver(*pair)
    free = gait_index(commands(driver, loco)[0])
    place = 2.0 * (driver.action[:, -1] + 1.0)
    assert len(set(free)) >= 3
    found = gait_index(commands(tuned(pair, 'decoder.gaits=["bound", "trot"]'), loco)[0])
    assert set(found) == {GAITS.index("trot"), GAITS.index("bound")}
    # Trot is [0, 1) on the channel and bound [3, 4], so the middle between them is 2.
    assert np.array_equal(found, np.where(place < 2.0, 0, 3))
    only = commands(tuned(pair, 'decoder.gaits=["pace"]'), loco)[0]
    assert set(gait_index(only)) == {GAITS.index("pace")}
    assert only[:, :12] == pytest.approx(commands(HierarchyDriver(*pair), loco)[0][:, :12])


@pytest.mark.parametrize(("rate", "held"), [("5", 10), ("50", 1), ("12.5", 4)])
def test_a_decision_is_held_as_long_as_the_rate_says(rate, held, pair, loco):
    said = commands(tuned(pair, f"decision_rate={rate}"), loco, 2 * held + 1)
    changed = np.flatnonzero((said[1:] != said[:-1]).any(axis=(1, 2))) + 1
    assert changed.tolist() == [held, 2 * held]  # the hidden state makes decisions differ


def test_too_fast_is_shortened_and_keeps_its_direction(pair, loco):
    free = commands(HierarchyDriver(*pair), loco)[0]
    slow = commands(tuned(pair, "safety.max_speed=0.7"), loco)[0]
    speed = np.linalg.norm(free[:, :2], axis=1)
    assert 0 < np.count_nonzero(speed > 0.7) < 20
    expected = free.copy()
    expected[:, :2] *= (np.minimum(speed, 0.7) / speed)[:, None]
    assert slow == pytest.approx(expected)


def test_tilted_robots_are_slowed_at_every_control_step(pair, loco):
    driver = tuned(pair, "safety.max_tilt=0.2")
    free = commands(HierarchyDriver(*pair), loco)[0]
    assert commands(driver, loco)[0] == pytest.approx(free)  # all are upright
    state, upright = loco.world.state, loco.world.state.quaternion.copy()
    angle = 0.4
    state.quaternion[:] = [np.sin(angle / 2), 0.0, 0.0, np.cos(angle / 2)]
    state.derive()
    try:
        tilted = driver.command(1)  # no decision at this step
        expected = free.copy()
        expected[:, :3] *= 0.5
        assert tilted == pytest.approx(expected)
    finally:
        state.quaternion[:] = upright
        state.derive()


def test_a_gait_begins_no_faster_than_its_bound(pair, loco):
    """A tuned bound below the robot's start frequency of 3.5 Hz takes precedence, whereas one that
    the policy has always had does not: a tuning of something else leaves the start as it is."""
    assert loco.robot.start_frequency == 3.5
    for assignment, most in (("decoder.frequency.high=2.5", 2.5), ("decoder.vx.high=0.4", 3.5)):
        driver = tuned(pair, assignment)
        driver.begin(loco, np.array([[6.0, 0.0]]), "rough")
        loco.clock.reset(np.arange(1), np.zeros(1))
        loco.command[:] = driver.command(0)
        loco.command[:, INDEX["frequency"]] = 2.2
        assert loco.executed()[0, INDEX["frequency"]] == pytest.approx(most)
    high, config = pair
    slow = dataclasses.replace(config.commands, frequency=(2.0, 3.0))
    slower = dataclasses.replace(config, commands=slow)
    driver = TunedDriver(high, slower, LOW, load(None, ["decoder.vx.high=0.4"]))
    driver.begin(loco, np.array([[6.0, 0.0]]), "rough")
    assert loco.executed()[0, INDEX["frequency"]] == pytest.approx(3.5)


def test_the_policy_sees_its_own_decisions(pair, loco):
    """A limit changes the robot's commands but not the last action that the policy observes."""
    free, limited = HierarchyDriver(*pair), tuned(pair, "decoder.vx.high=-0.9")
    commands(free, loco, 11)
    commands(limited, loco, 11)
    assert np.array_equal(free.action, limited.action)


# ------------------------------------------------------------------ what is refused


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("decoder.vx.high=1.3", r"vx.high=1.3: the low policy was trained on \[-1.0, 1.2\]"),
        ("decoder.vx.low=-3", r"decoder.vx.low=-3.0: the low policy was trained on \[-1.0, 1.2\]"),
        ("decoder.vx.high=0.9", r"a bound can only narrow the policy's \[-0.8, 0.8\]"),
        ("decoder.vx={\"low\": 0.5, \"high\": 0.2}", "the lower bound 0.5 is above the upper 0.2"),
        ("decoder.gaits=[]", r"must name some of trot, pronk, pace, bound, each once, not \[\]"),
        ('decoder.gaits=["trot", "trot"]', "each once, not"),
        ('decoder.gaits=["gallop"]', "must name some of trot, pronk, pace, bound"),
        ("decision_rate=7", "must be the control rate of 50 Hz divided by a whole number from 1"),
        ("decision_rate=100", "divided by a whole number"),
        ("decision_rate=0", "divided by a whole number"),
        ("decision_rate=-10", "divided by a whole number"),
        ("decision_rate=1e-300", "divided by a whole number from 1 to 1000"),
        ("safety.max_tilt=0", "safety.max_tilt must be positive, not 0.0"),
        ("safety.max_speed=-1", "safety.max_speed must be positive, not -1.0"),
        ("decision_rate=10", "the tuning changes nothing"),
        ("decoder.vx.low=-0.8", "the tuning changes nothing"),
    ],
)  # fmt: skip
def test_limits_that_do_not_fit_the_policies(assignment, message):
    high = dataclasses.replace(HIGH, commands=CommandRanges(vx=(-0.8, 0.8)))
    with pytest.raises(ConfigError, match=message):
        check(load(None, [assignment]), high, LOW)


def test_gaits_of_a_policy_that_has_few_cannot_be_narrowed():
    few = dataclasses.replace(HIGH, commands=LOW.commands, gaits=("trot", "bound"))
    with pytest.raises(ConfigError, match=r"can only narrow all gaits; the policy has trot, bound"):
        check(load(None, ['decoder.gaits=["trot"]']), few, LOW)
    check(load(None, ["decoder.vx.high=0.5"]), few, LOW)


def test_slowing_down_needs_a_low_level_that_can_stand():
    running = dataclasses.replace(LOW, commands=CommandRanges(vx=(0.2, 1.0)))
    high = dataclasses.replace(HIGH, commands=running.commands)
    with pytest.raises(
        ConfigError, match=r"safety.max_tilt slows down to 0: .* vx from 0.2 to 1.0"
    ):
        check(load(None, ["safety.max_tilt=0.5"]), high, running)


def test_every_command_has_limits_and_they_are_its_own():
    names = [f.name for f in dataclasses.fields(DecoderTuning) if f.name != "gaits"]
    assert names == list(CONTINUOUS)
    bounds = dataclasses.asdict(CommandRanges())
    for name in names:
        low, high = bounds[name]
        middle = 0.5 * (low + high)
        narrowed = Tuning(DecoderTuning(**{name: Limits(high=middle)}))  # type: ignore[arg-type]
        expected = bounds | {name: (low, middle)}
        assert dataclasses.asdict(tuned_ranges(narrowed, HIGH, LOW)) == expected


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not a JSON file"),
        ("{", "not a JSON file"),
        ("[" * 100000, "not a JSON file"),
        ("[]", r"Tuning must be a table of keys, not \[\]"),
        ('{"decoders": {}}', "unknown configuration key 'decoders'; allowed: decoder, decision_r"),
        ('{"decoder": {"vz": {}}}', "unknown configuration key 'decoder.vz'"),
        ('{"decoder": {"vx": {"max": 1}}}', "'decoder.vx.max'; allowed: low, high"),
        ('{"decoder": {"vx": 0.6}}', "decoder.vx must be a table of keys, not 0.6"),
        ('{"decoder": {"vx": {"high": "0.6"}}}', "'decoder.vx.high' must be of type float"),
        ('{"decoder": {"vx": {"high": true}}}', "'decoder.vx.high' must be of type float"),
        ('{"decoder": {"vx": {"high": NaN}}}', "'decoder.vx.high' must be a finite number"),
        ('{"safety": {"max_speed": Infinity}}', "'safety.max_speed' must be a finite number"),
        ('{"safety": {"max_speed": 1e999}}', "'safety.max_speed' must be a finite number"),
        ('{"decision_rate": 1%s}' % ("0" * 400), "'decision_rate' must be a finite number"),
        ('{"decision_rate": 5, "decision_rate": 10}', "the key 'decision_rate' appears twice"),
        ('{"a\\nb\\u2028c": 1}', r"unknown configuration key 'a\\nb\\u2028c'"),
    ],
)
def test_files_that_cannot_be_read(text, message, tmp_path):
    path = tmp_path / "tuning.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=message) as caught:
        load(path)
    assert len(str(caught.value).splitlines()) == 1


def test_paths_that_are_no_files(tmp_path):
    with pytest.raises(ConfigError, match=r"none.json: No such file or directory$"):
        load(tmp_path / "none.json")
    with pytest.raises(ConfigError, match=r"Is a directory$"):
        load(tmp_path)
    (tmp_path / "bytes.json").write_bytes(b"\xff\xfe{}")
    with pytest.raises(ConfigError, match=r"bytes.json: not a JSON file$"):
        load(tmp_path / "bytes.json")


KEYS = st.sampled_from(
    ["decoder", "vx", "low", "high", "gaits", "decision_rate", "safety", "x", ""]
)
VALUES = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.sampled_from([*GAITS, "NaN", "\n"]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(KEYS, inner, max_size=3),
    max_leaves=8,
)


#: The same examples in every run.
examples = settings(deadline=None, derandomize=True, database=None)


@examples
@given(st.dictionaries(KEYS, VALUES, max_size=3), st.lists(st.text(max_size=12), max_size=2))
def test_anything_else_is_a_tuning_or_one_line(tmp_path_factory, data, texts):
    path = tmp_path_factory.mktemp("fuzz") / "tuning.json"
    path.write_text(json.dumps(data), encoding="utf-8")
    keys = ["decoder.vx.high=", "decision_rate=", "decoder.gaits=", ""]
    assignments = [key + text for key, text in zip(keys, texts, strict=False)]
    try:
        found = load(path, assignments)
        check(found, HIGH, LOW)
    except ConfigError as error:
        assert len(str(error).splitlines()) == 1
    else:
        ranges = tuned_ranges(found, HIGH, LOW)
        for name in CONTINUOUS:
            (low, high), (bottom, top) = getattr(LOW.commands, name), getattr(ranges, name)
            assert low <= bottom <= top <= high


@examples
@given(st.sampled_from(CONTINUOUS), st.floats(-0.5, 1.5), st.floats(-0.5, 1.5))
def test_bounds_narrow_the_ranges_or_are_refused(name, share, other):
    (low, high) = getattr(LOW.commands, name)
    bottom, top = low + share * (high - low), low + other * (high - low)
    tuning = Tuning(DecoderTuning(**{name: Limits(bottom, top)}))
    if low <= bottom <= top <= high:
        ranges = tuned_ranges(tuning, HIGH, LOW)
        assert ranges == dataclasses.replace(LOW.commands, **{name: (bottom, top)})
    else:
        with pytest.raises(ConfigError, match=rf"^decoder\.{name}[.:]"):
            tuned_ranges(tuning, HIGH, LOW)


# ------------------------------------------------------------------ beside the untuned run


def test_assignments_come_after_the_file_and_only_changes_are_recorded(tmp_path):
    path = tmp_path / "tuning.json"
    path.write_text('{"decoder": {"vx": {"low": -0.2, "high": 0.6}}, "decision_rate": 5}', "utf-8")
    found = load(path, ["decoder.vx.high=0.4", "safety.max_tilt=0.5", "decision_rate=null"])
    assert record(found) == {
        "decoder": {"vx": {"low": -0.2, "high": 0.4}},
        "safety": {"max_tilt": 0.5},
    }
    path.write_text(json.dumps(record(found)), encoding="utf-8")
    assert load(path) == found


def test_the_comparison_is_of_the_same_tiles():
    def row(policy: str, episode: int, outcome: str, time: float, path: float, energy: float):
        where = (policy, "nominal", "rough", 6, episode, 0, outcome, time, path, energy)
        return Episode(*where, (1.0, 0.0, 0.0, 0.0), np.zeros(2), np.zeros((1, 3)))

    rows = [
        row("tdgc", 0, "reached", 8.0, 8.0, 800.0), row("tdgc", 1, "fell", 2.0, 0.0, 100.0),
        row("tdgc", 2, "reached", 10.0, 6.0, 500.0),
        row("tdgc-tuned", 0, "fell", 4.0, 1.0, 50.0),
        row("tdgc-tuned", 1, "reached", 12.0, 7.0, 350.0),
        row("tdgc-tuned", 2, "reached", 16.0, 8.0, 400.0),
    ]  # fmt: skip
    found = effect(rows, "tdgc", "tdgc-tuned")["nominal"]
    before, after = found["tdgc"], found["tdgc-tuned"]
    assert (before["n"], before["reached"], after["reached"]) == (3, 2, 2)
    assert (found["gained"], found["lost"]) == (1, 1)
    assert before["mean_speed"] == pytest.approx(14.0 / 20.0)
    assert after["mean_speed"] == pytest.approx(0.5)
    assert before["energy_per_metre"] == pytest.approx(100.0)
    assert after["energy_per_metre"] == pytest.approx(50.0)
    still = [row("tdgc", 0, "timeout", 20.0, 0.0, 9.0), row("tdgc-tuned", 0, "fell", 1.0, 0.0, 1.0)]
    assert effect(still, "tdgc", "tdgc-tuned")["nominal"]["tdgc"]["energy_per_metre"] is None


@pytest.mark.usefixtures("in_process")
def test_the_script_shows_both_beside_each_other(tmp_path, capsys):
    flags = ["--levels", "0", "--families", "rough", "--episodes", "2", "--workers", "1"]
    flags += ["--policies", "tdgc", "--out", str(tmp_path)]
    assert evaluate.main([*flags, "--set", "decoder.vx.high=0.4"]) == 0
    rows = rows_of(tmp_path)
    assert [(r["policy"], r["episode"]) for r in rows] == [
        ("tdgc", "0"), ("tdgc", "1"), ("tdgc-tuned", "0"), ("tdgc-tuned", "1"),
    ]  # fmt: skip
    result = json.loads((tmp_path / "tuning.json").read_text(encoding="utf-8"))
    assert result["tuning"] == {"decoder": {"vx": {"high": 0.4}}}
    effect = result["effect"]["nominal"]
    for policy in ("tdgc", "tdgc-tuned"):
        mine = [r for r in rows if r["policy"] == policy]
        path = sum(float(r["path_m"]) for r in mine)
        assert effect[policy]["mean_speed"] == pytest.approx(
            path / sum(float(r["time_s"]) for r in mine), rel=1e-3
        )
        assert effect[policy]["energy_per_metre"] == pytest.approx(
            sum(float(r["energy_j"]) for r in mine) / path, rel=1e-3
        )
    assert effect["tdgc-tuned"]["mean_speed"] < 0.8 * effect["tdgc"]["mean_speed"]
    speed = f"{effect['tdgc-tuned']['mean_speed']:.2f} m/s"
    assert speed in capsys.readouterr().out
    # The next run in this folder has no tuning, so the file is removed.
    assert evaluate.main([*flags[:-4], "--policies", "gp", "--out", str(tmp_path)]) == 0
    assert not (tmp_path / "tuning.json").exists()
