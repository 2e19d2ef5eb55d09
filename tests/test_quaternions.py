"""The covariance of relative quaternions: direct sums, and Favro's law."""

import dataclasses
import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from brownian_motions import assert_same_fields, brownian_motion, motion_with_gaps, tracked_motion
from perrin import (
    Cluster,
    QuaternionCovariance,
    TooFewFramesError,
    quaternion_covariance,
    simulate_motion,
)


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
    motion = tracked_motion(3, n_frames=60, D_R=0.05, gaps=gaps)
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


def test_quaternion_covariance_is_favros(repeats):
    """A body that turns at (1, 2, 4)e-3: Favro's formula to 5 Monte-Carlo errors at all lags."""
    D, n, t = np.array([1e-3, 2e-3, 4e-3]), repeats(8, 16), np.arange(1.0, 301)[:, None]
    runs = [
        quaternion_covariance(brownian_motion(seed, np.arange(20_000.0), D_R=D), n_lags=300)
        for seed in range(n)
    ]
    covariance = np.array([run.covariance for run in runs])
    others = D.sum() - D
    decay = np.exp(-others * t)  # exp(-(D_j + D_k) t)
    expected = (1 + 2 * decay - decay.sum(axis=1, keepdims=True)) / 4
    diagonal = np.diagonal(covariance, axis1=2, axis2=3)
    error = diagonal.std(axis=0, ddof=1) / n**0.5
    assert np.all(np.abs(diagonal.mean(axis=0) - expected) < 5 * error)
    assert np.all(error < 0.05 * expected)
    off = covariance[:, :, [0, 0, 1], [1, 2, 2]]
    assert np.all(np.abs(off.mean(axis=0)) < 6 * off.std(axis=0, ddof=1) / n**0.5)


def test_the_covariance_is_the_same_after_json():
    """Every field; lags without a pair are null in between."""
    found = quaternion_covariance(motion_with_gaps(1))
    text = json.dumps(found.to_dict(), allow_nan=False)
    assert_same_fields(QuaternionCovariance.from_dict(json.loads(text)), found)


def test_bad_arguments_of_the_covariance_are_refused():
    """Planar motions, bad numbers of lags, and motions without a pair are refused."""
    flat = simulate_motion(
        Cluster.from_positions([[0, 0], [2, 0]]), D_R=0.1, dt=1, n_frames=9, rng=1
    )
    with pytest.raises(ValueError, match="three dimensions"):
        quaternion_covariance(flat)
    motion = tracked_motion(1, n_frames=20)
    for n_lags in (0, -1, 2.5):
        with pytest.raises(ValueError, match="n_lags"):
            quaternion_covariance(motion, n_lags=n_lags)
    with pytest.raises(TooFewFramesError):
        quaternion_covariance(dataclasses.replace(motion, piece=np.arange(20)))
    assert len(quaternion_covariance(motion, n_lags=1000).lagtime) == 19
