"""Which spots of a frame are spheres, and which of them have to be looked at together."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from perrin.errors import PrecisionWarning
from perrin.tracks.clusters import REACH

if TYPE_CHECKING:
    from perrin._arrays import Floats, Ints


_IN_SIGHT = 1.6  # closer than this their images overlap, blur and all


_CROWD = 16  # spheres in a longer chain of overlapping images are a crowd


_CLEAR_GAP = 2.0  # ratio of neighbouring masses that parts spheres from noise


_ALIKE = 4.0  # masses all within this ratio are spheres all of them


_FAINT = 20.0  # a gap that much below the largest mass parts noise from noise


def mass_cut(mass: Floats) -> float:
    """Return the mass that parts spheres from noise: the middle of the widest gap in log mass.

    Masses all within a factor 4 are spheres; what other frames hold below a quarter of the least of
    them is noise.

    Warns
    -----
    PrecisionWarning
        Where masses differ more but no two neighbouring ones twofold; then nothing is cut.

    Examples
    --------
    >>> import numpy as np
    >>> round(mass_cut(np.array([100.0, 200.0, 300.0, 2.0e4, 2.5e4, 3.0e4])))
    2449
    """
    ordered = np.sort(mass[mass > 0])
    if not ordered.size:
        return 0.0
    if ordered[-1] < _ALIKE * ordered[0]:
        return float(ordered[0] / _ALIKE)
    ratio = np.where(ordered[1:] > ordered[-1] / _FAINT, ordered[1:] / ordered[:-1], 1.0)
    if ratio.max() < _CLEAR_GAP:
        warnings.warn(
            f"the masses of the {mass.size} spots found have no clear gap between spheres and "
            "noise: all are kept; look at their histogram and set minmass",
            PrecisionWarning,
            stacklevel=4,
        )
        return 0.0
    k = int(ratio.argmax())
    return float(np.sqrt(ordered[k] * ordered[k + 1]))


@dataclass(frozen=True, kw_only=True)
class Spots:
    """How spheres are distinguished from noise.

    Parameters
    ----------
    dark : bool
        Spheres are darker than the medium around them.
    minmass : float, optional
        Least integrated intensity of a sphere; by default the widest gap between spheres and noise.
    percentile : float
        Percentile of voxels that are too dim to be the centre of a sphere.
    border : bool
        Include spheres that the border of the stack cuts.
    """

    dark: bool = False
    minmass: float | None = None
    percentile: float = 95.0
    border: bool = True


def touching_together(centers: Floats, *, contact: float) -> list[Ints]:
    """Return the spheres of one frame as groups to be fitted together: chains of touching ones.

    Examples
    --------
    >>> import numpy as np
    >>> x = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.1], [0.0, 0.0, 9.0]])
    >>> [group.tolist() for group in touching_together(x, contact=1.0)]
    [[0, 1], [2]]
    """
    return _chains(centers, REACH * contact)


def groups_and_crowds(centers: Floats, *, contact: float) -> tuple[list[Ints], list[Ints]]:
    """Return the spheres of one frame as groups to be fitted together, and as crowds.

    A crowd is a chain of over 16 spheres whose images overlap (closer than 1.6 contacts): each
    stands in the light of some others, which stand in that of yet others.

    Examples
    --------
    >>> import numpy as np
    >>> pair, row = [[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]], [[9.0, 9.0, 1.5 * k] for k in range(20)]
    >>> groups, crowds = groups_and_crowds(np.array(pair + row), contact=1.0)
    >>> groups[0].tolist(), len(crowds[0])
    ([0, 1], 20)
    """
    chains = _chains(centers, _IN_SIGHT * contact)
    crowds = [chain for chain in chains if len(chain) > _CROWD]
    crowded = np.zeros(len(centers), dtype=np.bool_)
    crowded[np.concatenate([np.empty(0, dtype=np.int64), *crowds])] = True
    together = touching_together(centers, contact=contact)
    return [group for group in together if not crowded[group[0]]], crowds


def _chains(centers: Floats, reach: float) -> list[Ints]:
    from perrin.tracks.linking import touching_groups

    if not len(centers):
        return []
    label = touching_groups(centers, reach=reach, size=len(centers), smallest=1)
    return [np.flatnonzero(label == k) for k in range(label.max() + 1)]


def at_contact(centers: Floats, *, contact: float) -> Floats:
    """Return the group drawn together about its middle until neighbours touch, on average.

    Filtering drives the maxima of touching balls apart by a tenth; a fit starts nearer to the
    truth from here. Distances already below contact stay.

    Examples
    --------
    >>> import numpy as np
    >>> at_contact(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.1]]), contact=1.0)[:, 2].round(12)
    array([0.05, 1.05])
    """
    distance = np.linalg.norm(centers[:, None] - centers, axis=-1)
    near = distance[np.triu(distance < REACH * contact, 1)]
    scale = min(contact / near.mean(), 1.0) if near.size else 1.0
    middle = centers.mean(axis=0)
    return np.asarray(middle + scale * (centers - middle))
