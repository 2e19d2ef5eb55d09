"""Track tables: reading, checking and writing them, with columns and units of our own."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np

from perrin._text import counted, listed
from perrin.errors import table_error
from perrin.tracks.cells import unguarded_cell
from perrin.tracks.clock import frames_from_times
from perrin.tracks.column_names import (
    COLUMNS,
    Spelling,
    ours_of,
    recognise_columns,
    seconds,
    stated_units,
    unit_faults,
)
from perrin.tracks.delimited import parse_text, utf8_text
from perrin.tracks.file_limits import refusing_foreign_errors
from perrin.tracks.formats import LARGEST_EXACT, parse_table, table_bytes, table_suffix
from perrin.tracks.groups import are_distinct
from perrin.tracks.simulations import is_selection, selection_table
from perrin.tracks.writing import written_whole

if TYPE_CHECKING:
    from collections.abc import Mapping

    import pandas as pd
    from numpy.typing import ArrayLike, NDArray

    from perrin._arrays import Bools, Floats, Ints
    from perrin.tracks.raw_tables import RawTable

_AXES = ("x", "y", "z")

_PathLike: TypeAlias = str | os.PathLike[str]


def read_tracks(
    path: _PathLike,
    *,
    scale: ArrayLike = 1.0,
    columns: Mapping[str, str | int] | None = None,
    detections: bool = False,
) -> pd.DataFrame:
    r"""Read particle tracks from a file into one checked table in micrometres.

    Parameters
    ----------
    path : str or path
        A table of text (``.csv``, ``.tsv``, ``.txt``, ``.dat``, packed as ``.gz`` or not), with
        commas, semicolons, tabs or blanks between the columns, among them tables of trackpy,
        TrackMate, Imaris and Motive; ``.parquet``; ``.gdf`` (IDL); ``.xml`` (TrackMate); ``.xyz``;
        and, with ``perrin[tables]``, ``.xlsx``, ``.xls``, ``.ods``, ``.c3d`` and ``.gsd``. The page
        docs/tables.md describes what is recognised in each.
    scale : float or one float per axis
        Micrometres per unit of the file: the pixel size, or (x, y, z) voxel sizes.
    columns : mapping, optional
        Which column of the file is which of ours (``frame``, ``particle``, ``x``, ``y``, ``z``,
        ``cluster``, ``time``), by its name in the file or by its number from 0 (from the end where
        negative): ``{"x": "POS_X"}`` or ``{"x": 0, "y": 1, "frame": -2, "particle": -1}``.
        Columns that already have our names need no entry, nor do those that differ in case, blanks
        or a unit only (``Frame``, ``Particle ID``, ``x (um)``, ``Y_um``); see the notes.
    detections : bool
        Accept a table without the column ``particle``, for `identify`.

    Returns
    -------
    pandas.DataFrame
        ``frame`` (int64), ``particle`` (int64 or text), ``x``, ``y`` and, where given, ``z``
        (float64, um), ``cluster`` and ``time`` (s) as in `check_tracks`. Other columns of the
        file are left out. ``attrs["columns"]`` holds all of the file's column
        names; ``attrs["notes"]``, where there are any, is a list of texts that state
        as what the file was read, and which columns were recognised under another spelling.

    Raises
    ------
    TrackTableError
        If the file cannot be read as a track table; the message lists every fault found.
    ValueError
        If `scale` is not one positive number, or one per axis.
    ImportError
        If the format needs a package that is not installed.
    OSError
        If the file is missing or may not be read.

    Notes
    -----
    A column with exactly our name is always taken. Otherwise a column is taken that has our name
    but for case, blanks, underscores and a unit at its end; where two columns could be the same one
    of ours, the table is refused. A unit of length in the name of a column, or stated elsewhere in
    the file, must agree with `scale`: nm needs 0.001, px needs the size of a pixel, and um needs 1;
    the table is refused where they contradict each other, since one of the two is wrong. Columns
    that `columns` gives by number are taken without regard to their names. A unit of time in the
    name of the column ``time`` converts it to s, as no argument can contradict it. Where a table
    has a column ``time``, but no ``frame``, frames are numbered by their times.

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
    suffix = table_suffix(source)
    data = Path(path).read_bytes()
    with refusing_foreign_errors(source):
        raw = parse_table(data, suffix, source)
    if raw.unnamed and not columns:
        raise table_error(source, raw.unnamed)
    columns = columns or {}
    found = _mapped_columns(list(raw.table.columns), columns, source)
    with refusing_foreign_errors(source):
        table, spelling = _named_columns(raw, found, columns)
        rows = RowNumbers(raw.word, raw.table.index.to_numpy() + raw.first)
        return _clean_table(table, spelling, source, rows, scale, detections=detections)


def check_tracks(
    table: pd.DataFrame, *, source: str, scale: ArrayLike = 1.0, detections: bool = False
) -> pd.DataFrame:
    """Check a table of tracks and return a clean copy.

    A NaN coordinate is not a fault: it is a missing point, and is kept.

    Parameters
    ----------
    table : pandas.DataFrame
        One row per particle and frame, with the columns ``frame``, ``particle``, ``x``, ``y`` and,
        where given, ``z``, ``cluster``, ``time``. A level of the index with one of these names that
        is no column counts as one; the rest of the index is ignored. Columns of two levels, such as
        those of a pivot table (axis, particle), become rows. A Universe or a group of atoms of
        MDAnalysis is taken as well.
    source : str
        Name of the table in messages: the name of its file, or "the table". For a source ending in
        ``.csv`` or ``.csv.gz`` they count lines (the header is line 1), else rows from 0.
    scale : float or one float per axis
        Micrometres per unit of the coordinates.
    detections : bool
        Accept a table without the column ``particle``, for `identify`.

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

    if is_selection(table):
        table = selection_table(table)
    if not isinstance(table, pd.DataFrame):
        raise TypeError(f"{source}: expected a pandas DataFrame, got {type(table).__name__}")
    if table.columns.nlevels == 2:
        table = _long_rows(table, source)
    else:
        present = set(ours_of(table.columns).values())
        levels = [name for name in table.index.names if isinstance(name, str)]
        wanted = {name: ours for name, ours in ours_of(levels).items() if ours not in present}
        added = {name: table.index.get_level_values(name) for name in wanted}
        table = table.reset_index(drop=True)
        table = table.assign(**{name: np.asarray(level) for name, level in added.items()})
    is_csv = source.lower().endswith((".csv", ".csv.gz"))
    rows = RowNumbers("line" if is_csv else "row", table.index.to_numpy() + 2 * is_csv)
    spelling = recognise_columns(table.columns)
    return _clean_table(table, spelling, source, rows, scale, detections=detections)


def write_tracks(table: pd.DataFrame, path: _PathLike) -> None:
    """Write tracks to a file of the kind that its suffix names; an existing file is replaced.

    The file appears whole or not at all (`written_whole`). Numbers read back bit-identical. The
    columns written are those of `check_tracks`.

    Parameters
    ----------
    table : pandas.DataFrame
        Tracks, coordinates in um.
    path : str or path
        Name of the file, ending in ``.csv``, ``.csv.gz``, ``.parquet``, ``.gdf`` (little endian,
        float64, columns x, y[, z], frame, particle), ``.xyz`` (extended) or ``.napari.csv``
        (track_id, t[, z], y, x). Text ids of digits in a csv are read back as numbers; parquet
        keeps them.

    Raises
    ------
    TrackTableError
        If the table has a fault, or the kind of file cannot hold it: ``.gdf`` and ``.napari.csv``
        hold neither text ids nor a ``cluster`` or ``time`` column.
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
    suffix = table_suffix(target.name, written=True)
    data = table_bytes(check_tracks(table, source="the table"), suffix, os.fspath(path))
    with written_whole(target) as part:
        part.write_bytes(data)


def read_spheres(path: _PathLike) -> tuple[Floats, Floats | None]:
    r"""Read the spheres of one body from a csv file with columns x, y, z and perhaps radius.

    Parameters
    ----------
    path : str or path
        A file with one header line and one row per sphere, um.

    Returns
    -------
    centers : ndarray, shape (n, 3)
        Sphere centres, um.
    radius : ndarray, shape (n,), or None
        Radii, um; None where the file has no such column.

    Raises
    ------
    TrackTableError
        If the file is no such table; all faults are listed.
    OSError
        If the file cannot be read.

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
    with refusing_foreign_errors(source):
        table = parse_text(utf8_text(Path(path).read_bytes(), source), source).table
    faults = [f"column {name!r} is missing" for name in _AXES if name not in table]
    unknown = [name for name in table if name not in (*_AXES, "radius")]
    if unknown:
        faults.append(f"columns other than x, y, z and radius: {listed(unknown)}")
    if not len(table):
        faults.append("no rows; expected one row per sphere")
    twice = sorted({str(name) for name in table.columns[table.columns.duplicated()]})
    if twice:
        faults.append(f"columns that stand there twice: {listed(twice)}")
    once = [name for name in (*_AXES, "radius") if name in table and name not in twice]
    for name in once:
        bad = ~np.isfinite(_as_numbers(table[name])[0])
        if bad.any():
            line = int(table.index[bad][0]) + 2
            faults.append(f"column {name!r} holds no finite number in line {line}")
    if faults:
        raise table_error(source, *faults)
    radius = table["radius"].to_numpy(np.float64) if "radius" in table else None
    return table[list(_AXES)].to_numpy(np.float64), radius


class RowNumbers(NamedTuple):
    """How messages name the rows of a table: lines of a csv file, or rows.

    Attributes
    ----------
    word : str
        "line" or "row".
    numbers : ndarray of int
        Number of each row of the table.
    """

    word: str
    numbers: Ints

    def where(self, bad: Bools) -> str:
        """Return "line 3" or "lines 3, 7, 9, 12, 20 and 4 more"."""
        numbers = self.numbers[bad]
        plural = "s" if len(numbers) > 1 else ""
        return f"{self.word}{plural} {listed(numbers.tolist(), most=5)}"


def _mapped_columns(
    names: list[Any], columns: Mapping[str, str | int], source: str
) -> dict[str, int]:
    """Return the number of the file's column for each of our names that the mapping holds."""
    found: dict[str, int] = {}
    faults = []
    for ours, theirs in columns.items():
        if ours not in COLUMNS:
            faults.append(f"columns: unknown name {ours!r}; expected {', '.join(COLUMNS)}")
        elif isinstance(theirs, str) and theirs in names:
            found[ours] = names.index(theirs)
        elif isinstance(theirs, int | np.integer) and -len(names) <= theirs < len(names):
            found[ours] = int(theirs) % len(names)
        else:
            faults.append(
                f"columns: {ours} should be column {theirs!r}, which the file does not have; "
                f"its {len(names)} columns are: {listed(names)}"
            )
    if faults:
        raise table_error(source, *faults)
    return found


def _named_columns(
    raw: RawTable, found: Mapping[str, int], columns: Mapping[str, str | int]
) -> tuple[pd.DataFrame, Spelling]:
    """Return a table with our names where the caller or the format states them, and the others.

    What the caller states outranks the format.
    """
    names = list(raw.table.columns)
    taken: dict[str, str | None] = {
        ours: theirs if isinstance(theirs, str) else None for ours, theirs in columns.items()
    }
    by_format = {
        ours: theirs
        for ours, theirs in raw.columns.items()
        if ours not in columns and names.index(theirs) not in found.values()
    }
    place = {**found, **{ours: names.index(theirs) for ours, theirs in by_format.items()}}
    taken |= {o: theirs if isinstance(theirs, str) else None for o, theirs in by_format.items()}
    rest = [i for i, name in enumerate(names) if i not in place.values() and name not in place]
    table = raw.table.iloc[:, [*place.values(), *rest]]
    table.columns = [*place, *(names[i] for i in rest)]
    table.attrs["names"] = [str(name) for name in names]
    spelling = recognise_columns([names[i] for i in rest], taken=taken)
    units, faults = stated_units(
        {
            ours: (str(theirs), raw.units[ours])
            for ours, theirs in by_format.items()
            if ours in raw.units
        }
    )
    notes = [*raw.notes]
    if raw.kind:
        pairs = listed(
            f"{theirs if isinstance(theirs, int) else repr(theirs)} as {ours}"
            for ours, theirs in by_format.items()
            if theirs != ours
        )
        notes.insert(0, f"read as {raw.kind}" + (f": {pairs}" if pairs else ""))
    return table, Spelling(
        spelling.renamed,
        {**spelling.units, **units},
        (*notes, *spelling.notes),
        (*spelling.faults, *faults),
    )


def _long_rows(table: pd.DataFrame, source: str) -> pd.DataFrame:
    """Return a table with columns of two levels, one of them the axes, as one row per particle."""
    levels = [{str(name) for name in table.columns.get_level_values(k)} for k in (0, 1)]
    axis = next((k for k in (0, 1) if {"x", "y"} <= levels[k] <= {*_AXES}), None)
    if axis is None:
        raise table_error(
            source,
            "columns of two levels, of which none holds just x, y and perhaps z; expected one of "
            "axes and one of particles",
        )
    ours = ours_of([name for name in table.index.names if isinstance(name, str)])
    if not {"frame", "time"} & set(ours.values()):
        table = table.rename_axis(index="frame")
    long = table.set_axis(table.columns.set_names([None, None]), axis=1)
    long = long.stack(level=1 - axis, future_stack=True)
    return long.rename_axis([*table.index.names, "particle"]).reset_index()


def _clean_table(
    raw: pd.DataFrame,
    spelling: Spelling,
    source: str,
    rows: RowNumbers,
    scale: ArrayLike,
    *,
    detections: bool,
) -> pd.DataFrame:
    """Check a table, convert its units to um and s, and attach its notes; list all faults."""
    import pandas as pd

    names = raw.attrs["names"] if "names" in raw.attrs else [str(name) for name in raw.columns]
    table = raw.rename(columns=dict(spelling.renamed)) if spelling.renamed else raw
    axes = [axis for axis in _AXES if axis in table]
    table, note, faults = _with_frames(table, spelling)
    notes = [*spelling.notes, *note]
    faults += [*spelling.faults, *_column_faults(table, names, spelling, detections=detections)]
    factors: dict[str, float] = {}
    if {"x", "y"} <= set(axes):
        factor = np.asarray(scale, dtype=np.float64)
        one_or_each = factor.shape in ((), (len(axes),))
        if not one_or_each or not (np.isfinite(factor) & (factor > 0)).all():
            raise ValueError(
                f"scale: expected one positive number, or {len(axes)} of them (one per axis), in "
                f"um per unit of the file, got {scale!r}"
            )
        factors = dict(zip(axes, np.broadcast_to(factor, len(axes)).tolist(), strict=True))
    faults += unit_faults(spelling.units, factors)
    clean: dict[str, NDArray[Any]] = {}
    present = list(table.columns)
    for name in COLUMNS:
        if present.count(name) == 1:
            check = _checked_ids if name in ("particle", "cluster") else _checked_numbers
            clean[name], found = check(table[name], name, rows)
            faults += found
    faults += _repeat_faults(clean, rows)
    if faults:
        raise table_error(source, *faults)
    if "time" in clean:
        factors["time"] = seconds(spelling.units)
    scaled = {k: c if factors.get(k, 1) == 1 else c * factors[k] for k, c in clean.items()}
    tracks = pd.DataFrame(scaled)
    if notes:
        tracks.attrs["notes"] = notes
    tracks.attrs["columns"] = list(names)
    if "labels" in raw.attrs:
        tracks.attrs["labels"] = dict(raw.attrs["labels"])
    return tracks


def _with_frames(
    table: pd.DataFrame, spelling: Spelling
) -> tuple[pd.DataFrame, list[str], list[str]]:
    """Return a table with frames numbered by the times where it has only these; notes, faults."""
    if "frame" in table or list(table.columns).count("time") != 1 or not len(table):
        return table, [], []
    times, text = _as_numbers(table["time"])
    if text.any():
        return table, [], []
    factor = seconds(spelling.units)
    frames, notes, faults = frames_from_times(np.asarray(times, dtype=np.float64) * factor)
    return table.assign(frame=frames), notes, faults


def _column_faults(
    table: pd.DataFrame, names: list[str], spelling: Spelling, *, detections: bool
) -> list[str]:
    """Return the faults of the table as a whole: its columns, named as in the file, and length."""
    found = list(table.columns)
    faults = []
    ambiguous = {fault.partition(":")[0] for fault in spelling.faults}
    needed = ("frame", "x", "y") if detections else ("frame", "particle", "x", "y")
    required = [name for name in needed if name not in ambiguous]
    missing = [name for name in required if name not in found]
    if missing:
        faults.append(
            f"missing column{'s' if len(missing) > 1 else ''} {', '.join(missing)}; found: "
            f"{listed(names) or 'none'}; rename them, or state "
            f"columns={{'{missing[0]}': ...}} with the file's name or number of the column"
        )
        if missing == ["particle"]:
            faults[-1] += "; where the rows have no ids, state contact= and size= to find them"
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


def _checked_numbers(
    column: pd.Series, name: str, rows: RowNumbers
) -> tuple[NDArray[Any], list[str]]:
    """Check frame numbers (whole, none missing), coordinates and times (finite or NaN)."""
    values, text = _as_numbers(column)
    faults = []
    if text.any():
        first = str(column[text].iloc[0])
        faults.append(
            f"{name}: {text.sum()} of {len(text)} entries are text where a number is expected, "
            f"first {first!r}, in {rows.where(text)}; correct them"
        )
    if name == "frame":
        faults += _missing_faults(np.isnan(values) & ~text, name, rows)
        faults += _whole_faults(values, name, rows)
        return (values if faults else values.astype(np.int64)), faults
    values = values.astype(np.float64)
    infinite = np.isinf(values)
    if infinite.any():
        faults.append(
            f"{name}: {counted(int(infinite.sum()), 'infinite value')}, in {rows.where(infinite)}; "
            "use NaN for a missing point"
        )
    return values, faults


def _checked_ids(column: pd.Series, name: str, rows: RowNumbers) -> tuple[NDArray[Any], list[str]]:
    """Check ids: whole numbers or text labels throughout; only a cluster may be missing.

    Text is returned as an object array with NaN where missing; numbers of no cluster are -1.
    """
    import pandas as pd

    missing = column.isna().to_numpy()
    labels, text = _as_numbers(column)
    all_text = column.dtype.kind not in "iufb" and (
        pd.api.types.infer_dtype(column.astype(object), skipna=True) == "string"
    )
    if text.any() or all_text:
        labels = column.astype(object).where(column.notna(), np.nan).to_numpy()
        if rows.word == "line":
            plain = np.array([unguarded_cell(label) for label in labels], dtype=object)
            # Two labels of a file stay two.
            if len(set(plain[~missing])) == len(set(labels[~missing])):
                labels = plain
        numeric = ~text & ~missing
        faults = []
        if text.any() and (numeric.any() or not all_text):
            faults.append(
                f"{name}: {text.sum()} entries are text and {numeric.sum()} are numbers, first "
                f"text {str(labels[text][0])!r}, text in {rows.where(text)}; use whole numbers "
                "throughout, or text labels throughout"
            )
    else:
        faults = _whole_faults(labels, name, rows)
    if name == "particle":
        faults += _missing_faults(missing, name, rows)
    elif labels.dtype.kind == "f":
        labels = np.where(missing, -1.0, labels)
    return (labels if faults or labels.dtype.kind == "O" else labels.astype(np.int64)), faults


def _whole_faults(values: Floats | Ints, name: str, rows: RowNumbers) -> list[str]:
    """Return the fault of values that are not whole, or that float64 and int64 do not both hold."""
    if values.dtype.kind == "i":
        return []
    with np.errstate(invalid="ignore"):
        whole = (values == np.floor(values)) & (np.abs(values) <= LARGEST_EXACT)
    broken = ~whole & ~np.isnan(values)
    if not broken.any():
        return []
    return [
        f"{name}: {broken.sum()} entries are not whole numbers, first {values[broken][0]}, in "
        f"{rows.where(broken)}; expected whole numbers"
    ]


def _missing_faults(missing: Bools, name: str, rows: RowNumbers) -> list[str]:
    """Return the fault of missing entries in a column that every row needs."""
    if not missing.any():
        return []
    return [
        f"{name}: {missing.sum()} entries are missing or NaN, in {rows.where(missing)}; "
        f"every row needs its {name}, so fill them in or drop those rows"
    ]


def _repeat_faults(clean: dict[str, NDArray[Any]], rows: RowNumbers) -> list[str]:
    """Return the fault of a particle with two rows in one frame."""
    import pandas as pd

    if "frame" not in clean or "particle" not in clean:
        return []
    key = [name for name in ("frame", "cluster", "particle") if name in clean]
    if are_distinct([clean[name] for name in key]):
        return []
    keys = pd.DataFrame({name: clean[name] for name in key})
    repeated = keys.duplicated().to_numpy()
    if repeated.any():
        repeated = repeated & keys[["frame", "particle"]].notna().all(axis=1).to_numpy()
    if not repeated.any():
        return []
    first = ", ".join(f"{name} {keys[name].to_numpy()[repeated][0]}" for name in key)
    return [
        f"{counted(int(repeated.sum()), 'row', 'repeat')} the ({', '.join(key)}) of an earlier "
        f"row, first {first}, in "
        f"{rows.where(repeated)}; a particle has at most one row per frame, so drop the repeats "
        "or, where ids start anew in every cluster, add a cluster column"
    ]
