"""The hashes that are compared before and after a rebuild repeat, and tell results apart."""

import pytest
from hashes import episodes, graphs

from tdgc.benchmark import evaluation
from tdgc.policies import Policy
from tdgc.tasks.pairing import PRETRAINED, load_low


def test_what_is_computed_again_has_the_same_hash(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of episodes, which another policy changes, and of graphs."""
    monkeypatch.setattr(evaluation, "HORIZON", 0.6)
    before = episodes(["tilt"], 1)
    assert episodes(["tilt"], 1) == before
    shipped, config = load_low(PRETRAINED / "low")
    nudged = Policy(shipped.header, {n: 1.0001 * t for n, t in shipped.tensors.items()})
    monkeypatch.setattr("hashes.load_low", lambda path: (nudged, config))
    assert episodes(["tilt"], 1) != before
    assert graphs(steps=12) == graphs(steps=12)
