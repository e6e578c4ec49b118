"""Configuration: frozen dataclasses, one per section of the paper, with a JSON round trip.

Every number that a user may want to change lives here, with its unit and where it comes from.
``with_overrides`` applies ``key=value`` pairs, ``to_dict``/``from_dict`` go to and from JSON.
Unknown keys, values of the wrong type and values outside the allowed range raise ``ConfigError``.
"""

from __future__ import annotations

import dataclasses
import json
import math
import types
import typing
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

Range = tuple[float, float]


class ConfigError(ValueError):
    """A configuration that cannot be used; the message is one line."""


@dataclass(frozen=True)
class RobotConfig:
    """The robot and its joint interface (paper Sec. IV-A, q* = q0 + alpha clip(a)).

    Masses and lengths are in ``urdf/quadruped.urdf``; leg order FL, FR, RL, RR everywhere and
    joints hip, thigh, calf within a leg.
    """

    urdf: str = "urdf/quadruped.urdf"
    kp: float = 20.0  # N m/rad (benchmark, Walk These Ways)
    kd: float = 0.6  # N m s/rad (benchmark: 0.5-0.7)
    torque_limit: tuple[float, float, float] = (23.7, 23.7, 35.5)  # N m, hip thigh calf (Go1)
    speed_limit: tuple[float, float, float] = (30.0, 30.0, 20.0)  # rad/s, hip thigh calf (Go1)
    nominal_hip: float = 0.1  # rad, outward on both sides (Walk These Ways)
    nominal_thigh: tuple[float, float] = (0.8, 1.0)  # rad, front and rear (Walk These Ways)
    nominal_calf: float = -1.5  # rad (Walk These Ways)
    action_scale: float = 0.25  # rad per unit action: alpha in the paper (Walk These Ways)
    hip_scale: float = 0.5  # hips move half as far per unit action (Walk These Ways)
    action_limit: float = 6.0  # a_max in the paper: 6 * 0.25 = 1.5 rad either side of nominal
    base_height: float = 0.30  # m, standing (benchmark)


@dataclass(frozen=True)
class PhysicsConfig:
    """Bullet's settings (benchmark, Physics)."""

    control_dt: float = 0.02  # s: 50 Hz control
    substeps: int = 8  # 2.5 ms: at most 0.1 % of foot samples sink more than 1 cm
    solver_iterations: int = 10  # the setting the sinking test was made with
    friction: float = 0.8  # foot on ground, nominal (benchmark)

    @property
    def dt(self) -> float:
        """Physics step in s."""
        return self.control_dt / self.substeps


@dataclass(frozen=True)
class CommandRanges:
    """Lower and upper bound of each continuous command: l_j and u_j of the decoder (Sec. IV-B).

    Ranges of Walk These Ways at the start of its own curriculum, narrowed where a foot could not
    follow at the step frequencies used; body height not below -0.10 m, since a deeper one asks
    for a pose that counts as a fall.
    """

    vx: Range = (-1.0, 1.0)  # m/s, forward, in the heading frame
    vy: Range = (-0.6, 0.6)  # m/s, left, in the heading frame
    yaw_rate: Range = (-1.0, 1.0)  # rad/s, left turn positive
    body_height: Range = (-0.10, 0.10)  # m, added to the standing height of 0.30 m
    frequency: Range = (2.0, 4.0)  # Hz, gait cycles a second
    duration: Range = (0.4, 0.6)  # 1, duty factor: share of a cycle in stance
    swing_height: Range = (0.03, 0.20)  # m, apex of the foot above the ground
    pitch: Range = (-0.3, 0.3)  # rad, nose down positive
    roll: Range = (-0.2, 0.2)  # rad, left side up positive
    stance_width: Range = (0.20, 0.35)  # m, between left and right footholds
    stance_length: Range = (0.33, 0.43)  # m, between front and rear footholds
    power_weight: Range = (0.0, 0.005)  # 1/W, the auxiliary: price of mechanical power


@dataclass(frozen=True)
class LowRewardConfig:
    """Weights of the low-level reward, one field per term of ``tdgc.rewards.LOW_TERMS``.

    Values of Walk These Ways (its published table); ``power`` is ours and is multiplied by the
    commanded ``power_weight``.
    """

    track_lin_vel: float = 1.0
    track_yaw_rate: float = 0.5
    body_height: float = -10.0
    orientation: float = -5.0
    raibert_foothold: float = -10.0
    swing_height: float = -30.0
    swing_contact_force: float = -4.0
    stance_foot_speed: float = -4.0
    target_rate: float = -0.1
    target_acceleration: float = -0.1
    action_rate: float = -0.01
    foot_slip: float = -0.04
    leg_collision: float = -5.0
    joint_limits: float = -10.0
    vertical_velocity: float = -0.02
    tilt_rate: float = -0.001
    joint_torques: float = -1e-4
    joint_speeds: float = -1e-4
    joint_accelerations: float = -2.5e-7
    power: float = -1.0
    sigma_lin: float = 0.25  # m^2/s^2, sigma_lin of the paper's r_lin
    sigma_yaw: float = 0.25  # rad^2/s^2, sigma_yaw of the paper's r_yaw


@dataclass(frozen=True)
class RandomisationConfig:
    """Domain randomisation, drawn at each reset unless a unit says otherwise.

    ``scale`` multiplies the width of every range about its nominal value: 0 switches all off.
    """

    scale: float = 1.0
    friction: Range = (0.4, 1.25)  # foot on ground
    payload: Range = (-1.0, 3.0)  # kg on the trunk (Walk These Ways)
    motor_strength: Range = (0.85, 1.1)  # times torque limits and gains
    joint_offset: Range = (-0.02, 0.02)  # rad, error of the joint zero (Walk These Ways)
    latency: Range = (0.0, 0.03)  # s between decision and effect (real robots: about 30 ms)
    push_speed: float = 0.75  # m/s, largest horizontal push (benchmark's `pushes`)
    push_interval: Range = (3.0, 8.0)  # s between pushes
    noise_gravity: float = 0.05  # half-width of uniform noise (Walk These Ways)
    noise_joint_angle: float = 0.01  # rad
    noise_joint_speed: float = 1.5  # rad/s


@dataclass(frozen=True)
class LowLevelConfig:
    """The execution-level MDP (Sec. IV-A)."""

    terrain: str = "plane"  # plane | tiles
    levels: int = 11  # of the curriculum: 0..levels-1
    # Pillar is left out: a level that sees no obstacle can learn nothing of it but bumps.
    families: tuple[str, ...] = ("rough", "stair", "gap", "tilt")
    episode_seconds: float = 20.0
    command_seconds: float = 5.0  # a new command and gait that often
    gyro: bool = False  # adds the angular velocity of the base to the actor's observation
    command_start: float = 0.4  # share of the velocity ranges at the start of the curriculum
    robot: RobotConfig = field(default_factory=RobotConfig)
    physics: PhysicsConfig = field(default_factory=PhysicsConfig)
    commands: CommandRanges = field(default_factory=CommandRanges)
    rewards: LowRewardConfig = field(default_factory=LowRewardConfig)
    randomisation: RandomisationConfig = field(default_factory=RandomisationConfig)


@dataclass(frozen=True)
class PPOConfig:
    """PPO and the networks of the low level; see docs/experiments.md for what was compared."""

    learning_rate: float = 5e-4
    final_learning_rate: float = 1e-4  # reached linearly at the last step
    n_steps: int = 32  # control steps a robot between updates
    batch_size: int = 960  # before mirroring: a quarter of a rollout
    n_epochs: int = 8
    gamma: float = 0.99
    gae_lambda: float = 0.95
    clip_range: float = 0.2
    ent_coef: float = 0.0
    vf_coef: float = 0.5
    max_grad_norm: float = 1.0
    initial_std: float = 1.0
    actor: tuple[int, ...] = (256, 192)
    critic: tuple[int, ...] = (256, 128)
    activation: str = "elu"
    mirror: bool = True  # each minibatch also holds its left-right mirror image


@dataclass(frozen=True)
class LowTrainConfig:
    """A run of train_low.py: first on the plane, then on terrain."""

    seed: int = 42  # the paper's
    n_envs: int = 120
    workers: int = 2
    plane_steps: int = 25_000_000
    steps: int = 100_000_000  # altogether
    plane_substeps: int = 4  # on a plane nothing sinks, so 5 ms will do (benchmark, Physics)
    log_steps: int = 100_000
    checkpoint_seconds: float = 50.0  # an interruption loses at most a minute
    env: LowLevelConfig = field(default_factory=LowLevelConfig)
    ppo: PPOConfig = field(default_factory=PPOConfig)


Config = TypeVar("Config")


def to_dict(config: Any) -> dict[str, Any]:
    """Nested plain dict of a configuration, ready for JSON (tuples become lists)."""
    return typing.cast(dict[str, Any], json.loads(json.dumps(dataclasses.asdict(config))))


def from_dict(cls: type[Config], data: Mapping[str, Any], where: str = "") -> Config:
    """Build ``cls`` from a plain dict; missing keys keep their defaults.

    Raises:
        ConfigError: a key that ``cls`` does not have, or a value of the wrong type.
    """
    if not isinstance(data, Mapping):
        raise ConfigError(f"{where or cls.__name__} must be a table of keys, not {data!r}")
    hints = typing.get_type_hints(cls)
    names = [f.name for f in dataclasses.fields(cls)]  # type: ignore[arg-type]
    values = {}
    for key, value in data.items():
        path = f"{where}.{key}" if where else str(key)
        if key not in names:
            raise ConfigError(f"unknown configuration key '{path}'; allowed: {', '.join(names)}")
        values[key] = _coerce(hints[key], value, path)
    return cls(**values)


def with_overrides(config: Config, assignments: Iterable[str]) -> Config:
    """Apply ``dotted.key=value`` strings, values written as in JSON (bare words are strings).

    Raises:
        ConfigError: an assignment without ``=``, an unknown key, or a value of the wrong type.
    """
    for text in assignments:
        key, equals, raw = text.partition("=")
        if not equals or not key:
            raise ConfigError(f"cannot read --set '{text}'; write key=value, e.g. kp=25")
        try:
            value = json.loads(raw)
        except (ValueError, RecursionError):
            value = raw
        config = _replace(config, key.strip().split("."), value, key.strip())
    return config


def _replace(config: Any, path: list[str], value: Any, full: str) -> Any:
    names = [f.name for f in dataclasses.fields(config)]
    head, rest = path[0], path[1:]
    if head not in names:
        raise ConfigError(f"unknown configuration key '{full}'; allowed: {', '.join(names)}")
    child = getattr(config, head)
    if rest:
        if not dataclasses.is_dataclass(child):
            raise ConfigError(f"'{full}': '{head}' is a value, it has no keys of its own")
        return dataclasses.replace(config, **{head: _replace(child, rest, value, full)})
    hint = typing.get_type_hints(type(config))[head]
    return dataclasses.replace(config, **{head: _coerce(hint, value, full)})


def _coerce(hint: Any, value: Any, path: str) -> Any:
    """``value`` as the annotated type: the few that configurations use, and nothing else."""
    origin = typing.get_origin(hint)
    if dataclasses.is_dataclass(hint):
        return from_dict(typing.cast(type, hint), value, path)
    if origin in (typing.Union, types.UnionType):
        options = typing.get_args(hint)
        if value is None and type(None) in options:
            return None
        return _coerce(next(o for o in options if o is not type(None)), value, path)
    if origin is tuple:
        args = typing.get_args(hint)
        if not isinstance(value, (list, tuple)):
            raise ConfigError(f"'{path}' must be a list, not {value!r}")
        if args[-1] is Ellipsis:
            return tuple(_coerce(args[0], v, path) for v in value)
        if len(value) != len(args):
            raise ConfigError(f"'{path}' must have {len(args)} values, not {len(value)}")
        result = tuple(_coerce(a, v, path) for a, v in zip(args, value, strict=True))
        if hint == Range and result[0] > result[1]:
            raise ConfigError(f"'{path}' must be [low, high] with low <= high, not {value!r}")
        return result
    if hint is bool and isinstance(value, bool):
        return value
    if hint is int and isinstance(value, int) and not isinstance(value, bool):
        return value
    if hint is float and isinstance(value, (int, float)) and not isinstance(value, bool):
        if not math.isfinite(value):
            raise ConfigError(f"'{path}' must be a finite number, not {value!r}")
        return float(value)
    if hint is str and isinstance(value, str):
        return value
    kind = getattr(hint, "__name__", str(hint))
    raise ConfigError(f"'{path}' must be of type {kind}, not {value!r}")
