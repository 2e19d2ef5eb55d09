"""Parts of an analysis that a test leaves out because it does not look at them."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pytest


def leave_out_tensors(patch: pytest.MonkeyPatch) -> None:
    """Estimate no tensors: they take a third of the time; tests/test_tensors.py tests them."""
    patch.setattr(
        "perrin.run.measure.measure_tensors", lambda motions, *_: [(None, [])] * len(motions)
    )


def leave_out_verdicts(patch: pytest.MonkeyPatch) -> None:
    """Judge no motion: that takes up to half of the time; tests/test_run_verdicts.py tests it."""
    patch.setattr("perrin.run.measure.judge_alone", lambda motions, **_: [None] * len(motions))


def make_figures_without_rendering(patch: pytest.MonkeyPatch) -> None:
    """Make figures, but write no pictures: layout and rendering take most of their time."""
    patch.setattr("matplotlib.layout_engine.ConstrainedLayoutEngine.execute", lambda *_: None)
    patch.setattr(
        "matplotlib.figure.Figure.savefig", lambda _, to, **__: to.write_bytes(bytes(2001))
    )
