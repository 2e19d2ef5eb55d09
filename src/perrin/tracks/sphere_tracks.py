"""Which sphere of one frame is which sphere of the next: tracks of single spheres."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from perrin.motion.residuals import median_chi2
from perrin.tracks.groups import connected_groups, frames_of

if TYPE_CHECKING:
    from perrin._arrays import Floats, Ints

# A sphere is searched for within six standard deviations (squared: the gate), for this number of
# frames after it was last seen.
_SPHERE_GATE, _FRAMES_BRIDGED = 36.0, 5

_FEWEST_OWN_STEPS = 5  # of a track with a variance of its own


def link_spheres(frame: Ints, x: Floats, *, variance: float) -> Ints:
    """Follow single spheres through time by least squares.

    Parameters
    ----------
    frame : ndarray of int, shape (N,)
        Frame number of each detection.
    x : ndarray, shape (N, d)
        Coordinates of each detection, um; no NaN.
    variance : float
        Variance of one coordinate of a sphere's step over one frame, um^2 (`step_variance`).

    Returns
    -------
    ndarray of int64, shape (N,)
        Track of each detection, numbered from 0.

    Notes
    -----
    The links of two frames minimise the sum of squared distances over their variance, which grows
    with the number of frames since a sphere was seen; leaving a sphere out costs as much as a
    distance of six standard deviations. Spheres of one body may be exchanged where it turns far:
    this is left to `settle_identity`.

    Examples
    --------
    >>> x = np.array([[0.0], [5.0], [5.1], [0.1], [0.2]])
    >>> link_spheres(np.array([0, 0, 1, 1, 3]), x, variance=0.01)
    array([0, 1, 1, 0, 0])
    """
    track = np.full(len(x), -1, dtype=np.int64)
    active = np.empty(0, dtype=np.int64)
    count = 0
    for rows in frames_of(frame):
        now = int(frame[rows[0]])
        active = active[frame[active] >= now - 1 - _FRAMES_BRIDGED]
        old, new = _least_square_links(frame, x, active, rows, variance)
        track[new] = track[old]
        fresh = rows[track[rows] < 0]
        track[fresh] = count + np.arange(fresh.size)
        count += fresh.size
        active = np.concatenate([np.setdiff1d(active, old), rows])
    return track


def track_variances(frame: Ints, track: Ints, x: Floats) -> Floats:
    """Return the variance of one coordinate of the free steps of each track, from median steps.

    Parameters
    ----------
    frame, track : ndarray of int, shape (N,)
        Frame and track of each detection.
    x : ndarray, shape (N, d)
        Coordinates of each detection, um.

    Returns
    -------
    ndarray
        Variance for a step of one frame, um^2, by the number of the track. It is at least that of
        the median step of all tracks: spheres that stay at rest together among others in motion
        are a body.

    Examples
    --------
    >>> x = np.random.default_rng(0).normal(size=(4000, 3)).cumsum(axis=0)
    >>> track_variances(np.arange(4000), np.zeros(4000, int), x).round(1)
    array([1.])
    """
    order = np.lexsort((frame, track))
    same = np.diff(track[order]) == 0
    gap = np.diff(frame[order])[same]
    square = (np.diff(x[order], axis=0)[same] ** 2).sum(axis=1) / gap
    owner = track[order][1:][same]
    steps = np.bincount(owner, minlength=int(track.max(initial=-1)) + 1)
    if not square.size:
        return np.zeros(len(steps))
    ranked = np.lexsort((square, owner))
    middle = np.cumsum(steps) - steps + steps // 2
    own = square[ranked[np.minimum(middle, len(ranked) - 1)]]
    usual = float(np.median(square))
    own = np.where(steps < _FEWEST_OWN_STEPS, usual, np.maximum(own, usual))
    return own / median_chi2(x.shape[1])


def _least_square_links(
    frame: Ints, x: Floats, old: Ints, new: Ints, variance: float
) -> tuple[Ints, Ints]:
    """Return the detections of last frames and of this one that are linked with each other."""
    from scipy.optimize import linear_sum_assignment
    from scipy.spatial import cKDTree

    if not (old.size and new.size and np.isfinite(variance)):
        return old[:0], new[:0]
    gap = frame[new[0]] - frame[old]
    reach = float(np.sqrt(_SPHERE_GATE * variance * gap.max()))
    near = cKDTree(x[old]).sparse_distance_matrix(cKDTree(x[new]), reach, output_type="coo_matrix")
    cost = near.data**2 / np.maximum(variance * gap[near.row], 1e-300)
    kept = cost <= _SPHERE_GATE
    i, j, cost = near.row[kept], near.col[kept], cost[kept]
    part = connected_groups(i, old.size + j, count=old.size + new.size)[i]
    order = np.argsort(part, kind="stable")
    edges = np.bincount(part, minlength=1)
    alone = edges[part] == 1
    linked = [(i[alone], j[alone])]
    order = order[~alone[order]]
    for some in np.split(order, np.flatnonzero(np.diff(part[order])) + 1):
        if not some.size:
            continue
        rows, a = np.unique(i[some], return_inverse=True)
        columns, b = np.unique(j[some], return_inverse=True)
        n, m = rows.size, columns.size
        # The gain of a link over leaving both spheres out; no link has a gain below zero.
        gain = np.zeros((n, m))
        gain[a, b] = _SPHERE_GATE - cost[some]
        r, c = linear_sum_assignment(-gain)
        taken = gain[r, c] > 0
        linked.append((rows[r[taken]], columns[c[taken]]))
    first, second = (np.concatenate(side).astype(np.int64) for side in zip(*linked, strict=True))
    return old[first], new[second]
