"""Which particles travel together, and their positions as an array."""

from __future__ import annotations

import warnings
from contextlib import suppress
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from perrin._arrays import (
    Bools,
    Floats,
    Ints,
    as_positions,
    number_fault,
    present,
    refuse,
    require_positive,
)
from perrin._text import counted, frames_text, listed
from perrin.errors import (
    DegenerateClusterError,
    IdentityWarning,
    TooFewFramesError,
    TrackTableError,
)
from perrin.motion.rods import track_direction
from perrin.tracks.bonds import rigid_groups
from perrin.tracks.groups import (
    TOUCHING_REACH,
    are_distinct,
    connected_groups,
    coordinates,
    near_pairs,
)
from perrin.tracks.identity import settle_identity
from perrin.tracks.linking import link_clusters

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    import pandas as pd
    from numpy.typing import ArrayLike

# Frame numbers that span more than this, and more than this multiple of the frames that occur, are
# times or ids.
_LONGEST_SPAN, _SPARSEST_FRAMES = 1_000_000, 1000


def cluster_positions(
    table: pd.DataFrame, *, cluster: int | str | None = None
) -> tuple[Floats, Ints]:
    """Return the tracks of one cluster as an array, one row per frame and one column per particle.

    Every frame from the cluster's first to its last is a row. A row of the table with a NaN
    coordinate counts as missing. Particles keep their ids.

    Parameters
    ----------
    table : pandas.DataFrame
        Tracks as `read_tracks` and `check_tracks` return them, coordinates in um.
    cluster : int or str, optional
        Number or name of the cluster, where the column ``cluster`` holds several. A table without
        that column is one cluster.

    Returns
    -------
    positions : ndarray, shape (T, n, d)
        Coordinates in um, NaN where missing; d is 3 where the table has a column ``z``, else 2.
        Particles are in the order of their ids.
    frames : ndarray of int64, shape (T,)
        Frame number of each row.

    Raises
    ------
    ValueError
        If the table holds several clusters and `cluster` is none of them or not given.
    TrackTableError
        If the table is not a clean track table, holds no coordinates, or has sparse frame numbers
        that look like times or ids.

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
    if "cluster" in table:
        labels = table["cluster"]
        known = sorted(labels[labels.notna() & (labels != -1)].unique().tolist())
        chosen = known[0] if cluster is None and len(known) == 1 else cluster
        if chosen not in known:
            wanted = (
                "expected cluster= one of these" if chosen is None else f"no cluster {chosen!r}"
            )
            held = "no cluster: every row is loose (-1 or missing)"
            if known:
                held = f"the {len(known)} clusters {listed(map(repr, known), most=20)}"
            raise ValueError(f"{wanted}; the table holds {held}")
        table = table[labels == chosen]
    elif cluster is not None:
        raise ValueError(f"cluster = {cluster!r}: the table has no column cluster")
    columns = _columns_of(table)
    rows = np.flatnonzero(columns.seen)
    return _as_array(columns.frame[rows], columns.code[rows], columns.x[rows])


def each_cluster(table: pd.DataFrame) -> Iterator[tuple[int, Floats, Ints, Ints, Floats | None]]:
    """Yield the positions of each cluster, checking the table only once.

    Parameters
    ----------
    table : pandas.DataFrame
        Tracks with the column ``cluster`` (whole numbers, -1 for none) and perhaps ``piece`` and
        ``delay`` (time of a particle after that of its frame, s).

    Yields
    ------
    cluster : int
        Number of the cluster; clusters come in the order of their numbers.
    positions : ndarray, shape (T, n, d)
    frames : ndarray of int64, shape (T,)
    piece : ndarray of int64, shape (T,)
        The column ``piece`` of each frame; where it is missing, that of the frame before.
    delay : ndarray, shape (T, n), or None
        The column ``delay``, NaN where a particle is missing; None without it.

    Raises
    ------
    TrackTableError
        As in `cluster_positions`.

    Examples
    --------
    >>> table = positions_table([[[0.0, 1.0], [2.0, 3.0]]], frames=[7])
    >>> [(cluster, x.shape, frames) for cluster, x, frames, *_ in each_cluster(table)]
    [(0, (1, 2, 2), array([7]))]
    """
    # Ids need to be unique within a cluster only.
    unique = ["frame", "particle", "cluster"]
    tracks = _columns_of(table, unique=unique)
    label = table["cluster"].to_numpy(dtype=np.int64)
    late = table["delay"].to_numpy(dtype=np.float64)[:, None] if "delay" in table else None
    stretch = table["piece"].to_numpy(dtype=np.int64) if "piece" in table else None
    every = bool(tracks.seen.all())
    for inside in _rows_by_label(label):
        rows = inside if every else inside[tracks.seen[inside]]
        frame, code = tracks.frame.take(rows), tracks.code.take(rows)
        positions, frames = _as_array(frame, code, tracks.x.take(rows, axis=0))
        piece = np.zeros(len(frames), dtype=np.int64)
        if stretch is not None:
            position = frame - frames[0]
            piece[position] = stretch[rows]
            last = np.zeros(len(frames), dtype=np.int64)
            last[position] = position
            piece = piece[np.maximum.accumulate(last)]
        delay = None if late is None else _as_array(frame, code, late[rows])[0][..., 0]
        yield int(label[inside[0]]), positions, frames, piece, delay


def _as_array(frame: Ints, code: Ints, x: Floats) -> tuple[Floats, Ints]:
    """Return the detections of one cluster as an array, a row per frame from first to last.

    Numbers that cannot be frames are refused.
    """
    if not len(frame):
        raise TrackTableError("no row has coordinates", ("no coordinates",))
    first, last = int(frame.min()), int(frame.max())
    span = last - first + 1
    if span > _LONGEST_SPAN and span > _SPARSEST_FRAMES * (distinct := len(np.unique(frame))):
        fault = (
            f"frames run from {first} to {last}, a span of {span}, but only {distinct} of them "
            "occur: these numbers look like times or ids; number the frames 0, 1, 2, ..."
        )
        raise TrackTableError(fault, (fault,))
    frames = np.arange(first, last + 1, dtype=np.int64)
    if len(frame) % span == 0:
        # Every particle in every frame, in order: the rows are those of the array.
        table, codes = frame.reshape(span, -1), code.reshape(span, -1)
        if (
            (codes[0, 1:] > codes[0, :-1]).all()
            and (codes == codes[0]).all()
            and (table == frames[:, None]).all()
        ):
            return x.reshape(*codes.shape, -1), frames
    # The columns are the particles that occur, in the order of their numbers.
    number = code - code.min()
    occurs = np.zeros(int(number.max()) + 1, dtype=np.bool_)
    occurs[number] = True
    column = np.cumsum(occurs) - 1
    positions = np.full((span, int(column[-1]) + 1, x.shape[1]), np.nan)
    positions[frame - first, column[number]] = x
    return positions, frames


def positions_table(positions: ArrayLike, *, frames: ArrayLike | None = None) -> pd.DataFrame:
    """Return the track table of one cluster, the inverse of `cluster_positions`.

    Parameters
    ----------
    positions : array_like, shape (T, n, d)
        Positions, um; points that are NaN have no row.
    frames : array_like of int, shape (T,), optional
        Frame numbers; default 0, 1, 2, ...

    Returns
    -------
    pandas.DataFrame
        Columns frame, particle, x, y[, z] and cluster (0).

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
        Smallest number of particles of a cluster; default 3 (2 in two dimensions).

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
    from scipy.sparse import csr_array

    if contact is not None:
        require_positive(contact=contact)
    if size is not None:
        refuse(number_fault("size", size, least=2, whole=True))
    tracks = _columns_of(table)
    smallest = min(3, tracks.x.shape[1]) if size is None else size
    count = tracks.n_particles
    if contact is None:
        rows = np.flatnonzero(tracks.seen)
        columns = tracks.frame[rows], tracks.code[rows], tracks.x[rows]
        group = rigid_groups(*columns, count=count, smallest=smallest)
        first = np.unique(group[group >= 0])
        labels = np.where(group >= 0, np.searchsorted(first, group), -1)
    else:
        # Pairs that are near each other in over half of the frames they share; one near frame can
        # never be over half of two or more.
        frame, code, x = tracks.frame[tracks.seen], tracks.code[tracks.seen], tracks.x[tracks.seen]
        pairs, n_near = near_pairs(frame, code, x, reach=TOUCHING_REACH * contact, fewest=2)
        frames, column = np.unique(frame, return_inverse=True)
        present_in = csr_array(
            (np.ones(len(code), dtype=np.int64), (code, column)),
            shape=(count, max(len(frames), 1)),
        )
        shared = np.zeros(len(pairs), dtype=np.int64)
        # In parts, so that memory stays bounded for any number of pairs.
        step = max(1, 500_000 // max(len(frames), 1))
        for i in range(0, len(pairs), step):
            one, other = pairs[i : i + step].T
            shared[i : i + step] = present_in[one].multiply(present_in[other]).sum(axis=1)
        pairs = pairs[2 * n_near > shared]
        group = connected_groups(pairs[:, 0], pairs[:, 1], count=count)
        _, first, inverse, members = np.unique(
            group, return_index=True, return_inverse=True, return_counts=True
        )
        large = np.flatnonzero(members >= smallest)
        number = np.full(len(members), -1, dtype=np.int64)
        number[large[np.argsort(first[large])]] = np.arange(len(large))
        labels = number[inverse]
    return table.assign(cluster=labels[tracks.code])


def identify(table: pd.DataFrame, *, contact: float, size: int) -> pd.DataFrame:
    """Give detections without lasting ids a particle and a cluster that last.

    In every frame touching detections (nearer than 1.3 times `contact`) are grouped, the centres of
    the groups are linked through time, and in each cluster particles are distinguished by the rigid
    fit and least rotation (`settle_identity`). Missing and extra detections are allowed.

    Parameters
    ----------
    table : pandas.DataFrame
        Columns frame, x, y[, z], um, a row per detection; a column ``particle`` or ``cluster`` is
        not used, but replaced. A row with a NaN coordinate counts as missing.
    contact : float
        Centre distance of touching particles, um.
    size : int
        Number of particles of a cluster.

    Returns
    -------
    pandas.DataFrame
        The same rows with ``particle``, ``cluster`` and ``piece`` (int64). Detections of no
        cluster, or whose particle is unknown, have ``cluster`` -1 and an id of their own.
        A new ``piece`` of a cluster begins where its particles (not the cluster) may have been
        mistaken; no step should join two pieces.

    Raises
    ------
    ValueError
        If `contact` is not a positive number, or `size` no whole number of at least 2.
    TrackTableError
        If the table is not clean.

    Warns
    -----
    IdentityWarning
        Where the table has a column ``particle`` and its labels pass from one of the particles
        found to another; the message states how many labels, and in which frames.

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
    refuse(number_fault("size", size, least=2, whole=True))
    columns = _columns_of(table.assign(particle=np.arange(len(table))))
    rows = np.flatnonzero(columns.seen)
    frame, x = columns.frame[rows], columns.x[rows]
    reach = TOUCHING_REACH * contact
    cluster = link_clusters(frame, x, reach=reach, contact=contact, size=size)
    own, piece = np.full(len(rows), -1, dtype=np.int64), np.zeros(len(rows), dtype=np.int64)
    for inside in _rows_by_label(cluster):
        own[inside], piece[inside] = particles_and_pieces(frame[inside], x[inside], size)
    known = own >= 0
    particle = np.full(len(table), -1, dtype=np.int64)
    particle[rows[known]] = cluster[known] * size + own[known]
    if "particle" in table:
        given = table["particle"].to_numpy()[rows[known]]
        found, part = particle[rows[known]], piece[known]
        order = np.lexsort((frame[known], part, found))
        same = (np.diff(found[order]) == 0) & (np.diff(part[order]) == 0)
        passed = order[1:][same & (given[order[1:]] != given[order[:-1]])]
        if passed.size:
            warnings.warn(
                f"identity: {counted(passed.size, 'label', 'pass')} to another particle, in "
                f"{frames_text(np.unique(frame[known][passed]))}; they are corrected",
                IdentityWarning,
                stacklevel=2,
            )
    loose = np.flatnonzero(particle < 0)
    particle[loose] = int(cluster.max(initial=-1) + 1) * size + np.arange(loose.size)
    in_cluster = np.full(len(table), -1, dtype=np.int64)
    in_cluster[rows[known]] = cluster[known]
    in_piece = np.zeros(len(table), dtype=np.int64)
    in_piece[rows] = piece
    return table.assign(particle=particle, cluster=in_cluster, piece=in_piece)


def _rows_by_label(label: Ints) -> Iterator[Ints]:
    """Yield the rows of each label but -1."""
    order = np.argsort(label, kind="stable")
    order = order[label[order] >= 0]
    if order.size:
        yield from np.split(order, np.flatnonzero(np.diff(label[order])) + 1)


def particles_and_pieces(frame: Ints, x: Floats, size: int) -> tuple[Ints, Ints]:
    """Distinguish the particles of one body by the rigid fit and least rotation.

    Parameters
    ----------
    frame : ndarray of int, shape (N,)
        Frame number of each detection.
    x : ndarray, shape (N, d)
        Coordinates of each detection, um; no NaN. Of a pair no frame holds a third detection.
    size : int
        Number of particles of the body.

    Returns
    -------
    particle : ndarray of int, shape (N,)
        0 to size - 1, or -1 where it is unknown.
    piece : ndarray of int, shape (N,)
        A new piece begins where the particles may have been mistaken.

    Examples
    --------
    >>> x = np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 3.0]])
    >>> frame = np.repeat(np.arange(3), 3)
    >>> particles_and_pieces(frame, np.concatenate([x, x[::-1], x]), 3)[0].tolist()
    [0, 1, 2, 2, 1, 0, 0, 1, 2]
    """
    order = np.argsort(frame, kind="stable")
    times, row, counts = np.unique(frame[order], return_inverse=True, return_counts=True)
    column = np.arange(len(frame)) - np.repeat(np.cumsum(counts) - counts, counts)
    width = max(size, int(counts.max()))
    positions = np.full((len(times), width, x.shape[1]), np.nan)
    positions[row, column] = x[order]
    if size == 2 and x.shape[1] == 3:
        taken, piece = np.full((len(times), width), -1), np.zeros(len(times), dtype=np.int64)
        with suppress(DegenerateClusterError, TooFewFramesError):
            rod = track_direction(positions, dt=1.0, times=times.astype(np.float64), labelled=False)
            along = np.einsum("td,td->t", positions[:, 1] - positions[:, 0], rod.direction)
            ends = np.where((along < 0)[:, None], [1, 0], [0, 1])
            taken, piece = np.where(np.isfinite(along)[:, None], ends, -1), rod.piece
    else:
        found = settle_identity(positions, times=times, size=size, labelled=False)
        taken, piece = found.order, found.piece
    particle = np.full((len(times), width), -1, dtype=np.int64)
    filled, number = np.nonzero(taken >= 0)
    particle[filled, taken[filled, number]] = number
    out = np.empty((2, len(frame)), dtype=np.int64)
    out[:, order] = particle[row, column], piece[row]
    return out[0], out[1]


class _Columns(NamedTuple):
    """The columns of a track table as arrays, one entry per row.

    `code` numbers the particles in the order of their ids; `seen` marks rows with coordinates.
    """

    frame: Ints
    code: Ints
    x: Floats
    seen: Bools
    n_particles: int


def _columns_of(table: pd.DataFrame, *, unique: Sequence[str] = ("frame", "particle")) -> _Columns:
    """Return the columns as arrays; a table that is not clean is refused, with all faults."""
    import pandas as pd

    missing = [name for name in ("frame", "particle", "x", "y") if name not in table]
    faults = [f"missing columns {', '.join(missing)}"] if missing else []
    for name in ("frame", "particle"):
        absent = int(table[name].isna().sum()) if name in table else 0
        faults += [f"{counted(absent, 'row')} without {name}"] if absent else []
    faults += [] if len(table) else ["no rows"]
    if not faults:
        x = coordinates(table)
        broken = 0
        if table["frame"].dtype.kind not in "iu":
            number = table["frame"].to_numpy(dtype=np.float64)
            broken = int(np.count_nonzero(number != np.round(number)))
        infinite = np.logical_or.reduce([np.isinf(axis) for axis in x.T])
        distinct = are_distinct([table[name].to_numpy() for name in unique])
        counts = {
            "frame numbers that are not whole": broken,
            "rows with an infinite coordinate": np.count_nonzero(infinite),
            "rows that repeat a particle in a frame": 0
            if distinct
            else table.duplicated(list(unique)).sum(),
        }
        faults = [f"{count} {what}" for what, count in counts.items() if count]
    if faults:
        raise TrackTableError(
            f"not a clean track table: {'; '.join(faults)}. check_tracks names the rows",
            tuple(faults),
        )
    code, ids = pd.factorize(table["particle"], sort=True)
    frame = table["frame"].to_numpy(dtype=np.int64)
    return _Columns(frame, code.astype(np.int64), x, present(x), len(ids))
