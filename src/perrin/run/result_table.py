"""Rows of quantities, and the tidy table that they make."""

from __future__ import annotations

from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from perrin._text import interval_text
from perrin.diffusion.estimate import DiffusionEstimate, bare_text

if TYPE_CHECKING:
    from collections.abc import Iterable

    import pandas as pd

    from perrin.diffusion.verdict import MotionVerdict
    from perrin.run.predictions import Compared

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


def tidy_table(rows: Iterable[dict[str, Any]]) -> pd.DataFrame:
    """Return rows of quantities as a table with all columns of ``results.csv``.

    Parameters
    ----------
    rows : iterable of dict
        Values by column; a column may be missing.

    Returns
    -------
    pandas.DataFrame

    Examples
    --------
    >>> tidy_table([{"quantity": "sigma", "value": 0.03, "unit": "um"}])["value"].tolist()
    [0.03]
    """
    import pandas as pd

    table = pd.DataFrame(list(rows), columns=list(RESULT_COLUMNS))
    whole = dict.fromkeys(("cluster", "particles", "frames", "warnings"), "Int64")
    numbers = ("value", "stderr", "ci68_low", "ci68_high", "ci95_low", "ci95_high")
    floats = dict.fromkeys((*numbers, "predicted", "pull"), np.float64)
    return table.astype(whole | floats | {"resolved": "boolean"})


def estimate_row(
    name: str,
    estimate: DiffusionEstimate,
    verdict: MotionVerdict | None = None,
    compared: Compared | None = None,
) -> dict[str, Any]:
    """Return the row of a diffusion coefficient.

    Parameters
    ----------
    name : str
        "D_R", "D_T" or "D_perp".
    estimate : DiffusionEstimate
    verdict : MotionVerdict, optional
        Verdict on the motion; by default the kind that the estimate states.
    compared : Compared, optional
        Prediction.

    Returns
    -------
    dict
        Columns of `tidy_table`.
    """
    row = {
        "quantity": name,
        "value": estimate.value,
        "stderr": estimate.stderr,
        "ci68_low": estimate.ci68[0],
        "ci68_high": estimate.ci68[1],
        "ci95_low": estimate.ci95[0],
        "ci95_high": estimate.ci95[1],
        "unit": estimate.unit,
        "resolved": estimate.resolved,
        "verdict": estimate.motion if verdict is None else verdict.kind,
        "frames": estimate.n_frames,
    }
    return row | prediction_columns(compared)


def prediction_columns(compared: Compared | None) -> dict[str, float]:
    """Return the columns of a predicted value; none without one.

    Parameters
    ----------
    compared : Compared or None
    """
    return {} if compared is None else {"predicted": compared.predicted, "pull": compared.pull}


def coefficients_html(
    rows: Iterable[tuple[str, DiffusionEstimate, DiffusionEstimate, int]], *, caption: str
) -> str:
    """Return coefficients as an HTML table for a notebook; names are escaped.

    Parameters
    ----------
    rows : iterable of tuple
        Name, rotational and translational coefficient, and number of warnings.
    caption : str

    Returns
    -------
    str
    """
    head = ("cluster", "D_R or D_⊥ (rad²/s)", "95 %", "D_T (µm²/s)", "95 %", "warnings")
    lines = ["<tr>" + "".join(f"<th>{text}</th>" for text in head) + "</tr>"]
    for name, turn, path, count in rows:
        cells = (
            name,
            bare_text(turn),
            interval_text(turn.ci95),
            bare_text(path),
            interval_text(path.ci95),
            str(count),
        )
        lines.append("<tr>" + "".join(f"<td>{escape(text)}</td>" for text in cells) + "</tr>")
    start = f"<table><caption style='text-align:left'>{escape(caption)}</caption>"
    return f"{start}{''.join(lines)}</table>"
