"""Errors of orientation correlations of a track, from the law of Brownian rotation on SO(3)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from perrin.curves.standard_errors import displacement_counts

if TYPE_CHECKING:
    from collections.abc import Sequence

    from perrin._arrays import Floats, Ints

_ERROR_LAGS = 32  # lags at which the error is computed; it is interpolated between them
_SLOPE_LAGS = 12  # lags of the line through the logarithm of a correlation


def product_weights(directions: Floats, *, degrees: tuple[int, int]) -> Floats:
    """Return the weights w_L of <f_l f_m> = sum_L w_L exp(-L(L + 1) D t) of one rotation.

    f_l is the mean over directions p of P_l(p . R p), R a Brownian rotation during t. The product
    of two such functions, averaged over the axis of R, is a sum of the characters
    sin((L + 1/2)a)/sin(a/2) of its angle a (Clebsch-Gordan series), whose means decay as
    (2L + 1) exp(-L(L + 1) D t).

    Parameters
    ----------
    directions : ndarray, shape (K, 3)
        Directions in body axes, of any length.
    degrees : tuple of int
        Degrees l and m of the two functions.

    Returns
    -------
    ndarray, shape (l + m + 1,)
        Their sum is 1.

    Examples
    --------
    >>> product_weights(np.eye(3)[:1], degrees=(2, 2)).round(9)  # P_2^2 = 1/5 + 2/7 P_2 + 18/35 P_4
    array([0.2       , 0.        , 0.28571429, 0.        , 0.51428571])
    >>> (9 * product_weights(np.eye(3), degrees=(1, 1))).round(9)  # all directions: 2L + 1
    array([1., 3., 5.])
    """
    p = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    # A product rule on the sphere, exact to the degree 8 that occurs.
    height, weight = np.polynomial.legendre.leggauss(6)
    phase = 2 * np.pi * np.arange(12) / 12
    ring = np.stack([np.cos(phase), np.sin(phase)], axis=-1)[None]
    axis = np.concatenate(
        [
            np.sqrt(1 - height * height)[:, None, None] * ring,
            np.broadcast_to(height[:, None, None], (6, 12, 1)),
        ],
        axis=-1,
    ).reshape(-1, 3)
    weight = np.repeat(weight / 24, 12)
    angle = np.pi * (np.arange(2 * sum(degrees) + 2) + 0.5) / (2 * sum(degrees) + 2)
    along = (axis @ p.T) ** 2
    cosine = np.cos(angle)[:, None, None] * (1 - along) + along
    means = [(cosine if n == 1 else 1.5 * cosine**2 - 0.5).mean(axis=-1) for n in degrees]
    mean = (means[0] * means[1]) @ weight
    order = np.arange(sum(degrees) + 1)
    character = np.sin((order + 0.5) * angle[:, None]) / np.sin(angle / 2)[:, None]
    return np.asarray(np.linalg.lstsq(character / (2 * order + 1), mean, rcond=None)[0])


# Covariances below exp(-45) of the largest one are not summed.
_NO_COVARIANCE = 45.0


def correlation_covariance(
    lags: tuple[Floats, Floats],
    *,
    degrees: tuple[int, int],
    weights: Floats,
    blocks: Sequence[int],
    present: tuple[Floats, Floats],
    D: float,
    s: float,
) -> Floats:
    """Return the covariance of two correlations of one track, whose noise is not corrected for.

    Two pairs of frames whose intervals share no time are independent for an isotropic rotor.
    Where they share the rotation during j, the parts that are not shared are averaged separately:
    the covariance is exp(-l(l+1)(a - h)) exp(-m(m+1)(b - h)) [<f_l f_m>(h) - <f_l>(h) <f_m>(h)]
    with a and b the whole of each pair in units of D t, and h the part that is shared. The noise
    adds s to a and b, and s/2 to h for every frame that is shared.

    Parameters
    ----------
    lags : tuple of ndarray, shapes (A,) and (B,)
        Lags of the two curves, steps.
    degrees : tuple of int
        Degrees l and m of the two curves.
    weights : ndarray, shape (l + m + 1,)
        Weights of both curves' directions, from `product_weights`.
    blocks : sequence of int
        Steps of each stretch of frames.
    present : tuple of ndarray, shapes (A,) and (B,)
        Fraction of the frames that is present, from the number of pairs at each lag.
    D, s : float
        Rotational diffusion coefficient times the step, and noise variance of one orientation.

    Returns
    -------
    ndarray, shape (A, B)

    Examples
    --------
    >>> lag, one = np.array([1.0]), np.ones(1)
    >>> variance = correlation_covariance(
    ...     (lag, lag), degrees=(1, 1), weights=product_weights(np.eye(3), degrees=(1, 1)),
    ...     blocks=[100], present=(one, one), D=9.0, s=0.0,
    ... )
    >>> round(900 * float(variance[0, 0]), 6)  # a hundred uniform rotations: 1/9 each
    1.0
    """
    first, second = (n * (n + 1) for n in degrees)
    weights = np.where(np.abs(weights) > 1e-12, weights, 0.0)
    lengths, times = np.unique(np.asarray(blocks, dtype=np.int64), return_counts=True)
    covariance, b = np.zeros((len(lags[0]), len(lags[1]))), lags[1][:, None]
    reach = _NO_COVARIANCE / max((first + second) * D, 1e-12)
    for i, a in enumerate(lags[0]):
        # Start of the second pair less that of the first, wherever they share time or a frame, and
        # the rotation during what they do not share has left a correlation.
        earliest = max(np.floor(-b.max()), np.floor(min(a - b.max(), 0.0) - reach))
        latest = min(np.ceil(a), np.ceil(max(a - b.min(), 0.0) + reach))
        shift = np.arange(earliest, latest + 1)
        overlap = np.maximum(np.minimum(a, b + shift) - np.maximum(0.0, shift), 0.0)
        h = D * overlap
        # The shifts at which the two pairs share a frame, and how many.
        places = np.stack([0 * b, a - b, a + 0 * b, -b])[..., 0] - earliest
        whole = np.rint(places).astype(np.int64)
        inside = (whole >= 0) & (whole < len(shift)) & (np.abs(places - whole) < 1e-9)
        row = np.broadcast_to(np.arange(len(b)), whole.shape)[inside]
        shared_frames, joint = np.unique(row * len(shift) + whole[inside], return_counts=True)
        row, place = np.divmod(shared_frames, len(shift))
        h[row, place] += 0.5 * s * joint
        shared = _shared_rotation(np.exp(-2 * h), weights=weights, alone=(first + second) // 2)
        h *= first + second
        h -= first * (D * a + s) + second * (D * b + s)
        term = np.exp(h, out=h)
        term *= shared
        term[row, place] *= np.sqrt(present[0][i] * present[1][row]) ** (-1.0 * joint)
        total, pairs = np.zeros(len(b)), np.zeros((2, len(b)))
        for length, count in zip(lengths, times, strict=True):
            n, m = max(length + 1 - a, 0.0), np.maximum(length + 1 - b, 0.0)
            starts = np.minimum(n, m - shift) - np.maximum(0.0, -shift)
            total += count * np.sum(np.maximum(starts, 0.0) * term, axis=1)
            pairs += count * np.array([np.full(len(b), n), m[:, 0]])
        product = pairs[0] * pairs[1]
        covariance[i] = np.divide(total, product, out=np.full(len(b), np.inf), where=product > 0)
    return covariance


def _shared_rotation(once: Floats, *, weights: Floats, alone: int) -> Floats:
    """Return sum_L w_L exp(-L(L + 1) h) - exp(-2 alone h), powers of `once`, exp(-2 h)."""
    power = {0: np.ones(1), 1: once}
    for k, (p, q) in {2: (1, 1), 3: (2, 1), 4: (2, 2), 6: (3, 3), 10: (6, 4)}.items():
        if k <= max(alone, len(weights) * (len(weights) - 1) // 2):
            power[k] = power[p] * power[q]
    shared = np.negative(power[alone])
    for order, w in enumerate(weights):
        if w:
            shared = shared + w * power[order * (order + 1) // 2]
    return np.asarray(shared)


def correlation_variances(
    lag: Ints,
    *,
    degree: int,
    weights: Floats,
    blocks: Sequence[int],
    present: Floats,
    D: float,
    s: float,
) -> Floats:
    """Return the diagonal of `correlation_covariance` of one curve, at lags of whole steps.

    The factors of a term depend on the shift, and on the lag less the shift: each is computed once
    for all lags.

    Parameters
    ----------
    lag : ndarray of int, shape (A,)
        Lags, steps.
    degree : int
        Degree of the curve.
    weights, blocks, present, D, s
        As in `correlation_covariance`.

    Returns
    -------
    ndarray, shape (A,)

    Examples
    --------
    >>> weights, lag = product_weights(np.eye(3), degrees=(1, 1)), np.array([1])
    >>> correlation_variances(
    ...     lag, degree=1, weights=weights, blocks=[100], present=np.ones(1), D=9.0, s=0.0
    ... ).round(6)  # a hundred uniform rotations: 1/9 each
    array([0.001111])
    """
    rate = 2 * degree * (degree + 1)
    weights = np.where(np.abs(weights) > 1e-12, weights, 0.0)
    lengths, times = np.unique(np.asarray(blocks, dtype=np.int64), return_counts=True)
    reach = int(min(np.ceil(_NO_COVARIANCE / max(rate * D, 1e-12)), lag.max()))
    shift = np.arange(1.0, reach + 1)
    fall = 2 * np.exp(-rate * (D * shift + s))
    longest = int(lag.max())
    # What h of each whole number of steps shares, and that of both frames, and of one, shared.
    h = D * np.arange(longest + 1.0)
    once = np.exp(-2 * np.concatenate([h, D * lag + s, [0.5 * s]]))
    shared = _shared_rotation(once, weights=weights, alone=rate // 2)
    together, one_frame = shared[longest + 1 : -1], shared[-1]
    variance = np.full(len(lag), np.inf)
    for i, a in enumerate(lag.tolist()):
        last = min(a - 1, reach)
        terms = fall[:last] * shared[a - last : a][::-1]
        end = 2 * np.exp(-rate * (D * a + 0.5 * s)) * one_frame / present[i] if a <= reach else 0.0
        total, pairs = 0.0, 0.0
        for length, count in zip(lengths.tolist(), times.tolist(), strict=True):
            n = max(length + 1 - a, 0)
            inside = min(last, n)
            total += count * float((n - shift[:inside]) @ terms[:inside])
            total += count * (n * together[i] / present[i] ** 2 + max(n - a, 0) * end)
            pairs += count * n
        if pairs:
            variance[i] = total / pairs**2
    return variance


def brownian_decay(lag: Floats, value: Floats, *, degree: int) -> tuple[float, float]:
    """Return D per step and the noise variance s of a correlation exp(-l(l + 1)(D t + s)).

    A line through the logarithm, up to the lag where the correlation has fallen to 1/e of its
    first value, or to a quarter of the lags.

    Parameters
    ----------
    lag, value : ndarray, shape (L,)
        Lags in steps, and the correlation, not corrected for noise, NaN where there is no pair.
    degree : int
        Degree l of the correlation.

    Returns
    -------
    D, s : float
        Neither is negative.

    Examples
    --------
    >>> lag = np.arange(1.0, 100.0)
    >>> D, s = brownian_decay(lag, np.exp(-2 * (0.01 * lag + 0.002)), degree=1)
    >>> round(D, 6), round(s, 6)
    (0.01, 0.002)
    """
    rate = degree * (degree + 1)
    good = np.flatnonzero(np.isfinite(value))
    if not good.size or value[good[0]] <= 0:
        return 1.0, 0.0  # uncorrelated after one step
    if good.size < len(lag):
        lag, value = lag[good], value[good]
    below = np.flatnonzero(value < value[0] * np.exp(-1))
    quarter = max(int(np.searchsorted(lag, 0.25 * lag[-1], side="right")), 1)
    end = max(min(int(below[0]) if below.size else quarter, quarter), 1)
    use = np.unique(np.linspace(0, end - 1, _SLOPE_LAGS).astype(int))
    if len(use) < 2:
        return float(-np.log(np.clip(value[0], 1e-9, 1)) / (rate * lag[0])), 0.0
    x, y = lag[use], -np.log(value[use]) / rate
    slope = max(float(np.polyfit(x, y, 1)[0]), 0.0)
    return slope, max(float(y[0] - slope * x[0]), 0.0)


def frames_present(
    lag: Floats, pairs: Ints | Floats, blocks: Sequence[int]
) -> tuple[tuple[int, ...], Floats]:
    """Return the stretches of frames of a curve, and the fraction that is present at each lag.

    Parameters
    ----------
    lag : ndarray, shape (L,)
        Lags in steps.
    pairs : ndarray, shape (L,)
        Number of pairs at each lag.
    blocks : sequence of int
        Steps of each stretch on a grid; where pairs join several stretches, all are one.

    Returns
    -------
    blocks : tuple of int
    present : ndarray, shape (L,)
        Root of the pairs that there are over those of complete stretches, at most 1.

    Examples
    --------
    >>> blocks, present = frames_present(np.array([1.0, 2.0]), np.array([9, 2]), [9])
    >>> blocks, present.round(3)
    ((9,), array([1. , 0.5]))
    """
    longest = round(float(lag[-1]))
    stretches = tuple(blocks) if blocks and longest <= max(blocks) else (longest,)
    complete = displacement_counts(np.array(stretches, dtype=np.int64), lag)
    share = np.divide(pairs, complete, out=np.ones(len(lag)), where=complete > 0)
    return stretches, np.sqrt(np.clip(share, 1e-9, 1.0))


def correlation_stderr(
    lag: Floats,
    value: Floats,
    *,
    pairs: Ints,
    degree: int,
    directions: Floats,
    blocks: Sequence[int],
) -> Floats:
    """Return the standard error of an orientation correlation that is not corrected for noise.

    The error of a Brownian rotor with the decay of the curve itself, at 32 lags and interpolated
    between them.

    Parameters
    ----------
    lag, value : ndarray, shape (L,)
        Lags in steps, and the correlation, NaN where there is no pair.
    pairs : ndarray of int, shape (L,)
        Number of pairs at each lag.
    degree : int
        Degree l of the correlation.
    directions : ndarray, shape (K, 3)
        Body-fixed directions that are averaged.
    blocks : sequence of int
        Steps of each stretch of frames.

    Returns
    -------
    ndarray, shape (L,)
        NaN where there is no pair.

    Examples
    --------
    >>> lag = np.arange(1.0, 101.0)
    >>> stderr = correlation_stderr(
    ...     lag, np.exp(-0.1 * lag), pairs=np.arange(100, 0, -1), degree=1, directions=np.eye(3),
    ...     blocks=[100],
    ... )
    >>> bool(0.05 < stderr[9] < 0.15)
    True
    """
    stderr = np.full(len(lag), np.nan)
    good = np.flatnonzero(pairs > 0)
    D, s = brownian_decay(lag[good], value[good], degree=degree)
    stretches, present = frames_present(lag, pairs, blocks)
    weights = product_weights(directions, degrees=(degree, degree))
    spaced = np.geomspace(1, len(good), _ERROR_LAGS)
    use = good[np.unique(np.minimum(np.rint(spaced), len(good)).astype(int)) - 1]
    whole = np.rint(lag[use]).astype(np.int64)
    if np.all(np.abs(lag[use] - whole) < 1e-9):
        variance = correlation_variances(
            whole, degree=degree, weights=weights, blocks=stretches, present=present[use], D=D, s=s
        )
    else:
        variance = np.array(
            [
                correlation_covariance(
                    (lag[[k]], lag[[k]]),
                    degrees=(degree, degree),
                    weights=weights,
                    blocks=stretches,
                    present=(present[[k]], present[[k]]),
                    D=D,
                    s=s,
                )[0, 0]
                for k in use
            ]
        )
    error = np.sqrt(np.maximum(variance, 0.0))  # that of a body at rest may round below zero
    stderr[good] = np.interp(np.log(lag[good]), np.log(lag[use]), error)
    return stderr
