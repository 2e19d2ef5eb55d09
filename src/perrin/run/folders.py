"""Run folders: written whole, or resumed."""

from __future__ import annotations

import os
import shutil
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator


@contextmanager
def staged_folder(folder: str | os.PathLike[str], *, overwrite: bool = False) -> Iterator[Path]:
    """Give a folder to write into, which is renamed to `folder` when all has been written.

    Parameters
    ----------
    folder : path
        Where the files are to appear.
    overwrite : bool
        Replace an existing run folder.

    Yields
    ------
    Path
        A new folder in the same place; it is removed if the writing fails.

    Raises
    ------
    FileExistsError
        If the folder exists and `overwrite` is not set, or is no run folder.
    OSError
        If the folder cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as parent:
    ...     with staged_folder(Path(parent, "run")) as stage:
    ...         _ = (stage / "run.json").write_text("{}")
    ...     [path.name for path in Path(parent, "run").iterdir()]
    ['run.json']
    """
    place = Path(folder)
    check_place(place, overwrite=overwrite)
    place.parent.mkdir(parents=True, exist_ok=True)
    stage = place.with_name(f".{place.name}.{os.getpid()}.part")
    stage.mkdir()
    try:
        yield stage
        if place.exists():
            old = stage.with_name(stage.name + ".old")
            place.rename(old)
            stage.rename(place)
            shutil.rmtree(old)
        else:
            stage.rename(place)
    finally:
        shutil.rmtree(stage, ignore_errors=True)


@contextmanager
def filled_folder(folder: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a folder to write into, whose files are then moved into an unfinished run folder.

    ``run.json`` is moved last and makes the folder a finished one; other files of the folder are
    kept.

    Parameters
    ----------
    folder : path
        The run folder.

    Yields
    ------
    Path
        A new folder inside it; it is removed if the writing fails.

    Raises
    ------
    OSError
        If the folder cannot be written.
    """
    place = Path(folder)
    place.mkdir(parents=True, exist_ok=True)
    for left in place.glob(".*.part"):  # by a process that was stopped
        shutil.rmtree(left)
    stage = place / f".{os.getpid()}.part"
    stage.mkdir()
    try:
        yield stage
        (place / "run.json").unlink(missing_ok=True)
        for new in sorted(stage.iterdir(), key=lambda path: path.name == "run.json"):
            old = place / new.name
            if old.is_dir():
                shutil.rmtree(old)
            new.replace(old)
    finally:
        shutil.rmtree(stage, ignore_errors=True)


def check_resumable(folder: str | os.PathLike[str], *, parts: str, overwrite: bool = False) -> None:
    """Refuse an output folder that is neither new, nor empty, nor an unfinished run with parts.

    Parameters
    ----------
    folder : path
    parts : str
        Name of the folder inside that an unfinished run has.
    overwrite : bool
        Accept a finished run as well.

    Raises
    ------
    FileExistsError, PermissionError
        As in `staged_folder`.
    """
    place = Path(folder)
    unfinished = (place / parts).is_dir() and not (place / "run.json").exists()
    empty = place.is_dir() and not any(place.iterdir())
    if not (unfinished or empty):
        check_place(place, overwrite=overwrite)


def check_place(folder: str | os.PathLike[str], *, overwrite: bool = False) -> None:
    """Refuse, before any work begins, an output folder that exists or cannot be made.

    Raises
    ------
    FileExistsError, PermissionError
        As in `staged_folder`.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     check_place(Path(folder, "new"))
    """
    place = Path(folder)
    if not place.exists():
        parent = next(p for p in place.absolute().parents if p.exists())
        if not parent.is_dir() or not os.access(parent, os.W_OK):
            raise PermissionError(f"{place} cannot be made: {parent} is not a writable folder")
        return
    if not overwrite:
        raise FileExistsError(f"{place} exists: choose another folder, or overwrite=True")
    if not place.is_dir() or (any(place.iterdir()) and not (place / "run.json").is_file()):
        raise FileExistsError(f"{place} is no run folder of perrin (no run.json): not overwritten")
