"""The paper's bodies, touching spheres, and any arrangement."""

import json

import numpy as np
import pytest

from perrin import Cluster, point_group, rotation_group
from perrin.geometry.rotations import exp_map
from perrin.geometry.shapes import is_tetrahedron, pair_distances
from perrin.geometry.symmetry import matching_rotation, symmetry_elements


def distances(cluster):
    """Return all pair distances."""
    return pair_distances(cluster.positions)


@pytest.mark.parametrize(("n", "contacts"), [(2, 1), (3, 3), (4, 6), (5, 9), (6, 12), (7, 15)])
@pytest.mark.parametrize("diameter", [1e-9, 2.45, 1e9])
def test_touching_spheres_touch_and_do_not_overlap(n, contacts, diameter):
    """The right number of pairs (3n - 6 from n = 3) is one diameter apart, and none is closer."""
    cluster = Cluster.touching(n, diameter)
    gap = distances(cluster) / diameter - 1
    assert np.sum(np.abs(gap) < 1e-14) == contacts
    assert gap.min() > -1e-14
    assert np.all((np.abs(gap) < 1e-14) | (gap > 0.05))
    assert cluster.positions.shape == (n, 3)
    assert cluster.diameter == diameter
    np.testing.assert_allclose(cluster.positions.mean(0), 0, atol=1e-15 * diameter)


def test_the_touching_bipyramid_is_longer_than_the_papers_pentahedron():
    """Apex to apex is 3.266 radii for touching spheres, 2 R for Eq. 15 (facts/peers.md, 6)."""
    real = Cluster.touching(5, 2.0)
    assert distances(real).max() == pytest.approx(3.2660, abs=1e-4)
    paper = Cluster.pentahedron(1.0)
    np.testing.assert_allclose(np.linalg.norm(paper.positions, axis=1), 1.0, atol=1e-15)
    expected = [3**0.5] * 3 + [2**0.5] * 6 + [2.0]
    np.testing.assert_allclose(np.sort(distances(paper)), np.sort(expected), atol=1e-15)


def test_equation_14():
    """The tetrahedron's corners are the alternating corners of a cube, at distance R."""
    corners = Cluster.tetrahedron(1.5).positions * 3**0.5 / 1.5
    np.testing.assert_allclose(np.abs(corners), 1.0, atol=1e-15)
    np.testing.assert_allclose(corners.prod(axis=1), 1.0, atol=1e-15)
    assert len(np.unique(corners.round(), axis=0)) == 4


def test_equation_15():
    """The pentahedron: three on the circle of radius R in z = 0, two at z = R and z = -R."""
    x = Cluster.pentahedron(2.0).positions
    ring = 2 * np.array([[1, 0, 0], [-0.5, 0.75**0.5, 0], [-0.5, -(0.75**0.5), 0]])
    expected = np.concatenate([ring, [[0, 0, 2], [0, 0, -2]]])
    order, wanted = np.lexsort(x.round(9).T), np.lexsort(expected.round(9).T)
    np.testing.assert_allclose(x[order], expected[wanted], atol=1e-15)


@pytest.mark.parametrize("make", [Cluster.tetrahedron, Cluster.pentahedron, Cluster.trimer])
def test_the_papers_bodies_have_the_r_they_are_asked_for(make):
    """R comes back, every particle is at R, the centre is the origin, and the size scales."""
    body = make(1.7)
    assert pytest.approx(1.7, rel=1e-15) == body.R
    np.testing.assert_allclose(np.linalg.norm(body.positions, axis=1), 1.7, rtol=1e-14)
    np.testing.assert_allclose(body.positions.mean(0), 0, atol=1e-15)
    np.testing.assert_allclose(make(3.4).positions, 2 * body.positions, rtol=1e-15)
    assert body.diameter is None


def test_r_of_the_papers_experiment():
    """Four touching spheres of 2.45 um have R = 1.500 um (the paper's section 5)."""
    assert pytest.approx(1.500, abs=5e-4) == Cluster.touching(4, 2.45).R


def test_any_arrangement_is_centred_and_keeps_its_distances():
    """`from_positions` moves the centre only; R is the mean distance, also in the plane."""
    x = np.random.default_rng(3).normal(size=(6, 3)) + 50
    body = Cluster.from_positions(x.tolist())
    np.testing.assert_allclose(body.positions, x - x.mean(0), atol=1e-13)
    assert pytest.approx(np.linalg.norm(x - x.mean(0), axis=1).mean()) == body.R
    assert Cluster.from_positions([[0, 0], [2, 0]]).R == 1.0
    assert body.symmetry is None


def test_a_cluster_cannot_be_changed():
    """The template is frozen, and is a copy of what it was made from."""
    x = np.eye(3)
    body = Cluster.from_positions(x)
    before = body.positions.copy()
    x[0] = 9
    np.testing.assert_array_equal(body.positions, before)
    with pytest.raises(ValueError, match="read-only"):
        body.positions[0, 0] = 1.0
    with pytest.raises(AttributeError):
        body.diameter = 2.0


@pytest.mark.parametrize("size", [0, -1, np.nan, np.inf])
def test_sizes_must_be_positive(size):
    """A radius or diameter that is no positive number is refused by name and value."""
    for make in (Cluster.tetrahedron, Cluster.pentahedron, Cluster.trimer):
        with pytest.raises(ValueError, match=f"R = {size}"):
            make(size)
    with pytest.raises(ValueError, match=f"diameter = {size}"):
        Cluster.touching(3, size)


@pytest.mark.parametrize("n", [-2, 0, 1, 8, 2.5, "3"])
def test_touching_takes_two_to_seven_spheres(n):
    """Any other number of spheres is refused, with the alternative."""
    with pytest.raises(ValueError, match="from_positions"):
        Cluster.touching(n, 1.0)


@pytest.mark.parametrize(
    "positions", [np.ones(3), np.ones((4, 4)), np.ones((0, 3)), [[np.nan, 0, 0]], [[np.inf, 0]]]
)
def test_positions_must_be_points(positions):
    """Wrong shapes and numbers that are not finite are refused."""
    with pytest.raises(ValueError, match="positions"):
        Cluster.from_positions(positions)


def test_which_bodies_are_tetrahedra():
    """Pair distances equal within 10 % make one, in any pose and size; other bodies are none."""
    x = Cluster.touching(4, 2.45).positions
    turn = np.linalg.qr(np.random.default_rng(4).normal(size=(3, 3)))[0]
    assert is_tetrahedron(x)
    assert is_tetrahedron(1e6 + 1e-3 * x @ turn)
    assert is_tetrahedron(x * [1, 1, 1.05])
    assert not is_tetrahedron(x * [1, 1, 1.3])
    assert not is_tetrahedron(Cluster.touching(5, 2.45).positions)
    assert not is_tetrahedron(Cluster.touching(6, 2.45).positions[:4])
    assert not is_tetrahedron(np.ones((4, 2)))


# ---- symmetry -----------------------------------------------------------------------------------

GOLDEN = (1 + 5**0.5) / 2


def ring(n, height=0.0, turn=0.0, radius=1.0):
    angle = turn + 2 * np.pi * np.arange(n) / n
    return radius * np.stack([np.cos(angle), np.sin(angle), np.full(n, height / radius)], axis=1)


def two_rings(n, turn, height):
    return np.concatenate([ring(n, height), ring(n, -height, turn)])


def cyclic(x, *sides):
    """Return a set with its coordinates in all cyclic orders."""
    return np.concatenate([x, x[:, [1, 2, 0]], x[:, [2, 0, 1]], *sides])


def orbit(x, turn):
    """Return x and its images under the powers of a matrix."""
    images = [np.array(x, dtype=float)]
    while not np.allclose(images[-1] @ turn.T, images[0]):
        images.append(images[-1] @ turn.T)
    return np.concatenate(images)


SIGNS = np.array([(a, b) for a in (1.0, -1) for b in (1, -1)])
CUBE = np.array([(a, b, c) for a in (1.0, -1) for b in (1, -1) for c in (1, -1)])
THIRD = exp_map([0, 0, 2 * np.pi / 3])
RANDOM = np.array([[1, 0.2, 0.6], [0.5, 1.4, 0.9]])
BODIES = {
    "I_h": cyclic(np.insert(SIGNS * [1, GOLDEN], 0, 0, axis=1), [[0, 0, 0]]),
    "O_h": CUBE,
    "T_h": cyclic(np.insert(SIGNS * [1, 2.3], 2, 0, axis=1)),
    "T_d": CUBE[CUBE.prod(axis=1) > 0],
    "D_2": two_rings(2, 0.4, 0.7),
    "D_3": two_rings(3, 0.3, 0.7),
    "D_2d": two_rings(2, np.pi / 2, 0.4),
    "D_3d": two_rings(3, np.pi / 3, 0.5),
    "D_6d": two_rings(6, np.pi / 6, 0.6),
    "D_2h": np.insert(SIGNS * [1, 2], 2, 0, axis=1),
    "D_6h": two_rings(6, 0, 0.6),
    "C_2": orbit([[1, 0, 0.3], [0.4, 1.2, -0.5]], np.diag([-1.0, -1, 1])),
    "C_3": orbit([[1, 0, 0], [0.3, 1.1, 0.5], [1.5, 0.9, -0.4]], THIRD),
    "C_2v": np.array([[0, 0, 0], [2.0, 0, 0], [1, 1.5, 0]]),
    "C_4v": np.concatenate([ring(4), [[0, 0, 1.2]]]),
    "C_2h": np.array([[1.0, 0, 0], [-1, 0, 0], [1, 1, 0], [-1, -1, 0]]),
    "C_3h": orbit([[1, 0, 0], [0.3, 1.3, 0]], THIRD),
    "S_4": orbit(RANDOM, np.diag([1, 1, -1.0]) @ exp_map([0, 0, np.pi / 2])),
    "C_i": np.concatenate([RANDOM, [[0.4, -0.5, 1.5]], -RANDOM, [[-0.4, 0.5, -1.5]]]),
    "C_s": np.array([[0, 0, 0], [1.0, 0, 0], [0, 1.3, 0]]),
    "C_1": np.random.default_rng(5).normal(size=(6, 3)),
}
ORDERS = {"I_h": 60, "O_h": 24, "T_h": 12, "T_d": 12, "D_6h": 12, "D_3": 6, "C_4v": 4, "S_4": 2}


@pytest.mark.parametrize("symbol", BODIES)
def test_point_groups(symbol):
    """Every family is named, in any pose, order and size, exact or with 1 % errors."""
    rng = np.random.default_rng(2)
    x = rng.permutation(BODIES[symbol]) @ exp_map(rng.normal(size=3)).T
    assert point_group(x) == symbol
    assert point_group(1e-9 * x) == symbol
    assert point_group(x @ np.diag([1, 1, -1.0])) == symbol
    assert point_group(x + rng.normal(size=x.shape) * 0.01, tolerance=0.06) == symbol
    if symbol in ORDERS:
        assert len(rotation_group(x, tolerance=1e-6)) == ORDERS[symbol]


@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize("symbol", BODIES)
def test_rotation_groups_are_exact_groups(symbol, noise):
    """Products and inverses are members to rounding, also where the body is not exact."""
    rng = np.random.default_rng(3)
    x = BODIES[symbol] + noise * rng.normal(size=BODIES[symbol].shape)
    group = rotation_group(x, tolerance=6 * noise + 1e-9)
    unity = np.broadcast_to(np.eye(3), group.shape)
    np.testing.assert_allclose(group @ np.swapaxes(group, 1, 2), unity, atol=1e-13)
    np.testing.assert_allclose(np.linalg.det(group), 1, atol=1e-13)
    np.testing.assert_array_equal(group[0].round(13), np.eye(3))
    products = (group[:, None] @ group).reshape(-1, 9)
    apart = np.abs(products[:, None] - group.reshape(-1, 9)).max(axis=2)
    assert apart.min(axis=1).max() < 1e-12
    # Every member carries the body on itself, each particle to the place of one other.
    centred = x - x.mean(0)
    miss = np.linalg.norm((centred @ np.swapaxes(group, 1, 2))[:, :, None] - centred, axis=3)
    assert miss.min(axis=2).max() <= 12 * noise + 1e-9


@pytest.mark.parametrize(
    "body",
    [
        *(Cluster.touching(n, 2.45) for n in range(2, 8)),
        Cluster.pentahedron(1.5),
        Cluster.tetrahedron(1.5),
        Cluster.trimer(1.0),
    ],
)
def test_the_bodies_have_the_symmetry_they_state(body):
    """`Cluster.symmetry` is what `point_group` finds; a distorted body has less."""
    assert point_group(body.positions) == body.symmetry
    if len(body.positions) > 3:
        off = np.random.default_rng(1).normal(size=body.positions.shape) * 0.05
        assert point_group(body.positions + off) == "C_1"


def test_lines_points_and_the_plane():
    """Particles on a line, one particle, and bodies of the plane."""
    turn = exp_map([1.0, 0.4, 0.2])
    rod = np.array([[0, 0, -1.0], [0, 0, 0], [0, 0, 1]]) @ turn.T
    assert point_group(rod) == "D_inf_h"
    bent = np.array([[0, 0, -1.0], [0.3, 0, 0], [0, 0, 1]]) @ turn.T
    assert point_group(bent, tolerance=1e-3) == "C_2v"
    assert point_group([[0, 0, 0], [0, 0, 1], [0, 0, 3]]) == "C_inf_v"
    assert point_group([[1, 2, 3]]) == "K_h"
    swap = rotation_group(rod, tolerance=0.01)
    assert swap.shape == (2, 3, 3)
    np.testing.assert_allclose(rod @ swap[1].T, rod[::-1], atol=1e-12)
    assert len(rotation_group([[0, 0, 0], [0, 0, 1], [0, 0, 3]], tolerance=0.01)) == 1
    assert len(rotation_group([[1, 2, 3]], tolerance=0)) == 1
    square = SIGNS @ [[0.8, 0.6], [-0.6, 0.8]]
    turns = rotation_group(square, tolerance=0.01)
    assert turns.shape == (4, 2, 2)
    np.testing.assert_allclose(np.linalg.det(turns), 1, atol=1e-13)
    assert point_group(square) == "D_4h"
    np.testing.assert_allclose(rotation_group([[0, 1], [0, -1]], tolerance=0)[1], -np.eye(2))


def test_a_nearly_symmetric_body_is_judged_by_the_tolerance():
    """A tetrahedron stretched by 5 % along a twofold axis is D_2d; within 10 % it is T_d."""
    x = Cluster.tetrahedron(1.0).positions * [1, 1, 1.05]
    assert point_group(x, tolerance=1e-3) == "D_2d"
    assert point_group(x, tolerance=0.1) == "T_d"
    # The symmetrised body is a true tetrahedron: the elements are those of a cube's corners.
    elements = symmetry_elements(x, 0.1)
    assert len(elements) == 24
    np.testing.assert_allclose(np.abs(elements).round(12) % 1, 0, atol=1e-12)


@pytest.mark.parametrize("tolerance", [-1, np.nan, np.inf])
def test_tolerances_must_be_lengths(tolerance):
    """A tolerance that is no finite number >= 0 is refused."""
    with pytest.raises(ValueError, match="tolerance"):
        rotation_group(np.eye(3), tolerance=tolerance)
    with pytest.raises(ValueError, match="tolerance"):
        point_group(np.eye(3), tolerance=tolerance)


def test_a_body_is_carried_onto_its_relabelled_copy_and_not_onto_its_mirror_image():
    """The planted rotation of a body without symmetry comes back; its mirror image has none."""
    rng = np.random.default_rng(2)
    x = rng.normal(size=(6, 3))
    x -= x.mean(0)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    moved = (x @ turn.T)[rng.permutation(6)]
    np.testing.assert_allclose(matching_rotation(x, moved, tolerance=1e-6), turn, atol=1e-12)
    assert matching_rotation(x, -moved, tolerance=1e-2) is None


@pytest.mark.parametrize("cluster", [Cluster.touching(5, 2.45), Cluster([[0.1, 0], [1, 0.3]])])
def test_a_cluster_comes_back_from_json(cluster):
    """Positions to the last bit, symmetry and diameter."""
    back = Cluster.from_dict(json.loads(json.dumps(cluster.to_dict())))
    np.testing.assert_array_equal(back.positions, cluster.positions)
    assert (back.symmetry, back.diameter) == (cluster.symmetry, cluster.diameter)
    assert not back.positions.flags.writeable
