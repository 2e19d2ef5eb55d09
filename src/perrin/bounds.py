"""How well D could be known at best: the Cramér-Rao bound."""

from __future__ import annotations

from typing import Literal

import numpy as np

from perrin._arrays import require_positive


def cramer_rao(
    *, n_frames: int, snr: float, axes: int = 3, noise: Literal["joint", "known"] = "joint"
) -> float:
    """Return the least relative standard error that any unbiased estimate of D can have.

    Parameters
    ----------
    n_frames : int
        Frames of one track without gaps, at least 3.
    snr : float
        D dt/s, s the noise variance of one orientation angle or centre coordinate.
    axes : int
        Independent axes that share D: 3 for the mean D_R or D_T, 2 or 1 for a principal value.
    noise : {"joint", "known"}
        Whether s has to be found along with D.

    Returns
    -------
    float
        Standard error of D over D.

    Raises
    ------
    ValueError
        For values out of range.

    Notes
    -----
    The covariance of the steps has the eigenvalues 2 D dt + 2 s (1 - cos(k pi/N)), k = 1..N-1; the
    Fisher information of D and s is half the sum over k of products of their logarithmic slopes.

    Examples
    --------
    >>> round(100 * cramer_rao(n_frames=300, snr=1), 2)
    10.0
    >>> round(100 * cramer_rao(n_frames=300, snr=1, noise="known"), 2)
    7.62
    """
    require_positive(snr=snr, axes=axes)
    if n_frames < 3 or noise not in ("joint", "known"):
        raise ValueError(
            f'expected n_frames >= 3 and noise "joint" or "known", got {n_frames!r}, {noise!r}'
        )
    tilt = 2 * (1 - np.cos(np.pi * np.arange(1, n_frames) / n_frames)) / snr
    by_D, by_s = 2 / (2 + tilt), tilt / (2 + tilt)
    information = axes / 2 * float(by_D @ by_D)
    if noise == "joint":
        information -= axes / 2 * float(by_D @ by_s) ** 2 / float(by_s @ by_s)
    return float(information**-0.5)
