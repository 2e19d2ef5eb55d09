"""Raw detections: groups of touching particles, followed through time."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

import perrin
from perrin.tracks.groups import touching_groups
from perrin.tracks.linking import Centers, linked_tracks

DIAMETER = 2.45


def raw(positions, rng, *, extra=0):
    """Return the shuffled rows of bodies (T, n, 3) without ids, and the truth."""
    parts = []
    for body, x in enumerate(positions):
        frame, site = np.indices(x.shape[:2])
        columns = {"frame": frame.ravel(), "body": body, "site": site.ravel()}
        parts.append(pd.DataFrame(columns | dict(zip("xyz", x.reshape(-1, 3).T, strict=True))))
    for k in range(extra):
        at = rng.uniform(-20, 60, 3)
        parts.append(
            pd.DataFrame({"frame": [k], "body": -1, "site": -1, "x": at[0], "y": at[1], "z": at[2]})
        )
    table = pd.concat(parts, ignore_index=True)
    return table.sample(frac=1, random_state=int(rng.integers(99))).reset_index(drop=True)


def track(rng, n_frames=100, body=4, factor=1.0):
    truth = perrin.simulate_motion(
        perrin.Cluster.touching(body, DIAMETER),
        D_R=4.9e-3,
        D_T=0.0385,
        dt=0.73 * factor,
        n_frames=n_frames,
        rng=rng,
    )
    return perrin.add_noise(truth.positions(), sigma=(0.03, 0.03, 0.04), rng=rng)


def wrong(found):
    """Count the particles that are two within one piece."""
    known = found[found["cluster"] >= 0]
    truth = known["body"] * 100 + known["site"]
    return int((truth.groupby([known["particle"], known["piece"]]).nunique() > 1).sum())


def test_shuffled_rows_become_lasting_particles():
    """Three clusters, 1 % lost, stray detections: every particle keeps its id."""
    rng = np.random.default_rng(0)
    table = raw([track(rng) + np.array([25.0 * k, 0, 0]) for k in range(3)], rng, extra=60)
    table = table[rng.random(len(table)) > 0.01]
    found = perrin.identify(table, contact=DIAMETER, size=4)
    assert wrong(found) == 0
    real = found[found["body"] >= 0]
    # Of frames that lost two particles of one cluster (1 in 1700) the others are loose.
    assert (real["cluster"] >= 0).mean() > 0.99
    assert (found.loc[found["body"] < 0, "cluster"] == -1).all()
    assert not found.duplicated(["frame", "particle"]).any()


def test_two_clusters_that_pass_keep_their_identity():
    """Nearest sphere centres come to 1.2 diameters, within reach of the grouping."""
    rng = np.random.default_rng(1)
    one, other = (track(rng) for _ in range(2))
    one, other = (x - x.mean(axis=1, keepdims=True) for x in (one, other))
    by, gap = np.linspace(-4, 4, 100)[:, None, None] * [0.0, 1.0, 0.0], 0.0
    while True:
        moved = other + by + [gap, 0.0, 0.0]
        nearest = np.linalg.norm(one[:, :, None] - moved[:, None], axis=-1).min(axis=(1, 2))
        if nearest.min() >= 1.2 * DIAMETER:
            break
        gap += 0.01
    assert (nearest < 1.3 * DIAMETER).any()
    found = perrin.identify(raw([one, moved], rng), contact=DIAMETER, size=4)
    assert wrong(found) == 0
    assert (found["cluster"] >= 0).all()
    assert found["piece"].max() == 0
    assert found["cluster"].nunique() == 2


def test_raw_detections_give_the_result_of_the_labelled_tracks():
    """D_R is the same with the particles found and with the true labels."""
    rng = np.random.default_rng(2)
    x = track(rng)
    found = perrin.identify(raw([x], rng), contact=DIAMETER, size=4)
    values = [
        perrin.estimate_diffusion(perrin.track_rotation(positions, dt=0.73)).value
        for positions in (x, perrin.cluster_positions(found, cluster=0)[0])
    ]
    assert values[1] == pytest.approx(values[0], rel=1e-6)


@pytest.mark.usefixtures("no_tensors", "no_verdicts")
def test_cuts_of_identify_reach_the_analysis():
    """Sampled too slowly for its symmetry a cluster is cut; no step joins two pieces."""
    rng = np.random.default_rng(3)
    found = perrin.identify(raw([track(rng, 60, factor=16)], rng), contact=DIAMETER, size=4)
    assert found["piece"].max() > 0
    (result,) = perrin.analyze(found, dt=16 * 0.73).clusters
    assert result.motion.piece.max() >= found["piece"].max()
    assert len(result.quality.cuts) == result.motion.piece.max()
    texts = [w for w in result.warnings if "identity" in w and "cut" in w]
    assert all(str(frame) in texts[0] for frame in result.quality.cuts)


def test_rods_have_two_ends():
    """With size=2 the ends of dumbbells are distinguished by least rotation."""
    rng = np.random.default_rng(4)
    found = perrin.identify(raw([track(rng, body=2)], rng), contact=DIAMETER, size=2)
    assert wrong(found) == 0
    assert (found["cluster"] == 0).all()


def test_other_columns_stay_and_the_input_is_untouched():
    """The columns particle and cluster are replaced, the rest is the caller's."""
    rng = np.random.default_rng(5)
    table = raw([track(rng, n_frames=20)], rng).assign(mass=2.0, particle=7)
    before = table.copy()
    found = perrin.identify(table, contact=DIAMETER, size=4)
    pd.testing.assert_frame_equal(table, before)
    pd.testing.assert_frame_equal(
        found.drop(columns=["particle", "cluster", "piece"]), before.drop(columns="particle")
    )
    with pytest.raises(ValueError, match="contact = "):
        perrin.identify(table, contact=0.0, size=4)
    with pytest.raises(ValueError, match="size: expected"):
        perrin.identify(table, contact=1.0, size=2.5)


def test_labels_that_pass_to_another_particle_are_a_warning():
    """Ids exchanged from frame 12 on: two labels; ids that last under other numbers: none."""
    table = perrin.positions_table(track(np.random.default_rng(6), n_frames=30))
    renamed = table.assign(particle=7 - table["particle"])
    assert perrin.identify(renamed, contact=DIAMETER, size=4)["cluster"].eq(0).all()
    late = table["frame"] >= 12
    exchanged = table["particle"].mask(late, table["particle"].map({0: 1, 1: 0, 2: 2, 3: 3}))
    with pytest.warns(perrin.IdentityWarning) as caught:
        perrin.identify(table.assign(particle=exchanged), contact=DIAMETER, size=4)
    (warning,) = caught
    assert str(warning.message) == (
        "identity: 2 labels pass to another particle, in frame 12; they are corrected"
    )
    assert warning.filename == __file__


def test_groups_stop_growing_at_their_size():
    """Two pairs nearer than the reach stay two, and a lone point is loose."""
    x = np.array([[0.0, 0], [1.0, 0], [2.2, 0], [3.2, 0], [9.0, 0]])
    assert touching_groups(x, reach=1.3, size=2, smallest=2).tolist() == [0, 0, 1, 1, -1]
    assert touching_groups(x, reach=1.3, size=4, smallest=2).tolist() == [0, 0, 0, 0, -1]


@pytest.mark.parametrize("jump", [1.2, 2.0, 5.0])
def test_a_jump_of_the_stage_ends_no_track(jump):
    """All clusters displaced at once keep their tracks, forwards and backwards in time."""
    rng = np.random.default_rng(3)
    places = [track(rng, 20) + np.array([9.0 * k, 0, 0]) for k in range(4)]
    for x in places:
        x[10:] += jump * np.array([0.6, 0.8, 0.0])
    for order in (1, -1):
        found = perrin.identify(raw([x[::order] for x in places], rng), contact=DIAMETER, size=4)
        assert wrong(found) == 0
        assert (found["cluster"] >= 0).all()
        assert found.groupby("body")["cluster"].nunique().eq(1).all()


def test_one_cluster_that_jumps_is_no_stage():
    """The others keep their tracks, and it gets a new one."""
    rng = np.random.default_rng(3)
    places = [track(rng, 20) + np.array([12.0 * k, 0, 0]) for k in range(4)]
    places[0][10:] -= [0.0, 5.0, 0.0]
    found = perrin.identify(raw(places, rng), contact=DIAMETER, size=4)
    assert found.groupby("body")["cluster"].nunique().tolist() == [2, 1, 1, 1]


def test_centres_that_may_have_changed_places_begin_new_tracks():
    """Two that step by a quarter of a turn about each other may be either; two that stay are known.

    Twenty others, far away, give the size of a step, 0.1 in each coordinate.
    """
    rng = np.random.default_rng(4)
    others = 100.0 + 20 * np.arange(40).reshape(20, 2)
    turning, staying = np.array([[0, 0.1], [0, -0.1]]), np.array([[50, 0.25], [50, -0.25]])
    before = np.concatenate([turning, staying, others])
    after = np.concatenate([turning[:, ::-1], staying, others + 0.1 * rng.normal(size=(20, 2))])
    frame = np.repeat([0, 1], 24)
    track = linked_tracks(Centers(frame, np.concatenate([before, after]), np.zeros(48)))
    assert track[:24].tolist() == list(range(24))
    assert track[24:26].tolist() == [24, 25]
    assert track[26:].tolist() == list(range(2, 24))
