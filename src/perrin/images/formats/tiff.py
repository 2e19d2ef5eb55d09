"""TIFF files: plain, OME, ImageJ, LSM, MetaMorph and NDTiff."""

from __future__ import annotations

import struct
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from perrin.images.formats.contents import (
    UNNAMED,
    Contents,
    Pick,
    chosen,
    even_times,
    grid,
    in_um,
    layout,
    needed,
)
from perrin.images.formats.directories import check_directories
from perrin.images.formats.headers import (
    clock_scale,
    header_scale,
    image_header,
    ome_images,
    tiff_kind,
)

if TYPE_CHECKING:
    from collections.abc import Sequence


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
    file = opened(path)
    try:
        plain = not (file.is_ome or file.is_imagej)
        if plain and "Axes" in image_header(file.pages.first):
            return ndtiff([file], pick)
        # A LSM file has a thumbnail of every image.
        images = [s for s in file.series if not (file.is_lsm and s.keyframe.is_reduced)]
        titles = [str(s.name) for s in images]
        number = chosen(titles, pick.image)
        series = declared_imagej_series(file) or images[number]
        require_decoder(file)
        names, notes = named_axes(series, pick)
        sizes = dict(zip(names, series.shape, strict=True))
        if one_frame:
            if sizes.get("T", 1) > 1:
                raise ValueError(f"is a movie of {sizes['T']} frames, where one frame was expected")
            planes = prod(n for axis, n in sizes.items() if axis not in "CSYX")
            where = layout(sizes, pick._replace(planes=planes), cut=is_cut_short(file))
        else:
            where = layout(sizes, pick, cut=is_cut_short(file))
        scale = header_scale(file, where, number=number, names=titles, channel=pick.channel or 0)
    except struct.error as fault:
        file.close()
        raise ValueError("is cut short, within the header of an image: copy it again") from fault
    except ValueError as fault:
        file.close()
        raise ValueError(f"{tiff_kind(file)}: {fault}") from fault
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
        notes=notes + scale.notes,
        without_times=scale.without_times,
    )


def opened(path: str) -> Any:  # noqa: ANN401
    """Open a TIFF file, with the header of a set of files where that is a file of its own.

    Parameters
    ----------
    path : str

    Returns
    -------
    tifffile.TiffFile

    Raises
    ------
    ValueError
        If the header is in another file, which is missing; if the directories of the images loop
        or state impossible sizes (`check_directories`).
    """
    import re

    tifffile = needed("tifffile", "images")
    check_directories(path)
    file = tifffile.TiffFile(path)
    header = file.ome_metadata if file.is_ome else None
    if not header or "BinaryOnly" not in header:
        return file
    file.close()
    named = re.search(r'MetadataFile="([^"]+)"', header)
    name = named[1] if named else ""
    companion = Path(path).parent / name
    # A name with a path would be of another folder.
    if name != Path(name).name or not companion.is_file():
        ome_images(header)
    return tifffile.TiffFile(path, omexml=companion.read_text(encoding="utf-8"))


def require_decoder(file: Any) -> None:  # noqa: ANN401
    """Refuse a file whose compression needs a library that is not installed.

    Raises
    ------
    ImportError
        With the command that installs it.
    """
    page = file.pages.first
    decoders = needed("tifffile", "images").TIFF
    if page.compression in decoders.DECOMPRESSORS and page.predictor in decoders.UNPREDICTORS:
        return
    needed("imagecodecs", "images")


def is_set(path: str) -> bool:
    """Return whether the image of an OME file is spread over several files.

    Parameters
    ----------
    path : str

    Returns
    -------
    bool
    """
    with opened(path) as file:
        return file.is_ome and any(series.is_multifile for series in file.series)


def ndtiff(files: Sequence[Any], pick: Pick) -> Contents:
    """Describe NDTiff files of Micro-Manager, whose images state their places and times.

    Parameters
    ----------
    files : sequence of tifffile.TiffFile
        The files of one recording.
    pick : Pick
        The user's choices; the image is one of several positions.

    Returns
    -------
    Contents
    """
    from datetime import UTC, datetime

    pages = [page for file in files for page in file.pages]
    about = [image_header(page) for page in pages]
    letters = {"time": "T", "z": "Z", "channel": "C", "position": "P"}
    sizes, places = grid(
        [{letters.get(k, k): v for k, v in a.get("Axes", {}).items()} for a in about]
    )
    axes = list(sizes)
    position = {}
    if "P" in sizes:
        labels = [str(i) for i in range(sizes.pop("P"))]
        position = {"P": chosen(labels, pick.image)}
    elif pick.image is not None:
        chosen(["0"], pick.image)
    where = layout(sizes, pick)

    def number(t: int, z: int) -> int:
        at = where.at(t, z) | position
        return places[tuple(at.get(axis, 0) for axis in axes)]

    def received(t: int, z: int) -> float:
        header = about[number(t, z)]
        stamp = header.get("TimeReceivedByCore")
        if stamp:
            return datetime.fromisoformat(stamp).replace(tzinfo=UTC).timestamp()
        return float(header.get("ElapsedTime-ms", np.nan)) / 1e3

    first = about[number(0, 0)]
    pixel = in_um(first.get("PixelSizeUm"), "um")
    heights = [
        float(about[number(0, z)].get("ZPosition_um_Intended", np.nan))
        for z in range(min(2, where.z))
    ]
    depth = heights[-1] - heights[0]
    clock = np.array([[received(t, z) for z in range(where.z)] for t in range(where.t)])
    scale = clock_scale(np.array([in_um(depth, "um"), pixel, pixel]), clock - np.nanmin(clock))

    def plane(t: int, z: int) -> NDArray[Any]:
        return np.asarray(pages[number(t, z)].asarray())

    def close() -> None:
        for file in files:
            file.close()

    page = pages[0]
    return Contents(
        shape=(where.t, where.z, *page.shape),
        dtype=np.dtype(page.dtype),
        plane=plane,
        close=close,
        voxel=scale.voxel,
        times=scale.times,
        plane_time=scale.plane_time,
        notes=scale.notes,
        without_times=scale.without_times,
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
        # A page of a LSM file has all channels.
        n_pages = prod(series.shape[:lead])
        together = n_pages // len(series.pages) if file.is_lsm else 1
        at_page = number // together
        page = series.pages[at_page] if at_page < len(series.pages) else None
        if page is None:
            raise ValueError(f"image {number} is not in the file")
        # Other files of a set are closed between their images.
        handle = page.parent.filehandle
        was_closed = handle.closed
        if was_closed:
            handle.open()
        try:
            whole = page.asarray()
        finally:
            if was_closed:
                handle.close()
        image = np.asarray(whole.reshape(together, *block)[number % together])
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
