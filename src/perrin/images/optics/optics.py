"""Optics: what microscope and camera make of a sphere."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from perrin.images.optics.ball_image import SphereImage, sphere_image

if TYPE_CHECKING:
    from collections.abc import Mapping

    from perrin._arrays import Floats


class CameraNoise(NamedTuple):
    """Variance of a voxel: ``gain * expected value + floor``, in squared grey levels."""

    gain: float
    floor: float

    def weight(self, expected: Floats) -> Floats:
        """Return one over the variance where so much light is expected.

        Light below nothing, which a fit may pass through, counts as none.
        """
        least = 0.05 * (self.gain * float(np.abs(expected).mean()) + self.floor)
        return np.asarray(1.0 / np.maximum(self.gain * expected + self.floor, least))


@dataclass(frozen=True)
class Optics:
    """How a sphere is seen.

    Attributes
    ----------
    diameter : float
        Of the ball that is seen, um.
    psf : tuple of float
        Standard deviations of the Gaussian point spread, (z, plane), um.
    noise : CameraNoise
        ``(gain, floor)``: a voxel's variance is gain times its expected value plus floor, in
        squared grey levels; the floor takes in read noise and the camera's offset.
    stderr : tuple of float
        Standard errors of diameter, psf z and psf plane, um; 0 where stated by the user.
    """

    diameter: float
    psf: tuple[float, float]
    noise: CameraNoise
    stderr: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> Optics:
        """Read back what `dataclasses.asdict` made."""
        (psf_z, psf), (a, b, c) = entry["psf"], entry["stderr"]
        return cls(entry["diameter"], (psf_z, psf), CameraNoise(*entry["noise"]), (a, b, c))

    def image(self, voxel: tuple[float, float, float]) -> SphereImage:
        """Return the table of the sphere's image for voxels (z, y, x), um."""
        return sphere_image(diameter=self.diameter, psf=self.psf, voxel=voxel)
