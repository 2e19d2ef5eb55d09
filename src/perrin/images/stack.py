"""Image stacks of all formats: frames (z, y, x) with voxel size and times."""

from __future__ import annotations

import hashlib
import os
import threading
import warnings
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from perrin._arrays import Floats, frozen, number_fault
from perrin.errors import FrameError, PrecisionWarning
from perrin.images.formats.arrays import array_contents
from perrin.images.formats.contents import Contents, Pick, needed, strange_lengths, summed
from perrin.images.formats.folders import sequence, sequence_files
from perrin.images.formats.isolation import SWITCH, guarded
from perrin.images.formats.tiff import tiff
from perrin.images.formats.vendors import WAY_OUT, vendor
from perrin.images.optics.pixel_pattern import without_pattern
from perrin.tracks.file_limits import refuse_oversize
from perrin.tracks.writing import written_whole

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from typing import Self


_PathLike: TypeAlias = str | os.PathLike[str]

# Relative difference of the user's values from those of the file above which a warning is given.
_HEADER_TOLERANCE = 1e-3

_OME_TYPES = ("uint8", "int8", "uint16", "int16", "uint32", "int32", "float32", "float64")


@dataclass(frozen=True, eq=False)
class Stack:
    """A movie of image stacks, read frame by frame.

    A context manager: ``with open_stack(path) as stack`` closes the file at the end.

    Attributes
    ----------
    shape : tuple of int
        Number of frames, and voxels of a frame: (t, z, y, x); a 2-D movie has z = 1.
    dtype : numpy.dtype
        Type of the grey levels.
    voxel : ndarray, shape (3,)
        Voxel size (z, y, x), um; NaN for the z of a 2-D movie.
    times : ndarray, shape (t,)
        Time at which the first plane of each frame was recorded, s.
    plane_time : float or None
        Time from one plane to the next, s, negative where the last plane is recorded first; None
        where it is unknown.
    source : str
        Name of the file, folder or other source of the frames.
    read : callable
        ``read(i)`` returns frame i without the checks of `frame`.
    notes : tuple of str
        How the file was interpreted where it does not name its axes.
    stated : dict
        Values of voxel, dt and plane_time that the user stated.

    Examples
    --------
    >>> import numpy as np
    >>> stack = open_stack(np.zeros((3, 4, 8, 8), np.uint8), voxel=(0.3, 0.1, 0.1), dt=0.5)
    >>> len(stack), stack.dt, [frame.shape for frame in stack][0]
    (3, 0.5, (4, 8, 8))
    """

    shape: tuple[int, int, int, int]
    dtype: np.dtype[Any]
    voxel: Floats
    times: Floats
    plane_time: float | None
    source: str
    read: Callable[[int], NDArray[Any]]
    notes: tuple[str, ...] = ()
    stated: dict[str, Any] = field(default_factory=dict)

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
        """The file, folder or glob that is read; None for an address and a stack in memory."""
        if not isinstance(self.read, _FileFrames) or "://" in self.read.path:
            return None
        return Path(self.read.path)

    @property
    def choice(self) -> dict[str, int | str | list[int] | None]:
        """The user's choices: channel, planes, image; empty for a stack in memory."""
        if not isinstance(self.read, _FileFrames):
            return {}
        several = {"channel": list(self.read.several)} if self.read.several else {}
        return self.read.pick._asdict() | several

    @property
    def dt(self) -> float:
        """Median time between frames, s; NaN for a single frame."""
        return float(np.median(np.diff(self.times))) if len(self) > 1 else float("nan")

    def frame(self, i: int) -> NDArray[Any]:
        """Return frame i, shape (z, y, x).

        Raises
        ------
        FrameError
            If this frame cannot be read; other frames may be readable.
        OSError
            If the whole file cannot be opened, as on another machine.
        IndexError
            If there is no such frame.
        """
        if not 0 <= i < len(self):
            raise IndexError(f"{self.source}: no frame {i}: it has {len(self)}, counted from 0")
        try:
            data = self.read(int(i))
        except (MemoryError, _UnopenedError):
            raise
        # The decoders of damaged files raise errors of any class.
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

    def corrected(self, pattern: Floats | None) -> Stack:
        """Return the stack for fits, with the pattern (ny, nx) of the pixels subtracted.

        Clipped voxels are NaN then. Without a pattern it is the same stack.
        """
        if pattern is None:
            return self
        read = _CorrectedFrames(self.read, pattern)
        return replace(self, read=read, dtype=np.dtype(np.float64))

    def close(self) -> None:
        """Close the file."""
        if isinstance(self.read, _FileFrames):
            self.read.close()


@dataclass(frozen=True, eq=False)
class _CorrectedFrames:
    """Frames of a stack for fits: without clipped voxels and without the pattern of the pixels."""

    read: Callable[[int], NDArray[Any]]
    pattern: Floats

    def __call__(self, i: int) -> NDArray[Any]:
        return without_pattern(self.read(i), self.pattern)


class _UnopenedError(OSError):
    """A whole file cannot be opened, as on another machine; no frame is at fault."""


class _FileFrames:
    """Frames of an open file: one reader at a time; another process opens it again, once.

    To open a file takes a time that is proportional to its number of images (5 s for 48 000 of a
    TIFF file), and a worker unpickles the same frames with every piece of its work.
    """

    def __init__(
        self,
        path: str,
        pick: Pick,
        contents: Contents | None = None,
        several: tuple[int, ...] | None = None,
        *,
        name: str = "",
    ) -> None:
        self.path, self.pick, self.several, self._contents = path, pick, several, contents
        self.name = name or os.urandom(16).hex()
        self._lock = threading.Lock()

    @staticmethod
    @lru_cache(maxsize=8)
    def of_name(name: str, path: str, pick: Pick, several: tuple[int, ...] | None) -> _FileFrames:
        """Return the frames that are unpickled, the same ones in one process for one name."""
        return _FileFrames(path, pick, None, several, name=name)

    def __call__(self, i: int) -> NDArray[Any]:
        with self._lock:
            if self._contents is None:
                try:
                    self._contents = file_contents(self.path, self.pick, self.several)
                # The decoders of damaged files raise errors of any class.
                except Exception as fault:
                    raise _UnopenedError(f"{self.path} cannot be opened here: {fault}") from fault
            return self._contents.frame(i)

    def __reduce__(self) -> tuple[Callable[..., _FileFrames], tuple[Any, ...]]:
        return _FileFrames.of_name, (self.name, self.path, self.pick, self.several)

    def close(self) -> None:
        with self._lock:
            if self._contents is not None:
                self._contents.close()
            self._contents = None


def open_stack(
    path: _PathLike | ArrayLike,
    *,
    voxel: ArrayLike | None = None,
    dt: float | None = None,
    plane_time: float | None = None,
    planes: int | None = None,
    channel: int | Sequence[int] | None = None,
    image: int | str | None = None,
) -> Stack:
    """Open a movie of image stacks of any format; only its header is read.

    Voxel size and times come from the file or from the user, never from a default.

    Parameters
    ----------
    path : str, path or array_like
        TIFF, OME-TIFF, ImageJ hyperstack, a folder or glob of TIFF files (in the order of the
        numbers in their names); Leica ``.lif``, Nikon ``.nd2``, Zeiss ``.czi`` and ``.lsm``,
        Olympus ``.oib``, DeltaVision ``.dv``, Imaris ``.ims``, OME-Zarr (also an address that
        fsspec reads, such as ``s3://bucket/movie.zarr``), ``.npy``, ``.h5``; or an
        array (t, z, y, x) or (z, y, x), also of dask, zarr or a memory map.
    voxel : array_like, shape (3,) or (2,), optional
        Voxel size (z, y, x), um; (y, x) for a 2-D movie. Required where the file does not state
        it, and used where the file states another one.
    dt : float, optional
        Time between frames, s. Required where the file does not state it and there are several
        frames.
    plane_time : float, optional
        Time from one plane to the next, s; negative where the last plane is recorded first.
    planes : int, optional
        Number of planes of one frame, where the file does not distinguish times from planes; 1 for
        a 2-D movie.
    channel : int or sequence of int, optional
        Number of the channel, from 0; required where there are several. The grey levels of
        several channels are summed, as for clusters whose spheres differ in colour; their times
        are those of the first.
    image : int or str, optional
        Number or name of the image in a file that holds several.

    Returns
    -------
    Stack
        Frames are read one by one, when they are used. It can be sent to another process, where it
        opens the file again.

    Raises
    ------
    ValueError
        If the file cannot be read, or a value that it does not state is not given; all faults in
        one message.
    ImportError
        If the reader of this format is not installed, with the command that installs it.
    FileNotFoundError
        If there is no file at `path`.

    Warns
    -----
    PrecisionWarning
        Where a value given differs from the file's by more than 0.1 %, or a voxel is not between
        1 nm and 20 um long.

    Examples
    --------
    >>> import numpy as np
    >>> movie = np.zeros((5, 8, 32, 32), dtype=np.uint8)
    >>> stack = open_stack(movie, voxel=(0.25, 0.2, 0.2), dt=0.7)
    >>> stack.shape, stack.frame(4).shape
    ((5, 8, 32, 32), (8, 32, 32))
    """
    size = None if voxel is None else np.atleast_1d(np.asarray(voxel, dtype=np.float64))
    given = {"voxel": None if size is None else size.tolist(), "dt": dt, "plane_time": plane_time}
    if size is not None and size.shape == (2,) and planes is None:
        planes = 1
    one, several = _channels(channel)
    pick = Pick(channel=one, planes=planes, image=image)
    if isinstance(path, (str, os.PathLike)):
        source = os.fspath(path)
        contents = _described(source, pick, several)
        place = source if "://" in source else os.path.abspath(source)
        read: Callable[[int], NDArray[Any]] = _FileFrames(place, pick, contents, several)
    else:
        source = "array"
        if several:
            raise ValueError("array: channel is for files; pass the sum of the channels")
        contents, read = array_contents(path, pick)
    try:
        settled, faults = contents.settled_voxel(size)
        times, more = contents.settled_times(dt)
        faults += more
        if plane_time is None:
            plane_time = contents.plane_time
        else:
            faults += number_fault("plane_time", plane_time, unit="s")
        faults += contents.doubts(settled, times, plane_time, given=size is not None)
        if faults:
            raise ValueError(f"{source}: " + "; ".join(faults))
        unequal = contents.differences(settled, times, plane_time, tolerance=_HEADER_TOLERANCE)
        if strange := strange_lengths(settled):
            unequal.append(f"the voxel size, {strange}; it is in um")
        if unequal:
            warnings.warn(
                f"{source}: the values given are used: " + "; ".join(unequal),
                PrecisionWarning,
                stacklevel=2,
            )
    except Exception:
        contents.close()
        raise
    return Stack(
        shape=contents.shape,
        dtype=contents.dtype,
        voxel=settled,
        times=times,
        plane_time=plane_time,
        source=source,
        read=read,
        notes=contents.notes,
        stated={name: value for name, value in given.items() if value is not None},
    )


def _described(source: str, pick: Pick, several: tuple[int, ...] | None) -> Contents:
    """Return the contents of a file; every fault names the file and what to do."""
    try:
        return file_contents(source, pick, several)
    except (FileNotFoundError, PermissionError, IsADirectoryError):
        raise
    except ImportError as missing:
        raise ImportError(f"{source}: {missing}") from missing
    # The decoders of damaged files raise errors of any class.
    except Exception as fault:
        reason = str(fault)
        if type(fault) is not ValueError:
            reason = f"cannot be read ({type(fault).__name__}: {fault}): {WAY_OUT}"
        raise ValueError(f"{source}: {reason}") from fault


def _channels(given: Any) -> tuple[int | None, tuple[int, ...] | None]:  # noqa: ANN401
    """Return the one channel that was chosen, or the several that are summed."""
    if given is None or np.ndim(given) == 0:
        return given, None
    numbers = tuple(given)
    whole = all(isinstance(n, (int, np.integer)) and not isinstance(n, bool) for n in numbers)
    if not numbers or not whole or len(set(numbers)) < len(numbers):
        raise ValueError(f"channel: expected different numbers from 0, got {given!r}")
    return None, tuple(map(int, numbers))


def file_contents(source: str, pick: Pick, several: tuple[int, ...] | None = None) -> Contents:
    """Return the contents of a file or folder, read by the reader of its format.

    Parameters
    ----------
    source : str
        Path of a file or folder, or a glob. The suffix decides among the vendors' formats; all
        other files are read as TIFF.
    pick : Pick
        The user's choices.
    several : tuple of int, optional
        Channels that are summed, instead of the channel of `pick`.

    Returns
    -------
    Contents

    Raises
    ------
    ValueError
        If the file is of a format that is not read, or does not have what was chosen.
    """
    if several:
        parts: list[Contents] = []
        try:
            for number in several:
                parts.append(file_contents(source, pick._replace(channel=number)))
            return summed(parts)
        except Exception:
            for part in parts:
                part.close()
            raise
    found = vendor(source)
    if found is not None:
        apart = found.apart and os.environ.get(SWITCH) != "off"
        try:
            contents = (guarded if apart else found.read)(source, pick)
        except ValueError as fault:
            # A library's own error keeps its class, so that the caller adds what to do.
            if type(fault) is not ValueError:
                raise
            raise ValueError(f"{found.name}: {fault}") from fault
    elif Path(source).is_dir() or (not Path(source).exists() and sequence_files(source)):
        contents = sequence(source, pick)
    else:
        contents = tiff(source, pick)
    try:
        refuse_oversize(source, contents.shape[1:], contents.dtype.itemsize, what="a frame")
        refuse_oversize(source, contents.shape[:1], 8, what="a series of frames")
    except ValueError:
        contents.close()
        raise
    return contents


def file_states(stack: Stack) -> list[tuple[str, int, int]]:
    """Return name, length and time of the last change of all files of a stack.

    Parameters
    ----------
    stack : Stack

    Returns
    -------
    list of tuple
        Empty for a stack in memory.

    Examples
    --------
    >>> import numpy as np
    >>> file_states(open_stack(np.zeros((1, 2, 8, 8)), voxel=(1, 1, 1)))
    []
    """
    states = []
    for path in _files_of(stack):
        about = path.stat()
        states.append((str(path), about.st_size, about.st_mtime_ns))
    return states


def _files_of(stack: Stack) -> list[Path]:
    """Return the files of a stack in the order of their names; none for a stack in memory."""
    if stack.path is None:
        return []
    if stack.path.is_file():
        return [stack.path]
    folder = stack.path.is_dir()
    inside = sorted(stack.path.rglob("*")) if folder else sequence_files(str(stack.path))
    return list(filter(Path.is_file, map(Path, inside)))


def digest(stack: Stack) -> str:
    """Return the SHA-256 of a stack: of its files with their names, or of its frames in memory.

    Of a movie in an object store it is that of the names, sizes and marks (ETag) of its objects,
    which are not read.

    Parameters
    ----------
    stack : Stack

    Returns
    -------
    str
        Hexadecimal digits.

    Examples
    --------
    >>> import numpy as np
    >>> still = np.zeros((1, 2, 8, 8), dtype=np.uint8)
    >>> digest(open_stack(still, voxel=(1, 1, 1)))[:12]
    '38723a2e5e8a'
    """
    total = hashlib.sha256()
    if stack.path is None and "://" in stack.source:
        from fsspec.core import url_to_fs

        system, root = url_to_fs(stack.source)
        for name, state in sorted(system.find(root, detail=True).items()):
            mark = state.get("ETag", state.get("etag", state.get("mtime")))
            total.update(f"{name.removeprefix(root)} {state['size']} {mark}\n".encode())
        return total.hexdigest()
    if stack.path is None:
        for frame in stack:
            total.update(np.ascontiguousarray(frame).tobytes())
        return total.hexdigest()
    if stack.path.is_file():
        with open(stack.path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    folder = stack.path.is_dir()
    for part in _files_of(stack):
        total.update(part.relative_to(stack.path).as_posix().encode() if folder else b"")
        with open(part, "rb") as file:
            total.update(hashlib.file_digest(file, "sha256").digest())
    return total.hexdigest()


def write_stack(stack: Stack, path: _PathLike) -> None:
    """Write a stack as an OME-TIFF file with voxel size and times.

    `open_stack` reads grey levels, voxel size and times back exactly. The frames are read and
    written one by one, so that a movie need not fit into memory. They are written to a temporary
    file in the same folder, which is renamed when it is complete: an incomplete file never appears
    at `path`, and an existing file is replaced only by a complete one. The OME header comes first
    and every plane follows its own header, so that a copy of the file that was cut short can still
    be opened, with its complete frames.

    Parameters
    ----------
    stack : Stack
        The movie; its grey levels are integers of 8, 16 or 32 bits or floats of 32 or 64 bits. A
        voxel size of NaN along z (a 2-D movie) is not written.
    path : str or path
        The file to write; its name ends in ``.ome.tif`` or ``.ome.tiff``. Files of more than 2 GB
        are written as BigTIFF.

    Raises
    ------
    ValueError
        For another suffix, or grey levels of a type that OME-TIFF does not have.
    FrameError
        If a frame of the stack cannot be read; no file is written then.
    OSError
        If the file cannot be written, as on a full disk.
    ImportError
        If tifffile is not installed.

    See Also
    --------
    open_stack : Read the file.
    render_stack : Make a movie of spheres whose positions are known.

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
    # Axes, sizes and times in the terms of OME.
    header: dict[str, Any] = {"axes": "TZYX"}
    for axis, length in zip("ZYX", stack.voxel, strict=True):
        if np.isfinite(length):
            header |= {f"PhysicalSize{axis}": float(length), f"PhysicalSize{axis}Unit": "\u00b5m"}
    if len(stack) > 1:
        header |= {"TimeIncrement": stack.dt, "TimeIncrementUnit": "s"}
    delay = np.arange(stack.shape[1]) * (stack.plane_time or 0.0)
    clock = (stack.times[:, None] + delay).ravel()
    header["Plane"] = {"DeltaT": clock.tolist(), "DeltaTUnit": ["s"] * clock.size}
    t, z, y, x = stack.shape
    xml = tifffile.OmeXml()
    xml.addimage(stack.dtype, stack.shape, (t * z, 1, 1, y, x, 1), **header)
    description: bytes | None = bytes(xml.tostring(declaration=True).encode())
    n_bytes = t * z * y * x * stack.dtype.itemsize
    with (
        written_whole(target) as part,
        tifffile.TiffWriter(part, bigtiff=n_bytes > 2**31) as file,
    ):
        for plane in (plane for frame in stack for plane in frame):
            file.write(
                plane,
                description=description,
                photometric="minisblack",
                metadata=None,
                contiguous=False,
            )
            description = None
