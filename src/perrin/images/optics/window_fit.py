"""Where the spheres of one cluster are, by the likelihood of their image.

Arrays' axes and centres are (z, y, x), um, the origin at the centre of voxel (0, 0, 0); only the
pose, which belongs to a body in (x, y, z), turns them round.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from perrin.geometry.rigid import pose_slopes
from perrin.geometry.rotations import exp_map

if TYPE_CHECKING:
    from perrin._arrays import Bools, Floats
    from perrin.images.optics.ball_image import SphereImage
    from perrin.images.optics.optics import CameraNoise


_CONVERGED = 1e-4  # last step of a sphere over the blur: far below what any photons tell


_ROUNDS = 40


_ENOUGH = 5  # voxels for each number that is fitted


_BACKGROUND = 4  # a level and its slope along z, y and x


class Window(NamedTuple):
    """The voxels of one fit: a box of the frame and those of its voxels that count."""

    box: tuple[slice, ...]
    mask: Bools
    data: Floats  # (m,)
    background: Floats  # (4, m)

    def shows(self, count: int) -> bool:
        """Return whether enough voxels are left to fit `count` spheres."""
        return len(self.data) >= _ENOUGH * (4 * count + _BACKGROUND)

    def spots(self, image: SphereImage, centers: Floats) -> tuple[Floats, Floats]:
        """Return unit images (n, m) of spheres on these voxels and their gradients (n, 3, m)."""
        shape = self.mask.shape
        origin = np.array([s.start for s in self.box]) * np.array(image.voxel)
        whole = np.zeros((len(centers), 4, *shape))
        for layer, center in zip(whole, centers - origin, strict=True):
            spot = image.spot(center, shape)
            layer[(0, *spot.box)] = spot.value
            layer[(slice(1, None), *spot.box)] = spot.gradient
        kept = whole.reshape(4 * len(centers), -1).take(np.flatnonzero(self.mask), axis=1)
        kept = kept.reshape(len(centers), 4, -1)
        return kept[:, 0], kept[:, 1:]


class Arrangement(Protocol):
    """Spheres whose places follow from a few numbers."""

    @property
    def centers(self) -> Floats:
        """Places (n, 3) as (z, y, x)."""

    @property
    def slope(self) -> Floats | None:
        """Derivatives of the flattened places by the numbers, (k, 3 n); None is the identity."""

    def moved(self, step: Floats) -> Arrangement:
        """Return the arrangement after a small step (k,) of its numbers."""


@dataclass(frozen=True)
class FreeCenters:
    """Every sphere moves for itself."""

    centers: Floats
    slope: None = None

    def moved(self, step: Floats) -> FreeCenters:
        """Shift each sphere; step (3 n,)."""
        return FreeCenters(self.centers + step.reshape(-1, 3))


@dataclass(frozen=True)
class RigidCenters:
    """The spheres are points of one body, which moves and turns: center and rotation in x, y, z."""

    center: Floats
    rotation: Floats
    template: Floats

    @property
    def centers(self) -> Floats:
        """Places (n, 3) as (z, y, x)."""
        return (self.center + self.template @ self.rotation.T)[:, ::-1]

    @property
    def slope(self) -> Floats:
        """By the centre's x, y, z and by a small turn about the lab's x, y, z: (6, 3 n)."""
        slopes = np.roll(pose_slopes(self.template @ self.rotation.T), 3, axis=-1)
        return np.moveaxis(slopes[:, ::-1], -1, 0).reshape(6, -1)

    def moved(self, step: Floats) -> RigidCenters:
        """Shift the centre and turn the body; step (6,)."""
        turned = exp_map(step[3:]) @ self.rotation
        return RigidCenters(self.center + step[:3], turned, self.template)


class ImageFit(NamedTuple):
    """A fitted window; `covariance` (k, k) is that of the arrangement's numbers."""

    arrangement: Arrangement
    brightness: Floats  # (n,)
    covariance: Floats
    converged: bool
    chi2: float  # per degree of freedom
    expected: Floats  # (m,)
    weight: Floats  # (m,)
    jacobian: Floats  # (p, m)

    @property
    def centers(self) -> Floats:
        """Places (n, 3) as (z, y, x), um."""
        return self.arrangement.centers


def cut_window(frame: Floats, image: SphereImage, centers: Floats, *, others: Floats) -> Window:
    """Cut out the voxels around the spheres at `centers` that are free of the `others`.

    Parameters
    ----------
    frame : ndarray, shape (nz, ny, nx)
    image : SphereImage
    centers, others : ndarray, shape (n, 3), (m, 3)
        (z, y, x), um.
    """
    extent, voxel = image.extent, np.array(image.voxel)
    box = box_around(centers, extent, image.voxel, frame.shape)
    grid = [h * np.arange(s.start, s.stop) for s, h in zip(box, voxel, strict=True)]
    mask = within(grid, centers, extent)
    low, high = (np.array([getattr(s, end) for s in box]) * voxel for end in ("start", "stop"))
    near = np.all(np.abs(others - np.clip(others, low, high)) < extent, axis=1)
    mask &= ~within(grid, others[near], extent)
    z, y, x = np.meshgrid(*(g - g.mean() for g in grid), indexing="ij", sparse=True)
    background = np.stack([np.broadcast_to(b, mask.shape)[mask] for b in (np.ones(()), z, y, x)])
    return Window(box, mask, frame[box][mask].astype(np.float64), background)


def box_around(
    centers: Floats, extent: Floats, voxel: tuple[float, float, float], shape: tuple[int, ...]
) -> tuple[slice, ...]:
    """Return the box of voxels that reaches `extent` (3,) beyond the centres, inside `shape`."""
    low = np.clip(np.floor((centers.min(0) - extent) / voxel), 0, None).astype(int)
    high = np.minimum(np.ceil((centers.max(0) + extent) / voxel) + 1, shape).astype(int)
    return tuple(slice(a, b) for a, b in zip(low, high, strict=True))


def within(grid: list[Floats], centers: Floats, extent: Floats) -> Bools:
    """Return which voxels of a grid lie in the ellipsoid `extent` around any of the centres."""
    mask = np.zeros(tuple(len(g) for g in grid), dtype=np.bool_)
    for center in centers:
        z, y, x = (((g - c) / e) ** 2 for g, c, e in zip(grid, center, extent, strict=True))
        mask |= z[:, None, None] + y[:, None] + x < 1.0
    return mask


def fit_window(
    window: Window, image: SphereImage, noise: CameraNoise, start: Arrangement
) -> ImageFit:
    """Find the arrangement, the spheres' brightness and the background of greatest likelihood.

    Notes
    -----
    Fisher scoring with Levenberg-Marquardt damping. The weights follow the expected light, so that
    the fixed point is the root of the score of the Poisson likelihood shifted by the camera's
    floor; the covariance is the inverse Fisher information there.
    """
    state = _linear_fit(window, image, noise, start)
    damping, settled = 1e-3, False
    for _ in range(_ROUNDS):
        information, score = _normal_equations(window, state)
        scale = np.diag(information)
        if not scale.min() > 0:  # a sphere without light in the window: nothing to be found
            break
        damped = information + np.diag((damping + 1e-12) * scale)
        step = np.asarray(np.linalg.solve(damped, score), dtype=np.float64)
        trial = _stepped(window, image, noise, state, step)
        if _misfit(window, trial.expected, state.weight) > _misfit(
            window, state.expected, state.weight
        ) * (1 + 1e-12):
            damping *= 10.0
            continue
        moved = np.abs(trial.arrangement.centers - state.arrangement.centers).max()
        state, damping = trial, damping / 10.0
        if moved < _CONVERGED * image.blur[1]:
            settled = True
            break
    return _finished(window, state, settled)


class _State(NamedTuple):
    """Where the search stands."""

    arrangement: Arrangement
    linear: Floats  # brightness (n,) and background (4,)
    expected: Floats
    weight: Floats
    jacobian: Floats


def _numbers(state: _State) -> int:
    return len(state.jacobian) - len(state.linear)


def _misfit(window: Window, expected: Floats, weight: Floats) -> float:
    return float(weight @ (window.data - expected) ** 2)


def _normal_equations(window: Window, state: _State) -> tuple[Floats, Floats]:
    weighted = state.jacobian * state.weight
    return weighted @ state.jacobian.T, weighted @ (window.data - state.expected)


def _linear_fit(
    window: Window, image: SphereImage, noise: CameraNoise, start: Arrangement
) -> _State:
    """Return the start: places as given, brightness and background by least squares."""
    value, gradient = window.spots(image, start.centers)
    design = np.concatenate([value, window.background])
    expected = np.full_like(window.data, window.data.mean())
    for _ in range(2):
        weighted = design * noise.weight(expected)
        # A sphere that is not there has no brightness to find; lstsq leaves it at nought.
        linear = np.linalg.lstsq(weighted @ design.T, weighted @ window.data, rcond=None)[0]
        expected = linear @ design
    return _state(start, linear, value, gradient, window, noise)


def _stepped(
    window: Window, image: SphereImage, noise: CameraNoise, state: _State, step: Floats
) -> _State:
    k = _numbers(state)
    arrangement = state.arrangement.moved(step[:k])
    value, gradient = window.spots(image, arrangement.centers)
    return _state(arrangement, state.linear + step[k:], value, gradient, window, noise)


def _state(
    arrangement: Arrangement,
    linear: Floats,
    value: Floats,
    gradient: Floats,
    window: Window,
    noise: CameraNoise,
) -> _State:
    slope, n = arrangement.slope, len(value)
    k = 3 * n if slope is None else len(slope)
    jacobian = np.empty((k + len(linear), len(window.data)))
    brightness = linear[:n, None, None]
    if slope is None:
        np.multiply(brightness, gradient, out=jacobian[:k].reshape(gradient.shape))
    else:
        np.matmul(slope, (brightness * gradient).reshape(3 * n, -1), out=jacobian[:k])
    jacobian[k : k + n], jacobian[k + n :] = value, window.background
    expected = linear @ jacobian[k:]
    return _State(arrangement, linear, expected, noise.weight(expected), jacobian)


def _finished(window: Window, state: _State, settled: bool) -> ImageFit:
    information, _ = _normal_equations(window, state)
    k = _numbers(state)
    freedom = max(len(window.data) - len(state.jacobian), 1)
    return ImageFit(
        state.arrangement,
        state.linear[: len(state.linear) - _BACKGROUND],
        np.asarray(np.linalg.pinv(information, hermitian=True)[:k, :k], dtype=np.float64),
        settled,
        _misfit(window, state.expected, state.weight) / freedom,
        state.expected,
        state.weight,
        state.jacobian,
    )
