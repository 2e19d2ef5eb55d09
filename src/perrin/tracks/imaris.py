"""Positions in the statistics of Imaris, as csv."""

from __future__ import annotations

from typing import TYPE_CHECKING

from perrin.errors import table_error
from perrin.tracks.delimited import Layout, delimited_table, first_lines
from perrin.tracks.raw_tables import RawTable, tracked_rows

if TYPE_CHECKING:
    from collections.abc import Sequence

_IMARIS_NAMES = {"x": "Position X", "y": "Position Y", "z": "Position Z", "frame": "Time"}

_LINES_BEFORE_HEADER = 4


def is_imaris(lines: Sequence[str]) -> bool:
    """Return whether a text begins like a file of statistics of Imaris: a title, underlined.

    Examples
    --------
    >>> is_imaris(["", "Position", " ==================== ", "Position X,Position Y,Unit"])
    True
    """
    return _underline(lines) is not None


def imaris_table(text: bytes, source: str) -> RawTable:
    r"""Return the positions in a file of statistics.

    Parameters
    ----------
    text : bytes
        UTF-8.
    source : str
        The file's name, for messages.

    Returns
    -------
    RawTable
        The column Time of Imaris counts frames from 1. Spots of no track are left out, and counted
        in a note.

    Raises
    ------
    TrackTableError
        If the statistic is another one than Position.

    Examples
    --------
    >>> text = b"\nPosition\n====\nPosition X,Position Y,Position Z,Unit,Time,TrackID,ID,\n"
    >>> raw = imaris_table(text + b"1,2,3,um,1,7,0,\n", "Position.csv")
    >>> raw.columns["particle"], raw.units["x"], raw.table.index.tolist()
    ('TrackID', 'um', [3])
    """
    lines = first_lines(text)
    underline = _underline(lines) or 0
    header = underline + 1
    title = lines[underline - 1].strip(' ",') if underline else ""
    names = Layout().fields(lines[header]) if header < len(lines) else []
    if not {"Position X", "Position Y"} <= set(names):
        raise table_error(
            source,
            f"the statistic {title or names[:1]} of Imaris; export the statistic Position, which "
            "has the columns Position X, Position Y, Position Z, Time and TrackID",
        )
    table = delimited_table(text, Layout(), source, header=header, names=names)
    found = {ours: name for ours, name in _IMARIS_NAMES.items() if name in table}
    particle = next((name for name in ("TrackID", "Parent") if name in table), None)
    notes: tuple[str, ...] = ()
    if particle and table[particle].notna().any():
        found["particle"] = particle
        table, notes = tracked_rows(table, particle)
    units = {}
    if "Unit" in table and table["Unit"].nunique() == 1:
        units = dict.fromkeys((axis for axis in "xyz" if axis in found), str(table["Unit"].iloc[0]))
    kind = f"the statistic {title or 'Position'} of Imaris"
    return RawTable(table, kind, found, units, notes, word="line", first=2)


def _underline(lines: Sequence[str]) -> int | None:
    """Return the line of equal signs under the title."""
    for number, line in enumerate(lines[:_LINES_BEFORE_HEADER]):
        if line.strip(" ,") and not line.strip(" ,="):
            return number
    return None
