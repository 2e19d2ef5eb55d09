"""The chain of image directories of a TIFF file, checked before any of its images is read."""

from __future__ import annotations

import os
import struct
from typing import TYPE_CHECKING, BinaryIO, NamedTuple

import numpy as np

from perrin.tracks.file_limits import refuse_oversize

if TYPE_CHECKING:
    from numpy.typing import NDArray

# Numbers of the tags that state sizes.
_WIDTH, _LENGTH, _BITS, _SAMPLES, _TILE_WIDTH, _TILE_LENGTH = 256, 257, 258, 277, 322, 323
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
    offset: str  # position in the file
    tag: np.dtype[np.void]


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
    with open(path, "rb") as file:
        kind, first = _kind_of(file.read(16))
        if kind is None:
            return
        width = struct.calcsize(f"{kind.order}{kind.tags}")
        last = struct.calcsize(f"{kind.order}{kind.offset}")
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
                size = n * kind.tag.itemsize + last
                data = file.read(size) if n <= _MOST_TAGS else b""
                if len(data) < size:
                    break
                (offset,) = struct.unpack(f"{kind.order}{kind.offset}", data[-last:])
                tags = np.frombuffer(data, kind.tag, count=n)
                chains += _check_tags(path, file, kind, tags, length)


def _kind_of(head: bytes) -> tuple[_Kind | None, int]:
    """Return how a file stores numbers, and the position of its first directory."""
    order = {b"II": "<", b"MM": ">"}.get(head[:2], "")
    version = struct.unpack(f"{order}H", head[2:4])[0] if order and len(head) == 16 else 0
    if version == 42:
        fields = [("code", "u2"), ("type", "u2"), ("count", "u4"), ("value", "u4")]
        kind = _Kind(order, "H", "I", np.dtype([(n, order + t) for n, t in fields]))
        return kind, struct.unpack(f"{order}I", head[4:8])[0]
    if version == 43:
        fields = [("code", "u2"), ("type", "u2"), ("count", "u8"), ("value", "u8")]
        kind = _Kind(order, "Q", "Q", np.dtype([(n, order + t) for n, t in fields]))
        return kind, struct.unpack(f"{order}Q", head[8:16])[0]
    return None, 0


def _check_tags(
    path: str, file: BinaryIO, kind: _Kind, tags: NDArray[np.void], length: int
) -> list[int]:
    """Check the sizes that a directory states; return the positions of those below it."""
    for tag in tags[tags["count"] > 8]:
        if int(tag["count"]) * _BYTES.get(int(tag["type"]), 1) > length:
            raise ValueError(
                f"its tag {tag['code']} of {tag['count']} values is longer than the file: the file "
                "is damaged"
            )
    small = {
        int(tag["code"]): _first_value(kind, tag) for tag in tags[np.isin(tags["code"], _SIZES)]
    }
    for height, width in ((_LENGTH, _WIDTH), (_TILE_LENGTH, _TILE_WIDTH)):
        shape = (small.get(height, 0), small.get(width, 0), small.get(_SAMPLES, 1))
        refuse_oversize(path, shape, max(small.get(_BITS, 8) // 8, 1), what="an image")
    below = tags[tags["code"] == _SUB_DIRECTORIES][:1]
    if not below.size:
        return []
    n = min(int(below["count"][0]), 64)
    if n == 1:
        return [int(below["value"][0])]
    width = _BYTES.get(int(below["type"][0]), 4)
    file.seek(min(int(below["value"][0]), length))
    data = file.read(n * width)
    return [
        int(v) for v in np.frombuffer(data[: len(data) // width * width], f"{kind.order}u{width}")
    ]


_SIZES = (_WIDTH, _LENGTH, _BITS, _SAMPLES, _TILE_WIDTH, _TILE_LENGTH)


def _first_value(kind: _Kind, tag: np.void) -> int:
    """Return the value in a tag that has one; 8 bits where several are stored elsewhere."""
    width = _BYTES.get(int(tag["type"]), 4)
    field = kind.tag["value"].itemsize
    if width > field or int(tag["count"]) * width > field:
        return 16 if tag["code"] == _BITS else 1
    data = np.asarray(tag["value"]).astype(f"{kind.order}u{field}").tobytes()
    return (
        int(np.frombuffer(data[:width], f"{kind.order}u{width}")[0]) if width in (1, 2, 4, 8) else 1
    )
