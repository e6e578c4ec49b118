"""Imitation of the scripted teacher, before reinforcement learning takes over.

The apprentice acts, the teacher says at every decision what it would have done, and the recurrent
policy learns to say so from its own observations: DAgger (Ross et al. 2011), with a teacher that
knows more than its student (Chen et al. 2019, "Learning by cheating"). Of a leap the teacher says
what each step frequency with each stance length would cost, and the policy learns the cheapest
(Ross and Bagnell 2014, AggreVaTe): with the teacher's choice itself as the only target it learned a
mean of two ways over a trench, which leads into it. For the same reason the teacher says both ways
around a pillar, and what counts is the error to the nearer one: the mean of both stands still in
front of it. The critic learns what these episodes return, so that PPO goes on with a critic that
knows the policy.
"""

from collections import deque
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple, cast

import numpy as np
import torch as th
from gymnasium import spaces
from sb3_contrib.common.recurrent.type_aliases import RNNStates
from torch import nn

from tdgc.learn.recurrent import FastRecurrentPolicy, FastRecurrentPPO, WholeEnvBuffer
from tdgc.sim.commands import INDEX, NUM_ACTIONS
from tdgc.tasks.high_observation import GUIDANCE, GUIDANCE_PARTS
from tdgc.tasks.leaps import FREQUENCIES, LENGTHS
from tdgc.tasks.teacher import WAY

_STRIDE = [INDEX["frequency"], INDEX["stance_length"]]
# As in the comparisons of docs/experiments.md: what a price weighs against a squared error in the
# action, what is left of that error of a stride that has a price, and what a decision whose stride
# has one weighs against others: an error in it leads into a trench, elsewhere most are forgiven.
_PRICE_WEIGHT, _PRICED, _LEAP_WEIGHT = 10.0, 0.1, 4.0
# What a metre more on the second way around weighs against a squared error: much less than taking
# neither, which is 1 or more, as the ways are 1 m/s and more apart in ranges of 1.2 and 2.2 m/s.
_DEARER = 1.0
_NOTES = "notebook."  # what names in a checkpoint begin with


class TaughtPolicy(FastRecurrentPolicy):
    """``FastRecurrentPolicy`` on observations that the teacher's guidance follows, unseen.

    Attributes:
        imitation_weight: of ``imitation_loss`` against the entropy, in reinforcement learning.
    """

    def __init__(self, observation_space: spaces.Box, *args: Any, **kwargs: Any) -> None:
        self.seen = observation_space.shape[0] - GUIDANCE
        self.imitation_weight = 0.0
        own = spaces.Box(observation_space.low[: self.seen], observation_space.high[: self.seen])
        super().__init__(own, *args, **kwargs)

    def error(self, obs: th.Tensor, mean: th.Tensor) -> th.Tensor:
        """``imitation_loss`` of the mean actions ``mean`` (n, 13) taken at ``obs``, (n,)."""
        limit = float(cast(spaces.Box, self.action_space).high[_STRIDE[0]])
        return imitation_loss(mean, obs[..., self.seen :], limit)

    def bonus(self, obs: th.Tensor, mean: th.Tensor) -> th.Tensor:
        return super().bonus(obs, mean) - self.imitation_weight * self.error(obs, mean)

    def forward(self, obs: th.Tensor, *args: Any, **kwargs: Any) -> Any:
        return super().forward(obs[..., : self.seen], *args, **kwargs)

    def obs_to_tensor(self, observation: Any) -> tuple[Any, bool]:
        return super().obs_to_tensor(observation[..., : self.seen])

    def predict_values(self, obs: th.Tensor, *args: Any) -> th.Tensor:  # type: ignore[override]
        return super().predict_values(obs[..., : self.seen], *args)

    def unroll(self, obs: th.Tensor, *args: Any) -> tuple[th.Tensor, th.Tensor]:
        return super().unroll(obs[..., : self.seen], *args)


class ApprenticePolicy(TaughtPolicy):
    """A ``TaughtPolicy`` that learns nothing but what it is taught."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        # Gradients of squared errors of actions are below SB3's eps of 1e-5 in the end.
        super().__init__(*args, optimizer_kwargs={"eps": 1e-8, "fused": True}, **kwargs)
        self.log_std.requires_grad_(False)  # what exploration is to begin with


def expected_price(stride: th.Tensor, price: th.Tensor, limit: float) -> th.Tensor:
    """Price of strides (n, 2), the actions of frequency and stance length, (n,).

    Args:
        stride: from -limit to limit.
        price: (n, FREQUENCIES, LENGTHS) at even steps between these; what counts is a mean over
            about two steps each way, so that the slope is felt from afar.
        limit: of the actions.
    """
    for action, count in ((stride[:, 0], FREQUENCIES), (stride[:, 1], LENGTHS)):
        grid = th.linspace(-limit, limit, count, device=price.device)
        step = 2.0 * limit / (count - 1)
        near = th.softmax(-0.5 * ((grid - action[:, None]) / step).square(), dim=1)
        price = th.einsum("nf,nf...->n...", near, price)
    return price


def imitation_loss(mean: th.Tensor, guidance: th.Tensor, limit: float) -> th.Tensor:
    """How far actions (n, 13) are from what ``guidance`` (n, GUIDANCE) asks for, (n,)."""
    taught, aside, dearer, price = th.split(guidance, list(GUIDANCE_PARTS.values()), dim=1)
    error = (mean - taught).square()
    weight, priced = th.ones_like(error), price.amax(1) > 0.0
    weight[:, _STRIDE] = th.where(priced, _PRICED, 1.0)[:, None]
    other = (mean[:, WAY] - taught[:, WAY] - aside).square().sum(1) + _DEARER * dearer[:, 0]
    saved = (error[:, WAY].sum(1) - other).clamp(min=0.0)  # by the second way around
    cost = expected_price(mean[:, _STRIDE], price.view(-1, FREQUENCIES, LENGTHS), limit)
    loss = ((weight * error).sum(1) - saved + _PRICE_WEIGHT * cost) / NUM_ACTIONS
    return th.where(priced, _LEAP_WEIGHT, 1.0) * loss


class Lessons(NamedTuple):
    """Rollouts of ``n`` robots, ``steps`` decisions long, sequence by sequence.

    Attributes:
        observations: (n, steps, size) with the teacher's guidance, float16.
        starts: (n, steps), 1 where an episode begins.
        returns: (n, steps).
        memories: (4, n, hidden) before the first decision: h and c of the actor and the critic.
    """

    observations: th.Tensor
    starts: th.Tensor
    returns: th.Tensor
    memories: th.Tensor


class Notebook:
    """The last rollouts, so that what is learned from one is not forgotten over the next.

    A sequence starts with the memory that the apprentice had when it acted, though by now it might
    have another (Kapturowski et al. 2019, R2D2, "stored state").

    Args:
        kept: how many rollouts.
    """

    def __init__(self, kept: int) -> None:
        self._rollouts: deque[Lessons] = deque(maxlen=kept)

    def add(self, rollout: WholeEnvBuffer) -> None:
        """Keep a rollout, and drop the oldest of too many."""
        observations, starts, returns = (
            rollout.by_env(array)
            for array in (rollout.observations, rollout.episode_starts, rollout.returns)
        )
        memories = rollout.first_memories()[:, 0]
        self._rollouts.append(Lessons(observations.half(), starts, returns, memories))

    def batches(self, count: int) -> Iterator[Lessons]:
        """``count`` minibatches: each robot once, in random order and from any rollout."""
        robots = len(self._rollouts[0].returns)
        for drawn in np.array_split(np.random.permutation(robots), count):
            which = np.random.randint(len(self._rollouts), size=len(drawn))
            pages = [(self._rollouts[k], i) for k, i in zip(which, drawn, strict=True)]
            yield Lessons(
                th.stack([page.observations[i] for page, i in pages]),
                th.stack([page.starts[i] for page, i in pages]),
                th.stack([page.returns[i] for page, i in pages]),
                th.stack([page.memories[:, i] for page, i in pages], dim=1),
            )

    def tensors(self) -> dict[str, th.Tensor]:
        """All of it by name, for a checkpoint."""
        return {
            f"{_NOTES}{number}.{name}": tensor
            for number, lessons in enumerate(self._rollouts)
            for name, tensor in lessons._asdict().items()
        }

    def restore(self, tensors: Mapping[str, th.Tensor]) -> None:
        """What ``tensors`` gave; other names are passed over."""
        self._rollouts.clear()
        number = 0
        while f"{_NOTES}{number}.returns" in tensors:
            parts = (tensors[f"{_NOTES}{number}.{name}"] for name in Lessons._fields)
            self._rollouts.append(Lessons(*parts))
            number += 1


class Apprentice(FastRecurrentPPO):
    """``FastRecurrentPPO`` that learns what the teacher asks for instead of better actions.

    Args:
        kept: rollouts that it learns from, the newest ones.
    """

    def __init__(self, *args: Any, kept: int = 1, **kwargs: Any) -> None:
        self.notebook = Notebook(kept)
        super().__init__(*args, **kwargs)

    def train(self) -> None:
        """One update: ``imitation_loss``, and the critic's squared error."""
        policy = cast(ApprenticePolicy, self.policy)
        policy.set_training_mode(True)
        self._update_learning_rate(policy.optimizer)
        rollout = cast(WholeEnvBuffer, self.rollout_buffer)
        self.notebook.add(rollout)
        minibatches = rollout.buffer_size * rollout.n_envs // cast(int, self.batch_size)
        losses, value_losses = [], []
        for _ in range(self.n_epochs):
            for batch in self.notebook.batches(minibatches):
                observations, starts, returns = (
                    part.flatten(0, 1).to(self.device, th.float32) for part in batch[:3]
                )
                h_pi, c_pi, h_vf, c_vf = batch.memories.to(self.device)[:, None]
                memories = RNNStates((h_pi, c_pi), (h_vf, c_vf))
                mean, values = policy.unroll(observations, memories, starts)
                imitation = policy.error(observations, mean).mean()
                value_loss = nn.functional.mse_loss(values.flatten(), returns)
                policy.optimizer.zero_grad()
                imitation.backward()  # type: ignore[no-untyped-call]
                # The actor's gradient alone: the critic, which shares no parameter, has none yet.
                nn.utils.clip_grad_norm_(policy.parameters(), self.max_grad_norm)
                (self.vf_coef * value_loss).backward()  # type: ignore[no-untyped-call]
                policy.optimizer.step()
                losses.append(imitation.item())
                value_losses.append(value_loss.item())
        self._n_updates += self.n_epochs
        self.logger.record("train/imitation_loss", np.mean(losses))
        self.logger.record("train/value_loss", np.mean(value_losses))
