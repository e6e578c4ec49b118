"""States to resume from: nested dicts of arrays and JSON values.

An object with a state returns copies of its arrays, and restores them in place with ``fill``. A
checkpoint stores the arrays and the rest in two files, see ``split`` and ``join``.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

State = dict[str, Any]
_PLACE = "array"  # the only key of the dict that ``split`` leaves in place of an array


def fill(arrays: Mapping[str, NDArray[Any]], state: Mapping[str, Any]) -> None:
    """Copy the values of ``state`` into the arrays of the same names, in place.

    Raises:
        ValueError: the state lacks a name, or a value has another shape.
    """
    for name, array in arrays.items():
        if name not in state:
            raise ValueError(f"the state lacks '{name}'")
        value = np.asarray(state[name])
        if value.shape != array.shape:
            raise ValueError(f"'{name}' has shape {value.shape}, not {array.shape}")
        array[...] = value


def copies(arrays: Mapping[str, NDArray[Any]]) -> State:
    """A state with copies of the arrays, under the same names."""
    return {name: array.copy() for name, array in arrays.items()}


def split(tree: Any, path: str, arrays: dict[str, NDArray[Any]]) -> Any:
    """Return ``tree`` with its arrays moved to ``arrays``, named by their place under ``path``."""
    if isinstance(tree, np.ndarray):
        arrays[path] = tree
        return {_PLACE: path}
    if isinstance(tree, dict):
        return {key: split(value, f"{path}.{key}", arrays) for key, value in tree.items()}
    if isinstance(tree, list):
        return [split(value, f"{path}.{k}", arrays) for k, value in enumerate(tree)]
    return tree


def join(tree: Any, arrays: Mapping[str, NDArray[Any]]) -> Any:
    """Undo ``split``: put the ``arrays`` back into ``tree``.

    Raises:
        KeyError: an array is missing.
    """
    if isinstance(tree, dict):
        if tree.keys() == {_PLACE}:
            return arrays[tree[_PLACE]]
        return {key: join(value, arrays) for key, value in tree.items()}
    if isinstance(tree, list):
        return [join(value, arrays) for value in tree]
    return tree
