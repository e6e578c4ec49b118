"""Ablation: measure what each part of the hierarchy contributes, on the same tiles and budget.

    python -m tdgc.ablate --out runs/ablation
    python -m tdgc.ablate --out runs/ablation --only full,trot --seeds 42,43
    python -m tdgc.ablate --out runs/alone --no-teacher

Each variant is a list of settings, trained from scratch by train_high.py and evaluated by
evaluate.py. Some variants are only evaluated, with the policy of ``full`` or with a scripted one.
If the command is stopped or killed at any moment, the same command continues where it was, also
within a training. A trial that fails is reported with its error, and the others are kept. The
results are ``ablation.json``, ``ablation.txt`` and ``ablation.png``.

Run it in the root of the repository, where the scripts are.
"""

import argparse
import hashlib
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tdgc.ablate.table import describe, rows
from tdgc.ablate.trials import Found, Runner, Tile, Trial
from tdgc.ablate.variants import Variant, variants
from tdgc.config import HighTrainConfig, read_json, with_overrides
from tdgc.errors import InputError, StoppedError, script
from tdgc.files import make_folder, write_json, write_text
from tdgc.learn.run import sole_user
from tdgc.parallel.cores import workers_flag
from tdgc.show import plots
from tdgc.sim.terrain import EDITION, family_number, is_map
from tdgc.tasks.pairing import PRETRAINED, load_low

#: Settings of a training that have a flag of their own here.
_FLAGS = {"seed": "--seeds", "steps": "--steps", "workers": "--workers", "low": "--low"}


def parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m tdgc.ablate", description=(__doc__ or "").partition("\n")[0]
    )
    taught, alone = (
        ", ".join(variant.name for variant in variants(alone)) for alone in (False, True)
    )
    trials = parser.add_argument_group("trials")
    trials.add_argument(
        "--only",
        metavar="NAMES",
        help=f"comma-separated, of {taught}; with --no-teacher of {alone} (all)",
    )
    trials.add_argument("--seeds", default="42", help="training seeds, e.g. 42,43 (42)")
    training = parser.add_argument_group("training")
    training.add_argument("--steps", type=int, help="decisions per training (as train_high.py)")
    training.add_argument(
        "--low", type=Path, default=PRETRAINED / "low", help="low policy (shipped)"
    )
    training.add_argument(
        "--no-teacher", action="store_true", help="train all variants without a teacher"
    )
    training.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="assignments",
        help="setting for all trainings, as in train_high.py; may be repeated",
    )  # fmt: skip
    evaluation = parser.add_argument_group("evaluation")
    evaluation.add_argument("--levels", default="6-10", help="levels to evaluate (6-10)")
    evaluation.add_argument("--episodes", type=int, default=100, help="per family and level (100)")
    run = parser.add_argument_group("run")
    run.add_argument(
        "--out", type=Path, default=Path("runs/ablation"), help="results folder (runs/ablation)"
    )
    run.add_argument("--time-limit", type=float, metavar="S", help="stop after S seconds (never)")
    run.add_argument(
        "--workers", type=workers_flag, default="auto", metavar="N", help="processes (one per core)"
    )
    return parser.parse_args(arguments)


def choose(only: str | None, allowed: Sequence[Variant]) -> list[Variant]:
    """The variants named by ``--only``, in the order of the table.

    Raises:
        InputError: a name is unknown.
    """
    names = [variant.name for variant in allowed]
    wanted = names if only is None else only.split(",")
    for name in wanted:
        if name not in names:
            raise InputError(f"unknown variant '{name}'; allowed: {', '.join(names)}")
    return [variant for variant in allowed if variant.name in wanted]


def choose_seeds(text: str) -> list[int]:
    """Parse the seeds of ``--seeds``, such as ``42,43``; duplicates are dropped.

    Raises:
        InputError: the text is not a list of numbers.
    """
    try:
        return list(dict.fromkeys(int(part) for part in text.split(",")))
    except ValueError:
        raise InputError(f"cannot read --seeds '{text}'; write e.g. 42,43") from None


def check_trainings(runner: Runner, chosen: Sequence[Variant], seeds: Sequence[int]) -> None:
    """Refuse invalid settings at once, not after hours of training.

    Raises:
        InputError: a setting cannot be used, or one that has a flag is among those of ``--set``.
    """
    for setting in runner.settings:
        name = setting.partition("=")[0].strip()
        if name in _FLAGS:
            raise InputError(f"--set cannot change '{name}' here; use {_FLAGS[name]}")
    steps = [] if runner.steps is None else [f"steps={runner.steps}"]
    with_overrides(HighTrainConfig(), [*steps, *(f"seed={seed}" for seed in seeds)])
    for variant in chosen:
        with_overrides(HighTrainConfig(), runner.training_settings(variant))


def without_missing(chosen: Sequence[Variant], low: Path, settings: Sequence[str]) -> list[Variant]:
    """Leave out what needs a low policy without its correction if it has none, and the policy
    right after imitation if the ``settings`` of all trainings leave imitation out.

    Raises:
        ConfigError: the low policy cannot be used.
    """
    missing = []
    if load_low(low)[0].correction is None:
        missing.append(("uncalibrated", f"'{low}' has no correction"))
    if not with_overrides(HighTrainConfig(), settings).imitation.steps:
        missing.append(("imitation", "nothing is imitated"))
    kept = list(chosen)
    for what, why in missing:
        left_out = [variant for variant in kept if what in (variant.low, variant.high)]
        if left_out:
            print(f"{' and '.join(variant.name for variant in left_out)} left out: {why}")
        kept = [variant for variant in kept if variant not in left_out]
    return kept


def plan(chosen: Sequence[Variant], seeds: Sequence[int]) -> list[Trial]:
    """All trials, seed by seed; scripted policies have no seed and run once, with the first."""
    return [
        Trial(variant, seed if variant.policy == "tdgc" else None)
        for seed in seeds
        for variant in chosen
        if variant.policy == "tdgc" or seed == seeds[0]
    ]


def claim(runner: Runner, tiles: Sequence[Tile]) -> dict[str, Any]:
    """What all trials in the folder have in common, recorded there by the first call.

    Raises:
        InputError: the folder holds trials that cannot be compared with these, or the low policy
            cannot be used.
    """
    digest = hashlib.sha256()
    for name, tensor in sorted(load_low(runner.low)[0].tensors.items()):
        digest.update(name.encode() + tensor.numpy().tobytes())
    common = {
        "low": str(runner.low),
        "low_sha256": digest.hexdigest(),  # it may have been trained further meanwhile
        "no_teacher": runner.alone,
        "settings": list(runner.settings),
        "steps": runner.steps,
        "levels": runner.levels,
        "episodes": runner.episodes,
        "edition": EDITION,
        "maps": {family: family_number(family) for family, *_ in tiles if is_map(family)},
    }
    path = runner.out / "settings.json"
    if not path.is_file():
        make_folder(runner.out)
        write_json(path, common)
        return common
    before = read_json(path)
    if not isinstance(before, dict):
        raise InputError(f"{path}: not the settings of an ablation")
    for name, value in common.items():
        if before.get(name) != value:
            raise InputError(
                f"'{runner.out}' holds an ablation with {name} {before.get(name)}, not {value}; "
                "use another --out"
            )
    return common


def report(
    out: Path,
    common: dict[str, Any],
    tiles: Sequence[Tile],
    trials: Sequence[Trial],
    found: Mapping[Trial, Found],
) -> str:
    """Write ablation.json, ablation.txt and ablation.png; return the text.

    They have a row for each variant of ``trials`` and for each other that was ``found``.
    """
    order = variants(common["no_teacher"])
    every = sorted(dict.fromkeys([*trials, *found]), key=lambda trial: order.index(trial.variant))
    table = rows(tiles, every, found)
    described = describe(table)
    write_json(out / "ablation.json", {"settings": common, "rows": table})
    write_text(out / "ablation.txt", f"{described}\n")
    plots.ablation(out / "ablation.json", out / "ablation.png")
    return described


def finished(runner: Runner) -> list[Trial]:
    """The trials in the folder that were finished, now or by earlier calls."""
    done: list[Trial] = []
    for variant in variants(runner.alone):
        seeds: Sequence[int | None] = [None]
        if variant.policy == "tdgc":
            ends = (path.name.removeprefix(f"{variant.name}-") for path in runner.out.iterdir())
            seeds = sorted(int(end) for end in ends if end.isdecimal())
        done += [trial for seed in seeds if runner.done(trial := Trial(variant, seed))]
    return done


def conduct(
    runner: Runner, trials: Sequence[Trial], common: dict[str, Any], tiles: Sequence[Tile]
) -> tuple[dict[Trial, Found], bool]:
    """Run ``trials`` one after the other, and write a report after each.

    Returns:
        The results of all trials in the folder that were run, now or before; and whether all of
        ``trials`` were run: False after a signal or at the time limit.
    """
    found = {trial: runner.run(trial) for trial in finished(runner)}
    for trial in trials:
        if trial in found:
            continue
        print(f"{trial.name}: {trial.variant.what}", flush=True)
        try:
            found[trial] = runner.run(trial)
        except StoppedError:
            return found, False
        report(runner.out, common, tiles, trials, found)
    return found, True


@script("tdgc.ablate")
def main(arguments: list[str] | None = None) -> int:
    args = parse(arguments)
    deadline = None if args.time_limit is None else time.monotonic() + args.time_limit
    runner = Runner(
        args.out, args.low, args.no_teacher, tuple(args.assignments), args.steps, args.levels,
        args.episodes, args.workers, deadline,
    )  # fmt: skip
    if args.time_limit is not None and not args.time_limit >= 0.0:
        raise InputError(f"--time-limit must be at least 0 s, not {args.time_limit:g}")
    chosen, seeds = choose(args.only, variants(args.no_teacher)), choose_seeds(args.seeds)
    check_trainings(runner, chosen, seeds)
    if args.only is None:
        chosen = without_missing(chosen, args.low, runner.settings)
    tiles, trials = runner.tiles(), plan(chosen, seeds)
    common = claim(runner, tiles)
    with sole_user(args.out):
        found, finished = conduct(runner, trials, common, tiles)
        print(report(args.out, common, tiles, trials, found))
    if not finished:
        print("stopped; run the same command to continue")
    asked = {trial.name: found.get(trial) for trial in trials}
    failed = {name: message for name, message in asked.items() if isinstance(message, str)}
    for name, message in failed.items():
        print(f"tdgc.ablate: {name}: {message}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
