"""Sentences on the motion of the clusters of a report."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

from perrin._text import listed
from perrin.run.remarks import NOT_JUDGED

if TYPE_CHECKING:
    from perrin.run.results import ClusterResult, Pooled, Report


def verdict_lines(report: Report) -> dict[str, list[str]]:
    """Return sentences on the motion of all clusters of a report, by quantity.

    Parameters
    ----------
    report : Report

    Returns
    -------
    dict of str to list of str
        For "rotation" and "translation" the pooled verdict, or that of the only cluster; for
        several clusters also how many show which kind of motion. Empty without clusters.

    Examples
    --------
    >>> from importlib.resources import files
    >>> import perrin
    >>> report = perrin.analyze(str(files("perrin") / "data" / "demo_tracks.csv.gz"), dt=0.73)
    >>> verdict_lines(report)["rotation"][0][:44]
    'The rotation is consistent with diffusion (p'
    """
    lines: dict[str, list[str]] = {}
    several, pooled = len(report.clusters) > 1, report.pooled
    for name in ("rotation", "translation") if report.clusters else ():
        source = pooled if several else report.clusters[0]
        texts = [] if source is None else motion_sentences(source, name)
        if several and pooled is None:
            for kind in report.kinds:
                found = [] if kind.pooled is None else motion_sentences(kind.pooled, name)
                texts += [f"Clusters of {kind.name}: {text}" for text in found]
        if several:
            if source is not None and texts and pooled is not None and len(pooled.clusters) > 1:
                texts[0] = f"All {len(pooled.clusters)} pooled clusters together: {texts[0]}"
            texts.append(kinds_text(report, name))
        lines[name] = texts or [f"The {name} was not judged: {NOT_JUDGED}."]
    return lines


def motion_sentences(result: ClusterResult | Pooled, quantity: str) -> list[str]:
    """Return what kind of motion a result shows, with the fit, and over which time its D holds.

    Parameters
    ----------
    result : ClusterResult or Pooled
    quantity : {"rotation", "translation"}

    Returns
    -------
    list of str
        Empty where the motion was not judged. A verdict of diffusion contains what could have been
        seen, and one of another kind its parameters; a further fit is one that was asked for, or D
        without the steady motion.
    """
    verdict = result.verdicts.get(quantity)
    if verdict is None:
        return []
    texts = [verdict.text]
    if verdict.model is not None and str(verdict.model) not in verdict.text:
        texts.append(f"Fitted: {verdict.model}.")
    name, estimate = ("D_R", result.D_R) if quantity == "rotation" else ("D_T", result.D_T)
    if verdict.kind != "diffusion" and estimate.time_scale:
        texts.append(f"{name} {estimate.time_scale}.")
    return texts


def kinds_text(report: Report, quantity: str) -> str:
    """Return how many clusters show which kind of motion, with the names of those that do not diffuse.

    Parameters
    ----------
    report : Report
    quantity : {"rotation", "translation"}
    """  # noqa: E501
    named: dict[str, list[str]] = {}
    for result in report.clusters:
        verdict = result.verdicts.get(quantity)
        named.setdefault("not judged" if verdict is None else verdict.kind, []).append(result.name)
    counts = Counter({kind: len(names) for kind, names in named.items()})
    shown = [
        f"{count} {kind}" + ("" if kind == "diffusion" else f" ({listed(named[kind])})")
        for kind, count in counts.most_common()
    ]
    return f"The {quantity} of single clusters: {', '.join(shown)}."
