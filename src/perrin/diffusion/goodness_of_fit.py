"""Tests of whether the steps of a motion are those of Brownian motion with constant noise.

Every axis has its own D and noise offset. The tests look at what is left: the powers of the sine
modes over their fitted variances, and the errors of predicting each step from those before it.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from perrin._arrays import distinct, expanded, frozen
from perrin.diffusion.step_kernels import SineModes, covariance_bands, difference_eigenvalues
from perrin.diffusion.step_spectra import (
    confined_autocovariance,
    fractional_slope,
    sine_spectrum,
)
from perrin.diffusion.steps import NoisySteps, Quantity, groups_alike, principal_steps_of_each
from perrin.errors import TooFewFramesError

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable, Sequence

    from perrin._arrays import Bools, Floats
    from perrin.diffusion.noise_model import Noise
    from perrin.motion.rigid_motion import RigidMotion

# Names of the tests, in the order in which they are reported.
TESTS = ("fractional", "cage", "steady", "clustering", "slow change", "tails", "largest", "line")

FEWEST_STEPS = 20  # eight tests of fewer steps say nothing

# An axis whose mean square is this much smaller than another one's does not move.
_SMALLEST_AXIS = 1e-20

# Frames whose noise differs by less than this share of a step's variance (rms) count as equal: the
# elements of the covariance off the diagonal of the sine modes are of that order.
_EQUAL_NOISE = 0.05

# The logarithm v of 1 + 2 o/(D tau), the ratio of the highest to the lowest sine mode, is searched
# between these: below, neighbouring steps are one straight line; above, there is no diffusion.
_LEAST_V, _MOST_V = -9.0, 14.0

_CONFINED_RATE = 6.0  # relaxations per track of the cage that the cage test looks for

# Above this p-value, at the D that contains the steady motion, no fit without it is made: it would
# change D, and with it p, by a few parts in N.
_NO_STEADY_MOTION = 0.2

_CLUSTERING_LAGS = 20

# About this many step components are tested at once; more do not stay in the processor's cache.
_MOST_SCORES = 60_000

FEWEST_HALF_PERIODS = 6  # of a vibration in the track

# A track of which the dense score would need more than this is divided, and the scores are added.
_DENSE_BLOCK = 400

# Below these the p-values are replaced by ranks among draws from the fit.
_FEWEST_ASYMPTOTIC_STEPS, _LEAST_INFORMATION = 200, 10.0

# Draws: as many numbers as can be judged in 0.1 s, in these limits; below the rank of _TAIL_RANK
# the p-value of the draws is continued in proportion to the approximate one.
_DRAWN_NUMBERS, _FEWEST_DRAWS, _MOST_DRAWS, _TAIL_RANK = 100_000, 199, 999, 10


class Score(NamedTuple):
    """The efficient score of an alternative for B data sets, and its law in Brownian motion.

    The score is half the sum of g (chi-squared - 1) over modes. Its modes are taken in four groups:
    g positive or negative, and beyond or within half of the largest g. The cumulants of a group add
    over axes and tracks.

    Attributes
    ----------
    value : ndarray, shape (B,)
        The score.
    variance : ndarray, shape (4, B)
        Variance of each group.
    third : ndarray, shape (4, B)
        Third cumulant of each group; those of negative g are negative.
    """

    value: Floats
    variance: Floats
    third: Floats

    @classmethod
    def of(cls, value: Floats, g: Floats, *, information: Floats) -> Score:
        """Return a score with the cumulants of modes g (B, A, N), scaled to its information."""
        large = np.abs(g) > 0.5 * np.abs(g).max(axis=(-2, -1), keepdims=True)
        groups = np.stack([(g > 0) & large, (g > 0) & ~large, (g < 0) & large, (g < 0) & ~large])
        variance = 0.5 * np.sum(np.where(groups, g**2, 0.0), axis=(-2, -1))
        scale = information / variance.sum(axis=0)
        third = np.sum(np.where(groups, g**3, 0.0), axis=(-2, -1))
        return cls(value, variance * scale, third * scale**1.5)

    @classmethod
    def total(cls, scores: Sequence[Score]) -> Score:
        """Return the sum of independent scores."""
        return cls(*(np.sum(part, axis=0) for part in zip(*scores, strict=True)))

    @property
    def information(self) -> Floats:
        """Variance of the score, (B,)."""
        return np.asarray(self.variance.sum(axis=0))


@dataclass(frozen=True, eq=False)
class AxisFit:
    """Steps of B data sets along A axes, and the D and noise offset fitted to each axis.

    Attributes
    ----------
    y : ndarray, shape (B, A, N)
        Steps, rad or um.
    D : ndarray, shape (B, A)
        Diffusion coefficients, rad^2/s or um^2/s.
    offset : ndarray, shape (B, A)
        Noise variance of the least noisy frame, less motion blur.
    """

    y: Floats
    D: Floats
    offset: Floats

    def __post_init__(self) -> None:
        frozen(self.y, self.D, self.offset)


@dataclass(frozen=True, eq=False)
class AxisModel:
    """Brownian steps along A axes, each with a D and an offset of its own.

    Several motions with the same frames are one model, whose `known` and `steady` have a first axis
    of B motions.

    Attributes
    ----------
    start : ndarray, shape (N,)
        Time at which each step begins, s.
    tau : ndarray, shape (N,)
        Duration of each step, s.
    linked : ndarray of bool, shape (N,)
        Whether the next step begins with the frame that this one ends with.
    known : tuple of ndarray, shape (A, N) or (B, A, N)
        Known part of the noise variances of the frames before and after each step.
    blur : float
        Motion blur takes this (s) times D from the known noise; 0 where the offset is free.
    free : bool
        Whether the offset is free; else the noise is known and the offset is 0.
    steady : ndarray, shape (N, A, p) or (B, N, A, p)
        What a steady velocity or spin along the lab axes adds to each step, per unit of it.
    """

    start: Floats
    tau: Floats
    linked: Bools
    known: tuple[Floats, Floats]
    blur: float
    free: bool
    steady: Floats

    def __post_init__(self) -> None:
        frozen(self.start, self.tau, self.linked, *self.known, self.steady)

    @classmethod
    def of_track(
        cls,
        track: NoisySteps,
        *,
        start: Floats,
        steady: Floats,
        moves: Bools,
        square: Floats,
        free: bool,
    ) -> AxisModel:
        """Return the model of the steps along the axes that a body moves along.

        Parameters
        ----------
        track : NoisySteps
            Steps along all axes, without a free steady motion.
        start : ndarray, shape (N,)
        steady : ndarray, shape (N, A, p)
            As in the attributes.
        moves : ndarray of bool
            Which axes the body moves along, A of them.
        square : ndarray
            Mean square step along every axis; noise that differs little beside it is equal.
        free : bool
            Whether the offset is free.
        """
        count, theta = len(start), 0.0 if free else track.theta
        rows = [
            (distinct(known) + distinct(weight) * theta)[:, moves]
            for known, weight in zip(track.known, track.weight, strict=True)
        ]
        before, after = (expanded(noise, count).T for noise in rows)
        model = cls(
            start=start,
            tau=track.steps.duration,
            linked=track.steps.linked,
            known=(before, after),
            blur=0.0 if free else track.blur,
            free=free,
            steady=steady,
        )
        if len(rows[0]) == len(rows[1]) == 1 and np.array_equal(rows[0], rows[1]):
            return model
        spread = 0.5 * (before.std(axis=1) + after.std(axis=1))
        equal = np.all(spread <= _EQUAL_NOISE * square[moves])
        return model.with_equal_noise() if equal else model

    @property
    def n_steps(self) -> int:
        """Number of steps N."""
        return len(self.tau)

    @cached_property
    def mean_tau(self) -> float:
        """Mean duration of a step, s."""
        return float(self.tau.mean())

    @cached_property
    def even(self) -> bool:
        """Whether all steps are linked and equally long."""
        return bool(np.ptp(self.tau) <= 1e-9 * self.tau[0] and self.linked[:-1].all())

    @cached_property
    def differences(self) -> Floats:
        """1 - cos w_k of the sine modes, (N,)."""
        return difference_eigenvalues(self.n_steps)

    @cached_property
    def mean_known(self) -> Floats:
        """Mean known noise variance of each axis, (A,) or (B, A)."""
        # Of noise that is stored once for all frames one number is the mean.
        first, last = (k[..., 0] if k.strides[-1] == 0 else k.mean(axis=-1) for k in self.known)
        return np.asarray(0.5 * (first + last))

    def with_equal_noise(self) -> AxisModel:
        """Return the model with the mean noise in all frames."""
        level = np.broadcast_to(self.mean_known[..., None], self.known[0].shape)
        return replace(self, known=(level, level))

    def of(self, rows: Bools) -> AxisModel:
        """Return the model of some of the motions; itself where it is that of one motion."""
        if self.steady.ndim == 3:
            return self
        before, after = (known[rows] for known in self.known)
        return replace(self, known=(before, after), steady=self.steady[rows])

    def ratio(self, D: Floats, offset: Floats) -> Floats:
        """Return v = ln(1 + 2 o/(D tau)), o the offset."""
        with np.errstate(divide="ignore", invalid="ignore"):
            v = np.log1p(2 * offset / (D * self.mean_tau))
        return np.asarray(np.clip(np.nan_to_num(v, nan=_MOST_V), _LEAST_V, _MOST_V))

    def eigenvalues(self, D: Floats, offset: Floats) -> Floats:
        """Return the variances of the sine modes for the mean duration and noise, (B, A, N)."""
        noise = offset + self.mean_known - self.blur * D
        return np.asarray(
            2 * D[..., None] * self.mean_tau + 2 * noise[..., None] * self.differences
        )

    def slopes(self, D: Floats, offset: Floats) -> tuple[Floats, Floats]:
        """Return the derivatives of ln lambda_k in ln D and in the offset over D, (B, A, N)."""
        eigen = self.eigenvalues(D, offset)
        by_D = 2 * D[..., None] * (self.mean_tau - self.blur * self.differences) / eigen
        by_offset = 2 * D[..., None] * self.differences / eigen
        return by_D, by_offset

    def bands(self, D: Floats, offset: Floats) -> tuple[Floats, Floats]:
        """Return diagonal and off-diagonal of the covariance of all rows, one after the other."""
        shape = (*D.shape, self.n_steps)

        def full(x: Floats) -> Floats:
            return np.ascontiguousarray(np.broadcast_to(x, shape)).ravel()

        linked = np.array(self.linked)
        linked[-1] = False
        one = np.ones(1)
        return covariance_bands(
            full(D[..., None]),
            full(offset[..., None]),
            full(self.tau),
            full(linked.astype(np.float64)),
            blur=self.blur,
            weight=(one, one),
            known=(full(self.known[0]), full(self.known[1])),
        )

    def fit(self, y: Floats, *, near: AxisFit | None = None) -> AxisFit:
        """Return the D and the offset of greatest likelihood of each axis of each data set.

        Even steps are fitted in their sine modes, other steps by scoring on the tridiagonal
        likelihood.

        Parameters
        ----------
        y : ndarray, shape (B, A, N)
            Steps.
        near : AxisFit, optional
            A fit of one data set from which to start; then three iterations suffice.
        """
        if self.even and np.all(np.ptp(self.known[0], axis=-1) == 0):
            return self._fit_modes(y, near)
        return self._fit_tridiagonal(y, near)

    def _fit_modes(self, y: Floats, near: AxisFit | None) -> AxisFit:
        """Fit even steps: D follows from v, and v by scoring from the best of a grid."""
        power = sine_powers(y)
        tau, c, noise = self.mean_tau, self.differences, self.mean_known

        def relative(v: Floats) -> Floats:
            return np.asarray(2 * tau * (1 + np.expm1(v)[..., None] / 2 * c))

        if not self.free:
            # One parameter: the root of the score in ln D, from the variance of the steps.
            D = np.maximum(np.mean(power, axis=-1) / 2 - noise, 1e-3 * power.mean(axis=-1)) / tau
            for _ in range(60):
                g = self.slopes(D, 0 * D)[0]
                r = power / self.eigenvalues(D, 0 * D) - 1
                move = np.sum(g * r, axis=-1) / np.sum(g * g, axis=-1)
                D = D * np.exp(np.clip(move, -1.0, 1.0))
                if np.all(np.abs(move) < 1e-10):
                    break
            return AxisFit(y, D, np.zeros_like(D))
        if near is None:
            trials = np.linspace(-5.0, 9.0, 15)
            shape = relative(trials)
            cost = np.log(power @ (1 / shape).T / len(c)) + np.mean(np.log(shape), axis=1)
            v = trials[np.argmin(cost, axis=-1)]
        else:
            v = np.broadcast_to(self.ratio(near.D, near.offset + noise), y.shape[:2])
        # The variances of the modes for D = 1, 2 tau + 2 c theta with theta = tau (e^v - 1)/2.
        count, v = len(c), np.array(v).ravel()
        modes = SineModes.of_powers(power.reshape(-1, count), by_D=2 * tau, by_theta=2 * c)
        for _ in range(60 if near is None else 4):
            theta, growth = tau * np.expm1(v) / 2, tau * np.exp(v)
            sums = modes.sums(np.ones_like(v), theta)
            # Sums over the modes of power/variance and of c power/variance^2, over D.
            D = 2 * (sums.rise_D + theta * sums.rise) / count
            slope = growth * (sums.rise / D - sums.fall)
            move = slope / (growth**2 * (-0.5 * sums.fall_oo - sums.fall**2 / count))
            v = np.clip(v + np.clip(move, -1.0, 1.0), _LEAST_V, _MOST_V)
            if np.all(np.abs(move) < 1e-10):
                break
        v = v.reshape(y.shape[:2])
        D = np.mean(power / relative(v), axis=-1)
        return AxisFit(y, D, D * tau * np.expm1(v) / 2 - noise)

    def _fit_tridiagonal(self, y: Floats, near: AxisFit | None) -> AxisFit:
        """Fit any steps by Newton steps on the score in ln D and v.

        The curvature is that of even steps of the mean duration (scoring); the fit of one data set
        takes its own curvature from differences of the score, where it has a maximum.
        """
        tau, shape = self.mean_tau, y.shape[:2]
        # An offset above -D/2 times the shortest step makes the covariance positive definite.
        least = max(_LEAST_V, float(np.log1p(-(1 - 1e-4) * self.tau.min() / tau)))
        single = near is None
        if near is None:
            even = np.ones(self.n_steps, dtype=np.bool_)
            modes = replace(self.with_equal_noise(), tau=np.full(self.n_steps, tau), linked=even)
            near = modes._fit_modes(y, None)
        t = np.stack([np.log(near.D), self.ratio(near.D, near.offset)], axis=-1)
        t = np.array(np.broadcast_to(t, (*shape, 2)))[..., : 1 + self.free]
        t[..., 1:] = np.maximum(t[..., 1:], least)

        def parameters(t: Floats) -> tuple[Floats, Floats]:
            D = np.exp(t[..., 0])
            return D, D * tau * np.expm1(t[..., 1]) / 2 if self.free else np.zeros_like(D)

        for _ in range(40 if single else 4):
            D, offset = parameters(t)
            score = self._score(y, D, offset)
            by_D, by_offset = self.slopes(D, offset)
            g = by_D[..., None, :]
            if self.free:
                ratio = np.exp(t[..., 1])[..., None]
                by_v = tau / 2 * ratio * by_offset
                g = np.stack([by_D + tau / 2 * (ratio - 1) * by_offset, by_v], axis=-2)
            matrix = 0.5 * np.einsum("...ik,...jk->...ij", g, g)
            if single:
                own = np.empty_like(matrix)
                for k in range(t.shape[-1]):
                    ahead = t.copy()
                    ahead[..., k] += 1e-5
                    own[..., k] = (score - self._score(y, *parameters(ahead))) / 1e-5
                own = 0.5 * (own + np.swapaxes(own, -1, -2))
                peaked = np.linalg.eigvalsh(own)[..., 0] > 0
                matrix = np.where(peaked[..., None, None], own, matrix)
            move = np.clip(np.linalg.solve(matrix, score[..., None])[..., 0], -0.5, 0.5)
            t = t + move
            if self.free:
                t[..., 1] = np.clip(t[..., 1], least, _MOST_V)
            if np.all(np.abs(move) < 1e-9):
                break
        return AxisFit(y, *parameters(t))

    def _score(self, y: Floats, D: Floats, offset: Floats) -> Floats:
        """Return the slopes of the log-likelihood in ln D and in a free v, (B, A, f)."""
        from scipy.linalg.lapack import dpttrf, dpttrs

        shape = y.shape[:2]
        a, b = self.bands(D, offset)
        d, lower, _ = dpttrf(a, b)
        up = dpttrf(a[::-1], b[::-1])[0]
        z = dpttrs(d, lower, y.reshape(-1, 1))[0][:, 0]
        inverse = 1 / (d + up[::-1] - a)
        starts = np.arange(0, y.size, self.n_steps)
        linked = np.tile(np.append(self.linked[:-1], False), len(starts))
        excess = z * z - inverse
        cross = np.append(z[:-1] * z[1:] + lower * inverse[1:], 0.0) * linked
        taus = np.tile(self.tau, len(starts))
        in_D = np.add.reduceat((taus - self.blur) * excess + self.blur * cross, starts)
        in_o = np.add.reduceat(excess - cross, starts)
        in_D, in_o = D * in_D.reshape(shape), in_o.reshape(shape)
        if not self.free:
            return np.asarray(in_D[..., None])
        half = D * self.mean_tau / 2
        return np.stack([in_D + offset * in_o, (half + offset) * in_o], axis=-1)

    def draws(self, fit: AxisFit, *, count: int, rng: np.random.Generator) -> Floats:
        """Return steps of Brownian motion with the D and the offset of one fit, (count, A, N)."""
        from scipy.linalg.lapack import dpttrf

        d, lower, _ = dpttrf(*self.bands(fit.D, fit.offset))
        axes = fit.D.shape[1]
        d, lower = d.reshape(axes, -1), np.append(lower, 0.0).reshape(axes, -1)
        # C = L diag(d) L^T with a bidiagonal L: each step takes up a part of the one before.
        z = np.sqrt(d) * rng.standard_normal((count, axes, self.n_steps))
        z[..., 1:] += lower[:, :-1] * z[..., :-1].copy()
        return np.asarray(z)

    def log_likelihood(self, fit: AxisFit) -> float:
        """Return the log-likelihood of the first data set at its fit, less a constant."""
        from scipy.linalg.lapack import dpttrf, dpttrs

        d, lower, _ = dpttrf(*self.bands(fit.D[:1], fit.offset[:1]))
        y = fit.y[:1].reshape(-1, 1)
        return -0.5 * float(np.sum(np.log(d)) + np.sum(y * dpttrs(d, lower, y)[0]))

    def change_scores(self, fit: AxisFit) -> Floats:
        """Return the scores of a linear change of D and of the noise offset in time, (2, B).

        The B data sets have a fit each, or one for all.

        With t from -1 to 1 along the track and z = C^-1 y they are the sums over steps of
        D t (z_j^2 - expected), and over shared frames of o t ((z_j - z_{j+1})^2 - expected)/2, the
        expected values those of diffusion and noise that do not change.
        """
        from scipy.linalg.lapack import dpttrf, dpttrs

        # Of data sets with one fit the covariance is factorised once.
        shape = fit.D.shape + fit.y.shape[2:]
        a, b = self.bands(fit.D, fit.offset)
        d, lower, _ = dpttrf(a, b)
        up = dpttrf(a[::-1], b[::-1])[0]
        z = dpttrs(d, lower, fit.y.reshape(-1, a.size).T)[0].T.reshape(fit.y.shape)
        inverse = (1 / (d + up[::-1] - a)).reshape(shape)
        corner = np.append(-lower * inverse.ravel()[1:], 0.0).reshape(shape)[..., :-1]
        t = np.linspace(-1.0, 1.0, self.n_steps)
        by_D = np.sum(fit.D[..., None] * t * (z**2 - inverse), axis=(1, 2))
        square = (z[..., :-1] - z[..., 1:]) ** 2
        expected = inverse[..., :-1] + inverse[..., 1:] - 2 * corner
        middle = 0.5 * (t[1:] + t[:-1]) * self.linked[:-1]
        by_noise = 0.5 * np.sum(middle * (square - expected), axis=(1, 2))
        return np.stack([by_D, by_noise])

    def prediction_errors(self, fit: AxisFit) -> Floats:
        """Return the errors of predicting each step from those before, over their scale (B, A, N).

        They are independent standard normal numbers if the model is right, with gaps and unequal
        noise. Each axis is scaled to a mean square of 1.
        """
        from scipy.linalg.lapack import dpttrf, dtbtrs

        d, lower, _ = dpttrf(*self.bands(fit.D, fit.offset))
        band = np.stack([np.ones_like(d), np.append(lower, 0.0)])
        e = dtbtrs(band, fit.y.reshape(-1, 1), uplo="L", diag="U")[0][:, 0] / np.sqrt(d)
        e = e.reshape(fit.y.shape)
        return np.asarray(e / np.sqrt(np.mean(e * e, axis=-1, keepdims=True)))

    def squared_errors(self, fit: AxisFit) -> Floats:
        """Return the squares of the prediction errors, summed over the axes, (B, N)."""
        return np.asarray(np.sum(self.prediction_errors(fit) ** 2, axis=1))

    def mode_ratios(self, fit: AxisFit) -> Floats:
        """Return the powers of the sine modes over their variances, of mean 1, (B, A, N).

        Where steps are uneven the modes are those of the prediction errors.
        """
        if not self.even:
            ratio = sine_powers(self.prediction_errors(fit))
            return np.asarray(ratio / ratio.mean(axis=-1, keepdims=True))
        ratio = sine_powers(fit.y) / self.eigenvalues(fit.D, fit.offset)
        ratio /= ratio.mean(axis=-1, keepdims=True)
        # A large mode draws the fit to itself, by its leverage beyond that of the mean: without its
        # own part in its variance the ratio r is r (1 - h)/(1 - h r). With half the leverage as h
        # the largest of all modes has the law of independent ones most nearly.
        g = np.stack(self.slopes(fit.D, fit.offset)[: 1 + self.free], axis=-2)
        solved = np.linalg.solve(np.einsum("...ik,...jk->...ij", g, g), g)
        h = np.maximum(np.einsum("...ik,...ik->...k", g, solved) - 1 / self.n_steps, 0.0)
        h /= 2
        return np.asarray(ratio * (1 - h) / np.maximum(1 - h * ratio, 0.1))

    def alternatives(self) -> Floats:
        """Return the change of the sine spectrum of D = 1 by each alternative, (2, N), s.

        The first is the derivative in the exponent of fractional motion at 1, the second the
        difference of a cage that relaxes six times in the whole track.
        """
        n = self.n_steps
        rate = _CONFINED_RATE / n
        shapes = np.stack([fractional_slope(n), confined_autocovariance(rate, n)])
        return np.asarray(self.mean_tau * (sine_spectrum(shapes) - [[0.0], [2.0]]))

    def score_shapes(self, fit: AxisFit) -> Floats:
        """Return the relative change of each mode by each alternative, (2, B, A, N).

        What a change of D and of the offset can do is removed.
        """
        by_D, by_offset = self.slopes(fit.D, fit.offset)
        change = self.alternatives()[:, None, None] * fit.D[..., None]
        g = change / self.eigenvalues(fit.D, fit.offset)
        known = np.stack([by_D, by_offset] if self.free else [by_D], axis=-2)
        gram = np.einsum("...ik,...jk->...ij", known, known)
        right = np.einsum("...ik,x...k->x...i", known, g)
        weight = np.linalg.solve(gram[None], right[..., None])[..., 0]
        return np.asarray(g - np.einsum("x...i,...ik->x...k", weight, known))

    def scores(self, fit: AxisFit) -> tuple[Score, Score]:
        """Return the scores of fractional and of confined motion, summed over the axes.

        U = 1/2 sum g (P/lambda - 1) and the information 1/2 sum g^2, g from
        `score_shapes` and P the power of a mode of variance lambda.
        """
        g = self.score_shapes(fit)
        r = sine_powers(fit.y) / self.eigenvalues(fit.D, fit.offset) - 1
        value = 0.5 * np.sum(g * r, axis=(-2, -1))
        information = 0.5 * np.sum(g * g, axis=(-2, -1))
        return (
            Score.of(value[0], g[0], information=information[0]),
            Score.of(value[1], g[1], information=information[1]),
        )

    def dense_scores(self, fit: AxisFit, y: Floats) -> tuple[Score, Score]:
        """Return the scores of fractional and of confined motion for steps of any durations.

        Parameters
        ----------
        fit : AxisFit
            Fit of one data set, at which the scores are taken.
        y : ndarray, shape (B, A, N)
            Steps of the data sets.

        Notes
        -----
        With z = C^-1 y and a derivative C' of the covariance, U = 1/2 (z^T C' z - tr C^-1 C') and
        I = 1/2 tr C^-1 C'_a C^-1 C'_b. What D and the offset can do is removed by regression of
        the scores, which also corrects for a fit that is not that of y. A long track is divided
        into blocks, whose scores and informations are added; the cumulants are scaled from those of
        even steps.
        """
        from scipy.linalg.lapack import dpttrf, dpttrs

        blocks = np.array_split(np.arange(self.n_steps), -(-self.n_steps // _DENSE_BLOCK))
        axes, parameters = y.shape[1], 3 + self.free
        U = np.zeros((axes, parameters, len(y)))
        matrix = np.zeros((axes, parameters, parameters))
        tau = self.mean_tau
        rate = _CONFINED_RATE / (self.n_steps * tau)
        for rows in blocks:
            start, linked = self.start[rows], self.linked[rows]
            stop = start + self.tau[rows]

            def covariance(
                square: Callable[[Floats], Floats], start: Floats = start, stop: Floats = stop
            ) -> Floats:
                """Return the covariance of the steps, from the mean square over each time."""

                def between(x: Floats, y: Floats) -> Floats:
                    return square(np.abs(x[:, None] - y))

                inner = between(start, stop) + between(stop, start)
                return np.asarray(0.5 * (inner - between(start, start) - between(stop, stop)))

            duration = np.diag(2 * (stop - start))
            chain = -(np.diag(linked[:-1].astype(np.float64), 1))
            offset_change = 2 * np.eye(len(start)) + chain + chain.T
            # Derivatives of the covariance for D = 1: the alternatives, ln D, and a free offset.
            changes = [
                covariance(lambda t: 2 * t * np.log(np.maximum(t / tau, 1e-12))),
                covariance(lambda t: -2 * np.expm1(-rate * t) / rate) - duration,
                duration - self.blur * offset_change,
                *([offset_change] if self.free else []),
            ]
            for axis, (D, offset) in enumerate(zip(fit.D[0], fit.offset[0], strict=True)):
                noise = self.known[0][axis, rows], self.known[1][axis, rows]
                a, b = covariance_bands(
                    D,
                    offset,
                    self.tau[rows],
                    self.linked[rows],
                    blur=self.blur,
                    weight=(np.ones(1), np.ones(1)),
                    known=noise,
                )
                d, lower, _ = dpttrf(a, b)
                z = dpttrs(d, lower, y[:, axis, rows].T)[0]
                products = [dpttrs(d, lower, D * change)[0] for change in changes]
                for i, change in enumerate(changes):
                    square = D * np.einsum("nb,nb->b", z, change @ z)
                    U[axis, i] += 0.5 * (square - np.trace(products[i]))
                flat = np.stack([product.ravel() for product in products])
                turned = np.stack([product.T.ravel() for product in products])
                matrix[axis] += 0.5 * flat @ turned.T
        weight = np.linalg.solve(matrix[:, 2:, 2:], matrix[:, 2:, :2])
        value = np.sum(U[:, :2] - np.swapaxes(weight, 1, 2) @ U[:, 2:], axis=0)
        left = matrix[:, :2, :2] - matrix[:, :2, 2:] @ weight
        information = np.einsum("aii->i", left)
        g = np.broadcast_to(self.score_shapes(fit), (2, len(y), *fit.y.shape[1:]))
        known = np.broadcast_to(information[:, None], (2, len(y)))
        return (
            Score.of(value[0], g[0], information=known[0]),
            Score.of(value[1], g[1], information=known[1]),
        )

    def steady_motion(self, fit: AxisFit) -> tuple[Floats, Floats, Floats]:
        """Return a steady velocity or spin, its information, and p of the F test.

        Their shapes are (B, p), (B, p, p) and (B,). The motion is found by generalised least
        squares on `steady`. Where p is below 0.2, D and the offset are fitted again to what is
        left. F has (p, nu) degrees of freedom, nu being twice the inverse relative variance of D,
        mean over the axes.
        """
        from scipy.linalg.lapack import dpttrf, dpttrs
        from scipy.special import fdtrc

        p, n, sets = self.steady.shape[-1], self.n_steps, len(fit.y)
        mean, information, p_value = np.zeros((sets, p)), np.zeros((sets, p, p)), np.zeros(sets)
        rows, model, rest = np.arange(sets), self, fit
        for refits in range(3):
            y = fit.y[rows]
            x = np.broadcast_to(np.swapaxes(model.steady, -3, -2), (*y.shape, p))
            d, lower, _ = dpttrf(*model.bands(rest.D, rest.offset))
            unit = dpttrs(d, lower, x.reshape(-1, p))[0].reshape(len(rows), -1, p)
            gram = np.swapaxes(x.reshape(unit.shape), 1, 2) @ unit
            right = np.swapaxes(unit, 1, 2) @ y.reshape(len(rows), -1, 1)
            found = np.linalg.solve(gram, right)[..., 0]
            by_D, by_offset = model.slopes(rest.D, rest.offset)
            g = np.stack([by_D, by_offset] if self.free else [by_D], axis=-2)
            matrix = 0.5 * g @ np.swapaxes(g, -1, -2)
            nu = np.mean(2 / np.linalg.inv(matrix)[..., 0, 0], axis=1)
            square = np.sum(found * right[..., 0], axis=1) * (n - 1) / (n * p)
            mean[rows], information[rows], p_value[rows] = found, gram, fdtrc(p, nu, square)
            left = p_value[rows] < _NO_STEADY_MOTION
            if refits == 2 or not left.any():
                break
            rows, model = rows[left], model.of(left)
            residual = y[left] - (x[left] @ found[left, None, :, None])[..., 0]
            rest = model.fit(residual, near=AxisFit(y[left], rest.D[left], rest.offset[left]))
        return mean, information, p_value


def axis_model(motion: RigidMotion, quantity: Quantity, noise: Noise) -> tuple[AxisModel, Floats]:
    """Return the model of the steps of one motion along the axes of its D, and the steps (1, A, N).

    An axis without any motion is left out.

    Raises
    ------
    TooFewFramesError
        If there are fewer than 20 steps.
    ValueError
        If the body does not move at all.

    Examples
    --------
    >>> from perrin import Cluster, Noise, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=100, rng=3)
    >>> model, y = axis_model(truth, "rotation", Noise())
    >>> model.even, y.shape
    (True, (1, 3, 99))
    """
    return axis_models([motion], quantity, noise)[0]


def axis_models(
    motions: Sequence[RigidMotion], quantity: Quantity, noise: Noise
) -> list[tuple[AxisModel, Floats]]:
    """Return the model and the steps of several motions, as `axis_model`, alike ones together.

    Raises
    ------
    TooFewFramesError, ValueError
        As in `axis_model`.

    Examples
    --------
    >>> from perrin import Cluster, Noise, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=100, rng=3)
    >>> [y.shape for _, y in axis_models([truth, truth], "rotation", Noise())]
    [(1, 3, 99), (1, 3, 99)]
    """
    every = principal_steps_of_each(motions, quantity)
    for steps in every:
        count = len(steps.duration)
        if count < FEWEST_STEPS:
            raise TooFewFramesError(
                f"{count} steps: at least {FEWEST_STEPS} are needed to tell what kind of motion "
                "they belong to",
                count + 1,
            )
    settings = replace(noise, drift=False)
    models: dict[int, tuple[AxisModel, Floats]] = {}
    shapes = [steps.vectors.shape for steps in every]
    for rows in groups_alike(shapes, [n * axes for n, axes in shapes], most=_MOST_SCORES):
        vectors = np.stack([every[k].vectors for k in rows])
        squares = vectors * vectors
        mean_squares = squares.mean(axis=1)
        # Eigenvectors have any sign; one that the steps determine gives p, which are simulated from
        # a seed made of the steps, that do not change with the axes of the laboratory.
        signs = np.where(np.sum(squares * vectors, axis=1) < 0, -1.0, 1.0)
        y = np.ascontiguousarray(np.swapaxes(vectors, 1, 2) * signs[..., None])
        steady = np.stack([every[k].steady for k in rows]) * signs[:, None, :, None]
        for i, k in enumerate(rows):
            square = mean_squares[i]
            if not square.max() > 0:
                raise ValueError(f"the body does not move: there is no {quantity} to judge")
            moves = square > _SMALLEST_AXIS * square.max()
            model = AxisModel.of_track(
                NoisySteps.of(every[k], settings),
                start=motions[k].time[every[k].start],
                steady=steady[i] if moves.all() else np.ascontiguousarray(steady[i][:, moves]),
                moves=moves,
                square=square,
                free=noise.model == "joint",
            )
            models[k] = model, y[i : i + 1] if moves.all() else y[i : i + 1, moves]
    return [models[k] for k in range(len(motions))]


def sine_powers(y: Floats) -> Floats:
    """Return the squared sine modes (orthonormal DST-I) of steps along the last axis.

    Examples
    --------
    >>> float(sine_powers(np.array([[1.0, 2.0, 2.0]])).sum().round(12))
    9.0
    """
    from scipy.fft import dst

    return np.asarray(dst(y, type=1, norm="ortho", axis=-1) ** 2)


def clustering(u: Floats) -> Floats:
    """Return the weighted sum of the first 20 autocorrelations of u along the last axis.

    Large and small values that come in groups make it positive.

    Examples
    --------
    >>> u = np.repeat([1.0, 3.0, 1.0, 3.0], 50)
    >>> bool(clustering(u) > 6)
    True
    """
    n = u.shape[-1]
    x = u - u.mean(axis=-1, keepdims=True)
    lags = min(_CLUSTERING_LAGS, n - 1)
    variance = np.sum(x * x, axis=-1)
    total = np.zeros_like(variance)
    for lag in range(1, lags + 1):
        weight = 1 - lag / (lags + 1)
        total += weight * np.einsum("...n,...n->...", x[..., lag:], x[..., :-lag])
    return np.asarray(total / variance)


def slow_change(u: Floats, axes: int) -> Floats:
    """Return the mean square of the cumulated u - mean, in its asymptotic unit.

    For independent chi-squared numbers with `axes` degrees of freedom it has the Cramer-von Mises
    law.

    Examples
    --------
    >>> slow_change(np.array([2.0, 2.0, 2.0]), 2)
    array(0.)
    """
    x = np.cumsum(u - u.mean(axis=-1, keepdims=True), axis=-1)
    return np.asarray(np.mean(x * x, axis=-1) / (2 * axes * u.shape[-1]))


def largest_share(u: Floats, axes: int) -> Floats:
    """Return -ln p of the largest of N chi-squared numbers, given their sum.

    The share of one in the sum has a Beta law.

    Examples
    --------
    >>> bool(largest_share(np.array([1.0, 1.0, 1.0]), 3) < 0.2)
    True
    >>> bool(largest_share(np.array([1.0] * 99 + [40.0]), 3) > 5)
    True
    """
    from scipy.special import betainc

    n = u.shape[-1]
    share = u.max(axis=-1) / u.sum(axis=-1)
    single = betainc((n - 1) * axes / 2, axes / 2, 1 - share)
    return np.asarray(-np.log(np.maximum(-np.expm1(n * np.log1p(-single)), 1e-300)))


def tabulated_statistics(u: Floats, axes: int) -> dict[str, Floats]:
    """Return the statistics of u whose laws stand in the table, scaled to vary little with N.

    Parameters
    ----------
    u : ndarray, shape (..., N)
        Sums over the axes of squared prediction errors, of mean `axes`.
    axes : int
        Number of axes.

    Returns
    -------
    dict of str to ndarray, shape (...,)
        "clustering", "slow change" and "tails" (the mean square, Mardia's kurtosis).

    Examples
    --------
    >>> sorted(tabulated_statistics(np.array([1.0, 2.0, 3.0]), 2))
    ['clustering', 'slow change', 'tails']
    """
    root = np.sqrt(u.shape[-1])
    return {
        "clustering": root * clustering(u),
        "slow change": slow_change(u, axes),
        "tails": root * (np.mean(u * u, axis=-1) / (axes * (axes + 2)) - 1),
    }


@lru_cache(maxsize=1)
def _quantile_table() -> dict[tuple[str, int], tuple[Floats, Floats]]:
    """Return the lengths and the quantiles (lengths, probabilities) by statistic and axes."""
    from importlib.resources import files

    text = files("perrin.diffusion").joinpath("brownian_quantiles.csv").read_text("utf-8")
    head, *lines = text.splitlines()
    table: dict[tuple[str, int], list[list[float]]] = {}
    for line in lines:
        name, axes, *numbers = line.split(",")
        table.setdefault((name, int(axes)), []).append([float(x) for x in numbers])
    table["probability", 0] = [[0.0, *(float(x) for x in head.split(",")[3:])]]
    arrays = {key: np.array(rows) for key, rows in table.items()}
    return {key: (rows[:, 0], rows[:, 1:]) for key, rows in arrays.items()}


def tabulated_p(name: str, statistic: Floats, *, axes: int, n_steps: int) -> Floats:
    """Return the probability of a larger statistic, from the table of its law.

    Quantiles are interpolated in 1/sqrt(N), logarithms of probabilities between quantiles; beyond
    the last one, p = 0.001, the logarithm is continued as a straight line.

    Parameters
    ----------
    name : str
        A name in `tabulated_statistics`.
    statistic : ndarray
        Its values.
    axes, n_steps : int
        Axes and steps.

    Examples
    --------
    >>> float(tabulated_p("slow change", np.array(0.4614), axes=3, n_steps=10**6).round(2))
    0.05
    """
    table = _quantile_table()
    probability = table["probability", 0][1][0]
    lengths, rows = table[name, axes]
    x, at = 1 / np.sqrt(lengths[::-1]), 1 / np.sqrt(n_steps)
    quantiles = np.array([np.interp(at, x, column[::-1]) for column in rows.T])
    log_p = np.log(probability)
    inside = np.interp(statistic, quantiles, log_p, left=0.0)
    slope = (log_p[-1] - log_p[-3]) / (quantiles[-1] - quantiles[-3])
    beyond = log_p[-1] + slope * (statistic - quantiles[-1])
    return np.asarray(np.exp(np.where(statistic > quantiles[-1], beyond, inside)))


def score_p(score: Score, *, one_sided: bool) -> Floats:
    """Return p-values of scores, (B,).

    Each group of modes is taken as a centred gamma variable with its second and third cumulant, of
    the cumulant generating function -a ln(1 - s t) - a s t with shape a and scale s. The tail
    probability of their sum is that of the saddle point (Lugannani and Rice 1980).

    Examples
    --------
    >>> normal = Score(np.array([1.96]), np.full((4, 1), 0.25), np.zeros((4, 1)))
    >>> score_p(normal, one_sided=False).round(3)
    array([0.05])
    """
    from scipy.special import ndtr

    unit = np.sqrt(score.information)
    least = 1e-7 * unit
    variance = np.maximum(score.variance, 1e-14 * unit**2)
    s = score.third / (2 * variance)
    s = np.where(np.abs(s) < least, least, s)
    a = variance / s**2
    high = np.min(np.where(s > 0, 1 / s, np.inf), axis=0)
    low = np.max(np.where(s < 0, 1 / s, -np.inf), axis=0)
    high, low = np.minimum(high, 1e3 / unit), np.maximum(low, -1e3 / unit)
    t = np.zeros_like(score.value)
    for _ in range(80):
        # Newton steps towards the saddle point, halved into the bracket.
        left = 1 / (1 - s * t)
        excess = np.sum(variance * t * left, axis=0) - score.value
        low, high = np.where(excess < 0, t, low), np.where(excess < 0, high, t)
        move = excess / np.sum(variance * left * left, axis=0)
        newton = t - move
        t = np.where((newton >= low) & (newton <= high), newton, 0.5 * (low + high))
        if np.all(np.abs(move) * unit <= 1e-12):
            break
    generating = -np.sum(a * (np.log1p(-s * t) + s * t), axis=0)
    curvature = np.sum(variance / (1 - s * t) ** 2, axis=0)
    w = np.sign(t) * np.sqrt(np.maximum(2 * (t * score.value - generating), 0.0))
    v = t * np.sqrt(curvature)
    middle = -score.third.sum(axis=0) / (6 * curvature**1.5)
    with np.errstate(divide="ignore", invalid="ignore"):
        correction = np.where(np.abs(w) < 1e-4, middle, 1 / v - 1 / w)
    density = np.exp(-0.5 * w * w) / np.sqrt(2 * np.pi)
    upper = np.clip(ndtr(-w) + density * correction, 0.0, 1.0)
    p = upper if one_sided else 2 * np.minimum(upper, 1 - upper)
    return np.asarray(np.clip(p, 1e-300, 1.0))


def holm(p: Floats) -> float:
    """Return the family-wise p-value of the smallest of several p-values (Holm 1979).

    Examples
    --------
    >>> holm(np.array([0.01, 0.5]))
    0.02
    """
    known = p[np.isfinite(p)]
    return float(min(1.0, known.size * known.min()))


def fisher(p: Sequence[float]) -> float:
    """Return the combined p-value of independent tests of one hypothesis (Fisher 1925).

    Examples
    --------
    >>> round(fisher([0.05, 0.05]), 4)
    0.0175
    """
    from scipy.special import gammaincc

    logs = -np.log(np.maximum(np.asarray(p, dtype=np.float64), 1e-300))
    return float(gammaincc(logs.size, logs.sum()))


class FittedSteps(NamedTuple):
    """The steps of one motion with the Brownian motion that is fitted to them.

    Attributes
    ----------
    model : AxisModel
    fit : AxisFit
        D and offset of every axis.
    u : ndarray, shape (N,)
        Sums over the axes of squared prediction errors, scaled to the number of axes on average.
    """

    model: AxisModel
    fit: AxisFit
    u: Floats

    @classmethod
    def of(cls, model: AxisModel, y: Floats) -> FittedSteps:
        """Fit the model to the steps (1, A, N) of one motion."""
        fit = model.fit(y)
        return cls(model, fit, model.squared_errors(fit)[0])


class BrownianSummary(NamedTuple):
    """What the tests of one motion contribute to the verdict on several.

    Attributes
    ----------
    p : dict of str to float
        p-value of every test, as in `BrownianTests`.
    scores : tuple of Score
        Of fractional and of confined motion.
    n_steps : int
    mean_D : float
        Mean over the axes.
    mean_tau : float
        Mean duration of a step, s.
    """

    p: dict[str, float]
    scores: tuple[Score, Score]
    n_steps: int
    mean_D: float
    mean_tau: float


@dataclass(frozen=True, eq=False)
class BrownianTests:
    """The tests of one motion against Brownian motion with constant noise.

    Attributes
    ----------
    p : dict of str to float
        p-value of every test: "fractional" (exponent of the MSD, two-sided), "cage" (confinement),
        "steady" (velocity or spin), "clustering" (of the variance), "slow change" (of the
        variance), "tails", "largest" (step) and "line" (one line in the spectrum).
    model : AxisModel
    fit : AxisFit
        D and offset of every axis.
    scores : tuple of Score
        Of fractional and of confined motion.
    u : ndarray, shape (N,)
        Sums over the axes of squared prediction errors, scaled to the number of axes on average.
    ranked : bool
        Whether the p-values come from draws.
    """

    p: dict[str, float]
    model: AxisModel
    fit: AxisFit
    scores: tuple[Score, Score]
    u: Floats
    ranked: bool

    def __post_init__(self) -> None:
        frozen(self.u)

    @property
    def fitted(self) -> FittedSteps:
        """The steps with their fit."""
        return FittedSteps(self.model, self.fit, self.u)

    @cached_property
    def summary(self) -> BrownianSummary:
        """What the verdict on several motions needs."""
        mean_D, model = float(self.fit.D.mean()), self.model
        return BrownianSummary(self.p, self.scores, model.n_steps, mean_D, model.mean_tau)


def brownian_tests(model: AxisModel, y: Floats) -> BrownianTests:
    """Test the steps of one motion against Brownian motion.

    Below 200 steps, or 10 steps times the signal-to-noise ratio, the p-values are ranks among those
    of draws from the fit.

    Parameters
    ----------
    model : AxisModel
    y : ndarray, shape (1, A, N)
        Steps.

    Examples
    --------
    >>> from perrin import Cluster, Noise, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=3)
    >>> tests = brownian_tests(*axis_model(truth, "rotation", Noise()))
    >>> holm(np.array(list(tests.p.values()))) > 0.05
    True
    """
    _, fit, u = FittedSteps.of(model, y)
    scores = model.scores(fit) if model.even else model.dense_scores(fit, y)
    p = approximate_p(model, fit, scores, u[None])
    return _ranked_if_short(
        model, fit, scores, u, {name: float(value[0]) for name, value in p.items()}
    )


def brownian_tests_of_each(
    each: Sequence[tuple[AxisModel, Floats]],
    *,
    progress: Callable[[], None] | None = None,
) -> list[BrownianTests]:
    """Test the steps of several motions, each alone, as `brownian_tests`; alike ones together.

    Parameters
    ----------
    each : sequence of tuple
        Model and steps (1, A, N) of every motion.
    progress : callable, optional
        Is called after each motion that has been tested.

    Examples
    --------
    >>> from perrin import Cluster, Noise, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=3)
    >>> one = axis_model(truth, "rotation", Noise())
    >>> first, second = brownian_tests_of_each([one, one])
    >>> first.p["cage"] == second.p["cage"]
    True
    """
    keys: list[Hashable] = []
    for i, (model, y) in enumerate(each):
        equal_noise = np.all(np.ptp(model.known[0], axis=-1) == 0)
        duration = float(model.tau[0])
        key = (y.shape[1:], model.steady.shape[-1], duration, model.blur, model.free)
        keys.append(key if model.even and equal_noise else i)
    found: dict[int, BrownianTests] = {}
    for rows in groups_alike(keys, [y.size for _, y in each], most=_MOST_SCORES):
        if len(rows) == 1:
            found[rows[0]] = brownian_tests(*each[rows[0]])
            if progress is not None:
                progress()
            continue
        some = [each[i] for i in rows]
        before, after = (np.stack([model.known[e] for model, _ in some]) for e in (0, 1))
        together = replace(
            some[0][0],
            known=(before, after),
            steady=np.stack([model.steady for model, _ in some]),
        )
        fit = together.fit(np.concatenate([y for _, y in some]))
        scores = together.scores(fit)
        u = together.squared_errors(fit)
        p = approximate_p(together, fit, scores, u)
        for j, (i, (model, _)) in enumerate(zip(rows, some, strict=True)):
            one = slice(j, j + 1)
            found[i] = _ranked_if_short(
                model,
                AxisFit(fit.y[one], fit.D[one], fit.offset[one]),
                (
                    Score(*(x[..., one] for x in scores[0])),
                    Score(*(x[..., one] for x in scores[1])),
                ),
                u[j],
                {name: float(value[j]) for name, value in p.items()},
            )
            if progress is not None:
                progress()
    return [found[i] for i in range(len(each))]


def _ranked_if_short(
    model: AxisModel,
    fit: AxisFit,
    scores: tuple[Score, Score],
    u: Floats,
    p: dict[str, float],
) -> BrownianTests:
    """Return the tests of one motion, ranked among draws where the laws of p do not hold."""
    n, y = model.n_steps, fit.y
    signal = float(fit.D.mean()) * model.mean_tau
    noise = float((fit.offset + model.mean_known).mean())
    # Without noise, in any unit of length, the ratio has no bound.
    snr = float(signal / noise) if noise > 1e-30 * signal else (np.inf if signal > 0 else 0.0)
    ranked = n < _FEWEST_ASYMPTOTIC_STEPS or 0 < n * snr < _LEAST_INFORMATION
    if ranked:
        count = int(np.clip(_DRAWN_NUMBERS // y.size, _FEWEST_DRAWS, _MOST_DRAWS))
        # The draws differ from track to track, so that their errors do not add up over tracks, and
        # are the same when a track is judged again.
        seed = zlib.crc32(np.round(y / np.abs(y).max(), 9).tobytes())
        drawn = model.draws(fit, count=count, rng=np.random.default_rng(seed))
        near = model.fit(drawn, near=fit)
        again = model.scores(near) if model.even else model.dense_scores(fit, drawn)
        null = approximate_p(model, near, again, model.squared_errors(near))
        ranks = {}
        for name, one in p.items():
            # The rank among those of the draws, continued below the smallest of these.
            order = np.sort(null[name])
            below = int(np.searchsorted(order, one, side="right"))
            rank = (1 + max(below, _TAIL_RANK)) / (1 + len(order))
            edge = float(order[_TAIL_RANK - 1])
            ranks[name] = rank if below >= _TAIL_RANK else rank * one / edge
        p = ranks
    return BrownianTests(p, model, fit, scores, u, ranked)


def approximate_p(
    model: AxisModel, fit: AxisFit, scores: tuple[Score, Score], u: Floats
) -> dict[str, Floats]:
    """Return the p-values of every test of every data set by their approximate laws, (B,) each.

    Parameters
    ----------
    model, fit, scores
        Model, its fit, and the scores of the two alternatives.
    u : ndarray, shape (B, N)
        Squared prediction errors of every step.

    Examples
    --------
    >>> from perrin import Cluster, Noise, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=3)
    >>> model, y = axis_model(truth, "rotation", Noise())
    >>> fit = model.fit(y)
    >>> tuple(approximate_p(model, fit, model.scores(fit), model.squared_errors(fit))) == TESTS
    True
    """
    axes = fit.D.shape[1]
    statistics = tabulated_statistics(u, axes)
    by_table = {
        name: tabulated_p(name, x, axes=axes, n_steps=model.n_steps)
        for name, x in statistics.items()
    }
    modes = np.sum(model.mode_ratios(fit), axis=1)
    return {
        "fractional": score_p(scores[0], one_sided=False),
        "cage": score_p(scores[1], one_sided=True),
        "steady": model.steady_motion(fit)[2],
        **by_table,
        "largest": np.exp(-largest_share(u, axes)),
        "line": np.exp(-largest_share(modes[:, FEWEST_HALF_PERIODS - 1 :], axes)),
    }
