"""Laws of the tests for jumps and for a steady velocity or spin."""

import json
from dataclasses import fields, replace

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

import perrin
from brownian_motions import all_tracked
from perrin.diffusion import estimate_each
from perrin.diffusion.step_tests import (
    StageJumps,
    cut_at,
    find_jumps,
    find_stage_jumps,
    steady_motion,
)
from perrin.motion.tracking import track_rotation

DT = 0.73
TETRA = 1.5 * np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(3)
FLAT = np.array([[0.0, 0.0], [2.0, 0.0], [1.0, 1.6]]) - [1.0, 1.6 / 3]


def brownian(seed, *, frames=300, D_R=5e-3, D_T=0.02, spin=(0, 0, 0), sigma=0.03, bad=0.0):
    """Return noisy places (T, 4, 3) of a tetrahedron; a share `bad` of the frames is 6 times worse.

    An independent simulator: steps in body axes, four a frame, seen from axes that turn with the
    spin.
    """
    rng = np.random.default_rng([seed, 11])
    steps = rng.normal(size=(4 * (frames - 1), 3)) * np.sqrt(2 * D_R * DT / 4)
    turn = [np.eye(3)]
    for step in Rotation.from_rotvec(steps).as_matrix():
        turn.append(turn[-1] @ step)
    spun = Rotation.from_rotvec(DT * np.arange(frames)[:, None] * np.array(spin)).as_matrix()
    places = np.einsum("tij,tjk,nk->tni", spun, np.array(turn[::4]), TETRA)
    path = np.cumsum(rng.normal(size=(frames, 1, 3)) * np.sqrt(2 * D_T * DT), axis=0)
    noise = rng.normal(size=(frames, 4, 3)) * sigma
    noise[rng.random(frames) < bad] *= 6
    return places + path + noise


def jumps_of(x, quantity, **given):
    motion = track_rotation(x, dt=DT)
    estimate = perrin.estimate_diffusion(motion, quantity=quantity, **given)
    return find_jumps(motion, estimate), motion, estimate


def turned(x, rotvec):
    """Return places (T, n, 3) turned about their own centres."""
    center = x.mean(axis=1, keepdims=True)
    return Rotation.from_rotvec(rotvec).apply((x - center).reshape(-1, 3)).reshape(x.shape) + center


def test_a_stage_jump_is_found_and_cut(repeats):
    """One jump, however long, is found at its frame with its size; D_T without it is the true one.

    D_T differs from that of the track without the jump by the one step that is left out, at most a
    hundredth of it (1/299, and what drift=True takes off).
    """
    cases = [(3.0, True), (50.0, False), (3.0, False), (50.0, True)]
    for size, drift in cases[: repeats(2, 4)]:
        given = {"quantity": "translation", "drift": drift}
        x = brownian(1)
        x[150:] += [size, 0, 0]
        found, motion, estimate = jumps_of(x, **given)
        assert found.rows.tolist() == [150], (size, drift)
        assert not found.many
        assert found.length[0] == pytest.approx(size, abs=4 * np.sqrt(2 * 0.02 * DT))
        clean = perrin.estimate_diffusion(track_rotation(brownian(1), dt=DT), **given)
        cut = perrin.estimate_diffusion(cut_at(motion, found.rows), **given)
        assert cut.value == pytest.approx(clean.value, rel=0.01), (size, drift)
        assert estimate.value > 1.2 * clean.value
        assert not jumps_of(x, "rotation", drift=drift)[0].rows.size, (size, drift)


def test_one_large_turn_is_found():
    """A turn of 57 degrees among steps of 5 is a jump of the orientation, not of the centre."""
    x = brownian(2)
    x[120:] = turned(x[120:], [1.0, 0, 0])
    found, motion, _ = jumps_of(x, "rotation")
    assert found.rows.tolist() == [120]
    assert np.rad2deg(found.length[0]) == pytest.approx(57.3, abs=15)
    assert not jumps_of(x, "translation")[0].rows.size
    cut = perrin.estimate_diffusion(cut_at(motion, found.rows))
    clean = perrin.estimate_diffusion(track_rotation(brownian(2), dt=DT))
    assert cut.value == pytest.approx(clean.value, rel=0.015)


def test_several_jumps_do_not_hide_each_other():
    """Three jumps, 1 % of the steps, are all found; a tenth of the steps are no jumps any more."""
    x = brownian(3)
    for frame, axis in ((60, 0), (61, 1), (250, 0)):
        x[frame:, :, axis] += 5.0
    found, _, _ = jumps_of(x, "translation")
    assert found.rows.tolist() == [60, 61, 250]
    assert not found.many
    rng = np.random.default_rng(4)
    hops = (rng.random(300) < 0.1)[:, None] * rng.normal(size=(300, 3)) * 3
    found, _, _ = jumps_of(brownian(3) + np.cumsum(hops, axis=0)[:, None], "translation")
    assert found.many


def test_coordinates_wrapped_in_a_box_are_found():
    """Wraps back and forth resemble localisation noise in a fit; they are found by their length."""
    x = brownian(4, D_T=0.04)
    center = x.mean(axis=1, keepdims=True)
    wraps = np.floor(center / 3.0)
    found, _, _ = jumps_of(x - 3.0 * wraps, "translation")
    crossings = np.flatnonzero((np.diff(wraps[:, 0], axis=0) != 0).any(axis=1)) + 1
    inside = crossings[(crossings > 1) & (crossings < 299)]
    assert len(np.intersect1d(found.rows, inside)) >= 0.95 * len(inside)
    assert found.many


@pytest.mark.parametrize("quantity", ["rotation", "translation"])
def test_brownian_motion_and_badly_measured_frames_have_no_jumps(quantity, repeats):
    """No jump in 8 or 40 tracks, of which half have 3 % of frames with six times the noise.

    At the level of 1e-6 a track none is expected in any; slow bodies show the bad frames most.
    """
    for seed in range(repeats(8, 40)):
        slow = {"D_R": 1e-5, "D_T": 1e-4} if seed % 3 == 0 else {}
        x = brownian(seed, frames=(60, 150)[seed % 2], bad=0.03 * (seed % 4 > 1), **slow)
        assert not jumps_of(x, quantity)[0].rows.size, seed


def test_jumps_follow_rotation_and_time_reversal():
    """Turning the lab or reversing time gives the same jumps."""
    x = brownian(5, frames=120)
    x[70:] += [2.0, 1.0, 0]
    turn = Rotation.from_rotvec([0.3, -1.2, 0.7]).as_matrix()
    assert jumps_of(x @ turn.T, "translation")[0].rows.tolist() == [70]
    back = jumps_of(x[::-1], "translation")[0]
    assert back.rows.tolist() == [120 - 70]


def test_a_steady_velocity_is_reported_with_its_error():
    """A flow of a tenth of a step a frame is found within its error; without one p is uniform.

    The velocity's error is sqrt(2 D/T) per axis; 4 of them bound one draw of three to 2e-4.
    """
    motion = track_rotation(brownian(6), dt=DT)
    flow = np.array([0.9, -0.3, 0.2])
    moved = replace(motion, center=motion.center + motion.time[:, None] * flow)
    still, found = (
        steady_motion(m, perrin.estimate_diffusion(m, quantity="translation"))
        for m in (motion, moved)
    )
    assert found.p < 1e-12
    assert found.stderr == pytest.approx([np.sqrt(2 * 0.02 / (299 * DT))] * 3, rel=0.25)
    assert np.all(np.abs(np.array(found.value) - flow) < 4 * np.array(found.stderr))
    assert still.p > 1e-4
    # Both velocities contain the same Brownian part; the covariance of the estimate differs a bit.
    assert np.subtract(found.value, still.value) == pytest.approx(flow, abs=0.01)


def test_a_steady_spin_is_reported_and_subtracted():
    """0.2 rad/s about the lab's z: found, its size within 4 errors, and D_R right without it."""
    motion = track_rotation(brownian(7, spin=(0, 0, 0.2)), dt=DT)
    plain = perrin.estimate_diffusion(motion)
    found = steady_motion(motion, plain)
    assert found.p < 1e-30
    assert abs(found.value[2] - 0.2) < 4 * found.stderr[2]
    rest = perrin.estimate_diffusion(motion, drift=True)
    assert plain.value > 2 * 5e-3
    assert abs(rest.value - 5e-3) < 4 * rest.stderr
    assert rest.drift[0] == pytest.approx(found.value, abs=1e-9)


def test_a_spin_leaves_the_same_diffusion_behind(repeats):
    """D_R with the mean spin subtracted does not contain it: the mean is within 3 errors."""
    values = []
    for seed in range(repeats(6, 20)):
        motion = track_rotation(brownian(seed, frames=150, spin=(0.1, 0, 0.25)), dt=DT)
        values.append(perrin.estimate_diffusion(motion, drift=True).value / 5e-3)
    assert abs(np.mean(values) - 1) < 3 * np.std(values, ddof=1) / np.sqrt(len(values))


def test_a_spin_in_the_plane():
    """In the plane the spin is one number about z."""
    flat = perrin.Cluster.from_positions(FLAT)
    truth = perrin.simulate_motion(flat, D_R=5e-3, D_T=0.02, dt=DT, n_frames=300, rng=8)
    angle = 0.2 * truth.time
    turn = np.stack(
        [
            np.stack([np.cos(angle), -np.sin(angle)], -1),
            np.stack([np.sin(angle), np.cos(angle)], -1),
        ],
        -2,
    )
    moved = replace(truth, rotation=turn @ truth.rotation)
    found = steady_motion(moved, perrin.estimate_diffusion(moved))
    assert len(found.value) == 1
    assert abs(found.value[0] - 0.2) < 4 * found.stderr[0]
    estimate = perrin.estimate_diffusion(moved, drift=True)
    plain = perrin.estimate_diffusion(truth, drift=True)
    assert estimate.value == pytest.approx(plain.value, rel=1e-9)


@pytest.mark.parametrize("quantity", ["rotation", "translation"])
def test_the_test_for_a_steady_motion_keeps_its_level(quantity, repeats):
    """The p-value is uniform in Brownian tracks: few below 0.05, and a median of 0.5.

    Of 20 tracks 5 or more would have probability 0.3 %, of 80 tracks 12 or more 0.06 %; the median
    is within 3 standard errors.
    """
    count = repeats(20, 80)
    tracks = (brownian(s, frames=repeats(60, 100)) for s in range(count))
    motions = all_tracked(tracks, dt=DT)
    estimates = estimate_each(motions, quantity=quantity, noise=perrin.Noise())
    p = np.array([steady_motion(m, D).p for m, D in zip(motions, estimates, strict=True)])
    assert np.count_nonzero(p < 0.05) < repeats(5, 12)
    assert abs(np.median(p) - 0.5) < 1.5 / np.sqrt(count)


def test_a_velocity_changes_nothing_but_the_drift(repeats):
    """D_T, errors, intervals and p_same are the same to 1e-6 up to 10 um/s, gaps included."""
    rng = np.random.default_rng(9)
    frames = repeats(80, 150)
    places = [brownian(s, frames=frames) for s in (20, 21)]
    for x in places:
        x[rng.random(frames) < 0.3] = np.nan

    def answer(velocity):
        time = DT * np.arange(frames)[:, None, None]
        motions = [track_rotation(x + time * velocity, dt=DT) for x in places]
        return perrin.estimate_diffusion(motions, quantity="translation", drift=True)

    still = answer(np.zeros(3))
    for speed in (0.3, 10.0, 1.0, 3.0)[: repeats(2, 4)]:
        found = answer(speed * np.array([0.6, -0.64, 0.48]))
        for name in ("value", "stderr", "ci68", "ci95", "offset", "p_same"):
            assert getattr(found, name) == pytest.approx(getattr(still, name), rel=1e-6), name


def test_jumps_and_steady_motions_come_back_from_json():
    """Every field survives to_dict, JSON and from_dict, with jumps and without."""
    x = brownian(1, frames=60)
    found = [jumps_of(x, "translation")[0]]
    x[30:] += [3.0, 0, 0]
    jumps, motion, estimate = jumps_of(x, "translation")
    found += [jumps, steady_motion(motion, estimate)]
    for result in found:
        back = type(result).from_dict(json.loads(json.dumps(result.to_dict())))
        for field in fields(result):
            value, expected = getattr(back, field.name), getattr(result, field.name)
            assert np.size(expected) == 0 or np.shape(value) == np.shape(expected)
            np.testing.assert_equal(np.ravel(value), np.ravel(expected))
    assert jumps.rows.tolist() == [30]


def together(jump, *, frames=24, bodies=4, seed=0):
    """Return the motions of bodies, of which all are displaced by `jump` from row 10 on."""
    motions = []
    for k in range(bodies):
        x = brownian(100 * seed + k, frames=frames, D_T=0.0385) + 9.0 * k
        x[10:] += jump
        motions.append(track_rotation(x, dt=DT))
    return motions, [np.arange(frames)] * bodies


def test_a_jump_of_the_stage_is_found_and_measured():
    """A common step of 5 standard deviations of one body; reversed time gives the opposite one."""
    jump = np.array([1.0, -0.7, 0.2])
    motions, frames = together(jump)
    found = find_stage_jumps(motions, frames)
    assert found.frames.tolist() == [10]
    assert found.bodies.tolist() == [4]
    assert np.all(np.abs(found.size[0] - jump) < 4 * found.stderr[0])
    # The mean of four steps of variance 2 D dt, known to the error of that D.
    assert found.stderr[0] == pytest.approx(np.sqrt(2 * 0.0385 * DT / 4), rel=0.3)
    back = [replace(m, center=m.center[::-1]) for m in motions]
    turned_back = find_stage_jumps(back, frames)
    assert turned_back.frames.tolist() == [14]
    assert turned_back.size == pytest.approx(-found.size)
    again = StageJumps.from_dict(json.loads(json.dumps(found.to_dict())))
    assert all(
        np.array_equal(getattr(again, f.name), getattr(found, f.name)) for f in fields(found)
    )


def test_diffusion_drift_and_one_body_are_no_jumps_of_the_stage(repeats):
    """No false alarm where nothing jumps, all drift, or one of the bodies jumps alone."""
    for seed in range(repeats(3, 30)):
        motions, frames = together(0.0, seed=seed + 1)
        assert not find_stage_jumps(motions, frames).frames.size
        flow = np.outer(np.arange(24), [0.1, 0.0, 0.0])
        drifting = [replace(m, center=m.center + flow) for m in motions]
        assert not find_stage_jumps(drifting, frames).frames.size
        alone = motions[0].center + np.where(np.arange(24) < 10, 0.0, 4.0)[:, None]
        one = [replace(motions[0], center=alone), *motions[1:]]
        assert not find_stage_jumps(one, frames).frames.size
    assert not find_stage_jumps(motions[:1], frames[:1]).frames.size


@pytest.mark.usefixtures("no_tensors")
def test_a_table_leaves_the_jump_of_the_stage_out_of_the_translation():
    """D_T is that without the step, D_R keeps all frames, and the report names the jump."""
    still, moved = (
        perrin.analyze(
            pd.concat(
                perrin.positions_table(x, frames=np.arange(5, 25)).assign(cluster=k)
                for k, x in enumerate(m.positions() for m in together(jump, frames=20, bodies=2)[0])
            ),
            dt=DT,
        )
        for jump in (0.0, 1.6)
    )
    assert [w for w in still.warnings if "stage" in w] == []
    (named,) = [w for w in moved.warnings if w.startswith("stage jump:")]
    assert "at frame 15" in named
    for one, other in zip(moved.clusters, still.clusters, strict=True):
        assert one.D_R.value == pytest.approx(other.D_R.value, rel=1e-9)
        assert one.jumps["translation"] == (10,)
    assert abs(moved.pooled.D_T.value / still.pooled.D_T.value - 1) < 0.2
