"""Which D and which noise explain noisy Brownian steps best: the likelihood and its maximum.

Step i of a motion has variance 2 D tau + o_i + o_{i+1} and covariance -o_{i+1} with the next one,
o = s - b D the noise variance s of a frame less what motion blur takes. s = weight theta + known:
theta is free (theta >= 0) or fixed, `known` is given. The determinants and inverses that this
needs are found by a sine transform where the steps are even, else by tridiagonal elimination.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from perrin._arrays import Bools, Floats, Ints
    from perrin.steps import Steps

# Lowest and highest logarithm of an offset theta in units of the mean square step. Without
# diffusion a long track needs an offset far above that.
_EDGE, _TOP = -30.0, 60.0

# A group of steps this much smaller (mean square) than another one's does not move at all.
_REST = 1e-24

_LEAST_RATIO = float(np.exp(-_TOP))

# Under every eigenvalue: zero noise and no diffusion give no density.
_TINY = 1e-100


@dataclass(frozen=True, eq=False)
class Track:
    """The steps of one motion with what is known of their noise.

    Attributes
    ----------
    steps : Steps
    weight : tuple of ndarray, shape (S, A)
        Noise variance of the frames before and after each step, per unit of theta.
    known : tuple of ndarray, shape (S, A)
        What is known of these variances.
    blur : float
        b of the offset s - b D, s.
    theta : float
        The value of a fixed theta, or the residuals' value of a free one.
    freedom : float
        Degrees of freedom behind that value: 0 knows nothing of theta, inf fixes it.
    level : float
        Mean of `known` over the frames that show the most particles.
    drift : bool
        Whether a steady velocity or spin is free; `steps` are then without their least-squares one.
    steady : ndarray, shape (p,)
        That one; zeros without drift.
    """

    steps: Steps
    weight: tuple[Floats, Floats]
    known: tuple[Floats, Floats]
    blur: float
    theta: float
    freedom: float
    level: float
    drift: bool = False
    steady: Floats = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def free(cls, steps: Steps, *, blur: float, drift: bool) -> Track:
        """Leave the offset free; known is by how much a frame exceeds the least noisy one."""
        steps, steady = _centred(steps, drift=drift)
        noise = [steps.sigma**2 * n for n in (steps.before, steps.after)]
        least = min(float(n.min()) for n in noise)
        one = np.ones_like(noise[0])
        known = noise[0] - least, noise[1] - least
        level = steps.sigma**2 * steps.complete - least
        return cls(steps, (one, one), known, blur, 0.0, 0.0, level, drift, steady)

    @classmethod
    def informed(cls, steps: Steps, *, blur: float, drift: bool) -> Track:
        """Let the rigid-fit residuals say what they know of the noise."""
        theta = steps.sigma**2 * steps.complete
        if theta == 0:
            return cls.fixed(steps, sigma=0.0, blur=blur, drift=drift)
        steps, steady = _centred(steps, drift=drift)
        weight = steps.before / steps.complete, steps.after / steps.complete
        none = np.zeros_like(weight[0])
        freedom = float(steps.freedom)
        return cls(steps, weight, (none, none), blur, theta, freedom, 0.0, drift, steady)

    @classmethod
    def fixed(cls, steps: Steps, *, sigma: float, blur: float, drift: bool) -> Track:
        """Take the localisation error sigma (um) as known."""
        steps, steady = _centred(steps, drift=drift)
        known = sigma**2 * steps.before, sigma**2 * steps.after
        none = np.zeros_like(known[0])
        level = sigma**2 * steps.complete
        return cls(steps, (none, none), known, blur, 0.0, np.inf, level, drift, steady)


def _centred(steps: Steps, *, drift: bool) -> tuple[Steps, Floats]:
    """Return the steps and their steady motion; without drift all of it stays in the steps."""
    return steps.without_steady_motion() if drift else (steps, np.zeros(steps.steady.shape[2]))


class Sums(NamedTuple):
    """The log-likelihood of every group and its slopes, each as a rise less a fall, (G,) each."""

    value: Floats
    rise_D: Floats
    fall_D: Floats
    rise: Floats
    fall: Floats


class _Kernel(Protocol):
    """A way to evaluate some of the groups; `groups` are their numbers."""

    @property
    def groups(self) -> Ints: ...

    def sums(self, D: Floats, theta: Floats) -> Sums: ...


def _by_group(starts: Ints, rows: Sequence[Floats]) -> Sums:
    return Sums(*[np.add.reduceat(row, starts) for row in rows])


@dataclass(frozen=True, eq=False)
class _Sines:
    """Even tracks: a sine transform makes their covariance diagonal.

    Eigenvalue k is 2 D (tau - b c_k) + 2 (weight theta + known) c_k, c_k = 1 - cos(k pi/N); axes
    with the same noise add up their powers.
    """

    groups: Ints
    starts: Ints
    which: Ints
    power: Floats
    count: Floats
    by_D: Floats
    by_theta: Floats
    given: Floats

    @classmethod
    def of(cls, tracks: Sequence[Track], groups: Sequence[int]) -> _Sines:
        rows = [_modes(track) for track in tracks]
        sizes = [row.shape[1] for row in rows]
        power, count, by_D, by_theta, given = np.concatenate(rows, axis=1)
        starts = np.cumsum([0, *sizes[:-1]])
        which = np.repeat(np.arange(len(groups)), sizes)
        return cls(np.array(groups), starts, which, power, count, by_D, by_theta, given)

    def sums(self, D: Floats, theta: Floats) -> Sums:
        if len(self.groups) == 1:
            eigen = D * self.by_D + theta * self.by_theta + self.given
        else:
            eigen = D[self.which] * self.by_D + theta[self.which] * self.by_theta + self.given
        np.maximum(eigen, _TINY, out=eigen)
        fall = self.count / eigen
        ratio = self.power / eigen
        rise = ratio / eigen
        value = -0.5 * (self.count * np.log(eigen) + ratio)
        by_D, by_theta = 0.5 * self.by_D, 0.5 * self.by_theta
        rows = (value, by_D * rise, by_D * fall, by_theta * rise, by_theta * fall)
        return _by_group(self.starts, rows)


def _modes(track: Track) -> Floats:
    """Return powers, axes added up, and the eigenvalue's parts by D, by theta and known, (5, M)."""
    from scipy.fft import dst

    s = track.steps
    c = 1 - np.cos(np.pi * np.arange(1, len(s.size) + 1) / (len(s.size) + 1))
    power = dst(s.size, type=1, norm="ortho", axis=0) ** 2
    weight, known = track.weight[0][0], track.known[0][0]
    columns = []
    for axes in _alike(np.stack([weight, known])):
        columns.append(
            np.stack(
                [
                    power[:, axes].sum(axis=1),
                    np.full(len(c), float(len(axes))),
                    2 * (s.duration[0] - track.blur * c),
                    2 * weight[axes[0]] * c,
                    2 * known[axes[0]] * c,
                ]
            )
        )
    return np.concatenate(columns, axis=1)


def _alike(noise: Floats) -> list[Ints]:
    """Group the columns of (M, A) that are the same to rounding."""
    scale = 1e-9 * np.abs(noise).max(axis=1, keepdims=True)
    free, found = np.arange(noise.shape[1]), []
    while free.size:
        same = np.all(np.abs(noise[:, free] - noise[:, free[:1]]) <= scale, axis=0)
        found.append(free[same])
        free = free[~same]
    return found


@dataclass(frozen=True, eq=False)
class _Tridiagonal:
    """Any tracks: their axes stacked to one tridiagonal system, solved by LAPACK.

    Axes with the same noise are one block with several columns y (missing ones are 0; `count` says
    how many there are). The inverse of a tridiagonal matrix has the diagonal 1/(d + d' - a), d and
    d' being the pivots of the elimination from above and from below, and
    Z_{i,i+1} = -l_i Z_{i+1,i+1}.
    With a free steady motion the likelihood is the restricted one (REML): with U = C^-1 X for the
    effect X of the steady motion on the steps, and G = X^T U, C^-1 becomes C^-1 - U G^-1 U^T.
    """

    groups: Ints
    starts: Ints
    which: Ints
    count: Floats
    y: Floats
    tau: Floats
    linked: Floats
    blur: Floats
    weight: tuple[Floats, Floats]
    known: tuple[Floats, Floats]
    steady: Floats | None

    @classmethod
    def of(cls, tracks: Sequence[Track], groups: Sequence[int]) -> _Tridiagonal:
        blocks = [(i, axes) for i, t in enumerate(tracks) for axes in _same_noise(t)]
        lengths = [len(tracks[i].steps.size) for i, _ in blocks]
        starts = np.cumsum([0, *lengths[:-1]])
        group = np.array([i for i, _ in blocks])
        y = np.zeros((sum(lengths), max(len(axes) for _, axes in blocks)), order="F")
        for start, length, (i, axes) in zip(starts, lengths, blocks, strict=True):
            y[start : start + length, : len(axes)] = tracks[i].steps.size[:, axes]
        steady = None
        if any(t.drift for t in tracks):
            steady = np.zeros((*y.shape, tracks[0].steps.steady.shape[2]))
            for start, length, (i, axes) in zip(starts, lengths, blocks, strict=True):
                steady[start : start + length, : len(axes)] = tracks[i].steps.steady[:, axes]

        def noise(part: Callable[[Track], Floats]) -> Floats:
            return np.concatenate([part(tracks[i])[:, axes[0]] for i, axes in blocks])

        def stacked(part: Callable[[Track], Floats | Bools]) -> Floats:
            rows = [part(tracks[i]) for i, _ in blocks]
            return np.asarray(np.concatenate(rows), dtype=np.float64)

        return cls(
            groups=np.array(groups),
            starts=starts[np.flatnonzero(np.diff(group, prepend=-1))],
            which=np.repeat(group, lengths),
            count=np.repeat([float(len(axes)) for _, axes in blocks], lengths),
            y=y,
            tau=stacked(lambda t: t.steps.duration),
            linked=stacked(lambda t: t.steps.linked),
            blur=np.array([t.blur for t in tracks]),
            weight=(noise(lambda t: t.weight[0]), noise(lambda t: t.weight[1])),
            known=(noise(lambda t: t.known[0]), noise(lambda t: t.known[1])),
            steady=steady,
        )

    def sums(self, D: Floats, theta: Floats) -> Sums:
        solved = self._solved(D, theta)
        if solved is None:
            nothing = np.zeros(len(self.groups))
            return Sums(nothing - np.inf, nothing + 1.0, nothing, nothing + 1.0, nothing)
        value, square, cross, inverse, corner = solved
        blur = self._spread_groups(self.blur)
        through, half = self.tau - blur, 0.5 * (self.weight[0] + self.weight[1])
        shared = self.linked * self.weight[1]
        rows = (
            value,
            through * square + blur * cross,
            through * inverse + blur * corner,
            half * square - shared * cross,
            half * inverse - shared * corner,
        )
        return _by_group(self.starts, rows)

    def _solved(
        self, D: Floats, theta: Floats
    ) -> tuple[Floats, Floats, Floats, Floats, Floats] | None:
        """Return the value by step, z z and C^-1 on and beside the diagonal, z = C^-1 y.

        All are summed over the columns of a block.
        """
        from scipy.linalg.lapack import dpttrf, dpttrs

        a, b = self._bands(D, theta)
        d, lower, bad = dpttrf(a, b)
        up, _, bad_up = dpttrf(a[::-1], b[::-1])
        if bad or bad_up:
            return None
        z, _ = dpttrs(d, lower, self.y)
        inverse = 1 / (d + up[::-1] - a)
        corner = self._beside(-lower * inverse[1:])
        value = -0.5 * self.count * np.log(d)
        inverse, corner = self.count * inverse, self.count * corner
        if self.steady is not None:
            unit, gram, mean = self._steady_motion(d, lower)
            z = z - np.einsum("rcp,rp->rc", unit, mean[self.which])
            value[self.starts] -= 0.5 * np.linalg.slogdet(gram)[1]
            shared = unit @ np.linalg.inv(gram)[self.which]
            inverse = inverse - np.einsum("rcp,rcp->r", shared, unit)
            corner = corner - self._beside(np.einsum("rcp,rcp->r", shared[:-1], unit[1:]))
        value -= 0.5 * np.einsum("rc,rc->r", self.y, z)
        square, cross = np.einsum("rc,rc->r", z, z), np.einsum("rc,rc->r", z[:-1], z[1:])
        return value, square, self._beside(cross), inverse, corner

    def _steady_motion(self, d: Floats, lower: Floats) -> tuple[Floats, Floats, Floats]:
        """Return U = C^-1 X (rows, c, p), G = X^T U (G, p, p) and G^-1 U^T y (G, p)."""
        from scipy.linalg.lapack import dpttrs

        x = self.steady
        if x is None:
            raise ValueError("these tracks have no free steady motion")
        unit = dpttrs(d, lower, x.reshape(len(x), -1))[0].reshape(x.shape)
        gram = np.add.reduceat(np.swapaxes(x, -1, -2) @ unit, self.starts)
        right = np.add.reduceat(np.einsum("rcp,rc->rp", unit, self.y), self.starts)
        return unit, gram, np.linalg.solve(gram, right[..., None])[..., 0]

    def steady_motion(self, D: Floats, theta: Floats) -> tuple[Floats, Floats]:
        """Return the steady motion (G, p) of every track and its inverse covariance (G, p, p)."""
        from scipy.linalg.lapack import dpttrf

        d, lower, _ = dpttrf(*self._bands(D, theta))
        _, gram, mean = self._steady_motion(d, lower)
        return mean, gram

    def _bands(self, D: Floats, theta: Floats) -> tuple[Floats, Floats]:
        """Return the diagonal of the covariance of all steps and the one beside it."""
        D, theta, blur = (self._spread_groups(x) for x in (D, theta, self.blur))
        return covariance_bands(
            D, theta, self.tau, self.linked, blur=blur, weight=self.weight, known=self.known
        )

    def _spread_groups(self, x: Floats) -> Floats:
        """Return a number of each group at every step; one number where there is one group."""
        return x if len(x) == 1 else x[self.which]

    def _beside(self, product: Floats) -> Floats:
        padded: Floats = self.linked * np.append(product, 0.0)
        return padded


def covariance_bands(
    D: Floats | float,
    theta: Floats | float,
    tau: Floats,
    linked: Floats | Bools,
    *,
    blur: Floats | float,
    weight: tuple[Floats, Floats],
    known: tuple[Floats, Floats],
) -> tuple[Floats, Floats]:
    """Return the diagonal of the covariance of steps and the one beside it, along the first axis.

    The variance is 2 D tau + o_before + o_after and the covariance with the next step -o_after,
    o = weight theta + known - blur D.
    """
    before, after = (w * theta + k - blur * D for w, k in zip(weight, known, strict=True))
    return 2 * D * tau + before + after, -(after * linked)[:-1]


def _same_noise(track: Track) -> list[Ints]:
    """Group the axes of a track whose noise is the same in every frame."""
    parts = np.concatenate([*track.weight, *track.known])
    return _alike(parts)


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
