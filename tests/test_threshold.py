"""The threshold rule: rotation from a reference that is renewed where a threshold is exceeded."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from perrin import (
    Cluster,
    add_noise,
    fit_line,
    msad_vector,
    simulate_motion,
    threshold_displacement,
    track_rotation,
)
from perrin.geometry.rotations import exp_map
from perrin.motion.rigid_motion import threshold_references

TETRA = Cluster.tetrahedron(1.5)
FLAT = Cluster.from_positions([[0.0, 0.0], [2.0, 0.1], [0.5, 1.2], [-0.7, 0.9]])


def gappy(seed, n_frames=300):
    """Return a noisy motion with missing frames, cut into two pieces."""
    rng = np.random.default_rng(seed)
    truth = simulate_motion(TETRA, D_R=2e-2, dt=1.0, n_frames=n_frames, rng=rng)
    x = add_noise(truth.positions(), sigma=0.05, rng=rng)
    x[1 + np.flatnonzero(rng.random(n_frames - 2) < 0.15)] = np.nan
    motion = track_rotation(x, dt=1.0)
    return replace(motion, piece=np.repeat([0, 1], [180, n_frames - 180]))


def turned(rotations):
    """Return the motion of a tetrahedron whose orientations are given."""
    return track_rotation(np.einsum("tij,nj->tni", rotations, TETRA.positions), dt=1.0)


@pytest.mark.parametrize("threshold", [0.1, 0.7, 2.0])
def test_the_displacement_is_the_rule_frame_by_frame(threshold):
    """Gaps and pieces: equal to a loop over scipy rotations that restarts its reference."""
    motion = gappy(1)
    walk = threshold_displacement(motion, threshold=threshold)
    assert np.array_equal(np.isnan(walk[:, 0]), np.isnan(motion.center[:, 0]))
    piece = None
    for row in motion.fitted:
        here = Rotation.from_matrix(motion.rotation[row].copy())
        if motion.piece[row] != piece:
            piece, reference, base = motion.piece[row], here, np.zeros(3)
        turn = (here * reference.inv()).as_rotvec()
        np.testing.assert_allclose(walk[row], base + turn, atol=1e-9)
        if np.linalg.norm(turn) > threshold:
            reference, base = here, base + turn


def test_the_limits_are_the_sum_of_all_steps_and_the_rotation_vector():
    """Threshold 0, or one below every step, is accumulated_rotation; pi is log(R_k R_0^T)."""
    motion = gappy(2)
    every = motion.accumulated_rotation()
    for threshold in (0.0, 1e-4):
        walk = threshold_displacement(motion, threshold=threshold)
        np.testing.assert_allclose(walk, every, atol=1e-9)
    rows = motion.fitted[motion.piece[motion.fitted] == 0]
    whole = Rotation.from_matrix(motion.rotation[rows]).as_rotvec()
    np.testing.assert_allclose(
        threshold_displacement(motion, threshold=np.pi)[rows], whole, atol=1e-9
    )


def test_the_displacement_turns_with_the_lab_and_has_no_unit():
    """A turned lab turns the displacement; unit, origin and particle order do not change it."""
    rng = np.random.default_rng(3)
    truth = simulate_motion(TETRA, D_R=2e-2, dt=1.0, n_frames=200, rng=rng)
    x = add_noise(truth.positions(), sigma=0.03, rng=rng)
    q = Rotation.from_rotvec(np.random.default_rng(4).normal(size=3)).as_matrix()
    walk = threshold_displacement(track_rotation(x, dt=1.0), threshold=0.8)
    moved = threshold_displacement(track_rotation(1e3 * x @ q.T + 5.0, dt=2.0), threshold=0.8)
    shuffled = threshold_displacement(track_rotation(x[:, [2, 0, 3, 1]], dt=1.0), threshold=0.8)
    np.testing.assert_allclose(moved, walk @ q.T, atol=1e-7)
    np.testing.assert_allclose(shuffled, walk, atol=1e-7)


def test_in_the_plane_rotations_add_up_whatever_the_threshold():
    """Turns about one axis commute: every threshold below pi gives the same angle."""
    angle = np.cumsum(0.3 * np.random.default_rng(5).normal(size=300))
    x = np.einsum("tij,nj->tni", exp_map(angle[:, None]), FLAT.positions)
    motion = track_rotation(x, dt=1.0)
    for threshold in (0.0, 0.5, 1.5):
        walk = threshold_displacement(motion, threshold=threshold)
        np.testing.assert_allclose(walk[:, 0], angle - angle[0], atol=1e-9)


def test_noise_on_a_body_at_rest_does_not_add_up(repeats):
    """sigma/R = 0.15: the sum of steps has D = 0.04 (sigma/R)^4 a frame, the threshold rule 0.

    The slope between lags of 200 and 2000 frames, within 3 of its stated errors, 20000 (quick:
    12000) frames.
    """
    still = np.tile(TETRA.positions, (repeats(12_000, 20_000), 1, 1))
    motion = track_rotation(add_noise(still, sigma=0.15 * TETRA.R, rng=6), dt=1.0)
    every, held = (
        fit_line(msad_vector(motion, threshold=t), lag_range=(200, 2000)) for t in (0.0, 1.0)
    )
    assert abs(every.value - 0.04 * 0.15**4) < 3 * every.stderr
    assert every.ci95[0] > 0
    # Noise alone has such a D: it is an upper limit, and printed as one.
    assert not every.resolved
    assert every.resolution_floor == pytest.approx(0.04 * 0.15**4, rel=0.1)
    assert abs(held.value) < 0.01 * every.value


def test_free_diffusion_is_measured_too():
    """Both rules measure D at lags beyond threshold^2/(6 D) = 83 frames, within 3 errors.

    The rule itself lowers D by threshold^2/60 = 1.7 %, a sixth of the error.
    """
    truth = simulate_motion(TETRA, D_R=2e-3, dt=1.0, n_frames=50_000, rng=7)
    for threshold in (0.0, 1.0):
        found = fit_line(msad_vector(truth, threshold=threshold), lag_range=(200, 800))
        assert abs(found.value - 2e-3) < 3 * found.stderr
        assert found.stderr < 0.12 * 2e-3


def test_the_long_time_diffusion_is_that_of_first_passages(repeats):
    """Threshold 2: D (1 - threshold^2/60) = 0.93 D, within 3 errors, which are below 2 %.

    Passages are independent and isotropic, so that D is their mean square over six mean durations.
    The quick form has as many passages in frames four times as long.
    """
    shorter = repeats(4, 1)
    D = 5e-3 * shorter
    truth = simulate_motion(TETRA, D_R=D, dt=1.0, n_frames=240_000 // shorter, rng=10)
    origins = np.unique(threshold_references(truth.rotation, truth.piece, threshold=2.0))
    passage = np.diff(threshold_displacement(truth, threshold=2.0)[origins], axis=0)
    square, duration = np.sum(passage**2, axis=1), np.diff(origins)
    ratio = square.sum() / (6 * D * duration.sum())
    scatter = square - ratio * 6 * D * duration
    error = scatter.std() / (6 * D * duration.mean() * np.sqrt(len(square)))
    assert error < 0.02
    assert abs(ratio - (1 - 4 / 60)) < 3 * error


def test_jumps_of_a_caged_rotor_are_counted_and_its_rattling_is_not(repeats):
    """Rattling by 0.2 rad per axis, 8 jumps by 2.2 rad: the end is the sum of the jumps to 4 rad.

    Each jump contains the rattling at both its ends (1.4 rad in all); the sum of all steps differs
    by 11 rad after 50000 frames (quick: over 4 rad after 25000).
    """
    frames = repeats(25_000, 50_000)
    rng = np.random.default_rng(8)
    jump = rng.normal(size=(8, 3))
    jump *= 2.2 / np.linalg.norm(jump, axis=1, keepdims=True)
    cage, cages = np.eye(3), [np.eye(3)]
    for turn in exp_map(jump):
        cage = turn @ cage
        cages.append(cage)
    place = np.arange(frames) * 9 // frames
    rattle = exp_map(0.2 * rng.normal(size=(frames, 3)))
    motion = turned(np.array(cages)[place] @ rattle)
    off = {
        t: np.linalg.norm(threshold_displacement(motion, threshold=t)[-1] - jump.sum(axis=0))
        for t in (0.0, 1.6)
    }
    assert off[1.6] < 4 < off[0.0]


@pytest.mark.parametrize("threshold", [-0.1, 3.2, np.nan])
def test_invalid_thresholds_are_refused(threshold):
    """Below 0, above pi, NaN: refused with the value."""
    motion = gappy(9, n_frames=200)
    with pytest.raises(ValueError, match=r"threshold: expected an angle from 0 to pi.*got"):
        threshold_displacement(motion, threshold=threshold)
    with pytest.raises(ValueError, match="threshold"):
        msad_vector(motion, threshold=threshold)
