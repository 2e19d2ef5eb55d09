"""Correlations of translation and rotation, in time and over clusters, and the decoupling ratio."""

from dataclasses import replace

import numpy as np
import pytest

from dense_motions import TETRA, moving, still, switching_speed
from perrin import (
    Cluster,
    CoefficientCorrelation,
    DecouplingRatio,
    MobilityCorrelation,
    TooFewFramesError,
    cluster_mobility,
    decoupling_ratio,
    diffusion_correlation,
    estimate_diffusion,
    simulate_motion,
    translation_rotation_correlation,
)
from perrin.diffusion import (
    DiffusionEstimate,
    Found,
    Noise,
    NoisySteps,
    prediction_errors,
    steps_of,
)
from perrin.geometry.rotations import exp_map


def estimate(value, relative, quantity):
    """Return an estimate with a relative error."""
    return DiffusionEstimate.judged(
        Found.normal(value, relative * value, 0.0, 0.0),
        quantity=quantity,
        method="mle",
        n_frames=300,
        dt=1.0,
        noise_variance=0.0,
    )


def test_common_changes_of_mobility_are_found(repeats):
    """A common tenfold change of D, SNR 5, N = 300: rho is 0.45 on average, and always found."""
    rng = np.random.default_rng(2)
    rho = []
    for _ in range(repeats(3, 100)):
        speed = switching_speed(299, rng, ratio=10, dwell=20)
        found = translation_rotation_correlation(moving(speed, speed, rng))
        assert found.p < 0.01
        assert found.variance_factor > 1.2
        rho.append(found.value)
    assert abs(np.mean(rho) - 0.45) < 3 * 0.06 / np.sqrt(len(rho)) + 0.01
    assert "at the same times" in found.text


def test_intermittent_but_independent_motions_are_not_called_correlated(repeats):
    """The variance corrected for intermittency: 5 % false alarms, where the plain one has 22 %."""
    rng = np.random.default_rng(3)
    count = repeats(10, 400)
    z = []
    for _ in range(count):
        one, other = (switching_speed(299, rng, ratio=10, dwell=20) for _ in range(2))
        found = translation_rotation_correlation(moving(one, other, rng))
        assert found.ci95[0] < found.ci68[0] < found.value < found.ci68[1] < found.ci95[1]
        z.append(found.value / found.stderr)
    assert abs(np.std(z) - 1) < 3 / np.sqrt(2 * count) + 0.1
    assert np.mean(np.abs(z) > 1.96) < 0.05 + 3 * np.sqrt(0.05 / count)


def test_the_correlation_does_not_depend_on_frame_and_unit():
    """Another lab frame, origin, unit of length or time: the same rho."""
    rng = np.random.default_rng(4)
    speed = switching_speed(199, rng, ratio=10, dwell=20)
    motion = moving(speed, speed, rng)
    turn = exp_map(np.array([[0.3, -1.0, 0.7]]))[0]
    other = replace(
        motion,
        center=7 * motion.center @ turn.T + 5,
        rotation=turn @ motion.rotation,
        time=3 * motion.time,
        dt=3.0,
    )
    one, two = (translation_rotation_correlation(m) for m in (motion, other))
    assert two.value == pytest.approx(one.value, abs=1e-3)  # ranks may be exchanged by rounding
    both = translation_rotation_correlation([motion, motion])
    assert both.value == pytest.approx(one.value)
    assert both.stderr == pytest.approx(one.stderr / np.sqrt(2))
    assert both.n_steps == 398
    assert MobilityCorrelation.from_dict(one.to_dict()) == one


def test_prediction_errors_are_independent_normal_numbers():
    """With gaps and noise: variance 1 and no correlation of neighbours, where steps have -0.3."""
    rng = np.random.default_rng(5)
    motion = moving(np.ones(1999), np.ones(1999), rng, snr=1.0)
    center, rotation = np.array(motion.center), np.array(motion.rotation)
    missing = 1 + np.flatnonzero(rng.random(1998) < 0.2)
    center[missing], rotation[missing] = np.nan, np.nan
    steps = steps_of(replace(motion, center=center, rotation=rotation), "translation")
    errors = prediction_errors(NoisySteps.of(steps, Noise()))
    sd = 1 / np.sqrt(errors.size)
    assert abs(np.mean(errors**2) - 1) < 4 * np.sqrt(2) * sd
    assert abs(np.mean(errors[1:] * errors[:-1])) < 4 * sd
    assert np.mean(steps.vectors[1:] * steps.vectors[:-1]) / np.mean(steps.vectors**2) < -0.2


def test_attenuation_of_the_correlation_over_clusters(repeats):
    """Spread 0.3 and errors of 0.15 lower a correlation of 1 to 0.80; the corrected one is 1."""
    rng = np.random.default_rng(6)
    measured, corrected, inside = [], [], []
    for _ in range(repeats(30, 1000)):
        log = 0.3 * rng.normal(size=40)
        errors = np.exp(0.15 * rng.normal(size=(2, 40)))
        D_T = [estimate(0.04 * x, 0.15, "translation") for x in np.exp(log) * errors[0]]
        D_R = [estimate(5e-3 * x, 0.15, "rotation") for x in np.exp(log) * errors[1]]
        found = diffusion_correlation(D_T, D_R)
        measured.append(found.measured)
        if found.value is None:
            continue
        corrected.append(found.value)
        inside.append(found.ci95[0] <= 1 <= found.ci95[1])
    count = len(corrected)
    assert count > 0.98 * len(measured)
    assert abs(np.mean(measured) - 0.80) < 3 * np.std(measured) / np.sqrt(count) + 0.005
    assert abs(np.mean(corrected) - 1) < 3 * np.std(corrected) / np.sqrt(count) + 0.01
    assert np.mean(inside) > 0.95 - 3 * np.sqrt(0.05 / count)
    assert found.p < 1e-6
    assert CoefficientCorrelation.from_dict(found.to_dict()) == found
    swapped = diffusion_correlation(D_T[::-1], D_R[::-1])
    assert swapped.value == pytest.approx(found.value)


def test_without_spread_there_is_no_corrected_correlation():
    """Where the errors explain the scatter, the value is None and the reason is stated."""
    rng = np.random.default_rng(7)
    D_T = [estimate(x, 0.1, "translation") for x in 0.04 * np.exp(0.1 * rng.normal(size=30))]
    D_R = [estimate(x, 0.1, "rotation") for x in 5e-3 * np.exp(0.5 * rng.normal(size=30))]
    found = diffusion_correlation(D_T, D_R)
    assert (found.value, found.stderr, found.ci95, found.attenuation) == (None,) * 4
    assert "errors of D_T are as large as the spread" in found.text
    assert CoefficientCorrelation.from_dict(found.to_dict()) == found
    few = diffusion_correlation(D_R_as_T := [replace(x, unit="um^2/s") for x in D_R[:9]], D_R[:9])
    assert few.reason == "fewer than 30 clusters"
    with pytest.raises(ValueError, match=r"same length.*got 9 and 2; D_T\[0\]: .*D_R\[1\]"):
        diffusion_correlation(D_R[:9], [D_R[0], D_R_as_T[1]])


def test_the_decoupling_ratio_of_a_dilute_body_is_one():
    """Viscosity and temperature cancel; the ends are log-normal; a slower rotation is named."""
    conditions = (
        {"viscosity": 2.18e-3, "temperature": 295},
        {"viscosity": 0.1, "temperature": 320},
    )
    bodies = [cluster_mobility(Cluster.touching(4, 2.45), radius=1.225, **c) for c in conditions]
    motion = simulate_motion(bodies[0], dt=0.7, n_frames=1500, rng=3)
    D_T, D_R = (estimate_diffusion(motion, quantity=q) for q in ("translation", "rotation"))
    first, second = (decoupling_ratio(D_T, D_R, mobility=body) for body in bodies)
    assert second.value == pytest.approx(first.value, rel=1e-9)
    assert abs(first.value - 1) < 3 * first.stderr
    assert np.prod(first.ci95) == pytest.approx(first.value**2)
    assert first.stderr / first.value == pytest.approx(
        np.hypot(D_T.stderr / D_T.value, D_R.stderr / D_R.value)
    )
    slow = decoupling_ratio(D_T, estimate(D_R.value / 4, 0.1, "rotation"), mobility=bodies[0])
    assert slow.value == pytest.approx(4 * first.value)
    assert slow.p < 1e-6
    assert "rotation is slowed more" in slow.text
    assert DecouplingRatio.from_dict(slow.to_dict()) == slow
    with pytest.raises(ValueError, match=r"D_T: expected a positive value \(um\^2/s\).*D_R: "):
        decoupling_ratio(D_R, D_T, mobility=bodies[0])


def test_motions_that_cannot_be_correlated_are_refused():
    """Few steps, or no translation at all."""
    with pytest.raises(TooFewFramesError, match="motion 0: 9 steps"):
        translation_rotation_correlation(still(10))
    moved = simulate_motion(TETRA, D_R=1e-3, D_T=0.1, dt=1.0, n_frames=30, rng=1)
    with pytest.raises(ValueError, match="motion 1: no translation"):
        translation_rotation_correlation([moved, still(30)])
