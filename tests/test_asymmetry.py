"""Point spreads that are no even body of revolution: images, fits, and what a movie shows."""

from itertools import product

import numpy as np
import pytest

from perrin.images import (
    BallBlur,
    CameraNoise,
    FreeCenters,
    GroupSample,
    Optics,
    cut_window,
    fit_samples,
    fit_window,
    sphere_image,
)
from perrin.images.optics.asymmetry import Asymmetry
from perrin.movie.checks import asymmetric_point_spread

VOXEL = (0.25, 0.2, 0.2)
BALL = {"diameter": 2.45, "psf": (0.4, 0.15), "voxel": VOXEL}
NOBODY = np.empty((0, 3))
# Derivatives (z, y, x) of each component, with their factors.
ELLIPSE = ((0.5, (0, 0, 2)), (-0.5, (0, 2, 0)))
PLANE = ((-1.0, (0, 0, 2)), (-1.0, (0, 2, 0)))


def times(parts, *more):
    return tuple((factor, tuple(np.add(powers, more))) for factor, powers in parts)


DERIVATIVES = {
    "zx": ((1.0, (1, 0, 1)),),
    "zy": ((1.0, (1, 1, 0)),),
    "ellipse": ELLIPSE,
    "xy": ((1.0, (0, 1, 1)),),
    "zzz": ((-1.0, (3, 0, 0)),),
    "zrr": times(PLANE, 1, 0, 0),
    "xrr": times(PLANE, 0, 0, 1),
    "yrr": times(PLANE, 0, 1, 0),
    "zzx": ((-1.0, (2, 0, 1)),),
    "zzy": ((-1.0, (2, 1, 0)),),
    "z_ellipse": tuple((-f, p) for f, p in times(ELLIPSE, 1, 0, 0)),
    "zxy": ((-1.0, (1, 1, 1)),),
}


def exact(z, y, x):
    """Return the image of the ball with an even point spread, without a table."""
    blur = tuple(np.sqrt([0.4**2 + 0.25**2 / 12, 0.15**2 + 0.2**2 / 12]))
    rho = np.hypot(y[:, None], x)
    value = BallBlur(BALL["diameter"], ((1.0, blur),)).intensity(np.abs(z), rho.ravel())
    return value.reshape(len(z), *rho.shape)


def derivative(offsets, powers, *, step=0.02):
    """Return a mixed derivative of the exact image by finite differences in space."""
    kernels = {
        0: ((0, 1.0),),
        1: ((-1, -0.5), (1, 0.5)),
        2: ((-1, 1.0), (0, -2.0), (1, 1.0)),
        3: ((-2, -0.5), (-1, 1.0), (1, -1.0), (2, 0.5)),
    }
    total = 0.0
    for part in product(*(kernels[n] for n in powers)):
        moved = [x + step * k for x, (k, _) in zip(offsets, part, strict=True)]
        total = total + np.prod([w for _, w in part]) * exact(*moved)
    return total / step ** sum(powers)


@pytest.mark.parametrize("name", Asymmetry._fields)
def test_each_component_adds_its_derivative_of_the_image(name):
    offsets = np.array([0.7, -0.9]), np.array([0.5, -0.3]), np.array([0.6, -1.0, 0.1])
    size = 1e-3
    change = sphere_image(**BALL, asymmetry=Asymmetry(**{name: size})).at(*offsets)[0]
    change -= sphere_image(**BALL).at(*offsets)[0]
    expected = sum(f * derivative(offsets, powers) for f, powers in DERIVATIVES[name])
    # The tables use steps of a tenth of the blur, whose truncation is of the order of 1 %.
    assert np.abs(change / size - expected).max() < 0.02 * np.abs(expected).max()


def test_exchange_of_x_and_y_exchanges_the_components():
    z, y, x = np.array([0.4]), np.array([-0.8, 0.3]), np.array([0.9, 1.1, -0.2])
    one = Asymmetry(zx=0.02, xrr=1e-3, zzy=2e-3, ellipse=0.003, xy=0.001)
    other = Asymmetry(zy=0.02, yrr=1e-3, zzx=2e-3, ellipse=-0.003, xy=0.001)
    images = [sphere_image(**BALL, asymmetry=a) for a in (one, other)]
    first, second = images[0].at(z, y, x)[0], images[1].at(z, x, y)[0]
    assert np.allclose(first, second.swapaxes(1, 2), atol=1e-14)


def test_a_fit_with_the_asymmetry_finds_places_and_one_without_it_does_not():
    uneven = sphere_image(**BALL, asymmetry=Asymmetry(zx=0.03, zzx=-0.004))
    truth = np.array([[2.5, 2.6, 2.5], [2.5, 2.6 + 2.45 / np.sqrt(2), 2.5 + 2.45 / np.sqrt(2)]])
    truth[:, 0] += [0.0, 0.4]
    frame = np.full((24, 38, 38), 5.0)
    for center in truth:
        spot = uneven.spot(center, frame.shape)
        frame[spot.box] += 100 * spot.value
    errors = []
    for image in (uneven, sphere_image(**BALL)):
        window = cut_window(frame, image, truth, others=NOBODY)
        found = fit_window(window, image, CameraNoise(1.0, 0.0), FreeCenters(truth + 0.05))
        errors.append(np.abs(found.centers - truth).max())
    # The change is computed at places that are exact to a fiftieth of the blur.
    assert errors[0] < 5e-4
    assert errors[1] > 5e-3


def tilted_ball(covariance, *, grid=0.1, shape=(60, 60, 60)):
    """Return the image of a ball at the middle of a grid, by its Fourier transform."""
    k = np.meshgrid(*(2 * np.pi * np.fft.fftfreq(n, grid) for n in shape), indexing="ij")
    size = np.maximum(np.sqrt(sum(a**2 for a in k)) * BALL["diameter"] / 2, 1e-6)
    form = 3 * (np.sin(size) - size * np.cos(size)) / size**3
    square = sum(covariance[i, j] * k[i] * k[j] for i in range(3) for j in range(3))
    volume = np.pi / 6 * BALL["diameter"] ** 3 / grid**3
    return np.fft.fftshift(np.fft.ifftn(form * np.exp(-0.5 * square)).real) * volume


def samples_of(covariance, *, count, rng):
    """Return windows of single spheres, drawn without the model of the image."""
    from scipy.ndimage import map_coordinates, spline_filter

    ball, shape = spline_filter(tilted_ball(covariance)), (20, 22, 22)
    grid = np.meshgrid(
        *(h * np.arange(n) for h, n in zip(VOXEL, shape, strict=True)), indexing="ij"
    )
    samples = []
    for _ in range(count):
        center = np.array([2.4, 2.1, 2.1]) + rng.uniform(-0.1, 0.1, 3)
        where = [(g - c) / 0.1 + 30 for g, c in zip(grid, center, strict=True)]
        light = 3 + 200 * map_coordinates(ball, where, order=3, prefilter=False)
        frame = 3.0 * rng.poisson(np.maximum(light, 0)) + rng.normal(size=light.shape)
        samples.append(GroupSample(frame, center[None], NOBODY))
    return samples


def test_a_movie_shows_a_tilted_point_spread_and_an_even_one_shows_none():
    even = np.diag([0.4**2, 0.15**2, 0.15**2])
    tilted = even.copy()
    tilted[0, 2] = tilted[2, 0] = 0.02
    rng = np.random.default_rng(1)
    found = [
        fit_samples(samples_of(c, count=7, rng=rng), diameter=2.45, voxel=VOXEL).optics
        for c in (even, tilted)
    ]
    assert found[0].asymmetry is None
    assert found[1].asymmetry is not None
    assert found[1].asymmetry.kinds == ("a tilted axis",)
    # Seven spheres of 200 photons: a standard error of 0.0004.
    assert abs(found[1].asymmetry.zx - 0.02) < 0.0015


def test_the_asymmetry_is_kept_with_the_optics_and_named():
    plain = Optics(2.45, (0.4, 0.15), CameraNoise(3.0, 4.0))
    optics = Optics(
        *(2.45, (0.4, 0.15), CameraNoise(3.0, 4.0)), asymmetry=Asymmetry(zx=0.02, yrr=1e-4)
    )
    assert Optics.from_dict(optics.to_dict()) == optics
    assert "asymmetry" not in plain.to_dict()
    assert optics.image(VOXEL).asymmetry == optics.asymmetry
    note = asymmetric_point_spread(optics).notes[0]
    assert note.startswith("asymmetric point spread: a tilted axis, a tail to one side (coma)")
    assert asymmetric_point_spread(plain) == ((), ())
