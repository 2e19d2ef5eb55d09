"""Bodies found by the distances that stay the same, without a contact distance."""

from __future__ import annotations

import numpy as np
import pytest

import perrin
from perrin.grouping import find_clusters


def bodies(count, *, n_frames=100, loose=0, seed=0, apart=10.0, sigma=0.03):
    """Return a table of tetrahedra on a grid and of free particles, and the true clusters."""
    rng = np.random.default_rng(seed)
    side = int(np.ceil((count + 1) ** (1 / 3)))
    grid = np.indices((side,) * 3).reshape(3, -1).T * apart
    parts = []
    for c in range(count):
        truth = perrin.simulate_motion(
            perrin.Cluster.touching(4, 2.45),
            D_R=5e-3,
            D_T=0.04,
            dt=0.73,
            n_frames=n_frames,
            rng=rng,
        )
        parts.append(truth.positions() + grid[c])
    for _ in range(loose):
        walk = rng.normal(scale=0.38, size=(n_frames, 1, 3)).cumsum(axis=0)
        parts.append(walk + rng.uniform(0, side * apart, 3))
    x = perrin.add_noise(np.concatenate(parts, axis=1), sigma=sigma, rng=rng)
    truth = np.concatenate([np.repeat(np.arange(count), 4), np.full(loose, -1)])
    return x, truth


def found_in(x, **options):
    table = perrin.positions_table(x).drop(columns="cluster")
    return find_clusters(table, **options).groupby("particle")["cluster"].first().to_numpy()


@pytest.mark.parametrize(("count", "loose", "n_frames"), [(1, 0, 10), (8, 25, 100), (27, 20, 60)])
def test_bodies_among_loose_particles_are_found(count, loose, n_frames):
    """Every body and no other, with few particles (all pairs) and many (neighbours only)."""
    for seed in range(2):
        x, truth = bodies(count, loose=loose, n_frames=n_frames, seed=seed)
        np.testing.assert_array_equal(found_in(x), truth)


def test_a_gas_has_no_body():
    """Free particles are loose, all of them."""
    x, truth = bodies(0, loose=30, n_frames=150, seed=3)
    np.testing.assert_array_equal(found_in(x), truth)


def test_gaps_do_not_matter():
    """A third of the points missing, and one particle seen in half of the time only."""
    x, truth = bodies(5, loose=5, seed=4)
    x[np.random.default_rng(4).random(x.shape[:2]) < 0.33] = np.nan
    x[:50, 2] = np.nan
    np.testing.assert_array_equal(found_in(x), truth)


def test_bodies_that_stay_near_each_other_for_a_while_are_two():
    """For a quarter of the time two bodies travel side by side, touching."""
    x, truth = bodies(2, seed=5, n_frames=160)
    beside = x[40:80, :4].mean(axis=1) + np.array([4.0, 0, 0]) - x[40:80, 4:].mean(axis=1)
    x[40:80, 4:] += beside[:, None]
    np.testing.assert_array_equal(found_in(x), truth)


def test_the_fewest_particles_of_a_body():
    """Pairs are bodies in the plane, and in space where asked for."""
    rng = np.random.default_rng(6)
    walk = rng.normal(size=(80, 3, 2)).cumsum(axis=0)
    x = np.concatenate([walk, walk[:, :1] + [1.0, 0.0]], axis=1) + 0.01 * rng.normal(
        size=(80, 4, 2)
    )
    assert found_in(x).tolist() == [0, -1, -1, 0]
    space = np.concatenate([x, rng.normal(scale=0.01, size=(80, 4, 1))], axis=2)
    assert found_in(space).tolist() == [-1] * 4
    assert found_in(space, size=2).tolist() == [0, -1, -1, 0]
    with pytest.raises(ValueError, match="size: expected a whole number"):
        found_in(space, size=1)


def test_turned_moved_and_scaled_tables_give_the_same_bodies():
    """No unit and no axis is special."""
    x, truth = bodies(6, loose=10, seed=7)
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    for other in (x @ turn, x + 1e4, x * 1e3, x[::-1]):
        np.testing.assert_array_equal(found_in(other), truth)
