"""The diffusion coefficient at long times of caged and hopping motion."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from perrin._arrays import choice_fault, number_fault, refuse, to_plain
from perrin._display import Shown
from perrin._text import number_text, unit_text
from perrin.curves.displacement import frames_of, independent_walks, mean_square_curve
from perrin.diffusion.curve_fits import GridLags, line_weights, slope_interval
from perrin.diffusion.estimate import NORMAL, UNITS
from perrin.diffusion.steps import Quantity
from perrin.motion.rigid_motion import RigidMotion, threshold_displacement

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from typing import Self

    from perrin._arrays import Floats, Ints
    from perrin.curves.displacement import LagCurve

# Standard deviations of one angle in a cage, noise included. At 5 a twentieth of the spurious
# diffusion of added steps remains, at 8 none; the plateau is read up to a third too high.
_CAGE_WIDTHS = 6.0

# A mean square that grows more slowly than this power of the lag somewhere has a plateau.
_PLATEAU_EXPONENT = 0.9

# Wider cages need a threshold at which free diffusion would already read 7 % low.
_WIDEST_THRESHOLD = 2.0

# The slope is that of the lags n to 4 n. n is a sixtieth to a twenty-fourth of the track: a line
# through shorter lags would be that of the relaxation in a cage where that is slow, one through
# longer lags has an error above 40 %.
_WINDOW, _SHORTEST_START, _LONGEST_START = 4, 60, 24

# A window is straight where its slope differs from those of all longer windows by less than so
# many standard errors of the difference.
_STRAIGHT = 1.0


@dataclass(frozen=True, repr=False)
class LongTimeEstimate(Shown):
    """A diffusion coefficient at long times, with the range of lag times over which it holds.

    Attributes
    ----------
    value : float
        Slope of the mean square at long lags over 2 dof, rad^2/s or um^2/s; it may be negative
        where a cage holds the body.
    stderr : float
        Standard error: that of the slope for Brownian motion at long times in a cage, with the
        correlated motion in the cage and the small number of hops included.
    ci68, ci95 : tuple of float
        Confidence intervals; an upper end that the data do not bound is inf, a lower one 0.
    resolved : bool
        Whether the 95 % interval lies above 0; if not, its upper end is an upper limit.
    unit : str
        "rad^2/s" or "um^2/s".
    lag_range : tuple of float
        First and last lag time of the straight line, s.
    threshold : float
        Angle at which the reference of the rotation changes, rad; 0 where all steps are added, and
        for translation.
    offset : float
        Variance of one orientation (rad^2) or coordinate (um^2) in the cage, noise included: the
        intercept of the line over 2 dof.
    n_frames : int
        Frames with a pose, of all motions.
    method : str
        How displacements were added: "added steps", "threshold" or "displacements".
    """

    value: float
    stderr: float
    ci68: tuple[float, float]
    ci95: tuple[float, float]
    resolved: bool
    unit: str
    lag_range: tuple[float, float]
    threshold: float
    offset: float
    n_frames: int
    method: str

    @property
    def text(self) -> str:
        """One sentence: the value or its upper limit, the lag times, and how it was found."""
        name, unit = ("D_T", UNITS["translation"])
        if self.unit == UNITS["rotation"]:
            name, unit = ("D_R", UNITS["rotation"])
        how = f" {self.threshold:.2g} rad" if self.method == "threshold" else ""
        low, high = self.lag_range
        over = f"over lag times of {low:.3g} to {high:.3g} s"
        tail = f"[{self.method}{how}, {self.n_frames} frames]"
        if self.resolved:
            return (
                f"{name} = {number_text(self.value, self.stderr)} {unit_text(unit)} {over} {tail}"
            )
        limit = number_text(self.ci95[1], digits=2)
        return f"{name} < {limit} {unit_text(unit)} (95 % limit) {over} {tail}"

    def __str__(self) -> str:
        return self.text

    def __float__(self) -> float:
        return self.value

    def to_dict(self) -> dict[str, Any]:
        """Return the estimate for JSON; an end of an interval without bound is None."""
        entry: dict[str, Any] = to_plain(asdict(self))
        return entry

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> Self:
        """Return the estimate that `to_dict` wrote.

        Parameters
        ----------
        entry : mapping
        """
        read = dict(entry)
        for name in ("ci68", "ci95", "lag_range"):
            low, high = entry[name]
            read[name] = (low, np.inf if high is None else high)
        return cls(**read)


def long_time_diffusion(
    motion: RigidMotion | Sequence[RigidMotion],
    *,
    quantity: Quantity = "rotation",
    threshold: float | None = None,
) -> LongTimeEstimate:
    """Estimate the D of long times from the slope of the mean square at long lags.

    In a cage the steps show the short-time D of the cage, as `estimate_diffusion` does. At long
    times only motion out of the cage remains. Rotation is the sum of the steps, or with a
    threshold the sum of those rotations that exceed it (`threshold_displacement`): the sum of all
    steps of a body in a cage of variance L^2 diffuses by about 0.09 L^4 a frame although the body
    does not, because rotations do not commute.

    Parameters
    ----------
    motion : RigidMotion or sequence of RigidMotion
        Motion; several motions with the same time between frames are pooled and share one D.
    quantity : {"rotation", "translation"}
        D_R, or D_T from the mean square displacement.
    threshold : float, optional
        Angle, rad, 0 to pi, for rotation only; 0 adds all steps. None: 6 (L^2 + s)^(1/2), at most
        2, where L^2 + s is the variance of one angle in the cage and its noise, read at the
        plateau of the mean square of added steps; 0 where there is no plateau.

    Returns
    -------
    LongTimeEstimate

    Raises
    ------
    TooFewFramesError
        If no two frames of one piece are present.
    ValueError
        For an unknown quantity, a threshold out of range or for translation, motions of different
        dimensions or times between frames, motions at rest, or tracks under 24 steps.

    Notes
    -----
    The line is fitted by least squares to the lags n to 4 n. Of five n from a sixtieth to a
    twenty-fourth of the longest track, the smallest is taken whose slope agrees with those of all
    longer windows within the standard errors of the differences: the mean square less its
    intercept then has the exponent 1 within its error. Free diffusion at the threshold t reads
    1 - t^2/60 of D.

    The variance of the slope is that of Brownian motion with noise (as for `fit_line`) plus two
    parts: positions in a cage are correlated in time, so that their variance is multiplied by the
    sum of the correlations over all times, and the excess of the fourth moment, c n at lag n, adds
    c/P for P pairs: 1/h of D^2 for h hops of equal size. The rule of the threshold is that of
    Simon, Bobas, Villemot, Barrat and Berthier, arXiv 2604.21512 (2026).

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=900, rng=3)
    >>> found = long_time_diffusion(truth, threshold=0.5)
    >>> found.ci95[0] < 5e-3 < found.ci95[1]
    True
    """
    motions = [motion] if isinstance(motion, RigidMotion) else list(motion)
    faults = choice_fault("quantity", quantity, get_args(Quantity))
    if len({m.dimension for m in motions}) != 1:
        faults.append("motion: expected one or more motions, all in 2 or all in 3 dimensions")
    elif not np.allclose([m.dt for m in motions], motions[0].dt, rtol=1e-6, atol=0):
        faults.append(
            "motion: expected motions with the same time between frames, got dt = "
            f"{min(m.dt for m in motions):g} to {max(m.dt for m in motions):g} s"
        )
    if threshold is not None:
        faults += number_fault("threshold", threshold, least=0, most=np.pi, unit="rad")
        if quantity == "translation" and threshold:
            faults.append(
                "threshold: for rotation only; displacements add up exactly, leave it out"
            )
    refuse(faults)
    if quantity == "translation":
        angle, method = 0.0, "displacements"
    else:
        if threshold is None:
            threshold = cage_threshold(_PooledWalk.of(motions, quantity, threshold=0.0).curve)
        angle = float(threshold)
        method = "threshold" if angle else "added steps"
    walk = _PooledWalk.of(motions, quantity, threshold=angle)
    if not np.nanmax(walk.curve.value) > 0:
        raise ValueError(f"motion: no {quantity} at all, so that there is no D")
    window = straight_window(walk.lags)
    weights = line_weights(window.steps)
    value, offset = window.line(weights)
    D, s = window.brownian_line(weights)
    a, b, c = _slope_variance(walk, window, D=D, s=s)
    dt = window.step
    (low68, high68), (low95, high95) = (
        slope_interval(value, (a, a + b + c, c), D=D, s=s, z=NORMAL[level])
        for level in (0.68, 0.95)
    )
    return LongTimeEstimate(
        value=value / dt,
        stderr=float(np.sqrt(a * D * D + b * D * max(s, 0.0) + c * s * s)) / dt,
        ci68=(low68 / dt, high68 / dt),
        ci95=(low95 / dt, high95 / dt),
        resolved=low95 > 0,
        unit=UNITS[quantity],
        lag_range=(float(window.steps[0]) * dt, float(window.steps[-1]) * dt),
        threshold=angle,
        offset=offset,
        n_frames=sum(m.fitted.size for m in motions),
        method=method,
    )


@dataclass(frozen=True, eq=False)
class _PooledWalk:
    """The accumulated displacement of all motions, one after another, and its mean square.

    Attributes
    ----------
    walk : ndarray, shape (T, c)
        Accumulated rotation (rad) or centre (um), NaN where missing.
    time : ndarray, shape (T,)
        Rising times, s.
    piece : ndarray of int, shape (T,)
        Pieces; no two motions share one.
    curve : LagCurve
        Mean square against lag time.
    lags : GridLags
        Its lags on the grid of times.
    """

    walk: Floats
    time: Floats
    piece: Ints
    curve: LagCurve
    lags: GridLags

    @classmethod
    def of(cls, motions: Sequence[RigidMotion], quantity: Quantity, *, threshold: float) -> Self:
        """Concatenate the walks of motions and form their mean square."""
        walks, times, pieces = [], [], []
        end, number = 0.0, 0
        for one in motions:
            rotation = quantity == "rotation"
            walks.append(
                threshold_displacement(one, threshold=threshold) if rotation else one.center
            )
            times.append(one.time - one.time[0] + end)
            pieces.append(one.piece - one.piece.min() + number)
            end, number = times[-1][-1] + one.dt, int(pieces[-1].max()) + 1
        walk, time, piece = (np.concatenate(parts) for parts in (walks, times, pieces))
        dof = walk.shape[1]
        n_walks = float(dof)
        if quantity == "rotation" and dof == 3:
            n_walks = float(np.mean([independent_walks(m, np.eye(3)) for m in motions]))
        curve = mean_square_curve(
            walk[:, None],
            frames_of(walk[:, None], time, piece, dt=motions[0].dt),
            quantity=quantity,
            dof=dof,
            n_walks=n_walks,
        )
        return cls(walk, time, piece, curve, GridLags.of(curve))


def cage_threshold(curve: LagCurve) -> float:
    """Return 6 (L^2 + s)^(1/2) from the plateau of the mean square; 0 without a plateau.

    L is the rms deviation from the middle of the cage along one axis, and s the noise.

    Parameters
    ----------
    curve : LagCurve
        Mean square of the accumulated rotation, rad^2.

    Returns
    -------
    float
        Angle of the threshold displacement, rad.

    Examples
    --------
    >>> from perrin import Cluster, msad_vector, simulate_motion
    >>> free = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=3)
    >>> cage_threshold(msad_vector(free))
    0.0
    """
    lags = GridLags.of(curve)
    reach = max(int(lags.stretches[-1][0]) // _LONGEST_START, 4)
    edges = np.unique(np.rint(np.geomspace(1, reach, 4 * int(np.log2(reach)))))
    at = np.unique(np.searchsorted(lags.steps, edges - 0.5))
    at = at[at < lags.size]
    steps, value = np.log(lags.steps[at]), np.log(np.maximum(lags.value[at], 1e-300))
    # Over factors of two or more: neighbouring lags are too close for an exponent.
    apart = 3 if at.size > 3 else 1
    exponent = (value[apart:] - value[:-apart]) / (steps[apart:] - steps[:-apart])
    flattest = int(np.argmin(exponent))
    if exponent[flattest] > _PLATEAU_EXPONENT:
        return 0.0
    middle = 0.5 * (value[flattest] + value[flattest + apart])
    width = np.sqrt(np.exp(middle) / (2 * lags.dof))
    return float(min(_CAGE_WIDTHS * width, _WIDEST_THRESHOLD))


def straight_window(lags: GridLags) -> GridLags:
    """Return the lags n to 4 n of the smallest n beyond which the mean square is straight.

    Parameters
    ----------
    lags : GridLags
        Lags to choose from.

    Returns
    -------
    GridLags

    Raises
    ------
    ValueError
        If the track is too short, or has too few lags with data.

    Examples
    --------
    >>> from perrin import Cluster, msad_vector, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=3)
    >>> straight_window(GridLags.of(msad_vector(truth))).steps[[0, -1]]
    array([ 9., 36.])
    """
    length = int(lags.stretches[-1][0])
    most = length // _LONGEST_START
    if most < 1:
        raise ValueError(
            f"motion: a slope at long lags needs a track of at least {_LONGEST_START} steps, the "
            f"longest has {length}"
        )
    least = max(length // _SHORTEST_START, 1)
    starts = np.unique(np.rint(np.geomspace(least, most, 5)))
    windows = []
    for n in starts:
        inside = (lags.steps > n - 0.5) & (lags.steps < _WINDOW * n + 0.5)
        if inside.sum() >= 3:
            windows.append(lags.take(np.flatnonzero(inside)))
    if not windows:
        raise ValueError(
            f"motion: 3 lags with data are needed from {least} to {_WINDOW * most} frames, there "
            "are none or fewer"
        )
    weights = np.zeros((len(windows), lags.size))
    for row, window in zip(weights, windows, strict=True):
        row[np.searchsorted(lags.index, window.index)] = line_weights(window.steps)[0]
    slopes = weights @ lags.value / (2 * lags.dof)
    for k, window in enumerate(windows[:-1]):
        D, s = window.brownian_line(line_weights(window.steps))
        s *= _cage_memory(lags, window, D=D, s=s)
        if all(
            abs(slopes[k] - slopes[j])
            <= _STRAIGHT * np.sqrt(lags.variance(weights[k] - weights[j], D=D, s=s))
            for j in range(k + 1, len(windows))
        ):
            return window
    return windows[-1]


def _cage_memory(lags: GridLags, window: GridLags, *, D: float, s: float) -> float:
    """Return the sum of the correlations of the position in a cage over all times, in frames.

    1 for noise. The slope at long lags has the error that white noise of this times the variance
    would give it: only the spectral density at low frequency matters.
    """
    if not s > 0:
        return 1.0
    short = lags.take(np.flatnonzero(lags.steps < window.steps[0] - 0.5))
    kept = 1 - (short.value / (2 * short.dof) - D * short.steps) / s
    return 1 + 2 * float(np.sum(np.maximum(kept, 0.0)))


def _slope_variance(
    walk: _PooledWalk, window: GridLags, *, D: float, s: float
) -> tuple[float, float, float]:
    """Return a, b, c of the variance a D^2 + b D s + c s^2 of the slope, cage and hops included."""
    weights = line_weights(window.steps)[0]
    a, both, c = (window.variance(weights, D=d, s=e) for d, e in ((1, 0), (1, 1), (0, 1)))
    memory = _cage_memory(walk.lags, window, D=D, s=s)
    b, c = (both - a - c) * memory, c * memory**2
    first = float(window.steps[0])
    lag, step = first * window.step, walk.lags.step
    here = np.flatnonzero(np.isfinite(walk.walk[:, 0]))
    time = walk.time[here]
    partner = np.searchsorted(time, time + (lag - 0.1 * step))
    close = np.searchsorted(time, time + (lag + 0.1 * step)) > partner
    begin, end = here[close], here[partner[close]]
    same = walk.piece[begin] == walk.piece[end]
    x = walk.walk[end[same]] - walk.walk[begin[same]]
    pairs, covariance = len(x), x.T @ x / len(x)
    # The fourth cumulant: the excess of <r^4> over that of a Gaussian.
    gaussian = np.trace(covariance) ** 2 + 2 * np.sum(covariance**2)
    excess = float(np.mean(np.sum(x * x, axis=1) ** 2) - gaussian)
    hops = max(excess, 0.0) / (first * pairs * (2 * window.dof) ** 2)
    # More hops of the same size: in proportion to D, which is unknown below its other errors.
    known = max(D, np.sqrt(a * D * D + b * D * max(s, 0.0) + c * s * s))
    if hops > 0 and s > 0:
        b += hops / (known * s)
    elif hops > 0:
        a += hops / known**2
    return a, b, c
