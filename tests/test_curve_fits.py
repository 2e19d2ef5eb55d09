"""Fits to curves: the paper's straight line, and the error it really has."""

import dataclasses

import numpy as np
import pytest

from perrin import (
    Cluster,
    LagCurve,
    add_noise,
    fit_line,
    msad,
    msd,
    orientation_correlation,
    simulate_motion,
    track_rotation,
)
from perrin.curve_fits import _covariance, _quadratic_variance


def straight(D, offset, n=200, dt=0.5, dof=2):
    """Return a curve that is a straight line to the last digit."""
    t = dt * np.arange(1, n + 1)
    value = 2 * dof * (D * t + offset)
    return LagCurve(
        lagtime=t,
        value=value,
        components=np.tile(value[:, None] / 3, 3),
        stderr=0.1 * value,
        n_pairs=n + 1 - np.arange(1, n + 1),
        dof=dof,
        quantity="rotation",
        unit="rad^2",
        n_walks=2.0,
    )


@pytest.mark.parametrize(("D", "offset"), [(5e-3, 2e-4), (1e-9, 0.0), (3.0, -0.1)])
@pytest.mark.parametrize("dof", [1, 2, 3])
def test_a_straight_line_is_returned_exactly(D, offset, dof):
    """Value = 2 dof (D t + offset) gives D and offset to 1e-12."""
    found = fit_line(straight(D, offset, dof=dof), lag_range=(3, 22))
    assert found.value == pytest.approx(D, rel=1e-12)
    assert found.offset == pytest.approx(offset, rel=1e-9, abs=1e-12 * D)
    assert (found.method, found.unit) == ("line", "rad^2/s")


def test_lag_range_ends_are_included():
    """Both ends belong to the window, also where dt does not divide them in binary."""
    curve = straight(5e-3, 2e-4, n=30, dt=0.1)
    bent = np.array(curve.value)
    bent[[1, 6]] += 1.0  # 0.2 s and 0.7 s lie just outside 0.3 to 0.6 s
    outside = dataclasses.replace(curve, value=bent)
    assert fit_line(outside, lag_range=(0.3, 0.6)).value == pytest.approx(5e-3, rel=1e-10)
    for index in (2, 5):
        bent = np.array(curve.value)
        bent[index] += 1.0
        inside = dataclasses.replace(curve, value=bent)
        assert abs(fit_line(inside, lag_range=(0.3, 0.6)).value / 5e-3 - 1) > 1


def test_too_few_lags_are_refused_with_the_numbers():
    """A window of two lags, beyond the curve or upside down: refused, and the curve's span said."""
    curve = straight(5e-3, 2e-4)
    for window in ((3.0, 3.6), (200.0, 300.0), (22.0, 3.0)):
        with pytest.raises(ValueError, match=r"at least 3.*from 0.5 to 100 s"):
            fit_line(curve, lag_range=window)
    with pytest.raises(ValueError, match="holds 2 lags"):
        fit_line(curve, lag_range=(3.0, 3.6))


def test_lags_without_data_are_left_out():
    """NaN lags inside the window change nothing on a straight line."""
    curve = straight(5e-3, 2e-4)
    holes = np.array(curve.value)
    holes[[7, 8, 20]] = np.nan
    found = fit_line(dataclasses.replace(curve, value=holes), lag_range=(3, 22))
    assert found.value == pytest.approx(5e-3, rel=1e-12)
    assert np.isfinite(found.stderr)


def test_the_line_knows_its_true_error():
    """Over 300 tracks in the paper's window stderr is the scatter, a quarter of D, within 12 %.

    12 % is 3 Monte-Carlo errors. For D_R it is 6(2) % conservative (measured, 1200 tracks): the
    four directions of a body that has turned are worth more than three walks.
    """
    cluster, lines = Cluster.touching(4, 2.45), {"R": [], "T": []}
    for seed in range(300):
        rng = np.random.default_rng([seed, 11])
        truth = simulate_motion(cluster, D_R=4.93e-3, D_T=3.85e-2, dt=0.73, n_frames=300, rng=rng)
        x = add_noise(truth.positions(), sigma=(0.03, 0.03, 0.04), rng=rng)
        motion = track_rotation(x, dt=0.73)
        lines["R"].append(fit_line(msad(motion), lag_range=(3, 22)))
        lines["T"].append(fit_line(msd(motion), lag_range=(3, 22)))
    for name, truth, percent, excess in (("R", 4.93e-3, 0.25, 1.06), ("T", 3.85e-2, 0.27, 1.0)):
        values = np.array([e.value for e in lines[name]])
        stated = np.mean([e.stderr for e in lines[name]])
        assert stated / excess == pytest.approx(values.std(), rel=0.12)
        assert values.std() / truth == pytest.approx(percent, rel=0.12)
        assert abs(values.mean() - truth) < 3 * values.std() / np.sqrt(len(values))


def dense_forms(N):
    """Return the matrices Q_n of MSD(n) = y.Q_n.y, y the N steps of a walk."""
    forms = np.zeros((N, N, N))
    for lag in range(1, N + 1):
        for start in range(N - lag + 1):
            forms[lag - 1, start : start + lag, start : start + lag] += 1 / (N - lag + 1)
    return forms


@pytest.mark.parametrize("N", [1, 2, 3, 7, 20])
@pytest.mark.parametrize("s", [0.0, 0.8, -0.2])
def test_the_covariance_of_lags_is_a_dense_trace(N, s):
    """cov(MSD(n), MSD(m)) is 2 tr (Q_n C Q_m C), built densely, to 1e-12; negative offsets too."""
    C = (2 * 0.7 + 2 * s) * np.eye(N) - s * (np.eye(N, k=1) + np.eye(N, k=-1))
    QC = dense_forms(N) @ C
    expected = 2 * np.einsum("nij,mji->nm", QC, QC)
    use, complete = np.arange(N), np.ones(N)
    found = _covariance(use, N, seen=complete, D=0.7, s=s)
    np.testing.assert_allclose(found, expected, rtol=1e-12)


@pytest.mark.parametrize("seen", [1.0, 0.6])
def test_both_ways_to_a_variance_agree(seen):
    """Cumulative sums give what the covariance matrix gives, to 1e-10, on any choice of lags."""
    rng = np.random.default_rng(4)
    for use in (np.arange(30), np.array([0, 3, 4, 17, 29]), np.array([25, 28])):
        weights, part = rng.normal(size=use.size), np.full(use.size, seen)
        covariance = _covariance(use, 30, seen=part, D=0.7, s=0.3)
        short = _quadratic_variance(weights, use, 30, seen=part, D=0.7, s=0.3)
        assert short == pytest.approx(weights @ covariance @ weights, rel=1e-10)


def test_missing_frames_add_the_covariance_they_should():
    """Frames missing at random: the mean dense covariance over 400 masks, within 4 of its errors.

    The mean squares are taken over the pairs there are; 24 steps, 30 % missing, lags 1 to 5.
    """
    N, f, D, s = 24, 0.7, 0.7, 0.3
    rng, pairs = np.random.default_rng(2), []
    position = 2 * D * np.minimum.outer(np.arange(N + 1.0), np.arange(N + 1.0))
    position += s * np.eye(N + 1)
    for _ in range(400):
        here = rng.random(N + 1) < f
        step = np.zeros((5, N + 1, N + 1))
        for lag in range(1, 6):
            start = np.flatnonzero(here[:-lag] & here[lag:])
            step[lag - 1, start, start + lag], step[lag - 1, start, start] = 1.0, -1.0
            step[lag - 1] /= np.sqrt(f * f * (N + 1 - lag))
        cross = np.einsum("nia,ab,mjb->nmij", step, position, step, optimize=True)
        pairs.append(2 * np.sum(cross**2, axis=(2, 3)))
    mean, error = np.mean(pairs, axis=0), np.std(pairs, axis=0) / np.sqrt(len(pairs))
    found = _covariance(np.arange(5), N, seen=np.full(5, f), D=D, s=s)
    assert np.all(np.abs(found - mean) < 4 * error)


def test_a_correlation_is_no_line():
    """fit_line refuses an orientation correlation, which is no straight line."""
    truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=1.0, n_frames=30, rng=1)
    with pytest.raises(ValueError, match="correlation"):
        fit_line(orientation_correlation(truth), lag_range=(1, 10))
