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

from perrin.diffusion.step_kernels import (
    LEAST_EIGENVALUE,
    GroupSlopes,
    SineModes,
    StepKernel,
    TridiagonalCovariance,
    difference_eigenvalues,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from perrin._arrays import Bools, Floats
    from perrin.diffusion.steps import NoisySteps

# Lowest and highest logarithm of an offset theta in units of the mean square step. Without
# diffusion a long track needs an offset far above that.
_LEAST_LOG_OFFSET, _MOST_LOG_OFFSET = -30.0, 60.0

# The steps of a body whose mean square is this much smaller than another one's are rounding.
_SMALLEST_STEP_RATIO = 1e-24

_LEAST_SLOPE_RATIO = float(np.exp(-_MOST_LOG_OFFSET))


class ProfilePoint(NamedTuple):
    """A point of the profile likelihood: the likelihood maximised over theta at given D.

    Attributes
    ----------
    D : ndarray, shape (units,)
        D of each unit: one for every motion, or one for all.
    value : ndarray, shape (units,)
        Profile log-likelihood.
    slope : ndarray, shape (units,)
        Slope of the value in D.
    log_ratio : ndarray, shape (units,)
        Logarithm of the rise over the fall of that slope.
    theta : ndarray, shape (G,)
        Noise parameter of each motion at the maximum.
    curvature : ndarray, shape (G,)
        Slope of the log ratio of theta in log theta, with which the next search begins.
    """

    D: Floats
    value: Floats
    slope: Floats
    log_ratio: Floats
    theta: Floats
    curvature: Floats


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
        """Return the likelihood with the sine transform for even steps, else elimination."""
        even = [i for i, t in enumerate(tracks) if t.steps.even and not t.drift]
        rest = sorted(set(range(len(tracks))) - set(even))
        found: list[StepKernel] = []
        if even:
            found.append(SineModes.of([tracks[i] for i in even], even))
        if rest:
            found.append(TridiagonalCovariance.of([tracks[i] for i in rest], rest))
        return cls(tuple(tracks), tuple(found))

    def apart(self) -> Likelihood:
        """Return the same likelihood with a D for every motion."""
        return replace(self, own=True)

    @cached_property
    def mean_square(self) -> Floats:
        """Mean square step of each motion: the scale of its theta."""
        square = np.array([np.mean(t.steps.vectors**2) for t in self.tracks])
        floor: Floats = np.maximum(square, _SMALLEST_STEP_RATIO * square.max())
        return floor

    @cached_property
    def scale(self) -> Floats:
        """D of each unit that explains all of its motion without noise."""
        moved = np.array([np.sum(t.steps.vectors**2) for t in self.tracks])
        spent = [2 * t.steps.vectors.shape[1] * np.sum(t.steps.duration) for t in self.tracks]
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
        """Sum over the motions that share a D."""
        return x if self.own else np.atleast_1d(x.sum())

    def sums(self, D: Floats, theta: Floats) -> GroupSlopes:
        """Evaluate all motions at the D of each unit and the theta of each motion."""
        D = D if len(D) == len(theta) else np.full(len(theta), D[0])
        if len(self.kernels) == 1:
            total = self.kernels[0].sums(D, theta)
        else:
            total = GroupSlopes(*np.empty((5, len(theta))))
            for kernel in self.kernels:
                part = kernel.sums(D[kernel.groups], theta[kernel.groups])
                for of_all, of_some in zip(total, part, strict=True):
                    of_all[kernel.groups] = of_some
        freedom, value = self.prior
        if freedom.any():
            # The residuals of the rigid fits: chi-squared with their degrees of freedom in theta.
            safe = np.maximum(theta, LEAST_EIGENVALUE)
            total.value[:] -= 0.5 * freedom * (np.log(safe) + value / safe)
            total.rise[:] += 0.5 * freedom * (value / safe) / safe
            total.fall[:] += 0.5 * freedom / safe
        return total

    def profile(
        self, D: Floats, near: ProfilePoint | None = None, tolerance: float = 1e-12
    ) -> ProfilePoint:
        """Maximise over theta at given D, starting from the theta and the curvature of `near`.

        Each theta is the root of its own rise less fall, all motions at once, by secant steps
        inside a shrinking bracket in log theta; the logarithm of rise over fall makes the secant
        nearly straight. Towards theta = 0 the root may not exist; the edge is then the answer.
        """
        square, fixed = self.mean_square, self.fixed
        some_fixed = bool(fixed.any())

        def theta_at(t: Floats) -> Floats:
            free = square * np.exp(t)
            return np.where(fixed, self.prior[1], free) if some_fixed else free

        def point(sums: GroupSlopes, theta: Floats, curvature: Floats) -> ProfilePoint:
            rise, fall = self.by_unit(sums.rise_D), self.by_unit(sums.fall_D)
            value, ratio = self.by_unit(sums.value), log_slope_ratio(rise, fall)
            return ProfilePoint(D, value, rise - fall, ratio, theta, curvature)

        if fixed.all():
            theta = self.prior[1]
            return point(self.sums(D, theta), theta, np.zeros_like(theta))
        low = np.full(len(square), _LEAST_LOG_OFFSET)
        high = np.full(len(square), _MOST_LOG_OFFSET)
        start = 0.5 * square if near is None else near.theta
        old = np.log(np.maximum(start / square, 1e-6))
        old_ratio = log_slope_ratio(*self.sums(D, theta_at(old))[3:])
        move = np.copysign(1e-3, old_ratio)
        if near is not None:
            steep = near.curvature < -0.01
            newton = np.divide(-old_ratio, near.curvature, out=move.copy(), where=steep)
            move = np.where(newton == 0, move, np.clip(newton, -1.0, 1.0))
        t = np.clip(old + move, low, high)
        curvature = np.full(len(square), np.nan)
        for _ in range(100):
            theta = theta_at(t)
            sums = self.sums(D, theta)
            ratio = log_slope_ratio(sums.rise, sums.fall)
            up, run = ratio > 0, t - old
            low, high = np.where(up, t, low), np.where(up, high, t)
            moved = np.abs(run)
            np.divide(ratio - old_ratio, run, out=curvature, where=moved > 1e-9)
            target = secant_trial(t, ratio, old, old_ratio, low, high)
            moves = np.minimum(np.abs(target - t), moved)
            done = (moves <= tolerance) | (high <= _LEAST_LOG_OFFSET) | fixed
            if done.all():
                break
            old, old_ratio, t = t, ratio, np.where(done, t, target)
        return point(sums, theta, curvature)

    def continued_profile(self, tolerance: float) -> Callable[[Floats], ProfilePoint]:
        """Return `profile` as a function of D that starts where its last two calls ended."""
        trail: list[ProfilePoint] = []

        def follow(D: Floats) -> ProfilePoint:
            near = trail[-1] if trail else None
            if len(trail) > 1 and not self.own and trail[-1].D[0] != trail[-2].D[0]:
                one, two = trail[-2:]
                ahead = (two.theta - one.theta) * (D - two.D) / (two.D - one.D)
                near = two._replace(theta=two.theta + ahead)
            trail.append(self.profile(D, near, tolerance))
            return trail[-1]

        return follow

    def best(self) -> ProfilePoint:
        """Return the D of greatest likelihood of every unit: the highest maximum, or 0.

        Short tracks can have several maxima, so the whole range is searched.
        """
        coarse, fine = self.continued_profile(1e-3), self.continued_profile(1e-12)
        best = np.zeros_like(self.scale)
        seen = [coarse(best)]
        for power in range(-7, 60):
            if power > 0 and np.all(seen[-1].slope <= 0):
                break
            seen.append(coarse(self.scale * 4.0**power))
        height = np.where(seen[0].slope <= 0, seen[0].value, -np.inf)
        # Brackets in which a unit's slope falls through zero, in the order of D; a unit that has
        # no more of them gets a bracket of length 0.
        D = np.array([p.D for p in seen])
        slope = np.array([p.log_ratio for p in seen])
        falls = (slope[:-1] > 0) & (slope[1:] <= 0)
        order, unit = np.argsort(~falls, axis=0, kind="stable"), np.arange(D.shape[1])
        for row in order[: int(falls.sum(axis=0).max(initial=0))]:
            low = D[row, unit]
            high = np.where(falls[row, unit], D[row + 1, unit], low)
            peak = self.maximum_between(low, high, fine)
            higher = (peak.value > height) & (high > low)
            best, height = np.where(higher, peak.D, best), np.where(higher, peak.value, height)
        return fine(best)

    def maximum_between(
        self, low: Floats, high: Floats, follow: Callable[[Floats], ProfilePoint]
    ) -> ProfilePoint:
        """Return the maximum of the profile between `low` and `high`, by bracketed secant steps.

        A unit whose `low` and `high` agree keeps that D.
        """
        first, last = follow(low), follow(high)
        old, peak = first, last
        for _ in range(200):
            D = peak.D
            low, high = np.where(peak.log_ratio > 0, D, low), np.where(peak.log_ratio > 0, high, D)
            target = secant_trial(D, peak.log_ratio, old.D, old.log_ratio, low, high)
            moves = np.minimum(np.abs(target - D), np.abs(D - old.D))
            done = (moves <= 1e-13 * np.abs(D)) | (high <= low)
            if done.all():
                break
            old, peak = peak, follow(np.where(done, D, target))
        return peak

    def interval(self, best: ProfilePoint, drop: float) -> tuple[float, float]:
        """Return where twice the profile log-likelihood has fallen by `drop`; 0 if it never has."""
        # At the maximum over theta the value is flat: half the digits of theta give all of its own.
        follow = self.continued_profile(1e-6)
        value, top = float(best.D[0]), float(best.value[0])

        def height(D: float) -> tuple[float, float]:
            peak = follow(np.array([D]))
            return float(peak.value[0]) - top + drop / 2, float(peak.slope[0])

        count = sum(t.steps.vectors.size for t in self.tracks)
        near = 0.02 * value if value else float(self.scale[0]) / count
        curvature = -height(value + near)[1] / near
        reach = np.sqrt(drop / curvature) if curvature > 0 else near
        high = newton_crossing(height, inside=value, start=value + reach, outside=np.inf)
        if value == 0 or height(0.0)[0] > 0:
            return 0.0, high
        return newton_crossing(height, inside=value, start=value - reach, outside=0.0), high

    def steady_motion(self, D: float, theta: Floats) -> tuple[Floats, Floats]:
        """Return the steady velocity or spin of every motion (G, p), lab axes, and its information.

        The information (G, p, p) is the inverse of the covariance at this D and theta.
        """
        kernel = next(k for k in self.kernels if isinstance(k, TridiagonalCovariance))
        mean, information = kernel.steady_motion(np.full(len(theta), D), theta)
        return mean + np.array([t.steady for t in self.tracks]), information

    def offsets(self, best: ProfilePoint) -> tuple[Floats, float]:
        """Return the noise offset of each motion, and the standard error of their mean.

        The observed information is arrow-shaped (one D, a theta for each motion); it comes from
        central differences of the slopes. NaN where a theta lies on its edge.
        """
        blur = np.array([t.blur for t in self.tracks])
        level = np.array([t.level for t in self.tracks])
        free = np.where(self.fixed, 0.0, best.theta)
        offset = free + level - blur * best.D
        D, theta, free = best.D, best.theta, ~self.fixed
        if D[0] == 0 or np.any(free & (theta <= 1e-3 * self.mean_square)):
            return offset, np.nan
        more, less = (self.sums(D, theta + k * 1e-4 * self.mean_square * free) for k in (1, -1))
        h_oo = (less.rise - less.fall - more.rise + more.fall) / (2e-4 * self.mean_square)
        more, less = (self.sums(D * (1 + k * 1e-4), theta) for k in (1, -1))
        slope_D = less.rise_D - less.fall_D - more.rise_D + more.fall_D
        slope_o = less.rise - less.fall - more.rise + more.fall
        h_DD, h_Do = (float(slope_D.sum()) / (2e-4 * D[0]), slope_o / (2e-4 * D[0]))
        turn = np.divide(h_Do, h_oo, out=np.zeros_like(h_Do), where=free)
        left = h_DD - float(np.sum(turn * h_Do))
        if left <= 0 or np.any(h_oo[free] <= 0):
            return offset, np.nan
        own = np.sum(1 / h_oo[free]) / len(offset) ** 2
        return offset, float(np.sqrt(own + np.mean(turn + blur) ** 2 / left))


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


def secant_trial(
    t: Floats, slope: Floats, old: Floats, old_slope: Floats, low: Floats, high: Floats
) -> Floats:
    """Return the next trial: the secant step, or the middle of the bracket where that leaves it.

    Examples
    --------
    >>> t, slope, old, old_slope, low, high = np.array([[1.0], [2.0], [0.0], [4.0], [1.0], [9.0]])
    >>> secant_trial(t, slope, old, old_slope, low, high)
    array([2.])
    """
    rise, run = slope - old_slope, t - old
    step = np.full(t.shape, np.nan)
    np.divide(slope * run, rise, out=step, where=rise * run < 0)
    target = t - step
    inside = (target > low) & (target < high)
    if inside.all():
        return np.asarray(target)
    # Where a falling slope does not cross zero, the maximum is at the edge.
    edge = _LEAST_LOG_OFFSET
    target = np.where((target <= low) & (low <= edge), edge, target)
    return np.where(inside | (target == edge), target, 0.5 * (low + high))


def newton_crossing(
    height: Callable[[float], tuple[float, float]], *, inside: float, start: float, outside: float
) -> float:
    """Return where a height falls through zero between `inside` (> 0) and `outside` (< 0).

    Newton steps, halved into the bracket, or doubled away from `inside` while there is no bracket.

    Examples
    --------
    >>> newton_crossing(lambda x: (2 - x * x, -2 * x), inside=1.0, start=3.0, outside=np.inf)
    1.414213562373095
    """
    x = start if min(inside, outside) < start < max(inside, outside) else (inside + outside) / 2
    for _ in range(200):
        value, slope = height(x)
        inside, outside = (x, outside) if value > 0 else (inside, x)
        middle = 2 * x if outside == np.inf else (inside + outside) / 2
        newton = x - value / slope if slope else np.nan
        within = min(inside, outside) < newton < max(inside, outside)
        old, x = x, newton if within else middle
        if abs(x - old) <= 1e-11 * abs(x):
            break
    return float(x)


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
    parts = [_squared_deviations(t, D, float(own)) for t, own in zip(tracks, theta, strict=True)]
    excess, scale = np.sum(parts, axis=0)
    return 1.0 + max(0.0, float(excess / scale)) if scale > 0 else 1.0


def _squared_deviations(track: NoisySteps, D: float, theta: float) -> tuple[float, float]:
    """Return sums over modes of the squared deviations, chance subtracted, and of their scale."""
    from scipy.fft import dst

    count, axes = track.steps.vectors.shape
    if axes == 1 or count < 5:
        return 0.0, 0.0
    c = difference_eigenvalues(count)
    weight, known = (
        np.mean([pair[0].mean(axis=0), pair[1].mean(axis=0)], axis=0)
        for pair in (track.weight, track.known)
    )
    noise = theta * weight + known
    # Uneven steps are taken as even ones of their mean duration: only a width depends on it.
    by_D, by_noise = 2 * (track.steps.duration.mean() - track.blur * c), 2 * c
    eigen = by_D * D + by_noise * noise.mean()
    if not np.all(eigen > 0):
        return 0.0, 0.0
    modes = dst(track.steps.vectors, type=1, norm="ortho", axis=0)
    powers = modes[:, :, None] * modes[:, None, :]
    powers -= by_noise[:, None, None] * np.diag(noise - noise.mean())
    powers -= np.trace(powers, axis1=1, axis2=2)[:, None, None] / axes * np.eye(axes)
    rows = np.stack([by_D, by_noise])
    fisher = np.linalg.inv((rows / eigen) @ (rows / eigen).T)
    found = np.einsum("kab,pk->pab", powers, fisher @ (rows / eigen**2))
    deviation = np.einsum("pab,pk->kab", found, rows)
    chance = (axes - 1) * (axes + 2) * np.einsum("pk,pq,qk->k", rows, fisher, rows)
    # Weights of the modes in the score of D with theta profiled out.
    score = by_D / eigen**2
    if np.isfinite(track.freedom):
        by_theta = by_noise * weight.mean()
        known_theta = track.freedom / (axes * theta**2) if theta > 0 else 0.0
        shared = np.sum(by_D * by_theta / eigen**2) / (
            np.sum((by_theta / eigen) ** 2) + known_theta
        )
        score = (by_D - shared * by_theta) / eigen**2
    excess = np.sum(score**2 * (np.sum(deviation**2, axis=(1, 2)) - chance))
    return float(excess), float(axes * np.sum((score * eigen) ** 2))
