"""Tables of text: encoding, marks between the columns, decimal commas, comments before them."""

from __future__ import annotations

import codecs
import io
import re
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from perrin.errors import table_error
from perrin.tracks.raw_tables import RawTable

if TYPE_CHECKING:
    from collections.abc import Sequence

    import pandas as pd

_MARKS = {"\t": "tabs", ";": "semicolons", ",": "commas", r"\s+": "blanks"}

# Lines after the header from which marks are found.
_LINES_COMPARED, _LINES_OF_NUMBERS = 6, 500

_DECIMAL_COMMA = re.compile(r"(?:^|[\s;\"])[+-]?\d*,\d+(?:[eE][+-]?\d+)?(?=$|[\s;\"])")

_DECIMAL_POINT = re.compile(r"(?:^|[\s;\"])[+-]?\d*\.\d+(?:[eE][+-]?\d+)?(?=$|[\s;\"])")

_THOUSANDS = re.compile(r"(?:^|[\s;\"])[+-]?\d{1,3}(?:\.\d{3})+,\d+(?=$|[\s;\"])")

_UTF16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)


class Layout(NamedTuple):
    """How a line of text is divided into numbers.

    Attributes
    ----------
    mark : str
        What separates columns; a regular expression for blanks.
    decimal : str
        "." or ",".
    """

    mark: str = ","
    decimal: str = "."

    @property
    def notes(self) -> tuple[str, ...]:
        """A sentence where it is not that of a csv file."""
        if self == Layout():
            return ()
        numbers = "decimal commas" if self.decimal == "," else "decimal points"
        return (f"read with {_MARKS[self.mark]} between the columns and {numbers}",)

    def fields(self, line: str) -> list[str]:
        """Return the fields of a line, without quotation marks and blanks around them."""
        parts = line.split() if self.mark == r"\s+" else line.split(self.mark)
        return [part.strip().strip('"').strip() for part in parts]


def decoded(data: bytes, source: str) -> str:
    r"""Return the text of a file, in UTF-8 or, with a byte order mark, in UTF-16.

    Parameters
    ----------
    data : bytes
    source : str
        The file's name, for messages.

    Returns
    -------
    str

    Raises
    ------
    TrackTableError
        For an empty file and for bytes that are no text in these encodings.

    Examples
    --------
    >>> decoded("x (µm)".encode("utf-16"), "t.txt")
    'x (µm)'
    """
    if not data.strip():
        raise table_error(source, "the file is empty")
    encoding = "utf-16" if data[:2] in _UTF16 else "utf-8-sig"
    try:
        text = data.decode(encoding)
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise table_error(
            source, f"not a text file in UTF-8 (line {line}); save it as csv in UTF-8"
        ) from None
    if "\0" in text:
        raise table_error(source, "a binary file, not a csv; give it the suffix of its kind")
    if not text.strip():
        raise table_error(source, "the file is empty")
    return text


def parse_text(text: str, source: str) -> RawTable:
    r"""Return the table of a text with one header line, which may begin with #.

    Parameters
    ----------
    text : str
        Columns separated by commas, semicolons, tabs or blanks; with the last three, numbers may
        have decimal commas.
    source : str
        The file's name, for messages.

    Returns
    -------
    RawTable
        The index counts lines from the one after line 1; blank lines have no row.

    Raises
    ------
    TrackTableError
        If this is no such text.

    Examples
    --------
    >>> raw = parse_text("x;y\n1,5;2\n\n3,25;4\n", "t.csv")
    >>> raw.table.index.tolist(), raw.table["x"].tolist()
    ([0, 2], [1.5, 3.25])
    >>> raw.notes
    ('read with semicolons between the columns and decimal commas',)
    """
    lines = text.splitlines()
    header = next(i for i, line in enumerate(lines) if line.strip())
    comments = header
    while comments < len(lines) and lines[comments].lstrip().startswith("#"):
        comments += 1
    first = next((i for i in range(comments, len(lines)) if lines[i].strip()), len(lines))
    notes: tuple[str, ...] = ()
    if comments > header:
        following = lines[first : first + _LINES_COMPARED]
        layout = layout_of(following, source)
        named = lines[comments - 1].lstrip("#\t ")
        is_header = bool(following) and all(map(_is_number, layout.fields(following[0])))
        # numpy.savetxt writes the names of the columns into a comment.
        header = comments - 1 if is_header else first
        if is_header:
            lines[header] = named
        if header > 0:
            notes = (f"line {header + 1} has the names of the columns; those before are comments",)
    layout = layout_of(lines[header : header + _LINES_OF_NUMBERS], source)
    if all(map(_is_number, layout.fields(lines[header]))):
        shown = lines[header].strip()[:60]
        unnamed = (
            f"line {header + 1} holds numbers ({shown}) where the names of the columns are "
            "expected; add a header line such as frame,particle,x,y,z, or state the numbers of the "
            "columns, for example columns={'frame': 0, 'particle': 1, 'x': 2, 'y': 3}"
        )
        table = delimited_table(lines, layout, source, header=header, named=False)
        return RawTable(table, notes=layout.notes, unnamed=unnamed, word="line", first=2)
    table = delimited_table(lines, layout, source, header=header)
    return RawTable(table, notes=(*layout.notes, *notes), word="line", first=2)


def layout_of(lines: Sequence[str], source: str) -> Layout:
    r"""Return the marks that divide a header and the lines after it.

    Parameters
    ----------
    lines : sequence of str
        Header and the first lines of numbers.
    source : str
        The file's name, for messages.

    Returns
    -------
    Layout

    Raises
    ------
    TrackTableError
        If numbers have both decimal points and decimal commas, or marks between thousands.

    Examples
    --------
    >>> layout_of(["frame y x", "0 1,5 2"], "t.txt")
    Layout(mark='\\s+', decimal=',')
    """
    head = lines[0] if lines else ""
    rest = [line for line in lines[1:_LINES_COMPARED] if line.strip()]
    inside = [mark for mark in ("\t", ";", ",") if mark in head]
    regular = [mark for mark in inside if all(row.count(mark) >= head.count(mark) for row in rest)]
    mark = next(iter([*regular, *inside]), ",")
    parts = head.split()
    # Numbers with decimal commas and blanks between them, under no header.
    commas = inside == [","] and all(_is_number(p) and not p.endswith(",") for p in parts)
    if (not inside or commas) and len(parts) > 1:
        mark = r"\s+" if all(len(row.split()) == len(parts) for row in rest) else mark
    if mark == ",":
        return Layout()
    numbers = "\n".join(lines[1:])
    if _THOUSANDS.search(numbers):
        found = _THOUSANDS.search(numbers)
        raise table_error(
            source,
            f"numbers with points between thousands ({found[0].strip() if found else ''}); write "
            "them without",
        )
    comma, point = _DECIMAL_COMMA.search(numbers), _DECIMAL_POINT.search(numbers)
    if comma and point:
        raise table_error(
            source,
            f"numbers with decimal commas ({comma[0].strip()}) and with decimal points "
            f"({point[0].strip()}); write all in one way",
        )
    return Layout(mark, "," if comma else ".")


def delimited_table(
    lines: Sequence[str],
    layout: Layout,
    source: str,
    *,
    header: int,
    skipped: int = 0,
    named: bool = True,
) -> pd.DataFrame:
    r"""Return the table that begins at a line.

    Parameters
    ----------
    lines : sequence of str
        All lines of the file.
    layout : Layout
    source : str
        The file's name, for messages.
    header : int
        Index of the header line.
    skipped : int
        Number of lines after the header that are no rows.
    named : bool
        Whether the header has names; if not, it is a row and the columns have numbers.

    Returns
    -------
    pandas.DataFrame
        The index counts lines of the file from 0 at line 2; blank lines have no row.

    Raises
    ------
    TrackTableError
        If the lines are no table.

    Examples
    --------
    >>> delimited_table(["a title", "x,y", "1,2"], Layout(), "t.csv", header=1)
       x  y
    1  1  2
    """
    import pandas as pd

    major, minor = (int(part) for part in pd.__version__.split(".")[:2])
    # From pandas 3.1 on floats always read back bit-identical, and the option is deprecated.
    exact = {} if (major, minor) >= (3, 1) else {"float_precision": "round_trip"}
    body = lines[header + 1 + skipped :] if named else lines[header:]
    try:
        table = pd.read_csv(
            io.StringIO("\n".join([lines[header], *body] if named else body)),
            sep=layout.mark,
            decimal=layout.decimal,
            header=0 if named else None,
            **exact,
            low_memory=False,
            skip_blank_lines=False,
            skipinitialspace=True,
        )
    except (pd.errors.ParserError, pd.errors.EmptyDataError) as error:
        reason = str(error).strip().removeprefix("Error tokenizing data. C error: ")
        shift = header + skipped
        reason = re.sub(r"(?<=\bline )\d+", lambda at: str(int(at[0]) + shift), reason)
        raise table_error(
            source,
            f"not a table with one header line and {_MARKS[layout.mark]} between the columns: "
            f"{reason}",
        ) from None
    if not isinstance(table.index, pd.RangeIndex):
        raise table_error(
            source, f"rows have more fields than the header (line {header + 1}) has names"
        )
    empty = np.flatnonzero(table.isna().all(axis=1)).tolist()
    table = table.drop(index=[i for i in empty if not body[i].strip(" \t,;")])
    table.index += header + skipped - (0 if named else 1)
    if named:
        table.columns = table.columns.astype(str).str.strip()
        table = _without_equal_columns(table, layout.fields(lines[header]))
    return table


def _without_equal_columns(table: pd.DataFrame, names: list[str]) -> pd.DataFrame:
    """Return the table without repeated columns of equal content; others keep their name.

    A DataFrame whose index has the name of a column is written with both.
    """
    repeated = {name for name in names if name and names.count(name) > 1}
    again = {f"{name}.{k}": name for name in repeated for k in range(1, names.count(name))}
    again = {column: name for column, name in again.items() if {column, name} <= set(table.columns)}
    equal = [column for column, name in again.items() if table[column].equals(table[name])]
    kept = table.drop(columns=equal)
    return kept.rename(columns={k: name for k, name in again.items() if k not in equal})


def _is_number(text: str) -> bool:
    try:
        float(text.replace(",", "."))
    except ValueError:
        return False
    return True
