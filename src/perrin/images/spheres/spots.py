"""Which spots of a frame are spheres, and which of them have to be fitted together."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, TypedDict

import numpy as np

from perrin._arrays import PlainOptions, flag_fault, number_fault, numpy_to_python, refuse
from perrin.errors import PrecisionWarning
from perrin.geometry.shapes import pair_distances
from perrin.tracks.groups import TOUCHING_REACH, touching_groups

if TYPE_CHECKING:
    from perrin._arrays import Floats, Ints


# Distance in contacts below which the images of two spheres overlap, with their blur.
_IMAGE_OVERLAP = 1.6

# Largest number of spheres in a chain of overlapping images that is fitted group by group.
_MAX_CHAIN = 16

# Least ratio of neighbouring masses that separates spheres from noise.
_CLEAR_GAP = 2.0

# Masses that are all within this ratio are all of spheres.
_SAME_MASS_RATIO = 4.0

# Ratio to the largest mass below which a gap separates noise from noise.
_FAINT_RATIO = 20.0


class SpotSettings(TypedDict, total=False):
    """Single keywords of `locate` that are fields of `Spots`."""

    dark: bool
    minmass: float | None
    percentile: float
    border: bool


@dataclass(frozen=True, kw_only=True)
class Spots(PlainOptions):
    """Which spots of a frame are taken for spheres.

    `dark` and `percentile` have no effect on 2-D movies that are refined by the model, where
    spots are centres of circular symmetry.

    Parameters
    ----------
    dark : bool
        Spheres are darker than their surroundings.
    minmass : float, optional
        Least integrated brightness of a sphere; by default the widest gap between spheres and
        noise.
    percentile : float
        Percentile of the grey levels below which a voxel is not the centre of a sphere; lower it
        where spheres fill the field.
    border : bool
        Spheres that the border of the stack cuts are located too, if their centre is inside. If
        they are left out, their intensity disturbs the fits of their neighbours, which `chi2`
        shows.

    Raises
    ------
    ValueError
        If a value is out of its range; all faults in one message.

    Examples
    --------
    >>> Spots(dark=True, percentile=80.0)
    Spots(dark=True, minmass=None, percentile=80.0, border=True)
    """

    dark: bool = False
    minmass: float | None = None
    percentile: float = 95.0
    border: bool = True

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        refuse(
            flag_fault("dark", self.dark)
            + ([] if self.minmass is None else number_fault("minmass", self.minmass))
            + number_fault("percentile", self.percentile, least=0, below=100)
            + flag_fault("border", self.border)
        )
        numpy_to_python(self)


# The single keywords in place of the fields of `Spots`.
SPOT_KEYWORDS = tuple(field.name for field in fields(Spots))


def mass_cut(mass: Floats) -> float:
    """Return the mass that separates spheres from noise: the middle of the widest gap in log mass.

    Masses all within a factor of 4 are spheres; a quarter of the least of them then separates them
    from the noise of other frames.

    Parameters
    ----------
    mass : ndarray
        Integrated brightness of the spots of several frames.

    Returns
    -------
    float

    Warns
    -----
    PrecisionWarning
        Where masses differ by more but no two neighbouring ones by a factor of 2; then no spot is
        cut.

    Examples
    --------
    >>> import numpy as np
    >>> round(mass_cut(np.array([100.0, 200.0, 300.0, 2.0e4, 2.5e4, 3.0e4])))
    2449
    """
    ordered = np.sort(mass[mass > 0])
    if not ordered.size:
        return 0.0
    if ordered[-1] < _SAME_MASS_RATIO * ordered[0]:
        return float(ordered[0] / _SAME_MASS_RATIO)
    ratio = np.where(ordered[1:] > ordered[-1] / _FAINT_RATIO, ordered[1:] / ordered[:-1], 1.0)
    if ratio.max() < _CLEAR_GAP:
        warnings.warn(
            f"the masses of the {mass.size} spots found have no clear gap between spheres and "
            "noise: all are kept; inspect their histogram and set minmass",
            PrecisionWarning,
            stacklevel=4,
        )
        return 0.0
    k = int(ratio.argmax())
    return float(np.sqrt(ordered[k] * ordered[k + 1]))


def touching_together(
    centers: Floats, *, contact: float, reach: float = TOUCHING_REACH
) -> list[Ints]:
    """Return the spheres of one frame as groups: chains of touching spheres.

    Parameters
    ----------
    centers : ndarray, shape (n, d)
        Positions, um.
    contact : float
        Centre distance of touching spheres, um.
    reach : float
        Largest distance of neighbours in a chain, in contact distances.

    Returns
    -------
    list of ndarray of int
        Indices of the spheres of each group.

    Examples
    --------
    >>> import numpy as np
    >>> x = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.1], [0.0, 0.0, 9.0]])
    >>> [group.tolist() for group in touching_together(x, contact=1.0)]
    [[0, 1], [2]]
    """
    if not len(centers):
        return []
    label = touching_groups(centers, reach=reach * contact, size=len(centers), smallest=1)
    return [np.flatnonzero(label == k) for k in range(label.max() + 1)]


def groups_and_crowds(centers: Floats, *, contact: float) -> tuple[list[Ints], list[Ints]]:
    """Return the spheres of one frame as groups to be fitted together, and as crowds.

    A crowd is a chain of over 16 spheres whose images overlap (closer than 1.6 contacts), so that
    the image of each depends on some others, which depend on further ones.

    Parameters
    ----------
    centers : ndarray, shape (n, 3)
        Positions, um.
    contact : float
        Centre distance of touching spheres, um.

    Returns
    -------
    groups, crowds : list of ndarray of int
        Indices of the spheres of each.

    Examples
    --------
    >>> import numpy as np
    >>> pair, row = [[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]], [[9.0, 9.0, 1.5 * k] for k in range(20)]
    >>> groups, crowds = groups_and_crowds(np.array(pair + row), contact=1.0)
    >>> groups[0].tolist(), len(crowds[0])
    ([0, 1], 20)
    """
    chains = touching_together(centers, contact=contact, reach=_IMAGE_OVERLAP)
    crowds = [chain for chain in chains if len(chain) > _MAX_CHAIN]
    crowded = np.zeros(len(centers), dtype=np.bool_)
    crowded[np.concatenate([np.empty(0, dtype=np.int64), *crowds])] = True
    together = touching_together(centers, contact=contact)
    return [group for group in together if not crowded[group[0]]], crowds


def at_contact(centers: Floats, *, contact: float) -> Floats:
    """Return the group contracted about its centre until neighbours touch, on average.

    Filtering moves the maxima of touching spheres apart by a tenth; a fit starts nearer to the
    truth from here. Distances already below contact stay.

    Parameters
    ----------
    centers : ndarray, shape (n, 3)
        Positions, um.
    contact : float
        Centre distance of touching spheres, um.

    Returns
    -------
    ndarray, shape (n, 3)

    Examples
    --------
    >>> import numpy as np
    >>> at_contact(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.1]]), contact=1.0)[:, 2].round(12)
    array([0.05, 1.05])
    """
    distance = pair_distances(centers)
    near = distance[distance < TOUCHING_REACH * contact]
    scale = min(contact / near.mean(), 1.0) if near.size else 1.0
    middle = centers.mean(axis=0)
    return np.asarray(middle + scale * (centers - middle))
