"""Spheres in two-dimensional movies."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import perrin
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


def test_a_plane_has_centroids_in_place_of_the_model_of_a_volume(triangles):
    """A warning states it, the positions are centroids; trackpy's own fit stays available."""
    _, places, movie = triangles
    asked = {"diameter": 0.9, "contact": 0.9, "frames": [0, 1]}
    with pytest.warns(perrin.PrecisionWarning, match="2-D movie places are filtered centroids"):
        table = perrin.locate(movie, **asked)
    assert table.equals(perrin.locate(movie, refine=None, **asked))
    # Discs are for balls larger than the point spread: as wide here as the spot at half its height.
    spot = {"diameter": 0.36, "contact": 0.9}
    discs = perrin.locate(movie, refine="trackpy", **(asked | spot))
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
        table = perrin.locate(stack, diameter=5, contact=5, refine=None)
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
