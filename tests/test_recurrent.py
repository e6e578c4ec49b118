"""The fast recurrent policy against sb3-contrib's own: same outputs, gradients and training."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from sb3_contrib import RecurrentPPO
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from sb3_contrib.common.recurrent.type_aliases import RNNStates
from stable_baselines3.common.vec_env import DummyVecEnv
from torch import nn

from tdgc.recurrent import FastRecurrentPolicy

OBS, ACT, HIDDEN = 6, 2, 16
VARIANTS = [
    {},
    {"n_lstm_layers": 2},
    {"enable_critic_lstm": False},
    {"enable_critic_lstm": False, "shared_lstm": True},
]


@pytest.fixture(autouse=True)
def one_thread():
    """The networks are so small that threads only wait for each other."""
    threads = th.get_num_threads()
    th.set_num_threads(1)
    yield
    th.set_num_threads(threads)


class MemoryEnv(gym.Env):
    """Reward for repeating the last observation; an episode ends at random, some at a limit."""

    def __init__(self, seed: int) -> None:
        self.observation_space = spaces.Box(-np.inf, np.inf, (OBS,))
        self.action_space = spaces.Box(-2.0, 2.0, (ACT,))
        self.rng = np.random.default_rng(seed)

    def _next(self) -> np.ndarray:
        return self.rng.normal(size=OBS).astype(np.float32)

    def reset(self, *, seed=None, options=None):
        self.last = self.obs = self._next()
        return self.obs, {}

    def step(self, action):
        reward = -float(np.abs(action - self.last[:ACT]).sum())
        self.last, self.obs = self.obs, self._next()
        ended, limit = self.rng.random(2) < (0.12, 0.05)
        return self.obs, reward, bool(ended), bool(limit), {}


def make_model(policy: type[RecurrentActorCriticPolicy], **kwargs) -> RecurrentPPO:
    """12 steps of 5 environments; minibatches of 17 cut sequences at odd places."""
    env = DummyVecEnv([lambda i=i: MemoryEnv(i) for i in range(5)])
    return RecurrentPPO(
        policy,
        env,
        n_steps=12,
        batch_size=17,
        n_epochs=3,
        learning_rate=3e-3,
        seed=3,
        device="cpu",
        policy_kwargs={"lstm_hidden_size": HIDDEN, "net_arch": [8], **kwargs},
    )


def count_calls(lstm: nn.LSTM) -> list[int]:
    """A list that gets the sequence length of every call of ``lstm``."""
    lengths: list[int] = []
    lstm.register_forward_hook(lambda module, inputs, output: lengths.append(len(inputs[0])))
    return lengths


def gradients(policy: nn.Module) -> dict[str, th.Tensor]:
    return {n: p.grad.clone() for n, p in policy.named_parameters() if p.grad is not None}


def assert_close(got: dict[str, th.Tensor], want: dict[str, th.Tensor], tolerance: float) -> None:
    assert set(got) == set(want)
    for name in want:
        error = (got[name] - want[name]).abs().max()
        assert error <= tolerance * (1.0 + want[name].abs().max()), name


def test_it_is_the_stock_policy_but_for_the_pass():
    fast, stock = make_model(FastRecurrentPolicy).policy, make_model("MlpLstmPolicy").policy
    assert fast.state_dict().keys() == stock.state_dict().keys()
    assert all(th.equal(a, stock.state_dict()[n]) for n, a in fast.state_dict().items())


@pytest.mark.parametrize("layers", [1, 2])
def test_pass_equals_the_loop_where_sequences_start_episodes(layers):
    generator = th.Generator().manual_seed(0)
    n_seq, length = 9, 7
    lstm = nn.LSTM(OBS, HIDDEN, num_layers=layers)
    features = th.randn(n_seq * length, OBS, generator=generator)
    states = tuple(th.randn(layers, n_seq, HIDDEN, generator=generator) for _ in range(2))
    starts = th.zeros(n_seq, length)
    starts[[1, 2, 6], 0] = 1.0
    weights = th.randn(n_seq * length, HIDDEN, generator=generator)
    results = []
    for policy in (FastRecurrentPolicy, RecurrentActorCriticPolicy):
        inputs = [t.clone().requires_grad_() for t in (features, *states)]
        lstm.zero_grad()
        output, last = policy._process_sequence(
            inputs[0], (inputs[1], inputs[2]), starts.flatten(), lstm
        )
        ((output * weights).sum() + last[0].sum() - last[1].sum()).backward()
        tensors = {"output": output, "h": last[0], "c": last[1], **gradients(lstm)}
        results.append(tensors | {f"input{i}": t.grad for i, t in enumerate(inputs)})
    assert_close(results[0], results[1], 2e-6)
    # The gradient does not flow into a state that was zeroed, and does into the others.
    for grad in (results[0]["input1"], results[0]["input2"]):
        assert grad[:, [1, 2, 6]].abs().max() == 0.0
        assert grad[:, [0, 3, 4, 5, 7, 8]].abs().amax((0, 2)).min() > 1e-4


def test_a_start_inside_a_sequence_is_still_right():
    generator = th.Generator().manual_seed(1)
    lstm = nn.LSTM(OBS, HIDDEN)
    features = th.randn(3 * 5, OBS, generator=generator)
    states = (th.randn(1, 3, HIDDEN, generator=generator),) * 2
    starts = th.zeros(3, 5)
    starts[0, 0] = starts[1, 3] = 1.0
    output, last = FastRecurrentPolicy._process_sequence(features, states, starts.flatten(), lstm)
    output = output.view(3, 5, HIDDEN)
    # By hand: from its start on, sequence 1 is a sequence of its own from a state of zeros.
    alone, (h, c) = lstm(features.view(3, 5, OBS)[1, 3:])
    assert (output[1, 3:] - alone).abs().max() < 1e-6
    assert max((last[0][:, 1] - h).abs().max(), (last[1][:, 1] - c).abs().max()) < 1e-6
    fresh, _ = lstm(features.view(3, 5, OBS)[0])
    assert (output[0] - fresh).abs().max() < 1e-6


@pytest.mark.parametrize("variant", VARIANTS, ids=lambda v: "-".join(v) or "default")
def test_evaluate_actions_on_real_rollouts(variant):
    stock = make_model("MlpLstmPolicy", **variant)
    fast = make_model(FastRecurrentPolicy, **variant).policy
    stock.learn(60)
    fast.load_state_dict(stock.policy.state_dict())
    fast_calls, stock_calls = count_calls(fast.lstm_actor), count_calls(stock.policy.lstm_actor)
    padded = inside = 0
    for batch in stock.rollout_buffer.get(17):
        inside += int((batch.episode_starts > 0).sum())
        padded += int((batch.mask < 0.5).sum())
        outputs = []
        for policy in (fast, stock.policy):
            policy.zero_grad()
            values, log_prob, entropy = policy.evaluate_actions(
                batch.observations, batch.actions, batch.lstm_states, batch.episode_starts
            )
            mask = batch.mask > 0.5
            (values.flatten() * batch.returns + log_prob * batch.advantages)[mask].sum().backward()
            tensors = {"values": values, "log_prob": log_prob, "entropy": entropy}
            outputs.append(tensors | gradients(policy))
        assert_close(outputs[0], outputs[1], 5e-6)
    assert inside >= 3 and padded >= 5  # the rollout did hold what makes this hard
    assert len(fast_calls) == 4 and max(fast_calls) > 3  # one call a minibatch
    assert len(stock_calls) > 12 and max(stock_calls) == 1  # a call a step


@pytest.mark.parametrize("variant", VARIANTS, ids=lambda v: "-".join(v) or "default")
def test_training_ends_at_the_same_weights(variant):
    trained = []
    for policy in (FastRecurrentPolicy, RecurrentActorCriticPolicy):
        model = make_model(policy, **variant)  # which seeds torch and numpy, so not before the loop
        start = {name: t.clone() for name, t in model.policy.state_dict().items()}
        trained.append(dict(model.learn(3 * 60).policy.state_dict()))
    fast, stock = trained
    assert_close(fast, stock, 1e-4)
    assert min((fast[name] - start[name]).abs().max() for name in start) > 1e-3  # it did train


def test_one_step_with_many_environments():
    """Collecting: a sequence per environment, one step long, some of them starting."""
    stock, fast = make_model("MlpLstmPolicy").policy, make_model(FastRecurrentPolicy).policy
    generator = th.Generator().manual_seed(2)
    obs = th.randn(100, OBS, generator=generator)
    parts = [th.randn(1, 100, HIDDEN, generator=generator) for _ in range(4)]
    states = RNNStates((parts[0], parts[1]), (parts[2], parts[3]))
    starts = (th.rand(100, generator=generator) < 0.3).float()
    with th.no_grad():
        got, want = (p(obs, states, starts, deterministic=True) for p in (fast, stock))
    flat = [dict(enumerate([*r[:3], *r[3].pi, *r[3].vf])) for r in (got, want)]
    assert_close(flat[0], flat[1], 1e-6)
    assert 0 < starts.sum() < 100
