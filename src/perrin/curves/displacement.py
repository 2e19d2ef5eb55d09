"""Mean square displacements, angles, correlations and distributions against lag time."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from perrin._arrays import Bools, Floats, Ints, as_positions, frozen, present, require_positive
from perrin.curves.pairs import (
    NEAR,
    Frames,
    PairSums,
    Squares,
    pair_sums,
    place_frames,
    relative_error,
)
from perrin.errors import TooFewFramesError
from perrin.motion.rigid_motion import RigidMotion, threshold_displacement

if TYPE_CHECKING:
    import pandas as pd


# Directions that weigh the axes this evenly cannot move a slope by more than this part.
_EVEN_WEIGHTS = 0.01


@dataclass(frozen=True, eq=False)
class LagCurve:
    """A mean square displacement, or angle, against lag time: value = 2 dof D t + offset.

    The lags are multiples of the step between frames. Where frames lie on no compact grid of times
    (uneven times, long holes) they are the lags that have pairs.

    Attributes
    ----------
    lagtime : ndarray, shape (L,)
        Mean time between the frames of the pairs, s.
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
        MSAD of one direction, 3 for that of all directions of a cluster; fewer where the body turns
        faster about one axis than about the others.
    drift : tuple of float or None
        Mean velocity that was taken off, um/s by axis.
    noise : float
        Noise variance of one orientation (rad^2) or centre coordinate (um^2) that the rigid-fit
        residuals predict; NaN where there are none (free particles).
    resolution_floor : float or None
        The D_R that a motionless cluster would read (rad^2/s); None for translation.
    step : float or None
        Step of the grid of times, s; None for the first lag time.
    blocks : tuple of int
        Steps from first to last frame of each stretch of frames on a grid; empty for one stretch
        with a step per lag.
    weights : ndarray, shape (3, 3), or None
        What each element of the rotational tensor counts, body axes: the slope is 2 tr(D W). The
        trace is dof. None for translation, and in the plane.
    ratio : tuple of float or None
        tr(D W)/dof over the mean of D about all axes, as the motion's steps show it, and its
        standard error; None where all axes count alike.
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
    step: float | None = None
    blocks: tuple[int, ...] = ()
    weights: Floats | None = None
    ratio: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        frozen(self.lagtime, self.value, self.components, self.stderr, self.n_pairs)
        if self.weights is not None:
            frozen(self.weights)

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
    motion_or_positions: RigidMotion | ArrayLike,
    *,
    dt: float | None = None,
    drift: bool | ArrayLike | None = None,
) -> LagCurve:
    """Return the mean square displacement over all lag times (Hunter 2011, Eq. 24: 6 D_T t).

    Parameters
    ----------
    motion_or_positions : RigidMotion or array_like, shape (T, n, d)
        A motion (its centre is used), or the positions of free particles, um, NaN where missing.
    dt : float, optional
        Time between frames, s; for positions only, where it is required.
    drift : array_like, shape (d,), or bool, optional
        A known velocity, um/s, that is taken off: the curve and its errors are those of the walk
        without it. True: the mean velocity, the same in all pieces and for all particles (flow,
        stage drift, sedimentation), is estimated and taken off. What an estimated velocity takes of
        the Brownian motion along with it, t/T of the MSD in a run of length T, is given back; of
        the longest lag of a single track nothing is left, and it is NaN. ``stderr`` is then within
        20 % up to half of the run, too small near its end. Either is reported in
        ``LagCurve.drift``.

    Returns
    -------
    LagCurve
        um^2; dof = d.

    Raises
    ------
    ValueError
        If dt is missing or superfluous, or a velocity is not d finite numbers.
    TooFewFramesError
        If no two frames are there.

    Warns
    -----
    PrecisionWarning
        If frames lie on no compact grid of times and are so many that not all pairs are formed.

    Examples
    --------
    >>> import numpy as np
    >>> steady = np.arange(5.0)[:, None, None] * [[1.0, 0.0, 0.0]]
    >>> msd(steady, dt=0.5).value
    array([ 1.,  4.,  9., 16.])
    >>> msd(steady, dt=0.5, drift=True).drift
    (2.0, 0.0, 0.0)
    >>> msd(steady, dt=0.5, drift=[2.0, 0.0, 0.0]).value
    array([0., 0., 0., 0.])
    """
    if isinstance(motion_or_positions, RigidMotion):
        if dt is not None:
            raise ValueError("dt: a RigidMotion knows its own; leave dt out")
        motion, dt = motion_or_positions, motion_or_positions.dt
        walks, time, piece = motion.center[:, None], motion.time, motion.piece
    elif dt is None:
        raise ValueError("dt: the time between frames (s) is needed with positions")
    else:
        require_positive(dt=dt)
        walks = as_positions(motion_or_positions)
        time = dt * np.arange(len(walks), dtype=np.float64)
        piece = np.zeros(len(walks), dtype=np.int64)
    dof = walks.shape[2]
    noise = np.nan
    if isinstance(motion_or_positions, RigidMotion):
        noise = motion_or_positions.center_noise
    if drift is None or isinstance(drift, (bool, np.bool_)):
        make = _undrifted if drift else _curve
        made = make(walks, time, piece, dt=dt, quantity="translation", dof=dof)
        return replace(made, noise=noise)
    velocity = np.asarray(drift, dtype=np.float64)
    if velocity.shape != (dof,) or not np.isfinite(velocity).all():
        raise ValueError(
            f"drift: expected True, False or a velocity of {dof} numbers (um/s), got {drift!r}"
        )
    still = walks - (time - time[0])[:, None, None] * velocity
    curve = _curve(still, time, piece, dt=dt, quantity="translation", dof=dof)
    return replace(curve, drift=tuple(float(v) for v in velocity), noise=noise)


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
        If a direction is zero.

    Warns
    -----
    PrecisionWarning
        As `msd`.

    Notes
    -----
    A direction p does not feel the rotation about itself: its MSAD grows as 2 (tr D - p.D p) t for
    a rotational tensor D, and the mean over directions as 2 tr(D W) t with W = 1 - <p p^T>, which
    is 4 D_R t (D_R a third of the trace) where the body is isotropic or the directions weigh all
    axes alike. W is in ``LagCurve.weights``.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.0), D_R=1e-3, dt=1.0, n_frames=20000, rng=0)
    >>> round(float(msad(truth).value[9]) / (4 * 1e-3 * 10), 1)
    1.0
    """
    p = _directions(motion, directions)
    phi = motion.rotational_displacement(p)
    if phi.shape[2] == 1:
        return _turned(motion, phi, dof=1, independent=1.0)
    weights = direction_weights(p)
    walks = _independent_walks(motion, weights)
    ratio = _axis_ratio(motion, weights)
    return _turned(motion, phi, dof=2, independent=walks, weights=weights, ratio=ratio)


def direction_weights(directions: Floats) -> Floats:
    """Return W = 1 - <p p^T> (3, 3) of directions (K, 3), whose mean MSAD is 2 tr(D W) t.

    Examples
    --------
    >>> import numpy as np
    >>> direction_weights(np.eye(3)[:1]).diagonal()
    array([0., 1., 1.])
    """
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return np.asarray(np.eye(3) - unit.T @ unit / len(unit))


def weighs_alike(weights: Floats) -> bool:
    """Return whether weights (3, 3) of the rotational tensor are those of all axes, to a hundredth.

    Examples
    --------
    >>> import numpy as np
    >>> weighs_alike(2 / 3 * np.eye(3)), weighs_alike(np.diag([1.0, 0.5, 0.5]))
    (True, False)
    """
    uneven = 3 / np.trace(weights) * weights - np.eye(3)
    return bool(np.abs(np.linalg.eigvalsh(uneven)).max() < _EVEN_WEIGHTS)


def _independent_walks(motion: RigidMotion, weights: Floats) -> float:
    """Return n = (tr WS)^2 / tr WSWS, of how many equal walks a mean square w.W w has the error.

    S is the covariance of a step's rotation vector w, free of what its own error adds to the
    square; where the particles lie alike about all axes, the body is taken as isotropic.
    """
    stop = motion.steps()[1]
    if weighs_alike(direction_weights(_directions(motion, None))) or len(stop) < 2:
        return float(np.trace(weights) ** 2 / np.sum(weights * weights))
    w = motion.step_vectors()[stop - 1]
    count, product = len(w), weights @ (w.T @ w)
    total = np.trace(product) ** 2
    square = (count * np.sum(product * product.T) - total) / (count + 1)
    return float(np.clip(total / square, 1.0, 3.0)) if square > 0 else 3.0


def _axis_ratio(motion: RigidMotion, weights: Floats) -> tuple[float, float] | None:
    """Return tr(D W)/tr W over tr(D)/3 and its standard error; None where W weighs axes evenly.

    Mean products of steps (a) and of neighbouring steps (b), which take the noise off, stand for
    D. The error is that of a quadratic form in Gaussian steps with these covariances: in the mode
    of phase f the form is 1 + c cos f, c twice the steps per neighbouring pair, and the covariance
    a + 2 b cos f.
    """
    if weighs_alike(weights):
        return None
    start, stop = motion.steps()
    w = motion.step_vectors()[stop - 1]
    linked = start[1:] == stop[:-1]
    if linked.sum() < 2:
        return 1.0, np.inf
    own = w.T @ w / len(w)
    beside = w[:-1][linked].T @ w[1:][linked] / linked.sum()
    beside = 0.5 * (beside + beside.T)
    tensor = own + 2 * beside
    if not np.trace(tensor) > 0:
        return 1.0, np.inf
    uneven = 3 / np.trace(weights) * weights - np.eye(3)
    more = float(np.sum(tensor * uneven) / np.trace(tensor))
    cosine = np.cos(2 * np.pi * (np.arange(64) + 0.5) / 64)
    form = 1 + 2 * len(w) / linked.sum() * cosine
    both = (uneven - more * np.eye(3)) @ (own + 2 * linked.mean() * cosine[:, None, None] * beside)
    variance = 2 * np.mean(form**2 * np.einsum("kij,kji->k", both, both)) / len(w)
    return 1 + more, float(np.sqrt(max(variance, 0.0)) / np.trace(tensor))


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
        For a threshold out of range.

    Warns
    -----
    PrecisionWarning
        As `msd`.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.0), D_R=1e-3, dt=1.0, n_frames=20000, rng=0)
    >>> round(float(msad_vector(truth).value[9]) / (6 * 1e-3 * 10), 1)
    1.0
    """
    walk = threshold_displacement(motion, threshold=threshold)[:, None]
    dof = walk.shape[2]
    if dof == 1:
        return _turned(motion, walk, dof=1, independent=1.0)
    walks = _independent_walks(motion, np.eye(3))
    curve = _turned(motion, walk, dof=3, independent=walks, weights=np.eye(3))
    # What returns within the threshold adds up to nothing.
    return replace(curve, resolution_floor=None) if threshold > 0 else curve


def msad_axes(motion: RigidMotion, *, axes: ArrayLike | None = None) -> tuple[LagCurve, ...]:
    """Return the mean square angle turned about single axes of the body, one curve per axis.

    The body-frame rotation vectors of all steps are added up component by component: 2 D t with
    the D of that axis, however the body has turned meanwhile.

    Parameters
    ----------
    motion : RigidMotion
    axes : array_like, shape (3,) or (K, 3), optional
        Body-fixed axes at the first fitted frame. Default: the principal axes of the particles'
        gyration tensor, the shortest first: that about which the body turns slowest, as the axes of
        a `DiffusionTensor` are ordered. In the plane the one there is.

    Returns
    -------
    tuple of LagCurve
        rad^2; dof = 1 each.

    Raises
    ------
    ValueError
        If an axis is zero, or axes are given in the plane.

    Warns
    -----
    PrecisionWarning
        As `msd`.

    Examples
    --------
    >>> from perrin import Cluster, fit_line, simulate_motion
    >>> rod = Cluster.from_positions([[-3, 0, 0], [0, 0.5, 0], [0, 0, 0.5], [3, 0, 0]])
    >>> truth = simulate_motion(rod, D_R=[5e-3, 1e-3, 1e-3], dt=1.0, n_frames=20000, rng=0)
    >>> *across, along = msad_axes(truth)
    >>> print(fit_line(along))
    D_R = 0.00501(9) rad^2/s [line, 20000 frames]
    """
    walk = motion.accumulated_rotation(axes="body")[:, None]
    if walk.shape[2] == 1:
        if axes is not None:
            raise ValueError("axes: a motion in the plane turns about one axis only")
        return (_turned(motion, walk, dof=1, independent=1.0),)
    unit = _principal_axes(motion) if axes is None else _unit_vectors(axes)
    return tuple(
        _turned(motion, walk @ a[:, None], dof=1, independent=1.0, weights=np.outer(a, a))
        for a in unit
    )


def _walk(motion: RigidMotion, *, lag: float, quantity: str) -> Floats:
    """Return the walk (T, c) of a quantity; refuse a lag that is no whole number of frames."""
    if quantity not in ("rotation", "translation"):
        raise ValueError(f'quantity: expected "rotation" or "translation", got {quantity!r}')
    steps, span = round(lag / motion.dt), motion.time[-1] - motion.time[0]
    if abs(steps * motion.dt - lag) > 1e-3 * motion.dt or not 1 <= steps <= span / motion.dt + NEAR:
        raise ValueError(
            f"lag: expected a multiple of dt = {motion.dt:g} s up to {span:g} s, got {lag!r}"
        )
    return motion.accumulated_rotation() if quantity == "rotation" else motion.center


def _pairs_apart(motion: RigidMotion, lag: float) -> tuple[Ints, Ints]:
    """Return first and last rows of the pairs with a pose and in one piece that lag apart."""
    rows = motion.fitted
    time = motion.time[rows]
    low, high = (time + lag + sign * NEAR * motion.dt for sign in (-1, 1))
    partner = np.searchsorted(time, low)
    there = np.flatnonzero(partner < np.searchsorted(time, high, side="right"))
    first, last = rows[there], rows[partner[there]]
    same = motion.piece[first] == motion.piece[last]
    return first[same], last[same]


def _unit_vectors(vectors: ArrayLike) -> Floats:
    """Return axes in space as unit vectors (K, 3)."""
    v = np.atleast_2d(np.asarray(vectors, dtype=np.float64))
    length = np.linalg.norm(v, axis=-1, keepdims=True)
    if v.ndim != 2 or v.shape[1] != 3 or not np.all((length > 0) & (length < np.inf)):
        raise ValueError(f"axes: expected (3,) or (K, 3), none zero, got {vectors!r}")
    return np.asarray(v / length)


def _principal_axes(motion: RigidMotion) -> Floats:
    """Return the principal axes of the particles' gyration tensor as rows, the shortest first."""
    return np.asarray(np.linalg.eigh(motion.template.T @ motion.template)[1].T)


def _directions(motion: RigidMotion, directions: ArrayLike | None) -> Floats:
    """Return the directions asked for as (K, d), or those of the particles."""
    if directions is not None:
        return np.atleast_2d(np.asarray(directions, dtype=np.float64))
    length = np.linalg.norm(motion.template, axis=1)
    # A particle at the centre has no direction.
    return np.asarray(motion.template[length > 1e-6 * length.max()])


def _frames(time: Floats, piece: Ints, here: Bools, *, dt: float) -> Frames:
    """Return the frames that are there on their grids of times; refuse fewer than two."""
    if here.sum() < 2:
        raise TooFewFramesError("no two frames in one piece: a pair needs two", int(here.sum()))
    return place_frames(time, piece, here, dt=dt)


def _require_pairs(sums: PairSums) -> None:
    if not sums.pairs.any():
        raise TooFewFramesError("no two frames in one piece: a pair needs two", 0)


def _mean(sums: PairSums) -> Floats:
    """Return sums over pairs; NaN where there are none."""
    average = np.full_like(sums.sums, np.nan)
    pairs = sums.pairs[:, None]
    np.divide(sums.sums, pairs, out=average, where=pairs > 0)
    return average


def _turned(
    motion: RigidMotion,
    walks: Floats,
    *,
    dof: int,
    independent: float | None = None,
    weights: Floats | None = None,
    ratio: tuple[float, float] | None = None,
) -> LagCurve:
    """Return the curve of angles (T, K, c) of a motion."""
    curve = _curve(
        walks,
        motion.time,
        motion.piece,
        dt=motion.dt,
        quantity="rotation",
        dof=dof,
        independent=independent,
    )
    noise = motion.orientation_noise
    # In a component that weighs the axes by W the noise counts with the same weights.
    weighed = (
        np.trace(noise @ weights) / dof if weights is not None else np.trace(noise) / len(noise)
    )
    return replace(
        curve,
        weights=weights,
        ratio=ratio,
        noise=float(weighed),
        resolution_floor=motion.resolution_floor,
    )


def _curve(
    walks: Floats,
    time: Floats,
    piece: Ints,
    *,
    dt: float,
    quantity: str,
    dof: int,
    independent: float | None = None,
) -> LagCurve:
    """Average walks (T, K, c) over time, pieces and the K walkers."""
    here = np.asarray(present(walks).any(axis=1))
    frames = _frames(time, piece, here, dt=dt)
    sums = pair_sums(Squares(walks), frames)
    _require_pairs(sums)
    average = _mean(sums)
    value = average.sum(axis=1)
    # Free particles are independent walkers; the directions of one body are not.
    walkers = walks.shape[1] if independent is None else 1
    n_walks = float(walks.shape[2] * walkers) if independent is None else independent
    shared = sums.pairs / walks.shape[1]
    relative = relative_error(sums, frames, value / (2 * dof), shared)
    return LagCurve(
        lagtime=sums.lagtime,
        value=value,
        components=average,
        stderr=value * relative / np.sqrt(n_walks),
        n_pairs=sums.pairs if independent is None else np.rint(shared).astype(np.int64),
        dof=dof,
        quantity=quantity,
        unit="rad^2" if quantity == "rotation" else "um^2",
        n_walks=n_walks,
        step=frames.step,
        blocks=tuple(int(n) for n in frames.lengths),
    )


def _undrifted(
    walks: Floats, time: Floats, piece: Ints, *, dt: float, quantity: str, dof: int
) -> LagCurve:
    """Average walks as `_curve` does, without their mean velocity."""
    velocity, durations = _mean_velocity(walks, time, piece)
    still = walks - (time - time[0])[:, None, None] * velocity
    curve = _curve(still, time, piece, dt=dt, quantity=quantity, dof=dof)
    restored = _restored(
        curve.components, curve.n_pairs, lagtime=curve.lagtime, durations=durations
    )
    value = restored.sum(axis=1)
    ratio = np.divide(value, curve.value, out=np.ones_like(value), where=curve.value > 0)
    return replace(
        curve,
        value=value,
        components=restored,
        stderr=curve.stderr * ratio,
        drift=tuple(float(v) for v in velocity),
    )


def _mean_velocity(walks: Floats, time: Floats, piece: Ints) -> tuple[Floats, Floats]:
    """Return the mean velocity from first to last frames of every stretch, and their durations.

    For a Brownian walk no other estimate of the velocity has a smaller error.
    """
    total, durations = np.zeros(walks.shape[2]), []
    here = present(walks)
    for label in np.unique(piece):
        for k in range(walks.shape[1]):
            rows = np.flatnonzero(here[:, k] & (piece == label))
            if rows.size > 1:
                total += walks[rows[-1], k] - walks[rows[0], k]
                durations.append(time[rows[-1]] - time[rows[0]])
    if not durations:
        raise TooFewFramesError("no two frames in one piece: a velocity needs two", 0)
    return total / sum(durations), np.sort(durations)


def _restored(components: Floats, pairs: Ints, *, lagtime: Floats, durations: Floats) -> Floats:
    """Give back what a mean velocity takes of the MSD of noisy Brownian walks, (L, c).

    A mean velocity from first to last frames, T of time in all stretches together, leaves
    2 D t (1 - t/T) + o g(t) of 2 D t + o at lag t. In g the noise of the stretches' ends counts
    twice, with the displacements that begin or end there and with itself.
    """
    total = float(durations.sum())
    n = lagtime / total
    long_enough = len(durations) - np.searchsorted(durations, lagtime * (1 - 1e-9))
    seen = np.maximum(pairs, 1)
    g = 1 - 2 * n * long_enough / seen + n * n * len(durations)
    left = 1 - n
    # The whole of one stretch is drift, nothing of its displacement is left.
    good = np.flatnonzero((pairs > 0) & (left > 0.5 * n[0]))
    restored = np.full_like(components, np.nan)
    if good.size > 1:
        first, second = good[:2]
        lines = np.array([[n[i] * left[i], g[i]] for i in (first, second)])
        offset = np.linalg.solve(lines, components[[first, second]])[1]
        taken = components[good] - offset * g[good, None]
        restored[good] = taken / left[good, None] + offset
    return restored
