"""The Cramér-Rao bound: a published table, and a dense Fisher matrix."""

import numpy as np
import pytest

from perrin import cramer_rao


@pytest.mark.parametrize(
    ("n_frames", "snr", "axes", "known", "joint"),
    [
        (100, 0.05, 3, 29.82, 31.45),
        (100, 50, 1, 14.49, 24.87),
        (300, 1, 3, 7.62, 10.00),
        (300, 20, 3, None, 8.3),
        (1000, 5, 2, 3.72, 5.81),
        (10000, 0.2, 1, 3.49, 3.91),
    ],
)
def test_the_bound_is_the_published_table(n_frames, snr, axes, known, joint):
    """The Cramer-Rao bound in percent equals an independent table to its last digit."""
    for noise, percent in (("known", known), ("joint", joint)):
        if percent is not None:
            bound = 100 * cramer_rao(n_frames=n_frames, snr=snr, axes=axes, noise=noise)
            assert bound == pytest.approx(percent, abs=0.006 if percent != 8.3 else 0.06)


def test_the_bound_is_the_inverse_of_a_dense_fisher_matrix():
    """For 20 frames the sine eigenvalues give what tr(C^-1 dC C^-1 dC)/2 gives densely."""
    steps = np.eye(19)
    shape = 2 * steps - np.eye(19, k=1) - np.eye(19, k=-1)
    inverse = np.linalg.inv(2 * steps + shape / 0.7)
    slopes = [inverse @ (2 * steps), inverse @ shape / 0.7]
    fisher = np.array([[np.trace(a @ b) / 2 for a in slopes] for b in slopes])
    assert cramer_rao(n_frames=20, snr=0.7, axes=1) == pytest.approx(
        np.sqrt(np.linalg.inv(fisher)[0, 0])
    )


def test_the_bound_refuses_what_has_none():
    """SNR, axes and the number of frames must be positive, the noise one of two words."""
    for bad in ({"snr": 0.0}, {"axes": 0}, {"n_frames": 2}, {"noise": "guessed"}):
        with pytest.raises(ValueError, match="expected"):
            cramer_rao(**({"n_frames": 100, "snr": 1.0} | bad))
