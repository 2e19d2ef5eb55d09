"""Rigid bodies of points: slopes and errors of a pose, 6x6 tensors moved to another point."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from perrin.geometry.rotations import skew

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from perrin._arrays import Bools, Floats, Ints


def degrees_of_freedom(n_present: Ints, d: int) -> Ints:
    """Return the degrees of freedom that a rigid fit leaves in each frame.

    Parameters
    ----------
    n_present : ndarray of int
        Number of particles present in each frame.
    d : int
        Number of coordinates of a particle, 2 or 3.

    Returns
    -------
    ndarray of int
        3n - 6, or 2n - 3 in the plane; never negative.

    Examples
    --------
    >>> degrees_of_freedom(np.array([1, 3, 4]), 3)
    array([0, 3, 6])
    """
    return np.maximum(d * n_present - d * (d + 1) // 2, 0)


def pose_slopes(arm: Floats) -> Floats:
    """Return how a small rotation and a shift of a rigid body move each of its particles.

    Parameters
    ----------
    arm : ndarray, shape (..., n, d)
        Positions of the particles relative to the point that the body turns about.

    Returns
    -------
    ndarray, shape (..., n, d, k)
        Derivatives of every coordinate by the k = 6 components of the rotation vector and of the
        shift, in this order; k = 3 (one angle, two shifts) in the plane.

    Notes
    -----
    A rotation vector w moves the point r by w x r, whose derivative by w is -[r]x.

    Examples
    --------
    >>> slopes = pose_slopes(np.array([[0.0, 2.0, 0.0]]))
    >>> slopes[0] @ [0.1, 0, 0, 0, 0, 0.5]  # turned about x by 0.1 rad, lifted by 0.5
    array([0. , 0. , 0.7])
    """
    d = arm.shape[-1]
    turn = np.stack([-arm[..., 1], arm[..., 0]], axis=-1)[..., None] if d == 2 else -skew(arm)
    return np.concatenate([turn, np.broadcast_to(np.eye(d), (*arm.shape, d))], axis=-1)


def inertia_tensor(arm: Floats) -> Floats:
    """Return the inertia tensor M = sum (r^2 1 - r r^T) of particles of unit mass, um^2.

    Parameters
    ----------
    arm : ndarray, shape (..., n, 3)
        Positions relative to their centre, um.

    Returns
    -------
    ndarray, shape (..., 3, 3)

    Examples
    --------
    >>> inertia_tensor(np.array([[0.0, 0, 1.0], [0, 0, -1.0]])).diagonal()
    array([2., 2., 0.])
    """
    square = np.sum(arm * arm, axis=(-2, -1))[..., None, None]
    tensor: Floats = square * np.eye(3) - np.swapaxes(arm, -1, -2) @ arm
    return tensor


def orientation_covariance(positions: Floats, noise: Floats) -> Floats:
    """Return the covariance of an orientation fitted with equal weights (first order in the noise).

    Parameters
    ----------
    positions : ndarray, shape (..., n, d)
        Particles used for the fit, body axes; their mean need not be at the origin.
    noise : ndarray, shape (..., d, d)
        Covariance of the localisation error in body axes.

    Returns
    -------
    ndarray, shape (..., 3, 3) or (..., 1, 1)

    Notes
    -----
    The fitted rotation vector errs by sum A_i e_i, with A_i = M^-1 [r_i]x the inertia tensor M and
    the slopes of the pose -[r_i]x.

    Examples
    --------
    >>> pair = np.array([[1.0, 0.0], [-1.0, 0.0]])
    >>> orientation_covariance(pair, 0.01 * np.eye(2))
    array([[0.005]])
    """
    r = positions - positions.mean(axis=-2, keepdims=True)
    if r.shape[-1] == 2:
        across = pose_slopes(r)[..., 0]
        inertia = (r * r).sum(axis=(-2, -1))
        variance = np.einsum("...ia,...ab,...ib->...", across, noise, across) / inertia**2
        return np.asarray(variance)[..., None, None]
    inverse = np.linalg.inv(inertia_tensor(r))[..., None, :, :]
    response = inverse @ skew(r)
    covariance: Floats = np.einsum("...iab,...bc,...idc->...ad", response, noise, response)
    # Symmetric to the last bit, as tables store one triangle of it.
    return 0.5 * (covariance + np.swapaxes(covariance, -1, -2))


def center_variance(positions: Floats, present: Bools, sigma: float | Floats) -> Floats:
    """Return the variance (um^2, mean over axes) of a cluster's centre fitted from some particles.

    With particles missing the centre is extrapolated along the body, so the error of the
    orientation enters through the lever from the centroid of those present to the centre.

    Parameters
    ----------
    positions : ndarray, shape (..., n, d)
        All particles of a body, um, their centre at the origin.
    present : ndarray of bool, shape (n,)
        Whether the pose is fitted to each particle.
    sigma : float or ndarray, shape (...)
        Localisation error of one coordinate, um.

    Returns
    -------
    ndarray, shape (...)

    Examples
    --------
    >>> body = np.array([[1.0, 0.0], [-0.5, 0.8], [-0.5, -0.8]])
    >>> all_three = center_variance(body, np.ones(3, dtype=bool), 0.03)
    >>> two = center_variance(body, np.array([True, True, False]), 0.03)
    >>> bool(all_three < two)
    True
    """
    seen, d = positions[..., present, :], positions.shape[-1]
    lever = seen.mean(axis=-2)
    square = np.broadcast_to(np.asarray(sigma, dtype=np.float64) ** 2, lever.shape[:-1])
    variance = square / seen.shape[-2]
    if present.all():
        return np.asarray(variance)
    covariance = orientation_covariance(seen, square[..., None, None] * np.eye(d))
    if d == 2:
        return np.asarray(variance + (lever * lever).sum(axis=-1) * covariance[..., 0, 0] / 2)
    arm = pose_slopes(lever)[..., :3]
    spread = np.einsum("...ia,...ab,...ib->...", arm, covariance, arm)
    return np.asarray(variance + spread / 3)


def shifted(tensor: Floats, point: ArrayLike) -> Floats:
    """Move a coupled tensor (6, 6) to a point r of the body: u' = u + omega x r for every motion.

    Parameters
    ----------
    tensor : ndarray, shape (6, 6)
        Translation first.
    point : array_like, shape (3,)
        Position of the new point relative to the present one, um, body axes.

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
    """Return the centre of diffusion (3,), relative to the present point of a coupled tensor, um.

    About the centre of diffusion the coupling is symmetric.

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
