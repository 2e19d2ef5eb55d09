"""Non-Gaussian parameters of displacements and rotations against lag time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike

from perrin._arrays import choice_fault, refuse
from perrin.curves.displacement import LagCurve
from perrin.curves.grids import place_frames
from perrin.curves.noise_offsets import center_offset, correction_fault, orientation_offsets
from perrin.curves.pairs import pairs_apart
from perrin.errors import TooFewFramesError
from perrin.geometry.rotations import unit_quaternion

if TYPE_CHECKING:
    from perrin._arrays import Floats, Ints
    from perrin.motion.rigid_motion import RigidMotion

_SERIES_FROM = 1e-3  # D t from which the series of characters is used, and the terms that it needs
_SERIES_TERMS = 220

_LAGS_PER_DECADE = 10
_MOST_JACKKNIFE_BLOCKS, _LEAST_BLOCKS = 12, 4  # blocks of a track whose scatter is the error
_SHORTEST_BLOCK = 2  # lags that a block is long, so that blocks are nearly independent


def heat_kernel_moments(Dt: ArrayLike) -> tuple[Floats, Floats]:
    """Return <a^2> and <a^4> of the angle a of a Brownian rotation, exact at every D t.

    With the density (1/pi) sum_l (2l + 1) exp(-l(l+1) D t) [cos(l a) - cos((l + 1) a)] of the heat
    kernel on SO(3) the moments are sums of those of cosines. Below D t = 0.001 the first two terms
    of an expansion about a Gaussian are exact to rounding.

    Parameters
    ----------
    Dt : array_like
        Rotational diffusion coefficient times time, rad^2.

    Returns
    -------
    square, fourth : ndarray
        Means in rad^2 and rad^4, of the shape of `Dt`.

    Examples
    --------
    >>> square, fourth = heat_kernel_moments(100.0)  # uniform rotations: pi^2/3 + 2
    >>> bool(abs(square - np.pi**2 / 3 - 2) < 1e-12)
    True
    """
    t = np.asarray(Dt, dtype=np.float64)
    degree = np.arange(_SERIES_TERMS + 1.0)
    sign = (-1.0) ** degree
    with np.errstate(divide="ignore", invalid="ignore"):
        squares = np.where(degree > 0, 2 * np.pi * sign / degree**2, np.pi**3 / 3)
        fourths = sign * (4 * np.pi**3 / degree**2 - 24 * np.pi / degree**4)
    fourths[0] = np.pi**5 / 5
    degree = degree[:-1]
    decay = np.exp(-degree * (degree + 1) * np.maximum(t, _SERIES_FROM)[..., None])
    decay *= (2 * degree + 1) / np.pi
    square, fourth = (decay @ (m[:-1] - m[1:]) for m in (squares, fourths))
    near = t < _SERIES_FROM
    gaussian = 6 * t / (1 + t / 6)
    square = np.where(near, gaussian, square)
    return square, np.where(near, 5 / 3 * gaussian**2 * (1 - t * t / 90), fourth)


def brownian_alpha2(Dt: ArrayLike) -> Floats:
    """Return the non-Gaussian parameter of the rotation vector of Brownian rotation on SO(3).

    alpha_2 = 3 <a^4>/(5 <a^2>^2) - 1 with the angle a of the rotation during t. It is -(D t)^2/90
    for small angles, since the space of rotations is nearly flat there, and -0.2504 for uniform
    rotations: a rotation vector ends at pi.

    Parameters
    ----------
    Dt : array_like
        Rotational diffusion coefficient times time, rad^2, 0 or more. At finite noise of variance s
        of one orientation the law is that of D t + s.

    Returns
    -------
    ndarray
        Of the shape of `Dt`.

    Raises
    ------
    ValueError
        If a value is negative or not finite.

    Examples
    --------
    >>> brownian_alpha2([0.25, 0.5, 1.0]).round(4)
    array([-0.0018, -0.0459, -0.1685])
    """
    t = np.asarray(Dt, dtype=np.float64)
    if not np.all(np.isfinite(t) & (t >= 0)):
        raise ValueError(f"Dt: expected finite numbers >= 0 (rad^2), got {Dt!r}")
    square, fourth = heat_kernel_moments(t)
    excess = 3 * fourth / (5 * np.where(t > 0, square, 1.0) ** 2) - 1
    return np.asarray(np.where(t < _SERIES_FROM, -t * t / 90, excess))


def brownian_angle_time(mean_square: ArrayLike) -> Floats:
    """Return the D t at which a Brownian rotation has a given mean square angle <a^2>.

    Parameters
    ----------
    mean_square : array_like
        Mean square rotation angle, rad^2.

    Returns
    -------
    ndarray
        D t, rad^2; 100 from the mean square of uniform rotations (pi^2/3 + 2) on.

    Examples
    --------
    >>> square, _ = heat_kernel_moments([0.0, 0.02, 0.7])
    >>> brownian_angle_time(square).round(9)
    array([0.  , 0.02, 0.7 ])
    """
    wanted = np.asarray(mean_square, dtype=np.float64)
    low, high = np.zeros_like(wanted), np.full_like(wanted, 100.0)
    for _ in range(60):
        middle = 0.5 * (low + high)
        short = heat_kernel_moments(middle)[0] < wanted
        low, high = np.where(short, middle, low), np.where(short, high, middle)
    return np.asarray(high)


def non_gaussian(
    motion: RigidMotion,
    *,
    quantity: Literal["rotation", "translation"] = "rotation",
    noise: Literal["residual", "joint"] | float | None = "residual",
    lags: ArrayLike | None = None,
) -> LagCurve:
    """Return the non-Gaussian parameter of rotations or displacements against lag time.

    alpha_2 = c <r^4>/<r^2>^2 - 1 with c = d/(d + 2): 0 for Gaussian vectors in d dimensions,
    positive where the mobility changes in time or between bodies.

    Parameters
    ----------
    motion : RigidMotion
        Positions and orientations against time.
    quantity : {"rotation", "translation"}
        Rotations are the rotation vectors of R(t)^T R(t + lag), up to pi.
    noise : "residual", "joint", float or None
        Noise that the parameter is corrected for. "residual": what the residuals of the rigid fits
        predict, which supposes nothing about the motion; right where all particles of a frame are
        recorded at the same instant. A number is the known localisation error of one coordinate,
        um. "joint": the offset of the steps, which holds where the motion is diffusion, of any D,
        from one frame to the next; it is too large for a body that rattles in a cage. None: no
        correction.
    lags : array_like, optional
        Lag times, s, whole numbers of steps between frames. Default: ten per decade, up to a tenth
        of the longest stretch of frames.

    Returns
    -------
    LagCurve
        Dimensionless. ``stderr`` comes from leaving out one block of the track after the other
        (jackknife), or is that of Gaussian motion where this is larger: it holds for motion that is
        not Gaussian, if its mobility changes many times within a twelfth of the track, and is NaN
        for lags over a ninth of it. ``brownian`` is 0
        for translation and in the plane, and `brownian_alpha2` for rotation: the value of a
        Brownian rotor that turns as much. ``noise`` is the variance of one axis that was corrected
        for.

    Raises
    ------
    ValueError
        For an unknown quantity or noise, lags that are not whole numbers of steps, or a body that
        does not move.
    TooFewFramesError
        If no two frames are one of these lags apart.

    Notes
    -----
    Gaussian noise adds 2 o to the second cumulant of each axis of a difference and nothing to the
    fourth: alpha_2 = measured alpha_2 [M/(M - 2 d o)]^2, with M the measured mean square over d
    axes; it is NaN where noise accounts for all of M. For rotation the law of SO(3) is subtracted
    before this correction, and that at the smaller M added after it. The bias of short tracks, to
    the first order in their inverse length, is removed by the jackknife.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.0), D_R=1e-3, dt=1.0, n_frames=3000, rng=0)
    >>> curve = non_gaussian(truth, lags=[1.0, 10.0])
    >>> bool((abs(curve.value - curve.brownian) < 3 * curve.stderr).all())
    True
    """
    faults = choice_fault("quantity", quantity, ("rotation", "translation"))
    refuse(faults + correction_fault(noise))
    rotates = quantity == "rotation"
    frames = place_frames(motion.time, motion.piece, np.isfinite(motion.center[:, 0]), dt=motion.dt)
    steps = whole_lags(lags, frames.lengths, frames.step)
    rows = frames.row
    if rotates:
        offsets = orientation_offsets(motion, noise)[motion.fitted]
        axes = offsets.shape[-1]
        offset = float(np.trace(offsets.mean(axis=0))) / axes
        # Rotation vectors in the plane are the angles of the complex numbers (cos, sin).
        pose = unit_quaternion(motion.rotation[rows]) if axes == 3 else motion.rotation[rows, :, 0]
    else:
        offset, axes = center_offset(motion, noise), motion.dimension
        pose = motion.center[rows]
    size = len(steps)
    lagtime, value, stderr, law = (np.full(size, np.nan) for _ in range(4))
    pairs = np.zeros(size, dtype=np.int64)
    for i, lag in enumerate(steps):
        first, last = pairs_apart(frames.time / frames.step, frames.piece, float(lag))
        if not first.size:
            continue
        a, b = pose[first], pose[last]
        if rotates:
            square = turned_angles(a, b, quaternions=axes == 3) ** 2
        else:
            square = np.sum((b - a) ** 2, axis=-1)
        pairs[i] = first.size
        lagtime[i] = np.mean(frames.time[last] - frames.time[first])
        if square.any():  # a body at rest has none
            value[i], stderr[i], law[i] = corrected_excess(
                square, lag=int(lag), axes=axes, offset=offset, curved=rotates and axes == 3
            )
    if not pairs.any():
        raise TooFewFramesError("no two frames of one piece are one of these lags apart", 0)
    if np.isnan(law).all() and not offset > 0:
        raise ValueError("the body does not move: its displacements have no non-Gaussian parameter")
    lagtime = np.where(pairs > 0, lagtime, steps * frames.step)
    return LagCurve(
        lagtime=lagtime,
        value=value,
        components=value[:, None].copy(),
        stderr=stderr,
        n_pairs=pairs,
        dof=axes,
        quantity="non-Gaussian",
        unit="1",
        n_walks=float(axes),
        noise=offset,
        step=frames.step,
        blocks=tuple(int(n) for n in frames.lengths),
        brownian=law,
    )


def whole_lags(lags: ArrayLike | None, lengths: Ints, step: float) -> Ints:
    """Return lags in steps: those given in s, or ten per decade up to a tenth of the longest block.

    Parameters
    ----------
    lags : array_like or None
        Lag times, s.
    lengths : ndarray of int, shape (B,)
        Steps of each stretch of frames.
    step : float
        Time between frames, s.

    Returns
    -------
    ndarray of int

    Raises
    ------
    ValueError
        If a lag is not a whole number of steps, 1 or more.

    Examples
    --------
    >>> whole_lags(None, np.array([100]), 0.5), whole_lags([2.0, 5.0], np.array([100]), 0.5)
    (array([ 1,  2,  3,  4,  5,  6,  8, 10]), array([ 4, 10]))
    """
    if lags is None:
        decades = np.log10(max(int(lengths.max()) // 10, 1))
        count = int(np.ceil(decades * _LAGS_PER_DECADE)) + 1
        return np.unique(np.rint(np.logspace(0, decades, count)).astype(np.int64))
    given = np.atleast_1d(np.asarray(lags, dtype=np.float64)) / step
    whole = np.rint(given)
    if (
        given.ndim != 1
        or not given.size
        or not np.all((np.abs(given - whole) < 1e-3) & (whole > 0))
    ):
        raise ValueError(f"lags: expected whole multiples of {step:g} s, got {lags!r}")
    return whole.astype(np.int64)


def turned_angles(a: Floats, b: Floats, *, quaternions: bool) -> Floats:
    """Return the angle, rad, 0 to pi, between orientations.

    Parameters
    ----------
    a, b : ndarray, shape (P, 4) or (P, 2)
        Unit quaternions, or in the plane unit vectors.
    quaternions : bool
        Whether a vector and its opposite are one orientation, turned by twice their angle.

    Returns
    -------
    ndarray, shape (P,)

    Examples
    --------
    >>> turned_angles(np.array([[1.0, 0.0]]), np.array([[0.0, -1.0]]), quaternions=False)
    array([1.57079633])
    """
    apart, together = np.linalg.norm(b - a, axis=-1), np.linalg.norm(b + a, axis=-1)
    if quaternions:
        return np.asarray(4 * np.arctan2(np.minimum(apart, together), np.maximum(apart, together)))
    return np.asarray(2 * np.arctan2(apart, together))


def without_noise(
    measured: Floats | float, heat: float, *, offset: float, curved: bool
) -> tuple[Floats, float]:
    """Return alpha_2 without noise, from a measured one, and that of Brownian motion.

    Parameters
    ----------
    measured : float or ndarray
        alpha_2 of the noisy motion.
    heat : float
        D t of Brownian motion with the measured mean square, noise included: half of the mean
        square of one axis, or `brownian_angle_time`.
    offset : float
        Noise variance of one axis of one frame, less than `heat`.
    curved : bool
        Whether the vectors are rotation vectors in space.

    Returns
    -------
    alpha2 : ndarray
    brownian : float

    Examples
    --------
    >>> alpha2, _ = without_noise(0.16, 2.0, offset=1.0, curved=False)  # half of it is noise
    >>> float(alpha2)
    0.64
    """
    noisy, law = (
        float(brownian_alpha2(max(x, 0.0))) if curved else 0.0 for x in (heat, heat - offset)
    )
    return (np.asarray(measured) - noisy) * (heat / (heat - offset)) ** 2 + law, law


def corrected_excess(
    square: Floats, *, lag: int, axes: int, offset: float, curved: bool
) -> tuple[float, float, float]:
    """Return alpha_2 without noise and bias, its standard error, and the Brownian law.

    Parameters
    ----------
    square : ndarray, shape (P,)
        Squared lengths of the vectors of all pairs, in order of their first frames.
    lag : int
        Steps between the frames of a pair.
    axes : int
        Components d of each vector.
    offset : float
        Noise variance of one axis of one frame.
    curved : bool
        Whether the vectors are rotation vectors in space.

    Returns
    -------
    alpha2, stderr, brownian : float
        NaN where noise accounts for the whole mean square; the error is NaN for fewer than four
        blocks of pairs.

    Examples
    --------
    >>> squares = np.random.default_rng(1).chisquare(3, 5000)
    >>> alpha2, stderr, law = corrected_excess(squares, lag=1, axes=3, offset=0.0, curved=False)
    >>> bool(abs(alpha2) < 3 * stderr), law
    (True, 0.0)
    """
    factor = axes / (axes + 2)
    mean = float(square.mean())
    heat = float(brownian_angle_time(mean)) if curved else mean / (2 * axes)
    if heat <= offset:
        return np.nan, np.nan, np.nan
    number = min(_MOST_JACKKNIFE_BLOCKS, len(square) // (_SHORTEST_BLOCK * lag))
    edges = np.linspace(0, len(square), max(number, 1) + 1).astype(int)[:-1]
    sums = np.add.reduceat(np.stack([np.ones_like(square), square, square**2], axis=1), edges)
    # All pairs first, then all but those of each block.
    count, second, fourth = (sums.sum(axis=0) - np.vstack([np.zeros(3), sums])).T
    if number < _LEAST_BLOCKS:
        count, second, fourth = count[:1], second[:1], fourth[:1]
    raw = factor * fourth * count / second**2 - 1
    excess, law = without_noise(raw, heat, offset=offset, curved=curved)
    # A block changes the mean square, and with it the correction for noise.
    own = heat * second / count / mean
    gain = (own / (own - offset) * (heat - offset) / heat) ** 2
    excess = (excess - law) * gain + law
    if number < _LEAST_BLOCKS:
        return float(excess[0]), np.nan, law
    others = excess[1:]
    value = number * excess[0] - (number - 1) * others.mean()
    # Overlapping pairs of Gaussian motion have the correlation of the time that they share.
    shared = np.arange(1, lag) / lag
    powers = (
        (1 - offset / heat) ** 4 * shared**4 @ np.maximum(1 - (lag - lag * shared) / len(square), 0)
    )
    gaussian = 8 / (axes * (axes + 2)) * (1 + 2 * powers) / len(square)
    gaussian *= (heat / (heat - offset)) ** 4
    return float(value), float(np.sqrt(max(gaussian, (number - 1) * others.var()))), law
