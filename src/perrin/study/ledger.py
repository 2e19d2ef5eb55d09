"""What is finished in the folder of a study, and what is new or has changed since."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from perrin._arrays import to_plain
from perrin.images.formats.folders import sequence_files
from perrin.tracks.writing import write_json, written_whole

if TYPE_CHECKING:
    from collections.abc import Mapping
    from typing import Self

    from perrin.study.manifest import StudyMovie

ENTRIES, RUNS = "movies", "runs"  # folders of a study: a file for each movie, and its run folder


@dataclass(frozen=True)
class Entry:
    """The result of one movie in a study.

    Attributes
    ----------
    name : str
        Name of its run folder.
    status : {"done", "failed"}
    reason : str
        Why there is no result.
    retry : bool
        Whether a failure lies in the machine (disk, memory, a lost worker) and not in the data, so
        that the next call tries again.
    settings : dict
        What the result depends on besides the input: options and version.
    stamp : dict
        Size (bytes) and time of the last change of the input, by which it is recognised.
    sha256 : str or None
        Hash of the input.
    seconds : float
        Duration of the measurement.
    clusters : tuple of dict
        Values and intervals of every cluster.
    kinds : tuple of dict
        Kinds of bodies, each with the positions of the particles of one of them.
    warnings, notes : tuple of str
        Of the whole movie.
    """

    name: str
    status: Literal["done", "failed"]
    reason: str = ""
    retry: bool = False
    settings: dict[str, Any] = field(default_factory=dict)
    stamp: dict[str, Any] = field(default_factory=dict)
    sha256: str | None = None
    seconds: float = 0.0
    clusters: tuple[dict[str, Any], ...] = ()
    kinds: tuple[dict[str, Any], ...] = ()
    warnings: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return the entry for JSON."""
        entry: dict[str, Any] = to_plain(vars(self))
        return entry

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> Self:
        """Return the entry that `to_dict` wrote.

        Parameters
        ----------
        entry : mapping
        """
        several = ("clusters", "kinds", "warnings", "notes")
        read: dict[str, Any] = {k: tuple(v) if k in several else v for k, v in entry.items()}
        return cls(**read)


def settings_of(movie: StudyMovie, *, reports: bool) -> dict[str, Any]:
    """Return what the result of a movie depends on besides its input, as JSON holds it.

    Parameters
    ----------
    movie : StudyMovie
    reports : bool
        Whether its run folder has figures and a report page.

    Returns
    -------
    dict
    """
    from perrin import __version__

    stated = {
        "path": movie.path,
        "source": movie.source,
        "options": movie.options,
        "reports": reports,
        "version": __version__,
    }
    plain: dict[str, Any] = json.loads(json.dumps(to_plain(stated), sort_keys=True))
    return plain


def stamp_of(path: str) -> dict[str, Any]:
    """Return the size of a file, folder or sequence of files, and the time of its last change.

    Parameters
    ----------
    path : str
        Path, glob or address.

    Returns
    -------
    dict
        "bytes", "files" and "changed" (ns); the address alone for what is not on a disk.

    Examples
    --------
    >>> stamp_of("s3://bucket/movie.zarr")
    {'address': 's3://bucket/movie.zarr'}
    """
    if "://" in path:
        return {"address": path}
    place = Path(path)
    if place.is_dir():
        files = [p for p in place.rglob("*") if p.is_file()]
    else:
        files = [place] if place.exists() else [Path(p) for p in sequence_files(path)]
    states = [p.stat() for p in files]
    return {
        "bytes": sum(s.st_size for s in states),
        "files": len(states),
        "changed": max((s.st_mtime_ns for s in states), default=0),
    }


def read_entries(folder: Path) -> dict[str, Entry]:
    """Return all entries of a study by name; a damaged file counts as absent.

    Parameters
    ----------
    folder : Path
        Folder of the study.

    Returns
    -------
    dict of Entry
    """
    found = {}
    for path in sorted((folder / ENTRIES).glob("*.json")):
        try:
            entry = Entry.from_dict(json.loads(path.read_bytes()))
        except (ValueError, TypeError, KeyError):
            continue
        found[entry.name] = entry
    return found


def write_entry(folder: Path, entry: Entry) -> None:
    """Write the entry of a movie, whole or not at all.

    Parameters
    ----------
    folder : Path
        Folder of the study.
    entry : Entry
    """
    place = folder / ENTRIES / f"{entry.name}.json"
    place.parent.mkdir(parents=True, exist_ok=True)
    with written_whole(place) as part:
        write_json(part, entry.to_dict())


def is_current(entry: Entry | None, movie: StudyMovie, folder: Path, *, reports: bool) -> bool:
    """Return whether the result of a movie is that of its input and settings as they are now.

    An input whose size or time has changed counts as another one: it is measured again.

    Parameters
    ----------
    entry : Entry or None
    movie : StudyMovie
    folder : Path
        Folder of the study.
    reports : bool

    Returns
    -------
    bool
    """
    if entry is None or entry.retry or entry.settings != settings_of(movie, reports=reports):
        return False
    if entry.status == "done" and not (folder / RUNS / entry.name / "run.json").is_file():
        return False
    return entry.stamp == stamp_of(movie.path)
