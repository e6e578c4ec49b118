"""Checkpoints, interruption, flags, and resumed runs that end as if they had never stopped."""

import argparse
import contextlib
import copy
import dataclasses
import errno
import functools
import json
import math
import multiprocessing
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3 import PPO
from stubs import in_this_process, no_file_larger_than
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import train_high
import train_low
from tdgc import calibration, policies
from tdgc.config import (
    FIRST_TEACHER,
    CalibrationConfig,
    CommandRanges,
    ConfigError,
    HighTrainConfig,
    LowTrainConfig,
    PPOConfig,
    TeacherConfig,
    from_dict,
    to_dict,
    with_overrides,
)
from tdgc.errors import what_stopped
from tdgc.learn.checkpoints import Checkpoint, CheckpointError
from tdgc.learn.flags import Machine, _keep_start, add_arguments, configure
from tdgc.learn.imitation import TaughtPolicy
from tdgc.learn.ppo import LinearRate, NoiseScaledRate
from tdgc.learn.recurrent import exchange_memories
from tdgc.learn.run import Interruption, Run, append_line, drop_rows_after, tensorboard_logger
from tdgc.parallel.cores import usable_cores
from tdgc.parallel.vec import worker_seed
from tdgc.parallel.worker import ProcessLink
from tdgc.policies import AsymmetricActorCriticPolicy
from tdgc.sim.gaits import GAITS
from tdgc.sim.locomotion import actor_layout
from tdgc.sim.observation import width
from tdgc.tasks.high_observation import untold_column
from tdgc.tasks.low_observation import low_mirror, low_spaces
from tdgc.tasks.pairing import PRETRAINED, load_low

ROOT = Path(__file__).resolve().parents[1]

pytestmark = pytest.mark.usefixtures("signals")


# ------------------------------------------------------------------ checkpoints


def learner(seed: int, hidden: int = 8, steps: int = 32) -> PPO:
    model = PPO(
        "MlpPolicy", "Pendulum-v1", n_steps=16, batch_size=8, n_epochs=2, seed=seed, device="cpu",
        policy_kwargs={"net_arch": [hidden]},
    )  # fmt: skip
    model.learn(steps)
    return model


def parameters(model: PPO) -> dict[str, th.Tensor]:
    """Copies of the parameters and of the optimiser's moments."""
    tensors = {k: v.clone() for k, v in model.policy.state_dict().items()}
    for index, slots in model.policy.optimizer.state_dict()["state"].items():
        tensors |= {f"{index}.{k}": th.as_tensor(v).clone() for k, v in slots.items()}
    return tensors


def draw() -> tuple[float, float, float]:
    return random.random(), float(np.random.normal()), float(th.randn(()))


def test_checkpoint_round_trip(tmp_path: Path) -> None:
    model = learner(seed=1)
    np.random.normal()  # so that NumPy has cached the second value of a pair
    position = np.random.normal(size=(4, 3))
    state = {"epoch": 3, "robots": {"position": position}}
    path = Checkpoint.take(model, {"workers": [state], "phase": 1}).save(tmp_path)
    assert path == tmp_path / "step-000000000032"
    saved, drawn = parameters(model), draw()
    other = learner(seed=2, steps=16)
    assert any((saved[k] != v).any() for k, v in parameters(other).items())
    read = Checkpoint.read(path)
    (worker,) = read.workers()
    assert worker["epoch"] == 3 and read.header["phase"] == 1
    np.testing.assert_array_equal(worker["robots"]["position"], position)
    read.restore(other)
    loaded = parameters(other)
    assert set(loaded) == set(saved) and "0.exp_avg_sq" in saved
    assert all((loaded[k] == saved[k]).all() for k in saved)
    assert draw() == drawn
    assert (other.num_timesteps, other._n_updates) == (32, model._n_updates) == (32, 4)


def test_two_checkpoints_are_kept(tmp_path: Path) -> None:
    model = learner(seed=0)
    (tmp_path / ".step-000000000050.partial").mkdir()  # left by a process that was killed
    for steps in (100, 9, 2000, 2000):
        model.num_timesteps = steps
        Checkpoint.take(model, {}).save(tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["step-000000000100", "step-000000002000"]


def three(folder: Path) -> list[Path]:
    """Save two checkpoints, returned oldest first, and leave the folder of an unfinished third."""
    model = learner(seed=0)
    made = []
    for steps in (10, 20):
        model.num_timesteps = steps
        made.append(Checkpoint.take(model, {"at": steps}).save(folder / "checkpoints"))
    (folder / "checkpoints" / ".step-000000000030.partial").mkdir()
    return made


def test_the_newest_checkpoint_is_taken(tmp_path: Path) -> None:
    three(tmp_path)
    warnings: list[str] = []
    assert Checkpoint.newest(tmp_path, warnings.append).header["at"] == 20
    assert warnings == []


def truncate(path: Path) -> None:
    (path / "state.safetensors").write_bytes((path / "state.safetensors").read_bytes()[:-1])


def flip(path: Path) -> None:
    data = bytearray((path / "state.safetensors").read_bytes())
    data[-10] ^= 1
    (path / "state.safetensors").write_bytes(data)


def garble(path: Path) -> None:
    (path / "state.json").write_text('{"format": "tdgc-ch', encoding="utf-8")


def foreign(path: Path) -> None:
    (path / "state.json").write_text('{"format": "other", "version": 1}', encoding="utf-8")


def listed(path: Path) -> None:
    (path / "state.json").write_text("[]", encoding="utf-8")


def newer(path: Path) -> None:
    header = json.loads((path / "state.json").read_text(encoding="utf-8"))
    newer = header["version"] + 1
    (path / "state.json").write_text(json.dumps({**header, "version": newer}), encoding="utf-8")


def later(path: Path) -> None:
    header = json.loads((path / "state.json").read_text(encoding="utf-8"))
    later = header["n_updates"] + 1
    (path / "state.json").write_text(json.dumps({**header, "n_updates": later}), encoding="utf-8")


def remove(path: Path) -> None:
    (path / "state.safetensors").unlink()


@pytest.mark.parametrize("damage", [truncate, flip, garble, foreign, listed, newer, later, remove])
def test_a_damaged_checkpoint_falls_back_to_the_one_before(damage: Any, tmp_path: Path) -> None:
    before, newest = three(tmp_path)
    damage(newest)
    with pytest.raises(CheckpointError, match=str(newest)) as caught:
        Checkpoint.read(newest)
    assert "\n" not in str(caught.value)
    warnings: list[str] = []
    assert Checkpoint.newest(tmp_path, warnings.append).header["at"] == 10
    assert len(warnings) == 1 and str(newest) in warnings[0]
    assert warnings[0].endswith("; going on from step-000000000010")
    Checkpoint.read(before).drop_later(tmp_path / "checkpoints")  # as when a run goes on from it
    assert sorted(newest.parent.glob("step-*")) == [before]
    damage(before)
    with pytest.raises(CheckpointError, match=str(before)) as caught:
        Checkpoint.newest(tmp_path, warnings.append)
    assert "\n" not in str(caught.value) and len(warnings) == 1


def test_no_checkpoint_at_all(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r": no checkpoint$"):
        Checkpoint.newest(tmp_path, print)


def test_a_run_of_another_version_is_refused_in_one_line_that_says_what_to_do(
    tmp_path: Path,
) -> None:
    for checkpoint in three(tmp_path):
        newer(checkpoint)
    warnings: list[str] = []
    with pytest.raises(CheckpointError, match=r"a new run can begin .* with --init$") as caught:
        Checkpoint.newest(tmp_path, warnings.append)
    assert "\n" not in str(caught.value) and not warnings


def test_a_checkpoint_of_another_network(tmp_path: Path) -> None:
    taken = Checkpoint.take(learner(seed=0), {})
    with pytest.raises(CheckpointError, match=r"^the checkpoint does not fit the conf") as caught:
        taken.restore(learner(seed=0, hidden=9))
    assert "\n" not in str(caught.value)


def test_a_checkpoint_of_another_number_of_robots() -> None:
    model = learner(seed=0)
    memory = {
        name: th.zeros(1, 100, 8) for name in ("lstm.pi.h", "lstm.pi.c", "lstm.vf.h", "lstm.vf.c")
    }
    taken = Checkpoint.take(model, {})
    taken = dataclasses.replace(taken, tensors=taken.tensors | memory)
    with pytest.raises(CheckpointError, match=r"^the checkpoint is of 100 robots, not 1$"):
        taken.restore(model)


# ------------------------------------------------------------------ a full disk


def test_a_checkpoint_that_finds_no_room_leaves_those_before(tmp_path: Path) -> None:
    model = learner(seed=0)
    kept = [Checkpoint.take(model, {"at": 0}).save(tmp_path)]
    model.num_timesteps += 1
    with no_file_larger_than(2000), pytest.raises(OSError):
        Checkpoint.take(model, {"at": 1}).save(tmp_path)
    assert list(tmp_path.iterdir()) == kept
    assert Checkpoint.read(kept[0]).header["at"] == 0
    kept.append(Checkpoint.take(model, {"at": 2}).save(tmp_path))
    assert sorted(tmp_path.iterdir()) == kept


def test_a_line_is_added_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "log.jsonl"
    append_line(path, "first")
    for size in (6, 9):  # no room; room for a part of the line
        with no_file_larger_than(size), pytest.raises(OSError):
            append_line(path, "second")
        assert path.read_text() == "first\n"
    append_line(path, "third")
    assert path.read_text() == "first\nthird\n"


# ------------------------------------------------------------------ interruption


def test_rows_that_a_resumed_run_writes_again_are_dropped(tmp_path: Path) -> None:
    log = tmp_path / "log.jsonl"
    drop_rows_after(100, log)
    assert not log.exists()
    lines = ['{"steps": 100}', '{"steps": 200}', '{"steps": 300}']
    for line in lines:
        append_line(log, line)
    drop_rows_after(300, log)
    assert log.read_text().split("\n") == [*lines, ""]
    drop_rows_after(250, log)
    append_line(log, '{"steps": 260}')
    assert log.read_text().split("\n") == [*lines[:2], '{"steps": 260}', ""]


@pytest.mark.parametrize("tail", [b'{"steps": 3', b"\0\0\0\0", b"\xff\xfe", b"{}"])
def test_a_row_that_a_crash_cut_short_is_dropped(tail: bytes, tmp_path: Path) -> None:
    log = tmp_path / "log.jsonl"
    log.write_bytes(b'{"steps": 100}\n{"steps": 200}\n' + tail)
    drop_rows_after(250, log)
    assert log.read_text() == '{"steps": 100}\n{"steps": 200}\n'


def test_the_learning_rate_of_a_rollout_beyond_the_run() -> None:
    """SB3 gives it a remaining share below 0; the rate stays at its last value."""
    rate = LinearRate(1e-3, 1e-4)
    assert [rate(share) for share in (1.0, 0.5, 0.0)] == pytest.approx([1e-3, 5.5e-4, 1e-4])
    assert rate(-2.0) == 1e-4


def test_tensorboard_shows_what_a_resumed_run_wrote_again_once(tmp_path: Path) -> None:
    for begins, rows_of in ((0, {100: 1.0, 200: 2.0, 300: 3.0}), (200, {300: 4.0})):
        logger = tensorboard_logger(tmp_path, begins)
        for steps, value in rows_of.items():
            logger.record("reward", value)
            logger.dump(steps)
        logger.close()
        if not begins:  # TensorBoard orders files by the second in their names
            (file,) = tmp_path.glob("events.*")
            stamp = file.name.split(".")[3]
            file.rename(file.with_name(file.name.replace(stamp, str(int(stamp) - 1), 1)))
    shown = EventAccumulator(str(tmp_path)).Reload().Scalars("reward")
    assert [(event.step, event.value) for event in shown] == [(100, 1.0), (200, 2.0), (300, 4.0)]


def test_time_limit() -> None:
    assert not Interruption(None).due() and not Interruption(1000.0).due()
    over = Interruption(-1.0)
    assert over.due() and over.reason == "the time limit"
    os.kill(os.getpid(), signal.SIGTERM)  # the first signal; the last checkpoint is being written
    assert over.due() and over.reason == "the time limit"
    with pytest.raises(KeyboardInterrupt, match=r"^SIGTERM$"):
        os.kill(os.getpid(), signal.SIGTERM)


@pytest.mark.parametrize(("trainer", "flags"), [(train_low, []), (train_high, ["--no-teacher"])])
def test_a_second_ctrl_c_is_one_line(
    trainer: Any,
    flags: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def train(*given: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Run, "train", train)
    with pytest.raises(SystemExit) as ended:  # so that an ablation ends, too
        trainer.main([*flags, "--out", str(tmp_path)])
    assert ended.value.code == 1
    said = capsys.readouterr().err
    assert said.splitlines()[-1] == f"{trainer.__name__}.py: stopped by Ctrl-C"
    assert "Traceback" not in said


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_asks_to_stop_and_a_second_one_stops(number: signal.Signals) -> None:
    interruption = Interruption(None)
    os.kill(os.getpid(), number)
    assert interruption.due() and interruption.reason == number.name
    with pytest.raises(KeyboardInterrupt) as stopped:
        os.kill(os.getpid(), number)
    said = {signal.SIGINT: "stopped by Ctrl-C", signal.SIGTERM: "stopped by SIGTERM"}
    assert what_stopped(stopped.value) == said[number]


# ------------------------------------------------------------------ the policy that is trained


def test_the_policy_is_symmetric(tmp_path: Path) -> None:
    """A mirrored observation gives the mirrored action and the same value, for any weights.

    The saved policy gives the same actions.
    """
    config = LowTrainConfig().env
    mirror, actor_dim = low_mirror(config), width(actor_layout(config.robot, config.gyro))
    policy = AsymmetricActorCriticPolicy(
        *low_spaces(config), lambda _: 1e-3, actor_dim=actor_dim,
        mirror=mirror, net_arch={"pi": [16], "vf": [16]},
    )  # fmt: skip
    seen = th.randn(5, len(mirror.obs_index))
    image = seen[:, mirror.obs_index] * th.tensor(mirror.obs_sign)
    for _ in range(2):
        with th.no_grad():
            for tensor in policy.parameters():
                tensor.add_(0.3 * th.randn_like(tensor))
            action = policy.get_distribution(seen).mode()
            mirrored = policy.get_distribution(image).mode()
            th.testing.assert_close(
                mirrored, action[:, mirror.action_index] * th.tensor(mirror.action_sign)
            )
            assert (mirrored - action).abs().max() > 0.1
            th.testing.assert_close(policy.predict_values(image), policy.predict_values(seen))
    policies.save(tmp_path / "policy", policy, {})
    given, _ = policies.load(tmp_path / "policy").predict(seen[:, :actor_dim].numpy())
    wanted = action.clamp(-4.0, 4.0).numpy()
    np.testing.assert_allclose(given, wanted, atol=1e-5)


# ------------------------------------------------------------------ whole runs

TINY = [
    "--seed", "3", "--n-envs", "4", "--workers", "2", "--steps", "160",
    "--set", "calibration.robots=0", "--set", "checkpoint_seconds=0", "--set", "log_steps=64",
    "--set", "ppo.n_steps=8", "--set", "ppo.batch_size=16", "--set", "ppo.n_epochs=2",
    "--set", "ppo.actor=[8]", "--set", "ppo.critic=[8]", "--set", "env.episode_seconds=0.4",
    "--set", "env.physics.substeps=4", "--set", "plane_share=0.5",
    "--set", 'env.families=["stair","gap"]',
]  # fmt: skip


def at_calls(monkeypatch: pytest.MonkeyPatch, act: Callable[[int, Interruption], None]) -> None:
    """Call ``act(n, interruption)`` when a run checks for the n-th time whether to stop."""
    calls = 0

    def due(interruption: Interruption) -> bool:
        nonlocal calls
        calls += 1
        act(calls, interruption)
        return interruption.reason is not None

    monkeypatch.setattr(Interruption, "due", due)


def kill_run(script: str, arguments: list[str], last: Path) -> None:
    """Start a run and kill it once the checkpoint ``last`` has appeared."""
    process = subprocess.Popen(
        [sys.executable, script, *arguments],
        cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip
    while process.poll() is None and not last.exists():
        time.sleep(0.01)
    process.kill()
    output, _ = process.communicate(timeout=300.0)  # the workers hold the pipe open, too
    assert process.returncode == -signal.SIGKILL, output.decode()


def newest(run: Path) -> Path:
    return max((run / "checkpoints").glob("step-*"))


def final(run: Path) -> dict[str, Any]:
    """The final state of a run: the learner, the counters, the workers and the policy.

    The wall time is left out, and so is the checksum, which covers it.
    """
    header = Checkpoint.read(newest(run)).header
    timed = ("seconds", "sha256")
    return {
        **{key: value for key, value in header.items() if key not in timed},
        "tensors": (newest(run) / "state.safetensors").read_bytes(),
        "policy": weights(run),
    }


def weights(run: Path) -> bytes:
    return (run / "policy.safetensors").read_bytes()


def rows(run: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]


def test_a_stopped_killed_and_resumed_run_ends_as_one_that_never_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """A stopped, killed and resumed run ends in exactly the state of an uninterrupted one.

    Each makes five updates, with half of the robots on tiles. The first run writes one checkpoint
    before its end. The second is stopped after the first update, in the middle of episodes, and
    killed later; it loses its newest checkpoint and continues from the one before.
    """
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    assert train_low.main([*TINY, "--out", str(whole), "--set", "checkpoint_seconds=1e6"]) == 0
    names = sorted(path.name for path in (whole / "checkpoints").iterdir())
    assert names == ["step-000000000000", "step-000000000160"]
    assert [row["steps"] for row in rows(whole)] == [64, 128, 160]
    assert all(row["memory/mb"] > 100.0 for row in rows(whole))
    assert rows(whole)[1]["reward/track_lin_vel"] > 0.0 and "level/stair" in rows(whole)[1]
    stored = from_dict(LowTrainConfig, json.loads((whole / "config.json").read_text()))
    expected = LowTrainConfig(
        seed=3, n_envs=4, workers=2, steps=160, plane_share=0.5,
        checkpoint_seconds=1e6, log_steps=64, calibration=CalibrationConfig(robots=0),
    )  # fmt: skip
    assert dataclasses.replace(stored, env=expected.env, ppo=expected.ppo) == expected
    assert stored.ppo.actor == (8,) and stored.env.episode_seconds == 0.4

    def stop(call: int, interruption: Interruption) -> None:
        if call == 2:
            interruption.reason = "the test"

    with monkeypatch.context() as patch:
        at_calls(patch, stop)
        assert train_low.main([*TINY, "--out", str(broken)]) == 0
    stopped = Checkpoint.read(newest(broken))
    assert stopped.steps == 32 and stopped.header["phase"] == "learning to walk"
    under_way = [state["lengths"] for state in stopped.workers()]
    assert 0 < np.max(under_way) < 20  # of episodes of 20 steps
    # Flags that the run cannot continue with leave its configuration unchanged.
    config = (broken / "config.json").read_text(encoding="utf-8")
    assert train_low.main(["--resume", "--out", str(broken), "--n-envs", "6"]) == 2
    for flags in (["--seed", "4"], ["--set", "seed=4"]):
        assert train_low.main(["--resume", "--out", str(broken), *flags]) == 2
        assert "--resume keeps the run's seed, 3: no other seed" in "".join(capfd.readouterr())
    for name, before, now in (
        ("ppo.initial_std", 1.0, 0.5), ("env.command_start", 0.4, 0.5), ("env.first_levels", 3, 1),
        ("env.families", ["stair", "gap"], '["rough","gap"]'),
        ("env.crossing.shallowest_trench", 0.05, 0.1),
    ):  # fmt: skip
        assert train_low.main(["--resume", "--out", str(broken), "--set", f"{name}={now}"]) == 2
        said = f"--resume keeps the run's {name}, {before}: no other {name}\n"
        assert capfd.readouterr().err.endswith(said)
    assert (broken / "config.json").read_text(encoding="utf-8") == config
    last = broken / "checkpoints/step-000000000096"
    kill_run("train_low.py", ["--resume", "--out", str(broken)], last)
    assert weights(broken) != weights(whole)
    flip(newest(broken))
    damaged = broken / "checkpoints/step-000000999999"
    damaged.mkdir()
    assert train_low.main(["--resume", "--out", str(broken)]) == 0
    assert "its checksum does not match" in "".join(capfd.readouterr())
    assert not damaged.exists()
    assert final(broken) == final(whole)
    assert policies.load(whole / "policy").meta["calibration"] == {"robots": 0}

    # Resuming a finished run changes nothing, and it says so.
    capfd.readouterr()
    assert train_low.main(["--resume", "--out", str(broken)]) == 0
    said = "has been trained for 160 steps already; only a larger --steps would train it further"
    assert f"{broken} {said}\n" in capfd.readouterr().out
    assert final(broken) == final(whole)


@pytest.mark.usefixtures("inline_workers")
def test_a_killed_and_resumed_high_level_ends_as_one_that_never_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A stopped, killed and resumed run of the high policy ends like an uninterrupted one.

    Each makes five updates of the recurrent learner, two of imitation and three of reinforcement
    learning, and keeps the LSTM states of the current episodes. The second run writes a checkpoint
    after each update, is stopped after the first and killed as soon as that of the third is there.
    """
    arguments = [
        "--seed", "3", "--n-envs", "2", "--workers", "1", "--steps", "40",
        "--set", "checkpoint_seconds=0", "--set", "log_steps=16", "--set", "ppo.n_steps=4",
        "--set", "ppo.minibatches=2", "--set", "imitation.minibatches=2", "--set", "ppo.n_epochs=2",
        "--set", "ppo.lstm=8",
        "--set", "ppo.actor=[8]", "--set", "ppo.critic=[8]", "--set", "env.episode_seconds=0.7",
        "--set", "imitation.steps=16", "--set", "imitation.levels_after=hardest",
        "--set", "imitation.kept=2", "--set", "ppo.desired_kl=1e-9",
        "--set", 'env.families=["rough","pillar"]',
    ]  # fmt: skip
    monkeypatch.chdir(ROOT)  # where ``kill_run`` starts the resumed run
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    manner, trials = TeacherConfig(walk_speed=0.5), []
    monkeypatch.setattr(train_high, "find_manner", lambda *_: trials.append(None) or manner)
    assert (
        train_high.main([*arguments, "--out", str(whole), "--set", "checkpoint_seconds=1e6"]) == 0
    )
    assert [row["steps"] for row in rows(whole)] == [16, 32, 40]
    # The policy at the end of imitation is kept beside the final one.
    imitated, learned = (policies.load(whole / name) for name in ("imitation", "policy"))
    assert (imitated.meta["steps"], learned.meta["steps"]) == (16, 40)
    assert imitated.meta["teacher"] == learned.meta["teacher"] == to_dict(manner)
    # Imitation draws levels at random. Afterwards all start at the hardest, and none has moved yet.
    assert [rows(whole)[1][f"level/{family}"] for family in ("rough", "pillar")] == [10.0, 10.0]
    # In imitation, halfway from 2e-3 to 2e-4. Then, on the way from 1.5e-4 to 5e-5, after 24 of 40
    # steps and at the end.
    rates = [row["train/learning_rate"] for row in rows(whole)]
    assert rates == pytest.approx([1.1e-3, 5e-5 + 0.4 * 1e-4, 5e-5])
    # The actor's is lowered by a third after each update of reinforcement learning.
    rates = [row["train/actor_learning_rate"] for row in rows(whole)]
    assert rates == pytest.approx([1.1e-3, 5e-5 + 0.4 * 1e-4, 5e-5 / 1.5**2], rel=1e-4)
    last = broken / "checkpoints/step-000000000024"
    with monkeypatch.context() as patch:
        at_calls(patch, lambda call, run: setattr(run, "reason", "a test" if call == 2 else None))
        assert train_high.main([*arguments, "--out", str(broken)]) == 0
    stopped = Checkpoint.read(newest(broken))
    assert stopped.steps == 8 and stopped.header["phase"] == "imitation"
    # It only continues with the low policy that it began with.
    config = (broken / "config.json").read_text(encoding="utf-8")
    other = tmp_path / "other"
    low = policies.load(PRETRAINED / "low")
    policies.save_copy(other, low, {**low.meta, "note": "trained on"})
    assert train_high.main(["--resume", "--out", str(broken), "--low", str(other)]) == 2
    error = capsys.readouterr().err
    assert f"train_high.py: {other} is not the low policy that this run began with" in error
    assert train_high.main(["--resume", "--out", str(broken), "--set", "start_speed=0.3"]) == 2
    assert "keeps the run's start_speed, 0.5: no other start_speed" in capsys.readouterr().err
    assert (broken / "config.json").read_text(encoding="utf-8") == config
    # A full disk at the end of imitation stops the run, which would not write that policy later.
    save = policies.save

    def no_room(path: Path, *rest: Any) -> None:
        if path.name == "imitation":
            raise OSError(errno.ENOSPC, "No space left on device")
        save(path, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(policies, "save", no_room)
        assert train_high.main(["--resume", "--out", str(broken)]) == 1
    assert "No space left on device" in capsys.readouterr().err
    assert Checkpoint.read(newest(broken)).steps < 16
    kill_run("train_high.py", ["--resume", "--out", str(broken)], last)
    assert (broken / "imitation.json").is_file()
    cut = Checkpoint.read(newest(broken))
    assert cut.steps < 40
    (state,) = cut.workers()
    assert state["lengths"].max() > 0  # updates come every 4 decisions, within episodes of 7
    assert cut.tensors["lstm.pi.h"].any()
    assert train_high.main(["--resume", "--out", str(broken)]) == 0
    assert final(broken) == final(whole)
    assert len(trials) == 2  # at the start of each run, not when it is resumed


def test_the_manner_of_the_teacher(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It is found by trials, set, or that of the policy that training begins from."""
    found, low = TeacherConfig(walk_speed=0.5), policies.load(PRETRAINED / "low")
    monkeypatch.setattr(train_high, "find_manner", lambda *_: found)
    config = HighTrainConfig()

    def manner(config: HighTrainConfig, init: Path | None = None) -> TeacherConfig | None:
        return train_high.with_manner(config, low, init).imitation.teacher

    alone = with_overrides(config, ["imitation.steps=0"])
    own = with_overrides(config, ["imitation.teacher.leap_speed=1.1"])
    assert (manner(config), manner(alone)) == (found, None)
    assert manner(own) == TeacherConfig(leap_speed=1.1)
    high = policies.load(PRETRAINED / "high")
    untold = {key: value for key, value in high.meta.items() if key != "teacher"}
    policies.save_copy(tmp_path / "old", high, untold)  # from before the trials
    assert manner(alone, tmp_path / "old") == TeacherConfig(**FIRST_TEACHER)
    taught = {**high.meta, "teacher": to_dict(TeacherConfig(leap_speed=1.0))}
    policies.save_copy(tmp_path / "high", high, taught)
    assert manner(alone, tmp_path / "high") == TeacherConfig(leap_speed=1.0)
    assert capsys.readouterr().out == ""
    # What the teacher cannot command is not recorded, and said.
    commands = dataclasses.replace(CommandRanges(), vx=(-1.0, 0.9), frequency=(2.5, 4.0))
    slow = dataclasses.replace(alone, env=dataclasses.replace(alone.env, commands=commands))
    assert manner(slow, tmp_path / "high") == TeacherConfig(0.6, 2.5, 0.9)
    assert capsys.readouterr().out.splitlines() == [
        "the command ranges limit the teacher: imitation.teacher.step_frequency=2.5, not 2.3",
        "the command ranges limit the teacher: imitation.teacher.leap_speed=0.9, not 1.0",
    ]


@pytest.mark.usefixtures("inline_workers")
def test_the_imitating_policy_is_kept_when_nothing_comes_after_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run of imitation alone may be continued with reinforcement learning."""
    monkeypatch.chdir(ROOT)
    arguments = [
        "--seed", "3", "--n-envs", "2", "--workers", "1", "--steps", "8", "--set", "ppo.n_steps=4",
        "--set", "ppo.minibatches=2", "--set", "imitation.minibatches=2", "--set", "ppo.n_epochs=1",
        "--set", "ppo.lstm=8", "--set", "ppo.actor=[8]", "--set", "ppo.critic=[8]",
        "--set", "imitation.teacher.walk_speed=0.6", "--set", 'env.families=["rough"]',
    ]  # fmt: skip
    assert train_high.main([*arguments, "--out", str(tmp_path)]) == 0
    imitated = (tmp_path / "imitation.safetensors").read_bytes()
    assert weights(tmp_path) == imitated


@pytest.mark.usefixtures("inline_workers")
def test_from_scratch_on_terrain_of_ones_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A feed-forward policy trains without a teacher on a height map that no family has.

    A run stopped while the noise of the gait is held resumes and ends like an uninterrupted one.
    """
    x, y = np.meshgrid(np.linspace(0.0, 8.0, 161), np.linspace(0.0, 8.0, 161), indexing="ij")
    bumps = tmp_path / "bumps.npy"
    np.save(bumps, 0.1 * np.sin(2.0 * np.pi * x / 1.6) * np.cos(2.0 * np.pi * y / 1.6))
    arguments = [
        "--no-teacher", "--seed", "3", "--n-envs", "4", "--workers", "1", "--steps", "96",
        "--set", f'env.families=["{bumps}"]', "--set", "ppo.lstm=null", "--set", "ppo.encoder=[]",
        "--set", "log_steps=32",
        "--set", "ppo.n_steps=8", "--set", "ppo.minibatches=2", "--set", "ppo.n_epochs=2",
        "--set", "env.episode_seconds=1.3",
    ]  # fmt: skip
    monkeypatch.chdir(ROOT)
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    assert train_high.main([*arguments, "--out", str(whole)]) == 0
    stored = from_dict(HighTrainConfig, json.loads((whole / "config.json").read_text()))
    assert (stored.imitation.steps, stored.ppo.gait_hold, stored.ppo.lstm) == (0, 10, None)
    assert stored.env.shallowest_trench == 0.05 and stored.env.rewards.map_radius == 6.5
    assert [row["steps"] for row in rows(whole)] == [32, 64, 96]
    assert all(row[f"level/{bumps}"] == 0.0 for row in rows(whole))
    shares = [sum(row[f"gait/{bumps}_{gait}"] for gait in GAITS) for row in rows(whole)]
    assert shares == pytest.approx([1.0] * 3, abs=1e-3)
    assert (whole / "training.png").is_file()
    made = policies.load(whole / "policy")
    assert made.kind == "mlp" and made.meta["config"]["families"] == [str(bumps)]
    with monkeypatch.context() as patch:
        at_calls(patch, lambda call, run: setattr(run, "reason", "a test" if call == 2 else None))
        assert train_high.main([*arguments, "--out", str(broken)]) == 0
    noise, age = Checkpoint.read(newest(broken)).tensors["policy.held"]
    assert noise.all() and (age > 0.0).all() and (age < 10.0).all()
    assert train_high.main(["--resume", "--out", str(broken)]) == 0
    assert final(broken) == final(whole)


@pytest.mark.usefixtures("inline_workers")
def test_robots_that_fall_too_often_to_be_calibrated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The run says how to end it, and ends that way."""

    def fall(low: policies.Policy, robots: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros((1, 15)), np.zeros((1, 3))  # of the last one standing

    monkeypatch.setattr(calibration, "measure", fall)
    monkeypatch.setattr(calibration, "run_jobs", in_this_process)
    out = ["--out", str(tmp_path)]
    assert train_low.main([*TINY, "--steps", "32", "--set", "calibration.robots=64", *out]) == 2
    said = "only 1 of 64 robots walked without a fall, which is too few to calibrate"
    hint = "--resume with --set calibration.robots=0 leaves the policy as it is"
    assert capsys.readouterr().err.endswith(f"train_low.py: {said}; {hint}\n")
    assert train_low.main(["--resume", "--set", "calibration.robots=0", *out]) == 0
    assert policies.load(tmp_path / "policy").meta["calibration"] == {"robots": 0}
    # From now on this is how the run ends.
    before = weights(tmp_path)
    assert train_low.main(["--resume", *out]) == 0 and weights(tmp_path) == before
    kept = json.loads((tmp_path / "config.json").read_text(encoding="utf-8"))
    assert kept["calibration"] == {"robots": 0}


@pytest.mark.usefixtures("inline_workers")
def test_calibration_ends_a_run_of_the_low_policy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """The calibrated copy replaces the policy; an interrupted run ends the same once resumed.

    A run that still calibrates, like one that still learns, cannot be resumed by someone else.
    """
    monkeypatch.setattr(calibration, "_EPOCHS", 2)
    monkeypatch.setattr(calibration, "_CORRECTIONS", 4)
    monkeypatch.setattr(calibration, "_WALK_SECONDS", 0.3)
    monkeypatch.setattr(calibration, "_SETTLE_SECONDS", 0.1)
    monkeypatch.setattr(calibration, "run_jobs", in_this_process)
    arguments = [*TINY, "--steps", "32", "--set", "calibration.robots=64"]
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    assert train_low.main([*arguments, "--out", str(whole)]) == 0
    learned, given = policies.load(whole / "uncalibrated"), policies.load(whole / "policy")
    assert given.meta["calibration"]["robots"] == 64 and "calibration" not in learned.meta
    assert given.meta["benchmark"] == learned.meta["benchmark"] == 2
    assert weights(whole) != (whole / "uncalibrated.safetensors").read_bytes()

    second: list[int] = []

    def stop(call: int, interruption: Interruption) -> None:
        if call == 3:
            second.append(train_low.main(["--resume", "--out", str(broken)]))
            interruption.reason = "the test"

    with monkeypatch.context() as patch:
        at_calls(patch, stop)
        assert train_low.main([*arguments, "--out", str(broken)]) == 0
    said = "".join(capfd.readouterr())
    assert second == [2] and f"'{broken}' is in use by another process\n" in said
    assert "stopped by the test" in said
    assert weights(broken) == (whole / "uncalibrated.safetensors").read_bytes()
    assert train_low.main(["--resume", "--out", str(broken)]) == 0
    assert weights(broken) == weights(whole)
    # Killed when of the calibrated copy only the weights were written.
    shutil.copy(whole / "uncalibrated.json", broken / "policy.json")
    assert train_low.main(["--resume", "--out", str(broken)]) == 0
    assert weights(broken) == weights(whole)

    # A run that was to end without it can be calibrated later.
    later = tmp_path / "later"
    assert train_low.main([*TINY, "--steps", "32", "--out", str(later)]) == 0
    assert policies.load(later / "policy").meta["calibration"] == {"robots": 0}
    resumed = ["--resume", "--set", "calibration.robots=64"]
    assert train_low.main([*resumed, "--out", str(later)]) == 0
    assert weights(later) == weights(whole)
    assert "calibration" not in policies.load(later / "uncalibrated").meta
    assert train_low.main(["--resume", "--out", str(later)]) == 0  # as it is
    assert weights(later) == weights(whole)
    again = ["--resume", "--set", "calibration.robots=65", "--out", str(later)]
    assert train_low.main(again) == 2
    said = "policy is already calibrated, with 'calibration.robots' 64, not 65; python -m"
    assert said in "".join(capfd.readouterr())
    without = ["--resume", "--set", "calibration.robots=0", "--out", str(later)]
    assert train_low.main(without) == 2
    said = f"is already calibrated; the policy from before is {later / 'uncalibrated'}\n"
    assert said in "".join(capfd.readouterr())


@pytest.mark.usefixtures("inline_workers")
def test_a_policy_that_diverges_ends_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The checkpoint from before the update stays, and the run resumes from it."""
    update = PPO.train

    def diverge(model: PPO) -> None:
        update(model)
        if model.num_timesteps == 96:
            next(model.policy.parameters()).data[0] = np.nan

    with monkeypatch.context() as patch:
        patch.setattr(PPO, "train", diverge)
        assert train_low.main([*TINY, "--out", str(tmp_path)]) == 1
    said = "the policy diverged at 96 steps; --resume continues from the last checkpoint"
    assert f"train_low.py: {said}" in capsys.readouterr().err
    assert Checkpoint.read(newest(tmp_path)).steps == 64
    assert train_low.main(["--resume", "--out", str(tmp_path)]) == 0
    assert policies.load(tmp_path / "policy").meta["steps"] == 160


def test_faults_of_a_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A run survives a full disk, a killed worker and a stop, but not workers that keep dying."""
    arguments = [
        *TINY, "--n-envs", "2", "--workers", "1", "--steps", "160", "--out", str(tmp_path),
        "--set", "checkpoint_seconds=0", "--set", "log_steps=16",
    ]  # fmt: skip
    full, others = contextlib.ExitStack(), set(multiprocessing.active_children())

    def kill_worker() -> None:
        (worker,) = set(multiprocessing.active_children()) - others
        worker.kill()

    def upset(call: int, interruption: Interruption) -> None:
        if call == 2:
            full.enter_context(no_file_larger_than(100))
        elif call == 3:
            full.close()
            kill_worker()
        elif call == 5:
            interruption.reason = "the test"

    with monkeypatch.context() as patch, full:
        at_calls(patch, upset)
        assert train_low.main(arguments) == 0
    output = capsys.readouterr().out
    assert "no checkpoint at 16 steps, the one before stays: [Errno 27] File too large" in output
    assert "no complete log row at 32 steps: [Errno 27] File too large" in output
    seed = worker_seed(3, 0, 1)
    assert f"worker 0 died (exit code -9); restarted with seed {seed} (restart 1)" in output
    assert f"stopped by the test; continue with --resume --out {tmp_path}" in output
    names = sorted(path.name for path in (tmp_path / "checkpoints").iterdir())
    assert names == ["step-000000000048", "step-000000000064"]
    assert [row["steps"] for row in rows(tmp_path)] == [16, 48, 64]
    (fault,) = rows(tmp_path)[1].pop("faults")
    assert (fault["steps"], fault["seed"], fault["restarts"]) == (34, seed, 1)
    assert [row["faults/restarts"] for row in rows(tmp_path)] == [0.0, 1.0, 0.0]
    assert len(list((tmp_path / "tensorboard").iterdir())) == 2

    with monkeypatch.context() as patch:
        at_calls(patch, lambda call, interruption: kill_worker())
        assert train_low.main(["--resume", "--out", str(tmp_path)]) == 1
    assert capsys.readouterr().err.splitlines()[-1] == (
        "train_low.py: 3 faults of workers within 1000 steps; the last one: worker 0 died "
        "(exit code -9)"
    )
    last = Checkpoint.read(newest(tmp_path))
    assert last.steps == 96 and last.header["workers"][0]["restarts"] == 3
    assert all(tensor.isfinite().all() for tensor in last.tensors.values())
    logged = [
        (row["steps"], fault["restarts"]) for row in rows(tmp_path) for fault in row["faults"]
    ]
    assert logged == [(48, 1), (80, 2), (96, 3)]  # the last one, of a rollout that was lost, too
    assert set(multiprocessing.active_children()) <= others


def test_flags_and_folders_that_cannot_be_used(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    used, empty = tmp_path / "used", tmp_path / "empty"
    used.mkdir()
    (used / "config.json").write_text(json.dumps(to_dict(LowTrainConfig())), encoding="utf-8")
    (used / "log.jsonl").write_text("", encoding="utf-8")
    damaged = tmp_path / "damaged"
    shutil.copytree(used, damaged)
    (damaged / "config.json").write_text('{"seed": ', encoding="utf-8")
    cases = {
        f"'{used}' holds a run already; use --resume or another --out": ["--out", str(used)],
        f"--resume: no run in '{empty}' (config.json is missing)": [
            "--resume",
            "--out",
            str(empty),
        ],
        f"{used}: no checkpoint": ["--resume", "--out", str(used)],
        "unknown configuration key 'env.robot.kq'": ["--set", "env.robot.kq=1"],
        "cannot read --set 'seed'": ["--set", "seed"],
        "not a JSON file": ["--resume", "--out", str(damaged)],
        "'randomisation.latency' times its scale must be from 0 to 0.04, not [0, 0.05]": [
            "--set",
            "env.randomisation.latency=[0,0.05]",
        ],
        "unknown terrain family 'sand'; choose from flat, rough, ": [
            "--set",
            'env.families=["sand"]',
        ],
        "'env.terrain' has no effect: robots train on both": ["--set", "env.terrain=tiles"],
        "'ppo.batch_size' must be at least 2, not 1": ["--set", "ppo.batch_size=1"],
        "'ppo.n_steps' times 'n_envs' must be at least 2, not 1": [
            "--n-envs",
            "1",
            "--workers",
            "1",
            "--set",
            "ppo.n_steps=1",
        ],
        "'env.episode_seconds' must last a step of 0.02 s, not 0.005": [
            "--set",
            "env.episode_seconds=0.005",
        ],
        "'env.command_seconds' must be 0 or last a step of 0.02 s, not 0.005": [
            "--set",
            "env.command_seconds=0.005",
        ],
        "'plane_share' must be from 0 to below 1, not 1": ["--set", "plane_share=1"],
        "'env.randomisation.probe_delay' has no effect": [
            "--set",
            "env.randomisation.probe_delay=0",
        ],
        "below which a robot has fallen, not 0.14": ["--set", "env.robot.base_height=0.17"],
        "'calibration.robots' must be 0 or at least 64": ["--set", "calibration.robots=63"],
        "--worker-timeout must be above 0 and at most 86400, not inf": ["--worker-timeout", "inf"],
        "--time-limit must be at least 0 s, not nan": ["--time-limit", "nan"],
        "terrain 'no.npy' cannot be read as a NumPy": ["--set", 'env.families=["flat","no.npy"]'],
    }
    for message, arguments in cases.items():
        where = [] if "--out" in arguments else ["--out", str(empty)]
        assert train_low.main([*arguments, *where]) == 2
        error = capsys.readouterr().err
        assert error.startswith("train_low.py: ") and message in error
        assert error.count("\n") == 1
    assert train_high.main(["--resume", "--out", str(used)]) == 2
    said = f"train_high.py: --resume: '{used}' holds a run of train_low.py\n"
    assert capsys.readouterr().err == said
    for setting, message in (
        ('env.families=["sand"]', "unknown terrain family 'sand'; choose from flat, rough, "),
        ("env.first_level=3", "'env.first_level' and 'env.first_levels' have no effect with imi"),
        ("env.window=8", "threshold must be above (window + 1) / 2 and at most window, not 3 with"),
        (
            "env.first_levels=20",
            "'env.first_level' and 'env.first_levels' must add up to at most 11 levels, not 20",
        ),
        ("env.levels=0", "'env.levels' must be at least 1, not 0"),
        ("env.levels=13", "'env.levels' must be from 1 to 11, not 13"),
        ("env.decimation=0", "'env.decimation' must be at least 1, not 0"),
        ("env.decimation=2001", "'env.episode_seconds' must last a step of 40.02 s, not 20"),
        ("env.families=[]", "'env.families' must name at least one terrain family"),
        ("env.randomisation.payload=[-20,0]", "'randomisation.payload' times its scale must be "),
        (
            "env.commands.vy=[-0.2,0.6]",
            "commands.vy must be the same to both sides for a symmetric",
        ),
        (
            "env.commands.duration=[40,60]",
            "'env.commands.duration' must be [low, high] with 0 < low <= high < 1, not [40,",
        ),
        ("start_speed=3", "'start_speed' or 'start_swing' is out of bounds: vx 3.0 is outside "),
        ("ppo.minibatches=0", "'ppo.minibatches' must be at least 1, not 0"),
        ("ppo.minibatches=101", "'ppo.minibatches' must be at most the 100 robots, not 101"),
        ("imitation.minibatches=101", "'imitation.minibatches' must be at most the 100 robots"),
        (
            "ppo.minibatches=97",
            "'ppo.minibatches' cannot be 97 with 100 robots of 24 steps; 100 can",
        ),
        ("ppo.initial_std=0", "'ppo.initial_std' must be above 0, not 0"),
        ("seed=-1", "'seed' must be from 0 to 2**32 - 1, not -1"),
        ("seed=4294967296", "'seed' must be from 0 to 2**32 - 1, not 4294967296"),
        ("steps=0", "'steps' must be at least 1, not 0"),
        ("ppo.ent_coef=0", "'ppo.imitation_coef' needs 'ppo.ent_coef' above 0; or set it to 0"),
        ("env.unknown_share=1.5", "'env.unknown_share' must be from 0 to 1, not 1.5"),
        ("env.unknown_share=-0.1", "'env.unknown_share' must be from 0 to 1, not -0.1"),
        ("env.randomisation.scale=1.5", "'randomisation.latency' times its scale must be "),
        ("env.gaits=[]", "gaits must be some of trot, pronk, pace, bound, each once, not []"),
        ("ppo.gait_hold=0", "'ppo.gait_hold' must be at least 1, not 0"),
        ("ppo.gait_ent_coef=-1", "'ppo.gait_ent_coef' must be at least 0, not -1"),
        ("ppo.imitation_coef=-1", "'ppo.imitation_coef' must be at least 0, not -1"),
        ("ppo.encoder=[0]", "'ppo.encoder' must be at least 1, not 0"),
    ):
        assert train_high.main(["--set", setting, "--out", str(empty)]) == 2
        assert capsys.readouterr().err.startswith(f"train_high.py: {message}")
    drawn = ["--no-teacher", "--set", "env.curriculum=uniform", "--set", "env.first_level=3"]
    assert train_high.main([*drawn, "--out", str(empty)]) == 2
    assert "have no effect with env.curriculum uniform" in capsys.readouterr().err
    told = ["--no-teacher", "--set", "imitation.teacher.walk_speed=0.9"]
    assert train_high.main([*told, "--out", str(empty)]) == 2
    assert "'imitation.teacher' has no effect without imitation" in capsys.readouterr().err
    alone = ["--set", "ppo.lstm=null"]
    assert train_high.main([*alone, "--out", str(empty)]) == 2
    assert "'ppo.encoder' must be [] if 'ppo.lstm' is null" in capsys.readouterr().err
    short = ["--set", "ppo.n_steps=1", "--set", "ppo.minibatches=100"]
    assert train_high.main([*short, "--out", str(empty)]) == 2
    message = "'ppo.n_steps' times 'n_envs' per 'ppo.minibatches' must be at least 2, not 1"
    assert message in capsys.readouterr().err
    for low in ("", "null", "7"):  # paths, whatever they look like
        assert train_high.main(["--low", low, "--out", str(empty)]) == 2
        assert f"{low}.json: no such file" in capsys.readouterr().err
    for train in (train_low, train_high):
        assert train.main(["--init", "x", "--out", str(empty)]) == 2
        assert capsys.readouterr().err.endswith("x.json: no such file\n")
    assert not empty.exists()
    for train in (train_low, train_high):  # before the teacher is tried out
        assert train.main(["--out", str(used / "log.jsonl")]) == 2
        message = f"{train.__name__}.py: '{used / 'log.jsonl'}' cannot be used: File exists\n"
        assert capsys.readouterr().err.endswith(message)


def test_a_run_killed_before_its_first_checkpoint_leaves_its_folder_free(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """There is only its configuration, with which nothing can be resumed."""
    (tmp_path / "config.json").write_text(json.dumps(to_dict(LowTrainConfig())), encoding="utf-8")
    flags = ["--out", str(tmp_path), "--set", "ppo.batch_size=1"]
    assert train_low.main(flags) == 2
    assert "'ppo.batch_size' must be at least 2" in capsys.readouterr().err
    (tmp_path / "policy.json").touch()
    assert train_low.main(flags) == 2
    assert "holds a run already" in capsys.readouterr().err
    (tmp_path / "config.json").unlink()  # somebody put a policy there
    assert train_low.main(flags) == 2
    assert "holds a run already" in capsys.readouterr().err


def test_a_run_that_cannot_begin_leaves_its_folder_free(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = ["--out", str(tmp_path / "run")]
    assert train_low.main([*out, "--n-envs", "1", "--workers", "2"]) == 2
    assert "workers must be 1 to the 1 robots, not 2" in capsys.readouterr().err
    assert not (tmp_path / "run" / "config.json").exists()


#: A run of train_high.py that stops at its beginning; one without imitation.
STOPPED = [
    "--n-envs", "4", "--workers", "1", "--set", "ppo.lstm=8", "--set", "ppo.minibatches=4",
    "--time-limit", "0",
]  # fmt: skip
UNTRAINED = [*STOPPED, "--set", "imitation.steps=0"]


@pytest.mark.usefixtures("inline_workers")
def test_flags_come_after_a_preset(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = ["--out", str(tmp_path)]
    preset = ["--preset", "paper", "--seed", "7", "--n-envs", "4", "--workers", "1"]
    small = ["--steps", "96", "--set", "ppo.lstm=8", "--time-limit", "0"]
    assert train_high.main([*preset, *small, *out]) == 0
    config = json.loads((tmp_path / "config.json").read_text(encoding="utf-8"))
    assert (config["seed"], config["n_envs"], config["steps"]) == (7, 4, 96)
    assert (config["env"]["decimation"], config["ppo"]["lstm"]) == (1, 8)
    for flags in (["--preset", "paper"], ["--no-teacher"], ["--init", "x"]):
        assert train_high.main(["--resume", *flags, *out]) == 2
        assert "train_high.py: --resume keeps " in capsys.readouterr().err
    with pytest.raises(SystemExit, match="2"):
        train_high.main(["--no-teacher", "--preset", "paper", *out])


def test_the_apprentice_sees_all_levels_and_is_led_for_three_quarters(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made: dict[str, Any] = {}

    def make_env(config: HighTrainConfig, low: Any, taught: bool, led: float, _: Machine) -> None:
        made.update(env=config.env, taught=taught, led=led)

    monkeypatch.setattr(train_high, "make_env", make_env)
    monkeypatch.setattr(train_high, "make_learner", lambda *_, **keywords: made.update(keywords))
    changes = (
        "n_envs=10", "steps=800", "imitation.steps=1000", "imitation.kept=7",
        "imitation.n_epochs=9", "ppo.n_steps=8", "ppo.minibatches=2", "imitation.minibatches=4",
        "env.first_level=3",
    )  # fmt: skip
    config = with_overrides(HighTrainConfig(), changes)
    low = policies.load(PRETRAINED / "low")
    train_high.build_imitation(config, low, Machine("cpu", 1.0, ProcessLink))
    assert made["taught"] and made["led"] == 60.0  # 0.75 * 800 decisions of 10 robots
    assert (made["env"].first_level, made["env"].first_levels) == (0, config.env.levels)
    assert made["env"].curriculum == config.imitation.curriculum != config.env.curriculum
    assert (made["kept"], made["n_epochs"], made["batch_size"]) == (7, 9, 20)


@pytest.mark.usefixtures("inline_workers")
def test_a_start_from_a_policy_of_other_settings_names_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, slower = tmp_path / "first", tmp_path / "slower"
    assert train_high.main([*UNTRAINED, "--out", str(first)]) == 0
    begin = ["--init", str(first / "policy"), "--set", "env.commands.vx=[-1,0.8]"]
    assert train_high.main([*STOPPED, *begin, "--seed", "7", "--out", str(slower)]) == 0
    assert weights(slower) == weights(first)
    stored = json.loads((slower / "config.json").read_text(encoding="utf-8"))
    assert stored["imitation"]["steps"] == 0  # it would overwrite what the policy has learned
    fresh = tmp_path / "fresh"
    assert train_high.main([*UNTRAINED, "--seed", "7", "--out", str(fresh)]) == 0
    assert weights(fresh) != weights(first)
    said = capsys.readouterr().out.splitlines()
    few = "too few robots for all families: none is on tilt, clutter, ditches"
    assert said.count(few) == 3
    told = [line for line in said if "was trained with" in line]
    vx = "env.commands.vx=[-1.0, 1.2], not [-1.0, 0.8]"
    assert told == [f"{first / 'policy'} was trained with {vx}"]


@pytest.mark.usefixtures("inline_workers")
def test_a_low_policy_can_start_from_another(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What the schedule has to leave out is said."""
    first, second = tmp_path / "first", tmp_path / "second"
    untrained = [*TINY, "--time-limit", "0"]
    assert train_low.main([*untrained, "--out", str(first)]) == 0
    assert not re.search("too few|limit leaps", capsys.readouterr().out)
    untrained += [
        "--set",
        'env.families=["stair","gap","tilt"]',
        "--set",
        "env.commands.vx=[-1,0.9]",
    ]
    begin = ["--init", str(first / "policy"), "--seed", "7"]
    assert train_low.main([*untrained, *begin, "--out", str(second)]) == 0
    assert weights(second) == weights(first)
    said = capsys.readouterr().out.splitlines()
    assert "too few robots for all families: none is on tilt" in said
    leaps = "the command ranges limit leaps over trenches to 0.9 m/s"
    assert f"{leaps}, not env.crossing.leap_speed=[1.0, 1.2]" in said


@pytest.mark.usefixtures("inline_workers")
def test_a_start_from_a_policy_for_another_robot_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also if the policy's file does not say what it was trained with."""
    assert train_high.main([*UNTRAINED, "--out", str(tmp_path / "first")]) == 0
    first, said = policies.load(tmp_path / "first/policy"), []
    stiff = copy.deepcopy(first.meta)
    stiff["low"]["config"]["robot"]["kp"] = 25.0
    for name, meta in (("stiff", stiff), ("untold", {**first.meta, "config": {"decimation": 0}})):
        policies.save_copy(tmp_path / name, first, meta)
        begin = ["--init", str(tmp_path / name), "--out", str(tmp_path / f"from-{name}")]
        assert train_high.main([*UNTRAINED, *begin]) == 0
        lines = capsys.readouterr().out.splitlines()
        said += [line for line in lines if "settings" in line or "was trained with" in line]
    assert said[0] == f"{tmp_path / 'stiff'} was trained with low.robot.kp=25.0, not 20.0"
    assert len(said) == 2 and said[1].startswith("cannot compare the settings: ")


@pytest.mark.parametrize(
    ("config", "name"),
    [
        *((LowTrainConfig(), name) for name in (
            "seed", "ppo.initial_std", "env.command_start", "env.first_levels",
            "env.families", "env.crossing.shallowest_trench",
        )),
        *((HighTrainConfig(), name) for name in (
            "seed", "start_speed", "start_swing", "ppo.initial_std", "ppo.initial_gait_std",
            "env.first_level", "env.first_levels", "env.families", "env.shallowest_trench",
        )),
    ],
)  # fmt: skip
def test_a_resumed_run_keeps_what_acts_at_its_beginning(config: Any, name: str) -> None:
    before = to_dict(config)
    _keep_start(before, before)
    *path, last = name.split(".")
    now = copy.deepcopy(before)
    table = functools.reduce(dict.__getitem__, path, now)
    assert last in table
    table[last] = "another"
    with pytest.raises(ConfigError, match=f"^--resume keeps the run's {re.escape(name)}, "):
        _keep_start(before, now)


def test_a_device_that_is_not_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert train_low.main(["--device", "toaster", "--out", str(tmp_path)]) == 2
    assert capsys.readouterr().err.startswith("train_low.py: --device toaster: Expected one of ")
    if not th.cuda.is_available():
        assert train_low.main(["--device", "cuda", "--out", str(tmp_path)]) == 2
        error = capsys.readouterr().err
        assert error == "train_low.py: --device cuda: PyTorch finds no GPU here\n"


def test_workers_auto(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """``auto`` is one worker per core, with at least 10 robots each.

    A resumed run keeps its number of workers, and ``--set`` has its way, as with other flags.
    """
    parser = argparse.ArgumentParser()
    add_arguments(parser, str(tmp_path), LowTrainConfig(), "control steps")

    def workers(*flags: str) -> int:
        return configure(LowTrainConfig(), parser.parse_args(flags)).workers

    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(3)))
    monkeypatch.setattr("tdgc.learn.flags.usable_cores", lambda: usable_cores(tmp_path))
    assert workers() == workers("--set", "workers=2") == 2
    assert workers("--workers", "auto") == 3
    assert workers("--workers", "auto", "--n-envs", "25") == 2
    assert workers("--workers", "auto", "--set", "workers=1") == 1
    begun = json.dumps(to_dict(LowTrainConfig(workers=7)))
    (tmp_path / "config.json").write_text(begun, encoding="utf-8")
    assert workers("--resume", "--workers", "auto") == workers("--resume") == 7
    for name, given, kept in (("workers", "5", 7), ("n-envs", "60", 120)):
        setting = name.replace("-", "_")
        with pytest.raises(ConfigError, match=f"^--resume keeps the run's {setting}, {kept}: no "):
            workers("--resume", f"--{name}", given)


@pytest.mark.parametrize(
    ("before", "flag", "message"),
    [
        ((), "ppo.desired_kl=0.01", "ppo.desired_kl from None to 0.01"),
        ((), "ppo.gait_hold=5", "ppo.gait_hold from 1 to 5"),
        (("ppo.desired_kl=0.01",), "ppo.desired_kl=null", "ppo.desired_kl from 0.01 to None"),
        (("ppo.gait_hold=5",), "ppo.gait_hold=1", "ppo.gait_hold from 5 to 1"),
        (("ppo.gait_hold=5", "ppo.desired_kl=0.01"), "ppo.gait_hold=9", None),
        (("ppo.gait_hold=5", "ppo.desired_kl=0.01"), "ppo.desired_kl=0.02", None),
    ],
)
def test_a_resumed_run_cannot_switch_what_is_kept_with_its_policy(
    before: tuple[str, ...], flag: str, message: str | None, tmp_path: Path
) -> None:
    begun = to_dict(with_overrides(HighTrainConfig(), before))
    (tmp_path / "config.json").write_text(json.dumps(begun), encoding="utf-8")
    parser = argparse.ArgumentParser()
    add_arguments(parser, str(tmp_path), HighTrainConfig(), "decisions")
    args = parser.parse_args(["--resume", "--set", flag])
    if message is None:
        changed = with_overrides(HighTrainConfig(), (*before, flag))
        assert configure(HighTrainConfig(), args) == changed
    else:
        with pytest.raises(ConfigError, match=f"^--resume cannot change {re.escape(message)}$"):
            configure(HighTrainConfig(), args)


def test_the_low_policy_is_what_the_first_command_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """``find_low`` takes the low policy of runs/low once it is final, else the shipped one."""
    shipped = str(PRETRAINED / "low")
    low = policies.load(shipped)
    monkeypatch.chdir(tmp_path)
    assert train_high.find_low() == shipped
    left = {key: value for key, value in low.meta.items() if key != "calibration"}
    policies.save_copy(tmp_path / "runs" / "low" / "policy", low, left)
    assert train_high.find_low() == shipped
    assert "runs/low/policy comes from an unfinished run" in "".join(capsys.readouterr())
    policies.save_copy(
        tmp_path / "runs" / "low" / "policy", low, {**left, "calibration": {"robots": 64}}
    )
    assert train_high.find_low() == "runs/low/policy"


@pytest.mark.usefixtures("inline_workers")
def test_one_range_may_be_narrowed_and_the_others_stay_the_low_policys(tmp_path: Path) -> None:
    low, config = load_low(PRETRAINED / "low")
    wide = dataclasses.replace(CommandRanges(), vy=(-0.4, 0.4), pitch=(-0.2, 0.1))
    config = dataclasses.replace(config, commands=wide)
    policies.save_copy(tmp_path / "low", low, {**low.meta, "config": to_dict(config)})
    small = ["--steps", "96", "--n-envs", "4", "--workers", "1", "--time-limit", "0"]
    flags = ["--no-teacher", "--low", str(tmp_path / "low"), "--set", "env.commands.vx=[-0.5,0.5]"]
    assert train_high.main([*small, *flags, "--out", str(tmp_path / "run")]) == 0
    stored = json.loads((tmp_path / "run" / "config.json").read_text(encoding="utf-8"))
    used = from_dict(CommandRanges, stored["env"]["commands"])
    assert used == dataclasses.replace(wide, vx=(-0.5, 0.5))


@pytest.mark.usefixtures("inline_workers")
def test_a_curve_that_cannot_be_drawn_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It comes after the training, whose policy is kept."""
    (tmp_path / "training.png").mkdir()
    small = ["--steps", "96", "--n-envs", "4", "--workers", "1", "--set", "ppo.n_steps=24"]
    flags = ["--no-teacher", "--set", "ppo.minibatches=1", "--out", str(tmp_path)]
    assert train_high.main([*small, *flags]) == 1
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith("train_high.py: ") and last.endswith(f"'{tmp_path / 'training.png'}'")
    assert policies.load(tmp_path / "policy").kind == "lstm"


def test_a_run_with_another_robot_takes_what_fits_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Settings that are not assigned are fitted to another robot, but not to the shipped one."""
    urdf = tmp_path / "heavy.urdf"
    shipped = (ROOT / "urdf" / "quadruped.urdf").read_text(encoding="utf-8")
    urdf.write_text(shipped.replace('<mass value="5.6"/>', '<mass value="11.9"/>'))
    assigned = [f"env.robot.urdf={urdf}", "env.robot.kd=0.7"]
    config = train_low.fit(with_overrides(LowTrainConfig(), assigned), assigned)
    robot = config.env.robot
    assert (robot.kp, robot.kd, robot.base_height) == (30.0, 0.7, 0.3)  # kp: 20 * 18.9 kg / 12.6 kg
    assert robot.torque_limit == (23.7, 23.7, 35.5)
    assert "env.robot.kp=30.0" in "".join(capsys.readouterr())
    assert train_low.fit(LowTrainConfig(), ["env.robot.kp=25"]) == LowTrainConfig()
    # A table may assign several.
    assigned = [f'env={{"robot": {{"urdf": "{urdf}", "kp": 28}}, "gyro": true}}']
    robot = train_low.fit(with_overrides(LowTrainConfig(), assigned), assigned).env.robot
    assert (robot.kp, robot.kd) == (28.0, 0.9)


def test_robots_of_a_run() -> None:
    """The MDPs on the plane and on tiles differ only in terrain and physics step.

    On the plane, a physics step is as long as a torque is held: 4 per control step.
    """
    config = with_overrides(LowTrainConfig(), ["steps=80"])
    (phase,) = train_low.phases(config, Machine("cpu", 1.0, ProcessLink))
    assert phase.until == 80
    _, (on_plane, on_tiles), machine = phase.build.args  # type: ignore[attr-defined]
    assert (on_plane.terrain, on_plane.physics.substeps, machine.device) == ("plane", 4, "cpu")
    assert on_plane.physics.hold == 1 and on_plane.physics.joint_steps == 4
    assert (on_tiles.terrain, on_tiles.physics) == ("tiles", config.env.physics)
    assert on_tiles.physics.joint_steps == 4
    assert dataclasses.replace(on_plane, terrain="tiles", physics=on_tiles.physics) == on_tiles
    assert PPOConfig().mirror


# ------------------------------------------------------------------ how the learners are built


def test_the_learning_rate_is_scaled_by_the_noise() -> None:
    rate = NoiseScaledRate(first=2e-3, last=1e-3, initial_std=0.5)
    assert rate(1.0) == pytest.approx(1e-3)
    rate.log_std = th.log(th.tensor([0.1, 0.3]))
    assert rate(0.0) == pytest.approx(2e-4)


def test_a_high_policy_starts_by_walking_with_noise_on_its_gaits() -> None:
    config = HighTrainConfig()
    policy = SimpleNamespace(action_net=th.nn.Linear(4, 13), log_std=th.zeros(13))
    train_high.start_walking(policy, config)  # type: ignore[arg-type]
    start = train_high.start_action(config)
    np.testing.assert_allclose(policy.action_net.bias.detach(), start, rtol=1e-6)
    assert policy.log_std[-1].item() == pytest.approx(math.log(config.ppo.initial_gait_std))
    assert (policy.log_std[:-1] == 0.0).all()


def test_the_learner_is_given_the_imitation_loss_and_the_exchange(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made: dict[str, Any] = {}

    def learner(policy: type, env: None, **keywords: Any) -> SimpleNamespace:
        made.update(keywords, policy=policy)
        return SimpleNamespace(policy=SimpleNamespace())

    monkeypatch.setattr(train_high, "FastRecurrentPPO", learner)
    monkeypatch.setattr(train_high, "make_env", lambda *_: None)
    monkeypatch.setattr(train_high, "start_walking", lambda *_: None)
    config = HighTrainConfig()
    ppo = dataclasses.replace(config.ppo, imitation_coef=0.2, memory_exchange=0.3)
    config = dataclasses.replace(config, ppo=ppo)
    low = policies.load(PRETRAINED / "low")
    machine = Machine("cpu", 1.0, ProcessLink)
    model, _ = train_high.build_reinforcement(config, low, machine)
    assert made["policy"] is TaughtPolicy
    untold = untold_column(config.env)
    assert untold is not None
    assert made["exchange"].func is exchange_memories
    assert made["exchange"].keywords == {"share": 0.3, "untold": untold}
    assert model.policy.imitation_weight == pytest.approx(0.2 / config.ppo.ent_coef)


def test_the_noise_of_a_symmetric_policy_is_symmetric(tmp_path: Path) -> None:
    """In training and from the file, whatever the parameters of the noise are."""
    config = LowTrainConfig().env
    mirror, size = low_mirror(config), width(actor_layout(config.robot, config.gyro))
    policy = AsymmetricActorCriticPolicy(
        *low_spaces(config), lambda _: 1e-3, actor_dim=size, mirror=mirror, net_arch=[8]
    )
    with th.no_grad():
        policy.log_std.copy_(th.linspace(-4.0, 0.0, 12))
    other = list(mirror.action_index)
    std = policy.symmetric_log_std().detach().numpy()
    assert np.ptp(std) > 0.5
    np.testing.assert_allclose(std, std[other])
    policies.save(tmp_path / "policy", policy, {})
    loaded = policies.load(tmp_path / "policy")
    loaded.seed(0)
    drawn, _ = loaded.predict(np.zeros((20000, size), dtype=np.float32), deterministic=False)
    spread = drawn.std(axis=0)
    np.testing.assert_allclose(spread, spread[other], rtol=0.05)
