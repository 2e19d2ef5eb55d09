"""Saturation: voxels that are clipped at the ends of the range of grey levels."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from perrin._arrays import Floats

# Saturation below this number of voxels, or this fraction of them, does not affect any position.
_MIN_CLIPPED, _MIN_CLIPPED_FRACTION = 10, 1e-5

# Number of occupied grey levels below the highest, with which it is compared.
_COMPARED_LEVELS = 3

# Share of a voxel and its neighbours at the lowest grey level from which on it is left out.
_MANY_AT_FLOOR = 0.1

# Number of voxels in which a floor is searched for.
_FLOOR_SAMPLE = 50_000

# Voxels at the lowest grey level over those at the next ones, and largest ratio of the next two.
_PILED, _FLAT = 3.0, 2.0

# Level of the saturation test in one frame: movies have thousands of frames.
_SATURATION_LEVEL = 1e-6


def saturated_share(data: NDArray[Any]) -> float:
    """Return the fraction of voxels that are clipped at the highest grey level; 0 where none is.

    Parameters
    ----------
    data : ndarray
        One frame, in the type in which it was recorded.

    Returns
    -------
    float

    Notes
    -----
    The highest grey level of a frame is the end of the camera's range where it is the largest value
    of an integer type, or where significantly more voxels have it than have any of the three
    occupied grey levels below it: without clipping, the number of voxels decreases from level to
    level. The numbers of voxels at two levels are compared by the binomial test.

    Examples
    --------
    >>> import numpy as np
    >>> frame = np.random.default_rng(1).poisson(200.0, size=100_000).astype(np.uint16)
    >>> saturated_share(frame), round(saturated_share(np.minimum(frame, 230)), 3)
    (0.0, 0.02)
    """
    from scipy.special import bdtrc

    top = data.max()
    count = int(np.count_nonzero(data == top))
    share = count / data.size
    if count < _MIN_CLIPPED or share <= _MIN_CLIPPED_FRACTION:
        return 0.0
    if data.dtype.kind in "iu" and top == np.iinfo(data.dtype).max:
        return share
    numbers = np.unique(data, return_counts=True)[1]
    if len(numbers) == 1:
        return 0.0
    most = int(numbers[-1 - _COMPARED_LEVELS : -1].max())
    # The level is the highest because one voxel has it: that voxel is no evidence.
    return share if bdtrc(count - 2, count - 1 + most, 0.5) < _SATURATION_LEVEL else 0.0


def floor_share(data: NDArray[Any]) -> float:
    """Return the fraction of voxels that are clipped at the lowest grey level; 0 where none is.

    Parameters
    ----------
    data : ndarray
        One frame, in the type in which it was recorded.

    Returns
    -------
    float

    Notes
    -----
    The offset of a camera that is set too low, or a background that was subtracted, cuts the
    distribution of the grey levels where it hardly changes from level to level. The lowest grey
    level is the end of the range where over three times as many voxels have it as have any of the
    next three occupied levels, and the first of these is less than twice as frequent as the
    second. Counts of few photons, which are also often zero, decrease faster.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> grey = rng.normal(-4.0, 5.0, (9, 40, 40)).round()
    >>> round(floor_share(np.maximum(grey, 0)), 2), floor_share(rng.poisson(0.3, (9, 40, 40)))
    (0.82, 0.0)
    """
    # An odd step visits all columns of a frame.
    rest = data.ravel()[:: max(data.size // _FLOOR_SAMPLE, 1) | 1]
    numbers, size = [], rest.size
    for _ in range(1 + _COMPARED_LEVELS):
        if not rest.size:
            return 0.0
        low = rest == rest.min()
        numbers.append(int(np.count_nonzero(low)))
        rest = rest[~low]
    piled = numbers[0] > _PILED * max(numbers[1:]) and numbers[1] < _FLAT * numbers[2]
    return numbers[0] / size if piled else 0.0


def without_clipped(data: NDArray[Any]) -> Floats:
    """Return a frame as float64, with NaN in voxels that are clipped and in their neighbours.

    A voxel that noise keeps just below the end of the range is no sample of its distribution, so
    that all voxels beside clipped ones are left out too: their selection does not depend on their
    own noise. At the floor of the range, where most of a frame may be, those are left out of whose
    neighbours a tenth is clipped: with fewer, the mean of Gaussian noise is moved by less than a
    twentieth of its standard deviation.

    Parameters
    ----------
    data : ndarray
        One frame, in the type in which it was recorded.

    Returns
    -------
    ndarray
        The frame itself where `saturated_share` and `floor_share` find no clipping.

    Examples
    --------
    >>> frame = np.random.default_rng(1).poisson(9.0, size=(9, 40, 40)).astype(np.uint8)
    >>> frame[3:6, 20:23, 20:23] = 255
    >>> int(np.isnan(without_clipped(frame)).sum())
    125
    """
    from scipy.ndimage import binary_dilation, uniform_filter

    frame = np.asarray(data, dtype=np.float64)
    if saturated_share(data) > 0:
        beside = np.ones((3,) * frame.ndim, dtype=np.bool_)
        frame = np.where(binary_dilation(data == data.max(), beside), np.nan, frame)
    if floor_share(data) > 0:
        low = uniform_filter((data == data.min()).astype(np.float64), size=3)
        frame = np.where(low > _MANY_AT_FLOOR, np.nan, frame)
    return frame
