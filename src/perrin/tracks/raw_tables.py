"""A table as it is in a file, and what its format states about columns and units."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

    import pandas as pd


@dataclass(frozen=True, eq=False)
class RawTable:
    """A table as it is in a file, before its columns and units are ours.

    Attributes
    ----------
    table : pandas.DataFrame
        Columns with the file's names, or numbers where it has none.
    kind : str
        What the file was recognised as, for a note: "a spots table of TrackMate". Empty where
        nothing but the names of the columns was needed.
    columns : mapping of str to str or int
        The file's column for each of our names, where the format states it.
    units : mapping of str to str
        Unit of our columns, where the format states it elsewhere than in their names.
    notes : tuple of str
        Further sentences on what was recognised or left out.
    unnamed : str
        Why the columns have no meaning until the caller names them; empty where they have one.
    word : str
        How messages call a row of the file: "line" or "row".
    first : int
        Number of the row of index 0.
    """

    table: pd.DataFrame
    kind: str = ""
    columns: Mapping[str, str | int] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    unnamed: str = ""
    word: str = "row"
    first: int = 0


def without_flat_z(columns: Mapping[str, str | int], table: pd.DataFrame) -> dict[str, str | int]:
    """Return the columns without z where it is 0 in every row: a movie of one plane.

    Parameters
    ----------
    columns : mapping
        The file's column for each of our names, of a format that always has a z.
    table : pandas.DataFrame

    Returns
    -------
    dict

    Examples
    --------
    >>> import pandas as pd
    >>> without_flat_z({"x": "X", "z": "Z"}, pd.DataFrame({"X": [1.0, 2.0], "Z": [0.0, 0.0]}))
    {'x': 'X'}
    """
    flat = "z" in columns and len(table) > 0 and bool((table[columns["z"]] == 0).all())
    return {name: column for name, column in columns.items() if not (flat and name == "z")}


def tracked_rows(table: pd.DataFrame, particle: str) -> tuple[pd.DataFrame, tuple[str, ...]]:
    """Return the rows that belong to a track, and a sentence on the others.

    Parameters
    ----------
    table : pandas.DataFrame
    particle : str
        Column with the number of the track, empty where there is none.

    Returns
    -------
    table : pandas.DataFrame
        All rows where none has a track.
    notes : tuple of str

    Examples
    --------
    >>> import pandas as pd
    >>> table = pd.DataFrame({"TRACK_ID": [1.0, None]})
    >>> rows, notes = tracked_rows(table, "TRACK_ID")
    >>> len(rows), notes[0]
    (1, 'left out: 1 of 2 spots that belong to no track')
    """
    import pandas as pd

    known = pd.to_numeric(table[particle], errors="coerce").notna()
    if known.all() or not known.any():
        return table, ()
    text = f"left out: {(~known).sum()} of {len(known)} spots that belong to no track"
    return table[known], (text,)
