"""Whether bodies that do not touch move together: the stage, the focus, a flow."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from perrin._arrays import frozen

if TYPE_CHECKING:
    from collections.abc import Sequence

    from perrin._arrays import Floats, Ints
    from perrin.motion.rigid_motion import RigidMotion

_FEWEST_SHARED_STEPS = 10  # that two bodies share


@dataclass(frozen=True, eq=False)
class CommonMotion:
    """Covariance of the steps of different bodies in the same frames, by lab axis.

    Attributes
    ----------
    covariance : ndarray, shape (d,)
        Mean product of the steps of two bodies over the same frames, um^2, mean over pairs.
    stderr : ndarray, shape (d,)
        Its standard error for bodies that move independently, um^2.
    variance : ndarray, shape (d,)
        Mean square of a step, um^2.
    following : ndarray, shape (d,)
        Mean product of a step of one body and the next step of another, um^2: minus half of the
        covariance where the common positions are random from frame to frame, zero where the common
        motion is diffusion, towards the covariance where it lasts for many frames.
    bodies : int
        Number of bodies.
    p : float
        Chance of a covariance as large on any axis, for independent bodies.
    """

    covariance: Floats
    stderr: Floats
    variance: Floats
    following: Floats
    bodies: int
    p: float

    def __post_init__(self) -> None:
        frozen(self.covariance, self.stderr, self.variance, self.following)

    @property
    def share(self) -> Floats:
        """Share of the mean square step that is common to all bodies, by lab axis."""
        return np.asarray(self.covariance / self.variance)


def common_motion(bodies: Sequence[tuple[RigidMotion, Ints]]) -> CommonMotion | None:
    """Compare the steps of bodies in the same frames.

    Parameters
    ----------
    bodies : sequence of tuple
        Motion of each body, and the frame numbers of its rows.

    Returns
    -------
    CommonMotion or None
        None for fewer than two bodies that share ten steps.

    Notes
    -----
    With the sum S and the sum Q of squares of the m bodies' steps in a frame, the products of all
    pairs add up to (S^2 - Q)/2. Standard errors are those of independent bodies: the variance of
    the sum is the sum of products of the variances of the two steps. Bodies in a fluid follow one
    another a little: two spheres of radius a at the distance r have the correlation 3 a/(2 r) along
    their line of centres, and half of it across.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> body = Cluster.tetrahedron(1.5)
    >>> alone = [
    ...     simulate_motion(body, D_R=0.01, D_T=0.04, dt=0.7, n_frames=200, rng=k) for k in (1, 2)
    ... ]
    >>> found = common_motion([(motion, np.arange(200)) for motion in alone])
    >>> found.p > 0.01, (abs(found.share) < 0.2).all()
    (True, np.True_)
    """
    from scipy.special import ndtr

    if len(bodies) < 2:
        return None
    last = 1 + max(int(frames.max()) for _, frames in bodies)
    d = bodies[0][0].dimension
    steps = np.full((len(bodies), last, d), np.nan)
    for b, (motion, frames) in enumerate(bodies):
        start, stop = motion.steps()
        near = frames[stop] - frames[start] == 1
        moved = (motion.center[stop] - motion.center[start])[near]
        if len(moved):
            # A steady velocity is tested for each body by itself.
            steps[b, frames[stop[near]]] = moved - moved.mean(axis=0)
    seen = np.isfinite(steps[..., 0])
    filled = np.where(seen[..., None], steps, 0.0)
    own = (filled**2).sum(axis=1) / np.maximum(seen.sum(axis=1), 1)[:, None]
    pairs = float((seen.sum(axis=0) * (seen.sum(axis=0) - 1) / 2).sum())
    if pairs < _FEWEST_SHARED_STEPS or not (own[seen.any(axis=1)] > 0).all():
        return None
    squares = np.where(seen[..., None], own[:, None], 0.0)
    products = 0.5 * (filled.sum(axis=0) ** 2 - (filled**2).sum(axis=0))
    spread = 0.5 * (squares.sum(axis=0) ** 2 - (squares**2).sum(axis=0))
    total, following = filled.sum(axis=0), np.zeros(d)
    both = float((seen[:, 1:].sum(axis=0) * seen[:, :-1].sum(axis=0)).sum())
    both -= float((seen[:, 1:] & seen[:, :-1]).sum())
    if both > 0:
        across = (total[1:] * total[:-1]).sum(axis=0) - (filled[:, 1:] * filled[:, :-1]).sum(
            axis=(0, 1)
        )
        following = across / both
    covariance = products.sum(axis=0) / pairs
    stderr = np.sqrt(spread.sum(axis=0)) / pairs
    p = float(min(1.0, d * ndtr(-np.max(covariance / stderr))))
    variance = (filled**2).sum(axis=(0, 1)) / seen.sum()
    return CommonMotion(covariance, stderr, variance, following, len(bodies), p)
