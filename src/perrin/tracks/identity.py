"""Which detection is which particle of a rigid body, in every frame.

The integers of this module, one word for one meaning:

=============  ===========  ======================================================================
word           range        meaning
=============  ===========  ======================================================================
row            0 to T - 1   frame, as the first index of the array of positions
column         0 to m - 1   second index of that array; in a track table one particle id
detection      0 to w - 1   point of a row, counted without the missing ones (`Detections`)
particle       0 to n - 1   point of the shape of the body (`BodyModel`)
candidate      0 to C - 1   one of the assignments that are compared in a row (`Candidates`)
=============  ===========  ======================================================================

and the arrays of these integers:

=============  ===========  ======================================================================
word           shape        meaning
=============  ===========  ======================================================================
assignment     (..., n)     detection of each particle, -1 where it is missing
order          (..., n)     column of each particle, -1 where it is missing
label          (..., m)     particle of each column, -1 where unknown: the inverse of an order
symmetry       (G, n)       permutations of the particles that leave the shape unchanged
shown          (T,)         number of detections of each row
used           (...)        number of detections that an assignment uses
=============  ===========  ======================================================================
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations, permutations
from math import lgamma
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from perrin._arrays import (
    Bools,
    Floats,
    Ints,
    as_positions,
    count_present,
    from_plain,
    frozen,
    present,
    to_plain,
)
from perrin._display import Shown
from perrin._text import counted, frames_text
from perrin.errors import IdentityWarning
from perrin.geometry.rigid import degrees_of_freedom
from perrin.geometry.rotations import fit_rotations
from perrin.geometry.shapes import centred, pair_distances
from perrin.motion.procrustes import arms_of_particles
from perrin.motion.residuals import median_chi2
from perrin.motion.rods import LABEL_LOG_ODDS, LEAP_LABELLED, LEAP_UNLABELLED, SETTLED_LOG_ODDS

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from numpy.typing import ArrayLike

# A fit is noise-like up to this multiple of the usual mean square residual: chance does not reach
# it in a frame of usual quality, and an exchanged pair (1000 times and more) is far above.
_NOISE_LIKE = 16.0

# Degrees of freedom of the Student law of a frame's misfit: the odds between two assignments of a
# bad frame depend on the ratio of their misfits, not on their difference in units of usual noise.
_STUDENT_FREEDOM = 8.0

# Every assignment is tried for bodies of up to this number of particles.
_MOST_PERMUTED = 6

_MOST_MODEL_ROWS = 300  # rows from which the shape is averaged

# A step of under 0.4 of the least angle between two assignments cannot be mistaken.
_SHORT_STEP = 0.4

_BATCH_FITS = 100_000  # rigid fits at a time: bounds the memory

# A column with points in this share of the rows is a particle.
_LASTING_SHARE = 0.05

_ROUNDING_ANGLE = 1e-6  # rotations by less than this, rad, are rounding errors

# A fit of a large body this close (of the least particle distance) is right, and ends a search that
# begins at one in this number of the covering rotations.
_CLOSE_FIT, _ROTATION_STRIDE = 0.1, 5


@dataclass(frozen=True, eq=False, repr=False)
class Identity(Shown):
    """Which column of an array of detections holds which particle, row by row.

    Attributes
    ----------
    order : ndarray of int, shape (T, n)
        The column of each particle; -1 where it is missing.
    piece : ndarray of int, shape (T,)
        Number of the piece that each row belongs to; within a piece the identity is certain.
    swaps : ndarray of int
        Rows at which a label passes to another particle; `order` corrects it.
    cuts : ndarray of int
        Rows that begin a new piece: two assignments were about as likely.
    extra : ndarray of int
        Rows in which a detection is left out because it is no particle of the body.
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
        """Return the detections (T, m, d) as particles (T, n, d), NaN where missing.

        Where every column is its particle throughout, these are the positions themselves.
        """
        x = np.asarray(positions, dtype=np.float64)
        if self.order.shape == x.shape[:2]:
            seen = present(x)
            own = np.arange(x.shape[1])
            if not seen.all():
                own = np.where(seen, own, -1)
            if (self.order == own).all() and (seen.all() or np.isnan(x[~seen]).all()):
                return x
        taken = np.take_along_axis(x, self.order[..., None], axis=1)
        return np.where(self.order[..., None] >= 0, taken, np.nan)

    def to_dict(self) -> dict[str, Any]:
        """Return the attributes as lists, which JSON can hold.

        Returns
        -------
        dict
            One entry per attribute.
        """
        plain: dict[str, Any] = to_plain(vars(self))
        return plain

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> Identity:
        """Return the identity that `to_dict` wrote.

        Parameters
        ----------
        entry : mapping
            As `to_dict` returns it, also after a round trip through JSON.

        Returns
        -------
        Identity

        Examples
        --------
        >>> import perrin
        >>> found = settle_identity(perrin.Cluster.tetrahedron(1.5).positions[None])
        >>> Identity.from_dict(found.to_dict()).order
        array([[0, 1, 2, 3]])
        """
        order = from_plain(entry["order"], dtype=np.int64)
        names = ("piece", "swaps", "cuts", "extra", "unsettled")
        return cls(order, *(from_plain(entry[name], dtype=np.int64) for name in names))


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
        Detections of one body, um; NaN where there is none. Columns have no meaning where
        `labelled` is False. Columns that never occur in the same row may be the same particle.
    times : array_like, shape (T,), optional
        Time of each row, any unit; default 0, 1, 2, ...
    size : int, optional
        Number of particles n of the body; default: the columns with points in over 5 % of the rows
        if every two of them occur together, else the number of points in the fullest 5 % of the
        rows.
    labelled : bool
        Whether a column is meant to be one particle throughout. It then stays one unless an
        exchange is e^18 times more likely.

    Returns
    -------
    Identity

    Raises
    ------
    ValueError
        If a shape is not valid.

    Warns
    -----
    IdentityWarning
        Where labels were corrected; the message states how many, and in which frames.

    Notes
    -----
    The likelihood of an assignment is (1 + S/(8 sigma^2))^(-(8 + f)/2) exp(-theta^2/(2 s^2)): S is
    the squared residual of the fit with f degrees of freedom, sigma^2 from its median, theta the
    angle of the step and s^2 from the median step, growing with the time across gaps. The misfit
    follows a Student law, so that a frame noisier than the others is no evidence for another
    assignment. s^2 is at least 1/16 of the least squared turn (1/4 with labels): a leap is not
    judged by the law of small steps. With labels the assignment of the last frame is always a
    candidate, also in a frame in which no assignment is noise-like. All assignments are tried for
    up to 6 particles; for more, linear assignment and rigid fit alternate, from many orientations.

    Examples
    --------
    >>> import warnings
    >>> import numpy as np
    >>> from perrin import Cluster, IdentityWarning, simulate_motion
    >>> from perrin.tracks.identity import settle_identity
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=40, rng=1)
    >>> x = truth.positions() + 0.01 * np.random.default_rng(1).normal(size=(40, 4, 3))
    >>> x[25:] = x[25:, [1, 0, 2, 3]]
    >>> with warnings.catch_warnings(action="ignore", category=IdentityWarning):
    ...     found = settle_identity(x)
    >>> found.swaps.tolist(), found.order[24].tolist(), found.order[25].tolist()
    ([25], [0, 1, 2, 3], [1, 0, 2, 3])
    """
    x = as_positions(positions)
    seen = present(x)
    time = np.arange(len(x), dtype=np.float64) if times is None else np.asarray(times, np.float64)
    n = body_size(seen) if size is None else size
    columns = seen.any(axis=0)
    if labelled and columns.sum() == n and certain_labels(x[None, :, columns])[0]:
        return _without_assignment(seen, n, labelled=labelled)
    detections = Detections.of(x, n)
    start = _medoid_row(x, seen, n)
    if start is None:
        return _without_assignment(seen, n, labelled=labelled)
    body = BodyModel.of_row(detections, start, labelled=labelled)
    found = most_likely_identity(detections, body, time, labelled=labelled)
    label = body.label
    if labelled:
        # A column of unknown particle gets the one to which it was most often assigned.
        count = np.zeros((label.size, n), dtype=np.int64)
        row, particle = np.nonzero(found.order >= 0)
        np.add.at(count, (found.order[row, particle], particle), 1)
        usual = np.where(count.any(axis=1), count.argmax(axis=1), -1)
        label = np.where(label >= 0, label, usual)
    if not labelled or found.cuts.size or (label != body.label).any():
        # The first shape mixes equivalent poses of the body; the second, from the longest piece,
        # keeps its small irregularities.
        body = body._replace(label=label).of_piece(found, x)
        found = most_likely_identity(detections, body, time, labelled=labelled)
    if found.swaps.size:
        passed = np.diff(labels_in_time(found.order), axis=0)[found.swaps - 1] != 0
        warnings.warn(
            f"identity: {counted(int(passed.sum()), 'label', 'pass')} to another particle, in "
            f"{frames_text(found.swaps)} counted from 0; they are corrected",
            IdentityWarning,
            stacklevel=2,
        )
    return found


def settle_each(positions: Sequence[Floats], *, times: Sequence[Floats | None]) -> list[Identity]:
    """Decide which detection is which particle for several labelled bodies, as `settle_identity`.

    Bodies of one shape whose labels are right are found together; the others are settled one by
    one.

    Parameters
    ----------
    positions : sequence of ndarray, shape (T, m, d)
        Detections of each body, um; NaN where there is none.
    times : sequence of ndarray, shape (T,), or None
        Time of each row.

    Returns
    -------
    list of Identity

    Warns
    -----
    IdentityWarning
        Where labels were corrected.

    Examples
    --------
    >>> import perrin
    >>> x = np.stack([perrin.Cluster.tetrahedron(1.5).positions] * 9)
    >>> [one.order[8].tolist() for one in settle_each([x, x + 5.0], times=[None, None])]
    [[0, 1, 2, 3], [0, 1, 2, 3]]
    """
    alike: dict[tuple[object, ...], list[int]] = {}
    for k, x in enumerate(positions):
        complete = bool(np.isfinite(x).all())
        if complete or body_size(present(x)) == x.shape[1]:
            alike.setdefault((x.shape, complete), []).append(k)
    found: dict[int, Identity] = {}
    for group in alike.values():
        for part in _batches(len(group), positions[group[0]].size):
            rows = group[part]
            some = np.stack([positions[k] for k in rows])
            for k, seen, certain in zip(rows, present(some), certain_labels(some), strict=True):
                if certain:
                    found[k] = _without_assignment(seen, seen.shape[1], labelled=True)
    return [
        found[k] if k in found else settle_identity(x, times=time)
        for k, (x, time) in enumerate(zip(positions, times, strict=True))
    ]


def body_size(seen: Bools) -> int:
    """Return the number of particles of a body.

    Parameters
    ----------
    seen : ndarray of bool, shape (T, m)
        Where a column has a point. Columns that never occur in the same row may be one particle,
        and a column with points in few rows may be none.

    Returns
    -------
    int

    Examples
    --------
    >>> body_size(np.array([[True, True, False], [True, False, True]]))
    2
    """
    lasting = seen[:, seen.sum(axis=0) > _LASTING_SHARE * len(seen)].astype(np.float64)
    if lasting.size and (lasting.T @ lasting > 0).all():
        return int(lasting.shape[1])
    counts = np.sort(seen.sum(axis=1))
    counts = counts[counts > 0]
    return int(counts[-max(1, int(np.ceil(_LASTING_SHARE * len(counts))))]) if counts.size else 0


def _without_assignment(seen: Bools, n: int, *, labelled: bool) -> Identity:
    """Return the labels as given, one particle a column; without labels none is assigned."""
    none = np.empty(0, dtype=np.int64)
    if labelled:
        order = np.where(seen, np.arange(seen.shape[1]), -1)
        unsettled = none.copy() if n == seen.shape[1] else np.arange(len(seen))
    else:
        order = np.full((len(seen), n), -1, dtype=np.int64)
        unsettled = np.flatnonzero(seen.any(axis=1))
    piece = np.zeros(len(seen), dtype=np.int64)
    return Identity(order, piece, none, none.copy(), none.copy(), unsettled)


def _medoid_row(x: Floats, seen: Bools, n: int) -> int | None:
    """Return a complete row to begin with: of a few, the one that most other rows resemble."""
    d = x.shape[2]
    rows = np.flatnonzero(seen.sum(axis=1) == n)
    if n < d or n > seen.shape[1] or rows.size < 2:
        return None
    rows = rows[np.linspace(0, rows.size - 1, min(rows.size, 15)).astype(int)]
    points = np.stack([x[k][seen[k]] for k in rows])
    misfit = [np.median(best_assignments(points, points[k])[1]) for k in range(min(5, rows.size))]
    best = int(np.argmin(misfit))
    return int(rows[best]) if np.isfinite(misfit[best]) else None


class Detections(NamedTuple):
    """The points of every row without the missing ones, moved to the left of the array.

    Attributes
    ----------
    x : ndarray, shape (T, w, d)
        Coordinates of each detection, um; NaN beyond the last.
    column : ndarray of int, shape (T, w)
        Column of each detection; -1 beyond the last.
    shown : ndarray of int, shape (T,)
        Number of detections of each row.
    n : int
        Number of particles of the body.
    """

    x: Floats
    column: Ints
    shown: Ints
    n: int

    @classmethod
    def of(cls, x: Floats, n: int) -> Detections:
        """Return the detections in positions (T, m, d) of a body of n particles."""
        seen = present(x)
        width = max(int(seen.sum(axis=1).max()), n)
        column = np.argsort(~seen, axis=1, kind="stable")[:, :width]
        here = np.take_along_axis(seen, column, axis=1)
        points = np.take_along_axis(x, column[..., None], axis=1)
        pad = width - column.shape[1]
        column = np.pad(np.where(here, column, -1), ((0, 0), (0, pad)), constant_values=-1)
        points = np.pad(points, ((0, 0), (0, pad), (0, 0)), constant_values=np.nan)
        return cls(np.where((column >= 0)[..., None], points, np.nan), column, here.sum(axis=1), n)

    def assignment(self, label: Ints) -> Ints:
        """Return the assignment (T, n) by the labels (m,): the detection of each particle."""
        particle = np.where(self.column >= 0, label[self.column], -1)
        assignment = np.full((len(particle), self.n), -1, dtype=np.int64)
        row, detection = np.nonzero(particle >= 0)
        assignment[row, particle[row, detection]] = detection
        return assignment


class BodyModel(NamedTuple):
    """The shape of a body, its noise and symmetry, and the particle of each column.

    Attributes
    ----------
    template : ndarray, shape (n, d)
        Coordinates of the particles in the axes of the body, um.
    sigma2 : float
        Variance of one coordinate about the shape, um^2.
    symmetry : ndarray of int, shape (G, n)
        Permutations that leave the shape as it is within noise, the identity first.
    label : ndarray of int, shape (m,)
        Particle that each column is meant to be, -1 where that is unknown.
    """

    template: Floats
    sigma2: float
    symmetry: Ints
    label: Ints

    @classmethod
    def averaged(cls, points: Floats, shape: Floats, label: Ints) -> BodyModel:
        """Average complete rows (K, n, d), in the order of a shape; find noise and symmetry."""
        rotation, misfit = rigid_fits(points, shape)
        fits = np.isfinite(misfit)
        if fits.any():
            centred = points[fits] - points[fits].mean(axis=1, keepdims=True)
            shape = np.einsum("tij,tni->tnj", rotation[fits], centred).mean(axis=0)
        freedom = float(degrees_of_freedom(np.array(len(shape)), shape.shape[1]))
        # Where there is no noise, the rounding error is taken as noise.
        sigma2 = float(np.median(rigid_fits(points, shape)[1])) / median_chi2(freedom)
        sigma2 = max(sigma2, (1e-7 * float(np.abs(shape).max())) ** 2)
        return cls(shape, sigma2, shape_symmetry(shape, sigma2), label)

    @classmethod
    def of_row(cls, detections: Detections, start: int, *, labelled: bool) -> BodyModel:
        """Return the shape from the rows that can be assigned to one complete row."""
        n, d = detections.n, detections.x.shape[2]
        order = detections.column[start, :n]
        rows = _evenly(np.flatnonzero(detections.shown == n))
        some = detections.x[rows[:: max(1, rows.size // 15)], :n]
        template = detections.x[start, :n] - detections.x[start, :n].mean(axis=0)
        freedom = float(degrees_of_freedom(np.array(n), d))
        sigma2 = float(np.median(best_assignments(some, template)[1])) / median_chi2(freedom)
        symmetry = shape_symmetry(template, sigma2)
        assignment = np.broadcast_to(np.arange(n), (rows.size, n)).copy()
        same = (detections.column[rows, :n] == order).all(axis=1) & labelled
        misfit = np.full(rows.size, np.inf)
        misfit[same] = rigid_fits(detections.x[rows[same], :n], template)[1]
        odd = np.flatnonzero(misfit > _NOISE_LIKE * sigma2 * freedom)
        assignment[odd], misfit[odd] = best_assignments(
            detections.x[rows[odd], :n], template, symmetry=symmetry
        )
        good = misfit <= 2 * _NOISE_LIKE * sigma2 * freedom
        points = assigned_points(detections.x[rows[good]], assignment[good][:, None])[:, 0]
        # The particle of each column.
        label = np.full(int(detections.column.max()) + 1, -1, dtype=np.int64)
        label[order] = np.arange(n)
        return cls.averaged(points, template, label)

    def of_piece(self, found: Identity, x: Floats) -> BodyModel:
        """Return the shape averaged over the longest piece of an identity."""
        complete = (found.order >= 0).all(axis=1)
        longest = np.bincount(found.piece[complete], minlength=1).argmax()
        rows = np.flatnonzero(complete & (found.piece == longest))
        if rows.size < 2:
            return self
        rows = _evenly(rows)
        points = np.take_along_axis(x[rows], found.order[rows][..., None], axis=1)
        return BodyModel.averaged(points, self.template, self.label)

    def misfit_limit(self, used: Ints) -> Floats:
        """Return the misfit up to which an assignment of `used` detections is noise-like."""
        freedom = degrees_of_freedom(used, self.template.shape[1])
        return np.asarray(_NOISE_LIKE * self.sigma2 * freedom, dtype=np.float64)

    def misfit_cost(self, misfit: Floats, used: Ints, shown: Ints) -> Floats:
        """Return minus the log-likelihood of squared residuals (T, C) of assignments.

        The residuals of a row follow a multivariate Student law of the usual noise: a row as a
        whole may be worse than others. A detection left out is anywhere within the body's extent.
        """
        n, d = self.template.shape
        freedom = degrees_of_freedom(np.arange(n + 1), d).astype(np.float64)
        scale = _STUDENT_FREEDOM * self.sigma2
        gamma = np.array(
            [lgamma((_STUDENT_FREEDOM + f) / 2) - lgamma(_STUDENT_FREEDOM / 2) for f in freedom]
        )
        norm = freedom / 2 * np.log(np.pi * scale) - gamma
        extent = 2 * float(np.linalg.norm(self.template, axis=1).max())
        strays = d * np.log(extent) * (shown[:, None] - used)
        cost: Floats = norm[used] + strays
        return cost + (_STUDENT_FREEDOM + freedom[used]) / 2 * np.log1p(misfit / scale)


def _evenly(rows: Ints) -> Ints:
    """Return evenly spaced rows of some, at most as many as the shape is averaged from."""
    spaced: Ints = rows[np.linspace(0, rows.size - 1, min(rows.size, _MOST_MODEL_ROWS)).astype(int)]
    return spaced


def rigid_fits(points: Floats, template: Floats) -> tuple[Floats, Floats]:
    """Fit a template to sets of points by proper rotations.

    Parameters
    ----------
    points : ndarray, shape (..., n, d)
        Points, um; NaN where missing.
    template : ndarray, shape (..., n, d)

    Returns
    -------
    rotation : ndarray, shape (..., d, d)
    misfit : ndarray, shape (...)
        Squared residual of each fit, um^2; inf where the rotation is not unique.

    Examples
    --------
    >>> square = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
    >>> rotation, misfit = rigid_fits(square[[1, 2, 3, 0]], square)
    >>> rotation.round(12).tolist(), float(misfit.round(12))
    ([[0.0, -1.0], [1.0, 0.0]], 0.0)
    """
    rotation, unique = fit_rotations(points, template)
    here = present(points) & present(template)
    # With the sets last, products of a few coordinates are those of long vectors.
    y, t, turn = (
        np.ascontiguousarray(np.moveaxis(a, -3, -1) if a.ndim > 2 else a[..., None])
        for a in (points, template, rotation)
    )
    if here.all():
        y = y - y.sum(axis=-3, keepdims=True) / y.shape[-3]
        t = t - t.sum(axis=-3, keepdims=True) / t.shape[-3]
        e = np.einsum("...njk,...ijk->...nik", t, turn)
        e -= y
    else:
        known = (np.swapaxes(here, -2, -1) if here.ndim > 1 else here[:, None])[..., None, :]
        weight = known / np.maximum(known.sum(axis=-3, keepdims=True), 1)
        y, t = np.where(known, y, 0.0), np.where(known, t, 0.0)
        y = y - (y * weight).sum(axis=-3, keepdims=True)
        t = t - (t * weight).sum(axis=-3, keepdims=True)
        e = np.where(known, y - np.einsum("...njk,...ijk->...nik", t, turn), 0.0)
    misfit = np.einsum("...nik,...nik->...k", e, e).reshape(unique.shape)
    return rotation, np.where(unique, misfit, np.inf)


@lru_cache(maxsize=64)
def all_assignments(shown: int, n: int, used: int) -> Ints:
    """Return all assignments of `used` out of `shown` detections to n particles, shape (C, n).

    Examples
    --------
    >>> all_assignments(2, 2, 2).tolist(), len(all_assignments(3, 3, 2))
    ([[0, 1], [1, 0]], 18)
    """
    rows = []
    for particles in combinations(range(n), used):
        for taken in permutations(range(shown), used):
            row = [-1] * n
            for particle, detection in zip(particles, taken, strict=True):
                row[particle] = detection
            rows.append(row)
    table: Ints = np.array(rows, dtype=np.int64)
    frozen(table)
    return table


def assigned_points(points: Floats, assignment: Ints) -> Floats:
    """Return detections as particles, for several assignments of each row.

    Parameters
    ----------
    points : ndarray, shape (K, w, d)
    assignment : ndarray of int, shape (C, n) or (K, C, n)

    Returns
    -------
    ndarray, shape (K, C, n, d)
        NaN where a particle is missing.

    Examples
    --------
    >>> assigned_points(np.array([[[1.0, 2.0], [3.0, 4.0]]]), np.array([[1, -1, 0]])).tolist()
    [[[[3.0, 4.0], [nan, nan], [1.0, 2.0]]]]
    """
    index = np.broadcast_to(assignment, (len(points), *assignment.shape[-2:]))
    rows = np.arange(len(points))[:, None, None]
    return np.where((index >= 0)[..., None], points[rows, index], np.nan)


def best_assignments(
    points: Floats, template: Floats, *, symmetry: Ints | None = None
) -> tuple[Ints, Floats]:
    """Return the assignment of least misfit of every complete row, and that misfit.

    Parameters
    ----------
    points : ndarray, shape (K, n, d)
    template : ndarray, shape (n, d)
    symmetry : ndarray of int, shape (G, n), optional
        Permutations that leave the shape unchanged: of equivalent assignments one is tried.

    Returns
    -------
    assignment : ndarray of int, shape (K, n)
    misfit : ndarray, shape (K,)

    Examples
    --------
    >>> triangle = np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 1.0]])
    >>> best_assignments(triangle[None, [2, 0, 1]], triangle)[0].tolist()
    [[1, 2, 0]]
    """
    n = len(template)
    if n > _MOST_PERMUTED:
        return icp_search(points, template)
    tried = all_assignments(n, n, n)
    if symmetry is not None:
        rest = dict.fromkeys(map(tuple, tried.tolist()))
        chosen = []
        while rest:
            row = np.array(next(iter(rest)))
            chosen.append(row)
            for other in row[symmetry].tolist():
                rest.pop(tuple(other), None)
        tried = np.array(chosen)
    best, least = np.empty((len(points), n), np.int64), np.empty(len(points))
    for rows in _batches(len(points), len(tried)):
        misfit = rigid_fits(assigned_points(points[rows], tried), template)[1]
        choice = np.argmin(misfit, axis=1)
        best[rows] = tried[choice]
        least[rows] = np.take_along_axis(misfit, choice[:, None], 1)[:, 0]
    return best, least


def _batches(count: int, width: int) -> Iterator[slice]:
    """Yield slices of `count` rows with `width` rigid fits each, as many as memory is to hold."""
    step = max(1, _BATCH_FITS // max(width, 1))
    return (slice(low, low + step) for low in range(0, count, step))


def icp_search(points: Floats, template: Floats) -> tuple[Ints, Floats]:
    """Return the best assignment of every complete row by `icp_fit` from many rotations.

    The rotation of the last row comes first; a fit much closer than any wrong one ends the search.

    Parameters
    ----------
    points : ndarray, shape (K, n, d)
    template : ndarray, shape (n, d)

    Returns
    -------
    assignment : ndarray of int, shape (K, n)
    misfit : ndarray, shape (K,)

    Examples
    --------
    >>> triangle = np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 1.0]])
    >>> icp_search(triangle[None, [2, 0, 1]], triangle)[0].tolist()
    [[1, 2, 0]]
    """
    n, d = template.shape
    best, least = np.zeros((len(points), n), np.int64), np.full(len(points), np.inf)
    nearest = float(pair_distances(template).min())
    enough = (_CLOSE_FIT * nearest) ** 2 * float(degrees_of_freedom(np.array(n), d))
    last = np.eye(d)
    for k, x in enumerate(points):
        for rotation in (last, *covering_rotations(d)[::_ROTATION_STRIDE]):
            assignment, turned, misfit = icp_fit(x, template, rotation)
            if misfit < least[k]:
                best[k], least[k], last = assignment, misfit, turned
            if least[k] <= enough:
                break
    return best, least


def icp_fit(x: Floats, template: Floats, rotation: Floats) -> tuple[Ints, Floats, float]:
    """Assign and fit in turn until the assignment no longer changes (iterative closest points).

    Parameters
    ----------
    x, template : ndarray, shape (n, d)
    rotation : ndarray, shape (d, d)
        Rotation with which the search begins.

    Returns
    -------
    assignment : ndarray of int, shape (n,)
    rotation : ndarray, shape (d, d)
    misfit : float

    Examples
    --------
    >>> triangle = np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 1.0]])
    >>> icp_fit(triangle[[2, 0, 1]], triangle, np.eye(2))[0].tolist()
    [1, 2, 0]
    """
    from scipy.optimize import linear_sum_assignment

    assignment, misfit = np.arange(len(template)), np.inf
    y, t = x - x.mean(axis=0), template - template.mean(axis=0)
    for _ in range(20):
        # The squared distances differ from this by terms that do not depend on the assignment.
        new = linear_sum_assignment(-(t @ rotation.T) @ y.T)[1]
        if np.isfinite(misfit) and (new == assignment).all():
            break
        assignment = new
        rotation, value = rigid_fits(y[assignment], t)
        misfit = float(value)
        if not np.isfinite(misfit):
            break
    return assignment, rotation, misfit


@lru_cache(maxsize=2)
def covering_rotations(d: int) -> Floats:
    """Return rotations of which one is within about 30 degrees of any rotation, shape (K, d, d).

    In three dimensions they are super-Fibonacci spirals (Alexa, CVPR 2022).

    Examples
    --------
    >>> covering_rotations(2).shape, covering_rotations(3).shape
    ((30, 2, 2), (300, 3, 3))
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


def shape_symmetry(template: Floats, sigma2: float) -> Ints:
    """Return the permutations that leave a shape as it is within noise, the identity first.

    Parameters
    ----------
    template : ndarray, shape (n, d)
    sigma2 : float
        Variance of one coordinate, um^2.

    Returns
    -------
    ndarray of int, shape (G, n)

    Examples
    --------
    >>> isosceles = np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 3.0, 0.0]])
    >>> shape_symmetry(isosceles, 1e-4).tolist()
    [[0, 1, 2], [1, 0, 2]]
    """
    n, d = template.shape
    limit = 2 * _NOISE_LIKE * sigma2 * float(degrees_of_freedom(np.array(n), d))
    if n <= _MOST_PERMUTED:
        tried = all_assignments(n, n, n)
        alike = rigid_fits(template[tried], template)[1] <= limit
        alike[0] = True
        return np.asarray(tried[alike])
    found = [tuple(range(n))]
    for start in covering_rotations(d):
        order, _, misfit = icp_fit(template, template, start)
        if misfit <= limit and tuple(order.tolist()) not in found:
            found.append(tuple(order.tolist()))
    return np.array(found, dtype=np.int64)


def squared_angle(one: Floats, other: Floats) -> Floats:
    """Return the squared angle between rotations; sin^2(angle / 2) = (d - tr(A^T B)) / 4.

    Parameters
    ----------
    one, other : ndarray, shape (..., d, d)

    Returns
    -------
    ndarray, shape (...)
        Squared angle, rad^2.

    Examples
    --------
    >>> float(squared_angle(np.eye(2), -np.eye(2)) / np.pi**2)
    1.0
    """
    trace = np.einsum("...ij,...ij->...", one, other)
    half = np.sqrt(np.clip((one.shape[-1] - trace) / 4, 0.0, 1.0))
    return np.asarray((2 * np.arcsin(half)) ** 2)


def certain_labels(x: Floats) -> Bools:
    """Return for which bodies the labels fit in all frames and no step can be mistaken for another.

    Parameters
    ----------
    x : ndarray, shape (B, T, n, d)
        Detections of B bodies of n particles, um; NaN where there is none.

    Returns
    -------
    ndarray of bool, shape (B,)

    Notes
    -----
    A step can be mistaken if it turns the body by over 0.4 of the least angle between two
    assignments that fit the shape as well as noise allows.

    Examples
    --------
    >>> import perrin
    >>> x = np.stack([perrin.Cluster.tetrahedron(1.5).positions] * 9)
    >>> swapped = x.copy()
    >>> swapped[5, [0, 1]] = x[5, [1, 0]]
    >>> certain_labels(np.stack([x, swapped]))
    array([ True, False])
    """
    _, _, n, d = x.shape
    seen = present(x)
    shown = count_present(seen)
    every = np.asarray(seen.any(axis=1)).all(axis=1)
    certain = ((shown == n).sum(axis=1) >= 2) & every & (n >= d)
    bodies = np.flatnonzero(certain)
    if not bodies.size:
        return np.asarray(certain)
    x, seen, shown = x[bodies], seen[bodies], shown[bodies]
    shape, usable, sampled = _labelled_shapes(x, shown == n)
    rotation, misfit = rigid_fits(x, shape[:, None])
    freedom = float(degrees_of_freedom(np.array(n), d))
    chosen = np.where(sampled >= 0, np.take_along_axis(misfit, sampled, axis=1), np.nan)
    count = (sampled >= 0).sum(axis=1)[:, None]
    middle = np.concatenate([(count - 1) // 2, count // 2], axis=1)
    # The median; NaN, which is sorted last, where no row was sampled.
    sigma2 = np.take_along_axis(np.sort(chosen, axis=1), middle, axis=1).mean(axis=1)
    sigma2 = sigma2 / median_chi2(freedom)
    # Where there is no noise, the rounding error is taken as noise.
    sigma2 = np.maximum(sigma2, (1e-7 * np.abs(shape).max(axis=(1, 2))) ** 2)
    posed = shown >= d
    limit = _NOISE_LIKE * sigma2[:, None] * degrees_of_freedom(shown, d)
    usable &= ((misfit <= limit) | ~posed).all(axis=1)
    least = np.full(shown.shape, np.pi)
    # Of large bodies the symmetries are compared, which all particles determine.
    compared = seen if n <= _MOST_PERMUTED else np.ones_like(seen)
    first, which = np.zeros(1, dtype=np.int64), np.zeros(shown.shape, dtype=np.int64)
    if not compared.all():
        code = np.packbits(compared, axis=2).reshape(-1, -(-n // 8))
        _, first, found = np.unique(code, axis=0, return_index=True, return_inverse=True)
        which = found.reshape(shown.shape)
    for i in range(len(first)):
        particles = np.flatnonzero(compared.reshape(-1, n)[first[i]])
        rows = (which == i) & usable[:, None]
        some = np.flatnonzero(rows.any(axis=1))
        if particles.size >= d and some.size:
            angle = np.full(len(x), np.pi)
            angle[some] = _least_angles(shape[some], sigma2[some], particles)
            least = np.where(rows, angle[:, None], least)
    if not posed.all():
        # Rows with a pose first, so that a step over a gap is one step.
        order = np.argsort(~posed, axis=1, kind="stable")
        rotation = np.take_along_axis(rotation, order[..., None, None], axis=1)
        least = np.take_along_axis(least, order, axis=1)
    angle = np.sqrt(squared_angle(rotation[:, :-1], rotation[:, 1:]))
    step = np.arange(1, x.shape[1]) < posed.sum(axis=1)[:, None]
    short = angle < _SHORT_STEP * np.minimum(least[:, :-1], least[:, 1:])
    certain[bodies] = usable & (short | ~step).all(axis=1)
    return np.asarray(certain)


def _labelled_shapes(x: Floats, whole: Bools) -> tuple[Floats, Bools, Ints]:
    """Return the shapes that follow if all labels are right, and where they are.

    Parameters
    ----------
    x : ndarray, shape (B, T, n, d)
    whole : ndarray of bool, shape (B, T)
        Complete rows, two or more of each body.

    Returns
    -------
    shape : ndarray, shape (B, n, d)
        Mean of complete rows turned to the first of them.
    usable : ndarray of bool, shape (B,)
        Whether all these rows fit the first of them as well as noise allows.
    sampled : ndarray of int, shape (B, K)
        These rows; -1 after the last.
    """
    width = min(x.shape[1], _MOST_MODEL_ROWS)
    sampled = np.full((len(x), width), -1, dtype=np.int64)
    if whole.all():
        sampled[:] = _evenly(np.arange(x.shape[1]))
    else:
        for own, complete in zip(sampled, whole, strict=True):
            rows = _evenly(np.flatnonzero(complete))
            own[: rows.size] = rows
    used = sampled >= 0
    points = x
    if x.shape[1] > width or not whole.all():
        points = np.take_along_axis(x, sampled[..., None, None], axis=1)
        points = np.where(used[..., None, None], points, np.nan)
    template = centred(points[:, 0])
    rotation, misfit = rigid_fits(points, template[:, None])
    # Of two labellings that share the time, neither is right for all: the lower tenth of the
    # misfits belongs to one.
    others = np.sort(misfit[:, 1:], axis=1)
    tenth = (used.sum(axis=1) - 1) // 10
    lowest = np.take_along_axis(others, tenth[:, None], axis=1)[:, 0]
    usual = np.maximum(lowest, _ROUNDING_ANGLE**2 * (template**2).sum(axis=(1, 2)))
    worst = np.where(used, misfit, 0.0).max(axis=1)
    usable = np.asarray(worst <= 2 * _NOISE_LIKE * usual)
    fits = np.isfinite(misfit) & used
    turn = rotation
    if not fits.all():
        points, turn = (np.where(fits[..., None, None], part, 0.0) for part in (points, turn))
    # The sum of R^T (x - centroid) over the rows is one product of matrices.
    total = arms_of_particles(points) @ turn.reshape(len(turn), -1, turn.shape[-1])
    count = fits.sum(axis=1)[:, None, None]
    shape = np.where(count > 0, total / np.maximum(count, 1), template)
    return shape, usable, sampled


def _least_angles(shapes: Floats, sigma2: Floats, particles: Ints) -> Floats:
    """Return the least angle, rad, between two noise-like assignments of some particles, (B,)."""
    n, d = shapes.shape[1:]
    used = particles.size
    if n > _MOST_PERMUTED and len(shapes) > 1:
        rows = [slice(k, k + 1) for k in range(len(shapes))]
        return np.concatenate([_least_angles(shapes[k], sigma2[k], particles) for k in rows])
    if n > _MOST_PERMUTED:
        tried = shape_symmetry(shapes[0], float(sigma2[0]))
    else:
        tried = all_assignments(used, n, used)
    limit = 2 * _NOISE_LIKE * sigma2 * float(degrees_of_freedom(np.array(used), d))
    own = np.full(n, -1)
    own[particles] = np.arange(used)
    points = assigned_points(shapes[:, particles], tried)
    rotation, misfit = rigid_fits(points, shapes[:, None])
    other = (tried != own).any(axis=1) & (misfit <= limit[:, None])
    angle = np.sqrt(squared_angle(rotation, np.eye(d)))
    return np.asarray(np.where(other, angle, np.pi).min(axis=1))


class Candidates(NamedTuple):
    """The assignments that are compared in every row, C at most, the last one reserved.

    Attributes
    ----------
    assignment : ndarray of int, shape (T, C, n)
        Detection of each particle.
    rotation : ndarray, shape (T, C, d, d)
        Rotation of the fit of each candidate.
    cost : ndarray, shape (T, C)
        Minus the log-likelihood of the misfit; inf where there is no candidate.
    fits : ndarray of bool, shape (T, C)
        Whether the misfit is noise-like.
    given : ndarray of int
        Rows whose first candidate is the labels as given, with a noise-like misfit.
    """

    assignment: Ints
    rotation: Floats
    cost: Floats
    fits: Bools
    given: Ints

    @classmethod
    def of(
        cls, detections: Detections, body: BodyModel, found: Mapping[int, Ints], given: Ints
    ) -> Candidates:
        """Fit the assignments (C, n) found for each row."""
        width = max((len(table) for table in found.values()), default=1) + 1
        count, d = len(detections.x), detections.x.shape[2]
        assignment = np.full((count, width, detections.n), -1, dtype=np.int64)
        for k, table in found.items():
            assignment[k, : len(table)] = table
        rotation, misfit = np.zeros((count, width, d, d)), np.full((count, width), np.inf)
        rows, listed = np.nonzero((assignment >= 0).any(axis=2))
        for part in _batches(rows.size, 1):
            entry = rows[part], listed[part]
            points = assigned_points(detections.x[entry[0]], assignment[entry][:, None])[:, 0]
            rotation[entry], misfit[entry] = rigid_fits(points, body.template)
        used = (assignment >= 0).sum(axis=2)
        cost = body.misfit_cost(misfit, used, detections.shown)
        return cls(assignment, rotation, cost, misfit <= body.misfit_limit(used), given)

    def order(self, detections: Detections, rows: Ints) -> Ints:
        """Return the column of each particle in the candidates of some rows, (K, C, n)."""
        assignment = self.assignment[rows]
        column = detections.column[rows[:, None, None], assignment]
        return np.where(assignment >= 0, column, -1)

    def include(self, detections: Detections, body: BodyModel, row: int, label: Ints) -> None:
        """Add the assignment by these labels to the candidates of a row, whatever its misfit."""
        one = slice(row, row + 1)
        assignment = detections._replace(column=detections.column[one]).assignment(label)
        known = (assignment >= 0).sum() == detections.shown[row]
        if not known or (self.assignment[row] == assignment).all(axis=1).any():
            return
        points = assigned_points(detections.x[one], assignment[:, None])[0]
        rotation, misfit = rigid_fits(points, body.template)
        used = (assignment >= 0).sum(axis=1)[:, None]
        self.assignment[row, -1], self.rotation[row, -1] = assignment[0], rotation[0]
        cost = body.misfit_cost(misfit[:, None], used, detections.shown[one])
        self.cost[row, -1] = cost[0, 0]
        self.fits[row, -1] = misfit[0] <= body.misfit_limit(used)[0, 0]

    def step_variance(
        self, detections: Detections, time: Floats, rows: Ints, *, labelled: bool
    ) -> Floats:
        """Return the variance of one component of each step's rotation vector, from the median.

        Columns that are lasting particles measure the turn between two rows even where their labels
        are not those of the shape; of detections without labels the least turn counts.
        """
        d = detections.x.shape[2]
        square = np.empty(0)
        if labelled:
            points = np.full((rows.size, int(detections.column.max()) + 1, d), np.nan)
            row, detection = np.nonzero(detections.column[rows] >= 0)
            column = detections.column[rows[row], detection]
            points[row, column] = detections.x[rows[row], detection]
            rotation, misfit = rigid_fits(points[1:], points[:-1])
            square = squared_angle(rotation[np.isfinite(misfit)], np.eye(d))
        if not 2 * square.size > rows.size:
            fits = self.fits[rows]
            first = self.rotation[rows[:-1], np.argmax(fits[:-1], axis=1)]
            square = squared_angle(first[:, None], self.rotation[rows[1:]])
            square = np.where(fits[1:], square, np.inf).min(axis=1)
            square = square[fits[:-1].any(axis=1) & fits[1:].any(axis=1)]
        gap = np.diff(time)
        usual = float(np.median(gap)) if gap.size else 1.0
        median = float(np.median(square)) if square.size else 0.0
        typical = median / median_chi2(3.0 if d == 3 else 1.0)
        variance: Floats = max(typical, _ROUNDING_ANGLE**2) * np.maximum(gap / usual, 1.0)
        return variance

    def step_cost(self, poses: list[Pose], row: int, *, labelled: bool) -> Floats:
        """Return minus the log-likelihood (C,) of a row's candidates after the poses before it."""
        misfit = self.cost[row]
        turns = np.full(misfit.shape, np.inf)
        for pose in poses:
            square = squared_angle(pose.rotation, self.rotation[row])
            # A leap does not follow the law of small steps: its own size is its variance.
            least = float(square[np.isfinite(misfit)].min())
            wide = max(pose.variance, least / (LEAP_LABELLED if labelled else LEAP_UNLABELLED))
            turns = np.minimum(turns, square / (2 * wide))
        return np.asarray(turns + misfit)


def candidate_assignments(detections: Detections, body: BodyModel, *, labelled: bool) -> Candidates:
    """List the candidates of every row: the noise-like assignments and the labels as given.

    A row without a noise-like assignment still determines how far the body has turned. Its
    candidates are the labels as given, and the assignments that the symmetries of the body make of
    them.

    Parameters
    ----------
    detections : Detections
    body : BodyModel
    labelled : bool
        Whether the labels of the body are candidates.

    Returns
    -------
    Candidates

    Examples
    --------
    >>> import perrin
    >>> detections = Detections.of(perrin.Cluster.tetrahedron(1.5).positions[None].repeat(2, 0), 4)
    >>> body = BodyModel.of_row(detections, 0, labelled=True)
    >>> int(candidate_assignments(detections, body, labelled=True).fits[0].sum())
    12
    """
    n = detections.n
    found: dict[int, Ints] = {}
    by_label = detections.assignment(body.label)
    known = (by_label >= 0).sum(axis=1) == detections.shown
    trusted = np.flatnonzero(known & labelled)
    points = assigned_points(detections.x[trusted], by_label[trusted, None])[:, 0]
    misfit = np.full(len(detections.x), np.inf)
    misfit[trusted] = rigid_fits(points, body.template)[1]
    given = np.flatnonzero(np.isfinite(misfit))
    limit = body.misfit_limit(detections.shown)
    fits = misfit <= limit
    complete = np.flatnonzero(detections.shown == n)
    best = by_label.copy()
    odd = complete[~fits[complete]]
    best[odd], misfit[odd] = best_assignments(
        detections.x[odd, :n], body.template, symmetry=body.symmetry
    )
    for k in complete[misfit[complete] <= limit[complete]].tolist():
        found[k] = best[k][body.symmetry]
    if n <= _MOST_PERMUTED:
        _search_all(detections, body, found, left_out=0)
        _search_all(detections, body, found, left_out=1)
    else:
        _search_near_labels(detections, body, found, by_label, fits)
    for k in given.tolist():
        if k not in found:
            found[k] = by_label[k][body.symmetry]
        elif (found[k][0] != by_label[k]).any():
            others = (found[k] != by_label[k]).any(axis=1)
            found[k] = np.concatenate([by_label[k][None], found[k][others]])
    return Candidates.of(detections, body, found, np.flatnonzero(fits))


def _search_all(
    detections: Detections, body: BodyModel, found: dict[int, Ints], *, left_out: int
) -> None:
    """Try every assignment of the rows that have none yet, with some detections left out."""
    n, d = body.template.shape
    for count in np.unique(detections.shown).tolist():
        used = min(count, n) - left_out
        rows = np.flatnonzero(detections.shown == count)
        rows = np.array([k for k in rows if k not in found], int)
        if used < d or count > _MOST_PERMUTED + 1 or not rows.size:
            continue
        tried = all_assignments(count, n, used)
        limit = float(body.misfit_limit(np.array(used)))
        for part in _batches(rows.size, len(tried)):
            points = detections.x[rows[part]]
            rotation, misfit = rigid_fits(assigned_points(points, tried), body.template)
            fits = misfit <= limit
            if left_out and count <= n:
                # A detection that is left out within half a particle distance of a free particle is
                # that particle, measured badly.
                taken = (tried[:, :, None] == np.arange(count)).any(axis=1)
                left = points[:, np.argmin(taken, axis=1)]
                here = (tried >= 0)[..., None]
                share = here / here.sum(axis=1, keepdims=True)
                center = (np.nan_to_num(assigned_points(points, tried)) * share).sum(axis=2)
                arms = body.template - (body.template * share).sum(axis=1, keepdims=True)
                places = center[:, :, None] + np.einsum("kcij,cnj->kcni", rotation, arms)
                distance = np.linalg.norm(places - left[:, :, None], axis=3)
                least = np.where(tried < 0, distance, np.inf).min(axis=2)
                fits &= least > 0.5 * pair_distances(body.template).min()
            for k, fit in zip(rows[part].tolist(), fits, strict=True):
                if fit.any():
                    found[k] = tried[fit]


def _search_near_labels(
    detections: Detections, body: BodyModel, found: dict[int, Ints], by_label: Ints, fits: Bools
) -> None:
    """Assign and fit in turn the incomplete rows of large bodies, beginning with the labels."""
    from scipy.optimize import linear_sum_assignment

    n, d = body.template.shape
    for k in np.flatnonzero((detections.shown >= d) & (detections.shown <= n)).tolist():
        if k in found:
            continue
        row = detections.x[k][None]
        x, assignment = detections.x[k, : detections.shown[k]], by_label[k]
        for _ in range(0 if fits[k] else 10):
            points = assigned_points(row, assignment[None])[0, 0]
            rotation, misfit = rigid_fits(points, body.template)
            if not np.isfinite(misfit):
                break
            lab = body.template @ rotation.T
            away = lab + np.nanmean(points - lab, axis=0) - x[:, None]
            detection, particle = linear_sum_assignment((away**2).sum(axis=2))
            assignment = np.full(n, -1, dtype=np.int64)
            assignment[particle] = detection
        misfit = rigid_fits(assigned_points(row, assignment[None])[0, 0], body.template)[1]
        if misfit <= float(body.misfit_limit(detections.shown[k])):
            found[k] = assignment[None]


def most_likely_identity(
    detections: Detections, body: BodyModel, time: Floats, *, labelled: bool
) -> Identity:
    """Follow the most likely assignment from row to row; cut where it is in doubt.

    Parameters
    ----------
    detections : Detections
    body : BodyModel
    time : ndarray, shape (T,)
    labelled : bool
        Whether the labels of the body last.

    Returns
    -------
    Identity

    Examples
    --------
    >>> import perrin
    >>> x = perrin.Cluster.tetrahedron(1.5).positions[None].repeat(3, 0)
    >>> detections = Detections.of(x, 4)
    >>> body = BodyModel.of_row(detections, 0, labelled=True)
    >>> most_likely_identity(detections, body, np.arange(3.0), labelled=True).order[2].tolist()
    [0, 1, 2, 3]
    """
    candidates = candidate_assignments(detections, body, labelled=labelled)
    rows = np.flatnonzero(np.isfinite(candidates.cost).any(axis=1))
    choice, certain = most_likely_path(detections, body, candidates, time, rows, labelled=labelled)
    order = np.full((len(detections.x), detections.n), -1, dtype=np.int64)
    order[rows] = candidates.order(detections, rows)[np.arange(rows.size), choice]
    settled = rows[candidates.fits[rows, choice]]
    used = (order >= 0).sum(axis=1)
    label = labels_in_time(order)
    swaps = rows[:0]
    if labelled:
        changed = (label[1:] != label[:-1]) & (label[:-1] >= 0)
        swaps = np.setdiff1d(np.flatnonzero(changed.any(axis=1)) + 1, rows[~certain])
        # Rows without assignment keep the labels that held before them (at the start, after).
        first = np.argmax(label >= 0, axis=0)
        opening = label[first, np.arange(label.shape[1])]
        for k in np.flatnonzero((order < 0).all(axis=1)).tolist():
            held = np.where(label[k] >= 0, label[k], opening)
            for column in detections.column[k, : detections.shown[k]].tolist():
                if column < len(held) and held[column] >= 0 and order[k, held[column]] < 0:
                    order[k, held[column]] = column
    piece = np.zeros(len(detections.x), dtype=np.int64)
    piece[rows[~certain]] = 1
    return Identity(
        order=order,
        piece=np.cumsum(piece),
        swaps=swaps,
        cuts=rows[~certain],
        extra=rows[detections.shown[rows] > used[rows]],
        unsettled=np.setdiff1d(np.flatnonzero(detections.shown >= detections.x.shape[2]), settled),
    )


def labels_in_time(order: Ints) -> Ints:
    """Return the particle that each column last was.

    Parameters
    ----------
    order : ndarray of int, shape (T, n)

    Returns
    -------
    ndarray of int, shape (T, m)
        Particle of each column; -1 before the first row in which it is one.

    Examples
    --------
    >>> labels_in_time(np.array([[0, -1], [-1, -1], [1, 0]])).tolist()
    [[0, -1], [0, -1], [1, 0]]
    """
    label = np.full((len(order), int(order.max(initial=0)) + 1), -1, dtype=np.int64)
    row, particle = np.nonzero(order >= 0)
    label[row, order[row, particle]] = particle
    last = np.maximum.accumulate(np.where(label >= 0, np.arange(len(label))[:, None], -1), axis=0)
    held = np.take_along_axis(label, last, axis=0)
    return np.where(last >= 0, held, -1)


class Pose(NamedTuple):
    """A rotation that was reached, and the variance of the turn since then.

    Attributes
    ----------
    rotation : ndarray, shape (d, d)
        Rotation from the axes of the body to those of the laboratory.
    variance : float
        Variance of one component of the rotation vector from this rotation to the next, rad^2.
    """

    rotation: Floats
    variance: float


def most_likely_path(
    detections: Detections,
    body: BodyModel,
    candidates: Candidates,
    time: Floats,
    rows: Ints,
    *,
    labelled: bool,
) -> tuple[list[int], Bools]:
    """Choose the most likely candidate of each row, given that of the row before.

    Parameters
    ----------
    detections : Detections
    body : BodyModel
    candidates : Candidates
        Candidates of every row; with labels, the assignment of the row before is added where it is
        missing.
    time : ndarray, shape (T,)
    rows : ndarray of int, shape (K,)
        Rows that have candidates.
    labelled : bool

    Returns
    -------
    choice : list of int
        The candidate of each of the rows.
    certain : ndarray of bool, shape (K,)
        False where a candidate in conflict with the chosen one is nearly as likely.

    Notes
    -----
    Three of four particles fit the body and its mirror image. Without labels the incomplete rows
    at the beginning of a piece therefore follow, backward in time, from its first complete row.

    Examples
    --------
    >>> import perrin
    >>> x = perrin.Cluster.tetrahedron(1.5).positions[None].repeat(3, 0)
    >>> detections = Detections.of(x, 4)
    >>> body = BodyModel.of_row(detections, 0, labelled=True)
    >>> candidates = candidate_assignments(detections, body, labelled=True)
    >>> most_likely_path(detections, body, candidates, np.arange(3), np.arange(3), labelled=True)
    ([0, 0, 0], array([ True,  True,  True]))
    """
    if not rows.size:
        return [], np.empty(0, dtype=np.bool_)
    variance = candidates.step_variance(detections, time[rows], rows, labelled=labelled)
    choice, certain = _path_from(detections, body, candidates, rows, variance, labelled=labelled)
    if labelled:
        return choice, certain
    complete: Bools = np.all(candidates.assignment[rows, choice] >= 0, axis=1)
    end = 0
    for begin in np.flatnonzero(~complete & np.append(True, ~certain[1:])).tolist():
        if begin < end or not complete[begin:].any():
            continue
        end = begin + int(np.argmax(complete[begin:]))
        back, passed = rows[begin : end + 1][::-1], variance[begin:end][::-1]
        path, sure = _path_from(
            detections, body, candidates, back, passed, labelled=False, first=choice[end]
        )
        choice[begin:end], certain[begin + 1 : end + 1] = path[:0:-1], sure[:0:-1]
    return choice, certain


def _path_from(
    detections: Detections,
    body: BodyModel,
    candidates: Candidates,
    rows: Ints,
    variance: Floats,
    *,
    labelled: bool,
    first: int | None = None,
) -> tuple[list[int], Bools]:
    """Choose the most likely candidate of each row after the one before it.

    `variance` (K - 1,) is that of the steps between the rows; the candidate of the first row may be
    known.
    """
    order = candidates.order(detections, rows[:1])[0]
    cost = candidates.cost[rows[0]]
    if labelled:
        # Of equivalent candidates the one is chosen that agrees with the labels of most particles.
        particle = np.where(order >= 0, body.label[order], -1)
        wrong = ((particle != np.arange(detections.n)) & (order >= 0)).sum(axis=1)
        against = _contradict(body.label, order, detections.column[rows[0]])
        cost = cost + LABEL_LOG_ODDS * against + wrong
    choice, certain = [int(np.argmin(cost)) if first is None else first], [True]
    label = _passed_on(body.label, order[choice[0]])
    # A step between rows with the labels as given is obvious where it is likelier than all others,
    # whatever their angles: every other candidate contradicts the labels.
    turned, misfit = candidates.rotation[rows, 0], candidates.cost[rows[1:]]
    given = np.isin(rows, candidates.given) & labelled
    own = squared_angle(turned[:-1], turned[1:]) / (2 * variance) + misfit[:, 0]
    sure = own + SETTLED_LOG_ODDS < misfit[:, 1:].min(axis=1) + LABEL_LOG_ODDS
    obvious = given[:-1] & given[1:] & sure
    nowhere, poses = np.full(label.size, -1), list[Pose]()
    for i in range(1, rows.size):
        # A step begins at the last noise-like pose or at the last of all, whichever is likelier:
        # a single row may have a wrong rotation, and over many bad rows the body turns far.
        before = rows[i - 1], choice[-1]
        pose = Pose(candidates.rotation[before], variance[i - 1])
        if candidates.fits[before] or not poses:
            poses = [pose]
        else:
            poses = [Pose(poses[0].rotation, poses[0].variance + variance[i - 1]), pose]
        shown = detections.column[rows[i]]
        if obvious[i - 1] and choice[-1] == 0 and (label == body.label)[shown].all():
            choice.append(0)
            certain.append(True)
            continue
        if labelled:
            candidates.include(detections, body, rows[i], label)
        order = candidates.order(detections, rows[i : i + 1])[0]
        cost = candidates.step_cost(poses, rows[i], labelled=labelled)
        if labelled:
            cost += LABEL_LOG_ODDS * _contradict(label, order, shown)
        best = int(np.argmin(cost))
        # Two candidates that agree on every particle that both of them place do not conflict.
        near = order[cost <= cost[best] + SETTLED_LOG_ODDS]
        rivals = len(near) > 1 and _relabel(_passed_on(nowhere, order[best]), near).any()
        choice.append(best)
        certain.append(not rivals)
        if labelled:
            label = _passed_on(label, order[best])
    return choice, np.array(certain)


def _passed_on(label: Ints, order: Ints) -> Ints:
    """Return the labels (m,) after a row in which the particles are in the columns of an order."""
    placed = order >= 0
    new = np.where((label >= 0) & placed[label], -1, label)
    new[order[placed]] = np.flatnonzero(placed)
    return new


def _relabel(label: Ints, order: Ints) -> Bools:
    """Return which candidates (C, n) give a column another particle than its label."""
    before = np.where(order >= 0, label[order], -1)
    return np.asarray(((before >= 0) & (before != np.arange(order.shape[1]))).any(axis=1))


def _contradict(label: Ints, order: Ints, shown: Ints) -> Bools:
    """Return which candidates (C, n) contradict the labels: by another particle, or by none.

    Of the columns `shown`, those of known particles are meant to be placed, at most n of them.
    """
    known = ((shown >= 0) & (label[shown] >= 0)).sum()
    placed = ((order >= 0) & (label[order] >= 0)).sum(axis=1)
    return np.asarray(_relabel(label, order) | (placed < min(known, order.shape[1])))
