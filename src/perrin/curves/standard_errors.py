"""Standard errors of mean squares over overlapping pairs of frames of a Brownian motion."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from perrin._arrays import Floats, Ints
    from perrin.curves.grids import Frames
    from perrin.curves.pairs import ListedPairs, PairSums

# Starts of displacements are compared as whole numbers below this: exact sums of their squares.
_INTEGER_RANGE = 1 << 22


_CACHED_LAGS = 4096  # lags whose working arrays fit into the second-level cache


def relative_error(sums: PairSums, frames: Frames, value: Floats, pairs: Floats) -> Floats:
    """Return the relative standard error of a one-dimensional MSD at every lag.

    The variance of a mean of squares is twice the sum of the squared covariances of all pairs of
    displacements, over the squared number of displacements.

    Parameters
    ----------
    sums : PairSums
        Sums of the squared displacements.
    frames : Frames
        Frames that form the pairs.
    value : ndarray, shape (L,)
        The MSD, or any multiple D t + s of it; D per step and s are estimated from its first two
        lags, and their unit does not matter.
    pairs : ndarray, shape (L,)
        Number of pairs of one walker.

    Returns
    -------
    ndarray, shape (L,)
        NaN at a lag without a pair.

    Examples
    --------
    >>> from perrin.curves import Squares, pair_sums, place_frames
    >>> time, piece, here = np.arange(101.0), np.zeros(101, dtype=int), np.ones(101, dtype=bool)
    >>> walk = np.random.default_rng(1).normal(size=(101, 1, 1)).cumsum(axis=0)
    >>> frames = place_frames(time, piece, here, dt=1.0)
    >>> sums = pair_sums(Squares(walk), frames)
    >>> error = relative_error(sums, frames, sums.mean[:, 0], sums.pairs)
    >>> bool(abs(error[0] - np.sqrt(2 / 100)) < 1e-3)  # 100 independent squares
    True
    """
    lengths = frames.lengths
    if len(lengths) == 1 and sums.listed is None and frames.exact:
        longest = int(lengths[0])
        if pairs[0] == longest:  # all pairs of neighbours: no frame is missing
            whole = (longest + 1.0) - pairs
            d, s = two_lag_fit(whole, value, pairs)
            if not d + s > 0:
                return np.full_like(value, np.nan)
            relative = lag_covariance(whole, longest, present=None, D=d, s=s)
            np.sqrt(relative, out=relative)
            whole *= d * 2**0.5
            whole += s * 2**0.5
            whole *= pairs
            relative /= whole
            return relative
    lag = sums.lagtime / frames.step
    d, s = two_lag_fit(lag, value, pairs)
    total = np.zeros_like(lag)
    blocks = [
        (int(n), int(k)) for n, k in zip(*np.unique(lengths, return_counts=True), strict=True)
    ]
    for begin in range(0, len(lag), _CACHED_LAGS):
        part = slice(begin, begin + _CACHED_LAGS)
        steps, number = np.maximum(np.rint(lag[part]), 1.0), pairs[part]
        share = np.zeros_like(steps)
        np.divide(sums.on_grid[part], sums.pairs[part], out=share, where=sums.pairs[part] > 0)
        on_grid = share * number
        complete = displacement_counts(lengths, steps)
        known = (on_grid > 0) & (complete > 0)
        present = np.sqrt(np.where(known, on_grid / np.maximum(complete, 1), 1.0))
        for length, times in blocks:
            use = np.flatnonzero((steps <= length) & (on_grid > 0))
            own = lag_covariance(steps[use], length, present=present[use], D=d, s=s)
            total[part][use] += times * own * present[use] ** 4
    if sums.listed is not None:
        # Displacements of length l that begin a time a apart share l - a; with a common first or
        # last frame the noise s is shared too, and where one ends at the other's beginning it
        # counts once.
        listed = sums.listed
        count = np.bincount(listed.lag, minlength=len(lag)).astype(np.float64)
        total += count * (2 * d * lag + 2 * s) ** 2
        total += 2 * (2 * d) ** 2 * squared_shared_times(listed, frames, lag)
        for ends in (listed.first, listed.last):
            common = common_frames(listed.lag, ends, ends, n_lags=len(lag)) - count
            total += common * (4 * d * lag * s + s * s)
        chained = common_frames(listed.lag, listed.last, listed.first, n_lags=len(lag))
        total += 2 * chained * s * s
    mean = 2 * (d * lag + s)
    relative = np.full_like(value, np.nan)
    good = (pairs > 0) & (mean > 0)
    np.divide(np.sqrt(2 * total), pairs * mean, out=relative, where=good)
    return relative


def two_lag_fit(lag: Floats, half: Floats, pairs: Floats | Ints) -> tuple[float, float]:
    """Return D per step and s of half an MSD, D t + s, from its first two lags, neither negative.

    Parameters
    ----------
    lag : ndarray, shape (L,)
        Lags in steps.
    half : ndarray, shape (L,)
        Half of the MSD.
    pairs : ndarray, shape (L,)
        Number of pairs at each lag; lags without a pair are skipped.

    Returns
    -------
    D, s : float

    Examples
    --------
    >>> two_lag_fit(np.array([1.0, 2.0]), np.array([0.75, 1.25]), np.array([9, 8]))
    (0.5, 0.25)
    """
    if len(pairs) > 1 and pairs[0] > 0 and pairs[1] > 0:
        first, second = 0, 1
    else:
        good = pairs > 0
        first = second = int(np.argmax(good))
        if good[first + 1 :].any():
            second += 1 + int(np.argmax(good[first + 1 :]))
    rise = (half[second] - half[first]) / max(lag[second] - lag[first], 1e-9)
    d = min(max(rise, 0.0), half[first] / lag[first])
    return float(d), float(half[first] - d * lag[first])


def displacement_counts(lengths: Ints, lag: Floats) -> Floats:
    """Return how many displacements of each lag fit into blocks without missing frames.

    Parameters
    ----------
    lengths : ndarray of int, shape (B,)
        Steps from the first to the last frame of each block.
    lag : ndarray, shape (L,)
        Lags in steps.

    Returns
    -------
    ndarray, shape (L,)

    Examples
    --------
    >>> displacement_counts(np.array([3, 5]), np.array([1.0, 4.0]))
    array([8., 2.])
    """
    rising = np.sort(lengths)
    left = np.append(np.cumsum(rising[::-1])[::-1], 0)
    shorter = np.searchsorted(rising, lag - 0.5)
    return np.asarray(left[shorter] + (len(rising) - shorter) * (1 - lag))


def common_frames(bins: Ints, one: Ints, other: Ints, *, n_lags: int) -> Floats:
    """Return how many pairs of displacements of one bin have a frame in common.

    Parameters
    ----------
    bins : ndarray of int, shape (P,)
        Bin of every displacement.
    one, other : ndarray of int, shape (P,)
        First or last frame of every displacement: the ends that are compared.
    n_lags : int
        Number of bins.

    Returns
    -------
    ndarray, shape (n_lags,)
        A displacement and itself count where both ends are the same.

    Examples
    --------
    >>> common_frames(np.array([0, 0, 1]), np.array([1, 2, 3]), np.array([0, 1, 2]), n_lags=2)
    array([1., 0.])
    """
    size = int(max(one.max(initial=0), other.max(initial=0))) + 1
    rising = np.sort(bins * size + other)
    wanted = bins * size + one
    found = np.searchsorted(rising, wanted, side="right") - np.searchsorted(rising, wanted)
    counted = np.bincount(bins, found.astype(np.float64), minlength=n_lags)
    return np.asarray(counted, dtype=np.float64)


def squared_shared_times(pairs: ListedPairs, frames: Frames, lag: Floats) -> Floats:
    """Return the sum of (shared time)^2 over pairs of displacements of a bin, each pair once.

    Displacements are divided into groups that have no time in common. Their starts become whole
    numbers, so that differences of cumulative sums of squares are exact, modulo 2^64.

    Parameters
    ----------
    pairs : ListedPairs
        Displacements in order of lag and first frame.
    frames : Frames
        Frames that form the pairs.
    lag : ndarray, shape (L,)
        Lags in steps.

    Returns
    -------
    ndarray, shape (L,)
        Sum for each lag, steps squared.

    Examples
    --------
    >>> from perrin.curves import ListedPairs, place_frames
    >>> time, piece, here = np.arange(4.0), np.zeros(4, dtype=int), np.ones(4, dtype=bool)
    >>> frames = place_frames(time, piece, here, dt=1.0)
    >>> pairs = ListedPairs(np.zeros(2, dtype=int), np.array([0, 1]), np.array([2, 3]))
    >>> squared_shared_times(pairs, frames, np.array([2.0])).round(6)  # from 1 to 2
    array([1.])
    """
    start = frames.time[pairs.first] / frames.step
    length = lag[pairs.lag]
    fresh = np.append(True, np.diff(start) >= length[1:])
    fresh |= np.append(True, np.diff(pairs.lag) > 0)
    fresh |= np.append(True, np.diff(frames.piece[pairs.first]) > 0)
    cluster = np.cumsum(fresh) - 1
    start = start - start[fresh][cluster]
    extent = np.zeros(len(lag))
    np.maximum.at(extent, pairs.lag, start)
    scale = _INTEGER_RANGE / np.maximum(extent, lag)
    a = np.rint(start * scale[pairs.lag]).astype(np.int64)
    whole = np.rint(length * scale[pairs.lag]).astype(np.int64)
    key = cluster * (4 * _INTEGER_RANGE) + a
    begin = np.searchsorted(key, key - whole, side="right")
    here = np.arange(len(a))
    once, twice = (np.append(0, np.cumsum(x)) for x in (a, a * a))
    rest = whole - a
    shared = (here - begin) * rest * rest + 2 * rest * (once[here] - once[begin])
    shared += twice[here] - twice[begin]
    square = np.bincount(pairs.lag, shared.astype(np.float64), minlength=len(lag))
    return np.asarray(square / scale**2)


def lag_covariance(
    lag: Floats, steps: int, *, present: Floats | None, D: float, s: float
) -> Floats:
    """Return S(b, b) of `covariance_polynomials` for rising lags b, without polynomials.

    Parameters
    ----------
    lag, steps, present, D, s
        As in `covariance_polynomials`; `present` None where no frame is missing.

    Returns
    -------
    ndarray, shape (L,)

    Examples
    --------
    >>> lag_covariance(np.array([1.0, 8.0]), 10, present=None, D=0.5, s=0.0)
    array([ 10., 460.])
    """
    square, both, noise, n = 4 * D * D, 8 * D * s, 2 * s * s, float(steps + 1)
    middle = int(lag.searchsorted(0.5 * n, side="right"))
    # Up to half of the track a polynomial of b, beyond it one of the displacements q = n - b.
    near = (
        -5 / 6 * square,
        2 / 3 * n * square,
        -square / 6 - both,
        n * (square / 3 + both) - 4 * noise,
        3 * n * noise,
    )
    far = (
        11 / 6 * square,
        -8 / 3 * n * square,
        (n * n - 5 / 6) * square - both,
        n * (2 / 3 * square + both) + 2 * noise,
        0.0,
    )
    total = np.empty_like(lag)
    for value, x, coefficients in (
        (total[:middle], lag[:middle], near),
        (total[middle:], n - lag[middle:], far),
    ):
        np.multiply(x, coefficients[0], out=value)
        for coefficient in coefficients[1:-1]:
            value += coefficient
            value *= x
        value += coefficients[-1]
    if present is None:
        return total
    gap, b, p = 1 / present - 1, lag, n - lag
    total += gap * (p * b * (both + 2 * square * b) + noise * np.maximum(2 * p - b, p))
    same = (gap * gap + 2 * gap) * (2 * D * b + 2 * s) ** 2 - 2 * gap * (2 * D * b + s) ** 2
    total += p * same
    return total


def covariance_polynomials(
    lag: Floats, steps: int, *, present: Floats, D: float, s: float
) -> tuple[Floats, Floats, Floats]:
    """Return the covariance of an MSD at two lags as polynomials of the shorter lag.

    One-dimensional displacements over a and b >= a frames of which j are shared have covariance
    2 D j, + s for a common first or last frame, - s where one ends at the other's beginning. The
    covariance of their mean squares is 2 S(a, b) over the displacements of a track without gaps,
    steps + 1 - a and steps + 1 - b. S sums the squared covariances over all pairs of displacements;
    where frames are missing at random, those that share one or both frames weigh more, since they
    are missing together.

    Parameters
    ----------
    lag : ndarray, shape (L,)
        The longer lags b, frames.
    steps : int
        Steps of the track.
    present : ndarray, shape (L,)
        Fraction of the frames that is present, from 0 to 1: the root of that of the displacements.
    D, s : float
        Diffusion coefficient times dt, and variance of one coordinate from noise.

    Returns
    -------
    near, far : ndarray, shape (5, L)
        Coefficients of a^0 .. a^4 in S(a, b), for a <= steps + 1 - b and for longer a.
    same : ndarray, shape (L,)
        Term that is added where a = b.

    Examples
    --------
    >>> near, far, same = covariance_polynomials(
    ...     np.array([1.0]), 10, present=np.ones(1), D=0.5, s=0.0
    ... )
    >>> float(near.sum() + same[0])  # a = b = 1: ten independent squares, each of variance 1
    10.0
    """
    b, p = lag, steps + 1 - lag
    gap, zero = 1 / present - 1, np.zeros_like(lag)
    squares, noise, cross = 4 * D * D, 2 * s * s, 8 * D * s * p * (1 + gap)
    near = squares * np.stack([zero, p / 3, p * b + 1 / 6, -p / 3, zero - 1 / 6])
    near[:2] += 2 * noise * p * (1 + gap), cross - noise * (1 + gap)
    once, twice = p * (p - 1) / 2, p * (p * p - 1) / 3
    far = squares * np.stack([p * twice / 2, -2 * twice, p * (b + 1) + 2 * once, -p, zero])
    far[:2] += noise * p * (1 + gap), cross
    for polynomial in (near, far):
        polynomial[2] += 2 * squares * p * gap
    same = (gap * gap + 2 * gap) * (2 * D * b + 2 * s) ** 2 - 2 * gap * (2 * D * b + s) ** 2
    return near, far, p * (noise + same)
