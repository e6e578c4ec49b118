"""Logs of a deployed pair: the inputs and outputs of its graphs, step by step.

A log has one row per control step, starting with the first of an episode, and a final row with the
readings after the last step. It holds only what a real robot can record. ``tdgc.diagnose`` turns it
into a trace, without what only a simulator knows, and diagnoses that. A file is an ``.npz`` with
one array (rows, size) per value, or a ``.csv`` with one column per entry, such as ``gravity_0``.
docs/deploy.md lists the values.
"""

import csv
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tdgc.benchmark.trace import (
    COLUMNS,
    NO_TILE,
    Trace,
    action_columns,
    command_columns,
    probe_columns,
    probe_places,
    tilt,
)
from tdgc.deploy.controller import Controller
from tdgc.errors import InputError
from tdgc.files import atomic
from tdgc.sim.commands import INDEX
from tdgc.sim.robot import Array, wrap_angle
from tdgc.sim.terrain import file_label
from tdgc.tasks.rules import HORIZON

SENSED = ("gravity", "joint_angles", "joint_speeds", "goal")  # in every row
GIVEN = ("clock", "commands", "joint_targets")  # in every row but the last
# In rows in which ``high`` decided; empty (NaN) in the others.
DECIDED = ("family", "probes", "probe_age", "decision")
#: Sizes of the values that a log may omit if no graph takes them: angular velocity, and the heading
#: in rad in the map frame of the goal. With neither, velocity and yaw rate are unknown; a
#: heading from the gyro alone drifts.
OPTIONAL = {"gyro": 3, "yaw": 1}
# Ends of an episode that its log does not show; only a simulator's log ends in ``left_tile``.
UNSEEN = ("fell", "collided", "left_tile")
ENDS = ("reached", *UNSEEN, "timeout")
_SAME = 5e-3  # in the value's own unit: logs with four decimals differ by up to 3e-3, in leaps
# Share of a step: at 50 Hz the millisecond to which a program may round its time stamps.
_PUNCTUAL = 0.05
# Allowed error of gravity's length: training's errors, 0.02 in each entry, reach 0.035; those of
# Walk These Ways, 0.05, reach 0.087.
_LENGTH = 0.1
# rad allowed beyond a joint's limits: simulated joints with sensor errors reach 0.04; the calf of a
# standing robot is 2.4 beyond them with the wrong sign, and 83 in degrees.
_BEYOND = 1.0
# Allowed multiple of the joints' speed limit, chosen by hand: impacts may exceed it somewhat; in
# degrees, speeds are 57 times as large.
_OVER = 5.0
_TURN = 35.0  # rad/s: the usual range of gyros, 2000 degrees/s


class LogError(InputError):
    """A log that cannot be used; the message is one line."""


@dataclass(frozen=True, eq=False)
class Log:
    """A log of one episode.

    Attributes:
        name: its file name without the suffix.
        time: (n,) s since the start of the episode.
        values: name -> (n, size); NaN where there is no value.
        decisions: (k,) rows in which ``high`` decided.
    """

    name: str
    time: Array
    values: dict[str, Array]
    decisions: NDArray[np.intp]


def layout(controller: Controller) -> dict[str, int]:
    """Name and size of each value except ``time``."""
    tables = controller.low.table, controller.high.table
    sizes = {s["name"]: s["shape"][0] for t in tables for s in (*t["inputs"], *t["outputs"])}
    sizes |= OPTIONAL
    return {name: sizes[name] for name in (*SENSED, *OPTIONAL, *GIVEN, *DECIDED) if name in sizes}


class LogWriter:
    """Records the inputs and outputs of a controller in each of its steps."""

    def __init__(self, controller: Controller) -> None:
        self._controller, self._layout = controller, layout(controller)
        self._rows: list[dict[str, Array]] = []

    def add(self, readings: dict[str, Array]) -> None:
        """Record the step that the controller has just taken on ``readings``."""
        low, high = self._controller.low.values, self._controller.high.values
        made = {name: low[name] for name in GIVEN}
        if self._controller.decided:
            made |= {name: high[name] for name in DECIDED if name in high}
        self._note(readings, made, self._controller.count - 1)

    def end(self, readings: dict[str, Array]) -> None:
        """Record the ``readings`` after the last step."""
        self._note(readings, {}, self._controller.count)

    def _note(self, readings: dict[str, Array], made: dict[str, Array], step: int) -> None:
        row = {name: value for name, value in readings.items() if name not in DECIDED} | made
        # Copies, because a simulator may reuse its arrays.
        whole = {n: np.array(row.get(n, [np.nan] * k)) for n, k in self._layout.items()}
        self._rows.append(whole | {"time": np.array(step * self._controller.dt)})

    def save(self, path: Path) -> None:
        """Write all rows to an ``.npz`` file, atomically.

        Raises:
            OSError: the file cannot be written.
        """
        columns = {name: np.stack([row[name] for row in self._rows]) for name in self._rows[0]}
        for name in OPTIONAL:
            if np.isnan(columns[name]).all():  # never given
                del columns[name]
        # Pass an open file, because NumPy would append its suffix to a name.
        with atomic(path) as partial, open(partial, "wb") as file:
            np.savez_compressed(file, allow_pickle=False, **columns)


# ---------------------------------------------------------------------------- reading


def read(path: Path, controller: Controller) -> Log:
    """Read the log of a robot that ran the controller's folder.

    Raises:
        LogError: the file is missing or damaged, lacks values or rows, has values that are not
            numbers, does not begin at 0 s, is of a loop at another rate, has decisions where none
            are due, or has readings in another unit or convention than the interface's.
    """
    known = {"time", *layout(controller)}
    try:
        table = _read_csv(path, known) if path.suffix == ".csv" else _read_npz(path)
    except LogError:
        raise
    except Exception as error:  # numpy and zipfile raise all kinds of errors on damaged files
        raise LogError(f"{path}: missing, or neither an .npz nor a .csv of numbers") from error
    taken = [signal["name"] for signal in controller.low.table["inputs"]]
    left_out = [name for name in OPTIONAL if name not in table and name not in taken]
    sizes = {name: size for name, size in layout(controller).items() if name not in left_out}
    rows = table["time"].size if "time" in table else 0
    shapes = {name: (rows, size) for name, size in ({"time": 1} | sizes).items()}
    for name, shape in shapes.items():
        if name not in table:
            raise LogError(f"{path}: lacks '{name}'; it needs {', '.join(shapes)}")
        if table[name].shape != shape:
            raise LogError(f"{path}: '{name}' must be numbers {shape}, not {table[name].shape}")
        if table[name].dtype.kind not in "fiu":
            raise LogError(f"{path}: '{name}' must be numbers, not of type {table[name].dtype}")
    values = {name: table[name].astype(np.float64) for name in sizes}
    decisions = np.flatnonzero(np.isfinite(values["decision"]).all(axis=1))
    log = Log(path.stem, table["time"][:, 0].astype(np.float64), values, decisions)
    wrong = _mistimed(log.time, controller.dt) or _gap(log, controller) or _misread(log, controller)
    if wrong is not None:
        raise LogError(f"{path}: {wrong}")
    return log


def _read_npz(path: Path) -> dict[str, NDArray[Any]]:
    """Read values by name; those with a single entry may be of shape (rows,)."""
    with np.load(path) as file:
        return {name: x[:, None] if x.ndim == 1 else x for name, x in file.items()}


def _read_csv(path: Path, known: Collection[str]) -> dict[str, NDArray[Any]]:
    """Read the ``known`` values by name, entries in the order of their column numbers.

    An empty cell is NaN; empty lines are skipped.

    Raises:
        LogError: a column is duplicated, or a column number is skipped.
    """
    with open(path, newline="", encoding="utf-8-sig") as file:
        header, *lines = filter(None, csv.reader(file))
    cells = np.array([[float(cell or "nan") for cell in line] for line in lines])
    cells = cells.reshape(len(lines), len(header))
    places: dict[str, dict[int, int]] = {}
    for place, column in enumerate(header):
        name, _, number = column.rpartition("_")
        if not (number.isascii() and number.isdigit()):
            name, number = column, "0"  # a value with a single entry, such as the time
        if name not in known:
            continue
        mine = places.setdefault(name, {})
        if int(number) in mine:
            raise LogError(f"{path}: the column '{column}' appears twice")
        mine[int(number)] = place
    table = {}
    for name, mine in places.items():
        missing = set(range(len(mine))) - mine.keys()
        if missing:
            raise LogError(f"{path}: no column '{name}_{min(missing)}', but '{name}_{max(mine)}'")
        table[name] = cells[:, [mine[k] for k in range(len(mine))]]
    return table


def _mistimed(time: Array, dt: float) -> str | None:
    """Describe what is wrong with the time stamps of rows ``dt`` s apart; None if nothing is.

    A row that is late by less than a step is accepted: the program was slow but left no row out.
    """
    if len(time) < 2 or not np.isfinite(time).all():
        return "needs two rows at least, each with its time"
    if abs(time[0]) > 0.5 * dt:
        return f"begins at {time[0]:.2f} s, not at 0 s, where an episode starts"
    later = np.diff(time)
    usual = np.median(later)
    if abs(usual - dt) > _PUNCTUAL * dt:
        return (
            f"its rows are {usual:.3g} s apart (median), not {dt:g} s: the graphs must run at "
            f"{1.0 / dt:g} Hz"
        )
    for k in np.flatnonzero((later <= 0.0) | (later > (2.0 - _PUNCTUAL) * dt)):
        return (
            f"a gap at {time[k]:.2f} s, where the next row is {later[k]:.3f} s later and not "
            f"{dt:g} s: log every control step"
        )
    return None


def _gap(log: Log, controller: Controller) -> str | None:
    """Describe a value or decision that is missing, or a decision too many; None if none is."""
    time, dt, steps = log.time, controller.dt, np.arange(len(log.time))
    for names, rows in (
        ((*SENSED, *OPTIONAL), steps),
        (GIVEN, steps[:-1]),
        (DECIDED, log.decisions),
    ):
        for name in (name for name in names if name in log.values):
            empty = rows[~np.isfinite(log.values[name][rows]).all(axis=1)]
            if empty.size:
                return (
                    f"a gap at {time[empty[0]]:.2f} s: no {name}; where none has arrived, log the "
                    "one that the graphs were given"
                )
    if not log.decisions.size:
        return "has no decision"
    task, due = controller.high.table["task"], _due(log, controller)
    for k in np.setxor1d(due, log.decisions):
        wrong = "no decision" if k in due else "a decision where none is due"
        return (
            f"a gap at {time[k]:.2f} s: {wrong}; decisions are due every "
            f"{controller.decimation * dt:g} s before the last row, until "
            f"{task['after_goal']['keep_deciding']['value']:g} s after the goal is reached, for "
            f"{task['horizon']['value']:g} s at most"
        )
    return None


def _misread(log: Log, controller: Controller) -> str | None:
    """Describe a reading in another unit or convention than the interface's; None if none is."""
    low, high, time = controller.low.table, controller.high.table, log.time
    gravity, level = log.values["gravity"], low["frames"]["gravity_when_level"]["value"]
    lengths = np.linalg.norm(gravity, axis=1)
    for k in np.flatnonzero(np.abs(lengths - 1.0) > _LENGTH):
        return f"'gravity' at {time[k]:.2f} s is {lengths[k]:.3g} long; it must be a unit vector"
    if gravity[0] @ level < np.sqrt(0.5):  # steeper than 45 degrees, no robot stands at its start
        return (
            f"'gravity' is {gravity[0].round(2).tolist()} in the first row; upright it must be "
            f"about {level}, frames.gravity_when_level"
        )
    angles, limits = log.values["joint_angles"], low["joint_control"]["joint_limits"]
    ends = np.array([limits["low"], limits["high"]])
    for k, j in np.argwhere((angles < ends[0] - _BEYOND) | (angles > ends[1] + _BEYOND)):
        return (
            f"'joint_angles' at {time[k]:.2f} s has {angles[k, j]:.3g} for {low['joints'][j]}, "
            f"which turns from {ends[0, j]:g} to {ends[1, j]:g} rad; it must be in rad, along "
            "joint_control.axes"
        )
    limit = _OVER * max(low["joint_control"]["speed_limit"]["value"])
    speeds = {"joint_speeds": (log.values["joint_speeds"], limit, "rad/s")}
    if "gyro" in log.values:
        speeds["gyro"] = log.values["gyro"], _TURN, "rad/s"
    if "yaw" in log.values:
        turned = wrap_angle(np.diff(log.values["yaw"], axis=0))
        speeds["yaw"] = turned / controller.dt, _TURN, "rad"
    for name, (speed, limit, unit) in speeds.items():
        for k, j in np.argwhere(np.abs(speed) > limit):
            return (
                f"'{name}' at {time[k]:.2f} s means {abs(speed[k, j]):.3g} rad/s, more than any "
                f"robot's {limit:g}; it must be in {unit}"
            )
    for k in log.decisions if "family" in log.values else ():
        told, families = log.values["family"][k], high["families"]
        if np.abs(told - np.eye(len(families))[told.argmax()]).max() > _SAME:
            return (
                f"'family' at {time[k]:.2f} s is {told.tolist()}; it must be 1 for one of "
                f"{', '.join(families)} and 0 for the others"
            )
    return None


def _due(log: Log, controller: Controller) -> NDArray[np.intp]:
    """Rows in which ``high`` decides."""
    radius = controller.high.table["task"]["goal_radius"]["value"]
    near = np.linalg.norm(log.values["goal"], axis=1) < radius
    reached_at = int(near.argmax()) if near.any() else None
    rows = range(0, len(log.time) - 1, controller.decimation)
    return np.array([k for k in rows if not controller.over(k, reached_at)], dtype=np.intp)


def replay(log: Log, controller: Controller) -> dict[str, tuple[float, float]]:
    """Replay the readings of a log through the graphs, beginning with the clock of its first row.

    Returns:
        For ``decision`` and each value in ``GIVEN``, by name: the largest difference between the
        log and the graphs, in the value's own unit, and the time in s at which a difference first
        exceeds rounding, infinite if none does. From that time on, a value was not passed from step
        to step as the interface specifies, the log holds another value than was used, or the robot
        ran other graphs.
    """
    controller.reset(float(log.values["clock"][0, 0]))
    found = dict.fromkeys(("decision", *GIVEN), (0.0, np.inf))
    for k, time in enumerate(log.time[:-1]):
        controller.step({name: x[k] for name, x in log.values.items() if name not in GIVEN})
        made = {name: controller.low.values[name] for name in GIVEN}
        if controller.decided:
            made["decision"] = controller.high.values["decision"]
        for name, value in made.items():
            off = value - log.values[name][k]
            if name == "clock":
                off -= np.round(off)  # whole cycles do not count
            largest, first = max(found[name][0], float(np.abs(off).max())), found[name][1]
            found[name] = largest, float(min(first, time if largest > _SAME else np.inf))
    return found


# ---------------------------------------------------------------------------- trace


def outcome(log: Log, controller: Controller, told: str | None = None) -> str:
    """How the episode of a log ended.

    ``told`` is the outcome that an observer gave, one of ``ENDS``. As in the benchmark, a robot
    that falls or collides at the goal has not reached it.

    Raises:
        LogError: the log does not show how the episode ended and ``told`` is None, or ``told`` is
            "reached" but the log never reaches the goal, or "timeout" but it does, or ends before
            the pair's horizon and the benchmark's.
    """
    if told in UNSEEN:
        return told
    goals, task = log.values["goal"], controller.high.table["task"]
    distance = np.linalg.norm(goals, axis=1)
    if distance.min() < task["goal_radius"]["value"]:
        if told == "timeout":
            raise LogError(f"{log.name}: reaches the goal, so it has not run out of time")
        return "reached"
    if told == "reached":
        raise LogError(f"{log.name}: comes no nearer to the goal than {distance.min():.2f} m")
    if controller.over(len(log.time) - 1, None):
        return "timeout"
    ends = f"{log.name}: ends at {log.time[-1]:.2f} s"
    if told == "timeout":
        if log.time[-1] > HORIZON - 0.5 * controller.dt:
            return "timeout"  # an episode of the benchmark ends before a pair of a longer horizon
        raise LogError(f"{ends}, before the horizon of {task['horizon']['value']:g} s")
    how = f"--outcome {' or '.join(UNSEEN[:2])}"
    raise LogError(f"{ends}, {distance[-1]:.2f} m from the goal; say how with {how}")


def trace(log: Log, controller: Controller, told: str | None = None) -> Trace:
    """The trace of a log, without what only a simulator knows.

    Velocity is computed from the heading and from the motion of the goal as seen from the robot.
    The trace ends one decision interval after the last decision; the standing at the goal that
    follows is left out.

    Args:
        log: log of one episode.
        controller: controller of the folder that the robot ran.
        told: how the episode ended, if the log does not show it.

    Raises:
        LogError: see ``outcome``; or the robot fell, collided or left its tile after its last
            decision had been carried out.
    """
    seen, begin = log.values, log.decisions
    end = np.minimum(begin + controller.decimation, len(log.time) - 1)
    if told in UNSEEN and end[-1] < len(log.time) - 1:
        raise LogError(
            f"{log.name}: no decision after {log.time[begin[-1]]:.2f} s led to what happened at "
            f"{log.time[-1]:.2f} s: it was no longer part of the episode"
        )
    rows = np.append(begin, end[-1])
    columns: dict[str, NDArray[Any]] = {
        c.name: np.full(len(rows), np.nan if c.unit else None, np.float32 if c.unit else object)
        for c in COLUMNS
    }
    families, places = np.array(["unknown"], object), ""
    decided = _decided(log, controller)
    if "family" in seen:
        families = np.array(controller.high.table["families"], object)
        families = families[seen["family"][begin].argmax(axis=1)]
        decided["family"] = families
    if "probes" in seen:
        places = probe_places(controller.high.table["probes"]["ahead_left"]["value"])
        decided |= probe_columns(seen["probes"][begin])
    for where, found in (
        (slice(None), _state(log, rows)),
        (slice(-1), decided),
        (slice(1, None), _execution(log, begin, end)),
    ):
        for name, values in found.items():
            columns[name][where] = values
    return Trace(
        "tdgc",
        file_label(log.name),
        "+".join(dict.fromkeys(families)),
        NO_TILE,
        0,
        NO_TILE,
        outcome(log, controller, told),
        columns,
        places,
    )


def _state(log: Log, rows: NDArray[np.intp]) -> dict[str, Array]:
    """Columns of the state in these ``rows`` (n,), (n,) each."""
    pitch, roll = tilt(log.values["gravity"][rows])
    ahead, left = log.values["goal"][rows].T
    return {
        "time": log.time[rows],
        "pitch": pitch,
        "roll": roll,
        "goal_distance": np.hypot(ahead, left),
        "goal_bearing": np.arctan2(left, ahead),
    }


def _decided(log: Log, controller: Controller) -> dict[str, NDArray[Any]]:
    """Columns of the actions and commands of each decision."""
    seen, begin = log.values, log.decisions
    command = seen["commands"][begin]
    # A gait may start faster than requested, so the frequency carried out is the clock's advance in
    # the first step of the decision. It is unknown (NaN) if that step was the last of the log.
    carried_out = command.copy()
    went = np.append(np.mod(np.diff(seen["clock"][:-1, 0]), 1.0), [np.nan] * 2)
    carried_out[:, INDEX["frequency"]] = went[begin] / controller.dt
    columns = command_columns(command, carried_out, controller.bounds)
    return action_columns(seen["decision"][begin]) | columns


def _execution(log: Log, begin: NDArray[np.intp], end: NDArray[np.intp]) -> dict[str, Array]:
    """Columns of how decisions were carried out, each from its row ``begin`` to its row ``end``."""
    seen, command = log.values, log.values["commands"][begin]
    columns = {"seconds": log.time[end] - log.time[begin]}
    for name, values in zip(("pitch", "roll"), tilt(seen["gravity"]), strict=True):
        mean = np.array([values[a + 1 : b + 1].mean() for a, b in zip(begin, end, strict=True)])
        columns[f"error_{name}"] = mean - command[:, INDEX[name]]
    yaw = _heading(log)
    if yaw is not None:
        turned = yaw[end] - yaw[begin]
        goal = seen["goal"][:, 0] + 1j * seen["goal"][:, 1]  # ahead + i left
        # How the goal moved relative to the robot, in the heading halfway through the turn.
        way = goal[begin] * np.exp(-0.5j * turned) - goal[end] * np.exp(0.5j * turned)
        for name, change in (("vx", way.real), ("vy", way.imag), ("yaw_rate", turned)):
            columns[f"error_{name}"] = change / columns["seconds"] - command[:, INDEX[name]]
    return columns


def _heading(log: Log) -> Array | None:
    """Heading at each row up to a constant, (n,) rad: measured, or else integrated from the gyro.

    None without either.
    """
    if "yaw" in log.values:
        return np.unwrap(log.values["yaw"][:, 0])
    if "gyro" not in log.values:
        return None
    rate = -np.sum(log.values["gravity"] * log.values["gyro"], axis=1)
    steps = 0.5 * (rate[1:] + rate[:-1]) * np.diff(log.time)
    return np.concatenate([[0.0], np.cumsum(steps)])
