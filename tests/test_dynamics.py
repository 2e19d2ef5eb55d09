"""Simulated motions that are not Brownian have the laws of their dynamics."""

import numpy as np
import pytest

from perrin import (
    Cluster,
    Confined,
    Fractional,
    Hopping,
    Spin,
    Switching,
    cluster_mobility,
    simulate_motion,
)
from perrin.cli.options import read_dynamics
from perrin.geometry.rotations import exp_map, log_map
from perrin.motion import fast_states, fractional_noise, relaxing_coordinates

BODY = Cluster.tetrahedron(1.5)
PLANE = Cluster.from_positions([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
ALL = [
    Fractional(0.5),
    Confined(5.0),
    Spin((0.01, -0.02, 0.03)),
    Switching(10, dwell=20.0),
    Hopping(0.8, 10.0),
    Hopping(0.8, 10.0, relaxation_time=5.0),
]


def simulate(dynamics, cluster=BODY, **options):
    """Return a motion with defaults that may be overridden."""
    options = {"D_R": 1e-3, "D_T": 0.04, "dt": 1.0, "n_frames": 2001, "rng": 1} | options
    return simulate_motion(cluster, dynamics=dynamics, **options)


def lab_steps(motion):
    """Return the lab-frame rotation vector of every step, log(R_{k+1} R_k^T)."""
    return log_map(motion.rotation[1:] @ np.swapaxes(motion.rotation[:-1], -1, -2))


def body_steps(motion):
    """Return the body-frame rotation vector of every step, log(R_k^T R_{k+1})."""
    return log_map(np.swapaxes(motion.rotation[:-1], -1, -2) @ motion.rotation[1:])


def mean_and_error(samples):
    """Return the mean over the first axis, of independent samples, and its standard error."""
    samples = np.asarray(samples)
    return samples.mean(0), samples.std(0, ddof=1) / np.sqrt(len(samples))


def assert_within(samples, expected, *, errors=4.0):
    """Assert that the mean of independent samples is as expected within this many errors."""
    mean, error = mean_and_error(samples)
    np.testing.assert_array_less(np.abs(mean - expected), errors * error)


# ---- every dynamics -----------------------------------------------------------------------------


@pytest.mark.parametrize("dynamics", ALL, ids=repr)
@pytest.mark.parametrize("cluster", [BODY, PLANE], ids=["space", "plane"])
def test_one_seed_makes_one_walk_from_the_origin(dynamics, cluster):
    """Frame 0 is at the origin and not rotated; orientations are rotations; a seed repeats."""
    if cluster is PLANE and isinstance(dynamics, Spin):
        dynamics = Spin(0.03)
    motion = simulate(dynamics, cluster, n_frames=60)
    again = simulate(dynamics, cluster, n_frames=60, rng=np.random.default_rng(1))
    other = simulate(dynamics, cluster, n_frames=60, rng=2)
    np.testing.assert_array_equal(motion.positions(), again.positions())
    assert np.abs(motion.positions() - other.positions()).max() > 0.1
    d = motion.dimension
    np.testing.assert_array_equal(motion.rotation[0], np.eye(d))
    np.testing.assert_array_equal(motion.center[0], np.zeros(d))
    square = motion.rotation @ np.swapaxes(motion.rotation, -1, -2)
    np.testing.assert_allclose(square, np.broadcast_to(np.eye(d), square.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(motion.rotation), 1.0, atol=1e-12)
    assert simulate(dynamics, cluster, n_frames=1).positions().shape == motion.positions()[:1].shape


@pytest.mark.parametrize("dynamics", ALL, ids=repr)
def test_the_unit_of_time_has_no_effect(dynamics):
    """With all times a thousand times as long and all rates as small the poses are the same."""
    times = {"relaxation_time", "dwell", "interval"}
    entry = {
        name: 1000 * value if name in times and value is not None else value
        for name, value in dynamics.to_dict().items()
    }
    if "rate" in entry:
        entry["rate"] = [value / 1000 for value in entry["rate"]]
    slow = type(dynamics).from_dict(entry)
    one = simulate(dynamics, n_frames=50)
    two = simulate(slow, n_frames=50, D_R=1e-6, D_T=4e-5, dt=1000.0)
    np.testing.assert_allclose(two.rotation, one.rotation, atol=1e-12)
    np.testing.assert_allclose(two.center, one.center, atol=1e-12)


@pytest.mark.parametrize("dynamics", ALL, ids=repr)
def test_options_are_converted_to_json_and_back(dynamics):
    """from_dict returns what to_dict wrote, and equal options are equal."""
    assert type(dynamics).from_dict(dynamics.to_dict()) == dynamics


# ---- fractional ---------------------------------------------------------------------------------


@pytest.mark.parametrize("alpha", [0.3, 0.8, 1.0, 1.5, 1.9])
def test_fractional_noise_has_its_exact_covariance(alpha):
    """Covariance (m+1)^alpha + |m-1|^alpha - 2 m^alpha over 2, and sums of mean square m^alpha."""
    x = fractional_noise(alpha, (64, 10_000), generator=np.random.default_rng(1))
    for m in (0, 1, 2, 10, 63):
        expected = ((m + 1) ** alpha + abs(m - 1) ** alpha - 2 * m**alpha) / 2
        assert_within(x[0] * x[m], expected)
    for m in (1, 4, 16, 64):
        assert_within(x[:m].sum(axis=0) ** 2, m**alpha)


@pytest.mark.parametrize("alpha", [0.5, 1.5])
@pytest.mark.parametrize("cluster", [BODY, PLANE], ids=["space", "plane"])
def test_mean_squares_grow_as_a_power(alpha, cluster):
    """MSD and mean square of added lab-frame steps are 2 d D dt m^alpha; D holds at one frame."""
    D_R, D_T, dt = 1e-4, 0.04, 0.5
    lags = np.array([1, 3, 10, 30, 100])
    turned, moved = [], []
    for seed in range(40):
        motion = simulate(
            Fractional(alpha), cluster, D_R=D_R, D_T=D_T, dt=dt, n_frames=301, rng=seed
        )
        angle = np.cumsum(lab_steps(motion), axis=0)
        sums = np.concatenate([np.zeros((1, angle.shape[1])), angle])
        turned.append([np.mean((sums[m:] - sums[:-m]) ** 2) for m in lags])
        moved.append([np.mean((motion.center[m:] - motion.center[:-m]) ** 2) for m in lags])
    assert_within(turned, 2 * D_R * dt * lags**alpha)
    assert_within(moved, 2 * D_T * dt * lags**alpha)


def test_the_memory_of_a_rotation_is_in_the_lab():
    """At large turns lab-frame steps keep their covariance 5 steps later, body-frame steps do not.

    The neighbour of a step has the same angle with it in both frames.
    """
    alpha, D = 1.5, 0.2
    motion = simulate(Fractional(alpha), D_R=D, n_frames=20_001)
    lab, body = (np.mean(x[5:] * x[:-5]) for x in (lab_steps(motion), body_steps(motion)))
    assert lab == pytest.approx(D * (6**alpha + 4**alpha - 2 * 5**alpha), rel=0.2)
    assert abs(body) < 0.6 * lab


# ---- confined -----------------------------------------------------------------------------------


@pytest.mark.parametrize("cluster", [BODY, PLANE], ids=["space", "plane"])
def test_a_cage_has_its_plateau_and_its_relaxation(cluster):
    """Mean squares are 2 L^2 (1 - exp(-t/tau)) per axis, L^2 = D tau."""
    D_R, D_T, dt, tau = 2e-4, 0.04, 0.5, 4.0
    lags = np.array([1, 8, 100])
    turned, moved = [], []
    for seed in range(30):
        motion = simulate(Confined(tau), cluster, D_R=D_R, D_T=D_T, dt=dt, n_frames=301, rng=seed)
        turn = np.swapaxes(motion.rotation[:1], -1, -2) @ motion.rotation
        for found, x in ((turned, log_map(turn)), (moved, motion.center)):
            found.append([np.mean((x[m:] - x[:-m]) ** 2) for m in lags])
    law = 2 * tau * -np.expm1(-lags * dt / tau)
    assert_within(turned, D_R * law, errors=4.5)
    assert_within(moved, D_T * law)


def test_a_cage_takes_a_tensor_in_body_axes():
    """Short steps have the covariance 2 D dt of the tensor, and the steps of g_0 and g_1."""
    D = np.array([[3.0, 0.5, 0.2], [0.5, 2.0, -0.3], [0.2, -0.3, 1.0]]) * 1e-4
    kappa = 0.1
    motion = simulate(Confined(1 / kappa), D_R=D, n_frames=20_001)
    y = body_steps(motion)
    g = 2 * -np.expm1(-kappa) / kappa, -(np.expm1(-kappa) ** 2) / kappa
    np.testing.assert_allclose(y.T @ y / len(y), g[0] * D, atol=0.04 * g[0] * D.max())
    lagged = y[1:].T @ y[:-1] / (len(y) - 1)
    np.testing.assert_allclose(lagged, g[1] * D, atol=0.04 * g[0] * D.max())


def test_a_relaxing_coordinate_does_not_depend_on_the_sampling():
    """Every tenth value of a fine process has the correlation of the coarse one."""
    fine = relaxing_coordinates(0.05, (2000, 200), generator=np.random.default_rng(2))[::10]
    assert_within((fine[1:] * fine[:-1]).mean(axis=0), np.exp(-0.5))


# ---- spin ---------------------------------------------------------------------------------------


def test_a_spin_is_found_back_in_the_lab():
    """Without diffusion R = exp(rate t); with it, the mean of the lab-frame steps is the spin."""
    rate = np.array([0.02, -0.05, 0.03])
    motion = simulate(Spin(rate), D_R=0.0, D_T=0.0, dt=0.5, n_frames=100)
    np.testing.assert_allclose(motion.rotation, exp_map(motion.time[:, None] * rate), atol=1e-12)
    motion = simulate(Spin(tuple(rate)), D_R=1e-3, dt=0.5, n_frames=4001)
    assert_within(lab_steps(motion), 0.5 * rate)
    flat = simulate(Spin(0.05), PLANE, D_R=1e-3, n_frames=4001)
    assert_within(lab_steps(flat), 0.05)


def test_a_spin_is_added_to_the_same_brownian_motion():
    """R(t) exp(-rate t) on the left is the walk of the same seed without a spin."""
    tensor = [1e-3, 2e-3, 3e-3]
    spinning = simulate(Spin(0.3), D_R=tensor, n_frames=50)
    free = simulate(None, D_R=tensor, n_frames=50)
    back = exp_map(-spinning.time[:, None] * [0.0, 0.0, 0.3])
    np.testing.assert_allclose(back @ spinning.rotation, free.rotation, atol=1e-12)
    np.testing.assert_allclose(spinning.center, free.center, atol=1e-12)


# ---- switching ----------------------------------------------------------------------------------


@pytest.mark.parametrize("cluster", [BODY, PLANE], ids=["space", "plane"])
def test_switching_keeps_the_mean_and_the_two_states_are_the_same_for_both(cluster):
    """Mean squares are those of the given D; squares of both quantities are correlated as planned.

    The relative variance of D over the states, v = ((ratio - 1)/(ratio + 1))^2, is the relative
    covariance of the squares of a turn and of a displacement in one step, and decays as
    exp(-2 t/dwell).
    """
    D_R, D_T, ratio, dwell = 1e-4, 0.04, 10.0, 5.0
    turn, jump, common, later = [], [], [], []
    for seed in range(40):
        motion = simulate(
            Switching(ratio, dwell), cluster, D_R=D_R, D_T=D_T, n_frames=501, rng=seed
        )
        a = np.mean(body_steps(motion) ** 2, axis=1) / (2 * D_R)
        b = np.mean(np.diff(motion.center, axis=0) ** 2, axis=1) / (2 * D_T)
        turn.append(a.mean())
        jump.append(b.mean())
        common.append(np.mean(a * b) - 1)
        later.append(np.mean(a[3:] * b[:-3]) - 1)
    v = ((ratio - 1) / (ratio + 1)) ** 2
    assert_within(turn, 1.0)
    assert_within(jump, 1.0)
    assert_within(common, v)
    assert_within(later, v * np.exp(-2 * 3 / dwell))


def test_states_change_at_their_rate_however_they_are_sampled():
    """The share of changes over a time t is (1 - exp(-2 r t))/2, also over several steps."""
    fast = fast_states(0.05, 200_000, generator=np.random.default_rng(3))
    for lag in (1, 5, 40):
        changed = fast[lag::lag] != fast[:-lag:lag]
        assert_within(changed.astype(float), -0.5 * np.expm1(-0.1 * lag))


# ---- hopping ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("cluster", "dimensions"), [(BODY, 3), (PLANE, 1)])
def test_hops_add_to_the_coefficient(cluster, dimensions):
    """Added squares of steps are those of D_R + angle^2/(2 d interval); translation is free."""
    angle, interval, D_R = 0.3, 20.0, 2e-4
    motions = [
        simulate(Hopping(angle, interval), cluster, D_R=D_R, n_frames=501, rng=seed)
        for seed in range(40)
    ]
    squares = [np.mean(body_steps(motion) ** 2) / 2 for motion in motions]
    assert_within(squares, D_R + angle**2 / (2 * dimensions * interval))
    assert_within([np.mean(np.diff(m.center, axis=0) ** 2) / 2 for m in motions], 0.04)


def test_hops_are_poisson_turns_by_one_angle():
    """Without diffusion single turns are the angle, and exp(-dt/interval) are empty."""
    angle, interval = 0.4, 3.0
    motion = simulate(Hopping(angle, interval), D_R=0.0, n_frames=4001)
    turned = np.linalg.norm(body_steps(motion), axis=1)
    still = turned < 1e-9
    assert_within(still.astype(float), np.exp(-1 / interval))
    once = np.isclose(turned, angle)
    assert_within(once.astype(float), np.exp(-1 / interval) / interval, errors=4)


def test_a_caged_body_diffuses_by_its_hops_alone():
    """At long times orientations lose memory as those of the hops, times the cage's own factor.

    A turn by theta keeps (1 + 2 cos theta)/3 of E[R], and turns arrive at random; a cage of
    variance L^2 per axis keeps at both ends (2 <cos> + 1)/3 with <1 - cos> = 3 L^2/2 to first
    order.
    """
    angle, interval, tau, D_R = 0.8, 100.0, 5.0, 2e-3
    kept = []
    for seed in range(20):
        motion = simulate(
            Hopping(angle, interval, relaxation_time=tau), D_R=D_R, n_frames=1001, rng=seed
        )
        R = motion.rotation
        kept.append([np.mean(np.einsum("tij,tij->t", R[m:], R[:-m])) / 3 for m in (50, 150)])
        assert np.abs(motion.center).max() < 6 * np.sqrt(2 * 0.04 * tau)
    rate = (1 - np.cos(angle)) * 2 / 3 / interval
    w = np.random.default_rng(0).normal(scale=np.sqrt(D_R * tau), size=(100_000, 3))
    cage = np.mean(1 + 2 * np.cos(np.linalg.norm(w, axis=1))) / 3
    assert_within(kept, cage**2 * np.exp(-rate * np.array([50, 150])))


# ---- refusals -----------------------------------------------------------------------------------


def test_options_out_of_range_are_refused():
    """Every class states its range and what came."""
    for make, match in (
        (lambda: Fractional(2.0), "alpha: expected .* < 2, got 2.0"),
        (lambda: Confined(0.0), "relaxation_time: expected .*s.*, got 0.0"),
        (lambda: Spin((0.1, 0.2)), "rate: expected one finite number .* or 3"),
        (lambda: Spin(np.nan), "rate"),
        (lambda: Spin("fast"), "rate"),
        (lambda: Switching(0.5, -1.0), "ratio: .*; dwell: "),
        (lambda: Hopping(4.0, 0.0, -1.0), "angle: .*; interval: .*; relaxation_time: "),
    ):
        with pytest.raises(ValueError, match=match):
            make()


def test_combinations_without_meaning_are_refused():
    """Dynamics with a Mobility, with "euler", of another type, and tensors with a lab memory."""
    with pytest.raises(ValueError, match="Mobility"):
        simulate_motion(
            cluster_mobility(
                Cluster.touching(3, 2.0), radius=1.0, viscosity=1e-3, temperature=300, accuracy=0.01
            ),
            dt=1.0, n_frames=3, dynamics=Confined(1.0), rng=1,
        )  # fmt: skip
    with pytest.raises(ValueError, match=r"euler.*leave dynamics out"):
        simulate(Confined(1.0), scheme="euler")
    with pytest.raises(ValueError, match=r"dynamics: expected Fractional.*'confined'"):
        simulate("confined")
    with pytest.raises(ValueError, match=r"Fractional.*one D_R"):
        simulate(Fractional(0.5), D_R=[1e-3, 2e-3, 3e-3])
    with pytest.raises(ValueError, match="about z in the plane"):
        simulate(Spin((0.1, 0.0, 0.0)), PLANE)


@pytest.mark.parametrize(
    ("text", "dynamics"),
    [
        ("fractional:0.5", Fractional(0.5)),
        ("confined:5", Confined(5.0)),
        ("spin:0.2", Spin(0.2)),
        ("spin:0,0.1,0.2", Spin((0.0, 0.1, 0.2))),
        ("switching:10,14", Switching(10.0, 14.0)),
        ("hopping:0.8,70", Hopping(0.8, 70.0)),
        ("hopping:0.8,70,5", Hopping(0.8, 70.0, relaxation_time=5.0)),
        (None, None),
    ],
)
def test_the_command_line_reads_all_dynamics(text, dynamics):
    """Name, colon, numbers."""
    assert read_dynamics(text) == dynamics


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("sticky:1", "expected fractional"),
        ("confined", "expected a number"),
        ("switching:10", "wrong number of values for switching"),
        ("fractional:3", "--dynamics: alpha: expected"),
    ],
)
def test_the_command_line_refuses_other_dynamics(text, words):
    """The message names the option and what was expected."""
    with pytest.raises(ValueError, match=words):
        read_dynamics(text)
