"""Atomic file writes, tables, checksums, and writable folders."""

import contextlib
import csv
import hashlib
import io
import json
import os
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from tdgc.errors import InputError


@contextlib.contextmanager
def atomic(path: Path) -> Iterator[Path]:
    """Yield a temporary path next to ``path`` to write to.

    On success the file written there replaces ``path``; on an exception ``path`` stays as it was.

    Raises:
        OSError: ``path`` cannot be replaced; the error names it alone.
    """
    partial = path.parent / f".{path.name}.{os.getpid()}.tmp"
    try:
        yield partial
        try:
            os.replace(partial, path)
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(path)) from None
    finally:
        partial.unlink(missing_ok=True)


def write_synced(path: Path, data: bytes) -> None:
    """Write a file and wait until it is on the disk, so that a rename never outlives its content.

    Raises:
        OSError: the file cannot be written.
    """
    with open(path, "wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically, in UTF-8.

    Raises:
        OSError: the file cannot be written.
    """
    with atomic(path) as partial:
        write_synced(partial, text.encode())


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file atomically, indented.

    Raises:
        OSError: the file cannot be written.
    """
    write_text(path, json.dumps(value, indent=2))


def read_csv(path: Path) -> list[dict[str, str]]:
    """Read the rows of a CSV file, by column.

    Raises:
        OSError: the file cannot be read.
        csv.Error, UnicodeDecodeError: it is not a CSV file.
    """
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def write_csv(path: Path, columns: Iterable[str], rows: Iterable[Mapping[str, Any]]) -> None:
    """Write a CSV file atomically, with one row per mapping from columns to values.

    Raises:
        OSError: the file cannot be written.
    """
    content = io.StringIO(newline="")
    writer = csv.DictWriter(content, list(columns))
    writer.writeheader()
    writer.writerows(rows)
    write_text(path, content.getvalue())


def make_folder(folder: Path) -> None:
    """Make a folder and check that it is writable, so that a failure comes before the work.

    Raises:
        InputError: the folder cannot be made or written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise InputError(f"'{folder}' cannot be used: {error.strerror}") from error


def checksum(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal.

    Raises:
        OSError: the file cannot be read.
    """
    return hashlib.sha256(path.read_bytes()).hexdigest()
