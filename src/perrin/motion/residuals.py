"""Residuals of rigid fits: localisation error of each axis, a stretched z, a sequential scan."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cache, cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from perrin._arrays import Bools, Floats, Ints, count_present, distinct, expanded, frozen, present
from perrin.geometry.rigid import (
    degrees_of_freedom,
    inertia_tensor,
    orientation_covariance,
    pose_slopes,
)
from perrin.geometry.rotations import skew
from perrin.motion.rigid_motion import RigidMotion
from perrin.motion.tracking import track_each

if TYPE_CHECKING:
    from collections.abc import Sequence

# Most frames sampled: the standard error of every average here is then below 2 % of its scatter.
_SAMPLED_FRAMES = 2000

# Two-sided probability below which a slope is taken to differ from zero.
SIGNIFICANCE = 1e-3

# Least power (um^2) of a displacement over what noise of the fitted orientation adds to it: below
# this factor the body turns or moves too little to measure the slope.
_LEAST_POWER = 4.0

# Largest standard error of the stretch (relative) that is still reported as measured.
_STRETCH_ERROR = 0.1

# Spread of the variances of the axes, over the mean square residual, that is assumed before they
# are measured: residuals of a body in the plane x y hardly contain the noise along z, which may be
# up to ten times as large.
_VARIANCE_SPREAD = 6.0

# Largest relative standard error of a variance that is still reported as measured.
_VARIANCE_ERROR = 0.3

# Largest speed of the centre over the median speed: faster ones are jumps, not the motion that a
# sequential scan displaces particles by.
_JUMP_SPEED = 6.0


def median_chi2(freedom: float) -> float:
    """Return the median of chi squared (Wilson and Hilferty, 1931; within 3 % from 1 on).

    Parameters
    ----------
    freedom : float
        Degrees of freedom.

    Examples
    --------
    >>> round(median_chi2(3.0), 2)  # exact: 2.37
    2.38
    """
    return freedom * (1 - 2 / (9 * freedom)) ** 3


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residual vectors of the complete frames of B bodies of n particles, in body axes.

    The frames are the last axis, so that products of a few coordinates are those of long vectors.
    Bodies with fewer complete frames than others have zeros after their last one.

    Attributes
    ----------
    rotation : ndarray, shape (B, d, d, K)
        Orientation of each body, lab from body.
    vector : ndarray, shape (B, n, d, K)
        Measured positions minus those of the template, um.
    velocity : ndarray, shape (B, d, K)
        Velocity of the centre from the neighbouring poses, about its mean, um/s, lab axes; 0 at
        the ends and at jumps.
    count : ndarray of int, shape (B,)
        Number of complete frames of each body.
    template : ndarray, shape (B, n, d)
        Particles of the common shapes, um.
    keeps : ndarray, shape (B, n, n, d, d)
        Projector on the residuals of a rigid fit: what it leaves of displacements of the particles.
    """

    rotation: Floats
    vector: Floats
    velocity: Floats
    count: Ints
    template: Floats
    keeps: Floats

    def __post_init__(self) -> None:
        frozen(self.rotation, self.vector, self.velocity, self.count, self.template, self.keeps)

    @property
    def freedom(self) -> int:
        """Degrees of freedom of the residuals of one frame."""
        n, d = self.template.shape[1:]
        return int(degrees_of_freedom(np.array(n), d))

    @cached_property
    def complete(self) -> Bools:
        """Which rows are frames of each body, (B, K)."""
        return np.asarray(np.arange(self.vector.shape[-1]) < self.count[:, None])

    @cached_property
    def median_sigma(self) -> Floats:
        """Localisation error of one coordinate (um) from the median frame, (B,); NaN where unknown.

        A few bad frames hardly change it.
        """
        freedom, count = self.freedom, self.count
        if freedom == 0:
            return np.full(count.shape, np.nan)
        square = np.einsum("bnik,bnik->bk", self.vector, self.vector)
        square = np.where(self.complete, square, np.nan)
        square = median_present(square)
        unbiased = np.divide(count, count - 1, out=np.full(count.shape, np.nan), where=count > 1)
        return np.asarray(np.sqrt(square * unbiased / median_chi2(freedom)))

    @cached_property
    def projector(self) -> Floats:
        """The projector `keeps` as matrices of all coordinates, (B, n d, n d)."""
        coordinates = self.template[0].size
        swapped = np.swapaxes(self.keeps, 2, 3)
        return np.ascontiguousarray(swapped).reshape(-1, coordinates, coordinates)

    @cached_property
    def axes(self) -> Floats:
        """The products u_i u_j, i <= j, of the lab's axes u in body axes, (B, d, d(d + 1)/2, K)."""
        return _products(self.rotation)

    @cached_property
    def expected(self) -> Floats:
        """The `expected_squares` of every frame, (B, d, d, K)."""
        return _expected_of(self.axes, self.keeps)

    def with_vector(self, vector: Floats) -> Residuals:
        """Return the same poses with other residuals."""
        other = replace(self, vector=vector)
        vars(other)["axes"], vars(other)["expected"] = self.axes, self.expected
        return other

    def of_bodies(self, bodies: Ints) -> Residuals:
        """Return the residuals of some of the bodies."""
        return Residuals(*(getattr(self, part.name)[bodies] for part in fields(self)))

    def with_bodies(self, bodies: Ints, others: Residuals) -> Residuals:
        """Return the residuals with other ones for some of the bodies."""
        parts = {part.name: getattr(self, part.name).copy() for part in fields(self)}
        for name, part in parts.items():
            part[bodies] = getattr(others, name)
        return Residuals(**parts)

    def left_of(self, displacement: Floats) -> Floats:
        """Return what a rigid fit leaves of displacements (B, n, d, K), less their mean shape."""
        bodies, n, d, rows = displacement.shape
        left: Floats = self.projector @ displacement.reshape(bodies, n * d, rows)
        left -= left.sum(axis=2, keepdims=True) / np.maximum(self.count, 1)[:, None, None]
        if not self.complete.all():
            left *= self.complete[:, None]
        return left.reshape(displacement.shape)

    def in_lab(self, vectors: Floats) -> Floats:
        """Return vectors (B, n, d, K) given in body axes along the axes of the lab."""
        return np.asarray(np.einsum("baik,bnik->bnak", self.rotation, vectors))


class Slope(NamedTuple):
    """A regression coefficient of the residuals, of one body or of several.

    Attributes
    ----------
    value : float or ndarray, shape (B,)
        Coefficient; NaN where it is not determined.
    stderr : float or ndarray, shape (B,)
        Standard error of the coefficient.
    freedom : float or ndarray, shape (B,)
        Degrees of freedom of the standard error.
    """

    value: Floats
    stderr: Floats
    freedom: Floats

    @classmethod
    def unknown(cls, shape: tuple[int, ...] = ()) -> Slope:
        """Return coefficients that are not determined."""
        return cls(np.full(shape, np.nan), np.full(shape, np.nan), np.zeros(shape))

    @property
    def known(self) -> Bools:
        """Whether the track determines the coefficient."""
        return np.asarray(np.isfinite(self.stderr))

    def of_body(self, number: int) -> Slope:
        """Return the coefficient of one body."""
        return Slope(*(x[number] for x in self))

    def where(self, some: Bools, other: Slope) -> Slope:
        """Return these coefficients for some of the bodies, and the other ones elsewhere."""
        pairs = zip(self, other, strict=True)
        return Slope(*(np.where(some, mine, theirs) for mine, theirs in pairs))

    def differs_from(self, expected: float) -> Bools:
        """Test at the level `SIGNIFICANCE` whether the coefficient differs (Student's t)."""
        from scipy.special import ndtri, stdtrit

        known, exact = self.known, np.isinf(self.freedom)
        freedom = np.where(known & ~exact, self.freedom, 1.0)
        quantile = np.where(exact, ndtri(SIGNIFICANCE / 2), stdtrit(freedom, SIGNIFICANCE / 2))
        off = np.abs(np.where(known, self.value - expected, 0.0))
        return np.asarray(known & (off > -quantile * np.where(known, self.stderr, 0.0)))


def sample_residuals(
    motions: Sequence[RigidMotion], positions: Floats, *, residuals: Floats | None = None
) -> Residuals:
    """Collect the residuals of the complete frames, at most 2000 a body, evenly chosen.

    Parameters
    ----------
    motions : sequence of RigidMotion
        Motions of B bodies.
    positions : ndarray, shape (B, T, n, d)
        The positions that the motions were fitted to, um.
    residuals : ndarray, shape (B, T, n, d), optional
        Their residuals, as `residuals_of_each` returns them, where these are known already.

    Examples
    --------
    >>> from perrin import Cluster, add_noise, simulate_motion, track_rotation
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=0.02, dt=0.7, n_frames=300, rng=1)
    >>> x = add_noise(truth.positions(), sigma=0.03, rng=2)
    >>> sample_residuals([track_rotation(x, dt=0.7)], x[None]).vector.shape
    (1, 4, 3, 300)
    """
    vector = residuals_of_each(motions, positions) if residuals is None else residuals
    whole = count_present(present(vector)) == vector.shape[2]
    count = np.minimum(whole.sum(axis=1), _SAMPLED_FRAMES)
    every = bool(whole.all()) and whole.shape[1] <= _SAMPLED_FRAMES
    rows = np.argsort(~whole, axis=1, kind="stable")[:, :_SAMPLED_FRAMES]
    for k in np.flatnonzero(whole.sum(axis=1) > _SAMPLED_FRAMES):
        all_rows = np.flatnonzero(whole[k])
        rows[k] = all_rows[np.linspace(0, all_rows.size - 1, _SAMPLED_FRAMES).astype(int)]
    complete = np.arange(rows.shape[1]) < count[:, None]

    def sampled(x: Floats) -> Floats:
        if every:
            return x
        index = rows.reshape(len(rows), *[1] * (x.ndim - 2), -1)
        here = complete.reshape(index.shape)
        return np.where(here, np.take_along_axis(x, index, axis=-1), 0.0)

    center, time = frames_last([m.center for m in motions]), np.stack([m.time for m in motions])
    velocity = np.zeros_like(center)
    poses = np.array([m.fitted.size for m in motions])
    fitted = np.flatnonzero((poses == time.shape[1]) & (poses >= 3))
    if fitted.size:
        velocity[fitted] = _velocities(center[fitted], time[fitted])
    for number in np.flatnonzero((poses < time.shape[1]) & (poses >= 3)).tolist():
        own, body = motions[number].fitted, slice(number, number + 1)
        velocity[body, :, own] = _velocities(center[body, :, own], time[body, own])
    template = np.stack([m.template for m in motions])
    return Residuals(
        rotation=sampled(frames_last([m.rotation for m in motions])),
        vector=sampled(np.ascontiguousarray(np.moveaxis(vector, 1, -1))),
        velocity=sampled(velocity),
        count=count,
        template=template,
        keeps=fit_projector(template),
    )


def frames_last(arrays: Sequence[Floats]) -> Floats:
    """Return arrays (T, ...) of B bodies as one with the frames last, (B, ..., T).

    Examples
    --------
    >>> frames_last([np.zeros((300, 4, 3))] * 2).shape
    (2, 4, 3, 300)
    """
    joined = np.empty((len(arrays), *arrays[0].shape[1:], len(arrays[0])))
    for own, one in zip(np.moveaxis(joined, -1, 1), arrays, strict=True):
        own[...] = one
    return joined


def _velocities(center: Floats, time: Floats) -> Floats:
    """Return the velocity between the poses before and after, about its mean, (B, d, K).

    It is 0 at the first and at the last pose, and at jumps. `center` is (B, d, K), `time` (B, K).
    """
    velocity = np.zeros_like(center)
    v = (center[..., 2:] - center[..., :-2]) / (time[:, 2:] - time[:, :-2])[:, None]
    v -= median_present(v)[..., None]
    speed = np.sqrt(np.einsum("bdk,bdk->bk", v, v))
    usual = speed <= _JUMP_SPEED * median_present(speed)[:, None]
    mean = np.where(usual[:, None], v, 0.0).sum(axis=2) / usual.sum(axis=1)[:, None]
    velocity[..., 1:-1] = np.where(usual[:, None], v - mean[..., None], 0.0)
    return velocity


def median_present(values: Floats) -> Floats:
    """Return the median over the last axis of the values that are not NaN; NaN of none.

    Examples
    --------
    >>> median_present(np.array([[1.0, 5.0, 3.0], [7.0, np.nan, np.nan]]))
    array([3., 7.])
    """
    return quantile_present(values, 0.5)


def quantile_present(values: Floats, share: float) -> Floats:
    """Return the quantile over the last axis of the values that are not NaN; NaN of none.

    Parameters
    ----------
    values : ndarray, shape (..., K)
    share : float
        Share of the values below the quantile, which is interpolated linearly.

    Examples
    --------
    >>> quantile_present(np.array([[1.0, 5.0, 3.0], [7.0, np.nan, np.nan]]), 0.75)
    array([4., 7.])
    """
    ordered = np.sort(values, axis=-1)  # NaN last
    last = np.full((1,) * (ordered.ndim - 1), ordered.shape[-1] - 1)
    if not np.isfinite(ordered[..., -1:]).all():
        last = np.maximum((~np.isnan(ordered)).sum(axis=-1) - 1, 0)
    place = share * last
    below = np.floor(place).astype(np.int64)
    ends = below[..., None], np.minimum(below + 1, last)[..., None]
    if last.size == 1:  # the same place in all rows
        low, high = (ordered[..., int(k.item())] for k in ends)
    else:
        low, high = (np.take_along_axis(ordered, k, axis=-1)[..., 0] for k in ends)
    return np.asarray(low + (place - below) * (high - low))


def fit_projector(template: Floats) -> Floats:
    """Return the projector on what a rigid fit leaves of small displacements of the particles.

    Parameters
    ----------
    template : ndarray, shape (..., n, d)

    Returns
    -------
    ndarray, shape (..., n, n, d, d)

    Examples
    --------
    >>> triangle = np.array([[1.0, 0.0], [-0.5, 0.75**0.5], [-0.5, -(0.75**0.5)]])
    >>> round(float(np.einsum("nnii->", fit_projector(triangle))), 9)  # 2 n - 3
    3.0
    """
    n, d = template.shape[-2:]
    slopes = pose_slopes(template)
    slopes = slopes.reshape(*template.shape[:-2], n * d, -1)
    basis, triangle = np.linalg.qr(slopes)
    size = np.abs(np.diagonal(triangle, axis1=-2, axis2=-1))
    if (size.min(axis=-1) > 1e-6 * size.max(axis=-1)).all():
        left = np.eye(n * d) - basis @ np.swapaxes(basis, -1, -2)
    else:  # fewer displacements are independent
        left = np.eye(n * d) - slopes @ np.linalg.pinv(slopes)
    blocks = left.reshape(*template.shape[:-2], n, d, n, d)
    return np.ascontiguousarray(np.swapaxes(blocks, -3, -2))


def autocorrelation(vectors: Floats, count: Ints, freedom: float) -> Floats:
    """Return the autocorrelation of residuals up to the lag where it falls below its error.

    Subtracting the mean of every component lowers it by about the variance of that mean, which is
    added back.

    Parameters
    ----------
    vectors : ndarray, shape (B, ..., K)
        Residuals of B bodies, zeros after the last frame of each.
    count : ndarray of int, shape (B,)
        Number of frames of each body.
    freedom : float
        Degrees of freedom of one frame.

    Returns
    -------
    ndarray, shape (B, M)
        Autocorrelation at the lags 1, ..., M; 0 from the first lag below its error.

    Examples
    --------
    >>> white = np.random.default_rng(1).normal(size=(1, 4, 3, 300))
    >>> bool(np.abs(autocorrelation(white, np.array([300]), 6)).sum() < 0.1)
    True
    """
    flat = vectors.reshape(len(vectors), -1, vectors.shape[-1])
    power = np.einsum("bxk,bxk->b", flat, flat)
    following = np.einsum("bxk,bxk->b", flat[..., 1:], flat[..., :-1])
    least = 2.0 / np.sqrt(np.maximum(count * freedom, 1.0))
    first = np.divide(following, power, out=np.zeros(len(flat)), where=power > 0)
    smooth = np.flatnonzero((first >= least) & (count > 1) & (power > 0))
    if not smooth.size:
        return np.zeros((len(flat), 0))
    rho = lagged_products(flat[smooth])[:, 1:] / power[smooth, None]
    within = np.arange(1, rho.shape[1] + 1) < np.maximum(2, count[smooth] // 2)[:, None]
    kept = np.logical_and.accumulate(within & (rho >= least[smooth, None]), axis=1)
    lags = kept.sum(axis=1)
    kept, rho = kept[:, : lags.max()], rho[:, : lags.max()]
    total, lost = np.where(kept, rho, 0.0).sum(axis=1), np.zeros(len(smooth))
    for _ in range(20):
        raised_total = (total + lags * lost) / (1.0 + lost)
        lost = np.minimum((1.0 + 2.0 * raised_total) / count[smooth], 1.0)
    raised = np.zeros((len(flat), rho.shape[1]))
    raised[smooth] = np.where(kept, (rho + lost[:, None]) / (1.0 + lost[:, None]), 0.0)
    return raised


def lag_one_autocorrelation(residuals: Floats) -> Slope:
    """Return the autocorrelation of residuals between neighbouring frames, and its error.

    Parameters
    ----------
    residuals : ndarray, shape (..., T, n, d)
        Residuals in body axes, NaN where missing; gaps are not bridged.

    Examples
    --------
    >>> white = np.random.default_rng(1).normal(size=(300, 4, 3))
    >>> found = lag_one_autocorrelation(white)
    >>> bool(abs(found.value) < 4 * found.stderr)
    True
    """
    a, b = residuals[..., :-1, :, :], residuals[..., 1:, :, :]
    both = np.isfinite(a) & np.isfinite(b)
    if not both.all():
        a, b = np.where(both, a, 0.0), np.where(both, b, 0.0)
    power = 0.5 * (np.einsum("...tni,...tni->...", a, a) + np.einsum("...tni,...tni->...", b, b))
    n, d = residuals.shape[-2:]
    share = float(degrees_of_freedom(np.array(n), d)) / (n * d)
    freedom = np.where(power > 0, both.sum(axis=(-3, -2, -1)) * share, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        value = np.where(power > 0, np.einsum("...tni,...tni->...", a, b) / power, np.nan)
        error = np.sqrt(np.maximum(1 - value**2, 0.0) / freedom)
    unknown_error = np.where(power > 0, np.inf, np.nan)
    return Slope(value, np.where(freedom > 0, error, unknown_error), freedom)


def lagged_products(vectors: Floats) -> Floats:
    """Return sum_k v_k . v_{k+lag} of vectors for the lags 0, ..., K - 1.

    Parameters
    ----------
    vectors : ndarray, shape (B, ..., K)

    Returns
    -------
    ndarray, shape (B, K)

    Examples
    --------
    >>> lagged_products(np.array([[[1.0, 2.0, 3.0]]])).round(12)
    array([[14.,  8.,  3.]])
    """
    count = vectors.shape[-1]
    spectrum = np.fft.rfft(vectors.reshape(len(vectors), -1, count), n=2 * count)
    power = (spectrum.real**2 + spectrum.imag**2).sum(axis=1)
    sums: Floats = np.fft.irfft(power, n=2 * count)[:, :count]
    return sums


def regress(
    sample: Residuals,
    displacement: Floats,
    *,
    left: Floats | None = None,
    offset: Floats | float = 0.0,
    imitated: Floats | float = 0.0,
) -> Slope:
    """Regress the residuals on what a rigid fit leaves of a displacement; return slope and error.

    The error is the larger of two: from the scores of all frames (each over 1 less its leverage),
    and from the mean square of the residuals without the displacement. Both are widened by the
    autocorrelation that the residuals share with the displacement. The degrees of freedom are the
    number of independent frames that the displacement is spread over.

    Parameters
    ----------
    sample : Residuals
        Of B bodies.
    displacement : ndarray, shape (B, n, d, K)
        Displacement of every particle for a slope of 1, body axes.
    left : ndarray, shape (B, n, d, K), optional
        What a rigid fit leaves of it, where that is known already.
    offset : float or ndarray, shape (B,)
        Expectation of the product of residuals and displacement for a slope of 0.
    imitated : float or ndarray, shape (B,)
        Square of the displacement that noise of the fitted orientation alone contributes.

    Returns
    -------
    Slope
        Of every body; NaN where the displacement is too small to measure it.

    Examples
    --------
    >>> from perrin import Cluster, add_noise, simulate_motion, track_rotation
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=0.02, dt=0.7, n_frames=300, rng=1)
    >>> x = add_noise(truth.positions(), sigma=0.03, rng=2)
    >>> sample = sample_residuals([track_rotation(x, dt=0.7)], x[None])
    >>> moved = np.zeros(sample.vector.shape)
    >>> moved[:, 0, :, ::2] = 1.0  # the first particle, in every second frame
    >>> bool(abs(regress(sample, moved).value[0]) < 0.01)
    True
    """
    left = sample.left_of(displacement) if left is None else left
    power, known = _measurable_power(sample, displacement, left, imitated)
    if not known.any():
        return Slope.unknown(sample.count.shape)
    frames = np.einsum("bnik,bnik->bk", left, left)
    total = np.where(known, frames.sum(axis=1), 1.0)
    along = np.einsum("bnik,bnik->bk", left, sample.vector)
    slope = (along.sum(axis=1) - offset) / power
    rest = slope[:, None, None, None] * left
    np.subtract(sample.vector, rest, out=rest)
    rho = autocorrelation(sample.in_lab(rest), sample.count, sample.freedom)
    share = np.where(known[:, None], frames / total[:, None], 0.0)  # leverage of every frame
    scores = (along - slope[:, None] * frames) / (1.0 - share)
    residual_square = np.einsum("bnik,bnik->b", rest, rest)
    mean_square = residual_square / (sample.freedom * np.maximum(sample.count - 1, 1))
    variance = np.maximum((scores * scores).sum(axis=1), mean_square * total)
    shared = np.zeros(len(total))
    smooth = np.flatnonzero(rho.any(axis=1))
    if smooth.size:
        together = lagged_products(sample.of_bodies(smooth).in_lab(left[smooth]))
        shared[smooth] = (rho[smooth] * together[:, 1 : rho.shape[1] + 1]).sum(axis=1)
    inflation = np.maximum(1.0 + 2.0 * shared / total, 1.0)
    mean_lost = 1.0 + (1.0 + 2.0 * rho.sum(axis=1)) / np.maximum(sample.count, 1)
    repeats = 1.0 + 2.0 * (rho * rho).sum(axis=1)
    concentration = np.where(known, (share * share).sum(axis=1), 1.0)
    found = Slope(
        slope, np.sqrt(variance * inflation * mean_lost) / power, 1.0 / concentration / repeats
    )
    return found.where(known, Slope.unknown(known.shape))


def _measurable_power(
    sample: Residuals, displacement: Floats, left: Floats, imitated: Floats | float = 0.0
) -> tuple[Floats, Bools]:
    """Return the square of what a fit leaves, less that of noise, and where it is large enough.

    The power is 1 where the displacement is too small to measure its slope.
    """
    power = np.einsum("bnik,bnik->b", left, left) - imitated
    moved = np.einsum("bnik,bnik->b", displacement, displacement)
    least = np.maximum(_LEAST_POWER * np.asarray(imitated), 1e-9 * moved)
    known = (sample.freedom > 0) & (sample.count >= 3) & (power > least)
    return np.where(known, power, 1.0), np.asarray(known)


class AxisNoise(NamedTuple):
    """Variance of the localisation error along each lab axis, of one body or of several.

    Attributes
    ----------
    variance : ndarray, shape (..., d)
        Variance along each lab axis, um^2; NaN where it is not determined.
    covariance : ndarray, shape (..., d, d)
        Covariance of these variances, um^4.
    """

    variance: Floats
    covariance: Floats

    @property
    def known(self) -> Bools:
        """Whether every variance is positive and its relative standard error at most 30 %."""
        diagonal = np.diagonal(self.covariance, axis1=-2, axis2=-1)
        positive = np.asarray((self.variance > 0).all(axis=-1))
        error = np.sqrt(np.where(positive[..., None], diagonal, np.inf))
        return np.asarray((error <= _VARIANCE_ERROR * self.variance).all(axis=-1) & positive)

    def z_ratio(self, unit: Floats) -> Slope:
        """Return sigma_z over sigma_xy, each times a unit (..., 3) of its axis, and its error."""
        square = unit**2
        v = self.variance * square
        across = v[..., :2].sum(axis=-1)
        ratio = np.sqrt(2 * v[..., 2] / across)
        # Slope of the logarithm of the squared ratio.
        slope = np.stack([-1 / across, -1 / across, 1 / v[..., 2]], axis=-1) * square
        variance = np.einsum("...a,...ab,...b->...", slope, self.covariance, slope)
        return Slope(ratio, 0.5 * ratio * np.sqrt(variance), np.full_like(ratio, np.inf))


def expected_squares(rotation: Floats, keeps: Floats) -> Floats:
    """Return what variances along the lab axes add to the squares of the residuals of each frame.

    Parameters
    ----------
    rotation : ndarray, shape (..., K, d, d)
        Orientations of the body, lab from body.
    keeps : ndarray, shape (..., n, n, d, d)
        Projector on the residuals, as `fit_projector` returns it.

    Returns
    -------
    ndarray, shape (..., K, d, d)
        Sum over the particles of the squares along axis a for a variance of 1 along axis b: the
        squares of the elements of R K R^T, summed over the blocks K of the projector.

    Examples
    --------
    >>> triangle = np.array([[1.0, 0.0], [-0.5, 0.75**0.5], [-0.5, -(0.75**0.5)]])
    >>> float(expected_squares(np.eye(2)[None], fit_projector(triangle)).sum().round(9))  # 2 n - 3
    3.0
    """
    expected = _expected_of(_products(np.moveaxis(rotation, -3, -1)), keeps)
    return np.moveaxis(expected, -1, -3)


def _expected_of(axes: Floats, keeps: Floats) -> Floats:
    """Return `expected_squares` (..., d, d, K) from the products of the axes (..., d, m, K)."""
    d = keeps.shape[-1]
    blocks = keeps.reshape(*keeps.shape[:-4], -1, d * d)
    # u_i K_ij v_j u_k K_kl v_l is a quadratic form in the axis u and in the axis v.
    products = np.swapaxes(blocks, -1, -2) @ blocks
    form = np.swapaxes(products.reshape(*keeps.shape[:-4], d, d, d, d), -3, -2)
    form = _of_products(np.moveaxis(_of_products(form), -1, -3))
    along = np.swapaxes(form, -1, -2)[..., None, :, :] @ axes
    return np.asarray(np.einsum("...auk,...buk->...abk", along, axes))


def _products(vectors: Floats) -> Floats:
    """Return the products u_i u_j, i <= j, of the components of vectors (..., d, K).

    The rows of an orientation, lab from body, are the lab's axes in body axes.

    Examples
    --------
    >>> _products(np.array([[[0.6], [0.8]], [[-0.8], [0.6]]])).round(2)[..., 0]
    array([[ 0.36,  0.48,  0.64],
           [ 0.64, -0.48,  0.36]])
    """
    i, j, _ = _pairs_of_axes(vectors.shape[-2])
    return np.asarray(np.take(vectors, i, axis=-2) * np.take(vectors, j, axis=-2))


def _of_products(form: Floats) -> Floats:
    """Return the coefficients of the products u_i u_j, i <= j, in quadratic forms (..., d, d)."""
    d = form.shape[-1]
    found = form.reshape(-1, d * d) @ _pairs_of_axes(d)[2]
    return found.reshape(*form.shape[:-2], -1)


@cache
def _pairs_of_axes(d: int) -> tuple[Ints, Ints, Floats]:
    """Return the pairs i <= j of axes, and which of the d^2 products u_i u_j is that of a pair."""
    i, j = np.triu_indices(d)
    place = np.arange(d * d)[:, None]
    each = ((place == i * d + j) | (place == j * d + i)).astype(np.float64)
    frozen(i, j, each)
    return i, j, each


def axis_noise(sample: Residuals) -> AxisNoise:
    """Measure the localisation error of each lab axis.

    The squares of a frame's residuals along the lab axes are a linear function of the variances
    through the projector of the fit. The covariance is that of the measured squares, widened by
    their autocorrelation.

    Parameters
    ----------
    sample : Residuals
        Of B bodies.

    Returns
    -------
    AxisNoise
        Of every body; NaN where the residuals do not determine it.

    Examples
    --------
    >>> from perrin import Cluster, add_noise, simulate_motion, track_rotation
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=0.02, dt=0.7, n_frames=300, rng=1)
    >>> x = add_noise(truth.positions(), sigma=(0.03, 0.03, 0.06), rng=2)
    >>> noise = axis_noise(sample_residuals([track_rotation(x, dt=0.7)], x[None]))
    >>> (noise.variance[0] ** 0.5).round(3)
    array([0.031, 0.032, 0.059])
    """
    count, d = sample.count, sample.template.shape[2]
    mix = sample.expected
    lab = sample.in_lab(sample.vector)
    unbiased = count / np.maximum(count - 1, 1)
    square = np.einsum("bnak,bnak->bak", lab, lab) * unbiased[:, None, None]
    sums, total = square.sum(axis=2), mix.sum(axis=3)
    known = (count >= 3) & (sums.sum(axis=1) > 0)
    singular = np.linalg.svd(np.where(known[:, None, None], total, np.eye(d)), compute_uv=False)
    known &= singular[:, 0] <= 1e8 * singular[:, -1]
    inverse = np.linalg.inv(np.where(known[:, None, None], total, np.eye(d)))
    variance = np.einsum("bij,bj->bi", inverse, sums)
    scores = square - np.einsum("bijk,bj->bik", mix, variance)
    rho = autocorrelation(lab, count, sample.freedom)
    spread = inverse @ (scores @ np.swapaxes(scores, 1, 2)) @ np.swapaxes(inverse, 1, 2)
    spread = spread * (1.0 + 2.0 * (rho * rho).sum(axis=1))[:, None, None]
    return AxisNoise(
        np.where(known[:, None], variance, np.nan), np.where(known[:, None, None], spread, np.nan)
    )


class Stretch(NamedTuple):
    """Scale of z against x and y of several bodies, and their fits with z corrected.

    Attributes
    ----------
    scale : Slope
        Scale of z of every body (1: not stretched).
    sample : Residuals
        Residuals of the bodies with z corrected.
    motions : list of RigidMotion
        Motions of the bodies with z corrected.
    """

    scale: Slope
    sample: Residuals
    motions: list[RigidMotion]

    def with_bodies(self, bodies: Ints, others: Stretch) -> Stretch:
        """Return the same with the scales of others for some bodies, where these are known."""
        known = np.flatnonzero(others.scale.known)
        scale = Slope(*(part.copy() for part in self.scale))
        for part, other in zip(scale, others.scale, strict=True):
            part[bodies[known]] = other[known]
        motions = list(self.motions)
        for k in known.tolist():
            motions[bodies[k]] = others.motions[k]
        sample = self.sample.with_bodies(bodies[known], others.sample.of_bodies(known))
        return Stretch(scale, sample, motions)


def measure_stretch(
    motions: Sequence[RigidMotion],
    positions: Floats,
    sample: Residuals,
    *,
    scale: Floats | None = None,
    trials: int = 10,
) -> Stretch:
    """Measure the scale of z against x and y from the change of a body's shape as it turns.

    Least squares in scale, template and poses: Gauss-Newton steps in the scale alternate with
    rigid fits. The second-order contribution of noise, which differs between axes, is subtracted.

    Parameters
    ----------
    motions : sequence of RigidMotion
        Motions of B bodies.
    positions : ndarray, shape (B, T, n, d)
        Positions of their particles, um.
    sample : Residuals
        Residuals of the motions.
    scale : ndarray, shape (B,), optional
        Scale of z that was taken off the positions before the motions were fitted; default 1.
    trials : int
        Largest number of steps.

    Returns
    -------
    Stretch
        The scale (1: not stretched) is unknown (NaN) in the plane and for a body that turns too
        little to determine it.

    Examples
    --------
    >>> from perrin import Cluster, add_noise, simulate_motion, track_rotation
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=0.02, dt=0.7, n_frames=300, rng=1)
    >>> x = add_noise(truth.positions(), sigma=0.03, rng=2) * [1.0, 1.0, 1.1]
    >>> motions = [track_rotation(x, dt=0.7)]
    >>> found = measure_stretch(motions, x[None], sample_residuals(motions, x[None])).scale
    >>> found.value.round(2), found.differs_from(1.0)
    (array([1.1]), array([ True]))
    """
    unknown = Slope.unknown(sample.count.shape)
    if sample.template.shape[2] == 2:
        return Stretch(unknown, sample, list(motions))
    scale = np.ones(len(motions)) if scale is None else scale
    step, left = _stretch_step(sample)
    usable = step.known & ~(step.stderr > _STRETCH_ERROR)
    # The step is linear in the stretch; its second order is then small against the error.
    settled = usable & ((step.value**2 <= 0.1 * step.stderr) | (trials == 1))
    taken = np.where(settled, step.value, 0.0)[:, None, None, None]
    rest = sample.with_vector(sample.vector - taken * left)
    found = Slope(scale * (1.0 + step.value), scale * step.stderr, step.freedom)
    stretch = Stretch(found.where(settled, unknown), rest, list(motions))
    bodies = np.flatnonzero(usable & ~settled)
    if not bodies.size:
        return stretch
    scale = scale[bodies] * np.clip(1.0 + step.value[bodies], 0.5, 2.0)
    x = positions[bodies].copy()
    x[..., 2] /= scale[:, None, None]
    time = np.stack([motions[k].time for k in bodies.tolist()])
    fits = track_each(x, time=time, dt=motions[0].dt)
    fitted = np.array([isinstance(fit, RigidMotion) for fit in fits])
    closer = [fit for fit in fits if isinstance(fit, RigidMotion)]
    if not closer:
        return stretch
    again = measure_stretch(
        closer,
        positions[bodies[fitted]],
        sample_residuals(closer, x[fitted]),
        scale=scale[fitted],
        trials=trials - 1,
    )
    return stretch.with_bodies(bodies[fitted], again)


def _stretch_step(sample: Residuals) -> tuple[Slope, Floats]:
    """Return the stretch of z from the residuals, and what a rigid fit leaves of a unit stretch."""
    up = sample.rotation[:, 2]  # the lab's z axis in body axes
    displacement = (sample.template @ up)[:, :, None] * up[:, None]
    left = sample.left_of(displacement)
    unknown = Slope.unknown(sample.count.shape)
    power, known = _measurable_power(sample, displacement, left)
    if not known.any():
        return unknown, left
    plain = np.where(known, np.einsum("bnik,bnik->b", left, sample.vector) / power, 0.0)
    vector = plain[:, None, None, None] * left
    np.subtract(sample.vector, vector, out=vector)
    # The noise of the axes is shrunk to equal noise, the more the larger its error. A body whose
    # residuals do not separate the axes (a trimer that hardly turns) is left with equal noise, and
    # with an error that allows standard deviations of 1 : 1 : 3.
    square = np.einsum("bnik,bnik->b", vector, vector)
    mean = square / (sample.freedom * np.maximum(sample.count - 1, 1))
    variance = np.repeat(mean[:, None], 3, axis=1)
    covariance = ((_VARIANCE_SPREAD * mean) ** 2)[:, None, None] * np.eye(3)
    noise = axis_noise(sample.with_vector(vector))
    measured = np.isfinite(noise.variance).all(axis=1)
    if measured.any():
        some = covariance[measured]
        total = some + noise.covariance[measured]
        gain = np.swapaxes(np.linalg.solve(total, some), 1, 2)
        off = (noise.variance - variance)[measured]
        shrunk = variance[measured] + np.einsum("bij,bj->bi", gain, off)
        variance[measured] = np.maximum(shrunk, 0.0)
        covariance[measured] = some - gain @ some
    products, squares = _noise_products(sample, left)
    imitated = (squares * variance).sum(axis=1)
    found = regress(
        sample,
        displacement,
        left=left,
        offset=(products * variance).sum(axis=1),
        imitated=imitated,
    )
    power = np.einsum("bnik,bnik->b", left, left) - imitated
    noise_error = np.einsum("ba,bac,bc->b", products, covariance, products)
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.sqrt(found.stderr**2 + noise_error / power**2)
    return found._replace(stderr=error).where(known, unknown), left


def _noise_products(sample: Residuals, left: Floats) -> tuple[Floats, Floats]:
    """Return the sums of residual times stretch, and of stretch squared, for unit noise by axis.

    Second order in the noise: the fitted orientation errs by delta = sum A_i e_i with
    A_i = M^-1 [r_i]x, so that the residual has the mean (C - tr C) r_i / 2 - <delta x e_i>
    with C = <delta delta^T>, and the direction of z in the body, which errs with delta, is
    correlated with the residual where the axes of the lab have unequal noise.

    All of these are polynomials in the components of the lab's axes u in body axes, whose
    coefficients are those of the body; the frames enter by the sums of the products u_i u_j.
    """
    form = _noise_forms(sample)
    axes, up = sample.axes, sample.axes[:, 2]
    moved = left.reshape(len(left), -1, left.shape[-1])
    shift, crossed, square = (np.swapaxes(part, 1, 2) for part in form)
    residual = np.einsum("zauk,zuk->za", axes, shift @ moved + crossed @ up)
    return residual, np.einsum("zauk,zuk->za", axes, square @ _products(up))


class _NoiseForms(NamedTuple):
    """Second-order moments for unit noise along the lab's axis u, by the products of axes.

    Attributes
    ----------
    shift : ndarray, shape (B, 3 n, 6)
        Mean residual of every coordinate in body axes, by u_i u_j.
    crossed : ndarray, shape (B, 6, 6)
        Mean product of the residual and of the error of the stretch, by z_i z_j and u_k u_l.
    square : ndarray, shape (B, 21, 6)
        Mean square of the error of the stretch, by the products of two z_i z_j, and by u_k u_l.
    """

    shift: Floats
    crossed: Floats
    square: Floats


def _noise_forms(sample: Residuals) -> _NoiseForms:
    """Return the moments that `_noise_products` sums over the frames."""
    r, unit = sample.template, np.eye(3)
    bodies, n, d = r.shape
    cross, moment = skew(unit), skew(r)  # cross[k] is [e_k]x
    arm = np.linalg.inv(inertia_tensor(r))[:, None] @ moment
    # C by u_b u_c.
    turn = np.einsum("zipb,ziqc->zpqbc", arm, arm)
    shift = np.einsum("zip,zpxbc->zixbc", r, turn) - np.einsum("zix,zppbc->zixbc", r, turn)
    shift = 0.5 * shift - np.einsum("zipb,cpx->zixbc", arm, cross)
    # The derivative of z (z . r) with z -> z - delta x z, by delta_p z_b z_c.
    slope = np.einsum("bxp,znc->znxpbc", cross, r) + np.einsum("xb,znpc->znxpbc", unit, moment)
    slope = (sample.projector @ slope.reshape(bodies, n * d, -1)).reshape(slope.shape)
    # <delta_p e_ix> of what the fit leaves of the noise, by u_b u_c.
    shared = np.einsum("zlpb,zlicx->zixpbc", arm, sample.keeps)
    turn, shift, slope, shared = (_of_products(part) for part in (turn, shift, slope, shared))
    crossed = np.einsum("zixpu,zixpv->zuv", slope, shared)
    slope = slope.reshape(bodies, n * d, -1)
    pairs = (np.swapaxes(slope, 1, 2) @ slope).reshape(bodies, 3, 6, 3, 6)
    pairs = _of_products(pairs.transpose(0, 1, 3, 2, 4)).reshape(bodies, 9, -1)
    square = np.swapaxes(pairs, 1, 2) @ turn.reshape(bodies, 9, -1)
    return _NoiseForms(shift.reshape(bodies, n * d, -1), crossed, square)


def measure_scan(sample: Residuals) -> Slope:
    """Measure how much later a particle is recorded the higher it is, s/um.

    A plane that sweeps through the body with the velocity v reaches a particle at height h later
    than its centre by h/v, so that the particle is displaced by the body's velocity times h/v.
    Noise of any size along z is independent of the velocity between the frames before and after.

    Parameters
    ----------
    sample : Residuals
        Of B bodies.

    Returns
    -------
    Slope
        Delay 1/v with its sign; NaN in the plane and for a body at rest.

    Examples
    --------
    >>> from perrin import Cluster, add_noise, simulate_motion, track_rotation
    >>> truth = simulate_motion(
    ...     Cluster.tetrahedron(1.5), D_R=0.02, D_T=0.04, dt=0.7, n_frames=300, rng=1
    ... )
    >>> x = add_noise(truth.positions(), sigma=0.03, rng=2)  # all recorded at once
    >>> measure_scan(sample_residuals([track_rotation(x, dt=0.7)], x[None])).differs_from(0.0)
    array([False])
    """
    if sample.template.shape[2] != 3:
        return Slope.unknown(sample.count.shape)
    height = sample.template @ sample.rotation[:, 2]
    velocity = np.einsum("baik,bak->bik", sample.rotation, sample.velocity)
    return regress(sample, height[:, :, None] * velocity[:, None])


def body_residuals(motion: RigidMotion, positions: Floats) -> Floats:
    """Return the measured minus the fitted positions in body axes, um.

    Parameters
    ----------
    motion : RigidMotion
    positions : ndarray, shape (T, n, d)
        The positions that the motion was fitted to, um.

    Returns
    -------
    ndarray, shape (T, n, d)
        NaN where a particle or a pose is missing.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=0.02, dt=0.7, n_frames=5, rng=1)
    >>> bool(np.allclose(body_residuals(truth, truth.positions()), 0.0))
    True
    """
    residuals: Floats = residuals_of_each([motion], positions[None])[0]
    return residuals


def residuals_of_each(motions: Sequence[RigidMotion], positions: Floats) -> Floats:
    """Return the measured minus the fitted positions of several bodies in body axes, um.

    Parameters
    ----------
    motions : sequence of RigidMotion
        Motions of B bodies.
    positions : ndarray, shape (B, T, n, d)
        The positions that the motions were fitted to, um.

    Returns
    -------
    ndarray, shape (B, T, n, d)
        NaN where a particle or a pose is missing.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=0.02, dt=0.7, n_frames=5, rng=1)
    >>> residuals_of_each([truth, truth], np.stack([truth.positions()] * 2)).shape
    (2, 5, 4, 3)
    """
    center = frames_last([m.center for m in motions])
    rotation = frames_last([m.rotation for m in motions])
    template = np.stack([m.template for m in motions])
    from_center = np.moveaxis(positions, 1, -1) - center[:, None]
    out: Floats = np.einsum("baik,bnak->bnik", rotation, from_center)
    out -= template[..., None]
    return np.moveaxis(out, -1, 1)


def unit_covariance(motion: RigidMotion) -> Floats:
    """Return the step noise of every orientation for a localisation error of 1 um, (T, a, a).

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.0), D_R=5e-3, dt=0.7, n_frames=9, rng=3)
    >>> unit_covariance(truth)[0].diagonal().round(9)
    array([0.375, 0.375, 0.375])
    """
    square = float(motion.noise @ motion.noise) / len(motion.noise)
    if square > 0:
        return expanded(distinct(motion.step_covariance) / square, len(motion.time))
    unit = orientation_covariance(motion.template, np.eye(motion.template.shape[1]))
    return np.broadcast_to(unit, motion.covariance.shape)


def unit_center_variance(motion: RigidMotion) -> Floats:
    """Return the step noise variance of every centre for a localisation error of 1 um, (T,).

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.0), D_R=5e-3, dt=0.7, n_frames=2, rng=3)
    >>> unit_center_variance(truth)
    array([0.25, 0.25])
    """
    square = float(motion.noise @ motion.noise) / len(motion.noise)
    if square > 0:
        return expanded(distinct(motion.step_center_variance) / square, len(motion.time))
    return np.full(len(motion.time), 1 / len(motion.template))
