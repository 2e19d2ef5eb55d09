"""Kabsch without an SVD against the SVD; the maps between rotations and vectors."""

import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from perrin import Cluster, DegenerateClusterError, kabsch
from perrin.rotations import cumulative_product, exp_map, fit_rotations, log_map, skew

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


def hard_cases():
    """Yield the name, the points and the reference of every hard but well-posed case."""
    rng = np.random.default_rng(7)
    count = 1500
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


CASES = {name: (points, reference) for name, points, reference in hard_cases()}


# ---- kabsch: the answer -------------------------------------------------------------------------


@pytest.mark.parametrize("name", CASES)
def test_kabsch_agrees_with_an_svd_of_every_row(name):
    """The rotation without SVD is the SVD's to 1e-12, proper and orthogonal."""
    points, reference = CASES[name]
    got = kabsch(points, reference)
    np.testing.assert_allclose(got, svd_loop(points, reference), rtol=0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(got), 1.0, rtol=0, atol=1e-13)
    unit = got @ np.swapaxes(got, -1, -2)
    np.testing.assert_allclose(unit, np.broadcast_to(np.eye(got.shape[-1]), unit.shape), atol=1e-13)


@pytest.mark.parametrize("spread", [1e-2, 1e-3])
def test_a_noisy_chain_is_not_certified_by_luck(spread):
    """Rows whose Newton iteration has not settled take the slow path: an error of eps/gap only."""
    rng = np.random.default_rng(3)
    body = np.outer([-1.5, -0.5, 0.5, 1.5], [1.0, 0, 0]) + spread * rng.normal(size=(4, 3))
    points = turned(body, random_rotations(4000)) + spread * rng.normal(size=(4000, 4, 3))
    got, expected = kabsch(points, body), svd_loop(points, body)
    centred = points - points.mean(1, keepdims=True)
    c = np.einsum("tni,nj->tij", centred, body - body.mean(0))
    s = np.linalg.svd(c, compute_uv=False)
    gap = (s[:, 1] + np.sign(np.linalg.det(c)) * s[:, 2]) / s[:, 0]
    error = np.abs(got - expected).max((1, 2))
    assert np.all(error < 1e-13 + 100 * np.finfo(float).eps / gap)
    np.testing.assert_allclose(np.linalg.det(got), 1.0, rtol=0, atol=1e-13)


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
def test_weights_mean_what_they_say(seed, d):
    """Weight 0 is absence, an integer weight is a repeated point, a common factor is nothing."""
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
def test_chunks_leave_no_seam(count):
    """A row's answer does not depend on how many rows stand beside it."""
    q = random_rotations(count)
    np.testing.assert_allclose(kabsch(turned(TETRA, q), TETRA), q, rtol=0, atol=1e-14)


def test_the_inputs_are_left_alone():
    """Neither set is written to, with NaN rows or without, and lists of integers will do."""
    y = turned(TETRA, random_rotations(3))
    y[1, 2] = np.nan
    before, reference = y.copy(), TETRA.copy()
    kabsch(y, reference, weights=[1, 1, 1, 1])
    np.testing.assert_array_equal(y, before)
    np.testing.assert_array_equal(reference, TETRA)
    corner = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    np.testing.assert_allclose(kabsch(corner, corner), np.eye(3), atol=1e-15)


# ---- kabsch: refusals ---------------------------------------------------------------------------

HOPELESS = {
    "collinear": (LINE, LINE),
    "collinear points only": (LINE, IRREGULAR[:4]),
    "collinear reference only": (IRREGULAR[:4], LINE),
    "coincident": (np.full((4, 3), 0.3), TETRA),
    "coincident trimer": (np.full((3, 3), 0.3), TRIMER),
    "exactly mirrored tetrahedron": (TETRA @ MIRROR, TETRA),
    "two places": (TETRA[[0, 0, 1, 1]], TETRA[[0, 0, 1, 1]]),
}


@pytest.mark.parametrize("offset", [0.0, 1.0, 1e3, 1e6])
@pytest.mark.parametrize("name", HOPELESS)
def test_rows_without_a_unique_answer_are_named(name, offset):
    """Exactly the rows without one answer are in `indices`, near the origin and far from it."""
    points, reference = HOPELESS[name]
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


def test_not_one_of_many_hopeless_rows_slips_through():
    """Of 20 000 degenerate rows at random places, weighted or not, none gets a rotation."""
    rng = np.random.default_rng(18)
    q = random_rotations(5000)
    far = 1e6 * rng.normal(size=(5000, 1, 3))
    for name, (points, reference) in HOPELESS.items():
        same = rng.uniform(0.1, 3, size=(5000, len(points)))
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
def test_what_does_not_fit_is_a_value_error(points, reference, weights):
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


def test_three_times_faster_than_batched_svd():
    """Whole kabsch takes under a third of the bare SVDs, which get their matrices ready-made."""
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
    """log(exp(v)) = v to a few eps relative to the angle, from nothing to nearly half a turn."""
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
