"""Which detection is which particle: planted exchanges are found, right labels are kept."""

from __future__ import annotations

import json

import numpy as np
import pytest

import perrin
from perrin.geometry.rotations import exp_map
from perrin.tracks.identity import Identity, all_assignments, settle_identity

BODIES = {n: perrin.Cluster.touching(n, 2.45) for n in (3, 4, 5, 6, 7)}
SLOW = 4.9e-3 * 0.73  # D_R dt of the paper's experiment

# In all other tests a warning is an error: labels that are right give none.
corrects_labels = pytest.mark.filterwarnings("ignore::perrin.IdentityWarning")


def track(seed, body=4, *, D_R=SLOW, n_frames=120, sigma=(0.03, 0.03, 0.04)):
    """Return noisy positions (T, n, 3) with right labels, dt = 1, and the generator."""
    rng = np.random.default_rng(seed)
    truth = perrin.simulate_motion(
        BODIES[body], D_R=D_R, D_T=0.03, dt=1.0, n_frames=n_frames, rng=rng
    )
    return perrin.add_noise(truth.positions(), sigma=sigma, rng=rng), rng


def shuffled(x, rng):
    """Order the columns of every row at random; return them and which particle each one is."""
    particle = np.argsort(rng.random(x.shape[:2]), axis=1)
    return np.take_along_axis(x, particle[..., None], axis=1), particle


def wrong_steps(found, particle):
    """Count the steps inside a piece at which a place in the order passes to another particle."""
    placed = np.take_along_axis(particle, np.maximum(found.order, 0), axis=1)
    both = (found.order[1:] >= 0) & (found.order[:-1] >= 0)
    moved = ((placed[1:] != placed[:-1]) & both).any(axis=1)
    return int((moved & (found.piece[1:] == found.piece[:-1])).sum())


@pytest.mark.parametrize("body", [3, 4, 5, 6])
def test_labels_shuffled_in_every_frame_are_sorted_out(body, repeats):
    """At the paper's sampling and 4 times slower no assignment is wrong; all frames are settled."""
    for factor in (1, 4):
        x, rng = track(body, body, D_R=factor * SLOW, n_frames=repeats(30, 120))
        mixed, particle = shuffled(x, rng)
        found = settle_identity(mixed, labelled=False)
        assert wrong_steps(found, particle) == 0
        assert not found.unsettled.size
        assert np.isfinite(found.arranged(mixed)).all()


@pytest.mark.parametrize("seed", range(4))
def test_incomplete_rows_before_the_first_complete_one_are_no_mirror_image(seed):
    """Three of four particles fit both hands; the body that enters the field decides it later."""
    x, rng = track(seed, n_frames=30, sigma=(0.005,) * 3)
    mixed, particle = shuffled(x, rng)
    mixed[:5, 0] = np.nan
    found = settle_identity(mixed, labelled=False)
    assert wrong_steps(found, particle) == 0
    assert not found.cuts.size
    motion = perrin.track_rotation(found.arranged(mixed), dt=1.0)
    right = perrin.track_rotation(x, dt=1.0)
    np.testing.assert_allclose(
        motion.center - motion.center[-1], right.center - right.center[-1], atol=0.03
    )


def test_seven_particles_are_assigned_without_trying_all_orders():
    """Beyond six, linear assignment and rigid fit in turn do the same."""
    x, rng = track(1, 7, n_frames=5)
    mixed, particle = shuffled(x, rng)
    found = settle_identity(mixed, labelled=False)
    assert wrong_steps(found, particle) == 0
    assert not found.unsettled.size


def test_where_the_second_best_is_nearly_as_likely_the_track_is_cut(repeats):
    """At 16 times the paper's interval there are cuts, and every wrong step is behind one."""
    wrong = cuts = 0
    for seed in range(repeats(3, 6)):
        x, rng = track(seed, D_R=16 * SLOW)
        mixed, particle = shuffled(x, rng)
        found = settle_identity(mixed, labelled=False)
        wrong, cuts = wrong + wrong_steps(found, particle), cuts + found.cuts.size
    assert cuts >= 5
    # At odds of 100 to 1 a step, 357 (with --long 714) steps leave fewer than one error on average.
    assert wrong <= 3


@corrects_labels
@pytest.mark.parametrize("kind", [2, 3], ids=["pair", "three-cycle"])
@pytest.mark.parametrize("body", [3, 4, 5])
def test_labels_exchanged_for_good_are_corrected(body, kind):
    """A swapped pair changes the residual, a cycle the angle of the step: all are reported."""
    x, rng = track(10 + body, body)
    rows, mixed = [17, 18, 60, 99], x.copy()
    for k in rows:
        some = rng.permutation(body)[:kind]
        mixed[k:, some] = mixed[k:, np.roll(some, 1)]
    found = settle_identity(mixed)
    assert found.swaps.tolist() == rows
    assert not found.cuts.size
    arranged = found.arranged(mixed)
    first = [int(np.flatnonzero((arranged[0] == p).all(axis=1))[0]) for p in x[0]]
    np.testing.assert_array_equal(arranged[:, first], x)


@corrects_labels
def test_one_exchange_is_found_wherever_it_is(repeats):
    """Neither of two labellings needs to be rare."""
    for row in (3, 60, 117, 12, 30, 90)[: repeats(3, 6)]:
        x, _ = track(30)
        x[row:, [0, 2]] = x[row:, [2, 0]]
        assert settle_identity(x).swaps.tolist() == [row]


@corrects_labels
def test_one_exchange_of_seven_particles_is_found(repeats):
    """Near the beginning, in the middle and near the end."""
    for row in repeats((5,), (10, 3, 17)):
        x, _ = track(30, 7, n_frames=repeats(11, 20))
        x[row:, [0, 2]] = x[row:, [2, 0]]
        assert settle_identity(x).swaps.tolist() == [row]


def test_corrected_labels_are_a_warning_with_their_number_and_frames():
    """Two labels of a pair, three of a cycle; the warning is raised at the caller's line."""
    x, _ = track(30)
    x[12:, [0, 2]] = x[12:, [2, 0]]
    x[60:, [0, 1, 2]] = x[60:, [1, 2, 0]]
    with pytest.warns(perrin.IdentityWarning) as caught:
        settle_identity(x)
    (warning,) = caught
    assert str(warning.message) == (
        "identity: 5 labels pass to another particle, in frames 12, 60 counted from 0; they are "
        "corrected"
    )
    assert warning.filename == __file__


@corrects_labels
def test_an_identity_comes_back_from_json():
    """Every attribute, also of a track with pieces, extra and unsettled detections."""
    x, rng = track(4, n_frames=60)
    x[30, 2] += [2.0, 2.0, -2.0]
    x[40:, [0, 1]] = x[40:, [1, 0]]
    x[20] += 0.3 * rng.normal(size=(4, 3))
    found = settle_identity(x)
    back = Identity.from_dict(json.loads(json.dumps(found.to_dict())))
    assert found.swaps.size
    assert found.extra.size
    for name, value in vars(found).items():
        np.testing.assert_array_equal(getattr(back, name), value)
        assert getattr(back, name).dtype.kind == "i"


@corrects_labels
def test_large_bodies_with_missing_particles(repeats):
    """Many particles, 2 % missing, one exchange: found, and every frame settled."""
    rng = np.random.default_rng(1)
    n = repeats(7, 30)
    body = perrin.Cluster.from_positions(rng.normal(scale=3.0, size=(n, 3)))
    truth = perrin.simulate_motion(body, D_R=1e-3, dt=1.0, n_frames=2 * n, rng=rng)
    x = perrin.add_noise(truth.positions(), sigma=0.03, rng=rng)
    x[n:, [0, 3]] = x[n:, [3, 0]]
    lost = rng.random(x.shape[:2]) < 0.02
    lost[:, [0, 3]] = False
    x[lost] = np.nan
    found = settle_identity(x)
    assert not found.unsettled.size
    np.testing.assert_array_equal(
        (found.order >= 0).sum(axis=1), np.isfinite(x[..., 0]).sum(axis=1)
    )
    assert found.swaps.tolist() == [n]


@pytest.mark.parametrize("body", [3, 4, 6])
@pytest.mark.parametrize("D_R", [SLOW, 0.1, 1.0])
def test_right_labels_are_kept_however_far_the_body_turns(body, D_R, repeats):
    """Lasting labels outweigh a shorter rotation: no label is changed after a long step."""
    x, rng = track(20, body, D_R=D_R, n_frames=repeats(60, 120))
    x[rng.random(x.shape[:2]) < 0.02] = np.nan
    found = settle_identity(x)
    placed = found.order >= 0
    np.testing.assert_array_equal(np.where(placed, np.arange(body), -1), found.order)
    assert not found.swaps.size


def test_missing_particles_do_not_matter():
    """Labels shuffled and 3 % lost: three of four particles are enough, two are not."""
    x, rng = track(3, n_frames=200)
    mixed, particle = shuffled(x, rng)
    mixed[rng.random(mixed.shape[:2]) < 0.03] = np.nan
    found = settle_identity(mixed, labelled=False)
    seen = np.isfinite(mixed[..., 0]).sum(axis=1)
    np.testing.assert_array_equal((found.order >= 0).sum(axis=1)[seen > 2], seen[seen > 2])
    assert wrong_steps(found, particle) == 0


def test_a_stray_detection_is_left_out():
    """A detection far from a particle's place, or besides all particles, is no particle."""
    x, _ = track(4)
    x[30, 2] += [2.0, 2.0, -2.0]
    found = settle_identity(x)
    assert found.extra.tolist() == [30]
    assert found.order[30].tolist() == [0, 1, -1, 3]
    more = np.concatenate([x, np.full((len(x), 1, 3), np.nan)], axis=1)
    more[50, 4] = x[50, 0] + [1.5, 0.0, 0.0]
    found = settle_identity(more)
    assert found.extra.tolist() == [30, 50]
    assert found.order[50].tolist() == [0, 1, 2, 3]


def test_a_particle_measured_badly_stays():
    """A particle eight standard deviations off is still nearest to its own place."""
    x, _ = track(5)
    x[40, 1] += [0.3, 0.0, 0.0]
    found = settle_identity(x)
    assert found.order[40].tolist() == [0, 1, 2, 3]
    assert found.swaps.size + found.extra.size + found.cuts.size == 0


def test_ids_that_end_and_begin_are_one_particle():
    """A lost particle gets a new id: two columns, never in the same row, are one particle."""
    x, _ = track(6)
    broken = np.concatenate([x, np.full((len(x), 1, 3), np.nan)], axis=1)
    broken[70:, 4], broken[66:, 1] = x[70:, 1], np.nan
    found = settle_identity(broken)
    assert found.order.shape == (120, 4)
    assert found.order[60].tolist() == [0, 1, 2, 3]
    assert found.order[80].tolist() == [0, 4, 2, 3]
    assert not found.swaps.size


def test_mirror_images_are_no_fit():
    """A mirrored body is another one: its frames keep their labels and are reported as unsettled.

    (Of a tetrahedron some exchange of labels undoes the mirror; an irregular body has none.)
    """
    rng = np.random.default_rng(8)
    body = perrin.Cluster.from_positions(rng.normal(size=(6, 3)))
    truth = perrin.simulate_motion(body, D_R=SLOW, dt=1.0, n_frames=30, rng=rng)
    x = perrin.add_noise(truth.positions(), sigma=0.01, rng=rng)
    x[20:23, :, 2] *= -1
    found = settle_identity(x)
    assert found.unsettled.tolist() == [20, 21, 22]
    np.testing.assert_array_equal(found.order, np.tile(np.arange(6), (30, 1)))


@pytest.mark.parametrize("n", [2, 3, 5])
def test_bodies_in_the_plane(n):
    """In two dimensions the same holds, from two particles on."""
    rng = np.random.default_rng(n)
    angle = 2 * np.pi * np.arange(n) / n
    body = perrin.Cluster.from_positions(1.4 * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    truth = perrin.simulate_motion(body, D_R=SLOW, D_T=0.03, dt=1.0, n_frames=80, rng=rng)
    x = perrin.add_noise(truth.positions(), sigma=0.03, rng=rng)
    mixed, particle = shuffled(x, rng)
    found = settle_identity(mixed, labelled=False)
    assert wrong_steps(found, particle) == 0
    assert not found.unsettled.size


def test_turning_moving_and_scaling_space_changes_nothing():
    """The order is the same in other axes, at another place, and in another unit."""
    x, rng = track(8, n_frames=40)
    mixed, _ = shuffled(x, rng)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    base = settle_identity(mixed, labelled=False)
    for other in (mixed @ turn.T, mixed + 1e3, mixed * 1e-3):
        again = settle_identity(other, labelled=False)
        np.testing.assert_array_equal(again.order, base.order)


def test_a_long_gap_is_a_longer_step():
    """After a gap of 300 frames the body may have turned to any orientation: the track is cut."""
    x, rng = track(9, D_R=4 * SLOW, n_frames=400)
    mixed, _ = shuffled(np.delete(x, np.arange(50, 350), axis=0), rng)
    times = np.delete(np.arange(400.0), np.arange(50, 350))
    assert settle_identity(mixed, times=times, labelled=False).cuts.tolist() == [50]
    assert settle_identity(mixed[:50], labelled=False).cuts.size == 0


def test_without_a_complete_frame_labels_stay_and_detections_stay_unknown():
    """There is no shape: labels are kept, detections without labels are not assigned."""
    x, _ = track(2, n_frames=40)
    for k in range(40):
        x[k, k % 4] = np.nan
    np.testing.assert_array_equal(
        settle_identity(x).order, np.where(np.isnan(x[..., 0]), -1, np.arange(4))
    )
    found = settle_identity(x, labelled=False)
    assert (found.order == -1).all()
    assert found.unsettled.size == 40


def test_the_table_of_assignments_is_complete():
    """Two of 3 detections are assigned to 3 particles: 3 pairs of particles times 6 orders."""
    table = all_assignments(3, 3, 2)
    assert len({tuple(row) for row in table.tolist()}) == 18
    assert ((table >= 0).sum(axis=1) == 2).all()


@pytest.mark.parametrize(
    ("degrees", "doubted"), [(30, False), (45, False), (60, True), (75, False)]
)
def test_a_leap_of_a_quiet_body_is_judged_by_its_own_size(degrees, doubted):
    """After small steps, 60 degrees one way or 60 degrees the other are equally likely.

    Without labels 75 degrees are taken for the 45 that are left of 120. Lasting labels decide.
    """
    body = BODIES[4].positions
    turn = exp_map(np.deg2rad(degrees) * body[0] / np.linalg.norm(body[0]))
    rng = np.random.default_rng(degrees)
    x = np.concatenate([np.stack([body] * 20), np.stack([body @ turn.T] * 20)])
    x = x + 0.01 * rng.normal(size=x.shape)
    found = settle_identity(shuffled(x, rng)[0], labelled=False)
    assert found.cuts.tolist() == ([20] if doubted else [])
    assert nothing_reported(settle_identity(x))


def worse(x, rng, share, factor, *, sigma=0.03):
    """Add noise to a share of the frames, so that these are a factor noisier."""
    rows = np.flatnonzero(rng.random(len(x)) < share)
    out = x.copy()
    out[rows] += rng.normal(size=x[rows].shape) * sigma * np.sqrt(factor**2 - 1)
    return out, rows


def nothing_reported(found):
    """Return whether labels are as given, with no exchange, no cut and nothing left out."""
    given = np.where(found.order >= 0, np.arange(found.order.shape[1]), -1)
    events = found.swaps.size + found.cuts.size + found.extra.size
    return bool((found.order == given).all()) and events == 0


@pytest.mark.parametrize("factor", [3, 4, 6])
@pytest.mark.parametrize("sides", [(2.40, 2.50, 2.45), (2.45, 2.45, 2.45)])
def test_bad_frames_are_no_evidence_for_another_labelling(sides, factor, repeats):
    """A trimer of equal or 2 % unequal sides and 3 % of the frames worse: all labels stay."""
    a, b, c = sides
    across = (a * a + b * b - c * c) / (2 * a)
    body = np.array([[0, 0, 0], [a, 0, 0], [across, np.sqrt(b * b - across**2), 0]])
    for seed in range(repeats(2, 5)):
        rng = np.random.default_rng(seed)
        truth = perrin.simulate_motion(
            perrin.Cluster.from_positions(body),
            D_R=SLOW,
            n_frames=repeats(300, 600),
            dt=1.0,
            rng=rng,
        )
        x, rows = worse(perrin.add_noise(truth.positions(), sigma=0.02, rng=rng), rng, 0.03, factor)
        found = settle_identity(x)
        assert nothing_reported(found)
        assert np.isin(found.unsettled, rows).all()


def test_bad_frames_of_a_tetrahedron_keep_their_labels(repeats):
    """Equal sides, 3 % of the frames at six times the noise, some in a row, some incomplete."""
    for seed in range(repeats(2, 5)):
        x, rng = track(seed, n_frames=300, sigma=(0.03, 0.03, 0.06))
        x, _ = worse(x, rng, 0.03, 6)
        x[100:104] += 0.15 * rng.normal(size=x[100:104].shape)
        x[rng.random(x.shape[:2]) < 0.05] = np.nan
        assert nothing_reported(settle_identity(x))


@pytest.mark.parametrize("body", [3, 4, 5])
def test_steps_as_long_as_the_angles_of_symmetry_are_no_evidence(body, repeats):
    """At 26 degrees a step and component chance brings other labellings nearer; labels stay.

    With 5 % missing, the labels of the frame that last held a particle count. At most 0.5 % of the
    tracks may report anything: of 9 (with --long 30) none.
    """
    for seed in range(repeats(3, 10)):
        x, rng = track(seed, body, D_R=0.1)
        x[rng.random(x.shape[:2]) < 0.05] = np.nan
        assert nothing_reported(settle_identity(x))


@corrects_labels
@pytest.mark.parametrize("body", [3, 4, 5, 6])
def test_lasting_exchanges_are_found_among_bad_frames(body, repeats):
    """Any permutation from some frame on, within symmetry or not, is found where it happens."""
    for seed in range(repeats(1, 3)):
        x, rng = track(seed, body)
        x, bad = worse(x, rng, 0.03, 5)
        usual = np.setdiff1d(np.arange(5, len(x) - 5), np.concatenate([bad, bad + 1]))
        row, order = int(rng.choice(usual)), np.arange(body)
        while (order == np.arange(body)).all():
            order = rng.permutation(body)
        x[row:] = x[row:, order]
        found = settle_identity(x)
        assert found.swaps.tolist() == [row]
        assert found.cuts.size + found.extra.size == 0


@corrects_labels
@pytest.mark.parametrize("length", [1, 4])
def test_short_exchanges_are_found(length):
    """One frame or a few: a pair changes the misfit, a cycle the angle, there and back."""
    for kind in (2, 3):
        x, rng = track(kind)
        some = rng.permutation(4)[:kind]
        rows = slice(50, 50 + length)
        x[rows, some] = x[rows, np.roll(some, 1)]
        found = settle_identity(x)
        assert found.swaps.tolist() == [50, 50 + length]
        assert not found.cuts.size


def test_a_particle_under_a_second_label_keeps_it_in_bad_frames():
    """Column 4 continues column 1: its labels count as much as those of the first columns."""
    x, rng = track(7)
    broken = np.concatenate([x, np.full((len(x), 1, 3), np.nan)], axis=1)
    broken[60:, 4], broken[60:, 1] = x[60:, 1], np.nan
    broken[80:83] += 0.15 * rng.normal(size=broken[80:83].shape)
    found = settle_identity(broken)
    np.testing.assert_array_equal(found.order[60:], np.tile([0, 4, 2, 3], (len(x) - 60, 1)))
    assert found.swaps.size + found.cuts.size + found.extra.size == 0


@corrects_labels
def test_labels_of_a_minority_of_the_frames_do_not_widen_the_law_of_the_steps(repeats):
    """A pair and a cycle exchanged for good: the labels of the shape fit in few frames only."""
    for seed in range(repeats(2, 5)):
        x, rng = track(seed, n_frames=150)
        some, mixed = rng.permutation(4), x.copy()
        mixed[40:, some[:2]] = mixed[40:, some[1::-1]]
        mixed[77:, some[1:]] = mixed[77:, np.roll(some[1:], 1)]
        found = settle_identity(mixed)
        assert found.swaps.tolist() == [40, 77]
        assert not found.cuts.size
