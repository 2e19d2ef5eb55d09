"""Point spreads that change with the height of a sphere: images, fits, and what a movie shows."""

import json

import numpy as np
import pytest

import perrin.images.optics.ball_image as ball_image
from perrin.images import (
    Asymmetry,
    BallBlur,
    CameraNoise,
    DepthChange,
    FreeCenters,
    GroupSample,
    ImageParameters,
    LikeliestOptics,
    MomentFit,
    Optics,
    cut_window,
    fit_crowd,
    fit_samples,
    fit_window,
    significant_slopes,
    sphere_image,
)
from perrin.movie import changing_point_spread

VOXEL = (0.25, 0.2, 0.2)
BALL = {"diameter": 2.45, "psf": (0.45, 0.15), "voxel": VOXEL}
NOBODY = np.empty((0, 3))
# Variances of 0.10 and 0.30 um^2 along z, at 2 and 8 um.
DEEPER = DepthChange(5.0, 2.0, 8.0, wide_z=0.034, wide=0.001)
NOISE = CameraNoise(1.0, 0.0)


@pytest.mark.parametrize("spread", [0.0, 0.05])
def test_the_image_at_a_height_is_that_of_the_point_spread_there(spread):
    offsets = np.linspace(-2, 2, 9), np.array([0.5, -0.3]), np.array([0.6, -1.0, 0.1])
    image = sphere_image(**BALL, spread=spread, depth=DEEPER)
    for height in (1.0, 2.0, 3.3, 5.0, 7.1, 9.0):
        psf = DEEPER.psf(BALL["psf"], height)
        own = sphere_image(**BALL | {"psf": psf}, spread=spread)
        value, _ = image.sized(0.02, height).at(*offsets)
        assert np.abs(value - own.sized(0.02).at(*offsets)[0]).max() < 2e-3
    assert DEEPER.psf(BALL["psf"], 1.0) == DEEPER.psf(BALL["psf"], 2.0)


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("spread", [0.0, 0.05])
def test_gradients_contain_the_change_of_the_point_spread(compiled, spread, monkeypatch):
    if not compiled:
        monkeypatch.setattr(ball_image, "compiled_kernels", lambda: None)
    image = sphere_image(**BALL, spread=spread, depth=DEEPER)
    mask, center, size = np.ones((20, 16, 16), dtype=bool), np.array([[2.4, 1.6, 1.5]]), [0.02]
    up = np.array([[1e-4, 0.0, 0.0]])

    def at(x):
        # The array begins 3 um above the first plane of the stack.
        return image.on_voxels(mask, x, np.array(size), x[:, 0] + 3.0)[0]

    slope = (at(center + up)[0] - at(center - up)[0]) / 2e-4
    assert np.abs(at(center)[1] - slope).max() < 2e-3 * np.abs(slope).max()
    spot = image.sized(size[0], 5.4).spot(center[0], mask.shape)
    value = np.zeros(mask.shape)
    value[spot.box] = spot.value
    assert np.abs(at(center)[0] - value[mask]).max() < 1e-9


def test_third_moments_change_with_the_height():
    deeper = DepthChange(5.0, 2.0, 8.0, zzz=0.004)
    image = sphere_image(**BALL, asymmetry=Asymmetry(zx=0.01, zzz=0.01), depth=deeper)
    own = sphere_image(**BALL, asymmetry=Asymmetry(zx=0.01, zzz=0.018))
    center, shape = np.array([2.4, 1.6, 1.5]), (20, 16, 16)
    values = [one.spot(center, shape, height=7.0).value for one in (image, own)]
    assert np.abs(values[0] - values[1]).max() < 1e-9
    mask, sizes = np.ones(shape, dtype=bool), np.zeros(1)
    changes = [
        one.changes_on_voxels(mask, center[None], sizes, np.array([7.0])) for one in (image, own)
    ]
    assert np.abs(changes[0] - changes[1]).max() < 1e-9


def drawn(centers, image, shape):
    frame = np.full(shape, 5.0)
    for center in centers:
        spot = image.spot(center, shape)
        frame[spot.box] += 100 * spot.value
    return frame


def test_fits_with_the_change_find_places_and_one_without_it_does_not():
    touching = 2.45 / np.sqrt(2)
    truth = np.array([[2.5, 2.6, 2.5], [2.5 + touching, 2.6, 2.5 + touching]])
    image = sphere_image(**BALL, depth=DEEPER)
    frame = drawn(truth, image, (30, 26, 40))
    errors = []
    for one in (image, sphere_image(**BALL)):
        window = cut_window(frame, one, truth, others=NOBODY)
        fit = fit_window(window, one, NOISE, FreeCenters(truth + 0.05))
        assert fit.converged
        errors.append(np.abs(fit.centers - truth).max())
    assert errors[0] < 2e-4
    assert errors[1] > 3e-3
    crowd = fit_crowd(
        frame, truth + 0.05, others=NOBODY, contact=2.45, image=image, noise=NOISE, searches=1
    )
    assert np.abs(crowd.centers - truth).max() < 2e-4


def samples_of(widths, *, count, rng):
    """Return windows of single spheres at heights of a stack, from the closed form of the image.

    `widths` are standard deviations along z at 2 and 8 um.
    """
    shape, voxel = (40, 18, 18), np.array(VOXEL)
    grid = [h * np.arange(n) for h, n in zip(VOXEL, shape, strict=True)]
    samples = []
    for height in rng.uniform(2, 8, count):
        center = np.array([height, 1.7, 1.7]) + rng.uniform(-0.1, 0.1, 3)
        wide = np.interp(center[0], [2, 8], np.square(widths))
        blur = np.sqrt(np.array([wide, 0.15**2]) + np.square(voxel[:2]) / 12)
        z, y, x = (g - c for g, c in zip(grid, center, strict=True))
        ball = BallBlur(2.45, ((1.0, tuple(blur)),))
        light = ball.intensity(np.abs(z), np.hypot(y[:, None], x).ravel()).reshape(shape)
        frame = 3.0 * rng.poisson(3 + 100 * light) + rng.normal(size=shape)
        samples.append(GroupSample(frame, center[None], NOBODY))
    return samples


def test_a_movie_shows_the_change_and_an_even_one_shows_none():
    rng = np.random.default_rng(3)
    found = [
        fit_samples(samples_of(w, count=10, rng=rng), diameter=2.45, voxel=VOXEL).optics
        for w in ((0.4, 0.4), (0.30, 0.50))
    ]
    assert found[0].depth is None
    depth = found[1].depth
    assert depth is not None
    assert abs(depth.wide_z - (0.5**2 - 0.3**2) / 6) < 4 * depth.stderr[0]
    assert depth.stderr[0] < 0.0015
    assert abs(depth.wide) < 4 * depth.stderr[1]
    assert depth.zzz == depth.zrr == 0
    assert depth.low < depth.middle < depth.high


def test_errors_of_the_image_contain_those_of_its_moments():
    samples = samples_of((0.30, 0.50), count=8, rng=np.random.default_rng(7))
    start = ImageParameters(np.log([2.45, 0.41, 0.16]), VOXEL)
    even = LikeliestOptics.search(samples, start, NOISE)
    found = MomentFit.shown_by(even)
    assert found.parameters.depth is not None
    together, alone = (
        found.parameters.optics(found.noise, information).stderr
        for information in (found.information, found.information[:3, :3])
    )
    assert len(found.information) > 3
    assert all(a > b for a, b in zip(together, alone, strict=True))


def test_scores_that_scatter_show_no_slope_and_those_of_a_slope_do():
    rng, sets, n = np.random.default_rng(4), 3000, 15
    height = rng.normal(size=(sets, n))
    # Six times the scatter of the noise: images that the model does not describe.
    false = [
        significant_slopes((z**2)[:, None, None], 6 * (z * rng.normal(size=n))[:, None])[0]
        for z in height
    ]
    assert np.mean(false) < 2e-3
    z = height[0]
    scores = 50 * (z**2 + 0.05 * z * rng.normal(size=n))
    assert significant_slopes((z**2)[:, None, None], scores[:, None])[0]


def test_the_change_is_kept_with_the_optics_and_named():
    plain = Optics(2.45, (0.45, 0.15), CameraNoise(3.0, 4.0))
    deeper = DEEPER._replace(stderr=(1e-3, 2e-4, 0.0, 0.0))
    optics = Optics(2.45, (0.45, 0.15), CameraNoise(3.0, 4.0), depth=deeper)
    assert Optics.from_dict(json.loads(json.dumps(optics.to_dict()))) == optics
    assert "depth" not in plain.to_dict()
    assert optics.image(VOXEL).depth == deeper
    note = changing_point_spread(optics).notes[0]
    assert note.startswith("point spread by depth: its standard deviations are 0.317 um along z")
    assert "0.552 and 0.16 um at 8 um" in note
    assert changing_point_spread(plain) == ((), ())


def test_one_height_alone_has_one_point_spread():
    flat = DepthChange(5.0, 6.0, 6.0, wide_z=0.05)
    image, own = (
        sphere_image(**BALL | more) for more in ({"depth": flat}, {"psf": (0.5025, 0.15)})
    )
    center, shape = np.array([2.4, 1.6, 1.5]), (20, 16, 16)
    for height in (3.0, 6.0, 9.0):
        spot = image.spot(center, shape, height=height)
        assert np.abs(spot.value - own.spot(center, shape).value).max() < 2e-3
        assert np.isfinite(spot.gradient).all()


def test_a_movie_of_spheres_at_one_height_shows_no_change():
    rng = np.random.default_rng(6)
    samples = [
        s._replace(centers=np.array([[5.0, 1.7, 1.7]]))
        for s in samples_of((0.4, 0.4), count=6, rng=rng)
    ]
    shape, image = samples[0].frame.shape, sphere_image(**BALL)
    frames = [3.0 * rng.poisson(drawn(s.centers, image, shape)) for s in samples]
    samples = [s._replace(frame=frame) for s, frame in zip(samples, frames, strict=True)]
    found = fit_samples(samples, diameter=2.45, voxel=VOXEL).optics
    assert found.depth is None
    assert np.isfinite(found.stderr).all()
