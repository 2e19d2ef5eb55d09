"""The main job: a track table in, the diffusion of every cluster out."""

from __future__ import annotations

import platform
import warnings as python_warnings
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from perrin._text import frames_text, listed, with_error
from perrin.diffusion.estimate import DiffusionEstimate
from perrin.diffusion.rods import estimate_rod
from perrin.diffusion.step_tests import (
    JUMP_LEVEL,
    Jumps,
    SteadyMotion,
    cut_at,
    find_jumps,
    offset_gain,
    persistence_gain,
    steady_motion,
    without_spin,
)
from perrin.diffusion.steps import residual_freedom
from perrin.diffusion.tensors import diffusion_tensor
from perrin.errors import (
    DegenerateClusterError,
    IdentityWarning,
    PrecisionWarning,
    TooFewFramesError,
    TrackTableError,
)
from perrin.geometry.rotations import fit_rotations, log_map
from perrin.hydrodynamics.units import viscosity_remarks
from perrin.motion.floor import floor_range
from perrin.motion.rigidity import Quality, judge_quality
from perrin.motion.rods import RodMotion, track_direction
from perrin.motion.tracking import track_rotation
from perrin.run.predictions import Body, Shape, are_unequal, compare_body, compare_rod, is_known
from perrin.run.results import (
    ClusterResult,
    Pooled,
    Report,
    RodResult,
    floor_factor,
    predicted_noise,
)
from perrin.tracks.clock import frame_stride, read_clock
from perrin.tracks.clusters import each_cluster, find_clusters
from perrin.tracks.identity import Identity, settle_identity
from perrin.tracks.screening import CENTRE_REMOVED, centre_removed, far_points, far_sentence

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping
    from typing import TypeAlias

    import pandas as pd

    from perrin._arrays import Bools, Floats, Ints
    from perrin.diffusion.steps import Quantity
    from perrin.diffusion.tensor_results import DiffusionTensor
    from perrin.hydrodynamics.mobility import Mobility
    from perrin.motion.floor import NoiseFloor
    from perrin.motion.rigid_motion import RigidMotion
    from perrin.run.experiment import Conditions

    # A better motion for every cluster, from its motion and the frame numbers of its rows.
    Improve: TypeAlias = Callable[
        [Mapping[int, tuple[RigidMotion, Ints]]], Mapping[int, RigidMotion]
    ]


# So few particles in so few frames may pass as one body without a cluster column.
_FEW, _FEWEST = 20, 8


# Cuts in more than this share of the frames are no accident.
_MANY_CUTS = 0.02


_ANGLES = 5  # of cuts, told one by one


# Clusters that agree less well than this by chance have no common D.
_DIFFER = 0.003


# A steady velocity or spin is reported below this p-value, shared by all clusters of a table.
_STEADY = 1e-3


# Identity corrected in this share of the frames, at most, is information.
_FEW_FRAMES = 0.01


# Jumps of a length that differs by less than this share are all of one length.
_ONE_LENGTH = 0.3


_SHOWN_JUMPS = 5


# Of frame numbers at least one in this many occurs; numbers that are times in ms have fewer.
_SPARSE = 100


# The noise floor is tested at this many standard errors (0.05 % of clean tracks), for any ratio
# sigma_z/sigma_xy up to this one.
_FLOOR_ERRORS, _NOISE_RATIO = 3.5, 5.0


@dataclass(frozen=True)
class Remarks:
    """What there is to report of a table as a whole."""

    warnings: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def measure_table(
    table: pd.DataFrame,
    conditions: Conditions,
    *,
    source: Mapping[str, str | None],
    arguments: Mapping[str, Any],
    contact: float | None = None,
    improved: Improve | None = None,
    remarks: Remarks | None = None,
) -> Report:
    """Measure every cluster of a clean table; `analyze` without its door.

    Parameters
    ----------
    table : pandas.DataFrame
        As `check_tracks` returns it, perhaps with cluster and piece.
    conditions : Conditions
    source, arguments : mapping
        For run.json.
    contact : float, optional
        As in `analyze`.
    improved : callable, optional
        Given the fitted bodies by cluster number, returns their motions from better data, without
        those that have to be left out.
    remarks : Remarks, optional
        What reading and screening the table brought up.
    """
    remarks = Remarks() if remarks is None else remarks
    table, labels, more = _clustered(table, contact=contact)
    remarks = Remarks([*remarks.warnings, *more.warnings], [*remarks.notes, *more.notes])
    first = int(table["frame"].min())
    table["frame"] -= first
    clock = None if conditions.times is None else conditions.times.from_frame(first)
    if clock is None:
        clock, notes = read_clock(table, dt=conditions.dt)
        clock = None if clock is None else clock.from_frame(0)
        remarks.notes.extend(notes)
    recorded = np.unique(table["frame"].to_numpy(dtype=np.int64))
    stride = frame_stride(table)
    remarks.notes.extend(_absent_frames(recorded, stride, first))
    remarks.warnings.extend(_sparse_frames(recorded))
    conditions = replace(conditions, times=clock, first_frame=first, recorded=recorded)
    bodies, rods, failures = _fitted(table, labels, conditions)
    if improved is not None:
        motions = improved({b.cluster: (b.motion, b.frames + first) for b in bodies})
        bodies = [b._replace(motion=motions[b.cluster]) for b in bodies if b.cluster in motions]
    done = _estimated(bodies, conditions)
    failures += done.failures
    if failures and not (done.results or rods):
        raise failures[-1].error
    results, rods = _interpreted(done.results, rods, conditions)
    pooled, unpooled = _pooled(results, done.motions, conditions)
    warnings = (
        *unpooled,
        *remarks.warnings,
        *_failures_text(failures),
        *_common_jumps(done.jumps),
        *viscosity_remarks(conditions.viscosity),
    )
    remarks.notes.extend(_assumed_exposure(conditions))
    settings = _settings(source, arguments=arguments, first_frame=first)
    return Report(
        tuple(results), pooled, warnings, table, settings, tuple(rods), notes=tuple(remarks.notes)
    )


def _absent_frames(recorded: Ints, stride: tuple[str, ...], first: int) -> list[str]:
    """Report frame numbers that no row has; where they have a stride, that explains them."""
    absent = int(recorded[-1]) + 1 - len(recorded)
    if stride or not absent or absent > _SPARSE * len(recorded):
        return list(stride)
    before = recorded[np.flatnonzero(np.diff(recorded) > 1)[:1]]
    count = "1 frame number has" if absent == 1 else f"{absent} frame numbers have"
    return [
        f"{count} no row (the first is {int(before[0]) + 1 + first}): a step across them is one "
        "longer step"
    ]


def _sparse_frames(recorded: Ints) -> list[str]:
    """Warn of numbers of which so few occur that they are hardly numbers of frames."""
    span = int(recorded[-1]) + 1
    if span <= _SPARSE * len(recorded) or len(recorded) < 2:
        return []
    return [
        f"frame numbers: only {len(recorded)} of the {span} numbers from the first to the last "
        "occur, and each counts dt; if they are times, number the frames 0, 1, 2, ... and state "
        "the times in a column time"
    ]


def _clustered(
    table: pd.DataFrame, *, contact: float | None
) -> tuple[pd.DataFrame, dict[int, str], Remarks]:
    """Make sure that every row has a cluster number; return it, names of clusters, and remarks."""
    given, remarks = table, Remarks()
    if "z" in table and table["z"].nunique() == 1:
        remarks.warnings.append(
            "z never changes: leave the column out to analyse motion in the plane"
        )
    labels: dict[int, str] = {}
    if "cluster" in table:
        table, labels = _numbered(table)
    else:
        table, grouping = _grouped(table, contact=contact)
        remarks.notes.extend(grouping)
    loose = table["cluster"] == -1
    if loose.all():
        raise TrackTableError(_nothing_found(contact, marked="cluster" in given))
    if loose.any():
        count = table.loc[loose, "particle"].nunique()
        remarks.notes.append(f"{count} particles belong to no cluster and are left out")
    return table, labels, remarks


def _grouped(table: pd.DataFrame, *, contact: float | None) -> tuple[pd.DataFrame, list[str]]:
    """Find the clusters of a table without that column, pairs where there is nothing larger."""
    count, frames = table["particle"].nunique(), table["frame"].nunique()
    if contact is None and frames < _FEWEST and count <= _FEW:
        # Distances seen so rarely tell nothing; few particles may still be one body.
        found = table.assign(cluster=0)
    else:
        found = find_clusters(table, contact=contact)
        if (found["cluster"] == -1).all():
            found = find_clusters(table, contact=contact, size=2)
    if contact is not None:
        return found, []
    if (found["cluster"] == 0).all():
        return found, [
            "no cluster column and no contact distance: all "
            f"{count} particles are taken as one cluster"
        ]
    bodies = int(found["cluster"].max()) + 1
    return found, [
        f"no cluster column and no contact distance: {bodies} bodies found by the distances that "
        f"stay the same, among {count} particles"
    ]


def _nothing_found(contact: float | None, *, marked: bool) -> str:
    """Say why there is no cluster, and what to do."""
    if marked:
        return "no cluster: every particle is marked as loose (-1); correct that, or the scale"
    if contact is not None:
        how = f"loose at contact = {contact} um"
        return f"no cluster: every particle is {how}; correct that, or the scale"
    return (
        "no cluster: no two particles keep their distance (to a tenth, over 8 frames or more): say "
        "the centre distance of touching particles (contact=), or give a column cluster"
    )


def _numbered(table: pd.DataFrame) -> tuple[pd.DataFrame, dict[int, str]]:
    """Give clusters that have names a number, in the order of the names; -1 is none."""
    import pandas as pd

    if pd.api.types.is_numeric_dtype(table["cluster"]):
        return table.astype({"cluster": np.int64}), {}
    codes, names = pd.factorize(table["cluster"], sort=True)
    labels = {i: str(name) for i, name in enumerate(names)}
    return table.assign(cluster=codes.astype(np.int64)), labels


def _fitted(
    table: pd.DataFrame, labels: dict[int, str], conditions: Conditions
) -> tuple[list[_Body], list[RodResult], list[_Failure]]:
    """Fit cluster by cluster; return bodies, rods, and what cannot answer."""
    bodies: list[_Body] = []
    rods: list[RodResult] = []
    failures: list[_Failure] = []
    for cluster, positions, frames, piece in each_cluster(table):
        label = labels.get(cluster)
        try:
            far = far_points(positions)
            tracks = _Tracks(np.where(far[..., None], np.nan, positions), frames, piece, far)
            found = _fit(tracks, cluster, label, conditions)
            if isinstance(found, RodResult):
                rods.append(found)
            else:
                bodies.append(found)
        except (DegenerateClusterError, TooFewFramesError) as error:
            failures.append(_Failure(label or str(cluster), error))
    return bodies, rods, failures


class _Failure(NamedTuple):
    """A cluster that cannot answer, and why."""

    name: str
    error: DegenerateClusterError | TooFewFramesError

    @property
    def reason(self) -> str:
        return str(self.error)


def _failures_text(failures: list[_Failure]) -> list[str]:
    """Name the clusters that were left out, each reason once."""
    by_reason: dict[str, list[str]] = {}
    for failure in failures:
        by_reason.setdefault(failure.reason, []).append(failure.name)
    return [
        f"cluster{'s' if len(names) > 1 else ''} {listed(names)} "
        f"{'were' if len(names) > 1 else 'was'} left out: {reason}"
        for reason, names in by_reason.items()
    ]


class _Tracks(NamedTuple):
    """One cluster's particles: positions (T, n, d), frame numbers, pieces the table brought.

    `far` (T, n) marks points that were left out because they lie far from the body.
    """

    positions: Floats
    frames: Ints
    piece: Ints
    far: Bools

    def far_text(self, first: int) -> list[str]:
        """State which points were left out."""
        return [far_sentence(self.far, self.frames + first)] if self.far.any() else []


class _Body(NamedTuple):
    """One cluster's fitted motion, its quality, and the remarks on both."""

    cluster: int
    label: str | None
    frames: Ints
    motion: RigidMotion
    quality: Quality
    warnings: tuple[str, ...]
    notes: tuple[str, ...]
    centred: bool


def _fit(
    tracks: _Tracks, cluster: int, label: str | None, conditions: Conditions
) -> _Body | RodResult:
    """Fit a body, or measure the direction of a rod that has no full orientation."""
    if tracks.positions.shape[1:] == (2, 3):
        return _measure_rod(tracks, cluster, label, conditions)
    try:
        return _fit_body(tracks, cluster, label, conditions)
    except DegenerateClusterError as error:
        if not error.collinear:
            raise
        try:
            return _measure_rod(tracks, cluster, label, conditions)
        except (DegenerateClusterError, ValueError):
            raise error from None


def _fit_body(tracks: _Tracks, cluster: int, label: str | None, conditions: Conditions) -> _Body:
    """Settle which label belongs to which particle, fit the common shape, and judge the fits."""
    frames = tracks.frames
    # The remarks on identity state what this warning would.
    with python_warnings.catch_warnings(action="ignore", category=IdentityWarning):
        identity = settle_identity(tracks.positions, times=conditions.clock(frames))
    positions = identity.arranged(tracks.positions)
    changed = (np.diff(tracks.piece) != 0) | (np.diff(identity.piece) != 0)
    piece = np.append(0, np.cumsum(changed)).astype(np.int64)
    motion = track_rotation(
        positions,
        dt=conditions.dt,
        times=conditions.clock(frames),
        sigma=conditions.sigma,
        piece=piece,
    )
    quality = judge_quality(
        motion,
        positions,
        sigma=conditions.sigma,
        sigma_ratio=conditions.sigma_ratio,
        detections=tracks.positions,
        unsettled=tuple(identity.unsettled.tolist()),
        swaps=tuple(frames[identity.swaps].tolist()),
        cuts=tuple(frames[1:][changed].tolist()),
        extra=tuple(frames[identity.extra].tolist()),
    )
    warnings, notes = _identity_remarks(
        quality, identity, tracks, motion, first=conditions.first_frame
    )
    return _Body(
        cluster,
        label,
        frames,
        motion,
        quality,
        (*warnings, *quality.warnings),
        (*tracks.far_text(conditions.first_frame), *notes, *quality.notes),
        centred=centre_removed(tracks.positions),
    )


@dataclass
class _Estimated:
    """The results of all bodies, and what later steps need of how they were made.

    `motions` are those that D was estimated from, by cluster and quantity; `jumps` are the frames
    at which a cluster jumps with the displacements of its centre.
    """

    results: list[ClusterResult] = field(default_factory=list)
    failures: list[_Failure] = field(default_factory=list)
    motions: dict[tuple[int, Quantity], RigidMotion] = field(default_factory=dict)
    jumps: dict[int, list[tuple[str, Floats]]] = field(default_factory=dict)


def _estimated(bodies: list[_Body], conditions: Conditions) -> _Estimated:
    """Estimate the coefficients of every body; keep what cannot answer with its reason."""
    done = _Estimated()
    for body in bodies:
        try:
            _estimate_body(body, conditions, done, bodies=len(bodies))
        except (DegenerateClusterError, TooFewFramesError) as error:
            done.failures.append(_Failure(body.label or str(body.cluster), error))
    return done


@dataclass(frozen=True)
class _Diffusion:
    """One coefficient, the motion it was estimated from, and what its steps show beside it."""

    estimate: DiffusionEstimate
    motion: RigidMotion
    jumps: Jumps
    left_out: Ints
    steady: bool
    persistent: bool
    warnings: tuple[str, ...]
    notes: tuple[str, ...]


def _estimate_body(body: _Body, conditions: Conditions, done: _Estimated, *, bodies: int) -> None:
    """Estimate the coefficients of a body, and collect the remarks on them."""
    motion = body.motion
    turn = _diffusion(body, "rotation", conditions, bodies=bodies)
    path = _diffusion(body, "translation", conditions, bodies=bodies)
    D_R, D_T = turn.estimate, path.estimate
    noise = predicted_noise(motion)
    turning = turn.motion
    if D_R.drift is not None:
        turning = without_spin(turning, D_R.drift[0])
    tensor, unfound = _tensor(turning, conditions)
    # The offset of steps that contain another motion, or of a body that bends, is no noise.
    floor: list[str] = []
    if body.quality.rigid and not (turn.steady or turn.persistent or turn.jumps.rows.size):
        floor = _floor_mismatch(motion, D_R, noise, stated=conditions.sigma is not None)
    warnings = (
        *body.warnings,
        *floor,
        *turn.warnings,
        *path.warnings,
        *_limits_text(D_R, D_T),
    )
    result = ClusterResult(
        body.cluster,
        motion,
        D_R,
        D_T,
        tensor,
        noise,
        None,
        warnings,
        body.label,
        body.quality,
        notes=(
            *_missing(motion, body.frames, conditions),
            *body.notes,
            *turn.notes,
            *path.notes,
            *unfound,
        ),
        jumps={
            name: tuple(body.frames[found.left_out].tolist())
            for name, found in (("rotation", turn), ("translation", path))
            if found.left_out.size
        },
    )
    done.results.append(result)
    done.motions[body.cluster, "rotation"] = turn.motion
    done.motions[body.cluster, "translation"] = path.motion
    for row, move in zip(path.jumps.rows, path.jumps.size, strict=True):
        frame = int(body.frames[row]) + conditions.first_frame
        done.jumps.setdefault(frame, []).append((result.name, move))


def _diffusion(
    body: _Body, quantity: Quantity, conditions: Conditions, *, bodies: int
) -> _Diffusion:
    """Estimate one coefficient from the steps that Brownian motion can make.

    `bodies` is the number of clusters tested: the level of the steady motion is one for all.
    """
    motion = body.motion
    if body.centred and quantity == "translation":
        nothing = np.empty(0, dtype=np.int64)
        estimate = DiffusionEstimate.absent(
            quantity=quantity, n_frames=int(motion.fitted.size), reason=CENTRE_REMOVED
        )
        none = Jumps(nothing, np.empty((0, 3)), np.empty(0), 0)
        return _Diffusion(estimate, motion, none, nothing, False, False, (), ())
    estimate = conditions.estimate(motion, quantity)
    # Doubt about the labels cuts the track, but the centre's path goes on across it.
    path = motion if quantity == "rotation" else replace(motion, piece=np.zeros_like(motion.piece))
    jumps = find_jumps(path, estimate)
    left_out = jumps.rows[:0]
    warnings: list[str] = []
    if jumps.rows.size:
        frames = body.frames[jumps.rows] + conditions.first_frame
        warnings.append(_jumps_text(jumps, frames, quantity, kept=conditions.keep_jumps))
        if not (jumps.many or conditions.keep_jumps):
            left_out = jumps.rows
            motion = cut_at(motion, left_out)
            estimate = conditions.estimate(motion, quantity)
    notes = _drift_text(estimate, quantity)
    if not estimate.resolved:
        notes.append(f"not resolved: {estimate}")
    steady = False
    persistent = 0.0 if jumps.many else persistence_gain(motion, estimate)
    if not (conditions.drift or jumps.many):
        found = steady_motion(motion, estimate)
        steady = found.p < _STEADY / bodies
        if steady and persistent > _FLOOR_ERRORS**2:
            # A steady motion makes steps alike as well; what is left without it decides.
            persistent = persistence_gain(motion, estimate, drift=True)
            steady = persistent < _FLOOR_ERRORS**2
        warnings += [_steady_text(found, quantity)] if steady else []
    if persistent > _FLOOR_ERRORS**2 and not steady:
        warnings.append(_persistent_text(persistent, quantity))
    return _Diffusion(
        estimate=estimate,
        motion=motion,
        jumps=jumps,
        left_out=left_out,
        steady=steady,
        persistent=persistent > _FLOOR_ERRORS**2 and not steady,
        warnings=tuple(warnings),
        notes=tuple(notes),
    )


def _limits_text(D_R: DiffusionEstimate, D_T: DiffusionEstimate) -> list[str]:
    """State where an estimate leaves the conditions under which it is exact, each limit once.

    An upper limit is stated as one and needs no word on its signal-to-noise ratio.
    """
    named: dict[str, list[str]] = {}
    for name, estimate in (("D_R", D_R), ("D_T", D_T)):
        for text in estimate.warnings:
            if estimate.resolved or not text.startswith("signal-to-noise"):
                named.setdefault(text, []).append(name)
    return [f"{' and '.join(names)}: {text}" for text, names in named.items()]


def _jumps_text(jumps: Jumps, frames: Ints, quantity: Quantity, *, kept: bool) -> str:
    """Name the steps that Brownian motion cannot make, with frame and size."""
    turn = quantity == "rotation"
    name, unit = ("D_R", "deg") if turn else ("D_T", "um")
    what = "the body turns" if turn else "the centre moves"
    length = np.rad2deg(jumps.length) if turn else jumps.length
    shown = _amounts(length, unit)
    if jumps.many:
        return (
            f"steps: {what} in {len(frames)} of {jumps.n_steps} steps farther than Brownian motion "
            f"can (the longest {length.max():.3g} {unit}, at frame {frames[np.argmax(length)]})"
            f"{_wrapping(jumps, quantity)}: so many are usually another kind of motion (hops, a "
            f"changing D, heavy tails), which one {name} does not describe; they are left in"
        )
    done = f"{name} contains them" if kept else f"{name} leaves them out (keep_jumps keeps them)"
    if len(frames) == 1:
        done = done.replace("them", "it")
    return (
        f"jump: {what} by {shown} in one step, at {frames_text(frames)}"
        f"{_wrapping(jumps, quantity)}; Brownian motion does so with a probability below "
        f"{JUMP_LEVEL:g} in the whole track; {done}"
    )


def _amounts(values: Floats, unit: str) -> str:
    return f"{listed([f'{v:.3g}' for v in values])} {unit}"


def _wrapping(jumps: Jumps, quantity: Quantity) -> str:
    """Report jumps that all have one length along one axis each: coordinates in a periodic box."""
    if quantity == "rotation" or len(jumps.rows) < 2:
        return ""
    size = np.abs(jumps.size)
    largest = size.max(axis=1)
    usual = float(np.median(largest))
    alike = np.mean(np.abs(largest - usual) < _ONE_LENGTH * usual)
    if alike < 0.8 or np.mean(np.sort(size, axis=1)[:, -2] < 0.5 * largest) < 0.8:
        return ""
    return f", most of them by about {usual:.3g} um along one axis, as coordinates wrapped in a box"


def _persistent_text(gain: float, quantity: Quantity) -> str:
    """Name steps that are more alike than motion blur can make them."""
    turn = quantity == "rotation"
    return (
        f"steps: successive {'turns of the body' if turn else 'displacements of the centre'} are "
        "more alike than a shutter that is open all the time makes them (likelihood ratio, "
        f"{np.sqrt(gain):.1f} standard errors): smoothed or interpolated tracks, or a persistent "
        f"motion; {'D_R' if turn else 'D_T'} does not describe it"
    )


def _steady_text(found: SteadyMotion, quantity: Quantity) -> str:
    """Name a steady velocity or spin with its error and the remedy."""
    turn = quantity == "rotation"
    value, error = np.array(found.value), np.array(found.stderr)
    size = float(np.linalg.norm(value))
    stderr = float(np.linalg.norm(value * error) / size)
    unit, name = ("rad/s", "D_R") if turn else ("um/s", "D_T")
    what = "the body turns" if turn else "the centre moves"
    way = ""
    if len(value) > 1:
        along = ", ".join(f"{v:.2f}" for v in value / size)
        way = f" {'about' if turn else 'along'} ({along})"
    return (
        f"steady motion: {what} steadily at {with_error(size, stderr)} {unit}{way} (F test, p = "
        f"{found.p:.1g}), and {name} contains that; drift=True takes it off"
    )


def _drift_text(estimate: DiffusionEstimate, quantity: Quantity) -> list[str]:
    """State which mean velocity or spin was taken off."""
    if estimate.drift is None or estimate.drift_stderr is None:
        return []
    axes = "xyz" if len(estimate.drift[0]) > 1 else "z"
    parts = zip(axes, estimate.drift[0], estimate.drift_stderr[0], strict=False)
    shown = ", ".join(f"{axis} {with_error(v, e)}" for axis, v, e in parts)
    if quantity == "rotation":
        return [f"D_R is about a mean spin of {shown} rad/s, which was taken off"]
    return [f"D_T is about a mean velocity of {shown} um/s, which was taken off"]


def _common_jumps(jumps: dict[int, list[tuple[str, Floats]]]) -> list[str]:
    """Name frames at which several clusters jump: exchanged clusters, or a jump of the stage."""
    shared = sorted((frame, found) for frame, found in jumps.items() if len(found) > 1)
    return [
        f"jump: clusters {listed(name for name, _ in found)} jump at the same frame {frame}: "
        f"{_common_cause(np.array([move for _, move in found]))}"
        for frame, found in shared[:_SHOWN_JUMPS]
    ]


def _common_cause(moves: Floats) -> str:
    """Tell a jump of all clusters by one vector from clusters that take each other's place."""
    typical = float(np.mean(np.linalg.norm(moves, axis=1)))
    together = float(np.linalg.norm(moves.mean(axis=0)))
    if together > 0.8 * typical:
        return "the stage or the camera moved"
    if together < 0.2 * typical:
        return "their labels were exchanged"
    return "labels were exchanged, or the stage turned"


def _tensor(
    motion: RigidMotion, conditions: Conditions, quantity: Quantity = "rotation"
) -> tuple[DiffusionTensor | None, list[str]]:
    """Return the tensor in body axes, or None and the reason; in the plane there is none."""
    if motion.template.shape[1] != 3:
        return None, []
    try:
        with python_warnings.catch_warnings():
            python_warnings.simplefilter("ignore", PrecisionWarning)
            tensor = diffusion_tensor(
                motion,
                quantity=quantity,
                noise=conditions.noise,
                exposure=conditions.exposure,
            )
    except ValueError as error:
        return None, [f"no diffusion tensor: {error}"]
    return tensor, []


def _measure_rod(
    tracks: _Tracks, cluster: int, label: str | None, conditions: Conditions
) -> RodResult:
    """Estimate how fast the direction and the centre of a straight chain diffuse."""
    frames, dt = tracks.frames, conditions.dt
    motion = track_direction(
        tracks.positions, dt=dt, times=conditions.clock(frames), sigma=conditions.sigma
    )
    D_perp, D_T = estimate_rod(motion), estimate_rod(motion, quantity="translation")
    first = conditions.first_frame
    notes = [
        *_missing(motion, frames, conditions),
        *tracks.far_text(first),
        f"no D_R: {len(motion.places)} particles on one line have a direction but no full "
        "orientation; D_perp is how fast that direction diffuses",
    ]
    notes.append("jumps and a steady motion of a rod are not tested for")
    warnings: list[str] = []
    if conditions.drift:
        warnings.append("drift=True is not applied to rods: D_T and D_perp contain a mean motion")
    if motion.swaps.size:
        swaps = frames[motion.swaps] + first
        text = f"identity: the ends exchange labels at {frames_text(swaps)}; corrected"
        (warnings if motion.swaps.size > _FEW_FRAMES * len(frames) else notes).append(text)
    cuts = frames[1:][np.diff(motion.piece) != 0]
    if cuts.size:
        warnings.append(
            f"identity: the ends may be mistaken at {frames_text(cuts + first)}; the track is cut"
        )
    return RodResult(cluster, motion, D_perp, D_T, tuple(warnings), label, notes=tuple(notes))


def _identity_remarks(
    quality: Quality, identity: Identity, tracks: _Tracks, motion: RigidMotion, *, first: int
) -> tuple[list[str], list[str]]:
    """Name the frames at which labels were corrected, a track cut, or a detection left out.

    What concerns less than 1 % of the frames is a note, the rest a warning.
    """
    warnings: list[str] = []
    notes: list[str] = []
    count = len(tracks.frames)

    def remark(frames: Iterable[int], text: str) -> None:
        (warnings if len(list(frames)) > _FEW_FRAMES * count else notes).append(text)

    def at(frames: Iterable[int]) -> str:
        return frames_text(k + first for k in frames)

    if quality.swaps:
        remark(
            quality.swaps,
            f"identity: labels change particles at {at(quality.swaps)}; corrected"
            f"{_misfit_text(identity, tracks, motion)}",
        )
    if quality.cuts:
        remark(
            quality.cuts,
            f"identity: which label belongs to which particle is in doubt at {at(quality.cuts)}; "
            f"the track is cut there{_angles_text(quality, tracks, motion)}",
        )
    if quality.extra:
        remark(
            quality.extra,
            f"identity: a detection that is no particle of the body is left out at "
            f"{at(quality.extra)}",
        )
    unsettled = tracks.frames[identity.unsettled]
    if unsettled.size:
        # How many bad frames a rigid body may have is judged by its quality.
        notes.append(
            f"identity: {unsettled.size} of {count} frames fit the common shape in no assignment "
            f"({at(unsettled.tolist())}); they keep their labels"
        )
    if len(quality.cuts) > _MANY_CUTS * count:
        warnings.append(
            "identity: the body turns too far between frames for its symmetry; cutting the longest "
            "steps makes D_R too low: sample faster"
        )
    return warnings, notes


def _misfit_text(identity: Identity, tracks: _Tracks, motion: RigidMotion) -> str:
    """Return which residual the corrected frames would have left with the labels as they came."""
    rows = identity.swaps[identity.swaps > 0]
    before = identity.order[rows - 1]
    x = np.take_along_axis(tracks.positions[rows], np.maximum(before, 0)[..., None], axis=1)
    whole = (before >= 0).all(axis=1) & np.isfinite(x).all(axis=(1, 2))
    if not whole.any():
        return ""
    points = x[whole]
    # An exact mirror image has no best rotation; it is left out.
    rotation, unique = fit_rotations(points, motion.template)
    if not unique.any():
        return ""
    turned = motion.template @ np.swapaxes(rotation[unique], -1, -2)
    off = (points - points.mean(axis=1, keepdims=True))[unique] - turned
    worst = float(np.sqrt((off**2).sum(axis=2).mean(axis=1)).max())
    usual = float(np.nanmedian(motion.residual))
    return f" (residual as labelled up to {worst:.3g} um against {usual:.3g} median)"


def _angles_text(quality: Quality, tracks: _Tracks, motion: RigidMotion) -> str:
    """Return how far the body turns where the track is cut, as far as the fits show."""
    rows = np.searchsorted(tracks.frames, quality.cuts)
    turn = motion.rotation[rows] @ np.swapaxes(motion.rotation[rows - 1], -1, -2)
    known = np.isfinite(turn).all(axis=(-2, -1))
    if not known.any():
        return ""
    angle = np.rad2deg(np.linalg.norm(log_map(turn[known]), axis=-1))
    listed = ", ".join(f"{a:.0f}" for a in angle[:_ANGLES])
    return (
        f" (step angle{'s' if angle.size > 1 else ''} {listed}"
        f"{', ...' if angle.size > _ANGLES else ''} deg: a jump of the body's symmetry, "
        f"{quality.symmetry}, cannot be told from a real turn)"
    )


def _missing(motion: RigidMotion | RodMotion, frames: Ints, conditions: Conditions) -> list[str]:
    """State how many of the frames that were recorded have no pose, and why."""
    recorded = np.ones(len(frames), dtype=np.bool_)
    if conditions.recorded is not None:
        recorded = np.isin(frames, conditions.recorded)
    reasons = [r for r, seen in zip(motion.reason, recorded, strict=True) if r and seen]
    if not reasons:
        return []
    kinds = {r: reasons.count(r) for r in sorted(set(reasons))}
    by_kind = "; ".join(f"{count} x {reason}" for reason, count in kinds.items())
    return [f"{len(reasons)} of {np.count_nonzero(recorded)} frames have no pose ({by_kind})"]


def _floor_mismatch(
    motion: RigidMotion, D_R: DiffusionEstimate, noise: NoiseFloor, *, stated: bool
) -> list[str]:
    """Warn where the offset of the steps is not the noise that the residuals (or sigma) predict.

    Where sigma is not stated, any sigma_z/sigma_xy up to 5 may be behind the residuals: a body that
    does not turn tells them apart by nothing else. A likelihood-ratio test with one degree of
    freedom.
    """
    if D_R.noise != "joint" or not D_R.value > 0:
        return []
    low = high = 1.0
    if not stated:
        if motion.template.shape[1] == 3:
            rotation = motion.rotation[motion.fitted]
            low, high = floor_range(motion.template, rotation, ratio=_NOISE_RATIO)
        unsure = _FLOOR_ERRORS * np.sqrt(2 / max(residual_freedom(motion), 1))
        low, high = low * max(1 - unsure, 0.0), high * (1 + unsure)
    # A stated exposure takes b D, b = exposure dt/3, from the noise of every frame.
    blur = (D_R.exposure or 0.0) * motion.dt / 3 * D_R.value
    measured = floor_factor(motion) * (D_R.offset + blur)
    if low * noise.phi2 <= measured <= high * noise.phi2:
        return []
    nearest = high if measured > high * noise.phi2 else low
    sigma = float(np.sqrt(nearest * np.mean(motion.noise**2)))
    gain = offset_gain(motion, D_R, sigma=sigma)
    if gain < _FLOOR_ERRORS**2:
        return []
    error = floor_factor(motion) * D_R.offset_stderr
    shown = f"{measured:.3g} +- {error:.2g}" if np.isfinite(error) else f"{measured:.3g}"
    return [
        f"noise floor: the steps show Phi^2 = {shown} rad^2, the localisation error predicts "
        f"{noise.phi2:.3g} (likelihood ratio, {np.sqrt(gain):.1f} standard errors); motion blur "
        "lowers it, particles recorded one after another or noise that is smooth in time change it"
    ]


def _assumed_exposure(conditions: Conditions) -> list[str]:
    """State what an unknown exposure was taken for where the noise is held."""
    if conditions.noise == "joint" or conditions.exposure is not None:
        return []
    return [
        f"noise {conditions.noise}: the exposure is not stated and taken as 0; a shutter that is "
        "open all the time would make D up to 26 % low"
    ]


def _interpreted(
    results: list[ClusterResult], rods: list[RodResult], conditions: Conditions
) -> tuple[list[ClusterResult], list[RodResult]]:
    """Add what the shapes imply: sizes, and predictions where a diameter was stated."""
    if conditions.temperature is None:
        return results, rods
    shapes = [_shape(r.motion.template, r.motion) for r in results]
    pairs = zip(results, conditions.bodies(shapes), strict=True)
    results = [_with_sizes(result, body, conditions) for result, body in pairs]
    if conditions.diameter is None:
        return results, rods
    places = [np.outer(rod.motion.places, [0.0, 0.0, 1.0]) for rod in rods]
    lines = [_shape(x, rod.motion) for x, rod in zip(places, rods, strict=True)]
    foreseen = zip(rods, conditions.bodies(lines), strict=True)
    return results, [_with_prediction(rod, body) for rod, body in foreseen]


def _shape(positions: Floats, motion: RigidMotion | RodMotion) -> Shape:
    """Return a measured shape with the error of its coordinates, which are means over frames."""
    return Shape(positions, float(np.nan_to_num(motion.sigma) / np.sqrt(motion.fitted.size)))


def _with_sizes(result: ClusterResult, body: Body, conditions: Conditions) -> ClusterResult:
    """Add the sizes and, for a stated diameter, the prediction, or why there are none."""
    if body.mobility is None:
        lacking = "no sizes" if conditions.diameter is None else "no sizes and no prediction"
        return replace(result, warnings=(*result.warnings, f"{lacking}: {body.reason}"))
    D_T, D_R = result.D_T, result.D_R
    sizes = conditions.sizes(body.mobility, D_T=D_T, D_R=D_R)
    limited = [
        name
        for name, D in (("D_R", D_R), ("D_T", D_T))
        if D.absent_because is None and not is_known(D)
    ]
    notes = []
    if limited:
        which = " from" if sizes else "s:"
        notes.append(f"no size{which} {' and '.join(limited)}: an upper limit only")
    warnings = [*result.warnings, *body.told]
    prediction = None
    if conditions.diameter is not None:
        tensor_T, more = _translation_tensor(result.motion, body.mobility, conditions)
        prediction = compare_body(
            body.mobility, D_T=D_T, D_R=D_R, tensor_T=tensor_T, tensor_R=result.tensor
        )
        notes += more
    return replace(
        result,
        sizes=sizes or None,
        prediction=prediction,
        warnings=tuple(warnings),
        notes=(*result.notes, *notes),
    )


def _translation_tensor(
    motion: RigidMotion, mobility: Mobility, conditions: Conditions
) -> tuple[DiffusionTensor | None, list[str]]:
    """Measure D_T in body axes where it should differ between them; a drift would mix with it."""
    if conditions.drift or not are_unequal(mobility.principal_D_T.values):
        return None, []
    return _tensor(motion, conditions, "translation")


def _with_prediction(rod: RodResult, body: Body) -> RodResult:
    """Add the prediction for a rod, or why there is none."""
    if body.mobility is None:
        return replace(rod, warnings=(*rod.warnings, f"no prediction: {body.reason}"))
    prediction = compare_rod(body.mobility, D_T=rod.D_T, D_perp=rod.D_perp)
    return replace(rod, prediction=prediction, warnings=(*rod.warnings, *body.told))


def _pooled(
    results: list[ClusterResult],
    motions: Mapping[tuple[int, Quantity], RigidMotion],
    conditions: Conditions,
) -> tuple[Pooled | None, list[str]]:
    """Pool all clusters that passed as rigid; without any nothing is pooled."""
    soft = [r for r in results if r.quality is not None and not r.quality.rigid]
    used = [r for r in results if r not in soft]
    if not used:
        return None, _nothing_rigid(soft)
    warnings = []
    if soft:
        names = listed(r.name for r in soft)
        many = "s" if len(soft) > 1 else ""
        warnings.append(f"the pooled values leave out what is not rigid: cluster{many} {names}")
    clusters = tuple(r.cluster for r in used)
    if len(used) == 1:
        return Pooled(used[0].D_R, used[0].D_T, clusters), warnings
    D_R = conditions.estimate([motions[r.cluster, "rotation"] for r in used], "rotation")
    moving = [r for r in used if np.isfinite(r.D_T.value)]
    D_T = used[0].D_T
    if moving:
        paths = [motions[r.cluster, "translation"] for r in moving]
        D_T = conditions.estimate(paths, "translation")
    warnings += [
        f"the clusters do not agree on one {name}: equal values would scatter as much with "
        f"probability {estimate.p_same:.1g}"
        for name, estimate in (("D_R", D_R), ("D_T", D_T))
        if estimate.p_same is not None and estimate.p_same < _DIFFER
    ]
    return Pooled(D_R, D_T, clusters), warnings


def _nothing_rigid(soft: list[ClusterResult]) -> list[str]:
    """State that nothing is pooled because no cluster moves as one rigid body."""
    if not soft:
        return []
    which = "the cluster is" if len(soft) == 1 else f"none of the {len(soft)} clusters is"
    return [
        f"not rigid: {which}{' not' if len(soft) == 1 else ''} a rigid body, and nothing is "
        "pooled; D_R and D_T of what is not rigid describe no body"
    ]


def _settings(
    source: Mapping[str, str | None], *, arguments: Mapping[str, Any], first_frame: int
) -> dict[str, Any]:
    """Return what run.json keeps: enough to repeat the run and to know that it is the same."""
    from importlib.metadata import version

    names = ("perrin", "numpy", "scipy", "pandas")
    return {
        "input": dict(source),
        "arguments": dict(arguments),
        "first_frame": first_frame,
        "versions": {"python": platform.python_version()} | {n: version(n) for n in names},
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "seed": None,
    }
