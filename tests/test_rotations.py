"""Kabsch without an SVD against the SVD; the maps between rotations and vectors."""

import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from perrin import Cluster, DegenerateClusterError, axis_angle, kabsch, similarity
from perrin.geometry.rotations import cumulative_product, exp_map, fit_rotations, log_map, skew
from perrin.geometry.wahba import certified_rotation

TETRA = Cluster.tetrahedron(1.0).positions
TRIMER = Cluster.trimer(1.0).positions
IRREGULAR = np.random.default_rng(55).normal(size=(5, 3))
CHAIN = np.array([[-1.5, 0, 0], [-0.5, 0.01, 0], [0.5, 0, 0.01], [1.5, 0.01, -0.01]])
LINE = np.outer([0.0, 1.0, 2.5, 4.0], [1.0, 2.0, 3.0])
MIRROR = np.diag([1.0, 1.0, -1.0])

laws = settings(max_examples=25, deadline=None, derandomize=True)
seeds = st.integers(0, 2**32 - 1)


def turned(body, rotations):
    """Return the body in every orientation, (N, n, d)."""
    return np.einsum("tij,nj->tni", rotations, body)


def random_rotations(count, seed=1):
    """Return rotations uniform over SO(3)."""
    return Rotation.random(count, random_state=seed).as_matrix()


def svd_rotation(y, x, w=None):
    """Return the textbook answer for one row: centre, SVD, flip the last axis if reflected."""
    w = np.ones(len(y)) if w is None else w
    y, x = y - w @ y / w.sum(), x - w @ x / w.sum()
    u, _, vt = np.linalg.svd((w[:, None] * y).T @ x)
    flip = np.eye(y.shape[1])
    flip[-1, -1] = np.sign(np.linalg.det(u @ vt))
    return u @ flip @ vt


def svd_loop(y, x, w=None):
    """Apply `svd_rotation` to every row of (N, n, d) pairs."""
    x = np.broadcast_to(x, y.shape)
    return np.array([svd_rotation(y[k], x[k], None if w is None else w[k]) for k in range(len(y))])


def hard_cases(count):
    """Yield the name, the points and the reference of every hard but well-posed case."""
    rng = np.random.default_rng(7)
    q = random_rotations(count)

    def noise(level, body):
        return level * rng.normal(size=(count, *body.shape))

    tetra, trimer = turned(TETRA, q), turned(TRIMER, q)
    yield "tetrahedron exact", tetra, TETRA
    yield "tetrahedron noise 10 %", tetra + noise(0.1, TETRA), TETRA
    yield "tetrahedron noise 100 %", tetra + noise(1.0, TETRA), TETRA
    yield "planar exact", trimer, TRIMER
    yield "planar noise 5 %", trimer + noise(0.05, TRIMER), TRIMER
    axis = rng.normal(size=(count, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    near = exp_map((np.pi - 10.0 ** rng.uniform(-12, -3, count))[:, None] * axis)
    yield "near pi", turned(TETRA, near), TETRA
    yield "near pi planar", turned(TRIMER, near), TRIMER
    half = 2 * axis[:, :, None] * axis[:, None] - np.eye(3)
    yield "exactly pi", turned(TETRA, half), TETRA
    yield "exactly pi planar", turned(TRIMER, half), TRIMER
    yield "mirrored irregular", turned(IRREGULAR @ MIRROR, q) + noise(0.02, IRREGULAR), IRREGULAR
    yield "nearly collinear", turned(CHAIN, q), CHAIN
    yield "unit 1e-9", 1e-9 * (tetra + noise(0.1, TETRA)), 1e-9 * TETRA
    yield "unit 1e9", 1e9 * (tetra + noise(0.1, TETRA)), 1e9 * TETRA
    yield "units mixed", 1e9 * (tetra + noise(0.1, TETRA)), 1e-9 * TETRA
    many = rng.normal(size=(500, 3))
    yield "n = 500", (turned(many, q) + noise(0.1, many))[:200], many
    plane = rng.normal(size=(3, 2))
    angle = rng.uniform(-np.pi, np.pi, (count, 1))
    yield "2-D", turned(plane, exp_map(angle)) + noise(0.1, plane), plane
    yield "2-D two particles", turned(plane[:2], exp_map(angle)), plane[:2]
    yield "2-D mirrored", turned(plane * [1, -1], exp_map(angle)) + noise(0.1, plane), plane


CASES = (
    "tetrahedron exact",
    "tetrahedron noise 10 %",
    "tetrahedron noise 100 %",
    "planar exact",
    "planar noise 5 %",
    "near pi",
    "near pi planar",
    "exactly pi",
    "exactly pi planar",
    "mirrored irregular",
    "nearly collinear",
    "unit 1e-9",
    "unit 1e9",
    "units mixed",
    "n = 500",
    "2-D",
    "2-D two particles",
    "2-D mirrored",
)


@pytest.fixture(scope="module")
def cases(repeats):
    """Return points and reference of every hard case by its name."""
    found = {name: sets for name, *sets in hard_cases(repeats(300, 1500))}
    assert tuple(found) == CASES
    return found


# ---- kabsch: the answer -------------------------------------------------------------------------


@pytest.mark.parametrize("name", CASES)
def test_kabsch_agrees_with_an_svd_of_every_row(name, cases):
    """The rotation without SVD is the SVD's to 1e-12, proper and orthogonal."""
    points, reference = cases[name]
    got = kabsch(points, reference)
    np.testing.assert_allclose(got, svd_loop(points, reference), rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(got), 1.0, rtol=0, atol=1e-13)
    unit = got @ np.swapaxes(got, -1, -2)
    np.testing.assert_allclose(unit, np.broadcast_to(np.eye(got.shape[-1]), unit.shape), atol=1e-13)


@pytest.mark.parametrize("spread", [1e-2, 1e-3])
def test_a_noisy_chain_is_certified_only_where_newton_converged(spread, repeats):
    """Rows whose Newton iteration has not converged use the SVD: an error of eps/gap only."""
    count = repeats(1000, 4000)
    rng = np.random.default_rng(3)
    body = np.outer([-1.5, -0.5, 0.5, 1.5], [1.0, 0, 0]) + spread * rng.normal(size=(4, 3))
    points = turned(body, random_rotations(count)) + spread * rng.normal(size=(count, 4, 3))
    got, expected = kabsch(points, body), svd_loop(points, body)
    centred = points - points.mean(1, keepdims=True)
    c = np.einsum("tni,nj->tij", centred, body - body.mean(0))
    s = np.linalg.svd(c, compute_uv=False)
    gap = (s[:, 1] + np.sign(np.linalg.det(c)) * s[:, 2]) / s[:, 0]
    error = np.abs(got - expected).max((1, 2))
    assert np.all(error < 1e-13 + 100 * np.finfo(float).eps / gap)
    np.testing.assert_allclose(np.linalg.det(got), 1.0, rtol=0, atol=1e-13)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_ordinary_bodies_need_no_svd(sign):
    """The closed form is certified in every row of well separated singular values, and exact."""
    u, v = random_rotations(300), random_rotations(300)[::-1]
    c = u @ np.diag([3.0, 2.0, 0.5 * sign]) @ np.swapaxes(v, 1, 2) * 1e4
    rotation, certain = certified_rotation(c.transpose(1, 2, 0), np.full(300, 1e-10))
    assert certain.all()
    np.testing.assert_allclose(rotation.transpose(2, 0, 1), u @ np.swapaxes(v, 1, 2), atol=1e-13)


@pytest.mark.parametrize("offset", [1e4, 1e6])
def test_a_far_origin_costs_only_the_rounding_of_the_input(offset):
    """At a far offset the same coordinates give the SVD's answer, and the truth to eps times it."""
    rng = np.random.default_rng(4)
    q = random_rotations(1500)
    points = turned(TETRA, q) + offset * rng.normal(size=(1500, 1, 3))
    reference = TETRA + offset
    got = kabsch(points, reference)
    np.testing.assert_allclose(got, svd_loop(points, reference), rtol=0, atol=1e-12)
    np.testing.assert_allclose(got, q, rtol=0, atol=20 * np.finfo(float).eps * offset)


def test_the_length_unit_does_not_matter():
    """The planted rotation comes back whatever the length unit, from 1e-100 to 1e100."""
    q = random_rotations(50)
    for unit in (1e-100, 1e-30, 1e30, 1e100):
        got = kabsch(unit * turned(TETRA, q), unit * TETRA)
        np.testing.assert_allclose(got, q, rtol=0, atol=1e-14)


@laws
@given(seed=seeds, n=st.integers(3, 9))
def test_kabsch_follows_turns_shifts_permutations_and_units(seed, n):
    """Turn, shift, permute or rescale either set and the answer follows."""
    rng = np.random.default_rng(seed)
    x, y = rng.normal(size=(2, n, 3))
    a, b = random_rotations(2, seed=seed % 2**31)
    r, order = kabsch(y, x), rng.permutation(n)
    assert np.abs(kabsch(y @ a.T, x @ b.T) - a @ r @ b.T).max() < 1e-9
    assert np.abs(kabsch(y + 7.0, x - [1.0, 2.0, 3.0]) - r).max() < 1e-9
    assert np.abs(kabsch(y[order], x[order]) - r).max() < 1e-9
    assert np.abs(kabsch(25.4 * y, 1e-3 * x) - r).max() < 1e-9
    assert np.abs(kabsch(x, y) - r.T).max() < 1e-9


@laws
@given(seed=seeds)
def test_no_rotation_fits_better(seed):
    """The answer is a minimum of the squared distance over all proper rotations tried."""
    rng = np.random.default_rng(seed)
    x, y = rng.normal(size=(2, 4, 3))
    x, y = x - x.mean(0), y - y.mean(0)
    best = np.sum((y - x @ kabsch(y, x).T) ** 2)
    near = kabsch(y, x) @ exp_map(rng.normal(size=(100, 3)) * 10.0 ** rng.uniform(-4, 0, (100, 1)))
    others = np.concatenate([near, random_rotations(100, seed=seed % 2**31)])
    cost = np.sum((y - turned(x, others)) ** 2, axis=(1, 2))
    assert best <= cost.min() * (1 + 1e-12)


# ---- kabsch: weights and absent particles -------------------------------------------------------


@laws
@given(seed=seeds, d=st.sampled_from([2, 3]))
def test_weights_are_those_of_the_squares(seed, d):
    """Weight 0 is absence, an integer weight is a repeated point, a common factor has no effect."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(6, d))
    y = x @ kabsch(*rng.normal(size=(2, 5, d))).T + 0.1 * rng.normal(size=(6, d))
    whole = np.array([1, 2, 3, 1, 0, 2])
    repeated = kabsch(np.repeat(y, whole, axis=0), np.repeat(x, whole, axis=0))
    weighted = kabsch(y, x, weights=whole)
    assert np.abs(weighted - repeated).max() < 1e-11
    for factor in (1e-200, 1e-6, 1e9, 1e200):
        assert np.abs(kabsch(y, x, weights=factor * whole) - weighted).max() < 1e-11
    absent = kabsch(y, x, weights=[1, 1, 1, 1, 0, 1])
    assert np.abs(absent - kabsch(np.delete(y, 4, 0), np.delete(x, 4, 0))).max() < 1e-11
    assert np.abs(kabsch(y, x, weights=np.ones(6)) - kabsch(y, x)).max() < 1e-11


def test_weights_of_every_row_agree_with_the_weighted_svd():
    """Real weights, a set to each row, give the rotation of the weighted SVD to 1e-12."""
    rng = np.random.default_rng(11)
    y = turned(IRREGULAR, random_rotations(500)) + 0.05 * rng.normal(size=(500, 5, 3))
    w = rng.uniform(0.1, 3.0, size=(500, 5))
    got = kabsch(y, IRREGULAR, weights=w)
    np.testing.assert_allclose(got, svd_loop(y, IRREGULAR, w), rtol=0, atol=1e-12)
    assert np.abs(got - kabsch(y, IRREGULAR)).max() > 1e-3


@pytest.mark.parametrize("holes", ["points", "reference", "both", "one coordinate"])
def test_a_nan_row_is_an_absent_particle(holes):
    """A particle with a NaN in either set counts no more than one that was never there."""
    rng = np.random.default_rng(12)
    y = turned(IRREGULAR, random_rotations(50)) + 0.05 * rng.normal(size=(50, 5, 3))
    x = np.broadcast_to(IRREGULAR, y.shape).copy()
    kept_y, kept_x = np.delete(y, 1, axis=1), np.delete(x, 1, axis=1)
    w = np.array([1.0, 5.0, 2.0, 1.0, 1.0])
    if holes in ("points", "both"):
        y[:, 1] = np.nan
    if holes in ("reference", "both"):
        x[:, 1] = np.nan
    if holes == "one coordinate":
        y[:, 1, 2] = np.nan
    np.testing.assert_allclose(kabsch(y, x), kabsch(kept_y, kept_x), atol=1e-13)
    weighted = kabsch(kept_y, kept_x, weights=np.delete(w, 1))
    np.testing.assert_allclose(kabsch(y, x, weights=w), weighted, atol=1e-13)


# ---- kabsch: shapes -----------------------------------------------------------------------------


def test_leading_axes_broadcast_like_numpys():
    """Every leading shape gives the rows that single calls give."""
    rng = np.random.default_rng(13)
    y, x = rng.normal(size=(4, 2, 5, 3)), rng.normal(size=(2, 5, 3))
    w = rng.uniform(0.5, 1, size=(4, 1, 5))
    got = kabsch(y, x, weights=w)
    assert got.shape == (4, 2, 3, 3)
    for i, j in np.ndindex(4, 2):
        one = kabsch(y[i, j], x[j], weights=w[i, 0])
        assert one.shape == (3, 3)
        np.testing.assert_allclose(got[i, j], one, atol=1e-12)
    assert kabsch(y, x[0]).shape == (4, 2, 3, 3)
    assert kabsch(y[0, 0], x).shape == (2, 3, 3)
    assert kabsch(y[:, :1], x).shape == (4, 2, 3, 3)
    assert kabsch(y[0, 0], x[0], weights=np.ones((7, 5))).shape == (7, 3, 3)
    assert kabsch(y[..., :2], x[..., :2]).shape == (4, 2, 2, 2)


def test_an_empty_batch_gives_an_empty_answer():
    """No rows in, no rows out, with and without weights."""
    assert kabsch(np.empty((0, 4, 3)), TETRA).shape == (0, 3, 3)
    assert kabsch(np.empty((3, 0, 4, 3)), TETRA, weights=np.ones(4)).shape == (3, 0, 3, 3)
    assert kabsch(np.empty((0, 4, 2)), np.empty((0, 4, 2))).shape == (0, 2, 2)


@pytest.mark.parametrize("count", [1, 2047, 2048, 2049, 4097])
def test_the_size_of_the_batch_does_not_matter(count):
    """The rotation of a row does not depend on the number of other rows."""
    q = random_rotations(count)
    np.testing.assert_allclose(kabsch(turned(TETRA, q), TETRA), q, rtol=0, atol=1e-14)


def test_the_inputs_are_not_changed():
    """Neither set is written to, with NaN rows or without; lists of integers are accepted."""
    y = turned(TETRA, random_rotations(3))
    y[1, 2] = np.nan
    before, reference = y.copy(), TETRA.copy()
    kabsch(y, reference, weights=[1, 1, 1, 1])
    np.testing.assert_array_equal(y, before)
    np.testing.assert_array_equal(reference, TETRA)
    corner = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    np.testing.assert_allclose(kabsch(corner, corner), np.eye(3), atol=1e-15)


# ---- kabsch: refusals ---------------------------------------------------------------------------

DEGENERATE = {
    "collinear": (LINE, LINE),
    "collinear points only": (LINE, IRREGULAR[:4]),
    "collinear reference only": (IRREGULAR[:4], LINE),
    "coincident": (np.full((4, 3), 0.3), TETRA),
    "coincident trimer": (np.full((3, 3), 0.3), TRIMER),
    "exactly mirrored tetrahedron": (TETRA @ MIRROR, TETRA),
    "two places": (TETRA[[0, 0, 1, 1]], TETRA[[0, 0, 1, 1]]),
}


@pytest.mark.parametrize("offset", [0.0, 1.0, 1e3, 1e6])
@pytest.mark.parametrize("name", DEGENERATE)
def test_rows_without_a_unique_answer_are_named(name, offset):
    """Exactly the rows without one answer are in `indices`, near the origin and far from it."""
    points, reference = DEGENERATE[name]
    rng = np.random.default_rng(17)
    count, bad = 3000, [0, 5, 2047, 2048, 2999]
    good = TETRA if len(points) == 4 else TRIMER
    q = random_rotations(count)
    y, x = turned(good, q), np.broadcast_to(good, (count, *good.shape)).copy()
    y[bad], x[bad] = turned(points, q[bad]), reference
    for far in (np.zeros((count, 1, 3)), rng.normal(size=(count, 1, 3))):
        with pytest.raises(DegenerateClusterError, match=r"5 of 3000 rows .*0, 5, 2047") as caught:
            kabsch(y + offset, x + offset * far)
        assert caught.value.indices == tuple(bad)


def test_no_degenerate_row_gets_a_rotation(repeats):
    """Thousands of degenerate rows at random places, weighted or not: none gets a rotation."""
    rng = np.random.default_rng(18)
    count = repeats(500, 5000)
    q = random_rotations(count)
    far = 1e6 * rng.normal(size=(count, 1, 3))
    for name, (points, reference) in DEGENERATE.items():
        same = rng.uniform(0.1, 3, size=(count, len(points)))
        weights = [None] if "mirrored" in name else [None, same]
        for w in weights:
            for shift in (0.0, far):
                rotation, unique = fit_rotations(turned(points, q) + shift, reference, weights=w)
                assert not unique.any(), name
                assert np.isnan(rotation).all()


def test_too_few_particles_have_no_rotation():
    """One or two particles in space, or one in the plane, are refused, also by NaN and weight."""
    for n, d in ((1, 3), (2, 3), (1, 2)):
        with pytest.raises(DegenerateClusterError) as caught:
            kabsch(np.ones((2, n, d)) * np.arange(n)[:, None], np.arange(n * d).reshape(n, d))
        assert caught.value.indices == (0, 1)
    y = np.stack([TETRA, TETRA, TETRA])
    y[1, :2] = np.nan
    with pytest.raises(DegenerateClusterError) as caught:
        kabsch(y, TETRA)
    assert caught.value.indices == (1,)
    with pytest.raises(DegenerateClusterError) as caught:
        kabsch(y, TETRA, weights=[[1, 1, 1, 0], [1, 1, 1, 1], [1, 0, 0, 1]])
    assert caught.value.indices == (1, 2)
    with pytest.raises(DegenerateClusterError):
        kabsch(TETRA, TETRA, weights=np.zeros(4))


def test_indices_count_along_the_flattened_leading_axes():
    """In a batch with two leading axes the index is the flat one."""
    y = np.broadcast_to(TETRA, (3, 4, 4, 3)).copy()
    y[1, 2] = LINE
    with pytest.raises(DegenerateClusterError) as caught:
        kabsch(y, TETRA)
    assert caught.value.indices == (6,)


def test_a_mirrored_body_in_the_plane_has_no_unique_turn():
    """In 2-D a mirrored equilateral triangle fits equally badly at every angle."""
    triangle = TRIMER[:, :2]
    with pytest.raises(DegenerateClusterError):
        kabsch(triangle * [1, -1] + 1e6, triangle)


def test_a_thin_body_far_away_is_answered_or_refused_but_never_wrong():
    """What is accepted at offset 1e6 is right within the rounding of the input over the width."""
    q = random_rotations(300)
    for width in (1e-1, 1e-2, 1e-4, 1e-6, 1e-9):
        body = CHAIN * [1.0, 100 * width, 100 * width]
        rotation, unique = fit_rotations(turned(body, q) + 1e6, body)
        error = np.abs(rotation - q).max((1, 2))
        bound = 20 * np.finfo(float).eps * 1e6 / width
        assert np.all(error[unique] < bound)
        if width >= 1e-4:
            assert unique.all()
        if width <= 1e-9:
            assert not unique.any()


@pytest.mark.parametrize(
    ("points", "reference", "weights"),
    [
        (np.ones((4, 3)), np.ones((5, 3)), None),
        (np.ones((4, 3)), np.ones((4, 2)), None),
        (np.ones((4, 4)), np.ones((4, 4)), None),
        (np.ones((4, 1)), np.ones((4, 1)), None),
        (np.ones(3), np.ones(3), None),
        (np.ones((2, 0, 3)), np.ones((0, 3)), None),
        (np.ones((3, 4, 3)), np.ones((2, 4, 3)), None),
        (TETRA, TETRA, np.ones(3)),
        (TETRA, TETRA, 1.0),
        (TETRA, TETRA, [1, 1, 1, -1e-9]),
        (TETRA, TETRA, [1, 1, 1, np.nan]),
        (TETRA, TETRA, [1, 1, 1, np.inf]),
        (np.ones((3, 4, 3)), TETRA, np.ones((2, 4))),
        (np.where(np.eye(4, 3) > 0, np.inf, TETRA), TETRA, None),
        (TETRA, np.where(np.eye(4, 3) > 0, -np.inf, TETRA), None),
        (np.array([[np.nan, np.inf, 0], *TETRA[1:]]), TETRA, None),
        (np.array([[np.inf, 0, 0], *TETRA[1:]]), TETRA, [0, 1, 1, 1]),
    ],
)
def test_inputs_that_do_not_fit_are_a_value_error(points, reference, weights):
    """Shapes that do not fit, bad weights and infinite coordinates are refused by name."""
    with pytest.raises(ValueError, match=r"expected|broadcast|infinite") as caught:
        kabsch(points, reference, weights=weights)
    assert not isinstance(caught.value, DegenerateClusterError)


# ---- kabsch: speed ------------------------------------------------------------------------------


def speed_ratio(rounds=5):
    """Return the processor time of batched SVDs of ready matrices over that of whole kabsch."""
    rng = np.random.default_rng(20)
    y = turned(TETRA, random_rotations(100_001)) + 0.03 * rng.normal(size=(100_001, 4, 3))
    points, reference = y[1:], y[:-1]
    cross = np.einsum(
        "tni,tnj->tij",
        points - points.mean(1, keepdims=True),
        reference - reference.mean(1, keepdims=True),
    )
    spent = np.empty((rounds, 2))
    for row in spent:
        for i, work in enumerate((lambda: np.linalg.svd(cross), lambda: kabsch(points, reference))):
            start = time.process_time()
            work()
            row[i] = time.process_time() - start
    peer, own = np.median(spent, axis=0)
    return peer / own


def test_three_times_faster_than_batched_svd(request):
    """The whole of kabsch takes under a third of the time of the bare SVDs of ready matrices."""
    if not request.config.getoption("--long"):
        pytest.skip("a measurement of processor time, with --long only")
    assert speed_ratio() > 3 or speed_ratio() > 3


# ---- exp and log --------------------------------------------------------------------------------

vectors = arrays(np.float64, 3, elements=st.floats(-4, 4))


@laws
@given(v=vectors)
def test_exp_is_scipys_and_a_rotation(v):
    """Exp agrees with scipy to 1e-14, is orthogonal with det 1, and exp(-v) undoes exp(v)."""
    r = exp_map(v)
    np.testing.assert_allclose(r, Rotation.from_rotvec(v).as_matrix(), rtol=0, atol=1e-14)
    np.testing.assert_allclose(r @ exp_map(-v), np.eye(3), atol=1e-14)
    assert abs(np.linalg.det(r) - 1) < 1e-14


@laws
@given(v=vectors, a=st.floats(-1, 1), b=st.floats(-1, 1))
def test_turns_about_one_axis_add(v, a, b):
    """exp(a v) exp(b v) = exp((a + b) v), and exp carries its axis through any turn."""
    np.testing.assert_allclose(exp_map(a * v) @ exp_map(b * v), exp_map((a + b) * v), atol=1e-14)
    q = random_rotations(1)[0]
    np.testing.assert_allclose(exp_map(q @ v), q @ exp_map(v) @ q.T, atol=1e-14)
    np.testing.assert_allclose(skew(v) @ q[0], np.cross(v, q[0]), atol=1e-14)


@pytest.mark.parametrize(
    "angle",
    [0.0, 1e-300, 1e-160, 1e-12, 1e-9, 2e-9, 1e-8, 1e-5, 1.0, 3.0]
    + [np.pi - gap for gap in (1e-3, 1e-6, 1e-9, 1e-12)],
)
def test_log_undoes_exp_at_every_angle(angle):
    """log(exp(v)) = v to a few eps relative to the angle, from 0 to nearly half a turn."""
    v = np.random.default_rng(21).normal(size=(500, 3))
    v *= angle / np.linalg.norm(v, axis=1, keepdims=True)
    back = log_map(exp_map(v))
    np.testing.assert_allclose(back, v, rtol=0, atol=1e-14 * min(angle, 1.0))
    np.testing.assert_allclose(exp_map(back), exp_map(v), rtol=0, atol=5e-15)


def test_log_at_exactly_half_a_turn_is_one_of_two():
    """At pi the vector has length pi and exp takes it back, whichever sign it has."""
    axis = np.random.default_rng(22).normal(size=(500, 3))
    axis = np.concatenate([axis / np.linalg.norm(axis, axis=1, keepdims=True), np.eye(3)])
    half = 2 * axis[:, :, None] * axis[:, None] - np.eye(3)
    v = log_map(half)
    np.testing.assert_allclose(np.linalg.norm(v, axis=1), np.pi, rtol=0, atol=1e-14)
    np.testing.assert_allclose(exp_map(v), half, atol=1e-14)


def test_log_is_scipys():
    """Log agrees with scipy on rotations all over the group, and its length is in [0, pi]."""
    q = random_rotations(2000)
    v = log_map(q)
    np.testing.assert_allclose(v, Rotation.from_matrix(q).as_rotvec(), rtol=0, atol=1e-13)
    assert np.all(np.linalg.norm(v, axis=1) <= np.pi)
    np.testing.assert_allclose(log_map(np.swapaxes(q, 1, 2)), -v, rtol=0, atol=1e-13)


def test_nan_passes_through_log_and_shapes_through_both():
    """A missing rotation has a missing vector; leading axes and empty batches are kept."""
    q = random_rotations(6).reshape(2, 3, 3, 3).copy()
    q[1, 2] = np.nan
    v = log_map(q)
    assert v.shape == (2, 3, 3)
    assert np.isnan(v[1, 2]).all()
    assert np.isfinite(v.reshape(6, 3)[:5]).all()
    assert exp_map(v[:, :2]).shape == (2, 2, 3, 3)
    assert log_map(np.empty((0, 3, 3))).shape == (0, 3)
    assert exp_map(np.empty((0, 3))).shape == (0, 3, 3)


@laws
@given(a=st.floats(-10, 10), b=st.floats(-10, 10))
def test_turns_of_the_plane(a, b):
    """In 2-D angles add, log gives the angle in (-pi, pi], and a quarter turn takes x to y."""
    product = exp_map([a]) @ exp_map([b])
    np.testing.assert_allclose(product, exp_map([a + b]), atol=1e-14)
    angle = log_map(product)
    assert angle.shape == (1,)
    assert -np.pi < angle[0] <= np.pi
    assert abs(np.angle(np.exp(1j * (a + b - angle[0])))) < 1e-13
    np.testing.assert_allclose(exp_map([np.pi / 2]) @ [1, 0], [0, 1], atol=1e-15)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("count", [0, 1, 2, 3, 7, 1000])
def test_running_products_are_those_of_a_plain_loop(count, d):
    """Q_0 = 1, Q_{k+1} = Q_k S_k, to 1e-13 after 1000 steps."""
    steps = exp_map(np.random.default_rng(23).normal(size=(count, 3 if d == 3 else 1)))
    expected = [np.eye(d)]
    for step in steps:
        expected.append(expected[-1] @ step)
    got = cumulative_product(steps)
    assert got.shape == (count + 1, d, d)
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-13)


# ---- similarity ---------------------------------------------------------------------------------


def planted(d, batch=(), seed=31, noise=0.0):
    """Return reference sets, points s R x + v (+ noise), and the planted s, R, v."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(*batch, 6, d))
    s = np.exp(rng.normal(size=batch))
    R = exp_map(2.0 * rng.normal(size=(*batch, 3 if d == 3 else 1)))
    v = 10.0 * rng.normal(size=(*batch, d))
    y = s[..., None, None] * np.einsum("...ij,...nj->...ni", R, x) + v[..., None, :]
    return x, y + noise * rng.normal(size=y.shape), (s, R, v)


def misfit(y, x, s, R, v):
    """Return the sum that Eq. 5 makes least, with the s and v of Eq. 1; absent rows left out."""
    model = np.asarray(s)[..., None, None] * np.einsum("...ij,...nj->...ni", R, x)
    return np.nansum((y - model - np.asarray(v)[..., None, :]) ** 2, axis=(-2, -1))


@pytest.mark.parametrize("batch", [(), (1,), (50,), (4, 3)])
@pytest.mark.parametrize("d", [2, 3])
def test_similarity_recovers_what_was_planted(d, batch):
    """Scale, rotation and shift of Eq. 1 come back to 1e-12, one set or many."""
    x, y, truth = planted(d, batch)
    found = similarity(y, x)
    for got, expected, shape in zip(found, truth, [(), (d, d), (d,)], strict=True):
        assert got.shape == (*batch, *shape)
        np.testing.assert_allclose(got, expected, rtol=1e-12, atol=1e-12)
    assert found.s is found[0]
    assert found.R is found[1]
    assert found.v is found[2]


@pytest.mark.parametrize("d", [2, 3])
def test_similarity_leaves_out_nan_rows(d):
    """A NaN in either set takes the particle out, whatever the other set has."""
    x, y, truth = planted(d, (40,))
    y[:, 1] = np.nan
    y[::2, 4, 0] = np.nan
    x = np.where(np.arange(6)[:, None] == 2, np.nan, x)
    y[:, 2] = 1e6
    for got, expected in zip(similarity(y, x), truth, strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-11, atol=1e-11)
    noisy_x, noisy_y, _ = planted(d, (40,), noise=0.1)
    kept = similarity(np.delete(noisy_y, 3, 1), np.delete(noisy_x, 3, 1))
    noisy_y[:, 3] = np.nan
    for got, expected in zip(similarity(noisy_y, noisy_x), kept, strict=True):
        np.testing.assert_allclose(got, expected, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("holes", [False, True])
@pytest.mark.parametrize("d", [2, 3])
def test_no_similarity_fits_better(d, holes):
    """On noisy data every step away in s, R, v or all three costs more, large steps and small."""
    rng = np.random.default_rng(32)
    x, y, _ = planted(d, (30,), noise=0.3)
    if holes:
        y[np.arange(30)[:, None], rng.integers(0, 6, (30, 2))] = np.nan
    s, R, v = similarity(y, x)
    best = misfit(y, x, s, R, v)
    for size in (1e-3, 1e-2, 0.3):
        ds = size * rng.normal(size=s.shape)
        dR = exp_map(size * rng.normal(size=(len(s), 3 if d == 3 else 1)))
        dv = size * rng.normal(size=v.shape)
        for near in ((s + ds, R, v), (s, R @ dR, v), (s, R, v + dv), (s + ds, R @ dR, v + dv)):
            assert np.all(misfit(y, x, *near) > best)
    # At the optimum the cost has no slope.
    h = 1e-5
    slope = [misfit(y, x, s + h, R, v) - misfit(y, x, s - h, R, v)]
    slope += [misfit(y, x, s, R, v + h * e) - misfit(y, x, s, R, v - h * e) for e in np.eye(d)]
    for e in np.eye(3 if d == 3 else 1):
        slope += [misfit(y, x, s, R @ exp_map(h * e), v) - misfit(y, x, s, R @ exp_map(-h * e), v)]
    np.testing.assert_allclose(np.array(slope) / (2 * h), 0, atol=1e-6)


def test_similarity_follows_the_axes_and_units_of_both_sets():
    """Turn, shift and stretch either set: s, R, v follow; without noise the inverse is inverse."""
    x, y, _ = planted(3, (20,), noise=0.2)
    s, R, v = similarity(y, x)
    q, shift = random_rotations(1)[0], np.array([3.0, -4.0, 5.0])
    s2, R2, v2 = similarity(7.0 * y @ q.T + shift, x)
    np.testing.assert_allclose(s2, 7.0 * s, rtol=1e-12)
    np.testing.assert_allclose(R2, q @ R, atol=1e-12)
    np.testing.assert_allclose(v2, 7.0 * v @ q.T + shift, atol=1e-11)
    s3, R3, v3 = similarity(y, 0.1 * x @ q.T + shift)
    np.testing.assert_allclose(s3, 10.0 * s, rtol=1e-12)
    np.testing.assert_allclose(R3, R @ q.T, atol=1e-12)
    np.testing.assert_allclose(v3, v - np.einsum("t,tij,j->ti", s3, R3, shift), atol=1e-10)
    clean_x, clean_y, (s0, R0, v0) = planted(3)
    back = similarity(clean_x, clean_y)
    np.testing.assert_allclose(back.s, 1 / s0, rtol=1e-12)
    np.testing.assert_allclose(back.R, R0.T, atol=1e-12)
    np.testing.assert_allclose(back.v, -R0.T @ v0 / s0, atol=1e-12)


@pytest.mark.parametrize(
    ("left", "right"), [((), (4,)), ((4,), ()), ((4, 1), (3,)), ((1, 3), (4, 1)), ((0,), ())]
)
@pytest.mark.parametrize("d", [2, 3])
def test_leading_axes_of_similarity_broadcast(d, left, right):
    """Any leading shapes give what single calls give, also more of them on the reference."""
    rng = np.random.default_rng(33)
    y, x = rng.normal(size=(*left, 6, d)), rng.normal(size=(*right, 6, d))
    s, R, v = similarity(y, x)
    batch = np.broadcast_shapes(left, right)
    assert (s.shape, R.shape, v.shape) == (batch, (*batch, d, d), (*batch, d))
    y, x = np.broadcast_to(y, (*batch, 6, d)), np.broadcast_to(x, (*batch, 6, d))
    for k in np.ndindex(batch):
        one = similarity(y[k], x[k])
        np.testing.assert_allclose(s[k], one.s, rtol=1e-12)
        np.testing.assert_allclose(R[k], one.R, atol=1e-12)
        np.testing.assert_allclose(v[k], one.v, atol=1e-12)


def test_similarity_never_mirrors():
    """Mirrored data get a proper rotation and a positive scale, the best that such can do."""
    rng = np.random.default_rng(34)
    for d in (2, 3):
        x = rng.normal(size=(30, 6, d))
        s, R, v = similarity(x * np.r_[np.ones(d - 1), -1.0], x)
        assert np.all(s > 0)
        np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=1e-13)
        best = misfit(x * np.r_[np.ones(d - 1), -1.0], x, s, R, v)
        for turn in exp_map(3.0 * rng.normal(size=(50, 3 if d == 3 else 1))):
            assert np.all(misfit(x * np.r_[np.ones(d - 1), -1.0], x, s, R @ turn, v) >= best)


@pytest.mark.parametrize("name", DEGENERATE)
def test_similarity_refuses_degenerate_sets(name):
    """Collinear, coincident and exactly mirrored sets are refused with their rows."""
    points, reference = DEGENERATE[name]
    good = TETRA if len(points) == 4 else TRIMER
    with pytest.raises(DegenerateClusterError, match="collinear") as caught:
        similarity(np.stack([good, points]), np.stack([good, reference]))
    assert caught.value.indices == (1,)
    y = np.where(np.arange(4)[:, None] < 2, np.nan, TETRA)
    with pytest.raises(DegenerateClusterError):
        similarity(y, TETRA)
    with pytest.raises(ValueError, match="infinite"):
        similarity(np.where(np.eye(4, 3) > 0, np.inf, TETRA), TETRA)


# ---- axis and angle -----------------------------------------------------------------------------

AXES = {
    "x": [1.0, 0, 0],
    "-x": [-1.0, 0, 0],
    "y": [0, 1.0, 0],
    "-z": [0, 0, -1.0],
    "nearly x": [1.0, 1e-9, 0],
    "any": [0.36, -0.48, 0.8],
}


@pytest.mark.parametrize("angle", [1e-300, 1e-200, 1e-160, 1e-12, 1e-8, 1e-3, 1.0, np.pi / 2, 3.0])
@pytest.mark.parametrize("name", AXES)
def test_axis_and_angle_of_a_planted_rotation(name, angle):
    """Both come back at every angle from 1e-300 up, also along x, where eq. 29 is 0/0."""
    u = np.array(AXES[name]) / np.linalg.norm(AXES[name])
    axis, got = axis_angle(exp_map(angle * u))
    assert float(got) == pytest.approx(angle, rel=1e-14)
    np.testing.assert_allclose(axis, u, rtol=0, atol=1e-14)


@pytest.mark.parametrize("gap", [1e-3, 1e-6, 1e-8, 1e-10, 1e-12])
@pytest.mark.parametrize("name", AXES)
def test_axis_and_angle_near_half_a_turn(name, gap):
    """Just under pi the sign of the axis is still known; just over it the other one is right."""
    u = np.array(AXES[name]) / np.linalg.norm(AXES[name])
    for side in (1, -1):
        axis, angle = axis_angle(exp_map((np.pi - side * gap) * u))
        assert float(angle) == pytest.approx(np.pi - gap, abs=1e-14)
        np.testing.assert_allclose(axis, side * u, rtol=0, atol=1e-14)


def test_at_exactly_half_a_turn_either_sign_is_right():
    """At pi the angle is pi to rounding and the axis one of two, never NaN, also along x, y, z."""
    u = np.random.default_rng(41).normal(size=(300, 3))
    u = np.concatenate([u / np.linalg.norm(u, axis=1, keepdims=True), np.eye(3), -np.eye(3)])
    axis, angle = axis_angle(2 * u[:, :, None] * u[:, None] - np.eye(3))
    np.testing.assert_allclose(angle, np.pi, rtol=0, atol=1e-14)
    assert np.all(angle <= np.pi)
    np.testing.assert_allclose(np.abs(np.sum(axis * u, axis=1)), 1, atol=1e-14)


def test_no_turn_has_no_axis():
    """The identity has angle 0 and axis NaN; a missing rotation has neither; neighbours stay."""
    q = random_rotations(4)
    q[1], q[2] = np.eye(3), np.nan
    axis, angle = axis_angle(q)
    assert angle[1] == 0
    assert np.isnan(axis[1:3]).all()
    assert np.isnan(angle[2])
    assert np.isfinite(axis[[0, 3]]).all()
    single = axis_angle(np.eye(3))
    assert single[0].shape == (3,)
    assert single[1].shape == ()


def test_axis_times_angle_is_scipys_rotation_vector():
    """Over the whole group and leading axes, against Rotation.as_rotvec and magnitude (1e-13)."""
    q = random_rotations(3000)
    axis, angle = axis_angle(q.reshape(30, 100, 3, 3))
    assert axis.shape == (30, 100, 3)
    assert angle.shape == (30, 100)
    peer = Rotation.from_matrix(q)
    product = (axis * angle[..., None]).reshape(-1, 3)
    np.testing.assert_allclose(product, peer.as_rotvec(), rtol=0, atol=1e-13)
    np.testing.assert_allclose(angle.ravel(), peer.magnitude(), rtol=0, atol=1e-13)
    np.testing.assert_allclose(np.linalg.norm(axis, axis=-1), 1, rtol=0, atol=1e-14)
    assert axis_angle(np.empty((0, 3, 3)))[0].shape == (0, 3)


def test_equations_28_to_31_hold_as_printed():
    """R u = u; w = u x i/|u x i|; R w = w'; sin(dphi) u = w x w', for any axis off x (1e-12)."""
    q = np.concatenate([random_rotations(2000), exp_map([[0, 0, 1e-5], [0.3, 3.1, 0.2]])])
    u, angle = axis_angle(q)
    np.testing.assert_allclose(np.einsum("tij,tj->ti", q, u), u, rtol=0, atol=1e-12)
    w = np.cross(u, [1.0, 0.0, 0.0])
    w /= np.linalg.norm(w, axis=1, keepdims=True)
    turned_w = np.einsum("tij,tj->ti", q, w)
    cross = np.cross(w, turned_w)
    np.testing.assert_allclose(cross, np.sin(angle)[:, None] * u, rtol=0, atol=1e-12)
    # Eq. 31 alone has dphi or pi - dphi; with the cosine it is the angle between w and w'.
    between = np.arctan2(np.linalg.norm(cross, axis=1), np.sum(w * turned_w, axis=1))
    np.testing.assert_allclose(between, angle, rtol=0, atol=1e-12)


@laws
@given(seed=seeds)
def test_axis_and_angle_follow_the_lab(seed):
    """Another lab turns the axis and leaves the angle; the inverse has the opposite axis."""
    q, lab = random_rotations(2, seed=seed % 2**31)
    axis, angle = axis_angle(q)
    other, same = axis_angle(lab @ q @ lab.T)
    # The axis is known to eps over the sine of the angle.
    slack = 1e-13 / np.sin(angle)
    assert abs(angle - same) < 1e-13
    assert np.abs(other - lab @ axis).max() < slack
    assert np.abs(axis_angle(q.T)[0] + axis).max() < slack


@pytest.mark.parametrize("shape", [(), (3,), (2, 2), (5, 2, 2), (4, 4), (3, 4), (4, 3), (9,)])
def test_other_shapes_have_no_axis(shape):
    """What is not (..., 3, 3) is refused with its shape, the plane too."""
    with pytest.raises(ValueError, match=r"rotation: expected matrices \(\.\.\., 3, 3\)"):
        axis_angle(np.zeros(shape))
