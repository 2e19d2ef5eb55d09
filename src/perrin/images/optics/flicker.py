"""Factors of the light that voxels have in common: of a plane, a line of a scan, or a pixel."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from perrin.images.optics.neighbours import OVERLAP, THIRD_DIFFERENCE

if TYPE_CHECKING:
    from collections.abc import Sequence

    from perrin._arrays import Bools, Floats, Ints
    from perrin.images.optics.optics import CameraNoise

# Flicker is used if its variance is this many standard errors above 0, and its standard deviation
# over this fraction of the light.
_LEAST_FLICKER_ERRORS, _LEAST_FLICKER = 5.0, 0.02

# Distance from the middle of a line, in voxels, within which voxels are on none of its sides.
_GAP_OF_SIDES = 2.0

# Information on the light of a line that is dark.
_LEAST_POWER_OF_SIDES = 1e-9

_WEIGHTING_ROUNDS = 8  # of the weights


class Lines(NamedTuple):
    """Lines of voxels of a window: along x, with the planes that they are in, or along z.

    Attributes
    ----------
    place : ndarray of int, shape (2, l)
        Plane and row (z, y) of every line along x that has voxels, or (x, y) of every line along z.
    order : ndarray of int, shape (m,), or None
        The voxels line by line; None where they are in this order.
    first, length : ndarray of int, shape (l,)
        First voxel of every line in this order, and number of its voxels.
    first_line : ndarray of int, shape (k,)
        First line of every plane that has voxels.
    """

    place: Ints
    order: Ints | None
    first: Ints
    length: Ints
    first_line: Ints

    @classmethod
    def of_scan(cls, mask: Bools) -> Lines:
        """Return the lines along x of the voxels of a mask (nz, ny, nx).

        Examples
        --------
        >>> Lines.of_scan(np.array([[[True, True], [False, False], [True, False]]])).first.tolist()
        [0, 2]
        """
        count = mask.sum(axis=2)
        place = np.stack(np.nonzero(count))
        length = count[place[0], place[1]]
        first_line = np.flatnonzero(np.diff(place[0], prepend=-1))
        return cls(place, None, np.cumsum(length) - length, length, first_line)

    @classmethod
    def of_pixels(cls, mask: Bools) -> Lines:
        """Return the lines along z of the voxels of a mask (nz, ny, nx).

        Examples
        --------
        >>> Lines.of_pixels(np.ones((2, 1, 2), dtype=bool)).order.tolist()
        [0, 2, 1, 3]
        """
        # Voxels of the same x and y, which are in the order of z.
        _, y, x = np.nonzero(mask)
        order = np.lexsort((y, x))
        lines = cls.of_scan(np.swapaxes(mask, 0, 2))
        return lines._replace(order=order)

    @property
    def lines_of_planes(self) -> Ints:
        """Number of lines of every plane that has voxels."""
        return np.asarray(np.diff(self.first_line, append=len(self.first)))

    @property
    def from_middle(self) -> Floats:
        """Distance (m,) of every voxel from the middle of its line, in voxels."""
        middle = self.first + (self.length - 1) / 2
        away = np.arange(float(self.length.sum())) - np.repeat(middle, self.length)
        if self.order is None:
            return away
        out = np.empty_like(away)
        out[self.order] = away
        return out

    def sums(self, rows: Floats) -> Floats:
        """Return the sums (..., l) over the voxels of every line of rows (..., m)."""
        rows = rows if self.order is None else rows[..., self.order]
        return np.asarray(np.add.reduceat(rows, self.first, axis=-1))

    def spread(self, values: Floats) -> Floats:
        """Return values (..., l) of lines for every voxel, (..., m)."""
        rows = np.repeat(values, self.length, axis=-1)
        if self.order is None:
            return rows
        out = np.empty_like(rows)
        out[..., self.order] = rows
        return out


class VoxelPrecision(NamedTuple):
    """Inverse covariance of the voxels of a window: V^-1, and D^-1 for light that does not flicker.

    Attributes
    ----------
    weight : ndarray, shape (m,)
        Inverse variance of every voxel for light that does not flicker, the diagonal of D^-1.
    light : ndarray, shape (m,)
        Expected grey levels above those without light.
    noise : CameraNoise
        With the standard deviations of the factors.
    lines : Lines or None
        Lines of the voxels; None where voxels have no factors in common.
    """

    weight: Floats
    light: Floats
    noise: CameraNoise
    lines: Lines | None

    @staticmethod
    def lines_of(mask: Bools, noise: CameraNoise) -> Lines | None:
        """Return the lines of the voxels of a window that have factors in common."""
        if noise.pixel:
            return Lines.of_pixels(mask)
        return Lines.of_scan(mask) if noise.correlated else None

    @classmethod
    def of(cls, expected: Floats, noise: CameraNoise, lines: Lines | None) -> VoxelPrecision:
        """Return the precision of voxels with these expected grey levels."""
        light = expected if lines is None else noise.light(expected)
        return cls(noise.weight(expected), light, noise, lines)

    def left(self, rows: Floats) -> Floats:
        """Return differences from expected grey levels without the part that factors explain.

        Parameters
        ----------
        rows : ndarray, shape (..., m)
            Differences of the grey levels of the voxels from the expected ones.

        Returns
        -------
        ndarray, shape (..., m)
            D V^-1 times the rows.

        Notes
        -----
        The relative change of the light of a line is the sum of one of its plane and one of its
        own, with the variances of the flicker, or that of its pixel; the rows less the light times
        the most likely changes are D V^-1 times the rows (Woodbury's identity, in which the lines
        of a plane are disjoint).

        Examples
        --------
        >>> from perrin.images import CameraNoise
        >>> lines, level = Lines.of_scan(np.ones((2, 1, 3), dtype=bool)), np.ones(6)
        >>> precision = VoxelPrecision.of(level, CameraNoise(0.01, 0.0, plane=1.0), lines)
        >>> precision.left(np.array([0.3, 0.3, 0.3, 0.3, 0.0, -0.3])).round(2)
        array([ 0. ,  0. ,  0. ,  0.3,  0. , -0.3])
        """
        lines, noise = self.lines, self.noise
        if lines is None:
            return rows
        shared = self.light * self.weight
        sums, power = lines.sums(rows * shared), lines.sums(self.light * shared)
        own = noise.pixel**2 if noise.pixel else noise.line**2
        shrunk = 1.0 / (1.0 + own * power)
        change = own * sums
        if not noise.pixel:
            of_plane = np.add.reduceat(sums * shrunk, lines.first_line, axis=-1)
            power_of_plane = np.add.reduceat(power * shrunk, lines.first_line)
            of_plane *= noise.plane**2 / (1.0 + noise.plane**2 * power_of_plane)
            change += np.repeat(of_plane, lines.lines_of_planes, axis=-1)
        return np.asarray(rows - self.light * lines.spread(shrunk * change))

    def times(self, rows: Floats) -> Floats:
        """Return V^-1 times rows (..., m)."""
        return self.left(rows) * self.weight


class LineChanges(NamedTuple):
    """Relative change of the light of the lines of one window, on both sides of their middle.

    Attributes
    ----------
    lines : Lines
    change : ndarray, shape (2, l)
        Mean change of each side of every line, weighted by the information of its voxels.
    power : ndarray, shape (2, l)
        Inverse variance of these means without common factors.
    """

    lines: Lines
    change: Floats
    power: Floats

    @classmethod
    def of(cls, lines: Lines, residual: Floats, light: Floats, weight: Floats) -> LineChanges:
        """Return the changes of the lines of a window.

        Parameters
        ----------
        lines : Lines
        residual, light, weight : ndarray, shape (m,)
            Grey levels minus expected grey levels, expected light, and inverse variances of the
            voxels within a line.
        """
        away = lines.from_middle
        # Noise that neighbours have in common is not that of both sides.
        sides = np.stack([away < -_GAP_OF_SIDES, away > _GAP_OF_SIDES]) * light * weight
        power = np.maximum(lines.sums(sides * light), _LEAST_POWER_OF_SIDES)
        return cls(lines, lines.sums(sides * residual) / power, power)

    def differences(self, change: Floats, variance: Floats) -> Floats:
        """Return third differences along the first axis of the places, and their variances.

        Parameters
        ----------
        change, variance : ndarray, shape (2, l)
            Of both sides of every line.

        Returns
        -------
        ndarray, shape (2, 2, q)
        """
        place = self.lines.place
        grid = np.full((2, 2, *(place.max(axis=1) + 1)), np.nan)
        grid[:, :, place[0], place[1]] = change, variance
        return _differences_of_sides(grid)


def find_flicker(windows: Sequence[LineChanges]) -> tuple[float, float]:
    """Measure the flicker of the light from plane to plane and from line to line.

    Parameters
    ----------
    windows : sequence of LineChanges
        Of lines along x.

    Returns
    -------
    plane, line : float
        Relative standard deviations of the light of a plane, and of a line about its plane; 0 where
        its variance is less than five standard errors above 0, or the deviation below 2 %.

    Notes
    -----
    The covariance of both sides of a line, in third differences along z: the fits and errors of the
    image of the sphere, which are blurred, do not contribute to differences of four planes that
    follow each other.

    Examples
    --------
    >>> rng, windows = np.random.default_rng(2), []
    >>> lines = Lines.of_scan(np.ones((90, 10, 15), dtype=bool))
    >>> light, weight = np.full(13500, 50.0), np.full(13500, 1 / 49)
    >>> for _ in range(4):
    ...     change = 0.1 * rng.normal(size=(90, 1, 1)) + 0.05 * rng.normal(size=(90, 10, 1))
    ...     residual = 50 * change + rng.normal(0, 7, (90, 10, 15))
    ...     windows.append(LineChanges.of(lines, residual.ravel(), light, weight))
    >>> [round(value, 2) for value in find_flicker(windows)]
    [0.1, 0.05]
    """
    of_planes, of_lines, shares = [], [], []
    for window in windows:
        lines, change, power = window
        total = np.add.reduceat(power, lines.first_line, axis=1)
        mean = np.add.reduceat(power * change, lines.first_line, axis=1) / total
        # A line about the mean of its plane, which contains it.
        whole, middle = (np.repeat(x, lines.lines_of_planes, axis=1) for x in (total, mean))
        own = np.maximum(1 / power - 1 / whole, 0.0)
        of_lines.append(window.differences(change - middle, own))
        planes = np.full((2, 2, int(lines.place[0].max()) + 1, 1), np.nan)
        planes[:, :, lines.place[0, lines.first_line], 0] = mean, 1 / total
        of_planes.append(_differences_of_sides(planes))
        shares.append(np.add.reduceat(np.prod(power / whole, axis=0), lines.first_line))
    share = float(np.mean(np.concatenate(shares)))
    line = _common_variance(np.concatenate(of_lines, axis=2)) / max(1 - share, 0.1)
    plane = _common_variance(np.concatenate(of_planes, axis=2), known=share * line)
    return float(np.sqrt(plane)), float(np.sqrt(line))


def find_gain_spread(windows: Sequence[LineChanges]) -> float:
    """Measure how much the gains of the pixels of a camera differ.

    Parameters
    ----------
    windows : sequence of LineChanges
        Of lines along z.

    Returns
    -------
    float
        Relative standard deviation from pixel to pixel, from third differences along x; 0 where it
        is not significant, as in `find_flicker`.

    Examples
    --------
    >>> rng, mask = np.random.default_rng(1), np.ones((20, 30, 30), dtype=bool)
    >>> residual = 50 * 0.05 * rng.normal(size=(30, 30)) + rng.normal(0, 7, mask.shape)
    >>> light, weight = np.full(mask.size, 50.0), np.full(mask.size, 1 / 49)
    >>> window = LineChanges.of(Lines.of_pixels(mask), residual.ravel(), light, weight)
    >>> round(find_gain_spread([window]), 2)
    0.05
    """
    differences = [window.differences(window.change, 1 / window.power) for window in windows]
    return float(np.sqrt(_common_variance(np.concatenate(differences, axis=2))))


def _differences_of_sides(grid: Floats) -> Floats:
    """Return third differences of values along the first axis of a grid, and their variances.

    Parameters
    ----------
    grid : ndarray, shape (2, 2, a, b)
        Values and variances of both sides; NaN where there are none.

    Returns
    -------
    ndarray, shape (2, 2, q)
    """
    if grid.shape[2] < len(THIRD_DIFFERENCE):
        return np.empty((2, 2, 0))
    quads = np.lib.stride_tricks.sliding_window_view(grid, len(THIRD_DIFFERENCE), axis=2)
    both = np.stack([quads[0] @ THIRD_DIFFERENCE, quads[1] @ THIRD_DIFFERENCE**2])
    return np.asarray(both[:, :, np.isfinite(both).all(axis=(0, 1))])


def _common_variance(differences: Floats, *, known: float = 0.0) -> float:
    """Return the variance that both sides have in common, beyond a known one; 0 if insignificant.

    Parameters
    ----------
    differences : ndarray, shape (2, 2, q)
        Third differences of both sides and their variances without common factors.
    known : float
        Variance of a single value that both sides have in common.
    """
    # The only lines of their planes do not differ from these.
    (first, second), noise = differences[:, :, differences[1].min(axis=0) > 0]
    single = float(np.sum(THIRD_DIFFERENCE**2))
    if not first.size:
        return 0.0
    product, found = first * second, 0.0
    for _ in range(_WEIGHTING_ROUNDS):
        weight = 1.0 / np.prod(noise + single * found, axis=0)
        found = max(float(weight @ product / (single * weight.sum())), 0.0)
    # The difference of both sides has what the noise really is.
    weight = 1.0 / np.prod(noise, axis=0)
    scale = float(weight @ (first - second) ** 2 / (weight @ noise.sum(axis=0)))
    error = scale * np.sqrt(OVERLAP / weight.sum()) / single
    variance = found - known
    large = variance > _LEAST_FLICKER**2 and variance > _LEAST_FLICKER_ERRORS * error
    return variance if large else 0.0
