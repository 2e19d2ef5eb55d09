"""Sums over pairs of frames: equal to direct sums, exact in pairs, with gaps and uneven times."""

import dataclasses
import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import perrin.curves.pairs as pairs_module
from brownian_motions import (
    brownian_motion,
    direct_mean_square,
    tetrahedron,
    tracked_motion,
    with_poses,
)
from perrin import (
    PrecisionWarning,
    add_noise,
    fit_gls,
    fit_line,
    kabsch,
    msad,
    msad_axes,
    msad_vector,
    msd,
    orientation_correlation,
    quaternion_covariance,
    simulate_motion,
    track_rotation,
    van_hove,
)
from perrin.curves import (
    Correlations,
    complete_squares,
    covariance_polynomials,
    lag_covariance,
)

SMALL = settings(max_examples=8, deadline=None, derandomize=True)


# ---- the kernel ---------------------------------------------------------------------------------


@pytest.mark.parametrize("gaps", [0.0, 0.05])
def test_fft_equals_direct_sums_far_from_the_origin(gaps, repeats):
    """20 000 frames (long: 1e5) at offset 1e4: errors under 1e-8, exact numbers of pairs."""
    n, rng = repeats(20_000, 100_000), np.random.default_rng(7)
    walk = 1e4 + np.cumsum(rng.normal(size=(n, 3)), axis=0)
    lost = rng.random(n) < gaps
    lost[[0, 1, -2, -1]] = False
    walk[lost] = np.nan
    curve = msd(walk[:, None], dt=1.0)
    for lag in (1, 2, 10, 100, n // 10, n // 2, n - 2):
        expected, pairs = direct_mean_square(walk, lag)
        assert curve.n_pairs[lag - 1] == pairs
        assert np.allclose(curve.components[lag - 1], expected, rtol=1e-8, atol=0)
        assert curve.value[lag - 1] == pytest.approx(expected.sum(), rel=1e-8)


@SMALL
@given(st.integers(2, 40), st.integers(1, 3), st.integers(2, 3), st.integers(0, 2**32 - 1))
def test_free_particles_equal_a_double_loop(n_frames, n, d, seed):
    """Particles that come and go: value, components and pairs are those of a sum pair by pair."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(n_frames, n, d)).cumsum(axis=0)
    x[rng.random((n_frames, n)) < 0.3] = np.nan
    x[[0, -1], 0] = 0.5
    curve = msd(x, dt=2.0)
    assert np.array_equal(curve.lagtime, 2.0 * np.arange(1, n_frames))
    for lag in range(1, n_frames):
        step = x[lag:] - x[:-lag]
        step = step[np.isfinite(step).all(axis=2)]
        assert curve.n_pairs[lag - 1] == len(step)
        if len(step):
            expected = (step**2).mean(axis=0)
            assert np.allclose(curve.components[lag - 1], expected, rtol=1e-9, atol=1e-12)
        else:
            assert np.isnan(curve.value[lag - 1])
            assert np.isnan(curve.components[lag - 1]).all()
            assert np.isnan(curve.stderr[lag - 1])


def test_lags_without_a_pair_are_nan():
    """Frames 0, 1 and 4 only: lags 1, 3 and 4 have one pair each, lag 2 has none and is NaN."""
    x = np.full((5, 1, 3), np.nan)
    x[[0, 1, 4], 0, 0] = [0.0, 1.0, 5.0]
    x[[0, 1, 4], 0, 1:] = 0.0
    curve = msd(x, dt=1.0)
    assert curve.n_pairs.tolist() == [1, 0, 1, 1]
    assert np.array_equal(np.isnan(curve.value), [False, True, False, False])
    assert np.allclose(curve.value[[0, 2, 3]], [1.0, 16.0, 25.0], rtol=1e-12)


def test_squares_and_constants_are_exactly_known():
    """A walk t^2 has MSD = mean of (2 t lag + lag^2)^2; a particle at rest has exactly 0."""
    t = np.arange(60.0)
    x = np.zeros((60, 1, 3))
    x[:, 0, 1] = t**2
    curve = msd(x, dt=1.0)
    for lag in (1, 2, 7, 30, 58):
        expected = np.mean((2 * t[:-lag] * lag + lag**2) ** 2)
        assert curve.value[lag - 1] == pytest.approx(expected, rel=1e-11)
    assert np.array_equal(curve.components[:, [0, 2]], np.zeros((59, 2)))
    assert np.array_equal(msd(np.full((60, 2, 3), 1e6), dt=1.0).value, np.zeros(59))


def test_components_sum_to_the_value_and_nothing_is_negative():
    """The components are the value by axis."""
    motion = tracked_motion(1)
    for curve in (msd(motion), msad(motion)):
        assert np.allclose(curve.components.sum(axis=1), curve.value, rtol=1e-12)
        assert (curve.components >= 0).all()
        assert (curve.stderr > 0).all()


@SMALL
@given(st.floats(-6, 6), st.floats(-1e4, 1e4), st.integers(0, 2**32 - 1))
def test_msd_follows_units_origin_rotation_and_time_reversal(power, shift, seed):
    """MSD scales with the square of the unit, not with origin, axes or time's direction."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(64, 2, 3)).cumsum(axis=0)
    x[rng.random((64, 2)) < 0.1] = np.nan
    base, unit = msd(x, dt=1.0), 10.0**power
    turn = kabsch(rng.normal(size=(4, 3)), rng.normal(size=(4, 3)))
    scaled = msd(x * unit, dt=3.0)
    assert np.allclose(scaled.value, base.value * unit**2, rtol=1e-9, equal_nan=True)
    assert np.allclose(scaled.stderr, base.stderr * unit**2, rtol=1e-6, equal_nan=True)
    for other in (x + shift, x @ turn.T, x[::-1], x[:, ::-1]):
        curve = msd(other, dt=1.0)
        assert np.allclose(curve.value, base.value, rtol=1e-7, equal_nan=True)
        assert np.array_equal(curve.n_pairs, base.n_pairs)


def test_msad_of_a_motion_reversed_is_unchanged():
    """A motion reversed in time has the same MSD and MSAD."""
    rng = np.random.default_rng(3)
    truth = simulate_motion(tetrahedron(), D_R=5e-3, D_T=0.1, dt=1.0, n_frames=80, rng=rng)
    x = add_noise(truth.positions(), sigma=0.02, rng=rng)
    x[[7, 8, 30]] = np.nan
    forward, backward = (track_rotation(y, dt=1.0) for y in (x, x[::-1]))
    for curve in (msd, msad):
        assert np.allclose(curve(forward).value, curve(backward).value, rtol=1e-9)
        assert np.array_equal(curve(forward).n_pairs, curve(backward).n_pairs)


# ---- pieces, gaps, frames -----------------------------------------------------------------------


def test_pieces_are_never_paired():
    """Two pieces: pairs within each only, so the longest lags have none; sums equal direct ones."""
    motion = tracked_motion(2, n_frames=60)
    piece = np.repeat([0, 1], [25, 35])
    cut = dataclasses.replace(motion, piece=piece)
    for curve, walk in (
        (msd(cut), cut.center),
        (msad(cut, directions=[0, 1, 0]), cut.rotational_displacement([0, 1, 0])),
    ):
        for lag in range(1, 60):
            expected, pairs = direct_mean_square(walk, lag, piece)
            assert curve.n_pairs[lag - 1] == pairs == max(25 - lag, 0) + max(35 - lag, 0)
            assert np.allclose(curve.components[lag - 1], expected, rtol=1e-9, equal_nan=True)


def test_a_jump_between_pieces_does_not_change_the_curve():
    """The second piece set a kilometre away leaves the curve as it was."""
    motion = tracked_motion(2, n_frames=60)
    piece = np.repeat([0, 1], [30, 30])
    far = motion.center + 1e3 * piece[:, None]
    near, apart = (dataclasses.replace(motion, piece=piece, center=c) for c in (motion.center, far))
    assert np.allclose(msd(near).value, msd(apart).value, rtol=1e-9, equal_nan=True)


def test_frames_with_holes_equal_rows_of_nan():
    """Frame numbers that skip give the same curve as rows of NaN."""
    motion = tracked_motion(4, n_frames=40)
    x = motion.positions()
    keep = np.array([0, 1, 2, 5, 6, 9, 20, 21, 22, 39])
    blank = np.full_like(x, np.nan)
    blank[keep] = x[keep]
    holes, rows = track_rotation(x[keep], dt=0.5, frames=keep), track_rotation(blank, dt=0.5)
    for curve in (msd, msad):
        a, b = curve(holes), curve(rows)
        assert np.array_equal(a.lagtime, b.lagtime)
        assert np.array_equal(a.n_pairs, b.n_pairs)
        assert np.allclose(a.value, b.value, rtol=1e-9, equal_nan=True)


def test_frame_numbers_may_start_anywhere():
    """The first frame's number does not matter."""
    x = tracked_motion(4, n_frames=30).positions()
    first, late = (track_rotation(x, dt=0.5, frames=np.arange(30) + k) for k in (0, 977))
    assert np.allclose(msad(first).value, msad(late).value, rtol=1e-12)
    assert np.allclose(msad(first).lagtime, msad(late).lagtime)


# ---- sparse frames, uneven times ----------------------------------------------------------------

HOLE = 10**6


def sparse_frames(kind):
    """Return frame numbers with a stride, with one long hole, or in bursts."""
    return {
        "stride": 1000 * np.arange(120),
        "hole": np.r_[0:60, HOLE : HOLE + 60],
        "bursts": (5000 * np.arange(20)[:, None] + np.arange(6)).ravel(),
    }[kind]


def pauses(n=300, dt=0.73):
    """Return times whose every 30th interval is a pause of 20 s."""
    interval = np.full(n - 1, dt)
    interval[29::30] = 20.0
    return np.append(0.0, interval.cumsum())


def walk_at(time, rng, *, dt, D=0.02, s=2e-4):
    """Return a motion whose centre is a noisy Brownian walk in space at given times."""
    step = np.diff(time, prepend=time[0])[:, None]
    walk = np.cumsum(rng.normal(size=(len(time), 3)) * np.sqrt(2 * D * step), axis=0)
    walk += rng.normal(size=walk.shape) * np.sqrt(s)
    return with_poses(tetrahedron(), time, center=walk, dt=dt)


@pytest.mark.parametrize("kind", ["stride", "hole", "bursts"])
def test_sparse_frames_cost_by_the_frames_present(kind):
    """Every pair is counted at its lag and there is no other lag; the memory is under 4 MB.

    An array with a place per absent frame and axis would take 24 MB and more.
    """
    frames = sparse_frames(kind)
    motion = walk_at(0.5 * frames, np.random.default_rng(1), dt=0.5)
    tracemalloc.start()
    curve = msd(motion)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4e6
    i, j = np.triu_indices(len(frames), 1)
    lag, square = frames[j] - frames[i], (motion.center[j] - motion.center[i]) ** 2
    lags, which, count = np.unique(lag, return_inverse=True, return_counts=True)
    np.testing.assert_allclose(curve.lagtime, 0.5 * lags, rtol=1e-12)
    np.testing.assert_array_equal(curve.n_pairs, count)
    for axis in range(3):
        mean = np.bincount(which, square[:, axis]) / count
        np.testing.assert_allclose(curve.components[:, axis], mean, rtol=1e-7)
    assert np.isfinite(curve.stderr).all()


def test_a_stride_is_another_unit_of_time():
    """Frames 0, 1000, 2000 ...: all curves are those of frames 0, 1, 2 ... with dt 1000 times."""
    x = tracked_motion(3, n_frames=50).positions()
    far, near = track_rotation(x, dt=0.5, frames=1000 * np.arange(50)), track_rotation(x, dt=500.0)
    curves = (msd, msad, msad_vector, orientation_correlation, lambda m: msad_axes(m)[1])
    for curve in curves:
        a, b = curve(far), curve(near)
        np.testing.assert_allclose(a.lagtime, b.lagtime, rtol=1e-12)
        np.testing.assert_allclose(a.value, b.value, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(a.stderr, b.stderr, rtol=1e-9)
    a, b = quaternion_covariance(far), quaternion_covariance(near)
    np.testing.assert_allclose(a.covariance, b.covariance, atol=1e-12)
    assert van_hove(far, lag=1500.0).n_pairs == van_hove(near, lag=1500.0).n_pairs == 47
    assert fit_line(msd(far)).value == pytest.approx(fit_line(msd(near)).value, rel=1e-9)


def test_irregular_frames_have_few_lags():
    """400 frames at random of 10^8: every pair counts, in at most 9 lags a frame."""
    frames = np.sort(np.random.default_rng(2).choice(10**8, 400, replace=False))
    curve = msd(walk_at(frames, np.random.default_rng(3), dt=1.0))
    assert curve.n_pairs.sum() == 400 * 399 // 2
    assert len(curve.lagtime) < 9 * 400
    assert (np.diff(curve.lagtime) > 0).all()
    with pytest.raises(ValueError, match=r"no compact grid of times.*estimate_diffusion"):
        fit_line(curve)


def test_more_pairs_than_can_be_formed_are_cut_at_a_lag_and_reported(repeats, monkeypatch):
    """Frames off any grid with 1.1 times the pairs allowed: the shortest lags are complete.

    Quick: 20 000 pairs are allowed and 210 frames are there; long: a million, and 1500 frames.
    """
    most, n = repeats(20_000, 1_000_000), repeats(210, 1500)
    monkeypatch.setattr(pairs_module, "_MOST_LISTED_PAIRS", most)
    rng = np.random.default_rng(4)
    time = np.cumsum(rng.uniform(0.4, 1.6, n))
    motion = walk_at(time, rng, dt=1.0)
    with pytest.warns(PrecisionWarning, match="pairs across groups are formed up to a lag of"):
        curve = msd(motion)
    # Pairs within groups are on top of those allowed.
    assert 0.9 * most < curve.n_pairs.sum() < 1.02 * most
    i, j = np.triu_indices(n, 1)
    lag = time[j] - time[i]
    end = (round(curve.lagtime[-1] / curve.step) + 0.1) * curve.step
    assert curve.n_pairs.sum() == np.sum(lag <= end)
    square = ((motion.center[j] - motion.center[i]) ** 2).sum(axis=1)
    edge = 30.1 * curve.step  # of a bin
    total = np.sum((curve.value * curve.n_pairs)[curve.lagtime <= edge])
    assert total == pytest.approx(np.sum(square[lag <= edge]), rel=1e-9)


@pytest.mark.parametrize("kind", ["pauses", "jitter"])
def test_uneven_times_take_the_lags_that_pairs_have(kind):
    """Every bin is the mean over pairs of one interval of lags, in lag and in value, to 1e-9."""
    rng = np.random.default_rng(5)
    time = pauses() if kind == "pauses" else 0.73 * (np.arange(200) + rng.uniform(-0.4, 0.4, 200))
    motion = walk_at(time, rng, dt=0.73)
    curve = msd(motion)
    i, j = np.triu_indices(len(time), 1)
    order = np.argsort(time[j] - time[i])
    i, j = i[order], j[order]
    edges = np.append(0, np.cumsum(curve.n_pairs))
    assert edges[-1] == len(i)
    square = ((motion.center[j] - motion.center[i]) ** 2).sum(axis=1)
    lag, value = (
        np.add.reduceat(v, edges[:-1]) / curve.n_pairs for v in (time[j] - time[i], square)
    )
    np.testing.assert_allclose(curve.lagtime, lag, rtol=1e-9)
    np.testing.assert_allclose(curve.value, value, rtol=1e-7)
    width = np.maximum.reduceat((time[j] - time[i]), edges[:-1]) - time[j[edges[:-1]]]
    assert np.all(width + time[i[edges[:-1]]] <= 0.8 * curve.step * (1 + 1e-9))


def test_nearly_even_times_state_their_mean_lags():
    """Times within 4 % of a grid: lags are the mean differences of time, not multiples of dt."""
    rng = np.random.default_rng(6)
    time = 0.73 * (np.arange(200) + rng.uniform(-0.04, 0.04, 200))
    curve = msd(walk_at(time, rng, dt=0.73))
    expected = [np.mean(time[n:] - time[:-n]) for n in range(1, 200)]
    np.testing.assert_allclose(curve.lagtime, expected, rtol=1e-10)
    np.testing.assert_array_equal(curve.n_pairs, 199 - np.arange(199))


def test_pauses_leave_curve_and_fit_unbiased_with_their_true_error(repeats):
    """18 walks (long: 120) with pauses of 20 s: mean 6 (D t + s), stated errors, intervals right.

    Stated errors within 3.2 Monte-Carlo errors of the scatter, the mean of each lag within 4, of
    the fit (long: also GLS) within 3; the coverage of the 95 % interval within 3.
    """
    time, D, s, n = pauses(), 0.02, 2e-4, repeats(18, 120)
    curves = [walk_msd(time, k, D=D, s=s) for k in range(n)]
    within = 3.2 / np.sqrt(2 * n)
    use = np.array([0, 3, 11, 28, 60, 130])
    value, stderr = (
        np.array([getattr(c, name)[use] for c in curves]) for name in ("value", "stderr")
    )
    scatter = value.std(axis=0, ddof=1)
    expected = 6 * (D * curves[0].lagtime[use] + s)
    assert np.all(np.abs(value.mean(axis=0) - expected) < 4 * scatter / np.sqrt(n))
    np.testing.assert_allclose(stderr.mean(axis=0) / scatter, 1, atol=within)
    for fit in repeats((fit_line,), (fit_line, fit_gls)):
        found = [fit(c) for c in curves]
        values = np.array([e.value for e in found])
        assert abs(values.mean() - D) < 3 * values.std() / np.sqrt(n)
        assert np.mean([e.stderr for e in found]) == pytest.approx(values.std(), rel=within)
        covered = np.mean([e.ci95[0] <= D <= e.ci95[1] for e in found])
        assert covered > 0.95 - 3 * np.sqrt(0.95 * 0.05 / n)
    with pytest.raises(ValueError, match="join frames across holes"):
        fit_line(curves[0], lag_range=(1.0, 60.0))


def walk_msd(time, seed, *, D, s):
    """Return the MSD of a noisy Brownian walk with the dt of the paper."""
    return msd(walk_at(time, np.random.default_rng([seed, 7]), dt=0.73, D=D, s=s))


def test_rotation_at_uneven_times_gives_D_R(repeats):
    """6 tetrahedra (long: 40) with pauses: MSAD, vector angle, single axes within 4 errors of D_R.

    The correlation of orientations too.
    """
    time, D, n = pauses(n=200), 5e-3, repeats(6, 40)
    found = []
    for seed in range(n):
        motion = brownian_motion([seed, 8], time, D_R=D, dt=0.73)
        # A pause turns by 0.8 rad, where the curvature of rotations counts: short lags only.
        curves = (msad(motion), msad_vector(motion), msad_axes(motion)[0])
        found.append([c.value[4] / (2 * c.dof * c.lagtime[4]) for c in curves])
        cosine = orientation_correlation(motion)
        found[-1].append(-np.log(cosine.value[4]) / (2 * cosine.lagtime[4]))
    mean, error = np.mean(found, axis=0), np.std(found, axis=0, ddof=1) / np.sqrt(n)
    assert np.all(np.abs(mean - D) < 4 * error + 0.02 * D)
    assert error.max() < 0.08 * D


@pytest.mark.parametrize("gaps", [False, True])
@pytest.mark.parametrize("walkers", [1, 3])
def test_a_steady_motion_keeps_its_digits(gaps, walkers):
    """A straight line far from the origin, with a small walk: 1e-12 of the direct sums (O(T^2))."""
    rng = np.random.default_rng(8)
    n = 4000
    x = np.arange(n)[:, None, None] * np.array([1.0, 0.3, -0.2]) + 1e4
    x = x + 0.1 * np.cumsum(rng.normal(size=(n, walkers, 3)), axis=0)
    if gaps:
        x[1:-1][rng.random((n - 2, walkers)) < 0.1] = np.nan
    curve = msd(x, dt=0.5)
    for lag in (1, 2, 7, 400, n // 2, n - 2):
        square = np.sum((x[lag:] - x[:-lag]) ** 2, axis=-1)
        if np.isfinite(square).any():
            assert curve.value[lag - 1] == pytest.approx(np.nanmean(square), rel=1e-12)
            assert curve.n_pairs[lag - 1] == np.isfinite(square).sum()


@pytest.mark.parametrize("velocity", [0.0, 50.0])
@pytest.mark.parametrize("n", [2, 3, 8, 9])
def test_squares_of_complete_walks_up_to_any_lag(n, velocity):
    """Sums up to every longest lag equal direct sums, for even and odd numbers of frames."""
    walks = np.random.default_rng(n).normal(size=(n, 2, 3))
    walks += velocity * np.arange(n)[:, None, None]
    direct = [np.sum((walks[lag:] - walks[:-lag]) ** 2, axis=(0, 1)) for lag in range(1, n)]
    for count in range(1, n):
        found = complete_squares(walks, count)
        np.testing.assert_allclose(found, direct[:count], rtol=1e-12)


@pytest.mark.parametrize("count", [1, 5, 30, 39])
def test_half_frequencies_give_all_correlations(count):
    """Even and odd parts of correlations equal direct sums, also where the period is shorter."""
    rng = np.random.default_rng(3)
    x, y = rng.normal(size=(2, 40))
    transform = Correlations.of(40 + count)
    f, g = (transform.spectrum(one[None]) for one in (x, y))
    forward = [x[: 40 - lag] @ y[lag:] for lag in range(count + 1)]
    back = [y[: 40 - lag] @ x[lag:] for lag in range(count + 1)]
    product = (np.conj(f) * g)[0]
    even, odd = np.zeros(count), transform.odd(product.imag)[: count + 1]
    transform.add_even(product.real, out=even, scale=2.0)
    np.testing.assert_allclose(even, np.add(forward, back)[1:], atol=1e-12)
    np.testing.assert_allclose(-2 * odd, np.subtract(forward, back), atol=1e-12)


def test_all_lags_of_a_track_need_little_memory():
    """The MSD of a track without gaps, all lags: under six times its bytes (results are four)."""
    x = np.cumsum(np.random.default_rng(1).normal(size=(100_000, 1, 3)), axis=0)
    msd(x, dt=1.0)
    tracemalloc.start()
    msd(x, dt=1.0)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 6 * x.nbytes


@pytest.mark.parametrize("gaps", [0.0, 0.05])
def test_a_steady_motion_keeps_the_digits_of_its_displacements(gaps, repeats):
    """A velocity of 1000 root-mean-square steps: errors under 1e-8 at the shortest lags too."""
    n, rng = repeats(20_000, 1_000_000), np.random.default_rng(9)
    steps = np.array([1.0, -2.0, 0.5]) + rng.normal(scale=1e-3, size=(n, 3))
    walk = 1e4 + np.cumsum(steps, axis=0)
    walk[1:-1][rng.random(n - 2) < gaps] = np.nan
    curve = msd(walk[:, None], dt=1.0)
    for lag in (1, 2, 100, n // 2, n - 1):
        expected, pairs = direct_mean_square(walk, lag)
        assert curve.n_pairs[lag - 1] == pairs
        np.testing.assert_allclose(curve.components[lag - 1], expected, rtol=1e-8)


@pytest.mark.parametrize("steps", [10, 11, 300])
@pytest.mark.parametrize(("D", "s"), [(0.5, 0.0), (0.5, 0.3), (0.0, 1.0)])
def test_the_covariance_of_a_lag_with_itself_is_that_of_the_polynomials(steps, D, s):
    """Both forms of the formula agree, with all frames and with missing ones."""
    lag = np.arange(1.0, steps + 1)
    for present in (np.ones(steps), np.linspace(0.5, 1, steps)):
        near, far, same = covariance_polynomials(lag, steps, present=present, D=D, s=s)
        both = [np.polynomial.polynomial.polyval(lag, c, tensor=False) for c in (near, far)]
        expected = np.where(lag <= steps + 1 - lag, *both) + same
        found = lag_covariance(lag, steps, present=present, D=D, s=s)
        np.testing.assert_allclose(found, expected, rtol=1e-11)
    complete = lag_covariance(lag, steps, present=None, D=D, s=s)
    ones = lag_covariance(lag, steps, present=np.ones(steps), D=D, s=s)
    np.testing.assert_allclose(complete, ones, rtol=1e-13)
