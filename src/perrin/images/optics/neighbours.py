"""Noise of neighbouring voxels: its variance from their differences, and their correlation."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from perrin._arrays import Bools, Floats

# Factors of four neighbours in their third difference; the sum of their squares is 20.
THIRD_DIFFERENCE = np.array([-1.0, 3.0, -3.0, 1.0])

# Overlapping third differences of independent values have correlations -15/20, 6/20 and -1/20: the
# mean of their squares has a variance that is larger by this factor.
OVERLAP = 1.0 + 2.0 * (0.75**2 + 0.3**2 + 0.05**2)

# Number of voxels, along each axis, over which noise is correlated.
_REACH = 4

# Correlations are used if they are this many standard errors from 0, and all together only if
# nearest neighbours have at least this one, and if they increase the variance of a sum of many
# voxels by at least this share.
_LEAST_ERRORS, _LEAST_NEAREST, _LEAST_INCREASE = 5.0, 0.05, 0.2

# Correlation of voxels of neighbouring planes from which on an image was smoothed along z too:
# errors of the model of the image, and the blocks of compressed images, leave smaller ones.
_LEAST_ALONG_Z = 0.3

# Least variance of a spatial frequency over that of independent voxels.
_LEAST_NEIGHBOUR_POWER = 0.05


def neighbour_variance(
    residual: Floats, expected: Floats, used: Bools, *, axis: int
) -> tuple[Floats, Floats]:
    """Estimate the variance of voxels or pixels from the differences of neighbours.

    Parameters
    ----------
    residual, expected : ndarray, shape (nz, ny, nx) or (ny, nx)
        Grey levels minus expected grey levels, and expected grey levels.
    used : ndarray of bool, shape (nz, ny, nx) or (ny, nx)
        The voxels that are used.
    axis : int
        The axis along which they are neighbours.

    Returns
    -------
    expected : ndarray, shape (m,)
        Expected grey level of every four neighbours along the axis.
    variance : ndarray, shape (m,)
        Their squared third differences over 20, the sum of squares of the factors 1, 3, 3, 1.

    Notes
    -----
    An error of the model of the image is blurred as the image is, so that its third differences
    are small: with a blur of b voxels they have 15 / (2 b^2)^3 / 20 of the error's variance (the
    sixth moment of its Gaussian spectrum), 1 % for b = 1.5. Noise that is constant along the axis
    does not contribute.

    Examples
    --------
    >>> noise = np.random.default_rng(1).normal(0.0, 3.0, (20, 30, 30))
    >>> misfit = 5 * np.cos(np.arange(20) / 3)[:, None, None]
    >>> used, level = np.ones(noise.shape, dtype=bool), np.full(noise.shape, 7.0)
    >>> expected, variance = neighbour_variance(noise + misfit, level, used, axis=0)
    >>> expected.mean().round(), variance.mean().round(1), (noise + misfit).var().round(1)
    (np.float64(7.0), np.float64(8.9), np.float64(22.1))
    """
    if used.shape[axis] < len(THIRD_DIFFERENCE):
        return np.empty(0), np.empty(0)
    quads = (
        np.lib.stride_tricks.sliding_window_view(field, len(THIRD_DIFFERENCE), axis=axis)
        for field in (residual, expected, used)
    )
    difference, level, together = quads
    kept = together.all(axis=-1)
    share = THIRD_DIFFERENCE**2 / np.sum(THIRD_DIFFERENCE**2)
    square = (difference @ THIRD_DIFFERENCE)[kept] ** 2 / np.sum(THIRD_DIFFERENCE**2)
    return (level @ share)[kept], square


def find_neighbours(
    windows: Sequence[tuple[Bools, Floats]],
) -> tuple[tuple[tuple[float, ...], ...], tuple[float, ...]]:
    """Measure the correlation of the noise of neighbouring voxels.

    Parameters
    ----------
    windows : sequence of tuple
        Mask (nz, ny, nx) of the m voxels of each window, and their residuals (m,) in standard
        deviations.

    Returns
    -------
    neighbours : tuple of tuple of float
        Correlation of voxels of a plane i rows and j columns apart (either sign), i, j up to 4;
        empty where nearest neighbours are not correlated.
    along_z : tuple of float
        What `find_along_z` returns, empty where `neighbours` is.

    Notes
    -----
    In a plane third differences along z, to which errors of the model of the image, which are
    blurred as the image is, contribute a hundredth of their variance.

    Examples
    --------
    >>> noise = np.random.default_rng(1).normal(size=(20, 50, 50))
    >>> found = find_neighbours([(np.ones(noise.shape, dtype=bool), noise.ravel())])
    >>> pairs = (noise + np.roll(noise, 1, axis=2)) / np.sqrt(2)
    >>> mask = np.ones(noise.shape, dtype=bool)
    >>> found, round(find_neighbours([(mask, pairs.ravel())])[0][0][1], 1)
    (((), ()), 0.5)
    """
    lags, square, count = _REACH + 1, 0.0, 0.0
    products, pairs = np.zeros((2, lags, lags))
    for mask, residual in windows:
        box = np.full(mask.shape, np.nan)
        box[mask] = residual
        if len(box) < len(THIRD_DIFFERENCE):
            continue
        quads = np.lib.stride_tricks.sliding_window_view(box, len(THIRD_DIFFERENCE), axis=0)
        difference = quads @ THIRD_DIFFERENCE
        there = np.isfinite(difference)
        difference = np.where(there, difference, 0.0)
        square, count = square + float(np.sum(difference**2)), count + float(there.sum())
        size = (mask.shape[1] + _REACH, mask.shape[2] + _REACH)
        for total, field in ((products, difference), (pairs, there)):
            power = np.sum(np.abs(np.fft.rfft2(field, size)) ** 2, axis=0)
            lagged = np.fft.irfft2(power, size)[:lags]
            total += lagged[:, :lags]
            total[:, 1:] += lagged[:, :-lags:-1]
    if not square > 0:
        return (), ()
    found = products / np.maximum(pairs, 1.0) / (square / count)
    found[np.abs(found) <= _LEAST_ERRORS * np.sqrt(OVERLAP / count)] = 0.0
    found[0, 0] = 1.0
    neighbours = tuple(tuple(row) for row in found.tolist())
    increase = float(_both_signs(neighbours).sum()) - 1
    if max(found[0, 1], found[1, 0]) < _LEAST_NEAREST or increase <= _LEAST_INCREASE:
        return (), ()
    return neighbours, find_along_z(windows)


def find_along_z(windows: Sequence[tuple[Bools, Floats]]) -> tuple[float, ...]:
    """Measure the correlation of the noise of voxels above each other, in a smoothed image.

    Parameters
    ----------
    windows : sequence of tuple
        As in `find_neighbours`.

    Returns
    -------
    tuple of float
        Correlation of voxels k planes apart, k up to 4; empty where that of neighbouring planes is
        below 0.3.

    Examples
    --------
    >>> noise, mask = np.random.default_rng(1).normal(size=(20, 50, 50)), np.ones((19, 50, 50))
    >>> pairs = (noise[1:] + noise[:-1]) / np.sqrt(2)
    >>> [round(value, 1) for value in find_along_z([(mask > 0, pairs.ravel())])[:2]]
    [1.0, 0.5]
    """
    products, pairs = np.zeros((2, _REACH + 1))
    for mask, residual in windows:
        box = np.zeros(mask.shape)
        box[mask] = residual
        for k in range(min(_REACH + 1, len(box))):
            products[k] += np.sum(box[k:] * box[: len(box) - k])
            pairs[k] += np.count_nonzero(mask[k:] & mask[: len(box) - k])
    if not products[0] > 0:
        return ()
    found = products / np.maximum(pairs, 1) / (products[0] / pairs[0])
    return tuple(found.tolist()) if found[1] > _LEAST_ALONG_Z else ()


def neighbour_covariance(
    rows: Floats,
    mask: Bools,
    neighbours: tuple[tuple[float, ...], ...],
    *,
    along_z: tuple[float, ...] = (),
) -> Floats:
    """Return what correlations of neighbours add to the covariance of sums over voxels.

    Parameters
    ----------
    rows : ndarray, shape (p, m)
        Factors of the m voxels in p sums, of noise in standard deviations.
    mask : ndarray of bool, shape (nz, ny, nx)
        The voxels.
    neighbours : tuple of tuple of float
        As `find_neighbours` returns it.
    along_z : tuple of float
        As `find_along_z` returns it: factors of the correlation of voxels in different planes.

    Returns
    -------
    ndarray, shape (p, p)

    Examples
    --------
    >>> pair = np.ones((1, 1, 2), dtype=bool)
    >>> neighbour_covariance(np.ones((1, 2)), pair, ((1.0, 0.5), (0.0, 0.0))).round(6)
    array([[1.]])
    """
    both = _both_signs(neighbours)
    reach = len(neighbours) - 1
    size = (mask.shape[1] + reach, mask.shape[2] + reach)
    kernel = np.zeros(size)
    offset = np.arange(-reach, reach + 1)
    kernel[np.ix_(offset, offset)] = both
    power = np.maximum(np.fft.rfft2(kernel).real, _LEAST_NEIGHBOUR_POWER)
    # Frequencies that the real transform leaves out are the conjugates of others.
    power[:, 1 : (size[1] + 1) // 2] *= 2.0
    boxes = np.zeros((len(rows), *mask.shape))
    boxes[:, mask] = rows
    wave = np.fft.rfft2(boxes, size).reshape(*boxes.shape[:2], -1)
    other = wave * power.ravel()
    if along_z:
        planes = np.arange(len(mask))
        apart = np.minimum(np.abs(planes[:, None] - planes), len(along_z))
        other = np.append(along_z, 0.0)[apart].astype(np.complex128) @ other
    total = (other.reshape(len(rows), -1) @ wave.reshape(len(rows), -1).conj().T).real
    return np.asarray(total / (size[0] * size[1]) - rows @ rows.T)


def _both_signs(neighbours: tuple[tuple[float, ...], ...]) -> Floats:
    """Return correlations at lags from -k to k along both axes."""
    quarter = np.array(neighbours)
    half = np.concatenate([quarter[:0:-1], quarter])
    return np.concatenate([half[:, :0:-1], half], axis=1)
