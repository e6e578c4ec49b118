"""Interface files: all that a program needs to know about an exported pair, in fields with units.

``tdgc.export`` writes one for each graph; ``interface.schema.json`` describes every field.
"""

import functools
import json
import math
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tdgc.config import read_json
from tdgc.errors import InputError

#: Version of the interface files; any change gets a new one, except to a ``meaning``.
VERSION = 5
SCHEMA = Path(__file__).with_name("interface.schema.json")

Table = dict[str, Any]


class ExportError(InputError):
    """An export that cannot be used; the message is one line."""


def interface_path(folder: Path, name: str) -> Path:
    """Path of the interface file of the graph ``name``."""
    return folder / f"{name}_interface.json"


def read_interface(folder: Path, name: str) -> Table:
    """Read the interface file of the graph ``name`` in an exported folder.

    Raises:
        ExportError: the file has another version, lacks a field or has an invalid one, or has two
            that do not fit each other.
        ConfigError: the file cannot be read or is not JSON.
    """
    from jsonschema.exceptions import best_match

    path = interface_path(folder, name)
    table = read_json(path)
    version = table.get("version") if isinstance(table, dict) else None
    if version != VERSION:
        raise ExportError(
            f"{path}: an interface of version {version}, this package reads {VERSION}; export the "
            "policies again"
        )
    error = best_match(_validator(name).iter_errors(table))
    if error is not None:
        where = "".join(f"[{k}]" if isinstance(k, int) else f".{k}" for k in error.absolute_path)
        said = textwrap.shorten(error.message, 200, placeholder="...")
        raise ExportError(f"{path}: {where.removeprefix('.') or 'the interface'}: {said}")
    for misfit in _misfits(table):
        raise ExportError(f"{path}: {misfit}")
    return dict(table)


@functools.cache
def _validator(name: str) -> Any:
    """Validator of the graph ``name``'s interface file, which rejects NaN and Infinity."""
    from jsonschema import Draft202012Validator, validators

    known, largest = Draft202012Validator.TYPE_CHECKER, sys.float_info.max
    finite = known.redefine(
        "number", lambda _, value: known.is_type(value, "number") and abs(value) <= largest
    )
    definitions = json.loads(SCHEMA.read_text(encoding="utf-8"))["$defs"]
    schema = {"$defs": definitions, "$ref": f"#/$defs/{name}"}
    return validators.extend(Draft202012Validator, type_checker=finite)(schema)


def _misfits(table: Table) -> Iterator[str]:
    """Describe fields that do not fit each other, in a table that the schema admits."""
    ranges = [*table["commands"], *table["trained_for"]]
    if "joint_control" in table:
        limits = table["joint_control"]["joint_limits"]
        ends = zip(table["joints"], limits["low"], limits["high"], strict=True)
        ranges += [{"name": joint, "low": low, "high": high} for joint, low, high in ends]
    for entry in ranges:
        if "low" in entry and entry["low"] > entry["high"]:
            yield f"{entry['name']}: low, {entry['low']:g}, is above high, {entry['high']:g}"
    named = dict(table)  # what names the entries of a signal, by the signal's 'order'
    if "probes" in table:
        named["probes"] = table["probes"]["ahead_left"]["value"]
    signals = table["inputs"] + table["outputs"]
    sizes = {signal["name"]: signal["shape"][0] for signal in signals}
    for signal in signals:
        name, order, previous, start = (signal[k] for k in ("name", "order", "previous", "start"))
        others = {"start": len(start)} if isinstance(start, list) else {}
        if order is not None:
            others[f"order '{order}'"] = len(named.get(order, ()))
        if previous is not None:
            others[f"previous '{previous}'"] = sizes.get(previous, 0)
        for what, size in others.items():
            if size != sizes[name]:
                yield f"'{name}' has the size {sizes[name]}, its {what} has {size}"
    if "families" in table and table["task"]["family"]["otherwise"] not in table["families"]:
        yield f"task.family.otherwise is '{table['task']['family']['otherwise']}', no family"


def pair_misfits(low: Table, high: Table) -> Iterator[str]:
    """Describe each mismatch that shows that two interfaces come from different exports."""
    if low["robot"]["standing_height"] != high["probes"]["plane_below_trunk"]:
        yield "their standing heights differ"
    every = high["order"][0]["every"]
    if not math.isclose(low["rate"]["value"], every * high["rate"]["value"]):
        yield (
            f"low runs at {low['rate']['value']:g} Hz, which is not {every} times high's "
            f"{high['rate']['value']:g} Hz"
        )
    for mine, trained in zip(high["commands"], low["commands"], strict=True):
        if "low" in mine and (mine["low"] < trained["low"] or mine["high"] > trained["high"]):
            yield f"high's bounds of {mine['name']} exceed low's"
    made = {f"{t['graph']}.{s['name']}": s["shape"] for t in (low, high) for s in t["outputs"]}
    for signal in low["inputs"] + high["inputs"]:
        source = signal["source"]
        if source is not None and made.get(source) != signal["shape"]:
            yield f"'{signal['name']}' has the shape {signal['shape']}, {source} {made.get(source)}"
