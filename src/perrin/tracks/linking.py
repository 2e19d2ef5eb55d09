"""Which detections are one cluster, and which cluster of the next frame it is: no ids needed."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from perrin.tracks.bonds import frames_of

if TYPE_CHECKING:
    from collections.abc import Iterator

    from perrin._arrays import Floats, Ints


# A centre is looked for within six standard deviations, for so many frames after it was lost; a
# link is sure when the other way round is a hundred times less likely.
_GATE, _MEMORY = 36.0, 10


_DOUBT = float(np.log(100.0))


# A centre of the particles found is off by up to this share of the contact distance for each one
# missing over each one found.
_LOPSIDED = 0.6


_FEWEST = 3


_NEVER = 1e6  # the cost of a link that is none


def link_clusters(frame: Ints, x: Floats, *, reach: float, contact: float, size: int) -> Ints:
    """Group the detections of every frame into clusters and follow them through time.

    Parameters
    ----------
    frame : ndarray of int, shape (N,)
        Frame number of each detection.
    x : ndarray, shape (N, d)
        Where it is, um; no NaN.
    reach : float
        Particles of a cluster are chained by distances up to this, um.
    contact : float
        Centre distance of touching particles, um.
    size : int
        Particles of a cluster.

    Returns
    -------
    ndarray of int64, shape (N,)
        Cluster of each detection, numbered by first appearance; -1 for loose ones.

    Notes
    -----
    In a frame groups grow along the shortest distances first and never beyond `size`, so clusters
    that pass each other stay apart as long as their spheres are nearer to their own than to the
    other's. Centres are linked by least squared distance over the variance of a step (from the
    median step, growing with time). Where another link is nearly as likely all tracks involved end.
    """
    smallest = min(size, x.shape[1])
    group = np.full(len(frame), -1, dtype=np.int64)
    count = 0
    for rows in frames_of(frame):
        label = touching_groups(x[rows], reach=reach, size=size, smallest=smallest)
        group[rows] = np.where(label >= 0, label + count, -1)
        count += int(label.max(initial=-1)) + 1
    if not count:
        return group
    track = _linked(_centers(frame, x, group, count, size=size, contact=contact))
    lasting = np.bincount(track, minlength=1) >= _FEWEST
    number = np.where(lasting, np.cumsum(lasting) - 1, -1)
    return np.where(group >= 0, number[track[np.maximum(group, 0)]], -1)


def touching_groups(x: Floats, *, reach: float, size: int, smallest: int) -> Ints:
    """Group the points of one frame: chains of distances up to `reach`, of at most `size` points.

    Parameters
    ----------
    x : ndarray, shape (N, d)
    reach : float
    size, smallest : int
        Groups of fewer than `smallest` points are loose.

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
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    pairs = cKDTree(x).query_pairs(reach, output_type="ndarray")
    links = coo_array((np.ones(len(pairs)), tuple(pairs.T)), shape=(len(x), len(x)))
    label = connected_components(links, directed=False)[1].astype(np.int64)
    crowded = np.flatnonzero(np.bincount(label) > size)
    if crowded.size:
        inside = np.isin(label[pairs[:, 0]], crowded)
        label = _capped(x, pairs[inside], label, size=size)
    _, label, members = np.unique(label, return_inverse=True, return_counts=True)
    number = np.where(members >= smallest, np.cumsum(members >= smallest) - 1, -1)
    return np.asarray(number[label], dtype=np.int64)


def _capped(x: Floats, pairs: Ints, label: Ints, *, size: int) -> Ints:
    """Join points along the shortest pairs first, but never to more than `size`."""
    length = np.linalg.norm(x[pairs[:, 0]] - x[pairs[:, 1]], axis=1)
    points = np.unique(pairs).tolist()
    out = label.copy()
    first = int(label.max()) + 1
    out[points] = first + np.arange(len(points))
    members = {first + k: [p] for k, p in enumerate(points)}
    for i, j in pairs[np.argsort(length, kind="stable")].tolist():
        a, b = int(out[i]), int(out[j])
        if a != b and len(members[a]) + len(members[b]) <= size:
            out[members[b]] = a
            members[a] += members.pop(b)
    return out


class _Centers(NamedTuple):
    """Groups of all frames: when, where, and the variance of their place from missing particles."""

    frame: Ints
    place: Floats
    extra: Floats


def _centers(
    frame: Ints, x: Floats, group: Ints, count: int, *, size: int, contact: float
) -> _Centers:
    rows = np.flatnonzero(group >= 0)
    n = np.bincount(group[rows], minlength=count)
    place = np.stack(
        [np.bincount(group[rows], weights=a, minlength=count) / n for a in x[rows].T], axis=1
    )
    when = np.zeros(count, dtype=np.int64)
    when[group[rows]] = frame[rows]
    return _Centers(when, place, (_LOPSIDED * contact * (size - n) / n) ** 2 / x.shape[1])


def _linked(centers: _Centers) -> Ints:
    """Return the track of each group."""
    variance = _step_variance(centers)
    track = np.full(len(centers.frame), -1, dtype=np.int64)
    active = np.empty(0, dtype=np.int64)
    count = 0
    for groups in frames_of(centers.frame):
        now = int(centers.frame[groups[0]])
        active = active[centers.frame[active] >= now - _MEMORY]
        ended = []
        for old, new, sure in _links(centers, active, groups, variance):
            ended.append(old)
            if sure:
                track[new] = track[old]
        fresh = groups[track[groups] < 0]
        track[fresh] = count + np.arange(fresh.size)
        count += fresh.size
        active = np.concatenate([np.setdiff1d(active, ended), groups])
    return track


def _step_variance(centers: _Centers) -> float:
    """Return the variance of one coordinate of a step of one frame, from the median step."""
    from scipy.spatial import cKDTree

    squares = []
    before: Ints | None = None
    for groups in frames_of(centers.frame):
        whole = groups[centers.extra[groups] == 0]
        if before is not None and before.size and whole.size:
            gap = int(centers.frame[whole[0]] - centers.frame[before[0]])
            there, nearest = cKDTree(centers.place[before]).query(centers.place[whole])
            back = cKDTree(centers.place[whole]).query(centers.place[before])[1]
            mutual = back[nearest] == np.arange(whole.size)
            squares.append(there[mutual] ** 2 / gap)
        before = whole
    d = centers.place.shape[1]
    median_chi2 = float(d * (1 - 2 / (9 * d)) ** 3)
    if not squares:
        return np.inf
    return float(np.median(np.concatenate(squares))) / median_chi2


def _links(
    centers: _Centers, old: Ints, new: Ints, variance: float
) -> Iterator[tuple[int, int, bool]]:
    """Yield the likeliest links of tracks' last groups to groups of this frame, and if sure."""
    from scipy.optimize import linear_sum_assignment

    for rows, columns, cost in _contests(centers, old, new, variance):
        n, m = cost.shape
        if n == m == 1:
            yield int(old[rows[0]]), int(new[columns[0]]), True
            continue
        # Nobody has to be linked: leaving one out costs what lies at the gate.
        full = np.full((n + m, n + m), _GATE / 2)
        full[:n, :m] = cost
        full[n:, m:] = 0.0
        i, j = linear_sum_assignment(full)
        best = full[i, j].sum()
        for a, b in zip(i.tolist(), j.tolist(), strict=True):
            if a < n and b < m:
                other = full.copy()
                other[a, b] = _NEVER
                rival = other[linear_sum_assignment(other)].sum()
                yield int(old[rows[a]]), int(new[columns[b]]), bool(rival - best > _DOUBT)


def _contests(
    centers: _Centers, old: Ints, new: Ints, variance: float
) -> Iterator[tuple[Ints, Ints, Floats]]:
    """Yield independent sets of last groups and new groups within each other's gates, with costs.

    A cost is half the squared distance over its variance; out of the gate it is above all others.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    if not old.size or not new.size:
        return
    gap = float(centers.frame[new[0]] - centers.frame[old].min())
    widest = variance * gap + 2 * float(centers.extra.max())
    reach = float(np.sqrt(_GATE * min(widest, 1e300)))
    near = cKDTree(centers.place[old]).sparse_distance_matrix(
        cKDTree(centers.place[new]), reach, output_type="coo_matrix"
    )
    step = variance * (centers.frame[new[near.col]] - centers.frame[old[near.row]])
    spread = step + centers.extra[old[near.row]] + centers.extra[new[near.col]]
    half = 0.5 * near.data**2 / np.maximum(spread, 1e-300)
    kept = half <= _GATE / 2
    i, j, half = near.row[kept], near.col[kept], half[kept]
    total = old.size + new.size
    graph = coo_array((np.ones(i.size), (i, old.size + j)), shape=(total, total))
    part = connected_components(graph, directed=False)[1]
    order = np.argsort(part[i], kind="stable")
    for edges in np.split(order, np.flatnonzero(np.diff(part[i[order]])) + 1):
        if edges.size:
            rows, a = np.unique(i[edges], return_inverse=True)
            columns, b = np.unique(j[edges], return_inverse=True)
            cost = np.full((rows.size, columns.size), _NEVER)
            cost[a, b] = half[edges]
            yield rows, columns, cost
