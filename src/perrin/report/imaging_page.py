"""The page of imaging quality: how well spheres were found and fitted in a movie."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from perrin._text import listed, number_text
from perrin.geometry.shapes import pair_distances
from perrin.movie.checks import bleaching
from perrin.plot.imaging import imaging_of, least_turns
from perrin.report.html import byline, captioned, inline_pictures, render_page
from perrin.run.remarks import condensed
from perrin.tracks.groups import TOUCHING_REACH

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

    from perrin.images.imaging import Imaging
    from perrin.images.optics.optics import CameraNoise, Optics
    from perrin.images.optics.radial_image import TransmissionNoise
    from perrin.run.results import Report


Fact = tuple[str, str, str]  # name, value and remark

# Caption of each figure: its title, what it shows, and what to check.
_IMAGING_CAPTIONS = {
    "found": (
        "Spheres found.",
        "One frame from the middle of the movie in maximum projections (minimum projections for "
        "dark spheres) along z, y and x; spheres are drawn dark. Circles have the expected "
        "diameter, with one colour and number for each cluster; spheres of dashed circles belong "
        "to no cluster.",
        "Each sphere should fill its circle in all three projections. Spheres without a circle "
        "were missed: lower the mass cut. Circles without a sphere are noise: raise it. If all "
        "circles are too large or too small, the diameter or the voxel size is wrong; the voxel "
        "size in z if only the side views disagree.",
    ),
    "tracks": (
        "Tracks on the images.",
        "Frames evenly over the movie, projected along z: the spheres of the frame, and the path "
        "of each cluster's centre in the last 100 frames. Each cluster has one colour.",
        "A cluster should keep its colour from frame to frame. A path that jumps from one cluster "
        "to another is an error of linking; a common direction of all paths is drift; a path that "
        "ends is a cluster that was lost.",
    ),
    "masses": (
        "Brightness of the spots.",
        "Integrated brightness (mass) of all spots of a few frames, including noise, and the cut "
        "between noise and spheres (dashed). Both axes are logarithmic.",
        "Two peaks with a gap between them, and the cut in the gap. Without a gap every cut "
        "loses spheres or keeps noise; a peak at twice the mass means that pairs of spheres were "
        "found as one.",
    ),
    "residuals": (
        "Residuals.",
        "Misfit of the model image to the voxels around the spheres (top, if images were fitted), "
        "and rms distance of the spheres to the fitted rigid body (bottom).",
        "The misfit should be near 1. A larger value in all frames means that the model does not "
        "describe the spheres; its square root is contained in the errors stated in a volume, and "
        "those stated in a plane are too small by it. In the "
        "residuals a single spike is a bad frame, a lasting step an exchange of spheres; a slow "
        "rise means that the body is not rigid or that the dye bleaches.",
    ),
    "steps": (
        "Angles of the steps.",
        "Rotation angles of all bodies from one pose to the next, and the expectation for "
        "Brownian rotation with the pooled coefficient and noise (line). Ticks mark the "
        "largest angles; a dotted line is the smallest rotation that maps a body onto itself.",
        "The histogram should follow the line into its tail. Steps far beyond it are exchanged "
        "spheres: inspect their frames. If the histogram reaches half of the smallest symmetry "
        "rotation, orientations cannot be distinguished: take frames faster.",
    ),
    "health": (
        "Frame by frame.",
        "Number of spheres and of all spots, brightness of the spheres, grey level of the frame, "
        "and share of voxels at the end of the camera's range. Crosses mark frames that could "
        "not be read.",
        "All lines should be constant. Decreasing brightness is bleaching, which increases the "
        "errors. A changing number of spheres means that spheres cross the border or the mass cut. "
        "Saturated voxels distort the images of the spheres and bias their fits.",
    ),
}

_LISTED_FRAMES = 50  # largest number of unreadable frames in the table


def render_imaging_quality(report: Report, figures: Iterable[Path]) -> str:
    """Return the imaging quality of a report as one HTML page that needs no other file.

    Parameters
    ----------
    report : Report
        Report of a movie, with `imaging`; it may have no clusters.
    figures : iterable of Path
        Files of `perrin.plot.imaging.save_image_figures`; the page contains the PNGs among them.

    Returns
    -------
    str
    """
    imaging, pictures = imaging_of(report), inline_pictures(figures)
    faults = imaging.frames[~_readable(imaging)]
    cut: Fact = ("mass cut", "none", "all spots are taken for spheres")
    if imaging.minmass > 0:
        below = int((imaging.spots["mass"] < imaging.minmass).sum())
        remark = f"{below} of {len(imaging.spots)} spots of the sampled frames lie below"
        cut = ("mass cut", number_text(imaging.minmass), remark)
    drawn = [
        captioned(pictures, f"images-{kind}", kind, caption)
        for kind, caption in _IMAGING_CAPTIONS.items()
    ]
    z, y, x = imaging.voxel
    depth = bool(np.isfinite(z))
    refined = {"model": "by the model of their image", "trackpy": "by trackpy's least squares"}
    return render_page(
        "imaging",
        **byline(report.settings),
        headline=_headline_boxes(report),
        warnings=condensed(report.warnings),
        notes=condensed(report.notes),
        facts=[
            *brightness_facts(imaging),
            cut,
            *fit_facts(imaging),
            *optics_facts(imaging),
            *rigid_body_facts(report),
        ],
        faults=[
            (row.frame, number_text(row.time), row.fault)
            for row in faults.head(_LISTED_FRAMES).itertuples()
        ],
        more_faults=max(len(faults) - _LISTED_FRAMES, 0),
        figures=[f for f in drawn if f],
        settings=[
            ("diameter", f"{number_text(imaging.diameter)} µm"),
            ("contact", f"{number_text(imaging.contact)} µm"),
            ("spheres", f"{'darker' if imaging.dark else 'brighter'} than their surroundings"),
            ("voxel, x × y × z", f"{x:g} × {y:g} × {z:g} µm")
            if depth
            else ("voxel, x × y", f"{x:g} × {y:g} µm"),
            ("refined", refined.get(imaging.refine or "", "not: positions are filtered centroids")),
        ],
    )


def _readable(imaging: Imaging) -> Any:  # noqa: ANN401 (pandas has no types)
    """Return which frames could be read."""
    return imaging.frames["fault"].fillna("") == ""


def _headline_boxes(report: Report) -> list[Fact]:
    """Return the numbers of frames, spheres and clusters, and the stated error of a centre."""
    imaging = imaging_of(report)
    frames = imaging.frames[_readable(imaging)]
    time = imaging.frames["time"].dropna().to_numpy(dtype=np.float64)
    span = ""
    if time.size:
        lost = len(imaging.frames) - len(frames)
        unread = f"; {lost} could not be read" if lost else ""
        span = f"from {number_text(time.min())} to {number_text(time.max())} s{unread}"
    count = frames["spheres"].to_numpy()
    middle, spheres = "–", "no frame could be read"
    if len(count):
        low, high, empty = int(count.min()), int(count.max()), int((count == 0).sum())
        middle = f"{np.median(count):g}"
        spheres = f"median; {low} to {high}" if low < high else "in every frame"
        if 0 < empty < len(count):
            spheres += f"; none in {empty} frame{'s' * (empty > 1)}"
    found, kept = len(imaging.features), int((imaging.features["cluster"] >= 0).sum())
    share = f"{100 * kept / found:.3g} % of the spheres belong to one" if found else ""
    if kept == found:
        share = "all spheres belong to one" if found else "no sphere was found"
    boxes = [
        ("Frames read", f"{len(frames)} of {len(imaging.frames)}", span),
        ("Spheres in a frame", middle, spheres),
        ("Clusters tracked", str(len(report.results)), share),
    ]
    errors = _stated_errors(imaging)
    if errors:
        axes = ", ".join(errors)
        boxes.append(("Stated error of a centre", _nanometres(errors), f"median, along {axes}"))
    return boxes


def _stated_errors(imaging: Imaging) -> dict[str, float]:
    """Return the median error, um, that the fits state along each axis; empty without errors."""
    columns = {a: f"sigma_{a}" for a in "xyz" if f"sigma_{a}" in imaging.features}
    median = {a: float(imaging.features[name].median()) for a, name in columns.items()}
    return {a: value for a, value in median.items() if np.isfinite(value)}


def _nanometres(errors: Mapping[str, float]) -> str:
    """Write lengths given in um, in nm."""
    return ", ".join(number_text(1e3 * um, digits=2) for um in errors.values()) + " nm"


def brightness_facts(imaging: Imaging) -> list[Fact]:
    """Return the share of saturated voxels, and the change of brightness over the movie.

    Parameters
    ----------
    imaging : Imaging

    Returns
    -------
    list of tuple of str
        Name, value and remark of each quantity.
    """
    worst = 100 * float(imaging.frames.loc[_readable(imaging), "saturated"].max())
    if not np.isfinite(worst):
        return []
    value = f"{number_text(worst, digits=2)} %" if worst else "none"
    facts = [("saturated voxels", value, "in the worst frame")]
    change = bleaching(imaging.features)
    if change is not None:
        error = f" ± {number_text(100 * change.stderr, digits=1)}" if change.stderr > 0 else ""
        remark = "of the tracked spheres, last tenth of the movie over the first"
        facts.append(("brightness", f"{number_text(100 * (1 + change.value))}{error} %", remark))
    return facts


def fit_facts(imaging: Imaging) -> list[Fact]:
    """Return stated errors and misfit of the fitted images, and the number of rejected fits.

    Parameters
    ----------
    imaging : Imaging

    Returns
    -------
    list of tuple of str
        Name, value and remark of each quantity.
    """
    features, errors = imaging.features, _stated_errors(imaging)
    facts = []
    if errors:
        remark = f"median along {', '.join(errors)}, from the noise of the image alone"
        facts.append(("stated error", _nanometres(errors), remark))
    if "chi2" in features and features["chi2"].notna().any():
        misfit = number_text(float(features["chi2"].median()))
        facts.append(("image misfit", misfit, "median χ² per degree of freedom; 1: to the noise"))
    if "refined" in features:
        rejected = features[~features["refined"].astype(bool)]
        remark = "all fits converged"
        if len(rejected):
            remark = "their unrefined positions were kept"
            if "reason" in rejected:
                reasons = rejected["reason"].fillna("").replace("", "no reason stated")
                counts = reasons.value_counts().items()
                remark += f": {', '.join(f'{reason} ({n})' for reason, n in counts)}"
        facts.append(("not refined", f"{len(rejected)} of {len(features)}", remark))
    return facts


def optics_facts(imaging: Imaging) -> list[Fact]:
    """Return apparent diameter, point spread or radial image, and camera noise.

    Parameters
    ----------
    imaging : Imaging

    Returns
    -------
    list of tuple of str
        Name, value and remark of each quantity.
    """
    radial = imaging.radial
    if radial is not None:
        shape = (
            f"learned from the images: a spline with knots {number_text(radial.spacing)} µm apart"
        )
        reach = f"radial, ends {number_text(radial.reach)} µm from the centre"
        return [("image of a sphere", reach, shape), _gain_fact(radial.noise)]
    if imaging.optics is None:
        return []
    if not imaging.other_optics:
        return _channel_facts(imaging, imaging.optics)
    return [
        (f"{name}, channel {k}", value, remark)
        for k, optics in enumerate((imaging.optics, *imaging.other_optics))
        for name, value, remark in _channel_facts(imaging, optics)
    ]


def _channel_facts(imaging: Imaging, optics: Optics) -> list[Fact]:
    """Return size and point spread of the image of a sphere, and the noise, of one channel."""
    values = (optics.diameter, *optics.psf)
    size, psf_z, psf = (number_text(v, e) for v, e in zip(values, optics.stderr, strict=True))
    learned = "learned from the images" if any(optics.stderr) else "as stated"
    expected = f"{learned}; the expected diameter is {number_text(imaging.diameter)} µm"
    if optics.shell:
        expected += "; the surface of the spheres is fluorescent"
    tail = []
    if optics.tail is not None:
        wide_z, wide = (number_text(width) for width in optics.tail.psf)
        share = f"{100 * optics.tail.share:.0f} % of the intensity, {wide_z} µm along z"
        tail = [("tail of the point spread", f"{wide} µm", share)]
    if optics.pupil is not None:
        radius, airy = number_text(optics.pupil.pinhole), number_text(optics.pupil.airy_units)
        remark = f"radius in the sample, learned; a diameter of {airy} Airy units"
        tail.append(("pinhole", f"{radius} µm", remark))
    if optics.asymmetry is not None:
        kinds = listed(optics.asymmetry.kinds)
        remark = f"{kinds}; the fits allow for it to first order"
        tail.append(("shape of the point spread", "asymmetric", remark))
    if optics.depth is not None:
        low, high = optics.depth.low, optics.depth.high
        widths = [number_text(optics.depth.psf(optics.psf, height)[0]) for height in (low, high)]
        remark = f"{number_text(low)} and {number_text(high)} µm high in the stack"
        tail.append(("point spread along z by depth", f"{' to '.join(widths)} µm", remark))
    if optics.spread:
        expected += f"; spheres differ by {100 * optics.spread:.1f} % (standard deviation)"
    return [
        ("apparent diameter", f"{size} µm", expected),
        ("point spread", f"{psf} µm", f"standard deviation in the plane; {psf_z} µm along z"),
        *tail,
        _gain_fact(optics.noise),
    ]


def _gain_fact(noise: CameraNoise | TransmissionNoise) -> Fact:
    """Return the gain of the camera and the variance of a voxel."""
    gain, sign = number_text(noise.gain), "−" if noise.floor < 0 else "+"
    floor = number_text(abs(noise.floor))
    return (
        "gain",
        gain,
        f"the variance of a voxel is {gain} times its signal {sign} {floor}, in grey levels",
    )


def rigid_body_facts(report: Report) -> list[Fact]:
    """Return what the rigid bodies imply: errors, contact distance and symmetry rotation.

    Parameters
    ----------
    report : Report
        Report of a movie, with `imaging`.

    Returns
    -------
    list of tuple of str
        Name, value and remark of each quantity.
    """
    facts = []
    sigma = [c.motion.sigma for c in report.clusters if np.isfinite(c.motion.sigma)]
    if sigma:
        remark = "of one coordinate, median of the clusters; not only image noise"
        value = f"{number_text(1e3 * float(np.median(sigma)), digits=2)} nm"
        facts.append(("error from rigid bodies", value, remark))
    contact = imaging_of(report).contact
    shapes = [c.motion.template for c in report.clusters]
    shapes += [rod.motion.places[:, None] for rod in report.rods]
    distance = np.concatenate([np.empty(0), *(pair_distances(shape) for shape in shapes)])
    distance = distance[distance < TOUCHING_REACH * contact]
    if distance.size:
        mean = float(distance.mean())
        off = f"{100 * (mean / contact - 1):+.2g} %".replace("-", "−")
        remark = f"mean of {distance.size} pairs; contact is {number_text(contact)} µm ({off})"
        facts.append(("distance of touching spheres", f"{number_text(mean, digits=4)} µm", remark))
    for turn in least_turns(report)[:1]:
        remark = "a step of half of it or more may be an exchange of spheres"
        facts.append(("smallest symmetry rotation", f"{number_text(turn)}°", remark))
    return facts
