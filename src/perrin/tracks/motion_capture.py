"""Markers of motion capture: csv of OptiTrack's Motive, and C3D."""

from __future__ import annotations

import io
import warnings
from typing import TYPE_CHECKING

import numpy as np

from perrin.errors import table_error
from perrin.tracks.raw_tables import RawTable

if TYPE_CHECKING:
    from collections.abc import Sequence

# Kinds of points in the files of Motive, the measured ones first.
_KINDS = ("Marker", "Rigid Body Marker", "Bone Marker")


def is_motive(lines: Sequence[str]) -> bool:
    """Return whether a text begins like a csv file of Motive.

    Examples
    --------
    >>> is_motive(["Format Version,1.23,Take Name,one"])
    True
    """
    return lines[0].lstrip('"').startswith("Format Version")


def motive_table(text: bytes, source: str) -> RawTable:
    r"""Return the positions of markers in a csv file of Motive, a row per marker and frame.

    Parameters
    ----------
    text : bytes
        UTF-8.
    source : str
        The file's name, for messages.

    Returns
    -------
    RawTable
        Measured markers, or where there are none those that Motive solved; the body before the
        colon in a marker's name is its cluster.

    Raises
    ------
    TrackTableError
        If the header is another one, or if no marker is in the file.

    Examples
    --------
    >>> text = b"Format Version,1.23,Length Units,Millimeters\n\n,,Marker,Marker,Marker\n"
    >>> text += b",,a:1,a:1,a:1\n,,Position,Position,Position\nFrame,Time (Seconds),X,Y,Z\n"
    >>> motive_table(text + b"0,0.0,1,2,3\n", "take.csv").table
       Frame  Time (Seconds) Marker  X  Y  Z Body
    4      0             0.0    a:1  1  2  3    a
    """
    import csv

    import pandas as pd

    lines = text.decode().splitlines()
    head = next((i for i, line in enumerate(lines) if line.lower().startswith("frame,time")), None)
    if head is None:
        raise table_error(source, "a file of Motive without the line Frame,Time (Seconds),X,Y,Z")
    *labels, axes = list(csv.reader(lines[1 : head + 1]))
    labels = [row for row in labels if any(row)]
    about = next(csv.reader(lines[:1]))
    units = dict(zip(about[::2], about[1::2], strict=False)).get("Length Units", "")
    kinds = next((row for row in labels if set(row) & {*_KINDS, "Rigid Body", "Bone"}), [])
    parts = next((row for row in labels if "Position" in row), [])
    names = labels[labels.index(kinds) + 1] if kinds in labels[:-1] else []
    width = min(len(kinds), len(parts), len(names), len(axes))
    columns: dict[tuple[str, str], dict[str, int]] = {}
    for j in range(2, width):
        if parts[j] == "Position" and axes[j] in ("X", "Y", "Z"):
            columns.setdefault((kinds[j], names[j]), {})[axes[j]] = j
    kind = next((kind for kind in _KINDS if any(key[0] == kind for key in columns)), None)
    if kind is None:
        raise table_error(
            source,
            "no markers in this file of Motive; export it again with the option Markers or Rigid "
            "Body Markers",
        )
    data = pd.read_csv(io.StringIO("\n".join(lines[head + 1 :])), header=None)
    data.index += head - 1
    tables = []
    for (of, name), place in columns.items():
        if of == kind and len(place) == 3:
            one = data[[0, 1]].set_axis([axes[0], axes[1]], axis=1)
            one = one.assign(Marker=name, **{axis: data[j] for axis, j in place.items()})
            body, colon, _ = name.rpartition(":")
            tables.append(one.assign(Body=body if colon else None))
    table = pd.concat(tables)
    found = {"frame": axes[0], "time": axes[1], "particle": "Marker", "x": "X", "y": "Y", "z": "Z"}
    if table["Body"].notna().any():
        found["cluster"] = "Body"
    else:
        table = table.drop(columns="Body")
    stated = dict.fromkeys("xyz", units) if units else {}
    others = sorted({of for of, _ in columns} - {kind})
    notes = (f"left out: points of the kind {', '.join(others)}",) if others else ()
    return RawTable(table, f"a take of Motive ({kind})", found, stated, notes, word="line", first=2)


def parse_c3d(data: bytes, source: str) -> RawTable:
    """Return the markers of a C3D file, a row per marker and frame; needs the package c3d.

    Parameters
    ----------
    data : bytes
    source : str
        The file's name, for messages.

    Returns
    -------
    RawTable
        Coordinates are NaN where the file marks a point as missing.

    Raises
    ------
    TrackTableError
        If this is no C3D file with markers.
    ImportError
        If the package is not installed.
    """
    import pandas as pd

    try:
        import c3d
    except ImportError:
        raise ImportError(f"{source}: C3D needs c3d: pip install 'perrin[tables]'") from None

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of files without analog channels
            reader = c3d.Reader(io.BytesIO(data))
            frames = [(number, points) for number, points, _ in reader.read_frames(copy=True)]
            rate = float(reader.point_rate)
            names = [str(name).strip() for name in reader.point_labels]
            unit = reader.get("POINT:UNITS")
    except Exception as error:
        raise table_error(source, f"not a C3D file that can be read ({error})") from None
    if not frames or not names:
        raise table_error(source, "a C3D file without markers")
    number = np.array([at for at, _ in frames])
    x = np.stack([points[: len(names), :3] for _, points in frames]).astype(np.float64)
    missing = np.stack([points[: len(names), 3] < 0 for _, points in frames])
    x[missing] = np.nan
    count = len(names)
    table = pd.DataFrame(
        {
            "frame": np.repeat(number, count),
            "label": np.tile(np.array(names, dtype=object), len(number)),
            "time (s)": np.repeat((number - number[0]) / rate, count),
        }
        | dict(zip(("X", "Y", "Z"), x.reshape(-1, 3).T, strict=True))
    )
    found = {
        "frame": "frame", "particle": "label", "time": "time (s)", "x": "X", "y": "Y", "z": "Z",
    }  # fmt: skip
    stated = str(unit.string_value).strip() if unit is not None else ""
    units = dict.fromkeys("xyz", stated) if stated else {}
    return RawTable(table, f"C3D ({count} markers, {rate:g} frames/s)", found, units)
