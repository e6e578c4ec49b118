"""Trials: a variant with a seed, trained by train_high.py and evaluated by evaluate.py.

A trial's folder holds the files of its training run, ``evaluation`` with the results of
evaluate.py, and ``cell.json`` once it is done. Until then, running it again continues where it was.
"""

import csv
import inspect
import itertools
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import evaluate
import train_high
from tdgc import policies
from tdgc.ablate.variants import WHOLE, Variant
from tdgc.config import HighTrainConfig, read_json, with_overrides
from tdgc.errors import FAILURES, InputError, StoppedError, escaped, what_stopped
from tdgc.files import read_csv, write_json
from tdgc.learn.run import signalled, signals_restored
from tdgc.parallel.cores import Workers
from tdgc.policies.acting import without_correction
from tdgc.sim.families import UNNAMED
from tdgc.tasks.pairing import load_low
from tdgc.tasks.rules import OUTCOMES
from tdgc.tasks.tiles import FLAT

#: Family, level and number of a tile.
Tile = tuple[str, int, int]
#: What is kept of an evaluation, s, and of a training: decisions, s, and h simulated, summed over
#: all robots.
EVALUATED = ("evaluate_seconds",)
TRAINED = ("steps", "train_seconds", "simulated_hours")


class TrialError(InputError):
    """A trial cannot be trained or evaluated; the message is one line."""


@dataclass(frozen=True)
class Trial:
    """A variant with the seed of the trained policy it uses; None if it is scripted."""

    variant: Variant
    seed: int | None

    @property
    def name(self) -> str:
        """Name of the trial and of its folder."""
        return self.variant.name if self.seed is None else f"{self.variant.name}-{self.seed}"


@dataclass(frozen=True, eq=False)
class Result:
    """The result of a trial.

    Attributes:
        facts: ``EVALUATED`` and, if it was trained, ``TRAINED``.
        reached: (n,) whether the goal was reached, in the order of ``Runner.tiles``.
    """

    facts: dict[str, float]
    reached: NDArray[np.bool_]


#: The result of a trial, or its error message.
Found = Result | str


@dataclass(frozen=True)
class Runner:
    """Runs trials that can be compared with each other.

    Attributes:
        out: parent of their folders.
        low: path of the low policy.
        alone: train without a teacher.
        settings: applied to all trainings, before those of the variants.
        steps: decisions per training; None for the default of train_high.py.
        levels: in the format of evaluate.py.
        episodes: per family and level.
        workers: in the format of both scripts.
        deadline: in s, on the clock of ``time.monotonic``; None for no deadline.
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

    def run(self, trial: Trial) -> Found:
        """Train a trial, if it needs training, and evaluate it; continue from an earlier call.

        Returns its result, or an error message if it failed or one of its files is damaged.

        Raises:
            StoppedError: a signal or the deadline came before it was done.
        """
        folder = self.out / trial.name
        try:
            if not self.done(trial):
                self._complete(trial, folder)
            facts = read_json(folder / "cell.json")
            kept = EVALUATED + (TRAINED if trial.variant.settings is not None else ())
            return Result(
                {name: _number(facts, name, folder / "cell.json") for name in kept},
                _reached(folder / "evaluation" / "episodes.csv", self.tiles()),
            )
        except StoppedError:
            raise
        except (ValueError, *FAILURES) as error:
            said = what_stopped(error)
        except Exception as error:  # whatever happened, the other trials continue
            said = f"{type(error).__name__}: {' '.join(str(error).split())}"
        return escaped(said)

    def done(self, trial: Trial) -> bool:
        """Whether an earlier call has finished the trial."""
        return (self.out / trial.name / "cell.json").is_file()

    def _complete(self, trial: Trial, folder: Path) -> None:
        """Do the remaining work of a trial and write its ``cell.json``."""
        high = None
        if trial.variant.settings is not None:
            self._train(trial, folder)
            high = folder / "policy"
        elif trial.variant.policy == "tdgc":
            whole = self.out / f"{WHOLE}-{trial.seed}"
            high = whole / trial.variant.high
            if not (whole / "cell.json").is_file():
                raise TrialError(f"it needs '{WHOLE}' with seed {trial.seed}, which is missing")
        elif trial.variant.policy in ("cues", "teacher"):
            # At the speeds at which the teacher taught ``full``, whatever its seed.
            done = min(self.out.glob(f"{WHOLE}-*/cell.json"), default=None)
            if done is not None and "teacher" in policies.load(done.with_name("policy")).meta:
                high = done.with_name("policy")
        self._seconds_left()
        began = time.monotonic()
        folder.mkdir(parents=True, exist_ok=True)
        low, high = changed_pair(trial.variant, self.low, high, folder)
        flags = self.evaluation_flags(trial.variant.policy, low, high)
        call(evaluate.main, [*flags, "--out", folder / "evaluation"])
        found = {"evaluate_seconds": round(time.monotonic() - began, 1)}
        if trial.variant.settings is not None:
            found |= _training_facts(folder / "policy", low)
        write_json(folder / "cell.json", found)

    def tiles(self) -> list[Tile]:
        """The tiles that each trial is evaluated on.

        Raises:
            ValueError, OSError: evaluate.py cannot use the flags.
        """
        flags = self.evaluation_flags("gp", self.low, None)
        e = evaluate.Evaluation.of(evaluate.parse([str(flag) for flag in flags]))
        return list(itertools.product(e.families, e.levels, range(e.episodes)))

    def training_settings(self, variant: Variant) -> tuple[str, ...]:
        """Values of ``--set`` for a variant's training."""
        own = (variant.settings or ()) + (variant.alone if self.alone else ())
        return self.settings + own

    def evaluation_flags(self, policy: str, low: Path, high: Path | None) -> list[object]:
        """Flags of evaluate.py; the tiles are the same for all variants."""
        env = with_overrides(HighTrainConfig(), self.settings).env
        families = dict.fromkeys(name for name in env.families if name not in (*UNNAMED, FLAT))
        flags: list[object] = [
            *("--policies", policy, "--levels", self.levels, "--episodes", self.episodes),
            *("--families", ",".join(families or dict.fromkeys(env.families))),
            *("--low", low, "--workers", self.workers),
        ]
        return flags if high is None else [*flags, "--high", high]

    def _train(self, trial: Trial, folder: Path) -> None:
        """Train until the budget is used up."""
        flags: list[object] = []
        if any((folder / "checkpoints").glob("step-*")):
            flags += ["--resume"]
        else:
            shutil.rmtree(folder, ignore_errors=True)  # it was killed before its first checkpoint
            flags += ["--low", self.low, "--seed", trial.seed, "--workers", self.workers]
            flags += [] if self.steps is None else ["--steps", self.steps]
            flags += ["--no-teacher"] if self.alone else []
            for setting in self.training_settings(trial.variant):
                flags += ["--set", setting]
        left = self._seconds_left()
        flags += [] if left is None else ["--time-limit", left]
        with signals_restored():
            call(train_high.main, [*flags, "--out", folder])
            if signalled():  # perhaps after the last update, when the training ended anyway
                raise StoppedError
        budget = _number(read_json(folder / "config.json"), "steps", folder / "config.json")
        meta = policies.load(folder / "policy").meta
        if _number(meta, "steps", folder / "policy.json") < budget:
            raise StoppedError

    def _seconds_left(self) -> float | None:
        if self.deadline is None:
            return None
        left = self.deadline - time.monotonic()
        if left <= 0.0:
            raise StoppedError
        return left


# ---------------------------------------------------------------------------- the two scripts


def call(main: Callable[[list[str]], int], flags: Sequence[object]) -> None:
    """Call a script's ``main``; what stops it is raised instead of printed.

    Raises:
        TrialError: it ended with an exit status, after printing why.
    """
    status = inspect.unwrap(main)([str(flag) for flag in flags])
    if status:
        raise TrialError(f"{main.__module__}.py: status {status}")


# ---------------------------------------------------------------------------- policies


def changed_pair(
    variant: Variant, low: Path, high: Path | None, folder: Path
) -> tuple[Path, Path | None]:
    """The low and high policy that a variant is evaluated with.

    Copies with a changed configuration are written into ``folder``.

    Raises:
        ValueError: a policy is missing or cannot be used.
        OSError: a copy cannot be written.
    """
    if variant.low == "uncalibrated":
        given = policies.load(low)
        if given.correction is None:
            raise InputError(f"'{low}' has no correction to leave out")
        low = folder / "low"
        policies.save_copy(low, without_correction(given), given.meta)
    elif variant.low == "fixed-pose":
        pose = {"robot": {"commanded_pose": False}}
        low = _copy(low, folder / "low", {"config": pose})
        if high is not None:
            high = _copy(high, folder / "high", {"low": {"config": pose}})
    return low, high


def _copy(source: Path, target: Path, changes: dict[str, Any]) -> Path:
    """Write a copy of a policy with changes to its ``meta``."""
    policy = policies.load(source)
    policies.save_copy(target, policy, _changed(policy.meta, changes))
    return target


def _changed(table: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """A copy of a nested table with some of its values changed."""
    return table | {
        key: _changed(table[key], value) if isinstance(value, dict) else value
        for key, value in changes.items()
    }


# ---------------------------------------------------------------------------- files of a trial


def _number(table: Any, key: str, path: Path) -> float:
    """A number in ``table``, which is the content of the file ``path``.

    Raises:
        TrialError: the entry is missing or not a number.
    """
    value = table.get(key) if isinstance(table, dict) else None
    if not isinstance(value, int | float):
        raise TrialError(f"{path}: '{key}' must be a number, not {value!r}")
    return value


def _training_facts(policy: Path, low: Path) -> dict[str, float]:
    meta, path = policies.load(policy).meta, policy.with_suffix(".json")
    decimation = _number(meta.get("config"), "decimation", path)
    hours = decimation * load_low(low)[1].physics.control_dt / 3600.0  # per decision
    steps = _number(meta, "steps", path)
    return {
        "steps": steps,
        "train_seconds": _number(meta, "seconds", path),
        "simulated_hours": round(steps * hours, 2),
    }


def _reached(path: Path, tiles: Sequence[Tile]) -> NDArray[np.bool_]:
    """Whether the goal was reached on each tile, from the episodes.csv of an evaluation.

    Raises:
        TrialError: the file cannot be parsed, or lacks the outcome of a tile.
        OSError: the file is missing.
    """
    try:
        outcomes = {
            (row["family"], int(row["level"]), int(row["episode"])): row["outcome"]
            for row in read_csv(path)
        }
    except (KeyError, TypeError, ValueError, csv.Error) as error:
        raise TrialError(f"{path}: damaged, or not of an evaluation") from error
    for tile in tiles:
        if outcomes.get(tile) not in OUTCOMES:
            family, level, number = tile
            raise TrialError(f"{path}: no outcome of episode {number} on {family}, level {level}")
    return np.array([outcomes[tile] == "reached" for tile in tiles])
