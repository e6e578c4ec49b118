"""What all errors about something that was read have in common: their message is one line."""

import importlib.util


class InputError(ValueError):
    """Something that was read and cannot be used.

    Messages quote keys, values and file names, which may hold anything: what cannot be printed is
    escaped, so that a message is always one line.
    """

    def __init__(self, message: str) -> None:
        super().__init__("".join(c if c.isprintable() else ascii(c)[1:-1] for c in message))


def require(what: str, packages: tuple[str, ...], extra: str) -> None:
    """Refuse to do ``what`` without the packages of an optional extra that it needs.

    Raises:
        InputError: names those that are missing and what to install.
    """
    missing = [name for name in packages if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError(
            f"{what} needs {', '.join(missing)}: install the extra '{extra}', "
            f"pip install -c constraints.txt -e '.[{extra}]'"
        )
