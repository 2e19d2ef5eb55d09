"""How much memory the content of a file may take, by its length; errors of its decoders."""

from __future__ import annotations

import os
import re
from contextlib import contextmanager
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING

from perrin.errors import TrackTableError, table_error

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

LIMIT = "PERRIN_MEMORY"  # environment variable that raises the limit

_ALWAYS = 2**28  # bytes that any file may take: frames of 256 MiB
_RATIO = 32  # bytes of content of one byte of a file; compressed images of spheres have under 20

# Length from which the files of a folder are not counted further: no machine has so much memory.
_ENOUGH = 2**38

_UNITS = {"": 1, "K": 2**10, "M": 2**20, "G": 2**30, "T": 2**40}


def allowed_memory(length: int) -> int:
    """Return the number of bytes that one frame, or one table, of a file may take.

    256 MiB, and 32 bytes for every byte of the file. The environment variable ``PERRIN_MEMORY``
    (such as ``8G``) is the limit where it is larger.

    Parameters
    ----------
    length : int
        Length of the file, bytes; of a folder, that of all its files.

    Returns
    -------
    int

    Raises
    ------
    ValueError
        If the environment variable is no size.

    Examples
    --------
    >>> allowed_memory(1000) >= 2**28
    True
    """
    stated = os.environ.get(LIMIT, "").strip()
    size = re.fullmatch(r"(\d{1,15})\s*([KMGT]?)i?B?", stated, re.IGNORECASE) if stated else None
    if stated and size is None:
        raise ValueError(f"the environment variable {LIMIT}: expected a size as 8G, got {stated!r}")
    least = int(size[1]) * _UNITS[size[2].upper()] if size else 0
    return max(_ALWAYS + _RATIO * length, least)


def length_of(path: str | os.PathLike[str]) -> int:
    """Return the length of a file, or of all files in a folder, bytes; 0 where there is none."""
    place = Path(path)
    if place.is_file():
        return place.stat().st_size
    total = 0
    for folder, _, names in os.walk(place):
        if total > _ENOUGH:
            break
        total += sum(os.lstat(os.path.join(folder, name)).st_size for name in names)
    return total


def refuse_oversize(
    path: str | os.PathLike[str], shape: Sequence[int], itemsize: int, *, what: str
) -> None:
    """Refuse an array that is larger than the length of its file warrants.

    Parameters
    ----------
    path : path
    shape : sequence of int
        Shape that the file states.
    itemsize : int
        Bytes of one element.
    what : str
        Name of the array in the message.

    Raises
    ------
    ValueError

    Examples
    --------
    >>> refuse_oversize("none", (2**20, 2**20), 2, what="a frame")
    Traceback (most recent call last):
        ...
    ValueError: a frame of 1048576 x 1048576 (2 TiB) is larger than the file's length warrants: \
the file is damaged, or set PERRIN_MEMORY=2049G
    """
    needed = prod(int(n) for n in shape) * itemsize
    if min(shape, default=0) < 0 or needed > allowed_memory(length_of(path)):
        raise ValueError(oversize_text(f"{what} of {' x '.join(map(str, shape))}", needed))


def oversize_text(what: str, n_bytes: int) -> str:
    """Return why something is refused that is larger than its file warrants, and what to do.

    Examples
    --------
    >>> oversize_text("a frame", 2**33)
    "a frame (8 GiB) is larger than the file's length warrants: the file is damaged, or set \
PERRIN_MEMORY=9G"
    """
    return (
        f"{what} ({size_text(n_bytes)}) is larger than the file's length warrants: the file is "
        f"damaged, or set {LIMIT}={n_bytes // 2**30 + 1}G"
    )


def refuse_large_archive(data: bytes, source: str) -> None:
    """Refuse a zip archive (a spreadsheet) whose files are larger than its length warrants.

    Parameters
    ----------
    data : bytes
        Any other file passes.
    source : str
        The file's name, for messages.

    Raises
    ------
    TrackTableError

    Examples
    --------
    >>> refuse_large_archive(b"no archive", "t.xls")
    """
    import io
    import zipfile

    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            total = sum(entry.file_size for entry in archive.infolist())
    except (zipfile.BadZipFile, ValueError, NotImplementedError, OSError):
        return  # the reader of spreadsheets says what is wrong
    if total > allowed_memory(len(data)):
        raise table_error(source, oversize_text("the unpacked spreadsheet", total))


@contextmanager
def refusing_foreign_errors(source: str) -> Iterator[None]:
    """Turn the errors of decoders of damaged tables, which are of any class, into our own.

    Parameters
    ----------
    source : str
        The file's name, for messages.

    Raises
    ------
    TrackTableError

    Examples
    --------
    >>> with refusing_foreign_errors("t.csv"):
    ...     int("1x")
    Traceback (most recent call last):
        ...
    perrin.errors.TrackTableError: t.csv: cannot be read as a table (ValueError: invalid literal \
for int() with base 10: '1x'); write or fetch it again
    """
    try:
        yield
    except (TrackTableError, ImportError, OSError):
        raise
    except MemoryError:
        raise table_error(source, "takes more memory than there is: the file is damaged") from None
    # The decoders of damaged files raise errors of any class.
    except Exception as fault:
        # A fault of an argument is no fault of the file.
        if type(fault) is ValueError and str(fault).startswith("scale: "):
            raise
        reason = f"{type(fault).__name__}: {' '.join(str(fault).split())[:300]}"
        raise table_error(
            source, f"cannot be read as a table ({reason}); write or fetch it again"
        ) from fault


def size_text(n_bytes: int) -> str:
    """Write a number of bytes with its unit.

    Examples
    --------
    >>> size_text(13 * 2**40), size_text(3 * 2**19), size_text(7)
    ('13 TiB', '1.5 MiB', '7 B')
    """
    size, unit = float(n_bytes), "B"
    for larger in ("KiB", "MiB", "GiB", "TiB"):
        if abs(size) < 1024:
            break
        size, unit = size / 1024, larger
    return f"{size:.3g} {unit}"
