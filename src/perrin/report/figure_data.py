"""What the interactive figures of one cluster draw: curves, paths, steps and residuals."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from perrin._arrays import Floats, Ints, finite_or_none
from perrin._text import unit_text
from perrin.diffusion.steps import Quantity
from perrin.geometry.rigid import degrees_of_freedom
from perrin.geometry.rotations import unit_quaternion
from perrin.geometry.shapes import pair_distances
from perrin.motion.rods import RodMotion
from perrin.plot.results import curve_floors, model_line
from perrin.plot.step_law import step_distribution
from perrin.report.embedding import packed

if TYPE_CHECKING:
    import pandas as pd

    from perrin.motion.rigid_motion import RigidMotion
    from perrin.run.results import ClusterResult, RodResult

_LAGS = 80  # lag times of a curve, evenly over its logarithm
_FEWEST_DRAWN_FRAMES, _MOST_DRAWN_FRAMES = 60, 2000  # frames of a path that are drawn
_MOST_BYTES = 3_200_000  # of the paths of all clusters together, before compression


def cluster_data(
    result: ClusterResult | RodResult,
    rows: Floats,
    *,
    clusters: int,
    diameter: float | None = None,
    **texts: str,
) -> str:
    """Return what the page draws of a cluster, compressed.

    Parameters
    ----------
    result : ClusterResult or RodResult
    rows : ndarray, shape (rows, 2 + d)
        The cluster's rows of `grouped_tracks`, for the measured places.
    clusters : int
        Number of clusters of the report: paths of many clusters are drawn with fewer frames.
    diameter : float, optional
        Sphere diameter, um; by default the smallest distance of two particles.
    **texts
        Further texts of the header.

    Returns
    -------
    str
        The text of `perrin.report.packed`. Its curves are logarithms to base 10 of lag times and
        values, and relative errors.
    """
    motion: Any = result.motion
    rod = isinstance(motion, RodMotion)
    template = np.outer(motion.places, [1.0, 0.0, 0.0]) if rod else motion.template
    places = _measured_places(rows, count=len(motion.time), template=template)
    width = 8 + (0 if places is None else places.shape[1] * places.shape[2])
    allowed = int(
        np.clip(_MOST_BYTES / clusters / (2 * width), _FEWEST_DRAWN_FRAMES, _MOST_DRAWN_FRAMES)
    )
    stride = -(-len(motion.time) // allowed)
    shown = np.arange(0, len(motion.time), stride)
    header: dict[str, Any] = {
        **texts,
        "dimension": int(template.shape[1]),
        "template": np.round(template, 5).tolist(),
        "diameter": diameter or float(pair_distances(template).min()),
        "stride": int(stride),
        "frames": len(motion.time),
        "dt": motion.dt,
        "rod": rod,
    }
    arrays = {"time": motion.time[shown], "residual": motion.residual[shown]}
    arrays |= {f"center{k}": motion.center[shown, k] for k in range(motion.center.shape[1])}
    arrays |= _orientations(motion, shown, rod=rod)
    if places is not None:
        arrays["places"] = places[shown] - motion.center[shown, None]
    curves: dict[str, Floats] = {}
    if not rod:
        more, curves = _rigid_parts(result, motion)  # type: ignore[arg-type]
        header |= more
    return packed(header, arrays | curves)


def grouped_tracks(tracks: pd.DataFrame) -> dict[int, Floats]:
    """Return the rows of each cluster as an array: frame, particle, coordinates, um.

    Parameters
    ----------
    tracks : pandas.DataFrame
        `Report.tracks`.

    Returns
    -------
    dict
        Arrays of shape (rows, 2 + d) by cluster number.

    Examples
    --------
    >>> import pandas as pd
    >>> row = {"frame": [0], "particle": [3], "cluster": [7], "x": [1.0], "y": [2.0]}
    >>> grouped_tracks(pd.DataFrame(row))
    {7: array([[0., 3., 1., 2.]])}
    """
    axes = [a for a in "xyz" if a in tracks]
    rows = tracks[["frame", "particle", *axes]].to_numpy(dtype=np.float64)
    cluster = tracks["cluster"].to_numpy(dtype=np.int64)
    order = np.argsort(cluster, kind="stable")
    numbers, starts = np.unique(cluster[order], return_index=True)
    return dict(zip(numbers.tolist(), np.split(rows[order], starts[1:]), strict=True))


def _measured_places(rows: Floats, *, count: int, template: Floats) -> Floats | None:
    """Return the measured positions (T, n, d), or None where they are not those of the motion."""
    rows = rows[np.isfinite(rows[:, 2:]).all(axis=1)]
    ids, particle = np.unique(rows[:, 1], return_inverse=True)
    if rows.shape[1] - 2 != template.shape[1] or len(ids) != len(template):
        return None
    frame = (rows[:, 0] - rows[:, 0].min()).astype(np.int64)
    if frame.max() != count - 1:
        return None
    places = np.full((count, *template.shape), np.nan)
    places[frame, particle] = rows[:, 2:]
    return places


def _orientations(motion: Any, shown: Ints, *, rod: bool) -> dict[str, Floats]:  # noqa: ANN401
    """Return quaternions, or directions of a rod, and the rotation from the first frame."""
    if rod:
        return {f"u{k}": motion.direction[shown, k] for k in range(3)}
    rotation = motion.rotation[shown]
    turned = motion.accumulated_rotation()[shown]
    parts = {f"turn{k}": turned[:, k] for k in range(turned.shape[1])}
    if motion.dimension == 2:
        half = np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0]) / 2
        return parts | {"q0": np.cos(half), "q3": np.sin(half)}
    q = np.full((len(rotation), 4), np.nan)
    known = np.isfinite(rotation[:, 0, 0])
    q[known] = unit_quaternion(rotation[known])
    return parts | {f"q{k}": q[:, k] for k in range(4)}


def _rigid_parts(
    result: ClusterResult, motion: RigidMotion
) -> tuple[dict[str, Any], dict[str, Floats]]:
    """Return lines and numbers for the header, and the columns of curves and distributions."""
    header: dict[str, Any] = {"lines": {}, "steps": {}}
    columns: dict[str, Floats] = {}
    floors = dict(zip(("msad", "msd"), curve_floors(result), strict=True))
    for name, curve, estimate in (
        ("msad", result.msad, result.D_R),
        ("msd", result.msd, result.D_T),
    ):
        if estimate.absent_because is not None:
            continue
        line = model_line(curve, estimate, result.tensor if name == "msad" else None)
        entry: dict[str, Any] = {"dof": curve.dof, "unit": unit_text(curve.unit)}
        entry |= {"floor": finite_or_none(floors[name]), "span": float(curve.lagtime[-1])}
        if line is not None:
            text = line.text.replace(r"$\langle D\rangle$", "⟨D⟩")
            text = text.replace("$D_R$", "D<sub>R</sub>").replace("$D_T$", "D<sub>T</sub>")
            entry |= {"D": line.D, "offset": line.offset, "error": line.stderr, "text": text}
        header["lines"][name] = entry
        # At most 80 lags, evenly over the logarithm.
        kept, count = np.arange(len(curve.lagtime)), len(curve.lagtime)
        if count > _LAGS:
            kept = np.unique(np.rint(np.geomspace(1, count, _LAGS)).astype(np.int64)) - 1
        value, error = curve.value[kept], curve.stderr[kept]
        shown = value > 0
        value = np.where(shown, value, 1.0)
        columns |= {
            f"{name}_t": np.log10(curve.lagtime[kept]),
            f"{name}_y": np.where(shown, np.log10(value), np.nan),
            f"{name}_e": np.where(shown, np.minimum(error / value, 10.0), np.nan),
        }
    d = motion.dimension
    kinds = zip(("turn", "shift"), get_args(Quantity), ("rad", "µm"), strict=True)
    for name, quantity, unit in kinds:
        found = step_distribution(result, quantity)
        if found is None:
            continue
        columns[f"{name}_steps"] = found.number
        header["steps"][name] = {
            "count": int(found.number.sum()),
            "half": float(found.edges[-1]),
            "variance": found.variance.tolist(),
            "unit": unit,
        }
    if result.tensor is not None:
        header["axes"] = np.round(result.tensor.axes.T, 4).tolist()
        header["principal"] = result.tensor.principal_values.tolist()
    full = degrees_of_freedom(np.array([len(motion.template)]), d)[0]
    header["expected"] = float(motion.sigma * np.sqrt(full / len(motion.template)))
    return header, columns


def body_picture(template: Floats, diameter: float, *, label: str) -> str:
    """Return spheres in parallel projection as SVG, the nearest drawn last.

    Parameters
    ----------
    template : ndarray, shape (n, d)
        Centres, um.
    diameter : float
        Sphere diameter, um.
    label : str
        Description of the picture for readers who do not see it; it must contain no markup.

    Returns
    -------
    str

    Examples
    --------
    >>> body_picture(np.zeros((1, 3)), 1.0, label="one sphere").count("<circle")
    1
    """
    points = np.zeros((len(template), 3))
    points[:, : template.shape[1]] = template
    if template.shape[1] == 3:
        tilt, side = np.deg2rad([25.0, 35.0])
        about = np.array([[np.cos(side), -np.sin(side), 0], [np.sin(side), np.cos(side), 0]])
        about = np.vstack([about, [0.0, 0.0, 1.0]])
        up = np.array([[1, 0, 0], [0, np.sin(tilt), np.cos(tilt)]])
        up = np.vstack([up, [0.0, -np.cos(tilt), np.sin(tilt)]])
        points = points @ about.T @ up.T
    half = float(np.abs(points[:, :2]).max()) + 0.6 * diameter
    scale = 100 / half
    circles = "".join(
        f'<circle cx="{scale * x:.1f}" cy="{-scale * y:.1f}" r="{scale * diameter / 2:.1f}" '
        f'fill="url(#ball)" stroke="#00456e" stroke-width="1"/>'
        for x, y, _ in points[np.argsort(points[:, 2])]
    )
    bar = 10.0 ** np.floor(np.log10(half))
    return (
        f'<svg class="still" viewBox="-104 -104 208 222" role="img" aria-label="{label}">'
        '<defs><radialGradient id="ball" cx=".35" cy=".3" r=".75"><stop offset="0" '
        'stop-color="#cfe6f5"/><stop offset=".5" stop-color="#3d97cf"/><stop offset="1" '
        'stop-color="#00527f"/></radialGradient></defs>'
        f'{circles}<path d="M-100 108h{scale * bar:.1f}" stroke="currentColor" stroke-width="2"/>'
        f'<text x="{-96 + scale * bar:.1f}" y="112" font-size="11" fill="currentColor">{bar:g} µm'
        "</text></svg>"
    )
