"""The likelihood of noisy Brownian steps with one D, its maximum and its profile.

Step i of a motion has variance 2 D tau + o_i + o_{i+1} and covariance -o_{i+1} with the next one,
o = s - b D the noise variance s of a frame less what motion blur takes. s = weight theta + known:
theta is free (theta >= 0) or fixed, `known` is given. The determinants and inverses that this
needs are found by a sine transform where the steps are even, else by tridiagonal elimination.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from perrin._arrays import mean_row
from perrin.diffusion.effective_modes import FewModes, NoiseProfile
from perrin.diffusion.step_kernels import (
    LEAST_EIGENVALUE,
    GroupSlopes,
    SineModes,
    StepKernel,
    TridiagonalCovariance,
    difference_eigenvalues,
)
from perrin.diffusion.steps import groups_alike

if TYPE_CHECKING:
    from collections.abc import Sequence

    from perrin._arrays import Bools, Floats
    from perrin.diffusion.steps import NoisySteps

# Lowest and highest logarithm of an offset theta in units of the mean square step. Without
# diffusion a long track needs an offset far above that.
_LEAST_LOG_OFFSET, _MOST_LOG_OFFSET = -30.0, 60.0

# The steps of a body whose mean square is this much smaller than another one's are rounding.
_SMALLEST_STEP_RATIO = 1e-24

# Steps in log theta that are short enough where only the sign of a slope is used.
_COARSE_LOG_STEP = 0.03

# About this many step components are evaluated at once; more do not stay in the processor's cache.
_MOST_MOTIONS_AT_ONCE = 100_000

_LEAST_SLOPE_RATIO = float(np.exp(-_MOST_LOG_OFFSET))


class ProfilePoint(NamedTuple):
    """Points of the profile likelihood: the likelihood maximised over theta at given D.

    Attributes
    ----------
    D : ndarray, shape (..., units)
        D of each unit: one for every motion, or one for all.
    value : ndarray, shape (..., units)
        Profile log-likelihood.
    slope, curvature : ndarray, shape (..., units)
        First and second derivative of the value in D.
    log_ratio, bend : ndarray, shape (..., units)
        Logarithm of the rise over the fall of that slope, and its derivative in D.
    theta, theta_slope : ndarray, shape (..., G)
        Noise parameter of each motion at the maximum, and its derivative in D.
    """

    D: Floats
    value: Floats
    slope: Floats
    curvature: Floats
    log_ratio: Floats
    bend: Floats
    theta: Floats
    theta_slope: Floats

    def theta_at(self, D: Floats) -> Floats:
        """Return the theta that these points predict for other D, (..., G): a power of D.

        Near the edge theta = 0 the power would be without bound; there it is a first guess only.
        """
        known = (self.theta > 0) & (self.D > 0)
        ratio = np.where(known & (D > 0), D / np.where(self.D > 0, self.D, 1.0), 1.0)
        power = np.divide(
            self.theta_slope * self.D, self.theta, out=np.zeros_like(self.theta), where=known
        )
        return np.asarray(self.theta * ratio ** np.clip(power, -3.0, 3.0))


@dataclass(frozen=True, eq=False)
class Likelihood:
    """The likelihood of the steps of several motions (groups), theta profiled out.

    Arrays over "units" have the length of the number of different D.

    Attributes
    ----------
    tracks : tuple of NoisySteps
        Steps of every motion.
    kernels : tuple of StepKernel
        Objects that evaluate the motions, each some of them.
    own : bool
        Whether every motion has a D of its own; else they share one.
    """

    tracks: tuple[NoisySteps, ...]
    kernels: tuple[StepKernel, ...]
    own: bool = False

    @classmethod
    def of(cls, tracks: Sequence[NoisySteps]) -> Likelihood:
        """Return the likelihood: sine modes of even steps, few of long tracks, else elimination."""
        even = [i for i, t in enumerate(tracks) if t.steps.even]
        rest = sorted(set(range(len(tracks))) - set(even))
        profiles = {i: NoiseProfile.of(tracks[i]) for i in rest}
        long = {i: one for i, one in profiles.items() if one is not None}
        rest = [i for i in rest if i not in long]
        found: list[StepKernel] = []
        if even:
            found.append(SineModes.of([tracks[i] for i in even], even))
        if long:
            found.append(FewModes.of([tracks[i] for i in long], [*long.values()], [*long]))
        if rest:
            found.append(TridiagonalCovariance.of([tracks[i] for i in rest], rest))
        return cls(tuple(tracks), tuple(found))

    def apart(self) -> Likelihood:
        """Return the same likelihood with a D for every motion."""
        return replace(self, own=True)

    @cached_property
    def mean_square(self) -> Floats:
        """Mean square step of each motion: the scale of its theta."""
        square = np.array([t.steps.sum_of_squares / t.steps.vectors.size for t in self.tracks])
        floor: Floats = np.maximum(square, _SMALLEST_STEP_RATIO * square.max())
        return floor

    @cached_property
    def scale(self) -> Floats:
        """D of each unit that explains all of its motion without noise."""
        moved = np.array([t.steps.sum_of_squares for t in self.tracks])
        spent = [2 * t.steps.vectors.shape[1] * t.steps.total_duration for t in self.tracks]
        return self.by_unit(moved) / self.by_unit(np.array(spent))

    @cached_property
    def fixed(self) -> Bools:
        """Whether theta is fixed, by motion."""
        return np.array([np.isinf(t.freedom) for t in self.tracks])

    @cached_property
    def prior(self) -> tuple[Floats, Floats]:
        """Degrees of freedom and value of theta from the residuals; none where it is fixed."""
        freedom = np.array([t.freedom for t in self.tracks])
        return np.where(self.fixed, 0.0, freedom), np.array([t.theta for t in self.tracks])

    def by_unit(self, x: Floats) -> Floats:
        """Sum over the motions that share a D, (..., units)."""
        alone = self.own or len(self.tracks) == 1
        return x if alone else np.asarray(x.sum(axis=-1, keepdims=True))

    def sums(self, D: Floats, theta: Floats, *, rough: bool = False) -> GroupSlopes:
        """Evaluate all motions at the D (..., units) and the theta (..., G).

        `rough` allows an error of 1 %, to find where to search.
        """
        D = np.broadcast_to(D, theta.shape)
        kernels = [kernel.rough if rough else kernel for kernel in self.kernels]
        if len(kernels) == 1:
            total = kernels[0].sums(D, theta)
        else:
            total = GroupSlopes(*[np.empty(theta.shape) for _ in GroupSlopes._fields])
            for kernel in kernels:
                part = kernel.sums(D[..., kernel.groups], theta[..., kernel.groups])
                for of_all, of_some in zip(total, part, strict=True):
                    of_all[..., kernel.groups] = of_some
        freedom, value = self.prior
        if freedom.any():
            # The residuals of the rigid fits: chi-squared with their degrees of freedom in theta.
            safe = np.maximum(theta, LEAST_EIGENVALUE)
            total.value[:] -= 0.5 * freedom * (np.log(safe) + value / safe)
            total.rise[:] += 0.5 * freedom * (value / safe) / safe
            total.fall[:] += 0.5 * freedom / safe
            total.rise_oo[:] -= freedom * (value / safe) / safe / safe
            total.fall_oo[:] -= 0.5 * freedom / safe / safe
        return total

    def profile(
        self, D: Floats, start: Floats | None = None, *, tolerance: float = 1e-6
    ) -> ProfilePoint:
        """Maximise over theta at given D (..., units), starting from a theta (..., G).

        Each theta is the root of its own rise less fall, all at once, by Newton steps inside a
        shrinking bracket in log theta; the logarithm of rise over fall is nearly straight there.
        Towards theta = 0 the root may not exist; the edge is then the answer. The last step is
        shorter than the tolerance; it enters the result to first order, which leaves an error of
        the order of its square.
        """
        square, fixed = self.mean_square, self.fixed
        shape = (*D.shape[:-1], len(square))
        if start is None:
            spent = [t.steps.total_duration / len(t.steps.duration) for t in self.tracks]
            start = np.maximum(0.5 * square - D * np.array(spent), 0.01 * square)
        low, high = np.full(shape, _LEAST_LOG_OFFSET), np.full(shape, _MOST_LOG_OFFSET)
        t = np.log(np.maximum(np.broadcast_to(start, shape) / square, 1e-6))
        t = np.minimum(t, _MOST_LOG_OFFSET)
        some_fixed, rough = bool(fixed.any()), tolerance >= _COARSE_LOG_STEP
        for _ in range(100):
            theta = square * np.exp(t)
            theta = np.where(fixed, self.prior[1], theta) if some_fixed else theta
            sums = self.sums(D, theta, rough=rough)
            ratio = log_slope_ratio(sums.rise, sums.fall)
            bend = theta * ratio_bend(sums.rise, sums.fall, sums.rise_oo, sums.fall_oo)
            up = ratio > 0
            low, high = np.where(up, t, low), np.where(up, high, t)
            target = newton_trial(t, ratio, bend, low, high)
            at_edge = fixed | (high <= _LEAST_LOG_OFFSET)
            move = np.where(at_edge, 0.0, target - t)
            settled = np.abs(move) <= tolerance
            if settled.all():
                break
            t = np.where(settled, t, target)
        more = theta * np.expm1(move)
        slopes = sums.rise_Do - sums.fall_Do, sums.rise_oo - sums.fall_oo
        turn = np.divide(-slopes[0], slopes[1], out=np.zeros(shape), where=~at_edge & (bend < 0))
        rise = self.by_unit(sums.rise_D + sums.rise_Do * more)
        fall = self.by_unit(sums.fall_D + sums.fall_Do * more)
        rise_bend = self.by_unit(sums.rise_DD + sums.rise_Do * turn)
        fall_bend = self.by_unit(sums.fall_DD + sums.fall_Do * turn)
        return ProfilePoint(
            D,
            self.by_unit(sums.value + 0.5 * (sums.rise - sums.fall) * more),
            rise - fall,
            rise_bend - fall_bend,
            log_slope_ratio(rise, fall),
            ratio_bend(rise, fall, rise_bend, fall_bend),
            theta + more,
            turn,
        )

    def best(self) -> ProfilePoint:
        """Return the D of greatest likelihood of every unit: the highest maximum, or 0.

        Short tracks can have several maxima, so the whole range is searched.
        """
        seen = self.searched_range()
        best, theta = np.zeros_like(self.scale), seen.theta[0]
        height = np.where(seen.slope[0] <= 0, seen.value[0], -np.inf)
        # Brackets in which a unit's slope falls through zero, in the order of D; a unit that has
        # no more of them gets a bracket of length 0.
        falls = (seen.log_ratio[:-1] > 0) & (seen.log_ratio[1:] <= 0)
        order, unit = np.argsort(~falls, axis=0, kind="stable"), np.arange(len(best))
        for row in order[: int(falls.sum(axis=0).max(initial=0))]:
            rows = np.stack([row, np.where(falls[row, unit], row + 1, row)])
            low, high = seen.D[rows, unit]
            by_motion = np.broadcast_to(rows, (2, len(theta)))
            peak = self.maximum_between(
                (low, high),
                log_ratio=seen.log_ratio[rows, unit],
                theta=np.take_along_axis(seen.theta, by_motion, axis=0),
            )
            higher = (peak.value > height) & (high > low)
            best, height = np.where(higher, peak.D, best), np.where(higher, peak.value, height)
            theta = np.where(higher, peak.theta, theta)
        return self.profile(best, theta)

    def searched_range(self) -> ProfilePoint:
        """Return the profile at D = 0 and at all powers of 4 of its scale that may be likely.

        Only the signs of the slopes, and the value at 0, are used of it.
        """
        size = sum(kernel.size for kernel in self.kernels)
        powers = np.concatenate([[0.0], 4.0 ** np.arange(-7, 3)])
        at_once = int(np.clip(_MOST_MOTIONS_AT_ONCE / size, 1, len(powers)))
        parts: list[ProfilePoint] = []
        for k in range(0, 60, at_once):
            if k >= len(powers):
                powers = np.append(powers, 4.0 ** (len(powers) - 8 + np.arange(at_once)))
            D = powers[k : k + at_once, None] * self.scale
            start = parts[-1].theta_at(D)[-1:] if parts and at_once == 1 else None
            parts.append(self.profile(D, start, tolerance=_COARSE_LOG_STEP))
            if powers[min(k + at_once, len(powers)) - 1] > 1 and np.all(parts[-1].slope[-1] <= 0):
                break
        return ProfilePoint(*[np.concatenate(rows) for rows in zip(*parts, strict=True)])

    def maximum_between(
        self, ends: tuple[Floats, Floats], *, log_ratio: Floats, theta: Floats
    ) -> ProfilePoint:
        """Return the maximum of the profile between two D of every unit, by bracketed Newton steps.

        The log ratio (2, units) and theta (2, G) are those at both ends. A unit whose ends agree
        keeps that D.
        """
        low, high = ends
        share = np.divide(
            log_ratio[0], log_ratio[0] - log_ratio[1], out=np.zeros_like(low), where=high > low
        )
        share = np.clip(share, 0.05, 0.95) * (high > low)
        # The ends differ by a factor of 4 or begin at 0.
        part = np.where(low > 0, np.expm1(share * np.log(4.0)) / 3, share)
        trial = low + part * (high - low)
        peak = self.profile(trial, theta[0] + part * (theta[1] - theta[0]))
        for _ in range(200):
            rising = peak.log_ratio > 0
            low, high = np.where(rising, peak.D, low), np.where(rising, high, peak.D)
            trial = newton_trial(peak.D, peak.log_ratio, peak.bend, low, high)
            # The error of the next Newton step is of the order of the square of this one.
            nearest = np.where(peak.bend < 0, 1e-7, 1e-13) * np.abs(peak.D)
            done = (np.abs(trial - peak.D) <= nearest) | (high <= low)
            if done.all():
                break
            trial = np.where(done, peak.D, trial)
            peak = self.profile(trial, peak.theta_at(trial))
        D = np.where(high > low, trial, peak.D)
        return peak._replace(D=D, theta=peak.theta_at(D))

    def intervals(self, best: ProfilePoint, drops: Floats) -> tuple[Floats, Floats]:
        """Return where twice the profile log-likelihood has fallen by drops (K, units), both ends.

        The low end is 0 if it never has. All ends are found at once, by Newton steps in the root of
        twice the fall, which is nearly straight, halved into brackets; or doubled, while there is
        no bracket.
        """
        value, top = best.D, best.value
        count = len(drops)
        fall_to_zero = 2 * (top - self.profile(np.zeros_like(value)).value)
        has_low = (value > 0) & (fall_to_zero > drops)
        root = np.sqrt(np.concatenate([drops, drops]))
        side = np.where(np.arange(2 * count) < count, 1.0, -1.0)[:, None]
        sizes = self.by_unit(np.array([t.steps.vectors.size for t in self.tracks]))
        bent = (value > 0) & (best.curvature < 0)
        reach = np.where(
            bent, root / np.sqrt(np.where(bent, -best.curvature, 1.0)), self.scale / sizes
        )
        inside = np.broadcast_to(value, root.shape)
        outside = np.broadcast_to(np.where(side > 0, np.inf, 0.0), root.shape)
        x = value + side * reach
        x = np.where(x > 0, x, 0.5 * value)
        settled = np.concatenate([np.zeros_like(has_low), ~has_low])
        x = np.where(settled, value, x)
        point = ProfilePoint(*[np.broadcast_to(row, (2 * count, row.shape[-1])) for row in best])
        for _ in range(200):
            point = self.profile(x, point.theta_at(x))
            fall = 2 * (top - point.value)
            within = fall < root**2
            inside, outside = np.where(within, x, inside), np.where(within, outside, x)
            depth = np.sqrt(np.maximum(fall, 0.0))
            slope = -np.divide(point.slope, depth, out=np.zeros_like(x), where=depth > 0)
            step = np.divide(root - depth, slope, out=np.full_like(x, np.inf), where=slope != 0)
            bounded = np.isfinite(outside)
            middle = np.where(bounded, 0.5 * (inside + np.where(bounded, outside, 0.0)), 2 * x)
            between = (np.minimum(inside, outside) < x + step) & (
                x + step < np.maximum(inside, outside)
            )
            moved = np.where(settled, 0.0, np.where(between, step, middle - x))
            x = x + moved
            # The error of the next Newton step is of the order of the square of this one. What is
            # nothing beside the least D that steps of this size could show is as good as 0.
            nearest = np.where(between, 1e-7, 1e-11) * np.abs(x) + 1e-12 * self.scale / sizes
            settled |= np.abs(moved) <= nearest
            if settled.all():
                break
        return np.where(has_low, x[count:], 0.0), x[:count]

    def steady_motion(self, D: Floats | float, theta: Floats) -> tuple[Floats, Floats]:
        """Return the steady velocity or spin of every motion (G, p), lab axes, and its information.

        The information (G, p, p) is the inverse of the covariance at this D, one for all or (G,),
        and theta.
        """
        p = self.tracks[0].steady.size
        mean, information = np.empty((len(theta), p)), np.empty((len(theta), p, p))
        for kernel in self.kernels:
            rows = kernel.groups
            some = kernel.steady_motion(np.broadcast_to(D, theta.shape)[rows], theta[rows])
            mean[rows], information[rows] = some
        return mean + np.array([t.steady for t in self.tracks]), information

    def offsets(self, best: ProfilePoint) -> tuple[Floats, Floats]:
        """Return the mean noise offset of the motions of each unit, and its standard error.

        The observed information is arrow-shaped: one D, a theta for each motion. NaN where a theta
        lies on its edge.
        """
        blur = np.array([t.blur for t in self.tracks])
        level = np.array([t.level for t in self.tracks])
        free, theta = ~self.fixed, best.theta
        count = self.by_unit(np.ones(len(blur)))
        offset = self.by_unit(np.where(free, theta, 0.0) + level - blur * best.D) / count
        known = self.by_unit((free & (theta <= 1e-3 * self.mean_square)).astype(np.float64)) == 0
        sums = self.sums(best.D, theta)
        h_DD = self.by_unit(sums.fall_DD - sums.rise_DD)
        h_Do, h_oo = sums.fall_Do - sums.rise_Do, sums.fall_oo - sums.rise_oo
        known &= (best.D > 0) & (self.by_unit((free & (h_oo <= 0)).astype(np.float64)) == 0)
        inverse: Floats = np.zeros_like(h_oo)
        np.divide(1.0, h_oo, out=inverse, where=free & (h_oo > 0))
        turn: Floats = np.asarray(h_Do * inverse, dtype=np.float64)
        left = h_DD - self.by_unit(turn * h_Do)
        known &= left > 0
        left = np.where(known, left, np.nan)
        own = self.by_unit(inverse) / count**2
        return offset, np.sqrt(own + (self.by_unit(turn + blur) / count) ** 2 / left)


def log_slope_ratio(rise: Floats, fall: Floats) -> Floats:
    """Return the logarithm of rise over fall; negative where both are zero.

    Examples
    --------
    >>> log_slope_ratio(np.array([1.0, 0.0]), np.array([1.0, 0.0]))
    array([  0., -60.])
    """
    ratio = rise / np.maximum(fall, LEAST_EIGENVALUE)
    return np.asarray(
        np.log(np.minimum(np.maximum(ratio, _LEAST_SLOPE_RATIO), 1 / _LEAST_SLOPE_RATIO))
    )


def ratio_bend(rise: Floats, fall: Floats, rise_bend: Floats, fall_bend: Floats) -> Floats:
    """Return the slope of the logarithm of rise over fall; 0 where one of them is zero.

    Examples
    --------
    >>> two = np.array([2.0, 0.0])
    >>> ratio_bend(two, two, -two, two)
    array([-2.,  0.])
    """
    known = (rise > LEAST_EIGENVALUE) & (fall > LEAST_EIGENVALUE)
    up = np.divide(rise_bend, rise, out=np.zeros_like(rise), where=known)
    return np.asarray(up - np.divide(fall_bend, fall, out=np.zeros_like(fall), where=known))


def newton_trial(t: Floats, slope: Floats, bend: Floats, low: Floats, high: Floats) -> Floats:
    """Return the next trial: the Newton step, or the middle of the bracket where that leaves it.

    Examples
    --------
    >>> t, slope, bend, low, high = np.array([[1.0], [2.0], [-2.0], [1.0], [9.0]])
    >>> newton_trial(t, slope, bend, low, high)
    array([2.])
    """
    target = t - np.divide(slope, bend, out=np.full(t.shape, np.nan), where=bend < 0)
    inside = (target >= low) & (target <= high)
    if inside.all():
        return np.asarray(target)
    # Where a falling slope does not cross zero, the maximum is at the edge.
    edge = _LEAST_LOG_OFFSET
    target = np.where((target <= low) & (low <= edge), edge, target)
    return np.where(inside | (target == edge), target, 0.5 * (low + high))


def excess_scatter(tracks: Sequence[NoisySteps], D: float, theta: Floats) -> float:
    """Return the factor by which unequal axes raise the variance of their common D.

    The likelihood of one D for all axes finds the mean over axes (trace/3) whatever the tensor is,
    for the deviations of the axes cancel in its score. They do not cancel in the score's variance,
    which in sine mode k is sum_ab Lambda_ab^2 over A lambda^2 times that of equal axes. The
    deviations of D and of the noise are fitted to the cross powers of the axes, and the part that
    is expected by chance is subtracted: equal axes give 1 on average.

    Parameters
    ----------
    tracks : sequence of NoisySteps
        Steps of every motion, all of one quantity.
    D : float
    theta : ndarray, shape (G,)
        Noise of each motion, as the likelihood found it.

    Returns
    -------
    float
        Ratio, at least 1.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> from perrin.diffusion import Noise, NoisySteps, steps_of
    >>> D_R = [1e-3, 1e-3, 1e-2]
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=D_R, dt=0.7, n_frames=300, rng=3)
    >>> track = NoisySteps.of(steps_of(truth, "rotation"), Noise())
    >>> excess_scatter([track], 4e-3, np.zeros(1)) > 1.4
    True
    """
    excess, scale = _squared_deviations(tracks, np.full(len(tracks), D), theta).sum(axis=1)
    return 1.0 + max(0.0, float(excess / scale)) if scale > 0 else 1.0


def excess_scatter_of_each(tracks: Sequence[NoisySteps], D: Floats, theta: Floats) -> Floats:
    """Return the factor of `excess_scatter` for each of several motions alone, (G,).

    Parameters
    ----------
    tracks : sequence of NoisySteps
    D, theta : ndarray, shape (G,)
        D and noise of each motion.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> from perrin.diffusion import Noise, NoisySteps, steps_of
    >>> D_R = [1e-3, 1e-3, 1e-2]
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=D_R, dt=0.7, n_frames=300, rng=3)
    >>> track = NoisySteps.of(steps_of(truth, "rotation"), Noise())
    >>> excess_scatter_of_each([track, track], np.full(2, 4e-3), np.zeros(2)) > 1.4
    array([ True,  True])
    """
    excess, scale = _squared_deviations(tracks, D, theta)
    ratio = np.divide(excess, scale, out=np.zeros_like(excess), where=scale > 0)
    return np.asarray(1.0 + np.maximum(ratio, 0.0))


def _squared_deviations(tracks: Sequence[NoisySteps], D: Floats, theta: Floats) -> Floats:
    """Return sums over modes of the squared deviations, chance subtracted, and of their scale.

    They are those of each motion, (2, G).
    """
    from scipy.fft import dst

    found = np.zeros((2, len(tracks)))
    shapes = [track.steps.vectors.shape for track in tracks]
    sizes = [count * axes for count, axes in shapes]
    for group in groups_alike(shapes, sizes, most=_MOST_MOTIONS_AT_ONCE):
        count, axes = shapes[group[0]]
        if axes == 1 or count < 5:
            continue
        some, own_D, own_theta = [tracks[k] for k in group], D[group], theta[group]
        c = difference_eigenvalues(count)
        weight, known = (
            np.stack([0.5 * (mean_row(first) + mean_row(last)) for first, last in pairs])
            for pairs in ([t.weight for t in some], [t.known for t in some])
        )
        noise = own_theta[:, None] * weight + known
        level = noise.mean(axis=1)
        # Uneven steps are taken as even ones of their mean duration: only a width depends on it.
        duration = np.array([t.steps.total_duration for t in some]) / count
        blur = np.array([t.blur for t in some])
        by_D, by_noise = 2 * (duration[:, None] - blur[:, None] * c), 2 * c
        eigen = by_D * own_D[:, None] + by_noise * level[:, None]
        defined = (eigen > 0).all(axis=1)
        eigen = np.where(defined[:, None], eigen, 1.0)
        modes = dst(np.stack([t.steps.vectors for t in some]), type=1, norm="ortho", axis=1)
        rows = np.stack([by_D, np.broadcast_to(by_noise, by_D.shape)], axis=1)
        relative = rows / eigen[:, None]
        fisher = np.linalg.inv(relative @ np.swapaxes(relative, 1, 2))
        # The deviations of D and of the noise, less what the unequal noise of the axes makes of
        # them.
        weights = fisher @ (relative / eigen[:, None])
        columns = np.swapaxes(modes, 1, 2)[:, None]
        deviation = columns @ (weights[..., None] * modes[:, None])
        unequal = (noise - level[:, None])[:, None, None] * np.eye(axes)
        deviation = deviation - (weights @ by_noise)[..., None, None] * unequal
        mean = np.trace(deviation, axis1=2, axis2=3)[..., None, None] / axes
        deviation = deviation - mean * np.eye(axes)
        flat = deviation.reshape(len(some), 2, -1)
        squares = flat @ np.swapaxes(flat, 1, 2) - (axes - 1) * (axes + 2) * fisher
        # Weights of the modes in the score of D with theta profiled out.
        freedom = np.array([t.freedom for t in some])
        free = np.isfinite(freedom)
        by_theta = by_noise * np.where(free, weight.mean(axis=1), 0.0)[:, None]
        known_theta = np.where(free & (own_theta > 0), freedom, 0.0) / axes
        known_theta /= np.where(own_theta > 0, own_theta, 1.0) ** 2
        power = ((by_theta / eigen) ** 2).sum(axis=1) + known_theta
        crossed = (by_D * by_theta / eigen**2).sum(axis=1)
        shared = np.divide(crossed, power, out=np.zeros_like(power), where=power > 0)
        score = (by_D - shared[:, None] * by_theta) / eigen**2
        scored = score[:, None] * rows
        excess = (squares * (scored @ np.swapaxes(scored, 1, 2))).sum(axis=(1, 2))
        scale = axes * ((score * eigen) ** 2).sum(axis=1)
        found[:, group] = np.where(defined, np.stack([excess, scale]), 0.0)
    return found
