"""Likelihoods of steps with tensors D whose frames are equally noisy, in axes that diagonalise D.

Even steps are taken to their sine modes, those of many motions at once; long uneven tracks to a few
modes with the same likelihood; other steps are a chain.

Mode k of the sine transform of even steps has covariance 2 D tau + w_k O, w_k = 2 (1 - cos w), and
all modes are diagonal in the axes that diagonalise D against 2 D tau + 2 O.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from perrin.compiled.loading import compiled_kernels
from perrin.diffusion.effective_modes import WINDOW, compress_steps, moment_estimate
from perrin.diffusion.step_kernels import difference_eigenvalues

if TYPE_CHECKING:
    from collections.abc import Sequence

    from perrin._arrays import Bools, Floats, Ints
    from perrin.diffusion.effective_modes import EffectiveModes
    from perrin.diffusion.steps import Steps


class TensorSlopes(NamedTuple):
    """Log-likelihoods at P points, and their derivatives.

    Attributes
    ----------
    value : ndarray, shape (P,)
        Log-likelihood; -inf, without slopes, where a covariance is not positive definite.
    D : ndarray, shape (P, b, b)
        Slopes in D.
    theta : ndarray, shape (P, r)
        Slopes in the noise amplitudes.
    B : ndarray, shape (P,)
        Slope in B.
    noise : ndarray, shape (P, b, b)
        Slopes in a noise O that is added to that of every frame.
    """

    value: Floats
    D: Floats
    theta: Floats
    B: Floats
    noise: Floats

    @classmethod
    def undefined(cls, D: Floats, theta: Floats) -> TensorSlopes:
        """Return -inf without slopes at all of these points."""
        none = np.full(len(D), np.nan)
        least = np.full(len(D), -np.inf)
        lost = np.full_like(D, np.nan)
        return cls(least, lost, np.full_like(theta, np.nan), none, lost)

    def lose(self, bad: Bools) -> None:
        """Make the likelihoods of some points undefined, in place."""
        if bad.any():
            self.value[bad] = -np.inf
            for slopes in self[1:]:
                slopes[bad] = np.nan


class ModeSums(NamedTuple):
    """Sums over the sine modes of even steps at P points, in the axes that diagonalise them all.

    q are the modes along these axes over their variances, V one over the variances, and w the
    weight of the noise in every mode.

    Attributes
    ----------
    axes : ndarray, shape (P, b, b)
        Those axes as columns, not of unit length.
    log_det : ndarray, shape (P,)
        Logarithm of the determinant of the covariance of all modes.
    form : ndarray, shape (P,)
        Sum of the squared modes over their variances.
    same, next_one : ndarray, shape (P, b, b)
        Sums of q_a q_b, less V_a on the diagonal, times 1 and w.
    power : ndarray, shape (P, b, b, 3, b)
        Sums of q_a q_b V_c times 1, w and w^2; empty where no second derivatives are wanted.
    trace : ndarray, shape (P, b, 3, b)
        Sums of V_a V_c times 1, w and w^2; empty as `power`.
    undefined : ndarray of bool, shape (P,)
        Whether the covariance is not positive definite.
    """

    axes: Floats
    log_det: Floats
    form: Floats
    same: Floats
    next_one: Floats
    power: Floats
    trace: Floats
    undefined: Bools


@dataclass(frozen=True, eq=False)
class EvenTracks:
    """Even steps of P motions of one length in their sine modes; all points of one motion if P = 1.

    Attributes
    ----------
    modes : ndarray, shape (P, b, K)
        Sine transforms of the steps.
    tau, dt : ndarray, shape (P,)
        Duration of the steps, and time between frames.
    shapes : ndarray, shape (P, r, b, b)
        Noise covariances of a frame for an amplitude of 1.
    """

    modes: Floats
    tau: Floats
    dt: Floats
    shapes: Floats

    @classmethod
    def of(cls, steps: Sequence[Steps]) -> EvenTracks:
        """Transform the even steps of some motions, of which each has as many."""
        from scipy.fft import dst

        return cls(
            dst(np.stack([s.vectors.T for s in steps]), type=1, norm="ortho", axis=2),
            np.array([s.duration[0] for s in steps]),
            np.array([s.dt for s in steps]),
            np.stack([s.noise[:, s.start[0]] for s in steps]),
        )

    def rows(self, rows: Ints) -> EvenTracks:
        """Return some of the motions."""
        return EvenTracks(self.modes[rows], self.tau[rows], self.dt[rows], self.shapes[rows])

    @property
    def weight(self) -> Floats:
        """Weight w of the noise in every mode, (K,)."""
        return np.asarray(2 * difference_eigenvalues(self.modes.shape[2]))

    def noise(self, D: Floats, theta: Floats, B: Floats) -> Floats:
        """Return the noise O of a frame, less its blur, (P, b, b)."""
        blur = (2 * B * self.dt)[:, None, None] * D
        return np.asarray(np.einsum("pr,prab->pab", theta, self.shapes) - blur)

    def diagonal(self, D: Floats, theta: Floats, B: Floats, *, curved: bool = False) -> ModeSums:
        """Return the sums over the modes at P points; `curved`: also for second derivatives."""
        motion = (2 * self.tau)[:, None, None] * D
        values, turn = np.linalg.eigh(motion + 2 * self.noise(D, theta, B))
        undefined = ~(values[:, 0] > 0)
        if undefined.any():
            values = np.where(undefined[:, None], 1.0, values)
        root = turn / np.sqrt(values)[:, None]
        share, turn = np.linalg.eigh(np.swapaxes(root, 1, 2) @ motion @ root)
        axes, b = root @ turn, D.shape[1]
        sums = mode_sums(self.modes, axes, share, self.weight, curved=curved)
        log_det, form, least = sums[:, :3].T
        squares, second = sums[:, 3 : 3 + 2 * b * b], sums[:, 3 + 2 * b * b :]
        same, next_one = squares.reshape(-1, 2, b, b).swapaxes(0, 1)
        count = len(second) if curved else 0
        power, trace = second[:count, : 3 * b**3], second[:count, 3 * b**3 :]
        return ModeSums(
            axes,
            log_det + self.modes.shape[2] * np.log(values).sum(axis=1),
            form,
            same,
            next_one,
            power.reshape(count, b, b, 3, b),
            trace.reshape(count, b, 3, b),
            undefined | ~(least > 0),
        )

    def slopes(self, D: Floats, B: Floats, sums: ModeSums) -> TensorSlopes:
        """Return the log-likelihoods and their derivatives at the points of these sums."""
        axes, back = sums.axes, np.swapaxes(sums.axes, 1, 2)
        plain, weighted = axes @ sums.same @ back, axes @ sums.next_one @ back
        value = -0.5 * (sums.log_det + sums.form)
        by_theta = 0.5 * np.einsum("pjab,pab->pj", self.shapes, weighted)
        by_B = -self.dt * (weighted * D).sum(axis=(1, 2))
        by_D = self.tau[:, None, None] * plain - (B * self.dt)[:, None, None] * weighted
        found = TensorSlopes(value, by_D, by_theta, by_B, 0.5 * weighted)
        found.lose(sums.undefined)
        return found

    def curvatures(self, E: Floats, D: Floats, B: Floats, sums: ModeSums) -> Floats:
        """Return minus the second derivatives along E (P, m, b, b), in theta and in B.

        They are those of the covariances alone, as if these were linear. With the slopes
        X_i = A_i + w_k N_i of mode k and its inverse covariance V, they are
        y^T V X_i V X_j V y - tr(V X_i V X_j)/2 summed over the modes.
        """
        of_D, of_noise = covariance_slopes(E, D, B, self.dt)
        points, m, b = E.shape[:3]
        none = np.zeros((points, self.shapes.shape[1] + 1, b, b))
        same = np.concatenate([self.tau[:, None, None, None] * of_D, none], axis=1)
        shapes = np.broadcast_to(self.shapes, (points, *self.shapes.shape[1:]))
        next_one = np.concatenate([of_noise[:, :m], shapes, of_noise[:, m:]], axis=1)
        return information(sums.axes, same, next_one, sums.power, sums.trace)


def mode_sums(
    modes: Floats, axes: Floats, share: Floats, weight: Floats, *, curved: bool
) -> Floats:
    """Return sums over modes that a likelihood with a tensor, and its derivatives, consist of.

    Mode k has the variances V_a = share_a + w_k (1 - share_a)/2 along the axes, and the amplitudes
    q over these.

    Parameters
    ----------
    modes : ndarray, shape (P or 1, b, K)
    axes : ndarray, shape (P, b, b)
        Axes as columns.
    share : ndarray, shape (P, b)
    weight : ndarray, shape (K,)
        Weights w.
    curved : bool
        Whether the sums for second derivatives are wanted.

    Returns
    -------
    ndarray, shape (P, 3 + 2 b^2) or (P, 3 + 5 b^2 + 3 b^3)
        Sum of log V; of q_a^2 V_a; the least V; sums of q_a q_b less 1/V_a on the diagonal, then
        the same times w. If `curved`: sums of q_a q_b/V_c times 1, w and w^2, as (b, b, 3, b), and
        of 1/(V_a V_c), as (b, 3, b).

    Examples
    --------
    >>> one = np.ones((1, 1, 1))
    >>> mode_sums(one, one, one[0], np.array([0.5]), curved=False)
    array([[0., 1., 1., 0., 0.]])
    """
    points, b = share.shape
    fewer = 3 + 2 * b * b
    sums = np.empty((points, fewer + 3 * b * b * (b + 1) if curved else fewer))
    kernels = compiled_kernels() if b <= 3 else None
    if kernels is not None:
        kernels.mode_sums(*map(np.ascontiguousarray, (modes, axes, share, weight)), sums)
        return sums
    variance = share[..., None] + 0.5 * weight * (1 - share[..., None])
    inverse, along = 1 / variance, np.swapaxes(axes, 1, 2) @ modes
    q = along * inverse
    with np.errstate(divide="ignore", invalid="ignore"):
        sums[:, 0] = np.log(variance).sum(axis=(1, 2))
    sums[:, 1], sums[:, 2] = (along * q).sum(axis=(1, 2)), variance.min(axis=(1, 2))
    same, next_one = (x @ np.swapaxes(q, 1, 2) for x in (q, weight * q))
    kept = np.arange(b)
    same[:, kept, kept] -= inverse.sum(axis=2)
    next_one[:, kept, kept] -= inverse @ weight
    sums[:, 3:fewer] = np.stack([same, next_one], axis=1).reshape(points, -1)
    if curved:
        powers = weight ** np.arange(3)[:, None]
        weights = (inverse[:, None] * powers[:, None]).reshape(points, 3 * b, -1)
        weights = np.swapaxes(weights, 1, 2)
        pairs = (q[:, :, None] * q[:, None]).reshape(points, b * b, -1)
        sums[:, fewer : fewer + 3 * b**3] = (pairs @ weights).reshape(points, -1)
        sums[:, fewer + 3 * b**3 :] = (inverse @ weights).reshape(points, -1)
    return sums


class FewDiagonalModes(NamedTuple):
    """The effective modes of a track at P points, in the axes that diagonalise all of them.

    Attributes
    ----------
    axes : ndarray, shape (P, b, b)
        Those axes as columns, not of unit length.
    variance, inverse : ndarray, shape (P, K, b)
        Variances of the K modes along them, and one over these.
    scaled : ndarray, shape (P, K, b, b)
        Products of amplitudes along them over both variances.
    log_det : ndarray, shape (P,)
        Logarithm of the determinant of a covariance.
    undefined : ndarray of bool, shape (P,)
        Whether the covariance is not positive definite.
    places : ndarray, shape (P, b)
        Ratio of noise to motion along the axes, as the window of the modes counts it.
    """

    axes: Floats
    variance: Floats
    inverse: Floats
    scaled: Floats
    log_det: Floats
    undefined: Bools
    places: Floats


@dataclass(frozen=True, eq=False)
class FewModesTrack:
    """A long track with equally noisy frames as effective modes of covariance d_k D + w_k O.

    Attributes
    ----------
    modes : EffectiveModes
        Modes of the pair A = 2 tau - lift W and W, the second difference: d_k = motion + lift w_k.
    lift : float
        Half the shortest step, in units of time: the noise less its blur is at least -lift D.
    shapes : ndarray, shape (r, b, b)
        Noise covariances of a frame for an amplitude of 1.
    dt : float
        Time between frames.
    count : int
        Number of steps.
    """

    modes: EffectiveModes
    lift: float
    shapes: Floats
    dt: float
    count: int

    @classmethod
    def of(
        cls,
        steps: Steps,
        shapes: Floats,
        noise: Floats | None,
        *,
        window: tuple[float, float] | None = None,
    ) -> FewModesTrack:
        """Compress the steps; the noise of a frame (b, b) is estimated from moments if not given.

        The modes are exact about these estimates, or in the window of `places` that is given.
        """
        tau, linked = steps.duration, steps.linked[:-1].astype(np.float64)
        lift, scale = 0.5 * float(tau.min()), float(tau.mean())
        if window is None:
            D, offset = moment_estimate(steps)
            values, axes = np.linalg.eigh(D)
            root = axes / np.sqrt(np.maximum(values, 0.02 * np.abs(values).max()))
            ratio = np.linalg.eigvalsh(root.T @ (offset if noise is None else noise) @ root) + lift
            places = np.log(np.maximum(ratio / scale, 1e-4))
            window = float(places.min()) - WINDOW, float(places.max()) + WINDOW
        return cls(
            compress_steps(
                steps.vectors,
                (2 * (tau - lift), lift * linked),
                (np.full(len(tau), 2.0), -linked),
                scale=scale,
                window=window,
            ),
            lift,
            shapes,
            steps.dt,
            len(tau),
        )

    def exact(self, places: Floats) -> bool:
        """Return whether the modes are exact at all of these log ratios of noise to motion."""
        low, high = self.modes.window
        return bool(np.all((places >= low) & (places <= high) | (places == np.inf)))

    @property
    def motion(self) -> Floats:
        """Weight d of the motion in every mode, (K,)."""
        return np.asarray(self.modes.motion + self.lift * self.modes.noise)

    def diagonal(self, D: Floats, theta: Floats, B: Floats) -> FewDiagonalModes:
        """Return the modes in the axes that diagonalise all of them, at P points."""
        modes, scale = self.modes, self.modes.scale
        lifted = (self.lift - 2 * B * self.dt)[:, None, None] * D
        noise = np.einsum("pr,rab->pab", theta, self.shapes) + lifted
        values, turn = np.linalg.eigh(scale * D + noise)
        undefined = ~(values[:, 0] > 0)
        if undefined.any():
            values = np.where(undefined[:, None], 1.0, values)
        root = turn / np.sqrt(values)[:, None]
        share, turn = np.linalg.eigh(np.swapaxes(root, 1, 2) @ (scale * D) @ root)
        axes = root @ turn
        of_noise = 1 - share
        variance = share[:, None] * (modes.motion / scale)[:, None]
        variance = variance + of_noise[:, None] * modes.noise[:, None]
        undefined |= ~(variance.min(axis=(1, 2)) > 0)
        variance = np.where(undefined[:, None, None], 1.0, variance)
        inverse, turned = 1 / variance, axes[:, None]
        scaled = np.swapaxes(turned, 2, 3) @ modes.power @ turned
        scaled = scaled * (inverse[..., None] * inverse[:, :, None])
        log_det = self.count * np.log(values).sum(axis=1) + len(self.shapes[0]) * modes.log_det
        log_det = log_det + np.log(variance).sum(axis=2) @ modes.count
        with np.errstate(divide="ignore", invalid="ignore"):
            places = np.log(of_noise / share)
        return FewDiagonalModes(axes, variance, inverse, scaled, log_det, undefined, places)

    def slopes(self, D: Floats, B: Floats, modes: FewDiagonalModes) -> TensorSlopes:
        """Return the log-likelihoods and their derivatives at the points of these modes."""
        axes, back = modes.axes, np.swapaxes(modes.axes, 1, 2)
        weights = np.stack([self.motion, self.modes.noise])
        points, K, b = modes.inverse.shape
        sums = (weights @ modes.scaled.reshape(points, K, b * b)).reshape(points, 2, b, b)
        kept = np.arange(b)
        sums[:, :, kept, kept] -= (weights * self.modes.count) @ modes.inverse
        moved, weighted = (axes @ sums[:, j] @ back for j in (0, 1))
        form = np.einsum("pkaa,pka->p", modes.scaled, modes.variance)
        found = TensorSlopes(
            -0.5 * (modes.log_det + form),
            0.5 * moved - (B * self.dt)[:, None, None] * weighted,
            0.5 * np.einsum("jab,pab->pj", self.shapes, weighted),
            -self.dt * (weighted * D).sum(axis=(1, 2)),
            0.5 * weighted,
        )
        found.lose(modes.undefined)
        return found

    def curvatures(self, E: Floats, D: Floats, B: Floats, modes: FewDiagonalModes) -> Floats:
        """Return minus the second derivatives along E (P, m, b, b), in theta and in B.

        As `EvenTracks.curvatures`, with the slopes X_i = d_k A_i + w_k N_i of mode k.
        """
        points, m, b = E.shape[:3]
        _, of_noise = covariance_slopes(E, D, B, np.full(points, self.dt))
        none = np.zeros((points, len(self.shapes) + 1, b, b))
        of_D = np.concatenate([E, none], axis=1)
        shapes = np.broadcast_to(self.shapes, (points, *self.shapes.shape))
        next_one = np.concatenate([of_noise[:, :m], shapes, of_noise[:, m:]], axis=1)
        inverse = modes.inverse
        d, w = self.motion, self.modes.noise
        powers = np.stack([d * d, d * w, w * w], axis=1)
        weights = (inverse[:, :, None] * powers[:, :, None]).reshape(points, -1, 3 * b)
        pairs = modes.scaled.reshape(points, -1, b * b)
        counted = np.swapaxes(inverse * self.modes.count[:, None], 1, 2)
        return information(
            modes.axes,
            of_D,
            next_one,
            (np.swapaxes(pairs, 1, 2) @ weights).reshape(points, b, b, 3, b),
            (counted @ weights).reshape(points, b, 3, b),
        )


def information(
    axes: Floats, same: Floats, next_one: Floats, power: Floats, trace: Floats
) -> Floats:
    """Return minus the second derivatives of a log-likelihood from sums over its modes.

    Parameters
    ----------
    axes : ndarray, shape (P, b, b)
        Axes of the sums, as columns.
    same, next_one : ndarray, shape (P, m, b, b)
        Slopes of the covariances of the modes: those of the motion and those of the noise.
    power : ndarray, shape (P, b, b, 3, b)
        Sums of q_a q_b V_c, weighted for two slopes of motion, one of each, and two of noise.
    trace : ndarray, shape (P, b, 3, b)
        The same sums of V_a V_c.

    Examples
    --------
    >>> one = np.ones((1, 1, 1, 1))
    >>> information(one[0], one, one, 2 * np.ones((1, 1, 1, 3, 1)), np.ones((1, 1, 3, 1)))
    array([[[6.]]])
    """
    points, count, b = same.shape[:3]
    kernels = compiled_kernels() if b <= 3 else None
    if kernels is not None:
        found = np.empty((points, count, count))
        arrays = map(np.ascontiguousarray, (axes, same, next_one, power, trace))
        kernels.curvatures(*arrays, found)
        return found
    turned_axes = axes[:, None]
    same, next_one = (np.swapaxes(turned_axes, 2, 3) @ x @ turned_axes for x in (same, next_one))

    def form(k: int, left: Floats, right: Floats) -> Floats:
        # (c, a, b) times (c, b, j): sum over b of q_a q_b V_c X_j[c, b]
        turned = np.moveaxis(power[:, :, :, k], 3, 1) @ np.moveaxis(right, 1, 3)
        turned = np.moveaxis(turned, 3, 1)  # (j, c, a)
        turned = np.swapaxes(turned, 2, 3) - 0.5 * trace[:, None, :, k] * np.swapaxes(right, 2, 3)
        flat = turned.reshape(points, count, -1)
        return np.asarray(left.reshape(points, count, -1) @ np.swapaxes(flat, 1, 2))

    # Where a coordinate does not move at all its variance tends to 0 and these grow without end.
    with np.errstate(over="ignore", invalid="ignore"):
        mixed = form(1, same, next_one)
        total = form(0, same, same) + mixed + np.swapaxes(mixed, 1, 2)
        return np.asarray(total + form(2, next_one, next_one))


def covariance_slopes(E: Floats, D: Floats, B: Floats, dt: Floats) -> tuple[Floats, Floats]:
    """Return the slopes of 2 D (P, m, b, b) and of the noise less blur (P, m + 1, b, b).

    They are those along directions E (P, m, b, b) of D; the last one of the noise is that in B.

    Examples
    --------
    >>> one = np.ones((1, 1, 1))
    >>> covariance_slopes(one[None], one, np.array([0.1]), np.array([2.0]))[1].ravel()
    array([-0.4, -4. ])
    """
    blur = np.concatenate([B[:, None, None, None] * E, D[:, None]], axis=1)
    return 2 * E, -2 * dt[:, None, None, None] * blur


class Chains(NamedTuple):
    """Uneven steps at one point, in the axes that diagonalise D against 2 D tau + 2 O.

    Attributes
    ----------
    axes : ndarray, shape (b, b)
        Those axes as columns, not of unit length.
    pivots, lower : ndarray, shapes (b S,) and (b S - 1,)
        Elimination of the tridiagonal covariances along them, one after the other.
    inverse, corner : ndarray, shape (b, S)
        Diagonals of their inverses, and the elements next to these; 0 where steps are not linked.
    solved : ndarray, shape (b, S)
        Inverse covariances times steps.
    value : float
        Log-likelihood; -inf where a covariance is not positive definite.
    """

    axes: Floats
    pivots: Floats
    lower: Floats
    inverse: Floats
    corner: Floats
    solved: Floats
    value: float


@dataclass(frozen=True, eq=False)
class ChainTrack:
    """Steps of any durations and links whose frames are equally noisy.

    D and the noise O of a frame are two matrices, which are diagonal in common axes: along each of
    them the steps are a chain of their own, whose covariance is tridiagonal.

    Attributes
    ----------
    steps : Steps
    shapes : ndarray, shape (r, b, b)
        Noise covariances of a frame for an amplitude of 1.
    """

    steps: Steps
    shapes: Floats

    def at(self, D: Floats, theta: Floats, B: float) -> Chains | None:
        """Return the chains at one point; None where the covariance is not positive definite."""
        from scipy.linalg.lapack import dpttrf, dpttrs

        s, b = self.steps, len(D)
        count, tau = len(s.duration), float(s.duration.mean())
        motion = 2 * tau * D
        values, turn = np.linalg.eigh(
            motion + 2 * np.tensordot(theta, self.shapes, 1) - 4 * B * s.dt * D
        )
        if not values[0] > 0:
            return None
        root = turn / np.sqrt(values)
        share, turn = np.linalg.eigh(root.T @ motion @ root)
        axes = root @ turn
        a = (share[:, None] * (s.duration / tau) + (1 - share)[:, None]).ravel()
        off = (-0.5 * (1 - share)[:, None] * s.linked).ravel()[:-1]
        d, lower, bad = dpttrf(a, off)
        up, _, bad_up = dpttrf(a[::-1], off[::-1])
        if bad or bad_up:
            return None
        y = axes.T @ s.vectors.T
        z = dpttrs(d, lower, y.reshape(-1, 1))[0].reshape(b, count)
        inverse = 1 / (d + up[::-1] - a)
        corner = np.append(-lower * inverse[1:], 0.0).reshape(b, count) * s.linked
        log_det = np.log(d).sum() + count * np.log(values).sum()
        value = -0.5 * float(log_det + np.sum(y * z))
        return Chains(axes, d, lower, inverse.reshape(b, count), corner, z, value)

    def slopes(self, D: Floats, B: float, chains: Chains) -> TensorSlopes:
        """Return the log-likelihood and its derivatives, at one point."""
        s, z = self.steps, chains.solved
        linked = z[:, :-1] * s.linked[:-1]
        plain = (z * s.duration) @ z.T - np.diag(chains.inverse @ s.duration)
        cross = linked @ z[:, 1:].T
        weighted = 2 * z @ z.T - cross - cross.T
        weighted -= 2 * np.diag(chains.inverse.sum(axis=1) - chains.corner.sum(axis=1))
        plain, weighted = (chains.axes @ x @ chains.axes.T for x in (plain, weighted))
        return TensorSlopes(
            np.array([chains.value]),
            (plain - B * s.dt * weighted)[None],
            0.5 * np.einsum("jab,ab->j", self.shapes, weighted)[None],
            np.array([-s.dt * float(np.sum(weighted * D))]),
            0.5 * weighted[None],
        )

    def curvatures(self, E: Floats, D: Floats, B: float, chains: Chains) -> Floats:
        """Return the average of observed and expected information along E, in theta and in B.

        It is z^T X_i C^-1 X_j z/2 for the slopes X_i of C, as in `NoisyVectors.band_curvatures`.
        """
        from scipy.linalg.lapack import dpttrs

        s, z = self.steps, chains.solved
        of_D, of_noise = (
            x[0] for x in covariance_slopes(E[None], D[None], np.array([B]), np.array([s.dt]))
        )
        none = np.zeros((len(self.shapes) + 1, *D.shape))
        on = chains.axes.T @ np.concatenate([of_D, none]) @ chains.axes
        noise = np.concatenate([of_noise[:-1], self.shapes, of_noise[-1:]])
        noise = chains.axes.T @ noise @ chains.axes
        differences = 2 * z
        differences[:, :-1] -= s.linked[:-1] * z[:, 1:]
        differences[:, 1:] -= s.linked[:-1] * z[:, :-1]
        products = (on @ (z * s.duration) + noise @ differences).reshape(len(on), -1)
        solved = dpttrs(chains.pivots, chains.lower, products.T)[0]
        return np.asarray(0.5 * products @ solved)
