"""Fits to curves: windows and weights, and their true errors."""

import dataclasses
import warnings

import numpy as np
import pytest

from brownian_motions import brownian_motion, rod
from perrin import (
    Cluster,
    LagCurve,
    add_noise,
    cramer_rao,
    fit_gls,
    fit_line,
    msad,
    msad_axes,
    msad_vector,
    msd,
    orientation_correlation,
    simulate_motion,
    track_rotation,
)
from perrin.diffusion import curve_fits, msd_covariance, weighted_variance


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
    """A window of two lags, beyond the curve or upside down: the message names the curve's span."""
    curve = straight(5e-3, 2e-4)
    for window in ((3.0, 3.6), (200.0, 300.0), (22.0, 3.0)):
        with pytest.raises(ValueError, match=r"at least 3.*from 0.5 to 100 s"):
            fit_line(curve, lag_range=window)
    with pytest.raises(ValueError, match="holds 2 lags"):
        fit_line(curve, lag_range=(3.0, 3.6))


def test_lags_without_data_are_left_out():
    """NaN lags inside the window do not change the fit of a straight line."""
    curve = straight(5e-3, 2e-4)
    holes = np.array(curve.value)
    holes[[7, 8, 20]] = np.nan
    found = fit_line(dataclasses.replace(curve, value=holes), lag_range=(3, 22))
    assert found.value == pytest.approx(5e-3, rel=1e-12)
    assert np.isfinite(found.stderr)


def test_the_stated_error_of_the_paper_line_is_the_true_one(repeats):
    """Over 36 tracks (long: 300) in the paper's window stderr is the scatter, a quarter of D.

    Within 3 Monte-Carlo errors. For D_R it is 6(2) % conservative (measured, 1200 tracks): the
    four directions of a body that has turned are worth more than three walks.
    """
    n, lines = repeats(36, 300), {"R": [], "T": []}
    noise = {"angle_noise": 5e-4, "center_noise": 3e-4}
    for seed in range(n):
        motion = brownian_motion(
            [seed, 11], 0.73 * np.arange(300), D_R=4.93e-3, D_T=3.85e-2, dt=0.73, **noise
        )
        lines["R"].append(fit_line(msad(motion), lag_range=(3, 22)))
        lines["T"].append(fit_line(msd(motion), lag_range=(3, 22)))
    within = 3 / np.sqrt(2 * n)
    for name, truth, percent, excess in (("R", 4.93e-3, 0.25, 1.06), ("T", 3.85e-2, 0.27, 1.0)):
        values = np.array([e.value for e in lines[name]])
        stated = np.mean([e.stderr for e in lines[name]])
        assert stated / excess == pytest.approx(values.std(), rel=within)
        assert values.std() / truth == pytest.approx(percent, rel=within)
        assert abs(values.mean() - truth) < 3 * values.std() / np.sqrt(n)


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
    lags, complete = np.arange(1.0, N + 1), np.ones(N)
    found = msd_covariance(lags, N, present=complete, D=0.7, s=s)
    np.testing.assert_allclose(found, expected, rtol=1e-12)


@pytest.mark.parametrize("seen", [1.0, 0.6])
def test_both_ways_to_a_variance_agree(seen):
    """Cumulative sums give what the covariance matrix gives, to 1e-10, on any choice of lags."""
    rng = np.random.default_rng(4)
    for use in (np.arange(30), np.array([0, 3, 4, 17, 29]), np.array([25, 28])):
        weights, part = rng.normal(size=use.size), np.full(use.size, seen)
        covariance = msd_covariance(use + 1.0, 30, present=part, D=0.7, s=0.3)
        short = weighted_variance(weights, use + 1.0, 30, present=part, D=0.7, s=0.3)
        assert short == pytest.approx(weights @ covariance @ weights, rel=1e-10)


def test_missing_frames_add_the_covariance_they_should(repeats):
    """Frames missing at random: the mean dense covariance of 200 masks (long: 400), 4 errors.

    The mean squares are taken over the pairs there are; 24 steps, 30 % missing, lags 1 to 5.
    """
    N, f, D, s = 24, 0.7, 0.7, 0.3
    rng, pairs = np.random.default_rng(2), []
    position = 2 * D * np.minimum.outer(np.arange(N + 1.0), np.arange(N + 1.0))
    position += s * np.eye(N + 1)
    for _ in range(repeats(200, 400)):
        here = rng.random(N + 1) < f
        step = np.zeros((5, N + 1, N + 1))
        for lag in range(1, 6):
            start = np.flatnonzero(here[:-lag] & here[lag:])
            step[lag - 1, start, start + lag], step[lag - 1, start, start] = 1.0, -1.0
            step[lag - 1] /= np.sqrt(f * f * (N + 1 - lag))
        cross = np.einsum("nia,ab,mjb->nmij", step, position, step, optimize=True)
        pairs.append(2 * np.sum(cross**2, axis=(2, 3)))
    mean, error = np.mean(pairs, axis=0), np.std(pairs, axis=0) / np.sqrt(len(pairs))
    found = msd_covariance(np.arange(1.0, 6), N, present=np.full(5, f), D=D, s=s)
    assert np.all(np.abs(found - mean) < 4 * error)


def test_a_correlation_is_not_fitted_by_a_line():
    """fit_line refuses an orientation correlation, which is not a straight line."""
    truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=1.0, n_frames=30, rng=1)
    with pytest.raises(ValueError, match="correlation"):
        fit_line(orientation_correlation(truth), lag_range=(1, 10))


# ---- windows, generalised least squares, intervals ----------------------------------------------

FITS = {
    "best": fit_line,
    "paper": lambda curve: fit_line(curve, lag_range="paper"),
    "gls": fit_gls,
}


def noisy_msd(rng, *, snr, n_frames=300, missing=0.0):
    """Return the MSD of a walk in space with D dt = 1 and noise, frames missing at random."""
    walk = np.cumsum(rng.normal(scale=np.sqrt(2), size=(n_frames, 1, 3)), axis=0)
    walk += rng.normal(scale=snr**-0.5, size=walk.shape)
    walk[rng.random(n_frames) < missing] = np.nan
    return msd(walk, dt=1.0)


@pytest.mark.parametrize("fit", FITS)
@pytest.mark.parametrize(("D", "offset"), [(5e-3, 2e-4), (1e-9, 0.0), (3.0, -0.1)])
def test_every_fit_returns_a_straight_line(fit, D, offset):
    """On an exact line the choice of lags and weights does not matter."""
    found = FITS[fit](straight(D, offset))
    assert found.value == pytest.approx(D, rel=1e-9)
    assert found.offset == pytest.approx(offset, rel=1e-6, abs=1e-9 * D)
    assert found.method == ("gls" if fit == "gls" else "line")


def test_the_papers_window_is_its_3_to_22_s():
    """Of a run of 300 frames in 220 s, "paper" uses what (3, 22) uses."""
    truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=220 / 300, n_frames=300, rng=2)
    curve = msad(truth)
    assert fit_line(curve, lag_range="paper") == fit_line(curve, lag_range=(3, 22))


def test_the_papers_window_gains_nothing_from_a_longer_run():
    """Its error is 25 % of D within 2 % for 300, 3000 and 30000 frames; the best falls as N^-1/2.

    Exact, not simulated: the curves are straight lines, SNR 20 and three walks.
    """
    errors = {
        n: [
            FITS[fit](dataclasses.replace(straight(1.0, 0.025, n=n - 1), n_walks=3.0)).stderr
            for fit in ("paper", "best", "gls")
        ]
        for n in (300, 3000, 30000)
    }
    for n, (paper, best, gls) in errors.items():
        assert paper == pytest.approx(0.25, abs=0.02)
        bound = cramer_rao(n_frames=n, snr=20)
        assert bound < gls <= best * (1 + 1e-9)
        assert best == pytest.approx(bound, rel=0.02)


def test_best_window_and_gls_reach_the_bound(repeats):
    """30 tracks (long: 200) of 300 frames at SNR 0.2: all within 3 Monte-Carlo errors.

    Efficiency (bound over variance) 0.87 for the best line, 0.96 for GLS, and below 0.5 in the
    paper's window (a quarter in truth); no bias; the stated error is the scatter; the 68 % and 95 %
    intervals cover that much.
    """
    rng, n = np.random.default_rng(21), repeats(30, 200)
    curves = [noisy_msd(rng, snr=0.2) for _ in range(n)]
    bound = cramer_rao(n_frames=300, snr=0.2)
    efficiency, within = {}, 3 / np.sqrt(2 * n)
    for name, fit in FITS.items():
        found = [fit(curve) for curve in curves]
        value = np.array([e.value for e in found])
        scatter = value.std(ddof=1)
        efficiency[name] = (bound / scatter) ** 2
        assert abs(value.mean() - 1) < 3 * scatter / np.sqrt(n)
        assert np.mean([e.stderr for e in found]) == pytest.approx(scatter, rel=within)
        for level, interval in ((0.68, "ci68"), (0.95, "ci95")):
            ends = np.array([getattr(e, interval) for e in found])
            covered = np.mean((ends[:, 0] <= 1) & (ends[:, 1] >= 1))
            assert abs(covered - level) < 3 * np.sqrt(level * (1 - level) / n)
    assert efficiency["best"] > 0.87 * (1 - 2 * within)
    assert efficiency["gls"] > 0.96 * (1 - 2 * within)
    assert efficiency["paper"] < 0.5


def test_missing_frames_are_in_the_error(repeats):
    """40 % of the frames missing, 14 tracks (long: 100): bias, error and coverage, 3 errors."""
    rng, n = np.random.default_rng(8), repeats(14, 100)
    curves = [noisy_msd(rng, snr=0.5, missing=0.4) for _ in range(n)]
    for fit in FITS.values():
        found = [fit(curve) for curve in curves]
        value = np.array([e.value for e in found])
        covered = np.mean([e.ci95[0] <= 1 <= e.ci95[1] for e in found])
        assert abs(covered - 0.95) < 3 * np.sqrt(0.95 * 0.05 / n)
        assert abs(value.mean() - 1) < 3 * value.std() / np.sqrt(n)
        stated = np.mean([e.stderr for e in found])
        assert stated == pytest.approx(value.std(), rel=3 / np.sqrt(2 * n))


@pytest.mark.parametrize("offset", [0.0, 0.3])
def test_the_interval_ends_where_the_value_is_too_far_in_their_own_error(offset):
    """At the lower and upper end as truth, the value is 1.96 of that truth's errors away."""
    window = (2, 10)
    found = fit_line(straight(1.0, offset), lag_range=window)
    for end in found.ci95:
        there = fit_line(straight(end, offset), lag_range=window).stderr
        assert abs(found.value - end) == pytest.approx(1.96 * there, rel=1e-6)
    assert found.ci95[1] - 1 > 1 - found.ci95[0]


@pytest.mark.parametrize("fit", FITS)
def test_fits_follow_the_units(fit):
    """Lengths in another unit, times in another: value, interval and offset follow to 1e-9."""
    curve = dataclasses.replace(noisy_msd(np.random.default_rng(3), snr=0.3), noise=0.7)
    length2, time = 1e-12, 86400.0
    other = dataclasses.replace(
        curve,
        noise=curve.noise * length2,
        lagtime=curve.lagtime * time,
        step=curve.step * time,
        value=curve.value * length2,
        components=curve.components * length2,
        stderr=curve.stderr * length2,
    )
    a, b = FITS[fit](curve), FITS[fit](other)
    assert b.value == pytest.approx(a.value * length2 / time, rel=1e-9)
    assert b.stderr == pytest.approx(a.stderr * length2 / time, rel=1e-9)
    assert b.ci95 == pytest.approx(np.array(a.ci95) * length2 / time, rel=1e-9)
    assert (b.offset, b.offset_stderr) == pytest.approx(
        (a.offset * length2, a.offset_stderr * length2), rel=1e-9
    )
    assert b.snr == pytest.approx(a.snr, rel=1e-9)


@pytest.fixture(scope="module")
def noise_curves(repeats):
    """Return MSDs of noise without motion."""
    rng = np.random.default_rng(6)
    return [msd(rng.normal(size=(200, 1, 3)), dt=1.0) for _ in range(repeats(8, 40))]


@pytest.mark.parametrize("fit", FITS)
def test_noise_alone_is_an_upper_limit(fit, noise_curves):
    """Of tracks of noise without motion at most 10 % (or one) resolve D, and all have a limit."""
    found = [FITS[fit](curve) for curve in noise_curves]
    assert sum(e.resolved for e in found) <= max(1, 0.1 * len(found))
    assert all(np.isfinite(e.ci95).all() and e.ci68[0] <= e.value <= e.ci68[1] for e in found)


@pytest.mark.parametrize("fit", FITS)
def test_a_walk_that_is_not_brownian_has_a_finite_D(fit):
    """A body at rest has D = 0 without error; steady motion, which bends upwards, a finite D."""
    still = FITS[fit](msd(np.zeros((60, 1, 3)), dt=1.0))
    assert (still.value, still.stderr, still.resolved) == (0.0, 0.0, False)
    steady = FITS[fit](msd(np.arange(60.0)[:, None, None] * [1.0, 0, 0], dt=1.0))
    assert np.isfinite([steady.value, steady.stderr, *steady.ci95]).all()


def test_bad_windows_are_refused():
    """Unknown words, correlations and a single lag: refused in one line."""
    curve = straight(1.0, 0.1)
    with pytest.raises(ValueError, match=r'"best", "paper" or two lag times.*\'short\''):
        fit_line(curve, lag_range="short")
    truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=1.0, n_frames=30, rng=1)
    with pytest.raises(ValueError, match="correlation"):
        fit_gls(orientation_correlation(truth))
    with pytest.raises(ValueError, match="at least 2 lags with data, this one has 1"):
        fit_gls(straight(1.0, 0.1, n=1))


def test_a_long_curve_needs_few_evaluations(repeats, monkeypatch):
    """20 000 frames (long: 1e5): at most 600 lags in a matrix, and 2000 variances of windows."""
    curve = noisy_msd(np.random.default_rng(1), snr=1.0, n_frames=repeats(20_000, 100_000))
    sizes, calls = [], []

    def counted_covariance(lags, *args, **keywords):
        sizes.append(lags.size)
        return msd_covariance(lags, *args, **keywords)

    def counted_variance(weights, *args, **keywords):
        calls.append(weights.size)
        return weighted_variance(weights, *args, **keywords)

    monkeypatch.setattr(curve_fits, "msd_covariance", counted_covariance)
    monkeypatch.setattr(curve_fits, "weighted_variance", counted_variance)
    for fit in FITS.values():
        fit(curve)
    assert 0 < max(sizes) <= 600
    assert len(sizes) <= 20
    assert 0 < len(calls) < 2000


# ---- what the slope of an anisotropic body means ------------------------------------------------


def slope_of(cluster, D_R, seed, fit, n_frames=400):
    """Return a fit to the MSAD of a noisy body, and the texts of its warnings."""
    rng = np.random.default_rng([seed, 5])
    truth = simulate_motion(cluster, D_R=D_R, dt=0.5, n_frames=n_frames, rng=rng)
    x = add_noise(truth.positions(), sigma=0.03, rng=rng)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = fit(msad(track_rotation(x, dt=0.5)))
    return found, [str(w.message) for w in caught]


@pytest.mark.parametrize("fit", [fit_line, fit_gls])
def test_a_slope_that_is_not_D_R_is_named(fit):
    """A rod's MSAD: the warning is raised and kept, and states the ratio to D_R and its error."""
    found, given = slope_of(rod(), [2e-2, 2e-3, 2e-3], 0, fit)
    assert given == list(found.warnings)
    (text,) = given
    assert "equals D_R only for an isotropic body" in text
    ratio, error = msad(
        simulate_motion(rod(), D_R=[2e-2, 2e-3, 2e-3], dt=0.5, n_frames=4000, rng=1)
    ).ratio
    unit = rod().positions / np.linalg.norm(rod().positions, axis=1, keepdims=True)
    D = np.diag([2e-2, 2e-3, 2e-3])
    expected = 1.5 * np.trace(D - unit.T @ unit @ D / len(unit)) / np.trace(D)
    assert abs(ratio - expected) < 4 * error
    assert error < 0.01


def test_an_isotropic_body_gives_no_warning(repeats):
    """Tetrahedra have no ratio; of 10 trimers (long: 60) with equal axes at most 1 warns (long: 2).

    The level is below 1 % each: two of 10 and three of 60 have probabilities below 2 %.
    """
    found, given = slope_of(Cluster.tetrahedron(1.5), [5e-3] * 3, 0, fit_line)
    assert not given
    assert not found.warnings
    trimer = Cluster.trimer(2.4)
    warned = [slope_of(trimer, 5e-3, k, fit_line, n_frames=150)[1] for k in range(repeats(10, 60))]
    assert sum(map(bool, warned)) <= repeats(1, 2)


def test_single_axes_and_the_vector_angle_need_no_warning():
    """Curves of single axes, and of the vector angle, have no ratio and raise no warning."""
    truth = simulate_motion(rod(), D_R=[2e-2, 2e-3, 2e-3], dt=0.5, n_frames=400, rng=2)
    for curve in (*msad_axes(truth), msad_vector(truth)):
        assert curve.ratio is None
        assert not fit_line(curve).warnings
