"""Frames of a track on grids of times: which frames are a whole number of steps apart."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from perrin._arrays import frozen, repeated
from perrin.errors import TooFewFramesError

if TYPE_CHECKING:
    from perrin._arrays import Bools, Floats, Ints

# A time this close to a multiple of the step between frames (in steps) counts as that multiple.
GRID_TOLERANCE = 0.1

# Times that deviate from a grid by less than this (in dt) are those of frame numbers.
_EXACT_GRID = 1e-3

# A grid may have this many places per frame, and this many more; beyond, its holes are cut out, so
# that arrays and lag axes are bounded by the number of frames present.
_PLACES_PER_FRAME, _SPARE_PLACES = 8, 64


@dataclass(frozen=True, eq=False)
class Frames:
    """The frames of a track in blocks; within a block their times lie on a grid.

    Attributes
    ----------
    row : ndarray of int, shape (N,)
        Rows of the track, sorted by piece, then by time.
    time : ndarray, shape (N,)
        Time of each frame, s.
    piece : ndarray of int, shape (N,)
        Piece of the track that each frame belongs to; no pair of frames joins two pieces.
    block : ndarray of int, shape (N,)
        Block of each frame, counted from 0.
    slot : ndarray of int, shape (N,)
        Place of each frame on the grid of its block, counted from 0.
    step : float
        Time between places of the grid, s: dt times the common divisor of the frame numbers.
    exact : bool
        Whether the times are exact multiples of the step; otherwise they are only close to them.
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

    @cached_property
    def blocks(self) -> list[slice]:
        """Slice of the frames that belong to each block."""
        if self.block[-1] == 0:
            return [slice(0, len(self.block))]
        edges = np.flatnonzero(np.diff(self.block, prepend=-1, append=self.block[-1] + 1))
        return [slice(int(a), int(b)) for a, b in pairwise(edges)]

    @cached_property
    def lengths(self) -> Ints:
        """Steps from the first to the last frame of each block, shape (B,)."""
        return np.array([int(self.slot[b.stop - 1]) for b in self.blocks], dtype=np.int64)

    @property
    def separate(self) -> bool:
        """Whether every piece is one block, so that no pair joins two blocks."""
        if self.block[-1] == 0:
            return True
        joined = (np.diff(self.block) > 0) & (np.diff(self.piece) == 0)
        return not joined.any()

    @property
    def most_lags(self) -> int:
        """Largest number of lags that a curve of these frames may have."""
        return _PLACES_PER_FRAME * len(self.time) + _SPARE_PLACES


def place_frames(time: Floats, piece: Ints, here: Bools, *, dt: float) -> Frames:
    """Sort the rows that are `here` into blocks of frames on a grid of times.

    Frames whose times are multiples of dt share one grid per piece. For other times a block begins
    with every frame whose time deviates by more than a tenth of a step from the grid of the block
    before. Blocks are cut at their holes where a grid would have far more places than frames.

    Parameters
    ----------
    time : ndarray, shape (T,)
        Rising times, s.
    piece : ndarray of int, shape (T,)
        Piece of each row; no pair of frames joins two of them.
    here : ndarray of bool, shape (T,)
        Whether each row is used.
    dt : float
        Time between frames, s.

    Returns
    -------
    Frames

    Raises
    ------
    TooFewFramesError
        If fewer than two rows are used.

    Examples
    --------
    >>> time, piece = np.array([0.0, 1.0, 2.0, 4.0]), np.zeros(4, dtype=int)
    >>> place_frames(time, piece, np.ones(4, dtype=bool), dt=0.5).slot
    array([0, 1, 2, 4])
    """
    count = int(np.count_nonzero(here))
    if count < 2:
        raise TooFewFramesError("no two frames in one piece: a pair needs two", count)
    if count == len(time) and piece[0] == piece[-1]:
        off = (time - time[0]) / dt
        off -= np.arange(count)
        exact = max(off.max(), -off.min()) < _EXACT_GRID
        if exact and np.all(piece == piece[0]):
            # Views: the arrays of the caller stay writable, and long tracks are not copied.
            return complete_frames(time[:], piece[:], dt=dt)
    rows = np.flatnonzero(here)
    t, label = time[rows], piece[rows]
    same = label[1:] == label[:-1]
    if np.any(label[1:] < label[:-1]) or np.any((t[1:] < t[:-1]) & same):
        rows = rows[np.lexsort((t, label))]
        t, label = time[rows], piece[rows]
        same = label[1:] == label[:-1]
    first = np.flatnonzero(np.append(True, ~same))
    origin = np.repeat(t[first], np.diff(np.append(first, len(t))))
    place = (t - origin) / dt
    number = np.rint(place)
    exact = bool(
        np.all(np.abs(place - number) < _EXACT_GRID) and np.all(np.diff(number)[same] >= 1)
    )
    begins = np.append(True, ~same)
    if exact:
        stride = int(np.gcd.reduce(np.diff(number)[same].astype(np.int64))) or 1
        step, slot = stride * dt, number.astype(np.int64) // stride
    else:
        step, slot, start = grid_step(np.diff(t)[same], dt), np.zeros(len(t), dtype=np.int64), t[0]
        for i in range(1, len(t)):
            steps = (t[i] - start) / step
            whole = round(steps)
            if same[i - 1] and whole > slot[i - 1] and abs(steps - whole) <= GRID_TOLERANCE:
                slot[i] = whole
            else:
                begins[i], start = True, t[i]
    first = np.flatnonzero(begins)
    size = np.diff(np.append(first, len(t)))
    places = slot[first + size - 1]
    sparse = np.repeat(places > _PLACES_PER_FRAME * size + _SPARE_PLACES, size)
    begins |= np.append(False, np.diff(slot) > _PLACES_PER_FRAME) & sparse
    block = np.cumsum(begins) - 1
    return Frames(rows, t, label, block, slot - slot[begins][block], step, exact)


def complete_frames(time: Floats, piece: Ints, *, dt: float) -> Frames:
    """Return the frames of one piece without a gap at multiples of dt.

    Parameters
    ----------
    time : ndarray, shape (T,)
        Time of each frame, s.
    piece : ndarray of int, shape (T,)
        Piece of each frame, one for all.
    dt : float
        Time between frames, s.

    Returns
    -------
    Frames

    Examples
    --------
    >>> complete_frames(np.arange(3.0), np.zeros(3, dtype=int), dt=1.0).lengths
    array([2])
    """
    slot = np.arange(len(time))
    block = repeated(np.zeros((), dtype=np.int64), len(time))
    return Frames(slot, time, piece, block, slot, dt, exact=True)


def grid_step(durations: Floats, dt: float) -> float:
    """Return the step of a grid on which most times between frames lie nearly.

    It is dt, or what the times show instead: the median duration, if most durations are multiples
    of it within a tenth; times the common divisor of these multiples.

    Parameters
    ----------
    durations : ndarray, shape (K,)
        Times between neighbouring frames of one piece, s.
    dt : float
        Stated time between frames, s.

    Returns
    -------
    float
        Step, s.

    Examples
    --------
    >>> grid_step(np.array([2.0, 4.01, 1.99]), 1.0)
    2.0
    """
    if not durations.size:
        return dt
    for unit in (dt, float(np.median(durations))):
        number = np.rint(durations / unit)
        near = (np.abs(durations / unit - number) <= GRID_TOLERANCE) & (number >= 1)
        if near.mean() >= 0.5:
            stride = int(np.gcd.reduce(number[near].astype(np.int64)))
            return stride * float(durations[near].sum() / number[near].sum())
    return dt
