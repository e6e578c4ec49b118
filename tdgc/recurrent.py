"""RecurrentPPO with a fast update, exact (Sec. IV-B).

sb3-contrib cuts a rollout where episodes start and pads the pieces to one length. Then it calls
each LSTM step by step in Python, since a state has to be zeroed where an episode starts, and every
step drags the gradients of all weights along. But an episode starts nowhere but at the beginning of
a piece, so the states before the pieces are all there is to zero, and each LSTM is called once.

A minibatch holds whole environments, as in OpenAI Baselines' PPO2 for recurrent policies: only the
LSTMs see padding, and only where an episode starts within the rollout.
"""

from __future__ import annotations

from collections.abc import Generator
from typing import Any, cast

import numpy as np
import torch as th
from numpy.typing import NDArray
from sb3_contrib import RecurrentPPO
from sb3_contrib.common.recurrent.buffers import RecurrentRolloutBuffer
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from sb3_contrib.common.recurrent.type_aliases import RecurrentRolloutBufferSamples, RNNStates
from torch import nn


class FastRecurrentPolicy(RecurrentActorCriticPolicy):
    """``MlpLstmPolicy`` with a fast ``evaluate_actions``; for ``FastRecurrentPPO``.

    It takes the same arguments, has the same parameters and computes the same numbers.

    Raises:
        ValueError: other LSTMs than plain ones of one layer, one each for actor and critic.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        # SB3's Adam, in one operation instead of a dozen for each parameter.
        kwargs.setdefault("optimizer_kwargs", {"eps": 1e-5, "fused": True})
        super().__init__(*args, **kwargs)
        plain = self.lstm_actor.num_layers == 1 and not self.lstm_kwargs
        if self.lstm_critic is None or not plain or not self.share_features_extractor:
            raise ValueError(
                "FastRecurrentPolicy has plain LSTMs of one layer, one each for actor and critic, "
                "on shared features"
            )

    def evaluate_actions(  # type: ignore[override]  # as sb3-contrib has it
        self, obs: th.Tensor, actions: th.Tensor, lstm_states: RNNStates, episode_starts: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor | None]:
        """Values, log probabilities and entropies of ``n_seq`` sequences of equal length.

        Args:
            obs, actions: (n_seq * length, size), sequence by sequence.
            lstm_states: before the first step, of actor and critic, each (1, n_seq, hidden).
            episode_starts: (n_seq * length,), 1.0 where the state is zeroed before the step.

        Returns:
            Values (n_seq * length, 1); log probabilities and entropies (n_seq * length,).
        """
        n_seq = lstm_states.pi[0].shape[1]
        starts = episode_starts.view(n_seq, -1) > 0.0
        length = starts.shape[1]
        cuts = starts.clone()
        cuts[:, 0] = True
        first = cuts.flatten().nonzero().squeeze(1)  # of each piece
        sizes = th.diff(first, append=first.new_tensor([cuts.numel()]))
        offset = th.arange(int(sizes.max()), device=first.device)
        # (n_seq * length,): where each step of the sequences is among (longest * pieces) steps.
        piece = th.repeat_interleave(sizes)
        place = (th.arange(cuts.numel(), device=first.device) - first[piece]) * len(first) + piece
        # (longest, pieces); what pads a piece is thrown away again.
        steps = (first + offset.unsqueeze(1)).clamp_(max=cuts.numel() - 1)
        goes_on = ((first % length == 0) & ~starts.flatten()[first]).to(obs.dtype).view(1, -1, 1)
        pieces = cast(th.Tensor, self.extract_features(obs))[steps]

        def run(lstm: nn.LSTM, states: tuple[th.Tensor, ...]) -> th.Tensor:
            before = tuple(state[:, first // length] * goes_on for state in states)
            return lstm(pieces, before)[0].flatten(0, 1).index_select(0, place)

        latent_pi = run(self.lstm_actor, lstm_states.pi)
        latent_vf = run(cast(nn.LSTM, self.lstm_critic), lstm_states.vf)
        values = self.value_net(self.mlp_extractor.forward_critic(latent_vf))
        distribution = self._get_action_dist_from_latent(
            self.mlp_extractor.forward_actor(latent_pi)
        )
        return values, distribution.log_prob(actions), distribution.entropy()


class WholeEnvBuffer(RecurrentRolloutBuffer):
    """Rollout buffer whose minibatches hold whole environments."""

    def get(  # type: ignore[override]  # as sb3-contrib has it
        self, batch_size: int | None = None
    ) -> Generator[RecurrentRolloutBufferSamples, None, None]:
        """Minibatches of about ``batch_size`` steps, each environment once, in random order."""
        total = self.n_envs * self.buffer_size
        minibatches = total // (batch_size or total)
        for envs in np.array_split(np.random.permutation(self.n_envs), minibatches):
            yield self._rollouts(envs)

    def _rollouts(self, envs: NDArray[np.int64]) -> RecurrentRolloutBufferSamples:
        def steps(array: NDArray[np.float32]) -> th.Tensor:
            """(n_steps, n_envs, ...) to (len(envs) * n_steps, ...), environment by environment."""
            return self.to_torch(self.swap_and_flatten(array[:, envs]))

        def before(array: NDArray[np.float32]) -> th.Tensor:
            """The first of (n_steps, 1, n_envs, hidden)."""
            return self.to_torch(array[0][:, envs])

        return RecurrentRolloutBufferSamples(
            observations=steps(self.observations),
            actions=steps(self.actions),
            old_values=steps(self.values).flatten(),
            old_log_prob=steps(self.log_probs).flatten(),
            advantages=steps(self.advantages).flatten(),
            returns=steps(self.returns).flatten(),
            lstm_states=RNNStates(
                (before(self.hidden_states_pi), before(self.cell_states_pi)),
                (before(self.hidden_states_vf), before(self.cell_states_vf)),
            ),
            episode_starts=steps(self.episode_starts).flatten(),
            mask=th.ones(len(envs) * self.buffer_size, device=self.device),
        )


class FastRecurrentPPO(RecurrentPPO):
    """``RecurrentPPO`` with ``WholeEnvBuffer``.

    Raises:
        ValueError: a ``batch_size`` below ``n_steps``, which holds no environment's rollout.
    """

    def _setup_model(self) -> None:
        super()._setup_model()
        if cast(int, self.batch_size) < self.n_steps:
            raise ValueError(
                f"a minibatch of {self.batch_size} steps does not hold the {self.n_steps} of one "
                "environment; take fewer minibatches or more environments"
            )
        stock = cast(RecurrentRolloutBuffer, self.rollout_buffer)
        self.rollout_buffer = WholeEnvBuffer(
            stock.buffer_size, stock.observation_space, stock.action_space,
            stock.hidden_state_shape, stock.device, stock.gae_lambda, stock.gamma, stock.n_envs,
        )  # fmt: skip
