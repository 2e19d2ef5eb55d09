"""Fits of spheres and poses to small windows: exact images, dense information, limits by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

import perrin
from perrin.geometry.rotations import exp_map
from perrin.images import CameraNoise
from perrin.images.optics.ball_image import sphere_image
from perrin.images.optics.window_fit import (
    FreeCenters,
    RigidCenters,
    Window,
    box_around,
    cut_window,
    fit_window,
    within,
)
from perrin.images.spheres.poses import Pose, pose_in, start_of, with_poses

VOXEL, PSF = (0.25, 0.2, 0.2), (0.3, 0.15)
IMAGE = sphere_image(diameter=1.0, psf=PSF, voxel=VOXEL)
SPREAD = sphere_image(diameter=1.0, psf=PSF, voxel=VOXEL, spread=0.05)
NOISE = CameraNoise(2.0, 9.0)
SHAPE = (16, 20, 22)
PAIR = np.array([[1.9, 2.0, 1.7], [2.1, 1.8, 2.6]])
AWAY = np.array([[0.1, -0.1, 0.05], [0.0, 0.1, 0.1]])
NONE = np.empty((0, 3))


def drawn(centers, brightness, *, shape=SHAPE, image=IMAGE, sizes=None, background=(20.0, 0, 0, 0)):
    """Return the expected frame of spheres on a background with a slope along z, y and x."""
    frame = np.full(shape, background[0])
    for axis, slope in enumerate(background[1:]):
        line = VOXEL[axis] * (np.arange(shape[axis]) - (shape[axis] - 1) / 2)
        frame += slope * line.reshape([-1 if k == axis else 1 for k in range(3)])
    for k, (center, bright) in enumerate(zip(centers, brightness, strict=True)):
        spot = (image if sizes is None else image.sized(sizes[k])).spot(np.asarray(center), shape)
        frame[spot.box] += bright * spot.value
    return frame


# ---- windows ------------------------------------------------------------------------------------


def test_a_box_reaches_beyond_the_centres_inside_the_frame():
    """Whole voxels outwards, cut at the frame."""
    centers = np.array([[1.0, 2.0, 3.0], [2.0, 1.1, 3.5]])
    box = box_around(centers, np.array([0.4, 0.45, 0.55]), VOXEL, (40, 13, 19))
    # (1 - 0.4)/0.25 = 2.4, (2 + 0.4)/0.25 = 9.6; (1.1 - 0.45)/0.2 = 3.25; (3 - 0.55)/0.2 = 12.25.
    assert [(s.start, s.stop) for s in box] == [(2, 11), (3, 13), (12, 19)]
    assert [s.start for s in box_around(centers, np.full(3, 9.0), VOXEL, (40, 40, 40))] == [0] * 3


def test_voxels_of_a_window_are_in_reach_of_its_spheres_and_of_no_other():
    """Ellipsoids of the extent; voxels of others and without a number are left out."""
    grid = [np.arange(5.0), np.arange(4.0), np.arange(3.0)]
    centers, extent = np.array([[1.0, 1.0, 1.0], [3.0, 2.0, 1.0]]), np.array([1.5, 1.1, 1.0])
    z, y, x = np.meshgrid(*grid, indexing="ij")
    expected = np.zeros((5, 4, 3), dtype=bool)
    for c in centers:
        expected |= ((z - c[0]) / 1.5) ** 2 + ((y - c[1]) / 1.1) ** 2 + (x - c[2]) ** 2 < 1
    np.testing.assert_array_equal(within(grid, centers, extent), expected)
    frame = drawn(PAIR, [50, 60])
    frame[7, 10, 12] = np.nan
    window = cut_window(frame, IMAGE, PAIR[:1], others=PAIR[1:])
    axes = [h * np.arange(s.start, s.stop) for s, h in zip(window.box, VOXEL, strict=True)]
    expected = within(axes, PAIR[:1], IMAGE.extent) & ~within(axes, PAIR[1:], IMAGE.extent)
    expected[tuple(k - s.start for k, s in zip((7, 10, 12), window.box, strict=True))] = False
    np.testing.assert_array_equal(window.mask, expected)
    np.testing.assert_array_equal(window.data, frame[window.box][expected])
    assert window.box == box_around(PAIR[:1], IMAGE.extent, VOXEL, SHAPE)
    assert np.isfinite(window.data).all()
    # The background's slopes are about the middle of the box, um.
    places = np.stack([g[expected] for g in np.meshgrid(*axes, indexing="ij")])
    middle = np.array([a.mean() for a in axes])
    np.testing.assert_allclose(window.background, [np.ones(len(places.T)), *(places.T - middle).T])
    # A sphere outside the box takes the voxels that its image reaches.
    plain = cut_window(drawn(PAIR, [50, 60]), IMAGE, PAIR[:1], others=NONE)
    beside = np.append(PAIR[0, :2], plain.box[2].start * VOXEL[2] - 0.5 * IMAGE.extent[2])
    cut = cut_window(drawn(PAIR, [50, 60]), IMAGE, PAIR[:1], others=beside[None])
    taken = within(axes, beside[None], IMAGE.extent)
    np.testing.assert_array_equal(cut.mask, plain.mask & ~taken)
    assert (plain.mask & taken).any()


def test_a_window_needs_five_voxels_a_parameter():
    """Four for every sphere, and four of the background."""
    for count, voxels in ((1, 40), (3, 80)):
        for more, enough in ((0, True), (-1, False)):
            window = Window((), np.zeros(0, bool), np.zeros(voxels + more), np.zeros(0))
            assert window.has_enough_voxels(count) == enough


# ---- fits ---------------------------------------------------------------------------------------


def test_an_exact_image_gives_back_its_parameters():
    """Positions, brightness and a sloping background, from starts 0.15 um away."""
    background = (20.0, 3.0, -2.0, 1.0)
    frame = drawn(PAIR, [50.0, 80.0], background=background)
    window = cut_window(frame, IMAGE, PAIR, others=NONE)
    fit = fit_window(window, IMAGE, NOISE, FreeCenters(PAIR + AWAY))
    assert fit.converged
    np.testing.assert_allclose(fit.centers, PAIR, atol=1e-5)
    np.testing.assert_allclose(fit.brightness, [50, 80], rtol=1e-4)
    assert fit.chi2 < 1e-6
    np.testing.assert_allclose(fit.expected, window.data, rtol=1e-5)
    np.testing.assert_allclose(fit.weight, 1 / (2 * fit.expected + 9), rtol=1e-9)
    np.testing.assert_allclose(fit.sizes, 0)
    np.testing.assert_array_equal(fit.size_variance, 0)
    np.testing.assert_array_equal(fit.prior, 0)
    for image, center in zip(fit.unit_images, PAIR, strict=True):
        alone = drawn([center], [1.0], background=(0.0, 0, 0, 0))
        np.testing.assert_allclose(image, alone[window.box][window.mask], atol=1e-5)


def numerical_jacobian(window, fit, image, *, sizes=False):
    """Return derivatives of the expected levels by positions, sizes, brightness and background."""
    rows = []
    for sphere in range(len(PAIR)):
        for axis in range(3):
            step = np.zeros_like(PAIR)
            step[sphere, axis] = 1e-4
            ends = [
                drawn(
                    fit.centers + s * step,
                    fit.brightness,
                    image=image,
                    sizes=fit.sizes if sizes else None,
                )
                for s in (1, -1)
            ]
            rows.append((ends[0] - ends[1])[window.box][window.mask] / 2e-4)
    if sizes:
        for sphere in range(len(PAIR)):
            step = 1e-4 * (np.arange(len(PAIR)) == sphere)
            ends = [
                drawn(fit.centers, fit.brightness, image=image, sizes=fit.sizes + s * step)
                for s in (1, -1)
            ]
            rows.append((ends[0] - ends[1])[window.box][window.mask] / 2e-4)
    return np.concatenate([rows, fit.unit_images, window.background])


def test_the_covariance_is_the_inverse_information_times_the_misfit():
    """Chi-squared per degree of freedom above 1 multiplies it; below 1 it stays."""
    truth = drawn(PAIR, [50.0, 80.0])
    rng = np.random.default_rng(3)
    for size, above in ((0.2, False), (3.0, True)):
        noise = size * np.sqrt(2 * truth + 9) * rng.normal(size=SHAPE)
        window = cut_window(truth + noise, IMAGE, PAIR, others=NONE)
        fit = fit_window(window, IMAGE, NOISE, FreeCenters(PAIR))
        jacobian = numerical_jacobian(window, fit, IMAGE)
        np.testing.assert_allclose(fit.jacobian, jacobian, atol=2e-3 * np.abs(jacobian).max())
        chi2 = np.sum(fit.weight * (window.data - fit.expected) ** 2) / (len(window.data) - 12)
        assert fit.chi2 == pytest.approx(chi2, rel=1e-9)
        assert (fit.chi2 > 1) == above
        expected = np.linalg.inv((jacobian * fit.weight) @ jacobian.T)[:6, :6] * max(chi2, 1.0)
        np.testing.assert_allclose(fit.covariance, expected, rtol=0.02, atol=0.01 * expected.max())
        # The score of the likelihood is 0, to the last step.
        score = (fit.jacobian * fit.weight) @ (window.data - fit.expected)
        assert np.abs(score / np.sqrt(np.diag((jacobian * fit.weight) @ jacobian.T))).max() < 0.05


def test_diameters_that_differ_are_fitted_with_their_distribution():
    """Exact sizes come back but for their pull to the mean; their variance is the information's."""
    sizes = np.array([0.04, -0.03])
    frame = drawn(PAIR, [500.0, 800.0], image=SPREAD, sizes=sizes)
    window = cut_window(frame, SPREAD, PAIR, others=NONE)
    fit = fit_window(window, SPREAD, NOISE, FreeCenters(PAIR + 0.05))
    assert fit.converged
    np.testing.assert_allclose(fit.centers, PAIR, atol=2e-3)
    np.testing.assert_allclose(fit.sizes, sizes, atol=4e-3)
    jacobian = numerical_jacobian(window, fit, SPREAD, sizes=True)
    information = (jacobian * fit.weight) @ jacobian.T
    information[[6, 7], [6, 7]] += 0.05**-2
    np.testing.assert_allclose(fit.prior, [0] * 6 + [400] * 2 + [0] * 6)
    variance = np.linalg.inv(information)
    np.testing.assert_allclose(fit.size_variance, np.diag(variance)[6:8], rtol=0.03)
    np.testing.assert_allclose(fit.covariance, variance[:6, :6], rtol=0.05, atol=1e-7)
    # At the maximum the pull of the distribution balances the score of the image.
    score = (fit.jacobian * fit.weight) @ (window.data - fit.expected)
    np.testing.assert_allclose(score[6:8], 400 * fit.sizes, atol=0.02 * 400 * 0.04)
    slopes = window.size_slopes(SPREAD, fit.centers, fit.sizes)
    np.testing.assert_allclose(jacobian[6:8], fit.brightness[:, None] * slopes, atol=2.0)
    # A size beyond its range stays at it.
    far = cut_window(
        drawn(PAIR, [500.0] * 2, image=SPREAD, sizes=[0.5, 0.0]), SPREAD, PAIR, others=NONE
    )
    found = fit_window(far, SPREAD, NOISE, FreeCenters(PAIR))
    assert found.sizes[0] == pytest.approx(SPREAD.size_range)


def test_a_fit_without_a_position_does_not_converge():
    """A sphere beyond the window has no image; far starts take their rounds."""
    frame = drawn(PAIR[:1], [50.0])
    window = cut_window(frame, IMAGE, PAIR[:1], others=NONE)
    lost = np.array([PAIR[0], [1.9, 2.0, 30.0]])
    fit = fit_window(window, IMAGE, NOISE, FreeCenters(lost))
    assert not fit.converged
    np.testing.assert_array_equal(fit.centers, lost)
    assert fit.brightness[1] == pytest.approx(0, abs=1e-9)
    far = fit_window(window, IMAGE, NOISE, FreeCenters(PAIR[:1] - [0.35, 0.3, -0.3]))
    assert far.converged
    np.testing.assert_allclose(far.centers, PAIR[:1], atol=1e-5)


# ---- poses --------------------------------------------------------------------------------------

TEMPLATE = np.array([[0.6, 0.1, -0.2], [-0.5, 0.5, 0.1], [-0.1, -0.6, 0.1]])
CENTER = np.array([2.1, 1.9, 1.9])
TURN = exp_map(np.array([0.3, -0.2, 0.5]))


def body_frame(center=CENTER, template=TEMPLATE):
    return drawn((center + template @ TURN.T)[:, ::-1], [60.0, 70.0, 80.0], shape=SHAPE)


def test_the_pose_of_an_exact_image_comes_back_with_its_covariance():
    """The covariance of six parameters: rotations about the lab's axes, mean variance of shifts."""
    start = RigidCenters(CENTER + 0.05, exp_map(np.array([0.05, 0.05, -0.05])) @ TURN, TEMPLATE)
    found = pose_in(body_frame(), start, IMAGE, NOISE, others=NONE)
    np.testing.assert_allclose(found.center, CENTER, atol=1e-4)
    np.testing.assert_allclose(found.rotation, TURN, atol=2e-4)
    window = cut_window(body_frame(), IMAGE, start.centers, others=NONE)
    fit = fit_window(window, IMAGE, NOISE, RigidCenters(CENTER, TURN, TEMPLATE))
    np.testing.assert_allclose(found.turn_covariance, fit.covariance[3:, 3:], rtol=0.02, atol=1e-7)
    assert found.center_variance == pytest.approx(np.trace(fit.covariance[:3, :3]) / 3, rel=0.01)
    # Voxels of other spheres, given as (x, y, z), are left out; so few are left that none is found.
    away = pose_in(body_frame(), start, IMAGE, NOISE, others=np.array([[4.2, 1.9, 1.9]]))
    np.testing.assert_allclose(away.center, CENTER, atol=1e-3)
    assert pose_in(body_frame(), start, IMAGE, NOISE, others=start.centers[:, ::-1]) is None


@pytest.mark.parametrize("side", ["first", "last"])
def test_spheres_out_of_view_have_no_brightness_and_are_left_out(side):
    """Their centres are beyond the border by 0.95 of the reach of an image or more."""
    inside = np.array([[1.9, 1.9, 1.5], [1.9, 2.9, 1.9], [1.9, 1.2, 2.4]])
    frame = drawn(inside[:, ::-1], [60.0, 70.0, 80.0])
    for share in (0.93, 0.97):
        beyond = share * IMAGE.extent[2]
        x = -beyond if side == "first" else (SHAPE[2] - 1) * VOXEL[2] + beyond
        body = RigidCenters(np.array([1.0, 0, 0]), np.eye(3), np.array([*inside, [x, 1.9, 1.9]]))
        body = replace(body, template=body.template - body.center)
        found = pose_in(frame, body, IMAGE, NOISE, others=NONE)
        three = replace(body, template=body.template[:3])
        alone = pose_in(frame, three, IMAGE, NOISE, others=NONE)
        same = np.array_equal(found.turn_covariance, alone.turn_covariance)
        assert same == (share > 0.95)


def test_poses_are_put_into_a_motion_with_its_first_rotation_the_identity():
    """Body axes are turned with it; covariances are in body axes; lost rows have a reason."""
    rng = np.random.default_rng(1)
    truth = perrin.simulate_motion(
        perrin.Cluster.from_positions(TEMPLATE), D_R=0.05, D_T=0.01, dt=1.0, n_frames=4, rng=1
    )
    motion = perrin.track_rotation(truth.positions() + 0.01 * rng.normal(size=(4, 3, 3)), dt=1.0)
    motion = replace(motion, shift_noise=np.ones(4), turn_noise=motion.covariance)
    root = rng.normal(size=(3, 3))
    poses = {
        0: Pose(np.array([1.0, 2.0, 3.0]), TURN, root @ root.T, 0.25),
        2: Pose(np.array([4.0, 5.0, 6.0]), TURN @ TURN, np.diag([1.0, 2.0, 3.0]), 0.5),
    }
    found = with_poses(motion, poses, lost={3: "dark"})
    np.testing.assert_allclose(found.rotation[0], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(found.rotation[2], TURN @ TURN @ TURN.T, atol=1e-12)
    np.testing.assert_allclose(found.rotation[1], motion.rotation[1] @ TURN.T, atol=1e-12)
    np.testing.assert_allclose(found.template, motion.template @ TURN.T)
    np.testing.assert_allclose(found.center[[0, 2]], [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_allclose(found.center[1], motion.center[1])
    assert found.center_variance[[0, 2]].tolist() == [0.25, 0.5]
    # About the body's axes at the first frame, which are those of the laboratory.
    np.testing.assert_allclose(found.covariance[0], root @ root.T, atol=1e-12)
    back = TURN.T @ TURN.T @ np.diag([1.0, 2.0, 3.0]) @ TURN @ TURN
    np.testing.assert_allclose(found.covariance[2], TURN @ back @ TURN.T, atol=1e-12)
    np.testing.assert_allclose(
        found.covariance[1], TURN @ motion.covariance[1] @ TURN.T, atol=1e-12
    )
    for part in (found.rotation[3], found.center[3], found.covariance[3], found.center_variance[3]):
        assert np.isnan(part).all()
    assert found.reason == ("", "", "", "dark")
    assert found.turn_noise is None
    assert found.shift_noise is None
    assert with_poses(motion, {}, lost=dict.fromkeys(range(4), "x")).fitted.size == 0
    start = start_of(motion, 2)
    np.testing.assert_array_equal(start.center, motion.center[2])
    np.testing.assert_array_equal(start.rotation, motion.rotation[2])


def test_poses_of_a_movie_are_fitted_in_the_frames_that_are_stated():
    """Frames 1 and 3 of the stack; spheres of others only in their own frame."""
    frames = [np.zeros(SHAPE), body_frame(), np.zeros(SHAPE), body_frame(CENTER + 0.1)]

    class Movie:
        shape, voxel = (4, *SHAPE), VOXEL

        def frame(self, i):
            return frames[i]

    places = np.stack([c + TEMPLATE @ TURN.T for c in (CENTER, CENTER + 0.1)])
    noisy = places + 0.02 * np.random.default_rng(2).normal(size=places.shape)
    motion = perrin.track_rotation(noisy, dt=1.0)
    shape = TEMPLATE @ perrin.kabsch(motion.template, TEMPLATE).T
    motion = replace(motion, template=shape - shape.mean(axis=0))
    optics = perrin.Optics(1.0, PSF, NOISE)
    posed = perrin.fit_pose(Movie(), motion, optics=optics, frames=np.array([1, 3]))
    middle = places.mean(axis=1)
    np.testing.assert_allclose(posed.center, middle, atol=2e-3)
    assert posed.reason == ("", "")
    cover = pd.DataFrame(
        {"frame": 3, "x": places[1, :, 0], "y": places[1, :, 1], "z": places[1, :, 2]}
    )
    hidden = perrin.fit_pose(Movie(), motion, optics=optics, frames=[1, 3], others=cover)
    assert hidden.reason == ("", "the pose fit to the image did not settle")
    np.testing.assert_allclose(hidden.center[0], middle[0], atol=2e-3)
    default = perrin.fit_pose(Movie(), motion, optics=optics)
    assert default.reason[0] == "the pose fit to the image did not settle"
    np.testing.assert_allclose(default.center[1], middle[0], atol=0.03)
