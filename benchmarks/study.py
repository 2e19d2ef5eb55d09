"""Scheduling, memory and resumption of studies: `python benchmarks/study.py [--quick]`.

Movies are replaced by tasks of a known duration that write an entry and a run folder, so that what
is measured is the study and not the machine's load; with --real tables are measured.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
import pandas as pd
from study_task import CLUSTERS, StandIn

import perrin
from perrin.study import Manifest, Study, StudyMovie, running

MEASURE_MOVIE = running.measure_movie


def study_of(count: int, folder: Path) -> Study:
    """Return a study of that many movies under five conditions."""
    movies = []
    for number in range(count):
        path = folder / f"{number}.csv"
        path.write_text("frame,particle,x,y,z\n")
        movies.append(
            StudyMovie(
                f"movie-{number}", str(path), "table", f"s{number % 5}",
                {"phi": 0.1 * (number % 5)}, options={"dt": float(number + 1)},
            )
        )  # fmt: skip
    return Study(Manifest(tuple(movies), conditions=("phi",), text="# benchmark"))


def memory(pid: int | str = "self") -> float:
    """Return the resident memory of a process, MB."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * 4096 / 1e6


def scheduling(folder: Path, *, tasks: int, seconds: float, workers: int) -> tuple[float, float]:
    """Return the efficiency of the workers, and the processor time of scheduling a task, s.

    For the second the tasks do nothing: all processor time is that of scheduling them and of
    writing their entries.
    """
    from perrin.run.workers import dask_client

    study = study_of(tasks, folder)
    running.measure_movie = StandIn(seconds)
    with dask_client(workers, None) as client:
        address = client.scheduler.address
        # The first task of a worker imports the package.
        list(running.measure_all(study.manifest.movies[:4], folder / "S", scheduler=address))
        start = time.monotonic()
        count = len(
            list(running.measure_all(study.manifest.movies, folder / "S", scheduler=address))
        )
        wall = time.monotonic() - start
        running.measure_movie = StandIn(0.0)
        before = processor_time(client)
        for _ in running.measure_all(study.manifest.movies, folder / "S", scheduler=address):
            pass
        spent = processor_time(client) - before
    return count * seconds / (workers * wall), spent / count


def processor_time(client) -> float:
    """Return the processor time of this process, with its scheduler, and of all workers, s."""
    return time.process_time() + sum(client.run(time.process_time).values())


def resumption(folder: Path, *, count: int) -> tuple[float, float, float]:
    """Return the duration of a first run of quick tasks, of a second, and the memory, MB."""
    study = study_of(count, folder)
    running.measure_movie = StandIn(0.0)
    start = time.monotonic()
    study.run(folder / "STUDY")
    first = time.monotonic() - start
    start = time.monotonic()
    study.run(folder / "STUDY")
    return first, time.monotonic() - start, memory()


def growth(folder: Path, *, counts: tuple[int, int]) -> list[float]:
    """Return the memory of the scheduling process after two numbers of movies, MB."""
    from perrin.run.workers import dask_client

    running.measure_movie = StandIn(0.0)
    found = []
    with dask_client(2, None) as client:
        for count in counts:
            place = folder / str(count)
            place.mkdir()
            movies = study_of(count, place).manifest.movies
            for _ in running.measure_all(movies, place, scheduler=client.scheduler.address):
                pass
            workers = client.run(memory).values()
            found.append(memory() + max(workers))
    return found


def tables(folder: Path, *, count: int) -> list[StudyMovie]:
    """Return movies that are tables of 5 tetrahedra in 300 frames."""
    body, rng = perrin.Cluster.touching(4, 2.45), np.random.default_rng(1)
    movies = []
    for number in range(count):
        parts = []
        for k in range(5):
            truth = perrin.simulate_motion(body, D_R=5e-3, D_T=0.04, dt=0.7, n_frames=300, rng=rng)
            x = perrin.add_noise(truth.positions() + 20 * k, sigma=0.03, rng=rng)
            table = perrin.positions_table(x)
            parts.append(table.assign(cluster=k, particle=table["particle"] + 10 * k))
        path = folder / f"r{number}.csv"
        pd.concat(parts).to_csv(path, index=False)
        movies.append(StudyMovie(f"r{number}", str(path), "table", "s", options={"dt": 0.7}))
    return movies


def work_of_a_table(folder: Path, *, reports: bool) -> float:
    """Return the processor time of measuring a table of 5 clusters and writing its folder, s."""
    movies = tables(folder, count=3)
    running.measure_movie = MEASURE_MOVIE
    list(running.measure_all(movies[:1], folder / "S", reports=reports))  # imports
    start = time.process_time()
    list(running.measure_all(movies[1:], folder / "S", reports=reports))
    return (time.process_time() - start) / (len(movies) - 1)


def real(folder: Path, *, count: int) -> float:
    """Return the efficiency of two workers on real tables against one."""
    from perrin.run.workers import dask_client

    movies = tables(folder, count=count)
    spent = []
    for workers in (1, 2):
        with dask_client(workers, None) as client:
            address = client.scheduler.address
            place = folder / f"S{workers}"
            list(running.measure_all(movies[:workers], place, reports=False, scheduler=address))
            start = time.monotonic()
            list(running.measure_all(movies, place, reports=False, scheduler=address))
            spent.append(time.monotonic() - start)
    return spent[0] / (2 * spent[1])


def main() -> int:
    """Print what is required and what was measured; the status counts what fails."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a tenth of the tasks")
    parser.add_argument("--real", action="store_true", help="measure tables, on an idle machine")
    stated = parser.parse_args()
    shorter = 10 if stated.quick else 1
    failures = 0

    def show(name: str, value: float, most: float, unit: str = "") -> None:
        nonlocal failures
        failures += value > most
        print(f"{name}: {value:.3g}{unit} (at most {most:g}{unit}){' FAILS' * (value > most)}")

    with tempfile.TemporaryDirectory() as parent:
        place = Path(parent)
        for name in ("a", "b", "c", "d", "e"):
            (place / name).mkdir()
        if stated.real:
            efficiency = real(place / "d", count=24 // (3 if stated.quick else 1))
            print(f"efficiency of two workers on tables of 5 clusters: {efficiency:.2f}")
            return 0
        work, bare = (work_of_a_table(place / name, reports=name == "d") for name in ("d", "e"))
        efficiency, cost = scheduling(place / "a", tasks=200 // shorter, seconds=1.0, workers=2)
        print(f"efficiency of two workers, tasks of 1 s: {efficiency:.3f} (at least 0.9)")
        failures += efficiency < 0.9
        print(
            f"processor time: scheduling {1e3 * cost:.0f} ms a task; a table of 5 clusters "
            f"{work:.2f} s, without figures and page {bare:.2f} s ({100 * cost / bare:.1f} %)"
        )
        show("scheduling a table, over measuring and writing it", 100 * cost / work, 2.0, " %")
        small, large = growth(place / "b", counts=(100 // shorter, 1000 // shorter))
        show("memory of ten times as many movies, over that of the first", large / small, 1.1)
        count = 500 // shorter
        first, second, _ = resumption(place / "c", count=count)
        print(f"{count} movies of {CLUSTERS} clusters: first call {first:.1f} s beside the work")
        show(f"resumption of a finished study of {count} movies", second, 5.0, " s")
    print(f"{failures} requirements fail")
    return failures


if __name__ == "__main__":
    raise SystemExit(main())
