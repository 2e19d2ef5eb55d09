"""Run folders: written whole, or resumed, by one process at a time."""

from __future__ import annotations

import os
import shutil
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from perrin.run.lock import LOCK_INSIDE, locked
from perrin.tracks.writing import hidden_beside

if TYPE_CHECKING:
    from collections.abc import Iterator


@contextmanager
def claimed_folder(folder: str | os.PathLike[str]) -> Iterator[Path]:
    """Hold a run folder, and put in order what a process that was stopped has left beside it.

    A finished run that was about to be replaced is put back; unfinished files are removed.

    Parameters
    ----------
    folder : path
        Existing or new run folder.

    Yields
    ------
    Path
        The folder.

    Raises
    ------
    FolderInUseError
        If another process is writing there (`locked`).
    OSError
        If the folder above cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as parent, claimed_folder(Path(parent, "run")) as place:
    ...     place.name
    'run'
    """
    place = Path(folder)
    with locked(place) as first:
        if first and place.parent.is_dir():
            begin = hidden_beside(place, "").name
            left = [p for p in place.parent.iterdir() if p.name.startswith(begin)]
            for old in [p for p in left if p.name.endswith(_REPLACED) and not place.exists()]:
                old.rename(place)
            for part in [p for p in left if p.name.endswith((_UNFINISHED, _REPLACED))]:
                shutil.rmtree(part, ignore_errors=True)
        yield place


# Ends of the names of folders that are being written, and of those that are being replaced.
_UNFINISHED = ".part"
_REPLACED = ".part.old"


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
    FolderInUseError
        If another process is writing there.
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
    with claimed_folder(folder) as place:
        check_place(place, overwrite=overwrite)
        place.parent.mkdir(parents=True, exist_ok=True)
        stage = hidden_beside(place, f"{os.getpid()}{_UNFINISHED}")
        stage.mkdir()
        try:
            yield stage
            if place.exists():
                old = hidden_beside(place, f"{os.getpid()}{_REPLACED}")
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
    FolderInUseError
        If another process is writing there.
    OSError
        If the folder cannot be written.
    """
    with claimed_folder(folder) as place:
        place.mkdir(parents=True, exist_ok=True)
        for left in place.glob(f".*{_UNFINISHED}"):  # by a process that was stopped
            shutil.rmtree(left)
        stage = place / f".{os.getpid()}{_UNFINISHED}"
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
    empty = place.is_dir() and not _contents(place)
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
    if not place.is_dir() or (_contents(place) and not (place / "run.json").is_file()):
        raise FileExistsError(f"{place} is no run folder of perrin (no run.json): not overwritten")


def _contents(folder: Path) -> set[str]:
    """Return the names in a folder, but for that of a lock."""
    return {path.name for path in folder.iterdir()} - {LOCK_INSIDE}
