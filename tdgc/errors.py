"""Unusable input, failures, interruptions and missing packages, each reported in one line."""

import functools
import importlib.util
import sys
from collections.abc import Callable
from typing import ParamSpec


def escaped(text: str) -> str:
    """The text on one line: unprintable characters, such as the ends of lines, are escaped."""
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


class InputError(ValueError):
    """Input that was read but cannot be used.

    Messages quote keys, values and file names, which may contain anything, so they are ``escaped``.
    """

    def __init__(self, message: str) -> None:
        super().__init__(escaped(message))


class WorkerError(RuntimeError):
    """A worker died, hung or raised; the message includes its traceback if there is one."""


#: What may stop a program besides unusable input and Ctrl-C: a robot that blows up, a full disk or
#: memory, a dead process.
FAILURES = (FloatingPointError, OSError, MemoryError, WorkerError)


class StoppedError(Exception):
    """A signal or the time limit stopped the work before it was complete."""


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


def script(name: str) -> Callable[[Callable[P, int]], Callable[P, int]]:
    """Decorate a script's ``main``: what stops it becomes one line that begins with ``name``.

    The exit status is 2 for input that cannot be used, a ``ValueError``, and 1 for ``FAILURES`` and
    Ctrl-C. Any other exception is a defect and keeps its traceback.
    """

    def decorate(main: Callable[P, int]) -> Callable[P, int]:
        @functools.wraps(main)
        def run(*args: P.args, **keywords: P.kwargs) -> int:
            try:
                return main(*args, **keywords)
            except (ValueError, *FAILURES, KeyboardInterrupt) as error:
                print(f"{name}: {what_stopped(error)}", file=sys.stderr)
                if isinstance(error, KeyboardInterrupt):
                    sys.exit(1)  # instead of returning, so that a caller stops, too
                return 2 if isinstance(error, ValueError) else 1

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
