"""Image stacks of every format as one thing: frames (z, y, x) with voxel size and times."""

from __future__ import annotations

import hashlib
import os
import threading
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from perrin._arrays import Floats, frozen
from perrin.errors import FrameError, PrecisionWarning
from perrin.images.formats.contents import Contents, Pick, even_times, needed
from perrin.images.formats.tiff import sequence, sequence_files, tiff
from perrin.images.formats.vendors import vendor
from perrin.tracks.writing import written_whole

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from typing import Self


_PathLike: TypeAlias = str | os.PathLike[str]


# A value of the user's further than this from the file's is told.
_TELL = 1e-3


_OME_TYPES = ("uint8", "int8", "uint16", "int16", "uint32", "int32", "float32", "float64")


@dataclass(frozen=True, eq=False)
class Stack:
    """A movie of image stacks, read frame by frame.

    A context manager: ``with open_stack(path) as stack`` lets go of the file at the end.

    Attributes
    ----------
    shape : tuple of int
        (t, z, y, x); a 2-D movie has z = 1.
    dtype : numpy.dtype
        Of the voxels.
    voxel : ndarray, shape (3,)
        Voxel size (z, y, x), um; NaN for the z of a 2-D movie.
    times : ndarray, shape (t,)
        When the first plane of each frame was taken, s.
    plane_time : float or None
        Time from one plane to the next, s; None where it is not known.
    source : str
        Where the frames come from.
    read : callable
        ``read(i)`` returns frame i; `frame` is the safe way to it.
    notes : tuple of str
        How the file was read where it does not say, for instance which of its axes are times.
    """

    shape: tuple[int, int, int, int]
    dtype: np.dtype[Any]
    voxel: Floats
    times: Floats
    plane_time: float | None
    source: str
    read: Callable[[int], NDArray[Any]]
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        frozen(self.voxel, self.times)

    def __repr__(self) -> str:
        z, y, x = self.voxel
        return (
            f"Stack({self.source}, shape={self.shape}, {self.dtype}, "
            f"voxel=({z:.4g}, {y:.4g}, {x:.4g}) um, dt={self.dt:.4g} s)"
        )

    def __len__(self) -> int:
        return self.shape[0]

    def __iter__(self) -> Iterator[NDArray[Any]]:
        return (self.frame(i) for i in range(len(self)))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def path(self) -> Path | None:
        """The file, folder or glob that is read; None for what is in memory."""
        return Path(self.read.path) if isinstance(self.read, _FileFrames) else None

    @property
    def choice(self) -> dict[str, int | str | None]:
        """What was chosen of the file: channel, planes, image; empty for what is in memory."""
        return self.read.pick._asdict() if isinstance(self.read, _FileFrames) else {}

    @property
    def dt(self) -> float:
        """Median time between frames, s; NaN for a single frame."""
        return float(np.median(np.diff(self.times))) if len(self) > 1 else float("nan")

    def frame(self, i: int) -> NDArray[Any]:
        """Return frame i, shape (z, y, x).

        Raises
        ------
        FrameError
            If this frame cannot be read: catch it to go on with the next one.
        OSError
            If the whole file is out of reach where the stack was sent.
        IndexError
            If there is no such frame.
        """
        if not 0 <= i < len(self):
            raise IndexError(f"{self.source}: no frame {i}: it has {len(self)}, counted from 0")
        try:
            data = self.read(int(i))
        except (MemoryError, _UnopenedError):
            raise
        # The readers of damaged files raise whatever their decoders do.
        except Exception as fault:
            raise FrameError(
                f"{self.source}: frame {i} of {len(self)} cannot be read: {fault}", i, self.source
            ) from fault
        if data.shape != self.shape[1:]:
            raise FrameError(
                f"{self.source}: frame {i} has shape {data.shape}, the stack {self.shape[1:]}",
                i,
                self.source,
            )
        return data

    def close(self) -> None:
        """Let go of the file."""
        if isinstance(self.read, _FileFrames):
            self.read.close()


class _UnopenedError(OSError):
    """A whole file is out of reach, as on another machine: no fault of one frame."""


class _FileFrames:
    """Frames of an open file: one reader at a time, and opened anew where it is unpickled."""

    def __init__(self, path: str, pick: Pick, contents: Contents | None = None) -> None:
        self.path, self.pick, self._contents = path, pick, contents
        self._lock = threading.Lock()

    def __call__(self, i: int) -> NDArray[Any]:
        with self._lock:
            if self._contents is None:
                self._contents = self._opened()
            return self._contents.frame(i)

    def _opened(self) -> Contents:
        try:
            return _contents(self.path, self.pick)
        # The readers of damaged files raise whatever their decoders do.
        except Exception as fault:
            raise _UnopenedError(f"{self.path} cannot be opened here: {fault}") from fault

    def __reduce__(self) -> tuple[type[_FileFrames], tuple[str, Pick]]:
        return _FileFrames, (self.path, self.pick)

    def close(self) -> None:
        with self._lock:
            if self._contents is not None:
                self._contents.close()
            self._contents = None


@dataclass(frozen=True, eq=False)
class _ArrayFrames:
    """Frames of anything that is indexed like an array (t, z, y, x)."""

    array: Any
    shape: tuple[int, int, int, int]
    n_axes: int
    movie: bool

    def __call__(self, i: int) -> NDArray[Any]:
        whole = self.n_axes == 3 and not self.movie
        return np.asarray(self.array[:] if whole else self.array[i]).reshape(self.shape[1:])


def open_stack(
    path: _PathLike | ArrayLike,
    *,
    voxel: ArrayLike | None = None,
    dt: float | None = None,
    plane_time: float | None = None,
    planes: int | None = None,
    channel: int | None = None,
    image: int | str | None = None,
) -> Stack:
    """Open a movie of image stacks of any format; nothing is read but its header.

    Voxel size and times come from the file or from the user, never from a guess.

    Parameters
    ----------
    path : str, path or array_like
        TIFF, OME-TIFF, ImageJ hyperstack, a folder or glob of TIFF files (in the order of the
        numbers in their names); Leica ``.lif``, Nikon ``.nd2``, Zeiss ``.czi``, Imaris ``.ims``,
        OME-Zarr; or an array (t, z, y, x) or (z, y, x), also of dask, zarr or a memory map.
    voxel : array_like, shape (3,) or (2,), optional
        Voxel size (z, y, x), um; (y, x) for a 2-D movie. Needed where the file does not say, and
        used where it says otherwise.
    dt : float, optional
        Time between frames, s. Needed where the file does not say and there are several frames.
    plane_time : float, optional
        Time from one plane to the next, s; used for nothing but what asks for it.
    planes : int, optional
        Planes of one frame, where the file does not tell times from planes; 1 for a 2-D movie.
    channel : int, optional
        Which channel, from 0; needed where there are several.
    image : int or str, optional
        Which image of a file that holds several, by number or name.

    Returns
    -------
    Stack
        Reads a frame when asked for it. Can be sent to another process, where it opens the file
        again.

    Raises
    ------
    ValueError
        If the file cannot be read, or what it leaves open is not given; all faults in one message.
    ImportError
        If the reader of this format is not installed, with the command that installs it.
    FileNotFoundError
        If there is nothing at `path`.

    Warns
    -----
    PrecisionWarning
        Where a value given differs from the file's by more than 0.1 %.

    Examples
    --------
    >>> import numpy as np
    >>> movie = np.zeros((5, 8, 32, 32), dtype=np.uint8)
    >>> stack = open_stack(movie, voxel=(0.25, 0.2, 0.2), dt=0.7)
    >>> stack.shape, stack.frame(4).shape
    ((5, 8, 32, 32), (8, 32, 32))
    """
    size = None if voxel is None else np.atleast_1d(np.asarray(voxel, dtype=np.float64))
    if size is not None and size.shape == (2,) and planes is None:
        planes = 1
    pick = Pick(channel=channel, planes=planes, image=image)
    if isinstance(path, (str, os.PathLike)):
        source = os.fspath(path)
        contents = _opened(source, pick)
        read: Callable[[int], NDArray[Any]] = _FileFrames(os.path.abspath(source), pick, contents)
    else:
        source = "array"
        contents, read = _array_contents(path, pick)
    try:
        settled = _settled(source, contents, voxel=size, dt=dt, plane_time=plane_time)
    except Exception:
        contents.close()
        raise
    return Stack(
        contents.shape, contents.dtype, *settled, source=source, read=read, notes=contents.notes
    )


def _opened(source: str, pick: Pick) -> Contents:
    """Describe the file at `source`, every fault under its name."""
    try:
        return _contents(source, pick)
    except (FileNotFoundError, PermissionError, IsADirectoryError):
        raise
    except ImportError as missing:
        raise ImportError(f"{source}: {missing}") from missing
    # The readers of damaged files raise whatever their decoders do.
    except Exception as fault:
        raise ValueError(f"{source}: {fault}") from fault


def _contents(source: str, pick: Pick) -> Contents:
    """Choose the reader: by suffix for the vendors' formats, TIFF for all else."""
    reader = vendor(source)
    if reader is not None:
        return reader(source, pick)
    if Path(source).is_dir() or (not Path(source).exists() and sequence_files(source)):
        return sequence(source, pick)
    return tiff(source, pick)


def _array_contents(given: Any, pick: Pick) -> tuple[Contents, _ArrayFrames]:  # noqa: ANN401
    """Take an array for a movie (t, z, y, x), or (t, y, x) with planes=1, or one frame."""
    array = given if hasattr(given, "shape") else np.asarray(given)
    if pick.channel is not None or pick.image is not None:
        raise ValueError("array: channel and image are for files; pass the part of the array")
    n_axes = len(array.shape)
    movie = n_axes == 3 and pick.planes == 1
    if n_axes == 4:
        shape = tuple(array.shape)
    elif n_axes == 3:
        a, y, x = array.shape
        shape = (a, 1, y, x) if movie else (1, a, y, x)
    else:
        raise ValueError(
            f"array: expected (t, z, y, x), (z, y, x), or (t, y, x) with planes=1, got "
            f"{array.shape}"
        )
    if pick.planes not in (None, shape[1]) or 0 in shape:
        raise ValueError(f"array: {array.shape} has no frames of planes={pick.planes}")
    read = _ArrayFrames(array, shape, n_axes, movie)
    contents = Contents(
        shape=shape,
        dtype=np.dtype(array.dtype),
        plane=lambda t, z: read(t)[z],
        close=lambda: None,
        voxel=np.full(3, np.nan),
        times=even_times(shape[0], np.nan),
    )
    return contents, read


def _settled(
    source: str,
    contents: Contents,
    *,
    voxel: Floats | None,
    dt: float | None,
    plane_time: float | None,
) -> tuple[Floats, Floats, float | None]:
    """Return voxel, times and time per plane of file and user, all faults in one error."""
    size, faults = _voxel(contents, voxel)
    times, more = _times(contents, dt)
    per_plane = contents.plane_time if plane_time is None else plane_time
    faults += more
    if per_plane is not None and not (np.isfinite(per_plane) and per_plane >= 0):
        faults.append(f"plane_time: expected seconds >= 0, got {per_plane!r}")
    if faults:
        raise ValueError(f"{source}: " + "; ".join(faults))
    told = _differences(contents, size, times, per_plane)
    if told:
        warnings.warn(
            f"{source}: the values given are used: " + "; ".join(told),
            PrecisionWarning,
            stacklevel=3,
        )
    return size, times, per_plane


def _voxel(contents: Contents, given: Floats | None) -> tuple[Floats, list[str]]:
    """Return the voxel size (z, y, x) and what is wrong with it."""
    flat = contents.shape[1] == 1
    size = contents.voxel.copy()
    if given is not None:
        if given.shape not in ((3,), (2,)) or (given.shape == (2,) and not flat):
            return size, [f"voxel: expected (z, y, x) in um, got {given.tolist()}"]
        size[3 - len(given) :] = given
    bad = [
        axis
        for axis, length in zip("zyx", size, strict=True)
        if not (np.isfinite(length) and length > 0) and not (flat and axis == "z")
    ]
    if bad and given is not None:
        return size, [f"voxel: expected lengths > 0 in um, got {given.tolist()}"]
    if bad:
        wanted = "(y, x)" if flat else "(z, y, x)"
        # ImageJ calls the images of a movie slices unless told otherwise.
        movie = f", or (y, x) if its {contents.shape[1]} images are times"
        hint = movie if contents.shape[0] == 1 and not flat else ""
        return size, [f"no voxel size along {', '.join(bad)}: pass voxel={wanted} in um{hint}"]
    return size, []


def _times(contents: Contents, dt: float | None) -> tuple[Floats, list[str]]:
    """Return the times of the frames and what is wrong with them."""
    n = contents.shape[0]
    if dt is not None:
        if not (np.isfinite(dt) and dt > 0):
            return np.zeros(n), [f"dt: expected seconds > 0, got {dt!r}"]
        return np.arange(n, dtype=np.float64) * float(dt), []
    if contents.times is None:
        return np.zeros(n), [f"no times of its {n} frames: pass dt= in s"]
    if np.any(np.diff(contents.times) <= 0):
        late = int(np.flatnonzero(np.diff(contents.times) <= 0)[0]) + 1
        return np.zeros(n), [f"the times do not grow at frame {late}: pass dt= in s"]
    return contents.times, []


def _differences(
    contents: Contents, voxel: Floats, times: Floats, plane_time: float | None
) -> list[str]:
    """Say where the values in use are not the file's."""
    interval = float(np.median(np.diff(times))) if len(times) > 1 else np.nan
    other = contents.times
    file_interval = np.nan if other is None or len(times) < 2 else np.median(np.diff(other))
    pairs = {
        f"voxel {a}": pair
        for a, pair in zip("zyx", zip(voxel, contents.voxel, strict=True), strict=True)
    }
    pairs["dt"] = (interval, float(file_interval))
    if plane_time is not None and contents.plane_time is not None:
        pairs["plane_time"] = (plane_time, contents.plane_time)
    return [
        f"{name} {used:.6g} (in the file {there:.6g})"
        for name, (used, there) in pairs.items()
        if abs(used - there) > _TELL * abs(there)
    ]


def digest(stack: Stack) -> str:
    """Return the SHA-256 of what a stack is read from: its files with their names, or its frames.

    Examples
    --------
    >>> import numpy as np
    >>> still = np.zeros((1, 2, 8, 8), dtype=np.uint8)
    >>> digest(open_stack(still, voxel=(1, 1, 1)))[:12]
    '38723a2e5e8a'
    """
    total = hashlib.sha256()
    if stack.path is None:
        for frame in stack:
            total.update(np.ascontiguousarray(frame).tobytes())
        return total.hexdigest()
    if stack.path.is_file():
        with open(stack.path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    folder = stack.path.is_dir()
    inside = sorted(stack.path.rglob("*")) if folder else sequence_files(str(stack.path))
    for part in filter(Path.is_file, map(Path, inside)):
        total.update(part.relative_to(stack.path).as_posix().encode() if folder else b"")
        with open(part, "rb") as file:
            total.update(hashlib.file_digest(file, "sha256").digest())
    return total.hexdigest()


def write_stack(stack: Stack, path: _PathLike) -> None:
    """Write a stack as OME-TIFF with voxel size and times, which `open_stack` reads back exactly.

    Written frame by frame, beside its place and renamed, so that a half-written one never stands.

    Parameters
    ----------
    stack : Stack
        The movie; integers of 8 to 32 bits, or floats of 32 or 64.
    path : str or path
        Where to, ending in ``.ome.tif`` or ``.ome.tiff``.

    Raises
    ------
    ValueError
        For another suffix, or voxels that OME-TIFF has no type for.
    FrameError
        If a frame of the stack cannot be read; nothing is written then.
    ImportError
        If tifffile is not installed.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np
    >>> stack = open_stack(np.ones((3, 2, 8, 8), np.uint8), voxel=(0.3, 0.1, 0.1), dt=0.5)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_stack(stack, f"{folder}/movie.ome.tif")
    ...     with open_stack(f"{folder}/movie.ome.tif") as again:
    ...         again.times, again.voxel
    (array([0. , 0.5, 1. ]), array([0.3, 0.1, 0.1]))
    """
    target = Path(path)
    if not target.name.lower().endswith((".ome.tif", ".ome.tiff")):
        raise ValueError(f"{target}: a stack is written as .ome.tif")
    if stack.dtype.name not in _OME_TYPES:
        raise ValueError(f"{target}: OME-TIFF has no {stack.dtype}: expected one of {_OME_TYPES}")
    tifffile = needed("tifffile", "images")
    n_bytes = int(np.prod(stack.shape)) * stack.dtype.itemsize
    described: bytes | None = _ome_header(stack, tifffile)
    with (
        written_whole(target) as beside,
        tifffile.TiffWriter(beside, bigtiff=n_bytes > 2**31) as file,
    ):
        # Every plane with its own header before it: a file that is cut short keeps the rest.
        for plane in (plane for frame in stack for plane in frame):
            file.write(
                plane,
                description=described,
                photometric="minisblack",
                metadata=None,
                contiguous=False,
            )
            described = None


def _ome_header(stack: Stack, tifffile: Any) -> bytes:  # noqa: ANN401 (an untyped library)
    """Return axes, sizes and times in the words of OME."""
    header: dict[str, Any] = {"axes": "TZYX"}
    for axis, length in zip("ZYX", stack.voxel, strict=True):
        if np.isfinite(length):
            header |= {f"PhysicalSize{axis}": float(length), f"PhysicalSize{axis}Unit": "\u00b5m"}
    if len(stack) > 1:
        header |= {"TimeIncrement": stack.dt, "TimeIncrementUnit": "s"}
    delay = np.arange(stack.shape[1]) * (stack.plane_time or 0.0)
    clock = (stack.times[:, None] + delay).ravel()
    header["Plane"] = {"DeltaT": clock.tolist(), "DeltaTUnit": ["s"] * clock.size}
    xml = tifffile.OmeXml()
    t, z, y, x = stack.shape
    xml.addimage(stack.dtype, stack.shape, (t * z, 1, 1, y, x, 1), **header)
    return bytes(xml.tostring(declaration=True).encode())
