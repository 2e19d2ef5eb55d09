"""Leica, Nikon, Zeiss, Imaris and OME-Zarr files, each read by the library of its format."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
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

if TYPE_CHECKING:
    from collections.abc import Callable

    from perrin._arrays import Floats


# Imaris blocks are several planes deep: with a smaller cache each is unpacked once per plane.
_IMARIS_CACHE = 2**25


def lif(path: str, pick: Pick) -> Contents:
    """Describe an image of a Leica .lif file (liffile); times are those of its time axis."""
    file = needed("liffile", "lif").LifFile(path)
    try:
        names = [image.path for image in file.images]
        image = file.images[chosen(names, pick.image)]
        where = layout(image.sizes, pick)
        steps = {axis: np.diff(values[:2]) for axis, values in image.coords.items()}
        spacing = {axis: float(step[0]) for axis, step in steps.items() if step.size}
    except Exception:
        file.close()
        raise

    def plane(t: int, z: int) -> NDArray[Any]:
        at = {axis: i for axis, i in where.at(t, z).items() if axis in image.sizes}
        colour = at.pop("S", None)
        data = np.asarray(image.frame(**at))
        return data if colour is None else data[..., colour]

    return Contents(
        shape=(where.t, where.z, image.sizes["Y"], image.sizes["X"]),
        dtype=np.dtype(image.dtype),
        plane=plane,
        close=file.close,
        voxel=np.array([in_um(spacing.get(axis), "m") for axis in "ZYX"]),
        times=even_times(where.t, in_seconds(spacing.get("T"), "s")),
    )


def nd2(path: str, pick: Pick) -> Contents:
    """Describe a Nikon .nd2 file (nd2), which states the time of every plane."""
    file = needed("nd2", "nd2").ND2File(path)
    try:
        sizes = dict(file.sizes)
        where = layout(sizes, pick)
        loops = [axis for axis in sizes if axis not in "CSYX"]
        volume = file.metadata.channels[pick.channel or 0].volume
        known = zip(volume.axesCalibration, volume.axesCalibrated, strict=True)
        x, y, z = (length if yes else None for length, yes in known)

        def number(t: int, k: int) -> int:
            at = where.at(t, k)
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


def czi(path: str, pick: Pick) -> Contents:
    """Describe a Zeiss .czi file (pylibCZIrw)."""
    context = needed("pylibCZIrw.czi", "czi").open_czi(path)
    file = context.__enter__()

    def close() -> None:
        context.__exit__(None, None, None)

    try:
        if len(file.scenes_bounding_rectangle) > 1:
            raise ValueError("has several scenes: save the one wanted as a file of its own")
        box = {axis: stop - start for axis, (start, stop) in file.total_bounding_box.items()}
        where = layout(box, pick)
        scale = file.metadata["ImageDocument"]["Metadata"]
        lengths = {
            e["@Id"]: e.get("Value") for e in _header_items(scale, "Scaling", "Items", "Distance")
        }
        step = _header_items(
            scale, "Information", "Image", "Dimensions", "T", "Positions", "Interval", "Increment"
        )
        dtype = np.asarray(file.read(plane={"T": 0, "Z": 0, "C": pick.channel or 0})).dtype
    except Exception:
        close()
        raise

    def plane(t: int, z: int) -> NDArray[Any]:
        at = {axis: i for axis, i in where.at(t, z).items() if axis in box}
        data = np.asarray(file.read(plane=at))
        if data.shape[2] > 1:
            raise ValueError("has colours: save one channel as grey values")
        return data[..., 0]

    return Contents(
        shape=(where.t, where.z, box["Y"], box["X"]),
        dtype=dtype,
        plane=plane,
        close=close,
        voxel=np.array([in_um(lengths.get(axis), "m") for axis in "ZYX"]),
        times=even_times(where.t, in_seconds(step[0] if step else None, "s")),
    )


def ims(path: str, pick: Pick) -> Contents:
    """Describe an Imaris .ims file: HDF5, finest resolution, padded blocks cut to the image."""
    file = needed("h5py", "ims").File(path, "r", rdcc_nbytes=_IMARIS_CACHE)
    try:
        finest = file["DataSet"]["ResolutionLevel 0"]
        about = file["DataSetInfo"]
        image = {key: _imaris_text(value) for key, value in about["Image"].attrs.items()}
        size = {axis: int(image[axis]) for axis in "ZYX"}
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
        return b"".join(np.atleast_1d(value).astype("S1")).decode()
    return value.decode() if isinstance(value, bytes) else str(value)


def ome_zarr(path: str, pick: Pick) -> Contents:
    """Describe an OME-Zarr folder (NGFF 0.4 and 0.5), its finest resolution."""
    group = needed("zarr", "zarr").open_group(path, mode="r")
    header = group.attrs.get("ome", group.attrs)
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


def _header_items(tree: Any, *keys: str) -> list[Any]:  # noqa: ANN401 (a parsed XML header)
    """Return the items under a path of keys of a header; empty where a key is missing."""
    for key in keys:
        if not isinstance(tree, dict) or key not in tree:
            return []
        tree = tree[key]
    return tree if isinstance(tree, list) else [tree]


_READERS: dict[str, Callable[[str, Pick], Contents]] = {
    ".lif": lif,
    ".nd2": nd2,
    ".czi": czi,
    ".ims": ims,
}


def vendor(path: str) -> Callable[[str, Pick], Contents] | None:
    """Return the reader of a file by its suffix; None for all other files.

    Examples
    --------
    >>> vendor("movie.lif").__name__, vendor("movie.tif")
    ('lif', None)
    """
    if (Path(path) / ".zgroup").exists() or (Path(path) / "zarr.json").exists():
        return ome_zarr
    return _READERS.get(Path(path).suffix.lower())
