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

    from perrin._arrays import Floats
    from perrin.run.results import Report

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
        motion = result.motion
        rows = motion.fitted
        center = motion.center[rows]
        if isinstance(motion, RodMotion):
            directions = [0.5 * float(np.ptp(motion.places)) * motion.direction[rows]]
        else:
            directions = [motion.R * axis for axis in np.moveaxis(motion.rotation[rows], 2, 0)]
        frame = (int(start[result.cluster]) + rows)[:, None].astype(np.float64)
        origin = np.column_stack([frame, center[:, ::-1]])
        for k, direction in enumerate(directions):
            arrow = np.column_stack([np.zeros_like(frame), direction[:, ::-1]])
            arrows.append(np.stack([origin, arrow], axis=1))
            names += [result.name] * len(rows)
            numbers += [k] * len(rows)
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
    from scipy.spatial import cKDTree

    from perrin.run.measure import library_version

    axes = [axis for axis in ("z", "y", "x") if axis in table]
    table = table.dropna(subset=axes)
    ids = ["cluster", "particle"] if "cluster" in table else ["particle"]
    number = table.groupby(ids, sort=False, dropna=False).ngroup().to_numpy(dtype=np.int64)
    frame = table["frame"].to_numpy(dtype=np.int64)
    x = table[axes].to_numpy(dtype=np.float64)
    order = np.lexsort((frame, number))
    points = np.column_stack([frame, x])
    features = {name: table[name].to_numpy() for name in ids}
    # The drawn diameter follows from the distances in the frame with the most particles.
    frames, counts = np.unique(frame, return_counts=True)
    fullest = x[frame == frames[np.argmax(counts)]] if len(frames) else x
    diameter = 1.0
    if len(fullest) > 1:
        nearest = cKDTree(fullest).query(fullest, 2)[0][:, 1]
        diameter = _DRAWN_SIZE * float(np.median(nearest))
    about: dict[str, Any] = {
        "name": "particles",
        "features": features,
        "face_color": ids[0],
        "size": diameter,
    }
    # A sphere is drawn in all planes that it reaches.
    installed = library_version("napari")
    if installed is not None and tuple(map(int, installed.split(".")[:2])) < (0, 9):
        about["out_of_slice_display"] = True
    else:
        about["projection_mode"] = "rescale_spherical"
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
