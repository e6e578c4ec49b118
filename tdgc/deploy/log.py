"""Logs of a deployed pair: what went into its graphs and what came out, step by step.

A log has a row per control step, from the first of an episode on, and a last row with what was
sensed after the last step. It is what a real robot can write down. A trace can be made of it,
without what only a simulator knows, and diagnosed: ``tdgc.diagnose``. A file is ``.npz``, with an
array (rows, size) per value, or ``.csv``, with a column per entry, ``gravity_0``. docs/deploy.md
lists the values.
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
# Where ``high`` decided, and empty (NaN) in other rows.
DECIDED = ("family", "probes", "probe_age", "decision")
#: What a log may lack if no graph takes it: angular velocity, and the heading in rad on the map
#: that has the goal. Without both, velocity and yaw rate are not known; the gyro alone drifts.
OPTIONAL = {"gyro": 3, "yaw": 1}
ENDS = ("reached", "fell", "collided", "timeout")  # of an episode on no tile
_SAME = 1e-3  # rad: targets written with four digits are not off by as much


class LogError(InputError):
    """A log that cannot be used; the message is one line."""


@dataclass(frozen=True, eq=False)
class Log:
    """A log of one episode.

    Attributes:
        name: of its file, without suffix.
        time: (n,) s since the start of the episode.
        values: name -> (n, size); NaN where there is none.
        decisions: (k,) rows in which ``high`` decided.
    """

    name: str
    time: Array
    values: dict[str, Array]
    decisions: NDArray[np.intp]


def layout(controller: Controller) -> dict[str, int]:
    """Name and size of each value beside ``time``."""
    tables = controller.low.table, controller.high.table
    sizes = {s["name"]: s["shape"][0] for t in tables for s in (*t["inputs"], *t["outputs"])}
    sizes |= OPTIONAL
    return {name: sizes[name] for name in (*SENSED, *OPTIONAL, *GIVEN, *DECIDED) if name in sizes}


class LogWriter:
    """Writes down what a controller is fed and gives.

    Args:
        controller: whose steps they are.
    """

    def __init__(self, controller: Controller) -> None:
        self._controller, self._layout = controller, layout(controller)
        self._rows: list[dict[str, Array]] = []

    def add(self, readings: dict[str, Array]) -> None:
        """Note the step that the controller just took on ``readings``."""
        low, high = self._controller.low.values, self._controller.high.values
        row = readings | {name: low[name] for name in GIVEN}
        if self._controller.decided:
            row["decision"] = high["decision"]
        else:
            row = {name: value for name, value in row.items() if name not in DECIDED}
        self._note(row, self._controller.count - 1)

    def end(self, readings: dict[str, Array]) -> None:
        """Note ``readings`` after the last step."""
        self._note(readings, self._controller.count)

    def _note(self, row: dict[str, Array], step: int) -> None:
        # Copies: a simulator may go on in the same arrays.
        whole = {n: np.array(row.get(n, [np.nan] * k)) for n, k in self._layout.items()}
        self._rows.append(whole | {"time": np.array(step * self._controller.dt)})

    def save(self, path: Path) -> None:
        """Write all into an ``.npz``.

        Raises:
            OSError: it cannot be written.
        """
        columns = {name: np.stack([row[name] for row in self._rows]) for name in self._rows[0]}
        np.savez_compressed(path, allow_pickle=False, **columns)


# ---------------------------------------------------------------------------- reading


def read(path: Path, controller: Controller) -> Log:
    """The log in a file, of a robot that the controller's folder was on.

    Raises:
        LogError: no such file, one that is damaged or lacks values or rows, or values that are no
            numbers.
    """
    known = {"time", *layout(controller)}
    try:
        table = _read_csv(path, known) if path.suffix == ".csv" else _read_npz(path)
    except LogError:
        raise
    except Exception as error:  # numpy and zipfile raise all kinds of them on damaged files
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
    """Values by name."""
    with np.load(path) as file:
        return dict(file)


def _read_csv(path: Path, known: Collection[str]) -> dict[str, NDArray[Any]]:
    """Values by name, of those ``known``, in the order of the numbers in the columns' names; an
    empty cell is NaN.

    Raises:
        LogError: the same column twice, or none for a number.
    """
    with open(path, newline="", encoding="utf-8") as file:
        header, *lines = csv.reader(file)
    cells = np.array([[float(cell or "nan") for cell in line] for line in lines])
    cells = cells.reshape(len(lines), len(header))
    places: dict[str, dict[int, int]] = {}
    for place, column in enumerate(header):
        name, _, number = column.rpartition("_")
        if not (number.isascii() and number.isdigit()):
            name, number = column, "0"  # of a single value, as the time is
        if name not in known:
            continue
        mine = places.setdefault(name, {})
        if int(number) in mine:
            raise LogError(f"{path}: the column '{column}' stands twice")
        mine[int(number)] = place
    table = {}
    for name, mine in places.items():
        missing = set(range(len(mine))) - mine.keys()
        if missing:
            raise LogError(f"{path}: no column '{name}_{min(missing)}', but '{name}_{max(mine)}'")
        table[name] = cells[:, [mine[k] for k in range(len(mine))]]
    return table | {"time": table["time"][:, 0]} if "time" in table else table


def _gap(log: Log, controller: Controller) -> str | None:
    """What a log lacks first, if anything."""
    time, dt, every = log.time, controller.dt, controller.decimation
    if len(time) < 2 or not np.isfinite(time).all():
        return "needs two rows at least, each with its time"
    for k in np.flatnonzero(np.abs(np.diff(time) - dt) > 0.5 * dt):
        step = time[k + 1] - time[k]
        return (
            f"a gap at {time[k]:.2f} s, where the next row is {step:.3f} s later and not {dt:g} s"
        )
    due = np.arange(0, max(log.decisions, default=0) + 1, every)
    for k in np.setxor1d(due, log.decisions):
        wrong = "no decision" if k in due else "a decision between those"
        return f"a gap at {time[k]:.2f} s: {wrong} that are due every {every * dt:g} s"
    steps = np.arange(len(time))
    for names, rows in (
        ((*SENSED, *OPTIONAL), steps),
        (GIVEN, steps[:-1]),
        (DECIDED, log.decisions),
    ):
        for name in log.values.keys() & set(names):
            empty = rows[~np.isfinite(log.values[name][rows]).all(axis=1)]
            if empty.size:
                return f"a gap at {time[empty[0]]:.2f} s: no {name}"
    return None


def replay(log: Log, controller: Controller) -> tuple[float, float]:
    """Feed what a log says was sensed to the graphs.

    Returns:
        Largest difference in rad between the joint targets in the log and those of the graphs, and
        when in s it was first too large for rounding, infinite if never. There a value was not
        handed on from step to step as the interface says, or the graphs are other ones.
    """
    controller.reset(float(log.values["clock"][0, 0]))
    largest, first = 0.0, np.inf
    for k, time in enumerate(log.time[:-1]):
        readings = {name: values[k] for name, values in log.values.items() if name not in GIVEN}
        off = float(np.abs(controller.step(readings) - log.values["joint_targets"][k]).max())
        largest, first = max(largest, off), min(first, time if off > _SAME else np.inf)
    return largest, first


# ---------------------------------------------------------------------------- a trace


def outcome(log: Log, controller: Controller, told: str | None = None) -> str:
    """How the episode of a log ended; ``told`` by who was there, one of ``ENDS``.

    Raises:
        LogError: neither does the log say nor was it told, or both say something else.
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

    Velocity is how the goal moved as seen from the robot, whose heading is known. What follows the
    last decision by more than its interval, standing at the goal, is no part of the trace.

    Args:
        log: of one episode.
        controller: of the folder that was on the robot.
        told: how the episode ended, where the log does not say.

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
    # A gait may begin faster than asked: how far the clock went, which nobody knows (NaN) of a
    # decision whose first step was the last of all.
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
        # How the goal moved, in the heading of the middle.
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
    """Heading at each row, (n,) rad from anywhere on: measured, or else what the gyro adds up to;
    None without either."""
    if "yaw" in log.values:
        return np.unwrap(log.values["yaw"][:, 0])
    if "gyro" not in log.values:
        return None
    rate = -np.sum(log.values["gravity"] * log.values["gyro"], axis=1)
    steps = 0.5 * (rate[1:] + rate[:-1]) * np.diff(log.time)
    return np.concatenate([[0.0], np.cumsum(steps)])
