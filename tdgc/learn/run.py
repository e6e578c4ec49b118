"""A training run: its folder, its phases, the learning loop, logs and interruption.

A run folder holds ``config.json``, ``log.jsonl`` (a row every ``log_steps``), TensorBoard's event
files, ``policy.safetensors`` with ``policy.json`` (the latest policy, ready for use), ``.lock`` and
``checkpoints/`` with the two newest checkpoints, from which a run resumes, in the middle of its
episodes, as if it had never stopped.
"""

import contextlib
import dataclasses
import errno
import fcntl
import json
import math
import os
import signal
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any, cast

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat
from stable_baselines3.common.policies import ActorCriticPolicy
from tensorboard.compat.proto.event_pb2 import Event, SessionLog
from tqdm import tqdm

from tdgc import policies
from tdgc.config import (
    ConfigError,
    HighTrainConfig,
    LowLevelConfig,
    LowTrainConfig,
    differences,
    recorded,
    to_dict,
)
from tdgc.errors import InputError, WorkerError
from tdgc.files import write_json, write_text
from tdgc.learn.checkpoints import Checkpoint
from tdgc.parallel.vec import TaskVecEnv, without_episodes
from tdgc.parallel.worker import memory_mb


@dataclass(frozen=True)
class Phase:
    """A part of a run with its own environment.

    Attributes:
        name: for the progress bar and the policy that the phase leaves.
        build: makes the learner and its workers.
        until: steps of the run at which the phase ends.
        own_levels: whether robots begin on the levels that the phase's environment sets; otherwise
            they stay on the levels where the previous phase left them.
    """

    name: str
    build: Callable[[], tuple[Any, TaskVecEnv]]
    until: int
    own_levels: bool = False


class Interruption:
    """Turns SIGINT, SIGTERM and a time limit into one flag that the learning loop checks.

    Attributes:
        reason: why to stop; None for no reason.
        signalled: whether a signal came.
    """

    def __init__(self, time_limit: float | None) -> None:
        self.reason: str | None = None
        self.signalled = False
        self._deadline = math.inf if time_limit is None else time.monotonic() + time_limit
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._on_signal)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if self.signalled:  # asked twice: stop at once
            raise KeyboardInterrupt("SIGTERM" if number == signal.SIGTERM else "")
        self.signalled = True
        if self.reason is None:
            self.reason = signal.Signals(number).name

    def due(self) -> bool:
        """Whether the run should stop now."""
        if self.reason is None and time.monotonic() > self._deadline:
            self.reason = "the time limit"
        return self.reason is not None

    def tell(self, run: Path) -> None:
        """Print what stopped the run in the folder ``run`` and how to resume it."""
        tqdm.write(f"stopped by {self.reason}; continue with --resume --out {run}")


def signalled() -> bool:
    """Whether a signal came that this process's latest ``Interruption`` has turned into a flag."""
    latest = getattr(signal.getsignal(signal.SIGINT), "__self__", None)
    return isinstance(latest, Interruption) and latest.signalled


@contextlib.contextmanager
def signals_restored() -> Iterator[None]:
    """Restore the handlers of SIGINT and SIGTERM at the end; an ``Interruption`` replaces them."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@dataclass(frozen=True)
class Run:
    """A run of a trainer.

    Attributes:
        folder: the run folder, which exists.
        config: of the whole run; written to the folder.
        meta: stored in the policy's file.
        summarise: sums of all workers -> values to log.
        interruption: when to stop.
        init: a policy to begin from, if any.
    """

    folder: Path
    config: LowTrainConfig | HighTrainConfig
    meta: dict[str, Any]
    summarise: Callable[[dict[str, float]], dict[str, float]]
    interruption: Interruption
    init: Path | None = None

    def train(
        self, phases: Sequence[Phase], resume: bool, finish: Callable[[], None] = lambda: None
    ) -> None:
        """Run the phases in order, starting from the newest checkpoint if ``resume`` is set.

        ``finish`` is called at the end, unless the run was interrupted. Until then no other process
        can train in the folder.

        Raises:
            InputError: another process trains in the folder.
            CheckpointError: there is no readable checkpoint to resume from, or it does not fit.
            ValueError: the policy ``init`` cannot be read or does not fit.
            FloatingPointError: the policy diverged; the last checkpoint is from before.
            WorkerError: too many worker faults; a checkpoint was written.
            OSError: a file cannot be written, for example the last checkpoint.
            Exception: what ``finish`` raises.
        """
        if self.init is not None:
            self._tell_changes(policies.load(self.init).meta)
        finished, unsaved = True, None
        with sole_user(self.folder):
            last = Checkpoint.newest(self.folder, tqdm.write) if resume else None
            if last is not None and last.steps >= phases[-1].until:
                tqdm.write(
                    f"{self.folder} has been trained for {last.steps} steps already; only a larger "
                    "--steps would train it further"
                )
            for phase in phases:
                if finished and (last is None or last.steps < phase.until):
                    last, finished, unsaved = self._go_through(phase, last, phase is phases[-1])
            if unsaved is not None:
                raise unsaved
            if finished:
                finish()
            else:
                self.interruption.tell(self.folder)

    def _tell_changes(self, before: Mapping[str, Any]) -> None:
        """Print which settings of the environment and of the low policy's robot differ from those
        in ``before``, the metadata of ``init``, as its actions may have meant something else."""
        env = self.config.env
        try:
            trained = to_dict(recorded(type(env), before.get("config", {}), self.init))
        except ConfigError as error:
            tqdm.write(f"cannot compare the settings: {error}")
            return
        for change in (
            *differences(trained, to_dict(env), "env"),
            *differences(_robot(before), _robot(self.meta), "low.robot"),
        ):
            tqdm.write(f"{self.init} was trained with {change}")

    def _go_through(
        self, phase: Phase, last: Checkpoint | None, final: bool
    ) -> tuple[Checkpoint, bool, OSError | None]:
        """Run one phase from the checkpoint ``last``, or from the start of the run if None.

        The policy at its end is kept beside those of later phases, unless it is the ``final`` one.

        Returns:
            The checkpoint at its end; whether the phase finished; and the error if that checkpoint
            could not be written.
        """
        model, env = phase.build()
        try:
            begins = 0 if last is None else last.steps
            model.set_logger(tensorboard_logger(self.folder / "tensorboard", begins))
            if last is not None:
                last.restore(model)
                states = last.workers()
                if last.header["phase"] != phase.name:  # episodes end with a phase
                    states = [without_episodes(state) for state in states]
                    if phase.own_levels:
                        states = [{k: v for k, v in s.items() if k != "curriculum"} for s in states]
                env.load_state_dicts(states)
            else:
                if self.init is not None:
                    policies.load_into(self.init, model.policy)
                env.reset()
            # Only now, so that a run that cannot start leaves none behind.
            write_json(self.folder / "config.json", to_dict(self.config))
            if last is not None:
                drop_rows_after(last.steps, self.folder / "log.jsonl")
                last.drop_later(self.folder / "checkpoints")
            # The latest observations, which SB3 otherwise keeps from the previous rollout.
            model._last_obs, model._last_episode_starts = env.seen(), env.starts()
            model.ep_info_buffer, model.ep_success_buffer = deque(maxlen=100), deque(maxlen=100)
            callback = RunCallback(self, env, phase.name, last)
            try:
                finished = learn(model, callback, phase.until)
            except WorkerError:
                callback.tell_faults()
                callback.log()
                callback.save()
                raise
            keeps = finished and not final
            taken = callback.save(("policy", phase.name) if keeps else ("policy",))
            if keeps and callback.unsaved is not None:
                raise callback.unsaved  # later phases would not write this phase's policy
            return taken, finished, callback.unsaved
        finally:
            env.close()


def _robot(meta: Mapping[str, Any]) -> dict[str, Any] | None:
    """The robot of the low policy that a high policy with the metadata ``meta`` commands."""
    try:
        return to_dict(recorded(LowLevelConfig, meta["low"]["config"], "low"))["robot"]
    except (KeyError, TypeError, ConfigError):
        return None


class RunCallback(BaseCallback):
    """Progress, logs and checkpoints of a phase.

    Args:
        run: the run that the phase belongs to.
        env: the workers.
        name: of the phase.
        last: the run's newest checkpoint, if there is one.

    Attributes:
        unsaved: why the last checkpoint could not be written, or None.
    """

    def __init__(self, run: Run, env: TaskVecEnv, name: str, last: Checkpoint | None) -> None:
        super().__init__()
        self.run, self.env = run, env
        self._name = name
        self._started = time.monotonic() - (0.0 if last is None else last.header["seconds"])
        # A run's first checkpoint is written at once, so that it can be resumed whenever it ends.
        self._saved_at = -math.inf if last is None else self.seconds
        self._logged_at = (0, 0.0)
        self._bar: Any = None
        self._faults: list[dict[str, Any]] = []  # since the last log row
        self._tensorboard_failed = False
        self.unsaved: OSError | None = None

    @property
    def seconds(self) -> float:
        """Wall time of the run in s, including the time before it was resumed."""
        return time.monotonic() - self._started

    def _on_training_start(self) -> None:
        self._logged_at = (self.num_timesteps, self.seconds)
        self._bar = tqdm(
            desc=self._name,
            total=self.run.config.steps,
            initial=self.num_timesteps,
            unit="step",
            unit_scale=True,
            mininterval=2.0,
            dynamic_ncols=True,
        )

    def _on_rollout_start(self) -> None:
        # Between an update and the next rollout the learner's state is complete. The workers forget
        # before every rollout, so that writing a checkpoint or not makes no difference to the run.
        self.env.forget()
        if self.seconds - self._saved_at >= self.run.config.checkpoint_seconds:
            self.save()
            self._saved_at = self.seconds

    def _on_step(self) -> bool:
        self.tell_faults()
        return True

    def tell_faults(self) -> None:
        """Print the faults of restarted workers and keep them for the next log row."""
        while self.env.faults:
            fault = self.env.faults.pop(0)
            tqdm.write(str(fault))
            self._faults.append({"steps": self.num_timesteps, **dataclasses.asdict(fault)})

    def _on_rollout_end(self) -> None:
        self._bar.update(self.num_timesteps - self._bar.n)
        if self.num_timesteps - self._logged_at[0] >= self.run.config.log_steps:
            self.log()

    def save(self, names: Sequence[str] = ("policy",)) -> Checkpoint:
        """Write the policy and a checkpoint, or print why not, and return the checkpoint.

        Args:
            names: of the policy's files in the run folder.

        Raises:
            ValueError: the policy is not finite; no checkpoint is written then.
        """
        states = self.env.state_dicts()
        extra = {"workers": states, "seconds": self.seconds, "phase": self._name}
        taken = Checkpoint.take(self.model, extra)
        policy = cast(ActorCriticPolicy, self.model.policy)
        meta = {**self.run.meta, "steps": taken.steps, "seconds": round(self.seconds)}
        try:
            # The policy first: if it is not finite, it is refused, and so is the checkpoint.
            for name in names:
                policies.save(self.run.folder / name, policy, meta)
            taken.save(self.run.folder / "checkpoints")
            self.unsaved = None
        except OSError as error:
            self.unsaved = error
            tqdm.write(f"no checkpoint at {taken.steps} steps, the one before stays: {error}")
        return taken

    def log(self) -> None:
        """Write a log row about the steps since the last row, if there are steps or faults."""
        steps, seconds = self._logged_at
        if steps == self.num_timesteps and not self._faults:
            return
        sums: dict[str, float] = {}
        for part in self.env.stats():
            for key, value in part.items():
                sums[key] = sums.get(key, 0.0) + value
        values = self.run.summarise(sums) if sums else {}  # if all workers are broken
        values["time/steps_per_s"] = (self.num_timesteps - steps) / (self.seconds - seconds)
        episodes = self.model.ep_info_buffer or ()
        if episodes:
            values["episode/return"] = float(np.mean([e["r"] for e in episodes]))
            values["episode/length"] = float(np.mean([e["l"] for e in episodes]))
        for name in (
            "imitation_loss", "value_loss", "policy_gradient_loss", "approx_kl", "clip_fraction",
            "std", "learning_rate", "actor_learning_rate",
        ):  # fmt: skip
            number = self.logger.name_to_value.get(f"train/{name}")
            if number is not None:
                values[f"train/{name}"] = float(number)
        memory = sums.get("memory_mb", 0.0) + memory_mb(os.getpid())
        if math.isfinite(memory):
            values["memory/mb"] = memory
        values["faults/blow_ups"] = sums.get("blow_ups", 0.0)
        values["faults/restarts"] = float(len(self._faults))
        row: dict[str, Any] = {"steps": self.num_timesteps, "seconds": round(self.seconds, 1)}
        row |= {k: float(f"{v:.5g}") for k, v in values.items()} | {"faults": self._faults}
        try:
            append_line(self.run.folder / "log.jsonl", json.dumps(row))
            self._faults = []
            if self._tensorboard_failed:  # its writer cannot recover from an error
                folder = self.run.folder / "tensorboard"
                self.model.set_logger(tensorboard_logger(folder, steps))
            for key, value in values.items():
                self.logger.record(key, value)
            self.logger.dump(self.num_timesteps)
            self._tensorboard_failed = False
        except OSError as error:
            self._tensorboard_failed = True
            tqdm.write(f"no complete log row at {self.num_timesteps} steps: {error}")
        self._logged_at = (self.num_timesteps, self.seconds)

    def _on_training_end(self) -> None:
        self._bar.close()


@contextlib.contextmanager
def sole_user(folder: Path) -> Iterator[None]:
    """Hold a run folder, so that nobody else who asks for it here can train in it.

    The folder is free again when the process ends, even if it is killed; the file ``.lock`` stays.
    Processes that it has started do not hold the lock.

    Raises:
        InputError: another process uses the folder, or this one does already.
        OSError: the folder cannot be written to.
    """
    with open(folder / ".lock", "wb") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(f"'{folder}' is in use by another process") from None
        except OSError:
            pass  # a file system without locks: better unguarded than unusable
        yield


def append_line(path: Path, line: str) -> None:
    """Append a line to a file, completely or not at all.

    Raises:
        OSError: it cannot be written.
    """
    data = f"{line}\n".encode()
    with open(path, "ab", buffering=0) as file:
        end = file.tell()
        if file.write(data) < len(data):  # the disk had room for only a part
            file.truncate(end)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))


def drop_rows_after(steps: int, path: Path) -> None:
    """Drop the rows of a log beyond ``steps``: a resumed run writes them again.

    A row cut short by a crash is the log's last and newer than the checkpoint, so it goes, too.

    Raises:
        OSError: the log cannot be written.
    """
    if not path.exists():
        return
    lines = path.read_bytes().splitlines(keepends=True)
    kept = [line for line in lines if _logged_steps(line) <= steps]
    if len(kept) < len(lines):
        write_text(path, b"".join(kept).decode())


def _logged_steps(line: bytes) -> float:
    """Steps at which a row was logged; infinite where it cannot be read."""
    try:
        return float(json.loads(line)["steps"])
    except (ValueError, KeyError, TypeError):
        return math.inf


def learn(model: Any, callback: RunCallback, until: int) -> bool:
    """Run SB3's learning loop up to ``until`` steps; False if it was interrupted before.

    Like ``OnPolicyAlgorithm.learn``, but it stops only between two updates, so that a checkpoint
    written then is complete.

    Raises:
        FloatingPointError: an update left a parameter that is not finite.
        WorkerError: too many worker faults; parameters and step count are those after the last
            update.
    """
    callback.init_callback(model)
    callback.on_training_start(locals(), globals())
    updated_at = model.num_timesteps
    try:
        while model.num_timesteps < until and not callback.run.interruption.due():
            model.collect_rollouts(model.env, callback, model.rollout_buffer, model.n_steps)
            model._update_current_progress_remaining(model.num_timesteps, until)
            model.train()
            updated_at = model.num_timesteps
            if not all(p.isfinite().all() for p in model.policy.parameters()):
                raise FloatingPointError(
                    f"the policy diverged at {updated_at} steps; --resume continues from the last "
                    "checkpoint, perhaps with a lower --set ppo.learning_rate"
                )
        callback.log()
    except WorkerError:
        # Nothing was learned from the steps since.
        model.num_timesteps = callback.num_timesteps = updated_at
        raise
    finally:
        callback.on_training_end()
    return bool(model.num_timesteps >= until)


def tensorboard_logger(folder: Path, steps: int) -> Logger:
    """SB3's logger, writing only TensorBoard event files, for a run that continues from ``steps``.

    It makes TensorBoard discard earlier events beyond ``steps``, because a killed run lost them.
    """
    output = TensorBoardOutputFormat(str(folder))
    restart = SessionLog(status=SessionLog.START)
    writer = cast(Any, output.writer.file_writer)  # torch declares no type for it
    writer.add_event(Event(step=steps + 1, session_log=restart))
    return Logger(str(folder), [output])
