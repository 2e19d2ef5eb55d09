"""Rigid bodies among touching spheres: what keeps together longer than diffusion allows."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.distance import cdist

import perrin
from perrin.geometry.rotations import exp_map
from perrin.tracks.rigid_bodies import identify_bodies, rigid_bodies

CONTACT, ERROR = 2.0, 0.004
SHAPES = {n: perrin.Cluster.touching(n, CONTACT).positions for n in (2, 3, 4)} | {
    1: np.zeros((1, 3))
}


def suspension(kinds, box, n_frames, rng, *, step=0.1, substeps=4):
    """Move bodies of touching spheres in a box; steps that make spheres overlap are not made.

    Returns frame, positions and owner of every detection.
    """
    shapes, places, turns = [SHAPES[k] for k in kinds], [], []
    spheres = np.empty((0, 3))
    for shape in shapes:
        while True:
            place, turn = rng.uniform(0, box, 3), random_turn(rng, np.pi)
            new = place + shape @ turn.T
            if np.any(new < 0) or np.any(new > box):
                continue
            if not len(spheres) or cdist(new, spheres).min() > CONTACT:
                break
        spheres = np.concatenate([spheres, new])
        places.append(place)
        turns.append(turn)
    owner = np.repeat(np.arange(len(kinds)), [len(shape) for shape in shapes])
    path = np.empty((n_frames, len(owner), 3))
    for k in range(n_frames):
        for _ in range(substeps):
            moves = step * rng.normal(size=(len(shapes), 3))
            small = exp_map(step / 3 * rng.normal(size=(len(shapes), 3)) / np.sqrt(3))
            for b, shape in enumerate(shapes):
                place, turn = places[b] + moves[b], small[b] @ turns[b]
                new = place + shape @ turn.T
                inside = np.all((new > 0) & (new < box))
                if inside and cdist(new, spheres[owner != b]).min() > CONTACT:
                    places[b], turns[b], spheres[owner == b] = place, turn, new
        path[k] = spheres
    frame = np.repeat(np.arange(n_frames), len(owner))
    x = path.reshape(-1, 3) + ERROR * rng.normal(size=(len(frame), 3))
    return frame, x, np.tile(owner, n_frames)


def random_turn(rng, size):
    return exp_map(size * rng.normal(size=3) / np.sqrt(3))


def partition(label):
    """Return the sets of rows of each label but -1."""
    return {tuple(np.flatnonzero(label == value)) for value in np.unique(label[label >= 0])}


@pytest.fixture(scope="module")
def crowd():
    """Return a tetrahedron, two trimers and a dimer among 40 spheres, 20 % by volume."""
    kinds = (4, 3, 3, 2, *[1] * 40)
    return suspension(kinds, 8.5, 16, np.random.default_rng(3))


def bodies_of(frame, owner):
    """Return the owners with several spheres as labels, -1 for single spheres."""
    several = np.bincount(owner[frame == 0])[owner] > 1
    return np.where(several, owner, -1)


def test_planted_bodies_come_back_from_a_crowd(crowd):
    """All of them, none false, no sphere too many or too few, in any sphere's every frame."""
    frame, x, owner = crowd
    found = rigid_bodies(frame, x, contact=CONTACT, error=ERROR)
    assert partition(found.body) == partition(bodies_of(frame, owner))
    assert sorted(found.size) == [2, 3, 3, 4]
    # Without a stated error as well.
    assert partition(rigid_bodies(frame, x, contact=CONTACT).body) == partition(found.body)


def test_bodies_do_not_depend_on_the_order_of_rows_the_unit_or_the_axes(crowd):
    """Rows permuted, positions rotated, moved and scaled, and time reversed: the same bodies."""
    frame, x, _ = crowd
    rng = np.random.default_rng(0)
    found = partition(rigid_bodies(frame, x, contact=CONTACT, error=ERROR).body)
    order = rng.permutation(len(x))
    permuted = rigid_bodies(frame[order], x[order], contact=CONTACT, error=ERROR).body
    back = np.empty_like(permuted)
    back[order] = permuted
    assert partition(back) == found
    moved = 1e3 * (x @ random_turn(rng, 2).T) + 7.0
    assert partition(rigid_bodies(frame, moved, contact=1e3 * CONTACT).body) == found
    assert partition(rigid_bodies(-frame, x, contact=CONTACT, error=ERROR).body) == found


@pytest.mark.parametrize("share", [0.15, 0.35])
def test_free_spheres_are_no_bodies(share, repeats):
    """Hard spheres at 15 and 35 % by volume, of which each touches several in most frames."""
    for seed in range(repeats(1, 50)):
        box = (64 * np.pi / 6 * CONTACT**3 / share) ** (1 / 3)
        rng = np.random.default_rng(seed)
        frame, x = hard_spheres(64, box, 20, rng)
        found = rigid_bodies(frame, x, contact=CONTACT, error=ERROR)
        assert found.size.size == 0
        assert len(np.unique(found.track)) == 64


def hard_spheres(count, box, n_frames, rng, *, step=0.15, substeps=6):
    """Move single spheres from a cubic lattice, several steps before the first frame."""
    side = round(count ** (1 / 3))
    grid = np.stack(np.meshgrid(*[np.arange(side)] * 3), axis=-1).reshape(-1, 3)
    x = (grid + 0.5) * box / side
    path = []
    for k in range(-3, n_frames):
        for _ in range(substeps):
            moves = step * rng.normal(size=x.shape)
            for i, move in enumerate(moves):
                new = x[i] + move
                square = ((x - new) ** 2).sum(axis=1)
                square[i] = np.inf
                if square.min() > CONTACT**2 and np.all((new > 0) & (new < box)):
                    x[i] = new
        if k >= 0:
            path.append(x.copy())
    frame = np.repeat(np.arange(n_frames), count)
    return frame, np.concatenate(path) + ERROR * rng.normal(size=(len(frame), 3))


def test_bodies_that_stick_together_for_a_while_remain_two():
    """Two trimers are one body of six spheres for half of the movie, and apart after that."""
    rng = np.random.default_rng(2)
    shape = np.concatenate([SHAPES[3], SHAPES[3] + [0.0, 0.0, CONTACT]])
    frame, x, owner = [], [], []
    place, turn = np.zeros(3), np.eye(3)
    apart = np.zeros(3)
    for k in range(40):
        place = place + 0.2 * rng.normal(size=3)
        turn = random_turn(rng, 0.05) @ turn
        apart = apart + (0.0 if k < 20 else 0.3) * np.array([0.0, 0.0, 1.0])
        both = shape + np.repeat([np.zeros(3), apart], 3, axis=0)
        frame.append(np.full(6, k))
        x.append(place + both @ turn.T + ERROR * rng.normal(size=(6, 3)))
        owner.append(np.repeat([0, 1], 3))
    frame, x, owner = map(np.concatenate, (frame, x, owner))
    found = rigid_bodies(frame, x, contact=CONTACT, error=ERROR)
    assert partition(found.body) == partition(owner)


def test_an_exchange_of_two_tracks_does_not_exchange_spheres_of_bodies(crowd):
    """Spheres are followed one by one, but a body has its own spheres on both sides of a gap."""
    frame, x, owner = crowd
    # In three frames one sphere of the tetrahedron is missing: its track ends or crosses the gap.
    lost = (owner == 0) & np.isin(frame, [9, 10, 11])
    lost &= np.arange(len(x)) % np.bincount(frame)[0] == 0
    kept = ~lost
    assert lost.sum() == 3
    found = identify_bodies(frame[kept], x[kept], contact=CONTACT, error=ERROR)
    assert partition(found.body) == partition(bodies_of(frame[kept], owner[kept]))


def test_spheres_at_rest_in_contact_are_a_body():
    """Where spheres move less than the error of their places, nothing but contact is known."""
    rng = np.random.default_rng(4)
    still = np.tile(SHAPES[4], (12, 1)) + 0.01 * rng.normal(size=(48, 3))
    found = rigid_bodies(np.repeat(np.arange(12), 4), still, contact=CONTACT, error=0.01)
    assert found.size.tolist() == [4]
    assert np.all(found.body == 0)


def test_particles_of_bodies_are_those_of_identify(crowd):
    """In a movie of tetrahedra alone the particles and pieces are those of `identify`."""
    rng = np.random.default_rng(6)
    frame, x, _ = suspension((4, 4), 9.0, 20, rng)
    found = identify_bodies(frame, x, contact=CONTACT, error=ERROR)

    table = pd.DataFrame(x, columns=list("xyz")).assign(frame=frame)
    known = perrin.identify(table, contact=CONTACT, size=4)
    assert np.array_equal(found.body, known["cluster"])
    assert np.array_equal(4 * found.body + found.particle, known["particle"])
    assert np.array_equal(found.piece, known["piece"])
    assert np.all(found.track == -1)


def test_bodies_recorded_plane_by_plane_are_found():
    """Distances that scatter by the motion during the scan are those of bodies, with `scan`.

    Between the recordings of two touching spheres a tenth of the time between frames passes: 20
    times the stated error. Without that knowledge fewer bonds are found; free spheres stay free.
    """
    rng = np.random.default_rng(12)
    frame, x, owner = suspension((4, 4, 3, *([1] * 12)), 14.0, 30, rng)
    steps = np.diff(x[owner >= 3].reshape(30, 12, 3), axis=0)
    scan = 0.1
    late = np.sqrt(scan * np.mean(steps**2) / 2) * rng.normal(size=x.shape)
    planted = partition(bodies_of(frame, owner))
    found = rigid_bodies(frame, x + late, contact=CONTACT, error=ERROR, scan=scan)
    assert partition(found.body) == planted
