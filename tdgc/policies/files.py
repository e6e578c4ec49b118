"""Policies and their files: weights as safetensors, everything else as JSON, no pickle anywhere.

A policy on disk is two files side by side: ``NAME.safetensors`` holds the tensors of actor and
critic, ``NAME.json`` describes them::

    {"format": "tdgc-policy", "version": 1,
     "kind": "lstm",                                  "mlp" (Sec. IV-A) or "lstm" (Sec. IV-B)
     "architecture": {"activation": "elu",            elu, relu or tanh, after each hidden layer
                      "actor": [64],                  hidden sizes
                      "critic": [64],
                      "lstm": 64,                     hidden size of both LSTMs; null for "mlp"
                      "encoder": [128],               layer sizes before both LSTMs; omitted if none
                      "correction": [15, 64, 3]},     layer sizes, see Correction; omitted if none
     "observation": {"size": 92, "actor_size": 92},   [actor part | critic-only part]
     "mirror": null,                                  or how left and right swap, see Mirror
     "action": {"size": 13, "low": [...], "high": [...]},            null: unbounded
     "sha256": "...",                                 of NAME.safetensors
     "meta": {...}}                                   the caller's: configuration, seed, steps, ...

Tensors are float32, named ``actor.0.weight``, ``actor.0.bias``, ... (the last one gives the mean
action), ``critic.*`` likewise (the last one gives the value), ``log_std``, and for "lstm" also
``actor_lstm.*`` and ``critic_lstm.*`` with ``weight_ih``, ``weight_hh``, ``bias_ih``,
``bias_hh`` (gate order i, f, g, o as in PyTorch). With an encoder, ``actor_encoder.*`` and
``critic_encoder.*`` are its layers; actor and critic then take the LSTM's output followed by the
encoder's. With a correction, ``correction.*`` are the tensors of ``Correction``.
"""

import dataclasses
import hashlib
import itertools
import json
import math
import os
import reprlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.torch
import torch as th
from torch import nn

from tdgc.errors import InputError
from tdgc.files import atomic, write_synced

FORMAT = "tdgc-policy"
VERSION = 1
KINDS = ("mlp", "lstm")
ACTIVATIONS: dict[str, type[nn.Module]] = {"elu": nn.ELU, "relu": nn.ReLU, "tanh": nn.Tanh}
LSTM_TENSORS = ("weight_ih", "weight_hh", "bias_ih", "bias_hh")

_deserialize: Callable[[bytes], list[tuple[str, dict[str, Any]]]] = safetensors.deserialize

# Limits on what is read from a file that may be damaged: far above any policy of this package, and
# far below what fills a computer's memory.
_MAX_JSON_BYTES = 4 * 2**20
_MAX_WEIGHT_BYTES = 256 * 2**20
_MAX_SIZE = 65536  # of any layer, observation or action
_MAX_LAYERS = 32
_MAX_FLOAT32 = float(np.finfo(np.float32).max)
_MAX_TENSOR_HEADER = 65536  # bytes of a safetensors file beside the weights


class PolicyFileError(InputError):
    """A policy file that cannot be used; the message is one line and names the file."""


@dataclass(frozen=True)
class Mirror:
    """How an observation and an action look in a left-right mirror.

    ``sign * x[..., index]`` is x mirrored. ``obs_index`` and ``obs_sign`` may be longer than the
    actor's part of the observation; the actor's entries then come first and map only to each other.
    """

    obs_index: tuple[int, ...]
    obs_sign: tuple[float, ...]
    action_index: tuple[int, ...]
    action_sign: tuple[float, ...]

    def actor_part(self, size: int) -> "Mirror":
        """The mirror of the first ``size`` entries of the observation.

        Raises:
            ValueError: one of these entries is mirrored from an entry beyond them.
        """
        if any(i >= size for i in self.obs_index[:size]):
            raise ValueError("the mirror mixes the actor's part with the critic's")
        return Mirror(
            self.obs_index[:size], self.obs_sign[:size], self.action_index, self.action_sign
        )


@dataclass(frozen=True)
class Header:
    """The content of ``NAME.json``."""

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
    mirror: Mirror | None = None  # of the actor's part of the observation
    encoder: tuple[int, ...] = ()
    correction: tuple[int, ...] = ()

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Name and shape of every tensor, in the order they are written."""
        shapes: dict[str, tuple[int, ...]] = {"log_std": (len(self.low),)}
        for net, inputs, hidden, outputs in (
            ("actor", self.actor_dim, self.actor, len(self.low)),
            ("critic", self.obs_dim, self.critic, 1),
        ):
            if self.lstm is not None:
                for i, size in enumerate(self.encoder):
                    shapes[f"{net}_encoder.{i}.weight"] = (size, inputs)
                    shapes[f"{net}_encoder.{i}.bias"] = (size,)
                    inputs = size
                gates = 4 * self.lstm
                lstm_shapes = ((gates, inputs), (gates, self.lstm), (gates,), (gates,))
                for tensor, shape in zip(LSTM_TENSORS, lstm_shapes, strict=True):
                    shapes[f"{net}_lstm.{tensor}"] = shape
                inputs = self.lstm + (self.encoder[-1] if self.encoder else 0)
            for i, size in enumerate((*hidden, outputs)):
                shapes[f"{net}.{i}.weight"] = (size, inputs)
                shapes[f"{net}.{i}.bias"] = (size,)
                inputs = size
        if self.correction:
            for name in ("zero", "unit", "sign"):
                shapes[f"correction.{name}"] = self.correction[:1]
            for i, (inputs, size) in enumerate(itertools.pairwise(self.correction)):
                shapes[f"correction.{i}.weight"] = (size, inputs)
                shapes[f"correction.{i}.bias"] = (size,)
        return shapes

    def nbytes(self) -> int:
        """Total size of all weights in bytes."""
        return 4 * sum(math.prod(shape) for shape in self.shapes().values())

    def to_json(self, sha256: str) -> str:
        """The text of ``NAME.json``.

        Raises:
            ValueError: ``meta`` holds something that JSON cannot represent.
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
                **({"encoder": list(self.encoder)} if self.encoder else {}),
                **({"correction": list(self.correction)} if self.correction else {}),
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
    def from_json(cls, text: str) -> tuple["Header", str]:
        """Parse and validate the text of ``NAME.json``; returns the header and the checksum.

        Raises:
            PolicyFileError: not JSON, another format or version, an unknown or missing key, or a
                value of the wrong type or out of range. The message does not name the file.
        """
        table = _table(text)
        parts = {
            **_architecture(table["architecture"], table["kind"]),
            **_observation(table["observation"]),
            **_action(table["action"]),
        }
        mirror = _mirror(table["mirror"], parts["actor_dim"], len(parts["low"]))
        header = cls(kind=table["kind"], meta=table["meta"], mirror=mirror, **parts)
        if header.nbytes() > _MAX_WEIGHT_BYTES:
            raise PolicyFileError(f"{header.nbytes()} bytes of weights, too large to be a policy")
        return header, table["sha256"]


def _table(text: str) -> dict[str, Any]:
    """The table in a header's text, once its format, version and kind are known to be right."""
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
    if table["kind"] not in KINDS:
        raise PolicyFileError(f"kind {_shown(table['kind'])}; known: {', '.join(KINDS)}")
    for key, kind, what in (("sha256", str, "a string"), ("meta", dict, "a table")):
        if not isinstance(table[key], kind):
            raise PolicyFileError(f"'{key}' must be {what}, not {_shown(table[key])}")
    return table


def _architecture(arch: Any, kind: str) -> dict[str, Any]:
    """Fields of ``Header`` from a table 'architecture' in a file of this kind."""
    if isinstance(arch, dict):
        arch = {"encoder": [], "correction": []} | arch  # most files lack these
    keys = ("activation", "actor", "critic", "lstm", "encoder", "correction")
    _check_keys(arch, keys, "'architecture'")
    if not isinstance(arch["activation"], str) or arch["activation"] not in ACTIVATIONS:
        known = ", ".join(ACTIVATIONS)
        raise PolicyFileError(f"activation {_shown(arch['activation'])}; known: {known}")
    if (arch["lstm"] is not None) != (kind == "lstm"):
        raise PolicyFileError(f"'lstm' is {_shown(arch['lstm'])} in a file of kind '{kind}'")
    encoder = _sizes(arch["encoder"], "'encoder'")
    if encoder and kind != "lstm":
        raise PolicyFileError(f"'encoder' is {list(encoder)} in a file of kind '{kind}'")
    correction = _sizes(arch["correction"], "'correction'")
    if correction and (kind != "mlp" or len(correction) < 2 or correction[-1] > correction[0]):
        raise PolicyFileError(f"'correction' is {list(correction)} in a file of kind '{kind}'")
    return {
        "activation": arch["activation"],
        "actor": _sizes(arch["actor"], "'actor'"),
        "critic": _sizes(arch["critic"], "'critic'"),
        "lstm": None if arch["lstm"] is None else _size(arch["lstm"], "'lstm'"),
        "encoder": encoder,
        "correction": correction,
    }


def _observation(table: Any) -> dict[str, Any]:
    """Fields of ``Header`` from a table 'observation'."""
    _check_keys(table, ("size", "actor_size"), "'observation'")
    obs_dim = _size(table["size"], "'size' of 'observation'")
    actor_dim = _size(table["actor_size"], "'actor_size'")
    if actor_dim > obs_dim:
        raise PolicyFileError(f"'actor_size' {actor_dim} is more than the {obs_dim} there are")
    return {"obs_dim": obs_dim, "actor_dim": actor_dim}


def _action(table: Any) -> dict[str, Any]:
    """Fields of ``Header`` from a table 'action'."""
    _check_keys(table, ("size", "low", "high"), "'action'")
    size = _size(table["size"], "'size' of 'action'")
    low = _bounds(table["low"], size, -math.inf, "'low'")
    high = _bounds(table["high"], size, math.inf, "'high'")
    if any(lo > hi for lo, hi in zip(low, high, strict=True)):
        raise PolicyFileError("'low' of 'action' is above 'high'")
    return {"low": low, "high": high}


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


def store(path: str | os.PathLike[str], header: Header, tensors: dict[str, th.Tensor]) -> None:
    """Write both files of a policy, each atomically, weights first.

    Args:
        path: with or without one of the two suffixes; missing folders are created.
        header: content of the JSON file.
        tensors: by name, with the shapes of ``header.shapes()``, on any device; written as float32.

    Raises:
        ValueError: weights that are not finite, or a header that could not be read back.
        OSError: the files cannot be written.
    """
    tensors = {
        name: tensor.detach().to("cpu", th.float32).contiguous() for name, tensor in tensors.items()
    }
    for name, tensor in tensors.items():
        if not bool(tensor.isfinite().all()):
            raise ValueError(f"tensor {name} holds a number that is not finite; not saved")
    weights = safetensors.torch.save(tensors)
    text = header.to_json(hashlib.sha256(weights).hexdigest()).encode()
    if len(text) > _MAX_JSON_BYTES:
        raise ValueError(f"meta takes {len(text)} bytes, more than {_MAX_JSON_BYTES}")
    Header.from_json(text.decode())  # write nothing that cannot be read back
    header_path, weights_path = files_of(path)
    header_path.parent.mkdir(parents=True, exist_ok=True)
    for file, data in ((weights_path, weights), (header_path, text)):
        with atomic(file) as partial:
            write_synced(partial, data)


def files_of(path: str | os.PathLike[str]) -> tuple[Path, Path]:
    """The files of a policy named with or without a suffix: ``NAME.json``, which contains the
    checksum of the other one, and ``NAME.safetensors``."""
    path = Path(path)
    name = path.stem if path.suffix in (".safetensors", ".json") else path.name
    # Not Path.with_suffix, which would drop the ".5" of "low-v1.5".
    return path.parent / f"{name}.json", path.parent / f"{name}.safetensors"


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


def read(path: str | os.PathLike[str]) -> tuple[Header, dict[str, th.Tensor]]:
    """Read what ``store`` wrote: the header, and the tensors by name, float32 in main memory.

    Args:
        path: with or without one of the two suffixes.

    Raises:
        PolicyFileError: a file is missing, damaged, too large or does not match the other one; the
            message names it.
    """
    header_path, weights_path = files_of(path)
    try:
        text = _read_bytes(header_path, _MAX_JSON_BYTES).decode()
    except UnicodeDecodeError:
        raise PolicyFileError(f"{header_path}: not UTF-8 text") from None
    try:
        header, sha256 = Header.from_json(text)
    except PolicyFileError as error:
        raise PolicyFileError(f"{header_path}: {error}") from None

    # The header's sizes are validated by now, so they bound what is read and allocated here.
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
            raise PolicyFileError(f"{weights_path}: tensor '{name}' holds a non-finite number")
        tensors[name] = th.from_numpy(array)
    return header, tensors


def _shown(value: Any) -> str:
    return reprlib.repr(value)[:40]  # plain repr can fail on the deepest nesting that can be read


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())[:200]
