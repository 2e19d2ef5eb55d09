"""The greatest likelihoods of many motions with even steps, each with a tensor of its own."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from perrin.diffusion.tensor_likelihood import (
    CONVERGED_GAIN,
    FARTHEST_REACH,
    FIRST_REACH,
    LEAST_BLUR,
    MOST_BLUR,
    MOST_HESSIANS,
    MOST_STRAIGHT_STEPS,
    NEAREST_REACH,
    ROUNDING_GAIN,
    START_ANGLES,
    STEPS_A_HESSIAN,
    STRAIGHT_GAIN,
    ArrowHessian,
    Maximum,
    at_blur,
    bfgs_update,
    changed_noise,
    noise_range,
    noise_turns,
)
from perrin.diffusion.tensor_modes import EvenTracks

if TYPE_CHECKING:
    from collections.abc import Sequence

    from perrin._arrays import Floats, Ints
    from perrin.diffusion.tensor_likelihood import Family, NoisyVectors
    from perrin.diffusion.tensor_modes import TensorSlopes

# Times that a step may be shortened, by this factor.
_MOST_SHORTENED, _SHORTER = 16, 0.4


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
        sums = self.tracks.diagonal(tensor[0], theta, B)
        found = self.tracks.slopes(tensor[0], B, sums)
        value, slope = self.straight_slopes(tensor, theta, B, found)
        slope[:, tensor[1].shape[1] :] *= noise_turns(own, blurred=self.B is None)[0]
        return value, slope

    def straight_slopes(
        self, tensor: tuple[Floats, Floats, Floats], theta: Floats, B: Floats, found: TensorSlopes
    ) -> tuple[Floats, Floats]:
        """Return log-likelihoods (P,) and slopes by the noise amplitudes and B themselves."""
        value, slopes = found.value, [np.einsum("pab,pkab->pk", found.D, tensor[1])]
        if np.isfinite(self.freedom).all():
            measured, by_theta, _ = self.measurement(theta)
            value = value + measured.sum(axis=1)
            slopes.append(found.theta + by_theta)
        if self.B is None:
            value = value - LEAST_BLUR * B
            slopes.append((found.B - LEAST_BLUR)[:, None])
        return value, np.concatenate(slopes, axis=1)

    def measurement(self, theta: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the log-likelihood of the measured amplitudes and two derivatives, (P, r) each."""
        half = 0.5 * self.freedom[:, None]
        if not half.any():
            return np.zeros_like(theta), np.zeros_like(theta), np.zeros_like(theta)
        ratio = self.theta / theta
        value = half * (np.log(ratio) - ratio)
        return value, half * (ratio - 1) / theta, half * (1 - 2 * ratio) / theta**2

    def straight_expansion(
        self, tensor: tuple[Floats, Floats, Floats], own: Floats
    ) -> tuple[Floats, Floats, Floats]:
        """Return log-likelihoods (P,), slopes (P, m + c) and minus the Hessians (P, m + c, m + c).

        The derivatives are those by the parameters of D, the noise amplitudes and B themselves.
        """
        (D, slopes, bends), tracks = tensor, self.tracks
        m, r = slopes.shape[1], self.theta.shape[1]
        theta, B = self.amplitudes(own)
        sums = tracks.diagonal(D, theta, B, curved=True)
        found = tracks.slopes(D, B, sums)
        full = tracks.curvatures(slopes, D, B, sums)
        full[:, :m, :m] -= np.einsum("pklab,pab->pkl", bends, found.D)
        # The noise less its blur contains -2 B dt D, which is not linear.
        mixed = 2 * tracks.dt[:, None] * np.einsum("pkab,pab->pk", slopes, found.noise)
        full[:, :m, -1] += mixed
        full[:, -1, :m] += mixed
        kept = list(range(m))
        if np.isfinite(self.freedom).all():
            amplitudes = np.arange(m, m + r)
            full[:, amplitudes, amplitudes] -= self.measurement(theta)[2]
            kept += amplitudes.tolist()
        if self.B is None:
            kept.append(m + r)
        value, slope = self.straight_slopes(tensor, theta, B, found)
        return value, slope, np.asarray(full[:, kept][:, :, kept])

    def expansion(
        self, tensor: tuple[Floats, Floats, Floats], own: Floats
    ) -> tuple[Floats, Floats, Floats]:
        """Return what `straight_expansion` does, by the free parameters of the noise."""
        value, slope, full = self.straight_expansion(tensor, own)
        m = tensor[1].shape[1]
        first, second = noise_turns(own, blurred=self.B is None)
        turn = np.concatenate([np.ones((len(own), m)), first], axis=1)
        full *= turn[:, :, None] * turn[:, None]
        noise = np.arange(m, turn.shape[1])
        full[:, noise, noise] -= second * slope[:, m:]
        return value, slope * turn, full


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
    tracks: SeparateTensors, family: Family, q: Floats, own: Floats, *, near: bool = False
) -> list[Maximum | None]:
    """Return the maxima over a family of D, one for each motion, and over their noise.

    The search is that of `maximise`: with Newton steps by the noise amplitudes and the blur
    themselves, from a small and from a large blur where that is unknown; then, from the higher end
    of the two, with quasi-Newton (BFGS) ones from the Hessian, which is computed again where no
    step increases the likelihood, and after every ten steps.

    Parameters
    ----------
    tracks : SeparateTensors
    family : callable
        Family of tensors (P, ...) of the parameters (P, m).
    q : ndarray, shape (P, m)
        Parameters to start from.
    own : ndarray, shape (P, c)
        Free parameters of the noise to start from.
    near : bool
        As in `maximise`.

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
    count, m, active = len(q), q.shape[1], np.arange(len(q))
    if tracks.B is None and not near:
        noise, D = tracks.tracks.shapes.sum(axis=1), family(q, active)[0]
        ratio = 2 * tracks.tracks.dt * np.trace(D, axis1=1, axis2=2)
        ratio /= np.trace(noise, axis1=1, axis2=2)
        ends, heights = climbed_each(
            tracks.rows(np.tile(active, 2)),
            lambda q, rows: family(q, rows % count),
            np.tile(q, (2, 1)),
            np.concatenate([at_blur(own, angle, ratio) for angle in START_ANGLES]),
        )
        p = ends[np.argmax(heights.reshape(2, count), axis=0) * count + active]
    else:
        p, _ = climbed_each(tracks, family, q, own)
    found: list[Maximum | None] = [None] * len(q)
    value, slope, hessian = tracks.expansion(family(p[:, :m], active), p[:, m:])
    inverse = ArrowHessian.of_single_motions(hessian, m).inverse()
    # Steps since the last Hessian, number of Hessians, and times that this step was shortened.
    steps, hessians, shorter = np.zeros((3, len(q)), dtype=np.int64)
    while active.size:
        step = (inverse @ slope[..., None])[..., 0]
        gain = 0.5 * np.sum(slope * step, axis=1)
        done = gain <= CONVERGED_GAIN
        lost = ~done & (hessians >= MOST_HESSIANS)
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
        again = np.flatnonzero((steps >= STEPS_A_HESSIAN) | (shorter >= _MOST_SHORTENED))
        if again.size:
            place = p[active[again]]
            tensor = family(place[:, :m], active[again])
            hessian = tracks.rows(again).expansion(tensor, place[:, m:])[2]
            inverse[again] = ArrowHessian.of_single_motions(hessian, m).inverse()
            steps[again] = shorter[again] = 0
            hessians[again] += 1
    return found


def climbed_each(
    tracks: SeparateTensors, family: Family, q: Floats, own: Floats
) -> tuple[Floats, Floats]:
    """Return higher points (P, m + c) of a search and their values, by Newton steps that gain.

    The steps are those of `PooledLikelihood.climbed`: by the parameters of D, the noise amplitudes
    and the blur, at most a part of the way to the edges of the latter. The parameters are those of
    `maximise_each`.

    Examples
    --------
    >>> from perrin import Cluster, Noise, simulate_motion
    >>> from perrin.diffusion import ScaledTracks, body_steps, squares
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=3)
    >>> data = ScaledTracks.of([body_steps(truth, "rotation", np.eye(3))], Noise())
    >>> own = np.array([track.start() for track in data.tracks])
    >>> each, start = SeparateTensors.of(data.tracks), np.full((1, 1), 3.0)
    >>> ends, values = climbed_each(each, squares(np.eye(3)[None]), start, own)
    >>> bool(abs(data.in_units(ends[0, 0] ** 2 * np.eye(3))[0, 0] - 5e-3) < 1e-3)
    True
    """
    p, m, active = np.concatenate([q, own], axis=1), q.shape[1], np.arange(len(q))
    blurred, reach = tracks.B is None, np.full(len(q), FIRST_REACH)
    value, slope, hessian = tracks.straight_expansion(family(q, active), own)
    highest = value.copy()
    for _ in range(MOST_STRAIGHT_STEPS):
        here = p[active]
        limits = noise_range(here[:, None, m:], reach[:, None, None], blurred=blurred)
        arrow = ArrowHessian.of_single_motions(hessian, m)
        of_D, of_noise = arrow.step_within(slope[:, :m], slope[:, None, m:], limits)
        gain = np.sum(slope[:, :m] * of_D, axis=1) + np.sum(slope[:, m:] * of_noise[:, 0], axis=1)
        kept = np.flatnonzero((gain > STRAIGHT_GAIN) & (reach >= NEAREST_REACH))
        if not kept.size:
            break
        active, here, reach, tracks = active[kept], here[kept], reach[kept], tracks.rows(kept)
        value, slope, hessian = value[kept], slope[kept], hessian[kept]
        noise = changed_noise(here[:, m:], of_noise[kept, 0], blurred=blurred)
        trial = np.concatenate([here[:, :m] + of_D[kept], noise], axis=1)
        ahead = tracks.straight_expansion(family(trial[:, :m], active), noise)
        rises = ahead[0] > value
        p[active[rises]], highest[active[rises]] = trial[rises], ahead[0][rises]
        for old, new in zip((value, slope, hessian), ahead, strict=True):
            old[rises] = new[rises]
        reach = np.where(rises, np.minimum(2 * reach, FARTHEST_REACH), 0.25 * reach)
    return p, highest


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
    hessian = tracks.expansion((D, directions, straight), own)[2]
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
