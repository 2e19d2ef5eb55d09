"""How far a fitted body deserves trust: is it rigid, how large its errors are, what was done."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from perrin._arrays import Floats, Ints, as_positions, as_sigma, finite_or_none, present
from perrin.geometry.symmetry import point_group
from perrin.motion.residuals import (
    LEVEL,
    Residuals,
    Slope,
    autocorrelation,
    axis_noise,
    body_residuals,
    fit_projector,
    lag_one_autocorrelation,
    lagged_products,
    measure_scan,
    measure_stretch,
    sample_residuals,
)

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from perrin.motion.residuals import AxisNoise
    from perrin.motion.rigid_motion import RigidMotion


# A body is called soft when its residuals are large against its size and smooth in time; a sigma
# stated by the user replaces both rules by a factor on it.
_SOFT_SIZE, _SOFT_SMOOTH, _SOFT_FACTOR = 0.03, 0.3, 2.0


# A particle that moves against the others: root mean square of the part that is smooth in time,
# over R.
_FLEXING = 0.03


# Share of the detections trimmed (winsorised) as outliers of each particle.
_TRIMMED = 0.05


# A detection fits badly beyond this multiple of the distance that most detections keep.
_MISFIT, _MOST = 3.0, 0.9


# Shares of the frames that may fit badly in a rigid body: one particle of it, and any.
_MISFIT_PARTICLE, _MISFIT_FRAMES = 0.05, 0.1


# A bond breaks when the median distance of a pair in one eighth of the time leaves that in another
# by a fifth of itself and by more than the noise: five standard errors, as 28 pairs of eighths of
# up to dozens of pairs of particles are compared.
_BLOCKS, _BROKEN, _BEYOND = 8, 0.2, 5.0


# A scale error of z is reported from 1 % on, where the test finds it.
_SCALE = 0.01


# The ratio of the noise along z to that in x and y is held against the stated one from here on:
# a user's statement is no more exact.
_BLUR = 1.25


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
    scan_blur, scan_blur_stderr : float or None
        sigma_z over sigma_xy, over the ratio stated by `sigma` or `sigma_ratio`, with its standard
        error.
    scan_delay, scan_delay_stderr : float or None
        How much later a frame's particles are recorded with height, s/um, from residuals that
        follow the velocity of the body times the height of the particle: 0 where all are recorded
        at once.
    misfits : int
        Number of frames with a detection that is not at its place in the common shape, those that
        fit in no assignment included.
    notes : tuple of str
        What informs, in words.
    swaps, cuts, extra : tuple of int
        Rows of repaired exchanges of labels, of cuts, and of detections left out.
    symmetry : str
        Point group of the shape within its own error (Schoenflies symbol).
    fraction : float
        Share of the rows from the first frame to the last that have a pose.
    warnings : tuple of str
        What is wrong, in words; empty for a good cluster.
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
    notes: tuple[str, ...] = ()
    scan_blur_stderr: float | None = None
    scan_delay: float | None = None
    scan_delay_stderr: float | None = None
    misfits: int = 0

    def to_dict(self) -> dict[str, Any]:
        """Return the entry "quality" of ``summary.json``."""
        return {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(self).items()}

    @classmethod
    def from_dict(cls, entry: dict[str, Any]) -> Quality:
        """Read back what `to_dict` wrote; fields that older versions did not write are empty."""
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
    detections: ArrayLike | None = None,
    unsettled: ArrayLike = (),
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
    detections : array_like, shape (T, m, d), optional
        The same rows before any detection was left out. A detection that was left out is held
        against the place of the missing particle next to it: a soft body stays soft when the
        frames that show it are thrown away.
    unsettled : array_like of int, optional
        Rows that fit the common shape in no assignment (`Identity`).

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
    stretch = measure_stretch(motion, x)
    stretched = _stretched(stretch.scale)
    # What z alone does to the distances must not be taken for a soft body.
    right = np.array([1.0, 1.0, stretch.scale.value]) if stretched else np.ones(x.shape[2])
    body = stretch.motion if stretched else motion
    everything = _with_detections(body, x / right, detections, right)
    sample = stretch.sample if stretched else sample_residuals(motion, x)
    smooth = lag_one_autocorrelation(body_residuals(body, x / right))
    drift, pair, ends = _bond_drift(x / right)
    noise = axis_noise(stretch.sample)
    sigma_xyz = _sigma_per_axis(noise, right)
    blur = _scan_blur(noise, right, sigma if sigma_ratio is None else sigma_ratio)
    delay = measure_scan(stretch.sample)
    misfit = _misfits(body, everything, np.asarray(unsettled, dtype=np.int64))
    soft = [
        *_softness(body, sample, smooth, sigma),
        *_flexing(body, everything),
        *_misplaced(misfit, body.fitted.size),
        *_broken(pair, drift, ends),
    ]
    stated = sigma is not None or sigma_ratio is not None
    return Quality(
        rigid=not soft,
        reasons=tuple(soft),
        residual_over_R=motion.sigma / motion.R,
        residual_over_sigma=_over_stated(motion, sigma),
        autocorrelation=finite_or_none(smooth.value),
        bond_drift=drift,
        drifting_pair=pair,
        sigma_xyz=sigma_xyz,
        z_scale=finite_or_none(stretch.scale.value),
        z_scale_stderr=finite_or_none(stretch.scale.stderr),
        scan_blur=finite_or_none(blur.value),
        swaps=swaps,
        cuts=cuts,
        extra=extra,
        symmetry=point_group(motion.template, tolerance=motion.template_error),
        fraction=motion.fitted.size / len(motion.time),
        warnings=(*soft, *_odd_scale(stretch.scale), *_scanned(delay), *_blurred(blur, stated)),
        notes=(*_misfits_noted(misfit, soft, body), *_ratio_noted(blur, stated)),
        scan_blur_stderr=finite_or_none(blur.stderr),
        scan_delay=finite_or_none(delay.value),
        scan_delay_stderr=finite_or_none(delay.stderr),
        misfits=int(misfit.any(axis=1).sum()),
    )


def _over_stated(motion: RigidMotion, sigma: ArrayLike | None) -> float | None:
    if sigma is None:
        return None
    stated = float(np.sqrt(np.mean(as_sigma(sigma, motion.template.shape[1]) ** 2)))
    return finite_or_none(motion.sigma / stated) if stated > 0 else None


def _softness(
    motion: RigidMotion, sample: Residuals, smooth: Slope, sigma: ArrayLike | None
) -> list[str]:
    """Judge by the size of the residuals: over the stated sigma, or over R and smooth in time."""
    usual = _usual_sigma(sample)
    if sigma is not None:
        stated = float(np.sqrt(np.mean(as_sigma(sigma, motion.template.shape[1]) ** 2)))
        if not usual > _SOFT_FACTOR * stated:
            return []
        over = usual / stated if stated > 0 else np.inf
        return [
            f"not rigid: the particles leave the common shape by {usual:.3g} um a "
            f"coordinate, {over:.1f} times the stated sigma; or identities swap, "
            "or the particles of a frame are not simultaneous"
        ]
    if not usual > _SOFT_SIZE * motion.R:
        return []
    if not smooth.value - _SOFT_SMOOTH > 3 * smooth.stderr:
        return []
    return [
        f"not rigid: residuals of {usual:.3g} um a coordinate are {usual / motion.R:.3f} of R "
        f"(over {_SOFT_SIZE}) and smooth in time (lag-1 autocorrelation {smooth.value:.2f} +- "
        f"{smooth.stderr:.2f}, over {_SOFT_SMOOTH}); if this is the localisation error itself, "
        "state it as sigma"
    ]


def _usual_sigma(sample: Residuals) -> float:
    """Return the noise of one coordinate from the median frame, which bad frames hardly change.

    The median of chi-squared is that of Wilson and Hilferty, f (1 - 2/(9 f))^3.
    """
    freedom, count = sample.freedom, len(sample.vector)
    if count < 2 or freedom == 0:
        return np.nan
    square = float(np.median((sample.vector**2).sum(axis=(1, 2)))) * count / (count - 1)
    return float(np.sqrt(square / (freedom * (1 - 2 / (9 * freedom)) ** 3)))


def _with_detections(
    motion: RigidMotion, x: Floats, detections: ArrayLike | None, scale: Floats
) -> Floats:
    """Put detections that were left out at the missing particles next to them, (T, n, d).

    A detection farther than R from every missing particle is none of the body.
    """
    if detections is None:
        return x
    found = as_positions(detections, name="detections") / scale
    if len(found) != len(x):
        raise ValueError(f"detections: expected {len(x)} rows as in positions, got {len(found)}")
    filled, seen, places = x.copy(), present(x), motion.positions()
    used = (found[:, :, None] == x[:, None]).all(axis=3).any(axis=2)
    spare = present(found) & ~used
    for k in np.flatnonzero(spare.any(axis=1) & ~seen.all(axis=1) & np.isfinite(places[:, 0, 0])):
        missing, points = np.flatnonzero(~seen[k]), found[k, spare[k]]
        distance = np.linalg.norm(points[:, None] - places[k, missing], axis=2)
        for row, nearest in zip(points, distance.argmin(axis=1), strict=True):
            off = np.linalg.norm(row - places[k, missing[nearest]])
            now = np.linalg.norm(filled[k, missing[nearest]] - places[k, missing[nearest]])
            if off <= motion.R and not now <= off:
                filled[k, missing[nearest]] = row
    return filled


def _misfits(motion: RigidMotion, x: Floats, unsettled: Ints) -> Floats:
    """Return which detections (T, n) are not at their places in the common shape.

    The limit is three times the distance that 90 % of all detections keep: 4.9 standard deviations
    where the noise is along one axis, 7.5 where it is equal in three.
    """
    distance = np.linalg.norm(body_residuals(motion, x), axis=2)
    seen = np.isfinite(distance)
    limit = _MISFIT * float(np.quantile(distance[seen], _MOST)) if seen.any() else np.inf
    # Rounding is no misfit.
    far: Floats = np.where(seen & (distance > max(limit, 1e-9 * motion.R)), 1.0, 0.0)
    far[unsettled] = 1.0
    return far


def _misplaced(misfit: Floats, count: int) -> list[str]:
    """Judge by the number of frames in which a detection is not at its place (binomial test)."""
    from scipy.stats import binom

    each, total = misfit.sum(axis=0).astype(int), int(misfit.any(axis=1).sum())
    worst = int(each.argmax())
    level = LEVEL / len(each)
    if total > binom.isf(LEVEL, count, _MISFIT_FRAMES):
        return [
            f"not rigid: in {total} of {count} frames a particle is not at its place in the common "
            f"shape (at most {_MISFIT_FRAMES:.0%} are taken for bad frames)"
        ]
    if each[worst] > binom.isf(level, count, _MISFIT_PARTICLE):
        return [
            f"not rigid: particle {worst} (counted from 0) is not at its place in the common shape "
            f"in {each[worst]} of {count} frames (at most {_MISFIT_PARTICLE:.0%} are taken for bad "
            "detections)"
        ]
    return []


def _misfits_noted(misfit: Floats, soft: list[str], motion: RigidMotion) -> list[str]:
    rows = np.flatnonzero(misfit.any(axis=1))
    if soft or not rows.size:
        return []
    return [
        f"{rows.size} of {motion.fitted.size} frames fit the common shape badly (first at "
        f"{motion.time[rows[0]]:g} s): a particle is over {_MISFIT:g} times as far from its place "
        f"as {_MOST:.0%} of all detections are"
    ]


def _flexing(motion: RigidMotion, x: Floats) -> list[str]:
    """Judge by the particle that moves against the others more than noise of all of them does.

    Noise that differs between particles has no memory, and noise that is smooth in time is as
    smooth for all of them: tested is the covariance of a particle's place in the body between
    neighbouring frames, less that of the median particle.
    """
    from scipy.stats import t

    n, d = motion.template.shape
    keeps = fit_projector(motion.template)
    vector = np.einsum("nmij,tmj->tni", keeps, body_residuals(motion, x))
    whole = np.isfinite(vector).all(axis=(1, 2))
    # What each particle's variance contributes to the mean squares of all residuals.
    share = np.einsum("nmij,nmij->nm", keeps, keeps)
    first = (np.cumsum(whole) - 1)[:-1][whole[1:] & whole[:-1]]
    if first.size < 10 or np.linalg.cond(share) > 1e6:
        return []
    vector = _winsorised(vector[whole] - np.median(vector[whole], axis=0))
    inverse = np.linalg.inv(share)
    product = (vector[first] * vector[first + 1]).sum(axis=2) @ inverse
    order = np.argsort(product.mean(axis=0))
    worst, middle = int(order[-1]), int(order[(n - 1) // 2])
    excess = float(np.mean(product[:, worst] - product[:, middle]))
    size = float(np.sqrt(max(d * excess, 0.0)))
    if not size > _FLEXING * motion.R:
        return []
    # Equal noise gives the products the covariance `inverse` times a number; the number is that of
    # the median particle, and its autocorrelation that of the other particles, as the error of
    # the worst would contain what is tested.
    unit = float(np.sort(product.var(axis=0) / np.diag(inverse))[(n - 1) // 2])
    others = np.delete(vector, worst, axis=1)
    rho = autocorrelation(lagged_products(others), d * (n - 1) / 2)
    repeats = 1.0 + 2.0 * float(rho @ rho)
    contrast = inverse[worst, worst] + inverse[middle, middle] - 2 * inverse[worst, middle]
    error = float(np.sqrt(unit * contrast * repeats / first.size))
    if not excess > t.isf(LEVEL / n, max(first.size / repeats, 1.0)) * error:
        return []
    return [
        f"not rigid: particle {worst} (counted from 0) moves against the others by {size:.3g} um "
        f"smoothly in time ({size / motion.R:.3f} of R, over {_FLEXING}; {excess / error:.1f} "
        "standard errors)"
    ]


def _winsorised(vector: Floats) -> Floats:
    """Shorten the longest 5 % of every particle's vectors (T, n, d) to the length of the next."""
    length = np.linalg.norm(vector, axis=2, keepdims=True)
    limit = np.quantile(length, 1 - _TRIMMED, axis=0)
    short: Floats = vector * np.minimum(1.0, limit / np.maximum(length, 1e-300))
    return short


def _bond_drift(x: Floats) -> tuple[float, tuple[int, ...], tuple[float, ...]]:
    """Return the largest relative drift of a pair's distance, the pair, and the two distances.

    Medians of eighths of the time are compared with the scatter inside the eighths, which does
    not contain the drift between them.
    """
    worst: tuple[float, tuple[int, ...], tuple[float, ...]] = (0.0, (0, 1), (0.0, 0.0))
    blocks = np.array_split(np.arange(len(x)), min(_BLOCKS, max(1, len(x) // 5)))
    for i, j in zip(*np.triu_indices(x.shape[1], 1), strict=True):
        distance = np.linalg.norm(x[:, i] - x[:, j], axis=1)
        kept = [k for k in (distance[b][np.isfinite(distance[b])] for b in blocks) if k.size]
        if len(kept) < 2:
            continue
        medians = [(float(np.median(k)), k.size) for k in kept]
        (low, few), (high, more) = min(medians), max(medians)
        noise = _BEYOND * _median_noise(kept) * np.sqrt(1 / few + 1 / more)
        drift = (high - low) / low if high - low > noise and low > 0 else 0.0
        if drift > worst[0]:
            worst = (float(drift), (int(i), int(j)), (low, high))
    return worst


def _median_noise(blocks: list[Floats]) -> float:
    """Return the standard error of a median times the root of the number of values.

    From the median absolute deviations inside the blocks, wider by their autocorrelation.
    """
    off = [b - np.median(b) for b in blocks]
    scatter = 1.4826 * float(np.median(np.abs(np.concatenate(off))))
    power = sum(float(e @ e) for e in off)
    rho = sum(float(e[:-1] @ e[1:]) for e in off) / power if power > 0 else 0.0
    rho = min(max(rho, 0.0), 0.9)  # a block of a dozen values measures no more
    return scatter * float(np.sqrt(np.pi / 2 * (1 + rho) / (1 - rho)))


def _broken(pair: tuple[int, ...], drift: float, ends: tuple[float, ...]) -> list[str]:
    if drift <= _BROKEN:
        return []
    return [
        f"not rigid: the distance of particles {pair[0]} and {pair[1]} (counted from 0) changes in "
        f"time between {ends[0]:.3g} and {ends[1]:.3g} um; a bond breaks, or a particle is another"
    ]


def _sigma_per_axis(noise: AxisNoise | None, scale: Floats) -> tuple[float, ...] | None:
    """Return the localisation error of each lab axis in the coordinates given, where known."""
    if noise is None or not noise.known:
        return None
    return tuple(float(s) for s in np.sqrt(noise.variance) * scale)


def _stretched(scale: Slope) -> bool:
    """Decide whether z is stretched: by 1 % or more, and by the test."""
    return scale.known and abs(scale.value - 1) > _SCALE and scale.differs_from(1.0)


def _odd_scale(scale: Slope) -> list[str]:
    if not _stretched(scale):
        return []
    return [
        f"z scale: the shape changes with its orientation as if z were {scale.value:.3f} +- "
        f"{scale.stderr:.2g} times too long; check the voxel size or the refractive index"
    ]


def _scan_blur(noise: AxisNoise | None, scale: Floats, sigma: ArrayLike | None) -> Slope:
    """Return sigma_z over sigma_xy, over the same ratio of the stated sigma where there is one."""
    if noise is None or not noise.known or len(noise.variance) != 3:
        return Slope(np.nan, np.nan, 0.0)
    stated = np.ones(3) if sigma is None else as_sigma(sigma, 3)
    unit = (scale / stated if (stated > 0).all() else scale) ** 2
    v = noise.variance * unit
    across = v[:2].sum()
    ratio = float(np.sqrt(2 * v[2] / across))
    # Of the logarithm of the squared ratio.
    slope = np.array([-1 / across, -1 / across, 1 / v[2]]) * unit
    return Slope(ratio, 0.5 * ratio * float(np.sqrt(slope @ noise.covariance @ slope)), np.inf)


def _blurred(blur: Slope, stated: bool) -> list[str]:
    """Compare the ratio with the stated one; without one the ratio is no evidence of anything."""
    if not (stated and blur.known and blur.value > _BLUR):
        return []
    # Tested on the logarithm, whose error does not grow with the ratio.
    if not Slope(np.log(blur.value), blur.stderr / blur.value, np.inf).differs_from(0.0):
        return []
    return [
        f"noise along z: sigma_z over sigma_xy is {blur.value:.2f} +- {blur.stderr:.2g} times the "
        "stated ratio; z is located worse than stated, or the particles of a frame are recorded "
        "one after another (sequential scan): then sigma includes motion, and D with noise from "
        "the residuals is too low"
    ]


def _ratio_noted(blur: Slope, stated: bool) -> list[str]:
    if stated or not blur.known:
        return []
    if not Slope(np.log(blur.value), blur.stderr / blur.value, np.inf).differs_from(0.0):
        return []
    return [f"localisation error: sigma_z is {blur.value:.2f} +- {blur.stderr:.2g} times sigma_xy"]


def _scanned(delay: Slope) -> list[str]:
    if not delay.differs_from(0.0):
        return []
    return [
        "scan: the particles of a frame are recorded one after another along z: their residuals "
        f"follow the velocity of the body times their height, {abs(delay.value):.2g} +- "
        f"{delay.stderr:.2g} s/um; sigma then includes motion, and D with noise from the residuals "
        "is too low"
    ]
