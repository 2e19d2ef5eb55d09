"""The confocal image of a sphere: a ball blurred by the optics and the voxels.

In `perrin.images` the axes of arrays, centres and point spreads are (z, y, x).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from perrin._arrays import Floats, frozen, require_positive

# Spacing of the table's knots in units of the blur along each axis; the cubic error is below 1e-4.
_KNOT_SPACING = 0.25

# A fit uses the voxels up to this many blurs outside a sphere's surface.
_FIT_RANGE = 3.5

# The table ends this many blurs outside the sphere, where less than 1e-5 is left.
_TABLE_RANGE = 4.5


class SphereSpot(NamedTuple):
    """The image of a unit-bright sphere in a box of voxels, and its derivatives by the centre.

    Attributes
    ----------
    box : tuple of slice
        The voxels (z, y, x) that the image covers.
    value : ndarray, shape (nz, ny, nx)
        Intensity of the sphere.
    gradient : ndarray, shape (3, nz, ny, nx)
        Derivatives of the intensity by the centre's (z, y, x), per um.
    """

    box: tuple[slice, slice, slice]
    value: Floats
    gradient: Floats


@dataclass(frozen=True, eq=False)
class SphereImage:
    """The blurred image of a unit-bright ball, tabulated once, evaluated anywhere.

    Attributes
    ----------
    diameter : float
        Diameter of the fluorescent sphere (the core of a core-shell sphere), um.
    psf : tuple of float
        Standard deviations of the Gaussian point spread along z and within the plane, um.
    voxel : tuple of float
        Voxel size (z, y, x), um.
    blur : tuple of float
        Standard deviations of point spread and voxel together, (z, plane), um.

    Examples
    --------
    >>> image = sphere_image(diameter=2.0, psf=(0.4, 0.15), voxel=(0.25, 0.2, 0.2))
    >>> spot = image.spot(np.array([3.0, 3.0, 3.0]), (24, 32, 32))
    >>> spot.value.shape, round(float(spot.value.max()), 2)
    ((23, 17, 17), 0.98)
    """

    diameter: float
    psf: tuple[float, float]
    voxel: tuple[float, float, float]
    blur: tuple[float, float]
    _knots: Floats
    _spacing: tuple[float, float]

    @property
    def reach(self) -> tuple[float, float, float]:
        """Distances from the centre along z, y and x at which the image ends, um."""
        z, plane = (self.diameter / 2 + _TABLE_RANGE * blur for blur in self.blur)
        return z, plane, plane

    @property
    def extent(self) -> Floats:
        """Half axes (z, y, x) of the ellipsoid of voxels that a fit uses, um."""
        return self.diameter / 2 + _FIT_RANGE * np.array([self.blur[0], self.blur[1], self.blur[1]])

    def spot(self, center: Floats, shape: tuple[int, ...]) -> SphereSpot:
        """Return the image of a sphere at `center` (z, y, x), um, inside an array of `shape`.

        The origin is the centre of voxel (0, 0, 0); the box is cut at the array's borders.
        """
        limits = zip(center, self.reach, self.voxel, shape, strict=True)
        box = tuple(
            slice(
                min(max(int(np.ceil((c - reach) / h)), 0), n),
                max(min(int(np.floor((c + reach) / h)) + 1, n), 0),
            )
            for c, reach, h, n in limits
        )
        z, y, x = (
            h * np.arange(s.start, s.stop) - c
            for s, h, c in zip(box, self.voxel, center, strict=True)
        )
        value, gradient = self.at(z, y, x)
        return SphereSpot((box[0], box[1], box[2]), value, gradient)

    def at(self, z: Floats, y: Floats, x: Floats) -> tuple[Floats, Floats]:
        """Return image and gradient on the grid of offsets z, y, x from the centre, um.

        The blurred ball has the symmetry of rotation about z, so that the image is one sum of
        spline products: a matrix of splines in abs(z), the table's knots, and a matrix of splines
        in the distance from the axis.

        Returns
        -------
        value : ndarray, shape (nz, ny, nx)
        gradient : ndarray, shape (3, nz, ny, nx)
            Derivatives by the centre's (z, y, x), per um.
        """
        rho = np.hypot(y[:, None], x)
        shape = (len(z), *rho.shape)
        along, along_slope = _cubic_splines(np.abs(z) / self._spacing[0], self._knots.shape[0])
        across, across_slope = _cubic_splines(rho.ravel() / self._spacing[1], self._knots.shape[1])
        profile = along @ self._knots
        by_z = along_slope @ self._knots * (-np.sign(z) / self._spacing[0])[:, None]
        outward = across_slope / (self._spacing[1] * np.where(rho > 0, rho, 1.0)).reshape(-1, 1)
        value = (profile @ across.T).reshape(shape)
        by_rho = (profile @ outward.T).reshape(shape)
        gradient = np.empty((3, *shape))
        np.matmul(by_z, across.T, out=gradient[0].reshape(len(z), rho.size))
        np.multiply(by_rho, -y[:, None], out=gradient[1])
        np.multiply(by_rho, -x, out=gradient[2])
        return value, gradient


def sphere_image(
    *,
    diameter: float,
    psf: tuple[float, float],
    voxel: tuple[float, float, float],
) -> SphereImage:
    """Tabulate a ball convolved with an anisotropic Gaussian point spread and with the voxels.

    Parameters
    ----------
    diameter : float
        Diameter of the fluorescent sphere, um.
    psf : tuple of float
        Standard deviations of the point spread, (z, plane), um.
    voxel : tuple of float
        Voxel size (z, y, x), um.

    Returns
    -------
    SphereImage

    Raises
    ------
    ValueError
        For a length that is not positive, or where the blur along z is less than within the plane.

    Notes
    -----
    A voxel of side h enters as a Gaussian of variance h^2/12, exact to the third moment. The ball
    blurred evenly by s has a closed form, with a = R - r and b = R + r::

        (erf(b/s√2) + erf(a/s√2))/2 - s/(r√2π) (exp(-a²/2s²) - exp(-b²/2s²))

    (the integral of a Gaussian over a ball); the blur along z in excess of s is added by one
    numerical convolution.

    Examples
    --------
    >>> import numpy as np
    >>> image = sphere_image(diameter=2.45, psf=(0.4, 0.15), voxel=(0.25, 0.2, 0.2))
    >>> value, gradient = image.at(np.zeros(1), np.zeros(1), np.array([0.0, 1.225, 2.0]))
    >>> value.round(2).tolist()
    [[[1.0, 0.34, 0.0]]]
    """
    from scipy.ndimage import spline_filter1d
    from scipy.special import erf

    require_positive(diameter=diameter, **{"psf[z]": psf[0], "psf[plane]": psf[1]})
    require_positive(**{f"voxel[{axis}]": h for axis, h in zip("zyx", voxel, strict=True)})
    blur_z = float(np.sqrt(psf[0] ** 2 + voxel[0] ** 2 / 12))
    blur = float(np.sqrt(psf[1] ** 2 + voxel[1] * voxel[2] / 12))
    if blur_z < blur:
        raise ValueError(
            f"psf: expected (z, plane) with the larger blur along z, as in every microscope, got "
            f"{psf} um, with the voxel {blur_z:.3g} and {blur:.3g}; are the two exchanged?"
        )
    # The ball blurred by `blur` along all axes, over abs(z) and the distance rho from the axis.
    radius = diameter / 2
    spacing = _KNOT_SPACING * blur_z, _KNOT_SPACING * blur
    z, rho = (
        h * np.arange(int(np.ceil((radius + _TABLE_RANGE * s) / h)) + 2)
        for h, s in zip(spacing, (blur_z, blur), strict=True)
    )
    nodes, weights = _gaussian_nodes(float(np.sqrt(blur_z**2 - blur**2)), blur)
    r = np.hypot((z[:, None] - nodes)[..., None], rho)
    a, b = (radius - r) / blur, (radius + r) / blur
    # Near the centre the difference of exponentials over r is its limit, the derivative.
    small = r < 1e-4 * blur
    safe = np.where(small, blur, r)
    edge = blur / safe * (np.exp(-0.5 * a**2) - np.exp(-0.5 * b**2))
    edge = np.where(small, 2 * radius / blur * np.exp(-0.5 * (radius / blur) ** 2), edge)
    ball = 0.5 * (erf(b / np.sqrt(2)) + erf(a / np.sqrt(2))) - edge / np.sqrt(2 * np.pi)
    table = np.einsum("k,zkr->zr", weights, ball)
    for axis in (0, 1):
        table = spline_filter1d(table, axis=axis, mode="mirror")
    # The image is even in z and in rho: the knot before the first equals the one after it.
    knots = np.pad(table, 1, mode="reflect")
    frozen(knots)
    return SphereImage(diameter, psf, voxel, (blur_z, blur), knots, spacing)


def _gaussian_nodes(width: float, blur: float) -> tuple[Floats, Floats]:
    """Return nodes and weights that convolve with a Gaussian; the sum converges exponentially."""
    if width < 1e-6 * blur:
        return np.zeros(1), np.ones(1)
    step = min(width, blur) / 2
    count = int(np.ceil(6 * width / step))
    nodes = np.asarray(step * np.arange(-count, count + 1), dtype=np.float64)
    weights = np.exp(-0.5 * (nodes / width) ** 2)
    return nodes, weights / weights.sum()


def _cubic_splines(t: Floats, count: int) -> tuple[Floats, Floats]:
    """Return the cubic B-splines (len(t), count) of padded knots at t, and their slopes."""
    first = np.minimum(t.astype(np.int64), count - 4)
    u = np.minimum(t - first, 1.0)
    v = 1.0 - u
    rows = np.arange(len(t))[:, None]
    columns = first[:, None] + np.arange(4)
    middle = (2 / 3 - u**2 + u**3 / 2, 2 / 3 - v**2 + v**3 / 2)
    value, slope = np.zeros((len(t), count)), np.zeros((len(t), count))
    value[rows, columns] = np.stack([v**3 / 6, *middle, u**3 / 6], axis=1)
    steep = (-2 * u + 1.5 * u**2, 2 * v - 1.5 * v**2)
    slope[rows, columns] = np.stack([-(v**2) / 2, *steep, u**2 / 2], axis=1)
    return value, slope
