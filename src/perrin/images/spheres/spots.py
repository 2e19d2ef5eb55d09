"""Which spots of a frame are spheres, and which of them have to be fitted together."""

from __future__ import annotations

import warnings
from dataclasses import asdict, dataclass, fields
from typing import TYPE_CHECKING, Any, TypedDict

import numpy as np

from perrin._arrays import PlainOptions, flag_fault, number_fault, numpy_to_python, refuse
from perrin.errors import PrecisionWarning
from perrin.geometry.shapes import pair_distances
from perrin.tracks.groups import TOUCHING_REACH, touching_groups

if TYPE_CHECKING:
    from collections.abc import Sequence

    from perrin._arrays import Floats, Ints
    from perrin.images.spheres.by_trackpy import Features


# Distance in contacts below which the images of two spheres overlap, with their blur.
_IMAGE_OVERLAP = 1.6

# Largest number of spheres in a chain of overlapping images that is fitted group by group.
_MAX_CHAIN = 16

# Least ratio of neighbouring masses that separates spheres from noise.
_CLEAR_GAP = 2.0

# Masses that are all within this ratio are all of spheres.
_SAME_MASS_RATIO = 4.0

# The mass cut follows the brightness of the spheres where it changes by more than this factor.
_FADED = 2.0

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
    cut = clear_mass_cut(mass)
    if cut is None:
        warnings.warn(
            f"the masses of the {mass.size} spots found have no clear gap between spheres and "
            "noise: all are kept; inspect their histogram and set minmass",
            PrecisionWarning,
            stacklevel=5,
        )
        return 0.0
    return cut


def clear_mass_cut(mass: Floats) -> float | None:
    """Return the mass cut of `mass_cut`, or None where there is no clear gap.

    Parameters
    ----------
    mass : ndarray
        Integrated brightness of spots.

    Examples
    --------
    >>> clear_mass_cut(np.array([1.0, 1.9, 3.5, 6.0])) is None
    True
    """
    ordered = np.sort(mass[mass > 0])
    if not ordered.size:
        return 0.0
    if ordered[-1] < _SAME_MASS_RATIO * ordered[0]:
        return float(ordered[0] / _SAME_MASS_RATIO)
    ratio = np.where(ordered[1:] > ordered[-1] / _FAINT_RATIO, ordered[1:] / ordered[:-1], 1.0)
    if ratio.max() < _CLEAR_GAP:
        return None
    k = int(ratio.argmax())
    return float(np.sqrt(ordered[k] * ordered[k + 1]))


@dataclass(frozen=True)
class Fading:
    """Brightness of the spheres in time and over the depth: bleaching, and light lost on the way.

    Attributes
    ----------
    frames : tuple of int
        Frames in which the brightness is known, in their order.
    light : tuple of float
        Brightness in these frames over that in the first of them.
    per_depth : float
        Logarithmic change of the brightness with z, 1/um.
    depth : float
        The z of the brightness above, um.

    Examples
    --------
    >>> bleached = Fading((0, 10), (1.0, 0.25))
    >>> bleached.at(5, np.zeros((1, 3)))
    array([0.5])
    """

    frames: tuple[int, ...]
    light: tuple[float, ...]
    per_depth: float = 0.0
    depth: float = 0.0

    def at(self, frame: int, centers: Floats) -> Floats:
        """Return the relative brightness (n,) of spheres at `centers` (n, 3) as (z, y, x), um.

        Between the known frames its logarithm is interpolated.
        """
        light = float(np.exp(np.interp(frame, self.frames, np.log(self.light))))
        return light * np.exp(self.per_depth * (centers[:, 0] - self.depth))

    def to_dict(self) -> dict[str, Any]:
        """Return the brightness for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, entry: dict[str, Any]) -> Fading:
        """Return the brightness that `to_dict` wrote."""
        frames, light = tuple(entry["frames"]), tuple(entry["light"])
        return cls(frames, light, entry["per_depth"], entry["depth"])


def find_fading(frames: Sequence[int], spots: Sequence[Features]) -> Fading | None:
    """Return how the brightness of the spheres changes in time and over the depth.

    Parameters
    ----------
    frames : sequence of int
        Frames from which it is learned.
    spots : sequence of Features
        The spots of each, noise among them.

    Returns
    -------
    Fading or None
        None where it changes by less than a factor of 2, which one mass cut for all frames serves,
        and where the masses of a frame have no clear gap between spheres and noise.

    Examples
    --------
    >>> from perrin.images.spheres.by_trackpy import Features
    >>> masses = [np.array([900.0, 1000.0, 1100.0]), np.array([1.0, 90.0, 100.0, 110.0])]
    >>> find_fading([0, 5], [Features(np.zeros((len(m), 3)), m) for m in masses]).light
    (1.0, 0.1)
    """
    number, light, depth, relative = [], [], [np.empty(0)], [np.empty(0)]
    for frame, found in zip(frames, spots, strict=True):
        cut = clear_mass_cut(found.mass)
        if cut is None:
            return None
        sphere = (found.mass >= cut) & (found.mass > 0)
        if sphere.any():
            number.append(frame)
            light.append(float(np.median(found.mass[sphere])))
            depth.append(found.centers[sphere, 0])
            relative.append(np.log(found.mass[sphere] / light[-1]))
    if not light:
        return None
    z, y = np.concatenate(depth), np.concatenate(relative)
    height = z - z.mean()
    slope = float(height @ y) / max(float(height @ height), 1e-300)
    if abs(slope) * float(np.ptp(z)) < np.log(_FADED):
        slope = 0.0
    if max(light) < _FADED * min(light) and slope == 0:
        return None
    return Fading(
        tuple(int(i) for i in number), tuple(m / light[0] for m in light), slope, float(z.mean())
    )


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
