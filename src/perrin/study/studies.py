"""Study and StudyResult: from a manifest to one answer for each condition."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from perrin.run.lock import locked
from perrin.study.manifest import Manifest, read_manifest
from perrin.study.running import measure_all, unfinished
from perrin.study.study_results import StudyResult
from perrin.study.tables import movie_table
from perrin.study.writing import write_results

if TYPE_CHECKING:
    import os
    from collections.abc import Callable

    import pandas as pd

    from perrin.study.ledger import Entry

    Progress = Callable[[int, int, str], None]

_LOG = "study.log"


@dataclass(frozen=True, eq=False)
class Study:
    """Movies and tables under several conditions, as a manifest states them.

    Attributes
    ----------
    manifest : Manifest

    Examples
    --------
    >>> from perrin.study import StudyMovie
    >>> movie = StudyMovie("a", "a.csv", "table", "dilute", {"phi": 0.1})
    >>> Study(Manifest((movie,), conditions=("phi",))).to_frame()["status"].tolist()
    ['new']
    """

    manifest: Manifest

    @classmethod
    def from_toml(cls, path: str | os.PathLike[str]) -> Study:
        """Read a manifest.

        Parameters
        ----------
        path : path

        Raises
        ------
        ManifestError
            All faults of the manifest with their lines.
        """
        return cls(read_manifest(path))

    def to_frame(self) -> pd.DataFrame:
        """Return the movies as a table: name, sample, path, replicate, conditions."""
        return movie_table(self.manifest, {})

    def run(
        self,
        folder: str | os.PathLike[str],
        *,
        workers: int = 0,
        scheduler: str | None = None,
        progress: Progress | None = None,
        command: str = "",
    ) -> StudyResult:
        """Measure what is new or has changed, and write tables, figures and the page.

        Parameters
        ----------
        folder : path
            Folder of the study, new or of the same study. It holds a run folder for each movie in
            ``runs/``.
        workers : int
            Number of processes of this machine; 0 does the work in this one. A script calls with
            workers below the line ``if __name__ == "__main__":``, since each process imports it.
        scheduler : str, optional
            Address of a Dask scheduler, whose workers read the files and write into the folder.
        progress : callable, optional
            Called with the number of finished movies, their total, and what is done.
        command : str
            Command line, for the provenance.

        Returns
        -------
        StudyResult

        Raises
        ------
        FolderInUseError
            If another process is writing into the folder.
        OSError
            If the folder cannot be written or the scheduler does not answer.
        """
        place = Path(folder)
        with locked(place):
            if place.exists() and any(place.iterdir()) and not (place / "study.toml").is_file():
                raise FileExistsError(f"{place} is no folder of a study (no study.toml)")
            place.mkdir(parents=True, exist_ok=True)
            entries, wanted = unfinished(self.manifest.movies, place, reports=self.manifest.reports)
            if not (place / "study.toml").is_file():
                (place / "study.toml").write_text(self.manifest.text, encoding="utf-8")
            log = _Log(place / _LOG, done=len(entries), total=len(self.manifest.movies))
            log.start(len(wanted), progress)
            for entry in measure_all(
                wanted,
                place,
                reports=self.manifest.reports,
                workers=workers,
                scheduler=scheduler,
            ):
                entries[entry.name] = entry
                log.add(entry, progress)
            result = StudyResult(self.manifest, place, entries)
            if not wanted and result.is_written:
                return result
            if progress is not None:
                progress(0, 0, "means, figures and page")
            write_results(result, command=command)
            log.write("results written")
        return result


class _Log:
    """Lines about the progress of a study, on disk and for a caller."""

    def __init__(self, path: Path, *, done: int, total: int) -> None:
        self._path = path
        self._done, self._total, self._failed = done, total, 0
        self._first = done
        self._start = time.monotonic()

    def start(self, wanted: int, progress: Progress | None) -> None:
        """State what is there and what is to be done."""
        if wanted:
            self.write(f"{self._done} of {self._total} movies are finished, {wanted} to measure")
        if progress is not None:
            progress(self._done, self._total, "movies")

    def add(self, entry: Entry, progress: Progress | None) -> None:
        """Count a movie that is finished or failed."""
        self._done += 1
        self._failed += entry.status == "failed"
        passed = time.monotonic() - self._start
        left = passed / (self._done - self._first) * (self._total - self._done)
        how = f"done in {entry.seconds:.1f} s"
        if entry.status == "failed":
            how = f"failed: {entry.reason}"
        self.write(
            f"{self._done}/{self._total} {entry.name} {how}; {self._failed} failed, about "
            f"{duration_text(left)} left"
        )
        if progress is not None:
            progress(self._done, self._total, "movies")

    def write(self, line: str) -> None:
        """Append a line with the time."""
        stamp = time.strftime("%Y-%m-%d %H:%M:%S", time.gmtime())
        try:
            with self._path.open("a", encoding="utf-8") as file:
                file.write(f"{stamp} {line}\n")
        except OSError:  # a full disk: the log is not the result
            return


def duration_text(seconds: float) -> str:
    """Return a duration in words.

    Parameters
    ----------
    seconds : float

    Examples
    --------
    >>> duration_text(40), duration_text(5400), duration_text(200000)
    ('40 s', '90 min', '56 h')
    """
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.0f} h"
