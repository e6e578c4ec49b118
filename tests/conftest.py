"""Fixtures and hooks shared by several test files."""

import os
from collections.abc import Iterator

import pytest

# PyTorch's threads wait busily, and the tests run in as many processes as there are cores.
os.environ.setdefault("OMP_NUM_THREADS", "1")

# After the above, since they import numpy and PyTorch.
from stubs import InlineLink, in_this_process

import evaluate
from tdgc import policies
from tdgc.config import LowLevelConfig
from tdgc.learn.run import signals_restored
from tdgc.policies import Policy
from tdgc.show import film
from tdgc.tasks import leaps
from tdgc.tasks.pairing import PRETRAINED, load_low

#: The slowest files, slowest first. Run in this order, no process is left without work at the end.
SLOWEST = (
    "readme", "cluster", "training", "world", "calibration", "cues", "evaluation", "diagnosis",
    "deploy", "imitation", "film", "export", "ablate", "manners", "vec", "low_env",
)  # fmt: skip
ORDER = {f"test_{name}.py": place for place, name in enumerate(SLOWEST)}


@pytest.fixture(autouse=True, scope="session")
def sb3_folder(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Let Stable-Baselines3's default logger use one folder, not a new one in /tmp per learner."""
    os.environ["SB3_LOGDIR"] = str(tmp_path_factory.mktemp("sb3"))


@pytest.fixture(scope="session")
def low() -> tuple[Policy, LowLevelConfig]:
    """The shipped low policy and its MDP."""
    return load_low(PRETRAINED / "low")


@pytest.fixture
def signals() -> Iterator[None]:
    """Restore the handlers of SIGINT and SIGTERM, which training runs replace."""
    with signals_restored():
        yield


@pytest.fixture
def one_thread() -> Iterator[None]:
    """Let PyTorch use one thread: with networks this small, threads only wait for each other."""
    with policies.torch_threads(1):
        yield


@pytest.fixture
def in_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let evaluate.py run its jobs, and draw its films, in this process."""
    monkeypatch.setattr(evaluate, "run_jobs", in_this_process)
    monkeypatch.setattr(film, "run_jobs", in_this_process)


@pytest.fixture
def inline_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let trainings collect in this process."""
    monkeypatch.setattr("tdgc.learn.flags.ProcessLink", InlineLink)


@pytest.fixture
def quick_landing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Measure a low policy's landings for half a second, for tests that do not depend on them."""
    monkeypatch.setattr(leaps, "_SECONDS", 2.0)  # the first 1.5 s are not measured


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: ORDER.get(item.path.name, len(ORDER)))
