"""What a run found: the report, its clusters, and the folder that holds them."""

from __future__ import annotations

import json
import os
import shutil
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from perrin.diffusion import DiffusionEstimate, with_error
from perrin.hydrodynamics import Size
from perrin.images.imaging import Imaging, read_imaging, write_imaging
from perrin.lagged import LagCurve, msad, msd
from perrin.motion import RigidMotion
from perrin.noise import NoiseFloor, floor_of
from perrin.predictions import Prediction
from perrin.quality import Quality
from perrin.rods import RodMotion
from perrin.step_tests import without_spin
from perrin.tensors import DiffusionTensor

if TYPE_CHECKING:
    from collections.abc import Iterator

    import pandas as pd


@dataclass(frozen=True, eq=False)
class ClusterResult:
    """What was measured on one cluster.

    Attributes
    ----------
    cluster : int
    motion : RigidMotion
    D_R, D_T : DiffusionEstimate
    tensor : DiffusionTensor or None
        Of rotation, in body axes; None in the plane and where there are too few steps.
    noise : NoiseFloor
        Predicted from sigma and the shape.
    sizes : dict of Size or None
        "translation" and "rotation", where the viscosity is known, and "both", with the viscosity
        that both coefficients imply; of equal spheres of the measured shape. None without any.
    warnings : tuple of str
        What speaks against the numbers.
    label : str or None
        The cluster's name in the table, where it is text.
    quality : Quality or None
        Rigidity, errors per axis, and what was repaired.
    prediction : Prediction or None
        What spheres of the stated diameter would do; None if none was stated.
    notes : tuple of str
        What informs: how the table was read, what was left out or corrected.
    jumps : dict of tuple of int
        "rotation" and "translation": the frames (from 0) at which a step was left out of the
        estimates because Brownian motion cannot make it.
    """

    cluster: int
    motion: RigidMotion
    D_R: DiffusionEstimate
    D_T: DiffusionEstimate
    tensor: DiffusionTensor | None
    noise: NoiseFloor
    sizes: dict[str, Size] | None
    warnings: tuple[str, ...]
    label: str | None = None
    quality: Quality | None = None
    prediction: Prediction | None = None
    notes: tuple[str, ...] = ()
    jumps: dict[str, tuple[int, ...]] = field(default_factory=dict)

    @cached_property
    def msad(self) -> LagCurve:
        """The MSAD averaged over the particles' directions, without a mean spin taken off D_R."""
        if self.D_R.drift is None:
            return msad(self.motion)
        return msad(without_spin(self.motion, self.D_R.drift[0]))

    @cached_property
    def msd(self) -> LagCurve:
        """The MSD of the centre, without a mean velocity taken off D_T."""
        return msd(self.motion, drift=self.D_T.drift is not None)

    @property
    def phi2_measured(self) -> float:
        """The noise floor Phi^2 (rad^2) that the steps themselves show."""
        return self.D_R.offset * floor_factor(self.motion)

    @property
    def phi2_stderr(self) -> float:
        """The standard error of `phi2_measured`, rad^2; NaN at the edge of what is possible."""
        return self.D_R.offset_stderr * floor_factor(self.motion)

    @property
    def name(self) -> str:
        """The cluster's number, or its label."""
        return self.label or str(self.cluster)

    def to_dict(self) -> dict[str, Any]:
        """Return the cluster's entry of ``summary.json``."""
        xyz = None if self.quality is None else self.quality.sigma_xyz
        return {
            "cluster": self.cluster,
            "label": self.label,
            "n_particles": len(self.motion.template),
            "n_frames": int(self.motion.fitted.size),
            "D_R": _estimate_dict(self.D_R),
            "D_T": _estimate_dict(self.D_T),
            "sigma": _number(self.motion.sigma),
            "sigma_xyz": None if xyz is None else list(xyz),
            "phi2": {"measured": _number(self.phi2_measured), "predicted": self.noise.phi2},
            "snr": _number(self.D_R.snr),
            "tensor": None if self.tensor is None else _tensor_dict(self.tensor),
            "sizes": None if self.sizes is None else _sizes_dict(self.sizes),
            "size_factor": next((s.factor for s in (self.sizes or {}).values()), None),
            "prediction": None if self.prediction is None else self.prediction.to_dict(),
            "quality": None if self.quality is None else self.quality.to_dict(),
            "jumps": {name: list(frames) for name, frames in self.jumps.items()},
            "warnings": list(self.warnings),
            "notes": list(self.notes),
        }


@dataclass(frozen=True, eq=False)
class RodResult:
    """What was measured on one rod or straight chain: it has a direction, no full orientation.

    Attributes
    ----------
    cluster : int
    motion : RodMotion
    D_perp, D_T : DiffusionEstimate
        Of the direction (``<|du|^2>`` = 4 D_perp dt) and of the centre.
    warnings : tuple of str
    label : str or None
    prediction : Prediction or None
        What spheres of the stated diameter would do; None if none was stated.
    notes : tuple of str
        What only informs, beside the warnings.
    """

    cluster: int
    motion: RodMotion
    D_perp: DiffusionEstimate
    D_T: DiffusionEstimate
    warnings: tuple[str, ...]
    label: str | None = None
    prediction: Prediction | None = None
    notes: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """The rod's number, or its label."""
        return self.label or str(self.cluster)

    def to_dict(self) -> dict[str, Any]:
        """Return the rod's entry of ``summary.json``."""
        return {
            "cluster": self.cluster,
            "label": self.label,
            "n_particles": len(self.motion.places),
            "n_frames": int(self.motion.fitted.size),
            "D_R": None,
            "D_perp": _estimate_dict(self.D_perp),
            "D_T": _estimate_dict(self.D_T),
            "length": self.motion.length,
            "sigma": _number(self.motion.sigma),
            "sigma_xyz": None,
            "snr": _number(self.D_perp.snr),
            "tensor": None,
            "sizes": None,
            "prediction": None if self.prediction is None else self.prediction.to_dict(),
            "warnings": list(self.warnings),
            "notes": list(self.notes),
        }


@dataclass(frozen=True, eq=False)
class Pooled:
    """One D_R and D_T for all rigid clusters together, each with its own noise.

    Attributes
    ----------
    D_R, D_T : DiffusionEstimate
    clusters : tuple of int
        Which clusters went in.
    """

    D_R: DiffusionEstimate
    D_T: DiffusionEstimate
    clusters: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Report:
    """The result of a run: a result per cluster, pooled values, warnings, and where they come from.

    Attributes
    ----------
    clusters : tuple of ClusterResult
    pooled : Pooled or None
        None where there are only rods.
    warnings : tuple of str
        What concerns the whole table; each cluster has its own besides.
    tracks : pandas.DataFrame
        The positions used: frame from 0, particle, cluster, x, y[, z], um.
    settings : dict
        Arguments, versions, and the input with its SHA-256.
    rods : tuple of RodResult
        Pairs and straight chains in three dimensions, which have no full rotation.
    imaging : Imaging or None
        How the spheres were seen, where the run began with images.
    notes : tuple of str
        What informs of the whole table: how it was read, what was left out.
    """

    clusters: tuple[ClusterResult, ...]
    pooled: Pooled | None
    warnings: tuple[str, ...]
    tracks: pd.DataFrame
    settings: dict[str, Any] = field(default_factory=dict)
    rods: tuple[RodResult, ...] = ()
    imaging: Imaging | None = None
    notes: tuple[str, ...] = ()

    @property
    def results(self) -> tuple[ClusterResult | RodResult, ...]:
        """Bodies and rods together."""
        both: list[ClusterResult | RodResult] = [*self.clusters, *self.rods]
        return tuple(both)

    def __repr__(self) -> str:
        count = len(self.warnings) + sum(len(c.warnings) for c in self.results)
        lines = [f"Report({len(self.results)} clusters, {count} warnings)"]
        lines += [f"  cluster {c.name}: {c.D_R}; {c.D_T}" for c in self.clusters[:10]]
        lines += [f"  {perp_text(rod)}" for rod in self.rods[:10]]
        if self.pooled is not None and len(self.clusters) > 1:
            lines.append(f"  pooled: {self.pooled.D_R}; {self.pooled.D_T}")
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Return ``summary.json`` as a dictionary: plain numbers, null for what is unknown."""
        entries = [result.to_dict() for result in self.results]
        pooled = self.pooled
        return {
            "clusters": sorted(entries, key=lambda entry: int(entry["cluster"])),
            "pooled": {
                "D_R": None if pooled is None else _estimate_dict(pooled.D_R),
                "D_T": None if pooled is None else _estimate_dict(pooled.D_T),
                "p_same": None if pooled is None else pooled.D_R.p_same,
                "clusters": [] if pooled is None else list(pooled.clusters),
            },
            "warnings": list(self.warnings),
            "notes": list(self.notes),
        }

    def save(self, folder: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        """Write the run's data (no pictures) to a new folder, which appears whole or not at all.

        Raises
        ------
        FileExistsError
            If the folder exists and `overwrite` is not set, or is not a run folder.
        """
        with staged_folder(folder, overwrite=overwrite) as stage:
            write_data(self, stage)


def load_run(folder: str | os.PathLike[str]) -> Report:
    """Read a run folder back.

    Raises
    ------
    FileNotFoundError
        If the folder or one of its files is missing.
    """
    import pandas as pd

    path = Path(folder)
    summary = json.loads((path / "summary.json").read_text(encoding="utf-8"))
    settings = json.loads((path / "run.json").read_text(encoding="utf-8"))
    motions = pd.read_parquet(path / "motion.parquet")
    attributes = motions.attrs["clusters"]
    results: list[ClusterResult] = []
    rods: list[RodResult] = []
    for entry in summary["clusters"]:
        rows = motions[motions["cluster"] == entry["cluster"]].reset_index(drop=True)
        rows.attrs = attributes[str(entry["cluster"])]
        if "D_perp" in entry:
            rods.append(_rod_from(entry, RodMotion.from_frame(rows)))
        else:
            results.append(_result_from(entry, RigidMotion.from_frame(rows)))
    return Report(
        clusters=tuple(results),
        rods=tuple(rods),
        pooled=_pooled_from(summary["pooled"]),
        warnings=tuple(summary["warnings"]),
        tracks=pd.read_parquet(path / "tracks.parquet"),
        settings=settings,
        imaging=read_imaging(path) if (path / "imaging.json").is_file() else None,
        notes=_notes_from(summary),
    )


@contextmanager
def staged_folder(folder: str | os.PathLike[str], *, overwrite: bool = False) -> Iterator[Path]:
    """Give a folder to write into that takes its place, whole, when all has been written.

    Raises
    ------
    FileExistsError
        If the place is taken and `overwrite` is not set, or what stands there is no run folder.
    OSError
        If the place cannot be written.
    """
    place = Path(folder)
    check_place(place, overwrite=overwrite)
    place.parent.mkdir(parents=True, exist_ok=True)
    stage = place.with_name(f".{place.name}.{os.getpid()}.part")
    stage.mkdir()
    try:
        yield stage
        if place.exists():
            old = stage.with_name(stage.name + ".old")
            place.rename(old)
            stage.rename(place)
            shutil.rmtree(old)
        else:
            stage.rename(place)
    finally:
        shutil.rmtree(stage, ignore_errors=True)


@contextmanager
def filled_folder(folder: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a folder to write into, whose files then go into an unfinished run folder.

    ``run.json`` goes last and makes the folder a finished one; what else stands there stays.

    Raises
    ------
    OSError
        If the place cannot be written.
    """
    place = Path(folder)
    place.mkdir(parents=True, exist_ok=True)
    for left in place.glob(".*.part"):  # by one that was killed
        shutil.rmtree(left)
    stage = place / f".{os.getpid()}.part"
    stage.mkdir()
    try:
        yield stage
        (place / "run.json").unlink(missing_ok=True)
        for new in sorted(stage.iterdir(), key=lambda path: path.name == "run.json"):
            old = place / new.name
            if old.is_dir():
                shutil.rmtree(old)
            new.replace(old)
    finally:
        shutil.rmtree(stage, ignore_errors=True)


def check_resumable(folder: str | os.PathLike[str], *, parts: str, overwrite: bool = False) -> None:
    """Refuse an output folder that is neither new, nor empty, nor an unfinished run with parts.

    Parameters
    ----------
    folder : path
    parts : str
        The folder inside that an unfinished run has.
    overwrite : bool
        A finished one will do as well.

    Raises
    ------
    FileExistsError, PermissionError
        As in `staged_folder`.
    """
    place = Path(folder)
    unfinished = (place / parts).is_dir() and not (place / "run.json").exists()
    empty = place.is_dir() and not any(place.iterdir())
    if not (unfinished or empty):
        check_place(place, overwrite=overwrite)


def check_place(folder: str | os.PathLike[str], *, overwrite: bool = False) -> None:
    """Refuse, before any work is done, an output folder that stands already.

    Raises
    ------
    FileExistsError, PermissionError
        As in `staged_folder`.
    """
    place = Path(folder)
    if not place.exists():
        parent = next(p for p in place.absolute().parents if p.exists())
        if not parent.is_dir() or not os.access(parent, os.W_OK):
            raise PermissionError(f"{place} cannot be made: {parent} is not a writable folder")
        return
    if not overwrite:
        raise FileExistsError(f"{place} exists: choose another folder, or overwrite=True")
    if not place.is_dir() or (any(place.iterdir()) and not (place / "run.json").is_file()):
        raise FileExistsError(f"{place} is no run folder of perrin (no run.json): not overwritten")


def write_data(report: Report, folder: Path) -> None:
    """Write summary.json, tracks.parquet, motion.parquet, curves.csv and run.json to a folder."""
    _write_json(folder / "summary.json", report.to_dict())
    _write_json(folder / "run.json", report.settings)
    report.tracks.to_parquet(folder / "tracks.parquet", index=False)
    motion_table(report).to_parquet(folder / "motion.parquet", index=False)
    curve_table(report).to_csv(folder / "curves.csv", index=False)
    if report.imaging is not None:
        write_imaging(report.imaging, folder)


def motion_table(report: Report) -> pd.DataFrame:
    """Return the motion of all clusters, a row per cluster and frame; templates in ``attrs``."""
    import pandas as pd

    parts, attributes = [], {}
    # A motion has every frame from its cluster's first to its last.
    whole = report.tracks.dropna(subset=["x", "y"])
    first = whole.groupby("cluster")["frame"].min()
    for result in report.results:
        part = result.motion.to_frame()
        attributes[str(result.cluster)] = part.attrs
        part.attrs = {}
        part.insert(0, "cluster", result.cluster)
        part.insert(1, "frame", first[result.cluster] + np.arange(len(part), dtype=np.int64))
        parts.append(part)
    table = pd.concat(parts, ignore_index=True)
    table.attrs = {"clusters": attributes}
    return table


def curve_table(report: Report) -> pd.DataFrame:
    """Return the MSD and MSAD of all clusters, a row per cluster, quantity and lag."""
    import pandas as pd

    parts = []
    for result in report.clusters:
        for name, curve in (("msad", result.msad), ("msd", result.msd)):
            part = curve.to_frame()
            part.insert(0, "cluster", result.cluster)
            part.insert(1, "quantity", name)
            parts.append(part)
    if not parts:
        return pd.DataFrame(columns=["cluster", "quantity"])
    return pd.concat(parts, ignore_index=True)


def perp_text(rod: RodResult) -> str:
    """Return a rod's coefficients as one line."""
    shown = with_error(rod.D_perp.value, rod.D_perp.stderr)
    return f"rod {rod.name}: D_perp = {shown} {rod.D_perp.unit}; {rod.D_T}"


def predicted_noise(motion: RigidMotion) -> NoiseFloor:
    """Return the noise floor that sigma and the shape predict, averaged over the poses."""
    covariance = np.mean(motion.covariance[motion.fitted], axis=0)
    return NoiseFloor(float(floor_of(covariance)), covariance)


def floor_factor(motion: RigidMotion) -> float:
    """Return Phi^2 over the variance of one orientation angle: 4, or 2 in the plane."""
    return 2.0 if motion.covariance.shape[-1] == 1 else 4.0


def _number(value: float) -> float | None:
    """Return a number that JSON can hold; None where it is unbounded or unknown."""
    return float(value) if np.isfinite(value) else None


def _estimate_dict(estimate: DiffusionEstimate) -> dict[str, Any]:
    """Return an estimate for JSON, ends of intervals without bound as None."""
    entry = asdict(estimate)
    for name in ("value", "stderr", "offset", "offset_stderr", "snr", "dt"):
        entry[name] = _number(entry[name])
    for name in ("ci68", "ci95"):
        entry[name] = [_number(end) for end in entry[name]]
    entry["warnings"] = list(estimate.warnings)
    for name in ("drift", "drift_stderr"):
        if entry[name] is not None:
            entry[name] = [list(row) for row in entry[name]]
    return entry


def _estimate_from(entry: dict[str, Any]) -> DiffusionEstimate:
    """Read back what `_estimate_dict` wrote."""
    read = dict(entry)
    for name in ("ci68", "ci95"):
        low, high = read[name]
        read[name] = (low, np.inf if high is None else high) if low is not None else (np.nan,) * 2
    for name in ("value", "offset", "offset_stderr", "dt"):
        read[name] = np.nan if entry[name] is None else entry[name]
    # Without a value nothing is known; beside one, what JSON cannot hold is unbounded.
    unbounded = np.nan if entry["value"] is None else np.inf
    for name in ("stderr", "snr"):
        read[name] = unbounded if entry[name] is None else entry[name]
    read["warnings"] = tuple(entry["warnings"])
    for name in ("drift", "drift_stderr"):
        if entry[name] is not None:
            read[name] = tuple(map(tuple, entry[name]))
    return DiffusionEstimate(**read)


_TENSOR_ARRAYS = (
    "tensor", "principal_values", "axes", "stderr", "covariance", "axis_errors", "offset",
)  # fmt: skip


def _tensor_dict(tensor: DiffusionTensor) -> dict[str, Any]:
    """Return a tensor for JSON; unknown errors as None. Column a of axes is axis a."""
    entry = {f.name: getattr(tensor, f.name) for f in fields(tensor)}
    for name in _TENSOR_ARRAYS:
        array = entry[name].astype(object)
        array[~np.isfinite(entry[name])] = None
        entry[name] = array.tolist()
    for name in ("p_isotropic", "p_axial"):
        entry[name] = _number(entry[name])
    return entry


def _tensor_from(entry: dict[str, Any]) -> DiffusionTensor:
    """Read back what `_tensor_dict` wrote."""
    read = dict(entry)
    for name in _TENSOR_ARRAYS:
        read[name] = np.array(entry[name], dtype=np.float64)
    for name in ("p_isotropic", "p_axial"):
        read[name] = np.nan if entry[name] is None else entry[name]
    return DiffusionTensor(**read)


# From which coefficients a size follows, and what its keys in the summary end in.
_SIZE_KEYS = {"translation": "T", "rotation": "R", "both": "TR"}


def _sizes_dict(sizes: dict[str, Size]) -> dict[str, Any]:
    """Return sizes for JSON; None for those that were not found."""
    entry: dict[str, Any] = {}
    for mode, letters in _SIZE_KEYS.items():
        size = sizes.get(mode)
        for what in ("sphere", "cluster"):
            entry[f"{what}_{letters}"] = size and {
                "value": getattr(size, what),
                "stderr": getattr(size, f"{what}_stderr"),
            }
    both = sizes.get("both")
    entry["viscosity_TR"] = both and {"value": both.viscosity, "stderr": both.viscosity_stderr}
    return entry


def _sizes_from(entry: dict[str, Any]) -> dict[str, Size]:
    """Read back what `_sizes_dict` wrote."""
    found = {}
    for mode, letters in _SIZE_KEYS.items():
        sphere, cluster = (entry["sizes"][f"{what}_{letters}"] for what in ("sphere", "cluster"))
        thickness = entry["sizes"]["viscosity_TR"] if mode == "both" else None
        if sphere is not None:
            found[mode] = Size(
                cluster=cluster["value"],
                cluster_stderr=cluster["stderr"],
                sphere=sphere["value"],
                sphere_stderr=sphere["stderr"],
                factor=entry["size_factor"],
                viscosity=thickness and thickness["value"],
                viscosity_stderr=thickness and thickness["stderr"],
            )
    return found


def _result_from(entry: dict[str, Any], motion: RigidMotion) -> ClusterResult:
    """Rebuild one cluster's result from its summary and its motion."""
    return ClusterResult(
        cluster=entry["cluster"],
        motion=motion,
        D_R=_estimate_from(entry["D_R"]),
        D_T=_estimate_from(entry["D_T"]),
        tensor=None if entry["tensor"] is None else _tensor_from(entry["tensor"]),
        noise=predicted_noise(motion),
        sizes=None if entry["sizes"] is None else _sizes_from(entry),
        warnings=tuple(entry["warnings"]),
        label=entry["label"],
        quality=None if entry["quality"] is None else Quality.from_dict(entry["quality"]),
        prediction=_prediction_from(entry),
        notes=_notes_from(entry),
        jumps={name: tuple(frames) for name, frames in entry.get("jumps", {}).items()},
    )


def _rod_from(entry: dict[str, Any], motion: RodMotion) -> RodResult:
    """Rebuild one rod's result from its summary and its motion."""
    return RodResult(
        cluster=entry["cluster"],
        motion=motion,
        D_perp=_estimate_from(entry["D_perp"]),
        D_T=_estimate_from(entry["D_T"]),
        warnings=tuple(entry["warnings"]),
        label=entry["label"],
        prediction=_prediction_from(entry),
        notes=_notes_from(entry),
    )


def _prediction_from(entry: dict[str, Any]) -> Prediction | None:
    """Read back a prediction; runs without one may lack the key."""
    given = entry.get("prediction")
    return None if given is None else Prediction.from_dict(given)


def _notes_from(entry: dict[str, Any]) -> tuple[str, ...]:
    """Read back notes; runs of earlier versions have none."""
    return tuple(entry.get("notes", ()))


def _pooled_from(entry: dict[str, Any]) -> Pooled | None:
    """Rebuild the pooled values; None where there were only rods."""
    if entry["D_R"] is None:
        return None
    estimates = _estimate_from(entry["D_R"]), _estimate_from(entry["D_T"])
    return Pooled(*estimates, tuple(entry["clusters"]))


def _write_json(path: Path, content: dict[str, Any]) -> None:
    text = json.dumps(content, indent=2, allow_nan=False, ensure_ascii=False)
    path.write_text(text + "\n", encoding="utf-8")
