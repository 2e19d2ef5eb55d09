"""The noise floor: published numbers, exact tops, and fits to noisy bodies."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from perrin import Cluster, DegenerateClusterError, NoiseFloor, kabsch, noise_floor
from perrin.geometry.rigid import center_variance, orientation_covariance, pose_slopes
from perrin.geometry.rotations import exp_map, log_map
from perrin.motion.floor import floor_of

IRREGULAR = np.random.default_rng(5).normal(size=(6, 3)) * [1.5, 1.0, 0.7]
laws = settings(max_examples=25, deadline=None, derandomize=True)
sizes = st.floats(1e-3, 1e3)


def paper_formula(cluster, sigma):
    """Return 6 sigma^2 / (n R^2), Eq. 23."""
    return 6 * sigma**2 / (len(cluster.positions) * cluster.R**2)


def fitted_orientations(body, sigma, count, seed, kept=None):
    """Return rotation vectors (count, 3 or 1) of fits to a body at rest."""
    noise = np.random.default_rng(seed).normal(size=(count, *body.shape)) * sigma
    kept = np.arange(len(body)) if kept is None else kept
    return log_map(kabsch((body + noise)[:, kept], body[kept]))


# ---- published and exact numbers ----------------------------------------------------------------


@laws
@given(radius=sizes, ratio=st.floats(1e-6, 0.3))
def test_the_papers_formula_is_exact_for_spherical_tops(radius, ratio):
    """Tetrahedron and octahedron: Phi^2 = 6 sigma^2/(n R^2), the same along every direction."""
    for body in (Cluster.tetrahedron(radius), Cluster.touching(6, radius)):
        floor = noise_floor(body, sigma=ratio * radius)
        expected = paper_formula(body, ratio * radius)
        assert floor.phi2 == pytest.approx(expected, rel=1e-12)
        for p in np.random.default_rng(1).normal(size=(5, 3)):
            assert floor.along(p) == pytest.approx(expected, rel=1e-12)


def test_trimer_and_pentahedron():
    """Means over directions: trimer 20/9 s^2/R^2, the paper's pentahedron 76/63 s^2/R^2."""
    for radius, sigma in ((1.0, 0.01), (1.5, 0.03)):
        unit = (sigma / radius) ** 2
        trimer = noise_floor(Cluster.trimer(radius), sigma=sigma)
        assert trimer.phi2 / unit == pytest.approx(20 / 9, rel=1e-9)
        pentahedron = noise_floor(Cluster.pentahedron(radius), sigma=sigma)
        assert pentahedron.phi2 / unit == pytest.approx(76 / 63, rel=1e-9)


@pytest.mark.parametrize(
    ("body", "direction", "expected"),
    [
        (Cluster.pentahedron(1.5), [0, 0, 1], 0.952),
        (Cluster.pentahedron(1.5), [1, 0, 0], 1.032),
        (Cluster.pentahedron(1.5), [1, 5, 0], 1.032),
        (Cluster.trimer(1.5), [0, 0, -3], 1.333),
        (Cluster.trimer(1.5), [1, 0, 0], 1.0),
        (Cluster.trimer(1.5), [0, 2, 0], 1.0),
    ],
)
def test_single_directions(body, direction, expected):
    """Phi^2(p) over the paper's formula, from 2 (tr C - p.C.p) of the two shapes."""
    ratio = noise_floor(body, sigma=0.03).along(direction) / paper_formula(body, 0.03)
    assert ratio == pytest.approx(expected, abs=5e-4)


def test_phi_of_the_papers_experiment():
    """Sigma 30, 30, 40 nm on R = 1.500 um gives Phi = 0.0275 rad (printed: about 0.028)."""
    floor = noise_floor(Cluster.touching(4, 2.45), sigma=(0.030, 0.030, 0.040))
    assert floor.phi2**0.5 == pytest.approx(0.0275, abs=5e-5)


@laws
@given(st.tuples(sizes, sizes, sizes))
def test_the_floor_of_a_tetrahedron_is_that_of_the_mean_variance(sigma):
    """Per-axis sigma on a tetrahedron: Phi^2 is that of the mean of the three variances."""
    body = Cluster.tetrahedron(2e3)
    variance = np.square(sigma)
    mean = noise_floor(body, sigma=variance.mean() ** 0.5)
    floor = noise_floor(body, sigma=sigma)
    assert floor.phi2 == pytest.approx(mean.phi2, rel=1e-12)
    n_r2 = 4 * body.R**2
    expected = 3 / (4 * n_r2) * np.diag(variance.sum() - variance)
    np.testing.assert_allclose(floor.covariance, expected, rtol=0, atol=1e-12 * expected.max())


# ---- laws ---------------------------------------------------------------------------------------


@laws
@given(seed=st.integers(0, 10**6), n=st.integers(3, 8))
def test_the_floor_follows_the_body(seed, n):
    """Turn, shift, permute, rescale: C turns along, Phi^2 stays; sigma^2 multiplies it."""
    rng = np.random.default_rng(seed)
    x, turn = rng.normal(size=(n, 3)), Rotation.random(random_state=seed).as_matrix()
    one = noise_floor(x, sigma=0.01)
    assert one.phi2 == pytest.approx(4 / 3 * np.trace(one.covariance), rel=1e-14)
    around = noise_floor(x @ turn.T, sigma=0.01)
    np.testing.assert_allclose(around.covariance, turn @ one.covariance @ turn.T, rtol=1e-8)
    p = rng.normal(size=3)
    assert around.along(turn @ p) == pytest.approx(one.along(p), rel=1e-8)
    assert one.along(-7 * p) == pytest.approx(one.along(p), rel=1e-12)
    assert noise_floor(rng.permutation(x) + 5, sigma=0.01).phi2 == pytest.approx(one.phi2, rel=1e-8)
    assert noise_floor(1e3 * x, sigma=10.0).phi2 == pytest.approx(one.phi2, rel=1e-10)
    assert noise_floor(x, sigma=0.03).phi2 == pytest.approx(9 * one.phi2, rel=1e-12)


def test_the_mean_over_directions_is_the_mean():
    """Phi^2 is the average of Phi^2(p) over three orthogonal directions, any three."""
    floor = noise_floor(IRREGULAR, sigma=(0.01, 0.02, 0.05))
    for turn in Rotation.random(5, random_state=3).as_matrix():
        assert np.mean([floor.along(p) for p in turn]) == pytest.approx(floor.phi2, rel=1e-12)


def test_in_the_plane_one_angle():
    """In 2-D Phi^2 = 2 sigma^2 / sum r^2, the same for every direction; two particles suffice."""
    x = np.array([[0.0, 0.0], [2.0, 0.0]])
    floor = noise_floor(x, sigma=0.1)
    assert floor.covariance.shape == (1, 1)
    assert floor.phi2 == pytest.approx(2 * 0.01 / 2)
    assert floor.along([3.0, 4.0]) == floor.phi2
    across = noise_floor(x, sigma=(0.5, 0.1))
    assert across.phi2 == pytest.approx(floor.phi2)


# ---- against fits -------------------------------------------------------------------------------


@pytest.mark.parametrize("sigma", [0.01, (0.005, 0.01, 0.02)])
@pytest.mark.parametrize("kept", [None, [0, 2, 3], [1, 2, 4, 5]])
def test_the_covariance_is_that_of_fits(sigma, kept):
    """40 000 fits to a still irregular body scatter as predicted, within 4.5 standard errors."""
    count = 40_000
    v = fitted_orientations(IRREGULAR, sigma, count, seed=6, kept=kept)
    rows = slice(None) if kept is None else kept
    noise = np.diag(np.broadcast_to(np.square(sigma), 3))
    c = orientation_covariance(IRREGULAR[rows], noise)
    error = np.sqrt((np.outer(np.diag(c), np.diag(c)) + c**2) / count)
    # The second order in sigma/R adds up to 1 % of the variance to what the formula knows.
    slack = 0.01 * np.sqrt(np.outer(np.diag(c), np.diag(c)))
    assert np.all(np.abs(v.T @ v / count - c) < 4.5 * error + slack)
    if kept is None:
        np.testing.assert_allclose(noise_floor(IRREGULAR, sigma=sigma).covariance, c, rtol=1e-12)


def test_the_floor_is_the_msad_of_a_still_body():
    """The mean square angle between two fits of one direction is Phi^2(p), within 4 errors."""
    v = fitted_orientations(IRREGULAR, (0.01, 0.02, 0.03), 40_000, seed=7)
    floor = noise_floor(IRREGULAR, sigma=(0.01, 0.02, 0.03))
    matrices = Rotation.from_rotvec(v).as_matrix()
    for p in np.eye(3):
        one, two = matrices[::2] @ p, matrices[1::2] @ p
        angle = np.arctan2(np.linalg.norm(np.cross(one, two), axis=1), np.sum(one * two, axis=1))
        square = angle**2
        error = square.std() / np.sqrt(len(square))
        assert abs(square.mean() - floor.along(p)) < 4 * error + 0.01 * floor.along(p)


def test_the_covariance_in_the_plane_is_that_of_fits():
    """2-D, anisotropic sigma: the variance of 40 000 fitted angles, within 4 standard errors."""
    body = np.array([[0.0, 0.0], [2.0, 0.1], [0.5, 0.7]])
    v = fitted_orientations(body, (0.01, 0.03), 40_000, seed=8)
    expected = noise_floor(body, sigma=(0.01, 0.03)).covariance[0, 0]
    assert abs(np.mean(v**2) / expected - 1) < 4 * np.sqrt(2 / 40_000) + 0.003


@pytest.mark.parametrize("d", [2, 3])
def test_the_centre_variance_is_that_of_fits(d):
    """A centre extrapolated from some particles scatters as predicted, within 4 errors."""
    body = IRREGULAR[:, :d] - IRREGULAR[:, :d].mean(0)
    kept = np.array([True, False, True, True, False, False])
    rng = np.random.default_rng(9)
    y = body[kept] + 0.01 * rng.normal(size=(40_000, 3, d))
    turn = kabsch(y, body[kept])
    center = y.mean(1) - turn @ body[kept].mean(0)
    predicted = center_variance(body, kept, 0.01)
    assert predicted > 1.1 * 0.01**2 / 3
    square = np.mean(center**2, axis=1)
    error = square.std() / np.sqrt(len(square))
    assert abs(square.mean() - predicted) < 4 * error + 0.01 * predicted
    assert center_variance(body, np.ones(6, bool), 0.01) == pytest.approx(0.01**2 / 6)


def test_floors_of_many_covariances_at_once():
    """(4/3) tr C along leading axes in space, 2 C in the plane."""
    c = np.stack([np.eye(3), 2 * np.eye(3)])
    np.testing.assert_allclose(floor_of(c), [4, 8])
    np.testing.assert_allclose(floor_of(np.full((5, 1, 1), 0.3)), np.full(5, 0.6))


@pytest.mark.parametrize("d", [2, 3])
def test_the_slopes_of_a_pose_are_its_derivatives(d):
    """Small rotations and shifts move the particles by the slopes, to second order (1e-9)."""
    body = IRREGULAR[:, :d]
    slopes = pose_slopes(body)
    angles = d * (d - 1) // 2
    assert slopes.shape == (6, d, angles + d)
    change = 1e-5 * np.random.default_rng(4).normal(size=angles + d)
    moved = body @ exp_map(change[:angles]).T + change[angles:]
    np.testing.assert_allclose(moved - body, slopes @ change, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(pose_slopes(np.stack([body, 2 * body]))[0], slopes)


# ---- refusals -----------------------------------------------------------------------------------


@pytest.mark.parametrize("offset", [0.0, 1e6])
@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
def test_bodies_without_an_orientation_are_refused(offset, unit):
    """Collinear, coincident and too few particles raise DegenerateClusterError."""
    line = np.outer([0.0, 1.0, 2.5, 4.0], [1.0, 2.0, 3.0])
    bodies = [line, np.zeros((4, 3)), line[:2], np.zeros((1, 2)), np.zeros((3, 2))]
    for body in bodies:
        with pytest.raises(DegenerateClusterError, match="orientation") as caught:
            noise_floor((body + offset) * unit, sigma=0.01)
        assert caught.value.indices == (len(body),)
    with pytest.raises(DegenerateClusterError):
        noise_floor(Cluster.touching(2, 1.0), sigma=0.01)


@pytest.mark.parametrize("sigma", [-0.01, np.nan, np.inf, (0.01, 0.01), (0.01, -0.01, 0.01), [[1]]])
def test_invalid_sigmas_are_refused(sigma):
    """Negative, infinite or misshapen sigma is refused; zero is allowed and gives zero."""
    with pytest.raises(ValueError, match="sigma"):
        noise_floor(Cluster.tetrahedron(1.0), sigma=sigma)
    assert noise_floor(Cluster.tetrahedron(1.0), sigma=0).phi2 == 0.0


@pytest.mark.parametrize("p", [[0, 0, 0], [1, 0], [np.nan, 0, 1], [np.inf, 0, 0], 1.0])
def test_invalid_directions_are_refused(p):
    """A direction that is zero, not finite or misshapen is refused."""
    with pytest.raises(ValueError, match="direction"):
        noise_floor(Cluster.trimer(1.0), sigma=0.01).along(p)


@pytest.mark.parametrize("body", [Cluster.trimer(1.0), [[0.0, 0.0], [2.0, 0.0]]])
def test_a_floor_survives_json(body):
    """to_dict, through JSON, and from_dict give back the same floor."""
    floor = noise_floor(body, sigma=0.03)
    back = NoiseFloor.from_dict(json.loads(json.dumps(floor.to_dict())))
    assert back.phi2 == floor.phi2
    np.testing.assert_array_equal(back.covariance, floor.covariance)
    assert not back.covariance.flags.writeable


def test_the_covariance_is_read_only():
    """A result cannot change after the fact."""
    with pytest.raises(ValueError, match="read-only"):
        noise_floor(Cluster.trimer(1.0), sigma=0.01).covariance[0, 0] = 1.0
