"""The table of an ablation: trials -> rows, and rows as text.

Rates are means over the tiles and over the seeds of a variant. Intervals cover the choice of tiles
only, for the given seeds. How much the seed matters shows only in the rates per seed.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import mean
from typing import Any

import numpy as np

from tdgc.ablate.trials import Found, Result, Tile, Trial
from tdgc.ablate.variants import WHOLE
from tdgc.benchmark.intervals import difference, rates


def rows(
    tiles: Sequence[Tile], trials: Sequence[Trial], found: Mapping[Trial, Found]
) -> list[dict[str, Any]]:
    """A row for each variant, over its seeds.

    Args:
        tiles: those that each trial was evaluated on.
        trials: all of them, in order.
        found: results or error messages of the trials that were run.

    Returns:
        For each variant, its ``name``, ``what`` and ``errors`` (seed -> message). If a trial is
        done, also the ``rates`` of all its seeds' episodes; ``families`` and ``seeds``, each ->
        rate; ``versus``, the ``difference`` from ``full`` with the same seed; and the means of
        the ``Result.facts`` over the seeds.
    """
    of = np.array([family for family, _, _ in tiles])
    done = {trial: result for trial, result in found.items() if isinstance(result, Result)}
    whole = {trial.seed: r.reached for trial, r in done.items() if trial.variant.name == WHOLE}
    table = []
    for variant in dict.fromkeys(trial.variant for trial in trials):
        mine = [trial for trial in trials if trial.variant == variant]
        row: dict[str, Any] = {"name": variant.name, "what": variant.what}
        results = {trial: done[trial] for trial in mine if trial in done}
        if results:
            reached = np.array([result.reached for result in results.values()])
            row |= rates(reached)
            row["families"] = {
                family: float(reached[:, of == family].mean())
                for family in dict.fromkeys(of.tolist())
            }
            row["seeds"] = {str(t.seed): float(r.reached.mean()) for t, r in results.items()}
            pairs = [
                (result.reached, other)
                for trial, result in results.items()
                for seed, other in whole.items()
                if trial.seed in (seed, None)  # a script has no seed and is compared with all
            ]
            row["versus"] = None
            if pairs and variant.name != WHOLE:
                row["versus"] = difference(np.array(pairs).swapaxes(1, 2))
            facts = [result.facts for result in results.values()]
            row |= {name: mean(each[name] for each in facts) for name in facts[0]}
        row["errors"] = {str(t.seed): found[t] for t in mine if isinstance(found.get(t), str)}
        table.append(row)
    return table


def describe(table: Sequence[dict[str, Any]]) -> str:
    """Format rows as text, with the errors below them."""
    families = list(next((row["families"] for row in table if "n" in row), {}))
    wide = max(len(row["name"]) for row in table) + 1
    head = f"{'variant':<{wide}}{'n':>6}{'success':>9}{'95 %':>15}{'against full':>22}"
    head += "".join(f"{Path(family).stem[:8]:>9}" for family in families)
    lines = [f"{head}{'steps':>9}{'walked':>9}{'trained':>9}{'evaluated':>11}"]
    for row in table:
        line = f"{row['name']:<{wide}}"
        if "n" in row:
            line += f"{row['n']:>6}{_percent(row['rate']):>8}%"
            line += f"{_interval(row):>15}{_versus(row['versus']):>22}"
            line += "".join(f"{_percent(row['families'][family]):>8}%" for family in families)
            trained = " " * 27
            if "steps" in row:
                trained = f"{row['steps'] / 1e6:>8.2f}M{row['simulated_hours']:>7.1f} h"
                trained += f"{row['train_seconds'] / 3600.0:>7.2f} h"
            line += f"{trained}{row['evaluate_seconds'] / 60.0:>7.1f} min"
        else:
            line += "failed" if row["errors"] else "to come"
        lines.append(line.rstrip())
    for row in table:
        lines += [f"{row['name']}, seed {seed}: {error}" for seed, error in row["errors"].items()]
    return "\n".join(lines)


def _percent(share: float, sign: str = "") -> str:
    return f"{100.0 * share:{sign}.1f}"


def _interval(found: Mapping[str, float], sign: str = "") -> str:
    return f"[{_percent(found['ci_low'], sign)}, {_percent(found['ci_high'], sign)}]"


def _versus(found: Mapping[str, float] | None) -> str:
    if found is None:
        return ""
    return f"{_percent(found['difference'], '+')} {_interval(found, '+')}"
