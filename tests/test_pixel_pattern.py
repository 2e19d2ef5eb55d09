"""Pixels of a camera whose offsets differ: found in the background, and subtracted for fits."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

import perrin
from perrin.images import (
    CameraNoise,
    cut_window,
    find_pixel_pattern,
    fit_window,
    pixel_offsets,
    sphere_image,
    without_pattern,
)
from perrin.images.optics.window_fit import FreeCenters

IMAGE = sphere_image(diameter=2.0, psf=(0.4, 0.15), voxel=(0.25, 0.2, 0.2))
GAIN, SHAPE, OFFSET, COUNT = 3.0, (24, 30, 30), 8.0, 20


@pytest.fixture(scope="module")
def movie():
    """Frames of one sphere at random places, their centres, and the offsets of the pixels."""
    rng = np.random.default_rng(3)
    pattern = OFFSET * rng.normal(size=SHAPE[1:])
    centers = np.array([2.9, 2.9, 2.9]) + rng.uniform(-0.4, 0.4, (COUNT, 3))
    frames = []
    for center in centers:
        spot, mean = IMAGE.spot(center, SHAPE), np.full(SHAPE, 4.0)
        mean[spot.box] += 8 * spot.value
        frames.append(np.round(GAIN * rng.poisson(mean) + 40 + pattern).astype(np.uint16))
    return frames, centers, pattern


def test_the_pattern_is_measured_in_the_background(movie):
    """Its size within 10 %, each pixel within twice its error; none without a pattern."""
    frames, _, pattern = movie
    found = find_pixel_pattern(frames)
    assert found.offset == pytest.approx(np.std(pattern), rel=0.1)
    assert found.significant
    high = pattern - gaussian_filter(pattern, 3.0)
    # Noise of 6 grey levels: a mean of half of 480 planes, and that of the sphere in some of them.
    assert np.std(pixel_offsets(frames) - high) < 2 * 6 / np.sqrt(12 * COUNT)
    plain = [np.round(f - pattern) for f in frames]
    assert not find_pixel_pattern(plain).significant


def test_what_does_not_move_and_is_blurred_is_no_pattern():
    """Two frames of the same texture, with the blur of an image and noise of their own."""
    rng = np.random.default_rng(4)
    still = 20 * gaussian_filter(rng.normal(size=SHAPE[1:]), 1.0)
    frames = [30 + still + rng.normal(size=SHAPE) for _ in range(2)]
    assert not find_pixel_pattern(frames).significant


def test_centres_have_their_stated_errors_without_the_pattern(movie):
    """Mean squares are 1 within four of the errors of their mean, with the pattern over 1.5."""
    frames, centers, _ = movie
    found = []
    for pattern in (pixel_offsets(frames), None):
        square = []
        for frame, center in zip(frames, centers, strict=True):
            window = cut_window(
                without_pattern(frame, pattern), IMAGE, center[None], others=np.empty((0, 3))
            )
            fit = fit_window(window, IMAGE, CameraNoise(GAIN, -118.0), FreeCenters(center[None]))
            square.append((fit.centers[0] - center) ** 2 / np.diag(fit.covariance))
        found.append(np.mean(square))
    assert abs(found[0] - 1) < 4 * np.sqrt(2 / (3 * COUNT))
    assert found[1] > 1.5


def test_a_corrected_stack_gives_the_same_frames_elsewhere(movie):
    """Also after it was sent to another process; clipped voxels are not a number."""
    frames, _, pattern = movie
    clipped = np.stack(frames[:2])
    clipped[0, :5, :5, :5] = np.iinfo(np.uint16).max
    stack = perrin.open_stack(clipped, voxel=(0.25, 0.2, 0.2), dt=1.0)
    assert stack.corrected(None) is stack
    sent = pickle.loads(pickle.dumps(stack.corrected(pattern)))
    np.testing.assert_array_equal(sent.frame(1), clipped[1] - pattern)
    assert np.isnan(sent.frame(0)[:5, :5, :5]).all()
