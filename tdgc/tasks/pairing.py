"""Load a low policy, and fit a high policy's MDP to it."""

import dataclasses
from pathlib import Path

from tdgc import policies
from tdgc.config import ConfigError, HighLevelConfig, LowLevelConfig, recorded
from tdgc.policies import Policy
from tdgc.sim.commands import (
    CONTINUOUS,
    INDEX,
    NUM_COMMANDS,
    VELOCITIES,
    CommandDecoder,
    default_command,
)
from tdgc.sim.locomotion import actor_layout
from tdgc.sim.observation import width
from tdgc.sim.robot import NUM_JOINTS

#: Folder of the shipped policies.
PRETRAINED = Path(__file__).resolve().parents[1] / "pretrained"


class MisfitError(ConfigError):
    """A high policy that does not fit the low policy; the message names the mismatch."""


def paired(high: HighLevelConfig, low: LowLevelConfig) -> HighLevelConfig:
    """The high policy's MDP with the decoder's bounds filled in: the low policy's, if it sets none.

    Raises:
        MisfitError: bounds that the low policy was not trained on; names the command and both
            ranges.
    """
    ranges = high.commands or low.commands
    if high.behaviour == "velocities":
        # The other commands are pinned at their defaults, or at the nearest bound.
        values = CommandDecoder(ranges).nearest(default_command()).tolist()
        others = CONTINUOUS[len(VELOCITIES) :]
        pinned = {name: (values[INDEX[name]], values[INDEX[name]]) for name in others}
        ranges = dataclasses.replace(ranges, **pinned)
    for f in dataclasses.fields(low.commands):
        asked, trained = getattr(ranges, f.name), getattr(low.commands, f.name)
        if asked[0] < trained[0] or asked[1] > trained[1]:
            raise MisfitError(
                f"commands.{f.name} asks for {list(asked)}, but the low policy was trained on "
                f"{list(trained)}"
            )
    return dataclasses.replace(high, commands=ranges)


def mdp_of(low: Policy, source: object = "the low policy") -> LowLevelConfig:
    """The MDP that a low policy was trained on.

    Raises:
        ConfigError: it is not a low policy, or not one of the MDP that it names; the message begins
            with ``source``.
    """
    if low.kind != "mlp" or low.action_dim != NUM_JOINTS or "config" not in low.meta:
        raise ConfigError(f"{source}: not a low policy of this package")
    sizes = low.header.correction
    if sizes and (sizes[0], sizes[-1]) != (NUM_COMMANDS, 3):
        raise ConfigError(f"{source}: its correction is not one of the {NUM_COMMANDS} commands")
    config = recorded(LowLevelConfig, low.meta["config"], source)
    size = width(actor_layout(config.robot, config.gyro))
    if low.actor_dim != size:
        raise ConfigError(
            f"{source}: its configuration gives {size} observations, it takes {low.actor_dim}"
        )
    return config


def load_low(path: str | Path) -> tuple[Policy, LowLevelConfig]:
    """Load a low policy, and the MDP that it was trained on.

    Raises:
        ValueError: a file that cannot be used, or a policy that is not a low policy.
    """
    low = policies.load(path)
    return low, mdp_of(low, path)
