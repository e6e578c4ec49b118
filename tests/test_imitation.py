"""Imitation: the apprentice sees only its own observation, and learns to act as it is taught."""

from __future__ import annotations

import math

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv

from tdgc import policies
from tdgc.learn.imitation import Apprentice, Notebook, TaughtPolicy, expected_price, imitation_loss
from tdgc.learn.recurrent import FastRecurrentPPO, WholeEnvBuffer
from tdgc.sim.commands import INDEX, NUM_ACTIONS
from tdgc.tasks.high_observation import GUIDANCE
from tdgc.tasks.leaps import FREQUENCIES, LENGTHS
from tdgc.tasks.teacher import WAY

SEEN, ENVS, STEPS = 5, 4, 16

pytestmark = pytest.mark.usefixtures("one_thread")


class Lesson(gym.Env):
    """The taught action is half of the previous observation, so learning it takes memory."""

    def __init__(self, seed: int) -> None:
        self.observation_space = spaces.Box(-np.inf, np.inf, (SEEN + GUIDANCE,))
        self.action_space = spaces.Box(-1.0, 1.0, (NUM_ACTIONS,))
        self.rng = np.random.default_rng(seed)
        self.last = np.zeros(SEEN)

    def _observe(self) -> np.ndarray:
        seen = self.rng.uniform(-1.0, 1.0, SEEN)
        taught = np.resize(0.5 * self.last, NUM_ACTIONS)
        self.last = seen
        return np.concatenate([seen, taught, np.zeros(GUIDANCE - NUM_ACTIONS)]).astype(np.float32)

    def reset(self, *, seed=None, options=None):
        self.last = np.zeros(SEEN)
        return self._observe(), {}

    def step(self, action):
        return self._observe(), 0.1, False, bool(self.rng.random() < 0.05), {}


def learner(
    kind: type[FastRecurrentPPO], policy: type[TaughtPolicy], **keywords: int
) -> FastRecurrentPPO:
    return kind(
        policy,
        DummyVecEnv([lambda i=i: Lesson(i) for i in range(ENVS)]),
        n_steps=STEPS,
        batch_size=STEPS * ENVS,
        n_epochs=10,
        learning_rate=3e-3,
        ent_coef=1e-3,
        seed=0,
        device="cpu",
        policy_kwargs={"lstm_hidden_size": 16, "net_arch": [16], "log_std_init": -2.0},
        **keywords,
    )


@pytest.fixture
def apprentice() -> FastRecurrentPPO:
    return learner(Apprentice, TaughtPolicy)


def error(model: FastRecurrentPPO) -> float:
    """Mean squared error of the mean actions against the teacher's, over the last rollout."""
    batch = next(model.rollout_buffer.get(STEPS * ENVS))
    obs = batch.observations
    with th.no_grad():
        mean, _ = model.policy.unroll(obs, batch.lstm_states, batch.episode_starts)
    return float((mean - obs[:, SEEN : SEEN + NUM_ACTIONS]).square().mean())


def test_an_apprentice_learns_what_it_is_taught_and_keeps_its_noise(apprentice) -> None:
    noise = apprentice.policy.log_std.clone()

    apprentice.learn(STEPS * ENVS)
    first = error(apprentice)
    apprentice.learn(40 * STEPS * ENVS)
    assert first > 0.03  # the labels have a variance of 0.083
    assert error(apprentice) < 0.15 * first
    assert th.equal(apprentice.policy.log_std, noise)


def fill(rollout: WholeEnvBuffer, observations: np.ndarray, mark: float) -> None:
    """Fill a rollout with ``observations`` (STEPS, ENVS, size), and mark its other arrays."""
    rollout.observations[:] = observations
    rollout.episode_starts[:] = np.arange(STEPS)[:, None] == 3
    rollout.returns[:] = mark + np.arange(ENVS)
    for k, memory in enumerate(
        (
            rollout.hidden_states_pi, rollout.cell_states_pi,
            rollout.hidden_states_vf, rollout.cell_states_vf,
        )
    ):  # fmt: skip
        memory[:] = 100.0 * k + mark + np.arange(ENVS)[:, None]


def test_a_notebook_keeps_the_last_rollouts_and_mixes_them(apprentice) -> None:
    """Minibatches hold single robots' sequences from kept rollouts, with their first hidden states.

    A restored notebook gives the same minibatches.
    """
    apprentice.learn(1)
    rollout, notebook = apprentice.rollout_buffer, Notebook(3)
    for number in range(5):
        fill(rollout, np.full(rollout.observations.shape, 10.0 * number), 10.0 * number)
        notebook.add(rollout)
    np.random.seed(0)
    seen = []
    for _ in range(50):
        first, second = notebook.batches(2)
        assert len(first.returns) == len(second.returns) == ENVS // 2
        values = th.cat([first.returns, second.returns])
        assert sorted((values[:, 0] % 10).tolist()) == list(range(ENVS))
        for batch in (first, second):
            assert batch.observations.shape == (2, STEPS, SEEN + GUIDANCE)
            assert (batch.observations == 10 * (batch.returns[..., None] // 10)).all()
            assert (batch.starts[:, 3] == 1.0).all() and batch.starts.sum() == 2.0
            for k in range(4):
                assert (batch.memories[k] == 100.0 * k + batch.returns[:, :1]).all()
        seen += (values[:, 0] // 10).tolist()
    assert sorted(set(seen)) == [2.0, 3.0, 4.0]  # the last three of five
    assert min(seen.count(number) for number in (2.0, 3.0, 4.0)) > 0.25 * len(seen)
    other = Notebook(3)
    other.restore(notebook.tensors(), STEPS)
    np.random.seed(1)
    expected = list(notebook.batches(1))
    np.random.seed(1)
    for batch, wanted in zip(other.batches(1), expected, strict=True):
        assert all(th.equal(part, same) for part, same in zip(batch, wanted, strict=True))
    with pytest.raises(ValueError, match=f"it has rollouts of {STEPS} decisions, not of 7"):
        other.restore(notebook.tensors(), 7)


def test_what_is_kept_is_not_forgotten() -> None:
    """After a second lesson the error on the first is small only if its rollouts are kept.

    Keeping 20 rollouts leaves less than 0.2 of the error that keeping 1 does.
    """
    left = {}
    for kept in (1, 20):
        model = learner(Apprentice, TaughtPolicy, kept=kept)
        model.learn(1)
        rng, rollout = np.random.default_rng(0), model.rollout_buffer
        lessons = []
        for sign in (1.0, -1.0):
            seen = rng.uniform(0.0, 1.0, (STEPS, ENVS, SEEN))
            taught = np.repeat(0.5 * seen[..., :1], NUM_ACTIONS, axis=2)
            price = np.zeros((STEPS, ENVS, GUIDANCE - NUM_ACTIONS))
            lessons.append(np.concatenate([sign * seen, taught, price], axis=2))
        for lesson in lessons:
            for _ in range(10):
                fill(rollout, lesson, 0.0)
                model.train()
        fill(rollout, lessons[0], 0.0)
        left[kept] = error(model)
    assert left[20] < 0.2 * left[1], left


def test_reinforcement_learning_goes_on_imitating_as_far_as_it_is_told_to() -> None:
    """Every action earns the same reward, so PPO alone has no reason to imitate the teacher."""
    errors = []
    for weight in (0.0, 1e4):  # multiplied by ent_coef
        model = learner(FastRecurrentPPO, TaughtPolicy)
        noise = model.policy.log_std.clone()
        model.policy.imitation_weight = weight
        model.learn(60 * STEPS * ENVS)
        errors.append(error(model))
        assert not th.equal(model.policy.log_std, noise)  # PPO trains the exploration noise
    assert errors[0] > 0.07 and errors[1] < 0.03, errors


def test_the_critic_learns_the_returns(apprentice) -> None:
    apprentice.learn(1)
    rollout, policy = apprentice.rollout_buffer, apprentice.policy
    rollout.returns[:] = np.arange(ENVS) - 0.5 * (ENVS - 1)  # by robot
    for _ in range(60):
        apprentice.train()
    batch = next(rollout.get(STEPS * ENVS))
    with th.no_grad():
        values, *_ = policy.evaluate_actions(
            batch.observations, batch.actions, batch.lstm_states, batch.episode_starts
        )
    off = (values.flatten() - batch.returns).square().mean() / batch.returns.square().mean()
    assert off < 0.5, off


def test_the_teachers_actions_are_not_seen(apprentice, tmp_path) -> None:
    policy = apprentice.policy
    obs = th.randn(ENVS, SEEN + GUIDANCE)
    other = th.cat([obs[:, :SEEN], th.randn(ENVS, GUIDANCE)], dim=1)
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


FREE = np.zeros((FREQUENCIES, LENGTHS))


def guidance(taught: float, price: np.ndarray) -> th.Tensor:
    """Guidance of one decision: ``taught`` for every action, the prices, and no second way."""
    parts = [np.full(NUM_ACTIONS, taught), np.zeros(len(WAY) + 1), price.ravel()]
    return th.tensor(np.concatenate(parts), dtype=th.float32)[None]


def test_between_two_ways_over_a_trench_a_student_takes_one() -> None:
    """The loss is least near one of two ways over a trench, not at their mean.

    Strides of low frequency with a long stance are free, and so are those of high frequency with a
    short stance; all others lead into the trench and cost 4. The teacher takes either way equally
    often. Without prices the loss is least at their mean, which is in the trench.
    """
    frequency, length = np.meshgrid(
        np.linspace(-1.0, 1.0, FREQUENCIES), np.linspace(-1.0, 1.0, LENGTHS), indexing="ij"
    )
    short = np.hypot(frequency + 0.5, length - 0.5) < 0.3
    long = np.hypot(frequency - 0.5, length + 0.5) < 0.3
    price = np.where(short | long, 0.0, 4.0)
    tried = np.linspace(-1.0, 1.0, 81)

    def least(asked: th.Tensor) -> tuple[float, float]:
        """Actions of frequency and stance length with the least mean loss."""
        mean = th.zeros(81, 81, len(asked), NUM_ACTIONS)
        mean[..., INDEX["frequency"]] = th.tensor(tried)[:, None, None]
        mean[..., INDEX["stance_length"]] = th.tensor(tried)[None, :, None]
        every = asked.expand(81, 81, *asked.shape).reshape(-1, GUIDANCE)
        loss = imitation_loss(mean.view(-1, NUM_ACTIONS), every, 1.0).view(81, 81, -1).mean(2)
        at = divmod(int(loss.argmin()), 81)
        return tried[at[0]], tried[at[1]]

    def both(price: np.ndarray) -> th.Tensor:
        asked = th.cat([guidance(0.0, price), guidance(0.0, price)])
        asked[:, INDEX["frequency"]] = th.tensor([-0.5, 0.5])
        asked[:, INDEX["stance_length"]] = th.tensor([0.5, -0.5])
        return asked

    assert least(both(FREE)) == pytest.approx((0.0, 0.0), abs=1e-9)
    chosen = least(both(price))
    assert min(math.dist(chosen, way) for way in ((-0.5, 0.5), (0.5, -0.5))) < 0.1


@pytest.mark.parametrize("limit", [1.0, 2.0])
def test_the_price_of_a_stride(limit: float) -> None:
    """Smoothing preserves constant and linear prices; actions are scaled by their limit."""
    along_f = th.linspace(0.0, 3.0, FREQUENCIES)[:, None].expand(FREQUENCIES, LENGTHS)
    along_l = th.linspace(0.0, 1.0, LENGTHS).expand(FREQUENCIES, LENGTHS)
    asked = limit * th.tensor([[0.25, -0.2]])

    def price(of: th.Tensor) -> float:
        return float(expected_price(asked, of[None], limit))

    assert price(th.full((FREQUENCIES, LENGTHS), 2.0)) == pytest.approx(2.0)
    assert price(along_f) == pytest.approx(3.0 * 0.625, abs=1e-3)
    assert price(along_l) == pytest.approx(0.4, abs=2e-3)
    assert price(along_f + along_l) == pytest.approx(3.0 * 0.625 + 0.4, abs=3e-3)


def test_between_two_ways_around_a_pillar_a_student_takes_one() -> None:
    """The loss is least at one of two ways around a pillar, not at their mean.

    The teacher goes left as often as right, and labels how much longer the other way is. A student
    that cannot tell which is shorter goes fully to one side instead of straight on between them.
    """
    side, turn = INDEX["vy"], INDEX["yaw_rate"]
    asked = th.cat([guidance(0.0, FREE), guidance(0.0, FREE)])
    way = th.tensor([0.8, -0.8])
    asked[:, side], asked[:, turn] = way, way
    for name, doubled in (("vx", 0.0), ("vy", -2.0), ("yaw_rate", -2.0)):
        asked[:, NUM_ACTIONS + WAY.index(INDEX[name])] = doubled * way
    asked[:, NUM_ACTIONS + len(WAY)] = dearer = 0.3

    def loss(to: float) -> th.Tensor:
        mean = th.zeros(2, NUM_ACTIONS)
        mean[:, [side, turn]] = to
        return imitation_loss(mean, asked, 1.0)

    expected = th.tensor([0.0, dearer]) / NUM_ACTIONS
    th.testing.assert_close(loss(0.8), expected)
    th.testing.assert_close(loss(-0.8), expected.flip(0))
    th.testing.assert_close(loss(0.0), th.full((2,), 2 * 0.8**2 / NUM_ACTIONS))
    th.testing.assert_close(loss(0.7)[0], th.tensor(2 * 0.1**2 / NUM_ACTIONS))
    tried = np.linspace(-1.0, 1.0, 81)
    best = tried[int(np.argmin([float(loss(to).mean()) for to in tried]))]
    assert abs(best) == pytest.approx(0.8, abs=0.03)


def test_without_a_price_it_is_the_mean_square() -> None:
    mean = th.full((1, NUM_ACTIONS), 0.3)
    assert float(imitation_loss(mean, guidance(0.1, FREE), 1.0)) == pytest.approx(0.04)


def test_a_decision_whose_stride_has_a_price_weighs_four_times_as_much() -> None:
    """The stride costs 10 times its price, here 2 everywhere, and 0.1 of its squared errors."""
    mean = th.full((1, NUM_ACTIONS), 0.3)
    loss = imitation_loss(mean, guidance(0.1, np.full_like(FREE, 2.0)), 1.0)
    others, stride = (NUM_ACTIONS - 2) * 0.04, 2 * 0.1 * 0.04 + 10.0 * 2.0
    assert float(loss) == pytest.approx(4.0 * (others + stride) / NUM_ACTIONS)
