"""One-page report on an evaluation: reads a results folder, writes ``report.html`` into it.

The page is self-contained: pictures and films are embedded as data URIs, and its
``Content-Security-Policy`` forbids everything else. The template is ``report.html`` beside this
module; Jinja escapes every value inserted into it.
"""

import base64
import glob
import json
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jinja2

import tdgc
from tdgc.benchmark.diagnosis import LAYERS, count_failures
from tdgc.benchmark.evaluation import CONDITIONS, EpisodeRecord
from tdgc.benchmark.results import EDITIONS, PAIRED, ROBOT, SIDES, policies_of, verdict
from tdgc.files import read_csv, write_text
from tdgc.sim.terrain import is_map
from tdgc.tasks.rules import FALL_HEIGHT, GOAL_RADIUS, HORIZON, OUTCOMES, TRUNK_FORCE

NAME = "report.html"
#: Limit on the bytes of films in a page, our choice: ten MP4s of whole episodes, about 2 MB each.
#: Films that do not fit are named instead.
FILM_BYTES = 24_000_000

Row = dict[str, str]
_TILE = ("condition", "family", "level", "episode")  # columns that identify a tile

#: Figures of ``tdgc.show.plots``: file, caption and alternative text.
FIGURES = (
    (
        "success.png",
        "Success by family and level, with Wilson 95 % intervals",
        "One panel per terrain family: success rate against level, one line per policy. The "
        "tables above give the same numbers.",
    ),
    ("gaits.png", "Time in each gait by family", "Bars of each policy's share of time in a gait."),
    (
        "headings.png",
        "Body heading relative to the direction of travel",
        "Polar histograms by family and policy of the angle between heading and travel.",
    ),
    (
        "trajectories.png",
        "Some episodes from above, on the hardest level",
        "Tiles from above, one row per family, with the paths of some robots from start to goal.",
    ),
)
#: What else an evaluation leaves in its folder beside tables and films; it shows an older table as
#: soon as there is a new one.
DERIVED = (
    "traces/*.parquet",
    "logs/*.npz",
    "logs/.*.tmp",
    "mujoco.json",
    "diagnosis.csv",
    "behaviour.csv",
    "tuning.json",
    NAME,
    *(name for name, *_ in FIGURES),
)


def data_uri(path: Path) -> str:
    """Encode a PNG, GIF or MP4 as a data URI.

    Raises:
        OSError: the file cannot be read.
        KeyError: the file is of another kind.
    """
    kind = {".png": "image/png", ".gif": "image/gif", ".mp4": "video/mp4"}[path.suffix]
    return f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode('ascii')}"


def _json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def _distinct(rows: Sequence[Row], column: str) -> list[str]:
    """Distinct values of a column, in order of appearance."""
    return list(dict.fromkeys(row[column] for row in rows))


def _conditions(episodes: Sequence[Row]) -> list[dict[str, Any]]:
    """Describe each condition: its name, changes, families, levels, cell sizes and outcomes.

    Raises:
        ValueError: an unknown condition.
    """
    result = []
    for name in _distinct(episodes, "condition"):
        if name not in CONDITIONS:
            allowed = ", ".join(CONDITIONS)
            raise ValueError(f"episodes.csv has condition '{name}'; allowed: {allowed}")
        rows = [r for r in episodes if r["condition"] == name]
        cells = Counter((r["policy"], r["family"], r["level"]) for r in rows)
        outcomes: dict[str, Counter[str]] = {}
        for r in rows:
            outcomes.setdefault(r["policy"], Counter())[r["outcome"]] += 1
        result.append(
            {
                "name": name,
                "changes": CONDITIONS[name].what,
                "families": ", ".join(_distinct(rows, "family")),
                "levels": ", ".join(_distinct(rows, "level")),
                "episodes": ", ".join(str(n) for n in sorted(set(cells.values()))),
                "outcomes": outcomes,
            }
        )
    return result


def _differences(written: dict[str, Any]) -> list[dict[str, Any]]:
    """Collect the tables of differences in summary.json: pairs of policies, and mirrored tiles."""
    tables = [
        {"title": f"{pair} on the same tiles", "of": "condition", "rows": rows, "pair": pair}
        for pair, rows in written.get(PAIRED, {}).items()
    ]
    if SIDES in written:
        title = "mirrored tiles - the tiles themselves"
        tables.append({"title": title, "of": "policy", "rows": written[SIDES], "pair": None})
    for table in tables:
        names = dict.fromkeys(name for found in table["rows"].values() for name in found)
        table["families"] = sorted(names, key=lambda name: name == "mean")
    return tables


def _flat(tree: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Flatten a tuning into keys as in ``--set``, with their values."""
    for key, value in tree.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield prefix + key, json.dumps(value)


def _tuning(path: Path) -> dict[str, Any] | None:
    if not path.is_file():
        return None
    found = _json(path)
    return {"changes": list(_flat(found["tuning"])), "effect": found["effect"]}


def record_of(row: Row) -> EpisodeRecord:
    """The record in a row of episodes.csv or diagnosis.csv."""
    level, episode, seed = (int(row[key]) for key in ("level", "episode", "seed"))
    where = row["policy"], row["condition"], row["family"]
    return EpisodeRecord(*where, level, episode, seed, row["outcome"])


def _film(folder: Path, row: Row, diagnosis: Row | None, room: int) -> dict[str, Any]:
    """Describe an episode: its rows of episodes.csv and diagnosis.csv, the name of its film in
    ``folder``, and film and sheet as data URIs, the film's only if it fits in ``room`` bytes;
    None for what is missing."""
    stem = record_of(row).name
    kinds = (folder / f"film_{stem}.mp4", folder / f"film_{stem}.gif")
    path = next((path for path in kinds if path.is_file()), None)
    sheet = folder / f"sheet_{stem}.png"
    return {
        "row": row,
        "diagnosis": diagnosis,
        "file": path.name if path else None,
        "uri": data_uri(path) if path and path.stat().st_size <= room else None,
        "sheet": data_uri(sheet) if sheet.is_file() else None,
    }


def _tiles(folder: Path, episodes: Sequence[Row], diagnoses: Sequence[Row]) -> list[dict[str, Any]]:
    """Collect the first filmed tile of each family, with its strip and the films of all policies.

    Args:
        folder: ``films/`` of a results folder.
        episodes: those that were filmed.
        diagnoses: of any episodes.
    """
    causes = {record_of(d).name: d for d in diagnoses}
    room = FILM_BYTES
    tiles = []
    for family in _distinct(episodes, "family"):
        first = next(r for r in episodes if r["family"] == family)
        where = [first[key] for key in _TILE]
        films = []
        for row in episodes:
            if [row[key] for key in _TILE] == where:
                film = _film(folder, row, causes.get(record_of(row).name), room)
                films.append(film)
                if film["uri"]:
                    room -= (folder / film["file"]).stat().st_size
        strip = folder / record_of(first).strip  # of episode 0
        shown = first["episode"] == "0" and strip.is_file()
        tiles.append({**first, "films": films, "strip": data_uri(strip) if shown else None})
    return tiles


def render(folder: Path) -> str:
    """Render the page about the evaluation whose results are in ``folder``.

    The folder must contain summary.json, episodes.csv and the figures. diagnosis.csv, tuning.json
    and films/ are shown if present.

    Raises:
        OSError: a file is missing or cannot be read.
        ValueError: a file has content that an evaluation does not write.
    """
    written, episodes = _json(folder / "summary.json"), read_csv(folder / "episodes.csv")
    has_diagnoses = (folder / "diagnosis.csv").is_file()
    diagnoses = read_csv(folder / "diagnosis.csv") if has_diagnoses else []
    films = folder / "films"
    filmed = [r for r in episodes if any(films.glob(f"[!.]*_{glob.escape(record_of(r).name)}.*"))]
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("report.html").render(
        version=tdgc.__version__,
        policies=_distinct(episodes, "policy"),
        seeds=_distinct(episodes, "seed"),
        count=len(episodes),
        editions=written.get(EDITIONS, {}),
        robot=written.get(ROBOT, []),
        summary=policies_of(written),
        differences=_differences(written),
        verdict=verdict,
        conditions=_conditions(episodes),
        maps=any(is_map(family) for family in _distinct(episodes, "family")),
        outcomes=OUTCOMES,
        figures=[(data_uri(folder / name), title, alt) for name, title, alt in FIGURES],
        layers=LAYERS,
        diagnoses=count_failures(diagnoses, episodes) if has_diagnoses else None,
        tuning=_tuning(folder / "tuning.json"),
        tiles=_tiles(films, filmed, diagnoses),
        filmed=len(filmed),
        horizon=HORIZON,
        goal_radius=GOAL_RADIUS,
        fall_height=FALL_HEIGHT,
        trunk_force=TRUNK_FORCE,
    )


def write(folder: Path) -> Path:
    """Write ``report.html`` into ``folder`` atomically, and return its path.

    Raises:
        OSError, ValueError: as ``render``, or the page cannot be written.
    """
    path = folder / NAME
    write_text(path, render(folder))
    return path
