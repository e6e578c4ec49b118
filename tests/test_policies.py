"""Policies and their files: the asymmetric network, exact round trips, and every bad file."""

import hashlib
import json
import os
import pickle
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import safetensors.torch
import torch as th
from gymnasium import spaces
from sb3_contrib.ppo_recurrent.policies import MlpLstmPolicy
from stable_baselines3 import PPO
from stable_baselines3.common.policies import ActorCriticPolicy
from stubs import no_file_larger_than
from torch import nn

from tdgc import policies
from tdgc.policies import AsymmetricActorCriticPolicy, PolicyFileError

ACTOR, OBS, ACT = 7, 10, 3


def spaces_pair(obs_dim: int = OBS, bound: float = 0.8) -> tuple[spaces.Box, spaces.Box]:
    return spaces.Box(-np.inf, np.inf, (obs_dim,)), spaces.Box(-bound, bound, (ACT,))


def shake(policy: ActorCriticPolicy, seed: int = 0) -> None:
    """Give every parameter a value worth checking: SB3 starts biases at 0 and actions near 0."""
    generator = th.Generator().manual_seed(seed)
    with th.no_grad():
        for parameter in policy.parameters():
            scale = parameter.shape[-1] ** -0.5 if parameter.dim() == 2 else 0.5
            parameter.copy_(scale * th.randn(parameter.shape, generator=generator))


def mlp_policy(**kwargs) -> AsymmetricActorCriticPolicy:
    policy = AsymmetricActorCriticPolicy(
        *spaces_pair(), lambda _: 1e-3, **{"actor_dim": ACTOR, **kwargs}
    )
    shake(policy)
    return policy


def lstm_policy(**kwargs) -> MlpLstmPolicy:
    policy = MlpLstmPolicy(*spaces_pair(), lambda _: 1e-3, **{"lstm_hidden_size": 16, **kwargs})
    shake(policy)
    return policy


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    path = tmp_path / "low"
    policies.save(path, mlp_policy(net_arch={"pi": [8, 5], "vf": [6]}), {"seed": 42})
    return path


class TinyEnv(gym.Env):
    """Rewards actions near a part of the observation; episodes end after 5 steps."""

    def __init__(self) -> None:
        self.observation_space, self.action_space = spaces_pair()
        self.observation_space.seed(0)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        self.obs = self.np_random.normal(size=OBS).astype(np.float32)
        return self.obs, {}

    def step(self, action):
        self.t += 1
        reward = -float(np.abs(action - self.obs[:ACT]).sum())
        self.obs = self.np_random.normal(size=OBS).astype(np.float32)
        return self.obs, reward, self.t == 5, False, {}


# --- the asymmetric policy ---------------------------------------------------------------------


def test_actor_sees_only_its_part_and_critic_sees_all():
    policy = mlp_policy()
    obs = th.randn(4, OBS, generator=th.Generator().manual_seed(1)).requires_grad_()
    policy.get_distribution(obs).distribution.mean.sum().backward()
    assert obs.grad[:, :ACTOR].abs().amax(0).min() > 1e-2
    assert obs.grad[:, ACTOR:].abs().max() == 0.0
    obs.grad = None
    policy.predict_values(obs).sum().backward()
    assert obs.grad.abs().amax(0).min() > 1e-2


def test_default_architecture():
    policy = AsymmetricActorCriticPolicy(
        *spaces_pair(), lambda _: 1e-3, actor_dim=ACTOR, log_std_init=-0.5
    )
    body = policy.mlp_extractor
    assert [tuple(m.weight.shape) for m in body.policy_net if isinstance(m, nn.Linear)] == [
        (256, ACTOR),
        (128, 256),
    ]
    assert [tuple(m.weight.shape) for m in body.value_net if isinstance(m, nn.Linear)] == [
        (256, OBS),
        (128, 256),
    ]
    assert sum(isinstance(m, nn.ELU) for m in body.modules()) == 4
    assert policy.log_std.tolist() == [-0.5] * ACT
    # SB3's initialisation: orthogonal, gain 0.01 for the action and sqrt(2) for hidden layers
    gram = policy.action_net.weight @ policy.action_net.weight.T
    assert th.allclose(gram, 1e-4 * th.eye(ACT), atol=1e-8)
    gram = body.policy_net[0].weight.T @ body.policy_net[0].weight
    assert th.allclose(gram, 2.0 * th.eye(ACTOR), atol=1e-4)


@pytest.mark.parametrize("actor_dim", [0, OBS + 1])
def test_actor_dim_must_fit(actor_dim):
    with pytest.raises(ValueError, match=f"1..{OBS}, not {actor_dim}"):
        mlp_policy(actor_dim=actor_dim)


def test_ppo_trains_it_and_both_networks_move():
    model = PPO(
        AsymmetricActorCriticPolicy,
        TinyEnv(),
        n_steps=64,
        batch_size=32,
        n_epochs=2,
        seed=0,
        device="cpu",
        policy_kwargs={"actor_dim": ACTOR, "net_arch": [16]},
    )
    before = {k: v.clone() for k, v in model.policy.state_dict().items()}
    model.learn(128)
    moved = {k for k, v in model.policy.state_dict().items() if not th.equal(v, before[k])}
    assert moved == set(before)


# --- round trips -------------------------------------------------------------------------------


@pytest.mark.parametrize("activation", [nn.ELU, nn.ReLU, nn.Tanh])
def test_mlp_acts_as_sb3_does(tmp_path, activation):
    policy = mlp_policy(activation_fn=activation)
    policies.save(tmp_path / "low", policy, {})
    loaded = policies.load(tmp_path / "low")
    obs = np.random.default_rng(2).normal(size=(200, OBS)).astype(np.float32)
    want, _ = policy.predict(obs, deterministic=True)
    got, state = loaded.predict(obs)
    assert state is None and got.dtype == np.float32
    assert np.abs(got - want).max() < 1e-6
    clipped = np.abs(want) == np.float32(0.8)
    assert 50 < clipped.sum() < clipped.size - 50  # both sides of the bound are exercised
    assert np.abs(loaded.predict(obs[:, :ACTOR])[0] - want).max() < 1e-6
    one, _ = loaded.predict(obs[3])
    assert one.shape == (ACT,) and np.abs(one - want[3]).max() < 1e-6
    assert loaded.predict(obs[3:4])[0].shape == (1, ACT)


def test_plain_sb3_policy_and_no_hidden_layers(tmp_path):
    policy = ActorCriticPolicy(*spaces_pair(), lambda _: 1e-3, net_arch={"pi": [], "vf": [4]})
    shake(policy)
    policies.save(tmp_path / "plain", policy, {})
    loaded = policies.load(tmp_path / "plain")
    obs = np.random.default_rng(3).normal(size=(20, OBS)).astype(np.float32)
    assert (loaded.obs_dim, loaded.actor_dim) == (OBS, OBS)
    assert np.abs(loaded.predict(obs)[0] - policy.predict(obs, deterministic=True)[0]).max() < 1e-6


def test_lstm_acts_as_sb3_does_through_episode_starts(tmp_path):
    policy = lstm_policy()
    policies.save(tmp_path / "high", policy, {})
    loaded = policies.load(tmp_path / "high")
    rng = np.random.default_rng(4)
    state = want_state = None
    for step in range(12):
        obs = rng.normal(size=(5, OBS)).astype(np.float32)
        start = rng.random(5) < (1.0 if step == 0 else 0.3)
        want, want_state = policy.predict(obs, want_state, start, deterministic=True)
        got, state = loaded.predict(obs, state, start)
        assert np.abs(got - want).max() < 1e-6
        assert state[0].shape == state[1].shape == want_state[0].shape == (1, 5, 16)
        assert max(np.abs(a - b).max() for a, b in zip(state, want_state, strict=True)) < 1e-6


def test_lstm_state_is_used_zeroed_and_not_written_to(tmp_path):
    policies.save(tmp_path / "high", lstm_policy(), {})
    loaded = policies.load(tmp_path / "high")
    obs = np.ones(OBS, np.float32)
    first, state = loaded.predict(obs)
    assert first.shape == (ACT,)
    kept = tuple(part.copy() for part in state)
    second, _ = loaded.predict(obs, state)
    again, _ = loaded.predict(obs, state, episode_start=np.array([True]))
    assert np.abs(second - first).max() > 1e-3
    assert np.array_equal(again, first)
    assert all(np.array_equal(a, b) for a, b in zip(state, kept, strict=True))


def test_meta_and_sizes_come_back_and_suffixes_do_not_matter(tmp_path):
    meta = {"seed": 42, "config": {"a": [1, 2.5, None, "x"]}, "code": "0.1.0"}
    stem = tmp_path / "runs" / "low-v1.5"
    policies.save(stem, mlp_policy(), meta)
    assert sorted(p.name for p in stem.parent.iterdir()) == [
        "low-v1.5.json",
        "low-v1.5.safetensors",
    ]
    for path in (stem, f"{stem}.json", f"{stem}.safetensors"):
        loaded = policies.load(path)
        assert loaded.meta == meta and loaded.kind == "mlp"
        assert (loaded.obs_dim, loaded.actor_dim, loaded.action_dim) == (OBS, ACTOR, ACT)
        assert loaded.low.tolist() == [np.float32(-0.8)] * ACT
        assert loaded.high.tolist() == [np.float32(0.8)] * ACT
    policies.save(f"{stem}.json", mlp_policy(), {"seed": 1})
    assert len(list(stem.parent.iterdir())) == 2 and policies.load(stem).meta == {"seed": 1}


def test_the_files_are_what_the_format_says(saved):
    data = Path(f"{saved}.safetensors").read_bytes()
    table = json.loads(Path(f"{saved}.json").read_text())
    assert table["sha256"] == hashlib.sha256(data).hexdigest()
    assert table["architecture"] == {
        "activation": "elu",
        "actor": [8, 5],
        "critic": [6],
        "lstm": None,
    }
    tensors = safetensors.torch.load(data)
    assert {name: tuple(t.shape) for name, t in tensors.items()} == {
        "log_std": (ACT,),
        "actor.0.weight": (8, ACTOR),
        "actor.0.bias": (8,),
        "actor.1.weight": (5, 8),
        "actor.1.bias": (5,),
        "actor.2.weight": (ACT, 5),
        "actor.2.bias": (ACT,),
        "critic.0.weight": (6, OBS),
        "critic.0.bias": (6,),
        "critic.1.weight": (1, 6),
        "critic.1.bias": (1,),
    }


def test_action_by_hand():
    header = policies.Header("mlp", "elu", (2,), (), None, 3, 2, (-1.0,), (1.0,), {})
    tensors = {
        "actor.0.weight": th.tensor([[1.0, 0.0], [0.0, 2.0]]),
        "actor.0.bias": th.tensor([0.5, 0.0]),
        "actor.1.weight": th.tensor([[0.25, 0.5]]),
        "actor.1.bias": th.tensor([0.1]),
        "log_std": th.tensor([0.0]),
    }
    policy = policies.Policy(header, tensors)
    # elu(1.5) = 1.5, elu(-1) = exp(-1) - 1; 0.25 * 1.5 + 0.5 * (exp(-1) - 1) + 0.1
    action, _ = policy.predict([1.0, -0.5, 99.0])
    assert action[0] == pytest.approx(0.475 + 0.5 * (np.exp(-1.0) - 1.0), abs=1e-6)
    assert policy.predict([9.0, 9.0])[0].tolist() == [1.0]


def test_unbounded_actions_are_not_clipped(tmp_path):
    policy = ActorCriticPolicy(
        spaces.Box(-1, 1, (2,)), spaces.Box(-np.inf, np.inf, (1,)), lambda _: 1e-3
    )
    with th.no_grad():
        policy.action_net.bias.fill_(1e6)
    policies.save(tmp_path / "p", policy, {})
    assert json.loads((tmp_path / "p.json").read_text())["action"]["low"] == [None]
    assert policies.load(tmp_path / "p").predict([0.0, 0.0])[0][0] == pytest.approx(1e6, rel=1e-3)


def test_stochastic_actions_have_the_right_spread_and_a_seed(tmp_path):
    policy = AsymmetricActorCriticPolicy(*spaces_pair(bound=100.0), lambda _: 1.0, actor_dim=ACTOR)
    with th.no_grad():
        policy.log_std.copy_(th.log(th.tensor([0.1, 1.0, 3.0])))
    policies.save(tmp_path / "p", policy, {})
    loaded = policies.load(tmp_path / "p")
    obs = np.tile(np.linspace(-1, 1, OBS, dtype=np.float32), (20000, 1))
    loaded.seed(5)
    drawn, _ = loaded.predict(obs, deterministic=False)
    mean, _ = loaded.predict(obs)
    assert drawn.std(axis=0) == pytest.approx([0.1, 1.0, 3.0], rel=0.03)
    assert np.abs((drawn - mean).mean(axis=0) / [0.1, 1.0, 3.0]).max() < 0.03
    more, _ = loaded.predict(obs, deterministic=False)
    loaded.seed(5)
    assert np.array_equal(loaded.predict(obs, deterministic=False)[0], drawn)
    assert not np.array_equal(more, drawn)


def test_predict_leaves_the_thread_count_alone(saved):
    threads = th.get_num_threads()
    th.set_num_threads(2)
    policies.load(saved).predict(np.zeros(OBS))
    after = th.get_num_threads()
    th.set_num_threads(threads)
    assert after == 2


@pytest.mark.parametrize("shape", [(OBS + 1,), (2, ACTOR - 1), (2, 2, OBS), ()])
def test_wrong_observation_width_names_both(saved, shape):
    with pytest.raises(ValueError, match=rf"{ACTOR} wide \(actor part\) or {OBS} \(all\)"):
        policies.load(saved).predict(np.zeros(shape))


def test_wrong_state_shape(tmp_path):
    policies.save(tmp_path / "high", lstm_policy(), {})
    state = (np.zeros((1, 3, 16), np.float32),) * 2
    with pytest.raises(ValueError, match=r"two of \(1, 2, 16\)"):
        policies.load(tmp_path / "high").predict(np.zeros((2, OBS)), state)


@pytest.mark.parametrize("make", [mlp_policy, lstm_policy])
def test_load_into_restores_every_parameter(tmp_path, make):
    source, target = make(), make()
    shake(target, seed=9)
    policies.save(tmp_path / "p", source, {"steps": 7})
    assert policies.load_into(tmp_path / "p", target) == {"steps": 7}
    want, got = source.state_dict(), target.state_dict()
    assert all(th.equal(want[name], got[name]) for name in want)


def test_load_into_refuses_another_architecture(saved):
    with pytest.raises(PolicyFileError, match=r"actor is \(8, 5\), this policy's \(256, 128\)"):
        policies.load_into(saved, mlp_policy())
    with pytest.raises(PolicyFileError, match=r"kind is mlp, this policy's lstm"):
        policies.load_into(saved, lstm_policy())


# --- what is not written -----------------------------------------------------------------------


def test_what_cannot_be_read_back_is_not_written(tmp_path):
    broken = mlp_policy()
    with th.no_grad():
        broken.value_net.bias.fill_(np.nan)
    bad = [
        (broken, {}, "critic.2.bias holds a number that is not finite"),
        (mlp_policy(), {"x": np.float32(1)}, "meta cannot be written"),
        (mlp_policy(), {"x": float("nan")}, "meta cannot be written"),
        (mlp_policy(), {"x": "y" * 5_000_000}, "meta takes 50"),
        (mlp_policy(activation_fn=nn.SiLU), {}, "known: elu, relu, tanh"),
        (lstm_policy(n_lstm_layers=2), {}, "one layer"),
        (lstm_policy(enable_critic_lstm=False), {}, "one each for actor and critic"),
        (mlp_policy(use_sde=True), {}, "plain Gaussian"),
    ]
    for policy, meta, message in bad:
        with pytest.raises(ValueError, match=message):
            policies.save(tmp_path / "out" / "p", policy, meta)
    assert list(tmp_path.iterdir()) == []


def test_files_are_replaced_not_written_over(saved):
    """Hard links to the old files, like open files, still give the old policy."""
    old = saved.parent / "old"
    for suffix in (".json", ".safetensors"):
        os.link(f"{saved}{suffix}", f"{old}{suffix}")
    policies.save(saved, lstm_policy(), {"seed": 1})
    assert policies.load(old).meta == {"seed": 42} and policies.load(old).kind == "mlp"
    assert policies.load(saved).meta == {"seed": 1} and policies.load(saved).kind == "lstm"


def test_failed_write_leaves_the_old_policy_and_no_scraps(saved):
    before = policies.load(saved)
    with no_file_larger_than(1000), pytest.raises(OSError, match=r"File too large"):
        policies.save(saved, mlp_policy(), {"seed": 1})
    assert len(list(saved.parent.iterdir())) == 2
    after = policies.load(saved)
    assert after.meta == {"seed": 42}
    assert all(th.equal(t, after.tensors[name]) for name, t in before.tensors.items())


# --- every bad file ----------------------------------------------------------------------------


def refused(path: Path, message: str) -> None:
    with pytest.raises(PolicyFileError, match=message) as caught:
        policies.load(path)
    assert "\n" not in str(caught.value)
    assert str(path.parent) in str(caught.value)


def rewrite(path: Path, *keys: str, value: object) -> None:
    """Set one value of the JSON file, given the keys that lead to it."""
    file = Path(f"{path}.json")
    table = json.loads(file.read_text())
    inner = table
    for key in keys[:-1]:
        inner = inner[key]
    inner[keys[-1]] = value
    file.write_text(json.dumps(table))


def reweigh(path: Path, data: bytes) -> None:
    """Replace the weights, and the checksum to match."""
    Path(f"{path}.safetensors").write_bytes(data)
    rewrite(path, "sha256", value=hashlib.sha256(data).hexdigest())


def test_missing_files(saved):
    refused(saved.parent / "nothing", r"nothing\.json: no such file")
    Path(f"{saved}.safetensors").unlink()
    refused(saved, r"low\.safetensors: no such file")
    Path(f"{saved}.safetensors").mkdir()
    refused(saved, r"low\.safetensors: cannot be read")


@pytest.mark.parametrize(
    ("keys", "value", "message"),
    [
        (("format",), "other", "not a tdgc-policy file"),
        (("version",), 2, "format version 2; this code reads 1"),
        (("version",), "1", "format version '1'"),
        (("version",), True, "format version True"),
        (("kind",), "cnn", "kind 'cnn'; known: mlp, lstm"),
        (("kind",), ["mlp"], r"kind \['mlp'\]"),
        (("kind",), "lstm", "'lstm' is None in a file of kind 'lstm'"),
        (("sha256",), 1, "'sha256' must be a string"),
        (("sha256",), "0" * 64, "not the file that low.json was made for"),
        (("meta",), [], "'meta' must be a table"),
        (("extra",), 1, "unknown key 'extra' in the file"),
        (("architecture",), 3, "'architecture' must be a table of keys"),
        (("architecture", "norm"), 1, "unknown key 'norm' in 'architecture'"),
        (("architecture", "activation"), "gelu", "activation 'gelu'; known: elu"),
        (("architecture", "activation"), {}, "activation {}"),
        (("architecture", "actor"), "8", "'actor' must be a list"),
        (("architecture", "actor"), [8, 5.0], r"'actor'\[1\] must be a whole number"),
        (("architecture", "actor"), [8, True], r"'actor'\[1\] must be a whole number"),
        (("architecture", "actor"), [8, 0], r"'actor'\[1\] must be a whole number"),
        (("architecture", "actor"), [8, 10**12], r"'actor'\[1\] must be a whole number"),
        (("architecture", "actor"), [8] * 1000, "at most 32"),
        (("architecture", "actor"), [65536] * 30, "too large to be a policy"),
        (("architecture", "actor"), [800, 500], "truncated: the architecture needs over"),
        (("architecture", "actor"), [8], "tensor 'actor.2.bias' is not part"),
        (("architecture", "actor"), [8, 4], "'actor.1.weight' is F32"),
        (("architecture", "lstm"), 8, "'lstm' is 8 in a file of kind 'mlp'"),
        (("architecture", "encoder"), [8], r"'encoder' is \[8\] in a file of kind 'mlp'"),
        (("architecture", "encoder"), 8, "'encoder' must be a list"),
        (("architecture", "correction"), [15], r"'correction' is \[15\] in a file"),
        (("architecture", "correction"), [3, 15], r"'correction' is \[3, 15\] in a file"),
        (("architecture", "correction"), [15, 3], "tensor 'correction.0.bias' is missing"),
        (("observation", "size"), 0, "'size' of 'observation' must be a whole number"),
        (("observation", "actor_size"), 11, "'actor_size' 11 is more than the 10"),
        (("observation", "actor_size"), 6, "'actor.0.weight' is F32"),
        (("action", "size"), 2, "'low' of 'action' must be a list of 2"),
        (("action", "low"), [0, 0, "x"], "holds 'x', not a number"),
        (("action", "low"), [0, 0, 1e300], "out of range"),
        (("action", "low"), [0, 0, 0.9], "'low' of 'action' is above 'high'"),
    ],
)
def test_bad_json_values(saved, keys, value, message):
    rewrite(saved, *keys, value=value)
    refused(saved, message)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"", "not JSON"),
        (b"[1, 2", "not JSON"),
        (b"[" * 100_000, "not JSON"),
        (b'{"format": NaN}', "not JSON"),
        (b"\xff\xfe\x00", "not UTF-8"),
        (b"[]", "not a tdgc-policy file"),
        (b'{"format": "tdgc-policy", "version": 1}', "key 'kind' is missing"),
        (b" " * 4_200_000, "larger than the 4194304 bytes"),
    ],
)
def test_bad_json_text(saved, text, message):
    Path(f"{saved}.json").write_bytes(text)
    refused(saved, message)


def test_json_infinity_is_refused(saved):
    file = Path(f"{saved}.json")
    text = file.read_text()
    for number in ("1e999", "-1e999"):
        file.write_text(text.replace("-0.800000011920929", number))
        refused(saved, "out of range")


def test_bad_weights(saved):
    file = Path(f"{saved}.safetensors")
    good = file.read_bytes()
    tensors = safetensors.torch.load(good)

    file.write_bytes(good[:-1])
    refused(saved, "truncated|not the file")
    file.write_bytes(good[:100])
    refused(saved, "100 bytes, truncated")
    file.write_bytes(good[:-1] + bytes([good[-1] ^ 1]))
    refused(saved, "not the file that low.json was made for")
    file.write_bytes(good + b"\0" * 100_000)
    refused(saved, "larger than the")

    # With the checksum set to match, so that the later checks are reached.
    reweigh(saved, b"\x80" * len(good))
    refused(saved, "not a safetensors file")
    reweigh(saved, good[:-4])
    refused(saved, "not a safetensors file")
    reweigh(saved, good + b"\0\0\0\0")
    refused(saved, "not a safetensors file")
    reweigh(saved, safetensors.torch.save({**tensors, "more": th.zeros(1)}))
    refused(saved, "tensor 'more' is not part of the architecture")
    renamed = {("log_sdt" if name == "log_std" else name): t for name, t in tensors.items()}
    reweigh(saved, safetensors.torch.save(renamed))
    refused(saved, "tensor 'log_sdt' is not part|tensor 'log_std' is missing")
    transposed = {**tensors, "actor.1.weight": tensors["actor.1.weight"].T.contiguous()}
    reweigh(saved, safetensors.torch.save(transposed))
    refused(saved, r"'actor.1.weight' is F32 \(8, 5\), the architecture needs F32 \(5, 8\)")
    reweigh(saved, safetensors.torch.save({n: t.double() for n, t in tensors.items()}))
    refused(saved, "is F64")
    reweigh(saved, safetensors.torch.save({**tensors, "log_std": th.zeros(6).bfloat16()}))
    refused(saved, "'log_std' is BF16")
    for bad in (np.nan, np.inf):
        weight = tensors["critic.0.weight"].clone()
        weight[2, 3] = bad
        reweigh(saved, safetensors.torch.save({**tensors, "critic.0.weight": weight}))
        refused(saved, "'critic.0.weight' holds a non-finite number")


class Bomb:
    """Unpickling one of these leaves a file behind."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return (Path.touch, (self.path,))


def test_a_pickle_is_never_opened(saved):
    mark = saved.parent / "unpickled"
    data = pickle.dumps([Bomb(mark), "x" * 5000])
    reweigh(saved, data)
    refused(saved, "not a safetensors file")
    Path(f"{saved}.json").write_bytes(data)
    refused(saved, "not UTF-8|not JSON")
    assert not mark.exists()
    pickle.loads(data)
    assert mark.exists()  # the bomb was live


def test_flipped_bits_are_refused_in_one_line(saved):
    """Every flipped bit in the weights is refused; one in the JSON is, or leaves it well-formed."""
    rng = np.random.default_rng(0)
    obs = np.linspace(-1, 1, OBS)
    want = policies.load(saved).predict(obs)[0]
    refusals = {}
    for suffix, trials in ((".json", 300), (".safetensors", 50)):
        file = Path(f"{saved}{suffix}")
        good = file.read_bytes()
        refusals[suffix] = 0
        for _ in range(trials):
            data = bytearray(good)
            data[rng.integers(len(data))] ^= 1 << rng.integers(8)
            file.write_bytes(data)
            try:
                policies.load(saved).predict(obs)
            except PolicyFileError as error:
                assert "\n" not in str(error)
                refusals[suffix] += 1
        file.write_bytes(good)
    assert refusals[".safetensors"] == 50 and refusals[".json"] > 150
    assert np.array_equal(policies.load(saved).predict(obs)[0], want)


def test_acting_needs_no_sb3(tmp_path: Path) -> None:
    """Loading a policy, acting with it and importing the evaluation do not import SB3."""
    actor_critic = mlp_policy()
    policies.save(tmp_path / "policy", actor_critic, {})
    code = (
        "import sys\n"
        "import numpy as np\n"
        "import tdgc.benchmark.evaluation\n"
        "from tdgc import policies\n"
        "policy = policies.load(sys.argv[1])\n"
        "print(policy.predict(np.ones(policy.obs_dim))[0].tolist())\n"
        "print([m for m in sys.modules if m.startswith(('stable_baselines3', 'sb3_contrib'))])\n"
    )
    command = [sys.executable, "-c", code, str(tmp_path / "policy")]
    root = Path(__file__).resolve().parents[1]
    result = subprocess.run(command, cwd=root, capture_output=True, text=True, check=True)
    *_, action, loaded = result.stdout.splitlines()
    expected, _ = actor_critic.predict(np.ones(OBS, np.float32), deterministic=True)
    np.testing.assert_allclose(json.loads(action), expected, atol=1e-6)
    assert loaded == "[]"
