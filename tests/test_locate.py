"""Positions of spheres in images: the model of the image, its fit, and the table of a movie."""

from __future__ import annotations

import json
import warnings
from dataclasses import asdict, replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial.distance import cdist

import perrin
from perrin.geometry.rotations import exp_map, log_map
from perrin.images.optics.ball_image import PsfTail, sphere_image
from perrin.images.optics.image_parameters import ImageParameters, ImageVariations
from perrin.images.optics.learn import fit_samples
from perrin.images.optics.optics import CameraNoise
from perrin.images.optics.samples import GroupSample, UsualImage
from perrin.images.optics.window_fit import FreeCenters, RigidCenters, cut_window, fit_window
from perrin.images.spheres.by_trackpy import Features
from perrin.images.spheres.localisation import (
    NO_SPHERE,
    Method,
    Search,
    choose_method,
    group_columns,
    sample_frames,
    with_crowds,
)
from perrin.images.spheres.spots import Fading, Spots, find_fading, mass_cut

pytest.importorskip("trackpy")

VOXEL = (0.25, 0.2, 0.2)
PSF = (0.4, 0.15)
DIAMETER = 2.45
GAIN, READ = 3.0, 2.0
NOISE = perrin.Camera(gain=GAIN, read_noise=READ).variance_model()
BODY = perrin.Cluster.touching(4, DIAMETER)
NO_OTHERS = np.empty((0, 3))


def brute_force(centers, shape, fine=4):
    """Render unit balls on a grid `fine` times finer, blur it, and average over each voxel."""
    grid = [
        ((np.arange(n * fine) + 0.5) / fine - 0.5) * h for n, h in zip(shape, VOXEL, strict=True)
    ]
    unit = np.zeros([n * fine for n in shape], dtype=np.float32)
    for center in centers:
        box = tuple(
            slice(*np.searchsorted(g, [c - 1.3, c + 1.3]))
            for g, c in zip(grid, center, strict=True)
        )
        z, y, x = (g[s] - c for g, s, c in zip(grid, box, center, strict=True))
        r = np.sqrt((z**2)[:, None, None] + (y**2)[:, None] + x**2)
        unit[box] += np.clip((DIAMETER / 2 - r) / 0.05 + 0.5, 0, 1)
    width = np.array([PSF[0], PSF[1], PSF[1]]) / np.array(VOXEL) * fine
    blurred = gaussian_filter(unit, width, truncate=5)
    return blurred.reshape([k for n in shape for k in (n, fine)]).mean(axis=(1, 3, 5))


def recorded(unit, rng, photons=40.0, background=4.0):
    """Return the grey levels that a camera records of an image of unit brightness."""
    grey = GAIN * rng.poisson(photons * unit + background) + rng.normal(0, READ, unit.shape)
    return np.clip(np.round(grey), 0, 255)


class Movie:
    """Frames in memory."""

    def __init__(self, frames, voxel=VOXEL):
        self.frames = np.asarray(frames)
        self.shape, self.voxel = self.frames.shape, voxel

    def frame(self, i):
        return self.frames[i]


@pytest.fixture(scope="module")
def tetrahedra(repeats):
    """Return frames of a tetrahedron at random poses: movie, rotations, positions (T, 4, 3)."""
    rng, n = np.random.default_rng(11), repeats(4, 10)
    rotation = exp_map(rng.normal(size=(n, 3)))
    middle = np.array([3.5, 3.5, 4.4]) + rng.uniform(-0.1, 0.1, (n, 3))
    places = middle[:, None] + np.einsum("tij,nj->tni", rotation, BODY.positions)
    frames = [recorded(brute_force(p[:, ::-1], (36, 36, 36)), rng) for p in places]
    return Movie(frames), rotation, places


@pytest.fixture(scope="module")
def learned(tetrahedra):
    """Learn the optics from the movie, the diameter given 4 % wrong."""
    movie, search = tetrahedra[0], Search(2.55, DIAMETER)
    sample = sample_frames(movie, search, range(movie.shape[0]))
    return choose_method(movie, search, sample).optics


def in_true_order(table, places):
    """Return located positions in the order of the true ones, and their rows of the table."""
    found = np.empty_like(places)
    rows = np.empty(places.shape[:2], dtype=int)
    for i, truth in enumerate(places):
        part = table[table["frame"] == i]
        nearest = cdist(truth, part[["x", "y", "z"]]).argmin(axis=1)
        assert len(part) == len(set(nearest)) == len(truth)
        found[i], rows[i] = part[["x", "y", "z"]].to_numpy()[nearest], part.index[nearest]
    return found, rows


def test_the_image_is_that_of_brute_force():
    """A supersampled ball at a sub-voxel shift agrees to 0.2 % of its brightness.

    The limit is the voxel taken as a Gaussian: its fourth moment is off, at the edge alone. The
    noise of 40 photons is eighty times that.
    """
    shape, center = (34, 30, 30), np.array([4.1, 2.93, 3.07])
    spot = sphere_image(diameter=DIAMETER, psf=PSF, voxel=VOXEL).spot(center, shape)
    truth = brute_force([center], shape, fine=5)
    drawn = np.zeros(shape)
    drawn[spot.box] = spot.value
    assert np.abs(drawn - truth).max() < 2e-3
    assert np.sqrt(np.mean((drawn - truth)[spot.box] ** 2)) < 3e-4


def test_the_image_has_the_volume_of_the_ball_and_the_gradient():
    """The intensity sums to the ball's volume; the gradient is that of finite differences."""
    image = sphere_image(diameter=DIAMETER, psf=PSF, voxel=VOXEL)
    z, y, x = (h * np.arange(-20, 21) + 0.03 for h in VOXEL)
    value, gradient = image.at(z, y, x)
    assert value.sum() * np.prod(VOXEL) == pytest.approx(np.pi * DIAMETER**3 / 6, rel=1e-4)
    step = 1e-5
    offsets = np.eye(3) * step
    for axis in range(3):
        up, down = (
            image.at(*(g - sign * o for g, o in zip((z, y, x), offsets[axis], strict=True)))[0]
            for sign in (1, -1)
        )
        assert np.allclose(gradient[axis], (up - down) / (2 * step), atol=1e-6)


def test_the_image_with_a_tail_is_the_sum_of_two_images():
    """The shares add up, and derivatives by the parameters are those of finite differences."""
    tail = PsfTail(0.2, (0.7, 0.3))
    image = sphere_image(diameter=DIAMETER, psf=PSF, voxel=VOXEL, tail=tail)
    narrow, wide = (sphere_image(diameter=DIAMETER, psf=p, voxel=VOXEL) for p in (PSF, tail.psf))
    grid = [np.linspace(-1.5, 1.6, 12)] * 3
    one, other, both = (i.at(*grid)[0] for i in (narrow, wide, image))
    assert np.allclose(0.8 * one + 0.2 * other, both, atol=2e-4)
    parameters = ImageParameters(np.log([DIAMETER, 0.41, 0.16, np.e, 0.7, 0.3]), VOXEL)
    parameters.values[3] = 0.2
    variations, center = ImageVariations.about(parameters), np.array([3.0, 3.1, 3.2])
    box, slopes = variations.image.slope_spot(variations.slopes, center, (24, 32, 32))
    for step, slope in zip(1e-3 * np.eye(6), slopes, strict=True):
        up, down = (
            replace(parameters, values=parameters.values + sign * step).image() for sign in (1, -1)
        )
        offsets = [
            h * np.arange(s.start, s.stop) - c for h, s, c in zip(VOXEL, box, center, strict=True)
        ]
        change = (up.at(*offsets)[0] - down.at(*offsets)[0]) / 2e-3
        # The steps of 0.01 and 0.001 differ by a third derivative, and the image by its knots.
        assert np.allclose(slope, change, atol=0.01 * np.abs(change).max())


def pairs_of_balls(diameters, tail, rng):
    """Return groups of two touching balls of these diameters, drawn with a point spread."""
    groups = []
    for first, second in np.reshape(diameters, (-1, 2)):
        arm = rng.normal(size=3)
        arm *= DIAMETER / 2 / np.linalg.norm(arm)
        centers = np.array([4.2, 3.7, 3.7]) + rng.uniform(-0.1, 0.1, 3) + [[*arm], [*-arm]]
        unit = np.zeros((34, 37, 37))
        for center, diameter in zip(centers, (first, second), strict=True):
            spot = sphere_image(diameter=diameter, psf=PSF, voxel=VOXEL, tail=tail).spot(
                center, unit.shape
            )
            unit[spot.box] += spot.value
        groups.append(GroupSample(recorded(unit, rng), centers, NO_OTHERS))
    return groups


def distances(groups, optics):
    """Return the distances of the two balls of every group, fitted with these optics."""
    image, found = optics.image(VOXEL), []
    for group in groups:
        window = group.window(image)
        fit = fit_window(window, image, optics.noise, FreeCenters(group.centers))
        found.append(np.linalg.norm(np.diff(fit.centers, axis=0)))
    return np.array(found)


def test_a_point_spread_with_tails_is_learned_and_distances_are_right():
    """The tail is recognised by held-out groups; with one Gaussian distances are too short."""
    rng, tail = np.random.default_rng(5), PsfTail(0.3, (0.7, 0.35))
    groups = pairs_of_balls(np.full(8, DIAMETER), tail, rng)
    optics = fit_samples(groups, diameter=2.5, voxel=VOXEL).optics
    assert optics.tail is not None
    assert optics.tail.share == pytest.approx(0.3, abs=0.08)
    assert optics.diameter == pytest.approx(DIAMETER, abs=4 * optics.stderr[0])
    # A distance has an error of 6 nm from its photons: the mean of four 0.12 %.
    assert distances(groups, optics).mean() == pytest.approx(DIAMETER, rel=4e-3)


@pytest.fixture(scope="module")
def unequal():
    """Return pairs of touching balls whose diameters differ by 5 % (standard deviation)."""
    rng = np.random.default_rng(6)
    diameters = DIAMETER * (1 + 0.05 * rng.normal(size=8))
    return pairs_of_balls(diameters, None, rng), diameters


def test_different_diameters_are_learned_and_fitted(unequal):
    """Spread, gain and every diameter come back, and the errors of positions are as stated."""
    groups, diameters = unequal
    optics, usual = fit_samples(groups, diameter=2.5, voxel=VOXEL)
    assert usual.left_out == 0
    assert optics.spread == pytest.approx(np.std(diameters) / DIAMETER, rel=0.1)
    assert optics.diameter == pytest.approx(diameters.mean(), rel=0.005)
    assert optics.noise.gain == pytest.approx(GAIN, rel=0.08)
    assert optics.tail is None
    image, sizes, normal = optics.image(VOXEL), [], []
    for group in groups:
        fit = fit_window(group.window(image), image, optics.noise, FreeCenters(group.centers))
        sizes += (optics.diameter * np.exp(fit.sizes)).tolist()
        assert fit.chi2 == pytest.approx(1.0, abs=0.1)
        volumes = np.pi * (optics.diameter * np.exp(fit.sizes)) ** 3 / 6
        assert np.allclose(fit.unit_images.sum(axis=1) * np.prod(VOXEL), volumes, rtol=0.01)
        normal.append((fit.centers - group.centers).ravel() / np.sqrt(np.diag(fit.covariance)))
    # One diameter has an error of 0.3 %; four standard errors of a mean square of 24 are 1.2.
    assert np.allclose(sizes, diameters, rtol=0.015)
    assert np.mean(np.square(normal)) == pytest.approx(1.0, abs=1.2)


def test_misfit_appears_in_chi2_and_not_in_the_noise(unequal):
    """Fitted with equal diameters, the differences of neighbours keep the noise of the camera."""
    image = sphere_image(diameter=unequal[1].mean(), psf=PSF, voxel=VOXEL)
    variations, chi2, ratio = ImageVariations(image, np.empty((0, 4, 4))), [], []
    for group in unequal[0]:
        window = group.window(image)
        chi2.append(fit_window(window, image, NOISE, FreeCenters(group.centers)).chi2)
        found = group.fit(variations, NOISE)
        ratio.append(np.mean(found.variance / (NOISE.gain * found.level + NOISE.floor)))
    assert np.mean(chi2) > 1.1
    # Third differences of 5000 voxels have the variance within 3 %.
    assert np.mean(ratio) == pytest.approx(1.0, abs=4 * 0.03 / np.sqrt(len(ratio)))


def test_a_sphere_far_outside_the_frame_has_an_empty_image():
    """Its box is empty, and so are the image and its gradient."""
    spot = sphere_image(diameter=DIAMETER, psf=PSF, voxel=VOXEL).spot(
        np.array([-9.0, 2.0, 2.0]), (20, 20, 20)
    )
    assert spot.value.size == 0
    assert spot.gradient.shape == (3, *spot.value.shape)


def test_a_point_spread_wider_in_the_plane_is_refused():
    """Exchanged point spreads and lengths that are not positive are named."""
    with pytest.raises(ValueError, match="exchanged"):
        sphere_image(diameter=2.0, psf=(0.15, 0.4), voxel=VOXEL)
    with pytest.raises(ValueError, match=r"psf\[plane\] = 0"):
        sphere_image(diameter=2.0, psf=(0.15, 0), voxel=VOXEL)


def test_pose_derivatives_are_those_of_finite_differences():
    """The derivatives of the centres by the six parameters of a pose are those of differences."""
    pose = RigidCenters(np.array([1.0, 2.0, 3.0]), exp_map([0.3, -0.2, 0.9]), BODY.positions)
    step = 1e-6
    for k, slope in enumerate(pose.slope):
        up, down = (pose.moved(sign * step * np.eye(6)[k]).centers for sign in (1, -1))
        assert np.allclose((up - down).ravel() / (2 * step), slope, atol=1e-8)


def fitted(frame, start, voxel=VOXEL, scale=1.0, noise=NOISE):
    image = sphere_image(
        diameter=scale * DIAMETER, psf=(scale * PSF[0], scale * PSF[1]), voxel=voxel
    )
    window = cut_window(frame, image, start, others=NO_OTHERS)
    return fit_window(window, image, noise, FreeCenters(start))


def test_the_fit_follows_shifts_mirrors_units_and_negatives(tetrahedra):
    """Shift by voxels, exchange x and y, change the unit, or negate: the positions follow.

    The tolerance is that of the fit: it ends at steps below 1e-4 of the blur, 16 pm.
    """
    movie, _, places = tetrahedra
    frame, start = movie.frame(0), places[0][:, ::-1] + 0.03
    found = fitted(frame, start).centers
    rolled = np.pad(frame[:-2, :-2], ((2, 0), (2, 0), (0, 0)), mode="edge")
    shift = np.array([0.5, 0.4, 0.0])
    assert np.allclose(fitted(rolled, start + shift).centers, found + shift, atol=2e-5)
    swapped = [0, 2, 1]
    mirrored = fitted(frame.transpose(swapped), start[:, swapped]).centers
    assert np.allclose(mirrored, found[:, swapped], atol=2e-5)
    unit = fitted(frame, 7 * start, tuple(7 * h for h in VOXEL), scale=7.0).centers
    assert np.allclose(unit, 7 * found, atol=1e-4)
    even = CameraNoise(0.0, 50.0)
    negative = fitted(255 - frame, start, noise=even)
    assert np.allclose(negative.centers, fitted(frame, start, noise=even).centers, atol=2e-5)
    assert (negative.brightness < 0).all()


def test_optics_are_learned_from_the_movie(learned):
    """Diameter, point spread and gain come back, within four stated errors or 3 %."""
    got = np.array([learned.diameter, *learned.psf])
    assert np.all(np.abs(got - [DIAMETER, *PSF]) < 4 * np.array(learned.stderr))
    assert np.all(np.array(learned.stderr) < 0.005)
    assert learned.noise.gain == pytest.approx(GAIN, rel=0.05)
    assert learned.tail is None


def test_touching_spheres_are_located_within_the_stated_errors(tetrahedra, learned):
    """No sphere is missed or false, and the errors of n coordinates have the stated size."""
    movie, _, places = tetrahedra
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        table = perrin.locate(movie, diameter=DIAMETER, contact=DIAMETER, optics=learned)
    found, rows = in_true_order(table, places)
    sigma = table[["sigma_x", "sigma_y", "sigma_z"]].to_numpy()[rows]
    assert table["refined"].all()
    # The mean square of n normalised errors has the standard error sqrt(2/n): four of them.
    tolerance = 4 * np.sqrt(2 / places.size)
    assert np.mean(((found - places) / sigma) ** 2) == pytest.approx(1.0, abs=tolerance)
    assert table["chi2"].mean() == pytest.approx(1.0, abs=0.05)
    assert np.all(sigma.mean(axis=(0, 1)) < [0.005, 0.005, 0.007])


def test_the_pose_is_found_within_its_covariance(tetrahedra, learned):
    """From starts 20 nm off, the errors of centres and rotations have the stated covariance."""
    movie, rotation, places = tetrahedra
    near = places + np.random.default_rng(0).normal(0, 0.02, places.shape)
    start = perrin.track_rotation(near, dt=1.0)
    shape = BODY.positions @ perrin.kabsch(start.template, BODY.positions).T
    posed = perrin.fit_pose(movie, replace(start, template=shape), optics=learned)
    assert np.allclose(posed.rotation[0], np.eye(3), atol=1e-12)
    gauge = perrin.kabsch(posed.template, BODY.positions)
    turn = log_map(np.swapaxes(rotation, 1, 2) @ posed.rotation @ gauge)
    errors = gauge.T @ posed.covariance @ gauge
    normal = np.einsum("ti,tij,tj->t", turn, np.linalg.inv(errors), turn) / 3
    tolerance = 4 * np.sqrt(2 / (3 * len(places)))
    assert normal.mean() == pytest.approx(1.0, abs=tolerance)
    off = np.sum((posed.center - places.mean(axis=1)) ** 2, axis=1) / (3 * posed.center_variance)
    assert off.mean() == pytest.approx(1.0, abs=tolerance)


def test_refinement_by_trackpy_and_none(tetrahedra):
    """Errors of centroids are over 50 nm, those of discs less than half of that."""
    movie, _, places = tetrahedra
    movie, rms = Movie(movie.frames[:1]), {}
    for refine in (None, "trackpy"):
        table = perrin.locate(movie, diameter=DIAMETER, contact=DIAMETER, refine=refine)
        assert list(table) == ["frame", "x", "y", "z", "mass"]
        found, _ = in_true_order(table, places[:1])
        rms[refine] = np.sqrt(np.mean((found - places[:1]) ** 2))
    assert rms[None] > 0.05
    assert rms["trackpy"] < 0.5 * rms[None]


def test_a_frame_without_spheres_has_no_rows(tetrahedra, learned):
    """An empty frame among others is not an error."""
    frames = np.stack([tetrahedra[0].frame(0), np.zeros((36, 36, 36))])
    table = perrin.locate(Movie(frames), diameter=DIAMETER, contact=DIAMETER, optics=learned)
    assert table["frame"].tolist() == [0, 0, 0, 0]


def test_a_sphere_cut_by_the_border_is_located_with_border(tetrahedra, learned):
    """All four spheres are found within their errors; without `border` chi2 is too large."""
    movie, _, places = tetrahedra
    cut = int(places[0][:, 0].min() / VOXEL[2]) - 2
    stack = Movie(movie.frames[:1, :, :, cut:])
    asked = {"diameter": DIAMETER, "contact": DIAMETER, "optics": learned}
    truth = places[:1] - [cut * VOXEL[2], 0, 0]
    partial = perrin.locate(stack, border=False, **asked)
    assert len(partial) < 4
    assert partial["chi2"].min() > 2
    table = perrin.locate(stack, **asked)
    found, rows = in_true_order(table, truth)
    sigma = table[["sigma_x", "sigma_y", "sigma_z"]].to_numpy()[rows]
    assert np.all(np.abs(found - truth) < 4.5 * sigma)


def test_masses_without_a_gap_are_reported():
    """A clear gap is found at any level of noise; without a gap there is a warning."""
    real = np.linspace(20000, 30500, 40)
    assert 1400 < mass_cut(np.concatenate([np.geomspace(3, 1400, 300), real])) < 20000
    assert 1400 < mass_cut(real) < 20000
    assert mass_cut(np.empty(0)) == 0
    with pytest.warns(perrin.PrecisionWarning, match="no clear gap"):
        assert mass_cut(np.geomspace(100, 10000, 50)) == 0


def test_bad_arguments_are_listed_together(tetrahedra):
    """One message names every fault."""
    with pytest.raises(
        ValueError, match=r"^percentile: .*; refine: .*'disc'; diameter 9.*exchanged"
    ):
        perrin.locate(tetrahedra[0], diameter=9, contact=2, refine="disc", percentile=100)
    with pytest.raises(ValueError, match=r"frames: expected 0 to \d+, as the stack has .* got 10"):
        perrin.locate(tetrahedra[0], diameter=2.45, contact=2.45, refine=None, frames=[10])
    with pytest.raises(ValueError, match="no spheres"):
        perrin.locate(Movie(np.zeros((2, 20, 20, 20))), diameter=2.45, contact=2.45)


def test_spots_are_stated_in_an_object_or_as_keywords(tetrahedra):
    """Both ways give the same table; both at once, and unknown keywords, are refused."""
    movie = Movie(tetrahedra[0].frames[:1])
    asked = {"diameter": DIAMETER, "contact": DIAMETER, "refine": None}
    chosen = {"percentile": 90.0, "minmass": 100.0, "border": False}
    one = perrin.locate(movie, spots=Spots(**chosen), **asked)
    other = perrin.locate(movie, **chosen, **asked)
    assert one.equals(other)
    assert len(one) == 4
    with pytest.raises(ValueError, match="minmass: stated in spots= and as a keyword"):
        perrin.locate(movie, spots=Spots(), minmass=3.0, **asked)
    with pytest.raises(TypeError, match=r"unknown keyword 'minmas'; the nearest .* 'minmass'"):
        perrin.locate(movie, minmas=3.0, **asked)
    with pytest.raises(ValueError, match=r"dark: expected .*; percentile: expected .* < 100"):
        Spots(dark="yes", percentile=100)


def test_optics_noise_and_spots_survive_json(learned):
    """What `from_dict` reads from the JSON of `to_dict` equals the original."""
    tailed = replace(learned, tail=PsfTail(0.1, (0.9, 0.4)), spread=0.05)
    for original in (
        learned,
        tailed,
        learned.noise,
        Spots(dark=True),
        Spots(minmass=2.5, border=False),
    ):
        entry = json.loads(json.dumps(original.to_dict()))
        assert type(original).from_dict(entry) == original
    # The keys and the nesting are those of earlier run folders.
    always = {
        k: v
        for k, v in asdict(tailed).items()
        if k not in ("measured", "shell", "asymmetry", "depth", "pupil")
    }
    always["noise"] = tailed.noise[:2]
    assert json.loads(json.dumps(always)) == tailed.to_dict()
    earlier = {k: v for k, v in learned.to_dict().items() if k not in ("tail", "spread")}
    assert perrin.Optics.from_dict(earlier) == learned


def test_the_mass_cut_follows_bleaching_and_depth():
    """Brightness that falls exponentially in time and depth comes back, in any unit of it."""
    rng = np.random.default_rng(0)
    frames, spots = [0, 5, 10, 15, 19], []
    for i in frames:
        z = rng.uniform(0, 10, 16)
        spheres = 3e4 * 0.05 ** (i / 19) * np.exp(-0.08 * z) * rng.uniform(0.95, 1.05, 16)
        centers = np.zeros((56, 3))
        centers[:16, 0] = z
        spots.append(Features(centers, np.append(spheres, rng.uniform(10, 300, 40))))
    found = find_fading(frames, spots)
    assert found.at(19, np.array([[found.depth, 0, 0]]))[0] == pytest.approx(0.05, rel=0.1)
    assert found.per_depth == pytest.approx(-0.08, abs=0.02)
    louder = find_fading(frames, [Features(s.centers, 7.0 * s.mass) for s in spots])
    assert louder.light == pytest.approx(found.light)
    assert Fading.from_dict(json.loads(json.dumps(found.to_dict()))) == found
    same = [Features(s.centers, np.where(s.mass > 300, 2e4, s.mass)) for s in spots]
    assert find_fading(frames, same) is None


def drawn(centers, brightness, rng, shape=(44, 64, 64)):
    """Return a frame of balls by the model of the image, with the noise of a camera."""
    image, unit = sphere_image(diameter=DIAMETER, psf=PSF, voxel=VOXEL), np.zeros(shape)
    for center, bright in zip(centers, brightness, strict=True):
        spot = image.spot(np.asarray(center), shape)
        unit[spot.box] += bright * spot.value
    return recorded(unit, rng)


USUAL = UsualImage(1.0, 120.0, 0.0)
OPTICS = perrin.Optics(DIAMETER, PSF, CameraNoise(GAIN, READ**2 + 1 / 12))


def test_spheres_that_touch_dust_keep_their_errors_and_the_dust_is_named():
    """A bright lump and a rod at a dimer are no spheres; the dimer is found as without them."""
    rng = np.random.default_rng(1)
    dimer = np.array([[5.0, 6.0, 5.0], [5.0, 6.0, 7.45]])
    dust = np.array([[5.0, 6.0, 9.9], [5.0, 6.6, 10.7], [5.0, 8.6, 4.0], [5.0, 9.7, 4.6]])
    frame = drawn(np.concatenate([dimer, dust]), [1, 1, 0.9, 0.9, 0.8, 0.8], rng)
    spots = Features(np.concatenate([dimer, dust[[0, 2]]]) + 0.05, np.full(4, 3e4))
    columns, _ = group_columns(frame, spots, Search(DIAMETER, DIAMETER), OPTICS, VOXEL, usual=USUAL)
    assert columns["reason"].tolist() == ["", "", NO_SPHERE, NO_SPHERE]
    x = np.stack([columns[a][:2] for a in "zyx"], axis=1)
    sigma = np.stack([columns[f"sigma_{a}"][:2] for a in "zyx"], axis=1)
    assert np.all(np.abs(x - dimer) < 4 * sigma)


def test_a_sphere_beyond_the_border_does_not_bias_its_neighbour():
    """Its image is fitted too: errors are those stated, not several times as large."""
    rng = np.random.default_rng(2)
    pair = np.array([[1.4, 6.0, 6.0], [-0.8, 6.0, 7.08]])
    frame = drawn(pair, [1, 1], rng)
    spots, search = Features(pair[:1] + 0.05, np.array([3e4])), Search(DIAMETER, DIAMETER)
    search = replace(search, crowds=True)
    plain, none = group_columns(frame, spots, search, OPTICS, VOXEL)
    assert not none
    columns, crowds = group_columns(frame, spots, search, OPTICS, VOXEL, usual=USUAL)
    columns = with_crowds(columns, frame, spots, search, VOXEL, crowds=crowds, usual=USUAL)
    assert columns["refined"].tolist() == [True]
    off, biased = (
        max(
            abs(c[a][0] - true) / c[f"sigma_{a}"][0] for a, true in zip("zyx", pair[0], strict=True)
        )
        for c in (columns, plain)
    )
    assert off < 4 < biased


@pytest.mark.parametrize("beside", [[5.0, 6.0, 9.9], [5.0, 6.0, 12.0]])
def test_a_sphere_that_was_not_found_is_fitted_with_its_group(beside):
    """Dust hides one of three from the search; its places and errors are right, dust is none."""
    rng = np.random.default_rng(5)
    three = np.array([[5.0, 5.0, 5.0], [5.0, 5.0, 7.45], [5.0, 7.12, 6.225]])
    frame = drawn(np.concatenate([three, [beside]]), [1, 1, 1, 2.5], rng)
    spots = Features(three[:2] + 0.05, np.full(2, 3e4))
    search = Search(DIAMETER, DIAMETER, crowds=True)
    columns, crowds = group_columns(frame, spots, search, OPTICS, VOXEL, usual=USUAL)
    columns = with_crowds(columns, frame, spots, search, VOXEL, crowds=crowds, usual=USUAL)
    assert columns["refined"].tolist() == [True] * 3
    x, sigma = (np.stack([columns[s + a] for a in "zyx"], axis=1) for s in ("", "sigma_"))
    assert np.all(np.abs(x - three[cdist(x, three).argmin(axis=1)]) < 4 * sigma)


def test_a_method_learns_from_spheres_and_not_from_dust():
    """A lump among the groups leaves diameter, blur and gain as they are."""
    rng = np.random.default_rng(3)
    spheres = np.array([[5.0, y, x] for y in (3.0, 9.5) for x in (3.0, 9.5)])
    lumps = np.array([[5.0, 3.0, 16.0]])
    centers = np.concatenate([spheres, lumps, lumps + np.array([0.8, 1.1, 0.5])])
    frame = drawn(centers, [1] * 4 + [0.9] * 2, rng, shape=(44, 64, 96))
    movie = Movie([frame])
    search = Search(DIAMETER, DIAMETER)
    method = choose_method(movie, search, sample_frames(movie, search, [0]))
    assert isinstance(method, Method)
    assert method.usual.left_out == 1
    # It would appear as a tail of the point spread, or as a different diameter.
    assert method.optics.tail is None
    assert method.optics.spread == 0
    assert method.optics.diameter == pytest.approx(DIAMETER, abs=0.02)
    assert method.optics.noise.gain == pytest.approx(GAIN, rel=0.1)
    assert method.usual.brightness == pytest.approx(120.0, rel=0.03)


def test_spheres_that_come_near_are_refined_as_those_that_touch():
    """A row at 1.27 contacts is found where it is, though fits start drawn together to contact.

    The fits of its ends move from there by over half a radius.
    """
    row = 1.27 * DIAMETER * np.arange(4)
    places = np.column_stack([np.full(4, 5.1), np.full(4, 6.0), 2.0 + row])
    rng = np.random.default_rng(4)
    frame = drawn(places, np.ones(4), rng, shape=(44, 64, 80))
    found = Features(places + rng.normal(0, 0.03, places.shape), np.full(4, 3e4))
    columns, _ = group_columns(frame, found, Search(DIAMETER, DIAMETER), OPTICS, VOXEL)
    assert columns["reason"].tolist() == [""] * 4
    error = np.stack([columns[a] for a in "zyx"], axis=1) - places
    sigma = np.stack([columns[f"sigma_{a}"] for a in "zyx"], axis=1)
    assert np.abs(error / sigma).max() < 5
