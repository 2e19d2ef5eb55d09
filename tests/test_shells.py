"""Spheres of which the surface alone is fluorescent."""

from __future__ import annotations

import numpy as np
import pytest

import perrin
from perrin.images import CameraNoise, fit_samples, sphere_image
from perrin.images.optics.ball_image import BallBlur
from perrin.images.optics.samples import GroupSample

DIAMETER, PSF, VOXEL, GAIN = 2.0, (0.4, 0.15), (0.25, 0.2, 0.2), 2.0
NONE = np.empty((0, 3))


def samples(rng, *, shell, photons=100, count=6):
    """Return frames of single spheres, of the whole ball or of its surface, and their centres."""
    image = sphere_image(diameter=DIAMETER, psf=PSF, voxel=VOXEL, shell=shell)
    out = []
    for _ in range(count):
        center = np.array([[3.5, 3.5, 3.5]]) + rng.uniform(-0.2, 0.2, (1, 3))
        mean = np.full((28, 35, 35), 9.0)
        spot = image.spot(center[0], mean.shape)
        mean[spot.box] += photons * spot.value
        out.append(GroupSample(GAIN * rng.poisson(mean), center, NONE))
    return out


def test_a_shell_has_the_light_of_its_ball():
    """Summed over space both are the volume of the ball, and far from the surface there is none."""
    z, rho = np.linspace(0, 4, 321), (np.arange(320) + 0.5) / 80
    for shell in (False, True):
        value = BallBlur(DIAMETER, ((1.0, (0.4, 0.16)),), shell).intensity(z, rho)
        line = 2 * (value.sum(axis=0) - value[0] / 2) * (z[1] - z[0])
        total = np.sum(line * 2 * np.pi * rho) / 80
        assert total == pytest.approx(np.pi / 6 * DIAMETER**3, rel=1e-3)
        assert value[-1, -1] < 1e-6


def test_a_shell_is_the_difference_of_balls():
    """The light between two close radii, per volume: the derivative of the ball by its radius."""
    z, rho, step = np.linspace(0, 2, 21), np.linspace(0, 2, 21), 1e-4
    blur = ((1.0, (0.5, 0.2)),)
    outer, inner = (BallBlur(DIAMETER + s, blur).intensity(z, rho) for s in (step, -step))
    shell = BallBlur(DIAMETER, blur, shell=True).intensity(z, rho)
    # A surface of density R/3 has the light of the ball.
    np.testing.assert_allclose((outer - inner) / step * DIAMETER / 6, shell, atol=1e-6)


@pytest.mark.parametrize("shell", [True, False])
def test_the_movie_shows_whether_spheres_are_shells(shell):
    """Diameter and point spread come back within four errors, the noise within 10 %."""
    movie = samples(np.random.default_rng(3), shell=shell)
    found = fit_samples(movie, diameter=2.2, voxel=VOXEL).optics
    assert found.shell is shell
    lengths = zip((found.diameter, *found.psf), (DIAMETER, *PSF), found.stderr, strict=True)
    for value, true, error in lengths:
        assert abs(value - true) < 4 * error + 0.003
    assert found.noise.gain == pytest.approx(GAIN, rel=0.1)
    assert perrin.Optics.from_dict(found.to_dict()) == found


class Tetrahedron:
    """Two frames of a tetrahedron of touching shells, whose contacts are its brightest places."""

    shape, voxel = (2, 30, 36, 36), VOXEL

    def __init__(self):
        self.centers = np.array([4.0, 3.6, 3.4]) + perrin.Cluster.touching(4, DIAMETER).positions
        self.image = sphere_image(diameter=DIAMETER, psf=PSF, voxel=VOXEL, shell=True)

    def frame(self, i):
        mean = np.full(self.shape[1:], 3.0)
        for center in self.centers:
            spot = self.image.spot(center, mean.shape)
            mean[spot.box] += 60 * spot.value / self.image.spot(center, mean.shape).value.max()
        return (GAIN * np.random.default_rng(i).poisson(mean)).astype(np.uint16)


def test_touching_shells_are_found_at_their_centres(repeats):
    """All of them and no contact, within four stated errors; with --long the optics are learned."""
    pytest.importorskip("trackpy")
    movie, known = Tetrahedron(), perrin.Optics(DIAMETER, PSF, CameraNoise(GAIN, 1.0), shell=True)
    optics = repeats(known, None)
    table = perrin.locate(movie, diameter=DIAMETER, contact=DIAMETER, optics=optics)
    for _, part in table.groupby("frame"):
        assert len(part) == 4
        x, sigma = (part[[f"{s}{a}" for a in "zyx"]].to_numpy() for s in ("", "sigma_"))
        rows = np.linalg.norm(x[:, None] - movie.centers, axis=2).argmin(axis=1)
        assert sorted(rows.tolist()) == [0, 1, 2, 3]
        assert np.abs((x - movie.centers[rows]) / sigma).max() < 4
        assert sigma.max() < 0.02
