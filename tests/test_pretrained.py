"""The shipped pair: trained with the current defaults, each by one complete run."""

import dataclasses
import hashlib
import itertools
import json
from pathlib import Path
from typing import Any

import pytest

from tdgc import policies
from tdgc.config import (
    HighLevelConfig,
    HighTrainConfig,
    LowLevelConfig,
    LowTrainConfig,
    TeacherConfig,
    recorded,
    to_dict,
)
from tdgc.sim.terrain import EDITION
from tdgc.tasks.pairing import PRETRAINED, load_low, paired


def read(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def plain(config: object) -> Any:
    return json.loads(json.dumps(to_dict(config)))


def rows(name: str) -> list[dict[str, Any]]:
    text = (PRETRAINED / f"{name}_run" / "log.jsonl").read_text(encoding="utf-8")
    return [json.loads(line) for line in text.splitlines()]


def test_the_low_policy_was_trained_with_the_defaults() -> None:
    config, path = LowTrainConfig(), PRETRAINED / "low_run" / "config.json"
    # A setting that came later has the value that the run had without it.
    assert recorded(LowTrainConfig, read(path), path) == config
    meta = policies.load(PRETRAINED / "low").meta
    assert recorded(LowLevelConfig, meta["config"], "low") == config.env
    assert meta["calibration"]["robots"] == 4800


def test_the_high_policy_was_trained_with_the_defaults() -> None:
    """It was also trained on the shipped low policy."""
    used = PRETRAINED / "low"
    _, low = load_low(used)
    defaults = HighTrainConfig()
    config = dataclasses.replace(
        defaults,
        env=paired(defaults.env, low),
        low="tdgc/pretrained/low",
        low_sha256=hashlib.sha256(used.with_suffix(".json").read_bytes()).hexdigest(),
    )
    path = PRETRAINED / "high_run" / "config.json"
    # A setting that came later has the value that the run had without it.
    run = recorded(HighTrainConfig, read(path), path)
    # What the trials found for the shipped low policy.
    assert run.imitation.teacher == TeacherConfig()
    imitation = dataclasses.replace(run.imitation, teacher=None)
    assert dataclasses.replace(run, imitation=imitation) == config
    meta = policies.load(PRETRAINED / "high").meta
    assert meta["teacher"] == plain(TeacherConfig())
    assert recorded(HighLevelConfig, meta["config"], "high") == config.env
    assert recorded(LowLevelConfig, meta["low"]["config"], "high") == low


@pytest.mark.parametrize(
    ("name", "config"), [("low", LowTrainConfig()), ("high", HighTrainConfig())]
)
def test_logs_are_of_one_run_from_its_first_step_to_its_last(
    name: str, config: LowTrainConfig | HighTrainConfig
) -> None:
    steps = [row["steps"] for row in rows(name)]
    assert steps == sorted(set(steps)) and steps[0] < 1.1 * config.log_steps
    assert 0.99 * config.steps < steps[-1] < 1.01 * config.steps
    assert max(b - a for a, b in itertools.pairwise(steps)) < 2.0 * config.log_steps
    meta = policies.load(PRETRAINED / name).meta
    assert config.steps <= meta["steps"] < 1.01 * config.steps and meta["benchmark"] == EDITION
