"""Which detection is which particle, part by part: likelihoods, limits and shapes by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_t

import perrin
import perrin.tracks.identity as identity
from perrin.geometry.rotations import exp_map
from perrin.tracks.identity import (
    BodyModel,
    Detections,
    Pose,
    all_assignments,
    assigned_points,
    best_assignments,
    body_size,
    candidate_assignments,
    certain_labels,
    covering_rotations,
    icp_fit,
    icp_search,
    labels_in_time,
    rigid_fits,
    settle_each,
    settle_identity,
    shape_symmetry,
    squared_angle,
)

NONE = np.nan
TETRAHEDRON = perrin.Cluster.tetrahedron(2.0).positions
CUBE = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1], indexing="ij"), float).reshape(3, 8).T
SEVEN = np.random.default_rng(2).normal(size=(7, 3))  # no symmetry
# The median of chi squared with 6 degrees of freedom, as the module approximates it.
MEDIAN_6 = 6 * (1 - 2 / 54) ** 3
# Expansions whose median squared size makes the noise: the squared residual is size^2 |shape|^2.
FACTORS = 0.001 * np.array([1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1])


def track_of(body, turns, *, factors=0.0):
    """Return positions (T, n, d) of a body that turns by vectors and expands by factors."""
    turned = body @ np.swapaxes(exp_map(np.asarray(turns, float)), -1, -2)
    return turned * (1 + np.reshape(factors, (-1, 1, 1)))


def settled(found):
    """Return the numbers of events of each kind."""
    return [found.swaps.size, found.cuts.size, found.extra.size, found.unsettled.size]


# ---- detections and shapes ----------------------------------------------------------------------


def test_detections_are_moved_to_the_left_and_keep_their_columns():
    """Rows with fewer, as many and more points than particles; the rest is NaN and -1."""
    x = np.array([[[1.0], [NONE], [3.0]], [[NONE], [5.0], [NONE]], [[7.0], [8.0], [9.0]]])
    two, four = Detections.of(x, 2), Detections.of(x, 4)
    assert two.column.tolist() == [[0, 2, -1], [1, -1, -1], [0, 1, 2]]
    np.testing.assert_array_equal(two.x[..., 0], [[1, 3, NONE], [5, NONE, NONE], [7, 8, 9]])
    assert (two.shown.tolist(), two.n) == ([2, 1, 3], 2)
    assert four.column.tolist() == [[0, 2, -1, -1], [1, -1, -1, -1], [0, 1, 2, -1]]
    assert np.isnan(four.x[:, 3]).all()
    # Column 0 is particle 1, column 2 particle 0, column 1 is unknown.
    label = np.array([1, -1, 0])
    assert two.assignment(label).tolist() == [[1, 0], [-1, -1], [2, 0]]
    assert four.assignment(label).tolist() == [[1, 0, -1, -1], [-1] * 4, [2, 0, -1, -1]]


def test_the_size_of_a_body_is_that_of_its_fullest_rows():
    """Columns of over 5 % of the rows that occur together; else the fullest 5 % of the rows."""
    seen = np.zeros((100, 4), dtype=bool)
    seen[:, :2] = True
    seen[:6, 2] = True
    assert body_size(seen) == 3
    seen[5, 2] = False  # exactly 5 % of the rows
    assert body_size(seen) == 2
    # Columns 0 and 3 never occur together, and 2 to 4 points are in a row.
    seen[:] = False
    seen[:50, 0], seen[50:, 3] = True, True
    seen[:, 1], seen[40:60, 2] = True, True
    assert body_size(seen) == 3
    seen[44:60, 2] = False  # in 4 of 100 rows only
    assert body_size(seen) == 2
    seen[44, 2] = True
    assert body_size(seen) == 3
    assert body_size(np.zeros((3, 2), dtype=bool)) == 0
    # Of 60 rows 40 have points: two of them are 5 %.
    seen = np.zeros((60, 3), dtype=bool)
    seen[:20, 0] = seen[20:40, 1] = seen[:2, 2] = True
    assert body_size(seen) == 2
    seen[1, 2] = False
    assert body_size(seen) == 1


def test_fits_are_those_of_proper_rotations_about_the_points_present():
    """The misfit of an expansion is its square, of a line unknown; absent points do not count."""
    turn = exp_map(np.array([0.3, -1.0, 2.0]))
    x = 5 + 1.01 * TETRAHEDRON @ turn.T
    rotation, misfit = rigid_fits(x, TETRAHEDRON)
    np.testing.assert_allclose(rotation, turn, atol=1e-12)
    assert misfit == pytest.approx(1e-4 * (TETRAHEDRON**2).sum())
    lost = x.copy()
    lost[2] = NONE
    rest = np.delete(TETRAHEDRON, 2, axis=0)
    rotation, misfit = rigid_fits(lost, TETRAHEDRON)
    np.testing.assert_allclose(rotation, turn, atol=1e-12)
    assert misfit == pytest.approx(1e-4 * ((rest - rest.mean(axis=0)) ** 2).sum())
    lost[1] = NONE
    assert rigid_fits(lost, TETRAHEDRON)[1] == np.inf
    assert rigid_fits(np.full((4, 3), NONE), TETRAHEDRON)[1] == np.inf
    mirrored = x * [1, 1, -1]
    assert rigid_fits(mirrored, TETRAHEDRON)[1] > 1


@pytest.mark.parametrize("body", [TETRAHEDRON, CUBE[[0, 1, 2, 4, 7]], SEVEN])
def test_the_order_of_least_misfit_is_that_which_was_planted(body):
    """Of up to 6 particles by all orders, of more by closest points; one order per symmetry."""
    rng = np.random.default_rng(3)
    order = np.array([rng.permutation(len(body)) for _ in range(4)])
    turns = Rotation.random(4, random_state=4).as_matrix()
    noise = 0.01 * rng.normal(size=(4, len(body), 3))
    x = np.stack([b[o] @ t.T + 9 for b, o, t in zip(body + noise, order, turns, strict=True)])
    symmetry = np.arange(7)[None] if len(body) == 7 else shape_symmetry(body, 1e-4)
    for given in (symmetry,) if len(body) == 7 else (None, symmetry):
        found, misfit = best_assignments(x, body, symmetry=given)
        inverse = np.argsort(order, axis=1)
        for own, planted in zip(found, inverse, strict=True):
            assert own.tolist() in planted[symmetry].tolist()
        again = rigid_fits(np.take_along_axis(x, found[..., None], axis=1), body)[1]
        np.testing.assert_allclose(misfit, again, rtol=1e-9)
        assert misfit.max() < 0.02
    assert symmetry[0].tolist() == list(range(len(body)))


def test_symmetries_are_those_of_the_shape_within_noise():
    """12 of a tetrahedron, 24 of cube and octahedron, 4 of a square; noise hides differences."""
    assert len(shape_symmetry(TETRAHEDRON, 1e-8)) == 12
    assert len(shape_symmetry(CUBE, 1e-8)) == 24
    octahedron = np.concatenate([np.eye(3), -np.eye(3)])
    assert len(shape_symmetry(octahedron, 1e-8)) == 24
    # One axis is longer by 0.06: a quarter turn about another moves four particles by that.
    misfit, limit = 4 * 0.06**2, 2 * 16 * 12
    for factor, number in ((0.95, 8), (1.05, 24)):
        assert len(shape_symmetry(octahedron * [1, 1, 1.06], misfit / limit * factor)) == number
    square = np.array([[1.0, 1], [-1, 1], [-1, -1], [1, -1]])
    assert len(shape_symmetry(square, 1e-8)) == 4


def test_rotations_cover_the_sphere_of_rotations():
    """Within 31 degrees of any rotation in space, 6 in the plane; all of them proper."""
    turns = covering_rotations(3)
    np.testing.assert_allclose(turns @ np.swapaxes(turns, 1, 2), [np.eye(3)] * 300, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(turns), 1)
    some = Rotation.random(300, random_state=1)
    cosine = (np.einsum("aij,bij->ab", some.as_matrix(), turns) - 1) / 2
    away = np.arccos(cosine.max(axis=1))
    assert np.rad2deg(away.max()) < 31
    assert 12 < np.rad2deg(np.mean(away)) < 19
    plane = covering_rotations(2)
    angle = np.arctan2(plane[:, 1, 0], plane[:, 0, 0])
    np.testing.assert_allclose(np.diff(np.unwrap(angle)), np.deg2rad(12))
    np.testing.assert_allclose(plane @ np.swapaxes(plane, 1, 2), [np.eye(2)] * 30, atol=1e-12)
    angles = np.array([0.0, 1e-3, 1.0, 3.0, np.pi])
    turned = exp_map(angles[:, None] * [0, 0.6, 0.8])
    np.testing.assert_allclose(squared_angle(turned, np.eye(3)), angles**2, atol=1e-12)


def test_closest_points_converge_from_a_rotation_nearby(monkeypatch):
    """A turn of 20 degrees is found; the search finds any; points on a line have no rotation."""
    turn = exp_map(np.deg2rad([12.0, -12.0, 10.0]))
    body = CUBE * [1, 2, 3]
    x = (body @ turn.T)[::-1] + 4
    order, found, misfit = icp_fit(x, body, np.eye(3))
    assert order.tolist() == list(range(7, -1, -1))
    np.testing.assert_allclose(found, turn, atol=1e-12)
    assert misfit < 1e-20
    far = body @ exp_map(np.array([0.0, 0.0, 1.4])).T
    found, misfit = icp_search(np.stack([x, far]), body)
    assert misfit.max() < 1e-20
    # A close fit ends the search, and the next row begins at its rotation.
    fits = []
    monkeypatch.setattr(identity, "icp_fit", lambda *a: fits.append(1) or icp_fit(*a))
    # So it does in nanometres, with noise of a hundredth of the least distance.
    noise = 0.02 * np.random.default_rng(1).normal(size=x.shape)
    x, far, body = (1e3 * one for one in (x + noise, far + noise, body))
    icp_search(np.stack([x, far, far, far]), body)
    first = len(fits)
    icp_search(np.stack([x, far]), body)
    assert (first, len(fits) - first) == (first, first - 2)
    assert first <= 60 + 3
    line = np.arange(4.0)[:, None] * np.ones(3)
    assert icp_fit(line, line, np.eye(3))[2] == np.inf


def test_the_shape_is_the_mean_of_the_rows_and_its_noise_their_median_misfit():
    """Expansions by 0.1 % cancel in the mean; the variance is the median misfit over its law's."""
    x = track_of(TETRAHEDRON, 0.1 * np.ones((12, 3)) * np.arange(12)[:, None], factors=FACTORS)
    body = BodyModel.averaged(x + 3, TETRAHEDRON, np.arange(4))
    np.testing.assert_allclose(body.template, TETRAHEDRON, atol=1e-9)
    own = 1e-6 * (TETRAHEDRON**2).sum() / MEDIAN_6
    assert body.sigma2 == pytest.approx(own, rel=1e-6)
    assert len(body.symmetry) == 12
    exact = BodyModel.averaged(x[:1] * 0 + TETRAHEDRON, TETRAHEDRON, np.arange(4))
    assert exact.sigma2 == pytest.approx((1e-7 * np.abs(TETRAHEDRON).max()) ** 2)
    # 16 times the usual misfit is noise-like: 3 n - 6 degrees of freedom.
    np.testing.assert_allclose(body.misfit_limit(np.array([3, 4])), 16 * own * np.array([3, 6]))


def test_the_cost_of_a_misfit_is_that_of_a_students_law():
    """8 degrees of freedom, in as many dimensions as the fit has; a stray one is anywhere near."""
    body = BodyModel(1.3 * TETRAHEDRON, 0.04, np.arange(4)[None], np.arange(4))
    extent = 2 * np.linalg.norm(body.template, axis=1).max()
    used, shown = np.array([[4, 3, 3]]), np.array([4])
    misfit = np.array([[0.3, 0.2, 0.0]])
    cost = body.misfit_cost(misfit, used, shown)[0]
    for k, (f, strays) in enumerate([(6, 0), (3, 1), (3, 1)]):
        law = multivariate_t(np.zeros(f), 0.04 * np.eye(f), df=8)
        at = np.append(np.sqrt(misfit[0, k]), np.zeros(f - 1))
        assert cost[k] == pytest.approx(-law.logpdf(at) + 3 * strays * np.log(extent), rel=1e-9)


# ---- labels that are certain --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("body", "lost", "least"),
    [
        (TETRAHEDRON, [], 120.0),
        (TETRAHEDRON, [3], 70.5287794),  # three of four: a face, from either side
        (CUBE, [], 90.0),
        (CUBE[[0, 3, 5, 6, 7]], [], 120.0),
        (np.array([[1.0, 0], [-1.0, 0]]), [], 180.0),
        (np.array([[0.0, 0], [2.0, 0], [0, 1.0]]), [], 180.0),  # no symmetry
    ],
    ids=["tetrahedron", "face", "cube", "axis", "pair", "none"],
)
def test_labels_are_certain_up_to_two_fifths_of_the_least_angle_between_assignments(
    body, lost, least
):
    """A step slightly shorter is certain, slightly longer is not; noise does not matter."""
    d = body.shape[1]
    tracks = []
    for share in (0.97, 1.03):
        a = np.zeros(12)
        a[6:] = np.deg2rad(share * 0.4 * least)
        c, s, zero = np.cos(a), np.sin(a), np.zeros(12)
        turns = np.array([[c, -s, zero], [s, c, zero], [zero, zero, zero + 1]])[:d, :d]
        x = np.einsum("ijt,nj->tni", turns, body)
        x[6, lost] = NONE
        x += 1e-6 * np.random.default_rng(0).normal(size=x.shape)
        # A frame without a pose in between does not hide the step.
        x = np.insert(x, 6, np.nan, axis=0)
        x[6, 0] = 0.0
        tracks.append(x)
    assert certain_labels(np.stack(tracks)).tolist() == [True, False]


def test_labels_are_certain_where_every_frame_fits_as_well_as_noise_allows():
    """The squared residual may be 16 times the usual mean square, 96/5.36 times the median."""
    # The shape is the mean of all rows: a strain of the first one, which is at right angles to the
    # expansions, is a tenth in it. Of ten squares the median is the mean of the fifth and sixth.
    strain = TETRAHEDRON * [1.0, -1.0, 0.0] * 1e-3 * np.sqrt(1.5)
    most = np.sqrt(16 * 6 / MEDIAN_6 * ((1.05**2 + 1.1**2) / 2 + 0.01) - 0.01)
    tracks = []
    for factor in (0.99, 1.01):
        one = factor * most
        factors = np.array([0, 1, -1, 1.05, -1.05, 1.1, -1.1, one, -one / 2, -one / 2])
        x = track_of(TETRAHEDRON, np.zeros((10, 3)), factors=1e-3 * factors)
        x[0] += strain
        tracks.append(x)
    assert certain_labels(np.stack(tracks)).tolist() == [True, False]
    # In the full search such a frame keeps its labels, but is not settled.
    for x, unsettled in zip(tracks, ([], [7]), strict=True):
        found = settle_identity(x)
        assert found.unsettled.tolist() == unsettled
        assert settled(found)[:3] == [0, 0, 0]
    lasting = tracks[0].copy()
    lasting[::2] = lasting[::2, [1, 0, 2, 3]]  # two labellings that share the time
    assert not certain_labels(lasting[None])[0]
    # One complete frame makes no shape, and a particle that never occurs is not known.
    once, never = np.stack([tracks[0][:7]] * 2)
    once[1:, 3], never[:, 3] = NONE, NONE
    assert certain_labels(np.stack([once, never])).tolist() == [False, False]
    twice = tracks[0][:7].copy()
    twice[2:, 3] = NONE
    assert certain_labels(np.stack([twice, tracks[0][:7]])).tolist() == [True, True]
    assert certain_labels(np.zeros((1, 12, 2, 3))).tolist() == [False]
    # Without noise rounding errors are no noise.
    turns = 0.1 * np.arange(9)[:, None] // 0.3 * [0.6, 0, 0.8]
    assert certain_labels(track_of(TETRAHEDRON, 0.3 * turns)[None]).tolist() == [True]


def test_all_complete_frames_must_resemble_the_first():
    """By 32 times the lower tenth of the misfits to it: of 11 frames the second least, 0.6^2."""
    for rows, share, expected in ((11, 0.99, True), (11, 1.01, False), (10, 0.99, False)):
        one = share * np.sqrt(32) * 0.6
        factors = 1e-3 * np.array([0, 0.1, 0.6, one, *5 * [-1.2], 0.9, 0.9])[:rows]
        x = track_of(TETRAHEDRON, np.zeros((rows, 3)), factors=factors)
        assert certain_labels(x[None]).tolist() == [expected]


@pytest.mark.filterwarnings("ignore::perrin.IdentityWarning")
def test_bodies_together_are_settled_as_each_of_them_alone():
    """Right and exchanged labels, gaps, other lengths and sizes, an id that is continued."""
    rng = np.random.default_rng(5)
    turns = np.cumsum(rng.normal(scale=0.1, size=(40, 3)), axis=0)
    x = track_of(TETRAHEDRON, np.zeros((40, 3))) @ np.swapaxes(exp_map(turns), 1, 2)
    x += 0.01 * rng.normal(size=x.shape)
    exchanged, lost, continued = x.copy(), x.copy(), np.full((40, 5, 3), NONE)
    exchanged[20:, [0, 1]] = x[20:, [1, 0]]
    lost[5, 2] = lost[10] = NONE
    continued[:, :4] = x
    continued[20:, 4], continued[20:, 1] = x[20:, 1], NONE
    bodies = [x, exchanged, lost, x[:30], continued, x[:, :3], x, lost]
    times = [None, None, 2.0 * np.arange(40), None, None, None, np.arange(40.0), None]
    together = settle_each(bodies, times=times)
    for body, time, found in zip(bodies, times, together, strict=True):
        alone = settle_identity(body, times=time)
        for name, value in vars(alone).items():
            np.testing.assert_array_equal(getattr(found, name), value)
    assert [one.swaps.tolist() for one in together] == [[], [20], *[[]] * 6]
    assert together[4].order[30].tolist() == [0, 4, 2, 3]
    assert together[0].arranged(x) is x
    arranged = together[1].arranged(exchanged)
    own = together[1].order[0]
    np.testing.assert_array_equal(arranged, x[:, own])


# ---- candidates and steps -----------------------------------------------------------------------


def model_of(x, *, labelled=True):
    """Return the detections of a body of four, its model and its candidates."""
    detections = Detections.of(x, 4)
    body = BodyModel.of_row(detections, 0, labelled=labelled)
    return detections, body, candidate_assignments(detections, body, labelled=labelled)


@pytest.mark.parametrize("labelled", [True, False])
def test_the_variance_of_steps_is_that_of_their_median_angle(labelled):
    """Median squared angle over that of chi squared, longer over gaps; of free labels the least."""
    angles = np.array([0.1, 0.2, 0.3, 0.25, 0.15, 0.12, 0.22])
    turns = np.append(0, np.cumsum(angles))[:, None] * [0.6, 0, 0.8]
    x = track_of(TETRAHEDRON, turns) + 1e-6 * np.random.default_rng(1).normal(size=(8, 4, 3))
    if not labelled:
        rng = np.random.default_rng(2)
        x = np.stack([row[rng.permutation(4)] for row in x])
    detections, _, candidates = model_of(x, labelled=labelled)
    median_3 = 3 * (1 - 2 / 27) ** 3
    for time, factor in (
        (np.arange(8.0), np.ones(7)),
        (5 * np.array([0, 1, 2, 3, 7, 8, 9, 9.5]), np.array([1, 1, 1, 4, 1, 1, 1])),
    ):
        found = candidates.step_variance(detections, time, np.arange(8), labelled=labelled)
        np.testing.assert_allclose(found, 0.2**2 / median_3 * factor, rtol=1e-4)
    one = candidates.step_variance(detections, np.zeros(1), np.zeros(1, int), labelled=labelled)
    assert one.size == 0
    still = model_of(np.stack([TETRAHEDRON] * 3))[2]
    rest = still.step_variance(detections, np.arange(3.0), np.arange(3), labelled=labelled)
    if not labelled:
        np.testing.assert_allclose(rest, 1e-12, rtol=1e-6)


def test_the_cost_of_a_step_is_its_angle_over_its_variance():
    """The likelier of two poses counts; a leap is judged by its own size."""
    detections, body, candidates = model_of(track_of(TETRAHEDRON, [[0, 0, 0], [0, 0, 0.3]]))
    axis = TETRAHEDRON[0] / np.linalg.norm(TETRAHEDRON[0])
    own = np.isfinite(candidates.cost[1])
    rotation = candidates.rotation[1]
    near, far = Pose(np.eye(3), 0.02), Pose(exp_map(1.0 * axis), 5.0)
    square_near = Rotation.from_matrix(rotation[own]).magnitude() ** 2
    turned = Rotation.from_matrix(far.rotation).inv() * Rotation.from_matrix(rotation[own])
    square_far = turned.magnitude() ** 2
    least = min(square_near)
    assert least == pytest.approx(0.3**2)
    for labelled, share in ((True, 4.0), (False, 16.0)):
        wide = max(0.02, least / share)
        assert (wide > 0.02) == labelled
        found = candidates.step_cost([near], 1, labelled=labelled)
        np.testing.assert_allclose(found[own] - candidates.cost[1][own], square_near / (2 * wide))
        both = candidates.step_cost([near, far], 1, labelled=labelled)
        expected = np.minimum(square_near / (2 * wide), square_far / (2 * 5.0))
        np.testing.assert_allclose(both[own] - candidates.cost[1][own], expected, rtol=1e-6)
    assert np.isinf(candidates.step_cost([near], 1, labelled=True)[~own]).all()
    # 12 turns of the body onto itself and the place that is kept free.
    assert own.sum() == 12
    assert len(own) == 13
    assert candidates.given.tolist() == [0, 1]
    # A labelling that is no candidate is put into that place, with its misfit.
    mirror = np.array([1, 0, 2, 3])
    candidates.include(detections, body, 1, mirror)
    assert candidates.assignment[1, -1].tolist() == [1, 0, 2, 3]
    expected = rigid_fits(detections.x[1][mirror], body.template)
    np.testing.assert_allclose(candidates.rotation[1, -1], expected[0])
    cost = body.misfit_cost(expected[1].reshape(1, 1), np.array([[4]]), np.array([4]))
    assert candidates.cost[1, -1] == pytest.approx(cost[0, 0])
    assert not candidates.fits[1, -1]
    assert np.isinf(candidates.cost[0, -1])
    before = candidates.assignment[1].copy()
    candidates.include(detections, body, 1, np.array([1, 2, 0, 3]))  # it is one already
    candidates.include(detections, body, 1, np.array([0, 1, 2, -1]))  # one point is not placed
    np.testing.assert_array_equal(candidates.assignment[1], before)


def test_detections_left_out_are_candidates_unless_near_a_free_particle():
    """A stray point half a distance from the empty place is none: the least distance decides."""
    for shift, strays in ((0.98, 0), (1.02, 1)):
        x = np.stack([TETRAHEDRON] * 30)
        x += 1e-4 * np.random.default_rng(1).normal(size=x.shape)
        outward = TETRAHEDRON[0] / np.linalg.norm(TETRAHEDRON[0])
        x[20, 0] += shift * np.sqrt(8 / 3) * outward  # half the distance of two particles
        found = settle_identity(x)
        assert found.extra.tolist() == [20][:strays]
        assert found.order[20].tolist() == [-1 if strays else 0, 1, 2, 3]
        assert found.unsettled.tolist() == [20][strays:]


@pytest.mark.filterwarnings("ignore::perrin.IdentityWarning")
def test_rows_without_a_pose_keep_the_labels_that_held():
    """Those of the rows before, at the beginning those of the rows after; others stay unknown."""
    x = track_of(TETRAHEDRON, 0.02 * np.arange(30)[:, None] * [0.6, 0, 0.8])
    x = np.concatenate([x, np.full((30, 1, 3), NONE)], axis=1)
    x += 0.001 * np.random.default_rng(1).normal(size=x.shape)
    x[10:, :2] = x[10:, 1::-1]
    x[0, [1, 3]] = x[5] = x[20, [0, 3]] = NONE
    x[20, 4] = 50.0
    found = settle_identity(x)
    assert found.swaps.tolist() == [10]
    assert found.order[[0, 5, 20]].tolist() == [[0, -1, 2, -1], [-1] * 4, [1, -1, 2, -1]]
    assert found.order[[1, 19, 21]].tolist() == [[0, 1, 2, 3], *[[1, 0, 2, 3]] * 2]
    assert found.unsettled.tolist() == [20]


@pytest.mark.filterwarnings("ignore::perrin.IdentityWarning")
def test_an_exchange_in_an_incomplete_row_of_a_large_body_is_found():
    """Its points are compared to the body where the particles present say it is."""
    x = track_of(SEVEN, 0.02 * np.arange(8)[:, None] * [0.6, 0, 0.8])
    x += 0.001 * np.random.default_rng(1).normal(size=x.shape)
    x[6, [0, 2]] = x[6, [2, 0]]
    x[6, 5:] = NONE
    found = settle_identity(x)
    assert found.order[6].tolist() == [2, 1, 0, 3, 4, -1, -1]
    assert settled(found) == [2, 0, 0, 0]


def test_labels_outweigh_a_shorter_turn_where_a_particle_is_missing():
    """A leap of 75 degrees leaves 45 to another labelling; the labels of three particles stay."""
    turns = np.deg2rad(75) * (np.arange(40)[:, None] >= 20) * TETRAHEDRON[0]
    x = track_of(TETRAHEDRON, turns / np.linalg.norm(TETRAHEDRON[0]))
    x += 0.01 * np.random.default_rng(2).normal(size=x.shape)
    x[20, 2] = NONE
    found = settle_identity(x)
    assert settled(found) == [0, 0, 0, 0]
    assert found.order[20].tolist() == [0, 1, -1, 3]


def test_a_lasting_label_outweighs_a_displaced_particle():
    """Left out it would be e^11 times likelier, and without a label it is; e^18 are needed."""
    rng = np.random.default_rng(3)
    x = np.stack([TETRAHEDRON] * 40) + 0.1 * rng.normal(size=(40, 4, 3))
    x[20, 0] = TETRAHEDRON[0] * (1 + 0.85)
    found = settle_identity(x)
    assert settled(found) == [0, 0, 0, 1]
    free = settle_identity(x, labelled=False)
    assert free.extra.tolist() == [20]


def test_labels_of_the_last_row_in_which_a_column_was_a_particle():
    """A column keeps its label through rows in which it is none."""
    order = np.array([[-1, 2, -1], [0, -1, 2], [-1, -1, -1], [2, 0, -1]])
    assert labels_in_time(order).tolist() == [[-1, -1, 1], [0, -1, 2], [0, -1, 2], [1, -1, 0]]
    assert labels_in_time(np.full((2, 3), -1)).tolist() == [[-1], [-1]]


def test_all_orders_are_listed_once():
    """Three of four detections to three of five particles: 10 times 24."""
    table = all_assignments(4, 5, 3)
    assert len(np.unique(table, axis=0)) == len(table) == 240
    assert ((table >= 0).sum(axis=1) == 3).all()
    for row in table:
        assert len(set(row[row >= 0].tolist())) == 3
    points = np.arange(8.0).reshape(2, 2, 2)
    one = assigned_points(points, np.array([[[1, -1]], [[-1, 0]]]))
    np.testing.assert_array_equal(one, [[[[2, 3], [NONE] * 2]], [[[NONE] * 2, [4, 5]]]])
