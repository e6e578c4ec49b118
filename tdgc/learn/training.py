"""What both trainers share: the run folder, checkpoints, logs, interruption, the loop.

A run folder holds ``config.json``, ``log.jsonl`` (a row every ``log_steps``), TensorBoard's event
files, ``policy.safetensors`` with ``policy.json`` (the last policy, ready to be used) and
``checkpoints/`` with the two newest states, from which a run goes on, in the middle of its
episodes, as if it had not been stopped.
"""

from __future__ import annotations

import argparse
import dataclasses
import errno
import hashlib
import json
import math
import os
import random
import shutil
import signal
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any, Protocol, cast

import numpy as np
import safetensors
import safetensors.torch
import torch as th
from numpy.typing import NDArray
from sb3_contrib.common.recurrent.type_aliases import RNNStates
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.policies import ActorCriticPolicy
from tqdm import tqdm

from tdgc import __version__, policies
from tdgc.config import Config, ConfigError, read_json, recorded, to_dict, with_overrides
from tdgc.errors import InputError
from tdgc.parallel.cluster import CLUSTER_HELP, ActorLink, check_workers, connect
from tdgc.parallel.cores import auto_workers, usable_cores, workers_flag
from tdgc.parallel.vec import TaskVecEnv, lasting
from tdgc.parallel.worker import MakeLink, ProcessLink, WorkerError, memory_mb
from tdgc.state import State, join, split

_KEEP = 2  # checkpoints: the newest, and one before it should that be damaged
_VERSION = 3
#: Names of what the recurrent learner remembers of the episodes under way.
_LSTM = ("lstm.pi.h", "lstm.pi.c", "lstm.vf.h", "lstm.vf.c")


class CheckpointError(InputError):
    """A checkpoint or run folder that cannot be used; the message is one line."""


# ---------------------------------------------------------------------------- checkpoints


def _random_states() -> tuple[dict[str, th.Tensor], dict[str, Any]]:
    name, keys, position, has_gauss, gauss = np.random.get_state(legacy=True)
    version, words, carry = random.getstate()
    states = {"numpy": [position, has_gauss, gauss], "python": [version, carry], "kind": name}
    tensors = {
        "random.torch": th.get_rng_state(),
        "random.numpy": th.from_numpy(np.asarray(keys).astype(np.int64)),
        "random.python": th.tensor(words, dtype=th.int64),
    }
    return tensors, states


def _restore_random(tensors: dict[str, th.Tensor], states: dict[str, Any]) -> None:
    th.set_rng_state(tensors["random.torch"].to(th.uint8))
    keys = tensors["random.numpy"].numpy().astype(np.uint32)
    np.random.set_state((states["kind"], keys, *states["numpy"]))
    version, carry = states["python"]
    random.setstate((version, tuple(tensors["random.python"].tolist()), carry))


def snapshot(
    model: BaseAlgorithm, extra: dict[str, Any]
) -> tuple[dict[str, th.Tensor], dict[str, Any]]:
    """The learner's whole state and ``extra`` as tensors and header, see ``load_learner`` and
    ``workers_of``."""
    tensors = {f"policy.{k}": v for k, v in model.policy.state_dict().items()}
    optimiser = model.policy.optimizer.state_dict()
    for index, slots in optimiser["state"].items():
        tensors |= {f"optimizer.{index}.{k}": th.as_tensor(v) for k, v in slots.items()}
    memory: RNNStates | None = getattr(model, "_last_lstm_states", None)
    if memory is not None:
        tensors |= zip(_LSTM, (*memory.pi, *memory.vf), strict=True)
    arrays: dict[str, NDArray[Any]] = {}
    extra = split(extra, "extra", arrays)
    tensors |= {name: th.from_numpy(array) for name, array in arrays.items()}
    random_tensors, random_states = _random_states()
    header = {
        "format": "tdgc-checkpoint",
        "version": _VERSION,
        "code": __version__,
        "num_timesteps": model.num_timesteps,
        "n_updates": model._n_updates,
        "random": random_states,
        **extra,
    }
    return tensors | random_tensors, header


def _checksum(data: bytes, header: dict[str, Any]) -> str:
    """Of the tensors' file and of all that stands beside it in the header."""
    rest = {key: value for key, value in header.items() if key != "sha256"}
    return hashlib.sha256(data + json.dumps(rest, sort_keys=True).encode()).hexdigest()


def save_checkpoint(folder: Path, tensors: dict[str, th.Tensor], header: dict[str, Any]) -> Path:
    """Write a snapshot; a reader sees it complete or not at all.

    Raises:
        OSError: it cannot be written; those before it are left as they are.
    """
    data = safetensors.torch.save({k: v.contiguous() for k, v in tensors.items()})
    header = json.loads(json.dumps(header))  # as a reader will have it
    text = json.dumps({**header, "sha256": _checksum(data, header)})
    final = folder / f"step-{header['num_timesteps']:012d}"
    partial = folder / f".{final.name}.partial"
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        for name, content in (("state.safetensors", data), ("state.json", text.encode())):
            with open(partial / name, "wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
        shutil.rmtree(final, ignore_errors=True)
        os.replace(partial, final)
    except OSError:
        shutil.rmtree(partial, ignore_errors=True)  # it may be what fills the disk
        raise
    for old in sorted(folder.glob("step-*"))[:-_KEEP]:
        shutil.rmtree(old)
    return final


def read_checkpoint(path: Path) -> tuple[dict[str, th.Tensor], dict[str, Any]]:
    """Tensors and header of one checkpoint.

    Raises:
        CheckpointError: missing, damaged or foreign files.
    """
    try:
        data = (path / "state.safetensors").read_bytes()
        header = json.loads((path / "state.json").read_bytes())
        known = isinstance(header, dict) and header.get("format") == "tdgc-checkpoint"
        if not known or header.get("version") != _VERSION:
            raise CheckpointError(f"{path}: not a tdgc checkpoint of version {_VERSION}")
        for counter in ("num_timesteps", "n_updates"):
            if type(header.get(counter)) is not int or not 0 <= header[counter] < 2**63:
                raise CheckpointError(f"{path}: '{counter}' is no count")
        if _checksum(data, header) != header["sha256"]:
            raise CheckpointError(f"{path}: its checksum does not match, it is damaged")
        return safetensors.torch.load(data), header
    except CheckpointError:
        raise
    except (OSError, ValueError, KeyError, RuntimeError, safetensors.SafetensorError) as error:
        raise CheckpointError(f"{path}: cannot be read: {error}") from error


def newest_checkpoint(
    run: Path, warn: Callable[[str], None]
) -> tuple[dict[str, th.Tensor], dict[str, Any]]:
    """The newest checkpoint of a run that can be read; damaged ones are passed over with a word.

    Raises:
        CheckpointError: the run has none.
    """
    for path in sorted((run / "checkpoints").glob("step-*"), reverse=True):
        try:
            return read_checkpoint(path)
        except CheckpointError as error:
            warn(f"{error}; trying the one before")
    raise CheckpointError(f"{run}: no checkpoint that can be read")


def load_learner(
    model: BaseAlgorithm, tensors: dict[str, th.Tensor], header: dict[str, Any]
) -> None:
    """Put a checkpoint's parameters, optimiser, counters and random states into ``model``.

    Raises:
        CheckpointError: parameters of another shape or name.
    """
    try:
        model.policy.load_state_dict(
            {k.removeprefix("policy."): v for k, v in tensors.items() if k.startswith("policy.")}
        )
        state = model.policy.optimizer.state_dict()
        state["state"] = {}
        for key, value in tensors.items():
            if key.startswith("optimizer."):
                _, index, slot = key.split(".")
                state["state"].setdefault(int(index), {})[slot] = value
        model.policy.optimizer.load_state_dict(state)
    except (RuntimeError, KeyError, ValueError) as error:
        line = str(error).splitlines()[0]
        raise CheckpointError(f"the checkpoint does not fit the configuration: {line}") from error
    if _LSTM[0] in tensors:
        h_pi, c_pi, h_vf, c_vf = (tensors[name].to(model.device) for name in _LSTM)
        cast(Any, model)._last_lstm_states = RNNStates(pi=(h_pi, c_pi), vf=(h_vf, c_vf))
    model.num_timesteps = int(header["num_timesteps"])
    model._n_updates = int(header["n_updates"])
    _restore_random(tensors, header["random"])


def workers_of(tensors: dict[str, th.Tensor], header: dict[str, Any]) -> list[State]:
    """The workers' states of a checkpoint, see ``TaskVecEnv.load_state_dicts``."""
    arrays = {k: v.numpy() for k, v in tensors.items() if k.startswith("extra.")}
    states: list[State] = join(header["workers"], arrays)
    return states


# ---------------------------------------------------------------------------- the loop


class Interruption:
    """Turns SIGINT, SIGTERM and a time limit into one flag that the loop looks at."""

    def __init__(self, time_limit: float | None) -> None:
        self.reason: str | None = None
        self._deadline = None if time_limit is None else time.monotonic() + time_limit
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._on_signal)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if self.reason is not None:  # asked twice: stop at once
            raise KeyboardInterrupt
        self.reason = signal.Signals(number).name

    def due(self) -> bool:
        """Whether to stop now."""
        if self.reason is None and self._deadline is not None:
            if time.monotonic() > self._deadline:
                self.reason = "the time limit"
        return self.reason is not None

    def tell(self, run: Path) -> None:
        """Say what stopped the run in the folder ``run``, and how it goes on."""
        tqdm.write(f"stopped by {self.reason}; --resume --out {run} goes on")


class RunCallback(BaseCallback):
    """Progress, logs and checkpoints of a run.

    Args:
        run: its folder.
        env: the workers.
        meta: goes into the policy's file: configuration, seed.
        summarise: (sums of all workers) -> values to log.
        interruption: when to stop.
        log_steps: control steps between log rows.
        checkpoint_seconds: wall time between checkpoints.
        seconds_before: wall time of the run so far.

    Attributes:
        unsaved: why the last checkpoint could not be written, or None.
    """

    def __init__(
        self,
        run: Path,
        env: TaskVecEnv,
        meta: dict[str, Any],
        summarise: Callable[[dict[str, float]], dict[str, float]],
        interruption: Interruption,
        log_steps: int,
        checkpoint_seconds: float,
        total_steps: int,
        seconds_before: float = 0.0,
        phase: int = 0,
        name: str | None = None,
    ) -> None:
        super().__init__()
        self.run, self.env, self.meta = run, env, meta
        self.summarise, self.interruption = summarise, interruption
        self.log_steps, self.checkpoint_seconds = log_steps, checkpoint_seconds
        self.total_steps = total_steps
        self.phase, self._name = phase, name
        self._started = time.monotonic() - seconds_before
        self._saved_at = 0.0
        self._logged_at = (0, 0.0)
        self._bar: Any = None
        self._faults: list[dict[str, Any]] = []  # since the last log row
        self._tensorboard_failed = False
        self.unsaved: OSError | None = None

    @property
    def seconds(self) -> float:
        """Wall time of the run, over all its pieces."""
        return time.monotonic() - self._started

    def _on_training_start(self) -> None:
        self._saved_at = self.seconds
        self._logged_at = (self.num_timesteps, self.seconds)
        self._bar = tqdm(
            desc=self._name,
            total=self.total_steps,
            initial=self.num_timesteps,
            unit="step",
            unit_scale=True,
            mininterval=2.0,
            dynamic_ncols=True,
        )

    def _on_rollout_start(self) -> None:
        # Between an update and the next rollout the learner's state is whole. The workers forget in
        # every run at every rollout, so that a checkpoint may be written at any or at none.
        self.env.forget()
        if self.seconds - self._saved_at >= self.checkpoint_seconds:
            self.save()
            self._saved_at = self.seconds

    def _on_step(self) -> bool:
        self.tell_faults()
        return True

    def tell_faults(self) -> None:
        """Tell of the workers that were started anew, and keep it for the next log row."""
        while self.env.faults:
            fault = self.env.faults.pop(0)
            tqdm.write(str(fault))
            self._faults.append({"steps": self.num_timesteps, **dataclasses.asdict(fault)})

    def _on_rollout_end(self) -> None:
        self._bar.update(self.num_timesteps - self._bar.n)
        if self.num_timesteps - self._logged_at[0] >= self.log_steps:
            self._log()

    def save(self) -> tuple[dict[str, th.Tensor], dict[str, Any]]:
        """Write the policy and a checkpoint, or tell why not; returns the snapshot."""
        states = self.env.state_dicts()
        extra = {"workers": states, "seconds": self.seconds, "phase": self.phase}
        taken = snapshot(self.model, extra)
        steps = self.model.num_timesteps
        meta = {**self.meta, "steps": steps, "seconds": round(self.seconds)}
        try:
            # The policy first: it is refused when it is not finite, and a checkpoint should be.
            policies.save(self.run / "policy", cast(ActorCriticPolicy, self.model.policy), meta)
            save_checkpoint(self.run / "checkpoints", *taken)
            self.unsaved = None
        except OSError as error:
            self.unsaved = error
            tqdm.write(f"no checkpoint at {steps} steps, the one before stays: {error}")
        return taken

    def _log(self) -> None:
        sums: dict[str, float] = {}
        for part in self.env.stats():
            for key, value in part.items():
                sums[key] = sums.get(key, 0.0) + value
        values = self.summarise(sums)
        steps, seconds = self._logged_at
        values["time/steps_per_s"] = (self.num_timesteps - steps) / (self.seconds - seconds)
        lengths = [e["l"] for e in self.model.ep_info_buffer or ()]
        if lengths:
            returns = [e["r"] for e in self.model.ep_info_buffer or ()]
            values["episode/return"] = float(np.mean(returns))
            values["episode/length"] = float(np.mean(lengths))
        for name in (
            "imitation_loss", "value_loss", "policy_gradient_loss", "approx_kl", "clip_fraction",
            "std", "learning_rate",
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
        row |= {k: _short(v) for k, v in values.items()} | {"faults": self._faults}
        try:
            append_line(self.run / "log.jsonl", json.dumps(row))
            if self._tensorboard_failed:  # its writer never recovers from an error
                self.model.set_logger(tensorboard_logger(self.run / "tensorboard"))
            for key, value in values.items():
                self.logger.record(key, value)
            self.logger.dump(self.num_timesteps)
            self._faults, self._tensorboard_failed = [], False
        except OSError as error:
            self._tensorboard_failed = True
            tqdm.write(f"no log row at {self.num_timesteps} steps: {error}")
        self._logged_at = (self.num_timesteps, self.seconds)

    def _on_training_end(self) -> None:
        self._bar.close()


def _short(value: float) -> float:
    return float(f"{value:.5g}")


def append_line(path: Path, line: str) -> None:
    """Add a line to a file, all of it or nothing.

    Raises:
        OSError: it cannot be written.
    """
    data = f"{line}\n".encode()
    with open(path, "ab", buffering=0) as file:
        end = file.tell()
        if file.write(data) < len(data):  # the disk had room for a part
            file.truncate(end)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))


def attach(model: BaseAlgorithm, env: TaskVecEnv) -> None:
    """Show the learner what the robots saw last."""
    model._last_obs, model._last_episode_starts = env.seen(), env.starts()
    model.ep_info_buffer, model.ep_success_buffer = deque(maxlen=100), deque(maxlen=100)


def learn(model: Any, callback: RunCallback, until: int) -> bool:
    """SB3's learning loop, up to ``until`` steps; False when it was interrupted.

    Like ``OnPolicyAlgorithm.learn``, but it stops between two updates and never inside one, so
    that a checkpoint written then is whole.

    Raises:
        WorkerError: too many faults of workers; the learner is as after the last update.
    """
    model._total_timesteps = until
    callback.init_callback(model)
    callback.on_training_start(locals(), globals())
    updated_at = model.num_timesteps
    try:
        while model.num_timesteps < until and not callback.interruption.due():
            model.collect_rollouts(model.env, callback, model.rollout_buffer, model.n_steps)
            model._update_current_progress_remaining(model.num_timesteps, until)
            model.train()
            updated_at = model.num_timesteps
    except WorkerError:
        model.num_timesteps = updated_at  # nothing was learned from the steps since
        raise
    finally:
        callback.on_training_end()
    return bool(model.num_timesteps >= until)


def tensorboard_logger(folder: Path) -> Logger:
    """SB3's logger, writing TensorBoard's event files only."""
    from stable_baselines3.common.logger import TensorBoardOutputFormat

    return Logger(str(folder), [TensorBoardOutputFormat(str(folder))])


# ---------------------------------------------------------------------------- the scripts


class TrainConfig(Protocol):
    """What the configurations of both trainers have in common."""

    @property
    def steps(self) -> int: ...

    @property
    def log_steps(self) -> int: ...

    @property
    def checkpoint_seconds(self) -> float: ...


@dataclass(frozen=True)
class Phase:
    """A stretch of a run with its own environment.

    Attributes:
        name: for the progress bar.
        build: makes the learner and its workers, given their ``timeout`` and what starts one.
        until: steps of the run at which the phase ends.
    """

    name: str
    build: Callable[[float, MakeLink], tuple[Any, TaskVecEnv]]
    until: int


def add_arguments(parser: argparse.ArgumentParser, out: str) -> None:
    """The flags of both trainers; ``out`` is the default run folder."""
    parser.add_argument("--seed", type=int, help="of everything random (42)")
    parser.add_argument("--n-envs", type=int, help="robots altogether")
    parser.add_argument(
        "--workers", type=workers_flag, metavar="N",
        help="processes that simulate, or auto: one a core, each with 10 robots at least",
    )  # fmt: skip
    parser.add_argument(
        "--worker-timeout", type=float, default=300.0, metavar="S",
        help="start a worker anew that is silent for S seconds (300)",
    )  # fmt: skip
    parser.add_argument("--cluster", metavar="ADDRESS", help=CLUSTER_HELP)
    parser.add_argument("--steps", type=int, help="steps altogether")
    parser.add_argument("--time-limit", type=float, metavar="S", help="stop after S seconds")
    parser.add_argument("--device", default="cpu", help="where the learner runs (cpu)")
    parser.add_argument("--out", type=Path, default=Path(out), help=f"run folder ({out})")
    parser.add_argument("--resume", action="store_true", help="go on with the run in --out")
    parser.add_argument("--init", type=Path, help="start from this policy instead of anew")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="assignments",
        help="change the configuration, e.g. ppo.n_steps=48",
    )  # fmt: skip


def configure(config: Config, args: argparse.Namespace) -> Config:
    """Configuration of the run: the folder's when resuming, else ``config``, then the flags.

    With ``--cluster`` this process joins it.

    Raises:
        ConfigError: nothing to resume, a folder in use, or an assignment that cannot be used.
        ClusterError: a cluster that cannot be used, or has fewer CPUs than there are workers.
    """
    stored = args.out / "config.json"
    if args.resume:
        if not stored.is_file():
            raise ConfigError(f"--resume: no run in '{args.out}' (config.json is missing)")
        try:
            config = recorded(type(config), read_json(stored), stored)
        except ConfigError as error:
            raise ConfigError(
                f"{error}; a run of another version cannot go on: start one in another folder, "
                f"with --init {args.out / 'policy'} to begin from its policy"
            ) from error
    elif stored.exists():
        raise ConfigError(f"'{args.out}' holds a run already; use --resume or another --out")
    flags = {k: getattr(args, k) for k in ("seed", "n_envs", "workers", "steps")}
    given = [f"{k}={v}" for k, v in flags.items() if v not in (None, "auto")]
    config = with_overrides(config, [*given, *args.assignments])
    cores = usable_cores() if args.cluster is None else connect(args.cluster)
    if args.workers == "auto" and not args.resume:  # a run goes on with as many as it began with
        workers = auto_workers(to_dict(config)["n_envs"], cores)
        config = with_overrides(config, [f"workers={workers}"])
    workers = to_dict(config)["workers"]
    if args.cluster is not None:
        check_workers(workers, cores)
    return config


def run(
    args: argparse.Namespace,
    config: TrainConfig,
    phases: Sequence[Phase],
    meta: dict[str, Any],
    summarise: Callable[[dict[str, float]], dict[str, float]],
    interruption: Interruption,
) -> bool:
    """Train through the phases, or go on with them; False when interrupted.

    Args:
        args: the flags of ``add_arguments``.
        config: of the whole run; written to the run folder.
        phases: in order.
        meta: goes into the policy's file.
        summarise: sums of all workers -> values to log.
        interruption: when to stop.

    Raises:
        CheckpointError: nothing to resume that can be read.
        ValueError: a policy of ``--init`` that does not fit.
        WorkerError: too many faults of workers; a checkpoint was written.
        OSError: files that cannot be written, among them the last checkpoint.
    """
    carried = newest_checkpoint(args.out, tqdm.write) if args.resume else None
    if args.init is not None:
        policies.load(args.init)  # before anything is written
    args.out.mkdir(parents=True, exist_ok=True)
    (args.out / "config.json").write_text(json.dumps(to_dict(config), indent=2), encoding="utf-8")
    link: MakeLink = ProcessLink if args.cluster is None else ActorLink
    seconds = float(carried[1]["seconds"]) if carried else 0.0
    finished, unsaved = True, None
    for number, phase in enumerate(phases):
        if carried is not None and int(carried[1]["num_timesteps"]) >= phase.until:
            continue
        model, env = phase.build(args.worker_timeout, link)
        try:
            model.set_logger(tensorboard_logger(args.out / "tensorboard"))
            callback = RunCallback(
                args.out, env, meta, summarise, interruption, config.log_steps,
                config.checkpoint_seconds, config.steps, seconds, number, phase.name,
            )  # fmt: skip
            if carried is not None:
                load_learner(model, *carried)
            elif args.init is not None:
                policies.load_into(args.init, model.policy)
            if carried is None:
                env.reset()
            else:
                states = workers_of(*carried)
                if carried[1]["phase"] != number:  # episodes end with a phase, levels go on
                    states = [lasting(state) for state in states]
                env.load_state_dicts(states)
            attach(model, env)
            try:
                finished = learn(model, callback, phase.until)
            except WorkerError:
                callback.tell_faults()
                callback.save()
                raise
            carried = callback.save()
            seconds, unsaved = callback.seconds, callback.unsaved
        finally:
            env.close()
        if not finished:
            break
    if unsaved is not None:
        raise unsaved
    if not finished:
        interruption.tell(args.out)
    return finished
