"""Exported policies: each graph computes the simulator's step, and a robot needs nothing else."""

import dataclasses
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pybullet_data
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import ActorCriticPolicy
from stubs import no_file_larger_than

from tdgc import export, policies
from tdgc.config import HighLevelConfig, LowLevelConfig, RandomisationConfig, RobotConfig, to_dict
from tdgc.deploy.controller import FORMATS, Controller, Graph
from tdgc.deploy.graphs import HighGraph, LowGraph, by_command, foot_phases
from tdgc.deploy.interface import ExportError
from tdgc.export import TOLERANCE
from tdgc.files import checksum
from tdgc.learn.recurrent import FastRecurrentPolicy
from tdgc.policies import AsymmetricActorCriticPolicy, Correction, Policy
from tdgc.sim.bullet_world import BulletWorld
from tdgc.sim.commands import NAMES, SIDEWAYS, CommandDecoder, default_command
from tdgc.sim.gaits import GAIT_TABLE, PhaseClock, gait_embedding
from tdgc.sim.locomotion import Locomotion, actor_layout
from tdgc.sim.observation import observe, width
from tdgc.sim.robot import JOINTS, nominal_pose
from tdgc.sim.urdf import urdf_path
from tdgc.tasks.high_env import NavigationTask
from tdgc.tasks.high_observation import HighSources, high_layout, high_mirror
from tdgc.tasks.low_observation import low_mirror
from tdgc.tasks.pairing import PRETRAINED, load_low
from tdgc.tasks.probes import PROBES, height_probes

LOW = PRETRAINED / "low"
LOW_POLICY, LOW_CONFIG = load_low(LOW)
HIGH_CONFIG = HighLevelConfig(commands=LOW_CONFIG.commands)
TURNED = {"unit": "rad", "value": (nominal_pose(LOW_CONFIG.robot) + 0.01).tolist()}


def unbounded(size: int) -> spaces.Box:
    return spaces.Box(-np.inf, np.inf, (size,))


def shake(policy: ActorCriticPolicy) -> None:
    """Set random parameters that give actions within and beyond their bounds."""
    generator = th.Generator().manual_seed(0)
    with th.no_grad():
        for parameter in policy.parameters():
            scale = parameter.shape[-1] ** -0.5 if parameter.dim() == 2 else 0.3
            parameter.copy_(scale * th.randn(parameter.shape, generator=generator))


def random_high(
    path: Path,
    config: HighLevelConfig,
    low: LowLevelConfig = LOW_CONFIG,
    hidden: int | None = 32,
    encoder: tuple[int, ...] = (),
) -> Path:
    """Save a high policy with random weights as ``train_high.py`` does; return its path."""
    size = width(high_layout(config))
    limit = config.action_limit
    mirror = high_mirror(config) if config.probes == "lines" else None
    policy = FastRecurrentPolicy(
        unbounded(size), spaces.Box(-limit, limit, (13,)), lambda _: 1e-3,
        lstm_hidden_size=hidden, encoder=encoder, net_arch={"pi": [hidden or 8], "vf": [4]},
        mirror=mirror,
    )  # fmt: skip
    shake(policy)
    trained_on = {"config": to_dict(low), "observation": LOW_POLICY.actor_dim}
    policies.save(path, policy, {"config": to_dict(config), "low": trained_on, "seed": 7})
    return path


def random_low(path: Path, config: LowLevelConfig, symmetric: bool) -> Policy:
    size, limit = width(actor_layout(config.robot, config.gyro)), config.robot.action_limit
    mirror = low_mirror(config).actor_part(size) if symmetric else None
    policy = AsymmetricActorCriticPolicy(
        unbounded(size), spaces.Box(-limit, limit, (12,)), lambda _: 1e-3,
        actor_dim=size, mirror=mirror, net_arch=[32],
    )  # fmt: skip
    shake(policy)
    policies.save(path, policy, {"config": to_dict(config)})
    return policies.load(path)


def random_commands(rng: np.random.Generator, count: int) -> np.ndarray:
    decoder = CommandDecoder(HIGH_CONFIG.commands)
    commands = rng.uniform(decoder.low, decoder.high, (count, 15))
    commands[:, 12:] = gait_embedding(np.arange(count) % 4)
    return commands


def disturb(loco: Locomotion, rng: np.random.Generator) -> None:
    """Put the robots into random states, including ones that no robot could be in."""
    state, m = loco.world.state, loco.num_robots
    state.position[:] = rng.uniform(0.5, 3.0, (m, 3))
    turn = rng.normal(size=(m, 4))
    state.quaternion[:] = turn / np.linalg.norm(turn, axis=1, keepdims=True)
    state.ang_vel[:] = rng.normal(0.0, 2.0, (m, 3))
    state.q[:] = rng.normal(0.0, 1.0, (m, 12))
    state.qd[:] = rng.normal(0.0, 10.0, (m, 12))
    state.derive()
    loco.joint_offset[:] = rng.uniform(-0.02, 0.02, (m, 12))
    loco.clock.clock = rng.uniform(size=m)
    loco.command[:] = random_commands(rng, m)


def body(loco: Locomotion, k: int) -> dict[str, np.ndarray]:
    """Sensor readings of robot ``k``."""
    state = loco.world.state
    return {
        "gravity": state.gravity[k],
        "joint_angles": (state.q - loco.joint_offset)[k],
        "joint_speeds": state.qd[k].copy(),
        "gyro": state.rotation[k].T @ state.ang_vel[k],
    }


def run(graph: LowGraph | HighGraph, values: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Run a graph before its export; return its outputs by name."""
    inputs = [th.as_tensor(values[s.name], dtype=th.float64) for s in graph.inputs]
    assert [tuple(x.shape) for x in inputs] == [(s.size,) for s in graph.inputs]
    outputs = graph(*inputs)
    assert [tuple(x.shape) for x in outputs] == [(s.size,) for s in graph.outputs]
    assert all(x.dtype == th.float64 for x in outputs)
    return {s.name: x.numpy() for s, x in zip(graph.outputs, outputs, strict=True)}


@pytest.fixture(scope="module")
def high(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("high") / "policy"
    return random_high(path, HIGH_CONFIG)


@pytest.fixture(scope="module")
def folder(high: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Export of the shipped low policy and a random high policy in all formats."""
    path = tmp_path_factory.mktemp("export")
    export.write(export.load_pair(LOW, high), path, list(FORMATS))
    return path


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A high policy with episodes of one second, and beside it the pair as TorchScript."""
    path = tmp_path_factory.mktemp("short")
    config = dataclasses.replace(HIGH_CONFIG, episode_seconds=1.0)
    pair = export.load_pair(LOW, random_high(path / "policy", config))
    export.write(pair, path, ["torchscript"])
    return path


# --- the graphs' mathematics --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("gyro", "symmetric", "walks", "start"),
    [(False, True, True, 3.5), (False, True, False, 3.5), (True, False, False, 3.5),
     (True, False, False, 0.0)],
)  # fmt: skip
def test_low_level_is_the_executors_step(
    tmp_path: Path, gyro: bool, symmetric: bool, walks: bool, start: float
) -> None:
    robot = RobotConfig(
        action_limit=0.6,
        hip_scale=0.4,
        nominal_hip=0.07,
        commanded_pose=symmetric,
        commanded_gait=walks,
        start_frequency=start,
    )
    config = LowLevelConfig(gyro=gyro, robot=robot)
    policy = random_low(tmp_path / "low", config, symmetric)
    graph = LowGraph(policy, config)
    m, rng = 24, np.random.default_rng(0)
    loco = Locomotion(BulletWorld(m, config.robot, config.physics), config)
    try:
        disturb(loco, rng)
        before = loco.command.copy()
        loco.clock.update(before[:, 12:], before[:, 5])
        # Swing grows over the first cycle of a gait; the first two may be faster than commanded.
        cycles = rng.uniform(0.1, 3.0, m)
        loco.clock.cycles = cycles.copy()
        loco.command[:6] = random_commands(rng, 7)[1:]  # their gait changes
        loco.actions = rng.uniform(-0.6, 0.6, (2, m, 12))
        sensed = [body(loco, k) for k in range(m)]
        history, clock = loco.actions, loco.clock.clock
        actions, _ = policy.predict(loco.observe())
        loco.act(actions)
        for k in range(m):
            own = {"last_action": history[0, k], "action_before": history[1, k]}
            given = {"commands": loco.command[k], "clock": clock[k : k + 1]}
            gait = {"last_commands": before[k], "cycles": cycles[k : k + 1]}
            got = run(graph, sensed[k] | own | given | gait)
            assert got["action"] == pytest.approx(loco.actions[0, k], abs=3e-6)
            assert got["joint_targets"] == pytest.approx(loco.targets[0, k], abs=1e-6)
            assert got["next_clock"] == pytest.approx(loco.clock.clock[k], abs=1e-15)
            counted = symmetric or start > 0.0  # else no output depends on it
            assert ("next_cycles" in got) == counted
            if counted:
                assert got["next_cycles"] == pytest.approx(loco.clock.cycles[k], abs=1e-12)
                assert (k < 6) == (got["next_cycles"][0] < 0.081)
        at_limit = np.abs(loco.actions[0]) == 0.6
        assert 20 < at_limit.sum() < at_limit.size - 20
    finally:
        loco.world.close()


@pytest.mark.parametrize(
    ("cues", "probes"),
    [("both", "lines"), ("both", "staggered"), ("semantic", "lines"), ("geometric", "lines"),
     ("none", "lines")],
)  # fmt: skip
def test_high_level_is_the_tasks_observation_and_decoder(
    tmp_path: Path, cues: str, probes: str
) -> None:
    """The graph decides and decodes as the policy does on the task's observation.

    The policy has a mirror unless its probes differ from side to side, and an encoder before the
    LSTM if it has both cues.
    """
    narrow = dataclasses.replace(HIGH_CONFIG.commands, vx=(-0.5, 0.8), pitch=(0.0, 0.0))
    config = HighLevelConfig(
        cues=cues, probes=probes, action_limit=2.0, decimation=4, commands=narrow
    )
    encoder = (24, 16) if cues == "both" else ()
    policy = policies.load(random_high(tmp_path / "high", config, encoder=encoder))
    assert policy.state_size == (64 if probes == "lines" else 32)
    graph = HighGraph(policy, config, LOW_CONFIG)
    task = NavigationTask(config, LOW_POLICY, 5, seed=2, training=False)
    loco, rng = task.locomotion, np.random.default_rng(1)
    try:
        task.reset(np.arange(5))
        disturb(loco, rng)
        loco.clock.update(loco.command[:, 12:], loco.command[:, 5])
        last = rng.uniform(-3.0, 3.0, (5, 13)).astype(np.float32)
        memory = rng.normal(0.0, 0.5, (2, 5, policy.state_size)).astype(np.float32)
        elapsed = np.arange(5) * 17
        heights, late = height_probes(loco, PROBES[probes]), np.arange(5) % 2
        before = rng.uniform(3.0, 5.0, (5, 2))  # the first robot is at its first decision
        before[0] = 0.0
        distance = np.linalg.norm(task.goal - loco.world.state.position[:, :2], axis=1)
        closing = (np.linalg.norm(before, axis=1) - distance) / 0.08 * (np.arange(5) > 0)
        seen = observe(
            high_layout(config),
            HighSources(
                loco, task.goal, elapsed / task.horizon, task.decoder.normalise(last),
                task.family_index, heights, late, closing,
            ),
        )  # fmt: skip
        wanted, (hidden, cell) = policy.predict(seen, (memory[:1], memory[1:]))
        state = loco.world.state
        for k in range(5):
            c, s = np.cos(state.yaw[k]), np.sin(state.yaw[k])
            x, y = task.goal[k] - state.position[k, :2]
            got = run(
                graph,
                body(loco, k)
                | {
                    "goal": np.array([c * x + s * y, c * y - s * x]),
                    "time_left": np.array([20.0 - elapsed[k] * 0.08]),
                    "last_decision": last[k],
                    "last_commands": loco.command[k],
                    "clock": loco.clock.clock[k : k + 1],
                    "family": np.eye(6)[task.family_index[k]],
                    "probes": np.where(np.abs(heights[k]) < 0.5, 1.0, 3.0) * heights[k],
                    "probe_age": 0.08 * late[k : k + 1],
                    "last_goal": before[k],
                    "hidden": memory[0, k],
                    "cell": memory[1, k],
                },
            )
            assert got["decision"] == pytest.approx(wanted[k], abs=3e-6)
            assert got["commands"] == pytest.approx(task.decoder.decode(wanted[k]), abs=3e-6)
            assert got["next_hidden"] == pytest.approx(hidden[0, k], abs=1e-6)
            assert got["next_cell"] == pytest.approx(cell[0, k], abs=1e-6)
    finally:
        task.close()


def test_decoding_is_the_decoders_to_the_last_bit_of_a_gait(high: Path) -> None:
    pair = export.load_pair(LOW, high)
    graph, decoder = (
        HighGraph(pair.high, pair.high_config, pair.low_config),
        CommandDecoder(HIGH_CONFIG.commands),
    )
    rng = np.random.default_rng(3)
    actions = rng.uniform(-1.3, 1.3, (40, 13))
    edges = np.float32([-0.5, 0.0, 0.5])
    near = [np.nextafter(edges, np.float32(side)) for side in (-2, 2)]
    actions[:11, -1] = [*edges, *near[0], *near[1], -1.0, 1.0]
    for action in actions:
        got = graph._decode(th.tensor(action)).numpy()
        assert got == pytest.approx(decoder.decode(action), abs=1e-15)
        assert np.array_equal(got[12:], decoder.decode(action)[12:])


def test_a_fixed_set_of_gaits_is_decoded_as_the_decoder_does(tmp_path: Path) -> None:
    config = dataclasses.replace(HIGH_CONFIG, gaits=("pace", "trot", "bound"))
    graph = HighGraph(policies.load(random_high(tmp_path / "high", config)), config, LOW_CONFIG)
    actions = np.random.default_rng(0).uniform(-1.2, 1.2, (50, 13))
    wanted = CommandDecoder(config.commands, gaits=config.gaits).decode(actions)
    found = [graph._decode(th.from_numpy(action)).numpy() for action in actions]
    np.testing.assert_allclose(found, wanted, atol=1e-12)
    assert len(np.unique(wanted[:, 12:], axis=0)) == 3


def test_foot_phases_are_the_phase_clocks() -> None:
    rng = np.random.default_rng(4)
    commands = random_commands(rng, 200)
    clock = rng.uniform(size=200)
    clock[:4], clock[4:8] = 0.0, commands[4:8, 5]  # where stance begins and ends in pronk
    phases = PhaseClock(200)
    phases.reset(np.arange(200), clock)
    phases.update(commands[:, 12:], commands[:, 5])
    for k, wanted in enumerate(phases.signal()):
        got = foot_phases(th.tensor(clock[k : k + 1]), by_command(th.tensor(commands[k])))
        assert np.sin(2.0 * np.pi * got.numpy()) == pytest.approx(wanted, abs=1e-14)


def test_goal_under_the_robot_counts_as_ahead(high: Path) -> None:
    pair = export.load_pair(LOW, high)
    graph = HighGraph(pair.high, pair.high_config, pair.low_config)
    rest = {s.name: np.full(s.size, 0.1) for s in graph.inputs}
    at, ahead, left = (
        run(graph, rest | {"goal": np.array(goal)})["decision"]
        for goal in ([0.0, 0.0], [1e-9, 0.0], [0.0, 1e-9])
    )
    assert np.array_equal(at, ahead) and np.abs(left - at).max() > 1e-3


# --- the files ----------------------------------------------------------------------------------


@pytest.mark.parametrize("form", FORMATS)
def test_graphs_drive_a_robot_as_the_policies_do(folder: Path, high: Path, form: str) -> None:
    result = export.check(folder, form, LOW, high)
    assert result.difference <= TOLERANCE
    assert result.seconds.shape == (1000,) and (result.seconds >= 0.0).all()


def test_check_finds_other_weights(tmp_path: Path) -> None:
    short = dataclasses.replace(HIGH_CONFIG, episode_seconds=1.0)
    other = random_high(tmp_path / "short", short)
    pair = export.load_pair(LOW, other)
    export.write(pair, tmp_path, ["torchscript"])
    assert export.check(tmp_path, "torchscript", LOW, other).difference <= TOLERANCE
    pair.high.tensors["actor.0.weight"].mul_(1.001)
    export.write(pair, tmp_path, ["torchscript"])
    assert export.check(tmp_path, "torchscript", LOW, other).difference > TOLERANCE


def test_check_knows_which_gaits_a_policy_has(tmp_path: Path) -> None:
    trot = dataclasses.replace(HIGH_CONFIG, episode_seconds=1.0, gaits=("trot",))
    high = random_high(tmp_path / "trot", trot)
    export.write(export.load_pair(LOW, high), tmp_path, ["torchscript"])
    assert export.check(tmp_path, "torchscript", LOW, high).difference <= TOLERANCE


def without_sources(table: dict[str, Any]) -> None:
    """Remove from an interface which inputs come from the other graph."""
    for signal in table["inputs"]:
        signal["source"] = None


@pytest.mark.parametrize(
    ("graph", "change", "refused"),
    [
        ("low", lambda t: t["frames"]["gravity_when_level"].update(value=[0.0, 0.0, 1.0]), ""),
        ("low", lambda t: t["joint_control"]["kp"].update(value=[21.0] * 12), ""),
        ("low", lambda t: t["joint_control"]["kd"].update(value=[0.5] * 12), ""),
        ("low", lambda t: t["rate"].update(value=25.0), "25 Hz, which is not 5 times"),
        ("low", lambda t: t["start"].update(joint_angles=TURNED), "the start pose differs"),
        ("low", lambda t: t["start"]["trunk_height"].update(value=0.31), "m high"),
        ("low", without_sources, "low: the reading 'commands' is missing"),
        ("high", without_sources, ""),
        ("high", lambda t: t["order"].reverse(), "order["),
        ("high", lambda t: t["order"][0].update(every=4), "which is not 4 times"),
        ("high", lambda t: t["probes"]["plane_below_trunk"].update(value=0.31), "two exports"),
        ("high", lambda t: t["probes"]["ahead_left"]["value"].reverse(), ""),
        ("high", lambda t: t["families"].reverse(), ""),
        ("high", lambda t: t["task"]["horizon"].update(value=2.0), ""),
    ],
)
def test_check_finds_an_interface_that_says_something_else(
    short: Path, tmp_path: Path, graph: str, change: Callable[[dict[str, Any]], None], refused: str
) -> None:
    shutil.copytree(short, tmp_path, dirs_exist_ok=True)
    high, path = tmp_path / "policy", tmp_path / f"{graph}_interface.json"
    table = json.loads(path.read_text())
    change(table)
    path.write_text(json.dumps(table))
    if refused:
        with pytest.raises(ExportError, match=re.escape(refused)):
            export.check(tmp_path, "torchscript", LOW, high)
    else:
        assert export.check(tmp_path, "torchscript", LOW, high).difference > TOLERANCE


@pytest.mark.parametrize("name", ["low", "high"])
def test_a_graph_does_not_say_where_it_was_made(folder: Path, name: str) -> None:
    """PyTorch notes the source file of every operation; with it, the path of the installation."""
    assert b".py" not in (folder / f"{name}.onnx").read_bytes()


@pytest.mark.parametrize("form", FORMATS)
def test_clock_does_not_drift(folder: Path, form: str) -> None:
    """1000 steps at 3.7 Hz are right to 1e-11; with 0.02 s rounded to float32: 3e-8 off by then."""
    graph = Graph(folder, "low", form)
    command = np.concatenate([np.full(12, 0.5), GAIT_TABLE[2]])
    command[4] = 3.7
    rest = {name: np.zeros(size) for name, size in
            (("gravity", 3), ("joint_angles", 12), ("joint_speeds", 12), ("gyro", 3))}  # fmt: skip
    for _ in range(1000):
        graph(rest | {"commands": command})
    assert graph.memory["clock"][0] == pytest.approx(np.mod(1000 * 0.02 * 3.7, 1.0), abs=1e-11)


def test_graph_hands_on_what_the_interface_says(folder: Path) -> None:
    graph = Graph(folder, "low", "onnx")
    rest = {name: np.full(size, 0.1) for name, size in
            (("gravity", 3), ("joint_angles", 12), ("joint_speeds", 12), ("gyro", 3))}  # fmt: skip
    rest["commands"] = random_commands(np.random.default_rng(5), 1)[0]
    assert not graph.memory["last_action"].any() and not graph.memory["action_before"].any()
    first = graph(rest)
    second = graph(rest)
    assert np.array_equal(graph.memory["last_action"], second["action"])
    assert np.array_equal(graph.memory["action_before"], first["action"])
    assert np.array_equal(graph.memory["clock"], second["next_clock"])
    assert np.abs(second["action"] - first["action"]).max() > 1e-3
    graph.reset()
    assert np.array_equal(graph(rest)["action"], first["action"])


@pytest.mark.parametrize("name", ["low", "high"])
def test_interface_names_what_the_graph_has(folder: Path, name: str) -> None:
    table = json.loads((folder / f"{name}_interface.json").read_text())
    session = onnxruntime.InferenceSession(folder / f"{name}.onnx")
    for side, found in (("inputs", session.get_inputs()), ("outputs", session.get_outputs())):
        said = [(s["name"], s["shape"], s["type"]) for s in table[side]]
        assert said == [(x.name, x.shape, "float64") for x in found]
        assert {x.type for x in found} == {"tensor(double)"}
    names = {s["name"] for side in ("inputs", "outputs") for s in table[side]}
    for signal in table["inputs"] + table["outputs"]:
        assert signal["meaning"] and signal["previous"] in {None, *names}
        handed_on = signal["previous"] is not None or signal["source"] == "low.next_clock"
        assert handed_on == (signal["start"] is not None)
        assert (signal["unit"] is None) == (signal["order"] == "commands")
        if signal["order"] is not None:
            order = table[signal["order"]]
            order = order["ahead_left"]["value"] if isinstance(order, dict) else order
            assert len(order) == signal["shape"][0]


def test_interface_says_how_to_drive_the_joints(folder: Path) -> None:
    table = json.loads((folder / "low_interface.json").read_text())
    assert table["rate"] == {"unit": "Hz", "value": 50.0} and table["joints"] == list(JOINTS)
    control, robot = table["joint_control"], LOW_CONFIG.robot
    assert control["rate"]["value"] == LOW_CONFIG.physics.joint_steps * 50.0
    assert control["kp"] == {"unit": "N m/rad", "value": [20.0] * 12}
    assert control["kd"] == {"unit": "N m s/rad", "value": [0.6] * 12}
    assert control["torque_limit"] == {"unit": "N m", "value": [23.7, 23.7, 35.5] * 4}
    assert control["speed_limit"] == {"unit": "rad/s", "value": [30.0, 30.0, 20.0] * 4}
    assert control["simulated_speed_limit"] == {"unit": "rad/s", "value": [20.0] * 12}
    assert control["joint_limits"]["low"][:3] == [-0.86, -0.69, -2.82]
    assert control["joint_limits"]["high"][:3] == [0.86, 4.5, -0.89]
    assert control["target_margin"] == {"unit": "rad", "value": robot.joint_margin}
    assert table["start"]["joint_angles"]["value"] == nominal_pose(robot).tolist()
    # Links of 0.213 m, with thighs at 0.8 and 1 rad and calves at -0.7 and -0.5 rad from the
    # vertical, on feet of 22 mm radius.
    rear = 0.213 * (np.cos(1.0) + np.cos(0.5))
    front = 0.213 * (np.cos(0.8) + np.cos(0.7))
    hip = 0.08 * np.sin(0.1)
    height = max(front, rear) * np.cos(0.1) - hip + 0.022
    assert table["start"]["trunk_height"]["value"] == pytest.approx(height, abs=1e-9)
    assert table["frames"]["origin"] == "origin of the URDF's root link"
    assert table["robot"]["urdf"]["file"] == "quadruped.urdf"
    assert table["robot"]["total_mass"]["value"] == pytest.approx(12.6)
    assert table["robot"]["link_masses"]["value"]["trunk"] == 5.6
    assert table["feet"] == ["FL", "FR", "RL", "RR"]
    assert table["gaits"][0] == {"name": "trot", "phase": 0.5, "offset": 0.0, "bound": 0.0}
    assert table["robot"]["stance"] == {"unit": "m", "length": 0.38, "width": 0.25}
    left = "velocity to the left, in the same frame"
    assert table["commands"][1] == {"name": "vy", "unit": "m/s", "meaning": left,
                                    "low": -0.6, "high": 0.6}  # fmt: skip
    assert "; 0.25 is the robot's own stance" in table["commands"][9]["meaning"]
    apart = "share of a cycle between front and rear pair: 0.5 in the gait bound"
    assert table["commands"][13] == {"name": "offset", "unit": "1", "meaning": apart,
                                     "values": [0.0, 0.5]}  # fmt: skip


def test_interface_says_how_to_decide(folder: Path) -> None:
    table = json.loads((folder / "high_interface.json").read_text())
    assert table["rate"]["value"] == pytest.approx(10.0)
    assert table["files"] == {
        form: {"file": f"high{suffix}", "sha256": checksum(folder / f"high{suffix}")}
        for form, suffix in FORMATS.items()
    }
    assert table["order"] == [{"graph": "high", "every": 5}, {"graph": "low", "every": 1}]
    assert table["policy"] == {"seed": 7}
    assert table["families"][-1] == "unknown" and table["decision"][-1] == "gait"
    assert table["probes"]["plane_below_trunk"] == {"unit": "m", "value": 0.3}
    clock = next(s for s in table["inputs"] if s["name"] == "clock")
    assert (clock["source"], clock["start"]) == ("low.next_clock", 0.0)
    task = table["task"]
    assert task["goal_radius"] == {"unit": "m", "value": 0.5}
    assert task["horizon"]["unit"] == "s" and task["horizon"]["value"] == pytest.approx(20.0)
    assert task["after_goal"]["keep_deciding"]["value"] == pytest.approx(2.0)
    assert task["family"] == {"scope": "whole tile", "otherwise": "unknown"}
    said = {s["name"]: s["meaning"] for s in table["inputs"]}
    assert "of the whole tile, from start to goal" in said["family"]
    assert all("origin of the URDF's root link" in said[name] for name in ("goal", "probes"))


def drawn(table: dict[str, Any]) -> dict[str, tuple[float, float, str]]:
    return {entry["name"]: (entry["low"], entry["high"], entry["unit"])
            for entry in table["trained_for"]}  # fmt: skip


def test_interface_says_what_the_policies_were_trained_for(folder: Path, tmp_path: Path) -> None:
    low, high = (
        drawn(json.loads((folder / f"{name}_interface.json").read_text()))
        for name in ("low", "high")
    )
    same = {"friction": (0.4, 1.25, "1"), "payload": (-1.0, 3.0, "kg"),
            "motor_strength": (0.85, 1.1, "1"), "joint_offset": (-0.02, 0.02, "rad"),
            "armature": (0.0, 0.015, "kg m^2"), "joint_friction": (0.0, 0.3, "N m"),
            "latency": (0.0, 0.03, "s"), "push_speed": (-0.75, 0.75, "m/s")}  # fmt: skip
    sensors = {"noise_gravity": (-0.02, 0.02, "1"), "noise_joint_angle": (-0.01, 0.01, "rad"),
               "noise_joint_speed": (-0.3, 0.3, "rad/s"),
               "noise_gyro": (-0.1, 0.1, "rad/s")}  # fmt: skip
    assert low == same | sensors
    # Only its probes have errors of their own in training.
    assert high == same | {"noise_probes": (-0.02, 0.02, "m"), "probe_delay": (0.0, 0.1, "s")}
    calm = dataclasses.replace(
        HIGH_CONFIG, cues="none", randomisation=RandomisationConfig(scale=0.5)
    )
    pair = export.load_pair(LOW, random_high(tmp_path / "policy", calm, hidden=4))
    export.write(pair, tmp_path, ["torchscript"])
    half = drawn(json.loads((tmp_path / "high_interface.json").read_text()))
    assert half.keys() == same.keys()
    assert half["friction"] == (pytest.approx(0.6), pytest.approx(1.025), "1")
    assert half["motor_strength"] == (pytest.approx(0.925), pytest.approx(1.05), "1")
    assert half["push_speed"] == (-0.375, 0.375, "m/s")


def test_a_pair_with_narrower_commands_can_be_exported(tmp_path: Path) -> None:
    """As docs/deploy.md limits commands; it stands within the limits, and does not walk."""
    narrow = dataclasses.replace(
        HIGH_CONFIG.commands, vx=(0.2, 0.8), frequency=(3.5, 4.0), swing_height=(0.03, 0.05)
    )
    config = dataclasses.replace(HIGH_CONFIG, episode_seconds=1.0, commands=narrow)
    high = random_high(tmp_path / "policy", config)
    export.write(export.load_pair(LOW, high), tmp_path, ["torchscript"])
    assert export.check(tmp_path, "torchscript", LOW, high).difference <= TOLERANCE
    stand = Controller(tmp_path, "torchscript").high.table["task"]["stand"]["value"]
    assert stand[:3] == [0.0, 0.0, 0.0] and stand[3:7] == [0.0, 3.5, 0.5, 0.05]
    assert stand[7:] == default_command()[7:].tolist()


def with_meshes(path: Path, names: Sequence[str]) -> LowLevelConfig:
    """Write the shipped robot to ``path``, with these meshes as its trunk's visual shape."""
    text, shape = urdf_path(LOW_CONFIG.robot).read_text(), '<box size="0.3 0.15 0.1"/>'
    assert text.count(shape) == 1
    meshes = [f'<mesh filename="{name}"/>' for name in names]
    path.write_text(text.replace(shape, "</geometry></visual><visual><geometry>".join(meshes)))
    robot = dataclasses.replace(LOW_CONFIG.robot, urdf=str(path))
    return dataclasses.replace(LOW_CONFIG, robot=robot)


def test_the_robots_meshes_come_along(tmp_path: Path) -> None:
    """However the URDF names them, and the check needs none but the copies."""
    package, out = tmp_path / "dog", tmp_path / "out"
    for folder in (package / "urdf", package / "meshes", out):
        folder.mkdir(parents=True)
    source = Path(pybullet_data.getDataPath()) / "a1" / "meshes" / "hip.obj"
    bare = re.sub("(?m)^(mtllib|usemtl) .*\n", "", source.read_text())
    (package / "urdf" / "hip.obj").write_text(bare)
    (package / "meshes" / "hip.obj").write_text(bare + "# another\n")
    names = ["hip.obj", "../meshes/hip.obj", "package://dog/meshes/hip.obj", "hip.obj"]
    config = with_meshes(package / "urdf" / "dog.urdf", names)
    policies.save_copy(tmp_path / "low", LOW_POLICY, {"config": to_dict(config)})
    short = dataclasses.replace(HIGH_CONFIG, episode_seconds=1.0)
    high = random_high(tmp_path / "high", short, config)
    export.write(export.load_pair(tmp_path / "low", high), out, ["torchscript"])
    for mesh in package.rglob("*.obj"):
        mesh.unlink()
    copied = re.findall('mesh filename="(.*?)"', (out / "dog.urdf").read_text())
    own, other = "meshes/0_hip.obj", "meshes/1_hip.obj"
    assert copied == [own, other, other, own]
    assert (out / own).read_text() == bare and (out / other).read_text() == bare + "# another\n"
    assert export.check(out, "torchscript", tmp_path / "low", high).difference <= TOLERANCE


def test_a_robot_without_meshes_is_copied_as_it_is(folder: Path) -> None:
    assert (folder / "quadruped.urdf").read_bytes() == urdf_path(LOW_CONFIG.robot).read_bytes()


ROBOT = """
import json, sys
import numpy as np, onnxruntime, torch
table = json.load(open("low_interface.json"))
values = [np.full(s["shape"], 0.3) for s in table["inputs"]]
session = onnxruntime.InferenceSession("low.onnx")
by_onnx = session.run(None, {s["name"]: v for s, v in zip(table["inputs"], values)})
by_torch = torch.jit.load("low.pt")(*map(torch.from_numpy, values))
assert not [name for name in sys.modules if name.partition(".")[0] == "tdgc"]
print(json.dumps([[float(x) for x in outputs[1]] for outputs in (by_onnx, by_torch)]))
"""


def test_a_robot_needs_no_part_of_this_package(folder: Path) -> None:
    command = [sys.executable, "-W", "ignore", "-I", "-c", ROBOT]
    result = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
    graph = LowGraph(LOW_POLICY, LOW_CONFIG)
    wanted = run(graph, {s.name: np.full(s.size, 0.3) for s in graph.inputs})["joint_targets"]
    for targets in json.loads(result.stdout):
        assert targets == pytest.approx(wanted, abs=1e-6)


def test_a_full_disk_stops_an_export(tmp_path: Path) -> None:
    """PyTorch itself would end the process without an error that could be caught."""
    pair = export.load_pair(LOW, random_high(tmp_path / "high", HIGH_CONFIG))
    with no_file_larger_than(10_000), pytest.raises(OSError, match="File too large"):
        export.write(pair, tmp_path, ["torchscript"])


def test_a_correction_is_part_of_the_graph(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    tensors = {
        "zero": th.zeros(15), "unit": th.ones(15),
        "sign": th.tensor([-1.0 if name in SIDEWAYS else 1.0 for name in NAMES]),
        "0.weight": th.from_numpy(rng.normal(0.0, 1.0, (8, 15))).float(), "0.bias": th.ones(8),
        "1.weight": th.from_numpy(rng.normal(0.0, 0.3, (3, 8))).float(), "1.bias": th.zeros(3),
    }  # fmt: skip
    low = tmp_path / "low"
    policies.save_copy(low, LOW_POLICY, LOW_POLICY.meta, Correction((15, 8, 3), tensors))
    short = dataclasses.replace(HIGH_CONFIG, episode_seconds=1.0)
    high, kinds = random_high(tmp_path / "high", short), ["onnx", "torchscript"]
    (tmp_path / "out").mkdir()
    export.write(export.load_pair(low, high), tmp_path / "out", kinds)
    for kind in kinds:
        assert export.check(tmp_path / "out", kind, low, high).difference <= TOLERANCE
    plain, corrected = (LowGraph(policy, LOW_CONFIG) for policy in (LOW_POLICY, load_low(low)[0]))
    values = {s.name: np.full(s.size, 0.3) for s in plain.inputs}
    targets = [run(graph, values)["joint_targets"] for graph in (plain, corrected)]
    assert np.abs(targets[0] - targets[1]).max() > 0.02


# --- the command --------------------------------------------------------------------------------


@pytest.mark.usefixtures("one_thread")  # the command sets it and leaves it so
def test_command_writes_checks_and_reports(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    short = dataclasses.replace(HIGH_CONFIG, episode_seconds=1.0)
    high = random_high(tmp_path / "high", short)
    out = tmp_path / "new" / "out"
    arguments = ["--high", str(high), "--out", str(out), "--format", "torchscript"]
    out.mkdir(parents=True)
    (out / "low.onnx").write_text("of an earlier export, which other interfaces fit")
    assert export.main(arguments) == 0
    assert sorted(path.name for path in out.iterdir()) == [
        "high.pt", "high_interface.json", "low.pt", "low_interface.json", "quadruped.urdf"
    ]  # fmt: skip
    said = capsys.readouterr()
    assert said.err == "" and said.out.count("\n") == 1
    assert said.out.startswith("torchscript: largest difference ")
    assert " in 50 control steps; a step takes " in said.out
    assert " back to back" in said.out
    monkeypatch.setattr(export, "TOLERANCE", -1.0)
    assert export.main(arguments) == 1
    said = capsys.readouterr()
    assert said.err.startswith("tdgc.export: torchscript differs by ")
    assert said.err.count("\n") == 1


@pytest.mark.parametrize(
    ("mesh", "message"),
    [
        ("no.stl", "robot.urdf: no mesh 'no.stl'; a mesh is named relative to the URDF, as "),
        ("robot.urdf", "out/robot.urdf: Bullet cannot load it"),  # it is there, but no mesh
    ],
)
def test_a_robot_that_cannot_be_loaded_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], mesh: str, message: str
) -> None:
    config = with_meshes(tmp_path / "robot.urdf", [mesh])
    policies.save_copy(tmp_path / "low", LOW_POLICY, {"config": to_dict(config)})
    high = random_high(tmp_path / "high", HIGH_CONFIG, config, hidden=4)
    flags = ["--low", str(tmp_path / "low"), "--high", str(high), "--format", "torchscript"]
    assert export.main([*flags, "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr()
    assert said.err.startswith("tdgc.export: ") and said.err.count("\n") == 1
    assert message in said.err


def save_pairs(path: Path) -> None:
    """Save a high policy that fits the shipped low policy, and policies that do not fit."""
    fast = dataclasses.replace(HIGH_CONFIG.commands, vx=(-1.0, 1.5))
    physics = dataclasses.replace(LOW_CONFIG.physics, control_dt=0.01)
    random_high(path / "high", HIGH_CONFIG, hidden=4)
    random_high(path / "fast", HighLevelConfig(commands=fast), hidden=4)
    random_high(path / "forward", HIGH_CONFIG, hidden=None)
    random_high(
        path / "slow", HIGH_CONFIG, dataclasses.replace(LOW_CONFIG, physics=physics), hidden=4
    )
    for name, stem, key, value in (
        ("blind", path / "high", "cues", "none"),
        ("dizzy", LOW, "gyro", not LOW_CONFIG.gyro),
    ):
        header = json.loads(Path(f"{stem}.json").read_text())
        header["meta"]["config"][key] = value
        (path / f"{name}.json").write_text(json.dumps(header))
        (path / f"{name}.safetensors").write_bytes(Path(f"{stem}.safetensors").read_bytes())
    (path / "file").write_text("")


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ("--high {0}/high --format onnx,tflite", "unknown format 'tflite'; allowed: onnx, torchs"),
        ("--high {0}/absent", "absent.json: no such file"),
        ("--high {0}/high --low {0}/absent", "absent.json: no such file"),
        ("--high {0}/high --low {0}/high", "high: not a low policy"),
        ("--high {low}", "low: not a high policy"),
        ("--high {0}/fast", "commands.vx asks for [-1.0, 1.5], but the low policy was trained on"),
        ("--high {0}/slow", "trained for a low policy with a control step of 0.01 s, not 0.02"),
        ("--high {0}/blind", "trained for a high policy that observes 53 values, not 92"),
        ("--high {0}/high --low {0}/dizzy", "dizzy: its configuration gives "),
        ("--high {0}/forward", "forward: only a recurrent high policy can be exported"),
        ("--high {0}/high --out {0}/file/out", "Not a directory"),
        ("--high {0}/high --out {urdf}", "holds the robot itself, "),
    ],
)
def test_bad_input_is_one_line_and_writes_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], flags: str, message: str
) -> None:
    save_pairs(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    folder = urdf_path(LOW_CONFIG.robot).parent
    kept = sorted((path, path.stat().st_mtime_ns) for path in folder.iterdir())
    arguments = flags.format(tmp_path, low=LOW, urdf=folder).split()
    assert export.main(["--out", str(tmp_path / "out"), *arguments]) == 2
    said = capsys.readouterr()
    assert said.err.startswith("tdgc.export: ") and said.err.count("\n") == 1
    assert message in said.err
    assert said.out == "" and sorted(tmp_path.rglob("*")) == before
    assert kept == sorted((path, path.stat().st_mtime_ns) for path in folder.iterdir())


def test_missing_package_names_the_extra(
    tmp_path: Path, high: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "onnxscript", None)  # as if it were not installed
    out = tmp_path / "out"
    assert export.main(["--high", str(high), "--out", str(out)]) == 2
    said = capsys.readouterr()
    assert "format onnx,torchscript needs onnxscript: install the extra 'export'" in said.err
    assert said.err.count("\n") == 1 and not out.exists()


def test_ctrl_c_is_one_line_and_stops_a_caller_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stop(*args: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(export, "load_pair", stop)
    with pytest.raises(SystemExit, match=r"^1$"):
        export.main(["--format", "torchscript", "--out", str(tmp_path)])
    assert capsys.readouterr().err == "tdgc.export: stopped by Ctrl-C\n"
