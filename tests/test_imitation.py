"""Imitation: the apprentice sees its own observation only, and comes to act as it is taught."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv

from tdgc import policies
from tdgc.learn.imitation import Apprentice, ApprenticePolicy
from tdgc.sim.commands import NUM_ACTIONS

SEEN, ENVS, STEPS = 5, 4, 16


class Lesson(gym.Env):
    """The right action is a share of what was seen one step before, so it takes memory."""

    def __init__(self, seed: int) -> None:
        self.observation_space = spaces.Box(-np.inf, np.inf, (SEEN + NUM_ACTIONS,))
        self.action_space = spaces.Box(-1.0, 1.0, (NUM_ACTIONS,))
        self.rng = np.random.default_rng(seed)
        self.last = np.zeros(SEEN)

    def _observe(self) -> np.ndarray:
        seen = self.rng.uniform(-1.0, 1.0, SEEN)
        taught = np.resize(0.5 * self.last, NUM_ACTIONS)
        self.last = seen
        return np.concatenate([seen, taught]).astype(np.float32)

    def reset(self, *, seed=None, options=None):
        self.last = np.zeros(SEEN)
        return self._observe(), {}

    def step(self, action):
        return self._observe(), 0.1, False, bool(self.rng.random() < 0.05), {}


@pytest.fixture
def apprentice():
    threads = th.get_num_threads()
    th.set_num_threads(1)
    yield Apprentice(
        ApprenticePolicy,
        DummyVecEnv([lambda i=i: Lesson(i) for i in range(ENVS)]),
        n_steps=STEPS,
        batch_size=STEPS * ENVS,
        n_epochs=10,
        learning_rate=3e-3,
        seed=0,
        device="cpu",
        policy_kwargs={"lstm_hidden_size": 16, "net_arch": [16], "log_std_init": -2.0},
    )
    th.set_num_threads(threads)


def test_an_apprentice_learns_what_it_is_taught_and_keeps_its_noise(apprentice) -> None:
    noise = apprentice.policy.log_std.clone()

    def error() -> float:
        batch = next(apprentice.rollout_buffer.get(STEPS * ENVS))
        with th.no_grad():
            obs = batch.observations
            _, log_prob, _ = apprentice.policy.evaluate_actions(
                obs, obs[:, SEEN:], batch.lstm_states, batch.episode_starts
            )
        # -log p = e^2 / (2 s^2) + log s + log(2 pi) / 2, summed over the actions
        constant = NUM_ACTIONS * (-2.0 + 0.5 * np.log(2.0 * np.pi))
        return float((-log_prob.mean() - constant) * 2.0 * np.exp(-4.0) / NUM_ACTIONS)

    apprentice.learn(STEPS * ENVS)
    first = error()
    apprentice.learn(40 * STEPS * ENVS)
    assert first > 0.03  # of labels with a variance of 0.083
    assert error() < 0.15 * first
    assert th.equal(apprentice.policy.log_std, noise)


def test_the_teachers_actions_are_not_seen(apprentice, tmp_path) -> None:
    policy = apprentice.policy
    obs = th.randn(ENVS, SEEN + NUM_ACTIONS)
    other = th.cat([obs[:, :SEEN], th.randn(ENVS, NUM_ACTIONS)], dim=1)
    starts = th.zeros(ENVS)
    state = apprentice._last_lstm_states
    for a, b in zip(
        policy.forward(obs, state, starts, deterministic=True)[:3],
        policy.forward(other, state, starts, deterministic=True)[:3],
        strict=True,
    ):
        assert th.equal(a, b)
    policies.save(tmp_path / "policy", policy, {})
    loaded = policies.load(tmp_path / "policy")
    assert loaded.obs_dim == SEEN
    expected = policy.forward(obs, state, starts, deterministic=True)[0]
    actions, _ = loaded.predict(obs[:, :SEEN].numpy())
    np.testing.assert_allclose(actions, np.clip(expected.detach().numpy(), -1, 1), atol=1e-6)
