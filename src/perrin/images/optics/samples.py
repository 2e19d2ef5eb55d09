"""Pieces of frames from which the optics are learned, and fits to them."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from perrin.images.optics.crowd_equations import profile_information, slopes_of_spheres
from perrin.images.optics.crowd_fit import fit_crowd
from perrin.images.optics.neighbours import THIRD_DIFFERENCE, neighbour_variance
from perrin.images.optics.window_fit import FreeCenters, cut_window, fit_window
from perrin.tracks.groups import TOUCHING_REACH

if TYPE_CHECKING:
    from collections.abc import Sequence

    from perrin._arrays import Bools, Floats
    from perrin.images.optics.ball_image import SphereImage
    from perrin.images.optics.crowd_fit import CrowdFit
    from perrin.images.optics.image_parameters import ImageVariations
    from perrin.images.optics.optics import CameraNoise
    from perrin.images.optics.window_fit import Window

# What is no sphere has over this multiple of the usual chi-squared, beyond this number of standard
# errors of it, or over this multiple of the usual brightness, beyond this number of standard
# deviations.
_WORST_CHI2, _CHI2_DEVIATIONS, _BRIGHTEST, _BRIGHT_DEVIATIONS = 1.6, 6.0, 1.4, 8.0

# Searches of a crowd's residuals for missing spheres, in every round.
_LEARNING_SEARCHES = 2


class SampleFit(NamedTuple):
    """A fit to one sample of a frame, and its information on the optics.

    Attributes
    ----------
    centers : ndarray, shape (n, 3)
        Fitted positions (z, y, x), um.
    information : ndarray, shape (k, k)
        Information on the k parameters of the image, the parameters of the spheres eliminated.
    score : ndarray, shape (k,)
        Score of these parameters.
    expected, squared_residual : ndarray, shape (m,)
        Expected grey levels of the voxels of the fit, and squared differences of their grey levels
        from these, without those that flicker explains.
    brightness : ndarray, shape (n,)
        Fitted intensity inside each sphere, grey levels.
    level, variance : ndarray, shape (q,)
        Expected grey levels of groups of neighbouring voxels, and estimates of the variance of
        these voxels from their differences (`neighbour_variance`).
    sizes, size_variance : ndarray, shape (n,)
        Deviations of the logarithms of the diameters and their variances, where they are fitted.
    residual : ndarray, shape (m,)
        Grey levels minus expected grey levels.
    mask : ndarray of bool, shape (nz, ny, nx)
        The voxels of the fit.
    """

    centers: Floats
    information: Floats
    score: Floats
    expected: Floats
    squared_residual: Floats
    brightness: Floats
    level: Floats
    variance: Floats
    sizes: Floats
    size_variance: Floats
    residual: Floats
    mask: Bools

    def chi2(self, noise: CameraNoise) -> float:
        """Return the mean squared residual over the variance that a camera noise predicts."""
        return float(np.mean(self.squared_residual * noise.weight(self.expected)))

    def variance_along(self, axis: int) -> tuple[Floats, Floats]:
        """Return `neighbour_variance` of the voxels of the fit along an axis."""
        return _variance_along(axis, self.mask, self.residual, self.expected)


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

    def has_enough_voxels(self, image: SphereImage) -> bool:
        """Return whether there are enough voxels to fit the spheres with an image."""
        return self.window(image).has_enough_voxels(len(self.centers))

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
        slope = window.slopes(image, variations.slopes, fit.centers, fit.brightness, fit.sizes)
        if variations.moments is not None:
            knots, widths, heights = variations.moments
            more = window.moment_slopes(
                image, knots, widths, fit.centers, fit.brightness, heights=heights
            )
            slope = np.concatenate([slope, more])
        # The Schur complement of the information, with the fit's own parameters eliminated.
        weighted = fit.precision.times(slope)
        nuisance = fit.precision.times(fit.jacobian)
        shared = nuisance @ slope.T
        own = nuisance @ fit.jacobian.T + np.diag(fit.prior)
        taken = np.linalg.lstsq(own, shared, rcond=None)[0]
        residual = window.data - fit.expected
        information = weighted @ slope.T - shared.T @ taken
        left_over = nuisance @ residual
        if image.spread > 0:
            left_over[fit.prior > 0] -= fit.sizes / image.spread**2
        score = weighted @ residual - taken.T @ left_over
        # Flicker is noise that the voxels of a line have in common.
        flickers = noise.correlated and not noise.pixel
        axis = 2 if flickers else _most_blurred_axis(image, window.mask.shape)
        level, variance = _variance_along(axis, window.mask, residual, fit.expected)
        return SampleFit(
            fit.centers,
            information,
            score,
            fit.expected,
            fit.precision.left(residual) ** 2,
            fit.brightness,
            level,
            variance,
            fit.sizes,
            fit.size_variance,
            residual,
            window.mask,
        )

    def log_likelihood(
        self, image: SphereImage, noise: CameraNoise, *, within: SphereImage
    ) -> float:
        """Return the logarithm of the likelihood of the group's voxels, up to a constant.

        The variance of the factors of flicker, which the image hardly changes, is left out.

        Parameters
        ----------
        image : SphereImage
            The image with which the group is fitted.
        noise : CameraNoise
        within : SphereImage
            The image that sets the voxels.

        Returns
        -------
        float
        """
        window = self.window(within)
        fit = fit_window(window, image, noise, FreeCenters(self.centers))
        residual = window.data - fit.expected
        square = residual * fit.precision.times(residual)
        return -0.5 * float(np.sum(square - np.log(fit.weight)))


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

    def has_enough_voxels(self, image: SphereImage) -> bool:  # noqa: ARG002
        """Return True: crowds have voxels of their own."""
        return True

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
        slope = slopes_of_spheres(window, variations.slopes, state.centers, state.brightness)
        information, score = profile_information(window, state, slope)
        residual = window.data - state.expected
        used = window.mask
        axis = _most_blurred_axis(variations.image, used.shape)
        level, variance = neighbour_variance(residual, state.expected, used, axis=axis)
        equal = np.zeros(len(state.centers))
        return SampleFit(
            state.centers,
            information,
            score,
            state.expected[used],
            residual[used] ** 2,
            state.brightness,
            level,
            variance,
            equal,
            equal,
            residual[used],
            used,
        )


def _variance_along(
    axis: int, mask: Bools, residual: Floats, expected: Floats
) -> tuple[Floats, Floats]:
    """Return `neighbour_variance` of the voxels (m,) of a window."""
    left, level = np.zeros((2, *mask.shape))
    left[mask], level[mask] = residual, expected
    return neighbour_variance(left, level, mask, axis=axis)


def _most_blurred_axis(image: SphereImage, shape: tuple[int, ...]) -> int:
    """Return the axis along which the blur covers most voxels, of those with four neighbours."""
    blur = np.array([image.blur[0], image.blur[1], image.blur[1]]) / image.voxel
    return int(np.argmax(np.where(np.array(shape) >= len(THIRD_DIFFERENCE), blur, -1.0)))


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
        deviation = float(np.median(np.abs(np.log(relative)))) if relative.size else 0.0
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

    def group_within(
        self, crowd: CrowdFit, *, level: float, count: int, contact: float
    ) -> CrowdFit | None:
        """Return those spheres of a crowd's fit that are a group and have the usual image.

        These are the spots of its start, and spheres that touch one of them.

        Parameters
        ----------
        crowd : CrowdFit
        level : float
            The usual brightness in this frame and depth, grey levels.
        count : int
            Number of spots of the start.
        contact : float
            Centre distance of touching spheres, um.

        Returns
        -------
        CrowdFit or None
            None if a spot of the start is no such sphere.
        """
        same = (crowd.centers[:, None] == crowd.intensity.centers).all(axis=2)
        bright = crowd.intensity.brightness[same.argmax(axis=1)] / level
        good = (crowd.chi2 <= self.worst_chi2) & (bright < self.brightest)
        good &= bright > 1 / self.brightest
        start = crowd.origin >= 0
        if not set(range(count)) <= set(crowd.origin[good].tolist()):
            return None
        away = np.linalg.norm(crowd.centers[:, None] - crowd.centers[start], axis=2).min(axis=1)
        good &= start | (away < TOUCHING_REACH * contact)
        return crowd._replace(
            centers=crowd.centers[good],
            sigma=crowd.sigma[good],
            chi2=crowd.chi2[good],
            converged=crowd.converged[good],
            origin=crowd.origin[good],
        )

    def spheres_among(
        self,
        samples: Sequence[GroupSample | CrowdSample],
        fits: Sequence[SampleFit],
        *,
        noise: CameraNoise,
    ) -> list[GroupSample | CrowdSample]:
        """Return the samples whose images are those of spheres, by the fits to them."""
        return [
            s
            for s, fit in zip(samples, fits, strict=True)
            if self.excess(
                np.full(len(fit.brightness), fit.chi2(noise)),
                fit.brightness / self.brightness,
                voxels=np.full(len(fit.brightness), len(fit.expected) / len(fit.brightness)),
            ).max(initial=0.0)
            <= 1
        ]

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
