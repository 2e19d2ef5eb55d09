"""The .gdf format of IDL particle tracking: bytes to an array and back.

int32 words: the magic number 82991, the number of dimensions, the dimensions, a type code, the
number of elements; then the elements with the first dimension (columns) running fastest. The byte
order of the magic number is that of the file.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from perrin.errors import table_error

if TYPE_CHECKING:
    from perrin._arrays import Floats

_GDF_MAGIC = 82991

_GDF_TYPES = {1: "u1", 2: "i2", 3: "i4", 4: "f4", 5: "f8"}


def parse_gdf(data: bytes, source: str) -> Floats:
    """Return the table in the bytes of a .gdf file, shape (rows, columns), in either byte order.

    Raises
    ------
    TrackTableError
        If these are not the bytes of a whole binary .gdf file; `source` is its name.

    Examples
    --------
    >>> parse_gdf(gdf_bytes(np.array([[0.5, 1.5, 0.0, 7.0]])), "t.gdf")
    array([[0.5, 1.5, 0. , 7. ]])
    """
    if data.startswith(b"GDF v. 1.0"):
        raise table_error(
            source, "the ASCII variant of GDF; write it again in binary, without /ascii"
        )
    orders = {_GDF_MAGIC.to_bytes(4, "little"): "<", _GDF_MAGIC.to_bytes(4, "big"): ">"}
    if data[:4] not in orders:
        raise table_error(
            source,
            f"not a .gdf file: it does not begin with the magic number {_GDF_MAGIC} in either "
            f"byte order, but with the bytes {data[:4].hex(' ') or '(none)'}",
        )
    order = orders[data[:4]]
    # As many words as the header of a table of two dimensions has.
    head = data[: min(24, len(data) // 4 * 4)]
    words = [int(word) for word in np.frombuffer(head, dtype=f"{order}i4")]
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
    if code not in _GDF_TYPES:
        kinds = ", ".join(f"{c} {np.dtype(t).name}" for c, t in _GDF_TYPES.items())
        faults.append(f"unknown type code {code} in the header; expected one of {kinds}")
    if min(n_columns, n_rows) < 0 or count != n_columns * n_rows:
        faults.append(
            f"the header contradicts itself: {n_columns} columns x {n_rows} rows, but "
            f"{count} elements"
        )
    if faults:
        raise table_error(source, *faults)
    dtype, offset = np.dtype(f"{order}{_GDF_TYPES[code]}"), 4 * (n_dims + 4)
    expected, found = n_rows * n_columns * dtype.itemsize, len(data) - offset
    if found != expected:
        what = "cut short" if found < expected else "too long"
        raise table_error(
            source,
            f"{what}: {n_rows} rows of {n_columns} columns ({dtype.name}) take {expected} bytes "
            f"after the header, the file has {found}; copy or write it again",
        )
    values = np.frombuffer(data, dtype=dtype, offset=offset).reshape((n_rows, n_columns))
    return values.astype(np.float64)


def gdf_bytes(values: Floats) -> bytes:
    """Return a table (rows, columns) as a little-endian .gdf file of float64 numbers.

    Examples
    --------
    >>> gdf_bytes(np.array([[0.5, 1.5]])).hex(" ", 4)[:35]
    '2f440100 02000000 02000000 01000000'
    """
    header = [_GDF_MAGIC, 2, values.shape[1], values.shape[0], 5, values.size]
    return np.array(header, dtype="<i4").tobytes() + values.astype("<f8").tobytes()
