"""Non-Gaussian parameters: the law on SO(3), planted mixtures, noise, errors and refusals."""

from dataclasses import replace

import numpy as np
import pytest

from brownian_motions import brownian_motion, motion_with_gaps, tetrahedron, with_poses
from perrin import TooFewFramesError, brownian_alpha2, non_gaussian, van_hove
from perrin.curves import brownian_angle_time, heat_kernel_moments
from perrin.geometry.rotations import cumulative_product, exp_map
from perrin.motion import heat_kernel_angles


def switching(seed, n=1000, *, snr, mean=1e-4):
    """Return rotation and translation with tenfold switching, dwell 50, and noise of known s."""
    rng = np.random.default_rng(seed)
    state = (np.cumsum(rng.random(n) < 1 / 50) + rng.integers(2)) % 2
    size = np.sqrt(4 * mean / 11 * np.where(state == 1, 10.0, 1.0))[:, None]
    s = mean / snr
    rotation = cumulative_product(exp_map(size * rng.normal(size=(n, 3))))
    rotation = rotation @ exp_map(np.sqrt(s) * rng.normal(size=(n + 1, 3)))
    walk = np.cumsum(np.vstack([np.zeros(3), size * rng.normal(size=(n, 3))]), axis=0)
    center = walk + np.sqrt(s) * rng.normal(size=walk.shape)
    motion = with_poses(tetrahedron(), np.arange(n + 1.0), rotation=rotation, center=center)
    return replace(
        motion, covariance=np.tile(s * np.eye(3), (n + 1, 1, 1)), center_variance=np.full(n + 1, s)
    )


@pytest.mark.parametrize("Dt", [1e-4, 0.01, 0.3, 0.9, 2.0])
def test_moments_are_those_of_the_simulated_angles(Dt):
    """<a^2>, <a^4> from the distribution that simulate_motion draws from, to 1e-5."""
    angle, cdf = heat_kernel_angles(Dt)
    middle, part = (angle[1:] + angle[:-1]) / 2, np.diff(cdf)
    square, fourth = heat_kernel_moments(Dt)
    assert square == pytest.approx(middle**2 @ part, rel=1e-5)
    assert fourth == pytest.approx(middle**4 @ part, rel=1e-5)
    assert brownian_angle_time(square) == pytest.approx(Dt, rel=1e-9)


def test_the_law_is_smooth_and_ends_at_uniform_rotations():
    """Series and expansion meet at D t = 0.001; alpha_2 falls from 0 to that of (1 - cos a)/pi."""
    Dt = np.array([0.0, 9.99e-4, 1.001e-3, 0.05, 0.5, 5.0, 50.0])
    law = brownian_alpha2(Dt)
    assert law[0] == 0
    assert abs(law[2] - law[1]) < 1e-8
    assert np.all(np.diff(law) <= 1e-12)
    a = (np.arange(100_000) + 0.5) * np.pi / 100_000
    density = (1 - np.cos(a)) / 100_000
    uniform = 3 * (a**4 @ density) / (5 * (a**2 @ density) ** 2) - 1
    assert law[-1] == pytest.approx(uniform, rel=1e-6)
    for bad in (-1.0, np.nan, [0.1, np.inf]):
        with pytest.raises(ValueError, match="Dt: expected finite numbers"):
            brownian_alpha2(bad)


@pytest.mark.parametrize("quantity", ["rotation", "translation"])
def test_switching_has_its_parameter_whatever_the_noise(quantity, repeats):
    """SNR 0.5, 15 tracks (long: 400): half of it raw, all of it corrected, by every noise model.

    At a lag of 5 steps and dwell 50 it is 0.64, within 0.05 and three Monte-Carlo errors; the
    stated error is the scatter within 25 % and three Monte-Carlo errors.
    """
    n = repeats(15, 400)
    runs = [switching(seed, snr=0.5) for seed in range(n)]
    raw = [non_gaussian(m, quantity=quantity, lags=[5.0], noise=None).value[0] for m in runs]
    assert np.mean(raw) == pytest.approx(0.32, abs=0.05 + 3 * np.std(raw) / np.sqrt(n))
    for noise in ("residual", "joint"):
        curves = [non_gaussian(m, quantity=quantity, lags=[5.0], noise=noise) for m in runs]
        values = [c.value[0] for c in curves]
        scatter = np.std(values, ddof=1)
        assert np.mean(values) == pytest.approx(0.64, abs=0.05 + 3 * scatter / np.sqrt(n))
        stated = np.mean([c.stderr[0] for c in curves])
        assert abs(np.log(stated / scatter)) < 0.25 + 3 / np.sqrt(2 * n)
    found = [van_hove(m, quantity=quantity, lag=5.0) for m in runs]
    scatter = np.std([f.alpha2 for f in found]) / np.sqrt(n)
    assert np.mean([f.alpha2 for f in found]) == pytest.approx(0.64, abs=0.05 + 3 * scatter)
    assert np.mean([f.alpha2_measured for f in found]) < 0.45


def test_brownian_rotation_follows_its_law_to_large_angles(repeats):
    """Lags to D t = 0.5: the mean over 8 tracks (long: 100) is the law within 3.5 errors."""
    n, lags = repeats(8, 100), [1.0, 5.0, 25.0]
    curves = [
        non_gaussian(brownian_motion(seed, np.arange(2001.0), D_R=0.02), lags=lags)
        for seed in range(n)
    ]
    values = np.array([c.value for c in curves])
    error = values.std(axis=0, ddof=1) / np.sqrt(n)
    assert np.all(
        np.abs(values.mean(axis=0) - brownian_alpha2(0.02 * np.array(lags))) < 3.5 * error
    )
    law = np.mean([c.brownian for c in curves], axis=0)
    np.testing.assert_allclose(law, brownian_alpha2(0.02 * np.array(lags)), rtol=0.2, atol=1e-4)
    assert np.mean([c.stderr for c in curves]) > 0.6 * values.std(axis=0).mean()


def test_unit_direction_of_time_and_lab_do_not_matter():
    """Scaled, reversed and turned: the same curve; errors of blocks are those of the pairs."""
    motion = switching(3, 400, snr=5.0)
    for quantity in ("rotation", "translation"):
        base = non_gaussian(motion, quantity=quantity)
        turn = exp_map(np.array([0.3, -1.0, 0.5]))
        other = [
            replace(motion, rotation=turn @ motion.rotation, center=motion.center @ turn.T + 1e3),
            replace(
                motion, center=1e3 * motion.center, center_variance=1e6 * motion.center_variance
            ),
        ]
        for m in other:
            curve = non_gaussian(m, quantity=quantity)
            np.testing.assert_allclose(curve.value, base.value, rtol=1e-6)
            np.testing.assert_allclose(curve.stderr, base.stderr, rtol=1e-6)
        back = replace(motion, rotation=motion.rotation[::-1], center=motion.center[::-1])
        reverse = non_gaussian(back, quantity=quantity, lags=[1.0])
        assert reverse.value[0] == pytest.approx(base.value[0], rel=0.05)
        assert (base.quantity, base.unit) == ("non-Gaussian", "1")


def test_pairs_respect_gaps_and_pieces():
    """The numbers of pairs are those of the frames; lags are whole steps up to the track."""
    motion = motion_with_gaps(7)
    curve = non_gaussian(motion, lags=[1.0, 6.0])
    here = np.isfinite(motion.center[:, 0])
    for lag, pairs in zip((1, 6), curve.n_pairs, strict=True):
        both = here[lag:] & here[:-lag] & (motion.piece[lag:] == motion.piece[:-lag])
        assert pairs == both.sum()
    with pytest.raises(ValueError, match="lags: expected whole multiples of 1 s"):
        non_gaussian(motion, lags=[1.5])
    with pytest.raises(ValueError, match=r"quantity: expected .*; noise: expected"):
        non_gaussian(motion, quantity="spin", noise=-1.0)
    with pytest.raises(TooFewFramesError, match="lags apart"):
        non_gaussian(motion, lags=[1000.0])
    with pytest.raises(ValueError, match="does not move"):
        non_gaussian(with_poses(tetrahedron(), np.arange(50.0)))


def test_noise_beyond_the_motion_leaves_no_value():
    """A stated noise above the mean square: NaN, and van_hove agrees."""
    motion = brownian_motion(1, np.arange(200.0), D_R=1e-3)
    assert np.isnan(non_gaussian(motion, noise=1.0, lags=[1.0]).value).all()
    found = van_hove(motion, lag=1.0, noise=1.0)
    assert np.isnan(found.alpha2)
    assert np.isfinite(found.alpha2_measured)


def test_van_hove_of_the_angle_follows_the_heat_kernel(repeats):
    """D t = 0.6, 4000 steps (long: 40000): the counts follow the heat kernel and no Gaussian."""
    n = repeats(4000, 40000)
    rng = np.random.default_rng(5)
    angle, cdf = heat_kernel_angles(0.6)
    axis = rng.normal(size=(n, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    turn = np.interp(rng.random(n), cdf, angle)[:, None] * axis
    motion = with_poses(
        tetrahedron(), np.arange(n + 1.0), rotation=cumulative_product(exp_map(turn))
    )
    edges = np.linspace(0, np.pi, 9)
    found = van_hove(motion, lag=1.0, quantity="angle", bins=edges)
    apart = np.abs(found.density - found.brownian) / found.stderr
    assert apart.max() < 4
    assert (np.abs(found.density - found.gaussian) / found.stderr).max() > 6
    assert found.density @ np.diff(edges) == pytest.approx(1)
    assert found.alpha2_brownian == pytest.approx(float(brownian_alpha2(0.6)), abs=0.01)
    assert abs(found.alpha2 - found.alpha2_brownian) < 4 * found.alpha2_stderr
