"""The likelihood of a rod's steps: units and gaps (test_rods tests that D comes back)."""

from __future__ import annotations

import numpy as np

import perrin


def test_units_and_gaps():
    """Another dt divides D_perp; lost frames are longer steps, not shorter ones."""
    truth = perrin.simulate_motion(
        perrin.Cluster.touching(2, 2.0), D_R=0.01, dt=0.5, n_frames=600, rng=1
    )
    x = perrin.add_noise(truth.positions(), sigma=0.02, rng=2)
    one = perrin.estimate_rod(perrin.track_direction(x, dt=0.5))
    ten = perrin.estimate_rod(perrin.track_direction(x, dt=5.0))
    np.testing.assert_allclose(ten.value, one.value / 10, rtol=1e-7)
    x[np.random.default_rng(3).random(600) < 0.3] = np.nan
    gaps = perrin.estimate_rod(perrin.track_direction(x, dt=0.5))
    assert abs(gaps.value - one.value) < one.stderr
