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
        import csv

        if self.mark == r"\s+":
            return [part.strip('"') for part in line.split()]
        parts = next(csv.reader([line], delimiter=self.mark, skipinitialspace=True), [])
        return [part.strip() for part in parts]


def utf8_text(data: bytes, source: str) -> bytes:
    r"""Return the text of a file in UTF-8 without a byte order mark.

    Parameters
    ----------
    data : bytes
        UTF-8 or, with a byte order mark, UTF-16.
    source : str
        The file's name, for messages.

    Returns
    -------
    bytes

    Raises
    ------
    TrackTableError
        For an empty file and for bytes that are no text in these encodings.

    Examples
    --------
    >>> utf8_text("x (µm)".encode("utf-16"), "t.txt").decode()
    'x (µm)'
    """
    if data[:2] in _UTF16:
        try:
            data = data.decode("utf-16").encode()
        except UnicodeDecodeError:
            raise table_error(source, "not a text file in UTF-16; save it in UTF-8") from None
    data = data.removeprefix(codecs.BOM_UTF8)
    if not data.strip():
        raise table_error(source, "the file is empty")
    try:
        data.decode()
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise table_error(
            source, f"not a text file in UTF-8 (line {line}); save it as csv in UTF-8"
        ) from None
    if b"\0" in data:
        raise table_error(source, "a binary file, not a csv; give it the suffix of its kind")
    return data


def first_lines(text: bytes) -> list[str]:
    r"""Return the first lines of a text in UTF-8, as many as its layout is found from.

    Examples
    --------
    >>> first_lines(b"x,y\r\n1,2\r\n")
    ['x,y', '1,2']
    """
    parts = text.split(b"\n", _LINES_OF_NUMBERS)[:_LINES_OF_NUMBERS]
    return b"\n".join(parts).decode().splitlines()


def parse_text(text: bytes, source: str) -> RawTable:
    r"""Return the table of a text with one header line, which may begin with #.

    Parameters
    ----------
    text : bytes
        UTF-8; columns separated by commas, semicolons, tabs or blanks; with the last three, numbers
        may have decimal commas.
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
    >>> raw = parse_text(b"x;y\n1,5;2\n\n3,25;4\n", "t.csv")
    >>> raw.table.index.tolist(), raw.table["x"].tolist()
    ([0, 2], [1.5, 3.25])
    >>> raw.notes
    ('read with semicolons between the columns and decimal commas',)
    """
    lines = first_lines(text)
    header = next((i for i, line in enumerate(lines) if line.strip()), 0)
    comments = header
    while comments < len(lines) and lines[comments].lstrip().startswith("#"):
        comments += 1
    notes: tuple[str, ...] = ()
    if comments > header:
        first = next((i for i in range(comments, len(lines)) if lines[i].strip()), comments)
        following = lines[first : first + _LINES_COMPARED]
        layout = layout_of(following, source)
        # numpy.savetxt writes the names of the columns into a comment.
        in_comment = bool(following) and all(map(is_number, layout.fields(following[0])))
        header = comments - 1 if in_comment else first
        lines[header:header] = [lines.pop(header).lstrip("#\t ")] if in_comment else []
        if header > 0:
            notes = (f"line {header + 1} has the names of the columns; those before are comments",)
    layout = layout_of(lines[header:], source)
    names = layout.fields(lines[header])
    if all(map(is_number, names)):
        shown = lines[header].strip()[:60]
        unnamed = (
            f"line {header + 1} holds numbers ({shown}) where the names of the columns are "
            "expected; add a header line such as frame,particle,x,y,z, or state the numbers of the "
            "columns, for example columns={'frame': 0, 'particle': 1, 'x': 2, 'y': 3}"
        )
        table = delimited_table(text, layout, source, header=header - 1, names=None)
        return RawTable(table, notes=layout.notes, unnamed=unnamed, word="line", first=2)
    named = lines[header] if comments else None
    table = delimited_table(
        text, layout, source, header=header, names=layout.fields(named) if named else names
    )
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
    commas = inside == [","] and all(is_number(p) and not p.endswith(",") for p in parts)
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
    text: bytes,
    layout: Layout,
    source: str,
    *,
    header: int,
    skipped: int = 0,
    names: Sequence[str] | None,
) -> pd.DataFrame:
    r"""Return the table that begins after a line.

    Parameters
    ----------
    text : bytes
        UTF-8.
    layout : Layout
    source : str
        The file's name, for messages.
    header : int
        Index of the header line; that before the first row where there is none.
    skipped : int
        Number of lines after the header that are no rows.
    names : sequence of str, optional
        Names of the columns in the header; None: the columns have numbers.

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
    >>> delimited_table(b"a title\nx,y\n1,2\n", Layout(), "t.csv", header=1, names=["x", "y"])
       x  y
    1  1  2
    """
    import pandas as pd

    major, minor = (int(part) for part in pd.__version__.split(".")[:2])
    # From pandas 3.1 on floats always read back bit-identical, and the option is deprecated.
    exact = {} if (major, minor) >= (3, 1) else {"float_precision": "round_trip"}
    try:
        table = pd.read_csv(
            io.BytesIO(text),
            sep=layout.mark,
            decimal=layout.decimal,
            header=None,
            names=None if names is None else range(len(names)),
            skiprows=header + 1 + skipped,
            encoding="utf-8",
            **exact,
            low_memory=False,
            skip_blank_lines=False,
            skipinitialspace=True,
        )
    except (pd.errors.ParserError, pd.errors.EmptyDataError) as error:
        reason = str(error).strip().removeprefix("Error tokenizing data. C error: ")
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
    lines = text.decode().splitlines()[header + 1 + skipped :] if empty else []
    table = table.drop(index=[i for i in empty if not lines[i].strip(" \t,;")])
    table.index += header + skipped
    if names is None:
        return table
    # A DataFrame whose index has the name of a column is written with both: one of two columns of
    # one name and of equal content is left out.
    first = {name: column for column, name in reversed(list(enumerate(names)))}
    kept = [
        column
        for column, name in enumerate(names)
        if not name or column == first[name] or not table[column].equals(table[first[name]])
    ]
    return table[kept].set_axis([names[column] for column in kept], axis=1)


def is_number(text: str) -> bool:
    """Return whether a text is a number, with a point or a comma.

    Examples
    --------
    >>> is_number("1,5"), is_number("***")
    (True, False)
    """
    try:
        float(text.replace(",", "."))
    except ValueError:
        return False
    return True
