"""The radial image of a sphere and the camera's noise, learned from the frames of a plane."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from perrin.errors import NoSpheresError
from perrin.images.optics.neighbours import neighbour_variance
from perrin.images.optics.optics import CameraNoise, photon_transfer
from perrin.images.optics.radial_image import (
    Patch,
    PatchFit,
    RadialImage,
    TransmissionNoise,
    cut_patch,
    fit_patch,
    spline_design,
)

if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import TypeAlias

    from perrin._arrays import Floats

    PixelNoise: TypeAlias = CameraNoise | TransmissionNoise


# Distances of the knots and ends of the image that are tried, in contact distances.
_SPACINGS, _REACHES = (0.05, 0.03, 0.08, 0.12), (0.8, 0.65, 1.1)

# Least distance of the knots, pixels.
_LEAST_SPACING = 0.4

# Number of samples above which knots and ends are compared with half of them.
_COMPARED = 20

# Standard errors by which chi-squared of other spheres must be lower with more coefficients.
_CLEARLY_BETTER = 1.0

_MAX_ROUNDS = 20

# Median brightness of spheres in its standard errors, and the round from which it is required.
_LEAST_SIGNIFICANCE, _JUDGED = 4.0, 2

# The search ends where a step is this far in squared standard errors, for each coefficient.
_SETTLED = 0.01

# Largest such step after the last round that is a failure.
_UNSETTLED = 1.0

# Brightness below which a spot is no sphere, over the median of the spheres.
LEAST_BRIGHTNESS = 0.3

# Least number of pixels for each coefficient of the image.
_PIXELS_PER_COEFFICIENT = 10


class RadialSample(NamedTuple):
    """Spheres of one frame from which the image is learned, all those near them included.

    Attributes
    ----------
    frame : ndarray, shape (ny, nx)
        Grey levels.
    centers, others : ndarray, shape (n, 2), (m, 2)
        Positions (y, x) of these spheres, and of spheres whose pixels are not used, um.
    """

    frame: Floats
    centers: Floats
    others: Floats

    def patch(self, surroundings: float, reach: float, pixel: tuple[float, float]) -> Patch:
        """Return the pixels of the surroundings that no other sphere reaches."""
        patch = cut_patch(self.frame, self.centers, reach=surroundings, pixel=pixel)
        if not len(self.others):
            return patch
        free = (patch.offsets(self.others)[1] > reach).all(axis=0)
        return Patch(
            patch.place[:, free], patch.data[free], patch.background[:, free], patch.pixel[:, free]
        )


def noise_of_neighbours(
    patches: Sequence[Patch], fits: Sequence[PatchFit], noise: PixelNoise
) -> PixelNoise:
    """Return the camera's noise from the differences of neighbouring pixels (`neighbour_variance`).

    The residuals of a wrong image vary slowly, so that their differences show the noise alone, and
    chi-squared shows the wrong image.

    Parameters
    ----------
    patches : sequence of Patch
    fits : sequence of PatchFit
    noise : CameraNoise or TransmissionNoise
        The noise of the fits.

    Returns
    -------
    CameraNoise or TransmissionNoise
        Of the kind of `noise`.
    """
    levels, variances = [], []
    for patch, fit in zip(patches, fits, strict=True):
        place = tuple(patch.pixel - patch.pixel.min(axis=1, keepdims=True))
        residual, expected = np.zeros((2, *(patch.pixel.max(axis=1) - patch.pixel.min(axis=1) + 1)))
        used = np.zeros(residual.shape, dtype=np.bool_)
        residual[place], expected[place], used[place] = (
            patch.data - fit.expected,
            fit.expected,
            True,
        )
        level, variance = neighbour_variance(residual, expected, used, axis=1)
        levels.append(level)
        variances.append(variance)
    mean, square = np.concatenate(levels), np.concatenate(variances)
    if isinstance(noise, TransmissionNoise):
        grey = noise.grey(mean)
        found = photon_transfer(grey, square * (grey / noise.level) ** 2)
        return TransmissionNoise(found.gain, found.floor, noise.level)
    return photon_transfer(mean, square)


def first_image(
    samples: Sequence[RadialSample],
    *,
    spacing: float,
    reach: float,
    pixel: tuple[float, float],
    level: float | None = None,
) -> RadialImage:
    """Return the image of least squares for spheres of equal brightness at their first positions.

    Parameters
    ----------
    samples : sequence of RadialSample
    spacing, reach : float
        Distance of the knots, and about the end of the image, um.
    pixel : tuple of float
        Pixel size (y, x), um.
    level : float, optional
        Where the frames of the samples are logarithms, that of `TransmissionNoise`.

    Returns
    -------
    RadialImage
    """
    k = max(round(reach / spacing) - 1, 3)
    information, score, square, count = np.zeros((k, k)), np.zeros(k), 0.0, 0
    for sample in samples:
        patch = sample.patch(spacing * (k + 1), spacing * (k + 1), pixel)
        distance = patch.offsets(sample.centers)[1]
        design = spline_design(distance, spacing=spacing, k=k).sum(axis=0)
        # Without the part that the background explains.
        basis = np.linalg.qr(patch.background.T)[0]
        design, data = (a - (a @ basis) @ basis.T for a in (design, patch.data))
        information += design @ design.T
        score += design @ data
        square, count = square + float(data @ data), count + len(data)
    bend = np.diff(np.eye(k + 2), 2, axis=0)[:, :k]
    ridge = 1e-4 * np.trace(information) / k * bend.T @ bend
    coefficients = np.linalg.solve(information + ridge, score)
    mean = square / max(count, 1)
    if level is not None:
        return RadialImage(spacing, coefficients, TransmissionNoise(0.0, mean, level))
    return RadialImage(spacing, coefficients, CameraNoise(0.0, mean))


def settled_image(
    samples: Sequence[RadialSample], image: RadialImage, *, pixel: tuple[float, float]
) -> tuple[RadialImage, list[RadialSample], float]:
    """Return the image of greatest likelihood and the samples with fitted positions.

    Parameters
    ----------
    samples : sequence of RadialSample
    image : RadialImage
        The image at the start.
    pixel : tuple of float
        Pixel size (y, x), um.

    Returns
    -------
    image : RadialImage
        For spheres of mean brightness.
    samples : list of RadialSample
        Without spots that have less than 0.3 of the median brightness.
    step : float
        The last step in squared standard errors, for each coefficient.

    Notes
    -----
    Gauss-Newton steps in the coefficients, with every sphere's position and brightness and every
    background eliminated exactly (the Schur complement of the information).
    """
    samples, step = list(samples), np.inf
    for k in range(_MAX_ROUNDS):
        patches = [s.patch(image.surroundings, image.reach, pixel) for s in samples]
        enough = [
            p.has_enough_pixels(len(s.centers)) for p, s in zip(patches, samples, strict=True)
        ]
        samples = [s for s, good in zip(samples, enough, strict=True) if good]
        patches = [p for p, good in zip(patches, enough, strict=True) if good]
        if sum(len(p.data) for p in patches) < _PIXELS_PER_COEFFICIENT * len(image.coefficients):
            return image, samples, np.inf
        fits = [fit_patch(p, image, s.centers) for p, s in zip(patches, samples, strict=True)]
        noise = noise_of_neighbours(patches, fits, image.noise)
        m = len(image.coefficients)
        information, score = np.zeros((m, m)), np.zeros(m)
        for patch, fit in zip(patches, fits, strict=True):
            distance = patch.offsets(fit.centers)[1]
            splines = spline_design(distance, spacing=image.spacing, k=m)
            design = np.tensordot(fit.brightness, splines, 1)
            weighted, slopes = design * fit.weight, fit.jacobian * fit.weight
            shared = slopes @ design.T
            taken = np.linalg.lstsq(fit.information, shared, rcond=1e-12)[0]
            residual = patch.data - fit.expected
            information += weighted @ design.T - shared.T @ taken
            score += weighted @ residual - taken.T @ (slopes @ residual)
        change = np.linalg.lstsq(information, score, rcond=1e-10)[0]
        step = float(change @ score) / len(score)
        brightness = np.concatenate([f.brightness for f in fits])
        typical = float(np.median(brightness))
        variances = [np.diag(f.covariance)[2 * n : 3 * n] for f in fits for n in (len(f.centers),)]
        error = np.sqrt(np.maximum(np.concatenate(variances), 1e-300))
        if k >= _JUDGED and not np.median(brightness / error) > _LEAST_SIGNIFICANCE:
            return image, samples, np.inf
        image = replace(image, coefficients=(image.coefficients + change) * typical, noise=noise)
        kept = [f.brightness > LEAST_BRIGHTNESS * typical for f in fits]
        samples = [
            s._replace(centers=f.centers[good])
            for s, f, good in zip(samples, fits, kept, strict=True)
            if good.any()
        ]
        if step < _SETTLED and k > 0:
            break
    return image, samples, step


def held_out_misfit(
    samples: Sequence[RadialSample],
    image: RadialImage,
    *,
    reach: float,
    pixel: tuple[float, float],
    noise: PixelNoise,
) -> Floats:
    """Return chi-squared of each sample that an image was not learned from, within a reach.

    Parameters
    ----------
    samples : sequence of RadialSample
    image : RadialImage
    reach : float
        Distance from the spheres of the pixels that are compared, um.
    pixel : tuple of float
        Pixel size (y, x), um.
    noise : CameraNoise or TransmissionNoise
        The noise, the same for all images that are compared.

    Returns
    -------
    ndarray, shape (n,)
    """
    out = []
    for sample in samples:
        patch = sample.patch(reach, reach, pixel)
        fit = fit_patch(patch, replace(image, noise=noise), sample.centers)
        out.append(fit.weight @ (patch.data - fit.expected) ** 2)
    return np.array(out)


def learn_image(
    samples: Sequence[RadialSample],
    *,
    contact: float,
    pixel: tuple[float, float],
    level: float | None = None,
) -> tuple[RadialImage, list[RadialSample]]:
    """Learn the image of a sphere; knots and end are those that predict other spheres best.

    Parameters
    ----------
    samples : sequence of RadialSample
        Spheres at the positions found first.
    contact : float
        Centre distance of touching spheres, um.
    pixel : tuple of float
        Pixel size (y, x), um.
    level : float, optional
        As in `first_image`.

    Returns
    -------
    image : RadialImage
    samples : list of RadialSample
        With fitted positions.

    Raises
    ------
    NoSpheresError
        Where there are too few spheres, the search does not converge, or their brightness is less
        than four of its standard errors.
    """
    widest, least = max(_REACHES) * contact, _LEAST_SPACING * min(pixel)
    samples = [
        s for s in samples if s.patch(widest, widest, pixel).has_enough_pixels(len(s.centers))
    ]
    chosen, noise = (_SPACINGS[0], _REACHES[0]), None
    tried: dict[tuple[float, float], Floats] = {}
    failed: set[tuple[float, float]] = set()
    apart = 2 if len(samples) > _COMPARED else 1
    halves = [samples[:: 2 * apart], samples[apart :: 2 * apart]]
    for turn in range(4 if halves[1] else 0):
        # By turns another distance of the knots and another end.
        options = _SPACINGS if turn % 2 else _REACHES
        for option in options:
            pair = (option, chosen[1]) if turn % 2 else (chosen[0], option)
            if pair in tried or pair in failed:
                continue
            spacing, reach = max(pair[0] * contact, least), pair[1] * contact
            image = first_image(halves[0], spacing=spacing, reach=reach, pixel=pixel, level=level)
            image, fitted, step = settled_image(halves[0], image, pixel=pixel)
            failed.add(pair)
            if step < _UNSETTLED:
                if noise is None:
                    # Later searches begin at the positions of the first.
                    noise, halves[0] = image.noise, fitted
                    halves[1] = settled_image(halves[1], image, pixel=pixel)[1]
                tried[pair] = held_out_misfit(
                    halves[1], image, reach=widest, pixel=pixel, noise=noise
                )
        if tried:
            # The fewest coefficients that are not clearly worse than the best. The samples are the
            # same for all, so that the error of a difference is that of its own spread.
            best = min(tried.values(), key=lambda chi2: float(chi2.sum()))
            good = [
                pair
                for pair, chi2 in tried.items()
                if np.sum(chi2 - best) <= _CLEARLY_BETTER * np.std(chi2 - best) * np.sqrt(len(best))
            ]
            chosen = min(good, key=lambda pair: pair[1] / pair[0])
    spacing, reach = max(chosen[0] * contact, least), chosen[1] * contact
    step = np.inf
    if samples and (tried or not halves[1]):
        image = first_image(samples, spacing=spacing, reach=reach, pixel=pixel, level=level)
        image, samples, step = settled_image(samples, image, pixel=pixel)
    if not step < _UNSETTLED:
        raise NoSpheresError(
            f"the image of a sphere cannot be learned from {sum(len(s.centers) for s in samples)} "
            "spots of this 2-D movie: do the spheres exceed the noise, have they one circular "
            "image of one size, and is contact right? refine=None finds filtered centroids"
        )
    return image, samples


def log_likelihood(
    samples: Sequence[RadialSample],
    image: RadialImage,
    *,
    reach: float,
    pixel: tuple[float, float],
) -> tuple[float, float]:
    """Return the logarithm of the likelihood of grey levels, and chi-squared per degree of freedom.

    Parameters
    ----------
    samples : sequence of RadialSample
    image : RadialImage
    reach : float
        Distance from the spheres of the pixels that count, um.
    pixel : tuple of float
        Pixel size (y, x), um.

    Returns
    -------
    likelihood, chi2 : float
        Up to a constant that is the same for images of grey levels and of their logarithms.
    """
    total, square, freedom = 0.0, 0.0, 0
    for sample in samples:
        patch = sample.patch(reach, reach, pixel)
        fit = fit_patch(patch, image, sample.centers)
        own = fit.weight * (patch.data - fit.expected) ** 2
        total += 0.5 * float(np.sum(np.log(fit.weight) - own))
        if isinstance(image.noise, TransmissionNoise):
            # A change of the grey level is that of its logarithm times level / grey.
            total -= float(np.sum(patch.data)) / image.noise.level
        square, freedom = square + float(own.sum()), freedom + max(len(own) - len(fit.jacobian), 1)
    return total, square / max(freedom, 1)


def size_spread(
    samples: Sequence[RadialSample], image: RadialImage, *, pixel: tuple[float, float]
) -> tuple[float, float]:
    """Return the spread of the sizes of the images of spheres, relative, and its standard error.

    Parameters
    ----------
    samples : sequence of RadialSample
    image : RadialImage
    pixel : tuple of float
        Pixel size (y, x), um.

    Returns
    -------
    spread, stderr : float
        Root of the variance of the logarithm of the size, less that of the noise.

    Notes
    -----
    One step of Gauss-Newton in a size of its own for every sphere, together with all parameters
    of its fit.
    """
    sizes, variances = [], []
    for sample in samples:
        patch = sample.patch(image.surroundings, image.reach, pixel)
        if not patch.has_enough_pixels(2 * len(sample.centers)):
            continue
        fit = fit_patch(patch, image, sample.centers)
        distance = patch.offsets(fit.centers)[1]
        slope = image.value_and_slope(distance)[1]
        design = np.concatenate([-fit.brightness[:, None] * slope * distance, fit.jacobian])
        weighted = design * fit.weight
        covariance = np.linalg.pinv(weighted @ design.T, hermitian=True)
        n = len(fit.centers)
        sizes.append((covariance @ (weighted @ (patch.data - fit.expected)))[:n])
        variances.append(np.diag(covariance)[:n])
    if not sizes:
        return 0.0, np.inf
    size, variance = np.concatenate(sizes), np.concatenate(variances)
    square = (size - size.mean()) ** 2 - variance
    excess, error = float(square.mean()), float(square.std()) / np.sqrt(len(size))
    spread = np.sqrt(max(excess, 0.0))
    return spread, error / max(2 * spread, np.sqrt(error), 1e-12)
