"""Optics learned from frames: sphere diameter, point spread and camera noise."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from perrin.errors import NoSpheresError
from perrin.images.optics.image_parameters import ImageParameters
from perrin.images.optics.learn_moments import MomentFit
from perrin.images.optics.likeliest import LikeliestOptics
from perrin.images.optics.optics import CameraNoise, Optics

if TYPE_CHECKING:
    from collections.abc import Sequence

    from perrin.images.optics.point_spread import PointSpread
    from perrin.images.optics.samples import CrowdSample, GroupSample, UsualImage


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


def fit_samples(
    samples: Sequence[GroupSample | CrowdSample],
    *,
    diameter: float,
    voxel: tuple[float, float, float],
    measured: PointSpread | None = None,
    shell: bool = False,
    camera_pattern: bool = False,
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
    measured : PointSpread, optional
        A point spread that was measured; diameter and noise are learned.
    shell : bool
        The surface of the spheres is fluorescent; otherwise it is tried where balls do not fit, and
        where it is likelier the result is that of this comparison alone, without tail, spread or
        asymmetry.
    camera_pattern : bool
        The pixels of the camera differ, so that their gains are compared.

    Returns
    -------
    LearnedOptics

    Raises
    ------
    NoSpheresError
        Without samples, or where the search does not converge.

    Notes
    -----
    Gauss-Newton steps in the logarithms of the lengths, with every sphere's position and brightness
    and every background eliminated exactly (the Schur complement of the information). The noise is
    that of the differences between neighbouring voxels.

    The point spread is a Gaussian. Where the derivative of the likelihood by the share of a wider
    second Gaussian is significant, the sum of two Gaussians is fitted to every other group, and it
    is used if the likelihood of the groups between them is the larger one. Where it is not, or much
    of the light is in the wider Gaussian, the point spread of an aperture with a pinhole (`Pupil`)
    is tried in the same way. Where the diameters of single spheres, fitted with a wide
    distribution, differ by more than their errors, their spread is learned too: that of greatest
    likelihood, and the mean diameter is the mean of the spheres.
    A point spread that is no body of revolution, or differs above and below the focus, changes the
    image by derivatives of it (`Asymmetry`), whose factors are found where they are significant;
    so are changes with the height of a sphere in the stack (`DepthChange`).
    Crowds have one even Gaussian and one diameter. Samples are left out first, because dust among
    them would appear as a tail or as a spread, and all are judged again by the image that is found.
    """
    psf = np.array([max(voxel[0], 0.15 * diameter), max(voxel[1] / 2, 0.06 * diameter)])
    start = ImageParameters(np.log([diameter, 1.0, 1.0]), voxel)
    start.values[1:] = np.log(np.hypot(psf, start.voxel_blur))
    if measured is not None:
        start = ImageParameters(np.log([diameter]), voxel, measured=measured)
    start = start.within_bounds()
    image = start.image()
    usable = [s for s in samples if s.has_enough_voxels(image)]
    if not usable:
        raise NoSpheresError(
            "no spheres to learn the optics from: none was found, or none has voxels to itself; "
            "check diameter, contact and minmass, and whether spheres are dark (dark=True), state "
            "the optics (optics=), or keep the positions found first (refine=None)"
        )
    mean = float(np.mean([np.nanmean(s.frame) for s in usable]))
    noise = CameraNoise(1.0, 0.05 * abs(mean))
    plain = LikeliestOptics.of_ball_or_shell(usable, replace(start, shell=shell), noise)
    if plain.parameters.shell and not shell:
        # Spheres whose surface is fluorescent are searched for in another way first.
        optics = plain.parameters.optics(plain.noise, plain.information)
        return LearnedOptics(optics, plain.usual)
    plain, left_out = plain.with_common_noise(camera_pattern=camera_pattern).without_dust()
    found = plain.with_spread() if plain.in_groups else plain
    if measured is None and found.shows_tail:
        found = found.with_tail().with_pupil()
    if found is not plain and left_out:
        # All samples are judged again by the image that was found.
        found, left_out = found.refitted_to(usable)
    elif found is not plain:
        found, left_out = found.without_dust()
    found = MomentFit.shown_by(found.with_neighbours())
    optics = found.parameters.optics(found.noise, found.information)
    return LearnedOptics(optics, replace(found.usual, left_out=left_out))
