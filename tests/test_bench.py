"""``tdgc.bench``: what it measures and writes, but not how fast this machine is."""

import dataclasses
import functools
import json
import time
from pathlib import Path

import numpy as np
import pytest
import torch as th
from sb3_contrib import RecurrentPPO
from stubs import no_task

from tdgc import bench
from tdgc.config import HighTrainConfig, LowLevelConfig, LowTrainConfig
from tdgc.learn.recurrent import FastRecurrentPPO
from tdgc.parallel.vec import TaskVecEnv
from tdgc.tasks.low_env import LowLevelTask
from tdgc.tasks.low_observation import low_spaces


def test_robots_are_spread_over_the_levels() -> None:
    """Each of two workers spreads its own share of five robots, and all begin new episodes."""
    config = LowLevelConfig()
    env = TaskVecEnv(functools.partial(LowLevelTask, config), 5, 2, 0, low_spaces(config))
    env.reset()
    env.step(np.zeros((5, 12), dtype=np.float32))
    bench.spread_levels(env, 2)
    assert [state["level"].tolist() for state in env.state_dicts()] == [[0, 1], [0, 1, 0]]
    assert env.starts().all()
    env.close()


def test_learning_leaves_the_threads_as_they_were() -> None:
    before = th.get_num_threads()
    assert bench.learn(LowTrainConfig(), before + 1, 0.01) > 0.0
    assert th.get_num_threads() == before


def test_load(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, values in (("ROBOTS", (2,)), ("WORKERS", (1, 2)), ("THREADS", (1,))):
        monkeypatch.setattr(bench, f"LOAD_{name}", values)
    assert bench.main(["--load", "--seconds", "0.1", "--out", str(tmp_path)]) == 0
    result = json.loads((tmp_path / "load.json").read_text())
    assert result["cores"] >= 1 and result["learn"]["1"] > 0.0
    for row in result["collect"]["2"].values():
        assert 0.0 < row["bullet_share"] < 1.0 < row["steps_per_s"]
        assert row["mb_total"] == pytest.approx(2 * row["mb_per_robot"])
    alone, both = (result["collect"]["2"][workers]["mb_total"] for workers in ("1", "2"))
    assert both - alone < 100.0  # a worker with PyTorch would take 150 MB more
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[:2] for line in lines if line] == [
        ["robots", "workers"], ["2", "1"], ["2", "2"], ["threads", "steps/s"],
        ["1", f"{result['learn']['1']:.0f}"],
    ]  # fmt: skip


def test_the_high_levels_update(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """On a small configuration, each learner changes every tensor of its policy."""
    config = HighTrainConfig(n_envs=4)
    config = dataclasses.replace(config, ppo=dataclasses.replace(config.ppo, n_steps=8, lstm=8))
    monkeypatch.setattr(bench, "HighTrainConfig", lambda: config)
    monkeypatch.setattr(bench, "UPDATES", 2)
    learners, before, fill = [], [], bench.fill

    def keep(model: RecurrentPPO, rng: np.random.Generator) -> None:
        fill(model, rng)
        learners.append(model)
        before.append({name: p.clone() for name, p in model.policy.state_dict().items()})

    monkeypatch.setattr(bench, "fill", keep)
    assert bench.main(["--update", "--out", str(tmp_path)]) == 0
    result = json.loads((tmp_path / "update.json").read_text())
    assert sorted(result) == ["fast", "ratio", "stock"] and min(result.values()) > 0.0
    assert [type(model) for model in learners] == [RecurrentPPO, FastRecurrentPPO]
    for model, start in zip(learners, before, strict=True):
        assert all((p != start[name]).any() for name, p in model.policy.state_dict().items())
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["update", "stock", "fast"]


def test_an_updates_times_are_medians(monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock is advanced by the updates only; the first update of a learner does not count."""
    taken = {
        RecurrentPPO: iter([9.0, 4.0, 6.0, 30.0]),
        FastRecurrentPPO: iter([9.0, 2.0, 2.0, 5.0]),
    }
    now = 0.0

    def train(model: RecurrentPPO) -> None:
        nonlocal now
        now += next(taken[type(model)])

    for learner in taken:
        monkeypatch.setattr(learner, "train", train)
    monkeypatch.setattr(time, "perf_counter", lambda: now)
    monkeypatch.setattr(bench, "HighTrainConfig", lambda: HighTrainConfig(n_envs=4))
    monkeypatch.setattr(bench, "UPDATES", 3)
    # The ratios are 2, 3 and 6.
    assert bench.compare_updates() == {"stock": 6.0, "fast": 2.0, "ratio": 3.0}


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ("--robots 2 --workers 3", "--workers must be 1 to the number of robots\n"),
        ("--robots 0", "--robots must be at least 1, not 0\n"),
        ("--load --workers 2", "--load has its own settings: no --workers\n"),
        ("--update --seconds 5", "--update has its own settings: no --seconds\n"),
        ("--seconds 0", "--seconds must be above 0 and finite, not 0\n"),
        ("--seconds=-1", "--seconds must be above 0 and finite, not -1\n"),
        ("--seconds nan", "--seconds must be above 0 and finite, not nan\n"),
        ("--out {0}/file/out", "'{0}/file/out' cannot be used: Not a directory\n"),
    ],
)
def test_what_cannot_be_used_is_one_line_before_anything_is_measured(
    flags: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    out = ["--out", str(tmp_path / "out")]
    assert bench.main([*out, *flags.format(tmp_path).split()]) == 2
    said = capsys.readouterr()
    assert (said.out, said.err) == ("", f"tdgc.bench: {message.format(tmp_path)}")
    assert not (tmp_path / "out").exists()


def test_a_worker_that_fails_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(bench, "LowLevelTask", no_task)
    flags = ["--robots", "2", "--workers", "1", "--seconds", "0.1", "--out", str(tmp_path)]
    assert bench.main(flags) == 1
    wanted = "tdgc.bench: worker 0 failed: RuntimeError: no robots today, not even 2\n"
    assert capsys.readouterr().err == wanted
    assert not list(tmp_path.iterdir())


def test_a_result_that_cannot_be_written_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("ROBOTS", "WORKERS", "THREADS"):
        monkeypatch.setattr(bench, f"LOAD_{name}", (1,))
    (tmp_path / "load.json").mkdir()
    assert bench.main(["--load", "--seconds", "0.01", "--out", str(tmp_path)]) == 1
    said = capsys.readouterr().err
    assert said == f"tdgc.bench: [Errno 21] Is a directory: '{tmp_path / 'load.json'}'\n"
