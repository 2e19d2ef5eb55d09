"""Rigid bodies among spheres that touch: groups whose contacts last and whose shape stays."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from perrin.errors import DegenerateClusterError, TooFewFramesError
from perrin.motion.tracking import track_rotation
from perrin.tracks.clusters import particles_and_pieces
from perrin.tracks.contacts import Contacts, lasting_contacts
from perrin.tracks.groups import TOUCHING_REACH, connected_groups
from perrin.tracks.linking import Centers, stage_path, step_variance
from perrin.tracks.sphere_tracks import link_spheres, track_variances

if TYPE_CHECKING:
    from collections.abc import Callable

    from perrin._arrays import Bools, Floats, Ints

# Two groups are one body if they are in contact in this share of the frames that show both.
_LASTING_SHARE_OF_FRAMES = 0.8

# The distances between two groups of one body scatter by under this share of the contact distance,
# or this multiple of the scatter of the bonds (from their median absolute deviation, of at most
# this number of pairs).
_RIGID_SHARE, _RIGID_RATIO, _PAIRS_COMPARED = 0.05, 3.0, 30

# The median absolute deviation of a normal distribution in standard deviations.
_NORMAL_MAD = 0.6745

# A sphere that is missing is looked for within this share of the contact distance of its place.
_FOUND_AGAIN = 0.25

# A body has the number of spheres that this share of its frames reach.
_FULL_SHARE = 0.05

# A step of up to half of the contact distance is unmistakable: no other sphere is as near.
_SURE_STEP = 0.5

# A body that ends is the one that begins within six standard deviations of a sphere's step
# (squared), within this number of frames.
_BODY_GATE, _FRAMES_APART = 36.0, 10


class RigidBodies(NamedTuple):
    """The rigid bodies of a movie, and the tracks of all spheres.

    Attributes
    ----------
    body : ndarray of int, shape (N,)
        Body of each detection, numbered by first appearance; -1 for spheres of no body.
    size : ndarray of int, shape (B,)
        Number of spheres of each body.
    track : ndarray of int, shape (N,)
        Track of each detection as a single sphere.
    """

    body: Ints
    size: Ints
    track: Ints


class IdentifiedBodies(NamedTuple):
    """The rigid bodies of a movie, with the particles of each.

    Attributes
    ----------
    body, particle, piece : ndarray of int, shape (N,)
        Body of each detection, its particle in the body (0 to size - 1), and the piece of the
        body's track in which particles are certain. Detections of no body, or of unknown particle,
        have body and particle -1.
    size : ndarray of int, shape (B,)
        Number of spheres of each body.
    track : ndarray of int, shape (N,)
        Track of each detection that is in no body; -1 for those that belong to one.
    """

    body: Ints
    particle: Ints
    piece: Ints
    size: Ints
    track: Ints


def identify_bodies(
    frame: Ints,
    x: Floats,
    *,
    contact: float,
    error: float | None = None,
    scan: float = 0.0,
    progress: Callable[[int, int, str], None] | None = None,
) -> IdentifiedBodies:
    """Find rigid bodies of all sizes, and which detection is which sphere of each.

    Parameters
    ----------
    frame, x, contact, error, scan
        As in `rigid_bodies`.
    progress : callable, optional
        Takes the number of finished bodies, of all (0: not known yet), and what is done.

    Returns
    -------
    IdentifiedBodies

    Notes
    -----
    In the bodies of `rigid_bodies` particles are distinguished as in `identify`. A sphere that is
    missing in a frame is then looked for among the loose ones at the place where the fit of the
    others expects it.

    Examples
    --------
    >>> from perrin import Cluster, positions_table, simulate_motion
    >>> truth = simulate_motion(Cluster.touching(3, 2.0), D_R=0.01, dt=0.5, n_frames=30, rng=3)
    >>> table = positions_table(truth.positions())
    >>> found = identify_bodies(
    ...     table["frame"].to_numpy(), table[["x", "y", "z"]].to_numpy(), contact=2.0
    ... )
    >>> found.size.tolist(), np.bincount(found.particle).tolist()
    ([3], [30, 30, 30])
    """
    report = progress or (lambda *_: None)
    report(0, 0, "linking the spheres")
    found = rigid_bodies(frame, x, contact=contact, error=error, scan=scan)
    body = found.body.copy()
    particle, piece = np.full(len(x), -1, dtype=np.int64), np.zeros(len(x), dtype=np.int64)
    for b, size in enumerate(found.size.tolist()):
        report(b, len(found.size), "identifying the particles")
        rows = np.flatnonzero(body == b)
        if size == 2:
            at = frame[rows]
            more = np.isin(at, np.flatnonzero(np.bincount(at - at.min()) > 2) + at.min())
            body[rows[more]] = -1
            rows = rows[~more]
        particle[rows], piece[rows] = particles_and_pieces(frame[rows], x[rows], size)
        new = _missing_spheres(frame, x, body, particle, b, size=size, contact=contact)
        if new.size:
            body[new] = b
            rows = np.flatnonzero(body == b)
            particle[rows], piece[rows] = particles_and_pieces(frame[rows], x[rows], size)
    track = np.where(body < 0, found.track, -1)
    body = np.where(particle < 0, -1, body)
    return IdentifiedBodies(body, particle, piece, found.size, track)


def _missing_spheres(
    frame: Ints, x: Floats, body: Ints, particle: Ints, b: int, *, size: int, contact: float
) -> Ints:
    """Return the loose detections at the places of spheres that are missing in a body."""
    from scipy.spatial import cKDTree

    own = np.flatnonzero((body == b) & (particle >= 0))
    frames, at, count = np.unique(frame[own], return_inverse=True, return_counts=True)
    lacking = frames[count < size]
    loose = np.flatnonzero((body < 0) & np.isin(frame, lacking))
    if size <= x.shape[1] - 1 or not loose.size or not (count == size).any():
        return loose[:0]
    positions = np.full((len(frames), size, x.shape[1]), np.nan)
    positions[at, particle[own]] = x[own]
    try:
        fitted = track_rotation(positions, dt=1.0, times=frames.astype(np.float64)).positions()
    except (DegenerateClusterError, TooFewFramesError):
        return loose[:0]
    found = [loose[:0]]
    for row in np.flatnonzero(count < size).tolist():
        places = fitted[row][np.isnan(positions[row, :, 0])]
        here = loose[frame[loose] == frames[row]]
        if here.size and np.isfinite(places).all():
            away, nearest = cKDTree(x[here]).query(places)
            found.append(np.unique(here[nearest[away < _FOUND_AGAIN * contact]]))
    return np.concatenate(found)


class _Members(NamedTuple):
    """Stretches of tracks that are in contact with others.

    Attributes
    ----------
    row : ndarray of int, shape (M, T)
        Detection of each member in every frame of the movie, -1 where there is none.
    one, other : ndarray of int, shape (C,)
        The two members of each contact.
    """

    row: Ints
    one: Ints
    other: Ints

    @classmethod
    def of(cls, frame: Ints, track: Ints, contacts: Contacts) -> _Members:
        """Return the stretches of tracks that are in contact."""
        count = contacts.one.size
        code = np.concatenate([contacts.one, contacts.other])
        first, last = np.tile(contacts.first, 2), np.tile(contacts.last, 2)
        member = np.empty(2 * count, dtype=np.int64)
        ends: list[tuple[int, int, int]] = []
        for k in np.lexsort((first, code)).tolist():
            if ends and ends[-1][0] == code[k] and first[k] <= ends[-1][2]:
                ends[-1] = (*ends[-1][:2], max(ends[-1][2], int(last[k])))
            else:
                ends.append((int(code[k]), int(first[k]), int(last[k])))
            member[k] = len(ends) - 1
        row = np.full((len(ends), int(np.ptp(frame)) + 1), -1, dtype=np.int64)
        at = frame - frame.min()
        by_track = np.argsort(track, kind="stable")
        for m, (number, start, end) in enumerate(ends):
            low, high = np.searchsorted(track[by_track], [number, number + 1])
            rows = by_track[low:high]
            rows = rows[(frame[rows] >= start) & (frame[rows] <= end)]
            row[m, at[rows]] = rows
        return cls(row, member[:count], member[count:])


def rigid_bodies(
    frame: Ints, x: Floats, *, contact: float, error: float | None = None, scan: float = 0.0
) -> RigidBodies:
    """Find the groups of touching spheres that move as rigid bodies.

    Parameters
    ----------
    frame : ndarray of int, shape (N,)
        Frame number of each detection.
    x : ndarray, shape (N, d)
        Coordinates of each detection, um; no NaN.
    contact : float
        Centre distance of touching spheres, um.
    error : float, optional
        Stated standard error of one coordinate, um.
    scan : float
        Share of the time between frames that passes between the recordings of two touching spheres.

    Returns
    -------
    RigidBodies

    Notes
    -----
    Single spheres are followed (`link_spheres`); of the pairs within 1.3 contact distances those
    are bonds that stay longer than diffusion allows (`lasting_contacts`). A track whose bonds all
    end before others begin counts as two spheres from there on. Groups are joined along the bonds,
    the most certain first, if bonds between them hold in 80 % of the frames that show both and the
    distances between them stay constant: two bodies that stick together for a while remain two,
    and a sphere that rolls on a body is none of its spheres. A body that ends, and one of
    as many spheres that begins near its last place within ten frames, are one. Jumps of the stage
    are subtracted before (`stage_path`).

    Examples
    --------
    >>> steps = 0.3 * np.random.default_rng(1).normal(size=(2, 40, 1)).cumsum(axis=1)
    >>> x = np.concatenate([steps[0], steps[0] + 1.0, steps[1] + 3.0])
    >>> found = rigid_bodies(np.tile(np.arange(40), 3), x, contact=1.0)
    >>> found.body[[0, 40, 80]].tolist(), found.size.tolist()
    ([0, 0, -1], [2])
    """
    variance = step_variance(Centers(frame, x, np.zeros(len(x))))
    x = x - stage_path(Centers(frame, x, np.zeros(len(x))), variance)
    # Beside spheres at rest, which may be the most, the others move far.
    variance = max(variance, (_SURE_STEP * contact) ** 2 / _BODY_GATE)
    track = link_spheres(frame, x, variance=variance)
    reach, own = TOUCHING_REACH * contact, track_variances(frame, track, x)
    contacts = lasting_contacts(frame, track, x, reach=reach, variance=own, error=error, scan=scan)
    body = np.full(len(x), -1, dtype=np.int64)
    if not contacts.one.size:
        return RigidBodies(body, np.empty(0, dtype=np.int64), track)
    members = _Members.of(frame, track, contacts)
    group = _joined_members(members, contacts, frame, x, contact=contact)
    for rows, label in zip(members.row, group, strict=True):
        body[rows[rows >= 0]] = label
    body = _joined_in_time(frame, x, body, variance=variance)
    return RigidBodies(body, _sizes(frame, body), track)


def _joined_members(
    members: _Members,
    contacts: Contacts,
    frame: Ints,
    x: Floats,
    *,
    contact: float,
) -> Ints:
    """Join members to bodies along the bonds, the most certain first; return the body of each."""
    one, other = members.one, members.other
    seen = members.row >= 0
    number = np.arange(seen.shape[1]) + frame.min()
    inside: dict[int, list[int]] = {m: [m] for m in range(len(seen))}
    alive: dict[int, Bools] = dict(enumerate(seen))
    bonded: dict[int, dict[int, Bools]] = {m: {} for m in range(len(seen))}
    group = np.arange(len(seen))
    bonds = list(zip(one.tolist(), other.tolist(), strict=True))
    usual = float(np.median(_scatter(members.row, bonds, x)))
    bound = max(_RIGID_SHARE * contact, _RIGID_RATIO * usual)
    for i, j, start, end in zip(one, other, contacts.first, contacts.last, strict=True):
        held = seen[i] & seen[j] & (number >= start) & (number <= end)
        both = held | bonded[int(i)].get(int(j), np.zeros_like(held))
        bonded[int(i)][int(j)] = bonded[int(j)][int(i)] = both
    for k in np.argsort(-contacts.score, kind="stable"):
        a, b = int(group[one[k]]), int(group[other[k]])
        if a == b:
            continue
        together = (alive[a] & alive[b]).sum()
        if bonded[a][b].sum() < _LASTING_SHARE_OF_FRAMES * together:
            continue
        pairs = [(i, j) for i in inside[a] for j in inside[b]]
        if not np.all(_scatter(members.row, pairs, x) <= bound):
            continue
        group[inside[b]] = a
        inside[a] += inside.pop(b)
        alive[a] = alive[a] | alive.pop(b)
        for c, held in bonded.pop(b).items():
            del bonded[c][b]
            if c != a:
                both = held | bonded[a].get(c, np.zeros_like(held))
                bonded[a][c] = bonded[c][a] = both
    return np.unique(group, return_inverse=True)[1].astype(np.int64)


def _scatter(row: Ints, pairs: list[tuple[int, int]], x: Floats) -> Floats:
    """Return the scatter of the distance of some pairs of members, 0 for pairs of few frames."""
    scatter = []
    for i, j in pairs[:: max(1, len(pairs) // _PAIRS_COMPARED)]:
        both = np.flatnonzero((row[i] >= 0) & (row[j] >= 0))
        distance = np.linalg.norm(x[row[i, both]] - x[row[j, both]], axis=1)
        off = np.abs(distance - np.median(distance)) if both.size > 2 else np.zeros(1)
        scatter.append(np.median(off) / _NORMAL_MAD)
    return np.array(scatter)


def _joined_in_time(frame: Ints, x: Floats, body: Ints, *, variance: float) -> Ints:
    """Join bodies that end with the bodies of the same size that begin nearby, if only one does.

    Bodies are numbered by first appearance.
    """
    size = _sizes(frame, body)
    ends = np.array([[frame[body == b].min(), frame[body == b].max()] for b in range(len(size))])
    first, last = (
        np.array([x[(body == b) & (frame == ends[b, side])].mean(axis=0) for b in range(len(size))])
        for side in (0, 1)
    )
    gap = ends[None, :, 0] - ends[:, None, 1]
    square = ((last[:, None] - first[None]) ** 2).sum(axis=2)
    near = (gap > 0) & (gap <= _FRAMES_APART) & (size[:, None] == size)
    near &= square <= _BODY_GATE * variance * np.maximum(gap, 1)
    single = near & (near.sum(axis=1, keepdims=True) == 1) & (near.sum(axis=0) == 1)
    before, after = np.nonzero(single)
    joined = connected_groups(before, after, count=len(size))
    label = np.where(body >= 0, joined[np.maximum(body, 0)], -1)
    rows = np.flatnonzero(label >= 0)
    start = np.full(len(size), np.iinfo(np.int64).max)
    np.minimum.at(start, label[rows], frame[rows])
    row = np.full(len(size), len(x))
    appears = rows[frame[rows] == start[label[rows]]]
    np.minimum.at(row, label[appears], appears)
    count = int(joined.max()) + 1
    rank = np.empty(count, dtype=np.int64)
    rank[np.lexsort((row[:count], start[:count]))] = np.arange(count)
    return np.where(label >= 0, rank[np.maximum(label, 0)], -1)


def _sizes(frame: Ints, body: Ints) -> Ints:
    """Return the number of spheres that 5 % of the frames of each body reach."""
    rows = np.flatnonzero(body >= 0)
    count = int(body.max(initial=-1)) + 1
    key, n = np.unique(np.stack([body[rows], frame[rows]]), axis=1, return_counts=True)
    size = np.zeros(count, dtype=np.int64)
    for b in range(count):
        counts = np.sort(n[key[0] == b])
        size[b] = counts[-max(1, int(np.ceil(_FULL_SHARE * len(counts))))]
    return size
