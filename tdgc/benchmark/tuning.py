"""Tuning at deployment: narrower commands, fewer gaits, another decision rate, safety limits.

The commands between the two levels can be limited without retraining. A bound clips a command
rather than rescaling it, so an action keeps the meaning it had in training and only commands
beyond the bound change. In JSON, with all keys optional:

    {
      "decoder": {"vx": {"low": -0.2, "high": 0.6}, "gaits": ["trot", "bound"]},
      "decision_rate": 5,
      "safety": {"max_tilt": 0.5, "max_speed": 0.6}
    }
"""

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tdgc.benchmark.drivers import HierarchyDriver
from tdgc.benchmark.evaluation import Episode
from tdgc.benchmark.results import compare, success
from tdgc.config import (
    CommandRanges,
    ConfigError,
    HighLevelConfig,
    LowLevelConfig,
    from_dict,
    read_json,
    to_dict,
    with_overrides,
)
from tdgc.policies import Policy
from tdgc.sim.commands import CONTINUOUS, INDEX, VELOCITIES, command_bounds
from tdgc.sim.gaits import GAITS, gait_embedding
from tdgc.sim.locomotion import Locomotion
from tdgc.sim.robot import Array
from tdgc.sim.sensors import Noise


@dataclass(frozen=True)
class Limits:
    """Bounds of one command, in its unit; None keeps the policy's own bound."""

    low: float | None = None
    high: float | None = None


@dataclass(frozen=True)
class DecoderTuning:
    """Bounds that clip the decoder's commands, and the allowed gaits."""

    vx: Limits = Limits()
    vy: Limits = Limits()
    yaw_rate: Limits = Limits()
    body_height: Limits = Limits()
    frequency: Limits = Limits()
    duration: Limits = Limits()
    swing_height: Limits = Limits()
    pitch: Limits = Limits()
    roll: Limits = Limits()
    stance_width: Limits = Limits()
    stance_length: Limits = Limits()
    power_weight: Limits = Limits()
    gaits: tuple[str, ...] = GAITS


@dataclass(frozen=True)
class SafetyTuning:
    """Limits that slow a robot down, applied at every control step after all bounds.

    Attributes:
        max_tilt: angle between the trunk and the horizontal, rad. Beyond it, commanded velocity
            and yaw rate are scaled by max_tilt / tilt.
        max_speed: m/s. A faster planar velocity is scaled down to it and keeps its direction.
    """

    max_tilt: float | None = None
    max_speed: float | None = None


@dataclass(frozen=True)
class Tuning:
    """Changes to a policy at deployment; ``decision_rate`` is in Hz."""

    decoder: DecoderTuning = DecoderTuning()
    decision_rate: float | None = None
    safety: SafetyTuning = SafetyTuning()


def load(path: str | Path | None, assignments: Iterable[str] = ()) -> Tuning:
    """Load the tuning from a JSON file, with ``key=value`` strings applied on top.

    Raises:
        ConfigError: the file cannot be read or is not JSON, a key is unknown or duplicated, or a
            value has the wrong type, is NaN or infinite; the message is one line.
    """
    data = {} if path is None else read_json(Path(path))
    return with_overrides(from_dict(Tuning, data), assignments)


def tuned_ranges(tuning: Tuning, config: HighLevelConfig, low: LowLevelConfig) -> CommandRanges:
    """Bounds that a tuned policy's commands stay within.

    Args:
        tuning: the changes.
        config: configuration of the tuned high policy.
        low: configuration of the low policy; its ``commands`` are the ranges it was trained on.

    Raises:
        ConfigError: a bound is outside what the low policy was trained on, or wider than the high
            policy's own, so that it would change nothing, or a lower bound is above the upper one.
    """
    ranges = {}
    for name in CONTINUOUS:
        limits: Limits = getattr(tuning.decoder, name)
        trained, own = getattr(low.commands, name), getattr(config.commands, name)
        for side in ("low", "high"):
            value = getattr(limits, side)
            what = f"decoder.{name}.{side}={value}"
            if value is not None and not trained[0] <= value <= trained[1]:
                raise ConfigError(f"{what}: the low policy was trained on {list(trained)}")
            if value is not None and not own[0] <= value <= own[1]:
                raise ConfigError(f"{what}: a bound can only narrow the policy's {list(own)}")
        bottom = own[0] if limits.low is None else limits.low
        top = own[1] if limits.high is None else limits.high
        if bottom > top:
            raise ConfigError(f"decoder.{name}: the lower bound {bottom} is above the upper {top}")
        ranges[name] = (bottom, top)
    return CommandRanges(**ranges)


def tuned_decimation(tuning: Tuning, config: HighLevelConfig, low: LowLevelConfig) -> int:
    """Control steps for which a decision is held.

    Raises:
        ConfigError: the rate does not divide the control rate, or gives less than one decision per
            episode.
    """
    if tuning.decision_rate is None:
        return config.decimation
    control = 1.0 / low.physics.control_dt
    steps = control / tuning.decision_rate if tuning.decision_rate > 0.0 else 0.0
    most = round(config.episode_seconds * control)
    if not 1 <= round(min(steps, most + 1)) <= most or abs(steps - round(steps)) > 1e-9 * steps:
        raise ConfigError(
            f"decision_rate={tuning.decision_rate} Hz must be the control rate of {control:g} Hz "
            f"divided by a whole number from 1 to {most}"
        )
    return round(steps)


def check(tuning: Tuning, config: HighLevelConfig, low: LowLevelConfig) -> None:
    """Refuse a tuning that cannot be used with these policies, or that changes nothing.

    Raises:
        ConfigError: the tuning is refused; names the key and what is allowed.
    """
    ranges, decimation = tuned_ranges(tuning, config, low), tuned_decimation(tuning, config, low)
    gaits, safety = tuning.decoder.gaits, tuning.safety
    if not gaits or len(set(gaits)) < len(gaits) or not set(gaits) <= set(GAITS):
        raise ConfigError(
            f"decoder.gaits must name some of {', '.join(GAITS)}, each once, not {list(gaits)}"
        )
    if set(gaits) != set(GAITS) and set(config.gaits) != set(GAITS):
        raise ConfigError(
            f"decoder.gaits can only narrow all gaits; the policy has {', '.join(config.gaits)}"
        )
    for name, value in dataclasses.asdict(safety).items():
        if value is not None and not value > 0.0:
            raise ConfigError(f"safety.{name} must be positive, not {value}")
        for command in VELOCITIES:
            bottom, top = getattr(low.commands, command)
            if value is not None and not bottom <= 0.0 <= top:
                raise ConfigError(
                    f"safety.{name} slows down to 0: the low policy was trained on {command} from "
                    f"{bottom} to {top}"
                )
    same = (
        ranges == config.commands and decimation == config.decimation and safety == SafetyTuning()
    )
    if same and set(gaits) == set(GAITS):
        raise ConfigError("the tuning changes nothing")


class TunedDriver(HierarchyDriver):
    """``HierarchyDriver`` within a tuning's limits, the policy ``tdgc-tuned``.

    The policy still observes its own last action, not the limited command. If the gait it picks is
    not allowed, the robot uses the allowed gait that is nearest on the action's gait channel, which
    is the smallest change of the action that gives an allowed gait.

    Args:
        high, config: as returned by ``load_high``.
        low: the low policy's MDP.
        tuning: the limits.

    Raises:
        ConfigError: the limits cannot be used, see ``check``.
    """

    def __init__(
        self, high: Policy, config: HighLevelConfig, low: LowLevelConfig, tuning: Tuning
    ) -> None:
        check(tuning, config, low)
        hold = tuned_decimation(tuning, config, low)
        super().__init__(high, dataclasses.replace(config, decimation=hold))
        self.bounds = tuned_ranges(tuning, config, low)
        self._bounds = command_bounds(self.bounds).T
        self._gaits = np.array(sorted(GAITS.index(name) for name in tuning.decoder.gaits))
        self._safety = tuning.safety
        most = tuning.decoder.frequency.high  # the policy's own bound does not cap a gait's start
        self._frequency_limit = np.inf if most is None else most

    def begin(self, loco: Locomotion, goal: Array, family: str, noise: Noise | None = None) -> None:
        super().begin(loco, goal, family, noise)
        loco.frequency_limit = self._frequency_limit

    def command(self, step: int) -> Array:
        command = super().command(step).copy()
        command[:, :12] = np.clip(command[:, :12], *self._bounds)
        assert self.action is not None
        command[:, 12:] = gait_embedding(self._nearest_gait(self.action))
        self._slow_down(command)
        return command

    def _nearest_gait(self, action: NDArray[np.floating]) -> NDArray[np.int64]:
        chosen = self._decoder.gait(action)
        place = 2.0 * (self._decoder.normalise(action)[:, -1:] + 1.0)  # gait i spans i to i + 1
        away = np.maximum(self._gaits - place, place - (self._gaits + 1.0))
        nearest = self._gaits[np.argmin(away, axis=1)]
        return np.where(np.isin(chosen, self._gaits), chosen, nearest)

    def _slow_down(self, command: Array) -> None:
        """Apply the safety limits to commands (M, 15), in place."""
        planar, turning = [INDEX["vx"], INDEX["vy"]], [INDEX[name] for name in VELOCITIES]
        if self._safety.max_speed is not None:
            speed = np.linalg.norm(command[:, planar], axis=1, keepdims=True)
            command[:, planar] *= self._safety.max_speed / np.maximum(speed, self._safety.max_speed)
        if self._safety.max_tilt is not None:
            down = -self._loco.world.state.gravity[:, 2:]
            tilt = np.arccos(np.clip(down, -1.0, 1.0))
            command[:, turning] *= self._safety.max_tilt / np.maximum(tilt, self._safety.max_tilt)


# ---------------------------------------------------------------------------- effect of a tuning


def effect(episodes: Sequence[Episode], before: str, after: str) -> dict[str, Any]:
    """Compare two policies on the same tiles: condition -> policy -> figures, and what changed.

    Figures are ``success`` and, pooled over all of a policy's episodes, ``mean_speed`` in m/s along
    the path and ``energy_per_metre`` in J (None if nothing moved). ``gained`` counts the tiles on
    which only ``after`` reached the goal, ``lost`` those on which only ``before`` did.

    Raises:
        ValueError: only one of the policies was run on some tile.
    """
    result: dict[str, Any] = {}
    for condition, families in compare(episodes, after, before).items():
        found: dict[str, Any] = {}
        for policy in (before, after):
            rows = [e for e in episodes if (e.condition, e.policy) == (condition, policy)]
            path = sum(e.path_m for e in rows)
            found[policy] = success(rows) | {
                "mean_speed": path / sum(e.time_s for e in rows),
                "energy_per_metre": sum(e.energy_j for e in rows) / path if path > 0.0 else None,
            }
        result[condition] = found | {key: families["mean"][key] for key in ("gained", "lost")}
    return result


def record(tuning: Tuning) -> dict[str, Any]:
    """The keys of a tuning that differ from their defaults, as JSON."""

    def changed(now: dict[str, Any], default: dict[str, Any]) -> dict[str, Any]:
        return {
            key: changed(value, default[key]) if isinstance(value, dict) else value
            for key, value in now.items()
            if value != default[key]
        }

    return changed(to_dict(tuning), to_dict(Tuning()))
