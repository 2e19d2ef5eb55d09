"""The point spread function of a microscope, measured on beads that are smaller than it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

from perrin._arrays import number_fault, refuse, to_plain
from perrin._text import listed

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from perrin._arrays import Floats

# Widths (standard deviations) in the plane of the Gaussians that are tried, um, and ratios of the
# widths along z to them.
_WIDTHS = np.geomspace(0.03, 0.9, 16)
_ELONGATIONS = (1.1, 1.5, 2.0, 2.8, 4.0, 5.6, 8.0)

# Largest width along z, um: the light of wider ones is background around a bead.
_MOST_RADIUS = 1.5

# A Gaussian with a smaller share of the intensity is left out.
_LEAST_COMPONENT = 0.01

# A bead is a maximum above this many standard deviations of the background, with a brightness
# between these multiples of the median: dimmer ones are noise, brighter ones are aggregates.
_BRIGHT_BEAD, _BEAD_BRIGHTNESS = 8.0, (0.4, 1.8)

# Half sizes (z, plane) of the voxels around a bead, um, and the most beads that are used.
_AROUND, _MOST_BEADS = (2.6, 1.4), 60

# Rounds of shares, brightness and background.
_BEAD_ROUNDS = 3


class StackLike(Protocol):
    """A movie as search and fits need it: its sizes, and one frame at a time."""

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Number of frames, and voxels of a frame: (t, z, y, x)."""

    @property
    def voxel(self) -> Floats | tuple[float, float, float]:
        """Voxel size (z, y, x), um; z is NaN for a 2-D movie."""

    def frame(self, i: int, /) -> Floats:
        """Return frame i, (z, y, x)."""


@dataclass(frozen=True)
class PointSpread:
    """A point spread function as a sum of Gaussians, symmetric about the optical axis and in z.

    Attributes
    ----------
    components : tuple
        ``(share, (z, plane))``: the share of the intensity of each Gaussian and its standard
        deviations, um, without the voxels; the narrowest first.
    beads : int
        Number of beads on which it was measured; 0 where it was stated.
    misfit : float
        Root mean square deviation of the mean bead from the sum, over its maximum.

    Examples
    --------
    >>> spread = PointSpread(((0.8, (0.4, 0.15)), (0.2, (0.9, 0.4))))
    >>> PointSpread.from_dict(spread.to_dict()) == spread
    True
    """

    components: tuple[tuple[float, tuple[float, float]], ...]
    beads: int = 0
    misfit: float = 0.0

    def __post_init__(self) -> None:
        """Check that the widths are lengths and that the shares are those of one intensity."""
        faults: list[str] = []
        if not self.components:
            faults.append("components: expected one Gaussian or more, got none")
        for share, (z, plane) in self.components:
            faults += number_fault("share", share, above=0)
            faults += number_fault("width along z", z, above=0, unit="um")
            faults += number_fault("width in the plane", plane, above=0, unit="um")
        total = sum(share for share, _ in self.components)
        if not faults and abs(total - 1) > 1e-6:
            faults.append(f"components: expected shares with the sum 1, got {total:.6g}")
        refuse(faults)

    @property
    def fwhm(self) -> tuple[float, float]:
        """Full widths at half maximum along z and in the plane, um."""
        widths = []
        for axis in (0, 1):
            x = np.linspace(0.0, 3 * max(w[axis] for _, w in self.components), 2000)
            line = np.zeros_like(x)
            for share, (z, plane) in self.components:
                line += share / (z * plane**2) * np.exp(-0.5 * (x / (z, plane)[axis]) ** 2)
            widths.append(2 * float(np.interp(-0.5 * line[0], -line, x)))
        return widths[0], widths[1]

    def to_dict(self) -> dict[str, Any]:
        """Return values that JSON holds."""
        return {
            "components": [[share, list(widths)] for share, widths in self.components],
            "beads": int(self.beads),
            "misfit": to_plain(self.misfit),
        }

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> PointSpread:
        """Return the point spread that `to_dict` wrote.

        Parameters
        ----------
        entry : mapping
            The dictionary of `to_dict`.

        Returns
        -------
        PointSpread
        """
        parts = tuple((float(share), (float(z), float(r))) for share, (z, r) in entry["components"])
        return cls(parts, int(entry["beads"]), float(entry["misfit"]))


def voxel_variances(voxel: Floats | tuple[float, float, float]) -> Floats:
    """Return the variances (z, plane) of a Gaussian that stands for a voxel, um^2.

    A voxel of side h has the variance h^2/12.

    Parameters
    ----------
    voxel : tuple of float
        Voxel size (z, y, x), um.

    Returns
    -------
    ndarray, shape (2,)

    Examples
    --------
    >>> voxel_variances((0.6, 0.3, 0.2)).round(4)
    array([0.03 , 0.005])
    """
    return np.array([voxel[0] ** 2, voxel[1] * voxel[2]]) / 12


class Bead(NamedTuple):
    """The voxels around one bead.

    Attributes
    ----------
    height, radius : ndarray, shape (m,)
        Distances from its centre along z, and from its axis, um.
    data : ndarray, shape (m,)
        Grey levels.
    brightness : float
        Integral of its image, grey levels um^3.
    background : float
        Grey level beside it.
    """

    height: Floats
    radius: Floats
    data: Floats
    brightness: float
    background: float

    @classmethod
    def at(cls, frame: Floats, place: Sequence[int] | Floats, half: Floats, voxel: Floats) -> Bead:
        """Return the voxels around a bead, relative to the centre of a Gaussian fitted to them.

        Parameters
        ----------
        frame : ndarray, shape (nz, ny, nx)
            Grey levels.
        place, half : ndarray of int, shape (3,)
            The brightest voxel (z, y, x), and the number of voxels on either side of it.
        voxel : ndarray, shape (3,)
            Voxel size (z, y, x), um.
        """
        from scipy.optimize import least_squares

        box = tuple(slice(int(p - h), int(p + h + 1)) for p, h in zip(place, half, strict=True))
        data = frame[box]
        grid = [v * np.arange(-h, h + 1) for h, v in zip(half, voxel, strict=True)]
        z, y, x = np.meshgrid(*grid, indexing="ij", sparse=True)
        level = float(np.median(data))

        def residual(p: Floats) -> Floats:
            exponent = ((z - p[0]) / np.exp(p[3])) ** 2
            exponent = exponent + ((y - p[1]) ** 2 + (x - p[2]) ** 2) / np.exp(2 * p[4])
            return np.asarray((p[5] * np.exp(-0.5 * exponent) + p[6] - data).ravel())

        start = [0.0, 0.0, 0.0, np.log(0.4), np.log(0.2), float(data.max()) - level, level]
        fit = least_squares(residual, start, x_scale=[0.1, 0.1, 0.1, 0.3, 0.3, start[5], start[5]])
        cz, cy, cx, wide_z, wide, peak, background = fit.x.tolist()
        radius = np.broadcast_to(np.hypot(y - cy, x - cx), data.shape).ravel()
        height = np.broadcast_to(z - cz, data.shape).ravel()
        integral = peak * np.exp(wide_z + 2 * wide) * (2 * np.pi) ** 1.5
        return cls(height, radius, data.ravel(), float(integral), background)


def measure_point_spread(stack: StackLike, *, diameter: float = 0.1) -> PointSpread:
    """Measure the point spread function on a stack of beads.

    Parameters
    ----------
    stack : Stack
        Beads at rest, some micrometres apart, in the medium and at the depth of the spheres, with
        voxels of at most half of the width of the point spread. Frames are averaged.
    diameter : float
        Diameter of the beads, um.

    Returns
    -------
    PointSpread

    Raises
    ------
    ValueError
        If there are no beads that are apart from each other and from the borders.

    Notes
    -----
    The centre of every bead is that of a Gaussian that is fitted to it. The shares of Gaussians of
    many widths are those of non-negative least squares to all beads together, in turn with the
    brightness and the background of each. Voxels and beads enter as Gaussians of their variance
    (h^2/12, d^2/20). An asymmetric point spread (coma, astigmatism, spherical aberration) is
    averaged over directions in the plane and over both sides of the focus; `misfit` has what is
    left.

    Examples
    --------
    >>> import perrin
    >>> places = [[x, y, 4.0] for x in (3.0, 7.0, 11.0) for y in (3.1, 7.2)]
    >>> beads = perrin.render_stack(
    ...     [places], voxel=(0.2, 0.1, 0.1), shape=(41, 104, 140), diameter=0.1, dt=1.0,
    ...     psf=(0.4, 0.15, 0.15), photons=400, background=2.0, rng=1,
    ... )
    >>> spread = measure_point_spread(beads)
    >>> spread.beads, [round(width / 2.355, 2) for width in spread.fwhm]
    (6, [0.39, 0.15])
    """
    from scipy.optimize import nnls

    refuse(number_fault("diameter", diameter, least=0, unit="um"))
    voxel = np.asarray(stack.voxel, dtype=np.float64)
    if not np.isfinite(voxel).all():
        raise ValueError("psf: a 2-D movie of beads shows no point spread along z")
    frame = np.zeros(stack.shape[1:])
    for i in range(stack.shape[0]):
        frame += np.asarray(stack.frame(i), dtype=np.float64) / stack.shape[0]
    beads = find_beads(frame, voxel)
    widths = np.array(
        [(ratio * r, r) for r in _WIDTHS for ratio in _ELONGATIONS if ratio * r <= _MOST_RADIUS]
    )
    # Variances of a voxel and of a bead.
    added = voxel_variances(voxel) + diameter**2 / 20
    total = np.sqrt(widths**2 + added)
    # Gaussians of unit integral.
    columns = [
        np.exp(
            -0.5 * ((b.height[:, None] / total[:, 0]) ** 2 + (b.radius[:, None] / total[:, 1]) ** 2)
        )
        / (total[:, 0] * total[:, 1] ** 2 * (2 * np.pi) ** 1.5)
        for b in beads
    ]
    shares = np.zeros(len(widths))
    for _ in range(_BEAD_ROUNDS):
        design = np.concatenate(
            [b.brightness * column for b, column in zip(beads, columns, strict=True)]
        )
        target = np.concatenate([b.data - b.background for b in beads])
        normal = design.T @ design
        factor = np.linalg.cholesky(normal + 1e-9 * np.trace(normal) * np.eye(len(normal)))
        shares = nnls(factor.T, np.linalg.solve(factor, design.T @ target))[0]
        shares = np.where(shares < _LEAST_COMPONENT * shares.sum(), 0.0, shares)
        shares /= shares.sum()
        scaled = []
        for bead, column in zip(beads, columns, strict=True):
            rows = np.stack([column @ shares, np.ones(len(bead.data))], axis=1)
            bright, level = np.linalg.lstsq(rows, bead.data, rcond=None)[0].tolist()
            scaled.append(bead._replace(brightness=bright, background=level))
        beads = scaled
    used = np.flatnonzero(shares)
    used = used[np.argsort(widths[used, 1] * widths[used, 0] ** 0.5, kind="stable")]
    components = tuple((float(shares[k]), (float(widths[k, 0]), float(widths[k, 1]))) for k in used)
    # The mean bead by distance in the plane and height, in steps of a tenth of a micrometre.
    height = np.concatenate([np.rint(np.abs(b.height) / 0.1) for b in beads]).astype(int)
    radius = np.concatenate([np.rint(b.radius / 0.1) for b in beads]).astype(int)
    spreads = [column @ shares for column in columns]
    off = np.concatenate(
        [
            (b.data - b.background) / b.brightness - spread
            for b, spread in zip(beads, spreads, strict=True)
        ]
    )
    cell = height * (radius.max() + 1) + radius
    count = np.bincount(cell)
    mean = np.bincount(cell, off)[count > 0] / count[count > 0]
    peak = max(float(spread.max()) for spread in spreads)
    misfit = float(np.sqrt(np.mean(mean**2)) / peak)
    return PointSpread(components, len(beads), misfit)


def find_beads(frame: Floats, voxel: Floats) -> list[Bead]:
    """Return the beads of a frame that are apart from others and whole, with fitted centres.

    Parameters
    ----------
    frame : ndarray, shape (nz, ny, nx)
        Grey levels.
    voxel : ndarray, shape (3,)
        Voxel size (z, y, x), um.

    Returns
    -------
    list of Bead

    Raises
    ------
    ValueError
        If there are none.

    Examples
    --------
    >>> frame = np.random.default_rng(1).normal(10.0, 1.0, (31, 41, 41))
    >>> frame[13:18, 18:23, 18:23] += 90 * np.exp(-np.abs(np.arange(-2, 3)))
    >>> len(find_beads(frame, np.array([0.2, 0.1, 0.1])))
    1
    """
    from scipy.ndimage import gaussian_filter, maximum_filter

    half = np.ceil(np.array([_AROUND[0], _AROUND[1], _AROUND[1]]) / voxel).astype(int)
    smooth = gaussian_filter(frame, 1.0)
    level = float(np.median(smooth))
    noise = 1.4826 * float(np.median(np.abs(smooth - level)))
    peaks = (smooth == maximum_filter(smooth, size=5)) & (smooth > level + _BRIGHT_BEAD * noise)
    places = np.argwhere(peaks)
    heights = smooth[peaks] - level
    least = 0.1 * heights.max(initial=0.0)
    places, heights = places[heights > least], heights[heights > least]
    whole = np.all((places >= half) & (places < np.array(frame.shape) - half), axis=1)
    apart = [
        k
        for k, place in enumerate(places)
        if whole[k] and (np.abs(places - place) <= 2 * half * 0.75).all(axis=1).sum() == 1
    ]
    typical = float(np.median(heights[apart])) if apart else 0.0
    low, high = (factor * typical for factor in _BEAD_BRIGHTNESS)
    chosen = [k for k in apart if low <= heights[k] <= high][:_MOST_BEADS]
    if not chosen:
        raise ValueError(
            f"psf: {len(places)} bright spots, and none of them is a bead that is "
            f"{listed(2 * a for a in _AROUND)} um (z, plane) from others and from the borders: "
            "record sparse beads that are smaller than the point spread"
        )
    return [Bead.at(frame, places[k], half, voxel) for k in chosen]
