"""Averages over all pairs of frames a lag time apart: MSD and MSAD, by one FFT kernel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from perrin._arrays import (
    Bools,
    Floats,
    Ints,
    TooFewFramesError,
    as_positions,
    frozen,
    present,
    require_positive,
)
from perrin.motion import RigidMotion

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, eq=False)
class LagCurve:
    """A mean square displacement, or angle, against lag time: value = 2 dof D t + offset.

    Attributes
    ----------
    lagtime : ndarray, shape (L,)
        s.
    value : ndarray, shape (L,)
        Sum of the components; NaN at a lag without a pair.
    components : ndarray, shape (L, c)
        The same by lab axis.
    stderr : ndarray, shape (L,)
        Standard error for Brownian motion with localisation noise, overlapping pairs counted as
        what they are. Neighbouring lags are strongly correlated.
    n_pairs : ndarray of int, shape (L,)
        Pairs of frames (times particles, for free particles).
    dof : int
        Angles or coordinates that diffuse: 3 for an MSD in space, 2 for an MSAD (1 in the plane).
    quantity : {"rotation", "translation", "orientation"}
    unit : str
        Unit of value.
    n_walks : float
        Independent one-dimensional walks that were averaged: 3 for the MSD of one centre, 2 for the
        MSAD of one direction, 3 for that of all directions of a cluster.
    """

    lagtime: Floats
    value: Floats
    components: Floats
    stderr: Floats
    n_pairs: Ints
    dof: int
    quantity: str
    unit: str
    n_walks: float

    def __post_init__(self) -> None:
        frozen(self.lagtime, self.value, self.components, self.stderr, self.n_pairs)

    def __repr__(self) -> str:
        names = {"rotation": "MSAD", "translation": "MSD", "orientation": "correlation"}
        name = names[self.quantity]
        return f"LagCurve({name}, {len(self.lagtime)} lags, dof={self.dof}, {self.unit})"

    def to_frame(self) -> pd.DataFrame:
        """Return the curve as a table with a row per lag."""
        import pandas as pd

        axes = "xyz" if self.components.shape[1] == 3 else "xy"
        names = axes if self.components.shape[1] > 1 else "z"
        columns: dict[str, object] = {"lagtime": self.lagtime, "value": self.value}
        if self.quantity != "orientation":  # a correlation has no components
            columns |= {f"value_{a}": self.components[:, i] for i, a in enumerate(names)}
        columns |= {"stderr": self.stderr, "n_pairs": self.n_pairs}
        return pd.DataFrame(columns)


def msd(motion_or_positions: RigidMotion | ArrayLike, *, dt: float | None = None) -> LagCurve:
    """Return the mean square displacement over all lag times (Hunter 2011, Eq. 24: 6 D_T t).

    Parameters
    ----------
    motion_or_positions : RigidMotion or array_like, shape (T, n, d)
        A motion (its centre is used), or the positions of free particles, um, NaN where missing.
    dt : float, optional
        Time between frames, s; for positions only, where it is required.

    Returns
    -------
    LagCurve
        um^2; dof = d.

    Raises
    ------
    ValueError
        If dt is missing or superfluous, or the frames of a motion are not evenly spaced.
    TooFewFramesError
        If no two frames are there.

    Examples
    --------
    >>> import numpy as np
    >>> steady = np.arange(5.0)[:, None, None] * [[1.0, 0.0, 0.0]]
    >>> msd(steady, dt=0.5).value
    array([ 1.,  4.,  9., 16.])
    """
    if isinstance(motion_or_positions, RigidMotion):
        if dt is not None:
            raise ValueError("dt: a RigidMotion knows its own; leave dt out")
        motion = motion_or_positions
        walks, piece = _on_grid(motion, motion.center[:, None])
        return _curve(walks, piece, dt=motion.dt, quantity="translation", dof=walks.shape[2])
    if dt is None:
        raise ValueError("dt: the time between frames (s) is needed with positions")
    require_positive(dt=dt)
    walks = as_positions(motion_or_positions)
    piece = np.zeros(len(walks), dtype=np.int64)
    return _curve(walks, piece, dt=dt, quantity="translation", dof=walks.shape[2])


def msad(motion: RigidMotion, *, directions: ArrayLike | None = None) -> LagCurve:
    """Return the mean square angular displacement of directions (Hunter 2011, Eqs. 19 and 20).

    Parameters
    ----------
    motion : RigidMotion
    directions : array_like, shape (d,) or (K, d), optional
        Body-fixed directions at the first fitted frame; several are averaged. Default: those of
        the particles, as in the paper's Fig. 5.

    Returns
    -------
    LagCurve
        rad^2; dof = 2 (4 D_R t), in the plane 1 (2 D_R t).

    Raises
    ------
    ValueError
        If a direction is zero or the frames are not evenly spaced.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.0), D_R=1e-3, dt=1.0, n_frames=20000, rng=0)
    >>> round(float(msad(truth).value[9]) / (4 * 1e-3 * 10), 1)
    1.0
    """
    p = _directions(motion, directions)
    phi, piece = _on_grid(motion, motion.rotational_displacement(p))
    planar = phi.shape[2] == 1
    # Averaging directions p weighs a rotation vector w by |w|^2 - <(w.p)^2>.
    unit = p / np.linalg.norm(p, axis=1, keepdims=True)
    weight = np.eye(p.shape[1]) - unit.T @ unit / len(unit)
    walks = 1.0 if planar else float(np.trace(weight) ** 2 / np.sum(weight * weight))
    dof = 1 if planar else 2
    return _curve(phi, piece, dt=motion.dt, quantity="rotation", dof=dof, independent=walks)


def msad_vector(motion: RigidMotion) -> LagCurve:
    """Return the mean square of the summed rotation vectors (Hunter 2011, appendix).

    Every step adds its angle times its axis; unlike the direction of one vector this sees all
    three rotations, so the curve is 6 D_R t, and 2/3 of it compares with `msad`.

    Parameters
    ----------
    motion : RigidMotion

    Returns
    -------
    LagCurve
        rad^2, lab axes; dof = 3 (1 in the plane).

    Raises
    ------
    ValueError
        If the frames are not evenly spaced.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.0), D_R=1e-3, dt=1.0, n_frames=20000, rng=0)
    >>> round(float(msad_vector(truth).value[9]) / (6 * 1e-3 * 10), 1)
    1.0
    """
    walk, piece = _on_grid(motion, motion.accumulated_rotation()[:, None])
    dof = walk.shape[2]
    return _curve(walk, piece, dt=motion.dt, quantity="rotation", dof=dof, independent=float(dof))


def orientation_correlation(
    motion: RigidMotion, *, degree: int = 1, directions: ArrayLike | None = None
) -> LagCurve:
    """Return the orientational correlation <P_l(p(t) . p(t + dt))> over all lag times.

    Parameters
    ----------
    motion : RigidMotion
        In three dimensions.
    degree : int
        l = 1 or 2 of the Legendre polynomial.
    directions : array_like, shape (3,) or (K, 3), optional
        Body-fixed directions, averaged; default those of the particles.

    Returns
    -------
    LagCurve
        Dimensionless; decays as exp(-l (l + 1) D_R t). ``stderr`` is NaN: it is for display, the
        steps tell D_R far better. ``dof`` is l (l + 1) / 2, half the rate over D_R.

    Raises
    ------
    ValueError
        For another degree, a planar motion, or frames that are not evenly spaced.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.0), D_R=1e-2, dt=1.0, n_frames=20000, rng=0)
    >>> curve = orientation_correlation(truth)
    >>> round(float(curve.value[49]), 1)  # exp(-2 x 0.01 x 50)
    0.4
    """
    if degree not in (1, 2):
        raise ValueError(f"degree: expected 1 or 2, got {degree!r}")
    if motion.template.shape[1] != 3:
        raise ValueError("orientation_correlation is for motions in three dimensions")
    p = motion.orientation(_directions(motion, directions))
    # |p' - p|^2 = 2 - 2 p.p', and the same for the tensors pp: one kernel serves both degrees.
    walk = p if degree == 1 else (p[..., :, None] * p[..., None, :]).reshape(*p.shape[:2], 9)
    grid, piece = _on_grid(motion, walk)
    curve = _curve(grid, piece, dt=motion.dt, quantity="rotation", dof=1, independent=1.0)
    cosine = 1 - curve.value / 2
    value = cosine if degree == 1 else 1.5 * cosine - 0.5
    return LagCurve(
        lagtime=curve.lagtime.copy(),
        value=value,
        components=value[:, None].copy(),
        stderr=np.full_like(value, np.nan),
        n_pairs=curve.n_pairs.copy(),
        dof=degree * (degree + 1) // 2,
        quantity="orientation",
        unit="1",
        n_walks=1.0,
    )


class QuaternionCovariance(NamedTuple):
    """<q q^T> of the vector part of the relative body-frame quaternion, against lag time.

    Attributes
    ----------
    lagtime : ndarray, shape (L,)
        s.
    covariance : ndarray, shape (L, 3, 3)
        Body axes; NaN at a lag without a pair.
    n_pairs : ndarray of int, shape (L,)
    """

    lagtime: Floats
    covariance: Floats
    n_pairs: Ints


def quaternion_covariance(
    motion: RigidMotion, *, n_lags: int | None = None
) -> QuaternionCovariance:
    """Return the covariance of relative quaternions over lag times, all pairs of frames.

    The unit quaternion of R_k^T R_{k+n} is (cos(a/2), q), q = sin(a/2) times the axis. With
    M the mean of those rotations, <q q^T> = sym(M)/2 - (tr M - 1)/4, and M comes from one FFT of
    each of the nine elements. For a tensor with principal values D_i,
    <q_i^2> = (1 + exp(-(D_j + D_k)t) - exp(-(D_i + D_j)t) - exp(-(D_i + D_k)t))/4 (Favro 1960).

    Parameters
    ----------
    motion : RigidMotion
        In three dimensions; frames without a pose are left out.
    n_lags : int, optional
        Number of lags from one frame on; default all.

    Returns
    -------
    QuaternionCovariance

    Raises
    ------
    ValueError
        For a planar motion, a number of lags that is not 1 or more, or frames that are not evenly
        spaced.
    TooFewFramesError
        If no two frames in one piece have a pose.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(
    ...     Cluster.tetrahedron(1.0), D_R=[1e-3, 2e-3, 4e-3], dt=1.0, n_frames=20000, rng=0
    ... )
    >>> first = quaternion_covariance(truth, n_lags=1).covariance[0]
    >>> (first.diagonal() / 0.5e-3).round(1)  # q is half the rotation vector: D t/2
    array([1., 2., 4.])
    """
    if motion.template.shape[1] != 3:
        raise ValueError("quaternion_covariance is for motions in three dimensions")
    if n_lags is not None and (n_lags != int(n_lags) or n_lags < 1):
        raise ValueError(f"n_lags: expected a whole number >= 1, got {n_lags!r}")
    grid, piece = _on_grid(motion, motion.rotation)
    count = len(grid) - 1 if n_lags is None else min(int(n_lags), len(grid) - 1)
    sums, pairs = np.zeros((count, 3, 3)), np.zeros(count, np.int64)
    for label in np.unique(piece):
        inside = (piece == label) & np.isfinite(grid[:, 0, 0])
        more, found = _relative_sums(grid, inside, count)
        sums, pairs = sums + more, pairs + found
    if not pairs.any():
        raise TooFewFramesError("no two frames in one piece: a relative rotation needs two", 0)
    mean = np.full_like(sums, np.nan)
    np.divide(sums, pairs[:, None, None], out=mean, where=pairs[:, None, None] > 0)
    trace = np.trace(mean, axis1=1, axis2=2)[:, None, None]
    covariance = 0.5 * mean - 0.25 * (trace - 1) * np.eye(3)
    lagtime = np.arange(1, count + 1, dtype=np.float64) * motion.dt
    return QuaternionCovariance(lagtime, covariance, pairs)


def _relative_sums(grid: Floats, inside: Bools, count: int) -> tuple[Floats, Ints]:
    """Return the summed sym(R_k^T R_{k+n}) for n = 1..count over frames inside, and the pairs."""
    rows = np.flatnonzero(inside)
    if rows.size < 2:
        return np.zeros((count, 3, 3)), np.zeros(count, np.int64)
    here = inside[rows[0] : rows[-1] + 1]
    size = _fast_size(len(here) + count)
    element = np.where(here, np.moveaxis(grid[rows[0] : rows[-1] + 1], 0, -1), 0.0)
    f = np.fft.rfft(element, size)
    m = np.fft.rfft(here.astype(np.float64), size)
    sums = np.empty((count, 3, 3))
    for i in range(3):
        for j in range(i + 1):
            # The transform of a sum over k and its transpose's is the real part.
            power = (f[:, i].real * f[:, j].real + f[:, i].imag * f[:, j].imag).sum(axis=0)
            sums[:, i, j] = sums[:, j, i] = np.fft.irfft(power, size)[1 : count + 1]
    pairs = np.fft.irfft(m.real**2 + m.imag**2, size)[1 : count + 1]
    return sums, np.rint(pairs).astype(np.int64)


def _directions(motion: RigidMotion, directions: ArrayLike | None) -> Floats:
    """Return the directions asked for as (K, d), or those of the particles."""
    if directions is not None:
        return np.atleast_2d(np.asarray(directions, dtype=np.float64))
    length = np.linalg.norm(motion.template, axis=1)
    # A particle at the centre has no direction.
    return np.asarray(motion.template[length > 1e-6 * length.max()])


def _on_grid(motion: RigidMotion, walks: Floats) -> tuple[Floats, Ints]:
    """Put walks (T, K, c) on the even grid of frames; frames without a row are missing."""
    step = (motion.time - motion.time[0]) / motion.dt
    row = np.rint(step).astype(np.int64)
    if np.max(np.abs(step - row)) > 1e-3 or np.any(np.diff(row) < 1):
        raise ValueError(
            f"the frames are not evenly spaced (dt = {motion.dt:g} s): lag times mix; "
            "estimate_diffusion takes the times as they are"
        )
    grid = np.full((int(row[-1]) + 1, *walks.shape[1:]), np.nan)
    piece = np.zeros(len(grid), dtype=np.int64)
    grid[row], piece[row] = walks, motion.piece
    return grid, piece


def _curve(
    walks: Floats,
    piece: Ints,
    *,
    dt: float,
    quantity: str,
    dof: int,
    independent: float | None = None,
) -> LagCurve:
    """Average walks (T, K, c) over time, pieces and the K walkers."""
    squares, pairs = np.zeros((len(walks) - 1, walks.shape[2])), np.zeros(len(walks) - 1, np.int64)
    for label in np.unique(piece):
        inside = np.where((piece == label)[:, None, None], walks, np.nan)
        more, count = _square_sums(inside)
        squares, pairs = squares + more, pairs + count
    if not pairs.any():
        raise TooFewFramesError("no two frames in one piece: a displacement needs two", 0)
    average = np.full_like(squares, np.nan)
    np.divide(squares, pairs[:, None], out=average, where=pairs[:, None] > 0)
    value = average.sum(axis=1)
    # Free particles are independent walkers; the directions of one body are not.
    walkers = walks.shape[1] if independent is None else 1
    n_walks = float(walks.shape[2] * walkers) if independent is None else independent
    shared = pairs / walks.shape[1]
    relative = _relative_error(value / (2 * dof), shared)
    return LagCurve(
        lagtime=np.arange(1, len(walks), dtype=np.float64) * dt,
        value=value,
        components=average,
        stderr=value * relative / np.sqrt(n_walks),
        n_pairs=pairs if independent is None else np.rint(shared).astype(np.int64),
        dof=dof,
        quantity=quantity,
        unit="rad^2" if quantity == "rotation" else "um^2",
        n_walks=n_walks,
    )


def _square_sums(walks: Floats) -> tuple[Floats, Ints]:
    """Return sum |x(t + lag) - x(t)|^2 per component and the pairs, all lags from 1, walkers added.

    With m the presence, the sum is corr(m x^2, m) + corr(m, m x^2) - 2 corr(m x, m x). The mean is
    taken off first: squares of a far origin would swallow the displacements.
    """
    length = len(walks)
    here = present(walks)
    mask = here.astype(np.float64)
    mean = np.where(here[..., None], walks, 0.0).sum(0) / np.maximum(mask.sum(0), 1)[:, None]
    x = np.where(here[..., None], walks - mean, 0.0)
    size = _fast_size(2 * length)
    m = np.fft.rfft(mask, size, axis=0)[..., None]
    f, g = np.fft.rfft(x, size, axis=0), np.fft.rfft(x * x, size, axis=0)
    spectrum = 2 * np.real(np.conj(m) * g) - 2 * np.abs(f) ** 2
    sums = np.fft.irfft(spectrum.sum(1), size, axis=0)[1:length]
    counts = np.fft.irfft((np.abs(m) ** 2).sum((1, 2)), size)[1:length]
    # A sum of squares that rounds below zero is zero.
    return np.maximum(sums, 0.0), np.rint(counts).astype(np.int64)


def _fast_size(least: int) -> int:
    """Return the smallest 2^a 3^b 5^c that is at least `least`: such transforms are fast."""
    best = 1 << (least - 1).bit_length()
    five = 1
    while five < best:
        three = five
        while three < best:
            two = -(-least // three)
            best = min(best, three << (two - 1).bit_length())
            three *= 3
        five *= 5
    return best


def _relative_error(half: Floats, pairs: Floats) -> Floats:
    """Return the relative standard error of a one-dimensional MSD at every lag.

    `half` is the MSD over 2, that is D t + s. Displacements over n frames that start j frames apart
    have covariance 2 D dt (n - j) + 2 s [j = 0] - s [j = n] for j <= n; the variance of their mean
    square is twice the mean of its square. D dt and s come from the first two lags.
    """
    good = np.flatnonzero(pairs > 0)
    n = np.arange(1, len(half) + 1, dtype=np.float64)
    first, second = (good[0], good[1]) if good.size > 1 else (good[0], good[0])
    rise = (half[second] - half[first]) / max(n[second] - n[first], 1.0)
    d = min(max(rise, 0.0), half[first] / n[first])
    s = half[first] - d * n[first]
    k = np.maximum(pairs, 1.0)
    m = np.minimum(n - 1, np.floor(k - 1))
    s1, s2, s3 = m * (m + 1) / 2, m * (m + 1) * (2 * m + 1) / 6, (m * (m + 1) / 2) ** 2
    squares = n * n * m - 2 * n * s1 + s2  # sum over j = 1..m of (n - j)^2
    tapered = squares - (n * n * s1 - 2 * n * s2 + s3) / k  # the same times 1 - j/k
    total = (2 * (d * n + s)) ** 2 + 2 * (4 * d * d * tapered)
    total = total + 2 * s * s * np.maximum(1 - n / k, 0.0)
    mean = 2 * (d * n + s)
    relative = np.full_like(half, np.nan)
    np.divide(np.sqrt(2 * total / k), mean, out=relative, where=(pairs > 0) & (mean > 0))
    return relative
