"""Rigidity of a fitted body: tests for softness, scale of z, and recording of a frame in turn."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from perrin._arrays import (
    Bools,
    Floats,
    Ints,
    as_positions,
    as_sigma,
    count_present,
    finite_or_none,
    present,
    to_plain,
)
from perrin._display import Shown
from perrin.geometry.shapes import lengths
from perrin.motion.residuals import (
    SIGNIFICANCE,
    Slope,
    autocorrelation,
    axis_noise,
    fit_projector,
    frames_last,
    lag_one_autocorrelation,
    measure_scan,
    measure_stretch,
    median_present,
    quantile_present,
    residuals_of_each,
    sample_residuals,
)
from perrin.motion.rigid_motion import find_symmetries

if TYPE_CHECKING:
    from collections.abc import Sequence

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

# About this many coordinates are judged at once; more do not stay in the processor's cache.
_MOST_RESIDUALS = 90_000

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
        Autocorrelation of the residuals between neighbouring rows. Errors of real cameras are
        smooth in time (0.9 and more), so that a large value alone is no sign of softness.
    bond_drift : float
        Largest relative change of a pair's distance between eighths of the rows.
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
    return judge_each(
        [motion],
        [as_positions(positions)],
        sigma=sigma,
        sigma_ratio=sigma_ratio,
        corrections=[Corrections(swaps, cuts, extra)],
        detections=[None if detections is None else as_positions(detections, name="detections")],
        unsettled=[np.asarray(unsettled, dtype=np.int64)],
    )[0]


class Corrections(NamedTuple):
    """Corrections of the identity of the particles of one body (`Identity`), in rows.

    Attributes
    ----------
    swaps, cuts, extra : tuple of int
        Exchanges of labels, cuts, and detections left out.
    """

    swaps: tuple[int, ...] = ()
    cuts: tuple[int, ...] = ()
    extra: tuple[int, ...] = ()


def judge_each(
    motions: Sequence[RigidMotion],
    positions: Sequence[Floats],
    *,
    sigma: ArrayLike | None = None,
    sigma_ratio: ArrayLike | None = None,
    corrections: Sequence[Corrections] | None = None,
    detections: Sequence[Floats | None] | None = None,
    unsettled: Sequence[Ints] | None = None,
) -> list[Quality]:
    """Judge several clusters, each alone, as `judge_quality`; those of one shape together.

    Parameters
    ----------
    motions : sequence of RigidMotion
    positions : sequence of ndarray, shape (T, n, d)
        The positions that each motion was fitted to, um.
    sigma, sigma_ratio
        As in `judge_quality`.
    corrections : sequence of Corrections, optional
        Corrections of the identity of the particles of each cluster.
    detections : sequence of ndarray, shape (T, m, d), or None, optional
        The rows of each cluster before any detection was left out.
    unsettled : sequence of ndarray of int, optional
        Rows of each cluster that fit the common shape in no assignment.

    Returns
    -------
    list of Quality

    Examples
    --------
    >>> from perrin import Cluster, add_noise, simulate_motion, track_rotation
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=0.02, dt=0.7, n_frames=300, rng=1)
    >>> x = [add_noise(truth.positions(), sigma=0.03, rng=seed) for seed in (2, 3)]
    >>> [one.rigid for one in judge_each([track_rotation(one, dt=0.7) for one in x], x)]
    [True, True]
    """
    count = len(motions)
    corrections = [Corrections()] * count if corrections is None else corrections
    detections = [None] * count if detections is None else detections
    unsettled = [np.empty(0, np.int64)] * count if unsettled is None else unsettled
    find_symmetries(motions)
    alike: dict[tuple[object, ...], list[int]] = {}
    for k, (motion, x) in enumerate(zip(motions, positions, strict=True)):
        scanned = motion.turn_noise is not None
        alike.setdefault((x.shape, motion.dt, scanned), []).append(k)
    found: dict[int, Quality] = {}
    for group in alike.values():
        at_once = max(1, _MOST_RESIDUALS // positions[group[0]].size)
        for low in range(0, len(group), at_once):
            rows = group[low : low + at_once]
            judged = _judge_alike(
                [motions[k] for k in rows],
                np.moveaxis(frames_last([positions[k] for k in rows]), -1, 1),
                sigma=sigma,
                sigma_ratio=sigma_ratio,
                corrections=[corrections[k] for k in rows],
                # Of the positions themselves none was left out.
                detections=[None if detections[k] is positions[k] else detections[k] for k in rows],
                unsettled=[unsettled[k] for k in rows],
            )
            found.update(zip(rows, judged, strict=True))
    return [found[k] for k in range(count)]


def _judge_alike(
    motions: Sequence[RigidMotion],
    x: Floats,
    *,
    sigma: ArrayLike | None,
    sigma_ratio: ArrayLike | None,
    corrections: Sequence[Corrections],
    detections: Sequence[Floats | None],
    unsettled: Sequence[Ints],
) -> list[Quality]:
    """Judge bodies whose positions (B, T, n, d) have one shape; in memory the frames are last."""
    d = x.shape[3]
    stated = None if sigma is None else as_sigma(sigma, d)
    ratio = stated if sigma_ratio is None else as_sigma(sigma_ratio, d)
    stated_sigma = None if stated is None else float(np.sqrt(np.mean(stated**2)))
    residuals = residuals_of_each(motions, x)
    plain = sample_residuals(motions, x, residuals=residuals)
    stretch = measure_stretch(motions, x, plain)
    scale = stretch.scale
    stretched = (np.abs(scale.value - 1) > _SCALE_ERROR) & scale.differs_from(1.0)
    # A stretched z changes the distances of a rigid body: it is corrected before the tests.
    unit = np.ones((len(x), d))
    unit[stretched, -1] = scale.value[stretched]
    bodies = [
        s if yes else m for s, yes, m in zip(stretch.motions, stretched, motions, strict=True)
    ]
    corrected = x
    if stretched.any():
        corrected = x / unit[:, None, None]
        residuals = residuals_of_each(bodies, corrected)
    each = list(corrected)
    filled = [
        one if found is None else _restored_detections(body, one, found, own)
        for body, one, found, own in zip(bodies, each, detections, unit, strict=True)
    ]
    all_residuals = residuals
    if any(more is not one for more, one in zip(filled, each, strict=True)):
        all_residuals = residuals_of_each(bodies, np.stack(filled))
    radius = np.array([body.R for body in bodies])
    misfit = misplaced_detections(all_residuals, radius)
    for own, rows in zip(misfit, unsettled, strict=True):
        own[rows] = True
    misfit_frames, misplaced = np.asarray(misfit.any(axis=2)), misfit.sum(axis=1)
    misfits = misfit_frames.sum(axis=1).tolist()
    smooth = lag_one_autocorrelation(residuals)
    drifts = bond_drifts(corrected)
    noise = axis_noise(stretch.sample)
    per_unit = unit / ratio if ratio is not None and (ratio > 0).all() else unit
    blur, noise_known = Slope.unknown((len(x),)), noise.known
    if d == 3:
        with np.errstate(divide="ignore", invalid="ignore"):
            blur = noise.z_ratio(per_unit).where(noise_known, blur)
    # Positions of particles with their own times were moved to one instant.
    delay = Slope.unknown((len(x),))
    if motions[0].turn_noise is None:
        delay = measure_scan(stretch.sample)
    usual = plain.median_sigma
    if stretched.any():
        usual = np.where(stretched, stretch.sample.median_sigma, usual)
    keeps = plain.keeps
    if stretched.any():
        keeps = fit_projector(np.stack([body.template for body in bodies]))
    flexing = _flexing_tests(bodies, all_residuals, keeps)
    imaging = _imaging_texts(scale, stretched, delay, blur, ratio is not None)
    judged = []
    for k, (motion, body) in enumerate(zip(motions, bodies, strict=True)):
        soft = [
            *_residual_test(body, float(usual[k]), smooth.of_body(k), stated_sigma),
            *flexing[k],
            *_shape_tests(misplaced[k], misfits[k], body.fitted.size, drifts[k]),
        ]
        warnings, notes = imaging[k]
        if misfits[k] and not soft:
            notes.insert(
                0,
                f"{misfits[k]} of {body.fitted.size} frames fit the common shape badly "
                f"(first at {body.time[misfit_frames[k].argmax()]:g} s): a particle is over "
                f"{_MISPLACED_MULTIPLE:g} times as far from its place as {_USUAL_SHARE:.0%} of all "
                "detections are",
            )
        error = np.sqrt(noise.variance[k]) * unit[k] if noise_known[k] else None
        over = finite_or_none(motion.sigma / stated_sigma) if stated_sigma else None
        judged.append(
            Quality(
                rigid=not soft,
                reasons=tuple(soft),
                residual_over_R=motion.sigma / motion.R,
                residual_over_sigma=over,
                autocorrelation=finite_or_none(smooth.value[k]),
                bond_drift=drifts[k].change,
                drifting_pair=drifts[k].pair,
                sigma_xyz=None if error is None else tuple(error.tolist()),
                z_scale=finite_or_none(scale.value[k]),
                z_scale_stderr=finite_or_none(scale.stderr[k]),
                scan_blur=finite_or_none(blur.value[k]),
                swaps=corrections[k].swaps,
                cuts=corrections[k].cuts,
                extra=corrections[k].extra,
                symmetry=motion.point_group,
                fraction=motion.fitted.size / len(motion.time),
                warnings=(*soft, *warnings),
                notes=tuple(notes),
                scan_blur_stderr=finite_or_none(blur.stderr[k]),
                scan_delay=finite_or_none(delay.value[k]),
                scan_delay_stderr=finite_or_none(delay.stderr[k]),
                misfits=misfits[k],
            )
        )
    return judged


def _imaging_texts(
    scale: Slope, stretched: Bools, delay: Slope, blur: Slope, stated: bool
) -> list[tuple[list[str], list[str]]]:
    """Return warnings and notes on the imaging: scale of z, sequential scan, noise along z."""
    late = delay.differs_from(0.0)
    # Tested on the logarithm, whose error does not grow with the ratio.
    with np.errstate(divide="ignore", invalid="ignore"):
        logarithm = Slope(np.log(blur.value), blur.stderr / blur.value, blur.freedom)
    unequal = logarithm.differs_from(0.0)
    texts = []
    for k in range(len(stretched)):
        warnings, notes = [], []
        if stretched[k]:
            warnings.append(
                "z scale: the shape changes with its orientation as if z were "
                f"{scale.value[k]:.3f} +- {scale.stderr[k]:.2g} times too long; check the voxel "
                "size or the refractive index"
            )
        if late[k]:
            warnings.append(
                "scan: the particles of a frame are recorded one after another along z: their "
                "residuals follow the velocity of the body times their height, "
                f"{abs(delay.value[k]):.2g} +- {delay.stderr[k]:.2g} s/um; sigma then includes "
                "motion, and D with noise from the residuals is too low; the times of the rows "
                "(column time) or of the planes (plane_time=) remove this"
            )
        if unequal[k] and not stated:
            notes.append(
                f"localisation error: sigma_z is {blur.value[k]:.2f} +- {blur.stderr[k]:.2g} times "
                "sigma_xy"
            )
        elif unequal[k] and blur.value[k] > _RATIO_EXCESS:
            warnings.append(
                f"noise along z: sigma_z over sigma_xy is {blur.value[k]:.2f} +- "
                f"{blur.stderr[k]:.2g} times the stated ratio; z is located worse than stated, or "
                "the particles of a frame are recorded one after another (sequential scan): then "
                "sigma includes motion, and D with noise from the residuals is too low"
            )
        texts.append((warnings, notes))
    return texts


def _residual_test(
    motion: RigidMotion, usual: float, smooth: Slope, stated: float | None
) -> list[str]:
    """Test the size of the residuals: over the stated sigma, or over R and smooth in time."""
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


def _restored_detections(motion: RigidMotion, x: Floats, found: Floats, unit: Floats) -> Floats:
    """Assign detections that were left out to the nearest missing particles, (T, n, d).

    A detection farther than R from every missing particle does not belong to the body. `unit` is
    the scale of each axis that the positions were already divided by.
    """
    if len(found) != len(x):
        raise ValueError(f"detections: expected {len(x)} rows as in positions, got {len(found)}")
    seen, detected = present(x), present(found)
    # As many positions as detections: none was left out.
    if (seen.sum(axis=1) == detected.sum(axis=1)).all():
        return x
    found = found / unit
    filled, expected = x.copy(), motion.positions()
    used = (found[:, :, None] == x[:, None]).all(axis=3).any(axis=2)
    spare = detected & ~used
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


def misplaced_detections(residuals: Floats, radius: Floats) -> Bools:
    """Return which detections are far from their positions in the common shape.

    Parameters
    ----------
    residuals : ndarray, shape (B, T, n, d)
        Measured minus fitted positions of B bodies, um.
    radius : ndarray, shape (B,)
        Mean distance of the particles of each body to its centre, um.

    Returns
    -------
    ndarray of bool, shape (B, T, n)

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=0.02, dt=0.7, n_frames=50, rng=1)
    >>> x = truth.positions()
    >>> x[7, 2] += 1.0
    >>> np.argwhere(misplaced_detections(residuals_of_each([truth], x[None]), np.array([1.5])))
    array([[0, 7, 2]])
    """
    distance = lengths(residuals)
    seen = np.isfinite(distance)
    # The order of the frames does not matter; they may be last in memory.
    every = np.swapaxes(distance, 1, 2).reshape(len(distance), -1)
    usual = quantile_present(every, _USUAL_SHARE)
    # A difference of rounding is no misfit.
    limit = np.maximum(_MISPLACED_MULTIPLE * np.nan_to_num(usual, nan=np.inf), 1e-9 * radius)
    return np.asarray(seen & (distance > limit[:, None, None]))


def _shape_tests(each: Ints, total: int, count: int, drift: BondDrift) -> list[str]:
    """Test the frames with a misplaced detection (binomial test), and the drift of distances.

    `each` has the number of misplaced detections of every particle, in `total` of `count` frames.
    """
    from scipy.special import bdtrc

    texts = []
    worst = int(each.argmax()) if total else 0
    chance = SIGNIFICANCE / len(each)
    if total and bdtrc(total - 1, count, _MISPLACED_FRAMES) <= SIGNIFICANCE:
        texts.append(
            f"not rigid: in {total} of {count} frames a particle is not at its place in the common "
            f"shape (at most {_MISPLACED_FRAMES:.0%} are taken for bad frames)"
        )
    elif total and bdtrc(each[worst] - 1, count, _MISPLACED_PARTICLE) <= chance:
        texts.append(
            f"not rigid: particle {worst} (counted from 0) is not at its place in the common shape "
            f"in {each[worst]} of {count} frames (at most {_MISPLACED_PARTICLE:.0%} are taken for "
            "bad detections)"
        )
    if drift.change > _LARGEST_DRIFT:
        texts.append(
            f"not rigid: the distance of particles {drift.pair[0]} and {drift.pair[1]} (counted "
            f"from 0) changes in time between {drift.distances[0]:.3g} and "
            f"{drift.distances[1]:.3g} um; a bond breaks, or a label moves to another particle"
        )
    return texts


def _flexing_tests(
    motions: Sequence[RigidMotion], residuals: Floats, keeps: Floats
) -> list[list[str]]:
    """Test the particle that moves against the others more than noise of all of them explains.

    Noise that differs between particles has no memory, and noise that is smooth in time is as
    smooth for all of them. The statistic is the covariance of a particle's position in the body
    between neighbouring frames, less that of the median particle.
    """
    from scipy.special import stdtrit

    bodies, frames, n, d = residuals.shape
    # Contribution of each particle's variance to the mean squares of all residuals.
    share = np.einsum("bnmij,bnmij->bnm", keeps, keeps)
    singular = np.linalg.svd(share, compute_uv=False)
    whole = count_present(present(residuals)) == n
    following = whole[:, 1:] & whole[:, :-1]
    pairs = following.sum(axis=1)
    tested = np.flatnonzero((pairs >= 10) & ~(singular[:, 0] > 1e6 * singular[:, -1]))
    texts: list[list[str]] = [[] for _ in range(bodies)]
    if not tested.size:
        return texts
    rows, linked = np.moveaxis(residuals, 1, -1)[tested], following[tested]
    count, pairs = whole[tested].sum(axis=1), pairs[tested]
    complete = np.arange(frames) < count[:, None]
    if not complete.all():
        # Complete frames first, each with the number of the frame after it.
        order = np.argsort(~whole[tested], axis=1, kind="stable")
        linked = np.take_along_axis(np.pad(linked, ((0, 0), (0, 1))), order, axis=1)[:, :-1]
        rows = np.take_along_axis(rows, order[:, None, None], axis=-1)
        rows = np.where(complete[:, None, None], rows, np.nan)
    matrix = keeps[tested].transpose(0, 1, 3, 2, 4).reshape(len(tested), n * d, n * d)
    vector = (matrix @ rows.reshape(len(tested), n * d, frames)).reshape(rows.shape)
    vector -= median_present(vector)[..., None]
    # The longest vectors of every particle are shortened to the length of the next (winsorised).
    length = np.sqrt(np.einsum("bnik,bnik->bnk", vector, vector))
    limit = quantile_present(length, 1 - _TRIMMED_SHARE)
    vector *= np.minimum(1.0, limit[..., None] / np.maximum(length, 1e-300))[:, :, None]
    if not complete.all():
        vector = np.where(complete[:, None, None], vector, 0.0)
    inverse = np.linalg.inv(share[tested])
    product = inverse @ np.einsum("bnik,bnik->bnk", vector[..., :-1], vector[..., 1:])
    if not linked.all():
        product = np.where(linked[:, None], product, 0.0)
    mean = product.sum(axis=2) / pairs[:, None]
    ranks = np.argsort(mean, axis=1)
    worst, usual = ranks[:, -1], ranks[:, (n - 1) // 2]
    number = np.arange(len(tested))
    excess = mean[number, worst] - mean[number, usual]
    size = np.sqrt(np.maximum(d * excess, 0.0))
    radius = np.array([motions[k].R for k in tested.tolist()])
    for i in np.flatnonzero(size > _LARGEST_FLEXING * radius).tolist():
        # Equal noise gives the products the covariance `inverse` times a number; the number is that
        # of the median particle, and its autocorrelation that of the other particles, as the error
        # of the worst would contain the tested motion itself.
        w, m, own = worst[i], usual[i], inverse[i]
        variance = product[i][:, linked[i]].var(axis=1) / np.diag(own)
        unit = float(np.sort(variance)[(n - 1) // 2])
        others = np.delete(vector[i : i + 1], w, axis=1)
        rho = autocorrelation(others, count[i : i + 1], d * (n - 1) / 2)[0]
        repeats = 1.0 + 2.0 * float(rho @ rho)
        contrast = own[w, w] + own[m, m] - 2 * own[w, m]
        error = float(np.sqrt(unit * contrast * repeats / pairs[i]))
        quantile = -stdtrit(max(pairs[i] / repeats, 1.0), SIGNIFICANCE / n)
        if excess[i] > quantile * error:
            texts[tested[i]].append(
                f"not rigid: particle {w} (counted from 0) moves against the others by "
                f"{size[i]:.3g} um smoothly in time ({size[i] / radius[i]:.3f} of R, over "
                f"{_LARGEST_FLEXING}; {excess[i] / error:.1f} standard errors)"
            )
    return texts


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


def bond_drifts(x: Floats) -> list[BondDrift]:
    """Return the largest relative change of a pair's distance between eighths of the time.

    Medians are compared with the scatter inside the eighths, which does not contain the drift
    between them.

    Parameters
    ----------
    x : ndarray, shape (B, T, n, d)
        Positions of B bodies, um, NaN where missing.

    Returns
    -------
    list of BondDrift

    Examples
    --------
    >>> x = np.zeros((1, 80, 2, 2))
    >>> x[0, :, 1, 0] = np.repeat([1.0, 1.5], 40)
    >>> bond_drifts(x)
    [BondDrift(change=0.5, pair=(0, 1), distances=(1.0, 1.5))]
    """
    bodies, frames, n, _ = x.shape
    first, second = np.triu_indices(n, 1)
    along = np.ascontiguousarray(np.moveaxis(x, 1, -1))  # (B, n, d, T)
    off = along[:, first] - along[:, second]
    distances = np.sqrt(np.einsum("bpit,bpit->bpt", off, off))
    blocks = np.array_split(np.arange(frames), min(_TIME_BLOCKS, max(1, frames // 5)))
    width = max(len(rows) for rows in blocks)
    # The values of every block without the missing ones, those to the right.
    values = np.full((*distances.shape[:2], len(blocks), width), np.nan)
    for k, rows in enumerate(blocks):
        values[..., k, : len(rows)] = distances[..., rows]
    if not np.isfinite(distances).all():
        order = np.argsort(~np.isfinite(values), axis=-1, kind="stable")
        values = np.take_along_axis(values, order, axis=-1)
    here = np.isfinite(values)
    count = here.sum(axis=-1)
    medians = median_present(values)
    known = count > 0
    off = values - medians[..., None]
    # Error of a median, from the median absolute deviations inside the blocks, widened by their
    # autocorrelation.
    scatter = 1.4826 * median_present(np.abs(off).reshape(*off.shape[:2], -1))
    off = np.where(here, off, 0.0)
    power = (off * off).sum(axis=(2, 3))
    together = (off[..., 1:] * off[..., :-1]).sum(axis=(2, 3))
    rho = np.divide(together, power, out=np.zeros_like(power), where=power > 0)
    rho = np.clip(rho, 0.0, 0.9)  # a block of a dozen values does not determine more
    noise = scatter * np.sqrt(np.pi / 2 * (1 + rho) / (1 - rho))
    ends = [
        np.argmin(np.where(known, medians, np.inf), axis=-1)[..., None],
        np.argmax(np.where(known, medians, -np.inf), axis=-1)[..., None],
    ]
    (low, high), (n_low, n_high) = (
        [np.take_along_axis(a, k, axis=-1)[..., 0] for k in ends] for a in (medians, count)
    )
    several = (known.sum(axis=-1) >= 2) & (low > 0)
    error = noise * np.sqrt(1 / np.maximum(n_low, 1) + 1 / np.maximum(n_high, 1))
    changed = several & (high - low > _DRIFT_ERRORS * error)
    change = np.divide(high - low, low, out=np.zeros_like(low), where=changed)
    found = []
    for k, worst in enumerate(change.argmax(axis=1).tolist() if n > 1 else [0] * bodies):
        if n < 2 or not change[k, worst] > 0:
            found.append(BondDrift(0.0, (0, 1), (0.0, 0.0)))
            continue
        pair = int(first[worst]), int(second[worst])
        ends_um = float(low[k, worst]), float(high[k, worst])
        found.append(BondDrift(float(change[k, worst]), pair, ends_um))
    return found
