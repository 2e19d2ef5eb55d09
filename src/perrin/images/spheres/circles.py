"""Centres of circular symmetry in a frame of one plane: where spheres are, however they look."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from perrin.images.spheres.by_trackpy import Features

if TYPE_CHECKING:
    from perrin._arrays import Floats


# Contact distance in pixels from which pixels are combined: the search needs no more.
_FINEST = 16

# Distance up to which gradients point at a centre, and the least distance of two centres, in
# contact distances; a sphere's rim is at a half.
_FURTHEST, _SEPARATION = 0.6, 0.7

# Range of the mass that separates spheres from other spots, over the usual mass of spheres.
_CUTS = (0.1, 0.5)

# Smoothing before the gradient and of the map of centres, pixels.
_SMOOTHING = 1.0


def find_circles(
    frame: Floats, *, contact: float, pixel: tuple[float, float], margin: float = 0.0
) -> Features:
    """Find the centres of circular symmetry of a frame: discs, rings, spots and fringes alike.

    Parameters
    ----------
    frame : ndarray, shape (ny, nx)
        Grey levels.
    contact : float
        Centre distance of touching spheres, um.
    pixel : tuple of float
        Pixel size (y, x), um.
    margin : float
        Least distance of a centre from the border, um.

    Returns
    -------
    Features
        With z = 0. The mass grows in proportion to the contrast, bright or dark.

    Notes
    -----
    The gradient of a circular image points at its centre or away from it. Every pixel votes for the
    places along the line of its gradient, up to the rim of a sphere, with the root of its gradient;
    the spots are the local maxima of the votes, and their mass is the square of their height over
    the median height (Loy and Zelinsky 2003, radial symmetry, without regard to sign).

    Examples
    --------
    >>> y, x = np.meshgrid(0.2 * np.arange(40), 0.2 * np.arange(40), indexing="ij")
    >>> distance = np.hypot(y - 3.0, x - 4.2)
    >>> dark_rim = -np.exp(-(((distance - 1.0) / 0.2) ** 2))
    >>> found = find_circles(dark_rim, contact=2.4, pixel=(0.2, 0.2))
    >>> found.centers[found.mass.argmax()].round(1)
    array([0. , 3. , 4.2])
    """
    from scipy.ndimage import gaussian_filter, maximum_filter

    step = np.array(pixel)
    combined = np.maximum((contact / step / _FINEST).astype(int), 1)
    ny, nx = (np.array(frame.shape) // combined).tolist()
    shape = (ny, combined[0], nx, combined[1])
    coarse = frame[: ny * combined[0], : nx * combined[1]].reshape(shape).mean(axis=(1, 3))
    shift, step = (combined - 1) / 2 * step, step * combined

    gradient = np.stack(np.gradient(gaussian_filter(coarse, _SMOOTHING), *step))
    length = np.sqrt((gradient**2).sum(axis=0))
    towards = gradient / np.where(length > 0, length, 1.0)
    weight = np.sqrt(length).ravel()
    padding = (_FURTHEST * contact / step).astype(int) + 2
    wide = np.array(coarse.shape) + 2 * padding
    start = np.stack(np.meshgrid(np.arange(ny), np.arange(nx), indexing="ij"))
    start = start + padding[:, None, None] + 0.5
    votes = np.zeros(int(wide.prod()))
    for distance in np.arange(step.min(), _FURTHEST * contact, step.min()):
        along = distance * towards / step[:, None, None]
        for place in (start + along, start - along):
            row, column = place.astype(np.int64)
            number = (row * wide[1] + column).ravel()
            votes += np.bincount(number, weights=weight, minlength=len(votes))
    inside = tuple(slice(p, p + n) for p, n in zip(padding, coarse.shape, strict=True))
    height = gaussian_filter(votes.reshape(wide)[inside], _SMOOTHING)

    near = (_SEPARATION / 2 * contact / step).astype(int)
    y, x = (np.arange(-n, n + 1) * h for n, h in zip(near, step, strict=True))
    around = y[:, None] ** 2 + x**2 <= (_SEPARATION / 2 * contact) ** 2
    above = height - np.median(height)
    peak = np.argwhere((height == maximum_filter(height, footprint=around)) & (above > 0))
    centers = peak * step + shift
    last = (np.array(frame.shape) - 1) * np.array(pixel)
    kept = np.all((centers >= margin) & (centers <= last - margin), axis=1)
    mass = above[tuple(peak.T)] ** 2
    return Features(np.pad(centers[kept], [(0, 0), (1, 0)]), mass[kept])


def circle_cut(mass: Floats) -> float:
    """Return the mass that separates the centres of spheres from other ones.

    It is the middle of the widest gap in log mass between a tenth and a half of the usual mass, the
    median of those above a quarter of the largest. Where no gap is clear the cut may be low: a spot
    without the image of a sphere shows that in its fit.

    Parameters
    ----------
    mass : ndarray
        Masses of the spots of several frames.

    Returns
    -------
    float

    Examples
    --------
    >>> round(circle_cut(np.array([5.0, 9.0, 8.0, 7.0, 70.0, 90.0, 100.0])), 1)
    25.1
    """
    ordered = np.sort(mass[mass > 0])
    if not ordered.size:
        return 0.0
    usual = float(np.median(ordered[ordered > ordered[-1] / 4]))
    low, high = _CUTS[0] * usual, _CUTS[1] * usual
    between = np.concatenate([[low], ordered[(ordered > low) & (ordered < high)], [high]])
    # The masses next to the range make a gap wider, but the cut stays within the range.
    below, above = ordered[ordered <= low][-1:], ordered[ordered >= high][:1]
    between = np.concatenate([below, between[1:-1], above]) if below.size else between
    k = int(np.diff(np.log(between)).argmax())
    return float(np.clip(np.sqrt(between[k] * between[k + 1]), low, high))
