"""How relative orientations spread with lag time: the covariance of their quaternions."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from perrin._arrays import TooFewFramesError
from perrin.lagged import fast_size, on_grid

if TYPE_CHECKING:
    from perrin._arrays import Bools, Floats, Ints
    from perrin.motion import RigidMotion


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
    grid, piece = on_grid(motion, motion.rotation)
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
    size = fast_size(len(here) + count)
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
