"""The exported pair, run as on a robot: from nothing but the folder that ``tdgc.export`` wrote.

The check after export runs it in Bullet and ``tdgc.mujoco`` in MuJoCo; a robot's own program must
do the same (docs/deploy.md).
"""

import contextlib
import logging
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from tdgc.config import CommandRanges, RobotConfig
from tdgc.deploy.interface import ExportError, Table, pair_misfits, read_interface
from tdgc.files import checksum
from tdgc.sim.geometry import read_geometry
from tdgc.sim.robot import NUM_JOINTS, Array, RobotState, nominal_height, nominal_pose
from tdgc.sim.urdf import JOINTS

#: Graph formats and their file suffixes.
FORMATS = {"onnx": ".onnx", "torchscript": ".pt"}
GRAPHS = ("low", "high")

Run = Callable[[list[Array]], list[Array]]


class Graph:
    """A graph and its interface file, run as a robot would run it; ONNX Runtime uses one thread.

    Args:
        folder: folder that ``tdgc.export`` wrote.
        name: "low" or "high".
        form: one of ``FORMATS``.

    Raises:
        ExportError: the interface or the graph cannot be used, or they do not match.
        ConfigError: the interface file is missing or not JSON.

    Attributes:
        table: contents of the interface file.
        memory: values for the inputs that are carried over from the previous step, by name.
        sources: outputs of the other graph, as "graph.name", by the inputs that take them.
        values: all inputs and outputs of the last step, by name.
        seconds: CPU time of the last step, which is its latency on a dedicated core.
    """

    def __init__(self, folder: Path, name: str, form: str) -> None:
        self._name, self.table = name, read_interface(folder, name)
        inputs = self.table["inputs"]
        self._inputs = [s["name"] for s in inputs]
        self._outputs = [s["name"] for s in self.table["outputs"]]
        self._kept = {s["name"]: s["previous"] for s in inputs if s["previous"] is not None}
        self.sources = {s["name"]: s["source"] for s in inputs if s["source"] is not None}
        self._start = {s["name"]: _start(s) for s in inputs if s["start"] is not None}
        self._run = _RUNTIMES[form](graph_file(folder, self.table, form), self.table)
        self.reset()

    def reset(self) -> None:
        """Begin a new episode."""
        self.memory, self.values, self.seconds = dict(self._start), dict[str, Array](), 0.0

    def check(self, readings: dict[str, Array], only: str | None = None) -> None:
        """Check that the readings which the graph takes are there, of the right shape and finite.

        Args:
            readings: values by input name.
            only: name of the reading to check; None for all.

        Raises:
            ExportError: a reading fails; with it, ``memory`` would be wrong from then on.
        """
        for signal in self.table["inputs"]:
            name, shape = signal["name"], tuple(signal["shape"])
            if only not in (None, name):
                continue
            if name not in readings:
                if name in self.memory or signal["source"] is not None:
                    continue
                raise ExportError(f"{self._name}: the reading '{name}' is missing")
            if np.shape(readings[name]) != shape:
                raise ExportError(
                    f"'{name}' must have the shape {shape}, not {np.shape(readings[name])}"
                )
            if not np.isfinite(readings[name]).all():
                raise ExportError(f"'{name}' is not finite; give the last good reading instead")

    def __call__(self, values: dict[str, Array]) -> dict[str, Array]:
        """Run one step, inputs by name -> outputs by name; ignore other entries of ``values``.

        Inputs that are not given are taken from ``memory``.

        Raises:
            ExportError: an input is neither given nor in ``memory``.
        """
        known = self.memory | values
        try:
            # Copies, because a robot's program may reuse its arrays, and some are remembered.
            inputs = [np.array(known[name], dtype=np.float64) for name in self._inputs]
        except KeyError as error:
            raise ExportError(f"{self._name}: nothing gives its input {error}") from error
        started = time.thread_time()
        outputs = self._run(inputs)
        self.seconds = time.thread_time() - started
        made = dict(zip(self._outputs, outputs, strict=True))
        self.values = dict(zip(self._inputs, inputs, strict=True)) | made
        self.memory |= {name: self.values[source] for name, source in self._kept.items()}
        return made


def graph_file(folder: Path, table: Table, form: str) -> Path:
    """Path of a graph's file, after checking that its interface file was written with it.

    Raises:
        ExportError: the graph was not exported in this format, or the file is missing, cannot be
            read or has another checksum.
    """
    files = table["files"]
    if form not in files:
        raise ExportError(
            f"{folder}: its {table['graph']} policy was exported as {', '.join(files)}, not {form}"
        )
    path = folder / files[form]["file"]
    try:
        same = checksum(path) == files[form]["sha256"]
    except OSError as error:
        raise ExportError(f"{path}: {error.strerror}") from error
    if not same:
        raise ExportError(
            f"{path}: not the graph that {table['graph']}_interface.json was written with; export "
            "the policies again"
        )
    return path


def _start(signal: Table) -> Array:
    """Value of an input in the first step of an episode."""
    return np.broadcast_to(np.array(signal["start"], dtype=np.float64), signal["shape"]).copy()


def _open_onnx(path: Path, table: Table) -> Run:
    import onnxruntime  # type: ignore[import-untyped]

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    try:
        session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # its exceptions share no base class of their own
        raise ExportError(f"{path}: no ONNX graph") from error
    # The session is bound to these arrays, since naming and wrapping new ones takes a sixth of a
    # step.
    binding = session.io_binding()
    given: list[Array] = []
    made: list[Array] = []
    for side, found, arrays, bind in (
        ("inputs", session.get_inputs(), given, binding.bind_ortvalue_input),
        ("outputs", session.get_outputs(), made, binding.bind_ortvalue_output),
    ):
        if [(s["name"], s["shape"]) for s in table[side]] != [(x.name, x.shape) for x in found]:
            raise ExportError(f"{path}: its {side} are not those of its interface file")
        for signal in table[side]:
            arrays.append(np.zeros(signal["shape"]))
            bind(signal["name"], onnxruntime.OrtValue.ortvalue_from_numpy(arrays[-1]))

    def run(values: list[Array]) -> list[Array]:
        for array, value in zip(given, values, strict=True):
            if value.shape != array.shape:
                raise ValueError(f"an input must have the shape {array.shape}, not {value.shape}")
            array[...] = value
        session.run_with_iobinding(binding)
        return [array.copy() for array in made]

    return run


def _open_torchscript(path: Path, table: Table) -> Run:
    import torch as th

    try:
        with quiet():
            module = th.jit.load(path)  # type: ignore[no-untyped-call]
    except (RuntimeError, ValueError, OSError) as error:
        raise ExportError(f"{path}: no TorchScript graph") from error

    def run(values: list[Array]) -> list[Array]:
        with th.inference_mode():
            return [out.numpy() for out in module(*map(th.from_numpy, values))]

    return run


_RUNTIMES = {"onnx": _open_onnx, "torchscript": _open_torchscript}


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Suppress warnings of exporters and loaders, about deprecations or torchvision operators."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        logging.disable(logging.WARNING)
        try:
            yield
        finally:
            logging.disable(logging.NOTSET)


# ---------------------------------------------------------------------------------------------
# Both graphs together


class Controller:
    """Both graphs of a folder, run as the interface specifies: ``high`` first, if it is due.

    Args:
        folder: folder that ``tdgc.export`` wrote.
        form: one of ``FORMATS``.

    Raises:
        ExportError: the folder cannot be used.
        ConfigError: an interface file is missing or not JSON.

    Attributes:
        low, high: the graphs; ``table`` of each holds its interface file.
        dt: length of a control step, s.
        decimation: control steps per decision.
        horizon: control steps per episode.
        bounds: bounds of the continuous commands.
        count: control steps since ``reset``.
        commands: (15,) in force in the last step.
        decided: whether ``high`` ran in the last step.
        seconds: CPU time spent in the graphs in the last step.
    """

    def __init__(self, folder: Path, form: str = "onnx") -> None:
        self._folder = folder
        self._graphs = {name: Graph(folder, name, form) for name in GRAPHS}
        self.low, self.high = self._graphs["low"], self._graphs["high"]
        low, high = self.low.table, self.high.table
        for misfit in pair_misfits(low, high):
            raise ExportError(
                f"low and high in '{folder}' come from two exports: {misfit}; export the pair again"
            )
        self._task, self._probes = high["task"], high["probes"]
        self._stand = np.array(self._task["stand"]["value"])
        self._places = np.array(self._probes["ahead_left"]["value"])
        self._level = np.array(low["frames"]["gravity_when_level"]["value"])
        self.dt = 1.0 / low["rate"]["value"]
        self.decimation = high["order"][0]["every"]  # its schema has ``high`` first
        self.horizon = round(self._task["horizon"]["value"] / self.dt)
        ranges = {c["name"]: (c["low"], c["high"]) for c in high["commands"] if "low" in c}
        self.bounds = CommandRanges(**ranges)
        self.reset()

    def reset(self, clock: float | None = None) -> None:
        """Begin a new episode, with the gait clock at ``clock`` or as the interface specifies."""
        for graph in self._graphs.values():
            graph.reset()
            if clock is not None:
                graph.memory["clock"] = np.array([clock])
        self.count, self.commands, self.decided, self.seconds = 0, self._stand, False, 0.0
        self._reached_at: int | None = None
        self._latest: dict[str, Array] = {}  # outputs of both graphs, as "graph.name"

    def sense(
        self, state: RobotState, goal: Array, family: str, ground: Callable[[Array, Array], Array]
    ) -> dict[str, Array]:
        """Sensor and map readings of a simulated robot: graph inputs by name, and ``yaw``.

        No graph takes the heading ``yaw``; it is there for logs.

        Args:
            state: state of one robot.
            goal: (2,) m in the world.
            family: terrain family of the tile; one that the interface does not list is replaced by
                the interface's ``otherwise``.
            ground: ground heights in m at points (x, y) in the world; off the map, the height at
                the nearest border.
        """
        rotation, position, yaw = state.rotation[0], state.position[0], float(state.yaw[0])
        ahead, left = np.cos(yaw), np.sin(yaw)
        heading = np.array([[ahead, left], [-left, ahead]])  # world -> heading frame
        points = position[:2] + self._places @ heading
        plane = position[2] - self._probes["plane_below_trunk"]["value"]
        families = self.high.table["families"]
        told = family if family in families else self._task["family"]["otherwise"]
        return {
            "gravity": rotation.T @ self._level,
            "joint_angles": state.q[0],
            "joint_speeds": state.qd[0],
            "gyro": rotation.T @ state.ang_vel[0],
            "yaw": state.yaw.copy(),
            "goal": heading @ (goal - position[:2]),
            "family": np.eye(len(families))[families.index(told)],
            "probes": ground(points[:, 0], points[:, 1]) - plane,
            "probe_age": np.zeros(1),
        }

    def over(self, step: int, reached_at: int | None) -> bool:
        """Whether ``high`` has stopped by ``step``: at the horizon, or ``keep_deciding`` seconds
        after the goal was reached in step ``reached_at``; None if it has not been reached."""
        keep = round(self._task["after_goal"]["keep_deciding"]["value"] / self.dt)
        held = reached_at is not None and step - reached_at >= keep
        return step >= self.horizon or held

    def step(self, readings: dict[str, Array]) -> Array:
        """Run one control step: readings by name, as from ``sense`` -> joint targets, (12,) rad.

        Once ``high`` has stopped (``over``), ``low`` gets the interface's commands ``stand``.

        Raises:
            ExportError: a reading is missing, has the wrong shape or is not finite. The graphs
                have not run, and remember nothing.
        """
        task, elapsed = self._task, self.count * self.dt
        readings = readings | {"time_left": np.array([task["horizon"]["value"] - elapsed])}
        self.high.check(readings, "goal")  # also where ``high`` is not due
        reached_at, near = self._reached_at, task["goal_radius"]["value"]
        if reached_at is None and np.linalg.norm(readings["goal"]) < near:
            reached_at = self.count
        over = self.over(self.count, reached_at)
        decides = self.count % self.decimation == 0 and not over
        due = ("high", "low") if decides else ("low",)
        for name in due:
            self._graphs[name].check(readings)
        self._reached_at, self.decided, self.seconds = reached_at, False, 0.0
        for name in due:
            graph = self._graphs[name]
            taken = {
                name: self._latest[source]
                for name, source in graph.sources.items()
                if source in self._latest
            }
            if name == "low" and over:
                taken["commands"] = self._stand
            for signal, value in graph(readings | taken).items():
                self._latest[f"{name}.{signal}"] = value
            self.seconds += graph.seconds
        self.decided, self.commands = decides, self.low.values["commands"]
        self.count += 1
        return self.low.values["joint_targets"]

    def robot(self) -> RobotConfig:
        """The robot that the interface describes, as a configuration for this package's simulation.

        Raises:
            ConfigError: this package cannot read the URDF.
            ExportError: the URDF is of another robot, or joint settings differ from leg to leg.
        """
        table = self.low.table
        file = table["robot"]["urdf"]["file"]
        urdf = self._folder / file
        control, pose = table["joint_control"], table["start"]["joint_angles"]["value"]
        hip, thigh, calf = pose[:3]
        limits = [tuple(control[k]["value"][:3]) for k in ("torque_limit", "speed_limit")]
        config = RobotConfig(
            urdf=str(urdf.absolute()),
            kp=control["kp"]["value"][0],
            kd=control["kd"]["value"][0],
            torque_limit=limits[0],
            speed_limit=limits[1],
            nominal_hip=hip,
            nominal_thigh=(thigh, pose[7]),
            nominal_calf=calf,
            base_height=table["robot"]["standing_height"]["value"],
            stance=(table["robot"]["stance"]["length"], table["robot"]["stance"]["width"]),
            joint_margin=control["target_margin"]["value"],
        )
        for what, told, taken in (
            ("kp", control["kp"]["value"], [config.kp] * NUM_JOINTS),
            ("kd", control["kd"]["value"], [config.kd] * NUM_JOINTS),
            ("torque_limit", control["torque_limit"]["value"], config.torque_limit * 4),
            ("speed_limit", control["speed_limit"]["value"], config.speed_limit * 4),
            ("the start pose", pose, nominal_pose(config)),
        ):
            if not np.array_equal(told, taken):
                raise ExportError(f"{what} differs from leg to leg: {told}, not {list(taken)}")
        for difference in self._differences(config):
            raise ExportError(
                f"{urdf}: not the exported robot's URDF, {file}: {difference}; use that one, or "
                "export the pair again"
            )
        return config

    def _differences(self, config: RobotConfig) -> Iterator[str]:
        """Describe how the robot of ``config`` differs from the exported one."""
        geometry, table = read_geometry(config), self.low.table
        limits = table["joint_control"]["joint_limits"]
        told = np.column_stack([limits["low"], limits["high"]])
        for joint, mine, wanted in zip(JOINTS, geometry.joint_limits, told, strict=True):
            if not np.array_equal(mine, wanted):
                ends = [f"from {low:g} to {high:g} rad" for low, high in (mine, wanted)]
                yield f"{joint} turns {ends[0]}, that robot's {ends[1]}"
        masses = table["robot"]["link_masses"]["value"]
        for link in (*masses, *geometry.masses):
            mine, wanted = geometry.masses.get(link, 0.0), masses.get(link, 0.0)
            if mine != wanted:
                yield f"link {link} has {mine:g} kg, that robot's {wanted:g}"
        height, wanted = nominal_height(config, geometry), table["start"]["trunk_height"]["value"]
        if not np.isclose(height, wanted, rtol=0.0, atol=1e-9):
            yield f"starts {height:g} m high, that robot {wanted:g}"
        if checksum(Path(config.urdf)) != table["robot"]["urdf"]["sha256"]:
            yield "joint limits and masses agree, its checksum does not"
