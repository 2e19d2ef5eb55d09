"""Autocovariance of the steps of stationary motions, and their variance by sine mode."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from perrin._arrays import Floats


def fractional_autocovariance(
    alpha: Floats | float, n_steps: int, *, exposure: float = 0.0
) -> Floats:
    """Return the autocovariance of fractional Brownian steps for D = 1 and a frame time of 1.

    The displacement over m frames has variance 2 m^alpha along each axis, so that
    g_m = |m + 1|^alpha + |m - 1|^alpha - 2 |m|^alpha. A shutter that is open for a part of the
    frame time averages the path over that part, which replaces 2 m^alpha by the mean square
    difference of two such averages.

    Parameters
    ----------
    alpha : float or ndarray
        Exponent of the mean squared displacement, 0 < alpha < 2.
    n_steps : int
        Number of lags, from 0.
    exposure : float
        Open fraction of the frame time, 0 to 1.

    Returns
    -------
    ndarray, shape (..., n_steps)

    Examples
    --------
    >>> fractional_autocovariance(1.0, 3)
    array([2., 0., 0.])
    >>> blurred = fractional_autocovariance(1.0, 3, exposure=1.0)  # Berglund 2010
    >>> bool(np.allclose(blurred, [4 / 3, 1 / 3, 0]))
    True
    """
    a = np.asarray(alpha, dtype=np.float64)[..., None]
    lag = np.arange(n_steps + 1.0)
    if exposure == 0:
        square = 2 * lag**a
    else:
        f, b = exposure, a + 2
        outer = (lag + f) ** b + np.abs(lag - f) ** b - 2 * lag**b
        square = 2 * (outer / (f * f * (a + 1) * b) - 2 * f**a / ((a + 1) * b))
        square[..., 0] = 0.0
    return _second_difference(square)


def fractional_slope(n_steps: int) -> Floats:
    """Return the derivative of `fractional_autocovariance` in alpha at alpha = 1, (n_steps,).

    Examples
    --------
    >>> near = fractional_autocovariance(np.array([0.999, 1.001]), 4)
    >>> bool(np.allclose((near[1] - near[0]) / 0.002, fractional_slope(4), atol=1e-5))
    True
    """
    lag = np.arange(n_steps + 1.0)
    return _second_difference(2 * lag * np.log(np.maximum(lag, 1.0)))


def confined_autocovariance(rate: Floats | float, n_steps: int) -> Floats:
    """Return the autocovariance of the steps of an Ornstein-Uhlenbeck process with D = 1.

    The place relaxes to the centre of a harmonic well at this rate; its variance is D/rate.

    Parameters
    ----------
    rate : float or ndarray
        Relaxation rate per frame; 0 is free diffusion.
    n_steps : int
        Number of lags, from 0.

    Returns
    -------
    ndarray, shape (..., n_steps)

    Examples
    --------
    >>> confined_autocovariance(0.0, 3)
    array([2., 0., 0.])
    >>> confined_autocovariance(1.0, 2).round(4)
    array([ 1.2642, -0.3996])
    """
    k = np.asarray(rate, dtype=np.float64)[..., None]
    lag = np.arange(n_steps + 1.0)
    free = k == 0
    safe = np.where(free, 1.0, k)
    return _second_difference(np.where(free, 2 * lag, -2 * np.expm1(-safe * lag) / safe))


def _second_difference(square: Floats) -> Floats:
    """Return (M(m + 1) + M(m - 1) - 2 M(m))/2 of an even mean squared displacement M."""
    before = np.concatenate([square[..., 1:2], square[..., :-2]], axis=-1)
    return np.asarray(0.5 * (square[..., 1:] + before) - square[..., :-1])


def sine_spectrum(autocovariance: Floats) -> Floats:
    """Return the variances of the sine modes of N steps with this autocovariance.

    They are the diagonal of S C S, S the orthogonal sine transform (DST-I) and C the Toeplitz
    matrix of the autocovariance g: sigma_k = g_0 + 2/(N + 1) sum_m g_m [(N - m) cos(m w_k) +
    sin((m + 1) w_k)/sin w_k], w_k = k pi/(N + 1). For Brownian steps with noise C is diagonal in
    these modes; for others the elements off the diagonal are small.

    Parameters
    ----------
    autocovariance : ndarray, shape (..., N)
        g_0 to g_{N-1}.

    Returns
    -------
    ndarray, shape (..., N)

    Examples
    --------
    >>> sine_spectrum(np.array([2.0, -1.0, 0.0])).round(6)  # 2 (1 - cos w)
    array([0.585786, 2.      , 3.414214])
    """
    g = np.asarray(autocovariance, dtype=np.float64)
    n = g.shape[-1]
    m = np.arange(1, n)
    w = np.pi * np.arange(1, n + 1) / (n + 1)
    even = np.zeros((*g.shape[:-1], 2 * (n + 1)))
    odd = even.copy()
    even[..., 1:n] = (n - m) * g[..., 1:]
    odd[..., 2 : n + 1] = g[..., 1:]
    cosines = np.fft.rfft(even)[..., 1 : n + 1].real
    sines = -np.fft.rfft(odd)[..., 1 : n + 1].imag
    return np.asarray(g[..., :1] + 2 / (n + 1) * (cosines + sines / np.sin(w)))
