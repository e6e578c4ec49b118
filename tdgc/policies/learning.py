"""Training: an SB3 policy whose critic sees more than its actor, network parts, and saving."""

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

    With a mirror, the latents of an observation and of its mirror image are concatenated, twice as
    wide, for ``MirroredHead`` to average.
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
            return net(x)
        width = x.shape[-1]
        index, sign = cast(th.Tensor, self.index), cast(th.Tensor, self.sign)
        both = net(th.cat([x, x[..., index[:width]] * sign[:width]]))
        return th.cat(both.chunk(2), dim=-1)


class MirroredHead(nn.Module):
    """Mean of a linear layer's output and its mirrored-back output for the mirror image's latent.

    The action for a mirrored observation is thus exactly the mirrored action, and the value is the
    same for both, which halves what there is to learn.
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
        return 0.5 * (seen + mirrored[..., index] * sign)


class NoMemory(nn.Module):
    """Identity in place of an LSTM, for a feed-forward policy.

    It is called like ``nn.LSTM``; its state is one zero per robot that never changes.

    Attributes:
        input_size, hidden_size, num_layers: as in ``nn.LSTM``.
    """

    def __init__(self, input_size: int) -> None:
        super().__init__()
        self.input_size, self.hidden_size, self.num_layers = input_size, 1, 1

    def forward(
        self, x: th.Tensor, state: tuple[th.Tensor, th.Tensor]
    ) -> tuple[th.Tensor, tuple[th.Tensor, th.Tensor]]:
        """(steps, n, input_size) and the state -> both unchanged."""
        return x, state


class EncodedLSTM(nn.Module):
    """An LSTM behind an encoder whose output also bypasses the LSTM.

    Immediate reactions thus need not pass through the memory. It is called like ``nn.LSTM``.

    Attributes:
        encoder, lstm: its parts.
        input_size, hidden_size, num_layers: as in ``nn.LSTM``, for the module as a whole.
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
        """Run the encoder and the LSTM.

        (steps, n, input_size) and the state -> (steps, n, hidden_size + the encoder's last size)
        and the new state.
        """
        encoded = self.encoder(x)
        remembered, after = self.lstm(encoded, state)
        return th.cat([remembered, encoded], dim=-1), after


#: Modules that can take the place of sb3-contrib's LSTM.
Memory = nn.LSTM | NoMemory | EncodedLSTM


class MirroredLSTM(nn.Module):
    """An LSTM, or a module in its place, that processes an observation and its mirror image.

    The two sides occupy the halves of a state twice as wide. The module is called like ``nn.LSTM``;
    ``MirroredMlpExtractor`` and ``MirroredHead`` process the halves further.

    Attributes:
        lstm: the module that both sides pass through.
        input_size, hidden_size, num_layers: as in ``nn.LSTM``, for the module as a whole.
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
        """Run the LSTM on both sides.

        (steps, n, input_size) and h and c, each (1, n, hidden_size) -> both sides' outputs,
        concatenated along the last axis, and the new h and c.
        """
        index, sign = cast(th.Tensor, self.index), cast(th.Tensor, self.sign)
        both = th.cat([x, x[..., index] * sign], dim=1)
        h, c = (th.cat(part.chunk(2, dim=-1), dim=1) for part in state)
        latent, after = self.lstm(both, (h, c))
        latent, h, c = (th.cat(part.chunk(2, dim=1), dim=-1) for part in (latent, *after))
        return latent, (h, c)


class MirroredMlpExtractor(MlpExtractor):
    """SB3's ``MlpExtractor``, applied to each half of the output of ``MirroredLSTM``."""

    def forward_actor(self, features: th.Tensor) -> th.Tensor:
        """(n, 2 feature_dim) -> (n, 2 latent_dim_pi)."""
        return th.cat([self.policy_net(x) for x in features.chunk(2, dim=-1)], dim=-1)

    def forward_critic(self, features: th.Tensor) -> th.Tensor:
        """(n, 2 feature_dim) -> (n, 2 latent_dim_vf)."""
        return th.cat([self.value_net(x) for x in features.chunk(2, dim=-1)], dim=-1)


class AsymmetricActorCriticPolicy(ActorCriticPolicy):
    """SB3 policy for a Box observation laid out as [actor part | critic-only part].

    The critic can see what the robot cannot sense (friction, true velocity, payload); the actor
    sees only the first ``actor_dim`` entries. All other arguments of SB3's ``ActorCriticPolicy``
    but ``use_sde`` can be used; ``net_arch`` and ``activation_fn`` have different defaults here.

    With a ``mirror``, the policy and its value are exactly left-right symmetric.

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
        if self.mirror is not None:  # parameters stay the same, so the optimiser remains valid
            self.action_net = MirroredHead(cast(nn.Linear, self.action_net), self.mirror)
            self.value_net = MirroredHead(self.value_net, None)  # type: ignore[assignment]

    def symmetric_log_std(self) -> th.Tensor:
        """Log standard deviation of the actions, (action_dim,); symmetric with a mirror."""
        log_std = cast(th.Tensor, self.log_std)
        if self.mirror is None:
            return log_std
        return 0.5 * (log_std + log_std[list(self.mirror.action_index)])

    def _get_action_dist_from_latent(self, latent_pi: th.Tensor) -> Distribution:
        distribution = cast(DiagGaussianDistribution, self.action_dist)
        return distribution.proba_distribution(self.action_net(latent_pi), self.symmetric_log_std())


def save(path: str | os.PathLike[str], policy: ActorCriticPolicy, meta: dict[str, Any]) -> None:
    """Write ``policy`` as ``path.safetensors`` and ``path.json``.

    Each file is replaced atomically, weights first: a reader in between sees a checksum that does
    not match, never a half-written file or weights under the wrong header.

    Args:
        path: with or without one of the two suffixes; missing folders are created.
        policy: ``AsymmetricActorCriticPolicy``, SB3's ``MlpPolicy`` or sb3-contrib's
            ``MlpLstmPolicy`` (one layer, an LSTM each for actor and critic, or ``NoMemory`` or
            ``EncodedLSTM`` in their places) and subclasses, with a flat Box observation and action
            and a state-independent standard deviation.
        meta: anything JSON can represent: configuration, seed, steps, wall time, code version.

    Raises:
        ValueError: an unsupported policy, weights that are not finite, or ``meta`` that JSON
            cannot represent; nothing is written then.
        OSError: the files cannot be written.
    """
    store(path, _describe(policy, meta), _tensors(policy))


def load_into(path: str | os.PathLike[str], policy: ActorCriticPolicy) -> dict[str, Any]:
    """Copy the weights in ``path`` into an SB3 ``policy`` built with the same sizes.

    This is for continuing to train a saved policy. Returns the file's ``meta``.

    Raises:
        PolicyFileError: the files cannot be used, or ``policy`` has another architecture.
        ValueError: ``policy`` is of a kind that cannot be saved.
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
    """The header of an SB3 policy; ``ValueError`` if the format cannot represent the policy."""
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
    """The live parameters of an SB3 policy by their names in the file."""
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
