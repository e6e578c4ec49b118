"""The table of an ablation: cells -> rows, and rows as text.

Intervals are those of the tiles. How much a seed changes shows in the rates of the seeds alone.
"""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import mean
from typing import Any

from tdgc.ablate.cells import Cell
from tdgc.ablate.variants import WHOLE
from tdgc.benchmark.results import difference, rates

#: What a cell came to (``Runner.run``), or the message of its error.
Found = dict[str, Any] | str
_FACTS = ("steps", "train_seconds", "simulated_hours")


def reached(folder: Path) -> dict[tuple[str, str, str], bool]:
    """Family, level and number of each tile of a cell's evaluation -> whether its goal was
    reached."""
    with open(folder / "evaluation" / "episodes.csv", newline="", encoding="utf-8") as file:
        return {
            (row["family"], row["level"], row["episode"]): row["outcome"] == "reached"
            for row in csv.DictReader(file)
        }


def rows(out: Path, cells: Sequence[Cell], found: Mapping[Cell, Found]) -> list[dict[str, Any]]:
    """A row for each variant, over its seeds.

    Args:
        out: where the cells' folders are.
        cells: all, in order.
        found: of those that were run.

    Returns:
        Of each variant ``name``, ``what`` and ``errors``, seed -> message. If a cell is done also
        n, reached, rate, ci_low and ci_high over all seeds; ``families`` and ``seeds``, each ->
        rate; ``versus``: ``results.difference`` to ``full`` on the same tiles with the same seed;
        and of a training, mean over the seeds, ``steps``, ``train_seconds``, ``simulated_hours``.
    """
    done = {cell: reached(out / cell.name) for cell, f in found.items() if isinstance(f, dict)}
    whole = {cell.seed: tiles for cell, tiles in done.items() if cell.variant.name == WHOLE}
    table = []
    for variant in dict.fromkeys(cell.variant for cell in cells):
        mine = [cell for cell in cells if cell.variant == variant]
        row: dict[str, Any] = {"name": variant.name, "what": variant.what}
        tiles = {cell: done[cell] for cell in mine if cell in done}
        if tiles:
            every = [(where, yes) for some in tiles.values() for where, yes in some.items()]
            families = dict.fromkeys(family for (family, _, _), _ in every)
            row |= rates(yes for _, yes in every)
            row["families"] = {
                family: rates(yes for where, yes in every if where[0] == family)["rate"]
                for family in families
            }
            row["seeds"] = {str(c.seed): rates(some.values())["rate"] for c, some in tiles.items()}
            pairs = [
                (yes, other[where])
                for cell, some in tiles.items()
                for seed, other in whole.items()
                if cell.seed in (seed, None)
                for where, yes in some.items()
            ]
            row["versus"] = difference(pairs) if pairs and variant.name != WHOLE else None
            for key in _FACTS if variant.settings is not None else ():
                row[key] = mean(_facts(found[cell])[key] for cell in tiles)
        row["errors"] = {str(c.seed): found[c] for c in mine if isinstance(found.get(c), str)}
        table.append(row)
    return table


def _facts(found: Found) -> dict[str, Any]:
    assert isinstance(found, dict)
    return found


def describe(table: Sequence[dict[str, Any]]) -> str:
    """Rows as text, with the errors below them."""
    families = list(next((row["families"] for row in table if "n" in row), {}))
    wide = max(len(row["name"]) for row in table) + 1
    head = f"{'variant':<{wide}}{'n':>6}{'success':>9}{'95 %':>15}{'against full':>22}"
    head += "".join(f"{Path(family).stem[:8]:>9}" for family in families)
    lines = [f"{head}{'steps':>9}{'hours':>7}"]
    for row in table:
        line = f"{row['name']:<{wide}}"
        if "n" in row:
            line += f"{row['n']:>6}{_percent(row['rate']):>8}%"
            line += f"{_interval(row):>15}{_versus(row['versus']):>22}"
            line += "".join(f"{_percent(row['families'][family]):>8}%" for family in families)
            if "steps" in row:
                line += f"{row['steps'] / 1e6:>8.2f}M{row['train_seconds'] / 3600.0:>7.2f}"
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
