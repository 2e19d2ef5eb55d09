"""The page of a study: study.html, one file that needs no other."""

from __future__ import annotations

import re
from collections import Counter
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np

from perrin._text import number_text, percent, unit_text
from perrin.report.embedding import packed, page_script, plotly_script, source_hash
from perrin.report.html import inline_pictures, render_page
from perrin.study.conditions import QUANTITIES, QUANTITY_UNITS, cluster_name, condition_text
from perrin.study.ledger import RUNS
from perrin.study.trends import law_values

if TYPE_CHECKING:
    from perrin.study.manifest import StudyMovie
    from perrin.study.profiles import Interval
    from perrin.study.study_results import StudyResult

SAMPLES = "samples"  # folder of the pages of samples

_MOST_SINGLES = 3000  # single clusters that a figure draws; SVG with more is slow
_MOST_WARNINGS = 24  # columns of the matrix of warnings
_DOWNLOADS = (
    ("results.csv", "all values and means, tidy"),
    ("results.parquet", "the same, with types"),
    ("summary.json", "means, trends and comparisons"),
    ("movies.csv", "movies: files, hashes, status"),
    ("study.toml", "the manifest as used"),
    ("provenance.json", "versions, hashes, command"),
    ("figures/conditions.pdf", "the figure"),
    ("study.log", "the log"),
)


def render_study(result: StudyResult) -> str:
    """Return a study as one HTML page.

    Parameters
    ----------
    result : StudyResult
        Its figures, if they are written, are part of the page for browsers without scripts.

    Returns
    -------
    str
    """
    script = page_script("study")
    plotly, plotly_hash = plotly_script()
    pictures = inline_pictures(sorted((result.folder / "figures").glob("conditions.png")))
    bodies = list(result.by_body())
    done = [e for e in result.entries.values() if e.status == "done"]
    clusters_apart = {(v.body, v.apart_because, v.name) for v in result.values if v.apart_because}
    apart = Counter((body, reason) for body, reason, _ in clusters_apart)
    return render_page(
        "study",
        title=result.manifest.title,
        date=f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC",
        movies=len(result.manifest.movies),
        measured=len(done),
        clusters=sum(len(e.clusters) for e in done),
        bodies=bodies,
        picture=pictures.get("conditions"),
        rows=_condition_rows(result),
        trends=[(name, one.text) for name, one in result.trends.items()],
        comparisons=[
            (a.body, a.quantity, condition_text(a.conditions), condition_text(b.conditions), one)
            for a, b, one in result.comparisons
        ],
        outlying=[
            {
                "name": name,
                "kind": one.kind,
                "where": f"{mean.body}, {mean.label}: {mean.quantity}",
                "deviation": f"{one.deviation:+.1f}".replace("-", "−"),
                "p": number_text(one.p),
                "change": f"{100 * one.change:+.1f} %".replace("-", "−"),
                "errors": f"{one.change_in_errors:+.1f}".replace("-", "−"),
            }
            for mean in result.means
            for name, one in mean.outlying
        ],
        apart=[(body, reason, n) for (body, reason), n in sorted(apart.items())],
        failed=[(e.name, e.reason) for e in result.failed],
        movie_rows=_movie_rows(result),
        matrix=warning_matrix(result),
        methods=study_methods(result),
        downloads=[
            (name, text)
            for name, text in _DOWNLOADS
            if name != "figures/conditions.pdf" or result.means
        ],
        data=_figure_data(result),
        script=script,
        plotly=plotly,
        script_sources=f"{source_hash(script)} {plotly_hash}",
    )


def render_samples(result: StudyResult) -> list[str]:
    """Return a page for each sample: its movies with links to their runs, its clusters, warnings.

    Parameters
    ----------
    result : StudyResult

    Returns
    -------
    list of str
        In the order in which the manifest names the samples.
    """
    clusters: dict[str, dict[str, dict[str, Any]]] = {}
    for one in result.values:
        if one.quantity not in ("D_R", "D_T"):
            continue
        known = clusters.setdefault(one.movie.sample, {}).setdefault(
            one.name,
            {
                "name": one.name,
                "body": one.body,
                "frames": one.frames,
                "motion": [],
                "apart": [],
            },
        )
        known[one.quantity] = _interval_text(one.coefficient)
        for key, text in (("motion", one.verdict), ("apart", one.apart_because)):
            if text and text not in known[key]:
                known[key].append(text)
    movies: dict[str, list[StudyMovie]] = {}
    for movie in result.manifest.movies:
        movies.setdefault(movie.sample, []).append(movie)
    rows: dict[str, list[dict[str, Any]]] = {}
    for row in _movie_rows(result):
        rows.setdefault(row["sample"], []).append(row)
    pages = []
    for sample, members in movies.items():
        warnings = []
        for entry in (result.entries[m.name] for m in members if m.name in result.entries):
            warnings += [(entry.name, text) for text in entry.warnings]
            for cluster in entry.clusters:
                name = cluster_name(entry.name, cluster["label"], cluster["cluster"])
                warnings += [(name, text) for text in cluster["warnings"]]
        pages.append(
            render_page(
                "sample",
                title=result.manifest.title,
                sample=sample,
                condition=" / ".join(dict.fromkeys(condition_text(m.conditions) for m in members)),
                movies=rows[sample],
                clusters=list(clusters.get(sample, {}).values()),
                warnings=warnings,
            )
        )
    return pages


def study_methods(result: StudyResult) -> str:
    """Return how the means of a study were obtained, for a methods section.

    Parameters
    ----------
    result : StudyResult

    Returns
    -------
    str
    """
    from perrin import __version__

    if not result.means:
        return ""
    clusters = sum(one.mean.n_clusters for one in result.means if one.quantity == "D_R")
    movies = len({v.movie.unit for v in result.values})
    averaged = ", ".join(result.manifest.average)
    text = (
        f"Diffusion coefficients of {clusters} clusters in {movies} movies were measured with "
        f"perrin {__version__} (Hunter et al. 2011), each with its profile likelihood. Means over "
        "a condition are those of ln D in a model of random effects: clusters differ within a "
        "movie and movies differ within a condition, both with normal spreads of ln D, which were "
        "estimated by restricted maximum likelihood from the likelihoods of the single clusters. "
        "Intervals of the means are those of the likelihood ratio, scaled by the dispersion of "
        "the movies, with Student's t of one degree of freedom less than the movies (Hartung and "
        "Knapp 2001); where a condition has one movie they hold for this movie. Clusters whose "
        f"motion has another verdict than {averaged}, clusters that are not rigid, and excluded "
        "ones are listed but not averaged."
    )
    values = [
        f"{one.quantity} = {_interval_text(one.mean)} {one.mean.unit} ({one.body}, {one.label})"
        for one in result.means
        if one.quantity != QUANTITIES[-1]
    ]
    return f"{text} Results (95 % intervals): {'; '.join(values[:12])}."


def ordered_conditions(result: StudyResult) -> list[str]:
    """Return the conditions of a study in words, numbers in ascending order.

    Parameters
    ----------
    result : StudyResult

    Returns
    -------
    list of str
    """
    every = {condition_text(m.conditions): m.conditions for m in result.manifest.movies}

    def place(label: str) -> list[tuple[bool, float, str]]:
        return [
            (isinstance(v, str), 0.0 if isinstance(v, str) else float(v), str(v))
            for v in (every[label][name] for name in result.manifest.conditions)
        ]

    return sorted(every, key=place)


def warning_matrix(result: StudyResult) -> dict[str, Any]:
    """Return how often each kind of warning occurs in each movie.

    Texts that differ in numbers and names of clusters alone are one kind.

    Parameters
    ----------
    result : StudyResult

    Returns
    -------
    dict
        "kinds": texts of the most frequent ones; "rows": name of the movie, its counts, and the
        number of its warnings of other kinds.
    """
    by_movie = {}
    examples: dict[str, str] = {}
    for entry in result.entries.values():
        texts = [*entry.warnings, *(w for c in entry.clusters for w in c["warnings"])]
        count: Counter[str] = Counter()
        for text in texts:
            key = re.sub(r"[-+]?\d[\d.,]*(e[-+]?\d+)?", "#", text)[:80]
            examples.setdefault(key, text)
            count[key] += 1
        by_movie[entry.name] = count
    total: Counter[str] = Counter()
    for count in by_movie.values():
        total.update(dict.fromkeys(count, 1))
    kinds = [key for key, _ in total.most_common(_MOST_WARNINGS)]
    rows = [
        (
            movie.name,
            [by_movie[movie.name][key] for key in kinds],
            sum(n for key, n in by_movie[movie.name].items() if key not in kinds),
        )
        for movie in result.manifest.movies
        if by_movie.get(movie.name)
    ]
    return {"kinds": [examples[key] for key in kinds], "rows": rows}


def _condition_rows(result: StudyResult) -> list[dict[str, Any]]:
    """Return a row of the table of conditions for each kind of bodies and condition."""
    rows: dict[tuple[str, str], dict[str, Any]] = {}
    bodies = list(result.by_body())
    order = ordered_conditions(result)
    for one in result.means:
        row = rows.setdefault(
            (one.body, one.label),
            {"body": one.body, "condition": one.label, "cells": {}, "movies": 0, "clusters": 0},
        )
        row["movies"] = max(row["movies"], one.mean.n_movies)
        row["clusters"] = max(row["clusters"], one.mean.n_clusters)
        row["scope"] = one.mean.scope
        decoupled = result.decoupling(one)
        row["cells"][one.quantity] = {
            "value": _interval_text(one.mean),
            "within": _spread_text(one.mean.spread_clusters, one.mean.spread_clusters_ci95),
            "between": _spread_text(one.mean.spread_movies, one.mean.spread_movies_ci95),
            "predicted": None if one.predicted is None else number_text(one.predicted),
            "decoupling": None if decoupled is None else number_text(decoupled),
        }
    return sorted(
        rows.values(), key=lambda row: (bodies.index(row["body"]), order.index(row["condition"]))
    )


def _interval_text(one: Interval) -> str:
    """Return a coefficient or a mean with its 95 % interval."""
    low, high = one.ci95
    value = number_text(one.value)
    if not np.isfinite(high) or high > 1e3 * max(one.value, 1e-300):
        return f"{value} (above {number_text(low)})"
    return f"{value} ({number_text(low)} to {number_text(high)})"


def _spread_text(value: float | None, ends: tuple[float, float] | None) -> str:
    """Return a spread of ln D in percent with its interval."""
    if value is None or ends is None:
        return "–"
    high = percent(ends[1]) if ends[1] < 10 else "no bound"
    shown, low = (percent(one) if one else "0" for one in (value, ends[0]))
    return f"{shown} ({low} to {high})"


def _movie_rows(result: StudyResult) -> list[dict[str, Any]]:
    """Return a row for each movie, with the link to its run."""
    rows = []
    samples = list(dict.fromkeys(movie.sample for movie in result.manifest.movies))
    number = {sample: k for k, sample in enumerate(samples, start=1)}
    for movie in result.manifest.movies:
        entry = result.entries.get(movie.name)
        link = None
        if entry is not None and entry.status == "done":
            link, page = f"{RUNS}/{movie.name}/", "report.html"
            if entry.settings.get("reports") or (result.folder / link / page).is_file():
                link += page
        rows.append(
            {
                "name": movie.name,
                "sample": movie.sample,
                "page": f"{SAMPLES}/{number[movie.sample]}.html",
                "condition": condition_text(movie.conditions),
                "replicate": movie.replicate or "",
                "link": link,
                "clusters": 0 if entry is None else len(entry.clusters),
                "warnings": 0
                if entry is None
                else len(entry.warnings) + sum(len(c["warnings"]) for c in entry.clusters),
                "status": "not measured" if entry is None else entry.status,
                "reason": "" if entry is None else entry.reason,
            }
        )
    return rows


def _figure_data(result: StudyResult) -> str:
    """Return what the figure draws, compressed: means, laws, and single clusters."""
    first = result.manifest.conditions[:1]
    numbers = bool(first) and all(
        isinstance(m.conditions[first[0]], int | float) for m in result.manifest.movies
    )
    labels = ordered_conditions(result)

    def place(conditions: dict[str, float | str]) -> float:
        if numbers:
            return float(conditions[first[0]])
        return float(labels.index(condition_text(conditions)))

    panels, columns = [], {}
    for b, (body, of_body) in enumerate(result.by_body().items()):
        for q, quantity in enumerate(QUANTITIES):
            means = of_body[quantity]
            singles = [
                v
                for v in result.values
                if v.body == body and v.quantity == quantity and v.coefficient.value > 0
            ]
            every = 1 + (len(singles) - 1) // _MOST_SINGLES if singles else 1
            singles = singles[::every]
            key = f"{b}-{q}"
            columns[f"{key}-x"] = np.array([place(v.movie.conditions) for v in singles])
            columns[f"{key}-y"] = np.array([v.coefficient.value for v in singles])
            columns[f"{key}-apart"] = np.array([float(bool(v.apart_because)) for v in singles])
            trend = result.trends.get(f"{body}: {quantity}")
            line: dict[str, Any] | None = None
            if trend is not None and numbers:
                x = np.linspace(float(trend.x.min()), float(trend.x.max()), 60)
                y = law_values(trend.law, x, trend.parameters)
                line = {"x": x.tolist(), "y": y.tolist(), "name": trend.law}
            panels.append(
                {
                    "key": key,
                    "body": body,
                    "quantity": quantity,
                    "unit": unit_text(QUANTITY_UNITS[quantity]),
                    "every": every,
                    "names": [v.name for v in singles],
                    "x": [place(m.conditions) for m in means],
                    "labels": [m.label for m in means],
                    "value": [_finite(m.mean.value) for m in means],
                    "low": [_finite(max(m.mean.ci95[0], m.mean.value / 1e3)) for m in means],
                    "high": [_finite(min(m.mean.ci95[1], m.mean.value * 1e3)) for m in means],
                    "predicted": [m.predicted for m in means],
                    "line": line,
                }
            )
    header = {
        "panels": panels,
        "axis": first[0] if numbers else "",
        "labels": [] if numbers else labels,
        "bodies": list(result.by_body()),
    }
    return packed(header, columns, exact=columns.keys())


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
