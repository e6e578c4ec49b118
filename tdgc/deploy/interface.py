"""Interface files: all that a program needs to know about an exported pair, in fields with units.

``tdgc.export`` writes one for each graph; ``interface.schema.json`` describes every field.
"""

import functools
import json
import textwrap
from pathlib import Path
from typing import Any

from tdgc.config import read_json
from tdgc.errors import InputError

#: Version of the interface files; any change to their contents gets a new one.
VERSION = 4
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
        ExportError: the file has another version, or lacks a field or has an invalid one.
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
    return dict(table)


@functools.cache
def _validator(name: str) -> Any:
    from jsonschema import Draft202012Validator

    definitions = json.loads(SCHEMA.read_text(encoding="utf-8"))["$defs"]
    return Draft202012Validator({"$defs": definitions, "$ref": f"#/$defs/{name}"})
