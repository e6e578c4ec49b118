"""Errors about unusable input, interruptions, one-line descriptions of both, and a check for
optional packages."""

import functools
import importlib.util
import sys
from collections.abc import Callable
from typing import ParamSpec


class InputError(ValueError):
    """Input that was read but cannot be used.

    Messages quote keys, values and file names, which may contain anything. Unprintable characters
    are escaped, so a message is always one line.
    """

    def __init__(self, message: str) -> None:
        super().__init__("".join(c if c.isprintable() else ascii(c)[1:-1] for c in message))


class StoppedError(Exception):
    """A signal or the time limit came before something was done."""


def in_one_line(text: str) -> str:
    """The first and the last line of a text: between them is a worker's traceback."""
    lines = text.splitlines()
    return " ".join(dict.fromkeys((lines[0], lines[-1])))


def what_stopped(error: BaseException) -> str:
    """Describe what ended a program in one line, with the error's notes."""
    said = in_one_line(str(error) or type(error).__name__)  # a MemoryError may say nothing
    if isinstance(error, KeyboardInterrupt):
        said = f"stopped by {str(error) or 'Ctrl-C'}"
    return "; ".join([said, *getattr(error, "__notes__", ())])


P = ParamSpec("P")


def interruptible(name: str) -> Callable[[Callable[P, int]], Callable[P, int]]:
    """Decorate a script's ``main``, so that Ctrl-C ends it with one line, which begins with
    ``name``, and exit status 1."""

    def decorate(main: Callable[P, int]) -> Callable[P, int]:
        @functools.wraps(main)
        def run(*args: P.args, **keywords: P.kwargs) -> int:
            try:
                return main(*args, **keywords)
            except KeyboardInterrupt as error:
                print(f"{name}: {what_stopped(error)}", file=sys.stderr)
                sys.exit(1)  # instead of returning, so that a caller stops, too

        return run

    return decorate


def require(what: str, packages: tuple[str, ...], extra: str) -> None:
    """Check that the ``packages`` of an optional extra that ``what`` needs are installed.

    Raises:
        InputError: a package is missing; names the missing ones and what to install.
    """
    missing = [name for name in packages if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError(
            f"{what} needs {', '.join(missing)}: install the extra '{extra}', "
            f"pip install -c constraints.txt -e '.[{extra}]'"
        )
