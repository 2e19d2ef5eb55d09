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
    center = np.full((len(bodies), d, last), np.nan)
    piece = np.full((len(bodies), last), -1, dtype=np.int64)
    for own_center, own_piece, (motion, frames) in zip(center, piece, bodies, strict=True):
        own_center[:, frames] = motion.center.T
        own_piece[frames] = motion.piece
    moved = center[..., 1:] - center[..., :-1]
    seen = np.isfinite(moved[:, 0]) & (piece[:, 1:] == piece[:, :-1])
    filled = np.where(seen[:, None], moved, 0.0)
    steps = np.maximum(seen.sum(axis=1), 1)[:, None]
    # A steady velocity is tested for each body by itself.
    filled -= np.where(seen[:, None], (filled.sum(axis=2) / steps)[..., None], 0.0)
    square = np.einsum("bdt,bdt->bd", filled, filled)
    own, count = square / steps, seen.sum(axis=0)
    pairs = float((count * (count - 1) / 2).sum())
    if pairs < _FEWEST_SHARED_STEPS or not (own[seen.any(axis=1)] > 0).all():
        return None
    total = filled.sum(axis=0)
    products = 0.5 * ((total * total).sum(axis=1) - square.sum(axis=0))
    here = seen.astype(np.float64)
    spread = 0.5 * ((own.T @ here) ** 2 - (own.T**2) @ here)
    following = np.zeros(d)
    both = float((count[1:] * count[:-1]).sum() - (seen[:, 1:] & seen[:, :-1]).sum())
    if both > 0:
        after = np.einsum("bdt,bdt->d", filled[..., 1:], filled[..., :-1])
        following = ((total[:, 1:] * total[:, :-1]).sum(axis=1) - after) / both
    covariance = products / pairs
    stderr = np.sqrt(spread.sum(axis=1)) / pairs
    p = float(min(1.0, d * ndtr(-np.max(covariance / stderr))))
    variance = square.sum(axis=0) / seen.sum()
    return CommonMotion(covariance, stderr, variance, following, len(bodies), p)
