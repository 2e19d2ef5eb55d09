"""Zeiss .czi files, read with czifile; scenes, times and tiles are put together here."""

from __future__ import annotations

import re
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from perrin.images.formats.contents import (
    Contents,
    Pick,
    chosen,
    even_times,
    in_seconds,
    in_um,
    layout,
    needed,
)
from perrin.images.formats.headers import xml_root

if TYPE_CHECKING:
    from collections.abc import Sequence
    from xml.etree.ElementTree import Element

    from perrin._arrays import Floats

# Numbers by which CZI files name their compressions.
_LZW, _ZSTD, _ZSTD_WITH_HEADER = 2, 5, 6


def czi(path: str, pick: Pick) -> Contents:
    """Describe a scene of a Zeiss .czi file (czifile); a scene is an image of `pick`."""
    file = needed("czifile", "czi").CziFile(path)
    try:
        # Smaller copies of the image are stored beside it.
        blocks = [b for b in file.subblock_directory if b.shape == b.stored_shape]
        scenes = sorted({_index(b, "S") for b in blocks})
        scene = scenes[chosen([f"scene {i}" for i in scenes], pick.image)]
        blocks = [b for b in blocks if _index(b, "S") == scene]
        if any(b.shape[b.axes.index("0")] > 1 for b in blocks if "0" in b.axes):
            raise ValueError("has colours: save one channel as grey values, or export OME-TIFF")
        axes = sorted({axis for b in blocks for axis in b.axes} - set("SMYX0"))
        ranks = {axis: sorted({_index(b, axis) for b in blocks}) for axis in axes}
        sizes = {axis: len(ranks[axis]) for axis in axes}
        where = layout(sizes, pick)
        y0, height = _extent(blocks, "Y")
        x0, width = _extent(blocks, "X")
        tiles: dict[tuple[int, ...], list[Any]] = {}
        for b in blocks:
            place = tuple(ranks[axis].index(_index(b, axis)) for axis in axes)
            tiles.setdefault(place, []).append(b)

        def blocks_of(t: int, z: int) -> list[Any]:
            at = where.at(t, z)
            return tiles.get(tuple(at.get(axis, 0) for axis in axes), [])

        # A missing plane is the fault of its frame alone.
        first = next(b for t in range(where.t) for b in blocks_of(t, 0))
        dtype = np.dtype(first.dtype)
        _decoder(first.compression)
        header = xml_root(file.metadata())
        lengths = [header.findtext(f".//Scaling/Items/Distance[@Id='{a}']/Value") for a in "ZYX"]
        started = [_clock_time(blocks_of(t, 0)) for t in range(where.t)]
        # A file without attachments has no directory of them.
        attached = file.attachments() if file.header.attachment_directory_position > 0 else ()
        stamps = [a.data() for a in attached if a.attachment_entry.name == "TimeStamps"]
        times = czi_times(header, [float(value) for one in stamps[:1] for value in one], started)
        passed = np.diff([_clock_time(blocks_of(0, z)) for z in range(where.z)])
        passed = passed[np.isfinite(passed) & (passed > 0)]
    except Exception:
        file.close()
        raise

    def plane(t: int, z: int) -> NDArray[Any]:
        found = blocks_of(t, z)
        if not found:
            raise ValueError(f"the file lacks its plane {z}")
        out = np.zeros((height, width), dtype=dtype)
        for b in found:
            y, x = _index(b, "Y") - y0, _index(b, "X") - x0
            data = _pixels(b)
            out[y : y + data.shape[0], x : x + data.shape[1]] = data
        return out

    return Contents(
        shape=(where.t, where.z, height, width),
        dtype=dtype,
        plane=plane,
        close=file.close,
        voxel=np.array([in_um(length, "m") for length in lengths]),
        times=times,
        plane_time=float(np.median(passed)) if passed.size else None,
    )


def czi_times(header: Element, stamps: Sequence[float], started: Sequence[float]) -> Floats | None:
    """Return the times of the frames: measured ones, a list of offsets, or an even interval.

    Parameters
    ----------
    header : Element
        Metadata of the file.
    stamps : sequence of float
        Time stamps that the microscope attached, s; empty where there are none.
    started : sequence of float, length n
        Time of day at which the first plane of every frame was recorded, s; NaN where the file
        does not state it.

    Returns
    -------
    ndarray, shape (n,), or None

    Examples
    --------
    >>> from xml.etree import ElementTree
    >>> header = ElementTree.fromstring("<A><T><Positions><List><Offsets>0 0.5 1.1</Offsets>"
    ...                                 "</List></Positions></T></A>")
    >>> czi_times(header, [], [np.nan] * 3)
    array([0. , 0.5, 1.1])
    """
    n = len(started)
    if len(stamps) == n > 1:
        return np.asarray(stamps, dtype=np.float64)
    offsets = np.array((header.findtext(".//T/Positions/List/Offsets") or "").split(), dtype=float)
    if len(offsets) == n > 1:
        return offsets
    if n > 1 and np.all(np.isfinite(started)) and np.any(np.diff(started) != 0):
        return np.asarray(started, dtype=np.float64) - started[0]
    step = header.findtext(".//T/Positions/Interval/Increment")
    return even_times(n, in_seconds(step, "s"))


def _index(block: Any, axis: str) -> int:  # noqa: ANN401
    """Return where a block of pixels begins along an axis; 0 where it has no such axis."""
    return int(block.start[block.axes.index(axis)]) if axis in block.axes else 0


def _extent(blocks: Sequence[Any], axis: str) -> tuple[int, int]:
    """Return the first pixel of all tiles along an axis, and their number of pixels."""
    first = min(_index(b, axis) for b in blocks)
    end = max(_index(b, axis) + b.shape[b.axes.index(axis)] for b in blocks)
    return first, end - first


def _clock_time(blocks: Sequence[Any]) -> float:
    """Return the time at which the first tile of a plane was recorded, s; NaN if not stated."""
    if not blocks:
        return np.nan
    header = str(blocks[0].data_segment().metadata(raw=True))
    found = re.search(r"<AcquisitionTime>\s*([^<\s]+)", header)
    if not found:
        return np.nan
    moment = datetime.fromisoformat(found[1][:26].rstrip("Z"))
    return moment.replace(tzinfo=UTC).timestamp()


def _decoder(compression: int) -> Any:  # noqa: ANN401
    """Return the library that unpacks a block; None for those without compression."""
    return needed("imagecodecs", "czi") if compression else None


def _pixels(block: Any) -> NDArray[Any]:  # noqa: ANN401
    """Return one block of pixels (y, x)."""
    codecs = _decoder(block.compression)
    segment = block.data_segment()
    shape = [n for axis, n in zip(block.axes, block.stored_shape, strict=True) if axis in "YX"]
    dtype = np.dtype(block.dtype)
    if block.compression not in (_LZW, _ZSTD, _ZSTD_WITH_HEADER):
        return np.asarray(segment.data()).reshape(shape)
    raw = segment.data(raw=True)
    if block.compression != _ZSTD_WITH_HEADER:
        unpack = codecs.lzw_decode if block.compression == _LZW else codecs.zstd_decode
        return np.frombuffer(unpack(raw), dtype=dtype).reshape(shape)
    # The header is its own length, then chunks; chunk 1 states whether low and high bytes of the
    # grey levels are stored one after the other.
    length = raw[0]
    separated = length >= 3 and raw[1] == 1 and raw[2] & 1
    data = np.frombuffer(codecs.zstd_decode(raw[length:]), dtype=np.uint8)
    if separated:
        data = np.ascontiguousarray(data.reshape(dtype.itemsize, -1).T)
    return np.asarray(data.view(dtype).reshape(shape))
