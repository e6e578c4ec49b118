"""Observation layouts: rows, columns, noise and mirror images follow from the terms."""

import numpy as np

from tdgc.config import RandomisationConfig
from tdgc.sim.observation import LEG_FLIP, Flip, Term, columns, in_place, mirror, observe, width
from tdgc.sim.sensors import Noise

LAYOUT: tuple[Term[np.ndarray], ...] = (
    Term("speed", 2, lambda x: x[:, :2], 10.0, "noise_gyro", in_place(1.0, -1.0)),
    Term("mean", 1, lambda x: x.mean(axis=1, keepdims=True)),
    Term("contact", 4, lambda x: np.tile(x[:, :1] > 0.0, 4), mirror=LEG_FLIP),
)
SOURCE = np.array([[1.0, 2.0, 3.0], [-1.0, 0.0, 4.0]])


def test_rows_have_the_terms_in_order_and_scaled() -> None:
    rows = observe(LAYOUT, SOURCE)
    assert rows.dtype == np.float32 and width(LAYOUT) == 7
    assert rows.tolist() == [[10, 20, 2, 1, 1, 1, 1], [-10, 0, 1, 0, 0, 0, 0]]
    assert columns(LAYOUT) == {"speed": slice(0, 2), "mean": slice(2, 3), "contact": slice(3, 7)}


def test_noise_is_in_the_unit_that_is_read() -> None:
    noise = Noise(RandomisationConfig(noise_gyro=0.1, scale=0.5), np.random.default_rng(0))
    error = np.array([observe(LAYOUT, SOURCE, noise) for _ in range(200)]) - observe(LAYOUT, SOURCE)
    assert (error[..., 2:] == 0.0).all()
    assert 0.49 < np.abs(error[..., :2]).max() <= 0.5


def test_mirror() -> None:
    flip = mirror(LAYOUT)
    assert flip == Flip((0, 1, 2, 4, 3, 6, 5), (1.0, -1.0, 1.0, 1.0, 1.0, 1.0, 1.0))
