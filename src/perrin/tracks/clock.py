"""When the frames of a track table were recorded: the column time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from perrin._arrays import from_plain, to_plain
from perrin._text import counted, frames_text
from perrin.errors import TrackTableError

if TYPE_CHECKING:
    from collections.abc import Mapping

    import pandas as pd

    from perrin._arrays import Floats, Ints

# Times that differ from an even grid by less than this share of dt are even.
_GRID_TOLERANCE = 5e-4

# Times are on a grid if the intervals between them are multiples of one interval to this share of
# it; times that differ by less than the second share are those of one frame.
_INTERVAL_TOLERANCE, _SAME_TIME = 0.1, 1e-3

# The median interval of the column may differ from dt by this share: clocks are not exact.
_DT_TOLERANCE = 0.01


@dataclass(frozen=True, eq=False)
class Clock:
    """When frames were recorded.

    Attributes
    ----------
    frames : ndarray of int, shape (K,)
        Frames whose time is known, in rising order.
    times : ndarray, shape (K,)
        Times of these frames, s.
    dt : float
        Time between the frames before the first and after the last of these, s.
    """

    frames: Ints
    times: Floats
    dt: float

    def at(self, frames: Ints) -> Floats:
        """Return the times of frames, s, interpolated between those that are known."""
        before = np.minimum(frames - self.frames[0], 0)
        after = np.maximum(frames - self.frames[-1], 0)
        known = np.interp(frames, self.frames, self.times)
        return np.asarray(known + self.dt * (before + after))

    def from_frame(self, first: int) -> Clock:
        """Return the clock for frames counted from `first`, whose time becomes 0."""
        start = float(self.at(np.array([first]))[0])
        return Clock(self.frames - first, self.times - start, self.dt)

    def to_dict(self) -> dict[str, Any]:
        """Return the attributes as lists and numbers, which JSON can hold.

        Returns
        -------
        dict
            One entry per attribute.
        """
        plain: dict[str, Any] = to_plain(vars(self))
        return plain

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> Clock:
        """Return the clock that `to_dict` wrote.

        Parameters
        ----------
        entry : mapping
            As `to_dict` returns it, also after a round trip through JSON.

        Returns
        -------
        Clock

        Examples
        --------
        >>> clock = Clock(np.array([0, 2]), np.array([0.0, 1.5]), 0.7)
        >>> Clock.from_dict(clock.to_dict()).times
        array([0. , 1.5])
        """
        frames = from_plain(entry["frames"], dtype=np.int64)
        return cls(frames, from_plain(entry["times"]), float(entry["dt"]))


def read_clock(table: pd.DataFrame, *, dt: float) -> tuple[Clock | None, tuple[str, ...]]:
    """Return the times of the frames from the column ``time`` of a table, and notes on them.

    Parameters
    ----------
    table : pandas.DataFrame
        A clean track table.
    dt : float
        Time between successive frame numbers, s, which the column must agree with.

    Returns
    -------
    clock : Clock or None
        The time of a frame is the mean over its rows. None without a column ``time``, and where
        frames are dt apart.
    notes : tuple of str
        Sentences on how the column is used.

    Raises
    ------
    TrackTableError
        If times do not rise with the frame numbers, are missing in more than half of the frames,
        or if the median interval of neighbouring frames differs from dt by more than 1 %.

    Examples
    --------
    >>> import numpy as np
    >>> import pandas as pd
    >>> from perrin.tracks.clock import read_clock
    >>> table = pd.DataFrame({"frame": [0, 1, 2, 3], "time": [0.0, 0.5, 1.0, 9.0]})
    >>> clock, notes = read_clock(table, dt=0.5)
    >>> clock.at(np.array([0, 2, 3, 4])).tolist()
    [0.0, 1.0, 9.0, 9.5]
    """
    if "time" not in table or not table["time"].notna().any():
        return None, ()
    by_frame = table.groupby("frame")["time"]
    mean, known = by_frame.mean(), by_frame.mean().notna().to_numpy()
    frame = mean.index.to_numpy(dtype=np.int64)[known]
    time = mean.to_numpy(dtype=np.float64)[known]
    spread = float((by_frame.max() - by_frame.min()).max())
    missing, step = int((~known).sum()), np.diff(time)
    usual = float(np.median(step / np.diff(frame))) if step.size else dt
    back = np.flatnonzero(step <= 0)
    faults = []
    if missing > len(time):
        faults.append(f"{counted(missing, 'frame', 'have')} none, of {missing + len(time)}")
    elif back.size:
        where = frames_text(frame[back + 1])
        faults.append(f"it does not rise from one frame to the next at {where}")
    else:
        if abs(usual - dt) > _DT_TOLERANCE * dt:
            faults.append(
                f"its median interval is {usual:.6g} s a frame, which contradicts dt = {dt:g} s"
            )
        if step.size and spread > usual:
            faults.append(
                f"rows of one frame differ by up to {spread:.3g} s, more than an interval"
            )
    if faults:
        raise TrackTableError(
            f"the column time: {'; '.join(faults)}. Correct it or dt, or leave the column out",
            tuple(faults),
        )
    # Frames are even where their means vary only as the rows of one frame do.
    if evenly_spaced(time, frame, dt=dt) or np.ptp(time - dt * frame) <= spread:
        return None, ()
    gaps = np.diff(time) / np.diff(frame)
    notes = [
        f"the column time is used: intervals between frames run from {gaps.min():.4g} to "
        f"{gaps.max():.4g} s (median {np.median(gaps):.4g} s)"
    ]
    if not known.all():
        lacking = counted(int((~known).sum()), "frame", "have")
        notes.append(f"{lacking} no time; it is interpolated")
    return Clock(frame, time, dt), tuple(notes)


def own_times(table: pd.DataFrame, *, dt: float) -> tuple[Floats | None, tuple[str, ...]]:
    """Return the time of every row after the mean of its frame, where rows have their own times.

    Parameters
    ----------
    table : pandas.DataFrame
        A clean track table, perhaps with the column ``time``, s.
    dt : float
        Time between frames, s.

    Returns
    -------
    delays : ndarray, shape (N,), or None
        Seconds; None where all rows of a frame have one time, or some rows have none.
    notes : tuple of str
        A sentence on how the times are used.

    Examples
    --------
    >>> import pandas as pd
    >>> table = pd.DataFrame({"frame": [0, 0, 1, 1], "time": [0.0, 0.1, 1.0, 1.1]})
    >>> own_times(table, dt=1.0)[0].round(3)
    array([-0.05,  0.05, -0.05,  0.05])
    """
    if "time" not in table or not table["time"].notna().any():
        return None, ()
    mean = table.groupby("frame")["time"].transform("mean")
    delay = (table["time"] - mean).to_numpy(dtype=np.float64)
    longest = float(np.nanmax(np.abs(delay)))
    if not longest > _GRID_TOLERANCE * dt:
        return None, ()
    lacking = int(np.isnan(delay).sum())
    if lacking:
        return None, (
            "the rows of a frame have different times, but "
            f"{counted(lacking, 'row', 'have')} none: all are "
            "taken as recorded at the mean time of their frame",
        )
    return delay, (
        f"the rows of a frame have their own times, up to {longest:.3g} s from its mean: bodies "
        "are fitted with the motion between them",
    )


def frames_from_times(times: Floats) -> tuple[Ints, list[str], list[str]]:
    """Return the frames of rows, numbered by the times at which they were recorded.

    Parameters
    ----------
    times : ndarray, shape (N,)
        Time of each row, s.

    Returns
    -------
    frames : ndarray of int64, shape (N,)
        From 0 at the first time. Where all intervals are multiples of the usual one, a longer one
        leaves out frames; otherwise times are numbered in their order.
    notes, faults : list of str

    Examples
    --------
    >>> frames, notes, faults = frames_from_times(np.array([5.0, 5.5, 5.5, 6.5]))
    >>> frames.tolist(), notes
    ([0, 1, 1, 3], ['frames are numbered by the column time: 3 times, 0.5 s apart'])
    """
    known = np.isfinite(times)
    if not known.all():
        text = f"time: {(~known).sum()} entries are missing, which are needed to number the frames"
        return np.zeros(len(times), dtype=np.int64), [], [text]
    distinct = np.unique(times)
    gaps = np.diff(distinct)
    if gaps.size:
        # Rounding may have made two times of one.
        new = np.concatenate([[True], gaps > _SAME_TIME * np.median(gaps)])
        distinct = distinct[new]
        gaps = np.diff(distinct)
    usual = float(np.quantile(gaps, 0.5, method="lower")) if gaps.size else np.nan
    multiples = np.round(gaps / usual)
    even = bool(np.all(np.abs(gaps / usual - multiples) <= _INTERVAL_TOLERANCE))
    steps = multiples if even and np.all(multiples >= 1) else np.ones(len(gaps))
    numbers = np.concatenate([[0], np.cumsum(steps)]).astype(np.int64)
    row = np.searchsorted(distinct, times, side="right") - 1
    apart = f", {usual:.4g} s apart" if even else f", unevenly spaced (median {usual:.4g} s)"
    note = f"frames are numbered by the column time: {len(distinct)} times{apart}"
    return numbers[row], [note], []


def evenly_spaced(times: Floats, frames: Ints, *, dt: float) -> bool:
    """Return whether frames were recorded dt apart, counted from the first.

    Examples
    --------
    >>> import numpy as np
    >>> evenly_spaced(np.array([3.0, 3.5, 4.5]), np.array([0, 1, 3]), dt=0.5)
    True
    """
    grid = times[0] + dt * (frames - frames[0])
    return bool(np.all(np.abs(times - grid) <= _GRID_TOLERANCE * dt))


def frame_stride(table: pd.DataFrame) -> tuple[str, ...]:
    """Return a sentence where all frame numbers are multiples of a number, counted from the first.

    Examples
    --------
    >>> import pandas as pd
    >>> from perrin.tracks.clock import frame_stride
    >>> frame_stride(pd.DataFrame({"frame": [0, 5, 10, 20]}))[0][:36]
    'frame numbers are multiples of 5: a '
    """
    frame = np.sort(table["frame"].unique().astype(np.int64))
    stride = int(np.gcd.reduce(np.diff(frame))) if len(frame) > 2 else 1
    if stride == 1:
        return ()
    return (
        f"frame numbers are multiples of {stride}: a step between neighbouring rows takes "
        f"{stride} dt; if dt is the time between these rows, number the frames 0, 1, 2, ...",
    )
