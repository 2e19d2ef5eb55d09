"""XYZ files, plain and extended: frames of particles, one after another."""

from __future__ import annotations

import io
import re
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from perrin.errors import table_error
from perrin.tracks.raw_tables import RawTable, without_flat_z

if TYPE_CHECKING:
    from collections.abc import Sequence

    import pandas as pd

_PROPERTIES = re.compile(r'\bProperties="?([^"\s]+)"?', re.IGNORECASE)

_FRAME_STATED = re.compile(r"\bframe\s*[=:]?\s*(-?\d+)\b", re.IGNORECASE)

_TIME_STATED = re.compile(r"\btime\s*[=:]?\s*\"?([-+.\deE]+)", re.IGNORECASE)

# Names of properties that other programs give to our columns.
_OURS = {
    "id": "particle", "particle": "particle", "track_id": "particle", "cluster": "cluster",
    "molecule": "cluster", "time": "time",
}  # fmt: skip


def parse_xyz(text: str, source: str) -> RawTable:
    r"""Return the particles of an XYZ file, a row per particle and frame.

    Parameters
    ----------
    text : str
        Frames of: the number of particles, a comment, and a line per particle. The comment of an
        extended file has ``Properties=``; ``frame=`` and ``Time=`` in a comment are used.
    source : str
        The file's name, for messages.

    Returns
    -------
    RawTable
        Where the file has no ids, particles are numbered in their order, provided that all frames
        have the same number of them.

    Raises
    ------
    TrackTableError
        If this is no such file.

    Examples
    --------
    >>> raw = parse_xyz("2\n\nA 0 0 1\nA 1 0 1\n2\n\nA 0 1 1\nA 1 1 1\n", "t.xyz")
    >>> raw.table[["frame", "particle", "x"]].to_numpy().tolist()
    [[0, 0, 0], [0, 1, 1], [1, 0, 0], [1, 1, 1]]
    """
    lines = text.splitlines()
    starts, counts = _frame_starts(lines, source)
    comments = [lines[start + 1] for start in starts]
    body = [
        line
        for start, count in zip(starts, counts, strict=True)
        for line in lines[start + 2 : start + 2 + count]
    ]
    table, found = _particle_columns(body, comments[0], source)
    # Numbers of frames in the comments count where all frames have one and all rise.
    stated = [int(match[1]) for match in map(_FRAME_STATED.search, comments) if match]
    rising = len(stated) == len(comments) and all(a < b for a, b in pairwise(stated))
    table["frame"] = np.repeat(stated if rising else range(len(comments)), counts)
    rows = [np.arange(n) + start + 2 for start, n in zip(starts, counts, strict=True)]
    table.index = np.concatenate(rows) - 1
    times = [_TIME_STATED.search(comment) for comment in comments]
    if "time" not in table and all(times):
        table["time"] = np.repeat([float(time[1]) for time in times if time], counts)
    notes = []
    extended = _PROPERTIES.search(comments[0]) is not None
    if "particle" not in found and len(set(counts)) == 1:
        table["particle"] = np.tile(np.arange(counts[0]), len(counts))
        notes.append("particles have no id in the file: they are numbered in their order")
    elif "particle" not in found:
        notes.append("particles have no id in the file, and frames have different numbers of them")
    columns = without_flat_z({axis: axis for axis in "xyz" if axis in table}, table)
    if len(columns) < 3 and "z" in table:
        table = table.drop(columns="z")
        notes.append("z is 0 throughout: read as two dimensions")
    if "lattice=" in comments[0].lower():
        notes.append("the periodic box is not used: positions must be unwrapped")
    columns |= {name: name for name in ("frame", "particle", "cluster", "time") if name in table}
    kind = f"{'extended ' if extended else ''}XYZ, {len(counts)} frames"
    return RawTable(table, kind, columns, notes=tuple(notes), word="line", first=2)


def xyz_text(table: pd.DataFrame) -> str:
    r"""Return a clean track table as extended XYZ, frames in rising order.

    Parameters
    ----------
    table : pandas.DataFrame
        As `check_tracks` returns it; z is written as 0 where there is none.

    Returns
    -------
    str

    Examples
    --------
    >>> import pandas as pd
    >>> print(xyz_text(pd.DataFrame({"frame": [4], "particle": [7], "x": [0.5], "y": [1.5]})))
    1
    Properties=species:S:1:pos:R:3:id:I:1 frame=4
    X 0.5 1.5 0 7
    <BLANKLINE>
    """
    extra = [name for name in ("particle", "cluster", "time") if name in table]
    kinds = {
        name: "R" if name == "time" else "I" if table[name].dtype.kind == "i" else "S"
        for name in extra
    }
    spelled = {"particle": "id"}
    properties = ":".join(f"{spelled.get(name, name)}:{kinds[name]}:1" for name in extra)
    columns = [table[name].map(repr) for name in ("x", "y")]
    columns.append(table["z"].map(repr) if "z" in table else table["x"].map(lambda _: "0"))
    columns += [table[name].map(repr if name == "time" else str) for name in extra]
    rows = np.array(["X " + " ".join(parts) for parts in zip(*columns, strict=True)], dtype=object)
    parts = []
    for frame, where in table.groupby("frame", sort=True).indices.items():
        parts.append(f"{len(where)}\nProperties=species:S:1:pos:R:3:{properties} frame={frame}")
        parts.extend(rows[where])
    return "\n".join(parts) + "\n"


def _frame_starts(lines: Sequence[str], source: str) -> tuple[list[int], list[int]]:
    """Return the first line of each frame and its number of particles."""
    starts, counts = [], []
    at = 0
    while at < len(lines):
        if not lines[at].strip():
            at += 1
            continue
        if not lines[at].strip().isdecimal():
            raise table_error(
                source,
                f"not an XYZ file: line {at + 1} ({lines[at][:40]!r}) should be the number of "
                "particles of a frame",
            )
        count = int(lines[at])
        if at + 2 + count > len(lines):
            raise table_error(source, f"cut short: line {at + 1} announces {count} particles")
        starts.append(at)
        counts.append(count)
        at += count + 2
    if not sum(counts):
        raise table_error(source, "an XYZ file without particles")
    return starts, counts


def _particle_columns(body: list[str], comment: str, source: str) -> tuple[pd.DataFrame, set[str]]:
    """Return the columns that the properties of an extended file, or their number, name."""
    import pandas as pd

    major, minor = (int(part) for part in pd.__version__.split(".")[:2])
    exact = {} if (major, minor) >= (3, 1) else {"float_precision": "round_trip"}
    try:
        table = pd.read_csv(
            io.StringIO("\n".join(body)), sep=r"\s+", header=None, **exact, low_memory=False
        )
    except pd.errors.ParserError as error:
        raise table_error(source, f"lines of different length: {error}") from None
    properties = _PROPERTIES.search(comment)
    names: dict[int, str] = {}
    if properties:
        parts = properties[1].split(":")
        at = 0
        for name, _, width in zip(parts[::3], parts[1::3], parts[2::3], strict=True):
            if name.lower() in ("pos", "position"):
                names |= {at + k: axis for k, axis in zip(range(int(width)), "xyz", strict=False)}
            elif name.lower() in _OURS and _OURS[name.lower()] not in names.values():
                names[at] = _OURS[name.lower()]
            at += int(width)
    else:
        element = 0 if table.shape[1] == 3 and table[0].dtype.kind in "iuf" else 1
        names = {element + k: axis for k, axis in enumerate("xyz")}
    if max(names, default=0) >= table.shape[1]:
        raise table_error(
            source, f"{table.shape[1]} columns where {max(names) + 1} are expected at least"
        )
    table = table[list(names)].set_axis(list(names.values()), axis=1)
    return table, set(names.values())
