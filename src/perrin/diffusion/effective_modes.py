"""A few modes that have the same likelihood as many uneven steps in equally noisy frames.

The covariance of the steps of an axis is a A + o W with two fixed tridiagonal matrices, the motion
A and the noise W, both positive, and two numbers a, o >= 0. Were all eigenvectors v of this pair
known, A v = m (A/s + W) v and W v = n (A/s + W) v, the likelihood would be that of independent
modes of variance a m + o n. It depends on the steps y only through log det P and y^T P^-1 y of
P = (1 - f) A/s + f W, functions of the one ratio f = o/(o + a s). Both are analytic in
log(f/(1 - f)) within pi of the real axis, so that their values at a few nodes determine them; and
weights on a fixed grid of modes reproduce these values. The sums over the modes then are the
likelihood and all its derivatives to 1e-12 between dense nodes, and to about 1e-2 at all others.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from perrin._arrays import frozen
from perrin.diffusion.step_kernels import (
    GroupSlopes,
    SineModes,
    TridiagonalCovariance,
    equal_columns,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from perrin._arrays import Bools, Floats, Ints
    from perrin.diffusion.steps import NoisySteps, Steps

# Spacing of the grid of modes in log(n/m), and how far it reaches beyond the nodes: the functions
# of one mode are sech((log n/m + log f/(1 - f))/2), which this grid reproduces to rounding.
_MODE_SPACING, _MODE_MARGIN = 0.45, 16.0

# Nodes in the window of dense ones: this many, and more by its half-width in log(f/(1 - f)).
_LEAST_NODES, _NODES_BY_WIDTH = 9, 5.5

# Distances of the sparse nodes from the window.
_SPARSE_NODES = np.array([0.8, 2.0, 4.5, 10.0])

# Fewer steps than these are eliminated at every D and noise instead.
LEAST_STEPS = 1000

# Noise is proportional in all frames if its ratio agrees to this.
_PROPORTIONAL = 1e-9

# Half-width of the window about the estimate from moments, in log(o/(a s)).
WINDOW = 1.0

# Displacements over this many steps, more than most noise hides.
_FAR_STEPS = 50

# Singular values below this part of the largest carry no more than rounding.
_LEAST_SINGULAR = 1e-14


@dataclass(frozen=True, eq=False)
class EffectiveModes:
    """Independent modes with the likelihood of some uneven steps of b components.

    The log-likelihood of one component with covariance a A + o W is
    -(log_det + sum_k [count_k log v_k + power_k/v_k])/2, v_k = a motion_k + o noise_k; that of
    several components with matrices in place of a and o follows in the axes that diagonalise both.

    Attributes
    ----------
    motion, noise : ndarray, shape (K,)
        Variances of the modes for a = 1, and for o = 1.
    count : ndarray, shape (K,)
        Number of steps that each mode represents; their sum is the number of steps.
    power : ndarray, shape (K, b, b)
        Sum of products of the components' amplitudes in each mode.
    log_det : float
        Logarithm of the determinant of A/s + W.
    scale : float
        The ratio s.
    window : tuple of float
        Lowest and highest log(o/(a s)) at which the modes are exact to rounding.
    """

    motion: Floats
    noise: Floats
    count: Floats
    power: Floats
    log_det: float
    scale: float
    window: tuple[float, float]

    def __post_init__(self) -> None:
        frozen(self.motion, self.noise, self.count, self.power)

    def exact(self, a: Floats, o: Floats) -> Bools:
        """Return where the likelihood is exact: in the window, or where a = 0."""
        with np.errstate(divide="ignore", invalid="ignore"):
            place = np.log(o / (a * self.scale))
        within = (place >= self.window[0]) & (place <= self.window[1])
        return np.asarray(within | (a == 0))


def compress_steps(
    vectors: Floats,
    motion: tuple[Floats, Floats],
    noise: tuple[Floats, Floats],
    *,
    scale: float,
    window: tuple[float, float],
) -> EffectiveModes:
    """Return modes that have the likelihood of steps with covariance a A + o W.

    One elimination of a tridiagonal matrix for each of about 30 nodes, in memory of a few times
    the steps.

    Parameters
    ----------
    vectors : ndarray, shape (S, b)
        Steps y.
    motion, noise : tuple of ndarray, shapes (S,) and (S - 1,)
        Diagonal and first off-diagonal of A and of W, both positive definite.
    scale : float
        Number s that brings A to the size of W.
    window : tuple of float
        Range of log(o/(a s)) in which the modes are exact.

    Returns
    -------
    EffectiveModes

    Examples
    --------
    >>> tau = np.array([1.0, 1, 2, 1, 1, 3, 1])
    >>> noise = np.full(7, 2.0), np.full(6, -1.0)
    >>> y = np.arange(7.0)[:, None]
    >>> modes = compress_steps(y, (2 * tau, 0 * tau[1:]), noise, scale=1.0, window=(-1.0, 1.0))
    >>> off = np.diag(noise[1], 1)
    >>> inverse = np.linalg.inv(np.diag(2 * tau + 2) + off + off.T)
    >>> form = np.sum(modes.power[:, 0, 0] / (modes.motion + modes.noise))
    >>> bool(abs(form - y[:, 0] @ inverse @ y[:, 0]) < 1e-10)
    True
    """
    low, high = window
    half = 0.5 * (high - low)
    count = _LEAST_NODES + int(_NODES_BY_WIDTH * half)
    dense = np.cos(np.pi * (np.arange(count) + 0.5) / count)
    place = np.concatenate(
        [low - _SPARSE_NODES, 0.5 * (low + high) + half * dense, high + _SPARSE_NODES]
    )
    share = np.append(1 / (1 + np.exp(-place)), 1.0)
    columns = np.asfortranarray(vectors)
    found = [ratio_node(columns, motion, noise, f, scale=scale) for f in share]
    log_dets, forms = np.array([one[0] for one in found]), np.array([one[1] for one in found])
    grid = np.arange(-high - _MODE_MARGIN, -low + _MODE_MARGIN, _MODE_SPACING)
    part = 1 / (1 + np.exp(-grid))
    variance = (1 - share)[:, None] * (1 - part) + share[:, None] * part
    # Every form counts relative to its own size, and every mode by its largest contribution.
    b = vectors.shape[1]
    size = 1 / np.maximum(np.trace(forms, axis1=1, axis2=2), np.finfo(float).tiny)
    kernel = size[:, None] / variance
    reach = kernel.max(axis=0)
    right = (size[:, None, None] * forms).reshape(len(share), b * b)
    power = np.linalg.lstsq(kernel / reach, right, rcond=_LEAST_SINGULAR)[0] / reach[:, None]
    # log det P = sum_k count_k log v_k + log_det, and the counts add up to the number of steps.
    logs = np.column_stack([np.log(variance), np.ones(len(share))])
    logs = np.vstack([logs, np.append(np.ones(len(grid)), 0.0)])
    weights = np.linalg.lstsq(logs, np.append(log_dets, len(vectors)), rcond=_LEAST_SINGULAR)[0]
    power = power.reshape(-1, b, b)
    return EffectiveModes(
        scale * (1 - part),
        part,
        weights[:-1],
        0.5 * (power + np.swapaxes(power, 1, 2)),
        float(weights[-1]),
        scale,
        window,
    )


def ratio_node(
    columns: Floats,
    motion: tuple[Floats, Floats],
    noise: tuple[Floats, Floats],
    share: float,
    *,
    scale: float,
) -> tuple[float, Floats]:
    """Return log det P and y^T P^-1 y (b, b) of P = (1 - f) A/s + f W for one f.

    Parameters
    ----------
    columns : ndarray, shape (S, b)
        Steps y, in columns that are contiguous.
    motion, noise : tuple of ndarray, shapes (S,) and (S - 1,)
        Diagonal and first off-diagonal of A and of W.
    share, scale : float
        The numbers f and s.

    Raises
    ------
    ValueError
        If P is not positive definite.

    Examples
    --------
    >>> one, y = (np.full(2, 2.0), np.zeros(1)), np.asfortranarray(np.eye(2))
    >>> log_det, form = ratio_node(y, one, one, 0.5, scale=1.0)
    >>> round(log_det, 6), form.diagonal()
    (1.386294, array([0.5, 0.5]))
    """
    from scipy.linalg.lapack import dpttrf, dpttrs

    of_motion = (1 - share) / scale
    diagonal = of_motion * motion[0]
    diagonal += share * noise[0]
    off = of_motion * motion[1]
    off += share * noise[1]
    pivots, lower, bad = dpttrf(diagonal, off, overwrite_d=1, overwrite_e=1)
    if bad:
        raise ValueError("the covariance of these steps is not positive definite at one ratio")
    solved = dpttrs(pivots, lower, columns)[0]
    # Pivots are of order 1: products of 16 neither overflow nor lose digits.
    whole = len(pivots) // 16 * 16
    log_det = np.log(pivots[:whole].reshape(-1, 16).prod(axis=1)).sum()
    log_det += np.log(pivots[whole:]).sum()
    form = np.empty((columns.shape[1],) * 2)
    for a, b in zip(*np.tril_indices(len(form)), strict=True):
        form[a, b] = form[b, a] = columns[:, a] @ solved[:, b]
    return float(log_det), form


class NoiseProfile(NamedTuple):
    """Noise of the axes of some steps that is proportional to one profile over the frames.

    Attributes
    ----------
    before, after : ndarray, shape (S,)
        Noise variance of the frames of every step, in units of the profile's mean.
    by_theta, known : ndarray, shape (A,)
        Noise of each axis in these units: theta by_theta + known.
    """

    before: Floats
    after: Floats
    by_theta: Floats
    known: Floats

    @classmethod
    def of(cls, track: NoisySteps) -> NoiseProfile | None:
        """Return the profile of a long track; None for a short one, or without such a profile."""
        if len(track.steps.vectors) < LEAST_STEPS or track.drift:
            return None
        free = not np.isinf(track.freedom)
        first, last = (noise[:, 0] for noise in (track.weight if free else track.known))
        mean, least = 0.5 * (first.mean() + last.mean()), min(first.min(), last.min())
        if not (least > 0 and track.blur <= 0.5 * track.steps.duration.min() * (1 + 1e-12)):
            return None
        profile = first / mean, last / mean
        by_axis = []
        for pair in (track.weight, track.known):
            ratio = 0.5 * (pair[0][0] / profile[0][0] + pair[1][0] / profile[1][0])
            allowed = _PROPORTIONAL * max(mean, float(ratio.max()))
            for noise, one in zip(pair, profile, strict=True):
                rest = [np.abs(noise[:, a] - r * one).max() for a, r in enumerate(ratio)]
                if not max(rest) <= allowed:
                    return None
            by_axis.append(ratio)
        if by_axis[1].min() < 0:
            return None
        return cls(*profile, *by_axis)


def moment_estimate(steps: Steps) -> tuple[Floats, Floats]:
    """Return D and the noise of a frame less its blur from moments of the steps, (A, A) each.

    D is <y y^T> tau/2 plus the covariance of neighbours, and the noise minus that covariance; where
    noise prevails D comes from displacements over 50 steps. Both are symmetric; D may have
    negative eigenvalues.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> from perrin.diffusion import steps_of
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=3)
    >>> D, noise = moment_estimate(steps_of(truth, "rotation"))
    >>> bool(abs(np.trace(D) / 3 - 5e-3) < 1e-3)
    True
    """
    y, time = steps.vectors, steps.duration.sum()
    product = (y[:-1] * steps.linked[:-1, None]).T @ y[1:]
    product = 0.5 * (product + product.T)
    square = y.T @ y
    D = (0.5 * square + product) / time
    if np.trace(D) < 0.2 * np.trace(square) / time and len(y) > 2 * _FAR_STEPS:
        place, when = np.cumsum(y, axis=0), np.cumsum(steps.duration)
        far = place[_FAR_STEPS:] - place[:-_FAR_STEPS]
        longer = np.mean(when[_FAR_STEPS:] - when[:-_FAR_STEPS]) - time / len(y)
        D = 0.5 * (far.T @ far / len(far) - square / len(y)) / longer
    return D, -product / max(int(steps.linked.sum()), 1)


@dataclass(frozen=True, eq=False)
class FewModes:
    """Long uneven tracks with proportional noise, as effective modes; exact at any D and noise.

    Attributes
    ----------
    modes : SineModes
        Effective modes of the motions.
    tracks : tuple of NoisySteps
        The steps themselves, for points outside the windows.
    windows : tuple of (int, float, float, EffectiveModes)
        Number of a motion, noise of one of its axes per theta and known, and its modes.
    constant : ndarray, shape (G,)
        Constant part of the log-likelihood of each motion.
    """

    modes: SineModes
    tracks: tuple[NoisySteps, ...]
    windows: tuple[tuple[int, float, float, EffectiveModes], ...]
    constant: Floats

    @property
    def groups(self) -> Ints:
        """Numbers of the motions."""
        return self.modes.groups

    @cached_property
    def bands(self) -> TridiagonalCovariance:
        """The same motions, to be evaluated by elimination."""
        return TridiagonalCovariance.of(self.tracks, self.groups.tolist())

    @property
    def size(self) -> int:
        """Number of effective modes."""
        return self.modes.power.size

    @classmethod
    def of(
        cls,
        tracks: Sequence[NoisySteps],
        profiles: Sequence[NoiseProfile],
        groups: Sequence[int],
    ) -> FewModes:
        """Compress the steps of these motions, which have these noise profiles and numbers."""
        rows, windows, constant = [], [], np.zeros(len(tracks))
        for g, (track, profile) in enumerate(zip(tracks, profiles, strict=True)):
            steps, blur = track.steps, track.blur
            linked = steps.linked[:-1].astype(np.float64)
            scale = float(steps.duration.mean())
            D, offset = (float(np.trace(x)) / len(x) for x in moment_estimate(steps))
            D = max(D, 1e-5 * float(np.mean(steps.vectors**2)) / scale)
            if track.freedom:
                offset = float(np.mean(profile.by_theta)) * track.theta
                offset += float(profile.known.mean())
            else:
                # The covariance of neighbours contains the blur.
                offset = max(offset, 0.0) + blur * D
            excess = offset + profile.known - profile.known.mean()
            places = np.log(np.maximum(excess, 1e-6 * D * scale) / (D * scale))
            found = compress_steps(
                steps.vectors,
                (2 * (steps.duration - blur), blur * linked),
                (profile.before + profile.after, -profile.after[:-1] * linked),
                scale=scale,
                window=(float(places.min()) - WINDOW, float(places.max()) + WINDOW),
            )
            axes = found.power.shape[1]
            constant[g] = -0.5 * axes * found.log_det
            level = np.stack([profile.by_theta, profile.known])
            for alike in equal_columns(level):
                by_theta, known = level[:, alike[0]]
                windows.append((g, float(by_theta), float(known), found))
                power = np.einsum("kaa->k", found.power[:, alike][:, :, alike])
                rows.append(
                    np.stack(
                        [
                            np.full(len(power), float(g)),
                            power,
                            len(alike) * found.count,
                            found.motion,
                            by_theta * found.noise,
                            known * found.noise,
                        ]
                    )
                )
        which, power, count, by_D, by_theta, given = np.concatenate(rows, axis=1)
        number = which.astype(np.int64)
        starts = np.searchsorted(number, np.arange(len(tracks)))
        modes = SineModes(np.array(groups), starts, number, power, count, by_D, by_theta, given)
        return cls(modes, tuple(tracks), tuple(windows), constant)

    @property
    def rough(self) -> FewModes:
        """The modes at all points, to 1 % outside their windows."""
        return replace(self, windows=())

    def sums(self, D: Floats, theta: Floats) -> GroupSlopes:
        """Evaluate all motions at the D and the theta of each, (..., G).

        Points outside the windows are evaluated by elimination.
        """
        found = self.modes.sums(D, theta)
        found = found._replace(value=found.value + self.constant)
        flat_D, flat_theta = (x.reshape(-1, len(self.constant)) for x in (D, theta))
        exact = np.ones(len(flat_D), dtype=np.bool_)
        for g, by_theta, known, modes in self.windows:
            exact &= modes.exact(flat_D[:, g], by_theta * flat_theta[:, g] + known)
        for row in np.flatnonzero(~exact):
            for total, part in zip(
                found, self.bands.sums(flat_D[row], flat_theta[row]), strict=True
            ):
                total.reshape(flat_D.shape)[row] = part
        return found

    def steady_motion(self, D: Floats, theta: Floats) -> tuple[Floats, Floats]:
        """Return the steady motion (G, p) of every track and its inverse covariance (G, p, p)."""
        return self.bands.steady_motion(D, theta)
