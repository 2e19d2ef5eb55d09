"""How the spheres of a movie were seen: what was found in its frames, and what they look like."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from perrin.images.optics.optics import Optics

if TYPE_CHECKING:
    from pathlib import Path

    import pandas as pd

    from perrin._arrays import Floats


@dataclass(frozen=True, eq=False)
class View:
    """One frame seen along its three axes: brightest voxels on each line of sight.

    Of dark spheres the darkest. A 2-D frame has only `xy`; the others have one row.

    Attributes
    ----------
    frame : int
        Number in the stack.
    xy, xz, yz : ndarray, shapes (y, x), (z, x), (z, y)
        Grey levels.
    """

    frame: int
    xy: Floats
    xz: Floats
    yz: Floats


@dataclass(frozen=True, eq=False)
class Imaging:
    """How the spheres of a movie were seen.

    Attributes
    ----------
    features : pandas.DataFrame
        A row per sphere found: ``frame`` (of the stack), ``x, y, z`` (um), ``mass``, what `locate`
        says besides, and ``cluster, particle, piece`` (cluster -1: of none).
    frames : pandas.DataFrame
        A row per frame used: ``frame``, ``time`` (s), ``spots`` (before the mass cut), ``spheres``,
        ``level`` (median grey level), ``saturated`` (share of voxels clipped at the highest value),
        ``fault`` (why it could not be read, or ""), ``copy_of`` (the earlier frame that it repeats
        exactly, or -1; such a frame has no features).
    spots : pandas.DataFrame
        ``frame, mass`` of all spots, noise included, of a few frames all over the movie.
    views : tuple of View
        A few frames all over the movie.
    optics : Optics or None
        How a sphere is seen; None without refinement by the model.
    minmass : float
        The mass cut; 0: nothing is cut.
    voxel : tuple of float
        (z, y, x), um; z is NaN in the plane.
    diameter, contact : float
        What was looked for, um.
    dark : bool
        Spheres are darker than what surrounds them.
    refine : str or None
    """

    features: pd.DataFrame
    frames: pd.DataFrame
    spots: pd.DataFrame
    views: tuple[View, ...]
    optics: Optics | None
    minmass: float
    voxel: tuple[float, float, float]
    diameter: float
    contact: float
    dark: bool
    refine: str | None


_TABLES = ("features", "frames", "spots")


def write_imaging(imaging: Imaging, folder: Path) -> None:
    """Write features.parquet, frames.parquet, spots.parquet, views.npz and imaging.json."""
    for name in _TABLES:
        getattr(imaging, name).to_parquet(folder / f"{name}.parquet", index=False)
    views = {f"{v.frame}-{side}": getattr(v, side) for v in imaging.views for side in _SIDES}
    np.savez_compressed(folder / "views.npz", **views)
    entry: dict[str, Any] = {
        "optics": None if imaging.optics is None else asdict(imaging.optics),
        "minmass": imaging.minmass,
        "voxel": [v if np.isfinite(v) else None for v in imaging.voxel],
        "diameter": imaging.diameter,
        "contact": imaging.contact,
        "dark": imaging.dark,
        "refine": imaging.refine,
    }
    text = json.dumps(entry, indent=2, allow_nan=False)
    (folder / "imaging.json").write_text(text + "\n", encoding="utf-8")


_SIDES = ("xy", "xz", "yz")


def read_imaging(folder: Path) -> Imaging:
    """Read back what `write_imaging` wrote.

    Raises
    ------
    FileNotFoundError
        If a file is missing.
    """
    import pandas as pd

    entry = json.loads((folder / "imaging.json").read_text(encoding="utf-8"))
    optics = entry.pop("optics")
    z, y, x = (np.nan if v is None else float(v) for v in entry.pop("voxel"))
    with np.load(folder / "views.npz") as stored:
        frames = sorted({int(name.partition("-")[0]) for name in stored})
        views = tuple(View(k, *(stored[f"{k}-{side}"] for side in _SIDES)) for k in frames)
    tables = {name: pd.read_parquet(folder / f"{name}.parquet") for name in _TABLES}
    return Imaging(
        **tables,
        views=views,
        optics=None if optics is None else Optics.from_dict(optics),
        voxel=(z, y, x),
        **entry,
    )
