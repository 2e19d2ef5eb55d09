"""Tidy tables of a study: its movies, and the values of all clusters and conditions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from perrin.study.conditions import QUANTITY_UNITS

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import pandas as pd

    from perrin.study.conditions import ClusterValue, ConditionMean
    from perrin.study.ledger import Entry
    from perrin.study.manifest import Manifest

_BEGIN = ("of", "sample", "movie", "cluster", "label", "body")
_REST = (
    "quantity", "value", "ci68_low", "ci68_high", "ci95_low", "ci95_high", "unit", "verdict",
    "averaged", "apart_because", "predicted", "frames", "warnings", "clusters", "movies", "scope",
    "spread_clusters", "spread_clusters_low", "spread_clusters_high", "spread_movies",
    "spread_movies_low", "spread_movies_high",
)  # fmt: skip


def study_table(
    manifest: Manifest, values: Sequence[ClusterValue], means: Sequence[ConditionMean]
) -> pd.DataFrame:
    """Return the values of all clusters and the means of all conditions as a tidy table.

    Parameters
    ----------
    manifest : Manifest
    values : sequence of ClusterValue
    means : sequence of ConditionMean

    Returns
    -------
    pandas.DataFrame
        A row for every cluster (of = "cluster") or condition (of = "condition") and quantity.
        Columns: of, sample, movie, cluster, label, body, a column for every condition, quantity
        ("D_R", "D_T" or "D_T/D_R"), value, ci68_low to ci95_high, unit, verdict, averaged,
        apart_because, predicted, frames, warnings (their number); of conditions clusters and
        movies (their numbers), scope, and the spreads of ln D with their 95 % intervals.
    """
    import pandas as pd

    rows: list[dict[str, Any]] = []
    for one in values:
        rows.append(
            {
                "of": "cluster",
                "sample": one.movie.sample,
                "movie": one.movie.name,
                "cluster": one.cluster,
                "label": one.label,
                "body": one.body,
                **{_column(name): one.movie.conditions[name] for name in manifest.conditions},
                "quantity": one.quantity,
                "value": one.coefficient.value,
                **_ends(one.coefficient.ci68, one.coefficient.ci95),
                "unit": QUANTITY_UNITS[one.quantity],
                "verdict": one.verdict,
                "averaged": not one.apart_because,
                "apart_because": one.apart_because or None,
                "predicted": one.predicted,
                "frames": one.frames,
                "warnings": one.warnings,
            }
        )
    for mean in means:
        found = mean.mean
        nothing = (np.nan, np.nan)
        within, between = found.spread_clusters_ci95 or nothing, found.spread_movies_ci95 or nothing
        rows.append(
            {
                "of": "condition",
                "body": mean.body,
                **{_column(name): mean.conditions[name] for name in manifest.conditions},
                "quantity": mean.quantity,
                "value": found.value,
                **_ends(found.ci68, found.ci95),
                "unit": QUANTITY_UNITS[mean.quantity],
                "predicted": mean.predicted,
                "clusters": found.n_clusters,
                "movies": found.n_movies,
                "scope": found.scope,
                "spread_clusters": found.spread_clusters,
                "spread_clusters_low": within[0],
                "spread_clusters_high": within[1],
                "spread_movies": found.spread_movies,
                "spread_movies_low": between[0],
                "spread_movies_high": between[1],
            }
        )
    columns = [*_BEGIN, *map(_column, manifest.conditions), *_REST]
    table = pd.DataFrame(rows, columns=columns)
    whole = dict.fromkeys(("cluster", "frames", "warnings", "clusters", "movies"), "Int64")
    numbers = [c for c in _REST if c in ("value", "predicted") or c.startswith(("ci", "spread"))]
    return table.astype(whole | dict.fromkeys(numbers, np.float64) | {"averaged": "boolean"})


def movie_table(manifest: Manifest, entries: Mapping[str, Entry]) -> pd.DataFrame:
    """Return the movies of a study as a table.

    Parameters
    ----------
    manifest : Manifest
    entries : mapping of Entry
        Results by the names of movies; may be empty.

    Returns
    -------
    pandas.DataFrame
        Columns movie, sample, path, source, replicate, a column for every condition, status,
        reason, clusters, warnings (their number), seconds, sha256. A byte of a path that is
        not UTF-8 is written as its code, a backslash and udc80 to udcff.
    """
    import pandas as pd

    rows = []
    for movie in manifest.movies:
        entry = entries.get(movie.name)
        rows.append(
            {
                "movie": movie.name,
                "sample": movie.sample,
                "path": movie.path.encode("utf-8", "backslashreplace").decode(),
                "source": movie.source,
                "replicate": movie.replicate,
                **{_column(name): movie.conditions[name] for name in manifest.conditions},
                "status": "new" if entry is None else entry.status,
                "reason": "" if entry is None else entry.reason,
                "clusters": 0 if entry is None else len(entry.clusters),
                "warnings": 0
                if entry is None
                else len(entry.warnings) + sum(len(c["warnings"]) for c in entry.clusters),
                "seconds": np.nan if entry is None else entry.seconds,
                "sha256": None if entry is None else entry.sha256,
            }
        )
    return pd.DataFrame(rows)


def _column(condition: str) -> str:
    """Return the column of a condition, which may have the name of another column."""
    return f"condition {condition}" if condition in (*_BEGIN, *_REST) else condition


def _ends(ci68: tuple[float, float], ci95: tuple[float, float]) -> dict[str, float]:
    """Return the columns of two intervals."""
    return {
        "ci68_low": ci68[0], "ci68_high": ci68[1], "ci95_low": ci95[0], "ci95_high": ci95[1],
    }  # fmt: skip
