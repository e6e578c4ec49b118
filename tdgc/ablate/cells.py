"""Cells: a variant with a seed, trained by train_high.py and evaluated by evaluate.py.

A cell has a folder: the run of its training, ``evaluation`` with the results of evaluate.py, and
``cell.json`` once it is done. Until then a cell that is run again goes on where it was.
"""

import contextlib
import io
import json
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

import evaluate
import train_high
from tdgc import policies
from tdgc.ablate.variants import WHOLE, Variant
from tdgc.config import HighTrainConfig, read_json, with_overrides
from tdgc.files import atomic
from tdgc.parallel.cores import Workers
from tdgc.tasks.high_env import load_low


class CellError(Exception):
    """A cell that cannot be trained or evaluated; the message is one line."""


class StoppedError(Exception):
    """A signal or the time limit came before a cell was done."""


@dataclass(frozen=True)
class Cell:
    """A variant with the seed of its training; None where no training is in it."""

    variant: Variant
    seed: int | None

    @property
    def name(self) -> str:
        """Of the cell and of its folder."""
        return self.variant.name if self.seed is None else f"{self.variant.name}-{self.seed}"


@dataclass(frozen=True)
class Runner:
    """Runs cells that can be compared.

    Attributes:
        out: where their folders are.
        low: the low policy's path.
        alone: train without a teacher.
        settings: of all trainings, before the variants' own.
        steps: decisions of a training; None for train_high.py's own number.
        levels: as evaluate.py takes them.
        episodes: of a family and level.
        workers: as both scripts take them.
        deadline: on ``time.monotonic``'s clock, s; None for none.
    """

    out: Path
    low: Path
    alone: bool
    settings: tuple[str, ...]
    steps: int | None
    levels: str
    episodes: int
    workers: Workers
    deadline: float | None

    def run(self, cell: Cell) -> dict[str, Any]:
        """Train a cell, if need be, and evaluate it, from where an earlier call was.

        Returns:
            ``evaluate_seconds``, and of a training ``steps``, ``train_seconds`` and
            ``simulated_hours``, those of all robots together.

        Raises:
            CellError, StoppedError: it is not done.
        """
        folder = self.out / cell.name
        if (folder / "cell.json").is_file():
            found: dict[str, Any] = read_json(folder / "cell.json")
            return found
        high = None
        if cell.variant.settings is not None:
            self._train(cell, folder)
            high = folder / "policy"
        elif cell.variant.policy == "tdgc":
            high = self.out / f"{WHOLE}-{cell.seed}" / "policy"
            if not (self.out / f"{WHOLE}-{cell.seed}" / "cell.json").is_file():
                raise CellError(f"it needs '{WHOLE}' with seed {cell.seed}, which is not done")
        self._seconds_left()
        began = time.monotonic()
        folder.mkdir(parents=True, exist_ok=True)
        try:
            low, high = changed_pair(cell.variant, self.low, high, folder)
        except (ValueError, OSError) as error:
            raise CellError(str(error)) from error
        flags = self.evaluation_flags(cell.variant.policy, low, high)
        call(evaluate.main, [*flags, "--out", folder / "evaluation"])
        found = {"evaluate_seconds": round(time.monotonic() - began, 1)}
        if cell.variant.settings is not None:
            found |= _training_facts(folder, low)
        with atomic(folder / "cell.json") as partial:
            partial.write_text(json.dumps(found, indent=2), encoding="utf-8")
        return found

    def training_settings(self, variant: Variant) -> tuple[str, ...]:
        """What ``--set`` is given in a variant's training."""
        own = (variant.settings or ()) + (variant.alone if self.alone else ())
        return self.settings + own

    def evaluation_flags(self, policy: str, low: Path, high: Path | None) -> list[object]:
        """The flags of evaluate.py: of all variants the same tiles."""
        env = with_overrides(HighTrainConfig(), self.settings).env
        flags: list[object] = [
            *("--policies", policy, "--levels", self.levels, "--episodes", self.episodes),
            *("--families", ",".join(dict.fromkeys(env.families))),
            *("--low", low, "--workers", self.workers),
        ]
        return flags if high is None else [*flags, "--high", high]

    def _train(self, cell: Cell, folder: Path) -> None:
        """Train to the end of the budget."""
        flags: list[object] = []
        if any((folder / "checkpoints").glob("step-*")):
            flags += ["--resume"]
        else:
            shutil.rmtree(folder, ignore_errors=True)  # killed before its first checkpoint
            flags += ["--low", self.low, "--seed", cell.seed, "--workers", self.workers]
            flags += [] if self.steps is None else ["--steps", self.steps]
            flags += ["--no-teacher"] if self.alone else []
            for setting in self.training_settings(cell.variant):
                flags += ["--set", setting]
        left = self._seconds_left()
        flags += [] if left is None else ["--time-limit", left]
        with _own_signals():
            call(train_high.main, [*flags, "--out", folder])
        budget = read_json(folder / "config.json")["steps"]
        if policies.load(folder / "policy").meta["steps"] < budget:
            raise StoppedError

    def _seconds_left(self) -> float | None:
        if self.deadline is None:
            return None
        left = self.deadline - time.monotonic()
        if left <= 0.0:
            raise StoppedError
        return left


# ---------------------------------------------------------------------------- the two scripts


class _Tee(io.StringIO):
    """Keeps what goes to a stream."""

    def __init__(self, stream: TextIO) -> None:
        super().__init__()
        self._stream = stream

    def write(self, text: str) -> int:
        self._stream.write(text)
        return super().write(text)

    def flush(self) -> None:
        self._stream.flush()


def call(main: Callable[[list[str]], int], flags: Sequence[object]) -> None:
    """Call a script's ``main``.

    Raises:
        CellError: it failed; with what it said.
    """
    said = _Tee(sys.stderr)
    try:
        with contextlib.redirect_stderr(said):
            status = main([str(flag) for flag in flags])
    except Exception as error:  # whatever it is, the other cells go on
        raise CellError(f"{type(error).__name__}: {' '.join(str(error).split())}") from error
    if status:
        script = f"{main.__module__}.py: "
        lines = said.getvalue().replace("\r", "\n").splitlines()
        named = [line.removeprefix(script) for line in lines if line.startswith(script)]
        raise CellError(named[-1] if named else f"{script}status {status}")


@contextlib.contextmanager
def _own_signals() -> Iterator[None]:
    """Give SIGINT and SIGTERM back to who had them: a training takes them over."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


# ---------------------------------------------------------------------------- policies


def changed_pair(
    variant: Variant, low: Path, high: Path | None, folder: Path
) -> tuple[Path, Path | None]:
    """The policies that a variant is evaluated with. Copies with a changed configuration are
    written into ``folder``.

    Raises:
        ValueError: a policy that is missing or cannot be used.
        OSError: copies that cannot be written.
    """
    if variant.low == "uncalibrated":
        low = low.with_name("uncalibrated")  # where train_low.py leaves it
        policies.load(low)
    elif variant.low == "fixed-pose":
        pose = {"robot": {"commanded_pose": False}}
        low = _copy(low, folder / "low", {"config": pose})
        if high is not None:
            high = _copy(high, folder / "high", {"low": {"config": pose}})
    return low, high


def _copy(source: Path, target: Path, changes: dict[str, Any]) -> Path:
    """Write a policy with changes to its ``meta``."""
    policy = policies.load(source)
    policies.save_copy(target, policy, {}, _changed(policy.meta, changes))
    return target


def _changed(table: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """A nested table with some of its values changed."""
    return table | {
        key: _changed(table[key], value) if isinstance(value, dict) else value
        for key, value in changes.items()
    }


def _training_facts(folder: Path, low: Path) -> dict[str, Any]:
    meta = policies.load(folder / "policy").meta
    decision = meta["config"]["decimation"] * load_low(low)[1].physics.control_dt  # s
    return {
        "steps": meta["steps"],
        "train_seconds": meta["seconds"],
        "simulated_hours": round(meta["steps"] * decision / 3600.0, 2),
    }
