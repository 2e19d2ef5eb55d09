"""Stated errors against those that rigid bodies show, and motions that all bodies share."""

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

import perrin
from perrin.motion import common_motion, error_ratio, with_error_ratio

BODY = perrin.Cluster.touching(4, 2.45)


def bodies(sigma, stated, *, count=4, n_frames=40, seed=0):
    """Return motions, positions and stated variances of bodies with another error."""
    found = []
    for k in range(count):
        rng = np.random.default_rng(100 * seed + k)
        truth = perrin.simulate_motion(BODY, D_R=5e-3, D_T=0.04, dt=0.7, n_frames=n_frames, rng=rng)
        z = truth.center[:, None, 2:]
        error = np.asarray(sigma(truth.time[:, None, None], z)) * rng.normal(size=(n_frames, 4, 3))
        x = truth.positions() + error
        found.append(
            (perrin.track_rotation(x, dt=0.7), x, np.full((n_frames, 3), 1.0) * np.square(stated))
        )
    return found


def test_ratios_of_the_axes_are_found_and_scale_the_poses():
    """Errors of (1, 1.5, 3) times the stated ones come back, and poses err as is then stated."""
    factor, sigma = np.array([1.0, 1.5, 3.0]), 0.01
    measured, squares = [], []
    for seed in range(5):
        sample = bodies(lambda t, z: sigma * factor, sigma, seed=seed)
        ratio = error_ratio(sample)
        assert (ratio.by_time, ratio.by_depth) == (0.0, 0.0)
        measured.append((ratio.measured - factor**2) / ratio.stderr)
        for k, (motion, x, stated) in enumerate(sample):
            truth = perrin.simulate_motion(
                BODY, D_R=5e-3, D_T=0.04, dt=0.7, n_frames=40,
                rng=np.random.default_rng(100 * seed + k),
            )  # fmt: skip
            plain = perrin.track_rotation(x, dt=0.7, sigma=sigma)
            scaled = with_error_ratio(plain, ratio.at(motion.time, motion.center[:, 2]), stated[0])
            apart = np.swapaxes(truth.rotation, 1, 2) @ motion.rotation
            mean = Rotation.from_matrix(apart).mean()
            error = (mean.inv() * Rotation.from_matrix(apart)).as_rotvec()
            inverse = np.linalg.inv(scaled.covariance)
            squares.append(np.einsum("ta,tab,tb->", error, inverse, error) / (3 * 39))
    # 15 standardised deviations, and 20 squares that scatter by 15 %.
    assert np.abs(measured).max() < 4
    assert np.std(measured) == pytest.approx(1, abs=0.4)
    assert np.mean(squares) == pytest.approx(1, abs=0.1)


def test_poses_that_weigh_the_axes_err_as_is_then_stated():
    """Fitted with stated errors of 1, 1, 1.4 where that of z is 3.5: squares are 1 within 10 %."""
    sigma, true = np.array([0.01, 0.01, 0.014]), np.array([0.01, 0.01, 0.035])
    squares = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        truth = perrin.simulate_motion(BODY, D_R=5e-3, dt=0.7, n_frames=40, rng=rng)
        x = truth.positions() + true * rng.normal(size=(40, 4, 3))
        plain = perrin.track_rotation(x, dt=0.7, sigma=sigma, weights="sigma")
        scaled = with_error_ratio(plain, np.tile((true / sigma) ** 2, (40, 1)), sigma**2)
        apart = np.swapaxes(truth.rotation, 1, 2) @ plain.rotation
        error = Rotation.from_matrix(apart)
        error = (error.mean().inv() * error).as_rotvec()
        inverse = np.linalg.inv(scaled.covariance)
        squares.append(np.einsum("ta,tab,tb->", error, inverse, error) / (3 * 39))
    assert np.mean(squares) == pytest.approx(1, abs=0.1)


def test_true_errors_are_left_as_they_are():
    """Where the stated errors are right the ratios stay within two errors, mostly at one."""
    values = [
        error_ratio(bodies(lambda t, z: 0.01, 0.01, seed=s, n_frames=20)).value for s in range(10)
    ]
    assert np.mean(values) == pytest.approx(1, abs=0.05)
    assert np.abs(np.array(values) - 1).max() < 0.5


@pytest.mark.parametrize(
    ("sigma", "name", "rate"),
    [
        (lambda t, z: 0.01 * np.exp(0.5 * 0.04 * t), "by_time", 0.04),
        (lambda t, z: 0.01 * np.exp(0.5 * 0.6 * z), "by_depth", 0.6),
    ],
)
def test_errors_that_change_with_time_or_depth(sigma, name, rate):
    """Planted changes of the logarithm of the variance come back within four of their errors."""
    ratio = error_ratio(bodies(sigma, 0.01, n_frames=100))
    other = {"by_time": "by_depth", "by_depth": "by_time"}[name]
    assert getattr(ratio, name) == pytest.approx(rate, rel=0.25)
    assert getattr(ratio, other) == 0


def test_units_and_the_order_of_bodies_do_not_matter():
    """Ratios have no unit; bodies may come in any order."""
    sample = bodies(lambda t, z: np.array([0.01, 0.01, 0.02]), 0.01)
    one = error_ratio(sample)
    nm = [
        (perrin.track_rotation(1e3 * x, dt=0.7), 1e3 * x, 1e6 * stated) for _, x, stated in sample
    ]
    np.testing.assert_allclose(error_ratio(nm[::-1]).measured, one.measured, rtol=1e-6)


def test_axes_that_agree_have_one_ratio():
    """Twenty frames of errors twice the stated ones: axes that differ by chance are drawn together.

    With an error along z that is five times as large, that of x and y stays below 1.5.
    """
    ratio = error_ratio(bodies(lambda t, z: 0.02, 0.01, n_frames=20, seed=3))
    assert np.ptp(ratio.value) < 0.5 * np.ptp(ratio.measured)
    assert ratio.value.mean() == pytest.approx(4, abs=1)
    ratio = error_ratio(bodies(lambda t, z: np.array([0.01, 0.01, 0.05]), 0.01, n_frames=20))
    assert ratio.value[:2].max() < 1.5
    assert ratio.value[2] > 15


def test_few_frames_determine_no_ratio():
    """Two frames leave the stated errors."""
    ratio = error_ratio(bodies(lambda t, z: 0.03, 0.01, n_frames=2))
    assert ratio.is_one
    assert np.isnan(ratio.measured).all()


def moving_together(common, *, count=3, n_frames=201, seed=1):
    """Return a table of bodies far apart whose positions share a displacement in every frame."""
    tables = []
    for k in range(count):
        truth = perrin.simulate_motion(
            BODY, D_R=5e-3, D_T=0.04, dt=0.7, n_frames=n_frames, rng=100 * seed + k
        )
        x = perrin.add_noise(truth.positions(), sigma=0.005, rng=k) + common[:, None]
        table = perrin.positions_table(x + np.array([40.0 * k, 0, 0])).assign(cluster=k)
        tables.append(table.assign(particle=table["particle"] + 4 * k))
    return pd.concat(tables, ignore_index=True)


@pytest.mark.usefixtures("no_tensors", "no_verdicts")
def test_a_stage_that_does_not_return_is_named_and_harmless():
    """Random common places along z are a note with their size, and D_T is that of the bodies."""
    jitter = np.zeros((201, 3))
    still = perrin.analyze(moving_together(jitter), dt=0.7)
    jitter[:, 2] = np.random.default_rng(3).normal(0, 0.3, 201)
    report = perrin.analyze(moving_together(jitter), dt=0.7)
    (note,) = [n for n in report.notes if n.startswith("common motion")]
    assert "along z" in note
    # The square of the common step is 2 sigma^2: 420 nm; 200 steps give it to 5 %.
    size = float(note.split(" nm a frame")[0].split()[-1])
    assert size == pytest.approx(1e3 * np.sqrt(2) * 0.3, rel=0.15)
    difference = report.pooled.D_T.value - still.pooled.D_T.value
    assert abs(difference) < 2 * report.pooled.D_T.stderr
    assert not [n for n in (*still.notes, *still.warnings) if n.startswith("common motion")]


def test_a_common_random_walk_is_a_warning():
    """A stage that wanders is in D_T, and the warning says so."""
    walk = np.random.default_rng(4).normal(0, 0.4, (201, 3)).cumsum(axis=0)
    report = perrin.analyze(moving_together(walk), dt=0.7)
    (text,) = [w for w in report.warnings if w.startswith("common motion")]
    assert "along x, y, z" in text
    assert "D_T contains this motion" in text


def test_common_motion_has_its_level(repeats):
    """Independent bodies: p is uniform; laws of units, order and reversal hold."""
    chances = []
    for seed in range(repeats(60, 1000)):
        rng = np.random.default_rng(seed)
        motions = [
            perrin.simulate_motion(BODY, D_R=5e-3, D_T=0.04, dt=0.7, n_frames=100, rng=rng)
            for _ in range(3)
        ]
        found = common_motion([(m, np.arange(100)) for m in motions])
        chances.append(found.p)
    # p is three times that of the largest of three axes, at most 1.
    assert np.mean(np.array(chances) < 0.1) < 0.25
    backwards = common_motion([(m, np.arange(100) + 5) for m in motions[::-1]])
    np.testing.assert_allclose(backwards.covariance, found.covariance)
    assert common_motion([(motions[0], np.arange(100))]) is None
    apart = [(motions[0], np.arange(100)), (motions[1], np.arange(100) + 500)]
    assert common_motion(apart) is None
