"""Optics: size and point spread of a sphere's image, and the noise of the camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from perrin._arrays import to_plain
from perrin._display import Shown
from perrin.images.optics.asymmetry import Asymmetry
from perrin.images.optics.ball_image import PsfTail, SphereImage, sphere_image
from perrin.images.optics.depth import DepthChange
from perrin.images.optics.point_spread import PointSpread
from perrin.images.optics.pupil import Pupil

if TYPE_CHECKING:
    from collections.abc import Mapping

    from perrin._arrays import Floats


class CameraNoise(NamedTuple):
    """Variance of a voxel: ``gain * expected value + floor``, in squared grey levels.

    Flicker of the light adds variance that all voxels of a plane, or of a line, have in common, and
    unequal gains of pixels one that the voxels of a pixel in all planes have in common.

    Attributes
    ----------
    gain : float
        Grey levels per photon.
    floor : float
        Variance of a voxel whose expected value is 0, squared grey levels.
    plane, line : float
        Relative standard deviation of the light from plane to plane, and of that of a line along x
        about its plane; 0 where the light does not flicker.
    pixel : float
        Relative standard deviation of the gain from pixel to pixel; with it, no flicker.
    neighbours : tuple of tuple of float
        Correlation of the noise of voxels of a plane that are i rows and j columns apart,
        ``neighbours[i][j]``; empty where the noise of voxels is independent.
    along_z : tuple of float
        Factor of that correlation for voxels k planes apart, ``along_z[k]``; empty where planes are
        independent.

    Examples
    --------
    >>> CameraNoise(3.0, 4.0).weight(np.array([10.0, 20.0])).round(4)
    array([0.0294, 0.0156])
    """

    gain: float
    floor: float
    plane: float = 0.0
    line: float = 0.0
    pixel: float = 0.0
    neighbours: tuple[tuple[float, ...], ...] = ()
    along_z: tuple[float, ...] = ()

    @property
    def correlated(self) -> bool:
        """Whether voxels have noise in common: flicker, or the gain of their pixel."""
        return self.plane > 0 or self.line > 0 or self.pixel > 0

    @property
    def voxels_in_one(self) -> float:
        """Number of voxels over which a mean square scatters as over one independent voxel.

        The sum of the squared correlations, of both signs of every lag.

        Examples
        --------
        >>> CameraNoise(3.0, 4.0, neighbours=((1.0, 0.5), (0.5, 0.0))).voxels_in_one
        2.0
        """
        square = np.square(self.neighbours or ((1.0,),))
        in_plane = 4 * square.sum() - 2 * square[0].sum() - 2 * square[:, 0].sum() + square[0, 0]
        return float(in_plane * (2 * np.square(self.along_z or (1.0,)).sum() - 1))

    def light(self, expected: Floats) -> Floats:
        """Return expected values above the level without light, grey levels.

        The variance of a voxel over the gain is this level where read noise is small, whatever the
        offset of the camera.
        """
        if self.gain <= 0:
            return expected
        return np.asarray(1.0 / (self.gain * self.weight(expected)))

    def weight(self, expected: Floats) -> Floats:
        """Return the inverse variance of voxels with these expected values.

        Negative expected values, which a fit may pass through, have the least variance: 5 % of
        that of the mean value.
        """
        least = 0.05 * (self.gain * float(np.abs(expected).mean()) + self.floor)
        return np.asarray(1.0 / np.maximum(self.gain * expected + self.floor, least))

    def to_dict(self) -> dict[str, Any]:
        """Return gain and floor, and what voxels have in common, as values that JSON holds."""
        entry = {name: to_plain(value) for name, value in self._asdict().items()}
        return (
            entry
            if self != CameraNoise(*self[:2])
            else {name: entry[name] for name in ("gain", "floor")}
        )

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> CameraNoise:
        """Return the noise that `to_dict` wrote.

        Parameters
        ----------
        entry : mapping
            The dictionary of `to_dict`.

        Returns
        -------
        CameraNoise
        """
        rows = tuple(tuple(row) for row in entry.get("neighbours", ()))
        values = {**entry, "neighbours": rows, "along_z": tuple(entry.get("along_z", ()))}
        return cls(**values)


@dataclass(frozen=True, repr=False)
class Optics(Shown):
    """The image of a sphere: its size, the point spread, and the noise.

    Attributes
    ----------
    diameter : float
        Diameter of the fluorescent sphere, um.
    psf : tuple of float
        Standard deviations of the Gaussian point spread, (z, plane), um; with a tail those of its
        narrower Gaussian, with `depth` those at its middle.
    noise : CameraNoise
        ``(gain, floor, ...)``: the variance of a voxel is gain times its expected value plus floor,
        in squared grey levels; the floor includes read noise and the camera's offset.
    stderr : tuple of float
        Standard errors of diameter, psf z and psf plane, um; 0 where the user stated the values.
    tail : PsfTail or None
        The second, wider Gaussian of the point spread: its share of the intensity and its standard
        deviations (z, plane), um; None for a Gaussian point spread.
    spread : float
        Relative standard deviation of the diameters of different spheres; 0 where they are equal.
    measured : PointSpread or None
        A point spread that was measured on beads; `psf` is then that of its narrowest Gaussian, and
        there is no `tail`.
    shell : bool
        The surface of the spheres is fluorescent, in place of all of them.
    asymmetry : Asymmetry or None
        By what the point spread differs from a body of revolution that is even along z; None where
        the movie shows no difference.
    depth : DepthChange or None
        How the point spread changes with the height of a sphere in the stack; None where the movie
        shows no change.
    pupil : Pupil or None
        The point spread of a confocal microscope, where it is likelier than one or two Gaussians;
        `psf` is then the Gaussian that is as wide at half of its maximum, and there is no `tail`.

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
    tail: PsfTail | None = None
    spread: float = 0.0
    measured: PointSpread | None = None
    shell: bool = False
    asymmetry: Asymmetry | None = None
    depth: DepthChange | None = None
    pupil: Pupil | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return values that JSON holds.

        `noise` is [gain, floor], or with noise that voxels have in common all its values; `tail` is
        [share, psf].
        """
        entry = {
            "diameter": to_plain(self.diameter),
            "psf": to_plain(self.psf),
            "noise": list(self.noise.to_dict().values()),
            "stderr": to_plain(self.stderr),
            "tail": None if self.tail is None else [to_plain(part) for part in self.tail],
            "spread": to_plain(self.spread),
        }
        # What most movies do not have is not written.
        shell = {"shell": True} if self.shell else {}
        measured = {} if self.measured is None else {"measured": self.measured.to_dict()}
        uneven = {} if self.asymmetry is None else {"asymmetry": self.asymmetry._asdict()}
        deep = {} if self.depth is None else {"depth": to_plain(self.depth._asdict())}
        pupil = {} if self.pupil is None else {"pupil": to_plain(self.pupil._asdict())}
        return entry | measured | shell | uneven | deep | pupil

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> Optics:
        """Return the optics that `to_dict` wrote.

        Parameters
        ----------
        entry : mapping
            The dictionary of `to_dict`; one without `tail` and `pupil` has a Gaussian point spread,
            one without `spread` equal spheres, one without `measured` a point spread that was
            learned, one without `shell` balls, and one without `asymmetry` or `depth` a point
            spread that is an even body of revolution, or the same at all heights.

        Returns
        -------
        Optics
        """
        (psf_z, psf), (a, b, c) = entry["psf"], entry["stderr"]
        tail = None
        if entry.get("tail") is not None:
            share, (tail_z, tail_plane) = entry["tail"]
            tail = PsfTail(share, (tail_z, tail_plane))
        values = dict(zip(CameraNoise._fields, entry["noise"], strict=False))
        noise = CameraNoise.from_dict(values)
        measured = None
        if entry.get("measured") is not None:
            measured = PointSpread.from_dict(entry["measured"])
        size, spread = entry["diameter"], entry.get("spread", 0.0)
        shell = bool(entry.get("shell", False))
        uneven = entry.get("asymmetry")
        asymmetry = None if uneven is None else Asymmetry(**uneven)
        deep, pupil = entry.get("depth"), entry.get("pupil")
        depth = None
        if deep is not None:
            depth = DepthChange(**{**deep, "stderr": tuple(deep["stderr"])})
        return cls(
            *(size, (psf_z, psf), noise, (a, b, c), tail, spread, measured, shell),
            asymmetry=asymmetry,
            depth=depth,
            pupil=None if pupil is None else Pupil(**pupil),
        )

    def image(self, voxel: tuple[float, float, float]) -> SphereImage:
        """Return the table of the sphere's image for voxels (z, y, x), um."""
        return sphere_image(
            diameter=self.diameter,
            psf=self.psf,
            voxel=voxel,
            tail=self.tail,
            spread=self.spread,
            measured=self.measured,
            shell=self.shell,
            asymmetry=self.asymmetry,
            depth=self.depth,
            pupil=self.pupil,
        )


def photon_transfer(expected: Floats, variance: Floats) -> CameraNoise:
    """Return gain and floor of the camera from the growth of the variance with the mean.

    Parameters
    ----------
    expected : ndarray, shape (m,)
        Expected grey levels.
    variance : ndarray, shape (m,)
        Estimates of their variance.

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
    noise = CameraNoise(0.0, float(variance.mean()))
    for _ in range(4):
        weighted = design * noise.weight(expected) ** 2
        gain, floor = np.linalg.solve(weighted @ design.T, weighted @ variance)
        if gain <= 0:
            return CameraNoise(0.0, float(variance.mean()))
        noise = CameraNoise(float(gain), float(floor))
    return noise
