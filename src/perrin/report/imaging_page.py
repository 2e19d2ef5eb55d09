"""The quality page of a run: how its spheres were seen, in words, numbers and pictures."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from perrin._text import number_text
from perrin.movie.checks import bleaching
from perrin.plot.imaging import imaging_of, least_turns
from perrin.report.html import byline, captioned, inline_pictures, render_page
from perrin.run.remarks import condensed

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from perrin._arrays import Floats
    from perrin.images.imaging import Imaging
    from perrin.images.optics.optics import Optics
    from perrin.run.results import Report


Fact = tuple[str, str, str]


# What each figure is, what it shows, and what to look for.
_CAPTIONS = {
    "found": (
        "Spheres found.",
        "One frame from the middle of the movie, the brightest voxels along each line of sight "
        "(of dark spheres the darkest), from above and from two sides; spheres are drawn dark. "
        "Circles have the diameter that was looked for, one colour a cluster, with its number; "
        "dashed ones belong to no cluster.",
        "Each sphere should fill its circle, on all three sides. Spheres without a circle are "
        "missed: lower the mass cut. Circles on nothing are noise: raise it. Circles that all are "
        "too large or too small mean a wrong diameter or voxel size, in z where only the sides "
        "are off.",
    ),
    "tracks": (
        "Tracks on the images.",
        "Some frames all over the movie, seen from above: the spheres of the frame, and the path "
        "of each cluster's centre in the 100 frames before it. A cluster keeps its colour.",
        "A cluster should keep its colour from frame to frame. A path that jumps from one cluster "
        "to another is a mistake; paths that all lean one way are drift; a path that ends is a "
        "cluster that was lost.",
    ),
    "masses": (
        "Brightness of the spots.",
        "Integrated brightness of all spots of a few frames, noise included, and the cut between "
        "noise and spheres (dashed). Both axes are logarithmic.",
        "Two hills with a gap between them, and the cut in the gap. Without a gap, spheres are "
        "lost or noise is kept whatever the cut; a hill at twice the mass is pairs seen as one.",
    ),
    "residuals": (
        "Residuals.",
        "How badly the model's image explains the voxels around the spheres (top, where images "
        "were fitted), and how far the spheres are from the rigid body fitted to them (bottom).",
        "The misfit should stay near 1; a larger one, the same in all frames, means that spheres "
        "do not look like the model, and errors are understated by its root. A single spike "
        "below is a bad frame, a step that stays an exchange of spheres, a slow rise means that "
        "the body is not rigid or the light fades.",
    ),
    "steps": (
        "Angles of the steps.",
        "Angles that all bodies turned through from one pose to the next, and the numbers that "
        "Brownian rotation with the pooled coefficient and noise gives (line). Ticks mark the "
        "largest; a dotted line is the least turn that brings a body onto itself.",
        "Columns should follow the line into its tail. Steps far beyond it are exchanged spheres: "
        "look at their frames. Columns that reach half the turn of a body onto itself mean that "
        "orientations cannot be told apart: take frames faster.",
    ),
    "health": (
        "Frame by frame.",
        "Spheres found and all spots, the brightness of the spheres, the grey level of the frame, "
        "and the share of voxels clipped at the end of the camera's range. Crosses mark frames "
        "that could not be read.",
        "Level lines. Brightness that falls is bleaching: errors grow with it. Spheres that come "
        "and go cross the border or the mass cut. Saturated voxels flatten the spheres' image and "
        "shift its fit.",
    ),
}


_LISTED = 50  # frames whose faults are told


_TOUCHING = 1.3  # contact distances: spheres nearer touch


def render_quality(report: Report, figures: Iterable[Path]) -> str:
    """Return how a report's spheres were seen as one HTML page that needs no other file.

    Parameters
    ----------
    report : Report
        With `imaging`; it may lack clusters.
    figures : iterable of Path
        From `perrin.plot.imaging.save_image_figures`; the PNGs among them are put into the page.

    Returns
    -------
    str
    """
    imaging, pictures = imaging_of(report), inline_pictures(figures)
    faults = imaging.frames[imaging.frames["fault"].fillna("") != ""]
    drawn = [captioned(pictures, f"images-{k}", k, caption) for k, caption in _CAPTIONS.items()]
    return render_page(
        "quality",
        **byline(report.settings),
        headline=_headline(report),
        warnings=condensed(report.warnings),
        notes=condensed(report.notes),
        facts=[
            *_light_facts(imaging),
            _mass_cut(imaging),
            *_fit_facts(imaging),
            *_optics_facts(imaging),
            *_body_facts(report),
        ],
        faults=[
            (row.frame, number_text(row.time), row.fault)
            for row in faults.head(_LISTED).itertuples()
        ],
        more_faults=max(len(faults) - _LISTED, 0),
        figures=[f for f in drawn if f],
        asked=_asked(imaging),
    )


def _headline(report: Report) -> list[tuple[str, str, str]]:
    """Return label, value and note of what to read first."""
    imaging = imaging_of(report)
    frames = _read(imaging)
    middle, span = _counts(frames["spheres"].to_numpy())
    boxes = [
        ("Frames read", f"{len(frames)} of {len(imaging.frames)}", _times(imaging)),
        ("Spheres in a frame", middle, span),
        ("Clusters tracked", str(len(report.results)), _share(imaging)),
    ]
    errors = _stated_errors(imaging)
    if errors:
        axes = ", ".join(errors)
        values = ", ".join(_nanometres(v) for v in errors.values())
        boxes.append(("Stated error of a centre", f"{values} nm", f"median, along {axes}"))
    return boxes


def _read(imaging: Imaging) -> Any:  # noqa: ANN401 (pandas carries no types)
    """Return the rows of the frames that could be read."""
    return imaging.frames[imaging.frames["fault"].fillna("") == ""]


def _times(imaging: Imaging) -> str:
    """Write when the first and the last frame were taken, and how many could not be read."""
    time = imaging.frames["time"].dropna().to_numpy(dtype=np.float64)
    if not time.size:
        return ""
    lost = len(imaging.frames) - len(_read(imaging))
    said = f"; {lost} could not be read" if lost else ""
    return f"from {number_text(time.min())} to {number_text(time.max())} s{said}"


def _counts(count: Floats) -> tuple[str, str]:
    """Write the median of the numbers of spheres, and their range."""
    if not len(count):
        return "–", "no frame could be read"
    low, high, empty = int(count.min()), int(count.max()), int((count == 0).sum())
    said = f"median; {low} to {high}" if low < high else "in every frame"
    if 0 < empty < len(count):
        said += f"; none in {empty} frame{'s' * (empty > 1)}"
    return f"{np.median(count):g}", said


def _share(imaging: Imaging) -> str:
    """Write how many of the spheres found belong to clusters."""
    found = len(imaging.features)
    if not found:
        return "no sphere was found"
    kept = int((imaging.features["cluster"] >= 0).sum())
    if kept == found:
        return "all spheres found belong to one"
    return f"{100 * kept / found:.3g} % of the spheres found belong to one"


def _stated_errors(imaging: Imaging) -> dict[str, float]:
    """Return the median error, um, that the fits state along each axis; empty where none does."""
    columns = {a: f"sigma_{a}" for a in "xyz" if f"sigma_{a}" in imaging.features}
    median = {a: float(imaging.features[name].median()) for a, name in columns.items()}
    return {a: value for a, value in median.items() if np.isfinite(value)}


def _nanometres(um: float) -> str:
    return number_text(1e3 * um, digits=2)


def _light_facts(imaging: Imaging) -> list[Fact]:
    """Return name, value and remark of how bright the frames were."""
    worst = 100 * float(_read(imaging)["saturated"].max())
    if not np.isfinite(worst):
        return []
    value = f"{number_text(worst, digits=2)} %" if worst else "none"
    return [("saturated voxels", value, "in the worst frame"), *_bleaching(imaging)]


def _bleaching(imaging: Imaging) -> list[Fact]:
    """Return the brightness of the last tenth of the movie against that of the first."""
    change = bleaching(imaging.features)
    if change is None:
        return []
    error = f" ± {number_text(100 * change.stderr, digits=1)}" if change.stderr > 0 else ""
    remark = "of the tracked spheres, last tenth of the movie against the first"
    return [("brightness", f"{number_text(100 * (1 + change.value))}{error} %", remark)]


def _mass_cut(imaging: Imaging) -> Fact:
    """Return name, value and remark of the line between spheres and noise."""
    if imaging.minmass <= 0:
        return "mass cut", "none", "all spots are taken for spheres"
    below = int((imaging.spots["mass"] < imaging.minmass).sum())
    remark = f"{below} of {len(imaging.spots)} spots of the frames looked at lie below"
    return "mass cut", number_text(imaging.minmass), remark


def _fit_facts(imaging: Imaging) -> list[Fact]:
    """Return name, value and remark of how the fits of the images went."""
    features = imaging.features
    errors = _stated_errors(imaging)
    facts = []
    if errors:
        values = ", ".join(_nanometres(v) for v in errors.values())
        remark = f"median along {', '.join(errors)}, from the light alone"
        facts.append(("stated error", f"{values} nm", remark))
    if "chi2" in features and features["chi2"].notna().any():
        misfit = number_text(float(features["chi2"].median()))
        facts.append(("image misfit", misfit, "median χ² per degree of freedom; 1: to the noise"))
    if "refined" in features:
        refused = features[~features["refined"].astype(bool)]
        value = f"{len(refused)} of {len(features)}"
        facts.append(("not refined", value, _reasons(refused)))
    return facts


def _reasons(refused: Any) -> str:  # noqa: ANN401 (pandas carries no types)
    """Write why fits were refused, the commonest reason first."""
    if not len(refused):
        return "every fit settled"
    said = "the places first found were kept"
    if "reason" not in refused:
        return said
    counts = refused["reason"].fillna("").replace("", "no reason told").value_counts()
    return f"{said}: {', '.join(f'{reason} ({n})' for reason, n in counts.items())}"


def _optics_facts(imaging: Imaging) -> list[Fact]:
    """Return name, value and remark of how a sphere is seen."""
    optics = imaging.optics
    if optics is None:
        return []
    learned = "learned from the images" if any(optics.stderr) else "as stated"
    size, psf_z, psf = _with_errors(optics)
    asked = f"{learned}; {number_text(imaging.diameter)} µm was looked for"
    noise = f"a voxel's variance is {number_text(optics.noise.gain)} times its light"
    floor = number_text(abs(optics.noise.floor))
    noise += f" {'−' if optics.noise.floor < 0 else '+'} {floor}, in grey levels"
    return [
        ("diameter seen", f"{size} µm", asked),
        ("point spread", f"{psf} µm", f"standard deviation in the plane; {psf_z} µm along z"),
        ("gain", number_text(optics.noise.gain), noise),
    ]


def _with_errors(optics: Optics) -> tuple[str, str, str]:
    """Write diameter, psf along z and psf in the plane, each with its error."""
    values = (optics.diameter, *optics.psf)
    size, z, plane = (number_text(v, e) for v, e in zip(values, optics.stderr, strict=True))
    return size, z, plane


def _body_facts(report: Report) -> list[Fact]:
    """Return name, value and remark of what the tracked bodies say of the images."""
    facts = []
    sigma = [c.motion.sigma for c in report.clusters if np.isfinite(c.motion.sigma)]
    if sigma:
        remark = "of a coordinate, median of the clusters; above the stated: not only the light"
        value = f"{_nanometres(float(np.median(sigma)))} nm"
        facts.append(("error seen in rigid bodies", value, remark))
    distance, contact = _touching(report), imaging_of(report).contact
    if distance.size:
        mean = float(distance.mean())
        off = f"{100 * (mean / contact - 1):+.2g} %".replace("-", "−")
        remark = f"mean of {distance.size} pairs; contact is {number_text(contact)} µm ({off})"
        facts.append(("touching spheres apart", f"{number_text(mean, digits=4)} µm", remark))
    for turn in least_turns(report)[:1]:
        remark = "a step of half of it or more cannot be told from an exchange of spheres"
        facts.append(("least turn onto itself", f"{number_text(turn)}°", remark))
    return facts


def _touching(report: Report) -> Floats:
    """Return the distances of touching spheres in the bodies and rods fitted, um."""
    reach = _TOUCHING * imaging_of(report).contact
    shapes = [c.motion.template for c in report.clusters]
    shapes += [rod.motion.places[:, None] for rod in report.rods]
    found = [np.empty(0)]
    for x in shapes:
        first, second = np.triu_indices(len(x), 1)
        found.append(np.linalg.norm(x[first] - x[second], axis=1))
    distance = np.concatenate(found)
    return distance[distance < reach]


def _asked(imaging: Imaging) -> list[tuple[str, str]]:
    """Return what was looked for, and how."""
    z, y, x = imaging.voxel
    how = {"model": "by the model of their image", "trackpy": "by trackpy's least squares"}
    size = f"{x:g} × {y:g}" + (f" × {z:g}" if np.isfinite(z) else "")
    return [
        ("diameter", f"{number_text(imaging.diameter)} µm"),
        ("contact", f"{number_text(imaging.contact)} µm"),
        ("spheres", "darker than around them" if imaging.dark else "brighter than around them"),
        ("voxel, x × y" + (" × z" if np.isfinite(z) else ""), f"{size} µm"),
        ("refined", how.get(imaging.refine or "", "not: places are filtered centroids")),
    ]
