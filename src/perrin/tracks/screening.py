"""Which rows of a track table are no measurements, and whether its distances are in um."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from perrin._arrays import Bools, Floats, Ints, present
from perrin._text import counted
from perrin.motion.degenerate import mean_present
from perrin.motion.residuals import frames_last, median_present
from perrin.tracks.groups import coordinates, group_quantiles

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    import pandas as pd

# Columns that trackpy writes in addition to its coordinates, which are in pixels.
TRACKPY_COLUMNS = ("mass", "size", "ecc", "signal", "raw_mass", "ep")

CENTRE_REMOVED = (
    "the centre does not move: no D_T (the mean of the particles' coordinates is the same in every "
    "frame to rounding, as in a table that was centred or from which the common drift was "
    "subtracted)"
)

# Colloidal particles are between these distances apart, um.
_LEAST_DISTANCE, _MOST_DISTANCE = 0.05, 50.0
# Particles that trackpy resolves are at least 5 pixels apart; few colloids are 5 um apart.
_LEAST_PIXELS = 5.0

# Expected number, and probability, of coincidences below which they are not due to chance.
_COINCIDENCE_LEVEL = 1e-3

# A placeholder is entered and left by steps of over 5 times the particle's median step, which a
# Brownian step in three dimensions exceeds with a probability of 1e-12; one point is a placeholder
# if that happens in 3 rows, the origin in one.
_PLACEHOLDER_STEP, _PLACEHOLDER_ROWS = 5.0, 3

# A particle needs this number of steps before its repeats are judged; from steps up to this number
# of rows from a repeat follows how often a coordinate stays the same by rounding alone.
_FEWEST_MOVES, _ROWS_AROUND = 8, 5

# A tenth of the steps of a moving particle are shorter than 0.13 of their standard deviation on an
# axis; the step that follows a repeat is usually over 5 times as long on one of the axes.
_SMALL_STEP_QUANTILE, _MOVING_STEP = 0.1, 5.0

# A repeat by rounding has to be exceeded by this factor.
_REPEAT_EXCESS = 3.0

# A coordinate farther from every other particle than this number of body sizes is no measurement.
_FAR_SIZES = 20.0

# Particles move if they spread over this number of rounding errors; a centre that varies by less
# than this share of the spread was removed, whatever the rounding.
_MOVING_SPREAD, _STILL_SHARE = 10.0, 1e-6

# Values lie on a lattice if their differences are multiples of one step to the first share of it; a
# ratio of two steps is whole to the second.
_LATTICE_TOLERANCE, _WHOLE_TOLERANCE = 1e-3, 0.02

# About this many coordinates are compared at once; more do not stay in the processor's cache.
_MOST_COORDINATES = 100_000

_POINTS_SHOWN = 3  # placeholders that a warning names

_DISTANCE_FRAMES = 60  # in which the nearest particles are searched for


@dataclass(frozen=True, eq=False)
class Screened:
    """A track table without rows that are no measurements, and sentences on these rows.

    Attributes
    ----------
    table : pandas.DataFrame
        The same rows; the coordinates of those that are no measurements are NaN.
    notes : tuple of str
        Sentence on rows without coordinates.
    warnings : tuple of str
        One sentence per kind of row whose coordinates are no measurements.
    """

    table: pd.DataFrame
    notes: tuple[str, ...]
    warnings: tuple[str, ...]


def screen_rows(table: pd.DataFrame) -> Screened:
    """Find the rows of a track table whose coordinates are no measurements.

    Parameters
    ----------
    table : pandas.DataFrame
        Columns frame, particle, x, y[, z] and perhaps cluster, as `check_tracks` returns it.

    Returns
    -------
    Screened

    Notes
    -----
    Two kinds are found. A *placeholder* is a point that is written for a lost particle, such as
    (0, 0, 0): rows at exactly the same place that is entered and left by steps of more than 5 times
    the particle's median step, in 3 rows or more (the origin: in one), or to which a particle
    returns more often than the resolution of the table allows. A *repeat* has all coordinates of
    the particle's previous row.

    A particle at rest in a table of few digits repeats its place as well. The number of repeats by
    rounding is n product_a p_a for n steps, with p_a the probability that coordinate a stays:
    the resolution over the median step or, if larger, the share of steps near the repeats in which
    a alone (not all coordinates) stays. Repeats are reported where resolution and step allow fewer
    than 0.001, or where the episodes of repeats exceed the expected number with a probability
    (Poisson) of less than 0.001 for the table.

    Examples
    --------
    >>> import pandas as pd
    >>> x = 9 + np.random.default_rng(0).normal(size=(40, 2)).cumsum(axis=0)
    >>> x[20] = x[19]
    >>> table = pd.DataFrame({"frame": range(40), "particle": 0, "x": x[:, 0], "y": x[:, 1]})
    >>> screened = screen_rows(table)
    >>> screened.warnings[0][:56]
    '1 row of 1 particle with all coordinates of the particle'
    >>> int(screened.table["x"].isna().sum())
    1
    """
    import pandas as pd

    x = coordinates(table)
    frame = table["frame"].to_numpy(dtype=np.int64)
    code = table["particle"].factorize(use_na_sentinel=False)[0].astype(np.int64)
    if "cluster" in table:
        cluster, clusters = table["cluster"].factorize(use_na_sentinel=False)
        code = pd.factorize(code * len(clusters) + cluster)[0].astype(np.int64)
    empty = ~present(x)
    rows = np.lexsort((frame, code))
    rows = rows[~empty[rows]] if empty.any() else rows
    own, points = code.take(rows), x.take(rows, axis=0)
    at_placeholder = placeholder_rows(own, points)
    filled, rest = rows[at_placeholder], rows
    if filled.size:
        left = ~at_placeholder
        rest, own, points = rows[left], own[left], points[left]
    repeated = rest[repeated_rows(own, points)]
    notes = _rows_sentence(
        np.flatnonzero(empty), frame, code, "without coordinates (NaN)", "they count as missing"
    )
    points, times = np.unique(x[filled], axis=0, return_counts=True)
    frequent = points[np.argsort(-times, kind="stable")[:_POINTS_SHOWN]]
    places = [f"({', '.join(f'{c:.6g}' for c in point)})" for point in frequent]
    if len(points) > _POINTS_SHOWN:
        places[-1] += f" or {counted(len(points) - _POINTS_SHOWN, 'more point')}"
    placeholders = _rows_sentence(
        filled,
        frame,
        code,
        f"at exactly {' or '.join(places)}",
        "a placeholder for a lost particle, no measurement; they count as missing",
    )
    repeats = _rows_sentence(
        repeated,
        frame,
        code,
        "with all coordinates of the particle's previous row, to the last digit",
        "no measurements; they count as missing",
    )
    bad = np.concatenate([filled, repeated])
    if bad.size:
        table = table.copy()
        x[bad] = np.nan
        for axis, values in zip("xyz", x.T, strict=False):
            table[axis] = values
    return Screened(table, notes, placeholders + repeats)


def far_points(x: Floats) -> Bools:
    """Mark the points of one cluster that are farther from the rest than 20 times its size.

    The size is the largest of the median distances between its particles. A point is marked where
    it is that far from every other particle of the frame; where all are that far from each other it
    is unknown which are right, and all are marked.

    Parameters
    ----------
    x : ndarray, shape (T, n, d)
        Positions, um, NaN where missing.

    Returns
    -------
    ndarray of bool, shape (T, n)

    Examples
    --------
    >>> x = np.tile([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], (9, 1, 1))
    >>> x[4, 2] = 900.0
    >>> np.argwhere(far_points(x)).tolist()
    [[4, 2]]
    """
    n = x.shape[1]
    nearest = np.full(x.shape[:2], np.inf)
    size = 0.0
    for i in range(n - 1):
        distance = np.linalg.norm(x[:, i + 1 :] - x[:, i : i + 1], axis=2)
        for k in np.flatnonzero(np.isfinite(distance).any(axis=0)):
            size = max(size, float(np.nanmedian(distance[:, k])))
        distance = np.where(np.isfinite(distance), distance, np.inf)
        nearest[:, i] = np.minimum(nearest[:, i], distance.min(axis=1))
        nearest[:, i + 1 :] = np.minimum(nearest[:, i + 1 :], distance)
    return np.asarray(np.isfinite(nearest) & (nearest > _FAR_SIZES * size))


def far_points_of_each(positions: Sequence[Floats]) -> list[Bools]:
    """Find the points of several clusters that lie far from the rest, as `far_points`.

    Parameters
    ----------
    positions : sequence of ndarray, shape (T, n, d)

    Returns
    -------
    list of ndarray of bool, shape (T, n)

    Examples
    --------
    >>> x = np.tile([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], (9, 1, 1))
    >>> far_points_of_each([x, x + 1.0])[1].any()
    np.False_
    """
    found = [np.zeros(x.shape[:2], dtype=np.bool_) for x in positions]
    for rows in of_equal_shape(positions):
        x = frames_last([positions[k] for k in rows])
        if x.shape[1] < 2:
            continue
        # A far point is farther from all others than many times any median distance. No distance
        # exceeds the diagonal of the box around the particles of a frame.
        pair, box = x[:, 1] - x[:, 0], np.fmax.reduce(x, axis=1) - np.fmin.reduce(x, axis=1)
        apart, diagonal = (np.sqrt(np.einsum("bdt,bdt->bt", a, a)) for a in (pair, box))
        limit = _FAR_SIZES * median_present(apart)
        largest = np.nan_to_num(diagonal).max(axis=1, initial=0.0)
        for i in np.flatnonzero(~(largest <= limit)).tolist():
            found[rows[i]] = far_points(positions[rows[i]])
    return found


def of_equal_shape(arrays: Sequence[Floats]) -> list[list[int]]:
    """Return the numbers of arrays of the same shape, in groups that fit the processor's cache.

    Examples
    --------
    >>> of_equal_shape([np.zeros((5, 4, 3)), np.zeros((6, 4, 3)), np.zeros((5, 4, 3))])
    [[0, 2], [1]]
    """
    alike: dict[tuple[int, ...], list[int]] = {}
    for k, one in enumerate(arrays):
        alike.setdefault(one.shape, []).append(k)
    groups = []
    for shape, rows in alike.items():
        at_once = max(1, _MOST_COORDINATES // max(int(np.prod(shape)), 1))
        groups += [rows[low : low + at_once] for low in range(0, len(rows), at_once)]
    return groups


def far_sentence(far: Bools, frames: Ints) -> str:
    """State which points of one cluster are left out because they are too far from the rest.

    Parameters
    ----------
    far : ndarray of bool, shape (T, n)
        As `far_points` returns it, with at least one point marked.
    frames : ndarray of int, shape (T,)

    Returns
    -------
    str

    Examples
    --------
    >>> far_sentence(np.array([[False, False], [True, False]]), np.array([7, 8]))[:51]
    '1 point of 1 particle is farther from the rest than'
    """
    points, particles = int(far.sum()), int(far.any(axis=0).sum())
    first = int(frames[np.flatnonzero(far.any(axis=1))[0]])
    verb = "is" if points == 1 else "are"
    kind = "no measurement" if points == 1 else "no measurements"
    return (
        f"{_count(points, 'point')} of {_count(particles, 'particle')} {verb} farther from the "
        f"rest than {_FAR_SIZES:.0f} times the body's size, first in frame {first}: {kind}; left "
        "out"
    )


def centre_removed(x: Floats) -> bool:
    """Return whether the mean of the particles stays the same to rounding while they move.

    Parameters
    ----------
    x : ndarray, shape (T, n, d)
        Coordinates of the particles of one cluster, um, NaN where missing.

    Returns
    -------
    bool
        False also for two frames or fewer, and for a single particle, where it is unknown.

    Notes
    -----
    Coordinates with rounding errors of at most q / 2 have a mean with an error of at most q / 2,
    where q is the resolution of the table. Particles move if the median of their standard
    deviations is over 10 times that. Means are taken over the frames that hold all particles, or,
    if these are not constant, over the particles seen in each frame.

    Examples
    --------
    >>> x = np.random.default_rng(1).normal(size=(50, 4, 3)).cumsum(axis=0)
    >>> centre_removed(x), centre_removed(x - x.mean(axis=1, keepdims=True))
    (False, True)
    """
    seen = present(x)
    several = seen.sum(axis=1) >= 2
    for rows in (seen.all(axis=1) & several, several):
        if rows.sum() <= 2:
            continue
        some, here = x[rows], seen[rows]
        steps = [lattice_step(axis[here]) for axis in np.moveaxis(some, 2, 0)]
        rounding = np.array(steps) / 2
        centre = np.nanmean(some, axis=1)
        spread = np.sqrt(np.nanmedian(np.nanvar(some, axis=0), axis=0))
        still = np.ptp(centre, axis=0) <= np.maximum(2 * rounding, _STILL_SHARE * spread)
        if still.all() and (spread > _MOVING_SPREAD * rounding).any():
            return True
    return False


def centres_removed(positions: Sequence[Floats]) -> list[bool]:
    """Return which of several clusters have a mean that stays the same, as `centre_removed`.

    Parameters
    ----------
    positions : sequence of ndarray, shape (T, n, d)

    Returns
    -------
    list of bool

    Notes
    -----
    The resolution of a coordinate is at most the smallest step of the first particle, so that a
    mean that moves by more is not constant; only the other clusters are tested in detail.

    Examples
    --------
    >>> x = np.random.default_rng(1).normal(size=(50, 4, 3)).cumsum(axis=0)
    >>> centres_removed([x, x - x.mean(axis=1, keepdims=True)])
    [False, True]
    """
    removed = [False] * len(positions)
    for rows in of_equal_shape(positions):
        x = frames_last([positions[k] for k in rows])
        seen = present(np.moveaxis(x, 2, -1))
        several = seen.sum(axis=1) >= 2
        low, high = np.fmin.reduce(x, axis=(1, 3)), np.fmax.reduce(x, axis=(1, 3))
        rounding = 8 * float(np.finfo(np.float64).eps) * np.maximum(np.abs(low), np.abs(high))
        mean = mean_present(x, axis=1)
        clear = np.ones(len(rows), dtype=np.bool_)
        for whole in (seen.all(axis=1) & several, several):
            first = np.where(whole[:, None], x[:, 0], np.nan)
            step = np.abs(first[..., 1:] - first[..., :-1])
            step = np.where(step > rounding[..., None], step, np.inf)
            finest = step.min(axis=2, initial=np.inf)
            centre = np.where(whole[:, None], mean, np.nan)
            moved = np.fmax.reduce(centre, axis=2) - np.fmin.reduce(centre, axis=2)
            # No standard deviation exceeds the range.
            moves = (moved > np.maximum(finest, _STILL_SHARE * (high - low))).any(axis=1)
            clear &= moves | (whole.sum(axis=1) <= 2)
            if seen.all():
                break
        for i in np.flatnonzero(~clear).tolist():
            removed[rows[i]] = centre_removed(positions[rows[i]])
    return removed


def distance_notes(
    table: pd.DataFrame, *, scale_given: bool, trackpy_columns: bool, trackpy_order: bool = False
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """State the distance of nearest particles, and warn where it is unusual for colloids.

    Parameters
    ----------
    table : pandas.DataFrame
        Columns frame, particle, x, y[, z]; coordinates in um after scaling.
    scale_given : bool
        Whether a scale other than 1 was given.
    trackpy_columns : bool
        Whether the table has trackpy's own columns: `has_trackpy_columns`.
    trackpy_order : bool
        Whether the columns are in trackpy's order: `has_trackpy_order`. A table in um that came
        from trackpy has it as well; it is asked for its unit where the distance is one of pixels.

    Returns
    -------
    notes, warnings : tuple of str
        The distance is that to the nearest particle in the same frame, the median over up to 60
        frames for each particle, and the mean over the particles. No notes where no frame holds two
        particles.

    Examples
    --------
    >>> import pandas as pd
    >>> table = pd.DataFrame({"frame": 0, "particle": [0, 1], "x": [0.0, 2.5], "y": 0.0})
    >>> distance_notes(table, scale_given=False, trackpy_columns=False)
    (('nearest particles are 2.5 um apart on average',), ())
    """
    from scipy.spatial import cKDTree

    x = coordinates(table)
    frame = table["frame"].to_numpy(dtype=np.int64)
    frames = np.sort(table["frame"].unique()).astype(np.int64)
    spaced = np.linspace(0, len(frames) - 1, _DISTANCE_FRAMES).astype(int)
    some = frames[spaced] if len(frames) else frames
    rows = np.flatnonzero(present(x) & np.isin(frame, some))
    code = table["particle"].iloc[rows].factorize()[0].astype(np.int64)
    # Frames are so far apart along an axis of their own that the nearest particle is in the same.
    axes = np.ascontiguousarray(x[rows].T)
    apart_by, nearest = 1.0, np.empty(0)
    if rows.size:
        apart_by += 2 * float(np.ptp(axes, axis=1).sum())
        placed = np.column_stack([*axes, apart_by * np.searchsorted(some, frame[rows])])
        nearest = cKDTree(placed, balanced_tree=False).query(placed, 2)[0][:, 1]
    known = nearest < 0.75 * apart_by
    if not known.any():
        return (), ()
    medians = group_quantiles(code[known], nearest[known], int(code.max()) + 1)
    apart = float(np.nanmean(medians))
    text = f"nearest particles are {apart:.3g} um apart on average"
    warnings = []
    if trackpy_columns and not scale_given:
        warnings.append(
            "the table has columns that trackpy writes, whose coordinates are pixels, but the "
            f"scale is 1 um per unit ({text}): state the um per pixel with scale"
        )
    elif trackpy_order and not scale_given and _LEAST_PIXELS <= apart <= _MOST_DISTANCE:
        warnings.append(
            "the columns are in the order of trackpy, whose coordinates are pixels, and the scale "
            f"is 1 um per unit ({text}): state the um per pixel with scale; if the coordinates are "
            "in um, name the columns x_um, y_um and z_um"
        )
    if not _LEAST_DISTANCE <= apart <= _MOST_DISTANCE:
        remedy = "correct scale" if scale_given else "state the um per unit with scale"
        warnings.append(
            f"{text}, outside {_LEAST_DISTANCE:g} to {_MOST_DISTANCE:g} um: the coordinates are "
            f"probably not in um; {remedy}"
        )
    return (text,), tuple(warnings)


def has_trackpy_columns(columns: Iterable[object]) -> bool:
    """Return whether column names are those of trackpy: two or more of its own.

    Examples
    --------
    >>> has_trackpy_columns(["y", "x", "mass", "size", "ecc", "frame", "particle"])
    True
    """
    return len(set(columns) & set(TRACKPY_COLUMNS)) >= 2


def has_trackpy_order(columns: Iterable[object]) -> bool:
    """Return whether a table has a mass, and its coordinates in trackpy's order: z, y, x.

    Examples
    --------
    >>> has_trackpy_order(["z", "y", "x", "frame", "particle", "mass"])
    True
    >>> has_trackpy_order(["frame", "particle", "x", "y", "mass"])
    False
    """
    names = list(columns)
    axes = [name for name in names if name in ("x", "y", "z")]
    return "mass" in names and axes in (["z", "y", "x"], ["y", "x"])


def placeholder_rows(code: Ints, x: Floats) -> Bools:
    """Mark the rows at points that are written for lost particles, such as (0, 0, 0).

    Parameters
    ----------
    code : ndarray of int, shape (N,)
        Particle of each row, from 0; rows are sorted by particle and frame.
    x : ndarray, shape (N, d)
        Coordinates without NaN.

    Returns
    -------
    ndarray of bool, shape (N,)

    Examples
    --------
    >>> x = 9 + np.random.default_rng(0).normal(size=(40, 2)).cumsum(axis=0)
    >>> x[20] = 0.0
    >>> np.flatnonzero(placeholder_rows(np.zeros(40, dtype=int), x)).tolist()
    [20]
    """
    marked = np.zeros(len(code), dtype=np.bool_)
    particles = int(code.max(initial=-1)) + 1
    # Only points that occur twice, and the origin, may be placeholders.
    suspected = np.zeros(particles, dtype=np.bool_)
    suspected[code[_rows_of_repeated_values(x)]] = True
    suspected[code[_are_equal(x, np.zeros_like(x[:1]))]] = True
    rows = np.flatnonzero(suspected[code])
    if rows.size:
        marked[rows] = _at_placeholders(code[rows], x[rows], particles)
    return marked


def _rows_of_repeated_values(x: Floats) -> Ints:
    """Return rows that include all rows of points that occur more than once."""
    rows = np.arange(len(x))
    for axis in range(x.shape[1]):
        values = x[rows, axis]
        ordered = np.sort(values)
        repeated = ordered[1:][ordered[1:] == ordered[:-1]]
        if not repeated.size:
            return rows[:0]
        place = np.minimum(np.searchsorted(repeated, values), repeated.size - 1)
        rows = rows[repeated[place] == values]
    return rows


def _are_equal(x: Floats, y: Floats) -> Bools:
    """Return which points (N, d) are equal to others (N or 1, d)."""
    equal: Bools = x[:, 0] == y[:, 0]
    for axis in range(1, x.shape[1]):
        equal &= x[:, axis] == y[:, axis]
    return equal


def _at_placeholders(code: Ints, x: Floats, particles: int) -> Bools:
    """Mark the rows at placeholders among all rows of some of the particles of a table."""
    # A number for each distinct point.
    order = np.lexsort(x.T)
    place = np.empty(len(x), dtype=np.int64)
    place[order] = np.append(0, np.cumsum((np.diff(x[order], axis=0) != 0).any(axis=1)))
    # Unbroken stays of particles at one place, with the smaller of the steps there and away in
    # units of the particle's median step.
    first = np.flatnonzero(np.append(True, (np.diff(code) != 0) | (np.diff(place) != 0)))
    particle, stay_place = code[first], place[first]
    step = np.linalg.norm(np.diff(x[first], axis=0), axis=1)
    same = np.diff(particle) == 0
    usual = group_quantiles(particle[1:][same], step[same], particles)
    usual[np.bincount(particle[1:][same], minlength=particles) < _FEWEST_MOVES] = np.inf
    step[~same] = np.inf
    leap = np.minimum(np.append(np.inf, step), np.append(step, np.inf))
    leap[np.isinf(leap)] = np.nan
    leap /= usual[particle]
    count = int(place.max()) + 1
    rows = np.bincount(place, minlength=count)
    known = np.bincount(stay_place, weights=np.isfinite(leap), minlength=count)
    leaps = np.bincount(stay_place, weights=leap > _PLACEHOLDER_STEP, minlength=count)
    origin = np.zeros(count, dtype=np.bool_)
    origin[place] = ~x.any(axis=1)
    brisk = 2 * np.bincount(stay_place, weights=leap >= 1, minlength=count) > known
    reached = ((rows >= _PLACEHOLDER_ROWS) | origin) & (2 * leaps > known)
    often = _revisited_places(code, x, particle, stay_place, origin, particles)
    reached[often] |= brisk[often]
    marked: Bools = reached[place]
    return marked


def _revisited_places(
    code: Ints, x: Floats, particle: Ints, place: Ints, origin: Bools, particles: int
) -> Ints:
    """Return the places to which a particle returned more often than rounding explains.

    `particle` and `place` are those of each stay, `origin` marks the place at the origin, and
    `particles` is their number in the table.
    """
    from scipy.special import pdtrc

    both, times = np.unique(place * particles + particle, return_counts=True)
    place, particle = np.divmod(both[times > 1], particles)
    times = times[times > 1]
    found = [np.empty(0, dtype=np.int64)]
    for one in np.unique(particle):
        own = particle == one
        start, stop = np.searchsorted(code, [one, one + 1])
        rows = int(stop - start)
        returns = rows * float(np.prod(rounding_chances(x[start:stop])))
        # The origin is known beforehand; any other row may be the first visit.
        known = origin[place[own]]
        level = pdtrc(times[own] - np.where(known, 1, 2), returns) * np.where(known, 1, rows)
        found.append(place[own][level * particles < _COINCIDENCE_LEVEL])
    return np.unique(np.concatenate(found))


def repeated_rows(code: Ints, x: Floats) -> Bools:
    """Mark the rows that repeat the previous row of their particle.

    Parameters
    ----------
    code : ndarray of int, shape (N,)
        Particle of each row, from 0; rows are sorted by particle and frame.
    x : ndarray, shape (N, d)
        Coordinates without NaN.

    Returns
    -------
    ndarray of bool, shape (N,)

    Examples
    --------
    >>> x = np.random.default_rng(0).normal(size=(40, 2)).cumsum(axis=0)
    >>> x[20] = x[19]
    >>> np.flatnonzero(repeated_rows(np.zeros(40, dtype=int), x)).tolist()
    [20]
    """
    from scipy.special import pdtrc

    repeated = np.zeros(len(code), dtype=np.bool_)
    if len(code) < 2:
        return repeated
    held = (np.diff(code) == 0) & _are_equal(x[1:], x[:-1])
    particles = int(code.max()) + 1
    window = np.ones(2 * _ROWS_AROUND + 1)
    for particle in np.unique(code[1:][held]):
        rows = np.arange(*np.searchsorted(code, [particle, particle + 1]))
        stays = held[rows[1:] - 1]
        if np.count_nonzero(~stays) < _FEWEST_MOVES:
            continue
        # A particle at rest on the grid of a camera repeats its place too, and leaves it by one
        # unit of the grid, which is also the smallest of its steps.
        step = np.abs(np.diff(x[rows], axis=0))
        small = [
            np.quantile(s[s > 0], _SMALL_STEP_QUANTILE) if (s > 0).any() else np.inf for s in step.T
        ]
        after = step[1:][stays[:-1] & ~stays[1:]]
        if not len(after) or float(np.median((after / small).max(axis=1))) < _MOVING_STEP:
            continue
        # Near repeats: the share of steps in which one coordinate stays and others do not.
        around = np.convolve(stays, window, mode="full")[_ROWS_AROUND : _ROWS_AROUND + len(stays)]
        zero = step[(around > 0.5) & ~stays] == 0
        others_move = zero.sum(axis=1, keepdims=True) - zero < x.shape[1] - 1
        alone = ((zero & others_move).sum(axis=0) + 1) / (others_move.sum(axis=0) + 1)
        chance = rounding_chances(x[rows])
        by_rounding = len(stays) * float(np.prod(chance))
        near_by = len(stays) * float(np.prod(np.maximum(chance, alone)))
        episodes = int(np.count_nonzero(np.diff(np.append(0, stays)) == 1))
        too_many = stays.sum() >= _REPEAT_EXCESS * near_by and (
            float(pdtrc(episodes - 1, near_by)) * particles < _COINCIDENCE_LEVEL
        )
        if too_many or by_rounding * particles < _COINCIDENCE_LEVEL:
            repeated[rows[1:]] = stays
    return repeated


def rounding_chances(x: Floats) -> Floats:
    """Return the probability that a step leaves each coordinate of a track the same by rounding.

    Parameters
    ----------
    x : ndarray, shape (T, d)

    Returns
    -------
    ndarray, shape (d,)

    Examples
    --------
    >>> x = np.array([[0.0, 0.0], [0.5, 1.0], [1.0, 3.0], [1.5, 4.0], [2.1, 6.0]])
    >>> rounding_chances(x).round(2).tolist()
    [0.2, 0.67]
    """
    step = np.abs(np.diff(x, axis=0))
    median = np.median(step[step.any(axis=1)], axis=0) if step.any() else np.zeros(x.shape[1])
    # Where digits count from the first that is not zero, the largest values are the coarsest.
    large = np.abs(x) >= np.median(np.abs(x), axis=0)
    lattice = [
        max(lattice_step(values), lattice_step(values[upper]))
        for values, upper in zip(x.T, large.T, strict=True)
    ]
    chance = np.divide(lattice, median, out=np.ones(len(median)), where=median > 0)
    return np.asarray(np.minimum(chance, 1.0))


def lattice_step(values: Floats) -> float:
    """Return the step of the lattice on which all values lie, or their rounding error.

    Parameters
    ----------
    values : ndarray, shape (N,)

    Returns
    -------
    float

    Examples
    --------
    >>> round(lattice_step(np.array([0.3, 0.9, 1.2])), 12)
    0.3
    """
    distinct = np.unique(values)
    rounding = 8 * float(np.finfo(np.float64).eps) * float(np.abs(values).max(initial=0.0))
    gaps = np.diff(distinct)
    gaps = gaps[gaps > rounding]
    if not gaps.size:
        return rounding
    step = float(gaps.min())
    # Euclid's algorithm for all differences; a step that divides the smallest and the largest is
    # refined by them, so that rounding errors do not grow.
    while rounding < _LATTICE_TOLERANCE * step:
        off = np.abs(gaps - np.round(gaps / step) * step)
        off = off[off > _LATTICE_TOLERANCE * step]
        if not off.size:
            return step
        finer = float(off.min())
        for gap in (float(gaps.min()), float(gaps.max())):
            times = round(gap / finer)
            finer = gap / times if abs(gap - times * finer) <= _WHOLE_TOLERANCE * finer else finer
        step = min(finer, 0.75 * step)
    return rounding


def _rows_sentence(rows: Ints, frame: Ints, code: Ints, what: str, meaning: str) -> tuple[str, ...]:
    """State how many rows of how many particles are of a kind, and the first frame."""
    if not rows.size:
        return ()
    counted = f"{_count(rows.size, 'row')} of {_count(np.unique(code[rows]).size, 'particle')}"
    return (f"{counted} {what}, first in frame {frame[rows].min()}: {meaning}",)


def _count(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"
