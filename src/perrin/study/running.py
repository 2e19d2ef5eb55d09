"""Every movie of a study measured: in this process, on several cores, or on a Dask cluster."""

from __future__ import annotations

import time
from contextlib import nullcontext, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from perrin.motion.rods import RodMotion
from perrin.movie.stacks import analyze_stack
from perrin.report.write import complete_run, write_run
from perrin.run.folders import filled_folder
from perrin.run.results import RodResult, write_data
from perrin.run.tables import analyze
from perrin.run.workers import Work, dask_client
from perrin.study.ledger import (
    RUNS,
    Entry,
    is_current,
    read_entries,
    settings_of,
    stamp_of,
    write_entry,
)
from perrin.study.manifest import STACK_OPTIONS, TABLE_OPTIONS

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from contextlib import AbstractContextManager

    from perrin.run.results import ClusterResult, Report
    from perrin.study.manifest import StudyMovie

# Movies that are given to the scheduler for each worker: one that it measures, and the next one.
_MOVIES_PER_WORKER = 2

# Time between two counts of the workers, and between two looks for finished movies, s.
_SECONDS_BETWEEN_COUNTS, _SECONDS_BETWEEN_LOOKS = 5.0, 0.02

# Workers that the frames of one movie keep busy.
_MOST_SHARED = 32

# Failures of the machine, after which the next call tries again; other errors lie in the data.
_OF_THE_MACHINE = (OSError, MemoryError, ImportError)


@dataclass(frozen=True)
class Task:
    """One movie that is measured, and where its results go.

    Attributes
    ----------
    movie : StudyMovie
    folder : str
        Folder of the study.
    reports : bool
        Whether its run folder has figures and a report page.
    scheduler : str or None
        Address of a Dask scheduler among whose workers the frames of the movie are divided.
    """

    movie: StudyMovie
    folder: str
    reports: bool = True
    scheduler: str | None = None


def measure_movie(task: Task) -> Entry:
    """Measure a movie, write its run folder and its entry; a failure becomes an entry too.

    Parameters
    ----------
    task : Task

    Returns
    -------
    Entry
    """
    movie, folder = task.movie, Path(task.folder)
    start = time.monotonic()
    known: dict[str, Any] = {
        "name": movie.name,
        "settings": settings_of(movie, reports=task.reports),
        "stamp": stamp_of(movie.path),
    }
    # On one thread the sums of numerical libraries are the same everywhere.
    one_thread: AbstractContextManager[object] = nullcontext()
    with suppress(ModuleNotFoundError):
        from threadpoolctl import threadpool_limits

        one_thread = threadpool_limits(1)
    try:
        with one_thread:
            report = _measured(task)
        entry = Entry(
            status="done",
            sha256=report.settings.get("input", {}).get("sha256"),
            seconds=time.monotonic() - start,
            **_content(report, movie),
            **known,
        )
        write_entry(folder, entry)
    except Exception as fault:  # whatever one movie raises, the others are measured
        text = f"{type(fault).__name__}: {fault}" if not str(fault) else str(fault)
        entry = Entry(
            status="failed",
            # A path in it may not be UTF-8.
            reason=" ".join(text.encode("utf-8", "backslashreplace").decode().split()),
            retry=isinstance(fault, _OF_THE_MACHINE),
            seconds=time.monotonic() - start,
            **known,
        )
        with suppress(OSError):  # a full disk: the caller keeps the entry
            write_entry(folder, entry)
    return entry


def unfinished(
    movies: Sequence[StudyMovie], folder: Path, *, reports: bool
) -> tuple[dict[str, Entry], list[StudyMovie]]:
    """Return the entries that are as they should be, and the movies that are to be measured.

    Parameters
    ----------
    movies : sequence of StudyMovie
    folder : Path
        Folder of the study.
    reports : bool

    Returns
    -------
    entries : dict of Entry
    movies : list of StudyMovie
    """
    there = read_entries(folder)
    current, wanted = {}, []
    for movie in movies:
        entry = there.get(movie.name)
        if entry is not None and is_current(entry, movie, folder, reports=reports):
            current[movie.name] = entry
        else:
            wanted.append(movie)
    return current, wanted


def measure_all(
    movies: Sequence[StudyMovie],
    folder: Path,
    *,
    reports: bool = True,
    workers: int = 0,
    scheduler: str | None = None,
) -> Iterator[Entry]:
    """Measure movies and yield their entries in the order in which they are finished.

    Parameters
    ----------
    movies : sequence of StudyMovie
    folder : Path
        Folder of the study.
    reports : bool
        Whether every run folder has figures and a report page.
    workers : int
        Number of processes of this machine; 0 does the work in this one.
    scheduler : str, optional
        Address of a running Dask scheduler.

    Yields
    ------
    Entry

    Raises
    ------
    ModuleNotFoundError, OSError
        If dask.distributed is missing, or the scheduler does not answer or has stopped.

    Notes
    -----
    Tables, and movies in full rounds of the workers, are tasks of their own: nothing is exchanged
    while they are measured. Where the last round would leave half of the workers idle, its movies
    are measured one after another, with their frames divided among all. At most two movies for
    each worker are with the scheduler at a time, and what returns is an entry: memory depends on
    the workers and not on the movies.
    """
    tasks = [Task(movie, str(folder), reports) for movie in movies]
    if not workers and scheduler is None:
        for task in tasks:
            yield measure_movie(task)
        return
    Work(workers=workers, scheduler=scheduler)  # refuses what is out of range
    with dask_client(workers, scheduler) as client:
        count = max(len(client.scheduler_info(n_workers=-1)["workers"]), 1)
        stacks = [task for task in tasks if task.movie.source == "movie"]
        left = len(stacks) % count
        divided = stacks[len(stacks) - left :] if 2 * left <= min(count, _MOST_SHARED) else []
        whole = [task for task in tasks if task not in divided]
        yield from _distributed(whole, client)
        address = client.scheduler.address
        for task in divided:
            yield measure_movie(replace(task, scheduler=address))


def _distributed(tasks: Sequence[Task], client: Any) -> Iterator[Entry]:  # noqa: ANN401 (dask's)
    """Yield the entries of tasks that are divided among the workers, few of them at a time."""
    from concurrent.futures import CancelledError

    from distributed import KilledWorker, as_completed

    waiting = list(reversed(tasks))
    running: dict[Any, Task] = {}
    finished = as_completed(loop=client.loop)
    wanted, counted = _MOVIES_PER_WORKER, -np.inf
    while running or waiting:
        if time.monotonic() > counted + _SECONDS_BETWEEN_COUNTS:
            # Workers of a queueing system join and leave while others measure.
            with suppress(OSError):  # a lost scheduler: its futures state that
                wanted = _MOVIES_PER_WORKER * max(len(client.nthreads()), 1)
            counted = time.monotonic()
        while waiting and len(running) < wanted:
            task = waiting.pop()
            future = client.submit(measure_movie, task, pure=False, retries=0)
            running[future] = task
            finished.add(future)
        if not finished.has_ready():
            time.sleep(_SECONDS_BETWEEN_LOOKS)
            continue
        future = next(finished)
        task = running.pop(future)
        try:
            entry = future.result()
        except KilledWorker as fault:
            entry = Entry(
                name=task.movie.name,
                status="failed",
                reason="workers were killed repeatedly while they measured it (out of memory, or "
                f"out of time?): {fault}",
                retry=True,
                settings=settings_of(task.movie, reports=task.reports),
                stamp=stamp_of(task.movie.path),
            )
            write_entry(Path(task.folder), entry)
        except CancelledError as fault:
            raise ConnectionError(
                "the Dask scheduler has stopped; finished movies are kept, and the same command "
                "resumes the study"
            ) from fault
        future.release()
        yield entry


def _measured(task: Task) -> Report:
    """Return the report of a movie, written into its run folder."""
    from perrin.images.stack import open_stack

    movie, place = task.movie, Path(task.folder) / RUNS / task.movie.name
    options: dict[str, Any] = {
        k: tuple(v) if k == "frames" else v for k, v in movie.options.items()
    }
    if movie.source == "table":
        report = analyze(movie.path, **{k: v for k, v in options.items() if k in TABLE_OPTIONS})
        if task.reports:
            write_run(report, place, overwrite=True)
        else:
            report.save(place, overwrite=True)
        return report
    opening = {k: v for k, v in options.items() if k in (*STACK_OPTIONS, "dt")}
    if opening.get("channel") is not None and isinstance(opening["channel"], list):
        opening["channel"] = tuple(opening["channel"])
    rest = {k: v for k, v in options.items() if k not in opening}
    if rest.get("refine") == "none":
        rest["refine"] = None
    with open_stack(movie.path, **opening) as stack:
        report = analyze_stack(
            stack,
            **rest,
            work=Work(keep=place, anew=True, scheduler=task.scheduler),
        )
        if task.reports:
            complete_run(report, place)
        else:
            with filled_folder(place) as stage:
                write_data(report, stage)
    return report


def _content(report: Report, movie: StudyMovie) -> dict[str, Any]:
    """Return the values of all clusters, the kinds of bodies and the remarks of a report."""
    kinds = []
    number: dict[int, int] = {}
    diameter = movie.options.get("diameter") if movie.source == "table" else None
    diameter = movie.options.get("contact", diameter)
    by_number = {one.cluster: one for one in report.results}
    for k, kind in enumerate(report.kinds):
        number |= dict.fromkeys(kind.clusters, k)
        motion = by_number[next(iter(kind.clusters))].motion
        template = (
            motion.places[:, None] * np.array([[1.0, 0.0, 0.0]])
            if isinstance(motion, RodMotion)
            else motion.template
        )
        kinds.append(
            {
                "size": kind.size,
                "point_group": kind.point_group,
                "count": len(kind.clusters),
                "template": np.round(template / (diameter or 1.0), 6).tolist(),
            }
        )
    return {
        "clusters": tuple(_values(one, number.get(one.cluster)) for one in report.results),
        "kinds": tuple(kinds),
        "warnings": report.warnings,
        "notes": report.notes,
    }


def _values(result: ClusterResult | RodResult, kind: int | None) -> dict[str, Any]:
    """Return what a study keeps of one cluster."""
    turn_name = "D_perp" if isinstance(result, RodResult) else "D_R"
    turn = result.D_perp if isinstance(result, RodResult) else result.D_R
    verdicts = getattr(result, "verdicts", {})
    quality = getattr(result, "quality", None)
    entry: dict[str, Any] = {
        "cluster": result.cluster,
        "label": result.label,
        "kind": kind,
        "rigid": None if quality is None else bool(quality.rigid),
        "frames": int(result.motion.fitted.size),
        "warnings": list(result.warnings),
    }
    for name, symbol, quantity, one in (
        ("D_R", turn_name, "rotation", turn),
        ("D_T", "D_T", "translation", result.D_T),
    ):
        verdict = verdicts.get(quantity)
        compared = getattr(result.prediction, symbol, None)
        entry[name] = {
            "symbol": symbol,
            "value": one.value,
            "stderr": one.stderr,
            "ci68": list(one.ci68),
            "ci95": list(one.ci95),
            "unit": one.unit,
            "resolved": one.resolved,
            "verdict": (verdict.kind if verdict is not None else one.motion) or "not judged",
            "predicted": None if compared is None else compared.predicted,
        }
    return entry
