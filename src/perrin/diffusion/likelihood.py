"""Which D and which noise explain noisy Brownian steps best: the likelihood and its maximum.

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

from perrin.diffusion.step_kernels import _TINY, Sums, Track, _Kernel, _Sines, _Tridiagonal

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from perrin._arrays import Bools, Floats


# Lowest and highest logarithm of an offset theta in units of the mean square step. Without
# diffusion a long track needs an offset far above that.
_EDGE, _TOP = -30.0, 60.0


# A group of steps this much smaller (mean square) than another one's does not move at all.
_REST = 1e-24


_LEAST_RATIO = float(np.exp(-_TOP))


class Peak(NamedTuple):
    """A point of the ridge: the likelihood maximised over theta at given D.

    `slope` is that of the value in D and `tilt` the logarithm of its rise over its fall; `bend` is
    how fast the tilt of theta changed with log theta, where the next search begins.
    """

    D: Floats
    value: Floats
    slope: Floats
    tilt: Floats
    theta: Floats
    bend: Floats


@dataclass(frozen=True, eq=False)
class Likelihood:
    """The likelihood of the steps of several motions (groups), theta profiled out.

    With `own` every group has a D of its own, else they share one; arrays over "units" have the
    length of the number of different D.
    """

    tracks: tuple[Track, ...]
    kernels: tuple[_Kernel, ...]
    own: bool = False

    @classmethod
    def of(cls, tracks: Sequence[Track]) -> Likelihood:
        """Give the even tracks and the rest their kernels."""
        even = [i for i, t in enumerate(tracks) if t.steps.even and not t.drift]
        rest = sorted(set(range(len(tracks))) - set(even))
        found: list[_Kernel] = []
        if even:
            found.append(_Sines.of([tracks[i] for i in even], even))
        if rest:
            found.append(_Tridiagonal.of([tracks[i] for i in rest], rest))
        return cls(tuple(tracks), tuple(found))

    def apart(self) -> Likelihood:
        """Return the same likelihood with a D for every group."""
        return replace(self, own=True)

    @cached_property
    def _power(self) -> Floats:
        """Mean square step of each group: the scale of its theta."""
        power = np.array([np.mean(t.steps.size**2) for t in self.tracks])
        floor: Floats = np.maximum(power, _REST * power.max())
        return floor

    @cached_property
    def scale(self) -> Floats:
        """Return the D of each unit that explains all of its motion without noise."""
        moved = np.array([np.sum(t.steps.size**2) for t in self.tracks])
        spent = [2 * t.steps.size.shape[1] * np.sum(t.steps.duration) for t in self.tracks]
        return self._units(moved) / self._units(np.array(spent))

    @cached_property
    def _known(self) -> Bools:
        return np.array([np.isinf(t.freedom) for t in self.tracks])

    @cached_property
    def _prior(self) -> tuple[Floats, Floats]:
        """Degrees of freedom and value of theta from the residuals; none where it is fixed."""
        freedom = np.array([t.freedom for t in self.tracks])
        return np.where(self._known, 0.0, freedom), np.array([t.theta for t in self.tracks])

    def _units(self, x: Floats) -> Floats:
        """Sum over the groups that share a D."""
        return x if self.own else np.atleast_1d(x.sum())

    def sums(self, D: Floats, theta: Floats) -> Sums:
        """Evaluate all groups at the D of each unit and the theta of each group."""
        D = D if len(D) == len(theta) else np.full(len(theta), D[0])
        if len(self.kernels) == 1:
            total = self.kernels[0].sums(D, theta)
        else:
            total = Sums(*np.empty((5, len(theta))))
            for kernel in self.kernels:
                part = kernel.sums(D[kernel.groups], theta[kernel.groups])
                for whole, piece in zip(total, part, strict=True):
                    whole[kernel.groups] = piece
        freedom, value = self._prior
        if freedom.any():
            # What rigid-fit residuals know of theta: chi-squared with their degrees of freedom.
            safe = np.maximum(theta, _TINY)
            total.value[:] -= 0.5 * freedom * (np.log(safe) + value / safe)
            total.rise[:] += 0.5 * freedom * (value / safe) / safe
            total.fall[:] += 0.5 * freedom / safe
        return total

    def ridge(self, D: Floats, near: Peak | None = None, tolerance: float = 1e-12) -> Peak:
        """Maximise over theta at given D, starting from the theta and the bend of `near`.

        Each theta is the root of its own rise less fall, all groups at once, by secant steps
        inside a shrinking bracket in log theta; the logarithm of rise over fall makes the secant
        nearly straight. Towards theta = 0 the root may not exist; the edge is then the answer.
        """
        power, known = self._power, self._known
        if known.all():
            theta = self._prior[1]
            return self._peak(D, self.sums(D, theta), theta, np.zeros_like(theta))
        low, high = np.full(len(power), _EDGE), np.full(len(power), _TOP)
        start = 0.5 * power if near is None else near.theta
        old = np.log(np.maximum(start / power, 1e-6))
        old_tilt = _tilt(*self.sums(D, self._theta(old))[3:])
        move = np.copysign(1e-3, old_tilt)
        if near is not None:
            newton = np.divide(-old_tilt, near.bend, out=move.copy(), where=near.bend < -0.01)
            move = np.where(newton == 0, move, np.clip(newton, -1.0, 1.0))
        t = np.clip(old + move, low, high)
        bend = np.full(len(power), np.nan)
        for _ in range(100):
            theta = self._theta(t)
            sums = self.sums(D, theta)
            tilt = _tilt(sums.rise, sums.fall)
            low, high = np.where(tilt > 0, t, low), np.where(tilt > 0, high, t)
            np.divide(tilt - old_tilt, t - old, out=bend, where=np.abs(t - old) > 1e-9)
            target = _secant(t, tilt, old, old_tilt, low, high)
            moves = np.minimum(np.abs(target - t), np.abs(t - old))
            done = (moves <= tolerance) | (high <= _EDGE) | known
            if done.all():
                break
            old, old_tilt, t = t, tilt, np.where(done, t, target)
        return self._peak(D, sums, theta, bend)

    def _theta(self, t: Floats) -> Floats:
        return np.where(self._known, self._prior[1], self._power * np.exp(t))

    def _peak(self, D: Floats, sums: Sums, theta: Floats, bend: Floats) -> Peak:
        rise, fall = self._units(sums.rise_D), self._units(sums.fall_D)
        return Peak(D, self._units(sums.value), rise - fall, _tilt(rise, fall), theta, bend)

    def _follower(self, tolerance: float) -> Callable[[Floats], Peak]:
        """Return `ridge` as a function of D that starts from where its last two calls ended."""
        trail: list[Peak] = []

        def follow(D: Floats) -> Peak:
            near = trail[-1] if trail else None
            if len(trail) > 1 and not self.own and trail[-1].D[0] != trail[-2].D[0]:
                one, two = trail[-2:]
                ahead = (two.theta - one.theta) * (D - two.D) / (two.D - one.D)
                near = two._replace(theta=two.theta + ahead)
            trail.append(self.ridge(D, near, tolerance))
            return trail[-1]

        return follow

    def best(self) -> Peak:
        """Return the D of greatest likelihood of every unit: the highest top of its ridge, or 0.

        Short tracks can have several tops, so the whole range is searched.
        """
        coarse, fine = self._follower(1e-3), self._follower(1e-12)
        best = np.zeros_like(self.scale)
        seen = [coarse(best)]
        for power in range(-7, 60):
            if power > 0 and np.all(seen[-1].slope <= 0):
                break
            seen.append(coarse(self.scale * 4.0**power))
        height = np.where(seen[0].slope <= 0, seen[0].value, -np.inf)
        for low, high in _falls(seen):
            peak = self._root(fine, low, high)
            higher = (peak.value > height) & (high > low)
            best, height = np.where(higher, peak.D, best), np.where(higher, peak.value, height)
        return fine(best)

    def _root(self, follow: Callable[[Floats], Peak], low: Floats, high: Floats) -> Peak:
        """Return the top of the ridge between `low` and `high`; units where they agree rest."""
        first, last = follow(low), follow(high)
        old, peak = first, last
        for _ in range(200):
            D = peak.D
            low, high = np.where(peak.tilt > 0, D, low), np.where(peak.tilt > 0, high, D)
            target = _secant(D, peak.tilt, old.D, old.tilt, low, high)
            moves = np.minimum(np.abs(target - D), np.abs(D - old.D))
            done = (moves <= 1e-13 * np.abs(D)) | (high <= low)
            if done.all():
                break
            old, peak = peak, follow(np.where(done, D, target))
        return peak

    def interval(self, best: Peak, drop: float) -> tuple[float, float]:
        """Return where twice the profile log-likelihood has fallen by `drop`; 0 if it never has."""
        # The height is flat in theta on the ridge: half the digits of theta give all of its own.
        follow = self._follower(1e-6)
        value, top = float(best.D[0]), float(best.value[0])

        def height(D: float) -> tuple[float, float]:
            peak = follow(np.array([D]))
            return float(peak.value[0]) - top + drop / 2, float(peak.slope[0])

        count = sum(t.steps.size.size for t in self.tracks)
        near = 0.02 * value if value else float(self.scale[0]) / count
        curvature = -height(value + near)[1] / near
        reach = np.sqrt(drop / curvature) if curvature > 0 else near
        high = _crossing(height, inside=value, start=value + reach, outside=np.inf)
        if value == 0 or height(0.0)[0] > 0:
            return 0.0, high
        return _crossing(height, inside=value, start=value - reach, outside=0.0), high

    def steady_motion(self, best: Peak) -> tuple[Floats, Floats]:
        """Return the steady velocity or spin of every group (G, p), lab axes, and its information.

        The information (G, p, p) is the inverse of the covariance at the D and noise of `best`.
        """
        kernel = next(k for k in self.kernels if isinstance(k, _Tridiagonal))
        mean, gram = kernel.steady_motion(np.full(len(best.theta), best.D[0]), best.theta)
        return mean + np.array([t.steady for t in self.tracks]), gram

    def steady_motion_at(self, D: float, theta: float) -> tuple[Floats, Floats]:
        """Return the steady motion (p,) of a single track at D and theta, and its information."""
        kernel = next(k for k in self.kernels if isinstance(k, _Tridiagonal))
        mean, gram = kernel.steady_motion(np.array([D]), np.array([theta]))
        return mean[0] + self.tracks[0].steady, gram[0]

    def offsets(self, best: Peak) -> tuple[Floats, float]:
        """Return the noise offset of each group, and the standard error of their mean.

        The observed information is arrow-shaped (one D, a theta for each group); it comes from
        central differences of the slopes. NaN where a theta lies on its edge.
        """
        blur = np.array([t.blur for t in self.tracks])
        level = np.array([t.level for t in self.tracks])
        free = np.where(self._known, 0.0, best.theta)
        offset = free + level - blur * best.D
        D, theta, free = best.D, best.theta, ~self._known
        if D[0] == 0 or np.any(free & (theta <= 1e-3 * self._power)):
            return offset, np.nan
        more, less = (self.sums(D, theta + k * 1e-4 * self._power * free) for k in (1, -1))
        h_oo = (less.rise - less.fall - more.rise + more.fall) / (2e-4 * self._power)
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


def _falls(seen: Sequence[Peak]) -> list[tuple[Floats, Floats]]:
    """Return the brackets in which a unit's slope falls through zero, the first of each unit first.

    A unit that has no more of them rests at one point.
    """
    D = np.array([p.D for p in seen])
    slope = np.array([p.tilt for p in seen])
    falls = (slope[:-1] > 0) & (slope[1:] <= 0)
    order = np.argsort(~falls, axis=0, kind="stable")
    found = []
    for layer in range(int(falls.sum(axis=0).max(initial=0))):
        row = order[layer]
        unit = np.arange(D.shape[1])
        here = falls[row, unit]
        low = D[row, unit]
        found.append((low, np.where(here, D[row + 1, unit], low)))
    return found


def _tilt(rise: Floats, fall: Floats) -> Floats:
    """Return the logarithm of rise over fall; where nothing moves it is downhill."""
    ratio = rise / np.maximum(fall, _TINY)
    return np.asarray(np.log(np.minimum(np.maximum(ratio, _LEAST_RATIO), 1 / _LEAST_RATIO)))


def _secant(
    t: Floats, slope: Floats, old: Floats, old_slope: Floats, low: Floats, high: Floats
) -> Floats:
    """Return the next trial: the secant step, or the middle of the bracket where that leaves it."""
    rise, run = slope - old_slope, t - old
    step = np.divide(slope * run, rise, out=np.full_like(t, np.nan), where=rise != 0)
    target = np.where(rise * run < 0, t - step, np.nan)
    inside = (target > low) & (target < high)
    # Falling slopes that never cross zero lead down to the edge, which is then the answer.
    target = np.where((target <= low) & (low <= _EDGE), _EDGE, target)
    return np.where(inside | (target == _EDGE), target, 0.5 * (low + high))


def _crossing(
    height: Callable[[float], tuple[float, float]], *, inside: float, start: float, outside: float
) -> float:
    """Return where a height falls through zero between `inside` (> 0) and `outside` (< 0).

    Newton steps, halved into the bracket, or doubled away from `inside` while there is no bracket.
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


def excess_scatter(tracks: Sequence[Track], D: float, theta: Floats) -> float:
    """Return the factor by which unequal axes raise the variance of their common D.

    The likelihood of one D for all axes finds the mean over axes (trace/3) whatever the tensor is,
    for the deviations of the axes cancel in its score. They do not cancel in the score's variance,
    which in sine mode k is sum_ab Lambda_ab^2 over A lambda^2 times that of equal axes. The
    deviations of D and of the noise are fitted to the cross powers of the axes, and what chance
    alone puts there is taken off: equal axes give 1 on average.

    Parameters
    ----------
    tracks : sequence of Track
        Of one quantity.
    D : float
    theta : ndarray, shape (G,)
        Noise of each track, as the likelihood found it.

    Returns
    -------
    float
        At least 1.
    """
    parts = [_excess(track, D, float(t)) for track, t in zip(tracks, theta, strict=True)]
    excess, scale = np.sum(parts, axis=0)
    return 1.0 + max(0.0, float(excess / scale)) if scale > 0 else 1.0


def _excess(track: Track, D: float, theta: float) -> tuple[float, float]:
    """Return sums over modes of the squared deviations, chance taken off, and of their scale."""
    count, axes = track.steps.size.shape
    if axes == 1 or count < 5:
        return 0.0, 0.0
    c = 1 - np.cos(np.pi * np.arange(1, count + 1) / (count + 1))
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
    rows = np.stack([by_D, by_noise])
    seen = _cross_powers(track.steps.size) - by_noise[:, None, None] * np.diag(noise - noise.mean())
    seen -= np.trace(seen, axis1=1, axis2=2)[:, None, None] / axes * np.eye(axes)
    fisher = np.linalg.inv((rows / eigen) @ (rows / eigen).T)
    found = np.einsum("kab,pk->pab", seen, fisher @ (rows / eigen**2))
    deviation = np.einsum("pab,pk->kab", found, rows)
    chance = (axes - 1) * (axes + 2) * np.einsum("pk,pq,qk->k", rows, fisher, rows)
    score = _score(track, theta, by_D, by_noise * weight.mean(), eigen)
    excess = np.sum(score**2 * (np.sum(deviation**2, axis=(1, 2)) - chance))
    return float(excess), float(axes * np.sum((score * eigen) ** 2))


def _cross_powers(size: Floats) -> Floats:
    """Return the products of the axes' sine transforms, (M, A, A)."""
    from scipy.fft import dst

    modes = dst(size, type=1, norm="ortho", axis=0)
    return np.asarray(modes[:, :, None] * modes[:, None, :])


def _score(track: Track, theta: float, by_D: Floats, by_theta: Floats, eigen: Floats) -> Floats:
    """Return the weights of the modes in the score of D with theta profiled out."""
    if np.isinf(track.freedom):
        return by_D / eigen**2
    axes = track.steps.size.shape[1]
    known = track.freedom / (axes * theta**2) if theta > 0 else 0.0
    shared = np.sum(by_D * by_theta / eigen**2) / (np.sum((by_theta / eigen) ** 2) + known)
    return np.asarray((by_D - shared * by_theta) / eigen**2)
