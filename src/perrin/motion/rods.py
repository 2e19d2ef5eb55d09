"""Direction of a straight line of particles in every frame: rods and straight chains."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from perrin._arrays import (
    Floats,
    Ints,
    as_positions,
    as_sigma,
    from_plain,
    frozen,
    present,
    require_positive,
    to_plain,
)
from perrin._display import Shown
from perrin.errors import DegenerateClusterError, TooFewFramesError

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import ArrayLike

# Log-odds: an assignment is settled when the next best is a hundred times less likely, and lasting
# labels are trusted e^18 times more than an exchange of them. Right labels are then doubted when
# chance makes another assignment e^18/100 = 6.6e5 times likelier, in at most 300 x 11/6.6e5 = 0.5 %
# of the tracks of 300 frames of a tetrahedron (likelihood ratios exceed c with probability 1/c).
SETTLED_LOG_ODDS, LABEL_LOG_ODDS = float(np.log(100.0)), 18.0

# A step whose least turn is over this many standard deviations (squared) gets a variance that is
# widened until the turn has this length: one long turn does not follow the law of the short ones.
# Lasting labels that turn a tetrahedron by 75 degrees are kept against an exchange that leaves 45,
# and replaced where the exchange leaves a third or less of the turn.
LEAP_UNLABELLED, LEAP_LABELLED = 16.0, 4.0

# Largest root mean square distance of the particles from their line, a coordinate, over its length.
_BENT = 0.1

# Largest difference of the positions along a chain, over its length, from those of the chain turned
# end for end at which its two ends count as equal.
_EQUAL_ENDS = 0.05

_MEDIAN_2 = 2 * float(np.log(2.0))  # median of chi squared with 2 degrees of freedom

_COLUMNS = ("residual", "n_present", "variance", "center_variance", "piece")
_INTEGER_FIELDS = ("n_present", "piece", "swaps")


@dataclass(frozen=True, eq=False)
class RodMotion(Shown):
    """Centre and direction of a rod or straight chain in every frame; missing frames are NaN.

    Rotation about the rod's own axis is not measured: a rod has a direction, no full orientation.

    Attributes
    ----------
    time : ndarray, shape (T,)
        Time of each frame, s.
    center : ndarray, shape (T, 3)
        Centre of all particles, um.
    direction : ndarray, shape (T, 3)
        Unit vectors in the lab frame, from the first particle to the last.
    residual : ndarray, shape (T,)
        Root mean square distance of the particles present to their positions on the line, um.
    n_present : ndarray of int, shape (T,)
        Number of particles present.
    variance : ndarray, shape (T,)
        Variance of each of the two angles of the direction from localisation error, rad^2.
    center_variance : ndarray, shape (T,)
        Variance of one coordinate of the centre, um^2.
    piece : ndarray of int, shape (T,)
        Number of the track piece that the frame belongs to. Within a piece the two ends are
        identified with certainty; no pair of frames is formed across two pieces.
    swaps : ndarray of int
        Frames (rows) from which on the labels of the two ends were exchanged; they are corrected.
    reason : tuple of str, length T
        Reason why a frame has no direction; empty where it has one.
    places : ndarray, shape (n,)
        Positions of the particles along the axis, um, mean 0.
    sigma : float
        Localisation error of one coordinate from the residuals, um.
    dt : float
        Time between frames, s.
    """

    time: Floats
    center: Floats
    direction: Floats
    residual: Floats
    n_present: Ints
    variance: Floats
    center_variance: Floats
    piece: Ints
    swaps: Ints
    reason: tuple[str, ...]
    places: Floats
    sigma: float
    dt: float

    def __post_init__(self) -> None:
        frozen(self.time, self.center, self.direction, self.residual, self.n_present)
        frozen(self.variance, self.center_variance, self.piece, self.swaps, self.places)

    def __repr__(self) -> str:
        return (
            f"RodMotion(n={len(self.places)}, length={self.length:.3g} um, {self.fitted.size} of "
            f"{len(self.time)} frames, dt={self.dt:g} s, sigma={self.sigma:.3g} um)"
        )

    @property
    def fitted(self) -> Ints:
        """Indices of the frames that have a direction."""
        return np.flatnonzero(np.isfinite(self.center[:, 0]))

    @property
    def length(self) -> float:
        """Distance between the outermost centres, um."""
        return float(np.ptp(self.places))

    def steps(self) -> tuple[Ints, Ints]:
        """Return the first and last frame index of every step; none joins two pieces."""
        rows = self.fitted
        same = self.piece[rows[:-1]] == self.piece[rows[1:]]
        return rows[:-1][same], rows[1:][same]

    def to_frame(self) -> pd.DataFrame:
        """Return a table with a row per frame; places, swaps, sigma and dt are in ``attrs``."""
        import pandas as pd

        columns: dict[str, object] = {"time": self.time}
        columns |= {a: self.center[:, i] for i, a in enumerate("xyz")}
        columns |= {f"u_{a}": self.direction[:, i] for i, a in enumerate("xyz")}
        columns |= {name: getattr(self, name) for name in _COLUMNS}
        table = pd.DataFrame(columns | {"reason": list(self.reason)})
        table.attrs = {
            "places": self.places.tolist(),
            "swaps": self.swaps.tolist(),
            "sigma": self.sigma,
            "dt": self.dt,
        }
        return table

    @classmethod
    def from_frame(cls, table: pd.DataFrame) -> RodMotion:
        """Return the motion that `to_frame` wrote.

        Parameters
        ----------
        table : DataFrame

        Raises
        ------
        ValueError
            If ``attrs`` lacks the places, swaps, sigma or dt, or a column is missing.
        """
        missing = {"places", "swaps", "sigma", "dt"} - set(table.attrs)
        vectors = ("x", "y", "z", "u_x", "u_y", "u_z")
        missing |= {"time", "reason", *vectors, *_COLUMNS} - set(table)
        if missing:
            raise ValueError(f"this table was not made by to_frame: it lacks {sorted(missing)}")
        numbers = {
            name: table[name].to_numpy(np.int64 if name in _INTEGER_FIELDS else np.float64)
            for name in _COLUMNS
        }
        return cls(
            time=table["time"].to_numpy(np.float64),
            center=table[["x", "y", "z"]].to_numpy(np.float64),
            direction=table[["u_x", "u_y", "u_z"]].to_numpy(np.float64),
            reason=tuple(table["reason"].astype(str).tolist()),
            places=np.array(table.attrs["places"], dtype=np.float64),
            swaps=np.array(table.attrs["swaps"], dtype=np.int64),
            sigma=float(table.attrs["sigma"]),
            dt=float(table.attrs["dt"]),
            **{name: np.array(values) for name, values in numbers.items()},
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the motion for JSON: lists for arrays, None for NaN."""
        return {field.name: to_plain(getattr(self, field.name)) for field in fields(self)}

    @classmethod
    def from_dict(cls, entry: dict[str, Any]) -> RodMotion:
        """Return the motion that `to_dict` wrote.

        Parameters
        ----------
        entry : dict

        Examples
        --------
        >>> ends = np.array([[[0.0, 0, 0], [2, 0, 0]], [[0, 0, 0], [2, 0.1, 0]]])
        >>> RodMotion.from_dict(track_direction(ends, dt=0.5, sigma=0.03).to_dict()).fitted
        array([0, 1])
        """
        arrays = {
            name: from_plain(value, dtype=np.int64 if name in _INTEGER_FIELDS else np.float64)
            for name, value in entry.items()
            if name not in ("reason", "sigma", "dt")
        }
        sigma, dt = (float(from_plain(entry[name])) for name in ("sigma", "dt"))
        return cls(reason=tuple(entry["reason"]), sigma=sigma, dt=dt, **arrays)


def track_direction(
    positions: ArrayLike,
    *,
    dt: float,
    times: ArrayLike | None = None,
    sigma: ArrayLike | None = None,
    labelled: bool = True,
) -> RodMotion:
    """Fit a straight line of particles in every frame and return the motion of its direction.

    Parameters
    ----------
    positions : array_like, shape (T, n, 3)
        Particle centres, um; NaN where a particle is missing.
    dt : float
        Time between frames, s.
    times : array_like, shape (T,), optional
        Times of the rows, s; default 0, dt, 2 dt, ...
    sigma : float or array_like, shape (3,), optional
        Known localisation error, um; default: from the residuals (of a pair: from its length).
    labelled : bool
        Whether a column is the same particle in all frames. The two ends of a symmetric chain are
        identified by the smallest rotation; labels are then changed only against odds of e^18.

    Returns
    -------
    RodMotion

    Raises
    ------
    DegenerateClusterError
        If the particles do not lie on one line within the noise, or are all in one place.
    TooFewFramesError
        If there are fewer than 2 frames with 2 particles.
    ValueError
        If a shape or value is not valid.

    Notes
    -----
    Least squares: u is along sum s_i (x_i - mean x), s_i the places on the axis, which are averaged
    over all frames. To first order each angle of u has the variance sigma^2 / sum s_i^2.

    Examples
    --------
    >>> from perrin import Cluster, add_noise, simulate_motion, track_direction
    >>> truth = simulate_motion(Cluster.touching(2, 2.0), D_R=0.01, dt=0.5, n_frames=500, rng=1)
    >>> track_direction(add_noise(truth.positions(), sigma=0.03, rng=2), dt=0.5)
    RodMotion(n=2, length=2 um, 500 of 500 frames, dt=0.5 s, sigma=0.0318 um)
    """
    x = as_positions(positions)
    if x.shape[2] != 3 or x.shape[1] < 2:
        raise ValueError(f"positions: expected (T, n, 3) with n >= 2, got {x.shape}")
    require_positive(dt=dt)
    given_times = np.arange(len(x)) * float(dt) if times is None else times
    time = np.array(given_times, dtype=np.float64)
    seen = present(x)
    rows = np.flatnonzero(seen.sum(axis=1) >= 2)
    if rows.size < 2:
        raise TooFewFramesError(
            f"{rows.size} frames contain two particles: 2 are needed", rows.size
        )
    points, here = x[rows], seen[rows]
    fullest = points[np.argmax(here.sum(axis=1))]
    middle = np.nanmean(fullest, axis=0)
    places = (fullest - middle) @ np.linalg.svd(np.nan_to_num(fullest - middle))[2][0]
    for _ in range(20):
        known = np.where(here, places, np.nan)
        mean = np.nanmean(known, axis=1, keepdims=True)
        offset = points - np.nanmean(
            np.where(np.isfinite(known)[..., None], points, np.nan), 1, keepdims=True
        )
        direction = np.nansum((known - mean)[..., None] * offset, axis=1)
        length = np.linalg.norm(direction, axis=1, keepdims=True)
        if not (length > 0).all():
            raise DegenerateClusterError("the particles are in one place: they have no direction")
        direction = direction / length
        along = np.einsum("tni,ti->tn", offset, direction)
        new = np.nanmean(np.where(here, along + mean, np.nan), axis=0)
        new = new - np.mean(new)
        change, places = np.nanmax(np.abs(new - places)), new
        if change <= 1e-13 * np.ptp(new):
            break
    sign, row_piece, swaps = _end_labels(direction, places, time[rows], labelled=labelled)
    direction = direction * sign[:, None]
    along = np.where(seen[rows], places * sign[:, None], np.nan)
    shift = np.nanmean(along, axis=1)
    center = np.nanmean(x[rows], axis=1) - shift[:, None] * direction
    e = x[rows] - center[:, None] - along[..., None] * direction[:, None]
    square, count = np.nansum(e * e, axis=(1, 2)), seen[rows].sum(axis=1)
    # Three coordinates and two angles are fitted in each frame, and the n - 1 distances once.
    freedom = float((3 * count - 5).sum() - (len(places) - 1))
    measured = float(np.sqrt(square.sum() / freedom)) if freedom > 0 else np.nan
    if measured > _BENT * np.ptp(places):
        raise DegenerateClusterError(
            f"the {len(places)} particles lie on no line: their distance from it is "
            f"{measured:.3g} um a coordinate (root mean square), over {_BENT} of its length",
            (len(places),),
        )
    noise = measured**2 if sigma is None else float(np.mean(as_sigma(sigma, 3) ** 2))
    lever = np.nansum((along - shift[:, None]) ** 2, axis=1)

    def in_all_frames(values: Floats) -> Floats:
        out = np.full((len(x), *values.shape[1:]), np.nan)
        out[rows] = values
        return out

    piece = np.zeros(len(x), dtype=np.int64)
    piece[rows] = row_piece
    return RodMotion(
        time=time,
        center=in_all_frames(center),
        direction=in_all_frames(direction),
        residual=in_all_frames(np.sqrt(square / count)),
        n_present=seen.sum(axis=1),
        variance=in_all_frames(noise / lever),
        center_variance=in_all_frames(noise / count + shift**2 * (2 / 3) * noise / lever),
        piece=np.maximum.accumulate(piece),
        swaps=rows[swaps],
        reason=tuple(
            "" if k >= 2 else f"{k} of {len(places)} particles, 2 needed"
            for k in seen.sum(axis=1).tolist()
        ),
        places=places,
        sigma=measured,
        dt=float(dt),
    )


def _end_labels(
    direction: Floats, places: Floats, time: Floats, *, labelled: bool
) -> tuple[Floats, Ints, Ints]:
    """Identify the two ends: the sign of every direction, pieces, and exchanged labels.

    Only the ends of a chain that is symmetric end for end can be exchanged; others keep their
    labels.
    """
    one, none = np.ones(len(direction)), np.empty(0, dtype=np.int64)
    ordered = np.sort(places)
    if not np.allclose(ordered, -ordered[::-1], atol=_EQUAL_ENDS * float(np.ptp(places))):
        return one, np.zeros(len(direction), dtype=np.int64), none
    dot = np.einsum("ti,ti->t", direction[:-1], direction[1:])
    angle = np.arctan2(np.linalg.norm(np.cross(direction[:-1], direction[1:]), axis=1), dot)
    least = np.minimum(angle, np.pi - angle)
    gap = np.diff(time)
    typical = float(np.median((angle if labelled else least) ** 2)) / _MEDIAN_2
    spread = max(typical, 1e-12) * np.maximum(gap / np.median(gap), 1.0)
    longest = LEAP_LABELLED if labelled else LEAP_UNLABELLED
    spread = np.maximum(spread, least**2 / longest)
    # Log-odds of kept against exchanged ends.
    odds = ((np.pi - angle) ** 2 - angle**2) / (2 * spread) + (LABEL_LOG_ODDS if labelled else 0.0)
    sign = np.concatenate([[1.0], np.where(odds < 0, -1.0, 1.0)])
    uncertain = np.append(False, np.abs(odds) <= SETTLED_LOG_ODDS)
    swaps = np.flatnonzero((sign < 0) & ~uncertain) if labelled else none
    return np.cumprod(sign), np.cumsum(uncertain).astype(np.int64), swaps
