"""Bulk rotation removed from a many-body system: the particles' own diffusion remains."""

import warnings
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from perrin import DegenerateClusterError, TooFewFramesError, msd, remove_rotation, similarity
from perrin.geometry.rotations import exp_map, log_map

WATER = Path(__file__).resolve().parents[2] / "shared" / "data" / "trackpy_bulk_water"
OMEGA = {3: np.array([0.02, -0.03, 0.05]), 2: np.array([0.06])}
DRIFT = {3: np.array([0.5, -0.2, 0.1]), 2: np.array([0.5, -0.2])}


def frame_motion(d, n_frames, drift=1.0):
    """Return rotation and centre of a frame that turns and drifts, not from the identity."""
    k = np.arange(n_frames)
    turn = exp_map(np.outer(k, OMEGA[d])) @ exp_map(20 * OMEGA[d])
    return turn, drift * k[:, None] * DRIFT[d] + np.array([30.0, -20.0, 10.0])[:d]


def walkers(d=3, n=500, n_frames=300, D=0.05, size=20.0, seed=0):
    """Return n independently diffusing particles, (T, n, d), from a box of that size."""
    rng = np.random.default_rng(seed)
    step = np.sqrt(2 * D) * rng.normal(size=(n_frames - 1, n, d))
    start = size * (rng.random((1, n, d)) - 0.5)
    return np.concatenate([start, start + step.cumsum(axis=0)])


def carried(y, drift=1.0):
    """Return the same particles as seen from a lab in which their frame turns and drifts."""
    turn, center = frame_motion(y.shape[2], len(y), drift)
    return np.einsum("tij,tnj->tni", turn, y) + center[:, None]


def come_and_go(y, seed=1, missing=0.3):
    """Return a copy with tracks of 40 to 150 frames, and 30 % of their points missing."""
    rng = np.random.default_rng(seed)
    t, n = y.shape[:2]
    length = rng.integers(40, 151, n)
    begin = rng.integers(-length + 20, t - 20)
    k = np.arange(t)[:, None]
    x = y.copy()
    x[(k < begin) | (k >= begin + length) | (rng.random((t, n)) < missing)] = np.nan
    assert np.isfinite(x[..., 0]).any(axis=0).all()
    return x


def square_steps(x, mask=None):
    """Return the sum of the squared steps seen, and how many."""
    step = np.diff(x, axis=0)
    step = step[np.isfinite(step if mask is None else mask[1:] + mask[:-1]).all(axis=2)]
    return np.sum(step**2), len(step)


def consistent(body, motion, x):
    """Check that body and motion agree: x = R body + center, template = mean body."""
    back = np.einsum("tij,tnj->tni", motion.rotation, body) + motion.center[:, None]
    rows = motion.fitted
    np.testing.assert_allclose(back[rows], x[rows], rtol=0, atol=1e-9)
    assert np.isnan(np.delete(body, rows, axis=0)).all()
    np.testing.assert_array_equal(motion.rotation[rows[0]], np.eye(x.shape[2]))
    np.testing.assert_allclose(motion.template, np.nanmean(body, axis=0), atol=1e-9)
    np.testing.assert_allclose(motion.template.mean(axis=0), 0, atol=1e-9)


# ---- 500 independent particles ------------------------------------------------------------------


@pytest.mark.parametrize("drift", [0.0, 1.0])
@pytest.mark.parametrize(("d", "seed"), [(3, 0), (3, 1), (2, 2)])
def test_the_particles_diffusion_comes_back(d, seed, drift, repeats):
    """D within 2 %, with and without drift: 9 (2-D: 8) Monte-Carlo errors of the first lag.

    500 walkers and 299 (quick: 119) steps give D to sqrt(2/(d 500 299)), 0.21 % in space. The fit
    removes d drift and d(d - 1)/2 turning coordinates of every frame, 0.4 % of the 1500: the
    walkers' own squared steps come back less exactly that share.
    """
    if seed == 1 and not repeats(0, 1):
        pytest.skip("with --long only")
    frames = repeats(120, 300)
    y = walkers(d, n_frames=frames, seed=seed)
    x = carried(y, drift)
    body, motion = remove_rotation(x, dt=1.0)
    consistent(body, motion, x)
    curve = msd(body, dt=1.0)
    monte_carlo = np.sqrt(2 / (d * 500 * (frames - 1)))
    assert 0.02 / monte_carlo > repeats(4.5, 7.5)
    found = curve.value[0] / (2 * d)
    assert found == pytest.approx(0.05, rel=0.02)
    share = (d + d * (d - 1) / 2) / (d * 500)
    assert abs(found / (0.05 * (1 - share)) - 1) < 4 * monte_carlo
    own = square_steps(y)[0]
    assert 1 - square_steps(body)[0] / own == pytest.approx(share, rel=0.15)
    # Longer lags too: no part of the rotation remains and accumulates.
    late = curve.value[[4, 9, 29]] / (2 * d * np.array([5, 10, 30]))
    np.testing.assert_allclose(late, 0.05, rtol=0.02 + 3 * curve.stderr[29] / curve.value[29])
    # Without the correction the turning frame dominates.
    assert msd(x, dt=1.0).value[9] > 10 * curve.value[9]


@pytest.mark.parametrize("d", [3, 2])
def test_the_frames_rotation_is_recovered(d):
    """Its steps to the error that diffusion leaves, M^-1 2 D dt, and the whole turn within 4."""
    y = walkers(d, seed=3)
    _, motion = remove_rotation(carried(y), dt=1.0)
    turn, _ = frame_motion(d, len(y))
    found = motion.rotation[1:] @ np.swapaxes(motion.rotation[:-1], 1, 2)
    # In the axes of the turning frame, where the walkers move without preference.
    error = log_map(np.swapaxes(turn[1:], 1, 2) @ found @ turn[:-1])
    r = y[:-1] - y[:-1].mean(axis=1, keepdims=True)
    if d == 2:
        expected = 2 * 0.05 / np.sum(r**2, axis=(1, 2))[:, None]
    else:
        moment = np.sum(r**2, axis=(1, 2))[:, None, None] * np.eye(3)
        moment = moment - np.einsum("tni,tnj->tij", r, r)
        expected = 2 * 0.05 * np.diagonal(np.linalg.inv(moment), axis1=1, axis2=2)
    count = error.size
    assert np.mean(error**2 / expected) == pytest.approx(1, abs=5 * np.sqrt(2 / count))
    total = log_map(np.swapaxes(turn[-1] @ turn[0].T, 0, 1) @ motion.rotation[-1])
    spread = np.sqrt(expected.sum(axis=0).mean())
    assert np.abs(total).max() < 4 * spread
    assert 4 * spread < 0.15
    # sigma is the walkers' own step, shared between the two frames.
    assert motion.sigma == pytest.approx(np.sqrt(0.05), rel=0.01)


@pytest.mark.parametrize("d", [3, 2])
def test_particles_may_come_and_go(d, repeats):
    """Tracks of 40 to 150 frames with 30 % missing: D within 2 %, 7 (2-D: 6) Monte-Carlo errors.

    Of 2500 tracks about 310 a frame are present in it and in the next one. The quick form has a
    quarter of the frames.
    """
    frames = repeats(75, 300)
    y = walkers(d, n=2500, n_frames=frames, seed=4)
    x = come_and_go(carried(y))
    body, motion = remove_rotation(x, dt=1.0)
    consistent(body, motion, x)
    assert motion.fitted.size == frames
    total, count = square_steps(body)
    monte_carlo = np.sqrt(2 / (d * count))
    assert 0.02 / monte_carlo > repeats(3, 6)
    assert total / (2 * d * count) == pytest.approx(0.05, rel=0.02)
    own, _ = square_steps(y, mask=x)
    share = (frames - 1) * (d + d * (d - 1) / 2) / (d * count)
    assert 1 - total / own == pytest.approx(share, rel=0.15)
    curve = msd(body, dt=1.0)
    np.testing.assert_allclose(
        curve.value[[1, 4, 9]] / (2 * d * np.array([2, 5, 10])), 0.05, rtol=0.025
    )
    turn, _ = frame_motion(d, frames)
    error = log_map(np.swapaxes(turn[-1] @ turn[0].T, 0, 1) @ motion.rotation[-1])
    assert np.abs(error).max() < 0.1


# ---- exact laws ---------------------------------------------------------------------------------


@pytest.mark.parametrize("offset", [0.0, 1e3])
@pytest.mark.parametrize("d", [3, 2])
def test_a_rigid_turn_is_removed_exactly(d, offset, repeats):
    """Without noise the particles are at rest (1e-10) and the planted motion is found."""
    frames = repeats(150, 400)
    still = np.broadcast_to(walkers(d, n=60, n_frames=2, seed=5)[0], (frames, 60, d))
    x = carried(still) + offset
    x[np.random.default_rng(6).random(x.shape[:2]) < 0.3] = np.nan
    x[100:110] = np.nan
    body, motion = remove_rotation(x, dt=0.5)
    here = np.isfinite(body)
    np.testing.assert_array_equal(here, np.isfinite(x))
    np.testing.assert_allclose(
        body[here], np.broadcast_to(motion.template, body.shape)[here], rtol=0, atol=1e-10
    )
    turn, center = frame_motion(d, frames)
    rows = motion.fitted
    assert rows.size == frames - 10
    expected = turn[rows] @ turn[0].T
    np.testing.assert_allclose(motion.rotation[rows], expected, rtol=0, atol=1e-12)
    middle = np.einsum("tij,j->ti", turn, still[0].mean(axis=0)) + center + offset
    np.testing.assert_allclose(motion.center[rows], middle[rows], rtol=0, atol=1e-9)
    np.testing.assert_array_equal(motion.time, 0.5 * np.arange(frames))
    assert motion.sigma < 1e-9
    consistent(body, motion, x)


@pytest.mark.parametrize("d", [3, 2])
def test_any_motion_of_the_lab_is_removed(d):
    """Turn and shift every frame at random, or change the unit: what remains is the same (1e-8)."""
    rng = np.random.default_rng(7)
    x = come_and_go(walkers(d, n=60, n_frames=60, seed=8))
    body, _ = remove_rotation(x)
    turn = exp_map(rng.normal(size=(60, 3 if d == 3 else 1)))
    turn[0] = np.eye(d)
    shaken = np.einsum("tij,tnj->tni", turn, x) + 50 * rng.normal(size=(60, 1, d))
    again, motion = remove_rotation(shaken)
    np.testing.assert_allclose(again, body, rtol=0, atol=1e-8)
    consistent(again, motion, shaken)
    np.testing.assert_allclose(remove_rotation(1e3 * x)[0], 1e3 * body, rtol=0, atol=1e-6)
    # A lab turned for good turns the answer, and the order of the particles is nothing.
    q = exp_map(rng.normal(size=3 if d == 3 else 1))
    np.testing.assert_allclose(remove_rotation(x @ q.T)[0], body @ q.T, rtol=0, atol=1e-8)
    order = rng.permutation(60)
    np.testing.assert_allclose(remove_rotation(x[:, order])[0], body[:, order], rtol=0, atol=1e-8)


@pytest.mark.parametrize("d", [3, 2])
def test_a_second_removal_changes_nothing(d):
    """After the removal no bulk rotation or drift is left."""
    body, _ = remove_rotation(carried(walkers(d, n=100, n_frames=60, seed=9)))
    again, motion = remove_rotation(body)
    np.testing.assert_allclose(again, body, rtol=0, atol=1e-9)
    np.testing.assert_allclose(motion.accumulated_rotation(), 0, atol=1e-11)
    np.testing.assert_allclose(motion.center, 0, atol=1e-9)


def test_time_may_run_backwards():
    """Reversed frames give the reversed result, in the axes of their own first frame."""
    x = come_and_go(carried(walkers(n=100, n_frames=70, seed=10)), missing=0.1)
    forth, back = remove_rotation(x)[0], remove_rotation(x[::-1])[0][::-1]
    s, R, v = similarity(back.reshape(-1, 3), forth.reshape(-1, 3))
    assert float(s) == pytest.approx(1, abs=1e-10)
    np.testing.assert_allclose(forth @ R.T + v, back, rtol=0, atol=1e-8)


def test_gaps_in_the_frame_numbers_are_empty_frames():
    """Left-out rows with their numbers, and rows of NaN, are the same data."""
    x = carried(walkers(n=100, n_frames=80, seed=11))
    absent = np.r_[10:13, 40, 60:75]
    kept = np.delete(np.arange(80), absent)
    holes = x.copy()
    holes[absent] = np.nan
    body, motion = remove_rotation(holes, dt=0.25)
    short, other = remove_rotation(x[kept], dt=0.25, frames=kept)
    np.testing.assert_allclose(short, body[kept], rtol=0, atol=1e-10)
    np.testing.assert_allclose(other.rotation, motion.rotation[kept], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(other.time, 0.25 * kept)
    np.testing.assert_array_equal(motion.fitted, kept)
    assert {motion.reason[k] for k in absent} == {"no particles"}
    np.testing.assert_allclose(
        other.accumulated_rotation(), motion.accumulated_rotation()[kept], rtol=0, atol=1e-10
    )


# ---- frames that do not fix a rotation ----------------------------------------------------------


@pytest.mark.parametrize("thin", [0, 10, 29])
def test_a_frame_on_a_line_does_not_change_the_others(thin):
    """A frame with only three particles on a line is refused and left out of the chain."""
    rng = np.random.default_rng(12)
    start = 5 * rng.normal(size=(40, 3))
    start[:3] = [[0, 0, 0], [5, 0.01, 0], [10, 0, 0.01]]
    x = carried(start + 0.05 * rng.normal(size=(30, 40, 3)))
    x[thin, 3:] = np.nan
    body, motion = remove_rotation(x)
    assert motion.fitted.tolist() == [k for k in range(30) if k != thin]
    assert "3 particles present" in motion.reason[thin]
    assert motion.n_present[thin] == 3
    empty = x.copy()
    empty[thin] = np.nan
    expected, other = remove_rotation(empty)
    np.testing.assert_allclose(body, expected, rtol=0, atol=1e-10)
    np.testing.assert_allclose(motion.rotation, other.rotation, rtol=0, atol=1e-12)
    consistent(body, motion, x)


def test_invalid_positions_are_refused():
    """Lines, single frames, too few particles, and particles absent in all frames with a pose."""
    x = carried(walkers(n=8, n_frames=20, seed=13))
    with pytest.raises(DegenerateClusterError, match="at least 3"):
        remove_rotation(x[:, :2])
    with pytest.raises(DegenerateClusterError, match="one line"):
        remove_rotation(np.arange(20.0)[:, None, None] + np.outer(np.arange(6.0), [1.0, 2.0, 3.0]))
    with pytest.raises(TooFewFramesError):
        remove_rotation(x[:1])
    with pytest.raises(ValueError, match="dt"):
        remove_rotation(x, dt=0.0)
    with pytest.raises(ValueError, match="frames"):
        remove_rotation(x, frames=np.zeros(20))
    with pytest.raises(ValueError, match="infinite"):
        remove_rotation(np.where(x == x.max(), np.inf, x))
    with pytest.raises(ValueError, match=r"shape \(T, n, d\)"):
        remove_rotation(x[0])
    lonely = x.copy()
    lonely[:, 7] = np.nan
    with pytest.raises(ValueError, match=r"particles \[7\] are missing in every frame"):
        remove_rotation(lonely)
    lonely[10] = np.nan
    lonely[10, [0, 7]] = x[10, [0, 7]]
    with pytest.raises(ValueError, match=r"particles \[7\] are missing in every frame with a pose"):
        remove_rotation(lonely)
    handover = np.concatenate([x, x], axis=1)
    handover[10:, :8] = np.nan
    handover[:10, 8:] = np.nan
    with pytest.raises(ValueError, match=r"particles \[8, 9, .* 15\] are missing in every frame"):
        remove_rotation(handover)


def test_the_input_is_not_changed():
    """Nothing is written to the caller's array, and the motion cannot be changed."""
    x = come_and_go(walkers(n=100, n_frames=60, seed=14))
    before = x.copy()
    body, motion = remove_rotation(x)
    np.testing.assert_array_equal(x, before)
    assert body.flags.writeable
    assert not motion.rotation.flags.writeable


# ---- real beads ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def water():
    """Return trackpy's bulk water: 1059 tracks of 1 um beads over 300 frames, pixels."""
    if not WATER.exists():
        pytest.skip("the tracks of beads in water are not here")
    return pd.read_csv(WATER / "tracks.csv.gz", usecols=["x", "y", "frame", "particle"])


@pytest.fixture(scope="module")
def beads(water, repeats):
    """Return the beads' positions (T, n, 2), all frames or the first 60, and without rotation."""
    x, _, _ = on_a_grid(water[water["frame"] < repeats(60, 300)])
    return x, *remove_rotation(x)


def power_law(table, *, kept):
    """Return n and A of trackpy's walkthrough: no drift, ensemble MSD, straight line in logs.

    The drift is that of all tracks, the MSD that of those kept.
    """
    with warnings.catch_warnings():
        if hasattr(pd.errors, "Pandas4Warning"):
            warnings.simplefilter("ignore", pd.errors.Pandas4Warning)
        trackpy = pytest.importorskip("trackpy")
        still = trackpy.subtract_drift(table, trackpy.compute_drift(table))
        curve = trackpy.emsd(still[still["particle"].isin(kept)], mpp=100 / 285, fps=24)
        fit = trackpy.utils.fit_powerlaw(curve, plot=False)
    return float(fit["n"].iloc[0]), float(fit["A"].iloc[0])


def on_a_grid(table):
    """Return the positions (T, n, 2) and the row and column of every line of the table."""
    particles, column = np.unique(table["particle"], return_inverse=True)
    row = table["frame"].to_numpy()
    x = np.full((row.max() + 1, len(particles), 2), np.nan)
    x[row, column] = table[["x", "y"]]
    return x, row, column


def spun(x, degrees, center):
    """Return positions turned by so many degrees a frame about a centre."""
    turn = exp_map(np.radians(degrees) * np.arange(len(x))[:, None])
    return np.einsum("tij,tnj->tni", turn, x - center) + center


def test_trackpys_bulk_water_is_unchanged_by_a_turn(water, repeats):
    """2 degrees a frame added and removed: n within 0.003, A within 0.6 % of the walkthrough.

    The walkthrough removes the drift too; the turn takes one more of the 520 coordinates of a
    frame, 0.2 % of A, and contains the 0.2 degrees by which the real beads turned together. The
    quick form measures n and A of the 30 longest tracks in 100 frames.
    """
    water = water[water["frame"] < repeats(100, 300)]
    longest = water["particle"].value_counts(sort=True).index
    kept = longest[: repeats(30, len(longest))]
    n_before, A_before = power_law(water, kept=kept)
    if len(kept) == len(longest):
        assert (n_before, A_before) == pytest.approx((1.08024, 1.602365), rel=2e-6)
    x, row, column = on_a_grid(water)
    body, motion = remove_rotation(spun(x, 2.0, [400.0, 200.0]), dt=1 / 24)
    assert motion.fitted.size == len(x)
    cleaned = water.assign(x=body[row, column, 0], y=body[row, column, 1])
    assert cleaned[["x", "y"]].notna().all(axis=None)
    n, A = power_law(cleaned, kept=kept)
    assert n == pytest.approx(n_before, abs=0.003)
    assert pytest.approx(A_before, rel=0.006) == A


@pytest.mark.parametrize("center", [[400.0, 200.0], [-5000.0, 3000.0]])
@pytest.mark.parametrize("degrees", [2.0, -75.0])
def test_any_turn_of_real_beads_is_removed(beads, degrees, center):
    """With a turn added or without, the corrected coordinates are the same to 1e-7 pixel."""
    x, plain, rest = beads
    body, motion = remove_rotation(spun(x, degrees, np.array(center)))
    np.testing.assert_allclose(body, plain, rtol=0, atol=1e-7)
    added = motion.accumulated_rotation() - rest.accumulated_rotation()
    np.testing.assert_allclose(added[:, 0], np.radians(degrees) * np.arange(len(x)), atol=1e-9)
    assert np.degrees(np.abs(rest.accumulated_rotation()).max()) < 1


def test_the_planted_frame_is_scipys():
    """The rotation recovered from noise-free positions is the one that scipy applied."""
    turn = Rotation.random(25, random_state=3)
    still = walkers(n=30, n_frames=2, seed=15)[0]
    x = np.stack([q.apply(still) for q in turn])
    rotation, rows = remove_rotation(x)[1].as_scipy()
    assert rows.size == 25
    assert (rotation * (turn * turn[0].inv()).inv()).magnitude().max() < 1e-12
