"""Where every sphere of a stack is, and how well that is known."""

from __future__ import annotations

import hashlib
import warnings
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol

import numpy as np

from perrin._arrays import Floats, require_positive
from perrin.errors import FrameError, PrecisionWarning
from perrin.images.optics.crowd_fit import CrowdFit, fit_crowd, piece_of
from perrin.images.optics.learn import CrowdSample, Sample, fit_samples, saturated_share
from perrin.images.optics.window_fit import FreeCenters, ImageFit, cut_window, fit_window
from perrin.images.spheres.by_trackpy import Features, find_features, refine_by_trackpy
from perrin.images.spheres.spots import at_contact, groups_and_crowds, mass_cut

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from typing import TypeAlias

    import pandas as pd
    from numpy.typing import NDArray

    from perrin._arrays import Ints
    from perrin.images.optics.optics import Optics

    Columns: TypeAlias = dict[str, NDArray[Any]]


Refine = Literal["model", "trackpy"] | None


_Voxel = tuple[float, float, float]


_LEARN_FRAMES = 5  # frames looked at to set the mass cut and to learn the optics


_LEARN_GROUPS = 15  # groups of spheres the optics are learned from


_LEARN_CROWDS = 2  # pieces of crowds the optics are learned from where there are no small groups


_PIECE = 30  # spheres in such a piece


# Why a sphere stays where it was found.
_CROWDED, _HIDDEN = "in a crowd", "no voxels of its own"


NO_FLAT_MODEL = (
    "the model of the image is that of a volume; in this 2-D movie places are filtered centroids: "
    "pass refine=None, or refine='trackpy' where spheres touch"
)


_UNSETTLED, _MOVED, _DARK = "fit did not settle", "moved over half a radius", "no light of its own"


class StackLike(Protocol):
    """What is asked of a movie: sizes, and one frame at a time."""

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """(t, z, y, x)."""

    @property
    def voxel(self) -> Floats | tuple[float, float, float]:
        """(z, y, x), um; z is NaN of a 2-D movie."""

    def frame(self, i: int, /) -> Floats:
        """Return frame i, (z, y, x)."""


@dataclass(frozen=True)
class Search:
    """What to look for.

    Attributes
    ----------
    diameter, contact : float
        Of the ball that is seen, and centre to centre of touching spheres, um.
    dark : bool
        Spheres are darker than what surrounds them.
    percentile : float
        Of voxels too dim to be a sphere's middle.
    minmass : float or None
        Least integrated brightness of a sphere; None is the widest gap.
    border : bool
        Also spheres cut by the stack's border.
    crowds : bool
        Also refine spheres in chains of over 16.
    """

    diameter: float
    contact: float
    dark: bool = False
    percentile: float = 95.0
    minmass: float | None = None
    border: bool = True
    crowds: bool = False

    def spots(self, frame: Floats, voxel: _Voxel) -> Features:
        """Return the spots of a frame, noise among them."""
        return find_features(
            frame,
            diameter=self.diameter,
            contact=self.contact,
            voxel=voxel,
            dark=self.dark,
            percentile=self.percentile,
            border=self.border,
        )

    def spheres(self, spots: Features) -> Features:
        """Return the spots of enough mass."""
        keep = spots.mass >= (self.minmass or 0.0)
        return Features(spots.centers[keep], spots.mass[keep])


class Sampled(NamedTuple):
    """A frame looked at to learn from, in the stack's own type, and its spots."""

    number: int
    frame: NDArray[Any]
    spots: Features


class Found(NamedTuple):
    """What one frame holds.

    Attributes
    ----------
    columns : dict of ndarray
        The frame's part of the table of `locate`.
    spots : int
        Before the mass cut.
    level : float
        Median grey level.
    saturated : float
        Share of the voxels that were clipped at the highest value.
    digest : str
        Of the voxels: equal for equal frames only.
    """

    columns: dict[str, NDArray[Any]]
    spots: int
    level: float
    saturated: float
    digest: str


@dataclass(frozen=True)
class Method:
    """How every frame is treated: the same for all, and each for itself.

    Attributes
    ----------
    search : Search
        With its mass cut.
    refine : {"model", "trackpy", None}
    optics : Optics or None
        For "model".
    """

    search: Search
    refine: Refine = "model"
    optics: Optics | None = None

    def look(self, stack: StackLike, i: int) -> Found:
        """Find and refine the spheres of frame i.

        Raises
        ------
        FrameError
            If the frame cannot be read.
        """
        data, voxel = np.asarray(stack.frame(i)), _voxel(stack)
        frame = _numbers(data, i)
        spots = self.search.spots(frame, voxel)
        columns = self._columns(frame, self.search.spheres(spots), voxel)
        columns = {"frame": np.full(len(columns["mass"]), i, dtype=np.int64)} | columns
        level = float(np.median(data))
        return Found(columns, len(spots.mass), level, saturated_share(data), frame_digest(data))

    def _columns(self, frame: Floats, found: Features, voxel: _Voxel) -> dict[str, NDArray[Any]]:
        contact = self.search.contact
        if self.refine == "model":
            columns = _by_model(frame, found, contact, self.optics, voxel)
            if self.optics is None or not self.search.crowds:
                return columns
            return _with_crowds(columns, frame, found, self.search, self.optics, voxel)
        centers = found.centers
        if self.refine == "trackpy":
            centers = refine_by_trackpy(
                frame, centers, diameter=self.search.diameter, contact=contact, voxel=voxel
            )
        places = _places(centers)
        if np.isnan(voxel[0]):
            del places["z"]
        return places | {"mass": found.mass}


def sample_frames(stack: StackLike, search: Search, frames: Sequence[int]) -> list[Sampled]:
    """Look at a few frames all over the movie, as far as they can be read.

    Raises
    ------
    FrameError
        If none of them can.
    """
    seen = []
    fault: FrameError | None = None
    for k in _spread(len(frames)):
        try:
            data = np.asarray(stack.frame(frames[k]))
            spots = search.spots(_numbers(data, frames[k]), _voxel(stack))
        except FrameError as error:
            fault = fault or error
            continue
        seen.append(Sampled(frames[k], data, spots))
    if fault is not None and not seen:
        raise fault
    return seen


def choose_method(
    stack: StackLike,
    search: Search,
    sample: Sequence[Sampled],
    *,
    refine: Refine = "model",
    optics: Optics | None = None,
) -> Method:
    """Set what was left open, mass cut and optics, from a few frames.

    Raises
    ------
    ValueError
        Where no sphere is found, or the optics do not settle.

    Warns
    -----
    PrecisionWarning
        As in `mass_cut`.
    """
    if search.minmass is None:
        masses = [seen.spots.mass for seen in sample]
        search = replace(search, minmass=mass_cut(np.concatenate([np.empty(0), *masses])))
    if refine == "model" and optics is None and not _crowded(sample, search):
        optics = fit_optics(sample, search, voxel=_voxel(stack))
    return Method(search, refine, optics if refine == "model" else None)


def locate(
    stack: StackLike,
    *,
    diameter: float,
    contact: float,
    refine: Refine = "model",
    optics: Optics | None = None,
    dark: bool = False,
    minmass: float | None = None,
    percentile: float = 95.0,
    border: bool = True,
    crowds: bool = False,
    frames: Iterable[int] | None = None,
) -> pd.DataFrame:
    """Find every sphere of a stack, and refine its place by the model of its image.

    Parameters
    ----------
    stack : Stack
        Anything with ``shape (t, z, y, x)``, ``voxel (z, y, x)`` in um and ``frame(i)``.
    diameter : float
        Of the ball that is seen, um: the whole sphere, or the fluorescent core of it.
    contact : float
        Centre distance of touching spheres, um. Spheres within 1.3 times that are fitted together.
    refine : {"model", "trackpy", None}
        "model" fits the ball blurred by the optics; "trackpy" its least-squares fit of discs;
        None leaves the filtered centroid, which is off by a tenth of the contact distance where
        balls touch.
    optics : Optics, optional
        How a sphere is seen; by default learned from a few frames (`fit_optics`).
    dark : bool
        Spheres are darker than what surrounds them.
    minmass : float, optional
        Least integrated brightness; by default the widest gap between spheres and noise.
    percentile : float
        Of voxels too dim to be a sphere's middle; lower it where spheres fill the field.
    border : bool
        Also spheres whose centre is inside the stack but which its border cuts; without them their
        neighbours' light is misread, which `chi2` shows.
    crowds : bool
        Also refine crowds, see the notes: some seconds for each of them in a frame. Otherwise they
        stay where they were found.
    frames : iterable of int, optional
        Frames to do; default all.

    Returns
    -------
    DataFrame
        ``frame, x, y, z`` (no z of a 2-D movie) in um, the origin at the centre of voxel (0, 0, 0),
        ``mass``; and for "model" ``sigma_x, sigma_y, sigma_z`` in um (from the Fisher information),
        ``chi2`` of the group's image per degree of freedom, and ``refined``: False where the fit
        did not settle, left by over half a radius, found no sphere, or was not tried, and the place
        found first was kept, without errors; `reason` says which of these. Of crowds see the notes.

    Raises
    ------
    ValueError
        For arguments that cannot be, or where the optics cannot be learned.
    ModuleNotFoundError
        Without trackpy.

    Warns
    -----
    PrecisionWarning
        Where a frame cannot be read: it is left out. Where the masses show no gap between spheres
        and noise. Where spheres stay where they were found: those of crowds, and what has no
        voxels to itself. Where the model is asked for in a 2-D movie.

    Notes
    -----
    More than 16 spheres in a chain, neighbours within 1.6 times `contact`, are a crowd. With
    `crowds` it is fitted until its image has nothing left over: spots that turn out to be no
    spheres are left out, and spheres that were missed are added, with a `mass` of NaN. Its `chi2`
    is that of each sphere's own voxels. Its background has a level of its own in every plane; what
    shines there without being a sphere is misread as one if it is bright enough.

    Examples
    --------
    >>> import numpy as np
    >>> from perrin.images.optics.ball_image import sphere_image
    >>> class Still:
    ...     shape, voxel = (1, 24, 32, 32), (0.25, 0.2, 0.2)
    ...     def frame(self, i):
    ...         ball = sphere_image(diameter=2.0, psf=(0.4, 0.15), voxel=self.voxel)
    ...         spot = ball.spot(np.array([3.01, 3.12, 3.23]), self.shape[1:])
    ...         light = np.full(self.shape[1:], 9.0)
    ...         light[spot.box] += 100 * spot.value
    ...         return np.random.default_rng(i).poisson(light)
    >>> found = locate(Still(), diameter=2.0, contact=2.0)
    >>> found[["x", "y", "z"]].round(1).values.tolist()
    [[3.2, 3.1, 3.0]]
    """
    search = Search(diameter, contact, dark, percentile, minmass, border, crowds)
    check_search(stack, search, refine, optics=optics)
    if refine == "model" and is_flat(stack):
        refine = None
        warnings.warn(NO_FLAT_MODEL, PrecisionWarning, stacklevel=2)
    listed = _listed(stack, frames)
    sample = sample_frames(stack, search, listed)
    method = choose_method(stack, search, sample, refine=refine, optics=optics)
    table = found_table(_looked(stack, listed, method))
    if refine == "model" and len(table):
        _warn_of_untried(table)
    return table


def _looked(stack: StackLike, frames: Sequence[int], method: Method) -> list[Found]:
    """Return what every frame holds; one that cannot be read is a warning."""
    found, faults = [], []
    for i in frames:
        try:
            found.append(method.look(stack, i))
        except FrameError as fault:
            faults.append(str(fault))
    if faults:
        warnings.warn(
            f"{len(faults)} of {len(frames)} frames are left out: {'; '.join(faults[:3])}"
            f"{f' and {len(faults) - 3} more' if len(faults) > 3 else ''}",
            PrecisionWarning,
            stacklevel=3,
        )
    return found


def fit_optics(sample: Sequence[Sampled], search: Search, *, voxel: _Voxel) -> Optics:
    """Learn the sphere's size in the light, the point spread and the noise from a few frames.

    Raises
    ------
    ValueError
        Where no sphere is found, or the search does not settle.
    """
    samples: list[Sample | CrowdSample] = []
    crowds: list[Sample | CrowdSample] = []
    for seen in sample:
        found = search.spheres(seen.spots)
        groups, crowded = groups_and_crowds(found.centers, contact=search.contact)
        samples += [_sample(seen.frame, found, group, search.contact) for group in groups]
        if search.crowds:
            crowds += [_piece(seen.frame, found, group, search, voxel) for group in crowded]
    most = _LEARN_GROUPS
    if sum(len(s.centers) for s in samples) < sum(len(s.centers) for s in crowds):
        samples, most = crowds, _LEARN_CROWDS
    learned = [samples[k] for k in _spread(len(samples), most)]
    return fit_samples(learned, diameter=search.diameter, voxel=voxel)


def _crowded(sample: Sequence[Sampled], search: Search) -> bool:
    """Return whether most spheres are in crowds that are not to be refined."""
    inside = outside = 0
    for seen in sample:
        found = search.spheres(seen.spots).centers
        groups, crowds = groups_and_crowds(found, contact=search.contact)
        inside, outside = inside + sum(map(len, crowds)), outside + sum(map(len, groups))
    return not search.crowds and inside > outside


def _by_model(
    frame: Floats, found: Features, contact: float, optics: Optics | None, voxel: _Voxel
) -> dict[str, NDArray[Any]]:
    """Fit every group of touching spheres; return the columns of the table."""
    centers, sigma = found.centers.copy(), np.full_like(found.centers, np.nan)
    chi2, reason = np.full(len(centers), np.nan), np.full(len(centers), _CROWDED, dtype=object)
    for group, fit in _fits(frame, found, contact, optics, voxel) if optics is not None else ():
        if fit is None:
            reason[group] = _HIDDEN
            continue
        chi2[group] = fit.chi2
        reason[group] = fit.doubts
        good = fit.doubts == ""
        centers[group[good]] = fit.centers[good]
        sigma[group[good]] = fit.sigma[good]
    columns = _places(centers) | {"mass": found.mass} | _places(sigma, "sigma_")
    return columns | {"chi2": chi2, "refined": reason == "", "reason": reason}


class _GroupFit(NamedTuple):
    """Refined spheres of one group: places and errors (n, 3), and why one is not to be believed."""

    centers: Floats
    sigma: Floats
    chi2: float
    doubts: NDArray[np.object_]


def _fits(
    frame: Floats, found: Features, contact: float, optics: Optics, voxel: _Voxel
) -> Iterator[tuple[Ints, _GroupFit | None]]:
    """Yield every group of touching spheres with its fit; None without enough voxels."""
    image = optics.image(voxel)
    for group in groups_and_crowds(found.centers, contact=contact)[0]:
        sample = _sample(frame, found, group, contact)
        window = cut_window(frame, image, sample.centers, others=sample.others)
        if not window.shows(len(group)):
            yield group, None
            continue
        fit = fit_window(window, image, optics.noise, FreeCenters(sample.centers))
        sigma = np.sqrt(np.diag(fit.covariance)).reshape(-1, 3)
        doubts = _doubts(fit, sample.centers, optics.diameter / 4)
        yield group, _GroupFit(fit.centers, sigma, fit.chi2, doubts)


def _doubts(fit: ImageFit, start: Floats, furthest: float) -> NDArray[np.object_]:
    """Return why each sphere of a fit is not to be believed; "" where it is."""
    moved = np.linalg.norm(fit.centers - start, axis=1) >= furthest
    dark = ~(fit.brightness / np.median(fit.brightness) > 0.1)
    why = np.where(dark, _DARK, np.where(moved, _MOVED, "")).astype(object)
    return why if fit.converged else np.full(len(start), _UNSETTLED, dtype=object)


def _with_crowds(
    columns: Columns,
    frame: Floats,
    found: Features,
    search: Search,
    optics: Optics,
    voxel: _Voxel,
) -> Columns:
    """Return the columns with the rows of every crowd replaced by those of its fit."""
    _, crowds = groups_and_crowds(found.centers, contact=search.contact)
    for group in crowds:
        crowd = fit_crowd(
            frame,
            found.centers[group],
            others=np.delete(found.centers, group, axis=0),
            contact=search.contact,
            image=optics.image(voxel),
            noise=optics.noise,
        )
        last = (np.array(frame.shape) - 1) * np.array(voxel)
        theirs = _crowd_columns(crowd, found.centers[group], found.mass[group], search, last)
        columns = {k: np.concatenate([columns[k], theirs[k]]) for k in columns}
    stays = np.ones(len(columns["mass"]), dtype=np.bool_)
    stays[np.concatenate([np.empty(0, dtype=np.int64), *crowds])] = False
    return {k: column[stays] for k, column in columns.items()}


def _crowd_columns(
    crowd: CrowdFit, start: Floats, mass: Floats, search: Search, last: Floats
) -> Columns:
    """Return the columns of a crowd that was found at `start`, in a stack that ends at `last`.

    A sphere whose fit did not settle stays where it was found first, or is left out where it was
    not; without `border` so is one that the border cuts.
    """
    first = crowd.origin >= 0
    good = crowd.settled & np.isfinite(crowd.sigma).all(axis=1)
    centers = np.where(good[:, None], crowd.centers, start[crowd.origin])
    sigma = np.where(good[:, None], crowd.sigma, np.nan)
    margin = 0.0 if search.border else search.diameter / 2
    kept = np.all((centers >= margin) & (centers <= last - margin), axis=1) & (good | first)
    columns = _places(centers) | {"mass": np.where(first, mass[crowd.origin], np.nan)}
    columns |= _places(sigma, "sigma_") | {"chi2": crowd.chi2, "refined": good}
    columns["reason"] = np.where(good, "", _UNSETTLED).astype(object)
    return {k: column[kept] for k, column in columns.items()}


def _warn_of_untried(table: pd.DataFrame) -> None:
    untried = int(table["chi2"].isna().sum())
    if untried:
        warnings.warn(
            f"{untried} of {len(table)} spheres touch in chains of over 16 (crowds=True refines "
            "them) or have no voxels to themselves: they stay where found, some hundredths of a "
            "sphere off, up to a tenth; the column `reason` says which",
            PrecisionWarning,
            stacklevel=3,
        )


def _sample(frame: Floats, found: Features, group: Ints, contact: float) -> Sample:
    others = np.delete(found.centers, group, axis=0)
    return Sample(frame, at_contact(found.centers[group], contact=contact), others)


def _piece(
    frame: NDArray[Any], found: Features, group: Ints, search: Search, voxel: _Voxel
) -> CrowdSample:
    piece, centers = piece_of(frame, found.centers[group], voxel, count=_PIECE)
    return CrowdSample(piece, centers, np.empty((0, 3)), search.contact)


def _numbers(data: NDArray[Any], i: int) -> Floats:
    """Return a frame as floats; voxels without a number would be bright or dark by chance."""
    frame = np.asarray(data, dtype=np.float64)
    lost = int(np.count_nonzero(~np.isfinite(frame)))
    if lost:
        raise FrameError(f"frame {i} has {lost} voxels without a number (NaN or infinite)", i)
    return frame


def frame_digest(data: NDArray[Any]) -> str:
    """Return a digest of the voxels of a frame."""
    return hashlib.blake2b(np.ascontiguousarray(data).tobytes(), digest_size=16).hexdigest()


def is_flat(stack: StackLike) -> bool:
    """Return whether a movie is two-dimensional: one plane, of no height."""
    return bool(np.isnan(stack.voxel[0]))


def _places(centers: Floats, prefix: str = "") -> dict[str, NDArray[Any]]:
    return {f"{prefix}{axis}": centers[:, k] for axis, k in zip("xyz", (2, 1, 0), strict=True)}


def found_table(found: Iterable[Found]) -> pd.DataFrame:
    """Return what frames hold as the table of `locate`."""
    import pandas as pd

    parts = [pd.DataFrame(f.columns) for f in found]
    if not parts:
        return pd.DataFrame(columns=["frame", "x", "y", "z", "mass"])
    return pd.concat(parts, ignore_index=True)


def _voxel(stack: StackLike) -> _Voxel:
    z, y, x = (float(h) for h in stack.voxel)
    return z, y, x


def _spread(count: int, wanted: int = _LEARN_FRAMES) -> list[int]:
    """Return up to so many indices, evenly over 0 ... count - 1."""
    return sorted(set(np.linspace(0, count - 1, min(wanted, count)).round().astype(int).tolist()))


def _listed(stack: StackLike, frames: Iterable[int] | None) -> list[int]:
    listed = list(range(stack.shape[0])) if frames is None else [int(i) for i in frames]
    outside = [i for i in listed if not 0 <= i < stack.shape[0]]
    if outside:
        raise ValueError(
            f"frames: expected 0 to {stack.shape[0] - 1}, as the stack has {stack.shape[0]}, got "
            f"{', '.join(map(str, outside[:5]))}"
        )
    return listed


def check_search(
    stack: StackLike, search: Search, refine: Refine, *, optics: Optics | None = None
) -> None:
    """Raise one error with every fault of the arguments of a search."""
    if len(stack.shape) != 4:
        raise ValueError(f"stack: expected shape (t, z, y, x), got {stack.shape}")
    require_positive(diameter=search.diameter, contact=search.contact)
    faults = _size_faults(stack, search, optics)
    if refine not in ("model", "trackpy", None):
        faults.append(f"refine: expected 'model', 'trackpy' or None, got {refine!r}")
    if search.diameter > 1.2 * search.contact:
        faults.append(
            f"diameter {search.diameter} um is more than contact {search.contact} um: balls do not "
            "overlap; are the two exchanged?"
        )
    if not 0 <= search.percentile < 100:
        faults.append(f"percentile: expected 0 <= percentile < 100, got {search.percentile}")
    if faults:
        raise ValueError("; ".join(faults))


def _size_faults(stack: StackLike, search: Search, optics: Optics | None) -> list[str]:
    """Return what does not fit into the stack or between its voxels: lengths in another unit.

    Windows, masks and tables grow with the cube of the diameter in voxels: this comes before any
    of them. Two touching spheres are seen together where the stack's diagonal is longer than
    `contact`; half a voxel is far below what any microscope shows as a sphere.
    """
    voxel = np.asarray(stack.voxel, dtype=np.float64)
    there = np.isfinite(voxel)
    voxel, extent = voxel[there], (np.array(stack.shape[1:]) * voxel)[there]
    spheres = {"diameter": search.diameter}
    if optics is not None:
        spheres["optics: diameter"] = optics.diameter
        spheres["optics: point spread"] = max(optics.psf)
    faults = [
        f"{name} {length:g} um does not fit into the stack"
        for name, length in spheres.items()
        if length > extent.min()
    ]
    if search.diameter < voxel.max() / 2:
        faults.append(f"diameter {search.diameter:g} um is less than half a voxel")
    if search.contact > np.linalg.norm(extent):
        faults.append(f"contact {search.contact:g} um is longer than the stack's diagonal")
    if not faults:
        return []
    axes = "z, y, x" if there.all() else "y, x"
    return [
        f"{', '.join(faults)}: the stack is {_lengths(extent)} um ({axes}), its voxels are "
        f"{_lengths(voxel)} um; are the lengths in um?"
    ]


def _lengths(values: Floats) -> str:
    return " x ".join(f"{value:.4g}" for value in values)
