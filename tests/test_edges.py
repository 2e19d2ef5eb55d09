"""At the edges of numbers `analyze` gives the right number, or one line that says what is wrong."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

import perrin

DT = 0.7
FRAMES = 205  # from 200 steps on no test is ranked among draws, which takes most of the time


@pytest.fixture(scope="module")
def places():
    """Positions of a tetrahedron with noise, (FRAMES, 4, 3)."""
    body = perrin.Cluster.touching(4, 2.45)
    motion = perrin.simulate_motion(body, D_R=5e-3, D_T=0.04, dt=DT, n_frames=FRAMES, rng=1)
    return perrin.add_noise(motion.positions(), sigma=0.02, rng=2)


def table(places, frames=None):
    """Return a table of tracks of one body."""
    frame, particle = np.indices(places.shape[:2])
    columns = dict(zip("xyz", places.reshape(-1, places.shape[2]).T, strict=False))
    if frames is not None:
        frame = np.asarray(frames)[frame]
    return pd.DataFrame({"frame": frame.ravel(), "particle": particle.ravel(), **columns})


def measured(places, frames=None, **known):
    """Return the only cluster."""
    (cluster,) = perrin.analyze(table(places, frames), **{"dt": DT} | known).clusters
    return cluster


@pytest.fixture(scope="module")
def usual(places):
    """Return the result without any edge."""
    return measured(places)


def assert_equal(one, other, *, D_R=1.0, D_T=1.0, rel=1e-6):
    """Compare the coefficients of two results, those of the second times factors."""
    for name, factor in (("D_R", D_R), ("D_T", D_T)):
        a, b = getattr(one, name), getattr(other, name)
        assert a.value == pytest.approx(factor * b.value, rel=rel)
        assert a.stderr == pytest.approx(factor * b.stderr, rel=max(rel, 1e-4))


@pytest.mark.parametrize("factor", [1e-9, 1e9])
def test_units_of_any_size(places, usual, factor):
    """D_T scales with the square of the unit of length, both with the inverse of that of time."""
    report = perrin.analyze(table(places * factor), dt=DT * factor)
    assert_equal(report.clusters[0], usual, D_R=1 / factor, D_T=factor)
    assert "the coordinates are probably not in um" in report.warnings[0]


def test_coordinates_far_from_the_origin(places, usual, request):
    """At 1e9 um a float64 resolves 0.1 um/1e6: the result is that of the rounded coordinates."""
    rounded, far = places + 1e9 - 1e9, measured(places + 1e9)
    request.getfixturevalue("no_tensors")
    request.getfixturevalue("no_verdicts")
    assert_equal(far, measured(rounded), rel=1e-4)
    assert_equal(far, usual, rel=1e-3)
    assert_equal(measured(places + 1e6), usual, rel=1e-5)


@pytest.mark.usefixtures("no_tensors", "no_verdicts")
def test_numbers_of_frames_that_begin_anywhere(places, usual):
    """Negative and large ones; every third frame has the time of three."""
    for first in (-30, 10**9):
        assert_equal(measured(places, np.arange(FRAMES) + first), usual)
    few = places[:60:3]
    assert_equal(measured(few, np.arange(0, 60, 3)), measured(few, dt=3 * DT), rel=1e-6)


@pytest.mark.usefixtures("no_tensors", "no_verdicts")
def test_types_of_numbers(places, usual):
    """float32 and whole numbers are read as they are."""
    assert_equal(measured(places.astype(np.float32)), usual, rel=1e-3)
    whole = np.rint(1e6 * places).astype(np.int64)
    assert_equal(measured(whole, scale=1e-6), usual, rel=1e-3)


def test_no_noise_at_all(places, usual):
    """Exact positions have a sigma of 0 within rounding; a stated sigma of 0 is contradicted."""
    body = perrin.Cluster.touching(4, 2.45)
    exact = perrin.simulate_motion(body, D_R=5e-3, D_T=0.04, dt=DT, n_frames=FRAMES, rng=1)
    cluster = measured(exact.positions())
    assert cluster.motion.sigma < 1e-12
    assert cluster.D_R.value == pytest.approx(5e-3, abs=3 * cluster.D_R.stderr)
    assert "not rigid" in measured(places, sigma=0.0).warnings[0]


@pytest.mark.usefixtures("no_tensors")
def test_equal_frames_are_named(places, usual):
    """No motion is D = 0, with a warning; one frame that differs is an upper limit, or little."""
    still = measured(np.repeat(places[:1], 20, axis=0))
    assert still.D_R.value == still.D_T.value == 0
    assert "the body does not move at all, its frames are equal" in still.warnings[0]
    nearly = [
        np.concatenate([np.repeat(places[:1], n - 1, axis=0), places[1:2]]) for n in (20, 205)
    ]
    assert not measured(nearly[0]).D_R.resolved
    # One of 204 steps, of which three components have 5.4 times their usual square or less.
    assert measured(nearly[1]).D_R.value < 5.4 / 204 * usual.D_R.value


def test_few_frames(places):
    """Two cannot separate motion from noise; three can, with a warning."""
    with pytest.raises(perrin.TooFewFramesError, match=r"2 frames .* at least 3 in a row"):
        measured(places[:2])
    assert any("2 steps, fewer than 30" in text for text in measured(places[:3]).warnings)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda x: x * 0, "the 4 particles lie on one line"),
        (lambda x: np.where(x == x[5, 0, 0], np.inf, x), "x: 1 infinite value"),
        (lambda x: x * np.nan, "no cluster: no two particles keep their distance"),
        (lambda x: x[:0], "no rows; expected one row per particle and frame"),
        (
            lambda x: np.where(np.arange(len(x))[:, None, None] % 2, x, x * [1, 1, -1]),
            "too few steps",
        ),
    ],
)
def test_what_shows_no_motion_is_refused_in_words(places, change, message):
    """All at one place, infinite, missing, without rows, mirrored in every second frame."""
    with pytest.raises(ValueError, match=message):
        measured(change(places))


@pytest.mark.usefixtures("no_tensors", "no_verdicts")
def test_mirrored_frames_and_particles_at_one_place(places, usual):
    """A mirrored body has the same D; a frame with two particles at one place is left out."""
    assert_equal(measured(places * [1, 1, -1]), usual)
    half = places[:20].copy()
    half[10:] *= [-1, 1, 1]
    assert any("labels change particles at frame 10" in text for text in measured(half).warnings)
    one = places[:20].copy()
    one[5, 1] = one[5, 0]
    assert any("at frame 5" in text for text in measured(one).warnings)
    far = places.copy()
    far[5, 0] = 1e100
    assert measured(far).D_R.value == pytest.approx(usual.D_R.value, rel=0.2)


@pytest.mark.usefixtures("no_tensors", "no_verdicts")
def test_nearly_collinear_particles(places):
    """Three on a line and one beside it have a full rotation, of the planted D_R."""
    line = np.array([[0.0, 0, 0], [2.45, 0, 0], [4.9, 0, 0], [2.45, 0.3, 0]])
    body = perrin.Cluster.touching(4, 2.45)
    motion = perrin.simulate_motion(body, D_R=5e-3, D_T=0.04, dt=DT, n_frames=FRAMES, rng=3)
    turned = np.einsum("tij,nj->tni", motion.rotation, line - line.mean(axis=0))
    noisy = perrin.add_noise(turned + motion.center[:, None], sigma=0.02, rng=1)
    cluster = measured(noisy)
    assert cluster.D_R.value == pytest.approx(5e-3, abs=3 * cluster.D_R.stderr)


@pytest.mark.parametrize("dt", [0, -1.0, np.nan, np.inf])
def test_times_between_frames_that_are_none(places, dt):
    """The message names dt."""
    with pytest.raises(ValueError, match="dt: expected a finite number > 0"):
        measured(places, dt=dt)


@pytest.mark.parametrize("late", [9, 5])
def test_times_that_repeat_or_go_back(places, late):
    """A column of times that does not grow is refused, or the frames are counted."""
    rows = table(places)
    clock = DT * np.arange(FRAMES, dtype=float)
    clock[10] = clock[late]
    rows["time"] = clock[rows["frame"]]
    with pytest.raises(ValueError, match="time"):
        perrin.analyze(rows, dt=DT)
