"""Mean square displacement (MSD) and mean square angular displacement (MSAD) against lag time."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from perrin._arrays import (
    Floats,
    Ints,
    as_positions,
    complete,
    from_plain,
    frozen,
    present,
    repeated,
    require_positive,
    to_plain,
)
from perrin._display import Shown
from perrin.curves.grids import complete_frames, place_frames
from perrin.curves.pairs import Squares, pair_sums
from perrin.curves.standard_errors import relative_error
from perrin.errors import TooFewFramesError
from perrin.motion.rigid_motion import RigidMotion, threshold_displacement

if TYPE_CHECKING:
    import pandas as pd

    from perrin.curves.grids import Frames

# Directions whose mean weighs the axes this evenly change a slope by at most this fraction.
_EVEN_WEIGHTS = 0.01


@dataclass(frozen=True, eq=False)
class LagCurve(Shown):
    """A mean square displacement, or angle, against lag time: value = 2 dof D t + offset.

    The lags are multiples of the step between frames. Where frames lie on no compact grid of times
    (uneven times, long holes) they are the lags that have pairs.

    Attributes
    ----------
    lagtime : ndarray, shape (L,)
        Mean time between the frames of the pairs, s.
    value : ndarray, shape (L,)
        Mean square (rad^2 or um^2) or correlation (dimensionless); NaN at a lag without a pair.
    components : ndarray, shape (L, c)
        Contribution of each lab axis to the value; the value is their sum.
    stderr : ndarray, shape (L,)
        Standard error of the value for Brownian motion with localisation noise. It accounts for
        overlapping pairs and for frames missing at random. Neighbouring lags are strongly
        correlated.
    n_pairs : ndarray of int, shape (L,)
        Number of pairs of frames at each lag (times particles, for free particles).
    dof : int
        Number of angles or coordinates that diffuse: 3 for an MSD in space, 2 for an MSAD (1 in the
        plane).
    quantity : {"rotation", "translation", "orientation", "non-Gaussian"}
        Kind of curve: an MSAD, an MSD, a correlation of orientations, or a non-Gaussian parameter.
    unit : str
        Unit of the value: "rad^2", "um^2" or "1".
    n_walks : float
        Number of independent one-dimensional walks that were averaged: 3 for the MSD of one centre,
        2 for the MSAD of one direction, 3 for that of all directions of a cluster; fewer where the
        body turns faster about one axis than about the others.
    drift : tuple of float or None
        Mean velocity that was subtracted, um/s by axis; None where none was.
    noise : float
        Noise variance of one orientation (rad^2) or centre coordinate (um^2) that the rigid-fit
        residuals predict; NaN where there are none (free particles).
    resolution_floor : float or None
        Rotational diffusion coefficient that would be measured for a motionless cluster, rad^2/s;
        None for translation.
    step : float or None
        Step of the grid of times, s; None where it is the first lag time.
    blocks : tuple of int
        Steps from first to last frame of each stretch of frames on a grid; empty for one stretch
        with a step per lag.
    weights : ndarray, shape (3, 3), or None
        Weight W of each element of the rotational diffusion tensor D in body axes: the slope is
        2 tr(D W), and the trace of W is dof. None for translation, and in the plane.
    ratio : tuple of float or None
        tr(D W)/dof over the mean of D about all axes, estimated from the motion's steps, and its
        standard error; None where all axes have the same weight.
    directions : ndarray, shape (K, 3), or None
        Body-fixed unit vectors whose correlations were averaged; None for other curves.
    brownian : ndarray, shape (L,), or None
        Value that Brownian motion with the same mean square would have; only for a non-Gaussian
        parameter.
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
    directions: Floats | None = None
    brownian: Floats | None = None

    def __post_init__(self) -> None:
        frozen(self.lagtime, self.value, self.components, self.stderr, self.n_pairs)
        optional = (self.weights, self.directions, self.brownian)
        frozen(*(array for array in optional if array is not None))

    def __repr__(self) -> str:
        names = {"rotation": "MSAD", "translation": "MSD", "orientation": "correlation"}
        name = names.get(self.quantity, "non-Gaussian parameter")
        return f"LagCurve({name}, {len(self.lagtime)} lags, dof={self.dof}, {self.unit})"

    def to_frame(self) -> pd.DataFrame:
        """Return a table with a row per lag; lab components where there are several."""
        import pandas as pd

        axes = "xyz" if self.components.shape[1] == 3 else "xy"
        columns: dict[str, object] = {"lagtime": self.lagtime, "value": self.value}
        if self.components.shape[1] > 1:
            columns |= {f"value_{a}": self.components[:, i] for i, a in enumerate(axes)}
        columns |= {"stderr": self.stderr, "n_pairs": self.n_pairs}
        if self.brownian is not None:
            columns["brownian"] = self.brownian
        return pd.DataFrame(columns)

    def to_dict(self) -> dict[str, Any]:
        """Return the curve for JSON: lists for arrays, None for values that are not finite.

        Returns
        -------
        dict
            An entry per attribute.

        Examples
        --------
        >>> entry = msd(np.zeros((3, 1, 2)), dt=0.5).to_dict()
        >>> entry["lagtime"], entry["n_pairs"], entry["noise"]
        ([0.5, 1.0], [2, 1], None)
        """
        return {field.name: to_plain(getattr(self, field.name)) for field in fields(self)}

    @classmethod
    def from_dict(cls, entry: dict[str, Any]) -> LagCurve:
        """Return the curve that `to_dict` wrote.

        Parameters
        ----------
        entry : dict
            As `to_dict` returns it, also after a round trip through JSON.

        Returns
        -------
        LagCurve

        Examples
        --------
        >>> LagCurve.from_dict(msd(np.zeros((3, 1, 2)), dt=0.5).to_dict())
        LagCurve(MSD, 2 lags, dof=2, um^2)
        """
        read = dict(entry)
        for name in ("lagtime", "value", "components", "stderr"):
            read[name] = from_plain(entry[name])
        read["n_pairs"] = from_plain(entry["n_pairs"], dtype=np.int64)
        read["noise"] = np.nan if entry["noise"] is None else entry["noise"]
        read["blocks"] = tuple(entry["blocks"])
        if entry["drift"] is not None:
            read["drift"] = tuple(entry["drift"])
        for name in ("weights", "directions", "brownian"):
            if entry.get(name) is not None:
                read[name] = from_plain(entry[name])
        if entry["ratio"] is not None:
            ratio, error = entry["ratio"]
            read["ratio"] = (ratio, np.inf if error is None else error)  # an unknown error is inf
        return cls(**read)


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
        A known velocity, um/s, that is subtracted: the curve and its errors are those of the walk
        without it. True: the mean velocity, the same in all pieces and for all particles (flow,
        stage drift, sedimentation), is estimated and subtracted. The part of the Brownian motion
        that an estimated velocity removes with it, t/T of the MSD in a run of length T, is
        corrected for; at the longest lag of a single track it is all of the MSD, which is NaN.
        ``stderr`` is then within 20 % up to half of the run, too small near its end. Either
        velocity is reported in ``LagCurve.drift``.

    Returns
    -------
    LagCurve
        The MSD in um^2; dof = d.

    Raises
    ------
    ValueError
        If dt is missing or superfluous, or a velocity is not d finite numbers.
    TooFewFramesError
        If no two frames of one piece are present.

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
    noise = np.nan
    if isinstance(motion_or_positions, RigidMotion):
        if dt is not None:
            raise ValueError("dt: a RigidMotion has its own; leave dt out")
        motion, dt = motion_or_positions, motion_or_positions.dt
        walks, time, piece = motion.center[:, None], motion.time, motion.piece
        noise = motion.center_noise
        frames = frames_of(walks, time, piece, dt=dt)
    elif dt is None:
        raise ValueError("dt: the time between frames (s) is needed with positions")
    else:
        require_positive(dt=dt)
        walks = as_positions(motion_or_positions)
        time = np.arange(len(walks), dtype=np.float64)
        time *= dt
        piece = repeated(np.zeros((), dtype=np.int64), len(walks))
        whole = len(walks) > 1 and complete(walks)
        frames = (complete_frames if whole else partial(frames_of, walks))(time, piece, dt=dt)
    dof = walks.shape[2]
    estimated = isinstance(drift, (bool, np.bool_)) and bool(drift)
    velocity = None
    if estimated:
        velocity, durations = mean_velocity(walks, time, piece)
    elif drift is not None and not isinstance(drift, (bool, np.bool_)):
        velocity = np.asarray(drift, dtype=np.float64)
        if velocity.shape != (dof,) or not np.isfinite(velocity).all():
            raise ValueError(
                f"drift: expected True, False or a velocity of {dof} numbers (um/s), got {drift!r}"
            )
    if velocity is not None:
        walks = walks - (time - time[0])[:, None, None] * velocity
    curve = mean_square_curve(walks, frames, quantity="translation", dof=dof, noise=noise)
    if velocity is None:
        return curve
    curve = replace(curve, drift=tuple(float(v) for v in velocity))
    if not estimated:
        return curve
    components = drift_corrected(
        curve.components, curve.n_pairs, lagtime=curve.lagtime, durations=durations
    )
    value = components.sum(axis=1)
    # At the lag of the whole track the value is unknown, and what is left of it is rounding.
    ratio = np.where(np.isnan(value), np.nan, 1.0)
    np.divide(value, curve.value, out=ratio, where=curve.value > 0)
    return replace(curve, value=value, components=components, stderr=curve.stderr * ratio)


def msad(motion: RigidMotion, *, directions: ArrayLike | None = None) -> LagCurve:
    """Return the mean square angular displacement of directions (Hunter 2011, Eqs. 19 and 20).

    Parameters
    ----------
    motion : RigidMotion
        Orientations against time.
    directions : array_like, shape (d,) or (K, d), optional
        Body-fixed directions at the first fitted frame; several are averaged. Default: those of
        the particles, as in the paper's Fig. 5.

    Returns
    -------
    LagCurve
        The MSAD in rad^2; dof = 2 (4 D_R t), in the plane 1 (2 D_R t).

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
    The rotation about a direction p does not move p: the MSAD of p grows as 2 (tr D - p.D p) t for
    a rotational tensor D, and the mean over directions as 2 tr(D W) t with W = 1 - <p p^T>, which
    is 4 D_R t (D_R a third of the trace) where the body is isotropic or the directions weigh all
    axes equally. W is in ``LagCurve.weights``.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.0), D_R=1e-3, dt=1.0, n_frames=20000, rng=0)
    >>> round(float(msad(truth).value[9]) / (4 * 1e-3 * 10), 1)
    1.0
    """
    p = body_directions(motion, directions)
    phi = motion.rotational_displacement(p)
    if phi.shape[2] == 1:
        return angle_curve(motion, phi, dof=1, n_walks=1.0)
    weights = direction_weights(p)
    curve = angle_curve(
        motion, phi, dof=2, n_walks=independent_walks(motion, weights), weights=weights
    )
    return replace(curve, ratio=axis_ratio(motion, weights))


def msad_vector(motion: RigidMotion, *, threshold: float = 0.0) -> LagCurve:
    """Return the mean square of the summed rotation vectors (Hunter 2011, appendix).

    Every step adds its angle times its axis. Unlike the direction of one vector, this sum contains
    all three rotations, so the curve is 6 D_R t, and 2/3 of it compares with `msad`.

    Parameters
    ----------
    motion : RigidMotion
        Orientations against time.
    threshold : float
        Angle in rad; above 0, the rotation is counted from a reference that is renewed only when it
        exceeds this, as in `threshold_displacement`: for motion in cages or hardly above the noise.

    Returns
    -------
    LagCurve
        The mean square in rad^2, by lab axes; dof = 3 (1 in the plane).

    Raises
    ------
    ValueError
        If the threshold is out of range.

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
    if walk.shape[2] == 1:
        return angle_curve(motion, walk, dof=1, n_walks=1.0)
    weights = np.eye(3)
    curve = angle_curve(
        motion, walk, dof=3, n_walks=independent_walks(motion, weights), weights=weights
    )
    # Rotations that return within the threshold sum to zero.
    return replace(curve, resolution_floor=None) if threshold > 0 else curve


def msad_axes(motion: RigidMotion, *, axes: ArrayLike | None = None) -> tuple[LagCurve, ...]:
    """Return the mean square angle turned about single axes of the body, one curve per axis.

    The body-frame rotation vectors of all steps are added up component by component: 2 D t with
    the D of that axis, however the body has turned meanwhile.

    Parameters
    ----------
    motion : RigidMotion
        Orientations against time.
    axes : array_like, shape (3,) or (K, 3), optional
        Body-fixed axes at the first fitted frame. Default: the principal axes of the particles'
        gyration tensor, the shortest first: that about which the body turns slowest, as the axes of
        a `DiffusionTensor` are ordered. In the plane the one there is.

    Returns
    -------
    tuple of LagCurve
        The mean squares in rad^2; dof = 1 each.

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
        return (angle_curve(motion, walk, dof=1, n_walks=1.0),)
    if axes is None:
        gyration = motion.template.T @ motion.template
        unit = np.asarray(np.linalg.eigh(gyration)[1].T)
    else:
        v = np.atleast_2d(np.asarray(axes, dtype=np.float64))
        length = np.linalg.norm(v, axis=-1, keepdims=True)
        if v.ndim != 2 or v.shape[1] != 3 or not np.all((length > 0) & (length < np.inf)):
            raise ValueError(f"axes: expected (3,) or (K, 3), none zero, got {axes!r}")
        unit = np.asarray(v / length)
    return tuple(
        angle_curve(motion, walk @ a[:, None], dof=1, n_walks=1.0, weights=np.outer(a, a))
        for a in unit
    )


def frames_of(walks: Floats, time: Floats, piece: Ints, *, dt: float) -> Frames:
    """Return the frames in which any of the walkers is present.

    Parameters
    ----------
    walks : ndarray, shape (T, K, c)
        Coordinates of K walkers, NaN where missing.
    time : ndarray, shape (T,)
        Time of each frame, s.
    piece : ndarray of int, shape (T,)
        Piece of each frame; no pair of frames joins two of them.
    dt : float
        Time between frames, s.

    Returns
    -------
    Frames

    Raises
    ------
    TooFewFramesError
        If there are fewer than two.

    Examples
    --------
    >>> walk = np.array([0.0, np.nan, 3.0])[:, None, None]
    >>> frames_of(walk, np.arange(3.0), np.zeros(3, dtype=int), dt=1.0).row
    array([0, 2])
    """
    seen = present(walks)
    here = seen[:, 0] if seen.shape[1] == 1 else np.asarray(seen.any(axis=1))
    return place_frames(time, piece, here, dt=dt)


def mean_square_curve(
    walks: Floats,
    frames: Frames,
    *,
    quantity: str,
    dof: int,
    n_walks: float | None = None,
    noise: float = np.nan,
) -> LagCurve:
    """Return the mean square differences of walks over time, pieces and walkers.

    Parameters
    ----------
    walks : ndarray, shape (T, K, c)
        Coordinates of K walkers, NaN where missing.
    frames : Frames
        Frames that form the pairs.
    quantity : {"rotation", "translation"}
        Kind of curve.
    dof : int
        Number of coordinates that diffuse.
    n_walks : float, optional
        Number of independent one-dimensional walks, for directions of one body. Default: free
        particles, K c walks, whose pairs are all counted.
    noise : float
        Noise variance of one coordinate that is known from elsewhere.

    Returns
    -------
    LagCurve

    Raises
    ------
    TooFewFramesError
        If no two frames are in one piece.

    Examples
    --------
    >>> walk, time = np.array([0.0, 1.0, 3.0])[:, None, None], np.arange(3.0)
    >>> frames = frames_of(walk, time, np.zeros(3, dtype=int), dt=1.0)
    >>> mean_square_curve(walk, frames, quantity="translation", dof=1).value
    array([2.5, 9. ])
    """
    sums = pair_sums(Squares(walks), frames)
    # The sums are not needed any more: the means take their place.
    components = sums.sums
    components /= sums.divisor[:, None]
    value = components.sum(axis=1)
    pairs = sums.number if walks.shape[1] == 1 else sums.number / walks.shape[1]
    stderr = relative_error(sums, frames, value, pairs)
    free = n_walks is None
    n_walks = float(walks.shape[2] * walks.shape[1]) if n_walks is None else n_walks
    stderr *= value
    stderr *= n_walks**-0.5
    return LagCurve(
        lagtime=sums.lagtime,
        value=value,
        components=components,
        stderr=stderr,
        n_pairs=sums.pairs if free else np.rint(pairs).astype(np.int64),
        dof=dof,
        quantity=quantity,
        unit="rad^2" if quantity == "rotation" else "um^2",
        n_walks=n_walks,
        noise=noise,
        step=frames.step,
        blocks=tuple(frames.lengths.tolist()),
    )


def angle_curve(
    motion: RigidMotion,
    angles: Floats,
    *,
    dof: int,
    n_walks: float | None = None,
    weights: Floats | None = None,
) -> LagCurve:
    """Return the mean square differences of angles of a motion, with its noise and resolution.

    Parameters
    ----------
    motion : RigidMotion
        Motion that the angles belong to.
    angles : ndarray, shape (T, K, c)
        Unbounded angles of K directions, rad, NaN where missing.
    dof : int
        Number of angles that diffuse.
    n_walks : float, optional
        Number of independent one-dimensional walks; default K c.
    weights : ndarray, shape (3, 3), optional
        Weights W of the rotational diffusion tensor; the noise has the same weights.

    Returns
    -------
    LagCurve

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.0), D_R=1e-3, dt=1.0, n_frames=50, rng=0)
    >>> angle_curve(truth, truth.accumulated_rotation()[:, None], dof=3)
    LagCurve(MSAD, 49 lags, dof=3, rad^2)
    """
    curve = mean_square_curve(
        angles,
        frames_of(angles, motion.time, motion.piece, dt=motion.dt),
        quantity="rotation",
        dof=dof,
        n_walks=n_walks,
    )
    noise = motion.orientation_noise
    weighted = (
        np.trace(noise @ weights) / dof if weights is not None else np.trace(noise) / len(noise)
    )
    return replace(
        curve,
        weights=weights,
        noise=float(weighted),
        resolution_floor=motion.resolution_floor,
    )


def body_directions(motion: RigidMotion, directions: ArrayLike | None = None) -> Floats:
    """Return directions as an array (K, d); by default those of the particles from the centre.

    Parameters
    ----------
    motion : RigidMotion
        Motion whose template has the particles.
    directions : array_like, shape (d,) or (K, d), optional
        Body-fixed directions.

    Returns
    -------
    ndarray, shape (K, d)
        Directions; a particle at the centre has none and is left out.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> still = simulate_motion(Cluster.tetrahedron(1.0), D_R=1e-3, dt=1.0, n_frames=2, rng=0)
    >>> body_directions(still).shape, body_directions(still, [0.0, 0.0, 1.0])
    ((4, 3), array([[0., 0., 1.]]))
    """
    if directions is not None:
        return np.atleast_2d(np.asarray(directions, dtype=np.float64))
    length = np.linalg.norm(motion.template, axis=1)
    return np.asarray(motion.template[length > 1e-6 * length.max()])


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


def axes_weighted_equally(weights: Floats) -> bool:
    """Return whether weights (3, 3) of the rotational tensor are equal for all axes, within 1 %.

    Examples
    --------
    >>> import numpy as np
    >>> axes_weighted_equally(2 / 3 * np.eye(3)), axes_weighted_equally(np.diag([1.0, 0.5, 0.5]))
    (True, False)
    """
    uneven = 3 / np.trace(weights) * weights - np.eye(3)
    return bool(np.abs(np.linalg.eigvalsh(uneven)).max() < _EVEN_WEIGHTS)


def independent_walks(motion: RigidMotion, weights: Floats) -> float:
    """Return n = (tr WS)^2 / tr WSWS: a mean square w.W w has the error of that of n equal walks.

    S is the covariance of a step's rotation vector w, corrected for the error of S in its square.
    Where the particles' directions weigh all axes equally, the body is assumed to be isotropic.

    Parameters
    ----------
    motion : RigidMotion
        Motion whose steps are used.
    weights : ndarray, shape (3, 3)
        Weights W.

    Returns
    -------
    float
        Number of walks, from 1 to 3.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> body = Cluster.tetrahedron(1.0)
    >>> truth = simulate_motion(body, D_R=1e-3, dt=1.0, n_frames=50, rng=0)
    >>> independent_walks(truth, np.eye(3)), independent_walks(truth, np.diag([1.0, 1.0, 0.0]))
    (3.0, 2.0)
    """
    stop = motion.steps()[1]
    if axes_weighted_equally(direction_weights(body_directions(motion))) or len(stop) < 2:
        return float(np.trace(weights) ** 2 / np.sum(weights * weights))
    w = motion.step_vectors()[stop - 1]
    count, product = len(w), weights @ (w.T @ w)
    total = np.trace(product) ** 2
    square = (count * np.sum(product * product.T) - total) / (count + 1)
    return float(np.clip(total / square, 1.0, 3.0)) if square > 0 else 3.0


def axis_ratio(motion: RigidMotion, weights: Floats) -> tuple[float, float] | None:
    """Return tr(D W)/tr W over tr(D)/3 and its standard error; None where W weighs axes equally.

    D is estimated from the mean products of steps (a) and of neighbouring steps (b), which subtract
    the noise. The error is that of a quadratic form in Gaussian steps with these covariances: in
    the mode of phase f the form is 1 + c cos f, c twice the steps per neighbouring pair, and the
    covariance a + 2 b cos f.

    Parameters
    ----------
    motion : RigidMotion
        Motion whose steps are used.
    weights : ndarray, shape (3, 3)
        Weights W.

    Returns
    -------
    tuple of float, or None
        Ratio and standard error; (1, inf) where the steps show no diffusion.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> rod = Cluster.from_positions([[-3, 0, 0], [0, 0.5, 0], [0, 0, 0.5], [3, 0, 0]])
    >>> truth = simulate_motion(rod, D_R=[4e-3, 1e-3, 1e-3], dt=1.0, n_frames=2000, rng=0)
    >>> ratio, stderr = axis_ratio(truth, np.diag([1.0, 0.0, 0.0]))
    >>> bool(abs(ratio - 2.0) < 3 * stderr)
    True
    """
    if axes_weighted_equally(weights):
        return None
    start, stop = motion.steps()
    w = motion.step_vectors()[stop - 1]
    linked = start[1:] == stop[:-1]
    if linked.sum() < 2:
        return 1.0, np.inf
    own = w.T @ w / len(w)
    neighbour = w[:-1][linked].T @ w[1:][linked] / linked.sum()
    neighbour = 0.5 * (neighbour + neighbour.T)
    tensor = own + 2 * neighbour
    if not np.trace(tensor) > 0:
        return 1.0, np.inf
    uneven = 3 / np.trace(weights) * weights - np.eye(3)
    more = float(np.sum(tensor * uneven) / np.trace(tensor))
    cosine = np.cos(2 * np.pi * (np.arange(64) + 0.5) / 64)
    form = 1 + 2 * len(w) / linked.sum() * cosine
    both = (uneven - more * np.eye(3)) @ (
        own + 2 * linked.mean() * cosine[:, None, None] * neighbour
    )
    variance = 2 * np.mean(form**2 * np.einsum("kij,kji->k", both, both)) / len(w)
    return 1 + more, float(np.sqrt(max(variance, 0.0)) / np.trace(tensor))


def mean_velocity(walks: Floats, time: Floats, piece: Ints) -> tuple[Floats, Floats]:
    """Return the mean velocity from first to last frames of every stretch, and their durations.

    For a Brownian walk no other estimate of the velocity has a smaller error.

    Parameters
    ----------
    walks : ndarray, shape (T, K, c)
        Coordinates of K walkers, um, NaN where missing.
    time : ndarray, shape (T,)
        Time of each frame, s.
    piece : ndarray of int, shape (T,)
        Piece of each frame.

    Returns
    -------
    velocity : ndarray, shape (c,)
        Mean velocity, um/s.
    durations : ndarray, shape (B,)
        Duration of each stretch, s, in rising order.

    Raises
    ------
    TooFewFramesError
        If no walker has two frames in one piece.

    Examples
    --------
    >>> walk, time = np.array([0.0, 5.0, 3.0])[:, None, None], np.array([0.0, 1.0, 2.0])
    >>> mean_velocity(walk, time, np.zeros(3, dtype=int))
    (array([1.5]), array([2.]))
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


def drift_corrected(
    components: Floats, pairs: Ints, *, lagtime: Floats, durations: Floats
) -> Floats:
    """Correct an MSD for the Brownian motion that was subtracted with a mean velocity.

    A mean velocity from first to last frames, T of time in all stretches together, leaves
    2 D t (1 - t/T) + o g(t) of 2 D t + o at lag t. In g the noise of the stretches' ends counts
    twice, with the displacements that begin or end there and with itself.

    Parameters
    ----------
    components : ndarray, shape (L, c)
        MSD by axis of the walks without their mean velocity, um^2.
    pairs : ndarray of int, shape (L,)
        Number of pairs at each lag.
    lagtime : ndarray, shape (L,)
        Lag times, s.
    durations : ndarray, shape (B,)
        Duration of each stretch, s, in rising order.

    Returns
    -------
    ndarray, shape (L, c)
        Corrected MSD by axis, um^2; NaN at the lag of a whole track, all of whose displacement was
        subtracted.

    Examples
    --------
    >>> lagtime = np.array([1.0, 2.0, 3.0])
    >>> left = (2 * lagtime * (1 - lagtime / 4))[:, None]  # 2 D t less its drift, D = 1, T = 4
    >>> drift_corrected(
    ...     left, np.array([4, 3, 2]), lagtime=lagtime, durations=np.array([4.0])
    ... ).ravel().round(9)
    array([2., 4., 6.])
    """
    total = float(durations.sum())
    n = lagtime / total
    long_enough = len(durations) - np.searchsorted(durations, lagtime * (1 - 1e-9))
    g = 1 - 2 * n * long_enough / np.maximum(pairs, 1) + n * n * len(durations)
    left = 1 - n
    good = np.flatnonzero((pairs > 0) & (left > 0.5 * n[0]))
    corrected = np.full_like(components, np.nan)
    if good.size > 1:
        first, second = good[:2]
        lines = np.array([[n[i] * left[i], g[i]] for i in (first, second)])
        offset = np.linalg.solve(lines, components[[first, second]])[1]
        diffusive = components[good] - offset * g[good, None]
        corrected[good] = diffusive / left[good, None] + offset
    return corrected
