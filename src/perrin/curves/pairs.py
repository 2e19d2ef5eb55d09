"""Pairs of frames by the time between them: the lags that occur, and sums over their pairs."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np
from numpy.polynomial.polynomial import polyval

from perrin._arrays import frozen, present
from perrin.errors import PrecisionWarning

if TYPE_CHECKING:
    from perrin._arrays import Bools, Floats, Ints


# A time this close to a multiple of the step between frames (in steps) counts as that multiple.
NEAR = 0.1


# Times that are off a grid by less than this (in dt) are those of frame numbers.
_EXACT = 1e-3


# A grid may have this many places per frame, and this many more; beyond, its holes are cut out, so
# that arrays and lag axes are bounded by the number of frames present.
_PLACES, _SPARE = 8, 64


# Pairs formed one by one where frames lie on no common compact grid: a second and 200 MB. All
# pairs of 1400 frames.
_MOST_PAIRS = 1_000_000


_CHUNK = 1 << 16  # pairs whose displacements are in memory at once


# Starts of displacements are compared as whole numbers below this: exact sums of their squares.
_RESOLUTION = 1 << 22


class Kernel(Protocol):
    """A quantity that is summed over pairs of frames."""

    def within(self, rows: Ints, slots: Ints, count: int) -> tuple[Floats, Ints]:
        """Return sums (count, q) and pairs (count,) at lags 1 to count of rows on a grid."""

    def between(self, first: Ints, last: Ints) -> tuple[Floats, Ints]:
        """Return the quantity (P, q) and its multiplicity (P,) of pairs of rows."""


@dataclass(frozen=True, eq=False)
class Frames:
    """The frames of a track in blocks; within a block their times lie on a grid.

    Attributes
    ----------
    row : ndarray of int, shape (N,)
        Rows of the track, by piece, then by time.
    time : ndarray, shape (N,)
        s.
    piece, block, slot : ndarray of int, shape (N,)
        The piece and the block of each row, and its place on the block's grid, from 0.
    step : float
        Between places of the grid, s: dt times the common divisor of the frame numbers.
    exact : bool
        Whether times are multiples of the step, and not only close to them.
    """

    row: Ints
    time: Floats
    piece: Ints
    block: Ints
    slot: Ints
    step: float
    exact: bool

    def __post_init__(self) -> None:
        frozen(self.row, self.time, self.piece, self.block, self.slot)

    @property
    def blocks(self) -> list[slice]:
        """Which elements each block has."""
        edges = np.flatnonzero(np.diff(self.block, prepend=-1, append=self.block[-1] + 1))
        return [slice(int(a), int(b)) for a, b in pairwise(edges)]

    @property
    def lengths(self) -> Ints:
        """Steps from the first to the last frame of each block, (B,)."""
        return np.array([int(self.slot[b.stop - 1]) for b in self.blocks], dtype=np.int64)

    @property
    def separate(self) -> bool:
        """Whether every piece is one block, so that no pair joins two blocks."""
        joined = (np.diff(self.block) > 0) & (np.diff(self.piece) == 0)
        return not joined.any()


class PairSums(NamedTuple):
    """Sums over all pairs of frames at each lag.

    Attributes
    ----------
    lagtime : ndarray, shape (L,)
        Mean time between the frames of the pairs, s.
    sums : ndarray, shape (L, q)
    pairs : ndarray of int, shape (L,)
        Pairs, counted as the kernel does.
    within : ndarray, shape (L,)
        Pairs of those that were summed on grids.
    singles : Singles or None
        The pairs that were formed one by one.
    """

    lagtime: Floats
    sums: Floats
    pairs: Ints
    within: Floats
    singles: Singles | None


class Singles(NamedTuple):
    """Pairs formed one by one, in order of lag and first frame.

    Attributes
    ----------
    lag : ndarray of int, shape (P,)
        Which element of the lag axis.
    first, last : ndarray of int, shape (P,)
        Elements of `Frames`.
    """

    lag: Ints
    first: Ints
    last: Ints


def place_frames(time: Floats, piece: Ints, here: Bools, *, dt: float) -> Frames:
    """Sort the rows that are `here` into blocks of frames on a grid of times.

    Parameters
    ----------
    time : ndarray, shape (T,)
        s, rising.
    piece : ndarray of int, shape (T,)
        No pair joins two of them.
    here : ndarray of bool, shape (T,)
    dt : float
        Time between frames, s.
    """
    rows = np.flatnonzero(here)
    rows = rows[np.lexsort((time[rows], piece[rows]))]
    t, label = time[rows], piece[rows]
    same = label[1:] == label[:-1]
    first = np.flatnonzero(np.append(True, ~same))
    origin = np.repeat(t[first], np.diff(np.append(first, len(t))))
    place = (t - origin) / dt
    number = np.rint(place)
    exact = bool(np.all(np.abs(place - number) < _EXACT) and np.all(np.diff(number)[same] >= 1))
    if exact:
        stride = int(np.gcd.reduce(np.diff(number)[same].astype(np.int64))) or 1
        step, slot, block = stride * dt, number.astype(np.int64) // stride, np.append(0, ~same)
    else:
        step = _grid_step(np.diff(t)[same], dt)
        slot, block = _runs(t, same, step)
    slot, block = _compact(slot, np.cumsum(block))
    return Frames(rows, t, label, block, slot, step, exact)


def _grid_step(duration: Floats, dt: float) -> float:
    """Return the step of a grid on which most times lie nearly: dt, or what they show instead."""
    if not duration.size:
        return dt
    for unit in (dt, float(np.median(duration))):
        number = np.rint(duration / unit)
        near = (np.abs(duration / unit - number) <= NEAR) & (number >= 1)
        if near.mean() >= 0.5:
            stride = int(np.gcd.reduce(number[near].astype(np.int64)))
            return stride * float(duration[near].sum() / number[near].sum())
    return dt


def _runs(t: Floats, same: Bools, step: float) -> tuple[Ints, Ints]:
    """Return the place of each time on the grid that its run began, and where runs begin."""
    slot, begins = np.zeros(len(t), dtype=np.int64), np.zeros(len(t), dtype=np.int64)
    origin = t[0]
    for i in range(1, len(t)):
        place = (t[i] - origin) / step
        number = round(place)
        if same[i - 1] and number > slot[i - 1] and abs(place - number) <= NEAR:
            slot[i] = number
        else:
            begins[i], origin = 1, t[i]
    return slot, begins


def _compact(slot: Ints, block: Ints) -> tuple[Ints, Ints]:
    """Cut blocks at their holes where a grid would have far more places than frames."""
    _, first, size = np.unique(block, return_index=True, return_counts=True)
    length = slot[first + size - 1]
    sparse = np.repeat(length > _PLACES * size + _SPARE, size)
    hole = np.append(False, np.diff(slot) > _PLACES) & sparse
    begins = hole.copy()
    begins[first] = True
    block = np.cumsum(begins) - 1
    origin = slot[begins][block]
    return slot - origin, block


def pair_sums(kernel: Kernel, frames: Frames, *, most: int | None = None) -> PairSums:
    """Sum a quantity over all pairs of frames of one piece, by the time between them.

    Pairs on one grid are summed by the kernel's Fourier transforms. Where a piece has several
    blocks (times off the grid, holes), its pairs are formed one by one and put into bins: lags
    within a tenth of a step of a whole number of steps into one, those between two such numbers
    into another. Where lags beyond the blocks are more than eight per frame, they share bins that
    are evenly spaced in the logarithm. Of more than a million pairs only those of the shortest lags
    are formed across blocks.

    Parameters
    ----------
    kernel : Kernel
    frames : Frames
    most : int, optional
        Number of steps of the longest lag; default all.
    """
    singles, whole = (None, False) if frames.separate else _listed(frames)
    longest = int(frames.lengths.max())
    if frames.exact and frames.separate:
        span = round(float(np.ptp(frames.time)) / frames.step)
        longest = span if span <= _axis_size(frames) else longest
    longest = longest if most is None else min(longest, most)
    grid = _Bins.empty(frames, longest)
    if not whole:
        for elements in frames.blocks:
            grid.add_block(kernel, frames, elements)
    if singles is None or not singles[0].size:
        return grid.done()
    return grid.joined(kernel, frames, singles, most)


def _listed(frames: Frames) -> tuple[tuple[Ints, Ints], bool]:
    """Return pairs of elements in one piece, and whether they are all; else those across blocks."""
    _, number = np.unique(frames.piece, return_inverse=True)
    apart = 2 * (np.ptp(frames.time) + frames.step)
    t = frames.time - frames.time.min() + apart * number
    begin = np.arange(len(t)) + 1
    end = np.searchsorted(t, t + 0.5 * apart)
    whole = int((end - begin).sum()) <= _MOST_PAIRS
    if not whole:
        begin = np.searchsorted(frames.block, frames.block, side="right")
        reach = _reach(t, begin, end, frames.step)
        if reach < frames.time[-1] - frames.time[0]:
            warnings.warn(
                f"the frames lie in {frames.block[-1] + 1} groups that share no compact grid of "
                f"times and make more than {_MOST_PAIRS} pairs: pairs across groups are formed up "
                f"to a lag of {reach:.4g} s",
                PrecisionWarning,
                stacklevel=5,
            )
        end = np.minimum(end, np.searchsorted(t, t + reach, side="right"))
    size = np.maximum(end - begin, 0)
    first = np.repeat(np.arange(len(t)), size)
    last = np.arange(len(first)) - np.repeat(np.cumsum(size) - size - begin, size)
    return (first, last), whole


def _reach(t: Floats, begin: Ints, end: Ints, step: float) -> float:
    """Return the longest lag up to which no more pairs are formed than allowed: a bin's end."""
    low, high = 0.0, float(t[-1] - t[0])
    for _ in range(60):
        middle = 0.5 * (low + high)
        last = np.minimum(end, np.searchsorted(t, t + middle, side="right"))
        within = np.maximum(last - begin, 0).sum() <= _MOST_PAIRS
        low, high = (middle, high) if within else (low, middle)
    return float((np.floor(low / step - NEAR) + NEAR) * step)  # the end of a bin


@dataclass(frozen=True, eq=False)
class _Bins:
    """Sums at whole numbers of steps, from 1; an array is made when the first block is added."""

    frames: Frames
    longest: int
    sums: list[Floats]
    pairs: Ints
    time: Floats

    @classmethod
    def empty(cls, frames: Frames, longest: int) -> _Bins:
        lag = np.arange(1.0, longest + 1)
        return cls(frames, longest, [], np.zeros(longest, np.int64), lag * frames.step)

    def add_block(self, kernel: Kernel, frames: Frames, elements: slice) -> None:
        """Add the pairs of one block."""
        slot = frames.slot[elements]
        count = min(int(slot[-1]), self.longest)
        if count < 1:
            return
        sums, pairs = kernel.within(frames.row[elements], slot, count)
        if not self.sums:
            self.sums.append(np.zeros((self.longest, sums.shape[1])))
        self.sums[0][:count] += sums
        if not frames.exact:
            total = self.pairs[:count] + pairs
            more = pairs * _deviations(frames.time[elements], slot, frames.step, count)
            self.time[:count] += np.divide(
                more - pairs * (self.time[:count] - self.grid[:count]),
                total,
                out=np.zeros(count),
                where=total > 0,
            )
        self.pairs[:count] += pairs

    @property
    def grid(self) -> Floats:
        """The whole numbers of steps, s."""
        return np.arange(1.0, self.longest + 1) * self.frames.step

    def done(self) -> PairSums:
        """Return the sums as they are."""
        sums = self.sums[0] if self.sums else np.zeros((self.longest, 1))
        return PairSums(self.time, sums, self.pairs, self.pairs.astype(np.float64), None)

    def joined(
        self, kernel: Kernel, frames: Frames, pairs: tuple[Ints, Ints], most: int | None
    ) -> PairSums:
        """Return the sums with those of single pairs; lags without a pair are left out."""
        first, last = pairs
        lag = (frames.time[last] - frames.time[first]) / frames.step
        key = _bin_numbers(lag, longest=int(frames.lengths.max()), most=_axis_size(frames))
        if most is not None:
            kept = key <= 2 * most
            first, last, lag, key = first[kept], last[kept], lag[kept], key[kept]
        order = np.lexsort((first, key))
        first, last, lag, key = first[order], last[order], lag[order], key[order]
        on_grid = np.flatnonzero(self.pairs)
        axis = np.union1d(2 * (on_grid + 1), key)
        which, here = np.searchsorted(axis, key), np.searchsorted(axis, 2 * (on_grid + 1))
        sums, count = _summed(kernel, frames, Singles(which, first, last), len(axis))
        within = np.zeros(len(axis))
        weight = np.bincount(which, minlength=len(axis)).astype(np.float64)
        mean = np.divide(
            np.bincount(which, lag * frames.step, minlength=len(axis)), np.maximum(weight, 1)
        )
        if self.sums:
            within[here] = self.pairs[on_grid]
            sums[here] += self.sums[0][on_grid]
            share = count[here] / (count[here] + within[here])
            mean[here] = share * mean[here] + (1 - share) * self.time[on_grid]
        return PairSums(
            mean, sums, count + within.astype(np.int64), within, Singles(which, first, last)
        )


def _axis_size(frames: Frames) -> int:
    """Return how many lags a curve of so many frames may have."""
    return _PLACES * len(frames.time) + _SPARE


def _bin_numbers(lag: Floats, *, longest: int, most: int) -> Ints:
    """Return twice the lag where it is nearly whole, else the odd number between two of those.

    If lags beyond the longest on a grid are more than `most`, they share that many bins.
    """
    whole = np.rint(lag)
    near = (np.abs(lag - whole) <= NEAR) & (whole >= 1)
    key = np.where(near, 2 * whole, 2 * np.floor(lag) + 1).astype(np.int64)
    far = key > 2 * longest + 1
    if np.unique(key[far]).size > most:
        high = np.log(lag[far] / (longest + NEAR))
        key[far] = 2 * longest + 2 + np.minimum(most * high / high.max(), most - 1).astype(np.int64)
    return key


def _summed(kernel: Kernel, frames: Frames, pairs: Singles, size: int) -> tuple[Floats, Ints]:
    """Return the sums (size, q) and counts (size,) of single pairs."""
    sums, count = None, np.zeros(size, dtype=np.int64)
    for begin in range(0, len(pairs.lag), _CHUNK):
        part = slice(begin, begin + _CHUNK)
        more, times = kernel.between(frames.row[pairs.first[part]], frames.row[pairs.last[part]])
        lags, edges = np.unique(pairs.lag[part], return_index=True)
        sums = np.zeros((size, more.shape[1])) if sums is None else sums
        sums[lags] += np.add.reduceat(more, edges, axis=0)
        count[lags] += np.add.reduceat(times, edges)
    return (np.zeros((size, 1)) if sums is None else sums), count


def _deviations(time: Floats, slot: Ints, step: float, count: int) -> Floats:
    """Return by how much the times between frames exceed whole steps, mean over pairs, s."""
    size = fast_size(int(slot[-1]) + 1 + count)
    here, off = np.zeros(size), np.zeros(size)
    here[slot], off[slot] = 1.0, time - time[0] - slot * step
    m, e = np.fft.rfft(here), np.fft.rfft(off)
    excess = np.fft.irfft(np.conj(m) * e - np.conj(e) * m, size)[1 : count + 1]
    pairs = np.fft.irfft(np.abs(m) ** 2, size)[1 : count + 1]
    return np.asarray(excess / np.maximum(np.rint(pairs), 1.0))


class Squares:
    """Squared differences of walks (T, K, c) by component, walkers added; NaN where missing."""

    def __init__(self, walks: Floats) -> None:
        self.walks = walks

    def within(self, rows: Ints, slots: Ints, count: int) -> tuple[Floats, Ints]:
        """Return the sums by FFT.

        With m the presence, the sum is corr(m x^2, m) + corr(m, m x^2) - 2 corr(m x, m x). The
        mean is taken off first: squares of a far origin would swallow the displacements.
        """
        walks = _on_places(self.walks, rows, slots)
        here = present(walks)
        mask = here.astype(np.float64)
        mean = np.where(here[..., None], walks, 0.0).sum(0) / np.maximum(mask.sum(0), 1)[:, None]
        x = np.where(here[..., None], walks - mean, 0.0)
        size = fast_size(len(walks) + count)
        m = np.fft.rfft(mask, size, axis=0)[..., None]
        f, g = np.fft.rfft(x, size, axis=0), np.fft.rfft(x * x, size, axis=0)
        spectrum = 2 * np.real(np.conj(m) * g) - 2 * np.abs(f) ** 2
        sums = np.fft.irfft(spectrum.sum(1), size, axis=0)[1 : count + 1]
        counts = np.fft.irfft((np.abs(m) ** 2).sum((1, 2)), size)[1 : count + 1]
        # A sum of squares that rounds below zero is zero.
        return np.maximum(sums, 0.0), np.rint(counts).astype(np.int64)

    def between(self, first: Ints, last: Ints) -> tuple[Floats, Ints]:
        """Return the squared differences of pairs."""
        square = (self.walks[last] - self.walks[first]) ** 2
        here = present(square)
        return np.where(here[..., None], square, 0.0).sum(1), here.sum(1)


class Products:
    """Products of features (T, F) whose pairs (i, j) of columns are summed in groups.

    Parameters
    ----------
    features : ndarray, shape (T, F)
        Finite in all rows that are used.
    groups : sequence of sequence of (int, int)
        Result q is the sum of the products of column i of one frame and column j of the other,
        symmetric in the frames.
    """

    def __init__(self, features: Floats, groups: list[list[tuple[int, int]]]) -> None:
        self.features, self.groups = features, groups

    def within(self, rows: Ints, slots: Ints, count: int) -> tuple[Floats, Ints]:
        """Return the sums by FFT."""
        values = _on_places(self.features, rows, slots)
        here = present(values)
        size = fast_size(len(values) + count)
        f = np.fft.rfft(np.where(here[:, None], values, 0.0).T, size)
        m = np.fft.rfft(here.astype(np.float64), size)
        sums = np.empty((count, len(self.groups)))
        for k, group in enumerate(self.groups):
            # The real part is the transform of the mean of a product and its reverse.
            power = sum(f[i].real * f[j].real + f[i].imag * f[j].imag for i, j in group)
            sums[:, k] = np.fft.irfft(power, size)[1 : count + 1]
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


def _on_places(values: Floats, rows: Ints, slots: Ints) -> Floats:
    """Return rows of an array at their places, NaN between them."""
    if len(slots) == slots[-1] + 1:
        return values[rows]
    grid = np.full((int(slots[-1]) + 1, *values.shape[1:]), np.nan)
    grid[slots] = values[rows]
    return grid


def fast_size(least: int) -> int:
    """Return the smallest 2^a 3^b 5^c that is at least `least`: such transforms are fast."""
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


def first_look(lag: Floats, half: Floats, pairs: Floats | Ints) -> tuple[float, float]:
    """Return D per step and s of half an MSD, D t + s, from its first two lags, neither negative.

    Parameters
    ----------
    lag : ndarray, shape (L,)
        Steps.
    half : ndarray, shape (L,)
    pairs : ndarray, shape (L,)
    """
    good = np.flatnonzero(pairs > 0)
    first, second = (good[0], good[1]) if good.size > 1 else (good[0], good[0])
    rise = (half[second] - half[first]) / max(lag[second] - lag[first], 1e-9)
    d = min(max(rise, 0.0), half[first] / lag[first])
    return float(d), float(half[first] - d * lag[first])


def relative_error(sums: PairSums, frames: Frames, half: Floats, shared: Floats) -> Floats:
    """Return the relative standard error of a one-dimensional MSD at every lag.

    Parameters
    ----------
    sums : PairSums
    frames : Frames
    half : ndarray, shape (L,)
        Half of the MSD, D t + s; D per step and s are from its first two lags.
    shared : ndarray, shape (L,)
        Pairs of one walker.
    """
    lag = sums.lagtime / frames.step
    d, s = first_look(lag, half, shared)
    per_walker = np.divide(sums.within, sums.pairs, out=np.zeros_like(half), where=sums.pairs > 0)
    total = _grid_overlaps(frames.lengths, lag, per_walker * shared, d=d, s=s)
    if sums.singles is not None:
        total += _single_overlaps(sums.singles, frames, lag, d=d, s=s)
    mean = 2 * (d * lag + s)
    relative = np.full_like(half, np.nan)
    good = (shared > 0) & (mean > 0)
    np.divide(np.sqrt(2 * total), shared * mean, out=relative, where=good)
    return relative


def _grid_overlaps(lengths: Ints, lag: Floats, pairs: Floats, *, d: float, s: float) -> Floats:
    """Return the squared covariances of displacements on grids, summed over pairs of them."""
    n = np.maximum(np.rint(lag), 1.0)
    whole = places(lengths, n)
    seen = np.sqrt(np.where((pairs > 0) & (whole > 0), pairs / np.maximum(whole, 1), 1.0))
    total = np.zeros_like(lag)
    for length, times in zip(*np.unique(lengths, return_counts=True), strict=True):
        use = np.flatnonzero((n <= length) & (pairs > 0))
        b, p = n[use], length + 1 - n[use]
        near, far, itself = overlap_sums(b, int(length), seen=seen[use], D=d, s=s)
        own = np.where(b <= p, *(polyval(b, c, tensor=False) for c in (near, far))) + itself
        total[use] += times * own
    return np.asarray(total * seen**4)


def places(lengths: Ints, lag: Floats) -> Floats:
    """Return how many displacements of each lag fit into blocks of so many steps, (L,)."""
    rising = np.sort(lengths)
    left = np.append(np.cumsum(rising[::-1])[::-1], 0)
    shorter = np.searchsorted(rising, lag - 0.5)
    return np.asarray(left[shorter] + (len(rising) - shorter) * (1 - lag))


def _single_overlaps(pairs: Singles, frames: Frames, lag: Floats, *, d: float, s: float) -> Floats:
    """Return the squared covariances of displacements of one bin, summed over pairs of them.

    Displacements of length l that begin a time a apart share l - a; with a common first or last
    frame the noise s is shared too, and where one ends at the other's beginning it counts once.
    """
    count = np.bincount(pairs.lag, minlength=len(lag)).astype(np.float64)
    total = count * (2 * d * lag + 2 * s) ** 2
    total += 2 * (2 * d) ** 2 * _squared_shares(pairs, frames, lag)
    for ends in (pairs.first, pairs.last):
        total += _meetings(pairs, ends, ends, lag) * (4 * d * lag * s + s * s)
    return np.asarray(total + 2 * _meetings(pairs, pairs.last, pairs.first, lag) * s * s)


def _meetings(pairs: Singles, one: Ints, other: Ints, lag: Floats) -> Floats:
    """Return how many different displacements of one bin meet in a frame, ordered pairs."""
    size = int(max(pairs.last.max(initial=0), pairs.first.max(initial=0))) + 1
    rising = np.sort(pairs.lag * size + other)
    wanted = pairs.lag * size + one
    found = np.searchsorted(rising, wanted, side="right") - np.searchsorted(rising, wanted)
    itself = 1.0 if one is other else 0.0
    return np.asarray(np.bincount(pairs.lag, found - itself, minlength=len(lag)), np.float64)


def _squared_shares(pairs: Singles, frames: Frames, lag: Floats) -> Floats:
    """Return the sum of (shared time)^2 over pairs of displacements of a bin, each once, steps^2.

    Displacements are cut into clusters that share nothing; their starts become whole numbers, so
    that differences of cumulative sums of squares are exact, modulo 2^64.
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
    scale = _RESOLUTION / np.maximum(extent, lag)
    a = np.rint(start * scale[pairs.lag]).astype(np.int64)
    whole = np.rint(length * scale[pairs.lag]).astype(np.int64)
    key = cluster * (4 * _RESOLUTION) + a
    begin = np.searchsorted(key, key - whole, side="right")
    here = np.arange(len(a))
    once, twice = (np.append(0, np.cumsum(x)) for x in (a, a * a))
    rest = whole - a
    shared = (here - begin) * rest * rest + 2 * rest * (once[here] - once[begin])
    shared += twice[here] - twice[begin]
    square = np.bincount(pairs.lag, shared.astype(np.float64), minlength=len(lag))
    return np.asarray(square / scale**2)


def overlap_sums(
    lag: Floats, steps: int, *, seen: Floats, D: float, s: float
) -> tuple[Floats, Floats, Floats]:
    """Return what the covariance of an MSD at two lags is made of, as polynomials of the shorter.

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
    seen : ndarray, shape (L,)
        The part of the frames that is there, from 0 to 1: the root of that of the displacements.
    D, s : float
        Diffusion coefficient times dt, and variance of one coordinate from noise.

    Returns
    -------
    near, far : ndarray, shape (5, L)
        Coefficients of a^0 .. a^4 in S(a, b), for a <= steps + 1 - b and from there on.
    itself : ndarray, shape (L,)
        What comes on top where a = b.
    """
    b, p = lag, steps + 1 - lag
    gap, zero = 1 / seen - 1, np.zeros_like(lag)
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
