"""The .gdf format of IDL particle tracking: bytes to an array and back.

int32 words: the magic number 82991, the number of dimensions, the dimensions, a type code, the
number of elements; then the elements with the first dimension (columns) running fastest. The byte
order of the magic number is that of the file.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from perrin.errors import table_error

if TYPE_CHECKING:
    from perrin._arrays import Floats

_MAGIC = 82991


_TYPES = {1: "u1", 2: "i2", 3: "i4", 4: "f4", 5: "f8"}


def parse_gdf(data: bytes, source: str) -> Floats:
    """Return the table in the bytes of a .gdf file, shape (rows, columns), in either byte order.

    Raises
    ------
    TrackTableError
        If these are not the bytes of a whole binary .gdf file; `source` is its name.
    """
    if data.startswith(b"GDF v. 1.0"):
        raise table_error(
            source, "the ASCII variant of GDF; write it again in binary, without /ascii"
        )
    shape, dtype, offset = _header(data, source)
    expected, found = math.prod(shape) * dtype.itemsize, len(data) - offset
    if found != expected:
        what = "cut short" if found < expected else "too long"
        raise table_error(
            source,
            f"{what}: {shape[0]} rows of {shape[1]} columns ({dtype.name}) take {expected} bytes "
            f"after the header, the file has {found}; copy or write it again",
        )
    values = np.frombuffer(data, dtype=dtype, offset=offset).reshape(shape)
    return values.astype(np.float64)


def _header(data: bytes, source: str) -> tuple[tuple[int, int], np.dtype[Any], int]:
    """Return (rows, columns), the type of the numbers, and where they begin."""
    words = _words(data, source)
    n_dims = words[1] if len(words) > 1 else 0
    if len(words) > 1 and n_dims not in (1, 2):
        raise table_error(
            source, f"expected a .gdf with 2 dimensions (columns, rows), got {n_dims}"
        )
    if len(words) < n_dims + 4:
        raise table_error(source, f"cut short within its header: it has {len(data)} bytes")
    # IDL drops a last dimension of 1: a table of one row has one dimension.
    n_columns, n_rows = (*words[2 : 2 + n_dims], 1)[:2]
    code, count = words[2 + n_dims : 4 + n_dims]
    faults = []
    if code not in _TYPES:
        kinds = ", ".join(f"{c} {np.dtype(t).name}" for c, t in _TYPES.items())
        faults.append(f"unknown type code {code} in the header; expected one of {kinds}")
    if min(n_columns, n_rows) < 0 or count != n_columns * n_rows:
        faults.append(
            f"the header contradicts itself: {n_columns} columns x {n_rows} rows, but "
            f"{count} elements"
        )
    if faults:
        raise table_error(source, *faults)
    order = _byte_order(data)
    return (n_rows, n_columns), np.dtype(f"{order}{_TYPES[code]}"), 4 * (n_dims + 4)


def _byte_order(data: bytes) -> str:
    """Return "<" or ">" by the magic number, "" without it."""
    orders = {_MAGIC.to_bytes(4, "little"): "<", _MAGIC.to_bytes(4, "big"): ">"}
    return orders.get(data[:4], "")


def _words(data: bytes, source: str) -> list[int]:
    """Return the first words of the file, as many as a header of two dimensions has."""
    order = _byte_order(data)
    if not order:
        raise table_error(
            source,
            f"not a .gdf file: it does not begin with the magic number {_MAGIC} in either "
            f"byte order, but with the bytes {data[:4].hex(' ') or '(none)'}",
        )
    head = data[: min(24, len(data) // 4 * 4)]
    return [int(word) for word in np.frombuffer(head, dtype=f"{order}i4")]


def gdf_bytes(values: Floats) -> bytes:
    """Return a table (rows, columns) as a little-endian .gdf file of float64 numbers."""
    header = [_MAGIC, 2, values.shape[1], values.shape[0], 5, values.size]
    return np.array(header, dtype="<i4").tobytes() + values.astype("<f8").tobytes()
