"""Van Hove distributions: Gaussian motion and mixtures, their errors, units and refusals."""

import dataclasses
import json

import numpy as np
import pytest

from brownian_motions import (
    assert_same_fields,
    brownian_motion,
    motion_with_gaps,
    tetrahedron,
    tracked_motion,
    with_poses,
)
from perrin import TooFewFramesError, VanHove, msad_vector, van_hove
from perrin.geometry.rotations import cumulative_product, exp_map


def brownian_center(seed, n_frames=400):
    """Return a motion whose centre makes Gaussian steps, with localisation noise."""
    return brownian_motion(seed, np.arange(float(n_frames)), D_R=2e-3, D_T=0.5, center_noise=0.01)


def test_gaussian_motion_has_no_excess_and_the_stated_errors(repeats):
    """40 tracks (long: 100), overlapping pairs and noise: alpha2 is 0 within 3 errors of its mean.

    Its scatter is the stated one within 3.1 Monte-Carlo errors; each bin's density is the Gaussian
    within 4 errors, and its scatter the stated one within 15 % on average over the bins.
    """
    edges, n = np.linspace(-6, 6, 13), repeats(40, 100)
    runs = [
        van_hove(brownian_center(seed, n_frames=150), lag=4.0, quantity="translation", bins=edges)
        for seed in range(n)
    ]
    alpha = np.array([r.alpha2 for r in runs])
    stated = np.mean([r.alpha2_stderr for r in runs])
    assert abs(alpha.mean()) < 3 * alpha.std() / np.sqrt(n)
    assert stated == pytest.approx(alpha.std(), rel=3.1 / np.sqrt(2 * n))
    density = np.array([r.density for r in runs])
    gaussian = np.mean([r.gaussian for r in runs], axis=0)
    scatter = density.std(axis=0)
    assert np.all(np.abs(density.mean(axis=0) - gaussian) < 4 * scatter / np.sqrt(n))
    ratio = np.mean([r.stderr for r in runs], axis=0) / scatter
    assert ratio.mean() == pytest.approx(1, abs=0.15)


def test_a_mixture_is_not_gaussian():
    """Rotations of two sizes, mixed half and half, 20000 steps: the alpha2 of the mixture in 10 %.

    For variances v and w = 9 v it is 2 (v^2 + w^2)/(v + w)^2 - 1 = 0.64.
    """
    rng = np.random.default_rng(6)
    size = np.where(rng.random(20_000) < 0.5, 0.02, 0.06)[:, None]
    steps = exp_map(size * rng.normal(size=(20_000, 3)))
    rotation = cumulative_product(steps)
    motion = with_poses(tetrahedron(), np.arange(20_001.0), rotation=rotation)
    found = van_hove(motion, lag=1.0)
    v, w = 0.02**2, 0.06**2
    expected = 2 * (v * v + w * w) / (v + w) ** 2 - 1
    assert found.alpha2 == pytest.approx(expected, rel=0.1)
    assert found.alpha2 > 10 * found.alpha2_stderr
    assert (found.quantity, found.unit, found.lagtime) == ("rotation", "rad", 1.0)


def test_the_density_is_a_density():
    """It integrates to 1, the Gaussian nearly so; beyond given edges it does not."""
    found = van_hove(brownian_center(1), lag=3.0, quantity="translation", bins=20)
    width = np.diff(found.edges)
    assert found.density @ width == pytest.approx(1, rel=1e-12)
    assert found.gaussian @ width == pytest.approx(1, rel=0.01)
    names = ["low", "high", "density", "stderr", "gaussian", "brownian"]
    assert list(found.to_frame()) == names
    cut = van_hove(brownian_center(1), lag=3.0, quantity="translation", bins=[0.0, 1.0])
    inside = found.n_pairs * 3 * cut.density[0]
    assert inside == pytest.approx(round(inside), abs=1e-6)
    assert 0 < cut.density[0] < 0.5


def test_van_hove_follows_units_and_time_reversal():
    """Scaled lengths scale the edges; backwards, every displacement changes its sign."""
    motion = brownian_center(2)
    a = van_hove(motion, lag=5.0, quantity="translation")
    scaled = dataclasses.replace(motion, center=1e-6 * motion.center)
    b = van_hove(scaled, lag=5.0, quantity="translation")
    np.testing.assert_allclose(b.edges, 1e-6 * a.edges, rtol=1e-9)
    np.testing.assert_allclose(b.stderr, 1e6 * a.stderr, rtol=1e-6)
    assert b.alpha2 == pytest.approx(a.alpha2, rel=1e-9)
    backwards = dataclasses.replace(motion, center=motion.center[::-1])
    c = van_hove(backwards, lag=5.0, quantity="translation")
    assert c.alpha2 == pytest.approx(a.alpha2, rel=1e-9)
    np.testing.assert_allclose(c.density, a.density[::-1], rtol=1e-9)


def test_van_hove_counts_the_pairs_there_are():
    """Gaps and pieces: the pairs and the lag time are those of the MSAD at that lag."""
    motion = motion_with_gaps(7)
    found = van_hove(motion, lag=6.0)
    curve = msad_vector(motion)
    assert found.n_pairs == curve.n_pairs[5]
    assert found.lagtime == curve.lagtime[5]


def test_bad_arguments_of_van_hove_are_refused():
    """Lags off the grid or too long, bad bins, another quantity, a body at rest: one line each.

    Several faults are in one message.
    """
    motion = tracked_motion(8, n_frames=30)
    for lag in (0.0, 0.5, 30.0, -1.0):
        with pytest.raises(ValueError, match=r"multiple of dt = 1 s up to 29 s"):
            van_hove(motion, lag=lag)
    for bins in (0, [1.0], [1.0, 1.0], [[0.0, 1.0]]):
        with pytest.raises(ValueError, match="bins: expected"):
            van_hove(motion, lag=1.0, bins=bins)
    with pytest.raises(ValueError, match="quantity: expected"):
        van_hove(motion, lag=1.0, quantity="spin")
    with pytest.raises(ValueError, match=r"quantity: .*; lag: .*; bins: "):
        van_hove(motion, lag=0.5, quantity="spin", bins=0)
    cut = dataclasses.replace(motion, piece=np.arange(30))
    with pytest.raises(TooFewFramesError, match="no two frames of one piece are 2 s apart"):
        van_hove(cut, lag=2.0)
    still = dataclasses.replace(motion, center=np.zeros((30, 3)))
    with pytest.raises(ValueError, match="the body does not move"):
        van_hove(still, lag=1.0, quantity="translation")


def test_a_distribution_is_the_same_after_json():
    """Every field, and its arrays are read-only."""
    found = van_hove(brownian_center(3), lag=2.0, quantity="translation")
    back = VanHove.from_dict(json.loads(json.dumps(found.to_dict())))
    assert_same_fields(back, found)
    assert not back.edges.flags.writeable
