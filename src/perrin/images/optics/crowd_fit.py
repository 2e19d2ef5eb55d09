"""Where the spheres of a crowd are: of so many touching ones that each needs all the others' light.

Arrays' axes and centres are (z, y, x), um, the origin at the centre of voxel (0, 0, 0).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from perrin.images.optics.crowd_equations import (
    Light,
    Scene,
    brightness_numbers,
    cut_scene,
    first_light,
    in_sight,
    left_over,
    normal_equations,
    own_misfit,
    shine,
    standard_errors,
    told_by,
)
from perrin.images.optics.window_fit import within

if TYPE_CHECKING:
    from perrin._arrays import Bools, Floats, Ints
    from perrin.images.optics.ball_image import SphereImage
    from perrin.images.optics.optics import CameraNoise


_ROUNDS = 40


_GLANCE = 8  # rounds between two looks at what is left over


_CONVERGED = 1e-4  # last step of a sphere over the blur, as for smaller groups


_NEARLY = 1e-2  # ... between two looks


_NEW_SIGHT, _OLD_SIGHT = 0.05, 0.01  # part of a sphere that has to be in sight


_ALIKE = 0.3  # relative spread of brightness


_FACTOR = 4.0  # a sphere is within this factor as bright as the usual one


_APART = 0.7  # two spheres are at least so many contact distances apart


_AGAIN = 0.3  # ... and by this part of that from where one was tried before and given up


_SEEN = 25.0  # a sphere lowers chi-squared by this, five standard errors of its brightness


_SHARE = (
    0.005  # ... and by this part of what one wholly in sight does: more than flaws of the model
)


class CrowdFit(NamedTuple):
    """The spheres of a crowd.

    Attributes
    ----------
    centers, sigma : ndarray, shape (n, 3)
        (z, y, x), um, and standard errors from the Fisher information.
    chi2 : ndarray, shape (n,)
        Per voxel, of the voxels that a sphere lights.
    settled : ndarray of bool, shape (n,)
        The last step was far below the blur.
    origin : ndarray of int, shape (n,)
        Which of the spheres at the start it is; -1: found in the light left over.
    scene, light
        What was fitted, and the fit.
    """

    centers: Floats
    sigma: Floats
    chi2: Floats
    settled: Bools
    origin: Ints
    scene: Scene
    light: Light


def fit_crowd(
    frame: Floats,
    centers: Floats,
    *,
    others: Floats,
    contact: float,
    image: SphereImage,
    noise: CameraNoise,
    looks: int = 8,
) -> CrowdFit:
    """Find all spheres of a crowd together, those that were missed too.

    Parameters
    ----------
    frame : ndarray, shape (nz, ny, nx)
    centers, others : ndarray, shape (n, 3), (m, 3)
        Where the crowd was found, and spheres whose light is left out.
    contact : float
        Centre distance of touching spheres, um.
    image : SphereImage
    noise : CameraNoise
    looks : int
        At what is left over, at most.

    Notes
    -----
    Fisher scoring as in `image_fit.fit_window`, its normal equations sparse. Between rounds,
    spheres much dimmer or brighter than the usual one and the dimmer of two at one place go, and
    spheres are put where one more of them takes most of chi-squared away. Spheres may stand beyond
    the frame's border, where their light comes from; they are not among the places returned.
    """
    scene = cut_scene(frame, image, noise, centers, others)
    light, start = first_light(scene, centers), centers
    origin, given_up = np.arange(len(centers)), np.empty((0, 3))
    for _ in range(looks):
        light, _ = _settle(scene, light, _GLANCE, _NEARLY)
        keep = _present(scene, light, contact)
        given_up = np.concatenate([given_up, start[~keep]])
        if not keep.any():
            break
        new = _missed(scene, light, keep, contact, given_up)
        if keep.all() and not len(new):
            break
        light = _changed(scene, light, keep, new)
        start = np.concatenate([start[keep], new])
        origin = np.append(origin[keep], np.full(len(new), -1))
    light, settled = _settle(scene, light, _ROUNDS, _CONVERGED)
    return _inside(frame.shape, scene, light, contact, settled, origin)


def _settle(scene: Scene, light: Light, rounds: int, part: float) -> tuple[Light, Bools]:
    """Return the light after some rounds of the search, and which spheres came to rest.

    The search ends when all spheres within the scene move by less than a `part` of the blur: one
    beyond its border, of which little is seen, may go on wandering.
    """
    from scipy.sparse import diags_array
    from scipy.sparse.linalg import splu

    damping, step = 1e-3, np.full(len(light.centers), np.inf)
    usual = _usual(light)
    information, score = _informed(scene, light, usual)
    for _ in range(rounds):
        scale = information.diagonal()
        # A number that no voxel tells of stays as it is.
        ridge = np.where(scale > 0, (damping + 1e-12) * scale, 1.0)
        trial = light.moved(scene, splu((information + diags_array(ridge)).tocsc()).solve(score))
        if _cost(scene, light, trial, usual) > _cost(scene, light, light, usual) * (1 + 1e-12):
            damping *= 10.0
            continue
        step = np.abs(trial.centers - light.centers).max(axis=1)
        light, damping = trial, damping / 10.0
        if np.all(step[scene.holds(light.centers)] < part * scene.image.blur[1]):
            break
        information, score = _informed(scene, light, usual)
    return light, step < part * scene.image.blur[1]


def _informed(scene: Scene, light: Light, usual: float) -> tuple[Any, Floats]:
    """Return the normal equations, in which every sphere is somewhat as bright as the usual one.

    Where a border leaves little of a sphere in sight, its brightness and its place cannot be told
    from each other; of all others the image itself tells some hundred times more.
    """
    from scipy.sparse import diags_array

    information, score = normal_equations(scene, light)
    told = np.zeros_like(score)
    told[brightness_numbers(light)] = (_ALIKE * usual) ** -2
    score[brightness_numbers(light)] += (usual - light.brightness) / (_ALIKE * usual) ** 2
    return information + diags_array(told), score


def _cost(scene: Scene, now: Light, then: Light, usual: float) -> float:
    """Return the misfit by the weights of now, with what is known of brightness."""
    unlike = (then.brightness - usual) / (_ALIKE * usual)
    return now.misfit(scene, then.expected) + float(np.sum(unlike**2))


def _usual(light: Light) -> float:
    """Return the usual brightness, which is negative for dark spheres."""
    # Of an image without any light any will do: nothing is found there.
    return float(np.median(light.brightness)) or 1.0


def _present(scene: Scene, light: Light, contact: float) -> Bools:
    """Return which spheres are there: as bright as usual, in sight, each by itself."""
    relative = light.brightness / _usual(light)
    keep = (relative > 1 / _FACTOR) & (relative < _FACTOR) & (in_sight(scene, light) > _OLD_SIGHT)
    keep &= told_by(light) > _SEEN
    for i, j in _overlapping(light.centers, _APART * contact):
        if keep[i] and keep[j]:
            keep[i if relative[i] < relative[j] else j] = False
    return np.asarray(keep)


def _overlapping(centers: Floats, reach: float) -> Ints:
    from scipy.spatial import cKDTree

    return np.asarray(cKDTree(centers).query_pairs(reach, output_type="ndarray"), dtype=np.int64)


def _missed(scene: Scene, light: Light, keep: Bools, contact: float, given_up: Floats) -> Floats:
    """Return places (k, 3) where one more sphere is seen in the light left over, best first."""
    from scipy.ndimage import maximum_filter

    brightness, gain, corner, known = left_over(scene, light, _NEW_SIGHT)
    whole = known * _usual(light) ** 2
    grid = [
        c + h * np.arange(n) for c, h, n in zip(corner, scene.image.voxel, gain.shape, strict=True)
    ]
    apart = np.full(3, _APART * contact)
    closed = within(grid, light.centers[keep], apart) | within(grid, given_up, apart * _AGAIN)
    # What is brighter than expected is no dark sphere, and what is known needs no second sphere.
    relative = np.where(closed, 0.0, brightness / _usual(light))
    gain = np.where((relative > 1 / _FACTOR) & (relative < _FACTOR), gain, 0.0)
    size = np.maximum(apart / scene.image.voxel, 3).astype(int)
    least = max(_SEEN, _SHARE * whole)
    index = np.argwhere((gain > least) & (gain == maximum_filter(gain, tuple(size))))
    best = index[np.argsort(-gain[tuple(index.T)])]
    return _thinned(corner + best * scene.image.voxel, _APART * contact)


def _thinned(places: Floats, apart: float) -> Floats:
    """Return the places that are not too near to an earlier one."""
    kept: list[Floats] = []
    for place in places:
        if all(np.linalg.norm(place - other) > apart for other in kept):
            kept.append(place)
    return np.array(kept).reshape(-1, 3)


def _changed(scene: Scene, light: Light, keep: Bools, new: Floats) -> Light:
    return shine(
        scene,
        np.concatenate([light.centers[keep], new]),
        np.append(light.brightness[keep], np.full(len(new), _usual(light))),
        light.background,
    )


def _inside(
    shape: tuple[int, ...],
    scene: Scene,
    light: Light,
    contact: float,
    settled: Bools,
    origin: Ints,
) -> CrowdFit:
    information, _ = normal_equations(scene, light)
    last = (np.array(shape) - 1) * scene.image.voxel
    inside = np.all((light.centers >= 0) & (light.centers <= last), axis=1)
    inside &= _present(scene, light, contact)
    return CrowdFit(
        light.centers[inside],
        standard_errors(information, light)[inside],
        own_misfit(scene, light)[inside],
        settled[inside],
        origin[inside],
        scene,
        light,
    )


def piece_of(
    frame: Floats, centers: Floats, voxel: tuple[float, float, float], *, count: int
) -> tuple[Floats, Floats]:
    """Return the box of a frame that holds the spheres in a crowd's middle, and those in it.

    Parameters
    ----------
    frame : ndarray, shape (nz, ny, nx)
    centers : ndarray, shape (n, 3)
    voxel : tuple of float
        (z, y, x), um.
    count : int
        The box is drawn around so many spheres; all of the crowd in it are returned.
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
