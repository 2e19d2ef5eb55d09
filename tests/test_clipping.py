"""Voxels at the end of the camera's range are left out of fits, and errors stay true."""

from __future__ import annotations

import numpy as np

from perrin.images import CameraNoise, cut_window, fit_window, sphere_image, without_clipped
from perrin.images.optics.crowd_equations import cut_crowd_window
from perrin.images.optics.window_fit import FreeCenters

IMAGE = sphere_image(diameter=2.0, psf=(0.4, 0.15), voxel=(0.25, 0.2, 0.2))
GAIN, SHAPE, NONE = 3.0, (24, 30, 30), np.empty((0, 3))


def clipped_sphere(rng, *, photons, ceiling):
    """Return a frame of one sphere, clipped at a grey level, and its centre."""
    center = np.array([[2.9, 2.9, 2.9]]) + rng.uniform(-0.2, 0.2, (1, 3))
    spot = IMAGE.spot(center[0], SHAPE)
    mean = np.full(SHAPE, 4.0)
    mean[spot.box] += photons * spot.value
    return np.minimum(GAIN * rng.poisson(mean), ceiling).astype(np.uint8), center


def squares(frames, centers, prepared):
    """Return the squared errors of fitted centres over the stated ones."""
    out = []
    for frame, center in zip(frames, centers, strict=True):
        window = cut_window(prepared(frame), IMAGE, center, others=NONE)
        fit = fit_window(window, IMAGE, CameraNoise(GAIN, 0.0), FreeCenters(center + 0.05))
        out.append((fit.centers - center)[0] ** 2 / np.diag(fit.covariance))
    return np.array(out)


def test_clipped_spheres_have_their_stated_errors():
    """Mean squares of 40 centres are 1, within 4 of the error sqrt(2/120) of their mean."""
    rng = np.random.default_rng(4)
    movie = [clipped_sphere(rng, photons=95, ceiling=255) for _ in range(40)]
    frames, centers = zip(*movie, strict=True)
    assert np.mean([np.mean(f == 255) for f in frames]) > 0.005
    found = squares(frames, centers, without_clipped)
    assert abs(found.mean() - 1) < 4 * np.sqrt(2 / found.size)


def test_spheres_above_a_floor_have_their_stated_errors():
    """Where the background is below the range: mean squares are 1, and no centre is drawn away."""
    rng = np.random.default_rng(8)
    frames, centers = [], []
    for _ in range(40):
        center = np.array([[2.9, 2.9, 2.9]]) + rng.uniform(-0.2, 0.2, (1, 3))
        spot, mean = IMAGE.spot(center[0], SHAPE), np.full(SHAPE, 4.0)
        mean[spot.box] += 40 * spot.value
        grey = np.round(GAIN * rng.poisson(mean) + rng.normal(-16, 1, SHAPE))
        frames.append(np.maximum(grey, 0).astype(np.uint8))
        centers.append(center)
    assert np.mean([f == 0 for f in frames]) > 0.5
    found = squares(frames, centers, without_clipped)
    assert abs(found.mean() - 1) < 4 * np.sqrt(2 / found.size)


def test_what_is_left_out_is_what_touches_clipped_voxels():
    """Nothing in a frame without clipping; else the clipped voxels with their 26 neighbours."""
    rng = np.random.default_rng(5)
    clean, _ = clipped_sphere(rng, photons=40, ceiling=250)
    np.testing.assert_array_equal(without_clipped(clean), clean.astype(float))
    frame = clipped_sphere(rng, photons=90, ceiling=255)[0]
    left = np.isnan(without_clipped(frame))
    assert left[frame == 255].all()
    grown = np.zeros_like(left)
    for step in np.ndindex(3, 3, 3):
        grown |= np.roll(frame == 255, np.array(step) - 1, axis=(0, 1, 2))
    np.testing.assert_array_equal(left, grown)


def test_no_fit_uses_voxels_that_are_left_out():
    """Windows of groups and of crowds: their grey level has no effect on either."""
    frame, center = clipped_sphere(np.random.default_rng(6), photons=90, ceiling=255)
    marked = without_clipped(frame)
    window = cut_window(marked, IMAGE, center, others=NONE)
    assert np.isfinite(window.data).all()
    assert window.data.size + np.isnan(marked).sum() == len(
        cut_window(frame, IMAGE, center, others=NONE).data
    )
    crowd = cut_crowd_window(marked, IMAGE, CameraNoise(GAIN, 0.0), center, NONE)
    assert np.isfinite(crowd.data).all()
    assert not crowd.mask[np.isnan(marked[tuple(slice(0, n) for n in crowd.mask.shape)])].any()
