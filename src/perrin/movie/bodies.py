"""Clusters of the spheres that were found in a movie."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from perrin.errors import DegenerateClusterError, NoSpheresError
from perrin.tracks.clusters import identify
from perrin.tracks.files import check_tracks
from perrin.tracks.groups import TOUCHING_REACH, touching_groups

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    import pandas as pd

    from perrin._arrays import Floats, Ints
    from perrin.images.optics.optics import Optics
    from perrin.images.spheres.localisation import Search
    from perrin.images.stack import Stack
    from perrin.motion.error_ratio import ErrorRatio


_CLEAR_MAJORITY = 0.95  # share of the groups with the most common size that needs no note


@dataclass(frozen=True, eq=False)
class Bodies:
    """Spheres that were found, the cluster of each, and remarks.

    Attributes
    ----------
    features : DataFrame
        Table of the spheres as in `Imaging`, with ``together`` (number of spheres in the chain of
        touching ones) and ``border`` (distance of the centre to the border, um).
    axes : list of str
        Columns of the coordinates.
    size : int
        Number of spheres of a cluster.
    margin : float
        Largest distance to the border of the centre of a sphere that the border cuts, um.
    dropped : dict of ndarray
        Frames of each cluster that are dropped because spheres are missing at the border.
    warnings : list of str
        Warnings about bodies that are left out.
    notes : list of str
        Notes about the choice of the size.
    """

    features: pd.DataFrame
    axes: list[str]
    size: int
    margin: float
    dropped: dict[int, Ints]
    warnings: list[str]
    notes: list[str]


def find_bodies(
    features: pd.DataFrame,
    stack: Stack,
    search: Search,
    *,
    optics: Optics | None,
    size: int | None = None,
) -> Bodies:
    """Assign the spheres of a movie to its clusters.

    Parameters
    ----------
    features : DataFrame
        Table of the spheres, as `locate` returns it.
    stack : Stack
    search : Search
    optics : Optics or None
    size : int, optional
        Number of spheres of a cluster; default: the most common number of touching spheres.

    Returns
    -------
    Bodies

    Raises
    ------
    NoSpheresError, DegenerateClusterError
        If nothing was found, or no spheres touch.
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
    together = np.ones(len(features), dtype=np.int64)
    together[usable] = group_sizes(features[usable], contact=search.contact, axes=axes)
    notes: list[str] = []
    if size is None:
        size, notes = most_common_size(together[usable], dimension=len(axes))
    found = identify(features.loc[usable, ["frame", *axes]], contact=search.contact, size=size)
    columns = {"cluster": -1, "particle": -1, "piece": 0}
    features = features.assign(together=together, **columns)
    features.loc[usable, list(columns)] = found[list(columns)]
    features, warnings = _without_larger_bodies(features, size=size)
    features.loc[features["cluster"] < 0, ["particle", "piece"]] = (-1, 0)
    length = dict(zip("zyx", np.array(stack.shape[1:]) * stack.voxel, strict=True))
    half = dict(zip("zyx", stack.voxel / 2, strict=True))
    sides = [
        np.minimum(features[a] + half[a], length[a] - half[a] - features[a]).to_numpy()
        for a in axes
    ]
    features["border"] = np.min(sides, axis=0)
    blur = 0.0 if optics is None else optics.psf[0]
    margin = search.diameter / 2 + 2 * blur
    features, dropped = _without_cut_bodies(features, size=size, margin=margin)
    return Bodies(features, axes, size, margin, dropped, warnings, notes)


def _without_larger_bodies(features: pd.DataFrame, *, size: int) -> tuple[pd.DataFrame, list[str]]:
    """Assign no cluster to spheres that are in a larger group in most of their frames."""
    tracked = features[features["cluster"] >= 0]
    usual = tracked.groupby(["cluster", "frame"])["together"].max().groupby("cluster").median()
    larger = usual[usual > size]
    if not len(larger):
        return features, []
    parts = features["cluster"].isin(larger.index)
    kinds = features[features["together"].isin(larger)].groupby("together")["frame"].nunique()
    listed = ", ".join(f"{n} in {count} frames" for n, count in kinds.items())
    features = features.copy()
    features.loc[parts, "cluster"] = -1
    return features, [
        f"larger bodies are left out (touching spheres: {listed}): they are no clusters of {size}; "
        "size= measures them"
    ]


def most_common_size(together: Ints, *, dimension: int) -> tuple[int, list[str]]:
    """Return the most common number of touching spheres, and a note if there are other numbers.

    Parameters
    ----------
    together : ndarray of int
        Number of spheres in the group of each sphere, in all frames.
    dimension : int
        2 or 3. Groups of fewer spheres, which have no orientation, are chosen only if there are no
        larger ones.

    Returns
    -------
    size : int
        The largest of several that are equally common.
    notes : list of str

    Raises
    ------
    DegenerateClusterError
        If no spheres touch.

    Examples
    --------
    >>> most_common_size(np.repeat([4, 8], [400, 8]), dimension=3)
    (4, [])
    """
    counted = np.bincount(together)
    groups = np.round(counted / np.maximum(np.arange(len(counted)), 1)).astype(int)
    groups[:2] = 0
    if not groups.any():
        raise DegenerateClusterError(
            f"no spheres touch: all {len(together)} found are over {TOUCHING_REACH} contact "
            "distances apart; correct contact or the voxel size"
        )
    bodies = groups.copy()
    bodies[:dimension] = 0
    counts = bodies if bodies.any() else groups
    size = int(np.flatnonzero(counts == counts.max())[-1])
    share = groups[size] / groups.sum()
    if share >= _CLEAR_MAJORITY:
        return size, []
    listed = ", ".join(f"{count} of {n}" for n, count in enumerate(groups) if count)
    return size, [
        f"clusters are taken to be of {size} spheres, the most common number (the largest of "
        f"equals); groups of touching spheres in all frames: {listed}; size= measures others"
    ]


def _without_cut_bodies(
    features: pd.DataFrame, *, size: int, margin: float
) -> tuple[pd.DataFrame, dict[int, Ints]]:
    """Assign no cluster to bodies with spheres outside the border, in the frames concerned.

    The intensity of spheres outside the stack biases the fits of the others.
    """
    tracked = features[features["cluster"] >= 0]
    bodies = tracked.groupby(["cluster", "frame"]).agg(n=("x", "size"), border=("border", "min"))
    cut = bodies[(bodies["n"] < size) & (bodies["border"] < margin)].reset_index()
    in_cut_body = features.set_index(["cluster", "frame"]).index.isin(
        cut.set_index(["cluster", "frame"]).index
    )
    features = features.copy()
    features.loc[in_cut_body, ["cluster", "particle", "piece"]] = (-1, -1, 0)
    return features, {int(c): part.to_numpy() for c, part in cut.groupby("cluster")["frame"]}


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


def stated_errors(bodies: Bodies) -> Floats | None:
    """Return the median standard errors of the positions along each axis, um.

    Parameters
    ----------
    bodies : Bodies

    Returns
    -------
    ndarray, shape (d,), or None
        None if the positions were not refined by the model.
    """
    names = [f"sigma_{axis}" for axis in bodies.axes]
    if not set(names) <= set(bodies.features):
        return None
    median = bodies.features[names].median().to_numpy(dtype=np.float64)
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
        As `check_tracks` returns it, with ``cluster`` and ``piece``.

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
            f"no cluster of {bodies.size} touching spheres is seen in three frames or more"
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
    return table.assign(piece=rows["piece"].to_numpy())
