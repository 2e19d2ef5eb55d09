"""Relaxation of orientation correlations: noise, errors, relaxation times, exponents, refusals."""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from brownian_motions import assert_same_fields, brownian_motion, motion_with_gaps
from perrin import (
    Cluster,
    RelaxationEstimate,
    TooFewFramesError,
    add_noise,
    fit_relaxation,
    msad,
    orientation_correlation,
    simulate_motion,
    track_rotation,
)
from perrin.curves import (
    LagCurve,
    correlation_covariance,
    correlation_variances,
    product_weights,
)


def brownian(seed, n_frames=401, *, D=1e-2, s=0.0, gaps=0.0):
    """Return a Brownian motion whose covariance is that of its orientation noise."""
    motion = brownian_motion(seed, np.arange(float(n_frames)), D_R=D, angle_noise=s, gaps=gaps)
    return replace(motion, covariance=np.tile(s * np.eye(3), (n_frames, 1, 1)))


@cache
def both_degrees(seed, n_frames=1001):
    """Return the curves of both degrees of one motion with noise, D dt = 0.01 and SNR 5."""
    motion = brownian(seed, n_frames, s=2e-3)
    return tuple(orientation_correlation(motion, degree=degree) for degree in (1, 2))


@pytest.mark.parametrize("degree", [1, 2])
def test_noise_is_taken_out_by_direction(degree):
    """Noise S divides the curve of p by exp(-l(l + 1)(tr S - p.S p)/2), for every lag.

    Of the S that rigid fits state to first order the second order is 1 + 3.6 tr S/3.
    """
    S = np.diag([1e-3, 2e-3, 4e-3])
    motion = brownian(1, 100)
    motion = replace(motion, covariance=np.tile(S, (100, 1, 1)))
    for p, across in (([1.0, 0, 0], 6e-3), ([0, 0, 2.0], 3e-3), ([1.0, 1.0, 0], 5.5e-3)):
        raw = orientation_correlation(motion, degree=degree, directions=p, noise=None)
        clean = orientation_correlation(motion, degree=degree, directions=p, noise="residual")
        factor = np.exp(degree * (degree + 1) * across / 2 * (1 + 3.6 * 7e-3 / 3))
        np.testing.assert_allclose(clean.value, factor * raw.value, rtol=1e-9)
        assert raw.noise == pytest.approx(across / 2)


@pytest.mark.parametrize("noise", ["residual", "joint"])
def test_the_corrected_curve_is_that_of_the_true_orientations(noise, repeats):
    """Tetrahedra of SNR 0.5, 5 tracks (long: 100): C_l within 0.2 % and 3 errors at 1 to 3 steps.

    The noise of the particles is 0.23 of the radius, where the noise of the orientations is 7 %
    above its first order.
    """
    D, lag = 1e-2, np.arange(1, 4)
    body = Cluster.tetrahedron(1.5)
    runs = []
    for seed in range(repeats(5, 100)):
        true = simulate_motion(body, D_R=D, dt=1.0, n_frames=2001, rng=[seed, 1])
        x = add_noise(true.positions(), sigma=0.231 * body.R, rng=[seed, 2])
        runs.append(track_rotation(x, dt=1.0))
    for degree in (1, 2):
        truth = np.exp(-degree * (degree + 1) * D * lag)
        values = [
            orientation_correlation(m, degree=degree, noise=noise).value[:3] / truth for m in runs
        ]
        error = np.std(values, axis=0, ddof=1) / np.sqrt(len(values))
        assert np.all(np.abs(np.mean(values, axis=0) - 1) < 2e-3 + 3 * error)


@pytest.mark.parametrize("gaps", [0.0, 0.3])
def test_the_stated_error_is_the_scatter(gaps, repeats):
    """25 tracks (long: 400) with and without gaps: within 15 % and three Monte-Carlo errors."""
    lag, n = np.array([1, 5, 20, 50, 100]), repeats(25, 400)
    curves = [orientation_correlation(brownian(seed, s=2e-3, gaps=gaps)) for seed in range(n)]
    scatter = np.std([c.value[lag - 1] for c in curves], axis=0, ddof=1)
    stated = np.mean([c.stderr[lag - 1] for c in curves], axis=0)
    assert np.all(np.abs(np.log(stated / scatter)) < 0.15 + 3 / np.sqrt(2 * n))


def test_independent_rotations_have_the_variance_of_their_characters():
    """Uniform steps: <P_l^2> = 1/(2l + 1) of one direction; covariances are symmetric."""
    one = np.ones(3)
    lag = np.array([1.0, 2.0, 7.0])
    for degree in (1, 2):
        weights = product_weights(np.array([[0.0, 0.0, 1.0]]), degrees=(degree, degree))
        assert weights.sum() == pytest.approx(1)
        for D in (20.0, 0.02):
            matrix = correlation_covariance(
                (lag, lag), degrees=(degree, degree), weights=weights, blocks=[50, 30],
                present=(one, one), D=D, s=1e-3,
            )  # fmt: skip
            np.testing.assert_allclose(matrix, matrix.T, rtol=1e-12)
            assert np.linalg.eigvalsh(matrix).min() > 0
            if D > 1:
                assert matrix[0, 0] == pytest.approx(1 / (80 * (2 * degree + 1)))


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize(("D", "s"), [(1e-3, 0.0), (0.02, 1e-3), (20.0, 0.1), (0.0, 0.01)])
def test_the_variance_of_a_lag_is_the_diagonal_of_the_covariance(degree, D, s):
    """Both sums agree for several stretches, missing frames, slow and fast rotation, and noise."""
    lag = np.array([1, 2, 3, 7, 29, 30, 49, 50, 200])
    weights = product_weights(np.eye(3)[:2], degrees=(degree, degree))
    for present in (np.ones(9), np.linspace(0.6, 1, 9)):
        given = {"weights": weights, "blocks": [50, 30, 50, 300], "D": D, "s": s}
        found = correlation_variances(lag, degree=degree, present=present, **given)
        matrix = correlation_covariance(
            (1.0 * lag, 1.0 * lag), degrees=(degree, degree), present=(present, present), **given
        )
        # Slow rotation: differences of exponentials near 1, of which digits are lost.
        np.testing.assert_allclose(found, matrix.diagonal(), rtol=1e-7)


def shaped(curve, values):
    """Return a curve with other values."""
    return replace(curve, value=values, components=values[:, None].copy())


def test_an_exponential_and_a_stretched_one_come_back():
    """tau, amplitude and beta to 1e-4 whatever the amplitude; both degrees of diffusion: 3."""
    one, two = both_degrees(0)
    t = one.lagtime
    found = fit_relaxation(shaped(one, 0.8 * np.exp(-t / 60)), shaped(two, 0.7 * np.exp(-t / 20)))
    assert found.tau == pytest.approx(60, rel=1e-4)
    assert found.amplitude == pytest.approx(0.8, rel=1e-4)
    assert found.beta == pytest.approx(1, rel=1e-4)
    assert not found.stretched
    assert found.ratio == pytest.approx(3, rel=1e-4)
    assert found.relaxations == pytest.approx(1000 / 60, rel=1e-4)
    stretched = fit_relaxation(shaped(one, 0.9 * np.exp(-((t / 10) ** 0.5))))
    assert stretched.beta == pytest.approx(0.5, rel=1e-3)
    assert stretched.stretched
    assert "stretched below" in stretched.text
    assert stretched.ratio is None


def test_planted_times_come_back_within_their_errors(repeats):
    """10 tracks (long: 300) of 20 tau_1: means, errors and cover of tau, beta and tau_1/tau_2."""
    n = repeats(10, 300)
    pairs = [both_degrees(seed) for seed in range(n)]
    found = [fit_relaxation(*pair) for pair in pairs]
    second = [fit_relaxation(pair[1]) for pair in pairs]
    for values, errors, truth in (
        ([e.tau for e in found], [e.stderr for e in found], 50),
        ([e.tau for e in second], [e.stderr for e in second], 50 / 3),
        ([e.beta for e in found], [e.beta_stderr for e in found], 1),
        ([e.beta for e in second], [e.beta_stderr for e in second], 1),
        ([e.ratio for e in found], [e.ratio_stderr for e in found], 3),
    ):
        scatter = np.std(values, ddof=1)
        assert np.mean(values) == pytest.approx(truth, abs=0.06 * truth + 3 * scatter / np.sqrt(n))
        assert abs(np.log(np.mean(errors) / scatter)) < 0.2 + 3 / np.sqrt(2 * n)
    cover = np.mean([e.ci95[0] < 50 < e.ci95[1] for e in found])
    assert cover > 0.9 - 3 * np.sqrt(0.09 / n)


def test_relaxation_follows_the_unit_of_time():
    """A tenth of the frame time is a tenth of tau; beta, the ratio and relative errors stay."""
    a = fit_relaxation(*both_degrees(1))
    curves = [replace(c, lagtime=0.1 * c.lagtime, step=0.1 * c.step) for c in both_degrees(1)]
    b = fit_relaxation(*curves)
    assert b.tau == pytest.approx(0.1 * a.tau, rel=1e-6)
    assert b.stderr == pytest.approx(0.1 * a.stderr, rel=1e-6)
    assert (b.beta, b.ratio) == pytest.approx((a.beta, a.ratio), rel=1e-6)
    c = fit_relaxation(*both_degrees(1)[::-1])
    assert (c.ratio, c.ratio_stderr) == pytest.approx((a.ratio, a.ratio_stderr), rel=1e-6)


def test_relaxation_survives_json():
    """to_dict and from_dict, with and without a second curve; so does the curve itself."""
    one, two = both_degrees(2)
    for found in (fit_relaxation(one, two), fit_relaxation(two)):
        back = RelaxationEstimate.from_dict(json.loads(json.dumps(found.to_dict())))
        assert back == found
    assert_same_fields(LagCurve.from_dict(json.loads(json.dumps(one.to_dict()))), one)


def test_what_cannot_be_fitted_is_refused():
    """Other curves, equal degrees, other directions or lags, uncorrelated and resting bodies."""
    motion = motion_with_gaps(3, 300)
    one, two = (orientation_correlation(motion, degree=degree) for degree in (1, 2))
    with pytest.raises(ValueError, match="expected a curve of orientation_correlation"):
        fit_relaxation(msad(motion))
    with pytest.raises(ValueError, match="expected the other degree, got 1 twice"):
        fit_relaxation(one, one)
    other = orientation_correlation(motion, degree=2, directions=[1.0, 0, 0])
    with pytest.raises(ValueError, match="the same directions"):
        fit_relaxation(one, other)
    with pytest.raises(ValueError, match="other lags"):
        fit_relaxation(one, replace(two, lagtime=2 * two.lagtime))
    with pytest.raises(TooFewFramesError, match="record faster"):
        fit_relaxation(orientation_correlation(brownian(1, 100, D=5.0)))
    with pytest.raises(TooFewFramesError, match="does not fall"):
        fit_relaxation(orientation_correlation(brownian(1, 100, D=0.0)))
    with pytest.raises(ValueError, match="noise: expected 'residual', 'joint'"):
        orientation_correlation(motion, noise="loud")
