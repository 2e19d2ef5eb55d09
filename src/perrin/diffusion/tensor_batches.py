"""The greatest likelihoods of many motions with even steps, each with a tensor of its own."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from perrin.diffusion.tensor_likelihood import (
    CONVERGED_GAIN,
    LEAST_BLUR,
    MOST_BLUR,
    ROUNDING_GAIN,
    Maximum,
    bfgs_update,
    positive_inverse,
)
from perrin.diffusion.tensor_modes import EvenTracks

if TYPE_CHECKING:
    from collections.abc import Sequence

    from perrin._arrays import Floats, Ints
    from perrin.diffusion.tensor_likelihood import Family, NoisyVectors

# Hessians that a search may need less one, steps from one of them, and times that a step may be
# shortened, by this factor.
_MOST_HESSIANS, _STEPS_A_HESSIAN, _MOST_SHORTENED, _SHORTER = 20, 30, 16, 0.4


@dataclass(frozen=True, eq=False)
class SeparateTensors:
    """The likelihoods of P motions with even steps, each with a tensor and a noise of its own.

    Attributes
    ----------
    tracks : EvenTracks
        Their steps.
    theta : ndarray, shape (P, r)
        Noise amplitudes: known, measured, or a first guess.
    freedom : ndarray, shape (P,)
        Degrees of freedom of that measurement; 0 for a guess, inf where they are known.
    B : float or None
        Blur coefficient; None where it is unknown.
    """

    tracks: EvenTracks
    theta: Floats
    freedom: Floats
    B: float | None

    @classmethod
    def of(cls, tracks: Sequence[NoisyVectors]) -> SeparateTensors:
        """Return the likelihoods of motions with the same `batch_key`."""
        return cls(
            EvenTracks.of([t.steps for t in tracks]),
            np.stack([t.theta for t in tracks]),
            np.array([t.freedom for t in tracks]),
            tracks[0].B,
        )

    def rows(self, rows: Ints) -> SeparateTensors:
        """Return the likelihoods of some of the motions."""
        return replace(
            self,
            tracks=self.tracks.rows(rows),
            theta=self.theta[rows],
            freedom=self.freedom[rows],
        )

    def amplitudes(self, own: Floats) -> tuple[Floats, Floats]:
        """Return the noise amplitudes (P, r) and B (P,) of the free parameters (P, c)."""
        r = self.theta.shape[1]
        theta = own[:, :r] ** 2 if np.isfinite(self.freedom).all() else self.theta
        if self.B is None:
            return theta, MOST_BLUR * np.sin(own[:, -1]) ** 2
        return theta, np.full(len(own), self.B)

    def slopes(self, tensor: tuple[Floats, Floats, Floats], own: Floats) -> tuple[Floats, Floats]:
        """Return log-likelihoods (P,) and slopes (P, m + c) by the parameters of D and noise.

        Parameters
        ----------
        tensor : tuple of ndarray
            D (P, b, b) and its derivatives (P, m, b, b) and (P, m, m, b, b).
        own : ndarray, shape (P, c)
            Free parameters of the noise, as in `NoisyVectors.start`.
        """
        theta, B = self.amplitudes(own)
        modes = self.tracks.diagonal(tensor[0], theta, B)
        found = self.tracks.slopes(tensor[0], B, modes)
        value, by_own = found.value, []
        if np.isfinite(self.freedom).all():
            measured, by_theta, _ = self.measurement(theta)
            value = value + measured.sum(axis=1)
            by_own.append(2 * own[:, : theta.shape[1]] * (found.theta + by_theta))
        if self.B is None:
            value = value - LEAST_BLUR * B
            by_own.append(((found.B - LEAST_BLUR) * MOST_BLUR * np.sin(2 * own[:, -1]))[:, None])
        by_q = np.einsum("pab,pkab->pk", found.D, tensor[1])
        return value, np.concatenate([by_q, *by_own], axis=1)

    def measurement(self, theta: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the log-likelihood of the measured amplitudes and two derivatives, (P, r) each."""
        half = 0.5 * self.freedom[:, None]
        if not half.any():
            return np.zeros_like(theta), np.zeros_like(theta), np.zeros_like(theta)
        ratio = self.theta / theta
        value = half * (np.log(ratio) - ratio)
        return value, half * (ratio - 1) / theta, half * (1 - 2 * ratio) / theta**2

    def hessians(self, tensor: tuple[Floats, Floats, Floats], own: Floats) -> Floats:
        """Return minus the Hessians (P, m + c, m + c) by the parameters of D and noise."""
        (D, slopes, bends), tracks = tensor, self.tracks
        m, r = slopes.shape[1], self.theta.shape[1]
        theta, B = self.amplitudes(own)
        modes = tracks.diagonal(D, theta, B)
        found = tracks.slopes(D, B, modes)
        full = tracks.curvatures(slopes, D, B, modes)
        full[:, :m, :m] -= np.einsum("pklab,pab->pkl", bends, found.D)
        # The noise less its blur contains -2 B dt D, which is not linear.
        mixed = 2 * tracks.dt[:, None] * np.einsum("pkab,pab->pk", slopes, found.noise)
        full[:, :m, -1] += mixed
        full[:, -1, :m] += mixed
        turn, kept, amplitudes = np.ones((len(own), m + r + 1)), list(range(m)), np.arange(m, m + r)
        twice = np.zeros_like(turn)
        if np.isfinite(self.freedom).all():
            _, by_theta, bend = self.measurement(theta)
            full[:, amplitudes, amplitudes] -= bend
            turn[:, m : m + r] = 2 * own[:, :r]
            twice[:, m : m + r] = 2 * (found.theta + by_theta)
            kept += amplitudes.tolist()
        if self.B is None:
            turn[:, -1] = MOST_BLUR * np.sin(2 * own[:, -1])
            twice[:, -1] = (found.B - LEAST_BLUR) * 2 * MOST_BLUR * np.cos(2 * own[:, -1])
            kept.append(m + r)
        full *= turn[:, :, None] * turn[:, None]
        every = np.arange(m + r + 1)
        full[:, every, every] -= twice
        return np.asarray(full[:, kept][:, :, kept])


def batch_key(track: NoisyVectors) -> tuple[object, ...]:
    """Return what motions with even steps have in common if they can be evaluated together.

    Examples
    --------
    >>> from perrin import Cluster, Noise, simulate_motion
    >>> from perrin.diffusion import ScaledTracks, body_steps
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=3)
    >>> data = ScaledTracks.of([body_steps(truth, "rotation", np.eye(3))], Noise())
    >>> batch_key(data.tracks[0])
    (299, 3, 1, True, None)
    """
    known = bool(np.isfinite(track.freedom))
    return (*track.steps.vectors.shape, len(track.theta), known, track.B)


def maximise_each(
    tracks: SeparateTensors, family: Family, q: Floats, own: Floats
) -> list[Maximum | None]:
    """Return the maxima over a family of D, one for each motion, and over their noise.

    The search is that of `maximise`: quasi-Newton (BFGS) from the Hessian, which is computed again
    where no step increases the likelihood, and after every 30 steps.

    Parameters
    ----------
    tracks : SeparateTensors
    family : callable
        Family of tensors (P, ...) of the parameters (P, m).
    q : ndarray, shape (P, m)
        Parameters to start from.
    own : ndarray, shape (P, c)
        Free parameters of the noise to start from.

    Returns
    -------
    list of Maximum or None
        None where the search did not converge.

    Examples
    --------
    >>> from perrin import Cluster, Noise, simulate_motion
    >>> from perrin.diffusion import ScaledTracks, body_steps, squares
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=3)
    >>> data = ScaledTracks.of([body_steps(truth, "rotation", np.eye(3))], Noise())
    >>> own = np.array([track.start() for track in data.tracks])
    >>> each = SeparateTensors.of(data.tracks)
    >>> best = maximise_each(each, squares(np.eye(3)[None]), np.ones((1, 1)), own)[0]
    >>> bool(abs(data.in_units(best.D)[0, 0] - 5e-3) < 1e-3)
    True
    """
    m, p, active = q.shape[1], np.concatenate([q, own], axis=1), np.arange(len(q))
    found: list[Maximum | None] = [None] * len(q)
    value, slope = tracks.slopes(family(q, active), own)
    inverse = _rising_inverse(tracks.hessians(family(q, active), own), m)
    # Steps since the last Hessian, number of Hessians, and times that this step was shortened.
    steps, hessians, shorter = np.zeros((3, len(q)), dtype=np.int64)
    while active.size:
        step = (inverse @ slope[..., None])[..., 0]
        gain = 0.5 * np.sum(slope * step, axis=1)
        done = gain <= CONVERGED_GAIN
        lost = ~done & (hessians >= _MOST_HESSIANS)
        done |= lost & (gain <= ROUNDING_GAIN)
        over = done | lost
        if over.any():
            ends = p[active[done]]
            D = family(ends[:, :m], active[done])[0]
            for i, end, one, height in zip(active[done], ends, D, value[done], strict=True):
                found[i] = Maximum(float(height), one, end[m:][None])
            left = ~over
            active, value, slope, inverse, step, gain, steps, hessians, shorter = (
                x[left]
                for x in (active, value, slope, inverse, step, gain, steps, hessians, shorter)
            )
            tracks = tracks.rows(np.flatnonzero(left))
            if not active.size:
                break
        part = _SHORTER**shorter
        trial = p[active] + part[:, None] * step
        height, ahead = tracks.slopes(family(trial[:, :m], active), trial[:, m:])
        rises = height > value + 1e-3 * part * gain
        rises |= (gain <= ROUNDING_GAIN) & np.isfinite(height)
        some = np.flatnonzero(rises)
        inverse[some] = bfgs_update(
            inverse[some], trial[some] - p[active[some]], slope[some] - ahead[some]
        )
        p[active[some]], value[some], slope[some] = trial[some], height[some], ahead[some]
        steps, shorter = steps + rises, np.where(rises, 0, shorter + 1)
        again = np.flatnonzero((steps >= _STEPS_A_HESSIAN) | (shorter >= _MOST_SHORTENED))
        if again.size:
            place = p[active[again]]
            hessian = tracks.rows(again).hessians(family(place[:, :m], active[again]), place[:, m:])
            inverse[again] = _rising_inverse(hessian, m)
            steps[again] = shorter[again] = 0
            hessians[again] += 1
    return found


def _rising_inverse(hessian: Floats, m: int) -> Floats:
    """Return inverses (P, m + c, m + c), negative curvatures turned positive, as `ArrowHessian`."""
    mixed = hessian[:, :m, m:]
    own = positive_inverse(hessian[:, m:, m:])
    lever = mixed @ own
    shared = positive_inverse(hessian[:, :m, :m] - lever @ np.swapaxes(mixed, 1, 2))
    inverse = np.empty_like(hessian)
    inverse[:, :m, :m] = shared
    inverse[:, :m, m:] = -shared @ lever
    inverse[:, m:, :m] = np.swapaxes(inverse[:, :m, m:], 1, 2)
    inverse[:, m:, m:] = own + np.swapaxes(lever, 1, 2) @ shared @ lever
    return inverse


def spread_each(
    tracks: SeparateTensors, best: Sequence[Maximum], basis: Floats
) -> tuple[Floats, Floats]:
    """Return directions of D (P, m, b, b) and covariances (P, m, m), as `spread` for each motion.

    Examples
    --------
    >>> from perrin import Cluster, Noise, simulate_motion
    >>> from perrin.diffusion import ScaledTracks, body_steps
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=3)
    >>> data = ScaledTracks.of([body_steps(truth, "rotation", np.eye(3))], Noise())
    >>> basis, each = np.eye(3)[None], SeparateTensors.of(data.tracks)
    >>> covariance = spread_each(each, [data.fit(basis)], basis[None])[1]
    >>> bool(0.03 < covariance[0, 0, 0] ** 0.5 < 0.1)  # relative, as the direction is D itself
    True
    """
    D, own = np.stack([one.D for one in best]), np.concatenate([one.own for one in best])
    values, axes = np.linalg.eigh(D)
    roots = np.sqrt(np.maximum(values, 1e-4 * values[:, -1:]))
    root = ((axes * roots[:, None]) @ np.swapaxes(axes, 1, 2))[:, None]
    directions = root @ basis @ root
    m = directions.shape[1]
    straight = np.zeros((len(D), m, m, *D.shape[1:]))
    hessian = tracks.hessians((D, directions, straight), own)
    covariance = np.full((len(D), m, m), np.nan)
    shared, mixed, noise = hessian[:, :m, :m], hessian[:, :m, m:], hessian[:, m:, m:]
    for k in range(len(D)):
        try:
            solved = np.linalg.solve(noise[k], mixed[k].T)
        except np.linalg.LinAlgError:
            continue
        known = shared[k] - mixed[k] @ solved
        if np.isfinite(known).all() and np.linalg.eigvalsh(known)[0] > 0:
            covariance[k] = np.linalg.inv(known)
    return directions, covariance
