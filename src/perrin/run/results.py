"""The results of a run: the report, its clusters and rods, and the files that hold them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from perrin._arrays import finite_or_none, to_plain
from perrin._display import Shown
from perrin._text import with_error
from perrin.curves.displacement import LagCurve, msad, msd
from perrin.diffusion.estimate import DiffusionEstimate
from perrin.diffusion.step_tests import without_spin
from perrin.diffusion.tensor_results import DiffusionTensor
from perrin.hydrodynamics.sizes import Size
from perrin.images.imaging import Imaging, read_imaging, write_imaging
from perrin.motion.floor import NoiseFloor, floor_of
from perrin.motion.rigid_motion import RigidMotion
from perrin.motion.rigidity import Quality
from perrin.motion.rods import RodMotion
from perrin.run.folders import staged_folder
from perrin.run.predictions import Prediction
from perrin.run.repetition import config_text
from perrin.run.result_table import (
    coefficients_html,
    estimate_row,
    prediction_columns,
    tidy_table,
)
from perrin.run.singles import SingleSpheres
from perrin.run.verdicts import verdicts_from_dict, verdicts_to_dict
from perrin.tracks.cells import guarded_table
from perrin.tracks.checksums import CheckedFiles, refusing_damage, write_checksums
from perrin.tracks.writing import write_json, write_parquet

if TYPE_CHECKING:
    import os
    from collections.abc import Callable, Mapping
    from typing import TypeAlias

    import pandas as pd

    from perrin.diffusion.verdict import MotionVerdict

    Progress: TypeAlias = Callable[[int, int, str], None]


# Coefficients of a kind of bodies.
_COEFFICIENTS = ("D_R", "D_perp", "D_T")

_NOTEBOOK_ROWS = 20  # largest number of clusters that a notebook shows

# The coefficients that a size follows from, and the ends of its keys in ``summary.json``.
_SIZE_ENDINGS = {"translation": "T", "rotation": "R", "both": "TR"}


@dataclass(frozen=True, eq=False, repr=False)
class ClusterResult(Shown):
    """What was measured on one cluster.

    Attributes
    ----------
    cluster : int
        Cluster number.
    motion : RigidMotion
        Fitted positions and orientations.
    D_R, D_T : DiffusionEstimate
        Rotational and translational diffusion coefficient.
    tensor : DiffusionTensor or None
        Rotational diffusion tensor in body axes; None in the plane and for too few steps.
    noise : NoiseFloor
        Noise floor predicted from sigma and the shape.
    sizes : dict of Size or None
        Sizes "translation" and "rotation", where the viscosity is known, and "both", with the
        viscosity that both coefficients imply, for equal spheres at the measured places. None
        without any.
    warnings : tuple of str
        Reasons to doubt the results.
    label : str or None
        Cluster name in the table, where it is text.
    quality : Quality or None
        Rigidity, errors per axis, and what was corrected.
    prediction : Prediction or None
        Coefficients predicted for spheres of the stated diameter; None if none was stated.
    notes : tuple of str
        How the table was read, what was left out, and what was corrected.
    jumps : dict of tuple of int
        Frames (from 0) at which a step was left out of the estimate of "rotation" or
        "translation" because Brownian motion cannot make it.
    verdicts : dict of MotionVerdict or None
        What kind of motion the "rotation" and the "translation" are, judged before jumps are cut
        and before a steady motion is subtracted; None for fewer than 20 steps or without motion.
        Their `frames` count from 0, as those of `jumps`; their texts state the table's own numbers.
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
    verdicts: dict[str, MotionVerdict | None] = field(default_factory=dict)

    @cached_property
    def msad(self) -> LagCurve:
        """The MSAD averaged over the particles' directions, without a spin that D_R leaves out."""
        if self.D_R.drift is None:
            return msad(self.motion)
        return msad(without_spin(self.motion, self.D_R.drift[0]))

    @cached_property
    def msd(self) -> LagCurve:
        """The MSD of the centre, without a velocity that D_T leaves out."""
        return msd(self.motion, drift=self.D_T.drift is not None)

    @property
    def phi2_measured(self) -> float:
        """Noise floor Phi^2 measured from the steps, rad^2."""
        return self.D_R.offset * floor_factor(self.motion)

    @property
    def phi2_stderr(self) -> float:
        """Standard error of `phi2_measured`, rad^2; NaN where the offset lies on its bound."""
        return self.D_R.offset_stderr * floor_factor(self.motion)

    @property
    def name(self) -> str:
        """Cluster label, or the number where there is none."""
        return self.label or str(self.cluster)

    def __str__(self) -> str:
        return f"cluster {self.name}: {self.D_R}; {self.D_T}"

    def rows(self) -> list[dict[str, Any]]:
        """Return a row of ``results.csv`` for every quantity."""
        known = self.prediction
        rotation, translation = (self.verdicts.get(q) for q in ("rotation", "translation"))
        rows: list[dict[str, Any]] = [
            estimate_row("D_R", self.D_R, rotation, None if known is None else known.D_R),
            estimate_row("D_T", self.D_T, translation, None if known is None else known.D_T),
            {"quantity": "sigma", "value": self.motion.sigma, "unit": "um"},
            {"quantity": "phi2", "value": self.phi2_measured, "unit": "rad^2"}
            | {"stderr": self.phi2_stderr},
            {"quantity": "phi2_predicted", "value": self.noise.phi2, "unit": "rad^2"},
            {"quantity": "snr", "value": self.D_R.snr, "unit": "1"},
        ]
        compared = () if known is None else known.principal_D_R
        for k in range(0 if self.tensor is None else 3):
            assert self.tensor is not None
            value, stderr = self.tensor.principal_values[k], self.tensor.stderr[k]
            row = {"quantity": f"D_R{k + 1}", "value": float(value), "stderr": float(stderr)}
            row |= {"unit": self.tensor.unit, "frames": self.tensor.n_frames}
            rows.append(row | prediction_columns(compared[k] if len(compared) == 3 else None))
        for mode, ending in _SIZE_ENDINGS.items():
            size = (self.sizes or {}).get(mode)
            for what in ("sphere", "cluster") if size is not None else ():
                value, stderr = getattr(size, what), getattr(size, f"{what}_stderr")
                row = {"quantity": f"{what}_diameter_{ending}", "value": value, "stderr": stderr}
                rows.append(row | {"unit": "um"})
            if mode == "both" and size is not None and size.viscosity is not None:
                row = {"quantity": "viscosity_TR", "value": size.viscosity, "unit": "Pa s"}
                rows.append(row | {"stderr": size.viscosity_stderr})
        return rows

    def to_dict(self) -> dict[str, Any]:
        """Return the cluster's entry of ``summary.json``."""
        xyz = None if self.quality is None else self.quality.sigma_xyz
        sizes: dict[str, Any] | None = None
        if self.sizes is not None:
            sizes = {}
            for mode, ending in _SIZE_ENDINGS.items():
                size = self.sizes.get(mode)
                for what in ("sphere", "cluster"):
                    sizes[f"{what}_{ending}"] = size and {
                        "value": getattr(size, what),
                        "stderr": getattr(size, f"{what}_stderr"),
                    }
            both = self.sizes.get("both")
            sizes["viscosity_TR"] = both and {
                "value": both.viscosity,
                "stderr": both.viscosity_stderr,
            }
        return {
            "cluster": self.cluster,
            "label": self.label,
            "n_particles": len(self.motion.template),
            "n_frames": int(self.motion.fitted.size),
            "D_R": self.D_R.to_dict(),
            "D_T": self.D_T.to_dict(),
            "sigma": finite_or_none(self.motion.sigma),
            "sigma_xyz": None if xyz is None else list(xyz),
            "phi2": {"measured": finite_or_none(self.phi2_measured), "predicted": self.noise.phi2},
            "snr": finite_or_none(self.D_R.snr),
            "tensor": None if self.tensor is None else self.tensor.to_dict(),
            "sizes": sizes,
            "size_factor": next((s.factor for s in (self.sizes or {}).values()), None),
            "prediction": None if self.prediction is None else self.prediction.to_dict(),
            "quality": None if self.quality is None else self.quality.to_dict(),
            "jumps": {name: list(frames) for name, frames in self.jumps.items()},
            "motion": verdicts_to_dict(self.verdicts),
            "warnings": list(self.warnings),
            "notes": list(self.notes),
        }

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any], motion: RigidMotion) -> ClusterResult:
        """Read back what `to_dict` wrote, with the motion, which ``motion.parquet`` holds."""
        sizes: dict[str, Size] = {}
        for mode, ending in _SIZE_ENDINGS.items() if entry["sizes"] is not None else ():
            sphere, cluster = (entry["sizes"][f"{what}_{ending}"] for what in ("sphere", "cluster"))
            thickness = entry["sizes"]["viscosity_TR"] if mode == "both" else None
            if sphere is not None:
                sizes[mode] = Size(
                    cluster=cluster["value"],
                    cluster_stderr=cluster["stderr"],
                    sphere=sphere["value"],
                    sphere_stderr=sphere["stderr"],
                    factor=entry["size_factor"],
                    viscosity=thickness and thickness["value"],
                    viscosity_stderr=thickness and thickness["stderr"],
                )
        prediction = entry.get("prediction")
        return cls(
            cluster=entry["cluster"],
            motion=motion,
            D_R=DiffusionEstimate.from_dict(entry["D_R"]),
            D_T=DiffusionEstimate.from_dict(entry["D_T"]),
            tensor=None if entry["tensor"] is None else DiffusionTensor.from_dict(entry["tensor"]),
            noise=predicted_noise(motion),
            sizes=None if entry["sizes"] is None else sizes,
            warnings=tuple(entry["warnings"]),
            label=entry["label"],
            quality=None if entry["quality"] is None else Quality.from_dict(entry["quality"]),
            prediction=None if prediction is None else Prediction.from_dict(prediction),
            # Runs of earlier versions have no notes, no jumps and no verdicts.
            notes=tuple(entry.get("notes", ())),
            jumps={name: tuple(frames) for name, frames in entry.get("jumps", {}).items()},
            verdicts=verdicts_from_dict(entry.get("motion", {})),
        )


@dataclass(frozen=True, eq=False, repr=False)
class RodResult(Shown):
    """What was measured on one rod or straight chain: it has a direction, no full orientation.

    Attributes
    ----------
    cluster : int
        Cluster number.
    motion : RodMotion
        Fitted centres and directions.
    D_perp, D_T : DiffusionEstimate
        Diffusion coefficient of the direction (``<|du|^2>`` = 4 D_perp dt) and of the centre.
    warnings : tuple of str
        Reasons to doubt the results.
    label : str or None
        Cluster name in the table, where it is text.
    prediction : Prediction or None
        Coefficients predicted for spheres of the stated diameter; None if none was stated.
    notes : tuple of str
        How the table was read, what was left out, and what was corrected.
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
        """Rod label, or the number where there is none."""
        return self.label or str(self.cluster)

    def __str__(self) -> str:
        return perp_text(self)

    def rows(self) -> list[dict[str, Any]]:
        """Return a row of ``results.csv`` for every quantity."""
        known = self.prediction
        return [
            estimate_row("D_perp", self.D_perp, None, None if known is None else known.D_perp),
            estimate_row("D_T", self.D_T, None, None if known is None else known.D_T),
            {"quantity": "sigma", "value": self.motion.sigma, "unit": "um"},
            {"quantity": "length", "value": self.motion.length, "unit": "um"},
        ]

    def to_dict(self) -> dict[str, Any]:
        """Return the rod's entry of ``summary.json``."""
        return {
            "cluster": self.cluster,
            "label": self.label,
            "n_particles": len(self.motion.places),
            "n_frames": int(self.motion.fitted.size),
            "D_R": None,
            "D_perp": self.D_perp.to_dict(),
            "D_T": self.D_T.to_dict(),
            "length": self.motion.length,
            "sigma": finite_or_none(self.motion.sigma),
            "sigma_xyz": None,
            "snr": finite_or_none(self.D_perp.snr),
            "tensor": None,
            "sizes": None,
            "prediction": None if self.prediction is None else self.prediction.to_dict(),
            "warnings": list(self.warnings),
            "notes": list(self.notes),
        }

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any], motion: RodMotion) -> RodResult:
        """Read back what `to_dict` wrote, with the motion, which ``motion.parquet`` holds."""
        prediction = entry.get("prediction")
        return cls(
            cluster=entry["cluster"],
            motion=motion,
            D_perp=DiffusionEstimate.from_dict(entry["D_perp"]),
            D_T=DiffusionEstimate.from_dict(entry["D_T"]),
            warnings=tuple(entry["warnings"]),
            label=entry["label"],
            prediction=None if prediction is None else Prediction.from_dict(prediction),
            notes=tuple(entry.get("notes", ())),
        )


@dataclass(frozen=True, eq=False, repr=False)
class Pooled(Shown):
    """One D_R and D_T for all rigid clusters together, each with its own noise.

    Attributes
    ----------
    D_R, D_T : DiffusionEstimate
        Rotational and translational diffusion coefficient of all these clusters.
    clusters : tuple of int
        Numbers of the clusters that are pooled.
    verdicts : dict of MotionVerdict or None
        What kind of motion the "rotation" and the "translation" of these clusters together are.
    """

    D_R: DiffusionEstimate
    D_T: DiffusionEstimate
    clusters: tuple[int, ...]
    verdicts: dict[str, MotionVerdict | None] = field(default_factory=dict)

    def __str__(self) -> str:
        return f"{len(self.clusters)} clusters: {self.D_R}; {self.D_T}"

    def to_dict(self) -> dict[str, Any]:
        """Return the entry "pooled" of ``summary.json``."""
        return {
            "D_R": self.D_R.to_dict(),
            "D_T": self.D_T.to_dict(),
            "p_same": self.D_R.p_same,
            "clusters": list(self.clusters),
            "motion": verdicts_to_dict(self.verdicts),
        }

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> Pooled:
        """Read back what `to_dict` wrote."""
        D_R, D_T = (
            DiffusionEstimate.from_dict(entry["D_R"]),
            DiffusionEstimate.from_dict(entry["D_T"]),
        )
        verdicts = verdicts_from_dict(entry.get("motion", {}))
        return cls(D_R, D_T, tuple(entry["clusters"]), verdicts)


@dataclass(frozen=True, eq=False, repr=False)
class BodyKind(Shown):
    """The clusters of one number of particles and one shape, and their pooled coefficients.

    Attributes
    ----------
    size : int
        Number of particles.
    point_group : str
        Schoenflies symbol that most of the clusters have.
    clusters : tuple of int
        Numbers of all clusters of this kind.
    pooled : Pooled or None
        Values of the rigid ones among them together; None for rods, and without a rigid cluster.
    D_perp, D_T : DiffusionEstimate or None
        Values of all rods of this kind together; None for other clusters, whose values are in
        `pooled`.
    """

    size: int
    point_group: str
    clusters: tuple[int, ...]
    pooled: Pooled | None = None
    D_perp: DiffusionEstimate | None = None
    D_T: DiffusionEstimate | None = None

    @property
    def name(self) -> str:
        """Number of particles and point group."""
        return f"{self.size} particles, {self.point_group}"

    @property
    def coefficients(self) -> list[tuple[str, DiffusionEstimate]]:
        """Names and values of the pooled coefficients: D_R and D_T, or D_perp and D_T of rods."""
        if self.pooled is not None:
            return [("D_R", self.pooled.D_R), ("D_T", self.pooled.D_T)]
        both = (("D_perp", self.D_perp), ("D_T", self.D_T))
        return [(name, one) for name, one in both if one is not None]

    def to_dict(self) -> dict[str, Any]:
        """Return an entry of "kinds" of ``summary.json``."""
        pooled, known = self.pooled, dict(self.coefficients)
        return {
            "size": self.size,
            "point_group": self.point_group,
            "clusters": list(self.clusters),
            **{name: known[name].to_dict() if name in known else None for name in _COEFFICIENTS},
            "pooled": None if pooled is None else list(pooled.clusters),
            "motion": verdicts_to_dict({} if pooled is None else pooled.verdicts),
        }

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> BodyKind:
        """Read back what `to_dict` wrote."""
        D = {
            name: None if entry[name] is None else DiffusionEstimate.from_dict(entry[name])
            for name in _COEFFICIENTS
        }
        kind = cls(entry["size"], entry["point_group"], tuple(entry["clusters"]))
        if D["D_R"] is None or D["D_T"] is None:
            return replace(kind, D_perp=D["D_perp"], D_T=D["D_T"])
        verdicts = verdicts_from_dict(entry["motion"])
        pooled = Pooled(D["D_R"], D["D_T"], tuple(entry["pooled"]), verdicts)
        return replace(kind, pooled=pooled)


@dataclass(frozen=True, eq=False)
class Report:
    """The result of a run: a result per cluster, pooled values, warnings, notes and settings.

    Attributes
    ----------
    clusters : tuple of ClusterResult
        Results of the clusters, by number of particles and shape.
    pooled : Pooled or None
        Values of all rigid clusters together; None where there is no rigid cluster, and where they
        are of several kinds: `kinds` has the values of each.
    warnings : tuple of str
        Reasons to doubt the results of the whole table; those of one cluster are in its result.
    tracks : pandas.DataFrame
        Positions used: frame from 0, particle, cluster, x, y[, z], um.
    settings : dict
        Arguments, versions, and the input with its SHA-256.
    rods : tuple of RodResult
        Results of pairs and straight chains in three dimensions, which have no full rotation.
    imaging : Imaging or None
        Features, images and optics, where the run began with images.
    notes : tuple of str
        How the whole table was read, what was left out, and what was corrected.
    kinds : tuple of BodyKind
        Numbers of particles and shapes of the clusters, with the pooled values of each.
    singles : SingleSpheres or None
        Diffusion of the spheres of a movie that belong to no cluster; None where there are few.
    """

    clusters: tuple[ClusterResult, ...]
    pooled: Pooled | None
    warnings: tuple[str, ...]
    tracks: pd.DataFrame
    settings: dict[str, Any] = field(default_factory=dict)
    rods: tuple[RodResult, ...] = ()
    imaging: Imaging | None = None
    notes: tuple[str, ...] = ()
    kinds: tuple[BodyKind, ...] = ()
    singles: SingleSpheres | None = None

    @property
    def pooled_by_kind(self) -> bool:
        """Whether there are pooled values that `pooled` does not hold."""
        rods = any(kind.D_perp is not None and len(kind.clusters) > 1 for kind in self.kinds)
        return len(self.kinds) > 1 or rods or self.singles is not None

    def kind_of(self, cluster: int) -> BodyKind | None:
        """Return the kind of a cluster by its number; None in runs of earlier versions."""
        return next((kind for kind in self.kinds if cluster in kind.clusters), None)

    @property
    def results(self) -> tuple[ClusterResult | RodResult, ...]:
        """Results of clusters and rods together."""
        both: list[ClusterResult | RodResult] = [*self.clusters, *self.rods]
        return tuple(both)

    def __eq__(self, other: object) -> bool:
        """Whether all numbers, texts, settings, positions and motions are equal."""
        if not isinstance(other, Report):
            return NotImplemented
        pairs = zip(self.results, other.results, strict=False)
        return (
            self.to_dict() == other.to_dict()
            and to_plain(self.settings) == to_plain(other.settings)
            and self.tracks.equals(other.tracks)
            and all(a.motion.to_dict() == b.motion.to_dict() for a, b in pairs)
        )

    __hash__ = object.__hash__

    def __repr__(self) -> str:
        count = len(self.warnings) + sum(len(c.warnings) for c in self.results)
        many = len(self.results)
        parts = [f"{many} cluster{'s' * (many != 1)}"]
        if self.pooled is not None:
            for name, one in (("D_R", self.pooled.D_R), ("D_T", self.pooled.D_T)):
                if one.absent_because is None:
                    parts.append(f"{name} = {with_error(one.value, one.stderr)} {one.unit}")
        if self.pooled_by_kind:
            parts.append(f"{len(self.kinds)} kind{'s' * (len(self.kinds) != 1)}")
        return f"Report({', '.join(parts)}, {count} warning{'s' * (count != 1)})"

    def _repr_html_(self) -> str:
        """Return a table of the coefficients of the first clusters for a notebook."""
        rows = [(c.name, c.D_R, c.D_T, len(c.warnings)) for c in self.clusters]
        rows += [(rod.name, rod.D_perp, rod.D_T, len(rod.warnings)) for rod in self.rods]
        table = coefficients_html(rows[:_NOTEBOOK_ROWS], caption=repr(self))
        rest = len(rows) - _NOTEBOOK_ROWS
        return table + (f"<p>and {rest} more: to_frame() has all.</p>" if rest > 0 else "")

    def to_frame(self) -> pd.DataFrame:
        """Return all numbers as a tidy table, the content of ``results.csv``.

        Returns
        -------
        pandas.DataFrame
            A row for every cluster (or pooled value) and quantity. Columns: of ("cluster", "rod",
            "pooled", "kind" or "single spheres"), cluster, label, particles, point_group, quantity
            ("D_R", "D_T", "D_perp", "D_R1" to "D_R3", "sigma", "length", "phi2",
            "phi2_predicted", "snr", "sphere_diameter_T", ..., "viscosity_TR"), value, stderr,
            ci68_low, ci68_high, ci95_low, ci95_high, unit, resolved (False for an upper limit,
            which is ci95_high), verdict (kind of motion), predicted, pull, frames, warnings (their
            number). A number that is not known is missing; an interval without bound ends at inf.

        Examples
        --------
        >>> import perrin
        >>> from importlib.resources import files
        >>> report = perrin.analyze(str(files("perrin") / "data" / "demo_tracks.csv.gz"), dt=0.73)
        >>> report.to_frame().loc[0, ["of", "quantity", "unit", "verdict"]].tolist()
        ['cluster', 'D_R', 'rad^2/s', 'diffusion']
        """
        rows: list[dict[str, Any]] = []
        for result in self.results:
            kind = self.kind_of(result.cluster)
            motion = result.motion
            shape = motion.places if isinstance(motion, RodMotion) else motion.template
            about: dict[str, Any] = {
                "of": "rod" if isinstance(result, RodResult) else "cluster",
                "cluster": result.cluster,
                "label": result.label,
                "particles": len(shape),
                "point_group": None if kind is None else kind.point_group,
                "frames": int(motion.fitted.size),
                "warnings": len(result.warnings),
            }
            rows += [about | row for row in result.rows()]
        pooled = self.pooled
        if pooled is not None and len(self.clusters) > 1:
            for name, quantity in (("D_R", "rotation"), ("D_T", "translation")):
                row = estimate_row(name, getattr(pooled, name), pooled.verdicts.get(quantity))
                rows.append({"of": "pooled"} | row)
        for kind in self.kinds if self.pooled_by_kind else ():
            about = {"of": "kind", "particles": kind.size, "point_group": kind.point_group}
            rows += [about | estimate_row(name, one) for name, one in kind.coefficients]
        if self.singles is not None:
            about = {"of": "single spheres", "particles": 1}
            rows.append(about | estimate_row("D_T", self.singles.D_T))
        return tidy_table(rows)

    def __str__(self) -> str:
        count = len(self.warnings) + sum(len(c.warnings) for c in self.results)
        lines = [f"Report({len(self.results)} clusters, {count} warnings)"]
        lines += [f"  {c}" for c in self.clusters[:10]]
        lines += [f"  {perp_text(rod)}" for rod in self.rods[:10]]
        if self.pooled is not None and len(self.clusters) > 1:
            lines.append(f"  pooled: {self.pooled.D_R}; {self.pooled.D_T}")
        for kind in self.kinds if self.pooled_by_kind else ():
            shown = "; ".join(
                f"{name} = {with_error(one.value, one.stderr)} {one.unit}"
                for name, one in kind.coefficients
            )
            lines.append(f"  {kind.name}, pooled: {shown or 'nothing'}")
        if self.singles is not None:
            lines.append(f"  {self.singles.text}")
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Return ``summary.json`` as a dictionary: plain numbers, null for what is unknown."""
        order = {c: k for k, kind in enumerate(self.kinds) for c in kind.clusters}
        entries = []
        for result in self.results:
            kind = self.kind_of(result.cluster)
            shape = None if kind is None else {"size": kind.size, "point_group": kind.point_group}
            entries.append(result.to_dict() | {"kind": shape})
        nothing: dict[str, Any] = {"D_R": None, "D_T": None, "p_same": None, "clusters": []}
        nothing["motion"] = verdicts_to_dict({})
        return {
            "clusters": sorted(entries, key=lambda e: (order.get(e["cluster"], 0), e["cluster"])),
            "pooled": nothing if self.pooled is None else self.pooled.to_dict(),
            "kinds": [kind.to_dict() for kind in self.kinds],
            "singles": None if self.singles is None else self.singles.to_dict(),
            "warnings": list(self.warnings),
            "notes": list(self.notes),
        }

    @classmethod
    def from_dict(
        cls,
        entry: Mapping[str, Any],
        *,
        motions: Mapping[int, RigidMotion | RodMotion],
        tracks: pd.DataFrame,
        settings: dict[str, Any] | None = None,
        imaging: Imaging | None = None,
    ) -> Report:
        """Read back what `to_dict` wrote, with what other files of a run folder hold.

        Parameters
        ----------
        entry : mapping
            The content of ``summary.json``.
        motions : mapping
            The motion of every cluster by its number, from ``motion.parquet``.
        tracks : pandas.DataFrame
            The positions used, from ``tracks.parquet``.
        settings : dict, optional
            The content of ``run.json``.
        imaging : Imaging, optional

        Returns
        -------
        Report
        """
        clusters: list[ClusterResult] = []
        rods: list[RodResult] = []
        for one in entry["clusters"]:
            motion = motions[one["cluster"]]
            if isinstance(motion, RodMotion):
                rods.append(RodResult.from_dict(one, motion))
            else:
                clusters.append(ClusterResult.from_dict(one, motion))
        pooled, singles = entry["pooled"], entry.get("singles")
        return cls(
            clusters=tuple(clusters),
            rods=tuple(rods),
            pooled=None if pooled["D_R"] is None else Pooled.from_dict(pooled),
            warnings=tuple(entry["warnings"]),
            tracks=tracks,
            settings={} if settings is None else settings,
            imaging=imaging,
            notes=tuple(entry.get("notes", ())),
            # Runs of earlier versions have no kinds.
            kinds=tuple(map(BodyKind.from_dict, entry.get("kinds", ()))),
            singles=None if singles is None else SingleSpheres.from_dict(singles),
        )

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

    Parameters
    ----------
    folder : path
        Folder of a finished run.

    Returns
    -------
    Report

    Raises
    ------
    FileNotFoundError
        If the folder or one of its files is missing.
    DamagedFileError
        If a file does not have its checksum in ``checksums.json``, or cannot be read; the message
        names it. Folders of earlier versions have no checksums.
    OSError
        If a file cannot be read from the disk.
    """
    path = Path(folder)
    if not (path / "summary.json").is_file():
        raise FileNotFoundError(f"{path}: not a run folder: it holds no summary.json")
    files = CheckedFiles.of(path)
    summary, settings = files.json("summary.json"), files.json("run.json")
    table, tracks = files.table("motion.parquet"), files.table("tracks.parquet")
    imaging = read_imaging(path) if files.has("imaging.json") else None
    with refusing_damage(path):
        motions: dict[int, RigidMotion | RodMotion] = {}
        for entry in summary["clusters"]:
            rows = table[table["cluster"] == entry["cluster"]].reset_index(drop=True)
            rows.attrs = table.attrs["clusters"][str(entry["cluster"])]
            kind = RodMotion if "D_perp" in entry else RigidMotion
            motions[entry["cluster"]] = kind.from_frame(rows)
        return Report.from_dict(
            summary, motions=motions, tracks=tracks, settings=settings, imaging=imaging
        )


def write_data(report: Report, folder: Path, *, progress: Progress | None = None) -> None:
    """Write numbers, tables and settings of a report to a folder, with checksums."""
    write_json(folder / "summary.json", report.to_dict())
    write_json(folder / "run.json", report.settings)
    dt = report.results[0].motion.dt if report.results else None
    (folder / "run.toml").write_text(config_text(report.settings, dt=dt), encoding="utf-8")
    write_parquet(folder / "tracks.parquet", report.tracks)
    write_parquet(folder / "motion.parquet", motion_table(report))
    curve_table(report, progress=progress).to_csv(folder / "curves.csv", index=False)
    guarded_table(report.to_frame()).to_csv(folder / "results.csv", index=False)
    if report.imaging is not None:
        write_imaging(report.imaging, folder)
    write_checksums(folder)


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
    empty = pd.DataFrame({"cluster": np.empty(0, np.int64), "frame": np.empty(0, np.int64)})
    table = pd.concat(parts, ignore_index=True) if parts else empty
    table.attrs = {"clusters": attributes}
    return table


def curve_table(report: Report, *, progress: Progress | None = None) -> pd.DataFrame:
    """Return the MSD and MSAD of all clusters, a row per cluster, quantity and lag."""
    import pandas as pd

    parts = []
    for done, result in enumerate(report.clusters):
        if progress is not None:
            progress(done, len(report.clusters), "writing the curves")
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
    covariance = np.mean(motion.step_covariance[motion.fitted], axis=0)
    return NoiseFloor(float(floor_of(covariance)), covariance)


def floor_factor(motion: RigidMotion) -> float:
    """Return Phi^2 over the variance of one orientation angle: 4, or 2 in the plane."""
    return 2.0 if motion.covariance.shape[-1] == 1 else 4.0
