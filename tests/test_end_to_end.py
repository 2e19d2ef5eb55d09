"""The benchmark of a whole movie, on a small one: its recipe, its pipeline and its comparison."""

import runpy
from pathlib import Path

import numpy as np
import pytest

from left_out import leave_out_tensors, leave_out_verdicts

pytest.importorskip("tifffile")
pytest.importorskip("trackpy")

BENCHMARK = Path(__file__).resolve().parents[1] / "benchmarks" / "end_to_end.py"
RECIPE = {"clusters": 2, "n_frames": 3, "shape": (40, 60, 100), "photons": 40.0, "seed": 0}


@pytest.fixture(scope="module")
def names():
    """Return the functions of the benchmark."""
    return runpy.run_path(str(BENCHMARK))


@pytest.fixture(scope="module")
def found(names, tmp_path_factory):
    """Return the report on a movie that is rendered and read again, and its true positions."""
    movie = tmp_path_factory.mktemp("movies") / "small.ome.tif"
    recipe = RECIPE | {"shape": (38, 50, 84)}
    names["kept"](movie, **recipe)[0].close()
    stack, truth = names["kept"](movie, **recipe)
    with stack, pytest.MonkeyPatch.context() as patch:
        leave_out_tensors(patch)
        leave_out_verdicts(patch)
        return names["pipeline"](stack)[0], truth


@pytest.mark.usefixtures("no_tensors", "no_verdicts")
def test_both_clusters_are_found_as_they_move(names, found):
    """D_R and D_T are those of the true positions within 0.2 of their standard errors.

    The root mean square over the large movie's clusters is 0.04.
    """
    report, truth = found
    true = names["true_report"](truth)
    pairs, false = names["matched"](report, truth)
    assert set(pairs) == {0, 1}
    assert false == []
    for c, result in pairs.items():
        assert np.abs(names["deviations"](result, true.clusters[c])).max() < 0.2


def test_stated_errors_of_positions_are_right(names, found):
    """24 positions an axis: their scatter over the stated one is 1 within 4 errors."""
    report, truth = found
    errors, stated = names["place_errors"](report.imaging.features, truth)
    assert len(errors) == truth[..., 0].size
    assert np.allclose(
        errors.std(axis=0) / stated.mean(axis=0), 1, atol=4 / np.sqrt(2 * len(errors))
    )


def test_another_recipe_is_not_taken_for_the_kept_one(names, tmp_path):
    """A movie of another seed is refused."""
    movie = tmp_path / "small.ome.tif"
    small = RECIPE | {"n_frames": 1, "clusters": 1}
    names["kept"](movie, **small)[0].close()
    with pytest.raises(SystemExit, match=r"another recipe.*seed"):
        names["kept"](movie, **small | {"seed": 1})
