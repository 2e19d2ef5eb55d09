"""Spheres of which only the surface is fluorescent: found by the mean grey level on a surface."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from perrin.images.spheres.by_trackpy import Features

if TYPE_CHECKING:
    from perrin._arrays import Floats

# Least distance of two centres, in contacts, and half the sides of the box in which the higher one
# is searched first.
_CLOSEST_SHELLS, _BOX = 0.7, 0.4

# Voxels around the frame beside the radius, as the search for balls has them.
_MARGIN = 3


def find_shells(
    frame: Floats,
    *,
    diameter: float,
    contact: float,
    voxel: tuple[float, float, float],
    border: bool = True,
) -> Features:
    """Find the centres of fluorescent surfaces of one frame, noise alike.

    Where such spheres touch, the brightest places are their contacts, which a search for balls
    finds. The mean grey level on a sphere of their diameter is largest at their centres.

    Parameters
    ----------
    frame : ndarray, shape (nz, ny, nx)
        Grey levels.
    diameter : float
        Diameter of the fluorescent surface, um.
    contact : float
        Centre distance of touching spheres, um.
    voxel : tuple of float
        Voxel size (z, y, x), um.
    border : bool
        Spheres that the border of the frame cuts are found too, if their centre is inside.

    Returns
    -------
    Features
        `mass` is the mean grey level on the surface over the median of the frame, times the voxels
        of the ball.

    Notes
    -----
    The convolution with the surface is a product with sin(kR)/(kR). Two maxima have a distance of
    0.7 contacts at least: the contact of two spheres is nearer to the centre of either.

    Examples
    --------
    >>> from perrin.images.optics.ball_image import sphere_image
    >>> size, frame = (0.25, 0.2, 0.2), np.zeros((24, 24, 34))
    >>> image = sphere_image(diameter=2.0, psf=(0.4, 0.15), voxel=size, shell=True)
    >>> for x in (2.3, 4.3):
    ...     spot = image.spot(np.array([3.0, 2.5, x]), frame.shape)
    ...     frame[spot.box] += 100 * spot.value
    >>> found = find_shells(frame, diameter=2.0, contact=2.0, voxel=size)
    >>> sorted(found.centers[np.argsort(-found.mass)[:2]].round(1).tolist())
    [[3.0, 2.5, 2.4], [3.0, 2.5, 4.2]]
    """
    from scipy import fft
    from scipy.ndimage import maximum_filter
    from scipy.spatial import cKDTree

    step, radius = np.array(voxel), diameter / 2
    padding = np.ceil(radius / step).astype(int) + _MARGIN
    level = np.asarray(frame, dtype=np.float64)
    padded = np.pad(level - np.median(level), [(p, p) for p in padding], mode="edge")
    size = [fft.next_fast_len(n, real=True) for n in padded.shape]
    k = [2 * np.pi * np.fft.fftfreq(n, h) for n, h in zip(size[:2], step, strict=False)]
    k.append(2 * np.pi * np.fft.rfftfreq(size[2], step[2]))
    length = np.sqrt(k[0][:, None, None] ** 2 + k[1][:, None] ** 2 + k[2] ** 2)
    blurred = fft.irfftn(fft.rfftn(padded, size) * np.sinc(length * radius / np.pi), size)
    inside = tuple(slice(p, p + n) for p, n in zip(padding, level.shape, strict=True))
    mean = np.asarray(blurred[inside])
    box = 2 * np.maximum(np.floor(_BOX * contact / step), 1).astype(int) + 1
    at = np.argwhere((mean == maximum_filter(mean, size=tuple(box.tolist()))) & (mean > 0))
    if not border:
        edge = np.minimum(at, np.array(level.shape) - 1 - at) * step
        at = at[(edge >= radius).all(axis=1)]
    at = at[np.argsort(-mean[tuple(at.T)], kind="stable")]
    kept = np.ones(len(at), dtype=np.bool_)
    near = cKDTree(at * step).query_pairs(_CLOSEST_SHELLS * contact) if len(at) else set()
    for i, j in sorted(near):
        # Pairs are in the order of the higher one, of which it is known whether it is kept.
        kept[j] &= not kept[i]
    at = at[kept]
    height, off = mean[tuple(at.T)], np.zeros(at.shape)
    for axis, n in enumerate(level.shape):
        # The maximum of a parabola through three voxels.
        rows = np.flatnonzero((at[:, axis] > 0) & (at[:, axis] < n - 1))
        one = np.eye(3, dtype=np.int64)[axis]
        low, high = (mean[tuple((at[rows] + side * one).T)] for side in (-1, 1))
        bend = np.maximum(2 * height[rows] - low - high, 1e-300)
        off[rows, axis] = np.clip(0.5 * (high - low) / bend, -0.5, 0.5)
    return Features((at + off) * step, height * (np.pi / 6 * diameter**3 / step.prod()))
