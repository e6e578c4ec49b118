"""The lower half of the paper's closed loop: commands -> low policy -> joint targets -> physics."""

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tdgc.sim.locomotion import Locomotion
from tdgc.sim.robot import NUM_JOINTS, Array
from tdgc.sim.sensors import Noise


class Acts(Protocol):
    """What the executor needs from a low policy."""

    def predict(self, obs: NDArray[np.float32]) -> tuple[NDArray[np.floating], Any]:
        """Observations (n, d) -> actions (n, 12), and a second value that is ignored here."""

    def correct(self, commands: Array) -> Array:
        """Commands (n, 15) -> those to give the policy so that it carries them out, (n, 15)."""


class Carries(Protocol):
    """What the closed loop needs from an executor."""

    def step(self, commands: Array, rows: NDArray[np.integer] | None = None) -> None:
        """Run one control step.

        Args:
            commands: (M, 15).
            rows: (n,) the robots that act; the others repeat their last action. All by default.
        """


class Executor:
    """M robots that follow commands through a frozen low policy; implements ``Carries``.

    Args:
        loco: the M robots.
        low: the low policy.
        noise: sensor noise, drawn at each control step; None for exact sensors.
    """

    def __init__(self, loco: Locomotion, low: Acts, noise: Noise | None = None) -> None:
        self.loco, self._low, self._noise = loco, low, noise
        loco.correct = low.correct
        self._actions = np.zeros((loco.num_robots, NUM_JOINTS), dtype=np.float32)

    def step(self, commands: Array, rows: NDArray[np.integer] | None = None) -> None:
        """As ``Carries.step``: observe, ask the low policy, act."""
        self.loco.act(self.decide(commands, rows))

    def decide(
        self, commands: Array, rows: NDArray[np.integer] | None = None
    ) -> NDArray[np.float32]:
        """What ``step`` does next, actions (M, 12)."""
        self.loco.command[:] = commands
        seen = self.loco.observe(self._noise)
        rows = np.arange(len(seen)) if rows is None else rows
        actions, _ = self._low.predict(seen[rows])
        # A robot whose simulation has blown up observes NaN, so its action is not finite either.
        # Step all the same, with action 0: whoever checks its state then detects the blow-up.
        actions[~np.isfinite(actions).all(axis=1)] = 0.0
        self._actions[rows] = actions
        return self._actions
