"""DeltaVision .dv files: a header of 1024 bytes, one of every plane, then the planes."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from perrin.images.formats.contents import Contents, Pick, chosen, in_um, layout
from perrin.images.formats.headers import clock_scale

_HEADER = 1024
_TYPES = {0: "u1", 1: "i2", 2: "f4", 6: "u2", 7: "i4"}
# Order of the planes in the file, slowest first, by the number in the header.
_ORDERS = {0: "CTZ", 1: "TZC", 2: "TCZ"}
# The second float of a plane's header is its time, s.
_TIME = 1


def deltavision(path: str, pick: Pick) -> Contents:
    """Describe a DeltaVision file: its header states voxel size (um) and the time of every plane.

    Parameters
    ----------
    path : str
    pick : Pick
        The user's choices.

    Returns
    -------
    Contents

    Raises
    ------
    ValueError
        If the file is no DeltaVision file, or is cut short.
    """
    chosen(["image"], pick.image)
    with open(path, "rb") as file:
        head = file.read(_HEADER)
    if len(head) < _HEADER:
        raise ValueError("is cut short within its header")
    # The identification of the format also states the order of the bytes.
    order = next((o for o in "<>" if struct.unpack(f"{o}h", head[96:98])[0] == -16224), "")
    if not order:
        raise ValueError("is not a DeltaVision file: it lacks the number that identifies them")
    x, y, n, mode = struct.unpack(f"{order}4i", head[:16])
    lengths = struct.unpack(f"{order}3f", head[40:52])
    (extended,) = struct.unpack(f"{order}i", head[92:96])
    n_ints, n_floats = struct.unpack(f"{order}2h", head[128:132])
    n_times, sequence = struct.unpack(f"{order}2h", head[180:184])
    (n_channels,) = struct.unpack(f"{order}h", head[196:198])
    if mode not in _TYPES or sequence not in _ORDERS:
        raise ValueError(
            f"has pixels of type {mode} in order {sequence}, which are not read: export OME-TIFF"
        )
    n_times, n_channels = max(n_times, 1), max(n_channels, 1)
    sizes = {"T": n_times, "C": n_channels, "Z": n // (n_times * n_channels)}
    where = layout(sizes, pick)
    axes = _ORDERS[sequence]
    dtype = np.dtype(f"{order}{_TYPES[mode]}")
    planes = np.memmap(path, dtype="u1", mode="r", offset=_HEADER + extended)

    def number(t: int, z: int) -> int:
        at = where.at(t, z)
        return int(np.ravel_multi_index([at.get(a, 0) for a in axes], [sizes[a] for a in axes]))

    def plane(t: int, z: int) -> NDArray[Any]:
        size = x * y * dtype.itemsize
        part = planes[number(t, z) * size : (number(t, z) + 1) * size]
        if len(part) < size:
            raise ValueError("the file ends before it")
        return part.view(dtype).reshape(y, x).astype(dtype.newbyteorder("="))

    clock = np.full((where.t, where.z), np.nan)
    width = 4 * (n_ints + n_floats)
    if n_floats > _TIME and extended >= width * n:
        about = np.memmap(path, dtype="u1", mode="r", offset=_HEADER, shape=(extended,))
        seconds = about[: width * n].reshape(n, width)[:, 4 * (n_ints + _TIME) :][:, :4]
        stamps = np.ascontiguousarray(seconds).view(f"{order}f4").ravel().astype(np.float64)
        clock = np.array([[stamps[number(t, z)] for z in range(where.z)] for t in range(where.t)])
        clock = clock if np.any(clock != clock[0, 0]) else np.full_like(clock, np.nan)
    scale = clock_scale(np.array([in_um(v, "um") for v in lengths[::-1]]), clock)
    return Contents(
        shape=(where.t, where.z, y, x),
        dtype=dtype.newbyteorder("="),
        plane=plane,
        close=lambda: None,
        voxel=scale.voxel,
        times=scale.times,
        plane_time=scale.plane_time,
        notes=scale.notes,
        without_times=scale.without_times,
    )
