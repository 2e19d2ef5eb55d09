"""Positions of the spheres of a crowd: touching spheres whose images are fitted all together.

Axes of arrays and centres are (z, y, x), um, with the origin at the centre of voxel (0, 0, 0).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from perrin.images.optics.crowd_equations import (
    CrowdIntensity,
    CrowdWindow,
    brightness_parameters,
    crowd_intensity,
    cut_crowd_window,
    detection_chi2,
    fit_brightness,
    normal_equations,
    residual_maps,
    sphere_chi2,
    standard_errors,
    visible_fraction,
)
from perrin.images.optics.window_fit import within

if TYPE_CHECKING:
    from perrin._arrays import Bools, Floats, Ints
    from perrin.images.optics.ball_image import SphereImage
    from perrin.images.optics.optics import CameraNoise


# Rounds of the last search, and between two searches of the residuals for missing spheres.
_MAX_CROWD_ROUNDS, _INTERIM_ROUNDS = 40, 8

# Step of a sphere over the blur at which the last search ends, as for smaller groups, and the
# interim ones.
_CROWD_STEP_CONVERGED, _INTERIM_STEP = 1e-4, 1e-2

# Least visible fraction of a sphere that is added, and of one that is kept.
_ADDED_VISIBLE, _KEPT_VISIBLE = 0.05, 0.01

# Relative standard deviation of brightness in the prior.
_BRIGHTNESS_SPREAD = 0.3

# The brightness of a sphere is within this factor of the median.
_BRIGHTNESS_FACTOR = 4.0

# Least distance of two spheres, in contact distances.
_MIN_DISTANCE = 0.7

# No sphere is added within this fraction of the least distance from a position given up before.
_RETRY_FRACTION = 0.3

# Least decrease of chi-squared by a sphere: five standard errors of its brightness.
_MIN_DETECTION_CHI2 = 25.0

# Least decrease of chi-squared by an added sphere, as a fraction of that by a wholly visible one:
# more than flaws of the model.
_MIN_DETECTION_FRACTION = 0.005


class CrowdFit(NamedTuple):
    """The fitted spheres of a crowd.

    Attributes
    ----------
    centers, sigma : ndarray, shape (n, 3)
        Positions (z, y, x), um, and their standard errors: from the Fisher information, times the
        root of the median `chi2` where this is above 1.
    chi2 : ndarray, shape (n,)
        Chi-squared per voxel, averaged over the voxels of each sphere.
    converged : ndarray of bool, shape (n,)
        Whether the last step of each sphere was far below the blur.
    origin : ndarray of int, shape (n,)
        Index of each sphere among those at the start; -1 where it was found in the residuals.
    window : CrowdWindow
        The voxels that were fitted.
    intensity : CrowdIntensity
        The fit, with the spheres beyond the border of the frame.
    """

    centers: Floats
    sigma: Floats
    chi2: Floats
    converged: Bools
    origin: Ints
    window: CrowdWindow
    intensity: CrowdIntensity


def fit_crowd(
    frame: Floats,
    centers: Floats,
    *,
    others: Floats,
    contact: float,
    image: SphereImage,
    noise: CameraNoise,
    searches: int = 8,
) -> CrowdFit:
    """Fit all spheres of a crowd together, and add those that are missing at the start.

    Parameters
    ----------
    frame : ndarray, shape (nz, ny, nx)
        Grey levels.
    centers, others : ndarray, shape (n, 3), (m, 3)
        Positions of the crowd at the start, and of spheres whose voxels are not used, um.
    contact : float
        Centre distance of touching spheres, um.
    image : SphereImage
        The image of a sphere.
    noise : CameraNoise
        The variance of a voxel.
    searches : int
        Largest number of searches of the residuals.

    Returns
    -------
    CrowdFit

    Notes
    -----
    Fisher scoring as in `fit_window`, with sparse normal equations. Between rounds, spheres much
    dimmer or brighter than the median and the dimmer one of two at the same position are removed,
    and spheres are added where one more of them decreases chi-squared most. Spheres may lie beyond
    the border of the frame if their images reach into it; they are not among the positions
    returned.

    Examples
    --------
    >>> from perrin.images import CameraNoise, sphere_image
    >>> image = sphere_image(diameter=2.0, psf=(0.4, 0.15), voxel=(0.25, 0.2, 0.2))
    >>> truth = np.array([[3.0, 3.0, 2.5], [3.0, 3.0, 4.5]])
    >>> frame = np.full((24, 31, 36), 9.0)
    >>> for spot in (image.spot(center, frame.shape) for center in truth):
    ...     frame[spot.box] += 100 * spot.value
    >>> noise, others = CameraNoise(1.0, 0.0), np.empty((0, 3))
    >>> crowd = fit_crowd(
    ...     frame, truth[:1] + 0.1, others=others, contact=2.0, image=image, noise=noise
    ... )
    >>> crowd.centers.round(3).tolist(), crowd.origin.tolist()
    ([[3.0, 3.0, 2.5], [3.0, 3.0, 4.5]], [0, -1])
    """
    window = cut_crowd_window(frame, image, noise, centers, others)
    state, start = fit_brightness(window, centers), centers
    origin, given_up = np.arange(len(centers)), np.empty((0, 3))
    for _ in range(searches):
        state, _ = _scored(window, state, _INTERIM_ROUNDS, _INTERIM_STEP)
        keep = plausible_spheres(window, state, contact)
        given_up = np.concatenate([given_up, start[~keep]])
        if not keep.any():
            break
        new = missing_spheres(window, state, keep, contact, given_up)
        if keep.all() and not len(new):
            break
        state = crowd_intensity(
            window,
            np.concatenate([state.centers[keep], new]),
            np.append(state.brightness[keep], np.full(len(new), _median_brightness(state))),
            state.background,
        )
        start = np.concatenate([start[keep], new])
        origin = np.append(origin[keep], np.full(len(new), -1))
    state, converged = _scored(window, state, _MAX_CROWD_ROUNDS, _CROWD_STEP_CONVERGED)
    information, _ = normal_equations(window, state)
    voxel = np.array(image.voxel)
    end = (np.array(frame.shape) - 0.5) * voxel
    inside = np.all((state.centers >= -voxel / 2) & (state.centers <= end), axis=1)
    inside &= plausible_spheres(window, state, contact)
    chi2 = sphere_chi2(window, state)
    finite = chi2[np.isfinite(chi2)]
    excess = max(float(np.median(finite)), 1.0) if finite.size else 1.0
    sigma = standard_errors(information, state) * np.sqrt(excess)
    return CrowdFit(
        state.centers[inside],
        sigma[inside],
        chi2[inside],
        converged[inside],
        origin[inside],
        window,
        state,
    )


def _scored(
    window: CrowdWindow, state: CrowdIntensity, rounds: int, tolerance: float
) -> tuple[CrowdIntensity, Bools]:
    """Return the state after some rounds of Fisher scoring, and which spheres have converged.

    The search ends when all spheres within the window move by less than `tolerance` blurs; spheres
    beyond its border, of which little is visible, may move by more.
    """
    from scipy.sparse import diags_array
    from scipy.sparse.linalg import splu

    damping, step = 1e-3, np.full(len(state.centers), np.inf)
    median = _median_brightness(state)
    information, score = _with_prior(window, state, median)
    for _ in range(rounds):
        scale = information.diagonal()
        # A parameter without information keeps its value.
        ridge = np.where(scale > 0, (damping + 1e-12) * scale, 1.0)
        trial = state.moved(window, splu((information + diags_array(ridge)).tocsc()).solve(score))
        if _penalised_chi2(window, state, trial, median) > _penalised_chi2(
            window, state, state, median
        ) * (1 + 1e-12):
            damping *= 10.0
            continue
        step = np.abs(trial.centers - state.centers).max(axis=1)
        state, damping = trial, damping / 10.0
        if np.all(step[window.holds(state.centers)] < tolerance * window.image.blur[1]):
            break
        information, score = _with_prior(window, state, median)
    return state, step < tolerance * window.image.blur[1]


def _with_prior(window: CrowdWindow, state: CrowdIntensity, median: float) -> tuple[Any, Floats]:
    """Return the normal equations with a Gaussian prior of brightness about the median.

    Where a border leaves little of a sphere visible, its brightness and its position cannot be
    distinguished; for all other spheres the information of the image is some hundred times that of
    the prior.
    """
    from scipy.sparse import diags_array

    information, score = normal_equations(window, state)
    prior = np.zeros_like(score)
    prior[brightness_parameters(state)] = (_BRIGHTNESS_SPREAD * median) ** -2
    score[brightness_parameters(state)] += (median - state.brightness) / (
        _BRIGHTNESS_SPREAD * median
    ) ** 2
    return information + diags_array(prior), score


def _penalised_chi2(
    window: CrowdWindow, state: CrowdIntensity, trial: CrowdIntensity, median: float
) -> float:
    """Return chi-squared of a trial with the weights of a state, and the prior of brightness."""
    deviation = (trial.brightness - median) / (_BRIGHTNESS_SPREAD * median)
    return state.chi2(window, trial.expected) + float(np.sum(deviation**2))


def _median_brightness(state: CrowdIntensity) -> float:
    """Return the median brightness, which is negative for dark spheres."""
    # In an image without any intensity any value serves: no sphere is found there.
    return float(np.median(state.brightness)) or 1.0


def plausible_spheres(window: CrowdWindow, state: CrowdIntensity, contact: float) -> Bools:
    """Return which spheres (n,) are kept: of usual brightness, visible, and not two at one place.

    Parameters
    ----------
    window : CrowdWindow
    state : CrowdIntensity
    contact : float
        Centre distance of touching spheres, um.

    Returns
    -------
    ndarray of bool, shape (n,)
    """
    from scipy.spatial import cKDTree

    relative = state.brightness / _median_brightness(state)
    keep = (relative > 1 / _BRIGHTNESS_FACTOR) & (relative < _BRIGHTNESS_FACTOR)
    keep &= visible_fraction(window, state) > _KEPT_VISIBLE
    keep &= detection_chi2(state) > _MIN_DETECTION_CHI2
    pairs = cKDTree(state.centers).query_pairs(_MIN_DISTANCE * contact, output_type="ndarray")
    for i, j in pairs:
        if keep[i] and keep[j]:
            keep[i if relative[i] < relative[j] else j] = False
    return np.asarray(keep)


def missing_spheres(
    window: CrowdWindow, state: CrowdIntensity, keep: Bools, contact: float, given_up: Floats
) -> Floats:
    """Return positions (k, 3) where one more sphere is detected in the residuals, best first.

    Parameters
    ----------
    window : CrowdWindow
    state : CrowdIntensity
    keep : ndarray of bool, shape (n,)
        The spheres of the state that are kept; none is added too close to them.
    contact : float
        Centre distance of touching spheres, um.
    given_up : ndarray, shape (m, 3)
        Starting positions that were removed before; none is added at them, um.

    Returns
    -------
    ndarray, shape (k, 3)
    """
    from scipy.ndimage import maximum_filter

    brightness, gain, corner, known = residual_maps(window, state, _ADDED_VISIBLE)
    whole = known * _median_brightness(state) ** 2
    grid = [
        c + h * np.arange(n) for c, h, n in zip(corner, window.image.voxel, gain.shape, strict=True)
    ]
    distance = np.full(3, _MIN_DISTANCE * contact)
    closed = within(grid, state.centers[keep], distance)
    closed |= within(grid, given_up, distance * _RETRY_FRACTION)
    # A residual of the wrong sign is no sphere, and a position already occupied needs no second.
    relative = np.where(closed, 0.0, brightness / _median_brightness(state))
    gain = np.where(
        (relative > 1 / _BRIGHTNESS_FACTOR) & (relative < _BRIGHTNESS_FACTOR), gain, 0.0
    )
    size = np.maximum(distance / window.image.voxel, 3).astype(int)
    least = max(_MIN_DETECTION_CHI2, _MIN_DETECTION_FRACTION * whole)
    index = np.argwhere((gain > least) & (gain == maximum_filter(gain, tuple(size))))
    best = index[np.argsort(-gain[tuple(index.T)])]
    added: list[Floats] = []
    for position in corner + best * window.image.voxel:
        if all(np.linalg.norm(position - other) > _MIN_DISTANCE * contact for other in added):
            added.append(position)
    return np.array(added).reshape(-1, 3)


def crowd_piece(
    frame: Floats, centers: Floats, voxel: tuple[float, float, float], *, count: int
) -> tuple[Floats, Floats]:
    """Return a box in the middle of a crowd, and the spheres of the crowd in it.

    Parameters
    ----------
    frame : ndarray, shape (nz, ny, nx)
        Grey levels.
    centers : ndarray, shape (n, 3)
        Positions of the crowd, um.
    voxel : tuple of float
        Voxel size (z, y, x), um.
    count : int
        Number of spheres around which the box is drawn; all spheres of the crowd in it are
        returned.

    Returns
    -------
    piece : ndarray
        The voxels of the box.
    centers : ndarray, shape (k, 3)
        Positions in the box, um.

    Examples
    --------
    >>> row = np.stack([np.full(9, 2.0), np.full(9, 2.0), np.arange(9.0)], axis=1)
    >>> piece, centers = crowd_piece(np.zeros((5, 5, 9)), row, (1.0, 1.0, 1.0), count=3)
    >>> piece.shape, centers[:, 2]
    ((1, 1, 3), array([0., 1., 2.]))
    """
    step = np.array(voxel)
    distance = np.linalg.norm(centers - np.median(centers, axis=0), axis=1)
    middle = centers[np.argsort(distance, kind="stable")[:count]]
    if count >= len(centers):
        return frame, centers
    low = np.floor(middle.min(axis=0) / step).astype(int)
    high = np.ceil(middle.max(axis=0) / step).astype(int) + 1
    inside = np.all((centers >= low * step) & (centers <= (high - 1) * step), axis=1)
    box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    return frame[box], centers[inside] - low * step
