"""Bodies found by the distances that stay the same, without a contact distance."""

from __future__ import annotations

import re

import numpy as np
import pytest

import perrin
from perrin.run.grouping import assign_clusters, stretch_warnings
from perrin.tracks.bonds import rigid_groups
from perrin.tracks.clusters import find_clusters


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
def test_bodies_among_loose_particles_are_found(count, loose, n_frames, repeats):
    """Every body and no other, with few particles (all pairs) and many (neighbours only)."""
    for seed in range(repeats(1, 2)):
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


# ---- noise that is not white, not equal along the axes, or not small ----------------------------

UPRIGHT = np.array([[-1.225, 0, 0], [1.225, 0, 0], [0, 0, 2.122]])


def moving(body, *, D_R, seed, n_frames=250, D_T=None, dt=0.73):
    """Return the positions (T, n, 3) of a body whose first pose is as given."""
    cluster = perrin.Cluster(body - body.mean(axis=0))
    D_T = 8 * D_R if D_T is None else D_T
    return perrin.simulate_motion(
        cluster, D_R=D_R, D_T=D_T, dt=dt, n_frames=n_frames, rng=seed
    ).positions()


def smooth(shape, memory, rng):
    """Return noise of variance 1 whose lag-1 autocorrelation is `memory`, shape (T, n, 3)."""
    steps = rng.normal(size=(shape[0] + 500, *shape[1:]))
    out = np.zeros(steps.shape)
    for k in range(1, len(out)):
        out[k] = memory * out[k - 1] + np.sqrt(1 - memory**2) * steps[k]
    return out[500:]


@pytest.mark.parametrize("seed", range(6))
def test_a_body_at_rest_with_smooth_error_is_one_body(seed):
    """Two nanometres of noise with a lag-1 autocorrelation of 0.98, on a trimer of 2.45 um."""
    rng = np.random.default_rng(seed)
    triangle = 2.45 * np.array([[0, 0, 0], [1, 0, 0], [0.5, np.sqrt(0.75), 0]])
    assert found_in(triangle + 0.002 * smooth((250, 3, 3), 0.98, rng)).tolist() == [0, 0, 0]


@pytest.mark.parametrize("ratio", [1 / 4, 3, 4])
@pytest.mark.parametrize("axis", [0, 2])
def test_one_axis_may_be_measured_worse(ratio, axis, repeats):
    """A slow upright trimer and a slow tetrahedron, one lab axis 3 to 4 times worse or better."""
    sigma = np.full(3, 0.02)
    sigma[axis] *= ratio
    for seed in range(repeats(1, 3)):
        rng = np.random.default_rng(seed)
        for body in (UPRIGHT, perrin.Cluster.touching(4, 2.45).positions):
            x = moving(body, D_R=1e-5, seed=rng)
            x += rng.normal(size=x.shape) * sigma
            assert found_in(x).tolist() == [0] * len(body)


@pytest.mark.parametrize("D_R", [1e-5, 5e-3])
def test_a_few_bad_coordinates_do_not_decide(D_R, repeats):
    """Three of 1200 coordinates, and one percent of them, off by 1 to 1000 um."""
    for seed in range(repeats(2, 4)):
        rng = np.random.default_rng(seed)
        x = moving(perrin.Cluster.touching(4, 2.45).positions, D_R=D_R, seed=rng, n_frames=300)
        x = perrin.add_noise(x, sigma=0.03, rng=rng)
        for count in (3, 36):
            y = x.copy()
            hit = rng.choice(y.size, count, replace=False)
            y.flat[hit] += rng.choice([-1, 1], count) * 10 ** rng.uniform(0, 3, count)
            assert found_in(y).tolist() == [0] * 4


def test_bodies_of_very_different_noise_are_all_found():
    """The tightest body of a table is no measure of the others."""
    for seed, noise in enumerate(([0.01, 0.12, 0.12, 0.12], [0.005, 0.03, 0.06, 0.12])):
        x, truth = bodies(4, seed=seed, sigma=0.0)
        rng = np.random.default_rng(seed)
        x += rng.normal(size=x.shape) * np.repeat(noise, 4)[:, None]
        np.testing.assert_array_equal(found_in(x), truth)


def test_particles_that_drift_together_are_no_body(repeats):
    """A common flow does not make free particles a body."""
    for seed in range(repeats(1, 3)):
        x, truth = bodies(0, loose=20, n_frames=250, seed=seed)
        x[..., 0] += 0.3 * np.arange(250)[:, None]
        np.testing.assert_array_equal(found_in(x), truth)


def test_trapped_particles_among_bodies_are_loose(repeats):
    """Trapped particles keep their distances within a tenth, but in no direction better."""
    for seed in range(repeats(1, 3)):
        x, _ = bodies(3, seed=seed, n_frames=250)
        rng = np.random.default_rng(seed)
        traps = np.array([[60, 0, 0], [70, 0, 0], [60, 10, 0], [70, 10, 0], [65, 5, 8]])
        held = traps + 0.3 * smooth((250, 5, 3), 0.7, rng)
        both = np.concatenate([x, held], axis=1)
        assert found_in(both).tolist() == [0] * 4 + [1] * 4 + [2] * 4 + [-1] * 5


def test_slow_neighbouring_bodies_are_two_where_their_distance_wanders(repeats):
    """Their distance wanders by more than its noise, from block to block of time."""
    for seed in range(repeats(2, 4)):
        rng = np.random.default_rng(seed)
        body = perrin.Cluster.touching(4, 2.45).positions
        x = [moving(body, D_R=1e-4, seed=rng) + 5.0 * k * np.eye(3)[0] for k in range(2)]
        noisy = np.concatenate(x, axis=1) + rng.normal(scale=0.03, size=(250, 8, 3))
        assert found_in(noisy).tolist() == [0] * 4 + [1] * 4


def test_the_result_does_not_depend_on_the_order_of_rows():
    """Rows shuffled, particles permuted: the same partition."""
    x, truth = bodies(3, loose=4, seed=9)
    rng = np.random.default_rng(9)
    frames, n, _ = x.shape
    frame, code = np.repeat(np.arange(frames), n), np.tile(np.arange(n), frames)
    order = rng.permutation(len(frame))
    name = rng.permutation(n)
    points = x.reshape(-1, 3)[order]
    found = rigid_groups(frame[order], name[code[order]], points, count=n, smallest=3)[name]
    assert ((found == -1) == (truth == -1)).all()
    assert len(set(zip(found, truth, strict=True))) == 4


def test_tables_without_pairs_have_no_bodies():
    """No rows, one particle, two at the same place together with a body."""
    none = np.empty(0, dtype=np.int64)
    assert rigid_groups(none, none, np.empty((0, 3)), count=2, smallest=2).tolist() == [-1, -1]
    assert found_in(np.zeros((20, 1, 2))).tolist() == [-1]
    x, _ = bodies(1, seed=2)
    doubled = np.concatenate([x, np.full((100, 2, 3), 50.0)], axis=1)
    assert found_in(doubled)[:4].tolist() == [0] * 4


def test_bodies_that_another_scale_of_z_makes_loose_are_named():
    """A table with z in planes names the factor; free particles and bodies with their z do not."""
    x, free = bodies(2, seed=4)[0], bodies(0, loose=8)[0]
    tables = [
        perrin.positions_table(y).drop(columns="cluster") for y in (x / [1.0, 1.0, 2.2], x, free)
    ]
    (text,) = stretch_warnings(tables[0])
    factor, pairs = re.search(r"multiplied by ([\d.]+) the distances of (\d+)", text).groups()
    assert float(factor) == pytest.approx(2.2, rel=0.03)
    assert 6 <= int(pairs) <= 12
    assert stretch_warnings(tables[1]) == stretch_warnings(tables[2]) == []
    assert text in assign_clusters(tables[0])[2].warnings
    narrow = perrin.positions_table(x / [1.0, 1.0, 0.4]).drop(columns="cluster")
    with pytest.raises(perrin.TrackTableError, match=r"no cluster: .*with z multiplied by 0\.[34]"):
        assign_clusters(narrow)
