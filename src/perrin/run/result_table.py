"""Results of a run as one tidy table: a row for every cluster and quantity."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator

    import pandas as pd

    from perrin.diffusion.estimate import DiffusionEstimate
    from perrin.diffusion.verdict import MotionVerdict
    from perrin.run.predictions import Compared
    from perrin.run.results import ClusterResult, Report, RodResult

RESULT_COLUMNS = (
    "of",
    "cluster",
    "label",
    "particles",
    "point_group",
    "quantity",
    "value",
    "stderr",
    "ci68_low",
    "ci68_high",
    "ci95_low",
    "ci95_high",
    "unit",
    "resolved",
    "verdict",
    "predicted",
    "pull",
    "frames",
    "warnings",
)


def result_table(report: Report) -> pd.DataFrame:
    """Return all numbers of a report as a tidy table.

    Parameters
    ----------
    report : Report

    Returns
    -------
    pandas.DataFrame
        A row for every cluster (or pooled value) and quantity. Columns: of ("cluster", "rod",
        "pooled", "kind" or "single spheres"), cluster, label, particles, point_group, quantity
        ("D_R", "D_T", "D_perp", "D_R1" to "D_R3", "sigma", "phi2", "phi2_predicted", "snr",
        "sphere_diameter_T", ..., "viscosity_TR"), value, stderr, ci68_low, ci68_high, ci95_low,
        ci95_high, unit, resolved (False for an upper limit, which is ci95_high), verdict (kind of
        motion), predicted, pull, frames, warnings (their number). A number that is not known is
        missing; an interval without bound ends at inf.

    Examples
    --------
    >>> import perrin
    >>> from importlib.resources import files
    >>> report = perrin.analyze(str(files("perrin") / "data" / "demo_tracks.csv.gz"), dt=0.73)
    >>> table = result_table(report)
    >>> table.loc[table["quantity"] == "D_R", ["of", "cluster", "unit", "verdict"]].iloc[0].tolist()
    ['cluster', 0, 'rad^2/s', 'diffusion']
    """
    import pandas as pd

    rows: list[dict[str, Any]] = []
    for result in report.results:
        kind = report.kind_of(result.cluster)
        of = "cluster" if hasattr(result, "D_R") else "rod"
        about = {
            "of": of,
            "cluster": result.cluster,
            "label": result.label,
            "particles": _particles(result),
            "point_group": None if kind is None else kind.point_group,
            "frames": int(result.motion.fitted.size),
            "warnings": len(result.warnings),
        }
        rows += [about | row for row in _quantities(result)]
    pooled = report.pooled
    if pooled is not None and len(report.clusters) > 1:
        verdicts = pooled.verdicts
        rows.append({"of": "pooled"} | _estimate("D_R", pooled.D_R, verdicts.get("rotation")))
        rows.append({"of": "pooled"} | _estimate("D_T", pooled.D_T, verdicts.get("translation")))
    for kind in report.kinds if report.pooled_by_kind else ():
        about = {"of": "kind", "particles": kind.size, "point_group": kind.point_group}
        rows += [about | _estimate(name, one, None) for name, one in kind.coefficients]
    if report.singles is not None:
        rows.append({"of": "single spheres", "particles": 1})
        rows[-1] |= _estimate("D_T", report.singles.D_T, None)
    table = pd.DataFrame(rows, columns=list(RESULT_COLUMNS))
    whole = dict.fromkeys(("cluster", "particles", "frames", "warnings"), "Int64")
    numbers = ("value", "stderr", "ci68_low", "ci68_high", "ci95_low", "ci95_high")
    floats = dict.fromkeys((*numbers, "predicted", "pull"), np.float64)
    return table.astype(whole | floats | {"resolved": "boolean"})


def _particles(result: ClusterResult | RodResult) -> int:
    """Return the number of particles of a body."""
    motion: Any = result.motion
    return len(motion.places if hasattr(motion, "places") else motion.template)


def _quantities(result: ClusterResult | RodResult) -> Iterator[dict[str, Any]]:
    """Yield a row for every quantity that was measured on a cluster or rod."""
    one: Any = result
    prediction: Any = result.prediction
    turn = "D_R" if hasattr(one, "D_R") else "D_perp"
    verdicts = getattr(one, "verdicts", {})
    for name, quantity in ((turn, "rotation"), ("D_T", "translation")):
        compared = None if prediction is None else getattr(prediction, name)
        yield _estimate(name, getattr(one, name), verdicts.get(quantity), compared)
    yield {"quantity": "sigma", "value": one.motion.sigma, "unit": "um"}
    if turn == "D_perp":
        yield {"quantity": "length", "value": one.motion.length, "unit": "um"}
        return
    if one.tensor is not None:
        compared_axes = () if prediction is None else prediction.principal_D_R
        for k, value in enumerate(one.tensor.principal_values):
            row = {"quantity": f"D_R{k + 1}", "value": float(value), "unit": one.tensor.unit}
            row["stderr"] = float(one.tensor.stderr[k])
            yield row | _prediction(compared_axes[k] if len(compared_axes) == 3 else None)
    floor = {"quantity": "phi2", "value": one.phi2_measured, "unit": "rad^2"}
    yield floor | {"stderr": one.phi2_stderr}
    yield {"quantity": "phi2_predicted", "value": one.noise.phi2, "unit": "rad^2"}
    yield {"quantity": "snr", "value": one.D_R.snr, "unit": "1"}
    for mode, end in (("translation", "T"), ("rotation", "R"), ("both", "TR")):
        size = (one.sizes or {}).get(mode)
        if size is None:
            continue
        for what in ("sphere", "cluster"):
            row = {"quantity": f"{what}_diameter_{end}", "value": getattr(size, what), "unit": "um"}
            yield row | {"stderr": getattr(size, f"{what}_stderr")}
        if mode == "both" and size.viscosity is not None:
            row = {"quantity": "viscosity_TR", "value": size.viscosity, "unit": "Pa s"}
            yield row | {"stderr": size.viscosity_stderr}


def _estimate(
    name: str,
    estimate: DiffusionEstimate,
    verdict: MotionVerdict | None,
    compared: Compared | None = None,
) -> dict[str, Any]:
    """Return the row of a diffusion coefficient."""
    kind = estimate.motion if verdict is None else verdict.kind
    return {
        "quantity": name,
        "value": estimate.value,
        "stderr": estimate.stderr,
        "ci68_low": estimate.ci68[0],
        "ci68_high": estimate.ci68[1],
        "ci95_low": estimate.ci95[0],
        "ci95_high": estimate.ci95[1],
        "unit": estimate.unit,
        "resolved": estimate.resolved,
        "verdict": kind,
        "frames": estimate.n_frames,
    } | _prediction(compared)


def _prediction(compared: Compared | None) -> dict[str, float]:
    """Return the columns of a predicted value."""
    return {} if compared is None else {"predicted": compared.predicted, "pull": compared.pull}


def result_rows_html(report: Report, *, most: int = 20) -> str:
    """Return the coefficients of the first clusters as a table for a notebook.

    Parameters
    ----------
    report : Report
    most : int
        Largest number of rows.

    Returns
    -------
    str
        An HTML table; labels are escaped.

    Examples
    --------
    >>> import perrin
    >>> from importlib.resources import files
    >>> report = perrin.analyze(str(files("perrin") / "data" / "demo_tracks.csv.gz"), dt=0.73)
    >>> result_rows_html(report).count("<tr>")
    2
    """
    from html import escape

    from perrin._text import interval_text
    from perrin.diffusion.estimate import bare_text

    head = ("cluster", "D_R or D_⊥ (rad²/s)", "95 %", "D_T (µm²/s)", "95 %", "warnings")
    lines = ["<tr>" + "".join(f"<th>{text}</th>" for text in head) + "</tr>"]
    for result in report.results[:most]:
        turn = getattr(result, "D_R", None) or getattr(result, "D_perp")  # noqa: B009
        cells = [result.name, bare_text(turn), interval_text(turn.ci95), bare_text(result.D_T)]
        cells += [interval_text(result.D_T.ci95), str(len(result.warnings))]
        lines.append("<tr>" + "".join(f"<td>{escape(text)}</td>" for text in cells) + "</tr>")
    rest = len(report.results) - most
    more = f"<p>and {rest} more: to_frame() has all.</p>" if rest > 0 else ""
    caption = escape(repr(report))
    return (
        f"<table><caption style='text-align:left'>{caption}</caption>{''.join(lines)}</table>{more}"
    )
