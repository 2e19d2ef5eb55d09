"""Correlations of orientations and covariances of relative quaternions against lag time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from perrin._arrays import choice_fault, from_plain, number_fault, refuse, to_plain
from perrin.curves.correlation_errors import correlation_stderr
from perrin.curves.displacement import LagCurve, body_directions, direction_weights
from perrin.curves.grids import place_frames
from perrin.curves.noise_offsets import correction_fault, orientation_offsets
from perrin.curves.pairs import Products, pair_sums

if TYPE_CHECKING:
    from perrin._arrays import Floats, Ints
    from perrin.motion.rigid_motion import RigidMotion


class QuaternionCovariance(NamedTuple):
    """Covariance <q q^T> of the vector part q of relative quaternions against lag time.

    Attributes
    ----------
    lagtime : ndarray, shape (L,)
        Mean time between the frames of the pairs, s.
    covariance : ndarray, shape (L, 3, 3)
        Covariance of the vector part in body axes; NaN at a lag without a pair.
    n_pairs : ndarray of int, shape (L,)
        Number of pairs of frames at each lag.
    """

    lagtime: Floats
    covariance: Floats
    n_pairs: Ints

    def to_dict(self) -> dict[str, Any]:
        """Return the covariance for JSON: lists for arrays, None for NaN.

        Returns
        -------
        dict
            An entry per attribute.

        Examples
        --------
        >>> still = QuaternionCovariance(np.ones(1), np.zeros((1, 3, 3)), np.array([4]))
        >>> still.to_dict()["n_pairs"]
        [4]
        """
        return {name: to_plain(values) for name, values in self._asdict().items()}

    @classmethod
    def from_dict(cls, entry: dict[str, Any]) -> QuaternionCovariance:
        """Return the covariance that `to_dict` wrote.

        Parameters
        ----------
        entry : dict
            As `to_dict` returns it, also after a round trip through JSON.

        Returns
        -------
        QuaternionCovariance

        Examples
        --------
        >>> still = QuaternionCovariance(np.ones(1), np.zeros((1, 3, 3)), np.array([4]))
        >>> QuaternionCovariance.from_dict(still.to_dict()).n_pairs
        array([4])
        """
        return cls(
            lagtime=from_plain(entry["lagtime"]),
            covariance=from_plain(entry["covariance"]),
            n_pairs=from_plain(entry["n_pairs"], dtype=np.int64),
        )


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
        Motion in three dimensions; frames without a pose are left out.
    n_lags : int, optional
        Number of lags, counted from one step between frames; default all.

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
    if motion.dimension != 3:
        raise ValueError("quaternion_covariance is for motions in three dimensions")
    if n_lags is not None:
        refuse(number_fault("n_lags", n_lags, least=1, whole=True))
    here = np.isfinite(motion.center[:, 0])
    frames = place_frames(motion.time, motion.piece, here, dt=motion.dt)
    # Element (i, j) of R_k^T R_{k+n} is the sum of products of column i and column j.
    lower = [(i, j) for i in range(3) for j in range(i + 1)]
    groups = [[(3 * a + i, 3 * a + j) for a in range(3)] for i, j in lower]
    sums = pair_sums(Products(motion.rotation.reshape(-1, 9), groups), frames, most=n_lags)
    elements = sums.mean
    mean = np.empty((len(elements), 3, 3))
    for k, (i, j) in enumerate(lower):
        mean[:, i, j] = mean[:, j, i] = elements[:, k]
    trace = np.trace(mean, axis1=1, axis2=2)[:, None, None]
    covariance = 0.5 * mean - 0.25 * (trace - 1) * np.eye(3)
    return QuaternionCovariance(sums.lagtime, covariance, sums.pairs)


def orientation_correlation(
    motion: RigidMotion,
    *,
    degree: int = 1,
    directions: ArrayLike | None = None,
    noise: Literal["residual", "joint"] | float | None = "residual",
) -> LagCurve:
    """Return the orientational correlation <P_l(p(t) . p(t + dt))> over all lag times.

    Parameters
    ----------
    motion : RigidMotion
        Motion in three dimensions.
    degree : int
        l = 1 or 2 of the Legendre polynomial.
    directions : array_like, shape (3,) or (K, 3), optional
        Body-fixed directions, averaged; default those of the particles.
    noise : None, "residual", "joint" or float
        Noise of the orientations that the curve is corrected for. "residual": the noise that the
        residuals of the rigid fits predict, frame by frame; right where all particles of a frame
        are recorded at the same instant. None: no correction, the curve of the orientations as they
        were measured. A number is the known localisation error of one coordinate, um. "joint": the
        offset of the steps, which includes motion blur, and holds where the motion is diffusion
        from one frame to the next; a body that rattles in a cage has such an offset without noise.

    Returns
    -------
    LagCurve
        Dimensionless curve that decays as exp(-l (l + 1) D_R t). ``stderr`` is the error of an
        isotropic Brownian rotor with the decay of the curve, noise and missing frames included.
        ``dof`` is l (l + 1) / 2, half the rate over D_R. ``noise`` is the variance of one
        orientation (rad^2) that the residuals predict, corrected for or not.

    Raises
    ------
    ValueError
        If the degree is not 1 or 2, the motion is planar, or the noise is none of those offered.

    Warns
    -----
    PrecisionWarning
        As `msd`.

    Notes
    -----
    Noise of covariance S (rad^2) in every frame multiplies the correlation of a direction p by
    exp(-l(l + 1) (tr S - p.S p)/2), which is exp(-l(l + 1) s) for isotropic noise s. It follows
    from the mean of P_l of small angles, <angle^2> = tr S - p.S p for the noise of one frame, and
    is exact to first order in S where p is a principal axis of the noise, or the body rotates
    isotropically. The factor is taken out of every frame and direction before the average. Even a
    corrected curve does not pass through 1 exactly: fit an amplitude (`fit_relaxation`).

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.0), D_R=1e-2, dt=1.0, n_frames=20000, rng=0)
    >>> curve = orientation_correlation(truth)
    >>> round(float(curve.value[49]), 1)  # exp(-2 x 0.01 x 50)
    0.4
    """
    faults = [] if degree in (1, 2) else choice_fault("degree", degree, (1, 2))
    refuse(faults + correction_fault(noise))
    if motion.dimension != 3:
        raise ValueError("orientation_correlation is for motions in three dimensions")
    body = body_directions(motion, directions)
    features = p = motion.orientation(body)
    if degree == 2:
        # The five components of the quadrupole p p^T - 1/3, scaled so that their product is P_2.
        x, y, z = np.moveaxis(p, -1, 0)
        root = np.sqrt(3.0)
        squares = [root / 2 * (x * x - y * y), 1.5 * z * z - 0.5]
        columns = np.stack([root * x * y, root * y * z, root * z * x, *squares])
        features = np.moveaxis(columns, 0, -1)
    unit = body / np.linalg.norm(body, axis=1, keepdims=True)
    rate = degree * (degree + 1)
    offset = 0.0
    if noise is not None:
        # Each frame contributes the root of the factor; across p, half of the trace.
        covariance = orientation_offsets(motion, noise)
        across = 0.5 * np.einsum("tij,ij->t", covariance, np.eye(3))[:, None]
        across = across - 0.5 * np.einsum("ki,tij,kj->tk", unit, covariance, unit)
        features = features * np.exp(0.5 * rate * across)[..., None]
        offset = float(across[motion.fitted].mean())
    here = np.isfinite(motion.center[:, 0])
    frames = place_frames(motion.time, motion.piece, here, dt=motion.dt)
    columns = features.reshape(len(p), -1)
    sums = pair_sums(Products(columns, [[(i, i) for i in range(columns.shape[1])]]), frames)
    value = sums.mean[:, 0] / p.shape[1]
    if offset == 0:
        value = np.minimum(value, 1.0)  # a mean of cosines that rounds above one is one
    blocks = tuple(int(n) for n in frames.lengths)
    damping = np.exp(-rate * offset)
    stderr = correlation_stderr(
        sums.lagtime / frames.step,
        value * damping,
        pairs=sums.pairs,
        degree=degree,
        directions=unit,
        blocks=blocks,
    )
    return LagCurve(
        lagtime=sums.lagtime,
        value=value,
        components=value[:, None].copy(),
        stderr=stderr / damping,
        n_pairs=sums.pairs,
        dof=rate // 2,
        quantity="orientation",
        unit="1",
        n_walks=1.0,
        noise=float(np.trace(motion.orientation_noise @ direction_weights(unit))) / 2,
        step=frames.step,
        blocks=blocks,
        directions=unit,
    )
