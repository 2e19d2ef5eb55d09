"""`analyze`: from a track table to a Report."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from perrin._text import counted
from perrin.run.experiment import Recording, merged_experiment
from perrin.run.measure import measure_table
from perrin.run.remarks import Remarks
from perrin.run.workers import Work, check_workers
from perrin.tracks.clusters import identify
from perrin.tracks.files import check_tracks, read_tracks
from perrin.tracks.screening import (
    distance_notes,
    has_trackpy_columns,
    has_trackpy_order,
    screen_rows,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    import pandas as pd
    from numpy.typing import ArrayLike

    from perrin.run.experiment import Experiment, MotionModel
    from perrin.run.measure import Progress
    from perrin.run.results import Report


def analyze(
    tracks: str | os.PathLike[str] | pd.DataFrame,
    *,
    dt: float | None = None,
    scale: ArrayLike = 1.0,
    columns: Mapping[str, str | int] | None = None,
    contact: float | None = None,
    size: int | None = None,
    sigma: ArrayLike | None = None,
    noise: Literal["joint", "residual"] | float = "joint",
    exposure: float | None = None,
    drift: bool = False,
    keep_jumps: bool = False,
    model: MotionModel | None = None,
    viscosity: float | None = None,
    temperature: float | None = None,
    diameter: float | None = None,
    frames: tuple[int | None, int | None] | None = None,
    experiment: Experiment | None = None,
    workers: int = 0,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> Report:
    """Measure D_R and D_T of every cluster in a track table.

    Parameters
    ----------
    tracks : path, pandas.DataFrame or MDAnalysis selection
        A file that `read_tracks` reads, or a table with the columns frame, particle, x, y[, z] and
        perhaps cluster and time (s), which may be uneven.
    dt : float
        Time between successive frame numbers, s; the column time must agree with it.
    scale : float or array_like
        um per unit of the coordinates, one number or one per axis.
    columns : mapping, optional
        Names or numbers of the file's columns by perrin's names (files only).
    contact : float, optional
        Centre distance of touching particles, um: finds the clusters in a table without a
        cluster column. Without it they are found by the distances that stay the same.
    size : int, optional
        Number of particles of a cluster, for a table without the column particle: with `contact`,
        `identify` finds particles and clusters.
    sigma : float or array_like, optional
        Known localisation error, um, one number or one per axis: sets the predicted noise floor and
        the test of rigidity, not the estimates.
    noise : {"joint", "residual"} or float
        How the noise under the estimates is known: free, from the rigid-fit residuals, or a
        localisation error in um; see `estimate_diffusion`.
    exposure : float, optional
        Open fraction of dt, 0 to 1; unknown by default.
    drift : bool
        Subtract a mean velocity (flow, sedimentation) from D_T and a mean spin from D_R; both are
        reported.
    keep_jumps : bool
        Leave steps in the estimates that Brownian motion cannot make (a jump of the stage, an
        exchange of labels). By default they are reported and the estimates of D leave them out.
    model : {"anomalous", "confined", "switching"}, optional
        Other motion that is fitted to every cluster, whatever `judge_motion` finds; the fit is
        then `MotionVerdict.model`, in ``summary.json`` "parameters". By default the motion that
        was found is fitted, if it is not diffusion.
    viscosity, temperature : float, optional
        Pa s and K: with both, sizes follow from D_T and from D_R for equal spheres of the measured
        shape, in three dimensions. The temperature alone gives the size and the viscosity that D_T
        and D_R imply together.
    diameter : float, optional
        Sphere diameter, um: with viscosity and temperature, the measured D_T and D_R of every
        cluster are compared with predicted ones. Without it, sizes are those of spheres that touch.
    frames : tuple of int or None, optional
        First frame and first frame that is not used, as in a slice.
    experiment : Experiment, optional
        dt, sigma, noise, exposure, drift, keep_jumps, model, viscosity, temperature and diameter in
        one object; a value is stated here or as its own argument, not both.
    workers : int
        Number of processes of this machine that share the clusters; 0 does the work in this one.
        The results are the same to the last bit. A script calls with workers below the line
        ``if __name__ == "__main__":``, since each process imports the script.
    scheduler : str, optional
        Address of a Dask scheduler whose workers share the clusters, such as tcp://node7:8786.
    progress : callable, optional
        Called with the number of finished clusters, their total, and what is done.

    Returns
    -------
    Report

    Raises
    ------
    ModuleNotFoundError, OSError
        If dask.distributed is needed and not installed, or the scheduler does not answer.
    TrackTableError
        If the table cannot be read, or if its particles belong to no cluster.
    DegenerateClusterError, TooFewFramesError
        If no cluster can be measured; a cluster that cannot be measured among others is a warning.
    ValueError
        For arguments out of range, or stated both in `experiment` and as a keyword.

    Examples
    --------
    >>> import perrin
    >>> from importlib.resources import files
    >>> report = perrin.analyze(str(files("perrin") / "data" / "demo_tracks.csv.gz"), dt=0.73)
    >>> print(report.clusters[0].D_R)
    D_R = 0.0069(6) rad^2/s [mle, 300 frames]
    """
    experiment = merged_experiment(
        experiment,
        dt=dt,
        sigma=sigma,
        noise=noise,
        exposure=exposure,
        drift=drift,
        keep_jumps=keep_jumps,
        model=model,
        viscosity=viscosity,
        temperature=temperature,
        diameter=diameter,
        contact=contact,
    )
    work = Work(workers=workers, scheduler=scheduler)
    if experiment.dt is None:
        raise ValueError("dt: needed, the time between successive frame numbers, s")
    check_workers(work)
    table, source, remarks = read_table(
        tracks, scale=scale, columns=columns, frames=frames, contact=contact, size=size
    )
    plain_scale = np.asarray(scale, dtype=np.float64).tolist()
    return measure_table(
        table,
        experiment,
        source=source,
        arguments=experiment.to_dict()
        | {"contact": contact, "frames": frames, "columns": columns, "scale": plain_scale}
        | ({} if size is None else {"size": size}),
        contact=contact,
        recording=Recording(dt=experiment.dt),
        remarks=remarks,
        progress=progress,
        work=work,
    )


def read_table(
    tracks: str | os.PathLike[str] | pd.DataFrame,
    *,
    scale: ArrayLike = 1.0,
    columns: Mapping[str, str | int] | None = None,
    frames: tuple[int | None, int | None] | None = None,
    contact: float | None = None,
    size: int | None = None,
) -> tuple[pd.DataFrame, dict[str, str | None], Remarks]:
    """Read or check a track table, and mark the rows that are no measurements.

    Parameters
    ----------
    tracks, scale, columns, frames, contact, size
        As in `analyze`.

    Returns
    -------
    table : pandas.DataFrame
        Clean table, um.
    source : dict
        Path of the file and its SHA-256; None for a table.
    remarks : Remarks

    Raises
    ------
    TrackTableError, ValueError
        As in `analyze`.
    """
    if isinstance(tracks, str | os.PathLike):
        table = read_tracks(tracks, scale=scale, columns=columns, detections=size is not None)
        digest = hashlib.sha256(Path(tracks).read_bytes()).hexdigest()
        source: dict[str, str | None] = {"path": os.fspath(tracks), "sha256": digest}
    else:
        if columns is not None:
            raise ValueError("columns: only for files; rename the columns of a table")
        table = check_tracks(tracks, source="the table", scale=scale, detections=size is not None)
        source = {"path": None, "sha256": None}
        if "piece" in getattr(tracks, "columns", ()):  # where `identify` was in doubt
            table["piece"] = tracks["piece"].to_numpy()
    if size is not None and (contact is None or "particle" in table):
        wrong = "contact is needed too" if contact is None else "the table has a column particle"
        raise ValueError(f"size: finds the particles of a table without ids; {wrong}")
    names: list[str] = table.attrs["columns"]
    read_notes = list(table.attrs.get("notes", ()))
    first, stop = frames or (None, None)
    keep = np.ones(len(table), dtype=np.bool_)
    if first is not None:
        keep &= (table["frame"] >= first).to_numpy()
    if stop is not None:
        keep &= (table["frame"] < stop).to_numpy()
    if not keep.any():
        low, high = int(table["frame"].min()), int(table["frame"].max())
        raise ValueError(f"frames {first}:{stop} hold no rows; the table runs from {low} to {high}")
    table = table if keep.all() else table[keep].reset_index(drop=True)
    if size is not None and contact is not None:
        table = identify(table, contact=contact, size=size)
        known = table["cluster"] >= 0
        count = int(table["cluster"][known].nunique())
        read_notes.append(
            f"particles are identified in {counted(count, 'cluster')} of {size}; "
            f"{counted(int((~known).sum()), 'row', 'belong')} to none, of {len(known)}"
        )
    screened = screen_rows(table)
    notes, warnings = distance_notes(
        screened.table,
        scale_given=bool(np.any(np.asarray(scale) != 1)),
        trackpy_columns=has_trackpy_columns(names),
        trackpy_order=has_trackpy_order(names),
    )
    of_trackpy = has_trackpy_columns(names) or has_trackpy_order(names)
    if "z" in table and of_trackpy and np.ndim(scale) == 0 and scale != 1:
        read_notes.append(
            f"scale: {float(np.asarray(scale)):g} um for z as for x and y; if the planes of the "
            "stack are not as far apart as the pixels, state three numbers, for x, y and z"
        )
    remarks = Remarks([*screened.warnings, *warnings], [*read_notes, *screened.notes, *notes])
    return screened.table, source, remarks
