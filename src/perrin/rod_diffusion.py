"""How fast a rod's direction and centre diffuse: the likelihood of their steps."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np

from perrin._arrays import TooFewFramesError
from perrin.diffusion import UNITS, DiffusionEstimate, _Likelihood
from perrin.rods import center_steps, direction_steps

if TYPE_CHECKING:
    from perrin.rods import RodMotion, Steps


def estimate_rod(
    motion: RodMotion, *, quantity: Literal["direction", "translation"] = "direction"
) -> DiffusionEstimate:
    """Estimate D_perp of a rod's direction, or D_T of its centre, by maximum likelihood.

    Parameters
    ----------
    motion : RodMotion
    quantity : {"direction", "translation"}
        D_perp (rad^2/s), with <|du|^2> = 4 D_perp dt for short times, or the mean D_T (um^2/s).

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
    steps = direction_steps(motion) if quantity == "direction" else center_steps(motion)
    if len(steps.tau) < 2:
        raise TooFewFramesError(
            f"{motion.fitted.size} frames show the rod in too few steps: at least 3 in a row "
            "(gaps allowed) are needed to tell diffusion from noise",
            int(motion.fitted.size),
        )
    likelihood = _likelihood(steps)
    value = likelihood.best_value()
    ci68, ci95 = (likelihood.interval(value, quantile) for quantile in (0.9889, 3.8415))
    offset, offset_stderr = likelihood.offset_at(value)
    noise = float(np.nanmean(steps.variance))
    return DiffusionEstimate(
        value=value,
        ci68=ci68,
        ci95=ci95,
        stderr=(ci68[1] - ci68[0]) / 2,
        offset=offset,
        offset_stderr=offset_stderr,
        resolution_floor=None,
        resolved=bool(ci95[0] > 0),
        unit=UNITS["rotation" if quantity == "direction" else "translation"],
        method="mle",
        n_frames=int(motion.fitted.size),
        snr=value * motion.dt / noise if noise > 0 else np.inf,
    )


def _likelihood(steps: Steps) -> _Likelihood:
    """Stack the components of the steps for the likelihood that serves all motions."""
    components = steps.y.shape[1]
    excess = steps.variance - np.nanmin(steps.variance)
    linked = np.append(steps.start[1:] == steps.stop[:-1], False).astype(np.float64)
    return _Likelihood(
        y=steps.y.T.ravel(),
        tau=np.tile(steps.tau, components),
        e0=np.tile(excess[steps.start], components),
        e1=np.tile(excess[steps.stop], components),
        linked=np.tile(linked, components),
        group=np.zeros(components * len(steps.tau), dtype=np.int64),
        level=np.array([float(np.nanmean(excess))]),
    )
