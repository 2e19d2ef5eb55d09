"""Stopped and broken runs end in the right result or in one clear line, and lose nothing finished.

``pytest -m faults`` (``make faults``); the moments of the stops are random, with fixed seeds.
"""

from __future__ import annotations

import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import perrin

pytestmark = [
    pytest.mark.faults,
    pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX"),
]

DRIVE = Path(__file__).with_name("drive.py")
DIAMETER, DT, FRAMES = 2.45, 0.73, 6
_PLACES = ("HOME", "XDG_CACHE_HOME", "TMPDIR")
STOPS = ["KILL", "TERM", "INT", "INT INT"]
STATUS = {"KILL": {-9}, "TERM": {143, -15}, "INT": {130, -2}, "INT INT": {130, -2}}


@pytest.fixture(scope="session")
def inputs(tmp_path_factory):
    """Write a table and a movie of one cluster; return their folder."""
    folder = tmp_path_factory.mktemp("inputs")
    rows = []
    body = perrin.Cluster.touching(4, DIAMETER)
    for k in range(1):
        motion = perrin.simulate_motion(body, D_R=5e-3, D_T=0.01, dt=DT, n_frames=40, rng=k)
        places = perrin.add_noise(motion.positions(), sigma=0.02, rng=k) + 30.0 * k
        frame, particle = np.indices(places.shape[:2])
        columns = dict(zip("xyz", places.reshape(-1, 3).T, strict=True))
        ids = {"frame": frame.ravel(), "particle": particle.ravel() + 4 * k, "cluster": k}
        rows.append(pd.DataFrame({**ids, **columns}))
    perrin.write_tracks(pd.concat(rows), folder / "tracks.csv")
    perrin.write_tracks(pd.concat(rows).query("frame < 30"), folder / "more.csv")
    lines = ['conditions = ["phi"]', "reports = false", "[defaults]", f"dt = {DT}"]
    for phi, name in enumerate(("tracks.csv", "more.csv")):
        lines += ["[[sample]]", f'files = ["{name}"]', f"phi = {phi}"]
    (folder / "study.toml").write_text("\n".join(lines), encoding="utf-8")
    motion = perrin.simulate_motion(body, D_R=5e-3, D_T=0.01, dt=DT, n_frames=FRAMES, rng=3)
    movie = perrin.render_stack(
        motion, centers=[(4.5, 4.5, 4.0)], voxel=(0.3, 0.25, 0.25), shape=(27, 36, 36),
        diameter=DIAMETER, psf=(0.4, 0.15, 0.15), photons=75, background=5, gain=3, read_noise=2,
        offset=5, rng=7,
    )  # fmt: skip
    perrin.write_stack(movie, folder / "movie.ome.tif")
    return folder


def command(inputs, name, output, *more):
    """Return the arguments of a command that writes to an output."""
    tracks, movie = inputs / "tracks.csv", inputs / "movie.ome.tif"
    sizes = ["--diameter", DIAMETER, "--contact", DIAMETER]
    # Optics and mass cut are stated: learning them takes longer than the rest.
    optics = [*sizes, "--optics", "2.45,0.4,0.15,3,10", "--minmass", 300]
    arguments = {
        "analyze": ["analyze", tracks, "--dt", DT, "-o", output],
        "run": ["run", movie, *optics, "-o", output],
        "convert": ["convert", tracks, output / "t.parquet"],
        "study": ["study", "run", inputs / "study.toml", "-o", output],
        "paper": ["paper", "-o", output],
        "demo": ["demo", "-o", output],
    }[name]
    return [str(part) for part in (*arguments, *more)]


def started(arguments, *, environment=None, **keywords):
    """Start a command, and wait until it begins its work."""
    ready = (
        Path(os.environ.get("TMPDIR", "/tmp")) / f"perrin-ready-{os.getpid()}-{time.monotonic_ns()}"
    )
    keywords = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | keywords
    variables = os.environ | {"READY": str(ready), "COLUMNS": "200"} | (environment or {})
    process = subprocess.Popen([sys.executable, DRIVE, *arguments], env=variables, **keywords)
    deadline = time.monotonic() + 60
    while not ready.exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.01)
    ready.unlink(missing_ok=True)
    return process


def ended(process, timeout=120):
    """Return status, standard output and standard error of a command."""
    out, err = process.communicate(timeout=timeout)
    text = [(part or b"").decode(errors="surrogateescape") for part in (out, err)]
    return process.returncode, *text


def finished(arguments, **keywords):
    """Run a command to its end; return status and both texts."""
    return ended(started(arguments, **keywords))


@pytest.fixture
def called(capsys, monkeypatch):
    """Give a function that runs a command in this process: status and both texts."""
    from perrin.cli.app import app

    for name in ("save_figures", "save_image_figures", "render_html", "render_imaging_quality"):
        monkeypatch.setattr(f"perrin.report.write.{name}", lambda *_, **__: "")
    for name in ("save_study_figures", "render_study"):
        monkeypatch.setattr(f"perrin.study.writing.{name}", lambda *_, **__: "")

    def call(arguments):
        with pytest.raises(SystemExit) as end:
            app(arguments)
        out, err = capsys.readouterr()
        return end.value.code or 0, out, err

    return call


@pytest.fixture(scope="session")
def whole(inputs, tmp_path_factory):
    """Return the result of each command, and how long it takes from its beginning, s."""
    results = {}
    for name in ("analyze", "run", "convert", "study"):
        folder = tmp_path_factory.mktemp("whole") / "out"
        if name == "convert":
            folder.mkdir()
        process = started(command(inputs, name, folder))
        start = time.monotonic()
        status, _, err = ended(process)
        assert status == 0, err
        results[name] = (content_of(folder), time.monotonic() - start)
    return results


def content_of(folder):
    """Return all results in a folder."""
    if (folder / "t.parquet").exists():
        return pd.read_parquet(folder / "t.parquet")
    if (folder / "study.toml").exists():
        runs = [p for name in ("summary.json", "tracks.parquet") for p in folder.rglob(name)]
        return {p.relative_to(folder): p.read_bytes() for p in [folder / "results.csv", *runs]}
    return perrin.load_run(folder)


def same(one, two):
    """Return whether two results are equal, bit by bit."""
    if isinstance(one, pd.DataFrame):
        return one.equals(two)
    if isinstance(one, dict):
        return one == two
    return one.to_dict() == two.to_dict() and one.tracks.equals(two.tracks)


def one_line(err):
    """Return whether an error is one line of perrin's, beside its progress and warnings."""
    lines = [line for line in err.splitlines() if line.startswith("perrin: ")]
    return len(lines) == 1 and "Traceback" not in err


def stopped(arguments, moment, stop, **keywords):
    """Start a command and stop it after a moment by one signal or several; return its end."""
    process = started(arguments, **keywords)
    time.sleep(moment)
    for k, name in enumerate(stop.split()):
        if k:
            time.sleep(0.02)
        process.send_signal(getattr(signal, f"SIG{name}"))
    return ended(process)


@pytest.mark.parametrize("stop", STOPS)
@pytest.mark.parametrize("name", ["analyze", "run", "convert", "study"])
def test_a_stop_at_any_moment_loses_nothing(tmp_path, inputs, whole, name, stop, request):
    """The folder is whole or absent (or holds parts), and the same command ends the work."""
    moments = random.Random(f"{name} {stop}")
    known, duration = whole[name]
    for k in range(request.config.getoption("--long") * 9 + 1):
        folder = tmp_path / f"out {k}"
        if name == "convert":
            folder.mkdir()
        arguments = command(inputs, name, folder)
        status, _, err = stopped(arguments, moments.uniform(0, duration), stop)
        assert "Traceback" not in err
        assert status in STATUS[stop] | {0}, err
        whole_or_absent = name in ("analyze", "run") and not (folder / "located").exists()
        if folder.exists() and whole_or_absent:
            assert same(content_of(folder), known)
        again, _, err = finished(arguments)
        if again:  # finished before it was stopped
            assert "exists" in err
            assert one_line(err)
        assert same(content_of(folder), known)
        left = {p.name for p in tmp_path.iterdir()} - {f"out {i}" for i in range(k + 1)}
        assert not left, "hidden files were left"
        assert not [p for p in folder.iterdir() if p.name.startswith(".")]


@pytest.mark.parametrize("stop", ["KILL", "INT"])
def test_a_stop_while_a_run_is_replaced_keeps_one_of_the_two(
    tmp_path, inputs, whole, stop, request
):
    """After any stop of --overwrite the old run or the new one is there, at the next start."""
    moments = random.Random(stop)
    known, duration = whole["analyze"]
    folder = tmp_path / "out"
    assert finished(command(inputs, "analyze", folder))[0] == 0
    for _ in range(request.config.getoption("--long") * 9 + 1):
        arguments = command(inputs, "analyze", folder, "--overwrite")
        status, _, err = stopped(arguments, moments.uniform(0.5, 1) * duration, stop)
        assert "Traceback" not in err
        assert status in STATUS[stop] | {0}
        assert finished(command(inputs, "analyze", folder))[0] == 2  # puts it back; it exists
        assert same(content_of(folder), known)


def test_the_paper_stops_in_order(tmp_path, inputs):
    """Its folder appears at the end only."""
    for stop in ("TERM", "INT"):
        status, _, err = stopped(command(inputs, "paper", tmp_path / "paper"), 1.0, stop)
        assert status in STATUS[stop]
        assert err.splitlines()[-1:] == ["Stopped: nothing is written, and what was there is kept."]
        assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "more"), [("analyze", []), ("run", []), ("run", ["--overwrite"]), ("study", [])]
)
def test_of_two_at_once_one_is_refused_in_one_line(tmp_path, inputs, whole, name, more):
    """The folder holds the result of one of them, whole."""
    folder = tmp_path / "out"
    arguments = command(inputs, name, folder, *more)
    both = [started(arguments) for _ in range(2)]
    ends = [ended(process) for process in both]
    states = sorted(status for status, _, _ in ends)
    assert states[0] == 0, ends
    for status, _, err in ends:
        if status:
            assert status == 2
            assert one_line(err)
            assert "is writing there, since 20" in err or "exists" in err
    assert same(content_of(folder), whole[name][0])
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize(
    ("name", "most"),
    [
        ("analyze", 0),
        ("analyze", 9000),
        ("run", 3000),
        ("run", 12000),
        ("convert", 100),
        ("study", 900),
    ],
)
def test_a_full_disk_is_reported_in_one_line(tmp_path, inputs, whole, called, name, most):
    """A limit on the length of files stands for it; the work is ended when there is space."""
    folder = tmp_path / "out"
    if name == "convert":
        folder.mkdir()
    arguments = command(inputs, name, folder)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, before[1]))
    try:
        status, _, err = called(arguments)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert status == 2, err
    assert one_line(err), err
    assert "File too large" in err
    assert called(arguments)[0] == 0
    assert same(content_of(folder), whole[name][0])


def test_places_that_cannot_be_written_are_refused_at_once(tmp_path, inputs, called):
    """A file in the place of the folder, a system folder, and a folder of other things."""
    (tmp_path / "file").write_text("")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "letter.txt").write_text("")
    inside = tmp_path / "file" / "a"
    for place in (tmp_path / "file", inside, Path("/proc/perrin"), tmp_path / "other"):
        for name in ("analyze", "run"):
            status, out, err = called(command(inputs, name, place))
            assert status == 2
            assert one_line(err), err
            assert not out
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "other"]


def test_a_folder_that_vanishes_is_reported(tmp_path, inputs, whole):
    """One line; the second call starts anew."""
    folder = tmp_path / "out"
    process = started(command(inputs, "run", folder))
    deadline = time.monotonic() + 60
    while not (folder / "located" / "method.json").exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    shutil.rmtree(folder, ignore_errors=True)
    status, _, err = ended(process)
    assert status in (0, 2)
    assert status == 0 or one_line(err), err
    status, _, err = finished(command(inputs, "run", folder, "--overwrite"))
    assert status == 0, err
    assert same(content_of(folder), whole["run"][0])


@pytest.mark.parametrize("change", ["cut", "gone", "written"])
def test_a_movie_that_changes_during_the_run_is_refused(tmp_path, inputs, change):
    """Frames of two files are never mixed."""
    shutil.copytree(inputs, tmp_path / "in")
    movie = tmp_path / "in" / "movie.ome.tif"
    process = started(command(tmp_path / "in", "run", tmp_path / "out"))
    deadline = time.monotonic() + 60
    while not (tmp_path / "out" / "located" / "method.json").exists() and process.poll() is None:
        assert time.monotonic() < deadline
        time.sleep(0.005)
    data = movie.read_bytes()
    if change == "gone":
        movie.unlink()
    else:
        movie.write_bytes(data[: len(data) // 2] if change == "cut" else data)
    status, _, err = ended(process)
    assert status == 2, err
    assert one_line(err), err
    assert "the file was written while it was read" in err


def test_closed_streams_and_missing_folders_do_not_matter(tmp_path, inputs, whole):
    """Standard output closed or cut, no home, no cache, no temporary folder, the C locale."""
    settings = {
        "closed": {"stdout": None, "preexec_fn": lambda: os.close(1)},
        "nowhere": {"environment": dict.fromkeys(_PLACES, "/proc/none")},
        "ascii": {"environment": {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}},
    }
    for case, keywords in settings.items():
        folder = tmp_path / case
        status, _, err = finished(command(inputs, "analyze", folder), **keywords)
        assert status == 0, (case, err)
        assert "Traceback" not in err, (case, err)
        assert same(content_of(folder), whole["analyze"][0])
    process = started(command(inputs, "run", tmp_path / "pipe"))
    process.stdout.close()
    process.stdout = None
    status, _, err = ended(process)
    assert status == 0
    assert "Traceback" not in err
    assert same(content_of(tmp_path / "pipe"), whole["run"][0])


ODD = [
    "a b", "'quoted\"", "two\nlines", "n" * 240, "\udcff\udcfe", "-x", "[/]", "ä μ \u202e", "$X;ls",
]  # fmt: skip


@pytest.mark.parametrize("odd", ODD)
def test_names_of_any_kind(tmp_path, inputs, whole, called, odd):
    """Of the table, of the folder above, and of the output; a link to it is the folder itself."""
    place = tmp_path / odd
    place.mkdir(parents=True)
    os.symlink(inputs / "tracks.csv", place / "tracks.csv")
    status, out, err = called(command(place, "analyze", place / odd))
    assert status == 0, err
    (out + err).encode()
    assert same(content_of(place / odd), whole["analyze"][0])
    first = odd.split("/", 1)[0]  # of a name with a slash the folder above
    assert sorted(p.name for p in place.iterdir()) == sorted(["tracks.csv", first])


def test_links_to_the_folder_are_the_folder(tmp_path, inputs, whole, called):
    """A link to an empty folder, and to a finished one that is replaced."""
    (tmp_path / "real").mkdir()
    os.symlink(tmp_path / "real", tmp_path / "link", target_is_directory=True)
    for more in ([], ["--overwrite"]):
        status, _, err = called(command(inputs, "run", tmp_path / "link", *more))
        assert status == 0, err
        assert same(content_of(tmp_path / "real"), whole["run"][0])
    assert sorted(p.name for p in tmp_path.iterdir()) == ["link", "real"]
