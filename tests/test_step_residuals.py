"""Residuals of steps, steady motions and verdicts, part by part: dense algebra and hand cases."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

import perrin
from brownian_motions import brownian_motion, tetrahedron, with_poses
from perrin.diffusion import BrownianSummary, NoisySteps, Score, combined_p, detectable_by, steps_of
from perrin.diffusion.step_tests import (
    Jumps,
    StageJumps,
    cut_at,
    find_jumps,
    find_jumps_of_each,
    find_stage_jumps,
    leave_one_out_residuals,
    offset_gain,
    offset_gain_of_each,
    persistence_gain,
    steady_motion,
    steady_motion_of_each,
    without_spin,
)
from perrin.geometry.rotations import exp_map

DT = 0.5
GAPS = np.delete(np.arange(14.0), [3, 8, 9]) * DT


def noisy_motion(seed=1, *, time=GAPS, sigma=0.1, n_frames=None):
    """Return a motion with gaps, and noise that differs between its frames."""
    motion = brownian_motion(seed, time, D_R=0.01, D_T=0.05, center_noise=0.002, dt=DT)
    rng = np.random.default_rng(seed)
    return replace(
        motion,
        sigma=sigma,
        noise=np.full(3, sigma),
        center_variance=sigma**2 / 4 * rng.uniform(1, 2, len(time)),
        residual=sigma * rng.uniform(0.5, 1.5, len(time)),
    )


def estimate_of(motion, **given):
    """Return an estimate of the translation, with numbers in place of its own."""
    own = {"value": 0.07, "offset": 0.004, "stderr": 0.02}
    found = perrin.estimate_diffusion(motion, quantity="translation")
    return replace(found, **(own | given))


def dense_covariance(motion, estimate):
    """Return the covariance of the steps along one axis of the centre, offset free."""
    start, stop = motion.steps()
    track = NoisySteps.of(steps_of(motion, "translation"), estimate.settings)
    excess = motion.center_variance - motion.center_variance[[*start, *stop]].min()
    level = excess.mean()
    offset = estimate.offset - level + track.blur * estimate.value
    noise = np.maximum(offset, 0) + excess - track.blur * estimate.value
    take = np.zeros((len(start), len(motion.time)))
    take[np.arange(len(start)), start], take[np.arange(len(start)), stop] = -1, 1
    duration = motion.time[stop] - motion.time[start]
    return (take * noise) @ take.T + 2 * estimate.value * np.diag(duration)


def test_residuals_are_those_of_dense_conditional_laws():
    """A step given all others, without those left out; the frame between two steps."""
    motion = replace(noisy_motion(), piece=np.repeat([0, 1], [6, 5]))
    estimate = estimate_of(motion)
    y = np.diff(motion.center, axis=0)[np.arange(10) != 5]
    C = dense_covariance(motion, estimate)
    for left_out in ([], [1], [2, 7]):
        without = np.isin(np.arange(9), left_out)
        found = leave_one_out_residuals([motion], [estimate], without=without[None])
        for k in range(9):
            others = np.setdiff1d(np.arange(9), [k, *left_out])
            weights = np.linalg.solve(C[np.ix_(others, others)], C[others, k])
            variance = C[k, k] - weights @ C[others, k]
            expected = (y[k] - weights @ y[others]) / np.sqrt(variance)
            np.testing.assert_allclose(found.step[0, k], expected, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(found.length[0], y / np.sqrt(np.diag(C))[:, None], rtol=1e-9)
        assert found.linked[0].tolist() == [True] * 4 + [False] + [True] * 3
    # A displacement of the frame between steps k and k + 1 changes them by e and -e: its
    # generalised least-squares estimate over its error.
    found = leave_one_out_residuals([motion], [estimate], without=np.zeros((1, 9), bool))
    inverse = np.linalg.inv(C)
    for k in range(8):
        e = np.zeros(9)
        e[[k, k + 1]] = 1, -1
        frame = e @ inverse @ y / np.sqrt(e @ inverse @ e)
        np.testing.assert_allclose(found.frame[0, k], frame, rtol=1e-9, atol=1e-12)
    # Two motions at once are as each alone.
    both = leave_one_out_residuals([motion] * 2, [estimate] * 2, without=np.zeros((2, 9), bool))
    for one, two in zip(found, both, strict=True):
        np.testing.assert_allclose(two, np.concatenate([one, one]), rtol=1e-9)


def test_localisation_explains_a_displacement_by_the_residual_of_its_frame():
    """Half the difference of two steps squared, up to 100 times the noise, worse frames more."""
    motion = noisy_motion(time=DT * np.arange(11))
    center = motion.center.copy()
    variance = motion.center_variance[5]
    middle = (center[4] + center[6]) / 2
    for residual, factor in ((0.5, 1.0), (1.0, 1.0), (3.0, 9.0)):
        own = 0.1 * np.array([1, 0.5, 1, 2, 1, residual, 1, 0.7, 1, 4, 1])  # the median is 0.1
        for share, expected in ((0.99, True), (1.01, False)):
            # The same along three axes, of which each has this variance.
            size = np.sqrt(share * 100 * variance * factor)
            moved = center.copy()
            moved[5] = middle + size
            one = replace(motion, center=moved, residual=own)
            found = leave_one_out_residuals(
                [one], [estimate_of(motion)], without=np.zeros((1, 10), bool)
            )
            assert found.measured_badly[0, 4] == expected
    none = replace(motion, residual=np.zeros(11))
    found = leave_one_out_residuals([none], [estimate_of(motion)], without=np.zeros((1, 10), bool))
    np.testing.assert_array_equal(found.measured_badly, np.ones((1, 9), bool))


def test_a_covariance_that_is_not_positive_has_no_residuals():
    """An offset below the limit of motion blur: residuals of 0, of that motion alone."""
    motion = noisy_motion(time=DT * np.arange(11))
    motion = replace(motion, center_variance=np.full(11, 0.002))
    fine = estimate_of(motion)
    bad = estimate_of(motion, value=-0.01, offset=-0.02)
    none = np.zeros((2, 10), bool)
    found = leave_one_out_residuals([motion] * 2, [fine, bad], without=none)
    alone = leave_one_out_residuals([motion], [fine], without=none[:1])
    np.testing.assert_allclose(found.step[0], alone.step[0])
    for part in (found.step[1], found.length[1], found.frame[1]):
        np.testing.assert_array_equal(part, 0)
    assert (found.frame.shape, found.linked.shape) == ((2, 9, 3), (2, 9))
    assert found.linked.all()


def test_jumps_are_many_above_one_in_a_hundred():
    """And more than one; lengths are those of the vectors."""
    for count, steps, many in ((1, 8, False), (2, 8, True), (2, 149, True), (2, 151, False)):
        size = np.tile([[3.0, 0, 4.0]], (count, 1))
        jumps = Jumps(np.arange(count), size, np.zeros(count), steps)
        assert jumps.many == many
        np.testing.assert_allclose(jumps.length, 5)


def test_the_probability_of_a_jump_is_that_of_hotellings_law():
    """The planted jump's residual in the axes of the others, over all steps of the track."""
    motion = brownian_motion(3, DT * np.arange(60), D_T=0.05, center_noise=1e-3, dt=DT)
    center = motion.center.copy()
    center[25:] += [2.0, 0.0, 0.0]
    motion = replace(motion, center=center)
    estimate = perrin.estimate_diffusion(motion, quantity="translation")
    found = find_jumps(motion, estimate)
    assert (found.rows.tolist(), found.n_steps) == ([25], 59)
    np.testing.assert_allclose(found.size[0], center[25] - center[24])
    without = np.arange(1, 60) == 25
    clean = perrin.estimate_diffusion(cut_at(motion, [25]), quantity="translation")
    z = leave_one_out_residuals([motion], [clean], without=without[None]).step[0]
    others = z[~without]
    values, axes = np.linalg.eigh(others.T @ others / 58)
    square = np.sum((z[without] @ axes) ** 2 / np.maximum(values, 1), axis=1)
    freedom = 58 - 3 + 1
    p = 59 * stats.f.sf(square * freedom / (3 * 58), 3, freedom)
    assert found.p[0] == pytest.approx(p[0], rel=1e-6)
    # A body that never leaves a plane jumps in it.
    level = replace(motion, center=center * [1.0, 1.0, 0.0])
    in_plane = perrin.estimate_diffusion(level, quantity="translation")
    assert find_jumps(level, in_plane).rows.tolist() == [25]
    # Each of several motions alone; a track of 7 steps has no scale, of 8 it has.
    short = [replace_frames(motion, np.arange(20, 20 + n)) for n in (8, 9)]
    still = replace(motion, center=np.zeros_like(center))
    motions = [motion, *short, brownian_motion(4, DT * np.arange(60), D_T=0.05, dt=DT)]
    estimates = [perrin.estimate_diffusion(m, quantity="translation") for m in motions]
    together = find_jumps_of_each([*motions, still], [*estimates, replace(estimate, value=0.0)])
    for m, e, one in zip(motions, estimates, together, strict=False):
        alone = find_jumps(m, e)
        assert one.rows.tolist() == alone.rows.tolist()
        assert one.size.shape == alone.size.shape
        assert one.n_steps == alone.n_steps == len(m.time) - 1
    assert together[0].rows.tolist() == [25]
    assert not together[3].rows.size
    assert not together[4].rows.size


def replace_frames(motion, rows):
    """Return some frames of a motion."""
    names = ("time", "center", "rotation", "residual", "n_present", "covariance", "center_variance")
    parts = {name: getattr(motion, name)[rows] for name in (*names, "piece")}
    return replace(motion, reason=("",) * len(rows), **parts)


# ---- steady motion ------------------------------------------------------------------------------


def test_a_steady_motion_is_that_of_generalised_least_squares():
    """Mean, error and the F test, from dense covariances, of each motion and of all together."""
    motion = noisy_motion(sigma=0.02)
    motion = replace(motion, center=motion.center - motion.time[:, None] * motion.center[-1] / 6.5)
    estimate = estimate_of(motion, offset=0.004)
    found = steady_motion(motion, estimate)
    assert found.p > 0.05  # so that no fit without the motion is made
    C = dense_covariance(motion, estimate)
    duration, y = np.diff(motion.time), np.diff(motion.center, axis=0)
    information = duration @ np.linalg.solve(C, duration)
    mean = np.linalg.solve(C, duration) @ y / information
    np.testing.assert_allclose(found.value, mean, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found.stderr, information**-0.5, rtol=1e-9)
    square = information * (mean @ mean) * 9 / 10
    freedom = 2 * (0.07 / 0.02) ** 2
    assert found.p == pytest.approx(stats.f.sf(square / 3, 3, freedom), rel=1e-9)
    moving = replace(motion, center=motion.center + motion.time[:, None] * [2.0, 0, 0])
    settings = estimate_of(moving)
    together = steady_motion_of_each([motion, moving, motion], [estimate, settings, estimate])
    alone = steady_motion(moving, settings)
    assert together[1].value == pytest.approx(alone.value)
    assert together[1].p == pytest.approx(alone.p)
    assert together[0].p == together[2].p == pytest.approx(found.p)
    # A p-value far above a level need not be exact, one below it is.
    slow = replace(motion, center=motion.center + motion.time[:, None] * [0.5, 0, 0])
    some = [slow, moving], [estimate_of(slow), settings]
    exact = steady_motion_of_each(*some)
    coarse = steady_motion_of_each(*some, level=exact[1].p * 1.01)
    assert coarse[1] == exact[1]
    assert coarse[0].p > exact[0].p
    assert steady_motion_of_each(*some, level=exact[0].p * 1.01) == exact
    # The fit with the motion left free decides.
    free = perrin.estimate_diffusion(moving, quantity="translation", drift=True)
    assert alone.value == pytest.approx(free.drift[0], abs=1e-6)
    exact = steady_motion(motion, estimate_of(motion, stderr=0.0))
    assert exact.p == pytest.approx(stats.chi2.sf(square, 3), rel=1e-6)


def test_a_spin_is_taken_away_about_the_axes_of_the_laboratory():
    """Of a body that only spins nothing is left, from its first frame on."""
    time = 3.0 + DT * np.arange(6)
    spin = np.array([0.3, -0.2, 0.5])
    rotation = exp_map(spin * (time - 3.0)[:, None])
    motion = with_poses(tetrahedron(), time, rotation=rotation, dt=DT)
    still = without_spin(motion, spin)
    np.testing.assert_allclose(still.rotation, [np.eye(3)] * 6, atol=1e-12)
    assert cut_at(motion, np.zeros(0, int)) is motion
    cut = cut_at(replace(motion, piece=np.array([0, 0, 0, 1, 1, 1])), np.array([1, 4]))
    assert cut.piece.tolist() == [0, 1, 1, 2, 3, 3]


def test_a_known_noise_loses_nothing_where_it_is_that_of_the_fit():
    """Twice the fall of the log-likelihood; 0 at the fitted noise, the same one by one."""
    motions = [
        brownian_motion(k, DT * np.arange(40), D_T=0.01, center_noise=0.01, dt=DT) for k in (1, 2)
    ]
    motions = [
        replace(m, sigma=0.2, noise=np.full(3, 0.2), center_variance=np.full(40, 0.01))
        for m in motions
    ]
    estimates = [perrin.estimate_diffusion(m, quantity="translation") for m in motions]
    fitted = [2 * np.sqrt(e.offset) for e in estimates]  # a quarter of sigma^2 is the noise
    np.testing.assert_allclose(offset_gain_of_each(motions, estimates, sigma=fitted), 0, atol=1e-6)
    for m, e, sigma in zip(motions, estimates, fitted, strict=True):
        gains = [offset_gain(m, e, sigma=f * sigma) for f in (0.5, 0.8, 1.25, 2.0)]
        assert gains[0] > gains[1] > 0 < gains[2] < gains[3]
        C = dense_covariance(m, e)
        y = np.diff(m.center, axis=0)
        # At four times the variance of the noise, and the D that is then most likely.
        one = perrin.estimate_diffusion(m, quantity="translation", noise=2 * sigma)
        four = dense_covariance(m, replace(e, value=one.value, offset=4 * e.offset))
        fall = stats.multivariate_normal(cov=C).logpdf(y.T).sum()
        fall -= stats.multivariate_normal(cov=four).logpdf(y.T).sum()
        assert gains[3] == pytest.approx(2 * fall, rel=1e-4)


def test_steps_smoother_than_by_motion_blur_gain():
    """Only where the offset is below -D dt/3, with noise left free."""
    rough = brownian_motion(1, DT * np.arange(80), D_T=0.05, center_noise=0.01, dt=DT)
    smooth = replace(rough, center=(rough.center + np.roll(rough.center, 1, 0)) / 2)
    smooth = replace_frames(smooth, np.arange(1, 80))
    estimate = perrin.estimate_diffusion(smooth, quantity="translation")
    assert estimate.offset < -estimate.value * DT / 3
    gain = persistence_gain(smooth, estimate)
    assert gain > 10
    assert persistence_gain(rough, perrin.estimate_diffusion(rough, quantity="translation")) == 0
    assert persistence_gain(smooth, replace(estimate, noise="residual")) == 0
    assert persistence_gain(smooth, replace(estimate, value=0.0)) == 0
    at_limit = replace(estimate, offset=-estimate.value * DT / 3)
    assert persistence_gain(smooth, at_limit) == 0
    below = replace(estimate, offset=-estimate.value * DT / 3 * 1.001)
    assert persistence_gain(smooth, below) == pytest.approx(gain)
    # Twice the difference of the likelihoods with half a step and a third of one as the most blur.
    densities = []
    for exposure in (None, 1.0):
        one = perrin.estimate_diffusion(smooth, quantity="translation", exposure=exposure)
        density = stats.multivariate_normal(cov=dense_covariance(smooth, one))
        densities.append(density.logpdf(np.diff(smooth.center, axis=0).T).sum())
    assert gain == pytest.approx(2 * (densities[0] - densities[1]), rel=1e-4)
    drifting = replace(smooth, center=smooth.center + smooth.time[:, None] * [3.0, 0, 0])
    free = perrin.estimate_diffusion(drifting, quantity="translation", drift=True)
    kept = persistence_gain(drifting, free)
    assert kept == pytest.approx(persistence_gain(smooth, estimate, drift=True), rel=1e-4)
    assert kept != pytest.approx(gain, rel=1e-4)


# ---- jumps of the stage -------------------------------------------------------------------------


def bodies(count=4, *, frames=24, jump=1.5, at=10, seed=1):
    """Return motions of bodies that are displaced together at one frame."""
    rng = np.random.default_rng(seed)
    time = DT * np.arange(frames)
    found = []
    for _ in range(count):
        walk = np.cumsum(rng.normal(scale=0.2, size=(frames, 3)), axis=0)
        walk[at:] += [jump, 0, 0]
        found.append(with_poses(tetrahedron(), time, center=walk, dt=DT))
    return found


def test_a_jump_of_the_stage_has_the_mean_and_the_probability_of_its_notes():
    """The weighted mean of the bodies' steps, its error, and the F test over all other frames."""
    motions = bodies()
    found = find_stage_jumps(motions, [5 + np.arange(24)] * 4)
    assert (found.frames.tolist(), found.bodies.tolist()) == ([15], [4])
    steps = np.stack([np.diff(m.center, axis=0) for m in motions])
    usual = np.arange(23) != 9
    center = np.median(steps[:, usual], axis=1, keepdims=True)
    weight = 1 / np.mean((steps[:, usual] - center) ** 2, axis=1)
    mean = (weight[:, None] * (steps - center)).sum(axis=0) / weight.sum(axis=0)
    common = (mean**2 * weight.sum(axis=0)).sum(axis=1)
    level = max(common[usual].mean() / 3, 1.0)
    np.testing.assert_allclose(found.size[0], mean[9])
    np.testing.assert_allclose(found.stderr[0], np.sqrt(level / weight.sum(axis=0)))
    p = 23 * stats.f.sf(common[9] / 3 / level, 3, 3 * 21 / 2)
    assert found.p[0] == pytest.approx(p, rel=1e-9)
    assert found.rows(np.array([0, 5, 14, 15, 16])).tolist() == [3]
    assert found.rows(np.array([0, 14, 16])).tolist() == [2]
    assert found.rows(np.array([15, 16])).tolist() == []
    assert found.rows(np.array([0, 14])).tolist() == []


def test_jumps_of_the_stage_over_gaps_and_of_some_bodies():
    """A step over a gap is as long as its time; bodies that are absent do not count."""
    motions = bodies(jump=1.8)
    keep = np.delete(np.arange(24), [8, 9])
    frames = [keep, keep, keep, keep[:4]]
    some = [replace_frames(m, f) for m, f in zip(motions, frames, strict=True)]
    found = find_stage_jumps(some, frames)
    assert found.frames.tolist() == [10]
    assert found.bodies.tolist() == [3]
    back = np.mean([m.center[10] - m.center[7] for m in motions[:3]], axis=0)
    assert np.abs(found.size[0] - back).max() < 0.5
    near = find_stage_jumps(bodies(jump=1.8)[:3], [np.arange(24)] * 3)
    assert np.all(found.stderr[0] > 1.3 * near.stderr[0])
    # Three steps are the fewest that have a scale.
    frames[3] = keep[:3]
    some[3] = replace_frames(motions[3], keep[:3])
    assert not find_stage_jumps(some, frames).frames.size
    # No body at all has the step that ends at frame 16.
    frames = [np.delete(np.arange(24), lost) for lost in (15, 15, 16, 16)]
    some = [replace_frames(m, f) for m, f in zip(motions, frames, strict=True)]
    assert find_stage_jumps(some, frames).frames.tolist() == [10]
    for none in (find_stage_jumps(motions[:1], [np.arange(24)]), find_stage_jumps([], [])):
        assert none.size.shape == none.stderr.shape == (0, 3)
        assert none.frames.size == none.p.size == none.bodies.size == 0
    # One body alone, 8 steps with the jump among them, or a jump every few steps: none.
    alone = [*bodies(jump=0.0)[:3], bodies(jump=5.0)[3]]
    assert not find_stage_jumps(alone, [np.arange(24)] * 4).frames.size
    for count, number in ((10, 1), (9, 0)):
        few = [replace_frames(m, np.arange(count)) for m in bodies(jump=9.0, at=5)]
        assert find_stage_jumps(few, [np.arange(count)] * 4).frames.size == number
    often = bodies(jump=5.0)
    often = [
        replace(m, center=m.center + 5.0 * (np.arange(24) >= 15)[:, None] * [0, 1, 0])
        for m in often
    ]
    assert find_stage_jumps(often, [np.arange(24)] * 4).frames.tolist() == [10, 15]
    often = [
        replace(m, center=m.center + 5.0 * (np.arange(24) >= 20)[:, None] * [0, 1, 0])
        for m in often
    ]
    assert not find_stage_jumps(often, [np.arange(24)] * 4).frames.size
    flat = StageJumps.from_dict(found.to_dict())
    np.testing.assert_array_equal(flat.size, found.size)


# ---- verdicts -----------------------------------------------------------------------------------


def judged(*, D, tau, n_steps, information, p=None, value=0.0):
    """Return what a verdict uses of the tests of one motion."""
    score = Score(np.array([value]), np.full((4, 1), information / 4), np.zeros((4, 1)))
    return BrownianSummary(p or {}, (score, score), n_steps, float(np.mean(D)), tau)


def test_what_a_track_could_have_shown_is_its_arithmetic():
    """2.8 errors of the exponent, 12 relaxations of a cage, 3.3 errors of a velocity."""
    one = judged(D=[0.01, 0.02, 0.03], tau=0.5, n_steps=300, information=100.0)
    two = judged(D=[0.04, 0.04, 0.04], tau=0.5, n_steps=100, information=44.0)
    found = detectable_by([one, two], "rotation")
    assert found["alpha_below"] == pytest.approx(1 - 2.8 / 12)
    assert found["alpha_above"] == pytest.approx(1 + 2.8 / 12)
    assert found["cage"] == pytest.approx(np.sqrt(2 * 0.02 * 0.5 * 300 / 12))
    assert found["spin"] == pytest.approx(3.3 * np.sqrt(2 * 0.02 / 150))
    assert found["drift"] is None
    alone = detectable_by([two], "translation")
    assert alone["drift"] == pytest.approx(3.3 * np.sqrt(2 * 0.04 / 50))
    assert alone["spin"] is None
    few = detectable_by([judged(D=[0.01], tau=1.0, n_steps=20, information=4.0)], "rotation")
    assert (few["alpha_below"], few["alpha_above"]) == (0.0, 2.0)


def test_p_values_of_several_motions_are_fishers_and_those_of_added_scores():
    """Scores add from 200 steps on; one motion keeps its own."""
    names = ("fractional", "cage", "steady")
    p = [dict(zip(names, numbers, strict=True)) for numbers in ((0.2, 0.3, 0.4), (0.5, 0.1, 0.7))]
    short = [
        judged(D=[1.0], tau=1.0, n_steps=99, information=9.0, p=own, value=v)
        for own, v in zip(p, (2.0, 4.0), strict=True)
    ]
    for name in names:
        joined = stats.chi2.sf(-2 * np.log(p[0][name] * p[1][name]), 4)
        assert combined_p(short)[name] == pytest.approx(joined)
    assert combined_p(short[:1]) == p[0]
    long = [one._replace(n_steps=100) for one in short]
    found = combined_p(long)
    # The sum of the scores is 6, of variance 18, and normal: sqrt(2) standard deviations.
    assert found["fractional"] == pytest.approx(2 * stats.norm.sf(np.sqrt(2)), rel=1e-3)
    assert found["steady"] == pytest.approx(combined_p(short)["steady"])
    assert found["cage"] == pytest.approx(stats.norm.sf(np.sqrt(2)), rel=1e-3)
