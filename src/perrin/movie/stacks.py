"""From a microscope stack to the diffusion of every cluster in it."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

import perrin.movie.checks as checks
from perrin.diffusion.noise_model import noise_faults
from perrin.errors import IdentityError, PartsError, TooFewFramesError
from perrin.images.imaging import Imaging, View
from perrin.images.spheres.localisation import NO_FLAT_MODEL, Search, check_search, is_flat
from perrin.images.stack import digest
from perrin.movie.bodies import Bodies, find_bodies, stated_errors, tracks_of
from perrin.movie.stages import Located, Workplace, fit_poses, locate_frames
from perrin.movie.workers import check_workers
from perrin.run.experiment import Conditions, check_arguments, told_conditions
from perrin.run.measure import measure_table
from perrin.tracks.clock import Clock, evenly_spaced

if TYPE_CHECKING:
    import os
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    from perrin._arrays import Ints
    from perrin.images.optics.optics import Optics
    from perrin.images.spheres.localisation import Refine
    from perrin.images.stack import Stack
    from perrin.motion.rigid_motion import RigidMotion
    from perrin.movie.stages import Progress
    from perrin.run.results import ClusterResult, Report


_VIEWS = 8  # frames that are kept as pictures


_LIBRARIES = ("perrin", "numpy", "scipy", "trackpy")


_FEWEST = 3  # different images of a movie


_LISTED = 10  # clusters named one by one


_LOCATED, _POSED = "located", "posed"


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
    keep_jumps: bool = False,
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
    noise, exposure, drift, keep_jumps, viscosity, temperature
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
        For arguments out of range; if `keep` holds parts of another input or of other settings.
    NoSpheresError, DegenerateClusterError, TooFewFramesError
        If there are no spheres, none touch, or no cluster can be measured.
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
    # Clusters that meet may be a crowd for some frames.
    search = Search(diameter, contact, dark, percentile, minmass, border, crowds=True)
    sphere = contact if viscosity is not None and temperature is not None else None
    conditions = Conditions(
        stack.dt, None, viscosity, temperature, sphere, noise, exposure, drift, keep_jumps,
        times=_uneven(stack),
    )  # fmt: skip
    _check(
        stack, search, refine, optics, conditions, size=size, workers=workers, scheduler=scheduler
    )
    flat = refine == "model" and is_flat(stack)
    refine = None if flat else refine
    listed, out = _listed(len(stack), frames), sorted({int(c) for c in exclude})
    if progress is not None:
        progress(0, 0, "taking the file's SHA-256")
    depends = _depends(stack, search, refine, optics, listed)
    with _kept_in(keep) as folder:
        place = Workplace(folder / _LOCATED, workers, scheduler, progress)
        find = partial(
            locate_frames, stack, search, refine=refine, optics=optics, frames=listed,
            settings=depends, place=place,
        )  # fmt: skip
        located = _located(find, place.folder, anew=anew)
        _check_copies(located)
        method = located.method
        bodies = find_bodies(located.features, stack, search, optics=method.optics, size=size)
        poses = _Poses(stack, method.optics, bodies, contact, folder / _POSED, place)
        report = measure_table(
            tracks_of(bodies, exclude=out),
            replace(conditions, sigma_ratio=stated_errors(bodies)),
            source={"path": stack.source if stack.path else None, "sha256": depends["sha256"]},
            arguments=_arguments(conditions, depends, bodies.size, out),
            improved=poses.improved,
        )
    imaging = _imaging(stack, located, bodies, search)
    findings = poses.findings + checks.Findings(notes=(NO_FLAT_MODEL,) if flat else ())
    return _with_checks(report, imaging, located, bodies, findings, stack)


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


def _uneven(stack: Stack) -> Clock | None:
    """Return the times of the frames where they are not evenly spaced."""
    frames = np.arange(len(stack))
    if evenly_spaced(stack.times, frames, dt=stack.dt):
        return None
    return Clock(frames, stack.times, stack.dt)


def _check(
    stack: Stack,
    search: Search,
    refine: Refine,
    optics: Optics | None,
    conditions: Conditions,
    *,
    size: int | None,
    workers: int,
    scheduler: str | None,
) -> None:
    """Raise one error with every fault of the arguments, before hours of work."""
    if len(stack) < 2:
        raise TooFewFramesError("one frame shows no motion: two or more are needed", len(stack))
    faults = noise_faults(conditions.noise, conditions.exposure)
    given = {"viscosity": conditions.viscosity, "temperature": conditions.temperature}
    faults += _faults_of(check_search, stack, search, refine, optics=optics)
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
    check_workers(workers, scheduler)


def _unevenness(stack: Stack) -> list[str]:
    """Say how uneven the times of the frames are."""
    if _uneven(stack) is None:
        return []
    gaps = np.diff(stack.times)
    return [
        f"times between frames run from {gaps.min():.4g} to {gaps.max():.4g} s: they are taken as "
        "they are"
    ]


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


def _located(find: Callable[[], Located], folder: Path, *, anew: bool) -> Located:
    """Locate all frames, and refuse or throw away the parts of another run."""
    import shutil

    try:
        return find()
    except PartsError as error:
        if not anew:
            raise PartsError(f"{error}; choose another folder, or anew=True") from None
    shutil.rmtree(folder)
    return find()


def _check_copies(located: Located) -> None:
    """Refuse a movie that holds fewer than three different images because the others are copies."""
    frames = located.frames
    different = int(((frames["copy_of"] < 0) & (frames["fault"] == "")).sum())
    copies = checks.repeated(frames).warnings
    if copies and different < _FEWEST:
        raise TooFewFramesError(
            f"{copies[0]}; {different} different images are left, and {_FEWEST} are needed",
            different,
        )


@dataclass(eq=False)
class _Poses:
    """Takes the motions of free centres to those fitted to the images."""

    stack: Stack
    optics: Optics | None
    bodies: Bodies
    contact: float
    folder: Path
    place: Workplace
    findings: checks.Findings = field(default_factory=checks.Findings)

    def improved(
        self, motions: Mapping[int, tuple[RigidMotion, Ints]]
    ) -> Mapping[int, RigidMotion]:
        """Refuse what moves too far, and fit the poses of the rest."""
        reasons = {c: checks.refused(m, contact=self.contact) for c, (m, _) in motions.items()}
        kept = {c: pair for c, pair in motions.items() if not reasons[c]}
        out = [f"cluster {c} was refused: {why}" for c, why in reasons.items() if why]
        more = (f"{len(out) - _LISTED} more clusters were refused",) if len(out) > _LISTED else ()
        self.findings += checks.Findings((*out[:_LISTED], *more))
        if motions and not kept:
            raise IdentityError(next(iter(reasons.values())))
        if self.optics is None or not kept:
            return {c: motion for c, (motion, _) in kept.items()}
        better, unsettled, count, remade = fit_poses(
            self.stack,
            kept,
            optics=self.optics,
            features=self.bodies.features,
            place=replace(self.place, folder=self.folder),
        )
        self.findings += checks.unsettled(unsettled, count)
        self.findings += checks.Findings(notes=tuple(remade))
        return better


def _arguments(
    conditions: Conditions, depends: Mapping[str, Any], size: int, out: Sequence[int]
) -> dict[str, Any]:
    """Return what run.json keeps of the arguments."""
    mine = {k: v for k, v in depends.items() if k not in ("sha256", "versions")}
    return told_conditions(conditions) | mine | {"size": size, "exclude": list(out)}


def _imaging(stack: Stack, located: Located, bodies: Bodies, search: Search) -> Imaging:
    z, y, x = (float(v) for v in stack.voxel)
    read = located.frames.loc[located.frames["fault"] == "", "frame"].to_numpy()
    shown = read[np.unique(np.linspace(0, len(read) - 1, min(_VIEWS, len(read))).astype(int))]
    return Imaging(
        features=bodies.features.drop(columns=["together", "border"]),
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
    bodies: Bodies,
    findings: checks.Findings,
    stack: Stack,
) -> Report:
    """Return the report with the images, with all that speaks against it and all that informs."""
    features, contact, method = bodies.features, imaging.contact, located.method
    good = (located.frames["fault"] == "") & (located.frames["copy_of"] < 0)
    read = located.frames.loc[good, "frame"].to_numpy(dtype=np.int64)
    found = (
        checks.Findings(tuple(located.told), (*stack.notes, *located.remade))
        + checks.unreadable(located.frames)
        + checks.repeated(located.frames)
        + checks.empty(located.frames, minmass=imaging.minmass)
        + checks.saturated(located.frames)
        + checks.faded(features)
        + checks.dimmed_with_depth(features)
        + checks.unrefined(features)
        + checks.pair_distance(features, contact=contact, refine=method.refine, axes=bodies.axes)
        + checks.Findings(tuple(bodies.warnings), tuple(bodies.notes))
        + checks.counts(features, size=bodies.size, contact=contact, frames=read)
        + checks.Findings(notes=tuple(_unevenness(stack)))
        + checks.at_border(features, margin=bodies.margin, dropped=bodies.dropped)
        + findings
    )
    clusters, of_clusters = _checked(report.clusters, imaging, stack)
    found += of_clusters
    return replace(
        report,
        clusters=clusters,
        warnings=(*found.warnings, *report.warnings),
        notes=(*found.notes, *report.notes),
        imaging=imaging,
    )


def _checked(
    results: Sequence[ClusterResult], imaging: Imaging, stack: Stack
) -> tuple[tuple[ClusterResult, ...], checks.Findings]:
    """Return the clusters with what speaks against one of them, and what speaks of several."""
    contact, own, found = imaging.contact, {r.name: r.warnings for r in results}, checks.Findings()
    alarms: tuple[Callable[[ClusterResult], checks.Verdict | None], ...] = (
        lambda r: checks.long_steps(r.motion, contact=contact),
        lambda r: checks.slow_sampling(r.motion),
        lambda r: checks.scan_blur(
            r.motion,
            D_T=r.D_T,
            plane_time=stack.plane_time,
            height=imaging.voxel[0],
            diameter=imaging.diameter,
        ),
    )
    for check in alarms:
        for name, text in checks.of_clusters({r.name: check(r) for r in results}).items():
            if name:
                own[name] = (*own[name], text)
            else:
                found += checks.Findings((text,))
    fast = {r.name: checks.fast_sampling(r.motion, phi2=r.noise.phi2) for r in results}
    for name, text in checks.of_clusters(fast).items():
        found += checks.Findings(notes=(f"cluster {name}: {text}" if name else text,))
    return tuple(replace(r, warnings=own[r.name]) for r in results), found
