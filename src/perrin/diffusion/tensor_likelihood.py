"""The likelihood of steps with one tensor D, of vectors of any length, and its maximum."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from perrin.diffusion.effective_modes import LEAST_STEPS
from perrin.diffusion.tensor_modes import (
    ChainTrack,
    EvenTracks,
    FewModesTrack,
    TensorSlopes,
    covariance_slopes,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from typing import TypeAlias

    from perrin._arrays import Floats, Ints
    from perrin.diffusion.steps import Steps

    # D (..., b, b), slopes (..., m, b, b) by the m parameters of a family of tensors, and second
    # derivatives (..., m, m, b, b), of the parameters (..., m) of those motions.
    Family: TypeAlias = Callable[..., tuple[Floats, Floats, Floats]]

# The largest blur: all motion seen in the first and last instant of a frame (1/6: open shutter).
MOST_BLUR = 0.25

# Where D and noise have the same shape only noise less blur is determined; then this slope of the
# log-likelihood selects the least blur. It changes the log-likelihood by 0.025 at most.
LEAST_BLUR = 0.1

# Hessians of a search, and steps from one of them: near an edge searches take many steps.
MOST_HESSIANS, STEPS_A_HESSIAN = 60, 10

# Searches begin at these angles of B = sin^2/4, a small and a large blur: the likelihood of short,
# noisy steps may have a maximum at both ends of the ridge on which noise less blur is the same.
START_ANGLES = (0.2, 1.2)

# A search has converged where another step would gain this much: 5e-9 standard errors. A gain below
# the second number is hidden by rounding, and steps are accepted without it.
CONVERGED_GAIN, ROUNDING_GAIN = 1e-17, 1e-9

# Newton steps along a ridge: their number, their least gain, and the part of the way to an edge of
# the noise's range that a step may go at first, at most and at least.
MOST_STRAIGHT_STEPS, STRAIGHT_GAIN = 50, 1e-6
FIRST_REACH, FARTHEST_REACH, NEAREST_REACH = 0.25, 0.95, 0.01

# Frames are equally noisy if the elements of their noise agree to this.
_EQUALLY_NOISY_FRAMES = 1e-9

# Step of numerical derivatives, in scaled units where all parameters are of order 1.
_DIFFERENCE_STEP = 1e-5


@dataclass(frozen=True, eq=False)
class NoisyVectors:
    """The steps of one motion with what is known of their noise, for a tensor D.

    Step i over the time tau_i has covariance 2 D tau_i + O_i + O_{i+1}, and -O_{i+1} with step
    i + 1 where the two share a frame; O_k = sum_j theta_j C_jk - 2 B dt D is the noise of frame k,
    less the blur of its exposure.

    Attributes
    ----------
    steps : Steps
        Steps in body axes, with the noise shapes C_j of every frame.
    theta : ndarray, shape (r,)
        Noise amplitudes: known, measured, or a first guess.
    freedom : float
        Degrees of freedom of that measurement; 0 for a guess, inf where they are known.
    B : float or None
        Blur coefficient, exposure/6; None where it is unknown.
    window : tuple of float or None
        Ratios of noise to motion at which the few modes of a long uneven track are exact; those
        about an estimate from moments if None, and no such modes if empty.
    """

    steps: Steps
    theta: Floats
    freedom: float
    B: float | None
    window: tuple[float, ...] | None = None

    def start(self) -> Floats:
        """Return the free parameters of the noise to start from: square roots, then an angle."""
        amplitudes = np.sqrt(self.theta) if np.isfinite(self.freedom) else np.empty(0)
        return np.append(amplitudes, [0.6] if self.B is None else [])

    def slopes(self, D: Floats, own: Floats) -> tuple[Floats, Floats, Floats]:
        """Return log-likelihoods, their slopes by D, and by the free parameters of the noise.

        D (P, b, b) and own (P, c) are those of P points. Amplitudes are squares and B = sin^2 / 4,
        so that the search has no edges.
        """
        theta, B = self.amplitudes(own)
        found = self.by_tensor(D, theta, B)
        value, by_theta = found.value, found.theta
        out = [np.empty((len(D), 0))]
        if np.isfinite(self.freedom):
            measured, slope, _ = self.measurement(theta)
            value = value + measured.sum(axis=1)
            out.append(2 * own[:, : len(self.theta)] * (by_theta + slope))
        if self.B is None:
            value = value - LEAST_BLUR * B
            slope = MOST_BLUR * np.sin(2 * own[:, -1:])
            out.append((found.B - LEAST_BLUR)[:, None] * slope)
        return value, found.D, np.concatenate(out, axis=1)

    def amplitudes(self, own: Floats) -> tuple[Floats, Floats]:
        """Return the noise amplitudes (P, r) and B (P,) of the free parameters (P, c)."""
        free = np.isfinite(self.freedom)
        theta = own[:, : len(self.theta)] ** 2 if free else np.tile(self.theta, (len(own), 1))
        B = np.full(len(own), self.B or 0.0)
        if self.B is None:
            B = np.array([MOST_BLUR * float(one) ** 2 for one in np.sin(own[:, -1])])
        return theta, B

    def measurement(self, theta: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the log-likelihood of the measured amplitudes and two derivatives, (..., r) each.

        They are chi-squared with their degrees of freedom; 0 where they were not measured.
        """
        if not self.freedom:
            return np.zeros_like(theta), np.zeros_like(theta), np.zeros_like(theta)
        ratio, half = self.theta / theta, 0.5 * self.freedom
        value = half * (np.log(ratio) - ratio)
        return value, half * (ratio - 1) / theta, half * (1 - 2 * ratio) / theta**2

    def noise(self, D: Floats, own: Floats) -> Floats:
        """Return the mean noise O of a frame, less its blur, (b, b)."""
        theta, B = self.amplitudes(own[None])
        shape = self.steps.mean_noise
        mean = (theta[0][:, None, None] * shape).sum(axis=0)
        return np.asarray(mean - 2 * B[0] * self.steps.dt * D)

    def blur_ratio(self, D: Floats) -> float:
        """Return the noise amplitude that has the mean variance of a blur of B = 1."""
        shape = self.steps.mean_noise.sum(axis=0)
        return float(2 * self.steps.dt * np.trace(D) / np.trace(shape))

    @cached_property
    def chain_track(self) -> ChainTrack | None:
        """The steps as chains along common axes; None where frames are not equally noisy."""
        s = self.steps
        ends = np.zeros(s.noise.shape[1], dtype=np.bool_)
        ends[s.start] = ends[s.stop] = True
        noise = s.noise[:, ends]
        if not np.ptp(noise, axis=1).max() <= _EQUALLY_NOISY_FRAMES * np.abs(noise).max():
            return None
        return ChainTrack(s, noise[:, 0])

    @cached_property
    def mode_track(self) -> EvenTracks | FewModesTrack | None:
        """The steps as modes: sine modes of even ones, few modes of a long track; else None."""
        if self.steps.even:
            return EvenTracks.of([self.steps])
        few = self.window is None or len(self.window) == 2
        if not few or len(self.steps.vectors) < LEAST_STEPS or self.chain_track is None:
            return None
        shapes = self.chain_track.shapes
        noise = None if self.freedom == 0 else np.tensordot(self.theta, shapes, 1)
        window = None if self.window is None else (self.window[0], self.window[1])
        return FewModesTrack.of(self.steps, shapes, noise, window=window)

    def places(self, D: Floats, own: Floats) -> Floats | None:
        """Return the ratios of noise to motion along the axes (b,) where few modes are used."""
        track = self.mode_track
        if not isinstance(track, FewModesTrack):
            return None
        theta, B = self.amplitudes(own[None])
        return np.asarray(track.diagonal(D[None], theta, B).places[0])

    def by_tensor(self, D: Floats, theta: Floats, B: Floats) -> TensorSlopes:
        """Return the log-likelihood and its derivatives at P points; -inf where not defined."""
        if self.mode_track is not None:
            return self.by_modes(D, theta, B)
        if len(D) == 1:
            if self.chain_track is None:
                return self.by_bands(D[0], theta[0], float(B[0]))
            chains = self.chain_track.at(D[0], theta[0], float(B[0]))
            if chains is None:
                return TensorSlopes.undefined(D, theta)
            return self.chain_track.slopes(D[0], float(B[0]), chains)
        points = [
            self.by_tensor(D[p : p + 1], theta[p : p + 1], B[p : p + 1]) for p in range(len(D))
        ]
        return TensorSlopes(*(np.concatenate(rows) for rows in zip(*points, strict=True)))

    def by_modes(self, D: Floats, theta: Floats, B: Floats) -> TensorSlopes:
        """Evaluate steps as modes: even ones, or long tracks with equally noisy frames."""
        track = self.mode_track
        if isinstance(track, EvenTracks):
            return track.slopes(D, B, track.diagonal(D, theta, B))
        if track is None:
            raise ValueError("these steps are neither even nor a long track with equal noise")
        return track.slopes(D, B, track.diagonal(D, theta, B))

    def band_curvatures(self, E: Floats, D: Floats, theta: Floats, B: float) -> Floats:
        """Return the average of observed and expected information along E, in theta and in B.

        With z = C^-1 y and the slopes X_i of C it is z^T X_i C^-1 X_j z/2 (Gilmour, Thompson and
        Cullis 1995), which needs no trace.
        """
        from scipy.linalg.lapack import dpbtrs

        s = self.steps
        diagonal, off_diagonal = self.bands(D, theta, B)
        factor, _, log_det = band_factor(diagonal, off_diagonal)
        if not np.isfinite(log_det):
            return np.full((len(E) + len(theta) + 1,) * 2, np.nan)
        z = dpbtrs(factor, s.vectors.reshape(-1), lower=1)[0].reshape(s.vectors.shape)
        of_D, of_noise = (
            x[0] for x in covariance_slopes(E[None], D[None], np.array([B]), np.array([s.dt]))
        )
        linked, none = s.linked[:-1, None], np.zeros_like(D)

        def product(of_D: Floats, before: Floats, after: Floats) -> Floats:
            """Return X z for the slopes of 2 D and of the noise before and after each step."""
            out: Floats = s.duration[:, None] * (z @ of_D)
            out += np.einsum("sab,sb->sa", before + after, z)
            out[:-1] -= linked * np.einsum("sab,sb->sa", after[:-1], z[1:])
            out[1:] -= linked * np.einsum("sab,sb->sa", after[:-1], z[:-1])
            return out

        blur = [np.broadcast_to(one, s.before.shape[1:]) for one in of_noise]
        products = [product(d, n, n) for d, n in zip(of_D, blur[:-1], strict=True)]
        products += [product(none, *x) for x in zip(s.before, s.after, strict=True)]
        products.append(product(none, blur[-1], blur[-1]))
        columns = np.stack([x.reshape(-1) for x in products], axis=1)
        return np.asarray(0.5 * columns.T @ dpbtrs(factor, columns, lower=1)[0])

    def uneven_curvatures(self, E: Floats, D: Floats, theta: Floats, B: float) -> Floats:
        """Return the average information of steps that are not even, as `band_curvatures`."""
        if self.chain_track is None:
            return self.band_curvatures(E, D, theta, B)
        chains = self.chain_track.at(D, theta, B)
        if chains is None:
            return np.full((len(E) + len(theta) + 1,) * 2, np.nan)
        return self.chain_track.curvatures(E, D, B, chains)

    def curvatures(self, D: Floats, slopes: Floats, bends: Floats, own: Floats) -> Floats:
        """Return minus the Hessian by the parameters of D and of the noise, (m + c, m + c).

        `slopes` (m, b, b) and `bends` (m, m, b, b) are the derivatives of D by its parameters, and
        `own` (c,) the free parameters of the noise. Where steps are not modes the second
        derivatives by the covariance are the average of observed and expected information.
        """
        full, by_noise = self.straight_curvatures(D, slopes, bends, own)
        first, second = noise_turns(own, blurred=self.B is None)
        turn = np.append(np.ones(len(slopes)), first)
        full *= turn[:, None] * turn
        noise = np.arange(len(slopes), len(turn))
        full[noise, noise] -= second * by_noise
        return full

    def straight_curvatures(
        self, D: Floats, slopes: Floats, bends: Floats, own: Floats
    ) -> tuple[Floats, Floats]:
        """Return what `curvatures` does by the noise amplitudes and B themselves, and their slopes.

        The slopes are (c,).
        """
        theta, B = self.amplitudes(own[None])
        m, r = len(slopes), len(self.theta)
        track = self.mode_track
        if isinstance(track, EvenTracks):
            even = track.diagonal(D[None], theta, B, curved=True)
            found = track.slopes(D[None], B, even)
            full = track.curvatures(slopes[None], D[None], B, even)[0]
        elif track is not None:
            few = track.diagonal(D[None], theta, B)
            found = track.slopes(D[None], B, few)
            full = track.curvatures(slopes[None], D[None], B, few)[0]
        else:
            found = self.by_tensor(D[None], theta, B)
            full = self.uneven_curvatures(slopes, D, theta[0], float(B[0]))
        full[:m, :m] -= np.tensordot(bends, found.D[0], 2)
        # The noise less its blur contains -2 B dt D, which is not linear.
        mixed = 2 * self.steps.dt * np.tensordot(slopes, found.noise[0], 2)
        full[:m, -1] += mixed
        full[-1, :m] += mixed
        kept, by_noise = list(range(m)), []
        if np.isfinite(self.freedom):
            _, slope, bend = self.measurement(theta[0])
            amplitudes = np.arange(m, m + r)
            full[amplitudes, amplitudes] -= bend
            kept += amplitudes.tolist()
            by_noise += (found.theta[0] + slope).tolist()
        if self.B is None:
            kept.append(m + r)
            by_noise.append(float(found.B[0]) - LEAST_BLUR)
        return np.asarray(full[np.ix_(kept, kept)]), np.array(by_noise)

    def by_bands(self, D: Floats, theta: Floats, B: float) -> TensorSlopes:
        """Evaluate any steps at one point by banded Cholesky factors of their covariance.

        With P and Q the pivot blocks of the elimination from above and from below and A the
        diagonal blocks, the diagonal blocks of the inverse are (P + Q - A)^-1; those next to them
        are -P^-1 times the block next to A times the next diagonal one.
        """
        from scipy.linalg.lapack import dpbtrs

        s = self.steps
        diagonal, off_diagonal = self.bands(D, theta, B)
        down, pivots, log_det = band_factor(diagonal, off_diagonal)
        _, up_pivots, log_up = band_factor(diagonal[::-1], off_diagonal[::-1])
        if not np.isfinite(log_det + log_up):
            return TensorSlopes.undefined(D[None], theta[None])
        solved, _ = dpbtrs(down, s.vectors.reshape(-1), lower=1)
        z = solved.reshape(s.vectors.shape)
        inverse = symmetric_inverses(pivots + up_pivots[::-1] - diagonal)
        across = -symmetric_inverses(pivots[:-1]) @ (off_diagonal @ inverse[1:])
        same = z[:, :, None] * z[:, None, :] - inverse
        next_one = (z[:-1, :, None] * z[1:, None, :] - across) * s.linked[:-1, None, None]
        value = -0.5 * (log_det + np.sum(s.vectors * z))
        weighted = 2 * same.sum(0) - next_one.sum(0) - next_one.sum(0).T
        by_theta = 0.5 * np.einsum("jsab,sab->j", s.before + s.after, same)
        by_theta -= np.einsum("jsab,sab->j", s.after[:, :-1], next_one)
        by_B = -s.dt * float(np.sum(weighted * D))
        by_D = np.tensordot(s.duration, same, 1) - B * s.dt * weighted
        return TensorSlopes(
            np.array([value]), by_D[None], by_theta[None], np.array([by_B]), 0.5 * weighted[None]
        )

    def bands(self, D: Floats, theta: Floats, B: float) -> tuple[Floats, Floats]:
        """Return the blocks of the covariance of the steps on the diagonal and next to it."""
        s = self.steps
        blur = 2 * B * s.dt * D
        first = np.tensordot(theta, s.before, 1) - blur
        last = np.tensordot(theta, s.after, 1) - blur
        diagonal = 2 * D * s.duration[:, None, None] + first + last
        return diagonal, -last[:-1] * s.linked[:-1, None, None]


def band_factor(diagonal: Floats, off_diagonal: Floats) -> tuple[Floats, Floats, float]:
    """Return the banded Cholesky factor of a block tridiagonal matrix, its pivots and log det.

    Examples
    --------
    >>> factor, pivots, log_det = band_factor(4 * np.ones((2, 1, 1)), 2 * np.ones((1, 1, 1)))
    >>> pivots.ravel(), round(float(np.exp(log_det)), 6)
    (array([4., 3.]), 12.0)
    """
    from scipy.linalg.lapack import dpbtrf

    count, b, _ = diagonal.shape
    band = np.zeros((count, b, 2 * b))
    for j in range(b):
        band[:, j, : b - j] = diagonal[:, j:, j]
        band[:-1, j, b - j : 2 * b - j] = off_diagonal[:, :, j]
    factor, bad = dpbtrf(band.reshape(-1, 2 * b).T, lower=1, overwrite_ab=1)
    if bad:
        return factor, diagonal, np.inf
    columns = factor.T.reshape(count, b, 2 * b)
    lower = np.zeros_like(diagonal)
    for j in range(b):
        lower[:, j:, j] = columns[:, j, : b - j]
    return factor, lower @ np.swapaxes(lower, 1, 2), 2 * float(np.log(factor[0]).sum())


def symmetric_inverses(a: Floats) -> Floats:
    """Return the inverses of symmetric matrices (S, b, b), by cofactors where b = 3.

    Examples
    --------
    >>> symmetric_inverses(np.diag([1.0, 2.0, 4.0])[None])[0].diagonal()
    array([1.  , 0.5 , 0.25])
    """
    if a.shape[1] != 3:
        return np.asarray(np.linalg.inv(a))
    i, j = np.array([1, 2, 0]), np.array([2, 0, 1])
    cofactor = a[:, i][:, :, i] * a[:, j][:, :, j] - a[:, i][:, :, j] * a[:, j][:, :, i]
    determinant = np.einsum("sb,sb->s", a[:, 0], cofactor[:, 0])
    inverse: Floats = cofactor / determinant[:, None, None]
    return inverse


def squares(basis: Floats) -> Family:
    """Return the family D = L^2 with L = sum q_j E_j: all tensors >= 0 that share a symmetry.

    The basis (m, b, b) spans the symmetric matrices that are invariant under the symmetry; with L
    also L^2 is invariant. A basis (P, m, b, b) has one for each of P motions.

    Examples
    --------
    >>> D, slopes, _ = squares(np.eye(3)[None])(np.array([2.0]))
    >>> D.diagonal(), slopes[0].diagonal()
    (array([4., 4., 4.]), array([4., 4., 4.]))
    """
    products = basis[..., :, None, :, :] @ basis[..., None, :, :, :]
    bends = products + np.swapaxes(products, -4, -3)

    def family(q: Floats, rows: Ints | None = None) -> tuple[Floats, Floats, Floats]:
        some, bent = (x[rows] if x.ndim > k else x for x, k in ((basis, 3), (bends, 4)))
        root = np.sum(q[..., None, None] * some, axis=-3)
        slope = some @ root[..., None, :, :]
        bent = np.broadcast_to(bent, (*q.shape[:-1], *bent.shape[-4:]))
        return root @ root, slope + np.swapaxes(slope, -1, -2), bent

    return family


def axial(axis: Floats) -> Family:
    """Return the tensors a^2 across and c^2 along an axis that may tilt away from this one.

    The parameters are a, c and the tilt along the two directions across. Axes (P, 3) are those of P
    motions.

    Examples
    --------
    >>> D, slopes, _ = axial(np.array([0.0, 0.0, 1.0]))(np.array([1.0, 2.0, 0.0, 0.0]))
    >>> D.diagonal(), slopes.shape
    (array([1., 1., 4.]), (4, 3, 3))
    """
    sideways = np.linalg.svd(axis[..., None, :])[2][..., 1:, :]
    eye = np.eye(3)

    def family(q: Floats, rows: Ints | None = None) -> tuple[Floats, Floats, Floats]:
        first, across = (x[rows] if axis.ndim > 1 else x for x in (axis, sideways))
        v = first + np.sum(q[..., 2:, None] * across, axis=-2)
        length = np.linalg.norm(v, axis=-1)[..., None, None]
        u = v / length[..., 0]
        along = u[..., :, None] * u[..., None, :]
        share = np.sum(across * u[..., None, :], axis=-1)
        tilt = (across - share[..., None] * u[..., None, :]) / length  # slopes of u
        turned = tilt[..., None] * u[..., None, None, :]
        turned = turned + np.swapaxes(turned, -1, -2)  # slopes of u u^T
        # Second derivatives of u, and of u u^T.
        second = share[..., None, :, None] * tilt[..., :, None, :]
        second = second + np.swapaxes(second, -3, -2)
        second += (tilt @ np.swapaxes(across, -1, -2))[..., None] * u[..., None, None, :]
        second /= -length[..., None]
        twice = second[..., None] * u[..., None, None, None, :]
        twice = twice + tilt[..., :, None, :, None] * tilt[..., None, :, None, :]
        a, c = (q[..., k, None, None] for k in (0, 1))
        span = (c**2 - a**2)[..., None, :, :]
        slopes = np.empty((*q.shape, 3, 3))
        slopes[..., 0, :, :], slopes[..., 1, :, :] = 2 * a * (eye - along), 2 * c * along
        slopes[..., 2:, :, :] = span * turned
        bends = np.zeros((*q.shape, 4, 3, 3))
        bends[..., 0, 0, :, :], bends[..., 1, 1, :, :] = 2 * (eye - along), 2 * along
        mixed = -2 * a[..., None, :, :] * turned, 2 * c[..., None, :, :] * turned
        for k, one in enumerate(mixed):
            bends[..., k, 2:, :, :] = bends[..., 2:, k, :, :] = one
        bends[..., 2:, 2:, :, :] = span[..., None] * (twice + np.swapaxes(twice, -1, -2))
        return a**2 * eye + span[..., 0, :, :] * along, slopes, bends

    return family


class Maximum(NamedTuple):
    """The greatest likelihood of a family of tensors.

    Attributes
    ----------
    value : float
        Greatest log-likelihood.
    D : ndarray, shape (b, b)
        Tensor at the maximum.
    own : ndarray, shape (G, c)
        Free noise parameters of each motion.
    """

    value: float
    D: Floats
    own: Floats


def maximise(
    tracks: Sequence[NoisyVectors], family: Family, q: Floats, own: Floats, *, near: bool = False
) -> Maximum:
    """Return the maximum over a family of D, common to all, and over the noise of each motion.

    There are two searches where the blur is unknown, from a small and from a large one; with `near`
    only one, from the noise and blur that are given, those of a maximum over more D. Where the
    steps are modes a search begins with Newton steps by the noise amplitudes and the
    blur themselves: noise and blur may have nearly the same effect, and the narrow ridge of the
    likelihood is straight in these. Then it is quasi-Newton (BFGS), by their square roots and an
    angle, and begins with the Hessian, with the average information in it where steps are not
    modes; it is computed again where no step increases the likelihood, and after every ten steps.
    The search ends at a root of the slopes.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=3)
    >>> from perrin.diffusion import Noise, ScaledTracks, body_steps
    >>> data = ScaledTracks.of([body_steps(truth, "rotation", np.eye(3))], Noise())
    >>> own = np.array([track.start() for track in data.tracks])
    >>> best = maximise(data.tracks, squares(np.eye(3)[None]), np.ones(1), own)
    >>> bool(abs(data.in_units(best.D)[0, 0] - 5e-3) < 1e-3)
    True
    """
    if near or tracks[0].B is not None:
        return _searched(tracks, family, q, own)
    ratio = np.array([t.blur_ratio(family(q)[0]) for t in tracks])
    found: list[Maximum] = []
    faults: list[ValueError] = []
    for angle in START_ANGLES:
        try:
            found.append(_searched(tracks, family, q, at_blur(own, angle, ratio)))
        except ValueError as fault:
            faults.append(fault)
    if not found:
        raise faults[0]
    return max(found, key=lambda m: m.value)


def _searched(tracks: Sequence[NoisyVectors], family: Family, q: Floats, own: Floats) -> Maximum:
    """Return the maximum that a search from these parameters finds."""
    problem = PooledLikelihood(tracks, family, len(q), own.shape)
    p = np.concatenate([q, own.ravel()])
    value, slope = problem.slopes(p)
    if all(t.mode_track is not None for t in tracks):
        p, value, slope = problem.climbed(p, value, slope)
    for _ in range(MOST_HESSIANS):
        inverse = problem.curvatures(p).inverse()
        for _ in range(STEPS_A_HESSIAN):
            step = inverse @ slope
            gain = 0.5 * float(slope @ step)
            if gain <= CONVERGED_GAIN:
                return Maximum(value, *problem.tensor_and_noise(p))
            trial = problem.line_search(p, value, step, gain)
            if trial is None:
                break
            new, new_value, new_slope = trial
            inverse = bfgs_update(inverse, new - p, slope - new_slope)
            p, value, slope = new, new_value, new_slope
    if gain <= ROUNDING_GAIN:
        return Maximum(value, *problem.tensor_and_noise(p))
    raise ValueError(
        f"the likelihood of these {sum(len(t.steps.vectors) for t in tracks)} steps has no maximum "
        "at which a search converges: they hold too little information about diffusion and noise; "
        "take longer tracks"
    )


def spread(tracks: Sequence[NoisyVectors], best: Maximum, basis: Floats) -> tuple[Floats, Floats]:
    """Return directions of D (m, b, b) and the covariance (m, m) of the error along them.

    The covariance is that of the observed information with the noise left free, and NaN where the
    information is not positive. The directions F E_j F, with F the root of D, are of the size of D
    itself, whose small values may be thousands of times below the others.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=3)
    >>> from perrin.diffusion import Noise, ScaledTracks, body_steps
    >>> data = ScaledTracks.of([body_steps(truth, "rotation", np.eye(3))], Noise())
    >>> basis = np.eye(3)[None]
    >>> directions, covariance = spread(data.tracks, data.fit(basis), basis)
    >>> bool(0.03 < covariance[0, 0] ** 0.5 < 0.1)  # relative, as the direction is D itself
    True
    """
    values, axes = np.linalg.eigh(best.D)
    root = (axes * np.sqrt(np.maximum(values, 1e-4 * values[-1]))) @ axes.T
    directions = root @ basis @ root

    straight = np.zeros((len(basis), len(basis), *best.D.shape))

    def family(q: Floats) -> tuple[Floats, Floats, Floats]:
        return best.D + np.tensordot(q, directions, 1), directions, straight

    problem = PooledLikelihood(tracks, family, len(basis), best.own.shape)
    known = problem.hessian(np.append(np.zeros(len(basis)), best.own)).information()
    if not (np.isfinite(known).all() and np.linalg.eigvalsh(known)[0] > 0):
        return directions, np.full_like(known, np.nan)
    return directions, np.asarray(np.linalg.inv(known))


@dataclass(frozen=True, eq=False)
class PooledLikelihood:
    """The likelihood of several motions with one D, as a function of one list of parameters.

    Attributes
    ----------
    tracks : sequence of NoisyVectors
        Steps of every motion.
    family : callable
        D and its slopes as a function of the first m parameters.
    m : int
        Number of these parameters.
    shape : tuple of int
        (G, c) of the other parameters: c of the noise of each of the G motions.
    """

    tracks: Sequence[NoisyVectors]
    family: Family
    m: int
    shape: tuple[int, ...]

    def tensor_and_noise(self, p: Floats) -> tuple[Floats, Floats]:
        """Return D and the noise parameters (G, c)."""
        return self.family(p[: self.m])[0], p[self.m :].reshape(self.shape)

    def slopes(self, p: Floats) -> tuple[float, Floats]:
        """Return the log-likelihood and its slopes."""
        values, slopes = self.slopes_at(p[None])
        return float(values[0]), slopes[0]

    def slopes_at(self, points: Floats) -> tuple[Floats, Floats]:
        """Return the log-likelihoods (P,) and their slopes (P, m + Gc) at P points."""
        tensors = [self.family(p[: self.m])[:2] for p in points]
        D, jacobian = (np.array(part) for part in zip(*tensors, strict=True))
        own = points[:, self.m :].reshape(len(points), *self.shape)
        found = [s.slopes(D, own[:, g]) for g, s in enumerate(self.tracks)]
        by_D = np.sum([part[1] for part in found], axis=0)
        by_q = [np.einsum("ab,kab->k", *one) for one in zip(by_D, jacobian, strict=True)]
        value = np.sum([part[0] for part in found], axis=0)
        return value, np.concatenate([by_q, *(part[2] for part in found)], axis=1)

    def line_search(
        self, p: Floats, value: float, step: Floats, gain: float
    ) -> tuple[Floats, float, Floats] | None:
        """Return the point along a step, shortened until the likelihood rises; None if never."""
        for part in 0.4 ** np.arange(16):
            new_value, slope = self.slopes(p + part * step)
            rises = new_value > value + 1e-3 * part * gain
            if rises or (gain <= ROUNDING_GAIN and np.isfinite(new_value)):
                return p + part * step, new_value, slope
        return None

    def climbed(self, p: Floats, value: float, slope: Floats) -> tuple[Floats, float, Floats]:
        """Return a higher point with its value and slopes, by Newton steps while they gain.

        Steps are by the parameters of D, the noise amplitudes and the blur; they go at most a
        part of the way to the edges of the latter, which the search that follows reaches.
        """
        blurred, reach, m = self.tracks[0].B is None, FIRST_REACH, self.m
        hessian = None
        for _ in range(MOST_STRAIGHT_STEPS):
            own = p[m:].reshape(self.shape)
            if hessian is None:
                tensors = self.family(p[:m])
                pairs = list(zip(self.tracks, own, strict=True))
                parts = [t.straight_curvatures(*tensors, one) for t, one in pairs]
                full = np.array([full for full, _ in parts])
                by_noise = np.array([one for _, one in parts])
                shared, mixed = full[:, :m, :m].sum(axis=0), full[:, :m, m:]
                hessian = ArrowHessian(shared[None], mixed[None], full[None, :, m:, m:])
            limits = noise_range(own[None], reach, blurred=blurred)
            steps = hessian.step_within(slope[None, :m], by_noise[None], limits)
            of_D, of_noise = (step[0] for step in steps)
            gain = float(slope[:m] @ of_D + np.sum(by_noise * of_noise))
            if not gain > STRAIGHT_GAIN or reach < NEAREST_REACH:
                break
            noise = changed_noise(own, of_noise, blurred=blurred)
            trial = np.append(p[:m] + of_D, noise)
            new, new_slope = self.slopes(trial)
            if new > value:
                p, value, slope, hessian = trial, new, new_slope, None
                reach = min(2 * reach, FARTHEST_REACH)
            else:
                reach *= 0.25
        return p, value, slope

    def curvatures(self, p: Floats) -> ArrowHessian:
        """Return minus the Hessian, with the average information of steps that are not modes."""
        tensors, m = self.family(p[: self.m]), self.m
        own = p[m:].reshape(self.shape)
        found = np.array([t.curvatures(*tensors, o) for t, o in zip(self.tracks, own, strict=True)])
        return ArrowHessian(found[:, :m, :m].sum(axis=0), found[:, :m, m:], found[:, m:, m:])

    def hessian(self, p: Floats) -> ArrowHessian:
        """Return minus the Hessian, by central differences where the steps are not modes.

        The noise of one motion does not enter the slopes of the others, so all change at once.
        """
        if all(t.mode_track is not None for t in self.tracks):
            return self.curvatures(p)
        count, c = self.shape
        one, other = np.eye(self.m, len(p)), np.zeros((c, len(p)))
        other[:, self.m :] = np.tile(np.eye(c), count)
        steps = _DIFFERENCE_STEP * np.concatenate([one, other])
        ahead, behind = np.split(self.slopes_at(np.concatenate([p + steps, p - steps]))[1], 2)
        change = (behind - ahead) / (2 * _DIFFERENCE_STEP)
        shared = change[: self.m, : self.m]
        by_noise = change[:, self.m :].reshape(self.m + c, count, c).swapaxes(0, 1)
        mixed, own = by_noise[:, : self.m], by_noise[:, self.m :]
        return ArrowHessian(0.5 * (shared + shared.T), mixed, 0.5 * (own + np.swapaxes(own, 1, 2)))


def noise_range(own: Floats, reach: Floats | float, *, blurred: bool) -> tuple[Floats, Floats]:
    """Return the least and the largest change of noise amplitudes and B in a step, (..., c) each.

    Parameters
    ----------
    own : ndarray, shape (..., c)
        Free parameters of the noise, as in `NoisyVectors.start`.
    reach : float or ndarray, shape (..., 1)
        Part of the way to the edges of their range.
    blurred : bool
        Whether the last one is B, which is at most 1/4.

    Examples
    --------
    >>> noise_range(np.array([2.0, 0.0]), 0.5, blurred=True)
    (array([-2., -0.]), array([  inf, 0.125]))
    """
    size, most = _amplitudes_and_blur(own, blurred=blurred), np.full(own.shape, np.inf)
    if blurred:
        most[..., -1] = MOST_BLUR
    return -reach * size, reach * (most - size)


def noise_turns(own: Floats, *, blurred: bool) -> tuple[Floats, Floats]:
    """Return first and second derivatives (..., c) of noise amplitudes and B by their parameters.

    Examples
    --------
    >>> noise_turns(np.array([2.0, 0.0]), blurred=True)
    (array([4., 0.]), array([2. , 0.5]))
    """
    first, second = 2 * own, np.full(own.shape, 2.0)
    if blurred:
        first[..., -1] = MOST_BLUR * np.sin(2 * own[..., -1])
        second[..., -1] = 2 * MOST_BLUR * np.cos(2 * own[..., -1])
    return first, second


def at_blur(own: Floats, angle: float, ratio: Floats) -> Floats:
    """Return the free parameters (..., c) of about the same noise less blur, at another blur.

    Parameters
    ----------
    own : ndarray, shape (..., c)
        Free parameters of the noise, as in `NoisyVectors.start`; the last one is the angle of B.
    angle : float
        The other angle.
    ratio : ndarray, shape (...,)
        Noise amplitude that has the mean variance of a blur of B = 1.

    Examples
    --------
    >>> at_blur(np.array([0.5, 0.0]), np.pi / 2, np.array(3.0)).round(9)
    array([1.        , 1.57079633])
    """
    more = MOST_BLUR * (np.sin(angle) ** 2 - np.sin(own[..., -1]) ** 2) * ratio
    size = np.maximum(own[..., :-1] ** 2 + more[..., None], 0.01 * ratio[..., None])
    return np.concatenate([np.sqrt(size), np.full((*own.shape[:-1], 1), angle)], axis=-1)


def changed_noise(own: Floats, change: Floats, *, blurred: bool) -> Floats:
    """Return the free parameters (..., c) of the noise after a change of amplitudes and B.

    Examples
    --------
    >>> changed_noise(np.array([2.0, 0.0]), np.array([5.0, 0.25]), blurred=True).round(9)
    array([3.        , 1.57079633])
    """
    size = np.sqrt(_amplitudes_and_blur(own, blurred=blurred) + change)
    if blurred:
        size[..., -1] = np.arcsin(size[..., -1] / np.sqrt(MOST_BLUR))
    return np.asarray(size)


def _amplitudes_and_blur(own: Floats, *, blurred: bool) -> Floats:
    """Return the noise amplitudes and B of the free parameters (..., c)."""
    size = own**2
    if blurred:
        size[..., -1] = MOST_BLUR * np.sin(own[..., -1]) ** 2
    return np.asarray(size)


@dataclass(frozen=True, eq=False)
class ArrowHessian:
    """Minus a Hessian in which the motions share the parameters of D alone; or several of them.

    Attributes
    ----------
    shared : ndarray, shape (..., m, m)
        Block of the parameters of D.
    mixed : ndarray, shape (..., G, m, c)
        Blocks of D and the noise of each motion.
    own : ndarray, shape (..., G, c, c)
        Blocks of the noise of each motion.
    """

    shared: Floats
    mixed: Floats
    own: Floats

    @classmethod
    def of_single_motions(cls, full: Floats, m: int) -> ArrowHessian:
        """Return the blocks of Hessians (P, m + c, m + c), each of one motion."""
        return cls(full[:, :m, :m], full[:, None, :m, m:], full[:, None, m:, m:])

    def inverse(self) -> Floats:
        """Return the inverse (..., m + Gc, m + Gc), its negative curvatures turned positive."""
        *several, count, m, c = self.mixed.shape
        own = positive_inverse(self.own)
        lever = self.mixed @ own
        by_shared = np.einsum("...gmc,...gnc->...mn", lever, self.mixed)
        shared = positive_inverse(self.shared - by_shared)
        tail = -np.swapaxes(lever, -1, -2).reshape(*several, count * c, m)
        inverse = np.empty((*several, m + count * c, m + count * c))
        inverse[..., :m, :m] = shared
        inverse[..., m:, :m] = tail @ shared
        inverse[..., :m, m:] = np.swapaxes(inverse[..., m:, :m], -1, -2)
        inverse[..., m:, m:] = inverse[..., m:, :m] @ np.swapaxes(tail, -1, -2)
        for g in range(count):
            rows = slice(m + g * c, m + (g + 1) * c)
            inverse[..., rows, rows] += own[..., g, :, :]
        return inverse

    def step(self, slope: Floats, by_noise: Floats) -> tuple[Floats, Floats]:
        """Return the products of `inverse` with slopes (P, m) and (P, G, c), block by block."""
        own = positive_inverse(self.own)
        lever = self.mixed @ own
        shared = positive_inverse(self.shared - np.einsum("pgmc,pgnc->pmn", lever, self.mixed))
        of_D = shared @ (slope - np.einsum("pgmc,pgc->pm", lever, by_noise))[..., None]
        of_noise = own @ by_noise[..., None] - np.swapaxes(lever, -1, -2) @ of_D[:, None]
        return of_D[..., 0], of_noise[..., 0]

    def step_within(
        self, slope: Floats, by_noise: Floats, limits: tuple[Floats, Floats]
    ) -> tuple[Floats, Floats]:
        """Return the Newton steps (P, m) and (P, G, c), the change of the noise within limits.

        A change beyond a limit (P, G, c) is fixed there, and all others are found again for it:
        where noise and blur have nearly the same effect the step remains on the ridge.
        """
        c = by_noise.shape[2]
        fixed, change = np.zeros(by_noise.shape, dtype=np.bool_), np.zeros_like(by_noise)
        of_D, rows = np.zeros_like(slope), np.arange(len(slope))
        for _ in range(c + 1):
            held, free = fixed[rows], ~fixed[rows]
            moved = np.where(held, change[rows], 0.0)
            by_D = slope[rows] - np.einsum("pgmc,pgc->pm", self.mixed[rows], moved)
            rest = by_noise[rows] - np.einsum("pgcd,pgd->pgc", self.own[rows], moved)
            rest = np.where(held, moved, rest)
            own = self.own[rows] * (free[..., :, None] & free[..., None, :])
            own += held[..., :, None] * np.eye(c)
            mixed = self.mixed[rows] * free[..., None, :]
            step, noise = ArrowHessian(self.shared[rows], mixed, own).step(by_D, rest)
            low, high = (limit[rows] for limit in limits)
            within = np.where(held, moved, np.clip(noise, low, high))
            of_D[rows], change[rows] = step, within
            share = np.divide(within, noise, out=np.ones_like(noise), where=free & (noise != 0))
            # The one of each motion that comes to its limit first.
            first = (share < 1) & (share == share.min(axis=2, keepdims=True, initial=1.0))
            fixed[rows] |= first
            rows = rows[first.any(axis=(1, 2))]
            if not rows.size:
                break
        return of_D, change

    def information(self) -> Floats:
        """Return the information on what is shared, the noise of every motion left free."""
        solved = np.linalg.solve(self.own, np.swapaxes(self.mixed, -1, -2))
        information: Floats = self.shared - np.einsum("...gmc,...gcn->...mn", self.mixed, solved)
        return information


def positive_inverse(a: Floats) -> Floats:
    """Return the inverse of symmetric matrices (..., c, c) with the sizes of their eigenvalues."""
    if a.shape[-1] == 1:
        size = np.maximum(np.abs(a), 1e-309)
        return np.asarray(1 / size)
    values, vectors = np.linalg.eigh(a)
    size = np.abs(values)
    size = np.maximum(size, 1e-9 * size.max(axis=-1, keepdims=True, initial=1e-300))
    inverse: Floats = (vectors / size[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    return inverse


def bfgs_update(inverse: Floats, step: Floats, fall: Floats) -> Floats:
    """Return the BFGS update of inverse Hessians; unchanged where the curvature is not positive.

    `fall` (..., n) is the fall of the slopes along the step (..., n).

    Examples
    --------
    >>> bfgs_update(np.eye(2), np.array([1.0, 0.0]), np.array([4.0, 0.0]))
    array([[0.25, 0.  ],
           [0.  , 1.  ]])
    """
    along = np.sum(step * fall, axis=-1)
    size = np.sqrt(np.sum(step**2, axis=-1) * np.sum(fall**2, axis=-1))
    curved = along > 1e-14 * size
    along = np.where(curved, along, 1.0)[..., None, None]
    pull = (inverse @ fall[..., None])[..., 0]
    cross = pull[..., :, None] * step[..., None, :]
    new = inverse - (cross + np.swapaxes(cross, -1, -2)) / along
    rise = np.sum(fall * pull, axis=-1)[..., None, None]
    new += step[..., :, None] * step[..., None, :] * ((1 + rise / along) / along)
    return np.asarray(np.where(curved[..., None, None], new, inverse))
