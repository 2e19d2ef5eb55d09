"""Laws of fitted fractional and confined motion."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import cholesky, toeplitz

from brownian_motions import brownian_motion, motion_with_gaps, tetrahedron, with_poses
from perrin import (
    AnomalousEstimate,
    Cluster,
    ConfinedEstimate,
    Noise,
    add_noise,
    fit_anomalous,
    fit_confined,
    simulate_motion,
    track_rotation,
)
from perrin.diffusion import (
    ShapeLikelihood,
    StepBlock,
    confined_mean_square,
    fractional_autocovariance,
    fractional_mean_square,
    log_sums,
    step_autocovariance,
    step_covariance,
    steps_of,
)
from perrin.geometry import cumulative_product, exp_map


def fractional_steps(alpha, n, seed, *, exposure=0.0):
    """Return n steps of fractional Brownian motion with D = 1 along three axes."""
    covariance = toeplitz(fractional_autocovariance(alpha, n, exposure=exposure))
    return cholesky(covariance, lower=True) @ np.random.default_rng(seed).normal(size=(n, 3))


def walk_of(steps, noise, seed):
    """Return the motion of a centre with these steps and noise of this variance."""
    walk = np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
    walk += np.sqrt(noise) * np.random.default_rng(seed).normal(size=walk.shape)
    return with_poses(tetrahedron(), np.arange(float(len(walk))), center=walk)


def confined_walk(rate, n, seed):
    """Return n places of an Ornstein-Uhlenbeck process with D = 1 along three axes."""
    walk = np.random.default_rng(seed).normal(size=(n, 3)) / np.sqrt(rate)
    for i in range(1, n):
        walk[i] = np.exp(-rate) * walk[i - 1] + np.sqrt(-np.expm1(-2 * rate)) * walk[i]
    return walk


def without_frames(motion, share, seed):
    """Return a motion in which a share of the frames has no pose."""
    lost = np.random.default_rng(seed).random(len(motion.time)) < share
    lost[[0, -1]] = False
    center, rotation = motion.center.copy(), motion.rotation.copy()
    center[lost], rotation[lost] = np.nan, np.nan
    return replace(motion, center=center, rotation=rotation)


def reversed_in_time(motion):
    """Return the motion with its frames in reverse order."""
    return replace(motion, center=motion.center[::-1], rotation=motion.rotation[::-1])


@pytest.mark.parametrize("exposure", [0.0, 0.4])
def test_covariance_of_steps_between_any_times(exposure):
    """Steps of one frame have the autocovariance; a longer step is the sum of its parts."""

    def square(lag):
        return fractional_mean_square(lag, 0.6, exposure=exposure)

    whole = step_covariance(np.arange(8.0), square)
    np.testing.assert_allclose(
        whole, toeplitz(fractional_autocovariance(0.6, 7, exposure=exposure)), atol=1e-12
    )
    time = np.array([0.0, 1, 4, 5, 7])
    sums = np.add.reduceat(np.eye(7), time[:-1].astype(int), axis=0)
    np.testing.assert_allclose(step_covariance(time, square), sums @ whole @ sums.T, atol=1e-12)


@pytest.mark.parametrize("rate", [1e-9, 0.02, 0.2, 3.0])
def test_blurred_confined_motion_is_the_average_over_the_open_shutter(rate):
    """The mean square difference of averages of many substeps; midpoint errors are 1/(12 n^2)."""
    n, exposure = 400, 0.7
    times = exposure * (np.arange(n) + 0.5) / n
    pairs = np.abs(times[:, None] - times)
    for lag in (1.0, 5.0):
        across = confined_mean_square(np.abs(lag + times[:, None] - times), rate)
        inside = confined_mean_square(pairs, rate)
        assert confined_mean_square(np.array(lag), rate, exposure=exposure) == pytest.approx(
            across.mean() - inside.mean(), rel=1e-4
        )


@pytest.mark.parametrize("known", [None, np.array([0.1, 0.2])])
@pytest.mark.parametrize("even", [True, False])
def test_slope_is_the_derivative_of_the_profile_likelihood(even, known):
    """Central differences agree; with gaps too."""
    rng = np.random.default_rng(4)
    time = np.arange(41.0) if even else np.cumsum(rng.integers(1, 4, 41)).astype(float)
    block = StepBlock(rng.normal(size=(40, 2)), time, even)

    def fractional(lag, shape):
        return fractional_mean_square(lag, shape)

    likelihood = ShapeLikelihood(((block,),), fractional, (known,), n_axes=2)
    low, middle, high = (likelihood.at(x) for x in (0.699, 0.7, 0.701))
    assert middle.slope == pytest.approx((high.value - low.value) / 0.002, abs=1e-3)


def test_sine_modes_agree_with_the_exact_likelihood():
    """For Brownian motion they are equal, for others the exponent differs by far less than errors.

    The elements of the covariance off the diagonal are left out; its effect on alpha was 0.2
    standard errors at most in 40 tracks.
    """
    steps = fractional_steps(0.6, 100, 3) + np.diff(
        0.3 * np.random.default_rng(1).normal(size=(101, 3)), axis=0
    )
    time = np.arange(101.0)
    found = []
    for even in (True, False):
        block = StepBlock(steps, time, even)

        def fractional(lag, shape):
            return fractional_mean_square(lag, shape)

        likelihood = ShapeLikelihood(((block,),), fractional, (None,), n_axes=3)
        best, points = likelihood.best(np.linspace(0.1, 1.9, 8))
        found.append((likelihood.at(1.0), best, likelihood.crossings(best, points, [1.0])[0]))
    (free, best, (low, high)), (exact_free, exact, _) = found
    assert pytest.approx(exact_free.D, rel=1e-7) == free.D
    assert free.offset == pytest.approx(exact_free.offset, rel=1e-6)
    assert abs(best.shape - exact.shape) < 0.25 * (high.shape - low.shape)


@pytest.mark.parametrize("model", ["joint", 0.02])
@pytest.mark.parametrize("gaps", [0.0, 0.2])
def test_shapes_together_are_those_alone(model, gaps):
    """With even and uneven steps, and with free and known noise, to the end of the searches."""
    rng = np.random.default_rng(4)
    truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=90, rng=4)
    positions = add_noise(truth.positions(), sigma=0.02, rng=4)
    positions[1:][rng.random(89) < gaps] = np.nan
    steps = [steps_of(track_rotation(positions, dt=0.7), "rotation")]
    likelihood = ShapeLikelihood.of(steps, Noise(model), fractional_mean_square)
    shapes = np.array([0.3, 1.0, 1.7])
    alone = [likelihood.at(shape) for shape in shapes]
    np.testing.assert_allclose(likelihood.at_each(shapes), alone, rtol=1e-7, atol=1e-9)
    best, points = likelihood.best(np.linspace(0.1, 1.9, 8))
    for drop, ends in zip(
        (1.0, 3.84), likelihood.crossings(best, points, [1.0, 3.84]), strict=True
    ):
        falls = [2 * (best.value - end.value) for end in ends if end is not None]
        assert falls == pytest.approx([drop] * len(falls), rel=1e-6)
        assert falls


def test_logarithms_are_summed_as_they_are():
    """Of numbers near both ends of the range, in any number of them, and of infinity and NaN."""
    rng = np.random.default_rng(1)
    for count in (1, 7, 8, 50):
        x = 10.0 ** rng.uniform(-37, 37, (3, count))
        np.testing.assert_allclose(log_sums(x), np.log(x).sum(axis=1), rtol=1e-13, atol=1e-12)
    assert np.isnan(log_sums(np.array([1.0, np.nan])))


@pytest.mark.parametrize(("alpha", "gaps"), [(0.5, 0.0), (1.0, 0.0), (1.5, 0.0), (0.6, 0.5)])
def test_planted_exponent_is_found(alpha, gaps):
    """Three standard errors, for even tracks and one with gaps; the MSD at its best lag too."""
    motion = without_frames(walk_of(fractional_steps(alpha, 250, 11), 0.2, 12), gaps, 1)
    found = fit_anomalous(motion, quantity="translation")
    assert abs(found.alpha - alpha) < 3 * found.stderr
    truth = 6 * found.best_lag**alpha
    assert abs(found.msd_at_best_lag - truth) < 3 * found.msd_at_best_lag_stderr
    assert 0.2 * found.msd_at_best_lag > found.msd_at_best_lag_stderr


def test_planted_exponent_is_found_with_an_open_shutter():
    """The blurred covariance reads the exponent, and the noise without a lower limit of its own."""
    motion = walk_of(fractional_steps(0.5, 300, 5, exposure=1.0), 0.1, 6)
    found = fit_anomalous(motion, quantity="translation", exposure=1.0)
    assert abs(found.alpha - 0.5) < 3 * found.stderr
    assert 0 <= found.offset < 0.4


def test_known_noise_halves_the_error_of_the_exponent():
    """At a signal-to-noise ratio of 5 the errors are 0.087 and 0.046."""
    motion = walk_of(fractional_steps(1.0, 300, 7), 0.2, 8)
    # The centre of n particles has the noise sigma^2/n.
    sigma = np.sqrt(0.2 * len(tetrahedron().positions))
    free, known = (
        fit_anomalous(motion, quantity="translation", noise=noise) for noise in ("joint", sigma)
    )
    assert known.stderr < 0.7 * free.stderr
    assert known.offset == pytest.approx(0.2)
    assert abs(known.alpha - 1) < 3 * known.stderr


@pytest.mark.parametrize("gaps", [0.0, 0.3])
def test_anomalous_estimate_follows_units_and_not_the_direction_of_time(gaps):
    """Lengths in nm, times in minutes; the frames in reverse order."""
    motion = without_frames(walk_of(fractional_steps(0.7, 60, 2), 0.2, 3), gaps, 4)
    one = fit_anomalous(motion, quantity="translation")
    scaled = replace(motion, center=1e3 * motion.center, time=60 * motion.time, dt=60.0)
    other = fit_anomalous(scaled, quantity="translation")
    assert other.alpha == pytest.approx(one.alpha, abs=1e-6)
    assert other.D_alpha == pytest.approx(1e6 * one.D_alpha / 60**one.alpha, rel=1e-5)
    assert other.best_lag == pytest.approx(60 * one.best_lag, rel=1e-5)
    assert other.msd_at_best_lag == pytest.approx(1e6 * one.msd_at_best_lag, rel=1e-5)
    assert other.log_likelihood_gain == pytest.approx(one.log_likelihood_gain, abs=1e-6)
    back = fit_anomalous(reversed_in_time(motion), quantity="translation")
    assert back.alpha == pytest.approx(one.alpha, abs=1e-6)
    assert back.ci95 == pytest.approx(one.ci95, abs=1e-6)


def test_anomalous_rotation_does_not_depend_on_the_lab():
    """A turned lab leaves body steps, and so the estimate, as they are."""
    motion = brownian_motion(3, np.arange(150.0), D_R=2e-3, angle_noise=4e-4)
    turn = exp_map(np.array([0.3, -1.0, 0.5]))
    one, other = (
        fit_anomalous(m) for m in (motion, replace(motion, rotation=turn @ motion.rotation))
    )
    assert other.alpha == pytest.approx(one.alpha, abs=1e-6)
    assert other.D_alpha == pytest.approx(one.D_alpha, rel=1e-5)


@pytest.mark.parametrize("frame", ["lab", "body"])
def test_frame_of_the_memory_is_found_for_large_turns(frame):
    """Of turns of 0.3 rad a frame with memory in one frame the other one sees less."""
    turns = exp_map(0.3 / np.sqrt(2) * fractional_steps(0.4, 300, 9))
    rotation = cumulative_product(turns)
    if frame == "lab":
        rotation = np.swapaxes(cumulative_product(np.swapaxes(turns, 1, 2)), 1, 2)
    found = fit_anomalous(with_poses(tetrahedron(), np.arange(301.0), rotation=rotation))
    assert found.frame == frame
    assert abs(found.alpha - 0.4) < 3 * found.stderr


def test_pooled_copies_double_the_gain():
    """Two copies of a motion have the same maximum, twice the gain and narrower intervals."""
    motion = walk_of(fractional_steps(0.6, 100, 1), 0.2, 2)
    one, both = (fit_anomalous(m, quantity="translation") for m in (motion, [motion, motion]))
    assert both.log_likelihood_gain == pytest.approx(2 * one.log_likelihood_gain, rel=1e-6)
    assert both.alpha == pytest.approx(one.alpha, abs=1e-7)
    assert both.D_alpha == pytest.approx(one.D_alpha, rel=1e-6)
    assert both.stderr == pytest.approx(one.stderr / np.sqrt(2), rel=0.1)
    assert both.msd_at_best_lag_stderr == pytest.approx(
        one.msd_at_best_lag_stderr / np.sqrt(2), rel=0.1
    )


@pytest.mark.parametrize("quantity", ["translation", "rotation"])
def test_planted_cage_is_found(quantity):
    """A cage of 5 steps seen for 20 relaxation times; all three numbers in their 99.9 % ranges."""
    rate, scale = 0.02, 0.3 * np.sqrt(0.02)
    walk = scale * confined_walk(rate, 1000, 3)
    walk += 0.4 * scale * np.random.default_rng(5).normal(size=walk.shape)
    fields = {"center": walk} if quantity == "translation" else {"rotation": exp_map(walk)}
    found = fit_confined(
        with_poses(tetrahedron(), 2.0 * np.arange(1000.0), dt=2.0, **fields), quantity=quantity
    )
    truths = {"relaxation_time": 2 / rate, "cage": 0.3, "D_short": scale**2 / 2}
    for name, truth in truths.items():
        low, high = getattr(found, f"{name}_ci95")
        value = getattr(found, name)
        assert low < value < high
        # The 95 % ends are 1.96 errors away; 3.3 errors of the logarithm are allowed.
        assert (low / value) ** 1.7 < truth / value < (high / value) ** 1.7, name
    assert found.resolved
    assert found.frame == ("mean" if quantity == "rotation" else "lab")
    assert found.cage**2 == pytest.approx(found.D_short * found.relaxation_time, rel=1e-9)


def test_free_motion_shows_no_cage():
    """The interval is open, and the text gives only its lower end."""
    motion = walk_of(fractional_steps(1.0, 300, 21), 0.2, 22)
    found = fit_confined(motion, quantity="translation")
    assert not found.resolved
    assert found.relaxation_time_ci95[1] == np.inf
    assert str(found).startswith("cage, if any, larger than")
    assert found.D_short_ci95[0] < 1 < found.D_short_ci95[1]


def test_cage_that_relaxes_within_a_frame_is_noise():
    """Its positions are white noise; a warning says that it cannot be told from noise."""
    walk = confined_walk(4.0, 400, 6)
    found = fit_confined(
        with_poses(tetrahedron(), np.arange(400.0), center=walk), quantity="translation"
    )
    assert found.relaxation_time_ci95[0] == 0
    assert found.relaxation_time > 1 or "noise" in found.warnings[0]


def test_results_survive_json():
    """Also those with open ends, and those of motions with gaps and pieces."""
    motion = motion_with_gaps(3, 100)
    for found, kind in (
        (fit_anomalous(motion), AnomalousEstimate),
        (fit_confined(motion, exposure=0.5), ConfinedEstimate),
    ):
        assert isinstance(found, kind)
        assert kind.from_dict(json.loads(json.dumps(found.to_dict()))) == found


@pytest.mark.parametrize("fit", [fit_anomalous, fit_confined])
def test_faults_are_listed_together(fit):
    """What was expected and what came; a body at rest has no spectrum."""
    motion = brownian_motion(1, np.arange(20.0), D_T=1.0)
    with pytest.raises(ValueError, match=r"quantity: .*; noise: .*; exposure: "):
        fit(motion, quantity="speed", noise="loud", exposure=2.0)
    with pytest.raises(ValueError, match="all steps are 0"):
        fit(with_poses(tetrahedron(), np.arange(20.0)), quantity="translation")


def test_autocovariance_of_a_stationary_place():
    """Independent places have the covariance of differences: 2, -1, 0 for variance 1."""
    np.testing.assert_allclose(step_autocovariance(np.array([0.0, 2, 2, 2])), [2, -1, 0])
