"""Configuration: the JSON round trip, and every way to get a key or a value wrong."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

from tdgc.config import (
    PRESETS,
    CommandRanges,
    ConfigError,
    HighLevelConfig,
    HighTrainConfig,
    LowLevelConfig,
    LowTrainConfig,
    PhysicsConfig,
    RobotConfig,
    from_dict,
    recorded,
    to_dict,
    with_overrides,
)
from tdgc.sim.locomotion import actor_layout
from tdgc.sim.observation import width
from tdgc.tasks.high_observation import high_layout
from tdgc.tasks.pairing import paired


def test_json_round_trip_of_the_defaults() -> None:
    config = LowTrainConfig()
    assert from_dict(LowTrainConfig, json.loads(json.dumps(to_dict(config)))) == config


def test_json_round_trip_of_changed_values() -> None:
    robot = RobotConfig(kp=25.5, nominal_thigh=(1.0, 0.8))
    env = LowLevelConfig(
        terrain="tiles", families=("stair",), gyro=True, robot=robot,
        commands=CommandRanges(vx=(-0.25, 0.75)),
    )  # fmt: skip
    config = LowTrainConfig(seed=7, env=env)
    back = from_dict(LowTrainConfig, json.loads(json.dumps(to_dict(config))))
    assert back == config
    assert back.env.robot.nominal_thigh == (1.0, 0.8)
    assert back.env.families == ("stair",)
    assert back.env.commands.vx == (-0.25, 0.75)


def test_missing_keys_keep_their_defaults() -> None:
    config = from_dict(LowTrainConfig, {"seed": 3, "env": {"robot": {"kd": 0.5}}})
    expected = LowTrainConfig(seed=3, env=LowLevelConfig(robot=RobotConfig(kd=0.5)))
    assert config == expected


def test_what_was_recorded_must_be_whole() -> None:
    config = LowTrainConfig(seed=3, env=LowLevelConfig(robot=RobotConfig(swing_ramp=0.0)))
    data = to_dict(config)
    assert recorded(LowTrainConfig, data, "run") == config
    del data["env"]["robot"]["swing_ramp"]
    message = (
        r"^run: the key 'env\.robot\.swing_ramp' is missing \(default 1\.0\); "
        "add the value that it was trained with$"
    )
    with pytest.raises(ConfigError, match=message):
        recorded(LowTrainConfig, data, "run")
    del data["env"]["robot"]
    message = r"key 'env\.robot\.urdf' is missing \(default \"urdf/quadr"
    with pytest.raises(ConfigError, match=message):
        recorded(LowTrainConfig, data, "run")


def test_a_pair_of_the_first_edition_can_be_used() -> None:
    """What the files of the pair shipped with it say of its MDPs, from before many settings."""
    path = Path(__file__).with_name("first_edition.json")
    first = json.loads(path.read_text(encoding="utf-8"))
    low = recorded(LowLevelConfig, first["low"]["config"], path)
    high = paired(recorded(HighLevelConfig, first["high"]["config"], path), low)
    assert width(actor_layout(low.robot, low.gyro)) == first["low"]["size"] == 74
    assert width(high_layout(high)) == first["high"]["size"] == 86
    assert (low.robot.commanded_gait, low.robot.joint_margin, low.physics.hold) == (False, None, 1)
    assert (high.probes, high.probe_age, high.closing_speed) == ("staggered", False, False)


def test_a_run_from_before_the_task_was_configured() -> None:
    """Keys that did not exist then take the former constants, whatever the defaults are now."""
    data = to_dict(LowLevelConfig())
    for key in ("first_levels", "command_draw", "crossing"):
        del data[key]
    then = to_dict(recorded(LowLevelConfig, data, "run"))
    assert then["first_levels"] == 3
    assert then["command_draw"] == {
        "gaits": [0.2, 0.2, 0.3, 0.3], "standing": 0.1,
        "leaps": 0.05, "leap_vx": [0.85, 1.0], "leap_frequency": [0.0, 0.375],
        "retries": 0.0, "growth": 0.05, "growth_steps": 200, "growth_velocity": 0.5,
        "growth_yaw_rate": 0.5, "growth_contact": 0.7,
    }  # fmt: skip
    assert then["crossing"] == {
        "share": 0.8, "gaits": [0.8, 0.05, 0.075, 0.075], "trench_gaits": [0.15, 0.85, 0.0, 0.0],
        "speed": [0.25, 0.8], "leap_speed": [0.9, 1.0], "facing": 0.8, "heading_gain": 1.0,
        "clearance": [0.05, 0.15], "bend": 0.3, "leap_decimation": 5, "landing_rate": 0.002,
        "shallowest_trench": 0.05, "demotion": 0.5,
    }  # fmt: skip


def test_a_whole_number_is_a_float_but_not_the_other_way_round() -> None:
    config = from_dict(RobotConfig, {"kp": 25})
    assert config.kp == 25.0 and isinstance(config.kp, float)
    with pytest.raises(ConfigError, match=r"^'n_envs' must be of type int, not 2\.0$"):
        from_dict(LowTrainConfig, {"n_envs": 2.0})


def test_physics_step() -> None:
    assert PhysicsConfig().dt == pytest.approx(0.0025, abs=1e-15)
    assert PhysicsConfig(substeps=4).dt == pytest.approx(0.005, abs=1e-15)


def test_configurations_cannot_be_changed_in_place() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        LowTrainConfig().seed = 1  # type: ignore[misc]


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"sed": 1}, "unknown configuration key 'sed'; allowed: seed, n_envs"),
        ({"env": {"robot": {"kq": 1}}}, "unknown configuration key 'env.robot.kq'; allowed: urdf"),
        ({"env": {"robot": 5}}, "env.robot must be a table of keys, not 5"),
        ({"env": []}, r"env must be a table of keys, not \[\]"),
        ({"seed": True}, "'seed' must be of type int, not True"),
        ({"seed": "1"}, "'seed' must be of type int, not '1'"),
        ({"ppo": {"mirror": 1}}, "'ppo.mirror' must be of type bool, not 1"),
        ({"ppo": {"gamma": "0.9"}}, "'ppo.gamma' must be of type float, not '0.9'"),
        ({"ppo": {"gamma": None}}, "'ppo.gamma' must be of type float, not None"),
        ({"ppo": {"gamma": True}}, "'ppo.gamma' must be of type float, not True"),
        ({"ppo": {"gamma": float("nan")}}, "'ppo.gamma' must be a finite number, not nan"),
        ({"ppo": {"gamma": float("-inf")}}, "'ppo.gamma' must be a finite number, not -inf"),
        ({"ppo": {"actor": 256}}, "'ppo.actor' must be a list, not 256"),
        ({"ppo": {"actor": [256, 0.5]}}, "'ppo.actor' must be of type int, not 0.5"),
        ({"ppo": {"activation": "gelu"}}, "'ppo.activation' must be one of elu, relu, tanh, not"),
        ({"env": {"terrain": "tile"}}, "'env.terrain' must be one of plane, tiles, not 'tile'"),
        ({"env": {"robot": {"urdf": 3}}}, "'env.robot.urdf' must be of type str, not 3"),
        ({"env": {"robot": {"torque_limit": [1, 2]}}}, "torque_limit' must have 3 values, not 2"),
        ({"env": {"commands": {"vx": [1, -1]}}}, r"must be \[low, high\] with low <= high"),
        ({"env": {"commands": {"vx": [0, "1"]}}}, "'env.commands.vx' must be of type float, not"),
        ({"env": {"commands": {"vx": [0, 1, 2]}}}, "'env.commands.vx' must have 2 values, not 3"),
        ({"env": {"crossing": {"share": 1.5}}}, "crossing.share' must be from 0 to 1, not 1.5"),
        (
            {"env": {"crossing": {"gaits": [1, 1, 0, 0]}}},
            "crossing.gaits' must be shares that add up to 1, not",
        ),
        ({"env": {"crossing": {"gaits": [2, -1, 0, 0]}}}, "gaits' must be from 0 to 1, not 2"),
        ({"env": {"commands": {"vx": [0, float("inf")]}}}, "vx' must be a finite number, not inf"),
    ],
)
def test_wrong_data_is_one_clear_line(data: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        from_dict(LowTrainConfig, data)
    assert "\n" not in str(caught.value)


def test_a_range_may_be_one_point() -> None:
    assert from_dict(CommandRanges, {"vx": [0.5, 0.5]}).vx == (0.5, 0.5)


def test_front_and_rear_are_not_a_range() -> None:
    assert from_dict(RobotConfig, {"nominal_thigh": [1.0, 0.8]}).nominal_thigh == (1.0, 0.8)


def test_overrides() -> None:
    plain = LowTrainConfig()
    config = with_overrides(
        plain,
        [
            "seed=7",
            "env.robot.kp=25",
            "env.robot.urdf=a=b.urdf",
            "env.commands.vx=[-0.5, 0.5]",
            "env.terrain=tiles",
            'env.families=["stair", "gap"]',
            "ppo.mirror=false",
            "ppo.learning_rate=1e-3",
        ],
    )
    robot = dataclasses.replace(plain.env.robot, kp=25.0, urdf="a=b.urdf")
    commands = dataclasses.replace(plain.env.commands, vx=(-0.5, 0.5))
    env = dataclasses.replace(
        plain.env, robot=robot, commands=commands, terrain="tiles", families=("stair", "gap")
    )
    ppo = dataclasses.replace(plain.ppo, mirror=False, learning_rate=0.001)
    assert config == dataclasses.replace(plain, seed=7, env=env, ppo=ppo)


def test_the_last_override_of_a_key_holds() -> None:
    assert with_overrides(RobotConfig(), ["kp=1", "kp=2"]).kp == 2.0


def test_an_override_of_a_whole_table() -> None:
    config = with_overrides(LowLevelConfig(), ['robot={"kp": 30}'])
    assert config.robot == RobotConfig(kp=30.0)


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("env.robot.kp", "cannot read --set 'env.robot.kp'; write key=value"),
        ("=5", "cannot read --set '=5'; write key=value"),
        ("env.robot.kq=1", "unknown configuration key 'env.robot.kq'; allowed: urdf, kp"),
        ("kp=1", "unknown configuration key 'kp'; allowed: seed"),
        ("seed.x=1", "'seed.x': 'seed' is a value, it has no keys of its own"),
        ("env..kp=1", "unknown configuration key 'env..kp'"),
        ("seed=1.5", "'seed' must be of type int, not 1.5"),
        ("env.robot.kp=NaN", "'env.robot.kp' must be a finite number, not nan"),
        ("env.robot.kp=1e999", "'env.robot.kp' must be a finite number, not inf"),
        ("env.robot.kp=twenty", "'env.robot.kp' must be of type float, not 'twenty'"),
        ("env.robot.kp=", "'env.robot.kp' must be of type float, not ''"),
        ("env.commands.vx=[1,0]", r"'env.commands.vx' must be \[low, high\] with low <= high"),
        ("env.command_draw.leap_vx=[0.9,1.2]", "with 0 <= low <= high <= 1, not"),
        ("env.rewards.power=-101", "'env.rewards.power' must be from -100 to 100, not -101"),
        ("env=3", "env must be a table of keys, not 3"),
        ('env={"robot": {"kq": 1}}', "unknown configuration key 'env.robot.kq'"),
    ],
)
def test_wrong_overrides(assignment: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        with_overrides(LowTrainConfig(), [assignment])
    assert "\n" not in str(caught.value)


def test_the_papers_preset_is_its_table() -> None:
    config = with_overrides(HighTrainConfig(), PRESETS["paper"])
    assert (config.seed, config.n_envs, config.env.decimation) == (42, 100, 1)
    ppo = config.ppo
    assert config.steps == 20_000 * ppo.n_steps * config.n_envs
    assert (ppo.learning_rate, ppo.ent_coef, ppo.clip_range) == (1e-4, 1e-4, 0.2)
    assert ppo.final_learning_rate == ppo.learning_rate
    assert (ppo.gamma, ppo.gae_lambda) == (0.99, 0.95)
    assert (ppo.n_steps, ppo.n_epochs, ppo.minibatches) == (24, 5, 4)
    assert (ppo.lstm, ppo.actor, ppo.critic) == (128, (128,), (128,))
    # Robots are always told the family, one of the paper's five, and keep their hidden states.
    assert (config.env.unknown_share, ppo.memory_exchange) == (0.0, 0.0)
    assert config.env.families == ("rough", "pillar", "stair", "gap", "tilt")
    assert with_overrides(HighTrainConfig(), PRESETS["default"]) == HighTrainConfig()
