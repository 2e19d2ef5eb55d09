"""How far a fitted body deserves trust: is it rigid, how large its errors are, what was done."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from perrin._arrays import Floats, as_positions, as_sigma
from perrin.motion import body_residuals
from perrin.rotations import skew
from perrin.shapes import point_group

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from perrin.motion import RigidMotion

# A body is called soft when its residuals are large against its size and smooth in time; a sigma
# stated by the user replaces both rules by a factor on it.
_SOFT_SIZE, _SOFT_SMOOTH, _SOFT_FACTOR = 0.03, 0.3, 2.0
# A bond breaks when the mean distance of a pair in one eighth of the time leaves that in another
# by a fifth of itself and by more than the noise.
_BLOCKS, _BROKEN, _BEYOND = 8, 0.2, 4.0
# sigma per axis is told where each variance is known to 30 %.
_TOLD = 0.3
# A scale error of z counts from 1 % and 5 standard errors on.
_SCALE, _SCALE_ERRORS = 0.01, 5.0
# So much more noise along z than the user states, or than in x and y, makes a scan suspect.
_BLUR = 1.6
_FRAMES = 2000  # so many frames are enough for every average here


@dataclass(frozen=True)
class Quality:
    """How one cluster's rigid fits turned out.

    Attributes
    ----------
    rigid : bool
        Whether the body passes as rigid; `reasons` says why not.
    reasons : tuple of str
    residual_over_R : float
        sigma from the residuals over the mean distance to the centre.
    residual_over_sigma : float or None
        The same over the sigma stated by the user.
    autocorrelation : float or None
        Of the residuals between neighbouring frames. Real cameras err smoothly (0.9 and more), so
        this alone says nothing.
    bond_drift : float
        The largest relative change of a pair's distance between eighths of the time.
    drifting_pair : tuple of int
        Which pair (columns).
    sigma_xyz : tuple of float or None
        Localisation error of each lab axis, um; None where the residuals cannot tell.
    z_scale, z_scale_stderr : float or None
        By how much z is stretched against x and y (1: not), from how the shape changes with
        orientation.
    scan_blur : float or None
        sigma_z over sigma_xy, over the ratio stated by `sigma` or `sigma_ratio`. Far
        above what the optics explain it betrays a sequential scan.
    swaps, cuts, extra : tuple of int
        Rows of repaired exchanges of labels, of cuts, and of detections left out.
    symmetry : str
        Point group of the shape within its own error (Schoenflies symbol).
    fraction : float
        Share of the rows from the first frame to the last that have a pose.
    warnings : tuple of str
        What a reader should know, in words; empty for a good cluster.
    """

    rigid: bool
    reasons: tuple[str, ...]
    residual_over_R: float
    residual_over_sigma: float | None
    autocorrelation: float | None
    bond_drift: float
    drifting_pair: tuple[int, ...]
    sigma_xyz: tuple[float, ...] | None
    z_scale: float | None
    z_scale_stderr: float | None
    scan_blur: float | None
    swaps: tuple[int, ...]
    cuts: tuple[int, ...]
    extra: tuple[int, ...]
    symmetry: str
    fraction: float
    warnings: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the entry "quality" of ``summary.json``."""
        return {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(self).items()}

    @classmethod
    def from_dict(cls, entry: dict[str, Any]) -> Quality:
        """Read back what `to_dict` wrote."""
        fields: dict[str, Any] = {
            k: tuple(v) if isinstance(v, list) else v for k, v in entry.items()
        }
        return cls(**fields)


def judge_quality(
    motion: RigidMotion,
    positions: ArrayLike,
    *,
    sigma: ArrayLike | None = None,
    sigma_ratio: ArrayLike | None = None,
    swaps: tuple[int, ...] = (),
    cuts: tuple[int, ...] = (),
    extra: tuple[int, ...] = (),
) -> Quality:
    """Judge a cluster's rigid fits.

    Parameters
    ----------
    motion : RigidMotion
    positions : array_like, shape (T, n, d)
        The positions that the motion was fitted to, um.
    sigma : float or array_like, shape (d,), optional
        Localisation error known to the user, um.
    sigma_ratio : array_like, shape (d,), optional
        Localisation errors of the axes over each other, where only that is known: for `scan_blur`.
    swaps, cuts, extra : tuple of int
        What the identity of the particles went through (`Identity`).

    Returns
    -------
    Quality

    Raises
    ------
    ValueError
        For bad shapes or values.

    Examples
    --------
    >>> from perrin import Cluster, add_noise, simulate_motion, track_rotation
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=0.02, dt=0.7, n_frames=300, rng=1)
    >>> x = add_noise(truth.positions(), sigma=(0.03, 0.03, 0.06), rng=2)
    >>> quality = judge_quality(track_rotation(x, dt=0.7), x)
    >>> quality.rigid, [round(s, 3) for s in quality.sigma_xyz]
    (True, [0.031, 0.032, 0.059])
    """
    x = as_positions(positions)
    residuals = body_residuals(motion, x)
    smooth = _autocorrelation(residuals)
    drift, pair, ends = _bond_drift(x, motion.sigma)
    sample = _sample(motion, residuals)
    sigma_xyz = _sigma_per_axis(sample)
    scale, scale_error = _z_scale(sample, smooth)
    blur = _scan_blur(sigma_xyz, sigma if sigma_ratio is None else sigma_ratio)
    over, soft = _softness(motion, smooth, sigma)
    broken = _broken(pair, drift, ends)
    odd = _odd_scale(scale, scale_error) + _blurred(blur)
    return Quality(
        rigid=not (soft or broken),
        reasons=(*soft, *broken),
        residual_over_R=motion.sigma / motion.R,
        residual_over_sigma=over,
        autocorrelation=_known(smooth),
        bond_drift=drift,
        drifting_pair=pair,
        sigma_xyz=sigma_xyz,
        z_scale=_known(scale),
        z_scale_stderr=_known(scale_error),
        scan_blur=blur,
        swaps=swaps,
        cuts=cuts,
        extra=extra,
        symmetry=point_group(motion.template, tolerance=motion.template_error),
        fraction=motion.fitted.size / len(motion.time),
        warnings=(*soft, *broken, *odd),
    )


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _softness(
    motion: RigidMotion, smooth: float, sigma: ArrayLike | None
) -> tuple[float | None, list[str]]:
    """Judge by the size of the residuals: over the stated sigma, or over R and smooth in time."""
    if sigma is not None:
        stated = float(np.sqrt(np.mean(as_sigma(sigma, motion.template.shape[1]) ** 2)))
        over = motion.sigma / stated if stated > 0 else np.inf
        if not motion.sigma > _SOFT_FACTOR * stated:
            return _known(over), []
        return _known(over), [
            f"not rigid: the particles leave the common shape by {motion.sigma:.3g} um a "
            f"coordinate, {over:.1f} times the stated sigma; or identities swap, "
            "or the particles of a frame are not simultaneous"
        ]
    if motion.sigma <= _SOFT_SIZE * motion.R or not smooth > _SOFT_SMOOTH:
        return None, []
    return None, [
        f"not rigid: residuals of {motion.sigma:.3g} um a coordinate are "
        f"{motion.sigma / motion.R:.3f} of R (over {_SOFT_SIZE}) and smooth in time (lag-1 "
        f"autocorrelation {smooth:.2f}, over {_SOFT_SMOOTH}); if this is the localisation error "
        "itself, state it as sigma"
    ]


def _autocorrelation(residuals: Floats) -> float:
    """Return the lag-1 autocorrelation of residual vectors (T, n, d); NaN without pairs."""
    before, after = residuals[:-1], residuals[1:]
    both = np.isfinite(before) & np.isfinite(after)
    a, b = before[both], after[both]
    power = 0.5 * float(a @ a + b @ b)
    return float(a @ b) / power if power > 0 else np.nan


def _bond_drift(x: Floats, sigma: float) -> tuple[float, tuple[int, ...], tuple[float, ...]]:
    """Return the largest relative drift of a pair's distance, the pair, and the two distances."""
    worst: tuple[float, tuple[int, ...], tuple[float, ...]] = (0.0, (0, 1), (0.0, 0.0))
    blocks = np.array_split(np.arange(len(x)), min(_BLOCKS, max(1, len(x) // 5)))
    for i, j in zip(*np.triu_indices(x.shape[1], 1), strict=True):
        distance = np.linalg.norm(x[:, i] - x[:, j], axis=1)
        kept = [distance[b][np.isfinite(distance[b])] for b in blocks]
        means = [(float(k.mean()), k.size) for k in kept if k.size]
        if len(means) < 2:
            continue
        (low, few), (high, more) = min(means), max(means)
        noise = _BEYOND * np.nan_to_num(sigma) * np.sqrt(2 / few + 2 / more)
        drift = (high - low) / low if high - low > noise and low > 0 else 0.0
        if drift > worst[0]:
            worst = (float(drift), (int(i), int(j)), (low, high))
    return worst


def _broken(pair: tuple[int, ...], drift: float, ends: tuple[float, ...]) -> list[str]:
    if drift <= _BROKEN:
        return []
    return [
        f"not rigid: the distance of particles {pair[0]} and {pair[1]} (counted from 0) changes in "
        f"time between {ends[0]:.3g} and {ends[1]:.3g} um; a bond breaks, or a particle is another"
    ]


class _Sample(NamedTuple):
    """Complete frames: rotations (K, d, d), residuals (K, n, d) in body axes, and the projector.

    `keeps` (n, n, d, d) is the projector of a rigid fit in body axes: what it leaves of noise.
    """

    rotation: Floats
    residual: Floats
    template: Floats
    keeps: Floats
    sigma: float


def _sample(motion: RigidMotion, residuals: Floats) -> _Sample:
    rows = np.flatnonzero(np.isfinite(residuals).all(axis=(1, 2)))
    rows = rows[np.unique(np.linspace(0, max(rows.size - 1, 0), _FRAMES).astype(int))[: rows.size]]
    r = motion.template
    n, d = r.shape
    across = np.stack([-r[:, 1], r[:, 0]], axis=1)[..., None] if d == 2 else -skew(r)
    slopes = np.concatenate([across, np.broadcast_to(np.eye(d), (n, d, d))], axis=2)
    flat = slopes.reshape(n * d, -1)
    keeps = np.eye(n * d) - flat @ np.linalg.pinv(flat)
    blocks = keeps.reshape(n, d, n, d).transpose(0, 2, 1, 3)
    return _Sample(motion.rotation[rows], residuals[rows], r, blocks, motion.sigma)


def _sigma_per_axis(sample: _Sample) -> tuple[float, ...] | None:
    """Return the localisation error of each lab axis, where the residuals can tell.

    The mean squares of the residuals along the lab axes are a linear function of the three
    variances through the projector of the fit; the function's inverse is their covariance.
    """
    turn, d = sample.rotation, sample.rotation.shape[-1]
    if len(turn) < 2 or not sample.sigma > 0:
        return None
    mix = np.zeros((d, d))
    for row in sample.keeps:
        for block in row:
            mix += ((turn @ block @ np.swapaxes(turn, -1, -2)) ** 2).sum(axis=0)
    lab = np.einsum("tij,tnj->tni", turn, sample.residual)
    square = (lab**2).sum(axis=(0, 1)) * len(turn) / (len(turn) - 1)
    if np.linalg.cond(mix) > 1e8:
        return None
    inverse = np.linalg.inv(mix)
    variance = inverse @ square
    told = np.sqrt(2 * np.maximum(np.diag(inverse), 0.0)) <= _TOLD
    if not told.all() or not (variance > 0).all():
        return None
    return tuple(float(s) for s in np.sqrt(variance))


def _inflation(smooth: float) -> float:
    """Return by how much noise that is smooth in time widens an error."""
    rho = float(np.clip(np.nan_to_num(smooth), 0.0, 0.999))
    return float(np.sqrt((1 + rho) / (1 - rho)))


def _z_scale(sample: _Sample, smooth: float) -> tuple[float, float]:
    """Fit how the shape changes with orientation if z is stretched; return scale and its error."""
    turn, n = sample.rotation, len(sample.template)
    if turn.shape[-1] != 3 or len(turn) < 2:
        return np.nan, np.nan
    up = turn[:, 2]  # the lab's z axis in body axes
    height = np.einsum("ti,ni->tn", up, sample.template)
    stretch = height[..., None] * up[:, None]
    left = np.einsum("nmij,tmj->tni", sample.keeps, stretch)
    left = left - left.mean(axis=0)
    power = float((left**2).sum())
    # A body that hardly turns hides a stretch in its shape.
    if power <= 1e-6 * n * len(turn) * float((sample.template**2).mean()):
        return np.nan, np.nan
    scale = 1.0 + float((left * sample.residual).sum()) / power
    return scale, sample.sigma / np.sqrt(power) * _inflation(smooth)


def _odd_scale(scale: float, error: float) -> list[str]:
    if not (abs(scale - 1) > _SCALE and abs(scale - 1) > _SCALE_ERRORS * error):
        return []
    return [
        f"z scale: the shape changes with its orientation as if z were {scale:.3f} times too long "
        f"(standard error {error:.2g}); check the voxel size or the refractive index"
    ]


def _scan_blur(sigma_xyz: tuple[float, ...] | None, sigma: ArrayLike | None) -> float | None:
    """Return sigma_z over sigma_xy, over the same ratio of the stated sigma where there is one.

    Particles recorded one after another along z are displaced by what the body moves meanwhile. In
    x and y that looks like a rotation and leaves no residual; along z it stretches the body.
    """
    if sigma_xyz is None or len(sigma_xyz) != 3:
        return None
    stated = np.ones(3) if sigma is None else as_sigma(sigma, 3)
    over = np.array(sigma_xyz) / stated if (stated > 0).all() else np.array(sigma_xyz)
    return float(over[2] / np.sqrt(np.mean(over[:2] ** 2)))


def _blurred(blur: float | None) -> list[str]:
    if blur is None or blur <= _BLUR:
        return []
    return [
        f"scan: the residuals say sigma_z = {blur:.1f} times sigma_xy (over the stated ratio, if "
        "any): if your microscope is not that much worse along z, the particles of a frame are "
        "recorded one after another (sequential scan); sigma then includes motion, and D with "
        "noise from the residuals is too low"
    ]
