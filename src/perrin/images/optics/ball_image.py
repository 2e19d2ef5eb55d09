"""The confocal image of a sphere: a ball blurred by the optics and the voxels.

In `perrin.images` the axes of arrays, centres and point spreads are (z, y, x).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from perrin._arrays import Bools, Floats, frozen, require_positive
from perrin.compiled.loading import compiled_kernels
from perrin.images.optics.asymmetry import (
    Asymmetry,
    asymmetry_tables,
    change_of_image,
    component_images,
    plane_factors,
)
from perrin.images.optics.point_spread import voxel_variances
from perrin.images.optics.pupil import MOST_DIAMETER, Pupil, PupilBall

if TYPE_CHECKING:
    from collections.abc import Sequence

    from perrin.images.optics.depth import DepthChange
    from perrin.images.optics.point_spread import PointSpread

# Spacing of the table's knots in units of the blur along each axis; the cubic error is below 1e-4.
_KNOT_SPACING = 0.25

# A fit uses the voxels up to this many blurs outside a sphere's surface. The tail of the point
# spread, with a share of the intensity of some tenths, is as weak at a smaller multiple of its own.
_FIT_RANGE, _TAIL_FIT_RANGE = 3.5, 1.5

# The table ends this many blurs outside the sphere, where less than 1e-5 is left.
_TABLE_RANGE, _TAIL_TABLE_RANGE = 4.5, 3.5

# Where diameters differ: largest deviation of a sphere's from the mean, in standard deviations and
# in its logarithm, and the spacing of the tables in units of the blur; the cubic error is 1e-3.
_SIZE_RANGE, _MAX_SIZE_RANGE, _SIZE_SPACING = 4.0, 0.3, 0.4

# Heights at which the image is tabulated where the point spread changes with the height: between
# them the cubic error of a width that doubles is 1e-3.
_HEIGHT_NODES = 5


class PsfTail(NamedTuple):
    """The wider one of the two Gaussians of a point spread with tails.

    Attributes
    ----------
    share : float
        Share of the intensity, between 0 and 1; the narrower Gaussian has the rest.
    psf : tuple of float
        Standard deviations (z, plane), um.

    Examples
    --------
    >>> PsfTail(0.15, (0.66, 0.27)).share
    0.15
    """

    share: float
    psf: tuple[float, float]

    def components(
        self, narrow: tuple[float, float]
    ) -> tuple[tuple[float, tuple[float, float]], ...]:
        """Return the shares and standard deviations (z, plane) of both Gaussians, um.

        Parameters
        ----------
        narrow : tuple of float
            Standard deviations of the narrower one, um.

        Raises
        ------
        ValueError
            For a length that is not positive, or a share outside 0 to 1.
        """
        require_positive(**{"tail psf[z]": self.psf[0], "tail psf[plane]": self.psf[1]})
        if not 0 <= self.share <= 1:
            raise ValueError(f"tail: expected a share between 0 and 1, got {self.share}")
        return (1.0 - self.share, narrow), (self.share, self.psf)


class BallBlur(NamedTuple):
    """A ball, and the Gaussian components by which its image is blurred.

    Attributes
    ----------
    diameter : float
        Diameter of the ball, um.
    components : tuple
        ``(share, (z, plane))`` of each component: its share of the intensity and its standard
        deviations with the voxels included, um; the narrowest component is the first.
    shell : bool
        The surface of the ball is fluorescent, in place of all of it; the intensity in all is that
        of the ball.
    """

    diameter: float
    components: tuple[tuple[float, tuple[float, float]], ...]
    shell: bool = False

    @classmethod
    def of_point_spread(
        cls,
        diameter: float,
        spreads: Sequence[tuple[float, tuple[float, float]]],
        *,
        voxel: tuple[float, float, float],
        shell: bool = False,
    ) -> BallBlur:
        """Return a ball that is blurred by the Gaussians of a point spread and by the voxels.

        Parameters
        ----------
        diameter : float
            Diameter of the ball, um.
        spreads : sequence of tuple
            ``(share, (z, plane))`` of each Gaussian, um.
        voxel : tuple of float
            Voxel size (z, y, x), um.
        shell : bool
            The surface of the ball is fluorescent.

        Raises
        ------
        ValueError
            Where the blur along z is less than within the plane.
        """
        more_z, more = voxel_variances(voxel).tolist()
        components = []
        for share, (psf_z, psf_plane) in spreads:
            blur_z, blur = float(np.sqrt(psf_z**2 + more_z)), float(np.sqrt(psf_plane**2 + more))
            if blur_z < blur:
                raise ValueError(
                    "psf: expected (z, plane) with the larger blur along z, as in every "
                    f"microscope, got {(psf_z, psf_plane)} um, with the voxel {blur_z:.3g} and "
                    f"{blur:.3g}; are the two exchanged?"
                )
            components.append((share, (blur_z, blur)))
        return cls(diameter, tuple(components), shell)

    def ranges(self, narrow: float, wide: float) -> tuple[float, float]:
        """Return distances (z, plane), um, in blurs of the narrowest component or of the others."""
        factors = [narrow, *([wide] * (len(self.components) - 1))]
        z, plane = (
            max(f * blur[axis] for f, (_, blur) in zip(factors, self.components, strict=True))
            for axis in (0, 1)
        )
        return z, plane

    @property
    def fit_range(self) -> tuple[float, float]:
        """Distances (z, plane) outside the surface up to which a fit uses voxels, um."""
        return self.ranges(_FIT_RANGE, _TAIL_FIT_RANGE)

    @property
    def table_range(self) -> tuple[float, float]:
        """Distances (z, plane) outside the surface at which the table of the image ends, um."""
        return self.ranges(_TABLE_RANGE, _TAIL_TABLE_RANGE)

    def widened(self, z: float, plane: float) -> BallBlur:
        """Return the ball with these added to the variances (z, plane) of all blurs, um^2.

        A blur along z stays at least that in the plane, and each at least half of its own.
        """
        components = []
        for share, (blur_z, blur) in self.components:
            across = float(np.sqrt(max(blur**2 + plane, blur**2 / 4)))
            along = float(np.sqrt(max(blur_z**2 + z, blur_z**2 / 4, across**2)))
            components.append((share, (along, across)))
        return self._replace(components=tuple(components))

    def intensity(self, z: Floats, rho: Floats) -> Floats:
        """Return the intensity (len(z), len(rho)) at heights z and distances rho from the axis.

        The ball blurred evenly by s has a closed form, with a = R - r and b = R + r::

            (erf(b/s√2) + erf(a/s√2))/2 - s/(r√2π) (exp(-a²/2s²) - exp(-b²/2s²))

        (the integral of a Gaussian over a ball), and so has a surface of as much light,
        R^2/(3 r s√2π) (exp(-a²/2s²) - exp(-b²/2s²)); the blur along z in excess of s is added by
        one numerical convolution.
        """
        from scipy.special import erf

        radius = self.diameter / 2
        total = np.zeros((len(z), len(rho)))
        for share, (blur_z, blur) in self.components:
            excess = float(np.sqrt(max(blur_z**2 - blur**2, 0.0)))
            nodes, weights = gaussian_quadrature(z, excess, blur=blur)
            r = np.hypot(nodes[:, None], rho)
            a, b = (radius - r) / blur, (radius + r) / blur
            # Near the centre the difference of exponentials over r is its limit, the derivative.
            small = r < 1e-4 * blur
            edge = (np.exp(-0.5 * a**2) - np.exp(-0.5 * b**2)) / np.where(small, blur, r)
            edge[small] = 2 * radius / blur**2 * np.exp(-0.5 * (radius / blur) ** 2)
            if self.shell:
                sphere = radius**2 / 3 / (blur * np.sqrt(2 * np.pi)) * edge
            else:
                sphere = 0.5 * (erf(b / np.sqrt(2)) + erf(a / np.sqrt(2)))
                sphere -= edge * blur / np.sqrt(2 * np.pi)
            total += share * (weights @ sphere)
        return total


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
        Standard deviations of the Gaussian point spread along z and within the plane, um; of a
        confocal one those of the Gaussian that is as wide.
    voxel : tuple of float
        Voxel size (z, y, x), um.
    blur : tuple of float
        Standard deviations of point spread and voxel together, (z, plane), um.
    tail : PsfTail or None
        The second, wider Gaussian of the point spread; `psf` and `blur` are of the first.
    spread : float
        Relative standard deviation of the diameters; 0 where all spheres are equal.
    asymmetry : Asymmetry or None
        By what the point spread differs from an even body of revolution. It changes the value of
        the image; the gradient is that without it.
    depth : DepthChange or None
        How the point spread changes with the height of a sphere in the stack.

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
    tail: PsfTail | None
    spread: float
    _ball: BallBlur | PupilBall
    _knots: Floats
    _spacing: tuple[float, float]
    _sizes: Floats
    _tables: Floats
    asymmetry: Asymmetry | None = None
    _uneven_knots: Floats | None = None
    depth: DepthChange | None = None
    _height_tables: Floats | None = None
    _height_slope: Floats | None = None

    @property
    def reach(self) -> tuple[float, float, float]:
        """Distances from the centre along z, y and x at which the image ends, um."""
        z, plane = self._ball.table_range
        radius = self.diameter / 2 * float(np.exp(_size_range(self.spread)))
        return radius + z, radius + plane, radius + plane

    @property
    def extent(self) -> Floats:
        """Half axes (z, y, x) of the ellipsoid of voxels that a fit uses, um."""
        z, plane = self._ball.fit_range
        return self.diameter / 2 * (1 + self.spread) + np.array([z, plane, plane])

    @property
    def size_range(self) -> float:
        """Largest deviation of the logarithm of a diameter from the mean."""
        return _size_range(self.spread)

    @property
    def is_uneven(self) -> bool:
        """Whether the point spread is no even body of revolution, at some height at least."""
        return self._uneven_knots is not None

    def sized(self, deviation: float, height: float | None = None) -> SphereImage:
        """Return the image of one sphere.

        Parameters
        ----------
        deviation : float
            Deviation of the logarithm of its diameter from the mean.
        height : float, optional
            Its height in the stack, um; by default the one at which the point spread is `psf`.
        """
        if self.spread == 0 and self.depth is None:
            return self
        value, _ = self._between_sizes(deviation)
        tables, slopes = self._tables_at(height)
        image = replace(self, _knots=np.tensordot(value, tables, 1))
        if self.depth is None:
            return image
        uneven = None
        if self.is_uneven:
            at = self.depth.middle if height is None else height
            uneven = self.depth.asymmetry(self.asymmetry, at)
        slope = np.tensordot(value, slopes, 1)
        return replace(image, depth=None, asymmetry=uneven, _height_slope=slope)

    def size_slope(self, deviation: float, height: float | None = None) -> Floats:
        """Return the table (1, ...) of the derivative of `sized` by the deviation."""
        _, slope = self._between_sizes(deviation)
        return np.asarray(np.tensordot(slope, self._tables_at(height)[0], 1)[None])

    def _tables_at(self, height: float | None) -> tuple[Floats, Floats]:
        """Return the tables of all sizes at a height, and their derivatives by the height."""
        if self.depth is None or height is None:
            return self._tables, np.zeros_like(self._tables)
        assert self._height_tables is not None
        nodes = self.depth.nodes(_HEIGHT_NODES)
        if nodes[0] == nodes[-1]:
            return self._height_tables[0], np.zeros_like(self._tables)
        within = float(np.clip(height, nodes[0], nodes[-1]))
        value, slope = _cubic_factors(nodes, within)
        if within != height:
            slope = np.zeros_like(slope)
        tables = self._height_tables
        return np.tensordot(value, tables, 1), np.tensordot(slope, tables, 1)

    def _between_sizes(self, deviation: float) -> tuple[Floats, Floats]:
        """Return the factors of the tables at a deviation, and their derivatives."""
        if self.spread == 0:
            return np.ones(1), np.zeros(1)
        return _cubic_factors(self._sizes, deviation)

    def spot(
        self, center: Floats, shape: tuple[int, ...], *, height: float | None = None
    ) -> SphereSpot:
        """Return the image of a sphere at `center` (z, y, x), um, inside an array of `shape`.

        The origin is the centre of voxel (0, 0, 0); the box is cut at the array's borders. `height`
        is that in the stack; by default it is the height in the array.
        """
        box, (z, y, x) = self._covered(center, shape)
        image = self
        if self.depth is not None:
            image = self.sized(0.0, float(center[0]) if height is None else height)
        value, gradient = image.at(z, y, x)
        return SphereSpot(box, value, gradient)

    def on_voxels(self, mask: Bools, centers: Floats, sizes: Floats, heights: Floats) -> Floats:
        """Return the images of spheres and their gradients on the voxels of a mask.

        Both are those without the asymmetry of the point spread, see `changes_on_voxels`.

        Parameters
        ----------
        mask : ndarray of bool, shape (nz, ny, nx)
            The m voxels that are wanted.
        centers : ndarray, shape (n, 3)
            Positions (z, y, x) from the centre of voxel (0, 0, 0), um.
        sizes : ndarray, shape (n,)
            Deviations of the logarithms of the diameters from the mean.
        heights : ndarray, shape (n,)
            Heights in the stack, um.

        Returns
        -------
        ndarray, shape (n, 4, m)
            Intensity, and its derivatives by z, y and x, per um.
        """
        kernels = compiled_kernels()
        if kernels is None:
            even = replace(self, asymmetry=None, _uneven_knots=None)
            whole = np.zeros((len(centers), 4, *mask.shape))
            for layer, center, size, high in zip(whole, centers, sizes, heights, strict=True):
                spot = even.sized(size, high).spot(center, mask.shape)
                layer[(0, *spot.box)] = spot.value
                layer[(slice(1, None), *spot.box)] = spot.gradient
            kept = whole.reshape(4 * len(centers), -1).take(np.flatnonzero(mask), axis=1)
            return kept.reshape(len(centers), 4, -1)
        own = [self]
        if self.spread > 0 or self.depth is not None:
            own = [self.sized(s, high) for s, high in zip(sizes, heights, strict=True)] or own
        place = np.ascontiguousarray(centers)
        lengths = [np.array(length) for length in (self.voxel, self.reach, self._spacing)]
        out = np.empty((len(centers), 4, np.count_nonzero(mask)))
        kernels.spots(mask, place, *lengths, np.stack([image._knots for image in own]), out)
        slopes = [image._height_slope for image in own if image._height_slope is not None]
        if slopes:
            # A sphere that moves up has another point spread, too.
            more = np.empty_like(out)
            kernels.spots(mask, place, *lengths, np.stack(slopes), more)
            out[:, 1] += more[:, 0]
        return out

    def changes_on_voxels(
        self, mask: Bools, centers: Floats, sizes: Floats, heights: Floats
    ) -> Floats:
        """Return what the asymmetry adds to the images of spheres on the voxels of a mask, (n, m).

        The parameters are those of `on_voxels`.
        """
        whole = np.zeros((len(centers), *mask.shape))
        if self.is_uneven:
            for layer, center, size, high in zip(whole, centers, sizes, heights, strict=True):
                box, offsets = self._covered(center, mask.shape)
                own = self.asymmetry
                if self.depth is not None:
                    own = self.depth.asymmetry(own, high)
                layer[box] = self._change(own, *(x * float(np.exp(-size)) for x in offsets))
        return whole[:, mask]

    def _change(self, own: Asymmetry | None, z: Floats, y: Floats, x: Floats) -> Floats:
        """Return what an asymmetry of the point spread adds to the image, on a grid of offsets."""
        assert own is not None
        assert self._uneven_knots is not None
        along, across = self._splines(z, y, x, knots=self._uneven_knots)
        change = change_of_image(
            *(own, self._uneven_knots),
            along=along,
            across=across,
            z=z,
            plane=plane_factors(y, x),
        )
        return change.reshape(len(z), len(y), len(x))

    def asymmetry_knots(self) -> Floats:
        """Return the tables of the derivatives by the asymmetry, for `asymmetry_spot`."""
        z, rho = self._grid
        tables = asymmetry_tables(self._ball.intensity, z, rho, blur=self.blur)
        return np.stack([_spline_knots(table) for table in tables])

    def asymmetry_spot(
        self, knots: Floats, center: Floats, shape: tuple[int, ...]
    ) -> tuple[tuple[slice, slice, slice], Floats]:
        """Return the voxels that the image covers, and its derivatives (12, nz, ny, nx).

        The derivatives are by the components of `Asymmetry`.

        Parameters
        ----------
        knots : ndarray, shape (7, ...)
            What `asymmetry_knots` returns.
        center : ndarray, shape (3,)
            Position (z, y, x), um.
        shape : tuple of int
            Shape of the array.
        """
        box, (z, y, x) = self._covered(center, shape)
        along, across = self._splines(z, y, x, knots=knots)
        found = component_images(knots, along=along, across=across, z=z, plane=plane_factors(y, x))
        return box, found.reshape(len(found), len(z), len(y), len(x))

    @property
    def _grid(self) -> tuple[Floats, Floats]:
        """Heights and distances of the table's knots, um."""
        z, rho = (
            h * np.arange(n - 2) for h, n in zip(self._spacing, self._knots.shape, strict=True)
        )
        return z, rho

    def _splines(self, z: Floats, y: Floats, x: Floats, *, knots: Floats) -> tuple[Floats, Floats]:
        """Return the splines of knots (..., a, b) on a grid, (nz, a) and (ny nx, b)."""
        rho = np.hypot(y[:, None], x)
        along, _ = _cubic_splines(np.abs(z) / self._spacing[0], knots.shape[-2])
        across, _ = _cubic_splines(rho.ravel() / self._spacing[1], knots.shape[-1])
        return along, across

    def slope_spot(
        self, slopes: Floats, center: Floats, shape: tuple[int, ...], *, deviation: float = 0.0
    ) -> tuple[tuple[slice, slice, slice], Floats]:
        """Return the voxels that the image covers, and its derivatives (k, nz, ny, nx).

        Parameters
        ----------
        slopes : ndarray, shape (k, ...)
            The tables of `slopes`.
        center : ndarray, shape (3,)
            Position (z, y, x), um.
        shape : tuple of int
            Shape of the array.
        deviation : float
            Deviation of the logarithm of the diameter at which tables of the mean diameter are
            evaluated, by their scale.
        """
        box, offsets = self._covered(center, shape)
        z, y, x = (offset * float(np.exp(-deviation)) for offset in offsets)
        along, across = self._splines(z, y, x, knots=slopes)
        return box, (along @ slopes @ across.T).reshape(len(slopes), len(z), len(y), len(x))

    def slopes(
        self, pairs: Sequence[tuple[BallBlur | PupilBall, BallBlur | PupilBall]], difference: float
    ) -> Floats:
        """Return the tables of derivatives (k, ...) by k parameters, for `slope_spot`.

        Parameters
        ----------
        pairs : sequence of tuple of BallBlur
            The ball with each parameter larger, and with it smaller.
        difference : float
            The change of the parameter between the two.
        """
        z, rho = self._grid
        tables = [larger.intensity(z, rho) - smaller.intensity(z, rho) for larger, smaller in pairs]
        return np.stack([_spline_knots(table / difference) for table in tables])

    def _covered(
        self, center: Floats, shape: tuple[int, ...]
    ) -> tuple[tuple[slice, slice, slice], list[Floats]]:
        """Return the voxels that the image covers, and their offsets from the centre, um."""
        limits = zip(center, self.reach, self.voxel, shape, strict=True)
        z, y, x = (
            slice(
                min(max(int(np.ceil((c - reach) / h)), 0), n),
                max(min(int(np.floor((c + reach) / h)) + 1, n), 0),
            )
            for c, reach, h, n in limits
        )
        offsets = [
            h * np.arange(s.start, s.stop) - c
            for s, h, c in zip((z, y, x), self.voxel, center, strict=True)
        ]
        return (z, y, x), offsets

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
        if self._uneven_knots is not None:
            value += self._change(self.asymmetry, z, y, x)
        by_rho = (profile @ outward.T).reshape(shape)
        gradient = np.empty((3, *shape))
        if self._height_slope is not None:
            by_z = by_z + along @ self._height_slope
        np.matmul(by_z, across.T, out=gradient[0].reshape(len(z), rho.size))
        np.multiply(by_rho, -y[:, None], out=gradient[1])
        np.multiply(by_rho, -x, out=gradient[2])
        return value, gradient


def sphere_image(
    *,
    diameter: float,
    psf: tuple[float, float],
    voxel: tuple[float, float, float],
    tail: PsfTail | None = None,
    spread: float = 0.0,
    measured: PointSpread | None = None,
    shell: bool = False,
    asymmetry: Asymmetry | None = None,
    depth: DepthChange | None = None,
    pupil: Pupil | None = None,
) -> SphereImage:
    """Tabulate a ball convolved with an anisotropic point spread and with the voxels.

    Parameters
    ----------
    diameter : float
        Diameter of the fluorescent sphere, um.
    psf : tuple of float
        Standard deviations of the point spread, (z, plane), um.
    voxel : tuple of float
        Voxel size (z, y, x), um.
    tail : PsfTail, optional
        A second, wider Gaussian of the point spread.
    spread : float
        Relative standard deviation of the diameters of different spheres.
    measured : PointSpread, optional
        A measured point spread, in place of `psf` and `tail`: `psf` is that of its first Gaussian.
    shell : bool
        The surface of the sphere is fluorescent, in place of all of it.
    asymmetry : Asymmetry, optional
        By what the point spread differs from an even body of revolution.
    depth : DepthChange, optional
        How the point spread changes with the height of a sphere in the stack.
    pupil : Pupil, optional
        The point spread of a confocal microscope, in place of `psf` and `tail`.

    Returns
    -------
    SphereImage

    Raises
    ------
    ValueError
        For a length that is not positive, a share of the tail outside 0 to 1, where the blur
        along z is less than within the plane, or for a sphere that is too large for a `Pupil`.

    Notes
    -----
    A voxel of side h enters as a Gaussian of variance h^2/12, exact to the third moment. The image
    of a point spread of two Gaussians is the sum of the two images.

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
    ball: BallBlur | PupilBall
    if pupil is not None:
        require_positive(**{f"pupil {name}": value for name, value in pupil._asdict().items()})
        if diameter > MOST_DIAMETER:
            raise ValueError(
                f"pupil: expected a sphere of at most {MOST_DIAMETER:g} um, got {diameter:g} um"
            )
        wide_z, wide = voxel_variances(voxel).tolist()
        ball = PupilBall(diameter, pupil, (wide_z, wide), shell)
    else:
        spreads = ((1.0, psf),) if measured is None else measured.components
        if measured is None and tail is not None:
            spreads = tail.components(psf)
        ball = BallBlur.of_point_spread(diameter, spreads, voxel=voxel, shell=shell)
    blur_z, blur = ball.components[0][1]
    spacing = _KNOT_SPACING * blur_z, _KNOT_SPACING * blur
    radius = diameter / 2 * float(np.exp(_size_range(spread)))
    z, rho = (
        np.asarray(h * np.arange(int(np.ceil((radius + end) / h)) + 2), dtype=np.float64)
        for h, end in zip(spacing, ball.table_range, strict=True)
    )
    knots = _spline_knots(ball.intensity(z, rho))
    sizes, tables = np.zeros(1), knots[None]
    if spread > 0:
        half = int(np.ceil(_size_range(spread) * diameter / 2 / (_SIZE_SPACING * blur))) + 1
        sizes = np.linspace(-1.0, 1.0, 2 * half + 1) * _size_range(spread)
        tables = _tables_of_sizes(ball, sizes, z, rho)
    frozen(knots, sizes, tables)
    image = SphereImage(
        diameter, psf, voxel, (blur_z, blur), tail, spread, ball, knots, spacing, sizes, tables
    )
    if asymmetry is not None and not any(asymmetry):
        asymmetry = None
    uneven = None
    if asymmetry is not None or (depth is not None and any(depth.slopes[2:])):
        uneven = image.asymmetry_knots()
    high = None
    if depth is not None:
        balls = [ball.widened(*depth.variances(at)) for at in depth.nodes(_HEIGHT_NODES)]
        high = np.stack([_tables_of_sizes(one, sizes, z, rho) for one in balls])
    return replace(
        image, asymmetry=asymmetry, _uneven_knots=uneven, depth=depth, _height_tables=high
    )


def _tables_of_sizes(ball: BallBlur | PupilBall, sizes: Floats, z: Floats, rho: Floats) -> Floats:
    """Return the knots of the images of balls whose logarithms of the diameter deviate."""
    balls = [ball._replace(diameter=ball.diameter * float(np.exp(size))) for size in sizes]
    return np.stack([_spline_knots(one.intensity(z, rho)) for one in balls])


def _cubic_factors(grid: Floats, at: float) -> tuple[Floats, Floats]:
    """Return the factors of tables on an even grid in the cubic between them, and their slopes."""
    step = grid[1] - grid[0]
    t = (at - grid[0]) / step
    first = int(np.clip(np.floor(t) - 1, 0, len(grid) - 4))
    u = t - first
    value, slope = np.zeros((2, len(grid)))
    for k in range(4):
        other = np.array([j for j in range(4) if j != k])
        scale = float(np.prod(k - other))
        a, b, c = u - other
        value[first + k] = a * b * c / scale
        slope[first + k] = (a * b + b * c + a * c) / (scale * step)
    return value, slope


def _size_range(spread: float) -> float:
    """Return the largest deviation of the logarithm of a diameter from the mean."""
    return min(_SIZE_RANGE * spread, _MAX_SIZE_RANGE)


def _spline_knots(table: Floats) -> Floats:
    """Return the knots of the cubic spline through a table that is even along both axes."""
    from scipy.ndimage import spline_filter1d

    for axis in (0, 1):
        table = spline_filter1d(table, axis=axis, mode="mirror")
    # The image is even in z and in rho: the knot before the first equals the one after it.
    return np.pad(table, 1, mode="reflect")


def gaussian_quadrature(z: Floats, width: float, *, blur: float) -> tuple[Floats, Floats]:
    """Return nodes and weights that convolve an even function with a Gaussian.

    Parameters
    ----------
    z : ndarray, shape (m,)
        Where the convolution is wanted, um.
    width : float
        Standard deviation of the Gaussian, um.
    blur : float
        Length over which the function is smooth, um.

    Returns
    -------
    nodes : ndarray, shape (k,)
    weights : ndarray, shape (m, k)

    Notes
    -----
    The sum over even spaces converges exponentially; for a Gaussian far narrower than `blur` three
    Hermite nodes have an error below 1e-8.

    Examples
    --------
    >>> nodes, weights = gaussian_quadrature(np.array([0.0, 2.0]), 0.5, blur=0.4)
    >>> (weights @ nodes**2).round(6)
    array([0.25, 4.25])
    """
    if width < 0.05 * blur:
        nodes = np.concatenate([z, z - np.sqrt(3) * width, z + np.sqrt(3) * width])
        return nodes, np.hstack([np.eye(len(z)) * share for share in (2 / 3, 1 / 6, 1 / 6)])
    step = min(width, blur) / 2
    nodes = step * np.arange(int(np.ceil((z.max() + 6 * width) / step)) + 1)
    weights = np.exp(-0.5 * ((z[:, None] - nodes) / width) ** 2)
    weights += np.exp(-0.5 * ((z[:, None] + nodes) / width) ** 2)
    weights[:, 0] /= 2
    return np.asarray(nodes, dtype=np.float64), weights * (step / (width * np.sqrt(2 * np.pi)))


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
