"""Sentences on the motion of the clusters of a report."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

import numpy as np

from perrin._text import interval_text, listed, number_text, unit_text
from perrin.diffusion.estimate import value_text
from perrin.run.remarks import NOT_JUDGED

if TYPE_CHECKING:
    from perrin.diffusion.estimate import DiffusionEstimate
    from perrin.run.predictions import Compared
    from perrin.run.results import ClusterResult, Pooled, Report, RodResult

_DIFFERENT = 0.05  # p-value below which coefficients are called different
_FAR_PULL = 2.0  # standard errors beyond which a value is called different from a prediction


def answer_lines(report: Report) -> list[str]:
    """Return the result of a report in sentences: values, times, agreement, prediction.

    Parameters
    ----------
    report : Report

    Returns
    -------
    list of str
        Without a pooled value those of every kind of clusters.

    Examples
    --------
    >>> from importlib.resources import files
    >>> import perrin
    >>> report = perrin.analyze(str(files("perrin") / "data" / "demo_tracks.csv.gz"), dt=0.73)
    >>> answer_lines(report)[0][:61]
    'The cluster of 4 particles rotates with D_R = 0.0069(6) rad²/'
    """
    several = len(report.results) > 1
    source: ClusterResult | RodResult | Pooled | None = report.pooled
    if not several and report.results:
        source = report.results[0]
    lines = []
    if source is not None:
        turn = "D_perp" if hasattr(source, "D_perp") else "D_R"
        known = {name: getattr(source, name) for name in (turn, "D_T")}
        known = {k: one for k, one in known.items() if one.absent_because is None}
        if several and report.pooled is not None:
            subject = f"The {len(report.pooled.clusters)} clusters"
            verbs, common = {"D_T": "move"}, "a common "
        else:
            count = report.results[0].to_dict()["n_particles"]
            subject, verbs, common = f"The cluster of {count} particles", {"D_T": "moves"}, ""
        turns = "rotate" if several else "rotates"
        # One sentence where both values hold over the same times, which are then stated once.
        scales = {one.time_scale for one in known.values()}
        if len(known) == 2 and len(scales) == 1:
            both = " and ".join(
                f"{verbs.get(name, turns)} with {common}{_value_text(name, one)}"
                for name, one in known.items()
            )
            verb, _, times = scales.pop().partition(" ")
            plural = {"holds": "hold", "is": "are"}.get(verb, verb)
            when = f". Both {plural} {times}" if verb else ""
            lines.append(f"{subject} {both}{when}.")
        else:
            lines += [
                f"{subject} {verbs.get(name, turns)} with {common}{_value_text(name, one)}"
                + (f", which {one.time_scale}." if one.time_scale else ".")
                for name, one in known.items()
            ]
    for kind in report.kinds if several and report.pooled is None else ():
        for name, estimate in kind.coefficients:
            if estimate.absent_because is None:
                when = f", which {estimate.time_scale}" if estimate.time_scale else ""
                lines.append(f"Clusters of {kind.name}: {_value_text(name, estimate)}{when}.")
    if several and report.pooled is not None:
        lines += _agreement(report.pooled)
    return lines + _predictions(report)


def _value_text(name: str, estimate: DiffusionEstimate) -> str:
    """Return a value with its interval."""
    sign = "= " if estimate.resolved else ""
    interval = f"95 % interval {interval_text(estimate.ci95)} {unit_text(estimate.unit)}"
    limit = "" if estimate.resolved else "an upper limit, "
    return f"{name} {sign}{value_text(estimate)} ({limit}{interval})"


def _agreement(pooled: Pooled) -> list[str]:
    """Return whether the clusters have the same coefficients."""
    lines = []
    for name, estimate in (("D_R", pooled.D_R), ("D_T", pooled.D_T)):
        p = estimate.p_same
        if p is None:
            continue
        chance = f"equal values would scatter as much as these with probability {number_text(p)}"
        if p < _DIFFERENT:
            lines.append(f"The clusters differ in {name}: {chance}. No cluster need have the mean.")
        else:
            lines.append(f"The clusters agree in {name}: {chance}.")
    return lines


def _predictions(report: Report) -> list[str]:
    """Return how the measured coefficients compare with the predicted ones."""
    compared: dict[str, list[Compared]] = {}
    for result in report.results:
        for name in ("D_R", "D_perp", "D_T") if result.prediction is not None else ():
            one = getattr(result.prediction, name)
            if one is not None and np.isfinite(one.pull):
                compared.setdefault(name, []).append(one)
    lines = []
    for name, found in compared.items():
        if len(found) == 1:
            (one,) = found
            unit = "µm²/s" if name == "D_T" else "rad²/s"
            side = "above" if one.pull > 0 else "below"
            agrees = "agrees with" if abs(one.pull) < _FAR_PULL else "differs from"
            lines.append(
                f"The measured {name} {agrees} the prediction {number_text(one.predicted)} {unit}: "
                f"it is {abs(one.pull):.1f} standard errors {side}."
            )
            continue
        far = sum(abs(one.pull) > _FAR_PULL for one in found)
        if not far:
            all_of_them = f"{name} of all {len(found)} clusters"
            lines.append(f"{all_of_them} is within two standard errors of its prediction.")
            continue
        lines.append(
            f"{name} of {far} of {len(found)} clusters is over two standard errors from its "
            f"prediction; {0.0455 * len(found):.2g} are expected by chance."
        )
    return lines


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
                # How many clusters show which motion is stated below, with their names.
                text = texts[0].partition(" Singly: ")[0].replace("this track ", "these tracks ")
                start = f"All {len(pooled.clusters)} pooled clusters together: "
                texts[0] = start + text[:1].lower() + text[1:]
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
