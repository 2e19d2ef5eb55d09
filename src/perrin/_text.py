"""How lists of frames, names and numbers are written in messages."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable


def listed(items: Iterable[object], *, most: int = 10) -> str:
    """Write items one after another, at most `most` of them, and how many more there are.

    Examples
    --------
    >>> listed("abc"), listed(range(30), most=3)
    ('a, b, c', '0, 1, 2 and 27 more')
    """
    every = [str(item) for item in items]
    more = f" and {len(every) - most} more" if len(every) > most else ""
    return ", ".join(every[:most]) + more


def frames_text(frames: Iterable[int], *, most: int = 10) -> str:
    """Write frame numbers: "frame 3", or "frames 3, 7 and 12 more".

    Examples
    --------
    >>> frames_text([7]), frames_text([3, 7])
    ('frame 7', 'frames 3, 7')
    """
    numbers = [int(k) for k in frames]
    return f"frame{'s' if len(numbers) != 1 else ''} {listed(numbers, most=most)}"
