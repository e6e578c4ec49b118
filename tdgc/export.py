"""Both policies as ONNX and TorchScript graphs, for a robot that has no part of this package.

    python -m tdgc.export --low runs/low/policy --high runs/high/policy --out runs/export

A graph holds all that stands between a robot's sensors and its joint targets: observation
(Sec. IV-A, IV-B), network, decoder, phase clock and joint targets. Beside ``low.onnx`` and
``low.pt`` stands ``low_interface.json``, which says what goes in and comes out, in which order and
unit, and how the joints are driven; likewise for ``high``. Afterwards each pair of graphs drives a
robot in the simulator for as long as an episode, and its outputs are compared with the policies'.

All inputs and outputs are vectors of float64. The networks run in float32, as they were trained;
what surrounds them runs in float64, as in the simulator: a clock in float32 would drift away.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import importlib.util
import json
import logging
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from numpy.typing import ArrayLike
from torch import Tensor, nn

from tdgc import __version__
from tdgc.benchmark.drivers import load_high
from tdgc.config import CommandRanges, ConfigError, HighLevelConfig, LowLevelConfig, RobotConfig
from tdgc.errors import install_hint
from tdgc.policies import Policy
from tdgc.sim.commands import (
    CONTINUOUS,
    INDEX,
    NAMES,
    NUM_ACTIONS,
    NUM_COMMANDS,
    UNITS,
    CommandDecoder,
    default_command,
    observed_command,
)
from tdgc.sim.gaits import FEET, GAIT_TABLE, GAITS
from tdgc.sim.geometry import FRONT, JOINTS, SIDE, read_geometry
from tdgc.sim.locomotion import actor_layout
from tdgc.sim.observation import Term, width
from tdgc.sim.robot import (
    HIGHEST_FOOT,
    NUM_JOINTS,
    Array,
    action_scale,
    foot_kinematics,
    nominal_pose,
    target_limits,
)
from tdgc.tasks.executor import Executor
from tdgc.tasks.high_env import (
    GOAL_SCALE,
    PRETRAINED,
    SEMANTIC,
    NavigationTask,
    high_layout,
    load_low,
    observe_high,
)
from tdgc.tasks.probes import NUM_PROBES, PROBE_RANGE, PROBES, height_probes
from tdgc.tasks.rules import GOING, outcome

#: Formats and the endings of their files.
FORMATS = {"onnx": ".onnx", "torchscript": ".pt"}
#: Largest difference allowed between graphs and policies, in the units of the outputs: float32
#: networks of this size differ by about 1e-6 where two libraries add up in another order.
TOLERANCE = 1e-5

_ONNX_PACKAGES = ("onnx", "onnxruntime", "onnxscript")  # the extra `export` of setup.cfg


# ---------------------------------------------------------------------------------------------
# The graphs


def _constant(value: ArrayLike) -> Tensor:
    # A tensor, since the ONNX exporter rounds Python's floats to float32.
    return th.tensor(np.asarray(value, dtype=np.float64))


_TURN = _constant(2.0 * np.pi)


class Row:
    """Rows of a network's inputs, in the order and scales of ``layout``."""

    def __init__(self, layout: Sequence[Term[Any]]) -> None:
        self._terms = [(term.name, _constant(term.scale)) for term in layout]

    def __call__(self, terms: Mapping[str, Tensor]) -> Tensor:
        """Terms by name, in the units that they are read in -> (n,) float32."""
        return th.cat([scale * terms[name] for name, scale in self._terms]).float()


@dataclass(frozen=True)
class Signal:
    """An input or output of a graph: a vector of float64.

    Attributes:
        name: as in the graph.
        size: length of the vector.
        unit: of its entries; None where the table ``order`` gives each entry's.
        meaning: what it is.
        order: the table in the interface file that names the entries.
        previous: of an input, the input or output whose value of the step before it takes.
        start: of such an input, what it (or each entry) is in the first step.
    """

    name: str
    size: int
    unit: str | None
    meaning: str
    order: str | None = None
    previous: str | None = None
    start: float | tuple[float, ...] | None = None


_BODY = (
    Signal("gravity", 3, "1", "unit vector of gravity in the trunk's frame: ahead, left, up"),
    Signal("joint_angles", NUM_JOINTS, "rad", "measured angles", "joints"),
    Signal("joint_speeds", NUM_JOINTS, "rad/s", "measured speeds", "joints"),
)
_GYRO = Signal("gyro", 3, "rad/s", "angular velocity about the trunk's axes: ahead, left, up")


class ClippedActor(nn.Module):
    """The mean action of a policy as ``Policy.predict`` clips it, after the LSTM if any."""

    def __init__(self, policy: Policy) -> None:
        super().__init__()
        self.actor = policy.actor
        self.low, self.high = th.from_numpy(policy.low), th.from_numpy(policy.high)

    def forward(self, x: Tensor) -> Tensor:
        """(n,) -> (action_dim,), both float32."""
        return th.as_tensor(self.actor(x[None])[0]).clamp(self.low, self.high)


def foot_phases(clock: Tensor, command: Tensor) -> Tensor:
    """Warped phase of each foot, as ``gaits.foot_phases``: (1,), (15,) -> (4,)."""
    phase, offset, bound = command[12:].unbind()
    duty = command[INDEX["duration"]]
    raw = clock + th.stack([phase + offset + bound, offset, bound, phase])
    raw = raw - raw.floor()
    swing = 0.5 + (raw - duty) * (0.5 / (1.0 - duty))
    return th.where(raw < duty, raw * (0.5 / duty), swing)


def clock_signal(clock: Tensor, command: Tensor) -> Tensor:
    """sin(2 pi phase) of each foot, as ``PhaseClock.signal``: (1,), (15,) -> (4,)."""
    return th.sin(_TURN * foot_phases(clock, command))


class Pose(nn.Module):
    """q0, as ``Locomotion.pose``: (1,), (1,), (15,) -> (12,) rad."""

    def __init__(self, robot: RobotConfig) -> None:
        super().__init__()
        nominal = nominal_pose(robot)
        self.follows, self.nominal = robot.commanded_pose, _constant(nominal)
        geometry = read_geometry(robot)
        self.thigh, self.calf = geometry.thigh, geometry.calf
        standing, _ = foot_kinematics(geometry, nominal[None], np.zeros((1, NUM_JOINTS)))
        hips = np.pad(geometry.hips, ((0, 0), (0, 1)))
        self.feet, self.default = _constant(standing[0] - hips), _constant(default_command())
        self.front, self.side = _constant(FRONT), _constant(SIDE)
        self.out = _constant(geometry.abduction * SIDE)
        self.lowest, self.highest = map(_constant, geometry.joint_limits[2::3].T)

    def forward(self, clock: Tensor, grown: Tensor, command: Tensor) -> Tensor:
        """``grown``: share of the swing that is asked so far, as in ``PhaseClock.swing``."""
        if not self.follows:
            return self.nominal
        swing = (2.0 * foot_phases(clock, command) - 1.0).clamp(0.0, 1.0)
        raised = grown * th.sin(0.5 * _TURN * swing)
        change = command - self.default
        x = self.feet[:, 0] + 0.5 * change[INDEX["stance_length"]] * self.front
        y = self.feet[:, 1] + 0.5 * change[INDEX["stance_width"]] * self.side
        z = self.feet[:, 2] - change[INDEX["body_height"]]
        z = (z + change[INDEX["swing_height"]] * raised).clamp(max=HIGHEST_FOOT)
        out, upper, lower = self.out, self.thigh, self.calf
        down = (y * y + z * z - out * out).clamp(min=0.0).sqrt()
        square = x * x + down * down
        bend = (square - upper * upper - lower * lower) / (2.0 * upper * lower)
        # ONNX Runtime has inverse functions of float32 alone, and no arctan2.
        calf = (-th.acos(bend.clamp(-1.0, 1.0).float())).double()
        calf = calf.clamp(self.lowest, self.highest)
        lean = lower * th.sin(calf) / (upper + lower * th.cos(calf))
        hip = th.atan(((out * z + down * y) / (out * y - down * z)).float()).double()
        thigh = (th.atan((-x / down).float()) - th.atan(lean.float())).double()
        return th.stack([hip, thigh, calf], 1).flatten()


class LowLevel(nn.Module):
    """One control step of the low level (Sec. IV-A): sensors and commands to joint targets.

    Attributes:
        inputs, outputs: what ``forward`` takes and gives, in order.
    """

    def __init__(self, policy: Policy, config: LowLevelConfig) -> None:
        super().__init__()
        self.actor = ClippedActor(policy)
        robot = config.robot
        self.dt = _constant(config.physics.control_dt)
        self.limit = _constant(robot.action_limit)
        self.pose = Pose(robot)
        self.row = Row(actor_layout(config.gyro))
        self.whole = _constant(1.0)
        ramped = robot.commanded_pose and robot.swing_ramp > 0.0
        self.ramp = _constant(robot.swing_ramp) if ramped else None
        hurried = robot.start_frequency > 0.0 and robot.start_cycles > 0.0
        self.start = _constant(robot.start_cycles) if hurried else None
        self.least = _constant(robot.start_frequency)
        self.counted = ramped or hurried
        self.is_frequency = _constant(np.arange(NUM_COMMANDS) == INDEX["frequency"])
        self.joint_scale = _constant(action_scale(robot))
        lowest, highest = target_limits(robot, read_geometry(robot))
        self.lowest, self.highest = _constant(lowest), _constant(highest)
        # This map is affine, so its values at 0 and at 1 say all.
        zero = observed_command(np.zeros(NUM_COMMANDS))
        self.command_zero = _constant(zero)
        self.command_gain = _constant(observed_command(np.ones(NUM_COMMANDS)) - zero)
        self.gait_shares = _constant(np.arange(len(GAITS)) / (len(GAITS) - 1))
        self.inputs = [
            *_BODY,
            *([_GYRO] if config.gyro else []),
            Signal("last_action", NUM_JOINTS, "1", "the last action", "joints", "action", 0.0),
            Signal("action_before", NUM_JOINTS, "1", "before that", "joints", "last_action", 0.0),
            Signal("commands", NUM_COMMANDS, None, "to follow in this step", "commands"),
            Signal("clock", 1, "1", "share of the gait cycle, in [0, 1)", None, "next_clock", 0.0),
        ]
        if self.counted:
            first = tuple(default_command().tolist())
            form = (NUM_COMMANDS, None, "the last", "commands", "commands", first)
            self.inputs += [
                Signal("last_commands", *form),
                Signal("cycles", 1, "1", "of the gait since it began", None, "next_cycles", 0.0),
            ]
        self.outputs = [
            Signal("action", NUM_JOINTS, "1", "within its limits", "joints"),
            Signal("joint_targets", NUM_JOINTS, "rad", "for the joint control", "joints"),
            Signal("next_clock", 1, "1", "share of the gait cycle at the end of this step"),
        ]
        if self.counted:
            self.outputs.append(
                Signal("next_cycles", 1, "1", "of the gait so far, after this step")
            )

    def forward(self, *values: Tensor) -> tuple[Tensor, ...]:
        """``inputs`` -> ``outputs``."""
        x = _by_name(self.inputs, values)
        command, clock = x["commands"], x["clock"]
        grown = self.whole
        if self.counted:
            same = (command[12:] == x["last_commands"][12:]).all()
            cycles = x["cycles"] * same
        if self.ramp is not None:
            grown = (cycles / self.ramp).clamp(max=1.0)
        if self.start is not None:
            early = 1.0 - (cycles / self.start).clamp(max=1.0)
            missing = (self.least - command[INDEX["frequency"]]).clamp(min=0.0)
            command = command + self.is_frequency * (early * missing)
        pose = self.pose(clock, grown, command)
        terms = x | {
            "joint_error": x["joint_angles"] - pose,
            "joint_speed": x["joint_speeds"],
            "command": self.command_gain * command + self.command_zero,
            "clock": clock_signal(clock, command),
            "gait": self._gait(command),
        }
        action = self.actor(self.row(terms)).double().clamp(-self.limit, self.limit)
        run = self.dt * command[INDEX["frequency"]]
        clock = clock + run
        targets = (pose + self.joint_scale * action).clamp(self.lowest, self.highest)
        step = (action, targets, clock - clock.floor())
        return (*step, cycles + run) if self.counted else step

    def _gait(self, command: Tensor) -> Tensor:
        """Index of the gait as a share of the last one's, as the observation has it: (1,)."""
        trot, pronk, pace, bound = self.gait_shares.unbind()
        phase, offset, pairs = (command[i : i + 1] > 0.25 for i in (12, 13, 14))
        return th.where(phase, trot, th.where(pairs, pace, th.where(offset, bound, pronk)))


class HighLevel(nn.Module):
    """One decision (Sec. IV-B): goal, cues and sensors to the 15 commands.

    Attributes:
        inputs, outputs: what ``forward`` takes and gives, in order.
    """

    def __init__(self, policy: Policy, config: HighLevelConfig, low: LowLevelConfig) -> None:
        super().__init__()
        self.actor = ClippedActor(policy)
        self.lstm = policy._lstm
        layout = high_layout(config.cues)
        self.row = Row(layout)
        hidden = self.lstm[1].shape[1]
        decoder = CommandDecoder(config.commands, config.action_limit, config.gaits)
        self.low = _constant(decoder.low[:12])
        self.span = _constant(decoder.high[:12] - decoder.low[:12])
        self.embedding = _constant(GAIT_TABLE[decoder.gaits])
        self.limit = _constant(config.action_limit)
        self.nominal = _constant(nominal_pose(low.robot))
        step = config.decimation * low.physics.control_dt
        seconds = round(config.episode_seconds / step) * step
        self.seconds = _constant(seconds)
        self.ahead = _constant([1.0, 0.0])
        start = tuple(default_command().tolist())
        family = "1 for the terrain under the robot, 0 for the others"
        probes = (
            "ground at points of the frame that turns by yaw alone, above a plane "
            f"{low.robot.base_height:g} m under the trunk; clipped at {PROBE_RANGE:g} m"
        )
        cues = {
            "family": Signal("family", len(SEMANTIC), "1", family, "families"),
            "probes": Signal("probes", NUM_PROBES, "m", probes, "probes"),
        }
        self.inputs = [
            Signal("goal", 2, "m", "ahead and to the left in the frame that turns by yaw alone"),
            Signal("time_left", 1, "s", f"of {seconds:g} s"),
            *_BODY,
            Signal("last_decision", NUM_ACTIONS, "1", "the last", "decision", "decision", 0.0),
            Signal("last_commands", NUM_COMMANDS, None, "the last", "commands", "commands", start),
            Signal("clock", 1, "1", "the low level's in its coming step"),
            *(cues[term.name] for term in layout if term.name in cues),
            Signal("hidden", hidden, "1", "state of the LSTM", None, "next_hidden", 0.0),
            Signal("cell", hidden, "1", "cell of the LSTM", None, "next_cell", 0.0),
        ]
        self.outputs = [
            Signal("decision", NUM_ACTIONS, "1", "raw actions", "decision"),
            Signal("commands", NUM_COMMANDS, None, "for the low level", "commands"),
            Signal("next_hidden", hidden, "1", "state of the LSTM"),
            Signal("next_cell", hidden, "1", "cell of the LSTM"),
        ]

    def forward(self, *values: Tensor) -> tuple[Tensor, ...]:
        """``inputs`` -> ``outputs``."""
        x = _by_name(self.inputs, values)
        goal = x["goal"]
        distance = (goal * goal).sum(0, keepdim=True).sqrt()
        direction = th.where(distance > 0.0, goal / distance, self.ahead)
        terms = x | {
            "goal": th.cat([GOAL_SCALE * distance, direction]),
            "time_left": x["time_left"] / self.seconds,
            "joint_error": x["joint_angles"] - self.nominal,
            "joint_speed": x["joint_speeds"],
            "last_action": self._normalise(x["last_decision"]),
            "clock": clock_signal(x["clock"], x["last_commands"]),
        }
        if "probes" in x:
            terms["probes"] = x["probes"].clamp(-PROBE_RANGE, PROBE_RANGE)
        state = (x["hidden"].float()[None], x["cell"].float()[None])
        hidden, cell = th.lstm_cell(self.row(terms)[None], state, *self.lstm)
        decision = self.actor(hidden[0]).double()
        return decision, self._decode(decision), hidden[0].double(), cell[0].double()

    def _normalise(self, decision: Tensor) -> Tensor:
        return decision.clamp(-self.limit, self.limit) / self.limit

    def _decode(self, decision: Tensor) -> Tensor:
        """As ``CommandDecoder.decode``: (13,) -> (15,)."""
        x = self._normalise(decision)
        n = len(self.embedding)
        gait = (0.5 * n * (x[-1] + 1.0)).floor().clamp(0, n - 1).long()
        return th.cat([self.low + 0.5 * (x[:-1] + 1.0) * self.span, self.embedding[gait]])


def _by_name(signals: Sequence[Signal], values: Sequence[Tensor]) -> dict[str, Tensor]:
    return {s.name: value for s, value in zip(signals, values, strict=True)}


# ---------------------------------------------------------------------------------------------
# Writing


@dataclass(frozen=True)
class Pair:
    """Both levels and the MDPs that they were trained on."""

    low: Policy
    low_config: LowLevelConfig
    high: Policy
    high_config: HighLevelConfig


def load_pair(low: str | Path, high: str | Path) -> Pair:
    """Both policies from their files.

    Raises:
        ValueError: a file that cannot be used, or levels that do not fit each other.
    """
    low_policy, low_config = load_low(low)
    size = width(actor_layout(low_config.gyro))
    if low_policy.actor_dim != size:
        raise ConfigError(
            f"{low}: its configuration gives {size} observations, it takes {low_policy.actor_dim}"
        )
    high_policy, high_config = load_high(high, low_policy, low_config)
    if high_policy.kind != "lstm":
        raise ConfigError(f"{high}: only a recurrent high policy can be exported")
    return Pair(low_policy, low_config, high_policy, high_config)


def interfaces(pair: Pair, low: LowLevel, high: HighLevel) -> dict[str, dict[str, Any]]:
    """What the two interface files say, by level."""
    robot, physics = pair.low_config.robot, pair.low_config.physics
    low_table = _signals(pair.low, low) | {
        "rate_hz": 1.0 / physics.control_dt,
        "joints": JOINTS,
        "commands": _commands(pair.low_config.commands),
        "feet": FEET,
        "gaits": {
            gait: dict(zip(NAMES[12:], row, strict=True))
            for gait, row in zip(GAITS, GAIT_TABLE.tolist(), strict=True)
        },
        "joint_control": {
            "law": "torque = kp (target - angle) - kd speed, within the torque limit; 0 where it "
            "would drive a joint beyond its speed limit",
            "axes": "right-handed: hips about the axis ahead, thighs and calves about the one to "
            "the left; at 0 a leg is straight down",
            "rate_hz": 1.0 / physics.dt,
            "kp": {"unit": "N m/rad", "value": [robot.kp] * NUM_JOINTS},
            "kd": {"unit": "N m s/rad", "value": [robot.kd] * NUM_JOINTS},
            "torque_limit": {"unit": "N m", "value": robot.torque_limit * 4},
            "speed_limit": {"unit": "rad/s", "value": robot.speed_limit * 4},
            "nominal_pose": {"unit": "rad", "value": nominal_pose(robot).tolist()},
        },
    }
    decimation = pair.high_config.decimation
    high_table = _signals(pair.high, high) | {
        "rate_hz": 1.0 / (decimation * physics.control_dt),
        "control_steps": decimation,
        "joints": JOINTS,
        "commands": _commands(pair.high_config.commands or pair.low_config.commands),
        "decision": (*CONTINUOUS, "gait"),
        "families": SEMANTIC,
        "probes": {"unit": "m", "ahead_left": PROBES[pair.high_config.probes].tolist()},
    }
    return {"low": low_table, "high": high_table}


def _signals(policy: Policy, level: LowLevel | HighLevel) -> dict[str, Any]:
    def table(signal: Signal) -> dict[str, Any]:
        said = {k: v for k, v in dataclasses.asdict(signal).items() if v is not None}
        form = {"shape": [said.pop("size")], "type": "float64"}
        return {"name": said.pop("name")} | form | said

    return {
        "package": f"tdgc {__version__}",
        "policy": {k: v for k, v in policy.meta.items() if k not in ("config", "low")},
        "inputs": [table(s) for s in level.inputs],
        "outputs": [table(s) for s in level.outputs],
    }


def _commands(ranges: CommandRanges) -> list[dict[str, Any]]:
    bounds = CommandDecoder(ranges)
    columns = zip(NAMES, UNITS, bounds.low.tolist(), bounds.high.tolist(), strict=True)
    return [dict(zip(("name", "unit", "low", "high"), row, strict=True)) for row in columns]


def write(pair: Pair, folder: Path, formats: Sequence[str]) -> None:
    """Write graphs and interface files of both levels into ``folder``, which exists.

    Raises:
        OSError: a file cannot be written.
    """
    low = LowLevel(pair.low, pair.low_config)
    high = HighLevel(pair.high, pair.high_config, pair.low_config)
    tables = interfaces(pair, low, high)
    for name, level in (("low", low), ("high", high)):
        text = json.dumps(tables[name], indent=2) + "\n"
        (folder / f"{name}_interface.json").write_text(text, encoding="utf-8")
        for form in formats:
            _write_graph(level, folder / (name + FORMATS[form]))


def _write_graph(level: LowLevel | HighLevel, path: Path) -> None:
    example = tuple(th.full((s.size,), 0.5, dtype=th.float64) for s in level.inputs)
    with _quiet():
        if path.suffix == FORMATS["torchscript"]:
            traced = th.jit.trace(level, example)  # type: ignore[no-untyped-call]
            th.jit.save(traced, path)
            return
        th.onnx.export(
            level,
            example,
            path,
            input_names=[s.name for s in level.inputs],
            output_names=[s.name for s in level.outputs],
            external_data=False,
            dynamo=True,
            verbose=False,
        )


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Without what the exporters say of themselves: deprecations, operators of torchvision."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        logging.disable(logging.WARNING)
        try:
            yield
        finally:
            logging.disable(logging.NOTSET)


# ---------------------------------------------------------------------------------------------
# Running and checking


class Graph:
    """A graph from a folder that ``write`` filled, run on one thread as a robot would run it.

    Attributes:
        memory: values of the inputs that come from the step before, by name.
        seconds: CPU time of the last step, which is its latency on a core of its own.
    """

    def __init__(self, folder: Path, name: str, form: str) -> None:
        table = json.loads((folder / f"{name}_interface.json").read_text(encoding="utf-8"))
        self._inputs = [s["name"] for s in table["inputs"]]
        self._outputs = [s["name"] for s in table["outputs"]]
        self._kept = {s["name"]: s["previous"] for s in table["inputs"] if "previous" in s}
        self._start = {
            s["name"]: np.full(s["shape"], s["start"]) for s in table["inputs"] if "start" in s
        }
        self._run = _RUNTIMES[form](folder / (name + FORMATS[form]), self._inputs)
        self.reset()

    def reset(self) -> None:
        """Begin a new episode."""
        self.memory, self.seconds = dict(self._start), 0.0

    def __call__(self, values: dict[str, Array]) -> dict[str, Array]:
        """One step, inputs by name -> outputs by name; what else ``values`` holds does not matter.

        Inputs that come from the step before are in ``memory`` unless given.
        """
        known = self.memory | values
        inputs = [known[name] for name in self._inputs]
        started = time.thread_time()
        outputs = self._run(inputs)
        self.seconds = time.thread_time() - started
        known |= dict(zip(self._outputs, outputs, strict=True))
        self.memory = {name: known[source] for name, source in self._kept.items()}
        return {name: known[name] for name in self._outputs}


Run = Callable[[list[Array]], list[Array]]


def _open_onnx(path: Path, inputs: list[str]) -> Run:
    import onnxruntime  # type: ignore[import-untyped]

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    return lambda values: session.run(None, dict(zip(inputs, values, strict=True)))


def _open_torchscript(path: Path, inputs: list[str]) -> Run:
    with _quiet():
        module = th.jit.load(path)  # type: ignore[no-untyped-call]

    def run(values: list[Array]) -> list[Array]:
        with th.inference_mode():
            return [out.numpy() for out in module(*map(th.from_numpy, values))]

    return run


_RUNTIMES = {"onnx": _open_onnx, "torchscript": _open_torchscript}


@dataclass(frozen=True)
class Check:
    """What ``check`` found.

    Attributes:
        difference: the largest between an output of a graph and the policy's.
        seconds: (control steps,) CPU time in the graphs: the low level's, and every decimation-th
            step the high level's too.
    """

    difference: float
    seconds: Array


class _LowGraph:
    """The low policy's graph as what acts, with the policy beside it.

    Attributes:
        differences: of each step's action, one after another.
        targets: (12,) rad, the last step's joint targets.
    """

    def __init__(self, graph: Graph, policy: Policy, limit: float, task: NavigationTask) -> None:
        self._graph, self._policy, self._limit, self._task = graph, policy, limit, task
        self.differences: list[Array] = []
        self.targets = np.zeros(NUM_JOINTS)

    def predict(self, obs: ArrayLike) -> tuple[Array, None]:
        """The graph's action, (1, 12), from what the robot senses; the policy's from ``obs``."""
        wanted = np.clip(self._policy.predict(obs)[0], -self._limit, self._limit)
        command = self._task.locomotion.command[0].copy()  # the graph remembers it
        made = self._graph(_sense(self._task) | {"commands": command})
        self.differences.append(made["action"] - wanted[0])
        self.targets = made["joint_targets"]
        return made["action"][None], None


def check(folder: Path, form: str, low: str | Path, high: str | Path) -> Check:
    """Let the graphs in ``folder`` drive a robot for as long as an episode, policies beside them.

    The policies see the robot through the simulator's own observation, with their own clock and
    LSTM state. A robot that falls or leaves its tile starts anew.

    Args:
        folder: where ``write`` wrote.
        form: of ``FORMATS``.
        low, high: the policies' paths.

    Raises:
        ValueError: policies that cannot be used.
    """
    pair = load_pair(low, high)
    config, limit = pair.high_config, pair.low_config.robot.action_limit
    decide, walk = Graph(folder, "high", form), Graph(folder, "low", form)
    task = NavigationTask(config, low, 1, seed=0, training=False)
    loco = task.locomotion
    acting = _LowGraph(walk, pair.low, limit, task)
    executor = Executor(loco, acting)
    differences: list[Array] = []
    seconds: list[float] = []
    ended = True
    try:
        for _ in range(task.horizon):
            if ended:
                task.reset(np.arange(1))
                decide.reset()
                walk.reset()
                walk.memory["clock"] = loco.clock.clock
                loco.command[:] = decide.memory["last_commands"]
                state, last = None, np.zeros((1, NUM_ACTIONS), dtype=np.float32)
            # A new episode has the phases of the one before until its first step.
            loco.clock.update(loco.command[:, 12:], loco.command[:, INDEX["duration"]])
            seen = observe_high(
                loco,
                task.goal,
                task.elapsed / task.horizon,
                task.decoder.normalise(last),
                task.family_index,
                config.cues,
                height_probes(loco, PROBES[config.probes]),
            )
            last, state = pair.high.predict(seen, state)
            made = decide(_sense(task) | {"clock": walk.memory["clock"]})
            differences += [
                made["decision"] - last[0],
                made["commands"] - task.decoder.decode(made["decision"]),
            ]
            task.elapsed += 1
            for k in range(config.decimation):
                executor.step(made["commands"][None])
                differences.append(acting.targets - loco.targets[0, 0])
                seconds.append(walk.seconds + (decide.seconds if k == 0 else 0.0))
            ended = outcome(loco.world)[0] != GOING
    finally:
        task.close()
    worst = np.abs(np.concatenate(differences + acting.differences)).max()
    return Check(float(worst), np.array(seconds))


def _sense(task: NavigationTask) -> dict[str, Array]:
    """What the task's one robot would know by its sensors and its map."""
    loco, state = task.locomotion, task.locomotion.world.state
    ahead, left = np.cos(state.yaw[0]), np.sin(state.yaw[0])
    offset = task.goal[0] - state.position[0, :2]
    return {
        "gravity": state.gravity[0],
        "joint_angles": state.q[0] - loco.joint_offset[0],
        "joint_speeds": state.qd[0],
        "gyro": state.rotation[0].T @ state.ang_vel[0],
        "goal": np.array([[ahead, left], [-left, ahead]]) @ offset,
        "time_left": (task.horizon - task.elapsed) * task.step_seconds,
        "family": np.eye(len(SEMANTIC))[task.family_index[0]],
        "probes": height_probes(loco, PROBES[task.config.probes])[0],
    }


def _choose_formats(text: str) -> list[str]:
    names = list(dict.fromkeys(text.split(",")))
    for name in names:
        if name not in FORMATS:
            raise ValueError(f"unknown format '{name}'; allowed: {', '.join(FORMATS)}")
    missing = [name for name in _ONNX_PACKAGES if importlib.util.find_spec(name) is None]
    if "onnx" in names and missing:
        raise ValueError(
            f"format onnx needs {', '.join(missing)}: {install_hint('export')}, "
            "or use --format torchscript"
        )
    return names


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--low", type=Path, default=PRETRAINED / "low", help="low level (shipped)")
    parser.add_argument(
        "--high", type=Path, default=PRETRAINED / "high", help="high level (shipped)"
    )
    parser.add_argument("--out", type=Path, required=True, help="folder to write into")
    parser.add_argument("--format", default=",".join(FORMATS), help=f"of {', '.join(FORMATS)}")
    args = parser.parse_args(arguments)
    try:
        formats = _choose_formats(args.format)
        pair = load_pair(args.low, args.high)
        args.out.mkdir(parents=True, exist_ok=True)
        write(pair, args.out, formats)
    except (ValueError, OSError) as error:
        print(f"tdgc.export: {error}", file=sys.stderr)
        return 2
    th.set_num_threads(1)  # the time of one core is asked for
    good = True
    for form in formats:
        result = check(args.out, form, args.low, args.high)
        median, slow = 1e3 * np.percentile(result.seconds, [50.0, 99.0])
        print(
            f"{form}: largest difference {result.difference:.1e} in {len(result.seconds)} control "
            f"steps; a step takes {median:.3f} ms (median), {slow:.3f} ms (99th percentile)"
        )
        if not result.difference <= TOLERANCE:
            message = f"{form} differs by {result.difference:.1e}, allowed is {TOLERANCE:g}"
            print(f"tdgc.export: {message}", file=sys.stderr)
            good = False
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
