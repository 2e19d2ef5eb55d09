"""The files of a study: tables, figures, page, manifest and provenance."""

from __future__ import annotations

import platform
import sys
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from perrin.report.html import write_page
from perrin.run.measure import library_version
from perrin.study.figures import save_study_figures
from perrin.study.manifest import manifest_dict
from perrin.study.page import SAMPLES, render_samples, render_study
from perrin.study.tables import movie_table
from perrin.tracks.writing import write_json, write_parquet, written_whole

if TYPE_CHECKING:
    from perrin.study.study_results import StudyResult

_VERSIONED = ("perrin", "numpy", "scipy", "pandas", "pyarrow", "distributed", "trackpy")


def write_results(result: StudyResult, *, command: str = "") -> None:
    """Write the files of a study into its folder, the provenance last.

    Each file appears whole or not at all; ``provenance.json`` states for which results the others
    are.

    Parameters
    ----------
    result : StudyResult
    command : str
        Command line.

    Raises
    ------
    OSError
        If a file cannot be written.
    """
    place = result.folder
    with written_whole(place / "study.toml") as part:
        part.write_text(result.manifest.text, encoding="utf-8")
    table = result.to_frame()
    with written_whole(place / "results.csv") as part:
        table.to_csv(part, index=False)
    with written_whole(place / "results.parquet") as part:
        # A condition may be a number in one sample and a text in another.
        mixed = {
            name: str
            for name in table
            if table[name].map(type).nunique() > 1
            and table[name].map(lambda one: isinstance(one, str)).any()
            and name in result.manifest.conditions
        }
        write_parquet(part, table.astype(mixed))
    with written_whole(place / "movies.csv") as part:
        movie_table(result.manifest, result.entries).to_csv(part, index=False)
    with written_whole(place / "summary.json") as part:
        write_json(part, result.to_dict())
    figures = place / "figures"
    figures.mkdir(exist_ok=True)
    save_study_figures(result, figures)
    pages = place / SAMPLES
    pages.mkdir(exist_ok=True)
    kept = set()
    for number, text in enumerate(render_samples(result), start=1):
        kept.add(f"{number}.html")
        with written_whole(pages / f"{number}.html") as part:
            write_page(part, text)
    for old in pages.glob("*.html"):
        if old.name not in kept:
            old.unlink()
    with written_whole(place / "study.html") as part:
        write_page(part, render_study(result))
    versions = {name: known for name in _VERSIONED if (known := library_version(name))}
    with written_whole(place / "provenance.json") as part:
        write_json(
            part,
            {
                "state": result.state,
                "created": datetime.now(UTC).isoformat(timespec="seconds"),
                "command": command,
                "python": sys.version.split()[0],
                "platform": platform.platform(),
                "versions": versions,
                "inputs": {e.name: e.sha256 for e in result.entries.values()},
                "manifest": manifest_dict(result.manifest),
            },
        )
