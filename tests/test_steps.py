"""Steps of a motion: vectors, durations, noise and steady motion are those that were planted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from perrin import Noise, RigidMotion, TooFewFramesError
from perrin._arrays import distinct, expanded, stored_once
from perrin.diffusion.steps import (
    NoisySteps,
    Steps,
    body_steps,
    center_steps,
    direction_steps,
    groups_alike,
    orientation_about_mean,
    pooled_steps,
    principal_steps,
    residual_freedom,
    steps_of,
)
from perrin.geometry.rotations import exp_map
from perrin.motion.rods import RodMotion

DT = 0.5
# Frames of two pieces: frame 3 has no pose, and times 6 and 7 are missing in the second piece.
TIME = DT * np.array([0, 1, 2, 3, 4, 5, 8, 9, 10, 11])
PIECE = np.array([0, 0, 0, 0, 0, 1, 1, 1, 1, 1])
N_PRESENT = np.array([5, 4, 5, 0, 4, 5, 5, 3, 5, 4])
START, STOP = np.array([0, 1, 2, 5, 6, 7, 8]), np.array([1, 2, 4, 6, 7, 8, 9])
DURATION = DT * np.array([1, 1, 2, 3, 1, 1, 1])
AXES = Rotation.from_rotvec([0.3, -0.5, 0.2]).as_matrix()  # of the noise, in its columns
COMPLETE = N_PRESENT == 5


def motion_with(rotation, *, covariance, center=None, seed=0, sigma=0.25, **others):
    """Return a motion of five particles with these orientations, noise and centres."""
    rng = np.random.default_rng(seed)
    d = rotation.shape[-1]
    center = rng.normal(size=(10, d)) if center is None else center.copy()
    rotation, covariance = rotation.copy(), covariance.copy()
    for x in (rotation, covariance, center):
        x[3] = np.nan
    template = rng.normal(size=(5, d))
    own = {
        "time": TIME, "center": center, "rotation": rotation, "residual": np.zeros(10),
        "n_present": N_PRESENT, "covariance": covariance * sigma**2,
        "center_variance": sigma**2 * np.where(COMPLETE, 0.2, 0.3), "piece": PIECE,
        "reason": tuple("" for _ in TIME), "template": template - template.mean(axis=0),
        "sigma": sigma, "noise": np.full(d, sigma), "dt": DT,
    }  # fmt: skip
    return RigidMotion(**(own | others))


def turning(vectors, *, between=((5, (0.4, 0.2, -0.1)),)):
    """Return orientations (10, 3, 3) whose body-frame steps are these rotation vectors (7, 3)."""
    rotation = np.tile(np.eye(3), (10, 1, 1))
    for frame, vector in between:  # the turn from one piece to the next is no step
        rotation[frame] = exp_map(np.array(vector))
    for w, start, stop in zip(vectors, START, STOP, strict=True):
        rotation[stop] = rotation[start] @ exp_map(w)
    return rotation


def covariances(values, *, seed=1):
    """Return covariances (10, 3, 3): diagonal in AXES in complete frames, in others along none."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(10, 3, 3))
    covariance = root @ np.swapaxes(root, 1, 2)
    covariance[COMPLETE] = AXES @ np.diag(values) @ AXES.T
    return covariance


def same_up_to_signs(found, expected):
    """Compare the columns of two tables; each may have the opposite sign."""
    signs = np.sign(np.sum(found * expected, axis=0))
    np.testing.assert_allclose(found * signs, expected, rtol=1e-9, atol=1e-12)


PLANTED = 0.3 * np.random.default_rng(5).normal(size=(7, 3))


@pytest.mark.parametrize("third", [1.529, 1.532], ids=["alike", "apart"])
def test_steps_of_a_rotation_lie_along_the_axes_of_the_noise(third):
    """Axes whose noise differs by under 2 % share it in complete frames; others keep their own."""
    covariance = covariances([1.0, 1.5, third])
    motion = motion_with(turning(PLANTED), covariance=covariance)
    steps = steps_of(motion, "rotation")
    same_up_to_signs(steps.vectors, PLANTED @ AXES)
    np.testing.assert_allclose(steps.duration, DURATION)
    np.testing.assert_array_equal(steps.start, START)
    np.testing.assert_array_equal(steps.stop, STOP)
    np.testing.assert_array_equal(steps.linked, [True, True, False, True, True, True, False])
    along = np.einsum("ia,tij,ja->ta", AXES, covariance, AXES)
    shared = (1.5 + third) / 2
    along[COMPLETE] = [1.0, shared, shared] if third < 1.53 else [1.0, 1.5, third]
    expected = along[:, :, None] * np.eye(3)
    seen = np.arange(10) != 3
    np.testing.assert_allclose(steps.noise[0, seen], expected[seen], rtol=1e-9, atol=1e-12)
    assert steps.complete == pytest.approx(expected[0].trace() / 3)
    assert (steps.dt, steps.sigma) == (DT, motion.sigma)
    # 3 n - 6 of every frame, less those of the template.
    assert steps.freedom == residual_freedom(motion) == 5 * 9 + 3 * 6 + 3 - 9
    for variance, frames in zip(steps.variances, (START, STOP), strict=True):
        np.testing.assert_allclose(variance, along[frames], rtol=1e-9)


@pytest.mark.parametrize("frame", ["body", "lab", "mean"])
def test_a_steady_spin_of_the_laboratory_is_the_product_of_the_steady_motion(frame):
    """The steps are `steady` times the spin, over gaps and in two pieces."""
    spin = np.array([0.02, -0.03, 0.05]) * (1 if frame != "mean" else 1e-3)
    rotation = exp_map(spin * TIME[:, None]) @ turning(np.zeros((7, 3)))
    motion = motion_with(rotation, covariance=covariances([1.0, 1.5, 2.5]))
    steps = principal_steps(motion, "rotation", frame=frame)
    # Differences of rotation vectors are the turns to first order in the angle.
    rel = 1e-9 if frame != "mean" else 1e-3
    np.testing.assert_allclose(steps.steady @ spin, steps.vectors, atol=rel * np.abs(spin).max())
    rest, found = steps.without_steady_motion()
    np.testing.assert_allclose(found, spin, rtol=10 * rel)
    np.testing.assert_allclose(rest.vectors, 0, atol=rel * np.abs(spin).max())
    if frame == "body":
        steps = steps_of(motion, "rotation")
        np.testing.assert_allclose(steps.steady @ spin, steps.vectors, atol=1e-12)


def test_the_steady_motion_is_fitted_to_the_steps_that_are_kept():
    """A step that is left out changes nothing, and has the same velocity subtracted."""
    center = np.array([1.0, -2.0, 0.5]) * TIME[:, None]
    center[6:] += 7.0
    motion = motion_with(turning(PLANTED), covariance=covariances([1, 2, 3]), center=center)
    steps = steps_of(motion, "translation")
    rest, velocity = steps.without_steady_motion(kept=np.arange(7) != 3)
    np.testing.assert_allclose(velocity, [1.0, -2.0, 0.5], rtol=1e-12)
    jump = 7.0 * (np.arange(7) == 3)[:, None] * np.ones(3)
    np.testing.assert_allclose(rest.vectors, jump, atol=1e-12)
    assert steps.without_steady_motion()[1][0] > 1.5


@pytest.mark.parametrize("d", [2, 3])
def test_steps_of_a_translation_are_displacements_with_the_noise_of_their_frames(d):
    """Displacements between neighbouring poses of one piece; steady motion takes their time."""
    rotation = np.tile(np.eye(d), (10, 1, 1))
    a = 3 if d == 3 else 1
    motion = motion_with(rotation, covariance=np.tile(np.eye(a), (10, 1, 1)))
    steps = steps_of(motion, "translation")
    np.testing.assert_allclose(steps.vectors, motion.center[STOP] - motion.center[START])
    np.testing.assert_allclose(steps.steady, DURATION[:, None, None] * np.eye(d))
    noise = np.where(COMPLETE, 0.2, 0.3)
    np.testing.assert_allclose(steps.noise, (noise[:, None, None] * np.eye(d))[None])
    assert steps.complete == pytest.approx(0.2)
    assert principal_steps(motion, "translation") is steps


def test_steps_in_the_plane_have_one_angle():
    """A spin is one number there, and no axes are chosen."""
    angle = np.cumsum(np.arange(10.0)) / 20
    c, s = np.cos(angle), np.sin(angle)
    rotation = np.moveaxis(np.array([[c, -s], [s, c]]), -1, 0)
    variance = np.where(COMPLETE, 0.5, 0.8)
    motion = motion_with(rotation, covariance=variance[:, None, None])
    steps = principal_steps(motion, "rotation")
    np.testing.assert_allclose(steps.vectors[:, 0], angle[STOP] - angle[START])
    np.testing.assert_allclose(steps.steady, DURATION[:, None, None])
    np.testing.assert_allclose(np.delete(steps.noise[0, :, 0, 0], 3), np.delete(variance, 3))
    assert steps.freedom == 5 * 7 + 3 * 5 + 3 - 7


def test_principal_steps_have_a_diagonal_tensor_in_ascending_order():
    """<w w^T>/2 + sym <w_j w_{j+1}^T> of linked steps; the noise in its axes has the same trace."""
    covariance = covariances([1.0, 1.5, 2.5])
    motion = motion_with(turning(PLANTED), covariance=covariance)
    steps = principal_steps(motion, "rotation")
    own = np.linalg.norm(steps.vectors, axis=1)
    np.testing.assert_allclose(own, np.linalg.norm(PLANTED, axis=1))
    next_one = steps.vectors[1:] * steps.linked[:-1, None]
    tensor = steps.vectors.T @ steps.vectors / 2 + steps.vectors[:-1].T @ next_one
    tensor = (tensor + tensor.T) / 2
    np.testing.assert_allclose(tensor, np.diag(tensor.diagonal()), atol=1e-12)
    assert (np.diff(tensor.diagonal()) > 0).all()
    trace = np.trace(covariance, axis1=1, axis2=2)
    found = np.trace(steps.noise[0], axis1=1, axis2=2)
    np.testing.assert_allclose(np.delete(found, 3), np.delete(trace, 3))
    axes = np.linalg.lstsq(PLANTED, steps.vectors, rcond=None)[0]
    np.testing.assert_allclose(
        np.delete(steps.noise[0], 3, axis=0),
        [np.diag(np.diag(axes.T @ c @ axes)) for c in np.delete(covariance, 3, axis=0)],
        atol=1e-9,
    )


@pytest.mark.parametrize("frame", ["lab", "mean"])
def test_noise_that_does_not_turn_with_the_body_is_the_same_in_all_frames(frame):
    """In lab axes N is R C R^T with C in body axes; about the mean M of a piece, M^T N M."""
    rotation = turning(PLANTED, between=())
    noise = AXES @ np.diag([1.0, 2.0, 5.0]) @ AXES.T
    covariance = np.swapaxes(rotation, 1, 2) @ noise @ rotation
    motion = motion_with(rotation, covariance=covariance)
    steps = principal_steps(motion, "rotation", frame=frame)
    for piece in (0, 1):
        rows = [k for k in motion.fitted if PIECE[k] == piece]
        mean = Rotation.from_matrix(rotation[rows]).mean().as_matrix()
        turn = np.eye(3) if frame == "lab" else mean
        w = np.einsum("sij,sj->si", rotation[START], PLANTED)
        if frame == "mean":
            about = Rotation.from_matrix(mean.T @ rotation).as_rotvec()
            np.testing.assert_allclose(orientation_about_mean(motion)[rows], about[rows], atol=1e-9)
            w = about[STOP] - about[START]
        own = PIECE[START] == piece
        # The axes follow from all steps, those of both pieces.
        axes = np.linalg.lstsq(w[own], steps.vectors[own], rcond=None)[0]
        np.testing.assert_allclose(w[own] @ axes, steps.vectors[own], atol=1e-9)
        expected = np.diag(np.diag(axes.T @ turn.T @ noise @ turn @ axes))
        np.testing.assert_allclose(steps.noise[0, rows], [expected] * len(rows), rtol=1e-7)
    assert np.isnan(orientation_about_mean(motion)[3]).all()


def test_two_steps_are_enough_and_one_is_not():
    """The error states the frames, and which of several motions has too few."""
    motion = motion_with(turning(PLANTED), covariance=covariances([1, 2, 3]))
    two = replace(motion, piece=np.array([0, 0, 0, 1, 1, 2, 3, 4, 5, 6]))
    assert len(steps_of(two, "translation").start) == 2
    one = replace(motion, piece=np.array([0, 0, 1, 1, 2, 3, 4, 5, 6, 7]))
    with pytest.raises(
        TooFewFramesError, match=r"^9 frames with a pose in too few steps"
    ) as caught:
        pooled_steps([one], "translation")
    assert caught.value.n_frames == 9
    with pytest.raises(TooFewFramesError, match=r"^motion 1: 9 frames") as caught:
        pooled_steps([two, one], "rotation")
    assert caught.value.n_frames == 9


def test_the_logarithm_of_a_pose_gives_the_pose_back():
    """A step (u, w) moves the pose by the exponential of a 4x4 matrix, at small angles too."""
    rng = np.random.default_rng(2)
    size = np.array([1.0, 2.0, 0.3, 1e-2, 2.1e-3, 1e-3, 1e-7])[:, None]
    twist = np.concatenate([rng.normal(size=(7, 3)), rng.normal(size=(7, 3)) * size / 2], axis=1)
    pose = np.tile(np.eye(4), (10, 1, 1))
    for v, start, stop in zip(twist, START, STOP, strict=True):
        matrix = np.zeros((4, 4))
        x, y, z = v[3:]
        matrix[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
        matrix[:3, 3] = v[:3]
        pose[stop] = pose[start] @ expm(matrix)
    covariance = covariances([1, 2, 3])
    motion = motion_with(pose[:, :3, :3], covariance=covariance, center=pose[:, :3, 3])
    steps = body_steps(motion, "both", np.eye(3))
    np.testing.assert_allclose(steps.vectors, twist, rtol=1e-9, atol=1e-9)
    noise = np.zeros((2, 10, 6, 6))
    noise[0, :, :3, :3] = np.where(COMPLETE, 0.2, 0.3)[:, None, None] * np.eye(3)
    noise[1, :, 3:, 3:] = covariance
    noise[1, 3, 3:, 3:] = np.nan
    np.testing.assert_allclose(steps.noise, noise)
    # The variances of a single D are those of the first source.
    for variance, frames in zip(steps.variances, (START, STOP), strict=True):
        np.testing.assert_allclose(variance, np.diagonal(noise[0, frames], axis1=1, axis2=2))
    # Displacements are in the axes of the middle of the step, and both in other axes on demand.
    middle = motion.rotation[START] @ exp_map(twist[:, 3:] / 2)
    moved = motion.center[STOP] - motion.center[START]
    half = np.stack([m.T @ x for m, x in zip(middle, moved, strict=True)])
    along = body_steps(motion, "translation", AXES.T)
    np.testing.assert_allclose(along.vectors, half @ AXES, rtol=1e-9)
    np.testing.assert_allclose(along.noise[0], noise[0, :, :3, :3])
    turned = body_steps(motion, "rotation", AXES.T)
    np.testing.assert_allclose(turned.vectors, twist[:, 3:] @ AXES, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(turned.noise[0], AXES.T @ noise[1, :, 3:, 3:] @ AXES)
    for found in (steps, along, turned):
        np.testing.assert_allclose(found.duration, DURATION)
        np.testing.assert_array_equal(found.start, START)
        np.testing.assert_array_equal(found.stop, STOP)
        assert (found.dt, found.sigma, found.freedom) == (DT, 0.25, 57)


def rod_with(direction, *, piece):
    """Return a rod with these directions; its frame 2 has none where they are NaN."""
    count = len(direction)
    variance = 0.1 + 0.01 * np.arange(count)
    center = np.arange(3.0 * count).reshape(-1, 3) ** 2
    lost = np.isnan(direction[:, 0])
    center[lost] = variance[lost] = np.nan
    return RodMotion(
        time=DT * np.arange(count) ** 2, center=center, direction=direction,
        residual=np.zeros(count), n_present=np.full(count, 2), variance=variance,
        center_variance=2 * variance, piece=np.array(piece), swaps=np.zeros(0, int),
        reason=("",) * count, places=np.array([-1.0, 1.0]), sigma=0.1, dt=DT,
    )  # fmt: skip


def test_steps_of_a_direction_are_carried_along_without_turning():
    """Around an octant of the sphere, x, y, z, x: every step is 90 degrees to the left of the last.

    Two more steps along one great circle are parallel, of the angles that they have.
    """
    c, s = np.cos(0.3), np.sin(0.3)
    x, y, z = np.eye(3)
    lost = np.full(3, np.nan)
    rod = rod_with(np.array([x, y, lost, z, x, x, [c, s, 0], -y]), piece=[0] * 4 + [1] * 4)
    steps = direction_steps(rod)
    # From frame 3 to 4 there is no step, but the axes are carried on.
    np.testing.assert_array_equal(steps.start, [0, 1, 4, 5, 6])
    np.testing.assert_array_equal(steps.stop, [1, 3, 5, 6, 7])
    v = steps.vectors
    quarter = np.pi / 2
    np.testing.assert_allclose(np.linalg.norm(v, axis=1), [quarter, quarter, 0, 0.3, quarter + 0.3])
    angle = np.unwrap(np.arctan2(v[:, 1], v[:, 0])) - np.arctan2(v[0, 1], v[0, 0])
    handed = np.sign(angle[1])
    np.testing.assert_allclose(handed * angle[1], quarter)
    # The octant's area is 90 degrees: carried around it, the axes are back after a quarter turn,
    # and x to y is the direction of the first step turned back by it.
    np.testing.assert_allclose(np.cos(angle[3:] - angle[3]), [1, -1], atol=1e-12)
    np.testing.assert_allclose(np.sin(handed * angle[3]), -1, atol=1e-12)
    np.testing.assert_allclose(steps.noise[0], rod.variance[:, None, None] * np.eye(2))
    assert steps.complete == pytest.approx(np.nanmean(rod.variance))
    assert (steps.sigma, steps.freedom, steps.dt) == (1.0, 0, DT)
    assert steps.steady.shape == (5, 2, 0)
    assert NoisySteps.of(steps, Noise()).steady.size == 0
    center = center_steps(rod)
    np.testing.assert_allclose(center.vectors, rod.center[steps.stop] - rod.center[steps.start])
    np.testing.assert_allclose(center.duration, rod.time[steps.stop] - rod.time[steps.start])
    np.testing.assert_allclose(center.noise[0], 2 * rod.variance[:, None, None] * np.eye(3))


BARE = ("vectors", "duration", "start", "stop", "noise", "dt", "sigma", "freedom")


def plain_steps(noise, *, duration=(1.0, 1.0, 1.0), start=(0, 1, 2), stop=(1, 2, 3)):
    """Return three steps of two components with the noise (T, 2) of the frames."""
    noise = np.array(noise, dtype=float)
    return Steps(
        vectors=np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 7.0]]), duration=np.array(duration),
        start=np.array(start), stop=np.array(stop), noise=(noise[..., None] * np.eye(2))[None],
        dt=2.0, sigma=0.4, freedom=30, complete=0.5,
        steady=np.ones((3, 1, 1)) * np.eye(2),
    )  # fmt: skip


def test_steps_are_even_where_times_and_noise_agree_to_a_billionth():
    """Frames between the steps do not count; steps that share no frame are not even."""
    same = np.full((4, 2), 0.4)
    assert plain_steps(same).even
    assert plain_steps(0 * same).even
    for size, even in ((4e-10, True), (4e-9, False)):
        assert plain_steps(same * (1 + size * np.arange(4)[:, None] / 3)).even == even
        assert plain_steps(same, duration=(1.0, 1.0, 1.0 + size)).even == even
        assert plain_steps(2 * same, duration=(5.0, 5.0, 5.0 + 5 * size)).even == even
    between = np.insert(same, 1, 9.0, axis=0)
    assert plain_steps(between, start=(0, 2, 3), stop=(2, 3, 4)).even
    assert not plain_steps(np.full((5, 2), 0.4), start=(0, 1, 3), stop=(1, 2, 4)).even
    last = plain_steps(same * [[1], [1], [1], [2]])
    assert not last.even
    first = plain_steps(same * [[2], [1], [1], [1]])
    assert not first.even
    np.testing.assert_array_equal(last.after[0, :, 0, 0], [0.4, 0.4, 0.8])
    np.testing.assert_array_equal(first.before[0, :, 0, 0], [0.8, 0.4, 0.4])


def test_the_noise_of_every_option_is_its_arithmetic():
    """Known, free and estimated parts of the noise variance of a frame, and the blur, by hand."""
    steps = plain_steps([[0.4, 0.2], [0.4, 0.6], [0.8, 0.4], [0.4, 0.4]], duration=(2.0, 1.0, 3.0))
    before = np.array([[0.4, 0.2], [0.4, 0.6], [0.8, 0.4]])
    after = np.array([[0.4, 0.6], [0.8, 0.4], [0.4, 0.4]])
    free = NoisySteps.of(steps, Noise(exposure=0.6))
    np.testing.assert_allclose(free.known[0], 0.16 * (before - 0.2))
    np.testing.assert_allclose(free.known[1], 0.16 * (after - 0.2))
    np.testing.assert_array_equal(free.weight, np.ones((2, 3, 2)))
    assert free.level == pytest.approx(0.16 * 0.3)
    assert (free.blur, free.theta, free.freedom) == (pytest.approx(0.4), 0.0, 0.0)
    assert free.theta_at(2.0, 0.5) == pytest.approx(0.5 - 0.048 + 0.4 * 2.0)
    assert free.theta_at(0.0, -0.5) == 0
    np.testing.assert_array_equal(free.steady, [0, 0])
    assert not free.drift
    # By default no mean noise is known, and no steady motion can be removed.
    bare = Steps(*(getattr(steps, name) for name in BARE))
    assert np.isnan(bare.complete)
    assert bare.steady.shape == (0, 0, 0)
    # An unknown exposure, and noise that averaging over a scan makes negative: half a step.
    assert NoisySteps.of(steps, Noise()).blur == pytest.approx(0.5)
    negative = plain_steps([[-0.1, 0.2], [0.4, 0.6], [0.8, 0.4], [0.4, 0.4]])
    assert NoisySteps.of(negative, Noise(exposure=0.6)).blur == pytest.approx(0.5)
    none = plain_steps([[0.0, 0.2], [0.4, 0.6], [0.8, 0.4], [0.4, 0.4]])
    assert NoisySteps.of(none, Noise(exposure=0.6)).blur == pytest.approx(0.4)
    residual = NoisySteps.of(steps, Noise("residual", exposure=0.6))
    np.testing.assert_allclose(residual.weight, [before / 0.5, after / 0.5])
    np.testing.assert_array_equal(residual.known, np.zeros((2, 3, 2)))
    assert (residual.theta, residual.blur) == (pytest.approx(0.08), pytest.approx(0.4))
    assert (residual.freedom, residual.level) == (30.0, 0.0)
    assert NoisySteps.of(steps, Noise("residual")).blur == 0
    known = NoisySteps.of(steps, Noise(2.0, exposure=0.6, drift=True))
    np.testing.assert_allclose(known.known, [4 * before, 4 * after])
    np.testing.assert_array_equal(known.weight, np.zeros((2, 3, 2)))
    assert (known.blur, known.level) == (pytest.approx(0.4), pytest.approx(2.0))
    assert (known.theta, known.freedom, known.theta_at(1.0, 5.0)) == (0.0, np.inf, 0.0)
    # Drift: the mean of the three steps is subtracted.
    assert known.drift
    np.testing.assert_allclose(known.steady, [3.0, 13 / 3])
    np.testing.assert_allclose(known.steps.vectors, steps.vectors - [3.0, 13 / 3], atol=1e-12)
    for options in (Noise(drift=True), Noise("residual", drift=True)):
        np.testing.assert_allclose(NoisySteps.of(steps, options).steady, [3.0, 13 / 3])
    exact = NoisySteps.of(replace(steps, sigma=0.0), Noise("residual"))
    assert (exact.theta, exact.freedom) == (0.0, np.inf)
    np.testing.assert_array_equal(exact.known, np.zeros((2, 3, 2)))


def test_equal_rows_are_stored_once_and_equal_keys_grouped():
    """One row that differs, or a single one, stays as it is; a group is at most that large."""
    rows = np.ones((3, 2))
    rows[2, 1] = 2
    assert stored_once(rows) is rows
    assert stored_once(rows[:1]).strides == rows[:1].strides
    assert stored_once(rows[:2]).strides[0] == 0
    np.testing.assert_array_equal(stored_once(rows[:2]), rows[:2])
    np.testing.assert_array_equal(expanded(distinct(stored_once(rows[:2])), 2), rows[:2])
    keys = ["a"] * 5 + ["b"] * 2 + ["c"] * 2
    sizes = [3] * 5 + [8] * 2 + [0] * 2
    assert groups_alike(keys, sizes, most=7) == [[0, 1], [2, 3], [4], [5], [6], [7, 8]]
