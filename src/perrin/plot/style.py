"""Colours, figures and legends that all figures use."""

from __future__ import annotations

from typing import TYPE_CHECKING

from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure as Figure

if TYPE_CHECKING:
    from pathlib import Path

    from matplotlib.axes import Axes as Axes


# Colours of Okabe and Ito, which colour-blind readers and grey prints distinguish.
INK, BLUE, RED, GREY = "#222222", "#0072B2", "#D55E00", "#8a8a8a"

PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
DPI = 150  # resolution of PNG files


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure whose layout keeps labels apart.

    Parameters
    ----------
    width, height : float
        Size in inches.

    Returns
    -------
    matplotlib.figure.Figure

    Examples
    --------
    >>> new_figure(4, 3).get_size_inches()
    array([4., 3.])
    """
    return Figure(figsize=(width, height), layout="constrained")


def save_figure(figure: Figure, stem: Path) -> list[Path]:
    """Write a figure as PNG and PDF.

    Parameters
    ----------
    figure : matplotlib.figure.Figure
    stem : Path
        Path of the files without suffix.

    Returns
    -------
    list of Path

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     [file.name for file in save_figure(new_figure(2, 1), Path(folder, "empty"))]
    ['empty.png', 'empty.pdf']
    """
    FigureCanvasAgg(figure)
    files = [stem.with_name(stem.name + suffix) for suffix in (".png", ".pdf")]
    engine = figure.get_layout_engine()
    # With a layout of its own every file would be drawn twice, first for the layout alone.
    with rc_context({"figure.autolayout": False, "figure.constrained_layout.use": False}):
        if engine is not None and figure.axes:
            figure.set_dpi(DPI)
            engine.execute(figure)
        figure.set_layout_engine(None)
        for file in files:
            figure.savefig(file, dpi=DPI)
    return files


def legend_above(ax: Axes, *, ncols: int) -> None:
    """Draw the legend above the axes.

    Parameters
    ----------
    ax : matplotlib.axes.Axes
    ncols : int
        Number of columns of the legend.
    """
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


def write_reason(ax: Axes, reason: str, *, framed: bool = False) -> Axes:
    """Write on empty axes why there is nothing to draw.

    Parameters
    ----------
    ax : matplotlib.axes.Axes
    reason : str
    framed : bool
        Keep the frame of the axes and write in grey.

    Returns
    -------
    matplotlib.axes.Axes

    Examples
    --------
    >>> write_reason(new_figure(2, 1).add_subplot(), "no steps").texts[0].get_text()
    'no steps'
    """
    text = ax.text(0.5, 0.5, reason, ha="center", va="center", transform=ax.transAxes)
    if framed:
        text.set_color(GREY)
        ax.set(xticks=[], yticks=[])
    else:
        ax.set_axis_off()
    return ax


def font_in_use() -> str | None:
    """Return the name and the file of the font that figures get, None where no font is found.

    Examples
    --------
    >>> font_in_use() is not None
    True
    """
    from matplotlib.font_manager import FontProperties, findfont

    try:
        file = findfont(FontProperties())
    except ValueError:
        return None
    return f"{FontProperties(fname=file).get_name()}, {file}"
