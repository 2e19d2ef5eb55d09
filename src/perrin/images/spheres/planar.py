"""Positions of the spheres of a 2-D movie, by the radial image that all of them share."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from perrin.errors import NoSpheresError, PrecisionWarning
from perrin.images.optics.learn_radial import (
    LEAST_BRIGHTNESS,
    RadialSample,
    first_image,
    learn_image,
    log_likelihood,
    size_spread,
)
from perrin.images.optics.radial_image import Patch, TransmissionNoise, cut_patch, fit_patch
from perrin.images.spheres.spots import touching_together

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from perrin._arrays import Floats, Ints
    from perrin.images.optics.radial_image import RadialImage
    from perrin.images.spheres.by_trackpy import Features


# Largest number of spheres that are fitted together.
_MOST_TOGETHER = 12

# Number of groups of spheres from which the image is learned.
_LEARNING_PLANAR_GROUPS = 40

# Contact distance in pixels below which twice as many are used, as each shows less.
_SMALL_SPHERES = 8

# Most fits of a group, between which those of its neighbours change, and the change of a position
# over the distance of the knots at which they end.
_MAX_SWEEPS, _SWEEP_CONVERGED = 12, 0.001

# Distance from the place found first, and distance of two spheres, in contact distances, from which
# a fit is that of another sphere.
_LEFT_PLACE, _SAME = 0.3, 0.6

# Spread of the sizes of the images, from which they are not those of equal spheres in a plane, and
# distance of the knots for its measurement, in contact distances.
_SIZE_SPREAD, _SIZE_KNOTS = 0.06, 0.12

# Chi-squared per degree of freedom above which images that multiply are tried, and the distance
# from the spheres of the pixels that are compared, in contact distances.
_MISFIT, _COMPARED_REACH = 1.03, 1.0

# Reasons for which a sphere is not refined.
_NO_IMAGE, _AWAY, _UNSETTLED_PLACE, _NO_PIXELS = (
    "no image of a sphere",
    "moved to another sphere",
    "fit did not settle",
    "no pixels of its own",
)


def fitted_together(centers: Floats, *, contact: float) -> list[Ints]:
    """Return spheres that are fitted together: chains of touching ones, long chains in parts.

    Parameters
    ----------
    centers : ndarray, shape (n, 2)
        Positions, um.
    contact : float
        Centre distance of touching spheres, um.

    Returns
    -------
    list of ndarray of int

    Examples
    --------
    >>> row = np.column_stack([np.arange(14.0), np.zeros(14)])
    >>> [len(group) for group in fitted_together(row, contact=1.0)]
    [7, 7]
    """
    whole, parts = touching_together(centers, contact=contact), []
    while whole:
        group = whole.pop()
        if len(group) <= _MOST_TOGETHER:
            parts.append(group)
            continue
        # In halves across its longest axis.
        x = centers[group] - centers[group].mean(axis=0)
        order = np.argsort(x @ np.linalg.svd(x, full_matrices=False)[2][0], kind="stable")
        half = len(group) // 2
        whole += [np.sort(group[order[:half]]), np.sort(group[order[half:]])]
    return parts


def learn_plane(
    frames: Sequence[Floats],
    places: Sequence[Floats],
    *,
    contact: float,
    pixel: tuple[float, float],
) -> RadialImage:
    """Learn the image of a sphere from a few frames of a plane.

    Parameters
    ----------
    frames : sequence of ndarray, shape (ny, nx)
        Grey levels.
    places : sequence of ndarray, shape (n, 2)
        Positions (y, x) of the spheres of each, as found first, um.
    contact : float
        Centre distance of touching spheres, um.
    pixel : tuple of float
        Pixel size (y, x), um.

    Returns
    -------
    RadialImage

    Raises
    ------
    NoSpheresError
        As in `learn_image`.

    Warns
    -----
    PrecisionWarning
        Where the images of the spheres differ in size.
    """
    samples = [
        RadialSample(frame, centers[group], np.delete(centers, group, axis=0))
        for frame, centers in zip(frames, places, strict=True)
        for group in fitted_together(centers, contact=contact)
    ]
    most = _LEARNING_PLANAR_GROUPS * (2 if contact < _SMALL_SPHERES * min(pixel) else 1)
    chosen = np.unique(np.linspace(0, len(samples) - 1, most).round().astype(int))
    samples = [samples[k] for k in chosen] if samples else []
    image, samples = _likelier_image(samples, contact=contact, pixel=pixel)
    # Fine knots can follow steps of several sizes, so that no size alone would fit better.
    coarse = first_image(
        samples,
        spacing=max(image.spacing, _SIZE_KNOTS * contact),
        reach=image.reach,
        pixel=pixel,
        level=image.noise.level if isinstance(image.noise, TransmissionNoise) else None,
    )
    spread, error = size_spread(samples, replace(coarse, noise=image.noise), pixel=pixel)
    if spread - 2.5 * error > _SIZE_SPREAD:
        warnings.warn(
            f"the images of the spheres differ in size by {100 * spread:.0f} % (rms), so that no "
            "one image describes them: are they spheres of different sizes, or at different "
            "heights? In a slice through bodies that turn out of the plane, circles grow and "
            "shrink, and D_R and D_T are not those of the bodies: record whole stacks",
            PrecisionWarning,
            stacklevel=4,
        )
    return image


def _likelier_image(
    samples: Sequence[RadialSample], *, contact: float, pixel: tuple[float, float]
) -> tuple[RadialImage, list[RadialSample]]:
    """Return the image under which the samples are likelier: of grey levels, or of logarithms.

    Images of fluorescent spheres add, their transmissions in bright field multiply. Logarithms are
    tried where images that add leave residuals.
    """
    image, fitted = learn_image(samples, contact=contact, pixel=pixel)
    reach = _COMPARED_REACH * contact
    likelihood, chi2 = log_likelihood(fitted, image, reach=reach, pixel=pixel)
    levels = np.array([np.median(s.frame) for s in samples])
    if chi2 < _MISFIT or not levels.min() > 0:
        return image, fitted
    noise = TransmissionNoise(0.0, 1.0, float(np.median(levels)))
    logarithms = [s._replace(frame=noise.logarithm(s.frame)) for s in fitted]
    try:
        other, moved = learn_image(logarithms, contact=contact, pixel=pixel, level=noise.level)
    except NoSpheresError:
        return image, fitted
    if log_likelihood(moved, other, reach=reach, pixel=pixel)[0] > likelihood:
        return other, moved
    return image, fitted


class PlaneFit(NamedTuple):
    """The spheres of one frame of a plane.

    Attributes
    ----------
    centers, sigma : ndarray, shape (n, 2)
        Positions (y, x) and their standard errors, um; not refined spheres are where they were
        found, without errors.
    brightness : ndarray, shape (n,)
        Brightness relative to the learned image.
    chi2 : ndarray, shape (n,)
        Chi-squared per degree of freedom of the fit of each sphere's group.
    reason : ndarray of str, shape (n,)
        Why a sphere is not refined, or "".
    """

    centers: Floats
    sigma: Floats
    brightness: Floats
    chi2: Floats
    reason: NDArray[Any]

    def sweep(
        self,
        frame: Floats,
        first: Floats,
        *,
        contact: float,
        image: RadialImage,
        pixel: tuple[float, float],
    ) -> None:
        """Fit every group of the spheres in turn, until positions stay; the arrays are changed.

        Parameters
        ----------
        frame : ndarray, shape (ny, nx)
            Grey levels, or their logarithms (`RadialImage.seen_in`).
        first : ndarray, shape (n, 2)
            Positions (y, x) as found first, um.
        contact, image, pixel
            Those of `fit_plane`.
        """
        there = np.flatnonzero((self.reason == "") | (self.reason == _UNSETTLED_PLACE))
        groups = [there[g] for g in fitted_together(first[there], contact=contact)]
        overlap = image.reach + image.surroundings + 0.1 * contact
        away = np.linalg.norm(first[there][:, None] - first[there], axis=2)
        beside = []
        for group in groups:
            near = (away[np.isin(there, group)] < overlap).any(axis=0) & ~np.isin(there, group)
            beside.append(there[near])
        again = np.ones(len(groups), dtype=np.bool_)
        for _ in range(_MAX_SWEEPS):
            moved = np.zeros(len(first))
            for group, others in ((groups[k], beside[k]) for k in np.flatnonzero(again)):
                before = self.centers[group]
                self.refit(frame, group, others, image=image, pixel=pixel)
                moved[group] = np.abs(self.centers[group] - before).max()
            change = _SWEEP_CONVERGED * image.spacing
            again = np.array([len(o) > 0 and bool((moved[o] > change).any()) for o in beside])
            if not again.any():
                break

    def refit(
        self,
        frame: Floats,
        group: Ints,
        others: Ints,
        *,
        image: RadialImage,
        pixel: tuple[float, float],
    ) -> None:
        """Fit one group of spheres, with the images of the others subtracted.

        The elements of the group in the arrays are changed.

        Parameters
        ----------
        frame : ndarray, shape (ny, nx)
            Grey levels, or their logarithms (`RadialImage.seen_in`).
        group, others : ndarray of int
            Indices of the spheres of the group, and of those beside it.
        image, pixel
            Those of `fit_plane`.
        """
        patch = cut_patch(frame, self.centers[group], reach=image.surroundings, pixel=pixel)
        if not patch.has_enough_pixels(len(group)):
            self.reason[group] = _NO_PIXELS
            return
        known = np.zeros(len(patch.data))
        if len(others):
            known = self.brightness[others] @ image.value(patch.offsets(self.centers[others])[1])
            patch = Patch(patch.place, patch.data - known, patch.background, patch.pixel)
        found = fit_patch(patch, image, self.centers[group], known=known)
        n = len(group)
        self.chi2[group] = found.chi2
        if not (found.converged and np.isfinite(found.centers).all()):
            dim = ~(found.brightness > LEAST_BRIGHTNESS * np.median(found.brightness))
            self.reason[group] = np.where(dim, _NO_IMAGE, _UNSETTLED_PLACE)
            return
        self.reason[group] = ""
        self.centers[group], self.brightness[group] = found.centers, found.brightness
        variance = np.diag(found.covariance)[: 2 * n]
        self.sigma[group] = np.sqrt(np.maximum(variance, 0.0)).reshape(n, 2)


def fit_plane(
    frame: Floats,
    centers: Floats,
    *,
    contact: float,
    image: RadialImage,
    pixel: tuple[float, float],
) -> PlaneFit:
    """Fit all spheres of a frame of a plane.

    Parameters
    ----------
    frame : ndarray, shape (ny, nx)
        Grey levels.
    centers : ndarray, shape (n, 2)
        Positions (y, x) as found first, um.
    contact : float
        Centre distance of touching spheres, um.
    image : RadialImage
        The image of a sphere.
    pixel : tuple of float
        Pixel size (y, x), um.

    Returns
    -------
    PlaneFit

    Notes
    -----
    Touching spheres are fitted together, with their brightness and a level and a slope of the
    background, where the images of all other spheres are subtracted; fits are repeated until
    positions stay. Spots with less than 0.3 of the median brightness, and the fainter one of two
    that move to one place, are no spheres and are left out of the fits of the others.

    Examples
    --------
    >>> from perrin.images.optics.optics import CameraNoise
    >>> from perrin.images.optics.radial_image import RadialImage
    >>> image = RadialImage(0.3, np.array([100.0, 80.0, 30.0]), CameraNoise(1.0, 0.0))
    >>> y, x = np.meshgrid(0.2 * np.arange(30), 0.2 * np.arange(30), indexing="ij")
    >>> truth = np.array([[2.03, 1.87], [2.95, 2.61]])
    >>> frame = 5 + sum(image.value(np.hypot(y - a, x - b)) for a, b in truth)
    >>> fit = fit_plane(frame, truth.round(1), contact=1.2, image=image, pixel=(0.2, 0.2))
    >>> fit.centers.round(4).tolist() == truth.tolist()
    True
    """
    n, frame = len(centers), image.seen_in(frame)
    fit = PlaneFit(
        centers.copy(),
        np.full((n, 2), np.nan),
        np.ones(n),
        np.full(n, np.nan),
        np.full(n, "", dtype=object),
    )
    for _ in range(n + 1):
        before = fit.reason.copy()
        fit.sweep(frame, centers, contact=contact, image=image, pixel=pixel)
        # Spots whose fits show no sphere, or that of another spot.
        good = fit.reason == ""
        typical = float(np.median(fit.brightness[good])) if good.any() else 0.0
        dim = good & ~(fit.brightness > LEAST_BRIGHTNESS * typical)
        moved = np.linalg.norm(fit.centers - centers, axis=1)
        away = good & (moved > _LEFT_PLACE * contact)
        close = np.linalg.norm(fit.centers[:, None] - fit.centers, axis=2) < _SAME * contact
        for i, j in np.argwhere(np.triu(close & good & good[:, None], 1)):
            away[i if moved[i] > moved[j] else j] = True
        fit.reason[dim], fit.reason[away & ~dim] = _NO_IMAGE, _AWAY
        # Without the spots that were marked now, the others may be spheres.
        if not np.isin(fit.reason[before != fit.reason], (_NO_IMAGE, _AWAY)).any():
            break
    failed = fit.reason != ""
    fit.centers[failed], fit.sigma[failed] = centers[failed], np.nan
    return fit


def plane_columns(
    frame: Floats,
    found: Features,
    *,
    contact: float,
    image: RadialImage,
    pixel: tuple[float, float],
) -> dict[str, NDArray[Any]]:
    """Return the columns of the table of `locate` for one frame of a plane.

    Parameters
    ----------
    frame : ndarray, shape (ny, nx)
        Grey levels.
    found : Features
        The spheres of the frame as they were found first.
    contact : float
        Centre distance of touching spheres, um.
    image : RadialImage
        The image of a sphere.
    pixel : tuple of float
        Pixel size (y, x), um.

    Returns
    -------
    dict of ndarray
    """
    fit = fit_plane(frame, found.centers[:, 1:], contact=contact, image=image, pixel=pixel)
    return {
        "x": fit.centers[:, 1],
        "y": fit.centers[:, 0],
        "mass": found.mass,
        "sigma_x": fit.sigma[:, 1],
        "sigma_y": fit.sigma[:, 0],
        "chi2": fit.chi2,
        "refined": fit.reason == "",
        "reason": fit.reason,
    }
