"""Track tables as bytes: which format a file has, how it is read, and how tables are written."""

from __future__ import annotations

import io
import json
import re
import zlib
from typing import TYPE_CHECKING

import numpy as np

from perrin.errors import table_error
from perrin.tracks.cells import guarded_table
from perrin.tracks.delimited import first_lines, parse_text, utf8_text
from perrin.tracks.file_limits import allowed_memory, oversize_text, refuse_large_archive
from perrin.tracks.gdf import gdf_bytes, parse_gdf
from perrin.tracks.imaris import imaris_table, is_imaris
from perrin.tracks.motion_capture import is_motive, motive_table, parse_c3d
from perrin.tracks.raw_tables import RawTable
from perrin.tracks.simulations import parse_gsd
from perrin.tracks.track_arrays import gdf_table, napari_columns, napari_text
from perrin.tracks.trackmate import is_trackmate, parse_trackmate_xml, trackmate_table
from perrin.tracks.xyz import parse_xyz, xyz_text

if TYPE_CHECKING:
    from collections.abc import Callable

    import pandas as pd

# Endings of names of files that can be written; ".napari.csv" before ".csv".
SUFFIXES = (".napari.csv", ".csv", ".csv.gz", ".parquet", ".gdf", ".xyz")

_TEXT_SUFFIXES = (".csv", ".tsv", ".txt", ".dat")

_SHEET_SUFFIXES = (".xlsx", ".xls", ".ods")

# Endings of names of files that can be read; a text file may be packed as .gz.
READABLE_SUFFIXES = (
    *_TEXT_SUFFIXES, ".csv.gz", ".parquet", ".gdf", ".xml", ".xyz", ".extxyz", *_SHEET_SUFFIXES,
    ".c3d", ".gsd",
)  # fmt: skip

LARGEST_EXACT = 2**53  # whole numbers up to this are exact as float64


def table_suffix(name: str, *, written: bool = False) -> str:
    """Return the suffix of a file's name, which determines the format.

    Parameters
    ----------
    name : str
    written : bool
        Whether the file is to be written; not all formats can be.

    Returns
    -------
    str
        In small letters, with ".gz" where the name has it.

    Raises
    ------
    TrackTableError
        For a name with another ending; the formats are listed.

    Examples
    --------
    >>> table_suffix("Tracks.CSV.GZ"), table_suffix("tracks.xyz", written=True)
    ('.csv.gz', '.xyz')
    """
    offered = SUFFIXES if written else READABLE_SUFFIXES
    packed = () if written else tuple(f"{s}.gz" for s in (*_TEXT_SUFFIXES, ".xml", ".xyz"))
    suffixes: tuple[str, ...] = (*packed, *offered)
    for suffix in suffixes:
        if name.lower().endswith(suffix):
            return suffix
    raise table_error(name, f"unknown kind of file; expected a name ending in {', '.join(offered)}")


def parse_table(data: bytes, suffix: str, source: str) -> RawTable:
    r"""Return the table in the bytes of a file as it is, and what its format states about it.

    Parameters
    ----------
    data : bytes
    suffix : str
        As `table_suffix` returns it. A text file is recognised by its content: a csv may be a table
        of TrackMate, Imaris or Motive.
    source : str
        The file's name, for messages.

    Returns
    -------
    RawTable

    Raises
    ------
    TrackTableError
        If the bytes are no table of that format.
    ImportError
        If the format needs a package that is not installed.

    Examples
    --------
    >>> parse_table(b"x,y\n1,2\n", ".csv", "t.csv").table
       x  y
    0  1  2
    """
    if suffix.endswith(".gz"):
        data = unpacked(data, source)
        suffix = suffix.removesuffix(".gz")
    if suffix in (".xyz", ".extxyz"):
        return parse_xyz(utf8_text(data, source).decode(), source)
    if suffix in _SHEET_SUFFIXES:
        text, note = sheet_text(data, source)
        raw = text_table(text.encode(), source)
        return RawTable(
            raw.table, raw.kind, raw.columns, raw.units, (note, *raw.notes), raw.unnamed, "row", 2
        )
    parsers: dict[str, Callable[[bytes, str], RawTable]] = {
        ".gdf": lambda data, source: gdf_table(parse_gdf(data, source)),
        ".parquet": parse_parquet,
        ".xml": parse_trackmate_xml,
        ".c3d": parse_c3d,
        ".gsd": parse_gsd,
    }
    if suffix in parsers:
        return parsers[suffix](data, source)
    return text_table(utf8_text(data, source), source)


def unpacked(data: bytes, source: str) -> bytes:
    """Return the content of a gzip file, which must not be larger than its length warrants.

    Parameters
    ----------
    data : bytes
    source : str
        The file's name, for messages.

    Returns
    -------
    bytes

    Raises
    ------
    TrackTableError
        If this is no whole gzip file, or its content is too large (`allowed_memory`).

    Examples
    --------
    >>> import gzip
    >>> unpacked(gzip.compress(b"x,y"), "t.csv.gz")
    b'x,y'
    """
    import gzip

    if not data:
        raise table_error(source, "the file is empty")
    most = allowed_memory(len(data))
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(data)) as file:
            content = file.read(most + 1)
    except (gzip.BadGzipFile, EOFError, zlib.error) as error:
        raise table_error(
            source, f"not a whole gzip file ({error}); fetch or write it again"
        ) from None
    if len(content) > most:
        raise table_error(source, oversize_text("the unpacked table", len(content)))
    return content


def text_table(text: bytes, source: str) -> RawTable:
    r"""Return the table of a text, recognised by its first lines.

    Parameters
    ----------
    text : bytes
        UTF-8.
    source : str
        The file's name, for messages.

    Returns
    -------
    RawTable

    Raises
    ------
    TrackTableError
        If the text is no table.

    Examples
    --------
    >>> text_table(b"track_id,t,z,y,x\n7,0,1,2,3\n", "t.csv").kind
    'a table of tracks as napari takes them'
    """
    lines = first_lines(text)
    for recognised, parse in (
        (is_motive, motive_table),
        (is_imaris, imaris_table),
        (is_trackmate, trackmate_table),
    ):
        if recognised(lines):
            return parse(text, source)
    raw = parse_text(text, source)
    columns = napari_columns(raw.table.columns)
    if not columns:
        return raw
    kind = "a table of tracks as napari takes them"
    return RawTable(raw.table, kind, columns, notes=raw.notes, word=raw.word, first=raw.first)


def sheet_text(data: bytes, source: str) -> tuple[str, str]:
    """Return a sheet of a spreadsheet as csv, and a sentence on which; needs python-calamine.

    Parameters
    ----------
    data : bytes
        File of .xlsx, .xls or .ods.
    source : str
        The file's name, for messages.

    Returns
    -------
    text : str
        The sheet Position, which Imaris writes, or the first one that is not empty.
    note : str

    Raises
    ------
    TrackTableError
        If this is no spreadsheet, or an empty one.
    ImportError
        If the package is not installed.
    """
    import csv

    try:
        from python_calamine import CalamineError, CalamineWorkbook
    except ImportError:
        raise ImportError(
            f"{source}: spreadsheets need python-calamine: pip install 'perrin[tables]'; or save "
            "the sheet as csv"
        ) from None

    refuse_large_archive(data, source)
    try:
        book = CalamineWorkbook.from_filelike(io.BytesIO(data))
        sheets = {
            name: book.get_sheet_by_name(name).to_python(skip_empty_area=False)
            for name in book.sheet_names
        }
    except CalamineError as error:
        raise table_error(source, f"not a spreadsheet that can be read ({error})") from None
    full = [name for name, rows in sheets.items() if any(any(c != "" for c in r) for r in rows)]
    if not full:
        raise table_error(source, "the file is empty")
    chosen = "Position" if "Position" in full else full[0]
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(
        [" ".join(cell.split()) if isinstance(cell, str) else cell for cell in row]
        for row in sheets[chosen]
    )
    others = [name for name in full if name != chosen]
    note = f"read from the sheet {chosen!r}"
    if others:
        note += f", not from {', '.join(map(repr, others))}"
    return text.getvalue(), note


def parse_parquet(data: bytes, source: str) -> RawTable:
    """Return the table in the bytes of a Parquet file.

    Raises
    ------
    TrackTableError
        If these are not the bytes of such a file, or its table does not fit into memory; `source`
        is its name.

    Examples
    --------
    >>> import pandas as pd
    >>> data = table_bytes(pd.DataFrame({"x": [0.5]}), ".parquet", "t.parquet")
    >>> parse_parquet(data, "t.parquet").table["x"].tolist()
    [0.5]
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        file = pq.ParquetFile(io.BytesIO(data))
        needed = 8 * file.metadata.num_rows * file.metadata.num_columns
        if not 0 <= needed <= allowed_memory(len(data)):
            raise table_error(source, oversize_text("its table", needed))
        # Metadata of pandas could hide the frame column in the index.
        table = file.read().to_pandas(ignore_metadata=True)
        attributes = json.loads((file.schema_arrow.metadata or {}).get(b"PANDAS_ATTRS", b"{}"))
    except (pa.ArrowException, OSError, ValueError) as error:
        reason = str(error).strip().splitlines()[0]
        raise table_error(source, f"not a parquet file that can be read ({reason})") from None
    labels = attributes.get("labels") if isinstance(attributes, dict) else None
    if isinstance(labels, dict):  # texts of the clusters that `assign_clusters` has numbered
        table.attrs["labels"] = {k: v for k, v in labels.items() if re.fullmatch("[0-9]+", k)}
    return RawTable(table)


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
    faults = _faults_of_writing(table, suffix)
    if faults:
        raise table_error(target, *(f"{fault}, or write .csv or .parquet" for fault in faults))
    if suffix == ".gdf":
        names = [name for name in ("x", "y", "z", "frame", "particle") if name in table]
        return gdf_bytes(table[names].to_numpy(dtype=np.float64))
    if suffix == ".xyz":
        return xyz_text(table).encode("utf-8")
    if suffix == ".napari.csv":
        return napari_text(table).encode("utf-8")
    text: str = guarded_table(table).to_csv(index=False, lineterminator="\n")
    if suffix == ".csv":
        return text.encode("utf-8")
    import gzip

    # Without time and name in the header, equal tables make equal files.
    with gzip.GzipFile("", "wb", compresslevel=6, fileobj=buffer, mtime=0) as packed:
        packed.write(text.encode("utf-8"))
    return buffer.getvalue()


def _faults_of_writing(table: pd.DataFrame, suffix: str) -> list[str]:
    """Return what a format cannot hold of a table."""
    faults = []
    if suffix in (".gdf", ".napari.csv"):
        faults += [
            f"a {suffix} cannot hold the column {name}; drop it"
            for name in ("cluster", "time")
            if name in table
        ]
        if table["particle"].dtype.kind != "i":
            faults.append(f"a {suffix} cannot hold text in particle; number the particles")
    if suffix == ".gdf" and table["particle"].dtype.kind == "i":
        largest = max(table["particle"].abs().max(), table["frame"].abs().max())
        if largest > LARGEST_EXACT:
            faults.append("a .gdf of float64 cannot hold frames or ids beyond 2**53; renumber them")
    if suffix == ".xyz":
        faults += [
            f"a .xyz cannot hold blanks in {name} ({label!r}); replace them"
            for name in ("particle", "cluster")
            if name in table and table[name].dtype.kind not in "i"
            for label in [str(v) for v in table[name].unique() if len(str(v).split()) != 1][:1]
        ]
    return faults
