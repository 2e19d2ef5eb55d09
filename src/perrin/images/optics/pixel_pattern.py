"""The fixed pattern of a camera: pixels whose grey levels differ in all planes and frames."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from perrin.images.optics.clipping import without_clipped

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from perrin._arrays import Floats

# Pixels of a third difference, whose factors -1, 3, -3, 1 have squares of the sum 20.
_REACH = 4

# Planes of which the darker ones show the background.
_FEWEST_PLANES = 8

# Pattern over the noise of a voxel from which on it is subtracted.
_LEAST_PATTERN = 0.25

# Distance, in pixels, over which what varies smoothly is not a pattern of pixels.
_SMOOTH = 3.0

# Covariance of third differences one pixel apart, over their variance, above which the pattern is a
# blurred one; that of independent pixels is -0.75.
_WHITE = -0.5


class PixelPattern(NamedTuple):
    """How much pixels differ.

    Attributes
    ----------
    offset : float
        Standard deviation from pixel to pixel of the grey level of the background; 0 where
        neighbouring pixels do not differ, or differ by a blurred image.
    noise : float
        Standard deviation of the noise of a voxel of the background, grey levels.
    """

    offset: float
    noise: float

    @property
    def significant(self) -> bool:
        """Whether pixels differ by over a quarter of the noise of a voxel."""
        return 0 < _LEAST_PATTERN * self.noise < self.offset


def find_pixel_pattern(frames: Sequence[NDArray[Any]]) -> PixelPattern:
    """Measure how much the grey levels of pixels differ in all planes and frames (sCMOS).

    Parameters
    ----------
    frames : sequence of ndarray, shape (nz, ny, nx)
        Frames of a movie, of which the first and the last are compared.

    Returns
    -------
    PixelPattern

    Notes
    -----
    The darker half of the planes of a pixel is the background where spheres fill less than half of
    them. The product of its third differences along a row in two frames has no
    contribution of the noise. Spheres move between the frames, and their images are blurred: only
    patterns whose neighbouring third differences have a covariance of less than -1/2 of their
    variance, as those of independent pixels (-3/4), are patterns of the camera.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> pattern = 4 * rng.normal(size=(40, 40))
    >>> frames = [20 + pattern + 5 * rng.normal(size=(24, 40, 40)) for _ in range(2)]
    >>> [round(value, 1) for value in find_pixel_pattern(frames)]
    [4.1, 5.0]
    """
    first, last = np.asarray(frames[0]), np.asarray(frames[-1])
    if len(first) < _FEWEST_PLANES or first.shape[2] < 2 * _REACH:
        return PixelPattern(0.0, 0.0)
    a, b = (_differences(_background([frame])) for frame in (first, last))
    variance = float(np.mean(a * b)) / 20
    beside = float(np.mean(a[:, 1:] * b[:, :-1] + a[:, :-1] * b[:, 1:])) / 40
    spread = np.median(np.abs(_differences(first.reshape(-1, first.shape[2]))))
    noise = float(spread / 0.6745 / np.sqrt(20))
    # The variance of the voxels has that of the pattern too.
    if not (variance > 0 and beside < _WHITE * variance):
        return PixelPattern(0.0, noise)
    return PixelPattern(float(np.sqrt(variance)), float(np.sqrt(max(noise**2 - variance, 0.0))))


def pixel_offsets(frames: Sequence[NDArray[Any]]) -> Floats:
    """Return by how much the grey level of every pixel differs from those around it.

    Parameters
    ----------
    frames : sequence of ndarray, shape (nz, ny, nx)
        Frames of a movie; the more, the more exact.

    Returns
    -------
    ndarray, shape (ny, nx)
        Mean of the darker half of all planes of all frames, less its mean over some pixels, in
        hundredths of a grey level.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> pattern = 4 * rng.normal(size=(40, 40))
    >>> found = pixel_offsets([20 + pattern + rng.normal(size=(24, 40, 40)) for _ in range(5)])
    >>> bool(np.std(found - pattern) < 1)
    True
    """
    from scipy.ndimage import gaussian_filter

    level = _background(frames)
    return np.asarray(np.round(level - gaussian_filter(level, _SMOOTH), 2))


def without_pattern(data: NDArray[Any], pattern: Floats | None) -> Floats:
    """Return a frame for fits: without clipped voxels and without the pattern of the pixels.

    Parameters
    ----------
    data : ndarray, shape (nz, ny, nx)
        One frame, in the type in which it was recorded.
    pattern : ndarray, shape (ny, nx), or None
        Grey levels that are subtracted from every plane.

    Returns
    -------
    ndarray

    Examples
    --------
    >>> without_pattern(np.full((1, 2, 2), 7), np.array([[1.0, 0.0], [0.0, -1.0]]))[0].tolist()
    [[6.0, 7.0], [7.0, 8.0]]
    """
    frame = without_clipped(data)
    return frame if pattern is None else frame - pattern


def _background(frames: Sequence[NDArray[Any]]) -> Floats:
    """Return the mean of the darker half of the planes at every pixel, (ny, nx)."""
    planes = np.concatenate([np.asarray(frame) for frame in frames])
    half = len(planes) // 2
    return np.asarray(np.partition(planes, half, axis=0)[:half].mean(axis=0), dtype=np.float64)


def _differences(rows: NDArray[Any]) -> Floats:
    """Return the third differences along the rows of an image."""
    x = rows.astype(np.float64)
    return x[:, 3:] - 3 * x[:, 2:-1] + 3 * x[:, 1:-2] - x[:, :-3]
