"""Noise that voxels have in common: flicker, gains of pixels, and correlated neighbours."""

import json

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from perrin.images import CameraNoise, GroupSample, Optics, fit_samples, sphere_image
from perrin.images.optics.flicker import (
    LineChanges,
    Lines,
    VoxelPrecision,
    find_flicker,
    find_gain_spread,
)
from perrin.images.optics.neighbours import find_along_z, find_neighbours, neighbour_covariance
from perrin.images.optics.window_fit import FreeCenters, cut_window, fit_window
from perrin.movie.checks import noise_in_common

VOXEL, SHAPE, CENTER = (0.25, 0.2, 0.2), (16, 20, 20), np.array([[1.9, 2.03, 1.97]])
IMAGE = sphere_image(diameter=1.6, psf=(0.3, 0.15), voxel=VOXEL)
GAIN, PHOTONS, BACKGROUND = 2.0, 40.0, 3.0


def expected():
    """Return the mean grey levels of a sphere."""
    level = np.full(SHAPE, GAIN * BACKGROUND)
    spot = IMAGE.spot(CENTER[0], SHAPE)
    level[spot.box] += GAIN * PHOTONS * spot.value
    return level


LEVEL = expected()


def recorded(rng, *, plane=0.0, line=0.0, pixel=0.0):
    """Return a frame of that sphere in light that flickers, by a camera with unequal gains."""
    factor = 1 + plane * rng.normal(size=(SHAPE[0], 1, 1))
    factor = factor + line * rng.normal(size=(*SHAPE[:2], 1)) + pixel * rng.normal(size=SHAPE[1:])
    return LEVEL * factor + rng.normal(size=SHAPE) * np.sqrt(GAIN * LEVEL)


def changes(rng, lines_of, **flicker):
    """Return changes of the lines of ten frames of the sphere."""
    lines, light = lines_of(np.ones(SHAPE, dtype=bool)), LEVEL.ravel()
    rows = [recorded(rng, **flicker).ravel() - light for _ in range(10)]
    return [LineChanges.of(lines, row, light, 1 / (GAIN * light)) for row in rows]


@pytest.mark.parametrize("noise", [(0.3, 0.0, 0.0), (0.0, 0.2, 0.0), (0.3, 0.2, 0.0), (0, 0, 0.25)])
def test_precision_is_the_inverse_of_the_covariance(noise):
    """V^-1 of the sums over lines equals that of the dense matrix."""
    rng, camera = np.random.default_rng(1), CameraNoise(2.0, 5.0, *noise)
    mask = rng.random((4, 3, 5)) < 0.7
    level, rows = rng.uniform(10, 50, mask.sum()), rng.normal(size=(3, mask.sum()))
    z, y, x = np.nonzero(mask)
    same_plane = z[:, None] == z
    same_line, same_pixel = (
        same_plane & (y[:, None] == y),
        (y[:, None] == y) & (x[:, None] == x),
    )
    shared = sum(s**2 * a for s, a in zip(noise, (same_plane, same_line, same_pixel), strict=True))
    light = level + 2.5
    covariance = np.diag(2.0 * light) + light[:, None] * light * shared
    precision = VoxelPrecision.of(level, camera, VoxelPrecision.lines_of(mask, camera))
    assert precision.times(rows) == pytest.approx(rows @ np.linalg.inv(covariance))


@pytest.mark.parametrize(("plane", "line"), [(0.1, 0.0), (0.0, 0.15), (0.1, 0.15)])
def test_flicker_of_planes_and_of_lines_are_told_apart(plane, line):
    """Ten frames of a sphere: within 25 %, four times the scatter of the planes' variance."""
    found = find_flicker(changes(np.random.default_rng(2), Lines.of_scan, plane=plane, line=line))
    assert found == pytest.approx((plane, line), rel=0.25)


def test_gains_of_pixels_are_found():
    """Ten frames with gains that differ by 10 %, from lines along z."""
    windows = changes(np.random.default_rng(3), Lines.of_pixels, pixel=0.1)
    assert find_gain_spread(windows) == pytest.approx(0.1, rel=0.2)


def test_steady_light_has_no_flicker(repeats):
    """Neither photons alone nor noise that neighbours along x share are flicker."""
    rng = np.random.default_rng(4)
    for _ in range(repeats(1, 500)):
        assert find_flicker(changes(rng, Lines.of_scan)) == (0.0, 0.0)
        assert find_gain_spread(changes(rng, Lines.of_pixels)) == 0.0
    mask, light = np.ones((16, 20, 20), dtype=bool), np.full(6400, 40.0)
    windows = []
    for _ in range(10):
        row = gaussian_filter1d(rng.normal(size=mask.shape), 0.8, axis=2).ravel()
        windows.append(LineChanges.of(Lines.of_scan(mask), 12 * row, light, np.full(6400, 1 / 40)))
    assert find_flicker(windows) == (0.0, 0.0)


def square_over_stated(frame, camera):
    """Fit the sphere of a frame; return the squared error of its centre over the stated one."""
    window = cut_window(frame, IMAGE, CENTER, others=np.empty((0, 3)))
    fit = fit_window(window, IMAGE, camera, FreeCenters(CENTER + 0.02))
    error = (fit.centers - CENTER)[0]
    return error @ np.linalg.solve(fit.covariance, error) / 3


@pytest.mark.parametrize("noise", [{"plane": 0.3}, {"line": 0.4}, {"pixel": 0.3}])
def test_errors_of_fits_in_flickering_light_are_those_stated(noise, repeats):
    """Squared errors over the stated ones: 1 within four errors of it (3 to 11 without it)."""
    n = repeats(8, 100)
    rng = np.random.default_rng(5)
    camera, squares = CameraNoise(GAIN, 0.0, **noise), []
    for _ in range(n):
        frame = recorded(rng, **noise)
        squares.append(square_over_stated(frame, camera))
    assert np.mean(squares) == pytest.approx(1, abs=4 * np.sqrt(2 / (3 * n)))


def test_correlations_add_what_the_dense_covariance_has():
    """Sums over voxels that are correlated in their plane, against the explicit sum."""
    rng, mask = np.random.default_rng(6), np.random.default_rng(7).random((3, 5, 6)) < 0.8
    lags = np.array([1.0, 0.4, 0.1, 0.0])
    neighbours = tuple(tuple(row) for row in np.outer(lags, lags))
    z, y, x = np.nonzero(mask)
    far = [np.abs(a[:, None] - a) for a in (z, y, x)]
    near = (far[1] < 4) & (far[2] < 4)
    shared = np.where(near, np.outer(lags, lags)[far[1] % 4, far[2] % 4], 0.0)
    rows = rng.normal(size=(2, mask.sum()))
    for along_z in ((), (1.0, 0.3)):
        planes = np.append(along_z or (1.0,), (0.0, 0.0))[far[0]]
        added = neighbour_covariance(rows, mask, neighbours, along_z=along_z)
        assert added == pytest.approx(rows @ (shared * planes - np.eye(len(z))) @ rows.T)


def test_correlations_of_neighbours_are_found_and_stated(repeats):
    """Noise blurred along all axes: its correlation, and errors of fits that are then true.

    Without the correlation the squares are over 10.
    """
    n = repeats(8, 100)
    rng, camera = np.random.default_rng(8), CameraNoise(0.0, 1.0)
    width, squares = 0.7, []
    factor = (2 * width * np.sqrt(np.pi)) ** 1.5

    def blurred(shape):
        rows = rng.normal(size=shape)
        for axis in range(3):
            rows = gaussian_filter1d(rows, width, axis=axis, mode="wrap")
        return factor * rows

    mask = np.ones((20, 40, 40), dtype=bool)
    found, along_z = find_neighbours([(mask, blurred(mask.shape).ravel())])
    assert found[0][1] == pytest.approx(np.exp(-1 / (4 * width**2)), abs=0.03)
    assert find_neighbours([(mask, rng.normal(size=mask.size))]) == ((), ())
    assert along_z[1] == pytest.approx(np.exp(-1 / (4 * width**2)), abs=0.09)
    assert find_along_z([(mask, rng.normal(size=mask.size))]) == ()
    camera = camera._replace(floor=4.0, neighbours=found, along_z=along_z)
    for _ in range(n):
        frame = LEVEL + 2 * blurred(SHAPE)
        squares.append(square_over_stated(frame, camera))
    assert np.mean(squares) == pytest.approx(1, abs=4 * np.sqrt(2 / (3 * n)))


def test_learned_optics_have_the_flicker_of_the_movie():
    """Three frames with lines that differ by 20 %: the flicker, and the gain without it."""
    rng = np.random.default_rng(9)
    samples = [
        GroupSample(recorded(rng, line=0.2), CENTER.copy(), np.empty((0, 3))) for _ in range(3)
    ]
    noise = fit_samples(samples, diameter=1.6, voxel=VOXEL).optics.noise
    assert noise.line == pytest.approx(0.2, rel=0.15)
    assert noise.plane == 0.0
    assert noise.gain == pytest.approx(GAIN, rel=0.2)


def test_noise_in_common_is_kept_and_named():
    """JSON keeps all values; flicker over 10 % and correlated neighbours are warnings."""
    noise = CameraNoise(3.0, 4.0, 0.2, 0.05, 0.0, ((1.0, 0.5), (0.5, 0.25)), (1.0, 0.4))
    optics = Optics(2.0, (0.4, 0.15), noise)
    assert Optics.from_dict(json.loads(json.dumps(optics.to_dict()))) == optics
    warnings, notes = noise_in_common(optics)
    assert [text.split(":")[0] for text in warnings] == ["flicker", "correlated noise"]
    assert "by 20 % from plane to plane and by 5 % from line to line" in warnings[0]
    assert not notes
    few = Optics(2.0, (0.4, 0.15), CameraNoise(3.0, 4.0, line=0.03))
    assert noise_in_common(few).notes[0].startswith("flicker:")
    gains = Optics(2.0, (0.4, 0.15), CameraNoise(3.0, 4.0, pixel=0.06))
    assert noise_in_common(gains).notes[0].startswith("gains of pixels differ by 6 %")
    plain = Optics(2.0, (0.4, 0.15), CameraNoise(3.0, 4.0))
    assert noise_in_common(plain) == noise_in_common(None) == ((), ())
    assert "noise=(3, 4)" in repr(plain)
