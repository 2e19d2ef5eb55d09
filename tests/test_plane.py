"""Spheres in two-dimensional movies."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import perrin
from perrin.images import (
    CameraNoise,
    RadialImage,
    TransmissionNoise,
    circle_cut,
    find_circles,
    fit_plane,
    learn_plane,
)
from perrin.movie.checks import overlapping_places, ring_images

pytest.importorskip("trackpy")

STUCK = Path(__file__).resolve().parents[2] / "shared" / "data" / "trackpy_stuck" / "stuck.tif"
PIXEL = 0.1


class Plane:
    """A 2-D movie of spots of 0.15 um at places (T, n, 2), x and y, 2000 photons in each."""

    def __init__(self, places, rng):
        grid = PIXEL * np.arange(120)
        near = [np.exp(-0.5 * ((grid - places[..., k, None]) / 0.15) ** 2) for k in (1, 0)]
        photons = np.einsum("tny,tnx->tyx", *near) * 2000 * PIXEL**2 / (2 * np.pi * 0.15**2)
        self.frames = rng.poisson(photons + 10)[:, None]
        self.shape, self.voxel = self.frames.shape, (np.nan, PIXEL, PIXEL)

    def frame(self, i):
        return self.frames[i]


@pytest.fixture(scope="module")
def triangles(repeats):
    """Return the motion of a triangle over 12 or 30 frames, its positions, and the movie."""
    body = perrin.Cluster([[0.0, 0.0], [1.6, 0.0], [0.3, 1.3]])
    frames = repeats(12, 30)
    truth = perrin.simulate_motion(body, D_R=0.02, D_T=0.01, dt=1.0, n_frames=frames, rng=4)
    places = truth.positions() + 6.0
    return truth, places, Plane(places, np.random.default_rng(1))


@pytest.fixture(scope="module")
def spots(triangles):
    """Return the table of the spots in that movie."""
    return perrin.locate(triangles[2], diameter=0.9, contact=0.9, refine=None)


def test_spots_of_a_plane_are_found_where_they_are(triangles, spots):
    """All spots and no others, no z; errors within 1.3 of what photons allow the centroid.

    Those of the spot, 0.15 um/sqrt(2000), and of 10 in each pixel of the mask, 0.9 um wide.
    """
    _, places, _ = triangles
    table = spots
    assert list(table) == ["frame", "x", "y", "mass"]
    assert (table.groupby("frame").size() == 3).all()
    off = []
    for i, truth in enumerate(places):
        found = table.loc[table["frame"] == i, ["x", "y"]].to_numpy()
        nearest = np.linalg.norm(truth[:, None] - found, axis=2).argmin(axis=1)
        off.append(found[nearest] - truth)
    allowed = 0.15**2 / 2000 + 10 * 81 * (0.9**2 / 12) / 2000**2
    assert np.sqrt(np.mean(np.square(off))) < 1.3 * np.sqrt(allowed)


def test_a_planar_body_turns_as_it_did(triangles, spots):
    """From images to the angle of every step: within four times what places so known allow."""
    truth, _, _ = triangles
    known = perrin.identify(spots, contact=1.6, size=3)
    assert known["cluster"].nunique() == 1
    motion = perrin.track_rotation(perrin.cluster_positions(known, cluster=0)[0], dt=1.0)
    step, true = (np.swapaxes(m.rotation[:-1], 1, 2) @ m.rotation[1:] for m in (motion, truth))
    turned = np.swapaxes(step, 1, 2) @ true
    angle = np.arctan2(turned[:, 1, 0], turned[:, 0, 0])
    assert np.abs(angle).max() < 4 * np.sqrt(2) * motion.sigma / np.linalg.norm(motion.template)


def test_trackpys_discs_find_spots_of_a_plane(triangles):
    """Discs are for balls larger than the point spread: as wide here as the spot at half height."""
    _, places, movie = triangles
    asked = {"diameter": 0.36, "contact": 0.9, "frames": [0, 1]}
    discs = perrin.locate(movie, refine="trackpy", **asked)
    assert list(discs) == ["frame", "x", "y", "mass"]
    near = np.linalg.norm(places[0][:, None] - discs[["x", "y"]].to_numpy()[:3], axis=2)
    assert near.min(axis=1).max() < PIXEL


@pytest.mark.skipif(not STUCK.exists(), reason="the movie of stuck beads is not here")
def test_stuck_beads_are_a_body_at_rest():
    """Real beads on a glass: all found in all five frames, the angle scatters by their noise.

    Of the 45 places the rms angle is sigma/(sqrt(n) R_rms), within 3 of its standard errors of
    1/sqrt(2 * 4).
    """
    with perrin.open_stack(STUCK, voxel=(1, 1), dt=1, planes=1) as stack:
        table = perrin.locate(stack, diameter=5, contact=5, refine=None, percentile=99)
    count = table.groupby("frame").size()
    assert count.min() >= 16
    known = perrin.identify(table, contact=120, size=int(count.min()))
    motion = perrin.track_rotation(perrin.cluster_positions(known, cluster=0)[0], dt=1.0)
    assert motion.n_present.tolist() == [int(count.min())] * 5
    assert 0.05 < motion.sigma < 0.15
    turned = motion.rotation @ np.swapaxes(motion.rotation[:1], 1, 2)
    angle = np.arctan2(turned[:, 1, 0], turned[:, 0, 0])
    allowed = motion.sigma / np.linalg.norm(motion.template)
    assert np.std(angle, ddof=1) < allowed * (1 + 3 / np.sqrt(8))
    assert np.std(angle, ddof=1) > allowed * (1 - 2.5 / np.sqrt(8))


def test_discs_are_no_rings_and_rings_are_named():
    """No false alarm for discs of either contrast; rings of either contrast are named."""
    rng = np.random.default_rng(5)
    y, x = np.mgrid[:100, :100] * PIXEL
    for shape in ("disc", "ring"):
        images, places = [], []
        for _ in range(6):
            at = np.array([[2.5, 2.5], [3.5, 2.5], [7.0, 7.0]]) + rng.uniform(-0.5, 0.5, 2)
            r = np.hypot(x[..., None] - at[:, 0], y[..., None] - at[:, 1])
            part = 1 / (1 + np.exp((r - 0.5) / 0.05))
            part = part if shape == "disc" else np.exp(-(((r - 0.38) / 0.1) ** 2))
            images.append(100 + 40 * part.sum(axis=2) + rng.normal(0, 3, x.shape))
            places.append(at)
        for dark in (False, True):
            signed = [200 - image if dark else image for image in images]
            given = {"pixel": (PIXEL, PIXEL), "diameter": 1.0}
            named = ring_images(signed, places, dark=dark, **given).warnings
            assert bool(named) == (shape == "ring")
            other = ring_images(signed, places, dark=not dark, **given).warnings
            assert other
            assert other[0].startswith("contrast:")
        assert not overlapping_places(places, contact=1.0).warnings


# Movies of touching spheres: images add, and are radial functions of the distance over the contact.
CONTACT, STEP, GAIN = 2.0, 0.2, 2.0


def disc(r):
    """Return a disc with a soft rim."""
    return 0.5 * (1 - np.tanh((r - 0.5) / 0.06))


def ring(r):
    """Return a bright-field contrast: a dark rim and a bright middle."""
    return 0.5 * np.exp(-((r / 0.2) ** 2) / 2) - np.exp(-(((r - 0.5) / 0.1) ** 2) / 2)


def chains(n_frames, rng, sizes=(3, 2)):
    """Return positions (T, n, 2), x and y, of rows and triangles of touching spheres."""
    shapes = {2: [[0, 0], [1, 0]], 3: [[0, 0], [1, 0], [0.5, np.sqrt(0.75)]]}
    frames = []
    for _ in range(n_frames):
        spheres = []
        for k, size in enumerate(sizes):
            c, s = np.cos(angle := rng.uniform(0, 2 * np.pi)), np.sin(angle)
            shape = CONTACT * (np.array(shapes[size]) - np.mean(shapes[size], axis=0))
            middle = np.array([3.5 + 5.5 * k, 4.0]) + rng.uniform(-0.3, 0.3, 2)
            spheres.append(middle + shape @ np.array([[c, s], [-s, c]]))
        frames.append(np.concatenate(spheres))
    return np.array(frames)


def drawn(places, image, rng, *, photons=50.0, background=120.0, shape=(40, 64), sizes=1.0):
    """Return the movie (T, 1, y, x) of spheres with one image, of relative sizes (n,)."""
    y, x = (STEP * np.arange(n) for n in shape)
    movie = []
    for frame in places:
        away = np.hypot(x - frame[:, 0, None, None], y[:, None] - frame[:, 1, None, None])
        scaled = away / CONTACT / np.broadcast_to(sizes, len(frame))[:, None, None]
        movie.append(background + photons * image(scaled).sum(axis=0))
    return GAIN * rng.poisson(np.array(movie))[:, None].astype(np.float64)


def located(movie, **options):
    """Return the table of `locate` for such a movie."""
    stack = perrin.open_stack(movie, voxel=(STEP, STEP), dt=1.0)
    return perrin.locate(stack, **({"diameter": CONTACT, "contact": CONTACT} | options))


def off(table, places):
    """Return errors (m, 2) of the places found, each nearest to another sphere."""
    errors = []
    for i, truth in enumerate(places):
        found = table.loc[table["frame"] == i, ["x", "y"]].to_numpy()
        away = np.linalg.norm(found[:, None] - truth, axis=2)
        assert sorted(away.argmin(axis=1)) == list(range(len(truth)))
        errors.append(found - truth[away.argmin(axis=1)])
    return np.concatenate(errors)


@pytest.fixture(scope="module")
def rings():
    """Return positions of a triangle and a pair of touching rings, and their movie."""
    rng = np.random.default_rng(11)
    places = chains(4, rng)
    return places, drawn(places, ring, rng)


@pytest.fixture(scope="module")
def learned(rings):
    """Return the image of a ring, learned from that movie, and the places found in each frame."""
    _, movie = rings
    spots = [find_circles(f[0], contact=CONTACT, pixel=(STEP, STEP)) for f in movie]
    cut = circle_cut(np.concatenate([s.mass for s in spots]))
    places = [s.centers[s.mass > cut, 1:] for s in spots]
    image = learn_plane([f[0] for f in movie], places, contact=CONTACT, pixel=(STEP, STEP))
    return image, places


def test_touching_discs_come_back_within_their_errors():
    """All found, no others; squared errors are those stated, and distances are those of contact.

    Of 40 coordinates the mean square has a standard error of sqrt(2/40) = 22 %, of 16 distances
    the mean is known to 15 nm/sqrt(16) or 0.19 %; trackpy's distances are 4 % too long.
    """
    rng = np.random.default_rng(5)
    places = chains(4, rng)
    table = located(drawn(places, disc, rng))
    assert table["refined"].all()
    error = off(table, places)
    square = np.mean((error / table[["sigma_x", "sigma_y"]].to_numpy()) ** 2)
    assert abs(square - 1) < 4 * np.sqrt(2 / error.size)
    assert table["sigma_x"].median() < 0.02
    lengths = []
    for _, part in table.groupby("frame"):
        x = part[["x", "y"]].to_numpy()
        away = np.linalg.norm(x[:, None] - x, axis=2)[np.triu_indices(len(x), 1)]
        lengths += away[away < 1.3 * CONTACT].tolist()
    assert len(lengths) == 4 * len(places)
    assert np.mean(lengths) == pytest.approx(CONTACT, rel=0.005)


def test_touching_rings_come_back_within_their_errors(rings, learned):
    """Bright-field rings: squared errors are those stated, within 4 of sqrt(2/40) = 22 %.

    Their light adds, as the movie shows, and its noise is that of the background of 120 photons.
    """
    places, movie = rings
    image, starts = learned
    assert isinstance(image.noise, CameraNoise)
    assert image.noise.gain * GAIN * 120 + image.noise.floor == pytest.approx(
        GAIN**2 * 120, rel=0.1
    )
    assert RadialImage.from_dict(image.to_dict()).noise == image.noise
    square = []
    for truth, frame, start in zip(places, movie[:, 0], starts, strict=True):
        fit = fit_plane(frame, start, contact=CONTACT, image=image, pixel=(STEP, STEP))
        assert (fit.reason == "").all()
        away = np.linalg.norm(fit.centers[:, ::-1][:, None] - truth, axis=2).argmin(axis=1)
        assert sorted(away) == list(range(len(truth)))
        square.append(((fit.centers[:, ::-1] - truth[away]) / fit.sigma[:, ::-1]) ** 2)
    assert abs(np.mean(square) - 1) < 4 * np.sqrt(2 / np.size(square))


def test_transmissions_multiply_where_the_movie_shows_it():
    """Touching rims that absorb light in turn come back, distinguished from those that add.

    Added where they multiply, distances of touching spheres are some percent too long.
    """
    rng = np.random.default_rng(21)
    places = chains(3, rng)
    y, x = (STEP * np.arange(n) for n in (40, 64))
    movie = []
    for frame in places:
        away = np.hypot(x - frame[:, 0, None, None], y[:, None] - frame[:, 1, None, None])
        movie.append(rng.poisson(200 * np.prod(1 + 0.45 * ring(away / CONTACT), axis=0)))
    movie = GAIN * np.array(movie)[:, None].astype(np.float64)
    spots = [find_circles(f[0], contact=CONTACT, pixel=(STEP, STEP)) for f in movie]
    cut = circle_cut(np.concatenate([s.mass for s in spots]))
    starts = [s.centers[s.mass > cut, 1:] for s in spots]
    image = learn_plane([f[0] for f in movie], starts, contact=CONTACT, pixel=(STEP, STEP))
    assert isinstance(image.noise, TransmissionNoise)
    variance = image.noise.gain * GAIN * 200 + image.noise.floor
    assert variance == pytest.approx(GAIN**2 * 200, rel=0.1)
    again = RadialImage.from_dict(image.to_dict())
    assert again.noise == image.noise
    square = []
    for truth, frame, start in zip(places, movie[:, 0], starts, strict=True):
        fit = fit_plane(frame, start, contact=CONTACT, image=image, pixel=(STEP, STEP))
        assert (fit.reason == "").all()
        away = np.linalg.norm(fit.centers[:, ::-1][:, None] - truth, axis=2).argmin(axis=1)
        square.append(((fit.centers[:, ::-1] - truth[away]) / fit.sigma[:, ::-1]) ** 2)
    # Of 30 coordinates the mean square has a standard error of sqrt(2/30) = 26 %.
    assert abs(np.mean(square) - 1) < 4 * np.sqrt(2 / np.size(square))


def test_trackpy_is_refused_in_a_crowd():
    """All touching spheres at once would take it hours."""
    x, y = np.meshgrid(np.arange(5.0), np.arange(5.0))
    grid = 2.0 + CONTACT * np.column_stack([x.ravel(), y.ravel()])
    movie = drawn([grid], disc, np.random.default_rng(3), shape=(80, 80))
    with pytest.raises(ValueError, match=r"fits all spheres that touch at once: chains of up to 2"):
        located(movie, refine="trackpy")


def test_places_in_a_plane_follow_its_shift_rotation_and_contrast(rings, learned):
    """Shifted by pixels, turned by 90 degrees and as its negative a frame has the same places.

    Within a tenth of a standard error, where fits end.
    """
    places, movie = rings
    image, starts = learned
    image = RadialImage(image.spacing, image.coefficients, CameraNoise(0.0, 200.0))
    known = {"contact": CONTACT, "pixel": (STEP, STEP)}
    frame, start = movie[3, 0], starts[3]
    fit = fit_plane(frame, start, image=image, **known)
    assert (fit.reason == "").all()
    assert len(fit.centers) == places.shape[1]
    tolerance = 0.1 * fit.sigma.min()

    wider = np.pad(frame, ((5, 0), (7, 0)), mode="edge")
    shift = STEP * np.array([5, 7])
    moved = fit_plane(wider, start + shift, image=image, **known)
    np.testing.assert_allclose(moved.centers, fit.centers + shift, atol=tolerance)

    width = STEP * (frame.shape[1] - 1)
    turned = np.column_stack([width - start[:, 1], start[:, 0]])
    expected = np.column_stack([width - fit.centers[:, 1], fit.centers[:, 0]])
    again = fit_plane(np.rot90(frame), turned, image=image, **known)
    np.testing.assert_allclose(again.centers, expected, atol=tolerance)
    np.testing.assert_allclose(again.sigma, fit.sigma[:, ::-1], rtol=0.01)

    negative = RadialImage(image.spacing, -image.coefficients, image.noise)
    inverted = fit_plane(500 - frame, start, image=negative, **known)
    np.testing.assert_allclose(inverted.centers, fit.centers, atol=tolerance)
    spots, other = (find_circles(f, **known) for f in (frame, 500 - frame))
    np.testing.assert_allclose(spots.centers, other.centers)
    np.testing.assert_allclose(spots.mass, other.mass)


def test_spots_that_are_no_spheres_do_not_disturb_the_others(rings, learned):
    """A spot between spheres and one on the background are named as such."""
    _, movie = rings
    image, starts = learned
    known = {"contact": CONTACT, "image": image, "pixel": (STEP, STEP)}
    fit = fit_plane(movie[0, 0], starts[0], **known)
    n = len(starts[0])
    triangle = [c for c in fit.centers if c[1] < 6]
    wrong = [np.mean(triangle, axis=0), np.array([7.0, 12.0])]
    more = fit_plane(movie[0, 0], np.concatenate([starts[0], wrong]), **known)
    assert (more.reason[:n] == "").all()
    assert (more.reason[n:] != "").all()
    np.testing.assert_allclose(more.centers[:n], fit.centers, atol=0.1 * fit.sigma.min())


def test_a_crowd_in_a_plane_is_fitted_in_parts(learned):
    """A patch of 30 touching rings without noise comes back, far below its standard errors."""
    image, _ = learned
    y, x = (STEP * np.arange(n) for n in (56, 76))
    row, column = np.meshgrid(np.arange(5), np.arange(6), indexing="ij")
    truth = CONTACT * np.column_stack(
        [1.2 + np.sqrt(0.75) * row.ravel(), 1.2 + column.ravel() + row.ravel() % 2 / 2]
    )
    truth += np.random.default_rng(0).uniform(0, 0.01, truth.shape)
    frame = 120.0 + sum(image.value(np.hypot(y[:, None] - a, x - b)) for a, b in truth)
    start = truth + np.random.default_rng(1).uniform(-0.1, 0.1, truth.shape)
    fit = fit_plane(frame, start, contact=CONTACT, image=image, pixel=(STEP, STEP))
    assert (fit.reason == "").all()
    assert np.abs(fit.centers - truth).max() < 0.2 * fit.sigma.min()


def test_images_of_unequal_sizes_are_named():
    """Circles that spread by 17 %, as in a slice of a volume, are no images of equal spheres."""
    rng = np.random.default_rng(3)
    places = chains(2, rng, sizes=(2, 2))
    movie = drawn(places, disc, rng, sizes=np.array([0.8, 1.2, 0.85, 1.1]))
    spots = [find_circles(f[0], contact=CONTACT, pixel=(STEP, STEP)) for f in movie]
    cut = circle_cut(np.concatenate([s.mass for s in spots]))
    starts = [s.centers[s.mass > cut, 1:] for s in spots]
    with pytest.warns(perrin.PrecisionWarning, match=r"differ in size by [12]\d %"):
        learn_plane([f[0] for f in movie], starts, contact=CONTACT, pixel=(STEP, STEP))


def test_noise_and_optics_of_a_volume_are_refused_in_a_plane(rings):
    """Pure noise has no image to learn; what was measured in a volume does not describe a plane."""
    noise = np.random.default_rng(2).poisson(20.0, (1, 1, 30, 30))
    with pytest.raises(ValueError, match="image of a sphere cannot be learned"):
        located(noise)
    optics = perrin.Optics(CONTACT, (0.4, 0.2), CameraNoise(1.0, 0.0))
    with pytest.raises(ValueError, match="optics: those of a volume"):
        located(rings[1], optics=optics)


def test_a_planar_movie_ends_in_a_report():
    """From images to the noise floor: D_R of the true angles, sigma of the stated errors."""
    rng = np.random.default_rng(8)
    body = perrin.Cluster.touching(3, CONTACT).positions[:, :2]
    truth = perrin.simulate_motion(
        perrin.Cluster(body), D_R=0.02, D_T=0.01, dt=1.0, n_frames=5, rng=4
    )
    places = truth.positions() + 4.2
    movie = drawn(places, ring, rng, shape=(43, 43))
    stack = perrin.open_stack(movie, voxel=(STEP, STEP), dt=1.0)
    report = perrin.analyze_stack(stack, diameter=CONTACT, contact=CONTACT)
    (cluster,) = report.clusters
    known = perrin.analyze(perrin.positions_table(places), dt=1.0).clusters[0]
    for name in ("D_R", "D_T"):
        found, true = getattr(cluster, name), getattr(known, name)
        assert abs(found.value - true.value) < 0.5 * true.stderr
    features = report.imaging.features
    # Of the 3 internal coordinates in 5 frames: 1/sqrt(2 * 15), 18 %.
    assert cluster.motion.sigma == pytest.approx(features["sigma_x"].median(), rel=0.5)
    again = type(report.imaging).from_dict(report.imaging.to_dict())
    r = np.linspace(0, 3, 20)
    np.testing.assert_array_equal(again.radial.value(r), report.imaging.radial.value(r))
