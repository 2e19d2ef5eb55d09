"""The style of all figures: sheet, sizes for one and two columns, colours, legends, files."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import contextmanager
from importlib.resources import as_file, files
from os import fspath
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np
from matplotlib import rc_context, rcParams
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex
from matplotlib.figure import Figure as Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from perrin._arrays import choice_fault, refuse
from perrin._text import number_text, ten_to

if TYPE_CHECKING:
    import os
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from matplotlib.axes import Axes as Axes
    from matplotlib.axis import Axis as Axis

    from perrin.run.workers import Progress

    # A file, the name of a style of matplotlib, or settings.
    Sheet: TypeAlias = str | os.PathLike[str] | Mapping[str, Any]

Columns = Literal[1, 2]

# Colours of Okabe and Ito, which colour-blind readers and grey prints distinguish.
PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
GREY = "#8a8a8a"
DPI = 150  # resolution of PNG files outside `style`
_GAP = 0.2  # between two columns, inches
_FEW_DECADES = 300.0  # ratio of the ends of an axis with more ticks than powers of ten
_NARROW = 4.5  # width of a figure of one column at most, inches


@contextmanager
def style(*, sheet: Sheet | None = None) -> Iterator[None]:
    """Draw figures in perrin's style, or in that of another style sheet.

    Parameters
    ----------
    sheet : path, str or mapping, optional
        A style sheet of matplotlib that outranks perrin's in what it states: a file, a name such as
        "ggplot", or settings. Perrin's own is ``perrin.mplstyle`` beside this module, which outside
        this function is ``matplotlib.style.use("perrin.plot.perrin")``.

    Notes
    -----
    The width of ``figure.figsize`` is that of a figure over two columns; `column_width` follows
    from it. Lines and symbols are multiples of ``lines.linewidth`` and ``lines.markersize``;
    colours are those of ``axes.prop_cycle`` in order, and ``text.color``.

    Raises
    ------
    OSError
        If there is no such style sheet.

    Examples
    --------
    >>> with style():
    ...     column_width(1), column_width(2)
    (3.4, 7.0)
    >>> with style(sheet={"figure.figsize": (6.2, 3)}):
    ...     column_width(1), column_width(2)
    (3.0, 6.2)
    """
    from matplotlib import style as styles

    with as_file(files("perrin.plot") / "perrin.mplstyle") as own, rc_context():
        styles.use(own)
        if sheet is not None:
            styles.use(dict(sheet) if isinstance(sheet, Mapping) else fspath(sheet))
        yield


@contextmanager
def palette() -> Iterator[None]:
    """Draw figures in the colours of perrin's style and otherwise in that of the caller.

    Examples
    --------
    >>> with palette():
    ...     series_color(0)
    '#0072b2'
    """
    with rc_context({"axes.prop_cycle": f"cycler('color', {list(PALETTE)})"}):
        yield


def column_width(columns: Columns = 2) -> float:
    """Return the width of a figure over one or two columns of a journal, inches.

    Parameters
    ----------
    columns : {1, 2}

    Raises
    ------
    ValueError
        For another number of columns.

    Examples
    --------
    >>> with style():
    ...     column_width(1)
    3.4
    """
    refuse(choice_fault("columns", columns, (1, 2)))
    both = float(rcParams["figure.figsize"][0])
    return both if columns == 2 else (both - _GAP) / 2


def column_figure(height: float, *, columns: Columns = 2) -> Figure:
    """Return an empty figure over one or two columns.

    Parameters
    ----------
    height : float
        Height over the width of two columns.
    columns : {1, 2}

    Returns
    -------
    matplotlib.figure.Figure

    Examples
    --------
    >>> with style():
    ...     column_figure(0.5, columns=1).get_size_inches()
    array([3.4, 3.5])
    """
    return new_figure(column_width(columns), height * column_width(2))


def series_color(k: int) -> str:
    """Return the colour of the k-th series of a figure, from the colours of the style.

    Parameters
    ----------
    k : int
        From 0; the colours repeat.

    Examples
    --------
    >>> with style():
    ...     series_color(1)
    '#d55e00'
    """
    # Resolved now, because matplotlib resolves "C1" only when the figure is drawn.
    colors = rcParams["axes.prop_cycle"].by_key().get("color", list(PALETTE))
    return to_hex(colors[k % len(colors)])


def ink() -> str:
    """Return the colour of texts and of marks that are no series."""
    return to_hex(rcParams["text.color"])


def line_width(share: float) -> float:
    """Return the width of a line that is a share of the style's, points.

    Parameters
    ----------
    share : float
    """
    return share * float(rcParams["lines.linewidth"])


def marker_size(share: float) -> float:
    """Return the size of a symbol that is a share of the style's, points.

    Parameters
    ----------
    share : float
    """
    return share * float(rcParams["lines.markersize"])


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
    paths = [stem.with_name(stem.name + suffix) for suffix in (".png", ".pdf")]
    engine = figure.get_layout_engine()
    stated = rcParams["savefig.dpi"]
    dpi = DPI if stated == "figure" else float(stated)
    # With a layout of its own every file would be drawn twice, first for the layout alone.
    with rc_context({"figure.autolayout": False, "figure.constrained_layout.use": False}):
        if engine is not None and figure.axes:
            figure.set_dpi(dpi)
            engine.execute(figure)
        figure.set_layout_engine(None)
        with _glyphs_alone():
            for file in paths:
                figure.savefig(file, dpi=dpi)
    return paths


def save_drawn(
    figures: Mapping[str, Callable[[], Figure]],
    folder: Path,
    *,
    sheet: Sheet | None = None,
    progress: Progress | None = None,
) -> list[Path]:
    """Draw figures one after the other in perrin's style, and write each as PNG and PDF.

    Parameters
    ----------
    figures : mapping
        Function that returns the figure, by the name of its files without suffix.
    folder : Path
        Existing folder.
    sheet : path, str or mapping, optional
        Style sheet that outranks perrin's, as in `style`.
    progress : callable, optional
        Called with the number of finished figures, their total, and what is done.

    Returns
    -------
    list of Path

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     [f.name for f in save_drawn({"empty": lambda: new_figure(2, 1)}, Path(folder))]
    ['empty.png', 'empty.pdf']
    """
    files: list[Path] = []
    with style(sheet=sheet):
        for done, (name, draw) in enumerate(figures.items()):
            if progress is not None:
                progress(done, len(figures), "drawing the figures")
            files += save_figure(draw(), folder / name)
    return files


@contextmanager
def _glyphs_alone() -> Iterator[None]:
    """Embed fonts without the tables that place and replace glyphs.

    A PDF file states every glyph with its place, and reading those tables takes half of the time
    that its fonts need. matplotlib has no setting for it.
    """
    from fontTools.subset import Options

    kept = Options._drop_tables_default
    Options._drop_tables_default = [*kept, "GSUB", "GPOS", "GDEF"]
    try:
        yield
    finally:
        Options._drop_tables_default = kept


def log_ticks(axis: Axis) -> None:
    """Write 1, 2 and 5 on a logarithmic axis of few decades, and powers of ten on a longer one.

    A longer axis has unlabelled ticks at 2 and 5; those of matplotlib, eight in a decade, take more
    time than all curves together.

    Parameters
    ----------
    axis : matplotlib.axis.Axis
        Logarithmic axis whose limits are set.

    Examples
    --------
    >>> ax = new_figure(2, 1).add_subplot(xscale="log", xlim=(0.3, 2000))
    >>> log_ticks(ax.xaxis)
    >>> [ax.xaxis.get_major_formatter()(x) for x in (1, 100)]
    ['10⁰', '10²']
    """
    low, high = axis.get_view_interval()
    axis.set_minor_formatter(NullFormatter())
    if high < _FEW_DECADES * low:
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter(FuncFormatter(lambda x, _: number_text(x, digits=1)))
        return
    axis.set_minor_locator(LogLocator(subs=(2, 5)))
    axis.set_major_formatter(FuncFormatter(lambda x, _: ten_to(round(np.log10(x)))))


def legend_above(ax: Axes, *, ncols: int) -> None:
    """Draw the legend above the axes.

    Parameters
    ----------
    ax : matplotlib.axes.Axes
    ncols : int
        Number of columns of the legend, at most 2 in a figure of one column.
    """
    # The canvas is that of the whole figure, also for axes in a part of it.
    narrow = ax.figure is not None and ax.figure.canvas.figure.get_figwidth() < _NARROW
    ax.legend(
        loc="lower left",
        bbox_to_anchor=(0, 1),
        ncols=min(ncols, 2) if narrow else ncols,
        frameon=False,
        fontsize="small",
        borderaxespad=0.2,
        handlelength=1.4,
        handletextpad=0.6,
        columnspacing=1.0,
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
