"""The Gymnasium interface that both MDPs share."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from tdgc.parallel.worker import are_sane


class TaskEnv(gym.Env[NDArray[np.float32], NDArray[np.float32]]):
    """A task with one robot as a Gymnasium environment.

    This is the MDP used in training: dynamics are randomised, the robot is pushed, sensors are
    noisy, and levels change with success. ``reset`` keeps the robot's level; ``reset(seed=...)``
    rebuilds the task from that seed, so that everything after it is repeatable.
    ``info["is_success"]`` reports whether the robot has reached its goal or crossed its tile. As in
    training, a robot that blows up earns nothing in that step and is truncated.

    Args:
        make_task: (seed, whether to render) -> a task with one robot.
        render_mode: None, or rgb_array for images of 640 x 400 pixels.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 50}  # noqa: RUF012  as in gymnasium

    def __init__(self, make_task: Callable[[int, bool], Any], render_mode: str | None) -> None:
        self.render_mode = render_mode
        self._make_task = make_task
        # So that environments made without a seed differ.
        self.task = make_task(int(np.random.SeedSequence().generate_state(1)[0]), self._rendered)
        self.action_space = self.task.action_space
        self.observation_space = self.task.observation_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        super().reset(seed=seed)
        if seed is not None:
            if seed >= 2**32:  # more than a tile can be drawn from
                seed = int(np.random.SeedSequence(seed).generate_state(1)[0])
            self.task.close()
            self.task = self._make_task(seed, self._rendered)
        self.task.reset(np.arange(1))
        self._seen = self.task.observe()[0]
        return self._seen, {}

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        reward, terminated, truncated = self.task.step(np.asarray(action)[None])
        info = {"is_success": bool(self.task.reached[0])}
        seen = self.task.observe()
        if not are_sane(seen, reward)[0]:
            self.task.restart()
            return self._seen, 0.0, False, True, info
        self._seen = seen[0]
        return self._seen, float(reward[0]), bool(terminated[0]), bool(truncated[0]), info

    @property
    def _rendered(self) -> bool:
        return self.render_mode is not None

    def render(self) -> NDArray[np.uint8] | None:
        return self.task.world.picture(0) if self._rendered else None

    def close(self) -> None:
        self.task.close()
