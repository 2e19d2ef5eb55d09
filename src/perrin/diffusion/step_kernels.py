"""Covariance of noisy Brownian steps and its determinant and inverse, for even and uneven steps."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from perrin._arrays import Bools, Floats, Ints
    from perrin.diffusion.steps import Steps


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
