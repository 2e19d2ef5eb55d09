"""The measurement of every cluster: its fit, its coefficients, its sizes, and pooled values."""

from __future__ import annotations

import platform
import warnings as python_warnings
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cache, partial
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from perrin._arrays import as_sigma
from perrin.diffusion.changing import with_changing_interval
from perrin.diffusion.estimate import DiffusionEstimate
from perrin.diffusion.estimators import estimate_diffusion, estimate_each, estimate_pooled
from perrin.diffusion.rods import estimate_rod
from perrin.diffusion.step_tests import (
    Jumps,
    SteadyMotion,
    cut_at,
    find_jumps_of_each,
    find_stage_jumps,
    offset_gain_of_each,
    persistence_gain,
    steady_motion_of_each,
    without_spin,
)
from perrin.diffusion.steps import Quantity, residual_freedom
from perrin.diffusion.switching import SwitchingEstimate
from perrin.diffusion.tensors import tensor_of_each
from perrin.errors import (
    DegenerateClusterError,
    IdentityWarning,
    PrecisionWarning,
    TooFewFramesError,
)
from perrin.geometry.rotations import fit_rotations, log_map
from perrin.geometry.symmetry import point_group
from perrin.hydrodynamics.units import viscosity_remarks
from perrin.motion.common_motion import common_motion
from perrin.motion.floor import floor_range
from perrin.motion.rigid_motion import RigidMotion, find_step_vectors
from perrin.motion.rigidity import Corrections, Quality, judge_each
from perrin.motion.rods import RodMotion, track_direction
from perrin.motion.tracking import track_each, track_scanned
from perrin.run import remarks as words
from perrin.run.batches import batches_of, clusters_together, shared_work
from perrin.run.experiment import Experiment, Recording
from perrin.run.grouping import assign_clusters
from perrin.run.kinds import shape_numbers, usual_symmetry
from perrin.run.predictions import (
    Shape,
    ShapeMobility,
    are_unequal,
    compare_body,
    compare_rod,
    find_sizes,
    is_known,
    solve_bodies,
)
from perrin.run.remarks import Remarks
from perrin.run.results import (
    BodyKind,
    ClusterResult,
    Pooled,
    Report,
    RodResult,
    floor_factor,
    predicted_noise,
)
from perrin.run.singles import measure_singles
from perrin.run.verdicts import fit_model, judge_alone, judge_pool
from perrin.tracks.clock import frame_stride, own_times, read_clock
from perrin.tracks.clusters import each_cluster
from perrin.tracks.identity import Identity, settle_each
from perrin.tracks.screening import (
    CENTRE_REMOVED,
    centres_removed,
    far_points_of_each,
    of_equal_shape,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from typing import TypeAlias

    import pandas as pd

    from perrin._arrays import Bools, Floats, Ints
    from perrin.diffusion.noise_model import Noise
    from perrin.diffusion.tensor_results import DiffusionTensor
    from perrin.diffusion.verdict import JudgedMotion, MotionVerdict
    from perrin.motion.floor import NoiseFloor
    from perrin.run.batches import InOrder
    from perrin.run.workers import Work

    Progress: TypeAlias = Callable[[int, int, str], None]

    # Better motions by cluster number, from the fitted bodies and the number of the first frame.
    Improve: TypeAlias = Callable[[Sequence["FittedBody"], int], Mapping[int, RigidMotion]]


# Clusters have no common D if they agree less well than this by chance.
_DISAGREEMENT = 0.003

# A steady velocity or spin is reported below this p-value, shared by all clusters of a table.
_STEADY_LEVEL = 1e-3

# A motion that is not diffusion is a warning below this p-value, shared by both quantities, and
# half of it by all clusters where several are also judged together.
_VERDICT_LEVEL = 0.005

# The symmetry of a straight chain is that of places equal within this share of its length.
_SAME_PLACE = 0.03

# Noise floor and alike steps are tested at this number of standard errors (0.05 % of clean
# tracks), the noise floor for any ratio sigma_z/sigma_xy up to this one.
_TEST_ERRORS, _NOISE_RATIO = 3.5, 5.0


@dataclass(frozen=True, eq=False)
class ClusterTracks:
    """Positions of the particles of one cluster.

    Attributes
    ----------
    cluster : int
        Cluster number.
    label : str or None
        Cluster name in the table, where it is text.
    positions : ndarray, shape (T, n, d)
        Particle positions, um, without the points that lie far from the body.
    frames : ndarray of int, shape (T,)
        Frame of each row, counted from the table's first.
    piece : ndarray of int, shape (T,)
        Number of the piece of each row: within a piece no label is in doubt.
    far : ndarray of bool, shape (T, n)
        Points that were left out because they lie far from the body.
    delay : ndarray, shape (T, n), or None
        Time of each particle after that of its frame, s; None where all are recorded at once.
    """

    cluster: int
    label: str | None
    positions: Floats
    frames: Ints
    piece: Ints
    far: Bools
    delay: Floats | None = None


@dataclass(frozen=True, eq=False)
class FittedBody:
    """The fitted motion of one cluster, its quality, and the remarks on both.

    Attributes
    ----------
    tracks : ClusterTracks
        Positions that were fitted.
    motion : RigidMotion
        Fitted positions and orientations.
    positions : ndarray, shape (T, n, d)
        Positions that the motion was fitted to, um, each column one particle.
    quality : Quality
        Rigidity, errors per axis, and what was corrected.
    remarks : Remarks
        Warnings and notes on identity and fit.
    stage : ndarray of int
        Rows at which a step ends that contains a jump of the stage and is left out of D_T.
    centre_removed : bool
        Whether the mean of the particles was subtracted, so that there is no D_T.
    """

    tracks: ClusterTracks
    motion: RigidMotion
    positions: Floats
    quality: Quality
    remarks: Remarks
    stage: Ints = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    centre_removed: bool = False


@dataclass(frozen=True, eq=False)
class Coefficient:
    """One diffusion coefficient, and what the tests of its steps found.

    Attributes
    ----------
    estimate : DiffusionEstimate
        Estimate from the steps that Brownian motion can make.
    motion : RigidMotion
        Motion that it was estimated from, cut at the steps that were left out.
    whole : RigidMotion
        The motion before that; for translation, also without the cuts where labels are in doubt.
    jumps : Jumps
        Steps that Brownian motion cannot make.
    left_out : ndarray of int
        Rows at which a step was left out of the estimate.
    brownian : bool
        Whether the tests found no jumps, no steady motion and no alike steps.
    remarks : Remarks
        Warnings and notes on this coefficient.
    verdict : MotionVerdict or None
        What kind of motion it is; None until it is judged, and where it cannot be.
    judged : JudgedMotion or None
        The verdict on the whole motion, without what the tests for jumps found.
    """

    estimate: DiffusionEstimate
    motion: RigidMotion
    whole: RigidMotion
    jumps: Jumps
    left_out: Ints
    brownian: bool
    remarks: Remarks
    verdict: MotionVerdict | None = None
    judged: JudgedMotion | None = None


@dataclass(frozen=True, eq=False)
class MeasuredBody:
    """The result of one cluster with the coefficients that it was made of.

    Attributes
    ----------
    body : FittedBody
        Fit of the cluster.
    rotation, translation : Coefficient
        Rotational and translational coefficient with the tests of their steps.
    result : ClusterResult
        Result without sizes and prediction.
    """

    body: FittedBody
    rotation: Coefficient
    translation: Coefficient
    result: ClusterResult


def measure_table(
    table: pd.DataFrame,
    experiment: Experiment,
    *,
    source: Mapping[str, str | None],
    arguments: Mapping[str, Any],
    contact: float | None = None,
    recording: Recording | None = None,
    improved: Improve | None = None,
    remarks: Remarks | None = None,
    singles: pd.DataFrame | None = None,
    progress: Progress | None = None,
    work: Work | None = None,
) -> Report:
    """Measure every cluster of a clean table: `analyze` without reading and checking.

    Parameters
    ----------
    table : pandas.DataFrame
        Table as `check_tracks` returns it, perhaps with the columns cluster and piece.
    experiment : Experiment
    source, arguments : mapping
        Input and arguments for ``run.json``.
    contact : float, optional
        Centre distance of touching particles, um, as in `analyze`.
    recording : Recording, optional
        Times of the frames and ratios of the errors, where they are not in the table.
    improved : callable, optional
        Returns better motions of the fitted bodies by cluster number, without those that have to
        be left out.
    remarks : Remarks, optional
        Remarks from reading and screening the table.
    singles : pandas.DataFrame, optional
        Tracks of single particles, as in `measure_singles`, with frames as in the table.
    progress : callable, optional
        Called with the number of finished clusters, their total, and what is done.
    work : Work, optional
        The processes that share the clusters; by default this one.

    Returns
    -------
    Report

    Raises
    ------
    TrackTableError
        If no particle belongs to a cluster, or the column time contradicts dt.
    DegenerateClusterError, TooFewFramesError
        If no cluster can be measured.
    """
    if progress is not None:
        progress(0, 0, "finding the clusters")
    table, labels, found = assign_clusters(table, contact=contact)
    remarks = found if remarks is None else remarks + found
    first = int(table["frame"].min())
    table["frame"] -= first
    recording = recording or Recording(dt=experiment.dt or np.nan)
    recording, more = complete_recording(recording, table, first_frame=first)
    remarks += more
    with shared_work(work) as in_order:
        bodies, rods, failures = fit_clusters(
            table, labels, experiment, recording, in_order=in_order, progress=progress
        )
        if improved is not None:
            motions = improved(bodies, first)
            bodies = [
                replace(b, motion=motions[b.tracks.cluster])
                for b in bodies
                if b.tracks.cluster in motions
            ]
        placed = [b for b in bodies if not b.centre_removed]
        stage = find_stage_jumps([b.motion for b in placed], [b.tracks.frames for b in placed])
        remarks.warnings.extend(
            words.stage_jump_warnings(stage, first_frame=first, kept=experiment.keep_jumps)
        )
        if not experiment.keep_jumps:
            bodies = [replace(b, stage=stage.rows(b.tracks.frames)) for b in bodies]
        measured, failed = measure_bodies(
            bodies, experiment, recording, in_order=in_order, progress=progress
        )
        failures += failed
    if failures and not (measured or rods):
        raise failures[-1][1]
    remarks += words.common_motion_remarks(
        common_motion([(m.translation.motion, m.body.tracks.frames) for m in measured])
    )
    measured, kinds, unpooled = measure_kinds(
        measured, rods, experiment, first_frame=first, progress=progress
    )
    pooled = [kind.pooled for kind in kinds if kind.pooled is not None]
    loose = None
    if singles is not None:
        shifted = singles.assign(frame=singles["frame"] - first)
        loose = measure_singles(shifted, experiment.noise, recording)
    results, rods = add_predictions([one.result for one in measured], rods, experiment)
    return Report(
        clusters=tuple(results),
        pooled=pooled[0] if len(pooled) == 1 else None,
        warnings=(
            *unpooled,
            *remarks.warnings,
            *words.left_out_warnings(failures),
            *words.common_jump_warnings(
                (
                    one.result.name,
                    one.body.tracks.frames[one.translation.jumps.rows] + first,
                    one.translation.jumps.size,
                )
                for one in measured
            ),
            *viscosity_remarks(experiment.viscosity),
        ),
        tracks=table,
        settings=run_settings(source, arguments=arguments, first_frame=first),
        rods=tuple(rods),
        notes=(*remarks.notes, *words.assumed_exposure_notes(experiment.noise)),
        kinds=tuple(kinds),
        singles=loose,
    )


def complete_recording(
    recording: Recording, table: pd.DataFrame, *, first_frame: int
) -> tuple[Recording, Remarks]:
    """Add what a table states of its frames to a recording.

    Parameters
    ----------
    recording : Recording
    table : pandas.DataFrame
        Table whose frames are counted from its first.
    first_frame : int
        The table's own number of its first frame.

    Returns
    -------
    recording : Recording
    remarks : Remarks
        Remarks on the column time and on the frame numbers.

    Raises
    ------
    TrackTableError
        If the column time contradicts dt.
    """
    remarks = Remarks()
    clock = None if recording.times is None else recording.times.from_frame(first_frame)
    if clock is None:
        clock, notes = read_clock(table, dt=recording.dt)
        clock = None if clock is None else clock.from_frame(0)
        remarks.notes.extend(notes)
        delays, notes = own_times(table, dt=recording.dt)
        remarks.notes.extend(notes)
        if delays is not None:
            table["delay"] = delays
    recorded = np.unique(table["frame"].to_numpy(dtype=np.int64))
    remarks.notes.extend(
        words.absent_frames_notes(recorded, frame_stride(table), first_frame=first_frame)
    )
    remarks.warnings.extend(words.sparse_frames_warnings(recorded))
    whole = replace(recording, times=clock, first_frame=first_frame, recorded=recorded)
    return whole, remarks


def fit_clusters(
    table: pd.DataFrame,
    labels: Mapping[int, str],
    experiment: Experiment,
    recording: Recording,
    *,
    in_order: InOrder,
    progress: Progress | None = None,
) -> tuple[list[FittedBody], list[RodResult], list[tuple[str, ValueError]]]:
    """Fit every cluster of a table, batch by batch; particles on one line are measured as rods.

    Returns
    -------
    bodies : list of FittedBody
    rods : list of RodResult
    failures : list of tuple
        Names of the clusters that cannot be fitted, with the error.
    """
    bodies: list[FittedBody] = []
    rods: list[RodResult] = []
    failures: list[tuple[str, ValueError]] = []
    count = table["cluster"][table["cluster"] >= 0].nunique()
    fit = partial(fit_batch, labels=labels, experiment=experiment, recording=recording)
    # A pose has four rows or more in most tables.
    size = clusters_together(count, len(table) // 4)
    batches = batches_of(each_cluster(table), size=size)
    if progress is not None:
        progress(0, count, "fitting clusters")
    for more_bodies, more_rods, more_failures in in_order(fit, batches):
        bodies += more_bodies
        rods += more_rods
        failures += more_failures
        if progress is not None:
            progress(len(bodies) + len(rods) + len(failures), count, "fitting clusters")
    return bodies, rods, failures


def fit_batch(
    clusters: Sequence[tuple[int, Floats, Ints, Ints, Floats | None]],
    labels: Mapping[int, str],
    experiment: Experiment,
    recording: Recording,
) -> tuple[list[FittedBody], list[RodResult], list[tuple[str, ValueError]]]:
    """Fit some clusters, as `each_cluster` gives them, as `fit_clusters` does."""
    bodies: list[FittedBody] = []
    rods: list[RodResult] = []
    failures: list[tuple[str, ValueError]] = []
    far = far_points_of_each([positions for _, positions, *_ in clusters])
    tracks = [
        ClusterTracks(
            cluster,
            labels.get(cluster),
            np.where(away[..., None], np.nan, x) if away.any() else x,
            frames,
            piece,
            away,
            delay,
        )
        for (cluster, x, frames, piece, delay), away in zip(clusters, far, strict=True)
    ]
    solid = [one for one in tracks if one.positions.shape[1:] != (2, 3)]
    fitted = iter(fit_bodies(solid, experiment, recording))
    for one in tracks:
        name = one.label or str(one.cluster)
        pair = one.positions.shape[1:] == (2, 3)
        body = None if pair else next(fitted)
        if isinstance(body, FittedBody):
            bodies.append(body)
            continue
        if body is not None and not getattr(body, "collinear", False):
            failures.append((name, body))
            continue
        try:
            rods.append(measure_rod(one, experiment, recording))
        except (DegenerateClusterError, TooFewFramesError) as error:
            failures.append((name, error if body is None else body))
        except ValueError:
            if body is None:
                raise
            failures.append((name, body))
    return bodies, rods, failures


def fit_bodies(
    tracks: Sequence[ClusterTracks], experiment: Experiment, recording: Recording
) -> list[FittedBody | DegenerateClusterError | TooFewFramesError]:
    """Settle which label belongs to which particle, fit the common shapes, and judge the fits.

    Parameters
    ----------
    tracks : sequence of ClusterTracks
    experiment : Experiment
    recording : Recording

    Returns
    -------
    list of FittedBody, DegenerateClusterError or TooFewFramesError
        The error of a cluster that cannot be fitted.
    """
    times = [recording.clock(one.frames) for one in tracks]
    # The remarks on identity state what this warning states.
    with python_warnings.catch_warnings(action="ignore", category=IdentityWarning):
        identities = settle_each([one.positions for one in tracks], times=times)
    positions = [
        identity.arranged(one.positions) for identity, one in zip(identities, tracks, strict=True)
    ]
    pieces = []
    for identity, one in zip(identities, tracks, strict=True):
        changed = one.piece[1:] != one.piece[:-1]
        changed = changed | (identity.piece[1:] != identity.piece[:-1])
        piece = np.zeros(len(one.piece), dtype=np.int64)
        piece[1:] = changed.cumsum()
        pieces.append(piece)
    motions = _tracked_bodies(
        tracks, identities, positions, pieces, times, experiment=experiment, recording=recording
    )
    fitted = [k for k, motion in enumerate(motions) if isinstance(motion, RigidMotion)]
    moving = [motion for motion in motions if isinstance(motion, RigidMotion)]
    corrections = [
        Corrections(
            *(
                tuple(tracks[k].frames[rows].tolist())
                for rows in (
                    identities[k].swaps,
                    1 + np.flatnonzero(np.diff(pieces[k])),
                    identities[k].extra,
                )
            )
        )
        for k in fitted
    ]
    qualities = judge_each(
        moving,
        [positions[k] for k in fitted],
        sigma=experiment.sigma,
        sigma_ratio=recording.stated_sigma,
        corrections=corrections,
        # Detections that were left out have no position at the instant.
        detections=[tracks[k].positions if tracks[k].delay is None else None for k in fitted],
        unsettled=[identities[k].unsettled for k in fitted],
    )
    centred = centres_removed([tracks[k].positions for k in fitted])
    bodies = [
        FittedBody(
            tracks[k],
            motion,
            positions[k],
            quality,
            identity_remarks(tracks[k], identities[k], motion, quality, recording)
            + Remarks([*quality.warnings], [*quality.notes]),
            centre_removed=still,
        )
        for k, motion, quality, still in zip(fitted, moving, qualities, centred, strict=True)
    ]
    fits = iter(bodies)
    return [next(fits) if isinstance(one, RigidMotion) else one for one in motions]


def _tracked_bodies(
    tracks: Sequence[ClusterTracks],
    identities: Sequence[Identity],
    positions: list[Floats],
    pieces: Sequence[Ints],
    times: Sequence[Floats],
    *,
    experiment: Experiment,
    recording: Recording,
) -> list[RigidMotion | DegenerateClusterError | TooFewFramesError]:
    """Fit the common shape of every body; positions of scanned ones become those at one instant."""
    found: dict[int, RigidMotion | DegenerateClusterError | TooFewFramesError] = {}
    scanned = [
        k
        for k, (one, x) in enumerate(zip(tracks, positions, strict=True))
        if one.delay is not None and x.shape[2] == 3
    ]
    for k in scanned:
        # Rigidity and errors are those of the positions at one instant.
        delays = identities[k].arranged(np.asarray(tracks[k].delay)[..., None])[..., 0]
        try:
            found[k], positions[k] = track_scanned(
                positions[k],
                delays,
                time=times[k],
                dt=recording.dt,
                piece=pieces[k],
                sigma=experiment.sigma,
                crossing=recording.crossing,
                least=recording.stated_sigma,
            )
        except (DegenerateClusterError, TooFewFramesError) as error:
            found[k] = error
    rest = [k for k in range(len(tracks)) if k not in found]
    d = positions[rest[0]].shape[2] if rest else 3
    sigma = None if experiment.sigma is None else as_sigma(experiment.sigma, d)
    # Bodies without gaps need no weights.
    complete = [bool(np.isfinite(x).all()) for x in positions]
    for whole in (True, False):
        some = [k for k in rest if complete[k] is whole]
        for rows in of_equal_shape([positions[k] for k in some]):
            numbers = [some[i] for i in rows]
            fits = track_each(
                np.stack([positions[k] for k in numbers]),
                time=np.stack([times[k] for k in numbers]),
                dt=recording.dt,
                sigma=sigma,
                piece=np.stack([pieces[k] for k in numbers]),
            )
            for k, fit in zip(numbers, fits, strict=True):
                if not isinstance(fit, RigidMotion | DegenerateClusterError | TooFewFramesError):
                    raise fit
                found[k] = fit
    return [found[k] for k in range(len(tracks))]


def identity_remarks(
    tracks: ClusterTracks,
    identity: Identity,
    motion: RigidMotion,
    quality: Quality,
    recording: Recording,
) -> Remarks:
    """State where labels were corrected or are in doubt, and which points were left out.

    Parameters
    ----------
    tracks : ClusterTracks
    identity : Identity
    motion : RigidMotion
    quality : Quality
        With the frames of the corrections.
    recording : Recording

    Returns
    -------
    Remarks
    """
    frames, first = tracks.frames, recording.first_frame
    swaps, cuts, extra = (
        np.array(some, dtype=np.int64) for some in (quality.swaps, quality.cuts, quality.extra)
    )
    remarks, count = Remarks(notes=words.far_points_notes(tracks.far, frames + first)), len(frames)
    if swaps.size:
        misfit = misfit_as_labelled(identity, tracks.positions, motion)
        text = words.corrected_labels_text(
            swaps + first, misfit=misfit, usual=float(np.nanmedian(motion.residual))
        )
        remarks.add(text, frames=swaps.size, of=count)
    if cuts.size:
        rows = np.searchsorted(frames, cuts)
        turn = motion.rotation[rows] @ np.swapaxes(motion.rotation[rows - 1], -1, -2)
        known = np.isfinite(turn).all(axis=(-2, -1))
        angles = np.linalg.norm(log_map(turn[known]), axis=-1)
        text = words.cut_text(cuts + first, angles=angles, symmetry=quality.symmetry)
        remarks.add(text, frames=cuts.size, of=count)
    if extra.size:
        remarks.add(words.extra_detection_text(extra + first), frames=extra.size, of=count)
    # The number of bad frames that a rigid body may have is part of its quality.
    remarks.notes.extend(words.unsettled_notes(frames[identity.unsettled] + first, of=count))
    remarks.warnings.extend(words.fast_turning_warnings(cuts=cuts.size, of=count))
    return remarks


def misfit_as_labelled(identity: Identity, positions: Floats, motion: RigidMotion) -> float:
    """Return the largest residual, um, that frames before their correction would have left.

    NaN where no corrected frame is complete, or where all of them are exact mirror images, which
    have no best rotation.
    """
    rows = identity.swaps[identity.swaps > 0]
    before = identity.order[rows - 1]
    x = np.take_along_axis(positions[rows], np.maximum(before, 0)[..., None], axis=1)
    points = x[(before >= 0).all(axis=1) & np.isfinite(x).all(axis=(1, 2))]
    if not len(points):
        return float("nan")
    rotation, unique = fit_rotations(points, motion.template)
    if not unique.any():
        return float("nan")
    turned = motion.template @ np.swapaxes(rotation[unique], -1, -2)
    off = (points - points.mean(axis=1, keepdims=True))[unique] - turned
    return float(np.sqrt((off**2).sum(axis=2).mean(axis=1)).max())


def measure_rod(tracks: ClusterTracks, experiment: Experiment, recording: Recording) -> RodResult:
    """Estimate how fast the direction and the centre of a straight chain diffuse."""
    frames, first = tracks.frames, recording.first_frame
    motion = track_direction(
        tracks.positions,
        dt=recording.dt,
        times=recording.clock(frames),
        sigma=experiment.sigma,
    )
    D_perp, D_T = estimate_rod(motion), estimate_rod(motion, quantity="translation")
    remarks = Remarks(
        [words.ROD_DRIFT] if experiment.noise.drift else [],
        [
            *words.no_pose_notes(motion.reason, recording.has(frames)),
            *words.far_points_notes(tracks.far, frames + first),
            words.no_rotation_note(len(motion.places)),
            words.ROD_TESTS,
        ],
    )
    if motion.swaps.size:
        text = words.exchanged_ends_text(frames[motion.swaps] + first)
        remarks.add(text, frames=motion.swaps.size, of=len(frames))
    cuts = frames[1:][np.diff(motion.piece) != 0]
    if cuts.size:
        remarks.warnings.append(words.doubtful_ends_warning(cuts + first))
    return RodResult(
        cluster=tracks.cluster,
        motion=motion,
        D_perp=D_perp,
        D_T=D_T,
        warnings=tuple(remarks.warnings),
        label=tracks.label,
        notes=tuple(remarks.notes),
    )


def measure_bodies(
    bodies: Sequence[FittedBody],
    experiment: Experiment,
    recording: Recording,
    *,
    in_order: InOrder,
    progress: Progress | None = None,
) -> tuple[list[MeasuredBody], list[tuple[str, ValueError]]]:
    """Measure all bodies, batch by batch.

    Parameters
    ----------
    bodies, experiment, recording
        As in `measure_together`.
    in_order : callable
        As `shared_work` gives it.
    progress : callable, optional
        As in `measure_table`.

    Returns
    -------
    measured : list of MeasuredBody
    failures : list of tuple
        As `measure_together`.
    """
    measured: list[MeasuredBody] = []
    failures: list[tuple[str, ValueError]] = []
    count = len(bodies)
    measure = partial(measure_together, experiment=experiment, recording=recording, tested=count)
    if progress is not None:
        progress(0, count, "estimating D_R and D_T")
    poses = sum(len(body.motion.time) for body in bodies)
    batches = batches_of(bodies, size=clusters_together(count, poses))
    for found, failed in in_order(measure, batches):
        measured += found
        failures += failed
        if progress is not None:
            done = len(measured) + len(failures)
            progress(done, count, "estimating D_R and D_T")
    return measured, failures


def measure_together(
    bodies: Sequence[FittedBody], experiment: Experiment, recording: Recording, *, tested: int
) -> tuple[list[MeasuredBody], list[tuple[str, ValueError]]]:
    """Estimate the coefficients and the tensors of some bodies, judge their motions, and remark.

    Parameters
    ----------
    bodies : sequence of FittedBody
    experiment : Experiment
    recording : Recording
    tested : int
        Number of bodies that share the level of the test for a steady motion.

    Returns
    -------
    measured : list of MeasuredBody
    failures : list of tuple
        Names of the bodies whose steps give no estimate, with the error.
    """
    failures: list[tuple[str, ValueError]] = []
    find_step_vectors([body.motion for body in bodies])
    coefficients = [
        measure_coefficients(bodies, quantity, experiment, recording, tested=tested)
        for quantity in get_args(Quantity)
    ]
    measured: list[FittedBody] = []
    turns: list[Coefficient] = []
    paths: list[Coefficient] = []
    for body, turn, path in zip(bodies, *coefficients, strict=True):
        if isinstance(turn, Coefficient) and isinstance(path, Coefficient):
            measured.append(body)
            turns.append(turn)
            paths.append(path)
            continue
        error = path if isinstance(turn, Coefficient) else turn
        failures.append((body.tracks.label or str(body.tracks.cluster), error))
    turns, paths = (judge_coefficients(some, experiment.noise) for some in (turns, paths))
    found = list(zip(measured, turns, paths, strict=True))
    turning = [
        turn.motion
        if turn.estimate.drift is None
        else without_spin(turn.motion, turn.estimate.drift[0])
        for _, turn, _ in found
    ]
    tensors = measure_tensors(turning, "rotation", experiment.noise)
    predicted = [predicted_noise(body.motion) for body, *_ in found]
    # The offset of steps that contain another motion, or of a body that bends, is no noise.
    sound = [k for k, (body, turn, _) in enumerate(found) if body.quality.rigid and turn.brownian]
    floors = noise_floor_tests(
        [(found[k][0].motion, found[k][1].estimate, predicted[k]) for k in sound],
        stated=experiment.sigma is not None,
    )
    floor = dict(zip(sound, floors, strict=True))
    results = [
        measured_body(
            *one, *tensors[k], noise=predicted[k], floor=floor.get(k, []), recording=recording
        )
        for k, one in enumerate(found)
    ]
    return results, failures


def judge_coefficients(coefficients: Sequence[Coefficient], noise: Noise) -> list[Coefficient]:
    """Judge the whole motions that some coefficients of one quantity were estimated from.

    Parameters
    ----------
    coefficients : sequence of Coefficient
    noise : Noise

    Returns
    -------
    list of Coefficient
        The same with `judged`.
    """
    shown = [k for k, one in enumerate(coefficients) if one.estimate.absent_because is None]
    if not shown:
        return list(coefficients)
    alone = judge_alone(
        [coefficients[k].whole for k in shown],
        quantity=coefficients[shown[0]].estimate.quantity,
        noise=noise,
    )
    judged = dict(zip(shown, alone, strict=True))
    return [replace(one, judged=judged.get(k)) for k, one in enumerate(coefficients)]


def measured_body(
    body: FittedBody,
    turn: Coefficient,
    path: Coefficient,
    tensor: DiffusionTensor | None,
    no_tensor: Sequence[str],
    *,
    noise: NoiseFloor,
    floor: Sequence[str],
    recording: Recording,
) -> MeasuredBody:
    """Collect what was measured of a body, and the remarks on it.

    Parameters
    ----------
    body : FittedBody
    turn, path : Coefficient
        Rotational and translational coefficient.
    tensor : DiffusionTensor or None
    no_tensor : sequence of str
        Why there is no tensor.
    noise : NoiseFloor
        Noise floor that residuals or sigma predict.
    floor : sequence of str
        Warning that the offset of the steps is not that noise.
    recording : Recording

    Returns
    -------
    MeasuredBody
    """
    tracks, motion = body.tracks, body.motion
    D_R, D_T = turn.estimate, path.estimate
    result = ClusterResult(
        cluster=tracks.cluster,
        motion=motion,
        D_R=D_R,
        D_T=D_T,
        tensor=tensor,
        noise=noise,
        sizes=None,
        warnings=(
            *body.remarks.warnings,
            *floor,
            *turn.remarks.warnings,
            *path.remarks.warnings,
            *words.limit_warnings(D_R, D_T),
        ),
        label=tracks.label,
        quality=body.quality,
        notes=(
            *words.no_pose_notes(motion.reason, recording.has(tracks.frames)),
            *body.remarks.notes,
            *turn.remarks.notes,
            *path.remarks.notes,
            *no_tensor,
        ),
        jumps={
            name: tuple(tracks.frames[rows].tolist())
            for name, rows in (
                ("rotation", turn.left_out),
                ("translation", np.union1d(path.left_out, body.stage)),
            )
            if rows.size
        },
    )
    return MeasuredBody(body, turn, path, result)


def measure_coefficients(
    bodies: Sequence[FittedBody],
    quantity: Quantity,
    experiment: Experiment,
    recording: Recording,
    *,
    tested: int,
) -> list[Coefficient | DegenerateClusterError | TooFewFramesError]:
    """Estimate one coefficient of every body from the steps that Brownian motion can make.

    Parameters
    ----------
    bodies : sequence of FittedBody
    quantity : {"rotation", "translation"}
    experiment : Experiment
    recording : Recording
    tested : int
        Number of bodies that share the level of the test for a steady motion.

    Returns
    -------
    list of Coefficient, DegenerateClusterError or TooFewFramesError
        The error of a body whose steps give no estimate.
    """
    noise = experiment.noise
    motions, paths = [], []
    for body in bodies:
        motion, path = motion_and_path(body, quantity)
        motions.append(motion)
        paths.append(path)
    found: list[Coefficient | DegenerateClusterError | TooFewFramesError | None]
    estimates = estimate_each(motions, quantity=quantity, noise=noise)
    found = [one if isinstance(one, TooFewFramesError) else None for one in estimates]
    if quantity == "translation":
        for k, body in enumerate(bodies):
            if body.centre_removed and found[k] is None:
                found[k] = no_translation(body)
    rest = [k for k, one in enumerate(found) if one is None]
    given = [one for k, one in enumerate(estimates) if k in set(rest)]
    some = [one for one in given if not isinstance(one, TooFewFramesError)]
    jumps = find_jumps_of_each([paths[k] for k in rest], some)
    without_tests: list[Coefficient] = []
    numbers: list[int] = []
    for k, estimate, own in zip(rest, some, jumps, strict=True):
        try:
            coefficient = without_jumps(
                bodies[k], motions[k], paths[k], estimate, own, experiment, recording
            )
        except (DegenerateClusterError, TooFewFramesError) as error:
            found[k] = error
            continue
        without_tests.append(coefficient)
        numbers.append(k)
    level = _STEADY_LEVEL / tested
    for k, one in zip(numbers, with_step_tests(without_tests, noise, level=level), strict=True):
        found[k] = one
    return [one for one in found if one is not None]


def no_translation(body: FittedBody) -> Coefficient:
    """Return the missing D_T of a body whose centre was subtracted from its particles."""
    motion, nothing = body.motion, np.empty(0, dtype=np.int64)
    estimate = DiffusionEstimate.absent(
        quantity="translation", n_frames=int(motion.fitted.size), reason=CENTRE_REMOVED
    )
    none = Jumps(nothing, np.empty((0, 3)), np.empty(0), 0)
    return Coefficient(estimate, motion, motion, none, nothing, True, Remarks())


def without_jumps(
    body: FittedBody,
    motion: RigidMotion,
    path: RigidMotion,
    estimate: DiffusionEstimate,
    jumps: Jumps,
    experiment: Experiment,
    recording: Recording,
) -> Coefficient:
    """Leave jumps out of an estimate, and state them.

    Parameters
    ----------
    body : FittedBody
    motion, path : RigidMotion
        Motion that D is estimated from, and the one that was searched for jumps.
    estimate : DiffusionEstimate
        Estimate from all steps.
    jumps : Jumps
    experiment : Experiment
    recording : Recording

    Returns
    -------
    Coefficient
        Before its steps are tested any further.
    """
    quantity, left_out, remarks = estimate.quantity, jumps.rows[:0], Remarks()
    if jumps.rows.size:
        frames = body.tracks.frames[jumps.rows] + recording.first_frame
        remarks.warnings.append(
            words.jump_warning(jumps, frames, quantity, kept=experiment.keep_jumps)
        )
        if not (jumps.many or experiment.keep_jumps):
            left_out = jumps.rows
            motion = cut_at(motion, left_out)
            with python_warnings.catch_warnings():
                # The estimate's own warnings are entered in the report.
                python_warnings.simplefilter("ignore", PrecisionWarning)
                estimate = estimate_diffusion(motion, quantity=quantity, noise=experiment.noise)
    remarks.notes.extend(words.removed_drift_notes(estimate, quantity))
    if not estimate.resolved:
        remarks.notes.append(f"not resolved: {estimate}")
    brownian = not jumps.rows.size
    return Coefficient(estimate, motion, path, jumps, left_out, brownian, remarks)


def with_step_tests(
    coefficients: Sequence[Coefficient], noise: Noise, *, level: float
) -> list[Coefficient]:
    """Test the steps of coefficients of one quantity for a steady motion and for likeness.

    Parameters
    ----------
    coefficients : sequence of Coefficient
    noise : Noise
    level : float
        p-value below which a motion is steady.

    Returns
    -------
    list of Coefficient
        The same with remarks.
    """
    few = [k for k, one in enumerate(coefficients) if not one.jumps.many]
    motions = [coefficients[k].motion for k in few]
    estimates = [coefficients[k].estimate for k in few]
    moving: dict[int, SteadyMotion] = {}
    if not noise.drift:
        steady_motions = steady_motion_of_each(motions, estimates, level=level)
        moving = dict(zip(few, steady_motions, strict=True))
    tested = list(coefficients)
    for k, motion, estimate in zip(few, motions, estimates, strict=True):
        one, remarks = coefficients[k], coefficients[k].remarks
        persistence = persistence_gain(motion, estimate)
        steady = k in moving and moving[k].p < level
        if steady and persistence > _TEST_ERRORS**2:
            # A steady motion makes steps alike as well; what is left without it decides.
            persistence = persistence_gain(motion, estimate, drift=True)
            steady = persistence < _TEST_ERRORS**2
        if steady:
            remarks.warnings.append(words.steady_motion_warning(moving[k], estimate.quantity))
        alike = persistence > _TEST_ERRORS**2 and not steady
        if alike:
            remarks.warnings.append(words.persistence_warning(persistence, estimate.quantity))
        tested[k] = replace(one, brownian=one.brownian and not (steady or alike))
    return tested


def motion_and_path(body: FittedBody, quantity: Quantity) -> tuple[RigidMotion, RigidMotion]:
    """Return the motion that a coefficient is estimated from, and the one to search for jumps.

    Doubt about the labels cuts a track, but the path of the centre crosses it. A jump of the stage
    cuts that path, and leaves the rotation as it is.
    """
    motion = body.motion
    if quantity == "rotation":
        return motion, motion
    whole = motion
    if motion.piece.any():
        whole = replace(motion, piece=np.zeros_like(motion.piece))
    return cut_at(motion, body.stage), cut_at(whole, body.stage)


def measure_kinds(
    measured: Sequence[MeasuredBody],
    rods: Sequence[RodResult],
    experiment: Experiment,
    *,
    first_frame: int,
    progress: Progress | None = None,
) -> tuple[list[MeasuredBody], list[BodyKind], list[str]]:
    """Judge and pool the bodies of each number of particles and shape; those of others never.

    Parameters
    ----------
    measured : sequence of MeasuredBody
    rods : sequence of RodResult
    experiment : Experiment
    first_frame : int
        The table's own number of its first frame.
    progress : callable, optional
        As in `measure_table`.

    Returns
    -------
    measured : list of MeasuredBody
        Bodies with verdicts, sorted by number of particles and shape.
    kinds : list of BodyKind
    warnings : list of str
        As in `pool_clusters`; where there are several kinds, with the kind.
    """
    shapes = shape_numbers(
        [one.body.motion.template for one in measured],
        rigid=[one.body.quality.rigid for one in measured],
    )
    lines = shape_numbers([np.outer(rod.motion.places, [0.0, 0.0, 1.0]) for rod in rods])
    judged: list[MeasuredBody] = []
    kinds: list[BodyKind] = []
    found: list[tuple[str, str]] = []

    total = 2 * len(measured)
    if progress is not None:
        progress(0, total, "judging the motion")
    for number in np.unique(shapes).tolist():
        members = [one for one, shape in zip(measured, shapes, strict=True) if shape == number]
        part, together = judge_bodies(
            members,
            experiment,
            first_frame=first_frame,
            tested=len(measured),
        )
        pooled, texts = pool_clusters(part, experiment, together)
        judged += part
        kind = BodyKind(
            size=len(part[0].body.motion.template),
            point_group=usual_symmetry([one.body.quality.symmetry for one in part]),
            clusters=tuple(one.result.cluster for one in part),
            pooled=pooled,
        )
        kinds.append(kind)
        found += [(kind.name, text) for text in texts]
    for number in np.unique(lines).tolist():
        same = [rod for rod, line in zip(rods, lines, strict=True) if line == number]
        places = same[0].motion.places
        centred = np.outer(places, [0.0, 0.0, 1.0])
        kinds.append(
            BodyKind(
                size=len(places),
                point_group=point_group(centred, tolerance=_SAME_PLACE * float(np.ptp(places))),
                clusters=tuple(rod.cluster for rod in same),
                D_perp=estimate_rod([rod.motion for rod in same]),
                D_T=estimate_rod([rod.motion for rod in same], quantity="translation"),
            )
        )
    if progress is not None:
        progress(total, total, "judging the motion")
    kinds.sort(key=lambda kind: kind.size)
    warnings = [f"{name}: {text}" if len(kinds) > 1 else text for name, text in found]
    return judged, kinds, warnings


def judge_bodies(
    measured: Sequence[MeasuredBody],
    experiment: Experiment,
    *,
    first_frame: int,
    tested: int,
) -> tuple[list[MeasuredBody], dict[str, MotionVerdict | None]]:
    """State what kind of motion every body shows, and judge all rigid ones together.

    Parameters
    ----------
    measured : sequence of MeasuredBody
    experiment : Experiment
    first_frame : int
        The table's own number of its first frame.
    tested : int
        Number of clusters that share the level of a warning.

    Returns
    -------
    measured : list of MeasuredBody
        The same with verdicts, with intervals that hold for a changing D, and with remarks.
    together : dict of MotionVerdict or None
        Verdict on the rotation and on the translation of all rigid bodies.
    """
    together: dict[str, MotionVerdict | None] = {}
    judged: dict[str, list[Coefficient]] = {}
    for quantity, coefficients in (
        ("rotation", [one.rotation for one in measured]),
        ("translation", [one.translation for one in measured]),
    ):
        shown = [i for i, c in enumerate(coefficients) if c.estimate.absent_because is None]
        judged[quantity] = list(coefficients)
        for i in shown:
            alone = coefficients[i].judged
            judged[quantity][i] = judge_coefficient(
                coefficients[i],
                None if alone is None else alone.verdict,
                measured[i].body,
                experiment,
                first_frame=first_frame,
                tested=tested,
            )
        used = [i for i in shown if measured[i].body.quality.rigid]
        common = judge_pool(
            [coefficients[i].whole for i in used],
            [coefficients[i].judged for i in used],
            noise=experiment.noise,
        )
        if common is not None and len(used) > 1:
            jumped = [i for i in used if judged[quantity][i].left_out.size]
            if jumped:
                p = min(float(judged[quantity][i].jumps.p.min()) for i in jumped)
                names = [measured[i].result.name for i in jumped]
                common = words.with_jumps(common, np.empty(0, np.int64), p=p, clusters=names)
            together[quantity] = common
        else:
            together[quantity] = next((judged[quantity][i].verdict for i in used), None)
    bodies = []
    for one, turn, path in zip(measured, judged["rotation"], judged["translation"], strict=True):
        warnings, notes = [*one.result.warnings], [*one.result.notes]
        for before, after in ((one.rotation, turn), (one.translation, path)):
            warnings += after.remarks.warnings[len(before.remarks.warnings) :]
            notes += after.remarks.notes[len(before.remarks.notes) :]
        if any(words.is_not_diffusion(text) for text in turn.remarks.warnings):
            # The offset of steps that contain another motion is no noise.
            warnings = [text for text in warnings if not words.is_noise_floor(text)]
        result = replace(
            one.result,
            D_R=turn.estimate,
            D_T=path.estimate,
            warnings=tuple(warnings),
            notes=tuple(notes),
            verdicts={"rotation": turn.verdict, "translation": path.verdict},
        )
        bodies.append(MeasuredBody(one.body, turn, path, result))
    return bodies, together


def judge_coefficient(
    coefficient: Coefficient,
    verdict: MotionVerdict | None,
    body: FittedBody,
    experiment: Experiment,
    *,
    first_frame: int,
    tested: int,
) -> Coefficient:
    """Add the verdict on a motion to its coefficient, with what follows for its D.

    Parameters
    ----------
    coefficient : Coefficient
    verdict : MotionVerdict or None
        Verdict of `judge_motion` on the whole motion.
    body : FittedBody
    experiment : Experiment
    first_frame : int
        The table's own number of its first frame.
    tested : int
        Number of clusters that share the level of a warning.

    Returns
    -------
    Coefficient
        Steps that were cut out, or would have been, are the verdict "jumps". Frames count from 0
        at the table's first. Where D changes in time its interval is that of the states.
    """
    estimate, jumps, frames = coefficient.estimate, coefficient.jumps, body.tracks.frames
    quantity, remarks = estimate.quantity, coefficient.remarks + Remarks()
    if verdict is None:
        if experiment.model is not None:
            remarks.notes.extend(words.no_model_notes([(quantity, None)], experiment.model))
        return replace(coefficient, remarks=remarks)
    if jumps.rows.size and not jumps.many:
        verdict = words.with_jumps(
            verdict, frames[jumps.rows], p=float(jumps.p.min()), first_frame=first_frame
        )
    elif verdict.kind == "jumps":
        rows = np.array(verdict.frames, dtype=np.int64)
        verdict = words.with_jumps(verdict, frames[rows], p=1.0, first_frame=first_frame)
    estimate = replace(estimate, motion=verdict.kind)
    if isinstance(verdict.model, SwitchingEstimate):
        estimate = with_changing_interval(estimate, coefficient.motion, verdict.model)
    removed = experiment.noise.drift and verdict.kind in ("drift", "spin")
    level = _VERDICT_LEVEL / 2 / (tested if tested == 1 else 2 * tested)
    # A more specific warning on the same steps, or on the body, is enough.
    unnamed = coefficient.brownian and body.quality.rigid and estimate.resolved and not removed
    if verdict.kind != "diffusion" and unnamed and verdict.p_family < level:
        remarks.warnings.append(words.not_diffusion_warning(verdict, estimate))
    if experiment.model is not None:
        try:
            model = fit_model(
                [coefficient.motion], [estimate], noise=experiment.noise, model=experiment.model
            )
            verdict = replace(verdict, model=model)
        except ValueError as error:
            remarks.notes.extend(words.no_model_notes([(quantity, error)], experiment.model))
    return replace(coefficient, estimate=estimate, verdict=verdict, remarks=remarks)


def measure_tensors(
    motions: Sequence[RigidMotion], quantity: Quantity, noise: Noise
) -> list[tuple[DiffusionTensor | None, list[str]]]:
    """Return the tensor of each motion in body axes, or None and the reason.

    In the plane there is none, and no reason is needed.
    """
    solid = [motion for motion in motions if motion.dimension == 3]
    found = iter(tensor_of_each(solid, quantity=quantity, noise=replace(noise, drift=False)))
    tensors: list[tuple[DiffusionTensor | None, list[str]]] = []
    for motion in motions:
        tensor = next(found) if motion.dimension == 3 else None
        if isinstance(tensor, ValueError):
            tensors.append((None, [f"no diffusion tensor: {tensor}"]))
        else:
            tensors.append((tensor, []))
    return tensors


def noise_floor_tests(
    bodies: Sequence[tuple[RigidMotion, DiffusionEstimate, NoiseFloor]], *, stated: bool
) -> list[list[str]]:
    """Test whether the offset of the steps is the noise that residuals or sigma predict.

    A likelihood-ratio test with one degree of freedom. Where sigma is not stated, any
    sigma_z/sigma_xy up to 5 may be behind the residuals: for a body that does not turn nothing
    else distinguishes them.

    Parameters
    ----------
    bodies : sequence of tuple
        Motion, its D_R, and the noise floor that the residuals or sigma predict.
    stated : bool
        Whether the user stated sigma.

    Returns
    -------
    list of list of str
        For every body a warning, or nothing.
    """
    outside: dict[int, tuple[float, float]] = {}
    for k, (motion, D_R, predicted) in enumerate(bodies):
        # Over a scan the offset is mostly motion, and no multiple of sigma^2.
        if D_R.noise != "joint" or not D_R.value > 0 or motion.turn_noise is not None:
            continue
        # A stated exposure takes b D, b = exposure dt/3, from the noise of every frame.
        blur = (D_R.exposure or 0.0) * motion.dt / 3 * D_R.value
        measured = floor_factor(motion) * (D_R.offset + blur)
        unsure = _TEST_ERRORS * np.sqrt(2 / max(residual_freedom(motion), 1))
        low, high = (1.0, 1.0) if stated else (max(1 - unsure, 0.0), 1 + unsure)
        within = low * predicted.phi2 <= measured <= high * predicted.phi2
        if not (within or stated) and motion.template.shape[1] == 3:
            rotation = motion.rotation[motion.fitted]
            least, most = floor_range(motion.template, rotation, ratio=_NOISE_RATIO)
            low, high = least * low, most * high
        if not low * predicted.phi2 <= measured <= high * predicted.phi2:
            nearest = high if measured > high * predicted.phi2 else low
            outside[k] = measured, float(np.sqrt(nearest * np.mean(motion.noise**2)))
    gains = offset_gain_of_each(
        [bodies[k][0] for k in outside],
        [bodies[k][1] for k in outside],
        sigma=[sigma for _, sigma in outside.values()],
    )
    warnings: list[list[str]] = [[] for _ in bodies]
    for (k, (measured, _)), gain in zip(outside.items(), gains, strict=True):
        if gain >= _TEST_ERRORS**2:
            motion, D_R, predicted = bodies[k]
            error = floor_factor(motion) * D_R.offset_stderr
            text = words.noise_floor_warning(measured, error, predicted=predicted.phi2, gain=gain)
            warnings[k].append(text)
    return warnings


def add_predictions(
    results: list[ClusterResult], rods: list[RodResult], experiment: Experiment
) -> tuple[list[ClusterResult], list[RodResult]]:
    """Add sizes, and predictions where a diameter is stated; only for a stated temperature.

    Parameters
    ----------
    results : list of ClusterResult
    rods : list of RodResult
    experiment : Experiment

    Returns
    -------
    results : list of ClusterResult
    rods : list of RodResult
    """
    if experiment.temperature is None:
        return results, rods
    known: dict[str, Any] = {
        "diameter": experiment.diameter,
        # Without a viscosity the bodies give ratios of sizes only, in which it cancels.
        "viscosity": experiment.viscosity or 1e-3,
        "temperature": experiment.temperature,
    }
    shapes = [measured_shape(one.motion.template, one.motion) for one in results]
    solved = zip(results, solve_bodies(shapes, **known), strict=True)
    results = [with_sizes(result, shape, experiment) for result, shape in solved]
    if experiment.diameter is None:
        return results, rods
    places = [np.outer(rod.motion.places, [0.0, 0.0, 1.0]) for rod in rods]
    shapes = [measured_shape(x, rod.motion) for x, rod in zip(places, rods, strict=True)]
    predicted = []
    for rod, shape in zip(rods, solve_bodies(shapes, **known), strict=True):
        if shape.mobility is None:
            lacking = words.no_prediction_warning("prediction", shape.reason)
            predicted.append(replace(rod, warnings=(*rod.warnings, lacking)))
            continue
        prediction = compare_rod(shape.mobility, D_T=rod.D_T, D_perp=rod.D_perp)
        warnings = (*rod.warnings, *shape.warnings)
        predicted.append(replace(rod, prediction=prediction, warnings=warnings))
    return results, predicted


def measured_shape(positions: Floats, motion: RigidMotion | RodMotion) -> Shape:
    """Return a measured shape with the error of its coordinates, which are means over frames."""
    return Shape(positions, float(np.nan_to_num(motion.sigma) / np.sqrt(motion.fitted.size)))


def with_sizes(
    result: ClusterResult, shape: ShapeMobility, experiment: Experiment
) -> ClusterResult:
    """Add the sizes and, for a stated diameter, the prediction, or why there are none.

    Parameters
    ----------
    result : ClusterResult
    shape : ShapeMobility
        Mobility in the axes of the motion's template.
    experiment : Experiment
        With a temperature.

    Returns
    -------
    ClusterResult
    """
    mobility, predicts = shape.mobility, experiment.diameter is not None
    if mobility is None:
        wanted = "sizes and no prediction" if predicts else "sizes"
        lacking = words.no_prediction_warning(wanted, shape.reason)
        return replace(result, warnings=(*result.warnings, lacking))
    D_T, D_R = result.D_T, result.D_R
    sizes = find_sizes(
        mobility,
        D_T=D_T,
        D_R=D_R,
        viscosity=experiment.viscosity,
        temperature=experiment.temperature or np.nan,
    )
    limited = [
        name
        for name, D in (("D_R", D_R), ("D_T", D_T))
        if D.absent_because is None and not is_known(D)
    ]
    notes = words.unresolved_size_notes(limited, others=bool(sizes))
    prediction = None
    if predicts:
        tensor_T = None
        # A drift would mix with the translation along the axes of the body.
        if not experiment.noise.drift and are_unequal(mobility.principal_D_T.values):
            tensor_T, no_tensor = measure_tensors([result.motion], "translation", experiment.noise)[
                0
            ]
            notes += no_tensor
        prediction = compare_body(
            mobility, D_T=D_T, D_R=D_R, tensor_T=tensor_T, tensor_R=result.tensor
        )
    return replace(
        result,
        sizes=sizes or None,
        prediction=prediction,
        warnings=(*result.warnings, *shape.warnings),
        notes=(*result.notes, *notes),
    )


def pool_clusters(
    measured: Sequence[MeasuredBody],
    experiment: Experiment,
    verdicts: Mapping[str, MotionVerdict | None],
) -> tuple[Pooled | None, list[str]]:
    """Pool all clusters that passed as rigid; without any nothing is pooled.

    Parameters
    ----------
    measured : sequence of MeasuredBody
    experiment : Experiment
    verdicts : mapping
        Verdict on the "rotation" and on the "translation" of all rigid clusters together.

    Returns
    -------
    pooled : Pooled or None
    warnings : list of str
        Clusters that are not pooled, coefficients on which the others do not agree, and motions
        that are not diffusion where no single cluster shows it.
    """
    used = [one for one in measured if one.body.quality.rigid]
    soft = [one.result.name for one in measured if not one.body.quality.rigid]
    warnings = [words.soft_clusters_warning(soft, nothing_else=not used)] if soft else []
    if not used:
        return None, warnings
    clusters = tuple(one.result.cluster for one in used)
    D_R, D_T = used[0].result.D_R, used[0].result.D_T
    if len(used) == 1:
        return Pooled(D_R, D_T, clusters, dict(verdicts)), warnings
    pooled, judged = {"rotation": D_R, "translation": D_T}, dict(verdicts)
    for quantity, parts in (
        ("rotation", [one.rotation for one in used]),
        (
            "translation",
            [one.translation for one in used if np.isfinite(one.result.D_T.value)],
        ),
    ):
        if not parts:
            continue
        pooled[quantity], judged[quantity], more = pool_coefficients(
            parts, verdicts[quantity], experiment
        )
        warnings += more
    D_R, D_T = pooled["rotation"], pooled["translation"]
    warnings += [
        words.disagreement_warning(name, estimate.p_same)
        for name, estimate in (("D_R", D_R), ("D_T", D_T))
        if estimate.p_same is not None and estimate.p_same < _DISAGREEMENT
    ]
    return Pooled(D_R, D_T, clusters, judged), warnings


def pool_coefficients(
    parts: Sequence[Coefficient], verdict: MotionVerdict | None, experiment: Experiment
) -> tuple[DiffusionEstimate, MotionVerdict | None, list[str]]:
    """Estimate one D for several motions, with the verdict on all of them.

    Parameters
    ----------
    parts : sequence of Coefficient
        Coefficients of one quantity.
    verdict : MotionVerdict or None
        Verdict on the motions together.
    experiment : Experiment

    Returns
    -------
    estimate : DiffusionEstimate
        Pooled D; where D changes in time, with the interval of the states.
    verdict : MotionVerdict or None
        The verdict, with the fit of the model that the experiment asks for.
    warnings : list of str
        That the motion is not diffusion, where no single motion has such a warning.
    """
    motions, noise = [one.motion for one in parts], experiment.noise
    quantity = parts[0].estimate.quantity
    each = [one.estimate for one in parts]
    estimate = estimate_pooled(motions, each, quantity=quantity, noise=noise)
    if verdict is None:
        return estimate, None, []
    estimate, warnings = replace(estimate, motion=verdict.kind), []
    if verdict.kind == "changing D":
        estimate = with_changing_interval(estimate, motions)
    removed = noise.drift and verdict.kind in ("drift", "spin")
    warned = any(
        not one.brownian or any(words.is_not_diffusion(text) for text in one.remarks.warnings)
        for one in parts
    )
    unnamed = estimate.resolved and not (removed or warned)
    if verdict.kind != "diffusion" and unnamed and verdict.p_family < _VERDICT_LEVEL / 4:
        warnings.append(words.not_diffusion_warning(verdict, estimate))
    if experiment.model is not None:
        try:
            model = fit_model(
                motions, [one.estimate for one in parts], noise=noise, model=experiment.model
            )
            verdict = replace(verdict, model=model)
        except ValueError:  # the notes of the clusters state it
            verdict = replace(verdict, model=None)
    return estimate, verdict, warnings


def measure_free_spheres(
    table: pd.DataFrame,
    experiment: Experiment,
    recording: Recording,
    *,
    source: Mapping[str, str | None],
    arguments: Mapping[str, Any],
) -> Report:
    """Return the report of a movie in which no spheres form a cluster.

    Parameters
    ----------
    table : pandas.DataFrame
        Tracks of the single spheres, as in `measure_singles`.
    experiment : Experiment
    recording : Recording
        Times of the frames.
    source, arguments : mapping
        Input and arguments for ``run.json``.

    Returns
    -------
    Report
        Without clusters; `Report.singles` has the D_T of the spheres.

    Raises
    ------
    DegenerateClusterError
        If the tracks are too few or too short for a D_T either.
    """
    first = int(table["frame"].min())
    table = table.assign(frame=table["frame"] - first, cluster=-1).reset_index(drop=True)
    clock = None if recording.times is None else recording.times.from_frame(first)
    recorded = np.unique(table["frame"].to_numpy(dtype=np.int64))
    whole = replace(recording, times=clock, first_frame=first, recorded=recorded)
    singles = measure_singles(table, experiment.noise, whole)
    if singles is None:
        raise DegenerateClusterError(
            f"no cluster: {words.NO_BODY}; single spheres are followed over too few frames for a "
            "D_T"
        )
    return Report(
        clusters=(),
        pooled=None,
        warnings=(f"no clusters: {words.NO_BODY}; {words.FREE_SPHERES}",),
        tracks=table,
        settings=run_settings(source, arguments=arguments, first_frame=first),
        notes=tuple(words.assumed_exposure_notes(experiment.noise)),
        singles=singles,
    )


@cache
def library_version(name: str) -> str | None:
    """Return the installed version of a library, None where it is missing.

    Reading a version takes some milliseconds, so that each is read once.

    Examples
    --------
    >>> library_version("numpy") == np.__version__, library_version("no-such-library")
    (True, None)
    """
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(name)
    except PackageNotFoundError:
        return None


def run_settings(
    source: Mapping[str, str | None], *, arguments: Mapping[str, Any], first_frame: int
) -> dict[str, Any]:
    """Return the content of ``run.json``, which suffices to repeat the run.

    Parameters
    ----------
    source : mapping
        Path of the input and its SHA-256.
    arguments : mapping
        Arguments of the call.
    first_frame : int
        The table's own number of its first frame.

    Returns
    -------
    dict
    """
    return {
        "input": dict(source),
        "arguments": dict(arguments),
        "first_frame": first_frame,
        "versions": {"python": platform.python_version()}
        | {name: library_version(name) for name in ("perrin", "numpy", "scipy", "pandas")},
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "seed": None,
    }
