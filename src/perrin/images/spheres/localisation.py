"""Positions of every sphere of a stack, and their standard errors."""

from __future__ import annotations

import hashlib
import warnings
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Unpack

import numpy as np

from perrin._arrays import (
    Floats,
    choice_fault,
    number_fault,
    options_from,
    refuse,
    refuse_unknown,
)
from perrin._text import listed
from perrin.errors import FrameError, NoSpheresError, PrecisionWarning
from perrin.images.optics.clipping import floor_share, saturated_share
from perrin.images.optics.crowd_fit import CrowdFit, crowd_piece, fit_crowd
from perrin.images.optics.learn import LearnedOptics, fit_samples
from perrin.images.optics.pixel_pattern import find_pixel_pattern, pixel_offsets, without_pattern
from perrin.images.optics.samples import CrowdSample, GroupSample, UsualImage
from perrin.images.optics.window_fit import FreeCenters, fit_window
from perrin.images.spheres.by_trackpy import Features, find_features, refine_by_trackpy
from perrin.images.spheres.circles import circle_cut, find_circles
from perrin.images.spheres.planar import learn_plane, plane_columns
from perrin.images.spheres.shells import find_shells
from perrin.images.spheres.spots import (
    SPOT_KEYWORDS,
    Fading,
    Spots,
    SpotSettings,
    at_contact,
    find_fading,
    groups_and_crowds,
    mass_cut,
    touching_together,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from typing import TypeAlias

    import pandas as pd
    from numpy.typing import NDArray

    from perrin._arrays import Ints
    from perrin.images.optics.ball_image import SphereImage
    from perrin.images.optics.optics import CameraNoise, Optics
    from perrin.images.optics.point_spread import PointSpread, StackLike
    from perrin.images.optics.radial_image import RadialImage

    Columns: TypeAlias = dict[str, NDArray[Any]]


Refine = Literal["model", "trackpy"] | None
_Voxel = tuple[float, float, float]

# Number of frames from which the mass cut and the optics are learned, and of those of a plane.
_LEARNING_FRAMES, _LEARNING_PLANES = 5, 15

# Number of groups of spheres, or of pieces of crowds, from which the optics are learned.
_LEARNING_GROUPS, _LEARNING_CROWDS = 15, 2

# Largest number of spots that are fitted as one group where there is dust among them.
_LARGEST_GROUP = 40

# Largest number of spots of a group that is fitted with spheres that were not found.
_LARGEST_CUT_GROUP = 8

# Largest number of touching spheres that trackpy's least squares fit at once, in seconds.
_MOST_BY_TRACKPY = 16

# Number of spheres in a piece of a crowd.
_PIECE_SPHERES = 30

# Reason of spots whose image is not that of one sphere, by its shape or its brightness.
NO_SPHERE = "not the image of a sphere"
_DOUBLE = "nearer than 0.8 contact distances to a sphere that fits better"

# Hard spheres do not overlap; the distribution of their sizes and errors are far below a fifth.
_LEAST_APART = 0.8

# Reasons for which a sphere is not refined.
_IN_A_CROWD, _NO_OWN_VOXELS = "in a crowd", "no voxels of its own"
_NOT_CONVERGED, _MOVED, _DARK = (
    "fit did not settle",
    "moved over half a radius",
    "no light of its own",
)


@dataclass(frozen=True)
class Search:
    """Options of a search for spheres.

    Attributes
    ----------
    diameter : float
        Diameter of the fluorescent sphere, um.
    contact : float
        Centre distance of touching spheres, um.
    dark : bool
        Spheres are darker than their surroundings.
    percentile : float
        Percentile of the grey levels below which a voxel is not the centre of a sphere.
    minmass : float or None
        Least integrated brightness of a sphere; None is the widest gap.
    border : bool
        Spheres that the border of the stack cuts are located too.
    crowds : bool
        Spheres in chains of over 16 are refined too.
    circles : bool
        Spots are centres of circular symmetry, bright or dark: in a 2-D movie for the model.
    psf : PointSpread or None
        A point spread that was measured; None learns it with the optics.

    Examples
    --------
    >>> Search(2.45, 2.5, dark=True).crowds
    False
    """

    diameter: float
    contact: float
    dark: bool = False
    percentile: float = 95.0
    minmass: float | None = None
    border: bool = True
    crowds: bool = False
    circles: bool = False
    psf: PointSpread | None = None

    @classmethod
    def of(
        cls,
        stack: StackLike,
        spots: Spots,
        *,
        diameter: float,
        contact: float,
        refine: Refine,
        crowds: bool,
        psf: PointSpread | None = None,
    ) -> Search:
        """Return the search that options of spots state; in a 2-D movie it is for circles."""
        return cls(
            diameter=diameter,
            contact=contact,
            dark=spots.dark,
            percentile=spots.percentile,
            minmass=spots.minmass,
            border=spots.border,
            crowds=crowds,
            circles=refine == "model" and is_flat(stack),
            psf=psf,
        )

    def spots(self, frame: Floats, voxel: _Voxel) -> Features:
        """Return the spots of a frame, noise among them."""
        if self.circles:
            margin = 0.0 if self.border else self.diameter / 2
            return find_circles(frame[0], contact=self.contact, pixel=voxel[1:], margin=margin)
        return find_features(
            frame,
            diameter=self.diameter,
            contact=self.contact,
            voxel=voxel,
            dark=self.dark,
            percentile=self.percentile,
            border=self.border,
        )

    def shells(self, frame: Floats, voxel: _Voxel) -> Features:
        """Return the centres of fluorescent surfaces in a frame, noise among them."""
        return find_shells(
            frame,
            diameter=self.diameter,
            contact=self.contact,
            voxel=voxel,
            border=self.border,
        )

    def spheres(self, spots: Features, light: Floats | float = 1.0) -> Features:
        """Return the spots of at least the least mass, times the relative brightness at each."""
        keep = spots.mass >= (self.minmass or 0.0) * light
        return Features(spots.centers[keep], spots.mass[keep])


class SampledFrame(NamedTuple):
    """A frame from which the method is learned.

    Attributes
    ----------
    number : int
        Number of the frame in the stack.
    frame : ndarray, shape (nz, ny, nx)
        Grey levels, in the stack's own type.
    spots : Features
        The spots of the frame, noise among them.
    """

    number: int
    frame: NDArray[Any]
    spots: Features


class LocatedFrame(NamedTuple):
    """The spheres of one frame.

    Attributes
    ----------
    columns : dict of ndarray
        The rows of this frame in the table of `locate`.
    spots : int
        Number of spots before the mass cut.
    level : float
        Median grey level.
    saturated : float
        Fraction of voxels that are clipped at the highest grey level.
    digest : str
        Digest of the voxels, which only equal frames share.
    """

    columns: dict[str, NDArray[Any]]
    spots: int
    level: float
    saturated: float
    digest: str


@dataclass(frozen=True)
class Method:
    """The treatment of every frame: the same for all frames, each frame independently.

    Attributes
    ----------
    search : Search
        Options of the search, with the mass cut.
    refine : {"model", "trackpy", None}
        How positions are refined.
    optics : Optics or None
        The optics for refinement by the model.
    fading : Fading or None
        Brightness that the mass cut follows; None is the same cut in all frames.
    usual : UsualImage or None
        What the images of the spheres have in common; None accepts every image.
    radial : RadialImage or None
        The image of a sphere of a 2-D movie for refinement by the model.
    pattern : ndarray, shape (ny, nx), or None
        Offsets of the pixels of the camera, which are subtracted from every plane for the fits.
    """

    search: Search
    refine: Refine = "model"
    optics: Optics | None = None
    fading: Fading | None = None
    usual: UsualImage | None = None
    radial: RadialImage | None = None
    pattern: Floats | None = field(default=None, compare=False)

    def spots(self, frame: Floats, voxel: _Voxel) -> Features:
        """Return the spots of a frame, noise among them; of shells the centres of surfaces."""
        if self.optics is not None and self.optics.shell:
            return self.search.shells(frame, voxel)
        return self.search.spots(frame, voxel)

    def spheres(self, spots: Features, frame: int) -> Features:
        """Return the spots of a frame that pass the mass cut."""
        if self.fading is None:
            return self.search.spheres(spots)
        return self.search.spheres(spots, self.fading.at(frame, spots.centers))

    def locate_in(
        self, stack: StackLike, i: int, *, known: SampledFrame | None = None
    ) -> LocatedFrame:
        """Find and refine the spheres of frame i.

        Parameters
        ----------
        stack : Stack
        i : int
            Number of the frame.
        known : SampledFrame, optional
            The frame with its spots, where the method was learned from it; its spots are not
            searched for again unless the method searches for shells.

        Returns
        -------
        LocatedFrame

        Raises
        ------
        FrameError
            If the frame cannot be read.
        """
        data, voxel = np.asarray(stack.frame(i)), _voxel_size(stack)
        frame = _finite_frame(data, i)
        shells = self.optics is not None and self.optics.shell
        spots = self.spots(frame, voxel) if known is None or shells else known.spots
        found = self.spheres(spots, i)
        if self.radial is not None:
            columns = plane_columns(
                frame[0], found, contact=self.search.contact, image=self.radial, pixel=voxel[1:]
            )
        elif self.refine == "model":
            light = 1.0 if self.fading is None else self.fading.at(i, found.centers)
            frame = without_pattern(data, self.pattern)
            columns, crowds = group_columns(
                frame, found, self.search, self.optics, voxel, usual=self.usual, light=light
            )
            columns = with_crowds(
                columns, frame, found, self.search, voxel, crowds=crowds, usual=self.usual
            )
            columns = without_doubles(columns, contact=self.search.contact)
        else:
            centers = found.centers.copy()
            if self.refine == "trackpy":
                lengths = {"diameter": self.search.diameter, "contact": self.search.contact}
                few, _ = _trackpy_groups(centers, contact=self.search.contact)
                centers[few] = refine_by_trackpy(frame, centers[few], voxel=voxel, **lengths)
            columns = _axis_columns(centers) | {"mass": found.mass}
            if np.isnan(voxel[0]):
                del columns["z"]
        columns = {"frame": np.full(len(columns["mass"]), i, dtype=np.int64)} | columns
        level = float(np.median(data))
        return LocatedFrame(
            columns, len(spots.mass), level, saturated_share(data), frame_digest(data)
        )


def sample_frames(stack: StackLike, search: Search, frames: Sequence[int]) -> list[SampledFrame]:
    """Return a few frames all over the movie with their spots, as far as they can be read.

    Parameters
    ----------
    stack : Stack
    search : Search
    frames : sequence of int
        The frames among which they are chosen.

    Returns
    -------
    list of SampledFrame

    Raises
    ------
    FrameError
        If none of them can be read.
    """
    sample = []
    fault: FrameError | None = None
    most = _LEARNING_PLANES if search.circles else _LEARNING_FRAMES
    for k in _evenly_spaced(len(frames), most):
        try:
            data = np.asarray(stack.frame(frames[k]))
            spots = search.spots(_finite_frame(data, frames[k]), _voxel_size(stack))
        except FrameError as error:
            fault = fault or error
            continue
        sample.append(SampledFrame(frames[k], data, spots))
    if fault is not None and not sample:
        raise fault
    return sample


def choose_method(
    stack: StackLike,
    search: Search,
    sample: Sequence[SampledFrame],
    *,
    refine: Refine = "model",
    optics: Optics | None = None,
) -> Method:
    """Learn what was not stated, mass cut and optics, from a few frames.

    Parameters
    ----------
    stack : Stack
    search : Search
    sample : sequence of SampledFrame
    refine : {"model", "trackpy", None}
    optics : Optics, optional

    Returns
    -------
    Method

    Raises
    ------
    ValueError
        Where no sphere is found, or the search for the optics does not converge.

    Warns
    -----
    PrecisionWarning
        As in `mass_cut`.
    """
    if search.circles:
        if search.minmass is None:
            masses = [sampled.spots.mass for sampled in sample]
            search = replace(search, minmass=circle_cut(np.concatenate([np.empty(0), *masses])))
        radial = learn_plane(
            [np.asarray(sampled.frame[0], dtype=np.float64) for sampled in sample],
            [search.spheres(sampled.spots).centers[:, 1:] for sampled in sample],
            contact=search.contact,
            pixel=_voxel_size(stack)[1:],
        )
        return Method(search, refine, radial=radial)
    voxel = _voxel_size(stack)
    if refine == "model" and optics is not None and optics.shell:
        return _with_mass_cut(Method(search, refine, optics), _of_shells(sample, search, voxel))
    method = _with_mass_cut(Method(search, refine, optics if refine == "model" else None), sample)
    if refine == "trackpy":
        _refuse_trackpy_in_crowds(
            [method.spheres(s.spots, s.number).centers for s in sample], contact=search.contact
        )
    if refine != "model":
        return method
    if optics is None:
        in_crowds = in_groups = 0
        for sampled in sample:
            found = method.spheres(sampled.spots, sampled.number).centers
            groups, crowds = groups_and_crowds(found, contact=search.contact)
            in_crowds += sum(map(len, crowds))
            in_groups += sum(map(len, groups))
        # Where most spheres are in crowds that are not to be refined, no optics are needed.
        if search.crowds or in_crowds <= in_groups:
            return _with_optics(method, sample, Method(search), voxel)
    return method


def _with_mass_cut(method: Method, sample: Sequence[SampledFrame]) -> Method:
    """Return a method with the mass cut that the spots of some frames show, if none is stated."""
    if method.search.minmass is not None:
        return method
    fading = find_fading([seen.number for seen in sample], [seen.spots for seen in sample])
    masses = [seen.spots.mass for seen in sample]
    if fading is not None:
        masses = [m.spots.mass / fading.at(m.number, m.spots.centers) for m in sample]
    cut = mass_cut(np.concatenate([np.empty(0), *masses]))
    return replace(method, search=replace(method.search, minmass=cut), fading=fading)


def _of_shells(sample: Sequence[SampledFrame], search: Search, voxel: _Voxel) -> list[SampledFrame]:
    """Return sampled frames with the spots of spheres whose surface is fluorescent."""
    return [
        seen._replace(spots=search.shells(np.asarray(seen.frame, dtype=np.float64), voxel))
        for seen in sample
    ]


def _with_optics(
    method: Method, sample: Sequence[SampledFrame], stated: Method, voxel: _Voxel
) -> Method:
    """Return a method with the optics that some frames show; `stated` is without its mass cut.

    Where the spots are no balls, or their surface alone is fluorescent, spots are searched for anew
    as surfaces.
    """
    floor = max(floor_share(seen.frame) for seen in sample)
    if floor > 0:
        warnings.warn(
            f"clipped at the floor: {100 * floor:.0f} % of the voxels have the lowest grey level, "
            "as the offset of the camera is set too low or a background was subtracted; they are "
            "left out of the fits of a volume, so that positions are less exact and distances of "
            "touching spheres are up to 0.2 % wrong: record with a higher offset",
            PrecisionWarning,
            stacklevel=4,
        )
    pixels = find_pixel_pattern([seen.frame for seen in sample])
    if pixels.significant:
        pattern = pixel_offsets([seen.frame for seen in sample])
        method, stated = replace(method, pattern=pattern), replace(stated, pattern=pattern)
        warnings.warn(
            f"pixel pattern: the background of pixels differs by {pixels.offset:.2g} grey levels "
            f"(rms) in all planes and frames, the noise of a voxel is {pixels.noise:.2g}; the "
            f"offsets that {len(sample)} frames show are subtracted for the fits, and the stated "
            "errors contain what is left: correct the movie by dark and flat frames of the camera",
            PrecisionWarning,
            stacklevel=4,
        )
    try:
        learned = fit_optics(sample, method, voxel=voxel)
        if not learned.optics.shell:
            return replace(method, optics=learned.optics, usual=learned.usual)
        fault = NoSpheresError(
            "the images at the places found are neither those of balls nor of shells that a point "
            "spread of limited size blurs: in a stack of a wide-field microscope, without pinhole "
            "or light sheet, every plane has light from all depths, and spheres above each other "
            "cannot be separated; the diameter or the contact may be wrong as well. Record with "
            "optical sectioning, or keep the positions found first (refine=None)"
        )
    except NoSpheresError as error:
        fault = error
    if method.search.dark:
        raise fault
    shells = _of_shells(sample, method.search, voxel)
    with warnings.catch_warnings():
        # The spots may be no spheres, of which the masses then say nothing.
        warnings.simplefilter("ignore", PrecisionWarning)
        method = _with_mass_cut(stated, shells)
    try:
        learned = fit_optics(shells, method, voxel=voxel, shell=True)
    except NoSpheresError:
        raise fault from None
    return replace(method, optics=learned.optics, usual=learned.usual)


def _trackpy_groups(centers: Floats, *, contact: float) -> tuple[Ints, int]:
    """Return the spheres in chains that trackpy's fit can solve, and the longest chain of all."""
    groups = touching_together(centers, contact=contact)
    few = [group for group in groups if len(group) <= _MOST_BY_TRACKPY]
    rows = np.sort(np.concatenate([np.empty(0, dtype=np.int64), *few]))
    return rows, max(map(len, groups), default=0)


def _refuse_trackpy_in_crowds(places: Sequence[Floats], *, contact: float) -> None:
    """Raise an error if most spheres of some frames are in groups too large for trackpy."""
    groups = [_trackpy_groups(x, contact=contact) for x in places]
    most = sum(len(few) for few, _ in groups) > sum(map(len, places)) / 2
    if not most and any(map(len, places)):
        raise ValueError(
            f'refine="trackpy" fits all spheres that touch at once: chains of up to '
            f"{max(largest for _, largest in groups)} in this movie, over its limit of "
            f'{_MOST_BY_TRACKPY}, as its time grows with their cube; refine="model" is '
            "made for them, None keeps the positions found first"
        )


def locate(
    stack: StackLike,
    *,
    diameter: float,
    contact: float,
    refine: Refine = "model",
    optics: Optics | None = None,
    psf: PointSpread | None = None,
    spots: Spots | None = None,
    crowds: bool = False,
    frames: Iterable[int] | None = None,
    **settings: Unpack[SpotSettings],
) -> pd.DataFrame:
    """Find every sphere of a stack, and refine its position by the model of its image.

    Parameters
    ----------
    stack : Stack
        Anything with ``shape (t, z, y, x)``, ``voxel (z, y, x)`` in um and ``frame(i)``.
    diameter : float
        Diameter of the fluorescent sphere, um: the whole sphere, or its fluorescent core.
    contact : float
        Centre distance of touching spheres, um. Spheres within 1.3 times that are fitted together.
    refine : {"model", "trackpy", None}
        "model" fits the ball blurred by the optics, in a 2-D movie the radial image that is learned
        from it (see the notes); "trackpy" uses its least-squares fit of discs (of up to 16
        touching spheres; larger groups keep the positions found first, a crowd is refused);
        None keeps the filtered centroid, whose error is a tenth of the contact distance where
        spheres touch.
    optics : Optics, optional
        Size, point spread and noise of the image of a sphere; by default learned from a few frames
        (`fit_optics`).
    psf : PointSpread, optional
        A point spread that was measured on beads (`measure_point_spread`); diameter and noise are
        then learned with it.
    spots : Spots, optional
        Which spots are taken for spheres.
    crowds : bool
        Crowds are refined too (see the notes), which takes some seconds for each crowd of a frame.
        Otherwise their spheres keep the positions found first.
    frames : iterable of int, optional
        The frames to analyse; by default all.
    **settings
        Single fields of `Spots` in place of this object: `dark`, `minmass`, `percentile`, `border`.

    Returns
    -------
    DataFrame
        ``frame, x, y, z`` (no z for a 2-D movie) in um, with the origin at the centre of voxel
        (0, 0, 0), and ``mass``; with "model" also ``sigma_x, sigma_y, sigma_z`` in um (from the
        Fisher information, in a volume times the root of ``chi2`` where this is above 1),
        ``chi2`` of the group's image per degree of freedom, and ``refined``.
        `refined` is False where the fit did not converge, moved the sphere by over half a radius,
        found no intensity, or was not attempted: the position found first is kept, without errors,
        and `reason` names the cause. For crowds see the notes.

    Raises
    ------
    ValueError
        For arguments out of range, all in one message, an option stated both in `spots` and as a
        keyword, or where the optics cannot be learned.
    TypeError
        For an unknown keyword.
    ModuleNotFoundError
        If trackpy is not installed.

    Warns
    -----
    PrecisionWarning
        Where a frame cannot be read and is left out. Where the masses show no gap between spheres
        and noise. Where spheres keep the positions found first: those in crowds, and those that
        have no voxels of their own. Where the images of the spheres of a 2-D movie differ in size.

    Notes
    -----
    More than 16 spheres in a chain, neighbours within 1.6 times `contact`, are a crowd. With
    `crowds` it is fitted until its residuals show no further sphere: spots that are no spheres are
    removed, and missing spheres are added, with a `mass` of NaN. Its `chi2` is that of each
    sphere's own voxels. Its background has a level of its own in every plane; any other bright
    structure is taken for a sphere if it is bright enough.

    In a 2-D movie the model is one radial function for the images of all spheres, bright or dark,
    learned from a few frames, and images of neighbours add. Spots are centres of circular symmetry,
    whose `mass` grows in proportion to the contrast (`find_circles`); `dark` and `percentile` have
    no effect, crowds are always refined.

    Examples
    --------
    >>> import numpy as np
    >>> from perrin.images.optics.ball_image import sphere_image
    >>> class Still:
    ...     shape, voxel = (1, 24, 32, 32), (0.25, 0.2, 0.2)
    ...     def frame(self, i):
    ...         ball = sphere_image(diameter=2.0, psf=(0.4, 0.15), voxel=self.voxel)
    ...         spot = ball.spot(np.array([3.01, 3.12, 3.23]), self.shape[1:])
    ...         photons = np.full(self.shape[1:], 9.0)
    ...         photons[spot.box] += 100 * spot.value
    ...         return np.random.default_rng(i).poisson(photons)
    >>> found = locate(Still(), diameter=2.0, contact=2.0)
    >>> found[["x", "y", "z"]].round(1).values.tolist()
    [[3.2, 3.1, 3.0]]
    """
    refuse_unknown("locate", settings, SPOT_KEYWORDS)
    faults: list[str] = []
    spots = options_from(Spots, spots, settings, name="spots", faults=faults)
    search = Search.of(
        stack, spots, diameter=diameter, contact=contact, refine=refine, crowds=crowds, psf=psf
    )
    check_search(stack, search, refine, optics=optics, faults=faults)
    n_frames = stack.shape[0]
    numbers = list(range(n_frames)) if frames is None else [int(i) for i in frames]
    outside = [i for i in numbers if not 0 <= i < n_frames]
    if outside:
        raise ValueError(
            f"frames: expected 0 to {n_frames - 1}, as the stack has {n_frames}, got "
            f"{listed(outside, most=5)}"
        )
    sample = sample_frames(stack, search, numbers)
    method = choose_method(stack, search, sample, refine=refine, optics=optics)
    located, unread, seen = [], [], {sampled.number: sampled for sampled in sample}
    for i in numbers:
        try:
            located.append(method.locate_in(stack, i, known=seen.get(i)))
        except FrameError as fault:
            unread.append(str(fault))
    if unread:
        warnings.warn(
            f"{len(unread)} of {len(numbers)} frames are left out: {'; '.join(unread[:3])}"
            f"{f' and {len(unread) - 3} more' if len(unread) > 3 else ''}",
            PrecisionWarning,
            stacklevel=2,
        )
    table = found_table(located)
    untried = int(table["chi2"].isna().sum()) if refine == "model" and len(table) else 0
    if untried:
        warnings.warn(
            f"{untried} of {len(table)} spheres touch in chains of over 16 (crowds=True refines "
            "them) or have no voxels of their own: they keep the positions found first, whose "
            "errors are some hundredths of a sphere, up to a tenth; the column `reason` states "
            "the cause",
            PrecisionWarning,
            stacklevel=2,
        )
    return table


def fit_optics(
    sample: Sequence[SampledFrame], method: Method, *, voxel: _Voxel, shell: bool = False
) -> LearnedOptics:
    """Learn the diameter of the fluorescent sphere, the point spread and the noise.

    Parameters
    ----------
    sample : sequence of SampledFrame
        A few frames all over the movie.
    method : Method
        Options of the search, with the mass cut.
    voxel : tuple of float
        Voxel size (z, y, x), um.
    shell : bool
        The surface of the spheres is fluorescent, in place of all of them.

    Returns
    -------
    LearnedOptics

    Raises
    ------
    ValueError
        Where no sphere is found, or the search does not converge.
    """
    search = method.search
    samples: list[GroupSample | CrowdSample] = []
    pieces: list[GroupSample | CrowdSample] = []
    for sampled in sample:
        found = method.spheres(sampled.spots, sampled.number)
        frame = without_pattern(sampled.frame, method.pattern)
        groups, crowds = groups_and_crowds(found.centers, contact=search.contact)
        samples += [_group_sample(frame, found, group, search.contact) for group in groups]
        for crowd in crowds if search.crowds else []:
            piece = crowd_piece(frame, found.centers[crowd], voxel, count=_PIECE_SPHERES)
            pieces.append(CrowdSample(*piece, np.empty((0, 3)), search.contact))
    most = _LEARNING_GROUPS
    if sum(len(s.centers) for s in samples) < sum(len(s.centers) for s in pieces):
        samples, most = pieces, _LEARNING_CROWDS
    chosen = [samples[k] for k in _evenly_spaced(len(samples), most)]
    return fit_samples(
        chosen,
        diameter=search.diameter,
        voxel=voxel,
        measured=search.psf,
        shell=shell,
        camera_pattern=method.pattern is not None,
    )


def without_doubles(columns: Columns, *, contact: float) -> Columns:
    """Return the spheres of a frame of which no two refined ones are within 0.8 contacts.

    Parameters
    ----------
    columns : dict of ndarray
        As `group_columns` returns them.
    contact : float
        Centre distance of touching spheres, um.

    Returns
    -------
    dict of ndarray
        Of two spheres that overlap by more, the one with the larger chi-squared is marked as not
        refined, the worst of a frame first.

    Examples
    --------
    >>> two = {axis: np.zeros(2) for axis in "yz"} | {"x": np.array([0.0, 1.0])}
    >>> two |= {"chi2": np.array([1.0, 3.0]), "refined": np.ones(2, dtype=bool)}
    >>> without_doubles(two | {"reason": np.array(["", ""], dtype=object)}, contact=2.0)["refined"]
    array([ True, False])
    """
    from scipy.spatial import cKDTree

    refined, reason = columns["refined"].copy(), columns["reason"].copy()
    x = np.stack([columns[axis] for axis in "xyz"], axis=1)
    rows = np.flatnonzero(refined)
    if rows.size < 2:
        return columns
    pairs = rows[cKDTree(x[rows]).query_pairs(_LEAST_APART * contact, output_type="ndarray")]
    worse = np.where(
        columns["chi2"][pairs[:, 0]] > columns["chi2"][pairs[:, 1]], pairs[:, 0], pairs[:, 1]
    )
    for k in np.argsort(-columns["chi2"][worse], kind="stable"):
        if refined[pairs[k]].all():
            refined[worse[k]], reason[worse[k]] = False, _DOUBLE
    return columns | {"refined": refined, "reason": reason}


def group_columns(
    frame: Floats,
    found: Features,
    search: Search,
    optics: Optics | None,
    voxel: _Voxel,
    *,
    usual: UsualImage | None = None,
    light: Floats | float = 1.0,
) -> tuple[Columns, list[tuple[Ints, CrowdFit]]]:
    """Fit every group of touching spheres by the model of its image.

    Parameters
    ----------
    frame : ndarray, shape (nz, ny, nx)
        Grey levels.
    found : Features
        The spheres of the frame as they were found first.
    search : Search
        Options of the search.
    optics : Optics or None
        None: no group is fitted.
    voxel : tuple of float
        Voxel size (z, y, x), um.
    usual : UsualImage, optional
        What the images of spheres have in common. Spots with another image are not refined, and
        their voxels are not used for the others.
    light : ndarray, shape (n,), or float
        Relative brightness of spheres in this frame, at each of the spots.

    Returns
    -------
    columns : dict of ndarray
        The columns of the table of `locate`.
    crowds : list of tuple
        Spheres that are fitted as a crowd, and the fit: with `Search.crowds` those of crowds, and
        of groups whose images show spheres that were not found or are beyond the border.
    """
    contact = search.contact
    centers, sigma = found.centers.copy(), np.full_like(found.centers, np.nan)
    chi2 = np.full(len(centers), np.nan)
    reason = np.full(len(centers), _IN_A_CROWD, dtype=object)
    groups: list[Ints] = []
    crowds: list[tuple[Ints, CrowdFit]] = []
    if optics is not None:
        image, noise, furthest = optics.image(voxel), optics.noise, optics.diameter / 4
        dimmed, last = np.broadcast_to(light, len(centers)), (np.array(frame.shape) - 1) * voxel
        groups, chains = groups_to_fit(centers, contact, dusty=bool(usual and usual.left_out))
        for chain in chains if search.crowds else []:
            crowds.append((chain, _crowd_of(frame, found, chain, search, image, noise)))
    while groups:
        group = groups.pop()
        sample = _group_sample(frame, found, group, contact)
        window = sample.window(image)
        if not window.has_enough_voxels(len(group)):
            reason[group] = _NO_OWN_VOXELS
            continue
        fit = fit_window(window, image, noise, FreeCenters(sample.centers))
        # Spheres that only come near were found where they are, not where they would touch.
        starts = np.stack([sample.centers, found.centers[group]])
        moved = np.linalg.norm(fit.centers - starts, axis=2).min(axis=0) >= furthest
        dark = ~(fit.brightness / np.median(fit.brightness) > 0.1)
        faults = np.where(dark, _DARK, np.where(moved, _MOVED, "")).astype(object)
        if usual is not None:
            # Chi-squared per voxel of the voxels of every sphere, and their number.
            voxels = fit.unit_images.sum(axis=1)
            independent = voxels / noise.voxels_in_one
            residual = fit.precision.left(window.data - fit.expected)
            residual = fit.weight * residual**2
            square = fit.unit_images @ residual / np.maximum(voxels, 1e-300)
            level = usual.brightness * dimmed[group]
            excess = usual.excess(square, fit.brightness / level, voxels=independent)
            worst = int(excess.argmax())
            bright = fit.brightness / level >= usual.brightest
            # Spheres at the border, which are often not found, touch those within one contact.
            at_border = np.any(np.minimum(fit.centers, last - fit.centers) < contact)
            size = np.array([window.data.size / noise.voxels_in_one])
            beside = usual.disturbed(np.array([fit.chi2]), voxels=size)
            disturbed = beside[0] or usual.disturbed(square, voxels=independent).any()
            # Light beside spheres of usual brightness may be that of a sphere that was not found.
            if (
                search.crowds
                and len(group) <= _LARGEST_CUT_GROUP
                and not bright.any()
                and (excess[worst] > 1 or fit.chi2 > usual.worst_chi2 or (at_border and disturbed))
            ):
                beyond = _crowd_of(frame, found, group, search, image, noise)
                whole = usual.group_within(
                    beyond, level=float(np.median(level)), count=len(group), contact=contact
                )
                if whole is not None:
                    crowds.append((group, whole))
                    continue
            if excess[worst] > 1:
                # Without the worst one, whose voxels are left out, the others may be spheres.
                reason[group[worst]], chi2[group[worst]] = NO_SPHERE, fit.chi2
                groups += [np.delete(group, worst)] if len(group) > 1 else []
                continue
        reason[group] = faults if fit.converged else _NOT_CONVERGED
        chi2[group] = fit.chi2
        good = reason[group] == ""
        centers[group[good]] = fit.centers[good]
        sigma[group[good]] = np.sqrt(np.diag(fit.covariance)).reshape(-1, 3)[good]
    columns = _axis_columns(centers) | {"mass": found.mass} | _axis_columns(sigma, "sigma_")
    return columns | {"chi2": chi2, "refined": reason == "", "reason": reason}, crowds


def groups_to_fit(centers: Floats, contact: float, *, dusty: bool) -> tuple[list[Ints], list[Ints]]:
    """Return the spheres of a frame as groups and crowds; see `groups_and_crowds`.

    Dust makes crowds of small groups. Where there is dust, a crowd whose spheres touch in chains of
    at most 40 is divided into these.

    Examples
    --------
    >>> x = np.array([[0.0, 0.0, 1.5 * k] for k in range(20)])
    >>> [len(found) for found in groups_to_fit(x, 1.0, dusty=True)]
    [20, 0]
    """
    groups, crowds = groups_and_crowds(centers, contact=contact)
    whole = []
    for crowd in crowds:
        parts = touching_together(centers[crowd], contact=contact)
        if dusty and max(map(len, parts)) <= _LARGEST_GROUP:
            groups += [crowd[part] for part in parts]
        else:
            whole.append(crowd)
    return groups, whole


def _crowd_of(
    frame: Floats,
    found: Features,
    group: Ints,
    search: Search,
    image: SphereImage,
    noise: CameraNoise,
) -> CrowdFit:
    """Fit a group of the spheres of a frame together with those that were not found."""
    others = np.delete(found.centers, group, axis=0)
    return fit_crowd(
        frame, found.centers[group], others=others, contact=search.contact, image=image, noise=noise
    )


def with_crowds(
    columns: Columns,
    frame: Floats,
    found: Features,
    search: Search,
    voxel: _Voxel,
    *,
    crowds: Sequence[tuple[Ints, CrowdFit]],
    usual: UsualImage | None = None,
) -> Columns:
    """Return the columns with the rows of every crowd replaced by those of its fit.

    A sphere whose fit did not converge keeps the position found first, or is left out where it was
    not found first; without `border` a sphere that the border cuts is left out too.

    Parameters
    ----------
    columns, crowds : dict of ndarray, list of tuple
        What `group_columns` returns.
    frame : ndarray, shape (nz, ny, nx)
        Grey levels.
    found : Features
        The spheres of the frame as they were found first.
    search : Search
        Options of the search.
    voxel : tuple of float
        Voxel size (z, y, x), um.
    usual : UsualImage, optional
        What the images of spheres have in common; other spots are not refined.

    Returns
    -------
    dict of ndarray
    """
    last = (np.array(frame.shape) - 1) * np.array(voxel)
    # The field ends half a voxel beyond the centres of the outer voxels.
    margin = -np.array(voxel) / 2 if search.border else search.diameter / 2
    for group, crowd in crowds:
        first = crowd.origin >= 0
        good = crowd.converged & np.isfinite(crowd.sigma).all(axis=1)
        centers = np.where(good[:, None], crowd.centers, found.centers[group][crowd.origin])
        sigma = np.where(good[:, None], crowd.sigma, np.nan)
        reason = np.where(good, "", _NOT_CONVERGED).astype(object)
        if usual is not None:
            reason[good & (crowd.chi2 > usual.worst_chi2)] = NO_SPHERE
        kept = np.all((centers >= margin) & (centers <= last - margin), axis=1) & (good | first)
        mass = np.where(first, found.mass[group][crowd.origin], np.nan)
        own = _axis_columns(centers) | {"mass": mass} | _axis_columns(sigma, "sigma_")
        own |= {"chi2": crowd.chi2, "refined": reason == "", "reason": reason}
        columns = {k: np.concatenate([columns[k], own[k][kept]]) for k in columns}
    stays = np.ones(len(columns["mass"]), dtype=np.bool_)
    stays[np.concatenate([np.empty(0, dtype=np.int64), *(group for group, _ in crowds)])] = False
    return {k: column[stays] for k, column in columns.items()}


def _group_sample(frame: Floats, found: Features, group: Ints, contact: float) -> GroupSample:
    """Return a group of touching spheres, contracted to contact, and all other spheres."""
    others = np.delete(found.centers, group, axis=0)
    return GroupSample(frame, at_contact(found.centers[group], contact=contact), others)


def _finite_frame(data: NDArray[Any], i: int) -> Floats:
    """Return a frame as floats; NaN or infinite voxels, neither bright nor dark, are refused."""
    frame = np.asarray(data, dtype=np.float64)
    lost = int(np.count_nonzero(~np.isfinite(frame)))
    if lost:
        raise FrameError(f"frame {i} has {lost} voxels without a number (NaN or infinite)", i)
    return frame


def frame_digest(data: NDArray[Any]) -> str:
    """Return a digest of the voxels of a frame.

    Examples
    --------
    >>> frame_digest(np.zeros((2, 2), dtype=np.uint8)) == frame_digest(np.zeros((2, 2)))
    False
    """
    return hashlib.blake2b(np.ascontiguousarray(data).tobytes(), digest_size=16).hexdigest()


def is_flat(stack: StackLike) -> bool:
    """Return whether a movie is two-dimensional: one plane, whose z has no size.

    Examples
    --------
    >>> from perrin.images import open_stack
    >>> is_flat(open_stack(np.zeros((3, 8, 8)), voxel=(0.2, 0.2), dt=1.0))
    True
    """
    return bool(np.isnan(stack.voxel[0]))


def _axis_columns(centers: Floats, prefix: str = "") -> Columns:
    """Return columns x, y, z of an array (n, 3) of (z, y, x)."""
    return {f"{prefix}{axis}": centers[:, k] for axis, k in zip("xyz", (2, 1, 0), strict=True)}


def found_table(located: Iterable[LocatedFrame]) -> pd.DataFrame:
    """Return the spheres of several frames as the table of `locate`.

    Examples
    --------
    >>> columns = {"frame": np.array([3]), "x": np.array([1.5]), "mass": np.array([800.0])}
    >>> found_table([LocatedFrame(columns, spots=5, level=9.0, saturated=0.0, digest="")])
       frame    x   mass
    0      3  1.5  800.0
    """
    import pandas as pd

    parts = [pd.DataFrame(frame.columns) for frame in located]
    if not parts:
        return pd.DataFrame(columns=["frame", "x", "y", "z", "mass"])
    return pd.concat(parts, ignore_index=True)


def _voxel_size(stack: StackLike) -> _Voxel:
    """Return the voxel size (z, y, x) as floats, um."""
    z, y, x = (float(h) for h in stack.voxel)
    return z, y, x


def _evenly_spaced(count: int, most: int) -> list[int]:
    """Return up to `most` indices, evenly over 0 ... count - 1."""
    return sorted(set(np.linspace(0, count - 1, min(most, count)).round().astype(int).tolist()))


def check_search(
    stack: StackLike,
    search: Search,
    refine: Refine,
    *,
    optics: Optics | None = None,
    faults: Iterable[str] = (),
) -> None:
    """Raise one error with every fault of the arguments of a search.

    Parameters
    ----------
    stack : Stack
    search : Search
    refine : {"model", "trackpy", None}
    optics : Optics, optional
    faults : iterable of str
        Faults found before, which are listed first.

    Raises
    ------
    ValueError
    """
    faults = list(faults)
    if len(stack.shape) != 4:
        faults.append(f"stack: expected shape (t, z, y, x), got {stack.shape}")
    lengths = number_fault("diameter", search.diameter, above=0, unit="um")
    lengths += number_fault("contact", search.contact, above=0, unit="um")
    faults += lengths + choice_fault("refine", refine, ("model", "trackpy", None))
    if not lengths and search.diameter > 1.2 * search.contact:
        faults.append(
            f"diameter {search.diameter} um is more than contact {search.contact} um: balls do not "
            "overlap; are the two exchanged?"
        )
    faults += number_fault("percentile", search.percentile, least=0, below=100)
    if search.circles and optics is not None:
        faults.append(
            "optics: those of a volume do not describe a 2-D movie, whose image of a sphere is "
            "learned: leave optics out"
        )
    if search.psf is not None and optics is not None:
        faults.append("psf: the point spread is stated in optics as well: state one of them")
    if search.psf is not None and (search.circles or refine != "model"):
        faults.append('psf: only refine="model" in a volume uses it: leave it out')
    if not lengths and len(stack.shape) == 4:
        faults += size_faults(stack, search, optics)
    refuse(faults)


def size_faults(stack: StackLike, search: Search, optics: Optics | None) -> list[str]:
    """Return the lengths that do not fit the stack or its voxels: lengths in another unit.

    Windows, masks and tables grow with the cube of the diameter in voxels, so that this check
    comes before any of them. Two touching spheres are in the stack together if its diagonal is
    longer than `contact`; half a voxel is far below the size of any visible sphere.

    Parameters
    ----------
    stack : Stack
    search : Search
    optics : Optics or None

    Returns
    -------
    list of str
        Empty, or one line.

    Examples
    --------
    >>> from perrin.images import open_stack
    >>> stack = open_stack(np.zeros((1, 16, 32, 32)), voxel=(0.25, 0.2, 0.2))
    >>> size_faults(stack, Search(2.45, 2.45), None)
    []
    >>> size_faults(stack, Search(2450.0, 2.45), None)[0][:45]
    'diameter 2450 um does not fit into the stack:'
    """
    voxel = np.asarray(stack.voxel, dtype=np.float64)
    there = np.isfinite(voxel)
    voxel, extent = voxel[there], (np.array(stack.shape[1:]) * voxel)[there]
    lengths = {"diameter": search.diameter}
    if optics is not None:
        lengths["optics: diameter"] = optics.diameter
        lengths["optics: point spread"] = max(optics.psf)
    faults = [
        f"{name} {length:g} um does not fit into the stack"
        for name, length in lengths.items()
        if length > extent.min()
    ]
    if search.diameter < voxel.max() / 2:
        faults.append(f"diameter {search.diameter:g} um is less than half a voxel")
    if search.contact > np.linalg.norm(extent):
        faults.append(f"contact {search.contact:g} um is longer than the stack's diagonal")
    if not faults:
        return []
    axes = "z, y, x" if there.all() else "y, x"
    stack_size, voxel_size = (
        " x ".join(f"{length:.4g}" for length in sizes) for sizes in (extent, voxel)
    )
    return [
        f"{', '.join(faults)}: the stack is {stack_size} um ({axes}), its voxels are "
        f"{voxel_size} um; are the lengths in um?"
    ]
