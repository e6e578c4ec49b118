"""What both trainers tell SB3's PPO: the settings they share, and learning rates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import torch as th


class SharedSettings(Protocol):
    """Settings that ``PPOConfig`` and ``RecurrentPPOConfig`` have in common."""

    @property
    def n_steps(self) -> int: ...
    @property
    def n_epochs(self) -> int: ...
    @property
    def gamma(self) -> float: ...
    @property
    def gae_lambda(self) -> float: ...
    @property
    def clip_range(self) -> float: ...
    @property
    def ent_coef(self) -> float: ...
    @property
    def vf_coef(self) -> float: ...
    @property
    def max_grad_norm(self) -> float: ...


def shared_keywords(ppo: SharedSettings) -> dict[str, Any]:
    """Keyword arguments of SB3's PPO and RecurrentPPO."""
    return {
        "n_steps": ppo.n_steps,
        "n_epochs": ppo.n_epochs,
        "gamma": ppo.gamma,
        "gae_lambda": ppo.gae_lambda,
        "clip_range": ppo.clip_range,
        "ent_coef": ppo.ent_coef,
        "vf_coef": ppo.vf_coef,
        "max_grad_norm": ppo.max_grad_norm,
    }


@dataclass
class LinearRate:
    """A learning rate that falls linearly over the run, from ``first`` to ``last``."""

    first: float
    last: float

    def __call__(self, remaining: float) -> float:
        """At the share of the run that remains, 1 to 0."""
        return self.last + remaining * (self.first - self.last)


@dataclass
class NoiseScaledRate(LinearRate):
    """A ``LinearRate`` times the mean standard deviation of the actions, see ``PPOConfig``.

    Attributes:
        initial_std: before there is a policy.
        log_std: the policy's parameter, to be set once it is built.
    """

    initial_std: float
    log_std: th.Tensor | None = None

    def __call__(self, remaining: float) -> float:
        """At the share of the run that remains, 1 to 0."""
        std = self.initial_std
        if self.log_std is not None:
            std = float(self.log_std.detach().exp().mean())
        return super().__call__(remaining) * std
