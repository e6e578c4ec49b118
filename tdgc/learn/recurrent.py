"""RecurrentPPO with a fast but exact update (Sec. IV-B).

sb3-contrib cuts a rollout where episodes start and pads the pieces to equal length. It then calls
each LSTM step by step in Python, because a hidden state has to be zeroed where an episode starts,
and every step carries the gradients of all weights along. But episodes start only at the beginning
of a piece, so only the states before the pieces need zeroing, and each LSTM is called once.

A minibatch holds whole environments, as in OpenAI Baselines' PPO2 for recurrent policies: only the
encoders and LSTMs see padding, and only where an episode starts within the rollout.
"""

import functools
import math
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from sb3_contrib import RecurrentPPO
from sb3_contrib.common.recurrent.buffers import RecurrentRolloutBuffer
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from sb3_contrib.common.recurrent.type_aliases import RecurrentRolloutBufferSamples, RNNStates
from stable_baselines3.common.distributions import DiagGaussianDistribution
from stable_baselines3.common.torch_layers import MlpExtractor
from stable_baselines3.common.type_aliases import Schedule
from torch import nn

from tdgc.policies.files import Mirror
from tdgc.policies.learning import (
    EncodedLSTM,
    MirroredHead,
    MirroredLSTM,
    MirroredMlpExtractor,
    NoMemory,
)


@dataclass(frozen=True)
class GaitNoise:
    """Exploration noise of the gait channel, the last action.

    Attributes:
        robots: number of robots that decide at once.
        gaits: number of gaits to choose from, each an equal share of the action's range.
        hold: number of decisions for which the noise is held, within an episode. Each decision's
            noise is still normally distributed, and its likelihood is that of one decision.
    """

    robots: int
    gaits: int
    hold: int = 1


class FastRecurrentPolicy(RecurrentActorCriticPolicy):
    """``MlpLstmPolicy`` with a fast ``evaluate_actions``; for ``FastRecurrentPPO``, which also
    makes its optimiser.

    It takes the same arguments, has the same parameters and computes the same numbers, but Adam's
    ``eps`` is 1e-8 by default. With a
    ``mirror``, the policy and its value are exactly left-right symmetric. If ``lstm_hidden_size``
    is None, the policy is feed-forward and consists only of the networks behind the LSTMs.
    ``encoder`` gives the layer sizes of an encoder in front of each LSTM, see ``EncodedLSTM``.

    Attributes:
        gait_bonus: weight of the gaits' entropy in the entropy that ``evaluate_actions`` returns,
            which also contains that of the normal distributions.

    Raises:
        ValueError: the LSTMs are not plain ones of one layer, one each for actor and critic; the
            actions are not normally distributed with one deviation each; or there is an encoder
            but no LSTM.
    """

    def __init__(
        self,
        observation_space: spaces.Box,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        *,
        mirror: Mirror | None = None,
        lstm_hidden_size: int | None = 256,
        encoder: Sequence[int] = (),
        gait: GaitNoise | None = None,
        **kwargs: Any,
    ) -> None:
        # Fused: one operation instead of a dozen for each parameter. SB3's ``eps`` of 1e-5 would
        # drown small gradients (docs/experiments.md).
        kwargs.setdefault("optimizer_kwargs", {"fused": True, "eps": 1e-8})
        self.mirror, self.gait, self.gait_bonus = mirror, gait, 0.0
        self.encoder_arch = tuple(encoder)
        if encoder and lstm_hidden_size is None:
            raise ValueError("an encoder stands before LSTMs, and a feed-forward policy has none")
        size = observation_space.shape[0] if lstm_hidden_size is None else lstm_hidden_size
        super().__init__(
            observation_space, action_space, lr_schedule, lstm_hidden_size=size, **kwargs
        )
        plain = self.lstm_actor.num_layers == 1 and not self.lstm_kwargs
        if self.lstm_critic is None or not plain or not self.share_features_extractor:
            raise ValueError(
                "FastRecurrentPolicy has plain LSTMs of one layer, one each for actor and critic, "
                "on shared features"
            )
        if not isinstance(self.action_dist, DiagGaussianDistribution):
            raise ValueError("FastRecurrentPolicy has normally distributed actions, without gSDE")
        if lstm_hidden_size is None or encoder:
            self.lstm_actor, self.lstm_critic = (  # type: ignore[assignment]
                self._memory(lstm_hidden_size) for _ in range(2)
            )
            self.lstm_hidden_state_shape = (1, 1, self.lstm_actor.hidden_size)
        if gait is not None and gait.hold > 1:
            # The held noise and its age in decisions; as a buffer it is part of a checkpoint.
            self.held: th.Tensor
            self.register_buffer("held", th.zeros(2, gait.robots))
        if mirror is not None:
            self.lstm_actor = MirroredLSTM(self.lstm_actor, mirror)  # type: ignore[assignment]
            critic = cast(nn.LSTM, self.lstm_critic)
            self.lstm_critic = MirroredLSTM(critic, mirror)  # type: ignore[assignment]
            self.lstm_hidden_state_shape = (1, 1, self.lstm_actor.hidden_size)
            self.action_net = MirroredHead(cast(nn.Linear, self.action_net), mirror)
            self.value_net = MirroredHead(self.value_net, None)  # type: ignore[assignment]

    def _memory(self, hidden: int | None) -> NoMemory | EncodedLSTM:
        if hidden is None:
            return NoMemory(self.features_dim)
        memory = EncodedLSTM(self.features_dim, self.encoder_arch, hidden, self.activation_fn)
        memory.encoder.apply(functools.partial(self.init_weights, gain=math.sqrt(2.0)))  # as in SB3
        return memory.to(self.device)

    def _build_mlp_extractor(self) -> None:
        kind = MlpExtractor if self.mirror is None else MirroredMlpExtractor
        size = self.lstm_output_dim + (self.encoder_arch[-1] if self.encoder_arch else 0)
        self.mlp_extractor = kind(size, self.net_arch, self.activation_fn, self.device)

    def forward(  # type: ignore[override]  # as in sb3-contrib
        self,
        obs: th.Tensor,
        lstm_states: RNNStates,
        episode_starts: th.Tensor,
        deterministic: bool = False,
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor, RNNStates]:
        """Act as ``MlpLstmPolicy`` does, but hold the gait channel's noise, see ``GaitNoise``."""
        actions, values, log_prob, states = super().forward(
            obs, lstm_states, episode_starts, deterministic
        )
        if deterministic or self.gait is None or self.gait.hold == 1:
            return actions, values, log_prob, states
        normal = cast(th.distributions.Normal, self.action_dist.distribution)
        mean, std = normal.mean[:, -1], normal.stddev[:, -1]
        noise, age = self.held
        over = (episode_starts > 0.0) | (age >= self.gait.hold)
        noise = th.where(over, (actions[:, -1] - mean) / std, noise)
        self.held = th.stack([noise, th.where(over, 1.0, age + 1.0)])
        actions[:, -1] = mean + std * noise
        return actions, values, self.action_dist.log_prob(actions), states

    def evaluate_actions(  # type: ignore[override]  # as in sb3-contrib
        self, obs: th.Tensor, actions: th.Tensor, lstm_states: RNNStates, episode_starts: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor | None]:
        """Evaluate ``n_seq`` sequences of equal length.

        Args:
            obs, actions: (n_seq * length, size), sequence by sequence.
            lstm_states: of actor and critic before the first step, each (1, n_seq, hidden).
            episode_starts: (n_seq * length,), 1.0 where the state is zeroed before the step.

        Returns:
            Values (n_seq * length, 1); log probabilities and entropies (n_seq * length,).
        """
        mean, values = self.unroll(obs, lstm_states, episode_starts)
        log_prob, entropy = gaussian(actions, mean, self.log_std)
        return values, log_prob, entropy + self.bonus(obs, mean)

    def bonus(self, obs: th.Tensor, mean: th.Tensor) -> th.Tensor:
        """Bonus added to the entropy, (n,), for mean actions ``mean`` (n, size) at ``obs``."""
        if self.gait is None or self.gait_bonus <= 0.0:
            return mean.new_zeros(len(mean))
        limit = float(cast(spaces.Box, self.action_space).high[-1])
        std = self.log_std[-1].exp()
        return self.gait_bonus * gait_entropy(mean[:, -1], std, limit, self.gait.gaits)

    def unroll(
        self, obs: th.Tensor, lstm_states: RNNStates, episode_starts: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """Run actor and critic over the sequences; arguments as in ``evaluate_actions``.

        Returns:
            Mean actions (n_seq * length, size) and values (n_seq * length, 1).
        """
        n_seq = lstm_states.pi[0].shape[1]
        starts = episode_starts.view(n_seq, -1) > 0.0
        length = starts.shape[1]
        cuts = starts.clone()
        cuts[:, 0] = True
        first = cuts.flatten().nonzero().squeeze(1)  # step of each piece
        sizes = th.diff(first, append=first.new_tensor([cuts.numel()]))
        offset = th.arange(int(sizes.max()), device=first.device)
        # (n_seq * length,): index of each step among the (longest * pieces) padded steps.
        piece = th.repeat_interleave(sizes)
        place = (th.arange(cuts.numel(), device=first.device) - first[piece]) * len(first) + piece
        # (longest, pieces): index of the step in each padded place; padding is discarded later.
        steps = (first + offset.unsqueeze(1)).clamp_(max=cuts.numel() - 1)
        goes_on = ((first % length == 0) & ~starts.flatten()[first]).to(obs.dtype).view(1, -1, 1)
        pieces = cast(th.Tensor, self.extract_features(obs))[steps]

        def run(lstm: nn.LSTM, states: tuple[th.Tensor, ...]) -> th.Tensor:
            before = tuple(state[:, first // length] * goes_on for state in states)
            return lstm(pieces, before)[0].flatten(0, 1).index_select(0, place)

        latent_pi = run(self.lstm_actor, lstm_states.pi)
        latent_vf = run(cast(nn.LSTM, self.lstm_critic), lstm_states.vf)
        values = self.value_net(self.mlp_extractor.forward_critic(latent_vf))
        return self.action_net(self.mlp_extractor.forward_actor(latent_pi)), values


def gaussian(x: th.Tensor, mean: th.Tensor, log_std: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """Log probability of ``x`` (n, size) and entropy (n,) of independent normal distributions.

    Same as ``DiagGaussianDistribution``, but without its checks of every value, which take a
    twentieth of the update.
    """
    size = 0.5 * math.log(2.0 * math.pi) * len(log_std) + log_std.sum()
    log_prob = -0.5 * ((x - mean) * (-log_std).exp()).square().sum(1) - size
    return log_prob, (0.5 * len(log_std) + size).expand(len(x))


def gait_entropy(mean: th.Tensor, std: th.Tensor, limit: float, gaits: int) -> th.Tensor:
    """Entropy in nats of the gait that a normally distributed channel chooses, (n,).

    Args:
        mean: (n,) of the channel.
        std: standard deviation of its noise.
        limit: the channel's range is -limit to limit; values beyond count as its ends.
        gaits: number of gaits, which share the range equally.
    """
    edges = th.linspace(-limit, limit, gaits + 1, device=mean.device)[1:-1]
    below = th.special.ndtr((edges - mean[:, None]) / std)
    nothing = th.zeros_like(mean)[:, None]
    share = th.diff(below, prepend=nothing, append=nothing + 1.0).clamp(min=1e-8)
    return -(share * share.log()).sum(1)


def exchange_memories(
    states: RNNStates, seen: NDArray[np.float32], share: float, untold: int | None = None
) -> None:
    """Shuffle the actor's hidden states of a random subset of the robots among them, in place.

    A training tile is of one family throughout, so a hidden state that has seen pillars never meets
    a trench, and a policy learns to expect none. With the hidden state of a robot on other ground
    it has to act on what it sees. The critic keeps its own: it is to value what the robot will
    meet.

    Args:
        states: of actor and critic, each (1, M, hidden).
        seen: (M, size), the robots' observations.
        share: of the robots that take part, drawn anew in each call.
        untold: column of the observation that is 1 where a robot is not told its family. Only such
            robots take part, because the others know their family from the observation. None if
            no robot is told its family; then all can take part.
    """
    some = np.arange(len(seen)) if untold is None else np.flatnonzero(seen[:, untold] > 0.5)
    some = some[np.random.random(len(some)) < share]
    others = np.random.permutation(some)
    for state in states.pi:
        state[:, some] = state[:, others]


class _Everything:
    """Mask for batches without padding: ``mask > 1e-8``, as in RecurrentPPO, selects every step.

    Boolean indexing and its gradient took a tenth of the update.
    """

    def __gt__(self, other: float) -> slice:
        return slice(None)


class WholeEnvBuffer(RecurrentRolloutBuffer):
    """Rollout buffer whose minibatches hold whole environments."""

    def get(  # type: ignore[override]  # as in sb3-contrib
        self, batch_size: int | None = None
    ) -> Generator[RecurrentRolloutBufferSamples, None, None]:
        """Yield minibatches of about ``batch_size`` steps: each environment once, shuffled."""
        total = self.n_envs * self.buffer_size
        minibatches = total // (batch_size or total)
        steps = [
            self.by_env(array)
            for array in (
                self.observations, self.actions, self.values, self.log_probs, self.advantages,
                self.returns, self.episode_starts,
            )
        ]  # fmt: skip
        states = self.first_memories()
        for drawn in np.array_split(np.random.permutation(self.n_envs), minibatches):
            envs = self.to_torch(drawn)
            obs, actions, values, log_probs, advantages, returns, starts = (
                array.index_select(0, envs).flatten(0, 1) for array in steps
            )
            h_pi, c_pi, h_vf, c_vf = states.index_select(2, envs)
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

    def by_env(self, array: NDArray[np.float32]) -> th.Tensor:
        """Swap axes: array (n_steps, n_envs, ...) -> tensor (n_envs, n_steps, ...)."""
        return self.to_torch(array.swapaxes(0, 1))

    def first_memories(self) -> th.Tensor:
        """h and c of the actor and the critic before the first step, (4, 1, n_envs, hidden)."""
        of_actor = self.hidden_states_pi[0], self.cell_states_pi[0]
        of_critic = self.hidden_states_vf[0], self.cell_states_vf[0]
        return self.to_torch(np.stack([*of_actor, *of_critic]))


def actor_and_critic(policy: nn.Module) -> tuple[list[nn.Parameter], list[nn.Parameter]]:
    """Parameters of a recurrent ``policy`` that decide its actions, and those of its critic."""
    of_critic = "lstm_critic.", "mlp_extractor.value_net.", "value_net."
    actor: list[nn.Parameter] = []
    critic: list[nn.Parameter] = []
    for name, parameter in policy.named_parameters():
        (critic if name.startswith(of_critic) else actor).append(parameter)
    return actor, critic


def adapted_share(share: float, kl: float, desired: float) -> float:
    """The actor's share of the learning rate, from 0.01 to 1, after an update that changed the
    policy by a KL divergence ``kl``.

    Rule and factor are those by which rsl_rl adapts its learning rate to each minibatch.
    """
    if kl > 2.0 * desired:
        share /= 1.5
    elif kl < desired / 2.0:
        share *= 1.5
    return min(max(share, 0.01), 1.0)


class FastRecurrentPPO(RecurrentPPO):
    """``RecurrentPPO`` with ``WholeEnvBuffer``, which clips the gradient of the actor alone.

    SB3 clips one norm for actor and critic, which share no parameters here. Returns are in the
    tens, so the critic's gradient was ten times the actor's, and the actor learned at a fraction of
    the rate that was set: least where a fall or a success came as a surprise (docs/experiments.md).
    ``max_grad_norm`` is the greatest norm of the actor's gradient.

    Args:
        gait_ent_coef: weight of the gaits' entropy (``GaitNoise``) in the loss at the first step;
            it falls linearly to zero at the last. It requires an ``ent_coef`` above 0.
        exchange: exchanges hidden states after each rollout, see ``exchange_memories``; None for no
            exchange.
        desired_kl: KL divergence of the policy after an update from that before; the actor's
            learning rate is a share of ``learning_rate``, lowered after an update beyond twice
            this, see ``adapted_share``. None: the actor learns at ``learning_rate``, as the critic
            always does.

    Raises:
        ValueError: ``batch_size`` is below ``n_steps``, too small for one environment's rollout.
    """

    def __init__(
        self,
        *args: Any,
        gait_ent_coef: float = 0.0,
        exchange: Callable[[RNNStates, NDArray[np.float32]], None] | None = None,
        desired_kl: float | None = None,
        **kwargs: Any,
    ) -> None:
        self.gait_ent_coef, self.exchange, self.desired_kl = gait_ent_coef, exchange, desired_kl
        super().__init__(*args, **kwargs)

    def collect_rollouts(self, *args: Any, **kwargs: Any) -> bool:
        """Collect rollouts as ``RecurrentPPO`` does, then exchange hidden states."""
        complete = super().collect_rollouts(*args, **kwargs)
        if self.exchange is not None:
            seen = cast(NDArray[np.float32], self._last_obs)
            self.exchange(cast(RNNStates, self._last_lstm_states), seen)
        return complete

    def train(self) -> None:
        """Make one update."""
        if self.gait_ent_coef:
            # SB3 multiplies the whole entropy, bonus included, by ``ent_coef``.
            bonus = self.gait_ent_coef * self._current_progress_remaining / self.ent_coef
            cast(FastRecurrentPolicy, self.policy).gait_bonus = bonus
        super().train()
        if self.desired_kl is not None:
            kl = float(self.logger.name_to_value["train/approx_kl"])
            share = cast(th.Tensor, self.policy.actor_share)
            share.fill_(adapted_share(float(share), kl, self.desired_kl))

    def _update_learning_rate(self, optimizers: Any) -> None:
        super()._update_learning_rate(optimizers)
        if self.desired_kl is not None:
            actor = self.policy.optimizer.param_groups[0]
            actor["lr"] *= float(cast(th.Tensor, self.policy.actor_share))
            self.logger.record("train/actor_learning_rate", actor["lr"])

    def _setup_model(self) -> None:
        super()._setup_model()
        actor, critic = actor_and_critic(self.policy)
        self.policy.optimizer = self.policy.optimizer_class(
            [{"params": actor}, {"params": critic}],
            lr=self.lr_schedule(1.0),  # type: ignore[call-arg]  # as in SB3
            **self.policy.optimizer_kwargs,
        )
        if self.desired_kl is not None:  # as a buffer it is part of a checkpoint
            self.policy.register_buffer("actor_share", th.ones((), device=self.device))
        limit, self.max_grad_norm = self.max_grad_norm, math.inf

        def clip(*_: Any) -> None:
            nn.utils.clip_grad_norm_(actor, limit)

        self.policy.optimizer.register_step_pre_hook(clip)
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
