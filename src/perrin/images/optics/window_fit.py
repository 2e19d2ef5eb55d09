"""Positions of the spheres of one cluster, by the likelihood of their image.

Axes of arrays and centres are (z, y, x), um, with the origin at the centre of voxel (0, 0, 0); only
poses, which belong to a body, are in (x, y, z).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from perrin.geometry.rigid import pose_slopes
from perrin.geometry.rotations import exp_map
from perrin.images.optics.asymmetry import ABOVE_FOCUS, Asymmetry
from perrin.images.optics.flicker import VoxelPrecision
from perrin.images.optics.neighbours import neighbour_covariance

if TYPE_CHECKING:
    from perrin._arrays import Bools, Floats
    from perrin.images.optics.ball_image import SphereImage
    from perrin.images.optics.depth import DepthChange
    from perrin.images.optics.flicker import Lines
    from perrin.images.optics.optics import CameraNoise


# Step of a sphere over the blur at which the search ends: far below any standard error.
_WINDOW_STEP_CONVERGED = 1e-4

# What an asymmetric point spread adds to an image is computed again where a sphere has moved by
# this, over the blur: it changes by a tenth of the image's own change.
_CHANGE_CONVERGED = 0.02

_MAX_WINDOW_ROUNDS = 40

# Least number of voxels for each fitted parameter.
_VOXELS_PER_PARAMETER = 5

# Parameters of the background: a level and its slope along z, y and x.
_N_BACKGROUND = 4


class Window(NamedTuple):
    """The voxels of one fit.

    Attributes
    ----------
    box : tuple of slice
        The box of the frame that holds them.
    mask : ndarray of bool, shape (nz, ny, nx)
        The m voxels of the box that the fit uses.
    data : ndarray, shape (m,)
        Grey levels.
    background : ndarray, shape (4, m)
        The background's basis: a level and its slope along z, y and x.
    """

    box: tuple[slice, ...]
    mask: Bools
    data: Floats
    background: Floats

    def has_enough_voxels(self, count: int) -> bool:
        """Return whether there are enough voxels to fit `count` spheres."""
        return len(self.data) >= _VOXELS_PER_PARAMETER * (4 * count + _N_BACKGROUND)

    def origin(self, image: SphereImage) -> Floats:
        """Return the position (z, y, x) of the first voxel of the box, um."""
        return np.asarray(np.array([s.start for s in self.box]) * np.array(image.voxel))

    def spots(self, image: SphereImage, centers: Floats, sizes: Floats) -> tuple[Floats, Floats]:
        """Return unit images (n, m) of spheres on these voxels and their gradients (n, 3, m).

        `sizes` (n,) are deviations of the logarithms of the diameters. Without the asymmetry of the
        point spread.
        """
        origin = self.origin(image)
        layers = image.on_voxels(self.mask, centers - origin, sizes, centers[:, 0])
        return layers[:, 0], layers[:, 1:]

    def changes(self, image: SphereImage, centers: Floats, sizes: Floats) -> Floats | None:
        """Return what the asymmetry of the point spread adds to `spots` (n, m), None if nothing."""
        if not image.is_uneven:
            return None
        origin = self.origin(image)
        return image.changes_on_voxels(self.mask, centers - origin, sizes, centers[:, 0])

    def size_slopes(self, image: SphereImage, centers: Floats, sizes: Floats) -> Floats:
        """Return the derivatives (n, m) of unit images by the logarithms of the diameters."""
        origin = self.origin(image)
        whole = np.zeros((len(centers), *self.mask.shape))
        heights = centers[:, 0]
        for layer, center, size, high in zip(whole, centers - origin, sizes, heights, strict=True):
            table = image.size_slope(size, high)
            box, value = image.slope_spot(table, center, self.mask.shape)
            layer[box] = value[0]
        return whole[:, self.mask]

    def slopes(
        self,
        image: SphereImage,
        slopes: Floats,
        centers: Floats,
        brightness: Floats,
        sizes: Floats,
    ) -> Floats:
        """Return derivatives (k, m) of the intensity by parameters of the sphere's image.

        Parameters
        ----------
        image : SphereImage
        slopes : ndarray, shape (k, ...)
            The tables of `SphereImage.slopes`.
        centers, brightness, sizes : ndarray, shape (n, 3), (n,), (n,)
            The spheres; `sizes` are deviations of the logarithms of their diameters.
        """
        origin = self.origin(image)
        whole = np.zeros((len(slopes), *self.mask.shape))
        for center, bright, size in zip(centers - origin, brightness, sizes, strict=True):
            box, value = image.slope_spot(slopes, center, self.mask.shape, deviation=size)
            whole[(slice(None), *box)] += bright * value
        return whole[:, self.mask]

    def moment_slopes(
        self,
        image: SphereImage,
        knots: Floats,
        widths: Floats,
        centers: Floats,
        brightness: Floats,
        *,
        heights: DepthChange,
    ) -> Floats:
        """Return derivatives (16, m) of the intensity by moments of the point spread.

        These are the components of an `Asymmetry`, and the slopes of a `DepthChange`.

        Parameters
        ----------
        image : SphereImage
        knots : ndarray, shape (7, ...)
            What `SphereImage.asymmetry_knots` returns.
        widths : ndarray, shape (2, ...)
            Tables of the derivatives by the variances along z and in the plane.
        centers, brightness : ndarray, shape (n, 3), (n,)
            The spheres.
        heights : DepthChange
            The middle and the range of the heights.
        """
        whole = np.zeros((len(Asymmetry._fields) + len(heights.slopes), *self.mask.shape))
        origin, shape = self.origin(image), self.mask.shape
        for center, bright in zip(centers, brightness, strict=True):
            box, uneven = image.asymmetry_spot(knots, center - origin, shape)
            _, wider = image.slope_spot(widths, center - origin, shape)
            deep = heights.above_middle(float(center[0])) * np.concatenate(
                [wider, uneven[ABOVE_FOCUS]]
            )
            whole[(slice(None), *box)] += bright * np.concatenate([uneven, deep])
        return whole[:, self.mask]


class Arrangement(Protocol):
    """Spheres whose positions follow from a few parameters."""

    @property
    def centers(self) -> Floats:
        """Positions (n, 3) as (z, y, x), um."""

    @property
    def slope(self) -> Floats | None:
        """Derivatives of the flattened positions by the parameters, (k, 3 n); None is identity."""

    def moved(self, step: Floats) -> Arrangement:
        """Return the arrangement after a small step (k,) of its parameters."""


@dataclass(frozen=True)
class FreeCenters:
    """Spheres whose positions are independent.

    Examples
    --------
    >>> FreeCenters(np.zeros((1, 3))).moved(np.array([0.1, 0.0, 0.2])).centers
    array([[0.1, 0. , 0.2]])
    """

    centers: Floats
    slope: None = None

    def moved(self, step: Floats) -> FreeCenters:
        """Shift each sphere; step (3 n,)."""
        return FreeCenters(self.centers + step.reshape(-1, 3))


@dataclass(frozen=True)
class RigidCenters:
    """Spheres that are points of one rigid body; centre and rotation are in (x, y, z).

    Examples
    --------
    >>> body = RigidCenters(np.array([1.0, 2.0, 3.0]), np.eye(3), np.array([[0.5, 0.0, 0.0]]))
    >>> body.centers, body.slope.shape
    (array([[3. , 2. , 1.5]]), (6, 3))
    """

    center: Floats
    rotation: Floats
    template: Floats

    @property
    def centers(self) -> Floats:
        """Positions (n, 3) as (z, y, x), um."""
        return (self.center + self.template @ self.rotation.T)[:, ::-1]

    @property
    def slope(self) -> Floats:
        """Derivatives (6, 3 n) by the centre and by a small rotation about the lab's axes."""
        slopes = np.roll(pose_slopes(self.template @ self.rotation.T), 3, axis=-1)
        return np.moveaxis(slopes[:, ::-1], -1, 0).reshape(6, -1)

    def moved(self, step: Floats) -> RigidCenters:
        """Shift the centre and rotate the body; step (6,)."""
        turned = exp_map(step[3:]) @ self.rotation
        return RigidCenters(self.center + step[:3], turned, self.template)


class ImageFit(NamedTuple):
    """A fit to the voxels of a window.

    Attributes
    ----------
    arrangement : Arrangement
        The fitted positions.
    brightness : ndarray, shape (n,)
        Intensity inside each sphere, grey levels.
    covariance : ndarray, shape (k, k)
        Covariance of the arrangement's parameters: the inverse Fisher information, times `chi2`
        where this is above 1.
    converged : bool
        Whether the last step was far below the blur.
    chi2 : float
        Chi-squared per degree of freedom.
    expected : ndarray, shape (m,)
        Expected grey levels.
    precision : VoxelPrecision
        Inverse covariance of the voxels.
    jacobian : ndarray, shape (p, m)
        Derivatives of the expected grey levels by all parameters.
    sizes, size_variance : ndarray, shape (n,)
        Deviations of the logarithms of the diameters from the mean, and their variances; 0 where
        all spheres are equal.
    prior : ndarray, shape (p,)
        Information on the parameters by the distribution of the diameters.
    """

    arrangement: Arrangement
    brightness: Floats
    covariance: Floats
    converged: bool
    chi2: float
    expected: Floats
    precision: VoxelPrecision
    jacobian: Floats
    sizes: Floats
    size_variance: Floats
    prior: Floats

    @property
    def weight(self) -> Floats:
        """Inverse variances (m,) of the voxels, without what they have in common."""
        return self.precision.weight

    @property
    def unit_images(self) -> Floats:
        """Images (n, m) of the spheres at a brightness of 1."""
        return self.jacobian[-_N_BACKGROUND - len(self.brightness) : -_N_BACKGROUND]

    @property
    def centers(self) -> Floats:
        """Positions (n, 3) as (z, y, x), um."""
        return self.arrangement.centers


def cut_window(frame: Floats, image: SphereImage, centers: Floats, *, others: Floats) -> Window:
    """Cut out the voxels around the spheres at `centers` that are free of the `others`.

    Parameters
    ----------
    frame : ndarray, shape (nz, ny, nx)
        Voxels of NaN are left out.
    image : SphereImage
    centers, others : ndarray, shape (n, 3), (m, 3)
        Positions (z, y, x) of the spheres of the fit and of all others, um.

    Returns
    -------
    Window
    """
    extent, voxel = image.extent, np.array(image.voxel)
    box = box_around(centers, extent, image.voxel, frame.shape)
    grid = [h * np.arange(s.start, s.stop) for s, h in zip(box, voxel, strict=True)]
    mask = within(grid, centers, extent)
    low, high = (np.array([getattr(s, end) for s in box]) * voxel for end in ("start", "stop"))
    near = np.all(np.abs(others - np.clip(others, low, high)) < extent, axis=1)
    mask &= ~within(grid, others[near], extent)
    mask &= np.isfinite(frame[box])
    z, y, x = np.meshgrid(*(g - g.mean() for g in grid), indexing="ij", sparse=True)
    background = np.stack([np.broadcast_to(b, mask.shape)[mask] for b in (np.ones(()), z, y, x)])
    return Window(box, mask, frame[box][mask].astype(np.float64), background)


def box_around(
    centers: Floats, extent: Floats, voxel: tuple[float, float, float], shape: tuple[int, ...]
) -> tuple[slice, ...]:
    """Return the box of voxels that reaches `extent` (3,) beyond the centres, inside `shape`.

    Examples
    --------
    >>> centers = np.array([[2.0, 2.0, 2.0]])
    >>> box = box_around(centers, np.full(3, 1.0), (0.25, 0.2, 0.2), (40, 40, 12))
    >>> [(int(s.start), int(s.stop)) for s in box]
    [(4, 13), (5, 16), (5, 12)]
    """
    low = np.clip(np.floor((centers.min(0) - extent) / voxel), 0, None).astype(int)
    high = np.minimum(np.ceil((centers.max(0) + extent) / voxel) + 1, shape).astype(int)
    return tuple(slice(a, b) for a, b in zip(low, high, strict=True))


def within(grid: list[Floats], centers: Floats, extent: Floats) -> Bools:
    """Return which voxels of a grid lie in the ellipsoid `extent` around any of the centres.

    Examples
    --------
    >>> line = np.arange(3.0)
    >>> within([line, line, line], np.array([[1.0, 1.0, 1.0]]), np.full(3, 1.1)).sum()
    np.int64(7)
    """
    mask = np.zeros(tuple(len(g) for g in grid), dtype=np.bool_)
    for center in centers:
        z, y, x = (((g - c) / e) ** 2 for g, c, e in zip(grid, center, extent, strict=True))
        mask |= z[:, None, None] + y[:, None] + x < 1.0
    return mask


def fit_window(
    window: Window, image: SphereImage, noise: CameraNoise, start: Arrangement
) -> ImageFit:
    """Find the arrangement, the spheres' brightness and the background of greatest likelihood.

    Parameters
    ----------
    window : Window
        The voxels of the fit.
    image : SphereImage
        The image of a sphere.
    noise : CameraNoise
        The variance of a voxel.
    start : Arrangement
        Positions at the start.

    Returns
    -------
    ImageFit

    Notes
    -----
    Fisher scoring with Levenberg-Marquardt damping. The weights follow the expected intensity, so
    that the fixed point is the root of the score of the Poisson likelihood shifted by the camera's
    floor; the covariance is the inverse Fisher information there. Where the residuals exceed the
    noise (chi-squared per degree of freedom above 1), the model misses something of the image, and
    the covariance is multiplied by chi-squared. Flicker of the light is a random factor of every
    plane or line, the gain of a pixel one of all its voxels, of known variance, over which the
    likelihood is averaged. Noise that neighbours in a plane have in common (of an image that was
    compressed or smoothed) leaves the estimate as it is, and its covariance is that of this noise.
    What an asymmetric point spread adds to the images is fixed at the centres of the start, and
    computed again at those that are found, until these stay.
    Where diameters differ (`SphereImage.spread`), that of every sphere is fitted too, with a
    Gaussian distribution of its logarithm about the mean.

    Examples
    --------
    >>> from perrin.images import CameraNoise, sphere_image
    >>> image = sphere_image(diameter=2.0, psf=(0.4, 0.15), voxel=(0.25, 0.2, 0.2))
    >>> truth, frame = np.array([[3.01, 3.12, 3.23]]), np.full((24, 32, 32), 9.0)
    >>> spot = image.spot(truth[0], frame.shape)
    >>> frame[spot.box] += 100 * spot.value
    >>> window = cut_window(frame, image, truth, others=np.empty((0, 3)))
    >>> start = FreeCenters(truth + 0.1)
    >>> fit = fit_window(window, image, CameraNoise(1.0, 0.0), start)
    >>> fit.centers.round(4), fit.brightness.round(2)
    (array([[3.01, 3.12, 3.23]]), array([100.]))
    """
    lines = VoxelPrecision.lines_of(window.mask, noise)
    state_at = partial(_fit_state, window, image=image, noise=noise, lines=lines)
    changed_at = start.centers
    change = window.changes(image, changed_at, np.zeros(len(changed_at)))
    state = state_at(start, change=change)
    damping, converged = 1e-3, False
    for _ in range(_MAX_WINDOW_ROUNDS):
        information, score = state.normal_equations(window)
        scale = np.diag(information)
        if not scale.min() > 0:  # a sphere without intensity in the window has no position
            break
        damped = information + np.diag((damping + 1e-12) * scale)
        step = np.asarray(np.linalg.solve(damped, score), dtype=np.float64)
        k, free = state.n_arrangement, state.n_sizes
        moved = state.arrangement.moved(step[:k])
        sizes = state.sizes.copy()
        sizes[:free] = np.clip(
            sizes[:free] + step[k : k + free], -image.size_range, image.size_range
        )
        linear = state.linear + step[k + free :]
        trial = state_at(moved, change=change, linear=linear, sizes=sizes)
        if state.deviance(window, trial) > state.deviance(window, state) * (1 + 1e-12):
            damping *= 10.0
            continue
        shift = np.abs(trial.arrangement.centers - state.arrangement.centers).max()
        state, damping = trial, damping / 10.0
        if shift < _WINDOW_STEP_CONVERGED * image.blur[1]:
            moved_since = np.abs(state.arrangement.centers - changed_at).max()
            if change is None or moved_since < _CHANGE_CONVERGED * image.blur[1]:
                converged = True
                break
            changed_at = state.arrangement.centers
            change = window.changes(image, changed_at, state.sizes)
            state = state_at(
                state.arrangement, change=change, linear=state.linear, sizes=state.sizes
            )
    information, _ = state.normal_equations(window)
    k, free = state.n_arrangement, state.n_sizes
    variance = np.linalg.pinv(information, hermitian=True)
    if noise.neighbours:
        spread = variance @ state.precision.times(state.jacobian)
        spread /= np.sqrt(state.precision.weight)
        variance = variance + neighbour_covariance(
            spread, window.mask, noise.neighbours, along_z=noise.along_z
        )
    size_variance = np.zeros(len(state.sizes))
    size_variance[:free] = np.diag(variance)[k : k + free]
    chi2 = state.chi2(window, state.expected) / max(len(window.data) - len(state.jacobian), 1)
    covariance = variance[:k, :k] * max(chi2, 1.0)
    return ImageFit(
        state.arrangement,
        state.linear[: len(state.linear) - _N_BACKGROUND],
        np.asarray(covariance, dtype=np.float64),
        converged,
        chi2,
        state.expected,
        state.precision,
        state.jacobian,
        state.sizes,
        size_variance,
        state.prior,
    )


class _FitState(NamedTuple):
    """Parameters of a fit, and the expected intensity that follows from them."""

    arrangement: Arrangement
    linear: Floats  # brightness (n,) and background (4,)
    expected: Floats
    precision: VoxelPrecision
    jacobian: Floats
    sizes: Floats
    prior: Floats

    @property
    def n_sizes(self) -> int:
        """Number of diameters that are fitted."""
        return int(np.count_nonzero(self.prior))

    @property
    def n_arrangement(self) -> int:
        """Number of parameters of the arrangement."""
        return len(self.jacobian) - len(self.linear) - self.n_sizes

    def deviance(self, window: Window, trial: _FitState) -> float:
        """Return chi-squared of a trial with the weights of this state, and that of its sizes."""
        precision = float(self.prior.max())
        return self.chi2(window, trial.expected) + precision * float(np.sum(trial.sizes**2))

    def chi2(self, window: Window, expected: Floats) -> float:
        """Return chi-squared of an expected intensity, with the weights of this state."""
        residual = window.data - expected
        if self.precision.lines is None:
            return float(self.precision.weight @ residual**2)
        return float(residual @ self.precision.times(residual))

    def normal_equations(self, window: Window) -> tuple[Floats, Floats]:
        """Return the Fisher information and the score."""
        weighted = self.precision.times(self.jacobian)
        information = weighted @ self.jacobian.T
        score = weighted @ (window.data - self.expected)
        if self.n_sizes:
            information += np.diag(self.prior)
            score[self.prior > 0] -= self.prior.max() * self.sizes
        return information, score


def _least_squares(data: Floats, design: Floats, noise: CameraNoise, expected: Floats) -> Floats:
    """Return the coefficients of the rows of `design`, with the weights of an expected intensity.

    The brightness of a sphere outside the window is undetermined; lstsq leaves it at 0.
    """
    weighted = design * noise.weight(expected)
    return np.asarray(np.linalg.lstsq(weighted @ design.T, weighted @ data, rcond=None)[0])


def _fit_state(
    window: Window,
    arrangement: Arrangement,
    *,
    image: SphereImage,
    noise: CameraNoise,
    lines: Lines | None,
    change: Floats | None,
    linear: Floats | None = None,
    sizes: Floats | None = None,
) -> _FitState:
    """Return the state of an arrangement; `linear` None is fitted by least squares.

    `change` is what the asymmetry of the point spread adds to the images of the spheres.
    """
    if sizes is None:
        sizes = np.zeros(len(arrangement.centers))
    value, gradient = window.spots(image, arrangement.centers, sizes)
    if change is not None:
        value = value + change
    if linear is None:
        design = np.concatenate([value, window.background])
        flat = np.full_like(window.data, window.data.mean())
        linear = _least_squares(window.data, design, noise, flat)
        linear = _least_squares(window.data, design, noise, np.asarray(linear @ design))
    slope, n = arrangement.slope, len(value)
    k = 3 * n if slope is None else len(slope)
    free = n if image.spread > 0 else 0
    jacobian = np.empty((k + free + len(linear), len(window.data)))
    brightness = linear[:n, None, None]
    if slope is None:
        np.multiply(brightness, gradient, out=jacobian[:k].reshape(gradient.shape))
    else:
        np.matmul(slope, (brightness * gradient).reshape(3 * n, -1), out=jacobian[:k])
    if free:
        slopes = window.size_slopes(image, arrangement.centers, sizes)
        np.multiply(linear[:n, None], slopes, out=jacobian[k : k + n])
    k += free
    jacobian[k : k + n], jacobian[k + n :] = value, window.background
    expected = linear @ jacobian[k:]
    prior = np.zeros(len(jacobian))
    if free:
        prior[k - n : k] = image.spread**-2
    precision = VoxelPrecision.of(expected, noise, lines)
    return _FitState(arrangement, linear, expected, precision, jacobian, sizes, prior)
