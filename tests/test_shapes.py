"""The paper's bodies, touching spheres, and any arrangement."""

import numpy as np
import pytest

from perrin import Cluster
from perrin.shapes import is_tetrahedron


def distances(cluster):
    """Return all pair distances."""
    x = cluster.positions
    i, j = np.triu_indices(len(x), 1)
    return np.linalg.norm(x[i] - x[j], axis=1)


@pytest.mark.parametrize(("n", "contacts"), [(2, 1), (3, 3), (4, 6), (5, 9), (6, 12), (7, 15)])
@pytest.mark.parametrize("diameter", [1e-9, 2.45, 1e9])
def test_touching_spheres_touch_and_do_not_overlap(n, contacts, diameter):
    """So many pairs stand exactly one diameter apart (3n - 6 from n = 3), and none is closer."""
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
def test_touching_knows_two_to_seven(n):
    """Any other number of spheres is refused, with the way out."""
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
    """Alike pair distances within 10 % make one, in any pose and size; other bodies are none."""
    x = Cluster.touching(4, 2.45).positions
    turn = np.linalg.qr(np.random.default_rng(4).normal(size=(3, 3)))[0]
    assert is_tetrahedron(x)
    assert is_tetrahedron(1e6 + 1e-3 * x @ turn)
    assert is_tetrahedron(x * [1, 1, 1.05])
    assert not is_tetrahedron(x * [1, 1, 1.3])
    assert not is_tetrahedron(Cluster.touching(5, 2.45).positions)
    assert not is_tetrahedron(Cluster.touching(6, 2.45).positions[:4])
    assert not is_tetrahedron(np.ones((4, 2)))
