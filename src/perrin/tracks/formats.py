"""Track tables as bytes: csv, csv.gz, parquet and gdf, read and written without a check."""

from __future__ import annotations

import io
import zlib
from typing import TYPE_CHECKING

import numpy as np

from perrin.errors import table_error
from perrin.tracks.gdf import gdf_bytes, parse_gdf

if TYPE_CHECKING:
    import pandas as pd

SUFFIXES = (".csv", ".csv.gz", ".parquet", ".gdf")

LARGEST_EXACT = 2**53  # whole numbers up to this are exact as float64


def table_suffix(name: str) -> str:
    """Return the suffix of a file's name, which determines the format.

    Raises
    ------
    TrackTableError
        For a name with another ending; the four formats are listed.

    Examples
    --------
    >>> table_suffix("Tracks.CSV.GZ")
    '.csv.gz'
    """
    for suffix in SUFFIXES:
        if name.lower().endswith(suffix):
            return suffix
    raise table_error(
        name, f"unknown kind of file; expected a name ending in {', '.join(SUFFIXES)}"
    )


def parse_table(data: bytes, suffix: str, source: str) -> pd.DataFrame:
    r"""Return the table in the bytes of a file as it is; the columns of a .gdf are numbered.

    Parameters
    ----------
    data : bytes
    suffix : str
        One of `SUFFIXES`.
    source : str
        The file's name, for messages.

    Returns
    -------
    pandas.DataFrame
        The index counts data rows from 0; blank lines of a csv have no row, but are counted.

    Raises
    ------
    TrackTableError
        If the bytes are no table of that format.

    Examples
    --------
    >>> parse_table(b"x,y\n1,2\n", ".csv", "t.csv")
       x  y
    0  1  2
    """
    import pandas as pd

    if suffix == ".gdf":
        return pd.DataFrame(parse_gdf(data, source))
    if suffix == ".parquet":
        import pyarrow as pa
        import pyarrow.parquet as pq

        try:
            # Metadata of pandas could hide the frame column in the index.
            return pq.read_table(io.BytesIO(data)).to_pandas(ignore_metadata=True)
        except (pa.ArrowException, OSError) as error:
            reason = str(error).strip().splitlines()[0]
            raise table_error(source, f"not a parquet file that can be read ({reason})") from None
    if suffix == ".csv.gz":
        import gzip

        try:
            data = gzip.decompress(data)
        except (gzip.BadGzipFile, EOFError, zlib.error) as error:
            raise table_error(
                source, f"not a whole gzip file ({error}); fetch or write it again"
            ) from None
    return parse_csv(data, source)


def parse_csv(data: bytes, source: str) -> pd.DataFrame:
    r"""Return the table in the bytes of a csv file with one header line.

    Parameters
    ----------
    data : bytes
        Text in UTF-8, commas between the columns.
    source : str
        The file's name, for messages.

    Returns
    -------
    pandas.DataFrame
        The index counts data rows from 0; blank lines have no row, but are counted.

    Raises
    ------
    TrackTableError
        If these are not the bytes of such a file.

    Examples
    --------
    >>> parse_csv(b"x,y\n1,2\n\n3,4\n", "t.csv").index.tolist()
    [0, 2]
    """
    import pandas as pd

    _refuse_other_text(data, source)
    major, minor = (int(part) for part in pd.__version__.split(".")[:2])
    # From pandas 3.1 on floats always read back bit-identical, and the option is deprecated.
    exact = {} if (major, minor) >= (3, 1) else {"float_precision": "round_trip"}
    try:
        table = pd.read_csv(
            io.BytesIO(data),
            encoding="utf-8",
            **exact,
            low_memory=False,
            skip_blank_lines=False,
            skipinitialspace=True,
        )
    except (pd.errors.ParserError, pd.errors.EmptyDataError) as error:
        reason = str(error).strip().removeprefix("Error tokenizing data. C error: ")
        raise table_error(
            source, f"not a table with one header line and commas between the columns: {reason}"
        ) from None
    if not isinstance(table.index, pd.RangeIndex):
        raise table_error(source, "rows have more fields than the header (line 1) has names")
    table.columns = table.columns.astype(str).str.strip()
    empty = np.flatnonzero(table.isna().all(axis=1))
    lines = data.splitlines() if len(empty) else []
    return table.drop(index=[i for i in empty if not lines[i + 1].strip(b" \t,")])


def _refuse_other_text(data: bytes, source: str) -> None:
    """Raise for bytes that are no text in UTF-8, or whose first line is no header with commas."""
    if not data.strip():
        raise table_error(source, "the file is empty")
    try:
        data.decode("utf-8")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise table_error(
            source, f"not a text file in UTF-8 (line {line}); save it as csv in UTF-8"
        ) from None
    if b"\0" in data:
        raise table_error(source, "a binary file, not a csv; give it the suffix of its kind")
    header = data[:65536].decode("utf-8-sig", errors="replace").splitlines()[0]
    if header.strip() and all(_is_number(name) for name in header.split(",")):
        raise table_error(
            source,
            f"line 1 holds numbers ({header[:60]}) where the names of the columns are expected; "
            "add a header line such as frame,particle,x,y,z",
        )
    other = next((mark for mark in (";", "\t") if mark in header and "," not in header), None)
    if other:
        raise table_error(source, f"columns are separated by {other!r}; save it with commas")


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def table_bytes(table: pd.DataFrame, suffix: str, target: str) -> bytes:
    r"""Return a clean track table as the bytes of a file.

    Parameters
    ----------
    table : pandas.DataFrame
        As `check_tracks` returns it.
    suffix : str
        One of `SUFFIXES`.
    target : str
        The file's name, for messages.

    Returns
    -------
    bytes
        Equal tables give equal bytes.

    Raises
    ------
    TrackTableError
        If the format cannot hold the table.

    Examples
    --------
    >>> import pandas as pd
    >>> table_bytes(pd.DataFrame({"frame": [0], "x": [0.1]}), ".csv", "t.csv")
    b'frame,x\n0,0.1\n'
    """
    buffer = io.BytesIO()
    if suffix == ".parquet":
        table.to_parquet(buffer, engine="pyarrow", index=False)
        return buffer.getvalue()
    if suffix == ".gdf":
        faults = [
            f"a .gdf cannot hold the column {name}; drop it"
            for name in ("cluster", "time")
            if name in table
        ]
        if table["particle"].dtype.kind != "i":
            faults.append("a .gdf cannot hold text in particle; number the particles")
        elif max(table["particle"].abs().max(), table["frame"].abs().max()) > LARGEST_EXACT:
            faults.append("a .gdf of float64 cannot hold frames or ids beyond 2**53; renumber them")
        if faults:
            raise table_error(target, *(f"{fault}, or write .csv or .parquet" for fault in faults))
        names = [name for name in ("x", "y", "z", "frame", "particle") if name in table]
        return gdf_bytes(table[names].to_numpy(dtype=np.float64))
    text: str = table.to_csv(index=False, lineterminator="\n")
    if suffix == ".csv":
        return text.encode("utf-8")
    import gzip

    # Without time and name in the header, equal tables make equal files.
    with gzip.GzipFile("", "wb", compresslevel=6, fileobj=buffer, mtime=0) as packed:
        packed.write(text.encode("utf-8"))
    return buffer.getvalue()
