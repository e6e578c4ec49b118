"""Inference: load a policy from its file and run it without SB3."""

import contextlib
import dataclasses
import os
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
import torch as th
import torch.nn.functional as F
from numpy.typing import ArrayLike, NDArray
from torch import nn

from tdgc.policies.correction import Correction, frozen_linear
from tdgc.policies.files import LSTM_TENSORS, Header, PolicyFileError, read, store

Array = NDArray[np.float32]
State = tuple[NDArray[np.float32], ...]

_FUNCTIONS: dict[str, Callable[[th.Tensor], th.Tensor]] = {
    "elu": F.elu, "relu": th.relu, "tanh": th.tanh
}  # fmt: skip


class Actor(nn.Module):
    """The actor's MLP, behind the LSTM if any: (n, inputs) -> mean actions before clipping.

    The mean actions are (n, actions). With a mirror they are exactly symmetric, as with
    ``MirroredHead``; from an LSTM it then takes the latents of both sides, (2n, inputs).
    """

    def __init__(self, header: Header, tensors: Mapping[str, th.Tensor]) -> None:
        super().__init__()
        self.activation = _FUNCTIONS[header.activation]
        self.layers = nn.ModuleList(
            frozen_linear(tensors[f"actor.{i}.weight"], tensors[f"actor.{i}.bias"])
            for i in range(len(header.actor) + 1)
        )
        self.recurrent = header.lstm is not None
        self.mirror: tuple[th.Tensor, ...] | None = None
        if header.mirror is not None:
            self.mirror = tuple(th.tensor(part) for part in dataclasses.astuple(header.mirror))

    def both_sides(self, x: th.Tensor) -> th.Tensor:
        """Observations (n, size), with a mirror followed by their mirror images, (2n, size)."""
        if self.mirror is None:
            return x
        obs_index, obs_sign, _, _ = self.mirror
        return th.cat([x, x.index_select(1, obs_index) * obs_sign])

    def forward(self, x: th.Tensor) -> th.Tensor:
        # For a recurrent policy, x comes from an LSTM that already processed both sides.
        x = x if self.recurrent else self.both_sides(x)
        for layer in self.layers[:-1]:
            x = self.activation(layer(x))
        x = self.layers[-1](x)
        if self.mirror is not None:
            _, _, action_index, action_sign = self.mirror
            seen, mirrored = x.chunk(2)
            x = 0.5 * (seen + mirrored.index_select(1, action_index) * action_sign)
        return x


class Policy:
    """A loaded policy that acts as SB3's does, without SB3.

    Attributes:
        header: of its file.
        kind: "mlp" or "lstm".
        meta: as given by the caller of ``save``.
        obs_dim: width of the full observation, actor and critic-only part.
        actor_dim: width of the part that the actor sees.
        action_dim: number of actions.
        low, high: bounds of the actions, (action_dim,), in the environment's action units.
        tensors: all weights by name in the file, including the critic's.
        actor: the actor's MLP, without LSTM and encoder.
        correction: of the commands, see ``correct``; None if there is none.
        state_size: width of h and of c, 0 for "mlp"; with a mirror twice the LSTM's size: first the
            observed side, then its mirror image.
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
        sides = 1 if header.mirror is None else 2
        self.state_size = sides * header.lstm if header.lstm else 0
        self.actor = Actor(header, tensors)
        self.correction: Correction | None = None
        if header.correction:
            start = len("correction.")
            named = {n[start:]: t for n, t in tensors.items() if n.startswith("correction.")}
            self.correction = Correction(header.correction, named)
        self._lstm = [tensors[f"actor_lstm.{t}"] for t in LSTM_TENSORS] if header.lstm else []
        names = [f"actor_encoder.{i}" for i in range(len(header.encoder))]
        self._encoder = [(tensors[f"{n}.weight"], tensors[f"{n}.bias"]) for n in names]
        log_std = tensors["log_std"].numpy()
        if header.mirror is not None:
            log_std = 0.5 * (log_std + log_std[list(header.mirror.action_index)])
        self._std: Array = np.exp(log_std)
        self.seed(0)

    def seed(self, seed: int | None) -> None:
        """Seed the noise of ``predict(..., deterministic=False)``."""
        self._rng = np.random.default_rng(seed)

    def correct(self, commands: NDArray[np.float64]) -> NDArray[np.float64]:
        """Commands to give a low policy so that it does what ``commands`` (n, 15) ask for, (n, 15).

        Only the velocities differ, and those only for a calibrated policy.
        """
        if self.correction is None:
            return commands
        with torch_threads(1), th.inference_mode():
            return np.asarray(self.correction(th.tensor(commands)).numpy())

    def predict(
        self,
        obs: ArrayLike,
        state: State | None = None,
        episode_start: ArrayLike | None = None,
        deterministic: bool = True,
    ) -> tuple[Array, State | None]:
        """Compute actions for observations, in SB3's convention.

        Args:
            obs: (n, d) or (d,), where d is ``actor_dim`` or ``obs_dim``; of the latter only the
                actor part is used.
            state: (h, c), each (1, n, state_size), as returned before; None for zeros. For "mlp"
                it is returned unchanged.
            episode_start: (n,) or a scalar, true where the state is to be zeroed first.
            deterministic: return the mean action; otherwise sample from the Gaussian.

        Returns:
            Actions clipped to ``low`` and ``high``, (n, action_dim) or (action_dim,), and the new
            state (h, c), or for "mlp" the given one.

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
        with torch_threads(1), th.inference_mode():
            latent = th.from_numpy(batch)
            if self.state_size:
                before = self._previous(state, episode_start, len(batch), self.state_size)
                latent, after = self.remember(latent, before)
                state = (after[0].numpy()[None], after[1].numpy()[None])
            actions: Array = self.actor(latent).numpy()
        if not deterministic:
            noise = self._rng.standard_normal(actions.shape, dtype=np.float32)
            actions = actions + self._std * noise
        actions = np.clip(actions, self.low, self.high)
        return (actions if x.ndim == 2 else actions[0]), state

    def remember(
        self, x: th.Tensor, state: tuple[th.Tensor, th.Tensor]
    ) -> tuple[th.Tensor, tuple[th.Tensor, th.Tensor]]:
        """Run one step of the encoder, if any, and the LSTM.

        Args:
            x: (n, inputs).
            state: h and c, each (n, state_size).

        Returns:
            Latents for the actor, (n, latent), with a mirror (2n, latent); and the new h and c.
        """
        sides = 1 if self.actor.mirror is None else 2
        x = self.actor.both_sides(x)
        for weight, bias in self._encoder:
            x = self.actor.activation(F.linear(x, weight, bias))
        h, c = (th.cat(part.chunk(sides, dim=-1)) for part in state)
        h, c = th.lstm_cell(x, (h, c), *self._lstm)
        latent = th.cat([h, x], dim=-1) if self._encoder else h
        return latent, (th.cat(h.chunk(sides), dim=-1), th.cat(c.chunk(sides), dim=-1))

    @staticmethod
    def _previous(
        state: State | None, episode_start: ArrayLike | None, n: int, hidden: int
    ) -> tuple[th.Tensor, th.Tensor]:
        """(h, c), each (n, hidden), with the rows that start an episode zeroed."""
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
def torch_threads(number: int) -> Iterator[None]:
    """Run PyTorch on ``number`` threads, as a context manager or a decorator.

    The networks are too small to parallelise: with one thread they are as fast when cores are idle,
    several times faster when they are busy, and give the same bits whatever the thread setting.
    """
    before = th.get_num_threads()
    th.set_num_threads(number)
    try:
        yield
    finally:
        th.set_num_threads(before)


def load(path: str | os.PathLike[str]) -> Policy:
    """Load the policy that ``save`` wrote as ``path`` (with or without one of the two suffixes).

    Raises:
        PolicyFileError: the files cannot be used; the message is one line.
    """
    header, tensors = read(path)
    try:
        return Policy(header, tensors)
    except PolicyFileError as error:
        raise PolicyFileError(f"{path}: {error}") from None


def without_correction(policy: Policy) -> Policy:
    """The policy as it was before its calibration."""
    tensors = {n: t for n, t in policy.tensors.items() if not n.startswith("correction.")}
    return Policy(dataclasses.replace(policy.header, correction=()), tensors)


def save_copy(
    path: str | os.PathLike[str],
    policy: Policy,
    meta: dict[str, Any],
    correction: Correction | None = None,
) -> None:
    """Write a loaded policy with a new ``meta``, and with a ``correction`` if one is given.

    Raises:
        ValueError: as for ``save``.
        OSError: the files cannot be written.
    """
    header, tensors = dataclasses.replace(policy.header, meta=meta), policy.tensors
    if correction is not None:
        header = dataclasses.replace(header, correction=correction.sizes)
        tensors = tensors | correction.tensors()
    store(path, header, tensors)
