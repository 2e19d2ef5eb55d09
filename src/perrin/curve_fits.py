"""What D a curve shows: the paper's straight line, with the error it really has."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from perrin.diffusion import UNITS, DiffusionEstimate

if TYPE_CHECKING:
    from perrin._arrays import Floats
    from perrin.lagged import LagCurve

_NORMAL = {0.68: 0.9945, 0.95: 1.9600}


def fit_line(curve: LagCurve, *, lag_range: tuple[float, float]) -> DiffusionEstimate:
    """Fit a straight line with a free offset to a curve, as the paper does (Eqs. 20, 22 and 24).

    Parameters
    ----------
    curve : LagCurve
        From `msad` or `msd`.
    lag_range : tuple of float
        First and last lag time used, s, both included.

    Returns
    -------
    DiffusionEstimate
        The slope over 2 dof. Its error is that of the procedure on Brownian motion, correlations
        between overlapping pairs included (the scatter about the line says nothing about it); for
        the MSAD of several directions it is up to 10 % too large. ``n_frames`` counts the frames
        that the curve spans.

    Raises
    ------
    ValueError
        If the range holds fewer than 3 lags with data, or the curve is a correlation.

    Examples
    --------
    >>> from perrin import Cluster, msad, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=3)
    >>> print(fit_line(msad(truth), lag_range=(3, 22)))
    D_R = 0.0068(18) rad^2/s [line, 300 frames]
    """
    if curve.quantity not in UNITS:
        raise ValueError("curve: expected an MSD or MSAD; a correlation is no straight line")
    low, high = lag_range
    dt = float(curve.lagtime[0])
    inside = (curve.lagtime > low - 1e-6 * dt) & (curve.lagtime < high + 1e-6 * dt)
    use = np.flatnonzero(inside & np.isfinite(curve.value))
    if use.size < 3:
        raise ValueError(
            f"lag_range: {low:g} to {high:g} s holds {use.size} lags with data, at least 3 are "
            f"needed; the curve runs from {dt:g} to {curve.lagtime[-1]:g} s"
        )
    t = curve.lagtime[use]
    lever = (t - t.mean()) / np.sum((t - t.mean()) ** 2)
    D = float(lever @ curve.value[use]) / (2 * curve.dof)
    offset = float(np.mean(curve.value[use])) / (2 * curve.dof) - D * float(t.mean())
    steps = len(curve.lagtime)
    weights = np.zeros(use[-1] + 1)
    weights[use] = lever / 2
    variance = _quadratic_variance(weights, steps, D=max(D, 0.0) * dt, s=max(offset, 0.0))
    walkers = curve.n_walks / curve.components.shape[1] if curve.quantity == "translation" else 1.0
    # Gaps leave fewer pairs than a complete track; the variance grows in proportion.
    thinned = float(np.mean((steps - use) * walkers / curve.n_pairs[use]))
    stderr = float(np.sqrt(variance * thinned / curve.n_walks))
    ci68, ci95 = ((D - z * stderr, D + z * stderr) for z in (_NORMAL[0.68], _NORMAL[0.95]))
    return DiffusionEstimate(
        value=D,
        ci68=ci68,
        ci95=ci95,
        stderr=stderr,
        offset=offset,
        offset_stderr=np.nan,
        resolution_floor=None,
        resolved=ci95[0] > 0,
        unit=UNITS[curve.quantity],
        method="line",
        n_frames=steps + 1,
        snr=D * dt / offset if offset > 0 else np.inf,
    )


def _quadratic_variance(weights: Floats, steps: int, *, D: float, s: float) -> float:
    """Return the variance of sum_n weights[n-1] MSD(n) of a one-dimensional noisy Brownian walk.

    The sum is a quadratic form y.Q.y in the steps y, whose covariance C is tridiagonal
    (2D + 2s, -s); the variance is 2 tr (QC)^2. Q_jk, the weight over the pair count of all
    displacements that contain both steps, comes from cumulative sums, one diagonal at a time.
    """
    L, N = len(weights), steps
    lag = np.arange(1, L + 1)
    per_pair = np.concatenate([[0.0], np.cumsum(weights / (N - lag + 1))])
    held = per_pair[np.minimum(np.arange(N + L + 1), L)]
    twice = np.concatenate([[0.0], np.cumsum(held)])

    def diagonal(p: int) -> Floats:
        k = np.arange(p, N)
        top = np.maximum(np.minimum(k, L - 1) + 1, p)
        contained: Floats = twice[N - k + top] - twice[N - k + p] - (twice[top] - twice[p])
        return contained

    a, b = 2 * D + 2 * s, -s
    before, here = diagonal(1) if N > 1 else np.zeros(0), diagonal(0)
    trace = 0.0
    for p in range(min(L, N - 1) + 1):
        after = diagonal(p + 1)
        upper, lower = a * here, a * here
        upper[: len(after)] += b * after
        lower[1:] += b * after
        if p:
            upper += b * before[: len(here)]
            lower += b * before[1 : len(here) + 1]
            trace += 2 * float(upper @ lower)
        else:
            full = upper + lower - a * here
            trace += float(full @ full)
        before, here = here, after
    return 2 * trace
