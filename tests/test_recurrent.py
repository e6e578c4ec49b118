"""The fast recurrent learner against sb3-contrib's own: same outputs, gradients and training."""

import functools

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from sb3_contrib.common.recurrent.type_aliases import RNNStates
from stable_baselines3.common.vec_env import DummyVecEnv
from torch import nn

from tdgc import policies
from tdgc.learn.recurrent import (
    FastRecurrentPolicy,
    FastRecurrentPPO,
    GaitNoise,
    actor_and_critic,
    adapted_share,
    exchange_memories,
    gait_entropy,
)
from tdgc.policies import Mirror
from tdgc.sim.commands import CommandDecoder

OBS, ACT, HIDDEN = 6, 2, 16
ENVS, STEPS = 5, 12

pytestmark = pytest.mark.usefixtures("one_thread")


class MemoryEnv(gym.Env):
    """Rewards repeating the previous observation; episodes end or are truncated at random."""

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


def make_model(policy, batch_size: int = 24, **kwargs) -> FastRecurrentPPO:
    """Make a learner, by default with two minibatches, of three environments and of two."""
    env = DummyVecEnv([lambda i=i: MemoryEnv(i) for i in range(ENVS)])
    policy_kwargs = {
        "lstm_hidden_size": HIDDEN, "net_arch": [8], "optimizer_kwargs": {"fused": True},
        **kwargs.pop("policy_kwargs", {}),
    }  # fmt: skip
    defaults = {"n_epochs": 3, "learning_rate": 3e-3, "seed": 3, "device": "cpu"}
    return FastRecurrentPPO(
        policy,
        env,
        n_steps=STEPS,
        batch_size=batch_size,
        policy_kwargs=policy_kwargs,
        **{**defaults, **kwargs},
    )


def gradients(policy: nn.Module) -> dict[str, th.Tensor]:
    return {n: p.grad.clone() for n, p in policy.named_parameters() if p.grad is not None}


def assert_close(got: dict[str, th.Tensor], want: dict[str, th.Tensor], tolerance: float) -> None:
    assert set(got) == set(want)
    for name in want:
        error = (got[name] - want[name]).abs().max()
        assert error <= tolerance * (1.0 + want[name].abs().max()), name


def test_parameters_are_the_stock_policys():
    fast, stock = make_model(FastRecurrentPolicy).policy, make_model("MlpLstmPolicy").policy
    assert fast.state_dict().keys() == stock.state_dict().keys()
    assert all(th.equal(a, stock.state_dict()[n]) for n, a in fast.state_dict().items())
    groups = [p.optimizer.param_groups[0] for p in (fast, stock)]
    assert groups[0]["eps"] == groups[1]["eps"] == 1e-8
    assert groups[0]["lr"] == groups[1]["lr"]


def test_outputs_and_gradients_on_rollouts():
    """They equal the stock policy's on all minibatches of a rollout with starts anywhere in it."""
    model, stock = make_model(FastRecurrentPolicy), make_model("MlpLstmPolicy").policy
    model.learn(3 * ENVS * STEPS)
    stock.load_state_dict(model.policy.state_dict())
    starts = th.zeros(STEPS)
    for batch in model.rollout_buffer.get(24):
        assert batch.lstm_states.pi[0].abs().max() > 0.01  # the rollout continues an earlier one
        results = []
        for policy in (model.policy, stock):
            policy.zero_grad()
            values, log_prob, entropy = policy.evaluate_actions(
                batch.observations, batch.actions, batch.lstm_states, batch.episode_starts
            )
            (values.flatten() * batch.returns + log_prob * batch.advantages).sum().backward()
            tensors = {"values": values, "log_prob": log_prob, "entropy": entropy}
            results.append(tensors | gradients(policy))
        assert_close(results[0], results[1], 5e-6)
        starts += batch.episode_starts.view(-1, STEPS).sum(0)
    assert starts[0] >= 1 and (starts[1:] > 0).sum() >= 4


def test_an_episode_starts_from_nothing():
    """Without the stock policy: within a rollout, an episode is evaluated as if on its own."""
    policy = make_model(FastRecurrentPolicy).policy
    generator = th.Generator().manual_seed(1)
    obs = th.randn(3, 5, OBS, generator=generator)
    actions = th.randn(3, 5, ACT, generator=generator)
    before = [th.randn(1, 3, HIDDEN, generator=generator) for _ in range(4)]
    starts = th.zeros(3, 5)
    starts[0, 0] = starts[1, 3] = 1.0

    def evaluate(rows: slice, steps: slice, states: list[th.Tensor], starts: th.Tensor):
        with th.no_grad():
            values, log_prob, _ = policy.evaluate_actions(
                obs[rows, steps].flatten(0, 1), actions[rows, steps].flatten(0, 1),
                RNNStates((states[0], states[1]), (states[2], states[3])),
                starts[rows, steps].flatten(),
            )  # fmt: skip
        return th.stack((values.flatten(), log_prob)).view(2, starts[rows].shape[0], -1)

    whole = evaluate(slice(3), slice(5), before, starts)
    zeros = [th.zeros(1, 1, HIDDEN)] * 4
    for row, first in ((0, 0), (1, 3)):
        alone = evaluate(slice(row, row + 1), slice(first, 5), zeros, th.zeros(3, 5))
        assert (whole[:, row, first:] - alone[:, 0]).abs().max() < 1e-6
    # Without an episode start, the initial states matter to the end.
    without = evaluate(slice(2, 3), slice(5), zeros, starts)
    assert (whole[:, 2] - without[:, 0]).abs().amax(0).min() > 1e-3


def memories(robots: int) -> RNNStates:
    """Hidden states filled with i, i + 0.25, i + 0.5 and i + 0.75 for robot i."""
    whose = th.arange(robots).view(1, -1, 1).expand(1, robots, HIDDEN)
    h_pi, c_pi, h_vf, c_vf = (whose + part for part in (0.0, 0.25, 0.5, 0.75))
    return RNNStates((h_pi, c_pi), (h_vf, c_vf))


@pytest.mark.parametrize("untold", [None, 2])
def test_memories_are_exchanged_among_robots_that_are_told_nothing(untold):
    """The actor's hidden states move as a whole, none is lost, the expected number of them moves,
    and the critic's stay.

    That is half of those taking part, less the robots that get their own back: one per shuffle on
    average.
    """
    robots, rounds = 40, 200
    seen = np.zeros((robots, OBS), dtype=np.float32)
    seen[24:, 2] = 1.0
    taking_part = np.arange(robots) if untold is None else np.arange(24, robots)
    np.random.seed(1)
    moved = 0
    for _ in range(rounds):
        states = memories(robots)
        exchange_memories(states, seen, 0.5, untold)
        owner = states.pi[0][0, :, 0]
        for part, state in enumerate(states.pi):
            assert (state[0] == owner[:, None] + 0.25 * part).all()
        assert all(map(th.equal, states.vf, memories(robots).vf))
        assert sorted(owner.tolist()) == list(range(robots))
        others = np.flatnonzero(owner.numpy() != np.arange(robots))
        assert np.isin(others, taking_part).all()
        moved += len(others)
    assert moved / rounds == pytest.approx(len(taking_part) / 2 - 1, abs=1.0)


def test_an_exchange_comes_after_a_rollout_and_changes_none():
    """The next rollout starts from exchanged states, and this one is learned as collected."""
    exchange = functools.partial(exchange_memories, share=1.0)
    model = make_model(FastRecurrentPolicy, learning_rate=0.0, exchange=exchange)
    collected = []

    def remember(values: dict, _) -> bool:
        collected.append(values["lstm_states"].pi[0][0].numpy().copy())
        return True

    model.learn(2 * ENVS * STEPS, callback=remember)
    first = model.rollout_buffer.hidden_states_pi[0, 0]
    last = collected[STEPS - 1]  # after the first rollout
    assert not np.array_equal(first, last)
    assert np.array_equal(np.sort(first, axis=0), np.sort(last, axis=0))
    for batch in model.rollout_buffer.get(24):
        values, _, _ = model.policy.evaluate_actions(
            batch.observations, batch.actions, batch.lstm_states, batch.episode_starts
        )
        assert (values.flatten() - batch.old_values).abs().max() < 2e-6


@pytest.mark.parametrize(
    ("batch_size", "sizes"), [(60, [5]), (30, [3, 2]), (24, [3, 2]), (12, [1] * 5), (None, [5])]
)
def test_minibatches_are_whole_environments(batch_size, sizes):
    model = make_model("MlpLstmPolicy")
    model.learn(ENVS * STEPS)
    buffer = model.rollout_buffer
    whole = buffer.observations.swapaxes(0, 1)
    seen = []
    for batch, size in zip(buffer.get(batch_size), sizes, strict=True):
        assert batch.returns[batch.mask > 1e-8].shape == (size * STEPS,)  # nothing is masked
        for k, rollout in enumerate(batch.observations.view(size, STEPS, OBS).numpy()):
            (env,) = np.flatnonzero((whole == rollout).all((1, 2)))
            seen.append(env)
            rows = slice(k * STEPS, (k + 1) * STEPS)
            assert np.array_equal(batch.returns[rows], buffer.returns[:, env])
            assert np.array_equal(batch.episode_starts[rows], buffer.episode_starts[:, env])
            assert np.array_equal(batch.actions[rows], buffer.actions[:, env])
            assert np.array_equal(batch.lstm_states.vf[1][:, k], buffer.cell_states_vf[0][:, env])
    assert sorted(seen) == list(range(ENVS))


def test_order_of_environments_is_drawn_from_numpys_generator():
    buffer = make_model("MlpLstmPolicy").rollout_buffer

    def order(seed: int) -> list[int]:
        np.random.seed(seed)
        return [int(b.observations[0, 0]) for _ in range(4) for b in buffer.get(STEPS)]

    buffer.observations[:] = np.arange(ENVS)[:, None]
    assert order(0) == order(0) != order(1)
    assert order(0)[:ENVS] != order(0)[ENVS : 2 * ENVS]


def gradient_norm(parameters: list[nn.Parameter]) -> float:
    return float(th.cat([p.grad.flatten() for p in parameters]).norm())


def test_only_the_actors_gradient_is_clipped():
    """However large the critic's gradient is, the actor's is scaled to its own limit only."""
    model = make_model(FastRecurrentPolicy, max_grad_norm=0.5)
    actor, critic = actor_and_critic(model.policy)
    assert len(actor) == 1 + 4 + 2 + 2 and len(critic) == 4 + 2 + 2

    for size, limited in ((1e-3, False), (0.1, True)):
        for p in actor:
            p.grad = th.full_like(p, size)
        for p in critic:
            p.grad = th.full_like(p, 100.0)
        before = gradient_norm(actor)
        assert (before > 0.5) == limited
        model.policy.optimizer.step()
        assert gradient_norm(actor) == pytest.approx(0.5 if limited else before, rel=1e-5)
        assert all((p.grad == 100.0).all() for p in critic)


def test_training_clips_nothing_else():
    """SB3's own clipping of both networks' gradient at once is off."""
    norms = []

    def note(optimizer: th.optim.Optimizer, *_: object) -> None:
        norms.append([gradient_norm(part) for part in parts])

    model = make_model(FastRecurrentPolicy, max_grad_norm=0.05, vf_coef=1000.0)
    parts = actor_and_critic(model.policy)
    model.policy.optimizer.register_step_pre_hook(note)
    model.learn(ENVS * STEPS)
    of_actor, of_critic = np.array(norms).T
    np.testing.assert_allclose(of_actor, 0.05, rtol=1e-4)
    assert of_critic.min() > 100.0


@pytest.mark.parametrize(
    ("share", "kl", "adapted"),
    [
        (0.3, 0.021, 0.2), (0.3, 0.019, 0.3), (0.3, 0.0051, 0.3), (0.3, 0.0049, 0.45),
        (0.011, 0.5, 0.01), (0.9, 0.0, 1.0),
    ],
)  # fmt: skip
def test_the_actors_share_of_the_learning_rate_follows_the_kl_divergence(share, kl, adapted):
    assert adapted_share(share, kl, 0.01) == pytest.approx(adapted)


@pytest.mark.parametrize(("desired", "share"), [(1e-9, 1.5**-2), (1e9, 1.0), (None, 1.0)])
def test_only_the_actors_learning_rate_is_adapted(desired, share):
    """The last of three updates is made at the share that the two before it left."""
    model = make_model(FastRecurrentPolicy, learning_rate=3e-4, desired_kl=desired)
    model.learn(3 * ENVS * STEPS)
    actor, critic = (group["lr"] for group in model.policy.optimizer.param_groups)
    assert actor == pytest.approx(share * 3e-4)
    assert critic == 3e-4


def test_training_ends_at_the_same_weights():
    trained = []
    for policy in (FastRecurrentPolicy, "MlpLstmPolicy"):
        model = make_model(policy)  # inside the loop, as it seeds torch and numpy
        start = {name: t.clone() for name, t in model.policy.state_dict().items()}
        trained.append(dict(model.learn(3 * ENVS * STEPS).policy.state_dict()))
    fast, stock = trained
    assert_close(fast, stock, 1e-4)
    assert min((fast[name] - start[name]).abs().max() for name in start) > 1e-3  # it did train


@pytest.mark.parametrize(
    "variant",
    [
        {"n_lstm_layers": 2},
        {"lstm_kwargs": {"bias": False}},
        {"enable_critic_lstm": False},
        {"enable_critic_lstm": False, "shared_lstm": True},
        {"share_features_extractor": False},
    ],
    ids=lambda v: "-".join(v),
)
def test_other_lstms_are_refused(variant):
    with pytest.raises(ValueError, match=r"^FastRecurrentPolicy has plain LSTMs of one layer, one"):
        make_model(FastRecurrentPolicy, policy_kwargs=variant)


def test_other_distributions_are_refused():
    with pytest.raises(ValueError, match=r"^FastRecurrentPolicy has normally distributed actions"):
        make_model(FastRecurrentPolicy, use_sde=True)


def test_a_minibatch_below_one_rollout_is_refused():
    with pytest.raises(ValueError, match=r"^a minibatch of 11 steps does not hold the 12 of one"):
        make_model(FastRecurrentPolicy, batch_size=11)


# ------------------------------------------------------------------ left and right

#: Observation: two left-right pairs, the second negated when swapped, an entry that a mirror keeps
#: and one that it negates; one action of each of the last two kinds.
MIRROR = Mirror((1, 0, 3, 2, 4, 5), (1.0, 1.0, -1.0, -1.0, 1.0, -1.0), (0, 1), (1.0, -1.0))


def run_through(policy, observations: np.ndarray, starts: np.ndarray) -> tuple[th.Tensor, ...]:
    """Mean actions and values for (STEPS, ENVS, OBS), step by step, passing hidden states on."""
    size = policy.lstm_actor.hidden_size
    zeros = (th.zeros(1, ENVS, size), th.zeros(1, ENVS, size))
    states, actions, values = RNNStates(zeros, zeros), [], []
    for seen, start in zip(observations, starts, strict=True):
        seen, start = th.as_tensor(seen), th.as_tensor(start)
        with th.no_grad():
            action, value, _, states = policy(seen, states, start, deterministic=True)
        actions.append(action)
        values.append(value)
    return th.stack(actions), th.stack(values)


def act_alike(loaded, seen: np.ndarray, starts: np.ndarray, wanted: th.Tensor):
    """Check that a loaded policy acts as ``run_through`` found; return its last hidden state."""
    state = None
    for row, start, action in zip(seen, starts, wanted, strict=True):
        given, state = loaded.predict(row, state, start)
        np.testing.assert_allclose(given, action.clamp(-2.0, 2.0), atol=1e-6)
    return state


def test_a_mirrored_policy_is_symmetric_and_learning_keeps_it_so():
    rng = np.random.default_rng(0)
    seen = rng.normal(size=(STEPS, ENVS, OBS)).astype(np.float32)
    starts = (rng.random((STEPS, ENVS)) < 0.2).astype(np.float32)
    image = seen[..., list(MIRROR.obs_index)] * np.float32(MIRROR.obs_sign)
    model = make_model(FastRecurrentPolicy, policy_kwargs={"mirror": MIRROR})
    before = [p.clone() for p in model.policy.parameters()]
    for _ in range(2):
        actions, values = run_through(model.policy, seen, starts)
        mirrored, same = run_through(model.policy, image, starts)
        th.testing.assert_close(mirrored, actions * th.tensor([1.0, -1.0]))
        th.testing.assert_close(same, values)
        assert actions.std() > 1e-4 and (mirrored - actions).abs().max() > 1e-4
        model.learn(2 * STEPS * ENVS)
    after = list(model.policy.parameters())
    assert all((a != b).any() for a, b in zip(after, before, strict=True))


def test_a_mirrored_policy_acts_from_its_file_as_it_was_trained(tmp_path):
    rng = np.random.default_rng(1)
    seen = rng.normal(size=(STEPS, ENVS, OBS)).astype(np.float32)
    starts = (rng.random((STEPS, ENVS)) < 0.2).astype(np.float32)
    policy = make_model(FastRecurrentPolicy, policy_kwargs={"mirror": MIRROR}).policy
    wanted, _ = run_through(policy, seen, starts)
    policies.save(tmp_path / "policy", policy, {})
    loaded = policies.load(tmp_path / "policy")
    state = act_alike(loaded, seen, starts, wanted)
    assert state[0].shape == (1, ENVS, 2 * HIDDEN)
    with pytest.raises(ValueError, match=rf"it must be two of \(1, 5, {2 * HIDDEN}\)"):
        loaded.predict(seen[0], (np.zeros((1, 5, HIDDEN)),) * 2)


# ------------------------------------------------------------------ no memory

FORWARD = {"lstm_hidden_size": None}


@pytest.mark.parametrize("mirror", [None, MIRROR], ids=["plain", "mirrored"])
def test_a_feed_forward_policy_remembers_nothing_and_learns(mirror, tmp_path):
    rng = np.random.default_rng(2)
    seen = rng.normal(size=(STEPS, ENVS, OBS)).astype(np.float32)
    starts = np.zeros((STEPS, ENVS), dtype=np.float32)
    model = make_model(FastRecurrentPolicy, policy_kwargs={**FORWARD, "mirror": mirror})
    sizes = {name: tuple(p.shape) for name, p in model.policy.named_parameters()}
    assert not [name for name in sizes if "lstm" in name]
    held = {p for group in model.policy.optimizer.param_groups for p in group["params"]}
    assert held == set(model.policy.parameters())
    before = [p.clone() for p in model.policy.parameters()]
    model.learn(3 * ENVS * STEPS)
    assert all((a != b).any() for a, b in zip(model.policy.parameters(), before, strict=True))
    actions, values = run_through(model.policy, seen, starts)
    backwards, same = run_through(model.policy, seen[::-1].copy(), starts)
    th.testing.assert_close(backwards.flip(0), actions)
    th.testing.assert_close(same.flip(0), values)
    assert actions.std() > 1e-2
    policies.save(tmp_path / "policy", model.policy, {})
    loaded = policies.load(tmp_path / "policy")
    assert (loaded.kind, loaded.header.lstm, loaded.header.actor) == ("mlp", None, (8,))
    given, state = loaded.predict(seen[0])
    np.testing.assert_allclose(given, actions[0].clamp(-2.0, 2.0), atol=1e-6)
    assert state is None
    other = make_model(FastRecurrentPolicy, policy_kwargs={**FORWARD, "mirror": mirror}).policy
    policies.load_into(tmp_path / "policy", other)
    th.testing.assert_close(run_through(other, seen, starts)[0], actions)


# ------------------------------------------------------------------ exploring gaits


def test_noise_of_the_gait_is_held_within_an_episode():
    """The mean action is always 0 here, so that the actions are the noise."""
    gait = {"gait": GaitNoise(ENVS, 4, hold=5)}
    model = make_model(FastRecurrentPolicy, learning_rate=0.0, policy_kwargs=gait)
    with th.no_grad():
        model.policy.action_net.weight.zero_()
    model.learn(ENVS * STEPS)
    first = model.rollout_buffer.actions.copy()
    model.learn(ENVS * STEPS, reset_num_timesteps=False)
    buffer = model.rollout_buffer
    actions = np.concatenate([first, buffer.actions])
    assert (np.diff(actions[:, :, 0], axis=0) != 0.0).all()
    changed = np.diff(buffer.actions[:, :, -1], axis=0) != 0.0
    starts = buffer.episode_starts[1:] > 0.0
    assert starts.any() and changed[starts].all()
    for env in range(ENVS):  # runs of one value: five long, less if an episode starts
        ends = np.flatnonzero(changed[:, env])
        runs = np.diff(ends)
        whole = ~starts[ends[1:], env]
        assert (runs <= 5).all() and (runs[whole] == 5).all()
    batch = next(buffer.get(ENVS * STEPS))
    _, log_prob, _ = model.policy.evaluate_actions(
        batch.observations, batch.actions, batch.lstm_states, batch.episode_starts
    )
    assert (log_prob - batch.old_log_prob).abs().max() < 1e-5
    assert model.policy.state_dict()["held"].shape == (2, ENVS)
    assert len(np.unique(actions[:, :, -1])) < 0.4 * 2 * ENVS * STEPS


def test_noise_that_is_not_held_is_the_stock_policys():
    drawn = []
    for kwargs in ({}, {"gait": GaitNoise(ENVS, 4)}):
        model = make_model(FastRecurrentPolicy, policy_kwargs=kwargs)
        model.learn(ENVS * STEPS)
        drawn.append(model.rollout_buffer.actions)
        assert "held" not in model.policy.state_dict()
    assert np.array_equal(*drawn)


@pytest.mark.parametrize(("mean", "std"), [(-1.5, 0.8), (0.2, 0.5), (-3.0, 0.3), (0.0, 5.0)])
def test_entropy_of_the_gait_is_that_of_the_decoders_choice(mean, std):
    decoder, rng = CommandDecoder(action_limit=2.0), np.random.default_rng(0)
    actions = np.zeros((100_000, 13))
    actions[:, -1] = rng.normal(mean, std, len(actions))
    share = np.bincount(decoder.gait(actions), minlength=4) / len(actions)
    expected = -(share[share > 0.0] * np.log(share[share > 0.0])).sum()
    found = gait_entropy(th.tensor([mean]), th.tensor(std), 2.0, 4)
    assert found.item() == pytest.approx(expected, abs=0.01)


def test_a_bonus_on_the_gaits_entropy_falls_to_nothing():
    kwargs = {"policy_kwargs": {"gait": GaitNoise(ENVS, 4)}, "ent_coef": 0.01}
    model = make_model(FastRecurrentPolicy, gait_ent_coef=0.04, **kwargs)
    policy = model.policy
    bonuses = {}

    def keep(remaining: float) -> float:  # each update asks for its rate
        bonuses[remaining] = policy.gait_bonus
        return 3e-3

    model.lr_schedule = keep
    model.learn(4 * ENVS * STEPS)
    assert bonuses == pytest.approx({0.75: 3.0, 0.5: 2.0, 0.25: 1.0, 0.0: 0.0})
    batch = next(model.rollout_buffer.get(ENVS * STEPS))
    inputs = batch.observations, batch.actions, batch.lstm_states, batch.episode_starts
    with th.no_grad():
        *_, without = policy.evaluate_actions(*inputs)
        policy.gait_bonus = 2.0
        *_, with_bonus = policy.evaluate_actions(*inputs)
    assert 0.0 < (with_bonus - without).min() and (with_bonus - without).max() < 2.0 * np.log(4.0)
    # It keeps gaits in use: maximised alone, it spreads a channel that was sure of the first gait.
    mean, log_std = th.full((1,), -1.5, requires_grad=True), th.tensor(-1.0, requires_grad=True)
    optimiser = th.optim.Adam([mean, log_std], lr=0.05)
    for _ in range(100):
        optimiser.zero_grad()
        (-gait_entropy(mean, log_std.exp(), 2.0, 4).sum()).backward()
        optimiser.step()
    assert gait_entropy(mean, log_std.exp(), 2.0, 4).item() > 0.95 * np.log(4.0)


# ------------------------------------------------------------------ an encoder before the memory

ENCODED = {"encoder": (7, 5)}


@pytest.mark.parametrize("mirror", [None, MIRROR], ids=["plain", "mirrored"])
def test_an_encoder_learns_and_acts_from_its_file_as_it_was_trained(mirror, tmp_path):
    rng = np.random.default_rng(3)
    seen = rng.normal(size=(STEPS, ENVS, OBS)).astype(np.float32)
    starts = (rng.random((STEPS, ENVS)) < 0.2).astype(np.float32)
    model = make_model(FastRecurrentPolicy, policy_kwargs={**ENCODED, "mirror": mirror})
    held = {p for group in model.policy.optimizer.param_groups for p in group["params"]}
    assert held == set(model.policy.parameters())
    before = [p.clone() for p in model.policy.parameters()]
    model.learn(2 * ENVS * STEPS)
    assert all((a != b).any() for a, b in zip(model.policy.parameters(), before, strict=True))
    wanted, values = run_through(model.policy, seen, starts)
    if mirror is not None:
        image = seen[..., list(MIRROR.obs_index)] * np.float32(MIRROR.obs_sign)
        mirrored, same = run_through(model.policy, image, starts)
        th.testing.assert_close(mirrored, wanted * th.tensor([1.0, -1.0]))
        th.testing.assert_close(same, values)
    policies.save(tmp_path / "policy", model.policy, {})
    loaded = policies.load(tmp_path / "policy")
    assert (loaded.kind, loaded.header.lstm, loaded.header.encoder) == ("lstm", HIDDEN, (7, 5))
    # The head takes the LSTM's hidden state and then the encoder's 5 outputs.
    assert loaded.tensors["actor.0.weight"].shape[1] == HIDDEN + 5
    act_alike(loaded, seen, starts, wanted)
    other = make_model(FastRecurrentPolicy, policy_kwargs={**ENCODED, "mirror": mirror}).policy
    policies.load_into(tmp_path / "policy", other)
    th.testing.assert_close(run_through(other, seen, starts)[0], wanted)
    bare = make_model(FastRecurrentPolicy, policy_kwargs={"mirror": mirror}).policy
    with pytest.raises(policies.PolicyFileError, match=r"encoder is \(7, 5\), this policy's \(\)"):
        policies.load_into(tmp_path / "policy", bare)


def test_what_is_encoded_goes_past_the_memory():
    """With an LSTM of zero weights, the policy still reacts to what it sees."""
    policy = make_model(FastRecurrentPolicy, policy_kwargs=ENCODED).policy
    with th.no_grad():
        for parameter in policy.lstm_actor.lstm.parameters():
            parameter.zero_()
    seen = np.random.default_rng(4).normal(size=(STEPS, ENVS, OBS)).astype(np.float32)
    actions, _ = run_through(policy, seen, np.zeros((STEPS, ENVS), dtype=np.float32))
    assert actions.std() > 1e-3


def test_an_encoder_needs_a_memory():
    with pytest.raises(ValueError, match=r"^an encoder stands before LSTMs"):
        make_model(FastRecurrentPolicy, policy_kwargs={**ENCODED, **FORWARD})


@pytest.mark.parametrize("kind", [{}, FORWARD, ENCODED], ids=["plain", "feed-forward", "encoded"])
def test_a_rollout_is_evaluated_as_it_was_collected(kind):
    """Until a parameter changes, the update gets the values and probabilities of the rollout."""
    model = make_model(FastRecurrentPolicy, learning_rate=0.0, policy_kwargs=kind)
    model.learn(2 * ENVS * STEPS)
    for batch in model.rollout_buffer.get(24):
        values, log_prob, _ = model.policy.evaluate_actions(
            batch.observations, batch.actions, batch.lstm_states, batch.episode_starts
        )
        assert (values.flatten() - batch.old_values).abs().max() < 2e-6
        assert (log_prob - batch.old_log_prob).abs().max() < 1e-5
