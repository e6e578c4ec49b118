"""The decoder: 13 actions to 15 commands within bounds, its inverse, and what it refuses."""

import numpy as np
import pytest

from tdgc.config import CommandRanges
from tdgc.sim.commands import (
    COMMANDS,
    CONTINUOUS,
    INDEX,
    NAMES,
    NUM_ACTIONS,
    NUM_COMMANDS,
    UNITS,
    CommandDecoder,
    default_command,
    gait_index,
    observed_command,
)
from tdgc.sim.gaits import gait_embedding

#: name, unit, and the command at x = -1, 0 and 1.
CHANNELS = [
    ("vx", "m/s", -1.0, 0.1, 1.2),
    ("vy", "m/s", -0.6, 0.0, 0.6),
    ("yaw_rate", "rad/s", -1.0, 0.0, 1.0),
    ("body_height", "m", -0.03, 0.01, 0.05),
    ("frequency", "Hz", 2.0, 3.0, 4.0),
    ("duration", "1", 0.4, 0.5, 0.6),
    ("swing_height", "m", 0.03, 0.135, 0.24),
    ("pitch", "rad", -0.3, 0.0, 0.3),
    ("roll", "rad", -0.2, 0.0, 0.2),
    ("stance_width", "m", 0.20, 0.275, 0.35),
    ("stance_length", "m", 0.33, 0.38, 0.43),
    ("power_weight", "1/W", 0.0, 0.001, 0.002),
]


def test_names_units_and_sizes() -> None:
    assert (NUM_ACTIONS, NUM_COMMANDS) == (13, 15)
    assert CONTINUOUS == tuple(row[0] for row in CHANNELS)
    assert NAMES == (*CONTINUOUS, "phase", "offset", "bound")
    assert UNITS == (*(row[1] for row in CHANNELS), "1", "1", "1")
    assert [INDEX[name] for name in NAMES] == list(range(15))
    decoder = CommandDecoder()
    assert decoder.names == NAMES and decoder.units == UNITS


def test_meanings_name_the_robots_own_stance() -> None:
    for name in ("stance_width", "stance_length"):
        own = f"{default_command()[INDEX[name]]:g} is the robot's own stance"
        assert COMMANDS[name][1].endswith(own)


def test_bounds() -> None:
    decoder = CommandDecoder()
    assert decoder.low.tolist() == [*(row[2] for row in CHANNELS), 0.0, 0.0, 0.0]
    assert decoder.high.tolist() == [*(row[4] for row in CHANNELS), 0.5, 0.5, 0.5]


@pytest.mark.parametrize("gait", range(4))
def test_encode_finds_the_action_in_the_middle(gait: int) -> None:
    decoder = CommandDecoder(action_limit=2.0)
    command = default_command()
    command[INDEX["vx"]], command[12:] = 0.65, gait_embedding(gait)
    action = decoder.encode(command)
    assert action[0] == pytest.approx(1.0) and action[1] == 0.0
    assert action[12] == pytest.approx(2.0 * (-0.75, -0.25, 0.25, 0.75)[gait])
    np.testing.assert_allclose(decoder.decode(action), command, atol=1e-12)


def test_encode_takes_batches() -> None:
    decoder = CommandDecoder()
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (2, 3, 13))
    actions[..., -1] = [-0.75, 0.25, 0.75]  # the middles of trot, pace, bound
    np.testing.assert_allclose(decoder.encode(decoder.decode(actions)), actions)


def test_encode_refuses_what_no_action_gives() -> None:
    command = default_command()
    command[INDEX["vx"]] = 1.3
    with pytest.raises(ValueError, match=r"^vx 1.3 is outside \[-1.0, 1.2\]$"):
        CommandDecoder().encode(command)


def test_a_fixed_set_of_gaits_shares_the_channel() -> None:
    decoder = CommandDecoder(action_limit=2.0, gaits=("pace", "trot", "bound"))
    actions = np.zeros((5, 13))
    actions[:, -1] = [-2.0, -0.7, -0.6, 0.7, 2.0]  # thirds of [-2, 2]
    assert decoder.gait(actions).tolist() == [2, 2, 0, 3, 3]
    commands = decoder.decode(actions)
    assert gait_index(commands).tolist() == [2, 2, 0, 3, 3]
    middles = decoder.encode(commands)[:, -1]
    np.testing.assert_allclose(middles, [-4 / 3, -4 / 3, 0.0, 4 / 3, 4 / 3], atol=1e-15)
    alone = CommandDecoder(gaits=("bound",))
    assert (alone.gait(actions) == 3).all() and alone.encode(commands[4])[-1] == 0.0
    with pytest.raises(ValueError, match=r"^gait pace is none of bound$"):
        alone.encode(commands)


@pytest.mark.parametrize("gaits", [(), ("trot", "trot"), ("trot", "gallop")])
def test_gaits_that_are_none(gaits: tuple[str, ...]) -> None:
    with pytest.raises(ValueError, match=r"^gaits must be some of trot, pronk, pace, bound, each"):
        CommandDecoder(gaits=gaits)


def test_the_nearest_command_that_can_be_decoded() -> None:
    ranges = CommandRanges(vx=(-0.5, 0.8), frequency=(3.0, 3.0))
    decoder = CommandDecoder(ranges, gaits=("pace", "trot"))
    commands = np.tile(default_command(), (3, 1))
    commands[:, INDEX["vx"]] = [0.9, -0.7, 0.3]
    commands[:, INDEX["frequency"]] = 2.5
    commands[:, 12:] = gait_embedding([1, 0, 2])
    near = decoder.nearest(commands)
    assert near[:, INDEX["vx"]].tolist() == [0.8, -0.5, 0.3]
    assert (near[:, INDEX["frequency"]] == 3.0).all()
    assert gait_index(near).tolist() == [2, 0, 2]
    same = [j for j in range(12) if j not in (INDEX["vx"], INDEX["frequency"])]
    assert (near[:, same] == commands[:, same]).all()
    actions = decoder.encode(near)  # the middle, where all actions mean the same
    assert (actions[:, INDEX["frequency"]] == 0.0).all()
    np.testing.assert_allclose(decoder.decode(actions), near, atol=1e-12)
    inside = CommandDecoder().decode(np.random.default_rng(0).uniform(-1.0, 1.0, (9, 13)))
    assert np.array_equal(CommandDecoder().nearest(inside), inside)


@pytest.mark.parametrize("channel", range(12))
def test_each_channel_maps_affinely_and_alone(channel: int) -> None:
    """At -1, 0 and 1 it gives its bounds and middle; all others stay in the middle."""
    name, _, low, middle, high = CHANNELS[channel]
    actions = np.zeros((3, 13))
    actions[:, channel] = [-1.0, 0.0, 1.0]
    commands = CommandDecoder().decode(actions)
    np.testing.assert_allclose(commands[:, INDEX[name]], [low, middle, high], atol=1e-15)
    others = np.delete(commands[:, :12], channel, axis=1)
    expected = np.delete([row[3] for row in CHANNELS], channel)
    np.testing.assert_allclose(others, np.tile(expected, (3, 1)), atol=1e-15)


def test_a_quarter_of_the_way() -> None:
    command = CommandDecoder().decode(np.full(13, -0.5))
    assert command.shape == (15,)
    assert command[INDEX["frequency"]] == 2.5
    assert command[INDEX["stance_width"]] == pytest.approx(0.2375, abs=1e-15)


@pytest.mark.parametrize(
    ("x", "gait"),
    [
        (-1.0, 0), (-0.75, 0), (-0.5 - 1e-9, 0),
        (-0.5, 1), (-1e-9, 1),
        (0.0, 2), (0.5 - 1e-9, 2),
        (0.5, 3), (0.99, 3), (1.0, 3),
    ],
)  # fmt: skip
def test_gait_channel_in_four_classes(x: float, gait: int) -> None:
    action = np.zeros(13)
    action[12] = x
    decoder = CommandDecoder()
    assert decoder.gait(action) == gait
    assert decoder.decode(action)[12:].tolist() == gait_embedding(gait).tolist()


def test_raw_actions_are_clipped_at_a_max() -> None:
    decoder = CommandDecoder(action_limit=2.0)
    actions = np.array([np.full(13, 100.0), np.full(13, -100.0), np.full(13, 1.0)])
    commands = decoder.decode(actions)
    np.testing.assert_allclose(commands[0, :12], decoder.high[:12], atol=1e-15)
    np.testing.assert_allclose(commands[1, :12], decoder.low[:12], atol=1e-15)
    assert commands[2, INDEX["frequency"]] == 3.5  # x = 1 / 2
    assert decoder.gait(actions).tolist() == [3, 0, 3]
    assert decoder.normalise(actions)[2].tolist() == [0.5] * 13


def test_bounds_come_from_the_configuration() -> None:
    decoder = CommandDecoder(CommandRanges(vx=(0.0, 0.5), pitch=(0.1, 0.1)))
    command = decoder.decode(np.zeros(13))
    assert command[INDEX["vx"]] == 0.25 and command[INDEX["pitch"]] == 0.1
    assert decoder.decode(np.ones(13))[INDEX["vx"]] == 0.5


def test_batches_of_any_shape() -> None:
    actions = np.random.default_rng(0).uniform(-1, 1, (4, 5, 13))
    decoder = CommandDecoder()
    commands = decoder.decode(actions)
    assert commands.shape == (4, 5, 15) and decoder.gait(actions).shape == (4, 5)
    assert commands[2, 3].tolist() == decoder.decode(actions[2, 3]).tolist()
    assert (commands >= decoder.low).all() and (commands <= decoder.high).all()
    assert decoder.decode(np.zeros((0, 13))).shape == (0, 15)


@pytest.mark.parametrize("shape", [(), (12,), (14,), (13, 1), (2, 15)])
def test_an_action_of_another_shape(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"^an action has 13 values, not shape \("):
        CommandDecoder().decode(np.zeros(shape))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("channel", [0, 12])
def test_an_action_that_is_not_finite(value: float, channel: int) -> None:
    action = np.zeros((2, 13))
    action[1, channel] = value
    with pytest.raises(ValueError, match=r"^an action must be finite; it has NaN or infinite"):
        CommandDecoder().decode(action)


@pytest.mark.parametrize("limit", [0.0, -1.0, float("nan")])
def test_an_action_limit_that_is_none(limit: float) -> None:
    with pytest.raises(ValueError, match=r"^action_limit must be positive, not"):
        CommandDecoder(action_limit=limit)


def test_gait_index_inverts_the_embedding() -> None:
    commands = np.zeros((4, 15))
    commands[:, 12:] = gait_embedding([0, 1, 2, 3])
    assert gait_index(commands).tolist() == [0, 1, 2, 3]
    assert gait_index(commands[3]) == 3


def test_default_command_stands_in_trot_within_bounds() -> None:
    command, decoder = default_command(), CommandDecoder()
    assert command[:4].tolist() == [0.0] * 4
    assert command[INDEX["frequency"]] == 3.0 and command[INDEX["swing_height"]] == 0.08
    assert gait_index(command) == 0
    assert (command >= decoder.low).all() and (command <= decoder.high).all()


def test_networks_see_the_distance_from_the_default_in_half_ranges() -> None:
    seen = observed_command(default_command())
    assert seen.tolist() == [0.0] * 12 + [1.0, 0.0, 0.0]  # trot: phase one half
    decoder = CommandDecoder()
    for end in (decoder.low, decoder.high):
        assert np.abs(observed_command(end)).max() <= 2.0
    command = default_command()
    command[INDEX["vy"]], command[INDEX["frequency"]] = 0.25, 2.0
    np.testing.assert_allclose(observed_command(command)[[1, 4]], [0.5, -1.0], atol=1e-12)
