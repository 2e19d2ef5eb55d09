"""Which particles travel together, and their positions as an array."""

import numpy as np
import pandas as pd
import pytest

from perrin.errors import TrackTableError
from perrin.tracks.clusters import cluster_positions, find_clusters

TETRAHEDRON = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(8)


def table_of(positions, ids=None, first=0):
    """Return the track table of an array (T, n, d)."""
    n_frames, n, d = positions.shape
    ids = np.arange(n) if ids is None else np.asarray(ids)
    frame = np.repeat(np.arange(first, first + n_frames), n)
    columns = {"frame": frame, "particle": np.tile(ids, n_frames)}
    return pd.DataFrame(columns | dict(zip("xyz"[:d], positions.reshape(-1, d).T, strict=True)))


def tetrahedra(n_clusters=3, n_frames=20, seed=0, apart=10.0):
    """Return (T, 4 n, 3): clusters of edge 1 far apart, each turning and drifting a little."""
    rng = np.random.default_rng(seed)
    turn = np.linalg.qr(rng.normal(size=(n_frames, n_clusters, 3, 3)))[0]
    side = int(np.ceil(n_clusters ** (1 / 3)))
    grid = np.indices((side, side, side)).reshape(3, -1).T[:n_clusters] * apart
    center = grid + 0.1 * rng.normal(size=(n_frames, n_clusters, 3)).cumsum(axis=0)
    points = np.einsum("tcij,kj->tcki", turn, TETRAHEDRON) + center[:, :, None]
    return points.reshape(n_frames, -1, 3)


def labels_of(table):
    """Return the cluster of each particle as a dict, checking that it has only one."""
    assert (table.groupby("particle")["cluster"].nunique() == 1).all()
    return table.groupby("particle")["cluster"].first().to_dict()


# ---- find_clusters ------------------------------------------------------------------------------


def test_turning_tetrahedra_are_found_and_the_rest_is_loose():
    """Bodies keep together, a lone particle and a pair are no body in three dimensions."""
    lone = np.full((20, 1, 3), 100.0)
    pair = np.array([[50.0, 0, 0], [51.0, 0, 0]]) * np.ones((20, 1, 1))
    found = find_clusters(
        table_of(np.concatenate([lone, tetrahedra(2), pair], axis=1)), contact=1.0
    )
    assert found["cluster"].dtype == np.int64
    assert list(labels_of(found).values()) == [-1] + [0] * 4 + [1] * 4 + [-1] * 2


def test_a_pair_is_a_cluster_in_two_dimensions():
    """Without z two particles that travel together are a cluster."""
    points = np.array([[0.0, 0], [1.0, 0], [9.0, 0]]) + np.arange(5.0)[:, None, None]
    assert list(labels_of(find_clusters(table_of(points), contact=1.0)).values()) == [0, 0, -1]


def test_a_chain_is_one_cluster():
    """Particles of a chain are one cluster, although its ends do not touch each other."""
    points = np.arange(5.0)[:, None] * [1.0, 0, 0] * np.ones((6, 1, 1))
    assert set(find_clusters(table_of(points), contact=1.0)["cluster"]) == {0}


def test_clusters_are_numbered_by_their_smallest_particle_id():
    """The number does not depend on place or order of rows, only on the ids."""
    ids = [9, 8, 7, 3, 2, 20, 21, 22, 11, 30, 31, 0]
    labels = labels_of(find_clusters(table_of(tetrahedra(3), ids), contact=1.0))
    assert [labels[i] for i in (0, 2, 3, 9, 20)] == [0, 1, 2, 2, 1]
    assert [labels[i] for i in (11, 30, 31)] == [0, 0, 0]


@pytest.mark.parametrize(("ratio", "cluster"), [(1.29, 0), (1.31, -1)])
def test_the_reach_is_one_and_three_tenths_of_contact(ratio, cluster):
    """Nearer than 1.3 contact belongs together, farther does not; units do not matter."""
    for unit in (1.0, 2.45, 1e-3):
        points = np.array([[0.0, 0], [ratio * unit, 0]]) * np.ones((4, 1, 1))
        assert set(find_clusters(table_of(points), contact=unit)["cluster"]) == {cluster}


@pytest.mark.parametrize(
    ("n_near", "n_shared", "cluster"),
    [(1, 1, -1), (1, 2, -1), (2, 2, 0), (2, 3, 0), (2, 4, -1), (3, 5, 0), (5, 10, -1), (6, 10, 0)],
)
def test_pairs_are_near_in_more_than_half_of_the_shared_frames(n_near, n_shared, cluster):
    """Near in over half of the frames that hold both, at least 2 of them."""
    points = np.zeros((20, 2, 2))
    points[:, 1, 0] = np.where(np.arange(20) < n_near, 1.0, 8.0)
    points[n_shared:, 1] = np.nan
    table = table_of(points)
    assert set(find_clusters(table, contact=1.0)["cluster"]) == {cluster}
    assert set(find_clusters(table.dropna(), contact=1.0)["cluster"]) == {cluster}


def test_a_passing_particle_does_not_join_two_bodies():
    """A particle that touches two bodies for a while belongs to neither."""
    points = tetrahedra(2, n_frames=30)
    visitor = np.full((30, 1, 3), 500.0)
    visitor[:9, 0] = points[:9, 0] + 0.5
    visitor[9:18, 0] = points[9:18, 4] + 0.5
    labels = labels_of(
        find_clusters(table_of(np.concatenate([points, visitor], axis=1)), contact=1.0)
    )
    assert list(labels.values()) == [0] * 4 + [1] * 4 + [-1]


def test_the_table_comes_back_with_one_more_column():
    """Rows, index and other columns stay; the input is untouched."""
    table = table_of(tetrahedra(2)).assign(mass=1.5).sample(frac=1, random_state=1)
    before = table.copy()
    found = find_clusters(table, contact=1.0)
    pd.testing.assert_frame_equal(table, before)
    pd.testing.assert_frame_equal(found.drop(columns="cluster"), before)
    again = find_clusters(found.assign(cluster=7), contact=1.0)
    pd.testing.assert_frame_equal(again, found)


@pytest.mark.parametrize("seed", range(5))
def test_order_of_rows_frames_and_ids_change_no_cluster(seed):
    """Permuted rows, shifted frames, moved and turned space, ids renamed in order."""
    rng = np.random.default_rng(seed)
    points = tetrahedra(4, seed=seed)
    points[rng.random(points.shape[:2]) < 0.2] = np.nan
    table = table_of(points).dropna()
    found = find_clusters(table, contact=1.0)["cluster"]
    assert sorted(set(found)) == [0, 1, 2, 3]
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    for other in (
        table.sample(frac=1, random_state=seed),
        table.assign(frame=table["frame"] - 1000),
        table.assign(particle=table["particle"] * 7 - 5),
        table.assign(particle=[f"p{i:03d}" for i in table["particle"]]),
        table_of(points @ turn + 1e3).dropna().set_index(table.index),
    ):
        again = find_clusters(other, contact=1.0)["cluster"].reindex(found.index)
        assert again.tolist() == found.tolist()


def test_ids_renamed_at_random_keep_the_partition():
    """Other ids give the same groups."""
    names = np.random.default_rng(4).permutation(16)
    table = table_of(tetrahedra(4))
    found = find_clusters(table, contact=1.0)["cluster"]
    renamed = find_clusters(table.assign(particle=names[table["particle"]]), contact=1.0)["cluster"]
    assert len(set(zip(found, renamed, strict=True))) == 4


def test_a_particle_without_coordinates_is_loose():
    """A particle with rows of NaN only belongs to no cluster."""
    points = tetrahedra(1)
    points[:, 2] = np.nan
    assert list(labels_of(find_clusters(table_of(points), contact=1.0)).values()) == [0, 0, -1, 0]
    assert set(find_clusters(table_of(points * np.nan), contact=1.0)["cluster"]) == {-1}


@pytest.mark.parametrize("contact", [0, -1.0, np.nan, np.inf, [1.0]])
def test_a_contact_that_is_no_distance_is_refused(contact):
    """A distance is a positive number."""
    with pytest.raises(ValueError, match=r"contact = "):
        find_clusters(table_of(tetrahedra(1)), contact=contact)


def test_a_thousand_clusters_are_found(repeats):
    """1000 clusters of 4, with --long over 300 frames (1.2e6 rows), are all found."""
    frames = repeats(30, 300)
    table = table_of(tetrahedra(1000, n_frames=frames, apart=20.0))
    found = find_clusters(table, contact=1.0)["cluster"].to_numpy()
    np.testing.assert_array_equal(found, np.tile(np.repeat(np.arange(1000), 4), frames))


@pytest.mark.parametrize("function", [cluster_positions, lambda t: find_clusters(t, contact=1.0)])
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda t: t.drop(columns=["x", "frame"]), "missing columns frame, x"),
        (lambda t: t.iloc[:0], "no rows"),
        (lambda t: t.assign(frame=t["frame"].where(t["frame"] > 0)), "4 rows without frame"),
        (lambda t: t.assign(particle=np.nan), "80 rows without particle"),
        (lambda t: t.assign(frame=t["frame"] + 0.5), "80 frame numbers that are not whole"),
        (lambda t: t.assign(y=np.inf), "80 rows with an infinite coordinate"),
        (lambda t: pd.concat([t, t.iloc[:3]]), "3 rows that repeat a particle in a frame"),
    ],
)
def test_a_table_that_was_not_checked_gives_no_wrong_answer(function, change, words):
    """A table that `check_tracks` would refuse is refused here too."""
    with pytest.raises(TrackTableError, match=words):
        function(change(table_of(tetrahedra(1))))


# ---- cluster_positions --------------------------------------------------------------------------


@pytest.mark.parametrize("d", [2, 3])
def test_positions_come_back_as_they_went_in(d):
    """An array through a table and back is the same array."""
    points = np.random.default_rng(0).normal(size=(7, 5, d))
    points[2, 3] = np.nan
    points[4] = np.nan
    positions, frames = cluster_positions(table_of(points, first=11))
    np.testing.assert_array_equal(positions, points)
    np.testing.assert_array_equal(frames, np.arange(11, 18))
    assert (positions.dtype, frames.dtype) == (np.float64, np.int64)


def test_a_missing_row_and_a_row_of_nan_are_the_same():
    """NaN rows, also with one NaN coordinate, count as not there, at the ends too."""
    points = np.random.default_rng(1).normal(size=(9, 5, 3))
    points[[0, 8]] = np.nan
    points[:, 4] = np.nan
    points[3, 2, 1] = np.nan
    points[5, :3, 0] = np.nan
    table = table_of(points)
    with_nan, without = cluster_positions(table), cluster_positions(table.dropna())
    for one, other in zip(with_nan, without, strict=True):
        np.testing.assert_array_equal(one, other)
    assert with_nan[1].tolist() == list(range(1, 8))
    assert np.isnan(with_nan[0][2, 2]).all()
    assert np.isnan(with_nan[0][4]).any(axis=1).tolist() == [True, True, True, False]


def test_rows_permuted_frames_shifted_and_ids_renamed_change_nothing_else():
    """Only the order of frames and of ids matters."""
    rng = np.random.default_rng(2)
    points = rng.normal(size=(6, 3, 3))
    table = table_of(points)
    shuffled, _ = cluster_positions(table.sample(frac=1, random_state=0))
    np.testing.assert_array_equal(shuffled, points)
    shifted, frames = cluster_positions(table.assign(frame=table["frame"] - 4))
    np.testing.assert_array_equal(shifted, points)
    assert frames.tolist() == list(range(-4, 2))
    names = np.array([30, 10, 20])
    renamed, _ = cluster_positions(table.assign(particle=names[table["particle"]]))
    np.testing.assert_array_equal(renamed, points[:, [1, 2, 0]])
    texts = np.array(["c", "a", "b"])
    renamed, _ = cluster_positions(table.assign(particle=texts[table["particle"]]))
    np.testing.assert_array_equal(renamed, points[:, [1, 2, 0]])


def test_the_table_is_left_as_it_was():
    """Neither function changes its table."""
    table = table_of(tetrahedra(2)).assign(cluster=0)
    before = table.copy()
    positions, _ = cluster_positions(table)
    positions[:] = 0
    pd.testing.assert_frame_equal(table, before)


@pytest.mark.parametrize("labels", [[0, 5, -1], ["a", "b", None], ["a", "b", np.nan]])
def test_each_cluster_has_its_own_particles_and_frames(labels):
    """Loose particles are in none; first and last frame are the cluster's own."""
    points = np.random.default_rng(3).normal(size=(6, 8, 3))
    table = table_of(points)
    table["cluster"] = [labels[0 if i < 3 else 1 if i < 7 else 2] for i in table["particle"]]
    table = table[(table["cluster"] != labels[0]) | (table["frame"] > 1)]
    one, frames = cluster_positions(table, cluster=labels[0])
    np.testing.assert_array_equal(one, points[2:, :3])
    assert frames.tolist() == [2, 3, 4, 5]
    other, frames = cluster_positions(table, cluster=labels[1])
    np.testing.assert_array_equal(other, points[:, 3:7])
    assert frames.tolist() == list(range(6))
    only, _ = cluster_positions(table[table["cluster"] != labels[1]])
    np.testing.assert_array_equal(only, one)


def test_the_same_id_may_be_in_two_clusters():
    """Ids that start anew in every cluster are kept apart."""
    points = np.random.default_rng(5).normal(size=(4, 6, 2))
    table = table_of(points, ids=[0, 1, 2, 0, 1, 2]).assign(cluster=[0, 0, 0, 1, 1, 1] * 4)
    np.testing.assert_array_equal(cluster_positions(table, cluster=1)[0], points[:, 3:])


def test_several_clusters_need_a_choice():
    """The message lists the clusters of the table."""
    table = table_of(tetrahedra(2)).assign(cluster=lambda t: t["particle"] // 4 * 3)
    with pytest.raises(ValueError, match=r"cluster=.*the 2 clusters 0, 3"):
        cluster_positions(table)
    with pytest.raises(ValueError, match=r"no cluster 1; the table holds the 2 clusters 0, 3"):
        cluster_positions(table, cluster=1)
    with pytest.raises(ValueError, match=r"no cluster -1;"):
        cluster_positions(table.assign(cluster=[-1, 0] * 80), cluster=-1)
    with pytest.raises(ValueError, match=r"every row is loose"):
        cluster_positions(table.assign(cluster=-1))
    with pytest.raises(ValueError, match=r"cluster = 0: the table has no column cluster"):
        cluster_positions(table.drop(columns="cluster"), cluster=0)
    many = table_of(tetrahedra(30, n_frames=1)).assign(cluster=lambda t: t["particle"] // 4)
    with pytest.raises(ValueError, match=r"the 30 clusters 0, 1, .* 19 and 10 more"):
        cluster_positions(many)


def test_found_clusters_have_the_positions_of_the_bodies():
    """From one table of all particles to the array of each body."""
    points = tetrahedra(3)
    found = find_clusters(table_of(points).sample(frac=1, random_state=2), contact=1.0)
    for c in range(3):
        positions, _ = cluster_positions(found, cluster=c)
        np.testing.assert_array_equal(positions, points[:, 4 * c : 4 * c + 4])


def test_frame_numbers_that_are_times_are_refused():
    """Two frames a billion apart would make an array of a billion rows."""
    table = table_of(np.zeros((2, 3, 3)))
    with pytest.raises(TrackTableError, match=r"from 0 to 1000000000, a span of 1000000001, but"):
        cluster_positions(table.assign(frame=table["frame"] * 10**9))
    positions, _ = cluster_positions(table.assign(frame=table["frame"] * 999_999))
    assert len(positions) == 1_000_000
    with pytest.raises(TrackTableError, match="look like times or ids"):
        cluster_positions(table.assign(frame=table["frame"] * 1_000_000))


def test_a_cluster_without_coordinates_is_refused():
    """A cluster with NaN rows only has no positions."""
    with pytest.raises(TrackTableError, match="no row has coordinates"):
        cluster_positions(table_of(np.full((4, 3, 3), np.nan)))
