"""Flags that name the cells of an evaluation."""

from __future__ import annotations

from tdgc.sim.terrain import OOD_LEVELS


def choose(
    text: str, allowed: tuple[str, ...], everything: tuple[str, ...], what: str
) -> tuple[str, ...]:
    """The names in a comma-separated flag; ``all`` stands for ``everything``.

    Raises:
        ValueError: a name that is not allowed, or one of them twice.
    """
    names = everything if text == "all" else tuple(text.split(","))
    for name in names:
        if name not in allowed:
            raise ValueError(f"unknown {what} '{name}'; allowed: all, {', '.join(allowed)}")
        if names.count(name) > 1:
            raise ValueError(f"{what} '{name}' is named twice")
    return names


def choose_levels(text: str) -> tuple[int, ...]:
    """``6-10`` or ``0,5,10`` as levels.

    Raises:
        ValueError: not numbers, outside 0-12, or one of them twice.
    """
    levels: list[int] = []
    for part in text.split(","):
        first, _, last = part.partition("-")
        try:
            levels += range(int(first), int(last or first) + 1)
        except ValueError as error:
            raise ValueError(f"cannot read --levels '{text}'; write e.g. 6-10 or 0,5,10") from error
    top = OOD_LEVELS[-1]
    if not levels or min(levels) < 0 or max(levels) > top:
        raise ValueError(f"--levels '{text}' must name levels from 0 to {top}")
    if len(set(levels)) < len(levels):
        raise ValueError(f"--levels '{text}' names a level twice")
    return tuple(levels)
