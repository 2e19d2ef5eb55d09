"""Laws of the tests of Brownian motion and of the verdict on a motion."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

import perrin
from perrin import Cluster, Confined, Fractional, MotionVerdict, Spin, Switching, judge_motion
from perrin.diffusion import (
    AxisModel,
    Noise,
    Score,
    approximate_p,
    axis_model,
    brownian_tests,
    confined_autocovariance,
    fractional_autocovariance,
    holm,
    score_p,
    sine_spectrum,
)
from perrin.diffusion.goodness_of_fit import TESTS
from perrin.geometry import exp_map

TETRAHEDRON = Cluster.tetrahedron(1.5)
DT = 0.7
D_R = 0.05**2 / (2 * DT)  # an rms turn of 0.05 rad a frame and axis


def planted(dynamics=None, *, frames=301, seed=1, D=D_R):
    truth = perrin.simulate_motion(
        TETRAHEDRON, D_R=D, D_T=0.02, dt=DT, n_frames=frames, dynamics=dynamics, rng=seed
    )
    noisy = perrin.add_noise(truth.positions(), sigma=0.03, rng=seed + 1)
    return perrin.track_rotation(noisy, dt=DT)


@pytest.fixture(scope="module")
def brownian():
    return planted(seed=4)


def even_model(n_steps):
    none = np.zeros((3, n_steps))
    return AxisModel(
        start=np.arange(float(n_steps)),
        tau=np.ones(n_steps),
        linked=np.arange(n_steps) < n_steps - 1,
        known=(none, none),
        blur=0.0,
        free=True,
        steady=np.broadcast_to(np.eye(3), (n_steps, 3, 3)).copy(),
    )


def noisy_steps(n_steps, tracks, snr, rng):
    noise = np.diff(rng.standard_normal((tracks, 3, n_steps + 1)) / np.sqrt(snr), axis=-1)
    return np.sqrt(2) * rng.standard_normal((tracks, 3, n_steps)) + noise


@pytest.mark.parametrize(
    "g",
    [
        fractional_autocovariance(0.5, 40),
        fractional_autocovariance(1.6, 40, exposure=0.8),
        confined_autocovariance(0.3, 40),
    ],
)
def test_the_sine_spectrum_is_the_diagonal_of_the_transformed_covariance(g):
    k = np.arange(1, 41)
    sines = np.sqrt(2 / 41) * np.sin(np.pi * np.outer(k, k) / 41)
    covariance = g[np.abs(np.subtract.outer(k, k))]
    assert sine_spectrum(g) == pytest.approx(np.diag(sines @ covariance @ sines), rel=1e-11)


def test_brownian_steps_are_rejected_at_the_stated_levels(repeats):
    tracks = repeats(400, 4000)
    model = even_model(300)
    y = noisy_steps(300, tracks, 5.0, np.random.default_rng(5))
    fit = model.fit(y)
    p = approximate_p(model, fit, model.scores(fit), model.squared_errors(fit))
    for level in (0.05, 0.2):
        error = np.sqrt(level * (1 - level) / tracks)
        for name, values in p.items():
            assert np.mean(values < level) == pytest.approx(level, abs=3.5 * error), name
    family = np.mean([holm(one) < 0.05 for one in np.stack(list(p.values()), axis=1)])
    assert family < 0.05 + 3 * np.sqrt(0.05 * 0.95 / tracks)


def test_ranks_of_a_short_noisy_track_are_uniform(repeats, monkeypatch):
    tracks = repeats(20, 400)
    if not repeats(0, 1):
        # Ranks among 99 draws are as uniform as those among 666, and take less time.
        monkeypatch.setattr("perrin.diffusion.goodness_of_fit._MOST_DRAWS", 99)
    model = even_model(50)
    y = noisy_steps(50, tracks, 0.5, np.random.default_rng(6))
    p = np.array([list(brownian_tests(model, one[None]).p.values()) for one in y])
    error = np.sqrt(0.2 * 0.8 / tracks)
    assert np.mean(p < 0.2, axis=0) == pytest.approx(np.full(len(TESTS), 0.2), abs=3.5 * error)


@pytest.mark.parametrize(
    ("n_steps", "snr", "free", "known"),
    [(100, 5, 0.157, 0.080), (300, 0.5, 0.106, 0.070), (1000, 50, 0.045, 0.023)],
)
def test_the_error_of_the_exponent_is_that_of_the_information(n_steps, snr, free, known):
    # Information of the sine modes of three axes, offset free and noise known.
    model = even_model(n_steps)
    fit = model.fit(noisy_steps(n_steps, 1, snr, np.random.default_rng(1)))
    exact = replace(fit, D=np.ones((1, 3)), offset=np.full((1, 3), 1 / snr))
    assert model.scores(exact)[0].information[0] ** -0.5 == pytest.approx(free, rel=0.01)
    noise = np.full((3, n_steps), 1 / snr)
    fixed = replace(model, known=(noise, noise), free=False)
    exact = replace(exact, offset=np.zeros((1, 3)))
    assert fixed.scores(exact)[0].information[0] ** -0.5 == pytest.approx(known, rel=0.02)


def test_scores_of_any_durations_are_those_of_the_modes_where_steps_are_even():
    model = even_model(200)
    y = noisy_steps(200, 60, 5.0, np.random.default_rng(2))
    fit = model.fit(y[:1])
    modes = model.scores(replace(fit, y=y))
    dense = model.dense_scores(fit, y)
    # They differ by the elements of the covariances off the diagonal of the modes.
    for one, two in zip(modes, dense, strict=True):
        assert two.information[0] == pytest.approx(one.information[0], rel=0.15)
    corrected = dense[0].value - modes[0].value
    assert np.std(corrected - corrected.mean()) < 0.5 * np.sqrt(dense[0].information[0])


def test_the_fit_of_uneven_steps_is_that_of_the_likelihood():
    truth = perrin.simulate_motion(TETRAHEDRON, D_R=D_R, dt=DT, n_frames=200, rng=3)
    x = perrin.add_noise(truth.positions(), sigma=0.03, rng=4)
    x[np.random.default_rng(5).random(200) < 0.3] = np.nan
    motion = perrin.track_rotation(x, dt=DT)
    model, y = axis_model(motion, "rotation", Noise())
    fit = model.fit(y)
    assert not model.even
    for axis in range(3):
        for change in ((1.02, 0.0), (0.98, 0.0), (1.0, 1e-5), (1.0, -1e-5)):
            D, offset = fit.D.copy(), fit.offset.copy()
            D[0, axis] *= change[0]
            offset[0, axis] += change[1]
            assert model.log_likelihood(replace(fit, D=D, offset=offset)) < model.log_likelihood(
                fit
            )


def test_the_verdict_does_not_depend_on_the_axes_of_the_laboratory(brownian):
    turn = exp_map(np.array([0.4, -1.1, 0.7]))
    turned = replace(brownian, rotation=turn @ brownian.rotation, center=brownian.center @ turn.T)
    before, after = judge_motion(brownian), judge_motion(turned)
    assert after.p == pytest.approx(before.p, rel=1e-6)


def test_the_verdict_does_not_depend_on_units(brownian):
    slower = replace(brownian, time=10 * brownian.time, dt=10 * brownian.dt)
    before, after = judge_motion(brownian), judge_motion(slower)
    assert after.p == pytest.approx(before.p, rel=1e-6)
    assert after.detectable["spin"] == pytest.approx(before.detectable["spin"] / 10)
    larger = replace(brownian, center=1e3 * brownian.center)
    before, after = (judge_motion(m, quantity="translation") for m in (brownian, larger))
    assert after.p == pytest.approx(before.p, rel=1e-4)
    assert after.detectable["cage"] == pytest.approx(1e3 * before.detectable["cage"], rel=1e-4)


def test_time_reversal_keeps_the_spectrum(brownian):
    back = replace(brownian, center=brownian.center[::-1].copy())
    before, after = (judge_motion(m, quantity="translation") for m in (brownian, back))
    for name in ("fractional", "cage", "steady", "line"):
        assert after.p[name] == pytest.approx(before.p[name], rel=1e-4)


PLANTED = {
    "diffusion": None,
    "subdiffusion": Fractional(0.4),
    "superdiffusion": Fractional(1.5),
    "confined": Confined(8 * DT),
    "spin": Spin((0.0, 0.0, 0.4 * 0.05 / DT)),
    "changing D": Switching(10.0, 20 * DT),
}


@pytest.fixture(scope="module")
def verdicts():
    return {
        kind: judge_motion(planted(dynamics, frames=301, seed=11))
        for kind, dynamics in PLANTED.items()
    }


@pytest.mark.parametrize("kind", PLANTED)
def test_planted_motions_get_their_names(verdicts, kind):
    verdict = verdicts[kind]
    assert verdict.kind == kind
    assert (verdict.p_family <= 0.05) == (kind != "diffusion")
    assert (verdict.model is None) == (kind == "diffusion")


NUMBER = r"[\d.]+"
TEXTS = {
    "diffusion": rf"^The rotation is consistent with diffusion \(p = {NUMBER} over 8 tests\); this "
    rf"track could have shown an exponent below {NUMBER} or above {NUMBER}, a cage under {NUMBER} "
    rf"rad, or a spin over {NUMBER} rad/s\.$",
    "subdiffusion": rf"^The rotation is subdiffusive: .* \(p = {NUMBER} for diffusion with a",
    "superdiffusion": r"^The rotation is superdiffusive: ",
    "confined": r"^The rotation is confined: ",
    "spin": rf"^The body turns steadily at {NUMBER}\(\d+\) rad/s while it diffuses \(p ",
    "changing D": r"^The diffusion coefficient of the rotation changes in time",
}


@pytest.mark.parametrize("kind", TEXTS)
def test_a_verdict_is_a_sentence_with_numbers_and_units(verdicts, kind):
    assert re.match(TEXTS[kind], verdicts[kind].text)


def test_a_drift_is_named_with_its_velocity(brownian):
    flow = replace(brownian, center=brownian.center + brownian.time[:, None] * [0.1, 0.0, 0.0])
    verdict = judge_motion(flow, quantity="translation")
    assert verdict.kind == "drift"
    assert re.match(
        r"The body moves steadily at 0\.\d+\(\d+\) um/s while it diffuses", verdict.text
    )
    still = judge_motion(brownian, quantity="translation")
    assert re.search(r"a cage under [\d.]+ um, or a drift over [\d.]+ um/s\.$", still.text)
    assert verdict.model.drift[0][0] == pytest.approx(0.1, abs=4 * verdict.model.drift_stderr[0][0])


def test_drifts_of_several_bodies_are_named_with_their_range(brownian):
    flow = replace(brownian, center=brownian.center + brownian.time[:, None] * [0.1, 0.0, 0.0])
    faster = replace(flow, center=flow.center + brownian.time[:, None] * [0.2, 0.0, 0.0])
    both = judge_motion([flow, faster], quantity="translation")
    assert re.match(
        r"The bodies move steadily, at 0\.095\(13\) to 0\.295\(13\) um/s, while they diffuse",
        both.text,
    )
    assert both.text.endswith("Singly: 2 drift.")


def test_jumps_are_named_with_their_rows(brownian):
    center = brownian.center.copy()
    center[150:] += [1.0, 0.0, 0.0]
    center[220:] -= [0.0, 1.2, 0.0]
    verdict = judge_motion(replace(brownian, center=center), quantity="translation")
    assert verdict.kind == "jumps"
    assert set(verdict.frames) == {150, 220}


def test_a_vibration_is_named_with_its_period(brownian):
    shaken = brownian.center.copy()
    shaken[:, 0] += 0.5 * np.sin(2 * np.pi * brownian.time / (20 * DT))
    verdict = judge_motion(replace(brownian, center=shaken), quantity="translation")
    assert verdict.kind == "vibration"
    period = float(re.search(r"period of ([\d.]+) s", verdict.text).group(1))
    assert period == pytest.approx(20 * DT, rel=0.03)  # a mode is 1/30 of the frequency wide


def test_noise_that_grows_is_not_called_a_changing_diffusion():
    rng = np.random.default_rng(8)
    truth = perrin.simulate_motion(TETRAHEDRON, D_R=D_R, D_T=1e-4, dt=DT, n_frames=401, rng=rng)
    sigma = np.linspace(0.01, 0.05, 401)[:, None, None]
    x = truth.positions() + sigma * rng.standard_normal((401, 4, 3))
    verdict = judge_motion(perrin.track_rotation(x, dt=DT), quantity="translation")
    assert verdict.p_family < 0.05
    assert verdict.kind == "diffusion"
    assert "noise" in verdict.text


@pytest.mark.parametrize("growing", ["D", "noise"])
def test_without_residuals_the_larger_score_tells_noise_from_D(brownian, growing):
    rng = np.random.default_rng(5)
    size = np.linspace(0.4, 1.6, 301)[:, None]
    D, noise = (size if growing == name else np.ones((301, 1)) for name in ("D", "noise"))
    walk = np.cumsum(0.1 * D * rng.normal(size=(301, 3)), axis=0)
    center = walk + 0.1 * noise * rng.normal(size=(301, 3))
    motion = replace(brownian, center=center, residual=np.full(301, 0.03))
    verdict = judge_motion(motion, quantity="translation")
    assert verdict.p_family < 0.05
    assert verdict.kind == ("changing D" if growing == "D" else "diffusion")


@pytest.mark.parametrize(
    ("errors", "kind"), [(3.2, "diffusion"), (-3.2, "diffusion"), (2.8, "changing D")]
)
def test_residuals_that_change_beyond_three_errors_tell_noise_from_D(brownian, errors, kind):
    rng, direction = np.random.default_rng(6), 1 if errors > 0 else -1
    size = np.linspace(0.4, 1.6, 301)[::direction, None]
    center = np.cumsum(0.1 * size * rng.normal(size=(301, 3)), axis=0)
    center += 0.1 * rng.normal(size=(301, 3))
    # The squares are correlated with time by this number of errors, 1/sqrt(301) each.
    t, share = np.linspace(-1, 1, 301), errors / np.sqrt(301)
    other = np.sqrt(1 - share**2) * np.where(np.arange(301) % 2, 1, -1)
    square = 1 + 0.05 * (share * t / t.std() + other)
    motion = replace(brownian, center=center, residual=0.03 * np.sqrt(square))
    assert judge_motion(motion, quantity="translation").kind == kind


def test_several_motions_show_what_one_cannot():
    motions = [planted(Fractional(0.75), frames=301, seed=100 + 3 * k) for k in range(4)]
    verdict = judge_motion(motions)
    assert verdict.kind == "subdiffusion"
    assert len(verdict.each) == 4
    reach = 1 - verdict.detectable["alpha_below"]
    assert reach < 0.6 * min(1 - one.detectable["alpha_below"] for one in verdict.each)


@pytest.mark.parametrize("kind", PLANTED)
def test_a_verdict_comes_back_from_json(verdicts, kind):
    verdict = replace(verdicts[kind], each=(verdicts["diffusion"],))
    entry = json.loads(json.dumps(verdict.to_dict(), allow_nan=False))
    again = MotionVerdict.from_dict(entry)
    assert again.to_dict() == verdict.to_dict()
    assert str(again) == verdict.text


def test_what_cannot_be_judged_is_refused():
    with pytest.raises(perrin.TooFewFramesError, match="19 steps"):
        judge_motion(planted(frames=20))
    still = perrin.simulate_motion(TETRAHEDRON, D_R=D_R, dt=DT, n_frames=50, rng=1)
    with pytest.raises(ValueError, match="does not move"):
        judge_motion(still, quantity="translation")
    with pytest.raises(ValueError, match=r"quantity.*; noise"):
        judge_motion(still, quantity="speed", noise="loud")


def test_the_law_of_a_score_is_that_of_its_modes(repeats):
    """Half the sum of g (chi-squared - 1), few large and many small modes: p is uniform."""
    rng, g = np.random.default_rng(3), np.concatenate([[-0.8, -0.6, -0.4], np.full(200, 0.05)])
    draws = repeats(8_000, 200_000)
    value = 0.5 * (rng.chisquare(1, (draws, len(g))) - 1) @ g
    one = Score.of(value[:1], g[None, None], information=np.array([0.5 * g @ g]))
    score = Score(value, np.tile(one.variance, draws), np.tile(one.third, draws))
    for one_sided in (True, False):
        p = score_p(score, one_sided=one_sided)
        for level in (0.01, 0.05, 0.5, 0.95):
            error = np.sqrt(level * (1 - level) / draws)
            assert np.mean(p < level) == pytest.approx(level, abs=4 * error + 0.05 * level)
    near = np.linspace(-0.01, 0.01, 21)  # through 0, where the saddle point is at 0
    tail = score_p(Score(near, *(np.tile(x, 21) for x in one[1:])), one_sided=True)
    assert np.abs(np.diff(tail, 2)).max() < 0.01 * np.abs(np.diff(tail)).max()
