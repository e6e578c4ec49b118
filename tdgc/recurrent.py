"""RecurrentPPO with a fast update, exact (Sec. IV-B).

sb3-contrib cuts a rollout where episodes start, pads the pieces to one length, and then calls each
LSTM step by step in Python, since a state has to be zeroed where an episode starts. Every step
drags the gradients of all weights along. Here

- a minibatch holds whole environments, as in OpenAI Baselines' PPO2 for recurrent policies, so its
  sequences have the rollout's length and nothing is padded,
- what does not wait for the step before is left out of the loop over time: the gates' share of the
  observations before it and the gradients of the weights after it are one product each,
- the LSTMs of actor and critic go through the loop together.
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


class _Recurrence(th.autograd.Function):
    """The loop over time of N LSTMs, forwards and backwards, written out.

    With x_t = W (observation) + b, the gates and states after step t are::

        h', c' = keep_t h_{t-1}, keep_t c_{t-1}
        z = x_t + U h';  i, f, o = sigmoid(z_i, z_f, z_o);  g = tanh(z_g)
        c_t = f c' + i g;  h_t = o tanh(c_t)
    """

    @staticmethod
    def forward(
        ctx: Any, x: th.Tensor, keep: th.Tensor, h: th.Tensor, c: th.Tensor, u: th.Tensor
    ) -> th.Tensor:
        """Outputs h_t of all steps, (N, T, B, H).

        Args:
            x: (N, T, B, 4 H), in torch's order of gates: i, f, g, o.
            keep: (T, B, 1), 0.0 where an episode starts and 1.0 elsewhere.
            h, c: states before the first step, (N, B, H); data, no gradient goes there.
            u: recurrent weights, (N, 4 H, H).
        """
        steps = []
        for x_t, keep_t in zip(x.unbind(1), keep, strict=True):
            h_in, c_in = h * keep_t, c * keep_t
            z = th.baddbmm(x_t, h_in, u.mT)
            i, f, g, o = z.chunk(4, dim=-1)
            g.mul_(2.0)  # tanh(a) = 2 sigmoid(2 a) - 1, and torch's tanh takes thrice as long
            z.sigmoid_()
            g.mul_(2.0).sub_(1.0)
            c = (f * c_in).addcmul_(i, g)
            tanh_c = (2.0 * c).sigmoid_().mul_(2.0).sub_(1.0)
            h = o * tanh_c
            steps.append((z, h_in, c_in, tanh_c, h))
        gates, h_in, c_in, tanh_c, out = (
            th.stack(parts, dim=1) for parts in zip(*steps, strict=True)
        )
        ctx.save_for_backward(gates, h_in, c_in, tanh_c, keep, u)
        return out

    @staticmethod
    def backward(ctx: Any, d_out: th.Tensor) -> tuple[th.Tensor | None, ...]:
        """Backpropagation through time: the gradients of x and u from that of the outputs."""
        gates, h_in, c_in, tanh_c, keep, u = ctx.saved_tensors
        i, f, g, o = gates.chunk(4, dim=-1)
        # The derivatives of c_t by z_i, z_f, z_g and of h_t by z_o, until the loop has the factor.
        dz = th.cat(
            (g * (i - i * i), c_in * (f - f * f), i * (1.0 - g * g), tanh_c * (o - o * o)), -1
        )
        by_gate = dz.view(*h_in.shape[:3], 4, -1)
        through_h, through_time = o - o * tanh_c * tanh_c, f * keep
        dh, dc = d_out[:, -1], th.zeros_like(d_out[:, -1])
        for t in reversed(range(len(keep))):
            dc = th.addcmul(dc, dh, through_h[:, t])
            by_gate[:, t, :, :3] *= dc.unsqueeze(-2)
            by_gate[:, t, :, 3] *= dh
            if t > 0:
                dh = th.addcmul(d_out[:, t - 1], keep[t], dz[:, t] @ u)
                dc = dc * through_time[:, t]
        du = dz.flatten(1, 2).mT @ h_in.flatten(1, 2)
        return dz, None, None, None, du


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
        lstms = (self.lstm_actor, cast(nn.LSTM, self.lstm_critic))
        w = th.stack([lstm.all_weights[0][0] for lstm in lstms])
        u = th.stack([lstm.all_weights[0][1] for lstm in lstms])
        # Added before they are stacked, or the two would share one gradient, to be clipped twice.
        bias = th.stack([lstm.all_weights[0][2] + lstm.all_weights[0][3] for lstm in lstms])
        h, c = (th.cat(pair) for pair in zip(lstm_states.pi, lstm_states.vf, strict=True))
        n_seq, hidden = h.shape[1:]
        features = cast(th.Tensor, self.extract_features(obs))
        by_time = features.view(n_seq, -1, features.shape[1]).transpose(0, 1).flatten(0, 1)
        keep = 1.0 - episode_starts.view(n_seq, -1, 1).transpose(0, 1)
        x = th.baddbmm(bias.unsqueeze(1), by_time.expand(len(w), -1, -1), w.mT)
        x = x.view(len(w), -1, n_seq, 4 * hidden)
        out = _Recurrence.apply(x, keep, h, c, u)  # type: ignore[no-untyped-call]
        latent_pi, latent_vf = out.transpose(1, 2).flatten(1, 2)
        values = self.value_net(self.mlp_extractor.forward_critic(latent_vf))
        distribution = self._get_action_dist_from_latent(
            self.mlp_extractor.forward_actor(latent_pi)
        )
        return values, distribution.log_prob(actions), distribution.entropy()


class WholeEnvBuffer(RecurrentRolloutBuffer):
    """Rollout buffer whose minibatches hold whole environments, so nothing is cut or padded."""

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
