"""The point spread of a confocal microscope, and the image of a ball by it.

Scalar diffraction at the full aperture: the product of the focus of the excitation and of the focus
of the emission, the latter averaged over the pinhole.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from perrin._arrays import frozen

if TYPE_CHECKING:
    from perrin._arrays import Floats

# Wavelength of the excitation over that of the emission.
_STOKES = 0.94

# Half sizes (z, plane) of the space in which the point spread is computed, um, nodes of the pupil,
# and nodes in the plane for each unit of the largest phase.
_HALF, _PUPIL_NODES, _NODES_PER_PHASE = (9.0, 6.0), 48, 0.6

# The fit uses voxels, and the table of the image ends, where less than this is left of the
# intensity inside a large ball, and at this distance outside the surface at the latest, um.
_FIT_LEVEL, _TABLE_LEVEL, _MOST_RANGE = 0.02, 0.002, 4.0

# Largest diameter of a ball, um: the image of a larger one would reach beyond the space above and
# below it, and return from the other side, as a transform is periodic.
MOST_DIAMETER = 2 * (_HALF[0] - _MOST_RANGE)

# Phase at the first dark ring of a focus: its radius times `Pupil.lateral`.
AIRY = 3.832

# The standard deviation of a Gaussian over its half width at half of the maximum.
_OF_HALF_WIDTH = 1 / np.sqrt(2 * np.log(2))


class Pupil(NamedTuple):
    """What sets the point spread of a confocal microscope.

    Attributes
    ----------
    lateral : float
        2 pi times the numerical aperture over the wavelength of the emission, 1/um.
    slope : float
        Tangent of half of the aperture's half angle: the scale in the plane over that along z.
    pinhole : float
        Radius of the pinhole in the plane of the sample, um.

    Examples
    --------
    >>> water = Pupil(2 * np.pi * 1.2 / 0.52, np.tan(np.arcsin(1.2 / 1.33) / 2), 0.25)
    >>> [round(width, 2) for width in water.psf]
    [0.2, 0.08]
    """

    lateral: float
    slope: float
    pinhole: float

    @property
    def airy_units(self) -> float:
        """Diameter of the pinhole over that of the first dark ring of the emission's focus."""
        return self.pinhole * self.lateral / AIRY

    @property
    def psf(self) -> tuple[float, float]:
        """Standard deviations (z, plane) of a Gaussian as wide at half of its maximum, um."""
        return gaussian_widths(self)


def focal_intensity(pupil: Pupil, z: Floats, r: Floats, *, factor: float = 1.0) -> Floats:
    """Return the intensity of the focus of an aperture.

    Parameters
    ----------
    pupil : Pupil
    z, r : ndarray
        Heights above the focus and distances from the axis, um.
    factor : float
        By this the wavelength is shorter than that of the emission.

    Returns
    -------
    ndarray, shape (len(z), len(r))
        In units of its own.

    Examples
    --------
    >>> value = focal_intensity(Pupil(15.0, 0.6, 0.2), np.zeros(1), np.array([0.0, AIRY / 15]))
    >>> bool(value[0, 1] < 0.01 * value[0, 0])  # the first dark ring
    True
    """
    from scipy.special import j0

    x, weight = np.polynomial.legendre.leggauss(_PUPIL_NODES)
    rho, k = (x + 1) / 2, pupil.lateral * factor
    sine = 2 * pupil.slope / (1 + pupil.slope**2)
    cosine = np.sqrt(1 - (sine * rho) ** 2)
    amplitude = weight * rho / np.sqrt(cosine)
    phase = np.exp(1j * np.outer(z, k / sine * (cosine - 1)))
    return np.asarray(np.abs((phase * amplitude) @ j0(k * np.outer(rho, r))) ** 2)


@lru_cache(maxsize=64)
def gaussian_widths(pupil: Pupil) -> tuple[float, float]:
    """Return the standard deviations of a Gaussian as wide as a point spread at half its maximum.

    Parameters
    ----------
    pupil : Pupil

    Returns
    -------
    tuple of float
        Along z and in the plane, um.

    Examples
    --------
    >>> along, across = gaussian_widths(Pupil(15.0, 0.6, 0.2))
    >>> round(along, 2), round(across, 2)
    (0.19, 0.08)
    """
    space = FocalSpace.of(pupil)
    z, r, axis = np.linspace(0.0, 4.0, 400), np.linspace(0.0, 1.5, 400), np.zeros(1)
    emitted = space.through_pinhole(pupil, np.concatenate([axis, z]))
    along = emitted[1:] @ space.back(axis) * focal_intensity(pupil, z, axis, factor=1 / _STOKES)
    across = emitted[:1] @ space.back(r) * focal_intensity(pupil, axis, r, factor=1 / _STOKES)
    wide_z, wide = (
        float(_OF_HALF_WIDTH) * _first_below(x, value.ravel() / value.max(), 0.5)
        for x, value in ((z, along), (r, across))
    )
    return wide_z, wide


def _first_below(x: Floats, value: Floats, level: float) -> float:
    """Return where a function first falls below a level, by linear interpolation."""
    k = int(np.argmax(value < level)) or len(x) - 1
    return float(np.interp(level, value[[k, k - 1]], x[[k, k - 1]]))


class FocalSpace(NamedTuple):
    """The heights, distances from the axis and wave numbers on which a point spread is computed.

    Attributes
    ----------
    z, kz : ndarray, shape (a,)
        Even heights, um, the first one 0, and their wave numbers, 1/um, in the order of a Fourier
        transform.
    r, r_weight : ndarray, shape (b,)
        Nodes of the distance from the axis, um, and weights of integrals over the plane, um^2.
    k, k_weight : ndarray, shape (c,)
        Nodes of the wave number in the plane, 1/um, and weights of the transform back, 1/um^2.
    bessel : ndarray, shape (b, c)
        Bessel function of order 0 of r k.

    Examples
    --------
    >>> space = FocalSpace.of(Pupil(15.0, 0.6, 0.2))
    >>> gauss = np.exp(-0.5 * (space.r / 0.3) ** 2) * space.r_weight
    >>> (gauss @ space.bessel @ space.back(np.array([0.0, 0.3]))).round(3)
    array([1.   , 0.607])
    """

    z: Floats
    kz: Floats
    r: Floats
    r_weight: Floats
    k: Floats
    k_weight: Floats
    bessel: Floats

    @classmethod
    def of(cls, pupil: Pupil) -> FocalSpace:
        """Return a space that holds the whole band of a point spread."""
        from scipy.special import j0

        both = 1 + 1 / _STOKES
        band, band_z = pupil.lateral * both, pupil.lateral * pupil.slope * both
        # Intensities have twice the band of the field in the plane, and once along z.
        count = 2 * int(np.ceil(_HALF[0] * band_z / np.pi * 1.1)) + 2
        step = 2 * _HALF[0] / count
        most = min(2 * band, 2 * np.pi / 0.12)
        nodes, weight = np.polynomial.legendre.leggauss(
            int(most * _HALF[1] * _NODES_PER_PHASE) + 20
        )
        unit, weight = (nodes + 1) / 2, weight / 2
        r, k = _HALF[1] * unit, most * unit
        return cls(
            np.fft.ifftshift(np.asarray(step * (np.arange(count) - count // 2), dtype=np.float64)),
            np.asarray(2 * np.pi * np.fft.fftfreq(count, step), dtype=np.float64),
            r,
            2 * np.pi * _HALF[1] * weight * r,
            k,
            most * weight * k / (2 * np.pi),
            j0(np.outer(r, k)),
        )

    def through_pinhole(self, pupil: Pupil, z: Floats) -> Floats:
        """Return the transform (len(z), k) of the emission's focus behind the pinhole."""
        from scipy.special import j1

        inside = np.maximum(self.k * pupil.pinhole, 1e-9)
        emitted = focal_intensity(pupil, z, self.r)
        return np.asarray((emitted * self.r_weight) @ self.bessel * (2 * j1(inside) / inside))

    def back(self, r: Floats) -> Floats:
        """Return the matrix (k, len(r)) of the transform back to distances from the axis."""
        from scipy.special import j0

        return np.asarray(self.k_weight[:, None] * j0(np.outer(self.k, r)))


@lru_cache(maxsize=32)
def transfer_function(pupil: Pupil) -> tuple[FocalSpace, Floats]:
    """Return the optical transfer function of a confocal microscope.

    Parameters
    ----------
    pupil : Pupil

    Returns
    -------
    space : FocalSpace
    transfer : ndarray, shape (a, c)
        At the wave numbers along z and in the plane; all the light of a point is 1.

    Examples
    --------
    >>> space, transfer = transfer_function(Pupil(15.0, 0.6, 0.2))
    >>> transfer[0, np.searchsorted(space.k, [0.1, 10.0])].round(2)
    array([1.  , 0.53])
    """
    space = FocalSpace.of(pupil)
    emitted = space.through_pinhole(pupil, space.z) @ space.back(space.r)
    point = focal_intensity(pupil, space.z, space.r, factor=1 / _STOKES) * emitted
    light = (point * space.r_weight).sum()
    whole = np.fft.fft((point * space.r_weight) @ space.bessel, axis=0).real / light
    frozen(whole)
    return space, whole


class PupilBall(NamedTuple):
    """A ball as a confocal microscope shows it.

    Attributes
    ----------
    diameter : float
        Diameter of the ball, um; at most `MOST_DIAMETER`, 10 um.
    pupil : Pupil
    variances : tuple of float
        Variances (z, plane) by which the image is blurred besides, um^2: those of a voxel. Below 0
        they count as 0.
    shell : bool
        The surface of the ball is fluorescent, in place of all of it.

    Examples
    --------
    >>> ball = PupilBall(2.45, Pupil(15.7, 0.65, 0.3), (0.005, 0.003))
    >>> ball.intensity(np.array([0.0, 1.5]), np.array([0.0, 1.5])).round(2)
    array([[0.89, 0.02],
           [0.18, 0.01]])
    """

    diameter: float
    pupil: Pupil
    variances: tuple[float, float]
    shell: bool = False

    @property
    def components(self) -> tuple[tuple[float, tuple[float, float]], ...]:
        """The Gaussian that is as wide as the point spread with the voxels, its share 1."""
        z, plane = (
            float(np.sqrt(width**2 + max(more, 0.0)))
            for width, more in zip(self.pupil.psf, self.variances, strict=True)
        )
        return ((1.0, (z, plane)),)

    def widened(self, z: float, plane: float) -> PupilBall:
        """Return the ball with these added to the variances (z, plane) of the blur, um^2."""
        return self._replace(variances=(self.variances[0] + z, self.variances[1] + plane))

    @property
    def fit_range(self) -> tuple[float, float]:
        """Distances (z, plane) outside the surface up to which a fit uses voxels, um."""
        return _image_ends(self)[0]

    @property
    def table_range(self) -> tuple[float, float]:
        """Distances (z, plane) outside the surface at which the table of the image ends, um."""
        return _image_ends(self)[1]

    def intensity(self, z: Floats, rho: Floats) -> Floats:
        """Return the intensity (len(z), len(rho)) at heights z and distances rho from the axis."""
        space, whole = image_transform(self)
        heights = np.cos(np.outer(z, space.kz)) / (2 * _HALF[0])
        shape = np.shape(rho)
        flat = heights @ whole @ space.back(np.ravel(rho))
        return np.asarray(flat.reshape(len(z), *shape))


@lru_cache(maxsize=64)
def image_transform(ball: PupilBall) -> tuple[FocalSpace, Floats]:
    """Return the Fourier transform of the image of a ball.

    Parameters
    ----------
    ball : PupilBall

    Returns
    -------
    space : FocalSpace
    transform : ndarray, shape (a, c)
        At the wave numbers along z and in the plane, um^3.

    Examples
    --------
    >>> _, transform = image_transform(PupilBall(2.0, Pupil(15.0, 0.6, 0.2), (0.005, 0.003)))
    >>> round(float(transform[0, 0]), 2)  # the volume
    4.19
    """
    space, whole = transfer_function(ball.pupil)
    radius = ball.diameter / 2
    q = np.maximum(radius * np.hypot(space.kz[:, None], space.k), 1e-3)
    if ball.shell:
        form = 4 / 3 * np.pi * radius**3 * np.sin(q) / q
    else:
        form = 4 * np.pi * radius**3 * (np.sin(q) - q * np.cos(q)) / q**3
    # No point spread is narrower than that of the aperture.
    wide_z, wide = (max(v, 0.0) for v in ball.variances)
    blur = np.exp(-0.5 * (wide_z * space.kz[:, None] ** 2 + wide * space.k**2))
    found = np.asarray(whole * form * blur)
    frozen(found)
    return space, found


@lru_cache(maxsize=64)
def _image_ends(ball: PupilBall) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return distances (z, plane) outside the surface where little is left, for fits and tables."""
    out, axis = np.linspace(0.0, _MOST_RANGE, 161), np.zeros(1)
    along = ball.intensity(ball.diameter / 2 + out, axis)[:, 0]
    across = ball.intensity(axis, ball.diameter / 2 + out)[0]
    fit, table = (
        (_first_below(out, along, level), _first_below(out, across, level))
        for level in (_FIT_LEVEL, _TABLE_LEVEL)
    )
    return fit, table
