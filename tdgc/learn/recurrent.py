"""RecurrentPPO with a fast update, exact (Sec. IV-B).

sb3-contrib cuts a rollout where episodes start and pads the pieces to one length. Then it calls
each LSTM step by step in Python, since a state has to be zeroed where an episode starts, and every
step drags the gradients of all weights along. But an episode starts nowhere but at the beginning of
a piece, so the states before the pieces are all there is to zero, and each LSTM is called once.

A minibatch holds whole environments, as in OpenAI Baselines' PPO2 for recurrent policies: only the
LSTMs see padding, and only where an episode starts within the rollout.
"""

from __future__ import annotations

import math
from collections.abc import Generator
from typing import Any, cast

import numpy as np
import torch as th
from numpy.typing import NDArray
from sb3_contrib import RecurrentPPO
from sb3_contrib.common.recurrent.buffers import RecurrentRolloutBuffer
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from sb3_contrib.common.recurrent.type_aliases import RecurrentRolloutBufferSamples, RNNStates
from stable_baselines3.common.distributions import DiagGaussianDistribution
from stable_baselines3.common.torch_layers import MlpExtractor
from torch import nn

from tdgc.policies.files import Mirror
from tdgc.policies.learning import MirroredHead, MirroredLSTM, MirroredMlpExtractor


class FastRecurrentPolicy(RecurrentActorCriticPolicy):
    """``MlpLstmPolicy`` with a fast ``evaluate_actions``; for ``FastRecurrentPPO``.

    It takes the same arguments, has the same parameters and computes the same numbers; with a
    ``mirror`` it is exactly left-right symmetric, and so is its value.

    Raises:
        ValueError: other LSTMs than plain ones of one layer, one each for actor and critic, or
            other actions than normally distributed ones with one deviation each.
    """

    def __init__(self, *args: Any, mirror: Mirror | None = None, **kwargs: Any) -> None:
        # SB3's Adam, in one operation instead of a dozen for each parameter.
        kwargs.setdefault("optimizer_kwargs", {"eps": 1e-5, "fused": True})
        self.mirror = mirror
        super().__init__(*args, **kwargs)
        plain = self.lstm_actor.num_layers == 1 and not self.lstm_kwargs
        if self.lstm_critic is None or not plain or not self.share_features_extractor:
            raise ValueError(
                "FastRecurrentPolicy has plain LSTMs of one layer, one each for actor and critic, "
                "on shared features"
            )
        if not isinstance(self.action_dist, DiagGaussianDistribution):
            raise ValueError("FastRecurrentPolicy has normally distributed actions, without gSDE")
        if mirror is not None:  # the parameters stay, so the optimiser has them
            self.lstm_actor = MirroredLSTM(self.lstm_actor, mirror)  # type: ignore[assignment]
            self.lstm_critic = MirroredLSTM(self.lstm_critic, mirror)  # type: ignore[assignment]
            self.lstm_hidden_state_shape = (1, 1, self.lstm_actor.hidden_size)
            self.action_net = MirroredHead(cast(nn.Linear, self.action_net), mirror)
            self.value_net = MirroredHead(self.value_net, None)  # type: ignore[assignment]

    def _build_mlp_extractor(self) -> None:
        kind = MlpExtractor if self.mirror is None else MirroredMlpExtractor
        self.mlp_extractor = kind(
            self.lstm_output_dim, self.net_arch, self.activation_fn, self.device
        )

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), "mirror": self.mirror}

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
        mean = self.action_net(self.mlp_extractor.forward_actor(latent_pi))
        return values, *gaussian(actions, mean, self.log_std)


def gaussian(x: th.Tensor, mean: th.Tensor, log_std: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """Log probability of ``x`` (n, size) and entropy (n,) of independent normal distributions.

    As ``DiagGaussianDistribution`` has them, without its checks of every value, a twentieth of the
    update.
    """
    size = 0.5 * math.log(2.0 * math.pi) * len(log_std) + log_std.sum()
    log_prob = -0.5 * ((x - mean) * (-log_std).exp()).square().sum(1) - size
    return log_prob, (0.5 * len(log_std) + size).expand(len(x))


class _Everything:
    """A mask without padding: RecurrentPPO takes the steps where ``mask > 1e-8``, all of them.

    Indexing by booleans, and its gradient, was a tenth of the update.
    """

    def __gt__(self, other: float) -> slice:
        return slice(None)


class WholeEnvBuffer(RecurrentRolloutBuffer):
    """Rollout buffer whose minibatches hold whole environments."""

    def get(  # type: ignore[override]  # as sb3-contrib has it
        self, batch_size: int | None = None
    ) -> Generator[RecurrentRolloutBufferSamples, None, None]:
        """Minibatches of about ``batch_size`` steps, each environment once, in random order."""
        total = self.n_envs * self.buffer_size
        minibatches = total // (batch_size or total)

        def by_env(array: NDArray[np.float32]) -> th.Tensor:
            """(n_steps, n_envs, ...) -> (n_envs, n_steps, ...)."""
            return self.to_torch(array.swapaxes(0, 1))

        steps = [
            by_env(array)
            for array in (
                self.observations, self.actions, self.values, self.log_probs, self.advantages,
                self.returns, self.episode_starts,
            )
        ]  # fmt: skip
        states = [
            self.to_torch(array[0])  # before the first of (n_steps, 1, n_envs, hidden)
            for array in (
                self.hidden_states_pi, self.cell_states_pi,
                self.hidden_states_vf, self.cell_states_vf,
            )
        ]  # fmt: skip
        for drawn in np.array_split(np.random.permutation(self.n_envs), minibatches):
            envs = self.to_torch(drawn)
            obs, actions, values, log_probs, advantages, returns, starts = (
                array.index_select(0, envs).flatten(0, 1) for array in steps
            )
            h_pi, c_pi, h_vf, c_vf = (state.index_select(1, envs) for state in states)
            yield RecurrentRolloutBufferSamples(
                observations=obs,
                actions=actions,
                old_values=values,
                old_log_prob=log_probs,
                advantages=advantages,
                returns=returns,
                lstm_states=RNNStates((h_pi, c_pi), (h_vf, c_vf)),
                episode_starts=starts,
                mask=cast(th.Tensor, _Everything()),
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
