"""Residuals of rigid fits: localisation error of each axis, a stretched z, a sequential scan."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from perrin._arrays import Floats, frozen
from perrin.errors import DegenerateClusterError, TooFewFramesError
from perrin.geometry.rigid import (
    degrees_of_freedom,
    inertia_tensor,
    orientation_covariance,
    pose_slopes,
)
from perrin.geometry.rotations import skew
from perrin.motion.tracking import template_motion

if TYPE_CHECKING:
    from perrin.motion.rigid_motion import RigidMotion

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

_LEVI_CIVITA = -skew(np.eye(3))


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
    """Residual vectors of the complete frames of one body, in body axes.

    Attributes
    ----------
    rotation : ndarray, shape (K, d, d)
        Orientation of the body, lab from body.
    vector : ndarray, shape (K, n, d)
        Measured positions minus those of the template, um.
    velocity : ndarray, shape (K, d)
        Velocity of the centre from the neighbouring poses, about its mean, um/s, lab axes; 0 at
        the ends and at jumps.
    template : ndarray, shape (n, d)
        Particles of the common shape, um.
    keeps : ndarray, shape (n, n, d, d)
        Projector on the residuals of a rigid fit: what it leaves of displacements of the particles.
    """

    rotation: Floats
    vector: Floats
    velocity: Floats
    template: Floats
    keeps: Floats

    def __post_init__(self) -> None:
        frozen(self.rotation, self.vector, self.velocity, self.template, self.keeps)

    @property
    def freedom(self) -> int:
        """Degrees of freedom of the residuals of one frame."""
        n, d = self.template.shape
        return int(degrees_of_freedom(np.array(n), d))

    @property
    def median_sigma(self) -> float:
        """Localisation error of one coordinate (um) from the median frame; NaN where unknown.

        A few bad frames hardly change it.
        """
        freedom, count = self.freedom, len(self.vector)
        if count < 2 or freedom == 0:
            return np.nan
        square = float(np.median((self.vector**2).sum(axis=(1, 2)))) * count / (count - 1)
        return float(np.sqrt(square / median_chi2(freedom)))

    def left_of(self, displacement: Floats) -> Floats:
        """Return what a rigid fit leaves of displacements (K, n, d), less their mean shape."""
        n, d = self.template.shape
        keeps = self.keeps.transpose(0, 2, 1, 3).reshape(n * d, n * d)
        left = (displacement.reshape(-1, n * d) @ keeps.T).reshape(-1, n, d)
        from_mean: Floats = left - left.mean(axis=0)
        return from_mean

    def in_lab(self, vectors: Floats) -> Floats:
        """Return vectors (K, n, d) given in body axes along the axes of the lab."""
        return np.asarray(vectors @ np.swapaxes(self.rotation, 1, 2))


class Slope(NamedTuple):
    """A regression coefficient of the residuals.

    Attributes
    ----------
    value : float
        Coefficient; NaN where it is not determined.
    stderr : float
        Standard error of the coefficient.
    freedom : float
        Degrees of freedom of the standard error.
    """

    value: float
    stderr: float
    freedom: float

    @property
    def known(self) -> bool:
        """Whether the track determines the coefficient."""
        return bool(np.isfinite(self.stderr))

    def differs_from(self, expected: float) -> bool:
        """Test at the level `SIGNIFICANCE` whether the coefficient differs (Student's t)."""
        from scipy.stats import t

        if not self.known:
            return False
        return bool(
            abs(self.value - expected) > t.isf(SIGNIFICANCE / 2, self.freedom) * self.stderr
        )


UNKNOWN_SLOPE = Slope(np.nan, np.nan, 0.0)


def sample_residuals(motion: RigidMotion, positions: Floats) -> Residuals:
    """Collect the residuals of the complete frames, at most 2000 of them, evenly chosen.

    Parameters
    ----------
    motion : RigidMotion
    positions : ndarray, shape (T, n, d)
        The positions that the motion was fitted to, um.

    Examples
    --------
    >>> from perrin import Cluster, add_noise, simulate_motion, track_rotation
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=0.02, dt=0.7, n_frames=300, rng=1)
    >>> x = add_noise(truth.positions(), sigma=0.03, rng=2)
    >>> sample_residuals(track_rotation(x, dt=0.7), x).vector.shape
    (300, 4, 3)
    """
    vector = body_residuals(motion, positions)
    rows = np.flatnonzero(np.isfinite(vector).all(axis=(1, 2)))
    even = np.linspace(0, max(rows.size - 1, 0), _SAMPLED_FRAMES).astype(int)
    rows = rows[np.unique(even)[: rows.size]]
    # Velocity of the centre between the poses before and after, about its mean.
    velocity, fitted = np.zeros_like(motion.center), motion.fitted
    if fitted.size >= 3:
        step = motion.center[fitted[2:]] - motion.center[fitted[:-2]]
        v = step / (motion.time[fitted[2:]] - motion.time[fitted[:-2]])[:, None]
        v = v - np.median(v, axis=0)
        speed = np.linalg.norm(v, axis=1)
        usual = speed <= _JUMP_SPEED * np.median(speed)
        velocity[fitted[1:-1][usual]] = v[usual] - v[usual].mean(axis=0)
    return Residuals(
        motion.rotation[rows],
        vector[rows],
        velocity[rows],
        motion.template.copy(),
        fit_projector(motion.template),
    )


def fit_projector(template: Floats) -> Floats:
    """Return the projector on what a rigid fit leaves of small displacements of the particles.

    Parameters
    ----------
    template : ndarray, shape (n, d)

    Returns
    -------
    ndarray, shape (n, n, d, d)

    Examples
    --------
    >>> triangle = np.array([[1.0, 0.0], [-0.5, 0.75**0.5], [-0.5, -(0.75**0.5)]])
    >>> round(float(np.einsum("nnii->", fit_projector(triangle))), 9)  # 2 n - 3
    3.0
    """
    n, d = template.shape
    slopes = pose_slopes(template).reshape(n * d, -1)
    left = np.eye(n * d) - slopes @ np.linalg.pinv(slopes)
    blocks: Floats = left.reshape(n, d, n, d).transpose(0, 2, 1, 3).copy()
    return blocks


def autocorrelation(sums: Floats, freedom: float) -> Floats:
    """Return the autocorrelation of residuals up to the lag where it falls below its error.

    Subtracting the mean of every component lowers it by about the variance of that mean, which is
    added back.

    Parameters
    ----------
    sums : ndarray, shape (K,)
        Sums of products of K residuals at the lags 0, ..., K - 1 (`lagged_products`).
    freedom : float
        Degrees of freedom of one frame.

    Returns
    -------
    ndarray, shape (M,)
        Autocorrelation at the lags 1, ..., M.

    Examples
    --------
    >>> white = np.random.default_rng(1).normal(size=(300, 4, 3))
    >>> bool(np.abs(autocorrelation(lagged_products(white), 6)).sum() < 0.1)
    True
    """
    count = len(sums)
    if not sums[0] > 0:
        return np.zeros(0)
    rho = sums[1 : max(2, count // 2)] / sums[0]
    below = np.flatnonzero(rho < 2.0 / np.sqrt(max(count * freedom, 1.0)))
    kept = rho[: int(below[0]) if below.size else rho.size]
    lost = 0.0
    for _ in range(20 if kept.size else 0):
        corrected = (kept + lost) / (1.0 + lost)
        lost = min((1.0 + 2.0 * float(corrected.sum())) / count, 1.0)
    raised: Floats = (kept + lost) / (1.0 + lost)
    return raised


def lag_one_autocorrelation(residuals: Floats) -> Slope:
    """Return the autocorrelation of residuals between neighbouring frames, and its error.

    Parameters
    ----------
    residuals : ndarray, shape (T, n, d)
        Residuals in body axes, NaN where missing; gaps are not bridged.

    Examples
    --------
    >>> white = np.random.default_rng(1).normal(size=(300, 4, 3))
    >>> found = lag_one_autocorrelation(white)
    >>> bool(abs(found.value) < 4 * found.stderr)
    True
    """
    before, after = residuals[:-1], residuals[1:]
    both = np.isfinite(before) & np.isfinite(after)
    a, b = before[both], after[both]
    power = 0.5 * float(a @ a + b @ b)
    n, d = residuals.shape[1:]
    freedom = a.size * float(degrees_of_freedom(np.array(n), d)) / (n * d)
    if not power > 0:
        return UNKNOWN_SLOPE
    value = float(a @ b) / power
    error = np.sqrt(max(1 - value**2, 0.0) / freedom) if freedom > 0 else np.inf
    return Slope(value, float(error), freedom)


def lagged_products(vectors: Floats) -> Floats:
    """Return sum_k v_k . v_{k+lag} of vectors for the lags 0, ..., K - 1.

    Parameters
    ----------
    vectors : ndarray, shape (K, ...)

    Returns
    -------
    ndarray, shape (K,)

    Examples
    --------
    >>> lagged_products(np.array([[1.0], [2.0], [3.0]])).round(12)
    array([14.,  8.,  3.])
    """
    flat = vectors.reshape(len(vectors), -1)
    spectrum = np.fft.rfft(flat, n=2 * len(flat), axis=0)
    power = (spectrum.real**2 + spectrum.imag**2).sum(axis=1)
    sums: Floats = np.fft.irfft(power, n=2 * len(flat))[: len(flat)]
    return sums


def regress(
    sample: Residuals, displacement: Floats, *, offset: float = 0.0, imitated: float = 0.0
) -> Slope:
    """Regress the residuals on what a rigid fit leaves of a displacement; return slope and error.

    The error is the larger of two: from the scores of all frames (each over 1 less its leverage),
    and from the mean square of the residuals without the displacement. Both are widened by the
    autocorrelation that the residuals share with the displacement. The degrees of freedom are the
    number of independent frames that the displacement is spread over.

    Parameters
    ----------
    sample : Residuals
    displacement : ndarray, shape (K, n, d)
        Displacement of every particle for a slope of 1, body axes.
    offset : float
        Expectation of the product of residuals and displacement for a slope of 0.
    imitated : float
        Square of the displacement that noise of the fitted orientation alone contributes.

    Returns
    -------
    Slope
        NaN where the displacement is too small to measure it.

    Examples
    --------
    >>> from perrin import Cluster, add_noise, simulate_motion, track_rotation
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=0.02, dt=0.7, n_frames=300, rng=1)
    >>> x = add_noise(truth.positions(), sigma=0.03, rng=2)
    >>> sample = sample_residuals(track_rotation(x, dt=0.7), x)
    >>> moved = np.zeros(sample.vector.shape)
    >>> moved[::2, 0] = 1.0  # the first particle, in every second frame
    >>> bool(abs(regress(sample, moved).value) < 0.01)
    True
    """
    left = sample.left_of(displacement)
    total = float((left**2).sum())
    power = total - imitated
    if len(left) < 3 or sample.freedom == 0:
        return UNKNOWN_SLOPE
    if not power > max(_LEAST_POWER * imitated, 1e-9 * float((displacement**2).sum())):
        return UNKNOWN_SLOPE
    slope = (float((left * sample.vector).sum()) - offset) / power
    rest = sample.vector - slope * left
    lab = sample.in_lab(rest)
    rho = autocorrelation(lagged_products(lab), sample.freedom)
    count = len(left)
    share = (left**2).sum(axis=(1, 2)) / total  # leverage of every frame
    scores = (left * rest).sum(axis=(1, 2)) / (1.0 - share)
    mean_square = float((rest**2).sum()) / (sample.freedom * (count - 1))
    variance = max(float(scores @ scores), mean_square * total)
    shared = lagged_products(sample.in_lab(left))[1 : rho.size + 1]
    inflation = max(1.0 + 2.0 * float(rho @ shared) / total, 1.0)
    mean_lost = 1.0 + (1.0 + 2.0 * float(rho.sum())) / count
    freedom = 1.0 / float(share @ share) / (1.0 + 2.0 * float(rho @ rho))
    return Slope(slope, float(np.sqrt(variance * inflation * mean_lost)) / power, freedom)


class AxisNoise(NamedTuple):
    """Variance of the localisation error along each lab axis.

    Attributes
    ----------
    variance : ndarray, shape (d,)
        Variance along each lab axis, um^2.
    covariance : ndarray, shape (d, d)
        Covariance of these variances, um^4.
    """

    variance: Floats
    covariance: Floats

    @property
    def known(self) -> bool:
        """Whether every variance is positive and its relative standard error at most 30 %."""
        if not (self.variance > 0).all():
            return False
        error = np.sqrt(np.diag(self.covariance))
        return bool((error <= _VARIANCE_ERROR * self.variance).all())

    def z_ratio(self, unit: Floats) -> Slope:
        """Return sigma_z over sigma_xy, each times a unit (3,) of its axis, and its error."""
        square = unit**2
        v = self.variance * square
        across = v[:2].sum()
        ratio = float(np.sqrt(2 * v[2] / across))
        # Slope of the logarithm of the squared ratio.
        slope = np.array([-1 / across, -1 / across, 1 / v[2]]) * square
        error = 0.5 * ratio * float(np.sqrt(slope @ self.covariance @ slope))
        return Slope(ratio, error, np.inf)


def expected_squares(rotation: Floats, keeps: Floats) -> Floats:
    """Return what variances along the lab axes add to the squares of the residuals of each frame.

    Parameters
    ----------
    rotation : ndarray, shape (K, d, d)
        Orientations of the body, lab from body.
    keeps : ndarray, shape (n, n, d, d)
        Projector on the residuals, as `fit_projector` returns it.

    Returns
    -------
    ndarray, shape (K, d, d)
        Sum over the particles of the squares along axis a for a variance of 1 along axis b: the
        squares of the elements of R K R^T, summed over the blocks K of the projector.

    Examples
    --------
    >>> triangle = np.array([[1.0, 0.0], [-0.5, 0.75**0.5], [-0.5, -(0.75**0.5)]])
    >>> float(expected_squares(np.eye(2)[None], fit_projector(triangle)).sum().round(9))  # 2 n - 3
    3.0
    """
    count, d = rotation.shape[:2]
    blocks = keeps.reshape(-1, d * d)
    pairs = rotation[:, :, None, :, None] * rotation[:, None, :, None, :]
    pairs = pairs.reshape(count, d, d, d * d)
    return np.asarray(((pairs @ (blocks.T @ blocks)) * pairs).sum(axis=-1))


def axis_noise(sample: Residuals) -> AxisNoise | None:
    """Measure the localisation error of each lab axis; None where it is not determined.

    The squares of a frame's residuals along the lab axes are a linear function of the variances
    through the projector of the fit. The covariance is that of the measured squares, widened by
    their autocorrelation.

    Parameters
    ----------
    sample : Residuals

    Returns
    -------
    AxisNoise or None

    Examples
    --------
    >>> from perrin import Cluster, add_noise, simulate_motion, track_rotation
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=0.02, dt=0.7, n_frames=300, rng=1)
    >>> x = add_noise(truth.positions(), sigma=(0.03, 0.03, 0.06), rng=2)
    >>> noise = axis_noise(sample_residuals(track_rotation(x, dt=0.7), x))
    >>> (noise.variance**0.5).round(3)
    array([0.031, 0.032, 0.059])
    """
    turn, count = sample.rotation, len(sample.rotation)
    if count < 3 or not (sample.vector**2).sum() > 0:
        return None
    mix = expected_squares(turn, sample.keeps)
    lab = sample.in_lab(sample.vector)
    square = (lab**2).sum(axis=1) * count / (count - 1)
    total = mix.sum(axis=0)
    if np.linalg.cond(total) > 1e8:
        return None
    inverse = np.linalg.inv(total)
    variance = inverse @ square.sum(axis=0)
    scores = square - mix @ variance
    rho = autocorrelation(lagged_products(lab), sample.freedom)
    spread = inverse @ scores.T @ scores @ inverse.T * (1.0 + 2.0 * float(rho @ rho))
    return AxisNoise(variance, spread)


class Stretch(NamedTuple):
    """Scale of z against x and y, and the fit with z corrected.

    Attributes
    ----------
    scale : Slope
        Scale of z (1: not stretched).
    sample : Residuals
        Residuals of the body with z corrected.
    motion : RigidMotion
        Motion of the body with z corrected.
    """

    scale: Slope
    sample: Residuals
    motion: RigidMotion


def measure_stretch(motion: RigidMotion, positions: Floats) -> Stretch:
    """Measure the scale of z against x and y from the change of a body's shape as it turns.

    Least squares in scale, template and poses: Gauss-Newton steps in the scale alternate with
    rigid fits. The second-order contribution of noise, which differs between axes, is subtracted.

    Parameters
    ----------
    motion : RigidMotion
    positions : ndarray, shape (T, n, d)
        The positions that the motion was fitted to, um.

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
    >>> found = measure_stretch(track_rotation(x, dt=0.7), x).scale
    >>> round(found.value, 2), found.differs_from(1.0)
    (1.1, True)
    """
    sample = sample_residuals(motion, positions)
    if motion.dimension == 2 or len(sample.vector) < 3:
        return Stretch(UNKNOWN_SLOPE, sample, motion)
    first, scale, step = (motion, sample), 1.0, UNKNOWN_SLOPE
    for _ in range(10):
        step, left = _stretch_step(sample)
        if not step.known or step.stderr > _STRETCH_ERROR:
            return Stretch(UNKNOWN_SLOPE, first[1], first[0])
        # The step is linear in the stretch; its second order is then small against the error.
        if step.value**2 <= 0.1 * step.stderr:
            break
        scale *= float(np.clip(1.0 + step.value, 0.5, 2.0))
        try:
            motion = template_motion(positions / [1.0, 1.0, scale], time=motion.time, dt=motion.dt)
        except (DegenerateClusterError, TooFewFramesError):
            return Stretch(UNKNOWN_SLOPE, first[1], first[0])
        sample = sample_residuals(motion, positions / [1.0, 1.0, scale])
    rest = replace(sample, vector=sample.vector - step.value * left)
    found = Slope(scale * (1.0 + step.value), scale * step.stderr, step.freedom)
    return Stretch(found, rest, motion)


def _stretch_step(sample: Residuals) -> tuple[Slope, Floats]:
    """Return the stretch of z from the residuals, and what a rigid fit leaves of a unit stretch."""
    up = sample.rotation[:, 2]  # the lab's z axis in body axes
    height = up @ sample.template.T
    displacement = height[..., None] * up[:, None]
    left = sample.left_of(displacement)
    plain = regress(sample, displacement)
    if not plain.known:
        return plain, left
    rest = replace(sample, vector=sample.vector - plain.value * left)
    # The noise of the axes is shrunk to equal noise, the more the larger its error. A body whose
    # residuals do not separate the axes (a trimer that hardly turns) is left with equal noise, and
    # with an error that allows standard deviations of 1 : 1 : 3.
    mean = float((rest.vector**2).sum()) / (sample.freedom * max(len(rest.vector) - 1, 1))
    variance, covariance = np.full(3, mean), (_VARIANCE_SPREAD * mean) ** 2 * np.eye(3)
    noise = axis_noise(rest)
    if noise is not None:
        gain = np.linalg.solve(covariance + noise.covariance, covariance).T
        variance = np.maximum(variance + gain @ (noise.variance - variance), 0.0)
        covariance = covariance - gain @ covariance
    products, squares = _noise_products(sample, left)
    found = regress(
        sample,
        displacement,
        offset=float(products @ variance),
        imitated=float(squares @ variance),
    )
    power = float((left**2).sum()) - float(squares @ variance)
    noise_error = float(products @ covariance @ products) / power**2
    return found._replace(stderr=float(np.sqrt(found.stderr**2 + noise_error))), left


def _noise_products(sample: Residuals, left: Floats) -> tuple[Floats, Floats]:
    """Return the mean of residual times stretch, and of stretch squared, for unit noise by axis.

    Second order in the noise: the fitted orientation errs by delta = sum A_i e_i with
    A_i = M^-1 [r_i]x, so that the residual has the mean (C - tr C) r_i / 2 - <delta x e_i>
    with C = <delta delta^T>, and the direction of z in the body, which errs with delta, is
    correlated with the residual where the axes of the lab have unequal noise.
    """
    turn, r = sample.rotation, sample.template
    arm = np.linalg.pinv(inertia_tensor(r)) @ skew(r)
    # The derivative of u (u . r) with u -> u - delta x u; its last index is that of delta.
    up = turn[:, 2]
    count, (n, d) = len(turn), r.shape
    turned = np.einsum("abd,td->tab", _LEVI_CIVITA, up)
    slope = -turned[:, None] * (up @ r.T)[:, :, None, None]
    slope = slope - up[:, None, :, None] * (r @ turned)[:, :, None, :]
    keeps = sample.keeps.transpose(0, 2, 1, 3).reshape(n * d, n * d)
    slope = keeps @ slope.reshape(count, n * d, 3)
    shared = np.einsum("lbp,liqc->ibcpq", arm, sample.keeps).reshape(-1, 9)
    products, squares = np.empty(3), np.empty(3)
    for axis in range(3):
        u = turn[:, axis]
        turns = np.einsum("nab,tb->tna", arm, u)  # what unit noise along this axis turns the fit by
        c = np.swapaxes(turns, 1, 2) @ turns
        shift = 0.5 * (r @ c - np.trace(c, axis1=1, axis2=2)[:, None, None] * r)
        shift -= np.cross(turns, u[:, None])
        noise = (u[:, :, None] * u[:, None, :]).reshape(count, 9)
        crossed = (noise @ shared.T).reshape(count, n, 3, d)
        of_slope = slope.reshape(count, n, d, 3)
        products[axis] = (left * shift).sum() + (of_slope * np.swapaxes(crossed, 2, 3)).sum()
        squares[axis] = ((slope @ c) * slope).sum()
    return products, squares


def measure_scan(sample: Residuals) -> Slope:
    """Measure how much later a particle is recorded the higher it is, s/um.

    A plane that sweeps through the body with the velocity v reaches a particle at height h later
    than its centre by h/v, so that the particle is displaced by the body's velocity times h/v.
    Noise of any size along z is independent of the velocity between the frames before and after.

    Parameters
    ----------
    sample : Residuals

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
    >>> measure_scan(sample_residuals(track_rotation(x, dt=0.7), x)).differs_from(0.0)
    False
    """
    if sample.rotation.shape[-1] != 3 or len(sample.vector) < 3:
        return UNKNOWN_SLOPE
    height = sample.rotation[:, 2] @ sample.template.T
    velocity = np.einsum("tij,ti->tj", sample.rotation, sample.velocity)
    return regress(sample, height[..., None] * velocity[:, None])


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
    out: Floats = np.einsum("tij,tni->tnj", motion.rotation, positions - motion.center[:, None])
    return out - motion.template


def unit_covariance(motion: RigidMotion) -> Floats:
    """Return the step noise of every orientation for a localisation error of 1 um, (T, a, a).

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.0), D_R=5e-3, dt=0.7, n_frames=9, rng=3)
    >>> unit_covariance(truth)[0].diagonal().round(9)
    array([0.375, 0.375, 0.375])
    """
    square = float(np.mean(motion.noise**2))
    if square > 0:
        return np.asarray(motion.step_covariance / square)
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
    square = float(np.mean(motion.noise**2))
    if square > 0:
        return np.asarray(motion.step_center_variance / square)
    return np.full(len(motion.time), 1 / len(motion.template))
