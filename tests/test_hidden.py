"""Spheres that were not found, beyond the border or dim, belong to the body that shows them."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

import perrin
from perrin.images import CameraNoise
from perrin.movie.hidden import complete_bodies, missing_places, touching_places, with_spheres

DIAMETER, FRAMES = 2.0, 3
OPTICS = perrin.Optics(DIAMETER, (0.4, 0.15), CameraNoise(1.0, 0.0))
TETRAHEDRON = perrin.Cluster.touching(4, DIAMETER)
FOUR = TETRAHEDRON.positions
AXES = np.array([[-1, -1, -1], [1, -1, 0], [-1, -1, 2]]) / np.sqrt([[3], [2], [6]])
NO_OTHERS = pd.DataFrame({"frame": [], "cluster": [], "x": [], "y": [], "z": []})
PHOTONS = 60


def movie_of(x, *, brightness=None, seed=1):
    """Return a movie of spheres at x (T, n, 3), each with its own brightness."""
    places = [x] if brightness is None else [x[:, [k]] for k in range(x.shape[1])]
    parts = [
        perrin.render_stack(
            part,
            voxel=(0.3, 0.25, 0.25),
            shape=(24, 32, 32),
            diameter=DIAMETER,
            psf=(0.4, 0.15, 0.15),
            dt=1.0,
            photons=PHOTONS * (1 if brightness is None else brightness[k]),
            background=0,
            noise=False,
            dtype="float64",
            rng=1,
        )
        for k, part in enumerate(places)
    ]
    mean = np.sum([np.stack(list(part)) for part in parts], axis=0) + 3.0
    frames = np.random.default_rng(seed).poisson(mean).astype(np.float64)
    return perrin.open_stack(frames, voxel=(0.3, 0.25, 0.25), dt=1.0)


@pytest.fixture(scope="module")
def leaving():
    """Return the paths of a tetrahedron, and the motion of the three spheres that are inside."""
    truth = perrin.simulate_motion(TETRAHEDRON, D_R=1e-3, D_T=1e-3, dt=1.0, n_frames=FRAMES, rng=3)
    # The first sphere, on the axis through the three others, is beyond the border.
    x = truth.positions() @ AXES.T
    x = x - x[:, 0].mean(axis=0) + [-0.4, 4.0, 3.4]
    return x, perrin.track_rotation(x[:, 1:], dt=1.0)


def posed(stack, motion):
    return perrin.images.fit_pose(stack, motion, optics=OPTICS)


def pose_squares(motion, x):
    """Return the mean squared ratio of the errors of centre and orientation to the stated ones."""
    true = perrin.track_rotation(x, dt=1.0)
    turn = np.swapaxes(motion.rotation, 1, 2) @ true.rotation
    error = np.stack([perrin.geometry.log_map(t) for t in turn])
    error -= error.mean(axis=0)
    square = np.einsum("ti,tij,tj->t", error, np.linalg.inv(motion.covariance), error) / 3
    off = motion.center - x.mean(axis=1)
    center = (off - off.mean(axis=0)) ** 2 / motion.center_variance[:, None]
    lost = FRAMES / (FRAMES - 1)
    return square.mean() * lost, center.mean() * lost


@pytest.mark.parametrize("known", [True, False])
def test_a_sphere_beyond_the_border_belongs_to_its_body(leaving, known):
    """Its light is seen, so that poses have their stated errors; without it they are larger.

    With 3 frames a mean square of 9 components has a standard deviation of 0.5.
    """
    x, part = leaving
    movie = movie_of(x)
    motions = {7: (part, np.arange(FRAMES))}
    if known:  # another body of the movie is whole
        other = perrin.simulate_motion(TETRAHEDRON, D_R=1e-3, dt=1.0, n_frames=FRAMES, rng=1)
        motions[8] = (other, np.arange(FRAMES))
    whole, found = complete_bodies(
        movie, motions, optics=OPTICS, features=NO_OTHERS, contact=DIAMETER
    )
    assert list(whole) == [7]
    assert np.allclose(np.sort(perrin.geometry.pair_distances(whole[7].template)), 2, atol=0.1)
    assert "1 beside 3 that are found (beyond the border, brightness" in found.notes[0]
    turn, center = pose_squares(posed(movie, whole[7]), x)
    assert turn < 2.2
    assert center < 2.2
    stated = [np.trace(posed(movie, m).covariance.sum(axis=0)) for m in (whole[7], part)]
    assert stated[0] < 0.7 * stated[1]


def test_a_dim_sphere_of_a_known_shape_is_found_and_an_undyed_one_is_not(leaving):
    """12 % of the brightness decide on which side it is; without light nothing does."""
    x, _ = leaving
    x = np.add(x, [2.2, 0.0, 0.0])
    part = perrin.track_rotation(x[:, 1:], dt=1.0)
    other = perrin.simulate_motion(TETRAHEDRON, D_R=1e-3, dt=1.0, n_frames=FRAMES, rng=1)
    motions = {0: (part, np.arange(FRAMES)), 1: (other, np.arange(FRAMES))}
    settings = {"optics": OPTICS, "features": NO_OTHERS, "contact": DIAMETER}
    dim = movie_of(x, brightness=(0.12, 1, 1, 1))
    whole, found = complete_bodies(dim, motions, **settings)
    assert list(whole) == [0]
    assert np.linalg.norm(whole[0].positions()[:, 3] - x[:, 0], axis=1).max() < 0.1
    assert "(dim, brightness 0.1" in found.notes[0]
    undyed = movie_of(x, brightness=(0, 1, 1, 1))
    assert complete_bodies(undyed, motions, **settings)[0] == {}


def test_a_body_of_which_all_spheres_are_found_stays(leaving):
    """A trimer alone has none beyond the border, nor has a tetrahedron beside it."""
    x, part = leaving
    movie = movie_of(x[:, 1:])
    motions = {0: (part, np.arange(FRAMES))}
    whole, found = complete_bodies(
        movie, motions, optics=OPTICS, features=NO_OTHERS, contact=DIAMETER
    )
    assert whole == {}
    assert found == ((), ())


def test_places_of_other_spheres_turn_with_the_body():
    """Places beside a turned and permuted part are those places turned: nothing is preferred."""
    turn = perrin.kabsch(np.random.default_rng(1).normal(size=(5, 3)), np.eye(5, 3))
    octahedron = perrin.Cluster.touching(6, DIAMETER).positions
    for places_of in (
        lambda t: np.concatenate(missing_places(t, octahedron)),
        lambda t: touching_places(t, contact=DIAMETER),
    ):
        part = octahedron[:4] - octahedron[:4].mean(axis=0)
        turned = places_of(part[[2, 0, 3, 1]] @ turn.T)
        away = np.linalg.norm(turned[:, None] - places_of(part) @ turn.T, axis=2)
        assert away.min(axis=0).max() < 1e-9
        assert away.min(axis=1).max() < 1e-9


@pytest.mark.parametrize(("size", "count"), [(4, 2), (6, None)])
def test_places_of_the_missing_spheres_complete_the_shape(size, count):
    """Every way gives all distances of the whole; a triangle has the fourth sphere on two sides."""
    whole = perrin.Cluster.touching(size, DIAMETER).positions
    near = np.argsort(np.linalg.norm(whole - whole[0], axis=1), kind="stable")[:3]
    sets = missing_places(whole[near], whole)
    assert sets
    assert count is None or len(sets) == count
    expected = np.sort(perrin.geometry.pair_distances(whole))
    for places in sets:
        distances = perrin.geometry.pair_distances(np.concatenate([whole[near], places]))
        assert np.allclose(np.sort(distances), expected, atol=1e-9)


def test_the_centre_of_a_completed_body_is_that_of_all_its_spheres(leaving):
    """Positions of the found spheres do not change; the error of the centre grows with its arm."""
    _, part = leaving
    place = touching_places(part.template, contact=DIAMETER)[:1]
    whole = with_spheres(part, place)
    assert np.allclose(whole.positions()[:, :3], part.positions())
    assert np.allclose(whole.positions().mean(axis=1), whole.center)
    arm = np.linalg.norm(place) / 4
    turn = np.trace(part.covariance, axis1=1, axis2=2)
    more = whole.center_variance - part.center_variance
    assert np.all((more > 0) & (more < arm**2 * turn / 3))
