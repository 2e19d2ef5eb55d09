"""The report page: results of a run as one HTML file that needs no other file."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from perrin._text import (
    interval_text,
    length_text,
    listed,
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
from perrin.plot.motion import MOTION_CAPTION
from perrin.report.citations import (
    PAPER_BIBTEX,
    command_line,
    folder_links,
    methods_paragraph,
    python_lines,
    software_bibtex,
)
from perrin.report.embedding import packed, page_script, plotly_script, source_hash
from perrin.report.figure_data import body_picture, cluster_data, grouped_tracks
from perrin.report.html import byline, captioned, inline_pictures, render_page, render_part
from perrin.run.remarks import condensed, grouped
from perrin.run.results import RodResult, floor_factor
from perrin.run.statements import answer_lines, motion_sentences, verdict_lines

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from perrin.diffusion.estimate import DiffusionEstimate
    from perrin.motion.rigid_motion import RigidMotion
    from perrin.motion.rods import RodMotion
    from perrin.run.predictions import Prediction
    from perrin.run.results import BodyKind, ClusterResult, Pooled, Report


# Caption of each figure: its title, what it shows, and what to check.
_RESULT_CAPTIONS = {
    "curves": (
        "Mean square displacements against lag time.",
        "Mean square angular displacement (left) and mean square displacement (right) against lag "
        "time. Points: the data, faint beyond a quarter of the track, where few independent "
        "displacements remain. Band: one standard error of Brownian motion. Line: the "
        "maximum-likelihood fit to the steps, not to these points. Open circles: "
        "the same diffusion without noise. Dashed: the noise floor that the localisation error "
        "predicts.",
        "The points should follow the line within the band over the first quarter (neighbouring "
        "lags are correlated). Points that approach the dashed line at short lags are noise; "
        "an upward bend at long lags is drift or driven motion, a plateau is confinement.",
    ),
    "residuals": (
        "Residuals and detected particles.",
        "Root mean square distance of the particles to the rigid body fitted to the frame (top), "
        "and the number of detected particles (bottom). Crosses mark frames without a pose.",
        "Uniform scatter about the line is localisation error. Slow waves mean that the body is "
        "not rigid, single spikes are bad localisations, and a lasting step is an exchange of "
        "labels.",
    ),
    "sphere": (
        "Paths of the particles' directions.",
        "Paths of the particles' directions on the unit sphere in lab axes; strong on the side of "
        "the viewer, faint on the far side; an open circle marks the end of each path.",
        "A freely diffusing body has no preferred orientation. Long straight chords are jumps or "
        "gaps; rings about one axis are driven or hindered rotation.",
    ),
    "angle": (
        "Angle in the plane.",
        "Angle of the body in the plane since the first frame, full turns counted; gaps are "
        "frames without a pose, an open circle marks the end.",
        "A freely diffusing body has no trend. A steady slope is driven rotation; jumps are "
        "exchanges of labels.",
    ),
    "motion": MOTION_CAPTION,
    "clusters": (
        "All clusters.",
        "Diffusion coefficients of all clusters with 68 % (thick) and 95 % (thin) intervals; the "
        "vertical band is the pooled value with its intervals. Triangles are upper limits.",
        "If all clusters have the same coefficient, about one thin line in twenty does not contain "
        "the pooled value. If many do not, the clusters differ, and the pooled value describes "
        "none of them.",
    ),
}

_LINKED_CLUSTERS = 10  # largest number of clusters that one line links to

# Units of the arguments of `analyze`.
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
        Files of `perrin.plot.results.save_figures`; the page contains the PNGs among them.

    Returns
    -------
    str
    """
    pictures, pooled = inline_pictures(figures), report.pooled
    settings, source = report.settings, report.settings.get("input", {})
    several = len(report.results) > 1
    # Noise, exposure and drift are the same for all clusters.
    method = pooled or next(iter(report.clusters), None)
    headline = [] if pooled is None else _coefficients(pooled)
    if pooled is None and report.rods and not several:
        headline = _coefficients(report.rods[0])
    version = settings.get("versions", {}).get("perrin", "")
    script = page_script("report")
    plotly, plotly_hash = plotly_script()
    sections = [_section(one, report) for one in report.results]
    chosen = None
    if sections:
        chosen = sections[0] | {"figures": _figures(report.results[0], pictures)}
    return render_page(
        "report",
        **byline(settings),
        input_path=source.get("path") or "a table in memory",
        sha256=source.get("sha256") or "none (no file)",
        arguments=[
            (name, "not given" if value is None else f"{value} {unit}".strip())
            for name, value in settings.get("arguments", {}).items()
            for unit in (_ARGUMENT_UNITS.get(name, ""),)
        ],
        versions=list(settings.get("versions", {}).items()),
        several=several,
        results=len(report.results),
        clusters=len(report.clusters),
        rods=len(report.rods),
        label=None if several or not report.results else report.results[0].label,
        subject=_subject(report),
        answer=answer_lines(report),
        kinds=_kind_rows(report) if report.pooled_by_kind else [],
        headline=headline,
        verdict=[" ".join(texts) for texts in verdict_lines(report).values()],
        overview=[_overview_row(one, report) for one in (report.results if several else ())],
        pooled=_pooled_text(report) if several and pooled is not None else None,
        has_images=report.imaging is not None,
        warnings=condensed(report.warnings),
        warned=_remarks(report, {c.name: c.warnings for c in report.results}),
        notes=condensed(report.notes),
        noted=_remarks(report, {c.name: c.notes for c in report.results}),
        overview_figure=captioned(pictures, "clusters", "clusters", _RESULT_CAPTIONS["clusters"]),
        chosen=chosen,
        payloads=_payloads(report, sections),
        overview_data=_overview_data(report),
        copies=[
            ("Methods paragraph", methods_paragraph(report)),
            ("Command", command_line(report)),
            ("Python", python_lines(report)),
            ("BibTeX", f"{PAPER_BIBTEX}\n\n{software_bibtex(version)}"),
        ],
        links=folder_links(report),
        planar=any(c.motion.dimension == 2 for c in report.clusters),
        noise="joint" if method is None else method.D_R.settings.text,
        exposure=None if method is None else method.D_R.exposure,
        drift=method is not None and method.D_T.drift is not None,
        script=script,
        plotly=plotly,
        script_sources=f"{source_hash(script)} {plotly_hash}",
    )


def _overview_row(result: ClusterResult | RodResult, report: Report) -> dict[str, Any]:
    """Return the row of a cluster or rod in the table of all, with numbers to sort by."""
    (_, turn), (_, path) = _named_coefficients(result)
    kinds = {v.kind for v in getattr(result, "verdicts", {}).values() if v is not None}
    return {
        "anchor": result.cluster,
        "name": result.name,
        "kind": _kind_text(report.kind_of(result.cluster)),
        "D_R": _estimate_text(turn),
        "D_T": _estimate_text(path),
        "turn_sort": (turn.value, turn.ci95[1]),
        "path_sort": (path.value, path.ci95[1]),
        "motion": ", ".join(sorted(kinds)) or "not judged",
        "sigma": length_text(result.motion.sigma),
        "sigma_sort": result.motion.sigma,
        "frames": result.motion.fitted.size,
        "warnings": len(result.warnings),
    }


def _overview_data(report: Report) -> str:
    """Return values and intervals of all clusters for the forest plot, compressed."""
    columns: dict[str, Any] = {}
    both = [_named_coefficients(one) for one in report.results]
    for k, kind in enumerate(("turn", "shift")):
        estimates = [one[k][1] for one in both]
        columns |= {
            f"{kind}_value": [e.value if e.resolved else np.nan for e in estimates],
            f"{kind}_low68": [e.ci68[0] for e in estimates],
            f"{kind}_high68": [e.ci68[1] for e in estimates],
            f"{kind}_low95": [e.ci95[0] for e in estimates],
            f"{kind}_high95": [e.ci95[1] for e in estimates],
        }
    pooled: dict[str, Any] = {"turn": None, "shift": None}
    if report.pooled is not None:
        for kind, one in (("turn", report.pooled.D_R), ("shift", report.pooled.D_T)):
            numbers = (one.value, *one.ci95)
            pooled[kind] = list(numbers) if np.isfinite(numbers).all() else None
    header = {
        "keys": [one.cluster for one in report.results],
        "names": [one.name for one in report.results],
        "pooled": pooled,
    }
    return packed(header, columns, exact=columns.keys())


def _payloads(report: Report, sections: Sequence[Mapping[str, Any]]) -> list[tuple[int, str]]:
    """Return what the page draws and writes of every cluster, compressed, by its number."""
    several = len(report.results) > 1
    tracks = grouped_tracks(report.tracks)
    diameter = report.settings.get("arguments", {}).get("diameter")
    return [
        (
            result.cluster,
            cluster_data(
                result,
                tracks.get(result.cluster, np.empty((0, 5))),
                clusters=len(sections),
                diameter=diameter,
                title=section["title"],
                numbers=render_part("cluster", "numbers", section, several),
                details=render_part("cluster", "details", section),
                still=section["still"],
            ),
        )
        for result, section in zip(report.results, sections, strict=True)
    ]


def _figures(
    result: ClusterResult | RodResult, pictures: Mapping[str, str]
) -> list[dict[str, str]]:
    """Return the pictures of a cluster with their captions."""
    planar = result.motion.center.shape[1] == 2
    kinds = {"rotation": "motion", "translation": "motion"}
    kinds |= {"curves": "curves", "residuals": "residuals"}
    kinds |= {"orientations": "angle" if planar else "sphere"}
    drawn = [
        captioned(pictures, f"cluster-{result.cluster}-{name}", kind, _RESULT_CAPTIONS[kind])
        for name, kind in kinds.items()
    ]
    return [one for one in drawn if one]


def _subject(report: Report) -> str:
    """Return what a report is about, for its heading."""
    if not report.results:
        return "Translational diffusion of single spheres"
    many = len(report.results) > 1
    return f"Rotational diffusion of {'clusters' if many else 'a cluster'}"


def _kind_text(kind: BodyKind | None) -> str:
    """Return the number of particles and the point group of a kind of clusters."""
    return "–" if kind is None else f"{kind.size}, {kind.point_group.replace('inf', '∞')}"


def _kind_rows(report: Report) -> list[dict[str, Any]]:
    """Return a row for every kind of clusters, and one for the single spheres."""
    rows = []
    for kind in report.kinds:
        D = {name: _estimate_text(one) for name, one in kind.coefficients}
        turn = D.get("D_R", D.get("D_perp"))
        used = kind.clusters if kind.pooled is None else kind.pooled.clusters
        rows.append(
            {
                "name": _kind_text(kind),
                "count": len(kind.clusters),
                "used": len(used) if D else 0,
                "letter": "⊥" if "D_perp" in D else "R",
                "turn": turn,
                "path": D.get("D_T"),
            }
        )
    if report.singles is not None:
        path = _estimate_text(report.singles.D_T)
        count = report.singles.n_tracks
        single = {"name": "1 (single spheres)", "count": count, "used": count}
        rows.append(single | {"letter": "", "turn": None, "path": path})
    return rows


def _remarks(report: Report, texts: Mapping[str, Sequence[str]]) -> list[dict[str, Any]]:
    """Return the texts about single clusters, with links; those of one kind are one line."""
    anchors = {result.name: result.cluster for result in report.results}
    return [
        {
            "text": remark.text,
            "count": len(remark.names),
            "total": remark.total,
            "same": remark.same,
            "links": [(anchors[name], name) for name in remark.names[:_LINKED_CLUSTERS]],
            "more": max(len(remark.names) - _LINKED_CLUSTERS, 0),
        }
        for remark in grouped(texts)
    ]


def _pooled_text(report: Report) -> dict[str, Any]:
    """Return the pooled values, the probability of equal values, and the excluded clusters."""
    pooled = report.pooled
    assert pooled is not None
    used = set(pooled.clusters)
    agree = [
        f"{name} {number_text(estimate.p_same)}"
        for name, estimate in (("D_R", pooled.D_R), ("D_T", pooled.D_T))
        if estimate.p_same is not None
    ]
    return {
        "D_R": _estimate_text(pooled.D_R),
        "D_T": _estimate_text(pooled.D_T),
        "frames": pooled.D_R.n_frames,
        "count": len(used),
        "agree": ", ".join(agree),
        "left_out": listed(c.name for c in report.clusters if c.cluster not in used),
    }


def _named_coefficients(
    result: ClusterResult | RodResult | Pooled,
) -> tuple[tuple[str, DiffusionEstimate], tuple[str, DiffusionEstimate]]:
    """Return the rotational and the translational coefficient, each with its index."""
    if isinstance(result, RodResult):
        return ("⊥", result.D_perp), ("T", result.D_T)
    return ("R", result.D_R), ("T", result.D_T)


def _coefficients(result: ClusterResult | RodResult | Pooled) -> list[dict[str, Any]]:
    """Return both coefficients as text, each with its index."""
    return [{"letter": k} | _estimate_text(e) for k, e in _named_coefficients(result)]


def _estimate_text(estimate: DiffusionEstimate) -> dict[str, Any]:
    """Return value, standard error and both intervals as text, with one power of ten."""
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


def _section(result: ClusterResult | RodResult, report: Report) -> dict[str, Any]:
    """Return everything that the page writes about one cluster or rod."""
    alone = len(report.results) == 1
    # The remarks on a table of one cluster are remarks on it.
    warnings = (*(condensed(report.warnings) if alone else ()), *result.warnings)
    notes = (*(condensed(report.notes) if alone else ()), *result.notes)
    rod = isinstance(result, RodResult)
    common: dict[str, Any] = {
        "anchor": result.cluster,
        "title": f"{'Rod' if rod else 'Cluster'} {result.name}",
        "name": result.name,
        "estimates": _coefficients(result),
        "warnings": warnings,
        "notes": notes,
        "prediction": _prediction_text(result.prediction),
    }
    parts = _rod_parts(result) if isinstance(result, RodResult) else _body_parts(result, report)
    return common | parts


def _frames_fact(motion: RigidMotion | RodMotion) -> tuple[str, str, str]:
    """Return the number of frames that were used."""
    return (
        "frames used",
        f"{motion.fitted.size} of {len(motion.time)}",
        f"one every {motion.dt:g} s",
    )


def _rod_parts(rod: RodResult) -> dict[str, Any]:
    """Return what the page writes about a rod alone."""
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


def _body_parts(result: ClusterResult, report: Report) -> dict[str, Any]:
    """Return what the page writes about a cluster that is no rod."""
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
        "tensor": _tensor_text(result),
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


def _tensor_text(result: ClusterResult) -> dict[str, Any] | None:
    """Return the rotational tensor as text: one line for each principal axis, and its tests."""
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


def _prediction_text(prediction: Prediction | None) -> dict[str, Any] | None:
    """Return measured and predicted values and their pulls, one line for each coefficient."""
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
