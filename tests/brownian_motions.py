"""Brownian motions for tests, built without simulation and tracking, which are slow."""

from __future__ import annotations

from dataclasses import fields, replace
from functools import cache

import numpy as np

from perrin import Cluster, RigidMotion, add_noise, simulate_motion, track_rotation
from perrin.geometry.rotations import cumulative_product, exp_map
from perrin.motion.tracking import track_each


@cache
def tetrahedron() -> Cluster:
    """Return a regular tetrahedron."""
    return Cluster.tetrahedron(1.5)


@cache
def rod() -> Cluster:
    """Return a long body without symmetry, its long axis along x."""
    return Cluster.from_positions([[-3.0, 0, 0], [0, 0.5, 0.3], [0.2, -0.6, 0.4], [3.0, 0, 0]])


@cache
def flat() -> Cluster:
    """Return a body in the plane without symmetry."""
    return Cluster.from_positions([[0.0, 0.0], [2.0, 0.1], [0.5, 1.2], [-0.7, 0.9]])


@cache
def at_rest(cluster: Cluster) -> RigidMotion:
    """Return the motion of a body that rests for two frames."""
    return track_rotation(np.tile(cluster.positions, (2, 1, 1)), dt=1.0)


def all_tracked(tracks, *, dt=1.0):
    """Return the motions of tracks of one length, fitted together as each would be alone."""
    x = np.stack(list(tracks))
    return track_each(x, time=np.tile(dt * np.arange(x.shape[1]), (len(x), 1)), dt=dt)


def with_poses(cluster, time, *, center=None, rotation=None, dt=1.0):
    """Return a motion with given times, centres (default 0) and rotations (default the identity).

    Frames without a centre have no pose.
    """
    rest, n, d = at_rest(cluster), len(time), cluster.positions.shape[1]
    k = rest.covariance.shape[-1]
    center = np.zeros((n, d)) if center is None else center
    rotation = np.tile(np.eye(d), (n, 1, 1)) if rotation is None else rotation
    return replace(
        rest, time=np.array(time, dtype=float), center=center, rotation=rotation, dt=dt,
        residual=np.zeros(n), n_present=np.full(n, len(cluster.positions)),
        covariance=np.zeros((n, k, k)), center_variance=np.zeros(n), piece=np.zeros(n, int),
        reason=("",) * n,
    )  # fmt: skip


def brownian_motion(
    rng,
    time,
    *,
    cluster=None,
    D_R=0.0,
    D_T=0.0,
    angle_noise=0.0,
    center_noise=0.0,
    dt=1.0,
    gaps=0.0,
):
    """Return a Brownian motion with noise; `gaps` is the fraction of frames without a pose.

    D_R is one number or one for each body axis; the noises are variances of one angle (rad^2) and
    of one coordinate of the centre (um^2).
    """
    cluster = tetrahedron() if cluster is None else cluster
    n, d = len(time), cluster.positions.shape[1]
    rng, angles = np.random.default_rng(rng), 2 * d - 3
    duration = np.diff(time)[:, None]
    turn = np.sqrt(2 * np.asarray(D_R) * duration) * rng.normal(size=(n - 1, angles))
    rotation = cumulative_product(exp_map(turn))
    rotation = rotation @ exp_map(np.sqrt(angle_noise) * rng.normal(size=(n, angles)))
    step = np.sqrt(2 * D_T * duration) * rng.normal(size=(n - 1, d))
    center = np.vstack([np.zeros(d), np.cumsum(step, axis=0)])
    center += np.sqrt(center_noise) * rng.normal(size=(n, d))
    lost = rng.random(n) < gaps
    lost[[0, -1]] = False
    center[lost], rotation[lost] = np.nan, np.nan
    return with_poses(cluster, time, center=center, rotation=rotation, dt=dt)


def tracked_motion(seed, n_frames=200, *, D_R=2e-3, D_T=0.03, sigma=0.06, cluster=None, gaps=0.0):
    """Return a simulated, tracked motion with noise; `gaps` is the fraction of missing frames."""
    rng = np.random.default_rng(seed)
    cluster = tetrahedron() if cluster is None else cluster
    truth = simulate_motion(cluster, D_R=D_R, D_T=D_T, dt=1.0, n_frames=n_frames, rng=rng)
    x = add_noise(truth.positions(), sigma=sigma, rng=rng)
    lost = np.flatnonzero(rng.random(n_frames) < gaps)
    x[lost[(lost > 0) & (lost < n_frames - 1)]] = np.nan
    return track_rotation(x, dt=1.0)


def motion_with_gaps(seed, n_frames=150, *, cluster=None, D_R=5e-3):
    """Return a noisy motion with missing frames and two pieces; by default of the rod."""
    motion = brownian_motion(
        seed, np.arange(float(n_frames)), cluster=rod() if cluster is None else cluster, D_R=D_R,
        D_T=0.03, angle_noise=5e-4, center_noise=1e-3, gaps=0.15,
    )  # fmt: skip
    return replace(motion, piece=np.repeat([0, 1], [90, n_frames - 90]))


def direct_mean_square(walk, lag, piece=None):
    """Return the mean square displacement by component and the pairs of one walk (T, c), summed."""
    step = walk[lag:] - walk[:-lag]
    if piece is not None:
        step = step[piece[lag:] == piece[:-lag]]
    step = step[np.isfinite(step).all(axis=1)]
    return (step**2).mean(axis=0) if len(step) else np.full(walk.shape[1], np.nan), len(step)


def assert_same_fields(a, b):
    """Check that two results have equal fields, NaN equal to NaN."""
    names = a._fields if hasattr(a, "_fields") else [field.name for field in fields(a)]
    for name in names:
        x, y = getattr(a, name), getattr(b, name)
        assert type(x) is type(y), name
        if isinstance(x, np.ndarray):
            assert x.dtype == y.dtype, name
            np.testing.assert_array_equal(x, y, err_msg=name)
        else:
            assert x == y or (np.isnan(x) and np.isnan(y)), name
