"""Pictures of how the spheres of a movie were seen: what was found, and how far to trust it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from matplotlib.collections import EllipseCollection
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator

from perrin._text import number_text, shortened
from perrin.plot.style import BLUE, GREY, INK, PALETTE, RED, legend_above, new_figure, save_figure

if TYPE_CHECKING:
    import os

    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from perrin._arrays import Bools, Floats, Ints
    from perrin.diffusion.estimate import DiffusionEstimate
    from perrin.images.imaging import Imaging, View
    from perrin.motion.rigid_motion import RigidMotion
    from perrin.motion.rods import RodMotion
    from perrin.run.results import ClusterResult, Report, RodResult


Side = Literal["xy", "xz", "yz"]


Series = Literal["spheres", "spots", "brightness", "level", "saturated"]


# What lies across and what down in a picture of each side; yz stands beside xy, y down in both.
_ACROSS: dict[str, tuple[str, str]] = {"xy": ("x", "y"), "xz": ("x", "z"), "yz": ("z", "y")}


# Spheres are drawn no darker than this part of black, so that circles and numbers are seen on them.
_DARKEST = 0.6


_TRAIL = 100  # frames of a path: longer ones hide the spheres


_PANELS = 8  # views in a montage


_ACROSS_PAGE = 4  # of them in a row


_NUMBERED = 12  # clusters whose numbers can be read on every side


_FEW = 6  # clusters that have a colour of their own


_NAMES = 12  # letters of their names together that leave room for one line of a legend


_RASTER = 500  # points beyond which a line is an image inside a PDF


_BINS = 40  # of a histogram of masses


_MOST_BINS = 120  # of a histogram of angles


_TICKS = 10  # of the largest steps


_SERIES: dict[Series, tuple[str, str]] = {
    "spheres": ("spheres\nfound", "over the mass cut"),
    "spots": ("spots", "before the mass cut"),
    "brightness": ("brightness\n(% of first)", "median mass of the spheres"),
    "level": ("grey level", "median of the frame"),
    "saturated": ("saturated\nvoxels (%)", "at the end of the range"),
}


def plot_found(imaging: Imaging, view: View, *, ax: Axes, side: Side = "xy") -> Axes:
    """Draw the spheres found in a frame as circles on one of its projections, true to scale.

    Parameters
    ----------
    imaging : Imaging
    view : View
    ax : matplotlib.axes.Axes
    side : {"xy", "xz", "yz"}
        y and z point down, as rows of an image do; in "yz" z points to the right. In the plane
        there is only "xy".

    Returns
    -------
    matplotlib.axes.Axes
        um. A colour a cluster, with its number; spheres of no cluster dashed. Bright
        spheres are drawn dark, so that both kinds look alike. Of more than 12 clusters, which hide
        each other from the side, only the xy projection has the numbers.
    """
    across, down = _ACROSS[side]
    _draw_image(imaging, view, ax=ax, side=side)
    here = _spheres(imaging, view.frame)
    _draw_circles(here, imaging.diameter, ax=ax, across=across, down=down, lw=1.4)
    named = here[here["cluster"] >= 0].groupby("cluster")[[across, down]].mean()
    if side == "xy" or len(named) <= _NUMBERED:
        for cluster, place in zip(named.index, named.to_numpy(), strict=True):
            _write_number(cluster, place, ax=ax, small=len(named) > _NUMBERED)
    return ax


def plot_tracks(report: Report, view: View, *, ax: Axes) -> Axes:
    """Draw the paths of the clusters' centres up to a frame, and its spheres, over its image.

    Parameters
    ----------
    report : Report
        With `imaging`.
    view : View
    ax : matplotlib.axes.Axes

    Returns
    -------
    matplotlib.axes.Axes
        um, the xy projection. A path reaches 100 frames back; frames without a pose break it.
    """
    imaging = imaging_of(report)
    _draw_image(imaging, view, ax=ax, side="xy")
    here = _spheres(imaging, view.frame)
    _draw_circles(here, imaging.diameter, ax=ax, across="x", down="y", lw=0.9)
    for result in report.results:
        motion = result.motion
        frame = _frame_numbers(report, motion)
        path = motion.center[(frame <= view.frame) & (frame > view.frame - _TRAIL)]
        ax.plot(path[:, 0], path[:, 1], color="white", lw=2.4, alpha=0.7)
        ax.plot(path[:, 0], path[:, 1], color=_color(result.cluster), lw=1.2)
    ax.set_title(_frame_text(imaging, view.frame), size="medium")
    return ax


def plot_masses(imaging: Imaging, *, ax: Axes) -> Axes:
    """Draw how bright the spots of some frames are, and where spheres are parted from noise.

    Parameters
    ----------
    imaging : Imaging
    ax : matplotlib.axes.Axes

    Returns
    -------
    matplotlib.axes.Axes
        Integrated brightness (grey levels) and numbers of spots, both logarithmic.
    """
    mass = imaging.spots["mass"].to_numpy(dtype=np.float64)
    mass = mass[mass > 0]
    if not mass.size:
        return _say(ax, "no spots in the frames looked at")
    edges = _mass_edges(mass, imaging.minmass)
    kept = mass >= imaging.minmass
    for which, color, said in ((~kept, GREY, "rejected"), (kept, BLUE, "kept")):
        if which.any():
            ax.hist(mass[which], edges.tolist(), color=color, label=f"{which.sum()} {said}")
    if imaging.minmass > 0:
        said = f"cut at {number_text(imaging.minmass)}"
        ax.axvline(imaging.minmass, color=RED, lw=1.4, ls="--", label=said)
    ax.set(xscale="log", xlabel="mass (grey levels)", ylabel="spots")
    _count_axis(ax)
    legend_above(ax, ncols=3)
    return ax


def plot_misfit(imaging: Imaging, *, ax: Axes) -> Axes:
    """Draw chi-squared per degree of freedom of the fitted images against time.

    Parameters
    ----------
    imaging : Imaging
        Refined by the model.
    ax : matplotlib.axes.Axes

    Returns
    -------
    matplotlib.axes.Axes
        Median of each frame's spheres, and their range; time in s. 1 is an image explained to its
        noise.
    """
    known = imaging.features[["frame", "chi2"]].dropna()
    if known.empty:
        return _say(ax, "no image was fitted")
    told = known.groupby("frame")["chi2"].agg(["min", "median", "max"])
    time = _frame_times(imaging, told.index.to_numpy())
    ax.fill_between(time, told["min"], told["max"], color=BLUE, alpha=0.25, lw=0, label="range")
    raster = len(time) > _RASTER
    ax.plot(time, told["median"], color=BLUE, lw=1.2, label="median", rasterized=raster)
    if len(time) == 1:
        ax.errorbar(time, told["median"], _reach(told), fmt="o", color=BLUE, ms=4)
    ax.axhline(1.0, color=RED, lw=1.1, ls="--", label="explained to the noise")
    ax.set(xlabel="time (s)", ylabel="image misfit\nχ² per degree of freedom")
    if told["max"].max() > 5 * told["median"].median():
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
        Time in s, residual in nm. Up to 6 clusters have their colours; of more each is a grey
        line, with their median. The largest is named.
    """
    results = report.results
    if not results:
        return _say(ax, "no cluster was tracked")
    few, start = len(results) <= _FEW, _start(report)
    for result in results:
        motion = result.motion
        look: dict[str, Any] = {"color": GREY, "alpha": 0.5, "lw": 0.6}
        if few:
            look = {"color": _color(result.cluster), "lw": 0.9, "label": _named(result)}
        raster = len(motion.time) * len(results) > _RASTER
        ax.plot(start + motion.time, 1e3 * motion.residual, rasterized=raster, **look)
    if not few:
        time, middle = _median_residual(report)
        said = f"median of {len(results)} clusters"
        ax.plot(start + time, 1e3 * middle, color=INK, lw=1.2, label=said)
    _mark_largest(report, ax=ax)
    ax.set(xlabel="time (s)", ylabel="distance to the\nrigid body (nm)")
    ax.set_ylim(bottom=0)
    # Names may be long; a legend wider than its axes would squeeze them.
    short = few and sum(len(r.name) for r in results) <= _NAMES
    legend_above(ax, ncols=len(results) + 1 if short else 3)
    return ax


def plot_step_angles(report: Report, *, ax: Axes) -> Axes:
    """Draw the angles that bodies turn through from pose to pose, and those to expect.

    Parameters
    ----------
    report : Report
    ax : matplotlib.axes.Axes

    Returns
    -------
    matplotlib.axes.Axes
        Degrees, and numbers of steps on a logarithmic axis. The line is what Brownian rotation of
        the pooled D_R and its noise gives for the duration of every step: each component of the
        rotation vector has the variance 2 (D_R t + offset). Ticks are the largest steps; a dotted
        line, where it is within range, is the least turn that brings a body onto itself.
    """
    angle, duration, end = _steps(report)
    if not angle.size:
        return _say(ax, "no step between two poses")
    top = 1.08 * max(float(angle.max()), 1e-3)
    width = max(float(np.median(angle)) / 5, top / _MOST_BINS)
    edges = np.arange(0, top + width, width)
    ax.hist(angle, edges.tolist(), color=BLUE, alpha=0.75, label=f"{angle.size} steps")
    _draw_expected(report, edges, duration, ax=ax)
    k = int(angle.argmax())
    largest = np.sort(angle)[-_TICKS:]
    said = f"largest: {number_text(angle[k])}° ({end[k]})"
    look: dict[str, Any] = {"color": INK, "ls": "none", "ms": 9, "clip_on": False, "zorder": 4}
    ax.plot(largest, np.zeros(len(largest)), "|", label=said, transform=_foot(ax), **look)
    _mark_symmetry(report, top, ax=ax)
    ax.set(xlabel="angle between successive poses (°)", ylabel="steps")
    ax.set_xlim(0, edges[-1])
    _count_axis(ax)
    legend_above(ax, ncols=2)
    return ax


def plot_health(imaging: Imaging, *, ax: Axes, series: Series = "spheres") -> Axes:
    """Draw one number a frame against time; crosses mark frames that could not be read.

    Parameters
    ----------
    imaging : Imaging
    ax : matplotlib.axes.Axes
    series : {"spheres", "spots", "brightness", "level", "saturated"}
        Spheres found; spots before the mass cut; median mass of the spheres, in percent of the
        first frame that has any; median grey level; percent of saturated voxels.

    Returns
    -------
    matplotlib.axes.Axes
        Time in s.
    """
    label, said = _SERIES[series]
    time = imaging.frames["time"].to_numpy(dtype=np.float64)
    value = _health(imaging, series)
    raster = len(time) > _RASTER
    marker = "." if len(time) <= 200 else None
    ax.plot(time, value, color=BLUE, lw=0.9, marker=marker, ms=4, rasterized=raster)
    lost = time[_unread(imaging)]
    if lost.size:
        look: dict[str, Any] = {"color": RED, "ls": "none", "ms": 5, "clip_on": False}
        ax.plot(lost, np.zeros(lost.size), "x", transform=_foot(ax), **look)
        said += "" if series != "spheres" else f"; ×: not read ({lost.size} of {len(time)} frames)"
    ax.set(xlabel="time (s)", ylabel=label)
    ax.set_title(said, loc="left", size="small", color=INK, pad=3)
    ax.yaxis.set_major_locator(MaxNLocator(3, integer=series in ("spheres", "spots")))
    _widen(ax, value, least=1.0 if series in ("spheres", "spots") else 0.0)
    return ax


def save_image_figures(report: Report, folder: str | os.PathLike[str]) -> list[Path]:
    """Draw how a report's spheres were seen into a folder that exists, each as PNG and PDF.

    Parameters
    ----------
    report : Report
        With `imaging`.
    folder : path

    Returns
    -------
    list of Path
        ``images-found.*``, ``-tracks.*`` (both only where there are views), ``-masses.*``,
        ``-residuals.*``, ``-steps.*`` and ``-health.*``.
    """
    place = Path(folder)
    imaging = imaging_of(report)
    drawn: dict[str, Figure] = {}
    if imaging.views:
        drawn["found"] = _found_figure(imaging)
        drawn["tracks"] = _tracks_figure(report)
    drawn["masses"] = _single_figure()
    plot_masses(imaging, ax=drawn["masses"].axes[0])
    drawn["residuals"] = _residual_figure(report)
    drawn["steps"] = _single_figure()
    plot_step_angles(report, ax=drawn["steps"].axes[0])
    drawn["health"] = _health_figure(imaging)
    return [f for name, one in drawn.items() for f in save_figure(one, place / f"images-{name}")]


def imaging_of(report: Report) -> Imaging:
    """Return how a report's spheres were seen.

    Raises
    ------
    ValueError
        If the run did not begin with images.
    """
    if report.imaging is None:
        raise ValueError("this report began with a table, not with images: report.imaging is None")
    return report.imaging


def _color(cluster: int) -> str:
    return PALETTE[cluster % len(PALETTE)]


def _named(result: ClusterResult | RodResult) -> str:
    """Return a cluster's name, which is the user's text: dollars in it are no formula."""
    return "cluster " + shortened(result.name).replace("$", r"\$")


def _first_frame(report: Report) -> int:
    """Return the stack's frame that the tracks call 0."""
    return int(report.settings.get("first_frame") or 0)


def _frame_numbers(report: Report, motion: RigidMotion | RodMotion) -> Ints:
    """Return the stack's frame of every row of a motion."""
    frames = imaging_of(report).frames
    times = frames["time"].to_numpy(dtype=np.float64)
    nearest = np.searchsorted((times[1:] + times[:-1]) / 2, motion.time + _start(report))
    return np.asarray(frames["frame"].to_numpy(dtype=np.int64)[nearest])


def _start(report: Report) -> float:
    """Return the stack's time at which the tracks begin, s."""
    if report.imaging is None:
        return 0.0
    time = float(_frame_times(report.imaging, np.array([_first_frame(report)]))[0])
    return time if np.isfinite(time) else 0.0


def _frame_times(imaging: Imaging, frame: Any) -> Floats:  # noqa: ANN401 (what pandas indexes by)
    times = imaging.frames.set_index("frame")["time"]
    return np.asarray(times.reindex(frame), dtype=np.float64)


def _frame_text(imaging: Imaging, frame: int) -> str:
    time = float(_frame_times(imaging, np.array([frame]))[0])
    return f"frame {frame}, {number_text(time)} s" if np.isfinite(time) else f"frame {frame}"


def _spheres(imaging: Imaging, frame: int) -> pd.DataFrame:
    """Return the spheres of a frame that have a place."""
    here = imaging.features[imaging.features["frame"] == frame]
    return here.dropna(subset=["x", "y"])


def _foot(ax: Axes) -> Any:  # noqa: ANN401 (matplotlib's transforms carry no common type)
    return ax.get_xaxis_transform()


def _count_axis(ax: Axes) -> None:
    """Make the axis of numbers logarithmic: a single one among thousands is seen."""
    ax.set_yscale("log")
    # Set both ends: the far tail of a law would stretch margins without bound.
    ax.set_ylim(0.5, 2 * ax.dataLim.ymax)
    ax.yaxis.set_major_formatter("{x:g}")


def _say(ax: Axes, text: str) -> Axes:
    """Write why there is no picture where the picture would be."""
    ax.text(0.5, 0.5, text, color=GREY, ha="center", va="center", transform=ax.transAxes)
    ax.set(xticks=[], yticks=[])
    return ax


def _draw_image(imaging: Imaging, view: View, *, ax: Axes, side: Side) -> None:
    """Draw a projection, spheres dark on light, in um; the origin is the centre of a voxel."""
    across, down = _ACROSS[side]
    size = dict(zip("zyx", imaging.voxel, strict=True))
    pixels = getattr(view, side).T if side == "yz" else getattr(view, side)
    rows, columns = pixels.shape
    left, top = -size[across] / 2, -size[down] / 2
    extent = (left, left + columns * size[across], top + rows * size[down], top)
    level, sphere = np.nanpercentile(pixels, (50, 0.2) if imaging.dark else (50, 99.8))
    reach = (sphere - level) / _DARKEST or 1.0
    ends = sorted((level - 0.1 * reach, level + reach))
    cmap = "gray" if imaging.dark else "gray_r"
    ax.imshow(pixels, cmap=cmap, vmin=ends[0], vmax=ends[1], extent=extent, origin="upper")
    ax.set(xlabel=f"{across} (µm)", ylabel=f"{down} (µm)")


def _draw_circles(
    spheres: pd.DataFrame, diameter: float, *, ax: Axes, across: str, down: str, lw: float
) -> None:
    """Draw the outlines of spheres at their true size, and keep the picture's limits.

    Lines are at most `lw` points wide, less where spheres are small in the picture.
    """
    limits = ax.axis()
    lw *= min(1.0, max(0.4, 16 * diameter / abs(limits[1] - limits[0])))
    cluster = spheres["cluster"].to_numpy()
    centers = spheres[[across, down]].to_numpy(dtype=np.float64)
    own = np.array([_color(k) for k in cluster[cluster >= 0]], dtype=object)
    for which, colors, look in (
        (cluster < 0, "white", {"linewidths": 2 * lw}),
        (cluster < 0, INK, {"linewidths": lw, "linestyles": [(0, (2.5, 2))]}),
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
            **look,
        )
        ax.add_collection(circles, autolim=False)
    ax.axis(limits)


def _write_number(cluster: int, place: Floats, *, ax: Axes, small: bool) -> None:
    """Write a cluster's number at its middle, to be read on light and dark."""
    outline = [withStroke(linewidth=2, foreground="white")]
    text = ax.text(place[0], place[1], str(cluster), color=INK, ha="center", va="center")
    text.set(size="x-small" if small else "medium", weight="bold", path_effects=outline)
    text.set_clip_on(True)


def _mass_edges(mass: Floats, minmass: float) -> Floats:
    """Return even logarithmic bins over all masses, one of whose edges is the cut."""
    low, high = float(mass.min()), float(mass.max())
    if minmass <= 0:
        return np.geomspace(low / 1.01, high * 1.01, _BINS)
    low, high = min(low, minmass), max(high, minmass)
    ratio = (1.01 * high / low) ** (1 / _BINS)
    below = int(np.ceil(np.log(minmass / low) / np.log(ratio))) + 1
    above = int(np.ceil(np.log(high / minmass) / np.log(ratio))) + 1
    return np.asarray(minmass * ratio ** np.arange(-below, above + 1))


def _reach(told: pd.DataFrame) -> Floats:
    """Return how far the ends of a range are from its median."""
    return np.stack([told["median"] - told["min"], told["max"] - told["median"]])


def _median_residual(report: Report) -> tuple[Floats, Floats]:
    """Return times, s, and at each the median of the residuals of all clusters, um."""
    time = np.concatenate([r.motion.time for r in report.results])
    residual = np.concatenate([r.motion.residual for r in report.results])
    known = np.isfinite(residual)
    # Equal times of clusters with different first frames may differ by rounding.
    frame = np.rint(time[known] / report.results[0].motion.dt)
    shared, which = np.unique(frame, return_inverse=True)
    order = np.argsort(which, kind="stable")
    parts = np.split(residual[known][order], np.cumsum(np.bincount(which))[:-1])
    return shared * report.results[0].motion.dt, np.array([np.median(p) for p in parts])


def _mark_largest(report: Report, *, ax: Axes) -> None:
    """Ring and name the largest residual."""
    tops = [float(np.nanmax(r.motion.residual, initial=0.0)) for r in report.results]
    worst: ClusterResult | RodResult = report.results[int(np.argmax(tops))]
    k = int(np.nanargmax(worst.motion.residual))
    x, y = _start(report) + worst.motion.time[k], 1e3 * worst.motion.residual[k]
    frame = _frame_numbers(report, worst.motion)[k]
    said = f"largest: {number_text(y)} nm ({_named(worst)}, frame {frame})"
    ax.plot(x, y, "o", ms=8, mfc="none", mec=INK, mew=1.0, label=said)


def _steps(report: Report) -> tuple[Floats, Floats, list[str]]:
    """Return angle (degrees), duration (s) and end (in words) of every step."""
    angle, duration = [np.empty(0)], [np.empty(0)]
    end: list[str] = []
    for result in report.clusters:
        motion = result.motion
        start, stop = motion.steps()
        angle.append(np.rad2deg(np.linalg.norm(motion.step_vectors()[stop - 1], axis=-1)))
        duration.append(motion.time[stop] - motion.time[start])
        end += [f"{_named(result)}, frame {k}" for k in _frame_numbers(report, motion)[stop]]
    return np.concatenate(angle), np.concatenate(duration), end


def _draw_expected(report: Report, edges: Floats, duration: Floats, *, ax: Axes) -> None:
    """Draw the numbers of steps that the pooled D_R and its noise give for columns of a width."""
    if report.pooled is None:
        return
    planar = any(c.motion.template.shape[1] == 2 for c in report.clusters)
    angle = np.linspace(0, edges[-1], 20 * len(edges))
    density = _angle_density(angle, duration, report.pooled.D_R, planar=planar)
    said = "Brownian rotation with the pooled $D_R$ and noise"
    ax.plot(angle, duration.size * edges[1] * density, color=RED, lw=1.4, label=said)


def _angle_density(
    angle: Floats, duration: Floats, D_R: DiffusionEstimate, *, planar: bool
) -> Floats:
    """Return the density, 1/degree, of the angles (degrees) of Brownian steps, noise included.

    Maxwell's in space, half a Gaussian in the plane: each component of the rotation vector is
    Gaussian. NaN where the noise found is so negative that no variance is left.
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
    """Return the least turn that brings a body of this point group onto itself, degrees; or inf.

    Examples
    --------
    >>> least_turn("T_d"), least_turn("D_3h"), least_turn("C_s")
    (120.0, 120.0, inf)
    """
    family, _, rest = symmetry.partition("_")
    order = {"T": 3, "O": 4, "I": 5}.get(family, 1)
    digits = "".join(c for c in rest if c.isdigit())
    if digits:
        # The axis of S_2n turns a body onto itself only n times: the other half are mirrored.
        order = int(digits) // (2 if family == "S" else 1)
    return 360 / order if order > 1 else np.inf


def least_turns(report: Report) -> list[float]:
    """Return the least turns, degrees, that bring the bodies of a report onto themselves."""
    turns = set()
    for result in report.clusters:
        group = "" if result.quality is None else result.quality.symmetry
        # In the plane only the axis across it counts, and then its mirror gives the group an h.
        if result.motion.template.shape[1] == 3 or group.endswith("h"):
            turns.add(least_turn(group))
    return sorted(t for t in turns if np.isfinite(t))


def _mark_symmetry(report: Report, top: float, *, ax: Axes) -> None:
    """Draw the least turns of the bodies' symmetries that lie below `top`, degrees."""
    for turn in least_turns(report):
        if turn < top:
            said = f"turn onto itself, {number_text(turn)}°"
            ax.axvline(turn, color=INK, lw=1.2, ls=":", label=said)


def _unread(imaging: Imaging) -> Bools:
    return np.asarray(imaging.frames["fault"].fillna("") != "")


def _health(imaging: Imaging, series: Series) -> Floats:
    """Return one number a frame; NaN where it could not be read."""
    if series == "brightness":
        median = imaging.features.groupby("frame")["mass"].median()
        value = np.asarray(median.reindex(imaging.frames["frame"]), dtype=np.float64)
        known = value[np.isfinite(value)]
        value = 100 * value / (known[0] if known.size else 1.0)
    else:
        value = imaging.frames[series].to_numpy(dtype=np.float64)
        value = 100 * value if series == "saturated" else value
    return np.where(_unread(imaging), np.nan, value)


def _widen(ax: Axes, value: Floats, *, least: float) -> None:
    """Leave room around a series, even a constant one."""
    known = value[np.isfinite(value)]
    if not known.size:
        return
    low, high = float(known.min()), float(known.max())
    room = max(0.15 * (high - low), 0.02 * abs(high), least) or 0.1
    ax.set_ylim(low - room, high + room)


def _single_figure() -> Figure:
    figure = new_figure(10, 4.2)
    figure.add_subplot()
    return figure


def _found_figure(imaging: Imaging) -> Figure:
    """Draw the middle view: xy with xz below and yz beside it, one scale for all."""
    view = imaging.views[len(imaging.views) // 2]
    rows, columns = view.xy.shape
    depth, high, wide = np.array([view.xz.shape[0], rows, columns]) * imaging.voxel
    planar = not np.isfinite(depth)
    depth = 0.0 if planar else depth
    figure = new_figure(10, float(np.clip(9 * (high + depth) / (wide + depth) + 0.7, 3, 14)))
    figure.set_layout_engine("compressed")
    title = f"{_frame_text(imaging, view.frame)}: {len(_spheres(imaging, view.frame))} spheres"
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
    room = 3 if depth > 0.2 * wide else 1
    right.xaxis.set_major_locator(MaxNLocator(room))
    below.yaxis.set_major_locator(MaxNLocator(room))
    return figure


def _tracks_figure(report: Report) -> Figure:
    """Draw up to 8 views all over the movie, four in a row."""
    views = imaging_of(report).views
    which = np.unique(np.linspace(0, len(views) - 1, min(len(views), _PANELS)).round().astype(int))
    count = len(which)
    across = min(count, _ACROSS_PAGE)
    lines = -(-count // across)
    _, y, x = imaging_of(report).voxel
    rows, columns = views[0].xy.shape
    shape = rows * y / (columns * x)
    figure = new_figure(10, float(np.clip(lines * (9.4 / across * shape + 0.35) + 0.4, 2.5, 14)))
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


def _residual_figure(report: Report) -> Figure:
    """Draw misfit of the images over residuals of the rigid bodies, or these alone."""
    imaging = imaging_of(report)
    if "chi2" not in imaging.features:
        figure = _single_figure()
        plot_rigidity(report, ax=figure.axes[0])
        return figure
    figure = new_figure(10, 5.6)
    top, bottom = figure.subplots(2, 1, sharex=True)
    plot_misfit(imaging, ax=top)
    plot_rigidity(report, ax=bottom)
    top.set_xlabel("")
    return figure


def _health_figure(imaging: Imaging) -> Figure:
    """Draw all series one over the other, one time axis."""
    figure = new_figure(10, 7)
    panels = figure.subplots(len(_SERIES), 1, sharex=True)
    for ax, series in zip(panels, _SERIES, strict=True):
        plot_health(imaging, ax=ax, series=series)
        if ax is not panels[-1]:
            ax.set_xlabel("")
    figure.align_ylabels()
    return figure
