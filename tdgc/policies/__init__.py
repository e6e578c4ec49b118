"""Policies: their files, inference without SB3, and the SB3 classes to train them.

Loading and running a policy does not need SB3, so whatever depends on SB3 is imported on first
access.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from tdgc.policies.acting import Actor, Policy, State, load, save_copy, torch_threads
from tdgc.policies.correction import Correction
from tdgc.policies.files import ACTIVATIONS, Header, Mirror, PolicyFileError

if TYPE_CHECKING:
    from tdgc.policies.learning import AsymmetricActorCriticPolicy, load_into, save

__all__ = [
    "ACTIVATIONS",
    "Actor",
    "AsymmetricActorCriticPolicy",
    "Correction",
    "Header",
    "Mirror",
    "Policy",
    "PolicyFileError",
    "State",
    "load",
    "load_into",
    "save",
    "save_copy",
    "torch_threads",
]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(import_module("tdgc.policies.learning"), name)
