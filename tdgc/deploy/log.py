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
from tdgc.sim.commands import INDEX
from tdgc.sim.robot import Array
from tdgc.sim.terrain import file_label

SENSED = ("gravity", "joint_angles", "joint_speeds", "goal")  # in every row
GIVEN = ("clock", "commands", "joint_targets")  # in every row but the last
# In rows in which ``high`` decided; empty (NaN) in the others.
DECIDED = ("family", "probes", "probe_age", "decision")
#: Sizes of the values that a log may omit if no graph takes them: angular velocity, and the heading
#: in rad in the map frame of the goal. With neither, velocity and yaw rate are unknown; a
#: heading from the gyro alone drifts.
OPTIONAL = {"gyro": 3, "yaw": 1}
ENDS = ("reached", "fell", "collided", "timeout")  # of an episode without a tile
_SAME = 5e-3  # in the value's own unit: logs with four decimals differ by up to 3e-3, in leaps


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
    """Records the inputs and outputs of a controller.

    Args:
        controller: the controller whose steps are logged.
    """

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
        """Write all rows to an ``.npz`` file.

        Raises:
            OSError: the file cannot be written.
        """
        columns = {name: np.stack([row[name] for row in self._rows]) for name in self._rows[0]}
        np.savez_compressed(path, allow_pickle=False, **columns)


# ---------------------------------------------------------------------------- reading


def read(path: Path, controller: Controller) -> Log:
    """Read the log of a robot that ran the controller's folder.

    Raises:
        LogError: the file is missing or damaged, lacks values or rows, has values that are not
            numbers, does not begin at 0 s, or has decisions where none are due.
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
    shapes: dict[str, tuple[int, ...]] = {"time": (rows,)}
    shapes |= {name: (rows, size) for name, size in sizes.items()}
    for name, shape in shapes.items():
        if name not in table:
            raise LogError(f"{path}: lacks '{name}'; it needs {', '.join(shapes)}")
        if table[name].shape != shape or table[name].dtype.kind not in "fiu":
            raise LogError(f"{path}: '{name}' must be numbers {shape}, not {table[name].shape}")
    values = {name: table[name].astype(np.float64) for name in sizes}
    decisions = np.flatnonzero(np.isfinite(values["decision"]).all(axis=1))
    log = Log(path.stem, table["time"].astype(np.float64), values, decisions)
    gap = _gap(log, controller)
    if gap is not None:
        raise LogError(f"{path}: {gap}")
    return log


def _read_npz(path: Path) -> dict[str, NDArray[Any]]:
    """Read values by name."""
    with np.load(path) as file:
        return dict(file)


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
    return table | {"time": table["time"][:, 0]} if "time" in table else table


def _gap(log: Log, controller: Controller) -> str | None:
    """Describe a gap in a log; None if there is none."""
    time, dt = log.time, controller.dt
    if len(time) < 2 or not np.isfinite(time).all():
        return "needs two rows at least, each with its time"
    if abs(time[0]) > 0.5 * dt:
        return f"begins at {time[0]:.2f} s, not at 0 s, where an episode starts"
    for k in np.flatnonzero(np.abs(np.diff(time) - dt) > 0.5 * dt):
        step = time[k + 1] - time[k]
        return (
            f"a gap at {time[k]:.2f} s, where the next row is {step:.3f} s later and not {dt:g} s"
        )
    steps = np.arange(len(time))
    for names, rows in (
        ((*SENSED, *OPTIONAL), steps),
        (GIVEN, steps[:-1]),
        (DECIDED, log.decisions),
    ):
        for name in (name for name in names if name in log.values):
            empty = rows[~np.isfinite(log.values[name][rows]).all(axis=1)]
            if empty.size:
                return f"a gap at {time[empty[0]]:.2f} s: no {name}"
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

    ``told`` is the outcome that an observer gave, one of ``ENDS``; it is overridden if the log
    reaches the goal.

    Raises:
        LogError: the log does not show how the episode ended and ``told`` is None, or ``told`` is
            "reached" but the log never reaches the goal.
    """
    goals, task = log.values["goal"], controller.high.table["task"]
    distance = np.linalg.norm(goals, axis=1)
    if distance.min() < task["goal_radius"]["value"]:
        return "reached"
    if told == "reached":
        raise LogError(f"{log.name}: comes no nearer to the goal than {distance.min():.2f} m")
    if told is not None:
        return told
    if log.time[-1] > task["horizon"]["value"] - 0.5 * controller.dt:
        return "timeout"
    raise LogError(
        f"{log.name}: ends at {log.time[-1]:.2f} s, {distance[-1]:.2f} m from the goal; say how "
        f"with --outcome {' or '.join(ENDS[1:3])}"
    )


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
        LogError: see ``outcome``.
    """
    seen, begin = log.values, log.decisions
    end = np.minimum(begin + controller.decimation, len(log.time) - 1)
    rows = np.append(begin, end[-1])
    columns: dict[str, NDArray[Any]] = {
        c.name: np.full(len(rows), np.nan if c.unit else None, np.float32 if c.unit else object)
        for c in COLUMNS
    }

    def fill(where: slice, found: dict[str, Any]) -> None:
        for name, values in found.items():
            columns[name][where] = values

    pitch, roll = tilt(seen["gravity"])
    ahead, left = seen["goal"][rows].T
    fill(
        slice(None),
        {
            "time": log.time[rows],
            "pitch": pitch[rows],
            "roll": roll[rows],
            "goal_distance": np.hypot(ahead, left),
            "goal_bearing": np.arctan2(left, ahead),
        },
    )
    command = seen["commands"][begin]
    fill(slice(-1), action_columns(seen["decision"][begin]))
    # A gait may start faster than requested, so the frequency carried out is the clock's advance in
    # the first step of the decision. It is unknown (NaN) if that step was the last of the log.
    carried_out = command.copy()
    went = np.append(np.mod(np.diff(seen["clock"][:-1, 0]), 1.0), [np.nan] * 2)
    carried_out[:, INDEX["frequency"]] = went[begin] / controller.dt
    fill(slice(-1), command_columns(command, carried_out, controller.bounds))
    told_families = ["unknown"]
    if "family" in seen:
        families = controller.high.table["families"]
        told_families = [families[i] for i in seen["family"][begin].argmax(axis=1)]
        fill(slice(-1), {"family": told_families})
    places = ""
    if "probes" in seen:
        places = probe_places(controller.high.table["probes"]["ahead_left"]["value"])
        fill(slice(-1), probe_columns(seen["probes"][begin]))
    seconds = log.time[end] - log.time[begin]
    errors = {
        f"error_{name}": [values[a + 1 : b + 1].mean() for a, b in zip(begin, end, strict=True)]
        - command[:, INDEX[name]]
        for name, values in (("pitch", pitch), ("roll", roll))
    }
    yaw = _heading(log)
    if yaw is not None:
        turned = yaw[end] - yaw[begin]
        goal = seen["goal"][:, 0] + 1j * seen["goal"][:, 1]  # ahead + i left
        # How the goal moved relative to the robot, in the heading halfway through the turn.
        way = goal[begin] * np.exp(-0.5j * turned) - goal[end] * np.exp(0.5j * turned)
        for name, change in (("vx", way.real), ("vy", way.imag), ("yaw_rate", turned)):
            errors[f"error_{name}"] = change / seconds - command[:, INDEX[name]]
    fill(slice(1, None), {"seconds": seconds} | errors)
    return Trace(
        "tdgc",
        file_label(log.name),
        "+".join(dict.fromkeys(told_families)),
        NO_TILE,
        0,
        NO_TILE,
        outcome(log, controller, told),
        columns,
        places,
    )


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
