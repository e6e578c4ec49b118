"""What all errors about something that was read have in common: their message is one line."""

from __future__ import annotations


def install_hint(extra: str) -> str:
    """What to do where the packages of an optional extra are missing."""
    return f"install the extra '{extra}', pip install -c constraints.txt -e '.[{extra}]'"


class InputError(ValueError):
    """Something that was read and cannot be used.

    Messages quote keys, values and file names, which may hold anything: what cannot be printed is
    escaped, so that a message is always one line.
    """

    def __init__(self, message: str) -> None:
        super().__init__("".join(c if c.isprintable() else ascii(c)[1:-1] for c in message))
