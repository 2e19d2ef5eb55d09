"""What the report page writes of one result: coefficients, noise, tensor, sizes, prediction."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from perrin._text import (
    interval_text,
    length_text,
    number_text,
    power_of,
    scaled_text,
    signed_text,
    significant,
    unit_text,
)
from perrin.diffusion.estimate import bare_text, value_text
from perrin.diffusion.sampling import judge_sampling
from perrin.geometry.shapes import pair_distances
from perrin.report.figure_data import body_picture
from perrin.run.remarks import condensed
from perrin.run.results import RodResult, floor_factor
from perrin.run.statements import motion_sentences

if TYPE_CHECKING:
    from perrin.diffusion.estimate import DiffusionEstimate
    from perrin.motion.rigid_motion import RigidMotion
    from perrin.motion.rods import RodMotion
    from perrin.run.predictions import Prediction
    from perrin.run.results import ClusterResult, Pooled, Report


def named_coefficients(
    result: ClusterResult | RodResult | Pooled,
) -> tuple[tuple[str, DiffusionEstimate], tuple[str, DiffusionEstimate]]:
    """Return the rotational and the translational coefficient, each with its index.

    Parameters
    ----------
    result : ClusterResult, RodResult or Pooled

    Returns
    -------
    tuple of tuple
        Index ("R", "⊥" or "T") and estimate.
    """
    if isinstance(result, RodResult):
        return ("⊥", result.D_perp), ("T", result.D_T)
    return ("R", result.D_R), ("T", result.D_T)


def coefficient_texts(result: ClusterResult | RodResult | Pooled) -> list[dict[str, Any]]:
    """Return both coefficients as text, each with its index.

    Parameters
    ----------
    result : ClusterResult, RodResult or Pooled

    Returns
    -------
    list of dict
        Those of `estimate_texts`, and "letter", the index.
    """
    return [{"letter": k} | estimate_texts(e) for k, e in named_coefficients(result)]


def estimate_texts(estimate: DiffusionEstimate) -> dict[str, Any]:
    """Return value, standard error and both intervals as text, with one power of ten.

    Parameters
    ----------
    estimate : DiffusionEstimate

    Returns
    -------
    dict
    """
    unit = unit_text(estimate.unit)
    if estimate.absent_because is not None:
        absent = {"value": "none", "bare": "none", "stderr": "–", "ci68": "–", "ci95": "–"}
        absent |= {"time_scale": "", "error_from": ""}
        return {"resolved": False, "unit": unit, "absent": estimate.absent_because} | absent
    high = estimate.ci95[1]
    power = power_of(estimate.value if estimate.resolved or not np.isfinite(high) else high)
    stderr = "–"
    if estimate.resolved and np.isfinite(estimate.stderr):
        stderr = scaled_text(significant(estimate.stderr / 10.0**power, 2), power)
    return {
        "value": value_text(estimate),
        "resolved": estimate.resolved,
        "bare": bare_text(estimate),
        "stderr": stderr,
        "ci68": interval_text(estimate.ci68, power=power),
        "ci95": interval_text(estimate.ci95, power=power),
        "unit": unit,
        "absent": None,
        "time_scale": estimate.time_scale,
        "error_from": estimate.method.partition("error from ")[2],
    }


def cluster_texts(result: ClusterResult | RodResult, report: Report) -> dict[str, Any]:
    """Return everything that the page writes about one cluster or rod.

    Parameters
    ----------
    result : ClusterResult or RodResult
    report : Report
        The report that contains it.

    Returns
    -------
    dict
        Values of the template ``cluster``.
    """
    alone = len(report.results) == 1
    # The remarks on a table of one cluster are remarks on it.
    warnings = (*(condensed(report.warnings) if alone else ()), *result.warnings)
    notes = (*(condensed(report.notes) if alone else ()), *result.notes)
    rod = isinstance(result, RodResult)
    common: dict[str, Any] = {
        "anchor": result.cluster,
        "title": f"{'Rod' if rod else 'Cluster'} {result.name}",
        "name": result.name,
        "estimates": coefficient_texts(result),
        "warnings": warnings,
        "notes": notes,
        "prediction": prediction_texts(result.prediction),
    }
    parts = rod_texts(result) if isinstance(result, RodResult) else body_texts(result, report)
    return common | parts


def _frames_fact(motion: RigidMotion | RodMotion) -> tuple[str, str, str]:
    """Return the number of frames that were used."""
    return (
        "frames used",
        f"{motion.fitted.size} of {len(motion.time)}",
        f"one every {motion.dt:g} s",
    )


def rod_texts(rod: RodResult) -> dict[str, Any]:
    """Return what the page writes about a rod alone.

    Parameters
    ----------
    rod : RodResult

    Returns
    -------
    dict
    """
    motion = rod.motion
    places = np.outer(motion.places, [1.0, 0.0, 0.0])
    nearest = float(np.diff(np.sort(motion.places)).min())
    return {
        "motion": [],
        "facts": [
            ("length", length_text(motion.length), "distance of the outermost particles"),
            ("σ", length_text(motion.sigma), "localisation error of one coordinate"),
            _frames_fact(motion),
            ("particles", str(len(motion.places)), "on one line"),
        ],
        "tensor": None,
        "sampling": [],
        "sizes": [],
        "viscosity": "",
        "no_sizes": "",
        "still": body_picture(places, nearest, label=f"Rod of {len(places)} spheres"),
    }


def body_texts(result: ClusterResult, report: Report) -> dict[str, Any]:
    """Return what the page writes about a cluster that is no rod.

    Parameters
    ----------
    result : ClusterResult
    report : Report
        The report that contains it.

    Returns
    -------
    dict
    """
    motion, sizes = result.motion, result.sizes or {}
    arguments = report.settings.get("arguments", {})
    d = motion.dimension
    both, viscosity = sizes.get("both"), ""
    if both is not None and both.viscosity is not None and both.viscosity_stderr is not None:
        value = number_text(1e3 * both.viscosity, 1e3 * both.viscosity_stderr)
        viscosity = f"{value} mPa s"
    stated = [t for t in (*result.warnings, *result.notes) if t.startswith("no sizes")]
    no_sizes = "not computed"
    if stated:
        no_sizes = stated[0].partition(": ")[2]
    elif arguments.get("temperature") is None:
        no_sizes = "viscosity and temperature were not given"
    count = len(motion.template)
    constant = None if report.imaging is None else report.imaging.distance_error
    # The template is a mean over frames; an error of all distances alike is the same in each.
    error = np.hypot(
        np.nan_to_num(motion.sigma) / np.sqrt(motion.fitted.size * count),
        motion.R * (constant or 0.0),
    )
    radius = number_text(motion.R, float(error))
    body = f"in {d} dimensions, mean distance to the centre {radius} µm"
    diameter = arguments.get("diameter") or float(pair_distances(motion.template).min())
    return {
        "motion": [
            " ".join(texts)
            for quantity in ("rotation", "translation")
            if (texts := motion_sentences(result, quantity))
        ],
        "facts": [
            *noise_facts(result),
            _frames_fact(motion),
            ("particles", str(count), body),
        ],
        "tensor": tensor_texts(result),
        "sampling": [
            (letter, str(judge_sampling(estimate, axes=axes)))
            for letter, estimate, axes in (("R", result.D_R, 2 * d - 3), ("T", result.D_T, d))
            if estimate.dt > 0
            and 0 < estimate.ci95[1] < np.inf
            # Advice on sampling is that for diffusion.
            and estimate.motion in (None, "diffusion", "jumps")
        ],
        "sizes": [
            (
                letters,
                f"{number_text(size.cluster, size.cluster_stderr)} µm",
                f"{number_text(size.sphere, size.sphere_stderr)} µm",
            )
            for letters, name in (("T", "translation"), ("R", "rotation"), ("TR", "both"))
            if (size := sizes.get(name)) is not None
        ],
        "viscosity": viscosity,
        "no_sizes": no_sizes,
        "still": body_picture(motion.template, diameter, label=f"Cluster of {count} spheres"),
    }


def noise_facts(result: ClusterResult) -> list[tuple[str, str, str]]:
    """Return name, value and remark of every quantity of the noise.

    Parameters
    ----------
    result : ClusterResult

    Returns
    -------
    list of tuple of str
        Name, value and remark of each quantity.
    """
    motion, estimate = result.motion, result.D_R
    error = floor_factor(motion) * estimate.offset_stderr
    known = bool(np.isfinite(error))
    measured = _floor_text(result.phi2_measured, error if known else 0.0)
    held = {"joint": "free in the fit", "residual": "combined with the residuals"}
    remark = f"offset of the steps, {held.get(estimate.settings.text, 'held')}"
    remark += "" if known else "; its error is unknown, because it is at its bound"
    snr = number_text(estimate.snr) if np.isfinite(estimate.snr) else "without bound"
    facts = [
        (
            "σ",
            length_text(motion.sigma),
            "localisation error of one coordinate, from the residuals",
        ),
        ("Φ² measured", measured, remark),
        (
            "Φ² predicted",
            _floor_text(result.noise.phi2),
            "from the localisation error and the shape",
        ),
        ("signal to noise", snr, "diffusion within Δt over the noise, variances of one angle"),
    ]
    if estimate.resolution_floor is not None:
        text = f"{number_text(estimate.resolution_floor)} rad²/s"
        facts.append(("resolution", text, "apparent D of a motionless cluster with this noise"))
    return facts


def _floor_text(phi2: float, stderr: float = 0.0) -> str:
    """Write a noise floor as mean square angle and as angle."""
    text = f"{number_text(phi2, stderr)} rad²"
    if phi2 <= 0:
        return f"{text} (negative: no angle)"
    return f"{text} (Φ = {number_text(float(np.rad2deg(np.sqrt(phi2))))}°)"


def tensor_texts(result: ClusterResult) -> dict[str, Any] | None:
    """Return the rotational tensor as text: one line for each principal axis, and its tests.

    Parameters
    ----------
    result : ClusterResult

    Returns
    -------
    dict or None
        None without a tensor.
    """
    tensor = result.tensor
    if tensor is None:
        return None
    equal = np.ptp(tensor.principal_values) <= 1e-6 * tensor.principal_values[-1]
    rows = [
        (
            k + 1,
            f"{number_text(float(tensor.principal_values[k]), float(tensor.stderr[k]))} rad²/s",
            ", ".join(f"{x:+.2f}" for x in tensor.axes[:, k]),
        )
        for k in range(0 if equal else 3)
    ]
    tests = (("isotropic", tensor.p_isotropic), ("axial", tensor.p_axial))
    chance = ", ".join(f"{w} {number_text(p) if p > 1e-6 else '< 10⁻⁶'}" for w, p in tests)
    return {
        "rows": rows,
        "symmetry": tensor.symmetry,
        "chance": chance,
        "statement": tensor.statement,
    }


def prediction_texts(prediction: Prediction | None) -> dict[str, Any] | None:
    """Return measured and predicted values and their pulls, one line for each coefficient.

    Parameters
    ----------
    prediction : Prediction or None

    Returns
    -------
    dict or None
        None without a prediction.
    """
    if prediction is None:
        return None
    groups = (
        ("R", "rad²/s", prediction.D_R, prediction.principal_D_R),
        ("⊥", "rad²/s", prediction.D_perp, ()),
        ("T", "µm²/s", prediction.D_T, prediction.principal_D_T),
    )
    rows = []
    for letter, unit, mean, principal in groups:
        lines = [("", mean), *((f"axis {k}", one) for k, one in enumerate(principal, start=1))]
        for part, one in lines:
            if one is None:
                continue
            measured, pull = "not resolved", "–"
            if np.isfinite(one.pull):
                measured = f"{number_text(one.measured, one.stderr)} {unit}"
                pull = signed_text(one.pull)
            rows.append((letter, measured, f"{number_text(one.predicted)} {unit}", pull, part))
    return {"diameter": f"{number_text(prediction.diameter)} µm", "rows": rows}
