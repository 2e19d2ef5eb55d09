"""What the report page writes of all clusters together: table, kinds, pooled values, remarks."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from perrin._text import length_text, listed, number_text
from perrin.report.embedding import packed
from perrin.report.result_texts import estimate_texts, named_coefficients
from perrin.run.remarks import grouped

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from perrin.run.results import BodyKind, ClusterResult, Report, RodResult

_LINKED_CLUSTERS = 10  # largest number of clusters that one line links to


def overview_row(result: ClusterResult | RodResult, report: Report) -> dict[str, Any]:
    """Return the row of a cluster or rod in the table of all, with numbers to sort by.

    Parameters
    ----------
    result : ClusterResult or RodResult
    report : Report
        The report that contains it.

    Returns
    -------
    dict
        Texts and numbers by the names of the template's columns.
    """
    (_, turn), (_, path) = named_coefficients(result)
    kinds = {v.kind for v in getattr(result, "verdicts", {}).values() if v is not None}
    return {
        "anchor": result.cluster,
        "name": result.name,
        "kind": _kind_text(report.kind_of(result.cluster)),
        "D_R": estimate_texts(turn),
        "D_T": estimate_texts(path),
        "turn_sort": (turn.value, turn.ci95[1]),
        "path_sort": (path.value, path.ci95[1]),
        "motion": ", ".join(sorted(kinds)) or "not judged",
        "sigma": length_text(result.motion.sigma),
        "sigma_sort": result.motion.sigma,
        "frames": result.motion.fitted.size,
        "warnings": len(result.warnings),
    }


def overview_data(report: Report) -> str:
    """Return values and intervals of all clusters for the forest plot, compressed.

    Parameters
    ----------
    report : Report

    Returns
    -------
    str
        The text of `packed`.
    """
    columns: dict[str, Any] = {}
    both = [named_coefficients(one) for one in report.results]
    for k, kind in enumerate(("turn", "shift")):
        estimates = [one[k][1] for one in both]
        columns |= {
            f"{kind}_value": [e.value if e.resolved else np.nan for e in estimates],
            f"{kind}_low68": [e.ci68[0] for e in estimates],
            f"{kind}_high68": [e.ci68[1] for e in estimates],
            f"{kind}_low95": [e.ci95[0] for e in estimates],
            f"{kind}_high95": [e.ci95[1] for e in estimates],
        }
    pooled: dict[str, Any] = {"turn": None, "shift": None}
    if report.pooled is not None:
        for kind, one in (("turn", report.pooled.D_R), ("shift", report.pooled.D_T)):
            numbers = (one.value, *one.ci95)
            pooled[kind] = list(numbers) if np.isfinite(numbers).all() else None
    header = {
        "keys": [one.cluster for one in report.results],
        "names": [one.name for one in report.results],
        "pooled": pooled,
    }
    return packed(header, columns, exact=columns.keys())


def _kind_text(kind: BodyKind | None) -> str:
    """Return the number of particles and the point group of a kind of clusters."""
    return "–" if kind is None else f"{kind.size}, {kind.point_group.replace('inf', '∞')}"


def kind_rows(report: Report) -> list[dict[str, Any]]:
    """Return a row for every kind of clusters, and one for the single spheres.

    Parameters
    ----------
    report : Report

    Returns
    -------
    list of dict
    """
    rows = []
    for kind in report.kinds:
        D = {name: estimate_texts(one) for name, one in kind.coefficients}
        turn = D.get("D_R", D.get("D_perp"))
        used = kind.clusters if kind.pooled is None else kind.pooled.clusters
        rows.append(
            {
                "name": _kind_text(kind),
                "count": len(kind.clusters),
                "used": len(used) if D else 0,
                "letter": "⊥" if "D_perp" in D else "R",
                "turn": turn,
                "path": D.get("D_T"),
            }
        )
    if report.singles is not None:
        path = estimate_texts(report.singles.D_T)
        count = report.singles.n_tracks
        single = {"name": "1 (single spheres)", "count": count, "used": count}
        rows.append(single | {"letter": "", "turn": None, "path": path})
    return rows


def remark_rows(report: Report, texts: Mapping[str, Sequence[str]]) -> list[dict[str, Any]]:
    """Return the texts about single clusters, with links; those of one kind are one line.

    Parameters
    ----------
    report : Report
    texts : mapping
        Warnings or notes by the name of the cluster.

    Returns
    -------
    list of dict
    """
    anchors = {result.name: result.cluster for result in report.results}
    return [
        {
            "text": remark.text,
            "count": len(remark.names),
            "total": remark.total,
            "same": remark.same,
            "links": [(anchors[name], name) for name in remark.names[:_LINKED_CLUSTERS]],
            "more": max(len(remark.names) - _LINKED_CLUSTERS, 0),
        }
        for remark in grouped(texts)
    ]


def pooled_texts(report: Report) -> dict[str, Any]:
    """Return the pooled values, the probability of equal values, and the excluded clusters.

    Parameters
    ----------
    report : Report
        With pooled values.

    Returns
    -------
    dict
    """
    pooled = report.pooled
    assert pooled is not None
    used = set(pooled.clusters)
    agree = [
        f"{name} {number_text(estimate.p_same)}"
        for name, estimate in (("D_R", pooled.D_R), ("D_T", pooled.D_T))
        if estimate.p_same is not None
    ]
    return {
        "D_R": estimate_texts(pooled.D_R),
        "D_T": estimate_texts(pooled.D_T),
        "frames": pooled.D_R.n_frames,
        "count": len(used),
        "agree": ", ".join(agree),
        "left_out": listed(c.name for c in report.clusters if c.cluster not in used),
    }
