"""Optics learned from frames: sphere diameter, point spread and camera noise; and saturation."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
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

    from perrin._arrays import Bools, Floats
    from perrin.images.optics.window_fit import Window


# Change of a logarithm for the central differences.
_LOG_DIFFERENCE = 0.01

# Largest step of a logarithm, and the step at which the search ends.
_MAX_LOG_STEP, _LOG_STEP_CONVERGED = 0.25, 1e-3

_MAX_LEARNING_ROUNDS = 15

# What is no sphere has over this multiple of the usual chi-squared, beyond this number of standard
# errors of it, or over this multiple of the usual brightness, beyond this number of standard
# deviations.
_WORST_CHI2, _CHI2_DEVIATIONS, _BRIGHTEST, _BRIGHT_DEVIATIONS = 1.6, 6.0, 1.4, 8.0

# Searches for the optics, each without the samples that the one before found to be no spheres.
_MAX_SEARCHES, _FEWEST_SAMPLES = 4, 2

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
    brightness : ndarray, shape (n,)
        Fitted intensity inside each sphere, grey levels.
    """

    centers: Floats
    information: Floats
    score: Floats
    expected: Floats
    squared_residual: Floats
    brightness: Floats

    def chi2(self, noise: CameraNoise) -> float:
        """Return the mean squared residual over the variance that a camera noise predicts."""
        return float(np.mean(self.squared_residual * noise.weight(self.expected)))


@dataclass(frozen=True)
class UsualImage:
    """What the images of the spheres of a movie have in common.

    Attributes
    ----------
    chi2 : float
        Chi-squared per degree of freedom of the fits to spheres: over 1 where the model of the
        image is not exact.
    brightness : float
        Median intensity inside a sphere, grey levels; negative for dark spheres.
    spread : float
        Standard deviation of its logarithm over the spheres, from the median deviation.
    left_out : int
        Number of groups that were left out in learning it, because they are no spheres.

    Examples
    --------
    >>> usual = UsualImage(1.0, 100.0, 0.1)
    >>> usual.brightest, UsualImage(1.0, 100.0, 0.3).brightest > 2 * usual.brightest
    (2.225540928492468, True)
    """

    chi2: float
    brightness: float
    spread: float
    left_out: int = 0

    @classmethod
    def of(cls, chi2: Sequence[float], brightness: Sequence[Floats]) -> UsualImage:
        """Return what most spheres of some groups have in common.

        Parameters
        ----------
        chi2 : sequence of float
            Chi-squared per degree of freedom of the fit to each group.
        brightness : sequence of ndarray
            Intensity inside each sphere of each group.
        """
        count = [len(b) for b in brightness]
        every = np.concatenate(brightness)
        median = float(np.median(every))
        relative = every[every * median > 0] / median
        deviation = np.median(np.abs(np.log(relative))) if relative.size else 0.0
        # A low quantile, because what is no sphere has a larger chi-squared.
        return cls(float(np.quantile(np.repeat(chi2, count), 0.25)), median, 1.4826 * deviation)

    def to_dict(self) -> dict[str, Any]:
        """Return the values for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, entry: dict[str, Any]) -> UsualImage:
        """Return the values that `to_dict` wrote."""
        return cls(**entry)

    @property
    def worst_chi2(self) -> float:
        """Return the largest chi-squared per degree of freedom of a sphere."""
        return _WORST_CHI2 * self.chi2

    @property
    def brightest(self) -> float:
        """Return the largest brightness of a sphere over the median."""
        return max(_BRIGHTEST, float(np.exp(_BRIGHT_DEVIATIONS * self.spread)))

    def excess(self, chi2: Floats, brightness: Floats, *, voxels: Floats) -> Floats:
        """Return how far images are from those of spheres: over 1 for what is no single sphere.

        Parameters
        ----------
        chi2 : ndarray, shape (n,)
            Chi-squared per voxel, averaged over the voxels of each sphere.
        brightness : ndarray, shape (n,)
            Intensity inside each sphere over the usual one in this frame and depth.
        voxels : ndarray, shape (n,)
            Number of voxels in each sphere.
        """
        bound = self.chi2 * np.maximum(_WORST_CHI2, _chance(voxels))
        return np.maximum(chi2 / bound, brightness / self.brightest)

    def disturbed(self, chi2: Floats, *, voxels: Floats) -> Bools:
        """Return which images of spheres have more residual than chance leaves.

        Parameters
        ----------
        chi2, voxels : ndarray, shape (n,)
            As in `excess`.
        """
        return np.asarray(chi2 > self.chi2 * _chance(voxels))


def _chance(voxels: Floats) -> Floats:
    """Return the largest ratio of a chi-squared per voxel to the usual one by chance."""
    return 1 + _CHI2_DEVIATIONS * np.sqrt(2 / np.maximum(voxels, 1.0))


class LearnedOptics(NamedTuple):
    """Optics that were learned from samples of frames.

    Attributes
    ----------
    optics : Optics
        Sphere diameter, point spread and noise.
    usual : UsualImage
        What the images of the spheres have in common.
    """

    optics: Optics
    usual: UsualImage


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
        return SampleFit(fit.centers, information, score, fit.expected, residual**2, fit.brightness)


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
        return SampleFit(
            state.centers, information, score, state.expected[used], residual**2, state.brightness
        )


def _image_at(log: Floats, voxel: tuple[float, float, float]) -> SphereImage:
    """Return the image for the logarithms of diameter, psf z and psf plane."""
    size, psf_z, psf = np.exp(log)
    return sphere_image(diameter=float(size), psf=(float(psf_z), float(psf)), voxel=voxel)


def fit_samples(
    samples: Sequence[GroupSample | CrowdSample],
    *,
    diameter: float,
    voxel: tuple[float, float, float],
) -> LearnedOptics:
    """Find the sphere diameter, point spread and noise of greatest likelihood for most samples.

    Samples whose images are not those of spheres (dust, spheres that the border cuts) are left out.

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
    LearnedOptics

    Raises
    ------
    NoSpheresError
        Without samples, or where the search does not converge.

    Notes
    -----
    Gauss-Newton steps in the logarithms of the three lengths, with every sphere's position and
    brightness and every background eliminated exactly (the Schur complement of the information).
    """
    left_out = 0
    for _ in range(_MAX_SEARCHES):
        optics, samples, fits = _search_optics(samples, diameter=diameter, voxel=voxel)
        chi2 = [fit.chi2(optics.noise) for fit in fits]
        usual = UsualImage.of(chi2, [fit.brightness for fit in fits])
        kept = [
            s
            for s, fit, square in zip(samples, fits, chi2, strict=True)
            if usual.excess(
                np.full(len(fit.brightness), square),
                fit.brightness / usual.brightness,
                voxels=np.full(len(fit.brightness), len(fit.expected) / len(fit.brightness)),
            ).max(initial=0.0)
            <= 1
        ]
        if len(kept) == len(samples) or len(kept) < _FEWEST_SAMPLES:
            break
        left_out += len(samples) - len(kept)
        samples = kept
    return LearnedOptics(optics, replace(usual, left_out=left_out))


def _search_optics(
    samples: Sequence[GroupSample | CrowdSample],
    *,
    diameter: float,
    voxel: tuple[float, float, float],
) -> tuple[Optics, list[GroupSample | CrowdSample], list[SampleFit]]:
    """Return the optics of greatest likelihood, the samples with enough voxels, and their fits."""
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
    stderr = (float(error[0]), float(error[1]), float(error[2]))
    return Optics(size, (psf_z, psf), noise, stderr), samples, fits


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
