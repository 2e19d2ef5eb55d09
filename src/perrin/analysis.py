"""The main job: a track table in, the diffusion of every cluster out."""

from __future__ import annotations

import hashlib
import os
import platform
import warnings as python_warnings
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeAlias

import numpy as np

from perrin._arrays import (
    DegenerateClusterError,
    Floats,
    Ints,
    PrecisionWarning,
    TooFewFramesError,
    TrackTableError,
)
from perrin._units import viscosity_remarks
from perrin.diffusion import DiffusionEstimate, estimate_diffusion, with_error
from perrin.files import check_tracks, read_tracks
from perrin.grouping import each_cluster, find_clusters
from perrin.identity import Identity, settle_identity
from perrin.mobility import Mobility, condition_faults
from perrin.motion import RigidMotion, track_rotation
from perrin.predictions import (
    Body,
    Shape,
    are_unequal,
    compare_body,
    compare_rod,
    find_sizes,
    is_known,
    solve_bodies,
)
from perrin.quality import Quality, judge_quality
from perrin.results import (
    ClusterResult,
    Pooled,
    Report,
    RodResult,
    floor_factor,
    predicted_noise,
)
from perrin.rod_diffusion import estimate_rod
from perrin.rods import RodMotion, track_direction
from perrin.rotations import fit_rotations, log_map
from perrin.tensors import DiffusionTensor, diffusion_tensor

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    import pandas as pd
    from numpy.typing import ArrayLike

    from perrin.hydrodynamics import Size
    from perrin.noise import NoiseFloor
    from perrin.steps import Quantity

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
_DIFFER = 0.01


@dataclass(frozen=True, eq=False)
class Conditions:
    """What the user knows of the experiment: see `analyze`."""

    dt: float
    sigma: ArrayLike | None
    viscosity: float | None
    temperature: float | None
    diameter: float | None
    noise: Literal["joint", "residual"] | float
    exposure: float | None
    drift: bool
    times: Floats | None = None  # of every frame, s, where they are not dt apart
    sigma_ratio: ArrayLike | None = None  # of the axes, where that alone is known

    def clock(self, frames: Ints) -> Floats:
        """Return the times of frames, s."""
        return np.asarray(frames * self.dt if self.times is None else self.times[frames])

    def estimate(
        self, motion: RigidMotion | list[RigidMotion], quantity: Quantity
    ) -> DiffusionEstimate:
        """Estimate D_R or D_T; what has to be known of it goes into the report's own warnings."""
        with python_warnings.catch_warnings():
            python_warnings.simplefilter("ignore", PrecisionWarning)
            return estimate_diffusion(
                motion,
                quantity=quantity,
                noise=self.noise,
                exposure=self.exposure,
                drift=self.drift and quantity == "translation",
            )

    def bodies(self, shapes: list[Shape]) -> list[Body]:
        """Solve for the flow around every shape; only for a stated temperature."""
        # Without a viscosity the bodies give ratios of sizes only, in which it cancels.
        assumed = {"viscosity": self.viscosity or 1e-3, "temperature": self.temperature or 300.0}
        return solve_bodies(shapes, diameter=self.diameter, **assumed)

    def sizes(
        self, mobility: Mobility, *, D_T: DiffusionEstimate, D_R: DiffusionEstimate
    ) -> dict[str, Size]:
        """Return the sizes that the coefficients imply under these conditions."""
        if self.temperature is None:
            return {}
        return find_sizes(
            mobility, D_T=D_T, D_R=D_R, viscosity=self.viscosity, temperature=self.temperature
        )


def analyze(
    tracks: str | os.PathLike[str] | pd.DataFrame,
    *,
    dt: float,
    scale: ArrayLike = 1.0,
    columns: Mapping[str, str | int] | None = None,
    contact: float | None = None,
    sigma: ArrayLike | None = None,
    noise: Literal["joint", "residual"] | float = "joint",
    exposure: float | None = None,
    drift: bool = False,
    viscosity: float | None = None,
    temperature: float | None = None,
    diameter: float | None = None,
    frames: tuple[int | None, int | None] | None = None,
) -> Report:
    """Measure D_R and D_T of every cluster in a track table.

    Parameters
    ----------
    tracks : path or pandas.DataFrame
        A .csv, .csv.gz, .parquet or .gdf file, or a table with the columns frame, particle, x,
        y[, z] and perhaps cluster.
    dt : float
        Time between frames, s.
    scale : float or array_like
        um per unit of the coordinates, one number or one per axis.
    columns : mapping, optional
        Our column names to the file's names or column numbers (files only).
    contact : float, optional
        Centre distance of touching particles, um: finds the clusters in a table without a
        cluster column. Without it they are found by the distances that stay the same.
    sigma : float or array_like, optional
        Known localisation error, um, one number or one per axis: sets the predicted noise floor and
        the test of rigidity, not the estimates.
    noise : {"joint", "residual"} or float
        How the noise under the estimates is known: free, from the rigid-fit residuals, or a
        localisation error in um; see `estimate_diffusion`.
    exposure : float, optional
        Open fraction of dt, 0 to 1; unknown by default.
    drift : bool
        Give D_T a free mean velocity along each axis (flow, sedimentation).
    viscosity, temperature : float, optional
        Pa s and K: with both, sizes follow from D_T and from D_R for equal spheres of the measured
        shape, in three dimensions. The temperature alone gives the size and the viscosity that D_T
        and D_R imply together.
    diameter : float, optional
        Of one sphere, um: with viscosity and temperature, every cluster's predicted D_T and D_R
        stand beside the measured ones. Without it, sizes are those of spheres that touch.
    frames : tuple of int or None, optional
        First frame and first frame not used any more, as in a slice.

    Returns
    -------
    Report

    Raises
    ------
    TrackTableError
        If the table cannot be read or does not say which particles belong together.
    DegenerateClusterError, TooFewFramesError
        If no cluster can be measured; among good ones a bad one is a warning.
    ValueError
        For arguments out of range.

    Examples
    --------
    >>> import perrin
    >>> from importlib.resources import files
    >>> report = perrin.analyze(str(files("perrin") / "data" / "demo_tracks.csv.gz"), dt=0.73)
    >>> print(report.clusters[0].D_R)
    D_R = 0.0051(4) rad^2/s [mle, 300 frames]
    """
    check_arguments(
        dt=dt, contact=contact, viscosity=viscosity, temperature=temperature, diameter=diameter
    )
    table, source = _table(tracks, scale=scale, columns=columns)
    conditions = Conditions(dt, sigma, viscosity, temperature, diameter, noise, exposure, drift)
    table = _sliced(table, frames)
    arguments = told_conditions(conditions) | {"contact": contact, "frames": frames}
    arguments |= {"columns": columns, "scale": _plain(scale)}
    return measure_table(table, conditions, contact=contact, source=source, arguments=arguments)


def measure_table(
    table: pd.DataFrame,
    conditions: Conditions,
    *,
    source: Mapping[str, str | None],
    arguments: Mapping[str, Any],
    contact: float | None = None,
    improved: Improve | None = None,
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
    """
    table, labels, warnings = _clustered(table, contact=contact)
    first = int(table["frame"].min())
    table["frame"] -= first
    if conditions.times is not None:
        since = conditions.times[first:] - conditions.times[first]
        conditions = replace(conditions, times=since)
    bodies, rods, failures = _fitted(table, labels, conditions)
    if improved is not None:
        motions = improved({b.cluster: (b.motion, b.frames + first) for b in bodies})
        bodies = [b._replace(motion=motions[b.cluster]) for b in bodies if b.cluster in motions]
    results, unanswered = _estimated(bodies, conditions)
    failures += unanswered
    if failures and not (results or rods):
        raise failures[-1].error
    results, rods = _interpreted(results, rods, conditions)
    pooled, more = _pooled(results, conditions) if results else (None, [])
    more += [*_exposure_taken(conditions), *viscosity_remarks(conditions.viscosity)]
    settings = _settings(source, arguments=arguments, first_frame=first)
    told = (*warnings, *(failure.told for failure in failures), *more)
    return Report(tuple(results), pooled, told, table, settings, tuple(rods))


def told_conditions(conditions: Conditions) -> dict[str, Any]:
    """Return the conditions as run.json keeps them."""
    entry = asdict(replace(conditions, times=None, sigma_ratio=None))
    del entry["times"], entry["sigma_ratio"]
    return entry | {"sigma": _plain(conditions.sigma)}


def check_arguments(*, dt: float, **given: float | None) -> None:
    """Refuse arguments out of range, all in one message."""
    known = {name: value for name, value in given.items() if value is not None}
    faults = condition_faults(dt=dt, **known)
    if "viscosity" in known and "temperature" not in known:
        faults.append(
            "sizes need both viscosity (Pa s) and temperature (K): the temperature is missing"
        )
    if "diameter" in known and not {"viscosity", "temperature"} <= set(known):
        faults.append(
            "diameter: a prediction needs the viscosity (Pa s) and the temperature (K) as well"
        )
    if faults:
        raise ValueError("; ".join(faults))


def _table(
    tracks: str | os.PathLike[str] | pd.DataFrame,
    *,
    scale: ArrayLike,
    columns: Mapping[str, str | int] | None,
) -> tuple[pd.DataFrame, dict[str, str | None]]:
    """Read or check the table; say where it came from."""
    if isinstance(tracks, str | os.PathLike):
        table = read_tracks(tracks, scale=scale, columns=columns)
        digest = hashlib.sha256(Path(tracks).read_bytes()).hexdigest()
        return table, {"path": os.fspath(tracks), "sha256": digest}
    if columns is not None:
        raise ValueError("columns: only for files; rename the columns of a table")
    table = check_tracks(tracks, source="the table", scale=scale)
    if "piece" in tracks:  # where `identify` was in doubt
        table["piece"] = tracks["piece"].to_numpy()
    return table, {"path": None, "sha256": None}


def _sliced(table: pd.DataFrame, frames: tuple[int | None, int | None] | None) -> pd.DataFrame:
    """Keep the frames first <= frame < stop."""
    first, stop = frames or (None, None)
    keep = np.ones(len(table), dtype=np.bool_)
    if first is not None:
        keep &= (table["frame"] >= first).to_numpy()
    if stop is not None:
        keep &= (table["frame"] < stop).to_numpy()
    if not keep.any():
        low, high = int(table["frame"].min()), int(table["frame"].max())
        raise ValueError(f"frames {first}:{stop} hold no rows; the table runs from {low} to {high}")
    return table[keep].reset_index(drop=True)


def _clustered(
    table: pd.DataFrame, *, contact: float | None
) -> tuple[pd.DataFrame, dict[int, str], list[str]]:
    """Make sure that every row has a cluster number; return it, names of clusters, and warnings."""
    given, warnings = table, _oddities(table)
    labels: dict[int, str] = {}
    if "cluster" in table:
        table, labels = _numbered(table)
    else:
        table, said = _grouped(table, contact=contact)
        warnings += said
    loose = table["cluster"] == -1
    if loose.all():
        raise TrackTableError(_nothing_found(contact, marked="cluster" in given))
    if loose.any():
        count = table.loc[loose, "particle"].nunique()
        warnings.append(f"{count} particles belong to no cluster and are left out")
    return table, labels, warnings


def _oddities(table: pd.DataFrame) -> list[str]:
    """Say what is no fault in a table but should be known."""
    axes = [a for a in ("x", "y", "z") if a in table]
    empty = int(table[axes].isna().any(axis=1).sum())
    told = [f"{empty} rows without coordinates (NaN) count as missing points"] if empty else []
    if "z" in table and table["z"].nunique() == 1:
        told.append("z never changes: leave the column out to analyse motion in the plane")
    return told


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
        "the centre distance of touching particles (contact, --contact), or give a column cluster"
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
            found = _fit(_Tracks(positions, frames, piece), cluster, label, conditions)
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
    def told(self) -> str:
        return f"cluster {self.name} was left out: {str(self.error).removeprefix('motion 0: ')}"


class _Tracks(NamedTuple):
    """One cluster's particles: positions (T, n, d), frame numbers, pieces the table brought."""

    positions: Floats
    frames: Ints
    piece: Ints


class _Body(NamedTuple):
    """One cluster's fitted motion, what it went through, and what has to be told of it."""

    cluster: int
    label: str | None
    frames: Ints
    motion: RigidMotion
    quality: Quality
    told: tuple[str, ...]


def _fit(
    tracks: _Tracks, cluster: int, label: str | None, conditions: Conditions
) -> _Body | RodResult:
    """Fit a body, or measure the direction of a rod that has no full orientation."""
    if tracks.positions.shape[1:] == (2, 3):
        return _measure_rod(tracks, cluster, label, conditions)
    try:
        return _fit_body(tracks, cluster, label, conditions)
    except DegenerateClusterError as error:
        try:
            return _measure_rod(tracks, cluster, label, conditions)
        except (DegenerateClusterError, ValueError):
            raise error from None


def _fit_body(tracks: _Tracks, cluster: int, label: str | None, conditions: Conditions) -> _Body:
    """Settle who is who, fit the common shape to every frame, and judge the fits."""
    frames = tracks.frames
    identity = settle_identity(tracks.positions, times=frames)
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
        swaps=tuple(frames[identity.swaps].tolist()),
        cuts=tuple(frames[1:][changed].tolist()),
        extra=tuple(frames[identity.extra].tolist()),
    )
    told = _identity_told(quality, identity, tracks, motion)
    return _Body(cluster, label, frames, motion, quality, (*told, *quality.warnings))


def _estimated(
    bodies: Iterable[_Body], conditions: Conditions
) -> tuple[list[ClusterResult], list[_Failure]]:
    """Estimate the coefficients of every body; return what cannot answer as well."""
    results: list[ClusterResult] = []
    failures: list[_Failure] = []
    for body in bodies:
        try:
            results.append(_estimate_body(body, conditions))
        except (DegenerateClusterError, TooFewFramesError) as error:
            failures.append(_Failure(body.label or str(body.cluster), error))
    return results, failures


def _estimate_body(body: _Body, conditions: Conditions) -> ClusterResult:
    """Estimate the coefficients, and collect what must be said about them."""
    motion = body.motion
    D_R, D_T = (conditions.estimate(motion, q) for q in ("rotation", "translation"))
    noise = predicted_noise(motion)
    tensor, unfound = _tensor(motion, conditions)
    warnings = (
        *_missing(motion),
        *body.told,
        *_floor_mismatch(motion, D_R, noise),
        *_unresolved(D_R, D_T),
        *(f"D_R: {text}" for text in D_R.warnings),
        *(f"D_T: {text}" for text in D_T.warnings),
        *_drift_told(D_T),
        *unfound,
    )
    return ClusterResult(
        body.cluster, motion, D_R, D_T, tensor, noise, None, warnings, body.label, body.quality
    )


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
    warnings = [
        f"no D_R: {len(motion.places)} particles on one line have a direction but no full "
        "orientation; D_perp is how fast that direction diffuses"
    ]
    if motion.swaps.size:
        warnings.append(f"identity: the ends swap labels at {_at(frames[motion.swaps])}; put right")
    cuts = frames[1:][np.diff(motion.piece) != 0]
    if cuts.size:
        warnings.append(f"identity: the ends may be mistaken at {_at(cuts)}; the track is cut")
    return RodResult(cluster, motion, D_perp, D_T, (*_missing(motion), *warnings), label)


def _at(frames: Iterable[int]) -> str:
    """List frames in words."""
    listed = [str(int(k)) for k in frames]
    return f"frame{'s' if len(listed) > 1 else ''} {', '.join(listed)}"


def _identity_told(
    quality: Quality, identity: Identity, tracks: _Tracks, motion: RigidMotion
) -> list[str]:
    """Name every frame at which labels were repaired, a track cut, or a detection left out."""
    told = []
    if quality.swaps:
        told.append(
            f"identity: labels swap at {_at(quality.swaps)}; put right"
            f"{_misfit_told(identity, tracks, motion)}"
        )
    if quality.cuts:
        told.append(
            f"identity: who is who is in doubt at {_at(quality.cuts)}; the track is cut there"
            f"{_jumps_told(quality, tracks, motion)}"
        )
    if quality.extra:
        told.append(
            f"identity: a detection that is no particle of the body is left out at "
            f"{_at(quality.extra)}"
        )
    unsettled, count = tracks.frames[identity.unsettled], len(tracks.frames)
    if unsettled.size:
        told.append(
            f"identity: {unsettled.size} of {count} frames fit the common shape in no assignment "
            f"(first: {_at(unsettled[:10].tolist())}); they keep their labels"
        )
    if len(quality.cuts) > _MANY_CUTS * count:
        told.append(
            "identity: the body turns too far between frames for its symmetry; cutting the longest "
            "steps makes D_R too low: sample faster"
        )
    return told


def _misfit_told(identity: Identity, tracks: _Tracks, motion: RigidMotion) -> str:
    """Say which residual the swaps would have left with the labels as they came."""
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


def _jumps_told(quality: Quality, tracks: _Tracks, motion: RigidMotion) -> str:
    """Say how far the body turns where the track is cut, as far as the fits tell."""
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


def _missing(motion: RigidMotion | RodMotion) -> list[str]:
    """Say how many frames have no pose, and why."""
    reasons = [r for r in motion.reason if r]
    if not reasons:
        return []
    kinds = {r: reasons.count(r) for r in sorted(set(reasons))}
    listed = "; ".join(f"{count} x {reason}" for reason, count in kinds.items())
    return [f"{len(reasons)} of {len(motion.time)} frames have no pose ({listed})"]


def _floor_mismatch(motion: RigidMotion, D_R: DiffusionEstimate, noise: NoiseFloor) -> list[str]:
    """Warn where the offset of the steps is not the noise that the residuals (or sigma) predict."""
    factor = floor_factor(motion)
    measured, error = factor * D_R.offset, factor * D_R.offset_stderr
    if not abs(measured - noise.phi2) > 3 * error:
        return []
    return [
        f"noise floor: the steps show Phi^2 = {measured:.3g} +- {error:.2g} rad^2, the "
        f"localisation error predicts {noise.phi2:.3g}; motion blur lowers it, particles recorded "
        "one after another or noise that is smooth in time change it"
    ]


def _unresolved(D_R: DiffusionEstimate, D_T: DiffusionEstimate) -> list[str]:
    """Name the coefficients that are upper limits only."""
    return [f"not resolved: {estimate}" for estimate in (D_R, D_T) if not estimate.resolved]


def _drift_told(D_T: DiffusionEstimate) -> list[str]:
    """Say which mean velocity was taken off D_T."""
    if D_T.drift is None or D_T.drift_stderr is None:
        return []
    axes = zip("xyz", D_T.drift[0], D_T.drift_stderr[0], strict=False)
    told = ", ".join(f"{axis} {with_error(v, e)}" for axis, v, e in axes)
    return [f"D_T is about a mean velocity of {told} um/s"]


def _exposure_taken(conditions: Conditions) -> list[str]:
    """Say what an unknown exposure was taken for where the noise is held."""
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
    limits = " and ".join(k for k, D in (("D_R", D_R), ("D_T", D_T)) if not is_known(D))
    told = [f"no size{' from' if sizes else 's:'} {limits}: an upper limit only"] if limits else []
    prediction = None
    if conditions.diameter is not None:
        tensor_T, more = _translation_tensor(result.motion, body.mobility, conditions)
        prediction = compare_body(
            body.mobility, D_T=D_T, D_R=D_R, tensor_T=tensor_T, tensor_R=result.tensor
        )
        told += more
    warnings = (*result.warnings, *body.told, *told)
    return replace(result, sizes=sizes or None, prediction=prediction, warnings=warnings)


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


def _pooled(results: list[ClusterResult], conditions: Conditions) -> tuple[Pooled, list[str]]:
    """Pool all clusters that passed as rigid; say which are left out."""
    soft = [r for r in results if r.quality is not None and not r.quality.rigid]
    used = [r for r in results if r not in soft] or results
    warnings = []
    if soft and len(used) < len(results):
        names = ", ".join(r.name for r in soft)
        warnings.append(f"the pooled values leave out what is not rigid: cluster {names}")
    clusters = tuple(r.cluster for r in used)
    if len(used) == 1:
        return Pooled(used[0].D_R, used[0].D_T, clusters), warnings
    motions = [r.motion for r in used]
    D_R, D_T = (conditions.estimate(motions, q) for q in ("rotation", "translation"))
    warnings += [
        f"the clusters do not agree on one {name}: equal values would scatter as much with "
        f"probability {estimate.p_same:.1g}"
        for name, estimate in (("D_R", D_R), ("D_T", D_T))
        if estimate.p_same is not None and estimate.p_same < _DIFFER
    ]
    return Pooled(D_R, D_T, clusters), warnings


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


def _plain(given: ArrayLike | None) -> Any:  # noqa: ANN401 (whatever JSON holds)
    return None if given is None else np.asarray(given, dtype=np.float64).tolist()
