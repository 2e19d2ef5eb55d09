"""Which cluster every row of a table belongs to."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from perrin.errors import TrackTableError
from perrin.run.remarks import (
    CONSTANT_Z,
    Remarks,
    grouping_note,
    loose_particles_note,
    no_cluster_text,
    stretched_pairs_warning,
)
from perrin.tracks.bonds import stretch_of_pairs
from perrin.tracks.clusters import find_clusters

if TYPE_CHECKING:
    import pandas as pd


# With at most this number of particles in fewer than this number of frames, all particles of a
# table without a cluster column may be one body: distances in that few frames do not show it.
_PARTICLES_OF_ONE_BODY, _FRAMES_FOR_DISTANCES = 20, 8

# Particles whose distances are compared with those of another scale of z: 2016 pairs.
_PARTICLES_PAIRED = 64


def assign_clusters(
    table: pd.DataFrame, *, contact: float | None = None
) -> tuple[pd.DataFrame, dict[int, str], Remarks]:
    """Give every row of a table a cluster number.

    Parameters
    ----------
    table : pandas.DataFrame
        A clean track table. A column cluster of texts is numbered in the order of the texts, which
        ``attrs["labels"]`` then holds by number; the texts of numbered clusters are taken from it.
    contact : float, optional
        Centre distance of touching particles, um, for a table without that column. Without it
        clusters are found by the distances that stay the same; pairs where there is nothing larger.

    Returns
    -------
    table : pandas.DataFrame
        With a column cluster of whole numbers; -1 for particles that belong to none.
    labels : dict of int to str
        The texts by cluster number.
    remarks : Remarks

    Raises
    ------
    TrackTableError
        If no particle belongs to a cluster.

    Examples
    --------
    >>> import pandas as pd
    >>> table = pd.DataFrame({"frame": [0, 0], "particle": [0, 1], "cluster": ["knee", "foot"]})
    >>> assign_clusters(table)[0]["cluster"].tolist(), assign_clusters(table)[1]
    ([1, 0], {0: 'foot', 1: 'knee'})
    """
    import pandas as pd

    remarks = Remarks()
    if "z" in table and table["z"].min() == table["z"].max():
        remarks.warnings.append(CONSTANT_Z)
    labels: dict[int, str] = {}
    marked = "cluster" in table
    if marked and pd.api.types.is_numeric_dtype(table["cluster"]):
        table = table.assign(cluster=table["cluster"].to_numpy(dtype=np.int64))
        stated = table.attrs.get("labels", {})
        labels = {int(number): str(name) for number, name in stated.items()}
    elif marked:
        codes, names = pd.factorize(table["cluster"], sort=True)
        labels = {number: str(name) for number, name in enumerate(names)}
        table = table.assign(cluster=codes.astype(np.int64))
        table.attrs["labels"] = {str(number): name for number, name in labels.items()}
    else:
        count, frames = table["particle"].nunique(), table["frame"].nunique()
        if contact is None and frames < _FRAMES_FOR_DISTANCES and count <= _PARTICLES_OF_ONE_BODY:
            table = table.assign(cluster=0)
        else:
            found = find_clusters(table, contact=contact)
            none = (found["cluster"] == -1).all()
            table = find_clusters(table, contact=contact, size=2) if none else found
        if contact is None:
            remarks.notes.append(
                grouping_note(table["cluster"].to_numpy(dtype=np.int64), particles=count)
            )
    loose = table["cluster"] == -1
    stretched: list[str] = []
    if not marked and contact is None and 2 * loose.sum() >= len(table):
        stretched = stretch_warnings(table)
    if loose.all():
        raise TrackTableError("; ".join([no_cluster_text(contact, marked=marked), *stretched]))
    remarks.warnings.extend(stretched)
    if loose.any():
        remarks.notes.append(loose_particles_note(table.loc[loose, "particle"].nunique()))
    return table, labels, remarks


def stretch_warnings(table: pd.DataFrame) -> list[str]:
    """Warn where particles keep their distances with another scale of z.

    Parameters
    ----------
    table : pandas.DataFrame
        Columns frame, particle, x, y[, z]; the first 64 particles are compared.

    Examples
    --------
    >>> import pandas as pd
    >>> stretch_warnings(pd.DataFrame({"frame": [0], "particle": [0], "x": [0.0], "y": [0.0]}))
    []
    """
    if "z" not in table:
        return []
    seen = table.dropna(subset=["x", "y", "z"])
    some = seen[seen["particle"].isin(seen["particle"].unique()[:_PARTICLES_PAIRED])]
    if some.empty:
        return []
    wide = some.pivot_table(index="frame", columns="particle", values=["x", "y", "z"])
    x = wide.to_numpy(dtype=np.float64).reshape(len(wide), 3, -1).transpose(0, 2, 1)
    factor, pairs = stretch_of_pairs(x)
    return [stretched_pairs_warning(factor, pairs)] if pairs else []
