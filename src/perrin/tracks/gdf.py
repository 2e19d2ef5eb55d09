"""The .gdf format of IDL particle tracking: bytes to an array and back.

int32 words: the magic number 82991, the number of dimensions, the dimensions, a type code, the
number of elements; then the elements with the first dimension (columns) running fastest. The byte
order of the magic number is that of the file. The ASCII variant has the line ``GDF v. 1.0`` in
place of the magic number, and the same numbers as text.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from perrin.errors import table_error
from perrin.tracks.delimited import is_number

if TYPE_CHECKING:
    from perrin._arrays import Floats

_GDF_MAGIC = 82991

_ASCII_HEADER = b"GDF v. 1.0"

_GDF_TYPES = {1: "u1", 2: "i2", 3: "i4", 4: "f4", 5: "f8"}


def parse_gdf(data: bytes, source: str) -> Floats:
    """Return the table in the bytes of a .gdf file, shape (rows, columns), in either byte order.

    Raises
    ------
    TrackTableError
        If these are not the bytes of a whole .gdf file; `source` is its name.

    Examples
    --------
    >>> parse_gdf(gdf_bytes(np.array([[0.5, 1.5, 0.0, 7.0]])), "t.gdf")
    array([[0.5, 1.5, 0. , 7. ]])
    """
    if data.startswith(_ASCII_HEADER):
        return parse_ascii_gdf(data, source)
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


def parse_ascii_gdf(data: bytes, source: str) -> Floats:
    r"""Return the table in the bytes of an ASCII .gdf file, shape (rows, columns).

    Raises
    ------
    TrackTableError
        If a number cannot be read, or if there are more or fewer of them than the header states.

    Examples
    --------
    >>> parse_ascii_gdf(b"GDF v. 1.0\n 2\n 4 1 4 4\n 0.5 1.5 0.0 7.0\n", "t.gdf")
    array([[0.5, 1.5, 0. , 7. ]])
    """
    words = data[len(_ASCII_HEADER) :].split()
    try:
        n_dims = int(words[0])
        *size, _, count = (int(word) for word in words[1 : n_dims + 3])
    except (ValueError, IndexError):
        raise table_error(source, "cut short or damaged within its header") from None
    if n_dims not in (1, 2) or len(size) != n_dims or min(size) < 0:
        raise table_error(
            source, f"expected a .gdf with 2 dimensions (columns, rows), got {n_dims}"
        )
    n_columns, n_rows = (*size, 1)[:2]
    # Programs other than IDL write 0 for the number of elements.
    found, expected = words[n_dims + 3 :], n_columns * n_rows
    if count not in (0, expected) or len(found) != expected:
        raise table_error(
            source,
            f"the header states {n_rows} rows of {n_columns} columns and {count} elements, the "
            f"file has {len(found)} numbers; copy or write it again",
        )
    try:
        values = np.array(found, dtype=np.float64)
    except ValueError:
        # A number that is too long for its place is a row of asterisks.
        texts = [word.decode("ascii", "replace") for word in found]
        wrong, text = next(
            (i, text) for i, text in enumerate(texts) if "," in text or not is_number(text)
        )
        raise table_error(
            source,
            f"row {wrong // n_columns}, column {wrong % n_columns}: expected a number, got "
            f"{text!r}; write it again in binary, without /ascii",
        ) from None
    return values.reshape((n_rows, n_columns))


def gdf_bytes(values: Floats) -> bytes:
    """Return a table (rows, columns) as a little-endian .gdf file of float64 numbers.

    Examples
    --------
    >>> gdf_bytes(np.array([[0.5, 1.5]])).hex(" ", 4)[:35]
    '2f440100 02000000 02000000 01000000'
    """
    header = [_GDF_MAGIC, 2, values.shape[1], values.shape[0], 5, values.size]
    return np.array(header, dtype="<i4").tobytes() + values.astype("<f8").tobytes()
