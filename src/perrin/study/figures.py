"""Static figures of a study: the coefficients and their ratio against the condition."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from perrin._text import unit_text
from perrin.plot.figure_style import GREY, column_figure, save_figure, series_color, style
from perrin.study.conditions import QUANTITIES, QUANTITY_UNITS, condition_text
from perrin.study.trends import law_values

if TYPE_CHECKING:
    from pathlib import Path

    from matplotlib.axes import Axes

    from perrin.study.study_results import StudyResult

_QUANTITY_SYMBOLS = {"D_R": "$D_R$", "D_T": "$D_T$", "D_T/D_R": "$D_T/D_R$"}


@style()
def save_study_figures(result: StudyResult, folder: Path) -> list[Path]:
    """Write the figure of all conditions, and that of the residuals of fitted laws.

    Parameters
    ----------
    result : StudyResult
    folder : Path
        Existing folder.

    Returns
    -------
    list of Path
        PNG and PDF files.
    """
    if not result.means:
        return []
    figure = column_figure(0.36)
    axes = figure.subplots(1, len(QUANTITIES))
    for ax, quantity in zip(axes, QUANTITIES, strict=True):
        plot_conditions(result, quantity, ax=ax)
    files = save_figure(figure, folder / "conditions")
    if result.trends:
        shape = (1 + (len(result.trends) - 1) // 3, min(len(result.trends), 3))
        figure = column_figure(0.32 * shape[0])
        for ax, (name, trend) in zip(
            np.ravel(figure.subplots(*shape, squeeze=False)), result.trends.items(), strict=False
        ):
            ax.axhline(0, color=GREY, lw=0.8)
            ax.plot(trend.x, trend.residuals, "o", color=series_color(0), ms=4)
            ax.set_title(name, fontsize="small")
            ax.set(xlabel="condition", ylabel="residual (standard deviations)")
            if trend.law == "power" and np.all(trend.x > 0):
                ax.set_xscale("log")
        files += save_figure(figure, folder / "residuals")
    return files


def plot_conditions(result: StudyResult, quantity: str, *, ax: Axes) -> Axes:
    """Draw a coefficient against the first condition: means, single clusters, laws, predictions.

    Parameters
    ----------
    result : StudyResult
    quantity : {"D_R", "D_T", "D_T/D_R"}
    ax : matplotlib.axes.Axes

    Returns
    -------
    matplotlib.axes.Axes
    """
    first = result.manifest.conditions[:1]
    numbers = bool(first) and all(
        isinstance(one.conditions[first[0]], int | float) for one in result.means
    )
    labels = list(dict.fromkeys(condition_text(one.conditions) for one in result.means))

    def place(conditions: dict[str, float | str]) -> float:
        return (
            float(conditions[first[0]])
            if numbers
            else float(labels.index(condition_text(conditions)))
        )

    for k, (body, of_body) in enumerate(result.by_body().items()):
        color = series_color(k)
        singles = [
            v
            for v in result.values
            if v.body == body and v.quantity == quantity and v.coefficient.value > 0
        ]
        for marker, apart in ((".", False), ("x", True)):
            some = [v for v in singles if bool(v.apart_because) == apart]
            ax.plot(
                [place(v.movie.conditions) for v in some],
                [v.coefficient.value for v in some],
                marker, color=color, alpha=0.25, ms=4, mew=0.8,
            )  # fmt: skip
        means = of_body[quantity]
        at = np.array([place(one.conditions) for one in means])
        value = np.array([one.mean.value for one in means])
        low, high = (np.array([one.mean.ci95[k] for one in means]) for k in (0, 1))
        bounded = np.isfinite(high) & (value > 0)
        # An interval of one degree of freedom may span decades: it is cut at a factor of 30.
        below, above = value - np.maximum(low, value / 30), np.minimum(high, 30 * value) - value
        ax.errorbar(
            at[bounded], value[bounded], [below[bounded], above[bounded]],
            fmt="o", color=color, ms=5, lw=1.4, capsize=2, label=body, zorder=3,
        )  # fmt: skip
        predicted = np.array([one.predicted or np.nan for one in means])
        ax.plot(at, predicted, "D", mfc="none", color=color, ms=5)
        trend = result.trends.get(f"{body}: {quantity}")
        if trend is not None and numbers and trend.law != "own function":
            x = np.linspace(trend.x.min(), trend.x.max(), 100)
            ax.plot(x, law_values(trend.law, x, trend.parameters), "-", color=color, lw=1)
    ax.set_yscale("log")
    ax.set_ylabel(f"{_QUANTITY_SYMBOLS[quantity]} ({unit_text(QUANTITY_UNITS[quantity])})")
    if numbers:
        ax.set_xlabel(first[0])
    else:
        ax.set_xticks(range(len(labels)), labels, rotation=20, ha="right", fontsize="small")
        ax.set_xlim(-0.5, len(labels) - 0.5)
    ax.legend(fontsize="x-small", frameon=False)
    return ax
