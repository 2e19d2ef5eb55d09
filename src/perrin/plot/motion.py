"""Figure of the verdict on a motion: its steps against those of diffusion with constant noise."""

from __future__ import annotations

import re
import textwrap
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from perrin._arrays import refuse
from perrin._text import number_text, unit_text
from perrin.diffusion.anomalous import AnomalousEstimate
from perrin.diffusion.confined import ConfinedEstimate
from perrin.diffusion.estimate import UNITS
from perrin.diffusion.goodness_of_fit import axis_model, sine_powers
from perrin.diffusion.noise_model import Noise
from perrin.diffusion.step_spectra import (
    confined_autocovariance,
    fractional_autocovariance,
    sine_spectrum,
)
from perrin.diffusion.switching import SwitchingEstimate
from perrin.diffusion.verdict import judge_motion
from perrin.plot.figure_style import (
    GREY,
    column_figure,
    ink,
    legend_above,
    line_width,
    log_ticks,
    marker_size,
    series_color,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes as Axes
    from matplotlib.figure import Figure as Figure

    from perrin._arrays import Floats, Ints
    from perrin.diffusion.goodness_of_fit import AxisFit, AxisModel
    from perrin.diffusion.steps import Quantity
    from perrin.diffusion.verdict import MotionVerdict
    from perrin.motion.rigid_motion import RigidMotion


# Title, what is shown and what to check, as of the other figures of a report.
MOTION_CAPTION = (
    "Is it diffusion?",
    "The steps against those of diffusion with constant noise (blue), with the bands that contain "
    "68 % and 95 % of such data. Top left: power of the steps by frequency over twice the time "
    "between frames, averaged over bins; the level at low frequency is the diffusion coefficient, "
    "the rise at high frequency is noise; dashed: the motion that was found instead. Top right: "
    "distribution of the errors of predicting each step from those before it, over their standard "
    "deviation. Bottom: squares of these errors against time, of mean 1.",
    "About two points in three should lie in the dark band and 19 of 20 in the light one. Too "
    "little power at low frequency is confinement or subdiffusion, too much is drift, spin or "
    "superdiffusion; a single high point is a vibration. Means of the squares that leave the band "
    "for a while are a changing diffusion coefficient or changing noise; single high squares, and "
    "tails above the curve, are jumps.",
)

_BINS_A_DECADE = 8  # bins of the spectrum in one decade of frequency
_MOST_MEANS, _FEWEST_AVERAGED = 30, 5  # means of squared errors along a track; steps in one
_SHOWN_STEPS = 5000  # largest number of single squared errors shown, without the largest ones
# Squared errors under this, or under this quantile of Brownian motion, are drawn at the bottom.
_SMALLEST_SQUARE, _SMALLEST_QUANTILE = 0.01, 0.01
_MOST_VECTOR_POINTS = 1000  # more points are an image inside a PDF
_NUMBERED_JUMPS = 5  # jumps whose row is written
_WIDEST_ERROR = 8.0  # errors beyond this are counted in the legend
_TITLE_LETTERS = 120  # letters in one line of the title

# Shares of Brownian data inside the dark and the light band, and the opacity of both.
_BANDS = ((0.95, 0.14), (0.68, 0.22))


def alternative_spectrum(
    model: AxisModel, fit: AxisFit, verdict: MotionVerdict
) -> tuple[Floats, str] | None:
    """Return the sine spectrum of the motion that a verdict found, and its name.

    Parameters
    ----------
    model : AxisModel
    fit : AxisFit
        Steps and their fit.
    verdict : MotionVerdict

    Returns
    -------
    tuple of ndarray, shape (N,), and str, or None
        Variance of each sine mode of the steps, mean over the axes, rad^2 or um^2; of a steady
        motion its power with the variance of what is left. None where the motion has no spectrum
        of its own.

    Examples
    --------
    >>> from perrin import Cluster, Noise, Spin, judge_motion, simulate_motion
    >>> turning = simulate_motion(
    ...     Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, dynamics=Spin(0.1), rng=3
    ... )
    >>> model, y = axis_model(turning, "rotation", Noise())
    >>> alternative_spectrum(model, model.fit(y), judge_motion(turning))[1]
    'with a steady spin'
    """
    found, tau, n = verdict.model, model.mean_tau, model.n_steps
    if isinstance(found, AnomalousEstimate | ConfinedEstimate):
        exposure = min(1.0, (found.exposure or 0.0) * found.dt / tau)
        noise = 2 * found.offset * model.differences
        if isinstance(found, AnomalousEstimate):
            shape = fractional_autocovariance(found.alpha, n, exposure=exposure)
            name = f"fractional, α = {number_text(found.alpha, found.stderr)}"
            return found.D_alpha * tau**found.alpha * sine_spectrum(shape) + noise, name
        shape = confined_autocovariance(tau / found.relaxation_time, n, exposure=exposure)
        unit = unit_text(found.unit.partition("^")[0])
        name = f"cage, {number_text(found.cage, digits=2)} {unit}"
        power = found.D_short * tau * sine_spectrum(shape) + noise
        if found.frame == "mean":
            # The vectors v from the mean orientation are confined; body steps have in addition
            # v x v'/2, the solid angles of the path, which are independent of each other.
            left = np.exp(-2 * tau / found.relaxation_time)
            power = power + 0.5 * found.cage**4 * (1 - left)
        return power, name
    if verdict.kind in ("spin", "drift"):
        steady = np.einsum("nap,bp->ban", model.steady, model.steady_motion(fit)[0])
        rest = model.fit(fit.y - steady, near=fit)
        power = model.eigenvalues(rest.D, rest.offset) + sine_powers(steady)
        return power[0].mean(axis=0), f"with a steady {verdict.kind}"
    return None


def plot_step_spectrum(
    model: AxisModel,
    fit: AxisFit,
    *,
    ax: Axes,
    quantity: Quantity = "rotation",
    verdict: MotionVerdict | None = None,
) -> Axes:
    """Draw the power of the steps by frequency, and that of diffusion with constant noise.

    Parameters
    ----------
    model : AxisModel
    fit : AxisFit
        Steps and their fit.
    ax : matplotlib.axes.Axes
    quantity : {"rotation", "translation"}
    verdict : MotionVerdict, optional
        Adds the spectrum of the motion that was found, dashed, and marks the line of a vibration.

    Returns
    -------
    matplotlib.axes.Axes
        Hz, and rad^2/s or um^2/s. The power of a sine mode over twice the duration of a step is
        D where there is no noise. A point is the mean over the modes of a bin and over the axes,
        each over its fitted variance, times the mean fitted variance. For uneven steps the modes
        are those of the prediction errors. The bands contain 68 % and 95 % of such means.
    """
    from scipy.special import gammaincinv

    n, axes = model.n_steps, fit.D.shape[1]
    scale = 2 * model.mean_tau
    frequency = np.arange(1, n + 1) / ((n + 1) * scale)
    law = model.eigenvalues(fit.D, fit.offset)
    if model.even:
        ratio = np.mean(sine_powers(fit.y) / law, axis=1)[0]
    else:
        ratio = np.mean(sine_powers(model.prediction_errors(fit)), axis=1)[0]
    law = law[0].mean(axis=0) / scale
    # First mode of each bin, from 0, and n; the bins are equal in log frequency.
    count = 1 + int(np.ceil(_BINS_A_DECADE * np.log10(n + 1)))
    edges = np.unique(np.rint(np.geomspace(1, n + 1, count + 1)).astype(np.int64)) - 1
    middle = np.exp(_bin_means(np.log(frequency), edges))
    expected = np.exp(np.interp(np.log(middle), np.log(frequency), np.log(law)))
    average = _bin_means(ratio, edges) * expected

    # Each band has one step a bin, along the law between the ends of the bin.
    first, last = edges[:-1], edges[1:]
    ends = np.stack([frequency[0] * (first + 0.5), frequency[0] * (last + 0.5)], axis=1)
    at_ends = np.exp(np.interp(np.log(ends), np.log(frequency), np.log(law)))
    shape = 0.5 * axes * (last - first)
    for share, opacity in _BANDS:
        low, high = (
            (gammaincinv(shape, p) / shape)[:, None] * at_ends
            for p in (0.5 - share / 2, 0.5 + share / 2)
        )
        ax.fill_between(
            ends.ravel(),
            low.ravel(),
            high.ravel(),
            color=series_color(0),
            alpha=opacity,
            lw=0,
            label="68 % and 95 % of means" if share == 0.68 else None,
        )
    ax.plot(frequency, law, color=series_color(0), lw=line_width(0.95), label="diffusion and noise")
    found = None if verdict is None else alternative_spectrum(model, fit, verdict)
    ax.plot(
        middle,
        average,
        "o",
        color=ink(),
        ms=marker_size(0.6),
        mew=0,
        label="steps, bin means",
        zorder=4,
    )
    # The range contains the dark band, which is the last one drawn.
    shown = np.concatenate([average, low.ravel(), high.ravel()])
    if found is not None:
        # The odd modes alone have the power of a constant velocity: bins are averaged.
        power = _bin_means(found[0], edges) / scale
        ax.plot(
            middle,
            power,
            color=series_color(1),
            lw=line_width(1.05),
            ls=(0, (4, 2)),
            label=found[1],
        )
        shown = np.append(shown, power)
    if verdict is not None and verdict.kind == "vibration":
        k = int(np.argmax(np.sum(model.mode_ratios(fit), axis=1)[0]))
        height = ratio[k] * law[k]
        shown = np.append(shown, height)
        label = f"period {number_text(1 / float(frequency[k]))} s"
        ax.plot(
            frequency[k],
            height,
            "D",
            mfc="none",
            mec=series_color(1),
            ms=marker_size(1.15),
            mew=line_width(1.05),
            label=label,
        )
    bottom, top = shown[shown > 0].min(), shown.max()
    margin = max(top / bottom, 10.0) ** 0.05
    ax.set(
        xscale="log", yscale="log", xlabel="frequency (Hz)", ylim=(bottom / margin, top * margin)
    )
    ax.set_xlim(ends[0, 0], ends[-1, 1])
    log_ticks(ax.xaxis)
    log_ticks(ax.yaxis)
    ax.set_ylabel(f"power of the steps / 2Δt ({unit_text(UNITS[quantity])})")
    legend_above(ax, ncols=2)
    return ax


def plot_prediction_errors(
    motion: RigidMotion,
    model: AxisModel,
    fit: AxisFit,
    *,
    ax: Axes,
    verdict: MotionVerdict | None = None,
) -> Axes:
    """Draw the squared error of predicting each step from those before it, against time.

    Parameters
    ----------
    motion : RigidMotion
    model : AxisModel
    fit : AxisFit
        Its steps and their fit.
    ax : matplotlib.axes.Axes
    verdict : MotionVerdict, optional
        Shades the time in the fast of two states, and marks jumps.

    Returns
    -------
    matplotlib.axes.Axes
        s, the time at which a step ends, and the mean over the axes of the squared errors, of mean
        1. The smallest squares, under 0.01 or under the quantile of 1 % of Brownian motion, are
        drawn at the bottom. The bands contain 68 % and 95 % of the drawn means
        over consecutive steps.
    """
    from scipy.special import chdtri, gammaincinv

    n, axes = model.n_steps, fit.D.shape[1]
    square = np.mean(model.prediction_errors(fit) ** 2, axis=1)[0]
    row = motion.steps()[1]
    time = motion.time[row]
    count = int(np.clip(n // _FEWEST_AVERAGED, 1, _MOST_MEANS))
    edges = np.rint(np.linspace(0, n, count + 1)).astype(np.int64)
    averaged = n / count
    shape = 0.5 * axes * averaged
    for share, opacity in _BANDS:
        low, high = (gammaincinv(shape, 0.5 + s * share / 2) / shape for s in (-1, 1))
        label = "68 % and 95 % of the means" if share == 0.68 else None
        ax.axhspan(low, high, color=series_color(0), alpha=opacity, lw=0, label=label)
    ax.axhline(1, color=series_color(0), lw=line_width(0.8))

    stride = -(-n // _SHOWN_STEPS)
    # Beyond this one track of Brownian motion has one square.
    large = np.flatnonzero(square > chdtri(axes, 1 / n) / axes)
    shown = np.union1d(np.arange(0, n, stride), large)
    label = "steps" if stride == 1 else f"one step in {stride}, and the largest"
    few = n < _MOST_VECTOR_POINTS
    points: dict[str, Any] = {"color": GREY, "ms": marker_size(0.45 if few else 0.35), "mew": 0}
    points |= {"rasterized": not few, "alpha": 0.9 if few else 0.5, "zorder": 2.5}
    bottom = max(_SMALLEST_SQUARE, float(chdtri(axes, 1 - _SMALLEST_QUANTILE)) / axes)
    ax.plot(time[shown], np.maximum(square[shown], bottom), "o", label=label, **points)
    ends = np.append(time[edges[:-1]], time[-1])
    label = f"mean of {averaged:.0f} steps"
    ax.stairs(
        _bin_means(square, edges),
        ends,
        baseline=None,
        color=ink(),
        lw=line_width(1.05),
        label=label,
        zorder=3,
    )

    found = None if verdict is None else verdict.model
    top = max(float(square.max()), 4.0)
    if isinstance(found, SwitchingEstimate):
        ends = np.stack([motion.time[motion.steps()[0]], time], axis=1).ravel()
        fast = np.repeat(found.states[0][row] == 1, 2)
        # Single steps of a long track are thinner than a pixel and need the outline.
        shade: dict[str, Any] = {
            "color": series_color(4),
            "alpha": 0.25,
            "lw": line_width(0.4),
            "zorder": 0,
        }
        shade |= {"transform": ax.get_xaxis_transform(), "label": "fast state"}
        ax.fill_between(ends, 0, 1, where=fast, **shade)
    if verdict is not None and verdict.frames:
        jumps = np.flatnonzero(np.isin(row, verdict.frames))
        _mark_jumps(time, square, row, jumps, ax=ax)
        top *= 3
    ax.set(yscale="log", xlabel="time (s)", ylabel="squared error\nof prediction")
    ax.set_ylim(0.8 * bottom, 1.6 * top)
    log_ticks(ax.yaxis)
    margin = 0.01 * (time[-1] - time[0])
    ax.set_xlim(time[0] - margin, time[-1] + margin)
    legend_above(ax, ncols=5)
    return ax


def plot_error_distribution(model: AxisModel, fit: AxisFit, *, ax: Axes) -> Axes:
    """Draw the distribution of the prediction errors of all axes, and the standard normal law.

    Parameters
    ----------
    model : AxisModel
    fit : AxisFit
        Steps and their fit.
    ax : matplotlib.axes.Axes

    Returns
    -------
    matplotlib.axes.Axes
        Logarithmic; empty bins are left out. At least 68 % and 95 % of the bins of independent
        normal errors lie in the bands, which are those of their counts. The legend has the number
        of errors outside the axes.
    """
    from scipy.special import bdtrik, ndtr

    error = model.prediction_errors(fit).ravel()
    total = error.size
    widest = min(_WIDEST_ERROR, max(4.0, float(np.abs(error).max())))
    width = float(np.clip(3.5 * total ** (-1 / 3), 0.1, 0.5))
    half = int(np.ceil(widest / width))
    edges = width * np.arange(-half, half + 1)
    number = np.histogram(error, edges)[0]
    outside = total - int(number.sum())
    # The law is symmetric: probabilities of the upper tail are those of the lower one.
    lower = ndtr(edges[: half + 1])
    expected = np.diff(lower)
    expected = np.concatenate([expected, expected[::-1]])
    unit = 1 / (total * width)
    bottom = 0.3 * unit
    for share, opacity in _BANDS:
        # An integer is inside if it lies between these ends, half a count beyond the quantiles.
        low, high = (
            np.ceil(np.maximum(np.nan_to_num(bdtrik(p, total, expected)), 0.0) - 1e-9) + 0.5 * s
            for p, s in ((0.5 - share / 2, -1), (0.5 + share / 2, 1))
        )
        ax.fill_between(
            np.repeat(edges, 2)[1:-1],
            np.repeat(np.maximum(low * unit, 0.1 * bottom), 2),
            np.repeat(high * unit, 2),
            color=series_color(0),
            alpha=opacity,
            lw=0,
            label="68 % and 95 % of counts" if share == 0.68 else None,
        )
    x = np.linspace(edges[0], edges[-1], 400)
    ax.plot(
        x,
        np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi),
        color=series_color(0),
        lw=line_width(0.95),
        label="normal law",
    )
    full = number > 0
    middle = (edges[1:] + edges[:-1]) / 2
    label = f"{total} errors"
    if outside:
        label += f", {outside} beyond ±{edges[-1]:.0f}"
    ax.plot(
        middle[full],
        number[full] * unit,
        "o",
        color=ink(),
        ms=marker_size(0.6),
        mew=0,
        label=label,
        zorder=4,
    )
    ax.set(yscale="log", xlim=(edges[0], edges[-1]), ylabel="probability density")
    ax.set_ylim(bottom, 2 * max(float(number.max()) * unit, 0.4))
    ax.set_xlabel("prediction error / its standard deviation")
    legend_above(ax, ncols=2)
    return ax


def motion_figure(
    motion: RigidMotion,
    *,
    quantity: Quantity = "rotation",
    noise: Literal["joint", "residual"] | float | Noise = "joint",
    exposure: float | None = None,
    verdict: MotionVerdict | None = None,
) -> Figure:
    """Return a figure of what `judge_motion` tests: spectrum, distribution and course in time.

    Parameters
    ----------
    motion : RigidMotion
    quantity : {"rotation", "translation"}
    noise : {"joint", "residual"}, float or Noise
        As in `judge_motion`.
    exposure : float, optional
        Open fraction of the time between frames, as in `judge_motion`.
    verdict : MotionVerdict, optional
        The verdict on this motion with the same options; default is to judge it now.

    Returns
    -------
    matplotlib.figure.Figure
        Its title is the text of the verdict.

    Raises
    ------
    TooFewFramesError
        If the motion has fewer than 20 steps.
    ValueError
        For unknown or inconsistent choices, all in one message; if the verdict is that of another
        quantity or motion; for a body that does not move.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> free = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=100, rng=3)
    >>> [ax.get_xlabel() for ax in motion_figure(free).axes]
    ['frequency (Hz)', 'prediction error / its standard deviation', 'time (s)']
    """
    if verdict is None:
        verdict = judge_motion(motion, quantity=quantity, noise=noise, exposure=exposure)
    faults = []
    if verdict.quantity != quantity:
        faults.append(
            f"verdict: expected one on the {quantity}, got one on the {verdict.quantity}; give "
            "both functions the same quantity"
        )
    if verdict.n_frames != motion.fitted.size:
        faults.append(
            f"verdict: expected one on the {motion.fitted.size} frames of this motion, got one on "
            f"{verdict.n_frames}; the verdicts on single motions are in `each`"
        )
    refuse(faults)
    model, y = axis_model(motion, quantity, Noise.of(noise, exposure=exposure))
    fit = model.fit(y)
    figure = column_figure(0.7)
    axes = figure.subplot_mosaic(
        [["spectrum", "distribution"], ["time", "time"]], height_ratios=[1.35, 1]
    )
    plot_step_spectrum(model, fit, ax=axes["spectrum"], quantity=quantity, verdict=verdict)
    plot_error_distribution(model, fit, ax=axes["distribution"])
    plot_prediction_errors(motion, model, fit, ax=axes["time"], verdict=verdict)
    text = re.sub(r"\bum\b", "µm", verdict.text).replace("^2", "²")
    title = textwrap.fill(text, _TITLE_LETTERS, break_on_hyphens=False)
    figure.suptitle(title, x=0.01, ha="left", size="medium", parse_math=False)
    return figure


def _bin_means(x: Floats, edges: Ints) -> Floats:
    """Return the means of consecutive values between edges."""
    return np.asarray(np.add.reduceat(x, edges[:-1]) / np.diff(edges))


def _mark_jumps(time: Floats, square: Floats, row: Ints, jumps: Ints, *, ax: Axes) -> None:
    """Draw a ring about every jump, and the row of the largest ones that are apart."""
    style: dict[str, Any] = {
        "mfc": "none",
        "mec": series_color(1),
        "ms": marker_size(1.15),
        "mew": line_width(0.95),
        "zorder": 4,
    }
    label = f"jumps ({jumps.size})" if jumps.size > 1 else "jump"
    ax.plot(time[jumps], square[jumps], "o", label=label, **style)
    place = (time - time[0]) / (time[-1] - time[0])
    numbered: list[int] = []
    for j in jumps[np.argsort(-square[jumps])]:
        if len(numbered) < _NUMBERED_JUMPS and all(
            abs(place[j] - place[i]) > 0.06 for i in numbered
        ):
            numbered.append(int(j))
            # At the ends of the track the text begins or ends at the ring.
            side = "left" if place[j] < 0.03 else "right" if place[j] > 0.97 else "center"
            ax.annotate(
                f"row {row[j]}",
                (time[j], square[j]),
                (0, 6),
                textcoords="offset points",
                ha=side,
                size="small",
                color=series_color(1),
            )
