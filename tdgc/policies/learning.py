"""The side that learns: an SB3 policy whose critic sees more than its actor, and its saving."""

import os
from collections.abc import Iterable, Sequence
from typing import Any, cast

import torch as th
from gymnasium import spaces
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from stable_baselines3.common.distributions import DiagGaussianDistribution, Distribution
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import FlattenExtractor, MlpExtractor, create_mlp
from stable_baselines3.common.type_aliases import Schedule
from torch import nn

from tdgc.policies.files import (
    ACTIVATIONS,
    LSTM_TENSORS,
    Header,
    Mirror,
    PolicyFileError,
    read,
    store,
)


class AsymmetricMlpExtractor(nn.Module):
    """Two separate MLPs: the actor's on the first ``actor_dim`` features, the critic's on all.

    With a mirror the latents of an observation and of its mirror image stand side by side, twice
    as wide, for ``MirroredHead`` to average.
    """

    def __init__(
        self,
        actor_dim: int,
        critic_dim: int,
        net_arch: dict[str, list[int]],
        activation_fn: type[nn.Module],
        mirror: Mirror | None = None,
    ) -> None:
        super().__init__()
        self.actor_dim = actor_dim
        actor, critic = net_arch.get("pi", []), net_arch.get("vf", [])
        self.policy_net = nn.Sequential(*create_mlp(actor_dim, -1, actor, activation_fn))
        self.value_net = nn.Sequential(*create_mlp(critic_dim, -1, critic, activation_fn))
        self.latent_dim_pi = actor[-1] if actor else actor_dim
        self.latent_dim_vf = critic[-1] if critic else critic_dim
        self.mirrored = mirror is not None
        if mirror is not None:
            self.register_buffer("index", th.tensor(mirror.obs_index), persistent=False)
            self.register_buffer("sign", th.tensor(mirror.obs_sign), persistent=False)

    def forward(self, features: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """(n, critic_dim) -> latents for the two heads."""
        return self.forward_actor(features), self.forward_critic(features)

    def forward_actor(self, features: th.Tensor) -> th.Tensor:
        """(n, critic_dim) or (n, actor_dim) -> (n, latent_dim_pi), twice that with a mirror."""
        return self._latent(self.policy_net, features[..., : self.actor_dim])

    def forward_critic(self, features: th.Tensor) -> th.Tensor:
        """(n, critic_dim) -> (n, latent_dim_vf), twice that with a mirror."""
        return self._latent(self.value_net, features)

    def _latent(self, net: nn.Module, x: th.Tensor) -> th.Tensor:
        if not self.mirrored:
            return cast(th.Tensor, net(x))
        width = x.shape[-1]
        index, sign = cast(th.Tensor, self.index), cast(th.Tensor, self.sign)
        both = net(th.cat([x, x[..., index[:width]] * sign[:width]]))
        return th.cat(both.chunk(2), dim=-1)


class MirroredHead(nn.Module):
    """Mean of a linear layer on a latent and, mirrored back, on its mirror image's latent.

    So an action's mirror image is exactly the action for the mirrored observation, and a value is
    the same in the mirror: half of what there is to learn.
    """

    def __init__(self, linear: nn.Linear, mirror: Mirror | None) -> None:
        super().__init__()
        self.linear = linear
        index = range(linear.out_features) if mirror is None else mirror.action_index
        sign = [1.0] * linear.out_features if mirror is None else mirror.action_sign
        self.register_buffer("index", th.tensor(list(index)), persistent=False)
        self.register_buffer("sign", th.tensor(sign), persistent=False)

    def forward(self, latents: th.Tensor) -> th.Tensor:
        """(n, 2 latent_dim) -> (n, outputs)."""
        index, sign = cast(th.Tensor, self.index), cast(th.Tensor, self.sign)
        seen, mirrored = (self.linear(x) for x in latents.chunk(2, dim=-1))
        return cast(th.Tensor, 0.5 * (seen + mirrored[..., index] * sign))


class NoMemory(nn.Module):
    """Stands where an LSTM does in a feed-forward policy: it hands on what it is given.

    It is called as ``nn.LSTM`` is; its state is a zero per robot that stays one.

    Attributes:
        input_size, hidden_size, num_layers: as ``nn.LSTM`` has them.
    """

    def __init__(self, input_size: int) -> None:
        super().__init__()
        self.input_size, self.hidden_size, self.num_layers = input_size, 1, 1

    def forward(
        self, x: th.Tensor, state: tuple[th.Tensor, th.Tensor]
    ) -> tuple[th.Tensor, tuple[th.Tensor, th.Tensor]]:
        """(steps, n, input_size) and the state -> both as they came."""
        return x, state


class EncodedLSTM(nn.Module):
    """An LSTM behind an encoder, whose output goes past the LSTM, too.

    What is to be done now need not pass through the memory. It is called as ``nn.LSTM`` is.

    Attributes:
        encoder, lstm: its parts.
        input_size, hidden_size, num_layers: as ``nn.LSTM`` has them, seen from outside.
    """

    def __init__(
        self,
        input_size: int,
        encoder: Sequence[int],
        hidden_size: int,
        activation_fn: type[nn.Module],
    ) -> None:
        super().__init__()
        self.input_size, self.hidden_size, self.num_layers = input_size, hidden_size, 1
        self.encoder = nn.Sequential(*create_mlp(input_size, -1, list(encoder), activation_fn))
        self.lstm = nn.LSTM(encoder[-1], hidden_size)

    def forward(
        self, x: th.Tensor, state: tuple[th.Tensor, th.Tensor]
    ) -> tuple[th.Tensor, tuple[th.Tensor, th.Tensor]]:
        """(steps, n, input_size) and the state -> (steps, n, hidden_size + encoder's last), and
        the state after it."""
        encoded = self.encoder(x)
        remembered, after = self.lstm(encoded, state)
        return th.cat([remembered, encoded], dim=-1), after


#: What may stand where sb3-contrib has an LSTM.
Memory = nn.LSTM | NoMemory | EncodedLSTM


class MirroredLSTM(nn.Module):
    """An LSTM, or what stands in its place, that sees an observation and its mirror image, in two
    halves of a wider state.

    It is called as ``nn.LSTM`` is. ``MirroredMlpExtractor`` and ``MirroredHead`` go on with the
    halves.

    Attributes:
        lstm: what both halves go through.
        input_size, hidden_size, num_layers: as ``nn.LSTM`` has them, seen from outside.
    """

    def __init__(self, lstm: Memory, mirror: Mirror) -> None:
        super().__init__()
        self.lstm = lstm
        self.input_size, self.num_layers = lstm.input_size, lstm.num_layers
        self.hidden_size = 2 * lstm.hidden_size
        self.register_buffer("index", th.tensor(mirror.obs_index), persistent=False)
        self.register_buffer("sign", th.tensor(mirror.obs_sign), persistent=False)

    def forward(
        self, x: th.Tensor, state: tuple[th.Tensor, th.Tensor]
    ) -> tuple[th.Tensor, tuple[th.Tensor, th.Tensor]]:
        """(steps, n, input_size) and two (1, n, hidden_size) -> both sides' outputs side by side,
        and the two after it."""
        index, sign = cast(th.Tensor, self.index), cast(th.Tensor, self.sign)
        both = th.cat([x, x[..., index] * sign], dim=1)
        h, c = (th.cat(part.chunk(2, dim=-1), dim=1) for part in state)
        latent, after = self.lstm(both, (h, c))
        latent, h, c = (th.cat(part.chunk(2, dim=1), dim=-1) for part in (latent, *after))
        return latent, (h, c)


class MirroredMlpExtractor(MlpExtractor):
    """SB3's, on each half of what ``MirroredLSTM`` gives."""

    def forward_actor(self, features: th.Tensor) -> th.Tensor:
        """(n, 2 feature_dim) -> (n, 2 latent_dim_pi)."""
        return th.cat([self.policy_net(x) for x in features.chunk(2, dim=-1)], dim=-1)

    def forward_critic(self, features: th.Tensor) -> th.Tensor:
        """(n, 2 feature_dim) -> (n, 2 latent_dim_vf)."""
        return th.cat([self.value_net(x) for x in features.chunk(2, dim=-1)], dim=-1)


class AsymmetricActorCriticPolicy(ActorCriticPolicy):
    """SB3 policy for a Box observation laid out as [actor part | critic-only part].

    The critic may be told what the robot cannot sense (friction, true velocity, payload); the
    actor sees the first ``actor_dim`` entries and nothing else. Everything that SB3's
    ``ActorCriticPolicy`` takes can be given too; ``net_arch`` and ``activation_fn`` have other
    defaults here.

    With a ``mirror`` the policy is exactly left-right symmetric, and so is its value.

    Raises:
        ValueError: the observation is not a flat Box, or ``actor_dim`` does not fit it.
    """

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        lr_schedule: Schedule,
        *,
        actor_dim: int,
        mirror: Mirror | None = None,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        activation_fn: type[nn.Module] = nn.ELU,
        **kwargs: Any,
    ) -> None:
        shape = observation_space.shape if isinstance(observation_space, spaces.Box) else None
        if shape is None or len(shape) != 1:
            raise ValueError(f"the observation space must be a flat Box, not {observation_space}")
        if not 0 < actor_dim <= shape[0]:
            raise ValueError(f"actor_dim must be in 1..{shape[0]}, not {actor_dim}")
        self.actor_dim, self.mirror = actor_dim, mirror
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            net_arch={"pi": [256, 128], "vf": [256, 128]} if net_arch is None else net_arch,
            activation_fn=activation_fn,
            **kwargs,
        )

    def _build_mlp_extractor(self) -> None:
        arch = self.net_arch
        self.mlp_extractor = AsymmetricMlpExtractor(  # type: ignore[assignment]
            self.actor_dim,
            self.features_dim,
            arch if isinstance(arch, dict) else {"pi": arch, "vf": arch},
            self.activation_fn,
            self.mirror,
        ).to(self.device)

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        if self.mirror is not None:  # the heads keep their parameters, so the optimiser has them
            self.action_net = MirroredHead(cast(nn.Linear, self.action_net), self.mirror)
            self.value_net = MirroredHead(self.value_net, None)  # type: ignore[assignment]

    def symmetric_log_std(self) -> th.Tensor:
        """log sigma of the actions, (action_dim,), the same on both sides with a mirror."""
        log_std = cast(th.Tensor, self.log_std)
        if self.mirror is None:
            return log_std
        return 0.5 * (log_std + log_std[list(self.mirror.action_index)])

    def _get_action_dist_from_latent(self, latent_pi: th.Tensor) -> Distribution:
        distribution = cast(DiagGaussianDistribution, self.action_dist)
        return distribution.proba_distribution(self.action_net(latent_pi), self.symmetric_log_std())


def save(path: str | os.PathLike[str], policy: ActorCriticPolicy, meta: dict[str, Any]) -> None:
    """Write ``policy`` as ``path.safetensors`` and ``path.json``.

    Each file is replaced atomically, weights first: a reader that comes in between sees a wrong
    checksum, never a half-written file or the wrong meaning.

    Args:
        path: with or without one of the two suffixes; missing folders are made.
        policy: ``AsymmetricActorCriticPolicy``, SB3's ``MlpPolicy`` or sb3-contrib's
            ``MlpLstmPolicy`` (one layer, an LSTM each for actor and critic, or ``NoMemory`` or
            ``EncodedLSTM`` in their places) and subclasses, with a flat Box observation and action
            and a state-independent standard deviation.
        meta: anything JSON can say: configuration, seed, steps, wall time, code version.

    Raises:
        ValueError: a policy of another make, weights that are not finite, or ``meta`` that JSON
            cannot say; nothing is written then.
        OSError: the files cannot be written.
    """
    store(path, _describe(policy, meta), _tensors(policy))


def load_into(path: str | os.PathLike[str], policy: ActorCriticPolicy) -> dict[str, Any]:
    """Copy the weights in ``path`` into an SB3 ``policy`` built with the same sizes.

    For training on from a saved policy. Returns the file's ``meta``.

    Raises:
        PolicyFileError: whatever is wrong with the files, or a policy of another architecture.
    """
    header, tensors = read(path)
    mine = _describe(policy, header.meta)
    names = ("kind", "activation", "encoder", "lstm", "actor", "critic", "obs_dim", "actor_dim")
    for name in names:
        if getattr(mine, name) != getattr(header, name):
            raise PolicyFileError(
                f"{path}: {name} is {getattr(header, name)}, this policy's {getattr(mine, name)}"
            )
    if mine.mirror != header.mirror:
        raise PolicyFileError(
            f"{path}: its left-right mirror is not this policy's (ppo.mirror, env.probes)"
        )
    if len(mine.low) != len(header.low):
        raise PolicyFileError(f"{path}: {len(header.low)} actions, this policy {len(mine.low)}")
    with th.no_grad():
        for name, tensor in _tensors(policy).items():
            tensor.copy_(tensors[name])
    return header.meta


def _describe(policy: ActorCriticPolicy, meta: dict[str, Any]) -> Header:
    """The header of an SB3 policy; ``ValueError`` where the format has no words for it."""
    obs_space, action_space = policy.observation_space, policy.action_space
    for name, space in (("observation", obs_space), ("action", action_space)):
        if not isinstance(space, spaces.Box) or len(space.shape) != 1:
            raise ValueError(f"the {name} space must be a flat Box, not {space}")
    plain = isinstance(policy.action_dist, DiagGaussianDistribution) and not policy.squash_output
    if type(policy.features_extractor) is not FlattenExtractor or not plain:
        raise ValueError("only policies on flat features with a plain Gaussian can be saved")
    plain_nets = (MlpExtractor, AsymmetricMlpExtractor, MirroredMlpExtractor)
    if type(policy.mlp_extractor) not in plain_nets:
        raise ValueError("only policies with a plain MLP for actor and critic can be saved")
    activations = [name for name, fn in ACTIVATIONS.items() if fn is policy.activation_fn]
    if not activations:
        raise ValueError(f"activation {policy.activation_fn}; known: {', '.join(ACTIVATIONS)}")

    lstm, encoder = None, tuple[int, ...]()
    if isinstance(policy, RecurrentActorCriticPolicy):
        memory = _inner(policy.lstm_actor)
        if isinstance(memory, EncodedLSTM):
            encoder = tuple(len(layer.weight) for layer in _linear(memory.encoder))
        lstm = None if isinstance(memory, NoMemory) else memory.hidden_size
        if policy.lstm_critic is None or policy.lstm_kwargs or policy.lstm_actor.num_layers != 1:
            raise ValueError("only plain LSTMs of one layer, one each for actor and critic")
    tensors = _tensors(policy)

    def hidden(net: str) -> tuple[int, ...]:
        layers = [t for name, t in tensors.items() if name.startswith(net + ".") and t.dim() == 2]
        return tuple(len(layer) for layer in layers[:-1])

    box = cast(spaces.Box, action_space)
    obs_dim = cast(tuple[int, ...], obs_space.shape)[0]
    actor_dim = getattr(policy, "actor_dim", obs_dim)
    mirror: Mirror | None = getattr(policy, "mirror", None)
    return Header(
        kind="mlp" if lstm is None else "lstm",
        activation=activations[0],
        actor=hidden("actor"),
        critic=hidden("critic"),
        lstm=lstm,
        obs_dim=obs_dim,
        actor_dim=actor_dim,
        low=tuple(float(x) for x in box.low),
        high=tuple(float(x) for x in box.high),
        meta=meta,
        mirror=mirror if mirror is None else mirror.actor_part(actor_dim),
        encoder=encoder,
    )


def _inner(lstm: Memory | MirroredLSTM) -> Memory:
    return lstm.lstm if isinstance(lstm, MirroredLSTM) else lstm


def _linear(layers: Iterable[nn.Module]) -> list[nn.Linear]:
    return [layer for layer in layers if isinstance(layer, nn.Linear)]


def _tensors(policy: ActorCriticPolicy) -> dict[str, th.Tensor]:
    """The live parameters of an SB3 policy under the names of the file."""
    extractor = policy.mlp_extractor
    tensors: dict[str, th.Tensor] = {"log_std": cast(th.Tensor, policy.log_std)}
    for net, body, output in (
        ("actor", extractor.policy_net, policy.action_net),
        ("critic", extractor.value_net, policy.value_net),
    ):
        head = output.linear if isinstance(output, MirroredHead) else output
        parts = {net: _linear((*body, head))}
        if isinstance(policy, RecurrentActorCriticPolicy):
            lstm = _inner(getattr(policy, f"lstm_{net}"))
            if isinstance(lstm, EncodedLSTM):
                parts[f"{net}_encoder"] = _linear(lstm.encoder)
                lstm = lstm.lstm
            if isinstance(lstm, nn.LSTM):
                for tensor in LSTM_TENSORS:
                    tensors[f"{net}_lstm.{tensor}"] = getattr(lstm, f"{tensor}_l0")
        for part, layers in parts.items():
            for i, layer in enumerate(layers):
                tensors[f"{part}.{i}.weight"] = layer.weight
                tensors[f"{part}.{i}.bias"] = layer.bias
    return tensors
