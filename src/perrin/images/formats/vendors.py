"""Leica, Nikon, Imaris and OME-Zarr files, each read by the library of its format."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from perrin.images.formats.arrays import hdf5, numpy_file
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
from perrin.images.formats.deltavision import deltavision
from perrin.images.formats.olympus import olympus
from perrin.images.formats.zeiss import czi

if TYPE_CHECKING:
    from collections.abc import Callable

    from perrin._arrays import Floats


# Imaris blocks are several planes deep: with a smaller cache each is unpacked once per plane.
_IMARIS_CACHE = 2**25


def lif(path: str, pick: Pick) -> Contents:
    """Describe an image of a Leica .lif, .lof or .xlef file (liffile).

    Times are those of its time axis. A scan of x and z at many y is a volume like any other; one at
    a single y is a movie of a plane, whose y is the z of the microscope.

    Parameters
    ----------
    path : str
    pick : Pick
        The user's choices.

    Returns
    -------
    Contents
    """
    file = needed("liffile", "lif").LifFile(path)
    try:
        names = [image.path for image in file.images]
        image = file.images[chosen(names, pick.image)]
        section = "Y" not in image.sizes and "Z" in image.sizes
        seen = {"Z": "Y"} if section else {}
        sizes = {seen.get(axis, axis): n for axis, n in image.sizes.items()}
        if not {"X", "Y"} <= set(sizes):
            raise ValueError(f"has an image without an area, of {dict(image.sizes)}")
        inner = tuple(image.frames.frame_dims)
        where = layout(sizes, pick)
        steps = {axis: np.diff(values[:2]) for axis, values in image.coords.items()}
        spacing = {seen.get(axis, axis): float(s[0]) for axis, s in steps.items() if s.size}
        stamps = image.timestamps if "Z" not in inner else None
        plane_time = leica_plane_time(stamps, where.t, where.z)
    except Exception:
        file.close()
        raise

    def stored(at: dict[str, int]) -> NDArray[Any]:
        others = {axis: i for axis, i in at.items() if axis in image.sizes and axis not in inner}
        data = np.asarray(image.frame(**others))
        return data[..., at["S"]] if "S" in inner else data

    # The images of such a scan lie across the planes: one frame is kept.
    @lru_cache(maxsize=1)
    def volume(others: tuple[tuple[str, int], ...]) -> NDArray[Any]:
        rows = [stored({**dict(others), "Y": y}) for y in range(image.sizes["Y"])]
        return np.stack(rows, axis=1)

    def plane(t: int, z: int) -> NDArray[Any]:
        at = where.at(t, z)
        if section or "Z" not in inner:
            return stored(at)
        return np.asarray(volume(tuple((a, i) for a, i in at.items() if a != "Z"))[at["Z"]])

    return Contents(
        shape=(where.t, where.z, sizes["Y"], sizes["X"]),
        dtype=np.dtype(image.dtype),
        plane=plane,
        close=file.close,
        voxel=np.array([in_um(spacing.get(axis), "m") for axis in "ZYX"]),
        times=even_times(where.t, in_seconds(spacing.get("T"), "s")),
        plane_time=plane_time,
        notes=("the images are sections (z, x): their z is read as y",) if section else (),
    )


def leica_plane_time(stamps: NDArray[np.datetime64] | None, t: int, z: int) -> float | None:
    """Return the time from one plane to the next, where a Leica file has a stamp of every plane.

    Parameters
    ----------
    stamps : ndarray or None
        Time stamps of the images, planes before frames.
    t, z : int
        Number of frames, and of planes of a frame.

    Returns
    -------
    float or None
        Mean time over the planes of a frame, s, because the stamps are in whole milliseconds; its
        median over the frames. None where there is not one stamp of each plane.

    Examples
    --------
    >>> leica_plane_time(np.array([0, 20, 700, 720], dtype="datetime64[ms]"), 2, 2)
    0.02
    """
    if stamps is None or z == 1 or len(stamps) != t * z:
        return None
    clock = stamps.reshape(t, z)
    step = float(np.median((clock[:, -1] - clock[:, 0]) / np.timedelta64(1, "s"))) / (z - 1)
    return step if step > 0 else None


def nd2(path: str, pick: Pick) -> Contents:
    """Describe a Nikon .nd2 file (nd2), which states the time of every plane."""
    file = needed("nd2", "nd2").ND2File(path)
    try:
        sizes = dict(file.sizes)
        loops = [axis for axis in sizes if axis not in "CSYX"]
        # Positions of the stage are images of their own.
        position = {"P": chosen([f"position {i}" for i in range(sizes.get("P", 1))], pick.image)}
        where = layout({axis: n for axis, n in sizes.items() if axis != "P"}, pick)
        volume = file.metadata.channels[pick.channel or 0].volume
        known = zip(volume.axesCalibration, volume.axesCalibrated, strict=True)
        x, y, z = (length if yes else None for length, yes in known)

        def number(t: int, k: int) -> int:
            at = where.at(t, k) | position
            index = [at.get(axis, 0) for axis in loops]
            return int(np.ravel_multi_index(index, [sizes[a] for a in loops])) if loops else 0

        def seconds(t: int, k: int) -> float:
            channel = file.frame_metadata(number(t, k)).channels[pick.channel or 0]
            return float(channel.time.relativeTimeMs) / 1e3

        times = np.array([seconds(t, 0) for t in range(where.t)])
        plane_time = seconds(0, 1) - times[0] if where.z > 1 else 0.0
    except Exception:
        file.close()
        raise

    def plane(t: int, k: int) -> NDArray[Any]:
        data = np.asarray(file.read_frame(number(t, k)))
        at = where.at(t, k)
        if "C" in sizes:
            data = data[at["C"]]
        return data[..., at["S"]] if "S" in sizes else data

    return Contents(
        shape=(where.t, where.z, sizes["Y"], sizes["X"]),
        dtype=np.dtype(file.dtype),
        plane=plane,
        close=file.close,
        voxel=np.array([in_um(length, "um") for length in (z, y, x)]),
        times=times,
        plane_time=plane_time if plane_time > 0 else None,
    )


def ims(path: str, pick: Pick) -> Contents:
    """Describe an Imaris .ims file: HDF5, finest resolution, padded blocks cut to the image."""
    file = needed("h5py", "ims").File(path, "r", rdcc_nbytes=_IMARIS_CACHE)
    try:
        group: Any = file
        for name in ("DataSet", "ResolutionLevel 0", "TimePoint 0", "Channel 0", "Data"):
            link = type(group.get(name, getlink=True)).__name__ if hasattr(group, "get") else ""
            if link == "ExternalLink":
                raise ValueError(f"has its {name!r} in another file: save it as one file")
            group = group[name]
        if getattr(group, "external", None) or getattr(group, "is_virtual", False):
            raise ValueError("has its images in other files: save it as one file")
        finest = file["DataSet"]["ResolutionLevel 0"]
        about = file["DataSetInfo"]
        image = {key: _imaris_text(value) for key, value in about["Image"].attrs.items()}
        chosen(["image"], pick.image)
        size = imaris_size(image, finest["TimePoint 0"]["Channel 0"])
        n_channels = len(finest["TimePoint 0"])
        where = layout({"T": len(finest), "C": n_channels, **size}, pick)
        dtype = finest["TimePoint 0"]["Channel 0"]["Data"].dtype
        extent = [
            float(image[f"ExtMax{i}"]) - float(image[f"ExtMin{i}"])
            for i in (2, 1, 0)
            if f"ExtMax{i}" in image
        ]
        voxel = np.full(3, np.nan)
        if len(extent) == 3:
            per_axis = zip(extent, size.values(), strict=True)
            voxel = np.array([in_um(e / n, image.get("Unit", "um")) for e, n in per_axis])
        times = imaris_times(about, where.t)
    except Exception:
        file.close()
        raise

    def plane(t: int, z: int) -> NDArray[Any]:
        at = where.at(t, z)
        data = finest[f"TimePoint {at.get('T', 0)}"][f"Channel {at['C']}"]["Data"]
        return np.asarray(data[at.get("Z", 0), : size["Y"], : size["X"]])

    return Contents(
        shape=(where.t, where.z, size["Y"], size["X"]),
        dtype=dtype,
        plane=plane,
        close=file.close,
        voxel=voxel,
        times=times,
    )


def imaris_size(image: dict[str, str], channel: Any) -> dict[str, int]:  # noqa: ANN401
    """Return the size of the image in an Imaris file, whose blocks may extend beyond it.

    Parameters
    ----------
    image : dict
        Attributes of the whole image, which a minimal file has not all.
    channel : h5py.Group
        The first channel, which has attributes of its own.

    Returns
    -------
    dict of str to int
        Number of voxels along Z, Y, X.
    """
    size = {}
    for axis, n in zip("ZYX", channel["Data"].shape, strict=True):
        own = channel.attrs.get(f"ImageSize{axis}")
        stated = image.get(axis) or (None if own is None else _imaris_text(own))
        size[axis] = int(n if stated is None else stated)
    return size


def imaris_times(about: Any, n: int) -> Floats | None:  # noqa: ANN401 (an HDF5 group)
    """Read the times of the frames from their dates in an Imaris file.

    Parameters
    ----------
    about : h5py.Group
        The group DataSetInfo of the file.
    n : int
        Number of frames.

    Returns
    -------
    ndarray, shape (n,), or None
        Times since the first frame, s; None where a frame has no date.
    """
    from datetime import datetime

    if n == 1:
        return np.zeros(1)
    attributes = about["TimeInfo"].attrs if "TimeInfo" in about else {}
    stamps = [_imaris_text(attributes.get(f"TimePoint{i + 1}", "")) for i in range(n)]
    if not all(stamps):
        return None
    start, *_ = moments = [datetime.fromisoformat(stamp.strip()) for stamp in stamps]
    return np.array([(moment - start).total_seconds() for moment in moments])


def _imaris_text(value: Any) -> str:  # noqa: ANN401 (Imaris writes arrays of single characters)
    """Return an attribute of an Imaris file as text."""
    if isinstance(value, np.ndarray):
        text = b"".join(np.atleast_1d(value).astype("S1")).decode()
    else:
        text = value.decode() if isinstance(value, bytes) else str(value)
    # The library of Imaris ends texts with a zero.
    return text.rstrip("\x00 ")


def ome_zarr(path: str, pick: Pick) -> Contents:
    """Describe an image of an OME-Zarr folder (NGFF 0.4 and 0.5), its finest resolution.

    The folder is that of an image, or the root that bioformats2raw writes above several.

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
        If the folder has no image.
    """
    if (Path(path) / ".zarray").exists():
        raise ValueError("is one zarr array without a header: pass the array itself")
    group = needed("zarr", "zarr").open_group(path, mode="r")
    header = group.attrs.get("ome", group.attrs)
    if "bioformats2raw.layout" in header:
        attributes = group["OME"].attrs if "OME" in group else {}
        listed = attributes.get("ome", attributes).get("series")
        numbered = sorted((name for name in group.group_keys() if name.isdigit()), key=int)
        series = [str(name) for name in listed or numbered]
        group = group[series[chosen(series, pick.image)]]
        header = group.attrs.get("ome", group.attrs)
    else:
        chosen(["image"], pick.image)
    if "plate" in header:
        raise ValueError("is a plate of OME-Zarr: pass the folder of one image in it, as A/1/0")
    if "multiscales" not in header:
        raise ValueError("is a zarr folder without OME-Zarr `multiscales`: pass the array itself")
    scales = header["multiscales"][0]
    axes = {a["name"].upper(): a.get("unit") for a in scales["axes"]}
    array = group[scales["datasets"][0]["path"]]
    step = dict(zip(axes, ngff_scale(scales, len(axes)), strict=True))
    sizes = dict(zip(axes, array.shape, strict=True))
    where = layout(sizes, pick)

    depth = array.chunks[list(axes).index("Z")] if "Z" in axes else 1

    # Blocks may be many planes deep: the block read last is cached.
    @lru_cache(maxsize=1)
    def block(others: tuple[int, ...], number: int) -> NDArray[Any]:
        rest = iter(others)
        span = {
            "Z": slice(number * depth, (number + 1) * depth),
            "Y": slice(None),
            "X": slice(None),
        }
        return np.asarray(array[tuple(span.get(a) or next(rest) for a in axes)])

    def plane(t: int, z: int) -> NDArray[Any]:
        at = where.at(t, z)
        others = tuple(at.get(a, 0) for a in axes if a not in "ZYX")
        planes = block(others, at.get("Z", 0) // depth)
        return planes[at.get("Z", 0) % depth] if "Z" in axes else planes

    return Contents(
        shape=(where.t, where.z, sizes["Y"], sizes["X"]),
        dtype=np.dtype(array.dtype),
        plane=plane,
        close=lambda: None,
        voxel=np.array([in_um(step.get(a), axes.get(a)) for a in "ZYX"]),
        times=even_times(where.t, in_seconds(step.get("T"), axes.get("T"))),
    )


def ngff_scale(scales: Any, n: int) -> Floats:  # noqa: ANN401 (a JSON header)
    """Return the product of the scale of the finest level and that of the whole image.

    Parameters
    ----------
    scales : dict
        The first entry of `multiscales` in the header of an OME-Zarr folder.
    n : int
        Number of axes.

    Returns
    -------
    ndarray, shape (n,)

    Examples
    --------
    >>> scale = {"type": "scale", "scale": [1.0, 0.25, 0.2, 0.2]}
    >>> dataset = {"path": "0", "coordinateTransformations": [scale]}
    >>> ngff_scale({"datasets": [dataset]}, 4)
    array([1.  , 0.25, 0.2 , 0.2 ])
    """
    total = np.ones(n)
    for holder in (scales["datasets"][0], scales):
        for change in holder.get("coordinateTransformations", []):
            if change["type"] == "scale":
                total = total * np.asarray(change["scale"], dtype=np.float64)
    return total


class Format(NamedTuple):
    """A format of image files that is read.

    Attributes
    ----------
    name : str
        What a file of this format is, for messages.
    read : callable
        ``read(path, pick)`` describes the contents of a file.
    apart : bool
        Whether files are read in a process of their own (`guarded`), because a library decodes
        them.

    Examples
    --------
    >>> Format("Nikon ND2", nd2).name
    'Nikon ND2'
    """

    name: str
    read: Callable[[str, Pick], Contents]
    apart: bool = True


_FORMATS = {
    **dict.fromkeys((".lif", ".lof", ".xlef", ".xlif"), Format("Leica LAS X", lif)),
    ".nd2": Format("Nikon ND2", nd2),
    ".czi": Format("Zeiss CZI", czi),
    ".ims": Format("Imaris", ims),
    **dict.fromkeys((".oib", ".oif"), Format("Olympus FluoView", olympus)),
    **dict.fromkeys((".dv", ".r3d"), Format("DeltaVision", deltavision, apart=False)),
    **dict.fromkeys((".npy", ".npz"), Format("numpy array", numpy_file, apart=False)),
    **dict.fromkeys((".h5", ".hdf5"), Format("HDF5", hdf5)),
}

# Formats of microscopes without a free reader under a permissive licence, and files of pictures.
_UNREAD = {
    ".oir": "an Olympus FluoView OIR file",
    ".vsi": "an Olympus cellSens file",
    ".sld": "a SlideBook file",
    ".sldy": "a SlideBook file",
    ".zvi": "a Zeiss AxioVision file",
    ".mvd2": "a Volocity file",
    ".ids": "an ICS file",
    ".ics": "an ICS file",
    ".mrc": "an MRC file",
    **dict.fromkeys((".avi", ".mp4", ".mov", ".mkv", ".wmv"), "a video"),
    **dict.fromkeys((".png", ".jpg", ".jpeg", ".bmp", ".gif"), "a picture"),
}

WAY_OUT = (
    "export it as OME-TIFF, or save the array (t, z, y, x) with np.save and open the .npy file"
)


def vendor(path: str) -> Format | None:
    """Return the format of a file by its suffix; None for TIFF files and folders of them.

    Raises
    ------
    ValueError
        For a format that is known and not read, with what it is and what to do.

    Examples
    --------
    >>> vendor("movie.lif").name, vendor("movie.tif")
    ('Leica LAS X', None)
    """
    # Addresses of object stores hold OME-Zarr: the other formats are not read by range.
    if "://" in path or any(
        (Path(path) / name).exists() for name in (".zgroup", ".zarray", "zarr.json")
    ):
        return Format("OME-Zarr", ome_zarr)
    suffix = Path(path).suffix.lower()
    if suffix in _UNREAD:
        raise ValueError(f"is {_UNREAD[suffix]}, which is not read: {WAY_OUT}")
    return _FORMATS.get(suffix)
