"""The recurrent policy of the high level with a fast pass over sequences (Sec. IV-B).

sb3-contrib's LSTM pass goes step by step in Python as soon as one episode starts anywhere in a
minibatch, since the state has to be zeroed there. But its rollout buffer cuts the data at every
episode start before padding, so an episode can only start in the first column of a sequence.
Zeroing those initial states and running the LSTM once over the block is the same mathematics.
"""

from __future__ import annotations

import torch as th
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from torch import nn


class FastRecurrentPolicy(RecurrentActorCriticPolicy):
    """``MlpLstmPolicy`` that runs each LSTM once per minibatch; for ``RecurrentPPO``.

    It takes the same arguments, has the same parameters and computes the same numbers.
    """

    @staticmethod
    def _process_sequence(
        features: th.Tensor,
        lstm_states: tuple[th.Tensor, th.Tensor],
        episode_starts: th.Tensor,
        lstm: nn.LSTM,
    ) -> tuple[th.Tensor, th.Tensor]:  # as sb3-contrib has it; the second is a pair of them
        """One pass of ``lstm`` over ``n_seq`` padded sequences of equal length.

        Args:
            features: (n_seq * length, lstm.input_size), sequence by sequence.
            lstm_states: hidden and cell states before the first step, each
                (n_layers, n_seq, hidden).
            episode_starts: (n_seq * length,), 1.0 where the state is zeroed before the step.
            lstm: the actor's or the critic's.

        Returns:
            Outputs (n_seq * length, hidden) and the pair of states after the last step.
        """
        n_seq = lstm_states[0].shape[1]
        starts = episode_starts.reshape(n_seq, -1)
        if not starts[:, 1:].any():
            keep = (1.0 - starts[:, 0]).view(1, n_seq, 1)
            lstm_states = (keep * lstm_states[0], keep * lstm_states[1])
            episode_starts = th.zeros_like(episode_starts)
        # Without episode starts the stock pass is a single call; with some left, which no buffer
        # of sb3-contrib produces, it still does the right thing step by step.
        return RecurrentActorCriticPolicy._process_sequence(
            features, lstm_states, episode_starts, lstm
        )
