"""Fits of a rigid body to all frames: to one common shape, or from each frame to the next."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from perrin.errors import TooFewFramesError
from perrin.geometry.rigid import (
    center_variance,
    degrees_of_freedom,
    orientation_covariance,
    pose_slopes,
)
from perrin.geometry.rotations import exp_map, fit_rotations, successive_product
from perrin.motion.degenerate import mean_present, no_rotation, require_points

if TYPE_CHECKING:
    from collections.abc import Callable

    from perrin._arrays import Bools, Floats, Ints

# Largest rotation (rad) of a last Gauss-Newton step: rounding of a rotation matrix.
_LAST_TURN = 1e-13


class PoseFit(NamedTuple):
    """Poses of all frames before their errors are known; frames without a pose are NaN.

    Attributes
    ----------
    rotation : ndarray, shape (T, d, d)
        Orientation of the body, lab from body.
    center : ndarray, shape (T, d)
        Centre of the template, lab frame, um.
    template : ndarray, shape (n, d)
        Particles of the common shape, um, their centre at the origin.
    residual : ndarray, shape (T, n, d)
        Measured minus fitted positions, body axes, um.
    sigma2 : float
        Variance of the localisation error of one coordinate, from the residuals, um^2.
    """

    rotation: Floats
    center: Floats
    template: Floats
    residual: Floats
    sigma2: float


def fit_template(x: Floats, seen: Bools) -> PoseFit:
    """Fit all frames to their common shape: generalised Procrustes, missing particles allowed.

    Parameters
    ----------
    x : ndarray, shape (T, n, d)
        Positions, um, NaN where missing.
    seen : ndarray of bool, shape (T, n)
        Whether each particle is present.

    Returns
    -------
    PoseFit

    Raises
    ------
    DegenerateClusterError, TooFewFramesError
        As in `track_rotation`.

    Examples
    --------
    >>> triangle = np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 1.0]])
    >>> x = np.stack([triangle, triangle[:, ::-1] * [-1.0, 1.0]])  # turned by 90 degrees
    >>> fit_template(x, np.ones((2, 3), dtype=bool)).rotation[1].round(12) + 0.0
    array([[ 0., -1.],
           [ 1.,  0.]])
    """

    def refined(shape: Floats) -> Floats:
        rotation, unique = fit_rotations(x, shape)
        if not unique.any():
            return shape
        new = _centred_mean(_in_body(x, seen, rotation, shape))
        turn, known = fit_rotations(shape, new)
        return new @ turn.T if known else new

    shape = _fixed_point(refined, x[np.argmax(seen.sum(axis=1))])
    rotation, unique = fit_rotations(x, shape)
    if not unique.any() or not np.isfinite(shape).all():
        raise no_rotation(x)
    return _fit_of(x, seen, rotation, shape)


def fit_chain(x: Floats, seen: Bools) -> PoseFit:
    """Multiply the rotations between successive frames (Hunter 2011, Eq. 13).

    A gap is crossed by the one rotation between its ends. The residuals are those of the steps.

    Parameters
    ----------
    x : ndarray, shape (T, n, d)
        Positions, um, NaN where missing.
    seen : ndarray of bool, shape (T, n)
        Whether each particle is present.

    Returns
    -------
    PoseFit

    Raises
    ------
    DegenerateClusterError, TooFewFramesError
        As in `track_rotation`.

    Examples
    --------
    >>> triangle = np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 1.0]])
    >>> x = np.stack([triangle, triangle[:, ::-1] * [-1.0, 1.0]])  # turned by 90 degrees
    >>> fit_chain(x, np.ones((2, 3), dtype=bool)).rotation[1].round(12) + 0.0
    array([[ 0., -1.],
           [ 1.,  0.]])
    """
    rows, step = chain_steps(x, seen)
    rotation = np.full((len(x), x.shape[2], x.shape[2]), np.nan)
    rotation[rows] = successive_product(step)
    shape = _fixed_point(lambda s: _centred_mean(_in_body(x, seen, rotation, s)), x[rows[0]])
    _, residual, sigma2 = step_residuals(x, seen, rows, step)
    return _fit_of(x, seen, rotation, shape)._replace(residual=residual, sigma2=sigma2)


def chain_steps(x: Floats, seen: Bools) -> tuple[Ints, Floats]:
    """Return the frames that can be chained, and the rotation from each to the next.

    Parameters
    ----------
    x : ndarray, shape (T, n, d)
    seen : ndarray of bool, shape (T, n)

    Returns
    -------
    rows : ndarray of int, shape (K,)
        Frames that can be chained.
    rotation : ndarray, shape (K - 1, d, d)
        Rotation from each of these frames to the next, lab axes.

    Examples
    --------
    >>> triangle = np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 1.0]])
    >>> x = np.stack([triangle, np.full((3, 2), np.nan), triangle + 1.0])
    >>> rows, step = chain_steps(x, np.isfinite(x[..., 0]))
    >>> rows, step.shape
    (array([0, 2]), (1, 2, 2))
    """
    rows = np.flatnonzero(seen.sum(axis=1) >= x.shape[2])
    while rows.size > 1:
        step, unique = fit_rotations(x[rows[1:]], x[rows[:-1]])
        if unique.all():
            require_points(seen[rows], x.shape[2])
            return rows, step
        # A frame that cannot be fitted to the one before it is left out; of a run of them only the
        # first, as the next may be fitted to the frame that then comes before it.
        first = ~unique & np.append(True, unique[:-1])
        rows = rows[np.append(True, ~first)]
    if (seen.sum(axis=1) >= x.shape[2]).sum() > 1:
        raise no_rotation(x)
    raise _too_few_poses(rows.size)


def step_residuals(
    x: Floats, seen: Bools, rows: Ints, step: Floats
) -> tuple[Floats, Floats, float]:
    """Return shift, residuals and localisation error of the steps between successive frames.

    Parameters
    ----------
    x : ndarray, shape (T, n, d)
    seen : ndarray of bool, shape (T, n)
    rows, step : ndarray
        Chained frames and the rotations between them, as `chain_steps` returns them.

    Returns
    -------
    shift : ndarray, shape (K - 1, d)
        Shift of each step, for a rotation about the origin, um.
    residual : ndarray, shape (T, n, d)
        Residuals of the step that ends at each frame, over sqrt(2), um.
    sigma2 : float
        Variance of the localisation error of one coordinate, um^2; NaN where unknown.

    Examples
    --------
    >>> triangle = np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 1.0]])
    >>> x, seen = np.stack([triangle, triangle + 1.0]), np.ones((2, 3), dtype=bool)
    >>> shift, _, sigma2 = step_residuals(x, seen, *chain_steps(x, seen))
    >>> shift.round(12), round(float(sigma2), 12)
    (array([[1., 1.]]), 0.0)
    """
    both = (seen[rows[1:]] & seen[rows[:-1]])[..., None]
    end, begin = np.where(both, x[rows[1:]], np.nan), np.where(both, x[rows[:-1]], np.nan)
    shift = mean_present(end, axis=-2) - np.einsum("tij,tj->ti", step, mean_present(begin, axis=-2))
    turned = np.einsum("tij,tnj->tni", step, begin) + shift[:, None]
    e = np.full_like(x, np.nan)
    e[rows[1:]] = (end - turned) / np.sqrt(2)
    freedom = degrees_of_freedom(both[..., 0].sum(axis=1), x.shape[2]).sum()
    return shift, e, float(np.nansum(e * e)) / freedom if freedom else np.nan


def fit_weighted(
    fit: PoseFit, x: Floats, seen: Bools, variance: Floats
) -> tuple[PoseFit, tuple[Floats, Floats]]:
    """Fit the poses again with weights 1/variance; return them with their errors.

    The fit takes Gauss-Newton steps in the rotation vector (lab axes) and the centre.

    Parameters
    ----------
    fit : PoseFit
        The fit with equal weights; its template is kept.
    x : ndarray, shape (T, n, d)
        Positions, um, NaN where missing.
    seen : ndarray of bool, shape (T, n)
        Whether each particle is present.
    variance : ndarray, shape (n, d)
        Variance of the localisation error of every coordinate of every particle, um^2.

    Returns
    -------
    fit : PoseFit
    errors : tuple of ndarray
        Covariance of the orientations (body axes) and variance of the centres, as `pose_errors`.

    Examples
    --------
    >>> triangle = np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 1.0]])
    >>> x, seen = np.stack([triangle, triangle + 1.0]), np.ones((2, 3), dtype=bool)
    >>> _, (covariance, center) = fit_weighted(fit_template(x, seen), x, seen, np.ones((3, 2)))
    >>> covariance[:, 0, 0].round(9), center.round(9)
    (array([0.3, 0.3]), array([0.33333333, 0.33333333]))
    """
    rows = np.flatnonzero(np.isfinite(fit.rotation[:, 0, 0]))
    d = x.shape[2]
    angles = d * (d - 1) // 2
    rotation, center = fit.rotation[rows], fit.center[rows]
    weight = np.where(seen[rows][..., None], 1 / variance, 0.0)
    points = np.where(seen[rows][..., None], x[rows], 0.0)
    for _ in range(20):
        arm = np.einsum("tij,nj->tni", rotation, fit.template)
        slope = pose_slopes(arm)
        e = points - center[:, None] - arm
        information = np.einsum("tnda,tnd,tndb->tab", slope, weight, slope)
        step = np.linalg.solve(
            information, np.einsum("tnda,tnd,tnd->ta", slope, weight, e)[..., None]
        )[..., 0]
        rotation = exp_map(step[:, :angles]) @ rotation
        center = center + step[:, angles:]
        if np.abs(step[:, :angles]).max() < _LAST_TURN:
            break
    inverse = np.linalg.inv(information)
    # The first pose becomes the identity again: body axes are those of the lab at the first pose.
    first = rotation[0]
    turn = rotation @ first.T if angles == 3 else np.ones((rows.size, 1, 1))
    covariance = np.full((len(x), angles, angles), np.nan)
    covariance[rows] = np.swapaxes(turn, -1, -2) @ inverse[:, :angles, :angles] @ turn
    covariance = 0.5 * (covariance + np.swapaxes(covariance, -1, -2))
    center_error = np.full(len(x), np.nan)
    center_error[rows] = np.trace(inverse[:, angles:, angles:], axis1=1, axis2=2) / d
    rotations, centers = fit.rotation.copy(), fit.center.copy()
    rotations[rows], centers[rows] = rotation @ first.T, center
    rotations[rows[0]] = np.eye(d)
    template = fit.template @ first.T
    body = np.einsum("tij,tni->tnj", rotations, x - centers[:, None]) - template
    residual = np.where(seen[..., None], body, np.nan)
    weighted = PoseFit(rotations, centers, template, residual, fit.sigma2)
    return weighted, (covariance, center_error)


def pose_errors(fit: PoseFit, seen: Bools, noise: Floats) -> tuple[Floats, Floats]:
    """Return the covariance of the orientation and the variance of the centre of every pose.

    Parameters
    ----------
    fit : PoseFit
        A fit with equal weights.
    seen : ndarray of bool, shape (T, n)
        Whether each particle is present.
    noise : ndarray, shape (d,)
        Variance of the localisation error along each lab axis, um^2.

    Returns
    -------
    covariance : ndarray, shape (T, 3, 3) or (T, 1, 1)
        Covariance of the orientation, rad^2, body axes.
    variance : ndarray, shape (T,)
        Variance of one coordinate of the centre, um^2, mean over axes.

    Examples
    --------
    >>> triangle = np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 1.0]])
    >>> x, seen = np.stack([triangle, triangle + 1.0]), np.ones((2, 3), dtype=bool)
    >>> covariance, variance = pose_errors(fit_template(x, seen), seen, np.ones(2))
    >>> covariance[:, 0, 0].round(9), variance.round(9)
    (array([0.3, 0.3]), array([0.33333333, 0.33333333]))
    """
    angles = 3 if len(noise) == 3 else 1
    covariance = np.full((len(seen), angles, angles), np.nan)
    variance = np.full(len(seen), np.nan)
    fitted = np.flatnonzero(np.isfinite(fit.rotation[:, 0, 0]))
    patterns, which = np.unique(seen[fitted], axis=0, return_inverse=True)
    for i, pattern in enumerate(patterns):
        rows = fitted[which.ravel() == i]
        r = fit.rotation[rows]
        body_noise = np.einsum("tij,i,tik->tjk", r, noise, r)
        covariance[rows] = orientation_covariance(fit.template[pattern], body_noise)
        variance[rows] = center_variance(fit.template, pattern, float(np.sqrt(noise.mean())))
    return covariance, variance


def _fixed_point(refined: Callable[[Floats], Floats], shape: Floats) -> Floats:
    """Refine a shape until it changes by rounding only and no particle is added to it."""
    for _ in range(100):
        new = refined(shape)
        change = np.nanmax(np.abs(new - shape))
        size = np.nanmax(np.abs(new - mean_present(new, axis=-2)))
        grown = np.isfinite(new).sum() > np.isfinite(shape).sum()
        shape = new
        if not grown and change <= 1e-14 * size:
            break
    return shape


def _in_body(x: Floats, seen: Bools, rotation: Floats, shape: Floats) -> Floats:
    """Return the particles in the axes of the body, (T, n, d)."""
    center = _shape_centers(x, rotation, shape)
    turned: Floats = np.einsum("tij,tni->tnj", rotation, x - center[:, None])
    body: Floats = np.where(seen[..., None], turned, np.nan)
    return body


def _shape_centers(x: Floats, rotation: Floats, shape: Floats) -> Floats:
    """Return the lab position of the shape's origin, from the particles present in both."""
    known = np.isfinite(x) & np.isfinite(shape)
    arm = mean_present(np.where(known, shape, np.nan), axis=-2)
    centroid = mean_present(np.where(known, x, np.nan), axis=-2)
    center: Floats = centroid - np.einsum("tij,tj->ti", rotation, arm)
    return center


def _centred_mean(body: Floats) -> Floats:
    """Average the frames, and move the centre of the shape to the origin."""
    shape = mean_present(body, axis=0)
    centred: Floats = shape - mean_present(shape, axis=-2)
    return centred


def _fit_of(x: Floats, seen: Bools, rotation: Floats, shape: Floats) -> PoseFit:
    """Turn the template so that the first pose is the identity; return poses and residuals."""
    fitted = np.flatnonzero(np.isfinite(rotation[:, 0, 0]))
    if fitted.size < 2:
        raise _too_few_poses(int(fitted.size))
    gauge = rotation[fitted[0]]
    shape, rotation = shape @ gauge.T, rotation @ gauge.T
    rotation[fitted[0]] = np.eye(len(gauge))
    residual = _in_body(x, seen, rotation, shape) - shape
    d = x.shape[2]
    # The template was fitted too: it takes the degrees of freedom of one complete frame.
    freedom = degrees_of_freedom(seen[fitted].sum(axis=1), d).sum()
    freedom -= degrees_of_freedom(np.array(len(shape)), d)
    sigma2 = float(np.nansum(residual**2) / freedom) if freedom > 0 else np.nan
    return PoseFit(rotation, _shape_centers(x, rotation, shape), shape, residual, sigma2)


def _too_few_poses(count: int) -> TooFewFramesError:
    return TooFewFramesError(
        f"{count} frame{'s' if count != 1 else ''} with a pose: at least 2 are needed for a "
        "rotation",
        count,
    )
