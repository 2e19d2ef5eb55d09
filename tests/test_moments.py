"""Closed-form estimates of D from steps: costs of sparse frames."""

import tracemalloc

import numpy as np

from perrin import Cluster, estimate_diffusion, simulate_motion, track_rotation


def test_a_long_gap_takes_no_memory_in_the_mean_cosine():
    """Frames 0 to 99 and 10^8 on: the estimate is that with a gap of 10 frames, under 2 MB."""
    x = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=200, rng=1).positions()
    frame = np.arange(200)
    near, far = (
        track_rotation(x, dt=0.7, frames=frame + hole * (frame >= 100)) for hole in (10, 10**8)
    )
    tracemalloc.start()
    found = estimate_diffusion(far, method="trace")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    expected = estimate_diffusion(near, method="trace")
    assert peak < 2e6
    np.testing.assert_allclose(
        [found.value, found.stderr, found.offset],
        [expected.value, expected.stderr, expected.offset],
        rtol=1e-6,
    )
