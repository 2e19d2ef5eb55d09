"""Figures of results: each function draws one result on given axes and returns the axes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from perrin._text import number_text, shortened, unit_text
from perrin.curves.displacement import axes_weighted_equally
from perrin.diffusion.estimate import value_text
from perrin.geometry.rigid import degrees_of_freedom
from perrin.plot.figure_style import (
    GREY,
    ink,
    legend_above,
    line_width,
    log_ticks,
    marker_size,
    series_color,
    write_reason,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes as Axes
    from matplotlib.figure import Figure as Figure
    from numpy.typing import ArrayLike

    from perrin._arrays import Ints
    from perrin.curves.displacement import LagCurve
    from perrin.curves.distributions import VanHove
    from perrin.diffusion.estimate import DiffusionEstimate
    from perrin.diffusion.sampling import SamplingPlan
    from perrin.diffusion.tensor_results import DiffusionTensor
    from perrin.geometry.shapes import Cluster
    from perrin.motion.rigid_motion import RigidMotion
    from perrin.run.results import ClusterResult


# Symbols of a curve and of its coefficient.
CURVE_NAMES = {"rotation": ("MSAD", "$D_R$"), "translation": ("MSD", "$D_T$")}

# Names of methods in the legend.
_METHODS = {"mle": "ML fit", "line": "line"}

NAMED_CLUSTERS = 60  # largest number of clusters whose names a forest plot shows
_SHOWN_PARTICLES = 6  # particles whose paths are shown
_SHOWN_LAGS = 200  # largest number of lag times shown
_SHOWN_FRAMES = 5000  # largest number of frames of an orientation path shown
_VECTOR_FRAMES = 5000  # longer lines are images inside a PDF
_CLUSTER_PIXELS = 400  # width and height of a drawn cluster


def plot_lag_curve(
    curve: LagCurve,
    *,
    ax: Axes,
    estimate: DiffusionEstimate | None = None,
    floor: float | None = None,
    label: str | None = None,
    tensor: DiffusionTensor | None = None,
) -> Axes:
    """Draw an MSD or MSAD against lag time, log-log, with its fit and its noise floor.

    Parameters
    ----------
    curve : LagCurve
        rad^2 or um^2. Lags beyond a quarter of the track are faint, because they are means over
        few independent displacements. At most 200 lags are shown.
    ax : matplotlib.axes.Axes
    estimate : DiffusionEstimate, optional
        Adds the line 2 dof (D t + offset) and, as open circles, pure diffusion 2 dof D t.
    floor : float, optional
        Noise floor, in the unit of the curve: a horizontal line.
    label : str, optional
        Name of the points in the legend; default MSAD or MSD.
    tensor : DiffusionTensor, optional
        Rotational diffusion tensor, used for a curve whose directions weight the body's axes
        unequally. Line and circles are then the prediction of the tensor for those directions,
        with a band of one standard error, instead of those of `estimate`, which weights all axes
        equally. <D> is the mean of the tensor over the axes perpendicular to the directions.

    Returns
    -------
    matplotlib.axes.Axes
    """
    kept = _shown_lags(curve)
    kept = kept[curve.value[kept] > 0]
    t, value, error = curve.lagtime[kept], curve.value[kept], curve.stderr[kept]
    # Where the standard error is as large as the value, the band would reach zero.
    low, high = np.maximum(value - error, 1e-2 * value), value + error
    sure = t <= 0.25 * curve.lagtime[-1]
    rest = t >= t[sure].max(initial=0.0)
    points: dict[str, Any] = {"color": ink(), "ms": marker_size(0.65), "mew": 0}
    name = label or CURVE_NAMES[curve.quantity][0]
    ax.plot(t[sure], value[sure], ".", label=name, **points)
    if not sure.all():
        name = "beyond ¼ of the track"
        ax.plot(t[~sure], value[~sure], ".", alpha=0.3, label=name, **points)
    band: dict[str, Any] = {"color": GREY, "lw": 0}
    ax.fill_between(t[sure], low[sure], high[sure], alpha=0.35, label="± 1 standard error", **band)
    ax.fill_between(t[rest], low[rest], high[rest], alpha=0.15, **band)
    line = model_line(curve, estimate, tensor)
    if line is not None:
        slope, first, last = 2 * curve.dof, curve.lagtime[0], curve.lagtime[-1]
        t = np.geomspace(first, last, _SHOWN_LAGS)
        value = slope * (line.D * t + line.offset)
        # With motion blur the offset can be so negative that the line is negative at short lags.
        ax.plot(
            t,
            np.where(value > 0, value, np.nan),
            color=series_color(0),
            lw=line_width(0.95),
            label=line.text,
        )
        if line.stderr > 0:
            half = slope * line.stderr * t
            low = np.maximum(value - half, 1e-2 * np.abs(value))
            ax.fill_between(t, low, value + half, color=series_color(0), lw=0, alpha=0.25)
        if line.resolved:
            sparse = np.geomspace(first, last, 12)
            pure, name = slope * line.D * sparse, f"pure diffusion {slope} {line.symbol} t"
            ax.plot(
                sparse,
                pure,
                "o",
                mfc="none",
                mec=series_color(0),
                ms=marker_size(0.85),
                mew=line_width(0.6),
                label=name,
            )
    unit = unit_text(curve.unit)
    if floor is not None and floor > 0:
        name = f"noise floor {number_text(floor)} {unit}"
        ax.axhline(floor, color=series_color(1), lw=line_width(0.75), ls="--", label=name)
    ax.set(xscale="log", yscale="log", xlabel="lag time (s)")
    ax.set_ylabel(f"{CURVE_NAMES[curve.quantity][0]} ({unit})")
    _set_curve_range(ax, curve, line, floor)
    log_ticks(ax.xaxis)
    log_ticks(ax.yaxis)
    legend_above(ax, ncols=2)
    return ax


def plot_curve_ratio(
    curve: LagCurve,
    *,
    ax: Axes,
    estimate: DiffusionEstimate | None = None,
    tensor: DiffusionTensor | None = None,
) -> Axes:
    """Draw an MSD or MSAD over that of pure diffusion, 2 dof D t, against lag time.

    Parameters
    ----------
    curve : LagCurve
        Lags beyond a quarter of the track are faint; at most 200 are shown.
    ax : matplotlib.axes.Axes
    estimate, tensor : DiffusionEstimate, DiffusionTensor, optional
        They state D and the noise, as in `plot_lag_curve`.

    Returns
    -------
    matplotlib.axes.Axes
        Lag time in s, logarithmic. The band is one standard error of the curve; the line is that
        of the fit with its noise, 1 + offset/(D t). Without a resolved D there is no ratio.
    """
    line = model_line(curve, estimate, tensor)
    if line is None or not line.resolved:
        return write_reason(ax, "no ratio: the diffusion coefficient is not resolved")
    pure = 2 * curve.dof * line.D * curve.lagtime
    kept = _shown_lags(curve)
    t, value = curve.lagtime[kept], (curve.value / pure)[kept]
    error = (curve.stderr / pure)[kept]
    sure = t <= 0.25 * curve.lagtime[-1]
    points: dict[str, Any] = {"color": ink(), "ms": marker_size(0.65), "mew": 0}
    name = CURVE_NAMES[curve.quantity][0]
    ax.plot(t[sure], value[sure], ".", label=name, **points)
    ax.plot(t[~sure], value[~sure], ".", alpha=0.3, label="beyond ¼ of the track", **points)
    label = "± 1 standard error"
    ax.fill_between(t, value - error, value + error, color=GREY, alpha=0.25, lw=0, label=label)
    x = np.geomspace(curve.lagtime[0], curve.lagtime[-1], _SHOWN_LAGS)
    fit = 1 + line.offset / (line.D * x)
    ax.plot(x, fit, color=series_color(0), lw=line_width(0.95), label=line.text)
    ax.axhline(1, color=series_color(0), lw=line_width(0.55), ls=":", label="pure diffusion")
    shown = np.concatenate([value[sure], fit, [0.0, 1.0]])
    ax.set(xscale="log", xlabel="lag time (s)", ylim=(1.1 * shown.min(), 1.25 * shown.max()))
    ax.set_ylabel(f"{name} / ({2 * curve.dof} {line.symbol} t)")
    log_ticks(ax.xaxis)
    legend_above(ax, ncols=2)
    return ax


def plot_van_hove(result: VanHove, *, ax: Axes) -> Axes:
    """Draw a distribution of rotations or displacements, the Gaussian and the Brownian law.

    Parameters
    ----------
    result : VanHove
    ax : matplotlib.axes.Axes

    Returns
    -------
    matplotlib.axes.Axes
        Logarithmic; empty bins are left out. The legend has alpha_2, corrected for noise, and its
        standard error for Brownian motion. The law of the angle on SO(3) is drawn where it is not
        the Gaussian.
    """
    middle = (result.edges[1:] + result.edges[:-1]) / 2
    full = result.density > 0
    label = f"{result.n_pairs} pairs, α₂ = {number_text(result.alpha2, result.alpha2_stderr)}"
    ax.errorbar(
        middle[full],
        result.density[full],
        result.stderr[full],
        fmt="o",
        color=series_color(0),
        ms=marker_size(0.6),
        elinewidth=line_width(0.55),
        label=label,
    )
    ax.plot(
        middle,
        result.gaussian,
        "-",
        color=series_color(1),
        lw=line_width(0.8),
        label="Gaussian of the same width",
    )
    if result.quantity == "angle":
        ax.plot(
            middle, result.brownian, "--", color="k", lw=line_width(0.8), label="Brownian rotation"
        )
    names = {"translation": "displacement", "angle": "rotation angle"}
    name = names.get(result.quantity, "rotation")
    unit = unit_text(result.unit)
    ax.set_yscale("log", nonpositive="clip")
    ax.set_ylim(0.3 * float(result.density[full].min()), 2 * float(result.density.max()))
    ax.set(
        xlabel=f"{name} in {result.lagtime:.3g} s ({unit})",
        ylabel=f"probability density (1/{unit})",
    )
    legend_above(ax, ncols=2)
    return ax


def plot_residual(motion: RigidMotion, *, ax: Axes) -> Axes:
    """Draw the rms distance of the particles to the fitted body against time.

    Parameters
    ----------
    motion : RigidMotion
        Crosses at the bottom mark frames without a pose. The line is the residual that sigma
        predicts for a frame with its number of particles.
    ax : matplotlib.axes.Axes

    Returns
    -------
    matplotlib.axes.Axes
        Time in s, residual in nm (um where it is large).
    """
    rows = motion.fitted
    middle = float(np.median(motion.residual[rows]))
    scale, unit = (1e3, "nm") if middle < 1 else (1.0, "µm")
    raster = len(motion.time) > _VECTOR_FRAMES
    drawn = ax.plot(
        motion.time,
        scale * motion.residual,
        "-",
        color=series_color(0),
        lw=line_width(0.45),
        marker=".",
    )
    drawn[0].set(ms=marker_size(0.35), rasterized=raster, label="rms residual of the frame")
    # A pose has as many free coordinates as a rigid body, so n rms^2 = sigma^2 (d n - 6) in space.
    n_present, expected = motion.n_present[rows], np.full(len(motion.time), np.nan)
    free = degrees_of_freedom(n_present, motion.dimension)
    expected[rows] = motion.sigma * np.sqrt(free / n_present)
    label = f"expected from σ = {number_text(scale * motion.sigma)} {unit}"
    style: dict[str, Any] = {
        "color": series_color(1),
        "lw": line_width(0.8),
        "drawstyle": "steps-mid",
    }
    ax.plot(motion.time, scale * expected, label=label, rasterized=raster, **style)
    absent = _without_pose(motion)
    if absent.size:
        label = f"no pose ({absent.size} of {len(motion.time)} frames)"
        bottom = ax.get_xaxis_transform()
        ax.plot(
            motion.time[absent],
            np.zeros(absent.size),
            **_no_pose_style(),
            transform=bottom,
            label=label,
        )
    ax.set(xlabel="time (s)", ylabel=f"residual ({unit})")
    top = scale * float(np.max(motion.residual[rows]))
    ax.set_ylim(0, 1.08 * top if top > 0 else 1.0)
    legend_above(ax, ncols=3)
    return ax


def plot_presence(motion: RigidMotion, *, ax: Axes) -> Axes:
    """Draw the number of detected particles against time; crosses mark frames without a pose.

    Parameters
    ----------
    motion : RigidMotion
    ax : matplotlib.axes.Axes

    Returns
    -------
    matplotlib.axes.Axes
        Time in s.
    """
    n = len(motion.template)
    drawn = ax.plot(
        motion.time,
        motion.n_present,
        drawstyle="steps-mid",
        color=series_color(0),
        lw=line_width(0.65),
    )
    drawn[0].set_rasterized(len(motion.time) > _VECTOR_FRAMES)
    absent = _without_pose(motion)
    if absent.size:
        ax.plot(motion.time[absent], motion.n_present[absent], **_no_pose_style())
    ax.set(xlabel="time (s)", ylabel=f"present (of {n})", ylim=(-0.3, n + 0.5))
    ax.set_yticks(np.arange(0, n + 1, max(1, n // 4)))
    return ax


def plot_orientations(motion: RigidMotion, *, ax: Axes) -> Axes:
    """Draw the paths of the particles' directions on the unit sphere, or the angle in the plane.

    Parameters
    ----------
    motion : RigidMotion
        At most 6 particles and 5000 frames are shown.
    ax : matplotlib.axes.Axes
        Axes with ``projection="3d"`` for a motion in space, ordinary axes for one in the plane.

    Returns
    -------
    matplotlib.axes.Axes
        Lab axes without unit; in the plane rad against s.
    """
    if motion.dimension == 2:
        return plot_angle(motion, ax=ax)
    space: Any = ax  # matplotlib has no types for 3-D axes
    # A grid on the unit sphere with lab axes, in parallel projection, without a box.
    # Lines are separated by NaN and drawn as one, which is faster.
    polar, around = np.linspace(0, np.pi, 37), np.linspace(0, 2 * np.pi, 73)
    parallels = np.broadcast_arrays(polar[6:-1:6, None], np.append(around, np.nan))
    meridians = np.broadcast_arrays(np.append(polar, np.nan), around[:-1:6, None])
    p, a = (np.append(*angles) for angles in zip(parallels, meridians, strict=True))
    grid = {"color": "#cccccc", "lw": line_width(0.25), "zorder": 0}
    space.plot(np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p), **grid)
    for axis, name in zip(np.eye(3), "xyz", strict=True):
        space.plot(*np.outer(axis, [1.0, 1.2]), color=GREY, lw=line_width(0.6))
        space.text(*(1.3 * axis), name, color=ink(), ha="center", va="center")
    space.set(xlim=(-1, 1), ylim=(-1, 1), zlim=(-1, 1), xlabel="x", ylabel="y", zlabel="z")
    space.set_proj_type("ortho")
    space.set_box_aspect((1, 1, 1), zoom=1.4)
    space.set_axis_off()
    up, turn = np.deg2rad([space.elev, space.azim])
    viewer = np.array([np.cos(up) * np.cos(turn), np.cos(up) * np.sin(turn), np.sin(up)])
    length = np.linalg.norm(motion.template, axis=1)
    which = np.flatnonzero(length > 1e-6 * length.max())[:_SHOWN_PARTICLES]
    colors = [series_color(k) for k in range(which.size)]
    shown = np.arange(0, len(motion.time), -(-len(motion.time) // _SHOWN_FRAMES))
    shown = np.union1d(shown, motion.fitted[-1:])
    paths = motion.orientation(motion.template[which])
    for color, i, path in zip(colors, which, np.swapaxes(paths, 0, 1), strict=False):
        path = path[shown]
        # A path is faint on the far side of the sphere and strong on the side of the viewer.
        near = path @ viewer > 0
        front = np.where(near[:, None], path, np.nan)
        space.plot(*path.T, color=color, lw=line_width(0.35), alpha=0.35)
        space.plot(*front.T, color=color, lw=line_width(0.65), label=f"particle {i}")
        last = np.flatnonzero(np.isfinite(path[:, 0]))[-1]
        end: dict[str, Any] = {"mec": color, "alpha": 1.0 if near[last] else 0.5}
        space.plot(
            *path[[last]].T, "o", ms=marker_size(1.35), mfc="white", mew=line_width(1), **end
        )
    space.plot([], [], "o", ms=marker_size(1), mfc="white", mec=ink(), label="last frame")
    space.legend(loc="upper left", frameon=False, fontsize="small", handlelength=1.2)
    parts = [f"particles 0 to {which[-1]} of {len(length)}"] if len(which) < len(length) else []
    parts += [f"{len(shown)} of {len(motion.time)} frames"] if len(shown) < len(motion.time) else []
    space.text2D(0.98, 0.04, ", ".join(parts), transform=ax.transAxes, ha="right", size="small")
    return ax


def plot_angle(motion: RigidMotion, *, ax: Axes) -> Axes:
    """Draw the unbounded angle of a motion in the plane against time.

    Parameters
    ----------
    motion : RigidMotion
        Motion in the plane.
    ax : matplotlib.axes.Axes

    Returns
    -------
    matplotlib.axes.Axes
        rad against s; a circle marks the last frame with a pose.
    """
    angle = motion.rotational_displacement([1.0, 0.0])[:, 0]
    ax.plot(
        motion.time,
        angle,
        color=series_color(0),
        lw=line_width(0.6),
        rasterized=len(angle) > _VECTOR_FRAMES,
    )
    last = motion.fitted[-1]
    ax.plot(
        motion.time[last],
        angle[last],
        "o",
        ms=marker_size(1.15),
        mfc="white",
        mec=series_color(0),
        mew=line_width(0.95),
    )
    ax.axhline(0, color=GREY, lw=line_width(0.4))
    ax.set(xlabel="time (s)", ylabel="angle φ (rad)")
    return ax


def plot_forest(
    clusters: Sequence[ClusterResult],
    *,
    ax: Axes,
    quantity: Literal["rotation", "translation"] = "rotation",
    pooled: DiffusionEstimate | None = None,
) -> Axes:
    """Draw the diffusion coefficient of every cluster with its intervals, and the pooled one.

    Parameters
    ----------
    clusters : sequence of ClusterResult
        One row each, the first at the top. More than 60 are ordered by value, without names.
    ax : matplotlib.axes.Axes
    quantity : {"rotation", "translation"}
        D_R in rad^2/s or D_T in um^2/s.
    pooled : DiffusionEstimate, optional
        Drawn as a line with its 68 % and 95 % intervals as bands.

    Returns
    -------
    matplotlib.axes.Axes
        Intervals of 68 % are thick, those of 95 % thin. A triangle is the 95 % upper limit of a
        coefficient that is not resolved; an arrowhead at the edge marks the end of an interval
        outside the axes.
    """
    both = [(c.D_R if quantity == "rotation" else c.D_T, c) for c in clusters]
    estimates = [e for e, _ in both if e.absent_because is None]
    clusters = [c for e, c in both if e.absent_because is None]
    if not estimates:
        return write_reason(ax, f"no {CURVE_NAMES[quantity][1]}: {both[0][0].absent_because}")
    many = len(clusters) > NAMED_CLUSTERS
    rows = np.argsort([e.value for e in estimates]) if many else np.arange(len(estimates))
    ordered = [estimates[i] for i in rows]
    logarithmic, left, right = _forest_range([*ordered, *([pooled] if pooled else [])])
    ax.set_xscale("log" if logarithmic else "linear")
    ax.set_xlim(left, right)
    _draw_intervals(ordered, ax=ax, left=left, right=right, thin=many)
    if pooled is not None:
        for ends, alpha in ((pooled.ci95, 0.15), (pooled.ci68, 0.3)):
            low, high = np.clip(ends, left, right)
            ax.axvspan(low, high, color=series_color(1), alpha=alpha, lw=0, zorder=0)
        ax.axvline(
            pooled.value,
            color=series_color(1),
            lw=line_width(0.65),
            zorder=1,
            label=f"pooled, {value_text(pooled)}",
        )
        ax.legend(loc="lower center", bbox_to_anchor=(0.5, 1), frameon=False, fontsize="small")
    ax.set(xlabel=f"{CURVE_NAMES[quantity][1]} ({unit_text(estimates[0].unit)})")
    ax.xaxis.set_major_locator(MaxNLocator(4))  # small values have long labels
    ax.set_ylim(len(rows) - 0.4, -0.6)
    if many:
        ax.set(ylabel="clusters, ordered by value")
        return ax
    names = [shortened(clusters[i].name) for i in rows]
    # Names are text of the user: a dollar sign does not begin a formula.
    ax.set_yticks(np.arange(len(rows)), names, parse_math=False)
    ax.set(ylabel="cluster")
    return ax


def plot_plan(plan: SamplingPlan, *, ax: Axes) -> Axes:
    """Draw the expected error of D_R against the time between frames, log-log.

    Parameters
    ----------
    plan : SamplingPlan
    ax : matplotlib.axes.Axes

    Returns
    -------
    matplotlib.axes.Axes
        s, and standard error over D_R in percent. The band is the recommended window; lines are
        dashed where particles can no longer be distinguished; dotted lines are the two limits of
        Hunter et al. 2011.
    """
    if plan.dt_min < plan.dt_max:
        label = f"window, {number_text(plan.dt_min)} to {number_text(plan.dt_max)} s"
        ax.axvspan(plan.dt_min, plan.dt_max, color=GREY, alpha=0.18, lw=0, label=label)
    # Beyond dt_rigid particles can no longer be distinguished.
    known = plan.dt <= plan.dt_rigid
    rest = plan.dt >= plan.dt[known][-1]
    for error, color, label in (
        (plan.error, series_color(0), "noise estimated along (default)"),
        (plan.error_residual, series_color(1), "noise from the residuals"),
    ):
        ax.plot(plan.dt[known], 100 * error[known], color=color, lw=line_width(1.2), label=label)
        ax.plot(plan.dt[rest], 100 * error[rest], color=color, lw=line_width(0.95), ls=(0, (3, 2)))
    best: dict[str, Any] = {
        "mfc": "white",
        "mew": line_width(1.05),
        "ms": marker_size(1.15),
        "ls": "none",
        "marker": "o",
        "zorder": 4,
    }
    label = f"best, {number_text(plan.dt_best)} s"
    ax.plot(plan.dt_best, 100 * plan.expected_error, mec=series_color(0), label=label, **best)
    ax.plot(plan.dt_best, 100 * plan.expected_error_residual, mec=series_color(1), **best)
    lost: dict[str, Any] = {"color": GREY, "lw": line_width(0.95), "ls": (0, (3, 2))}
    ax.plot([], [], label="particles cannot be distinguished", **lost)
    rules = [plan.paper_dt_min, plan.paper_dt_max]
    label = "rules of Hunter 2011, {} and {} s".format(*map(number_text, rules))
    ax.vlines(
        rules,
        0,
        1,
        ink(),
        lw=line_width(0.8),
        ls=":",
        label=label,
        transform=ax.get_xaxis_transform(),
    )
    ax.set(xscale="log", yscale="log", xlabel="time between frames (s)")
    ax.set_xlim(plan.dt[0], max(plan.dt[-1], 1.5 * plan.paper_dt_max))
    ax.set_ylabel("expected error of $D_R$ (%)")
    low, high = 100 * plan.error_residual.min() / 1.3, 100 * plan.error.max() * 1.15
    ax.set_ylim(low, high)
    few = high < 12 * low
    ax.yaxis.set_major_locator(LogLocator(subs=range(1, 10) if few else (1, 2, 5), numticks=20))
    ax.yaxis.set_minor_formatter(NullFormatter())
    ax.yaxis.set_major_formatter("{x:g}")
    ax.xaxis.set_major_formatter(lambda value, _: number_text(value, digits=1))
    legend_above(ax, ncols=2)
    return ax


def plot_cluster(cluster: Cluster, *, ax: Axes, diameter: float, view: ArrayLike) -> Axes:
    """Draw a cluster as shaded spheres in parallel projection.

    Parameters
    ----------
    cluster : Cluster
        Cluster in three dimensions.
    ax : matplotlib.axes.Axes
    diameter : float
        Sphere diameter, um.
    view : array_like, shape (3, 3)
        Rotation of the body before the projection along z; x points to the right and y up.

    Returns
    -------
    matplotlib.axes.Axes
        um.
    """
    centers = cluster.positions @ np.asarray(view, dtype=np.float64).T
    half = float(np.abs(centers).max()) + 0.6 * diameter
    x = np.linspace(-half, half, _CLUSTER_PIXELS)
    shape = (_CLUSTER_PIXELS, _CLUSTER_PIXELS)
    height, color = np.full(shape, -np.inf), np.ones((*shape, 3))
    for i, center in enumerate(centers):
        across = np.stack(np.meshgrid(x - center[0], x - center[1]), axis=-1) / (diameter / 2)
        inside = np.sum(across**2, axis=-1)
        up = np.sqrt(np.maximum(1 - inside, 0.0))
        front = (inside < 1) & (center[2] + up * diameter / 2 > height)
        height[front] = (center[2] + up * diameter / 2)[front]
        # Diffuse reflection of a lamp at the upper left, and ambient light.
        brightness = 0.35 + 0.65 * np.maximum((across @ [-0.4, 0.5] + up) / np.hypot(0.64, 1), 0)
        own = np.array([int(series_color(i)[k : k + 2], 16) / 255 for k in (1, 3, 5)])
        color[front] = (brightness[..., None] * own)[front]
    ax.imshow(color, origin="lower", extent=(-half, half, -half, half), interpolation="bilinear")
    ax.set(xlabel="x (µm)", ylabel="y (µm)")
    return ax


class ModelLine(NamedTuple):
    """Straight line of a curve against lag time, 2 dof (D t + offset).

    Attributes
    ----------
    D : float
        Diffusion coefficient of the line, rad^2/s or um^2/s.
    offset : float
        Noise variance of one coordinate, rad^2 or um^2.
    stderr : float
        Standard error of D that is shown as a band; 0 for no band.
    resolved : bool
        Whether D differs from zero.
    symbol : str
        Symbol of the coefficient in the legend.
    text : str
        Legend of the line.
    """

    D: float
    offset: float
    stderr: float
    resolved: bool
    symbol: str
    text: str


def model_line(
    curve: LagCurve, estimate: DiffusionEstimate | None, tensor: DiffusionTensor | None
) -> ModelLine | None:
    """Return the line of a curve: that of the tensor where its directions weight axes unequally.

    Parameters
    ----------
    curve : LagCurve
    estimate : DiffusionEstimate or None
    tensor : DiffusionTensor or None

    Returns
    -------
    ModelLine or None
        D is tr(D W)/dof with the weights W of the curve, or the estimate's value; None without an
        estimate and a tensor that applies.
    """
    resolved = estimate is None or estimate.resolved
    uneven = curve.weights is not None and not axes_weighted_equally(curve.weights)
    if tensor is not None and curve.weights is not None and uneven and resolved:
        D, stderr = tensor.weighted(curve.weights)
        offset = float(np.einsum("ij,ij->", curve.weights, tensor.offset)) / curve.dof
        symbol = r"$\langle D\rangle$"
        text = f"tensor {symbol} = {number_text(D, stderr)} {unit_text(tensor.unit)}"
        return ModelLine(D, offset, stderr, True, symbol, text)
    if estimate is None:
        return None
    symbol = CURVE_NAMES[curve.quantity][1]
    method = _METHODS.get(estimate.method.partition(",")[0], estimate.method)
    text = f"{method} {symbol} {'= ' if estimate.resolved else ''}{value_text(estimate)}"
    return ModelLine(estimate.value, estimate.offset, 0.0, estimate.resolved, symbol, text)


def curve_floors(result: ClusterResult) -> tuple[float, float]:
    """Return the noise floors that the localisation error predicts for MSAD and MSD.

    Parameters
    ----------
    result : ClusterResult

    Returns
    -------
    tuple of float
        rad^2 and um^2.
    """
    weights, turn = result.msad.weights, result.noise.phi2
    if weights is not None:
        # Both ends of a rotation have the error of the orientation, perpendicular to a direction.
        turn = 2 * float(np.einsum("ij,ij->", weights, result.noise.covariance))
    motion = result.motion
    # Both ends of a displacement have the error of the centre, along each axis.
    return turn, 2 * motion.dimension * float(np.mean(motion.center_variance[motion.fitted]))


def _shown_lags(curve: LagCurve) -> Ints:
    """Return at most 200 rows of a curve, even on the logarithm of the lag time."""
    kept = np.arange(len(curve.lagtime))
    if len(kept) <= _SHOWN_LAGS:
        return kept
    even = np.geomspace(curve.lagtime[0], curve.lagtime[-1], _SHOWN_LAGS)
    return np.unique(np.rint(np.interp(even, curve.lagtime, kept)).astype(np.int64))


def _no_pose_style() -> dict[str, Any]:
    """Return the style of the crosses that mark frames without a pose."""
    size = {"ms": marker_size(0.65), "mew": line_width(0.55)}
    return {"marker": "x", "ls": "none", "color": ink(), "clip_on": False, "zorder": 4} | size


def _set_curve_range(
    ax: Axes, curve: LagCurve, line: ModelLine | None, floor: float | None
) -> None:
    """Set the range from points, line and floor, without the band, which can be much wider."""
    shown = curve.value[curve.value > 0]
    if shown.size == 0:
        return
    low = high = shown
    if line is not None:
        ends = np.array([curve.lagtime[0], curve.lagtime[-1]])
        ends = 2 * curve.dof * (line.D * ends + line.offset)
        low = high = np.append(shown, ends[ends > 0])
    if floor is not None and floor > 0:
        low = np.append(low, floor)
    # A floor far below the curve is left out of the range.
    bottom, top = max(low.min(), 1e-4 * shown.min()), high.max()
    margin = max(top / bottom, 10) ** 0.06
    ax.set_ylim(bottom / margin, top * margin)


def _without_pose(motion: RigidMotion) -> Ints:
    """Return the indices of the frames without a pose."""
    return np.setdiff1d(np.arange(len(motion.time)), motion.fitted)


def _forest_range(estimates: Sequence[DiffusionEstimate]) -> tuple[bool, float, float]:
    """Return whether the axis is logarithmic, and its two ends."""
    ends = np.array([(e.value, *e.ci95) for e in estimates])
    ends = ends[np.isfinite(ends)]
    positive = ends[ends > 0]
    if positive.size == 0:
        return False, -1.0, 1.0
    values = np.array([e.value for e in estimates if e.resolved and e.value > 0])
    if values.size and values.max() > 20 * values.min():
        # The axis does not extend to the ends of intervals that almost reach zero.
        return True, max(positive.min(), 0.03 * values.min()) / 1.5, positive.max() * 1.5
    high = positive.max()
    if values.size:
        high = min(high, 5 * values.max())
    low = min(ends.min(), high)
    margin = 0.05 * (high - low) or 0.5 * high
    return False, low - margin, high + margin


def _draw_intervals(
    estimates: Sequence[DiffusionEstimate], *, ax: Axes, left: float, right: float, thin: bool
) -> None:
    """Draw values, intervals and limits, and arrowheads where an interval leaves the axes."""
    rows = np.arange(len(estimates))
    value = np.array([e.value for e in estimates])
    resolved = np.array([e.resolved for e in estimates], dtype=np.bool_)
    ci68, ci95 = (np.array([getattr(e, c) for e in estimates]) for c in ("ci68", "ci95"))
    for ends, width, color in (
        (ci95, 0.55, GREY if thin else series_color(0)),
        (ci68, 2.3, series_color(0)),
    ):
        low, high = np.clip(ends, left, right).T
        seen = (low < right) & (high > left)
        ax.hlines(rows[seen], low[seen], high[seen], color=color, lw=line_width(width / (1 + thin)))
    dots: dict[str, Any] = (
        {"ms": marker_size(0.35), "color": "white"}
        if thin
        else {"ms": marker_size(0.85), "color": ink()}
    )
    ax.plot(value[resolved], rows[resolved], "o", mew=0, **dots)
    limits = np.minimum(ci95[:, 1], right)
    beyond, below = (ci95[:, 1] > right) & resolved, (ci95[:, 0] < left) & resolved
    edge: dict[str, Any] = {
        "ls": "none",
        "clip_on": False,
        "mec": series_color(0),
        "mfc": series_color(0),
        "ms": marker_size(0.65),
    }
    limit = edge | {"mec": ink(), "mfc": "white", "ms": marker_size(0.5 if thin else 1.15)}
    for which, x, marker, style in (
        (~resolved, limits, "<", limit),
        (beyond, np.full(len(rows), right), ">", edge),
        (below, np.full(len(rows), left), "<", edge),
    ):
        # The layout counts an empty unclipped line as a point in the corner of the figure.
        if which.any():
            ax.plot(x[which], rows[which], marker=marker, **style)
