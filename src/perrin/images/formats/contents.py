"""Contents of a microscope file: shape, axes, voxel size and times, from the file and the user."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from math import prod
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from perrin._arrays import number_fault

if TYPE_CHECKING:
    from perrin._arrays import Floats


Plane: TypeAlias = Callable[[int, int], NDArray[Any]]

# Letters by which tifffile marks axes of unknown meaning: times or planes.
UNNAMED = "IQ"

_UM_PER_UNIT = {
    **dict.fromkeys(("m", "meter", "metre"), 1e6),
    **dict.fromkeys(("cm", "centimeter", "centimetre"), 1e4),
    **dict.fromkeys(("mm", "millimeter", "millimetre"), 1e3),
    **dict.fromkeys(("um", "\u00b5m", "\u03bcm", "\\u00b5m", "micron", "microns"), 1.0),
    **dict.fromkeys(("micrometer", "micrometre"), 1.0),
    **dict.fromkeys(("nm", "nanometer", "nanometre"), 1e-3),
    **dict.fromkeys(("\u00e5", "\u212b", "\u00c5", "angstrom"), 1e-4),
    "inch": 25400.0,
}

_SECONDS_PER_UNIT = {
    **dict.fromkeys(("h", "hr", "hour", "hours"), 3600.0),
    **dict.fromkeys(("min", "minute", "minutes"), 60.0),
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), 1.0),
    **dict.fromkeys(("ms", "msec", "millisecond", "milliseconds"), 1e-3),
    **dict.fromkeys(("us", "\u00b5s", "\u03bcs", "\\u00b5s", "usec", "microsecond"), 1e-6),
    **dict.fromkeys(("ns", "nanosecond"), 1e-9),
}


# Shortest and longest voxel of a light microscope, um.
_VOXEL_LIMITS = (1e-3, 20.0)


class Pick(NamedTuple):
    """The user's choices among the contents of a file.

    Attributes
    ----------
    channel : int or None
        Number of the channel, from 0; `open_stack` sums several one by one.
    planes : int or None
        Number of planes of a frame, where the file does not distinguish times from planes.
    image : int or str or None
        Number or name of the image in a file that holds several.

    Examples
    --------
    >>> Pick(planes=4)
    Pick(channel=None, planes=4, image=None)
    """

    channel: int | None = None
    planes: int | None = None
    image: int | str | None = None


@dataclass(frozen=True, eq=False)
class Contents:
    """Contents of a file, as its header describes them.

    Attributes
    ----------
    shape : tuple of int
        Number of frames, and voxels of a frame: (t, z, y, x).
    dtype : numpy.dtype
        Type of the grey levels.
    plane : callable
        ``plane(t, z)`` reads one image (y, x).
    close : callable
        Closes the file.
    voxel : ndarray, shape (3,)
        Voxel size (z, y, x), um; NaN where the file does not state it.
    times : ndarray, shape (t,), or None
        Times of the frames, s; None where the file does not state them.
    plane_time : float or None
        Time from one plane to the next, s; None where the file does not state it.
    notes : tuple of str
        How the file was interpreted where it does not name its axes.
    without_times : str
        Why the times in the file cannot be used; empty where they can, or there are none.
    """

    shape: tuple[int, int, int, int]
    dtype: np.dtype[Any]
    plane: Plane
    close: Callable[[], object]
    voxel: Floats
    times: Floats | None = None
    plane_time: float | None = None
    notes: tuple[str, ...] = ()
    without_times: str = ""

    def frame(self, t: int) -> NDArray[Any]:
        """Return one frame (z, y, x), read plane by plane so that no second copy is made."""
        out = np.empty(self.shape[1:], dtype=self.dtype)
        for z in range(self.shape[1]):
            out[z] = self.plane(t, z)
        return out

    def settled_voxel(self, given: Floats | None) -> tuple[Floats, list[str]]:
        """Return the voxel size of the user or of the file, and the faults of it.

        Parameters
        ----------
        given : ndarray, shape (3,) or (2,), or None
            The user's voxel size (z, y, x), or (y, x) for a 2-D movie, um.

        Returns
        -------
        voxel : ndarray, shape (3,)
            Voxel size (z, y, x), um.
        faults : list of str
            Empty, or one line.
        """
        flat = self.shape[1] == 1
        size = self.voxel.copy()
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
            # ImageJ calls the images of a movie slices by default.
            movie = f", or (y, x) if its {self.shape[1]} images are times"
            hint = movie if self.shape[0] == 1 and not flat else ""
            return size, [f"no voxel size along {', '.join(bad)}: pass voxel={wanted} in um{hint}"]
        return size, []

    def settled_times(self, dt: float | None) -> tuple[Floats, list[str]]:
        """Return the times of the frames from the user's interval or the file, and the faults.

        Parameters
        ----------
        dt : float or None
            The user's time between frames, s.

        Returns
        -------
        times : ndarray, shape (t,)
            Times of the frames, s.
        faults : list of str
            Empty, or one line.
        """
        n = self.shape[0]
        if dt is not None:
            faults = number_fault("dt", dt, above=0, unit="s")
            if faults:
                return np.zeros(n), faults
            return np.arange(n, dtype=np.float64) * float(dt), []
        if self.times is None:
            reason = f" ({self.without_times})" if self.without_times else ""
            return np.zeros(n), [f"no times of its {n} frames{reason}: pass dt= in s"]
        if np.any(np.diff(self.times) <= 0):
            late = int(np.flatnonzero(np.diff(self.times) <= 0)[0]) + 1
            return np.zeros(n), [f"the times do not grow at frame {late}: pass dt= in s"]
        return self.times, []

    def doubts(
        self, voxel: Floats, times: Floats, plane_time: float | None, *, given: bool
    ) -> list[str]:
        """Return a line for each value that cannot be right.

        Parameters
        ----------
        voxel, times, plane_time
            The values in use.
        given : bool
            The user gave the voxel size, which is not doubted then.

        Returns
        -------
        list of str
            Voxels of the file that are not between 1 nm and 20 um long, and planes that together
            take longer than the frame of which they are parts.

        Examples
        --------
        >>> still = Contents((2, 5, 8, 8), np.dtype("u1"), lambda t, z: 0, lambda: 0, np.ones(3))
        >>> still.doubts(np.ones(3), np.array([0.0, 0.7]), 0.2, given=True)
        ['5 planes of 0.2 s each take longer than a frame of 0.7 s: pass dt= or plane_time= in s']
        """
        faults = []
        if not given and (strange := strange_lengths(voxel)):
            faults.append(f"the voxel size in the file, {strange}: pass voxel= in um")
        planes = self.shape[1]
        if len(times) > 1 and plane_time is not None:
            interval = float(np.median(np.diff(times)))
            if (planes - 1) * abs(plane_time) > interval > 0:
                faults.append(
                    f"{planes} planes of {abs(plane_time):.4g} s each take longer than a frame of "
                    f"{interval:.4g} s: pass dt= or plane_time= in s"
                )
        return faults

    def differences(
        self, voxel: Floats, times: Floats, plane_time: float | None, *, tolerance: float
    ) -> list[str]:
        """Return a line for each value in use that differs from the file's.

        Parameters
        ----------
        voxel, times, plane_time
            The values in use.
        tolerance : float
            Largest relative difference that is not listed.

        Returns
        -------
        list of str
        """
        interval = float(np.median(np.diff(times))) if len(times) > 1 else np.nan
        file_interval = np.nan
        if self.times is not None and len(times) > 1:
            file_interval = float(np.median(np.diff(self.times)))
        pairs = {
            f"voxel {axis}": (float(used), float(there))
            for axis, used, there in zip("zyx", voxel, self.voxel, strict=True)
        }
        pairs["dt"] = (interval, file_interval)
        if plane_time is not None and self.plane_time is not None:
            pairs["plane_time"] = (plane_time, self.plane_time)
        return [
            f"{name} {used:.6g} (in the file {there:.6g})"
            for name, (used, there) in pairs.items()
            if abs(used - there) > tolerance * abs(there)
        ]


class Layout(NamedTuple):
    """The images of a file as planes of frames.

    Attributes
    ----------
    t, z : int
        Number of frames, and of planes of a frame.
    at : callable
        ``at(t, z)`` returns the index of plane z of frame t along every axis of the file.
    """

    t: int
    z: int
    at: Callable[[int, int], dict[str, int]]


def layout(sizes: Mapping[str, int], pick: Pick, *, cut: bool = False) -> Layout:
    """Assign times, planes and channels to named axes; X and Y are those of the images.

    Parameters
    ----------
    sizes : mapping of str to int
        Size of the file along each axis.
    pick : Pick
        The user's choices.
    cut : bool
        The file was cut short. If it does not name its axes, the incomplete frame at its end is
        counted, so that reading it raises an error.

    Returns
    -------
    Layout

    Raises
    ------
    ValueError
        If there are several channels and none is chosen, if an axis is neither time, plane nor
        channel, or if images could be times as well as planes.

    Examples
    --------
    >>> where = layout({"T": 5, "Z": 4, "Y": 12, "X": 16}, Pick())
    >>> where.t, where.z, where.at(3, 1)
    (5, 4, {'T': 3, 'Z': 1, 'C': 0})
    >>> where = layout({"I": 20, "Y": 12, "X": 16}, Pick(planes=4))
    >>> where.t, where.z, where.at(3, 1)
    (5, 4, {'I': 13, 'C': 0})
    """
    size = {axis: n for axis, n in sizes.items() if n > 1 and axis not in "YX"}
    fixed = channel_index({a: size.pop(a) for a in "CS" if a in size}, pick.channel)
    strange = {a: n for a, n in size.items() if a not in "TZ" + UNNAMED}
    if strange:
        raise ValueError(
            f"has axes that are neither time, plane nor channel: {strange}; save the part wanted "
            "as a file of its own"
        )
    if len(size) > 1 and set(size) - set("TZ"):
        raise ValueError(f"does not state which of its axes {size} are times and which planes")
    unnamed = not set(size) <= set("TZ")
    cut = cut and (unnamed or not size)
    if cut and not size and pick.planes is None:
        raise ValueError("is cut short: only its first image is left")
    if unnamed and pick.planes is None:
        n = prod(size.values())
        raise ValueError(
            f"does not state whether its {n} images are times or planes: pass planes=1 (a 2-D "
            f"movie), planes={n} (one stack) or the number of planes of one frame"
        )
    t, z = size.get("T", 1), size.get("Z", 1)
    if pick.planes is None or (not unnamed and pick.planes == z):
        return Layout(t, z, lambda i, k: {"T": i, "Z": k, **fixed})
    return frames_of_planes(size, pick.planes, fixed, cut=cut)


def frames_of_planes(
    size: dict[str, int], planes: int, fixed: dict[str, int], *, cut: bool
) -> Layout:
    """Divide a sequence of images into frames of equally many planes.

    Parameters
    ----------
    size : dict of str to int
        Size of the file along the axes of the sequence.
    planes : int
        Number of planes of a frame.
    fixed : dict of str to int
        Index along the axis of the channels.
    cut : bool
        The file was cut short; the incomplete frame at its end is counted.

    Returns
    -------
    Layout

    Raises
    ------
    ValueError
        If the images do not make whole frames.

    Examples
    --------
    >>> where = frames_of_planes({"I": 20}, 4, {}, cut=False)
    >>> where.t, where.at(3, 1)
    (5, {'I': 13})
    """
    if len(size) > 1:
        raise ValueError(f"has {size['Z']} planes a frame, not planes={planes}")
    axis, n = next(iter(size.items()), ("T", 1))
    if cut and 1 <= planes <= n:
        return Layout(n // planes + 1, planes, lambda i, k: {axis: i * planes + k, **fixed})
    if planes < 1 or n % planes:
        cause = "is cut short: it has" if cut else "has"
        raise ValueError(f"{cause} {n} images, which do not make whole frames of planes={planes}")
    return Layout(n // planes, planes, lambda i, k: {axis: i * planes + k, **fixed})


def channel_index(size: dict[str, int], channel: int | None) -> dict[str, int]:
    """Return the index of the chosen channel, by the name of its axis.

    Parameters
    ----------
    size : dict of str to int
        Size along the axes of channels and colours.
    channel : int or None
        Number of the chosen channel, from 0.

    Returns
    -------
    dict of str to int

    Raises
    ------
    ValueError
        If the channel does not exist, or none of several is chosen.

    Examples
    --------
    >>> channel_index({"C": 2}, 1), channel_index({}, None)
    ({'C': 1}, {'C': 0})
    """
    if len(size) > 1:
        raise ValueError("has channels of several colours each: save one channel as grey values")
    axis, n = next(iter(size.items()), ("C", 1))
    if channel is None and n > 1:
        raise ValueError(f"has {n} channels: pass channel=0 to {n - 1}")
    if channel is not None and not 0 <= channel < n:
        raise ValueError(f"has no channel {channel}: it has {n}, counted from 0")
    return {axis: channel or 0}


def chosen(names: list[str], image: int | str | None) -> int:
    """Return the number of the image that the user chose, by number or name.

    Raises
    ------
    ValueError
        If there is no such image, or none of several is chosen.

    Examples
    --------
    >>> chosen(["overview", "stack"], "stack"), chosen(["overview", "stack"], 0)
    (1, 0)
    """
    if image is None and len(names) == 1:
        return 0
    if isinstance(image, int) and 0 <= image < len(names):
        return image
    if isinstance(image, str) and names.count(image) == 1:
        return names.index(image)
    missing = "" if image is None else f"no image {image!r} among "
    if len(names) == 1:
        raise ValueError(f"has {missing}its only image {names[0]!r}: leave image= out")
    raise ValueError(
        f"has {missing}{len(names)} images {names}: pass image= (a name or a number from 0)"
    )


def grid(
    labels: Sequence[Mapping[str, Any]],
) -> tuple[dict[str, int], dict[tuple[int, ...], int]]:
    """Arrange images by the labels that each of them has, as time 3, plane 0, channel "red".

    Parameters
    ----------
    labels : sequence of mapping of str to object
        Label of each image along every axis; the same axes for all images.

    Returns
    -------
    sizes : dict of str to int
        Number of different labels along each axis.
    places : dict of tuple of int to int
        Number of the image at each place of the grid, in the order of the sorted labels.

    Raises
    ------
    ValueError
        If images have the same labels, or places of the grid have no image.

    Examples
    --------
    >>> grid([{"T": 1, "Z": 5}, {"T": 1, "Z": 4}])
    ({'T': 1, 'Z': 2}, {(0, 1): 0, (0, 0): 1})
    """
    axes = list(labels[0])
    values = {axis: sorted({label[axis] for label in labels}) for axis in axes}
    sizes = {axis: len(values[axis]) for axis in axes}
    rank = {axis: {v: i for i, v in enumerate(values[axis])} for axis in axes}
    places: dict[tuple[int, ...], int] = {}
    for number, label in enumerate(labels):
        place = tuple(rank[axis][label[axis]] for axis in axes)
        if place in places:
            raise ValueError(f"has several images of the same {dict(label)}")
        places[place] = number
    for place in np.ndindex(*sizes.values()):
        if place not in places:
            missing = {axis: values[axis][i] for axis, i in zip(axes, place, strict=True)}
            raise ValueError(f"lacks the image {missing} of its {sizes}")
    return sizes, places


def strange_lengths(voxel: Floats) -> str:
    """Return which lengths of a voxel no light microscope has; empty if there are none.

    Parameters
    ----------
    voxel : ndarray, shape (3,)
        Voxel size (z, y, x), um.

    Returns
    -------
    str

    Examples
    --------
    >>> strange_lengths(np.array([250.0, 0.2, 0.2]))
    'z = 250 um, is not between 1 nm and 20 um'
    """
    low, high = _VOXEL_LIMITS
    strange = [
        f"{axis} = {length:.3g} um"
        for axis, length in zip("zyx", voxel, strict=True)
        if np.isfinite(length) and not low <= length <= high
    ]
    return f"{', '.join(strange)}, is not between 1 nm and 20 um" if strange else ""


def summed(parts: Sequence[Contents]) -> Contents:
    """Return the sum of several channels, in a type of number that holds it.

    Parameters
    ----------
    parts : sequence of Contents
        The channels, of equal shape; sizes and times are those of the first.

    Returns
    -------
    Contents

    Raises
    ------
    ValueError
        If the channels have different shapes.

    Examples
    --------
    >>> one = Contents(
    ...     (1, 1, 1, 2), np.dtype("u1"), lambda t, z: np.full((1, 2), 200, "u1"), lambda: 0,
    ...     np.ones(3),
    ... )
    >>> both = summed([one, one])
    >>> both.plane(0, 0), both.dtype
    (array([[400, 400]], dtype=uint16), dtype('uint16'))
    """
    first = parts[0]
    shapes = sorted({part.shape for part in parts})
    if len(shapes) > 1:
        raise ValueError(f"has channels of different shapes: {shapes}")
    dtype = first.dtype.newbyteorder("=")
    if dtype.kind in "ui":
        dtype = np.dtype(f"{dtype.kind}{min(2 * dtype.itemsize, 8)}")

    def plane(t: int, z: int) -> NDArray[Any]:
        total = parts[0].plane(t, z).astype(dtype)
        for part in parts[1:]:
            total += part.plane(t, z).astype(dtype)
        return total

    def close() -> None:
        for part in parts:
            part.close()

    return replace(first, dtype=dtype, plane=plane, close=close)


def needed(module: str, extra: str) -> Any:  # noqa: ANN401 (any module)
    """Import the reader of a format.

    Raises
    ------
    ImportError
        If it is not installed, with the command that installs it.

    Examples
    --------
    >>> needed("numpy", "images").__name__
    'numpy'
    """
    try:
        return import_module(module)
    except ImportError as missing:
        name = module.split(".")[0]
        raise ImportError(
            f"this format is read with {name}, which is not installed: "
            f"pip install 'perrin[{extra}]'"
        ) from missing


def in_um(value: object, unit: str | None) -> float:
    """Return a positive length in um; NaN where there is none or its unit is not a length.

    Examples
    --------
    >>> in_um(250, "nm"), in_um("2e-7", "m"), in_um(1.0, "pixel")
    (0.25, 0.19999999999999998, nan)
    """
    return _converted(value, unit, _UM_PER_UNIT)


def in_seconds(value: object, unit: str | None) -> float:
    """Return a positive time in seconds; NaN where there is none or its unit is not a time.

    Examples
    --------
    >>> in_seconds(730, "ms"), in_seconds(2, "min"), in_seconds(None, "s")
    (0.73, 120.0, nan)
    """
    return _converted(value, unit, _SECONDS_PER_UNIT)


def _converted(value: object, unit: str | None, table: Mapping[str, float]) -> float:
    """Return a positive number in the unit of the table; NaN where there is none."""
    if value is None or unit is None:
        return np.nan
    word = unit.strip()
    # Case counts: "m" and "M" differ, but "Sec" and "Micron" are words.
    factor = table.get(word, table.get(word.lower(), np.nan) if len(word) > 2 else np.nan)
    number = abs(float(str(value))) * factor
    return number if np.isfinite(number) and number > 0 else np.nan


def even_times(n: int, dt: float) -> Floats | None:
    """Return n even times from 0; None for an unknown interval, unless one frame needs none.

    Examples
    --------
    >>> even_times(3, 0.5), even_times(3, np.nan), even_times(1, np.nan)
    (array([0. , 0.5, 1. ]), None, array([0.]))
    """
    if n == 1:
        return np.zeros(1)
    return np.arange(n, dtype=np.float64) * dt if np.isfinite(dt) else None
