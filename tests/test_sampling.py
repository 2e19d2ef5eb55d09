"""When to take frames: published numbers, budgets, identity, units, and what simulations reach."""

import json
import warnings
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import perrin
from brownian_motions import assert_same_fields
from perrin import (
    Cluster,
    DegenerateClusterError,
    DiffusionEstimate,
    SamplingPlan,
    SamplingVerdict,
    UnitWarning,
    add_noise,
    cramer_rao,
    estimate_diffusion,
    judge_sampling,
    noise_floor,
    plan_sampling,
    simulate_motion,
    track_rotation,
)
from perrin.geometry.rotations import exp_map

# Hunter 2011, section 5 and Table 1.
D_R = 4.93e-3
PAPER = {"D_R": D_R, "sigma": (0.03, 0.03, 0.04)}


@cache
def paper_body():
    """Return the paper's tetrahedron."""
    return Cluster.touching(4, 2.45)


@cache
def paper_phi2():
    """Return the noise floor of the paper's tetrahedron, rad^2."""
    return noise_floor(paper_body(), sigma=PAPER["sigma"]).phi2


def test_the_window_is_the_rule():
    """The window is [5 Phi^2/4D_R, 0.1/4D_R], and SNR 20 the best for a number of frames."""
    plan = plan_sampling(paper_body(), **PAPER, n_frames=300)
    assert plan.phi2 == paper_phi2()
    assert plan.dt_min == pytest.approx(5 * paper_phi2() / (4 * D_R))
    assert plan.dt_max == pytest.approx(0.1 / (4 * D_R))
    assert plan.dt_best == pytest.approx(20 * paper_phi2() / (4 * D_R))
    assert plan.snr == pytest.approx(20)
    assert plan.expected_error == cramer_rao(n_frames=300, snr=plan.snr)
    assert plan.expected_error_residual == cramer_rao(n_frames=300, snr=plan.snr, noise="residual")
    assert plan.paper_dt_min == pytest.approx(paper_phi2() / (4 * D_R))
    assert plan.paper_dt_max == pytest.approx(1 / (4 * D_R))


def test_an_empty_window_is_reported():
    """With Phi^2 above 0.02 the best dt is 0.1/4D_R, with more frames or particles."""
    full, empty = (
        plan_sampling(paper_body(), D_R=D_R, sigma=sigma, n_frames=300)
        for sigma in np.sqrt(np.array([0.0199, 0.0201]) * 4 / 6) * paper_body().R
    )
    assert full.dt_min < full.dt_max
    assert "empty" not in full.reasons[0]
    assert empty.dt_min > empty.dt_max
    assert "take more frames or particles" in empty.reasons[0]
    for plan in (full, empty):  # SNR 20 is out of reach in both
        assert plan.dt_best == pytest.approx(0.1 / (4 * D_R))
    # With large noise and a short time there is still a plan (SNR 0.06).
    for photons in (False, True):
        plan = plan_sampling(
            paper_body(), D_R=D_R, sigma=2.7, n_frames=4, total_time=15.3, photons=photons
        )
        assert plan.dt_best == pytest.approx(min(0.1 / (4 * D_R), 15.3 / 3))
    assert plan_sampling(paper_body(), D_R=D_R, sigma=2.7, total_time=15.3).n_frames == 4


def test_published_frame_counts():
    """At SNR 5 an error r takes 2.25/r^2 frames, 0.93/r^2 with the noise from residuals.

    10, 3 and 1 %: 225, 2500, 22 500 and 93, 1030, 9300; the factors have three digits, and the
    ends of a track cost three frames more.
    """
    plan = plan_sampling(paper_body(), **PAPER, total_time=220)
    assert plan.snr == pytest.approx(5)
    for error, joint, residual in ((0.1, 225, 93), (0.03, 2500, 1033), (0.01, 22500, 9300)):
        assert plan.frames_for(error) == pytest.approx(joint, rel=0.003, abs=3.5)
        assert plan.frames_for(error, noise="residual") == pytest.approx(residual, rel=5e-3, abs=2)


def test_frames_for_is_the_least_number():
    """One frame less misses the wanted error; the least number is three frames."""
    plan = plan_sampling(paper_body(), **PAPER, n_frames=300)
    n = plan.frames_for(plan.expected_error)
    assert n == 300
    for noise in ("joint", "residual", "known"):
        n = plan.frames_for(0.04, noise=noise)
        enough, short = (cramer_rao(n_frames=k, snr=plan.snr, noise=noise) for k in (n, n - 1))
        assert enough <= 0.04 < short
    assert plan.frames_for(5.0) == 3
    with pytest.raises(ValueError, match="relative_error"):
        plan.frames_for(0)
    with pytest.raises(ValueError, match="noise"):
        plan.frames_for(0.1, noise="guessed")


def test_the_table_of_budgets():
    """Variances against SNR at fixed time, and with fixed photons, are the published ones."""
    # SNR, fixed time unknown and residual, photons residual and unknown; any one scale each.
    table = np.array([
        [0.5, 1.83, 1.31, 1.85, 2.59], [1, 2.98, 1.81, 1.81, 2.98], [5, 11.24, 4.65, 2.08, 5.03],
        [20, 41.37, 14.68, 3.28, 9.25],
    ])  # fmt: skip
    time = plan_sampling(paper_body(), **PAPER, total_time=1e5)
    dose = plan_sampling(paper_body(), **PAPER, n_frames=10**5, total_time=1e5, photons=True)
    stated = 1e5 / (10**5 - 1)
    at_snr = {
        "time": table[:, 0] * paper_phi2() / (4 * D_R),
        "dose": np.sqrt(table[:, 0] * paper_phi2() / (4 * D_R) * stated),
    }
    for plan, dt, error, column in (
        (time, "time", "error", 1), (time, "time", "error_residual", 2),
        (dose, "dose", "error_residual", 3), (dose, "dose", "error", 4),
    ):  # fmt: skip
        curve = np.log(getattr(plan, error))
        variance = np.exp(2 * np.interp(np.log(at_snr[dt]), np.log(plan.dt), curve))
        ratio = variance / table[:, column]
        # Three digits of the table, and the interpolation between the curve's points.
        assert ratio == pytest.approx(ratio[1], rel=0.01)


def test_given_time_more_frames_help_and_no_optimum_is_claimed():
    """The error rises with dt throughout; the advice is the short end of the window."""
    plan = plan_sampling(paper_body(), **PAPER, total_time=2200)
    assert plan.dt_best == plan.dt_min
    assert plan.n_frames == int(2200 / plan.dt_min) + 1
    assert (np.diff(plan.error) > 0).all()
    assert any("no optimum" in text for text in plan.reasons)


@pytest.mark.parametrize(("n_frames", "spread_out"), [(100, False), (600, True), (3000, True)])
def test_given_frames_and_time_both_are_limits(n_frames, spread_out):
    """All frames over all the time, unless that is longer than for frames alone.

    No dt of the curve has a smaller error than the best one, but for the last 2 % beyond SNR 20.
    """
    plan = plan_sampling(paper_body(), **PAPER, n_frames=n_frames, total_time=220)
    assert plan.n_frames == n_frames
    if spread_out:
        assert plan.dt_best == pytest.approx(220 / (n_frames - 1))
    else:
        assert plan.snr == pytest.approx(20)
    assert plan.dt_best * (n_frames - 1) <= 220 * (1 + 1e-12)
    assert plan.error.min() > plan.expected_error * (1 - 1e-9 if spread_out else 0.98)
    assert any("below the window" in text for text in plan.reasons) == (n_frames == 3000)


def test_with_limited_photons_the_stated_movie_is_a_point_of_the_curve():
    """At the stated dt the error is that of the stated movie; sigma^2 is proportional to 1/dt."""
    plan = plan_sampling(paper_body(), **PAPER, n_frames=300, total_time=220, photons=True)
    stated = 220 / 299
    there = np.exp(np.interp(np.log(stated), np.log(plan.dt), np.log(plan.error)))
    usual = cramer_rao(n_frames=300, snr=4 * D_R * stated / paper_phi2())
    assert there == pytest.approx(usual, rel=0.01)  # interpolated
    assert plan.snr == pytest.approx(0.5)
    assert plan.snr == pytest.approx(
        4 * D_R * plan.dt_best / (paper_phi2() * stated / plan.dt_best)
    )
    assert plan.expected_error < usual
    assert plan.n_frames > 300


def test_without_a_budget_300_frames_are_stated():
    """Neither frames nor time: the plan is that of 300 frames, and its reasons name them."""
    plan, stated = (
        plan_sampling(paper_body(), **PAPER),
        plan_sampling(paper_body(), **PAPER, n_frames=300),
    )
    assert str(plan) == str(stated)
    assert "(300)" in plan.reasons[1]


# 4 D_R dt, and the percentage of steps that nearest neighbours and the best rigid fit get wrong,
# published. The limits must lie where the table says hardly any and 0.1 to 0.4 %.
@pytest.mark.parametrize(
    ("shape", "hardly", "some"),
    [("trimer", 0.12, 0.2), ("tetrahedron", 0.072, 0.12), ("pentahedron", 0.04, 0.072)],
)
def test_identity_limits_are_those_of_the_table(shape, hardly, some):
    """Linking is reliable from 0.00 % to 0.07 % wrong, the rigid fit to 4 D_R dt = 0.2."""
    plan = plan_sampling(getattr(Cluster, shape)(1.5), D_R=D_R, sigma=0.03)
    assert hardly <= 4 * D_R * plan.dt_link <= some
    assert 4 * D_R * plan.dt_rigid == pytest.approx(0.2, rel=0.01)


@pytest.mark.parametrize("n", [3, 4, 5, 6, 7])
@pytest.mark.parametrize("D_T", [0.0, 0.05])
def test_linking_is_wrong_in_004_percent_of_the_steps_at_its_limit(n, D_T, repeats):
    """Simulated steps of touching spheres, turned and shifted, at the stated limit."""
    body = Cluster.touching(n, 1.0)
    dt = plan_sampling(body, D_R=1.0, D_T=D_T, sigma=0.01).dt_link
    steps, rng = repeats(15_000, 40_000), np.random.default_rng(n)
    turn = exp_map(rng.normal(scale=np.sqrt(2 * dt), size=(steps, 3)))
    shift = rng.normal(scale=np.sqrt(2 * D_T * dt), size=(steps, 1, 3))
    after = np.swapaxes(turn @ body.positions.T, 1, 2) + shift
    apart = np.sum((after[:, :, None] - body.positions) ** 2, axis=-1)
    wrong = np.mean((apart.argmin(axis=2) != np.arange(n)).any(axis=1))
    assert wrong < 4e-4 + 3 * np.sqrt(4e-4 / steps)


def test_high_symmetry_shortens_the_window():
    """A bipyramid of seven is confused by a turn of 36 degrees, before 4 D_R dt = 0.1."""
    plan = plan_sampling(Cluster.touching(7, 2.0), D_R=D_R, sigma=0.03)
    assert plan.dt_max == plan.dt_rigid
    assert 4 * D_R * plan.dt_max == pytest.approx(2 * np.deg2rad(36) ** 2 / 3.3**2)
    # A measured shape has no symmetry by name; neighbours' angles are then the careful limit.
    measured = plan_sampling(Cluster.touching(7, 2.0).positions, D_R=D_R, sigma=0.03)
    assert measured.dt_max <= plan.dt_max * (1 + 1e-12)


def test_translation_shortens_linking_only():
    """A moving centre confuses nearest neighbours earlier and leaves the rest of the plan alone."""
    rest, moves = (plan_sampling(paper_body(), **PAPER, D_T=D_T) for D_T in (None, 0.0385))
    assert moves.dt_link < rest.dt_link
    assert (moves.dt_best, moves.dt_rigid) == (rest.dt_best, rest.dt_rigid)
    # Without rotation: half the spacing is 4.2 standard deviations of one axis of a step.
    shift = plan_sampling(paper_body(), D_R=1e-12, sigma=0.03, D_T=0.04).dt_link
    assert shift == pytest.approx((2.45 / 2 / 4.2) ** 2 / (2 * 0.04))
    assert any("the centre moves" in text for text in moves.reasons)


@pytest.mark.parametrize("budget", [
    {"n_frames": 200}, {"total_time": 100.0}, {"n_frames": 400, "total_time": 100.0},
    {"n_frames": 400, "total_time": 100.0, "photons": True},
])  # fmt: skip
def test_units_rescale_the_plan(budget):
    """With times 60 and lengths 1000 times larger, the plan is only rescaled."""
    usual = plan_sampling(paper_body(), **PAPER, D_T=0.04, **budget)
    scaled = dict(budget)
    if "total_time" in scaled:
        scaled["total_time"] *= 60
    other = plan_sampling(
        1e3 * paper_body().positions,
        D_R=D_R / 60,
        D_T=0.04 * 1e6 / 60,
        sigma=(30, 30, 40),
        **scaled,
    )
    for name in ("dt_min", "dt_max", "dt_best", "dt_link", "paper_dt_min", "paper_dt_max", "dt"):
        assert getattr(other, name) == pytest.approx(60 * getattr(usual, name), rel=1e-9)
    assert other.n_frames == usual.n_frames
    assert other.snr == pytest.approx(usual.snr)
    assert other.error == pytest.approx(usual.error)


def test_in_the_plane_one_angle_shares_D():
    """In 2-D Phi^2 is 2 s, the MSAD 2 D_R t, and one axis has the error."""
    square = Cluster.from_positions([[1.0, 0], [0, 1], [-1, 0], [0, -1]])
    plan = plan_sampling(square, D_R=0.01, sigma=0.02, n_frames=500)
    s = 0.02**2 / 4
    assert plan.phi2 == pytest.approx(2 * s)
    assert plan.dt_best == pytest.approx(20 * s / 0.01)
    assert plan.paper_dt_min == pytest.approx(plan.phi2 / (2 * 0.01))
    assert plan.expected_error == cramer_rao(n_frames=500, snr=plan.snr, axes=1)
    assert plan.residual_dof == 2 * 4 - 3


def test_bias_of_long_steps_is_reported_where_it_matters():
    """At 4 D_R dt = 0.1 D_R is 0.4 % too low: reported for 2e5 frames, not for 300."""
    short, long = (
        plan_sampling(paper_body(), D_R=D_R, sigma=0.3, n_frames=n) for n in (300, 200_000)
    )
    assert not any("too small" in text for text in short.reasons)
    assert any("0.42 % too small" in text for text in long.reasons)


def test_every_fault_is_in_one_message():
    """All that is wrong is named at once, and bodies without an orientation as such."""
    bad = {"D_R": -1, "sigma": (1, 2), "D_T": -1, "n_frames": 2.5, "total_time": 0}
    names = r"D_R: .* > 0 .*, got -1; total_time: .*; sigma: .*; D_T: .*; n_frames: .*"
    with pytest.raises(ValueError, match=names):
        plan_sampling(paper_body(), **bad)
    with pytest.raises(ValueError, match="sigma: expected more than 0"):
        plan_sampling(paper_body(), D_R=1.0, sigma=0)
    for budget in ({}, {"n_frames": 9}, {"total_time": 9.0}):
        with pytest.raises(ValueError, match="photons: expected n_frames and total_time"):
            plan_sampling(paper_body(), D_R=1.0, sigma=0.1, photons=True, **budget)
    with pytest.raises(ValueError, match="fewer than 3 frames"):
        plan_sampling(paper_body(), D_R=1e-6, sigma=0.1, total_time=3.0)
    with pytest.raises(ValueError, match="same place"):
        plan_sampling([[0, 0, 0], [0, 0, 0], [1, 0, 0], [0, 1, 0]], D_R=1.0, sigma=0.1)
    with pytest.raises(DegenerateClusterError):
        plan_sampling(Cluster.touching(2, 1.0), D_R=1.0, sigma=0.1)


@pytest.fixture(scope="module")
def at_the_best_dt(repeats):
    """Return a plan of 100 frames, and the estimates of 16 clusters (long: 120) measured by it."""
    plan = plan_sampling(paper_body(), **PAPER, n_frames=100)
    rng, found = np.random.default_rng(4), []
    for _ in range(repeats(16, 120)):
        truth = simulate_motion(paper_body(), D_R=D_R, dt=plan.dt_best, n_frames=100, rng=rng)
        noisy = add_noise(truth.positions(), sigma=PAPER["sigma"], rng=rng)
        found.append(estimate_diffusion(track_rotation(noisy, dt=plan.dt_best)))
    return plan, found


def test_the_expected_error_is_what_the_estimator_reaches(at_the_best_dt):
    """The scatter of the estimates is the expected error, within 3 standard errors of a scatter."""
    plan, found = at_the_best_dt
    scatter = np.std([e.value for e in found], ddof=1) / D_R
    within = 3 / np.sqrt(2 * (len(found) - 1))
    assert scatter / plan.expected_error == pytest.approx(1, abs=within)


def test_what_was_planned_is_judged_well_sampled(at_the_best_dt):
    """The verdict on data taken as planned: well sampled, factors 1 within their scatter."""
    plan, found = at_the_best_dt
    verdicts = [judge_sampling(e) for e in found]
    assert all("Well sampled" in str(v) for v in verdicts)
    factors = np.array([v.factor for v in verdicts])
    # The factor goes as s/D, whose relative error is that of D to a few percent.
    assert np.median(factors) == pytest.approx(1, abs=4 * plan.expected_error / np.sqrt(len(found)))
    assert np.mean([v.error for v in verdicts]) == pytest.approx(plan.expected_error, rel=0.1)


def estimate(**changes):
    """Return an estimate of D_R at SNR 1.7, 4 D_R dt = 4e-4, made with the bound's error."""
    usual = DiffusionEstimate(
        value=0.01, ci68=(0.009, 0.011), ci95=(0.008, 0.012), stderr=0.001, offset=6e-5,
        offset_stderr=1e-6, resolution_floor=1e-9, resolved=True, unit="rad^2/s", method="mle",
        n_frames=300, snr=1.7, dt=0.01,
    )  # fmt: skip
    return replace(usual, **changes)


def test_the_factor_is_the_ratio_to_the_planned_dt():
    """plan_sampling with the D, noise and frames of the data gives factor times their dt."""
    for snr, dt in ((1.7, 0.01), (0.2, 0.01), (60.0, 0.3), (8.0, 4.0), (1.0, 4.0)):
        data = estimate(snr=snr, dt=dt)
        sigma = np.sqrt(data.value * dt / snr / (noise_floor(paper_body(), sigma=1.0).phi2 / 4))
        plan = plan_sampling(paper_body(), D_R=data.value, sigma=sigma, n_frames=300)
        verdict = judge_sampling(data)
        assert verdict.factor == pytest.approx(plan.dt_best / dt)
        assert verdict.dt_best == pytest.approx(plan.dt_best)
        assert verdict.bound_best == pytest.approx(plan.expected_error)


def test_oversampled_12_times():
    """SNR 20/12: every 12th frame would have been enough; the error is compared with the bound."""
    verdict = judge_sampling(estimate(snr=20 / 12))
    assert verdict.factor == pytest.approx(12)
    assert "Oversampled 12 times" in str(verdict)
    assert "every 12th frame would have been enough" in str(verdict)
    assert verdict.bound == cramer_rao(n_frames=300, snr=20 / 12)
    assert verdict.bound_best == pytest.approx(cramer_rao(n_frames=300, snr=20))
    assert verdict.error == pytest.approx(0.1)
    assert "Standard error 10 %" in str(verdict)
    assert "efficiency" not in str(verdict)
    poor = judge_sampling(estimate(snr=1e3, dt=0.5, stderr=0.002))
    assert "efficiency of the estimate [mle] is 17 %" in str(poor)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"snr": 4.99}, "Oversampled 4 times"),
        ({"snr": 5.01}, "Well sampled"),
        ({"snr": 50.0, "dt": 2.49}, "Well sampled"),
        ({"snr": 50.0, "dt": 2.51}, "Undersampled"),
        ({"snr": 50.0, "dt": 6.0}, "D_R is 1.0 % too low"),
        ({"snr": 6.0, "dt": 6.0}, "take more frames or particles"),
        ({"snr": np.inf}, "Well sampled (SNR inf"),
        ({"snr": 50.0, "dt": 6.0, "unit": "um^2/s"}, "Well sampled"),
        ({"snr": 1.0, "dt": 6.0, "unit": "um^2/s"}, "Oversampled 20 times"),
    ],
)  # fmt: skip
def test_verdicts(changes, words):
    """Each verdict on its side of its threshold; D_T has no limit from rotation."""
    assert words in str(judge_sampling(estimate(**changes)))


def test_unresolved_data_are_judged_at_their_limit():
    """Without a resolved D the factor is the least one: that of the 95 % limit."""
    limit = estimate(value=0.0, ci68=(0, 1e-4), ci95=(0, 2e-4), resolved=False, snr=0.0)
    verdict = judge_sampling(limit)
    assert verdict.factor == pytest.approx(20 * 6e-5 / (2e-4 * 0.01))
    assert "Oversampled at least 600 times" in str(verdict)
    assert "Not resolved" in str(verdict)
    near = estimate(resolved=False, snr=1.0)
    assert judge_sampling(near).snr == pytest.approx(1.2)


def test_estimates_without_dt_or_limit_are_not_judged():
    """No time between frames, or no D and no limit to it."""
    for changes in ({"dt": np.nan}, {"resolved": False, "ci95": (0.0, np.inf)}):
        with pytest.raises(ValueError, match="estimate: expected a time between frames"):
            judge_sampling(estimate(**changes))


def test_the_estimate_carries_its_dt():
    """estimate_diffusion states the time between frames, the mean one of several motions."""
    motions = [
        simulate_motion(paper_body(), D_R=D_R, dt=dt, n_frames=20, rng=1) for dt in (0.5, 0.7)
    ]
    assert estimate_diffusion(motions[0]).dt == 0.5
    assert estimate_diffusion(motions, quantity="translation").dt == pytest.approx(0.6)


def test_lengths_that_may_be_in_nanometres_are_warned_of():
    """A sigma larger than the body and spheres of 2450 um warn; usual lengths do not."""
    with pytest.warns(UnitWarning, match=r"sigma: 30 um .* R = 1\.5 um.* state 0\.03"):
        plan_sampling(paper_body(), D_R=D_R, sigma=30.0)
    with pytest.warns(UnitWarning, match=r"nearest particles, 2450 um, .* it is 2\.45 um"):
        plan_sampling(Cluster.touching(4, 2450.0), D_R=D_R, sigma=0.03)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for diameter in (0.06, 2.45, 49.0):
            plan_sampling(Cluster.touching(4, diameter), D_R=D_R, sigma=0.01 * diameter)


def test_every_estimate_of_one_track_gets_one_verdict(repeats):
    """A line, least squares of a curve and the likelihood share the noise: all are oversampled.

    Frames 10 ms apart at SNR 0.2: the offset of a curve is negative in some of these tracks and
    does not measure the noise.
    """
    body = Cluster.tetrahedron(1.5)
    for seed in range(repeats(3, 12)):
        truth = simulate_motion(body, D_R=5e-3, D_T=0.04, dt=0.01, n_frames=300, rng=seed)
        motion = track_rotation(add_noise(truth.positions(), sigma=0.03, rng=seed + 90), dt=0.01)
        estimates = [
            perrin.fit_line(perrin.msad(motion)),
            perrin.fit_gls(perrin.msad(motion)),
            perrin.estimate_diffusion(motion),
        ]
        # One noise variance, with the D that each found; the directions that a curve averages
        # weigh the axes of the noisy shape a little unequally.
        noise = [e.value * e.dt / e.snr for e in estimates]
        assert noise == pytest.approx([noise[0]] * 3, rel=1e-4)
        assert all(str(judge_sampling(e)).startswith("Oversampled") for e in estimates)


def test_the_noise_of_a_curve_of_positions_is_not_known():
    """Free particles have no rigid-fit residuals: no SNR, and no verdict on the sampling."""
    walk = np.random.default_rng(2).normal(size=(100, 3, 3)).cumsum(axis=0)
    estimate = perrin.fit_line(perrin.msd(walk, dt=0.5))
    assert np.isnan(estimate.snr)
    with pytest.raises(ValueError, match="localisation noise is not known"):
        judge_sampling(estimate)


@pytest.mark.parametrize("budget", [{}, {"n_frames": 50, "total_time": 60.0, "photons": True}])
def test_a_plan_is_the_same_after_json(budget):
    """Every field, the text and the number of frames for an error; the arrays are read-only."""
    plan = plan_sampling(paper_body(), **PAPER, D_T=0.04, **budget)
    text = json.dumps(plan.to_dict(), allow_nan=False)
    back = SamplingPlan.from_dict(json.loads(text))
    assert_same_fields(back, plan)
    assert str(back) == str(plan)
    assert back.frames_for(0.03) == plan.frames_for(0.03)
    assert not back.error.flags.writeable


def test_a_verdict_is_the_same_after_json():
    """Every field, infinite ones included."""
    for changes in ({}, {"snr": np.inf}, {"value": -0.01, "resolved": False}):
        verdict = judge_sampling(estimate(**changes))
        text = json.dumps(verdict.to_dict(), allow_nan=False)
        assert SamplingVerdict.from_dict(json.loads(text)) == verdict
