"""Run folders: written beside their place and renamed, or resumed."""

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
    """Give a folder to write into that takes its place, whole, when all has been written.

    Raises
    ------
    FileExistsError
        If the place is taken and `overwrite` is not set, or what stands there is no run folder.
    OSError
        If the place cannot be written.
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
    """Give a folder to write into, whose files then go into an unfinished run folder.

    ``run.json`` goes last and makes the folder a finished one; what else stands there stays.

    Raises
    ------
    OSError
        If the place cannot be written.
    """
    place = Path(folder)
    place.mkdir(parents=True, exist_ok=True)
    for left in place.glob(".*.part"):  # by one that was killed
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
        The folder inside that an unfinished run has.
    overwrite : bool
        A finished one will do as well.

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
    """Refuse, before any work is done, an output folder that stands already.

    Raises
    ------
    FileExistsError, PermissionError
        As in `staged_folder`.
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
