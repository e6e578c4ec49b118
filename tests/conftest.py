"""Fixtures and hooks shared by several test files."""

import os
import signal
from collections.abc import Iterator

import pytest

# PyTorch's threads wait busily, and the tests run in as many processes as there are cores.
os.environ.setdefault("OMP_NUM_THREADS", "1")

# After the above, since they import numpy and PyTorch.
from stubs import in_this_process

import evaluate

#: The slowest files, slowest first. Run in this order, no process is left without work at the end.
SLOWEST = (
    "training", "readme", "cluster", "world", "low_env", "faults", "evaluation", "high_env",
    "export", "diagnosis", "mujoco", "ablate", "calibration", "cues", "vec",
)  # fmt: skip
ORDER = {f"test_{name}.py": place for place, name in enumerate(SLOWEST)}


@pytest.fixture
def signals() -> Iterator[None]:
    """Restore the handlers of SIGINT and SIGTERM, which training runs replace."""
    before = [(number, signal.getsignal(number)) for number in (signal.SIGINT, signal.SIGTERM)]
    yield
    for number, handler in before:
        signal.signal(number, handler)


@pytest.fixture
def in_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let evaluate.py run its jobs in this process."""
    monkeypatch.setattr(evaluate, "run_jobs", in_this_process)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: ORDER.get(item.path.name, len(ORDER)))
