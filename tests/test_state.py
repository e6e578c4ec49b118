"""States: arrays are restored in place, or split from the rest and joined again."""

import json

import numpy as np
import pytest

from tdgc.state import copies, fill, join, split


def test_arrays_are_filled_in_place() -> None:
    whole, flags = np.zeros(3, dtype=np.int64), np.zeros((2, 1), dtype=bool)
    before = copies({"whole": whole})
    fill({"whole": whole, "flags": flags}, {"whole": [1, 2, 3], "flags": [[1], [0]], "more": 7})
    assert whole.tolist() == [1, 2, 3] and flags.tolist() == [[True], [False]]
    assert before["whole"].tolist() == [0, 0, 0]


def test_what_does_not_fit_is_refused() -> None:
    speed = np.zeros((4, 3))
    with pytest.raises(ValueError, match=r"^'speed' has shape \(3,\), not \(4, 3\)$"):
        fill({"speed": speed}, {"speed": np.ones(3)})  # although it could be broadcast
    with pytest.raises(ValueError, match=r"^the state lacks 'speed'$"):
        fill({"speed": speed}, {"sped": speed})
    assert not speed.any()


def test_arrays_and_the_rest_are_parted_and_joined() -> None:
    a, b = np.arange(3), np.ones((2, 2), dtype=bool)
    state = {"rng": {"words": 2**100}, "workers": [{"a": a, "in": {"b": b}}, {"n": None}]}
    arrays: dict[str, np.ndarray] = {}
    rest = split(state, "run", arrays)
    assert list(arrays) == ["run.workers.0.a", "run.workers.0.in.b"]
    joined = join(json.loads(json.dumps(rest)), arrays)
    assert joined["workers"][0]["a"] is a and joined["workers"][0]["in"]["b"] is b
    del state["workers"][0], joined["workers"][0]  # type: ignore[attr-defined]
    assert joined == state
    with pytest.raises(KeyError):
        join(rest, {})
