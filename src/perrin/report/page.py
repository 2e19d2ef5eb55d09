"""The report page: results of a run as one HTML file that needs no other file."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from perrin.plot.motion import MOTION_CAPTION
from perrin.report.citations import (
    PAPER_BIBTEX,
    folder_links,
    methods_paragraph,
    software_bibtex,
)
from perrin.report.embedding import page_script, plotly_script, source_hash
from perrin.report.figure_data import cluster_data, grouped_tracks
from perrin.report.html import byline, captioned, inline_pictures, render_page, render_part
from perrin.report.overview import (
    kind_rows,
    overview_data,
    overview_row,
    pooled_texts,
    remark_rows,
)
from perrin.report.result_texts import cluster_texts, coefficient_texts
from perrin.run.remarks import condensed
from perrin.run.repetition import command_line, python_lines
from perrin.run.statements import answer_lines, verdict_lines

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from perrin.run.results import Report
    from perrin.run.workers import Progress


# Caption of each figure: its title, what it shows, and what to check.
_RESULT_CAPTIONS = {
    "curves": (
        "Mean square displacements against lag time.",
        "Mean square angular displacement (left) and mean square displacement (right) against lag "
        "time. Points: the data, faint beyond a quarter of the track, where few independent "
        "displacements remain. Band: one standard error of Brownian motion. Line: the "
        "maximum-likelihood fit to the steps, not to these points. Open circles: "
        "the same diffusion without noise. Dashed: the noise floor that the localisation error "
        "predicts.",
        "The points should follow the line within the band over the first quarter (neighbouring "
        "lags are correlated). Points that approach the dashed line at short lags are noise; "
        "an upward bend at long lags is drift or driven motion, a plateau is confinement.",
    ),
    "residuals": (
        "Residuals and detected particles.",
        "Root mean square distance of the particles to the rigid body fitted to the frame (top), "
        "and the number of detected particles (bottom). Crosses mark frames without a pose.",
        "Uniform scatter about the line is localisation error. Slow waves mean that the body is "
        "not rigid, single spikes are bad localisations, and a lasting step is an exchange of "
        "labels.",
    ),
    "sphere": (
        "Paths of the particles' directions.",
        "Paths of the particles' directions on the unit sphere in lab axes; strong on the side of "
        "the viewer, faint on the far side; an open circle marks the end of each path.",
        "A freely diffusing body has no preferred orientation. Long straight chords are jumps or "
        "gaps; rings about one axis are driven or hindered rotation.",
    ),
    "angle": (
        "Angle in the plane.",
        "Angle of the body in the plane since the first frame, full turns counted; gaps are "
        "frames without a pose, an open circle marks the end.",
        "A freely diffusing body has no trend. A steady slope is driven rotation; jumps are "
        "exchanges of labels.",
    ),
    "motion": MOTION_CAPTION,
    "clusters": (
        "All clusters.",
        "Diffusion coefficients of all clusters with 68 % (thick) and 95 % (thin) intervals; the "
        "vertical band is the pooled value with its intervals. Triangles are upper limits.",
        "If all clusters have the same coefficient, about one thin line in twenty does not contain "
        "the pooled value. If many do not, the clusters differ, and the pooled value describes "
        "none of them.",
    ),
}

# Characters of the figures and details of single clusters, and what a row of the table takes of
# them: with these the page of 10 000 clusters stays below 15 MB.
_MOST_DETAILS, _ROW_SIZE = 11_000_000, 550

# Units of the arguments of `analyze`.
_ARGUMENT_UNITS = {
    "dt": "s",
    "sigma": "µm",
    "contact": "µm",
    "exposure": "of dt",
    "viscosity": "Pa s",
    "temperature": "K",
    "diameter": "µm",
    "scale": "µm per unit",
}


def render_html(
    report: Report, figures: Iterable[Path], *, progress: Progress | None = None
) -> str:
    """Return a report as one HTML page that needs no other file.

    Parameters
    ----------
    report : Report
    figures : iterable of Path
        Files of `perrin.plot.report_figures.save_figures`; the page contains the PNGs among them.
    progress : callable, optional
        Called with the number of finished clusters, their total, and what is done.

    Returns
    -------
    str
    """
    pictures, pooled = inline_pictures(figures), report.pooled
    settings, source = report.settings, report.settings.get("input", {})
    several = len(report.results) > 1
    # Noise, exposure and drift are the same for all clusters.
    method = pooled or next(iter(report.clusters), None)
    headline = [] if pooled is None else coefficient_texts(pooled)
    if pooled is None and report.rods and not several:
        headline = coefficient_texts(report.rods[0])
    version = settings.get("versions", {}).get("perrin", "")
    script = page_script("report")
    plotly, plotly_hash = plotly_script()
    chosen = None
    if report.results:
        first = report.results[0]
        kinds = {
            "rotation": "motion",
            "translation": "motion",
            "curves": "curves",
            "residuals": "residuals",
            "orientations": "angle" if first.motion.center.shape[1] == 2 else "sphere",
        }
        drawn = [
            captioned(pictures, f"cluster-{first.cluster}-{name}", kind, _RESULT_CAPTIONS[kind])
            for name, kind in kinds.items()
        ]
        chosen = cluster_texts(first, report) | {"figures": [one for one in drawn if one]}
    payloads: dict[int, str] = {}
    tracks, size = grouped_tracks(report.tracks), 0
    most = _MOST_DETAILS - _ROW_SIZE * len(report.results)
    # Beside the first one clusters with warnings come before the others.
    order = [*report.results[:1], *sorted(report.results[1:], key=lambda one: not one.warnings)]
    for done, result in enumerate(order):
        if payloads and size > most:
            break
        if progress is not None:
            progress(done, len(report.results), "writing the report")
        texts = cluster_texts(result, report)
        data = cluster_data(
            result,
            tracks.get(result.cluster, np.empty((0, 5))),
            clusters=len(report.results),
            diameter=settings.get("arguments", {}).get("diameter"),
            title=texts["title"],
            numbers=render_part("cluster", "numbers", texts, several),
            details=render_part("cluster", "details", texts),
            still=texts["still"],
        )
        payloads[result.cluster] = data
        size += len(data)
    subject = f"Rotational diffusion of {'clusters' if several else 'a cluster'}"
    if not report.results:
        subject = "Translational diffusion of single spheres"
    return render_page(
        "report",
        **byline(settings),
        input_path=source.get("path") or "a table in memory",
        sha256=source.get("sha256") or "none (no file)",
        arguments=[
            (name, "not given" if value is None else f"{value} {unit}".strip())
            for name, value in settings.get("arguments", {}).items()
            for unit in (_ARGUMENT_UNITS.get(name, ""),)
        ],
        versions=list(settings.get("versions", {}).items()),
        several=several,
        results=len(report.results),
        clusters=len(report.clusters),
        rods=len(report.rods),
        label=None if several or not report.results else report.results[0].label,
        subject=subject,
        answer=answer_lines(report),
        kinds=kind_rows(report) if report.pooled_by_kind else [],
        headline=headline,
        verdict=[" ".join(texts) for texts in verdict_lines(report).values()],
        overview=[overview_row(one, report) for one in (report.results if several else ())],
        pooled=pooled_texts(report) if several and pooled is not None else None,
        has_images=report.imaging is not None,
        warnings=condensed(report.warnings),
        warned=remark_rows(report, {c.name: c.warnings for c in report.results}),
        notes=condensed(report.notes),
        noted=remark_rows(report, {c.name: c.notes for c in report.results}),
        overview_figure=captioned(pictures, "clusters", "clusters", _RESULT_CAPTIONS["clusters"]),
        chosen=chosen,
        payloads={
            one.cluster: payloads[one.cluster] for one in report.results if one.cluster in payloads
        },
        overview_data=overview_data(report),
        copies=[
            ("Methods paragraph", methods_paragraph(report)),
            ("Command", command_line(settings)),
            ("Python", python_lines(settings)),
            ("BibTeX", f"{PAPER_BIBTEX}\n\n{software_bibtex(version)}"),
        ],
        links=folder_links(report),
        planar=any(c.motion.dimension == 2 for c in report.clusters),
        noise="joint" if method is None else method.D_R.settings.text,
        exposure=None if method is None else method.D_R.exposure,
        drift=method is not None and method.D_T.drift is not None,
        script=script,
        plotly=plotly,
        script_sources=f"{source_hash(script)} {plotly_hash}",
    )
