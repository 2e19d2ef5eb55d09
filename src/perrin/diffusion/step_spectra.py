"""Autocovariance of the steps of stationary motions, and their variance by sine mode."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from perrin._arrays import Floats


def fractional_mean_square(lag: Floats, alpha: Floats | float, *, exposure: float = 0.0) -> Floats:
    """Return the mean square displacement of fractional Brownian motion along one axis, D = 1.

    It is 2 t^alpha. A shutter that is open for a part f of the frame time averages the path over
    that part; for t >= f the mean square difference of two such averages is
    2 [(|t + f|^b + |t - f|^b - 2 t^b)/f^2 - 2 f^alpha]/((alpha + 1) b), b = alpha + 2.

    Parameters
    ----------
    lag : ndarray
        Lag in frames, 0 or at least `exposure`.
    alpha : float or ndarray
        Exponent, 0 < alpha < 2; broadcast against `lag`.
    exposure : float
        Open fraction f of the frame time, 0 to 1.

    Returns
    -------
    ndarray

    Examples
    --------
    >>> fractional_mean_square(np.array([0.0, 1, 4]), 0.5)
    array([0., 2., 4.])
    """
    if exposure == 0:
        return np.asarray(2 * lag**alpha)
    f, b = exposure, alpha + 2
    outer = (lag + f) ** b + np.abs(lag - f) ** b - 2 * lag**b
    square = 2 * (outer / f**2 - 2 * f**alpha) / ((alpha + 1) * b)
    return np.where(lag == 0, 0.0, square)


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
    return step_autocovariance(fractional_mean_square(lag, a, exposure=exposure))


def fractional_slope(n_steps: int) -> Floats:
    """Return the derivative of `fractional_autocovariance` in alpha at alpha = 1, (n_steps,).

    Examples
    --------
    >>> near = fractional_autocovariance(np.array([0.999, 1.001]), 4)
    >>> bool(np.allclose((near[1] - near[0]) / 0.002, fractional_slope(4), atol=1e-5))
    True
    """
    lag = np.arange(n_steps + 1.0)
    return step_autocovariance(2 * lag * np.log(np.maximum(lag, 1.0)))


def confined_mean_square(lag: Floats, rate: Floats | float, *, exposure: float = 0.0) -> Floats:
    """Return the mean square displacement of an Ornstein-Uhlenbeck process with D = 1, one axis.

    The place relaxes to the centre of a harmonic well at the rate k; its variance is D/k and its
    mean square displacement 2 (1 - exp(-k t))/k. Averaging over an open shutter, a part f of the
    frame time, multiplies this by (sinh(x/2)/(x/2))^2, x = k f, and adds 4 f (x - sinh x)/x^3, for
    t >= f; without confinement this is 2 (t - f/3).

    Parameters
    ----------
    lag : ndarray
        Lag in frames, 0 or at least `exposure`.
    rate : float or ndarray
        Relaxation rate per frame; 0 is free diffusion. Broadcast against `lag`.
    exposure : float
        Open fraction f of the frame time, 0 to 1.

    Returns
    -------
    ndarray

    Examples
    --------
    >>> confined_mean_square(np.array([0.0, 1, 30]), 0.5).round(4)
    array([0.    , 1.5739, 4.    ])
    >>> confined_mean_square(np.array([0.0, 1.0]), 1e-9, exposure=1.0).round(6)
    array([0.      , 1.333333])
    """
    k = np.asarray(rate, dtype=np.float64)
    free = k == 0
    safe = np.where(free, 1.0, k)
    square = np.where(free, 2 * lag, -2 * np.expm1(-safe * lag) / safe)
    if exposure == 0:
        return square
    x = k * exposure
    small = x < 0.05
    far = np.where(small, 1.0, x)
    factor = np.where(small, 1 + x**2 / 12 + x**4 / 360, (np.sinh(far / 2) / (far / 2)) ** 2)
    series = -(1 + x**2 / 20 + x**4 / 840) / 6
    less = 4 * exposure * np.where(small, series, (far - np.sinh(far)) / far**3)
    return np.where(lag == 0, 0.0, factor * square + less)


def confined_autocovariance(rate: Floats | float, n_steps: int, *, exposure: float = 0.0) -> Floats:
    """Return the autocovariance of the steps of an Ornstein-Uhlenbeck process with D = 1.

    The place relaxes to the centre of a harmonic well at this rate; its variance is D/rate.

    Parameters
    ----------
    rate : float or ndarray
        Relaxation rate per frame; 0 is free diffusion.
    n_steps : int
        Number of lags, from 0.
    exposure : float
        Open fraction of the frame time, 0 to 1.

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
    return step_autocovariance(confined_mean_square(lag, k, exposure=exposure))


def step_autocovariance(square: Floats) -> Floats:
    """Return the autocovariance of steps from the mean square displacement M of one axis.

    g_m = (M(m + 1) + M(m - 1) - 2 M(m))/2 for m = 0 to N - 1, M even.

    Parameters
    ----------
    square : ndarray, shape (..., N + 1)
        M at 0 to N frames.

    Returns
    -------
    ndarray, shape (..., N)

    Examples
    --------
    >>> step_autocovariance(np.array([0.0, 2, 4, 6]))
    array([2., 0., 0.])
    """
    before = np.concatenate([square[..., 1:2], square[..., :-2]], axis=-1)
    return np.asarray(0.5 * (square[..., 1:] + before) - square[..., :-1])


def step_covariance(time: Floats, mean_square: Callable[[Floats], Floats]) -> Floats:
    """Return the covariance of the steps between any times, from the mean square displacement M.

    Steps from a to b and from c to d have covariance
    (M(|a - d|) + M(|b - c|) - M(|a - c|) - M(|b - d|))/2.

    Parameters
    ----------
    time : ndarray, shape (S + 1,)
        Times of the frames, in frame times.
    mean_square : callable
        M as a function of the lag in frame times.

    Returns
    -------
    ndarray, shape (S, S)

    Examples
    --------
    >>> step_covariance(np.array([0.0, 1, 4]), lambda lag: 2.0 * (lag > 0))  # independent places
    array([[ 2., -1.],
           [-1.,  2.]])
    """
    square = mean_square(np.abs(time[:, None] - time))
    return np.asarray(-0.5 * np.diff(np.diff(square, axis=0), axis=1))


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
