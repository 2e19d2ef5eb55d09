"""Which rows of a table are no measurements, and whether its distances are in um."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

import perrin
from perrin.run.tables import read_table
from perrin.tracks.screening import (
    centre_removed,
    distance_notes,
    far_points,
    far_sentence,
    has_trackpy_columns,
    screen_rows,
)


def tracks(seed, *, n_frames=300, D_R=5e-3, D_T=0.04, sigma=0.03, n=4, dt=0.73):
    """Return the noisy positions (T, n, 3) of a body about (20, 20, 20)."""
    rng = np.random.default_rng(seed)
    body = perrin.Cluster.touching(n, 2.45)
    truth = perrin.simulate_motion(body, D_R=D_R, D_T=D_T, dt=dt, n_frames=n_frames, rng=rng)
    return perrin.add_noise(truth.positions(), sigma=sigma, rng=rng) + 20


def table_of(x, digits=5):
    """Return the table of positions (T, n, d), rounded as a file is; NaN rows stay."""
    frames, n, d = x.shape
    table = pd.DataFrame({"frame": np.repeat(np.arange(frames), n)})
    table["particle"] = np.tile(np.arange(n), frames)
    table[list("xyz"[:d])] = np.round(x.reshape(-1, d), digits)
    return table


def held_back(x, lost):
    """Return positions in which a lost particle repeats its last place."""
    y = x.copy()
    for k in range(1, len(y)):
        y[k, lost[k]] = y[k - 1, lost[k]]
    return y


def missing_in(screened, shape):
    return screened.table["x"].isna().to_numpy().reshape(shape)


@pytest.mark.parametrize("offset", [0.0, -20.0])
@pytest.mark.parametrize("point", [0.0, -1.0])
@pytest.mark.parametrize("digits", [3, 5])
def test_a_lost_particle_written_as_a_point_is_missing(offset, point, digits):
    """Exactly the rows at the placeholder, far from the body or amid it, are found and named."""
    x = tracks(1) + offset
    lost = np.random.default_rng(2).random(x.shape[:2]) < 0.05
    table = table_of(np.where(lost[..., None], point, x), digits)
    before = table.copy()
    screened = screen_rows(table)
    np.testing.assert_array_equal(missing_in(screened, lost.shape), lost)
    (text,) = screened.warnings
    first = int(np.flatnonzero(lost.any(axis=1))[0])
    place = f"({point:g}, {point:g}, {point:g})"
    assert f"{lost.sum()} rows of 4 particles at exactly {place}, first in frame {first}:" in text
    pd.testing.assert_frame_equal(table, before)


@pytest.mark.parametrize("digits", [1, 5])
def test_particles_elsewhere_do_not_change_what_is_missing(digits):
    """Rows of other particles, with points of their own or with shared values, change nothing."""
    x = tracks(4)
    x[[30, 31, 90, 200], 2] = -1.0
    others = tracks(5) + np.array([60.0, 0.0, 0.0])
    alone = missing_in(screen_rows(table_of(x, digits)), x.shape[:2])
    both = np.concatenate([others[:, :2], x, others[:, 2:]], axis=1)
    together = missing_in(screen_rows(table_of(both, digits)), both.shape[:2])
    assert alone.sum() == 4
    np.testing.assert_array_equal(together[:, 2:6], alone)
    assert not together[:, [0, 1, 6, 7]].any()


def test_a_particle_lost_for_a_long_while_is_missing_all_of_it():
    """One unbroken stay at (0, 0, 0) is a placeholder, not one place that is repeated."""
    x = tracks(3)
    x[100:140, 2] = 0.0
    screened = screen_rows(table_of(x))
    assert np.argwhere(missing_in(screened, x.shape[:2]))[:, 0].tolist() == list(range(100, 140))
    assert len(screened.warnings) == 1


@pytest.mark.parametrize("digits", [3, 5, 15])
@pytest.mark.parametrize("n_frames", [60, 300])
def test_repeats_of_the_last_place_are_missing(digits, n_frames):
    """Five percent of exact repeats are found, all and no others."""
    x = np.round(tracks(4, n_frames=n_frames), digits)
    lost = np.random.default_rng(5).random(x.shape[:2]) < 0.05
    lost[0] = False
    screened = screen_rows(table_of(held_back(x, lost), digits))
    np.testing.assert_array_equal(missing_in(screened, lost.shape), lost)
    (text,) = screened.warnings
    assert text.startswith(f"{lost.sum()} rows of 4 particles with all coordinates of the")
    assert "previous row" in text


def test_a_table_with_repeats_is_that_without_these_rows():
    """The positions are those of a table in which the lost particle has no row."""
    x = np.round(tracks(6), 5)
    lost = np.random.default_rng(7).random(x.shape[:2]) < 0.05
    lost[0] = False
    table = screen_rows(table_of(held_back(x, lost))).table
    repaired, _ = perrin.cluster_positions(table)
    expected = np.where(lost[..., None], np.nan, x)
    np.testing.assert_array_equal(repaired, expected)


@pytest.mark.parametrize("scale", [1.0, 0.107])
@pytest.mark.parametrize(("digits", "D_R"), [(0, 1e-5), (1, 1e-3), (2, 1e-8), (2, 5e-3), (5, 5e-3)])
def test_repeats_by_rounding_are_measurements(digits, D_R, scale, repeats):
    """Pixels, few digits, bodies that hardly move or not at all: coincidences are no repeats."""
    for seed in range(repeats(2, 4)):
        x = np.round(tracks(seed, D_R=D_R, D_T=8 * D_R), digits) * scale
        screened = screen_rows(table_of(x, 15))
        assert screened.warnings == ()
        assert not screened.table["x"].isna().any()


def test_a_particle_that_sticks_is_measured(repeats):
    """In pixels, a particle that moves and then sticks repeats its place as a measurement."""
    for seed in range(repeats(2, 4)):
        x = tracks(seed)
        x[150:] = x[150] + np.random.default_rng(seed).normal(scale=0.1, size=x[150:].shape)
        assert screen_rows(table_of(x, 0)).warnings == ()


def test_a_particle_that_never_moves_is_kept():
    """The same position in every row is a measurement, without a warning."""
    x = tracks(8)
    x[:, 3] = 17.0
    assert screen_rows(table_of(x)).warnings == ()


def test_rows_without_coordinates_are_a_note():
    """NaN rows inform: how many, of how many particles, since when."""
    x = tracks(9, n_frames=40)
    x[10:15, :2] = np.nan
    screened = screen_rows(table_of(x))
    assert screened.warnings == ()
    assert screened.notes == (
        "10 rows of 2 particles without coordinates (NaN), first in frame 10: they count as "
        "missing",
    )


def test_ids_that_recur_in_other_clusters_are_other_particles():
    """The last place is that of the same particle in the same cluster."""
    x = tracks(10, n_frames=50)
    one, two = (table_of(y).assign(cluster=c) for c, y in enumerate((x, x + 30)))
    both = pd.concat([one, two], ignore_index=True).sample(frac=1, random_state=0)
    assert screen_rows(both).warnings == ()


# ---- one cluster --------------------------------------------------------------------------------


def test_far_points_are_those_beyond_twenty_sizes():
    """Three bad coordinates among 1200 are marked, and coordinates near the body are not."""
    x = tracks(11)
    x[5, 0, 2] += 800.0
    x[70, 3] = -1e6
    x[80, 1, 0] += 20.0  # eight sizes: left to the fit
    x[90, :3] = np.nan
    far = far_points(x)
    assert np.argwhere(far).tolist() == [[5, 0], [70, 3]]
    assert far_sentence(far, np.arange(100, 400)) == (
        "2 points of 2 particles are farther from the rest than 20 times the body's size, first in "
        "frame 105: no measurements; left out"
    )
    np.testing.assert_array_equal(far_points(x * 1e3 + 7), far)
    np.testing.assert_array_equal(far_points(x[:, ::-1]), far[:, ::-1])


def test_of_two_points_far_from_each_other_none_is_kept():
    """Which of two points is wrong is unknown."""
    x = tracks(12, n=2)
    x[7, 0] += 500.0
    assert np.argwhere(far_points(x)).tolist() == [[7, 0], [7, 1]]
    assert not far_points(x[:, :1]).any()


@pytest.mark.parametrize("digits", [2, 3, 5, 15])
def test_a_removed_centre_is_found_at_every_resolution(digits):
    """Centred tables are found, also with frames missing; tables as measured are not."""
    x = tracks(13)
    centred = np.round(x - x.mean(axis=1, keepdims=True), digits)
    assert centre_removed(centred)
    assert centre_removed(centred * 0.107 + 3)
    assert not centre_removed(np.round(x, digits))
    lost = np.random.default_rng(1).random(x.shape[:2]) < 0.1
    centred[lost] = np.nan
    assert centre_removed(centred)
    x[lost] = np.nan
    assert centre_removed(np.round(x - np.nanmean(x, axis=1, keepdims=True), digits))


@pytest.mark.parametrize("digits", [0, 1, 2, 5])
def test_a_body_at_rest_has_its_centre(digits, repeats):
    """The centre of a body at rest is at rest, and was not removed."""
    for seed in range(repeats(2, 4)):
        x = tracks(seed, D_R=1e-9, D_T=1e-9, sigma=0.005, n_frames=60)
        assert not centre_removed(np.round(x, digits))
    assert not centre_removed(np.zeros((50, 4, 3)))
    assert not centre_removed(x[:2])


# ---- units --------------------------------------------------------------------------------------


def test_the_nearest_distance_is_stated():
    """The mean over particles; a tetrahedron of edge 2.45 um reads a little less with noise."""
    notes, warnings = distance_notes(
        table_of(tracks(14, sigma=0.0)), scale_given=False, trackpy_columns=False
    )
    assert notes == ("nearest particles are 2.45 um apart on average",)
    assert warnings == ()


def test_units_that_are_no_colloids_warn():
    """Pixels of trackpy with scale 1, metres, nanometres: one line each; none with a scale."""
    table = table_of(tracks(15))
    (text,) = distance_notes(table, scale_given=False, trackpy_columns=True)[1]
    assert "columns that trackpy writes, whose coordinates are pixels" in text
    assert "state the um per pixel with scale" in text
    assert distance_notes(table, scale_given=True, trackpy_columns=True)[1] == ()
    for unit in (1e-6, 1e3):
        other = table.assign(**{axis: table[axis] * unit for axis in "xyz"})
        (text,) = distance_notes(other, scale_given=False, trackpy_columns=False)[1]
        assert "outside 0.05 to 50 um" in text
        assert "state the um per unit with scale" in text
        (text,) = distance_notes(other, scale_given=True, trackpy_columns=False)[1]
        assert text.endswith("correct scale")
    alone = table[table["particle"] == 0]
    assert distance_notes(alone, scale_given=False, trackpy_columns=False) == ((), ())


def test_trackpy_is_recognised_by_two_of_its_columns():
    """Other programs write one column of mass or size, too."""
    assert has_trackpy_columns(["frame", "x", "y", "mass", "ecc"])
    assert not has_trackpy_columns(["frame", "x", "y", "size"])


def test_a_part_of_a_trackpy_table_is_asked_for_its_unit_where_distances_are_pixels():
    """z, y, x and mass: 22 pixels apart is a question; 2.45 um, a stated scale or unit is none."""
    names = ["z", "y", "x", "frame", "particle", "mass"]
    table = table_of(tracks(15))
    pixels = table.assign(**{axis: table[axis] / 0.11 for axis in "xyz"}, mass=900.0)
    (text,) = read_table(pixels[names])[2].warnings
    assert "order of trackpy, whose coordinates are pixels" in text
    assert "(nearest particles are 22" in text
    for silent in (
        read_table(pixels[names], scale=0.11),
        read_table(table.assign(mass=900.0)[names]),
        read_table(pixels[["frame", "particle", "x", "y", "z", "mass"]]),
        read_table(pixels[names].rename(columns={a: f"{a}_um" for a in "xyz"})),
        read_table(pixels[names[:-1]]),
    ):
        assert silent[2].warnings == []
    # Planes have mostly another distance than pixels.
    alike, apart = (read_table(pixels[names], scale=s)[2].notes for s in (0.11, (0.11, 0.11, 0.25)))
    assert any("0.11 um for z as for x and y" in note for note in alike)
    assert not any("for z as" in note for note in apart)


def test_particles_at_rest_on_a_cameras_grid_are_measured():
    """Markers that rest and move in turns on a grid of 0.145: repeats are measurements."""
    rng = np.random.default_rng(31)
    walking = (np.arange(1500) // 100) % 2 == 1
    path = np.cumsum(
        np.where(walking[:, None, None], 10.0, 0.003) * rng.normal(size=(1500, 4, 3)), 0
    )
    x = (np.round((path + 500) / 0.14490) * 0.14490).round(4)
    still = (np.diff(x, axis=0) == 0).all(axis=2)
    assert still.sum() > 500
    table = perrin.positions_table(x)
    assert screen_rows(table).warnings == ()
