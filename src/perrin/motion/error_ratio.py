"""Whether stated localisation errors are those that rigid bodies show."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from perrin._arrays import frozen
from perrin.geometry.rigid import pose_slopes
from perrin.motion.residuals import body_residuals, expected_squares, fit_projector

if TYPE_CHECKING:
    from collections.abc import Iterable

    from perrin._arrays import Floats
    from perrin.motion.rigid_motion import RigidMotion

# A trend with time or depth is used where it exceeds this number of its standard errors (0.1 %).
_TREND_ERRORS = 3.3

# A measured ratio is at least this one; few frames can give a negative variance.
_LEAST_ERROR_RATIO = 0.1

_WEIGHTING_ROUNDS = 8  # of the weights

# The logarithm of the ratio changes by at most this over the movie or the depth.
_LARGEST_TREND = 3.0


@dataclass(frozen=True, eq=False)
class ErrorRatio:
    """Variance of positions that rigid bodies show, over the stated one.

    The ratio of axis a at the time t and the depth z is
    ``value[a] * exp(by_time * (t - time) + by_depth * (z - depth))``.

    Attributes
    ----------
    value : ndarray, shape (d,)
        Ratio of each lab axis, drawn to that of the others where they agree, and then to 1 by its
        own error: 1 + (1 - s^2/(r - 1)^2) (r - 1) for the ratio r of standard error s, and 1 where
        r - 1 is less than s: errors that the spheres of a body have in common leave no residual, so
        that it is never below 1.
    measured, stderr : ndarray, shape (d,)
        Measured ratios and their standard errors; NaN where no frame determines them.
    by_time : float
        Change of the logarithm of the ratio with time, 1/s; 0 where it is within 3.3 errors.
    by_depth : float
        Change of the logarithm of the ratio with z, 1/um; 0 where it is within 3.3 errors.
    time, depth : float
        Mean time (s) and mean z (um) of the poses.
    """

    value: Floats
    measured: Floats
    stderr: Floats
    by_time: float
    by_depth: float
    time: float
    depth: float

    def __post_init__(self) -> None:
        frozen(self.value, self.measured, self.stderr)

    @property
    def is_one(self) -> bool:
        """Whether the stated errors are those that the bodies show."""
        return bool((self.value == 1).all()) and self.by_time == 0 and self.by_depth == 0

    def at(self, time: Floats, depth: Floats) -> Floats:
        """Return the ratio (..., d) of each axis at times (s) and depths (um)."""
        trend = self.by_time * (time - self.time) + self.by_depth * (depth - self.depth)
        bounded = np.exp(np.clip(trend, -_LARGEST_TREND, _LARGEST_TREND))
        return np.asarray(bounded[..., None] * self.value)


def error_ratio(bodies: Iterable[tuple[RigidMotion, Floats, Floats]]) -> ErrorRatio:
    """Compare the residuals of rigid bodies with the stated errors of their positions.

    Parameters
    ----------
    bodies : iterable of tuple
        Motion, positions (T, n, d) that it was fitted to (um), and the stated variance of one
        coordinate along each lab axis in each frame (T, d), um^2; frames with NaN are left out.

    Returns
    -------
    ErrorRatio

    Notes
    -----
    The squares of the residuals of a frame along the lab axes are a linear function of the
    variances along them, by the projector of the rigid fit; their ratios to the stated ones are the
    solution of weighted least squares over all frames of all bodies, in which a square scatters in
    proportion to its expectation. The standard error is that of the scatter of the frames.

    Examples
    --------
    >>> from perrin import Cluster, add_noise, simulate_motion, track_rotation
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=0.02, dt=0.7, n_frames=400, rng=1)
    >>> x = add_noise(truth.positions(), sigma=(0.03, 0.03, 0.06), rng=2)
    >>> stated = np.full((400, 3), 0.03**2)
    >>> error_ratio([(track_rotation(x, dt=0.7), x, stated)]).measured.round()
    array([1., 1., 4.])
    """
    total: Floats | None = None
    mixes, squares, times, depths = [], [], [], []
    for motion, positions, stated in bodies:
        vector = body_residuals(motion, positions)
        good = np.isfinite(vector).all(axis=(1, 2)) & np.isfinite(stated).all(axis=1)
        good &= (stated > 0).all(axis=1)
        count = int(good.sum())
        if count < 3:
            continue
        turn = motion.rotation[good]
        mean = stated[good].mean(axis=1, keepdims=True)
        mix = expected_squares(turn, fit_projector(motion.template))
        mix = mix * (stated[good] / mean)[:, None, :]
        lab = np.einsum("tij,tnj->tni", turn, vector[good])
        # The mean shape was fitted to the same frames.
        squares.append((lab**2).sum(axis=1) * count / (count - 1) / mean)
        mixes.append(mix)
        times.append(motion.time[good])
        depths.append(motion.center[good, -1])
        total = mix.sum(axis=0) if total is None else total + mix.sum(axis=0)
    if total is None or np.linalg.cond(total) > 1e8:
        unknown = np.full(3 if total is None else len(total), np.nan)
        return ErrorRatio(np.ones(len(unknown)), unknown, unknown, 0.0, 0.0, 0.0, 0.0)
    mix, square = np.concatenate(mixes), np.concatenate(squares)
    time, depth = np.concatenate(times), np.concatenate(depths)
    measured = np.maximum(np.linalg.solve(total, square.sum(axis=0)), _LEAST_ERROR_RATIO)
    for _ in range(_WEIGHTING_ROUNDS):
        # Squares scatter in proportion to their expectation.
        weighted = np.swapaxes(mix, 1, 2) / ((mix @ measured) ** 2)[:, None, :]
        inverse = np.linalg.inv((weighted @ mix).sum(axis=0))
        scores = np.einsum("tab,tb->ta", weighted, square - mix @ measured)
        measured = np.maximum(measured + inverse @ scores.sum(axis=0), _LEAST_ERROR_RATIO)
    stderr = np.sqrt(np.diag(inverse @ scores.T @ scores @ inverse.T))
    # Axes are drawn to a common ratio: their logarithms scatter with the variance that is left of
    # their weighted squares (DerSimonian and Laird 1986), so that unlike ones stay so.
    logarithm, variance = np.log(measured), np.maximum((stderr / measured) ** 2, 1e-12)
    weight = 1 / variance
    excess = weight @ (logarithm - np.average(logarithm, weights=weight)) ** 2 - (len(weight) - 1)
    between = max(float(excess / (weight.sum() - weight @ weight / weight.sum())), 0.0)
    weight = 1 / (variance + between)
    mean, own = np.average(logarithm, weights=weight), between * weight
    drawn = np.exp(mean + own * (logarithm - mean))
    error = drawn * np.sqrt(own * variance + (1 - own) ** 2 / weight.sum())
    off = drawn - 1
    held = np.divide(error, off, out=np.full(len(off), np.inf), where=off != 0)
    # Errors that the spheres of a body have in common are stated and leave no residual.
    value = 1 + np.maximum(1 - held**2, 0.0) * np.maximum(off, 0.0)
    # Changes of the logarithm of the squares with time and depth, 0 where insignificant: scoring
    # for gamma-distributed squares with a logarithmic link.
    relative = square.sum(axis=1) / (mix @ measured).sum(axis=1)
    terms = np.stack([np.ones(len(time)), time - time.mean(), depth - depth.mean()], axis=1)
    used = [0] + [k for k in (1, 2) if np.ptp(terms[:, k]) > 0]
    trend, rows = np.zeros(3), terms[:, used]
    if len(time) >= 10 * len(used) and relative.mean() > 0:
        rate = np.zeros(len(used))
        rate[0] = np.log(relative.mean())
        for _ in range(20):
            error = relative / np.exp(rows @ rate) - 1
            step = np.linalg.lstsq(rows, error, rcond=None)[0]
            rate = rate + np.clip(step, -1.0, 1.0)
            if np.abs(step).max() < 1e-9:
                break
        rate_error = np.sqrt(np.diag(np.linalg.inv(rows.T @ rows)) * np.mean(error**2))
        trend[used] = np.where(np.abs(rate) > _TREND_ERRORS * rate_error, rate, 0.0)
    by_time, by_depth = trend[1:].tolist()
    return ErrorRatio(
        value, measured, stderr, by_time, by_depth, float(time.mean()), float(depth.mean())
    )


def with_error_ratio(motion: RigidMotion, ratio: Floats, stated: Floats) -> RigidMotion:
    """Return a motion whose stated errors are larger by the ratio of the variances of its axes.

    Parameters
    ----------
    motion : RigidMotion
        With covariances that the stated errors of the positions gave.
    ratio : ndarray, shape (T, d)
        Variance of a coordinate over the stated one along each lab axis.
    stated : ndarray, shape (d,)
        Stated variance of one coordinate along each lab axis, um^2.

    Returns
    -------
    RigidMotion
        With C = L_1 L_0^-1 C L_0^-T L_1^T for the Cholesky factors of the covariances of
        orientations fitted with the weights W of the stated variances: P = (H^T W H)^-1 with these,
        and P H^T W V W H P with the variances V that are larger by the ratio.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion, track_rotation
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=0.02, dt=0.7, n_frames=9, rng=1)
    >>> motion = track_rotation(truth.positions(), dt=0.7, sigma=0.02)
    >>> twice = with_error_ratio(motion, np.full((9, 3), 4.0), np.full(3, 0.02**2))
    >>> bool(np.allclose(twice.covariance, 4 * motion.covariance))
    True
    """
    rows = motion.fitted
    turn = motion.rotation[rows]
    slope = pose_slopes(motion.template)[..., : motion.covariance.shape[-1]]
    known, true = (
        np.einsum("tji,tj,tjk->tik", turn, part, turn)
        for part in (np.broadcast_to(1 / stated, (len(rows), len(stated))), ratio[rows] / stated)
    )
    # The centre of the template is the origin, so that the shift of the body has no common term.
    P = np.linalg.inv(np.einsum("nia,tij,njb->tab", slope, known, slope))
    spread = np.einsum("nia,tij,njb->tab", slope, true, slope)
    change = np.linalg.cholesky(P @ spread @ P) @ np.linalg.inv(np.linalg.cholesky(P))
    covariance, center = motion.covariance.copy(), motion.center_variance.copy()
    scaled = change @ covariance[rows] @ np.swapaxes(change, 1, 2)
    covariance[rows] = 0.5 * (scaled + np.swapaxes(scaled, 1, 2))
    center[rows] *= (ratio[rows] @ stated) / stated.sum()
    return replace(motion, covariance=covariance, center_variance=center)
