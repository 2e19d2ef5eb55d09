"""Crowds: many touching spheres fitted together, in rendered packings and in a real stack."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.distance import cdist

import perrin
from perrin.images.optics.crowd_equations import normal_equations
from perrin.images.optics.crowd_fit import fit_crowd
from perrin.images.optics.optics import CameraNoise
from perrin.images.spheres.localisation import (
    Search,
    choose_method,
    sample_frames,
    without_doubles,
)

pytest.importorskip("trackpy")

VOXEL = (0.25, 0.2, 0.2)
DIAMETER = 2.45
NO_OTHERS = np.empty((0, 3))
OPTICS = perrin.Optics(DIAMETER, (0.393, 0.139), CameraNoise(3.0, 4.0))
REAL = Path(__file__).resolve().parents[2] / "shared" / "data" / "peri_confocal"


class Movie:
    """One frame in memory."""

    def __init__(self, frame, voxel=VOXEL):
        self.shape, self.voxel, self._frame = (1, *frame.shape), voxel, frame

    def frame(self, _):
        return self._frame


def packed(n, side, rng):
    """Throw balls into a box and push them apart until they overlap by at most 3 %."""
    x = side * rng.random((n, 3))
    for _ in range(2000):
        apart = x[:, None] - x
        distance = np.linalg.norm(apart, axis=2) + np.diag(np.full(n, np.inf))
        overlap = np.maximum(DIAMETER - distance, 0)
        if overlap.max() < 0.03 * DIAMETER:
            break
        x += 0.4 * np.sum(apart * (overlap / distance)[..., None], axis=1)
    return x - x.min(axis=0) + 1.8


@pytest.fixture(scope="module")
def pack(repeats):
    """Return positions (x, y, z) of touching balls, and their frame at 40 photons."""
    n = repeats(18, 30)
    places = packed(n, 7.5 * (n / 30) ** (1 / 3), np.random.default_rng(5))
    shape = tuple(
        int(np.ceil(e / h)) for e, h in zip(places.max(0)[::-1] + 1.8, VOXEL, strict=True)
    )
    stack = perrin.render_stack(
        places[None], voxel=VOXEL, shape=shape, diameter=DIAMETER, psf=(0.4, 0.15, 0.15),
        photons=40, spread=0.08, background=4, gradient=(0, 0, 0.1), gain=3, read_noise=2,
        rng=2, dtype="float64",
    )  # fmt: skip
    return places, stack.frame(0)


def fitted(frame, start, optics=OPTICS):
    return fit_crowd(
        frame,
        start,
        others=NO_OTHERS,
        contact=DIAMETER,
        image=optics.image(VOXEL),
        noise=optics.noise,
    )


@pytest.fixture(scope="module")
def begun(pack):
    """Return starts (z, y, x) 50 nm off the true places, and the fit that begins there."""
    places, frame = pack
    start = places[:, ::-1] + np.random.default_rng(0).normal(0, 0.05, places.shape)
    return start, fitted(frame, start)


def normal(table, places):
    """Return the errors (n, 3) of the spheres nearest to the true ones over the stated errors."""
    found = table[["x", "y", "z"]].to_numpy()
    nearest = cdist(places, found).argmin(axis=1)
    sigma = table[["sigma_x", "sigma_y", "sigma_z"]].to_numpy()
    return (found[nearest] - places) / sigma[nearest]


def test_a_crowd_is_located_within_the_stated_errors(pack):
    """With diameter and contact given, no sphere is missed or false, and errors are as stated.

    The mean square of the n normalised errors has the standard error sqrt(2/n); its tolerance is
    four of them. A filtered centroid is off by over 80 nm (the bias of touching balls). The
    standard errors of a sphere whose image overlaps a dozen others are at most 1.2 times those of
    one in a group of four (4.3, 4.3, 5.7 nm).
    """
    places, frame = pack
    stack, asked = Movie(frame), {"diameter": 1.03 * DIAMETER, "contact": DIAMETER}
    search = Search(**asked, crowds=True)
    sample = sample_frames(stack, search, range(stack.shape[0]))
    optics = choose_method(stack, search, sample).optics
    got = np.array([optics.diameter, *optics.psf])
    # A rendered voxel has the intensity at its centre: the blur by the voxel is not included.
    width = np.sqrt(np.array([0.4, 0.15]) ** 2 - np.array([0.25, 0.2]) ** 2 / 12)
    assert np.all(np.abs(got - [DIAMETER, *width]) < 4 * np.array(optics.stderr))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        table = perrin.locate(stack, optics=optics, crowds=True, **asked)
    assert len(table) == len(places)
    assert table["refined"].all()
    off = normal(table, places)
    assert np.mean(off**2) == pytest.approx(1.0, abs=4 * np.sqrt(2 / off.size))
    assert np.all(table[["sigma_x", "sigma_y", "sigma_z"]].mean() < 1.2 * np.array([4.3, 4.3, 5.7]))
    assert table["chi2"].mean() == pytest.approx(1.0, abs=0.05)
    first = perrin.locate(stack, refine=None, **asked)[["x", "y", "z"]]
    assert np.median(cdist(places, first).min(axis=1)) > 0.08


def test_missing_spheres_are_added_and_false_ones_removed(pack, begun):
    """From a start without five spheres and with four false ones the fit ends at the same place."""
    places, frame = pack
    start, whole = begun
    assert whole.origin.tolist() == list(range(len(places)))
    invented = start[[0, 8, 16]] + [0.9, 0.0, 0.9]
    again = fitted(frame, np.concatenate([start[5:], invented, [[0.2, 0.2, 0.2]]]))
    nearest = cdist(whole.centers, again.centers).argmin(axis=1)
    assert len(again.centers) == len(places)
    # Both searches end at steps below 1e-4 of the blur, 15 pm; convergence is at least linear.
    assert np.allclose(again.centers[nearest], whole.centers, atol=1e-4)
    assert np.all(again.converged)


def test_no_sphere_remains_in_noise():
    """Spots in noise alone, and in a frame of zeros, are all removed."""
    rng = np.random.default_rng(0)
    start, shape = rng.uniform(1, 4, (4, 3)), (20, 25, 25)
    for frame in (3.0 * rng.poisson(5, shape), np.zeros(shape)):
        assert len(fitted(frame, start).centers) == 0


def test_dark_spheres_are_found_as_bright_ones_are(pack):
    """The negative of a frame has the same spheres."""
    places, frame = pack
    even = perrin.Optics(DIAMETER, OPTICS.psf, CameraNoise(0.0, 200.0))
    bright, dark = (fitted(f, places[:, ::-1], even) for f in (frame, 300 - frame))
    assert np.allclose(bright.centers, dark.centers, atol=1e-5)
    assert np.all(dark.intensity.brightness < 0)


def test_a_border_through_the_crowd_adds_no_bias(pack):
    """All spheres inside the border are found, with the stated errors."""
    places, frame = pack
    low = np.array([8, 10, 10])
    part = places - (low * VOXEL)[::-1]
    end = (np.array(frame.shape) - low - 1) * VOXEL
    inside = np.all((part >= 0) & (part <= end[::-1]), axis=1)
    found = fitted(frame[8:, 10:, 10:], part[inside][:, ::-1] + 0.03)
    nearest = cdist(part[inside], found.centers[:, ::-1]).argmin(axis=1)
    off = (found.centers[nearest] - part[inside][:, ::-1]) / found.sigma[nearest]
    assert len(found.centers) == inside.sum()
    assert np.mean(off**2) == pytest.approx(1.0, abs=4 * np.sqrt(2 / off.size))


def test_crowds_are_not_refined_by_default(pack):
    """Their spheres keep the positions found first, and the table states the reason."""
    frame = pack[1]
    asked = {"diameter": DIAMETER, "contact": DIAMETER}
    with pytest.warns(perrin.PrecisionWarning, match=r"crowds=True refines"):
        table = perrin.locate(Movie(frame), **asked)
    first = perrin.locate(Movie(frame), refine=None, **asked)
    np.testing.assert_array_equal(table[["x", "y", "z"]], first[["x", "y", "z"]])
    assert not table["refined"].any()
    assert set(table["reason"]) == {"in a crowd"}
    assert table[["sigma_x", "sigma_y", "sigma_z", "chi2"]].isna().all(axis=None)


def test_the_normal_equations_are_those_of_finite_differences(pack, begun):
    """The score is minus half the derivative of chi-squared; errors are those of all parameters."""
    places, found = pack[0], begun[1]
    window, rng, n = found.window, np.random.default_rng(1), 4 * len(places)
    state = found.intensity.moved(window, rng.normal(0, 0.01, n + window.n_background))
    information, score = normal_equations(window, state)
    for k in (0, 5, 43, n + 3, len(score) - 1):
        step = np.zeros_like(score)
        step[k] = 1e-4
        up, down = (state.chi2(window, state.moved(window, s * step).expected) for s in (1, -1))
        assert (down - up) / 4e-4 == pytest.approx(score[k], rel=1e-5, abs=1e-3)
        assert (up + down - 2 * state.chi2(window, state.expected)) / 2e-8 == pytest.approx(
            information[k, k], rel=0.2
        )
    information, _ = normal_equations(window, found.intensity)
    exact = np.sqrt(np.diag(np.linalg.inv(information.toarray())))
    # Spheres beyond a sphere's neighbours are taken as known.
    assert np.allclose(found.sigma, exact[:n].reshape(-1, 4)[:, :3], rtol=0.01)


def test_no_two_refined_spheres_overlap():
    """Of spheres within 0.8 contacts the worse fit is marked; the order of rows does not matter."""
    rng = np.random.default_rng(7)
    x = rng.uniform(0, 8, (60, 3))
    columns = dict(zip("xyz", x.T, strict=True)) | {
        "chi2": rng.uniform(0.8, 2.0, 60),
        "refined": rng.random(60) < 0.9,
        "reason": np.full(60, "", dtype=object),
    }
    found = without_doubles(columns, contact=2.0)
    kept = found["refined"]
    assert not (kept & ~columns["refined"]).any()
    away = cdist(x, x) + np.diag(np.full(60, np.inf))
    assert away[np.ix_(kept, kept)].min() >= 1.6
    for k in np.flatnonzero(columns["refined"] & ~kept):
        near = columns["refined"] & (away[k] < 1.6)
        assert (columns["chi2"][near] < columns["chi2"][k]).any()
        assert "0.8 contact" in found["reason"][k]
    order = rng.permutation(60)
    turned = without_doubles({name: v[order] for name, v in columns.items()}, contact=2.0)
    np.testing.assert_array_equal(turned["refined"], kept[order])


@pytest.mark.skipif(not REAL.exists(), reason="the real confocal stack is not available")
def test_a_real_stack_of_dark_spheres(repeats):
    """Spheres that do not overlap are found at almost all positions listed for another program.

    Its authors made the list by centroids, and it has pairs at 0.64 and 0.9 diameters: the list is
    complete, but not accurate to a voxel. Hard spheres do not overlap; 5 % are allowed for their
    distribution of size. The stated noise was learned from this stack, so that chi2 is 1 where the
    fit is as good as it was then. The quick form fits a part of the stack.
    """
    from PIL import Image, ImageSequence

    with warnings.catch_warnings():
        # The file was written by Python 2.
        warnings.simplefilter("ignore", UserWarning)
        listed = np.load(REAL / "particle-positions.npy")[:, ::-1]
    with Image.open(REAL / "small_confocal_image.tif") as pages:
        frame = np.array([np.array(page) for page in ImageSequence.Iterator(pages)])
    frame = frame[: repeats(32, 48), : repeats(48, 64), : repeats(46, 64)]
    listed = listed[np.all((listed >= 0) & (listed < frame.shape[::-1]), axis=1)]
    assert len(listed) == repeats(19, 37)
    stack = Movie(frame, voxel=(1.0, 1.0, 1.0))
    asked = {"diameter": 11, "contact": 11, "dark": True}
    first = perrin.locate(stack, refine=None, **asked)[["x", "y", "z"]]
    assert np.sum(cdist(listed, first).min(axis=1) < 1) >= repeats(8, 20)
    optics = perrin.Optics(11.17, (3.66, 1.2), CameraNoise(0.09, 12.7))
    table = perrin.locate(stack, optics=optics, crowds=True, **asked)
    found = table[["x", "y", "z"]].to_numpy()
    off = cdist(listed, found).min(axis=1)
    assert table["refined"].all()
    assert np.sum(off < 2) >= repeats(14, 25)
    assert np.sum(off < 5.5) >= repeats(17, 35)
    apart = cdist(found, found) + np.diag(np.full(len(found), np.inf))
    assert apart.min() > 0.95 * optics.diameter
    assert table["chi2"].median() == pytest.approx(1.0, abs=0.1)
