"""How well D could be known at best: the Cramér-Rao bound."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np

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
        Whether s has to be found from the steps along with D, is measured besides by the residuals
        of the rigid fits, or is known.
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

    With "joint" noise a stated exposure buys nothing here: s - 2 B D dt is one free offset, and
    which name it has does not matter to D. The exposure then only says which truth `snr` belongs
    to; where it is not known, the bound is that of exposure 0 with D dt over the offset as `snr`.

    Examples
    --------
    >>> for noise in ("joint", "residual", "known"):
    ...     print(noise, round(100 * cramer_rao(n_frames=300, snr=1, noise=noise), 2))
    joint 10.0
    residual 7.79
    known 7.62
    """
    _check(n_frames, snr, axes, noise, exposure, residual_dof)
    blur = (exposure or 0.0) / 3
    bend, weight = _spectrum(n_frames, snr)
    eigenvalue = 1 + (1 / snr - blur) * bend  # over 2 D dt
    by_D, by_s = (1 - blur * bend) / eigenvalue, bend / (snr * eigenvalue)
    information = axes / 2 * float(weight @ by_D**2)
    if noise != "known":
        about_s = axes / 2 * float(weight @ by_s**2)
        if noise == "residual":
            about_s += (n_frames - 1) * residual_dof / 2
        information -= (axes / 2 * float(weight @ (by_D * by_s))) ** 2 / about_s
    return float(information**-0.5)


def _spectrum(n_frames: int, snr: float) -> tuple[np.ndarray, np.ndarray]:
    """Return 1 - cos(k pi/N) and the weights with which sums over it are those over k = 1..N-1.

    The summands are periodic and smooth over about sqrt(snr) radian. The trapezoidal rule is then
    exact to rounding with far fewer than N nodes; with all N of them it is the sum itself.
    """
    nodes = min(n_frames, int(1000 + 30 / np.sqrt(snr)))
    share = n_frames / nodes
    weight = np.full(nodes + 1, share)
    weight[[0, -1]] = (share - 1) / 2
    return 1 - np.cos(np.pi * np.arange(nodes + 1) / nodes), weight


def _check(
    n_frames: int, snr: float, axes: int, noise: str, exposure: float | None, residual_dof: int
) -> None:
    """Refuse values out of range, all in one message."""
    offered = get_args(NoiseKnowledge)
    sound = {
        f"n_frames: a whole number >= 3, got {n_frames!r}": whole(n_frames, least=3),
        f"snr: a finite number > 0, got {snr!r}": np.ndim(snr) == 0 and 0 < snr < np.inf,
        f"axes: 1, 2 or 3, got {axes!r}": axes in (1, 2, 3),
        f"noise: {' or '.join(map(repr, offered))}, got {noise!r}": noise in offered,
        f"exposure: None or 0 to 1, got {exposure!r}": exposure is None or 0 <= exposure <= 1,
        f"residual_dof: a whole number >= 1, got {residual_dof!r}": whole(residual_dof, least=1),
    }
    faults = [said for said, right in sound.items() if not right]
    if faults:
        raise ValueError("expected " + "; ".join(faults))


def whole(value: object, *, least: int) -> bool:
    """Return whether a value is a whole number of at least so much."""
    number = isinstance(value, int | np.integer) and not isinstance(value, bool)
    return number and bool(value >= least)  # type: ignore[operator]
