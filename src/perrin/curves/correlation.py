"""How relative orientations spread with lag time: the covariance of their quaternions."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from perrin.curves.displacement import LagCurve, _directions, _frames, _mean, _require_pairs
from perrin.curves.pairs import Products, pair_sums, place_frames
from perrin.errors import TooFewFramesError

if TYPE_CHECKING:
    from perrin._arrays import Floats, Ints
    from perrin.motion.rigid_motion import RigidMotion


_LOWER = [(i, j) for i in range(3) for j in range(i + 1)]


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
        Number of lags from one step between frames on; default all.

    Returns
    -------
    QuaternionCovariance

    Raises
    ------
    ValueError
        For a planar motion, or a number of lags that is not 1 or more.
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
    none = "no two frames in one piece: a relative rotation needs two"
    if motion.fitted.size < 2:
        raise TooFewFramesError(none, int(motion.fitted.size))
    here = np.isfinite(motion.center[:, 0])
    frames = place_frames(motion.time, motion.piece, here, dt=motion.dt)
    # Element (i, j) of R_k^T R_{k+n} is the sum of products of column i and column j.
    groups = [[(3 * a + i, 3 * a + j) for a in range(3)] for i, j in _LOWER]
    sums = pair_sums(Products(motion.rotation.reshape(-1, 9), groups), frames, most=n_lags)
    if not sums.pairs.any():
        raise TooFewFramesError(none, 0)
    mean = np.full((len(sums.pairs), 3, 3), np.nan)
    seen = sums.pairs > 0
    for k, (i, j) in enumerate(_LOWER):
        mean[seen, i, j] = mean[seen, j, i] = sums.sums[seen, k] / sums.pairs[seen]
    trace = np.trace(mean, axis1=1, axis2=2)[:, None, None]
    covariance = 0.5 * mean - 0.25 * (trace - 1) * np.eye(3)
    return QuaternionCovariance(sums.lagtime, covariance, sums.pairs)


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
        steps give D_R with a far smaller error. ``dof`` is l (l + 1) / 2, half the rate over D_R.

    Raises
    ------
    ValueError
        For another degree, or a planar motion.

    Warns
    -----
    PrecisionWarning
        As `msd`.

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
    features = p if degree == 1 else _quadrupole(p)
    frames = _frames(motion.time, motion.piece, np.isfinite(motion.center[:, 0]), dt=motion.dt)
    columns = features.reshape(len(p), -1)
    sums = pair_sums(Products(columns, [[(i, i) for i in range(columns.shape[1])]]), frames)
    _require_pairs(sums)
    # A mean of cosines that rounds above one is one.
    value = np.minimum(_mean(sums)[:, 0] / p.shape[1], 1.0)
    return LagCurve(
        lagtime=sums.lagtime,
        value=value,
        components=value[:, None].copy(),
        stderr=np.full_like(value, np.nan),
        n_pairs=sums.pairs,
        dof=degree * (degree + 1) // 2,
        quantity="orientation",
        unit="1",
        n_walks=1.0,
        step=frames.step,
        blocks=tuple(int(n) for n in frames.lengths),
    )


def _quadrupole(p: Floats) -> Floats:
    """Return the five components of directions' squares whose product is P_2 of the cosine."""
    x, y, z = np.moveaxis(p, -1, 0)
    root = np.sqrt(3.0)
    five = [root * x * y, root * y * z, root * z * x, root / 2 * (x * x - y * y), 1.5 * z * z - 0.5]
    return np.stack(five, axis=-1)
