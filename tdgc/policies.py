"""Policies and their files: weights as safetensors, everything else as JSON, no pickle anywhere.

A policy on disk is two files side by side: ``NAME.safetensors`` holds the tensors of actor and
critic, ``NAME.json`` says what they mean::

    {"format": "tdgc-policy", "version": 1,
     "kind": "mlp",                                   "mlp" (Sec. IV-A) or "lstm" (Sec. IV-B)
     "architecture": {"activation": "elu",            elu, relu or tanh, after each hidden layer
                      "actor": [256, 128],            hidden sizes
                      "critic": [256, 128],
                      "lstm": null},                  hidden size of both LSTMs; null for "mlp"
     "observation": {"size": 95, "actor_size": 70},   [actor part | critic-only part]
     "mirror": null,                                  or how left and right change places
     "action": {"size": 12, "low": [...], "high": [...]},            null: unbounded
     "sha256": "...",                                 of NAME.safetensors
     "meta": {...}}                                   the caller's: configuration, seed, steps, ...

Tensors are float32, named ``actor.0.weight``, ``actor.0.bias``, ... (the last one gives the mean
action), ``critic.*`` likewise (the last one gives the value), ``log_std``, and for "lstm" also
``actor_lstm.*`` and ``critic_lstm.*`` with ``weight_ih``, ``weight_hh``, ``bias_ih``,
``bias_hh`` (gate order i, f, g, o as in PyTorch).
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import math
import os
import reprlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import safetensors
import safetensors.torch
import torch as th
import torch.nn.functional as F
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from stable_baselines3.common.distributions import DiagGaussianDistribution, Distribution
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import (
    FlattenExtractor,
    MlpExtractor,
    create_mlp,
)
from stable_baselines3.common.type_aliases import Schedule
from torch import nn

from tdgc.errors import InputError

FORMAT = "tdgc-policy"
VERSION = 1
KINDS = ("mlp", "lstm")
ACTIVATIONS: dict[str, type[nn.Module]] = {"elu": nn.ELU, "relu": nn.ReLU, "tanh": nn.Tanh}

Array = NDArray[np.float32]
State = tuple[NDArray[np.float32], ...]

_deserialize: Callable[[bytes], list[tuple[str, dict[str, Any]]]] = safetensors.deserialize

_FUNCTIONS: dict[str, Callable[[th.Tensor], th.Tensor]] = {
    "elu": F.elu, "relu": th.relu, "tanh": th.tanh
}  # fmt: skip
_LSTM_TENSORS = ("weight_ih", "weight_hh", "bias_ih", "bias_hh")
_MAX_JSON_BYTES = 4 * 2**20
_MAX_WEIGHT_BYTES = 256 * 2**20
_MAX_SIZE = 65536  # of any layer, observation or action
_MAX_LAYERS = 32
_MAX_FLOAT32 = float(np.finfo(np.float32).max)
_MAX_TENSOR_HEADER = 65536  # bytes of a safetensors file that are not weights


class PolicyFileError(InputError):
    """A policy file that cannot be used; the message is one line and names the file."""


# ---------------------------------------------------------------------------------------------
# The trained side: an SB3 policy whose critic sees more than its actor


@dataclass(frozen=True)
class Mirror:
    """How an observation and an action look in a left-right mirror.

    ``sign * x[..., index]`` is x mirrored. The observation's part may be longer than the actor's,
    whose entries then come first and stay among themselves.
    """

    obs_index: tuple[int, ...]
    obs_sign: tuple[float, ...]
    action_index: tuple[int, ...]
    action_sign: tuple[float, ...]

    def actor_part(self, size: int) -> Mirror:
        """The same for the first ``size`` entries of the observation.

        Raises:
            ValueError: one of them comes from beyond.
        """
        if any(i >= size for i in self.obs_index[:size]):
            raise ValueError("the mirror mixes the actor's part with the critic's")
        return Mirror(
            self.obs_index[:size], self.obs_sign[:size], self.action_index, self.action_sign
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

    def _get_constructor_parameters(self) -> dict[str, Any]:
        own = {"actor_dim": self.actor_dim, "mirror": self.mirror}
        return {**super()._get_constructor_parameters(), **own}


# ---------------------------------------------------------------------------------------------
# The header: what NAME.json says


@dataclass(frozen=True)
class Header:
    """The content of ``NAME.json``, checked."""

    kind: str
    activation: str
    actor: tuple[int, ...]
    critic: tuple[int, ...]
    lstm: int | None
    obs_dim: int
    actor_dim: int
    low: tuple[float, ...]
    high: tuple[float, ...]
    meta: dict[str, Any]
    mirror: Mirror | None = None  # of the actor's part

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Name and shape of every tensor, in the order they are written."""
        shapes: dict[str, tuple[int, ...]] = {"log_std": (len(self.low),)}
        for net, inputs, hidden, outputs in (
            ("actor", self.actor_dim, self.actor, len(self.low)),
            ("critic", self.obs_dim, self.critic, 1),
        ):
            if self.lstm is not None:
                gates = 4 * self.lstm
                lstm_shapes = ((gates, inputs), (gates, self.lstm), (gates,), (gates,))
                for tensor, shape in zip(_LSTM_TENSORS, lstm_shapes, strict=True):
                    shapes[f"{net}_lstm.{tensor}"] = shape
                inputs = self.lstm
            for i, size in enumerate((*hidden, outputs)):
                shapes[f"{net}.{i}.weight"] = (size, inputs)
                shapes[f"{net}.{i}.bias"] = (size,)
                inputs = size
        return shapes

    def nbytes(self) -> int:
        """Bytes that the weights take, all tensors together."""
        return 4 * sum(math.prod(shape) for shape in self.shapes().values())

    def to_json(self, sha256: str) -> str:
        """The text of ``NAME.json``.

        Raises:
            ValueError: ``meta`` holds something that JSON cannot say.
        """
        table = {
            "format": FORMAT,
            "version": VERSION,
            "kind": self.kind,
            "architecture": {
                "activation": self.activation,
                "actor": list(self.actor),
                "critic": list(self.critic),
                "lstm": self.lstm,
            },
            "observation": {"size": self.obs_dim, "actor_size": self.actor_dim},
            "action": {
                "size": len(self.low),
                "low": [x if math.isfinite(x) else None for x in self.low],
                "high": [x if math.isfinite(x) else None for x in self.high],
            },
            "mirror": None if self.mirror is None else dataclasses.asdict(self.mirror),
            "sha256": sha256,
            "meta": self.meta,
        }
        try:
            return json.dumps(table, indent=2, allow_nan=False) + "\n"
        except (TypeError, ValueError, RecursionError) as error:
            raise ValueError(f"meta cannot be written as JSON: {error}") from None

    @classmethod
    def from_json(cls, text: str) -> tuple[Header, str]:
        """Header and checksum from the text of ``NAME.json``.

        Raises:
            PolicyFileError: not JSON, another format or version, a key too many or too few, a
                value of the wrong type or out of range. Its message does not name the file.
        """
        try:
            table = json.loads(text, parse_constant=_no_constant)
        except (ValueError, RecursionError) as error:
            raise PolicyFileError(f"not JSON ({_one_line(error)})") from None
        if not isinstance(table, dict) or table.get("format") != FORMAT:
            raise PolicyFileError(f"not a {FORMAT} file")
        version = table.get("version")
        if not isinstance(version, int) or isinstance(version, bool) or version != VERSION:
            raise PolicyFileError(f"format version {_shown(version)}; this code reads {VERSION}")
        keys = ("format", "version", "kind", "architecture", "observation", "action", "mirror",
                "sha256", "meta")  # fmt: skip
        _check_keys(table, keys, "the file")
        kind, sha256, meta = table["kind"], table["sha256"], table["meta"]
        if kind not in KINDS:
            raise PolicyFileError(f"kind {_shown(kind)}; known: {', '.join(KINDS)}")
        if not isinstance(sha256, str):
            raise PolicyFileError(f"'sha256' must be a string, not {_shown(sha256)}")
        if not isinstance(meta, dict):
            raise PolicyFileError(f"'meta' must be a table, not {_shown(meta)}")

        arch = table["architecture"]
        _check_keys(arch, ("activation", "actor", "critic", "lstm"), "'architecture'")
        if not isinstance(arch["activation"], str) or arch["activation"] not in ACTIVATIONS:
            known = ", ".join(ACTIVATIONS)
            raise PolicyFileError(f"activation {_shown(arch['activation'])}; known: {known}")
        if (arch["lstm"] is not None) != (kind == "lstm"):
            raise PolicyFileError(f"'lstm' is {_shown(arch['lstm'])} in a file of kind '{kind}'")

        observation = table["observation"]
        _check_keys(observation, ("size", "actor_size"), "'observation'")
        obs_dim = _size(observation["size"], "'size' of 'observation'")
        actor_dim = _size(observation["actor_size"], "'actor_size'")
        if actor_dim > obs_dim:
            raise PolicyFileError(f"'actor_size' {actor_dim} is more than the {obs_dim} there are")

        action = table["action"]
        _check_keys(action, ("size", "low", "high"), "'action'")
        action_dim = _size(action["size"], "'size' of 'action'")
        low = _bounds(action["low"], action_dim, -math.inf, "'low'")
        high = _bounds(action["high"], action_dim, math.inf, "'high'")
        if any(lo > hi for lo, hi in zip(low, high, strict=True)):
            raise PolicyFileError("'low' of 'action' is above 'high'")
        header = cls(
            kind=kind,
            activation=arch["activation"],
            actor=_sizes(arch["actor"], "'actor'"),
            critic=_sizes(arch["critic"], "'critic'"),
            lstm=None if arch["lstm"] is None else _size(arch["lstm"], "'lstm'"),
            obs_dim=obs_dim,
            actor_dim=actor_dim,
            low=low,
            high=high,
            meta=meta,
            mirror=_mirror(table["mirror"], actor_dim, action_dim),
        )
        if header.nbytes() > _MAX_WEIGHT_BYTES:
            raise PolicyFileError(f"{header.nbytes()} bytes of weights, too large to be a policy")
        return header, sha256


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is not JSON")


def _check_keys(table: Any, keys: tuple[str, ...], where: str) -> None:
    if not isinstance(table, dict):
        raise PolicyFileError(f"{where} must be a table of keys, not {_shown(table)}")
    for key in table:
        if key not in keys:
            raise PolicyFileError(f"unknown key {_shown(key)} in {where}")
    for key in keys:
        if key not in table:
            raise PolicyFileError(f"key '{key}' is missing from {where}")


def _size(value: Any, name: str) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or not 1 <= value <= _MAX_SIZE:
        raise PolicyFileError(
            f"{name} must be a whole number in 1..{_MAX_SIZE}, not {_shown(value)}"
        )
    return value


def _sizes(value: Any, name: str) -> tuple[int, ...]:
    if not isinstance(value, list) or len(value) > _MAX_LAYERS:
        raise PolicyFileError(f"{name} must be a list of at most {_MAX_LAYERS} layer sizes")
    return tuple(_size(v, f"{name}[{i}]") for i, v in enumerate(value))


def _mirror(value: Any, obs: int, actions: int) -> Mirror | None:
    if value is None:
        return None
    parts = tuple(f.name for f in dataclasses.fields(Mirror))
    _check_keys(value, parts, "'mirror'")
    for part, size in zip(parts, (obs, obs, actions, actions), strict=True):
        entries = value[part]
        if not isinstance(entries, list) or len(entries) != size:
            raise PolicyFileError(f"'{part}' of 'mirror' must be a list of {size} numbers")
        if part.endswith("index"):
            if any(type(i) is not int for i in entries) or sorted(entries) != list(range(size)):
                raise PolicyFileError(f"'{part}' of 'mirror' must hold 0 to {size - 1}, each once")
        elif any(sign not in (1, -1) for sign in entries):
            raise PolicyFileError(f"'{part}' of 'mirror' must hold 1 and -1 only")
    index, sign, action_index, action_sign = (value[part] for part in parts)
    return Mirror(
        tuple(index), tuple(map(float, sign)), tuple(action_index), tuple(map(float, action_sign))
    )


def _bounds(value: Any, count: int, unbounded: float, name: str) -> tuple[float, ...]:
    if not isinstance(value, list) or len(value) != count:
        raise PolicyFileError(f"{name} of 'action' must be a list of {count} numbers")
    bounds = []
    for number in value:
        if number is None:
            bounds.append(unbounded)
        elif isinstance(number, (int, float)) and not isinstance(number, bool):
            if not abs(number) <= _MAX_FLOAT32:  # a JSON 1e999 reads as inf
                raise PolicyFileError(f"{name} of 'action' holds {_shown(number)}, out of range")
            bounds.append(float(number))
        else:
            raise PolicyFileError(f"{name} of 'action' holds {_shown(number)}, not a number")
    return tuple(bounds)


# ---------------------------------------------------------------------------------------------
# Writing and reading


def save(path: str | os.PathLike[str], policy: ActorCriticPolicy, meta: dict[str, Any]) -> None:
    """Write ``policy`` as ``path.safetensors`` and ``path.json``.

    Each file is replaced atomically, weights first: a reader that comes in between sees a wrong
    checksum, never a half-written file or the wrong meaning.

    Args:
        path: with or without one of the two suffixes; missing folders are made.
        policy: ``AsymmetricActorCriticPolicy``, SB3's ``MlpPolicy`` or sb3-contrib's
            ``MlpLstmPolicy`` (one layer, an LSTM each for actor and critic) and subclasses, with
            a flat Box observation and action and a state-independent standard deviation.
        meta: anything JSON can say: configuration, seed, steps, wall time, code version.

    Raises:
        ValueError: a policy of another make, weights that are not finite, or ``meta`` that JSON
            cannot say; nothing is written then.
        OSError: the files cannot be written.
    """
    header = _describe(policy, meta)
    tensors = {
        name: tensor.detach().to("cpu", th.float32).contiguous()
        for name, tensor in _tensors(policy).items()
    }
    _store(path, header, tensors)


def save_copy(
    path: str | os.PathLike[str],
    policy: Policy,
    changed: Mapping[str, th.Tensor],
    meta: dict[str, Any],
) -> None:
    """Write a loaded policy with some of its weights ``changed``, by name, and another ``meta``.

    Raises:
        ValueError, OSError: as ``save``; or a tensor that the policy has not or of another shape.
    """
    for name, tensor in changed.items():
        if name not in policy.tensors or tensor.shape != policy.tensors[name].shape:
            raise ValueError(f"no tensor {name} of shape {tuple(tensor.shape)} in this policy")
    tensors = {
        name: changed.get(name, tensor).detach().to("cpu", th.float32).contiguous()
        for name, tensor in policy.tensors.items()
    }
    _store(path, dataclasses.replace(policy.header, meta=meta), tensors)


def _store(path: str | os.PathLike[str], header: Header, tensors: dict[str, th.Tensor]) -> None:
    for name, tensor in tensors.items():
        if not bool(tensor.isfinite().all()):
            raise ValueError(f"tensor {name} holds a number that is not finite; not saved")
    weights = safetensors.torch.save(tensors)
    text = header.to_json(hashlib.sha256(weights).hexdigest()).encode()
    if len(text) > _MAX_JSON_BYTES:
        raise ValueError(f"meta takes {len(text)} bytes, more than {_MAX_JSON_BYTES}")
    Header.from_json(text.decode())  # what could not be read back is not written
    stem = _stem(path)
    stem.parent.mkdir(parents=True, exist_ok=True)
    _write(_with_suffix(stem, ".safetensors"), weights)
    _write(_with_suffix(stem, ".json"), text)


def load(path: str | os.PathLike[str]) -> Policy:
    """The policy that ``save`` wrote as ``path`` (with or without one of the two suffixes).

    Raises:
        PolicyFileError: whatever is wrong with the files, in one line.
    """
    header, tensors = _read(path)
    return Policy(header, tensors)


def load_into(path: str | os.PathLike[str], policy: ActorCriticPolicy) -> dict[str, Any]:
    """Copy the weights in ``path`` into an SB3 ``policy`` built with the same sizes.

    For training on from a saved policy. Returns the file's ``meta``.

    Raises:
        PolicyFileError: whatever is wrong with the files, or a policy of another architecture.
    """
    header, tensors = _read(path)
    mine = _describe(policy, header.meta)
    names = ("kind", "activation", "lstm", "actor", "critic", "obs_dim", "actor_dim", "mirror")
    for name in names:
        if getattr(mine, name) != getattr(header, name):
            raise PolicyFileError(
                f"{path}: {name} is {getattr(header, name)}, this policy's {getattr(mine, name)}"
            )
    if len(mine.low) != len(header.low):
        raise PolicyFileError(f"{path}: {len(header.low)} actions, this policy {len(mine.low)}")
    with th.no_grad():
        for name, tensor in _tensors(policy).items():
            tensor.copy_(tensors[name])
    return header.meta


def _stem(path: str | os.PathLike[str]) -> Path:
    path = Path(path)
    return path.with_suffix("") if path.suffix in (".safetensors", ".json") else path


def _with_suffix(stem: Path, suffix: str) -> Path:
    # Not Path.with_suffix, which would eat the ".5" of "low-v1.5".
    return stem.parent / (stem.name + suffix)


def _write(path: Path, data: bytes) -> None:
    temporary = path.parent / f".{path.name}.{os.getpid()}.tmp"
    try:
        with open(temporary, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _read_bytes(path: Path, limit: int) -> bytes:
    try:
        with open(path, "rb") as file:
            data = file.read(limit + 1)
    except FileNotFoundError:
        raise PolicyFileError(f"{path}: no such file") from None
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise PolicyFileError(f"{path}: cannot be read ({_one_line(error)})") from None
    if len(data) > limit:
        raise PolicyFileError(f"{path}: larger than the {limit} bytes it can have")
    return data


def _read(path: str | os.PathLike[str]) -> tuple[Header, dict[str, th.Tensor]]:
    stem = _stem(path)
    header_path, weights_path = _with_suffix(stem, ".json"), _with_suffix(stem, ".safetensors")
    try:
        text = _read_bytes(header_path, _MAX_JSON_BYTES).decode()
    except UnicodeDecodeError:
        raise PolicyFileError(f"{header_path}: not UTF-8 text") from None
    try:
        header, sha256 = Header.from_json(text)
    except PolicyFileError as error:
        raise PolicyFileError(f"{header_path}: {error}") from None

    # The header's sizes are checked by now, and they bound what is read and allocated here.
    shapes, need = header.shapes(), header.nbytes()
    data = _read_bytes(weights_path, need + _MAX_TENSOR_HEADER)
    if len(data) < need:
        raise PolicyFileError(
            f"{weights_path}: {len(data)} bytes, truncated: the architecture needs over {need}"
        )
    if hashlib.sha256(data).hexdigest() != sha256:
        raise PolicyFileError(f"{weights_path}: not the file that {header_path.name} was made for")
    try:
        entries = dict(_deserialize(data))
    except safetensors.SafetensorError as error:
        message = f"{weights_path}: not a safetensors file ({_one_line(error)})"
        raise PolicyFileError(message) from None

    for name in sorted(entries.keys() ^ shapes.keys()):
        what = "is missing" if name in shapes else "is not part of the architecture"
        raise PolicyFileError(f"{weights_path}: tensor {name!r:.60} {what}")
    tensors = {}
    for name, shape in shapes.items():
        entry = entries[name]
        if entry["dtype"] != "F32" or tuple(entry["shape"]) != shape:
            raise PolicyFileError(
                f"{weights_path}: tensor '{name}' is {entry['dtype']} {tuple(entry['shape'])}, "
                f"the architecture needs F32 {shape}"
            )
        array = np.frombuffer(entry["data"], "<f4").astype(np.float32).reshape(shape)
        if not np.isfinite(array).all():
            raise PolicyFileError(f"{weights_path}: tensor '{name}' holds a number not finite")
        tensors[name] = th.from_numpy(array)
    return header, tensors


def _shown(value: Any) -> str:
    return reprlib.repr(value)[:40]  # repr fails on what is nested about as deep as can be read


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:200]


def _describe(policy: ActorCriticPolicy, meta: dict[str, Any]) -> Header:
    """The header of an SB3 policy; ``ValueError`` where the format has no words for it."""
    obs_space, action_space = policy.observation_space, policy.action_space
    for name, space in (("observation", obs_space), ("action", action_space)):
        if not isinstance(space, spaces.Box) or len(space.shape) != 1:
            raise ValueError(f"the {name} space must be a flat Box, not {space}")
    plain = isinstance(policy.action_dist, DiagGaussianDistribution) and not policy.squash_output
    if type(policy.features_extractor) is not FlattenExtractor or not plain:
        raise ValueError("only policies on flat features with a plain Gaussian can be saved")
    if type(policy.mlp_extractor) not in (MlpExtractor, AsymmetricMlpExtractor):
        raise ValueError("only policies with a plain MLP for actor and critic can be saved")
    activations = [name for name, fn in ACTIVATIONS.items() if fn is policy.activation_fn]
    if not activations:
        raise ValueError(f"activation {policy.activation_fn}; known: {', '.join(ACTIVATIONS)}")

    lstm = None
    if isinstance(policy, RecurrentActorCriticPolicy):
        lstm = policy.lstm_actor.hidden_size
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
    )


def _tensors(policy: ActorCriticPolicy) -> dict[str, th.Tensor]:
    """The live parameters of an SB3 policy under the names of the file."""
    extractor = policy.mlp_extractor
    tensors: dict[str, th.Tensor] = {"log_std": cast(th.Tensor, policy.log_std)}
    for net, body, output in (
        ("actor", extractor.policy_net, policy.action_net),
        ("critic", extractor.value_net, policy.value_net),
    ):
        if isinstance(policy, RecurrentActorCriticPolicy):
            lstm = getattr(policy, f"lstm_{net}")
            for tensor in _LSTM_TENSORS:
                tensors[f"{net}_lstm.{tensor}"] = getattr(lstm, f"{tensor}_l0")
        head = output.linear if isinstance(output, MirroredHead) else output
        layers = [m for m in (*body, head) if isinstance(m, nn.Linear)]
        for i, layer in enumerate(layers):
            tensors[f"{net}.{i}.weight"] = layer.weight
            tensors[f"{net}.{i}.bias"] = layer.bias
    return tensors


# ---------------------------------------------------------------------------------------------
# The loaded side


class Actor(nn.Module):
    """The mean action, before it is clipped, after the LSTM if any: (n, inputs) -> (n, actions).

    With a mirror it is exactly symmetric, as with ``MirroredHead``.
    """

    def __init__(self, header: Header, tensors: Mapping[str, th.Tensor]) -> None:
        super().__init__()
        self.activation = _FUNCTIONS[header.activation]
        self.layers = nn.ModuleList()
        for i in range(len(header.actor) + 1):
            weight, bias = tensors[f"actor.{i}.weight"], tensors[f"actor.{i}.bias"]
            layer = nn.Linear(weight.shape[1], weight.shape[0], device="meta")
            layer.load_state_dict({"weight": weight, "bias": bias}, assign=True)
            self.layers.append(layer.requires_grad_(False))
        self.mirror: tuple[th.Tensor, ...] | None = None
        if header.mirror is not None:
            self.mirror = tuple(th.tensor(part) for part in dataclasses.astuple(header.mirror))

    def forward(self, x: th.Tensor) -> th.Tensor:
        if self.mirror is not None:
            obs_index, obs_sign, action_index, action_sign = self.mirror
            x = th.cat([x, x[:, obs_index] * obs_sign])
        for layer in self.layers[:-1]:
            x = self.activation(layer(x))
        x = self.layers[-1](x)
        if self.mirror is not None:
            seen, mirrored = x.chunk(2)
            x = 0.5 * (seen + mirrored[:, action_index] * action_sign)
        return x

    def tensors(self) -> dict[str, th.Tensor]:
        """Its weights by their names in a policy's file."""
        return {f"actor.{name[7:]}": tensor for name, tensor in self.state_dict().items()}


class Policy:
    """A loaded policy: acts as SB3's does, without SB3.

    Attributes:
        header: what its file says.
        kind: "mlp" or "lstm".
        meta: what the caller of ``save`` gave.
        obs_dim: width of the full observation, actor and critic-only part.
        actor_dim: width of the part that the actor sees.
        action_dim: number of actions.
        low, high: bounds of the actions, (action_dim,), in the environment's action units.
        tensors: all weights by the name in the file, the critic's too.
        actor: what of them acts, the LSTM apart.
    """

    def __init__(self, header: Header, tensors: dict[str, th.Tensor]) -> None:
        self.header = header
        self.kind = header.kind
        self.meta = header.meta
        self.obs_dim = header.obs_dim
        self.actor_dim = header.actor_dim
        self.action_dim = len(header.low)
        self.low: Array = np.array(header.low, dtype=np.float32)
        self.high: Array = np.array(header.high, dtype=np.float32)
        self.tensors = tensors
        self._hidden = header.lstm
        self.actor = Actor(header, tensors)
        self._lstm = [tensors[f"actor_lstm.{t}"] for t in _LSTM_TENSORS] if header.lstm else []
        log_std = tensors["log_std"].numpy()
        if header.mirror is not None:
            log_std = 0.5 * (log_std + log_std[list(header.mirror.action_index)])
        self._std: Array = np.exp(log_std)
        self.seed(0)

    def seed(self, seed: int | None) -> None:
        """Restart the noise of ``predict(..., deterministic=False)``."""
        self._rng = np.random.default_rng(seed)

    def predict(
        self,
        obs: ArrayLike,
        state: State | None = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = True,
    ) -> tuple[Array, State | None]:
        """Actions for observations, in SB3's convention.

        Args:
            obs: (n, d) or (d,), where d is ``actor_dim`` or ``obs_dim``; of the latter only the
                actor part is used.
            state: (h, c), each (1, n, hidden), as returned before; None for zeros. For "mlp" it
                is handed back as it came.
            episode_start: (n,) or a scalar, true where the state is to be zeroed first.
            deterministic: the mean action, or else one drawn from the Gaussian.

        Returns:
            Actions clipped to ``low`` and ``high``, (n, action_dim) or (action_dim,), and the new
            state, (h, c) or what was given.

        Raises:
            ValueError: an observation or state of the wrong shape.
        """
        x = np.asarray(obs)
        if x.ndim not in (1, 2) or x.shape[-1] not in (self.actor_dim, self.obs_dim):
            raise ValueError(
                f"observation of shape {x.shape}; its last axis must be {self.actor_dim} wide "
                f"(actor part) or {self.obs_dim} (all)"
            )
        batch: Array = np.array(np.atleast_2d(x)[:, : self.actor_dim], dtype=np.float32)
        with one_thread(), th.inference_mode():
            latent = th.from_numpy(batch)
            if self._hidden is not None:
                h, c = self._previous(state, episode_start, len(batch), self._hidden)
                h, c = th.lstm_cell(latent, (h, c), *self._lstm)
                latent, state = h, (h.numpy()[None], c.numpy()[None])
            actions: Array = self.actor(latent).numpy()
        if not deterministic:
            noise = self._rng.standard_normal(actions.shape, dtype=np.float32)
            actions = actions + self._std * noise
        actions = np.clip(actions, self.low, self.high)
        return (actions if x.ndim == 2 else actions[0]), state

    @staticmethod
    def _previous(
        state: State | None, episode_start: ArrayLike | None, n: int, hidden: int
    ) -> tuple[th.Tensor, th.Tensor]:
        """(h, c), each (n, hidden), with the rows that start an episode at zero."""
        if state is None:
            return th.zeros(n, hidden), th.zeros(n, hidden)
        shapes = [np.shape(part) for part in state]
        if shapes != [(1, n, hidden)] * 2:
            raise ValueError(f"state of shapes {shapes}; it must be two of {(1, n, hidden)}")
        h, c = (np.array(part[0], dtype=np.float32) for part in state)
        if episode_start is not None:
            start = np.broadcast_to(np.asarray(episode_start, dtype=bool), n)
            h[start] = c[start] = 0.0
        return th.from_numpy(h), th.from_numpy(c)


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """PyTorch on one thread, as a context or a decorator.

    The networks are too small to share out: one thread costs nothing when cores are idle, is
    several times faster when they are not, and gives the same bits whatever the setting.
    """
    threads = th.get_num_threads()
    th.set_num_threads(1)
    try:
        yield
    finally:
        th.set_num_threads(threads)
