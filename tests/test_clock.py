"""Laws of the column time."""

import json

import numpy as np
import pandas as pd
import pytest

import perrin
from perrin.tracks.clock import frame_stride, read_clock


def table(times, frames=None):
    frames = np.arange(len(times)) if frames is None else frames
    return pd.DataFrame({"frame": np.repeat(frames, 2), "time": np.repeat(times, 2)})


def test_even_times_are_the_frames():
    """Times dt apart, to rounding, give the frames unchanged."""
    times = (0.73 * np.arange(50)).round(4)
    assert read_clock(table(times), dt=0.73) == (None, ())
    assert read_clock(table(times + 17.3), dt=0.73) == (None, ())
    assert read_clock(pd.DataFrame({"frame": [0, 1]}), dt=0.73) == (None, ())


def test_pauses_are_kept_and_missing_frames_interpolated():
    """The times of the rows; a frame without rows is interpolated; the clock survives JSON."""
    clock, notes = read_clock(table([5.0, 6.0, 7.0, 27.0, 29.0], [0, 1, 2, 3, 5]), dt=1.0)
    assert clock.at(np.arange(-1, 7)).tolist() == [4.0, 5.0, 6.0, 7.0, 27.0, 28.0, 29.0, 30.0]
    assert clock.from_frame(2).at(np.array([0, 1, 3])).tolist() == [0.0, 20.0, 22.0]
    assert "from 1 to 20 s" in notes[0]
    back = type(clock).from_dict(json.loads(json.dumps(clock.to_dict())))
    np.testing.assert_array_equal(back.frames, clock.frames)
    np.testing.assert_array_equal(back.times, clock.times)
    assert back.dt == clock.dt


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
    """A column in other units, or one that does not rise, is refused with both numbers."""
    with pytest.raises(perrin.TrackTableError) as error:
        read_clock(table(times), dt=0.73)
    assert all(word in str(error.value) for word in words)


def test_a_stride_of_the_frame_numbers_is_stated():
    """Frame numbers in steps of 5, from any first one; a single other number ends it."""
    frames = pd.DataFrame({"frame": 3 + 5 * np.arange(9)})
    assert frame_stride(frames)[0].startswith("frame numbers are multiples of 5: ")
    assert frame_stride(pd.concat([frames, pd.DataFrame({"frame": [4]})])) == ()
    assert frame_stride(table(np.arange(9.0))) == ()
