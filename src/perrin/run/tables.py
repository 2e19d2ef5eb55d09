"""The main job: from a track table to a Report."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from perrin.run.experiment import Conditions, _plain, check_arguments, told_conditions
from perrin.run.measure import Remarks, measure_table
from perrin.tracks.files import check_tracks, read_tracks
from perrin.tracks.screening import distance_notes, has_trackpy_columns, screen_rows

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    import pandas as pd
    from numpy.typing import ArrayLike

    from perrin.run.results import Report


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
    keep_jumps: bool = False,
    viscosity: float | None = None,
    temperature: float | None = None,
    diameter: float | None = None,
    frames: tuple[int | None, int | None] | None = None,
) -> Report:
    """Measure D_R and D_T of every cluster in a track table.

    Parameters
    ----------
    tracks : path or pandas.DataFrame
        A .csv, .csv.gz, .parquet or .gdf file, or a table with the columns frame, particle, x,
        y[, z] and perhaps cluster and time (s), which may be uneven.
    dt : float
        Time between successive frame numbers, s; the column time must agree with it.
    scale : float or array_like
        um per unit of the coordinates, one number or one per axis.
    columns : mapping, optional
        Our column names to the file's names or column numbers (files only).
    contact : float, optional
        Centre distance of touching particles, um: finds the clusters in a table without a
        cluster column. Without it they are found by the distances that stay the same.
    sigma : float or array_like, optional
        Known localisation error, um, one number or one per axis: sets the predicted noise floor and
        the test of rigidity, not the estimates.
    noise : {"joint", "residual"} or float
        How the noise under the estimates is known: free, from the rigid-fit residuals, or a
        localisation error in um; see `estimate_diffusion`.
    exposure : float, optional
        Open fraction of dt, 0 to 1; unknown by default.
    drift : bool
        Take a mean velocity off D_T (flow, sedimentation) and a mean spin off D_R; both are
        reported.
    keep_jumps : bool
        Leave steps in the estimates that Brownian motion cannot make (a jump of the stage, an
        exchange of labels). By default they are reported and the estimates of D leave them out.
    viscosity, temperature : float, optional
        Pa s and K: with both, sizes follow from D_T and from D_R for equal spheres of the measured
        shape, in three dimensions. The temperature alone gives the size and the viscosity that D_T
        and D_R imply together.
    diameter : float, optional
        Of one sphere, um: with viscosity and temperature, every cluster's predicted D_T and D_R
        stand beside the measured ones. Without it, sizes are those of spheres that touch.
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
    check_arguments(
        dt=dt, contact=contact, viscosity=viscosity, temperature=temperature, diameter=diameter
    )
    table, source, remarks = _table(tracks, scale=scale, columns=columns, frames=frames)
    conditions = Conditions(
        dt, sigma, viscosity, temperature, diameter, noise, exposure, drift, keep_jumps
    )
    arguments = told_conditions(conditions) | {"contact": contact, "frames": frames}
    arguments |= {"columns": columns, "scale": _plain(scale)}
    return measure_table(
        table,
        conditions,
        contact=contact,
        source=source,
        arguments=arguments,
        remarks=remarks,
    )


def _table(
    tracks: str | os.PathLike[str] | pd.DataFrame,
    *,
    scale: ArrayLike,
    columns: Mapping[str, str | int] | None,
    frames: tuple[int | None, int | None] | None,
) -> tuple[pd.DataFrame, dict[str, str | None], Remarks]:
    """Read or check the table, and take out rows that are no measurements.

    Returns as well where it came from, and the remarks on it.
    """
    if isinstance(tracks, str | os.PathLike):
        table = read_tracks(tracks, scale=scale, columns=columns)
        digest = hashlib.sha256(Path(tracks).read_bytes()).hexdigest()
        source: dict[str, str | None] = {"path": os.fspath(tracks), "sha256": digest}
        names: Iterable[str] = table.attrs.get("columns", table.columns)
    else:
        if columns is not None:
            raise ValueError("columns: only for files; rename the columns of a table")
        table = check_tracks(tracks, source="the table", scale=scale)
        source, names = {"path": None, "sha256": None}, map(str, tracks.columns)
        if "piece" in tracks:  # where `identify` was in doubt
            table["piece"] = tracks["piece"].to_numpy()
    remarks = Remarks([], list(table.attrs.get("notes", ())))
    table = _sliced(table, frames)
    screened = screen_rows(table)
    notes, warnings = distance_notes(
        screened.table,
        scale_given=bool(np.any(np.asarray(scale) != 1)),
        trackpy_columns=has_trackpy_columns(names),
    )
    remarks.warnings.extend((*screened.warnings, *warnings))
    remarks.notes.extend((*screened.notes, *notes))
    return screened.table, source, remarks


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
