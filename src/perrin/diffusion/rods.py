"""Diffusion coefficients of a rod's direction and centre from the likelihood of their steps."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np

from perrin._arrays import choice_fault, refuse
from perrin.diffusion.estimate import DiffusionEstimate
from perrin.diffusion.estimators import by_likelihood
from perrin.diffusion.noise_model import Noise
from perrin.diffusion.steps import NoisySteps, center_steps, direction_steps
from perrin.errors import TooFewFramesError
from perrin.motion.rods import RodMotion

if TYPE_CHECKING:
    from collections.abc import Sequence


def estimate_rod(
    motion: RodMotion | Sequence[RodMotion],
    *,
    quantity: Literal["direction", "translation"] = "direction",
) -> DiffusionEstimate:
    """Estimate D_perp of a rod's direction, or D_T of its centre, by maximum likelihood.

    Parameters
    ----------
    motion : RodMotion or sequence of RodMotion
        Motion; several motions are pooled: they share one D, and each has its own noise.
    quantity : {"direction", "translation"}
        D_perp (rad^2/s), with ``<|du|^2>`` = 4 D_perp dt for short times, or the mean D_T (um^2/s).

    Returns
    -------
    DiffusionEstimate
        Estimate with profile-likelihood intervals; the noise offset is estimated along with D.

    Raises
    ------
    TooFewFramesError
        If there are fewer than 3 frames in a row.
    ValueError
        If the quantity is not one of these.

    Examples
    --------
    >>> from perrin import Cluster, estimate_rod, simulate_motion, track_direction
    >>> truth = simulate_motion(Cluster.touching(2, 2.0), D_R=0.01, dt=0.5, n_frames=300, rng=2)
    >>> estimate = estimate_rod(track_direction(truth.positions(), dt=0.5))
    >>> estimate.ci95[0] < 0.01 < estimate.ci95[1]
    True
    """
    refuse(choice_fault("quantity", quantity, ("direction", "translation")))
    motions = [motion] if isinstance(motion, RodMotion) else list(motion)
    steps_of_rod = direction_steps if quantity == "direction" else center_steps
    steps = [steps_of_rod(one) for one in motions]
    for one, found in zip(motions, steps, strict=True):
        if len(found.duration) < 2:
            raise TooFewFramesError(
                f"{one.fitted.size} frames contain the rod in too few steps: at least 3 in a row "
                "(gaps allowed) are needed to separate diffusion from noise",
                int(one.fitted.size),
            )
    return DiffusionEstimate.judged(
        by_likelihood([NoisySteps.of(found, Noise()) for found in steps]),
        quantity="rotation" if quantity == "direction" else "translation",
        method="mle",
        n_frames=sum(int(one.fitted.size) for one in motions),
        dt=float(np.mean([np.median(found.duration) for found in steps])),
        noise_variance=float(np.mean([found.complete for found in steps])),
    )
