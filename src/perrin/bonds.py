"""Which particles keep their distances: the rigid bodies among free tracks, without a contact."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator

    from perrin._arrays import Bools, Floats, Ints

# Up to so many particles every pair is watched; of more only neighbours, in so many frames.
_ALL_PAIRS, _NEIGHBOURS, _LOOKS = 64, 12, 60
# A distance is steady when it varies by under a tenth of itself, either inside blocks of
# time (of a random walk's variance one eighth lies inside eight blocks, of white noise nearly all)
# or hardly varies (variance) against what it would if its ends moved on their own.
_STEADY, _DRIFT, _BLOCKS, _BLOCK, _TIED = 0.1, 0.5, 8, 5, 0.01
# Two groups are one body unless their distances vary by over so many times what each varies in
# itself; a group much looser than the tightest one of the table is no body.
_APART, _LOOSE = 2.5, 6.0
_FEWEST = 8


class Pairs(NamedTuple):
    """What the distances of some pairs of particles did; one entry per pair."""

    first: Ints
    second: Ints
    shared: Ints
    distance: Floats
    variance: Floats
    drift: Floats  # the share of the variance that lies between blocks of time
    free: Floats  # the variance if the two moved on their own

    @property
    def steady(self) -> Bools:
        """Whether the distance stays the same, as far as it was seen."""
        constant = np.sqrt(self.variance) <= _STEADY * self.distance
        tied = (self.drift <= _DRIFT) | (self.variance <= _TIED * self.free)
        return np.asarray((self.shared >= _FEWEST) & constant & tied)


def rigid_groups(frame: Ints, code: Ints, x: Floats, *, count: int, smallest: int) -> Ints:
    """Group the particles whose mutual distances stay constant within noise.

    Parameters
    ----------
    frame, code : ndarray of int, shape (N,)
        Frame and particle (0 to count - 1) of every detection.
    x : ndarray, shape (N, d)
        Where it is; no NaN.
    count : int
        Number of particles.
    smallest : int
        Groups of fewer particles are no body.

    Returns
    -------
    ndarray of int64, shape (count,)
        A group's label is its smallest code; particles of no body have -1.

    Notes
    -----
    Pairs are joined from the nearest and steadiest on (smallest product of distance and its
    fluctuation: mates in a body are near). Two groups become one if the distances between them are
    steady and vary by at most 2.5 times what those inside them do (rms). What a pair does for a
    while is averaged over all frames it shares, so bodies may pass each other.
    """
    pairs = _watched(frame, code, x, count=count)
    groups = _joined(pairs, count)
    label = np.full(count, -1, dtype=np.int64)
    inner = {min(g): np.sqrt(power) for g, power in groups if len(g) >= max(smallest, 2)}
    limit = _LOOSE * min(inner.values(), default=0.0)
    for members, _ in groups:
        if inner.get(min(members), np.inf) <= limit:
            label[members] = min(members)
    return label


def frames_of(frame: Ints) -> Iterator[Ints]:
    """Yield the rows of each frame, frames rising."""
    order = np.argsort(frame, kind="stable")
    yield from np.split(order, np.flatnonzero(np.diff(frame[order])) + 1)


def _watched(frame: Ints, code: Ints, x: Floats, *, count: int) -> Pairs:
    """Follow the distances of all pairs that may belong together, frame by frame."""
    first, second = _candidates(frame, code, x, count=count)
    frames = np.unique(frame)
    blocks = int(np.clip(len(frames) // _BLOCK, 2, _BLOCKS))
    start = np.zeros(len(first))
    sums = np.zeros((blocks, len(first)))
    shared, squares = np.zeros((blocks, len(first)), dtype=np.int64), np.zeros(len(first))
    place = np.full(count, -1, dtype=np.int64)
    for number, rows in enumerate(frames_of(frame)):
        place[code[rows]] = rows
        i, j = place[first], place[second]
        both = np.flatnonzero((i >= 0) & (j >= 0))
        place[code[rows]] = -1
        distance = np.linalg.norm(x[i[both]] - x[j[both]], axis=1)
        new = start[both] == 0
        start[both[new]] = distance[new]
        distance -= start[both]
        block = number * blocks // len(frames)
        sums[block, both] += distance
        shared[block, both] += 1
        squares[both] += distance**2
    wander = _wander(code, x, count)
    return _summed(first, second, wander[first] + wander[second], start, sums, shared, squares)


def _wander(code: Ints, x: Floats, count: int) -> Floats:
    """Return the variance of each particle's place, mean over the axes."""
    n = np.maximum(np.bincount(code, minlength=count), 1)
    centred = x - x.mean(axis=0)
    variance = np.zeros(count)
    for axis in centred.T:
        mean = np.bincount(code, weights=axis, minlength=count) / n
        variance += np.bincount(code, weights=(axis - mean[code]) ** 2, minlength=count) / n
    mean_variance: Floats = variance / x.shape[1]
    return mean_variance


def _summed(
    first: Ints,
    second: Ints,
    free: Floats,
    start: Floats,
    sums: Floats,
    shared: Ints,
    squares: Floats,
) -> Pairs:
    """Turn sums over blocks of time into mean, variance, and the share between the blocks."""
    n = shared.sum(axis=0)
    seen = n > 0
    first, second, free, start, n = (a[seen] for a in (first, second, free, start, n))
    sums, shared, squares = sums[:, seen], shared[:, seen], squares[seen]
    mean = sums.sum(axis=0) / n
    total = np.maximum(squares - n * mean**2, 0.0)
    between = (sums**2 / np.maximum(shared, 1)).sum(axis=0) - n * mean**2
    # A distance that does not change at all, to rounding, does not drift.
    still = total <= n * (1e-12 * start) ** 2
    drift = np.where(still, 0.0, between / np.where(still, 1.0, total))
    variance = total / np.maximum(n - 1, 1)
    return Pairs(first, second, n, start + mean, variance, drift, free)


def _candidates(frame: Ints, code: Ints, x: Floats, *, count: int) -> tuple[Ints, Ints]:
    """Return the pairs to watch: all of few particles, the neighbours of many."""
    if count <= _ALL_PAIRS:
        first, second = np.triu_indices(count, 1)
        return first.astype(np.int64), second.astype(np.int64)
    keys = [np.empty(0, dtype=np.int64)]
    for rows in _looks(frame, code, count):
        near = _neighbours(x[rows])
        one, other = code[rows[near[:, 0]]], code[rows[near[:, 1]]]
        keys.append(np.unique(np.minimum(one, other) * count + np.maximum(one, other)))
    first, second = np.divmod(np.unique(np.concatenate(keys)), count)
    return first, second


def _looks(frame: Ints, code: Ints, count: int) -> Iterator[Ints]:
    """Yield the rows of some frames, evenly spaced, and of as many as show every other particle."""
    frames = np.unique(frame)
    chosen = set(frames[np.linspace(0, len(frames) - 1, _LOOKS).astype(int)].tolist())
    seen = np.zeros(count, dtype=np.bool_)
    seen[code[np.isin(frame, list(chosen))]] = True
    rest = np.flatnonzero(~seen[code])
    while rest.size:
        chosen.add(int(frame[rest[rest.size // 2]]))
        seen[code[frame == frame[rest[rest.size // 2]]]] = True
        rest = rest[~seen[code[rest]]]
    kept = np.flatnonzero(np.isin(frame, list(chosen)))
    for rows in frames_of(frame[kept]):
        yield kept[rows]


def _neighbours(x: Floats) -> Ints:
    """Return the pairs (P, 2) of each point with its nearest others."""
    from scipy.spatial import cKDTree

    k = min(_NEIGHBOURS + 1, len(x))
    near = cKDTree(x).query(x, k)[1].reshape(len(x), k)
    pairs = np.stack([np.repeat(np.arange(len(x)), k), near.ravel()], axis=1)
    unlike: Ints = pairs[pairs[:, 0] != pairs[:, 1]].astype(np.int64)
    return unlike


def _joined(pairs: Pairs, count: int) -> list[tuple[list[int], float]]:
    """Join groups along the pairs; return members and the mean square fluctuation inside."""
    steady, variance = pairs.steady, pairs.variance
    known: list[dict[int, int]] = [{} for _ in range(count)]
    for p, (i, j) in enumerate(zip(pairs.first.tolist(), pairs.second.tolist(), strict=True)):
        if pairs.shared[p] >= _FEWEST:
            known[i][j] = known[j][i] = p
    members = {i: [i] for i in range(count)}
    home = list(range(count))
    inner: dict[int, list[int]] = {i: [] for i in range(count)}
    refused: set[tuple[int, int, int]] = set()
    order = np.flatnonzero(steady)
    order = order[np.argsort(variance[order] * pairs.distance[order] ** 2, kind="stable")]
    for i, j in zip(pairs.first[order].tolist(), pairs.second[order].tolist(), strict=True):
        a, b = sorted((home[i], home[j]))
        trial = (a, b, len(members[a]) + len(members[b]))
        if a == b or trial in refused:
            continue
        across = [known[u][v] for u in members[a] for v in members[b] if v in known[u]]
        inside = inner[a] + inner[b]
        if not _one_body(variance, steady, across, inside):
            refused.add(trial)
            continue
        for k in members[b]:
            home[k] = a
        members[a] += members.pop(b)
        inner[a] = inside + across
    return [(g, float(np.mean(variance[inner[a]]))) for a, g in members.items() if len(g) > 1]


def _one_body(variance: Floats, steady: Bools, across: list[int], inside: list[int]) -> bool:
    """Return whether the pairs between two groups are as steady as those inside them."""
    if 2 * np.count_nonzero(steady[across]) <= len(across):
        return False
    return not inside or bool(
        np.mean(variance[across]) <= _APART**2 * np.mean(variance[inside]) + 1e-300
    )
