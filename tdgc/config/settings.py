"""Reading, writing and changing configurations: dataclasses with checked values.

``with_overrides`` applies ``key=value`` pairs (``--set``), ``to_dict`` and ``from_dict`` convert to
and from JSON.
Unknown keys, values of the wrong type and values outside the allowed range raise ``ConfigError``.
"""

import dataclasses
import json
import math
import reprlib
import types
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

from tdgc.errors import InputError


class Rule(NamedTuple):
    """A constraint on the value of a setting, as worded in error messages, and whether it holds."""

    says: str
    holds: Callable[[Any], bool]


# Types of settings, with their constraints.
Share = Annotated[float, Rule("from 0 to 1", lambda x: 0.0 <= x <= 1.0)]
Positive = Annotated[float, Rule("above 0", lambda x: x > 0.0)]
NotNegative = Annotated[float, Rule("at least 0", lambda x: x >= 0.0)]
Weight = Annotated[float, Rule("from -100 to 100", lambda x: -100.0 <= x <= 100.0)]
Whole = Annotated[int, Rule("at least 0", lambda x: x >= 0)]
Seed = Annotated[int, Rule("from 0 to 2**32 - 1", lambda x: 0 <= x < 2**32)]  # as NumPy's
Count = Annotated[int, Rule("at least 1", lambda x: x >= 1)]
Range = Annotated[tuple[float, float], Rule("[low, high] with low <= high", lambda b: b[0] <= b[1])]
PositiveRange = Annotated[
    tuple[float, float], Rule("[low, high] with 0 < low <= high", lambda b: 0.0 < b[0] <= b[1])
]
ShareRange = Annotated[
    tuple[float, float],
    Rule("[low, high] with 0 < low <= high < 1", lambda b: 0.0 < b[0] <= b[1] < 1.0),
]
SharesRange = Annotated[
    tuple[float, float],
    Rule("[low, high] with 0 <= low <= high <= 1", lambda b: 0.0 <= b[0] <= b[1] <= 1.0),
]
#: Shares of trot, pronk, pace and bound.
GaitShares = Annotated[
    tuple[Share, Share, Share, Share],
    Rule("shares that add up to 1", lambda shares: math.isclose(sum(shares), 1.0)),
]


class ConfigError(InputError):
    """A configuration that cannot be used; the message is one line."""


Config = TypeVar("Config")


def to_dict(config: Any) -> dict[str, Any]:
    """Convert a configuration to nested plain dicts, ready for JSON (tuples become lists)."""
    return json.loads(json.dumps(dataclasses.asdict(config)))


def read_json(path: Path) -> Any:
    """Read a JSON file.

    Raises:
        ConfigError: the file cannot be read or is not JSON, or a key appears twice.
    """

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        table = dict(pairs)
        if len(table) < len(pairs):
            keys = [key for key, _ in pairs]
            twice = next(key for key in keys if keys.count(key) > 1)
            raise ConfigError(f"{path}: the key '{twice}' appears twice")
        return table

    try:
        return json.loads(path.read_text(encoding="utf-8"), object_pairs_hook=unique)
    except ConfigError:
        raise
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: not a JSON file") from error


def from_dict(cls: type[Config], data: Mapping[str, Any], where: str = "") -> Config:
    """Build ``cls`` from a plain dict; missing keys keep their defaults.

    Raises:
        ConfigError: a key that ``cls`` does not have, or a value that its setting does not allow.
    """
    if not isinstance(data, Mapping):
        shown = reprlib.repr(data)
        raise ConfigError(f"{where or cls.__name__} must be a table of keys, not {shown}")
    hints = typing.get_type_hints(cls, include_extras=True)
    names = [f.name for f in dataclasses.fields(cls)]  # type: ignore[arg-type]
    values = {}
    for key, value in data.items():
        path = f"{where}.{key}" if where else str(key)
        if key not in names:
            raise ConfigError(f"unknown configuration key '{path}'; allowed: {', '.join(names)}")
        values[key] = _coerce(hints[key], value, path)
    return cls(**values)


def recorded(cls: type[Config], data: Mapping[str, Any], source: object) -> Config:
    """Build ``cls`` from the configuration stored with a policy or a run.

    Every key must be there, except that settings with a ``before`` in their metadata take that
    value. Otherwise a policy could run with today's default of a key that did not exist when it
    was trained.

    Raises:
        ConfigError: as ``from_dict``, or a key is missing; the message begins with ``source``.
    """
    try:
        config = from_dict(cls, _with_before(cls, data))
    except ConfigError as error:
        raise ConfigError(f"{source}: {error}") from error
    for key, value in _missing(to_dict(config), _with_before(cls, data)):
        raise ConfigError(
            f"{source}: the key '{key}' is missing (default {value}); add the value that it was "
            "trained with"
        )
    return config


def _with_before(cls: Any, data: Any) -> Any:
    """``data`` with the ``before`` values of settings of ``cls`` that it lacks, and without those
    that ``cls`` has ``RETIRED``."""
    if not isinstance(data, Mapping):
        return data
    filled = {key: data[key] for key in data if key not in getattr(cls, "RETIRED", ())}
    hints = typing.get_type_hints(cls)
    for f in dataclasses.fields(cls):
        if f.name in data and dataclasses.is_dataclass(hints[f.name]):
            filled[f.name] = _with_before(hints[f.name], data[f.name])
        elif f.name not in data and "before" in f.metadata:
            filled[f.name] = f.metadata["before"]
    return filled


def _missing(whole: Mapping[str, Any], data: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Dotted keys of ``whole`` that ``data`` lacks, and their values."""
    for key, value in whole.items():
        if isinstance(value, dict):
            below = _missing(value, data.get(key, {}))
            yield from ((f"{key}.{name}", default) for name, default in below)
        elif key not in data:
            yield key, json.dumps(value)


def differences(before: Any, now: Any, where: str) -> Iterator[str]:
    """Settings that differ between two tables with the same keys, such as ``ppo.gamma=0.99, not
    0.98``."""
    if isinstance(before, Mapping) and isinstance(now, Mapping):
        for key in before:
            yield from differences(before[key], now[key], f"{where}.{key}")
    elif before != now:
        yield f"{where}={json.dumps(before)}, not {json.dumps(now)}"


def with_overrides(config: Config, assignments: Iterable[str]) -> Config:
    """Apply ``dotted.key=value`` strings, values written as in JSON (bare words are strings).

    Raises:
        ConfigError: an assignment without ``=``, an unknown key, or a value that its setting does
            not allow.
    """
    for text in assignments:
        key, equals, raw = text.partition("=")
        if not equals or not key:
            raise ConfigError(f"cannot read --set '{text}'; write key=value, e.g. a.b=0.5")
        try:
            value = json.loads(raw)
        except (ValueError, RecursionError):
            value = raw
        config = _replace(config, key.strip().split("."), value, key.strip())
    return config


def _replace(config: Any, path: list[str], value: Any, full: str) -> Any:
    names = [f.name for f in dataclasses.fields(config)]
    head, rest = path[0], path[1:]
    if head not in names:
        raise ConfigError(f"unknown configuration key '{full}'; allowed: {', '.join(names)}")
    child = getattr(config, head)
    if rest:
        if child is None:  # an optional table
            options = typing.get_args(typing.get_type_hints(type(config))[head])
            table = next((o for o in options if dataclasses.is_dataclass(o)), None)
            child = None if table is None else typing.cast(type, table)()
        if not dataclasses.is_dataclass(child):
            raise ConfigError(f"'{full}': '{head}' is a value, it has no keys of its own")
        return dataclasses.replace(config, **{head: _replace(child, rest, value, full)})
    if dataclasses.is_dataclass(child) and isinstance(value, dict):  # other keys are kept
        for key, own in value.items():
            child = _replace(child, [key], own, f"{full}.{key}")
        return dataclasses.replace(config, **{head: child})
    hint = typing.get_type_hints(type(config), include_extras=True)[head]
    return dataclasses.replace(config, **{head: _coerce(hint, value, full)})


def _coerce(hint: Any, value: Any, path: str) -> Any:
    """Convert ``value`` to the annotated type; only types that configurations use are supported."""
    origin = typing.get_origin(hint)
    shown = reprlib.repr(value)  # short, whatever the file contains
    if origin is Annotated:
        kind, rule = typing.get_args(hint)
        checked = _coerce(kind, value, path)
        if not rule.holds(checked):
            raise ConfigError(f"'{path}' must be {rule.says}, not {shown}")
        return checked
    if origin is Literal:
        if value not in typing.get_args(hint):
            allowed = ", ".join(typing.get_args(hint))
            raise ConfigError(f"'{path}' must be one of {allowed}, not {shown}")
        return value
    if dataclasses.is_dataclass(hint):
        return from_dict(typing.cast(type, hint), value, path)
    if origin in (typing.Union, types.UnionType):
        options = typing.get_args(hint)
        if value is None and type(None) in options:
            return None
        return _coerce(next(o for o in options if o is not type(None)), value, path)
    if origin is tuple:
        args = typing.get_args(hint)
        if not isinstance(value, (list, tuple)):
            raise ConfigError(f"'{path}' must be a list, not {shown}")
        if args[-1] is Ellipsis:
            return tuple(_coerce(args[0], v, path) for v in value)
        if len(value) != len(args):
            raise ConfigError(f"'{path}' must have {len(args)} values, not {len(value)}")
        return tuple(_coerce(a, v, path) for a, v in zip(args, value, strict=True))
    truth = isinstance(value, bool)  # which counts as an int in Python
    if hint in (bool, int, str) and isinstance(value, hint) and truth == (hint is bool):
        return value
    if hint is float and isinstance(value, (int, float)) and not truth:
        try:
            number = float(value)
        except OverflowError:  # an integer beyond the largest float
            number = math.inf
        if not math.isfinite(number):
            raise ConfigError(f"'{path}' must be a finite number, not {shown}")
        return number
    kind = getattr(hint, "__name__", str(hint))
    raise ConfigError(f"'{path}' must be of type {kind}, not {shown}")
