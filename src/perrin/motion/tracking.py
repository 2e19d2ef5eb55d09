"""From positions to motion: where the cluster is and how it is turned in every frame."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from perrin._arrays import Bools, Floats, Ints, as_positions, as_sigma, present, require_positive
from perrin.errors import DegenerateClusterError, TooFewFramesError
from perrin.geometry.rigid import (
    _pose_slopes,
    center_variance,
    degrees_of_freedom,
    orientation_covariance,
)
from perrin.geometry.rotations import exp_map, fit_rotations, successive_product
from perrin.motion.rigid_motion import RigidMotion

if TYPE_CHECKING:
    from collections.abc import Callable


Reference = Literal["template", "previous"]


Weights = Literal["equal", "sigma"]


_CONVERGED = 1e-13  # rad: a Gauss-Newton step this short has arrived


# Standard deviation of a pair's distance over its mean from which on a body is not rigid.
_CHANGES = 0.2


# The width of particles on a line, over their localisation error: that of the mean shape is below 2
# by the noise alone, and sigma_z may be three times the sigma that a distance across it shows.
_WIDE = 6.0


# An axis whose orientation is this uncertain (rad) is not determined: the particles lie on a line
# within the noise, and the small-angle theory of every error has lost its meaning.
_LOST_AXIS = 0.3


def track_rotation(
    positions: ArrayLike,
    *,
    dt: float,
    frames: ArrayLike | None = None,
    times: ArrayLike | None = None,
    reference: Reference = "template",
    sigma: ArrayLike | None = None,
    weights: Weights = "equal",
    piece: ArrayLike | None = None,
) -> RigidMotion:
    """Fit a rigid body to a cluster's particles in every frame and return its motion.

    Parameters
    ----------
    positions : array_like, shape (T, n, d)
        Particle centres, um, d = 2 or 3; NaN where a particle is missing. Identities must be right.
    dt : float
        Time between frames, s.
    frames : array_like of int, shape (T,), optional
        Frame numbers of the rows, rising; missing numbers are gaps. Default 0, 1, 2, ...
    times : array_like, shape (T,), optional
        Times of the rows, s, where frames are not evenly spaced.
    reference : {"template", "previous"}
        "template" fits every frame to one common shape built from all frames (generalised
        Procrustes). "previous" is the paper's product of successive rotations (Hunter 2011,
        Eq. 13), whose orientation drifts under noise.
    sigma : float or array_like, shape (d,), optional
        Known localisation error, um, for `covariance`; default: from the residuals. With
        ``weights="sigma"`` also (n, 1) or (n, d), one for each particle.
    weights : {"equal", "sigma"}
        "sigma" weighs every coordinate of every particle with 1/sigma^2 (poses, not the template):
        for a tetrahedron the variance of the orientation falls to 0.94, 0.70 and 0.42 where sigma_z
        is 1.33, 2 and 3 times sigma_xy.
    piece : array_like of int, shape (T,), optional
        Stretches of doubtless identity, as `settle_identity` finds them; no pair of frames is
        formed across two of them. Default: one.

    Returns
    -------
    RigidMotion
        Frames that cannot be fitted are missing, with their reason.

    Raises
    ------
    DegenerateClusterError
        Fewer than 3 particles (2 in the plane), or particles on one line within the noise.
    TooFewFramesError
        Fewer than 2 frames with a pose.
    ValueError
        For bad shapes or values.

    Examples
    --------
    >>> import numpy as np
    >>> from perrin import Cluster, simulate_motion, track_rotation
    >>> truth = simulate_motion(
    ...     Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=50, rng=np.random.default_rng(1)
    ... )
    >>> motion = track_rotation(truth.positions(), dt=0.7)
    >>> bool(np.allclose(motion.rotation, truth.rotation))
    True
    """
    x = as_positions(positions)
    require_positive(dt=dt)
    if reference not in ("template", "previous"):
        raise ValueError(f'reference: expected "template" or "previous", got {reference!r}')
    time = _times(len(x), dt=dt, frames=frames, times=times)
    stretch = _pieces(len(x), piece)
    given = _given_noise(sigma, x.shape[1:], weights=weights, reference=reference)
    seen = present(x)
    _require_points(seen, x.shape[2])
    fit = _fit_chain(x, seen) if reference == "previous" else _fit_template(x, seen)
    if weights == "equal" or given is None:
        motion = _measured(fit, x, seen, time=time, dt=dt, given=given)
    else:
        fit, errors = _weighted(fit, x, seen, given**2)
        motion = _measured(fit, x, seen, time=time, dt=dt, given=given.mean(axis=0), errors=errors)
    return replace(motion, piece=stretch)


def remove_rotation(
    positions: ArrayLike, *, dt: float = 1.0, frames: ArrayLike | None = None
) -> tuple[Floats, RigidMotion]:
    """Take the bulk rotation and drift off a many-body system (Hunter 2011, conclusion).

    The rotation between successive frames is fitted to the particles seen in both, whose own
    diffusion is noise to it; the steps are multiplied (Eq. 13) and undone.

    Parameters
    ----------
    positions : array_like, shape (T, n, d)
        Particles that move on their own in a frame that turns and drifts, um; NaN where missing.
    dt : float
        Time between frames, s.
    frames : array_like of int, shape (T,), optional
        Frame numbers of the rows.

    Returns
    -------
    positions : ndarray, shape (T, n, d)
        In the axes of the first fitted frame, about the centre of the particles' mean places, um;
        NaN in frames without a pose.
    motion : RigidMotion
        The motion taken off.

    Raises
    ------
    DegenerateClusterError, TooFewFramesError
        As in `track_rotation`.
    ValueError
        For bad shapes or values, and for particles seen only in frames without a pose.

    Examples
    --------
    >>> import numpy as np
    >>> from perrin import Cluster, remove_rotation, simulate_motion
    >>> truth = simulate_motion(Cluster.touching(7, 2.0), D_R=1e-3, dt=1.0, n_frames=50, rng=0)
    >>> still, motion = remove_rotation(truth.positions())
    >>> bool(np.allclose(still, still[0]))
    True
    """
    x = as_positions(positions)
    require_positive(dt=dt)
    time = _times(len(x), dt=dt, frames=frames, times=None)
    seen = present(x)
    _require_points(seen, x.shape[2])
    usable = seen
    while True:
        body, fit = _unturned(x, usable)
        motion = _measured(fit, x, seen, time=time, dt=dt, given=None)
        refused = np.isfinite(fit.center[:, 0]) & np.isnan(motion.center[:, 0])
        if not refused.any():
            return body, motion
        # The error of a frame that hardly fixes a rotation would stay in all later frames.
        usable = usable & ~refused[:, None]


class _Fit(NamedTuple):
    """Poses before they are measured: rows without one are NaN; residual vectors in body axes."""

    rotation: Floats
    center: Floats
    template: Floats
    residual: Floats
    sigma2: float


def _times(count: int, *, dt: float, frames: ArrayLike | None, times: ArrayLike | None) -> Floats:
    """Return the time of each row, from times, or from frame numbers, or from the count."""
    if frames is not None and times is not None:
        raise ValueError("frames and times say the same thing: give one of them")
    source = times if times is not None else frames
    t = np.arange(count, dtype=np.float64) if source is None else np.array(source, np.float64)
    name = "frames" if times is None else "times"
    if t.shape != (count,):
        raise ValueError(f"{name}: expected {count} numbers (one a row), got shape {t.shape}")
    bad = ~np.isfinite(t) | np.append(False, ~(np.diff(t) > 0))
    if bad.any():
        k = int(np.argmax(bad))
        raise ValueError(f"{name}: expected finite, rising numbers, got {t[k]} at row {k}")
    return t if times is not None else t * dt


def _pieces(count: int, piece: ArrayLike | None) -> Ints:
    """Return the piece of each row, a copy."""
    if piece is None:
        return np.zeros(count, dtype=np.int64)
    stretch = np.asarray(piece)
    if stretch.shape != (count,) or not np.issubdtype(stretch.dtype, np.integer):
        raise ValueError(
            f"piece: expected {count} whole numbers (one a row), got {stretch.dtype} of shape "
            f"{stretch.shape}"
        )
    return np.array(stretch, dtype=np.int64)


def _given_noise(
    sigma: ArrayLike | None, shape: tuple[int, ...], *, weights: str, reference: str
) -> Floats | None:
    """Return the stated sigma, (d,), or (n, d) where it is to weigh the particles."""
    if weights not in ("equal", "sigma"):
        raise ValueError(f'weights: expected "equal" or "sigma", got {weights!r}')
    if weights == "equal":
        return None if sigma is None else as_sigma(sigma, shape[1])
    if sigma is None or reference != "template":
        raise ValueError('weights="sigma" needs sigma, and reference="template"')
    s = np.asarray(sigma, dtype=np.float64)
    if s.shape in ((shape[0], 1), shape):
        s = np.broadcast_to(s, shape).copy()
    else:
        s = np.broadcast_to(as_sigma(sigma, shape[1]), shape).copy()
    if not (np.isfinite(s) & (s > 0)).all():
        raise ValueError(f"sigma: expected finite numbers > 0 to weigh with, got {sigma!r}")
    return s


def _require_points(seen: Bools, d: int) -> None:
    """Refuse what no frame can mend: too few particles, or one that never appears."""
    n = seen.shape[1]
    if n < d:
        raise DegenerateClusterError(
            f"{n} particle{'s' if n != 1 else ''}: a rotation in {d} dimensions needs at least {d}",
            (n,),
        )
    never = np.flatnonzero(~seen.any(axis=0))
    if never.size:
        raise ValueError(
            f"particles {never.tolist()} are missing in every frame with a pose: leave them out"
        )


def _fit_template(x: Floats, seen: Bools) -> _Fit:
    """Fit all frames to their common shape: generalised Procrustes, missing points allowed."""

    def refined(shape: Floats) -> Floats:
        rotation, unique = fit_rotations(x, shape)
        if not unique.any():
            return shape
        new = _mean_of(_in_body(x, seen, rotation, shape))
        turn, known = fit_rotations(shape, new)
        return new @ turn.T if known else new

    shape = _settled(refined, x[np.argmax(seen.sum(axis=1))])
    rotation, unique = fit_rotations(x, shape)
    if not unique.any() or not np.isfinite(shape).all():
        raise _no_rotation(x)
    return _finished(x, seen, rotation, shape)


def _fit_chain(x: Floats, seen: Bools) -> _Fit:
    """Multiply the rotations between successive frames (Eq. 13); a gap is one direct rotation."""
    rows, step = _chain_steps(x, seen)
    rotation = np.full((len(x), x.shape[2], x.shape[2]), np.nan)
    rotation[rows] = successive_product(step)
    shape = _settled(lambda s: _mean_of(_in_body(x, seen, rotation, s)), x[rows[0]])
    _, residual, sigma2 = _step_misfit(x, seen, rows, step)
    return _finished(x, seen, rotation, shape)._replace(residual=residual, sigma2=sigma2)


def _unturned(x: Floats, seen: Bools) -> tuple[Floats, _Fit]:
    """Undo the product of the steps (Eq. 13): particles in the moving axes, and the motion."""
    rows, step = _chain_steps(x, seen)
    shift, residual, sigma2 = _step_misfit(x, seen, rows, step)
    rotation = np.full((len(x), x.shape[2], x.shape[2]), np.nan)
    rotation[rows] = successive_product(step)
    # c_{k+1} = R^k c_k + v^k becomes a sum in the axes of the body.
    jumps = np.einsum("tji,tj->ti", rotation[rows[1:]], shift)
    origin = np.concatenate([_mean_present(x[rows[:1]]), jumps]).cumsum(axis=0)
    center = np.full((len(x), x.shape[2]), np.nan)
    center[rows] = np.einsum("tij,tj->ti", rotation[rows], origin)
    body = np.einsum("tji,tnj->tni", rotation, x - center[:, None])
    mean = _nan_mean(body, axis=0)
    middle = _mean_present(mean)
    fit = _Fit(rotation, center + rotation @ middle, mean - middle, residual, sigma2)
    return body - middle, fit


def _step_misfit(x: Floats, seen: Bools, rows: Ints, step: Floats) -> tuple[Floats, Floats, float]:
    """Return the shift of each step about the origin, its residuals over sqrt(2), and sigma^2."""
    both = (seen[rows[1:]] & seen[rows[:-1]])[..., None]
    end, begin = np.where(both, x[rows[1:]], np.nan), np.where(both, x[rows[:-1]], np.nan)
    shift = _mean_present(end) - np.einsum("tij,tj->ti", step, _mean_present(begin))
    turned = np.einsum("tij,tnj->tni", step, begin) + shift[:, None]
    e = np.full_like(x, np.nan)
    e[rows[1:]] = (end - turned) / np.sqrt(2)
    freedom = degrees_of_freedom(both[..., 0].sum(axis=1), x.shape[2]).sum()
    return shift, e, float(np.nansum(e * e)) / freedom if freedom else np.nan


def _chain_steps(x: Floats, seen: Bools) -> tuple[Ints, Floats]:
    """Return the frames that can be chained, and the rotation from each to the next."""
    rows = np.flatnonzero(seen.sum(axis=1) >= x.shape[2])
    while rows.size > 1:
        step, unique = fit_rotations(x[rows[1:]], x[rows[:-1]])
        if unique.all():
            _require_points(seen[rows], x.shape[2])
            return rows, step
        # A frame that cannot follow the one before it goes; of a run of them only the first, for
        # the next may well follow the frame that is then before it.
        first = ~unique & np.append(True, unique[:-1])
        rows = rows[np.append(True, ~first)]
    if (seen.sum(axis=1) >= x.shape[2]).sum() > 1:
        raise _no_rotation(x)
    raise _too_few(rows.size)


def _no_rotation(x: Floats) -> DegenerateClusterError:
    """Return the refusal of frames that no rotation joins, with its cause."""
    _, n, d = x.shape
    seen = present(x).astype(np.float64)
    shared = seen @ seen[np.argmax(seen.sum(axis=1))]
    if np.sum(shared >= d) < 2:
        text = f"no frame shares {d} of the {n} particles with the frame that shows most of them"
    elif d == 3:
        text = f"the {n} particles lie on one line"
    else:
        text = f"the {n} particles are in one place"
    return DegenerateClusterError(
        f"no rotation can be found: {text}", (n,), collinear=text.endswith("line")
    )


def _too_few(count: int) -> TooFewFramesError:
    return TooFewFramesError(
        f"{count} frame{'s' if count != 1 else ''} with a pose: at least 2 are needed to see a "
        "rotation",
        count,
    )


def _settled(refined: Callable[[Floats], Floats], shape: Floats) -> Floats:
    """Refine a shape until it rests to rounding and no particle is added to it any more."""
    for _ in range(100):
        new = refined(shape)
        change, size = np.nanmax(np.abs(new - shape)), np.nanmax(np.abs(new - _mean_present(new)))
        grown = np.isfinite(new).sum() > np.isfinite(shape).sum()
        shape = new
        if not grown and change <= 1e-14 * size:
            break
    return shape


def _in_body(x: Floats, seen: Bools, rotation: Floats, shape: Floats) -> Floats:
    """Return the particles in the axes of the body, (T, n, d)."""
    turned: Floats = np.einsum("tij,tni->tnj", rotation, x - _centers(x, rotation, shape)[:, None])
    body: Floats = np.where(seen[..., None], turned, np.nan)
    return body


def _centers(x: Floats, rotation: Floats, shape: Floats) -> Floats:
    """Return the lab position of the shape's origin, from the particles seen and known."""
    known = np.isfinite(x) & np.isfinite(shape)
    seat = _mean_present(np.where(known, shape, np.nan))
    centroid = _mean_present(np.where(known, x, np.nan))
    center: Floats = centroid - np.einsum("tij,tj->ti", rotation, seat)
    return center


def _mean_present(x: Floats) -> Floats:
    """Average over the particles (second-last axis) that are not NaN; NaN where there are none."""
    return _nan_mean(x, axis=-2)


def _mean_of(body: Floats) -> Floats:
    """Average the frames, and put the centre of the shape at the origin."""
    shape = _nan_mean(body, axis=0)
    centred: Floats = shape - _mean_present(shape)
    return centred


def _nan_mean(x: Floats, *, axis: int) -> Floats:
    here = np.isfinite(x)
    count = here.sum(axis=axis)
    total = np.where(here, x, 0.0).sum(axis=axis)
    mean: Floats = np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0)
    return mean


def _finished(x: Floats, seen: Bools, rotation: Floats, shape: Floats) -> _Fit:
    """Turn the template so that the first pose is the identity; collect residuals and sigma^2."""
    fitted = np.flatnonzero(np.isfinite(rotation[:, 0, 0]))
    if fitted.size < 2:
        raise _too_few(int(fitted.size))
    gauge = rotation[fitted[0]]
    shape, rotation = shape @ gauge.T, rotation @ gauge.T
    rotation[fitted[0]] = np.eye(len(gauge))
    residual = _in_body(x, seen, rotation, shape) - shape
    d = x.shape[2]
    # The template was fitted too: it costs what one frame has.
    freedom = degrees_of_freedom(seen[fitted].sum(axis=1), d).sum()
    freedom -= degrees_of_freedom(np.array(len(shape)), d)
    sigma2 = float(np.nansum(residual**2) / freedom) if freedom > 0 else np.nan
    return _Fit(rotation, _centers(x, rotation, shape), shape, residual, sigma2)


def _weighted(
    fit: _Fit, x: Floats, seen: Bools, variance: Floats
) -> tuple[_Fit, tuple[Floats, Floats]]:
    """Fit the poses again with weights 1/variance (n, d); return them and their errors.

    Gauss-Newton steps in the rotation vector (lab axes) and the centre.
    """
    rows = np.flatnonzero(np.isfinite(fit.rotation[:, 0, 0]))
    d, angles = x.shape[2], fit.rotation.shape[1] * (fit.rotation.shape[1] - 1) // 2
    rotation, center = fit.rotation[rows], fit.center[rows]
    weight = np.where(seen[rows][..., None], 1 / variance, 0.0)
    points = np.where(seen[rows][..., None], x[rows], 0.0)
    for _ in range(20):
        arm = np.einsum("tij,nj->tni", rotation, fit.template)
        slope = _pose_slopes(arm)
        e = points - center[:, None] - arm
        information = np.einsum("tnda,tnd,tndb->tab", slope, weight, slope)
        step = np.linalg.solve(
            information, np.einsum("tnda,tnd,tnd->ta", slope, weight, e)[..., None]
        )[..., 0]
        rotation = exp_map(step[:, :angles]) @ rotation
        center = center + step[:, angles:]
        if np.abs(step[:, :angles]).max() < _CONVERGED:
            break
    inverse = np.linalg.inv(information)
    covariance = np.full((len(x), angles, angles), np.nan)
    turn = rotation @ rotation[0].T if d == 3 else np.ones((rows.size, 1, 1))
    covariance[rows] = np.swapaxes(turn, -1, -2) @ inverse[:, :angles, :angles] @ turn
    covariance = 0.5 * (covariance + np.swapaxes(covariance, -1, -2))
    center_error = np.full(len(x), np.nan)
    center_error[rows] = np.trace(inverse[:, angles:, angles:], axis1=1, axis2=2) / d
    return _turned(fit, rows, rotation, center, x, seen), (covariance, center_error)


def _turned(
    fit: _Fit, rows: Ints, rotation: Floats, center: Floats, x: Floats, seen: Bools
) -> _Fit:
    """Return a fit with other poses, its first one the identity again."""
    gauge = rotation[0]
    turns, places = fit.rotation.copy(), fit.center.copy()
    turns[rows], places[rows] = rotation @ gauge.T, center
    turns[rows[0]] = np.eye(len(gauge))
    template = fit.template @ gauge.T
    body = np.einsum("tij,tni->tnj", turns, x - places[:, None]) - template
    return fit._replace(
        rotation=turns,
        center=places,
        template=template,
        residual=np.where(seen[..., None], body, np.nan),
    )


def _measured(
    fit: _Fit,
    x: Floats,
    seen: Bools,
    *,
    time: Floats,
    dt: float,
    given: Floats | None,
    errors: tuple[Floats, Floats] | None = None,
) -> RigidMotion:
    """Add what every pose is worth, refuse those worth nothing, and build the result."""
    d = x.shape[2]
    noise = np.full(d, fit.sigma2) if given is None else given**2
    covariance, variance = _pose_errors(fit, seen, noise) if errors is None else errors
    worst = np.sqrt(np.linalg.eigvalsh(np.nan_to_num(covariance))[:, -1])
    lost = worst > _LOST_AXIS
    fitted = np.isfinite(fit.rotation[:, 0, 0]) & ~lost
    if fitted.sum() < 2:
        raise _no_orientation(
            x, fit.template, float(np.sqrt(noise.mean())), tuple(np.flatnonzero(lost).tolist())
        )
    square = np.where(seen[..., None], fit.residual, np.nan) ** 2
    nan = np.where(fitted, 0.0, np.nan)
    return RigidMotion(
        time=time,
        center=fit.center + nan[:, None],
        rotation=fit.rotation + nan[:, None, None],
        residual=np.sqrt(_nan_mean(square.sum(axis=2), axis=1)) + nan,
        n_present=seen.sum(axis=1),
        covariance=covariance + nan[:, None, None],
        center_variance=variance + nan,
        piece=np.zeros(len(x), dtype=np.int64),
        reason=_reasons(seen, fitted, lost, d),
        template=fit.template,
        sigma=float(np.sqrt(fit.sigma2)),
        noise=np.sqrt(noise),
        dt=float(dt),
    )


def _no_orientation(
    x: Floats, template: Floats, noise: float, lost: tuple[int, ...]
) -> DegenerateClusterError:
    """Return the refusal of a body of which no frame fixes the orientation, with its cause.

    Distances that change, or particles on a line: their width is then of the order of the noise
    that the steadiest distance shows.
    """
    n, d = template.shape
    change, pair, scale = _distance_changes(x)
    extent = np.linalg.svd(template, compute_uv=False) / np.sqrt(n)
    wide = d == 3 and extent[1] > _WIDE * _steadiest_noise(x)
    if change > _CHANGES or (wide and change > 0):
        cause = (
            "more than one body under this number, or labels that change?"
            if scale is None
            else f"with z multiplied by {scale:.3g} all are constant: z is in another unit?"
        )
        return DegenerateClusterError(
            f"the {n} particles are no rigid body: the distance of particles {pair[0]} and "
            f"{pair[1]} (counted from 0) changes by {change:.0%} (standard deviation over mean): "
            f"{cause}",
            lost,
        )
    if d == 2:
        return DegenerateClusterError(
            f"the {n} particles are in one place within the noise: extent {extent[0]:.3g} um, "
            f"localisation error {noise:.3g} um",
            lost,
        )
    return DegenerateClusterError(
        f"the {n} particles lie on one line within the noise: length {extent[0]:.3g} um, width "
        f"{extent[1]:.3g} um (root mean squares), localisation error {noise:.3g} um",
        lost,
        collinear=True,
    )


def _steadiest_noise(x: Floats) -> float:
    """Return the localisation error of one coordinate that the steadiest pair of particles shows.

    The distance of two particles scatters by sqrt(2) of it; half of the absolute deviations from
    the median are below 0.6745 of that.
    """
    i, j = np.triu_indices(x.shape[1], 1)
    distance = np.linalg.norm(x[:, i] - x[:, j], axis=2)
    distance = distance[:, np.isfinite(distance).any(axis=0)]
    off = np.nanmedian(np.abs(distance - np.nanmedian(distance, axis=0)), axis=0)
    return float(off.min(initial=np.inf) / 0.6745 / np.sqrt(2))


def _distance_changes(x: Floats) -> tuple[float, tuple[int, int], float | None]:
    """Return the largest relative scatter of a pair's distance, the pair, and the scale of z.

    The scale is the factor on z that makes the squared distances most constant, where it makes
    them constant within a tenth of their scatter: of w . (x^2 + y^2, z^2) the ratio of mean square
    to variance is largest for the w of a generalised eigenvector.
    """
    i, j = np.triu_indices(x.shape[1], 1)
    square = (x[:, i] - x[:, j]) ** 2
    distance = np.sqrt(square.sum(axis=2))
    mean = _nan_mean(distance, axis=0)
    scatter = np.sqrt(_nan_mean((distance - mean) ** 2, axis=0))
    change = np.divide(scatter, mean, out=np.zeros_like(mean), where=mean > 0)
    k = int(np.argmax(np.nan_to_num(change)))
    worst, pair = float(np.nan_to_num(change)[k]), (int(i[k]), int(j[k]))
    if x.shape[2] == 2 or not worst > 0:
        return worst, pair, None
    parts = np.stack([square[..., :2].sum(axis=2), square[..., 2]], axis=-1)
    middle = _nan_mean(parts, axis=0)
    off = (parts - middle)[np.isfinite(parts).all(axis=2)]
    variance, power = off.T @ off, middle.T @ middle
    if not np.linalg.cond(variance) < 1e12:
        return worst, pair, None
    value, vector = np.linalg.eig(np.linalg.solve(variance, power))
    w = vector[:, int(np.argmax(value.real))].real
    left = float(w @ variance @ w) / float(w @ power @ w)
    before = float(variance.sum()) / float(power.sum())
    if not (w[0] * w[1] > 0 and left < 0.01 * before):
        return worst, pair, None
    return worst, pair, float(np.sqrt(w[1] / w[0]))


def _pose_errors(fit: _Fit, seen: Bools, noise: Floats) -> tuple[Floats, Floats]:
    """Return the covariance of the orientation and the variance of the centre of every pose."""
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


def _reasons(seen: Bools, fitted: Bools, lost: Bools, d: int) -> tuple[str, ...]:
    """Say for every frame without a pose why it has none."""
    n = seen.shape[1]

    def reason(count: int, ok: bool, blurred: bool) -> str:
        if ok:
            return ""
        if count < d:
            return f"{count} of {n} particles, {d} needed" if count else "no particles"
        if blurred:
            return (
                f"the {count} particles present lie too near one line for their noise: the "
                f"orientation is uncertain by over {_LOST_AXIS} rad"
            )
        return f"the {count} particles present do not fix a rotation"

    rows = zip(seen.sum(axis=1), fitted, lost, strict=True)
    return tuple(reason(int(c), bool(ok), bool(bad)) for c, ok, bad in rows)
