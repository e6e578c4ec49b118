"""Results of an evaluation: tables of rates, and the files of a results folder."""

import contextlib
import signal
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
from tqdm import tqdm

from tdgc.benchmark.evaluation import Cell, Episode, complete
from tdgc.benchmark.intervals import difference, rates
from tdgc.config import LowLevelConfig, differences, to_dict
from tdgc.errors import InputError
from tdgc.files import atomic, make_folder, write_csv, write_json
from tdgc.sim.terrain import EDITION

#: Files written by ``write_results``.
FILES = ("episodes.csv", "summary.json", "trajectories.npz")
# The last are of painters that were stopped.
_FILMS = ("films/film_*", "films/sheet_*", "films/strip_*", "films/.*.tmp")
#: Keys of summary.json beside the policies: "tdgc - gp" -> ``compare``; policy -> ``sides``; the
#: benchmark editions of the tiles and of the policies' training; and ``Training.robot``.
PAIRED, SIDES, EDITIONS, ROBOT = "paired", "sides", "editions", "robot"
# Settings of a robot that the benchmark prescribes; the others belong to the low policy.
_PRESCRIBED = ("urdf", "kp", "kd", "torque_limit", "speed_limit", "base_height")
# The rule of dominance (TDGC-Bench): ``tdgc`` is nowhere significantly below ``gp``. Its lead over
# ``cues`` is what learning adds to the cues.
_PAIRS = (("tdgc", "gp"), ("tdgc", "cues"))

_Where = tuple[str, str, int, int]  # policy or condition, family, level, episode


@dataclass(frozen=True)
class Training:
    """What the policies of an evaluation were trained on.

    Attributes:
        editions: of the benchmark, keyed by "low" and "high", see ``editions_of``.
        robot: what differs from the benchmark's robot and control step, see ``robot_changes``.
    """

    editions: Mapping[str, int]
    robot: Sequence[str] = ()


def make_room(out: Path, patterns: Sequence[str], folders: Mapping[str, bool]) -> None:
    """Create the results folder ``out`` and delete the files of an earlier table in it, because a
    new one may not overwrite all of them.

    Args:
        out: the folder.
        patterns: of files beside ``FILES`` and films.
        folders: name -> whether the new table needs it.
    """
    make_folder(out)
    for pattern in (*FILES, *_FILMS, *patterns):
        for old in out.glob(pattern):
            old.unlink()
    for name, wanted in folders.items():
        if wanted:
            (out / name).mkdir(exist_ok=True)


def compare(episodes: Iterable[Episode], first: str, second: str) -> dict[str, Any]:
    """Compare two policies on the same tiles: condition -> family -> ``difference``, with "mean"
    over the families.

    Raises:
        ValueError: only one of the policies was run on some tile.
    """
    reached = _reached(episodes, "condition", "policy")
    if any((first in found) != (second in found) for found in reached.values()):
        raise ValueError(f"{first} and {second} were not on the same tiles")
    return _differences_of(reached, first, second)


def sides(episodes: Iterable[Episode]) -> dict[str, Any]:
    """Compare tiles' mirror images with the tiles themselves, which shows what a policy has learned
    for one side only: policy -> family -> ``difference``, with "mean" over the families."""
    return _differences_of(_reached(episodes, "policy", "condition"), "mirrored", "nominal")


def _reached(episodes: Iterable[Episode], of: str, side: str) -> dict[_Where, dict[str, bool]]:
    """Whether the goal was reached: (``of``, family, level, episode) -> ``side`` -> that."""
    reached: dict[_Where, dict[str, bool]] = {}
    for e in episodes:
        where = getattr(e, of), e.family, e.level, e.episode
        reached.setdefault(where, {})[getattr(e, side)] = e.outcome == "reached"
    return reached


def _differences_of(
    reached: dict[_Where, dict[str, bool]], first: str, second: str
) -> dict[str, Any]:
    """``difference`` of two sides, where there are both: key -> family -> that, with "mean"
    over the families."""
    tree: dict[str, Any] = {}
    for (key, family, *_), found in reached.items():
        if first in found and second in found:
            pairs = tree.setdefault(key, {}).setdefault(family, [])
            pairs.append((found[first], found[second]))
    for families in tree.values():
        every = [pair for pairs in families.values() for pair in pairs]
        families.update({family: difference(pairs) for family, pairs in families.items()})
        families["mean"] = difference(every)
    return tree


def success(rows: Sequence[Episode]) -> dict[str, float]:
    """Return the ``rates`` of episodes."""
    return rates([e.outcome == "reached" for e in rows])


def summarise(episodes: Iterable[Episode]) -> dict[str, Any]:
    """Build the tree of summary.json: policy -> condition -> family -> level -> ``rates``.

    Each family also has a ``"mean"`` over its levels, and each condition a ``"mean"`` over all its
    episodes. Cells are equally large, so these are means over cells too.
    """
    tree: dict[str, Any] = {}
    for e in episodes:
        families = tree.setdefault(e.policy, {}).setdefault(e.condition, {})
        families.setdefault(e.family, {}).setdefault(str(e.level), []).append(e)
    for conditions in tree.values():
        for families in conditions.values():
            everything: list[Episode] = []
            for levels in families.values():
                rows = [e for level in levels.values() for e in level]
                everything += rows
                for level, some in levels.items():
                    levels[level] = success(some)
                levels["mean"] = success(rows)
            families["mean"] = success(everything)
    return tree


def describe(summary: dict[str, Any]) -> str:
    """Format a summary for the terminal.

    It lists the rates by family and level with their means, the paired differences in points of
    success with a note where the first policy is below the second, the differences on mirrored
    tiles, policies that were trained on another edition of the benchmark, and what differs from the
    benchmark's robot.
    """
    lines: list[str] = []
    for policy, conditions in policies_of(summary).items():
        for condition, families in conditions.items():
            lines += ["", f"{policy}, {condition}", *_rates(families)]
    for pair, conditions in summary.get(PAIRED, {}).items():
        for condition, families in conditions.items():
            lines += ["", f"{pair} on the same tiles, {condition}", *_differences(families, pair)]
    for policy, families in summary.get(SIDES, {}).items():
        lines += ["", f"{policy} on mirrored tiles - on the tiles", *_differences(families)]
    for name, edition in summary.get(EDITIONS, {}).items():
        if edition != EDITION:
            lines += [
                "",
                f"the {name} policy was trained on edition {edition} of TDGC-Bench, these tiles "
                f"are of edition {EDITION}",
            ]
    if ROBOT in summary:
        lines += ["", "not the benchmark's robot:", *(f"  {text}" for text in summary[ROBOT])]
    return "\n".join(lines)


def editions_of(metas: Mapping[str, Mapping[str, Any]]) -> dict[str, int]:
    """Editions of the benchmark that policies were trained on, from what their files record.

    Policies that do not record an edition are of the first.

    Raises:
        InputError: a policy's file has something else in place of an edition.
    """
    found = {name: meta.get("benchmark", 1) for name, meta in metas.items()}
    for name, edition in found.items():
        if type(edition) is not int:
            raise InputError(f"the {name} policy's 'benchmark' must be an edition, not {edition!r}")
    return found


def robot_changes(mdp: LowLevelConfig) -> list[str]:
    """List what a low policy's ``mdp`` has in place of the benchmark's robot, motors and control
    step, such as ``robot.kp=18.6, not 20.0``. All else in its physics is replaced."""
    mine, usual = to_dict(mdp), to_dict(LowLevelConfig())
    robot = {name: mine["robot"][name] for name in _PRESCRIBED}
    step = {"control_dt": mine["physics"]["control_dt"]}
    return [
        *differences(robot, usual["robot"], "robot"),
        *differences(step, usual["physics"], "physics"),
    ]


def policies_of(summary: dict[str, Any]) -> dict[str, Any]:
    """Return the rates by policy from a ``summary``, without its other keys."""
    others = (PAIRED, SIDES, EDITIONS, ROBOT)
    return {key: value for key, value in summary.items() if key not in others}


def verdict(pair: str, found: dict[str, float]) -> str:
    """Return e.g. "below gp" if the first of a pair is significantly worse, else ""."""
    return f"below {pair.rpartition(' ')[-1]}" if found["ci_high"] < 0.0 else ""


def _differences(families: dict[str, Any], pair: str = "") -> list[str]:
    wide = max(8, *(len(name) + 1 for name in families))
    lines = []
    for family, found in families.items():
        points, low, high = (100 * found[key] for key in ("difference", "ci_low", "ci_high"))
        text = f"{family.ljust(wide)}{points:+6.1f}  [{low:+.1f}, {high:+.1f}]"
        lines.append(f"{text}  {verdict(pair, found) if pair else ''}".rstrip())
    return lines


def _rates(families: dict[str, Any]) -> list[str]:
    names = [f for f in families if f != "mean"]
    levels = list(dict.fromkeys(level for name in names for level in families[name]))
    wide = max(8, *(len(name) + 1 for name in names))
    lines = ["family".ljust(wide) + "".join(f"{level:>8}" for level in levels)]
    for name in names:
        found = [families[name].get(level) for level in levels]  # None where the run was stopped
        cells = "".join(f"{100 * cell['rate']:7.1f}%" if cell else f"{'-':>8}" for cell in found)
        lines.append(name.ljust(wide) + cells)
    mean = families["mean"]
    rate, low, high = (100 * mean[key] for key in ("rate", "ci_low", "ci_high"))
    lines.append(f"{'mean'.ljust(wide)}{rate:.1f} %  [{low:.1f}, {high:.1f}]  n={mean['n']}")
    return lines


def write_results(
    folder: Path, episodes: Sequence[Episode], training: Training | None = None
) -> dict[str, Any]:
    """Write episodes.csv, summary.json and trajectories.npz into ``folder``; return the summary.

    Policies that were not run on the same tiles are not compared.

    trajectories.npz holds the tracks in the order of episodes.csv: ``poses`` (N, 3) of all episodes
    one after another, ``counts`` (E,), the number of poses of each episode, and ``goals`` (E, 2).
    """
    write_csv(folder / "episodes.csv", episodes[0].row(), (e.row() for e in episodes))
    # Pass an open file, because NumPy would append its suffix to a name.
    with atomic(folder / "trajectories.npz") as partial, open(partial, "wb") as tracks:
        np.savez_compressed(
            tracks,
            poses=np.concatenate([e.track for e in episodes]).astype(np.float32),
            counts=np.array([len(e.track) for e in episodes], dtype=np.int32),
            goals=np.array([e.goal for e in episodes], dtype=np.float32),
        )
    summary = summarise(episodes)

    def tiles(policy: str) -> set[_Where]:
        mine = (e for e in episodes if e.policy == policy)
        return {(e.condition, e.family, e.level, e.episode) for e in mine}

    pairs = [pair for pair in _PAIRS if tiles(pair[0]) == tiles(pair[1]) != set()]
    if pairs:
        summary[PAIRED] = {" - ".join(pair): compare(episodes, *pair) for pair in pairs}
    if found := sides(episodes):
        summary[SIDES] = found
    if training is not None:
        summary[EDITIONS] = {"tiles": EDITION, **training.editions}
        if training.robot:
            summary[ROBOT] = list(training.robot)
    write_json(folder / "summary.json", summary)
    return summary


# ---------------------------------------------------------------------------- stopped episodes


@contextlib.contextmanager
def salvage(
    folder: Path,
    episodes: Sequence[Episode],
    cells: Sequence[Cell],
    training: Training | None = None,
) -> Iterator[tqdm]:
    """Progress bar for running episodes, which keeps the ``complete`` ones whatever stops the run;
    SIGTERM stops it like Ctrl-C, with a KeyboardInterrupt.

    If stopped, it writes and prints the table of those episodes, adds a note with their number to
    the exception, and re-raises it.

    Args:
        folder, training: as for ``write_results``.
        episodes: the episodes that have ended; the caller appends to it meanwhile.
        cells: all batches of the evaluation.
    """
    total = sum(cell.count for cell in cells)
    before = signal.signal(signal.SIGTERM, _interrupt)
    try:
        with tqdm(total=total, unit="episode", dynamic_ncols=True) as bar:
            yield bar
    except (Exception, KeyboardInterrupt) as error:
        done = complete(episodes, cells)
        if done:
            print(describe(write_results(folder, done, training)))
            error.add_note(f"the table has {len(done)} of {total} episodes")
        else:
            error.add_note(f"no table, as 0 of {total} episodes are of complete cells")
        raise
    finally:
        signal.signal(signal.SIGTERM, before)


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt(signal.Signals(number).name)
