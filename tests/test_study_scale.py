"""Studies on a real Dask scheduler: lost workers, scheduler, client and disk, to the last bit."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from typing import TYPE_CHECKING

import pytest

import perrin
from perrin.study import Study

if TYPE_CHECKING:
    from pathlib import Path

pytest.importorskip("distributed")
PATIENCE = 3600  # s, on a machine that others load too
SCRIPT = "import sys; from perrin.study import Study; Study.from_toml(sys.argv[1]).run("
SCRIPT += "sys.argv[2], scheduler=sys.argv[3] if len(sys.argv) > 3 else None)"


@pytest.fixture(scope="module")
def long(request):
    if not request.config.getoption("--long"):
        pytest.skip("--long")


class Cluster:
    """A Dask scheduler and workers, each in a process of its own."""

    def __init__(self, folder: Path, workers: int) -> None:
        self._file = folder / "scheduler.json"
        self._run("scheduler", "--scheduler-file", str(self._file), "--port", "0",
                  "--host", "127.0.0.1", "--no-dashboard", "--no-jupyter")  # fmt: skip
        self.scheduler = self.processes[0]
        deadline = time.monotonic() + 60
        while not (self._file.exists() and self._file.stat().st_size):
            assert time.monotonic() < deadline
            time.sleep(0.1)
        self.address = json.loads(self._file.read_text())["address"]
        self.workers = [self.add_worker() for _ in range(workers)]

    def _run(self, *arguments: str) -> subprocess.Popen:
        environment = os.environ | {"OMP_NUM_THREADS": "1"}
        process = subprocess.Popen(
            [sys.executable, "-m", "distributed.cli.dask_" + arguments[0], *arguments[1:]],
            env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        self.__dict__.setdefault("processes", []).append(process)
        return process

    def add_worker(self) -> subprocess.Popen:
        return self._run("worker", self.address, "--nthreads", "1", "--no-nanny", "--no-dashboard")

    def close(self) -> None:
        for process in reversed(self.processes):
            if process.poll() is None:
                process.kill()
            process.wait()


@pytest.fixture
def cluster(tmp_path):
    found = Cluster(tmp_path, 3)
    yield found
    found.close()


def write_movies(folder: Path, *, count: int, frames: int) -> Path:
    """Write small rendered movies of one trimer each, and their manifest."""
    lines = ['conditions = ["phi"]', "[defaults]", "diameter = 2.0", "contact = 2.0"]
    lines.insert(0, "reports = false")
    for number in range(count):
        truth = perrin.simulate_motion(
            perrin.Cluster.touching(3, 2.0), D_R=0.01, D_T=0.02, dt=0.5, n_frames=frames, rng=number
        )
        movie = perrin.render_stack(
            truth, centers=[(4, 4, 4)], voxel=(0.4, 0.3, 0.3), shape=(20, 27, 27), diameter=2.0,
            psf=(0.4, 0.2, 0.2), photons=200, background=5, rng=number,
        )  # fmt: skip
        perrin.images.write_stack(movie, folder / f"movie{number}.ome.tif")
        lines += ["[[sample]]", f'files = ["movie{number}.ome.tif"]', f"phi = {number % 3}"]
    (folder / "study.toml").write_text("\n".join(lines))
    return folder / "study.toml"


def content(place: Path) -> dict[str, bytes]:
    """Return what a study measured: all numbers of its tables and runs, without dates."""
    found = {}
    for name in ("results.csv", "summary.json"):
        found[name] = (place / name).read_bytes()
    for path in sorted(place.glob("runs/*/*")):
        if path.name in ("summary.json", "results.csv", "tracks.parquet", "motion.parquet"):
            found[str(path.relative_to(place))] = path.read_bytes()
    return found


@pytest.fixture(scope="module")
def movies(tmp_path_factory, long):
    """Write 24 movies, and measure them in one process."""
    folder = tmp_path_factory.mktemp("movies")
    manifest = write_movies(folder, count=24, frames=8)
    Study.from_toml(manifest).run(folder / "STUDY")
    return manifest, content(folder / "STUDY")


def started(
    manifest: Path, place: Path, address: str | None, *, errors: str = "errors.txt"
) -> subprocess.Popen:
    """Start a study, whose errors go into a file beside its folder."""
    arguments = [str(manifest), str(place), *([address] if address else [])]
    with (place.parent / errors).open("w") as file:
        return subprocess.Popen(
            [sys.executable, "-c", SCRIPT, *arguments], stdout=subprocess.DEVNULL, stderr=file
        )


def wait_for(place: Path, count: int, process: subprocess.Popen) -> None:
    """Wait until a number of movies is finished."""
    deadline = time.monotonic() + PATIENCE
    while len(list(place.glob("movies/*.json"))) < count:
        assert process.poll() is None, (place.parent / "errors.txt").read_text()
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_a_lost_worker_costs_nothing_but_time(movies, cluster, tmp_path):
    manifest, expected = movies
    process = started(manifest, tmp_path / "STUDY", cluster.address)
    wait_for(tmp_path / "STUDY", 3, process)
    cluster.workers[0].send_signal(signal.SIGKILL)
    assert process.wait(PATIENCE) == 0, (tmp_path / "errors.txt").read_text()
    assert content(tmp_path / "STUDY") == expected


@pytest.mark.parametrize("victim", ["scheduler", "client"])
def test_after_a_lost_scheduler_or_client_the_next_call_ends(movies, cluster, tmp_path, victim):
    manifest, expected = movies
    place = tmp_path / "STUDY"
    process = started(manifest, place, cluster.address)
    wait_for(place, 3, process)
    (cluster.scheduler if victim == "scheduler" else process).send_signal(signal.SIGKILL)
    assert process.wait(PATIENCE) != 0
    if victim == "scheduler":
        assert "finished movies are kept" in (tmp_path / "errors.txt").read_text()
    done = {p.name: p.read_bytes() for p in place.glob("movies/*.json")}
    cluster.close()
    assert 3 <= len(done) < 24
    Study.from_toml(manifest).run(place, workers=2)
    assert content(place) == expected
    assert all((place / "movies" / name).read_bytes() == text for name, text in done.items())


def test_after_a_full_disk_the_next_call_ends(movies, tmp_path):
    """Files are limited to 3 kB, which no run folder keeps to, as on a disk that is full."""
    manifest, expected = movies
    place = tmp_path / "STUDY"
    limited = "import resource, signal; signal.signal(signal.SIGXFSZ, signal.SIG_IGN); "
    limited += "resource.setrlimit(resource.RLIMIT_FSIZE, (3000, 3000)); " + SCRIPT
    process = subprocess.run(
        [sys.executable, "-c", limited, str(manifest), str(place)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert process.returncode != 0
    assert not list(place.glob("runs/*/run.json"))
    Study.from_toml(manifest).run(place, workers=2)
    assert content(place) == expected


def test_two_commands_in_one_folder(movies, tmp_path):
    manifest, expected = movies
    place = tmp_path / "STUDY"
    first = started(manifest, place, None)
    wait_for(place, 1, first)
    second = started(manifest, place, None, errors="second.txt")
    assert second.wait(PATIENCE) != 0
    assert "is writing there" in (tmp_path / "second.txt").read_text()
    assert first.wait(PATIENCE) == 0
    assert content(place) == expected
