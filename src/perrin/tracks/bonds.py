"""Which particles keep their distances: rigid bodies among free tracks."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from perrin.tracks.groups import connected_groups, frames_of, group_quantiles

if TYPE_CHECKING:
    from perrin._arrays import Bools, Floats, Ints

# Up to this number of particles every pair is followed; of more only the nearest neighbours, which
# are searched for in some of the frames.
_ALL_PAIRS, _NEAREST_FOLLOWED, _SCREENED_FRAMES = 64, 12, 60

# Followed positions per chunk of pairs: bounds the memory.
_CHUNK_ROWS = 1_000_000

# A pair needs this number of shared frames. They are divided into blocks of time: white noise has
# one of n - 1 parts of its variance per block between them, a random walk seven eighths.
_FEWEST_SHARED, _MOST_BLOCKS, _BLOCK_FRAMES = 8, 8, 5

# Distances farther from the median than 5 standard deviations (from the quantiles at 10 and 90 %)
# are measured wrongly and do not count.
_TAIL_QUANTILE, _GROSS_ERROR = 0.1, 5.0

_NORMAL_RANGE = 2.563  # between these quantiles of a normal distribution, in standard deviations

# A distance is constant where it varies by under a tenth of the distance to the nearest particle.
_CONSTANT_SHARE = 0.1

# Variations are slow where more than half of the variance is between blocks of time. The
# distance of two free particles then varies as their separation does along every axis; that of a
# body by under a tenth of it (variance), or under 30 % of its slow part.
_SLOW_SHARE, _TIED_SHARE, _SLOW_TIED_SHARE = 0.5, 0.1, 0.3

# A pair whose distance varies by under 0.2 % of the distance to the nearest particle, less than any
# localisation error, is at rest.
_REST_SHARE = 2e-3

# Two groups are one body unless the distances between them vary by over 2.5 times (rms) what the
# distances inside vary; slow variations, of which there are few blocks, are compared by an F test
# at this level.
_MOST_EXCESS, _SLOW_TEST_LEVEL = 2.5, 1e-3

# A group whose distances vary by over 6 times those of the tightest group is a body only if they
# vary less (variance) than the separations along the axes. For trapped particles both variances are
# similar.
_LOOSE_RATIO, _TURNING_SHARE = 6.0, 0.7

# The localisation error along one axis of the microscope is at most this factor from that along the
# others. The logarithm of its square costs this share of a fluctuation's sampling error, so that
# equal errors stay equal.
_WORST_AXIS_RATIO, _AXIS_STEPS, _AXIS_PRICE = 5.0, 12, 0.25

# A distance that is constant but for the scale of z: its squares along z and across it are
# anticorrelated more than this. The scale counts where the ratios of three pairs agree within 5 %.
_FEWEST_STRETCHED, _STRETCHED, _EQUAL_STRETCH, _LEAST_STRETCH = 3, -0.9, 0.05, 0.1


class Pairs(NamedTuple):
    """Variances of the separations of pairs of particles, one entry per pair.

    Attributes
    ----------
    first, second : ndarray of int
        Codes of the two particles.
    shared : ndarray of int
        Number of frames that hold both.
    blocks : ndarray of int
        Number of blocks of time into which these frames are divided.
    distance : ndarray
        Median distance, um.
    variance : ndarray
        Variance of the distance, um^2.
    slow : ndarray
        Variance of the distance from the means of the blocks; equal to `variance` for white noise.
    free, free_slow : ndarray
        The same two variances for the separation along the axes, mean over the axes, um^2.
    direction : ndarray, shape (P, d)
        Mean squares of the components of the pair's direction.
    nearest : ndarray
        Distance from either particle to its nearest other one, um.
    """

    first: Ints
    second: Ints
    shared: Ints
    blocks: Ints
    distance: Floats
    variance: Floats
    slow: Floats
    free: Floats
    free_slow: Floats
    direction: Floats
    nearest: Floats

    @classmethod
    def of(cls, first: Ints, second: Ints, pair: Ints, separation: Floats) -> Pairs:
        """Return the statistics of separations (N, d), sorted by pair and time."""
        count = len(first)
        distance = np.linalg.norm(separation, axis=1)
        low, median, high = (
            group_quantiles(pair, distance, count, q=q)
            for q in (_TAIL_QUANTILE, 0.5, 1 - _TAIL_QUANTILE)
        )
        spread = (high - low) / _NORMAL_RANGE
        good = np.abs(distance - median[pair]) <= _GROSS_ERROR * spread[pair] + 1e-9 * median[pair]
        pair, separation, distance = pair[good], separation[good], distance[good]
        shared = np.bincount(pair, minlength=count)
        blocks = np.clip(shared // _BLOCK_FRAMES, 2, _MOST_BLOCKS)
        rank = np.arange(len(pair)) - np.repeat(np.cumsum(shared) - shared, shared)
        block = pair * _MOST_BLOCKS + rank * blocks[pair] // shared[pair]
        off = (distance - median[pair])[:, None]
        variance, slow = _variances(pair, block, off, shared, blocks)
        free, free_slow = _variances(pair, block, separation, shared, blocks)
        # Two particles at one place have no direction: all axes count equally.
        alike = np.where(distance == 0, 1 / np.sqrt(separation.shape[1]), 0.0)[:, None]
        unit = (separation / np.where(distance == 0, 1.0, distance)[:, None] + alike) ** 2
        n = np.maximum(shared, 1)
        direction = [np.bincount(pair, weights=u, minlength=count) / n for u in unit.T]
        return cls(
            first,
            second,
            shared,
            blocks,
            median,
            variance,
            slow,
            free,
            free_slow,
            np.stack(direction, 1),
            np.full(count, np.inf),
        )

    def share(self, slow: Floats, variance: Floats) -> Floats:
        """Return the share of a variance that lies between blocks of time."""
        between, total = slow * (self.blocks - 1), variance * (self.shared - 1)
        # A separation that is constant to rounding does not vary slowly.
        still = total <= self.shared * (1e-12 * self.distance) ** 2
        return np.where(still, 0.0, between / np.where(still, 1.0, total))

    @property
    def resting(self) -> Bools:
        """Whether the distance varies by less than any localisation error."""
        return np.asarray(np.sqrt(self.variance) <= _REST_SHARE * self.nearest)

    @property
    def steady(self) -> Bools:
        """Whether the distance is constant within noise."""
        constant = np.sqrt(self.variance) <= _CONSTANT_SHARE * self.nearest
        white = self.share(self.slow, self.variance) <= _SLOW_SHARE
        tied = self.variance <= _TIED_SHARE * self.free
        still = self.share(self.free_slow, self.free) <= _SLOW_SHARE
        apart = still | (self.slow <= _SLOW_TIED_SHARE * self.free_slow)
        kept = self.resting | tied | (white & apart)
        return np.asarray((self.shared >= _FEWEST_SHARED) & constant & kept)


def rigid_groups(frame: Ints, code: Ints, x: Floats, *, count: int, smallest: int) -> Ints:
    """Group the particles whose mutual distances stay constant within noise.

    Parameters
    ----------
    frame, code : ndarray of int, shape (N,)
        Frame and particle (0 to count - 1) of every detection.
    x : ndarray, shape (N, d)
        Coordinates of each detection, um; no NaN.
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
    pass each other. Particles at rest next to each other keep their distances, too: they cannot be
    distinguished from a body at rest.

    Examples
    --------
    >>> t = np.arange(20)
    >>> x = np.stack([np.cos(t), np.sin(t)], axis=1)
    >>> far = np.stack([9.0 + t**2, 0.0 * t], axis=1)
    >>> rigid_groups(np.tile(t, 3), np.repeat(np.arange(3), 20), np.concatenate([x, -x, far]),
    ...              count=3, smallest=2)
    array([ 0,  0, -1])
    """
    pairs = followed_pairs(frame, code, x, count=count)
    label = np.full(count, -1, dtype=np.int64)
    level = pairs.variance / noise_along(pairs, count=count)
    groups = [g for g in joined_pairs(pairs, level, count) if len(g[0]) >= max(smallest, 2)]
    kept = []
    for members, inside in groups:
        part = Pairs._make(column[inside] for column in pairs)
        total, between = (part.shared - 1) * part.free, (part.blocks - 1) * part.free_slow
        still = between.sum() <= _SLOW_SHARE * total.sum() or part.resting.all()
        wander = part.slow.sum() <= _SLOW_TIED_SHARE * part.free_slow.sum()
        turns = np.mean(level[inside]) <= _TURNING_SHARE * np.mean(pairs.free[inside])
        if still or (wander and turns):
            kept.append((members, float(np.sqrt(np.mean(level[inside]))), bool(turns)))
    tightest = min((rms for _, rms, _ in kept), default=0.0)
    for members, rms, turns in kept:
        if rms <= _LOOSE_RATIO * tightest or turns:
            label[members] = min(members)
    return label


def noise_along(pairs: Pairs, *, count: int) -> Floats:
    """Return the variance of the localisation error along each pair, over its mean over the axes.

    One axis may have a larger or smaller error than the others: axis and ratio are those for which
    the fluctuations of the steady pairs within connected groups agree best (least absolute
    differences of logarithms).

    Parameters
    ----------
    pairs : Pairs
    count : int
        Number of particles.

    Returns
    -------
    ndarray, shape (P,)

    Examples
    --------
    >>> x = np.random.default_rng(0).normal(scale=[0.1, 0.1, 0.4], size=(999, 3, 3))
    >>> x += [[0.0, 0.0, 0.0], [9.0, 0.0, 0.0], [0.0, 0.0, 9.0]]
    >>> frame, code = np.indices((999, 3)).reshape(2, -1)
    >>> pairs = followed_pairs(frame, code, x.reshape(-1, 3), count=3)
    >>> np.sqrt(noise_along(pairs, count=3)).round(1).tolist()  # along x, z, and between them
    [0.4, 1.6, 1.2]
    """
    used = np.flatnonzero(pairs.steady & (pairs.variance > 0))
    dimensions = pairs.direction.shape[1]
    best, weights = np.inf, np.ones(dimensions)
    group = connected_groups(pairs.first[used], pairs.second[used], count=count)[pairs.first[used]]
    sampling = np.sqrt(2 / (pairs.shared[used] - 1))
    price = _AXIS_PRICE * float(np.mean(sampling)) if used.size else 0.0
    factors = np.geomspace(_WORST_AXIS_RATIO**-2, _WORST_AXIS_RATIO**2, 2 * _AXIS_STEPS + 1)
    for factor in factors:
        for axis in range(dimensions):
            trial = np.where(np.arange(dimensions) == axis, factor, 1.0)
            excess = np.log(pairs.variance[used] / (pairs.direction[used] @ trial))
            off = np.abs(excess - group_quantiles(group, excess, count)[group])
            misfit = (float(off.mean()) if off.size else 0.0) + price * abs(np.log(factor))
            if misfit < best:
                best, weights = misfit, trial
    along: Floats = pairs.direction @ (weights / weights.mean())
    return along


def followed_pairs(frame: Ints, code: Ints, x: Floats, *, count: int) -> Pairs:
    """Follow the separations of all pairs that may belong together.

    Parameters
    ----------
    frame, code : ndarray of int, shape (N,)
        Frame and particle (0 to count - 1) of every detection.
    x : ndarray, shape (N, d)
    count : int

    Returns
    -------
    Pairs
        Pairs that share frames.

    Examples
    --------
    >>> x = np.array([[0.0, 0.0], [3.0, 4.0], [1.0, 0.0], [4.0, 4.0]])
    >>> pairs = followed_pairs(np.array([0, 0, 1, 1]), np.array([0, 1, 0, 1]), x, count=2)
    >>> pairs.distance.tolist(), pairs.shared.tolist()
    ([5.0], [2])
    """
    first, second = neighbour_pairs(frame, code, x, count=count)
    number = np.unique(frame, return_inverse=True)[1].astype(np.int64)
    order = np.lexsort((number, code))
    number, code, x = number[order], code[order], x[order]
    lengths = np.bincount(code, minlength=count)
    swapped = lengths[first] > lengths[second]
    brief, other = np.where(swapped, [second, first], [first, second])
    ends = np.cumsum(lengths[brief])
    parts = []
    # Every part holds about the same number of rows, which bounds the memory.
    for part in np.split(np.arange(len(brief)), np.flatnonzero(np.diff(ends // _CHUNK_ROWS)) + 1):
        pair, one, two = shared_rows(number, code, brief[part], other[part])
        parts.append(Pairs.of(first[part], second[part], pair, x[one] - x[two]))
    pairs = Pairs._make(np.concatenate(column) for column in zip(*parts, strict=True))
    seen = pairs.shared > 0
    pairs = Pairs._make(column[seen] for column in pairs)
    nearest = np.full(count, np.inf)
    unlike = pairs.distance > 0
    for side in (pairs.first, pairs.second):
        np.minimum.at(nearest, side[unlike], pairs.distance[unlike])
    return pairs._replace(nearest=np.minimum(nearest[pairs.first], nearest[pairs.second]))


def shared_rows(number: Ints, code: Ints, brief: Ints, other: Ints) -> tuple[Ints, Ints, Ints]:
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


def _variances(
    pair: Ints, block: Ints, values: Floats, shared: Ints, blocks: Ints
) -> tuple[Floats, Floats]:
    """Return the variance of values (N, k), and that from the means of blocks; mean over k."""
    count = len(shared)
    n = np.maximum(shared, 1)
    inside = np.bincount(block, minlength=count * _MOST_BLOCKS)
    total, between = np.zeros(count), np.zeros(count)
    for column in values.T:
        mean = np.bincount(pair, weights=column, minlength=count) / n
        off = column - mean[pair]
        total += np.bincount(pair, weights=off**2, minlength=count)
        sums = np.bincount(block, weights=off, minlength=count * _MOST_BLOCKS)
        power = sums**2 / np.maximum(inside, 1)
        between += power.reshape(count, _MOST_BLOCKS).sum(axis=1)
    k = values.shape[1]
    return total / np.maximum(shared - 1, 1) / k, between / (blocks - 1) / k


def neighbour_pairs(frame: Ints, code: Ints, x: Floats, *, count: int) -> tuple[Ints, Ints]:
    """Return the pairs to follow: all pairs of few particles, the nearest neighbours of many.

    Neighbours are searched for in some frames, evenly spaced, and in as many more as are needed to
    hold every particle.

    Parameters
    ----------
    frame, code : ndarray of int, shape (N,)
    x : ndarray, shape (N, d)
    count : int
        Number of particles.

    Returns
    -------
    first, second : ndarray of int, shape (P,)

    Examples
    --------
    >>> none = np.empty(0, dtype=np.int64)
    >>> [codes.tolist() for codes in neighbour_pairs(none, none, np.empty((0, 3)), count=3)]
    [[0, 0, 1], [1, 2, 2]]
    """
    from scipy.spatial import cKDTree

    if count <= _ALL_PAIRS:
        first, second = np.triu_indices(count, 1)
        return first.astype(np.int64), second.astype(np.int64)
    frames = np.unique(frame)
    chosen = set(frames[np.linspace(0, len(frames) - 1, _SCREENED_FRAMES).astype(int)].tolist())
    seen = np.zeros(count, dtype=np.bool_)
    seen[code[np.isin(frame, list(chosen))]] = True
    rest = np.flatnonzero(~seen[code])
    while rest.size:
        chosen.add(int(frame[rest[rest.size // 2]]))
        seen[code[frame == frame[rest[rest.size // 2]]]] = True
        rest = rest[~seen[code[rest]]]
    kept = np.flatnonzero(np.isin(frame, list(chosen)))
    keys = [np.empty(0, dtype=np.int64)]
    for part in frames_of(frame[kept]):
        rows = kept[part]
        k = min(_NEAREST_FOLLOWED + 1, len(rows))
        near = cKDTree(x[rows]).query(x[rows], k)[1].reshape(len(rows), k)
        one, other = code[np.repeat(rows, k)], code[rows[near.ravel()]]
        key = np.minimum(one, other) * count + np.maximum(one, other)
        keys.append(np.unique(key[one != other]))
    first, second = np.divmod(np.unique(np.concatenate(keys)), count)
    return first, second


def joined_pairs(pairs: Pairs, level: Floats, count: int) -> list[tuple[list[int], list[int]]]:
    """Join particles along steady pairs, from the nearest and steadiest on, while they are a body.

    Parameters
    ----------
    pairs : Pairs
    level : ndarray, shape (P,)
        Variance of each distance in units of the localisation error along the pair.
    count : int
        Number of particles.

    Returns
    -------
    list of (list of int, list of int)
        The particles of each group, and the indices of the pairs inside it.

    Examples
    --------
    >>> x = np.random.default_rng(0).normal(scale=0.1, size=(99, 3, 2)) + [[0, 0], [9, 0], [0, 9]]
    >>> frame, code = np.indices((99, 3)).reshape(2, -1)
    >>> pairs = followed_pairs(frame, code, x.reshape(-1, 2), count=3)
    >>> [sorted(members) for members, _ in joined_pairs(pairs, pairs.variance, 3)]
    [[0, 1, 2]]
    """
    steady = pairs.steady
    pair_of: list[dict[int, int]] = [{} for _ in range(count)]
    for p, (i, j) in enumerate(zip(pairs.first.tolist(), pairs.second.tolist(), strict=True)):
        if pairs.shared[p] >= _FEWEST_SHARED:
            pair_of[i][j] = pair_of[j][i] = p
    members = {i: [i] for i in range(count)}
    group = list(range(count))
    inner: dict[int, list[int]] = {i: [] for i in range(count)}
    refused: set[tuple[int, int, int]] = set()
    order = np.flatnonzero(steady)
    order = order[np.argsort(level[order] * pairs.distance[order] ** 2, kind="stable")]
    for i, j in zip(pairs.first[order].tolist(), pairs.second[order].tolist(), strict=True):
        a, b = sorted((group[i], group[j]))
        trial = (a, b, len(members[a]) + len(members[b]))
        if a == b or trial in refused:
            continue
        across = [pair_of[u][v] for u in members[a] for v in members[b] if v in pair_of[u]]
        inside = inner[a] + inner[b]
        if not are_one_body(pairs, level, steady, across, inside):
            refused.add(trial)
            continue
        for k in members[b]:
            group[k] = a
        members[a] += members.pop(b)
        inner[a] = inside + across
    return [(particles, inner[a]) for a, particles in members.items() if len(particles) > 1]


def are_one_body(
    pairs: Pairs, level: Floats, steady: Bools, across: list[int], inside: list[int]
) -> bool:
    """Return whether the pairs between two groups are as steady as those inside them.

    Pairs at rest are: their variations, perhaps smooth in time, are too small to be compared.

    Parameters
    ----------
    pairs : Pairs
    level : ndarray, shape (P,)
        Variance of each distance in units of the localisation error along the pair.
    steady : ndarray of bool, shape (P,)
        As `Pairs.steady`.
    across, inside : list of int
        The pairs between the two groups, and those inside either.

    Returns
    -------
    bool

    Examples
    --------
    >>> x = np.random.default_rng(0).normal(scale=0.1, size=(99, 3, 2)) + [[0, 0], [9, 0], [0, 9]]
    >>> frame, code = np.indices((99, 3)).reshape(2, -1)
    >>> pairs = followed_pairs(frame, code, x.reshape(-1, 2), count=3)
    >>> are_one_body(pairs, pairs.variance, pairs.steady, [1, 2], [0])
    True
    """
    from scipy.special import fdtri

    if 2 * np.count_nonzero(steady[across]) <= len(across):
        return False
    if not inside or pairs.resting[across + inside].all():
        return True
    if np.mean(level[across]) > _MOST_EXCESS**2 * np.mean(level[inside]) + 1e-300:
        return False
    along = level / np.maximum(pairs.variance, 1e-300)
    slow = [float(np.mean(pairs.slow[k] * along[k])) for k in (across, inside)]
    freedom = [float(np.sum(pairs.blocks[k] - 1)) for k in (across, inside)]
    limit = _MOST_EXCESS**2 * float(fdtri(*freedom, 1 - _SLOW_TEST_LEVEL))
    return slow[0] <= limit * slow[1] + 1e-300


def stretch_of_pairs(x: Floats) -> tuple[float, int]:
    """Return the factor of z with which distances of neighbours stay the same, and their number.

    Where dx^2 + dy^2 + s^2 dz^2 is constant while the pair turns, its first two terms and dz^2 lie
    on a line with the slope -s^2.

    Parameters
    ----------
    x : ndarray, shape (T, n, 3)
        Positions, NaN where a particle is missing.

    Returns
    -------
    factor : float
        1 where fewer than three pairs agree on another one.
    pairs : int
        Number of these pairs.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> turning = simulate_motion(Cluster.tetrahedron(1.5), D_R=0.02, dt=1.0, n_frames=200, rng=1)
    >>> factor, pairs = stretch_of_pairs(turning.positions() / [1.0, 1.0, 2.0])
    >>> round(factor, 3), pairs
    (2.0, 6)
    """
    first, second = np.triu_indices(x.shape[1], 1)
    square = (x[:, first] - x[:, second]) ** 2
    across, along = square[..., :2].sum(axis=-1), square[..., 2]
    known = np.isfinite(across)
    shared = np.maximum(known.sum(axis=0), 1)
    mean_across, mean_along = (np.where(known, v, 0).sum(axis=0) / shared for v in (across, along))
    a = np.where(known, across - mean_across, 0)
    b = np.where(known, along - mean_along, 0)
    spread_a, spread_b, both = (a * a).sum(axis=0), (b * b).sum(axis=0), (a * b).sum(axis=0)
    moving = (shared >= _BLOCK_FRAMES * _MOST_BLOCKS) & (spread_a > 0) & (spread_b > 0)
    correlation = both[moving] / np.sqrt(spread_a[moving] * spread_b[moving])
    factor = np.sqrt(np.maximum(-both[moving] / spread_b[moving], 0))
    factor = factor[correlation < _STRETCHED]
    if len(factor) < _FEWEST_STRETCHED:
        return 1.0, 0
    middle = float(np.median(factor))
    agree = np.abs(factor / middle - 1) < _EQUAL_STRETCH
    if agree.sum() < max(_FEWEST_STRETCHED, len(factor) / 2) or abs(middle - 1) < _LEAST_STRETCH:
        return 1.0, 0
    return middle, int(agree.sum())
