"""Which particles keep their distances: the rigid bodies among free tracks, without a contact."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator

    from perrin._arrays import Bools, Floats, Ints


# Up to this number of particles every pair is followed; of more only the neighbours, which are
# searched for in some of the frames.
_ALL_PAIRS, _NEIGHBOURS, _SAMPLED = 64, 12, 60


# Followed positions per chunk of pairs: bounds the memory.
_CHUNK = 1_000_000


# A pair needs this number of shared frames. They are divided into blocks of time: white noise has
# one of n - 1 parts of its variance per block between them, a random walk seven eighths.
_FEWEST, _BLOCKS, _BLOCK = 8, 8, 5


# Distances farther from the median than 5 standard deviations (from the quantiles at 10 and 90 %)
# are bad coordinates and do not count.
_TAIL, _GROSS = 0.1, 5.0


_NORMAL_RANGE = 2.563  # between these quantiles of a normal distribution, in standard deviations


# A distance is constant where it varies by under a tenth of the distance to the nearest particle.
_CONSTANT = 0.1


# Variations are slow where more than half of the variance lies between blocks of time. The
# distance of two free particles then varies as their separation does along every axis; that of a
# body by under a tenth of it (variance), or under 30 % of its slow part.
_SLOW, _TIED, _PARTAKES = 0.5, 0.1, 0.3


# Wandering by under 0.2 % of the distance to the nearest particle is less than any localisation
# error hides: at rest.
_AT_REST = 2e-3


# Two groups are one body unless their distances vary by over 2.5 times (rms) what each varies
# in itself; slow variations, which few blocks show, are compared at this level of an F test.
_APART, _LEVEL = 2.5, 1e-3


# A group varying by over 6 times what the tightest does is a body only if its distances vary less
# (variance) than the separations along the axes: trapped particles vary alike in both.
_LOOSE, _LESS = 6.0, 0.7


# The localisation error along one axis of the microscope is at most this factor from the others'.
# The logarithm of its square costs this share of a fluctuation's sampling error, so that equal
# errors stay equal.
_WORST_AXIS, _STEPS, _PRICE = 5.0, 12, 0.25


class Pairs(NamedTuple):
    """How the separations of some pairs of particles vary; one entry per pair."""

    first: Ints
    second: Ints
    shared: Ints  # frames that hold both
    blocks: Ints  # of time, into which these are divided
    distance: Floats  # median
    variance: Floats  # of the distance
    slow: Floats  # the same from the means of the blocks: equal for white noise
    free: Floats  # variance of the separation, mean over the axes
    free_slow: Floats
    direction: Floats  # (P, d): mean squares of the direction's components
    nearest: Floats  # distance to the nearest other particle

    def share(self, slow: Floats, variance: Floats) -> Floats:
        """Return the share of a variance that lies between blocks of time."""
        between, total = slow * (self.blocks - 1), variance * (self.shared - 1)
        # What does not change at all, to rounding, does not vary slowly.
        still = total <= self.shared * (1e-12 * self.distance) ** 2
        return np.where(still, 0.0, between / np.where(still, 1.0, total))

    @property
    def resting(self) -> Bools:
        """Whether the distance hardly varies at all."""
        return np.asarray(np.sqrt(self.variance) <= _AT_REST * self.nearest)

    @property
    def steady(self) -> Bools:
        """Whether the distance stays the same, as far as the noise shows."""
        constant = np.sqrt(self.variance) <= _CONSTANT * self.nearest
        white = self.share(self.slow, self.variance) <= _SLOW
        tied = self.variance <= _TIED * self.free
        still = self.share(self.free_slow, self.free) <= _SLOW
        apart = still | (self.slow <= _PARTAKES * self.free_slow)
        kept = self.resting | tied | (white & apart)
        return np.asarray((self.shared >= _FEWEST) & constant & kept)


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
    A distance is steady if it varies by under a tenth of the distance to the nearest particle and
    its variation is noise: white in time, or under a tenth (variance) of that of the separation
    along the axes, or under 0.2 % of the distance to the nearest particle (bodies at rest, whatever
    the noise). Where the separation of two particles wanders, the distance must not wander with
    it. Distances off by more than 5 standard deviations do not count.

    Pairs are joined from the nearest and steadiest on (smallest product of distance and its
    fluctuation: particles of one body are near). Two groups become one if the distances between
    them are steady and vary by at most 2.5 times what those inside them do (rms), in all and
    from block to block of time. Fluctuations are compared in units of the localisation error along
    the pair's direction: the ratio of that error along one axis to the others is fitted to all
    steady pairs. What a pair does for a while is averaged over all frames it shares, so bodies may
    pass each other. Particles at rest beside each other keep their distances, too: they cannot be
    told from a body at rest.

    Examples
    --------
    >>> t = np.arange(20)
    >>> x = np.stack([np.cos(t), np.sin(t)], axis=1)
    >>> far = np.stack([9.0 + t**2, 0.0 * t], axis=1)
    >>> rigid_groups(np.tile(t, 3), np.repeat(np.arange(3), 20), np.concatenate([x, -x, far]),
    ...              count=3, smallest=2)
    array([ 0,  0, -1])
    """
    pairs = _followed(frame, code, x, count=count)
    label = np.full(count, -1, dtype=np.int64)
    level = pairs.variance / _noise_along(pairs, count=count)
    groups = [g for g in _joined(pairs, level, count) if len(g[0]) >= max(smallest, 2)]
    groups = [g for g in groups if _keeps_shape(pairs, level, g[1])]
    rms = [float(np.sqrt(np.mean(level[inside]))) for _, inside in groups]
    for (members, inside), fluctuation in zip(groups, rms, strict=True):
        if fluctuation <= _LOOSE * min(rms) or _turns(pairs, level, inside):
            label[members] = min(members)
    return label


def frames_of(frame: Ints) -> Iterator[Ints]:
    """Yield the rows of each frame, frames rising."""
    order = np.argsort(frame, kind="stable")
    yield from np.split(order, np.flatnonzero(np.diff(frame[order])) + 1)


def _noise_along(pairs: Pairs, *, count: int) -> Floats:
    """Return the variance of the localisation error along each pair, over its mean over the axes.

    One axis may have a larger or smaller error than the others: axis and ratio are those for which
    the fluctuations of the steady pairs within connected groups agree best (least absolute
    differences of logarithms).
    """
    used = np.flatnonzero(pairs.steady & (pairs.variance > 0))
    dimensions = pairs.direction.shape[1]
    best, weights = np.inf, np.ones(dimensions)
    group = _component(pairs.first[used], pairs.second[used], count)
    sampling = np.sqrt(2 / (pairs.shared[used] - 1))
    price = _PRICE * float(np.mean(sampling)) if used.size else 0.0
    for factor in np.geomspace(_WORST_AXIS**-2, _WORST_AXIS**2, 2 * _STEPS + 1):
        for axis in range(dimensions):
            trial = np.where(np.arange(dimensions) == axis, factor, 1.0)
            excess = np.log(pairs.variance[used] / (pairs.direction[used] @ trial))
            misfit = _spread_within(group, excess) + price * abs(np.log(factor))
            if misfit < best:
                best, weights = misfit, trial
    along: Floats = pairs.direction @ (weights / weights.mean())
    return along


def _component(first: Ints, second: Ints, count: int) -> Ints:
    """Return the connected group of each link between particles."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    links = coo_array((np.ones(len(first)), (first, second)), shape=(count, count))
    part: Ints = connected_components(links, directed=False)[1][first].astype(np.int64)
    return part


def _spread_within(group: Ints, values: Floats) -> float:
    """Return the mean absolute difference of values from the median of their group."""
    if not len(values):
        return 0.0
    number, order = np.unique(group, return_inverse=True)[1], np.lexsort((values, group))
    start = np.searchsorted(group[order], np.unique(group))
    size = np.bincount(number)
    low, high = order[start + (size - 1) // 2], order[start + size // 2]
    median = 0.5 * (values[low] + values[high])
    return float(np.mean(np.abs(values - median[number])))


def _followed(frame: Ints, code: Ints, x: Floats, *, count: int) -> Pairs:
    """Follow the separations of all pairs that may belong together."""
    first, second = _candidates(frame, code, x, count=count)
    number = np.unique(frame, return_inverse=True)[1].astype(np.int64)
    order = np.lexsort((number, code))
    number, code, x = number[order], code[order], x[order]
    lengths = np.bincount(code, minlength=count)
    swapped = lengths[first] > lengths[second]
    brief, other = np.where(swapped, [second, first], [first, second])
    ends = np.cumsum(lengths[brief])
    parts = []
    for chunk in np.split(np.arange(len(brief)), _cuts(ends)):
        pair, one, two = _shared_rows(number, code, brief[chunk], other[chunk])
        sides = first[chunk], second[chunk]
        parts.append(_varied(*sides, pair, x[one] - x[two]))
    pairs = Pairs._make(np.concatenate(column) for column in zip(*parts, strict=True))
    seen = pairs.shared > 0
    pairs = Pairs._make(column[seen] for column in pairs)
    nearest = np.full(count, np.inf)
    unlike = pairs.distance > 0
    for side in (pairs.first, pairs.second):
        np.minimum.at(nearest, side[unlike], pairs.distance[unlike])
    return pairs._replace(nearest=np.minimum(nearest[pairs.first], nearest[pairs.second]))


def _cuts(ends: Ints) -> Ints:
    """Return where to cut a list of pairs so that every part holds about `_CHUNK` rows."""
    return np.flatnonzero(np.diff(ends // _CHUNK)) + 1


def _shared_rows(number: Ints, code: Ints, brief: Ints, other: Ints) -> tuple[Ints, Ints, Ints]:
    """Return pair, row of the one and row of the other, for each frame that holds both.

    Rows are sorted by particle, then frame.
    """
    width = int(number.max(initial=0)) + 1
    key = code * width + number
    start = np.searchsorted(code, brief)
    length = np.searchsorted(code, brief, side="right") - start
    pair = np.repeat(np.arange(len(brief)), length)
    one = np.arange(len(pair)) + np.repeat(start - np.cumsum(length) + length, length)
    wanted = other[pair] * width + number[one]
    two = np.minimum(np.searchsorted(key, wanted), len(key) - 1)
    both = key[two] == wanted
    return pair[both], one[both], two[both]


def _varied(first: Ints, second: Ints, pair: Ints, separation: Floats) -> Pairs:
    """Turn separations, sorted by pair and time, into their statistics."""
    count = len(first)
    distance = np.linalg.norm(separation, axis=1)
    median, spread = _quantiles(pair, distance, count)
    good = np.abs(distance - median[pair]) <= _GROSS * spread[pair] + 1e-9 * median[pair]
    pair, separation, distance = pair[good], separation[good], distance[good]
    shared = np.bincount(pair, minlength=count)
    blocks = np.clip(shared // _BLOCK, 2, _BLOCKS)
    rank = np.arange(len(pair)) - np.repeat(np.cumsum(shared) - shared, shared)
    block = pair * _BLOCKS + rank * blocks[pair] // shared[pair]
    off = (distance - median[pair])[:, None]
    variance, slow = _variances(pair, block, off, shared, blocks)
    free, free_slow = _variances(pair, block, separation, shared, blocks)
    # Two particles at one place have no direction: all axes count alike.
    alike = np.where(distance == 0, 1 / np.sqrt(separation.shape[1]), 0.0)[:, None]
    unit = (separation / np.where(distance == 0, 1.0, distance)[:, None] + alike) ** 2
    n = np.maximum(shared, 1)
    direction = np.stack([np.bincount(pair, weights=u, minlength=count) / n for u in unit.T], 1)
    return Pairs(
        first,
        second,
        shared,
        blocks,
        median,
        variance,
        slow,
        free,
        free_slow,
        direction,
        np.full(count, np.inf),
    )


def _quantiles(pair: Ints, values: Floats, count: int) -> tuple[Floats, Floats]:
    """Return the median of each pair's values, and their spread in standard deviations."""
    ordered = values[np.lexsort((values, pair))]
    size = np.bincount(pair, minlength=count)
    start = np.cumsum(size) - size
    at = []
    for q in (_TAIL, 0.5, 1 - _TAIL):
        place = start + q * np.maximum(size - 1, 0)
        low = np.minimum(place.astype(np.int64), max(len(ordered) - 1, 0))
        high = np.minimum(low + 1, max(len(ordered) - 1, 0))
        low, high = (ordered[k] if len(ordered) else np.zeros(count) for k in (low, high))
        share = place % 1.0
        at.append(np.where(share > 0, (1 - share) * low + share * high, low))
    return at[1], (at[2] - at[0]) / _NORMAL_RANGE


def _variances(
    pair: Ints, block: Ints, values: Floats, shared: Ints, blocks: Ints
) -> tuple[Floats, Floats]:
    """Return the variance of values (N, k), and that from the means of blocks; mean over k."""
    count = len(shared)
    n = np.maximum(shared, 1)
    inside = np.bincount(block, minlength=count * _BLOCKS)
    total, between = np.zeros(count), np.zeros(count)
    for column in values.T:
        mean = np.bincount(pair, weights=column, minlength=count) / n
        off = column - mean[pair]
        total += np.bincount(pair, weights=off**2, minlength=count)
        sums = np.bincount(block, weights=off, minlength=count * _BLOCKS)
        power = sums**2 / np.maximum(inside, 1)
        between += power.reshape(count, _BLOCKS).sum(axis=1)
    k = values.shape[1]
    return total / np.maximum(shared - 1, 1) / k, between / (blocks - 1) / k


def _candidates(frame: Ints, code: Ints, x: Floats, *, count: int) -> tuple[Ints, Ints]:
    """Return the pairs to watch: all of few particles, the neighbours of many."""
    if count <= _ALL_PAIRS:
        first, second = np.triu_indices(count, 1)
        return first.astype(np.int64), second.astype(np.int64)
    keys = [np.empty(0, dtype=np.int64)]
    for rows in _sampled_frames(frame, code, count):
        near = _neighbours(x[rows])
        one, other = code[rows[near[:, 0]]], code[rows[near[:, 1]]]
        keys.append(np.unique(np.minimum(one, other) * count + np.maximum(one, other)))
    first, second = np.divmod(np.unique(np.concatenate(keys)), count)
    return first, second


def _sampled_frames(frame: Ints, code: Ints, count: int) -> Iterator[Ints]:
    """Yield the rows of some frames, evenly spaced, and of as many as show every other particle."""
    frames = np.unique(frame)
    chosen = set(frames[np.linspace(0, len(frames) - 1, _SAMPLED).astype(int)].tolist())
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


def _joined(pairs: Pairs, level: Floats, count: int) -> list[tuple[list[int], list[int]]]:
    """Join groups along the pairs; return the members of each and the pairs inside."""
    steady = pairs.steady
    known: list[dict[int, int]] = [{} for _ in range(count)]
    for p, (i, j) in enumerate(zip(pairs.first.tolist(), pairs.second.tolist(), strict=True)):
        if pairs.shared[p] >= _FEWEST:
            known[i][j] = known[j][i] = p
    members = {i: [i] for i in range(count)}
    home = list(range(count))
    inner: dict[int, list[int]] = {i: [] for i in range(count)}
    refused: set[tuple[int, int, int]] = set()
    order = np.flatnonzero(steady)
    order = order[np.argsort(level[order] * pairs.distance[order] ** 2, kind="stable")]
    for i, j in zip(pairs.first[order].tolist(), pairs.second[order].tolist(), strict=True):
        a, b = sorted((home[i], home[j]))
        trial = (a, b, len(members[a]) + len(members[b]))
        if a == b or trial in refused:
            continue
        across = [known[u][v] for u in members[a] for v in members[b] if v in known[u]]
        inside = inner[a] + inner[b]
        if not _one_body(pairs, level, steady, across, inside):
            refused.add(trial)
            continue
        for k in members[b]:
            home[k] = a
        members[a] += members.pop(b)
        inner[a] = inside + across
    return [(g, inner[a]) for a, g in members.items() if len(g) > 1]


def _one_body(
    pairs: Pairs, level: Floats, steady: Bools, across: list[int], inside: list[int]
) -> bool:
    """Return whether the pairs between two groups are as steady as those inside them.

    Pairs at rest are: their variations, perhaps smooth in time, are too small to be compared.
    """
    from scipy.special import fdtri

    if 2 * np.count_nonzero(steady[across]) <= len(across):
        return False
    if not inside or pairs.resting[across + inside].all():
        return True
    if np.mean(level[across]) > _APART**2 * np.mean(level[inside]) + 1e-300:
        return False
    along = level / np.maximum(pairs.variance, 1e-300)
    slow = [float(np.mean(pairs.slow[k] * along[k])) for k in (across, inside)]
    freedom = [float(np.sum(pairs.blocks[k] - 1)) for k in (across, inside)]
    limit = _APART**2 * float(fdtri(*freedom, 1 - _LEVEL))
    return slow[0] <= limit * slow[1] + 1e-300


def _keeps_shape(pairs: Pairs, level: Floats, inside: list[int]) -> bool:
    """Return whether the distances in a group wander less than the separations, if these do."""
    part = Pairs._make(column[inside] for column in pairs)
    total, between = (part.shared - 1) * part.free, (part.blocks - 1) * part.free_slow
    if between.sum() <= _SLOW * total.sum() or part.resting.all():
        return True
    wander = part.slow.sum() <= _PARTAKES * part.free_slow.sum()
    return bool(wander and _turns(pairs, level, inside))


def _turns(pairs: Pairs, level: Floats, inside: list[int]) -> bool:
    """Return whether the separations in a group vary more along the axes than the distances."""
    return bool(np.mean(level[inside]) <= _LESS * np.mean(pairs.free[inside]))
