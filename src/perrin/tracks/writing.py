"""Writing files so that they appear whole or not at all."""

from __future__ import annotations

import os
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Give a path to write to, which is renamed to `path` when all has been written.

    The file is flushed to the disk before it is renamed, and its folder afterwards, so that a power
    cut leaves the old file or the new one.

    Parameters
    ----------
    path : Path
        Final path of the file.

    Yields
    ------
    Path
        A path in the same folder; it is removed if the writing fails.

    Raises
    ------
    OSError
        If the file cannot be written; the message names `path`.
    """
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield part
        _flush(part)
        part.replace(path)
        if os.name == "posix":
            _flush(path.parent)
    except OSError as fault:
        if fault.errno is None:
            raise
        # The system's message names the temporary path, or none.
        raise type(fault)(fault.errno, fault.strerror, str(path)) from fault
    finally:
        part.unlink(missing_ok=True)


def _flush(path: Path) -> None:
    """Force a file or a folder onto the disk."""
    handle = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
