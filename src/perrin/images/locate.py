"""Where every sphere of a stack is, and how well that is known."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, Protocol

import numpy as np

from perrin._arrays import Floats, PrecisionWarning, require_positive
from perrin.images.conventional import Features, find_features, refine_by_trackpy
from perrin.images.crowd import CrowdFit, fit_crowd, piece_of
from perrin.images.features import at_contact, groups_and_crowds, mass_cut
from perrin.images.image_fit import (
    FreeCenters,
    ImageFit,
    RigidCenters,
    cut_window,
    fit_window,
)
from perrin.images.optics import CrowdSample, Optics, Sample, fit_samples

if TYPE_CHECKING:
    from collections.abc import Iterable
    from typing import TypeAlias

    import pandas as pd

    from perrin._arrays import Bools, Ints
    from perrin.images.sphere_image import SphereImage
    from perrin.motion import RigidMotion

    Columns: TypeAlias = dict[str, Floats | Bools]

Refine = Literal["model", "trackpy"] | None

_LEARN_FRAMES = 5  # frames looked at to set the mass cut and to learn the optics
_LEARN_GROUPS = 15  # groups of spheres the optics are learned from
_LEARN_CROWDS = 2  # pieces of crowds the optics are learned from where there are no small groups
_PIECE = 30  # spheres in such a piece


class Stack(Protocol):
    """What is asked of a movie: sizes, and one frame at a time."""

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """(t, z, y, x)."""

    @property
    def voxel(self) -> tuple[float, float, float]:
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
    """

    diameter: float
    contact: float
    dark: bool = False
    percentile: float = 95.0
    minmass: float | None = None
    border: bool = True

    def spots(self, stack: Stack, i: int) -> tuple[Floats, Features]:
        """Return a frame and its spots, those of enough mass."""
        frame = np.asarray(stack.frame(i), dtype=np.float64)
        found = find_features(
            frame,
            diameter=self.diameter,
            contact=self.contact,
            voxel=_voxel(stack),
            dark=self.dark,
            percentile=self.percentile,
            border=self.border,
        )
        keep = found.mass >= (self.minmass or 0.0)
        return frame, Features(found.centers[keep], found.mass[keep])

    def with_minmass(self, stack: Stack) -> Search:
        """Return the search with its mass cut set, from a few frames all over the movie."""
        if self.minmass is not None:
            return self
        masses = [self.spots(stack, i)[1].mass for i in _spread(stack.shape[0])]
        return replace(self, minmass=mass_cut(np.concatenate(masses)))


def locate(
    stack: Stack,
    *,
    diameter: float,
    contact: float,
    refine: Refine = "model",
    optics: Optics | None = None,
    dark: bool = False,
    minmass: float | None = None,
    percentile: float = 95.0,
    border: bool = True,
    frames: Iterable[int] | None = None,
) -> pd.DataFrame:
    """Find every sphere of a stack, and refine its place by the model of its image.

    Parameters
    ----------
    stack : Stack
        Anything with ``shape (t, z, y, x)``, ``voxel (z, y, x)`` in um and ``frame(i)``; of a 2-D
        movie z = 1 and the voxel's z is NaN.
    diameter : float
        Of the ball that is seen, um: the whole sphere, or the fluorescent core of it.
    contact : float
        Centre distance of touching spheres, um. Spheres within 1.3 times that are fitted together.
    refine : {"model", "trackpy", None}
        "model" fits the ball blurred by the optics; "trackpy" its least-squares fit of discs;
        None leaves the filtered centroid, which is off by a tenth of the contact distance where
        balls touch. The model is that of a volume: in a 2-D movie it gives way to None.
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
    frames : iterable of int, optional
        Frames to do; default all.

    Returns
    -------
    DataFrame
        ``frame, x, y, z`` (no z of a 2-D movie) in um, the origin at the centre of voxel (0, 0, 0),
        ``mass``; and for "model" ``sigma_x, sigma_y, sigma_z`` in um (from the Fisher information),
        ``chi2`` of the group's image per degree of freedom, and ``refined``: False where the fit
        did not settle, left by over half a radius, found no sphere, or was not tried, and the place
        found first was kept, without errors. Of crowds see the notes.

    Raises
    ------
    ValueError
        For arguments that cannot be, or where the optics cannot be learned.
    ModuleNotFoundError
        Without trackpy.

    Warns
    -----
    PrecisionWarning
        Where the masses show no gap between spheres and noise; where a sphere has no voxels to
        itself and stays where it was found; where the model is asked for in a 2-D movie.

    Notes
    -----
    More than 16 spheres in a chain, neighbours within 1.6 times `contact`, are a crowd, which is
    fitted until its image has nothing left over: spots that turn out to be no spheres are left out,
    and spheres that were missed are added, with a `mass` of NaN. Its `chi2` is that of each
    sphere's own voxels. Its background has a level of its own in every plane; what shines there
    without being a sphere is misread as one if it is bright enough.

    Examples
    --------
    >>> import numpy as np
    >>> from perrin.images.sphere_image import sphere_image
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
    _checked(stack, diameter, contact, refine, percentile)
    if refine == "model" and _flat(stack):
        refine = None
        warnings.warn(
            "the model of the image is that of a volume; in this 2-D movie places are filtered "
            "centroids: pass refine=None, or refine='trackpy' where spheres touch",
            PrecisionWarning,
            stacklevel=2,
        )
    search = Search(diameter, contact, dark, percentile, minmass, border).with_minmass(stack)
    if refine == "model" and optics is None:
        optics = fit_optics(stack, search)
    listed = _listed(stack, frames)
    table = _table([_frame_columns(stack, i, search, refine, optics) for i in listed])
    if refine == "model":
        _warn_of_untried(table)
    return table


def fit_optics(stack: Stack, search: Search) -> Optics:
    """Learn the sphere's size in the light, the point spread and the noise from a few frames.

    Raises
    ------
    ValueError
        Where no sphere is found, or the search does not settle.
    """
    search = search.with_minmass(stack)
    samples: list[Sample | CrowdSample] = []
    crowds: list[Sample | CrowdSample] = []
    for i in _spread(stack.shape[0]):
        frame, found = search.spots(stack, i)
        groups, crowded = groups_and_crowds(found.centers, contact=search.contact)
        samples += [_sample(frame, found, group, search.contact) for group in groups]
        crowds += [_piece(frame, found, group, search, stack) for group in crowded]
    most = _LEARN_GROUPS
    if sum(len(s.centers) for s in samples) < sum(len(s.centers) for s in crowds):
        samples, most = crowds, _LEARN_CROWDS
    learned = [samples[k] for k in _spread(len(samples), most)]
    return fit_samples(learned, diameter=search.diameter, voxel=_voxel(stack))


def fit_pose(
    stack: Stack,
    motion: RigidMotion,
    *,
    optics: Optics,
    frames: Ints | None = None,
    others: pd.DataFrame | None = None,
) -> RigidMotion:
    """Fit the six numbers of a rigid cluster's pose to the images themselves.

    Parameters
    ----------
    stack : Stack
    motion : RigidMotion
        Of the free centres: the common shape, and every frame's start.
    optics : Optics
        How a sphere is seen.
    frames : ndarray of int, shape (T,), optional
        The stack's frame of each row of `motion`; default 0, 1, ...
    others : DataFrame, optional
        Spheres (``frame, x, y, z``) of other clusters, whose light is left out.

    Returns
    -------
    RigidMotion
        The same with `center`, `rotation`, `covariance` and `center_variance` from the images; a
        frame whose fit does not settle has no pose and says so in `reason`.

    Notes
    -----
    The shape is taken as known: an error in it goes into the pose unseen. `residual` stays that of
    the free centres, which shows whether the cluster is rigid at all.
    """
    rows = motion.fitted
    frames = np.arange(len(motion.time)) if frames is None else np.asarray(frames)
    image = optics.image(_voxel(stack))
    poses = {
        int(k): _pose(stack, int(frames[k]), motion, int(k), optics, image, others) for k in rows
    }
    return _replaced(motion, {k: fit for k, fit in poses.items() if fit.converged})


def _pose(
    stack: Stack,
    i: int,
    motion: RigidMotion,
    row: int,
    optics: Optics,
    image: SphereImage,
    others: pd.DataFrame | None,
) -> ImageFit:
    start = RigidCenters(motion.center[row], motion.rotation[row], motion.template)
    away = np.empty((0, 3))
    if others is not None:
        away = others.loc[others["frame"] == i, ["z", "y", "x"]].to_numpy(dtype=np.float64)
    frame = np.asarray(stack.frame(i), dtype=np.float64)
    return fit_window(
        cut_window(frame, image, start.centers, others=away), image, optics.noise, start
    )


def _replaced(motion: RigidMotion, fits: dict[int, ImageFit]) -> RigidMotion:
    """Return the motion with the fitted poses, its first one the identity again."""
    rotation, center = np.full_like(motion.rotation, np.nan), np.full_like(motion.center, np.nan)
    covariance = np.full_like(motion.covariance, np.nan)
    variance = np.full_like(motion.center_variance, np.nan)
    for k, fit in fits.items():
        pose = fit.arrangement
        if isinstance(pose, RigidCenters):
            rotation[k], center[k] = pose.rotation, pose.center
            covariance[k] = fit.covariance[3:, 3:]
            variance[k] = np.trace(fit.covariance[:3, :3]) / 3
    gauge = rotation[min(fits)] if fits else np.eye(3)
    rotation = rotation @ gauge.T
    reason = tuple(
        "the pose fit to the image did not settle" if k in set(motion.fitted) - set(fits) else why
        for k, why in enumerate(motion.reason)
    )
    return replace(
        motion,
        rotation=rotation,
        center=center,
        covariance=np.swapaxes(rotation, -1, -2) @ covariance @ rotation,
        center_variance=variance,
        template=motion.template @ gauge.T,
        reason=reason,
    )


def _frame_columns(
    stack: Stack, i: int, search: Search, refine: Refine, optics: Optics | None
) -> Columns:
    """Return the columns of one frame's part of the table."""
    frame, found = search.spots(stack, i)
    columns: Columns = {"frame": np.full(len(found.mass), i)}
    if refine == "model" and optics is not None:
        columns = _by_model(frame, found, search.contact, optics, _voxel(stack))
        columns = _with_crowds(columns, frame, found, search, optics, _voxel(stack))
        return {"frame": np.full(len(columns["mass"]), i)} | columns
    centers = found.centers
    if refine == "trackpy":
        centers = refine_by_trackpy(
            frame, centers, diameter=search.diameter, contact=search.contact, voxel=_voxel(stack)
        )
    places = _places(centers)
    if _flat(stack):
        del places["z"]
    return columns | places | {"mass": found.mass}


def _by_model(
    frame: Floats,
    found: Features,
    contact: float,
    optics: Optics,
    voxel: tuple[float, float, float],
) -> Columns:
    image = optics.image(voxel)
    centers, sigma = found.centers.copy(), np.full_like(found.centers, np.nan)
    chi2, refined = np.full(len(centers), np.nan), np.zeros(len(centers), dtype=np.bool_)
    groups, _ = groups_and_crowds(found.centers, contact=contact)
    for group in groups:
        sample = _sample(frame, found, group, contact)
        window = cut_window(frame, image, sample.centers, others=sample.others)
        if not window.shows(len(group)):
            continue
        fit = fit_window(window, image, optics.noise, FreeCenters(sample.centers))
        good = _believable(fit, sample.centers, optics.diameter / 4)
        spheres = group[good]
        centers[spheres] = fit.centers[good]
        sigma[spheres] = np.sqrt(np.diag(fit.covariance)).reshape(-1, 3)[good]
        chi2[group] = fit.chi2
        refined[spheres] = True
    errors = _places(sigma, "sigma_")
    return _places(centers) | {"mass": found.mass} | errors | {"chi2": chi2, "refined": refined}


def _with_crowds(
    columns: Columns,
    frame: Floats,
    found: Features,
    search: Search,
    optics: Optics,
    voxel: tuple[float, float, float],
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
    columns: Columns = _places(centers) | {"mass": np.where(first, mass[crowd.origin], np.nan)}
    columns |= _places(sigma, "sigma_") | {"chi2": crowd.chi2, "refined": good}
    return {k: column[kept] for k, column in columns.items()}


def _believable(fit: ImageFit, start: Floats, furthest: float) -> Bools:
    """Return which spheres of a fit are where they were looked for, and as bright as the rest."""
    moved = np.linalg.norm(fit.centers - start, axis=1)
    bright = fit.brightness / np.median(fit.brightness) > 0.1
    return np.asarray(fit.converged & (moved < furthest) & bright)


def _warn_of_untried(table: pd.DataFrame) -> None:
    untried = int(table["chi2"].isna().sum())
    if untried:
        warnings.warn(
            f"{untried} of {len(table)} spheres have no voxels to themselves: they stay where "
            "found, perhaps a tenth of a sphere off; the column `refined` says which",
            PrecisionWarning,
            stacklevel=3,
        )


def _sample(frame: Floats, found: Features, group: Ints, contact: float) -> Sample:
    others = np.delete(found.centers, group, axis=0)
    return Sample(frame, at_contact(found.centers[group], contact=contact), others)


def _piece(
    frame: Floats, found: Features, group: Ints, search: Search, stack: Stack
) -> CrowdSample:
    piece, centers = piece_of(frame, found.centers[group], _voxel(stack), count=_PIECE)
    return CrowdSample(piece, centers, np.empty((0, 3)), search.contact)


def _places(centers: Floats, prefix: str = "") -> Columns:
    return {f"{prefix}{axis}": centers[:, k] for axis, k in zip("xyz", (2, 1, 0), strict=True)}


def _table(columns: list[Columns]) -> pd.DataFrame:
    import pandas as pd

    if not columns:
        return pd.DataFrame(columns=["frame", "x", "y", "z", "mass", "chi2"])
    return pd.concat([pd.DataFrame(c) for c in columns], ignore_index=True)


def _flat(stack: Stack) -> bool:
    """Return whether the movie is two-dimensional: one plane, of no height."""
    return bool(np.isnan(stack.voxel[0]))


def _voxel(stack: Stack) -> tuple[float, float, float]:
    z, y, x = (float(h) for h in stack.voxel)
    return z, y, x


def _spread(count: int, wanted: int = _LEARN_FRAMES) -> list[int]:
    """Return up to so many indices, evenly over 0 ... count - 1."""
    return sorted(set(np.linspace(0, count - 1, min(wanted, count)).round().astype(int).tolist()))


def _listed(stack: Stack, frames: Iterable[int] | None) -> list[int]:
    listed = list(range(stack.shape[0])) if frames is None else [int(i) for i in frames]
    outside = [i for i in listed if not 0 <= i < stack.shape[0]]
    if outside:
        raise ValueError(
            f"frames: expected 0 to {stack.shape[0] - 1}, as the stack has {stack.shape[0]}, got "
            f"{', '.join(map(str, outside[:5]))}"
        )
    return listed


def _checked(
    stack: Stack, diameter: float, contact: float, refine: Refine, percentile: float
) -> None:
    """Raise one error with every fault of the arguments."""
    require_positive(diameter=diameter, contact=contact)
    faults = []
    if len(stack.shape) != 4:
        faults.append(f"stack: expected shape (t, z, y, x), got {stack.shape}")
    if refine not in ("model", "trackpy", None):
        faults.append(f"refine: expected 'model', 'trackpy' or None, got {refine!r}")
    if diameter > 1.2 * contact:
        faults.append(
            f"diameter {diameter} um is more than contact {contact} um: balls do not overlap; "
            "are the two exchanged?"
        )
    if not 0 <= percentile < 100:
        faults.append(f"percentile: expected 0 <= percentile < 100, got {percentile}")
    if faults:
        raise ValueError("; ".join(faults))
