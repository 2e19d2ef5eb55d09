"""Lists in messages: the first items and the number of the rest."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable


def listed(items: Iterable[object], *, most: int = 10) -> str:
    """Return items separated by commas, at most `most` of them, and the number of the others.

    Parameters
    ----------
    items : iterable
    most : int
        The largest number of items that are written out.

    Returns
    -------
    str

    Examples
    --------
    >>> listed(["a", "b"]), listed(range(300), most=3)
    ('a, b', '0, 1, 2 and 297 more')
    """
    texts = [str(item) for item in items]
    more = f" and {len(texts) - most} more" if len(texts) > most else ""
    return ", ".join(texts[:most]) + more


def frames_text(frames: Iterable[int], *, most: int = 10) -> str:
    """Return frame numbers as they stand in a sentence, at most `most` of them.

    Parameters
    ----------
    frames : iterable of int
    most : int
        The largest number of frames that are written out.

    Returns
    -------
    str

    Examples
    --------
    >>> frames_text([7]), frames_text([3, 8, 9], most=2)
    ('frame 7', 'frames 3, 8 and 1 more')
    """
    numbers = [int(frame) for frame in frames]
    return f"frame{'s' if len(numbers) != 1 else ''} {listed(numbers, most=most)}"
