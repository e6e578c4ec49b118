"""Fixtures and hooks shared by several test files."""

import signal
from collections.abc import Iterator

import pytest


@pytest.fixture
def signals() -> Iterator[None]:
    """Restore the handlers of SIGINT and SIGTERM, which training runs replace."""
    before = [(number, signal.getsignal(number)) for number in (signal.SIGINT, signal.SIGTERM)]
    yield
    for number, handler in before:
        signal.signal(number, handler)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run the slowest file first, so that other test processes have work in the meantime."""
    items.sort(key=lambda item: item.path.name != "test_readme.py")
