"""A point spread measured on beads is that of the movie, and gives places without a bias."""

from __future__ import annotations

import numpy as np
import pytest

import perrin
from perrin.images import fit_samples, sphere_image
from perrin.images.optics.ball_image import PsfTail
from perrin.images.optics.samples import GroupSample
from perrin.movie.stacks import analyze_stack

pytest.importorskip("trackpy")

VOXEL, PSF, TAIL, SHARE = (0.2, 0.1, 0.1), (0.4, 0.15), (0.9, 0.35), 0.25
PLACES = [[x, y, 4.0 + 0.03 * k] for k, x in enumerate((2.6, 6.1)) for y in (2.53, 6.17)]


def beads_movie(*, gain=2.0, photons=3000.0, seed=1):
    """Return a stack of four beads under two Gaussians with shares of the intensity."""
    parts = []
    for share, (z, plane) in ((1 - SHARE, PSF), (SHARE, TAIL)):
        drawn = perrin.render_stack(
            [PLACES],
            voxel=VOXEL,
            shape=(42, 88, 88),
            diameter=0.1,
            psf=(z, plane, plane),
            dt=1.0,
            photons=photons * share * PSF[0] * PSF[1] ** 2 / (z * plane**2),
            background=0,
            noise=False,
            dtype="float64",
            rng=1,
        ).frame(0)
        parts.append(drawn)
    mean = sum(parts) + 4.0
    frame = gain * np.random.default_rng(seed).poisson(mean)
    return perrin.open_stack(frame[None].astype(np.float64), voxel=VOXEL, dt=1.0)


@pytest.fixture(scope="module")
def measured():
    return perrin.measure_point_spread(beads_movie())


def profile(spread, z, rho):
    """Return the image of a sphere of 2 um along z and in the plane."""
    image = sphere_image(
        diameter=2.0, psf=spread.components[0][1], voxel=(0.25, 0.2, 0.2), measured=spread
    )
    return along(image, z, rho)


def along(image, z, rho):
    """Return the values of an image at heights z and distances rho from the axis."""
    pairs = zip(z, rho, strict=True)
    return np.array(
        [image.at(np.array([a]), np.zeros(1), np.array([b]))[0].item() for a, b in pairs]
    )


def test_beads_give_the_image_of_a_sphere(measured):
    """Within 1 % of its middle everywhere, though the Gaussians need not be those planted."""
    true = sphere_image(diameter=2.0, psf=PSF, voxel=(0.25, 0.2, 0.2), tail=PsfTail(SHARE, TAIL))
    r = np.linspace(0, 2.5, 26)
    for z, rho in ((r, 0 * r), (0 * r, r), (r / 2, r / 2)):
        np.testing.assert_allclose(profile(measured, z, rho), along(true, z, rho), atol=0.01)
    assert measured.beads == len(PLACES)
    assert measured.misfit < 0.01
    assert sum(share for share, _ in measured.components) == pytest.approx(1)


def test_a_point_spread_does_not_depend_on_the_gain():
    """Grey levels in other units over another offset change nothing but the rounding."""
    frame = beads_movie().frame(0)[None, :, :48, :48]
    one, other = (
        perrin.measure_point_spread(perrin.open_stack(frames, voxel=VOXEL, dt=1.0))
        for frames in (frame, 7.0 * frame + 300)
    )
    assert one.beads == 1
    z = np.linspace(0, 2, 9)
    np.testing.assert_allclose(profile(other, z, z / 2), profile(one, z, z / 2), atol=1e-4)


def test_the_diameter_is_learned_with_a_measured_point_spread(measured):
    """It comes back within four of its errors; the point spread and its tail stay as measured."""
    true = sphere_image(diameter=2.0, psf=PSF, voxel=(0.25, 0.2, 0.2), tail=PsfTail(SHARE, TAIL))
    rng, samples = np.random.default_rng(5), []
    for _ in range(6):
        center = np.array([[3.5, 3.5, 3.5]]) + rng.uniform(-0.2, 0.2, (1, 3))
        frame = np.full((28, 35, 35), 9.0)
        spot = true.spot(center[0], frame.shape)
        frame[spot.box] += 100 * spot.value
        samples.append(GroupSample(2.0 * rng.poisson(frame), center, np.empty((0, 3))))
    found = fit_samples(samples, diameter=2.2, voxel=(0.25, 0.2, 0.2), measured=measured).optics
    assert abs(found.diameter - 2.0) < 4 * found.stderr[0] + 0.003
    assert found.measured == measured
    assert found.noise.gain == pytest.approx(2.0, rel=0.1)
    assert perrin.Optics.from_dict(found.to_dict()) == found


def test_what_is_no_stack_of_beads_is_refused():
    """No beads, a plane, and a point spread that is stated twice are named."""
    noise = np.random.default_rng(1).poisson(9.0, (1, 30, 60, 60)).astype(float)
    with pytest.raises(ValueError, match="none of them is a bead"):
        perrin.measure_point_spread(perrin.open_stack(noise, voxel=VOXEL, dt=1.0))
    with pytest.raises(ValueError, match="2-D movie of beads"):
        perrin.measure_point_spread(perrin.open_stack(noise[:, :1], voxel=(0.1, 0.1), dt=1.0))
    with pytest.raises(ValueError, match=r"shares with the sum 1.*got 0.9"):
        perrin.PointSpread(((0.9, (0.4, 0.15)),))
    stack = perrin.open_stack(np.repeat(noise, 3, axis=0), voxel=VOXEL, dt=1.0)
    spread = perrin.PointSpread(((1.0, (0.4, 0.15)),))
    with pytest.raises(ValueError, match='only refine="model" in a volume uses it'):
        analyze_stack(stack, diameter=1.0, contact=1.0, psf=spread, refine=None)
