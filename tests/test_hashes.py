"""The hashes that are compared before and after a rebuild repeat, and tell results apart."""

import pytest
from hashes import episodes, graphs

from tdgc.policies import Policy
from tdgc.tasks.pairing import PRETRAINED, load_low


def test_what_is_computed_again_has_the_same_hash() -> None:
    assert episodes(["tilt"], 1) == episodes(["tilt"], 1)
    assert graphs(steps=12) == graphs(steps=12)


def test_another_policy_has_other_hashes(monkeypatch: pytest.MonkeyPatch) -> None:
    before = episodes(["tilt"], 1)
    shipped, config = load_low(PRETRAINED / "low")
    nudged = Policy(shipped.header, {n: 1.0001 * t for n, t in shipped.tensors.items()})
    monkeypatch.setattr("hashes.load_low", lambda path: (nudged, config))
    assert episodes(["tilt"], 1) != before
