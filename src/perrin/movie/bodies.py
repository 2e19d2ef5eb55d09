"""Which of the spheres found in a movie make up its clusters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from perrin.errors import DegenerateClusterError, NoSpheresError
from perrin.images.spheres.spots import touching_together
from perrin.tracks.clusters import identify
from perrin.tracks.files import check_tracks

if TYPE_CHECKING:
    from collections.abc import Sequence

    import pandas as pd

    from perrin._arrays import Bools, Floats, Ints
    from perrin.images.optics.optics import Optics
    from perrin.images.spheres.localisation import Search
    from perrin.images.stack import Stack


_SURE = 0.95  # groups of other sizes are reported where less than this share has the size taken


@dataclass(frozen=True, eq=False)
class Bodies:
    """Spheres that were found, which cluster each is of, and what was noticed on the way.

    Attributes
    ----------
    features : DataFrame
        As in `Imaging`, and ``together`` (spheres in a chain of touching ones), ``border``
        (distance of the centre to it, um).
    axes : list of str
    size : int
        Spheres of a cluster.
    margin : float
        Centres nearer to the border than this belong to spheres that it cuts, um.
    dropped : dict of ndarray
        Frames of each cluster that lack spheres at the border.
    warnings : list of str
        What is left out.
    notes : list of str
        How the size was found.
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
    """Say which spheres of a movie are of which cluster.

    Parameters
    ----------
    features : DataFrame
        As `locate` returns it.
    stack : Stack
    search : Search
    optics : Optics or None
    size : int, optional
        Spheres of a cluster; default: the most common number of touching ones.

    Raises
    ------
    NoSpheresError, DegenerateClusterError
        If nothing was found, or no spheres touch.
    """
    usable = _usable(features)
    if not usable.any():
        raise NoSpheresError(
            f"no particles: {len(features)} places were found and none of them shows a sphere; "
            "look at diameter and minmass, and whether the spheres are dark (dark=True)"
        )
    axes = [axis for axis in "xyz" if axis in features]
    together = np.ones(len(features), dtype=np.int64)
    together[usable] = group_sizes(features[usable], contact=search.contact, axes=axes)
    notes: list[str] = []
    if size is None:
        size, notes = _common_size(together[usable], dimension=len(axes))
    found = identify(features.loc[usable, ["frame", *axes]], contact=search.contact, size=size)
    columns = {"cluster": -1, "particle": -1, "piece": 0}
    features = features.assign(together=together, **columns)
    features.loc[usable, list(columns)] = found[list(columns)]
    features, warnings = _without_larger(features, size=size)
    features.loc[features["cluster"] < 0, ["particle", "piece"]] = (-1, 0)
    features["border"] = _to_border(features, stack, axes)
    blur = 0.0 if optics is None else optics.psf[0]
    margin = search.diameter / 2 + 2 * blur
    features, dropped = _without_cut_bodies(features, size=size, margin=margin)
    return Bodies(features, axes, size, margin, dropped, warnings, notes)


def _without_larger(features: pd.DataFrame, *, size: int) -> tuple[pd.DataFrame, list[str]]:
    """Loosen what stands in a larger group in most of its frames: a part of another body."""
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


def _usable(features: pd.DataFrame) -> Bools:
    """Return the rows whose places are good: where a fit was tried and failed they are not."""
    if "refined" not in features:
        return np.ones(len(features), dtype=np.bool_)
    tried = features["chi2"].notna().to_numpy()
    return np.asarray(features["refined"].to_numpy(dtype=np.bool_) | ~tried)


def _common_size(together: Ints, *, dimension: int) -> tuple[int, list[str]]:
    """Return the most common number of touching spheres, and what was seen besides."""
    counted = np.bincount(together)
    groups = np.round(counted / np.maximum(np.arange(len(counted)), 1)).astype(int)
    groups[:2] = 0
    if not groups.any():
        raise DegenerateClusterError(
            f"no spheres touch: all {len(together)} found are over 1.3 contact distances apart; "
            "correct contact or the voxel size"
        )
    bodies = groups.copy()
    bodies[:dimension] = 0
    counts = bodies if bodies.any() else groups
    size = int(np.flatnonzero(counts == counts.max())[-1])
    share = groups[size] / groups.sum()
    if share >= _SURE:
        return size, []
    listed = ", ".join(f"{count} of {n}" for n, count in enumerate(groups) if count)
    return size, [
        f"clusters are taken to be of {size} spheres, the most common number (the largest of "
        f"equals); groups of touching spheres in all frames: {listed}; size= measures others"
    ]


def _to_border(features: pd.DataFrame, stack: Stack, axes: list[str]) -> Floats:
    """Return how far each centre is from the nearest border of the stack, um."""
    length = dict(zip("zyx", np.array(stack.shape[1:]) * stack.voxel, strict=True))
    half = dict(zip("zyx", stack.voxel / 2, strict=True))
    sides = [
        np.minimum(features[a] + half[a], length[a] - half[a] - features[a]).to_numpy()
        for a in axes
    ]
    return np.asarray(np.min(sides, axis=0), dtype=np.float64)


def _without_cut_bodies(
    features: pd.DataFrame, *, size: int, margin: float
) -> tuple[pd.DataFrame, dict[int, Ints]]:
    """Loosen bodies at the border some of whose spheres are out of view.

    Their unseen light misleads the fits of the spheres that are left.
    """
    tracked = features[features["cluster"] >= 0]
    bodies = tracked.groupby(["cluster", "frame"]).agg(n=("x", "size"), border=("border", "min"))
    cut = bodies[(bodies["n"] < size) & (bodies["border"] < margin)].reset_index()
    gone = features.set_index(["cluster", "frame"]).index.isin(
        cut.set_index(["cluster", "frame"]).index
    )
    features = features.copy()
    features.loc[gone, ["cluster", "particle", "piece"]] = (-1, -1, 0)
    return features, {int(c): part.to_numpy() for c, part in cut.groupby("cluster")["frame"]}


def group_sizes(features: pd.DataFrame, *, contact: float, axes: list[str]) -> Ints:
    """Return for every row how many spheres touch in its chain, itself counted."""
    out = np.zeros(len(features), dtype=np.int64)
    x = features[axes].to_numpy(dtype=np.float64)
    for rows in features.reset_index(drop=True).groupby("frame").indices.values():
        for group in touching_together(x[rows], contact=contact):
            out[rows[group]] = len(group)
    return out


def stated_errors(bodies: Bodies) -> Floats | None:
    """Return the median stated errors of the axes, um, where places were refined."""
    names = [f"sigma_{axis}" for axis in bodies.axes]
    if not set(names) <= set(bodies.features):
        return None
    median = bodies.features[names].median().to_numpy(dtype=np.float64)
    return median if np.isfinite(median).all() else None


def tracks_of(bodies: Bodies, *, exclude: Sequence[int]) -> pd.DataFrame:
    """Return the table of tracks, clusters that are not wanted left out.

    Raises
    ------
    DegenerateClusterError
        If there is no cluster.
    ValueError
        If one to be left out does not exist, or none is left.
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
