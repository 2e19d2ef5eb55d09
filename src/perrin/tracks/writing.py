"""Files that appear whole or not at all."""

from __future__ import annotations

import os
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


@contextmanager
def written_whole(place: Path) -> Iterator[Path]:
    """Give a path to write to, which is renamed to `place` when all has been written.

    The file is on the disk before it is renamed, and the renaming before the function returns, so
    that a power cut leaves the old file or the new one.

    Parameters
    ----------
    place : Path
        Where the file is to appear.

    Yields
    ------
    Path
        A path in the same folder; it is removed if the writing fails.

    Raises
    ------
    OSError
        If the file cannot be written; the message names `place`.
    """
    beside = place.with_name(f".{place.name}.{os.getpid()}.part")
    try:
        yield beside
        _flush(beside)
        beside.replace(place)
        if os.name == "posix":
            _flush(place.parent)
    except OSError as fault:
        if fault.errno is None:
            raise
        # The system's message names the path beside, or none.
        raise type(fault)(fault.errno, fault.strerror, str(place)) from fault
    finally:
        beside.unlink(missing_ok=True)


def _flush(path: Path) -> None:
    """Force a file or a folder onto the disk."""
    handle = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
