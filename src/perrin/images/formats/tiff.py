"""TIFF in its dialects: plain, OME, ImageJ, and sequences of files."""

from __future__ import annotations

import re
import struct
from contextlib import closing
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from perrin.images.formats.contents import (
    UNNAMED,
    Contents,
    Layout,
    Pick,
    chosen,
    even_times,
    in_seconds,
    in_um,
    layout,
    needed,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from perrin._arrays import Floats


class _Scale(NamedTuple):
    """What a header says of lengths and times."""

    voxel: Floats
    times: Floats | None = None
    plane_time: float | None = None


class _Declared(NamedTuple):
    """Images one after the other in a file, as its header declares them."""

    axes: str
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    dataoffset: int


_SILENT = _Scale(np.full(3, np.nan))


def tiff(path: str, pick: Pick, *, one_frame: bool = False) -> Contents:
    """Describe one TIFF file; with `one_frame` all its images are the planes of a single frame."""
    file = needed("tifffile", "images").TiffFile(path)
    try:
        number = chosen([str(series.name) for series in file.series], pick.image)
        series = _imagej_series(file) or file.series[number]
        names, notes = _named_axes(series, pick)
        sizes = dict(zip(names, series.shape, strict=True))
        choice = _whole(sizes, pick) if one_frame else pick
        where = layout(sizes, choice, cut=_cut_short(file))
        scale = _scale(file, number, where, pick.channel or 0)
    except struct.error as fault:
        file.close()
        raise ValueError("is cut short, within the header of an image: copy it again") from fault
    except Exception:
        file.close()
        raise

    def plane(t: int, z: int) -> NDArray[Any]:
        return _plane(file, series, names, where.at(t, z))

    return Contents(
        shape=(where.t, where.z, sizes["Y"], sizes["X"]),
        dtype=np.dtype(series.dtype),
        plane=plane,
        close=file.close,
        voxel=scale.voxel,
        times=scale.times if scale.times is not None else even_times(where.t, np.nan),
        plane_time=scale.plane_time,
        notes=notes,
    )


def _named_axes(series: Any, pick: Pick) -> tuple[list[str], tuple[str, ...]]:  # noqa: ANN401
    """Return a name of its own for every axis of a series, and how unnamed ones were read.

    tifffile names axes of an unknown meaning Q or I, several of them alike: what `imwrite` makes of
    an array (t, z, y, x) has the axes QQYX. Two of them are times and planes in the order of the
    array; three, or one beside a named one, only where `pick` settles which is which.
    """
    axes = _without_colours(series, pick)
    named = [axis for axis in axes if axis not in UNNAMED]
    if len(set(named)) < len(named):
        raise ValueError(f"has axes {series.axes}, several of one name")
    unknown = [k for k, axis in enumerate(axes) if axis in UNNAMED]
    shape = tuple(series.shape)
    known = [axis for axis in "TZ" if axis in axes]
    if len(unknown) == 2 and not known:
        roles = dict(zip(unknown, "TZ", strict=True))
    else:
        roles = _settled_roles([k for k in unknown if shape[k] > 1], known, shape, pick)
    # Axes of one element that are left are no choice: any name of their own will do.
    answer = [roles.get(k, f"{axis}{k}" if k in unknown else axis) for k, axis in enumerate(axes)]
    if not {"T", "Z"} & set(roles.values()):
        return answer, ()
    read = ", ".join(
        roles.get(k, "1" if k in unknown else axis).lower() for k, axis in enumerate(axes)
    )
    return answer, (f"the file does not name the axes of its shape {shape}: read as ({read})",)


def _without_colours(series: Any, pick: Pick) -> list[str]:  # noqa: ANN401
    """Return the letters of the axes, Q for what only `imwrite` took for the colours of an image.

    Of three or four images in a row, not named by their writer, tifffile makes colours.
    """
    axes = list(series.axes)
    if getattr(series, "kind", "") != "shaped" or set(axes) & set("TZC") or "S" not in axes:
        return axes
    place = axes.index("S")
    if place > axes.index("Y") or pick.channel is not None:
        return axes
    if pick.planes is None:
        n, shape = series.shape[place], tuple(series.shape)
        raise ValueError(
            f"has shape {shape}, whose {n} images along axis {place} tifffile took for colours: "
            f"pass planes={n} if they are the planes of a frame"
            f"{', planes=1 if they are times' if len(shape) == 3 else ''}, or channel=0 to {n - 1}"
        )
    axes[place] = "Q"
    return axes


def _settled_roles(
    unknown: list[int], known: list[str], shape: tuple[int, ...], pick: Pick
) -> dict[int, str]:
    """Return which of the unnamed axes are times, planes and channels, as far as `pick` says so.

    Raises
    ------
    ValueError
        If it does not; a single unnamed axis is left to `layout`.
    """
    if not unknown or (len(unknown) == 1 and not known):
        return dict.fromkeys(unknown, "Q")
    sizes = [shape[k] for k in unknown]
    roles = {
        (1, ("T",)): "Z" if pick.planes == sizes[0] else "",
        (1, ("Z",)): "T" if pick.planes is not None else "",
        (2, ()): "TZ" if pick.planes == sizes[-1] else "",
        (3, ()): _order_of_three(sizes[1:], pick),
    }.get((len(unknown), tuple(known)), "")
    if not roles:
        raise ValueError(
            f"has shape {shape} and does not say what its axes of "
            f"{', '.join(map(str, sizes))} images are: pass planes=, the number of planes of one "
            "frame, and channel= if one of them is channels (times come first then), or write the "
            "file with its axes, as in imwrite(..., metadata={'axes': 'TZYX'})"
        )
    return dict(zip(unknown, roles, strict=True))


def _order_of_three(inner: list[int], pick: Pick) -> str:
    """Return which of the two inner axes are planes and channels; "" where it is open."""
    if pick.channel is None or inner.count(pick.planes or 0) != 1:
        return ""
    return "TZC" if inner[0] == pick.planes else "TCZ"


def _cut_short(file: Any) -> bool:  # noqa: ANN401 (tifffile is untyped here)
    """Return whether the chain of images ends otherwise than with the zero that ends it."""
    end = file.pages.next_page_offset
    if end is None:
        return False
    file.filehandle.seek(end)
    return any(file.filehandle.read(file.tiff.offsetsize))


def _imagej_series(file: Any) -> _Declared | None:  # noqa: ANN401
    """Return the images that an ImageJ header declares where the file ends before their last."""
    header = file.imagej_metadata if file.is_imagej else None
    page = file.pages.first
    if not header or len(file.pages) > 1 or not page.is_contiguous:
        return None
    axes = {"T": "frames", "Z": "slices", "C": "channels"}
    shape = (*(int(header.get(name, 1)) for name in axes.values()), *page.shape)
    start = page.dataoffsets[0]
    whole = prod(shape) * np.dtype(page.dtype).itemsize
    if page.axes != "YX" or start + whole <= file.filehandle.size:
        return None
    return _Declared("TZCYX", shape, page.dtype, start)


def _whole(sizes: Mapping[str, int], pick: Pick) -> Pick:
    """Return the choice that takes a file for one frame."""
    if sizes.get("T", 1) > 1:
        raise ValueError(f"is a movie of {sizes['T']} frames, where one frame was expected")
    return pick._replace(planes=prod(n for axis, n in sizes.items() if axis not in "CSYX"))


def _plane(
    file: Any,  # noqa: ANN401
    series: Any,  # noqa: ANN401
    names: list[str],
    at: dict[str, int],
) -> NDArray[Any]:
    """Read one image (y, x) of a series, whose axes have these names."""
    index = [at.get(name, 0) for name in names]
    if any(i >= n for i, n in zip(index, series.shape, strict=True)):
        raise ValueError("the file ends before it")
    lead = _leading(series)
    number = int(np.ravel_multi_index(index[:lead], series.shape[:lead])) if lead else 0
    block = _stretch(file, series, number, lead)
    inside = (
        slice(None) if axis in "YX" else i
        for axis, i in zip(series.axes[lead:], index[lead:], strict=True)
    )
    return np.asarray(block[tuple(inside)])


def _leading(series: Any) -> int:  # noqa: ANN401
    """Return how many axes count images; the others lie within one (Y, X, colours)."""
    return min(str(series.axes).index(axis) for axis in "YX" + ("S" if "S" in series.axes else ""))


def _stretch(file: Any, series: Any, number: int, lead: int) -> NDArray[Any]:  # noqa: ANN401
    """Read the images that belong to one index, (Y, X) or with colours.

    Of a contiguous file the header may list the first page only, so the bytes are counted.
    """
    block = series.shape[lead:]
    if series.dataoffset is None:
        page = series.pages[number] if number < len(series.pages) else None
        if page is None:
            raise ValueError(f"image {number} is not in the file")
        return np.asarray(page.asarray().reshape(block))
    dtype = np.dtype(series.dtype).newbyteorder(file.byteorder)
    n_bytes = prod(block) * dtype.itemsize
    file.filehandle.seek(series.dataoffset + number * n_bytes)
    data = file.filehandle.read(n_bytes)
    if len(data) < n_bytes:
        raise ValueError(f"the file ends before or within image {number}")
    return np.frombuffer(data, dtype=dtype).reshape(block)


def _scale(file: Any, number: int, where: Layout, channel: int) -> _Scale:  # noqa: ANN401
    """Read voxel size and times from the dialect of the file."""
    if file.is_ome:
        return _ome(file.ome_metadata, number, where, channel)
    if file.is_imagej:
        return _imagej(file, where)
    return _SILENT


def _ome(xml: str, number: int, where: Layout, channel: int) -> _Scale:
    """Read the OME header: pixel sizes, and times measured plane by plane or an interval."""
    from xml.etree import ElementTree

    pixels = [e for e in ElementTree.fromstring(xml).iter() if e.tag.endswith("}Pixels")][number]
    voxel = np.array(
        [
            in_um(
                pixels.get(f"PhysicalSize{axis}"), pixels.get(f"PhysicalSize{axis}Unit", "\u00b5m")
            )
            for axis in "ZYX"
        ]
    )
    step = in_seconds(pixels.get("TimeIncrement"), pixels.get("TimeIncrementUnit", "s"))
    clock = np.full((where.t, where.z), np.nan)
    for e in pixels:
        if e.tag.endswith("}Plane") and e.get("DeltaT") and int(e.get("TheC", 0)) == channel:
            t, z = int(e.get("TheT", 0)), int(e.get("TheZ", 0))
            if t < where.t and z < where.z:
                unit = in_seconds(1.0, e.get("DeltaTUnit", "s"))
                clock[t, z] = float(e.get("DeltaT", "nan")) * unit
    return _clocked(voxel, clock, even_times(where.t, step))


def _clocked(voxel: Floats, clock: Floats, even: Floats | None) -> _Scale:
    """Take the times of planes (t, z) where all frames have them, else the even ones."""
    start = clock[:, 0]
    steps = np.diff(clock, axis=1)
    steps = steps[np.isfinite(steps)]
    per_plane = float(np.median(steps)) if steps.size else 0.0
    measured = bool(np.all(np.isfinite(start)) and np.all(np.diff(start) > 0))
    return _Scale(voxel, start if measured else even, per_plane if per_plane > 0 else None)


def _imagej(file: Any, where: Layout) -> _Scale:  # noqa: ANN401
    """Read the ImageJ header: unit, spacing, interval, and the resolution tags in that unit."""
    header = file.imagej_metadata or {}
    unit = header.get("unit")
    tags = file.pages[0].tags

    def size(tag: str) -> float:
        if tag not in tags or not all(tags[tag].value):
            return float("nan")
        count, length = tags[tag].value
        return in_um(length / count, unit)

    voxel = np.array([in_um(header.get("spacing"), unit), size("YResolution"), size("XResolution")])
    rate = float(header.get("fps") or 0)
    step = in_seconds(header.get("finterval") or (1 / rate if rate > 0 else None), "s")
    return _Scale(voxel, even_times(where.t, step))


def sequence_files(path: str) -> list[str]:
    """Return the TIFF files of a folder or a glob, in the order of the numbers in their names."""
    from glob import glob

    inside = Path(path).iterdir() if Path(path).is_dir() else map(Path, glob(path))
    # Names that begin with a dot are an operating system's own, and halves of files being written.
    files = [
        str(f)
        for f in inside
        if f.suffix.lower() in (".tif", ".tiff") and f.is_file() and not f.name.startswith(".")
    ]
    return sorted(files, key=_counted)


def _counted(path: str) -> list[int | str]:
    """Sort key that puts t9 before t10."""
    return [int(part) if part.isdigit() else part for part in re.split(r"([0-9]+)", path)]


def sequence(path: str, pick: Pick) -> Contents:
    """Describe a folder or glob of TIFF files.

    A file of several images is one frame; files of one image each are counted in `pick.planes`.
    """
    files = sequence_files(path)
    if not files:
        raise ValueError("has no .tif or .tiff file")
    if len(files) == 1:
        return tiff(files[0], pick)
    first = tiff(files[0], pick, one_frame=True)
    first.close()
    _, inner, y, x = first.shape
    outer = Pick(planes=pick.planes if inner == 1 else 1)
    if inner > 1 and pick.planes not in (None, inner):
        raise ValueError(f"has files of {inner} images each, not planes={pick.planes}")
    where = layout({"I": len(files)}, outer)

    def plane(t: int, z: int) -> NDArray[Any]:
        number, k = (t, z) if inner > 1 else (t * where.z + z, 0)
        with closing(tiff(files[number], pick, one_frame=True)) as file:
            if file.shape != first.shape or file.dtype != first.dtype:
                raise ValueError(
                    f"{files[number]} is {file.shape[1:]} {file.dtype}, the first file "
                    f"{first.shape[1:]} {first.dtype}"
                )
            return file.plane(0, k)

    return Contents(
        shape=(where.t, inner if inner > 1 else where.z, y, x),
        dtype=first.dtype,
        plane=plane,
        close=lambda: None,
        voxel=first.voxel,
        times=even_times(where.t, np.nan),
    )
