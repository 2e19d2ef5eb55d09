"""Spheres of several kinds, of which each channel shows one: one table of all of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from perrin._arrays import frozen
from perrin._text import listed
from perrin.movie.checks import Findings
from perrin.tracks.groups import TOUCHING_REACH

if TYPE_CHECKING:
    from collections.abc import Sequence

    import pandas as pd

    from perrin._arrays import Floats

    # Anything with shape, voxel and times of a stack.
    from perrin.images.stack import Stack


# Hard spheres do not overlap: two places nearer than this share of a contact are one sphere, which
# the filters of both channels let through.
_ONE_SPHERE = 0.8

# A sphere of full brightness has at least the mass that this share of its kind does not reach.
_FULL_BRIGHTNESS = 0.9

# Rounds of the robust fit of the offset; it converges in about five.
_OFFSET_ROUNDS = 20

# Tukey's biweight with 95 % efficiency, and the median absolute deviation of a normal distribution.
_BIWEIGHT, _NORMAL_DEVIATION = 4.685, 0.6745

# Pairs below which an offset is not measured: four unknowns, and a scatter.
_FEWEST_PAIRS = 8

# Above this share of the contact distance, pairs that touch may not be the nearest ones.
_LARGE_OFFSET = 0.15

# Most combinations of kinds that a note lists.
_LISTED_KINDS = 6


@dataclass(frozen=True, eq=False)
class ChannelOffset:
    """Constant shift of the images of one channel against those of the first.

    Attributes
    ----------
    value : ndarray, shape (d,)
        Shift, um.
    stderr : ndarray, shape (d,)
        Standard error, um.
    contact : float
        Distance of touching spheres of the two kinds, um.
    pairs : int
        Number of touching pairs, of all frames.
    """

    value: Floats
    stderr: Floats
    contact: float
    pairs: int

    def __post_init__(self) -> None:
        frozen(self.value, self.stderr)


def check_channels(stacks: Sequence[Stack]) -> list[str]:
    """Return why stacks are no channels of one movie: other voxels or other times.

    Parameters
    ----------
    stacks : sequence of Stack

    Returns
    -------
    list of str
        Empty, or a line for each fault.

    Examples
    --------
    >>> from perrin.images import open_stack
    >>> movie = np.zeros((3, 4, 8, 8))
    >>> red, green = (open_stack(movie[:n], voxel=(1, 1, 1), dt=0.5) for n in (3, 2))
    >>> check_channels([red, green])
    ['stack 1 has shape (2, 4, 8, 8), stack 0 has (3, 4, 8, 8): channels of one movie are equal']
    """
    first, faults = stacks[0], []
    for k, stack in enumerate(stacks[1:], 1):
        if stack.shape != first.shape:
            faults.append(
                f"stack {k} has shape {stack.shape}, stack 0 has {first.shape}: channels of one "
                "movie are equal"
            )
            continue
        if not np.allclose(stack.voxel, first.voxel, rtol=1e-6, equal_nan=True):
            faults.append(
                f"stack {k} has voxels {stack.voxel.tolist()} um, stack 0 has "
                f"{first.voxel.tolist()}: channels of one movie are equal"
            )
        late = np.abs(stack.times - first.times).max()
        if len(first) > 1 and not late < np.diff(first.times).min():
            faults.append(
                f"stack {k} begins its frames up to {late:.4g} s from those of stack 0, which are "
                f"{first.dt:.4g} s apart: channels of one movie show the same frames"
            )
    return faults


def one_of_each(features: pd.DataFrame, *, contact: float) -> pd.DataFrame:
    """Return the spheres without those that another channel shows too, and brighter.

    A filter lets some light of other dyes through. Of two places of different kinds within 0.8
    contacts, the one whose mass is the smaller share of that of full spheres of its kind is no
    sphere.

    Parameters
    ----------
    features : pandas.DataFrame
        Table of `locate` with the column ``kind``.
    contact : float
        Centre distance of touching spheres, um.

    Returns
    -------
    pandas.DataFrame

    Examples
    --------
    >>> import pandas as pd
    >>> table = pd.DataFrame(
    ...     {"frame": 0, "x": [0.0, 5.0, 0.1], "y": 0.0, "mass": [9.0, 8.0, 2.0], "kind": [0, 1, 1]}
    ... )
    >>> one_of_each(table, contact=2.0)["x"].tolist()
    [0.0, 5.0]
    """
    from scipy.spatial import cKDTree

    axes = [axis for axis in "xyz" if axis in features]
    full = features.groupby("kind")["mass"].quantile(_FULL_BRIGHTNESS)
    share = (features["mass"] / features["kind"].map(full)).fillna(0.0).to_numpy()
    kind = features["kind"].to_numpy()
    kept = np.ones(len(features), dtype=np.bool_)
    for rows in features.reset_index(drop=True).groupby("frame").indices.values():
        x = features[axes].to_numpy(dtype=np.float64)[rows]
        pairs = rows[cKDTree(x).query_pairs(_ONE_SPHERE * contact, output_type="ndarray")]
        pairs = pairs[kind[pairs[:, 0]] != kind[pairs[:, 1]]]
        dimmer = share[pairs[:, 0]] < share[pairs[:, 1]]
        kept[np.where(dimmer, pairs[:, 0], pairs[:, 1])] = False
    return features[kept].reset_index(drop=True)


def channel_offset(features: pd.DataFrame, kind: int, *, contact: float) -> ChannelOffset | None:
    """Return the constant shift of one channel against the first, from spheres that touch.

    The distance of two touching spheres of different kinds is the same in all directions once the
    shift is subtracted: distance and shift are those of the least scatter, by a robust fit (Tukey's
    biweight), as some pairs are only near.

    Parameters
    ----------
    features : pandas.DataFrame
        Table of `locate` with the column ``kind``.
    kind : int
        Kind of the spheres of this channel.
    contact : float
        Centre distance of touching spheres, um.

    Returns
    -------
    ChannelOffset or None
        None where fewer than eight pairs touch, or their directions do not determine a shift.

    Examples
    --------
    >>> import pandas as pd
    >>> rng = np.random.default_rng(1)
    >>> one, away = rng.uniform(0, 900, (60, 3)), rng.normal(size=(60, 3))
    >>> other = one + 2 * away / np.linalg.norm(away, axis=1)[:, None] + [0.1, 0.0, -0.2]
    >>> table = pd.DataFrame(np.concatenate([one, other]), columns=["x", "y", "z"])
    >>> table = table.assign(frame=0, kind=np.repeat([0, 1], 60))
    >>> channel_offset(table, 1, contact=2.0).value.round(3)
    array([ 0.1,  0. , -0.2])
    """
    from scipy.spatial import cKDTree

    axes = [axis for axis in "xyz" if axis in features]
    between = [np.empty((0, len(axes)))]
    for _, rows in features[features["kind"].isin([0, kind])].groupby("frame"):
        places = [rows.loc[rows["kind"] == k, axes].to_numpy(np.float64) for k in (0, kind)]
        if all(map(len, places)):
            near = cKDTree(places[0]).query_ball_tree(cKDTree(places[1]), TOUCHING_REACH * contact)
            between += [places[1][j] - places[0][i] for i, j in enumerate(near) if j]
    step = np.concatenate(between)
    shift, distance, weight = np.zeros(len(axes)), contact, np.ones(len(step))
    if len(step) < _FEWEST_PAIRS:
        return None
    for _ in range(_OFFSET_ROUNDS):
        apart = step - shift
        length = np.linalg.norm(apart, axis=1)
        slope = np.column_stack([apart / length[:, None], np.ones(len(step))])
        normal = slope.T @ (weight[:, None] * slope)
        if np.linalg.cond(normal) > 1e6:
            return None
        change = np.linalg.solve(normal, slope.T @ (weight * (length - distance)))
        shift, distance = shift + change[:-1], distance + change[-1]
        left = np.linalg.norm(step - shift, axis=1) - distance
        scatter = max(np.median(np.abs(left)) / _NORMAL_DEVIATION, 1e-9 * contact)
        weight = np.maximum(1 - (left / (_BIWEIGHT * scatter)) ** 2, 0.0) ** 2
    # Asymptotic covariance of the robust fit, from the pairs that have weight.
    u = (left / (_BIWEIGHT * scatter)) ** 2
    used = u < 1
    response = np.sum(((1 - u) * (1 - 5 * u))[used])
    variance = len(step) / (len(step) - len(axes) - 1) * np.sum((weight * left) ** 2) / response**2
    spread = np.linalg.inv(slope[used].T @ slope[used]) * used.sum()
    error = np.sqrt(np.diag(spread)[:-1] * variance)
    return ChannelOffset(shift, error, float(distance), int(used.sum()))


def joined_kinds(
    tables: Sequence[pd.DataFrame], *, contact: float
) -> tuple[pd.DataFrame, list[ChannelOffset | None], Findings]:
    """Join the spheres of all channels in the coordinates of the first.

    Parameters
    ----------
    tables : sequence of DataFrame
        Spheres of each channel, as `locate` returns them.
    contact : float
        Centre distance of touching spheres, um.

    Returns
    -------
    features : pandas.DataFrame
        All spheres, in the order of the frames, with the column ``kind``: number of the channel.
    offsets : list of ChannelOffset or None
        Shift of each channel but the first, which is subtracted; None where it is not measured.
    findings : Findings
        The shifts in words, and the number of places that two channels show.
    """
    import pandas as pd

    table = pd.concat(
        [one.assign(kind=np.int64(k)) for k, one in enumerate(tables)], ignore_index=True
    )
    features = one_of_each(table, contact=contact)
    features = features.sort_values(["frame", "kind"], kind="stable", ignore_index=True)
    axes = [axis for axis in "xyz" if axis in features]
    offsets, findings = [], Findings()
    double = len(table) - len(features)
    if double:
        findings += Findings(
            notes=(
                f"{double} places of {len(table)} are shown by two channels: they are spheres of "
                "the kind of which they have the larger share of the brightness",
            )
        )
    for kind in range(1, len(tables)):
        offset = channel_offset(features, kind, contact=contact)
        offsets.append(offset)
        if offset is None:
            text = (
                f"the offset of channel {kind} against channel 0 is not measured, as hardly any "
                "spheres of these kinds touch: a chromatic shift would change the shapes of "
                "clusters of both"
            )
            findings += Findings(notes=(text,))
            continue
        rows = features["kind"] == kind
        features.loc[rows, axes] = features.loc[rows, axes].to_numpy() - offset.value
        shifts = ", ".join(
            f"{1e3 * v:.0f} +- {max(1e3 * e, 0.1):.1g} nm along {axis}"
            for axis, v, e in zip(axes, offset.value, offset.stderr, strict=True)
        )
        text = (
            f"channel {kind} is offset against channel 0 by {shifts} ({offset.pairs} pairs of "
            f"touching spheres, {offset.contact:.4g} um apart): this is subtracted"
        )
        large = np.linalg.norm(offset.value) > _LARGE_OFFSET * contact
        findings += Findings((text,)) if large else Findings(notes=(text,))
    return features, offsets, findings


def kinds_of_clusters(features: pd.DataFrame) -> Findings:
    """Note which kinds of spheres the clusters have; warn of spheres that change their kind.

    Parameters
    ----------
    features : pandas.DataFrame
        As in `Imaging`, with the column ``kind``.

    Examples
    --------
    >>> import pandas as pd
    >>> table = {"frame": [0, 0, 1, 1], "particle": [0, 1, 0, 1], "kind": [0, 1, 0, 1]}
    >>> kinds_of_clusters(pd.DataFrame(table | {"cluster": 0})).notes
    ('1 cluster of 1 + 1 spheres of kinds 0, 1 (the column kind of features.parquet)',)
    """
    own = features[features["cluster"] >= 0]
    if not len(own):
        return Findings()
    counted = own.groupby(["cluster", "particle", "kind"]).size().rename("count").reset_index()
    usual = counted.sort_values("count").groupby(["cluster", "particle"]).tail(1)
    strange = int(counted["count"].sum() - usual["count"].sum())
    count = int(features["kind"].max()) + 1
    table = usual.groupby(["cluster", "kind"]).size().unstack(fill_value=0)
    table = table.reindex(columns=range(count), fill_value=0)
    sorts = table.value_counts()
    texts = [
        f"{n} cluster{'s' if n > 1 else ''} of {' + '.join(map(str, sort))}"
        for sort, n in sorts.head(_LISTED_KINDS).items()
    ]
    more = (
        f"; and {len(sorts) - _LISTED_KINDS} other combinations"
        if len(sorts) > _LISTED_KINDS
        else ""
    )
    numbers = listed(map(str, range(count)))
    text = (
        f"{'; '.join(texts)} spheres of kinds {numbers}{more} (the column kind of features.parquet)"
    )
    found = Findings(notes=(text,))
    if strange:
        found += Findings(
            (
                f"{strange} of {len(own)} spheres have another kind than their particle usually: "
                "labels are exchanged there, or a channel shows the light of the other kind",
            )
        )
    return found


def joined_frames(tables: Sequence[pd.DataFrame]) -> pd.DataFrame:
    """Return the table of frames of all channels, as in `Imaging`.

    Numbers of spots and spheres and grey levels are sums; of the share of saturated voxels it is
    the largest, of faults the first. A frame is a copy of another if it is in all channels.

    Parameters
    ----------
    tables : sequence of DataFrame
        That of each channel.

    Examples
    --------
    >>> import pandas as pd
    >>> one = {"frame": [0], "spots": [5], "spheres": [3], "level": [2.0], "saturated": [0.0]}
    >>> one = pd.DataFrame(one | {"fault": [""], "copy_of": [-1]})
    >>> joined_frames([one, one.assign(spheres=1)])["spheres"].tolist()
    [4]
    """
    joined = tables[0].copy()
    for more in tables[1:]:
        for name in ("spots", "spheres", "level"):
            joined[name] = joined[name].to_numpy() + more[name].to_numpy()
        joined["saturated"] = np.fmax(joined["saturated"], more["saturated"].to_numpy())
        joined["fault"] = np.where(joined["fault"] == "", more["fault"], joined["fault"])
        same = joined["copy_of"].to_numpy() == more["copy_of"].to_numpy()
        joined["copy_of"] = np.where(same, joined["copy_of"], -1)
    return joined


def joined_spots(tables: Sequence[pd.DataFrame], cuts: Sequence[float]) -> pd.DataFrame:
    """Return the spots of all channels, their masses in proportion to the mass cuts.

    Parameters
    ----------
    tables : sequence of DataFrame
        ``frame, mass`` of the spots of each channel.
    cuts : sequence of float
        Mass cut of each channel; 0 where no spot is cut.

    Examples
    --------
    >>> import pandas as pd
    >>> one, other = (pd.DataFrame({"frame": [0], "mass": [m]}) for m in (30.0, 8.0))
    >>> joined_spots([one, other], [20.0, 4.0])["mass"].tolist()
    [30.0, 40.0]
    """
    import pandas as pd

    scale = [cuts[0] / cut if cut and cuts[0] else 1.0 for cut in cuts]
    scaled = [t.assign(mass=t["mass"] * by) for t, by in zip(tables, scale, strict=True)]
    return pd.concat(scaled, ignore_index=True)
