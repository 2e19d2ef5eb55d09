"""Arrays in memory and in .npy, .npz and HDF5 files, which state no voxel size and no times."""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from perrin.images.formats.contents import Contents, Pick, chosen, even_times, needed
from perrin.tracks.file_limits import refuse_oversize


@dataclass(frozen=True, eq=False)
class ArrayFrames:
    """Frames of an array (t, z, y, x) of any library.

    Attributes
    ----------
    array : array_like
        The array.
    shape : tuple of int
        Number of frames, and voxels of a frame.
    n_axes : int
        Number of axes of the array.
    movie : bool
        An array of three axes is a movie (t, y, x), not one frame.

    Examples
    --------
    >>> ArrayFrames(np.zeros((5, 12, 16)), (5, 1, 12, 16), 3, True)(4).shape
    (1, 12, 16)
    """

    array: Any
    shape: tuple[int, int, int, int]
    n_axes: int
    movie: bool

    def __call__(self, i: int) -> NDArray[Any]:
        """Return frame i, shape (z, y, x)."""
        whole = self.n_axes == 3 and not self.movie
        return np.asarray(self.array[:] if whole else self.array[i]).reshape(self.shape[1:])

    def plane(self, t: int, z: int) -> NDArray[Any]:
        """Return plane z of frame t, shape (y, x)."""
        if self.n_axes == 4:
            return np.asarray(self.array[t, z])
        return np.asarray(self.array[t if self.movie else z])


def array_contents(given: Any, pick: Pick) -> tuple[Contents, ArrayFrames]:  # noqa: ANN401
    """Interpret an array as a movie (t, z, y, x), or (t, y, x) with planes=1, or one frame.

    Parameters
    ----------
    given : array_like
        An array of numpy or another library.
    pick : Pick
        The user's choices.

    Returns
    -------
    contents : Contents
    read : callable
        ``read(i)`` returns frame i.

    Raises
    ------
    ValueError
        For another number of axes, or choices that are for files.

    Examples
    --------
    >>> contents, read = array_contents(np.zeros((5, 12, 16)), Pick(planes=1))
    >>> contents.shape, read(4).shape
    ((5, 1, 12, 16), (1, 12, 16))
    """
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
    read = ArrayFrames(array, shape, n_axes, movie)
    contents = Contents(
        shape=shape,
        dtype=np.dtype(array.dtype),
        plane=read.plane,
        close=lambda: None,
        voxel=np.full(3, np.nan),
        times=even_times(shape[0], np.nan),
    )
    return contents, read


def numpy_file(path: str, pick: Pick) -> Contents:
    """Describe an array in a .npy file, read from the disk frame by frame, or one of a .npz file.

    Parameters
    ----------
    path : str
    pick : Pick
        The user's choices; the image is the name of an array in a .npz file.

    Returns
    -------
    Contents
    """
    with open(path, "rb") as file:
        if file.read(6) != b"\x93NUMPY" and not zipfile.is_zipfile(path):
            raise ValueError("has no array of numbers: write it again with np.save or np.savez")
    if path.lower().endswith(".npz"):
        with zipfile.ZipFile(path) as archive:
            for entry in archive.infolist():
                what = f"the array {entry.filename!r}"
                refuse_oversize(path, (entry.file_size,), 1, what=what)
        with np.load(path, allow_pickle=False) as arrays:
            number = chosen(list(arrays.files), pick.image)
            return array_contents(arrays[arrays.files[number]], pick._replace(image=None))[0]
    chosen(["array"], pick.image)
    return array_contents(
        np.load(path, mmap_mode="r", allow_pickle=False), pick._replace(image=None)
    )[0]


def hdf5(path: str, pick: Pick) -> Contents:
    """Describe an array (t, z, y, x) or (z, y, x) in an HDF5 file.

    Parameters
    ----------
    path : str
    pick : Pick
        The user's choices; the image is the name of one of several arrays.

    Returns
    -------
    Contents

    Raises
    ------
    ValueError
        If the file has no array of three or four axes, or none of several is chosen.
    """
    from dataclasses import replace

    file = needed("h5py", "ims").File(path, "r")
    names: list[str] = []
    try:
        file.visititems(
            lambda name, item: names.append(name) if getattr(item, "ndim", 0) in (3, 4) else None
        )
        if not names:
            raise ValueError("has no array (t, z, y, x) or (z, y, x)")
        array = file[names[chosen(names, pick.image)]]
        if getattr(array, "external", None) or getattr(array, "is_virtual", False):
            raise ValueError("has its array in other files: copy it into one, as with h5repack")
        contents, _ = array_contents(array, pick._replace(image=None))
    except Exception:
        file.close()
        raise
    return replace(contents, close=file.close)
