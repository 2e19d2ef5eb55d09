"""Bodies whose particles are recorded one after another: their poses at one instant."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import perrin
from perrin.motion import RigidMotion, scan_share

DT, D_R, D_T, SIGMA = 0.73, 0.0049, 0.0385, 0.004
BODY = perrin.Cluster.touching(4, 2.45)


def recorded(n_frames, *, rng, rate=0.05, steps=73, body=BODY, crossing=0):
    """Return positions at their own times, these times after the frames, and the fine motion.

    A plane rises at 1/rate (um/s) through each frame; a particle is seen where it meets it, or over
    `crossing` fine steps about that: x and y with the weights of a semicircle, z at both ends.
    """
    h = DT / steps
    truth = perrin.simulate_motion(body, D_R=D_R, D_T=D_T, dt=h, n_frames=n_frames * steps, rng=rng)
    fine = truth.positions().reshape(n_frames, steps, len(body.positions), 3)
    fine = fine + np.array([0, 0, 6.0 - fine[..., 2].mean()])
    met = np.abs(fine[..., 2] * rate - (np.arange(steps) * h)[:, None]).argmin(axis=1)
    x = np.take_along_axis(fine, met[:, None, :, None], axis=1)[:, 0]
    if crossing:
        near = np.arange(-(crossing // 2), crossing // 2 + 1)
        weight = np.sqrt(np.maximum((crossing / 2 + 0.5) ** 2 - near**2, 0.0))
        at = np.clip(met[:, None, :] + near[:, None], 0, steps - 1)
        passed = np.take_along_axis(fine, at[..., None], axis=1)
        x = np.average(passed, axis=1, weights=weight)
        x[..., 2] = 0.5 * (passed[:, 0, :, 2] + passed[:, -1, :, 2])
    return x + rng.normal(0, SIGMA, x.shape), met * h, truth


def test_particles_recorded_at_once_give_the_usual_motion():
    """Equal times of all particles, different from frame to frame, change nothing."""
    rng = np.random.default_rng(1)
    truth = perrin.simulate_motion(BODY, D_R=D_R, D_T=D_T, dt=DT, n_frames=40, rng=rng)
    x = perrin.add_noise(truth.positions(), sigma=0.02, rng=rng)
    delays = np.repeat(rng.uniform(0, 0.5, (40, 1)), 4, axis=1)
    usual = perrin.track_rotation(x, dt=DT, sigma=0.02)
    motion = perrin.track_rotation(x, dt=DT, sigma=0.02, delays=delays)
    np.testing.assert_allclose(motion.rotation, usual.rotation, atol=1e-4)
    np.testing.assert_allclose(motion.center, usual.center, atol=1e-9)
    np.testing.assert_allclose(motion.covariance, usual.covariance, rtol=1e-3, atol=1e-9)
    np.testing.assert_allclose(motion.turn_noise, motion.covariance, rtol=1e-9, atol=1e-12)


def test_poses_follow_the_axes_and_the_order_of_the_particles():
    """A turn about z, a shift, a later clock and another order of the particles go through."""
    rng = np.random.default_rng(2)
    x, delays, _ = recorded(30, rng=rng)
    motion = perrin.track_rotation(x, dt=DT, delays=delays, crossing=0.1)
    turn = Rotation.from_rotvec([0, 0, 0.7]).as_matrix()
    order = [2, 0, 3, 1]
    moved = perrin.track_rotation(
        (x @ turn.T + [3.0, -1.0, 2.0])[:, order], dt=DT, delays=delays[:, order] + 5.0,
        crossing=0.1,
    )  # fmt: skip
    np.testing.assert_allclose(moved.center, motion.center @ turn.T + [3.0, -1.0, 2.0], atol=1e-9)
    np.testing.assert_allclose(moved.rotation, turn @ motion.rotation @ turn.T, atol=1e-9)
    np.testing.assert_allclose(moved.shift_noise, motion.shift_noise, rtol=1e-6)


def test_time_reversal_gives_the_same_poses():
    """Frames and particles in the opposite order of time have the same poses."""
    rng = np.random.default_rng(3)
    x, delays, _ = recorded(30, rng=rng)
    motion = perrin.track_rotation(x, dt=DT, delays=delays)
    back = perrin.track_rotation(x[::-1], dt=DT, delays=-delays[::-1])
    np.testing.assert_allclose(back.center[::-1], motion.center, atol=1e-8)
    # Body axes are those of the lab at the first pose, here the last.
    relative = np.swapaxes(motion.rotation, 1, 2) @ back.rotation[::-1]
    np.testing.assert_allclose(relative, np.broadcast_to(relative[0], relative.shape), atol=1e-7)


def test_lengths_and_times_may_have_other_units():
    """Micrometres as nanometres and seconds as milliseconds change only the units."""
    rng = np.random.default_rng(4)
    x, delays, _ = recorded(30, rng=rng)
    one = perrin.track_rotation(x, dt=DT, delays=delays, crossing=0.1)
    other = perrin.track_rotation(1e3 * x, dt=1e3 * DT, delays=1e3 * delays, crossing=100.0)
    np.testing.assert_allclose(other.rotation, one.rotation, atol=1e-9)
    np.testing.assert_allclose(other.covariance, one.covariance, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(other.shift_noise, 1e6 * one.shift_noise, rtol=1e-6)


@pytest.mark.parametrize("crossing", [0, 12])
def test_errors_of_poses_are_stated(repeats, crossing):
    """Errors over stated ones are 1 for the instant of each frame; without the times they are not.

    One body of 60 frames determines its D_T to 10 % and the square of its pose errors to 12 %;
    8 bodies are within 6 % (one standard error).
    """
    turns, shifts, without = [], [], []
    for seed in range(repeats(8, 100)):
        x, delays, truth = recorded(60, rng=np.random.default_rng(seed), crossing=crossing)
        motion = perrin.track_rotation(x, dt=DT, delays=delays, crossing=crossing * DT / 73)
        row = np.rint(delays.mean(axis=1) / DT * 73).astype(int) + 73 * np.arange(60)
        for found, squares in ((motion, turns), (perrin.track_rotation(x, dt=DT), without)):
            apart = np.swapaxes(truth.rotation[row], 1, 2) @ found.rotation
            mean = Rotation.from_matrix(apart).mean()
            error = (mean.inv() * Rotation.from_matrix(apart)).as_rotvec()
            inverse = np.linalg.inv(found.covariance)
            squares.append(np.einsum("ta,tab,tb->", error, inverse, error) / (3 * 59))
        error = motion.center - truth.center[row]
        error -= error.mean(axis=0)
        shifts.append(np.sum(error**2) / (3 * 59) / motion.center_variance.mean())
    assert np.mean(turns) == pytest.approx(1, abs=0.15)
    assert np.mean(shifts) == pytest.approx(1, abs=0.15)
    # The residuals see a part of the motion only, so that even there the errors are too small.
    assert np.mean(without) > 1.3


def test_steps_have_the_noise_that_is_stated():
    """The covariance of neighbouring steps is minus the stated noise of their common frame.

    12 bodies of 60 frames: the mean product of neighbouring steps has an error of 3 % of the
    square of a step.
    """
    products, stated, squares = [], [], []
    for seed in range(12):
        x, delays, _ = recorded(60, rng=np.random.default_rng(100 + seed))
        motion = perrin.track_rotation(x, dt=DT, delays=delays)
        steps = np.diff(motion.center, axis=0)
        products.append(np.mean(steps[1:] * steps[:-1]))
        squares.append(np.mean(steps**2))
        stated.append(motion.center_noise)
    error = np.std(products) / np.sqrt(len(products))
    assert np.mean(stated) < 0  # averaging over the scan shortens the steps
    assert -np.mean(products) == pytest.approx(np.mean(stated), abs=3 * error)
    whole = np.mean(squares) - 2 * np.mean(stated)
    assert whole == pytest.approx(2 * D_T * DT, rel=0.1)


def test_missing_particles_have_no_weight():
    """A particle without a position changes nothing, whatever time it has."""
    rng = np.random.default_rng(5)
    x, delays, _ = recorded(30, rng=rng)
    x[4, 1] = x[9, 2] = np.nan
    late = delays.copy()
    late[4, 1], late[9, 2] = np.nan, 1e3
    one = perrin.track_rotation(x, dt=DT, delays=delays)
    other = perrin.track_rotation(x, dt=DT, delays=late)
    np.testing.assert_array_equal(one.rotation, other.rotation)
    assert one.n_present[4] == 3


@pytest.mark.usefixtures("no_tensors")
def test_a_table_with_its_own_times_is_fitted_with_them():
    """The column time of a table, one value a row, is used like `delays`."""
    rng = np.random.default_rng(6)
    x, delays, _ = recorded(20, rng=rng)
    table = perrin.positions_table(x)
    table["time"] = (np.arange(20)[:, None] * DT + delays).ravel()
    report = perrin.analyze(table, dt=DT)
    motion = perrin.track_rotation(x, dt=DT, delays=delays)
    found = report.clusters[0].motion
    np.testing.assert_allclose(found.center, motion.center, atol=1e-9)
    assert found.turn_noise is not None
    assert any("own times" in note for note in report.notes)
    # All particles of a frame at one time: nothing to correct.
    table["time"] = np.repeat(np.arange(20) * DT, 4)
    assert perrin.analyze(table, dt=DT).clusters[0].motion.turn_noise is None
    table.loc[7, "time"] = np.nan
    table.loc[8, "time"] += 0.1
    assert any("has none" in note for note in perrin.analyze(table, dt=DT).notes)


def test_a_scanned_motion_is_written_and_read():
    """Tables and JSON keep the noise of the steps."""
    x, delays, _ = recorded(20, rng=np.random.default_rng(7))
    motion = perrin.track_rotation(x, dt=DT, delays=delays)
    for again in (
        RigidMotion.from_frame(motion.to_frame()),
        RigidMotion.from_dict(motion.to_dict()),
    ):
        np.testing.assert_array_equal(again.turn_noise, motion.turn_noise)
        np.testing.assert_array_equal(again.shift_noise, motion.shift_noise)
    plain = replace(motion, turn_noise=None, shift_noise=None)
    assert RigidMotion.from_frame(plain.to_frame()).turn_noise is None
    assert scan_share(motion) > 0.5 > scan_share(plain) == 0.0


@pytest.mark.parametrize(
    ("delays", "text"),
    [
        (np.zeros((20, 3)), r"delays: expected an array \(20, 4\)"),
        (np.full((20, 4), np.nan), "80 particles have coordinates but no time"),
    ],
)
def test_wrong_delays_are_refused(delays, text):
    """The message states the shape that is needed, or the first particle without a time."""
    x, _, _ = recorded(20, rng=np.random.default_rng(8))
    with pytest.raises(ValueError, match=text):
        perrin.track_rotation(x, dt=DT, delays=delays)
    with pytest.raises(ValueError, match="delays weigh"):
        perrin.track_rotation(x, dt=DT, delays=np.zeros((20, 4)), reference="previous")


def test_planes_may_be_recorded_from_the_last(tmp_path):
    """A negative time from plane to plane is written and read again."""
    pytest.importorskip("tifffile")
    frames = np.random.default_rng(0).integers(0, 200, (3, 4, 8, 8)).astype("uint8")
    stack = perrin.open_stack(frames, voxel=(0.3, 0.2, 0.2), dt=1.0, plane_time=-0.1)
    perrin.write_stack(stack, tmp_path / "down.ome.tif")
    with perrin.open_stack(tmp_path / "down.ome.tif") as again:
        assert again.plane_time == pytest.approx(-0.1)
        np.testing.assert_allclose(again.times, [0, 1, 2], atol=1e-9)
    with pytest.raises(ValueError, match=r"4 planes of 0\.5 s"):
        perrin.open_stack(frames, voxel=(0.3, 0.2, 0.2), dt=1.0, plane_time=-0.5)


def test_a_body_at_rest_without_noise_has_no_errors():
    """Positions that are exact and do not move give the same pose in all frames."""
    x = np.repeat(BODY.positions[None], 20, axis=0)
    delays = np.random.default_rng(1).uniform(0, 0.3, (20, 4))
    motion = perrin.track_rotation(x, dt=DT, delays=delays, crossing=0.1)
    np.testing.assert_allclose(motion.rotation, np.broadcast_to(np.eye(3), (20, 3, 3)), atol=1e-9)
    assert motion.sigma < 1e-8
