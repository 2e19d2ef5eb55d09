"""Rigidity of a fitted body: tests for softness, scale of z, and recording of a frame in turn."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from perrin._arrays import Bools, Floats, as_positions, as_sigma, finite_or_none, present, to_plain
from perrin._display import Shown
from perrin.geometry.shapes import pair_distances
from perrin.geometry.symmetry import point_group, schoenflies
from perrin.motion.residuals import (
    SIGNIFICANCE,
    UNKNOWN_SLOPE,
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

    from perrin.motion.rigid_motion import RigidMotion

# Largest residual of a rigid body, a coordinate, over R: the localisation errors of real cameras
# reach half of it.
_LARGEST_RESIDUAL = 0.03

# Largest lag-1 autocorrelation of residuals that is still localisation error without memory.
_SMOOTHEST_RESIDUAL = 0.3

# Largest residual over the sigma stated by the user, which replaces both rules above: a stated
# sigma is exact within this factor.
_LARGEST_OVER_SIGMA = 2.0

# Largest displacement of one particle against the others that is smooth in time (root mean square)
# over R: as for the residuals of all.
_LARGEST_FLEXING = 0.03

# Share of the detections of each particle that are trimmed (winsorised) as outliers.
_TRIMMED_SHARE = 0.05

# A detection is misplaced beyond this multiple of the distance from its position in the common
# shape that `_USUAL_SHARE` of all detections keep: 4.9 standard deviations where the noise is along
# one axis, 7.5 where it is equal in three.
_MISPLACED_MULTIPLE, _USUAL_SHARE = 3.0, 0.9

# Largest share of the frames of a rigid body in which one particle, or any, is misplaced: detectors
# fail as often.
_MISPLACED_PARTICLE, _MISPLACED_FRAMES = 0.05, 0.1

# Number of blocks of time whose median distances of a pair are compared.
_TIME_BLOCKS = 8

# Largest change of a pair's distance between blocks, over the distance, before a bond is broken.
_LARGEST_DRIFT = 0.2

# Standard errors by which a change of a distance must exceed its noise: 28 pairs of blocks of up to
# dozens of pairs of particles are compared.
_DRIFT_ERRORS = 5.0

# Smallest relative error of the scale of z that is reported, where it is significant: refractive
# indices are not known better.
_SCALE_ERROR = 0.01

# Largest ratio of sigma_z to sigma_xy, over the stated ratio, that is not reported: a stated ratio
# is no more exact.
_RATIO_EXCESS = 1.25


@dataclass(frozen=True, repr=False)
class Quality(Shown):
    """How rigid a fitted cluster is, and how large its errors are.

    Attributes
    ----------
    rigid : bool
        Whether the cluster passes all tests of rigidity.
    reasons : tuple of str
        The failed tests, one sentence each; empty where the cluster is rigid.
    residual_over_R : float
        Localisation error from the residuals over the mean distance of the particles to the centre.
    residual_over_sigma : float or None
        Localisation error from the residuals over the one stated by the user.
    autocorrelation : float or None
        Autocorrelation of the residuals between neighbouring frames. Errors of real cameras are
        smooth in time (0.9 and more), so that a large value alone is no sign of softness.
    bond_drift : float
        Largest relative change of a pair's distance between eighths of the time.
    drifting_pair : tuple of int
        Columns of the two particles whose distance changes most.
    sigma_xyz : tuple of float or None
        Localisation error of each lab axis, um; None where the residuals do not determine it.
    z_scale, z_scale_stderr : float or None
        Scale of z against x and y (1: not stretched) and its standard error, from the change of the
        shape with orientation.
    scan_blur, scan_blur_stderr : float or None
        sigma_z over sigma_xy, over the ratio stated by `sigma` or `sigma_ratio`, and its standard
        error.
    scan_delay, scan_delay_stderr : float or None
        Delay of recording per height of a particle within a frame, s/um, and its standard error,
        from residuals that follow the velocity of the body times the height; 0 where all particles
        are recorded at once.
    misfits : int
        Number of frames with a misplaced detection, including those that fit the common shape in
        no assignment.
    notes : tuple of str
        Information that is no fault, one sentence each.
    swaps, cuts, extra : tuple of int
        Rows of corrected exchanges of labels, of cuts, and of detections left out.
    symmetry : str
        Point group of the shape within its own error (Schoenflies symbol).
    fraction : float
        Share of the rows from the first frame to the last that have a pose.
    warnings : tuple of str
        Faults, one sentence each; empty for a good cluster.
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
        entry: dict[str, Any] = to_plain(asdict(self))
        return entry

    @classmethod
    def from_dict(cls, entry: dict[str, Any]) -> Quality:
        """Return what `to_dict` wrote; fields that older versions did not write are empty.

        Parameters
        ----------
        entry : dict

        Returns
        -------
        Quality
        """
        values: dict[str, Any] = {
            k: tuple(v) if isinstance(v, list) else v for k, v in entry.items()
        }
        if values["residual_over_R"] is None:
            values["residual_over_R"] = np.nan
        return cls(**values)


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
    """Test whether a cluster is rigid, and measure the errors of its positions.

    Parameters
    ----------
    motion : RigidMotion
    positions : array_like, shape (T, n, d)
        The positions that the motion was fitted to, um.
    sigma : float or array_like, shape (d,), optional
        Localisation error known to the user, um.
    sigma_ratio : array_like, shape (d,), optional
        Ratio of the localisation errors of the axes, where only that is known, for `scan_blur`.
    swaps, cuts, extra : tuple of int
        Corrections of the identity of the particles (`Identity`).
    detections : array_like, shape (T, m, d), optional
        The same rows before any detection was left out. A detection that was left out is compared
        with the position of the nearest missing particle, so that a soft body is found soft also
        where the detections that show it were left out.
    unsettled : array_like of int, optional
        Rows that fit the common shape in no assignment (`Identity`).

    Returns
    -------
    Quality

    Raises
    ------
    ValueError
        If a shape or value is not valid.

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
    d = motion.dimension
    stated = None if sigma is None else as_sigma(sigma, d)
    ratio = stated if sigma_ratio is None else as_sigma(sigma_ratio, d)
    stated_sigma = None if stated is None else float(np.sqrt(np.mean(stated**2)))
    stretch = measure_stretch(motion, x)
    scale = stretch.scale
    stretched = abs(scale.value - 1) > _SCALE_ERROR and scale.differs_from(1.0)
    # A stretched z changes the distances of a rigid body: it is corrected before the tests.
    unit = np.array([1.0, 1.0, scale.value]) if stretched else np.ones(d)
    body = stretch.motion if stretched else motion
    corrected = x / unit
    all_detections = corrected
    if detections is not None:
        found = as_positions(detections, name="detections") / unit
        all_detections = _restored_detections(body, corrected, found)
    misfit = misplaced_detections(body, all_detections)
    misfit[np.asarray(unsettled, dtype=np.int64)] = True
    misfit_rows = np.flatnonzero(misfit.any(axis=1))
    smooth = lag_one_autocorrelation(body_residuals(body, corrected))
    drift = bond_drift(corrected)
    noise = axis_noise(stretch.sample)
    noise = noise if noise is not None and noise.known else None
    per_unit = unit / ratio if ratio is not None and (ratio > 0).all() else unit
    blur = UNKNOWN_SLOPE if noise is None or d == 2 else noise.z_ratio(per_unit)
    # Positions of particles with their own times were moved to one instant.
    delay = measure_scan(stretch.sample) if motion.turn_noise is None else UNKNOWN_SLOPE

    sample = stretch.sample if stretched else sample_residuals(motion, x)
    soft = [
        *_residual_test(body, sample, smooth, stated_sigma),
        *_flexing_test(body, all_detections),
        *_misfit_test(misfit, body.fitted.size),
    ]
    if drift.change > _LARGEST_DRIFT:
        soft.append(
            f"not rigid: the distance of particles {drift.pair[0]} and {drift.pair[1]} (counted "
            f"from 0) changes in time between {drift.distances[0]:.3g} and "
            f"{drift.distances[1]:.3g} um; a bond breaks, or a label moves to another particle"
        )
    warnings, notes = _imaging_texts(scale if stretched else None, delay, blur, ratio is not None)
    if misfit_rows.size and not soft:
        notes.insert(
            0,
            f"{misfit_rows.size} of {body.fitted.size} frames fit the common shape badly (first at "
            f"{body.time[misfit_rows[0]]:g} s): a particle is over {_MISPLACED_MULTIPLE:g} times "
            f"as far from its place as {_USUAL_SHARE:.0%} of all detections are",
        )
    elements = motion.symmetry_elements
    return Quality(
        rigid=not soft,
        reasons=tuple(soft),
        residual_over_R=motion.sigma / motion.R,
        residual_over_sigma=finite_or_none(motion.sigma / stated_sigma) if stated_sigma else None,
        autocorrelation=finite_or_none(smooth.value),
        bond_drift=drift.change,
        drifting_pair=drift.pair,
        sigma_xyz=None if noise is None else tuple((np.sqrt(noise.variance) * unit).tolist()),
        z_scale=finite_or_none(scale.value),
        z_scale_stderr=finite_or_none(scale.stderr),
        scan_blur=finite_or_none(blur.value),
        swaps=swaps,
        cuts=cuts,
        extra=extra,
        symmetry=point_group(motion.template, tolerance=motion.template_error)
        if elements is None
        else schoenflies(elements),
        fraction=motion.fitted.size / len(motion.time),
        warnings=(*soft, *warnings),
        notes=tuple(notes),
        scan_blur_stderr=finite_or_none(blur.stderr),
        scan_delay=finite_or_none(delay.value),
        scan_delay_stderr=finite_or_none(delay.stderr),
        misfits=misfit_rows.size,
    )


def _imaging_texts(
    scale: Slope | None, delay: Slope, blur: Slope, stated: bool
) -> tuple[list[str], list[str]]:
    """Return warnings and notes on the imaging: scale of z, sequential scan, noise along z."""
    warnings, notes = [], []
    if scale is not None:
        warnings.append(
            f"z scale: the shape changes with its orientation as if z were {scale.value:.3f} +- "
            f"{scale.stderr:.2g} times too long; check the voxel size or the refractive index"
        )
    if delay.differs_from(0.0):
        warnings.append(
            "scan: the particles of a frame are recorded one after another along z: their "
            "residuals follow the velocity of the body times their height, "
            f"{abs(delay.value):.2g} +- {delay.stderr:.2g} s/um; sigma then includes motion, and D "
            "with noise from the residuals is too low; the times of the rows (column time) or of "
            "the planes (plane_time=) remove this"
        )
    # Tested on the logarithm, whose error does not grow with the ratio.
    unequal = Slope(np.log(blur.value), blur.stderr / blur.value, np.inf).differs_from(0.0)
    if unequal and not stated:
        notes.append(
            f"localisation error: sigma_z is {blur.value:.2f} +- {blur.stderr:.2g} times sigma_xy"
        )
    elif unequal and blur.value > _RATIO_EXCESS:
        warnings.append(
            f"noise along z: sigma_z over sigma_xy is {blur.value:.2f} +- {blur.stderr:.2g} times "
            "the stated ratio; z is located worse than stated, or the particles of a frame are "
            "recorded one after another (sequential scan): then sigma includes motion, and D with "
            "noise from the residuals is too low"
        )
    return warnings, notes


def _residual_test(
    motion: RigidMotion, sample: Residuals, smooth: Slope, stated: float | None
) -> list[str]:
    """Test the size of the residuals: over the stated sigma, or over R and smooth in time."""
    usual = sample.median_sigma
    if stated is not None:
        if not usual > _LARGEST_OVER_SIGMA * stated:
            return []
        over = usual / stated if stated > 0 else np.inf
        return [
            f"not rigid: the particles leave the common shape by {usual:.3g} um a "
            f"coordinate, {over:.1f} times the stated sigma; or identities swap, "
            "or the particles of a frame are not simultaneous"
        ]
    if not usual > _LARGEST_RESIDUAL * motion.R:
        return []
    if not smooth.value - _SMOOTHEST_RESIDUAL > 3 * smooth.stderr:
        return []
    return [
        f"not rigid: residuals of {usual:.3g} um a coordinate are {usual / motion.R:.3f} of R "
        f"(over {_LARGEST_RESIDUAL}) and smooth in time (lag-1 autocorrelation "
        f"{smooth.value:.2f} +- {smooth.stderr:.2f}, over {_SMOOTHEST_RESIDUAL}); if this is the "
        "localisation error itself, state it as sigma"
    ]


def _restored_detections(motion: RigidMotion, x: Floats, found: Floats) -> Floats:
    """Assign detections that were left out to the nearest missing particles, (T, n, d).

    A detection farther than R from every missing particle does not belong to the body.
    """
    if len(found) != len(x):
        raise ValueError(f"detections: expected {len(x)} rows as in positions, got {len(found)}")
    filled, seen, expected = x.copy(), present(x), motion.positions()
    used = (found[:, :, None] == x[:, None]).all(axis=3).any(axis=2)
    spare = present(found) & ~used
    for k in np.flatnonzero(spare.any(axis=1) & ~seen.all(axis=1) & np.isfinite(expected[:, 0, 0])):
        missing, points = np.flatnonzero(~seen[k]), found[k, spare[k]]
        distance = np.linalg.norm(points[:, None] - expected[k, missing], axis=2)
        for row, nearest in zip(points, distance.argmin(axis=1), strict=True):
            particle = missing[nearest]
            off = np.linalg.norm(row - expected[k, particle])
            now = np.linalg.norm(filled[k, particle] - expected[k, particle])
            if off <= motion.R and not now <= off:
                filled[k, particle] = row
    return filled


def misplaced_detections(motion: RigidMotion, x: Floats) -> Bools:
    """Return which detections are far from their positions in the common shape.

    Parameters
    ----------
    motion : RigidMotion
    x : ndarray, shape (T, n, d)
        The positions that the motion was fitted to, um.

    Returns
    -------
    ndarray of bool, shape (T, n)

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=0.02, dt=0.7, n_frames=50, rng=1)
    >>> x = truth.positions()
    >>> x[7, 2] += 1.0
    >>> np.argwhere(misplaced_detections(truth, x))
    array([[7, 2]])
    """
    distance = np.linalg.norm(body_residuals(motion, x), axis=2)
    seen = np.isfinite(distance)
    usual = float(np.quantile(distance[seen], _USUAL_SHARE)) if seen.any() else np.inf
    # A difference of rounding is no misfit.
    limit = max(_MISPLACED_MULTIPLE * usual, 1e-9 * motion.R)
    return np.asarray(seen & (distance > limit))


def _misfit_test(misfit: Bools, count: int) -> list[str]:
    """Test the number of frames with a misplaced detection (binomial test)."""
    from scipy.stats import binom

    each, total = misfit.sum(axis=0), int(misfit.any(axis=1).sum())
    worst = int(each.argmax())
    if total > binom.isf(SIGNIFICANCE, count, _MISPLACED_FRAMES):
        return [
            f"not rigid: in {total} of {count} frames a particle is not at its place in the common "
            f"shape (at most {_MISPLACED_FRAMES:.0%} are taken for bad frames)"
        ]
    if each[worst] > binom.isf(SIGNIFICANCE / len(each), count, _MISPLACED_PARTICLE):
        return [
            f"not rigid: particle {worst} (counted from 0) is not at its place in the common shape "
            f"in {each[worst]} of {count} frames (at most {_MISPLACED_PARTICLE:.0%} are taken for "
            "bad detections)"
        ]
    return []


def _flexing_test(motion: RigidMotion, x: Floats) -> list[str]:
    """Test the particle that moves against the others more than noise of all of them explains.

    Noise that differs between particles has no memory, and noise that is smooth in time is as
    smooth for all of them. The statistic is the covariance of a particle's position in the body
    between neighbouring frames, less that of the median particle.
    """
    from scipy.stats import t

    n, d = motion.template.shape
    keeps = fit_projector(motion.template)
    vector = np.einsum("nmij,tmj->tni", keeps, body_residuals(motion, x))
    whole = np.isfinite(vector).all(axis=(1, 2))
    # Contribution of each particle's variance to the mean squares of all residuals.
    share = np.einsum("nmij,nmij->nm", keeps, keeps)
    first = (np.cumsum(whole) - 1)[:-1][whole[1:] & whole[:-1]]
    if first.size < 10 or np.linalg.cond(share) > 1e6:
        return []
    vector = vector[whole] - np.median(vector[whole], axis=0)
    # The longest vectors of every particle are shortened to the length of the next (winsorised).
    length = np.linalg.norm(vector, axis=2, keepdims=True)
    limit = np.quantile(length, 1 - _TRIMMED_SHARE, axis=0)
    vector = vector * np.minimum(1.0, limit / np.maximum(length, 1e-300))
    inverse = np.linalg.inv(share)
    product = (vector[first] * vector[first + 1]).sum(axis=2) @ inverse
    order = np.argsort(product.mean(axis=0))
    worst, middle = int(order[-1]), int(order[(n - 1) // 2])
    excess = float(np.mean(product[:, worst] - product[:, middle]))
    size = float(np.sqrt(max(d * excess, 0.0)))
    if not size > _LARGEST_FLEXING * motion.R:
        return []
    # Equal noise gives the products the covariance `inverse` times a number; the number is that of
    # the median particle, and its autocorrelation that of the other particles, as the error of
    # the worst would contain the tested motion itself.
    unit = float(np.sort(product.var(axis=0) / np.diag(inverse))[(n - 1) // 2])
    others = np.delete(vector, worst, axis=1)
    rho = autocorrelation(lagged_products(others), d * (n - 1) / 2)
    repeats = 1.0 + 2.0 * float(rho @ rho)
    contrast = inverse[worst, worst] + inverse[middle, middle] - 2 * inverse[worst, middle]
    error = float(np.sqrt(unit * contrast * repeats / first.size))
    if not excess > t.isf(SIGNIFICANCE / n, max(first.size / repeats, 1.0)) * error:
        return []
    return [
        f"not rigid: particle {worst} (counted from 0) moves against the others by {size:.3g} um "
        f"smoothly in time ({size / motion.R:.3f} of R, over {_LARGEST_FLEXING}; "
        f"{excess / error:.1f} standard errors)"
    ]


class BondDrift(NamedTuple):
    """Largest change of a pair's distance with time.

    Attributes
    ----------
    change : float
        Difference of the distances over the smaller one; 0 where none exceeds the noise.
    pair : tuple of int
        Columns of the two particles.
    distances : tuple of float
        Smallest and largest median distance, um.
    """

    change: float
    pair: tuple[int, int]
    distances: tuple[float, float]


def bond_drift(x: Floats) -> BondDrift:
    """Return the largest relative change of a pair's distance between eighths of the time.

    Medians are compared with the scatter inside the eighths, which does not contain the drift
    between them.

    Parameters
    ----------
    x : ndarray, shape (T, n, d)
        Positions, um, NaN where missing.

    Returns
    -------
    BondDrift

    Examples
    --------
    >>> x = np.zeros((80, 2, 2))
    >>> x[:, 1, 0] = np.repeat([1.0, 1.5], 40)
    >>> bond_drift(x)
    BondDrift(change=0.5, pair=(0, 1), distances=(1.0, 1.5))
    """
    worst = BondDrift(0.0, (0, 1), (0.0, 0.0))
    distances = pair_distances(x)
    blocks = np.array_split(np.arange(len(x)), min(_TIME_BLOCKS, max(1, len(x) // 5)))
    pairs = zip(*np.triu_indices(x.shape[1], 1), strict=True)
    for (i, j), distance in zip(pairs, distances.T, strict=True):
        kept = [k for k in (distance[b][np.isfinite(distance[b])] for b in blocks) if k.size]
        if len(kept) < 2:
            continue
        medians = [(_median(k), k.size) for k in kept]
        (low, n_low), (high, n_high) = min(medians), max(medians)
        # Error of a median, from the median absolute deviations inside the blocks, widened by
        # their autocorrelation.
        off = [k - median for k, (median, _) in zip(kept, medians, strict=True)]
        scatter = 1.4826 * _median(np.abs(np.concatenate(off)))
        power = sum(float(e @ e) for e in off)
        rho = sum(float(e[:-1] @ e[1:]) for e in off) / power if power > 0 else 0.0
        rho = min(max(rho, 0.0), 0.9)  # a block of a dozen values does not determine more
        noise = scatter * float(np.sqrt(np.pi / 2 * (1 + rho) / (1 - rho)))
        error = noise * np.sqrt(1 / n_low + 1 / n_high)
        change = (high - low) / low if high - low > _DRIFT_ERRORS * error and low > 0 else 0.0
        if change > worst.change:
            worst = BondDrift(float(change), (int(i), int(j)), (low, high))
    return worst


def _median(values: Floats) -> float:
    """Return the median of finite values (K,); numpy's own takes ten times as long for few."""
    ordered = np.sort(values)
    return 0.5 * float(ordered[(len(values) - 1) // 2] + ordered[len(values) // 2])
