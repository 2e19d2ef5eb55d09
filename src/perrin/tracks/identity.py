"""Which detection is which particle of a body, in every frame."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations, permutations
from math import lgamma
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from perrin._arrays import Bools, Floats, Ints, as_positions, frozen, present
from perrin.geometry.rigid import degrees_of_freedom
from perrin.geometry.rotations import fit_rotations

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import ArrayLike


# A fit is noise-like up to this multiple of the usual mean square residual: chance does not reach
# it in a frame of usual quality, and an exchanged pair (1000 times and more) is far above.
_NOISE = 16.0


# Degrees of freedom of the Student law of a frame's misfit: the odds between two assignments of a
# bad frame depend on the ratio of their misfits, not on their difference in units of usual noise.
_STUDENT = 8.0


# Up to so many particles every assignment is tried, and so many frames at most build the template.
_ALL, _MODELS = 6, 300


# Log-odds: an assignment is settled when the next best is a hundred times less likely, and lasting
# labels are trusted e^18 times more than an exchange of them. Right labels are then doubted when
# chance makes another assignment e^18/100 = 6.6e5 times likelier, in at most 300 x 11/6.6e5 = 0.5 %
# of the tracks of 300 frames of a tetrahedron (likelihood ratios exceed c with probability 1/c).
_DOUBT, _TRUST = float(np.log(100.0)), 18.0


# A least turn of over this many standard deviations of an axis (squared) widens the law of the step
# to itself. Lasting labels that turn the body 75 degrees are kept against an exchange that leaves
# 45 (a tetrahedron), and replaced where the exchange leaves a third or less of the turn.
_LEAP_UNLABELLED, _LEAP_LABELLED = 16.0, 4.0


# A step of under 0.4 of the least angle between two assignments cannot be mistaken.
_SHORT = 0.4


_BATCH = 100_000


_COMPLETE = 0.05


_TINY = 1e-6  # rad: what rounding leaves of a rotation


# Of large bodies a fit this near (of the least particle distance) is right; searched from one in
# five of the orientations.
_CLOSE, _COARSE = 0.1, 5


@dataclass(frozen=True, eq=False)
class Identity:
    """Which column of an array of detections holds which particle, row by row.

    Attributes
    ----------
    order : ndarray of int, shape (T, n)
        The column of each particle; -1 where it is missing.
    piece : ndarray of int, shape (T,)
        Stretches of doubtless identity.
    swaps : ndarray of int
        Rows at which a label passes to another particle; `order` corrects it.
    cuts : ndarray of int
        Rows that begin a new piece: two assignments were about as likely.
    extra : ndarray of int
        Rows in which a detection is left out as no particle of the body.
    unsettled : ndarray of int
        Rows with enough detections for a pose whose misfit is over 16 times the usual mean square.
        They keep their labels.
    """

    order: Ints
    piece: Ints
    swaps: Ints
    cuts: Ints
    extra: Ints
    unsettled: Ints

    def __post_init__(self) -> None:
        frozen(self.order, self.piece, self.swaps, self.cuts, self.extra, self.unsettled)

    def arranged(self, positions: ArrayLike) -> Floats:
        """Return the detections (T, m, d) as particles (T, n, d), NaN where missing."""
        x = as_positions(positions)
        taken = np.take_along_axis(x, np.maximum(self.order, 0)[..., None], axis=1)
        return np.where(self.order[..., None] >= 0, taken, np.nan)


def settle_identity(
    positions: ArrayLike,
    *,
    times: ArrayLike | None = None,
    size: int | None = None,
    labelled: bool = True,
) -> Identity:
    """Decide in every frame which detection is which particle of one rigid body.

    Of the assignments that fit the common shape as well as noise allows, by a proper rotation, the
    one of least rotation since the last frame is taken. Mirror images never fit (in the plane of a
    flat body they do, as half turns). Where the second best is nearly as likely the track is cut.

    Parameters
    ----------
    positions : array_like, shape (T, m, d)
        Detections of one body, um; NaN where there is none. Columns mean nothing where `labelled`
        is False. Columns that are never seen together may be the same particle.
    times : array_like, shape (T,), optional
        Time of each row, any unit; default 0, 1, 2, ...
    size : int, optional
        Number of particles n of the body; default: the columns with points in over 5 % of the rows
        if every two of them are seen together, else the most seen together in 5 % of the rows.
    labelled : bool
        Whether a column is meant to be one particle throughout. It then stays one unless an
        exchange is e^18 times more likely.

    Returns
    -------
    Identity

    Raises
    ------
    ValueError
        For bad shapes.

    Notes
    -----
    The likelihood of an assignment is (1 + S/(8 sigma^2))^(-(8 + f)/2) exp(-theta^2/(2 s^2)): S is
    the squared residual of the fit with f degrees of freedom, sigma^2 from its median, theta the
    angle of the step and s^2 from the median step, growing with the time across gaps. The misfit
    follows a Student law, so that a frame noisier than the others is no evidence for another
    assignment. s^2 is at least 1/16 of the least squared turn (1/4 with labels): a leap is not
    judged by the law of small steps. With labels the assignment last held is always a candidate,
    in a frame in which nothing fits as well. All assignments are tried for up to 6
    particles; beyond, linear assignment and rigid fit in turn, from many orientations.

    Examples
    --------
    >>> import numpy as np
    >>> from perrin import Cluster, simulate_motion
    >>> from perrin.tracks.identity import settle_identity
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=40, rng=1)
    >>> x = truth.positions() + 0.01 * np.random.default_rng(1).normal(size=(40, 4, 3))
    >>> x[25:] = x[25:, [1, 0, 2, 3]]
    >>> found = settle_identity(x)
    >>> found.swaps.tolist(), found.order[24].tolist(), found.order[25].tolist()
    ([25], [0, 1, 2, 3], [1, 0, 2, 3])
    """
    x = as_positions(positions)
    seen = present(x)
    time = np.arange(len(x), dtype=np.float64) if times is None else np.asarray(times, np.float64)
    n = _size(seen) if size is None else size
    frames = _Frames.of(x, seen, n)
    if labelled and _undoubted(frames, _body_as_given(frames)):
        return _as_given(seen, n)
    seed = _seed(x, seen, n)
    if seed is None:
        return _as_given(seen, n) if labelled else _unknown(seen, n)
    body = _body(frames, seed, labelled=labelled)
    lists = _assignments(frames, body, labelled=labelled)
    answer = _chained(frames, body, lists, time, labelled=labelled)
    seat = _completed(body.seat, answer.order) if labelled else body.seat
    if labelled and not answer.cuts.size and (seat == body.seat).all():
        return answer
    body = body._replace(seat=seat)
    # The first shape mixes equivalent views of the body; the second keeps its small irregularities.
    body = _remade(body, answer, x)
    lists = _assignments(frames, body, labelled=labelled)
    return _chained(frames, body, lists, time, labelled=labelled)


class _Frames(NamedTuple):
    """Detections moved to the left: x (T, w, d), the columns they came from, and how many."""

    x: Floats
    column: Ints
    shown: Ints
    n: int

    @classmethod
    def of(cls, x: Floats, seen: Bools, n: int) -> _Frames:
        width = max(int(seen.sum(axis=1).max()), n)
        column = np.argsort(~seen, axis=1, kind="stable")[:, :width]
        here = np.take_along_axis(seen, column, axis=1)
        points = np.take_along_axis(x, column[..., None], axis=1)
        pad = width - column.shape[1]
        column = np.pad(np.where(here, column, -1), ((0, 0), (0, pad)), constant_values=-1)
        points = np.pad(points, ((0, 0), (0, pad), (0, 0)), constant_values=np.nan)
        return cls(np.where((column >= 0)[..., None], points, np.nan), column, here.sum(axis=1), n)


class _Body(NamedTuple):
    """The shape, its noise, its near-symmetries as permutations, and the particle of each column.

    `seat` (m,) holds the particle that each column is meant to be, -1 where that is unknown.
    """

    template: Floats
    sigma2: float
    group: Ints
    seat: Ints


class _Lists(NamedTuple):
    """The candidate assignments of every frame, padded to (T, C).

    `place` is the position in `_Frames` of each particle, `cost` minus the log-likelihood of the
    misfit, infinite where there is no candidate, `fits` whether the misfit is noise-like. `own` are
    the rows whose first candidate is the labels as given, with a noise-like misfit.
    """

    place: Ints
    rotation: Floats
    cost: Floats
    fits: Bools
    own: Ints


def _size(seen: Bools) -> int:
    """Return how many particles the body has.

    Columns never seen together may be one particle, and one seen in few frames may be none.
    """
    lasting = seen[:, seen.sum(axis=0) > _COMPLETE * len(seen)].astype(np.float64)
    if lasting.size and (lasting.T @ lasting > 0).all():
        return int(lasting.shape[1])
    counts = np.sort(seen.sum(axis=1))
    counts = counts[counts > 0]
    return int(counts[-max(1, int(np.ceil(_COMPLETE * len(counts))))]) if counts.size else 0


def _seed(x: Floats, seen: Bools, n: int) -> int | None:
    """Return a complete frame to begin with: of a few, the one that most frames look like."""
    d = x.shape[2]
    rows = np.flatnonzero(seen.sum(axis=1) == n)
    if n < d or n > seen.shape[1] or rows.size < 2:
        return None
    rows = rows[np.linspace(0, rows.size - 1, min(rows.size, 15)).astype(int)]
    points = np.stack([x[k][seen[k]] for k in rows])
    misfit = [np.median(_best(points, points[k])[1]) for k in range(min(5, rows.size))]
    best = int(np.argmin(misfit))
    return int(rows[best]) if np.isfinite(misfit[best]) else None


def _as_given(seen: Bools, n: int) -> Identity:
    """Leave the columns as they are: one particle each."""
    none = np.empty(0, dtype=np.int64)
    order = np.where(seen, np.arange(seen.shape[1]), -1)
    piece = np.zeros(len(seen), dtype=np.int64)
    unsettled = none if n == seen.shape[1] else np.arange(len(seen))
    return Identity(order, piece, none, none.copy(), none.copy(), unsettled)


def _unknown(seen: Bools, n: int) -> Identity:
    """Settle nothing: no frame shows the whole body."""
    none = np.empty(0, dtype=np.int64)
    order = np.full((len(seen), n), -1, dtype=np.int64)
    piece = np.zeros(len(seen), dtype=np.int64)
    return Identity(order, piece, none, none.copy(), none.copy(), np.flatnonzero(seen.any(axis=1)))


def _fits(points: Floats, template: Floats) -> tuple[Floats, Floats]:
    """Return the rotation and the squared residual of each rigid fit; inf where not unique."""
    rotation, unique = fit_rotations(points, template)
    here = present(points) & present(template)
    weight = here[..., None] / np.maximum(here.sum(axis=-1), 1)[..., None, None]
    y, t = np.where(here[..., None], points, 0.0), np.where(here[..., None], template, 0.0)
    y = y - (y * weight).sum(axis=-2, keepdims=True)
    t = t - (t * weight).sum(axis=-2, keepdims=True)
    e = np.where(here[..., None], y - t @ np.swapaxes(rotation, -1, -2), 0.0)
    return rotation, np.where(unique, (e * e).sum(axis=(-2, -1)), np.inf)


@lru_cache(maxsize=64)
def _table(m: int, n: int, used: int) -> Ints:
    """Return all ways (C, n) to seat `used` of m detections on n particles; -1 is an empty seat."""
    rows = []
    for seats in combinations(range(n), used):
        for taken in permutations(range(m), used):
            row = [-1] * n
            for seat, detection in zip(seats, taken, strict=True):
                row[seat] = detection
            rows.append(row)
    table = np.array(rows, dtype=np.int64)
    frozen(table)
    return table


def _seated(points: Floats, order: Ints) -> Floats:
    """Return points (K, w, d) in the places that order (K, C, n) or (C, n) says, (K, C, n, d)."""
    index = np.broadcast_to(order, (len(points), *order.shape[-2:]))
    rows = np.arange(len(points))[:, None, None]
    return np.where((index >= 0)[..., None], points[rows, np.maximum(index, 0)], np.nan)


def _batches(count: int, width: int) -> Iterator[slice]:
    step = max(1, _BATCH // max(width, 1))
    return (slice(low, low + step) for low in range(0, count, step))


def _best(points: Floats, template: Floats) -> tuple[Ints, Floats]:
    """Return the best assignment (K, n) of complete frames (K, n, d), and its misfit (K,)."""
    n = len(template)
    return _matched(points, template) if n > _ALL else _best_of(points, template, _table(n, n, n))


def _best_of(points: Floats, template: Floats, table: Ints) -> tuple[Ints, Floats]:
    """Return the best of the assignments in a table (C, n) for every frame, and its misfit."""
    best, least = np.empty((len(points), len(template)), np.int64), np.empty(len(points))
    for rows in _batches(len(points), len(table)):
        misfit = _fits(_seated(points[rows], table), template)[1]
        choice = np.argmin(misfit, axis=1)
        best[rows], least[rows] = (
            table[choice],
            np.take_along_axis(misfit, choice[:, None], 1)[:, 0],
        )
    return best, least


def _matched(points: Floats, template: Floats) -> tuple[Ints, Floats]:
    """Assign large bodies by linear assignment and rigid fit in turn, from many orientations.

    The last frame's rotation comes first; a fit much closer than any wrong one ends the search.
    """
    n, d = template.shape
    best, least = np.zeros((len(points), n), np.int64), np.full(len(points), np.inf)
    apart = np.linalg.norm(template[:, None] - template, axis=2) + np.diag(np.full(n, np.inf))
    enough = (_CLOSE * float(apart.min())) ** 2 * _freedom(n, d)
    last = np.eye(d)
    for k, x in enumerate(points):
        for rotation in (last, *_orientations(d)[::_COARSE]):
            order, turned, misfit = _refined(x, template, rotation)
            if misfit < least[k]:
                best[k], least[k], last = order, misfit, turned
            if least[k] <= enough:
                break
    return best, least


def _refined(x: Floats, template: Floats, rotation: Floats) -> tuple[Ints, Floats, float]:
    """Assign and fit in turn until the assignment rests."""
    from scipy.optimize import linear_sum_assignment

    order, misfit = np.arange(len(template)), np.inf
    y, t = x - x.mean(axis=0), template - template.mean(axis=0)
    for _ in range(20):
        # The squared distances differ from this by what does not depend on the assignment.
        new = linear_sum_assignment(-(t @ rotation.T) @ y.T)[1]
        if np.isfinite(misfit) and (new == order).all():
            break
        order = new
        rotation, value = _fits(y[order], t)
        misfit = float(value)
        if not np.isfinite(misfit):
            break
    return order, rotation, misfit


@lru_cache(maxsize=2)
def _orientations(d: int) -> Floats:
    """Return orientations that cover all rotations: every one has a start within about 30 degrees.

    Super-Fibonacci spirals in three dimensions (Alexa, CVPR 2022).
    """
    count = 300
    s = np.arange(count) + 0.5
    if d == 2:
        angle = 2 * np.pi * s[::10] / count
        c, v = np.cos(angle), np.sin(angle)
        turns = np.stack([np.stack([c, -v], -1), np.stack([v, c], -1)], -2)
        frozen(turns)
        return turns
    inner, outer = np.sqrt(s / count), np.sqrt(1 - s / count)
    alpha, beta = 2 * np.pi * s / np.sqrt(2.0), 2 * np.pi * s / 1.533751168755204288118041
    a, b = inner * np.sin(alpha), inner * np.cos(alpha)
    c, w = outer * np.sin(beta), outer * np.cos(beta)
    turns = np.empty((count, 3, 3))
    turns[:, 0] = np.stack([1 - 2 * (b * b + c * c), 2 * (a * b - c * w), 2 * (a * c + b * w)], -1)
    turns[:, 1] = np.stack([2 * (a * b + c * w), 1 - 2 * (a * a + c * c), 2 * (b * c - a * w)], -1)
    turns[:, 2] = np.stack([2 * (a * c - b * w), 2 * (b * c + a * w), 1 - 2 * (a * a + b * b)], -1)
    frozen(turns)
    return turns


def _body_as_given(frames: _Frames) -> _Body | None:
    """Build the shape as if all labels were right; None if they are not."""
    n, d = frames.n, frames.x.shape[2]
    rows = np.flatnonzero(frames.shown == n)
    if n < d or rows.size < 2 or frames.x.shape[1] != n:
        return None
    rows = rows[np.linspace(0, rows.size - 1, min(rows.size, _MODELS)).astype(int)]
    label = frames.column[rows[0]]
    if not (frames.column[rows] == label).all():
        return None
    points = frames.x[rows]
    template = points[0] - points[0].mean(axis=0)
    rotation, misfit = _fits(points, template)
    # Of two labellings that share the time, neither is right for all: the lower tenth shows one.
    lowest = float(np.sort(misfit[1:])[(rows.size - 1) // 10])
    usual = max(lowest, _TINY**2 * float((template**2).sum()))
    if not misfit.max() <= 2 * _NOISE * usual:
        return None
    seat = _seats(label, int(frames.column.max()) + 1)
    return _body_of(_mean_shape(points, rotation), points, seat)


def _seats(label: Ints, count: int) -> Ints:
    """Return the particle of each of so many columns, given the column of each particle."""
    seat = np.full(count, -1, dtype=np.int64)
    seat[label] = np.arange(label.size)
    return seat


def _completed(seat: Ints, order: Ints) -> Ints:
    """Give a column of unknown particle the one it was most often assigned to."""
    count = np.zeros((seat.size, order.shape[1]), dtype=np.int64)
    row, particle = np.nonzero(order >= 0)
    np.add.at(count, (order[row, particle], particle), 1)
    found = np.where(count.any(axis=1), count.argmax(axis=1), -1)
    return np.where(seat >= 0, seat, found)


def _body(frames: _Frames, seed: int, *, labelled: bool) -> _Body:
    """Build the shape from frames assigned to the seed, and find its symmetries within noise."""
    n, d = frames.n, frames.x.shape[2]
    label = frames.column[seed, :n]
    rows = np.flatnonzero(frames.shown == n)
    rows = rows[np.linspace(0, rows.size - 1, min(rows.size, _MODELS)).astype(int)]
    some = frames.x[rows[:: max(1, rows.size // 15)], :n]
    template = frames.x[seed, :n] - frames.x[seed, :n].mean(axis=0)
    freedom = _freedom(n, d)
    sigma2 = float(np.median(_best(some, template)[1])) / _median_chi2(freedom)
    seat = _seats(label, int(frames.column.max()) + 1)
    rough = _Body(template, sigma2, _group(template, sigma2), seat)
    order = np.broadcast_to(np.arange(n), (rows.size, n)).copy()
    same = (frames.column[rows, :n] == label).all(axis=1) & labelled
    misfit = np.full(rows.size, np.inf)
    misfit[same] = _fits(frames.x[rows[same], :n], template)[1]
    odd = np.flatnonzero(misfit > _NOISE * sigma2 * freedom)
    order[odd], misfit[odd] = _base(frames.x[rows[odd], :n], rough)
    good = misfit <= 2 * _NOISE * sigma2 * freedom
    points = _seated(frames.x[rows[good]], order[good][:, None])[:, 0]
    return _averaged(points, template, seat)


def _averaged(points: Floats, shape: Floats, seat: Ints) -> _Body:
    """Average complete frames (K, n, d), in order, to a shape; find its noise and symmetries."""
    rotation, misfit = _fits(points, shape)
    fits = np.isfinite(misfit)
    if fits.any():
        shape = _mean_shape(points[fits], rotation[fits])
    return _body_of(shape, points, seat)


def _mean_shape(points: Floats, rotation: Floats) -> Floats:
    """Average complete frames in the axes of the body."""
    centred = points - points.mean(axis=1, keepdims=True)
    mean: Floats = np.einsum("tij,tni->tnj", rotation, centred).mean(axis=0)
    return mean


def _body_of(shape: Floats, points: Floats, seat: Ints) -> _Body:
    """Find the noise of frames about a shape, and its symmetries within that noise."""
    n, d = shape.shape
    # Rounding takes the place of noise where there is none.
    sigma2 = float(np.median(_fits(points, shape)[1])) / _median_chi2(_freedom(n, d))
    sigma2 = max(sigma2, (1e-7 * float(np.abs(shape).max())) ** 2)
    return _Body(shape, sigma2, _group(shape, sigma2), seat)


def _remade(body: _Body, answer: Identity, x: Floats) -> _Body:
    """Build the shape again, from the longest stretch without a cut."""
    whole = (answer.order >= 0).all(axis=1)
    longest = np.bincount(answer.piece[whole], minlength=1).argmax()
    rows = np.flatnonzero(whole & (answer.piece == longest))
    if rows.size < 2:
        return body
    rows = rows[np.linspace(0, rows.size - 1, min(rows.size, _MODELS)).astype(int)]
    points = np.take_along_axis(x[rows], answer.order[rows][..., None], axis=1)
    return _averaged(points, body.template, body.seat)


def _freedom(n: int, d: int) -> float:
    return max(float(degrees_of_freedom(np.array(n), d)), 1.0)


def _median_chi2(freedom: float) -> float:
    """Return the median of chi squared (Wilson and Hilferty, 1931; within 3 % from 1 on)."""
    return freedom * (1 - 2 / (9 * freedom)) ** 3


def _group(template: Floats, sigma2: float) -> Ints:
    """Return the permutations (G, n) that leave the shape as it is within noise, identity first."""
    n, d = template.shape
    limit = 2 * _NOISE * sigma2 * float(degrees_of_freedom(np.array(n), d))
    if n <= _ALL:
        table = _table(n, n, n)
        alike = _fits(template[table], template)[1] <= limit
        alike[0] = True
        return np.asarray(table[alike])
    found = [tuple(range(n))]
    for start in _orientations(d):
        order, _, misfit = _refined(template, template, start)
        if misfit <= limit and tuple(order.tolist()) not in found:
            found.append(tuple(order.tolist()))
    return np.array(found, dtype=np.int64)


def _places(frames: _Frames, seat: Ints) -> Ints:
    """Return where (T, n) each particle stands among the detections by the labels, or -1."""
    particle = np.where(frames.column >= 0, seat[frames.column], -1)
    place = np.full((len(particle), frames.n), -1, dtype=np.int64)
    row, detection = np.nonzero(particle >= 0)
    place[row, particle[row, detection]] = detection
    return place


def _known(frames: _Frames, place: Ints) -> Bools:
    """Return the frames whose every detection has a label of a particle of its own."""
    return np.asarray((place >= 0).sum(axis=1) == frames.shown)


def _limit(count: Ints, body: _Body) -> Floats:
    """Return the misfit up to which a frame with so many particles is noise-like."""
    freedom = degrees_of_freedom(count, body.template.shape[1])
    return np.asarray(_NOISE * body.sigma2 * freedom, dtype=np.float64)


def _undoubted(frames: _Frames, body: _Body | None) -> bool:
    """Return whether the labels fit everywhere and no step is long enough to be mistaken."""
    if body is None:
        return False
    place = _places(frames, body.seat)
    rows = np.flatnonzero(frames.shown >= body.template.shape[1])
    if not _known(frames, place).all():
        return False
    rotation, misfit = _fits(_seated(frames.x[rows], place[rows, None])[:, 0], body.template)
    if not (misfit <= _limit(frames.shown[rows], body)).all():
        return False
    seats, which = np.unique(place[rows] >= 0, axis=0, return_inverse=True)
    least = np.array([_least_angle(body, tuple(s.tolist())) for s in seats])[which.ravel()]
    angle = np.sqrt(_square_angle(rotation[:-1], rotation[1:]))
    return bool((angle < _SHORT * np.minimum(least[:-1], least[1:])).all())


def _least_angle(body: _Body, here: tuple[bool, ...]) -> float:
    """Return the least angle between two noise-like assignments of the particles that are here."""
    seats = np.flatnonzero(here)
    n = len(body.template)
    if n > _ALL:
        seats = np.arange(n)
    table = body.group if seats.size == n else _table(seats.size, n, seats.size)
    points = body.template if seats.size == n else body.template[seats]
    rotation, misfit = _fits(_seated(points[None], table)[0], body.template)
    angle = np.sqrt(_square_angle(rotation, np.eye(len(rotation[0]))))
    own = np.full(n, -1)
    own[seats] = np.arange(seats.size)
    other = (table != own).any(axis=1) & (misfit <= 2 * _limit(np.array(seats.size), body))
    return float(angle[other].min(initial=np.pi))


def _square_angle(one: Floats, other: Floats) -> Floats:
    """Return the squared angle between rotations; sin^2(angle / 2) = (d - tr(A^T B)) / 4."""
    trace = np.einsum("...ij,...ij->...", one, other)
    half = np.sqrt(np.clip((one.shape[-1] - trace) / 4, 0.0, 1.0))
    return np.asarray((2 * np.arcsin(half)) ** 2)


def _assignments(frames: _Frames, body: _Body, *, labelled: bool) -> _Lists:
    """List the candidates of every frame: the noise-like assignments and the labels as given.

    A frame in which nothing is noise-like still shows how far the body has turned. Its candidates
    are the labels as given and what the symmetries of the body make of them.
    """
    n = frames.n
    found: dict[int, Ints] = {}
    place = _places(frames, body.seat)
    misfit = np.full(len(frames.x), np.inf)
    trusted = np.flatnonzero(_known(frames, place) & (frames.shown > 0) & labelled)
    seated = _seated(frames.x[trusted], place[trusted, None])[:, 0]
    misfit[trusted] = _fits(seated, body.template)[1]
    given = np.flatnonzero(np.isfinite(misfit))
    fits = misfit <= _limit(frames.shown, body)
    whole = np.flatnonzero(frames.shown == n)
    base = place.copy()
    odd = whole[~fits[whole]]
    base[odd], misfit[odd] = _base(frames.x[odd, :n], body)
    for k in whole[misfit[whole] <= _limit(frames.shown[whole], body)]:
        found[int(k)] = base[k][body.group]
    if n <= _ALL:
        _search(frames, body, found, drop=0)
        _search(frames, body, found, drop=1)
    else:
        _patch(frames, body, found, place, fits)
    for k in given.tolist():
        if k not in found:
            found[k] = place[k][body.group]
        elif (found[k][0] != place[k]).any():
            others = (found[k] != place[k]).any(axis=1)
            found[k] = np.concatenate([place[k][None], found[k][others]])
    return _padded(frames, body, found, np.flatnonzero(fits))


def _base(points: Floats, body: _Body) -> tuple[Ints, Floats]:
    """Return one assignment that fits; up to symmetry only one in |G| has to be tried."""
    n = len(body.template)
    if n > _ALL:
        return _matched(points, body.template)
    rest = dict.fromkeys(map(tuple, _table(n, n, n).tolist()))
    chosen = []
    while rest:
        row = np.array(next(iter(rest)))
        chosen.append(row)
        for other in row[body.group].tolist():
            rest.pop(tuple(other), None)
    return _best_of(points, body.template, np.array(chosen))


def _search(frames: _Frames, body: _Body, found: dict[int, Ints], *, drop: int) -> None:
    """Try every assignment of the frames that have none yet, leaving `drop` detections out."""
    n, d = body.template.shape
    for count in np.unique(frames.shown).tolist():
        used = min(count, n) - drop
        rows = np.array([k for k in np.flatnonzero(frames.shown == count) if k not in found], int)
        if used < d or count > _ALL + 1 or not rows.size:
            continue
        table = _table(count, n, used)
        limit = float(_limit(np.array(used), body))
        for part in _batches(rows.size, len(table)):
            points = frames.x[rows[part]]
            rotation, misfit = _fits(_seated(points, table), body.template)
            fits = misfit <= limit
            if drop and count <= n:
                fits &= _strays(points[:, :count], table, rotation, body.template)
            for k, fit in zip(rows[part].tolist(), fits, strict=True):
                if fit.any():
                    found[k] = table[fit]


def _patch(frames: _Frames, body: _Body, found: dict[int, Ints], place: Ints, fits: Bools) -> None:
    """Seat the detections of incomplete frames of large bodies, near where their labels say."""
    from scipy.optimize import linear_sum_assignment

    d = body.template.shape[1]
    for k in np.flatnonzero((frames.shown >= d) & (frames.shown <= frames.n)).tolist():
        if k in found:
            continue
        x, order = frames.x[k, : frames.shown[k]], place[k]
        for _ in range(0 if fits[k] else 10):
            seated = _seated(frames.x[k][None], order[None])[0, 0]
            rotation, misfit = _fits(seated, body.template)
            if not np.isfinite(misfit):
                break
            lab = body.template @ rotation.T
            away = lab + np.nanmean(seated - lab, axis=0) - x[:, None]
            detection, seat = linear_sum_assignment((away**2).sum(axis=2))
            order = np.full(frames.n, -1, dtype=np.int64)
            order[seat] = detection
        misfit = _fits(_seated(frames.x[k][None], order[None])[0, 0], body.template)[1]
        if misfit <= float(_limit(frames.shown[k], body)):
            found[k] = order[None]


def _strays(points: Floats, table: Ints, rotation: Floats, template: Floats) -> Bools:
    """Return where the detection left out is over half a particle distance from all empty seats.

    Nearer it is one of the body's particles, measured badly.
    """
    n, count = len(template), points.shape[1]
    taken = (table[:, :, None] == np.arange(count)).any(axis=1)
    left = points[:, np.argmin(taken, axis=1)]
    seated = _seated(points, table)
    here = (table >= 0)[..., None]
    share = here / here.sum(axis=1, keepdims=True)
    center = (np.nan_to_num(seated) * share).sum(axis=2)
    arms = template[None] - (template[None] * share).sum(axis=1, keepdims=True)
    seats = center[:, :, None] + np.einsum("kcij,cnj->kcni", rotation, arms)
    distance = np.linalg.norm(seats - left[:, :, None], axis=3)
    apart = np.linalg.norm(template[:, None] - template, axis=2) + np.diag(np.full(n, np.inf))
    far = np.where(table < 0, distance, np.inf).min(axis=2) > 0.5 * apart.min()
    return np.asarray(far)


def _padded(frames: _Frames, body: _Body, found: dict[int, Ints], own: Ints) -> _Lists:
    """Lay the lists of all frames side by side, with their fits; the last place stays empty."""
    width = max((len(table) for table in found.values()), default=1) + 1
    count, d = len(frames.x), frames.x.shape[2]
    place = np.full((count, width, frames.n), -1, dtype=np.int64)
    for k, table in found.items():
        place[k, : len(table)] = table
    rotation, misfit = np.zeros((count, width, d, d)), np.full((count, width), np.inf)
    rows, listed = np.nonzero((place >= 0).any(axis=2))
    for part in _batches(rows.size, 1):
        at = rows[part], listed[part]
        seated = _seated(frames.x[at[0]], place[at][:, None])[:, 0]
        rotation[at], misfit[at] = _fits(seated, body.template)
    used = (place >= 0).sum(axis=2)
    cost = _misfit_cost(misfit, used, frames.shown, body)
    return _Lists(place, rotation, cost, misfit <= _limit(used, body), own)


def _misfit_cost(misfit: Floats, used: Ints, shown: Ints, body: _Body) -> Floats:
    """Return minus the log-likelihood of squared residuals (T, C) of so many particles.

    The residuals of a frame follow a multivariate Student law of the usual noise: a frame as a
    whole may be worse than others. A detection left out lies anywhere within the body's extent.
    """
    n, d = body.template.shape
    freedom = np.maximum(degrees_of_freedom(np.arange(n + 1), d), 0).astype(np.float64)
    scale = _STUDENT * body.sigma2
    gamma = np.array([lgamma((_STUDENT + f) / 2) - lgamma(_STUDENT / 2) for f in freedom])
    norm = freedom / 2 * np.log(np.pi * scale) - gamma
    extent = 2 * float(np.linalg.norm(body.template, axis=1).max())
    strays = d * np.log(extent) * (shown[:, None] - used)
    cost: Floats = norm[used] + strays
    return cost + (_STUDENT + freedom[used]) / 2 * np.log1p(misfit / scale)


def _chained(
    frames: _Frames, body: _Body, lists: _Lists, time: Floats, *, labelled: bool
) -> Identity:
    """Follow the most likely assignment from frame to frame; cut where it is in doubt."""
    rows = np.flatnonzero(np.isfinite(lists.cost).any(axis=1))
    choice, sure = _followed(frames, body, lists, time, rows, labelled=labelled)
    order = np.full((len(frames.x), frames.n), -1, dtype=np.int64)
    order[rows] = _columns(frames, lists, rows)[np.arange(rows.size), choice]
    settled = rows[lists.fits[rows, choice]]
    used = (order >= 0).sum(axis=1)
    site = _sites(order)
    if labelled:
        order = _kept(frames, order, site)
    piece = np.zeros(len(frames.x), dtype=np.int64)
    piece[rows[~sure]] = 1
    return Identity(
        order=order,
        piece=np.cumsum(piece),
        swaps=np.setdiff1d(_exchanges(site), rows[~sure]) if labelled else rows[:0],
        cuts=rows[~sure],
        extra=rows[frames.shown[rows] > used[rows]],
        unsettled=np.setdiff1d(np.flatnonzero(frames.shown >= frames.x.shape[2]), settled),
    )


def _followed(
    frames: _Frames, body: _Body, lists: _Lists, time: Floats, rows: Ints, *, labelled: bool
) -> tuple[list[int], Bools]:
    """Return the choice in each settled frame, and whether the step to it is beyond doubt."""
    if not rows.size:
        return [], np.empty(0, dtype=np.bool_)
    spread = _spread(frames, lists, time[rows], rows, labelled=labelled)
    choice, sure = [_first_choice(frames, body, lists, rows[0], labelled=labelled)], [True]
    held = _taken(_columns(frames, lists, rows[:1])[0, choice[0]], body.seat)
    plain = _plain(lists, rows, spread) & labelled
    nowhere, poses = np.full(held.size, -1), list[_Pose]()
    for i in range(1, rows.size):
        poses = _reached(poses, lists, rows[i - 1], choice[-1], spread[i - 1])
        shown = frames.column[rows[i]]
        if plain[i - 1] and choice[-1] == 0 and (held == body.seat)[shown].all():
            choice.append(0)
            sure.append(True)
            continue
        if labelled:
            _list_held(frames, body, lists, rows[i], held)
        column = _columns(frames, lists, rows[i : i + 1])[0]
        cost = _step_cost(lists, poses, rows[i], labelled=labelled)
        if labelled:
            cost += _TRUST * _against(held, column, shown)
        now = int(np.argmin(cost))
        # Two candidates that agree on every particle both of them place are in no conflict.
        near = column[cost <= cost[now] + _DOUBT]
        rivals = len(near) > 1 and _moved(_taken(column[now], nowhere), near).any()
        choice.append(now)
        sure.append(not rivals)
        if labelled:
            held = _taken(column[now], held)
    return choice, np.array(sure)


class _Pose(NamedTuple):
    """A rotation reached before, and the variance of a component of the turn since then."""

    rotation: Floats
    spread: float


def _reached(
    poses: list[_Pose], lists: _Lists, row: int, choice: int, spread: float
) -> list[_Pose]:
    """Return the poses a step may start from: the last noise-like one and the last of all.

    A single frame may have a wrong rotation, and over many bad frames the body turns far: the step
    is as likely as from the nearer of the two.
    """
    pose = _Pose(lists.rotation[row, choice], spread)
    if lists.fits[row, choice] or not poses:
        return [pose]
    return [_Pose(poses[0].rotation, poses[0].spread + spread), pose]


def _list_held(frames: _Frames, body: _Body, lists: _Lists, row: int, held: Ints) -> None:
    """Add the labels as they were last held to the candidates of a frame, whatever their misfit.

    They are the labels as given until an exchange. The last place of every list is kept for them.
    """
    one = slice(row, row + 1)
    place = _places(frames._replace(column=frames.column[one]), held)
    if (place >= 0).sum() != frames.shown[row] or (lists.place[row] == place).all(axis=1).any():
        return
    rotation, misfit = _fits(_seated(frames.x[one], place[:, None])[0], body.template)
    used = (place >= 0).sum(axis=1)[:, None]
    lists.place[row, -1], lists.rotation[row, -1] = place[0], rotation[0]
    lists.cost[row, -1] = _misfit_cost(misfit[:, None], used, frames.shown[one], body)[0, 0]
    lists.fits[row, -1] = misfit[0] <= _limit(used, body)[0, 0]


def _plain(lists: _Lists, rows: Ints, spread: Floats) -> Bools:
    """Return the steps between rows whose own labels are beyond doubt whatever the other angles.

    Every other candidate bears the whole weight of the labels, so its misfit is compared alone.
    """
    square = _square_angle(lists.rotation[rows[:-1], 0], lists.rotation[rows[1:], 0])
    cost = lists.cost[rows[1:]]
    own = np.isin(rows, lists.own)
    sure = square / (2 * spread) + cost[:, 0] + _DOUBT < cost[:, 1:].min(axis=1) + _TRUST
    return np.asarray(own[:-1] & own[1:] & sure)


def _taken(column: Ints, held: Ints) -> Ints:
    """Return the particle (m,) of each column once the particles are in the columns given."""
    filled = column >= 0
    seat = np.where((held >= 0) & filled[held], -1, held)
    seat[column[filled]] = np.flatnonzero(filled)
    return seat


def _moved(held: Ints, column: Ints) -> Bools:
    """Return which candidates (C, n) give a column another particle than it is held to be."""
    before = np.where(column >= 0, held[column], -1)
    return np.asarray(((before >= 0) & (before != np.arange(column.shape[1]))).any(axis=1))


def _against(held: Ints, column: Ints, shown: Ints) -> Bools:
    """Return which candidates (C, n) contradict the labels: by another particle, or by none.

    Of the columns `shown`, those of known particles are meant to be placed, at most n of them.
    """
    known = ((shown >= 0) & (held[shown] >= 0)).sum()
    placed = ((column >= 0) & (held[column] >= 0)).sum(axis=1)
    return np.asarray(_moved(held, column) | (placed < min(known, column.shape[1])))


def _first_choice(frames: _Frames, body: _Body, lists: _Lists, row: int, *, labelled: bool) -> int:
    """Return the assignment to begin with: the labels unless another is e^18 times likelier."""
    cost = lists.cost[row]
    if labelled:
        column = _columns(frames, lists, np.array([row]))[0]
        particle = np.where(column >= 0, body.seat[column], -1)
        wrong = ((particle != np.arange(frames.n)) & (column >= 0)).sum(axis=1)
        cost = cost + _TRUST * _against(body.seat, column, frames.column[row]) + wrong
    return int(np.argmin(cost))


def _columns(frames: _Frames, lists: _Lists, rows: Ints) -> Ints:
    """Return the columns that the listed assignments of some frames take, (K, C, n)."""
    place = lists.place[rows]
    column = frames.column[rows[:, None, None], np.maximum(place, 0)]
    return np.where(place >= 0, column, -1)


def _spread(frames: _Frames, lists: _Lists, time: Floats, rows: Ints, *, labelled: bool) -> Floats:
    """Return the variance of one component of each step's rotation vector, from the median.

    Columns that are lasting particles show the turn between two frames even where their labels are
    not those of the shape; of detections without labels the least turn counts.
    """
    steps = _labelled_turns(frames, rows) if labelled else rows[:0]
    if not 2 * steps.size > rows.size:
        fits = lists.fits[rows]
        first = lists.rotation[rows[:-1], np.argmax(fits[:-1], axis=1)]
        square = _square_angle(first[:, None], lists.rotation[rows[1:]])
        square = np.where(fits[1:], square, np.inf).min(axis=1)
        steps = square[fits[:-1].any(axis=1) & fits[1:].any(axis=1)]
    gap = np.diff(time)
    usual = float(np.median(gap)) if gap.size else 1.0
    median = float(np.median(steps)) if steps.size else 0.0
    typical = median / _median_chi2(3.0 if frames.x.shape[2] == 3 else 1.0)
    spread: Floats = max(typical, _TINY**2) * np.maximum(gap / usual, 1.0)
    return spread


def _labelled_turns(frames: _Frames, rows: Ints) -> Floats:
    """Return the squared angles of the steps between rows that columns seen in both fix."""
    count, d = int(frames.column.max()) + 1, frames.x.shape[2]
    points = np.full((rows.size, count, d), np.nan)
    row, detection = np.nonzero(frames.column[rows] >= 0)
    points[row, frames.column[rows[row], detection]] = frames.x[rows[row], detection]
    rotation, misfit = _fits(points[1:], points[:-1])
    return _square_angle(rotation[np.isfinite(misfit)], np.eye(d))


def _step_cost(lists: _Lists, poses: list[_Pose], row: int, *, labelled: bool) -> Floats:
    """Return minus the log-likelihood (C,) of a frame's candidates after the poses before it."""
    misfit = lists.cost[row]
    turns = np.full(misfit.shape, np.inf)
    for pose in poses:
        square = _square_angle(pose.rotation, lists.rotation[row])
        # A body that leaps follows no law of its small steps: those of the leap's own size decide.
        least = float(square[np.isfinite(misfit)].min())
        wide = max(pose.spread, least / (_LEAP_LABELLED if labelled else _LEAP_UNLABELLED))
        turns = np.minimum(turns, square / (2 * wide))
    return np.asarray(turns + misfit)


def _sites(order: Ints) -> Ints:
    """Return the particle that each column was last (T, m); -1 before its first."""
    site = np.full((len(order), int(order.max(initial=0)) + 1), -1, dtype=np.int64)
    row, particle = np.nonzero(order >= 0)
    site[row, order[row, particle]] = particle
    last = np.maximum.accumulate(np.where(site >= 0, np.arange(len(site))[:, None], -1), axis=0)
    held = np.take_along_axis(site, np.maximum(last, 0), axis=0)
    return np.where(last >= 0, held, -1)


def _exchanges(site: Ints) -> Ints:
    """Return the rows at which a column becomes another particle than it last was."""
    changed = (site[1:] != site[:-1]) & (site[:-1] >= 0)
    return np.flatnonzero(changed.any(axis=1)) + 1


def _kept(frames: _Frames, order: Ints, site: Ints) -> Ints:
    """Give frames without assignment the labels that held before them (at the start, after)."""
    out = order.copy()
    rows = np.flatnonzero((order < 0).all(axis=1) & (frames.shown > 0))
    first = np.argmax(site >= 0, axis=0)
    opening = site[first, np.arange(site.shape[1])]
    for k in rows.tolist():
        held = np.where(site[k] >= 0, site[k], opening)
        for column in frames.column[k, : frames.shown[k]].tolist():
            if column < len(held) and held[column] >= 0 and out[k, held[column]] < 0:
                out[k, held[column]] = column
    return out
