"""What a microscope file says of itself, before anything is asked of the user."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from math import prod
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from perrin._arrays import Floats


Plane: TypeAlias = Callable[[int, int], NDArray[Any]]


# Axes that may be times or planes: the letters by which tifffile says that it does not know.
UNNAMED = "IQ"


_UM = {
    **dict.fromkeys(("m", "meter", "metre"), 1e6),
    **dict.fromkeys(("cm", "centimeter", "centimetre"), 1e4),
    **dict.fromkeys(("mm", "millimeter", "millimetre"), 1e3),
    **dict.fromkeys(("um", "\u00b5m", "\u03bcm", "\\u00b5m", "micron", "microns"), 1.0),
    **dict.fromkeys(("micrometer", "micrometre"), 1.0),
    **dict.fromkeys(("nm", "nanometer", "nanometre"), 1e-3),
    "inch": 25400.0,
}


_SECONDS = {
    **dict.fromkeys(("h", "hour"), 3600.0),
    **dict.fromkeys(("min", "minute"), 60.0),
    **dict.fromkeys(("s", "sec", "second"), 1.0),
    **dict.fromkeys(("ms", "millisecond"), 1e-3),
    **dict.fromkeys(("us", "\u00b5s", "\u03bcs", "microsecond"), 1e-6),
    **dict.fromkeys(("ns", "nanosecond"), 1e-9),
}


class Pick(NamedTuple):
    """What the user chose among the things that a file holds; None where nothing was chosen."""

    channel: int | None = None
    planes: int | None = None
    image: int | str | None = None


@dataclass(frozen=True, eq=False)
class Contents:
    """A file as it describes itself.

    Attributes
    ----------
    shape : tuple of int
        (t, z, y, x).
    dtype : numpy.dtype
        Of the voxels.
    plane : callable
        ``plane(t, z)`` reads one image (y, x).
    close : callable
        Lets go of the file.
    voxel : ndarray, shape (3,)
        (z, y, x), um; NaN where the file does not say.
    times : ndarray, shape (t,), or None
        Seconds.
    plane_time : float or None
        Seconds from one plane to the next.
    notes : tuple of str
        How it was read where the file does not say.
    """

    shape: tuple[int, int, int, int]
    dtype: np.dtype[Any]
    plane: Plane
    close: Callable[[], object]
    voxel: Floats
    times: Floats | None = None
    plane_time: float | None = None
    notes: tuple[str, ...] = ()

    def frame(self, t: int) -> NDArray[Any]:
        """Return one frame (z, y, x), read plane by plane so that no second copy is made."""
        out = np.empty(self.shape[1:], dtype=self.dtype)
        for z in range(self.shape[1]):
            out[z] = self.plane(t, z)
        return out


class Layout(NamedTuple):
    """Where the plane z of frame t is among the axes of a file."""

    t: int
    z: int
    at: Callable[[int, int], dict[str, int]]


def layout(sizes: Mapping[str, int], pick: Pick, *, cut: bool = False) -> Layout:
    """Tell times, planes and channels among named axes; X and Y are the image and left alone.

    Of a file that was cut short (`cut`) and does not name its axes, the frame in which it ends
    counts, so that its loss is met.

    Raises
    ------
    ValueError
        If there are several channels and none is chosen, if an axis is neither time, plane nor
        channel, or if images could be times as well as planes.
    """
    size = {axis: n for axis, n in sizes.items() if n > 1 and axis not in "YX"}
    fixed = _channel({a: size.pop(a) for a in "CS" if a in size}, pick.channel)
    strange = {a: n for a, n in size.items() if a not in "TZ" + UNNAMED}
    if strange:
        raise ValueError(
            f"has axes that are neither time, plane nor channel: {strange}; save the part wanted "
            "as a file of its own"
        )
    if len(size) > 1 and set(size) - set("TZ"):
        raise ValueError(f"does not say which of its axes {size} are times and which planes")
    unnamed = not set(size) <= set("TZ")
    cut = cut and (unnamed or not size)
    if cut and not size and pick.planes is None:
        raise ValueError("is cut short: only its first image is left")
    if unnamed and pick.planes is None:
        n = prod(size.values())
        raise ValueError(
            f"does not say whether its {n} images are times or planes: pass planes=1 (a 2-D movie),"
            f" planes={n} (one stack) or the number of planes of one frame"
        )
    t, z = size.get("T", 1), size.get("Z", 1)
    if pick.planes is None or (not unnamed and pick.planes == z):
        return Layout(t, z, lambda i, k: {"T": i, "Z": k, **fixed})
    return _regrouped(size, pick.planes, fixed, cut=cut)


def _regrouped(size: dict[str, int], planes: int, fixed: dict[str, int], *, cut: bool) -> Layout:
    """Cut one run of images into frames of so many planes."""
    if len(size) > 1:
        raise ValueError(f"has {size['Z']} planes a frame, not planes={planes}")
    axis, n = next(iter(size.items()), ("T", 1))
    if cut and 1 <= planes <= n:
        return Layout(n // planes + 1, planes, lambda i, k: {axis: i * planes + k, **fixed})
    if planes < 1 or n % planes:
        cause = "is cut short: it has" if cut else "has"
        raise ValueError(f"{cause} {n} images, which do not make whole frames of planes={planes}")
    return Layout(n // planes, planes, lambda i, k: {axis: i * planes + k, **fixed})


def _channel(size: dict[str, int], channel: int | None) -> dict[str, int]:
    """Return the index of the chosen channel."""
    if len(size) > 1:
        raise ValueError("has channels of several colours each: save one channel as grey values")
    axis, n = next(iter(size.items()), ("C", 1))
    if channel is None and n > 1:
        raise ValueError(f"has {n} channels: pass channel=0 to {n - 1}")
    if channel is not None and not 0 <= channel < n:
        raise ValueError(f"has no channel {channel}: it has {n}, counted from 0")
    return {axis: channel or 0}


def chosen(names: list[str], image: int | str | None) -> int:
    """Return which image of a file is meant."""
    if image is None and len(names) == 1:
        return 0
    if isinstance(image, int) and 0 <= image < len(names):
        return image
    if isinstance(image, str) and names.count(image) == 1:
        return names.index(image)
    raise ValueError(f"has {len(names)} images {names}: pass image= (a name or a number from 0)")


def needed(module: str, extra: str) -> Any:  # noqa: ANN401 (any module)
    """Import the reader of a format.

    Raises
    ------
    ImportError
        If it is not installed, with the command that installs it.
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
    """Return a positive length in um; NaN where there is none or its unit is not a length."""
    return _in(value, unit, _UM)


def in_seconds(value: object, unit: str | None) -> float:
    """Return a positive time in seconds; NaN where there is none or its unit is not a time."""
    return _in(value, unit, _SECONDS)


def _in(value: object, unit: str | None, table: Mapping[str, float]) -> float:
    if value is None or unit is None:
        return np.nan
    word = unit.strip()
    # Case counts: "m" and "M" differ, but "Sec" and "Micron" are words.
    factor = table.get(word, table.get(word.lower(), np.nan) if len(word) > 2 else np.nan)
    number = abs(float(str(value))) * factor
    return number if np.isfinite(number) and number > 0 else np.nan


def even_times(n: int, dt: float) -> Floats | None:
    """Return n even times from 0; None for an unknown interval, unless one frame needs none."""
    if n == 1:
        return np.zeros(1)
    return np.arange(n, dtype=np.float64) * dt if np.isfinite(dt) else None
