"""The chain of image directories of a TIFF file, checked before any of its images is read."""

from __future__ import annotations

import math
import os
import struct
from typing import BinaryIO, NamedTuple

from perrin.tracks.file_limits import allowed_memory, refuse_oversize

# Numbers of the tags that state sizes.
_WIDTH, _LENGTH, _BITS, _SAMPLES, _TILE_WIDTH, _TILE_LENGTH = 256, 257, 258, 277, 322, 323
_SIZES = frozenset((_WIDTH, _LENGTH, _BITS, _SAMPLES, _TILE_WIDTH, _TILE_LENGTH))
_SUB_DIRECTORIES = 330

# Bytes of a value by the number of its type.
_BYTES = {
    **dict.fromkeys((1, 2, 6, 7), 1), **dict.fromkeys((3, 8), 2),
    **dict.fromkeys((4, 9, 11, 13), 4),
    **dict.fromkeys((5, 10, 12, 16, 17, 18), 8),
}  # fmt: skip
_MOST_TAGS = 4096


class _Kind(NamedTuple):
    """How a TIFF file stores numbers: classic or BigTIFF, in either order of bytes."""

    order: str
    tags: str  # number of the tags of a directory
    offset: str  # position in the file, and what a tag holds
    tag: struct.Struct


class _Tag(NamedTuple):
    """One entry of a directory."""

    code: int
    type: int
    number: int
    value: bytes  # or the position of the values, where they need more bytes

    @property
    def width(self) -> int:
        """Bytes of one value."""
        return _BYTES.get(self.type, 4)

    def one_value(self, order: str) -> int:
        """Return the value of a tag that has one, else 1; of the bits of several channels, 16."""
        if self.width * self.number > len(self.value):
            return 16 if self.code == _BITS else 1
        return int.from_bytes(self.value[: self.width], "big" if order == ">" else "little")


def check_directories(path: str) -> None:
    """Refuse a TIFF file whose directories loop, or state sizes that its length does not warrant.

    A file that is cut passes: its images are read up to the end.

    Parameters
    ----------
    path : str

    Raises
    ------
    ValueError
    """
    length = os.path.getsize(path)
    most = allowed_memory(length)
    with open(path, "rb") as file:
        kind, first = _kind_of(file.read(16))
        if kind is None:
            return
        width, last = (struct.calcsize(f"={code}") for code in (kind.tags, kind.offset))
        seen: set[int] = set()
        chains = [first]
        while chains:
            offset = chains.pop()
            while 0 < offset < length:
                if offset in seen:
                    raise ValueError(
                        f"its chain of images returns to an earlier one (byte {offset}): the file "
                        "is damaged"
                    )
                seen.add(offset)
                file.seek(offset)
                (n,) = struct.unpack(
                    f"{kind.order}{kind.tags}", file.read(width).ljust(width, b"\0")
                )
                size = n * kind.tag.size + last
                data = file.read(size) if n <= _MOST_TAGS else b""
                if len(data) < size:
                    break
                (offset,) = struct.unpack(f"{kind.order}{kind.offset}", data[-last:])
                tags = [_Tag(*entry) for entry in kind.tag.iter_unpack(data[:-last])]
                _check_sizes(path, tags, kind, length, most)
                chains += _below(file, tags, kind, length)


def _kind_of(head: bytes) -> tuple[_Kind | None, int]:
    """Return how a file stores numbers, and the position of its first directory."""
    order = {b"II": "<", b"MM": ">"}.get(head[:2], "")
    version = struct.unpack(f"{order}H", head[2:4])[0] if order and len(head) == 16 else 0
    if version == 42:
        kind = _Kind(order, "H", "I", struct.Struct(f"{order}HHI4s"))
        return kind, struct.unpack(f"{order}I", head[4:8])[0]
    if version == 43:
        kind = _Kind(order, "Q", "Q", struct.Struct(f"{order}HHQ8s"))
        return kind, struct.unpack(f"{order}Q", head[8:16])[0]
    return None, 0


def _check_sizes(path: str, tags: list[_Tag], kind: _Kind, length: int, most: int) -> None:
    """Refuse tags that are longer than the file, and images that need more than `most` bytes."""
    small = {}
    for tag in tags:
        if tag.number > 8 and tag.number * tag.width > length:
            raise ValueError(
                f"its tag {tag.code} of {tag.number} values is longer than the file: the file is "
                "damaged"
            )
        if tag.code in _SIZES:
            small[tag.code] = tag.one_value(kind.order)
    for height, width in ((_LENGTH, _WIDTH), (_TILE_LENGTH, _TILE_WIDTH)):
        shape = (small.get(height, 0), small.get(width, 0), small.get(_SAMPLES, 1))
        itemsize = max(small.get(_BITS, 8) // 8, 1)
        if math.prod(shape) * itemsize > most:
            refuse_oversize(path, shape, itemsize, what="an image")


def _below(file: BinaryIO, tags: list[_Tag], kind: _Kind, length: int) -> list[int]:
    """Return the positions of the directories below one directory."""
    for tag in tags:
        if tag.code != _SUB_DIRECTORIES:
            continue
        n = min(tag.number, 64)
        if n == 1:
            return [struct.unpack(f"{kind.order}{kind.offset}", tag.value)[0]]
        file.seek(min(struct.unpack(f"{kind.order}{kind.offset}", tag.value)[0], length))
        data = file.read(n * tag.width)
        code = {1: "B", 2: "H", 4: "I", 8: "Q"}[tag.width]
        whole = data[: len(data) // tag.width * tag.width]
        return [place for (place,) in struct.iter_unpack(f"{kind.order}{code}", whole)]
    return []
