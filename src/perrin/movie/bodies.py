"""Clusters of the spheres that were found in a movie."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from perrin._text import listed
from perrin.errors import DegenerateClusterError, NoSpheresError
from perrin.tracks.files import check_tracks
from perrin.tracks.groups import TOUCHING_REACH, touching_groups
from perrin.tracks.rigid_bodies import identify_bodies

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import pandas as pd

    from perrin._arrays import Floats, Ints
    from perrin.images.optics.optics import Optics
    from perrin.images.spheres.localisation import Search
    from perrin.images.stack import Stack
    from perrin.motion.error_ratio import ErrorRatio
    from perrin.run.workers import Progress
    from perrin.tracks.rigid_bodies import IdentifiedBodies


# Groups that keep together in fewer frames are left out, in short movies those of under half of the
# frames; below three frames nothing can be measured.
_FEWEST_FRAMES_TOGETHER, _FEWEST_FRAMES_MEASURED = 8, 3

# A group of more spheres is a gel, a crystal or a glass.
_MOST_SPHERES = 100


@dataclass(frozen=True, eq=False)
class Bodies:
    """Spheres that were found, the cluster of each, and remarks.

    Attributes
    ----------
    features : DataFrame
        Table of the spheres as in `Imaging`, with ``together`` (number of spheres of clusters in
        the chain of touching ones) and ``border`` (distance of the centre to the border, um).
    axes : list of str
        Columns of the coordinates.
    sizes : dict of int
        Number of spheres of each cluster.
    margin : float
        Largest distance to the border of the centre of a sphere that the border cuts, um.
    warnings : list of str
        Warnings about bodies that are left out.
    notes : list of str
        Notes about bodies that are left out.
    singles : DataFrame
        Tracks of the spheres that belong to no body: frame, particle and the coordinates, um.
    """

    features: pd.DataFrame
    axes: list[str]
    sizes: dict[int, int]
    margin: float
    warnings: list[str]
    notes: list[str]
    singles: pd.DataFrame


def find_bodies(
    features: pd.DataFrame,
    stack: Stack,
    search: Search,
    *,
    optics: Optics | None,
    sizes: Sequence[int] | None = None,
    progress: Progress | None = None,
) -> Bodies:
    """Assign the spheres of a movie to its clusters: groups that move as rigid bodies.

    Parameters
    ----------
    features : DataFrame
        Table of the spheres, as `locate` returns it.
    stack : Stack
    search : Search
    optics : Optics or None
    sizes : sequence of int, optional
        Numbers of spheres of the clusters that are wanted; default: all that are found.
    progress : callable, optional
        As in `Work`.

    Returns
    -------
    Bodies

    Raises
    ------
    NoSpheresError
        If nothing was found.
    DegenerateClusterError
        If there are bodies, but none of a size that is wanted.
    """
    usable = np.ones(len(features), dtype=np.bool_)
    if "refined" in features:
        tried = features["chi2"].notna().to_numpy()
        usable = np.asarray(features["refined"].to_numpy(dtype=np.bool_) | ~tried)
    if not usable.any():
        raise NoSpheresError(
            f"no particles: {len(features)} places were found and none of them shows a sphere; "
            "check diameter and minmass, and whether the spheres are dark (dark=True)"
        )
    axes = [axis for axis in "xyz" if axis in features]
    rows = np.flatnonzero(usable)
    frame = features["frame"].to_numpy(dtype=np.int64)[rows]
    x = features[axes].to_numpy(dtype=np.float64)[rows]
    errors = median_errors(features[usable], axes=axes)
    error = None if errors is None else float(np.sqrt(np.mean(errors**2)))
    # The spheres of a pair are a contact distance apart in height at most, a third in its square.
    between = abs(stack.plane_time or 0.0) * search.contact / float(stack.voxel[0]) / np.sqrt(3)
    scan = between / stack.dt if between > 0 else 0.0
    found = identify_bodies(
        frame, x, contact=search.contact, error=error, scan=scan, progress=progress
    )
    number, notes, warnings = _chosen_bodies(found, frame, sizes)
    label = np.append(number, -1)[found.body]
    size = {int(c): int(n) for c, n in zip(number, found.size, strict=True) if c >= 0}
    offset = np.cumsum([0, *(size[c] for c in sorted(size))])
    own = label >= 0
    columns = np.tile([[1], [-1], [-1], [0]], len(features))
    columns[0, rows[own]] = group_sizes(features.iloc[rows[own]], contact=search.contact, axes=axes)
    columns[1, rows] = label
    columns[2, rows] = np.where(own, offset[label] + found.particle, -1)
    columns[3, rows] = np.where(own, found.piece, 0)
    names = ("together", "cluster", "particle", "piece")
    features = features.assign(**dict(zip(names, columns, strict=True)))
    length = dict(zip("zyx", np.array(stack.shape[1:]) * stack.voxel, strict=True))
    half = dict(zip("zyx", stack.voxel / 2, strict=True))
    sides = [
        np.minimum(features[a] + half[a], length[a] - half[a] - features[a]).to_numpy()
        for a in axes
    ]
    features["border"] = np.min(sides, axis=0)
    blur = 0.0 if optics is None else optics.psf[0]
    margin = search.diameter / 2 + 2 * blur
    single = rows[found.track >= 0]
    singles = features.iloc[single][["frame", *axes]].assign(particle=found.track[found.track >= 0])
    return Bodies(features, axes, size, margin, warnings, notes, singles)


def _chosen_bodies(
    found: IdentifiedBodies, frame: Ints, sizes: Sequence[int] | None
) -> tuple[Ints, list[str], list[str]]:
    """Return the number of the cluster that each body is, -1 if it is left out; notes; warnings."""
    frames = len(np.unique(frame))
    fewest = min(_FEWEST_FRAMES_TOGETHER, max(_FEWEST_FRAMES_MEASURED, int(np.ceil(frames / 2))))
    own = found.body >= 0
    pairs = np.unique(np.stack([found.body[own], frame[own]]), axis=1)
    lives = np.bincount(pairs[0].astype(np.int64), minlength=len(found.size))
    brief = (lives < fewest) & (lives > 0)
    huge = found.size > _MOST_SPHERES
    whole = ~brief & ~huge & (lives > 0)
    wanted = whole if sizes is None else whole & np.isin(found.size, sizes)
    notes, warnings = [], []
    if brief.any():
        notes.append(
            f"{brief.sum()} groups of spheres that kept together in fewer than {fewest} of "
            f"{frames} frames are no clusters and are left out"
        )
    if huge.any():
        warnings.append(
            f"{found.size[huge].max()} spheres that touch and keep their distances are no cluster: "
            f"bodies of over {_MOST_SPHERES} spheres (gels, crystals, glasses) are left out"
        )
    if whole.any() and not wanted.any():
        raise DegenerateClusterError(
            f"no cluster of {' or '.join(map(str, sizes or ()))} spheres; found: "
            f"{_counted_sizes(found.size[whole])}; without size= all are measured"
        )
    if (whole & ~wanted).any():
        notes.append(
            f"clusters of other sizes are left out: {_counted_sizes(found.size[whole & ~wanted])}; "
            "size= selects several, without it all are measured"
        )
    number = np.where(wanted, np.cumsum(wanted) - 1, -1)
    return number.astype(np.int64), notes, warnings


def _counted_sizes(sizes: Ints) -> str:
    """Return how many clusters there are of each size, in words."""
    kinds, counts = np.unique(sizes, return_counts=True)
    return listed(f"{count} of {n}" for n, count in zip(kinds, counts, strict=True))


def group_sizes(features: pd.DataFrame, *, contact: float, axes: list[str]) -> Ints:
    """Return the number of spheres in the chain of touching ones of every sphere, itself included.

    Parameters
    ----------
    features : pandas.DataFrame
        With ``frame`` and the coordinates.
    contact : float
        Centre distance of touching spheres, um.
    axes : list of str
        Columns of the coordinates.

    Returns
    -------
    ndarray of int64

    Examples
    --------
    >>> import pandas as pd
    >>> table = pd.DataFrame({"frame": 0, "x": [0.0, 1.0, 5.0], "y": 0.0})
    >>> group_sizes(table, contact=1.0, axes=["x", "y"])
    array([2, 2, 1])
    """
    out = np.zeros(len(features), dtype=np.int64)
    x = features[axes].to_numpy(dtype=np.float64)
    for rows in features.reset_index(drop=True).groupby("frame").indices.values():
        label = touching_groups(x[rows], reach=TOUCHING_REACH * contact, size=len(rows), smallest=1)
        out[rows] = np.bincount(label)[label]
    return out


def median_errors(features: pd.DataFrame, *, axes: list[str]) -> Floats | None:
    """Return the median standard errors of the positions along each axis, um.

    Parameters
    ----------
    features : pandas.DataFrame
        Table of the spheres, as `locate` returns it.
    axes : list of str
        Columns of the coordinates.

    Returns
    -------
    ndarray, shape (d,), or None
        None if the positions were not refined by the model.

    Examples
    --------
    >>> import pandas as pd
    >>> median_errors(pd.DataFrame({"x": [1.0], "sigma_x": [0.01]}), axes=["x"])
    array([0.01])
    """
    names = [f"sigma_{axis}" for axis in axes]
    if not set(names) <= set(features):
        return None
    median = features[names].median().to_numpy(dtype=np.float64)
    return median if np.isfinite(median).all() else None


def stated_variances(bodies: Bodies, frames: Mapping[int, Ints]) -> dict[int, Floats]:
    """Return the stated variance of the spheres of clusters along each axis, mean over spheres.

    Parameters
    ----------
    bodies : Bodies
    frames : mapping
        Frames of the rows of each cluster.

    Returns
    -------
    dict of ndarray, shape (T, d)
        um^2; NaN in frames in which no sphere of the cluster was refined by the model.
    """
    names = [f"sigma_{axis}" for axis in bodies.axes]
    tracked = bodies.features[bodies.features["cluster"].isin(list(frames))]
    square = (tracked[names] ** 2).assign(cluster=tracked["cluster"], frame=tracked["frame"])
    mean = square.groupby(["cluster", "frame"])[names].mean()
    return {
        c: mean.loc[c].reindex(numbers).to_numpy(dtype=np.float64) for c, numbers in frames.items()
    }


def with_true_errors(bodies: Bodies, ratio: ErrorRatio, *, times: Floats) -> Bodies:
    """Return the spheres with the errors that rigid bodies show in place of the stated ones.

    Parameters
    ----------
    bodies : Bodies
    ratio : ErrorRatio
        Ratio of the variances, with times counted from the first frame of a cluster.
    times : ndarray, shape (T,)
        Time of each frame of the stack, s.
    """
    features = bodies.features
    frame = features["frame"].to_numpy(dtype=np.int64)
    first = int(frame[features["cluster"] >= 0].min())
    height = features[bodies.axes[-1]].to_numpy(dtype=np.float64)
    scale = np.sqrt(ratio.at(times[frame] - times[first], height))
    names = [f"sigma_{axis}" for axis in bodies.axes]
    return replace(
        bodies,
        features=features.assign(
            **{name: features[name] * scale[:, i] for i, name in enumerate(names)}
        ),
    )


def tracks_of(bodies: Bodies, *, exclude: Sequence[int]) -> pd.DataFrame:
    """Return the table of tracks without the excluded clusters.

    Parameters
    ----------
    bodies : Bodies
    exclude : sequence of int
        Numbers of clusters to leave out.

    Returns
    -------
    pandas.DataFrame
        As `check_tracks` returns it, with ``cluster``, ``piece`` and, where there are several
        channels, ``kind``.

    Raises
    ------
    DegenerateClusterError
        If there is no cluster.
    ValueError
        If an excluded cluster does not exist, or no cluster is left.
    """
    features = bodies.features
    found = set(features.loc[features["cluster"] >= 0, "cluster"].unique().tolist())
    if not found:
        raise DegenerateClusterError(
            "no cluster: no spheres keep together longer than diffusion over a contact allows"
        )
    unknown = sorted(set(exclude) - found)
    if unknown:
        raise ValueError(f"exclude: there is no cluster {unknown[0]}; found {sorted(found)}")
    rows = features[(features["cluster"] >= 0) & ~features["cluster"].isin(exclude)]
    if not len(rows):
        raise ValueError(f"exclude: no cluster is left of {sorted(found)}")
    table = check_tracks(
        rows[["frame", "particle", "cluster", *bodies.axes]], source="the spheres found"
    )
    own = [name for name in ("piece", "kind") if name in rows]
    return table.assign(**{name: rows[name].to_numpy() for name in own})
