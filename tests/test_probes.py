"""Height probes: their layout, what they read, and the errors of their sensor."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from tdgc.config import (
    HighLevelConfig,
    LowLevelConfig,
    PhysicsConfig,
    RandomisationConfig,
    RobotConfig,
)
from tdgc.sim.bullet_world import BulletWorld
from tdgc.sim.locomotion import Locomotion
from tdgc.sim.sensors import Noise
from tdgc.sim.terrain import make_tile
from tdgc.sim.tile import TileField
from tdgc.tasks.probes import (
    NUM_PROBES,
    PROBE_RANGE,
    PROBE_SWAP,
    PROBES,
    HeightProbes,
    height_probes,
)

ROBOTS = 8


@pytest.fixture
def loco() -> Iterator[Locomotion]:
    """Robots 0.6 m before the first trench of their tiles."""
    field = TileField(ROBOTS)
    for k in range(ROBOTS):
        field.place(k, make_tile("gap", 1.0, np.random.default_rng(k)))
    loco = Locomotion(BulletWorld(ROBOTS, RobotConfig(), PhysicsConfig(), field), LowLevelConfig())
    rows = np.arange(ROBOTS)
    lips = np.array([field.features[k].trenches[0, 0] for k in range(ROBOTS)])
    xy = field.origin(rows) + np.column_stack([lips - 0.6, np.full(ROBOTS, 4.0)])
    loco.place(rows, xy, np.zeros(ROBOTS), np.zeros(ROBOTS))
    yield loco
    loco.world.close()


POINTS = PROBES[HighLevelConfig().probes]


def test_they_are_the_same_on_both_sides_and_close_enough() -> None:
    assert len(POINTS) == NUM_PROBES == 32
    np.testing.assert_allclose(POINTS[list(PROBE_SWAP)] * [1.0, -1.0], POINTS, atol=1e-12)
    ahead = np.sort(POINTS[POINTS[:, 1] == 0.0, 0])
    np.testing.assert_allclose(np.diff(ahead), [*[0.05] * 13, *[0.075] * 6])
    assert ahead[0] == 0.1 and ahead[-1] == pytest.approx(1.2)
    np.testing.assert_allclose(np.unique(POINTS[:, 1]), [-0.4, -0.2, 0.0, 0.2, 0.4])


def begun(loco: Locomotion, noise: Noise | None) -> HeightProbes:
    probes = HeightProbes(loco, POINTS, noise)
    probes.begin(np.arange(ROBOTS))
    return probes


def test_they_see_the_trench_ahead(loco: Locomotion) -> None:
    seen = begun(loco, None).read()
    assert np.array_equal(seen, height_probes(loco, POINTS))
    before, in_it = POINTS[:, 0] < 0.55, (POINTS[:, 0] > 0.65) & (POINTS[:, 0] < 0.8)
    assert (np.abs(seen[:, before]) < 0.05).all()
    assert (seen[:, in_it] == -PROBE_RANGE).all()


def test_noise_is_as_wide_as_it_says(loco: Locomotion) -> None:
    noise = Noise(RandomisationConfig(noise_probes=0.02, probe_delay=0.0), np.random.default_rng(0))
    probes, exact = begun(loco, noise), height_probes(loco, POINTS)
    level = np.abs(exact) < 0.1
    off = []
    for _ in range(20):
        probes.measure()
        off.append((probes.read() - exact)[level])
    assert 0.0195 < np.abs(off).max() <= 0.02
    assert abs(np.mean(off)) < 0.001
    assert np.abs(probes.read()).max() <= PROBE_RANGE
    assert np.array_equal(probes.read(), probes.read())  # reading draws no new noise


def test_the_late_are_one_decision_late(loco: Locomotion) -> None:
    config = RandomisationConfig(noise_probes=0.0, probe_delay=0.5)
    probes = begun(loco, Noise(config, np.random.default_rng(1)))
    late = probes.late.copy()
    assert 0 < late.sum() < ROBOTS
    seen = [height_probes(loco, POINTS)]
    assert np.array_equal(probes.read(), seen[0])  # nothing was measured before
    for _ in range(3):
        loco.world.state.position[:, 0] += 0.07
        probes.measure()
        seen.append(height_probes(loco, POINTS))
        assert np.array_equal(probes.read()[late], seen[-2][late])
        assert np.array_equal(probes.read()[~late], seen[-1][~late])
        assert (np.abs(seen[-1] - seen[-2]).max(axis=1) > 0.1).all()  # a probe crossed a lip
    probes.begin(np.flatnonzero(late)[:1])  # a new episode forgets the last one's readings
    first = np.flatnonzero(late)[0]
    assert np.array_equal(probes.read()[first], seen[-1][first])


@pytest.mark.parametrize(("delay", "scale", "late"), [(1.0, 1.0, 8), (0.0, 1.0, 0), (1.0, 0.0, 0)])
def test_share_of_the_late(loco: Locomotion, delay: float, scale: float, late: int) -> None:
    config = RandomisationConfig(probe_delay=delay, scale=scale)
    probes = begun(loco, Noise(config, np.random.default_rng(1)))
    assert probes.late.sum() == late
    if not scale:
        assert np.array_equal(probes.read(), height_probes(loco, POINTS))
