"""Folders and globs of TIFF files, whose names count times, planes and channels."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from perrin.images.formats.contents import Contents, Layout, Pick, chosen, even_times, grid, layout
from perrin.images.formats.tiff import is_set, ndtiff, opened, tiff

# Words before a number in the names that microscope programs write.
_COUNTERS = {
    **dict.fromkeys(("t", "time", "tp", "timepoint", "frame"), "T"),
    **dict.fromkeys(("z", "slice", "plane", "section"), "Z"),
    **dict.fromkeys(("c", "ch", "channel", "w", "wave"), "C"),
    **dict.fromkeys(("s", "series", "p", "pos", "position", "xy", "site", "scene"), "P"),
}


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


def name_counters(names: list[str]) -> list[dict[str, int | str]]:
    """Return what the numbers in file names count.

    Only numbers that differ between the names count. A word before a number, such as t, z, ch or
    Series, states what it counts; a single number without such a word counts times or planes.

    Parameters
    ----------
    names : list of str
        Names without folders and suffixes, more than one.

    Returns
    -------
    list of dict of str to int or str
        For each name its number along T, Z, C (channels), P (positions) or I (times or planes).

    Raises
    ------
    ValueError
        If names differ in more than their numbers, or several numbers differ and one of them has
        no word that states its meaning.

    Examples
    --------
    >>> name_counters(["a2_t00_ch00", "a2_t00_ch01"])
    [{'C': 0}, {'C': 1}]
    >>> name_counters(["scan9", "scan10"])
    [{'I': 9}, {'I': 10}]
    """
    micro_manager = [re.fullmatch(r"img_(\d{9})_(.+)_(\d{3})", name) for name in names]
    if all(micro_manager):
        parts = [match.groups() for match in micro_manager if match]
        return [{"T": int(t), "C": channel, "Z": int(z)} for t, channel, z in parts]
    # MetaMorph adds the name of the wavelength to its number.
    plain = [re.sub(r"_w(\d+)[^_]*", r"_w\1", name) for name in names]
    tokens = [re.split(r"(\d+)", name) for name in plain]
    if len({tuple(part[::2]) for part in tokens}) > 1:
        raise ValueError(
            f"has files whose names differ in more than numbers, as {names[0]!r} and "
            f"{names[-1]!r}: pass a glob of those of one movie"
        )
    varying = [k for k in range(1, len(tokens[0]), 2) if len({part[k] for part in tokens}) > 1]
    words = [re.split(r"[^A-Za-z]", tokens[0][k - 1].rstrip("-_ =."))[-1] for k in varying]
    axes = [_COUNTERS.get(word.lower(), "I") for word in words]
    if axes == ["P"] and len(words[0]) == 1:
        axes = ["I"]  # A lone p or s may count planes or slices.
    if len(axes) > 1 and ("I" in axes or len(set(axes)) < len(axes)):
        raise ValueError(
            f"has files in whose names {len(axes)} numbers vary, as {names[0]!r} and "
            f"{names[-1]!r}, and their meaning is not clear: name them t, z and ch, or pass a glob"
        )
    return [{axis: int(part[k]) for axis, k in zip(axes, varying, strict=True)} for part in tokens]


def sequence(path: str, pick: Pick) -> Contents:
    """Describe a folder or glob of TIFF files, by the numbers in their names.

    A file of several images is one frame; of files of one image each that their names do not
    call times or planes, `pick.planes` are a frame.
    """
    files = sequence_files(path)
    if not files:
        raise ValueError("is a folder without a .tif or .tiff file: no other images are read in it")
    # The files of a set have the header of the whole.
    if len(files) == 1 or is_set(files[0]):
        return tiff(files[0], pick)
    if all("NDTiffStack" in Path(file).name for file in files):
        return ndtiff([opened(file) for file in files], pick)
    counters = name_counters([Path(file).stem for file in files])
    # The distances of times or planes whose numbers are uneven would be wrong.
    for axis, word in (("T", "times"), ("Z", "planes")):
        numbers = np.unique([int(label[axis]) for label in counters if axis in label])
        steps = np.diff(numbers)
        if len(steps) and steps.min() < steps.max():
            late = int(np.argmax(steps > steps.min()))
            raise ValueError(
                f"has files whose {word} are numbered unevenly, with none between "
                f"{numbers[late]} and {numbers[late + 1]}: add the missing ones, or number them "
                "evenly if none is missing"
            )
    sizes, places = grid(counters)
    axes = list(sizes)
    position = {}
    if "P" in sizes:
        labels = [str(i) for i in range(sizes.pop("P"))]
        position = {"P": chosen(labels, pick.image)}
    inside = pick._replace(
        channel=None if "C" in sizes else pick.channel, image=None if position else pick.image
    )
    first = tiff(files[0], inside, one_frame=True)
    first.close()
    _, inner, y, x = first.shape
    where = _frames(sizes, inner, pick if "C" in sizes else pick._replace(channel=None))

    opener = _OneFileOpen(inside)

    def plane(t: int, z: int) -> NDArray[Any]:
        at = where.at(t, 0 if inner > 1 else z) | position
        name = files[places[tuple(at.get(axis, 0) for axis in axes)]]
        file = opener.opened(name)
        if file.shape != first.shape or file.dtype != first.dtype:
            raise ValueError(
                f"{name} is {file.shape[1:]} {file.dtype}, the first file "
                f"{first.shape[1:]} {first.dtype}"
            )
        return file.plane(0, z if inner > 1 else 0)

    return Contents(
        shape=(where.t, inner if inner > 1 else where.z, y, x),
        dtype=first.dtype,
        plane=plane,
        close=opener.close,
        voxel=first.voxel,
        times=even_times(where.t, np.nan),
    )


class _OneFileOpen:
    """The file of a sequence that was read last, kept open for the other planes that it has."""

    def __init__(self, pick: Pick) -> None:
        self._pick = pick
        self._name = ""
        self._contents: Contents | None = None

    def opened(self, name: str) -> Contents:
        """Return a file, and close the one before it."""
        if self._contents is None or name != self._name:
            self.close()
            self._name, self._contents = name, tiff(name, self._pick, one_frame=True)
        return self._contents

    def close(self) -> None:
        """Close the file."""
        if self._contents is not None:
            self._contents.close()
        self._contents = None


def _frames(sizes: dict[str, int], inner: int, pick: Pick) -> Layout:
    """Return the frames of files of `inner` images each, counted along the axes of `sizes`."""
    if inner == 1:
        return layout(sizes, pick)
    if pick.planes not in (None, inner):
        raise ValueError(f"has files of {inner} images each, not planes={pick.planes}")
    if "Z" in sizes:
        raise ValueError(f"has files of {inner} images each, which their names call planes")
    return layout(sizes, pick._replace(planes=1))
