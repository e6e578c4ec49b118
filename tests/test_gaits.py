"""Gaits: phases of the feet, the warp by duty factor, the contact schedule and the clock."""

import math

import numpy as np
import pytest

from tdgc.sim.gaits import (
    FEET,
    GAIT_TABLE,
    GAITS,
    PhaseClock,
    begun,
    desired_contact,
    foot_phases,
    gait_embedding,
    normal_cdf,
    raw_phase,
    swing_profile,
)


def test_order_of_feet_and_gaits() -> None:
    assert FEET == ("FL", "FR", "RL", "RR")
    assert GAITS == ("trot", "pronk", "pace", "bound")


def test_embedding() -> None:
    assert gait_embedding([0, 1, 2, 3]).tolist() == [
        [0.5, 0.0, 0.0],  # trot: phase
        [0.0, 0.0, 0.0],
        [0.0, 0.0, 0.5],  # pace: bound
        [0.0, 0.5, 0.0],  # bound: offset
    ]
    assert gait_embedding(2).shape == (3,)
    assert gait_embedding(np.zeros((2, 5), dtype=int)).shape == (2, 5, 3)
    assert gait_embedding([]).shape == (0, 3)


@pytest.mark.parametrize("index", [-1, 4, [0, 7]])
def test_embedding_of_no_gait(index: int | list[int]) -> None:
    with pytest.raises(ValueError, match=r"^gait index must be 0\.\.3 \(trot, pronk, pace, bound"):
        gait_embedding(index)


# Computed by hand at g = 0.1 and a duty factor of one half: FL g + phase + offset + bound,
# FR g + offset, RL g + bound, RR g + phase.
@pytest.mark.parametrize(
    ("gait", "front_left", "front_right", "rear_left", "rear_right"),
    [
        ("trot", 0.6, 0.1, 0.1, 0.6),
        ("pronk", 0.1, 0.1, 0.1, 0.1),
        ("pace", 0.6, 0.1, 0.6, 0.1),
        ("bound", 0.6, 0.6, 0.1, 0.1),
    ],
)
def test_every_foot_of_every_gait(
    gait: str, front_left: float, front_right: float, rear_left: float, rear_right: float
) -> None:
    half = np.array([0.5])
    embedding = gait_embedding([GAITS.index(gait)])
    expected = np.array([[front_left, front_right, rear_left, rear_right]])
    np.testing.assert_allclose(foot_phases(np.array([0.1]), embedding, half), expected, atol=1e-12)
    later = foot_phases(np.array([0.75]), embedding, half)
    np.testing.assert_allclose(later, np.mod(expected + 0.65, 1.0), atol=1e-12)


def test_the_three_terms_one_by_one() -> None:
    """Values that no gait has, so that a term added to the wrong foot shows."""
    phases = foot_phases(np.array([0.05]), np.array([[0.1, 0.2, 0.3]]), np.array([0.5]))
    np.testing.assert_allclose(phases, [[0.65, 0.25, 0.35, 0.15]], atol=1e-12)


@pytest.mark.parametrize("duty", [0.4, 0.5, 0.6])
def test_the_clock_follows_from_a_warped_phase(duty: float) -> None:
    clock, duties = np.linspace(0.0, 0.99, 100), np.full(100, duty)
    front_right = foot_phases(clock, np.tile(gait_embedding(1), (100, 1)), duties)[:, 1]
    np.testing.assert_allclose(raw_phase(front_right, duties), clock, atol=1e-12)
    assert np.abs(front_right - clock).max() == pytest.approx(abs(duty - 0.5), abs=0.01)


@pytest.mark.parametrize("duty", [0.4, 0.5, 0.6])
def test_duration_warps_stance_and_swing_to_half_a_cycle_each(duty: float) -> None:
    raw = np.array([0.0, duty / 2, duty, (1 + duty) / 2, 1.0 - 1e-9])
    n = len(raw)
    phases = foot_phases(raw, np.tile(GAIT_TABLE[1], (n, 1)), np.full(n, duty))
    wanted = np.array([0.0, 0.25, 0.5, 0.75, 1.0])
    np.testing.assert_allclose(phases, np.tile(wanted[:, None], 4), atol=2e-9)
    assert phases.max() < 1.0


def test_duty_factor_is_the_share_of_stance() -> None:
    clock = (np.arange(1000) + 0.5) / 1000
    phases = foot_phases(clock, np.tile(GAIT_TABLE[0], (1000, 1)), np.full(1000, 0.4))
    assert (phases < 0.5).mean(axis=0).tolist() == [0.4, 0.4, 0.4, 0.4]


def test_each_robot_has_its_own_clock_gait_and_duty_factor() -> None:
    clock, embedding = np.array([0.1, 0.3, 0.7]), gait_embedding([0, 3, 2])
    duration = np.array([0.4, 0.5, 0.6])
    together = foot_phases(clock, embedding, duration)
    for i in range(3):
        alone = foot_phases(clock[i : i + 1], embedding[i : i + 1], duration[i : i + 1])
        assert together[i].tolist() == alone[0].tolist()


def test_normal_cdf() -> None:
    x = np.linspace(-1.0, 1.0, 2001)
    exact = np.array([0.5 * (1.0 + math.erf(v / 0.07 / math.sqrt(2.0))) for v in x])
    np.testing.assert_allclose(normal_cdf(x, 0.07), exact, atol=7.5e-8, rtol=0)
    assert normal_cdf(np.array([0.07]), 0.07)[0] == pytest.approx(0.8413447, abs=1e-7)


def test_desired_contact() -> None:
    mid_stance, lift_off, mid_swing, touch_down = desired_contact(np.array([0.25, 0.5, 0.75, 0.0]))
    # The quarter cycle to the next switch is 0.25 / 0.07 = 3.57 standard deviations.
    tail = 0.5 * math.erfc(0.25 / 0.07 / math.sqrt(2.0))
    assert mid_stance == pytest.approx((1.0 - tail) ** 2, abs=1e-6) and mid_stance > 0.999
    assert mid_swing == pytest.approx(2 * tail * (1.0 - tail), abs=1e-6) and mid_swing < 0.001
    assert lift_off == pytest.approx(0.5, abs=1e-6)
    assert touch_down == pytest.approx(0.5, abs=1e-6)
    # One standard deviation inside stance, and one outside.
    edges = desired_contact(np.array([0.07, 0.43, 0.57, 0.93]))
    np.testing.assert_allclose(edges, [0.8413447, 0.8413447, 0.1586553, 0.1586553], atol=1e-6)


def test_desired_contact_is_symmetric_about_mid_stance_and_joins_at_the_cycle_end() -> None:
    phase = np.linspace(0.0, 0.5, 101)
    np.testing.assert_allclose(desired_contact(phase), desired_contact(0.5 - phase), atol=2e-7)
    assert desired_contact(np.array([1.0 - 1e-9]))[0] == pytest.approx(0.5, abs=1e-6)
    values = desired_contact(np.linspace(0.0, 1.0, 1001))
    assert values.min() >= 0.0 and values.max() <= 1.0


def test_swing_profile() -> None:
    phases = np.array([0.0, 0.25, 0.5, 7.0 / 12.0, 0.75, 11.0 / 12.0, 1.0])
    expected = [0.0, 0.0, 0.0, 0.5, 1.0, 0.5, 0.0]  # half a sine
    np.testing.assert_allclose(swing_profile(phases), expected, atol=1e-12)


def test_clock_advances_by_frequency_and_wraps() -> None:
    clock = PhaseClock(2)
    clock.reset(np.array([0, 1]), np.array([0.0, 0.95]))
    duty, embedding = np.array([0.5, 0.5]), gait_embedding([1, 0])
    clock.advance(0.02, np.array([2.0, 4.0]), embedding, duty)
    np.testing.assert_allclose(clock.clock, [0.04, 0.03], atol=1e-12)
    np.testing.assert_allclose(clock.phases, [[0.04] * 4, [0.53, 0.03, 0.03, 0.53]], atol=1e-12)
    np.testing.assert_allclose(clock.contact, desired_contact(clock.phases), atol=0)
    sine = math.sin(2 * math.pi * 0.03)
    np.testing.assert_allclose(clock.signal()[1], [-sine, sine, sine, -sine], atol=1e-12)


def test_clock_follows_a_change_of_gait_without_moving() -> None:
    clock = PhaseClock(1)
    clock.reset(0, 0.2)
    clock.update(gait_embedding([0]), np.array([0.5]))
    np.testing.assert_allclose(clock.phases, [[0.7, 0.2, 0.2, 0.7]], atol=1e-12)
    clock.update(gait_embedding([3]), np.array([0.5]))
    np.testing.assert_allclose(clock.phases, [[0.7, 0.7, 0.2, 0.2]], atol=1e-12)
    assert clock.clock.tolist() == [0.2]


def test_three_hertz_for_a_second_and_a_half() -> None:
    clock = PhaseClock(1)
    for _ in range(75):
        clock.advance(0.02, np.array([3.0]), gait_embedding([0]), np.array([0.5]))
    assert clock.clock[0] == pytest.approx(0.5, abs=1e-9)  # four and a half cycles


def test_swing_grows_over_the_first_cycles_of_a_gait() -> None:
    clock, frequency, duty = PhaseClock(2), np.array([2.0, 4.0]), np.full(2, 0.5)
    trot, pronk = gait_embedding([0, 0]), gait_embedding([0, 1])
    clock.update(trot, duty)
    for _ in range(10):  # 0.4 and 0.8 cycles
        clock.advance(0.02, frequency, trot, duty)
    np.testing.assert_allclose(clock.cycles, [0.4, 0.8], atol=1e-12)
    np.testing.assert_allclose(clock.phases[:, 0], [0.9, 0.3], atol=1e-12)
    height = math.sin(0.8 * math.pi)  # at 0.8 of its swing
    np.testing.assert_allclose(clock.swing(1.0)[0], [0.4 * height, 0, 0, 0.4 * height], atol=1e-12)
    np.testing.assert_allclose(clock.swing(0.5)[0], [0.8 * height, 0, 0, 0.8 * height], atol=1e-12)
    np.testing.assert_allclose(clock.swing(0.2)[0], [height, 0, 0, height], atol=1e-12)
    assert (clock.swing(0.0) == swing_profile(clock.phases)).all()
    np.testing.assert_allclose(begun(clock.cycles, 2.0), [0.2, 0.4], atol=1e-12)
    np.testing.assert_allclose(begun(clock.cycles, 0.5), [0.8, 1.0], atol=1e-12)
    assert begun(clock.cycles, 0.0).tolist() == [1.0, 1.0]
    clock.update(pronk, duty)  # the second robot changes its gait
    np.testing.assert_allclose(clock.cycles, [0.4, 0.0], atol=1e-12)
    assert (clock.swing(1.0)[1] == 0.0).all() and (clock.swing(0.0)[1] == 0.0).sum() == 0
    clock.advance(0.02, frequency, pronk, duty)
    np.testing.assert_allclose(clock.cycles, [0.44, 0.08], atol=1e-12)
    height = math.sin(2 * 0.38 * math.pi)
    np.testing.assert_allclose(clock.swing(1.0)[1], np.full(4, 0.08 * height), atol=1e-12)
    clock.reset(np.array([0]), 0.7)
    assert clock.cycles.tolist() == [0.0, pytest.approx(0.08)]
