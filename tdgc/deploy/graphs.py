"""The two graphs of an export as PyTorch modules: everything between sensors and joint targets.

A graph holds a policy and all that the simulator computes around it: observation (Sec. IV-A, IV-B),
decoder, phase clock and joint targets. All inputs and outputs are vectors of float64. The networks
run in float32, as they were trained. Everything around them runs in float64, as in the simulator,
because a clock in float32 would drift.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch as th
from numpy.typing import ArrayLike
from torch import Tensor, nn

from tdgc.config import HighLevelConfig, LowLevelConfig, RobotConfig
from tdgc.policies import Policy
from tdgc.sim.commands import (
    INDEX,
    NAMES,
    NUM_ACTIONS,
    NUM_COMMANDS,
    CommandDecoder,
    default_command,
    observed_command,
)
from tdgc.sim.gaits import GAIT_TABLE, GAITS
from tdgc.sim.geometry import FRONT, SIDE, read_geometry
from tdgc.sim.locomotion import actor_layout
from tdgc.sim.observation import Term
from tdgc.sim.robot import (
    GRAVITY,
    HIGHEST_FOOT,
    NUM_JOINTS,
    action_scale,
    nominal_feet,
    nominal_height,
    nominal_pose,
    target_limits,
)
from tdgc.tasks.high_observation import GOAL_SCALE, SEMANTIC, high_layout
from tdgc.tasks.probes import NUM_PROBES, PROBE_RANGE


def _constant(value: ArrayLike) -> Tensor:
    # A tensor, because the ONNX exporter rounds Python floats to float32.
    return th.tensor(np.asarray(value, dtype=np.float64))


_TURN, _HALF_TURN, _HALF = _constant(2.0 * np.pi), _constant(np.pi), _constant(0.5)


class Row:
    """Builds a network's input rows, in the order and scales of ``layout``."""

    def __init__(self, layout: Sequence[Term[Any]]) -> None:
        self._names = [term.name for term in layout]
        scales = [np.broadcast_to(term.scale, term.size) for term in layout]
        self._scale = _constant(np.concatenate(scales))

    def __call__(self, terms: Mapping[str, Tensor]) -> Tensor:
        """Terms by name, unscaled -> (n,) float32."""
        return (self._scale * th.cat([terms[name] for name in self._names])).float()


@dataclass(frozen=True)
class Signal:
    """An input or output of a graph: a vector of float64.

    Attributes:
        name: its name in the graph.
        size: length of the vector.
        unit: unit of the entries; None if the table ``order`` gives one for each entry.
        meaning: what it is.
        order: the table in the interface file that names the entries.
        previous: for an input, the input or output of the same graph whose value in the previous
            step it takes.
        start: for an input, the value of it (or of each entry) in the first step of an episode.
        source: for an input, the output of the other graph whose latest value it takes.
    """

    name: str
    size: int
    unit: str | None
    meaning: str
    order: str | None = None
    previous: str | None = None
    start: float | tuple[float, ...] | None = None
    source: str | None = None


_BODY = (
    Signal("gravity", 3, "1", "unit vector of gravity in the trunk's frame: ahead, left, up"),
    Signal("joint_angles", NUM_JOINTS, "rad", "measured angles", "joints"),
    Signal("joint_speeds", NUM_JOINTS, "rad/s", "measured speeds", "joints"),
)
_GYRO = Signal("gyro", 3, "rad/s", "angular velocity about the trunk's axes: ahead, left, up")


class ClippedActor(nn.Module):
    """The mean action of a policy, clipped as in ``Policy.predict``; after the LSTM if any."""

    def __init__(self, policy: Policy) -> None:
        super().__init__()
        self.actor = policy.actor
        self.low, self.high = th.from_numpy(policy.low), th.from_numpy(policy.high)

    def forward(self, x: Tensor) -> Tensor:
        """Input of the policy's ``actor`` for one robot -> (action_dim,), both float32."""
        return th.as_tensor(self.actor(x)[0]).clamp(self.low, self.high)


Commands = Mapping[str, Tensor]


def by_command(command: Tensor) -> Commands:
    """The 15 commands by name, (1,) each."""
    return dict(zip(NAMES, command.chunk(NUM_COMMANDS), strict=True))


def foot_phases(clock: Tensor, command: Commands) -> Tensor:
    """Warped phase of each foot, as in ``gaits.foot_phases``: (1,) or (n, 1) -> (4,) or (n, 4)."""
    phase, offset, bound, duty = (command[name] for name in (*NAMES[12:], "duration"))
    raw = clock + th.cat([phase + offset + bound, offset, bound, phase])
    raw = raw - raw.floor()
    swing = 0.5 + (raw - duty) * (_HALF / (1.0 - duty))
    return th.where(raw < duty, raw * (_HALF / duty), swing)


class Pose(nn.Module):
    """q0, as in ``Locomotion.pose``.

    Attributes:
        ahead: (n, 1) s, times ahead of the clock at which foot phases are needed: now and, for a
            pose that walks, the middle of the control step and the time at which joints reach
            their targets.
    """

    def __init__(self, robot: RobotConfig, control_dt: float) -> None:
        super().__init__()
        nominal = nominal_pose(robot)
        self.follows, self.nominal = robot.commanded_pose, _constant(nominal)
        self.walks = robot.commanded_gait
        middle = 0.5 * control_dt
        ahead = [0.0, middle, middle + robot.kd / robot.kp] if self.walks else [0.0]
        self.ahead = _constant(ahead)[:, None]
        geometry = read_geometry(robot)
        self.thigh, self.calf = geometry.thigh, geometry.calf
        self.lengths = _constant([[geometry.thigh], [geometry.calf]])
        standing = nominal_feet(robot, geometry)
        hips = np.pad(geometry.hips, ((0, 0), (0, 1)))
        default = dict(zip(NAMES, default_command(), strict=True))
        self.hips_x, self.hips_y = map(_constant, geometry.hips.T)
        # Feet without the contribution of the commands: relative to the trunk for a pose that
        # walks, because commands pitch and roll the trunk, otherwise relative to their hips.
        x, y, z = (standing if self.walks else standing - hips).T
        self.x = _constant(x - 0.5 * default["stance_length"] * FRONT)
        self.y = _constant(y - 0.5 * default["stance_width"] * SIDE)
        lift = nominal_height(robot, geometry) - robot.base_height if self.walks else 0.0
        raised = 0.0 if self.walks else default["swing_height"]
        self.z, self.default_swing = _constant(z + default["body_height"] + lift), _constant(raised)
        self.front, self.side = _constant(0.5 * FRONT), _constant(0.5 * SIDE)
        self.out = _constant(geometry.abduction * SIDE)
        self.lowest, self.highest = map(_constant, geometry.joint_limits[2::3].T)
        # A leg's peak load in ``robot.stance_load``, times the duty factor, divided by kp.
        weight = GRAVITY * sum(geometry.masses.values())
        self.load = _constant(0.125 * np.pi * weight / robot.kp)

    def forward(self, phases: Tensor, grown: Tensor, command: Commands) -> Tensor:
        """Joint angles (12,) rad.

        Args:
            phases: (n, 4) foot phases at the times ``ahead``.
            grown: share of swing and foot travel applied so far in this gait, as
                ``PhaseClock.begun``; (1,), or a scalar 1 without a ramp.
            command: the commands in force.
        """
        if not self.follows:
            return self.nominal
        # One row of four feet, (1, 4), here and below.
        through = 2.0 * phases[-1:] - 1.0
        swing = through.clamp(0.0, 1.0)
        raised = grown * (command["swing_height"] - self.default_swing) * th.sin(_HALF_TURN * swing)
        x = self.x + command["stance_length"] * self.front
        y = self.y + command["stance_width"] * self.side
        z = self.z - command["body_height"] + raised
        if self.walks:
            lead = (through.abs() - 0.5) * (grown * command["duration"] / command["frequency"])
            pose = self._walk(x, y, z, lead, phases[1:2], command)
        else:
            pose = th.cat(self._angles(x, y, z))
        return pose.T.flatten()

    def _walk(
        self, x: Tensor, y: Tensor, z: Tensor, lead: Tensor, phases: Tensor, command: Commands
    ) -> Tensor:
        """Joint angles (3, 4) rad, as ``robot.walking_pose``.

        Args:
            x, y, z: (1, 4) m, feet relative to the trunk.
            lead: (1, 4) s by which the feet are ahead of their mid-stance positions.
            phases: (1, 4) foot phases in the middle of the control step.
            command: the commands in force.
        """
        turn = command["yaw_rate"]
        x, y = x + lead * (command["vx"] - turn * y), y + lead * (command["vy"] + turn * x)
        pitch, roll = command["pitch"], command["roll"]
        cos, sin = th.cos(pitch), th.sin(pitch)
        x, z = cos * x - sin * z, sin * x + cos * z
        cos, sin = th.cos(roll), th.sin(roll)
        y, z = cos * y + sin * z, cos * z - sin * y
        hip, thigh, calf = self._angles(x - self.hips_x, y - self.hips_y, z)
        # Joint deflection under the load on the feet: ``robot.load_torque`` divided by kp.
        load = (self.load / command["duration"]) * th.sin(_TURN * phases).clamp(min=0.0)
        bends = th.cat([thigh, thigh + calf])
        ahead, down = self.lengths * th.sin(bends), (self.lengths * th.cos(bends)).sum(0)
        x_thigh, x_calf = ahead.chunk(2)
        cos = th.cos(hip)
        rises = th.cat(
            [self.out * cos + down * th.sin(hip), (x_thigh + x_calf) * cos, x_calf * cos]
        )
        return th.cat([hip, thigh, calf]) - load * rises

    def _angles(self, x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Hip, thigh and calf angles in rad from feet in m relative to their hips.

        As ``robot.leg_angles``.
        """
        z = z.clamp(max=HIGHEST_FOOT)
        out, upper, lower = self.out, self.thigh, self.calf
        down = (y * y + z * z - out * out).clamp(min=0.0).sqrt()
        square = x * x + down * down
        bend = (square - (upper * upper + lower * lower)) / (2.0 * upper * lower)
        # ONNX Runtime has inverse trigonometric functions in float32 only, and no arctan2: the lean
        # of a calf that is longer than the thigh may exceed a right angle, its half does not.
        calf = (-th.acos(bend.clamp(-1.0, 1.0).float())).double()
        calf = calf.clamp(self.lowest, self.highest)
        along, across = upper + lower * th.cos(calf), lower * th.sin(calf)
        half = across / ((along * along + across * across).sqrt() + along)
        slopes = th.cat([(out * z + down * y) / (out * y - down * z), x / down, half])
        hip, back, half = th.atan(slopes.float()).double().chunk(3)
        return hip, -back - 2.0 * half, calf


class LowGraph(nn.Module):
    """One control step of the low policy (Sec. IV-A): sensors and commands to joint targets.

    Attributes:
        inputs, outputs: signals that ``forward`` takes and returns, in order.
    """

    def __init__(self, policy: Policy, config: LowLevelConfig) -> None:
        super().__init__()
        self.actor = ClippedActor(policy)
        self.correct = policy.correction
        robot = config.robot
        self.dt = _constant(config.physics.control_dt)
        self.pose = Pose(robot, config.physics.control_dt)
        self.nominal = _constant(nominal_pose(robot))
        self.row = Row(actor_layout(config.robot, config.gyro))
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
        # This map is affine, so its values at 0 and 1 determine it.
        zero = observed_command(np.zeros(NUM_COMMANDS))
        self.command_zero = _constant(zero)
        self.command_gain = _constant(observed_command(np.ones(NUM_COMMANDS)) - zero)
        # With four gaits, the gait index is an affine function of the three-value embedding.
        known = np.column_stack([np.ones(len(GAITS)), GAIT_TABLE])
        first, *gain = np.linalg.solve(known, np.arange(len(GAITS)) / (len(GAITS) - 1))
        self.gait_zero, self.gait_gain = _constant([first]), _constant(gain)
        asked = "commands to follow in this step"
        self.inputs = [
            *_BODY,
            *([_GYRO] if config.gyro else []),
            Signal("last_action", NUM_JOINTS, "1", "the last action", "joints", "action", 0.0),
            Signal(
                "action_before", NUM_JOINTS, "1", "the one before", "joints", "last_action", 0.0
            ),
            Signal("commands", NUM_COMMANDS, None, asked, "commands", source="high.commands"),
            Signal("clock", 1, "1", "share of the gait cycle, in [0, 1)", None, "next_clock", 0.0),
        ]
        if self.counted:
            first = tuple(default_command().tolist())
            form = (NUM_COMMANDS, None, "those of the previous step", "commands", "commands", first)
            self.inputs += [
                Signal("last_commands", *form),
                Signal(
                    "cycles", 1, "1", "gait cycles since this gait began", None, "next_cycles", 0.0
                ),
            ]
        self.outputs = [
            Signal("action", NUM_JOINTS, "1", "within its limits", "joints"),
            Signal("joint_targets", NUM_JOINTS, "rad", "for the joint control", "joints"),
            Signal("next_clock", 1, "1", "share of the gait cycle at the end of this step"),
        ]
        if self.counted:
            self.outputs += [
                Signal("next_cycles", 1, "1", "gait cycles since this gait began, after this step")
            ]

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
        if self.correct is not None:
            command = self.correct(command[None])[0]
        named = by_command(command)
        phases = foot_phases(clock + self.pose.ahead * named["frequency"], named)
        pose = self.pose(phases, grown, named)
        terms = x | {
            "joint_error": x["joint_angles"] - pose,
            "pose": pose - self.nominal,
            "joint_speed": x["joint_speeds"],
            "command": self.command_gain * command + self.command_zero,
            "clock": th.sin(_TURN * phases[:1].flatten()),
            "clock_cosine": th.cos(_TURN * phases[:1].flatten()),
            "gait": self.gait_zero + command[12:] @ self.gait_gain,
        }
        action = self.actor(self.row(terms)[None]).double()
        run = self.dt * named["frequency"]
        clock = clock + run
        targets = (pose + self.joint_scale * action).clamp(self.lowest, self.highest)
        step = (action, targets, clock - clock.floor())
        return (*step, cycles + run) if self.counted else step


def _high_inputs(config: HighLevelConfig, robot: RobotConfig, seconds: float) -> list[Signal]:
    """Inputs of a high policy in episodes of ``seconds`` s, except its state."""
    goal = (
        "ahead of and to the left of the origin of the URDF's root link, in the frame that turns "
        "by yaw alone"
    )
    clock = "the low policy's in its coming step"
    last = "those of the last decision"
    start = tuple(default_command().tolist())
    family = "1 for the terrain of the whole tile, from start to goal; 0 for the others"
    probes = (
        "ground at points of the frame that turns by yaw alone, above a plane "
        f"{robot.base_height:g} m under the origin of the URDF's root link; clipped at "
        f"{PROBE_RANGE:g} m"
    )
    before = "the goal at the last decision; 0 at the first"
    cues = {  # only if the policy observes them
        "family": Signal("family", len(SEMANTIC), "1", family, "families"),
        "probes": Signal("probes", NUM_PROBES, "m", probes, "probes"),
        "probe_age": Signal("probe_age", 1, "s", "since the probes were measured"),
        "closing_speed": Signal("last_goal", 2, "m", before, None, "goal", 0.0),
    }
    return [
        Signal("goal", 2, "m", goal),
        Signal("time_left", 1, "s", f"left of the episode's {seconds:g} s"),
        *_BODY,
        Signal("last_decision", NUM_ACTIONS, "1", "the last one", "decision", "decision", 0.0),
        Signal("last_commands", NUM_COMMANDS, None, last, "commands", "commands", start),
        Signal("clock", 1, "1", clock, start=0.0, source="low.next_clock"),
        *(cues[term.name] for term in high_layout(config) if term.name in cues),
    ]


class HighGraph(nn.Module):
    """One decision of the high policy (Sec. IV-B): goal, cues and sensors to the 15 commands.

    Attributes:
        inputs, outputs: signals that ``forward`` takes and returns, in order.
    """

    def __init__(self, policy: Policy, config: HighLevelConfig, low: LowLevelConfig) -> None:
        super().__init__()
        self.actor = ClippedActor(policy)
        self.remember = policy.remember
        self.row = Row(high_layout(config))
        decoder = CommandDecoder(config.commands, config.action_limit, config.gaits)
        self.low = _constant(decoder.low[:12])
        self.span = _constant(decoder.high[:12] - decoder.low[:12])
        self.embedding = _constant(GAIT_TABLE[decoder.gaits])
        self.limit = _constant(config.action_limit)
        self.nominal = _constant(nominal_pose(low.robot))
        step = config.decimation * low.physics.control_dt
        seconds = round(config.episode_seconds / step) * step
        self.seconds, self.step = _constant(seconds), _constant(step)
        self.ahead = _constant([1.0, 0.0])
        state = {"hidden": "state of the LSTM", "cell": "cell of the LSTM"}
        actions = "the policy's actions, clipped but not decoded"
        size = policy.state_size
        self.inputs = [
            *_high_inputs(config, low.robot, seconds),
            *(Signal(k, size, "1", what, None, f"next_{k}", 0.0) for k, what in state.items()),
        ]
        self.outputs = [
            Signal("decision", NUM_ACTIONS, "1", actions, "decision"),
            Signal("commands", NUM_COMMANDS, None, "for the low policy", "commands"),
            *(Signal(f"next_{k}", size, "1", what) for k, what in state.items()),
        ]

    def forward(self, *values: Tensor) -> tuple[Tensor, ...]:
        """``inputs`` -> ``outputs``."""
        x = _by_name(self.inputs, values)
        phases = _TURN * foot_phases(x["clock"], by_command(x["last_commands"]))
        goal = x["goal"]
        distance = (goal * goal).sum(0, keepdim=True).sqrt()
        direction = th.where(distance > 0.0, goal / distance, self.ahead)
        terms = x | {
            "goal": th.cat([GOAL_SCALE * distance, direction]),
            "time_left": x["time_left"] / self.seconds,
            "joint_error": x["joint_angles"] - self.nominal,
            "joint_speed": x["joint_speeds"],
            "last_action": self._normalise(x["last_decision"]),
            "clock": th.sin(phases),
            "clock_cosine": th.cos(phases),
        }
        if "probes" in x:
            terms["probes"] = x["probes"].clamp(-PROBE_RANGE, PROBE_RANGE)
        if "probe_age" in x:
            terms["probe_age"] = x["probe_age"] / self.step
        if "last_goal" in x:
            before = (x["last_goal"] * x["last_goal"]).sum(0, keepdim=True).sqrt()
            closing = (before - distance) / self.step
            terms["closing_speed"] = th.where(before > 0.0, closing, th.zeros_like(closing))
        state = (x["hidden"].float()[None], x["cell"].float()[None])
        latent, (hidden, cell) = self.remember(self.row(terms)[None], state)
        decision = self.actor(latent).double()
        return decision, self._decode(decision), hidden[0].double(), cell[0].double()

    def _normalise(self, decision: Tensor) -> Tensor:
        return decision.clamp(-self.limit, self.limit) / self.limit

    def _decode(self, decision: Tensor) -> Tensor:
        """Decode as ``CommandDecoder.decode``: (13,) -> (15,)."""
        x = self._normalise(decision)
        n = len(self.embedding)
        gait = (0.5 * n * (x[-1] + 1.0)).floor().clamp(0, n - 1).long()
        return th.cat([self.low + 0.5 * (x[:-1] + 1.0) * self.span, self.embedding[gait]])


def _by_name(signals: Sequence[Signal], values: Sequence[Tensor]) -> dict[str, Tensor]:
    return {s.name: value for s, value in zip(signals, values, strict=True)}
