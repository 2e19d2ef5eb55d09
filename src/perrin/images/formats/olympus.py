"""Olympus FluoView .oib and .oif files, read with oiffile."""

from __future__ import annotations

import re
from pathlib import PurePath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from perrin.images.formats.contents import (
    Contents,
    Pick,
    chosen,
    even_times,
    grid,
    in_seconds,
    in_um,
    layout,
    needed,
)
from perrin.images.formats.folders import name_counters


def olympus(path: str, pick: Pick) -> Contents:
    """Describe an Olympus FluoView file: planes by the counters in their names, axes in its header.

    Parameters
    ----------
    path : str
    pick : Pick
        The user's choices.

    Returns
    -------
    Contents
    """
    file = needed("oiffile", "oif").OifFile(path)
    try:
        chosen(["image"], pick.image)
        # Names such as s_C001Z001T001 are planes; others are thumbnails.
        names = [n for n in file.glob("*.tif") if PurePath(n).stem.startswith("s_")]
        if not names:
            raise ValueError("has no planes: export OME-TIFF")
        stems = [PurePath(name).stem for name in names]
        sizes, places = grid(name_counters(stems) if len(names) > 1 else [{}])
        axes = list(sizes)
        where = layout(sizes, pick)
        first = file.asarray(names[0])
        if first.ndim != 2:
            raise ValueError("has colours: save one channel as grey values, or export OME-TIFF")
        voxel, interval = olympus_scale(file.mainfile, where.t, where.z)
    except Exception:
        file.close()
        raise

    def plane(t: int, z: int) -> NDArray[Any]:
        at = where.at(t, z)
        return np.asarray(file.asarray(names[places[tuple(at.get(axis, 0) for axis in axes)]]))

    return Contents(
        shape=(where.t, where.z, *first.shape),
        dtype=first.dtype,
        plane=plane,
        close=file.close,
        voxel=voxel,
        times=even_times(where.t, interval),
    )


def olympus_scale(header: Any, t: int, z: int) -> tuple[NDArray[np.float64], float]:  # noqa: ANN401
    """Return voxel size and interval from the settings of an Olympus file.

    Parameters
    ----------
    header : mapping
        Sections of the main settings file.
    t, z : int
        Number of frames, and of planes of a frame; the header states first and last positions.

    Returns
    -------
    voxel : ndarray, shape (3,)
        Voxel size (z, y, x), um; NaN where it is not stated.
    interval : float
        Time between frames, s; NaN where it is not stated.

    Examples
    --------
    >>> axis = {"AxisCode": "Z", "StartPosition": 0.0, "EndPosition": 900.0, "UnitName": "nm"}
    >>> olympus_scale({"Axis 3 Parameters Common": axis}, 1, 4)
    (array([0.3, nan, nan]), nan)
    """
    reference = header.get("Reference Image Parameter", {})
    sections = (s for name, s in header.items() if re.fullmatch(r"Axis \d+ Parameters.*", name))
    about = {s.get("AxisCode"): s for s in sections}

    def step(axis: str, n: int) -> tuple[float | None, str]:
        section = about.get(axis, {})
        if n < 2 or "EndPosition" not in section:
            return None, ""
        span = float(section["EndPosition"]) - float(section["StartPosition"])
        return span / (n - 1), str(section.get("UnitName", ""))

    voxel = np.array(
        [
            in_um(*step("Z", z)),
            in_um(reference.get("HeightConvertValue"), reference.get("HeightUnit")),
            in_um(reference.get("WidthConvertValue"), reference.get("WidthUnit")),
        ]
    )
    return voxel, in_seconds(*step("T", t))
