"""The appendix's MSAD of rotation vectors, and orientational correlations."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from brownian_motions import brownian_motion, flat, motion_with_gaps, tetrahedron, with_poses
from perrin import (
    Cluster,
    TooFewFramesError,
    add_noise,
    msad,
    msad_vector,
    noise_floor,
    orientation_correlation,
    track_rotation,
)
from perrin.geometry.rotations import cumulative_product, exp_map

DIRECTIONS = ([1.0, 0, 0], [0.2, -3.0, 0.5], [0, 0, -1.0])


def gappy(seed, cluster=None):
    """Return a noisy motion with missing frames, one long gap and two pieces."""
    motion = motion_with_gaps(seed, cluster=cluster or tetrahedron(), D_R=2e-2)
    center, rotation = np.array(motion.center), np.array(motion.rotation)
    center[50:60], rotation[50:60] = np.nan, np.nan
    return replace(motion, center=center, rotation=rotation)


def moving(rotations):
    """Return the motion of a tetrahedron whose orientations are given, a frame a second."""
    return with_poses(tetrahedron(), np.arange(float(len(rotations))), rotation=rotations)


def pairs(motion, lag):
    """Return the frames of every pair that lag apart, both with a pose and in one piece."""
    ok = np.isfinite(motion.rotation[:, 0, 0])
    start = np.arange(len(ok) - lag)
    same = motion.piece[start] == motion.piece[start + lag]
    start = start[ok[start] & ok[start + lag] & same]
    return start, start + lag


def mean_and_error(samples):
    """Return the mean over repeats (first axis) and its standard error."""
    return np.mean(samples, axis=0), np.std(samples, axis=0, ddof=1) / np.sqrt(len(samples))


# ---- the MSAD of rotation vectors ---------------------------------------------------------------


@pytest.mark.parametrize("in_plane", [False, True])
def test_msad_vector_is_the_direct_sum(in_plane):
    """Gaps, pieces and every lag: the mean square of the summed rotvecs, to 1e-10, exact pairs."""
    motion = planar(1) if in_plane else gappy(1)
    walk = motion.accumulated_rotation()
    curve = msad_vector(motion)
    assert curve.dof == walk.shape[1]
    assert curve.n_walks == walk.shape[1]
    assert (curve.quantity, curve.unit) == ("rotation", "rad^2")
    assert curve.components.shape == (149, walk.shape[1])
    for lag in range(1, 150):
        start, stop = pairs(motion, lag)
        assert curve.n_pairs[lag - 1] == len(start)
        assert curve.lagtime[lag - 1] == lag
        if len(start):
            expected = np.mean((walk[stop] - walk[start]) ** 2, axis=0)
            np.testing.assert_allclose(curve.components[lag - 1], expected, rtol=1e-10, atol=1e-12)
            assert curve.value[lag - 1] == pytest.approx(expected.sum(), rel=1e-10, abs=1e-12)
        else:
            assert np.isnan(curve.value[lag - 1])


def planar(seed, n_frames=150):
    """Return a planar motion with a gap and two pieces."""
    motion = brownian_motion(seed, np.arange(float(n_frames)), cluster=flat(), D_R=2e-2)
    center, rotation = np.array(motion.center), np.array(motion.rotation)
    center[20:23], rotation[20:23] = np.nan, np.nan
    piece = np.repeat([0, 1], [n_frames - 60, 60])
    return replace(motion, center=center, rotation=rotation, piece=piece)


def test_in_the_plane_it_is_the_msad():
    """2-D: one angle, dof 1, the same curve as any direction's; 2 D t."""
    motion = planar(2, n_frames=8000)
    curve, other = msad_vector(motion), msad(motion)
    assert (curve.dof, other.dof) == (1, 1)
    np.testing.assert_allclose(curve.value, other.value, rtol=1e-9)
    np.testing.assert_allclose(curve.stderr, other.stderr, rtol=1e-9)
    lag = np.array([1, 5, 20])
    z = (curve.value[lag - 1] - 2 * 2e-2 * lag) / curve.stderr[lag - 1]
    assert np.abs(z).max() < 4


def test_a_steady_turn_gives_the_square_of_its_angle():
    """At constant omega the curve is (omega t)^2, beyond any number of turns."""
    omega = np.array([0.3, -0.5, 0.9])
    curve = msad_vector(moving(exp_map(np.outer(np.arange(200), omega))))
    expected = (np.arange(1, 200)[:, None] * omega) ** 2
    np.testing.assert_allclose(curve.components, expected, rtol=1e-8)
    assert curve.value[-1] > (30 * np.pi) ** 2


def test_it_grows_as_6_d_t_and_its_errors_are_right(repeats):
    """30 Brownian runs (long: 80): mean 6 D t at all lags, scatter as stated within 3.2 errors."""
    n = repeats(30, 80)
    curves = [msad_vector(brownian(seed, D_R=2e-3)) for seed in range(n)]
    lag = np.array([1, 2, 5, 10, 30, 100])
    values = np.array([c.value[lag - 1] for c in curves])
    mean, error = mean_and_error(values)
    assert np.abs((mean - 6 * 2e-3 * lag) / error).max() < 3.5
    stated = np.sqrt(np.mean([c.stderr[lag - 1] ** 2 for c in curves], axis=0))
    ratio = values.std(axis=0, ddof=1) / stated
    np.testing.assert_allclose(ratio, 1, atol=3.2 / np.sqrt(2 * n))


def brownian(seed, n_frames=1000, *, D_R=1e-3, cluster=None):
    """Return a Brownian motion without noise, a frame a second."""
    return brownian_motion(seed, np.arange(float(n_frames)), D_R=D_R, cluster=cluster)


@pytest.mark.parametrize("D_R", [1e-4, 1e-2])
def test_two_thirds_of_it_is_the_msad(D_R, repeats):
    """Isotropic bodies (Fig. 6): 2/3 of the curve is the MSAD of the directions within errors."""
    lag = np.array([1, 3, 10, 30])
    ratio = []
    for seed in range(repeats(10, 40)):
        motion = brownian(1000 + seed, D_R=D_R)
        ratio.append(2 / 3 * msad_vector(motion).value[lag - 1] / msad(motion).value[lag - 1])
    mean, error = mean_and_error(ratio)
    # Steps of finite size: averaged over directions, 3 D dt (at 1e-2) of a step is curvature.
    assert np.all(np.abs(mean - 1) < 4 * error + 1.5 * D_R)
    assert error.max() < 0.015


def test_noise_leaves_the_same_floor():
    """A still tetrahedron: 2/3 of the curve is Phi^2 of eq. 23 at every lag."""
    x = np.broadcast_to(tetrahedron().positions, (4000, 4, 3))
    motion = track_rotation(add_noise(x, sigma=0.05, rng=3), dt=1.0)
    floor = noise_floor(tetrahedron(), sigma=0.05).phi2
    value = 2 / 3 * msad_vector(motion).value[[0, 1, 4, 19, 99]]
    np.testing.assert_allclose(value, floor, rtol=0.06)


def test_no_direction_ever_turns_further_than_the_body_in_a_step():
    """Every step's angle of every direction is at most the step's: exact, up to half a turn.

    So the curves at a lag of one frame are ordered too, Brownian or not, noise or not.
    """
    rng = np.random.default_rng(4)
    p = rng.normal(size=(50, 3))
    for size in (1e-6, 0.1, 1.0, 3.0):
        steps = size * rng.normal(size=(200, 3))
        motion = moving(cumulative_product(exp_map(steps)))
        whole = np.linalg.norm(np.diff(motion.accumulated_rotation(), axis=0), axis=1)
        phi = np.diff(motion.rotational_displacement(p), axis=0)
        assert np.all(np.linalg.norm(phi, axis=2) <= whole[:, None] * (1 + 1e-9) + 1e-12)
        first = msad_vector(motion).value[0]
        for q in p[:10]:
            assert msad(motion, directions=q).value[0] <= first * (1 + 1e-9)


def test_brownian_curves_lie_above_those_of_any_direction(repeats):
    """At lags up to a twentieth of the track the order holds for all tracks, with noise too."""
    for seed in range(repeats(4, 20)):
        for noise in (0.0, 4e-4):
            motion = brownian_motion(seed, np.arange(1000.0), D_R=3e-3, angle_noise=noise)
            vector = msad_vector(motion).value[:50]
            for p in (None, *DIRECTIONS):
                assert np.all(msad(motion, directions=p).value[:50] <= vector)


def test_the_order_of_whole_curves_does_not_always_hold():
    """Coning: an omega that rotates sums to zero, the angle of a tilted direction grows past it.

    The appendix's "always" holds for steps, and for diffusion on average; not for every motion.
    """
    k = np.arange(400)
    steps = 0.2 * np.stack([np.cos(0.4 * k), np.sin(0.4 * k), 0 * k], axis=1)
    # In lab axes, so the product grows on the left: transposed, on the right.
    motion = moving(np.swapaxes(cumulative_product(exp_map(-steps)), 1, 2))
    whole = msad_vector(motion).value
    tilted = msad(motion, directions=[1.0, 0.0, 2.0]).value
    assert tilted[0] < whole[0]
    assert whole.max() < 2
    assert tilted[200] > 5 * whole.max()


@pytest.mark.parametrize("curve_of", [msad_vector, orientation_correlation])
def test_the_lab_the_unit_and_the_labels_do_not_matter(curve_of):
    """Turned, shifted, in nanometres, shuffled: the same curve; components turn as squares do."""
    x = add_noise(brownian(5, 300, D_R=1e-2).positions(), sigma=0.05, rng=5)
    base = curve_of(track_rotation(x, dt=1.0))
    q = Rotation.random(random_state=5).as_matrix()
    shift = np.array([4.0, -5.0, 6.0])
    for other in (1e3 * x, x + shift, x @ q.T, x[:, [3, 1, 0, 2]]):
        curve = curve_of(track_rotation(other, dt=1.0))
        np.testing.assert_allclose(curve.value, base.value, rtol=1e-8, atol=1e-10)
    back = curve_of(track_rotation(x[::-1], dt=1.0)).value
    np.testing.assert_allclose(back, base.value, rtol=1e-8, atol=1e-10)
    swapped = x[..., [1, 2, 0]]
    curve = msad_vector(track_rotation(swapped, dt=1.0))
    expected = msad_vector(track_rotation(x, dt=1.0)).components[:, [1, 2, 0]]
    np.testing.assert_allclose(curve.components, expected, rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(curve_of(track_rotation(x, dt=0.2)).lagtime, 0.2 * base.lagtime)


@pytest.mark.parametrize("curve_of", [msad_vector, orientation_correlation])
def test_left_out_frames_are_gaps_and_uneven_times_have_their_lags(curve_of):
    """Frame numbers with holes equal rows of NaN; times off the grid are taken as they are."""
    x = brownian(6, 100, D_R=1e-2).positions()
    holes = x.copy()
    holes[30:40] = np.nan
    kept = np.delete(np.arange(100), np.arange(30, 40))
    a = curve_of(track_rotation(holes, dt=1.0))
    b = curve_of(track_rotation(x[kept], dt=1.0, frames=kept))
    np.testing.assert_allclose(a.value, b.value, rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(a.n_pairs, b.n_pairs)
    uneven = track_rotation(x, dt=1.0, times=np.arange(100) ** 1.1)
    curve = curve_of(uneven)
    assert curve.n_pairs.sum() == 100 * 99 // 2
    total = np.sum(curve.n_pairs * curve.lagtime)
    i, j = np.triu_indices(100, 1)
    assert total == pytest.approx(np.sum(uneven.time[j] - uneven.time[i]), rel=1e-12)
    every = replace(track_rotation(x, dt=1.0), piece=np.arange(100))
    with pytest.raises(TooFewFramesError):
        curve_of(every)


# ---- orientational correlation ------------------------------------------------------------------


def legendre(degree, cosine):
    """Return P_1 or P_2."""
    return cosine if degree == 1 else (3 * cosine**2 - 1) / 2


@pytest.mark.parametrize("directions", [None, [0.0, 0.0, 2.0], DIRECTIONS])
@pytest.mark.parametrize("degree", [1, 2])
def test_correlation_is_the_direct_sum(degree, directions):
    """Gaps, pieces, one direction or several, every lag: <P_l(p.p')> to 1e-10, exact pairs."""
    motion = gappy(7)
    p0 = motion.template if directions is None else np.atleast_2d(directions)
    p = motion.orientation(p0)
    curve = orientation_correlation(motion, degree=degree, directions=directions)
    for lag in range(1, 150):
        start, stop = pairs(motion, lag)
        assert curve.n_pairs[lag - 1] == len(start)
        if len(start):
            cosine = np.sum(p[start] * p[stop], axis=-1)
            expected = legendre(degree, cosine).mean()
            assert curve.value[lag - 1] == pytest.approx(expected, rel=0, abs=1e-10)
        else:
            assert np.isnan(curve.value[lag - 1])
    np.testing.assert_array_equal(curve.components[:, 0], curve.value)
    np.testing.assert_array_equal(np.isfinite(curve.stderr), curve.n_pairs > 0)
    assert (curve.quantity, curve.unit) == ("orientation", "1")
    assert curve.dof == degree * (degree + 1) // 2


@pytest.mark.parametrize("degree", [1, 2])
def test_correlation_decays_as_exp_l_l_plus_1(degree, repeats):
    """25 isotropic runs (long: 60): exp(-2 D t) and exp(-6 D t) within 3.5 errors, D within 4 %."""
    D, lag = 1e-2, np.array([1, 5, 10, 20, 50])
    runs = [
        orientation_correlation(brownian(seed, D_R=D), degree=degree).value[lag - 1]
        for seed in range(repeats(25, 60))
    ]
    mean, error = mean_and_error(runs)
    rate = degree * (degree + 1)
    assert np.abs((mean - np.exp(-rate * D * lag)) / error).max() < 3.5
    assert -np.log(mean[1]) / (rate * lag[1]) == pytest.approx(D, rel=0.04)


def test_correlation_of_an_axial_body_decays_by_the_axes_across(repeats):
    """Along the symmetry axis the decay is exp(-2 D_perp t); across, exp(-(D_perp + D_par) t)."""
    D, lag = np.array([2e-3, 2e-3, 2e-2]), np.array([1, 10, 40])
    runs = [
        [
            orientation_correlation(brownian(seed, D_R=D), directions=p).value[lag - 1]
            for p in ([0, 0, 1.0], [1.0, 0, 0])
        ]
        for seed in range(repeats(15, 50))
    ]
    mean, error = mean_and_error(runs)
    expected = np.exp(-np.outer([4e-3, 2.2e-2], lag))
    assert np.abs((mean - expected) / error).max() < 3.5
    assert np.all(error < 0.1)


def test_correlation_of_a_steady_turn():
    """About z: cos(omega t) across, 1 along, and their P_2; lengths and signs of p do not count."""
    motion = moving(exp_map(np.outer(np.arange(100), [0, 0, 0.1])))
    cosine = np.cos(0.1 * np.arange(1, 100))
    for degree in (1, 2):
        for p in ([3.0, 0, 0], [-1e-3, 0, 0], [[0, 1.0, 0], [5.0, 5.0, 0]]):
            curve = orientation_correlation(motion, degree=degree, directions=p)
            np.testing.assert_allclose(curve.value, legendre(degree, cosine), atol=1e-10)
        still = orientation_correlation(motion, degree=degree, directions=[0, 0, -2.0])
        np.testing.assert_allclose(still.value, 1, atol=1e-12)
        assert np.all(still.value <= 1)


def test_a_particle_at_the_centre_has_no_direction():
    """By default it is left out of the average; the others' directions are those given by hand."""
    body = Cluster.from_positions(np.vstack([tetrahedron().positions, np.zeros(3)]))
    motion = brownian(8, 200, D_R=1e-2, cluster=body)
    curve = orientation_correlation(motion, degree=2)
    given = orientation_correlation(motion, degree=2, directions=motion.template[:4])
    np.testing.assert_allclose(curve.value, given.value, rtol=0, atol=1e-12)


@pytest.mark.parametrize("degree", [0, 3, -1, 1.5, "1", None, np.nan])
def test_other_degrees_are_refused(degree):
    """Only P_1 and P_2."""
    with pytest.raises(ValueError, match="degree: expected 1 or 2"):
        orientation_correlation(brownian(9, 10), degree=degree)


def test_the_plane_and_bad_directions_are_refused():
    """A planar motion has no correlation here; zero, misshapen and missing directions are named."""
    with pytest.raises(ValueError, match="three dimensions"):
        orientation_correlation(planar(9, 100))
    for p in ([0, 0, 0], [1.0, 0], [np.nan, 0, 1.0]):
        with pytest.raises(ValueError, match="p0"):
            orientation_correlation(brownian(9, 10), directions=p)
