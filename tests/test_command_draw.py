"""Commands drawn in training, and how their velocity ranges grow."""

import dataclasses

import numpy as np
import pytest

from tdgc.config import LowLevelConfig
from tdgc.sim.commands import INDEX
from tdgc.sim.gaits import gait_embedding
from tdgc.sim.robot import Array
from tdgc.tasks.command_draw import CommandDraw

CONFIG = LowLevelConfig()


def make(training: bool, command_start: float = 0.4) -> CommandDraw:
    config = dataclasses.replace(CONFIG, command_start=command_start)
    return CommandDraw(config, np.random.default_rng(0), training)


def drawn(draw: CommandDraw, n: int) -> tuple[Array, Array]:
    """Draw n free commands; return their gaits and values."""
    return draw.draw(*draw.bounds(n), np.ones(n, dtype=bool))[:2]


def test_commands_fill_their_ranges() -> None:
    gaits, values = drawn(make(training=False), 600)
    bounds = np.array(dataclasses.astuple(CONFIG.commands))
    width = bounds[:, 1] - bounds[:, 0]
    assert (values >= bounds[:, 0]).all() and (values <= bounds[:, 1]).all()
    assert (values.min(axis=0) < bounds[:, 0] + 0.05 * width).all()
    assert (values.max(axis=0) > bounds[:, 1] - 0.05 * width).all()
    standing = (values[:, :3] == 0.0).all(axis=1).mean()
    assert 0.05 < standing < 0.16
    # Shares 0.2, 0.2, 0.3 and 0.3 of the 19 in 20 that do not leap; leaps add 30 pronks. The
    # tolerance is three standard deviations.
    np.testing.assert_allclose(np.bincount(gaits, minlength=4), [114, 144, 171, 171], atol=36)


def test_leaps_are_fast_and_slow_in_step_and_free_commands_only() -> None:
    config = dataclasses.replace(
        CONFIG, command_draw=dataclasses.replace(CONFIG.command_draw, leaps=1.0, standing=0.0)
    )
    draw = CommandDraw(config, np.random.default_rng(0), training=False)
    free = np.arange(200) < 100
    gaits, values, _ = draw.draw(*draw.bounds(200), free)
    assert (gaits[free] == 1).all() and not (gaits[~free] == 1).all()
    vx, frequency = values[:, INDEX["vx"]], values[:, INDEX["frequency"]]
    assert (vx[free] >= 0.87 - 1e-9).all() and vx[~free].min() < -0.5
    assert (frequency[free] <= 2.8).all() and frequency[~free].max() > 3.5


def test_strides_of_pronk_are_not_too_long() -> None:
    """In pronk no stride is longer than 0.48 m, but slow robots still step slowly.

    Other gaits have strides up to 0.6 m.
    """
    gaits, values = drawn(make(training=False), 4000)
    frequency = values[:, INDEX["frequency"]]
    stride = np.hypot(values[:, 0], values[:, 1]) / frequency
    assert 0.479 < stride[gaits == 1].max() < 0.48 + 1e-9 and stride[gaits != 1].max() > 0.54
    assert frequency[gaits == 1].min() < 2.05


def test_pronk_is_as_fast_as_its_quickest_steps_allow() -> None:
    slow = dataclasses.replace(CONFIG.commands, frequency=(1.5, 2.0))
    config = dataclasses.replace(CONFIG, commands=slow)
    draw = CommandDraw(config, np.random.default_rng(0), training=False)
    gaits, values = drawn(draw, 4000)
    speed, frequency = np.hypot(values[:, 0], values[:, 1]), values[:, INDEX["frequency"]]
    assert 1.5 <= frequency.min() and frequency.max() <= 2.0
    assert 0.95 < speed[gaits == 1].max() < 0.96 + 1e-9 and speed[gaits != 1].max() > 1.2


def test_training_begins_with_a_share_of_the_velocity_ranges() -> None:
    draw = make(training=True, command_start=0.25)
    assert draw.share.tolist() == [0.25] * 4
    draw.share[2] = 1.0
    gaits, values = drawn(draw, 400)
    paces = gaits == 2
    assert np.abs(values[~paces, 0]).max() <= 0.3 and np.abs(values[paces, 0]).max() > 0.7
    assert np.abs(values[:, INDEX["body_height"]]).max() > 0.029  # others have their full range


def test_what_robots_fell_at_is_tried_again() -> None:
    """Three in twenty free commands repeat one at which a robot fell, once there are any."""
    draw = make(training=True)
    fallen = np.array([[-0.9, 0.1, 0.2, 0.0, 2.1, 0.45, 0.08, 0.1, 0.0, 0.25, 0.4, 0.001]] * 2)
    fallen[1, 0] = 0.7
    free = np.arange(2000) < 1500
    _, _, again = draw.draw(*draw.bounds(2000), free)
    assert not again.any()
    for _ in range(200):  # the oldest are dropped
        draw.remember(np.concatenate([fallen, gait_embedding(np.array([0, 3]))], axis=1))
    gaits, values, again = draw.draw(*draw.bounds(2000), free)
    assert 0.12 < again[free].mean() < 0.18 and not again[~free].any()
    bound = gaits[again] == 3
    assert 0.4 < bound.mean() < 0.6 and set(gaits[again]) == {0, 3}
    np.testing.assert_array_equal(values[again], fallen[bound.astype(int)])
    assert draw.falls.shape == (256, 13)


def test_velocity_ranges_grow_for_a_gait_that_does_well() -> None:
    """With 4 robots, a gait is judged after 200 samples; if it does well, it gains 0.05."""
    draw, weights = make(training=True), CONFIG.rewards
    samples = np.array([1000.0, 0.0, 10.0, 1000.0])
    sums = {
        "steps": samples,
        "track_lin_vel": samples * weights.track_lin_vel * [1.0, 1.0, 1.0, 0.3],  # bound is slow
        "track_yaw_rate": samples * weights.track_yaw_rate,
        "match": samples,
    }
    draw.judge(sums, 4)
    np.testing.assert_allclose(draw.share, [0.45, 0.4, 0.4, 0.4], atol=1e-12)
    assert (draw.scores[[0, 3]] == 0.0).all() and draw.scores[2, 0] == 10
    np.testing.assert_allclose(draw.grown(), [0.05 / 0.6, 0.0, 0.0, 0.0], atol=1e-12)
    draw.share[0] = 0.98
    draw.judge(sums, 4)
    assert draw.share[0] == 1.0


def test_velocity_ranges_are_whole_outside_training() -> None:
    draw = make(training=False)
    assert draw.share.tolist() == [1.0] * 4 and draw.grown().tolist() == [1.0] * 4


@pytest.mark.parametrize(
    ("poor", "grows"),
    [
        ({}, True),
        ({"track_lin_vel": 0.3}, False),
        ({"track_yaw_rate": 0.3}, False),
        ({"match": 0.3}, False),
    ],
    ids=["good", "velocity", "yaw rate", "contact"],
)
def test_ranges_grow_only_where_all_is_tracked(poor: dict[str, float], grows: bool) -> None:
    draw = CommandDraw(CONFIG, np.random.default_rng(0), training=True)
    before, weights = draw.share.copy(), CONFIG.rewards
    best = {
        "track_lin_vel": weights.track_lin_vel,
        "track_yaw_rate": weights.track_yaw_rate,
        "match": 1.0,
    }
    steps = np.full(4, 1e6)
    sums = {name: steps * value * poor.get(name, 1.0) for name, value in best.items()}
    draw.judge({"steps": steps} | sums, 4)
    assert (draw.share > before).all() == grows


@pytest.mark.parametrize("name", ["track_lin_vel", "track_yaw_rate"])
def test_a_tracking_reward_that_is_switched_off_holds_no_gait_back(name: str) -> None:
    weights = dataclasses.replace(CONFIG.rewards, **{name: 0.0})
    config = dataclasses.replace(CONFIG, rewards=weights)
    draw = CommandDraw(config, np.random.default_rng(0), training=True)
    before, steps = draw.share.copy(), np.full(4, 1e6)
    sums = {key: steps * getattr(weights, key) for key in ("track_lin_vel", "track_yaw_rate")}
    draw.judge({"steps": steps, "match": steps} | sums, 4)
    assert (draw.share > before).all()


def test_velocities_and_yaw_rates_are_drawn_from_a_share_of_their_ranges() -> None:
    draw = CommandDraw(CONFIG, np.random.default_rng(0), training=True)
    draw.share[:] = 0.25
    _, values, _ = draw.draw(*draw.bounds(400), np.ones(400, dtype=bool))
    bounds = np.abs(np.array(dataclasses.astuple(CONFIG.commands))[:3]).max(axis=1)
    assert (np.abs(values[:, :3]) <= 0.25 * bounds + 1e-9).all()
