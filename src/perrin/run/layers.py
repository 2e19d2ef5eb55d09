"""Layers of napari from runs and track tables, and the reader that napari calls."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from perrin.motion.rods import RodMotion
from perrin.run.results import load_run
from perrin.tracks.files import read_tracks
from perrin.tracks.formats import READABLE_SUFFIXES

if TYPE_CHECKING:
    from collections.abc import Callable

    import pandas as pd

    from perrin._arrays import Floats, Ints
    from perrin.run.results import ClusterResult, Report, RodResult

    # Data, arguments and kind of a layer, as napari's readers return them.
    Layer: TypeAlias = tuple[Floats, dict[str, Any], str]

# Diameter of a drawn particle over the median distance of nearest particles.
_DRAWN_SIZE = 0.5

# Colours of the three axes of a body.
_AXIS_COLOURS = ("#D55E00", "#009E73", "#0072B2")


def napari_layers(report: Report) -> list[Layer]:
    """Return points, tracks and orientations of a run as layers of napari.

    napari is not imported. Coordinates are um in the order (t, z, y, x), or (t, y, x) in the plane,
    with t the frame number of the input: give the image layer of the stack its voxel size as
    `scale`, and the layers lie over it.

    Parameters
    ----------
    report : Report

    Returns
    -------
    list of tuple
        Data, keyword arguments and kind of each layer: the particles ("points"), their paths
        ("tracks"), and the axes of every body in every frame with a pose ("vectors", as long as
        the mean distance of its particles to the centre), for
        ``viewer.add_layer(napari.layers.Layer.create(*layer))``.

    Examples
    --------
    >>> from importlib.resources import files
    >>> import perrin
    >>> report = perrin.analyze(str(files("perrin") / "data" / "demo_tracks.csv.gz"), dt=0.73)
    >>> [(kind, data.shape) for data, _, kind in napari_layers(report)]
    [('points', (1200, 4)), ('tracks', (1200, 5)), ('vectors', (900, 2, 4))]
    """
    first = int(report.settings.get("first_frame", 0))
    tracks = report.tracks.assign(frame=report.tracks["frame"] + first)
    layers = table_layers(tracks)
    whole = tracks.dropna(subset=["x", "y"])
    start = whole.groupby("cluster")["frame"].min()
    arrows, names, numbers = [], [], []
    for result in report.results:
        for k, arrow in enumerate(_axes_of(result, int(start[result.cluster]))):
            arrows.append(arrow)
            names += [result.name] * len(arrow)
            numbers += [k] * len(arrow)
    if arrows:
        about = {
            "name": "orientations",
            "features": {"cluster": np.array(names), "axis": np.array(numbers)},
            "edge_color": "axis",
            "edge_color_cycle": list(_AXIS_COLOURS),
        }
        layers.append((np.concatenate(arrows), about, "vectors"))
    return layers


def table_layers(table: pd.DataFrame) -> list[Layer]:
    """Return points and tracks of a clean track table as layers of napari.

    Parameters
    ----------
    table : pandas.DataFrame
        As `check_tracks` returns it; rows without coordinates are left out.

    Returns
    -------
    list of tuple
        As `napari_layers` returns them.

    Examples
    --------
    >>> import pandas as pd
    >>> table = pd.DataFrame({"frame": [0, 1], "particle": [7, 7], "x": [1.0, 2], "y": [3.0, 4]})
    >>> table_layers(table)[1][0].tolist()
    [[0.0, 0.0, 3.0, 1.0], [0.0, 1.0, 4.0, 2.0]]
    """
    axes = [axis for axis in ("z", "y", "x") if axis in table]
    table = table.dropna(subset=axes)
    ids = ["cluster", "particle"] if "cluster" in table else ["particle"]
    number = table.groupby(ids, sort=False, dropna=False).ngroup().to_numpy(dtype=np.int64)
    frame = table["frame"].to_numpy(dtype=np.int64)
    x = table[axes].to_numpy(dtype=np.float64)
    order = np.lexsort((frame, number))
    points = np.column_stack([frame, x])
    features = {name: table[name].to_numpy() for name in ids}
    about = {
        "name": "particles",
        "features": features,
        "face_color": ids[0],
        "size": _drawn_diameter(frame, x),
        **_seen_beside_its_plane(),
    }
    paths = np.column_stack([number, points])[order]
    ordered = {
        name: values[order] for name, values in features.items() if values.dtype.kind in "if"
    }
    return [
        (points, about, "points"),
        (paths, {"name": "tracks", "features": ordered}, "tracks"),
    ]


def napari_reader(path: str | list[str]) -> Callable[[str | list[str]], list[Layer]] | None:
    """Return the function that reads a run folder or a track table for napari, or None.

    Parameters
    ----------
    path : str or list of str
        What was dropped on napari, or opened.

    Returns
    -------
    callable or None
        None where it is neither, or a list of several files.

    Examples
    --------
    >>> napari_reader("movie.tif") is None, napari_reader("tracks.gdf") is None
    (True, False)
    """
    one = path[0] if isinstance(path, list) and len(path) == 1 else path
    if isinstance(one, list):
        return None
    is_run = (Path(one) / "run.json").is_file()
    if not is_run and not one.lower().endswith((*READABLE_SUFFIXES, ".gz")):
        return None
    return lambda _: napari_layers(load_run(one)) if is_run else table_layers(read_tracks(one))


def _seen_beside_its_plane() -> dict[str, Any]:
    """Return the option by which a sphere is drawn in the planes that it reaches."""
    from perrin.run.measure import library_version

    installed = library_version("napari")
    if installed is not None and tuple(map(int, installed.split(".")[:2])) < (0, 9):
        return {"out_of_slice_display": True}
    return {"projection_mode": "rescale_spherical"}


def _drawn_diameter(frame: Ints, x: Floats) -> float:
    """Return the diameter of a drawn particle, um, from the frame with the most rows."""
    from scipy.spatial import cKDTree

    frames, counts = np.unique(frame, return_counts=True)
    points = x[frame == frames[np.argmax(counts)]] if len(frames) else x
    if len(points) < 2:
        return 1.0
    return _DRAWN_SIZE * float(np.median(cKDTree(points).query(points, 2)[0][:, 1]))


def _axes_of(result: ClusterResult | RodResult, first: int) -> list[Floats]:
    """Return for each axis of a body its arrows (start, direction), with the frame as first."""
    motion = result.motion
    rows = motion.fitted
    center = motion.center[rows]
    if isinstance(motion, RodMotion):
        length = 0.5 * float(np.ptp(motion.places))
        directions = [length * motion.direction[rows]]
    else:
        directions = [motion.R * motion.rotation[rows][:, :, k] for k in range(motion.dimension)]
    frame = (first + rows)[:, None].astype(np.float64)
    return [
        np.stack(
            [
                np.column_stack([frame, center[:, ::-1]]),
                np.column_stack([np.zeros_like(frame), direction[:, ::-1]]),
            ],
            axis=1,
        )
        for direction in directions
    ]
