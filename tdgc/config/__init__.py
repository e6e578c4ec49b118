"""Every setting that a user may want to change, with its unit and the origin of its value.

The settings are frozen dataclasses; ``tdgc.config.settings`` reads, writes and changes them. The
metadata of a setting that was added after the first policies were trained holds, as ``before``, the
value that applied until then.
"""

from tdgc.config.high import HighLevelConfig, HighRewardConfig
from tdgc.config.low import CommandDrawConfig, CrossingConfig, LowLevelConfig, LowRewardConfig
from tdgc.config.settings import (
    ConfigError,
    Range,
    differences,
    from_dict,
    read_json,
    recorded,
    to_dict,
    with_overrides,
)
from tdgc.config.sim import CommandRanges, PhysicsConfig, RandomisationConfig, RobotConfig
from tdgc.config.training import (
    FIRST_TEACHER,
    NO_TEACHER,
    PRESETS,
    CalibrationConfig,
    HighTrainConfig,
    ImitationConfig,
    LowTrainConfig,
    PPOConfig,
    RecurrentPPOConfig,
    TeacherConfig,
)

__all__ = [
    "FIRST_TEACHER",
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
    "TeacherConfig",
    "differences",
    "from_dict",
    "read_json",
    "recorded",
    "to_dict",
    "with_overrides",
]
