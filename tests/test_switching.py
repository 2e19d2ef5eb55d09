"""Two states of diffusion: the likelihood against exact sums, and planted states come back."""

import itertools
import json
from dataclasses import replace

import numpy as np
import pytest

from perrin import (
    Cluster,
    Noise,
    Switching,
    SwitchingEstimate,
    TooFewFramesError,
    add_noise,
    fit_switching,
    simulate_motion,
    track_rotation,
)
from perrin.diffusion import Likelihood, NoisySteps, SwitchingSteps, steps_of
from perrin.motion import fast_states

BODY = Cluster.tetrahedron(1.5)
PLANE = Cluster.from_positions([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
PLANTED = Switching(10, dwell=20.0)


def noisy(n_frames=301, *, seed=1, dynamics=PLANTED, cluster=BODY, sigma=0.0115, dt=1.0, missing=0):
    """Return a noisy motion (SNR about 5 in both quantities); some frames may be missing."""
    truth = simulate_motion(
        cluster, D_R=1e-3 / dt, D_T=2e-4 / dt, dt=dt, n_frames=n_frames, dynamics=dynamics, rng=seed
    )
    positions = add_noise(truth.positions(), sigma=sigma, rng=seed + 100)
    if missing:
        gone = np.random.default_rng(seed).choice(
            np.arange(1, n_frames - 1), missing, replace=False
        )
        positions[gone] = np.nan
    return track_rotation(positions, dt=dt)


def switching_steps(motion, *, quantity="rotation", noise=None, exposed=0.0):
    """Return the steps of a motion for the model of two states, and their NoisySteps."""
    track = NoisySteps.of(steps_of(motion, quantity), noise or Noise())
    return SwitchingSteps.of(track, motion.time, exposed=exposed), track


def enumerated(steps, point):
    """Return log-likelihood and probability of "fast" by summing over all state sequences."""
    s, track = steps.track.steps, steps.track
    D, rate, theta = np.exp(point[:2]), np.exp(point[2:4]), np.exp(point[4])
    theta = theta if np.isfinite(track.freedom) else track.theta
    common, b = track.blur - steps.exposed, steps.exposed
    before, after = (
        theta * w + k - common * D[0] for w, k in zip(track.weight, track.known, strict=True)
    )
    paths = np.array(list(itertools.product((0, 1), repeat=len(s.duration))))
    changed = paths[:, 1:] != paths[:, :-1]
    change = rate[paths[:, :-1]] / rate.sum() * -np.expm1(-rate.sum() * steps.elapsed[1:])
    logs = np.log(rate[::-1] / rate.sum())[paths[:, 0]]
    logs += np.log(np.where(changed, change, 1 - change)).sum(axis=1)
    linked = np.flatnonzero(s.linked)
    for a, y in enumerate(s.vectors.T):
        # The blur of a frame is that of the state before it.
        earlier = np.concatenate([paths[:, :1], paths[:, :-1]], axis=1)
        blurred = 2 * D[paths] * (s.duration - 2 * b) + 2 * b * D[earlier]
        C = np.eye(len(y)) * (blurred + before[:, a] + after[:, a])[:, None]
        C[:, linked, linked + 1] = b * D[paths[:, linked]] - after[linked, a]
        C[:, linked + 1, linked] = C[:, linked, linked + 1]
        columns = np.broadcast_to(y[:, None], (len(C), len(y), 1))
        logs -= 0.5 * (np.linalg.slogdet(C)[1] + np.linalg.solve(C, columns)[..., 0] @ y)
    weight = np.exp(logs - logs.max())
    return logs.max() + np.log(weight.sum()), weight @ paths / weight.sum()


# ---- the likelihood -----------------------------------------------------------------------------


@pytest.mark.parametrize("quantity", ["rotation", "translation"])
@pytest.mark.parametrize("noise", [Noise(), Noise("residual"), Noise(0.02, exposure=0.5)])
@pytest.mark.parametrize("missing", [0, 12])
def test_equal_coefficients_are_brownian(quantity, noise, missing):
    """With D_slow = D_fast the likelihood is the exact one of one D, gaps and all, at any rate."""
    exposed = (noise.exposure or 0.0) / 3
    steps, track = switching_steps(
        noisy(40, missing=missing), quantity=quantity, noise=noise, exposed=exposed
    )
    D, theta = 8e-4, max(track.theta, 1e-4)
    value = Likelihood.of([track]).sums(np.array([D]), np.array([theta])).value[0]
    points = np.log([[D, D, 0.1, 0.02, theta], [D, D, 1.0, 3.0, theta]])
    np.testing.assert_allclose(steps.filtered(points)[0], value, rtol=1e-10)


def test_without_noise_it_is_the_sum_over_all_state_sequences():
    """The hidden Markov model and its state probabilities are exact, over gaps and cuts."""
    motion = noisy(11, sigma=0.0, missing=2)
    motion = replace(motion, piece=np.repeat([0, 1], [5, 6]))
    steps, _ = switching_steps(motion, noise=Noise(0.0))
    point = np.log([2e-4, 1.8e-3, 0.05, 0.15, 1.0])
    value, fast = enumerated(steps, point)
    assert steps.filtered(point[None])[0][0] == pytest.approx(value, rel=1e-12)
    np.testing.assert_allclose(steps.fast_probability(point), fast, rtol=1e-9)


def test_with_noise_it_is_nearly_that_sum():
    """The shared noise is merged to one normal law a state: an error of 0.01 in the logarithm.

    That in the probability of a state is 0.03 at most, with motion blur.
    """
    for seed in range(4):
        exposure = seed / 3
        steps, _ = switching_steps(
            noisy(9, seed=seed), noise=Noise(0.0115, exposure=exposure), exposed=exposure / 3
        )
        point = np.log([2e-4, 1.8e-3, 0.05, 0.05, 1.0])
        value, fast = enumerated(steps, point)
        assert steps.filtered(point[None])[0][0] == pytest.approx(value, abs=0.01)
        np.testing.assert_allclose(steps.fast_probability(point), fast, atol=0.04)


def test_slopes_and_curvatures_are_those_of_the_value():
    """The quadratic expansion predicts the value nearby to third order."""
    steps, _ = switching_steps(noisy(100))
    point = np.log([2e-4, 1.8e-3, 0.05, 0.05, 2e-4])
    value, slope, curvature = steps.expansion(point)
    move = 0.01 * np.array([1.0, -1.0, 0.5, 2.0, -1.0])
    expected = value + slope @ move + 0.5 * move @ curvature @ move
    assert steps.filtered(point[None] + move)[0][0] == pytest.approx(expected, abs=1e-4)


# ---- planted states -----------------------------------------------------------------------------


@pytest.mark.parametrize("quantity", ["rotation", "translation"])
def test_planted_states_come_back(quantity):
    """Coefficients and dwells lie in their intervals, and 95 % of the states are right."""
    found = fit_switching(noisy(301, seed=4), quantity=quantity)
    D = 1e-3 if quantity == "rotation" else 2e-4
    assert found.two_states
    assert found.unit == ("rad^2/s" if quantity == "rotation" else "um^2/s")
    for parameter, truth in (
        (found.D_slow, D * 2 / 11),
        (found.D_fast, D * 20 / 11),
        (found.D_mean, D),
        (found.dwell_slow, 20.0),
        (found.dwell_fast, 20.0),
    ):
        # The 95 % interval widened by half: all ten hold with a probability of 97 %.
        low, high = np.log(parameter.ci95) - np.log(parameter.value)
        assert 1.5 * low < np.log(truth / parameter.value) < 1.5 * high
    fast = fast_states(1 / 20, 300, generator=np.random.default_rng(4))
    assert np.mean((found.states[0][1:] == 1) == fast) > 0.93
    assert found.states[0][0] == -1
    assert np.isnan(found.probability[0][0])


def test_brownian_motion_is_not_called_two_states():
    """Two states gain less than their penalty, 1.5 ln N, and never less than 0."""
    for seed in range(2):
        found = fit_switching(noisy(81, seed=seed, dynamics=None))
        assert found.bic_gain < 0
        assert found.log_likelihood_gain > -1e-6
        assert "no better" in str(found)


def test_unequal_axes_are_not_two_states():
    """Axes of D_R 1:1:4 widen the law of the steps; scaled to equal axes they gain nothing."""
    body = Cluster.pentahedron(1.5)
    truth = simulate_motion(body, D_R=[1e-3, 1e-3, 4e-3], dt=1.0, n_frames=201, rng=3)
    found = fit_switching(track_rotation(add_noise(truth.positions(), sigma=0.01, rng=4), dt=1.0))
    assert found.bic_gain < -3


def test_the_unit_of_time_has_no_effect():
    """In a thousandth of the time all coefficients are a thousand times as large."""
    one = fit_switching(noisy(81, dt=1.0))
    two = fit_switching(noisy(81, dt=1e-3, dynamics=Switching(10, dwell=0.02)))
    assert two.D_slow.value == pytest.approx(1e3 * one.D_slow.value, rel=1e-6)
    assert two.D_fast.ci95 == pytest.approx(1e3 * np.array(one.D_fast.ci95), rel=1e-4)
    assert two.dwell == pytest.approx(1e-3 * np.array(one.dwell), rel=1e-4)
    assert two.bic_gain == pytest.approx(one.bic_gain, abs=1e-6)
    np.testing.assert_array_equal(two.states[0], one.states[0])


def test_reversed_time_has_the_same_states():
    """The reversed motion has the same coefficients, and its states in reverse order."""
    motion = noisy(81)
    back = replace(
        motion,
        center=motion.center[::-1].copy(),
        rotation=motion.rotation[::-1].copy(),
        residual=motion.residual[::-1].copy(),
    )
    one = fit_switching(motion, quantity="translation")
    two = fit_switching(back, quantity="translation")
    # Only the merging of the noise of two states has a direction.
    assert two.D_slow.value == pytest.approx(one.D_slow.value, rel=0.02)
    assert two.D_fast.value == pytest.approx(one.D_fast.value, rel=0.02)
    assert np.mean(two.states[0][:0:-1] == one.states[0][1:]) > 0.98


def test_a_motion_given_twice_halves_the_variances():
    """Twice the same data have the same maximum, and intervals narrower by the root of two."""
    motion = noisy(81)
    one, two = fit_switching(motion), fit_switching([motion, motion])
    assert two.D_slow.value == pytest.approx(one.D_slow.value, rel=1e-5)
    assert two.dwell == pytest.approx(one.dwell, rel=1e-4)
    width = [np.log(f.D_fast.ci95[1] / f.D_fast.ci95[0]) for f in (one, two)]
    assert width[1] == pytest.approx(width[0] / np.sqrt(2), rel=1e-3)
    assert two.log_likelihood_gain == pytest.approx(2 * one.log_likelihood_gain, rel=1e-6)
    for states in two.states:
        np.testing.assert_array_equal(states, one.states[0])


def test_gaps_are_longer_steps():
    """With a third of the frames missing the coefficients stay, and rows without step are -1."""
    motion = noisy(301, seed=7, missing=100)
    found = fit_switching(motion)
    assert found.two_states
    assert found.D_slow.ci95[0] < 1e-3 * 2 / 11 < found.D_slow.ci95[1]
    assert found.D_fast.ci95[0] < 1e-3 * 20 / 11 < found.D_fast.ci95[1]
    has_step = np.zeros(301, dtype=bool)
    has_step[motion.steps()[1]] = True
    np.testing.assert_array_equal(found.states[0] >= 0, has_step)


def test_the_plane_has_one_angle():
    """A planar body switches in its one angle and its two coordinates."""
    motion = noisy(151, seed=3, cluster=PLANE, sigma=0.003)
    found = fit_switching(motion)
    assert found.two_states
    assert found.D_fast.ci95[0] < 1e-3 * 20 / 11 < found.D_fast.ci95[1]


def test_a_stated_exposure_corrects_the_blur_of_each_state():
    """Frames averaged over all of dt: with exposure=1 both coefficients come back.

    Without it the fast one is low by about (1 - D_slow/D_fast)/3, 30 %.
    """
    fine, frames = 8, 201
    truth = simulate_motion(
        BODY, D_R=0.0, D_T=1e-3, dt=1 / fine, n_frames=frames * fine,
        dynamics=Switching(10, dwell=30.0), rng=5,
    )  # fmt: skip
    positions = truth.positions().reshape(frames, fine, 4, 3).mean(axis=1)
    motion = track_rotation(add_noise(positions, sigma=0.01, rng=6), dt=1.0)
    stated = fit_switching(motion, quantity="translation", exposure=1.0)
    unknown = fit_switching(motion, quantity="translation")
    assert stated.D_fast.ci95[0] < 1e-3 * 20 / 11 < stated.D_fast.ci95[1]
    assert stated.D_slow.ci95[0] < 1e-3 * 2 / 11 < stated.D_slow.ci95[1]
    assert 0.6 < unknown.D_fast.value / stated.D_fast.value < 0.8


# ---- results and refusals -----------------------------------------------------------------------


def test_results_are_converted_to_json_and_back():
    """to_dict is JSON, and from_dict returns the same estimate, open ends included."""
    found = fit_switching(noisy(61))
    found = replace(found, dwell_slow=replace(found.dwell_slow, ci95=(0.0, np.inf)))
    entry = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    again = SwitchingEstimate.from_dict(entry)
    assert again.to_dict() == found.to_dict()
    assert again.dwell_slow.ci95 == (0.0, np.inf)
    np.testing.assert_array_equal(again.states[0], found.states[0])
    np.testing.assert_array_equal(again.probability[0], found.probability[0])
    assert str(again) == str(found)


def test_what_cannot_be_fitted_is_refused():
    """All faults in one message; too few steps; a body at rest; drift."""
    motion = noisy(30)
    with pytest.raises(ValueError, match=r"quantity: .*; noise: "):
        fit_switching(motion, quantity="both", noise="loud")
    with pytest.raises(ValueError, match="no drift"):
        fit_switching(motion, noise=Noise(drift=True))
    with pytest.raises(ValueError, match="all in 2 or all in 3"):
        fit_switching([motion, noisy(30, cluster=PLANE)])
    with pytest.raises(TooFewFramesError, match="19 steps: two states need at least 20"):
        fit_switching(noisy(20))
    still = simulate_motion(BODY, D_R=0.0, dt=1.0, n_frames=50, rng=0)
    with pytest.raises(ValueError, match="D = 0"):
        fit_switching(still)
