"""Rigid bodies of points: uncertainty of a pose, and 6x6 tensors moved to another point."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from perrin.geometry.rotations import skew

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from perrin._arrays import Bools, Floats, Ints


def degrees_of_freedom(n_present: Ints, d: int) -> Ints:
    """Return the degrees of freedom that a rigid fit leaves: 3n - 6 a frame (2n - 3 in 2-D)."""
    return np.maximum(d * n_present - d * (d + 1) // 2, 0)


def _pose_slopes(arm: Floats) -> Floats:
    """Return the change of each coordinate (T, n, d) with rotation vector and centre."""
    t, n, d = arm.shape
    unit = np.broadcast_to(np.eye(d), (t, n, d, d))
    if d == 2:
        across = np.stack([-arm[..., 1], arm[..., 0]], axis=-1)[..., None]
        return np.concatenate([across, unit], axis=-1)
    return np.concatenate([-skew(arm), unit], axis=-1)


def orientation_covariance(positions: Floats, noise: Floats) -> Floats:
    """Return the covariance of an orientation fitted with equal weights (first order in the noise).

    Parameters
    ----------
    positions : ndarray, shape (n, d)
        The particles used, body axes; their mean need not be at the origin.
    noise : ndarray, shape (..., d, d)
        Covariance of the localisation error in body axes.

    Returns
    -------
    ndarray, shape (..., 3, 3) or (..., 1, 1)
    """
    r = positions - positions.mean(0)
    if r.shape[1] == 2:
        across = np.stack([-r[:, 1], r[:, 0]], axis=1)
        inertia = float((r * r).sum())
        variance = np.einsum("ia,...ab,ib->...", across, noise, across) / inertia**2
        return np.asarray(variance)[..., None, None]
    inverse = np.linalg.inv(_inertia(r))
    arms = inverse @ skew(r)
    covariance: Floats = np.einsum("iab,...bc,idc->...ad", arms, noise, arms)
    # Symmetric to the last bit, as tables store one triangle of it.
    return 0.5 * (covariance + np.swapaxes(covariance, -1, -2))


def center_variance(positions: Floats, present: Bools, sigma: float) -> float:
    """Return the variance (um^2, mean over axes) of a cluster's centre fitted from some particles.

    With particles missing the centre is extrapolated along the body, so the error of the
    orientation enters through the lever from the centroid of those present to the centre.
    """
    seen = positions[present]
    lever = seen.mean(0)
    variance = sigma**2 / len(seen)
    if present.all():
        return variance
    covariance = orientation_covariance(seen, sigma**2 * np.eye(positions.shape[1]))
    if positions.shape[1] == 2:
        return float(variance + lever @ lever * covariance[0, 0] / 2)
    arm = skew(lever)
    return float(variance + np.trace(arm @ covariance @ arm.T) / 3)


def _inertia(r: Floats) -> Floats:
    """Return M = sum (r^2 1 - r r^T) of centred positions."""
    return np.sum(r * r) * np.eye(3) - r.T @ r


def shifted(tensor: Floats, point: ArrayLike) -> Floats:
    """Move a coupled tensor (6, 6) to a point r of the body: u' = u + omega x r for every motion.

    Parameters
    ----------
    tensor : ndarray, shape (6, 6)
        Translation first.
    point : array_like, shape (3,)
        From the present point, um, body axes.

    Examples
    --------
    >>> shifted(np.diag([1.0, 1, 1, 1, 1, 1]), [0, 0, 2.0]).diagonal()
    array([5., 5., 1., 1., 1., 1.])
    """
    move = np.eye(6)
    move[:3, 3:] = -skew(np.asarray(point, dtype=np.float64))
    moved: Floats = move @ tensor @ move.T
    return moved


def diffusion_center(tensor: Floats) -> Floats:
    """Return the centre of diffusion (3,) of a coupled tensor from its present point, um.

    There the coupling is symmetric.

    Examples
    --------
    >>> away = shifted(np.diag([1.0, 1, 1, 1, 2, 3]), [0.5, 0, 1])
    >>> diffusion_center(away).round(12) + 0.0
    array([-0.5,  0. , -1. ])
    """
    rotation, coupling = tensor[3:, 3:], tensor[:3, 3:]
    odd = coupling - coupling.T
    v = np.array([odd[2, 1], odd[0, 2], odd[1, 0]])
    center: Floats = np.linalg.solve(np.trace(rotation) * np.eye(3) - rotation, v)
    return center
