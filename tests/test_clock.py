"""Laws of the column time."""

import numpy as np
import pandas as pd
import pytest

import perrin
from perrin.tracks.clock import frame_stride, read_clock


def table(times, frames=None):
    frames = np.arange(len(times)) if frames is None else frames
    return pd.DataFrame({"frame": np.repeat(frames, 2), "time": np.repeat(times, 2)})


def test_even_times_are_the_frames():
    """Times dt apart, to rounding, change nothing."""
    times = (0.73 * np.arange(50)).round(4)
    assert read_clock(table(times), dt=0.73) == (None, ())
    assert read_clock(table(times + 17.3), dt=0.73) == (None, ())
    assert read_clock(pd.DataFrame({"frame": [0, 1]}), dt=0.73) == (None, ())


def test_pauses_are_kept_and_missing_frames_interpolated():
    """The times of the rows, from 0; a frame without rows stands between its neighbours."""
    clock, notes = read_clock(table([5.0, 6.0, 7.0, 27.0, 29.0], [0, 1, 2, 3, 5]), dt=1.0)
    assert clock.at(np.arange(-1, 7)).tolist() == [4.0, 5.0, 6.0, 7.0, 27.0, 28.0, 29.0, 30.0]
    assert clock.from_frame(2).at(np.array([0, 1, 3])).tolist() == [0.0, 20.0, 22.0]
    assert "from 1 to 20 s" in notes[0]


@pytest.mark.parametrize(
    ("times", "words"),
    [
        (0.5 * np.arange(9), ["0.5 s a frame", "dt = 0.73"]),
        (730.0 * np.arange(9), ["730 s a frame", "dt = 0.73"]),
        (0.73 * np.array([0, 1, 2, 2, 3]), ["does not rise", "frame 3"]),
        (0.73 * np.array([0, 1, 2, 1.5, 3]), ["does not rise"]),
    ],
)
def test_times_that_contradict_are_refused(times, words):
    """A column in other units, or one that stands still, is refused with both numbers."""
    with pytest.raises(perrin.TrackTableError) as error:
        read_clock(table(times), dt=0.73)
    assert all(word in str(error.value) for word in words)


def test_uneven_times_reach_every_estimate():
    """Pauses of 20 s among intervals of 0.73 s: D within 4 errors, twice too large without them."""
    body = perrin.Cluster.tetrahedron(1.5)
    steps = np.where(np.arange(299) % 30 == 29, 20.0, 0.73)
    fine = np.append(0, np.cumsum(np.rint(steps / 0.1).astype(int)))
    truth = perrin.simulate_motion(
        body, D_R=5e-3, D_T=0.02, dt=0.1, n_frames=int(fine[-1]) + 1, rng=3
    )
    x = perrin.add_noise(truth.positions()[fine], sigma=0.03, rng=4)
    rows = perrin.positions_table(x)
    timed = rows.assign(time=0.1 * fine[rows["frame"]])
    # The usual interval of these whole tenths is 0.7 s.
    result = perrin.analyze(timed, dt=0.7).clusters[0]
    for estimate, planted in ((result.D_R, 5e-3), (result.D_T, 0.02)):
        assert abs(estimate.value - planted) < 4 * estimate.stderr
    wrong = perrin.analyze(rows, dt=0.7).clusters[0]
    assert wrong.D_R.value > 1.5 * result.D_R.value
    np.testing.assert_allclose(result.motion.time, 0.1 * fine)


def test_a_stride_is_reported_and_the_snr_is_that_of_real_steps():
    """Frame numbers in steps of 5: the same signal-to-noise ratio, and D in units of 5 dt."""
    truth = perrin.simulate_motion(
        perrin.Cluster.tetrahedron(1.5), D_R=5e-3, D_T=0.02, dt=1.0, n_frames=100, rng=5
    )
    rows = perrin.positions_table(perrin.add_noise(truth.positions(), sigma=0.03, rng=6))
    one = perrin.analyze(rows, dt=1.0)
    five = perrin.analyze(rows.assign(frame=5 * rows["frame"]), dt=0.2)
    assert five.clusters[0].D_R.snr == pytest.approx(one.clusters[0].D_R.snr, rel=1e-9)
    assert five.clusters[0].D_R.value == pytest.approx(one.clusters[0].D_R.value, rel=1e-9)
    assert any("multiples of 5" in note for note in five.notes)
    assert not any("multiples" in note for note in one.notes)
    assert frame_stride(rows) == ()
