"""Track tables in and out: the only room that knows the columns and units of tables."""

from __future__ import annotations

import gzip
import io
import os
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from perrin._text import listed
from perrin.errors import table_error
from perrin.tracks.column_names import COLUMNS, Spelling, recognise_columns, seconds, unit_faults
from perrin.tracks.gdf import gdf_bytes, parse_gdf
from perrin.tracks.writing import written_whole

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    import pandas as pd
    from numpy.typing import ArrayLike, NDArray

    from perrin._arrays import Bools, Floats, Ints


_REQUIRED = ("frame", "particle", "x", "y")


_AXES = ("x", "y", "z")


SUFFIXES = (".csv", ".csv.gz", ".parquet", ".gdf")


_LARGEST_EXACT = 2**53


_GDF_COLUMNS = {
    4: ("x", "y", "frame", "particle"),
    5: ("x", "y", "z", "frame", "particle"),
}


_GDF_EXAMPLE = 'columns={"x": 0, "y": 1, "z": 2, "frame": -2, "particle": -1}'


_PathLike: TypeAlias = str | os.PathLike[str]


def read_tracks(
    path: _PathLike,
    *,
    scale: ArrayLike = 1.0,
    columns: Mapping[str, str | int] | None = None,
) -> pd.DataFrame:
    r"""Read particle tracks from a file into one checked table in micrometres.

    Parameters
    ----------
    path : str or path
        A file ending in ``.csv``, ``.csv.gz``, ``.parquet`` or ``.gdf`` (IDL, either byte order).
        A ``.gdf`` of 4 columns holds x, y, frame, particle, one of 5 columns x, y, z, frame,
        particle; any other needs `columns`.
    scale : float or one float per axis
        Micrometres per unit of the file: the pixel size, or (x, y, z) voxel sizes.
    columns : mapping, optional
        Which column of the file is which of ours (``frame``, ``particle``, ``x``, ``y``, ``z``,
        ``cluster``, ``time``), by its name in the file or by its number from 0 (from the end where
        negative): ``{"x": "POS_X"}`` or ``{"x": 0, "y": 1, "frame": -2, "particle": -1}``.
        Columns that already bear our names need no entry, nor do those that differ in case, blanks
        or a unit only (``Frame``, ``Particle ID``, ``x (um)``, ``Y_um``); see the notes.

    Returns
    -------
    pandas.DataFrame
        ``frame`` (int64), ``particle`` (int64 or text), ``x``, ``y`` and, where given, ``z``
        (float64, um), ``cluster`` and ``time`` (s) as in `check_tracks`. Other columns of the
        file are left out. ``attrs["columns"]`` holds all of the file's column
        names; ``attrs["notes"]``, where there are any, is a list of texts that state
        which columns were recognised under another spelling.

    Raises
    ------
    TrackTableError
        If the file cannot be read as a track table; the message lists every fault found.
    ValueError
        If `scale` is not one positive number, or one per axis.
    OSError
        If the file is missing or may not be read.

    Notes
    -----
    A column with exactly our name is always taken. Otherwise a column is taken that has our name
    but for case, blanks, underscores and a unit at its end; where two columns could be the same one
    of ours, the table is refused. A unit of length in the name of a column must agree with `scale`:
    nm needs 0.001, px needs the size of a pixel, and um needs 1; the table is refused where they
    contradict each other, since one of the two is wrong. Columns that `columns` gives by number are
    taken without regard to their names. A unit of time in the name of the column ``time`` converts
    it to s, as no argument can contradict it.

    Examples
    --------
    >>> import tempfile
    >>> from perrin.tracks.files import read_tracks
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "tracks.csv"
    ...     _ = path.write_text("frame,particle,x,y\n0,7,10,20\n1,7,11,21\n")
    ...     read_tracks(path, scale=0.1)
       frame  particle    x    y
    0      0         7  1.0  2.0
    1      1         7  1.1  2.1
    """
    source = os.fspath(path)
    suffix = _suffix(source)
    raw = _PARSERS[suffix](Path(path).read_bytes(), source)
    if suffix == ".gdf" and columns is None:
        columns = _gdf_columns(raw.shape[1], source)
    named = _named(raw, columns or {}, source)
    return _finished(named, source, _Rows.of(raw, suffix), scale)


def check_tracks(table: pd.DataFrame, *, source: str, scale: ArrayLike = 1.0) -> pd.DataFrame:
    """Check a table of tracks and return a clean copy; every table passes through here.

    A NaN coordinate is not a fault: it is a missing point, and is kept.

    Parameters
    ----------
    table : pandas.DataFrame
        One row per particle and frame, with the columns ``frame``, ``particle``, ``x``, ``y`` and,
        where given, ``z``, ``cluster``, ``time``. The index is ignored.
    source : str
        What messages call the table: the name of its file, or "the table". For a source ending in
        ``.csv`` or ``.csv.gz`` they count lines (the header is line 1), else rows from 0.
    scale : float or one float per axis
        um per unit of the coordinates.

    Returns
    -------
    pandas.DataFrame
        Those columns in that order, rows in the order given, with a fresh index. ``frame`` is
        int64, coordinates and ``time`` are float64. ``particle`` and ``cluster`` are int64, or text
        throughout. A row of no cluster has ``cluster`` -1, or NaN where clusters are text. Columns
        of other spellings and units in their names are treated as in `read_tracks`.

    Raises
    ------
    TrackTableError
        If anything is wrong; ``faults`` holds a line for each kind of fault, with count and rows.
    TypeError
        If `table` is not a DataFrame.

    Examples
    --------
    >>> import pandas as pd
    >>> from perrin.tracks.files import check_tracks
    >>> table = pd.DataFrame({"x": [0, 1], "y": [2, 3], "particle": [4.0, 4.0], "frame": [0, 1]})
    >>> check_tracks(table, source="the table")
       frame  particle    x    y
    0      0         4  0.0  2.0
    1      1         4  1.0  3.0
    """
    import pandas as pd

    if not isinstance(table, pd.DataFrame):
        raise TypeError(f"{source}: expected a pandas DataFrame, got {type(table).__name__}")
    table = table.reset_index(drop=True)
    is_csv = source.lower().endswith((".csv", ".csv.gz"))
    named = _Named(table, recognise_columns(table.columns))
    return _finished(named, source, _Rows.of(table, ".csv" if is_csv else ""), scale)


def write_tracks(table: pd.DataFrame, path: _PathLike) -> None:
    """Write tracks to a file of the kind that its suffix names; an existing file is replaced.

    The file is written beside its place and renamed, so that a half-written one never stands.
    Numbers read back bit-identical. The columns written are those of `check_tracks`.

    Parameters
    ----------
    table : pandas.DataFrame
        Tracks, coordinates in um.
    path : str or path
        Where to, ending in ``.csv``, ``.csv.gz``, ``.parquet`` or ``.gdf`` (little endian, float64,
        columns x, y[, z], frame, particle). In a csv, text ids that look like numbers come back as
        numbers; parquet keeps them.

    Raises
    ------
    TrackTableError
        If the table has a fault, or the kind of file cannot hold it: a ``.gdf`` holds neither text
        ids nor a ``cluster`` or ``time`` column.
    OSError
        If the file cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> import pandas as pd
    >>> from perrin.tracks.files import read_tracks, write_tracks
    >>> table = pd.DataFrame({"frame": [0], "particle": [1], "x": [0.1], "y": [0.2]})
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_tracks(table, Path(folder) / "tracks.gdf")
    ...     read_tracks(Path(folder) / "tracks.gdf").equals(table)
    True
    """
    target = Path(path)
    to_bytes = _WRITERS[_suffix(target.name)]
    data = to_bytes(check_tracks(table, source="the table"), os.fspath(path))
    with written_whole(target) as beside:
        beside.write_bytes(data)


def read_spheres(path: _PathLike) -> tuple[Floats, Floats | None]:
    r"""Read the spheres of one body from a csv file with columns x, y, z and perhaps radius.

    Parameters
    ----------
    path : str or path
        One header line, one row a sphere, um.

    Returns
    -------
    centers : ndarray, shape (n, 3)
    radius : ndarray, shape (n,), or None
        None where the file has no such column.

    Raises
    ------
    TrackTableError
        If it is no such table; all faults are listed.
    OSError
        If it cannot be read.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = Path(folder) / "dimer.csv"
    ...     _ = file.write_text("x,y,z,radius\n0,0,0,1\n0,0,2.5,1.5\n")
    ...     centers, radius = read_spheres(file)
    >>> radius
    array([1. , 1.5])
    """
    source = os.fspath(path)
    table = _parse_csv(Path(path).read_bytes(), source)
    faults = [f"column {name!r} is missing" for name in _AXES if name not in table]
    unknown = [name for name in table if name not in (*_AXES, "radius")]
    if unknown:
        faults.append(f"columns other than x, y, z and radius: {listed(unknown)}")
    if not len(table):
        faults.append("no rows; expected one row per sphere")
    for name in [name for name in (*_AXES, "radius") if name in table]:
        bad = ~np.isfinite(_as_numbers(table[name])[0])
        if bad.any():
            line = int(table.index[bad][0]) + 2
            faults.append(f"column {name!r} holds no finite number in line {line}")
    if faults:
        raise table_error(source, *faults)
    radius = table["radius"].to_numpy(np.float64) if "radius" in table else None
    return table[list(_AXES)].to_numpy(np.float64), radius


# ---- messages -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Rows:
    """How messages name rows: lines of a csv file, or rows of a table."""

    word: str
    numbers: Ints

    @classmethod
    def of(cls, table: pd.DataFrame, suffix: str) -> _Rows:
        """Name the rows of a raw table, whose index counts data rows from 0."""
        if suffix.startswith(".csv"):
            return cls("line", table.index.to_numpy() + 2)
        return cls("row", table.index.to_numpy())

    def where(self, bad: Bools) -> str:
        """Return "line 3" or "lines 3, 7, 9, 12, 20 and 4 more"."""
        numbers = self.numbers[bad]
        plural = "s" if len(numbers) > 1 else ""
        return f"{self.word}{plural} {listed(numbers.tolist(), most=5)}"


# ---- the check ----------------------------------------------------------------------------------


def _checked(table: pd.DataFrame, source: str, rows: _Rows, faults: list[str]) -> pd.DataFrame:
    """Return the clean table, or raise all faults at once, those found before among them."""
    import pandas as pd

    faults = list(faults)
    clean: dict[str, NDArray[Any]] = {}
    for name in COLUMNS:
        if list(table.columns).count(name) == 1:
            clean[name], found = _CHECKS[name](table[name], name, rows)
            faults += found
    faults += _repeat_faults(clean, rows)
    if faults:
        raise table_error(source, *faults)
    return pd.DataFrame(clean)


def _column_faults(table: pd.DataFrame, named: _Named) -> list[str]:
    """Return the faults of the table as a whole: its columns and its length."""
    found = list(table.columns)
    faults = []
    ambiguous = {fault.partition(":")[0] for fault in named.spelling.faults}
    missing = [name for name in _REQUIRED if name not in found and name not in ambiguous]
    if missing:
        faults.append(
            f"missing column{'s' if len(missing) > 1 else ''} {', '.join(missing)}; found: "
            f"{listed(named.table.columns) or 'none'}; rename them, or state "
            f"columns={{'{missing[0]}': ...}} with the file's name or number of the column"
        )
    twice = [name for name in COLUMNS if found.count(name) > 1]
    if twice:
        faults.append(f"more than one column is called {', '.join(twice)}; keep one of each")
    if not len(table):
        faults.append("no rows; expected one row per particle and frame")
    return faults


def _as_numbers(column: pd.Series) -> tuple[Floats | Ints, Bools]:
    """Return a column as int64 or float64 (NaN where no number), and where it holds text.

    Integers stay integers, so that long ids keep all their digits.
    """
    import pandas as pd

    kind = column.dtype.kind
    text = np.zeros(len(column), dtype=bool)
    if kind in "iu" and not column.hasnans and column.max() <= np.iinfo(np.int64).max:
        return column.to_numpy(dtype=np.int64), text
    if kind in "iuf":
        return column.to_numpy(dtype=np.float64, na_value=np.nan), text
    numbers = pd.to_numeric(column.astype(object), errors="coerce")
    if numbers.dtype.kind not in "iuf":
        return np.full(len(column), np.nan), column.notna().to_numpy()
    text = (numbers.isna() & column.notna()).to_numpy()
    return numbers.to_numpy(), text


def _text_faults(column: pd.Series, text: Bools, name: str, rows: _Rows) -> list[str]:
    if not text.any():
        return []
    first = str(column[text].iloc[0])
    return [
        f"{name}: {text.sum()} of {len(text)} entries are text where a number is expected, "
        f"first {first!r}, in {rows.where(text)}; correct them"
    ]


def _check_measure(column: pd.Series, name: str, rows: _Rows) -> tuple[Floats, list[str]]:
    """Check a coordinate or the time: numbers or NaN, never infinite."""
    numbers, text = _as_numbers(column)
    values = numbers.astype(np.float64)
    faults = _text_faults(column, text, name, rows)
    infinite = np.isinf(values)
    if infinite.any():
        faults.append(
            f"{name}: {infinite.sum()} infinite values, in {rows.where(infinite)}; "
            "use NaN for a missing point"
        )
    return values, faults


def _is_whole(values: Floats | Ints) -> Bools:
    """Return where a value is a whole number that float64 and int64 both hold exactly."""
    if values.dtype.kind == "i":
        return np.ones(len(values), dtype=bool)
    with np.errstate(invalid="ignore"):
        whole: Bools = (values == np.floor(values)) & (np.abs(values) <= _LARGEST_EXACT)
    return whole


def _whole_faults(values: Floats | Ints, name: str, rows: _Rows) -> list[str]:
    broken = ~_is_whole(values) & ~np.isnan(values)
    if not broken.any():
        return []
    return [
        f"{name}: {broken.sum()} entries are not whole numbers, first {values[broken][0]}, in "
        f"{rows.where(broken)}; expected whole numbers"
    ]


def _missing_faults(missing: Bools, name: str, rows: _Rows) -> list[str]:
    if not missing.any():
        return []
    return [
        f"{name}: {missing.sum()} entries are missing or NaN, in {rows.where(missing)}; "
        f"every row needs its {name}, so fill them in or drop those rows"
    ]


def _check_frame(column: pd.Series, name: str, rows: _Rows) -> tuple[Floats | Ints, list[str]]:
    """Check frame numbers: whole numbers without exception."""
    values, text = _as_numbers(column)
    faults = [
        *_text_faults(column, text, name, rows),
        *_missing_faults(np.isnan(values) & ~text, name, rows),
        *_whole_faults(values, name, rows),
    ]
    return (values if faults else values.astype(np.int64)), faults


def _check_particle(column: pd.Series, name: str, rows: _Rows) -> tuple[NDArray[Any], list[str]]:
    """Check particle ids: whole numbers or text labels, none missing."""
    labels, faults = _as_labels(column, name, rows)
    faults += _missing_faults(column.isna().to_numpy(), name, rows)
    return _as_int_labels(labels, faults), faults


def _check_cluster(column: pd.Series, name: str, rows: _Rows) -> tuple[NDArray[Any], list[str]]:
    """Check cluster ids: as particle ids, but a missing one says "no cluster"."""
    labels, faults = _as_labels(column, name, rows)
    if labels.dtype.kind == "f":
        labels = np.where(column.isna().to_numpy(), -1.0, labels)
    return _as_int_labels(labels, faults), faults


def _as_int_labels(labels: NDArray[Any], faults: list[str]) -> NDArray[Any]:
    return labels if faults or labels.dtype.kind == "O" else labels.astype(np.int64)


def _as_labels(column: pd.Series, name: str, rows: _Rows) -> tuple[NDArray[Any], list[str]]:
    """Return ids as numbers, or as an object array of text with NaN where missing."""
    import pandas as pd

    raw = column.astype(object)
    values, text = _as_numbers(column)
    all_text = pd.api.types.infer_dtype(raw, skipna=True) == "string"
    if not text.any() and not all_text:
        return values, _whole_faults(values, name, rows)
    labels = raw.where(column.notna(), np.nan).to_numpy()
    numeric = ~text & column.notna().to_numpy()
    faults = []
    if text.any() and (numeric.any() or not all_text):
        faults.append(
            f"{name}: {text.sum()} entries are text and {numeric.sum()} are numbers, first "
            f"text {str(labels[text][0])!r}, text in {rows.where(text)}; use whole numbers "
            "throughout, or text labels throughout"
        )
    return labels, faults


def _repeat_faults(clean: dict[str, NDArray[Any]], rows: _Rows) -> list[str]:
    """Return the fault of a particle that stands twice in one frame."""
    import pandas as pd

    if "frame" not in clean or "particle" not in clean:
        return []
    key = [name for name in ("frame", "cluster", "particle") if name in clean]
    keys = pd.DataFrame({name: clean[name] for name in key})
    usable = keys[["frame", "particle"]].notna().all(axis=1)
    repeated = (keys.duplicated() & usable).to_numpy()
    if not repeated.any():
        return []
    first = ", ".join(f"{name} {keys[name].to_numpy()[repeated][0]}" for name in key)
    return [
        f"{repeated.sum()} rows repeat the ({', '.join(key)}) of an earlier row, first {first}, in "
        f"{rows.where(repeated)}; a particle may stand once in a frame, so drop the repeats or, "
        "where ids start anew in every cluster, add a cluster column"
    ]


_Check: TypeAlias = "Callable[[pd.Series, str, _Rows], tuple[NDArray[Any], list[str]]]"


_CHECKS: dict[str, _Check] = {
    "frame": _check_frame,
    "particle": _check_particle,
    "x": _check_measure,
    "y": _check_measure,
    "z": _check_measure,
    "cluster": _check_cluster,
    "time": _check_measure,
}


# ---- names and units ----------------------------------------------------------------------------


def _suffix(name: str) -> str:
    for suffix in SUFFIXES:
        if name.lower().endswith(suffix):
            return suffix
    raise table_error(
        name, f"unknown kind of file; expected a name ending in {', '.join(SUFFIXES)}"
    )


def _finished(named: _Named, source: str, rows: _Rows, scale: ArrayLike) -> pd.DataFrame:
    """Check a table, turn its units into um and s, and attach its notes."""
    spelling = named.spelling
    table = named.table.rename(columns=dict(spelling.renamed))
    axes = [axis for axis in _AXES if axis in table]
    faults = [*spelling.faults, *_column_faults(table, named)]
    if {"x", "y"} <= set(axes):
        factors = dict(zip(axes, _scale_per_axis(scale, len(axes)).tolist(), strict=True))
        faults += unit_faults(spelling.units, factors)
    tracks = _checked(table, source, rows, faults)
    for axis in axes:
        tracks[axis] *= factors[axis]
    if "time" in tracks:
        tracks["time"] *= seconds(spelling.units)
    if spelling.notes:
        tracks.attrs["notes"] = list(spelling.notes)
    tracks.attrs["columns"] = [str(name) for name in named.table.columns]
    return tracks


def _scale_per_axis(scale: ArrayLike, dimensions: int) -> Floats:
    values = np.asarray(scale, dtype=np.float64)
    if values.shape not in ((), (dimensions,)) or not (np.isfinite(values) & (values > 0)).all():
        raise ValueError(
            f"scale: expected one positive number, or {dimensions} of them (one per axis), in um "
            f"per unit of the file, got {scale!r}"
        )
    return np.broadcast_to(values, (dimensions,))


@dataclass(frozen=True, eq=False)
class _Named:
    """A raw table with the columns of the mapping under our names, and how the others are spelt."""

    table: pd.DataFrame
    spelling: Spelling


def _named(table: pd.DataFrame, columns: Mapping[str, str | int], source: str) -> _Named:
    """Return the table with the columns of the mapping under our names."""
    names = list(table.columns)
    places, faults = _places(names, columns)
    if faults:
        raise table_error(source, *faults)
    rest = [i for i, n in enumerate(names) if i not in places.values() and n not in places]
    named = table.iloc[:, [*places.values(), *rest]]
    named.columns = [*places, *(names[i] for i in rest)]
    taken = {ours: theirs if isinstance(theirs, str) else None for ours, theirs in columns.items()}
    return _Named(named, recognise_columns([names[i] for i in rest], taken=taken))


def _places(names: list[Any], columns: Mapping[str, str | int]) -> tuple[dict[str, int], list[str]]:
    """Return the number of the file's column for each name of ours, and what is wrong."""
    places: dict[str, int] = {}
    faults = []
    for ours, theirs in columns.items():
        if ours not in COLUMNS:
            faults.append(f"columns: unknown name {ours!r}; expected {', '.join(COLUMNS)}")
        elif isinstance(theirs, str) and theirs in names:
            places[ours] = names.index(theirs)
        elif isinstance(theirs, int | np.integer) and -len(names) <= theirs < len(names):
            places[ours] = int(theirs) % len(names)
        else:
            faults.append(
                f"columns: {ours} should be column {theirs!r}, which the file does not have; "
                f"its {len(names)} columns are: {listed(names)}"
            )
    return places, faults


def _gdf_columns(n_columns: int, source: str) -> dict[str, int]:
    if n_columns not in _GDF_COLUMNS:
        raise table_error(
            source,
            f"a .gdf of {n_columns} columns does not say which is which (4 are x, y, frame, "
            f"particle; 5 are x, y, z, frame, particle); name them, for example {_GDF_EXAMPLE}",
        )
    return {name: i for i, name in enumerate(_GDF_COLUMNS[n_columns])}


# ---- readers: bytes to a raw table --------------------------------------------------------------


def _parse_csv(data: bytes, source: str) -> pd.DataFrame:
    """Parse a csv file; the index counts data rows from 0 and leaves out blank lines."""
    import pandas as pd

    _refuse_unreadable_text(data, source)
    try:
        table = pd.read_csv(
            io.BytesIO(data),
            encoding="utf-8",
            **_exact_floats(pd.__version__),
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
    return _without_blank_lines(table, data)


def _exact_floats(pandas_version: str) -> dict[str, Any]:
    """Return the option of read_csv by which floats read back bit-identical."""
    major, minor = (int(part) for part in pandas_version.split(".")[:2])
    # From pandas 3.1 on this is the only way it reads, and the option is deprecated.
    return {} if (major, minor) >= (3, 1) else {"float_precision": "round_trip"}


def _refuse_unreadable_text(data: bytes, source: str) -> None:
    """Raise for an empty file, one that is no UTF-8 text, or one without a header."""
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
    _refuse_header(data[:65536].decode("utf-8-sig", errors="replace").splitlines()[0], source)


def _refuse_header(header: str, source: str) -> None:
    """Raise for a first line that cannot be the names of columns between commas."""
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


def _without_blank_lines(table: pd.DataFrame, data: bytes) -> pd.DataFrame:
    """Drop the rows of lines that say nothing at all; the index keeps the count of lines."""
    empty = np.flatnonzero(table.isna().all(axis=1))
    if not len(empty):
        return table
    lines = data.splitlines()
    return table.drop(index=[i for i in empty if not lines[i + 1].strip(b" \t,")])


def _parse_csv_gz(data: bytes, source: str) -> pd.DataFrame:
    try:
        text = gzip.decompress(data)
    except (gzip.BadGzipFile, EOFError, zlib.error) as error:
        raise table_error(
            source, f"not a whole gzip file ({error}); fetch or write it again"
        ) from None
    return _parse_csv(text, source)


def _parse_parquet(data: bytes, source: str) -> pd.DataFrame:
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        # Metadata of pandas could hide the frame column in the index.
        return pq.read_table(io.BytesIO(data)).to_pandas(ignore_metadata=True)
    except (pa.ArrowException, OSError) as error:
        reason = str(error).strip().splitlines()[0]
        raise table_error(source, f"not a parquet file that can be read ({reason})") from None


def _parse_gdf(data: bytes, source: str) -> pd.DataFrame:
    """Parse an IDL .gdf file; its columns are numbered."""
    import pandas as pd

    return pd.DataFrame(parse_gdf(data, source))


# ---- writers: a clean table to bytes ------------------------------------------------------------


def _csv_bytes(table: pd.DataFrame, _target: str) -> bytes:
    text: str = table.to_csv(index=False, lineterminator="\n")
    return text.encode("utf-8")


def _csv_gz_bytes(table: pd.DataFrame, target: str) -> bytes:
    buffer = io.BytesIO()
    # Neither the hour nor the file's name goes in: equal tables make equal files.
    with gzip.GzipFile("", "wb", compresslevel=6, fileobj=buffer, mtime=0) as packed:
        packed.write(_csv_bytes(table, target))
    return buffer.getvalue()


def _parquet_bytes(table: pd.DataFrame, _target: str) -> bytes:
    buffer = io.BytesIO()
    table.to_parquet(buffer, engine="pyarrow", index=False)
    return buffer.getvalue()


def _gdf_bytes(table: pd.DataFrame, target: str) -> bytes:
    extra = [name for name in ("cluster", "time") if name in table]
    faults = [f"a .gdf cannot hold the column {name}; drop it" for name in extra]
    if table["particle"].dtype.kind != "i":
        faults.append("a .gdf cannot hold text in particle; number the particles")
    elif max(table["particle"].abs().max(), table["frame"].abs().max()) > _LARGEST_EXACT:
        faults.append("a .gdf of float64 cannot hold frames or ids beyond 2**53; renumber them")
    if faults:
        raise table_error(target, *(f"{fault}, or write .csv or .parquet" for fault in faults))
    names = [*(axis for axis in _AXES if axis in table), "frame", "particle"]
    return gdf_bytes(table[names].to_numpy(dtype=np.float64))


_PARSERS: dict[str, Callable[[bytes, str], Any]] = {
    ".csv": _parse_csv,
    ".csv.gz": _parse_csv_gz,
    ".parquet": _parse_parquet,
    ".gdf": _parse_gdf,
}


_WRITERS: dict[str, Callable[[Any, str], bytes]] = {
    ".csv": _csv_bytes,
    ".csv.gz": _csv_gz_bytes,
    ".parquet": _parquet_bytes,
    ".gdf": _gdf_bytes,
}
