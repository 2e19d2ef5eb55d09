"""The least standard error that an estimate of D can have: the Cramér-Rao bound."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np

from perrin._arrays import choice_fault, number_fault, refuse
from perrin.diffusion.step_kernels import difference_eigenvalues

NoiseKnowledge = Literal["joint", "residual", "known"]


def cramer_rao(
    *,
    n_frames: int,
    snr: float,
    axes: int = 3,
    noise: NoiseKnowledge = "joint",
    exposure: float | None = None,
    residual_dof: int = 6,
) -> float:
    """Return the least relative standard error that any unbiased estimate of D can have.

    Parameters
    ----------
    n_frames : int
        Frames of one track without gaps, at least 3.
    snr : float
        D dt/s, s the noise variance of one orientation angle or centre coordinate.
    axes : {3, 2, 1}
        Independent axes that share D and s: 3 for the mean D_R or D_T, 2 or 1 for a principal
        value.
    noise : {"joint", "residual", "known"}
        Whether s is estimated from the steps together with D, is measured by the residuals of the
        rigid fits as well, or is known.
    exposure : float, optional
        Fraction of dt during which the shutter is open, 0 to 1; None as 0, no motion blur.
    residual_dof : int
        Only for "residual": degrees of freedom of one frame's residuals, 3n - 6 for n particles in
        space and 2n - 3 in the plane. The default is that of a tetrahedron.

    Returns
    -------
    float
        Standard error of D over D.

    Raises
    ------
    ValueError
        For values out of range, all of them in one message.

    Notes
    -----
    Steps have variance 2 D dt (1 - 2B) + 2 s and neighbours covariance -(s - 2 B D dt), with the
    blur coefficient B = exposure/6 (Berglund 2010). The sine transform makes that covariance
    diagonal with the eigenvalues 2 D dt + 2 (s - 2 B D dt)(1 - cos(k pi/N)), k = 1..N-1, so the
    Fisher information of ln D and ln s is half the sum over k of products of their slopes. The
    residuals of N frames, fitted to one common shape, add (N - 1) residual_dof/2 to that of ln s.

    With "joint" noise a stated exposure does not lower the bound: s - 2 B D dt is one free offset,
    whatever its parts. The exposure then only defines the s of `snr`; where it is not known, the
    bound is that of exposure 0 with D dt over the offset as `snr`.

    Examples
    --------
    >>> for noise in ("joint", "residual", "known"):
    ...     print(noise, round(100 * cramer_rao(n_frames=300, snr=1, noise=noise), 2))
    joint 10.0
    residual 7.79
    known 7.62
    """
    refuse(
        [
            *number_fault("n_frames", n_frames, least=3, whole=True),
            *number_fault("snr", snr, above=0),
            *([] if axes in (1, 2, 3) else choice_fault("axes", axes, (1, 2, 3))),
            *choice_fault("noise", noise, get_args(NoiseKnowledge)),
            *([] if exposure is None else number_fault("exposure", exposure, least=0, most=1)),
            *number_fault("residual_dof", residual_dof, least=1, whole=True),
        ]
    )
    blur = (exposure or 0.0) / 3
    # The summands are periodic in k and smooth over about sqrt(snr) radian. The trapezoidal rule is
    # then exact to rounding with far fewer than N nodes; with all N of them it is the sum itself.
    nodes = min(n_frames, int(1000 + 30 / np.sqrt(snr)))
    bend = np.concatenate([[0.0], difference_eigenvalues(nodes - 1), [2.0]])
    share = n_frames / nodes
    weight = np.full(nodes + 1, share)
    weight[[0, -1]] = (share - 1) / 2
    eigenvalue = 1 + (1 / snr - blur) * bend  # over 2 D dt
    by_D, by_s = (1 - blur * bend) / eigenvalue, bend / (snr * eigenvalue)
    information = axes / 2 * float(weight @ by_D**2)
    if noise != "known":
        about_s = axes / 2 * float(weight @ by_s**2)
        if noise == "residual":
            about_s += (n_frames - 1) * residual_dof / 2
        information -= (axes / 2 * float(weight @ (by_D * by_s))) ** 2 / about_s
    return float(information**-0.5)
