"""Which particles travel together, and their positions as an array: pandas ends here."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from perrin._arrays import Bools, Floats, Ints, as_positions, present, require_positive
from perrin._text import listed
from perrin.errors import DegenerateClusterError, TooFewFramesError, TrackTableError
from perrin.motion.rods import track_direction
from perrin.tracks.bonds import rigid_groups
from perrin.tracks.identity import settle_identity
from perrin.tracks.linking import link_clusters

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    import pandas as pd
    from numpy.typing import ArrayLike


# The gap behind a touching neighbour: the next shell of a packing begins at 1.41 diameters.
REACH = 1.3


_LONGEST_SPAN = 1_000_000


_SPARSEST = 1000


def cluster_positions(
    table: pd.DataFrame, *, cluster: int | str | None = None
) -> tuple[Floats, Ints]:
    """Seat the tracks of one cluster in an array, one row per frame and one column per particle.

    Every frame from the cluster's first to its last is a row. A row of the table with a NaN
    coordinate counts as missing, as if it were not there. Particles keep the ids they came with.

    Parameters
    ----------
    table : pandas.DataFrame
        Tracks as `read_tracks` and `check_tracks` return them, coordinates in um.
    cluster : int or str, optional
        Which cluster, where the column ``cluster`` holds several. A table without that column is
        one cluster.

    Returns
    -------
    positions : ndarray, shape (T, n, d)
        Coordinates in um, NaN where missing; d is 3 where the table has a column ``z``, else 2.
        Particles are in the order of their ids.
    frames : ndarray of int64, shape (T,)
        The frame number of each row.

    Raises
    ------
    ValueError
        If the table holds several clusters and `cluster` does not say which, or not that one.
    TrackTableError
        If the table is not a clean track table, holds no coordinates, or has frame numbers so
        sparse that they look like times or ids.

    Examples
    --------
    >>> import pandas as pd
    >>> from perrin.tracks.clusters import cluster_positions
    >>> table = pd.DataFrame({"frame": [5, 7], "particle": [0, 0], "x": [1.0, 2.0], "y": 0.0})
    >>> positions, frames = cluster_positions(table)
    >>> frames
    array([5, 6, 7])
    >>> positions[:, 0, 0]
    array([ 1., nan,  2.])
    """
    tracks = _tracks(_one_cluster(table, cluster))
    rows = np.flatnonzero(tracks.seen)
    return _seats(tracks.frame[rows], tracks.code[rows], tracks.x[rows])


def each_cluster(table: pd.DataFrame) -> Iterator[tuple[int, Floats, Ints, Ints]]:
    """Yield cluster by cluster what `cluster_positions` returns, checking the table only once.

    Parameters
    ----------
    table : pandas.DataFrame
        Tracks with the column ``cluster`` (whole numbers, -1 for none) and perhaps ``piece``.

    Yields
    ------
    cluster : int
        Rising.
    positions : ndarray, shape (T, n, d)
    frames : ndarray of int64, shape (T,)
    piece : ndarray of int64, shape (T,)
        The column ``piece`` of each frame; where it is missing, that of the frame before.

    Raises
    ------
    TrackTableError
        As in `cluster_positions`.
    """
    # Ids need to be unique within a cluster only.
    unique = ["frame", "particle", "cluster"]
    tracks = _tracks(table, unique=unique)
    label = table["cluster"].to_numpy(dtype=np.int64)
    stretch = table["piece"].to_numpy(dtype=np.int64) if "piece" in table else None
    for inside in _rows_by_label(label):
        rows = inside[tracks.seen[inside]]
        positions, frames = _seats(tracks.frame[rows], tracks.code[rows], tracks.x[rows])
        piece = np.zeros(len(frames), dtype=np.int64)
        if stretch is not None:
            at = tracks.frame[rows] - frames[0]
            piece[at] = stretch[rows]
            last = np.zeros(len(frames), dtype=np.int64)
            last[at] = at
            piece = piece[np.maximum.accumulate(last)]
        yield int(label[inside[0]]), positions, frames, piece


def _seats(frame: Ints, code: Ints, x: Floats) -> tuple[Floats, Ints]:
    """Seat the detections of one cluster in an array, a row per frame from first to last."""
    ids = np.unique(code)
    first, last = _span(frame)
    positions = np.full((last - first + 1, len(ids), x.shape[1]), np.nan)
    positions[frame - first, np.searchsorted(ids, code)] = x
    return positions, np.arange(first, last + 1, dtype=np.int64)


def positions_table(positions: ArrayLike, *, frames: ArrayLike | None = None) -> pd.DataFrame:
    """Turn an array of positions into a track table of one cluster: undo `cluster_positions`.

    Parameters
    ----------
    positions : array_like, shape (T, n, d)
        um; points that are NaN have no row.
    frames : array_like of int, shape (T,), optional
        Frame numbers; default 0, 1, 2, ...

    Returns
    -------
    pandas.DataFrame
        frame, particle, x, y[, z], cluster (0).

    Examples
    --------
    >>> positions_table([[[0.0, 1.0], [2.0, 3.0]]])
       frame  particle    x    y  cluster
    0      0         0  0.0  1.0        0
    1      0         1  2.0  3.0        0
    """
    import pandas as pd

    x = as_positions(positions)
    row, particle = np.nonzero(present(x))
    number = np.arange(len(x)) if frames is None else np.asarray(frames, dtype=np.int64)
    columns: dict[str, Any] = {"frame": number[row], "particle": particle}
    columns |= {axis: x[row, particle, i] for i, axis in enumerate("xyz"[: x.shape[2]])}
    return pd.DataFrame(columns).assign(cluster=0)


def find_clusters(
    table: pd.DataFrame, *, contact: float | None = None, size: int | None = None
) -> pd.DataFrame:
    """Find which particles travel together and number the clusters they form.

    With `contact` two particles belong together when they are nearer than 1.3 times that in more
    than half of the frames that hold both, and at least 2 frames do; clusters are the connected
    groups. Without it they belong together when their distance stays constant within noise
    (`rigid_groups`): bodies may pass each other, and frames may be missing.

    Parameters
    ----------
    table : pandas.DataFrame
        Tracks as `read_tracks` and `check_tracks` return them, coordinates in um. A row with a NaN
        coordinate counts as missing. An existing ``cluster`` column is replaced; ids must be
        unique without it.
    contact : float, optional
        Centre distance of touching particles, um.
    size : int, optional
        Fewest particles of a cluster; default 3 (2 in two dimensions).

    Returns
    -------
    pandas.DataFrame
        The same table with the column ``cluster`` (int64): clusters are numbered from 0 in the
        order of their smallest particle id, particles of no cluster have -1.

    Raises
    ------
    ValueError
        If `contact` is not a positive number, or `size` no whole number of at least 2.
    TrackTableError
        If the table is not a clean track table.

    Examples
    --------
    >>> import pandas as pd
    >>> from perrin.tracks.clusters import find_clusters
    >>> table = pd.DataFrame({"frame": [0, 0, 0, 1, 1, 1], "particle": [1, 2, 3, 1, 2, 3],
    ...                       "x": [0.0, 1.0, 5.0, 0.1, 1.1, 5.0], "y": 0.0})
    >>> find_clusters(table, contact=1.0)["cluster"].tolist()
    [0, 0, -1, 0, 0, -1]
    """
    if contact is not None:
        require_positive(contact=contact)
    tracks = _tracks(table)
    smallest = min(3, tracks.x.shape[1]) if size is None else _whole(size)
    if contact is None:
        rows = np.flatnonzero(tracks.seen)
        columns = tracks.frame[rows], tracks.code[rows], tracks.x[rows]
        group = rigid_groups(*columns, count=tracks.n_particles, smallest=smallest)
        labels = np.searchsorted(np.unique(group[group >= 0]), group)
        labels = np.where(group >= 0, labels, -1)
    else:
        pairs = _lasting_pairs(tracks, REACH * contact)
        labels = _components(pairs, tracks.n_particles, smallest)
    return table.assign(cluster=labels[tracks.code])


def identify(table: pd.DataFrame, *, contact: float, size: int) -> pd.DataFrame:
    """Give detections without lasting ids a particle and a cluster that last.

    In every frame detections are grouped by touching (1.3 times `contact`), the centres of the
    groups are linked through time, and in each cluster particles are told apart by the rigid fit
    and least rotation (`settle_identity`). Missing and extra detections are allowed.

    Parameters
    ----------
    table : pandas.DataFrame
        Columns frame, x, y[, z], um, a row per detection; a column ``particle`` or ``cluster`` is
        not used and replaced. A row with a NaN coordinate counts as missing.
    contact : float
        Centre distance of touching particles, um.
    size : int
        Particles of a cluster.

    Returns
    -------
    pandas.DataFrame
        The same rows with ``particle``, ``cluster`` and ``piece`` (int64). Detections of no
        cluster, or whose place in it cannot be told, have ``cluster`` -1 and an id of their own.
        A new ``piece`` of a cluster begins where its particles (not the cluster) may have been
        mistaken; no step should join two pieces.

    Raises
    ------
    ValueError
        If `contact` is not a positive number, or `size` no whole number of at least 2.
    TrackTableError
        If the table is not clean.

    Examples
    --------
    >>> import numpy as np
    >>> from perrin import Cluster, add_noise, identify, positions_table, simulate_motion
    >>> truth = simulate_motion(Cluster.touching(4, 2.0), D_R=5e-3, dt=0.7, n_frames=50, rng=1)
    >>> x = add_noise(truth.positions(), sigma=0.02, rng=2)
    >>> raw = positions_table(x).sample(frac=1, random_state=0)[["frame", "x", "y", "z"]]
    >>> found = identify(raw, contact=2.0, size=4)
    >>> found.groupby(["cluster", "particle"]).size().tolist()
    [50, 50, 50, 50]
    """
    require_positive(contact=contact)
    size = _whole(size)
    tracks = _tracks(table.assign(particle=np.arange(len(table))))
    rows = np.flatnonzero(tracks.seen)
    frame, x = tracks.frame[rows], tracks.x[rows]
    cluster = link_clusters(frame, x, reach=REACH * contact, contact=contact, size=size)
    seat, piece = np.full(len(rows), -1, dtype=np.int64), np.zeros(len(rows), dtype=np.int64)
    for inside in _rows_by_label(cluster):
        seat[inside], piece[inside] = _settled(frame[inside], x[inside], size)
    out = np.full((3, len(table)), -1, dtype=np.int64)
    sure = seat >= 0
    out[0, rows[sure]] = cluster[sure] * size + seat[sure]
    out[1, rows[sure]] = cluster[sure]
    out[2, rows] = piece
    loose = np.flatnonzero(out[0] < 0)
    out[0, loose] = int(cluster.max(initial=-1) + 1) * size + np.arange(loose.size)
    return table.assign(particle=out[0], cluster=out[1], piece=np.maximum(out[2], 0))


def _whole(size: int) -> int:
    if not (np.ndim(size) == 0 and size == int(size) and size >= 2):
        raise ValueError(f"size: expected a whole number of particles, at least 2, got {size!r}")
    return int(size)


def _rows_by_label(label: Ints) -> Iterator[Ints]:
    """Yield the rows of each label but -1."""
    order = np.argsort(label, kind="stable")
    order = order[label[order] >= 0]
    if order.size:
        yield from np.split(order, np.flatnonzero(np.diff(label[order])) + 1)


def _settled(frame: Ints, x: Floats, size: int) -> tuple[Ints, Ints]:
    """Return the particle (0 to size - 1, or -1) and the piece of each detection of one cluster."""
    order = np.argsort(frame, kind="stable")
    times, row, counts = np.unique(frame[order], return_inverse=True, return_counts=True)
    column = np.arange(len(frame)) - np.repeat(np.cumsum(counts) - counts, counts)
    positions = np.full((len(times), size, x.shape[1]), np.nan)
    positions[row, column] = x[order]
    if size == 2 and x.shape[1] == 3:
        taken, piece = _ends_of(positions, times)
    else:
        found = settle_identity(positions, times=times, size=size, labelled=False)
        taken, piece = found.order, found.piece
    which = np.full((len(times), size), -1, dtype=np.int64)
    at, seat = np.nonzero(taken >= 0)
    which[at, taken[at, seat]] = seat
    out = np.empty((2, len(frame)), dtype=np.int64)
    out[:, order] = which[row, column], piece[row]
    return out[0], out[1]


def _ends_of(positions: Floats, times: Ints) -> tuple[Ints, Ints]:
    """Return the order of the two ends of a rod in every frame, and the pieces."""
    try:
        rod = track_direction(positions, dt=1.0, times=times.astype(np.float64), labelled=False)
    except (DegenerateClusterError, TooFewFramesError):
        return np.full(positions.shape[:2], -1), np.zeros(len(positions), dtype=np.int64)
    along = np.einsum("td,td->t", positions[:, 1] - positions[:, 0], rod.direction)
    order = np.where((along < 0)[:, None], [1, 0], [0, 1])
    return np.where(np.isfinite(along)[:, None], order, -1), rod.piece


class _Tracks(NamedTuple):
    """The columns of a table as arrays, one entry per row."""

    frame: Ints
    code: Ints
    x: Floats
    seen: Bools
    n_particles: int


def _tracks(table: pd.DataFrame, *, unique: Sequence[str] = ("frame", "particle")) -> _Tracks:
    """Return the columns as arrays; `code` numbers the particles in the order of their ids."""
    import pandas as pd

    _refuse_unclean(table, unique)
    axes = ["x", "y", "z"] if "z" in table else ["x", "y"]
    x = table[axes].to_numpy(dtype=np.float64, na_value=np.nan)
    code, ids = pd.factorize(table["particle"], sort=True)
    frame = table["frame"].to_numpy(dtype=np.int64)
    return _Tracks(frame, code.astype(np.int64), x, ~np.isnan(x).any(axis=1), len(ids))


def _refuse_unclean(table: pd.DataFrame, unique: Sequence[str]) -> None:
    """Raise for what would become a wrong number here, listing all faults."""
    missing = [name for name in ("frame", "particle", "x", "y") if name not in table]
    faults = [f"missing columns {', '.join(missing)}"] if missing else []
    faults += [
        f"{table[name].isna().sum()} rows without {name}"
        for name in ("frame", "particle")
        if name in table and table[name].isna().any()
    ]
    faults += [] if len(table) else ["no rows"]
    if not faults:
        faults = _value_faults(table, unique)
    if faults:
        raise TrackTableError(
            f"not a clean track table: {'; '.join(faults)}. check_tracks names the rows",
            tuple(faults),
        )


def _value_faults(table: pd.DataFrame, unique: Sequence[str]) -> list[str]:
    frame = table["frame"].to_numpy(dtype=np.float64)
    axes = [axis for axis in ("x", "y", "z") if axis in table]
    x = table[axes].to_numpy(dtype=np.float64, na_value=np.nan)
    counts = {
        "frame numbers that are not whole": (frame != np.round(frame)).sum(),
        "rows with an infinite coordinate": np.isinf(x).any(axis=1).sum(),
        "rows that repeat a particle in a frame": table.duplicated(list(unique)).sum(),
    }
    return [f"{count} {what}" for what, count in counts.items() if count]


def _one_cluster(table: pd.DataFrame, cluster: int | str | None) -> pd.DataFrame:
    """Return the rows of the cluster asked for, or of the only one there is."""
    if "cluster" not in table:
        if cluster is not None:
            raise ValueError(f"cluster = {cluster!r}: the table has no column cluster")
        return table
    labels = table["cluster"]
    present = sorted(labels[labels.notna() & (labels != -1)].unique().tolist())
    if cluster is None and len(present) == 1:
        cluster = present[0]
    if cluster not in present:
        asked = "expected cluster= one of these" if cluster is None else f"no cluster {cluster!r}"
        raise ValueError(f"{asked}; the table holds {_listed(present)}")
    return table[labels == cluster]


def _listed(labels: list[Any], limit: int = 20) -> str:
    if not labels:
        return "no cluster: every row is loose (-1 or missing)"
    return f"the {len(labels)} clusters {listed(map(repr, labels), most=limit)}"


def _span(frame: Ints) -> tuple[int, int]:
    """Return the first and last frame, refusing numbers that cannot be frames."""
    if not len(frame):
        raise TrackTableError("no row has coordinates; nothing to follow", ("no coordinates",))
    first, last = int(frame.min()), int(frame.max())
    span, distinct = last - first + 1, len(np.unique(frame))
    if span > max(_LONGEST_SPAN, _SPARSEST * distinct):
        fault = (
            f"frames run from {first} to {last}, a span of {span}, but only {distinct} of them "
            "occur: these numbers look like times or ids; number the frames 0, 1, 2, ..."
        )
        raise TrackTableError(fault, (fault,))
    return first, last


def _lasting_pairs(tracks: _Tracks, reach: float) -> Ints:
    """Return the pairs (P, 2) of codes that are near in over half of the frames they share."""
    found = [near[:, 0] * tracks.n_particles + near[:, 1] for near in _near_pairs(tracks, reach)]
    keys, n_near = np.unique(np.concatenate([np.empty(0, np.int64), *found]), return_counts=True)
    # One near frame can never be over half of two or more.
    keys, n_near = keys[n_near > 1], n_near[n_near > 1]
    pairs = np.stack(np.divmod(keys, tracks.n_particles), axis=1)
    lasting: Ints = pairs[2 * n_near > _shared_frames(tracks, pairs)]
    return lasting


def _near_pairs(tracks: _Tracks, reach: float) -> Iterator[Ints]:
    """Yield, for each frame, the pairs of codes (P, 2), smaller first, within `reach`."""
    from scipy.spatial import cKDTree

    order = np.lexsort((tracks.code, tracks.frame))
    order = order[tracks.seen[order]]
    starts = np.flatnonzero(np.diff(tracks.frame[order])) + 1
    for rows in np.split(order, starts):
        if len(rows) > 1:
            near = cKDTree(tracks.x[rows]).query_pairs(reach, output_type="ndarray")
            yield tracks.code[rows][near]


def _shared_frames(tracks: _Tracks, pairs: Ints) -> Ints:
    """Return in how many frames both particles of each pair are seen."""
    from scipy.sparse import csr_array

    frames, column = np.unique(tracks.frame[tracks.seen], return_inverse=True)
    code = tracks.code[tracks.seen]
    present = csr_array(
        (np.ones(len(code), dtype=np.int64), (code, column)),
        shape=(tracks.n_particles, max(len(frames), 1)),
    )
    shared = np.zeros(len(pairs), dtype=np.int64)
    # In parts, so that memory stays bounded however many pairs ever met.
    step = max(1, 500_000 // max(len(frames), 1))
    for i in range(0, len(pairs), step):
        one, other = pairs[i : i + step].T
        shared[i : i + step] = present[one].multiply(present[other]).sum(axis=1)
    return shared


def _components(pairs: Ints, n_particles: int, smallest: int) -> Ints:
    """Return the cluster of each code, -1 for groups of fewer than `smallest`."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    links = coo_array((np.ones(len(pairs)), tuple(pairs.T)), shape=(n_particles, n_particles))
    _, group = connected_components(links, directed=False)
    _, first, inverse, size = np.unique(
        group, return_index=True, return_inverse=True, return_counts=True
    )
    large = np.flatnonzero(size >= smallest)
    number = np.full(len(size), -1, dtype=np.int64)
    number[large[np.argsort(first[large])]] = np.arange(len(large))
    labels: Ints = number[inverse]
    return labels
