"""How fast a rod's direction and centre diffuse: the likelihood of their steps."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np

from perrin.diffusion.estimate import DiffusionEstimate
from perrin.diffusion.estimators import by_likelihood
from perrin.diffusion.step_kernels import Track
from perrin.diffusion.steps import Steps, center_steps, direction_steps
from perrin.errors import TooFewFramesError

if TYPE_CHECKING:
    from perrin.diffusion.steps import Walk
    from perrin.motion.rods import RodMotion


def estimate_rod(
    motion: RodMotion, *, quantity: Literal["direction", "translation"] = "direction"
) -> DiffusionEstimate:
    """Estimate D_perp of a rod's direction, or D_T of its centre, by maximum likelihood.

    Parameters
    ----------
    motion : RodMotion
    quantity : {"direction", "translation"}
        D_perp (rad^2/s), with ``<|du|^2>`` = 4 D_perp dt for short times, or the mean D_T (um^2/s).

    Returns
    -------
    DiffusionEstimate
        With profile-likelihood intervals, the noise offset estimated along with D.

    Raises
    ------
    TooFewFramesError
        Fewer than 3 frames in a row.

    Examples
    --------
    >>> from perrin import Cluster, estimate_rod, simulate_motion, track_direction
    >>> truth = simulate_motion(Cluster.touching(2, 2.0), D_R=0.01, dt=0.5, n_frames=300, rng=2)
    >>> estimate = estimate_rod(track_direction(truth.positions(), dt=0.5))
    >>> estimate.ci95[0] < 0.01 < estimate.ci95[1]
    True
    """
    walk = direction_steps(motion) if quantity == "direction" else center_steps(motion)
    if len(walk.tau) < 2:
        raise TooFewFramesError(
            f"{motion.fitted.size} frames show the rod in too few steps: at least 3 in a row "
            "(gaps allowed) are needed to tell diffusion from noise",
            int(motion.fitted.size),
        )
    blur = float(walk.tau.min()) / 2  # the exposure is unknown: see estimate_diffusion
    found = by_likelihood([Track.free(_steps(walk, motion), blur=blur, drift=False)])
    return DiffusionEstimate.judged(
        found,
        quantity="rotation" if quantity == "direction" else "translation",
        method="mle",
        n_frames=int(motion.fitted.size),
        dt=float(np.median(walk.tau)),
        noise_variance=float(np.nanmean(walk.variance)),
    )


def _steps(walk: Walk, motion: RodMotion) -> Steps:
    """Return the walk as the likelihood that serves all motions takes it.

    Its noise is known as such, not as a multiple of sigma^2: sigma is 1.
    """
    components = walk.y.shape[1]
    before, after = (
        np.repeat(walk.variance[rows][:, None], components, axis=1)
        for rows in (walk.start, walk.stop)
    )
    return Steps(
        size=walk.y,
        duration=walk.tau,
        linked=np.append(walk.start[1:] == walk.stop[:-1], False),
        before=before,
        after=after,
        complete=float(np.nanmean(walk.variance)),
        sigma=1.0,
        freedom=0,
        dt=motion.dt,
        steady=np.zeros((*walk.y.shape, 0)),
    )
