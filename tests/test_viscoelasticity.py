"""Viscoelastic moduli from the motion of a cluster."""

import json
from dataclasses import replace
from math import gamma

import numpy as np
import pytest

from dense_motions import fractional_walk
from perrin import (
    Cluster,
    Moduli,
    cluster_mobility,
    msad,
    msad_vector,
    msd,
    simulate_motion,
    viscoelastic_moduli,
)
from perrin.diffusion import GridLags, curve_covariance, msd_covariance

KT = 1.380649e-23 * 300 * 1e18  # Pa um^3
SPHERE = Cluster(np.zeros((1, 3)), diameter=2.0)
BODY = cluster_mobility(Cluster.touching(4, 2.0), radius=1.0, viscosity=5e-3, temperature=300)


def fluid_curve(rng, *, alpha=0.5, snr=5.0, n_frames=300, D=1e-3):
    """Return the MSD of a sphere in a power-law fluid, with its noise as `LagCurve.noise`."""
    walk = np.sqrt(2 * D) * fractional_walk(n_frames, rng, alpha=alpha)
    walk += np.sqrt(D / snr) * rng.normal(size=walk.shape)
    return replace(msd(walk[:, None], dt=1.0), noise=D / snr)


def true_modulus(lag, *, alpha=0.5, D=1e-3):
    """Return |G*| of that fluid about a sphere of radius 1 um (Mason 2000), Pa."""
    return KT / (np.pi * 6 * D * lag**alpha * gamma(1 + alpha))


@pytest.mark.parametrize("make", [msad, msad_vector, msd])
def test_a_newtonian_fluid_has_its_viscosity(make):
    """Rotation and translation of any body: G'' = viscosity times frequency, G' = 0."""
    motion = simulate_motion(BODY, dt=0.5, n_frames=1500, rng=4)
    found = viscoelastic_moduli(make(motion), cluster=BODY, temperature=300)
    fast = found.frequency > 0.1
    loss = 5e-3 * found.frequency
    error = np.diff(found.loss_ci68, axis=1)[:, 0] / 2
    assert np.all(np.abs(found.loss - loss)[fast] < 3.5 * error[fast])
    error = np.diff(found.storage_ci68, axis=1)[:, 0] / 2
    assert np.all(np.abs(found.storage)[fast] < 3.5 * error[fast])
    assert found.reliable[-1]
    assert found.frequency[-1] == pytest.approx(2.0)


@pytest.mark.parametrize("noise", ["joint", "residual"])
def test_a_power_law_fluid_comes_back_within_its_band(noise, repeats):
    """Exponent 0.5 with noise: no bias, and the bands cover 68 %."""
    rng = np.random.default_rng(7)
    count = repeats(6, 150)
    log, alpha, inside = [], [], []
    for _ in range(count):
        curve = fluid_curve(rng)
        found = viscoelastic_moduli(curve, cluster=SPHERE, temperature=300, noise=noise)
        lag = 1 / found.frequency[[-1, 0]]  # the first and the last lag
        truth = true_modulus(lag)
        log.append(np.log(found.modulus[[-1, 0]] / truth))
        alpha.append(found.exponent[[-1, 0]])
        for band, true in (
            (found.modulus_ci68, truth),
            (found.exponent_ci68, 0.5),
            (found.storage_ci68, truth * np.cos(np.pi / 4)),
            (found.loss_ci68, truth * np.sin(np.pi / 4)),
        ):
            low, high = band[[-1, 0]].T
            inside.append((low <= true) & (true <= high))
    scatter = np.std(log, axis=0, ddof=1) / np.sqrt(count)
    assert np.all(np.abs(np.mean(log, axis=0)) < 3 * scatter + 0.05)
    scatter = np.std(alpha, axis=0, ddof=1) / np.sqrt(count)
    assert np.all(np.abs(np.mean(alpha, axis=0) - 0.5) < 3 * scatter + 0.02)
    assert abs(np.mean(inside) - 0.68) < 0.08 + 3 * np.sqrt(0.22 / (2 * count))


def test_units_of_length_time_and_temperature():
    """Lengths times 2: moduli over 8; times times 3: frequencies over 3; moduli grow with kT."""
    curve = fluid_curve(np.random.default_rng(8))
    one = viscoelastic_moduli(curve, cluster=SPHERE, temperature=300)
    large = replace(
        curve, value=4 * curve.value, lagtime=3 * curve.lagtime, step=3.0, noise=4 * curve.noise
    )
    other = viscoelastic_moduli(
        large, cluster=Cluster(np.zeros((1, 3)), diameter=4.0), temperature=330
    )
    np.testing.assert_allclose(other.frequency, one.frequency / 3, rtol=1e-9)
    np.testing.assert_allclose(other.storage, one.storage * 1.1 / 8, rtol=1e-5)
    np.testing.assert_allclose(other.loss_ci68, one.loss_ci68 * 1.1 / 8, rtol=1e-5)
    np.testing.assert_allclose(np.hypot(one.storage, one.loss), one.modulus, rtol=1e-12)
    assert other.offset == pytest.approx(4 * one.offset, rel=1e-4)


def test_known_noise_narrows_the_band():
    """At the first lag the fitted offset is the largest error; the known one has none."""
    curve = fluid_curve(np.random.default_rng(9))
    joint, known = (
        viscoelastic_moduli(curve, cluster=SPHERE, temperature=300, noise=noise)
        for noise in ("joint", "residual")
    )
    width = [np.log(m.modulus_ci68[-1, 1] / m.modulus_ci68[-1, 0]) for m in (joint, known)]
    assert width[1] < width[0] / 2
    assert known.offset == curve.noise
    assert abs(joint.offset - curve.noise) < 3.5 * joint.offset_stderr


@pytest.mark.parametrize("missing", [0.0, 0.3])
def test_the_covariance_of_a_brownian_curve_is_the_closed_one(missing):
    """The sum over pairs equals the polynomials of a Brownian walk, gaps and pieces included."""
    rng = np.random.default_rng(10)
    walk = rng.normal(size=(120, 1, 3)).cumsum(axis=0)
    walk[1 + np.flatnonzero(rng.random(118) < missing)] = np.nan
    lags = GridLags.of(msd(walk, dt=1.0)).take(np.array([0, 1, 4, 11, 39]))
    lags = replace(lags, present=np.full(lags.size, np.sqrt(1 - missing)))
    structure = 0.7 * np.arange(120.0) + 0.4
    structure[0] = 0.0
    closed = msd_covariance(lags.steps, 119, present=lags.present, D=0.7, s=0.4) / 4 / 3
    np.testing.assert_allclose(curve_covariance(lags, structure), closed, rtol=1e-9)


def test_results_go_to_tables_and_json():
    """Every column and its band; JSON both ways; the sentence states the range."""
    found = viscoelastic_moduli(
        fluid_curve(np.random.default_rng(11)), cluster=SPHERE, temperature=300
    )
    table = found.to_frame()
    assert np.array_equal(table["storage_low"], found.storage_ci68[:, 0])
    again = Moduli.from_dict(json.loads(json.dumps(found.to_dict())))
    assert again.to_dict() == found.to_dict()
    assert again.reliable.dtype == bool
    assert "known within a factor of 1.5 from" in found.text


def test_a_steady_drift_has_no_positive_storage_modulus():
    """Ballistic motion: the exponent is 2, far beyond that of a fluid, and nothing fails."""
    time = np.arange(300.0)[:, None, None]
    walk = 0.01 * time + np.random.default_rng(2).normal(size=(300, 1, 3)).cumsum(axis=0) * 1e-3
    found = viscoelastic_moduli(msd(walk, dt=1.0), cluster=SPHERE, temperature=300)
    np.testing.assert_allclose(found.exponent, 2, atol=0.05)
    assert np.all(found.storage < 0)


def test_faults_are_named():
    """All faults of one call in one message; a curve too short; a noise that is not known."""
    curve = msd(np.random.default_rng(1).normal(size=(300, 1, 3)).cumsum(axis=0), dt=1.0)
    single = Cluster(np.zeros((1, 3)))
    with pytest.raises(
        ValueError, match=r"kelvin.*noise: .*quantity: the curve.*cluster: a single"
    ):
        viscoelastic_moduli(
            curve, cluster=single, temperature=22, quantity="rotation", noise="known"
        )
    with pytest.raises(ValueError, match="has no residuals"):
        viscoelastic_moduli(curve, cluster=SPHERE, temperature=300, noise="residual")
    with pytest.raises(ValueError, match="does not move"):
        viscoelastic_moduli(msd(np.zeros((300, 1, 3)), dt=1.0), cluster=SPHERE, temperature=300)
    short = simulate_motion(BODY, dt=0.5, n_frames=30, rng=4)
    with pytest.raises(ValueError, match="3 lags with data up to a tenth"):
        viscoelastic_moduli(short, cluster=BODY, temperature=300)
