"""Poses of bodies whose particles are recorded one after another, as planes of a scan are."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from perrin.geometry.rigid import orientation_covariance, pose_slopes
from perrin.geometry.rotations import exp_map, log_map
from perrin.motion.degenerate import mean_present
from perrin.motion.procrustes import PoseFit, fit_template

if TYPE_CHECKING:
    from perrin._arrays import Bools, Floats, Ints
    from perrin.motion.rigid_motion import RigidMotion

# Rounds of diffusion, localisation error, poses and shape: each depends on the others.
_SCAN_ROUNDS = 6

# Nodes of the average over the planes through one particle.
_NODES = 6

# The moments of a few steps can give a D near zero or below; it is at least this share of what the
# mean square step would give without noise.
_LEAST_SHARE = 0.2

# Positions without noise are exact to this share of the body's size.
_ROUNDING = 1e-9

# The error of an axis is at least a third of the largest one: few frames can give zero.
_LEAST_AXIS = 0.1


class ScannedFit(NamedTuple):
    """Poses at one instant of every frame, with the errors that the scan leaves in them.

    The instant is the mean time of the particles present, at which their own motion before and
    after it enters the steps as noise that is independent from frame to frame.

    Attributes
    ----------
    fit : PoseFit
        Poses; residuals are those of the positions at the instant.
    instant : ndarray, shape (T, n, d)
        Positions less the expected motion of each particle between the instant and its own time,
        um.
    covariance : ndarray, shape (T, a, a)
        Covariance of the orientation, body axes, rad^2.
    center_variance : ndarray, shape (T,)
        Variance of one coordinate of the centre, mean over axes, um^2.
    turn_noise : ndarray, shape (T, a, a)
        What takes the place of `covariance` in the covariance of steps, rad^2: the errors
        contain the body's own motion, which the steps contain too.
    center_noise : ndarray, shape (T,)
        The same for `center_variance`, um^2; negative where averaging over the scan outweighs
        the noise.
    noise : ndarray, shape (d,)
        Localisation error of each lab axis, um.
    """

    fit: PoseFit
    instant: Floats
    covariance: Floats
    center_variance: Floats
    turn_noise: Floats
    center_noise: Floats
    noise: Floats


def fit_scanned(
    x: Floats,
    seen: Bools,
    delay: Floats,
    *,
    time: Floats,
    piece: Ints,
    sigma: Floats | None = None,
    crossing: float = 0.0,
    least: Floats | None = None,
) -> ScannedFit:
    """Fit a rigid body to particles that are recorded at their own times.

    Parameters
    ----------
    x : ndarray, shape (T, n, d)
        Positions, um, NaN where missing.
    seen : ndarray of bool, shape (T, n)
        Whether each particle is present.
    delay : ndarray, shape (T, n)
        Time of each particle after that of its frame, s.
    time : ndarray, shape (T,)
        Time of each frame, s.
    piece : ndarray of int, shape (T,)
        Pieces of the track, across which no steps are formed.
    sigma : ndarray, shape (d,), optional
        Known localisation error of each axis, um; default: from the residuals.
    crossing : float
        Time in which the planes through one particle are recorded, s.
    least : ndarray, shape (d,), optional
        Smallest localisation error of each axis that is possible, um.

    Returns
    -------
    ScannedFit

    Raises
    ------
    DegenerateClusterError, TooFewFramesError
        As in `track_rotation`.

    Notes
    -----
    A coordinate a of particle i is that of the body's motion b since the instant, averaged over
    the planes that show it: b_a = H_a <b(t_i + u)>, with the slopes H of the pose. x and y come
    from the outlines of a sphere in all its planes (weights of a semicircle over `crossing`), z
    from its top and its bottom (half of the weight at either end). Brownian motion has
    <b(t) b(t')> = Q (|t| + |t'| - |t - t'|)/2, Q = diag(2 D_R, 2 D_T). The poses are those of
    generalised least squares with the covariance V of these averages and of the localisation
    errors; with their weights W their covariance is P = (H^T V^-1 H)^-1. The error of a pose and
    the step that begins with it have the covariance sum W_i H_i Q <(t_i + u)^+>, that with the step
    before it the same of the times before the instant; where the mean of t_i is zero, steps
    therefore have the covariance of independent noise P - sym(sum W_i H_i Q <|t_i + u|>)/2 in each
    frame. D_T and D_R are those of the covariance estimator of the steps; sigma^2 is that of
    restricted maximum likelihood.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> body = Cluster.tetrahedron(1.5)
    >>> truth = simulate_motion(body, D_R=5e-3, D_T=0.04, dt=0.7, n_frames=50, rng=3)
    >>> x = truth.positions()
    >>> scanned = fit_scanned(
    ...     x, np.isfinite(x[..., 0]), np.zeros((50, 4)), time=truth.time, piece=truth.piece
    ... )
    >>> bool(np.allclose(scanned.fit.rotation, truth.rotation))
    True
    """
    n, d = x.shape[1:]
    angles = d * (d - 1) // 2
    fit = fit_template(x, seen)
    rows = np.flatnonzero(np.isfinite(fit.rotation[:, 0, 0]))
    here = seen[rows]
    absent = np.repeat(~here, d, axis=1)
    t = np.where(here, delay[rows], 0.0)
    t = np.where(here, t - (t.sum(axis=1) / here.sum(axis=1))[:, None], 0.0)
    shared, away = _averaged_brownian(t, d, crossing=crossing)
    points = np.where(here[..., None], x[rows], 0.0)
    rotation, center, template = fit.rotation[rows], fit.center[rows], fit.template
    rounding = (_ROUNDING * np.abs(fit.template).max()) ** 2
    variance = np.full(d, max(fit.sigma2, rounding)) if sigma is None else sigma**2
    instant = x.copy()
    inside = piece[rows[1:]] == piece[rows[:-1]]
    linked, duration = inside[1:] & inside[:-1], np.diff(time[rows]) @ inside
    share = inside.sum() / max(int(linked.sum()), 1)
    for _ in range(_SCAN_ROUNDS):
        # D_R and D_T of the covariance estimator of the steps, from all axes together.
        turn = log_map(np.swapaxes(rotation[:-1], 1, 2) @ rotation[1:])
        D = []
        for steps in (turn.reshape(len(turn), -1), np.diff(center, axis=0)):
            square = np.sum(steps[inside] ** 2)
            # The last step has no next one: the noise of both is that of all steps.
            product = share * np.sum((steps[:-1] * steps[1:])[linked])
            whole = 2 * duration * steps.shape[1]
            D.append(max(square + 2 * product, _LEAST_SHARE * square) / whole)
        Q = np.diag([2 * D[0]] * angles + [2 * D[1]] * d)
        arm = np.einsum("tij,nj->tni", rotation, template)
        slope = pose_slopes(arm) * here[..., None, None]
        moved = np.einsum("tmda,ab,tneb,tmdne->tmdne", slope, Q, slope, shared)
        moved = moved.reshape(len(rows), n * d, n * d)
        slope = slope.reshape(len(rows), n * d, -1)
        e = ((points - center[:, None] - arm) * here[..., None]).reshape(len(rows), n * d)
        if sigma is None:
            variance = _restricted_variance(moved, slope, e, variance, absent)
            variance = np.maximum(variance, max(_LEAST_AXIS * variance.max(), rounding))
            if least is not None:
                variance = np.maximum(variance, least**2)
        inverse, P = _generalised_inverses(moved, slope, variance, absent)
        weights = P @ np.swapaxes(slope, 1, 2) @ inverse
        step = np.einsum("tas,ts->ta", weights, e)
        rest = e - np.einsum("tsa,ta->ts", slope, step)
        between = np.einsum("trs,tsu,tu->tr", moved, inverse, rest).reshape(points.shape)
        instant[rows] = x[rows] - between
        rotation = exp_map(step[:, :angles]) @ rotation
        center = center + step[:, angles:]
        body = np.einsum("tij,tni->tnj", rotation, instant[rows] - center[:, None])
        template = mean_present(np.where(here[..., None], body, np.nan), axis=0)
        middle = template.mean(axis=0)
        template, center = template - middle, center + rotation @ middle
    own = weights @ (slope * away.reshape(len(rows), n * d)[..., None]) @ Q
    noise = P - 0.5 * (own + np.swapaxes(own, 1, 2))
    # Body axes are those of the lab at the first pose.
    rotation, template = rotation @ rotation[0].T, template @ rotation[0].T
    turn = rotation if angles == 3 else np.ones((len(rows), 1, 1))
    every = _Rows(len(x), rows)
    poses = every.filled(rotation)
    body = np.einsum("tij,tni->tnj", poses, instant - every.filled(center)[:, None])
    in_body = [np.swapaxes(turn, 1, 2) @ c[:, :angles, :angles] @ turn for c in (P, noise)]
    # Symmetric to the last bit, as tables store one triangle of it.
    in_body = [0.5 * (c + np.swapaxes(c, 1, 2)) for c in in_body]
    mean_axis = [np.trace(c[:, angles:, angles:], axis1=1, axis2=2) / d for c in (P, noise)]
    residual = np.where(seen[..., None], body - template, np.nan)
    return ScannedFit(
        fit=PoseFit(poses, every.filled(center), template, residual, float(variance.mean())),
        instant=instant,
        covariance=every.filled(in_body[0]),
        center_variance=every.filled(mean_axis[0]),
        turn_noise=every.filled(in_body[1]),
        center_noise=every.filled(mean_axis[1]),
        noise=np.sqrt(variance),
    )


class _Rows(NamedTuple):
    """The rows of all frames that have a pose."""

    total: int
    rows: Ints

    def filled(self, values: Floats) -> Floats:
        """Return the values of the rows in an array of all frames, NaN elsewhere."""
        out = np.full((self.total, *values.shape[1:]), np.nan)
        out[self.rows] = values
        return out


def _averaged_brownian(t: Floats, d: int, *, crossing: float) -> tuple[Floats, Floats]:
    """Return covariances of a Brownian motion since t = 0, averaged over the planes of particles.

    Returns
    -------
    covariance : ndarray, shape (T, n, d, n, d)
        (<|t|> + <|t'|> - <|t - t'|>)/2 of all pairs of coordinates, s.
    away : ndarray, shape (T, n, d)
        <|t|> of every coordinate, s.
    """
    # Gauss's nodes for a semicircle: Chebyshev's of the second kind.
    k = np.arange(1, _NODES + 1) * np.pi / (_NODES + 1)
    half_circle = np.cos(k), np.sin(k) ** 2 / np.sum(np.sin(k) ** 2)
    ends = np.array([-1.0, 1.0]), np.array([0.5, 0.5])
    one = (np.zeros(1), np.ones(1))
    spread = [half_circle, half_circle, ends][:d] if crossing > 0 else [one] * d
    at = [(t[..., None] + 0.5 * crossing * u, w) for u, w in spread]
    away = np.stack([np.abs(times) @ w for times, w in at], axis=-1)
    count, n = t.shape
    covariance = np.empty((count, n, d, n, d))
    for a, (first, w) in enumerate(at):
        for b, (second, v) in enumerate(at):
            apart = np.abs(first[:, :, None, :, None] - second[:, None, :, None, :]) @ v @ w
            covariance[:, :, a, :, b] = away[:, :, None, a] + away[:, None, :, b] - apart
    return 0.5 * covariance, away


def _generalised_inverses(
    moved: Floats, slope: Floats, variance: Floats, absent: Bools
) -> tuple[Floats, Floats]:
    """Return V^-1 without absent particles, and P = (H^T V^-1 H)^-1, of every frame."""
    size = moved.shape[1]
    noise = np.tile(variance, size // len(variance))
    full = moved + np.eye(size) * np.where(absent, 1.0, noise)[:, None, :]
    inverse = np.asarray(np.linalg.inv(full), dtype=np.float64)
    P = np.asarray(np.linalg.inv(np.swapaxes(slope, 1, 2) @ inverse @ slope), dtype=np.float64)
    return inverse, 0.5 * (P + np.swapaxes(P, 1, 2))


def _restricted_variance(
    moved: Floats, slope: Floats, e: Floats, variance: Floats, absent: Bools
) -> Floats:
    """Return one scoring step of the localisation errors (um^2) of the plane and of z.

    With M = V^-1 - V^-1 H P H^T V^-1 the restricted likelihood has the score e^T M S M e - tr(M S)
    for the variance of the coordinates that S selects, and the information tr(M S M S')/2.
    """
    d = len(variance)
    inverse, P = _generalised_inverses(moved, slope, variance, absent)
    known = inverse @ slope
    M = inverse - known @ P @ np.swapaxes(known, 1, 2)
    groups = [[0, 1], [2]] if d == 3 else [[0, 1]]
    selected = [np.isin(np.arange(e.shape[1]) % d, g) & ~absent for g in groups]
    turned = np.einsum("tij,tj->ti", M, e)
    score = np.array([np.sum(turned[s] ** 2) - np.einsum("tii->ti", M)[s].sum() for s in selected])
    information = np.array(
        [[np.einsum("tij,ti,tj->", M**2, a, b) for b in selected] for a in selected]
    )
    change = np.linalg.lstsq(information, score, rcond=None)[0]
    found = variance.copy()
    for group, more in zip(groups, change, strict=True):
        # A variance stays positive, and falls by at most ten in one step.
        found[group] = max(variance[group[0]] + more, 0.1 * variance[group[0]])
    return found


def scan_share(motion: RigidMotion) -> float:
    """Return the share of the variance of the orientations that is motion during the scan.

    Parameters
    ----------
    motion : RigidMotion
        As `track_rotation` returns it, with `delays` or without.

    Returns
    -------
    float
        0 where all particles are recorded at once.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> scan_share(simulate_motion(Cluster.tetrahedron(1.0), D_R=5e-3, dt=0.7, n_frames=9, rng=3))
    0.0
    """
    if motion.turn_noise is None:
        return 0.0
    rows = motion.fitted
    rotation = motion.rotation[rows]
    noise = np.einsum("tij,i,tik->tjk", rotation, motion.noise**2, rotation)
    at_rest = np.trace(orientation_covariance(motion.template, noise), axis1=1, axis2=2).mean()
    stated = np.trace(motion.covariance[rows], axis1=1, axis2=2).mean()
    return float(max(1 - at_rest / stated, 0.0))
