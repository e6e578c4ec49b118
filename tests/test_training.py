"""Checkpoints, interruption, and a resumed run that ends as if it had never stopped."""

import dataclasses
import json
import os
import random
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3 import PPO

import train_low
from tdgc import policies
from tdgc.config import LowTrainConfig, PPOConfig, from_dict, with_overrides
from tdgc.low_env import LowLevelTask
from tdgc.policies import AsymmetricActorCriticPolicy, Mirror
from tdgc.training import (
    CheckpointError,
    Interruption,
    load_learner,
    newest_checkpoint,
    read_checkpoint,
    save_checkpoint,
)


@pytest.fixture(autouse=True)
def signals() -> Iterator[None]:
    """Runs take over SIGINT and SIGTERM; give them back."""
    before = [(number, signal.getsignal(number)) for number in (signal.SIGINT, signal.SIGTERM)]
    yield
    for number, handler in before:
        signal.signal(number, handler)


# ------------------------------------------------------------------ checkpoints


def learner(seed: int, hidden: int = 8, steps: int = 32) -> PPO:
    model = PPO(
        "MlpPolicy", "Pendulum-v1", n_steps=16, batch_size=8, n_epochs=2, seed=seed, device="cpu",
        policy_kwargs={"net_arch": [hidden]},
    )  # fmt: skip
    model.learn(steps)
    return model


def parameters(model: PPO) -> dict[str, th.Tensor]:
    """Parameters and the optimiser's moments, as copies."""
    tensors = {k: v.clone() for k, v in model.policy.state_dict().items()}
    for index, slots in model.policy.optimizer.state_dict()["state"].items():
        tensors |= {f"{index}.{k}": th.as_tensor(v).clone() for k, v in slots.items()}
    return tensors


def draw() -> tuple[float, float, float]:
    return random.random(), float(np.random.normal()), float(th.randn(()))


def test_checkpoint_round_trip(tmp_path: Path) -> None:
    model = learner(seed=1)
    np.random.normal()  # so that numpy holds back the second of a pair
    path = save_checkpoint(tmp_path, model, {"workers": [{"epoch": 3}], "phase": 1})
    assert path == tmp_path / "step-000000000032"
    saved, drawn = parameters(model), draw()
    other = learner(seed=2, steps=16)
    assert any((saved[k] != v).any() for k, v in parameters(other).items())
    tensors, header = read_checkpoint(path)
    assert header["workers"] == [{"epoch": 3}] and header["phase"] == 1
    load_learner(other, tensors, header)
    loaded = parameters(other)
    assert set(loaded) == set(saved) and "0.exp_avg_sq" in saved
    assert all((loaded[k] == saved[k]).all() for k in saved)
    assert draw() == drawn
    assert (other.num_timesteps, other._n_updates) == (32, model._n_updates) == (32, 4)


def test_two_checkpoints_are_kept(tmp_path: Path) -> None:
    model = learner(seed=0)
    for steps in (100, 9, 2000, 2000):
        model.num_timesteps = steps
        save_checkpoint(tmp_path, model, {})
    assert sorted(p.name for p in tmp_path.iterdir()) == ["step-000000000100", "step-000000002000"]


def three(folder: Path) -> list[Path]:
    """A run's two newest checkpoints, and what is left of one that was not finished."""
    model = learner(seed=0)
    made = []
    for steps in (10, 20):
        model.num_timesteps = steps
        made.append(save_checkpoint(folder / "checkpoints", model, {"at": steps}))
    (folder / "checkpoints" / ".step-000000000030.partial").mkdir()
    return made


def test_the_newest_checkpoint_is_taken(tmp_path: Path) -> None:
    three(tmp_path)
    warnings: list[str] = []
    assert newest_checkpoint(tmp_path, warnings.append)[1]["at"] == 20
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
    (path / "state.json").write_text(json.dumps({**header, "version": 2}), encoding="utf-8")


def remove(path: Path) -> None:
    (path / "state.safetensors").unlink()


@pytest.mark.parametrize("damage", [truncate, flip, garble, foreign, listed, newer, remove])
def test_a_damaged_checkpoint_falls_back_to_the_one_before(damage: Any, tmp_path: Path) -> None:
    before, newest = three(tmp_path)
    damage(newest)
    with pytest.raises(CheckpointError, match=str(newest)) as caught:
        read_checkpoint(newest)
    assert "\n" not in str(caught.value)
    warnings: list[str] = []
    assert newest_checkpoint(tmp_path, warnings.append)[1]["at"] == 10
    assert len(warnings) == 1 and str(newest) in warnings[0]
    assert warnings[0].endswith("; trying the one before")
    damage(before)
    with pytest.raises(CheckpointError, match=r"no checkpoint that can be read$"):
        newest_checkpoint(tmp_path, warnings.append)


def test_no_checkpoint_at_all(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"no checkpoint that can be read$"):
        newest_checkpoint(tmp_path, print)


def test_a_checkpoint_of_another_network(tmp_path: Path) -> None:
    tensors, header = read_checkpoint(save_checkpoint(tmp_path, learner(seed=0), {}))
    with pytest.raises(CheckpointError, match=r"^the checkpoint does not fit the conf") as caught:
        load_learner(learner(seed=0, hidden=9), tensors, header)
    assert "\n" not in str(caught.value)


# ------------------------------------------------------------------ interruption


def test_time_limit() -> None:
    assert not Interruption(None).due() and not Interruption(1000.0).due()
    over = Interruption(-1.0)
    assert over.due() and over.reason == "the time limit"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_asks_to_stop_and_a_second_one_stops(number: signal.Signals) -> None:
    interruption = Interruption(None)
    os.kill(os.getpid(), number)
    assert interruption.due() and interruption.reason == number.name
    with pytest.raises(KeyboardInterrupt):
        os.kill(os.getpid(), number)


# ------------------------------------------------------------------ the policy that is trained


def test_the_policy_is_symmetric(tmp_path: Path) -> None:
    """Mirrored observation, mirrored action, same value: before and after a change of weights,
    and in the saved file."""
    task = LowLevelTask(LowTrainConfig().env, 1, seed=0)
    (obs_index, obs_sign), (act_index, act_sign) = task.observation_mirror, task.action_mirror
    mirror = Mirror(*(tuple(x.tolist()) for x in (obs_index, obs_sign, act_index, act_sign)))
    policy = AsymmetricActorCriticPolicy(
        task.observation_space, task.action_space, lambda _: 1e-3, actor_dim=task.actor_dim,
        mirror=mirror, net_arch={"pi": [16], "vf": [16]},
    )  # fmt: skip
    task.close()
    seen = th.randn(5, task.obs_dim)
    image = seen[:, obs_index] * th.from_numpy(obs_sign)
    for _ in range(2):
        with th.no_grad():
            for tensor in policy.parameters():
                tensor += 0.3 * th.randn_like(tensor)
            action = policy.get_distribution(seen).mode()
            mirrored = policy.get_distribution(image).mode()
            th.testing.assert_close(mirrored, action[:, act_index] * th.from_numpy(act_sign))
            assert (mirrored - action).abs().max() > 0.1
            th.testing.assert_close(policy.predict_values(image), policy.predict_values(seen))
    policies.save(tmp_path / "policy", policy, {})
    given, _ = policies.load(tmp_path / "policy").predict(seen[:, : task.actor_dim].numpy())
    wanted = action.clamp(-4.0, 4.0).numpy()
    np.testing.assert_allclose(given, wanted, atol=1e-5)


# ------------------------------------------------------------------ whole runs

TINY = [
    "--seed", "3", "--n-envs", "4", "--workers", "2", "--steps", "160",
    "--set", "plane_steps=64", "--set", "checkpoint_steps=32", "--set", "log_steps=64",
    "--set", "ppo.n_steps=8", "--set", "ppo.batch_size=16", "--set", "ppo.n_epochs=2",
    "--set", "ppo.actor=[8]", "--set", "ppo.critic=[8]", "--set", "env.episode_seconds=0.4",
    "--set", "env.physics.substeps=4",
]  # fmt: skip


def stop_at_call(monkeypatch: pytest.MonkeyPatch, last: int) -> None:
    """Interrupt a run where it asks for the ``last`` time whether to go on."""
    calls = 0

    def due(interruption: Interruption) -> bool:
        nonlocal calls
        calls += 1
        if calls == last:
            interruption.reason = "the test"
        return interruption.reason is not None

    monkeypatch.setattr(Interruption, "due", due)


def final(run: Path) -> dict[str, Any]:
    """What a run ended with, but for the wall time."""
    header = json.loads((run / "checkpoints/step-000000000160/state.json").read_bytes())
    return {**{k: v for k, v in header.items() if k != "seconds"}, "policy": weights(run)}


def weights(run: Path) -> bytes:
    return (run / "policy.safetensors").read_bytes()


def test_a_resumed_run_ends_as_one_that_never_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Two updates on the plane and three on tiles, a checkpoint after each. The second run stops
    after four, loses its newest checkpoint, and goes on from the one before."""
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    assert train_low.main([*TINY, "--out", str(whole)]) == 0
    names = sorted(path.name for path in (whole / "checkpoints").iterdir())
    assert names == ["step-000000000128", "step-000000000160"]
    rows = [json.loads(line) for line in (whole / "log.jsonl").read_text().splitlines()]
    assert [row["steps"] for row in rows] == [64, 128]
    assert rows[1]["reward/track_lin_vel"] > 0.0 and "level/stair" in rows[1]
    stored = from_dict(LowTrainConfig, json.loads((whole / "config.json").read_text()))
    expected = LowTrainConfig(
        seed=3, n_envs=4, workers=2, steps=160, plane_steps=64, checkpoint_steps=32, log_steps=64
    )
    assert dataclasses.replace(stored, env=expected.env, ppo=expected.ppo) == expected
    assert stored.ppo.actor == (8,) and stored.env.episode_seconds == 0.4

    with monkeypatch.context() as patch:
        stop_at_call(patch, 5)  # before 0, 32, 64, 96 and 128
        assert train_low.main([*TINY, "--out", str(broken)]) == 0
    assert "stopped by the test" in "".join(capfd.readouterr())
    assert sorted(p.name for p in (broken / "checkpoints").iterdir())[-1] == "step-000000000128"
    assert weights(broken) != weights(whole)
    flip(broken / "checkpoints/step-000000000128")
    assert train_low.main(["--resume", "--out", str(broken)]) == 0
    assert "its checksum does not match" in "".join(capfd.readouterr())
    assert final(broken) == final(whole)

    # A finished run has nothing left to do; more steps than its own go on from its end.
    assert train_low.main(["--resume", "--out", str(broken)]) == 0
    assert final(broken) == final(whole)


def test_flags_and_folders_that_cannot_be_used(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    used, empty = tmp_path / "used", tmp_path / "empty"
    used.mkdir()
    (used / "config.json").write_text("{}", encoding="utf-8")
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
        f"{used}: no checkpoint that can be read": ["--resume", "--out", str(used)],
        "unknown configuration key 'env.robot.kq'": ["--set", "env.robot.kq=1"],
        "cannot read --set 'seed'": ["--set", "seed"],
        "Expecting value": ["--resume", "--out", str(damaged)],
    }
    for message, arguments in cases.items():
        where = [] if "--out" in arguments else ["--out", str(empty)]
        assert train_low.main([*arguments, *where]) == 2
        error = capsys.readouterr().err
        assert error.startswith("train_low.py: ") and message in error
        assert error.count("\n") == 1
    assert not empty.exists()


def test_phases_of_a_run() -> None:
    """The plane with its coarser step, then tiles with the full number of substeps."""
    config = with_overrides(LowTrainConfig(), ["plane_steps=100", "steps=80"])
    assert [phase.until for phase in train_low.phases(config, "cpu")] == [80, 80]
    config = with_overrides(LowTrainConfig(), ["plane_steps=100", "steps=300"])
    plane, tiles = train_low.phases(config, "cpu")
    assert (plane.until, tiles.until) == (100, 300)
    _, on_plane, device = plane.build.args  # type: ignore[attr-defined]
    _, on_tiles, _ = tiles.build.args  # type: ignore[attr-defined]
    assert (on_plane.terrain, on_plane.physics.substeps, device) == ("plane", 4, "cpu")
    assert (on_tiles.terrain, on_tiles.physics) == ("tiles", config.env.physics)
    assert dataclasses.replace(on_plane, terrain="tiles", physics=on_tiles.physics) == on_tiles
    assert PPOConfig().mirror
