"""Optics learned from frames: sphere diameter, point spread and camera noise; and saturation."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from perrin.errors import NoSpheresError
from perrin.images.optics.ball_image import SphereImage, sphere_image
from perrin.images.optics.crowd_equations import profile_information, sum_of_spheres
from perrin.images.optics.crowd_fit import fit_crowd
from perrin.images.optics.optics import CameraNoise, Optics
from perrin.images.optics.window_fit import FreeCenters, cut_window, fit_window

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from perrin._arrays import Floats
    from perrin.images.optics.window_fit import Window


# Change of a logarithm for the central differences.
_LOG_DIFFERENCE = 0.01

# Largest step of a logarithm, and the step at which the search ends.
_MAX_LOG_STEP, _LOG_STEP_CONVERGED = 0.25, 1e-3

_MAX_LEARNING_ROUNDS = 15

# Searches of a crowd's residuals for missing spheres, in every round.
_LEARNING_SEARCHES = 2

# Saturation below this number of voxels, or this fraction of them, does not affect any position.
_MIN_CLIPPED, _MIN_CLIPPED_FRACTION = 10, 1e-5

# Number of occupied grey levels below the highest, with which it is compared.
_COMPARED_LEVELS = 3

# Level of the saturation test in one frame: movies have thousands of frames.
_SATURATION_LEVEL = 1e-6


def saturated_share(data: NDArray[Any]) -> float:
    """Return the fraction of voxels that are clipped at the highest grey level; 0 where none is.

    Parameters
    ----------
    data : ndarray
        One frame, in the type in which it was recorded.

    Returns
    -------
    float

    Notes
    -----
    The highest grey level of a frame is the end of the camera's range where it is the largest value
    of an integer type, or where significantly more voxels have it than have any of the three
    occupied grey levels below it: without clipping, the number of voxels decreases from level to
    level. The numbers of voxels at two levels are compared by the binomial test.

    Examples
    --------
    >>> import numpy as np
    >>> frame = np.random.default_rng(1).poisson(200.0, size=100_000).astype(np.uint16)
    >>> saturated_share(frame), round(saturated_share(np.minimum(frame, 230)), 3)
    (0.0, 0.02)
    """
    from scipy.special import bdtrc

    top = data.max()
    count = int(np.count_nonzero(data == top))
    share = count / data.size
    if count < _MIN_CLIPPED or share <= _MIN_CLIPPED_FRACTION:
        return 0.0
    if data.dtype.kind in "iu" and top == np.iinfo(data.dtype).max:
        return share
    numbers = np.unique(data, return_counts=True)[1]
    if len(numbers) == 1:
        return 0.0
    most = int(numbers[-1 - _COMPARED_LEVELS : -1].max())
    # The level is the highest because one voxel has it: that voxel is no evidence.
    return share if bdtrc(count - 2, count - 1 + most, 0.5) < _SATURATION_LEVEL else 0.0


class SampleFit(NamedTuple):
    """A fit to one sample of a frame, and its information on the optics.

    Attributes
    ----------
    centers : ndarray, shape (n, 3)
        Fitted positions (z, y, x), um.
    information : ndarray, shape (3, 3)
        Information on the logarithms of diameter, psf z and psf plane, the parameters of the
        spheres eliminated.
    score : ndarray, shape (3,)
        Score of these logarithms.
    expected : ndarray, shape (m,)
        Expected grey levels of the voxels of the fit.
    squared_residual : ndarray, shape (m,)
        Squared differences of grey levels and expected grey levels.
    """

    centers: Floats
    information: Floats
    score: Floats
    expected: Floats
    squared_residual: Floats


class ImageVariations(NamedTuple):
    """The sphere's image, and the images with each logarithm slightly larger and smaller.

    The logarithms are those of diameter, psf z and psf plane.

    Attributes
    ----------
    image : SphereImage
        The image at the present values.
    pairs : list of tuple of SphereImage
        The image with one logarithm larger, and with it smaller, for each of the three.
    """

    image: SphereImage
    pairs: list[tuple[SphereImage, ...]]

    @classmethod
    def about(cls, log: Floats, voxel: tuple[float, float, float]) -> ImageVariations:
        """Return the variations about logarithms (3,), for voxels (z, y, x), um."""
        steps = _LOG_DIFFERENCE * np.eye(3)
        pairs = [tuple(_image_at(log + s * d, voxel) for s in (1, -1)) for d in steps]
        return cls(_image_at(log, voxel), pairs)

    def derivatives(self, intensity: Callable[[SphereImage], Floats]) -> Floats:
        """Return the derivatives (3, ...) of an intensity by the logarithms."""
        return np.stack(
            [
                (intensity(larger) - intensity(smaller)) / (2 * _LOG_DIFFERENCE)
                for larger, smaller in self.pairs
            ]
        )


class GroupSample(NamedTuple):
    """One group of spheres in one frame, from which the optics are learned.

    Attributes
    ----------
    frame : ndarray, shape (nz, ny, nx)
        Grey levels.
    centers, others : ndarray, shape (n, 3), (m, 3)
        Positions (z, y, x) of the group and of all other spheres, um.
    """

    frame: Floats
    centers: Floats
    others: Floats

    def window(self, image: SphereImage) -> Window:
        """Return the voxels of the fit."""
        return cut_window(self.frame, image, self.centers, others=self.others)

    def fit(self, variations: ImageVariations, noise: CameraNoise) -> SampleFit:
        """Fit positions, brightness and background, and return the information on the optics.

        Parameters
        ----------
        variations : ImageVariations
        noise : CameraNoise

        Returns
        -------
        SampleFit
        """
        image = variations.image
        window = self.window(image)
        fit = fit_window(window, image, noise, FreeCenters(self.centers))
        slope = variations.derivatives(
            lambda varied: fit.brightness @ window.spots(varied, fit.centers)[0]
        )
        # The Schur complement of the information, with the fit's own parameters eliminated.
        weighted = slope * fit.weight
        nuisance = fit.jacobian * fit.weight
        shared = nuisance @ slope.T
        taken = np.linalg.lstsq(nuisance @ fit.jacobian.T, shared, rcond=None)[0]
        residual = window.data - fit.expected
        information = weighted @ slope.T - shared.T @ taken
        score = weighted @ residual - taken.T @ (nuisance @ residual)
        return SampleFit(fit.centers, information, score, fit.expected, residual**2)


class CrowdSample(NamedTuple):
    """A piece of a frame full of touching spheres, from which the optics are learned.

    Attributes
    ----------
    frame : ndarray, shape (nz, ny, nx)
        Grey levels.
    centers, others : ndarray, shape (n, 3), (m, 3)
        Positions (z, y, x) of the crowd and of all other spheres, um.
    contact : float
        Centre distance of touching spheres, um.
    """

    frame: Floats
    centers: Floats
    others: Floats
    contact: float

    def fit(self, variations: ImageVariations, noise: CameraNoise) -> SampleFit:
        """Fit positions, brightness and background, and return the information on the optics.

        Parameters
        ----------
        variations : ImageVariations
        noise : CameraNoise

        Returns
        -------
        SampleFit
        """
        found = fit_crowd(
            self.frame,
            self.centers,
            others=self.others,
            contact=self.contact,
            image=variations.image,
            noise=noise,
            searches=_LEARNING_SEARCHES,
        )
        window, state = found.window, found.intensity
        slope = variations.derivatives(
            lambda varied: sum_of_spheres(
                window, window.spots(varied, state.centers), state.brightness
            )
        )
        information, score = profile_information(window, state, slope)
        used = window.mask
        residual = (window.data - state.expected)[used]
        return SampleFit(state.centers, information, score, state.expected[used], residual**2)


def _image_at(log: Floats, voxel: tuple[float, float, float]) -> SphereImage:
    """Return the image for the logarithms of diameter, psf z and psf plane."""
    size, psf_z, psf = np.exp(log)
    return sphere_image(diameter=float(size), psf=(float(psf_z), float(psf)), voxel=voxel)


def fit_samples(
    samples: Sequence[GroupSample | CrowdSample],
    *,
    diameter: float,
    voxel: tuple[float, float, float],
) -> Optics:
    """Find the sphere diameter, point spread and noise of greatest likelihood for all samples.

    Parameters
    ----------
    samples : sequence of GroupSample or CrowdSample
        Pieces of frames.
    diameter : float
        Diameter at the start of the search, um; the diameter of the result is fitted.
    voxel : tuple of float
        Voxel size (z, y, x), um.

    Returns
    -------
    Optics

    Raises
    ------
    NoSpheresError
        Without samples, or where the search does not converge.

    Notes
    -----
    Gauss-Newton steps in the logarithms of the three lengths, with every sphere's position and
    brightness and every background eliminated exactly (the Schur complement of the information).
    """
    log = np.log([diameter, max(voxel[0], 0.15 * diameter), max(voxel[1] / 2, 0.06 * diameter)])
    log[1] = max(log[1], _least_log_psf_z(log[2], voxel))
    image = _image_at(log, voxel)
    samples = [
        s
        for s in samples
        if isinstance(s, CrowdSample) or s.window(image).has_enough_voxels(len(s.centers))
    ]
    if not samples:
        raise NoSpheresError(
            "no spheres to learn the optics from: none was found, or none has voxels to itself; "
            "check diameter, contact and minmass, and whether spheres are dark (dark=True), state "
            "the optics (optics=), or keep the positions found first (refine=None)"
        )
    mean = float(np.mean([s.frame.mean() for s in samples]))
    noise = CameraNoise(1.0, 0.05 * abs(mean))
    for _ in range(_MAX_LEARNING_ROUNDS):
        variations = ImageVariations.about(log, voxel)
        fits = [s.fit(variations, noise) for s in samples]
        samples = [s._replace(centers=fit.centers) for s, fit in zip(samples, fits, strict=True)]
        information = np.sum([fit.information for fit in fits], axis=0)
        step = np.linalg.solve(information, np.sum([fit.score for fit in fits], axis=0))
        noise = photon_transfer(
            np.concatenate([fit.expected for fit in fits]),
            np.concatenate([fit.squared_residual for fit in fits]),
        )
        log = log + step * min(1.0, _MAX_LOG_STEP / np.abs(step).max())
        log[1] = max(log[1], _least_log_psf_z(log[2], voxel))
        if np.abs(step).max() < _LOG_STEP_CONVERGED:
            break
    else:
        raise NoSpheresError(
            f"sphere size and point spread do not converge: diameter {np.exp(log[0]):.3g}, psf "
            f"({np.exp(log[1]):.3g}, {np.exp(log[2]):.3g}) um after {_MAX_LEARNING_ROUNDS} rounds "
            f"on {len(samples)} groups: are these spheres, bright enough, or dark (dark=True), and "
            "is the voxel size right? State the optics (optics=), or keep the positions found "
            "first (refine=None)"
        )
    size, psf_z, psf = (float(v) for v in np.exp(log))
    error = np.exp(log) * np.sqrt(np.diag(np.linalg.inv(information)))
    return Optics(size, (psf_z, psf), noise, (float(error[0]), float(error[1]), float(error[2])))


def _least_log_psf_z(log_psf: float, voxel: tuple[float, float, float]) -> float:
    """Return the logarithm of the least point spread along z: that of a microscope is elongated.

    With the widths of the voxels the blur along z stays the larger one, in all variations too.
    """
    plane = np.exp(2 * (log_psf + _LOG_DIFFERENCE)) + (voxel[1] * voxel[2] - voxel[0] ** 2) / 12
    narrowest = np.exp(2 * log_psf)
    return 0.5 * float(np.log(max(plane, narrowest))) + _LOG_DIFFERENCE + 1e-3


def photon_transfer(expected: Floats, squared_residual: Floats) -> CameraNoise:
    """Return gain and floor of the camera from the growth of the variance with the mean.

    Parameters
    ----------
    expected : ndarray, shape (m,)
        Expected grey levels.
    squared_residual : ndarray, shape (m,)
        Squared differences of grey levels and expected grey levels.

    Returns
    -------
    CameraNoise
        A negative gain (of a processed image) is replaced by 0 and a constant variance.

    Examples
    --------
    >>> noise = photon_transfer(np.array([10.0, 20.0, 30.0]), np.array([34.0, 64.0, 94.0]))
    >>> round(noise.gain, 6), round(noise.floor, 6)
    (3.0, 4.0)
    """
    design = np.stack([expected, np.ones_like(expected)])
    noise = CameraNoise(0.0, float(squared_residual.mean()))
    for _ in range(4):
        weighted = design * noise.weight(expected) ** 2
        gain, floor = np.linalg.solve(weighted @ design.T, weighted @ squared_residual)
        if gain <= 0:
            return CameraNoise(0.0, float(squared_residual.mean()))
        noise = CameraNoise(float(gain), float(floor))
    return noise
