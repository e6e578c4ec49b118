"""Every number that a user may want to change, with its unit and where it comes from.

Frozen dataclasses, one per section of the paper; ``tdgc.config.settings`` reads, writes and changes
them. A setting that came later than the first policies says in its metadata what it was ``before``.
"""

from tdgc.config.high import HighLevelConfig, HighRewardConfig
from tdgc.config.low import CommandDrawConfig, CrossingConfig, LowLevelConfig, LowRewardConfig
from tdgc.config.settings import (
    ConfigError,
    Range,
    from_dict,
    read_json,
    recorded,
    to_dict,
    with_overrides,
)
from tdgc.config.sim import CommandRanges, PhysicsConfig, RandomisationConfig, RobotConfig
from tdgc.config.training import (
    NO_TEACHER,
    PRESETS,
    CalibrationConfig,
    HighTrainConfig,
    ImitationConfig,
    LowTrainConfig,
    PPOConfig,
    RecurrentPPOConfig,
)

__all__ = [
    "NO_TEACHER",
    "PRESETS",
    "CalibrationConfig",
    "CommandDrawConfig",
    "CommandRanges",
    "ConfigError",
    "CrossingConfig",
    "HighLevelConfig",
    "HighRewardConfig",
    "HighTrainConfig",
    "ImitationConfig",
    "LowLevelConfig",
    "LowRewardConfig",
    "LowTrainConfig",
    "PPOConfig",
    "PhysicsConfig",
    "RandomisationConfig",
    "Range",
    "RecurrentPPOConfig",
    "RobotConfig",
    "from_dict",
    "read_json",
    "recorded",
    "to_dict",
    "with_overrides",
]
