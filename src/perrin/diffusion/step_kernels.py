"""Covariance of noisy Brownian steps and its determinant and inverse, for even and uneven steps."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from perrin._arrays import frozen
from perrin.compiled.loading import compiled_kernels

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from perrin._arrays import Bools, Floats, Ints
    from perrin.diffusion.steps import NoisySteps

# Lower bound of every eigenvalue: zero noise and no diffusion give no density.
LEAST_EIGENVALUE = 1e-100


@lru_cache(maxsize=8)
def difference_eigenvalues(n_steps: int) -> Floats:
    """Return 1 - cos(k pi/(N + 1)) for k = 1..N, the noise of N even steps by sine mode.

    The noise of independent frames, of variance 1, gives N steps the covariance 2 on the diagonal
    and -1 next to it, the second difference. Its eigenvectors are the modes of the sine transform
    (DST-I), and these numbers are half its eigenvalues.

    Examples
    --------
    >>> difference_eigenvalues(2)
    array([0.5, 1.5])
    """
    values = np.asarray(1 - np.cos(np.pi * np.arange(1, n_steps + 1) / (n_steps + 1)))
    frozen(values)
    return values


class GroupSlopes(NamedTuple):
    """The log-likelihood of every motion and its slopes, each slope as a rise less a fall.

    All arrays have the shape (..., G) of the theta at which they were evaluated.

    Attributes
    ----------
    value : ndarray
        Log-likelihood of each motion.
    rise_D, fall_D : ndarray
        Positive and negative part of the slope in D.
    rise, fall : ndarray
        Positive and negative part of the slope in theta.
    rise_DD, rise_Do, rise_oo : ndarray
        Slopes of `rise_D` in D and in theta, and of `rise` in theta.
    fall_DD, fall_Do, fall_oo : ndarray
        The same of the negative parts.
    """

    value: Floats
    rise_D: Floats
    fall_D: Floats
    rise: Floats
    fall: Floats
    rise_DD: Floats
    rise_Do: Floats
    rise_oo: Floats
    fall_DD: Floats
    fall_Do: Floats
    fall_oo: Floats

    @classmethod
    def impossible(cls, shape: tuple[int, ...]) -> GroupSlopes:
        """Return the likelihood 0 of steps with a covariance that is not positive definite."""
        zero = np.zeros(shape)
        return cls(zero - np.inf, zero + 1, zero, zero + 1, *[zero] * 7)


class StepKernel(Protocol):
    """A way to evaluate the likelihood of some of the motions; `groups` are their numbers."""

    @property
    def groups(self) -> Ints:
        """Numbers of the motions."""

    @property
    def size(self) -> int:
        """Number of terms of one evaluation."""

    @property
    def rough(self) -> StepKernel:
        """The same likelihood to 1 %, where that is faster."""

    def sums(self, D: Floats, theta: Floats) -> GroupSlopes:
        """Evaluate all motions at the D and the theta of each, (..., G)."""

    def steady_motion(self, D: Floats, theta: Floats) -> tuple[Floats, Floats]:
        """Return the steady motion (G, p) of every track and its inverse covariance (G, p, p)."""


def equal_columns(noise: Floats) -> list[Ints]:
    """Return the columns of (M, A) in groups that are equal to rounding.

    Examples
    --------
    >>> equal_columns(np.array([[1.0, 2.0, 1.0]]))
    [array([0, 2]), array([1])]
    """
    scale = 1e-9 * np.abs(noise).max(axis=1, keepdims=True)
    free, found = np.arange(noise.shape[1]), []
    while free.size:
        same = np.all(np.abs(noise[:, free] - noise[:, free[:1]]) <= scale, axis=0)
        found.append(free[same])
        free = free[~same]
    return found


@dataclass(frozen=True, eq=False)
class SineModes:
    """Even steps: a sine transform makes their covariance diagonal.

    Eigenvalue k is 2 D (tau - b c_k) + 2 (weight theta + known) c_k, c_k = 1 - cos(k pi/(N + 1))
    for N steps; the powers of axes with the same noise are added. All modes of all motions follow
    one another, (M,). A free steady motion makes the likelihood the restricted one (REML), as in
    `TridiagonalCovariance`: its effect on mode k is X_k, and sums over the modes of X_k^T X_k and
    X_k^T y_k, with the weights of the other sums, are all that it needs.

    Attributes
    ----------
    groups : ndarray of int
        Number of each motion.
    starts : ndarray of int
        First mode of each motion.
    which : ndarray of int, shape (M,)
        Motion to which each mode belongs, counted among these.
    power : ndarray, shape (M,)
        Squared amplitude of each mode, summed over axes.
    count : ndarray, shape (M,)
        Number of those axes.
    by_D, by_theta, given : ndarray, shape (M,)
        Slopes of the eigenvalue in D and in theta, and its known part.
    steady : tuple of ndarray, shapes (p, p, M) and (p, M), or None
        X_k^T X_k and X_k^T y_k of a free steady motion, summed over axes.
    """

    groups: Ints
    starts: Ints
    which: Ints
    power: Floats
    count: Floats
    by_D: Floats
    by_theta: Floats
    given: Floats
    steady: tuple[Floats, Floats] | None = None

    @classmethod
    def of(cls, tracks: Sequence[NoisySteps], groups: Sequence[int]) -> SineModes:
        """Transform the steps of these motions, which have these numbers."""
        from scipy.fft import dst

        if len({(t.steps.vectors.shape, t.drift) for t in tracks}) == 1:
            noise = np.stack([[t.weight[0][0], t.known[0][0]] for t in tracks])
            scale = 1e-9 * np.abs(noise).max(axis=2, keepdims=True)
            if (np.abs(noise - noise[..., :1]) <= scale).all():
                return cls.of_equal_axes(tracks, groups)
        rows = []
        squares, products = [], []
        for track in tracks:
            s = track.steps
            c = difference_eigenvalues(len(s.vectors))
            modes = dst(s.vectors, type=1, norm="ortho", axis=0)
            power = modes**2
            weight, known = track.weight[0][0], track.known[0][0]
            alike = equal_columns(np.stack([weight, known]))
            if track.drift:
                effect = dst(s.steady, type=1, norm="ortho", axis=0)
                for axes in alike:
                    some = effect[:, axes]
                    squares.append(np.einsum("kap,kaq->pqk", some, some))
                    products.append(np.einsum("kap,ka->pk", some, modes[:, axes]))
            columns = [
                np.stack(
                    [
                        power[:, axes].sum(axis=1),
                        np.full(len(c), float(len(axes))),
                        2 * (s.duration[0] - track.blur * c),
                        2 * weight[axes[0]] * c,
                        2 * known[axes[0]] * c,
                    ]
                )
                for axes in alike
            ]
            rows.append(np.concatenate(columns, axis=1))
        sizes = [row.shape[1] for row in rows]
        power, count, by_D, by_theta, given = np.concatenate(rows, axis=1)
        starts = np.cumsum([0, *sizes[:-1]])
        which = np.repeat(np.arange(len(groups)), sizes)
        steady = None
        if squares:
            steady = np.concatenate(squares, axis=-1), np.concatenate(products, axis=-1)
        return cls(np.array(groups), starts, which, power, count, by_D, by_theta, given, steady)

    @classmethod
    def of_equal_axes(cls, tracks: Sequence[NoisySteps], groups: Sequence[int]) -> SineModes:
        """Transform equally many steps of each motion, whose axes are equally noisy, as `of`."""
        from scipy.fft import dst

        count, axes = tracks[0].steps.vectors.shape
        c = difference_eigenvalues(count)
        # Modes last: sums over three neighbouring numbers take nine times as long.
        modes = dst(np.stack([t.steps.vectors.T for t in tracks]), type=1, norm="ortho", axis=2)
        duration, blur, weight, known = np.array(
            [(t.steps.duration[0], t.blur, t.weight[0][0, 0], t.known[0][0, 0]) for t in tracks]
        ).T[..., None]
        steady = None
        if tracks[0].drift:
            steady_motions = np.stack([t.steps.steady.transpose(1, 2, 0) for t in tracks])
            effect = dst(steady_motions, type=1, norm="ortho", axis=3)
            squares = np.einsum("gapk,gaqk->pqgk", effect, effect)
            products = np.einsum("gapk,gak->pgk", effect, modes)
            steady = squares.reshape(*squares.shape[:2], -1), products.reshape(len(products), -1)
        return cls(
            groups=np.array(groups),
            starts=np.arange(len(tracks)) * count,
            which=np.repeat(np.arange(len(tracks)), count),
            power=(modes * modes).sum(axis=1).ravel(),
            count=np.full(len(tracks) * count, float(axes)),
            by_D=(2 * (duration - blur * c)).ravel(),
            by_theta=(2 * weight * c).ravel(),
            given=(2 * known * c).ravel(),
            steady=steady,
        )

    @classmethod
    def of_powers(cls, power: Floats, *, by_D: float, by_theta: Floats) -> SineModes:
        """Return the modes of several single axes, of eigenvalues D by_D + theta by_theta.

        Parameters
        ----------
        power : ndarray, shape (G, K)
        by_D : float
        by_theta : ndarray, shape (K,)
        """
        groups, count = np.arange(len(power)), power.shape[1]
        return cls(
            groups=groups,
            starts=groups * count,
            which=np.repeat(groups, count),
            power=power.ravel(),
            count=np.ones(power.size),
            by_D=np.full(power.size, by_D),
            by_theta=np.tile(by_theta, len(groups)),
            given=np.zeros(power.size),
        )

    @property
    def size(self) -> int:
        """Number of modes of all axes."""
        return round(float(self.count.sum()))

    @property
    def rough(self) -> StepKernel:
        """The same object."""
        return self

    @cached_property
    def slope_columns(self) -> Floats:
        """Half the slopes of the eigenvalue in D and in theta, and their three products, (5, M)."""
        halves = 0.5 * np.stack([self.by_D, self.by_theta])
        return np.concatenate([halves, 4 * (halves[[0, 0, 1]] * halves[[0, 1, 1]])])

    @cached_property
    def length(self) -> int:
        """Number of modes of every motion; 0 where they differ."""
        lengths = np.diff(self.starts, append=len(self.power))
        return int(lengths[0]) if np.all(lengths == lengths[0]) else 0

    def sums(self, D: Floats, theta: Floats) -> GroupSlopes:
        """Evaluate all motions at the D and the theta of each, (..., G)."""
        kernels = compiled_kernels() if self.length else None
        if kernels is None:
            found = self.sums_of_numpy(D, theta)
        else:
            sums = np.empty((theta.size // len(self.groups), len(self.groups), 11))
            points = np.broadcast_to(D, theta.shape), theta
            kernels.spectrum_sums(*self.rows, *map(np.ascontiguousarray, points), sums)
            found = GroupSlopes(*np.moveaxis(sums.reshape(*theta.shape, 11), -1, 0))
        if self.steady is None:
            return found
        return self.without_steady_motion(found, 1 / self.eigenvalues(D, theta))

    @cached_property
    def rows(self) -> list[Floats]:
        """Power, count, slopes and known part of the eigenvalues, a row of K modes each motion."""
        columns = self.power, self.count, self.by_D, self.by_theta, self.given
        return [np.ascontiguousarray(x.reshape(len(self.groups), self.length)) for x in columns]

    def sums_of_numpy(self, D: Floats, theta: Floats) -> GroupSlopes:
        """Evaluate all motions without a free steady motion, as the compiled kernel does."""
        halves, products = self.slope_columns[:2], self.slope_columns[2:]
        eigen = self.eigenvalues(D, theta)
        power, count = (
            x.reshape(eigen.shape[-1 - bool(self.length) :]) for x in (self.power, self.count)
        )
        inverse = 1 / eigen
        fall = count * inverse
        ratio = power * inverse
        rise = ratio * inverse
        value = count * np.log(eigen) + ratio
        each = value.sum(axis=-1) if self.length else np.add.reduceat(value, self.starts, axis=-1)
        rises, falls = (self.by_motion(x, halves) for x in (rise, fall))
        rise_bends, fall_bends = (self.by_motion(x * inverse, products) for x in (rise, fall))
        return GroupSlopes(
            -0.5 * each,
            *(rises[..., 0], falls[..., 0], rises[..., 1], falls[..., 1]),
            *(-rise_bends[..., k] for k in range(3)),
            *(-0.5 * fall_bends[..., k] for k in range(3)),
        )

    def eigenvalues(self, D: Floats, theta: Floats) -> Floats:
        """Return the variances of the modes, (..., G, K) where motions are of one length K."""
        if self.length:
            # One row a motion: a sum over modes is then a product of matrices.
            shape: tuple[int, ...] = (len(self.groups), self.length)
            D, theta = D[..., None], theta[..., None]
        else:
            shape = self.power.shape
            D, theta = D[..., self.which], theta[..., self.which]
        by_D, by_theta, given = (x.reshape(shape) for x in (self.by_D, self.by_theta, self.given))
        eigen = D * by_D + theta * by_theta + given
        return np.asarray(np.maximum(eigen, LEAST_EIGENVALUE, out=eigen))

    @cached_property
    def steady_columns(self) -> Floats:
        """X^T X and X^T y of every mode, (p^2 + p, M)."""
        if self.steady is None:
            raise ValueError("these steps have no free steady motion")
        squares, products = self.steady
        return np.concatenate([squares.reshape(-1, squares.shape[-1]), products])

    @cached_property
    def steady_slopes(self) -> tuple[Floats, Floats]:
        """The same columns times the slopes (2 (p^2 + p), M), and times their products."""
        slopes = np.stack([self.by_D, self.by_theta])
        pairs, plain = slopes[[0, 0, 1]] * slopes[[0, 1, 1]], self.steady_columns
        once, twice = ((x[:, None] * plain).reshape(-1, plain.shape[1]) for x in (slopes, pairs))
        return once, twice

    def steady_sums(self, weight: Floats, order: int) -> tuple[Floats, Floats]:
        """Return sums of weight times X^T X (..., G, s, p, p) and X^T y (..., G, s, p).

        The weights are multiplied by `order` slopes: none, D and theta, or their products DD, Do
        and oo.
        """
        columns = self.steady_slopes[order - 1] if order else self.steady_columns
        count, total = order + 1, self.by_motion(weight, columns)
        p = int(np.sqrt(len(columns) / count))  # p^2 + p columns each
        total = total.reshape(*total.shape[:-1], count, p * p + p)
        square = total[..., : p * p].reshape(*total.shape[:-1], p, p)
        return square, total[..., p * p :]

    def without_steady_motion(self, plain: GroupSlopes, inverse: Floats) -> GroupSlopes:
        """Return the restricted likelihood from that without a steady motion.

        With the steady motion m = G^-1 X^T V y all squares of y become those of y - X m.
        """
        (gram, right), (square, product) = (
            self.steady_sums(inverse, 0),
            self.steady_sums(inverse**2, 1),
        )
        squares, products = self.steady_sums(inverse**3, 2)
        left = np.asarray(np.linalg.inv(gram), dtype=np.float64)  # (..., G, 1, p, p)
        mean = (left @ right[..., None])[..., 0]

        def change(square: Floats, product: Floats) -> Floats:
            turned = (square @ mean[..., None])[..., 0]
            return np.asarray(np.sum(mean * (turned - 2 * product), axis=-1))

        def trace(a: Floats, b: Floats) -> Floats:
            return np.asarray(np.sum(a * np.swapaxes(b, -1, -2), axis=(-2, -1)))

        value = plain.value + 0.5 * np.sum(right * mean, axis=-1)[..., 0]
        value = value - 0.5 * np.linalg.slogdet(gram)[1][..., 0]
        rise, fall = 0.5 * change(square, product), -0.5 * trace(left, square)
        rest = product - (square @ mean[..., None])[..., 0]
        through = left @ square
        pairs = ((0, 0), (0, 1), (1, 1))
        lever = np.stack(
            [
                np.einsum(
                    "...p,...pq,...q->...", rest[..., i, :], left[..., 0, :, :], rest[..., j, :]
                )
                for i, j in pairs
            ],
            axis=-1,
        )
        rise_bends = lever - change(squares, products)
        both = np.stack(
            [trace(through[..., i, :, :], through[..., j, :, :]) for i, j in pairs], axis=-1
        )
        fall_bends = trace(left, squares) - 0.5 * both
        return GroupSlopes(
            value,
            plain.rise_D + rise[..., 0],
            plain.fall_D + fall[..., 0],
            plain.rise + rise[..., 1],
            plain.fall + fall[..., 1],
            *(plain[5 + k] + rise_bends[..., k] for k in range(3)),
            *(plain[8 + k] + fall_bends[..., k] for k in range(3)),
        )

    def steady_motion(self, D: Floats, theta: Floats) -> tuple[Floats, Floats]:
        """Return the steady motion (G, p) of every track and its inverse covariance (G, p, p)."""
        gram, right = self.steady_sums(1 / self.eigenvalues(D, theta), 0)
        mean = np.asarray(np.linalg.solve(gram, right[..., None])[..., 0], dtype=np.float64)
        return mean[..., 0, :], gram[..., 0, :, :]

    def by_motion(self, x: Floats, columns: Floats) -> Floats:
        """Return the sums over the modes of each motion of x times columns (c, M), (..., G, c)."""
        if self.length:
            by_row = columns.reshape(len(columns), *x.shape[-2:])
            if len(self.groups) == 1:
                return np.asarray(x @ by_row[:, 0].T)
            # (G, P, K) times (G, K, c)
            stacked = np.moveaxis(x.reshape(-1, *x.shape[-2:]), 0, 1) @ np.moveaxis(by_row, 0, 2)
            return np.moveaxis(stacked, 1, 0).reshape(*x.shape[:-1], len(columns))
        sums = [np.add.reduceat(x * column, self.starts, axis=-1) for column in columns]
        return np.stack(sums, axis=-1)


@dataclass(frozen=True, eq=False)
class TridiagonalCovariance:
    """Any steps: their axes stacked to one tridiagonal system, solved by LAPACK.

    Axes with the same noise are one block with several columns y (missing ones are 0; `count` is
    their number). The inverse of a tridiagonal matrix has the diagonal 1/(d + d' - a), d and
    d' being the pivots of the elimination from above and from below, and
    Z_{i,i+1} = -l_i Z_{i+1,i+1}.
    With a free steady motion the likelihood is the restricted one (REML): with U = C^-1 X for the
    effect X of the steady motion on the steps, and G = X^T U, C^-1 becomes C^-1 - U G^-1 U^T.

    Attributes
    ----------
    groups : ndarray of int
        Number of each motion.
    starts : ndarray of int
        First row of each motion.
    which : ndarray of int, shape (rows,)
        Motion to which each row belongs, counted among these.
    count : ndarray, shape (rows,)
        Axes in the block of each row.
    y : ndarray, shape (rows, columns)
        Steps.
    tau, linked : ndarray, shape (rows,)
        Duration of each step, s; 1 where it is linked to the next row, else 0.
    blur : ndarray, shape (G,)
        b of the offset s - b D of each motion, s.
    weight, known : tuple of ndarray, shape (rows,)
        Noise variance of the frames before and after, per theta, and its known part.
    steady : ndarray, shape (rows, columns, p), or None
        Effect X of a free steady motion.
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
    def of(cls, tracks: Sequence[NoisySteps], groups: Sequence[int]) -> TridiagonalCovariance:
        """Stack the steps of these motions, which have these numbers."""
        blocks = [
            (i, axes)
            for i, track in enumerate(tracks)
            for axes in equal_columns(np.concatenate([*track.weight, *track.known]))
        ]
        lengths = [len(tracks[i].steps.vectors) for i, _ in blocks]
        starts = np.cumsum([0, *lengths[:-1]])
        group = np.array([i for i, _ in blocks])
        y = np.zeros((sum(lengths), max(len(axes) for _, axes in blocks)), order="F")
        for start, length, (i, axes) in zip(starts, lengths, blocks, strict=True):
            y[start : start + length, : len(axes)] = tracks[i].steps.vectors[:, axes]
        steady = None
        if any(t.drift for t in tracks):
            steady = np.zeros((*y.shape, tracks[0].steps.steady.shape[2]))
            for start, length, (i, axes) in zip(starts, lengths, blocks, strict=True):
                steady[start : start + length, : len(axes)] = tracks[i].steps.steady[:, axes]

        def noise(part: Callable[[NoisySteps], Floats]) -> Floats:
            return np.concatenate([part(tracks[i])[:, axes[0]] for i, axes in blocks])

        def stacked(part: Callable[[NoisySteps], Floats | Bools]) -> Floats:
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

    @property
    def size(self) -> int:
        """Number of steps along all axes."""
        return round(float(self.count.sum()))

    @property
    def rough(self) -> StepKernel:
        """The same object."""
        return self

    def repeated(self, count: int) -> TridiagonalCovariance:
        """Return the same motions `count` times over, to evaluate as many D and theta at once."""
        groups, rows = len(self.groups), len(self.tau)

        def again(x: Floats) -> Floats:
            return np.concatenate([x] * count)

        def numbered(x: Ints, step: int) -> Ints:
            return np.asarray((x + step * np.arange(count)[:, None]).ravel())

        return TridiagonalCovariance(
            groups=numbered(self.groups, groups),
            starts=numbered(self.starts, rows),
            which=numbered(self.which, groups),
            count=again(self.count),
            y=np.concatenate([self.y.T] * count, axis=1).T,
            tau=again(self.tau),
            linked=again(self.linked),
            blur=again(self.blur),
            weight=(again(self.weight[0]), again(self.weight[1])),
            known=(again(self.known[0]), again(self.known[1])),
            steady=None if self.steady is None else again(self.steady),
        )

    def sums(self, D: Floats, theta: Floats) -> GroupSlopes:
        """Evaluate all motions at the D and the theta of each, (..., G).

        The slopes need z z^T and C^-1, z = C^-1 y, on both diagonals, summed over the
        columns of a block. With A the slope of C in D or theta, the slopes of the rises are
        -(A z)^T C^-1 (A z); those of the falls are half the second derivatives of ln det C.
        """
        from scipy.linalg.lapack import dpttrf, dpttrs

        shape = theta.shape
        if theta.size > len(self.groups):
            flat = D.reshape(-1), theta.reshape(-1)
            found = self.repeated(theta.size // len(self.groups)).sums(*flat)
            if np.isfinite(found.value).all():
                return GroupSlopes(*[x.reshape(shape) for x in found])
            rows = zip(D.reshape(-1, shape[-1]), theta.reshape(-1, shape[-1]), strict=True)
            each = zip(*[self.sums(*row) for row in rows], strict=True)
            return GroupSlopes(*[np.reshape(x, shape) for x in each])
        a, b = self.bands(D.reshape(-1), theta.reshape(-1))
        d, lower, bad = dpttrf(a, b)
        up, _, bad_up = dpttrf(a[::-1], b[::-1])
        if bad or bad_up:
            return GroupSlopes.impossible(shape)
        z, _ = dpttrs(d, lower, self.y)
        inverse = 1 / (d + up[::-1] - a)
        corner = self.linked * np.append(-lower * inverse[1:], 0.0)
        value = -0.5 * self.count * np.log(d)
        inverse, corner = self.count * inverse, self.count * corner
        steady = None
        if self.steady is not None:
            steady = unit, gram, mean = self.steady_normal_equations(d, lower)
            z = z - np.einsum("rcp,rp->rc", unit, mean[self.which])
            value[self.starts] -= 0.5 * np.linalg.slogdet(gram)[1]
            shared = unit @ np.linalg.inv(gram)[self.which]
            inverse = inverse - np.einsum("rcp,rcp->r", shared, unit)
            across = np.einsum("rcp,rcp->r", shared[:-1], unit[1:])
            corner = corner - self.linked * np.append(across, 0.0)
        value -= 0.5 * np.einsum("rc,rc->r", self.y, z)
        square = np.einsum("rc,rc->r", z, z)
        cross = self.linked * np.append(np.einsum("rc,rc->r", z[:-1], z[1:]), 0.0)
        slopes = [
            0.5 * on * by_diagonal + off * by_corner
            for on, off in self.band_slopes
            for by_diagonal, by_corner in ((square, cross), (inverse, corner))
        ]
        sums = [np.add.reduceat(row, self.starts) for row in (value, *slopes)]
        bends = self.rise_bends(z, d, lower, steady) + self.fall_bends(d, lower, steady)
        return GroupSlopes(*[x.reshape(shape) for x in sums + bends])

    @cached_property
    def band_slopes(self) -> tuple[tuple[Floats, Floats], tuple[Floats, Floats]]:
        """Slopes of the covariance in D and in theta: diagonal and next to it, (rows,) each."""
        blur, (before, after) = self.by_row(self.blur), self.weight
        return (
            (2 * (self.tau - blur), blur * self.linked),
            (before + after, -after * self.linked),
        )

    def slope_products(self, x: Floats) -> list[Floats]:
        """Return A x for the slopes A of the covariance in D and in theta, x (rows, ...)."""
        found = []
        for on, off in self.band_slopes:
            on, off = (column.reshape(-1, *[1] * (x.ndim - 1)) for column in (on, off))
            product = on * x
            product[:-1] += off[:-1] * x[1:]
            product[1:] += off[:-1] * x[:-1]
            found.append(product)
        return found

    def rise_bends(
        self, z: Floats, d: Floats, lower: Floats, steady: tuple[Floats, Floats, Floats] | None
    ) -> list[Floats]:
        """Return the slopes of both rises, (G,) each: -(A z)^T C^-1 (A z)."""
        from scipy.linalg.lapack import dpttrs

        products = self.slope_products(z)
        columns = z.shape[1]
        # Columns are contiguous, as LAPACK needs them.
        solved, _ = dpttrs(d, lower, np.concatenate([x.T for x in products]).T)
        found = []
        for i, j in ((0, 0), (0, 1), (1, 1)):
            row = np.einsum("rc,rc->r", products[i], solved[:, j * columns : (j + 1) * columns])
            found.append(-np.add.reduceat(row, self.starts))
        if steady is not None:
            unit, gram, _ = steady
            shares = [
                np.add.reduceat(np.einsum("rcp,rc->rp", unit, x), self.starts) for x in products
            ]
            inverse = np.linalg.inv(gram)
            for bend, (i, j) in zip(found, ((0, 0), (0, 1), (1, 1)), strict=True):
                bend += np.einsum("gp,gpq,gq->g", shares[i], inverse, shares[j])
        return found

    def fall_bends(
        self, d: Floats, lower: Floats, steady: tuple[Floats, Floats, Floats] | None
    ) -> list[Floats]:
        """Return the slopes of both falls, (G,) each: half the second derivatives of ln det C.

        The pivots follow d_k+1 = a_k+1 - b_k^2/d_k, so that their derivatives obey linear
        recurrences: with l = b/d, d'_k+1 = a'_k+1 - 2 l_k b'_k + l_k^2 d'_k, and the second ones
        d''_k+1 = -2 (b'_k - l_k d'_k)^2/d_k + l_k^2 d''_k.
        """
        from scipy.linalg.lapack import dpttrs, dtbtrs

        band = np.ones((2, len(d)), order="F")
        band[1, :-1] = -(lower**2)

        def recurrence(columns: Sequence[Floats]) -> Floats:
            return np.asarray(dtbtrs(band, np.array(columns).T, uplo="L", diag="U")[0])

        first = []
        for on, off in self.band_slopes:
            column = on.copy()
            column[1:] -= 2 * lower * off[:-1]
            first.append(column)
        slopes = recurrence(first).T
        turned = [
            off[:-1] - lower * slope[:-1]
            for (_, off), slope in zip(self.band_slopes, slopes, strict=True)
        ]
        pairs = ((0, 0), (0, 1), (1, 1))
        second = [np.append(0.0, -2 * turned[i] * turned[j] / d[:-1]) for i, j in pairs]
        bends = recurrence(second).T
        found = []
        for bend, (i, j) in zip(bends, pairs, strict=True):
            row = 0.5 * self.count * (bend - slopes[i] * slopes[j] / d) / d
            found.append(np.add.reduceat(row, self.starts))
        if steady is not None:
            unit, gram, _ = steady
            inverse, size = np.linalg.inv(gram), unit[0].size
            products = self.slope_products(unit)
            flat = np.concatenate([x.reshape(len(d), -1) for x in products], axis=1)
            solved, _ = dpttrs(d, lower, flat)
            through = [
                inverse @ np.add.reduceat(np.swapaxes(unit, -1, -2) @ x, self.starts)
                for x in products
            ]
            for bend, (i, j) in zip(found, pairs, strict=True):
                after = solved[:, j * size : (j + 1) * size].reshape(unit.shape)
                twice = np.add.reduceat(np.swapaxes(products[i], -1, -2) @ after, self.starts)
                bend += np.einsum("gpq,gqp->g", inverse, twice)
                bend -= 0.5 * np.einsum("gpq,gqp->g", through[i], through[j])
        return found

    def steady_normal_equations(self, d: Floats, lower: Floats) -> tuple[Floats, Floats, Floats]:
        """Return U = C^-1 X (rows, c, p), G = X^T U (G, p, p) and G^-1 U^T y (G, p).

        `d` and `lower` are the pivots and the factor of C.
        """
        from scipy.linalg.lapack import dpttrs

        x = self.steady
        if x is None:
            raise ValueError("these steps have no free steady motion")
        unit = dpttrs(d, lower, x.reshape(len(x), -1))[0].reshape(x.shape)
        gram = np.add.reduceat(np.swapaxes(x, -1, -2) @ unit, self.starts)
        right = np.add.reduceat(np.einsum("rcp,rc->rp", unit, self.y), self.starts)
        return unit, gram, np.linalg.solve(gram, right[..., None])[..., 0]

    def steady_motion(self, D: Floats, theta: Floats) -> tuple[Floats, Floats]:
        """Return the steady motion (G, p) of every track and its inverse covariance (G, p, p)."""
        from scipy.linalg.lapack import dpttrf

        d, lower, _ = dpttrf(*self.bands(D, theta))
        _, gram, mean = self.steady_normal_equations(d, lower)
        return mean, gram

    def bands(self, D: Floats, theta: Floats) -> tuple[Floats, Floats]:
        """Return the diagonal and the first off-diagonal of the covariance of all steps."""
        D, theta, blur = (self.by_row(x) for x in (D, theta, self.blur))
        return covariance_bands(
            D, theta, self.tau, self.linked, blur=blur, weight=self.weight, known=self.known
        )

    def by_row(self, x: Floats) -> Floats:
        """Return a number of each motion at every row; one number where there is one motion."""
        return x if len(x) == 1 else x[self.which]


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
    """Return diagonal and first off-diagonal of the covariance of steps, along the first axis.

    The variance is 2 D tau + o_before + o_after and the covariance with the next step -o_after,
    o = weight theta + known - blur D.

    Examples
    --------
    >>> one = np.ones(3)
    >>> covariance_bands(2.0, 0.5, one, one, blur=0.0, weight=(one, one), known=(0 * one, 0 * one))
    (array([5., 5., 5.]), array([-0.5, -0.5]))
    """
    before, after = (w * theta + k - blur * D for w, k in zip(weight, known, strict=True))
    return 2 * D * tau + before + after, -(after * linked)[:-1]
