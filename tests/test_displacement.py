"""MSD and MSAD: the laws they follow, their standard errors, single axes, and drift."""

import dataclasses
import json

import numpy as np
import pytest

from brownian_motions import (
    assert_same_fields,
    brownian_motion,
    direct_mean_square,
    flat,
    motion_with_gaps,
    rod,
    tetrahedron,
    tracked_motion,
)
from perrin import (
    Cluster,
    LagCurve,
    TooFewFramesError,
    add_noise,
    diffusion_tensor,
    fit_line,
    kabsch,
    msad,
    msad_axes,
    msad_vector,
    msd,
    noise_floor,
    orientation_correlation,
    simulate_motion,
    track_rotation,
)
from perrin.curves import drift_corrected
from perrin.geometry.rotations import exp_map


def turning(omega, n_frames=50, dt=0.5):
    """Return the motion of a tetrahedron with a steady angular velocity omega, rad/s."""
    rotation = exp_map(np.arange(n_frames)[:, None] * dt * np.asarray(omega, dtype=float))
    return track_rotation(np.einsum("tij,nj->tni", rotation, tetrahedron().positions), dt=dt)


def test_bad_input_is_refused():
    """Wrong or missing dt, a zero direction, no pair of frames: refused in one line each."""
    motion = tracked_motion(5, n_frames=20)
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
    """The default MSAD is the mean over the particles' directions; their length does not matter."""
    motion = tracked_motion(6)
    own = msad(motion)
    each = [msad(motion, directions=p).value for p in motion.template]
    assert np.allclose(own.value, np.mean(each, axis=0), rtol=1e-10)
    scale = np.array([[1e-6], [1.0], [3.0], [1e6]])
    assert np.allclose(
        msad(motion, directions=scale * motion.template).value, own.value, rtol=1e-10
    )
    assert own.n_pairs.tolist() == list(range(199, 0, -1))


def test_a_particle_at_the_centre_has_no_direction():
    """A particle at the centre of the cluster is left out of the MSAD."""
    outer = Cluster.touching(6, 2.0).positions
    cluster = Cluster.from_positions(np.concatenate([outer, [[0.0, 0, 0]]]))
    motion = simulate_motion(cluster, D_R=5e-3, dt=1.0, n_frames=50, rng=1)
    curve = msad(motion)
    assert np.isfinite(curve.value).all()
    assert np.allclose(curve.value, msad(motion, directions=outer).value, rtol=1e-12)


def test_labels_of_particles_do_not_matter():
    """Particles in another order give the same MSAD and MSD."""
    x = tracked_motion(8).positions()
    a, b = (track_rotation(y, dt=1.0) for y in (x, x[:, [2, 0, 3, 1]]))
    assert np.allclose(msad(a).value, msad(b).value, rtol=1e-9)
    assert np.allclose(msd(a).value, msd(b).value, rtol=1e-9)


def test_one_direction_diffuses_as_4_D_t_and_the_centre_as_6_D_t(repeats):
    """Planted D_R and D_T are found: MSAD = 4 D_R t, MSD = 6 D_T t, with the dof of each.

    Within 3.5 standard errors of the mean of 30 tracks (long: 120; 12 comparisons); at
    D_R dt = 1e-3 finite steps lower the MSAD by 0.03 % only.
    """
    D_R, D_T, lags = 1e-3, 0.02, np.array([1, 4, 20, 60])
    curves = []
    for seed in range(repeats(30, 120)):
        m = brownian_motion(seed, np.arange(240.0), D_R=D_R, D_T=D_T)
        curves.append((msad(m, directions=[1, 2, 3]), msad(m), msd(m)))
    for i, D in enumerate((D_R, D_R, D_T)):
        ratio = [c[i].value[lags - 1] / (2 * c[i].dof * D * lags) for c in curves]
        mean, error = np.mean(ratio, axis=0), np.std(ratio, axis=0) / np.sqrt(len(ratio))
        assert np.all(np.abs(mean - 1) < 3.5 * error), (i, mean, error)
        assert error.max() < 0.12
    assert [(c.dof, c.unit, c.quantity) for c in curves[0]] == [
        (2, "rad^2", "rotation"),
        (2, "rad^2", "rotation"),
        (3, "um^2", "translation"),
    ]


def test_motionless_msad_is_the_noise_floor(repeats):
    """A tracked cluster at rest has the MSAD Phi^2 at every lag (Eq. 21), within 3 errors."""
    floor, lags = noise_floor(tetrahedron(), sigma=0.03).phi2, np.array([1, 10, 100])
    ratio, rng = [], np.random.default_rng(1)
    for _ in range(repeats(10, 60)):
        x = add_noise(np.tile(tetrahedron().positions, (200, 1, 1)), sigma=0.03, rng=rng)
        ratio.append(msad(track_rotation(x, dt=1.0)).value[lags - 1] / floor)
    error = np.std(ratio, axis=0, ddof=1) / np.sqrt(len(ratio))
    assert np.all(np.abs(np.mean(ratio, axis=0) - 1) < 3 * error + 5e-4)
    assert error.max() < 0.05


def test_in_the_plane_there_is_one_angle(repeats):
    """In two dimensions the MSAD is 2 D t of one angle, for all directions; the MSD 4 D t."""
    ratio = []
    for seed in range(repeats(40, 80)):
        time = 0.5 * np.arange(200)
        motion = brownian_motion(seed, time, cluster=flat(), D_R=4e-3, D_T=0.05, dt=0.5)
        angle, place = msad(motion), msd(motion)
        ratio.append([angle.value[3] / (2 * 4e-3 * 2), place.value[3] / (4 * 0.05 * 2)])
    assert (angle.dof, place.dof) == (1, 2)
    assert angle.components.shape == (199, 1)
    assert place.components.shape == (199, 2)
    assert np.allclose(angle.value, msad(motion, directions=[[0, -3], [1, 5]]).value, rtol=1e-9)
    error = np.std(ratio, axis=0) / np.sqrt(len(ratio))
    assert np.all(np.abs(np.mean(ratio, axis=0) - 1) < 3 * error)
    assert error.max() < 0.05


# ---- errors -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("gaps", "slack"), [(0.0, 0.0), (0.1, 0.1)])
def test_stderr_is_the_scatter_between_tracks(gaps, slack, repeats):
    """The mean stderr of noisy tracks is the scatter of MSD and MSAD at lags 1, 3, 10, N/4.

    Within 3.7 Monte-Carlo errors of a standard deviation from 40 tracks (long: 300); with gaps the
    formula itself counts pairs only, hence 10 % more.
    """
    lags, found, n = np.array([1, 3, 10, 30]), [], repeats(40, 300)
    for seed in range(n):
        motion = brownian_motion(
            seed, np.arange(120.0), D_R=2e-3, D_T=0.03, angle_noise=6e-4, center_noise=9e-4,
            gaps=gaps,
        )  # fmt: skip
        curves = (msd(motion), msad(motion), msad(motion, directions=[1, 0, 0]))
        found.append([(c.value[lags - 1], c.stderr[lags - 1]) for c in curves])
    value, stderr = np.moveaxis(np.array(found), 2, 0)
    ratio = stderr.mean(axis=0) / value.std(axis=0)
    assert np.all(np.abs(ratio - 1) < 3.7 / np.sqrt(2 * n) + slack), ratio


def test_stderr_of_free_particles_counts_each_as_a_walker(repeats):
    """25 free particles count as 25 walkers: stderr is the scatter between runs.

    Within 4 Monte-Carlo errors of a standard deviation from 80 runs (long: 200).
    """
    rng, n = np.random.default_rng(5), repeats(80, 200)
    runs = [msd(rng.normal(size=(60, 25, 3)).cumsum(axis=0), dt=1.0) for _ in range(n)]
    value, stderr = (
        np.array([getattr(r, k)[[0, 4, 14]] for r in runs]) for k in ("value", "stderr")
    )
    ratio = stderr.mean(axis=0) / value.std(axis=0)
    assert np.all(np.abs(ratio - 1) < 4 / np.sqrt(2 * n))


# ---- what a curve is ----------------------------------------------------------------------------


def test_to_frame_has_a_row_per_lag():
    """The table holds lag time, value, components by lab axis if several, error and pairs."""
    table = msd(tracked_motion(9, n_frames=30)).to_frame()
    names = ["lagtime", "value", "value_x", "value_y", "value_z", "stderr", "n_pairs"]
    assert list(table.columns) == names
    assert len(table) == 29
    assert np.allclose(table[["value_x", "value_y", "value_z"]].sum(axis=1), table["value"])
    motion = brownian_motion(0, 0.5 * np.arange(20), cluster=flat(), D_R=4e-3, D_T=0.05, dt=0.5)
    single = ["lagtime", "value", "stderr", "n_pairs"]
    assert list(msad(motion).to_frame()) == single
    assert list(msad_axes(tracked_motion(9, n_frames=30))[0].to_frame()) == single
    assert list(msd(motion).to_frame().columns)[2:4] == ["value_x", "value_y"]


def curves_of_every_kind():
    """Return curves with and without drift, weights, ratio, noise and NaN."""
    cut, particles = motion_with_gaps(3), np.random.default_rng(1).normal(size=(20, 2, 3))
    steps_apart = dataclasses.replace(cut, piece=np.arange(150) // 2)  # no neighbouring steps
    return {
        "MSD": msd(cut),
        "drift": msd(cut, drift=True),
        "particles": msd(particles, dt=0.5),
        "MSAD": msad(cut),
        "one direction": msad(cut, directions=[1, 0, 0]),
        "unknown ratio": msad(steps_apart, directions=[1, 0, 0]),
        "axis": msad_axes(cut)[0],
        "correlation": orientation_correlation(cut),
    }


def test_a_curve_is_the_same_after_json():
    """Every field of every kind of curve, NaN and infinite errors included, and it is read-only."""
    curves = curves_of_every_kind()
    assert curves["unknown ratio"].ratio == (1.0, np.inf)
    for curve in curves.values():
        back = LagCurve.from_dict(json.loads(json.dumps(curve.to_dict())))
        assert_same_fields(back, curve)
        assert not back.value.flags.writeable


def test_a_curve_cannot_be_changed():
    """Fields cannot be assigned, and arrays are read-only."""
    curve = msd(tracked_motion(9, n_frames=30))
    with pytest.raises(ValueError, match="read-only"):
        curve.value[0] = 1.0
    with pytest.raises(dataclasses.FrozenInstanceError):
        curve.dof = 2


# ---- single axes of the body --------------------------------------------------------------------


def test_msad_axes_is_the_direct_sum_of_body_steps():
    """Gaps, pieces, every lag: body-frame step vectors added up along each axis, to 1e-9."""
    motion = motion_with_gaps(1)
    axes = np.array([[1.0, 0, 0], [1.0, 2.0, -1.0]])
    curves = msad_axes(motion, axes=axes)
    steps = motion.step_vectors() @ (axes / np.linalg.norm(axes, axis=1)[:, None]).T
    walk = np.vstack([np.zeros(2), np.nancumsum(steps, axis=0)])
    walk[np.isnan(motion.center[:, 0])] = np.nan
    for curve, column in zip(curves, walk.T, strict=True):
        assert (curve.dof, curve.n_walks, curve.unit) == (1, 1.0, "rad^2")
        for lag in (1, 2, 10, 50, 89):
            expected, pairs = direct_mean_square(column[:, None], lag, motion.piece)
            assert curve.n_pairs[lag - 1] == pairs
            assert curve.value[lag - 1] == pytest.approx(expected[0], rel=1e-9)


def test_each_axis_has_its_own_diffusion():
    """A rod-like body: D across first, about the long axis last, each within 3.5 of its errors."""
    D = np.array([2e-2, 5e-3, 5e-3])
    truth = brownian_motion(2, np.arange(4000.0), cluster=rod(), D_R=D)
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
    truth = simulate_motion(rod(), D_R=1e-2, dt=1.0, n_frames=120, rng=rng)
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
    motion = brownian_motion(1, np.arange(50.0), cluster=flat(), D_R=1e-2)
    (curve,) = msad_axes(motion)
    np.testing.assert_allclose(curve.value, msad_vector(motion).value, rtol=1e-12)
    with pytest.raises(ValueError, match="one axis only"):
        msad_axes(motion, axes=[0, 0, 1])
    for bad in ([0.0, 0.0, 0.0], [1.0, 2.0], [[1.0, np.nan, 0.0]]):
        with pytest.raises(ValueError, match=r"axes: expected \(3,\)"):
            msad_axes(tracked_motion(1, n_frames=20), axes=bad)


def test_the_axes_are_ordered_as_those_of_the_tensor():
    """The curves' slopes rise as the principal values do: axis 1 is the same axis in both."""
    truth = simulate_motion(rod(), D_R=[2e-2, 6e-3, 2e-3], dt=1.0, n_frames=2000, rng=4)
    values = diffusion_tensor(truth).principal_values
    slopes = [fit_line(c).value for c in msad_axes(truth)]
    np.testing.assert_allclose(slopes, values, rtol=0.1)


# ---- directions that weigh axes unequally -------------------------------------------------------


def test_the_msad_of_directions_is_that_of_the_axes_across_them(repeats):
    """2 tr(D W) t with W = 1 - <p p^T>: 15 rods (long: 60), three means over directions, 4 errors.

    Each ratio is known to 5 %, and with equal weights it would be off by 20 % or more.
    """
    D = np.diag([2e-2, 4e-3, 2e-3])
    several = np.array([[1.0, 0, 0], [1.0, 1.0, 0], [0, 0, -2.0]])
    ratio = []
    for seed in range(repeats(15, 60)):
        motion = brownian_motion(seed, 0.5 * np.arange(300), cluster=rod(), D_R=np.diag(D), dt=0.5)
        curves = [msad(motion, directions=p) for p in (several[0], several[1], several)]
        ratio.append([c.value[3] / (2 * np.trace(D @ c.weights) * c.lagtime[3]) for c in curves])
    mean, error = np.mean(ratio, axis=0), np.std(ratio, axis=0, ddof=1) / np.sqrt(len(ratio))
    assert np.all(np.abs(mean - 1) < 4 * error)
    assert error.max() < 0.05
    np.testing.assert_allclose(curves[0].weights, np.diag([0.0, 1, 1]), atol=1e-12)
    np.testing.assert_allclose(np.trace(curves[2].weights), 2)
    np.testing.assert_array_equal(msad_vector(motion).weights, np.eye(3))


def test_stderr_accounts_for_a_rod_that_turns_mostly_about_one_axis(repeats):
    """40 rods (long: 100) with D 10 times larger about the long axis: stderr is the scatter.

    Within 3.2 Monte-Carlo errors; three equal walks would be off by 40 %.
    """
    runs, n = [], repeats(40, 100)
    for seed in range(n):
        motion = brownian_motion(
            seed, 0.5 * np.arange(200), cluster=rod(), D_R=[2e-2, 2e-3, 2e-3], dt=0.5
        )
        runs.append([(c.value[0], c.stderr[0]) for c in (msad(motion), msad_vector(motion))])
    value, stderr = np.moveaxis(np.array(runs), 2, 0)
    ratio = stderr.mean(axis=0) / value.std(axis=0, ddof=1)
    np.testing.assert_allclose(ratio, 1, atol=3.2 / np.sqrt(2 * n))


# ---- drift --------------------------------------------------------------------------------------


def test_a_steady_velocity_makes_no_difference():
    """Adding any velocity does not change the MSD without drift; the velocity is reported."""
    motion = motion_with_gaps(4)
    velocity = np.array([0.3, -2.0, 0.05])
    moved = dataclasses.replace(motion, center=motion.center + motion.time[:, None] * velocity)
    still, carried = (msd(m, drift=True) for m in (motion, moved))
    np.testing.assert_allclose(carried.value, still.value, rtol=1e-8)
    np.testing.assert_allclose(np.subtract(carried.drift, still.drift), velocity, rtol=1e-9)
    assert msd(motion).drift is None
    assert msd(moved).value[60] > 10 * still.value[60]


@pytest.mark.parametrize("pieces", [1, 2])
def test_the_correction_for_a_mean_velocity_is_exact(pieces):
    """The expected MSD of noisy walks without their mean velocity becomes 2 D n + 2 s, to 1e-9.

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
    """Adding v and subtracting it does not change values, errors and pairs, to 1e-9."""
    motion = motion_with_gaps(4)
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


def test_the_lag_of_the_whole_track_has_neither_msd_nor_error_without_its_drift():
    """Nothing but rounding is left there, which is exactly 0 in one of these tracks at least."""
    for seed in range(20, 40):
        walk = np.random.default_rng(seed).integers(-8, 8, size=(9, 1, 3)).astype(float)
        walk[[0, -1]], walk[4] = np.array([0.0, 8.0])[:, None, None], np.nan
        curve = msd(walk, dt=1.0, drift=True)
        assert np.isnan([curve.value[-1], curve.stderr[-1]]).all()
        assert np.isfinite(curve.stderr[:-1]).all()
