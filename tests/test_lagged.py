"""Averages over pairs of frames: equal to direct sums, exact in pairs, honest in their errors."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from perrin import (
    Cluster,
    TooFewFramesError,
    add_noise,
    kabsch,
    msad,
    msd,
    noise_floor,
    quaternion_covariance,
    simulate_motion,
    track_rotation,
)
from perrin.rotations import exp_map

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


@pytest.mark.parametrize("curve", [msd, msad])
def test_uneven_times_are_refused(curve):
    """Times off the grid of dt would mix lag times: refused, with the way out."""
    x = noisy(5, n_frames=20).positions()
    times = np.arange(20.0) + np.random.default_rng(0).uniform(-0.2, 0.2, 20)
    with pytest.raises(ValueError, match=r"not evenly spaced.*estimate_diffusion"):
        curve(track_rotation(x, dt=1.0, times=times))
    with pytest.raises(ValueError, match="not evenly spaced"):
        curve(track_rotation(x, dt=1.0, times=np.arange(20) * 0.5))


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
    """The table holds lag time, value, components by axis, error and pairs."""
    table = msd(noisy(9, n_frames=30)).to_frame()
    names = ["lagtime", "value", "value_x", "value_y", "value_z", "stderr", "n_pairs"]
    assert list(table.columns) == names
    assert len(table) == 29
    assert np.allclose(table[["value_x", "value_y", "value_z"]].sum(axis=1), table["value"])
    flat = Cluster.from_positions([[0, 0], [2, 0], [1, 1.6]])
    motion = simulate_motion(flat, D_R=4e-3, D_T=0.05, dt=0.5, n_frames=20, rng=0)
    assert list(msad(motion).to_frame().columns) == [
        "lagtime",
        "value",
        "value_z",
        "stderr",
        "n_pairs",
    ]
    assert list(msd(motion).to_frame().columns)[2:4] == ["value_x", "value_y"]


def test_a_curve_cannot_be_changed():
    """Results are read-only, down to their arrays."""
    curve = msd(noisy(9, n_frames=30))
    with pytest.raises(ValueError, match="read-only"):
        curve.value[0] = 1.0
    with pytest.raises(dataclasses.FrozenInstanceError):
        curve.dof = 2


# ---- quaternions --------------------------------------------------------------------------------


def direct_quaternions(motion, lag):
    """Return the mean q q^T at one lag and its pairs, from scipy's quaternions."""
    steps = []
    for k in range(len(motion.time) - lag):
        there = np.isfinite(motion.center[[k, k + lag], 0]).all()
        if there and motion.piece[k] == motion.piece[k + lag]:
            relative = motion.rotation[k].T @ motion.rotation[k + lag]
            q = Rotation.from_matrix(relative).as_quat()[:3]
            steps.append(np.outer(q, q))
    return np.mean(steps, axis=0), len(steps)


@pytest.mark.parametrize("pieces", [False, True])
@pytest.mark.parametrize("gaps", [0.0, 0.3])
def test_quaternion_covariance_equals_direct_sums(gaps, pieces):
    """All lags, gaps and pieces: within 1e-12 of the quaternions pair by pair, pairs exact."""
    motion = noisy(3, n_frames=60, D_R=0.05, gaps=gaps)
    if pieces:
        motion = dataclasses.replace(motion, piece=np.repeat([0, 1], [25, 35]))
    found = quaternion_covariance(motion)
    assert len(found.lagtime) == 59
    for lag in (1, 2, 7, 20, 30):
        expected, pairs = direct_quaternions(motion, lag)
        assert found.n_pairs[lag - 1] == pairs
        np.testing.assert_allclose(found.covariance[lag - 1], expected, atol=1e-12)
    few = quaternion_covariance(motion, n_lags=10)
    np.testing.assert_allclose(few.covariance, found.covariance[:10], atol=1e-12)
    np.testing.assert_array_equal(few.n_pairs, found.n_pairs[:10])
    if pieces:
        assert np.isnan(found.covariance[-1]).all()
        assert found.n_pairs[-1] == 0


def test_quaternion_covariance_is_favros():
    """A body that turns at (1, 2, 4)e-3: Favro's formula to 5 Monte-Carlo errors at all lags."""
    D, count = np.array([1e-3, 2e-3, 4e-3]), 20000
    runs = []
    for seed in range(8):
        truth = simulate_motion(TETRAHEDRON, D_R=D, dt=1.0, n_frames=count, rng=seed)
        runs.append(quaternion_covariance(truth, n_lags=300).covariance)
    t = quaternion_covariance(truth, n_lags=300).lagtime[:, None]
    others = D.sum() - D
    decay = np.exp(-others * t)  # exp(-(D_j + D_k) t)
    expected = (1 + 2 * decay - decay.sum(axis=1, keepdims=True)) / 4
    diagonal = np.diagonal(np.array(runs), axis1=2, axis2=3)
    error = diagonal.std(axis=0, ddof=1) / 8**0.5
    assert np.all(np.abs(diagonal.mean(axis=0) - expected) < 5 * error)
    assert np.all(error < 0.05 * expected)
    off = np.array(runs)[:, :, [0, 0, 1], [1, 2, 2]]
    assert np.all(np.abs(off.mean(axis=0)) < 6 * off.std(axis=0, ddof=1) / 8**0.5)


def test_quaternion_covariance_refuses_what_it_cannot_answer():
    """Planar motions, lags that are none, and motions without a pair."""
    flat = simulate_motion(
        Cluster.from_positions([[0, 0], [2, 0]]), D_R=0.1, dt=1, n_frames=9, rng=1
    )
    with pytest.raises(ValueError, match="three dimensions"):
        quaternion_covariance(flat)
    motion = noisy(1, n_frames=20)
    for n_lags in (0, -1, 2.5):
        with pytest.raises(ValueError, match="n_lags"):
            quaternion_covariance(motion, n_lags=n_lags)
    with pytest.raises(TooFewFramesError):
        quaternion_covariance(dataclasses.replace(motion, piece=np.arange(20)))
    assert len(quaternion_covariance(motion, n_lags=1000).lagtime) == 19
