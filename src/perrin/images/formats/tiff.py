"""TIFF files: plain, OME, ImageJ, and sequences of files."""

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
    from perrin._arrays import Floats


class HeaderScale(NamedTuple):
    """Lengths and times that the header of a file states.

    Attributes
    ----------
    voxel : ndarray, shape (3,)
        Voxel size (z, y, x), um; NaN where it is not stated.
    times : ndarray, shape (t,), or None
        Times of the frames, s.
    plane_time : float or None
        Time from one plane to the next, s.
    """

    voxel: Floats
    times: Floats | None = None
    plane_time: float | None = None


class DeclaredSeries(NamedTuple):
    """Contiguous images of a file, as its header declares them.

    Attributes
    ----------
    axes : str
        Letter of each axis.
    shape : tuple of int
        Size along each axis.
    dtype : numpy.dtype
        Type of the grey levels.
    dataoffset : int
        Position of the first image in the file, bytes.
    """

    axes: str
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    dataoffset: int


def tiff(path: str, pick: Pick, *, one_frame: bool = False) -> Contents:
    """Describe one TIFF file; with `one_frame` all its images are the planes of a single frame."""
    file = needed("tifffile", "images").TiffFile(path)
    try:
        number = chosen([str(series.name) for series in file.series], pick.image)
        series = declared_imagej_series(file) or file.series[number]
        names, notes = named_axes(series, pick)
        sizes = dict(zip(names, series.shape, strict=True))
        if one_frame:
            if sizes.get("T", 1) > 1:
                raise ValueError(f"is a movie of {sizes['T']} frames, where one frame was expected")
            planes = prod(n for axis, n in sizes.items() if axis not in "CSYX")
            where = layout(sizes, pick._replace(planes=planes), cut=is_cut_short(file))
        else:
            where = layout(sizes, pick, cut=is_cut_short(file))
        scale = HeaderScale(np.full(3, np.nan))
        if file.is_ome:
            scale = ome_scale(file.ome_metadata, number, where, pick.channel or 0)
        elif file.is_imagej:
            scale = imagej_scale(file, where)
    except struct.error as fault:
        file.close()
        raise ValueError("is cut short, within the header of an image: copy it again") from fault
    except Exception:
        file.close()
        raise

    def plane(t: int, z: int) -> NDArray[Any]:
        return read_plane(file, series, names, where.at(t, z))

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


def named_axes(series: Any, pick: Pick) -> tuple[list[str], tuple[str, ...]]:  # noqa: ANN401
    """Return a unique name for every axis of a series, and how unnamed axes were interpreted.

    tifffile gives axes of unknown meaning the letters Q or I, several axes the same one: an array
    (t, z, y, x) written by `imwrite` has the axes QQYX. Two of them are times and planes in the
    order of the array; three, or one besides a named one, only if `pick` decides which is which.

    Parameters
    ----------
    series : tifffile.TiffPageSeries or DeclaredSeries
    pick : Pick
        The user's choices.

    Returns
    -------
    names : list of str
    notes : tuple of str
        Empty where the file names its axes.

    Raises
    ------
    ValueError
        If several axes have one name, or unnamed axes are left undecided.
    """
    axes = axes_without_colours(series, pick)
    named = [axis for axis in axes if axis not in UNNAMED]
    if len(set(named)) < len(named):
        raise ValueError(f"has axes {series.axes}, several of one name")
    unknown = [k for k, axis in enumerate(axes) if axis in UNNAMED]
    shape = tuple(series.shape)
    known = [axis for axis in "TZ" if axis in axes]
    if len(unknown) == 2 and not known:
        roles = dict(zip(unknown, "TZ", strict=True))
    else:
        roles = axis_roles([k for k in unknown if shape[k] > 1], known, shape, pick)
    # Unnamed axes of one element get any unique name.
    answer = [roles.get(k, f"{axis}{k}" if k in unknown else axis) for k, axis in enumerate(axes)]
    if not {"T", "Z"} & set(roles.values()):
        return answer, ()
    read = ", ".join(
        roles.get(k, "1" if k in unknown else axis).lower() for k, axis in enumerate(axes)
    )
    return answer, (f"the file does not name the axes of its shape {shape}: read as ({read})",)


def axes_without_colours(series: Any, pick: Pick) -> list[str]:  # noqa: ANN401
    """Return the letters of the axes, with Q for planes or times that tifffile took for colours.

    tifffile takes three or four successive images without named axes for colours.

    Parameters
    ----------
    series : tifffile.TiffPageSeries or DeclaredSeries
    pick : Pick
        The user's choices.

    Returns
    -------
    list of str

    Raises
    ------
    ValueError
        If `pick` does not decide whether they are colours.
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


def axis_roles(
    unknown: list[int], known: list[str], shape: tuple[int, ...], pick: Pick
) -> dict[int, str]:
    """Return which of the unnamed axes are times, planes and channels, as `pick` decides.

    Parameters
    ----------
    unknown : list of int
        Unnamed axes of more than one element; a single one is left to `layout`.
    known : list of str
        Those of the letters T and Z that name an axis.
    shape : tuple of int
        Size of the file along all axes.
    pick : Pick
        The user's choices.

    Returns
    -------
    dict of int to str

    Raises
    ------
    ValueError
        If `pick` does not decide.

    Examples
    --------
    >>> axis_roles([0, 1, 2], [], (2, 3, 5, 12, 16), Pick(planes=5, channel=1))
    {0: 'T', 1: 'C', 2: 'Z'}
    """
    if not unknown or (len(unknown) == 1 and not known):
        return dict.fromkeys(unknown, "Q")
    sizes = [shape[k] for k in unknown]
    # Of three axes the first is times; the inner ones are planes and channels in either order.
    order_of_three = ""
    if pick.channel is not None and sizes[1:].count(pick.planes or 0) == 1:
        order_of_three = "TZC" if sizes[1] == pick.planes else "TCZ"
    roles = {
        (1, ("T",)): "Z" if pick.planes == sizes[0] else "",
        (1, ("Z",)): "T" if pick.planes is not None else "",
        (2, ()): "TZ" if pick.planes == sizes[-1] else "",
        (3, ()): order_of_three,
    }.get((len(unknown), tuple(known)), "")
    if not roles:
        raise ValueError(
            f"has shape {shape} and does not state what its axes of "
            f"{', '.join(map(str, sizes))} images are: pass planes=, the number of planes of one "
            "frame, and channel= if one of them is channels (times come first then), or write the "
            "file with its axes, as in imwrite(..., metadata={'axes': 'TZYX'})"
        )
    return dict(zip(unknown, roles, strict=True))


def is_cut_short(file: Any) -> bool:  # noqa: ANN401 (tifffile is untyped here)
    """Return whether the chain of images does not end with the zero that ends a complete one."""
    end = file.pages.next_page_offset
    if end is None:
        return False
    file.filehandle.seek(end)
    return any(file.filehandle.read(file.tiff.offsetsize))


def declared_imagej_series(file: Any) -> DeclaredSeries | None:  # noqa: ANN401
    """Return the images that an ImageJ header declares, if the file ends before the last one."""
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
    return DeclaredSeries("TZCYX", shape, page.dtype, start)


def read_plane(
    file: Any,  # noqa: ANN401
    series: Any,  # noqa: ANN401
    names: list[str],
    at: dict[str, int],
) -> NDArray[Any]:
    """Read one image of a series.

    Parameters
    ----------
    file : tifffile.TiffFile
    series : tifffile.TiffPageSeries or DeclaredSeries
    names : list of str
        Names of the axes of the series.
    at : dict of str to int
        Index along these axes; 0 where an axis is missing.

    Returns
    -------
    ndarray, shape (y, x)

    Raises
    ------
    ValueError
        If the file ends before the image.
    """
    index = [at.get(name, 0) for name in names]
    if any(i >= n for i, n in zip(index, series.shape, strict=True)):
        raise ValueError("the file ends before it")
    # The leading axes count images; the others lie within one: Y, X and colours.
    inner = "YX" + ("S" if "S" in series.axes else "")
    lead = min(str(series.axes).index(axis) for axis in inner)
    number = int(np.ravel_multi_index(index[:lead], series.shape[:lead])) if lead else 0
    block = series.shape[lead:]
    if series.dataoffset is None:
        page = series.pages[number] if number < len(series.pages) else None
        if page is None:
            raise ValueError(f"image {number} is not in the file")
        image = np.asarray(page.asarray().reshape(block))
    else:
        # The header of a contiguous file may list the first page only: the bytes are counted.
        dtype = np.dtype(series.dtype).newbyteorder(file.byteorder)
        n_bytes = prod(block) * dtype.itemsize
        file.filehandle.seek(series.dataoffset + number * n_bytes)
        data = file.filehandle.read(n_bytes)
        if len(data) < n_bytes:
            raise ValueError(f"the file ends before or within image {number}")
        image = np.frombuffer(data, dtype=dtype).reshape(block)
    inside = (
        slice(None) if axis in "YX" else i
        for axis, i in zip(series.axes[lead:], index[lead:], strict=True)
    )
    return np.asarray(image[tuple(inside)])


def ome_scale(xml: str, number: int, where: Layout, channel: int) -> HeaderScale:
    """Read an OME header: pixel sizes, and the measured times of planes or an interval.

    Parameters
    ----------
    xml : str
        The header.
    number : int
        Number of the image.
    where : Layout
        Times and planes of the image.
    channel : int
        Number of the channel, whose times are read.

    Returns
    -------
    HeaderScale
        The measured times where every frame has one, else even ones.

    Examples
    --------
    >>> xml = (
    ...     '<OME xmlns="a"><Image><Pixels PhysicalSizeZ="0.25" PhysicalSizeY="200" '
    ...     'PhysicalSizeYUnit="nm" TimeIncrement="0.5"/></Image></OME>'
    ... )
    >>> scale = ome_scale(xml, 0, layout({"T": 3, "Z": 4}, Pick()), 0)
    >>> scale.voxel, scale.times
    (array([0.25, 0.2 ,  nan]), array([0. , 0.5, 1. ]))
    """
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
    interval = in_seconds(pixels.get("TimeIncrement"), pixels.get("TimeIncrementUnit", "s"))
    clock = np.full((where.t, where.z), np.nan)
    for e in pixels:
        if e.tag.endswith("}Plane") and e.get("DeltaT") and int(e.get("TheC", 0)) == channel:
            t, z = int(e.get("TheT", 0)), int(e.get("TheZ", 0))
            if t < where.t and z < where.z:
                unit = in_seconds(1.0, e.get("DeltaTUnit", "s"))
                clock[t, z] = float(e.get("DeltaT", "nan")) * unit
    start = clock[:, 0]
    steps = np.diff(clock, axis=1)
    steps = steps[np.isfinite(steps)]
    plane_time = float(np.median(steps)) if steps.size else 0.0
    measured = bool(np.all(np.isfinite(start)) and np.all(np.diff(start) > 0))
    times = start if measured else even_times(where.t, interval)
    return HeaderScale(voxel, times, plane_time if plane_time > 0 else None)


def imagej_scale(file: Any, where: Layout) -> HeaderScale:  # noqa: ANN401
    """Read an ImageJ header: unit, spacing, interval, and the resolution tags in that unit.

    Parameters
    ----------
    file : tifffile.TiffFile
    where : Layout
        Times and planes of the file.

    Returns
    -------
    HeaderScale
    """
    header = file.imagej_metadata or {}
    unit = header.get("unit")
    tags = file.pages[0].tags

    def pixel_size(tag: str) -> float:
        if tag not in tags or not all(tags[tag].value):
            return float("nan")
        count, length = tags[tag].value
        return in_um(length / count, unit)

    spacing = in_um(header.get("spacing"), unit)
    voxel = np.array([spacing, pixel_size("YResolution"), pixel_size("XResolution")])
    rate = float(header.get("fps") or 0)
    interval = in_seconds(header.get("finterval") or (1 / rate if rate > 0 else None), "s")
    return HeaderScale(voxel, even_times(where.t, interval))


def sequence_files(path: str) -> list[str]:
    """Return the TIFF files of a folder or a glob, in the order of the numbers in their names."""
    from glob import glob

    inside = Path(path).iterdir() if Path(path).is_dir() else map(Path, glob(path))
    # Names that begin with a dot belong to the operating system or to files being written.
    files = [
        str(f)
        for f in inside
        if f.suffix.lower() in (".tif", ".tiff") and f.is_file() and not f.name.startswith(".")
    ]

    def numbered(path: str) -> list[int | str]:
        return [int(part) if part.isdigit() else part for part in re.split(r"([0-9]+)", path)]

    return sorted(files, key=numbered)


def sequence(path: str, pick: Pick) -> Contents:
    """Describe a folder or glob of TIFF files.

    A file of several images is one frame; of files of one image each, `pick.planes` are a frame.
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
