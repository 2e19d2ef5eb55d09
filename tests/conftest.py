"""The two lengths of the Monte-Carlo tests: quick for every change, long before a release."""

from __future__ import annotations

import gc
import os
from typing import TYPE_CHECKING

import pytest

from left_out import leave_out_tensors, leave_out_verdicts, make_figures_without_rendering

if TYPE_CHECKING:
    from collections.abc import Callable


# Files of microscopes are read in this process, where tests replace their readers;
# tests/test_guarded.py reads them apart.
os.environ.setdefault("PERRIN_GUARD", "off")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option --long."""
    parser.addoption("--long", action="store_true", help="all repeats of the Monte-Carlo tests")


def pytest_collection_finish() -> None:
    """Leave what is loaded before the first test out of the search for cycles, and search less.

    Each search takes a third of a second of processor time, for objects that all stay; with the
    usual threshold of 700 objects the others take a hundredth of the time of the tests.
    """
    gc.freeze()
    gc.set_threshold(10_000, 10, 10)


@pytest.fixture(scope="session")
def repeats(request: pytest.FixtureRequest) -> Callable[[int, int], int]:
    """Choose between two numbers of repeats: the first, or with --long the second."""
    return lambda quick, long: long if request.config.getoption("--long") else quick


@pytest.fixture
def no_tensors(monkeypatch: pytest.MonkeyPatch, repeats: Callable[[int, int], int]) -> None:
    """Leave out the tensors of an analysis in the quick form of a test."""
    if not repeats(0, 1):
        leave_out_tensors(monkeypatch)


@pytest.fixture
def no_verdicts(monkeypatch: pytest.MonkeyPatch, repeats: Callable[[int, int], int]) -> None:
    """Leave out the kind of motion in the quick form of a test."""
    if not repeats(0, 1):
        leave_out_verdicts(monkeypatch)


@pytest.fixture
def no_pictures(monkeypatch: pytest.MonkeyPatch, repeats: Callable[[int, int], int]) -> None:
    """Make figures without their pictures in the quick form of a test."""
    if not repeats(0, 1):
        make_figures_without_rendering(monkeypatch)
