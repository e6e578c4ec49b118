"""Drivers that decide on commands: the high policy, the paper's scripted baseline, the teacher."""

from abc import ABC, abstractmethod
from dataclasses import fields
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tdgc import policies
from tdgc.config import (
    CommandRanges,
    ConfigError,
    HighLevelConfig,
    LowLevelConfig,
    RobotConfig,
    recorded,
)
from tdgc.policies import Policy
from tdgc.sim.commands import INDEX, NUM_ACTIONS, CommandDecoder, default_command
from tdgc.sim.locomotion import Locomotion
from tdgc.sim.observation import width
from tdgc.sim.robot import Array, to_goal, wrap_angle
from tdgc.sim.sensors import Noise
from tdgc.tasks.high_observation import SEMANTIC, HighObserver, high_layout, semantic_index
from tdgc.tasks.pairing import MisfitError, paired
from tdgc.tasks.rules import episode_steps
from tdgc.tasks.teacher import Skill, Teacher, toward


class Driver(ABC):
    """Drives robots to their goals, one control step at a time.

    Attributes:
        config: the MDP of its decisions, with cues "none" if it uses no cues.
        bounds: ranges that its commands stay within.
        action: (M, 13) of the last decision, not decoded; None if the driver decodes none.
        told: family that the driver is told; None if it uses no such cue.
        probes: (M, 32) m, heights used by the last decision; None if the driver uses none.
    """

    config: HighLevelConfig
    bounds: CommandRanges
    action: NDArray[np.floating] | None = None
    told: str | None = None
    probes: Array | None = None

    @abstractmethod
    def begin(self, loco: Locomotion, goal: Array, family: str, noise: Noise | None = None) -> None:
        """Begin new episodes for all robots of ``loco``.

        Args:
            loco: M robots at their starts.
            goal: (M, 2) m in the world.
            family: family that the semantic cue reports, or "unknown".
            noise: noise of the height probes; None for exact ones.
        """

    @abstractmethod
    def command(self, step: int) -> Array:
        """Return commands (M, 15) for control step number ``step``, the next one."""


class BaselineDriver(Driver):
    """``gp``, the paper's baseline: a script that drives the same frozen low policy.

    The robot trots towards the goal with default behaviour parameters except for swing and body
    height, whatever the family; it uses no terrain cues. It decides at every control step. Its
    settings were tuned on tiles of ``--seed 1`` (docs/experiments.md).

    Commands outside ``bounds`` are clipped, because there is one setting for all low policies.

    Args:
        bounds: command ranges that the low policy was trained on; those of ``CommandRanges`` by
            default.
    """

    top_speed = 0.6  # m/s
    swing_height = 0.2  # m
    body_height = 0.04  # m, added to the standing height

    def __init__(self, bounds: CommandRanges | None = None) -> None:
        self.bounds = bounds or CommandRanges()
        self.config = HighLevelConfig(cues="none", commands=self.bounds)
        self._decoder = CommandDecoder(self.bounds)

    def begin(self, loco: Locomotion, goal: Array, family: str, noise: Noise | None = None) -> None:
        self._loco, self._goal = loco, goal
        self._command = np.tile(default_command(), (loco.num_robots, 1))
        self._command[:, INDEX["swing_height"]] = self.swing_height
        self._command[:, INDEX["body_height"]] = self.body_height

    def command(self, step: int) -> Array:
        state = self._loco.world.state
        distance, direction = to_goal(state, self._goal)
        speed, turn = toward(distance, wrap_angle(direction - state.yaw), self.top_speed)
        self._command[:, INDEX["vx"]], self._command[:, INDEX["yaw_rate"]] = speed, turn
        return self._decoder.nearest(self._command)


class TeacherDriver(Driver):
    """Drives robots by the scripted teacher, which decides as often as a high policy with default
    settings.

    It is told what the hierarchy has to infer, so it is no competitor: it shows what the low policy
    can do under good commands.

    Args:
        config: the MDP of the low policy.
        skill: of the low policy.
    """

    def __init__(self, config: LowLevelConfig, skill: Skill) -> None:
        self._skill, self.bounds = skill, config.commands
        self.config = HighLevelConfig(cues="none", commands=self.bounds)

    def begin(self, loco: Locomotion, goal: Array, family: str, noise: Noise | None = None) -> None:
        self._loco, self._goal = loco, goal
        assert loco.world.field is not None  # episodes run on tiles
        self._teacher = Teacher(loco.world.field, self.bounds, loco.robot, self._skill)
        self._teacher.begin(np.arange(loco.num_robots), goal)

    def command(self, step: int) -> Array:
        decision, held = divmod(step, self.config.decimation)
        if held == 0:
            if decision:  # as in training, which looks back on a decision
                seconds = self.config.decimation * self._loco.physics.control_dt
                self._teacher.watch(self._loco, seconds)
            self._command = self._teacher.commands(self._loco, self._goal)
        return self._command


class Decides(Protocol):
    """What the hierarchy needs from a high policy."""

    def predict(self, obs: NDArray[np.float32], state: Any) -> tuple[NDArray[np.floating], Any]:
        """Map o^H of M robots and the previous state, None at first, to actions (M, 13) and the
        next state."""


class HierarchyDriver(Driver):
    """Drives robots by the high policy (paper Sec. IV-B), ``tdgc``, recurrent or feed-forward.

    Decisions are deterministic; their commands are held for ``decimation`` control steps.

    Args:
        high, config: the high policy and its MDP, as ``load_high`` returns them.

    Attributes:
        high, config: as given.
    """

    def __init__(self, high: Decides, config: HighLevelConfig) -> None:
        self.high, self.config = high, config
        assert config.commands is not None  # filled in by ``load_high``
        self.bounds = config.commands
        self._decoder = CommandDecoder(config.commands, config.action_limit, config.gaits)

    def begin(self, loco: Locomotion, goal: Array, family: str, noise: Noise | None = None) -> None:
        m, config = loco.num_robots, self.config
        self._loco, self._goal = loco, goal
        seen = semantic_index(family)
        self._families = np.full(m, seen)
        if config.cues in ("both", "semantic"):
            self.told = SEMANTIC[seen]
        self._observer = HighObserver(loco, config, noise)
        seconds = config.decimation * loco.physics.control_dt
        self._horizon = episode_steps(config.episode_seconds, seconds)
        self._state: Any = None
        self._last = np.zeros((m, NUM_ACTIONS))

    def command(self, step: int) -> Array:
        decision, held = divmod(step, self.config.decimation)
        if held == 0:
            cues = self._observe(decision)
            self.action, self._state = self.high.predict(cues, self._state)
            self._last = self._decoder.normalise(self.action)
            self._command = self._decoder.decode(self.action)
        return self._command

    def _observe(self, decision: int) -> NDArray[np.float32]:
        """Return o^H, as in training."""
        rows = np.arange(self._loco.num_robots)
        if decision == 0:
            self._observer.begin(rows, self._goal)
        else:
            self._observer.measure(self._goal)
        if self.config.cues in ("both", "geometric"):
            self.probes = self._observer.probes.read()
        # A policy trained on shorter episodes than those of an evaluation has no time left then.
        share = np.full(len(rows), min(decision / self._horizon, 1.0))
        return self._observer.observe(self._goal, share, self._last, self._families)


def load_high(
    path: str | Path, low: Policy, low_config: LowLevelConfig
) -> tuple[Policy, HighLevelConfig]:
    """Load a high policy and the MDP it was trained on, for use with the low policy ``low``.

    Raises:
        MisfitError: it was trained on a low policy with another robot, observation or control
            rate, or with commands that ``low`` was not trained on; the message names the mismatch.
        ValueError: the file cannot be used or is not a high policy.
    """
    high = policies.load(path)
    if high.action_dim != NUM_ACTIONS:
        raise ConfigError(f"{path}: not a high policy of this package")
    try:
        config = recorded(HighLevelConfig, high.meta["config"], path)
        trained_on = recorded(LowLevelConfig, high.meta["low"]["config"], f"{path}, meta.low")
        observation = high.meta["low"]["observation"]
    except (KeyError, TypeError) as error:
        raise ConfigError(f"{path}: its metadata do not say what it was trained on") from error
    for field in fields(RobotConfig):
        wanted, given = (getattr(c.robot, field.name) for c in (trained_on, low_config))
        if wanted != given:
            raise MisfitError(
                f"{path}: trained for a low policy with robot.{field.name} {wanted}, not {given}"
            )
    observed = width(high_layout(config))
    if observed != high.obs_dim:
        raise ConfigError(
            f"{path}: trained for a high policy that observes {observed} values, not {high.obs_dim}"
        )
    for what, wanted, given in (
        ("a low policy that observes {} values", observation, low.actor_dim),
        (
            "a low policy with a control step of {} s",
            trained_on.physics.control_dt,
            low_config.physics.control_dt,
        ),
    ):
        if wanted != given:
            raise MisfitError(f"{path}: trained for {what.format(wanted)}, not {given}")
    return high, paired(config, low_config)
