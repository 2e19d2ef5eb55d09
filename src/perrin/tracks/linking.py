"""Which detections form one cluster, and which cluster of the next frame it is."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from perrin.motion.residuals import median_chi2
from perrin.motion.rods import SETTLED_LOG_ODDS
from perrin.tracks.groups import connected_groups, frames_of, touching_groups

if TYPE_CHECKING:
    from collections.abc import Iterator

    from perrin._arrays import Floats, Ints

# A centre is searched for within six standard deviations (squared: the gate), for this number of
# frames after it was lost.
_GATE, _FRAMES_REMEMBERED = 36.0, 10

# A centre of the particles found is off by up to this share of the contact distance for each one
# missing over each one found.
_OFF_PER_MISSING = 0.6

_FEWEST_FRAMES = 3  # of a track that is kept

_NO_LINK = 1e6  # the cost of a link that is excluded

# A displacement of all centres is searched for where the mean squared step over its variance
# exceeds this multiple of its expectation, from the differences of this number of centres to all
# of the next frame. It is accepted if it lowers chi-squared by more than `_STAGE_GAIN`: with three
# degrees of freedom, by chance in 1e-9 of the frames.
_STAGE_SUSPECTED, _STAGE_TRIALS, _STAGE_GAIN = 2.5, 8, 45.0


def link_clusters(frame: Ints, x: Floats, *, reach: float, contact: float, size: int) -> Ints:
    """Group the detections of every frame into clusters and follow them through time.

    Parameters
    ----------
    frame : ndarray of int, shape (N,)
        Frame number of each detection.
    x : ndarray, shape (N, d)
        Coordinates of each detection, um; no NaN.
    reach : float
        Particles of a cluster are chained by distances up to this, um.
    contact : float
        Centre distance of touching particles, um.
    size : int
        Number of particles of a cluster.

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
    Displacements of all centres at once (a jump of the stage) are subtracted before.

    Examples
    --------
    >>> x = np.array([[0.0], [1.0], [9.0], [0.1], [1.1], [0.2], [1.2]])
    >>> link_clusters(np.array([0, 0, 0, 1, 1, 2, 2]), x, reach=1.3, contact=1.0, size=2)
    array([ 0,  0, -1,  0,  0,  0,  0])
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
    rows = np.flatnonzero(group >= 0)
    n = np.bincount(group[rows], minlength=count)
    position = [np.bincount(group[rows], weights=a, minlength=count) / n for a in x[rows].T]
    when = np.zeros(count, dtype=np.int64)
    when[group[rows]] = frame[rows]
    extra = (_OFF_PER_MISSING * contact * (size - n) / n) ** 2 / x.shape[1]
    track = linked_tracks(Centers(when, np.stack(position, axis=1), extra))
    lasting = np.bincount(track, minlength=1) >= _FEWEST_FRAMES
    number = np.where(lasting, np.cumsum(lasting) - 1, -1)
    return np.where(group >= 0, number[track[np.maximum(group, 0)]], -1)


class Centers(NamedTuple):
    """Centres of the groups of all frames.

    Attributes
    ----------
    frame : ndarray of int, shape (G,)
        Frame number of each group.
    position : ndarray, shape (G, d)
        Mean position of the particles found, um.
    extra : ndarray, shape (G,)
        Variance of the centre that missing particles cause, um^2; 0 for complete groups.
    """

    frame: Ints
    position: Floats
    extra: Floats


def linked_tracks(centers: Centers) -> Ints:
    """Link centres through time by least squares.

    Parameters
    ----------
    centers : Centers

    Returns
    -------
    ndarray of int64, shape (G,)
        Track of each group, numbered by first appearance.

    Examples
    --------
    >>> position = np.array([[0.0], [5.0], [5.1], [0.1]])
    >>> linked_tracks(Centers(np.array([0, 0, 1, 1]), position, np.zeros(4)))
    array([0, 1, 1, 0])
    """
    variance = step_variance(centers)
    centers = centers._replace(position=centers.position - stage_path(centers, variance))
    track = np.full(len(centers.frame), -1, dtype=np.int64)
    active = np.empty(0, dtype=np.int64)
    count = 0
    for groups in frames_of(centers.frame):
        now = int(centers.frame[groups[0]])
        active = active[centers.frame[active] >= now - _FRAMES_REMEMBERED]
        ended = []
        for old, new, certain in _links(centers, active, groups, variance):
            ended.append(old)
            if certain:
                track[new] = track[old]
        fresh = groups[track[groups] < 0]
        track[fresh] = count + np.arange(fresh.size)
        count += fresh.size
        active = np.concatenate([np.setdiff1d(active, ended), groups])
    return track


def step_variance(centers: Centers) -> float:
    """Return the variance of one coordinate of a step of one frame, from the median step.

    Only steps between complete groups that are each other's nearest count.

    Parameters
    ----------
    centers : Centers

    Returns
    -------
    float
        Variance, um^2; inf where there is no such step.

    Examples
    --------
    >>> steps = np.random.default_rng(0).normal(size=(4000, 3))
    >>> centers = Centers(np.arange(4000), steps.cumsum(axis=0), np.zeros(4000))
    >>> round(step_variance(centers), 1)
    1.0
    """
    from scipy.spatial import cKDTree

    squares = []
    before: Ints | None = None
    for groups in frames_of(centers.frame):
        complete = groups[centers.extra[groups] == 0]
        if before is not None and before.size and complete.size:
            gap = int(centers.frame[complete[0]] - centers.frame[before[0]])
            old, new = centers.position[before], centers.position[complete]
            distance, nearest = cKDTree(old).query(new)
            mutual = cKDTree(new).query(old)[1][nearest] == np.arange(complete.size)
            squares.append(distance[mutual] ** 2 / gap)
        before = complete
    if not squares:
        return np.inf
    return float(np.median(np.concatenate(squares))) / median_chi2(centers.position.shape[1])


def stage_path(centers: Centers, variance: float) -> Floats:
    """Return the displacement of the stage at each group: the sum of all jumps up to its frame.

    Parameters
    ----------
    centers : Centers
    variance : float
        Variance of one coordinate of a step of one frame, um^2.

    Returns
    -------
    ndarray, shape (G, d)
        um; 0 where the stage does not jump. Drift in small steps is not found.

    Examples
    --------
    >>> x = np.array([[0.0, 0.0], [5.0, 1.0], [3.0, 0.1], [8.0, 1.1]])
    >>> stage_path(Centers(np.array([0, 0, 1, 1]), x, np.zeros(4)), 0.01).round(6).tolist()
    [[0.0, 0.0], [0.0, 0.0], [3.0, 0.1], [3.0, 0.1]]
    """
    path = np.zeros_like(centers.position)
    if not 0 < variance < np.inf:
        return path
    total = np.zeros(centers.position.shape[1])
    before: Ints | None = None
    for groups in frames_of(centers.frame):
        if before is not None:
            gap = int(centers.frame[groups[0]] - centers.frame[before[0]])
            total = total + _common_step(
                centers.position[before], centers.position[groups], variance * gap
            )
        path[groups] = total
        before = groups
    return path


def _common_step(old: Floats, new: Floats, variance: float) -> Floats:
    """Return the displacement (d,) that most centres of two successive frames have in common.

    It is 0 unless it makes their steps far likelier: chi-squared is summed over the old centres and
    limited to the gate for those that meet none of the new ones.
    """
    from scipy.spatial import cKDTree

    tree, d = cKDTree(new), old.shape[1]

    def squares(shift: Floats) -> Floats:
        return np.asarray(np.minimum(tree.query(old + shift)[0] ** 2 / variance, _GATE))

    still = np.zeros(d)
    unmoved = float(squares(still).sum())
    fewest = max(2, len(old) / 2)
    if unmoved < _STAGE_SUSPECTED * d * len(old) or min(len(old), len(new)) < fewest:
        return still
    tried = old[np.unique(np.linspace(0, len(old) - 1, _STAGE_TRIALS).astype(int))]
    trials = (new[None] - tried[:, None]).reshape(-1, d)
    best = min(trials, key=lambda shift: float(squares(shift).sum()))
    for _ in range(3):
        met = squares(best) < _GATE
        best = (new[tree.query(old[met] + best)[1]] - old[met]).mean(axis=0)
    met = squares(best) < _GATE
    gain = unmoved - float(squares(best).sum())
    return best if met.sum() >= fewest and gain > _STAGE_GAIN else still


def _links(
    centers: Centers, old: Ints, new: Ints, variance: float
) -> Iterator[tuple[int, int, bool]]:
    """Yield the likeliest links of tracks' last groups to groups of this frame, and if certain.

    The cost of a link is half the squared distance over its variance, and the logarithm of the
    volume over which a track may have moved: one that was lost for some frames is no rival of one
    seen just before. Out of the gate it is above all others.
    """
    from scipy.optimize import linear_sum_assignment
    from scipy.spatial import cKDTree

    if not old.size or not new.size:
        return
    gap = float(centers.frame[new[0]] - centers.frame[old].min())
    widest = variance * gap + 2 * float(centers.extra.max())
    reach = float(np.sqrt(_GATE * min(widest, 1e300)))
    near = cKDTree(centers.position[old]).sparse_distance_matrix(
        cKDTree(centers.position[new]), reach, output_type="coo_matrix"
    )
    step = variance * (centers.frame[new[near.col]] - centers.frame[old[near.row]])
    total = step + centers.extra[old[near.row]] + centers.extra[new[near.col]]
    half = 0.5 * near.data**2 / np.maximum(total, 1e-300)
    kept = half <= _GATE / 2
    spread = 0.5 * centers.position.shape[1] * np.log(np.maximum(total / variance, 1.0))
    i, j, half = near.row[kept], near.col[kept], (half + spread)[kept]
    part = connected_groups(i, old.size + j, count=old.size + new.size)
    order = np.argsort(part[i], kind="stable")
    # Sets of last groups and new groups that are within each other's gates, one after the other.
    for edges in np.split(order, np.flatnonzero(np.diff(part[i[order]])) + 1):
        rows, a = np.unique(i[edges], return_inverse=True)
        columns, b = np.unique(j[edges], return_inverse=True)
        n, m = rows.size, columns.size
        if n == m == 1:
            yield int(old[rows[0]]), int(new[columns[0]]), True
            continue
        # No group has to be linked: leaving one out costs as much as a link at the gate.
        full = np.full((n + m, n + m), _GATE / 2)
        full[:n, :m] = _NO_LINK
        full[a, b] = half[edges]
        full[n:, m:] = 0.0
        taken, to = linear_sum_assignment(full)
        best = full[taken, to].sum()
        for k, there in zip(taken.tolist(), to.tolist(), strict=True):
            if k < n and there < m:
                other = full.copy()
                other[k, there] = _NO_LINK
                rival = other[linear_sum_assignment(other)].sum()
                certain = bool(rival - best > SETTLED_LOG_ODDS)
                yield int(old[rows[k]]), int(new[columns[there]]), certain
