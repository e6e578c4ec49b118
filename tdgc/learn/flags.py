"""Command-line flags shared by both trainers, and the configuration built from them."""

import argparse
import functools
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import torch as th

from tdgc import policies
from tdgc.config import (
    ConfigError,
    HighTrainConfig,
    LowTrainConfig,
    read_json,
    recorded,
    to_dict,
    with_overrides,
)
from tdgc.parallel.cluster import CLUSTER_HELP, ActorLink, check_workers, connect
from tdgc.parallel.cores import auto_workers, usable_cores, workers_flag
from tdgc.parallel.worker import MakeLink, ProcessLink

_LONGEST = 86400.0  # s, of a worker's silence: one day; waiting on a pipe overflows at 25 days
TrainConfig = TypeVar("TrainConfig", LowTrainConfig, HighTrainConfig)
_TRAINERS = {LowTrainConfig: "train_low.py", HighTrainConfig: "train_high.py"}
#: Settings that a resumed run cannot change: they act when a run begins, or shape its workers or
#: the ground, on which episodes are under way.
_AT_START = (
    "seed", "n_envs", "workers", "start_speed", "start_swing", "ppo.initial_std",
    "ppo.initial_gait_std", "env.first_level", "env.first_levels", "env.command_start",
    "env.families", "env.shallowest_trench", "env.crossing.shallowest_trench",
)  # fmt: skip
#: Settings that it can change, but not switch on or off, and their values that are off: what they
#: need is kept with the policy.
_SWITCHES = {"ppo.desired_kl": None, "ppo.gait_hold": 1}


class Machine(NamedTuple):
    """Where a run learns and collects.

    Attributes:
        device: PyTorch device of the learner.
        timeout: s, after which a silent worker is restarted.
        link: how workers are started.
    """

    device: str
    timeout: float
    link: MakeLink

    @classmethod
    def of(cls, args: argparse.Namespace) -> "Machine":
        """From the flags; with ``--cluster`` workers are Ray actors, otherwise processes here."""
        link: MakeLink = ProcessLink if args.cluster is None else ActorLink
        return cls(args.device, args.worker_timeout, link)


def add_arguments(
    parser: argparse.ArgumentParser, out: str, config: TrainConfig, unit: str
) -> None:
    """Add the flags of both trainers.

    Args:
        parser: to add them to.
        out: default run folder.
        config: source of all other defaults.
        unit: what ``--steps`` counts, for the help text.
    """
    training = parser.add_argument_group("training")
    training.add_argument("--steps", type=int, help=f"total number of {unit} ({config.steps})")
    training.add_argument("--n-envs", type=int, help=f"number of robots ({config.n_envs})")
    training.add_argument("--seed", type=int, help=f"random seed ({config.seed})")
    training.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="assignments",
        help="override a setting of tdgc/config, e.g. ppo.n_epochs=4; may be repeated",
    )  # fmt: skip
    training.add_argument(
        "--init", type=Path, help="start from this policy instead of from scratch"
    )
    run = parser.add_argument_group("run")
    run.add_argument("--out", type=Path, default=Path(out), help=f"run folder ({out})")
    run.add_argument("--resume", action="store_true", help="continue the run in --out")
    run.add_argument("--time-limit", type=float, metavar="S", help="stop after S seconds (never)")
    machine = parser.add_argument_group("machine")
    machine.add_argument(
        "--workers", type=workers_flag, metavar="N",
        help="simulation processes, or auto: one per core, with at least 10 robots each "
        f"({config.workers})",
    )  # fmt: skip
    machine.add_argument(
        "--worker-timeout", type=float, default=300.0, metavar="S",
        help="restart a worker that is silent for S seconds (300)",
    )  # fmt: skip
    machine.add_argument("--device", default="cpu", help="PyTorch device of the learner (cpu)")
    machine.add_argument("--cluster", metavar="ADDRESS", help=CLUSTER_HELP)


def configure(config: TrainConfig, args: argparse.Namespace) -> TrainConfig:
    """Build the run's configuration: the stored one when resuming, else ``config``, then the flags.

    With ``--cluster`` this process joins the cluster.

    Raises:
        ConfigError: nothing to resume, a run folder already in use, or an invalid flag.
        PolicyFileError: the policy of ``--init`` cannot be read.
        ClusterError: the cluster cannot be used, or has fewer CPUs than there are workers.
    """
    stored = args.out / "config.json"
    if not 0.0 < args.worker_timeout <= _LONGEST:
        raise ConfigError(
            f"--worker-timeout must be above 0 and at most {_LONGEST:g}, "
            f"not {args.worker_timeout:g}"
        )
    if args.time_limit is not None and not args.time_limit >= 0.0:
        raise ConfigError(f"--time-limit must be at least 0 s, not {args.time_limit:g}")
    check_device(args.device)
    if args.resume:
        if args.init is not None:
            raise ConfigError("--resume keeps the run's policy: no --init")
        if not stored.is_file():
            raise ConfigError(f"--resume: no run in '{args.out}' (config.json is missing)")
        table = read_json(stored)
        try:
            config = recorded(type(config), table, stored)
        except ConfigError as error:
            for other, script in _TRAINERS.items():
                if _fits(other, table):
                    raise ConfigError(f"--resume: '{args.out}' holds a run of {script}") from None
            raise ConfigError(
                f"{error}; a run of another version cannot be resumed: start one in another "
                f"folder, with --init {args.out / 'policy'} to begin from its policy"
            ) from error
    elif _has_begun(args.out):
        either = "--resume or " if stored.exists() else ""
        raise ConfigError(f"'{args.out}' holds a run already; use {either}another --out")
    if args.init is not None:
        policies.load(args.init)  # fail before anything is written
    flags = {k: getattr(args, k) for k in ("seed", "n_envs", "workers", "steps")}
    given: list[str] = [f"{k}={v}" for k, v in flags.items() if v not in (None, "auto")]
    before, config = config, with_overrides(config, [*given, *args.assignments])
    if args.resume:
        _keep_start(to_dict(before), to_dict(config))
    cores = usable_cores() if args.cluster is None else connect(args.cluster)
    own = any(text.partition("=")[0].strip() == "workers" for text in args.assignments)
    # A resumed run keeps its number of workers.
    if args.workers == "auto" and not args.resume and not own:
        workers = auto_workers(config.n_envs, cores)
        config = with_overrides(config, [f"workers={workers}"])
    if args.cluster is not None:
        check_workers(config.workers, cores)
    if config.workers > config.n_envs:
        raise ConfigError(f"workers must be 1 to the {config.n_envs} robots, not {config.workers}")
    return config


def _keep_start(before: Any, now: Any) -> None:
    """Check that a resumed run does not change a setting of ``_AT_START`` or ``_SWITCHES``.

    Raises:
        ConfigError: names the setting and its value.
    """
    for name in _AT_START:
        then, new = (_setting(name.split("."), table) for table in (before, now))
        if then != new:
            raise ConfigError(f"--resume keeps the run's {name}, {then}: no other {name}")
    for name, off in _SWITCHES.items():
        then, new = (_setting(name.split("."), table) for table in (before, now))
        if (then == off) != (new == off):
            raise ConfigError(f"--resume cannot change {name} from {then} to {new}")


def _setting(path: list[str], table: Any) -> Any:
    """The entry of nested tables at ``path``, or None if this kind of run has no such setting."""
    return functools.reduce(lambda part, key: (part or {}).get(key), path, table)


def _fits(kind: type[LowTrainConfig] | type[HighTrainConfig], table: Any) -> bool:
    """Whether ``table`` is a whole configuration of this kind."""
    try:
        recorded(kind, table, "")
    except ConfigError:
        return False
    return True


def _has_begun(run: Path) -> bool:
    """Whether there is anything to lose in a run folder: a checkpoint, a log or a policy."""
    files = any((run / name).exists() for name in ("log.jsonl", "policy.json"))
    return files or any((run / "checkpoints").glob("step-*"))


def check_device(name: str) -> None:
    """Check that PyTorch has the device, because SB3 falls back to the CPU if a GPU is missing.

    Raises:
        ConfigError: the device is unknown or missing.
    """
    try:
        kind = "cpu" if name == "auto" else th.device(name).type
        if kind == "cuda" and not th.cuda.is_available():
            raise RuntimeError("PyTorch finds no GPU here")
        if kind not in ("cpu", "cuda"):
            raise RuntimeError("train on cpu or cuda")
        if name != "auto":
            th.zeros(1, device=name)
    except (RuntimeError, AssertionError) as error:
        raise ConfigError(f"--device {name}: {str(error).splitlines()[0]}") from None
