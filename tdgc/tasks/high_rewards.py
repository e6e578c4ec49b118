"""The high policy's reward (Sec. IV-B): its terms, each a pure function on arrays of M robots, and
``HighReward``, which remembers what they look back on."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tdgc.config import HighLevelConfig, HighRewardConfig
from tdgc.sim.commands import NUM_ACTIONS, CommandDecoder
from tdgc.sim.locomotion import Locomotion
from tdgc.sim.robot import Array, RobotState, to_goal
from tdgc.tasks.low_rewards import square_sum
from tdgc.tasks.rules import GOAL_RADIUS


@dataclass
class HighStep:
    """Inputs of the high policy's terms for one decision of M robots (Sec. IV-B).

    Attributes:
        distance: (M,) m to the goal, d_t, horizontal: a goal has no height here.
        heading_error: (M,) rad, psi* - psi.
        time_share: (M,) t / T_max.
        lin_vel, ang_vel: (M, 3) of the base, m/s and rad/s; joint_speed: (M, 12) rad/s.
        base_height: (M,) m above ground; standing_height: m, z*.
        actions: (2, M, 13), this action and the one before, clipped and normalised.
        commands: (3, M, 15) of this decision and the two before, each as a share of its range.
        contact_forces: (M, 5) N: the trunk, and each leg above the foot.
        config: the constants.
    """

    distance: Array
    heading_error: Array
    time_share: Array
    lin_vel: Array
    ang_vel: Array
    joint_speed: Array
    base_height: Array
    standing_height: float
    actions: Array
    commands: Array
    contact_forces: Array
    config: HighRewardConfig

    @property
    def inside(self) -> Array:
        """1[d_t < d_0], (M,); d_0 is the benchmark's."""
        return (self.distance < GOAL_RADIUS).astype(np.float64)


def goal_distance(s: HighStep) -> Array:
    """r_goal_dist = p + a (1 - e^{-b p}), p = clip(1 - d_t / R_map, 0, 1)."""
    p = np.clip(1.0 - s.distance / s.config.map_radius, 0.0, 1.0)
    return p + s.config.curve_gain * (1.0 - np.exp(-s.config.curve_rate * p))


def face(s: HighStep) -> Array:
    """r_face = cos(psi* - psi)."""
    return np.cos(s.heading_error)


def arrive(s: HighStep) -> Array:
    """r_arrive = 1[d_t < d_0] (b_0 + b_1 alpha), alpha = clip(1 - t / T_max, 0, 1)."""
    alpha = np.clip(1.0 - s.time_share, 0.0, 1.0)
    return s.inside * (s.config.arrive_base + s.config.arrive_speed * alpha)


def stable(s: HighStep) -> Array:
    """r_stable = 1[d_t < d_0] exp(-eta_t) exp(-(z - z*)^2 / sigma_z)."""
    eta = (
        np.linalg.norm(s.lin_vel, axis=1)
        + np.linalg.norm(s.ang_vel, axis=1)
        + s.config.joint_speed_weight * np.linalg.norm(s.joint_speed, axis=1)
    )
    height = (s.base_height - s.standing_height) ** 2 / s.config.height_scale
    return s.inside * np.exp(-eta) * np.exp(-height)


def action_rate(s: HighStep) -> Array:
    """r_action_rate = sum_j (a_t - a_{t-1})^2."""
    return square_sum(s.actions[0] - s.actions[1])


def command_rate(s: HighStep) -> Array:
    """r_cmd_sm1: mean squared first difference of the commands."""
    return square_sum(s.commands[0] - s.commands[1]) / s.commands.shape[-1]


def command_acceleration(s: HighStep) -> Array:
    """r_cmd_sm2: mean squared second difference of the commands."""
    second = s.commands[0] - 2.0 * s.commands[1] + s.commands[2]
    return square_sum(second) / s.commands.shape[-1]


def contact_force(s: HighStep) -> Array:
    """r_col = sum_j max(0, |F_j| - F_th), over the trunk and the legs above the feet."""
    return np.sum(np.maximum(s.contact_forces - s.config.force_threshold, 0.0), axis=1)


def laziness(s: HighStep) -> Array:
    """r_lazy = 1[d_t > d_0] 1[|v| < v_th]."""
    slow = np.linalg.norm(s.lin_vel, axis=1) < s.config.lazy_speed
    return (1.0 - s.inside) * slow


def alive(s: HighStep) -> Array:
    """r_alive = 1."""
    return np.ones_like(s.distance)


#: Terms of the high policy by name; the weights are fields of ``HighRewardConfig``.
HIGH_TERMS: dict[str, Callable[[HighStep], Array]] = {
    f.__name__: f
    for f in (
        goal_distance,
        face,
        arrive,
        stable,
        action_rate,
        command_rate,
        command_acceleration,
        contact_force,
        laziness,
        alive,
    )
}
if not set(HIGH_TERMS) <= {f.name for f in dataclasses.fields(HighRewardConfig)}:
    raise TypeError("HIGH_TERMS names a term without a weight in HighRewardConfig")


def high_terms(step: HighStep, dt: float) -> dict[str, Array]:
    """Every enabled term times its effective weight, (M,) each.

    The effective weight is w_i dt (step-time scaling), or w_i without ``step_time_scaling``. The
    high policy's reward is the plain sum of these terms.
    """
    scale = dt if step.config.step_time_scaling else 1.0
    return {
        name: weight * scale * term(step)
        for name, term in HIGH_TERMS.items()
        if (weight := getattr(step.config, name)) != 0.0
    }


class HighReward:
    """The reward of M robots' decisions, with the history that its terms look back on.

    For each decision call ``decide`` once, ``measure`` after each of its control steps, and
    ``terms`` at its end.

    Args:
        config: the decision-level MDP.
        decoder: of the MDP's commands.
        num_robots: M.
        step_seconds: duration of a decision in s.

    Attributes:
        actions: (2, M, 13) of the last decision and the one before, clipped and normalised.
        commands: (3, M, 15) of the last decision and the two before, as shares of the decoder's
            ranges, which puts their differences on one scale.
        force: (M, 5) N, the largest contact forces since the last decision: on the trunk, and on
            each leg above the foot.
    """

    def __init__(
        self, config: HighLevelConfig, decoder: CommandDecoder, num_robots: int, step_seconds: float
    ) -> None:
        self._config, self._decoder, self._seconds = config, decoder, step_seconds
        self._span = np.where(decoder.high > decoder.low, decoder.high - decoder.low, 1)
        self.actions = np.zeros((2, num_robots, NUM_ACTIONS))
        self.commands = np.zeros((3, num_robots, len(decoder.low)))
        self.force = np.zeros((num_robots, 5))
        self.begin(np.arange(num_robots))

    def begin(self, index: NDArray[np.integer]) -> None:
        """Begin new episodes of the robots ``index`` (n,), as if action 0 had been held."""
        self.actions[:, index] = 0.0
        self.commands[:, index] = self._shares(self._decoder.decode(np.zeros(NUM_ACTIONS)))

    def decide(self, commands: Array, actions: NDArray[np.floating] | None) -> None:
        """Remember a decision: its ``commands`` (M, 15) and the ``actions`` (M, 13) that they were
        decoded from, None for a script that has none."""
        self.commands[1:] = self.commands[:-1].copy()
        self.commands[0] = self._shares(commands)
        if actions is not None:
            self.actions[1] = self.actions[0]
            self.actions[0] = self._decoder.normalise(actions)
        self.force[:] = 0.0

    def measure(self, state: RobotState, live: NDArray[np.integer] | slice = slice(None)) -> None:
        """Note the contact forces of the robots ``live`` (n,) after a control step."""
        now = np.column_stack([state.trunk_force, state.leg_force])
        self.force[live] = np.maximum(self.force[live], now[live])

    def terms(self, loco: Locomotion, goal: Array, time_share: Array) -> dict[str, Array]:
        """The weighted terms, (M,) each, at the end of a decision.

        Args:
            loco: the robots.
            goal: (M, 2) m in the world.
            time_share: (M,) t / T_max.
        """
        state = loco.world.state
        distance, direction = to_goal(state, goal)
        step = HighStep(
            distance=distance,
            heading_error=direction - state.yaw,
            time_share=time_share,
            lin_vel=state.lin_vel,
            ang_vel=state.ang_vel,
            joint_speed=state.qd,
            base_height=loco.world.trunk_height(),
            standing_height=loco.robot.base_height,
            actions=self.actions,
            commands=self.commands,
            contact_forces=self.force,
            config=self._config.rewards,
        )
        return high_terms(step, self._seconds)

    def _shares(self, commands: Array) -> Array:
        return (commands - self._decoder.low) / self._span
