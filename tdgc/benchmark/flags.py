"""Flags shared by the evaluations in all simulators: episodes, workers and results folder."""

import argparse
import itertools
from pathlib import Path
from typing import NamedTuple, TypeAlias

from tdgc.parallel.cores import usable_cores, workers_flag
from tdgc.sim.families import ALL_FAMILIES, FAMILIES, OOD_LEVELS
from tdgc.sim.terrain import MAP_ENDING, file_label, height_map, is_map

Group: TypeAlias = argparse._ArgumentGroup


class Groups(NamedTuple):
    """Argument groups of an evaluation, to which a script adds the flags that only it has."""

    episodes: Group
    policies: Group
    looked_at: Group
    machine: Group


def add_arguments(parser: argparse.ArgumentParser, out: str) -> Groups:
    """Add the flags that evaluations share; ``out`` is the default results folder.

    Levels and families are None if not given, until ``resolve`` fills in the defaults, so that a
    script can reject them where they would have no effect.
    """
    titles = "episodes", "policies", "output", "machine"
    groups = Groups(*map(parser.add_argument_group, titles))
    add = groups.episodes.add_argument
    add("--levels", help="levels, e.g. 6-10 or 0,5,10 (6-10)")
    add(
        "--families",
        help=f"comma-separated: {', '.join(ALL_FAMILIES)}, or height maps FILE{MAP_ENDING}; "
        f"all means {', '.join(FAMILIES)} (all)",
    )
    add("--episodes", type=int, default=100, help="episodes per cell (100)")
    add("--seed", type=int, default=0, help="seed of the tiles (0)")
    groups.looked_at.add_argument("--out", type=Path, default=Path(out), help=f"results ({out})")
    groups.looked_at.add_argument(
        "--video",
        type=int,
        nargs="?",
        const=1,
        default=0,
        metavar="N",
        help="film the first N episodes of each cell (off; N is 1 if omitted)",
    )
    groups.machine.add_argument(
        "--workers",
        type=workers_flag,
        default="auto",
        metavar="N",
        help="simulation processes (one per core)",
    )
    return groups


def resolve(args: argparse.Namespace) -> None:
    """Parse levels, families and workers in place, and check the other flags.

    Raises:
        ValueError: a flag or a file of heights cannot be used.
        OSError: a file of heights cannot be read.
    """
    args.levels = choose_levels("6-10" if args.levels is None else args.levels)
    families = "all" if args.families is None else args.families
    maps = tuple(filter(is_map, families.split(",")))
    args.families = choose(families, (*ALL_FAMILIES, *maps), FAMILIES, "family")
    for name in maps:
        height_map(name)
    for one, other in itertools.combinations(maps, 2):
        if file_label(one) == file_label(other):
            raise ValueError(f"files of '{one}' and '{other}' would have the same names")
    args.workers = usable_cores() if args.workers == "auto" else args.workers
    for flag, value in (("--episodes", args.episodes), ("--workers", args.workers)):
        if value < 1:
            raise ValueError(f"{flag} must be at least 1, not {value}")
    if not 0 <= args.seed < 2**32:
        raise ValueError(f"--seed must lie in [0, 2**32), not {args.seed}")
    if not 0 <= args.video <= args.episodes:
        raise ValueError(f"--video must lie in [0, --episodes], not {args.video}")


def choose(
    text: str, allowed: tuple[str, ...], everything: tuple[str, ...], what: str
) -> tuple[str, ...]:
    """Parse a comma-separated list of names; ``all`` stands for ``everything``.

    Raises:
        ValueError: a name is not allowed or is given twice.
    """
    names = everything if text == "all" else tuple(text.split(","))
    if "all" in names:
        raise ValueError(f"'all' must stand alone, not in '{text}'")
    for name in names:
        if name not in allowed:
            raise ValueError(f"unknown {what} '{name}'; allowed: all, {', '.join(allowed)}")
        if names.count(name) > 1:
            raise ValueError(f"{what} '{name}' is named twice")
    return names


def choose_levels(text: str) -> tuple[int, ...]:
    """Parse levels such as ``6-10`` or ``0,5,10``.

    Raises:
        ValueError: a level is not a number, is outside 0-12 or is given twice.
    """
    spans: list[range] = []
    for part in text.split(","):
        first, dash, last = part.partition("-")
        try:
            spans.append(range(int(first), int(last if dash else first) + 1))
        except ValueError as error:
            raise ValueError(f"cannot read --levels '{text}'; write e.g. 6-10 or 0,5,10") from error
    top = OOD_LEVELS[-1]
    if not all(span and span[0] >= 0 and span[-1] <= top for span in spans):
        raise ValueError(f"--levels '{text}' must name levels from 0 to {top}, upwards")
    levels = [level for span in spans for level in span]
    if len(set(levels)) < len(levels):
        raise ValueError(f"--levels '{text}' names a level twice")
    return tuple(levels)
