"""A report to read: a run folder's pictures and its one self-contained HTML file."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from perrin._text import listed, number_text, power_of, significant, ten_to, unit_text
from perrin.diffusion.estimate import bare_text, value_text
from perrin.diffusion.sampling import judge_sampling
from perrin.plot.results import MAX_CLUSTERS
from perrin.report.html import byline, captioned, inline_pictures, render_page
from perrin.run.remarks import condensed, grouped
from perrin.run.results import floor_factor

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from perrin.diffusion.estimate import DiffusionEstimate
    from perrin.run.predictions import Compared, Prediction
    from perrin.run.results import ClusterResult, Pooled, Report, RodResult


# What each figure is, what it shows, and what to look for.
_CAPTIONS = {
    "curves": (
        "Mean square displacements against lag time.",
        "Mean square angular displacement (left) and mean square displacement (right) against lag "
        "time. Points: the data, faint beyond a quarter of the track, where few independent "
        "displacements remain. Band: one standard error of Brownian motion. Line: the "
        "maximum-likelihood fit, which was made to the steps, not to these points. Open circles: "
        "the same diffusion without noise. Dashed: the noise floor that the localisation error "
        "predicts.",
        "The points should follow the line within the band over the first quarter (neighbouring "
        "lags wander together). Points that flatten towards the dashed line at short lags are "
        "noise; a bend upwards at long lags is drift or driven motion, a plateau is confinement.",
    ),
    "residuals": (
        "Residuals and particles seen.",
        "Root mean square distance of the particles to the rigid body fitted to the frame (top), "
        "and how many particles were seen (bottom). Crosses mark frames without a pose.",
        "Even scatter about the line is localisation error. Slow waves mean that the body is not "
        "rigid, single spikes are bad localisations, and a step that stays is a swap of "
        "identities.",
    ),
    "sphere": (
        "Paths of the particles' directions.",
        "Paths of the particles' directions on the unit sphere, lab axes; strong in front, faint "
        "behind; an open circle ends each path.",
        "A free body wanders without a preferred place. Long straight chords are jumps or gaps; "
        "rings about one axis are driven or hindered rotation.",
    ),
    "angle": (
        "Angle in the plane.",
        "Angle of the body in the plane since the first frame, full turns counted; breaks are "
        "frames without a pose, an open circle ends the path.",
        "A free body wanders without a trend. A steady slope is driven rotation; jumps are swaps "
        "of identities.",
    ),
    "clusters": (
        "All clusters.",
        "Diffusion coefficients of all clusters with 68 % (thick) and 95 % (thin) intervals; the "
        "vertical band is the pooled value with its own. Triangles are upper limits.",
        "If all clusters diffuse alike, about one thin line in twenty misses the pooled line. Many "
        "misses mean that the clusters differ, and the pooled value describes none of them.",
    ),
}


_LINKS = 10  # clusters that are linked to from one line


_ARGUMENT_UNITS = {
    "dt": "s",
    "sigma": "µm",
    "contact": "µm",
    "exposure": "of dt",
    "viscosity": "Pa s",
    "temperature": "K",
    "diameter": "µm",
    "scale": "µm per unit",
}


def render_html(report: Report, figures: Iterable[Path]) -> str:
    """Return a report as one HTML page that needs no other file.

    Parameters
    ----------
    report : Report
    figures : iterable of Path
        From `perrin.plot.results.save_figures`; the PNGs among them are put into the page.

    Returns
    -------
    str
    """
    pictures = inline_pictures(figures)
    several = len(report.clusters) > 1
    return render_page(
        "report",
        **_provenance(report.settings),
        several=several,
        label=None if several else report.results[0].label,
        headline=_headline(report),
        overview=[_overview_row(c) for c in report.clusters] if several else [],
        pooled=_pooled_row(report, report.pooled) if several and report.pooled else None,
        rods=[_rod_row(rod) for rod in report.rods],
        seen=report.imaging is not None,
        warnings=condensed(report.warnings),
        warned=_remarks(report, {c.name: c.warnings for c in report.results}),
        notes=condensed(report.notes),
        noted=_remarks(report, {c.name: c.notes for c in report.results}),
        overview_figure=_figure(pictures, "clusters", "clusters"),
        clusters=[_section(c, pictures, report.settings) for c in report.clusters],
        hidden=max(len(report.clusters) - MAX_CLUSTERS, 0),
        planar=any(c.motion.template.shape[1] == 2 for c in report.clusters),
        **_method(report),
    )


def _method(report: Report) -> dict[str, Any]:
    """Return how noise, exposure and drift entered the estimates, the same for all clusters."""
    one = report.pooled or next(iter(report.clusters), None)
    if one is None:
        return {"noise": "joint", "exposure": None, "drift": False}
    return {
        "noise": one.D_R.settings.text,
        "exposure": one.D_R.exposure,
        "drift": one.D_T.drift is not None,
    }


def _remarks(report: Report, texts: Mapping[str, Sequence[str]]) -> list[dict[str, Any]]:
    """Return the texts about single clusters, with links, those of one kind in one line."""
    anchors = {result.name: result.cluster for result in report.results}
    return [
        {
            "text": remark.text,
            "count": len(remark.names),
            "total": remark.total,
            "same": remark.same,
            "links": [(anchors[name], name) for name in remark.names[:_LINKS]],
            "more": max(len(remark.names) - _LINKS, 0),
        }
        for remark in grouped(texts)
    ]


def _figure(pictures: Mapping[str, str], stem: str, kind: str) -> dict[str, str] | None:
    """Return a picture with its caption, or None where it was not drawn."""
    return captioned(pictures, stem, kind, _CAPTIONS[kind])


def _headline(report: Report) -> list[dict[str, Any]]:
    """Return D_R and D_T as the first thing to read: pooled where there are several clusters."""
    if report.pooled is None:
        return []
    estimates = (report.pooled.D_R, report.pooled.D_T)
    return [{"letter": k} | _estimate(e) for k, e in zip("RT", estimates, strict=True)]


def _overview_row(result: ClusterResult) -> dict[str, Any]:
    """Return one cluster's line in the list of all."""
    return {
        "anchor": result.cluster,
        "name": result.name,
        "D_R": _estimate(result.D_R),
        "D_T": _estimate(result.D_T),
        "sigma": _length(result.motion.sigma),
        "frames": result.motion.fitted.size,
        "warnings": len(result.warnings),
    }


def _rod_row(rod: RodResult) -> dict[str, Any]:
    """Return one rod's line: a direction, no full orientation."""
    return {
        "anchor": rod.cluster,
        "name": rod.name,
        "D_perp": _estimate(rod.D_perp),
        "D_T": _estimate(rod.D_T),
        "length": _length(rod.motion.length),
        "frames": rod.motion.fitted.size,
        "warnings": rod.warnings,
        "notes": rod.notes,
        "prediction": _prediction(rod.prediction),
    }


def _pooled_row(report: Report, pooled: Pooled) -> dict[str, Any]:
    """Return the pooled line, and which clusters it leaves out."""
    used = set(pooled.clusters)
    return {
        "D_R": _estimate(pooled.D_R),
        "D_T": _estimate(pooled.D_T),
        "frames": pooled.D_R.n_frames,
        "count": len(used),
        "agree": _agreement(pooled),
        "left_out": listed(c.name for c in report.clusters if c.cluster not in used),
    }


def _agreement(pooled: Pooled) -> str:
    """Say how well the clusters agree on one value."""
    said = [
        f"{name} {number_text(estimate.p_same)}"
        for name, estimate in (("D_R", pooled.D_R), ("D_T", pooled.D_T))
        if estimate.p_same is not None
    ]
    if not said:
        return ""
    return f"; equal values would scatter as much as these with probability {', '.join(said)}"


def _section(
    result: ClusterResult, pictures: Mapping[str, str], settings: Mapping[str, Any]
) -> dict[str, Any]:
    """Return everything the page says about one cluster."""
    path = "angle" if result.motion.template.shape[1] == 2 else "sphere"
    kinds = (("curves", "curves"), ("residuals", "residuals"), ("orientations", path))
    stem = f"cluster-{result.cluster}"
    drawn = [_figure(pictures, f"{stem}-{name}", kind) for name, kind in kinds]
    return {
        "anchor": result.cluster,
        "name": result.name,
        "estimates": [
            {"letter": k} | _estimate(e)
            for k, e in zip("RT", (result.D_R, result.D_T), strict=True)
        ],
        "facts": [*_noise_facts(result), *_body_facts(result)],
        "tensor": _tensor(result),
        "sampling": _sampling(result),
        "prediction": _prediction(result.prediction),
        "sizes": _sizes(result),
        "viscosity": _viscosity(result),
        "no_sizes": _why_no_sizes(result, settings),
        "warnings": result.warnings,
        "notes": result.notes,
        "figures": [f for f in drawn if f],
    }


def _estimate(estimate: DiffusionEstimate) -> dict[str, Any]:
    """Return an estimate in words: value, standard error and both intervals, one power of ten."""
    if estimate.absent_because is not None:
        words = dict.fromkeys(("value", "bare"), "none") | dict.fromkeys(
            ("stderr", "ci68", "ci95"), "–"
        )
        unit = unit_text(estimate.unit)
        return {"resolved": False, "unit": unit, "absent": estimate.absent_because} | words
    high = estimate.ci95[1]
    power = power_of(estimate.value if estimate.resolved or not np.isfinite(high) else high)
    stderr = "–"
    if estimate.resolved and np.isfinite(estimate.stderr):
        stderr = _scaled(significant(estimate.stderr / 10.0**power, 2), power)
    return {
        "value": value_text(estimate),
        "resolved": estimate.resolved,
        "bare": bare_text(estimate),
        "stderr": stderr,
        "ci68": _interval(estimate.ci68, power),
        "ci95": _interval(estimate.ci95, power),
        "unit": unit_text(estimate.unit),
        "absent": None,
    }


def _interval(ends: tuple[float, float], power: int) -> str:
    """Write an interval with two digits of its half width, or what is left without a bound."""
    low, high = (end / 10.0**power for end in ends)
    if not np.isfinite(high):
        return f"above {_scaled(significant(low, 2), power)}" if low > 0 else "not bounded"
    half = (high - low) / 2
    decimals = max(1 - int(np.floor(np.log10(half))), 0) if half > 0 else 2
    # An end without a bound is exactly 0, not 0 to some digits.
    first = f"{low:.{decimals}f}" if low else "0"
    return _scaled(f"{first} to {high:.{decimals}f}", power)


def _scaled(text: str, power: int) -> str:
    """Put a power of ten behind a number, or behind an interval in brackets."""
    if not power:
        return text
    return f"({text}) × {ten_to(power)}" if " " in text else f"{text} × {ten_to(power)}"


def _length(um: float) -> str:
    """Write a length in nm, or in um where it is large."""
    if not np.isfinite(um):
        return "unknown"
    return f"{number_text(1e3 * um)} nm" if um < 10 else f"{number_text(um)} µm"


def _floor(phi2: float, stderr: float = 0.0) -> str:
    """Write a noise floor as mean square angle and as angle."""
    text = f"{number_text(phi2, stderr)} rad²"
    if phi2 <= 0:
        return f"{text} (negative: no angle)"
    return f"{text} (Φ = {number_text(float(np.rad2deg(np.sqrt(phi2))))}°)"


def _noise_facts(result: ClusterResult) -> list[tuple[str, str, str]]:
    """Return name, value and remark of everything about the noise."""
    motion, estimate = result.motion, result.D_R
    error = floor_factor(motion) * estimate.offset_stderr
    known = bool(np.isfinite(error))
    measured = _floor(result.phi2_measured, error if known else 0.0)
    held = {"joint": "free in the fit", "residual": "the residuals weighed in"}
    remark = f"offset of the steps, {held.get(estimate.settings.text, 'held')}"
    remark += "" if known else "; its error is unknown: it lies on the edge of the possible"
    snr = number_text(estimate.snr) if np.isfinite(estimate.snr) else "without bound"
    facts = [
        ("σ", _length(motion.sigma), "localisation error of one coordinate, from the residuals"),
        ("Φ² measured", measured, remark),
        ("Φ² predicted", _floor(result.noise.phi2), "from the localisation error and the shape"),
        ("signal to noise", snr, "diffusion within Δt over the noise, variances of one angle"),
    ]
    if estimate.resolution_floor is not None:
        text = f"{number_text(estimate.resolution_floor)} rad²/s"
        facts.append(("resolution", text, "what a motionless cluster with this noise would read"))
    return facts


def _body_facts(result: ClusterResult) -> list[tuple[str, str, str]]:
    """Return name, value and remark of what was tracked."""
    motion = result.motion
    n, d = motion.template.shape
    frames = f"{motion.fitted.size} of {len(motion.time)}"
    body = f"in {d} dimensions, mean distance to the centre {number_text(motion.R)} µm"
    return [
        ("frames used", frames, f"one every {motion.dt:g} s"),
        ("particles", str(n), body),
    ]


def _tensor(result: ClusterResult) -> dict[str, Any] | None:
    """Return the rotational tensor in words: a line a principal axis, and how sure they are."""
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
    chances = (("isotropic", tensor.p_isotropic), ("axial", tensor.p_axial))
    chance = ", ".join(f"{w} {number_text(p) if p > 1e-6 else '< 10⁻⁶'}" for w, p in chances)
    return {
        "rows": rows,
        "symmetry": tensor.symmetry,
        "chance": chance,
        "statement": tensor.statement,
    }


def _sampling(result: ClusterResult) -> list[tuple[str, str]]:
    """Return the verdict on the time between frames, from each of the two coefficients."""
    d = result.motion.template.shape[1]
    pairs = (("R", result.D_R, 2 * d - 3), ("T", result.D_T, d))
    return [
        (letter, str(judge_sampling(estimate, axes=axes)))
        for letter, estimate, axes in pairs
        if estimate.dt > 0 and 0 < estimate.ci95[1] < np.inf
    ]


def _sizes(result: ClusterResult) -> list[tuple[str, str, str]]:
    """Return the diameters of cluster and sphere, um, and from which coefficients they are."""
    found = result.sizes or {}
    return [
        (
            letters,
            f"{number_text(size.cluster, size.cluster_stderr)} µm",
            f"{number_text(size.sphere, size.sphere_stderr)} µm",
        )
        for letters, name in (("T", "translation"), ("R", "rotation"), ("TR", "both"))
        if (size := found.get(name)) is not None
    ]


def _viscosity(result: ClusterResult) -> str:
    """Return the viscosity that both coefficients imply, or nothing."""
    both = (result.sizes or {}).get("both")
    if both is None or both.viscosity is None or both.viscosity_stderr is None:
        return ""
    return f"{number_text(1e3 * both.viscosity, 1e3 * both.viscosity_stderr)} mPa s"


def _prediction(prediction: Prediction | None) -> dict[str, Any] | None:
    """Return predicted beside measured values, a line each, in the order of the first table."""
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
        rows += [(letter, *_compared(one, unit), part) for part, one in lines if one is not None]
    return {"diameter": f"{number_text(prediction.diameter)} µm", "rows": rows}


def _compared(one: Compared, unit: str) -> tuple[str, str, str]:
    """Write a measured value, a predicted one, and how many standard errors lie between."""
    if not np.isfinite(one.pull):
        return "not resolved", f"{number_text(one.predicted)} {unit}", "–"
    measured = number_text(one.measured, one.stderr)
    pull = f"{one.pull:+.1f}".replace("-", "−")
    return f"{measured} {unit}", f"{number_text(one.predicted)} {unit}", pull


def _why_no_sizes(result: ClusterResult, settings: Mapping[str, Any]) -> str:
    """Say why there are no sizes."""
    stated = [t for t in (*result.warnings, *result.notes) if t.startswith("no sizes")]
    if stated:
        return stated[0].partition(": ")[2]
    if settings.get("arguments", {}).get("temperature") is None:
        return "viscosity and temperature were not given"
    return "not computed"


def _provenance(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return where the numbers come from: input, date, arguments, versions."""
    source = settings.get("input", {})
    arguments = [
        (name, "not given" if value is None else f"{value} {_ARGUMENT_UNITS.get(name, '')}".strip())
        for name, value in settings.get("arguments", {}).items()
    ]
    return byline(settings) | {
        "input_path": source.get("path") or "a table in memory",
        "sha256": source.get("sha256") or "none (no file)",
        "arguments": arguments,
        "versions": list(settings.get("versions", {}).items()),
    }
