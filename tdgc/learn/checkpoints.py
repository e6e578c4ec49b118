"""Checkpoints: the state of a run between two updates, to resume from as if it had never stopped.

A checkpoint is a folder with ``state.safetensors`` (parameters, optimiser, LSTM states, the
workers' arrays) and ``state.json`` (counters, random states, the rest of the workers' states, and a
checksum over both files). Loading a checkpoint cannot execute code.
"""

import hashlib
import json
import os
import random
import shutil
import textwrap
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import safetensors
import safetensors.torch
import torch as th
from numpy.typing import NDArray
from sb3_contrib.common.recurrent.type_aliases import RNNStates
from stable_baselines3.common.base_class import BaseAlgorithm

from tdgc import __version__
from tdgc.errors import InputError
from tdgc.files import write_synced
from tdgc.state import State, join, split

_KEEP = 2  # checkpoints: the newest, and the one before in case that is damaged
_VERSION = 17  # to be raised when the state of a run changes: other versions are refused
#: Tensor names of the recurrent learner's LSTM states in the current episodes.
_LSTM = ("lstm.pi.h", "lstm.pi.c", "lstm.vf.h", "lstm.vf.c")


class CheckpointError(InputError):
    """A checkpoint or run folder that cannot be used; the message is one line."""


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """The complete state of the learner and its workers.

    Attributes:
        tensors: by name.
        header: everything that is not a tensor: ``num_timesteps``, ``n_updates``, ``random``, and
            what the run adds: ``workers``, ``phase`` and ``seconds`` of wall time.
    """

    tensors: dict[str, th.Tensor]
    header: dict[str, Any]

    @property
    def steps(self) -> int:
        """Environment steps of the run so far."""
        return int(self.header["num_timesteps"])

    @classmethod
    def take(cls, model: BaseAlgorithm, extra: dict[str, Any]) -> "Checkpoint":
        """Take a checkpoint of a learner between two updates, together with ``extra``."""
        tensors = {f"policy.{k}": v for k, v in model.policy.state_dict().items()}
        optimiser = model.policy.optimizer.state_dict()
        for index, slots in optimiser["state"].items():
            tensors |= {f"optimizer.{index}.{k}": th.as_tensor(v) for k, v in slots.items()}
        memory: RNNStates | None = getattr(model, "_last_lstm_states", None)
        if memory is not None:
            tensors |= zip(_LSTM, (*memory.pi, *memory.vf), strict=True)
        notebook = getattr(model, "notebook", None)
        if notebook is not None:
            tensors |= notebook.tensors()
        arrays: dict[str, NDArray[Any]] = {}
        extra = split(extra, "extra", arrays)
        tensors |= {name: th.from_numpy(array) for name, array in arrays.items()}
        random_tensors, random_states = _random_states()
        header = {
            "format": "tdgc-checkpoint",
            "version": _VERSION,
            "code": __version__,
            "num_timesteps": model.num_timesteps,
            "n_updates": model._n_updates,
            "random": random_states,
            **extra,
        }
        return cls(tensors | random_tensors, header)

    @classmethod
    def read(cls, path: Path) -> "Checkpoint":
        """Read a checkpoint from its folder.

        Raises:
            CheckpointError: missing, damaged or foreign files.
        """
        try:
            data = (path / "state.safetensors").read_bytes()
            header = json.loads((path / "state.json").read_bytes())
            if not isinstance(header, dict) or header.get("format") != "tdgc-checkpoint":
                raise CheckpointError(f"{path}: not a tdgc checkpoint")
            if header.get("version") != _VERSION:
                raise CheckpointError(
                    f"{path}: its format version is {header.get('version')!r}, this code reads "
                    f"{_VERSION}; a new run can begin from the run's policy, with --init"
                )
            for counter in ("num_timesteps", "n_updates"):
                if type(header.get(counter)) is not int or not 0 <= header[counter] < 2**63:
                    raise CheckpointError(f"{path}: '{counter}' is not a count")
            if _checksum(data, header) != header["sha256"]:
                raise CheckpointError(f"{path}: its checksum does not match, it is damaged")
            return cls(safetensors.torch.load(data), header)
        except CheckpointError:
            raise
        except (OSError, ValueError, KeyError, RuntimeError, safetensors.SafetensorError) as error:
            raise CheckpointError(f"{path}: cannot be read: {error}") from error

    @classmethod
    def newest(cls, run: Path, warn: Callable[[str], None]) -> "Checkpoint":
        """Read the newest readable checkpoint of a run; warn of newer ones that are not readable.

        Raises:
            CheckpointError: the run has no readable checkpoint.
        """
        problems: list[CheckpointError] = []
        for path in sorted((run / "checkpoints").glob("step-*"), reverse=True):
            try:
                found = cls.read(path)
            except CheckpointError as error:
                problems.append(error)
            else:
                for problem in problems:
                    warn(f"{problem}; going on from {path.name}")
                return found
        raise problems[0] if problems else CheckpointError(f"{run}: no checkpoint")

    def save(self, folder: Path) -> Path:
        """Write the checkpoint to ``folder`` atomically and delete all but the newest two.

        Raises:
            OSError: it cannot be written; earlier checkpoints are left as they are.
        """
        data = safetensors.torch.save({k: v.contiguous() for k, v in self.tensors.items()})
        header = json.loads(json.dumps(self.header))  # as a reader will parse it
        text = json.dumps({**header, "sha256": _checksum(data, header)})
        final = folder / f"step-{self.steps:012d}"
        partial = folder / f".{final.name}.partial"
        for left in folder.glob(".step-*.partial"):  # by a process that was killed
            shutil.rmtree(left, ignore_errors=True)
        partial.mkdir(parents=True)
        try:
            for name, content in (("state.safetensors", data), ("state.json", text.encode())):
                write_synced(partial / name, content)
            shutil.rmtree(final, ignore_errors=True)
            os.replace(partial, final)
        except OSError:
            shutil.rmtree(partial, ignore_errors=True)  # it may be what filled the disk
            raise
        for old in sorted(folder.glob("step-*"))[:-_KEEP]:
            shutil.rmtree(old)
        return final

    def drop_later(self, folder: Path) -> None:
        """Delete damaged checkpoints in ``folder`` that are later than this one: they would count
        as the newest when the next is saved."""
        for path in folder.glob("step-*"):
            if path.name > f"step-{self.steps:012d}":
                shutil.rmtree(path)

    def restore(self, model: BaseAlgorithm) -> None:
        """Restore ``model`` and the global random states.

        This covers parameters, optimiser, counters, LSTM states and the notebook of rollouts.

        Raises:
            CheckpointError: parameters with different names or shapes, or another number of robots.
        """
        tensors = self.tensors
        try:
            policy = {k: v for k, v in tensors.items() if k.startswith("policy.")}
            model.policy.load_state_dict({k.removeprefix("policy."): v for k, v in policy.items()})
            state = model.policy.optimizer.state_dict()
            state["state"] = {}
            for key, value in tensors.items():
                if key.startswith("optimizer."):
                    _, index, slot = key.split(".")
                    state["state"].setdefault(int(index), {})[slot] = value
            model.policy.optimizer.load_state_dict(state)
            notebook = getattr(model, "notebook", None)
            if notebook is not None:
                notebook.restore(tensors, cast(Any, model).n_steps)
        except (RuntimeError, KeyError, ValueError) as error:
            said = textwrap.shorten(str(error), 200, placeholder="...")
            raise CheckpointError(
                f"the checkpoint does not fit the configuration: {said}"
            ) from error
        if _LSTM[0] in tensors:
            robots = tensors[_LSTM[0]].shape[1]
            if robots != model.n_envs:
                raise CheckpointError(f"the checkpoint is of {robots} robots, not {model.n_envs}")
            h_pi, c_pi, h_vf, c_vf = (tensors[name].to(model.device) for name in _LSTM)
            cast(Any, model)._last_lstm_states = RNNStates(pi=(h_pi, c_pi), vf=(h_vf, c_vf))
        model.num_timesteps = self.steps
        model._n_updates = int(self.header["n_updates"])
        # Generators of a GPU are not saved: give it other noise than at the start of the run.
        th.manual_seed(int(model.seed or 0) + self.steps)
        _restore_random(tensors, self.header["random"])

    def workers(self) -> list[State]:
        """The workers' states, for ``TaskVecEnv.load_state_dicts``."""
        arrays = {k: v.numpy() for k, v in self.tensors.items() if k.startswith("extra.")}
        states: list[State] = join(self.header["workers"], arrays)
        return states


def _checksum(data: bytes, header: dict[str, Any]) -> str:
    """SHA-256 over the tensor file and all other entries of the header."""
    rest = {key: value for key, value in header.items() if key != "sha256"}
    return hashlib.sha256(data + json.dumps(rest, sort_keys=True).encode()).hexdigest()


def _random_states() -> tuple[dict[str, th.Tensor], dict[str, Any]]:
    name, keys, position, has_gauss, gauss = np.random.get_state(legacy=True)
    version, words, carry = random.getstate()
    states = {"numpy": [position, has_gauss, gauss], "python": [version, carry], "kind": name}
    tensors = {
        "random.torch": th.get_rng_state(),
        "random.numpy": th.from_numpy(np.asarray(keys).astype(np.int64)),
        "random.python": th.tensor(words, dtype=th.int64),
    }
    return tensors, states


def _restore_random(tensors: dict[str, th.Tensor], states: dict[str, Any]) -> None:
    th.set_rng_state(tensors["random.torch"].to(th.uint8))
    keys = tensors["random.numpy"].numpy().astype(np.uint32)
    np.random.set_state((states["kind"], keys, *states["numpy"]))
    version, carry = states["python"]
    random.setstate((version, tuple(tensors["random.python"].tolist()), carry))
