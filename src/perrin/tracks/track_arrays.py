"""Arrays of tracks without names: the columns of a .gdf file, and those that napari takes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from perrin.tracks.raw_tables import RawTable

if TYPE_CHECKING:
    from collections.abc import Iterable

    import pandas as pd

    from perrin._arrays import Floats

_GDF_NAMES = {
    4: ("x", "y", "frame", "particle"),
    5: ("x", "y", "z", "frame", "particle"),
}

_GDF_EXAMPLE = 'columns={"x": 0, "y": 1, "z": 2, "frame": -2, "particle": -1}'

# The integrated brightness of a feature is larger than its coordinates by this factor.
_BRIGHTER = 10.0


def gdf_table(values: Floats) -> RawTable:
    """Return an IDL track array with the meaning of its columns, where that is certain.

    Parameters
    ----------
    values : ndarray, shape (rows, columns)

    Returns
    -------
    RawTable
        Columns have numbers. The last two are frame and particle. With 4 and 5 columns the others
        are x, y and x, y, z. With more, brightness, squared radius and others lie between: those of
        ``feature`` (x, y, brightness, radius of gyration, eccentricity) or ``feature3d`` (x, y, z,
        brightness, ...). The dimension is stated where the brightness is found, and left to the
        caller where not.

    Examples
    --------
    >>> rows = np.array([[5.0, 6, 7, 9000, 3, 0, 1], [5.1, 6, 7, 9100, 3, 1, 1]])
    >>> raw = gdf_table(rows)
    >>> raw.columns, raw.kind
    ({'x': 0, 'y': 1, 'z': 2, 'frame': 5, 'particle': 6}, 'a .gdf of 7 columns as of feature3d')
    """
    import pandas as pd

    table, count = pd.DataFrame(values), values.shape[1]
    if count in _GDF_NAMES:
        return RawTable(table, columns={name: i for i, name in enumerate(_GDF_NAMES[count])})
    names = _feature_names(values)
    if names:
        columns = {name: i for i, name in enumerate(names)}
        columns |= {"frame": count - 2, "particle": count - 1}
        program = "feature3d" if "z" in columns else "feature"
        note = "columns counted from 0; state others with columns"
        return RawTable(table, f"a .gdf of {count} columns as of {program}", columns, notes=(note,))
    return RawTable(
        table,
        unnamed=f"the meaning of the columns of a .gdf of {count} columns is unknown (4 are x, y, "
        "frame, particle; 5 are x, y, z, frame, particle; 7 and more are recognised by the "
        "brightness after x, y[, z] and whole numbers of frame and particle at the end); name "
        f"them, for example {_GDF_EXAMPLE}",
    )


def napari_columns(names: Iterable[object]) -> dict[str, str]:
    """Return our names of the columns track_id, t[, z], y, x; empty for other columns.

    Examples
    --------
    >>> napari_columns(["track_id", "t", "y", "x"])
    {'particle': 'track_id', 'frame': 't', 'y': 'y', 'x': 'x'}
    """
    given = set(names)
    if not {"track_id", "t", "y", "x"} <= given or given & {"frame", "particle"}:
        return {}
    found = {"particle": "track_id", "frame": "t", "z": "z", "y": "y", "x": "x"}
    return {ours: name for ours, name in found.items() if name in given}


def napari_text(table: pd.DataFrame) -> str:
    r"""Return a clean track table as csv with the columns of napari's tracks, sorted by track.

    Examples
    --------
    >>> import pandas as pd
    >>> napari_text(pd.DataFrame({"frame": [4], "particle": [7], "x": [0.5], "y": [1.5]}))
    'track_id,t,y,x\n7,4,1.5,0.5\n'
    """
    names = {"particle": "track_id", "frame": "t", "z": "z", "y": "y", "x": "x"}
    kept = {ours: name for ours, name in names.items() if ours in table}
    rows = table.sort_values(["particle", "frame"], kind="stable")[list(kept)]
    text: str = rows.rename(columns=kept).to_csv(index=False, lineterminator="\n")
    return text


def _feature_names(values: Floats) -> tuple[str, ...]:
    """Return ("x", "y") or ("x", "y", "z") by the place of the brightness; () where uncertain."""
    count = values.shape[1]
    # The last two columns can be frames and ids where they are whole, and each pair occurs once.
    ends = values[:, -2:]
    if count < 7 or not len(values) or not (ends == np.floor(ends)).all():
        return ()
    if not np.isfinite(ends).all() or len(np.unique(ends, axis=0)) < len(ends):
        return ()
    typical = np.median(np.abs(values[:, :-2]), axis=0)
    bright = int(np.argmax(typical))
    if bright not in (2, 3) or typical[bright] < _BRIGHTER * typical[:bright].max():
        return ()
    if bright == 2 and count == 7:
        eccentricity = values[:, 4]
        flat = bool(((eccentricity >= 0) & (eccentricity <= 1)).all())
        return ("x", "y") if flat else ()
    return ("x", "y", "z") if bright == 3 else ()
