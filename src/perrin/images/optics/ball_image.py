"""What a sphere looks like in a confocal image: a ball blurred by the optics and the voxels.

Inside the images rooms an array's axes are (z, y, x), and so are centres and point spreads.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from perrin._arrays import Floats, frozen, require_positive

_STEP = 0.25  # spacing of the table's knots in units of the narrower blur; cubic error under 1e-4


_WINDOW = 3.5  # voxels within so many blurs of a sphere's surface are its own


_REACH = 4.5  # the table ends this many blurs outside the sphere, where under 1e-5 is left


class SphereSpot(NamedTuple):
    """A unit sphere's image in a box of voxels, and how it changes as the sphere moves."""

    box: tuple[slice, slice, slice]
    value: Floats  # (nz, ny, nx)
    gradient: Floats  # (3, nz, ny, nx): by the centre's z, y, x, per um


@dataclass(frozen=True, eq=False)
class SphereImage:
    """The blurred image of a unit-bright ball, tabulated once, evaluated anywhere.

    Attributes
    ----------
    diameter : float
        Of the fluorescent ball (the core of a core-shell sphere), um.
    psf : tuple of float
        Standard deviations of the Gaussian point spread along z and within the plane, um.
    voxel : tuple of float
        (z, y, x), um.
    blur : tuple of float
        Point spread and voxel together, z and plane, um.
    """

    diameter: float
    psf: tuple[float, float]
    voxel: tuple[float, float, float]
    blur: tuple[float, float]
    _knots: Floats
    _spacing: tuple[float, float]

    @property
    def reach(self) -> tuple[float, float, float]:
        """Distance from the centre beyond which nothing is left, along z, y and x, um."""
        z, plane = (self.diameter / 2 + _REACH * blur for blur in self.blur)
        return z, plane, plane

    @property
    def extent(self) -> Floats:
        """Half axes (z, y, x) of the ellipsoid of voxels that a fit asks for, um."""
        return self.diameter / 2 + _WINDOW * np.array([self.blur[0], self.blur[1], self.blur[1]])

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

        The image is one sum of spline products, because the blurred ball is round about z: a
        matrix of splines in abs(z), the table's knots, and a matrix of splines in the distance
        from the axis.

        Returns
        -------
        value : ndarray, shape (nz, ny, nx)
        gradient : ndarray, shape (3, nz, ny, nx)
            Derivatives by the centre's (z, y, x), per um.
        """
        rho = np.hypot(y[:, None], x)
        shape = (len(z), *rho.shape)
        along, along_slope = _splines(np.abs(z) / self._spacing[0], self._knots.shape[0])
        across, across_slope = _splines(rho.ravel() / self._spacing[1], self._knots.shape[1])
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
        Of the fluorescent ball, um.
    psf : tuple of float
        Standard deviations of the point spread, (z, plane), um.
    voxel : tuple of float
        (z, y, x), um.

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

    (the integral of a Gaussian over a ball); what the blur along z has in excess of s is added by
    one numerical convolution.

    Examples
    --------
    >>> import numpy as np
    >>> image = sphere_image(diameter=2.45, psf=(0.4, 0.15), voxel=(0.25, 0.2, 0.2))
    >>> value, gradient = image.at(np.zeros(1), np.zeros(1), np.array([0.0, 1.225, 2.0]))
    >>> value.round(2).tolist()
    [[[1.0, 0.34, 0.0]]]
    """
    require_positive(diameter=diameter, **{"psf[z]": psf[0], "psf[plane]": psf[1]})
    require_positive(**{f"voxel[{axis}]": h for axis, h in zip("zyx", voxel, strict=True)})
    blur_z = float(np.sqrt(psf[0] ** 2 + voxel[0] ** 2 / 12))
    blur = float(np.sqrt(psf[1] ** 2 + voxel[1] * voxel[2] / 12))
    if blur_z < blur:
        raise ValueError(
            f"psf: expected (z, plane) with the larger blur along z, as in every microscope, got "
            f"{psf} um, with the voxel {blur_z:.3g} and {blur:.3g}; are the two exchanged?"
        )
    knots, spacing = _table(diameter / 2, blur_z, blur)
    frozen(knots)
    return SphereImage(diameter, psf, voxel, (blur_z, blur), knots, spacing)


def _table(radius: float, blur_z: float, blur: float) -> tuple[Floats, tuple[float, float]]:
    """Return the spline knots of the blurred ball over (abs(z), rho), and their spacing."""
    from scipy.ndimage import spline_filter1d

    spacing = _STEP * blur_z, _STEP * blur
    z, rho = (
        h * np.arange(int(np.ceil((radius + _REACH * s) / h)) + 2)
        for h, s in zip(spacing, (blur_z, blur), strict=True)
    )
    nodes, weights = _extra_blur(float(np.sqrt(blur_z**2 - blur**2)), blur)
    r = np.hypot((z[:, None] - nodes)[..., None], rho)
    table = np.einsum("k,zkr->zr", weights, _even_blur(r, radius, blur))
    for axis in (0, 1):
        table = spline_filter1d(table, axis=axis, mode="mirror")
    # The image is even in z and in rho: the knot before the first is the one after it.
    return np.pad(table, 1, mode="reflect"), spacing


def _extra_blur(width: float, blur: float) -> tuple[Floats, Floats]:
    """Return nodes and weights that convolve with a Gaussian; the sum converges exponentially."""
    if width < 1e-6 * blur:
        return np.zeros(1), np.ones(1)
    step = min(width, blur) / 2
    count = int(np.ceil(6 * width / step))
    nodes = np.asarray(step * np.arange(-count, count + 1), dtype=np.float64)
    weights = np.exp(-0.5 * (nodes / width) ** 2)
    return nodes, weights / weights.sum()


def _even_blur(r: Floats, radius: float, s: float) -> Floats:
    """Return a unit ball of `radius` convolved with an isotropic Gaussian s, at distance r."""
    from scipy.special import erf

    a, b = (radius - r) / s, (radius + r) / s
    # Near the centre the difference of exponentials over r is its limit, the derivative.
    small = r < 1e-4 * s
    safe = np.where(small, s, r)
    edge = s / safe * (np.exp(-0.5 * a**2) - np.exp(-0.5 * b**2))
    edge = np.where(small, 2 * radius / s * np.exp(-0.5 * (radius / s) ** 2), edge)
    inside: Floats = 0.5 * (erf(b / np.sqrt(2)) + erf(a / np.sqrt(2))) - edge / np.sqrt(2 * np.pi)
    return inside


def _splines(t: Floats, count: int) -> tuple[Floats, Floats]:
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
