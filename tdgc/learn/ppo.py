"""PPO settings shared by both trainers, and their learning rate schedules."""

from dataclasses import dataclass
from typing import Any

import torch as th

from tdgc.config import ConfigError, PPOConfig, RecurrentPPOConfig

_SHARED = (
    "n_steps", "n_epochs", "gamma", "gae_lambda", "clip_range", "ent_coef", "vf_coef",
    "max_grad_norm",
)  # fmt: skip


def check_batch(name: str, steps: int) -> None:
    """Refuse a batch of one step, because PPO normalises the advantages of each batch.

    Raises:
        ConfigError: there is only one; ``name`` is what the message calls ``steps``.
    """
    if steps < 2:
        raise ConfigError(f"{name} must be at least 2, not {steps}")


def shared_keywords(ppo: PPOConfig | RecurrentPPOConfig) -> dict[str, Any]:
    """Keyword arguments common to SB3's PPO and RecurrentPPO."""
    return {name: getattr(ppo, name) for name in _SHARED}


@dataclass
class LinearRate:
    """A learning rate that falls linearly over the run, from ``first`` to ``last``."""

    first: float
    last: float

    def __call__(self, remaining: float) -> float:
        """Learning rate at the remaining share of the run, 1 to 0.

        The last rollout may end beyond the run, where SB3 gives a share below 0.
        """
        return self.last + max(remaining, 0.0) * (self.first - self.last)


@dataclass
class NoiseScaledRate(LinearRate):
    """A ``LinearRate`` times the mean standard deviation of the actions, see ``PPOConfig``.

    Attributes:
        initial_std: standard deviation used until ``log_std`` is set.
        log_std: the policy's parameter, to be set once the policy is built.
    """

    initial_std: float
    log_std: th.Tensor | None = None

    def __call__(self, remaining: float) -> float:
        """Learning rate at the remaining share of the run, 1 to 0."""
        std = self.initial_std
        if self.log_std is not None:
            std = float(self.log_std.detach().exp().mean())
        return super().__call__(remaining) * std
