"""Points in groups: rows of one frame or one key, connected pairs, and touching particles."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from typing import Any

    import pandas as pd
    from numpy.typing import NDArray

    from perrin._arrays import Floats, Ints

# Particles nearer than this number of contact distances touch. The next shell of a packing begins
# at 1.41 diameters.
TOUCHING_REACH = 1.3


def frames_of(frame: Ints) -> Iterator[Ints]:
    """Yield the rows of each frame, in the order of the frame numbers.

    Parameters
    ----------
    frame : ndarray of int, shape (N,)
        Frame number of each row.

    Yields
    ------
    ndarray of int
        Rows of one frame, in their order.

    Examples
    --------
    >>> [rows.tolist() for rows in frames_of(np.array([5, 3, 5]))]
    [[1], [0, 2]]
    """
    order = np.argsort(frame, kind="stable")
    yield from np.split(order, np.flatnonzero(np.diff(frame[order])) + 1)


def coordinates(table: pd.DataFrame) -> Floats:
    """Return the coordinates (N, d) of a table with the columns x, y and perhaps z.

    Examples
    --------
    >>> import pandas as pd
    >>> coordinates(pd.DataFrame({"y": [2, 3], "x": [0.0, np.nan]}))
    array([[ 0.,  2.],
           [nan,  3.]])
    """
    columns = [
        table[axis].to_numpy(dtype=np.float64, na_value=np.nan) for axis in "xyz" if axis in table
    ]
    return np.stack(columns, axis=1)


def are_distinct(columns: Sequence[NDArray[Any]]) -> bool:
    """Return whether columns are whole numbers of which no two rows are the same.

    Parameters
    ----------
    columns : sequence of ndarray, shape (N,)

    Returns
    -------
    bool
        False for columns of other kinds, and for numbers whose combinations exceed int64.

    Examples
    --------
    >>> frame, particle = np.array([0, 0, 1]), np.array([3, 4, 3])
    >>> are_distinct([frame, particle]), are_distinct([frame])
    (True, False)
    """
    if any(column.dtype.kind != "i" or not column.size for column in columns):
        return False
    # Where the column that changes least comes first, the keys of most tables rise row by row.
    changes = [np.count_nonzero(column[1:] != column[:-1]) for column in columns]
    key, combinations = np.zeros(len(columns[0]), dtype=np.int64), 1
    for k in np.argsort(changes, kind="stable").tolist():
        low, high = int(columns[k].min()), int(columns[k].max())
        combinations *= high - low + 1
        if combinations > np.iinfo(np.int64).max:
            return False
        key *= high - low + 1
        key += columns[k]
        key -= low
    if not (key[1:] > key[:-1]).all():
        key.sort()
    return bool((key[1:] > key[:-1]).all())


def connected_groups(first: Ints, second: Ints, *, count: int) -> Ints:
    """Return the connected component of each of `count` points that are joined in pairs.

    Parameters
    ----------
    first, second : ndarray of int, shape (P,)
        The two points of each pair.
    count : int
        Number of points.

    Returns
    -------
    ndarray of int64, shape (count,)

    Examples
    --------
    >>> connected_groups(np.array([0, 2]), np.array([2, 4]), count=5)
    array([0, 1, 0, 2, 0])
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    graph = coo_array((np.ones(len(first)), (first, second)), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1], dtype=np.int64)


def touching_groups(x: Floats, *, reach: float, size: int, smallest: int) -> Ints:
    """Group the points of one frame: chains of distances up to `reach`, of at most `size` points.

    Chains of more points are divided: points are joined from the nearest pair on, but never to
    more than `size`.

    Parameters
    ----------
    x : ndarray, shape (N, d)
    reach : float
        Largest distance of touching points, in the unit of `x`.
    size, smallest : int
        Largest and smallest number of points of a group; points of smaller groups are loose.

    Returns
    -------
    ndarray of int64, shape (N,)
        Group of each point from 0 on, -1 for loose points.

    Examples
    --------
    >>> x = np.array([[0.0], [1.0], [2.2], [3.2]])
    >>> touching_groups(x, reach=1.3, size=2, smallest=2)
    array([0, 0, 1, 1])
    """
    from scipy.spatial import cKDTree

    pairs = cKDTree(x).query_pairs(reach, output_type="ndarray")
    label = connected_groups(pairs[:, 0], pairs[:, 1], count=len(x))
    crowded = np.flatnonzero(np.bincount(label) > size)
    if crowded.size:
        pairs = pairs[np.isin(label[pairs[:, 0]], crowded)]
        length = np.linalg.norm(x[pairs[:, 0]] - x[pairs[:, 1]], axis=1)
        points = np.unique(pairs).tolist()
        fresh = int(label.max()) + 1
        label[points] = fresh + np.arange(len(points))
        members = {fresh + k: [point] for k, point in enumerate(points)}
        for i, j in pairs[np.argsort(length, kind="stable")].tolist():
            a, b = int(label[i]), int(label[j])
            if a != b and len(members[a]) + len(members[b]) <= size:
                label[members[b]] = a
                members[a] += members.pop(b)
    _, label, counts = np.unique(label, return_inverse=True, return_counts=True)
    number = np.where(counts >= smallest, np.cumsum(counts >= smallest) - 1, -1)
    return np.asarray(number[label], dtype=np.int64)


def near_pairs(
    frame: Ints, code: Ints, x: Floats, *, reach: float, fewest: int
) -> tuple[Ints, Ints]:
    """Return the pairs of particles that are near each other in some frames.

    Parameters
    ----------
    frame, code : ndarray of int, shape (N,)
        Frame and particle (from 0) of every detection.
    x : ndarray, shape (N, d)
        Coordinates of each detection, um; no NaN.
    reach : float
        Largest distance of near particles, um.
    fewest : int
        Number of frames in which the particles of a pair are near each other, at least.

    Returns
    -------
    pairs : ndarray of int, shape (P, 2)
        Two particles, the smaller number first.
    count : ndarray of int, shape (P,)
        Number of frames in which they are near each other.

    Examples
    --------
    >>> x = np.array([[0.0], [1.0], [5.0], [0.0], [1.1], [6.0]])
    >>> near_pairs(np.repeat([0, 1], 3), np.tile(np.arange(3), 2), x, reach=1.3, fewest=2)
    (array([[0, 1]]), array([2]))
    """
    from scipy.spatial import cKDTree

    particles = int(code.max(initial=0)) + 1
    keys = [np.empty(0, dtype=np.int64)]
    for rows in frames_of(frame):
        near = cKDTree(x[rows]).query_pairs(reach, output_type="ndarray")
        pairs = np.sort(code[rows[near]], axis=1)
        keys.append(pairs[:, 0] * particles + pairs[:, 1])
    key, count = np.unique(np.concatenate(keys), return_counts=True)
    key, count = key[count >= fewest], count[count >= fewest]
    return np.stack(np.divmod(key, particles), axis=1), count


def group_quantiles(group: Ints, values: Floats, count: int, *, q: float = 0.5) -> Floats:
    """Return a quantile of the values in each group, NaN for none.

    Parameters
    ----------
    group : ndarray of int, shape (N,)
        Group of each value, 0 to count - 1.
    values : ndarray, shape (N,)
    count : int
        Number of groups.
    q : float
        Between the ordered values quantiles are interpolated linearly.

    Returns
    -------
    ndarray, shape (count,)

    Examples
    --------
    >>> group_quantiles(np.array([0, 0, 2]), np.array([1.0, 2.0, 5.0]), 3)
    array([1.5, nan, 5. ])
    """
    size = np.bincount(group, minlength=count)
    order = np.argsort(values)
    # Numbers of two bytes are sorted by counting.
    order = order[np.argsort(group[order].astype(np.min_scalar_type(count)), kind="stable")]
    ordered = np.append(values[order], np.nan)
    place = q * np.maximum(size - 1, 0)
    low = np.cumsum(size) - size + place.astype(np.int64)
    share = place % 1.0
    between = (1 - share) * ordered[low] + share * ordered[np.minimum(low + 1, len(values))]
    quantile: Floats = np.where(size == 0, np.nan, np.where(share > 0, between, ordered[low]))
    return quantile
