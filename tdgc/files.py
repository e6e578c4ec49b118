"""Files that are there as a whole or not at all."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def atomic(path: Path) -> Iterator[Path]:
    """A place beside ``path`` to write to: what is there in the end takes the place of ``path``,
    unless something was raised, which leaves ``path`` as it was."""
    partial = path.parent / f".{path.name}.{os.getpid()}.tmp"
    try:
        yield partial
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)
