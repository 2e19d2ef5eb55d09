"""Averages over pairs of frames: equal to direct sums, exact in pairs, honest in their errors."""

import dataclasses
import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from perrin import (
    Cluster,
    PrecisionWarning,
    TooFewFramesError,
    add_noise,
    diffusion_tensor,
    fit_gls,
    fit_line,
    kabsch,
    msad,
    msad_axes,
    msad_vector,
    msd,
    noise_floor,
    orientation_correlation,
    quaternion_covariance,
    simulate_motion,
    track_rotation,
    van_hove,
)
from perrin.curves.displacement import drift_corrected
from perrin.geometry.rotations import cumulative_product, exp_map

TETRAHEDRON = Cluster.tetrahedron(1.5)
SMALL = settings(max_examples=25, deadline=None, derandomize=True)


def direct(walk, lag, piece=None):
    """Return the mean square displacement by component and the pairs of one walk (T, c), summed."""
    step = walk[lag:] - walk[:-lag]
    if piece is not None:
        step = step[piece[lag:] == piece[:-lag]]
    step = step[np.isfinite(step).all(axis=1)]
    return (step**2).mean(axis=0) if len(step) else np.full(walk.shape[1], np.nan), len(step)


def turning(omega, n_frames=50, dt=0.5, cluster=TETRAHEDRON):
    """Return the motion of a cluster that turns steadily with angular velocity omega, rad/s."""
    rotation = exp_map(np.arange(n_frames)[:, None] * dt * np.asarray(omega, dtype=float))
    return track_rotation(np.einsum("tij,nj->tni", rotation, cluster.positions), dt=dt)


def noisy(seed, n_frames=200, D_R=2e-3, D_T=0.03, sigma=0.06, cluster=TETRAHEDRON, gaps=0.0):
    """Return a tracked Brownian cluster, whole frames missing at random (never the ends)."""
    rng = np.random.default_rng(seed)
    truth = simulate_motion(cluster, D_R=D_R, D_T=D_T, dt=1.0, n_frames=n_frames, rng=rng)
    x = add_noise(truth.positions(), sigma=sigma, rng=rng)
    lost = np.flatnonzero(rng.random(n_frames) < gaps)
    x[lost[(lost > 0) & (lost < n_frames - 1)]] = np.nan
    return track_rotation(x, dt=1.0)


# ---- the kernel ---------------------------------------------------------------------------------


@pytest.mark.parametrize("gaps", [0.0, 0.05])
def test_fft_equals_direct_sums_far_from_the_origin(gaps):
    """1e5 frames at offset 1e4: relative error under 1e-8 and exact pair counts, gaps or none."""
    n, rng = 100_000, np.random.default_rng(7)
    walk = 1e4 + np.cumsum(rng.normal(size=(n, 3)), axis=0)
    lost = rng.random(n) < gaps
    lost[[0, 1, -2, -1]] = False
    walk[lost] = np.nan
    curve = msd(walk[:, None], dt=1.0)
    for lag in (1, 2, 10, 100, n // 10, n // 2, n - 2):
        expected, pairs = direct(walk, lag)
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
    """A walk t^2 has MSD = mean of (2 t lag + lag^2)^2; a particle at rest has 0, not rounding."""
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
    motion = noisy(1)
    for curve in (msd(motion), msad(motion)):
        assert np.allclose(curve.components.sum(axis=1), curve.value, rtol=1e-12)
        assert (curve.components >= 0).all()
        assert (curve.stderr > 0).all()


@SMALL
@given(st.floats(-6, 6), st.floats(-1e4, 1e4), st.integers(0, 2**32 - 1))
def test_msd_follows_units_origin_rotation_and_time_reversal(power, shift, seed):
    """MSD scales with the square of the unit; origin, axes and time's direction leave it alone."""
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
    """Read backwards a motion has the same MSD and MSAD: particles' directions turn along."""
    rng = np.random.default_rng(3)
    truth = simulate_motion(TETRAHEDRON, D_R=5e-3, D_T=0.1, dt=1.0, n_frames=80, rng=rng)
    x = add_noise(truth.positions(), sigma=0.02, rng=rng)
    x[[7, 8, 30]] = np.nan
    forward, backward = (track_rotation(y, dt=1.0) for y in (x, x[::-1]))
    for curve in (msd, msad):
        assert np.allclose(curve(forward).value, curve(backward).value, rtol=1e-9)
        assert np.array_equal(curve(forward).n_pairs, curve(backward).n_pairs)


# ---- pieces, gaps, frames -----------------------------------------------------------------------


def test_pieces_are_never_paired():
    """Two pieces: pairs within each only, so the longest lags have none; sums equal direct ones."""
    motion = noisy(2, n_frames=60)
    piece = np.repeat([0, 1], [25, 35])
    cut = dataclasses.replace(motion, piece=piece)
    for curve, walk in (
        (msd(cut), cut.center),
        (msad(cut, directions=[0, 1, 0]), cut.rotational_displacement([0, 1, 0])),
    ):
        for lag in range(1, 60):
            expected, pairs = direct(walk, lag, piece)
            assert curve.n_pairs[lag - 1] == pairs == max(25 - lag, 0) + max(35 - lag, 0)
            assert np.allclose(curve.components[lag - 1], expected, rtol=1e-9, equal_nan=True)


def test_a_jump_between_pieces_is_not_seen():
    """The second piece set a kilometre away leaves the curve as it was."""
    motion = noisy(2, n_frames=60)
    piece = np.repeat([0, 1], [30, 30])
    far = motion.center + 1e3 * piece[:, None]
    near, apart = (dataclasses.replace(motion, piece=piece, center=c) for c in (motion.center, far))
    assert np.allclose(msd(near).value, msd(apart).value, rtol=1e-9, equal_nan=True)


def test_frames_with_holes_equal_rows_of_nan():
    """Frame numbers that skip say the same as rows of NaN."""
    motion = noisy(4, n_frames=40)
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
    x = noisy(4, n_frames=30).positions()
    first, late = (track_rotation(x, dt=0.5, frames=np.arange(30) + k) for k in (0, 977))
    assert np.allclose(msad(first).value, msad(late).value, rtol=1e-12)
    assert np.allclose(msad(first).lagtime, msad(late).lagtime)


# ---- sparse frames, uneven times ----------------------------------------------------------------

HOLE = 10**6
SPARSE = {
    "stride": 1000 * np.arange(120),
    "hole": np.r_[0:60, HOLE : HOLE + 60],
    "bursts": (5000 * np.arange(20)[:, None] + np.arange(6)).ravel(),
}


def pauses(n=300, dt=0.73):
    """Return times whose every 30th interval is a pause of 20 s."""
    interval = np.full(n - 1, dt)
    interval[29::30] = 20.0
    return np.append(0.0, interval.cumsum())


def at_times(time, walk, dt):
    """Return a motion whose centre is a walk at given times."""
    n = len(time)
    rest = track_rotation(np.tile(TETRAHEDRON.positions, (2, 1, 1)), dt=dt)
    return dataclasses.replace(
        rest, time=np.asarray(time, float), center=walk, rotation=np.tile(np.eye(3), (n, 1, 1)),
        residual=np.zeros(n), n_present=np.full(n, 4), covariance=np.zeros((n, 3, 3)),
        center_variance=np.zeros(n), piece=np.zeros(n, int), reason=("",) * n,
    )  # fmt: skip


def brownian_walk(time, rng, *, D=0.02, s=2e-4):
    """Return a noisy Brownian walk in space at given times."""
    step = (
        rng.normal(size=(len(time), 3)) * np.sqrt(2 * D * np.diff(time, prepend=time[0]))[:, None]
    )
    return np.cumsum(step, axis=0) + rng.normal(size=step.shape) * np.sqrt(s)


@pytest.mark.parametrize("name", SPARSE)
def test_sparse_frames_cost_by_the_frames_present(name):
    """Every pair is in the lag it has and there is no other lag; the memory is under 4 MB.

    An array with a place per absent frame and axis would take 24 MB and more.
    """
    frames = SPARSE[name]
    motion = at_times(0.5 * frames, brownian_walk(0.5 * frames, np.random.default_rng(1)), 0.5)
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
    x = noisy(3, n_frames=50).positions()
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
    curve = msd(at_times(frames, brownian_walk(frames, np.random.default_rng(3)), 1.0))
    assert curve.n_pairs.sum() == 400 * 399 // 2
    assert len(curve.lagtime) < 9 * 400
    assert (np.diff(curve.lagtime) > 0).all()
    with pytest.raises(ValueError, match=r"no compact grid of times.*estimate_diffusion"):
        fit_line(curve)


def test_more_pairs_than_can_be_formed_are_cut_at_a_lag_and_reported():
    """1500 frames off any grid: the shortest lags are complete, and the end is in the warning."""
    rng = np.random.default_rng(4)
    time = np.cumsum(rng.uniform(0.4, 1.6, 1500))
    motion = at_times(time, brownian_walk(time, rng), 1.0)
    with pytest.warns(PrecisionWarning, match="pairs across groups are formed up to a lag of"):
        curve = msd(motion)
    # Pairs within groups are on top of the million.
    assert 0.9e6 < curve.n_pairs.sum() < 1.01e6
    i, j = np.triu_indices(1500, 1)
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
    motion = at_times(time, brownian_walk(time, rng), 0.73)
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
    curve = msd(at_times(time, brownian_walk(time, rng), 0.73))
    expected = [np.mean(time[n:] - time[:-n]) for n in range(1, 200)]
    np.testing.assert_allclose(curve.lagtime, expected, rtol=1e-10)
    np.testing.assert_array_equal(curve.n_pairs, 199 - np.arange(199))


def test_pauses_leave_curve_and_fit_unbiased_with_their_true_error():
    """120 walks with pauses of 20 s: mean 6 (D t + s), stated errors and intervals right.

    Errors within 20 % (3 Monte-Carlo errors), the mean of each lag within 4, of the fit within 3.
    """
    time, D, s = pauses(), 0.02, 2e-4
    curves = [
        msd(at_times(time, brownian_walk(time, np.random.default_rng([k, 7]), D=D, s=s), 0.73))
        for k in range(120)
    ]
    use = np.array([0, 3, 11, 28, 60, 130])
    value, stderr = (
        np.array([getattr(c, name)[use] for c in curves]) for name in ("value", "stderr")
    )
    scatter = value.std(axis=0, ddof=1)
    expected = 6 * (D * curves[0].lagtime[use] + s)
    assert np.all(np.abs(value.mean(axis=0) - expected) < 4 * scatter / np.sqrt(120))
    np.testing.assert_allclose(stderr.mean(axis=0) / scatter, 1, atol=0.2)
    for fit in (fit_line, fit_gls):
        found = [fit(c) for c in curves]
        values = np.array([e.value for e in found])
        assert abs(values.mean() - D) < 3 * values.std() / np.sqrt(120)
        assert np.mean([e.stderr for e in found]) == pytest.approx(values.std(), rel=0.2)
        assert np.mean([e.ci95[0] <= D <= e.ci95[1] for e in found]) > 0.89
    with pytest.raises(ValueError, match="join frames across holes"):
        fit_line(curves[0], lag_range=(1.0, 60.0))


def test_rotation_at_uneven_times_is_right_too():
    """40 tetrahedra with pauses: MSAD, its vector form and single axes give D_R within 4 errors."""
    time, D = pauses(n=200), 5e-3
    found = []
    for seed in range(40):
        rng = np.random.default_rng([seed, 8])
        step = rng.normal(size=(199, 3)) * np.sqrt(2 * D * np.diff(time))[:, None]
        motion = dataclasses.replace(
            at_times(time, np.zeros((200, 3)), 0.73), rotation=cumulative_product(exp_map(step))
        )
        # A pause turns by 0.8 rad, where the curvature of rotations counts: short lags only.
        curves = (msad(motion), msad_vector(motion), msad_axes(motion)[0])
        found.append([c.value[4] / (2 * c.dof * c.lagtime[4]) for c in curves])
        lagged = orientation_correlation(motion)
        found[-1].append(-np.log(lagged.value[4]) / (2 * lagged.lagtime[4]))
    mean, error = np.mean(found, axis=0), np.std(found, axis=0, ddof=1) / np.sqrt(40)
    assert np.all(np.abs(mean - D) < 4 * error + 0.02 * D)


def test_bad_input_is_refused():
    """Wrong or missing dt, a zero direction, no pair of frames: refused in one line each."""
    motion = noisy(5, n_frames=20)
    with pytest.raises(ValueError, match=r"dt.*needed"):
        msd(motion.positions())
    with pytest.raises(ValueError, match=r"dt.*leave dt out"):
        msd(motion, dt=1.0)
    for dt in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="dt"):
            msd(motion.positions(), dt=dt)
    with pytest.raises(ValueError, match="none zero"):
        msad(motion, directions=[[1, 0, 0], [0, 0, 0]])
    with pytest.raises(TooFewFramesError):
        msd(motion.positions()[:1], dt=1.0)
    with pytest.raises(TooFewFramesError):
        msd(dataclasses.replace(motion, piece=np.arange(20)))


# ---- MSAD ---------------------------------------------------------------------------------------


def test_steady_rotation_is_exact():
    """A direction across a steady rotation omega has MSAD (omega t)^2 at every lag, unbounded."""
    curve = msad(turning([0, 0, 0.9], n_frames=80), directions=[1, 1, 0])
    assert np.allclose(curve.value, (0.9 * curve.lagtime) ** 2, rtol=1e-10)
    assert np.allclose(curve.components[:, :2], 0, atol=1e-18)
    along = msad(turning([0, 0, 0.9]), directions=[0, 0, 1])
    assert np.allclose(along.value, 0, atol=1e-20)


def test_default_directions_are_those_of_the_particles():
    """The default MSAD is the mean over the particles' directions; their length is no matter."""
    motion = noisy(6)
    own = msad(motion)
    each = [msad(motion, directions=p).value for p in motion.template]
    assert np.allclose(own.value, np.mean(each, axis=0), rtol=1e-10)
    scale = np.array([[1e-6], [1.0], [3.0], [1e6]])
    assert np.allclose(
        msad(motion, directions=scale * motion.template).value, own.value, rtol=1e-10
    )
    assert own.n_pairs.tolist() == list(range(199, 0, -1))


def test_a_particle_at_the_centre_has_no_direction():
    """A particle on the centre of the cluster is left out of the MSAD instead of spoiling it."""
    outer = Cluster.touching(6, 2.0).positions
    cluster = Cluster.from_positions(np.concatenate([outer, [[0.0, 0, 0]]]))
    motion = simulate_motion(cluster, D_R=5e-3, dt=1.0, n_frames=50, rng=1)
    curve = msad(motion)
    assert np.isfinite(curve.value).all()
    assert np.allclose(curve.value, msad(motion, directions=outer).value, rtol=1e-12)


def test_labels_of_particles_do_not_matter():
    """Particles in another order give the same MSAD and MSD."""
    x = noisy(8).positions()
    a, b = (track_rotation(y, dt=1.0) for y in (x, x[:, [2, 0, 3, 1]]))
    assert np.allclose(msad(a).value, msad(b).value, rtol=1e-9)
    assert np.allclose(msd(a).value, msd(b).value, rtol=1e-9)


def test_one_direction_diffuses_as_4_D_t_and_the_centre_as_6_D_t():
    """Planted D_R and D_T come back: MSAD = 4 D_R t, MSD = 6 D_T t, and dof says so.

    Within 3.5 standard errors of the mean of 120 tracks (12 comparisons); at D_R dt = 1e-3 finite
    steps lower the MSAD by 0.03 % only.
    """
    D_R, D_T, lags = 1e-3, 0.02, np.array([1, 4, 20, 60])
    curves = []
    for seed in range(120):
        m = simulate_motion(TETRAHEDRON, D_R=D_R, D_T=D_T, dt=1.0, n_frames=240, rng=seed)
        curves.append((msad(m, directions=[1, 2, 3]), msad(m), msd(m)))
    for i, D in enumerate((D_R, D_R, D_T)):
        ratio = [c[i].value[lags - 1] / (2 * c[i].dof * D * lags) for c in curves]
        mean, error = np.mean(ratio, axis=0), np.std(ratio, axis=0) / np.sqrt(len(ratio))
        assert np.all(np.abs(mean - 1) < 3.5 * error), (i, mean, error)
    assert [(c.dof, c.unit, c.quantity) for c in curves[0]] == [
        (2, "rad^2", "rotation"),
        (2, "rad^2", "rotation"),
        (3, "um^2", "translation"),
    ]


def test_motionless_msad_is_the_noise_floor():
    """A cluster that only jitters reads Phi^2 at every lag (Eq. 21), within 3 standard errors."""
    floor, lags = noise_floor(TETRAHEDRON, sigma=0.03).phi2, np.array([1, 10, 100])
    ratio = [
        msad(noisy(s, D_R=0.0, D_T=0.0, sigma=0.03)).value[lags - 1] / floor for s in range(60)
    ]
    error = np.std(ratio, axis=0) / np.sqrt(60)
    assert np.all(np.abs(np.mean(ratio, axis=0) - 1) < 3 * error + 5e-4)


def test_in_the_plane_there_is_one_angle():
    """In two dimensions the MSAD is 2 D t of one angle, whatever the directions; the MSD 4 D t."""
    flat = Cluster.from_positions([[0, 0], [2, 0], [1, 1.6]])
    ratio = []
    for seed in range(80):
        motion = simulate_motion(flat, D_R=4e-3, D_T=0.05, dt=0.5, n_frames=200, rng=seed)
        angle, place = msad(motion), msd(motion)
        ratio.append([angle.value[3] / (2 * 4e-3 * 2), place.value[3] / (4 * 0.05 * 2)])
    assert (angle.dof, place.dof) == (1, 2)
    assert angle.components.shape == (199, 1)
    assert place.components.shape == (199, 2)
    assert np.allclose(angle.value, msad(motion, directions=[[0, -3], [1, 5]]).value, rtol=1e-9)
    error = np.std(ratio, axis=0) / np.sqrt(80)
    assert np.all(np.abs(np.mean(ratio, axis=0) - 1) < 3 * error)


# ---- errors -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("gaps", "within"), [(0.0, 0.15), (0.1, 0.25)])
def test_stderr_is_the_scatter_between_tracks(gaps, within):
    """Over 300 noisy tracks the mean stderr is the scatter of MSD and MSAD at lags 1, 3, 10, N/4.

    15 % is 3.7 Monte-Carlo errors of a standard deviation from 300; with gaps the formula itself
    counts pairs only, hence 25 %.
    """
    lags, seen = np.array([1, 3, 10, 30]), []
    for seed in range(300):
        motion = noisy(seed, n_frames=120, gaps=gaps)
        curves = (msd(motion), msad(motion), msad(motion, directions=[1, 0, 0]))
        seen.append([(c.value[lags - 1], c.stderr[lags - 1]) for c in curves])
    value, stderr = np.moveaxis(np.array(seen), 2, 0)
    ratio = stderr.mean(axis=0) / value.std(axis=0)
    assert np.all(np.abs(ratio - 1) < within), ratio


def test_stderr_of_free_particles_counts_each_as_a_walker():
    """25 free particles count as 25 walkers: stderr is the scatter between runs.

    20 % is 4 Monte-Carlo errors of a standard deviation from 200 runs.
    """
    rng = np.random.default_rng(5)
    runs = [msd(rng.normal(size=(60, 25, 3)).cumsum(axis=0), dt=1.0) for _ in range(200)]
    value, stderr = (
        np.array([getattr(r, k)[[0, 4, 14]] for r in runs]) for k in ("value", "stderr")
    )
    assert np.all(np.abs(stderr.mean(axis=0) / value.std(axis=0) - 1) < 0.2)


# ---- what a curve is ----------------------------------------------------------------------------


def test_to_frame_has_a_row_per_lag():
    """The table holds lag time, value, components by lab axis if several, error and pairs."""
    table = msd(noisy(9, n_frames=30)).to_frame()
    names = ["lagtime", "value", "value_x", "value_y", "value_z", "stderr", "n_pairs"]
    assert list(table.columns) == names
    assert len(table) == 29
    assert np.allclose(table[["value_x", "value_y", "value_z"]].sum(axis=1), table["value"])
    flat = Cluster.from_positions([[0, 0], [2, 0], [1, 1.6]])
    motion = simulate_motion(flat, D_R=4e-3, D_T=0.05, dt=0.5, n_frames=20, rng=0)
    single = ["lagtime", "value", "stderr", "n_pairs"]
    assert list(msad(motion).to_frame()) == single
    assert list(msad_axes(noisy(9, n_frames=30))[0].to_frame()) == single
    assert list(msd(motion).to_frame().columns)[2:4] == ["value_x", "value_y"]


def test_a_curve_cannot_be_changed():
    """Results are read-only, down to their arrays."""
    curve = msd(noisy(9, n_frames=30))
    with pytest.raises(ValueError, match="read-only"):
        curve.value[0] = 1.0
    with pytest.raises(dataclasses.FrozenInstanceError):
        curve.dof = 2


# ---- single axes of the body --------------------------------------------------------------------

ROD = Cluster.from_positions([[-3.0, 0, 0], [0, 0.5, 0.3], [0.2, -0.6, 0.4], [3.0, 0, 0]])


def gappy(seed, cluster=ROD, D_R=5e-3, n_frames=150):
    """Return a noisy motion with missing frames and two pieces."""
    motion = noisy(seed, n_frames=n_frames, D_R=D_R, cluster=cluster, gaps=0.15)
    return dataclasses.replace(motion, piece=np.repeat([0, 1], [90, n_frames - 90]))


def test_msad_axes_is_the_direct_sum_of_body_steps():
    """Gaps, pieces, every lag: body-frame step vectors added up along each axis, to 1e-9."""
    motion = gappy(1)
    axes = np.array([[1.0, 0, 0], [1.0, 2.0, -1.0]])
    curves = msad_axes(motion, axes=axes)
    steps = motion.step_vectors() @ (axes / np.linalg.norm(axes, axis=1)[:, None]).T
    walk = np.vstack([np.zeros(2), np.nancumsum(steps, axis=0)])
    walk[np.isnan(motion.center[:, 0])] = np.nan
    for curve, column in zip(curves, walk.T, strict=True):
        assert (curve.dof, curve.n_walks, curve.unit) == (1, 1.0, "rad^2")
        for lag in (1, 2, 10, 50, 89):
            expected, pairs = direct(column[:, None], lag, motion.piece)
            assert curve.n_pairs[lag - 1] == pairs
            assert curve.value[lag - 1] == pytest.approx(expected[0], rel=1e-9)


def test_each_axis_has_its_own_diffusion():
    """A rod-like body: D across first, about the long axis last, each within 3.5 of its errors."""
    D = np.array([2e-2, 5e-3, 5e-3])
    truth = simulate_motion(ROD, D_R=D, dt=1.0, n_frames=4000, rng=2)
    curves = msad_axes(truth)
    for planted, curve in zip(D[::-1], curves, strict=True):
        found = fit_line(curve)
        assert abs(found.value - planted) < 3.5 * found.stderr
        assert found.stderr < 0.06 * planted
    single = msad_axes(truth, axes=[0.0, 0.0, 2.0])
    assert len(single) == 1


def test_the_axes_belong_to_the_body():
    """Lab rotated, particles renumbered, another unit, time reversed: the curves stay the same."""
    rng = np.random.default_rng(3)
    truth = simulate_motion(ROD, D_R=1e-2, dt=1.0, n_frames=120, rng=rng)
    x = add_noise(truth.positions(), sigma=0.02, rng=rng)
    q = kabsch(rng.normal(size=(4, 3)), rng.normal(size=(4, 3)))
    base = msad_axes(track_rotation(x, dt=1.0))
    for other in (x @ q.T, x[:, [2, 0, 3, 1]], 1e-3 * x + 7.0, x[::-1]):
        for a, b in zip(base, msad_axes(track_rotation(other, dt=1.0)), strict=True):
            np.testing.assert_allclose(b.value, a.value, rtol=1e-6)


def test_a_body_that_turns_steadily_turns_about_its_axes_by_the_components():
    """At constant omega the curve of axis a is (omega . a t)^2, beyond any number of turns."""
    omega = np.array([0.5, -0.9, 1.7])
    curves = msad_axes(turning(omega, n_frames=100), axes=np.eye(3))
    t = 0.5 * np.arange(1, 100)
    for curve, w in zip(curves, omega, strict=True):
        np.testing.assert_allclose(curve.value, (w * t) ** 2, rtol=1e-8)


def test_the_plane_has_one_axis():
    """2-D: one curve, that of msad_vector; axes are refused there, and zero axes everywhere."""
    flat = Cluster.from_positions([[0.0, 0.0], [2.0, 0.1], [0.5, 1.2]])
    motion = simulate_motion(flat, D_R=1e-2, dt=1.0, n_frames=50, rng=1)
    (curve,) = msad_axes(motion)
    np.testing.assert_allclose(curve.value, msad_vector(motion).value, rtol=1e-12)
    with pytest.raises(ValueError, match="one axis only"):
        msad_axes(motion, axes=[0, 0, 1])
    for bad in ([0.0, 0.0, 0.0], [1.0, 2.0], [[1.0, np.nan, 0.0]]):
        with pytest.raises(ValueError, match=r"axes: expected \(3,\)"):
            msad_axes(noisy(1, n_frames=20), axes=bad)


def test_the_axes_are_ordered_as_those_of_the_tensor():
    """The curves' slopes rise as the principal values do: axis 1 is the same axis in both."""
    truth = simulate_motion(ROD, D_R=[2e-2, 6e-3, 2e-3], dt=1.0, n_frames=4000, rng=4)
    values = diffusion_tensor(truth).principal_values
    slopes = [fit_line(c).value for c in msad_axes(truth)]
    np.testing.assert_allclose(slopes, values, rtol=0.1)


# ---- directions that weigh axes unequally -------------------------------------------------------


def test_the_msad_of_directions_is_that_of_the_axes_across_them():
    """2 tr(D W) t with W = 1 - <p p^T>: 60 rods, one direction and several, within 4 errors."""
    D = np.diag([2e-2, 4e-3, 2e-3])
    several = np.array([[1.0, 0, 0], [1.0, 1.0, 0], [0, 0, -2.0]])
    ratio = []
    for seed in range(60):
        truth = simulate_motion(ROD, D_R=np.diag(D), dt=0.5, n_frames=300, rng=seed)
        curves = [msad(truth, directions=p) for p in (several[0], several[1], several)]
        ratio.append([c.value[3] / (2 * np.trace(D @ c.weights) * c.lagtime[3]) for c in curves])
    mean, error = np.mean(ratio, axis=0), np.std(ratio, axis=0, ddof=1) / np.sqrt(60)
    assert np.all(np.abs(mean - 1) < 4 * error)
    np.testing.assert_allclose(curves[0].weights, np.diag([0.0, 1, 1]), atol=1e-12)
    np.testing.assert_allclose(np.trace(curves[2].weights), 2)
    np.testing.assert_array_equal(msad_vector(truth).weights, np.eye(3))


def test_stderr_knows_that_a_rod_turns_mostly_about_one_axis():
    """100 rods with D 10 times larger about the long axis: stderr is the scatter within 22 %."""
    runs = []
    for seed in range(100):
        truth = simulate_motion(ROD, D_R=[2e-2, 2e-3, 2e-3], dt=0.5, n_frames=200, rng=seed)
        runs.append([(c.value[0], c.stderr[0]) for c in (msad(truth), msad_vector(truth))])
    value, stderr = np.moveaxis(np.array(runs), 2, 0)
    np.testing.assert_allclose(stderr.mean(axis=0) / value.std(axis=0, ddof=1), 1, atol=0.22)


# ---- drift --------------------------------------------------------------------------------------


def test_a_steady_velocity_makes_no_difference():
    """Adding any velocity leaves the MSD without drift as it was, and is told; gaps and pieces."""
    motion = gappy(4)
    velocity = np.array([0.3, -2.0, 0.05])
    moved = dataclasses.replace(motion, center=motion.center + motion.time[:, None] * velocity)
    still, carried = (msd(m, drift=True) for m in (motion, moved))
    np.testing.assert_allclose(carried.value, still.value, rtol=1e-8)
    np.testing.assert_allclose(np.subtract(carried.drift, still.drift), velocity, rtol=1e-9)
    assert msd(motion).drift is None
    assert msd(moved).value[60] > 10 * still.value[60]


@pytest.mark.parametrize("pieces", [1, 2])
def test_what_a_mean_velocity_takes_is_given_back_exactly(pieces):
    """The expected MSD of noisy Brownian walks, less their mean step, becomes 2 D n + 2 s, 1e-9.

    The expectation is summed over all displacements from the covariance of the positions.
    """
    T, D, s = 30, 0.7, 0.4
    piece = np.repeat(np.arange(pieces), T // pieces)
    same = piece[:, None] == piece
    start = (T // pieces) * piece
    time = np.arange(T) - start
    cov = same * 2 * D * np.minimum.outer(time, time) + s * np.eye(T)
    ends = np.zeros(T)
    for p in range(pieces):
        rows = np.flatnonzero(piece == p)
        ends[rows[[0, -1]]] = [-1.0, 1.0]
    total = T - pieces
    left = np.eye(T) - np.outer(time, ends) / total
    cov = left @ cov @ left.T
    expected, pairs = np.full((T - 1, 1), np.nan), np.zeros(T - 1, dtype=np.int64)
    for lag in range(1, T // pieces):
        i = np.flatnonzero(piece[lag:] == piece[:-lag])
        square = cov[i + lag, i + lag] + cov[i, i] - 2 * cov[i + lag, i]
        expected[lag - 1], pairs[lag - 1] = square.mean(), len(i)
    lengths = np.full(pieces, T // pieces - 1.0)
    lagtime = np.arange(1.0, T)
    found = drift_corrected(expected, pairs, lagtime=lagtime, durations=lengths)[:, 0]
    n = np.arange(1, T // pieces)
    last = n.size if pieces > 1 else n.size - 1  # all of one piece is its own drift
    np.testing.assert_allclose(found[:last], 2 * D * n[:last] + 2 * s, rtol=1e-9)
    assert np.isnan(found[last:]).all()


def test_a_known_velocity_makes_no_difference():
    """Adding v and taking it off leaves values, errors and pairs as they were, to 1e-9."""
    motion = gappy(4)
    for time in (motion.time, 0.9 * motion.time + 3 * (motion.time > 40)):
        still = dataclasses.replace(motion, time=time)
        velocity = np.array([10.0, -2.0, 0.05])
        moved = dataclasses.replace(still, center=still.center + time[:, None] * velocity)
        a, b = msd(still), msd(moved, drift=velocity)
        for name in ("lagtime", "value", "components", "stderr", "n_pairs"):
            np.testing.assert_allclose(getattr(b, name), getattr(a, name), rtol=1e-9)
        assert b.drift == tuple(velocity)
    for bad in ([1.0, 2.0], [np.nan, 0, 0], 3.0):
        with pytest.raises(ValueError, match="drift: expected True, False or a velocity"):
            msd(motion, drift=bad)


def test_free_particles_share_their_drift():
    """30 particles in a flow: velocity within 4 errors, the MSD's D within 3.5 of its own."""
    rng = np.random.default_rng(5)
    x = np.cumsum(rng.normal(scale=np.sqrt(2 * 0.1), size=(200, 30, 3)), axis=0)
    x += 0.5 * np.arange(200)[:, None, None] * [0.3, 0.0, -0.1]
    curve = msd(x, dt=0.5, drift=True)
    error = np.sqrt(2 * 0.1 / (30 * 199)) / 0.5
    assert np.abs(np.subtract(curve.drift, [0.3, 0.0, -0.1])).max() < 4 * error
    found = fit_line(curve)
    assert abs(found.value - 0.2) < 3.5 * found.stderr


# ---- van Hove -----------------------------------------------------------------------------------


def brownian_center(seed, n_frames=400):
    """Return a motion whose centre makes Gaussian steps, seen with noise."""
    return noisy(seed, n_frames=n_frames, D_T=0.5, sigma=0.2)


def test_a_gaussian_is_told_as_one():
    """100 tracks, overlapping pairs and noise: alpha2 about 0, scatter as stated within 22 %.

    The mean alpha2 is 0 within 3 errors; each bin's density is the Gaussian within 4, and its
    scatter the stated one within 15 % on average over the bins.
    """
    edges = np.linspace(-6, 6, 13)
    runs = [
        van_hove(brownian_center(seed, n_frames=150), lag=4.0, quantity="translation", bins=edges)
        for seed in range(100)
    ]
    alpha = np.array([r.alpha2 for r in runs])
    stated = np.mean([r.alpha2_stderr for r in runs])
    assert abs(alpha.mean()) < 3 * alpha.std() / np.sqrt(100)
    assert stated == pytest.approx(alpha.std(), rel=0.22)
    density = np.array([r.density for r in runs])
    gaussian = np.mean([r.gaussian for r in runs], axis=0)
    scatter = density.std(axis=0)
    assert np.all(np.abs(density.mean(axis=0) - gaussian) < 4 * scatter / np.sqrt(100))
    ratio = np.mean([r.stderr for r in runs], axis=0) / scatter
    assert ratio.mean() == pytest.approx(1, abs=0.15)


def test_a_mixture_is_not_gaussian():
    """Rotations of two sizes, mixed half and half, 20000 steps: the alpha2 of the mixture in 10 %.

    For variances v and w = 9 v it is 2 (v^2 + w^2)/(v + w)^2 - 1 = 0.64.
    """
    rng = np.random.default_rng(6)
    size = np.where(rng.random(20_000) < 0.5, 0.02, 0.06)[:, None]
    steps = exp_map(size * rng.normal(size=(20_000, 3)))
    rotation = cumulative_product(steps)
    motion = track_rotation(np.einsum("tij,nj->tni", rotation, TETRAHEDRON.positions), dt=1.0)
    found = van_hove(motion, lag=1.0)
    v, w = 0.02**2, 0.06**2
    expected = 2 * (v * v + w * w) / (v + w) ** 2 - 1
    assert found.alpha2 == pytest.approx(expected, rel=0.1)
    assert found.alpha2 > 10 * found.alpha2_stderr
    assert (found.quantity, found.unit, found.lagtime) == ("rotation", "rad", 1.0)


def test_the_density_is_a_density():
    """It integrates to 1, the Gaussian nearly so; beyond given edges it does not."""
    found = van_hove(brownian_center(1), lag=3.0, quantity="translation", bins=20)
    width = np.diff(found.edges)
    assert found.density @ width == pytest.approx(1, rel=1e-12)
    assert found.gaussian @ width == pytest.approx(1, rel=0.01)
    assert list(found.to_frame()) == ["low", "high", "density", "stderr", "gaussian"]
    cut = van_hove(brownian_center(1), lag=3.0, quantity="translation", bins=[0.0, 1.0])
    inside = found.n_pairs * 3 * cut.density[0]
    assert inside == pytest.approx(round(inside), abs=1e-6)
    assert 0 < cut.density[0] < 0.5


def test_van_hove_follows_units_and_time_reversal():
    """Scaled lengths scale the edges; backwards, every displacement changes its sign."""
    motion = brownian_center(2)
    a = van_hove(motion, lag=5.0, quantity="translation")
    scaled = dataclasses.replace(motion, center=1e-6 * motion.center)
    b = van_hove(scaled, lag=5.0, quantity="translation")
    np.testing.assert_allclose(b.edges, 1e-6 * a.edges, rtol=1e-9)
    np.testing.assert_allclose(b.stderr, 1e6 * a.stderr, rtol=1e-6)
    assert b.alpha2 == pytest.approx(a.alpha2, rel=1e-9)
    backwards = dataclasses.replace(motion, center=motion.center[::-1])
    c = van_hove(backwards, lag=5.0, quantity="translation")
    assert c.alpha2 == pytest.approx(a.alpha2, rel=1e-9)
    np.testing.assert_allclose(c.density, a.density[::-1], rtol=1e-9)


def test_van_hove_counts_the_pairs_there_are():
    """Gaps and pieces: as many pairs as the MSD has at that lag, and the same mean square."""
    motion = gappy(7)
    found = van_hove(motion, lag=6.0)
    curve = msad_vector(motion)
    assert found.n_pairs == curve.n_pairs[5]
    assert found.lagtime == curve.lagtime[5]


def test_van_hove_refuses_what_it_cannot_answer():
    """Lags off the grid or too long, bad bins, another quantity, a body at rest: one line each."""
    motion = noisy(8, n_frames=30)
    for lag in (0.0, 0.5, 30.0, -1.0):
        with pytest.raises(ValueError, match=r"multiple of dt = 1 s up to 29 s"):
            van_hove(motion, lag=lag)
    for bins in (0, [1.0], [1.0, 1.0], [[0.0, 1.0]]):
        with pytest.raises(ValueError, match="bins: expected"):
            van_hove(motion, lag=1.0, bins=bins)
    with pytest.raises(ValueError, match="quantity: expected"):
        van_hove(motion, lag=1.0, quantity="spin")
    cut = dataclasses.replace(motion, piece=np.arange(30))
    with pytest.raises(TooFewFramesError, match="no two frames of one piece are 2 s apart"):
        van_hove(cut, lag=2.0)
    still = dataclasses.replace(motion, center=np.zeros((30, 3)))
    with pytest.raises(ValueError, match="nothing moves"):
        van_hove(still, lag=1.0, quantity="translation")
