"""The interval of a D that changes in time: from the states of a motion, or from blocks of it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from perrin.diffusion.estimate import NORMAL
from perrin.diffusion.steps import pooled_steps
from perrin.motion.rigid_motion import RigidMotion

if TYPE_CHECKING:
    from collections.abc import Sequence

    from perrin.diffusion.estimate import DiffusionEstimate
    from perrin.diffusion.switching import SwitchingEstimate

# A standard error of ln D above this states that the track has too few dwells to count them.
_MOST_ERROR = 1.0

_BLOCKS, _FEWEST_STEPS_OF_BLOCK = (4, 8, 16), 5


def with_changing_interval(
    estimate: DiffusionEstimate,
    motion: RigidMotion | Sequence[RigidMotion],
    states: SwitchingEstimate | None = None,
) -> DiffusionEstimate:
    """Return an estimate whose interval holds where D changes in time.

    Parameters
    ----------
    estimate : DiffusionEstimate
        D of the motion by the likelihood of one constant D, whose interval is too narrow here.
    motion : RigidMotion or sequence of RigidMotion
        The motion, or motions, of the estimate.
    states : SwitchingEstimate, optional
        Two states fitted to it; None for several motions, which have states of their own.

    Returns
    -------
    DiffusionEstimate
        The same value. Its relative error is that of the mean over the states, which contains the
        random number of dwells (method "mle, error from states"); where the dwells are too few for
        that, it is the largest error that the scatter of 4, 8 and 16 blocks of equal length gives
        (method "mle, error from blocks"). It is never less than that of the likelihood. An
        estimate that is not resolved is returned as it is.

    Notes
    -----
    Means over blocks of N/B steps scatter by the error of their mean times sqrt(B) if the blocks
    are independent; short blocks are not, so that the largest error counts (Flyvbjerg and Petersen
    1989).

    Examples
    --------
    >>> from perrin import Cluster, Switching, estimate_diffusion, fit_switching, simulate_motion
    >>> truth = simulate_motion(
    ...     Cluster.tetrahedron(1.5), D_R=1e-3, dt=1.0, n_frames=200,
    ...     dynamics=Switching(10, dwell=20.0), rng=1,
    ... )
    >>> one = estimate_diffusion(truth)
    >>> changing = with_changing_interval(one, truth, fit_switching(truth))
    >>> changing.method, changing.value == one.value, changing.stderr > 1.5 * one.stderr
    ('mle, error from states', True, True)
    """
    if not estimate.resolved:
        return estimate
    low, high = (0.0, np.inf) if states is None else states.D_mean.ci68
    error, source = np.inf, "states"
    if 0 < low < high < np.inf:
        error = float(np.log(high / low)) / (2 * NORMAL[0.68])
    if error > _MOST_ERROR:
        source = "blocks"
        motions = [motion] if isinstance(motion, RigidMotion) else motion
        rates = np.concatenate(
            [
                np.mean(s.vectors**2, axis=1) / (2 * s.duration)
                for s in pooled_steps(motions, estimate.quantity)
            ]
        )
        counts = [b for b in _BLOCKS if len(rates) >= _FEWEST_STEPS_OF_BLOCK * b]
        errors = [
            np.std([part.mean() for part in np.array_split(rates, b)], ddof=1) / np.sqrt(b)
            for b in counts
        ]
        error = float(max(errors, default=0.0)) / estimate.value
    error = max(error, estimate.stderr / estimate.value)
    ci68, ci95 = (
        (
            float(estimate.value * np.exp(-NORMAL[level] * error)),
            float(estimate.value * np.exp(NORMAL[level] * error)),
        )
        for level in (0.68, 0.95)
    )
    return replace(
        estimate,
        ci68=ci68,
        ci95=ci95,
        stderr=(ci68[1] - ci68[0]) / 2,
        method=f"{estimate.method}, error from {source}",
    )
