"""What the residuals of rigid fits show: noise of each axis, a stretched z, a sequential scan."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from perrin._arrays import Floats, as_positions, frozen
from perrin.errors import DegenerateClusterError, TooFewFramesError
from perrin.geometry.rigid import degrees_of_freedom
from perrin.geometry.rotations import skew
from perrin.motion.tracking import track_rotation

if TYPE_CHECKING:
    from perrin.motion.rigid_motion import RigidMotion

_FRAMES = 2000  # frames sampled: enough for every average here


# Two-sided probability below which a slope counts as different from zero.
LEVEL = 1e-3


# A slope is measured only where the motion of the body shows it: this multiple of what noise in
# the fitted orientation imitates, and a standard error of the stretch below `_USEFUL`.
_ABOVE_NOISE, _USEFUL = 4.0, 0.1


# Spread of the variances of the axes over the mean square residual before they are measured: that
# of a body that lies in the plane x y hardly contains the noise along z, up to ten times as large.
_UNEQUAL = 6.0


# Relative error of a variance up to which the noise of an axis counts as measured.
_MEASURED = 0.3


# Velocities above this multiple of the median are jumps, which say nothing about a scan.
_FASTEST = 6.0


_LEVI_CIVITA = -skew(np.eye(3))


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residual vectors of the complete frames of one body, body axes.

    Attributes
    ----------
    rotation : ndarray, shape (K, d, d)
        Lab from body.
    vector : ndarray, shape (K, n, d)
        Measured places less the template's, um.
    velocity : ndarray, shape (K, d)
        Velocity of the centre from the neighbouring poses, about its mean, um/s, lab axes; 0 at
        the ends and at jumps.
    template : ndarray, shape (n, d)
        um.
    keeps : ndarray, shape (n, n, d, d)
        Projector of a rigid fit: what it leaves of displacements of the particles.
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

    def left_of(self, displacement: Floats) -> Floats:
        """Return what a rigid fit leaves of displacements (K, n, d), less their mean shape."""
        left = np.einsum("nmij,tmj->tni", self.keeps, displacement)
        from_mean: Floats = left - left.mean(axis=0)
        return from_mean

    def lab(self) -> Floats:
        """Return the residual vectors along the axes of the lab, (K, n, d)."""
        return _turned(self.rotation, self.vector)


class Slope(NamedTuple):
    """A regression coefficient of the residuals, its standard error and degrees of freedom."""

    value: float
    stderr: float
    freedom: float

    @property
    def known(self) -> bool:
        """Whether the track determines the coefficient."""
        return bool(np.isfinite(self.stderr))

    def differs_from(self, expected: float) -> bool:
        """Test the coefficient at `LEVEL`, two-sided (Student's t)."""
        from scipy.stats import t

        if not self.known:
            return False
        return bool(abs(self.value - expected) > t.isf(LEVEL / 2, self.freedom) * self.stderr)


_UNKNOWN = Slope(np.nan, np.nan, 0.0)


def _turned(rotation: Floats, vectors: Floats) -> Floats:
    turned: Floats = np.einsum("tij,tnj->tni", rotation, vectors)
    return turned


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
    rows = rows[np.unique(np.linspace(0, max(rows.size - 1, 0), _FRAMES).astype(int))[: rows.size]]
    keeps = fit_projector(motion.template)
    return Residuals(
        motion.rotation[rows], vector[rows], _velocity(motion)[rows], motion.template.copy(), keeps
    )


def fit_projector(template: Floats) -> Floats:
    """Return what a rigid fit leaves of small displacements of the particles, (n, n, d, d).

    Examples
    --------
    >>> import numpy as np
    >>> triangle = np.array([[1.0, 0.0], [-0.5, 0.75**0.5], [-0.5, -(0.75**0.5)]])
    >>> round(float(np.einsum("nnii->", fit_projector(triangle))), 9)  # 2 n - 3
    3.0
    """
    n, d = template.shape
    across = np.stack([-template[:, 1], template[:, 0]], axis=1)[..., None]
    turns = across if d == 2 else -skew(template)
    slopes = np.concatenate([turns, np.broadcast_to(np.eye(d), (n, d, d))], axis=2)
    flat = slopes.reshape(n * d, -1)
    left = np.eye(n * d) - flat @ np.linalg.pinv(flat)
    blocks: Floats = left.reshape(n, d, n, d).transpose(0, 2, 1, 3).copy()
    return blocks


def _velocity(motion: RigidMotion) -> Floats:
    """Return the velocity of the centre between the poses before and after, about its mean."""
    rows = motion.fitted
    velocity = np.zeros_like(motion.center)
    if rows.size < 3:
        return velocity
    step = motion.center[rows[2:]] - motion.center[rows[:-2]]
    v = step / (motion.time[rows[2:]] - motion.time[rows[:-2]])[:, None]
    v = v - np.median(v, axis=0)
    speed = np.linalg.norm(v, axis=1)
    usual = speed <= _FASTEST * np.median(speed)
    velocity[rows[1:-1][usual]] = v[usual] - v[usual].mean(axis=0)
    return velocity


def autocorrelation(sums: Floats, freedom: float) -> Floats:
    """Return the autocorrelation of residuals at the lags up to where it is lost in its error.

    The mean taken off every component lowers it by about the variance of that mean, which is
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
        At the lags 1, ..., M.

    Examples
    --------
    >>> import numpy as np
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
        Body axes, NaN where missing; gaps are not bridged.

    Examples
    --------
    >>> import numpy as np
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
        return _UNKNOWN
    value = float(a @ b) / power
    error = np.sqrt(max(1 - value**2, 0.0) / freedom) if freedom > 0 else np.inf
    return Slope(value, float(error), freedom)


def lagged_products(vectors: Floats) -> Floats:
    """Return sum_k v_k . v_{k+lag} of vectors (K, ...) for the lags 0, ..., K - 1."""
    flat = vectors.reshape(len(vectors), -1)
    spectrum = np.fft.rfft(flat, n=2 * len(flat), axis=0)
    power = (spectrum.real**2 + spectrum.imag**2).sum(axis=1)
    sums: Floats = np.fft.irfft(power, n=2 * len(flat))[: len(flat)]
    return sums


def regress(
    sample: Residuals, displacement: Floats, *, offset: float = 0.0, imitated: float = 0.0
) -> Slope:
    """Regress the residuals on what a rigid fit leaves of a displacement; return slope and error.

    The error is that of residuals without the displacement: the larger of the one from the scores
    of all frames (each over 1 less its leverage) and the one from their mean square, both widened
    by the autocorrelation that the residuals share with the displacement. The degrees of freedom
    are the number of independent frames that the displacement is spread over.

    Parameters
    ----------
    sample : Residuals
    displacement : ndarray, shape (K, n, d)
        Displacement of every particle for a slope of 1, body axes.
    offset : float
        Expectation of the product of residuals and displacement for a slope of 0.
    imitated : float
        Square of the displacement that is due to noise of the fitted orientation alone.
    """
    left = sample.left_of(displacement)
    total = float((left**2).sum())
    power = total - imitated
    if len(left) < 3 or sample.freedom == 0:
        return _UNKNOWN
    if not power > max(_ABOVE_NOISE * imitated, 1e-9 * float((displacement**2).sum())):
        return _UNKNOWN
    slope = (float((left * sample.vector).sum()) - offset) / power
    rest = sample.vector - slope * left
    lab = _turned(sample.rotation, rest)
    rho = autocorrelation(lagged_products(lab), sample.freedom)
    count = len(left)
    share = (left**2).sum(axis=(1, 2)) / total  # leverage of every frame
    scores = (left * rest).sum(axis=(1, 2)) / (1.0 - share)
    mean_square = float((rest**2).sum()) / (sample.freedom * (count - 1))
    variance = max(float(scores @ scores), mean_square * total)
    shared = lagged_products(_turned(sample.rotation, left))[1 : rho.size + 1]
    inflation = max(1.0 + 2.0 * float(rho @ shared) / total, 1.0)
    mean_lost = 1.0 + (1.0 + 2.0 * float(rho.sum())) / count
    freedom = 1.0 / float(share @ share) / (1.0 + 2.0 * float(rho @ rho))
    return Slope(slope, float(np.sqrt(variance * inflation * mean_lost)) / power, freedom)


class AxisNoise(NamedTuple):
    """Variance of the localisation error along each lab axis, um^2, and its covariance."""

    variance: Floats
    covariance: Floats

    @property
    def known(self) -> bool:
        """Whether every variance is positive and known to 30 %."""
        if not (self.variance > 0).all():
            return False
        error = np.sqrt(np.diag(self.covariance))
        return bool((error <= _MEASURED * self.variance).all())


def axis_noise(sample: Residuals) -> AxisNoise | None:
    """Measure the localisation error of each lab axis; None where the residuals cannot tell.

    The squares of a frame's residuals along the lab axes are a linear function of the variances
    through the projector of the fit. The covariance is that of the squares found, widened by
    their autocorrelation.

    Parameters
    ----------
    sample : Residuals
    """
    turn, count = sample.rotation, len(sample.rotation)
    d = turn.shape[-1]
    if count < 3 or not (sample.vector**2).sum() > 0:
        return None
    back = np.swapaxes(turn, -1, -2)
    mix = np.zeros((count, d, d))
    for row in sample.keeps:
        for block in row:
            mix += (turn @ block @ back) ** 2
    lab = sample.lab()
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
    """How much too long z is, the residuals of the body with z corrected, and its motion."""

    scale: Slope
    sample: Residuals
    motion: RigidMotion


def measure_stretch(motion: RigidMotion, positions: Floats) -> Stretch:
    """Measure by how much z is stretched against x and y, from shapes that change as a body turns.

    Least squares in scale, template and poses, by Gauss-Newton steps in the scale and rigid fits
    in turn. What noise alone contributes at second order, which differs between axes, is taken
    off.

    Parameters
    ----------
    motion : RigidMotion
    positions : ndarray, shape (T, n, d)
        The positions that the motion was fitted to, um.

    Returns
    -------
    Stretch
        The scale (1: not stretched) is unknown (NaN) in the plane and for a body that turns too
        little to show it.

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
    if positions.shape[2] != 3 or len(sample.vector) < 3:
        return Stretch(_UNKNOWN, sample, motion)
    first, scale, step = (motion, sample), 1.0, _UNKNOWN
    for _ in range(10):
        step, left = _stretch_step(sample)
        if not step.known or step.stderr > _USEFUL:
            return Stretch(_UNKNOWN, first[1], first[0])
        # The step is linear in the stretch; what is left of second order vanishes in the error.
        if step.value**2 <= 0.1 * step.stderr:
            break
        scale *= float(np.clip(1.0 + step.value, 0.5, 2.0))
        try:
            motion = track_rotation(positions / [1.0, 1.0, scale], dt=motion.dt, times=motion.time)
        except (DegenerateClusterError, TooFewFramesError):
            return Stretch(_UNKNOWN, first[1], first[0])
        sample = sample_residuals(motion, positions / [1.0, 1.0, scale])
    rest = replace(sample, vector=sample.vector - step.value * left)
    found = Slope(scale * (1.0 + step.value), scale * step.stderr, step.freedom)
    return Stretch(found, rest, motion)


def _stretch_step(sample: Residuals) -> tuple[Slope, Floats]:
    """Return the stretch of z that the residuals show, and what a fit leaves of a unit stretch."""
    up = sample.rotation[:, 2]  # the lab's z axis in body axes
    height = up @ sample.template.T
    displacement = height[..., None] * up[:, None]
    left = sample.left_of(displacement)
    plain = regress(sample, displacement)
    if not plain.known:
        return plain, left
    rest = replace(sample, vector=sample.vector - plain.value * left)
    noise = _shrunk(axis_noise(rest), rest)
    products, squares = _noise_products(sample, left)
    found = regress(
        sample,
        displacement,
        offset=float(products @ noise.variance),
        imitated=float(squares @ noise.variance),
    )
    power = float((left**2).sum()) - float(squares @ noise.variance)
    doubt = float(products @ noise.covariance @ products) / power**2
    return found._replace(stderr=float(np.sqrt(found.stderr**2 + doubt))), left


def _shrunk(noise: AxisNoise | None, sample: Residuals) -> AxisNoise:
    """Combine the noise of the axes with equal noise, the better the less they are known.

    A body whose residuals cannot tell the axes apart (a trimer that hardly turns) is left with
    equal noise, and with an error that allows standard deviations of 1 : 1 : 3.
    """
    mean = float((sample.vector**2).sum()) / (sample.freedom * max(len(sample.vector) - 1, 1))
    equal, doubt = np.full(3, mean), (_UNEQUAL * mean) ** 2 * np.eye(3)
    if noise is None:
        return AxisNoise(equal, doubt)
    gain = np.linalg.solve(doubt + noise.covariance, doubt).T
    variance = np.maximum(equal + gain @ (noise.variance - equal), 0.0)
    return AxisNoise(variance, doubt - gain @ doubt)


def _noise_products(sample: Residuals, left: Floats) -> tuple[Floats, Floats]:
    """Return what unit noise of each lab axis adds to residual times stretch, and stretch squared.

    Second order in the noise: the fitted orientation errs by delta = sum A_i e_i with
    A_i = M^-1 [r_i]x, so that the residual has the mean (C - tr C) r_i / 2 - <delta x e_i>
    with C = <delta delta^T>, and the direction of z in the body, which errs with delta, is
    correlated with the residual where the axes of the lab have unequal noise.
    """
    turn, r = sample.rotation, sample.template
    inertia = np.sum(r * r) * np.eye(3) - r.T @ r
    arm = np.linalg.pinv(inertia) @ skew(r)
    # The derivative of u (u . r) with u -> u - delta x u; its last index is that of delta.
    up = turn[:, 2]
    turned = np.einsum("abd,td->tab", _LEVI_CIVITA, up)
    height = up @ r.T
    slope = -np.einsum("tab,tn->tnab", turned, height)
    slope = slope - np.einsum("ta,tcb,nc->tnab", up, turned, r)
    slope = np.einsum("nmij,tmjb->tnib", sample.keeps, slope)
    shared = np.einsum("lbp,liqc->ibpqc", arm, sample.keeps)
    products, squares = np.empty(3), np.empty(3)
    for axis in range(3):
        noise = turn[:, axis, :, None] * turn[:, axis, None, :]
        c = np.einsum("nab,tbc,ndc->tad", arm, noise, arm)
        shift = 0.5 * (np.einsum("tab,nb->tna", c, r) - np.einsum("tbb,na->tna", c, r))
        shift -= np.einsum("abc,nbp,tpc->tna", _LEVI_CIVITA, arm, noise)
        crossed = np.einsum("ibpqc,tpq->tibc", shared, noise)
        products[axis] = (left * shift).sum() + np.einsum("tncb,tnbc->", slope, crossed)
        squares[axis] = np.einsum("tnia,tab,tnib->", slope, c, slope)
    return products, squares


def measure_scan(sample: Residuals) -> Slope:
    """Measure how much later a frame's particles are recorded with height, s/um.

    A plane that sweeps through the body meets a particle at height h by h/v later than its
    centre, so that it is found displaced by the body's velocity times h/v. Noise, whatever its
    size along z, is not related to the velocity between the frames before and after.

    Parameters
    ----------
    sample : Residuals

    Returns
    -------
    Slope
        1/v with its sign; NaN in the plane and for a body at rest.
    """
    if sample.rotation.shape[-1] != 3 or len(sample.vector) < 3:
        return _UNKNOWN
    height = sample.rotation[:, 2] @ sample.template.T
    velocity = np.einsum("tij,ti->tj", sample.rotation, sample.velocity)
    return regress(sample, height[..., None] * velocity[:, None])


def body_residuals(motion: RigidMotion, positions: ArrayLike) -> Floats:
    """Return where the particles sit beside their places in the template, (T, n, d), um, body axes.

    Parameters
    ----------
    motion : RigidMotion
    positions : array_like, shape (T, n, d)
        The positions that the motion was fitted to.
    """
    x = as_positions(positions)
    out: Floats = np.einsum("tij,tni->tnj", motion.rotation, x - motion.center[:, None])
    return out - motion.template
