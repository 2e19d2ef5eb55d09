"""Optics: size and point spread of a sphere's image, and the noise of the camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from perrin._arrays import to_plain
from perrin._display import Shown
from perrin.images.optics.ball_image import SphereImage, sphere_image

if TYPE_CHECKING:
    from collections.abc import Mapping

    from perrin._arrays import Floats


class CameraNoise(NamedTuple):
    """Variance of a voxel: ``gain * expected value + floor``, in squared grey levels.

    Attributes
    ----------
    gain : float
        Grey levels per photon.
    floor : float
        Variance of a voxel whose expected value is 0, squared grey levels.

    Examples
    --------
    >>> CameraNoise(3.0, 4.0).weight(np.array([10.0, 20.0])).round(4)
    array([0.0294, 0.0156])
    """

    gain: float
    floor: float

    def weight(self, expected: Floats) -> Floats:
        """Return the inverse variance of voxels with these expected values.

        Negative expected values, which a fit may pass through, have the least variance: 5 % of
        that of the mean value.
        """
        least = 0.05 * (self.gain * float(np.abs(expected).mean()) + self.floor)
        return np.asarray(1.0 / np.maximum(self.gain * expected + self.floor, least))

    def to_dict(self) -> dict[str, float]:
        """Return gain and floor as values that JSON holds."""
        return {"gain": float(self.gain), "floor": float(self.floor)}

    @classmethod
    def from_dict(cls, entry: Mapping[str, float]) -> CameraNoise:
        """Return the noise that `to_dict` wrote.

        Parameters
        ----------
        entry : mapping
            The dictionary of `to_dict`.

        Returns
        -------
        CameraNoise
        """
        return cls(entry["gain"], entry["floor"])


@dataclass(frozen=True, repr=False)
class Optics(Shown):
    """The image of a sphere: its size, the point spread, and the noise.

    Attributes
    ----------
    diameter : float
        Diameter of the fluorescent sphere, um.
    psf : tuple of float
        Standard deviations of the Gaussian point spread, (z, plane), um.
    noise : CameraNoise
        ``(gain, floor)``: the variance of a voxel is gain times its expected value plus floor, in
        squared grey levels; the floor includes read noise and the camera's offset.
    stderr : tuple of float
        Standard errors of diameter, psf z and psf plane, um; 0 where the user stated the values.

    Examples
    --------
    >>> optics = Optics(2.45, (0.4, 0.15), CameraNoise(3.0, 4.0))
    >>> Optics.from_dict(optics.to_dict()) == optics
    True
    """

    diameter: float
    psf: tuple[float, float]
    noise: CameraNoise
    stderr: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def to_dict(self) -> dict[str, Any]:
        """Return the optics as values that JSON holds; `noise` is the list [gain, floor]."""
        return {
            "diameter": to_plain(self.diameter),
            "psf": to_plain(self.psf),
            "noise": [to_plain(value) for value in self.noise],
            "stderr": to_plain(self.stderr),
        }

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> Optics:
        """Return the optics that `to_dict` wrote.

        Parameters
        ----------
        entry : mapping
            The dictionary of `to_dict`.

        Returns
        -------
        Optics
        """
        (psf_z, psf), (a, b, c) = entry["psf"], entry["stderr"]
        return cls(entry["diameter"], (psf_z, psf), CameraNoise(*entry["noise"]), (a, b, c))

    def image(self, voxel: tuple[float, float, float]) -> SphereImage:
        """Return the table of the sphere's image for voxels (z, y, x), um."""
        return sphere_image(diameter=self.diameter, psf=self.psf, voxel=voxel)
