"""Cells of text that a spreadsheet would compute: a csv file holds them behind an apostrophe."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas as pd

# Spreadsheets take a cell for a formula that begins with one of these, also behind blanks.
_FORMULA = re.compile(r"'*\s*[=+\-@|\t\r]")


def guarded_cell(text: object) -> object:
    """Return a cell that no spreadsheet takes for a formula; numbers stay as they are.

    Parameters
    ----------
    text : object
        Anything but text is returned as it is.

    Returns
    -------
    object

    Examples
    --------
    >>> guarded_cell("=1+1"), guarded_cell("-1.5"), guarded_cell("a=b"), guarded_cell("'@x")
    ("'=1+1", '-1.5', 'a=b', "''@x")
    """
    if not isinstance(text, str) or not _FORMULA.match(text):
        return text
    try:
        float(text)
    except ValueError:
        return f"'{text}"
    return text


def unguarded_cell(text: object) -> object:
    """Return the cell that `guarded_cell` was given.

    Examples
    --------
    >>> [unguarded_cell(guarded_cell(text)) for text in ("=1+1", "'@x", "'x", "-3")]
    ['=1+1', "'@x", "'x", '-3']
    """
    if isinstance(text, str) and text.startswith("'") and guarded_cell(text[1:]) == text:
        return text[1:]
    return text


def guarded_table(table: pd.DataFrame) -> pd.DataFrame:
    """Return a table for a csv file, with `guarded_cell` for its cells and names of columns.

    Parameters
    ----------
    table : pandas.DataFrame

    Returns
    -------
    pandas.DataFrame

    Examples
    --------
    >>> import pandas as pd
    >>> guarded_table(pd.DataFrame({"label": ["@a", "b"], "x": [-1.0, 2.0]}))["label"].tolist()
    ["'@a", 'b']
    """
    texts = [name for name in table if table[name].dtype.kind not in "biufcmM"]
    guarded = table.assign(**{name: table[name].map(guarded_cell) for name in texts})
    return guarded.rename(columns=guarded_cell)
