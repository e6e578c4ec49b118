"""Imitation of the scripted teacher, before reinforcement learning takes over.

The apprentice acts, the teacher says at every decision what it would have done, and the recurrent
policy learns to say so from its own observations: DAgger (Ross et al. 2011), with a teacher that
knows more than its student (Chen et al. 2019, "Learning by cheating"). The critic learns what these
episodes return, so that PPO goes on with a critic that knows the policy.
"""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import torch as th
from gymnasium import spaces
from torch import nn

from tdgc.learn.recurrent import FastRecurrentPolicy, FastRecurrentPPO
from tdgc.sim.commands import NUM_ACTIONS


class ApprenticePolicy(FastRecurrentPolicy):
    """``FastRecurrentPolicy`` on observations that the teacher's 13 actions follow, unseen."""

    def __init__(self, observation_space: spaces.Box, *args: Any, **kwargs: Any) -> None:
        self.seen = observation_space.shape[0] - NUM_ACTIONS
        own = spaces.Box(observation_space.low[: self.seen], observation_space.high[: self.seen])
        super().__init__(own, *args, **kwargs)
        # A likelihood of fixed width: the noise is what exploration is to begin with.
        self.log_std.requires_grad_(False)

    def forward(self, obs: th.Tensor, *args: Any, **kwargs: Any) -> Any:
        return super().forward(obs[..., : self.seen], *args, **kwargs)

    def obs_to_tensor(self, observation: Any) -> tuple[Any, bool]:
        return super().obs_to_tensor(observation[..., : self.seen])

    def predict_values(self, obs: th.Tensor, *args: Any) -> th.Tensor:  # type: ignore[override]
        return super().predict_values(obs[..., : self.seen], *args)

    def evaluate_actions(self, obs: th.Tensor, *args: Any) -> Any:  # type: ignore[override]
        return super().evaluate_actions(obs[..., : self.seen], *args)


class Apprentice(FastRecurrentPPO):
    """``FastRecurrentPPO`` that learns the teacher's actions instead of better ones."""

    def train(self) -> None:
        """One update: the likelihood of the teacher's actions, and the critic's squared error."""
        policy = cast(ApprenticePolicy, self.policy)
        policy.set_training_mode(True)
        self._update_learning_rate(policy.optimizer)
        losses, value_losses = [], []
        for _ in range(self.n_epochs):
            for batch in self.rollout_buffer.get(self.batch_size):
                observations = batch.observations
                values, log_prob, _ = policy.evaluate_actions(
                    observations,
                    observations[:, policy.seen :],
                    cast(Any, batch).lstm_states,
                    cast(Any, batch).episode_starts,
                )
                imitation = -log_prob.mean()
                value_loss = nn.functional.mse_loss(values.flatten(), batch.returns)
                policy.optimizer.zero_grad()
                (imitation + self.vf_coef * value_loss).backward()
                nn.utils.clip_grad_norm_(policy.parameters(), self.max_grad_norm)
                policy.optimizer.step()
                losses.append(imitation.item())
                value_losses.append(value_loss.item())
        self._n_updates += self.n_epochs
        self.logger.record("train/imitation_loss", np.mean(losses))
        self.logger.record("train/value_loss", np.mean(value_losses))
