"""The benchmark of coverage can fail: the paper's own procedure fails, the default does not."""

import runpy
from pathlib import Path

import pytest

BENCHMARK = Path(__file__).resolve().parents[1] / "benchmarks" / "intervals.py"


@pytest.fixture(scope="module")
def found(repeats):
    """Return figures of all methods in one cell: a tetrahedron, 300 frames, SNR 20."""
    names = runpy.run_path(str(BENCHMARK))
    methods = {name: names["METHODS"][name] for name in ("joint", "residual")}
    methods["paper"] = names["by_the_paper"]
    figures = names["run"](names["CELLS"][2], methods, tracks=repeats(16, 60), seed=1)
    return {name: (figures[name], names["missed"](figures[name])) for name in methods}


@pytest.mark.parametrize("method", ["joint", "residual"])
def test_the_default_keeps_its_lines(found, method):
    """No figure misses its line by more than three Monte-Carlo errors."""
    figures, missed = found[method]
    assert missed == []
    assert set(figures) == {"bias %", "spread %", "efficiency", "cover68", "cover95"}


def test_the_papers_procedure_fails_them(found):
    """Its spread is 3 times the bound's and its error from the scatter covers almost never."""
    figures, missed = found["paper"]
    assert {"efficiency", "cover68", "cover95"} <= set(missed)
    assert figures["efficiency"][0] < 0.3
    assert figures["cover95"][0] < 0.2
