"""`analyze_stack`: from an image stack to the diffusion coefficients of every cluster."""

from __future__ import annotations

import inspect
import shutil
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypedDict

import numpy as np

import perrin.movie.checks as checks
from perrin._arrays import finite_or_none, number_fault, options_from, refuse, refuse_unknown
from perrin.errors import IdentityError, PartsError, TooFewFramesError
from perrin.images.imaging import Imaging, View
from perrin.images.spheres.localisation import Search, check_search, is_flat
from perrin.images.spheres.spots import Spots
from perrin.images.stack import digest, file_states
from perrin.motion.error_ratio import ErrorRatio, error_ratio, with_error_ratio
from perrin.motion.scanning import scan_share
from perrin.movie.bodies import (
    Bodies,
    find_bodies,
    median_errors,
    stated_variances,
    tracks_of,
    with_true_errors,
)
from perrin.movie.colours import (
    ChannelOffset,
    check_channels,
    joined_frames,
    joined_kinds,
    joined_spots,
    kinds_of_clusters,
)
from perrin.movie.hidden import complete_bodies
from perrin.movie.stages import Located, fit_poses, locate_frames
from perrin.run.experiment import Experiment, MotionModel, Recording, merged_experiment
from perrin.run.folders import claimed_folder
from perrin.run.measure import library_version, measure_free_spheres, measure_table
from perrin.run.workers import Work, check_workers
from perrin.tracks.clock import Clock, evenly_spaced

if TYPE_CHECKING:
    import os
    from collections.abc import Mapping, Sequence
    from typing import Unpack

    import pandas as pd

    from perrin.images.optics.optics import Optics
    from perrin.images.optics.point_spread import PointSpread
    from perrin.images.spheres.localisation import Refine
    from perrin.images.stack import Stack
    from perrin.motion.rigid_motion import RigidMotion
    from perrin.run.measure import FittedBody
    from perrin.run.results import Report
    from perrin.run.workers import Progress


# Poses are fitted to the images where less than this share of the variance of the orientation is
# motion during the scan.
_SCANNED = 0.05

# Frames of two channels that begin less than this share of their interval apart are simultaneous.
_ON_TIME = 1e-6

_VIEWS = 8  # frames that are kept as pictures
_LIBRARIES = ("perrin", "numpy", "scipy", "trackpy")
_FEWEST_IMAGES = 3  # different images that a movie must have
_LISTED_REFUSALS = 10  # refused clusters that are listed one by one
_LOCATED, _POSED = "located", "posed"  # folders of finished frames


class _Run(TypedDict):
    """Input and arguments for ``run.json``."""

    source: dict[str, str | None]
    arguments: dict[str, Any]


class Settings(TypedDict, total=False):
    """Keywords of `analyze_stack` that are fields of an options object."""

    dark: bool
    minmass: float | None
    percentile: float
    border: bool
    noise: Literal["joint", "residual"] | float
    exposure: float | None
    drift: bool
    keep_jumps: bool
    model: MotionModel | None
    viscosity: float | None
    temperature: float | None
    keep: str | os.PathLike[str] | None
    anew: bool
    workers: int
    scheduler: str | None
    progress: Progress | None


# Keywords of `analyze_stack` that are values of an `Experiment`.
_EXPERIMENT_KEYWORDS = (
    "noise", "exposure", "drift", "keep_jumps", "model", "viscosity", "temperature",
)  # fmt: skip


def analyze_stack(
    stack: Stack | list[Stack] | tuple[Stack, ...],
    *,
    diameter: float,
    contact: float,
    size: int | Iterable[int] | None = None,
    frames: tuple[int | None, int | None] | None = None,
    exclude: Iterable[int] = (),
    refine: Refine = "model",
    optics: Optics | None = None,
    psf: PointSpread | None = None,
    spots: Spots | None = None,
    experiment: Experiment | None = None,
    work: Work | None = None,
    **settings: Unpack[Settings],
) -> Report:
    """Measure D_R and D_T of every cluster in a movie of image stacks.

    Spheres are located and refined (`locate`) and assigned to clusters, which are those that move
    as rigid bodies (`rigid_bodies`), the poses of the clusters are fitted to the images
    (`fit_pose`), and the motions are analysed as in `analyze`. Clusters of different numbers of
    spheres or of different shapes have pooled values of their own (`Report.kinds`).

    Parameters
    ----------
    stack : Stack, or list or tuple of Stack
        Image stack from `open_stack` or `render_stack`; for clusters of spheres in several colours
        one stack for each channel, of which each shows the spheres of one kind.
    diameter : float
        Diameter of the fluorescent sphere, um.
    contact : float
        Centre distance of touching spheres, um.
    size : int or iterable of int, optional
        Number of spheres of the clusters that are measured, or several; default: all clusters.
    frames : tuple of int or None, optional
        First frame, and first frame that is not used, as in a slice.
    exclude : iterable of int
        Numbers of clusters to leave out; the others keep theirs.
    refine, optics, psf
        As in `locate`. With "model" poses are fitted to the images as well.
    spots : Spots, optional
        How spheres are distinguished from noise.
    experiment : Experiment, optional
        Viscosity, temperature, noise, how jumps are treated, and a model of the motion, as in
        `analyze`. With viscosity
        and temperature, the report compares every cluster with the prediction for spheres of
        diameter `contact`. The time between frames and the localisation error are those of the
        images.
    work : Work, optional
        Where finished frames are kept, and which processes do the work.
    **settings
        The fields of these objects as keywords of their own: ``dark``, ``minmass``, ``percentile``,
        ``border``; ``noise``, ``exposure``, ``drift``, ``keep_jumps``, ``model``,
        ``viscosity``, ``temperature``; ``keep``, ``anew``, ``workers``, ``scheduler``,
        ``progress``.

    Returns
    -------
    Report
        With `Report.imaging`; without clusters where all spheres are free, of which
        `Report.singles` has the D_T. Results do not depend on the number of workers, nor on
        interruptions.

    Raises
    ------
    TypeError
        For an unknown keyword.
    ValueError
        For arguments out of range, or stated both in an object and as a keyword; if the folder of
        finished frames holds parts of another input or of other settings.
    NoSpheresError, DegenerateClusterError, TooFewFramesError
        If there are no spheres, none of the sizes that are wanted, or no cluster can be measured.
    IdentityError
        If particles move over half a contact distance between frames.
    OSError
        If files cannot be read or written, or the scheduler does not answer.

    Notes
    -----
    The spheres of each channel are located by themselves, with a mass cut and optics of their own,
    and then put together in the coordinates of the first channel: a constant shift of the other
    channels follows from the distances of touching spheres of different kinds, is subtracted and
    reported. Where the channels begin their frames at different times, spheres have these times.
    `Imaging.features` has the column ``kind``: the number of the channel. The motions are then
    those of the fitted centres, as no one image shows a cluster whole.

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
    import tempfile

    stacks = tuple(stack) if isinstance(stack, (list, tuple)) else (stack,)
    refuse(["stack: expected a stack or several, got none"] if not stacks else [])
    stack = stacks[0]
    if len(stack) < 2:
        raise TooFewFramesError("one frame shows no motion: two or more are needed", len(stack))
    known = [*inspect.signature(analyze_stack).parameters, *Settings.__annotations__]
    refuse_unknown("analyze_stack", settings, known)
    faults = check_channels(stacks)
    spots = options_from(Spots, spots, settings, name="spots", faults=faults)
    work = options_from(Work, work, settings, name="work", faults=faults)
    experiment = _stack_experiment(stack, experiment, settings, contact, faults)
    search = Search.of(
        stack,
        spots,
        diameter=diameter,
        contact=contact,
        refine=refine,
        crowds=True,  # clusters that meet may be a crowd for some frames
        psf=psf,
    )
    try:
        check_search(stack, search, refine, optics=optics)
    except ValueError as fault:
        faults.append(str(fault))
    sizes = _wanted_sizes(size, faults)
    refuse(faults)
    check_workers(work)

    first, stop = frames or (None, None)
    if any(end is not None and end < 0 for end in (first, stop)):
        raise ValueError(f"frames: expected A:B with whole numbers from 0 on, got {first}:{stop}")
    numbers, excluded = list(range(len(stack)))[first:stop], sorted({int(c) for c in exclude})
    if not numbers:
        raise ValueError(f"frames {first}:{stop} hold none of the stack's, 0 to {len(stack) - 1}")
    if len(numbers) < 2:
        raise TooFewFramesError("one frame shows no motion: two or more are needed", len(numbers))
    work.report(0, 0, "taking the file's SHA-256")
    before = [file_states(one) for one in stacks]
    # All values that the located spheres depend on.
    depends: list[dict[str, Any]] = [
        {
            "sha256": digest(one),
            **one.choice,
            "shape": list(one.shape),
            "voxel": [finite_or_none(v) for v in one.voxel],
            "first_frame": numbers[0],
            "last_frame": numbers[-1],
            **asdict(search),
            "refine": refine,
            "optics": None if optics is None else optics.to_dict(),
            "versions": {name: library_version(name) for name in _LIBRARIES},
        }
        for one in stacks
    ]
    with (
        claimed_folder(work.keep)
        if work.keep is not None
        else tempfile.TemporaryDirectory(prefix="perrin-")
    ) as kept:
        folder = Path(kept)
        names = [_LOCATED, *(f"{_LOCATED}-{k}" for k in range(1, len(stacks)))]
        located = [
            _located(one, search, refine, optics, numbers, own, folder / name, work)
            for one, own, name in zip(stacks, depends, names, strict=True)
        ]
        if [file_states(one) for one in stacks] != before:
            raise OSError(
                f"{stacks[0].source}: the file was written while it was read: run it again when it "
                "is complete, into another folder"
            )
        learned, findings = located[0].method.optics, checks.Findings()
        features = located[0].features
        offsets: list[ChannelOffset | None] = []
        if len(stacks) > 1:
            tables = [one.features for one in located]
            features, offsets, findings = joined_kinds(tables, contact=contact)
        bodies = find_bodies(
            features, stack, search, optics=learned, sizes=sizes, progress=work.report
        )
        corrected = tuple(
            one.corrected(own.method.pattern) for one, own in zip(stacks, located, strict=True)
        )
        poses = _PoseFits(corrected, learned, bodies, contact, folder / _POSED, work)
        errors = median_errors(bodies.features, axes=bodies.axes)
        sources = [
            {
                "path": one.source if one.path or "://" in one.source else None,
                "sha256": own["sha256"],
            }
            for one, own in zip(stacks, depends, strict=True)
        ]
        channels = [{**source, **one.choice} for one, source in zip(stacks, sources, strict=True)]
        run: _Run = {
            "source": sources[0],
            "arguments": experiment.to_dict()
            | {k: v for k, v in depends[0].items() if k not in ("sha256", "versions")}
            | {"size": sizes, "exclude": excluded}
            | {f"stated_{name}": value for name, value in stack.stated.items()}
            | ({"other_channels": channels[1:]} if len(stacks) > 1 else {}),
        }
        recording = Recording(
            stack.dt,
            _uneven_clock(stack),
            errors,
            crossing=abs(stack.plane_time or 0.0) * diameter / float(stack.voxel[0]),
        )
        if bodies.sizes or excluded:
            report = measure_table(
                with_own_times(tracks_of(bodies, exclude=excluded), *stacks),
                experiment,
                recording=recording,
                improved=poses.improved,
                singles=bodies.singles,
                progress=work.progress,
                **run,
            )
        else:
            report = measure_free_spheres(bodies.singles, experiment, recording, **run)
    findings += poses.findings
    if poses.ratio is not None:
        findings += checks.error_ratio_shown(poses.ratio, axes=bodies.axes)
        bodies = with_true_errors(bodies, poses.ratio, times=stack.times)
    return _with_checks(report, stacks, located, bodies, search, findings, offsets)


def with_own_times(table: pd.DataFrame, stack: Stack, *channels: Stack) -> pd.DataFrame:
    """Add the time of every sphere after that of its frame, s: that of the planes through it.

    Parameters
    ----------
    table : pandas.DataFrame
        Tracks with the coordinate ``z``, um, and ``kind`` where there are several channels.
    stack : Stack
        With the time from plane to plane; without it the planes of a frame have the same time.
    *channels : Stack
        The other channels, whose frames may begin later. Where neither planes nor channels have
        times of their own the table is returned as it is.
    """
    late = np.array([one.times - stack.times for one in (stack, *channels)])
    scanned = bool(stack.plane_time) and "z" in table
    if not scanned and not np.any(np.abs(late) > _ON_TIME * (stack.dt or 1.0)):
        return table
    delay = np.zeros(len(table))
    if channels:
        delay += late[table["kind"], table["frame"]]
    if scanned:
        delay += table["z"].to_numpy() / stack.voxel[0] * stack.plane_time
    return table.assign(delay=delay)


def _stack_experiment(
    stack: Stack,
    experiment: Experiment | None,
    settings: Settings,
    contact: float,
    faults: list[str],
) -> Experiment:
    """Return the experiment with the interval of the stack and the keywords; collect its faults."""
    stated: dict[str, Any] = {k: v for k, v in settings.items() if k in _EXPERIMENT_KEYWORDS}
    try:
        known = merged_experiment(experiment, **stated)
    except ValueError as fault:
        faults.append(str(fault))
        return Experiment(dt=stack.dt)
    if known.dt is not None and known.dt != stack.dt:
        faults.append(f"experiment: dt is that of the stack, {stack.dt:g} s, got {known.dt!r}")
    if known.sigma is not None:
        faults.append("experiment: sigma is computed from the images and cannot be stated")
    if known.diameter is not None and known.diameter != contact:
        faults.append(
            f"experiment: the diameter is the contact distance, {contact:g} um, got "
            f"{known.diameter!r}"
        )
    predicted = known.viscosity is not None and known.temperature is not None
    try:
        return replace(known, dt=stack.dt, sigma=None, diameter=contact if predicted else None)
    except ValueError as fault:
        faults.append(str(fault))
        return known


def _wanted_sizes(size: int | Iterable[int] | None, faults: list[str]) -> list[int] | None:
    """Return the numbers of spheres that are wanted, sorted; collect what is wrong with them."""
    if size is None:
        return None
    numbers: list[Any] = list(size) if isinstance(size, Iterable) else [size]
    numbers = [int(n) if isinstance(n, float) and n.is_integer() else n for n in numbers]
    wrong = [line for n in numbers for line in number_fault("size", n, least=2, whole=True)]
    if not numbers:
        wrong = ["size: expected one number of spheres or several, got none"]
    faults += wrong
    return None if wrong else sorted({int(n) for n in numbers})


def _uneven_clock(stack: Stack) -> Clock | None:
    """Return the times of the frames if they are not evenly spaced."""
    frames = np.arange(len(stack))
    if evenly_spaced(stack.times, frames, dt=stack.dt):
        return None
    return Clock(frames, stack.times, stack.dt)


def _located(
    stack: Stack,
    search: Search,
    refine: Refine,
    optics: Optics | None,
    frames: Sequence[int],
    depends: Mapping[str, Any],
    folder: Path,
    work: Work,
) -> Located:
    """Locate the spheres of all frames, which must show three different images."""
    for last_attempt in (not work.anew, True):
        try:
            located = locate_frames(
                stack,
                search,
                refine=refine,
                optics=optics,
                frames=frames,
                settings=depends,
                folder=folder,
                work=work,
            )
            break
        except PartsError as error:
            if last_attempt:
                raise PartsError(f"{error}; choose another folder, or anew=True") from None
            shutil.rmtree(folder)
    table = located.frames
    different = int(((table["copy_of"] < 0) & (table["fault"] == "")).sum())
    copies = checks.repeated_frames(table).warnings
    if copies and different < _FEWEST_IMAGES:
        raise TooFewFramesError(
            f"{copies[0]}; {different} different images are left, and {_FEWEST_IMAGES} are needed",
            different,
        )
    return located


@dataclass(eq=False)
class _PoseFits:
    """Replace the motions of free centres by those of poses fitted to the images.

    Where each channel shows one kind of sphere, no image shows a body whole: motions stay.
    """

    stacks: tuple[Stack, ...]
    optics: Optics | None
    bodies: Bodies
    contact: float
    folder: Path
    work: Work
    findings: checks.Findings = field(default_factory=checks.Findings)
    ratio: ErrorRatio | None = None

    def improved(self, fitted: Sequence[FittedBody], first_frame: int) -> dict[int, RigidMotion]:
        """Refuse clusters with too long steps, fit the poses of the others, and scale errors."""
        reasons = {b.tracks.cluster: checks.refusal(b.motion, contact=self.contact) for b in fitted}
        kept = {b.tracks.cluster: b for b in fitted if not reasons[b.tracks.cluster]}
        refused = [f"cluster {c} was refused: {why}" for c, why in reasons.items() if why]
        more = len(refused) - _LISTED_REFUSALS
        rest = (f"{more} more clusters were refused",) if more > 0 else ()
        self.findings += checks.Findings((*refused[:_LISTED_REFUSALS], *rest))
        if fitted and not kept:
            raise IdentityError(next(iter(reasons.values())))
        motions = {c: body.motion for c, body in kept.items()}
        # The image of a body that moves during the scan shows no single pose.
        still = {
            c: (body.motion, body.tracks.frames + first_frame)
            for c, body in kept.items()
            if scan_share(body.motion) <= _SCANNED
        }
        if self.optics is None or not still:
            return motions
        posed: dict[int, RigidMotion] = {}
        if len(self.stacks) == 1:
            whole, findings = complete_bodies(
                self.stacks[0],
                still,
                optics=self.optics,
                features=self.bodies.features,
                contact=self.contact,
            )
            self.findings += findings
            posed, findings = fit_poses(
                self.stacks[0],
                {c: (whole.get(c, motion), frames) for c, (motion, frames) in still.items()},
                optics=self.optics,
                features=self.bodies.features,
                folder=self.folder,
                work=self.work,
            )
            self.findings += findings
        stated = stated_variances(self.bodies, {c: frames for c, (_, frames) in still.items()})
        self.ratio = error_ratio(
            (kept[c].motion, kept[c].positions, variance) for c, variance in stated.items()
        )
        for c, motion in posed.items():
            mean = np.nanmean(stated[c], axis=0)
            scale = self.ratio.at(motion.time, motion.center[:, -1])
            posed[c] = with_error_ratio(motion, scale, mean)
        return motions | posed


def _with_checks(
    report: Report,
    stacks: Sequence[Stack],
    located: Sequence[Located],
    bodies: Bodies,
    search: Search,
    findings: checks.Findings,
    offsets: Sequence[ChannelOffset | None],
) -> Report:
    """Return the report with the images, and with the warnings and notes of all checks."""
    stack = stacks[0]
    imaging = _imaging(stacks, located, bodies, search, offsets)
    features, contact, method = bodies.features, imaging.contact, located[0].method
    good = np.all([(o.frames["fault"] == "") & (o.frames["copy_of"] < 0) for o in located], axis=0)
    read = located[0].frames.loc[good, "frame"].to_numpy(dtype=np.int64)
    uneven: list[str] = []
    if _uneven_clock(stack) is not None:
        gaps = np.diff(stack.times)
        uneven.append(
            f"times between frames run from {gaps.min():.4g} to {gaps.max():.4g} s: these times "
            "are used"
        )
    if len(stacks) == 1:
        found = _channel_checks(stack, located[0], features)
    else:
        found = checks.Findings()
        for k, (one, own) in enumerate(zip(stacks, located, strict=True)):
            shown = _channel_checks(one, own, features[features["kind"] == k])
            texts = (tuple(f"channel {k}: {text}" for text in part) for part in shown)
            found += checks.Findings(*texts)
        found += kinds_of_clusters(features)
    contrast = checks.Findings()
    if is_flat(stack) and method.radial is None:
        seen = [
            features.loc[features["frame"] == v.frame, ["x", "y"]].to_numpy(dtype=np.float64)
            for v in imaging.views
        ]
        contrast = checks.ring_images(
            [np.asarray(v.xy, dtype=np.float64) for v in imaging.views],
            seen,
            pixel=imaging.voxel[1:],
            diameter=imaging.diameter,
            dark=imaging.dark,
        ) + checks.overlapping_places(seen, contact=contact)
    found += (
        checks.pair_distance_bias(features, contact=contact, refine=method.refine, axes=bodies.axes)
        + checks.distances_by_direction(features, contact=contact, axes=bodies.axes)
        + checks.Findings(tuple(bodies.warnings), tuple(bodies.notes))
        + contrast
        + checks.missing_spheres(features, sizes=bodies.sizes, contact=contact, frames=read)
        + checks.Findings(notes=tuple(uneven))
        + checks.clusters_near_border(features, margin=bodies.margin, sizes=bodies.sizes)
        + findings
    )
    clusters, of_several = checks.check_clusters(report.clusters, contact=contact)
    found += of_several + checks.partial_bodies(report.clusters, report.kinds)
    return replace(
        report,
        clusters=clusters,
        warnings=(*found.warnings, *report.warnings),
        notes=(*found.notes, *report.notes),
        imaging=imaging,
    )


def _channel_checks(stack: Stack, located: Located, features: pd.DataFrame) -> checks.Findings:
    """Return the findings on the frames and the spheres of one channel."""
    return (
        checks.Findings(tuple(located.warnings), (*stack.notes, *located.notes))
        + checks.unreadable_frames(located.frames)
        + checks.repeated_frames(located.frames)
        + checks.empty_frames(located.frames, minmass=float(located.method.search.minmass or 0.0))
        + checks.saturated_frames(located.frames)
        + checks.bleached(features)
        + checks.depth_dimming(features)
        + checks.unrefined_spheres(features)
        + checks.noise_in_common(located.method.optics)
        + checks.asymmetric_point_spread(located.method.optics)
        + checks.confocal_point_spread(located.method.optics)
        + checks.changing_point_spread(located.method.optics)
        + checks.image_misfit(features, located.method.optics)
    )


def _imaging(
    stacks: Sequence[Stack],
    located: Sequence[Located],
    bodies: Bodies,
    search: Search,
    offsets: Sequence[ChannelOffset | None],
) -> Imaging:
    """Return the tables of the run, and projections of some frames along their three axes."""
    first = located[0]
    z, y, x = (float(v) for v in stacks[0].voxel)
    frames = joined_frames([one.frames for one in located])
    read = frames.loc[frames["fault"] == "", "frame"].to_numpy()
    shown = read[np.unique(np.linspace(0, len(read) - 1, min(_VIEWS, len(read))).astype(int))]
    views = []
    for i in map(int, shown):
        frame = stacks[0].frame(i)
        for one in stacks[1:]:
            frame = frame + one.frame(i).astype(np.float64)
        sides = (frame.min(axis=k) if search.dark else frame.max(axis=k) for k in range(3))
        views.append(View(i, *sides))
    cuts = [float(one.method.search.minmass or 0.0) for one in located]
    return Imaging(
        features=bodies.features.drop(columns=["together", "border"]),
        frames=frames,
        spots=joined_spots([one.spots for one in located], cuts),
        views=tuple(views),
        optics=first.method.optics,
        radial=first.method.radial,
        minmass=cuts[0],
        voxel=(z, y, x),
        diameter=search.diameter,
        contact=search.contact,
        dark=search.dark,
        refine=first.method.refine,
        distance_error=checks.distance_error(
            bodies.features, contact=search.contact, axes=bodies.axes
        ),
        other_optics=tuple(one.method.optics for one in located[1:] if one.method.optics),
        channel_offsets=tuple(
            () if offset is None else tuple(offset.value.tolist()) for offset in offsets
        ),
    )
