"""Sums of a quantity over all pairs of frames, by the time between the two frames."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from perrin._arrays import present
from perrin.curves.grids import GRID_TOLERANCE
from perrin.errors import PrecisionWarning, TooFewFramesError

if TYPE_CHECKING:
    from perrin._arrays import Floats, Ints
    from perrin.curves.grids import Frames

# Largest number of pairs formed one by one where frames lie on no common compact grid: all pairs
# of 1400 frames, which take a second and 200 MB.
_MOST_LISTED_PAIRS = 1_000_000

# A mean velocity is subtracted from walks of which it makes all but this share of the squares.
_REST_OF_STEADY_MOTION = 0.01

_PAIRS_IN_MEMORY = 1 << 16  # pairs whose displacements are in memory at once


class Kernel(Protocol):
    """A quantity that is summed over pairs of frames."""

    def within(self, rows: Ints, slots: Ints, count: int) -> tuple[Floats, Ints]:
        """Return sums (count, q) and pairs (count,) at lags 1 to count of rows on a grid."""

    def between(self, first: Ints, last: Ints) -> tuple[Floats, Ints]:
        """Return the quantity (P, q) and its multiplicity (P,) of pairs of rows."""


class ListedPairs(NamedTuple):
    """Pairs formed one by one, in order of lag and first frame.

    Attributes
    ----------
    lag : ndarray of int, shape (P,)
        Element of the lag axis that each pair belongs to.
    first : ndarray of int, shape (P,)
        Element of `Frames` that is the pair's first frame.
    last : ndarray of int, shape (P,)
        Element of `Frames` that is the pair's last frame.
    """

    lag: Ints
    first: Ints
    last: Ints


class PairSums(NamedTuple):
    """Sums over all pairs of frames at each lag.

    Attributes
    ----------
    lagtime : ndarray, shape (L,)
        Mean time between the frames of the pairs, s.
    sums : ndarray, shape (L, q)
        Sum of each component of the quantity over the pairs.
    pairs : ndarray of int, shape (L,)
        Number of pairs, counted as the kernel does.
    on_grid : ndarray, shape (L,)
        Number of those pairs that were summed on grids.
    listed : ListedPairs or None
        Pairs that were formed one by one.
    """

    lagtime: Floats
    sums: Floats
    pairs: Ints
    on_grid: Floats
    listed: ListedPairs | None

    @property
    def mean(self) -> Floats:
        """Mean over the pairs, shape (L, q); NaN at a lag without a pair."""
        average = np.full_like(self.sums, np.nan)
        pairs = self.pairs[:, None]
        np.divide(self.sums, pairs, out=average, where=pairs > 0)
        return average


def pair_sums(kernel: Kernel, frames: Frames, *, most: int | None = None) -> PairSums:
    """Sum a quantity over all pairs of frames of one piece, by the time between them.

    Pairs on one grid are summed by the kernel's Fourier transforms. Where a piece has several
    blocks (times off the grid, holes), its pairs are formed one by one and put into bins
    (`lag_bins`). Of more than a million pairs only those of the shortest lags are formed across
    blocks.

    Parameters
    ----------
    kernel : Kernel
        Quantity that is summed.
    frames : Frames
        Frames in their blocks.
    most : int, optional
        Number of steps of the longest lag; default all.

    Returns
    -------
    PairSums

    Raises
    ------
    TooFewFramesError
        If no two frames are in one piece.

    Warns
    -----
    PrecisionWarning
        If not all pairs across blocks are formed.

    Examples
    --------
    >>> from perrin.curves import Squares, place_frames
    >>> time, piece, here = np.arange(4.0), np.zeros(4, dtype=int), np.ones(4, dtype=bool)
    >>> walk = np.array([0.0, 1.0, 3.0, 6.0])[:, None, None]
    >>> sums = pair_sums(Squares(walk), place_frames(time, piece, here, dt=1.0))
    >>> sums.mean[:, 0].round(12), sums.pairs
    (array([ 4.66666667, 17.        , 36.        ]), array([3, 2, 1]))
    """
    pairs, complete = (None, False) if frames.separate else _pairs_one_by_one(frames)
    longest = int(frames.lengths.max())
    if frames.exact and frames.separate:
        span = round(float(np.ptp(frames.time)) / frames.step)
        longest = span if span <= frames.most_lags else longest
    longest = longest if most is None else min(longest, most)
    sums = None
    count, grid = np.zeros(longest, np.int64), np.arange(1.0, longest + 1) * frames.step
    lagtime = grid if frames.exact else grid.copy()
    for elements in [] if complete else frames.blocks:
        slot = frames.slot[elements]
        lags = min(int(slot[-1]), longest)
        if lags < 1:
            continue
        added, number = kernel.within(frames.row[elements], slot, lags)
        if sums is None and lags == longest:
            sums = added
        else:
            sums = np.zeros((longest, added.shape[1])) if sums is None else sums
            sums[:lags] += added
        del added
        if not frames.exact:
            total = count[:lags] + number
            excess = number * _mean_excess(frames.time[elements], slot, frames.step, lags)
            lagtime[:lags] += np.divide(
                excess - number * (lagtime[:lags] - grid[:lags]),
                total,
                out=np.zeros(lags),
                where=total > 0,
            )
        count[:lags] += number
    sums = np.zeros((longest, 1)) if sums is None else sums
    found = PairSums(lagtime, sums, count, count.astype(np.float64), None)
    if pairs is not None and pairs[0].size:
        found = _with_listed_pairs(found, kernel, frames, pairs, most)
    if not found.pairs.any():
        raise TooFewFramesError("no two frames in one piece: a pair needs two", 0)
    return found


def _mean_excess(time: Floats, slot: Ints, step: float, count: int) -> Floats:
    """Return by how much the times between frames exceed whole steps, mean over pairs, s.

    With m the presence and e the deviation from the grid it is
    (corr(m, e) - corr(e, m)) / corr(m, m).
    """
    size = fft_size(int(slot[-1]) + 1 + count)
    here, off = np.zeros(size), np.zeros(size)
    here[slot], off[slot] = 1.0, time - time[0] - slot * step
    m, e = np.fft.rfft(here), np.fft.rfft(off)
    excess = np.fft.irfft(np.conj(m) * e - np.conj(e) * m, size)[1 : count + 1]
    pairs = np.fft.irfft(np.abs(m) ** 2, size)[1 : count + 1]
    return np.asarray(excess / np.maximum(np.rint(pairs), 1.0))


def _pairs_one_by_one(frames: Frames) -> tuple[tuple[Ints, Ints], bool]:
    """Return pairs of elements in one piece, and whether they are all; else those across blocks."""
    _, number = np.unique(frames.piece, return_inverse=True)
    apart = 2 * (np.ptp(frames.time) + frames.step)
    t = frames.time - frames.time.min() + apart * number
    begin = np.arange(len(t)) + 1
    end = np.searchsorted(t, t + 0.5 * apart)
    complete = int((end - begin).sum()) <= _MOST_LISTED_PAIRS
    if not complete:
        begin = np.searchsorted(frames.block, frames.block, side="right")
        # The longest lag up to which no more pairs are formed than allowed, by bisection.
        low, high = 0.0, float(t[-1] - t[0])
        for _ in range(60):
            middle = 0.5 * (low + high)
            last = np.minimum(end, np.searchsorted(t, t + middle, side="right"))
            few = np.maximum(last - begin, 0).sum() <= _MOST_LISTED_PAIRS
            low, high = (middle, high) if few else (low, middle)
        bin_end = np.floor(low / frames.step - GRID_TOLERANCE) + GRID_TOLERANCE
        longest = float(bin_end * frames.step)
        if longest < frames.time[-1] - frames.time[0]:
            warnings.warn(
                f"the frames lie in {frames.block[-1] + 1} groups that share no compact grid of "
                f"times and make more than {_MOST_LISTED_PAIRS} pairs: pairs across groups are "
                f"formed up to a lag of {longest:.4g} s",
                PrecisionWarning,
                stacklevel=5,
            )
        end = np.minimum(end, np.searchsorted(t, t + longest, side="right"))
    size = np.maximum(end - begin, 0)
    first = np.repeat(np.arange(len(t)), size)
    last = np.arange(len(first)) - np.repeat(np.cumsum(size) - size - begin, size)
    return (first, last), complete


def _with_listed_pairs(
    grid: PairSums, kernel: Kernel, frames: Frames, pairs: tuple[Ints, Ints], most: int | None
) -> PairSums:
    """Add pairs formed one by one to the sums on grids; lags without a pair are left out."""
    first, last = pairs
    lag = (frames.time[last] - frames.time[first]) / frames.step
    bin_number = lag_bins(lag, longest=int(frames.lengths.max()), most=frames.most_lags)
    order = np.lexsort((first, bin_number))
    if most is not None:
        order = order[bin_number[order] <= 2 * most]
    first, last, lag, bin_number = first[order], last[order], lag[order], bin_number[order]
    on_grid = np.flatnonzero(grid.pairs)
    axis = np.union1d(2 * (on_grid + 1), bin_number)
    listed = ListedPairs(np.searchsorted(axis, bin_number), first, last)
    sums, count = None, np.zeros(len(axis), dtype=np.int64)
    for begin in range(0, len(first), _PAIRS_IN_MEMORY):
        part = slice(begin, begin + _PAIRS_IN_MEMORY)
        added, times = kernel.between(frames.row[first[part]], frames.row[last[part]])
        lags, edges = np.unique(listed.lag[part], return_index=True)
        sums = np.zeros((len(axis), added.shape[1])) if sums is None else sums
        sums[lags] += np.add.reduceat(added, edges, axis=0)
        count[lags] += np.add.reduceat(times, edges)
    sums = np.zeros((len(axis), grid.sums.shape[1])) if sums is None else sums
    weight = np.bincount(listed.lag, minlength=len(axis)).astype(np.float64)
    total = np.bincount(listed.lag, lag * frames.step, minlength=len(axis))
    mean = np.divide(total, np.maximum(weight, 1))
    within = np.zeros(len(axis))
    if on_grid.size:
        here = np.searchsorted(axis, 2 * (on_grid + 1))
        within[here] = grid.pairs[on_grid]
        sums[here] += grid.sums[on_grid]
        share = count[here] / (count[here] + within[here])
        mean[here] = share * mean[here] + (1 - share) * grid.lagtime[on_grid]
    return PairSums(mean, sums, count + within.astype(np.int64), within, listed)


def pairs_apart(time: Floats, piece: Ints, lag: float) -> tuple[Ints, Ints]:
    """Return the first and last element of all pairs of one piece that are one lag apart.

    Parameters
    ----------
    time : ndarray, shape (N,)
        Times in steps, rising within a piece.
    piece : ndarray of int, shape (N,)
        Piece of each time, sorted.
    lag : float
        Lag in steps; pairs within a tenth of a step of it are used.

    Returns
    -------
    first, last : ndarray of int, shape (P,)

    Examples
    --------
    >>> pairs_apart(np.array([0.0, 1.0, 3.0, 4.0]), np.zeros(4, dtype=int), 1.0)
    (array([0, 2]), array([1, 3]))
    """
    # Pieces are moved apart, so that the times of all of them rise.
    apart = np.ptp(time) + 2 * lag + 2
    _, number = np.unique(piece, return_inverse=True)
    t = time - time.min() + apart * number
    partner = np.searchsorted(t, t + lag - GRID_TOLERANCE)
    first = np.flatnonzero(partner < np.searchsorted(t, t + lag + GRID_TOLERANCE, side="right"))
    return first, partner[first]


def lag_bins(lag: Floats, *, longest: int, most: int) -> Ints:
    """Return the bin of every lag: 2n within a tenth of n steps, 2n + 1 from there to n + 1.

    If the lags beyond the longest on a grid occupy more than `most` bins, they share that many
    bins, evenly spaced in the logarithm.

    Parameters
    ----------
    lag : ndarray, shape (P,)
        Times between the frames of pairs, in steps.
    longest : int
        Steps of the longest lag on a grid.
    most : int
        Largest number of bins beyond it.

    Returns
    -------
    ndarray of int, shape (P,)

    Examples
    --------
    >>> lag_bins(np.array([1.0, 1.04, 1.5, 1.95]), longest=2, most=10)
    array([2, 2, 3, 4])
    """
    whole = np.rint(lag)
    near = (np.abs(lag - whole) <= GRID_TOLERANCE) & (whole >= 1)
    bins = np.where(near, 2 * whole, 2 * np.floor(lag) + 1).astype(np.int64)
    far = bins > 2 * longest + 1
    if np.unique(bins[far]).size > most:
        high = np.log(lag[far] / (longest + GRID_TOLERANCE))
        fraction = np.minimum(most * high / high.max(), most - 1).astype(np.int64)
        bins[far] = 2 * longest + 2 + fraction
    return bins


class Squares:
    """Squared differences of walks (T, K, c) by component, summed over walkers.

    Parameters
    ----------
    walks : ndarray, shape (T, K, c)
        Coordinates of K walkers; NaN where one is missing.
    """

    def __init__(self, walks: Floats) -> None:
        self.walks = walks

    def within(self, rows: Ints, slots: Ints, count: int) -> tuple[Floats, Ints]:
        """Return the sums by FFT.

        With m the presence, the sum is corr(m x^2, m) + corr(m, m x^2) - 2 corr(m x, m x); where
        every frame is present, its first two terms are sums of squares up to a frame and from a
        frame on. The mean is subtracted first: the squares of coordinates far from the origin
        would lose digits of the displacements. So would those of a fast steady motion, whose mean
        velocity v is subtracted too: over n steps (x + v n)^2 = x^2 + 2 v n x + v^2 n^2.
        """
        walks = _on_grid(self.walks, rows, slots)
        here = np.ascontiguousarray(present(walks).T)
        mask = None if here.all() else here.astype(np.float64)
        size = fft_size(len(walks) + count)
        if mask is not None:
            m = np.fft.rfft(mask, size)
        sums, last = np.empty((walks.shape[2], count)), slice(-2, -2 - count, -1)
        for total, axis in zip(sums, range(walks.shape[2]), strict=True):
            x = _centred(walks[..., axis].T, mask)
            velocity = _dominant_velocity(x, mask)
            if velocity.any():
                x = _centred(x - velocity * np.arange(len(walks)), mask)
            f = np.fft.rfft(x, size)
            if velocity.any():
                w = np.fft.rfft(velocity * here, size)
                along = np.fft.irfft(2j * (np.conj(w) * f).imag.sum(0), size)[1 : count + 1]
                squared = np.fft.irfft((w.real**2 + w.imag**2).sum(0), size)[1 : count + 1]
            # In place, and without what is not needed any more: memory that is asked for anew costs
            # as much time as the transforms.
            np.multiply(x, x, out=x)
            power = f.real**2
            power += f.imag**2
            del f
            if mask is None:
                square = x.sum(0) if len(x) > 1 else x[0]
                up_to = np.cumsum(square)
                np.copyto(total, up_to[last])
                total += np.cumsum(square[::-1], out=up_to)[last]
                power *= -1.0
                del square, up_to
            else:
                g = np.fft.rfft(x, size)
                np.subtract(m.real * g.real + m.imag * g.imag, power, out=power)
                total[:] = 0.0
            del x
            correlation = np.fft.irfft(power.sum(0) if len(power) > 1 else power[0], size)
            correlation *= 2.0
            total += correlation[1 : count + 1]
            del correlation, power
            if velocity.any():
                lag = np.arange(1.0, count + 1)
                total += 2 * lag * along + lag**2 * squared
        if mask is None:
            pairs = here.shape[0] * (len(walks) - np.arange(1, count + 1))
        else:
            present_pairs = np.fft.irfft((m.real**2 + m.imag**2).sum(0), size)[1 : count + 1]
            pairs = np.rint(present_pairs).astype(np.int64)
        sums = sums.T
        # A sum of squares that rounds below zero is zero.
        return np.maximum(sums, 0.0, out=sums), pairs

    def between(self, first: Ints, last: Ints) -> tuple[Floats, Ints]:
        """Return the squared differences of pairs."""
        square = (self.walks[last] - self.walks[first]) ** 2
        here = present(square)
        return np.where(here[..., None], square, 0.0).sum(1), here.sum(1)


def _centred(x: Floats, mask: Floats | None) -> Floats:
    """Return walks (K, T) less their means, 0 where the mask is."""
    if mask is None:
        return np.asarray(x - x.mean(1, keepdims=True))
    walk = np.where(mask > 0, x, 0.0)
    mean = walk.sum(1, keepdims=True) / np.maximum(mask.sum(1, keepdims=True), 1.0)
    return np.asarray((walk - mean) * mask)


def _dominant_velocity(x: Floats, mask: Floats | None) -> Floats:
    """Return the slope (K, 1) of walks with mean 0 where it makes most of them, else 0."""
    time = _centred(np.arange(float(x.shape[1]))[None], None)
    time = time if mask is None else _centred(np.broadcast_to(time, x.shape), mask)
    squares = np.maximum((time * time).sum(1), 1.0)
    slope = np.einsum("kt,kt->k", x, np.broadcast_to(time, x.shape)) / squares
    # By least squares, those of the walk are those of the slope and those of the rest.
    dominant = slope**2 * squares > (1 - _REST_OF_STEADY_MOTION) * np.einsum("kt,kt->k", x, x)
    return np.where(dominant, slope, 0.0)[:, None]


class Products:
    """Products of features (T, F) whose pairs (i, j) of columns are summed in groups.

    Parameters
    ----------
    features : ndarray, shape (T, F)
        Features, finite in all rows that are used.
    groups : sequence of sequence of (int, int)
        Result q is the sum of the products of column i of one frame and column j of the other,
        symmetric in the frames.
    """

    def __init__(self, features: Floats, groups: list[list[tuple[int, int]]]) -> None:
        self.features, self.groups = features, groups

    def within(self, rows: Ints, slots: Ints, count: int) -> tuple[Floats, Ints]:
        """Return the sums by FFT."""
        values = _on_grid(self.features, rows, slots)
        here = present(values)
        size = fft_size(len(values) + count)
        whole = bool(here.all())
        columns = np.ascontiguousarray(values.T)
        f = np.fft.rfft(columns if whole else np.where(here, columns, 0.0), size)
        sums = np.empty((count, len(self.groups)))
        for k, group in enumerate(self.groups):
            # The real part is the transform of the mean of a product and its reverse.
            power = sum(f[i].real * f[j].real + f[i].imag * f[j].imag for i, j in group)
            sums[:, k] = np.fft.irfft(power, size)[1 : count + 1]
        if whole:
            return sums, len(values) - np.arange(1, count + 1)
        m = np.fft.rfft(here.astype(np.float64), size)
        pairs = np.fft.irfft(m.real**2 + m.imag**2, size)[1 : count + 1]
        return sums, np.rint(pairs).astype(np.int64)

    def between(self, first: Ints, last: Ints) -> tuple[Floats, Ints]:
        """Return the products of pairs."""
        a, b = self.features[first], self.features[last]
        columns = [
            sum(0.5 * (a[:, i] * b[:, j] + a[:, j] * b[:, i]) for i, j in group)
            for group in self.groups
        ]
        return np.stack(columns, axis=1), np.ones(len(first), dtype=np.int64)


def _on_grid(values: Floats, rows: Ints, slots: Ints) -> Floats:
    """Return rows of an array at their places on a grid, NaN between them."""
    if len(slots) == slots[-1] + 1:
        follow = rows[-1] - rows[0] + 1 == len(rows) and bool((np.diff(rows) == 1).all())
        return values[rows[0] : rows[-1] + 1] if follow else values[rows]
    grid = np.full((int(slots[-1]) + 1, *values.shape[1:]), np.nan)
    grid[slots] = values[rows]
    return grid


def fft_size(least: int) -> int:
    """Return the smallest 2^a 3^b 5^c that is at least `least`: such transforms are fast.

    Examples
    --------
    >>> fft_size(97), fft_size(128)
    (100, 128)
    """
    best = 1 << (least - 1).bit_length()
    five = 1
    while five < best:
        three = five
        while three < best:
            two = -(-least // three)
            best = min(best, three << (two - 1).bit_length())
            three *= 3
        five *= 5
    return best
