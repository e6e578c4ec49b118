"""Traces: what was decided, when, on which cues, and how it was carried out; one file per episode.

A trace is a table with one row per decision: the state of the robot, the cues, the action, the
commands it was decoded to, and how well the previous decision was carried out. A final row holds
the end of the episode and no decision. ``COLUMNS`` defines all columns; docs/trace.md lists them.

Files are Parquet with scalar columns only, so any table tool can read them. Their metadata give
the unit and meaning of each column and identify the episode. They need pyarrow, the extra
``trace``.
"""

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from tdgc.benchmark.drivers import Driver
from tdgc.benchmark.evaluation import Batch, EpisodeRecord
from tdgc.config import CommandRanges
from tdgc.errors import InputError, require
from tdgc.files import atomic
from tdgc.sim.commands import CONTINUOUS, INDEX, NAMES, UNITS, CommandDecoder, gait_index
from tdgc.sim.gaits import FEET, GAITS
from tdgc.sim.robot import Array, to_goal, wrap_angle
from tdgc.tasks.high_rewards import HIGH_TERMS, HighReward
from tdgc.tasks.probes import NUM_PROBES, PROBES
from tdgc.tasks.rules import episode_steps

FORMAT = "tdgc-trace"
VERSION = 4


class TraceError(InputError):
    """A trace that cannot be written or read; the message is one line."""


@dataclass(frozen=True)
class Column:
    """A column of a trace; ``unit`` is empty for a text column."""

    name: str
    unit: str
    meaning: str


#: Commands that the motion of the trunk is compared with; the others shape feet, contacts or power.
TRACKED = ("vx", "vy", "yaw_rate", "body_height", "pitch", "roll")
_ACTIONS = tuple(f"action_{name}" for name in (*CONTINUOUS, "gait"))
_COMMANDS = tuple(f"command_{name}" for name in NAMES)
_AT_BOUND = tuple(f"at_bound_{name}" for name in CONTINUOUS)
_PROBES = tuple(f"probe_{i:02d}" for i in range(NUM_PROBES))
_REWARDS = tuple(f"reward_{name}" for name in HIGH_TERMS)
# Means over the control steps of a decision, in the order of ``Tracer._measure``.
_MEANS = (
    *(f"error_{name}" for name in TRACKED),
    *(f"contact_{foot}" for foot in FEET),
    *(f"match_{foot}" for foot in FEET),
    "power",
)


def _columns() -> Iterator[Column]:
    yield Column("time", "s", "since the start of the episode")
    yield Column("base_x", "m", "trunk along the tile, 0 where the tile begins")
    yield Column("base_y", "m", "trunk across the tile, 0 at its right border")
    yield Column("base_z", "m", "trunk above the platforms")
    yield Column("base_height", "m", "trunk above the support surface under it")
    yield Column("yaw", "rad", "heading, 0 along the tile, left positive")
    yield Column("pitch", "rad", "of the trunk, nose down positive")
    yield Column("roll", "rad", "of the trunk, left side up positive")
    yield Column("goal_distance", "m", "from the trunk to the goal")
    yield Column("goal_bearing", "rad", "of the goal relative to the heading, left positive")
    yield Column("family", "", "cue: terrain family reported to the high policy")
    for i, name in enumerate(_PROBES):
        meaning = f"cue: ground at probe {i}, relative to the ground under a standing robot"
        yield Column(name, "m", meaning)
    for name in _ACTIONS:
        yield Column(name, "1", "action of the policy, before decoding")
    for name, unit in zip(_COMMANDS, UNITS, strict=True):
        yield Column(name, unit, "command, as executed")
    yield Column("asked_frequency", UNITS[INDEX["frequency"]], "command, as requested")
    yield Column("gait", "", "gait commanded")
    for name in _AT_BOUND:
        yield Column(name, "1", "-1 or 1 if at its lower or upper bound, else 0")
    yield Column("seconds", "s", "since the previous decision, which the columns below describe")
    for name in TRACKED:
        yield Column(f"error_{name}", UNITS[INDEX[name]], "mean of measured minus commanded")
    for foot in FEET:
        yield Column(f"contact_{foot}", "1", "share of the time in contact")
    for foot in FEET:
        yield Column(f"match_{foot}", "1", "share of the time with contact as the gait schedules")
    yield Column("trunk_force", "N", "largest normal force on the trunk")
    yield Column("leg_force", "N", "largest normal force on a leg above its foot")
    yield Column("power", "W", "mean of the sum of |torque x speed| of the joints")
    for name in _REWARDS:
        yield Column(name, "1", "term of the high policy's reward, weighted")


#: All columns in order. Numbers are float32. Missing values are null: the decision and the probes
#: that it was based on in the last row, the columns that look back in the first row, actions and
#: cues of a driver that has none, and reward terms without a weight.
COLUMNS: tuple[Column, ...] = tuple(_columns())
_TEXT = tuple(c.name for c in COLUMNS if not c.unit)
_DECIDED = (*_PROBES, *_ACTIONS, *_COMMANDS, "asked_frequency", "gait", *_AT_BOUND)


#: Seed and level of an episode without a tile, for example on a real robot.
NO_TILE = -1


@dataclass(frozen=True, eq=False)
class Trace(EpisodeRecord):
    """One episode's trace.

    Attributes:
        columns: name -> (n,) float32, or str and None in text columns; n - 1 decisions and the
            end. NaN stands for null.
        probes: where the policy's probes are, see ``probe_places``; empty if it has none.
    """

    columns: dict[str, NDArray[Any]]
    probes: str = ""

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self.columns[name]

    @property
    def file_name(self) -> str:
        """Name of the trace's file."""
        return f"{self.name}.parquet"


_META = tuple(f for f in dataclasses.fields(Trace) if f.name != "columns")


def action_columns(action: NDArray[np.floating]) -> dict[str, NDArray[Any]]:
    """The columns for actions (n, 13)."""
    return dict(zip(_ACTIONS, action.T.copy(), strict=True))


def command_columns(
    command: Array, carried_out: Array, bounds: CommandRanges
) -> dict[str, NDArray[Any]]:
    """The columns for commands (n, 15) as requested and ``carried_out`` (n, 15).

    They hold the commands carried out, the requested frequency, the gait, and which of the
    requested commands are at their ``bounds``.
    """
    columns: dict[str, NDArray[Any]] = dict(zip(_COMMANDS, carried_out.T.copy(), strict=True))
    columns["asked_frequency"] = command[:, INDEX["frequency"]].copy()
    columns["gait"] = np.array(GAITS, dtype=object)[gait_index(command)]
    for j, name in enumerate(CONTINUOUS):
        low, high = getattr(bounds, name)
        rounding = 1e-9 * (high - low)
        at = (command[:, j] >= high - rounding).astype(float)
        columns[f"at_bound_{name}"] = at - (command[:, j] <= low + rounding)
    return columns


def probe_places(points: Array) -> str:
    """Positions of probes (n, 2) as text, in m ahead and to the left: ``0.1,0 0.15,0`` etc."""
    return " ".join(f"{x:g},{y:g}" for x, y in points)


def probe_columns(heights: Array) -> dict[str, NDArray[Any]]:
    """The columns for the heights (n, 32) under the probes, in m."""
    return dict(zip(_PROBES, heights.T, strict=True))


def tilt(gravity: Array) -> tuple[Array, Array]:
    """Pitch and roll, (n,) rad each, from gravity (n, 3) in the trunk frame.

    The inverse of ``low_rewards.commanded_gravity``.
    """
    x, y, z = gravity.T
    return np.arcsin(np.clip(x, -1.0, 1.0)), np.arctan2(-y, -z)


class Tracer:
    """A ``Watcher`` that keeps a trace of every episode of a batch.

    Args:
        driver: what drives the batch.
    """

    def __init__(self, driver: Driver) -> None:
        self._driver = driver

    def begin(self, batch: Batch) -> None:
        self._batch, self._loco = batch, batch.loco
        m, config = self._loco.num_robots, self._driver.config
        self._dt = self._loco.physics.control_dt
        self._decimation = config.decimation
        seconds = self._decimation * self._dt
        self._horizon = episode_steps(config.episode_seconds, seconds)
        decoder = CommandDecoder(config.commands, config.action_limit, config.gaits)
        self._rewards = HighReward(config, decoder, m, seconds)
        self._rows: list[dict[str, NDArray[Any]]] = []
        self._clear()
        self._look()

    def step(self, step: int, live: NDArray[np.intp]) -> None:
        if step % self._decimation == 0:
            self._decide()
        self._measure(live)
        if (step + 1) % self._decimation == 0:
            self._look()

    def traces(self) -> list[Trace]:
        """The traces of the most recently watched batch, in order."""
        if self._count.any():  # the last episodes ended between two decisions
            self._look()
        batch, result, driver = self._batch, [], self._driver
        places = "" if driver.probes is None else probe_places(PROBES[driver.config.probes])
        decisions = -(-batch.steps // self._decimation)  # the last one may have been cut short
        for k in range(batch.cell.count):
            rows = self._rows[: decisions[k] + 1]
            columns: dict[str, NDArray[Any]] = {}
            for c in COLUMNS:
                kind = object if c.name in _TEXT else np.float32
                columns[c.name] = np.array([row[c.name][k] for row in rows], dtype=kind)
                if c.name in _DECIDED:  # other robots may have decided after this one ended
                    columns[c.name][-1] = None if kind is object else np.nan
            result.append(Trace(**batch.record(k), columns=columns, probes=places))
        return result

    # ------------------------------------------------------------------ a row

    def _clear(self) -> None:
        m = self._loco.num_robots
        self._count, self._sums = np.zeros(m), np.zeros((m, len(_MEANS)))

    def _decide(self) -> None:
        """Add the decision just taken to the latest row, which holds the state it was based on."""
        row, command, driver = self._rows[-1], self._loco.command, self._driver
        if driver.action is not None:
            row.update(action_columns(driver.action))
        row.update(command_columns(command, self._loco.carried_out, driver.bounds))
        if driver.probes is not None:
            row.update(probe_columns(driver.probes))
        self._rewards.decide(command, driver.action)
        self._clear()

    def _measure(self, live: NDArray[np.intp]) -> None:
        """Accumulate the measurements of one control step of the ``live`` robots."""
        loco = self._loco
        state = loco.world.state
        height = loco.world.trunk_height() - loco.robot.base_height  # as the command is
        measured = np.stack(
            [*state.heading_vel[:, :2].T, state.ang_vel[:, 2], height, *tilt(state.gravity)], axis=1
        )
        wanted = loco.command[:, [INDEX[name] for name in TRACKED]]
        match = state.touching == (loco.clock.contact > 0.5)
        values = np.column_stack([measured - wanted, state.touching, match, state.power])
        self._count[live] += 1.0
        self._sums[live] += values[live]
        self._rewards.measure(state, live)

    def _look(self) -> None:
        """Start a new row: the current state, and how the previous decision was carried out."""
        state = self._loco.world.state
        distance, direction = to_goal(state, self._batch.goal)
        nothing = np.full(self._loco.num_robots, np.nan)
        row: dict[str, NDArray[Any]] = {
            c.name: nothing if c.unit else np.full(len(nothing), None, object) for c in COLUMNS
        }
        row["time"] = self._dt * self._batch.steps
        row["base_x"], row["base_y"] = (state.position[:, :2] - self._batch.origin).T
        row["base_z"] = state.position[:, 2].copy()
        row["base_height"] = self._loco.world.trunk_height()
        row["yaw"] = state.yaw.copy()
        row["pitch"], row["roll"] = tilt(state.gravity)
        row["goal_distance"], row["goal_bearing"] = distance, wrap_angle(direction - state.yaw)
        row["family"] = np.full(len(nothing), self._driver.told, object)
        if self._count.any():
            self._add_execution(row)
        self._rows.append(row)
        self._count[:] = 0.0

    def _add_execution(self, row: dict[str, NDArray[Any]]) -> None:
        count = np.where(self._count > 0.0, self._count, np.nan)  # 0: has already ended
        row["seconds"] = self._dt * count
        row.update(zip(_MEANS, self._sums.T / count, strict=True))
        force = self._rewards.force
        row["trunk_force"], row["leg_force"] = force[:, 0].copy(), force[:, 1:].max(axis=1)
        # As in training, a decision that ends early is rewarded for its full duration.
        share = np.full(len(count), len(self._rows) / self._horizon)
        for name, value in self._rewards.terms(self._loco, self._batch.goal, share).items():
            if name != "action_rate" or self._driver.action is not None:
                row[f"reward_{name}"] = value


# ---------------------------------------------------------------------------- files


@dataclass(frozen=True)
class Selection:
    """Which traces are written: all, those of failed episodes, or the first N of each cell."""

    which: Literal["all", "failed"] | int

    @classmethod
    def parse(cls, text: str) -> "Selection":
        """Parse ``all``, ``failed`` or a number.

        Raises:
            TraceError: the text is none of these.
        """
        if text == "all":
            return cls("all")
        if text == "failed":
            return cls("failed")
        if not (text.isascii() and text.isdigit() and int(text[:9]) > 0):
            raise TraceError(f"--trace must be all, failed or a number from 1, not '{text}'")
        return cls(int(text[:9]))  # nine digits exceed any evaluation

    def includes(self, trace: Trace) -> bool:
        if isinstance(self.which, int):
            return trace.episode < self.which
        return self.which == "all" or trace.outcome != "reached"


def _fields() -> list[tuple[str, Any, dict[str, str]]]:
    """Name, type and metadata of each column in a file."""
    import pyarrow as pa

    number, text = pa.float32(), pa.string()
    return [
        (c.name, number if c.unit else text, {"unit": c.unit, "description": c.meaning})
        for c in COLUMNS
    ]


def _about(field: Any) -> dict[str, str]:
    """Unit and description of a column in a file, where present."""
    found = {key.decode(): value.decode() for key, value in (field.metadata or {}).items()}
    return {key: found[key] for key in ("unit", "description") if key in found}


def write(trace: Trace, folder: str | Path) -> Path:
    """Write ``trace`` atomically into ``folder`` under its ``file_name`` and return the path.

    Raises:
        InputError: pyarrow is not installed.
        OSError: the file cannot be written.
    """
    require("a trace", ("pyarrow",), "trace")
    import pyarrow as pa
    import pyarrow.parquet as pq

    fields = [pa.field(name, kind, metadata=about) for name, kind, about in _fields()]
    arrays = [pa.array(trace[f.name], f.type, from_pandas=True) for f in fields]
    meta = {"format": FORMAT, "version": str(VERSION)}
    meta |= {f.name: str(getattr(trace, f.name)) for f in _META}
    table = pa.Table.from_arrays(arrays, schema=pa.schema(fields, metadata=meta))
    path = Path(folder) / trace.file_name
    with atomic(path) as partial:
        pq.write_table(
            table,
            partial,
            compression="zstd",
            use_dictionary=list(_TEXT),
            use_byte_stream_split=[c.name for c in COLUMNS if c.unit],  # files a fifth smaller
            write_statistics=False,
            write_page_checksum=True,
        )
    return path


def read(path: str | Path) -> Trace:
    """Read the trace in a file that ``write`` wrote.

    Raises:
        TraceError: the file is missing, damaged, not a trace, or of another version.
        InputError: pyarrow is not installed.
    """
    require("a trace", ("pyarrow",), "trace")
    import pyarrow as pa
    import pyarrow.parquet as pq

    path = Path(path)
    if not path.is_file():
        raise TraceError(f"{path}: no such file")
    try:
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            raw = file.schema_arrow.metadata or {}
            meta = {key.decode(): value.decode() for key, value in raw.items()}
            fields = [(f.name, f.type, _about(f)) for f in file.schema_arrow]
            known = (meta.get("format"), meta.get("version"), fields)
            table = file.read() if known == (FORMAT, str(VERSION), _fields()) else None
            if table is not None:
                table.validate(full=True)  # among other things, that text is UTF-8
    except (pa.ArrowException, OSError, ValueError, OverflowError, MemoryError) as error:
        raise TraceError(f"{path}: damaged, or not a Parquet file") from error
    if meta.get("format") != FORMAT:
        raise TraceError(f"{path}: not a trace of this package")
    if meta.get("version") != str(VERSION):
        raise TraceError(
            f"{path}: a trace of version {meta.get('version')}, this package reads {VERSION}"
        )
    if table is None or table.num_rows < 2:
        raise TraceError(f"{path}: its columns are not those of a trace of version {VERSION}")
    try:
        head = {f.name: int(meta[f.name]) if f.type is int else meta[f.name] for f in _META}
    except (KeyError, ValueError) as error:
        raise TraceError(f"{path}: does not identify its episode") from error
    columns = {c.name: table[c.name].to_numpy(zero_copy_only=False) for c in COLUMNS}
    trace = Trace(**head, columns=columns)  # type: ignore[arg-type]
    if "\0" in trace.file_name or Path(trace.file_name).name != trace.file_name:
        raise TraceError(f"{path}: of an episode '{trace.file_name}', which cannot name a file")
    return trace
