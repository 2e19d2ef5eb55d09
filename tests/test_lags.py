"""Frames on grids, pairs and their errors, part by part: direct sums and small known cases."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import perrin.curves.pairs as pairs_module
from brownian_motions import flat, rod, tetrahedron, with_poses
from perrin import Cluster, PrecisionWarning, TooFewFramesError, msad, msad_axes, msad_vector, msd
from perrin.curves import (
    ListedPairs,
    Products,
    Squares,
    axes_weighted_equally,
    axis_ratio,
    body_directions,
    common_frames,
    displacement_counts,
    drift_corrected,
    fft_size,
    gapped_squares,
    grid_step,
    independent_walks,
    lag_bins,
    lag_covariance,
    mean_velocity,
    pair_sums,
    pairs_apart,
    place_frames,
    relative_error,
    squared_shared_times,
    two_lag_fit,
)
from perrin.geometry.rotations import cumulative_product, exp_map

DT = 0.5


def frames_of(numbers, *, piece=None, here=None, dt=DT):
    """Return the frames with these numbers (times over dt), in one piece or several."""
    numbers = np.asarray(numbers, dtype=float)
    piece = np.zeros(len(numbers), dtype=int) if piece is None else np.array(piece)
    here = np.ones(len(numbers), dtype=bool) if here is None else np.array(here)
    return place_frames(dt * numbers, piece, here, dt=dt)


def blocks_of(frames):
    """Return block and place on the grid of every frame."""
    return frames.block.tolist(), frames.slot.tolist()


# ---- grids --------------------------------------------------------------------------------------


def test_frames_at_whole_numbers_of_steps_have_one_grid():
    """Without a gap, with gaps, with a stride, and from any first frame."""
    whole = frames_of(7 + np.arange(5))
    assert blocks_of(whole) == ([0] * 5, [0, 1, 2, 3, 4])
    assert (whole.step, whole.exact, whole.separate) == (DT, True, True)
    assert (whole.row.tolist(), whole.blocks) == ([0, 1, 2, 3, 4], [slice(0, 5)])
    assert (whole.lengths.tolist(), whole.most_lags) == ([4], 8 * 5 + 64)
    gaps = frames_of([3, 4, 6, 11], here=[True, True, False, True])
    assert blocks_of(gaps) == ([0, 0, 0], [0, 1, 8])
    assert (gaps.row.tolist(), gaps.step, gaps.time.tolist()) == ([0, 1, 3], DT, [1.5, 2, 5.5])
    stride = frames_of([10, 16, 22, 34])
    assert blocks_of(stride) == ([0] * 4, [0, 1, 2, 4])
    assert (stride.step, stride.exact) == (6 * DT, True)
    # A thousandth of a step is rounding, more is another time.
    for off, exact in ((0.9e-3, True), (1.1e-3, False)):
        assert frames_of([0, 1 + off, 2]).exact == exact
        assert frames_of([0, 1 - off, 2]).exact == exact
        assert frames_of([0, 1, 3 + off, 4]).exact == exact
    assert frames_of([0, 1], here=[True, True]).lengths.tolist() == [1]
    with pytest.raises(TooFewFramesError) as caught:
        frames_of([0, 1], here=[True, False])
    assert caught.value.n_frames == 1
    # The times of a track without gaps are not copied.
    time, piece = DT * np.arange(4.0), np.zeros(4, dtype=int)
    assert np.shares_memory(place_frames(time, piece, piece == 0, dt=DT).time, time)


def test_pieces_have_grids_of_their_own():
    """They are sorted; one stride serves all of them; a piece of one frame is a block."""
    two = frames_of([0, 1, 2, 5.5, 6.5], piece=[0, 0, 0, 1, 1])
    assert blocks_of(two) == ([0, 0, 0, 1, 1], [0, 1, 2, 0, 1])
    assert (two.exact, two.separate, two.lengths.tolist()) == (True, True, [2, 1])
    assert two.blocks == [slice(0, 3), slice(3, 5)]
    mixed = frames_of([0, 2, 4, 6, 8, 10], piece=[1, 0, 1, 0, 1, 0])
    assert mixed.row.tolist() == [1, 3, 5, 0, 2, 4]
    assert blocks_of(mixed) == ([0, 0, 0, 1, 1, 1], [0, 1, 2, 0, 1, 2])
    assert mixed.step == 4 * DT
    alone = frames_of([0, 3, 9], piece=[0, 1, 2])
    assert blocks_of(alone) == ([0, 1, 2], [0, 0, 0])
    assert alone.step == DT
    # Evenly spaced in time, but the middle belongs to another piece.
    between = frames_of([0, 1, 2, 3], piece=[0, 1, 1, 0])
    assert blocks_of(between) == ([0, 0, 1, 1], [0, 3, 0, 1])
    assert between.row.tolist() == [0, 3, 1, 2]


def test_a_frame_off_the_grid_begins_a_block():
    """By more than a tenth of a step, from the last frame that began one."""
    frames = frames_of([0, 1, 2.05, 3.25, 4.2, 5.2])
    assert blocks_of(frames) == ([0, 0, 0, 1, 1, 1], [0, 1, 2, 0, 1, 2])
    assert (frames.exact, frames.separate) == (False, False)
    assert frames.step == pytest.approx(DT)
    for off, block in ((0.097, 0), (0.103, 1)):
        for sign in (1, -1):
            late = frames_of([0, 1, 2, 3, 4 + sign * off, 5, 6, 7, 8, 9, 10, 11, 12])
            assert late.block[4] == block
    again = frames_of([0, 1, 1.02, 2])
    assert again.block.tolist() == [0, 0, 1, 1]


def test_long_holes_are_cut_where_a_grid_would_be_mostly_empty():
    """At more than 8 places a frame and 64 more, holes of more than 8 steps."""
    for last, block in ((8 * 20 + 64, 0), (8 * 20 + 65, 1)):
        assert frames_of([*range(10), *range(last - 9, last + 1)]).block[-1] == block
    frames = frames_of([*range(10), 17, 26, 1000])
    assert blocks_of(frames) == ([0] * 11 + [1, 2], [*range(10), 17, 0, 0])
    assert (frames.separate, frames.exact) == (False, True)
    assert not frames_of([*range(10), 1000]).separate
    # Only the piece that is mostly empty is cut.
    both = frames_of([0, 1, 20, 0, 1, 1000], piece=[0] * 3 + [1] * 3)
    assert both.block.tolist() == [0, 0, 0, 1, 1, 2]


def test_the_step_of_a_grid_is_that_on_which_most_times_lie():
    """The stated one, its multiple, or the median; the stated one where there is none."""
    assert grid_step(np.array([2.0, 4.0, 2.0]), 1.0) == 2.0
    assert grid_step(np.array([1.0, 1.0, 1.0, 2.0]), 0.7) == 1.0
    assert grid_step(np.array([1.0, 1.02, 1.5, 1.5]), 1.0) == pytest.approx(1.01)
    assert grid_step(np.array([0.05, 0.05, 0.05, 1.0]), 1.0) == pytest.approx(0.05)
    assert grid_step(np.array([1.3, 2.7, 3.6, 5.4, 7.55]), 1.0) == 1.0
    assert grid_step(np.array([1.09, 1.3]), 1.0) == pytest.approx(1.09)
    assert grid_step(np.array([1.11, 1.4, 1.9]), 1.0) == 1.0
    assert grid_step(np.zeros(0), 0.3) == 0.3


def test_sizes_of_transforms_are_the_least_products_of_2_3_and_5():
    """Of all numbers up to 400."""
    smooth = [2**a * 3**b * 5**c for a in range(10) for b in range(7) for c in range(5)]
    for least in range(1, 401):
        assert fft_size(least) == min(k for k in smooth if k >= least)


# ---- pairs --------------------------------------------------------------------------------------


def direct(frames, walk, longest):
    """Return bin, number, mean lag and mean square of all pairs of one piece, one by one."""
    lags, squares = {}, {}
    for i in range(len(frames.row)):
        for j in range(len(frames.row)):
            if frames.piece[i] == frames.piece[j] and frames.time[j] > frames.time[i]:
                lag = (frames.time[j] - frames.time[i]) / frames.step
                n = round(lag)
                name = 2 * n if abs(lag - n) <= 0.1 and n >= 1 else 2 * int(lag) + 1
                if name <= longest:
                    lags.setdefault(name, []).append(lag * frames.step)
                    step = walk[frames.row[j]] - walk[frames.row[i]]
                    squares.setdefault(name, []).append((step**2).sum(axis=0))
    names = sorted(lags)
    return [
        np.array([f(d[k]) for k in names])
        for f, d in ((len, lags), (np.mean, lags), (lambda v: np.sum(v, axis=0), squares))
    ]


UNEVEN = {
    "exact": ([0, 1, 3, 4, 7, 8], None),
    "nearly": ([0, 1.04, 2, 2.98, 5.03, 6], None),
    "nearly, two": ([0, 1.04, 2, 2.98, 0, 1, 1.97, 3.02], [0] * 4 + [1] * 4),
    "off": ([0, 1, 2.05, 3.25, 4.2, 5.2], None),
    "off, two": ([0, 1, 2.05, 3.25, 4.2, 5.2, 9, 9.5, 10.5], [0] * 6 + [1] * 3),
    "hole": ([*range(6), *range(300, 306)], None),
}


@pytest.mark.parametrize("name", UNEVEN)
@pytest.mark.parametrize("most", [None, 2])
def test_sums_over_pairs_are_those_one_by_one(name, most):
    """Number, mean time and sum of squares of every lag, up to all or to two steps."""
    numbers, piece = UNEVEN[name]
    frames = frames_of(numbers, piece=piece)
    walk = np.random.default_rng(4).normal(size=(len(numbers), 2, 3))
    found = pair_sums(Squares(walk), frames, most=most)
    some = found.pairs > 0
    number, lag, square = direct(frames, walk, 10**6 if most is None else 2 * most)
    np.testing.assert_array_equal(found.pairs[some], 2 * number)
    np.testing.assert_allclose(found.lagtime[some], lag, rtol=1e-12)
    np.testing.assert_allclose(found.sums[some], square, rtol=1e-9)
    np.testing.assert_allclose(found.mean[some], square / (2 * number)[:, None], rtol=1e-9)
    assert np.isnan(found.mean[~some]).all()
    assert (found.listed is None) == frames.separate
    if most is not None and frames.separate:
        assert len(found.lagtime) == 2


def test_pairs_across_blocks_are_formed_up_to_the_lag_at_which_they_are_few(monkeypatch):
    """With 4 allowed, up to 3.1 steps; pairs of one block are those on its grid as before."""
    monkeypatch.setattr(pairs_module, "_MOST_LISTED_PAIRS", 4)
    frames = frames_of(UNEVEN["off"][0])
    walk = np.random.default_rng(4).normal(size=(6, 1, 3))
    with pytest.warns(PrecisionWarning, match=r"lie in 2 groups .* more than 4 pairs: .* 1.55 s"):
        found = pair_sums(Squares(walk), frames)
    number, lag, square = direct(frames, walk, 6)
    np.testing.assert_array_equal(found.pairs, number)
    np.testing.assert_allclose(found.lagtime, lag, rtol=1e-12)
    np.testing.assert_allclose(found.sums, square, rtol=1e-9)
    np.testing.assert_array_equal(found.on_grid, [4, 0, 2, 0])
    np.testing.assert_array_equal(found.listed.lag, [1, 3, 3])
    np.testing.assert_array_equal(found.listed.first, [2, 1, 2])


def test_no_pair_of_frames_is_an_error():
    """Two pieces of one frame each."""
    with pytest.raises(TooFewFramesError) as caught:
        pair_sums(Squares(np.zeros((2, 1, 3))), frames_of([0, 1], piece=[0, 1]))
    assert caught.value.n_frames == 0


def test_walkers_that_come_and_go_have_their_own_lines():
    """Each has its own mean and mean time; a common velocity keeps the digits of small steps."""
    rng = np.random.default_rng(6)
    time = np.arange(30.0)[:, None, None]
    walks = 1e4 * time * [1.0, -0.5] + rng.normal(size=(30, 3, 2))
    walks[10:20, 0] = walks[:12, 1] = walks[25:, 2] = np.nan
    sums, pairs = gapped_squares(walks, np.isfinite(walks[..., 0]), 29)
    for lag in (1, 2, 9, 17, 29):
        square = (walks[lag:] - walks[:-lag]) ** 2
        np.testing.assert_allclose(sums[lag - 1], np.nansum(square, axis=(0, 1)), rtol=1e-11)
        assert pairs[lag - 1] == np.isfinite(square[..., 0]).sum()


@pytest.mark.parametrize("gaps", [False, True])
@pytest.mark.parametrize("groups", [[[(0, 0)], [(1, 1), (2, 2)]], [[(0, 1)], [(1, 2), (2, 2)]]])
def test_products_of_features_are_symmetric_in_the_frames(gaps, groups):
    """Sums by transform and pair by pair, with missing frames, of squares and of other products."""
    x = np.random.default_rng(7).normal(size=(12, 3))
    rows = np.delete(np.arange(12), [3, 4, 9]) if gaps else np.arange(12)
    kernel = Products(x, groups)
    found, pairs = kernel.within(rows, rows, 11)
    for lag in range(1, 12):
        both = np.array([k for k in rows if k + lag in rows], dtype=int)
        assert pairs[lag - 1] == both.size
        expected = [
            sum(
                (x[both, i] * x[both + lag, j] + x[both, j] * x[both + lag, i]).sum() / 2
                for i, j in group
            )
            for group in groups
        ]
        np.testing.assert_allclose(found[lag - 1], expected, atol=1e-12)
        values, number = kernel.between(both, both + lag)
        np.testing.assert_allclose(values.sum(axis=0), expected, atol=1e-12)
        assert number.tolist() == [1] * both.size


def test_bins_of_lags_and_pairs_at_one_lag():
    """Within a tenth of a whole number or between two; far lags share bins in the logarithm."""
    lag = np.array([0.04, 0.95, 1.0, 1.09, 1.11, 1.89, 1.91, 2.5, 3.05])
    assert lag_bins(lag, longest=9, most=9).tolist() == [1, 2, 2, 2, 3, 3, 4, 5, 6]
    # Beyond 2 steps (bins above 5) five lags are more than 4 bins.
    far = np.array([1.0, 2.5, 3.0, 5.0, 20.0, 100.0, 900.0])
    share = np.log(far[2:] / 2.1) / np.log(900 / 2.1)
    bins = [2, 5, *(6 + np.minimum(np.floor(4 * share), 3).astype(int)).tolist()]
    assert lag_bins(far, longest=2, most=4).tolist() == bins
    assert lag_bins(far, longest=2, most=5).tolist() == [2, 5, 6, 10, 40, 200, 1800]
    time = np.array([0.0, 1.0, 2.05, 3.16, 0.0, 0.95, 2.0])
    piece = np.array([0, 0, 0, 0, 3, 3, 3])
    first, last = pairs_apart(time, piece, 1.0)
    assert list(zip(first.tolist(), last.tolist(), strict=True)) == [(0, 1), (1, 2), (4, 5), (5, 6)]
    first, last = pairs_apart(time, piece, 2.0)
    assert list(zip(first.tolist(), last.tolist(), strict=True)) == [(0, 2), (4, 6)]


# ---- standard errors ----------------------------------------------------------------------------


def covariance_of(i, j, time, *, D, s):
    """Return the covariance of the displacements from frames i to frames j (P,) of one walk."""
    position = 2 * D * np.minimum.outer(time, time) + s * np.eye(len(time))
    return (
        position[np.ix_(j, j)] - position[np.ix_(j, i)]
        - position[np.ix_(i, j)] + position[np.ix_(i, i)]
    )  # fmt: skip


COMPLETE = {
    "one": (np.arange(9), None),
    "strides": (3 * np.arange(9), None),
    "two": (np.arange(14), [0] * 9 + [1] * 5),
    "three alike": (np.arange(12), [0] * 4 + [1] * 4 + [2] * 4),
    "hole": (np.r_[0:6, 300:305], None),
    "two with holes": (np.r_[0:4, 300:304, 0:4, 500:503], [0] * 8 + [1] * 7),
}


@pytest.mark.parametrize("name", COMPLETE)
@pytest.mark.parametrize(("D", "s"), [(0.5, 0.0), (0.2, 0.7)])
def test_the_error_of_a_mean_square_is_that_of_all_covariances(name, D, s):
    """Twice the sum of the squared covariances of all pairs of displacements of every lag."""
    numbers, piece = COMPLETE[name]
    piece = np.zeros(len(numbers), dtype=int) if piece is None else np.array(piece)
    frames = frames_of(numbers, piece=piece)
    sums = pair_sums(Squares(np.random.default_rng(1).normal(size=(len(numbers), 1, 1))), frames)
    lag = sums.lagtime / frames.step
    found = relative_error(sums, frames, D * lag + s, sums.pairs.astype(float))
    places = numbers / (3 if name == "strides" else 1)
    total, count = np.zeros(len(lag)), np.zeros(len(lag))
    for label in np.unique(piece):
        time = places[piece == label].astype(float)
        i, j = np.triu_indices(len(time), 1)
        squares = covariance_of(i, j, time, D=D, s=s) ** 2
        which = np.searchsorted(lag, time[j] - time[i] - 0.5)
        for k in range(len(lag)):
            own = which == k
            total[k] += 2 * squares[np.ix_(own, own)].sum()
            count[k] += own.sum()
    np.testing.assert_array_equal(count, sums.pairs)
    some = count > 0
    expected = np.sqrt(total[some]) / (count * 2 * (D * lag + s))[some]
    np.testing.assert_allclose(found[some], expected, rtol=1e-6)
    assert np.isnan(found[~some]).all()


def test_missing_frames_weigh_the_covariances_by_their_share():
    """The formula for frames missing at random, with the root of the share of displacements."""
    numbers = np.delete(np.arange(12), [3, 7, 8])
    frames = frames_of(numbers)
    sums = pair_sums(Squares(np.zeros((9, 1, 1))), frames)
    lag = np.arange(1.0, 12)
    found = relative_error(sums, frames, 0.2 * lag + 0.3, sums.pairs / 1.0)
    present = np.sqrt(sums.pairs / (12 - lag))
    some = sums.pairs > 0
    own = lag_covariance(lag[some], 11, present=present[some], D=0.2, s=0.3)
    whole = sums.pairs[some] * 2 * (0.2 * lag + 0.3)[some]
    expected = np.sqrt(2 * own * present[some] ** 4) / whole
    np.testing.assert_allclose(found[some], expected, rtol=1e-9)
    rest = pair_sums(Squares(np.zeros((9, 1, 1))), frames_of(np.arange(9)))
    still = relative_error(rest, frames_of(np.arange(9)), np.zeros(8), rest.pairs / 1.0)
    assert np.isnan(still).all()


def test_the_line_through_the_first_two_lags_has_no_negative_part():
    """Slope and offset are not negative; lags without a pair are skipped."""
    lag, pairs = np.array([1.0, 2.0, 3.0, 4.0]), np.array([0, 5, 0, 3])
    assert two_lag_fit(lag, np.array([9, 1.0, 9, 1.5]), pairs) == pytest.approx((0.25, 0.5))
    assert two_lag_fit(lag, np.array([9, 1.0, 9, 0.5]), pairs) == (0.0, 1.0)
    assert two_lag_fit(lag, np.array([9, 1.0, 9, 9.0]), pairs) == (0.5, 0.0)
    assert two_lag_fit(lag, np.array([9, 1.0, 9, 9.0]), np.array([0, 5, 0, 0])) == (0.0, 1.0)
    assert two_lag_fit(lag, np.array([1.0, 1.2, 9, 9]), np.ones(4)) == pytest.approx((0.2, 0.8))


def test_displacements_and_common_frames_are_counted():
    """In blocks of several lengths; with each end compared to each."""
    lengths = np.array([5, 2, 0, 5, 3])
    lag = np.arange(1.0, 8)
    expected = [sum(max(n + 1 - k, 0) for n in lengths) for k in lag]
    np.testing.assert_array_equal(displacement_counts(lengths, lag), expected)
    rng = np.random.default_rng(3)
    bins, one, other = np.sort(rng.integers(0, 3, 40)), *rng.integers(0, 6, (2, 40))
    for a, b in ((one, one), (one, other)):
        same = (bins[:, None] == bins) & (a[:, None] == b)
        expected = [same[bins == k].sum() for k in range(4)]
        np.testing.assert_array_equal(common_frames(bins, a, b, n_lags=4), expected)


def test_the_time_that_two_displacements_share_is_squared_and_summed():
    """Of one lag and one piece, each pair once."""
    rng = np.random.default_rng(4)
    numbers = np.sort(rng.choice(60, 18, replace=False)).astype(float)
    frames = frames_of(numbers, piece=[0] * 10 + [1] * 8, dt=1.0)
    i, j = np.triu_indices(18, 1)
    same = frames.piece[i] == frames.piece[j]
    i, j = i[same], j[same]
    length = (frames.time[j] - frames.time[i]) / frames.step
    lags, which = np.unique(length, return_inverse=True)
    order = np.lexsort((i, which))
    i, which = i[order], which[order]
    start = frames.time[i] / frames.step
    shared = np.clip(lags[which] - np.abs(start[:, None] - start), 0, None) ** 2
    alike = (which[:, None] == which) & (frames.piece[i][:, None] == frames.piece[i])
    pairs = np.triu(shared * alike, 1).sum(axis=1)
    expected = np.bincount(which, pairs)
    found = squared_shared_times(ListedPairs(which, i, j[order]), frames, lags)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)


# ---- directions and axes ------------------------------------------------------------------------


def turning_by(vectors, *, piece=None):
    """Return a motion of the rod whose body-frame steps are these rotation vectors."""
    rotation = cumulative_product(exp_map(np.array(vectors)))
    motion = with_poses(rod(), DT * np.arange(len(rotation)), rotation=rotation, dt=DT)
    return motion if piece is None else replace(motion, piece=np.array(piece))


def test_the_number_of_walks_follows_from_the_steps_of_a_body():
    """(tr WS)^2/tr WSWS, with the chance of few steps subtracted, from 1 to 3."""
    size = np.sqrt(np.diag([10.0, 1.0, 1.0])) / 20
    motion = turning_by(np.tile(size, (4, 1)))
    # 12 steps whose squares are 40, 4 and 4: 48^2/((12 (40^2 + 2 4^2) - 48^2)/13).
    assert independent_walks(motion, np.eye(3)) == pytest.approx(2304 * 13 / (12 * 1632 - 2304))
    across = np.diag([0.0, 1.0, 1.0])
    assert independent_walks(motion, across) == pytest.approx(64 * 13 / (12 * 32 - 64))
    assert independent_walks(turning_by(np.tile(size[:1], (9, 1))), np.eye(3)) == 1.25  # 10/8
    assert independent_walks(turning_by(np.tile(size * [[0.3], [1], [1]], (4, 1))), np.eye(3)) == 3
    assert independent_walks(turning_by(size[:2]), across) == pytest.approx(3)
    # Directions that weigh all axes equally: the body is taken as isotropic.
    even = with_poses(tetrahedron(), np.arange(13.0), rotation=motion.rotation)
    assert independent_walks(even, np.eye(3)) == 3
    assert independent_walks(even, across) == 2
    assert independent_walks(turning_by(size[:1]), across) == 2
    still = turning_by(np.zeros((5, 3)))
    assert independent_walks(still, across) == 3


def test_weights_within_a_hundredth_are_equal():
    """Of the largest of the three over their mean."""
    assert axes_weighted_equally(np.diag([1.0099, 0.995, 0.9951]))
    assert not axes_weighted_equally(np.diag([1.0101, 0.995, 0.9949]))
    assert not axes_weighted_equally(np.diag([0.9899, 1.005, 1.0051]))
    assert axes_weighted_equally(3 * np.diag([1.0099, 0.995, 0.9951]))
    cross = [[-3.0, 0, 0], [3.0, 0, 0], [0, 1.0, 0], [0, -1.0, 0], [0, 0, 0]]
    cluster = Cluster.from_positions(cross)
    directions = body_directions(with_poses(cluster, np.arange(3.0)))
    assert directions.shape == (4, 3)
    assert body_directions(with_poses(cluster, np.arange(3.0)), [0, 0, 2]).tolist() == [[0, 0, 2.0]]


def test_the_ratio_of_weighted_axes_has_the_error_of_a_quadratic_form():
    """Steps of planted mean products, own and of neighbours, in two pieces: mean and variance.

    Over the phases cos^2 has the mean 1/2 and cos^4 3/8.
    """
    rng = np.random.default_rng(5)
    w = 0.1 * rng.normal(size=(40, 3)) * [2.0, 1.0, 1.0]
    w[1:] -= 0.2 * w[:-1]
    motion = turning_by(w, piece=[0] * 25 + [1] * 16)
    steps = np.delete(w, 24, axis=0)
    joined = np.delete(np.arange(38), 23)
    weights = np.diag([0.2, 0.7, 1.1])
    own = steps.T @ steps / 39
    near = steps[joined].T @ steps[joined + 1] / 37
    near = (near + near.T) / 2
    tensor = own + 2 * near
    ratio, stderr = axis_ratio(motion, weights)
    assert ratio == pytest.approx(3 / 2 * np.trace(tensor @ weights) / np.trace(tensor))
    form = 3 / 2 * weights - ratio * np.eye(3)
    a, b, c = form @ own, form @ near, 2 * 39 / 37
    p = 37 / 38
    square = (
        (1 + c * c / 2) * np.trace(a @ a) + 4 * p * c * np.trace(a @ b)
        + 4 * p**2 * (1 / 2 + 3 * c * c / 8) * np.trace(b @ b)
    )  # fmt: skip
    assert stderr == pytest.approx(np.sqrt(2 * square / 39) / np.trace(tensor))
    assert axis_ratio(motion, np.eye(3)) is None
    # One neighbouring pair, or steps that return: nothing is known.
    assert axis_ratio(turning_by(w[:3], piece=[0, 0, 0, 1]), weights) == (1.0, np.inf)
    assert axis_ratio(turning_by([w[0]] * 3), weights)[1] < np.inf
    back = turning_by([w[0], -w[0]] * 5)
    assert axis_ratio(back, weights) == (1.0, np.inf)


def test_the_mean_velocity_is_that_from_first_to_last_frames():
    """Of all walkers and pieces together, with the durations in rising order."""
    walks = np.full((8, 2, 2), np.nan)
    time, piece = np.array([0, 1, 2, 4, 7, 8, 9, 10.0]), np.array([0, 0, 0, 0, 1, 1, 1, 1])
    walks[[0, 1, 3], 0] = [[0, 0], [9, 9], [2, 8]]
    walks[[4, 7], 0] = [[5, 5], [8, 5]]
    walks[[1, 2], 1] = [[1, 1], [2, -1]]
    walks[6, 1] = [100, 100]
    velocity, durations = mean_velocity(walks, time, piece)
    assert durations.tolist() == [1, 3, 4]
    np.testing.assert_allclose(velocity, [(2 + 3 + 1) / 8, (8 + 0 - 2) / 8])
    with pytest.raises(TooFewFramesError) as caught:
        mean_velocity(walks[5:7], time[5:7], piece[5:7])
    assert caught.value.n_frames == 0


def test_a_mean_velocity_is_corrected_where_the_first_lag_has_no_pair():
    """Without an offset 2 D t (1 - t/T) is left, whatever lags there are."""
    lag = np.arange(1.0, 7)
    left = np.where(lag == 1, np.nan, 2 * lag * (1 - lag / 8))[:, None] * [1.0, 3.0]
    pairs = np.array([0, 4, 3, 2, 2, 1])
    found = drift_corrected(left, pairs, lagtime=lag, durations=np.array([2.0, 6.0]))
    np.testing.assert_allclose(found[1:], 2 * lag[1:, None] * [1.0, 3.0], rtol=1e-9)
    assert np.isnan(found[0]).all()


def test_curves_state_what_they_are():
    """Kind, unit, degrees of freedom, walks and noise, and one line of text."""
    motion = turning_by(0.05 * np.random.default_rng(2).normal(size=(30, 3)))
    noise = np.tile(np.diag([1e-3, 2e-3, 4e-3]), (31, 1, 1))
    motion = replace(motion, covariance=noise, center_variance=np.full(31, 7e-4), sigma=0.02)
    one, vector, axis, place = (
        msad(motion, directions=[1, 0, 0]), msad_vector(motion),
        msad_axes(motion, axes=[0, 0, 0.3])[0], msd(motion),
    )  # fmt: skip
    assert [c.dof for c in (one, vector, axis, place)] == [2, 3, 1, 3]
    noises = [one.noise, vector.noise, axis.noise, place.noise]
    np.testing.assert_allclose(noises, [3e-3, 7e-3 / 3, 4e-3, 7e-4])
    assert [c.unit for c in (one, place)] == ["rad^2", "um^2"]
    assert (axis.n_walks, place.n_walks) == (1.0, 3.0)
    assert repr(one) == "LagCurve(MSAD, 30 lags, dof=2, rad^2)"
    assert repr(replace(one, quantity="x")).startswith("LagCurve(non-Gaussian parameter, 30")
    assert repr(replace(one, quantity="orientation")).startswith("LagCurve(correlation, 30")
    floor = motion.resolution_floor
    assert floor > 0
    assert one.resolution_floor == axis.resolution_floor == floor
    assert msad_vector(motion, threshold=0.3).resolution_floor is None
    assert vector.resolution_floor == floor
    assert (place.blocks, place.step) == ((30,), DT)
    plane = with_poses(flat(), np.arange(5.0))
    plane = replace(plane, covariance=np.full((5, 1, 1), 3e-3))
    assert msad(plane).noise == pytest.approx(3e-3)
    # Three particles, of one or two walks each.
    free = msd(np.random.default_rng(1).normal(size=(9, 3, 2)), dt=1.0)
    assert (free.n_walks, free.dof, free.n_pairs[0]) == (6.0, 2, 24)
    table = replace(place, brownian=np.ones(30)).to_frame()
    assert list(table)[-3:] == ["stderr", "n_pairs", "brownian"]
