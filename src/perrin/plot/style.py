"""Colours, figures and legends shared by all pictures."""

from __future__ import annotations

from typing import TYPE_CHECKING

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure as Figure

if TYPE_CHECKING:
    from pathlib import Path

    from matplotlib.axes import Axes as Axes


# Okabe and Ito's colours, told apart by colour-blind readers and in grey print.
INK, BLUE, RED, GREY = "#222222", "#0072B2", "#D55E00", "#8a8a8a"


PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")


_DPI = 150


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of a size in inches, laid out so that labels never collide.

    Parameters
    ----------
    width, height : float
        Inches.

    Returns
    -------
    matplotlib.figure.Figure
    """
    return Figure(figsize=(width, height), layout="constrained")


def save_figure(figure: Figure, stem: Path) -> list[Path]:
    """Write a figure as PNG and PDF.

    Parameters
    ----------
    figure : matplotlib.figure.Figure
    stem : Path
        The files' path without its suffix.

    Returns
    -------
    list of Path
    """
    FigureCanvasAgg(figure)
    files = [stem.with_name(stem.name + suffix) for suffix in (".png", ".pdf")]
    for file in files:
        figure.savefig(file, dpi=_DPI)
        # The layout found for the first file serves the second.
        figure.set_layout_engine("none")
    return files


def legend_above(ax: Axes, *, ncols: int) -> None:
    """Put the legend over the axes, where it hides nothing."""
    ax.legend(
        loc="lower left",
        bbox_to_anchor=(0, 1),
        ncols=ncols,
        frameon=False,
        fontsize="small",
        borderaxespad=0.2,
        handlelength=1.6,
        columnspacing=1.2,
    )
