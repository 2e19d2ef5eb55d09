"""The covariance of relative quaternions: direct sums, and Favro's law."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from perrin import (
    Cluster,
    TooFewFramesError,
    add_noise,
    quaternion_covariance,
    simulate_motion,
    track_rotation,
)

TETRAHEDRON = Cluster.tetrahedron(1.5)


def noisy(seed, n_frames=200, D_R=2e-3, D_T=0.03, sigma=0.06, cluster=TETRAHEDRON, gaps=0.0):
    """Return a tracked Brownian cluster, whole frames missing at random (never the ends)."""
    rng = np.random.default_rng(seed)
    truth = simulate_motion(cluster, D_R=D_R, D_T=D_T, dt=1.0, n_frames=n_frames, rng=rng)
    x = add_noise(truth.positions(), sigma=sigma, rng=rng)
    lost = np.flatnonzero(rng.random(n_frames) < gaps)
    x[lost[(lost > 0) & (lost < n_frames - 1)]] = np.nan
    return track_rotation(x, dt=1.0)


def direct_quaternions(motion, lag):
    """Return the mean q q^T at one lag and its pairs, from scipy's quaternions."""
    steps = []
    for k in range(len(motion.time) - lag):
        there = np.isfinite(motion.center[[k, k + lag], 0]).all()
        if there and motion.piece[k] == motion.piece[k + lag]:
            relative = motion.rotation[k].T @ motion.rotation[k + lag]
            q = Rotation.from_matrix(relative).as_quat()[:3]
            steps.append(np.outer(q, q))
    return np.mean(steps, axis=0), len(steps)


@pytest.mark.parametrize("pieces", [False, True])
@pytest.mark.parametrize("gaps", [0.0, 0.3])
def test_quaternion_covariance_equals_direct_sums(gaps, pieces):
    """All lags, gaps and pieces: within 1e-12 of the quaternions pair by pair, pairs exact."""
    motion = noisy(3, n_frames=60, D_R=0.05, gaps=gaps)
    if pieces:
        motion = dataclasses.replace(motion, piece=np.repeat([0, 1], [25, 35]))
    found = quaternion_covariance(motion)
    assert len(found.lagtime) == 59
    for lag in (1, 2, 7, 20, 30):
        expected, pairs = direct_quaternions(motion, lag)
        assert found.n_pairs[lag - 1] == pairs
        np.testing.assert_allclose(found.covariance[lag - 1], expected, atol=1e-12)
    few = quaternion_covariance(motion, n_lags=10)
    np.testing.assert_allclose(few.covariance, found.covariance[:10], atol=1e-12)
    np.testing.assert_array_equal(few.n_pairs, found.n_pairs[:10])
    if pieces:
        assert np.isnan(found.covariance[-1]).all()
        assert found.n_pairs[-1] == 0


def test_quaternion_covariance_is_favros():
    """A body that turns at (1, 2, 4)e-3: Favro's formula to 5 Monte-Carlo errors at all lags."""
    D, count = np.array([1e-3, 2e-3, 4e-3]), 20000
    runs = []
    for seed in range(8):
        truth = simulate_motion(TETRAHEDRON, D_R=D, dt=1.0, n_frames=count, rng=seed)
        runs.append(quaternion_covariance(truth, n_lags=300).covariance)
    t = quaternion_covariance(truth, n_lags=300).lagtime[:, None]
    others = D.sum() - D
    decay = np.exp(-others * t)  # exp(-(D_j + D_k) t)
    expected = (1 + 2 * decay - decay.sum(axis=1, keepdims=True)) / 4
    diagonal = np.diagonal(np.array(runs), axis1=2, axis2=3)
    error = diagonal.std(axis=0, ddof=1) / 8**0.5
    assert np.all(np.abs(diagonal.mean(axis=0) - expected) < 5 * error)
    assert np.all(error < 0.05 * expected)
    off = np.array(runs)[:, :, [0, 0, 1], [1, 2, 2]]
    assert np.all(np.abs(off.mean(axis=0)) < 6 * off.std(axis=0, ddof=1) / 8**0.5)


def test_quaternion_covariance_refuses_what_it_cannot_answer():
    """Planar motions, lags that are none, and motions without a pair."""
    flat = simulate_motion(
        Cluster.from_positions([[0, 0], [2, 0]]), D_R=0.1, dt=1, n_frames=9, rng=1
    )
    with pytest.raises(ValueError, match="three dimensions"):
        quaternion_covariance(flat)
    motion = noisy(1, n_frames=20)
    for n_lags in (0, -1, 2.5):
        with pytest.raises(ValueError, match="n_lags"):
            quaternion_covariance(motion, n_lags=n_lags)
    with pytest.raises(TooFewFramesError):
        quaternion_covariance(dataclasses.replace(motion, piece=np.arange(20)))
    assert len(quaternion_covariance(motion, n_lags=1000).lagtime) == 19
