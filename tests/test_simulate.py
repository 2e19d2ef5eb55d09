"""Simulated motions have the coefficients and laws that they were simulated with."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from perrin import Cluster, add_noise, apparent_translation, cluster_mobility, simulate_motion
from perrin.geometry.rotations import log_map

BODY = Cluster.tetrahedron(1.5)
PLANE = Cluster.from_positions([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
TENSOR = np.array([[3.0, 0.5, 0.2], [0.5, 2.0, -0.3], [0.2, -0.3, 1.0]]) * 1e-3


def simulate(cluster=BODY, **options):
    """Return a motion with defaults that may be overridden."""
    options = {"D_R": 1e-2, "dt": 1.0, "n_frames": 10, "rng": 1} | options
    return simulate_motion(cluster, **options)


def steps(motion):
    """Return the body-frame rotation of every step, R_k^T R_{k+1}."""
    return np.swapaxes(motion.rotation[:-1], -1, -2) @ motion.rotation[1:]


def mean_and_error(sample):
    """Return the mean over the first axis and its standard error."""
    return sample.mean(0), sample.std(0) / np.sqrt(len(sample))


# ---- the law of the steps -----------------------------------------------------------------------


@pytest.mark.parametrize("scale", [1e-6, 1e-4, 1e-2, 0.1, 0.5, 0.99, 1.01, 2.0, 20.0])
def test_the_step_law_at_any_step(scale, repeats):
    """<cos> = (3 exp(-2 D dt) - 1)/2 and degree 2 decays by exp(-6 D dt), within 4 errors."""
    motion = simulate(D_R=scale / 0.7, dt=0.7, n_frames=repeats(20_001, 100_001), rng=31)
    angle = np.linalg.norm(log_map(steps(motion)), axis=1)
    # 1 - <cos> by the half angle, so that nothing cancels at D dt = 1e-6.
    loss, error = mean_and_error(2 * np.sin(angle / 2) ** 2)
    assert abs(loss + 1.5 * np.expm1(-2 * scale)) < 4 * error
    cos = np.cos(angle)
    character = 4 * cos**2 + 2 * cos - 1  # 1 + 2 cos a + 2 cos 2a
    mean, error = mean_and_error(character)
    assert abs(mean - 5 * np.exp(-6 * scale)) < 4 * error + 1e-12


@pytest.mark.parametrize("scale", [1e-6, 0.3, 1.5])
def test_the_axes_of_the_steps_are_uniform(scale, repeats):
    """Isotropic steps have no preferred axis: <u> = 0, <u u^T> = 1/3, within 4.5 errors."""
    v = log_map(steps(simulate(D_R=scale, n_frames=repeats(20_001, 50_001), rng=32)))
    u = v / np.linalg.norm(v, axis=1, keepdims=True)
    mean, error = mean_and_error(u)
    assert np.all(np.abs(mean) < 4.5 * error)
    mean, error = mean_and_error(u[:, :, None] * u[:, None])
    assert np.all(np.abs(mean - np.eye(3) / 3) < 4.5 * error)


@pytest.mark.parametrize("tensor", [TENSOR, np.diag(TENSOR), 1e-3, [1e-3, 0.0, 0.0]])
def test_the_planted_tensor_is_in_the_steps(tensor, repeats):
    """<theta theta^T> = 2 D dt in body axes, within 4.5 errors and the second order in D dt."""
    dt = 0.5
    planted = np.asarray(tensor)
    if planted.ndim < 2:
        planted = np.diag(np.broadcast_to(planted, 3))
    v = log_map(steps(simulate(D_R=tensor, dt=dt, n_frames=repeats(20_001, 40_001), rng=33)))
    mean, error = mean_and_error(v[:, :, None] * v[:, None])
    assert np.all(
        np.abs(mean - 2 * planted * dt) <= 4.5 * error + 4 * (np.trace(planted) * dt) ** 2
    )


def test_a_large_anisotropic_step_decays_by_its_tensor(repeats):
    """E[R] = exp(-(tr D - D) dt) for any tensor, also when 2 D dt is of order one (4.5 errors)."""
    dt = 200.0
    r = steps(simulate(D_R=TENSOR, dt=dt, n_frames=repeats(1501, 20_001), rng=34))
    values, axes = np.linalg.eigh(np.trace(TENSOR) * np.eye(3) - TENSOR)
    expected = axes @ np.diag(np.exp(-values * dt)) @ axes.T
    mean, error = mean_and_error(r)
    assert np.all(np.abs(mean - expected) < 4.5 * error)
    assert expected.max() < 0.6


def test_tensors_are_in_body_axes():
    """The tensor is fixed in the body: lab-frame steps of a body that turned are isotropic."""
    motion = simulate(D_R=[0.0, 0.0, 0.01], n_frames=1000, rng=35)
    z = motion.rotation[:, :, 2]
    np.testing.assert_allclose(z, np.broadcast_to([0.0, 0.0, 1.0], z.shape), atol=1e-12)
    mixed = simulate(D_R=[0.02, 0.02, 0.0], n_frames=5000, rng=36)
    body = log_map(steps(mixed))
    lab = np.einsum("tij,tj->ti", mixed.rotation[:-1], body)
    assert np.var(body[:, 2]) < 0.01 * np.var(body[:, 0])
    assert np.var(lab[:, 2]) > 0.5 * np.var(lab[:, 0])


def test_a_tensor_of_equal_values_is_the_number():
    """One D_R, three equal values and a multiple of the unit matrix give the same bits."""
    one = simulate(D_R=2e-3, n_frames=50)
    for same in ([2e-3] * 3, 2e-3 * np.eye(3)):
        np.testing.assert_array_equal(simulate(D_R=same, n_frames=50).rotation, one.rotation)
    turn = Rotation.random(random_state=2).as_matrix()
    rounded = simulate(D_R=turn @ (2e-3 * np.eye(3)) @ turn.T, n_frames=50)
    np.testing.assert_allclose(rounded.rotation, one.rotation, atol=1e-12)


def test_steps_compose(repeats):
    """Two steps of dt have the law of one step of 2 dt: E over pairs = exp(-4 D dt), 4 errors."""
    r = simulate(D_R=0.1, n_frames=repeats(40_001, 100_001), rng=37).rotation
    two = np.einsum("tii->t", np.swapaxes(r[:-2:2], 1, 2) @ r[2::2]) / 3
    mean, error = mean_and_error(two)
    assert abs(mean - np.exp(-0.4)) < 4 * error


# ---- the paper's scheme -------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [1e-3, 0.05, 0.25])
def test_eulers_scheme_has_the_right_mean(scale, repeats):
    """Eq. 16: E[R] = exp(-2 D dt) 1 exactly, within 4.5 errors."""
    r = simulate(D_R=scale, n_frames=repeats(20_001, 50_001), scheme="euler", rng=38).rotation
    # The paper multiplies in the lab, so its steps are R_{k+1} R_k^T.
    left = r[1:] @ np.swapaxes(r[:-1], -1, -2)
    mean, error = mean_and_error(left)
    assert np.all(np.abs(mean - np.exp(-2 * scale) * np.eye(3)) < 4.5 * error)


def test_finite_steps_of_both_schemes(repeats):
    """At D dt = 0.25 <alpha^2>/4 D dt of a lab axis is 0.913 for Brownian steps, about any axis.

    Euler's scheme is not isotropic there: its y axis differs from z.
    """
    z, y = np.eye(3)[2], np.eye(3)[1]
    r = simulate(D_R=0.25, n_frames=repeats(40_001, 200_001), rng=40).rotation
    s = simulate(D_R=0.25, n_frames=repeats(40_001, 200_001), scheme="euler", rng=39).rotation
    brownian, euler = (q[1:] @ np.swapaxes(q[:-1], 1, 2) for q in (r, s))
    ratio, error = mean_and_error(np.sum(log_map(brownian) ** 2, axis=1) / 1.5)
    assert abs(ratio - 0.9582) < 4 * error + 5e-5
    for axis in (z, y):
        ratio, error = mean_and_error(np.arccos(np.clip(brownian @ axis @ axis, -1, 1)) ** 2)
        assert abs(ratio - 0.9131) < 4 * error + 5e-5
    square = [np.arccos(np.clip(euler @ axis @ axis, -1, 1)) ** 2 for axis in (z, y)]
    difference, error = mean_and_error(square[1] - square[0])
    assert difference > 4 * error


def test_eulers_scheme_is_equation_16():
    """A step is R_x R_y R_z with angles of standard deviation sqrt(2 D dt): the same draws."""
    angles = np.random.default_rng(41).normal(scale=np.sqrt(2 * 0.01 * 0.5), size=(20, 3))
    expected = [np.eye(3)]
    for triple in angles:
        expected.append(Rotation.from_euler("XYZ", triple).as_matrix() @ expected[-1])
    got = simulate(D_R=0.01, dt=0.5, n_frames=21, scheme="euler", rng=41).rotation
    np.testing.assert_allclose(got, expected, atol=1e-13)


# ---- translation, the plane, the frame ----------------------------------------------------------


@pytest.mark.parametrize("cluster", [BODY, PLANE])
def test_translation_variance(cluster, repeats):
    """Each coordinate of the centre moves by 2 D_T dt a step, within 4.5 errors, uncorrelated."""
    d = cluster.positions.shape[1]
    motion = simulate(cluster, D_T=0.04, dt=0.7, n_frames=repeats(20_001, 50_001), rng=42)
    jump = np.diff(motion.center, axis=0)
    mean, error = mean_and_error(jump[:, :, None] * jump[:, None])
    assert np.all(np.abs(mean - 2 * 0.04 * 0.7 * np.eye(d)) < 4.5 * error)
    mean, error = mean_and_error(jump)
    assert np.all(np.abs(mean) < 4.5 * error)
    mean, error = mean_and_error(jump[1:] * jump[:-1])
    assert np.all(np.abs(mean) < 4.5 * error)


@pytest.mark.parametrize("scale", [1e-5, 0.1, 2.0])
def test_the_plane_has_one_angle(scale, repeats):
    """In 2-D the turn of a step is Gaussian of variance 2 D dt: <cos> = exp(-D dt), 4 errors."""
    frames = repeats(20_001, 50_001)
    motion = simulate(PLANE, D_R=scale, n_frames=frames, rng=43)
    assert motion.rotation.shape == (frames, 2, 2)
    angle = log_map(steps(motion))[:, 0]
    mean, error = mean_and_error(2 * np.sin(angle / 2) ** 2)
    assert abs(mean + np.expm1(-scale)) < 4 * error
    mean, error = mean_and_error(np.sin(angle))
    assert abs(mean) < 4 * error


def test_the_truth_is_a_rigid_body():
    """Frame 0 counts, unturned at the origin; the particles keep their places in the body."""
    motion = simulate(D_T=0.1, dt=0.5, n_frames=200)
    np.testing.assert_array_equal(motion.rotation[0], np.eye(3))
    np.testing.assert_array_equal(motion.center[0], np.zeros(3))
    np.testing.assert_array_equal(motion.time, 0.5 * np.arange(200))
    x = motion.positions()
    assert x.shape == (200, 4, 3)
    np.testing.assert_allclose(x.mean(1), motion.center, atol=1e-13)
    sides = np.linalg.norm(x[:, 1:] - x[:, :1], axis=-1)
    np.testing.assert_allclose(sides, np.broadcast_to(sides[0], sides.shape), rtol=1e-12)
    assert motion.sigma == 0.0
    assert not motion.covariance.any()
    assert simulate(n_frames=1).positions().shape == (1, 4, 3)


def test_long_products_stay_rotations(repeats):
    """After 300 000 (quick: 100 000) steps the matrices are orthogonal to 1e-12."""
    r = simulate(D_R=0.1, n_frames=repeats(100_001, 300_001)).rotation[-10:]
    np.testing.assert_allclose(
        r @ np.swapaxes(r, 1, 2), np.broadcast_to(np.eye(3), r.shape), atol=1e-12
    )


def test_no_motion_without_diffusion():
    """D_R = 0 and D_T = 0 leave every particle exactly where it was."""
    for scheme in ("brownian", "euler"):
        for zero in (0, 0.0, [0.0, 0.0, 0.0]):
            motion = simulate(D_R=zero, scheme=scheme)
            np.testing.assert_array_equal(motion.rotation, np.broadcast_to(np.eye(3), (10, 3, 3)))
            assert not motion.center.any()


@pytest.mark.parametrize("options", [{}, {"scheme": "euler"}, {"D_R": [1e-3, 2e-3, 3e-3]}])
def test_one_seed_one_motion(options):
    """The same seed gives the same bits, as a number or a generator; another seed other ones."""
    one = simulate(D_T=0.1, rng=5, **options)
    two = simulate(D_T=0.1, rng=np.random.default_rng(5), **options)
    np.testing.assert_array_equal(one.positions(), two.positions())
    assert not np.array_equal(simulate(D_T=0.1, rng=6, **options).positions(), one.positions())
    state = np.random.default_rng(5)
    first, second = simulate(rng=state, **options), simulate(rng=state, **options)
    assert not np.array_equal(first.rotation, second.rotation)


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"dt": 0}, "dt"),
        ({"dt": -1}, "dt"),
        ({"dt": np.nan}, "dt"),
        ({"n_frames": 0}, "n_frames"),
        ({"n_frames": 2.5}, "n_frames"),
        ({"D_T": -1}, "D_T"),
        ({"D_T": np.nan}, "D_T"),
        ({"D_T": [1, 2, 3]}, "D_T"),
        ({"D_R": -1e-3}, "D_R"),
        ({"D_R": np.inf}, "D_R"),
        ({"D_R": [1, 2]}, "D_R"),
        ({"D_R": [1, 2, -1e-3]}, "D_R"),
        ({"D_R": np.ones((2, 2))}, "D_R"),
        ({"D_R": [[1, 2, 0], [0, 1, 0], [0, 0, 1]]}, "D_R"),
        ({"D_R": [[1, 2, 0], [2, 1, 0], [0, 0, 1]]}, "D_R"),
        ({"D_R": [1, 2, 3], "scheme": "euler"}, "euler"),
        ({"cluster": PLANE, "scheme": "euler"}, "euler"),
        ({"cluster": PLANE, "D_R": [1, 2, 3]}, "D_R"),
        ({"scheme": "verlet"}, "scheme"),
    ],
)
def test_invalid_options_are_refused(options, word):
    """Bad numbers, bad tensors and unknown schemes raise a ValueError that names them."""
    with pytest.raises(ValueError, match=word):
        simulate(**options)


# ---- a body that moves by its mobility ----------------------------------------------------------

CHAIN = np.array([[0.0, 0, 0], [2, 0, 0], [2, 2, 0], [2, 2, 2]])  # a screw of touching spheres
KNOWN = {"viscosity": 1e-3, "temperature": 300.0}


@pytest.fixture(scope="module")
def chain():
    """Return a body whose coupling is as large as touching spheres make it."""
    return cluster_mobility(CHAIN, radius=1.0, **KNOWN)


@pytest.fixture(scope="module")
def propeller(chain):
    """Return the same spheres with a tensor in which every term of the law is large."""
    axes = Rotation.random(3, random_state=3).as_matrix()
    values = np.array([[0.05, 0.03, 0.02], [0.012, 0.006, 0.003], [0.006, -0.003, 0.002]])
    D_T, D_R, coupling = np.einsum("kij,kj,klj->kil", axes, values, axes)
    return replace(chain, D=np.block([[D_T, coupling], [coupling, D_R]]))


def screws(motion, body):
    """Return every step of the centre of diffusion and its turn in body axes, (T - 1, 6)."""
    point = motion.center + motion.rotation @ (body.center - body.centroid)
    before = np.swapaxes(motion.rotation[:-1], 1, 2)
    shift = (before @ np.diff(point, axis=0)[..., None])[..., 0]
    return np.concatenate([shift, log_map(before @ motion.rotation[1:])], axis=1)


@pytest.mark.parametrize(
    ("name", "quick", "long"), [("chain", 120_001, 300_001), ("propeller", 15_001, 40_001)]
)
def test_the_planted_6x6_tensor_is_in_the_steps(name, quick, long, request, repeats):
    """Covariances of body-frame screws are 2 D dt in all 36 places, within 4.5 errors."""
    body = request.getfixturevalue(name)
    dt = 1e-3 / np.trace(body.D_R)  # the second order in D dt is then below the errors
    step = screws(simulate_motion(body, dt=dt, n_frames=repeats(quick, long), rng=60), body)
    mean, error = mean_and_error(step[:, :, None] * step[:, None])
    assert np.all(np.abs(mean - 2 * body.D * dt) < 4.5 * error)
    # The coupling is measured, so that its sign is tested.
    place = np.unravel_index(np.abs(body.coupling).argmax(), (3, 3))
    measured, stderr = mean[:3, 3:][place], error[:3, 3:][place]
    assert abs(measured) > repeats(4, 6) * stderr
    drift, error = mean_and_error(step)
    assert np.all(np.abs(drift) < 4.5 * error)


def test_long_steps_of_a_coupled_body(propeller, repeats):
    """At any dt the centre of diffusion has <x^2> = 2 tr(D_T) dt, <R> = exp(-(tr D_R - D_R) dt)."""
    dt = 0.4 / np.trace(propeller.D_R)
    motion = simulate_motion(propeller, dt=dt, n_frames=repeats(1001, 8001), rng=61)
    step = screws(motion, propeller)
    mean, error = mean_and_error(np.sum(step[:, :3] ** 2, axis=1))
    assert abs(mean - 2 * np.trace(propeller.D_T) * dt) < 4.5 * error
    values, axes = np.linalg.eigh(np.trace(propeller.D_R) * np.eye(3) - propeller.D_R)
    expected = axes @ np.diag(np.exp(-values * dt)) @ axes.T
    mean, error = mean_and_error(steps(motion))
    assert np.all(np.abs(mean - expected) < 4.5 * error)


def test_a_tracked_point_off_the_centre_of_diffusion(repeats):
    """The centroid of a 1:3 dimer moves by 6 D_T t + 2 r^2 (1 - exp(-2 D_R t)), D_R across it.

    At short times that is the apparent D_T, at long ones a constant more than the true one.
    """
    body = cluster_mobility([[0, 0, 0], [0, 0, 4]], radius=[1.0, 3.0], **KNOWN)
    across, r = body.D_R[0, 0], np.linalg.norm(body.center - body.centroid)
    for scale, frames in (
        (1e-3, repeats(8001, 15_001)),
        (0.2, repeats(501, 4001)),
        (1.0, repeats(151, 1001)),
    ):
        t = scale / across
        motion = simulate_motion(body, dt=t, n_frames=frames, rng=62)
        mean, error = mean_and_error(np.sum(np.diff(motion.center, axis=0) ** 2, axis=1))
        expected = 2 * np.trace(body.D_T) * t + 2 * r**2 * (1 - np.exp(-2 * across * t))
        assert abs(mean - expected) < 4 * error
        if scale == 1e-3:
            apparent = apparent_translation(body, point=body.centroid)
            assert expected == pytest.approx(6 * apparent * t, rel=1e-3)
            assert mean > 2 * np.trace(body.D_T) * t + 4 * error


def test_the_motion_of_a_mobility_is_a_rigid_body(chain):
    """The template is the centres, frame 0 is at the origin, one seed makes one walk."""
    motion = simulate_motion(chain, dt=0.5, n_frames=50, rng=7)
    np.testing.assert_allclose(motion.template, CHAIN - CHAIN.mean(0), atol=1e-15)
    np.testing.assert_array_equal(motion.center[0], np.zeros(3))
    np.testing.assert_array_equal(motion.rotation[0], np.eye(3))
    np.testing.assert_allclose(motion.positions().mean(1), motion.center, atol=1e-12)
    again = simulate_motion(chain, dt=0.5, n_frames=50, rng=np.random.default_rng(7))
    np.testing.assert_array_equal(again.positions(), motion.positions())
    assert simulate_motion(chain, dt=0.5, n_frames=1, rng=7).positions().shape == (1, 4, 3)


def test_a_mobility_has_its_own_coefficients(chain):
    """D_R, D_T or another scheme with a Mobility are refused, and a Cluster needs D_R."""
    for options in ({"D_R": 1e-3}, {"D_T": 0.1}, {"scheme": "euler"}):
        with pytest.raises(ValueError, match="Mobility"):
            simulate_motion(chain, dt=1.0, n_frames=5, rng=1, **options)
    with pytest.raises(ValueError, match="D_R: needed"):
        simulate_motion(BODY, dt=1.0, n_frames=5, rng=1)


# ---- noise --------------------------------------------------------------------------------------


def test_noise_has_its_sigma_on_every_axis():
    """The added errors have the planted variances (4.5 errors), no mean and no correlation."""
    x = np.random.default_rng(50).normal(size=(20_000, 4, 3)) + 100
    sigma = np.array([0.03, 0.02, 0.05])
    noise = (add_noise(x, sigma=sigma, rng=51) - x).reshape(-1, 3)
    mean, error = mean_and_error(noise[:, :, None] * noise[:, None])
    assert np.all(np.abs(mean - np.diag(sigma**2)) < 4.5 * error)
    mean, error = mean_and_error(noise)
    assert np.all(np.abs(mean) < 4.5 * error)


def test_noise_changes_neither_its_input_nor_missing_points():
    """The input stays, missing points stay missing, sigma 0 adds nothing, one seed one answer."""
    x = np.zeros((5, 2, 3))
    x[2, 1] = np.nan
    before = x.copy()
    noisy = add_noise(x, sigma=0.1, rng=1)
    np.testing.assert_array_equal(x, before)
    np.testing.assert_array_equal(np.isnan(noisy), np.isnan(x))
    np.testing.assert_array_equal(noisy, add_noise(x, sigma=0.1, rng=np.random.default_rng(1)))
    np.testing.assert_array_equal(add_noise(x, sigma=0, rng=1), x)
    assert add_noise(x[..., :2], sigma=[0.1, 0.2], rng=1).shape == (5, 2, 2)


@pytest.mark.parametrize("sigma", [-1, np.nan, [1, 2], np.ones((5, 2, 3))])
def test_invalid_sigmas_are_refused(sigma):
    """A negative, missing or misshapen sigma, and positions of the wrong shape, are refused."""
    with pytest.raises(ValueError, match="sigma"):
        add_noise(np.zeros((5, 2, 3)), sigma=sigma, rng=1)
    with pytest.raises(ValueError, match="positions"):
        add_noise(np.zeros((5, 3)), sigma=0.1, rng=1)
