"""The main job: a track table in, the diffusion of every cluster out."""

from __future__ import annotations

import hashlib
import os
import platform
import warnings as python_warnings
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from perrin._arrays import (
    DegenerateClusterError,
    Floats,
    PrecisionWarning,
    TooFewFramesError,
    TrackTableError,
    as_sigma,
    require_positive,
)
from perrin.diffusion import DiffusionEstimate, estimate_diffusion, with_error
from perrin.files import check_tracks, read_tracks
from perrin.grouping import cluster_positions, find_clusters
from perrin.hydrodynamics import Size, size_from_rotation, size_from_translation
from perrin.motion import RigidMotion, body_residuals, track_rotation
from perrin.results import ClusterResult, Pooled, Report, floor_factor, predicted_noise
from perrin.shapes import is_tetrahedron
from perrin.tensors import DiffusionTensor, diffusion_tensor

if TYPE_CHECKING:
    from collections.abc import Mapping

    import pandas as pd
    from numpy.typing import ArrayLike

    from perrin.noise import NoiseFloor
    from perrin.steps import Quantity

# Without a cluster column up to this many particles may pass as one body.
_ONE_CLUSTER = 20
# A body is called soft when its residuals are large against its size and smooth in time; a sigma
# stated by the user replaces both rules by a factor on it.
_SOFT_SIZE, _SOFT_SMOOTH, _SOFT_FACTOR = 0.03, 0.3, 2.0
# Clusters that agree less well than this by chance have no common D.
_DIFFER = 0.01


@dataclass(frozen=True, eq=False)
class _Conditions:
    """What the user knows of the experiment."""

    dt: float
    sigma: ArrayLike | None
    viscosity: float | None
    temperature: float | None
    noise: Literal["joint", "residual"] | float
    exposure: float | None
    drift: bool

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
        cluster column.
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
        Pa s and K: with both, sizes of tetrahedra follow.
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
    _check_arguments(dt=dt, contact=contact, viscosity=viscosity, temperature=temperature)
    table, source = _table(tracks, scale=scale, columns=columns)
    conditions = _Conditions(dt, sigma, viscosity, temperature, noise, exposure, drift)
    table = _sliced(table, frames)
    table, labels, warnings = _clustered(table, contact=contact)
    first = int(table["frame"].min())
    table["frame"] -= first
    results, failures = _each(table, labels, conditions)
    pooled, more = _pooled(results, conditions)
    more += _exposure_taken(conditions)
    arguments = asdict(conditions) | {"contact": contact, "frames": frames, "columns": columns}
    arguments |= {name: _plain(given) for name, given in (("scale", scale), ("sigma", sigma))}
    settings = _settings(source, arguments=arguments, first_frame=first)
    return Report(tuple(results), pooled, (*warnings, *failures, *more), table, settings)


def _check_arguments(
    *, dt: float, contact: float | None, viscosity: float | None, temperature: float | None
) -> None:
    """Refuse arguments out of range, all in one message."""
    given = {"contact": contact, "viscosity": viscosity, "temperature": temperature}
    require_positive(dt=dt, **{name: v for name, v in given.items() if v is not None})
    if (viscosity is None) != (temperature is None):
        raise ValueError("sizes need both viscosity (Pa s) and temperature (K): one is missing")


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
    warnings = _oddities(table)
    labels: dict[int, str] = {}
    if "cluster" in table:
        table, labels = _numbered(table)
    elif contact is not None:
        table = find_clusters(table, contact=contact)
    else:
        table = _as_one(table)
        warnings.append(
            "no cluster column and no contact distance: all "
            f"{table['particle'].nunique()} particles are taken as one cluster"
        )
    loose = table["cluster"] == -1
    if loose.all():
        how = "marked as loose (-1)" if contact is None else f"loose at contact = {contact} um"
        raise TrackTableError(f"no cluster: every particle is {how}; correct that, or the scale")
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


def _as_one(table: pd.DataFrame) -> pd.DataFrame:
    """Take all particles as one cluster, if they are few enough to be one."""
    count = table["particle"].nunique()
    if count > _ONE_CLUSTER:
        raise TrackTableError(
            f"{count} particles and no cluster column: say the centre distance of touching "
            "particles (contact, --contact) so that the clusters can be found"
        )
    return table.assign(cluster=0)


def _numbered(table: pd.DataFrame) -> tuple[pd.DataFrame, dict[int, str]]:
    """Give clusters that have names a number, in the order of the names; -1 is none."""
    import pandas as pd

    if pd.api.types.is_numeric_dtype(table["cluster"]):
        return table.astype({"cluster": np.int64}), {}
    codes, names = pd.factorize(table["cluster"], sort=True)
    labels = {i: str(name) for i, name in enumerate(names)}
    return table.assign(cluster=codes.astype(np.int64)), labels


def _each(
    table: pd.DataFrame, labels: dict[int, str], conditions: _Conditions
) -> tuple[list[ClusterResult], list[str]]:
    """Measure cluster by cluster; one that cannot answer is a warning, unless none can."""
    results: list[ClusterResult] = []
    failures: list[str] = []
    for cluster, rows in table[table["cluster"] != -1].groupby("cluster", sort=True):
        label = labels.get(int(cluster))
        try:
            results.append(_measure(rows, int(cluster), label, conditions))
        except (DegenerateClusterError, TooFewFramesError) as error:
            failures.append(f"cluster {label or cluster} was left out: {error}")
            if not results and len(failures) == table["cluster"].loc[lambda c: c != -1].nunique():
                raise
    return results, failures


def _measure(
    rows: pd.DataFrame, cluster: int, label: str | None, conditions: _Conditions
) -> ClusterResult:
    """Estimate one cluster's coefficients and collect what must be said about them."""
    positions, frames = cluster_positions(rows)
    sigma = conditions.sigma
    motion = track_rotation(positions, dt=conditions.dt, frames=frames, sigma=sigma)
    D_R, D_T = (conditions.estimate(motion, q) for q in ("rotation", "translation"))
    noise = predicted_noise(motion)
    sizes, said = _sizes(motion, D_R, D_T, conditions)
    tensor, unfound = _tensor(motion, conditions)
    warnings = (
        *_missing(motion),
        *_softness(motion, positions, sigma),
        *_floor_mismatch(motion, D_R, noise),
        *_unresolved(D_R, D_T),
        *(f"D_R: {text}" for text in D_R.warnings),
        *(f"D_T: {text}" for text in D_T.warnings),
        *_drift_told(D_T),
        *unfound,
        *said,
    )
    return ClusterResult(cluster, motion, D_R, D_T, tensor, noise, sizes, warnings, label)


def _tensor(
    motion: RigidMotion, conditions: _Conditions
) -> tuple[DiffusionTensor | None, list[str]]:
    """Return the rotational tensor, or None and the reason; in the plane there is none."""
    if motion.template.shape[1] != 3:
        return None, []
    try:
        with python_warnings.catch_warnings():
            python_warnings.simplefilter("ignore", PrecisionWarning)
            tensor = diffusion_tensor(motion, noise=conditions.noise, exposure=conditions.exposure)
    except ValueError as error:
        return None, [f"no diffusion tensor: {error}"]
    return tensor, []


def _missing(motion: RigidMotion) -> list[str]:
    """Say how many frames have no pose, and why."""
    reasons = [r for r in motion.reason if r]
    if not reasons:
        return []
    kinds = {r: reasons.count(r) for r in sorted(set(reasons))}
    listed = "; ".join(f"{count} x {reason}" for reason, count in kinds.items())
    return [f"{len(reasons)} of {len(motion.time)} frames have no pose ({listed})"]


def _softness(motion: RigidMotion, positions: Floats, sigma: ArrayLike | None) -> list[str]:
    """Warn of a body that is not rigid: residuals large and smooth, or far above a stated sigma."""
    if sigma is not None:
        stated = float(np.sqrt(np.mean(as_sigma(sigma, positions.shape[2]) ** 2)))
        if motion.sigma <= _SOFT_FACTOR * stated:
            return []
        return [
            f"not rigid: the particles leave the common shape by {motion.sigma:.3g} um a "
            f"coordinate, {motion.sigma / stated:.1f} times the stated sigma; or identities swap, "
            "or the particles of a frame are not simultaneous"
        ]
    smooth = _autocorrelation(body_residuals(motion, positions))
    if motion.sigma <= _SOFT_SIZE * motion.R or not smooth > _SOFT_SMOOTH:
        return []
    return [
        f"not rigid: residuals of {motion.sigma:.3g} um a coordinate are "
        f"{motion.sigma / motion.R:.3f} of R (over {_SOFT_SIZE}) and smooth in time (lag-1 "
        f"autocorrelation {smooth:.2f}, over {_SOFT_SMOOTH}); if this is the localisation error "
        "itself, state it as sigma"
    ]


def _autocorrelation(residuals: Floats) -> float:
    """Return the lag-1 autocorrelation of residual vectors (T, n, d); NaN without pairs."""
    before, after = residuals[:-1], residuals[1:]
    both = np.isfinite(before) & np.isfinite(after)
    a, b = before[both], after[both]
    power = 0.5 * float(a @ a + b @ b)
    return float(a @ b) / power if power > 0 else np.nan


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


def _exposure_taken(conditions: _Conditions) -> list[str]:
    """Say what an unknown exposure was taken for where the noise is held."""
    if conditions.noise == "joint" or conditions.exposure is not None:
        return []
    return [
        f"noise {conditions.noise}: the exposure is not stated and taken as 0; a shutter that is "
        "open all the time would make D up to 26 % low"
    ]


def _sizes(
    motion: RigidMotion, D_R: DiffusionEstimate, D_T: DiffusionEstimate, conditions: _Conditions
) -> tuple[dict[str, Size] | None, list[str]]:
    """Return sizes by the paper's factor, or None and the reason."""
    viscosity, temperature = conditions.viscosity, conditions.temperature
    if viscosity is None or temperature is None:
        return None, []
    if not is_tetrahedron(motion.template):
        return None, ["no sizes: the paper's factor 1.844 holds for tetrahedra only"]
    if not (D_R.resolved and D_T.resolved):
        return None, ["no sizes: a diffusion coefficient is not resolved"]
    shared = {"viscosity": viscosity, "temperature": temperature}
    shape = motion.template
    return {
        "translation": size_from_translation(D_T, cluster=shape, factor="hoffmann2009", **shared),
        "rotation": size_from_rotation(D_R, cluster=shape, factor="hoffmann2009", **shared),
    }, []


def _pooled(results: list[ClusterResult], conditions: _Conditions) -> tuple[Pooled, list[str]]:
    """Pool all clusters that passed as rigid; say which are left out."""
    soft = [r for r in results if any(w.startswith("not rigid") for w in r.warnings)]
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
    source: dict[str, str | None], *, arguments: dict[str, Any], first_frame: int
) -> dict[str, Any]:
    """Return what run.json keeps: enough to repeat the run and to know that it is the same."""
    from importlib.metadata import version

    names = ("perrin", "numpy", "scipy", "pandas")
    return {
        "input": source,
        "arguments": arguments,
        "first_frame": first_frame,
        "versions": {"python": platform.python_version()} | {n: version(n) for n in names},
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "seed": None,
    }


def _plain(given: ArrayLike | None) -> Any:  # noqa: ANN401 (whatever JSON holds)
    return None if given is None else np.asarray(given, dtype=np.float64).tolist()
