"""Variances of orientations and centres from noise, for which correlations are corrected."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from perrin._arrays import number_fault
from perrin.motion.residuals import unit_center_variance, unit_covariance

if TYPE_CHECKING:
    from perrin._arrays import Bools, Floats
    from perrin.motion.rigid_motion import RigidMotion

# The variance of the orientation of a fitted body exceeds the one stated to first order, s, by the
# factor 1 + 3.6 s: 3.1 to 3.6 for bodies of 3 to 6 particles at sigma/R = 0.23
# (docs/validation.md).
_SECOND_ORDER = 3.6


def correction_fault(noise: object) -> list[str]:
    """Return one line where a noise model is none of those that a curve is corrected for.

    Parameters
    ----------
    noise : object
        Value that the user passed.

    Returns
    -------
    list of str
        Empty, or one line.

    Examples
    --------
    >>> correction_fault("residual"), correction_fault(0.02), correction_fault(None)
    ([], [], [])
    >>> correction_fault("loud")
    ["noise: expected 'residual', 'joint', sigma in um or None, got 'loud'"]
    """
    if noise is None or (isinstance(noise, str) and noise in ("residual", "joint")):
        return []
    if isinstance(noise, str) or number_fault("noise", noise, least=0):
        return [f"noise: expected 'residual', 'joint', sigma in um or None, got {noise!r}"]
    return []


def orientation_offsets(motion: RigidMotion, noise: str | float | None) -> Floats:
    """Return the covariance of the noise of every orientation, rad^2, body axes.

    Parameters
    ----------
    motion : RigidMotion
        Orientations against time.
    noise : "residual", "joint", float or None
        As in `orientation_correlation`. The first-order covariance of the rigid fits is raised to
        second order in the noise. "joint" is the covariance of neighbouring steps, negated
        (Vestergaard, Blainey and Flyvbjerg 2014, Eq. 10): the same for all frames, and less than
        the noise by the motion blur.

    Returns
    -------
    ndarray, shape (T, a, a)
        a = 3, in the plane 1.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.0), D_R=5e-3, dt=0.7, n_frames=9, rng=3)
    >>> orientation_offsets(truth, 0.02)[0].diagonal().round(9)  # sigma^2 3/8 over R^2
    array([0.00015008, 0.00015008, 0.00015008])
    """
    if noise is None:
        return np.zeros_like(motion.covariance)
    if noise == "joint":
        start, stop = motion.steps()
        product = neighbour_covariance(motion.step_vectors()[stop - 1], start[1:] == stop[:-1])
        return np.broadcast_to(-product, motion.covariance.shape)
    if noise == "residual":
        covariance = motion.step_covariance
    else:
        covariance = unit_covariance(motion) * float(noise) ** 2
    covariance = np.where(np.isfinite(covariance), covariance, 0.0)
    if motion.dimension == 2:
        return covariance
    mean = np.trace(covariance, axis1=1, axis2=2) / 3
    return np.asarray(covariance * (1 + _SECOND_ORDER * mean)[:, None, None])


def center_offset(motion: RigidMotion, noise: str | float | None) -> float:
    """Return the variance of one coordinate of the centre from noise, mean over axes, um^2.

    Parameters
    ----------
    motion : RigidMotion
        Centres against time.
    noise : "residual", "joint", float or None
        As in `orientation_correlation`.

    Returns
    -------
    float

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.0), D_R=5e-3, dt=0.7, n_frames=9, rng=3)
    >>> round(center_offset(truth, 0.02), 9)  # four particles
    0.0001
    """
    if noise is None:
        return 0.0
    if noise == "residual":
        return motion.center_noise
    if noise == "joint":
        start, stop = motion.steps()
        step = motion.center[stop] - motion.center[start]
        product = neighbour_covariance(step, start[1:] == stop[:-1])
        return -float(np.trace(product)) / len(product)
    variance = unit_center_variance(motion)[motion.fitted] * float(noise) ** 2
    return float(np.mean(variance))


def neighbour_covariance(steps: Floats, linked: Bools) -> Floats:
    """Return the mean product of neighbouring steps, symmetric; 0 where no two have a common frame.

    Parameters
    ----------
    steps : ndarray, shape (S, c)
        Displacements or rotation vectors.
    linked : ndarray of bool, shape (S - 1,)
        Whether each step begins where the one before it ends.

    Returns
    -------
    ndarray, shape (c, c)

    Examples
    --------
    >>> neighbour_covariance(np.array([[1.0], [-1.0], [1.0]]), np.array([True, True]))
    array([[-1.]])
    """
    if not linked.any():
        return np.zeros((steps.shape[1],) * 2)
    product = steps[:-1][linked].T @ steps[1:][linked] / np.count_nonzero(linked)
    return np.asarray(0.5 * (product + product.T))
