"""Figures of imaging quality: spheres found in a movie, and how well their images were fitted."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pandas as pd
from matplotlib.collections import EllipseCollection
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator

from perrin._text import number_text, shortened
from perrin.plot.figure_style import (
    GREY,
    column_figure,
    ink,
    legend_above,
    line_width,
    log_ticks,
    marker_size,
    save_drawn,
    series_color,
    write_reason,
)

if TYPE_CHECKING:
    import os
    from collections.abc import Callable

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from perrin._arrays import Floats, Ints
    from perrin.diffusion.estimate import DiffusionEstimate
    from perrin.images.imaging import Imaging, View
    from perrin.motion.rigid_motion import RigidMotion
    from perrin.motion.rods import RodMotion
    from perrin.plot.figure_style import Sheet
    from perrin.run.results import ClusterResult, Report, RodResult
    from perrin.run.workers import Progress


Side = Literal["xy", "xz", "yz"]
Series = Literal["spheres", "spots", "brightness", "level", "saturated"]

# Horizontal and vertical axis of the picture of each side. xy and yz share the vertical axis y.
_SIDE_AXES: dict[str, tuple[str, str]] = {"xy": ("x", "y"), "xz": ("x", "z"), "yz": ("z", "y")}

# Largest share of black of a sphere, so that circles and numbers on it are visible.
_DARKEST = 0.6

_PATH_FRAMES = 100  # length of a path; longer ones hide the spheres
_SHOWN_VIEWS = 8  # largest number of views in the figure of tracks
_VIEWS_IN_A_ROW = 4  # number of views in one row of the figure of tracks
_NUMBERED_CLUSTERS = 12  # largest number of clusters that are numbered on every side
_COLORED_CLUSTERS = 6  # largest number of clusters with a colour and a legend each
_LEGEND_LETTERS = 12  # total length of the clusters' names in a legend of one line
_VECTOR_POINTS = 500  # longer lines are images inside a PDF
_MASS_BINS = 40  # bins of the histogram of masses
_MOST_ANGLE_BINS = 120  # largest number of bins of the histogram of angles
_MARKED_STEPS = 10  # number of the largest steps that are marked

# Axis label and title of each series of the figure of frames.
_SERIES: dict[Series, tuple[str, str]] = {
    "spheres": ("spheres\nfound", "over the mass cut"),
    "spots": ("spots", "before the mass cut"),
    "brightness": ("brightness\n(% of first)", "median mass of the spheres"),
    "level": ("grey level", "median of the frame"),
    "saturated": ("saturated\nvoxels (%)", "at the end of the range"),
}


def plot_found(imaging: Imaging, view: View, *, ax: Axes, side: Side = "xy") -> Axes:
    """Draw the spheres found in a frame as circles of their diameter on one of its projections.

    Parameters
    ----------
    imaging : Imaging
    view : View
    ax : matplotlib.axes.Axes
    side : {"xy", "xz", "yz"}
        y and z point down like the rows of an image; in "yz" z points to the right. A movie in
        the plane has only "xy".

    Returns
    -------
    matplotlib.axes.Axes
        um. Each cluster has a colour and its number; spheres of no cluster are dashed. Bright
        spheres are drawn dark, like dark ones. With more than 12 clusters only the xy projection
        has the numbers.
    """
    across, down = _SIDE_AXES[side]
    _draw_image(imaging, view, ax=ax, side=side)
    here = _spheres_of(imaging, view.frame)
    _draw_circles(here, imaging.diameter, ax=ax, across=across, down=down, lw=line_width(0.95))
    named = here[here["cluster"] >= 0].groupby("cluster")[[across, down]].mean()
    if side == "xy" or len(named) <= _NUMBERED_CLUSTERS:
        size = "x-small" if len(named) > _NUMBERED_CLUSTERS else "medium"
        for cluster, place in zip(named.index, named.to_numpy(), strict=True):
            # The outline makes the number readable on dark and bright spheres.
            outline = [withStroke(linewidth=line_width(1.35), foreground="white")]
            text = ax.text(place[0], place[1], str(cluster), color=ink(), ha="center", va="center")
            text.set(size=size, weight="bold", path_effects=outline)
            text.set_clip_on(True)
    return ax


def plot_tracks(report: Report, view: View, *, ax: Axes) -> Axes:
    """Draw the paths of the clusters' centres up to a frame on its image, and its spheres.

    Parameters
    ----------
    report : Report
        Report of a movie, with `imaging`.
    view : View
    ax : matplotlib.axes.Axes

    Returns
    -------
    matplotlib.axes.Axes
        um, the xy projection. A path has the last 100 frames; frames without a pose interrupt it.
    """
    imaging = imaging_of(report)
    _draw_image(imaging, view, ax=ax, side="xy")
    here = _spheres_of(imaging, view.frame)
    _draw_circles(here, imaging.diameter, ax=ax, across="x", down="y", lw=line_width(0.6))
    for result in report.results:
        motion = result.motion
        frame = stack_frames(report, motion)
        path = motion.center[(frame <= view.frame) & (frame > view.frame - _PATH_FRAMES)]
        ax.plot(path[:, 0], path[:, 1], color="white", lw=line_width(1.6), alpha=0.7)
        ax.plot(path[:, 0], path[:, 1], color=series_color(result.cluster), lw=line_width(0.8))
    ax.set_title(_frame_text(imaging, view.frame), size="medium")
    return ax


def plot_masses(imaging: Imaging, *, ax: Axes) -> Axes:
    """Draw a histogram of the masses of spots, and the cut between noise and spheres.

    Parameters
    ----------
    imaging : Imaging
    ax : matplotlib.axes.Axes

    Returns
    -------
    matplotlib.axes.Axes
        Integrated brightness (grey levels) and number of spots, both logarithmic.
    """
    mass = imaging.spots["mass"].to_numpy(dtype=np.float64)
    mass = mass[mass > 0]
    if not mass.size:
        return write_reason(ax, "no spots in the sampled frames", framed=True)
    # Equal bins of the logarithm over all masses; one of their edges is the cut.
    low, high, cut = float(mass.min()), float(mass.max()), imaging.minmass
    edges = np.geomspace(low / 1.01, high * 1.01, _MASS_BINS)
    if cut > 0:
        low, high = min(low, cut), max(high, cut)
        ratio = (1.01 * high / low) ** (1 / _MASS_BINS)
        below, above = np.ceil(np.log([cut / low, high / cut]) / np.log(ratio)).astype(int) + 1
        edges = cut * ratio ** np.arange(-below, above + 1)
    kept = mass >= cut
    for which, color, verdict in ((~kept, GREY, "rejected"), (kept, series_color(0), "kept")):
        if which.any():
            ax.hist(mass[which], edges.tolist(), color=color, label=f"{which.sum()} {verdict}")
    if cut > 0:
        label = f"cut at {number_text(cut)}"
        ax.axvline(cut, color=series_color(1), lw=line_width(0.95), ls="--", label=label)
    ax.set(xscale="log", xlabel="mass (grey levels)", ylabel="spots")
    log_ticks(ax.xaxis)
    _count_axis(ax)
    legend_above(ax, ncols=3)
    return ax


def plot_misfit(imaging: Imaging, *, ax: Axes) -> Axes:
    """Draw chi-squared per degree of freedom of the fitted images against time.

    Parameters
    ----------
    imaging : Imaging
        Imaging quality of spheres that were refined by the model of their image.
    ax : matplotlib.axes.Axes

    Returns
    -------
    matplotlib.axes.Axes
        Median and range over the spheres of each frame; time in s. 1 means that the model fits
        the image to within its noise.
    """
    known = imaging.features[["frame", "chi2"]].dropna()
    if known.empty:
        return write_reason(ax, "no image was fitted", framed=True)
    chi2 = known.groupby("frame")["chi2"].agg(["min", "median", "max"])
    time = _frame_times(imaging, chi2.index.to_numpy())
    ax.fill_between(
        time, chi2["min"], chi2["max"], color=series_color(0), alpha=0.25, lw=0, label="range"
    )
    raster = len(time) > _VECTOR_POINTS
    ax.plot(
        time,
        chi2["median"],
        color=series_color(0),
        lw=line_width(0.8),
        label="median",
        rasterized=raster,
    )
    if len(time) == 1:
        ends = np.abs(chi2[["min", "max"]].T.to_numpy() - chi2["median"].to_numpy())
        ax.errorbar(
            time, chi2["median"], ends, fmt="o", color=series_color(0), ms=marker_size(0.65)
        )
    ax.axhline(
        1.0, color=series_color(1), lw=line_width(0.75), ls="--", label="explained to the noise"
    )
    ax.set(xlabel="time (s)", ylabel="image misfit\nχ² per degree of freedom")
    if chi2["max"].max() > 5 * chi2["median"].median():
        ax.set_yscale("log")
        ax.yaxis.set_major_formatter("{x:g}")
    legend_above(ax, ncols=3)
    return ax


def plot_rigidity(report: Report, *, ax: Axes) -> Axes:
    """Draw the rms distance of the spheres to the rigid bodies of all clusters against time.

    Parameters
    ----------
    report : Report
    ax : matplotlib.axes.Axes

    Returns
    -------
    matplotlib.axes.Axes
        Time in s, residual in nm. Up to 6 clusters have colours; more clusters are grey lines
        with their median. The largest residual is labelled with its cluster and frame.
    """
    results = report.results
    if not results:
        return write_reason(ax, "no cluster was tracked", framed=True)
    few, start = len(results) <= _COLORED_CLUSTERS, _tracks_start(report)
    dt, residuals = results[0].motion.dt, []
    for result in results:
        motion = result.motion
        # The same time of clusters with different first frames may differ by rounding.
        residuals.append(pd.Series(motion.residual, index=np.rint(motion.time / dt)))
        style: dict[str, Any] = {"color": GREY, "alpha": 0.5, "lw": line_width(0.4)}
        if few:
            style = {
                "color": series_color(result.cluster),
                "lw": line_width(0.6),
                "label": _cluster_label(result),
            }
        raster = len(motion.time) * len(results) > _VECTOR_POINTS
        ax.plot(start + motion.time, 1e3 * motion.residual, rasterized=raster, **style)
    if not few:
        middle = pd.concat(residuals).dropna().groupby(level=0).median()
        label = f"median of {len(results)} clusters"
        time = start + middle.index.to_numpy() * dt
        ax.plot(time, 1e3 * middle.to_numpy(), color=ink(), lw=line_width(0.8), label=label)
    tops = [float(np.nanmax(r.motion.residual, initial=0.0)) for r in results]
    worst: ClusterResult | RodResult = results[int(np.argmax(tops))]
    k = int(np.nanargmax(worst.motion.residual))
    x, y = start + worst.motion.time[k], 1e3 * worst.motion.residual[k]
    frame = stack_frames(report, worst.motion)[k]
    label = f"largest: {number_text(y)} nm ({_cluster_label(worst)}, frame {frame})"
    ax.plot(
        x, y, "o", ms=marker_size(1.35), mfc="none", mec=ink(), mew=line_width(0.65), label=label
    )
    ax.set(xlabel="time (s)", ylabel="distance to the\nrigid body (nm)")
    ax.set_ylim(bottom=0)
    # A legend that is wider than its axes makes the axes narrower.
    short = few and sum(len(r.name) for r in results) <= _LEGEND_LETTERS
    legend_above(ax, ncols=len(results) + 1 if short else 3)
    return ax


def plot_step_angles(report: Report, *, ax: Axes) -> Axes:
    """Draw a histogram of the rotation angles between successive poses, and its expectation.

    Parameters
    ----------
    report : Report
    ax : matplotlib.axes.Axes

    Returns
    -------
    matplotlib.axes.Axes
        Degrees, and numbers of steps on a logarithmic axis. The line is the expectation for
        Brownian rotation with the pooled D_R and its noise (`step_angle_density`). Ticks mark the
        largest steps; a dotted line within the range marks the smallest rotation that maps a body
        onto itself.
    """
    turns, durations, end = [np.empty(0)], [np.empty(0)], []
    for result in report.clusters:
        motion = result.motion
        first, last = motion.steps()
        turns.append(np.rad2deg(np.linalg.norm(motion.step_vectors()[last - 1], axis=-1)))
        durations.append(motion.time[last] - motion.time[first])
        frames = stack_frames(report, motion)[last]
        end += [f"{_cluster_label(result)}, frame {frame}" for frame in frames]
    angle, duration = np.concatenate(turns), np.concatenate(durations)
    if not angle.size:
        return write_reason(ax, "no step between two poses", framed=True)
    top = 1.08 * max(float(angle.max()), 1e-3)
    width = max(float(np.median(angle)) / 5, top / _MOST_ANGLE_BINS)
    edges = np.arange(0, top + width, width)
    ax.hist(angle, edges.tolist(), color=series_color(0), alpha=0.75, label=f"{angle.size} steps")
    if report.pooled is not None:
        planar = any(c.motion.dimension == 2 for c in report.clusters)
        x = np.linspace(0, edges[-1], 20 * len(edges))
        density = step_angle_density(x, duration, report.pooled.D_R, planar=planar)
        label = "Brownian rotation with the pooled $D_R$ and noise"
        ax.plot(
            x,
            duration.size * edges[1] * density,
            color=series_color(1),
            lw=line_width(0.95),
            label=label,
        )
    k = int(angle.argmax())
    largest = np.sort(angle)[-_MARKED_STEPS:]
    label = f"largest: {number_text(angle[k])}° ({end[k]})"
    style: dict[str, Any] = {
        "color": ink(),
        "ls": "none",
        "ms": marker_size(1.5),
        "clip_on": False,
        "zorder": 4,
    }
    bottom = ax.get_xaxis_transform()
    ax.plot(largest, np.zeros(len(largest)), "|", label=label, transform=bottom, **style)
    for turn in [t for t in least_turns(report) if t < top]:
        label = f"symmetry rotation, {number_text(turn)}°"
        ax.axvline(turn, color=ink(), lw=line_width(0.8), ls=":", label=label)
    ax.set(xlabel="angle between successive poses (°)", ylabel="steps")
    ax.set_xlim(0, edges[-1])
    _count_axis(ax)
    legend_above(ax, ncols=2)
    return ax


def plot_health(imaging: Imaging, *, ax: Axes, series: Series = "spheres") -> Axes:
    """Draw one quantity of the frames against time; crosses mark frames that could not be read.

    Parameters
    ----------
    imaging : Imaging
    ax : matplotlib.axes.Axes
    series : {"spheres", "spots", "brightness", "level", "saturated"}
        Number of spheres; number of spots before the mass cut; median mass of the spheres in
        percent of that in the first frame with spheres; median grey level; percent of saturated
        voxels.

    Returns
    -------
    matplotlib.axes.Axes
        Time in s.
    """
    label, title = _SERIES[series]
    frames = imaging.frames
    time, unread = frames["time"].to_numpy(dtype=np.float64), frames["fault"].fillna("") != ""
    if series == "brightness":
        median = imaging.features.groupby("frame")["mass"].median()
        value = np.asarray(median.reindex(frames["frame"]), dtype=np.float64)
        known = value[np.isfinite(value)]
        value = 100 * value / (known[0] if known.size else 1.0)
    else:
        value = frames[series].to_numpy(dtype=np.float64) * (100 if series == "saturated" else 1)
    value = np.where(unread, np.nan, value)
    raster = len(time) > _VECTOR_POINTS
    marker = "." if len(time) <= 200 else None
    ax.plot(
        time,
        value,
        color=series_color(0),
        lw=line_width(0.6),
        marker=marker,
        ms=marker_size(0.65),
        rasterized=raster,
    )
    lost = time[unread]
    if lost.size:
        style: dict[str, Any] = {
            "color": series_color(1),
            "ls": "none",
            "ms": marker_size(0.85),
            "clip_on": False,
        }
        ax.plot(lost, np.zeros(lost.size), "x", transform=ax.get_xaxis_transform(), **style)
        title += f"; ×: not read ({lost.size} of {len(time)} frames)" if series == "spheres" else ""
    ax.set(xlabel="time (s)", ylabel=label)
    ax.set_title(title, loc="left", size="small", color=ink(), pad=3)
    counted = series in ("spheres", "spots")
    ax.yaxis.set_major_locator(MaxNLocator(3, integer=counted))
    known = value[np.isfinite(value)]
    if known.size:
        low, high = float(known.min()), float(known.max())
        # A constant series is drawn in the middle of its axis.
        margin = max(0.15 * (high - low), 0.02 * abs(high), 1.0 if counted else 0.0) or 0.1
        ax.set_ylim(low - margin, high + margin)
    return ax


def save_image_figures(
    report: Report,
    folder: str | os.PathLike[str],
    *,
    sheet: Sheet | None = None,
    progress: Progress | None = None,
) -> list[Path]:
    """Write the figures of imaging quality into an existing folder, each as PNG and PDF.

    Parameters
    ----------
    report : Report
        Report of a movie, with `imaging`.
    folder : path
    sheet : path, str or mapping, optional
        Style sheet that outranks perrin's, as in `style`.
    progress : callable, optional
        Called with the number of finished figures, their total, and what is done.

    Returns
    -------
    list of Path
        ``images-found.*``, ``-tracks.*`` (both only if the movie has views), ``-masses.*``,
        ``-residuals.*``, ``-steps.*`` and ``-health.*``.
    """
    imaging = imaging_of(report)
    figures: dict[str, Callable[[], Figure]] = {}
    if imaging.views:
        figures["images-found"] = partial(found_figure, imaging)
        figures["images-tracks"] = partial(tracks_figure, report)
    figures["images-masses"] = partial(_single_figure, plot_masses, imaging)
    figures["images-residuals"] = partial(misfit_figure, report)
    figures["images-steps"] = partial(_single_figure, plot_step_angles, report)
    figures["images-health"] = partial(health_figure, imaging)
    return save_drawn(figures, Path(folder), sheet=sheet, progress=progress)


def imaging_of(report: Report) -> Imaging:
    """Return the imaging quality of a report.

    Parameters
    ----------
    report : Report

    Returns
    -------
    Imaging

    Raises
    ------
    ValueError
        If the report is not that of a movie.
    """
    if report.imaging is None:
        raise ValueError("this report began with a table, not with images: report.imaging is None")
    return report.imaging


def _cluster_label(result: ClusterResult | RodResult) -> str:
    """Return the name of a cluster, a text of the user: a dollar sign does not begin a formula."""
    return "cluster " + shortened(result.name).replace("$", r"\$")


def stack_frames(report: Report, motion: RigidMotion | RodMotion) -> Ints:
    """Return the frame of the stack of every row of a motion.

    Parameters
    ----------
    report : Report
        Report of a movie, with `imaging`.
    motion : RigidMotion or RodMotion
        Motion of one of its clusters or rods.

    Returns
    -------
    array of int, shape (T,)
    """
    frames = imaging_of(report).frames
    times = frames["time"].to_numpy(dtype=np.float64)
    nearest = np.searchsorted((times[1:] + times[:-1]) / 2, motion.time + _tracks_start(report))
    return np.asarray(frames["frame"].to_numpy(dtype=np.int64)[nearest])


def _tracks_start(report: Report) -> float:
    """Return the time of the stack at which the tracks begin, s."""
    if report.imaging is None:
        return 0.0
    first = int(report.settings.get("first_frame") or 0)
    time = float(_frame_times(report.imaging, np.array([first]))[0])
    return time if np.isfinite(time) else 0.0


def _frame_times(imaging: Imaging, frame: Any) -> Floats:  # noqa: ANN401 (what pandas indexes by)
    times = imaging.frames.set_index("frame")["time"]
    return np.asarray(times.reindex(frame), dtype=np.float64)


def _frame_text(imaging: Imaging, frame: int) -> str:
    time = float(_frame_times(imaging, np.array([frame]))[0])
    return f"frame {frame}, {number_text(time)} s" if np.isfinite(time) else f"frame {frame}"


def _spheres_of(imaging: Imaging, frame: int) -> pd.DataFrame:
    """Return the spheres of a frame that have coordinates."""
    here = imaging.features[imaging.features["frame"] == frame]
    return here.dropna(subset=["x", "y"])


def _count_axis(ax: Axes) -> None:
    """Make the axis of counts logarithmic, so that a count of 1 is visible among thousands."""
    ax.set_yscale("log")
    # Both ends are set, because the tail of the expected curve reaches far below 1.
    ax.set_ylim(0.5, 2 * ax.dataLim.ymax)
    log_ticks(ax.yaxis)
    ax.yaxis.set_major_formatter("{x:g}")


def _draw_image(imaging: Imaging, view: View, *, ax: Axes, side: Side) -> None:
    """Draw a projection with dark spheres, in um; the origin is the centre of a voxel."""
    across, down = _SIDE_AXES[side]
    size = dict(zip("zyx", imaging.voxel, strict=True))
    pixels = getattr(view, side).T if side == "yz" else getattr(view, side)
    rows, columns = pixels.shape
    left, top = -size[across] / 2, -size[down] / 2
    extent = (left, left + columns * size[across], top + rows * size[down], top)
    level, sphere = np.nanpercentile(pixels, (50, 0.2) if imaging.dark else (50, 99.8))
    contrast = (sphere - level) / _DARKEST or 1.0
    ends = sorted((level - 0.1 * contrast, level + contrast))
    cmap = "gray" if imaging.dark else "gray_r"
    ax.imshow(pixels, cmap=cmap, vmin=ends[0], vmax=ends[1], extent=extent, origin="upper")
    ax.set(xlabel=f"{across} (µm)", ylabel=f"{down} (µm)")


def _draw_circles(
    spheres: pd.DataFrame, diameter: float, *, ax: Axes, across: str, down: str, lw: float
) -> None:
    """Draw the outlines of spheres at their true size, and keep the limits of the axes.

    Lines are `lw` points wide, less if the spheres are small in the picture.
    """
    limits = ax.axis()
    lw *= min(1.0, max(0.4, 16 * diameter / abs(limits[1] - limits[0])))
    cluster = spheres["cluster"].to_numpy()
    centers = spheres[[across, down]].to_numpy(dtype=np.float64)
    own = np.array([series_color(int(k)) for k in cluster[cluster >= 0]], dtype=object)
    for which, colors, outline in (
        (cluster < 0, "white", {"linewidths": 2 * lw}),
        (cluster < 0, ink(), {"linewidths": lw, "linestyles": [(0, (2.5, 2))]}),
        (cluster >= 0, own, {"linewidths": lw}),
    ):
        size = np.full(which.sum(), diameter)
        circles = EllipseCollection(
            size,
            size,
            np.zeros(len(size)),
            units="xy",
            offsets=centers[which],
            offset_transform=ax.transData,
            facecolors="none",
            edgecolors=colors,
            **outline,
        )
        ax.add_collection(circles, autolim=False)
    ax.axis(limits)


def step_angle_density(
    angle: Floats, duration: Floats, D_R: DiffusionEstimate, *, planar: bool
) -> Floats:
    """Return the probability density of the rotation angles of Brownian steps with noise.

    Each component of the rotation vector is Gaussian with variance 2 (D_R t + offset), so the
    angle has Maxwell's distribution in space and half a Gaussian in the plane.

    Parameters
    ----------
    angle : array
        Degrees.
    duration : array
        Duration of every step, s; the density is the mean over them.
    D_R : DiffusionEstimate
    planar : bool
        Whether the motion is in the plane.

    Returns
    -------
    array, shape of `angle`
        1/degree; NaN if the offset is so negative that a variance is not positive.
    """
    length, count = np.unique(np.round(duration, 9), return_counts=True)
    variance = 2 * (D_R.value * length + D_R.offset)
    if not (variance > 0).all():
        return np.full(len(angle), np.nan)
    x = np.deg2rad(angle)[:, None]
    density = np.sqrt(2 / np.pi / variance) * np.exp(-(x**2) / 2 / variance)
    if not planar:
        density = density * x**2 / variance
    return np.asarray(np.deg2rad(density @ count / count.sum()))


def least_turn(symmetry: str) -> float:
    """Return the smallest rotation that maps a body of a point group onto itself.

    Parameters
    ----------
    symmetry : str
        Schoenflies symbol: "T_d".

    Returns
    -------
    float
        Degrees; inf for a group without rotations.

    Examples
    --------
    >>> least_turn("T_d"), least_turn("D_3h"), least_turn("C_s")
    (120.0, 120.0, inf)
    """
    family, _, rest = symmetry.partition("_")
    order = {"T": 3, "O": 4, "I": 5}.get(family, 1)
    digits = "".join(c for c in rest if c.isdigit())
    if digits:
        # The rotations of S_2n are those of C_n; its other elements are improper.
        order = int(digits) // (2 if family == "S" else 1)
    return 360 / order if order > 1 else np.inf


def least_turns(report: Report) -> list[float]:
    """Return the smallest rotations that map the bodies of a report onto themselves.

    Parameters
    ----------
    report : Report

    Returns
    -------
    list of float
        Degrees, in ascending order, one for each different value.
    """
    turns = set()
    for result in report.clusters:
        group = "" if result.quality is None else result.quality.symmetry
        # In the plane only rotations about its normal count; the group then has a mirror "h".
        if result.motion.dimension == 3 or group.endswith("h"):
            turns.add(least_turn(group))
    return sorted(t for t in turns if np.isfinite(t))


def _single_figure(draw: Callable[..., Axes], source: Imaging | Report) -> Figure:
    """Return a figure of one drawing over two columns."""
    figure = column_figure(0.42)
    draw(source, ax=figure.add_subplot())
    return figure


def found_figure(imaging: Imaging) -> Figure:
    """Return a figure of the spheres found in the middle view, on all its projections.

    Parameters
    ----------
    imaging : Imaging
        Imaging quality with at least one view.

    Returns
    -------
    matplotlib.figure.Figure
        xy, with xz below and yz to the right, all on one scale.
    """
    view = imaging.views[len(imaging.views) // 2]
    rows, columns = view.xy.shape
    depth, high, wide = np.array([view.xz.shape[0], rows, columns]) * imaging.voxel
    planar = not np.isfinite(depth)
    depth = 0.0 if planar else depth
    height = 0.9 * (high + depth) / (wide + depth) + 0.07
    figure = column_figure(float(np.clip(height, 0.3, 1.4)))
    figure.set_layout_engine("compressed")
    title = f"{_frame_text(imaging, view.frame)}: {len(_spheres_of(imaging, view.frame))} spheres"
    if planar:
        plot_found(imaging, view, ax=figure.add_subplot()).set_title(title, size="medium")
        return figure
    ratios: dict[str, Any] = {"width_ratios": (wide, depth), "height_ratios": (high, depth)}
    (main, right), (below, empty) = figure.subplots(2, 2, gridspec_kw=ratios)
    empty.set_axis_off()
    plot_found(imaging, view, ax=main).set_title(title, size="medium")
    plot_found(imaging, view, ax=right, side="yz").set_ylabel("")
    plot_found(imaging, view, ax=below, side="xz")
    main.set_xlabel("")
    main.tick_params(labelbottom=False)
    right.tick_params(labelleft=False)
    ticks = 3 if depth > 0.2 * wide else 1
    right.xaxis.set_major_locator(MaxNLocator(ticks))
    below.yaxis.set_major_locator(MaxNLocator(ticks))
    return figure


def tracks_figure(report: Report) -> Figure:
    """Return a figure of the tracks on up to 8 views, evenly over the movie, four in a row.

    Parameters
    ----------
    report : Report
        Report of a movie, with `imaging`.

    Returns
    -------
    matplotlib.figure.Figure
    """
    views = imaging_of(report).views
    which = np.unique(
        np.linspace(0, len(views) - 1, min(len(views), _SHOWN_VIEWS)).round().astype(int)
    )
    count = len(which)
    across = min(count, _VIEWS_IN_A_ROW)
    lines = -(-count // across)
    _, y, x = imaging_of(report).voxel
    rows, columns = views[0].xy.shape
    shape = rows * y / (columns * x)
    figure = column_figure(
        float(np.clip(lines * (0.94 / across * shape + 0.035) + 0.04, 0.25, 1.4))
    )
    figure.set_layout_engine("compressed")
    panels = figure.subplots(lines, across, sharex=True, sharey=True, squeeze=False)
    for k, ax in enumerate(panels.flat):
        if k >= count:
            ax.set_axis_off()
            continue
        plot_tracks(report, views[which[k]], ax=ax)
        if k + across < count:
            ax.set_xlabel("")
        else:
            ax.tick_params(labelbottom=True)
        if k % across:
            ax.set_ylabel("")
    return figure


def misfit_figure(report: Report) -> Figure:
    """Return a figure of the image misfit and of the residuals of the rigid bodies.

    Parameters
    ----------
    report : Report
        Report of a movie, with `imaging`. Without fitted images only the residuals are drawn.

    Returns
    -------
    matplotlib.figure.Figure
    """
    imaging = imaging_of(report)
    if "chi2" not in imaging.features:
        return _single_figure(plot_rigidity, report)
    figure = column_figure(0.56)
    top, bottom = figure.subplots(2, 1, sharex=True)
    plot_misfit(imaging, ax=top)
    plot_rigidity(report, ax=bottom)
    top.set_xlabel("")
    return figure


def health_figure(imaging: Imaging) -> Figure:
    """Return a figure of all series of `plot_health`, with a common time axis.

    Parameters
    ----------
    imaging : Imaging

    Returns
    -------
    matplotlib.figure.Figure
    """
    figure = column_figure(0.7)
    panels = figure.subplots(len(_SERIES), 1, sharex=True)
    for ax, series in zip(panels, _SERIES, strict=True):
        plot_health(imaging, ax=ax, series=series)
        if ax is not panels[-1]:
            ax.set_xlabel("")
    figure.align_ylabels()
    return figure
