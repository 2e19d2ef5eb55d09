"""The light of many spheres whose images overlap, and the normal equations of their places.

Arrays' axes and centres are (z, y, x), um, the origin at the centre of voxel (0, 0, 0).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from perrin.images.optics.window_fit import box_around, within

if TYPE_CHECKING:
    from collections.abc import Iterator

    from perrin._arrays import Bools, Floats
    from perrin.images.optics.ball_image import SphereImage, SphereSpot
    from perrin.images.optics.optics import CameraNoise


_OWN = 4  # numbers of a sphere: its place and its brightness


_TILTS = 5  # slopes and curvatures of the background within the plane


@dataclass(frozen=True, eq=False)
class Scene:
    """The voxels around a crowd, those of them that count, and how spheres are seen there.

    The background has a level of its own in every plane, because planes are scanned one after
    another and a dense sample often lies on a floor below which there is no light, and a smooth
    slope and curvature within the plane.
    """

    data: Floats  # (nz, ny, nx)
    mask: Bools
    origin: Floats  # (3,), um: of voxel (0, 0, 0) in the frame
    image: SphereImage
    noise: CameraNoise
    tilt: Floats  # (5, ny, nx)

    @property
    def n_background(self) -> int:
        """Numbers of the background."""
        return len(self.data) + _TILTS

    def background(self, numbers: Floats) -> Floats:
        """Return the light of the background (nz, ny, nx)."""
        n = len(self.data)
        return np.asarray(numbers[:n, None, None] + np.tensordot(numbers[n:], self.tilt, 1))

    def holds(self, places: Floats) -> Bools:
        """Return which places lie between the first voxel and the last."""
        last = self.origin + (np.array(self.data.shape) - 1) * np.array(self.image.voxel)
        return np.asarray(np.all((places >= self.origin) & (places <= last), axis=1))

    def spots(self, image: SphereImage, centers: Floats) -> list[SphereSpot]:
        """Return the unit images of spheres in this scene."""
        return [image.spot(c, self.data.shape) for c in centers - self.origin]


def cut_scene(
    frame: Floats, image: SphereImage, noise: CameraNoise, centers: Floats, others: Floats
) -> Scene:
    """Cut out the box around the spheres at `centers`, one sphere wider; `others` do not count.

    A sphere that is missing among `centers` is looked for in the whole of it.
    """
    extent, step = image.extent, np.array(image.voxel)
    box = box_around(centers, extent + image.diameter, image.voxel, frame.shape)
    grid = [h * np.arange(s.start, s.stop) for s, h in zip(box, step, strict=True)]
    ends = np.array([[g[0], g[-1]] for g in grid]).T
    near = np.all(np.abs(others - np.clip(others, *ends)) < extent, axis=1)
    y, x = (np.linspace(-1.0, 1.0, len(g)) for g in grid[1:])
    plane = (len(y), len(x))
    shapes = (y[:, None], x, y[:, None] ** 2, x**2, y[:, None] * x)
    return Scene(
        frame[box],
        ~within(grid, others[near], extent),
        np.array([g[0] for g in grid]),
        image,
        noise,
        np.stack([np.broadcast_to(shape, plane) for shape in shapes]),
    )


class Light(NamedTuple):
    """Spheres with their brightness and a background, and what they make a camera expect."""

    centers: Floats  # (n, 3)
    brightness: Floats  # (n,)
    background: Floats
    spots: list[SphereSpot]
    expected: Floats
    weight: Floats  # nought where a voxel does not count

    def misfit(self, scene: Scene, expected: Floats) -> float:
        """Return chi-squared of some expected light by these weights."""
        return float(np.sum(self.weight * (scene.data - expected) ** 2))

    @property
    def counted(self) -> int:
        """How many voxels count."""
        return int(np.count_nonzero(self.weight))

    def moved(self, scene: Scene, step: Floats) -> Light:
        """Return the light after a step of all numbers."""
        n = len(self.centers)
        own = step[: _OWN * n].reshape(n, _OWN)
        return shine(
            scene,
            self.centers + own[:, :3],
            self.brightness + own[:, 3],
            self.background + step[_OWN * n :],
        )


def shine(scene: Scene, centers: Floats, brightness: Floats, background: Floats) -> Light:
    """Return the light of spheres before a background."""
    spots = scene.spots(scene.image, centers)
    expected = scene.background(background) + total(scene, spots, brightness)
    weight = np.where(scene.mask, scene.noise.weight(expected), 0.0)
    return Light(centers, brightness, background, spots, expected, weight)


def total(scene: Scene, spots: list[SphereSpot], brightness: Floats) -> Floats:
    """Return the spheres' light, all together."""
    light = np.zeros(scene.data.shape)
    for spot, bright in zip(spots, brightness, strict=True):
        light[spot.box] += bright * spot.value
    return light


def first_light(scene: Scene, centers: Floats) -> Light:
    """Return spheres where they are said to be; brightness and background by least squares."""
    n = len(centers)
    planes = zip(scene.data, scene.mask, strict=True)
    level = [float(d[m].mean()) if m.any() else 0.0 for d, m in planes]
    light = shine(scene, centers, np.zeros(n), np.append(level, np.zeros(_TILTS)))
    for _ in range(2):
        information, score = normal_equations(scene, light)
        free = np.append(np.arange(3, _OWN * n, _OWN), np.arange(_OWN * n, len(score)))
        # A sphere that is not there has no brightness to find; lstsq leaves it at nought.
        step = np.zeros_like(score)
        part = information[free][:, free].toarray()
        step[free] = np.linalg.lstsq(part, score[free], rcond=None)[0]
        light = light.moved(scene, step)
    return light


def normal_equations(scene: Scene, light: Light) -> tuple[Any, Floats]:
    """Return the Fisher information, sparse (p, p), and the score (p,).

    The numbers are place (z, y, x) and brightness of every sphere, one sphere after the other, and
    the background's. Spheres whose boxes do not meet share nothing.
    """
    from scipy.sparse import coo_array

    blocks = list(_blocks(scene, light))
    blocks += [(column, row, block.T) for row, column, block in blocks if row != column]
    index = [np.indices(block.shape).reshape(2, -1) for *_, block in blocks]
    row, column = (
        np.concatenate([at[k] + block[k] for at, block in zip(index, blocks, strict=True)])
        for k in (0, 1)
    )
    value = np.concatenate([block.ravel() for *_, block in blocks])
    p = _OWN * len(light.spots) + scene.n_background
    information = coo_array((value, (row, column)), shape=(p, p)).tocsr()
    return information, project(scene, light, light.weight * (scene.data - light.expected))


def brightness_numbers(light: Light) -> slice:
    """Return which of the numbers are the spheres' brightness."""
    return slice(_OWN - 1, _OWN * len(light.spots), _OWN)


def project(scene: Scene, light: Light, field: Floats) -> Floats:
    """Return the sums (p,) of a field over voxels, times the slope of the light by each number."""
    own = [
        s.reshape(_OWN, -1) @ field[spot.box].ravel()
        for s, spot in zip(_slopes(light), light.spots, strict=True)
    ]
    return np.concatenate([*own, field.sum((1, 2)), np.einsum("tyx,zyx->t", scene.tilt, field)])


def _slopes(light: Light) -> list[Floats]:
    """Return every sphere's light by its place and its brightness, (4, *box)."""
    pairs = zip(light.spots, light.brightness, strict=True)
    return [np.concatenate([b * spot.gradient, spot.value[None]]) for spot, b in pairs]


def _blocks(scene: Scene, light: Light) -> Iterator[tuple[int, int, Floats]]:
    """Yield the blocks of the information on and right of the diagonal: row, column, block."""
    slopes, last = _slopes(light), _OWN * len(light.spots)
    for i, a in enumerate(light.spots):
        weighted = slopes[i] * light.weight[a.box]
        yield _OWN * i, last, _with_background(scene, a, weighted)
        for j in range(i, len(light.spots)):
            b = light.spots[j]
            common = [
                (max(p.start, q.start), min(p.stop, q.stop))
                for p, q in zip(a.box, b.box, strict=True)
            ]
            if all(low < high for low, high in common):
                own, theirs = (
                    s[(slice(None), *_inside(common, spot.box))].reshape(_OWN, -1)
                    for s, spot in ((weighted, a), (slopes[j], b))
                )
                yield _OWN * i, _OWN * j, own @ theirs.T
    yield last, last, _background_block(scene, light.weight)


def _inside(common: list[tuple[int, int]], box: tuple[slice, ...]) -> tuple[slice, ...]:
    return tuple(slice(a - s.start, b - s.start) for (a, b), s in zip(common, box, strict=True))


def _with_background(scene: Scene, spot: SphereSpot, weighted: Floats) -> Floats:
    block = np.zeros((_OWN, scene.n_background))
    block[:, spot.box[0]] = weighted.sum((2, 3))
    tilt = scene.tilt[(slice(None), *spot.box[1:])].reshape(_TILTS, -1)
    block[:, len(scene.data) :] = weighted.sum(1).reshape(_OWN, -1) @ tilt.T
    return block


def _background_block(scene: Scene, weight: Floats) -> Floats:
    n, tilt = len(scene.data), scene.tilt.reshape(_TILTS, -1)
    block = np.zeros((scene.n_background, scene.n_background))
    block[:n, :n] = np.diag(weight.sum((1, 2)))
    block[:n, n:] = weight.reshape(n, -1) @ tilt.T
    block[n:, :n] = block[:n, n:].T
    block[n:, n:] = (tilt * weight.sum(0).ravel()) @ tilt.T
    return block


def told_apart(scene: Scene, light: Light, slopes: Floats) -> tuple[Floats, Floats]:
    """Return information (k, k) and score (k,) of k more numbers, the spheres' own eliminated.

    Parameters
    ----------
    slopes : ndarray, shape (k, nz, ny, nx)
        The light's derivatives by those numbers.

    Notes
    -----
    The Schur complement of the information; numbers that no voxel tells of count as known.
    """
    from scipy.sparse import diags_array
    from scipy.sparse.linalg import splu

    information, score = normal_equations(scene, light)
    scale = information.diagonal()
    ridge = diags_array(np.where(scale > 0, 1e-12 * scale, 1.0))
    weighted = light.weight * slopes
    shared = np.stack([project(scene, light, w) for w in weighted], axis=1)
    taken = splu((information + ridge).tocsc()).solve(shared)
    own = np.einsum("izyx,jzyx->ij", weighted, slopes)
    by_hand = np.einsum("izyx,zyx->i", weighted, scene.data - light.expected)
    return own - shared.T @ taken, by_hand - taken.T @ score


def standard_errors(information: Any, light: Light) -> Floats:  # noqa: ANN401 (scipy's sparse array)
    """Return the standard errors (n, 3) of places, um; NaN for a sphere without light.

    The information on a sphere and all those whose boxes meet its own is inverted, with the
    background: what lies beyond is as good as known.
    """
    n, size = len(light.spots), information.shape[0]
    sigma = np.full((n, 3), np.nan)
    dark = information.diagonal() <= 0
    for i in range(n):
        row = slice(*information.indptr[_OWN * i : _OWN * i + 2])
        near = np.sort(information.indices[row])
        part = np.append(near[near < _OWN * n], np.arange(_OWN * n, size))
        local = information[part][:, part].toarray() + np.diag(dark[part])
        own = np.searchsorted(part, _OWN * i + np.arange(3))
        if not dark[part[own]].any():
            sigma[i] = np.sqrt(np.diag(np.linalg.inv(local))[own])
    return sigma


def own_misfit(scene: Scene, light: Light) -> Floats:
    """Return chi-squared per voxel (n,) of the voxels that every sphere lights."""
    square = light.weight * (scene.data - light.expected) ** 2
    misfit = np.full(len(light.spots), np.nan)
    for i, spot in enumerate(light.spots):
        seen = float(spot.value[scene.mask[spot.box]].sum())
        if seen > 0:
            misfit[i] = float(np.sum(spot.value * square[spot.box])) / seen
    return misfit


def in_sight(scene: Scene, light: Light) -> Floats:
    """Return the part (n,) of every sphere's light that falls on voxels that count."""
    volume = np.pi * scene.image.diameter**3 / 6 / float(np.prod(scene.image.voxel))
    seen = [float(spot.value[scene.mask[spot.box]].sum()) for spot in light.spots]
    return np.array(seen) / volume


def told_by(light: Light) -> Floats:
    """Return the chi-squared (n,) that every sphere's light is worth, all else being known."""
    pairs = zip(light.spots, light.brightness, strict=True)
    worth = [b**2 * np.sum(light.weight[spot.box] * spot.value**2) for spot, b in pairs]
    return np.array(worth, dtype=np.float64)


def left_over(scene: Scene, light: Light, least: float) -> tuple[Floats, Floats, Floats, float]:
    """Return what one more sphere would do, everywhere, also beyond the scene's border.

    Returns
    -------
    brightness, gain : ndarray
        Of least squares, and the chi-squared that it takes away; in a box larger than the scene;
        nought where less than the part `least` of the sphere would be seen.
    corner : ndarray, shape (3,)
        Place of the first voxel of that box, um.
    known : float
        Information on the brightness of a sphere wholly in sight.
    """
    from scipy.signal import fftconvolve

    image, step = scene.image, np.array(scene.image.voxel)
    half = (np.array(image.reach) / step).astype(int)
    value, _ = image.at(*(h * np.arange(-k, k + 1) for h, k in zip(step, half, strict=True)))
    # The sphere's image is its own mirror image, so that convolution is correlation.
    told = fftconvolve(light.weight * (scene.data - light.expected), value)
    known = fftconvolve(light.weight, value**2)
    seen = fftconvolve(scene.mask.astype(np.float64), value) > least * value.sum()
    brightness = np.where(seen, told / np.where(seen, known, 1.0), 0.0)
    return brightness, brightness * told, scene.origin - half * step, float(known.max())
