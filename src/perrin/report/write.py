"""Run folders with data, figures and HTML pages."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING

from perrin.plot.imaging import save_image_figures
from perrin.plot.report_figures import save_figures
from perrin.report.html import write_page
from perrin.report.imaging_page import render_imaging_quality
from perrin.report.page import render_html
from perrin.run.folders import filled_folder, staged_folder
from perrin.run.results import write_data

if TYPE_CHECKING:
    import os
    from collections.abc import Iterator
    from pathlib import Path

    from perrin.run.results import Report
    from perrin.run.workers import Progress


@contextmanager
def run_folder(
    report: Report,
    folder: str | os.PathLike[str],
    *,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Iterator[Path]:
    """Write a run folder as `write_run` does, and give it to add further files before it appears.

    Parameters
    ----------
    report, folder, overwrite, progress
        As in `write_run`.

    Yields
    ------
    Path
        The folder that is renamed to `folder` at the end.

    Raises
    ------
    FileExistsError
        As `write_run`.
    """
    with staged_folder(folder, overwrite=overwrite) as stage:
        _write_files(report, stage, progress)
        yield stage


def write_run(
    report: Report,
    folder: str | os.PathLike[str],
    *,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> None:
    """Write a run folder with data, figures and HTML pages, complete or not at all.

    Parameters
    ----------
    report : Report
    folder : path
        New folder. It gets the figures in ``figures/``, the report as ``report.html`` and, for a
        run on images, the imaging quality as ``quality.html``.
    overwrite : bool
        Replace an existing run folder.
    progress : callable, optional
        Called with the number of finished clusters, their total, and what is done.

    Raises
    ------
    FileExistsError
        If the folder exists and `overwrite` is not set, or is not a run folder.
    """
    with run_folder(report, folder, overwrite=overwrite, progress=progress):
        pass


def complete_run(
    report: Report, folder: str | os.PathLike[str], *, progress: Progress | None = None
) -> None:
    """Write a run, as `write_run` does, into the folder that holds its finished frames.

    Parameters
    ----------
    report : Report
    folder : path
        Folder given to `analyze_stack` as `keep`.
    progress : callable, optional
        As in `write_run`.

    Raises
    ------
    OSError
        If the run cannot be written; the finished frames remain.
    """
    with filled_folder(folder) as stage:
        _write_files(report, stage, progress)


def _write_files(report: Report, stage: Path, progress: Progress | None) -> None:
    """Write data, figures and pages into an empty folder."""
    write_data(report, stage, progress=progress)
    place = stage / "figures"
    place.mkdir()
    html = render_html(report, save_figures(report, place, progress=progress), progress=progress)
    write_page(stage / "report.html", html)
    if report.imaging is not None:
        html = render_imaging_quality(report, save_image_figures(report, place, progress=progress))
        write_page(stage / "quality.html", html)
