"""Sums of a quantity over all pairs of frames, by the time between the two frames."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import lru_cache
from math import prod
from typing import TYPE_CHECKING, NamedTuple, Protocol, TypeAlias

import numpy as np

from perrin._arrays import complete, present
from perrin.curves.grids import GRID_TOLERANCE
from perrin.errors import PrecisionWarning, TooFewFramesError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from perrin._arrays import Bools, Floats, Ints
    from perrin.curves.grids import Frames

    Complexes: TypeAlias = NDArray[np.complex128]

# Largest number of pairs formed one by one where frames lie on no common compact grid: all pairs
# of 1400 frames, which take a second and 200 MB.
_MOST_LISTED_PAIRS = 1_000_000

_PAIRS_IN_MEMORY = 1 << 16  # pairs whose displacements are in memory at once


# Whether transforms can be written to given memory (NumPy 2): new memory costs as much as they do.
_IN_PLACE = int(np.__version__.split(".")[0]) >= 2

# Components are transformed together up to so many numbers; more do not stay in the cache.
_NUMBERS_AT_ONCE = 40_000

# A straight line is subtracted first where it is this part of the mean square of a walk.
_STEADY_SHARE = 0.9


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
    def number(self) -> Floats:
        """Number of pairs, shape (L,), as floats."""
        return self.on_grid if self.listed is None else self.pairs.astype(np.float64)

    @property
    def divisor(self) -> Floats:
        """Number of pairs, shape (L,); NaN at a lag without a pair."""
        number = self.number
        return number if number.all() else np.where(number > 0, number, np.nan)

    @property
    def mean(self) -> Floats:
        """Mean over the pairs, shape (L, q); NaN at a lag without a pair."""
        average: Floats = self.sums / self.divisor[:, None]
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
    if frames.exact and frames.separate and len(frames.blocks) > 1:
        span = round(float(np.ptp(frames.time)) / frames.step)
        longest = span if span <= frames.most_lags else longest
    longest = longest if most is None else min(longest, most)
    sums: Floats | None = None
    count: Ints | None = None
    before: Ints | int = 0
    grid = np.arange(1.0, longest + 1)
    grid *= frames.step
    lagtime = grid if frames.exact else grid.copy()
    for elements in [] if complete else frames.blocks:
        slot = frames.slot[elements]
        row = slot if frames.row is frames.slot else frames.row[elements]
        lags = min(int(slot[-1]), longest)
        if lags < 1:
            continue
        added, number = kernel.within(row, slot, lags)
        if sums is None or count is None:
            if lags == longest and len(frames.blocks) == 1:
                sums, count = added, number
            else:
                sums, count = np.zeros((longest, added.shape[1])), np.zeros(longest, np.int64)
                sums[:lags], count[:lags] = added, number
        else:
            before = count[:lags].copy()
            sums[:lags] += added
            count[:lags] += number
        if not frames.exact:
            excess = number * _mean_excess(frames.time[elements], slot, frames.step, lags)
            lagtime[:lags] += np.divide(
                excess - number * (lagtime[:lags] - grid[:lags]),
                before + number,
                out=np.zeros(lags),
                where=before + number > 0,
            )
    if sums is None or count is None:
        sums, count = np.zeros((longest, 1)), np.zeros(longest, np.int64)
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
        """Return the sums by FFT, of one component after the other."""
        walks = _on_grid(self.walks, rows, slots)
        if not complete(walks):
            return gapped_squares(walks, present(walks), count)
        n, walkers, _ = walks.shape
        pairs = np.arange(walkers * (n - 1), walkers * (n - 1 - count), -walkers)
        return complete_squares(walks, count), pairs

    def between(self, first: Ints, last: Ints) -> tuple[Floats, Ints]:
        """Return the squared differences of pairs."""
        square = (self.walks[last] - self.walks[first]) ** 2
        here = present(square)
        return np.where(here[..., None], square, 0.0).sum(1), here.sum(1)


def complete_squares(walks: Floats, count: int) -> Floats:
    """Return sums of squared differences of complete walks at lags 1 to `count`, by FFT.

    The sum over the pairs of lag n is the sum of x^2 over the frames that begin one, plus that over
    the frames that end one, less twice the autocorrelation of x. The mean is subtracted first: the
    squares of coordinates far from the origin would lose digits of the displacements. So is a
    straight line v t where it is most of the motion; its share v^2 n^2 of every pair, and 2 v n
    times the sum of the other displacements, are added back.

    Parameters
    ----------
    walks : ndarray, shape (T, K, c)
        Coordinates of K walkers.
    count : int
        Number of lags.

    Returns
    -------
    ndarray, shape (count, c)
        Sums over the pairs of all walkers.

    Examples
    --------
    >>> complete_squares(np.array([0.0, 1.0, 3.0])[:, None, None], 2).round(9)
    array([[5.],
           [9.]])
    """
    n, walkers, components = walks.shape
    transform = Correlations.of(n + count)
    half = len(transform.turn)
    at_once = min(max(_NUMBERS_AT_ONCE // (n * walkers), 1), components)
    time = np.arange(0.5 * (1 - n), 0.5 * n)
    spread = walkers * n * (n * n - 1) / 12  # the sum of the squares of these times
    # New memory takes as long as the transforms: arrays are used again.
    memory = np.empty(at_once * walkers * max(n, half))
    spectrum = np.empty((at_once * walkers, half), dtype=np.complex128)
    sums = np.empty((components, count))
    for low in range(0, components, at_once):
        out = sums[low : low + at_once]
        q = len(out)
        x = memory[: q * walkers * n].reshape(q, walkers, n)
        x[:] = walks[..., low : low + at_once].T
        x -= x.sum(axis=2, keepdims=True) / n
        square = _squares_at_ends(x, out, memory=spectrum)
        slope = _steady_slopes(x, time, spread=spread, square=square)
        rest = None
        if any(slope):
            x -= np.reshape(slope, (q, 1, 1)) * time
            total = x.sum(axis=1)
            rest = np.cumsum(total[:, : -count - 1 : -1] - total[:, :count], axis=1)
            _squares_at_ends(x, out, memory=spectrum)
        found = transform.spectrum(x.reshape(-1, n), out=spectrum[: q * walkers])
        power = memory[: q * half].reshape(q, half)
        squared_size(found.reshape(q, walkers, half), overwrite=True, out=power)
        transform.add_even(power, out=out, scale=-2.0, memory=spectrum)
        if rest is not None:
            lag = np.arange(1.0, count + 1)
            far = np.multiply.outer(slope, lag)
            out += far * (far * (walkers * (n - lag)) + 2 * rest)
        # A sum of squares that rounds below zero is zero.
        if out.min() < 0:
            np.maximum(out, 0.0, out=out)
    return sums.T


def _squares_at_ends(x: Floats, out: Floats, *, memory: Complexes) -> list[float]:
    """Write the sums of squares over the frames that begin a pair and over those that end one.

    They are written to `out` (q, L) for walks (q, K, n) at lags 1 to L; returned is the sum of
    squares of each component. The complex `memory` has at least half as many numbers as x.
    """
    _, walkers, n = x.shape
    count, middle = out.shape[1], (n + 1) // 2
    square = memory.reshape(-1).view(np.float64)[: x.size].reshape(x.shape)
    np.multiply(x, x, out=square)
    square = square[:, 0] if walkers == 1 else square.sum(axis=1)
    # The frames that begin or end no pair lie at the two ends, as many at either: their sums up to
    # the middle of the track give those beyond it.
    ends = square[:, :middle]
    ends += square[:, : n - middle - 1 : -1]
    np.cumsum(ends, axis=1, out=ends)
    whole = ends[:, -1:] + ends[:, n - middle - 1 : n - middle]
    np.subtract(whole, ends[:, :count], out=out[:, :middle])
    out[:, middle:] = ends[:, n - count - 1 : n - middle - 1][:, ::-1]
    return [0.5 * each for each in whole[:, 0].tolist()]


def gapped_squares(walks: Floats, here: Bools, count: int) -> tuple[Floats, Ints]:
    """Return sums of squared differences of walks with gaps at lags 1 to `count`, by FFT.

    With m the presence the sum over the pairs is 2 corr(m, x^2) - 2 corr(x, x), after the mean and
    a straight line are subtracted, as in `complete_squares`.

    Parameters
    ----------
    walks : ndarray, shape (T, K, c)
        Coordinates of K walkers.
    here : ndarray of bool, shape (T, K)
        Where they are present.
    count : int
        Number of lags.

    Returns
    -------
    sums : ndarray, shape (count, c)
    pairs : ndarray of int, shape (count,)
        Sums over the pairs of all walkers, and their number.

    Examples
    --------
    >>> walk, here = np.array([0.0, np.nan, 3.0]), np.array([True, False, True])
    >>> sums, pairs = gapped_squares(walk[:, None, None], here[:, None], 2)
    >>> sums.round(9), pairs
    (array([[0.],
           [9.]]), array([0, 1]))
    """
    n, walkers, components = walks.shape
    transform = Correlations.of(n + count)
    at_once = min(max(_NUMBERS_AT_ONCE // (n * walkers), 1), components)
    mask = np.ascontiguousarray(here.T, dtype=np.float64)
    spectrum = transform.spectrum(mask)
    pairs = np.zeros(count)
    transform.add_even(squared_size(spectrum), out=pairs)
    np.rint(pairs, out=pairs)
    time, lag = np.arange(float(n)), np.arange(1.0, count + 1)
    number = np.maximum(mask.sum(axis=1, keepdims=True), 1.0)
    middle = mask * (time - (mask @ time)[:, None] / number)
    sums = np.zeros((components, count))
    for low in range(0, components, at_once):
        out = sums[low : low + at_once]
        x = np.where(here.T, walks[..., low : low + at_once].T, 0.0)
        x -= mask * (x.sum(axis=2, keepdims=True) / number)
        square = [float(np.vdot(one, one)) for one in x]
        spread = float(np.vdot(middle, middle))
        slope = _steady_slopes(x, time, spread=spread, square=square)
        if any(slope):
            x -= np.reshape(slope, (-1, 1, 1)) * middle
        both = transform.spectrum(np.concatenate([x, x * x]).reshape(-1, n))
        moved, squared = both.reshape(2, len(x), walkers, -1)
        power = (np.conj(spectrum) * squared).real.sum(axis=1) - squared_size(moved)
        transform.add_even(power, out=out, scale=2.0)
        if any(slope):
            far = np.multiply.outer(slope, lag)
            rest = transform.odd((spectrum * np.conj(moved)).imag.sum(axis=1))[:, 1 : count + 1]
            out += far * (far * pairs + 4 * rest)
        # A sum of squares that rounds below zero is zero.
        np.maximum(out, 0.0, out=out)
    return sums.T, pairs.astype(np.int64)


def _steady_slopes(x: Floats, time: Floats, *, spread: float, square: list[float]) -> list[float]:
    """Return the common slope of the walks (q, K, n) of mean 0 along each of q components.

    It is 0 where a straight line is not most of the motion. `spread` is the sum over the frames of
    all walks of the squared time from the walk's mean time, `square` that of each component.
    """
    slopes = [sum(each) / max(spread, 1.0) for each in (x @ time).tolist()]
    return [
        slope if slope * slope * spread > _STEADY_SHARE * whole else 0.0
        for slope, whole in zip(slopes, square, strict=True)
    ]


@dataclass(frozen=True, eq=False)
class Correlations:
    """Fourier transforms of real sequences at the odd multiples of half a frequency step.

    A zero-padded sequence of N numbers in a period of M = 2 H >= N + count places has correlations
    free of overlap up to lag `count`. At the frequencies (2k + 1/2)/M the transforms are complex
    ones of length H, and those at the other half frequencies their complex conjugates; sums over
    all of them are real transforms of length H: together less than half of the usual work.

    Attributes
    ----------
    turn : ndarray, shape (H,)
        exp(-i pi j/M).

    Examples
    --------
    >>> transform = Correlations.of(6)
    >>> spectrum = transform.spectrum(np.array([[1.0, 2.0, 3.0]]))
    >>> sums = np.zeros(2)
    >>> transform.add_even(np.abs(spectrum[0]) ** 2, out=sums)
    >>> sums.round(9)  # 2 + 6 and 3
    array([8., 3.])
    """

    turn: Complexes

    @classmethod
    def of(cls, places: int) -> Correlations:
        """Return the transforms of a period of at least this many places."""
        return cls(half_turn(fft_size(-(-places // 2))))

    def spectrum(self, x: Floats, *, out: Complexes | None = None) -> Complexes:
        """Return the transform of sequences (K, N) at the frequencies (2k + 1/2)/M, (K, H)."""
        half = len(self.turn)
        out = np.empty((len(x), half), dtype=np.complex128) if out is None else out
        size = min(half, x.shape[1])
        out[:, :size] = x[:, :half]  # converted first: a product of two types takes longer
        out[:, :size] *= self.turn[:size]
        out[:, size:] = 0.0
        rest = x[:, half:]
        if rest.shape[1]:
            out[:, : rest.shape[1]] -= 1j * rest * self.turn[: rest.shape[1]]
        return np.fft.fft(out, axis=1, out=out) if _IN_PLACE else np.fft.fft(out, axis=1)

    def add_even(
        self,
        power: Floats,
        *,
        out: Floats,
        scale: float = 1.0,
        memory: Complexes | None = None,
    ) -> None:
        """Add scale sum_k p_k cos(2 pi (2k + 1/2) j/M)/H of p (..., H), j = 1 to L, to (..., L).

        The complex `memory` has at least as many numbers as p.
        """
        turned = self._summed(power, scale=scale, memory=memory)
        half, count, split = len(self.turn), out.shape[-1], turned.shape[-1] - 1
        near, far = out[..., :split], out[..., split:]
        near += turned.real[..., 1 : count + 1]
        far -= turned.imag[..., half - count : half - split][..., ::-1]

    def odd(self, power: Floats) -> Floats:
        """Return sum_k p_k sin(2 pi (2k + 1/2) j/M)/H of p (..., H) at j = 0 to H - 1."""
        turned = self._summed(power)
        back = slice(len(self.turn) - turned.shape[-1], 0, -1)
        return np.concatenate([-turned.imag, turned.real[..., back]], axis=-1)

    def _summed(
        self, power: Floats, *, scale: float = 1.0, memory: Complexes | None = None
    ) -> Complexes:
        """Return scale sum_k p_k exp(-2 pi i (2k + 1/2) j/M)/H at j = 0 to H/2."""
        size = len(self.turn) // 2 + 1
        if memory is None or not _IN_PLACE:
            summed = np.fft.rfft(power, norm="forward")
        else:
            shape = (*power.shape[:-1], size)
            summed = memory.reshape(-1)[: prod(shape)].reshape(shape)
            np.fft.rfft(power, norm="forward", out=summed)
        summed *= scale * self.turn[:size]
        return summed


@lru_cache(maxsize=1)
def half_turn(count: int) -> Complexes:
    """Return exp(-i pi j/(2 H)) for j = 0 to H - 1; the last is kept for curves of one length.

    Examples
    --------
    >>> half_turn(2).round(3)
    array([1.   +0.j   , 0.707-0.707j])
    """
    # Products of two short lists: a trigonometric function for every place takes longer.
    width = int(np.sqrt(count)) + 1
    step = -0.5j * np.pi / count
    rows, columns = np.exp(step * width * np.arange(width)), np.exp(step * np.arange(width))
    turn: Complexes = np.multiply.outer(rows, columns).ravel()[:count]
    turn.flags.writeable = False
    return turn


def squared_size(
    spectrum: Complexes, *, overwrite: bool = False, out: Floats | None = None
) -> Floats:
    """Return the squared absolute values of spectra (..., K, H), summed over K.

    The spectra may be overwritten to save memory, and the sum be written to `out` (..., H).

    Examples
    --------
    >>> squared_size(np.array([[3.0 + 4.0j], [1.0j]]))
    array([26.])
    """
    parts = spectrum.view(np.float64)
    squares = np.multiply(parts, parts, out=parts if overwrite else None)
    total = squares[..., 0, :] if squares.shape[-2] == 1 else squares.sum(axis=-2)
    return np.add(total[..., ::2], total[..., 1::2], out=out)


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
        transform = Correlations.of(len(values) + count)
        whole = bool(here.all())
        columns = np.ascontiguousarray(
            (values if whole else np.where(here[:, None], values, 0.0)).T
        )
        sums = np.zeros((len(self.groups), count))
        memory = np.empty((1, len(transform.turn)), dtype=np.complex128)
        squares = all(i == j for group in self.groups for i, j in group)
        parts = None if squares else transform.spectrum(columns).view(np.float64)
        for out, group in zip(sums, self.groups, strict=True):
            power = np.zeros(len(transform.turn))
            for i, j in group:
                if parts is None:
                    moved = transform.spectrum(columns[i : i + 1], out=memory)
                    power += squared_size(moved, overwrite=True)
                else:
                    # The real part is the transform of the mean of a product and its reverse.
                    product = parts[i] * parts[j]
                    power += product[::2] + product[1::2]
            transform.add_even(power, out=out, memory=memory)
        if whole:
            return sums.T, len(values) - np.arange(1, count + 1)
        mask = transform.spectrum(here.astype(np.float64)[None])
        pairs = np.zeros(count)
        transform.add_even(squared_size(mask), out=pairs)
        return sums.T, np.rint(pairs).astype(np.int64)

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
        if len(rows) == len(values) and (rows is slots or np.array_equal(rows, slots)):
            return values
        if rows[-1] - rows[0] == len(rows) - 1 and np.array_equal(rows, slots + rows[0]):
            return values[rows[0] : rows[-1] + 1]
        return values[rows]
    grid = np.full((int(slots[-1]) + 1, *values.shape[1:]), np.nan)
    grid[slots] = values[rows]
    return grid


@lru_cache
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
