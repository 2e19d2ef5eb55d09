"""From a microscope stack to the diffusion of every cluster in it."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

import perrin.images.checks as checks
from perrin._arrays import DegenerateClusterError, Floats, IdentityError, TooFewFramesError
from perrin.analysis import Conditions, check_arguments, measure_table, told_conditions
from perrin.files import check_tracks
from perrin.grouping import identify
from perrin.images.imaging import Imaging, View
from perrin.images.locate import NO_FLAT_MODEL, Search, check_search, is_flat
from perrin.images.parts import PartsError
from perrin.images.stacks import digest
from perrin.images.stages import Located, Workplace, fit_poses, locate_frames
from perrin.steps import choice_faults

if TYPE_CHECKING:
    import os
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    import pandas as pd

    from perrin._arrays import Bools, Ints
    from perrin.images.locate import Refine
    from perrin.images.optics import Optics
    from perrin.images.stacks import Stack
    from perrin.images.stages import Progress
    from perrin.motion import RigidMotion
    from perrin.results import ClusterResult, Report

_VIEWS = 8  # frames that are kept as pictures
_EVEN = 1e-3  # intervals that differ by less than this share of dt are equal
_LIBRARIES = ("perrin", "numpy", "scipy", "trackpy")
_LOCATED, _POSED = "located", "posed"
_SURE = 0.95  # groups of other sizes are told where less than this share has the size taken


def analyze_stack(
    stack: Stack,
    *,
    diameter: float,
    contact: float,
    size: int | None = None,
    frames: tuple[int | None, int | None] | None = None,
    exclude: Iterable[int] = (),
    refine: Refine = "model",
    optics: Optics | None = None,
    dark: bool = False,
    minmass: float | None = None,
    percentile: float = 95.0,
    border: bool = True,
    noise: Literal["joint", "residual"] | float = "joint",
    exposure: float | None = None,
    drift: bool = False,
    viscosity: float | None = None,
    temperature: float | None = None,
    keep: str | os.PathLike[str] | None = None,
    anew: bool = False,
    workers: int = 0,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> Report:
    """Measure D_R and D_T of every cluster in a movie of image stacks.

    Spheres are located and refined (`locate`), told apart and followed (`identify`), the poses of
    the clusters are fitted to the images (`fit_pose`), and the motions analysed as in `analyze`.

    Parameters
    ----------
    stack : Stack
        From `open_stack` or `render_stack`.
    diameter, contact : float
        Of the ball that is seen, and centre to centre of touching spheres, um.
    size : int, optional
        Spheres of a cluster; default: the most common number of touching spheres (three or more, in
        the plane two or more, if there are any).
    frames : tuple of int or None, optional
        First frame and first frame not used any more, as in a slice.
    exclude : iterable of int
        Numbers of clusters to leave out; the others keep theirs.
    refine, optics, dark, minmass, percentile, border
        As in `locate`. For "model" poses are fitted to the images as well.
    noise, exposure, drift, viscosity, temperature
        As in `analyze`. With viscosity and temperature, what spheres of diameter `contact` should
        do stands beside what was measured.
    keep : path, optional
        A folder for finished frames: the same call goes on there where it was stopped. By default
        nothing is kept.
    anew : bool
        Throw away what was kept of another input or with other settings, instead of refusing it.
    workers : int
        Processes of this machine that share the work; 0 is this one alone.
    scheduler : str, optional
        Address of a Dask scheduler whose workers do the work; they have to reach the file.
    progress : callable, optional
        Called with (done, total, title) as the work goes on.

    Returns
    -------
    Report
        With `Report.imaging`. Results do not depend on where and in how many pieces the work was
        done.

    Raises
    ------
    ValueError
        For arguments out of range; where no sphere is found or the optics cannot be learned; if
        `keep` holds parts of another input or of other settings.
    DegenerateClusterError, TooFewFramesError
        If no spheres touch or no cluster can be measured.
    IdentityError
        If particles move over half a contact distance between frames.
    OSError
        If files cannot be read or written, or the scheduler does not answer.

    Examples
    --------
    >>> from perrin import Cluster, analyze_stack, render_stack, simulate_motion
    >>> truth = simulate_motion(
    ...     Cluster.touching(3, 2.0), D_R=0.01, D_T=0.02, dt=0.5, n_frames=8, rng=3
    ... )
    >>> movie = render_stack(
    ...     truth, centers=[(4, 4, 4)], voxel=(0.4, 0.3, 0.3), shape=(20, 27, 27), diameter=2.0,
    ...     psf=(0.4, 0.2, 0.2), photons=200, background=5, rng=1,
    ... )
    >>> report = analyze_stack(movie, diameter=2.0, contact=2.0)
    >>> len(report.clusters), len(report.clusters[0].motion.template)
    (1, 3)
    """
    search = Search(diameter, contact, dark, percentile, minmass, border)
    sphere = contact if viscosity is not None and temperature is not None else None
    known = (None, viscosity, temperature, sphere, noise, exposure, drift)
    conditions = Conditions(stack.dt, *known, times=_uneven(stack))
    _check(stack, search, refine, conditions, size=size, workers=workers, scheduler=scheduler)
    flat = refine == "model" and is_flat(stack)
    refine = None if flat else refine
    listed, out = _listed(len(stack), frames), sorted({int(c) for c in exclude})
    if progress is not None:
        progress(0, 0, "taking the file's SHA-256")
    depends = _depends(stack, search, refine, optics, listed)
    with _kept_in(keep) as folder:
        place = Workplace(folder / _LOCATED, workers, scheduler, progress)
        located = _located(
            stack, search, refine=refine, optics=optics, frames=listed, settings=depends,
            place=place, anew=anew,
        )  # fmt: skip
        seen = _grouped(located, stack, search, size)
        poses = _Poses(stack, located.method.optics, seen, contact, folder / _POSED, place)
        report = measure_table(
            _tracks(seen, out),
            replace(conditions, sigma_ratio=_stated(seen)),
            source={"path": stack.source if stack.path else None, "sha256": depends["sha256"]},
            arguments=_arguments(conditions, depends, seen.size, out),
            improved=poses.improved,
        )
    imaging = _imaging(stack, located, seen, search)
    told = [NO_FLAT_MODEL, *poses.told] if flat else poses.told
    return _with_checks(report, imaging, located, seen, told, stack)


@dataclass(frozen=True, eq=False)
class _Seen:
    """Spheres that were found, which cluster each is of, and what was noticed on the way."""

    features: pd.DataFrame  # of `Imaging`, and ``together``, ``border`` of `checks`
    axes: list[str]
    size: int
    margin: float  # of the border, um
    dropped: dict[int, Ints]  # frames of each cluster that lack spheres at the border
    told: list[str]


def _listed(count: int, frames: tuple[int | None, int | None] | None) -> list[int]:
    first, stop = frames or (None, None)
    if any(end is not None and end < 0 for end in (first, stop)):
        raise ValueError(f"frames: expected A:B with whole numbers from 0 on, got {first}:{stop}")
    listed = list(range(count))[slice(first, stop)]
    if not listed:
        raise ValueError(f"frames {first}:{stop} hold none of the stack's, 0 to {count - 1}")
    if len(listed) < 2:
        raise TooFewFramesError("one frame shows no motion: two or more are needed", len(listed))
    return listed


def _uneven(stack: Stack) -> Floats | None:
    """Return the times of the frames where they are not evenly spaced."""
    even = np.abs(np.diff(stack.times) - stack.dt) <= _EVEN * stack.dt
    return None if even.all() else stack.times


def _check(
    stack: Stack,
    search: Search,
    refine: Refine,
    conditions: Conditions,
    *,
    size: int | None,
    workers: int,
    scheduler: str | None,
) -> None:
    """Raise one error with every fault of the arguments, before hours of work."""
    if len(stack) < 2:
        raise TooFewFramesError("one frame shows no motion: two or more are needed", len(stack))
    faults = choice_faults(
        quantity="rotation", noise=conditions.noise, exposure=conditions.exposure
    )
    given = {"viscosity": conditions.viscosity, "temperature": conditions.temperature}
    faults += _faults_of(check_search, stack, search, refine)
    faults += _faults_of(check_arguments, dt=conditions.dt, **given)
    if size is not None and not (size == int(size) and size >= 2):
        faults.append(f"size: expected a whole number of spheres, at least 2, got {size!r}")
    if workers < 0 or (workers and scheduler is not None):
        faults.append(
            f"workers: expected processes of this machine, 0 or more, or a scheduler instead, got "
            f"{workers} and {scheduler!r}"
        )
    if faults:
        raise ValueError("; ".join(faults))


def _faults_of(check: Callable[..., None], *arguments: object, **named: object) -> list[str]:
    try:
        check(*arguments, **named)
    except ValueError as fault:
        return [str(fault)]
    return []


def _depends(
    stack: Stack,
    search: Search,
    refine: Refine,
    optics: Optics | None,
    frames: Sequence[int],
) -> dict[str, Any]:
    """Return all that the located spheres depend on."""
    return {
        "sha256": digest(stack),
        **stack.choice,
        "shape": list(stack.shape),
        "voxel": [float(v) if np.isfinite(v) else None for v in stack.voxel],
        "first_frame": frames[0],
        "last_frame": frames[-1],
        **asdict(search),
        "refine": refine,
        "optics": None if optics is None else asdict(optics),
        "versions": {name: _version(name) for name in _LIBRARIES},
    }


def _version(name: str) -> str | None:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(name)
    except PackageNotFoundError:
        return None


@contextmanager
def _kept_in(keep: str | os.PathLike[str] | None) -> Iterator[Path]:
    """Give the folder of the parts, one that goes away if none is wanted."""
    import tempfile

    if keep is not None:
        yield Path(keep)
        return
    with tempfile.TemporaryDirectory(prefix="perrin-") as folder:
        yield Path(folder)


def _located(
    stack: Stack,
    search: Search,
    *,
    refine: Refine,
    optics: Optics | None,
    frames: Sequence[int],
    settings: Mapping[str, Any],
    place: Workplace,
    anew: bool,
) -> Located:
    """Locate all frames, and refuse or throw away the parts of another run."""
    import shutil

    try:
        return locate_frames(
            stack, search, refine=refine, optics=optics, frames=frames, settings=settings,
            place=place,
        )  # fmt: skip
    except PartsError as error:
        if not anew:
            raise PartsError(
                f"{error}; choose another folder, or anew=True (--overwrite)"
            ) from None
    shutil.rmtree(place.folder)
    return locate_frames(
        stack, search, refine=refine, optics=optics, frames=frames, settings=settings, place=place
    )


def _grouped(located: Located, stack: Stack, search: Search, size: int | None) -> _Seen:
    """Say which spheres are of which cluster."""
    features = located.features
    if not len(features):
        raise DegenerateClusterError(
            "no particles were found in any frame: look at minmass, diameter, and whether the "
            "spheres are dark"
        )
    axes = [axis for axis in "xyz" if axis in features]
    usable = _usable(features)
    together = np.ones(len(features), dtype=np.int64)
    together[usable] = checks.group_sizes(features[usable], contact=search.contact, axes=axes)
    told: list[str] = []
    if size is None:
        size, told = _common_size(together[usable], dimension=len(axes))
    found = identify(features.loc[usable, ["frame", *axes]], contact=search.contact, size=size)
    columns = {"cluster": -1, "particle": -1, "piece": 0}
    features = features.assign(together=together, **columns)
    features.loc[usable, list(columns)] = found[list(columns)]
    features.loc[features["cluster"] < 0, ["particle", "piece"]] = (-1, 0)
    features["border"] = _to_border(features, stack, axes)
    blur = located.method.optics.psf[0] if located.method.optics is not None else 0.0
    margin = search.diameter / 2 + 2 * blur
    features, dropped = _without_cut_bodies(features, size=size, margin=margin)
    return _Seen(features, axes, size, margin, dropped, told)


def _usable(features: pd.DataFrame) -> Bools:
    """Return the rows whose places are good: where a fit was tried and failed they are not."""
    if "refined" not in features:
        return np.ones(len(features), dtype=np.bool_)
    tried = features["chi2"].notna().to_numpy()
    return np.asarray(features["refined"].to_numpy(dtype=np.bool_) | ~tried)


def _common_size(together: Ints, *, dimension: int) -> tuple[int, list[str]]:
    """Return the most common number of touching spheres, and what was seen besides."""
    counted = np.bincount(together)
    groups = np.round(counted / np.maximum(np.arange(len(counted)), 1)).astype(int)
    groups[:2] = 0
    if not groups.any():
        raise DegenerateClusterError(
            f"no spheres touch: all {len(together)} found are over 1.3 contact distances apart; "
            "correct contact or the voxel size"
        )
    bodies = groups.copy()
    bodies[:dimension] = 0
    size = int(np.argmax(bodies if bodies.any() else groups))
    share = groups[size] / groups.sum()
    if share >= _SURE:
        return size, []
    listed = ", ".join(f"{count} of {n}" for n, count in enumerate(groups) if count)
    return size, [
        f"clusters are taken to be of {size} spheres, the most common number; groups of touching "
        f"spheres in all frames: {listed}; state the size to measure others"
    ]


def _to_border(features: pd.DataFrame, stack: Stack, axes: list[str]) -> Floats:
    """Return how far each centre is from the nearest border of the stack, um."""
    length = dict(zip("zyx", np.array(stack.shape[1:]) * stack.voxel, strict=True))
    half = dict(zip("zyx", stack.voxel / 2, strict=True))
    sides = [
        np.minimum(features[a] + half[a], length[a] - half[a] - features[a]).to_numpy()
        for a in axes
    ]
    return np.asarray(np.min(sides, axis=0), dtype=np.float64)


def _without_cut_bodies(
    features: pd.DataFrame, *, size: int, margin: float
) -> tuple[pd.DataFrame, dict[int, Ints]]:
    """Loosen bodies at the border some of whose spheres are out of view.

    Their unseen light misleads the fits of the spheres that are left.
    """
    tracked = features[features["cluster"] >= 0]
    bodies = tracked.groupby(["cluster", "frame"]).agg(n=("x", "size"), border=("border", "min"))
    cut = bodies[(bodies["n"] < size) & (bodies["border"] < margin)].reset_index()
    gone = features.set_index(["cluster", "frame"]).index.isin(
        cut.set_index(["cluster", "frame"]).index
    )
    features = features.copy()
    features.loc[gone, ["cluster", "particle", "piece"]] = (-1, -1, 0)
    return features, {int(c): part.to_numpy() for c, part in cut.groupby("cluster")["frame"]}


def _stated(seen: _Seen) -> Floats | None:
    """Return the median stated errors of the axes, um, where places were refined."""
    names = [f"sigma_{axis}" for axis in seen.axes]
    if not set(names) <= set(seen.features):
        return None
    median = seen.features[names].median().to_numpy(dtype=np.float64)
    return median if np.isfinite(median).all() else None


def _tracks(seen: _Seen, out: Sequence[int]) -> pd.DataFrame:
    """Return the table of tracks, clusters that are not wanted left out."""
    features = seen.features
    found = set(features.loc[features["cluster"] >= 0, "cluster"].unique().tolist())
    if not found:
        raise DegenerateClusterError(
            f"no cluster of {seen.size} touching spheres is seen in three frames or more"
        )
    unknown = sorted(set(out) - found)
    if unknown:
        raise ValueError(f"exclude: there is no cluster {unknown[0]}; found {sorted(found)}")
    rows = features[(features["cluster"] >= 0) & ~features["cluster"].isin(out)]
    if not len(rows):
        raise ValueError(f"exclude: no cluster is left of {sorted(found)}")
    table = check_tracks(
        rows[["frame", "particle", "cluster", *seen.axes]], source="the spheres found"
    )
    return table.assign(piece=rows["piece"].to_numpy())


@dataclass(eq=False)
class _Poses:
    """Takes the motions of free centres to those fitted to the images."""

    stack: Stack
    optics: Optics | None
    seen: _Seen
    contact: float
    folder: Path
    place: Workplace
    told: list[str] = field(default_factory=list)

    def improved(
        self, motions: Mapping[int, tuple[RigidMotion, Ints]]
    ) -> Mapping[int, RigidMotion]:
        """Refuse what moves too far, and fit the poses of the rest."""
        reasons = {c: checks.refused(m, contact=self.contact) for c, (m, _) in motions.items()}
        kept = {c: pair for c, pair in motions.items() if not reasons[c]}
        self.told += [f"cluster {c} was refused: {why}" for c, why in reasons.items() if why]
        if motions and not kept:
            raise IdentityError(next(iter(reasons.values())))
        if self.optics is None or not kept:
            return {c: motion for c, (motion, _) in kept.items()}
        better, told = fit_poses(
            self.stack,
            kept,
            optics=self.optics,
            features=self.seen.features,
            place=replace(self.place, folder=self.folder),
        )
        self.told += told
        return better


def _arguments(
    conditions: Conditions, depends: Mapping[str, Any], size: int, out: Sequence[int]
) -> dict[str, Any]:
    """Return what run.json keeps of the arguments."""
    mine = {k: v for k, v in depends.items() if k not in ("sha256", "versions")}
    return told_conditions(conditions) | mine | {"size": size, "exclude": list(out)}


def _imaging(stack: Stack, located: Located, seen: _Seen, search: Search) -> Imaging:
    z, y, x = (float(v) for v in stack.voxel)
    read = located.frames.loc[located.frames["fault"] == "", "frame"].to_numpy()
    shown = read[np.unique(np.linspace(0, len(read) - 1, min(_VIEWS, len(read))).astype(int))]
    return Imaging(
        features=seen.features.drop(columns=["together", "border"]),
        frames=located.frames,
        spots=located.spots,
        views=tuple(_view(stack, int(i), search.dark) for i in shown),
        optics=located.method.optics,
        minmass=float(located.method.search.minmass or 0.0),
        voxel=(z, y, x),
        diameter=search.diameter,
        contact=search.contact,
        dark=search.dark,
        refine=located.method.refine,
    )


def _view(stack: Stack, i: int, dark: bool) -> View:
    frame = stack.frame(i)
    xy, xz, yz = (frame.min(axis=k) if dark else frame.max(axis=k) for k in range(3))
    return View(i, xy, xz, yz)


def _with_checks(
    report: Report,
    imaging: Imaging,
    located: Located,
    seen: _Seen,
    told: list[str],
    stack: Stack,
) -> Report:
    """Return the report with the images, and with all that speaks against it."""
    features, contact, method = seen.features, imaging.contact, located.method
    warnings = (
        *located.told,
        *checks.unreadable(located.frames),
        *checks.empty(located.frames, minmass=imaging.minmass),
        *checks.saturated(located.frames, voxels=int(np.prod(stack.shape[1:]))),
        *checks.faded(features),
        *checks.dimmed_with_depth(features),
        *checks.unrefined(features),
        *checks.pair_distance(features, contact=contact, refine=method.refine, axes=seen.axes),
        *seen.told,
        *checks.counts(features, size=seen.size, contact=contact),
        *checks.at_border(features, margin=seen.margin, dropped=seen.dropped),
        *told,
        *report.warnings,
    )
    clusters = tuple(_checked(result, imaging, stack) for result in report.clusters)
    return replace(report, clusters=clusters, warnings=warnings, imaging=imaging)


def _checked(result: ClusterResult, imaging: Imaging, stack: Stack) -> ClusterResult:
    more = (
        *checks.long_steps(result.motion, contact=imaging.contact),
        *checks.sampling(result.motion, phi2=result.noise.phi2),
        *checks.scan_blur(
            result.motion,
            D_T=result.D_T.value,
            plane_time=stack.plane_time,
            height=imaging.voxel[0],
            diameter=imaging.diameter,
        ),
    )
    return replace(result, warnings=(*result.warnings, *more))
