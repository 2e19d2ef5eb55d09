"""Figures of a report: each function draws one result, on given axes or on a new figure."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np

from perrin._arrays import choice_fault, refuse
from perrin._text import listed
from perrin.plot.figure_style import (
    column_figure,
    ink,
    legend_above,
    line_width,
    marker_size,
    save_drawn,
    series_color,
    style,
    write_reason,
)
from perrin.plot.motion import motion_figure
from perrin.plot.results import (
    CURVE_NAMES,
    NAMED_CLUSTERS,
    curve_floors,
    plot_curve_ratio,
    plot_forest,
    plot_lag_curve,
    plot_orientations,
    plot_presence,
    plot_residual,
)
from perrin.plot.step_law import step_distribution
from perrin.run.results import ClusterResult, RodResult

if TYPE_CHECKING:
    import os
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from matplotlib.axes import Axes as Axes
    from matplotlib.figure import Figure as Figure

    from perrin.plot.figure_style import Columns, Sheet
    from perrin.run.results import Pooled, Report
    from perrin.run.workers import Progress

Quantity: TypeAlias = Literal["rotation", "translation"]


def curves(
    source: Report | ClusterResult,
    *,
    cluster: int | None = None,
    quantity: Quantity = "rotation",
    ratio: bool = False,
    ax: Axes | None = None,
) -> Axes:
    """Draw the MSAD or the MSD of a cluster with its fit and its noise floor.

    Parameters
    ----------
    source : Report or ClusterResult
    cluster : int, optional
        Number of the cluster; needed where the report has several.
    quantity : {"rotation", "translation"}
        MSAD, rad^2, or MSD, um^2.
    ratio : bool
        Draw the curve over that of pure diffusion, MSAD/(4 D_R t), which tends to 1, against lag
        time; the band is one standard error of the curve.
    ax : matplotlib.axes.Axes, optional
        By default the axes of a new figure one column wide, in perrin's style.

    Returns
    -------
    matplotlib.axes.Axes
        Lag time in s. The line is that of the tensor where the directions of the MSAD weight the
        axes of the body unequally, otherwise that of the estimate.

    Raises
    ------
    ValueError
        If `cluster` is needed, or is no number of a cluster of the report, or that of a rod.

    Examples
    --------
    >>> import perrin
    >>> from importlib.resources import files
    >>> report = perrin.analyze(str(files("perrin") / "data" / "demo_tracks.csv.gz"), dt=0.73)
    >>> curves(report, cluster=0).get_ylabel()
    'MSAD (rad²)'
    """
    result = _cluster_of(source, cluster, quantity)
    rotation = quantity == "rotation"
    estimate = result.D_R if rotation else result.D_T
    with _given_or_new(ax) as drawn:
        if estimate.absent_because is not None:
            return write_reason(drawn, f"no {CURVE_NAMES[quantity][1]}: {estimate.absent_because}")
        curve, tensor = (result.msad, result.tensor) if rotation else (result.msd, None)
        if ratio:
            return plot_curve_ratio(curve, ax=drawn, estimate=estimate, tensor=tensor)
        floor = curve_floors(result)[0 if rotation else 1]
        return plot_lag_curve(curve, ax=drawn, estimate=estimate, floor=floor, tensor=tensor)


def trajectory(
    source: Report | ClusterResult,
    *,
    cluster: int | None = None,
    quantity: Quantity = "translation",
    ax: Axes | None = None,
) -> Axes:
    """Draw the path of a cluster's centre, or its accumulated rotation, against time.

    Parameters
    ----------
    source, cluster, ax
        As in `curves`.
    quantity : {"rotation", "translation"}
        Rotation since the first pose about each lab axis, full turns counted, rad, or displacement
        of the centre since then along each lab axis, um.

    Returns
    -------
    matplotlib.axes.Axes
        Time in s.

    Raises
    ------
    ValueError
        As `curves`.

    Examples
    --------
    >>> import perrin
    >>> from importlib.resources import files
    >>> report = perrin.analyze(str(files("perrin") / "data" / "demo_tracks.csv.gz"), dt=0.73)
    >>> [line.get_label() for line in trajectory(report).lines]
    ['x', 'y', 'z']
    """
    motion = _cluster_of(source, cluster, quantity).motion
    if quantity == "rotation":
        path, label = motion.accumulated_rotation(), "rotation (rad)"
        names = ["about x", "about y", "about z"] if path.shape[1] == 3 else ["φ"]
    else:
        path = motion.center - motion.center[motion.fitted[0]]
        names, label = list("xyz"), "displacement of the centre (µm)"
    with _given_or_new(ax) as drawn:
        for k, (name, values) in enumerate(zip(names, path.T, strict=False)):
            drawn.plot(motion.time, values, color=series_color(k), lw=line_width(0.6), label=name)
        drawn.set(xlabel="time (s)", ylabel=label)
        legend_above(drawn, ncols=3)
        return drawn


def steps(
    source: Report | ClusterResult,
    *,
    cluster: int | None = None,
    quantity: Quantity = "rotation",
    ax: Axes | None = None,
) -> Axes:
    """Draw the distribution of the steps between neighbouring frames, and the law of the fit.

    Parameters
    ----------
    source, cluster, ax
        As in `curves`.
    quantity : {"rotation", "translation"}
        Components of the rotation vectors, rad, or of the displacements of the centre, um.

    Returns
    -------
    matplotlib.axes.Axes
        Probability density, logarithmic, of the components of `step_distribution`; empty bins are
        left out, and bars are the errors of the counts.

    Raises
    ------
    ValueError
        As `curves`.

    Examples
    --------
    >>> import perrin
    >>> from importlib.resources import files
    >>> report = perrin.analyze(str(files("perrin") / "data" / "demo_tracks.csv.gz"), dt=0.73)
    >>> steps(report).get_xlabel()
    'component of a rotation in 0.73 s (rad)'
    """
    result = _cluster_of(source, cluster, quantity)
    found = step_distribution(result, quantity)
    with _given_or_new(ax) as drawn:
        if found is None:
            return write_reason(
                drawn, f"no {CURVE_NAMES[quantity][1]}, or no step of the usual duration"
            )
        width, total = np.diff(found.edges), found.number.sum()
        middle, full = (found.edges[1:] + found.edges[:-1]) / 2, found.number > 0
        density = found.number / (total * width)
        drawn.errorbar(
            middle[full],
            density[full],
            (density / np.sqrt(np.maximum(found.number, 1)))[full],
            fmt="o",
            color=ink(),
            ms=marker_size(0.6),
            elinewidth=line_width(0.55),
            label=f"{total:.0f} components",
        )
        x = np.linspace(found.edges[0], found.edges[-1], 300)
        law = found.density(x)
        drawn.plot(x, law, color=series_color(0), lw=line_width(0.95), label="law of the fit")
        unit, name = ("rad", "rotation") if quantity == "rotation" else ("µm", "displacement")
        drawn.set(
            xlabel=f"component of a {name} in {result.motion.usual_interval:.3g} s ({unit})",
            ylabel=f"probability density (1/{unit})",
            yscale="log",
            ylim=(0.3 / (total * width[0]), 2 * max(density.max(), law.max())),
        )
        legend_above(drawn, ncols=2)
        return drawn


def residuals(
    source: Report | ClusterResult, *, cluster: int | None = None, ax: Axes | None = None
) -> Axes:
    """Draw the rms distance of the particles to the fitted body against time.

    Parameters
    ----------
    source, cluster, ax
        As in `curves`.

    Returns
    -------
    matplotlib.axes.Axes
        As `plot_residual`.

    Raises
    ------
    ValueError
        As `curves`.

    Examples
    --------
    >>> import perrin
    >>> from importlib.resources import files
    >>> report = perrin.analyze(str(files("perrin") / "data" / "demo_tracks.csv.gz"), dt=0.73)
    >>> residuals(report).get_ylabel()
    'residual (nm)'
    """
    motion = _cluster_of(source, cluster).motion
    with _given_or_new(ax) as drawn:
        return plot_residual(motion, ax=drawn)


def orientations(
    source: Report | ClusterResult, *, cluster: int | None = None, ax: Axes | None = None
) -> Axes:
    """Draw the paths of the particles' directions on the unit sphere, or the angle in the plane.

    Parameters
    ----------
    source, cluster
        As in `curves`.
    ax : matplotlib.axes.Axes, optional
        As in `curves`; with ``projection="3d"`` for a motion in space.

    Returns
    -------
    matplotlib.axes.Axes
        As `plot_orientations`.

    Raises
    ------
    ValueError
        As `curves`.

    Examples
    --------
    >>> import perrin
    >>> from importlib.resources import files
    >>> report = perrin.analyze(str(files("perrin") / "data" / "demo_tracks.csv.gz"), dt=0.73)
    >>> orientations(report).name
    '3d'
    """
    motion = _cluster_of(source, cluster).motion
    space = motion.dimension == 3
    with _given_or_new(ax, height=0.486 if space else 0.3, space=space) as drawn:
        return plot_orientations(motion, ax=drawn)


def forest(report: Report, *, quantity: Quantity = "rotation", ax: Axes | None = None) -> Axes:
    """Draw the diffusion coefficient of every cluster with its intervals, and the pooled one.

    Parameters
    ----------
    report : Report
        With at least one cluster that is no rod.
    quantity : {"rotation", "translation"}
        D_R in rad^2/s or D_T in um^2/s.
    ax : matplotlib.axes.Axes, optional
        As in `curves`.

    Returns
    -------
    matplotlib.axes.Axes
        As `plot_forest`.

    Raises
    ------
    ValueError
        If the report has no such cluster.

    Examples
    --------
    >>> import perrin
    >>> from importlib.resources import files
    >>> report = perrin.analyze(str(files("perrin") / "data" / "demo_tracks.csv.gz"), dt=0.73)
    >>> forest(report, quantity="translation").get_xlabel()
    '$D_T$ (µm²/s)'
    """
    refuse(choice_fault("quantity", quantity, ("rotation", "translation")))
    if not report.clusters:
        raise ValueError("the report has no cluster with a full orientation")
    pooled = None
    if report.pooled is not None and len(report.clusters) > 1:
        pooled = report.pooled.D_R if quantity == "rotation" else report.pooled.D_T
    with _given_or_new(ax, height=_forest_height(len(report.clusters))) as drawn:
        return plot_forest(report.clusters, ax=drawn, quantity=quantity, pooled=pooled)


def curve_figure(result: ClusterResult, *, columns: Columns = 2) -> Figure:
    """Return a figure of the MSAD and the MSD of a cluster.

    Parameters
    ----------
    result : ClusterResult
    columns : {1, 2}
        Side by side over two columns, or one above the other over one.

    Returns
    -------
    matplotlib.figure.Figure
    """
    figure = column_figure(0.46 if columns == 2 else 0.86, columns=columns)
    left, right = figure.subplots(3 - columns, columns)
    curves(result, ax=left)
    curves(result, quantity="translation", ax=right)
    return figure


def residual_figure(result: ClusterResult, *, columns: Columns = 2) -> Figure:
    """Return a figure of the residuals and of the number of detected particles against time.

    Parameters
    ----------
    result : ClusterResult
    columns : {1, 2}

    Returns
    -------
    matplotlib.figure.Figure
    """
    figure = column_figure(0.42, columns=columns)
    top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=[2.4, 1])
    plot_residual(result.motion, ax=top)
    plot_presence(result.motion, ax=bottom)
    top.set_xlabel("")
    return figure


def orientation_figure(result: ClusterResult, *, columns: Columns = 2) -> Figure:
    """Return a figure of the paths on the unit sphere, or of the angle in the plane.

    Parameters
    ----------
    result : ClusterResult
    columns : {1, 2}
        Width for the angle; the sphere always has one column.

    Returns
    -------
    matplotlib.figure.Figure
    """
    planar = result.motion.dimension == 2
    figure = column_figure(0.36, columns=columns) if planar else column_figure(0.486, columns=1)
    ax = figure.add_subplot() if planar else figure.add_subplot(projection="3d")
    plot_orientations(result.motion, ax=ax)
    return figure


def forest_figure(
    clusters: Sequence[ClusterResult], pooled: Pooled, *, columns: Columns = 2
) -> Figure:
    """Return a figure of D_R and D_T of all clusters, as high as the list is long.

    Parameters
    ----------
    clusters : sequence of ClusterResult
    pooled : Pooled
    columns : {1, 2}
        Side by side over two columns, or one above the other over one.

    Returns
    -------
    matplotlib.figure.Figure
    """
    height = _forest_height(len(clusters))
    figure = column_figure(height if columns == 2 else 2 * height, columns=columns)
    left, right = figure.subplots(3 - columns, columns)
    plot_forest(clusters, ax=left, quantity="rotation", pooled=pooled.D_R)
    plot_forest(clusters, ax=right, quantity="translation", pooled=pooled.D_T)
    if columns == 2 and len(clusters) <= NAMED_CLUSTERS:
        right.tick_params(labelleft=False)
        right.set_ylabel("")
    return figure


def save_figures(
    report: Report,
    folder: str | os.PathLike[str],
    *,
    clusters: Iterable[int] | None = None,
    columns: Columns = 2,
    sheet: Sheet | None = None,
    progress: Progress | None = None,
) -> list[Path]:
    """Write figures of a report into an existing folder, each as PNG and PDF.

    Parameters
    ----------
    report : Report
    folder : path
    clusters : iterable of int, optional
        Numbers of the clusters that are drawn; by default the first one. The report page draws all
        of them itself.
    columns : {1, 2}
        Columns of a journal that a figure is wide; see `column_width`.
    sheet : path, str or mapping, optional
        Style sheet that outranks perrin's, as in `style`.
    progress : callable, optional
        Called with the number of finished figures, their total, and what is done.

    Returns
    -------
    list of Path
        ``clusters.*`` if there are several clusters, and for each drawn cluster
        ``cluster-<n>-curves.*``, ``-residuals.*`` and ``-orientations.*``, with ``-rotation.*`` and
        ``-translation.*``, against diffusion, over two columns, where the motion is not diffusion.
    """
    drawn = {c.cluster for c in report.clusters[:1]} if clusters is None else set(clusters)
    first = report.tracks.dropna(subset=["x", "y"]).groupby("cluster")["frame"].min()
    figures: dict[str, Callable[[], Figure]] = {}
    if report.pooled is not None and len(report.clusters) > 1:
        figures["clusters"] = partial(
            forest_figure, report.clusters, report.pooled, columns=columns
        )
    for result in [c for c in report.clusters if c.cluster in drawn]:
        name = f"cluster-{result.cluster}"
        figures[f"{name}-curves"] = partial(curve_figure, result, columns=columns)
        figures[f"{name}-residuals"] = partial(residual_figure, result, columns=columns)
        figures[f"{name}-orientations"] = partial(orientation_figure, result, columns=columns)
        for quantity, verdict in result.verdicts.items():
            if verdict is None or verdict.kind == "diffusion":
                continue
            motion = result.motion
            if verdict.quantity == "translation":  # the path crosses doubt about labels
                motion = replace(motion, piece=np.zeros_like(motion.piece))
            # In a report frames count from the table's first, in a motion from its own.
            rows = tuple(frame - int(first[result.cluster]) for frame in verdict.frames)
            figures[f"{name}-{quantity}"] = partial(
                motion_figure,
                motion,
                quantity=verdict.quantity,
                noise=result.D_R.settings,
                verdict=replace(verdict, frames=rows),
            )
    return save_drawn(figures, Path(folder), sheet=sheet, progress=progress)


def _cluster_of(
    source: Report | ClusterResult, cluster: int | None, quantity: str = "rotation"
) -> ClusterResult:
    """Return the cluster of a report that is drawn."""
    refuse(choice_fault("quantity", quantity, ("rotation", "translation")))
    if isinstance(source, ClusterResult):
        if cluster is not None and cluster != source.cluster:
            raise ValueError(
                f"cluster: the result is that of cluster {source.cluster}, got {cluster}"
            )
        return source
    numbers = [one.cluster for one in source.results]
    if cluster is None and len(numbers) != 1:
        raise ValueError(f"cluster: expected one of {listed(numbers)}, got none")
    result = next((one for one in source.results if cluster in (one.cluster, None)), None)
    if result is None:
        raise ValueError(f"cluster: expected one of {listed(numbers)}, got {cluster!r}")
    if isinstance(result, RodResult):
        raise ValueError(f"cluster {result.cluster} is a rod, which has no full orientation")
    return result


def _forest_height(count: int) -> float:
    """Return the height of a forest plot over the width of two columns."""
    return 0.16 + 0.02 * (count if count <= NAMED_CLUSTERS else 40)


@contextmanager
def _given_or_new(ax: Axes | None, *, height: float = 0.37, space: bool = False) -> Iterator[Axes]:
    """Give axes to draw on: those given, or those of a new figure in perrin's style."""
    if ax is not None:
        yield ax
        return
    with style():
        figure = column_figure(height, columns=1)
        axes: Axes = figure.add_subplot(projection="3d" if space else None)
        yield axes
