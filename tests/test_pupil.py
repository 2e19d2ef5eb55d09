"""Point spreads of a confocal microscope with a pinhole: images, and what a movie shows."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import j1

from perrin.images import (
    CameraNoise,
    GroupSample,
    Optics,
    Pupil,
    PupilBall,
    fit_samples,
    sphere_image,
)
from perrin.images.optics.pupil import MOST_DIAMETER
from perrin.movie import confocal_point_spread

VOXEL = (0.25, 0.2, 0.2)
OPEN = Pupil(15.0, 0.6, 1.0)
NO_VOXEL = (0.0, 0.0)


def test_the_light_of_a_ball_is_its_volume():
    z, rho = np.linspace(-8.9, 8.9, 500), np.linspace(0, 5.9, 400)
    for shell in (False, True):
        value = PupilBall(2.0, OPEN, (0.005, 0.003), shell).intensity(z, rho)
        light = np.trapezoid(np.trapezoid(2 * np.pi * rho * value, rho, axis=1), z)
        # The cone of an open pinhole leaves this space with some percent of the light.
        assert abs(light / (np.pi / 6 * 8) - 1) < 0.05


def test_a_small_ball_behind_a_closed_pinhole_is_the_product_of_two_airy_patterns():
    rho = np.linspace(0.01, 0.5, 40)
    value = PupilBall(0.02, Pupil(15.0, 0.1, 1e-3), NO_VOXEL).intensity(np.zeros(1), rho)[0]
    airy = [(2 * j1(v) / v) ** 2 for v in (15.0 * rho, 15.0 / 0.94 * rho)]
    expected = airy[0] * airy[1]
    assert np.abs(value / value[0] - expected / expected[0]).max() < 0.01


def test_an_image_is_that_of_twice_the_lengths_at_half_the_scale():
    z, rho = np.linspace(0, 1.5, 6), np.linspace(0, 1.2, 5)
    one = PupilBall(1.2, Pupil(24.0, 0.6, 0.2), (0.002, 0.001)).intensity(z, rho)
    two = PupilBall(2.4, Pupil(12.0, 0.6, 0.4), (0.008, 0.004)).intensity(2 * z, 2 * rho)
    # The light is that of the space in which the point spread is computed, of one size for both.
    assert np.abs(one / one[0, 0] - two / two[0, 0]).max() < 2e-3


def test_the_table_of_the_image_holds_the_ball():
    ball = PupilBall(2.45, OPEN, (VOXEL[0] ** 2 / 12, VOXEL[1] ** 2 / 12))
    image = sphere_image(diameter=2.45, psf=OPEN.psf, voxel=VOXEL, pupil=OPEN)
    z, x = np.array([-2.0, 0.3, 1.1]), np.array([0.0, 0.7, 1.3])
    value, gradient = image.at(z, np.zeros(1), x)
    assert np.abs(value[:, 0] - ball.intensity(np.abs(z), x)).max() < 1e-3
    up, down = (image.at(z + h, np.zeros(1), x)[0] for h in (1e-4, -1e-4))
    assert np.abs(gradient[0] + (up - down) / 2e-4).max() < 1e-3


def samples_of(ball, *, count, rng):
    """Return windows of single spheres, drawn from the image without its table."""
    shape = (30, 26, 26)
    grid = [h * np.arange(n) for h, n in zip(VOXEL, shape, strict=True)]
    samples = []
    for _ in range(count):
        center = np.array([3.6, 2.5, 2.5]) + rng.uniform(-0.1, 0.1, 3)
        z, y, x = (g - c for g, c in zip(grid, center, strict=True))
        light = ball.intensity(np.abs(z), np.hypot(y[:, None], x).ravel()).reshape(shape)
        frame = 3.0 * rng.poisson(3 + 200 * np.maximum(light, 0)) + rng.normal(size=shape)
        samples.append(GroupSample(frame, center[None], np.empty((0, 3))))
    return samples


def test_a_movie_shows_an_open_pinhole():
    ball = PupilBall(2.45, OPEN, (VOXEL[0] ** 2 / 12, VOXEL[1] ** 2 / 12))
    samples = samples_of(ball, count=6, rng=np.random.default_rng(2))
    found = fit_samples(samples, diameter=2.45, voxel=VOXEL).optics
    assert found.pupil is not None
    assert found.tail is None
    assert abs(found.diameter - 2.45) < 5 * found.stderr[0] + 0.002
    assert abs(found.pupil.pinhole - 1.0) < 0.1
    assert abs(found.psf[0] - OPEN.psf[0]) < 5 * found.stderr[1]


def test_the_pinhole_is_kept_with_the_optics_and_named():
    optics = Optics(2.45, OPEN.psf, CameraNoise(3.0, 4.0), pupil=OPEN)
    assert Optics.from_dict(json.loads(json.dumps(optics.to_dict()))) == optics
    older = dict.fromkeys(("pupil", "depth", "asymmetry", "measured"))
    assert Optics.from_dict(optics.to_dict() | older) == replace(optics, pupil=None)
    plain = Optics(2.45, OPEN.psf, CameraNoise(3.0, 4.0))
    assert "pupil" not in plain.to_dict()
    note = confocal_point_spread(optics).notes[0]
    assert note.startswith("confocal point spread: that of an aperture with a pinhole of 1 um")
    assert "3.9 Airy units" in note
    assert confocal_point_spread(plain) == ((), ())


def test_values_without_an_image_are_refused():
    """A larger ball would reach beyond the space of the point spread, and return into it."""
    given = {"psf": (0.4, 0.15), "voxel": VOXEL}
    with pytest.raises(ValueError, match="at most 10 um, got 12 um"):
        sphere_image(diameter=12.0, pupil=OPEN, **given)
    with pytest.raises(ValueError, match="pupil slope"):
        sphere_image(diameter=2.0, pupil=OPEN._replace(slope=0.0), **given)
    axis, far = np.zeros(1), np.array([9.0])
    assert PupilBall(MOST_DIAMETER, OPEN, NO_VOXEL).intensity(far, axis) < 0.03
    assert PupilBall(1.5 * MOST_DIAMETER, OPEN, NO_VOXEL).intensity(far, axis) > 0.1
