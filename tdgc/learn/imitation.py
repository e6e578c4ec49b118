"""Imitation of the scripted teacher, before reinforcement learning takes over.

The apprentice acts, the teacher labels every decision with what it would have done, and the
recurrent policy learns to predict these labels from its own observations. This is DAgger (Ross et
al. 2011), with a teacher that knows more than its student (Chen et al. 2019, "Learning by
cheating"). The teacher itself drives a share of the episodes that falls to zero over the first part
of the imitation, see ``NavigationTask``.

For a leap the teacher also gives the cost of each step frequency with each stance length, and the
policy learns to choose the cheapest (Ross and Bagnell 2014, AggreVaTe). With the teacher's own
choice as the only target, it learned the mean of two ways over a trench, which leads into the
trench. For the same reason the teacher labels both ways around an obstacle, and only the error to
the nearer one counts: a policy that learns their mean stands still in front of it.

The critic learns the returns of these episodes, so that PPO continues with a critic that knows the
policy.
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
from tdgc.sim.commands import NUM_ACTIONS
from tdgc.tasks.high_observation import GUIDANCE, GUIDANCE_PARTS
from tdgc.tasks.leaps import FREQUENCIES, LENGTHS, STRIDE_COMMANDS
from tdgc.tasks.teacher import WAY

# Weights, as in the comparisons of docs/experiments.md: of a stride's price against a squared error
# in the action; of the squared error of a stride that has a price; and of a decision whose stride
# has a price against other decisions. An error in such a decision leads into a trench, whereas most
# errors elsewhere are forgiven.
_PRICE_WEIGHT, _PRICED, _LEAP_WEIGHT = 10.0, 0.1, 4.0
# Weight of each extra metre of the second way around against a squared error. A detour then costs
# much less than taking neither way, which costs 1 or more because the ways are at least 1 m/s apart
# in ranges of 1.2 and 2.2 m/s.
_DEARER = 1.0
_NOTES = "notebook."  # prefix of the names in a checkpoint


class TaughtPolicy(FastRecurrentPolicy):
    """``FastRecurrentPolicy`` whose observations end with the teacher's guidance.

    Only the loss uses the guidance; the networks do not see it.

    Attributes:
        seen: width of the observation without the guidance.
        imitation_weight: of ``imitation_loss`` against the entropy, in reinforcement learning.
    """

    def __init__(self, observation_space: spaces.Box, *args: Any, **kwargs: Any) -> None:
        self.seen = observation_space.shape[0] - GUIDANCE
        self.imitation_weight = 0.0
        own = spaces.Box(observation_space.low[: self.seen], observation_space.high[: self.seen])
        super().__init__(own, *args, **kwargs)

    def error(self, obs: th.Tensor, mean: th.Tensor) -> th.Tensor:
        """``imitation_loss`` of the mean actions ``mean`` (n, 13) at observations ``obs``, (n,)."""
        limit = float(cast(spaces.Box, self.action_space).high[STRIDE_COMMANDS[0]])
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


def expected_price(stride: th.Tensor, price: th.Tensor, limit: float) -> th.Tensor:
    """Smoothed price of strides, (n,).

    Args:
        stride: (n, 2) actions of frequency and stance length, from -limit to limit.
        price: (n, FREQUENCIES, LENGTHS) on an even grid over the same range. It is averaged over
            about two grid steps either way, so that its slope is felt from afar.
        limit: of the actions.
    """
    for action, count in ((stride[:, 0], FREQUENCIES), (stride[:, 1], LENGTHS)):
        grid = th.linspace(-limit, limit, count, device=price.device)
        step = 2.0 * limit / (count - 1)
        near = th.softmax(-0.5 * ((grid - action[:, None]) / step).square(), dim=1)
        price = th.einsum("nf,nf...->n...", near, price)
    return price


def imitation_loss(mean: th.Tensor, guidance: th.Tensor, limit: float) -> th.Tensor:
    """Imitation cost of actions ``mean`` (n, 13) against ``guidance`` (n, GUIDANCE), (n,)."""
    taught, aside, dearer, price = th.split(guidance, list(GUIDANCE_PARTS.values()), dim=1)
    error = (mean - taught).square()
    weight, priced = th.ones_like(error), price.amax(1) > 0.0
    weight[:, STRIDE_COMMANDS] = th.where(priced, _PRICED, 1.0)[:, None]
    other = (mean[:, WAY] - taught[:, WAY] - aside).square().sum(1) + _DEARER * dearer[:, 0]
    saved = (error[:, WAY].sum(1) - other).clamp(min=0.0)  # by taking the second way around
    cost = expected_price(mean[:, STRIDE_COMMANDS], price.view(-1, FREQUENCIES, LENGTHS), limit)
    loss = ((weight * error).sum(1) - saved + _PRICE_WEIGHT * cost) / NUM_ACTIONS
    return th.where(priced, _LEAP_WEIGHT, 1.0) * loss


class Lessons(NamedTuple):
    """Rollouts of ``n`` robots over ``steps`` decisions, one sequence per robot.

    Attributes:
        observations: (n, steps, size) with the teacher's guidance, float16.
        starts: (n, steps), 1 where an episode begins.
        returns: (n, steps).
        memories: (4, n, hidden), h and c of the actor and the critic before the first decision.
    """

    observations: th.Tensor
    starts: th.Tensor
    returns: th.Tensor
    memories: th.Tensor


class Notebook:
    """The latest rollouts, so that what is learned from one is not forgotten over the next.

    A sequence starts with the hidden state that the apprentice had when it acted, although its
    current parameters might give another (Kapturowski et al. 2019, R2D2, "stored state").

    Args:
        kept: number of rollouts to keep.
    """

    def __init__(self, kept: int) -> None:
        self._rollouts: deque[Lessons] = deque(maxlen=kept)

    def add(self, rollout: WholeEnvBuffer) -> None:
        """Add a rollout; beyond ``kept`` rollouts the oldest is dropped."""
        observations, starts, returns = (
            rollout.by_env(array)
            for array in (rollout.observations, rollout.episode_starts, rollout.returns)
        )
        memories = rollout.first_memories()[:, 0]
        lessons = (observations.half(), starts, returns, memories)
        # On the CPU, where those of a checkpoint are.
        self._rollouts.append(Lessons(*(tensor.cpu() for tensor in lessons)))

    def batches(self, count: int) -> Iterator[Lessons]:
        """Yield ``count`` minibatches: each robot once, in random order, from a random rollout."""
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
        """All kept rollouts as named tensors, for a checkpoint."""
        return {
            f"{_NOTES}{number}.{name}": tensor
            for number, lessons in enumerate(self._rollouts)
            for name, tensor in lessons._asdict().items()
        }

    def restore(self, tensors: Mapping[str, th.Tensor], steps: int) -> None:
        """Restore the rollouts from what ``tensors()`` gave; other names are ignored.

        Raises:
            ValueError: they are not of ``steps`` decisions, as the next ones will be.
        """
        self._rollouts.clear()
        number = 0
        while f"{_NOTES}{number}.returns" in tensors:
            parts = (tensors[f"{_NOTES}{number}.{name}"] for name in Lessons._fields)
            lessons = Lessons(*parts)
            kept = lessons.returns.shape[1]
            if kept != steps:
                raise ValueError(f"it has rollouts of {kept} decisions, not of {steps}")
            self._rollouts.append(lessons)
            number += 1


class Apprentice(FastRecurrentPPO):
    """``FastRecurrentPPO`` that imitates the teacher instead of improving its actions.

    Its loss does not depend on the exploration noise, which is kept for the exploration afterwards.

    Args:
        kept: number of newest rollouts that it learns from.
    """

    def __init__(self, *args: Any, kept: int = 1, **kwargs: Any) -> None:
        self.notebook = Notebook(kept)
        super().__init__(*args, **kwargs)

    def train(self) -> None:
        """Make one update on ``imitation_loss`` and the critic's squared error."""
        policy = cast(TaughtPolicy, self.policy)
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
                loss = imitation + self.vf_coef * value_loss
                loss.backward()  # type: ignore[no-untyped-call]
                policy.optimizer.step()
                losses.append(imitation.item())
                value_losses.append(value_loss.item())
        self._n_updates += self.n_epochs
        self.logger.record("train/imitation_loss", np.mean(losses))
        self.logger.record("train/value_loss", np.mean(value_losses))
