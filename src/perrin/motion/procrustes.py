"""Fits of a rigid body to all frames: to one common shape, or from each frame to the next."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from perrin._arrays import count_present
from perrin.errors import DegenerateClusterError, TooFewFramesError
from perrin.geometry.rigid import (
    center_variance,
    degrees_of_freedom,
    orientation_covariance,
    pose_slopes,
)
from perrin.geometry.rotations import exp_map, fit_rotations, successive_product
from perrin.geometry.shapes import centred, centroids
from perrin.motion.degenerate import mean_present, no_rotation, require_points

if TYPE_CHECKING:
    from perrin._arrays import Bools, Floats, Ints

# Largest rotation (rad) of a last Gauss-Newton step: rounding of a rotation matrix.
_LAST_TURN = 1e-13


class PoseFit(NamedTuple):
    """Poses of all frames before their errors are known; frames without a pose are NaN.

    The fits of B bodies together have a first axis of length B.

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
    sigma2 : float or ndarray, shape (B,)
        Variance of the localisation error of one coordinate, from the residuals, um^2.
    """

    rotation: Floats
    center: Floats
    template: Floats
    residual: Floats
    sigma2: float | Floats


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
    fit, faults = fit_templates(x[None], seen[None])
    if faults[0] is not None:
        raise faults[0]
    return PoseFit(*(np.asarray(part)[0] for part in fit))


def fit_templates(
    x: Floats, seen: Bools
) -> tuple[PoseFit, list[DegenerateClusterError | TooFewFramesError | None]]:
    """Fit the frames of each of several bodies to their common shape, as `fit_template`.

    Parameters
    ----------
    x : ndarray, shape (B, T, n, d)
        Positions, um, NaN where missing.
    seen : ndarray of bool, shape (B, T, n)
        Whether each particle is present.

    Returns
    -------
    fit : PoseFit
        Of all bodies; that of a body without a fit has no meaning.
    faults : list of DegenerateClusterError, TooFewFramesError or None
        The error that `fit_template` raises for each body.

    Examples
    --------
    >>> triangle = np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 1.0]])
    >>> x = np.stack([triangle, triangle[:, ::-1] * [-1.0, 1.0]])  # turned by 90 degrees
    >>> fit, faults = fit_templates(np.stack([x, x + 9.0]), np.ones((2, 2, 3), dtype=bool))
    >>> fit.template.shape, faults
    ((2, 3, 2), [None, None])
    """
    shape = x[np.arange(len(x)), np.argmax(count_present(seen), axis=1)]
    moving = np.arange(len(x))
    arms = arms_of_particles(x) if seen.all() else None
    for _ in range(100):
        every = moving.size == len(x)
        some, here = (x, seen) if every else (x[moving], seen[moving])
        before = shape[moving]
        turned, found = fit_rotations(some, before[:, None])
        if every:
            rotation, unique = turned, found
        else:
            rotation[moving], unique[moving] = turned, found
        if arms is None:
            new = _mean_in_body(some, here, turned, before)
        else:
            new = _mean_of_complete(arms if every else arms[moving], turned, found)
        back, known = fit_rotations(before, new)
        new = np.where(known[:, None, None], new @ np.swapaxes(back, -1, -2), new)
        usable = np.asarray(found.any(axis=1))
        new = np.where(usable[:, None, None], new, before)
        change = np.nan_to_num(np.abs(new - before)).max(axis=(1, 2))
        arm = new - mean_present(new, axis=-2)[:, None]
        size = np.nan_to_num(np.abs(arm)).max(axis=(1, 2))
        grown = np.isfinite(new).sum(axis=(1, 2)) > np.isfinite(before).sum(axis=(1, 2))
        shape[moving] = new
        # The shape is final when it changes by rounding only and no particle is added to it.
        moving = moving[grown | ~(change <= 1e-14 * size)]
        if not moving.size:
            break
    else:
        rotation[moving], unique[moving] = fit_rotations(x[moving], shape[moving][:, None])
    faults: list[DegenerateClusterError | TooFewFramesError | None] = [None] * len(x)
    for k in np.flatnonzero(~unique.any(axis=1) | ~np.isfinite(shape).all(axis=(1, 2))).tolist():
        faults[k] = no_rotation(x[k])
    poses = unique.sum(axis=1)
    for k in np.flatnonzero(poses < 2).tolist():
        faults[k] = faults[k] or _too_few_poses(int(poses[k]))
    return _fit_of(x, seen, rotation, shape), faults


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
    shape = x[rows[0]]
    for _ in range(100):
        new = _mean_in_body(x, seen, rotation, shape)
        change = np.nanmax(np.abs(new - shape))
        size = np.nanmax(np.abs(new - mean_present(new, axis=-2)))
        grown = np.isfinite(new).sum() > np.isfinite(shape).sum()
        shape = new
        if not grown and change <= 1e-14 * size:
            break
    _, residual, sigma2 = step_residuals(x, seen, rows, step)
    chained = _fit_of(x[None], seen[None], rotation[None], shape[None])
    rotation, center, template = chained.rotation[0], chained.center[0], chained.template[0]
    return PoseFit(rotation, center, template, residual, sigma2)


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
        Fits of B bodies with equal weights.
    seen : ndarray of bool, shape (B, T, n)
        Whether each particle is present.
    noise : ndarray, shape (B, d)
        Variance of the localisation error along each lab axis, um^2.

    Returns
    -------
    covariance : ndarray, shape (B, T, 3, 3) or (B, T, 1, 1)
        Covariance of the orientation, rad^2, body axes.
    variance : ndarray, shape (B, T)
        Variance of one coordinate of the centre, um^2, mean over axes.

    Examples
    --------
    >>> triangle = np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 1.0]])
    >>> x, seen = np.stack([triangle, triangle + 1.0])[None], np.ones((1, 2, 3), dtype=bool)
    >>> covariance, variance = pose_errors(fit_templates(x, seen)[0], seen, np.ones((1, 2)))
    >>> covariance[0, :, 0, 0].round(9), variance[0].round(9)
    (array([0.3, 0.3]), array([0.33333333, 0.33333333]))
    """
    bodies, frames, n = seen.shape
    d = noise.shape[1]
    angles = 3 if d == 3 else 1
    covariance = np.full((bodies, frames, angles, angles), np.nan)
    variance = np.full((bodies, frames), np.nan)
    fitted = np.isfinite(fit.rotation[..., 0, 0])
    sigma = np.sqrt(noise.mean(axis=1))
    equal = np.ptp(noise, axis=1) == 0
    first, which = np.zeros(1, dtype=np.int64), np.zeros((bodies, frames), dtype=np.int64)
    if not seen.all():
        code = np.packbits(seen, axis=2).reshape(bodies * frames, -1)
        _, first, found = np.unique(code, axis=0, return_index=True, return_inverse=True)
        which = found.reshape(bodies, frames)
    for i in range(len(first)):
        pattern = seen.reshape(-1, n)[first[i]]
        rows = fitted & (which == i)
        some = np.flatnonzero(rows.any(axis=1))
        if not some.size:
            continue
        template, poses = fit.template[some], rows[some].sum(axis=1)
        variance[rows] = np.repeat(center_variance(template, pattern, sigma[some]), poses)
        # Noise that is equal along all axes is the same in body axes.
        of_body = noise[some, 0][:, None, None] * np.eye(d)
        of_poses = orientation_covariance(template[:, pattern], of_body)
        covariance[rows] = np.repeat(of_poses, poses, axis=0)
        for k in some[~equal[some]].tolist():
            r = fit.rotation[k, rows[k]]
            body_noise = np.einsum("tij,i,tik->tjk", r, noise[k], r)
            covariance[k, rows[k]] = orientation_covariance(fit.template[k, pattern], body_noise)
    return covariance, variance


def _in_body(x: Floats, seen: Bools, rotation: Floats, center: Floats) -> Floats:
    """Return the particles in the axes of the body, (..., T, n, d), the frames last in memory."""
    # Products of a few coordinates are those of long vectors.
    arm, r = (np.ascontiguousarray(np.moveaxis(a, -3, -1)) for a in (x, rotation))
    arm = arm - np.swapaxes(center, -1, -2)[..., None, :, :]
    turned = np.moveaxis(np.einsum("...aik,...nak->...nik", r, arm), -1, -3)
    return turned if seen.all() else np.where(seen[..., None], turned, np.nan)


def _shape_centers(x: Floats, rotation: Floats, shape: Floats) -> Floats:
    """Return the lab position of the shape's origin, from the particles present in both."""
    centroid = centroids(x)
    if np.isfinite(centroid).all() and np.isfinite(shape).all():
        arm = shape.mean(axis=-2)[..., None, :]
    else:
        known = np.isfinite(x) & np.isfinite(shape[..., None, :, :])
        arm = mean_present(np.where(known, shape[..., None, :, :], np.nan), axis=-2)
        centroid = mean_present(np.where(known, x, np.nan), axis=-2)
    r = np.ascontiguousarray(np.moveaxis(rotation, -3, -1))
    lever = np.einsum("...ijk,...jk->...ik", r, np.swapaxes(arm, -1, -2))
    center: Floats = centroid - np.swapaxes(lever, -1, -2)
    return center


def _mean_in_body(x: Floats, seen: Bools, rotation: Floats, shape: Floats) -> Floats:
    """Average the particles in the axes of the body over the frames; their centre is the origin."""
    body = _in_body(x, seen, rotation, _shape_centers(x, rotation, shape))
    mean = mean_present(body, axis=-3)
    mean_shape: Floats = mean - mean_present(mean, axis=-2)[..., None, :]
    return mean_shape


def arms_of_particles(x: Floats) -> Floats:
    """Return each particle's positions relative to the centroids of its frames.

    Parameters
    ----------
    x : ndarray, shape (B, T, n, d)

    Returns
    -------
    ndarray, shape (B, n, T d)

    Examples
    --------
    >>> arms_of_particles(np.array([[[[0.0, 0.0], [4.0, 2.0]]]]))
    array([[[-2., -1.],
            [ 2.,  1.]]])
    """
    along = np.ascontiguousarray(np.moveaxis(x, 1, -1))  # the frames last: sums of long vectors
    along = along - along.sum(axis=1, keepdims=True) / x.shape[2]
    arms: Floats = np.swapaxes(along, 2, 3).reshape(len(x), x.shape[2], -1)
    return arms


def _mean_of_complete(arms: Floats, rotation: Floats, unique: Bools) -> Floats:
    """Return what `_mean_in_body` returns for frames without missing particles.

    A particle's mean in the axes of the body is the sum of R^T (x - centroid) over the frames: one
    product of matrices.
    """
    bodies, _, d, _ = rotation.shape
    known = rotation if unique.all() else np.where(unique[..., None, None], rotation, 0.0)
    total: Floats = arms @ known.reshape(bodies, -1, d)
    mean = total / np.maximum(unique.sum(axis=1), 1)[:, None, None]
    return centred(mean)


def _fit_of(x: Floats, seen: Bools, rotation: Floats, shape: Floats) -> PoseFit:
    """Turn the templates so that the first pose is the identity; return poses and residuals."""
    bodies, d = np.arange(len(x)), x.shape[3]
    fitted = np.isfinite(rotation[..., 0, 0])
    first = np.argmax(fitted, axis=1)
    gauge = np.swapaxes(rotation[bodies, first], 1, 2)
    shape, turned = shape @ gauge, rotation.reshape(len(x), -1, d) @ gauge
    rotation = turned.reshape(rotation.shape)
    rotation[bodies, first] = np.eye(d)
    center = _shape_centers(x, rotation, shape)
    residual = _in_body(x, seen, rotation, center) - shape[:, None]
    # The template was fitted too: it takes the degrees of freedom of one complete frame.
    freedom = (degrees_of_freedom(count_present(seen), d) * fitted).sum(axis=1)
    freedom = freedom - degrees_of_freedom(np.array(shape.shape[1]), d)
    known = np.where(np.isnan(residual), 0.0, residual)
    square = np.einsum("btni,btni->b", known, known)
    sigma2 = np.divide(square, freedom, out=np.full(len(x), np.nan), where=freedom > 0)
    return PoseFit(rotation, center, shape, residual, sigma2)


def _too_few_poses(count: int) -> TooFewFramesError:
    return TooFewFramesError(
        f"{count} frame{'s' if count != 1 else ''} with a pose: at least 2 are needed for a "
        "rotation",
        count,
    )
