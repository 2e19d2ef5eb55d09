"""What a lag time apart differs: MSD, MSAD, correlations and distributions over all pairs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import erf
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.polynomial.polynomial import polyval
from numpy.typing import ArrayLike

from perrin._arrays import (
    Floats,
    Ints,
    TooFewFramesError,
    as_positions,
    frozen,
    present,
    require_positive,
)
from perrin.motion import RigidMotion, threshold_displacement

if TYPE_CHECKING:
    import pandas as pd

_ORDERS = 100  # of Hermite polynomials, beyond which the error of a bin is bounded from above


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
        what they are, missing frames as missing at random. Neighbouring lags are strongly
        correlated.
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
    drift : tuple of float or None
        Mean velocity that was taken off, um/s by axis.
    noise : float
        Noise variance of one orientation (rad^2) or centre coordinate (um^2) that the rigid-fit
        residuals predict; NaN where there are none (free particles).
    resolution_floor : float or None
        The D_R that a motionless cluster would read (rad^2/s); None for translation.
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
    drift: tuple[float, ...] | None = None
    noise: float = np.nan
    resolution_floor: float | None = None

    def __post_init__(self) -> None:
        frozen(self.lagtime, self.value, self.components, self.stderr, self.n_pairs)

    def __repr__(self) -> str:
        names = {"rotation": "MSAD", "translation": "MSD", "orientation": "correlation"}
        name = names[self.quantity]
        return f"LagCurve({name}, {len(self.lagtime)} lags, dof={self.dof}, {self.unit})"

    def to_frame(self) -> pd.DataFrame:
        """Return a table with a row per lag; lab components where there are several."""
        import pandas as pd

        axes = "xyz" if self.components.shape[1] == 3 else "xy"
        columns: dict[str, object] = {"lagtime": self.lagtime, "value": self.value}
        if self.components.shape[1] > 1:
            columns |= {f"value_{a}": self.components[:, i] for i, a in enumerate(axes)}
        columns |= {"stderr": self.stderr, "n_pairs": self.n_pairs}
        return pd.DataFrame(columns)


def msd(
    motion_or_positions: RigidMotion | ArrayLike, *, dt: float | None = None, drift: bool = False
) -> LagCurve:
    """Return the mean square displacement over all lag times (Hunter 2011, Eq. 24: 6 D_T t).

    Parameters
    ----------
    motion_or_positions : RigidMotion or array_like, shape (T, n, d)
        A motion (its centre is used), or the positions of free particles, um, NaN where missing.
    dt : float, optional
        Time between frames, s; for positions only, where it is required.
    drift : bool
        Whether to take off a mean velocity, the same in all pieces and for all particles: flow,
        stage drift, sedimentation. It is told in ``LagCurve.drift``. What the velocity takes of the
        Brownian motion along with it, t/T of the MSD in a run of length T, is given back; of the
        longest lag of a single track nothing is left, and it is NaN. ``stderr`` is within 20 % up
        to half of the run, too small near its end.

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
    >>> msd(steady, dt=0.5, drift=True).drift
    (2.0, 0.0, 0.0)
    """
    if isinstance(motion_or_positions, RigidMotion):
        if dt is not None:
            raise ValueError("dt: a RigidMotion knows its own; leave dt out")
        motion, dt = motion_or_positions, motion_or_positions.dt
        walks, piece = on_grid(motion, motion.center[:, None])
    elif dt is None:
        raise ValueError("dt: the time between frames (s) is needed with positions")
    else:
        require_positive(dt=dt)
        walks = as_positions(motion_or_positions)
        piece = np.zeros(len(walks), dtype=np.int64)
    make = _undrifted if drift else _curve
    return make(walks, piece, dt=dt, quantity="translation", dof=walks.shape[2])


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
    phi, piece = on_grid(motion, motion.rotational_displacement(p))
    planar = phi.shape[2] == 1
    # Averaging directions p weighs a rotation vector w by |w|^2 - <(w.p)^2>.
    unit = p / np.linalg.norm(p, axis=1, keepdims=True)
    weight = np.eye(p.shape[1]) - unit.T @ unit / len(unit)
    walks = 1.0 if planar else float(np.trace(weight) ** 2 / np.sum(weight * weight))
    dof = 1 if planar else 2
    return _curve(phi, piece, dt=motion.dt, quantity="rotation", dof=dof, independent=walks)


def msad_vector(motion: RigidMotion, *, threshold: float = 0.0) -> LagCurve:
    """Return the mean square of the summed rotation vectors (Hunter 2011, appendix).

    Every step adds its angle times its axis; unlike the direction of one vector this sees all
    three rotations, so the curve is 6 D_R t, and 2/3 of it compares with `msad`.

    Parameters
    ----------
    motion : RigidMotion
    threshold : float
        rad; above 0, the rotation is counted from a reference that is renewed only when it exceeds
        this, as in `threshold_displacement`: for motion in cages or hardly above the noise.

    Returns
    -------
    LagCurve
        rad^2, lab axes; dof = 3 (1 in the plane).

    Raises
    ------
    ValueError
        If the frames are not evenly spaced, or for a threshold out of range.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.0), D_R=1e-3, dt=1.0, n_frames=20000, rng=0)
    >>> round(float(msad_vector(truth).value[9]) / (6 * 1e-3 * 10), 1)
    1.0
    """
    angles = threshold_displacement(motion, threshold=threshold)
    walk, piece = on_grid(motion, angles[:, None])
    dof = walk.shape[2]
    return _curve(walk, piece, dt=motion.dt, quantity="rotation", dof=dof, independent=float(dof))


def msad_axes(motion: RigidMotion, *, axes: ArrayLike | None = None) -> tuple[LagCurve, ...]:
    """Return the mean square angle turned about single axes of the body, one curve per axis.

    The body-frame rotation vectors of all steps are added up component by component: 2 D t with
    the D of that axis, however the body has turned meanwhile.

    Parameters
    ----------
    motion : RigidMotion
    axes : array_like, shape (3,) or (K, 3), optional
        Body-fixed axes at the first fitted frame. Default: the principal axes of the particles'
        gyration tensor, the longest first; in the plane the one there is.

    Returns
    -------
    tuple of LagCurve
        rad^2; dof = 1 each.

    Raises
    ------
    ValueError
        If an axis is zero, axes are given in the plane, or the frames are not evenly spaced.

    Examples
    --------
    >>> from perrin import Cluster, fit_line, simulate_motion
    >>> rod = Cluster.from_positions([[-3, 0, 0], [0, 0.5, 0], [0, 0, 0.5], [3, 0, 0]])
    >>> truth = simulate_motion(rod, D_R=[5e-3, 1e-3, 1e-3], dt=1.0, n_frames=20000, rng=0)
    >>> along, *across = msad_axes(truth)
    >>> print(fit_line(along))
    D_R = 0.00501(9) rad^2/s [line, 20000 frames]
    """
    walk, piece = on_grid(motion, motion.accumulated_rotation(axes="body")[:, None])
    if walk.shape[2] == 1:
        if axes is not None:
            raise ValueError("axes: a motion in the plane turns about one axis only")
        unit = np.ones((1, 1))
    else:
        unit = _principal_axes(motion) if axes is None else _unit_vectors(axes)
    return tuple(
        _curve(walk @ a[:, None], piece, dt=motion.dt, quantity="rotation", dof=1, independent=1.0)
        for a in unit
    )


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
    p, piece = on_grid(motion, motion.orientation(_directions(motion, directions)))
    value, pairs = _mean_products(p if degree == 1 else _quadrupole(p), piece)
    return LagCurve(
        lagtime=np.arange(1, len(p), dtype=np.float64) * motion.dt,
        value=value,
        components=value[:, None].copy(),
        stderr=np.full_like(value, np.nan),
        n_pairs=pairs,
        dof=degree * (degree + 1) // 2,
        quantity="orientation",
        unit="1",
        n_walks=1.0,
    )


@dataclass(frozen=True, eq=False)
class VanHove:
    """How displacements or rotations over one lag time are distributed, beside a Gaussian.

    Attributes
    ----------
    lagtime : float
        s.
    edges : ndarray, shape (B + 1,)
        Of the bins, rad or um.
    density : ndarray, shape (B,)
        Probability per rad or um, all components of all pairs together.
    stderr : ndarray, shape (B,)
        What `density` would scatter by if the motion were Gaussian, overlapping pairs counted as
        what they are.
    gaussian : ndarray, shape (B,)
        The Gaussian of the same mean square, averaged over each bin.
    alpha2 : float
        Non-Gaussian parameter <x^4>/(3 <x^2>^2) - 1, freed from its bias in short tracks.
    alpha2_stderr : float
        What `alpha2` would scatter by about 0 if the motion were Gaussian.
    n_pairs : int
        Pairs of frames.
    quantity : {"rotation", "translation"}
    unit : str
        Of the edges.
    """

    lagtime: float
    edges: Floats
    density: Floats
    stderr: Floats
    gaussian: Floats
    alpha2: float
    alpha2_stderr: float
    n_pairs: int
    quantity: str
    unit: str

    def __post_init__(self) -> None:
        frozen(self.edges, self.density, self.stderr, self.gaussian)

    def to_frame(self) -> pd.DataFrame:
        """Return a table with a row per bin."""
        import pandas as pd

        return pd.DataFrame(
            {
                "low": self.edges[:-1],
                "high": self.edges[1:],
                "density": self.density,
                "stderr": self.stderr,
                "gaussian": self.gaussian,
            }
        )


def van_hove(
    motion: RigidMotion,
    *,
    lag: float,
    quantity: Literal["rotation", "translation"] = "rotation",
    bins: int | ArrayLike = 31,
) -> VanHove:
    """Return the distribution of rotations or displacements over one lag time (van Hove).

    Parameters
    ----------
    motion : RigidMotion
    lag : float
        s, a whole number of frames.
    quantity : {"rotation", "translation"}
        Rotations are differences of the unbounded `RigidMotion.accumulated_rotation`, not the
        rotation vectors between both frames, which end at pi. Components along all lab axes are
        taken together.
    bins : int or array_like, shape (B + 1,)
        Number of equal bins from the lowest to the highest value, symmetric about 0, or their edges
        (rad or um); values beyond given edges lower the density's integral.

    Returns
    -------
    VanHove

    Raises
    ------
    ValueError
        For a lag off the grid of frames, bad bins or quantity, or a body that does not move.
    TooFewFramesError
        If no two frames are that lag apart.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.0), D_R=1e-3, dt=1.0, n_frames=20000, rng=0)
    >>> result = van_hove(truth, lag=10.0)
    >>> abs(result.alpha2) < 3 * result.alpha2_stderr
    True
    """
    walk, piece, steps = _displaced(motion, lag=lag, quantity=quantity)
    step = walk[steps:] - walk[:-steps]
    x = step[np.isfinite(step[:, 0]) & (piece[steps:] == piece[:-steps])]
    if not len(x):
        raise TooFewFramesError(f"no two frames of one piece are {lag:g} s apart", 0)
    square = float(np.mean(x * x))
    if square == 0:
        raise ValueError("nothing moves: a distribution at rest has no width")
    edges = _bin_edges(bins, reach=float(np.abs(x).max()))
    shared = _shared(walk, piece, steps, pairs=len(x)) / x.shape[1]
    expected, spread = _gaussian_bins(edges / np.sqrt(square), shared)
    width = np.diff(edges)
    return VanHove(
        lagtime=steps * motion.dt,
        edges=edges,
        density=np.histogram(x, edges)[0] / (x.size * width),
        stderr=spread / width,
        gaussian=expected / width,
        alpha2=float(np.mean(x**4) / (3 * square**2) - 1 + 2 * shared[1]),
        alpha2_stderr=float(np.sqrt(8 / 3 * shared[3])),
        n_pairs=len(x),
        quantity=quantity,
        unit="rad" if quantity == "rotation" else "um",
    )


def _displaced(motion: RigidMotion, *, lag: float, quantity: str) -> tuple[Floats, Ints, int]:
    """Return the walk of a quantity on the grid of frames, its pieces, and the lag in frames."""
    if quantity not in ("rotation", "translation"):
        raise ValueError(f'quantity: expected "rotation" or "translation", got {quantity!r}')
    walk = motion.accumulated_rotation() if quantity == "rotation" else motion.center
    grid, piece = on_grid(motion, walk)
    steps = round(lag / motion.dt)
    if abs(steps * motion.dt - lag) > 1e-3 * motion.dt or not 1 <= steps < len(grid):
        raise ValueError(
            f"lag: expected a multiple of dt = {motion.dt:g} s up to "
            f"{(len(grid) - 1) * motion.dt:g} s, got {lag!r}"
        )
    return grid, piece, steps


def _bin_edges(bins: int | ArrayLike, *, reach: float) -> Floats:
    """Return the edges asked for, or so many equal bins out to `reach` on both sides."""
    if np.ndim(bins) == 0:
        count = int(np.asarray(bins))
        if count < 1:
            raise ValueError(f"bins: expected at least 1, got {bins!r}")
        return np.linspace(-reach, reach, count + 1)
    edges = np.array(bins, dtype=np.float64)
    if edges.ndim != 1 or edges.size < 2 or not np.all(np.diff(edges) > 0):
        raise ValueError("bins: expected a number, or rising edges, at least two of them")
    return edges


def _shared(walk: Floats, piece: Ints, steps: int, *, pairs: int) -> Floats:
    """Return for k = 1.._ORDERS the mean over all pairs of displacements of correlation^k.

    It is the variance of the mean of the kth normalised Hermite polynomial of one component, if
    the motion is Gaussian.
    """
    curve = _curve(walk[:, None], piece, dt=1.0, quantity="rotation", dof=1)
    d, s = _first_look(curve.value / 2, curve.n_pairs)
    apart = np.arange(steps + 1.0)
    correlation = d * (steps - apart)
    correlation[0] += s
    correlation[-1] -= s / 2
    correlation /= d * steps + s
    count = np.maximum(1 - apart / pairs, 0) * np.where(apart > 0, 2, 1) / pairs
    return np.array([count @ correlation**k for k in range(1, _ORDERS + 1)])


def _gaussian_bins(z: Floats, shared: Floats) -> tuple[Floats, Floats]:
    """Return what part of a unit Gaussian lies in each bin, and the error of counting it.

    The variance of a count is the sum of its squared Hermite coefficients, each over how often
    that order was seen independently (Mehler); the orders left out count as the last one.
    """
    below = np.array([erf(edge / np.sqrt(2)) for edge in z]) / 2
    part = np.diff(below)
    last, this = np.zeros_like(z), np.exp(-z * z / 2) / np.sqrt(2 * np.pi)
    variance, rest = np.zeros_like(part), part * (1 - part)
    for k, times in enumerate(shared, start=1):
        coefficient = np.diff(this) ** 2 / k
        variance, rest = variance + coefficient * times, rest - coefficient
        last, this = this, (z * this - np.sqrt(k - 1) * last) / np.sqrt(k)
    return part, np.sqrt(variance + np.maximum(rest, 0.0) * shared[-1])


def _unit_vectors(vectors: ArrayLike) -> Floats:
    """Return axes in space as unit vectors (K, 3)."""
    v = np.atleast_2d(np.asarray(vectors, dtype=np.float64))
    length = np.linalg.norm(v, axis=-1, keepdims=True)
    if v.ndim != 2 or v.shape[1] != 3 or not np.all((length > 0) & (length < np.inf)):
        raise ValueError(f"axes: expected (3,) or (K, 3), none zero, got {vectors!r}")
    return np.asarray(v / length)


def _principal_axes(motion: RigidMotion) -> Floats:
    """Return the principal axes of the particles' gyration tensor as rows, the longest first."""
    return np.asarray(np.linalg.eigh(motion.template.T @ motion.template)[1].T[::-1])


def _directions(motion: RigidMotion, directions: ArrayLike | None) -> Floats:
    """Return the directions asked for as (K, d), or those of the particles."""
    if directions is not None:
        return np.atleast_2d(np.asarray(directions, dtype=np.float64))
    length = np.linalg.norm(motion.template, axis=1)
    # A particle at the centre has no direction.
    return np.asarray(motion.template[length > 1e-6 * length.max()])


def on_grid(motion: RigidMotion, walks: Floats) -> tuple[Floats, Ints]:
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


def _undrifted(walks: Floats, piece: Ints, *, dt: float, quantity: str, dof: int) -> LagCurve:
    """Average walks as `_curve` does, without their mean velocity."""
    velocity, lengths = _mean_step(walks, piece)
    still = walks - np.arange(len(walks))[:, None, None] * velocity
    curve = _curve(still, piece, dt=dt, quantity=quantity, dof=dof)
    restored = _restored(curve.components, curve.n_pairs, lengths)
    value = restored.sum(axis=1)
    ratio = np.divide(value, curve.value, out=np.ones_like(value), where=curve.value > 0)
    return replace(
        curve,
        value=value,
        components=restored,
        stderr=curve.stderr * ratio,
        drift=tuple(float(v) for v in velocity / dt),
    )


def _mean_step(walks: Floats, piece: Ints) -> tuple[Floats, Ints]:
    """Return the mean step from first to last frames of every stretch, and the stretches' lengths.

    For a Brownian walk no other estimate of the velocity has a smaller error.
    """
    total, lengths = np.zeros(walks.shape[2]), []
    here = present(walks)
    for label in np.unique(piece):
        for k in range(walks.shape[1]):
            rows = np.flatnonzero(here[:, k] & (piece == label))
            if rows.size > 1:
                total += walks[rows[-1], k] - walks[rows[0], k]
                lengths.append(rows[-1] - rows[0])
    if not lengths:
        raise TooFewFramesError("no two frames in one piece: a velocity needs two", 0)
    return total / sum(lengths), np.sort(lengths)


def _restored(components: Floats, pairs: Ints, lengths: Ints) -> Floats:
    """Give back what a mean step takes of the MSD of noisy Brownian walks, (L, c).

    A mean step from first to last frames, T steps in all stretches together, leaves
    2 D n (1 - n/T) + o g(n) of 2 D n + o at lag n. In g the noise of the stretches' ends counts
    twice, with the displacements that begin or end there and with itself.
    """
    n, total = np.arange(1.0, len(pairs) + 1), float(lengths.sum())
    long_enough = len(lengths) - np.searchsorted(lengths, n)
    seen = np.maximum(pairs, 1)
    g = 1 - 2 * n * long_enough / (total * seen) + n * n * len(lengths) / total**2
    left = 1 - n / total
    # The whole of one stretch is drift, nothing of its displacement is left.
    good = np.flatnonzero((pairs > 0) & (left > 0.5 / total))
    restored = np.full_like(components, np.nan)
    if good.size > 1:
        first, second = good[:2]
        lines = np.array([[n[i] * left[i], g[i]] for i in (first, second)])
        offset = np.linalg.solve(lines, components[[first, second]])[1]
        taken = components[good] - offset * g[good, None]
        restored[good] = taken / left[good, None] + offset
    return restored


def _quadrupole(p: Floats) -> Floats:
    """Return the five components of directions' squares whose product is P_2 of the cosine."""
    x, y, z = np.moveaxis(p, -1, 0)
    root = np.sqrt(3.0)
    five = [root * x * y, root * y * z, root * z * x, root / 2 * (x * x - y * y), 1.5 * z * z - 0.5]
    return np.stack(five, axis=-1)


def _mean_products(walks: Floats, piece: Ints) -> tuple[Floats, Ints]:
    """Return the mean dot product of walks (T, K, c) with themselves a lag apart, and the pairs."""
    length, K = walks.shape[:2]
    size = fast_size(2 * length)
    sums, pairs = np.zeros(size // 2 + 1), np.zeros(size // 2 + 1)
    here = present(walks)
    for label in np.unique(piece):
        inside = here & (piece == label)[:, None]
        x = np.where(inside[..., None], walks, 0.0).reshape(length, -1)
        sums += sum(np.abs(np.fft.rfft(column, size)) ** 2 for column in x.T)
        pairs += np.abs(np.fft.rfft(inside[:, 0].astype(np.float64), size)) ** 2
    total, count = (np.fft.irfft(a, size)[1:length] for a in (sums, pairs))
    frames = np.rint(count).astype(np.int64)
    if not frames.any():
        raise TooFewFramesError("no two frames in one piece: a correlation needs two", 0)
    mean = np.full(length - 1, np.nan)
    np.divide(total, K * frames, out=mean, where=frames > 0)
    # A mean of cosines that rounds above one is one.
    return np.minimum(mean, 1.0), frames


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
    size = fast_size(2 * length)
    m = np.fft.rfft(mask, size, axis=0)[..., None]
    f, g = np.fft.rfft(x, size, axis=0), np.fft.rfft(x * x, size, axis=0)
    spectrum = 2 * np.real(np.conj(m) * g) - 2 * np.abs(f) ** 2
    sums = np.fft.irfft(spectrum.sum(1), size, axis=0)[1:length]
    counts = np.fft.irfft((np.abs(m) ** 2).sum((1, 2)), size)[1:length]
    # A sum of squares that rounds below zero is zero.
    return np.maximum(sums, 0.0), np.rint(counts).astype(np.int64)


def fast_size(least: int) -> int:
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


def overlap_sums(
    lag: Floats, steps: int, *, seen: Floats, D: float, s: float
) -> tuple[Floats, Floats, Floats]:
    """Return what the covariance of an MSD at two lags is made of, as polynomials of the shorter.

    One-dimensional displacements over a and b >= a frames of which j are shared have covariance
    2 D j, + s for a common first or last frame, - s where one ends at the other's beginning. The
    covariance of their mean squares is 2 S(a, b) over the displacements of a track without gaps,
    steps + 1 - a and steps + 1 - b. S sums the squared covariances over all pairs of displacements;
    where frames are missing at random, those that share one or both frames weigh more, since they
    are missing together.

    Parameters
    ----------
    lag : ndarray, shape (L,)
        The longer lags b, frames.
    steps : int
        Of the track.
    seen : ndarray, shape (L,)
        The part of the frames that is there, from 0 to 1: the root of that of the displacements.
    D, s : float
        Diffusion coefficient times dt, and variance of one coordinate from noise.

    Returns
    -------
    near, far : ndarray, shape (5, L)
        Coefficients of a^0 .. a^4 in S(a, b), for a <= steps + 1 - b and from there on.
    itself : ndarray, shape (L,)
        What comes on top where a = b.
    """
    b, p = lag, steps + 1 - lag
    gap, zero = 1 / seen - 1, np.zeros_like(lag)
    squares, noise, cross = 4 * D * D, 2 * s * s, 8 * D * s * p * (1 + gap)
    near = squares * np.stack([zero, p / 3, p * b + 1 / 6, -p / 3, zero - 1 / 6])
    near[:2] += 2 * noise * p * (1 + gap), cross - noise * (1 + gap)
    once, twice = p * (p - 1) / 2, p * (p * p - 1) / 3
    far = squares * np.stack([p * twice / 2, -2 * twice, p * (b + 1) + 2 * once, -p, zero])
    far[:2] += noise * p * (1 + gap), cross
    for polynomial in (near, far):
        polynomial[2] += 2 * squares * p * gap
    same = (gap * gap + 2 * gap) * (2 * D * b + 2 * s) ** 2 - 2 * gap * (2 * D * b + s) ** 2
    return near, far, p * (noise + same)


def _relative_error(half: Floats, pairs: Floats) -> Floats:
    """Return the relative standard error of a one-dimensional MSD at every lag.

    `half` is the MSD over 2, that is D t + s; D dt and s come from the first two lags.
    """
    steps = len(half)
    n = np.arange(1, steps + 1, dtype=np.float64)
    whole = steps + 1 - n
    d, s = _first_look(half, pairs)
    seen = np.sqrt(np.where(pairs > 0, pairs, whole) / whole)
    near, far, itself = overlap_sums(n, steps, seen=seen, D=d, s=s)
    total = np.where(n <= whole, *(polyval(n, c, tensor=False) for c in (near, far))) + itself
    mean = 2 * (d * n + s)
    relative = np.full_like(half, np.nan)
    np.divide(np.sqrt(2 * total) / whole, mean, out=relative, where=(pairs > 0) & (mean > 0))
    return relative


def _first_look(half: Floats, pairs: Floats | Ints) -> tuple[float, float]:
    """Return D dt and s of half an MSD, D t + s, from its first two lags; neither is negative."""
    good = np.flatnonzero(pairs > 0)
    first, second = (good[0], good[1]) if good.size > 1 else (good[0], good[0])
    rise = (half[second] - half[first]) / max(second - first, 1)
    d = min(max(rise, 0.0), half[first] / (first + 1))
    return float(d), float(half[first] - d * (first + 1))
