"""A movie of stacks gives the D of its true positions, in one piece or in many, here or elsewhere.

The movie is small: two touching tetrahedra, eight frames, written as an OME-TIFF. Figures are
drawn with --long only.
"""

from __future__ import annotations

import doctest
import hashlib
import json
import math
import multiprocessing
import os
import pickle
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import perrin
from command_line import command_line
from left_out import leave_out_tensors, leave_out_verdicts
from perrin.diffusion.noise_model import Noise
from perrin.images.optics.optics import CameraNoise
from perrin.images.spheres.by_trackpy import find_features
from perrin.images.spheres.localisation import Method
from perrin.images.spheres.spots import Spots
from perrin.movie import stages
from perrin.movie.parts import PartWriter, open_parts, read_parts
from perrin.plot.imaging import stack_frames
from perrin.run import workers
from perrin.run.experiment import Experiment
from perrin.run.folders import check_resumable, filled_folder
from perrin.run.results import motion_table
from perrin.run.workers import Work, work_through

pytest.importorskip("tifffile")
pytest.importorskip("trackpy")
pytest.importorskip("threadpoolctl")

DIAMETER, DT, FRAMES = 2.45, 0.73, 8
FEW = 3  # frames of the runs that are compared bit by bit
SEARCH = {"diameter": DIAMETER, "contact": DIAMETER}
OPTIONS = ["--diameter", "2.45", "--contact", "2.45"]
CENTERS = [(3.75, 3.75, 4.0), (8.25, 8.25, 4.0)]
VOXEL, SHAPE = (0.3, 0.25, 0.25), (26, 48, 48)
SCENE = {
    "voxel": VOXEL,
    "diameter": DIAMETER,
    "psf": (0.4, 0.15, 0.15),
    "photons": 75,
    "background": 5,
    "gain": 3,
}


@pytest.fixture(autouse=True)
def undrawn(request, monkeypatch):
    """Write no figures except with --long: they are tested with the plots."""
    if not request.config.getoption("--long"):
        for name in ("save_figures", "save_image_figures"):
            monkeypatch.setattr(f"perrin.report.write.{name}", no_figures)


@pytest.fixture(autouse=True, scope="module")
def left_out(repeats):
    """Estimate no tensors and judge no motion: other files test them."""
    with pytest.MonkeyPatch.context() as patch:
        if not repeats(0, 1):
            leave_out_tensors(patch)
            leave_out_verdicts(patch)
        yield


@pytest.fixture(autouse=True, scope="module")
def spots_found_once():
    """Find the spots of a frame with the same arguments once for all tests of this module.

    Many of them search the same movie, and trackpy takes a quarter of their time.
    """
    known = {}

    def found(frame, **asked):
        digest = hashlib.blake2b(np.ascontiguousarray(frame)).digest()
        key = digest, frame.shape, frame.dtype, repr(sorted(asked.items()))
        if key not in known:
            known[key] = find_features(frame, **asked)
            for column in known[key]:
                column.flags.writeable = False
        return known[key]

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("perrin.images.spheres.localisation.find_features", found)
        yield


def no_figures(_, folder, **__):
    """Make the folder of the figures."""
    Path(folder).mkdir(exist_ok=True)
    return []


def rendered(n_frames=FRAMES, seed=0, **changed):
    """Return a movie of two tetrahedra and the true positions (T, 8, 3)."""
    body = perrin.Cluster.touching(4, DIAMETER)
    motions = [
        perrin.simulate_motion(body, D_R=5e-3, D_T=0.01, dt=DT, n_frames=n_frames, rng=seed + k)
        for k in range(2)
    ]
    settings = SCENE | {"read_noise": 2, "offset": 5}
    movie = perrin.render_stack(
        motions,
        centers=CENTERS,
        shape=SHAPE,
        rng=seed + 7,
        **settings | changed,
    )
    places = [m.positions() + c for m, c in zip(motions, CENTERS, strict=True)]
    return movie, np.concatenate(places, axis=1)


@pytest.fixture(scope="module")
def movie_file(tmp_path_factory):
    """Write the movie; return its path and the true positions."""
    movie, places = rendered()
    path = tmp_path_factory.mktemp("movie") / "movie.ome.tif"
    perrin.write_stack(movie, path)
    return path, places


@pytest.fixture(scope="module")
def whole(movie_file):
    """Run in one piece."""
    with perrin.open_stack(movie_file[0]) as stack:
        return perrin.analyze_stack(stack, **SEARCH)


@pytest.fixture(scope="module")
def learned(whole):
    """Return the settings that a run learns from a few frames, for other runs."""
    optics = replace(whole.imaging.optics, stderr=(0.0, 0.0, 0.0))
    return SEARCH | {"optics": optics, "minmass": whole.imaging.minmass}


@pytest.fixture(scope="module")
def known(movie_file, learned):
    """Run the first frames in one piece with these settings stated."""
    with perrin.open_stack(movie_file[0]) as stack:
        return perrin.analyze_stack(stack, **learned, frames=(0, FEW))


@pytest.fixture(scope="module")
def stated(learned):
    """Return these settings as options of the command line."""
    optics = learned["optics"]
    numbers = (optics.diameter, *optics.psf, optics.noise.gain, optics.noise.floor)
    optics = ["--optics", ",".join(map(repr, numbers))]
    return [*OPTIONS, *optics, "--minmass", learned["minmass"], "--frames", f"0:{FEW}"]


def assert_identical(report, other):
    """Compare every number of two reports, bit by bit."""
    assert report.to_dict() == other.to_dict()
    pd.testing.assert_frame_equal(report.tracks, other.tracks, check_exact=True)
    for a, b in zip(report.clusters, other.clusters, strict=True):
        for name in ("rotation", "center", "covariance", "residual"):
            np.testing.assert_array_equal(getattr(a.motion, name), getattr(b.motion, name))
    for name in ("features", "frames", "spots"):
        one, two = getattr(report.imaging, name), getattr(other.imaging, name)
        pd.testing.assert_frame_equal(one, two, check_exact=True)


def run(*arguments):
    """Call the command line; return its exit status."""
    with pytest.raises(SystemExit) as stopped:
        command_line(["run", *map(str, arguments)])
    return stopped.value.code or 0


def test_the_movie_gives_what_its_true_positions_give(movie_file, whole):
    """Every cluster is found, none is false; D differs from that of the truth by 0.2 errors."""
    places = movie_file[1]
    assert len(whole.clusters) == 2
    for result in whole.clusters:
        start = result.motion.center[0]
        mine = np.linalg.norm(places[0].reshape(2, 4, 3).mean(axis=1) - start, axis=1).argmin()
        true = perrin.track_rotation(places[:, 4 * mine : 4 * mine + 4], dt=DT)
        for found, quantity in ((result.D_R, "rotation"), (result.D_T, "translation")):
            with pytest.warns(perrin.PrecisionWarning, match="7 steps"):
                expected = perrin.estimate_diffusion(true, quantity=quantity)
            assert abs(found.value - expected.value) < 0.2 * expected.stderr
        # 40 photons: 4.5 nm in x and y, 6 nm along z, and the table's constant offset apart.
        off = 1e3 * (result.motion.center - true.center)
        assert (off - off.mean(axis=0)).std(axis=0).max() < 6
        assert np.abs(off.mean(axis=0)).max() < 12


def test_the_run_describes_the_images_of_the_spheres(whole):
    """Counts, places and optics are those of the movie."""
    imaging = whole.imaging
    assert imaging.frames["spheres"].tolist() == [8] * FRAMES
    assert imaging.frames["frame"].tolist() == list(range(FRAMES))
    np.testing.assert_allclose(imaging.frames["time"], DT * np.arange(FRAMES))
    assert (imaging.features["cluster"] >= 0).all()
    assert imaging.optics.diameter == pytest.approx(DIAMETER, abs=0.02)
    assert len(imaging.spots) > 8  # noise among them
    # The distances of touching spheres state the error of the shape that all frames share.
    radius = perrin.Cluster.touching(4, DIAMETER).R
    assert 0 < imaging.distance_error < 0.003
    for cluster in whole.clusters:
        assert abs(cluster.motion.R / radius - 1) < 4 * imaging.distance_error
    assert {v.frame for v in imaging.views} <= set(range(FRAMES))
    assert imaging.views[0].xy.shape == SHAPE[1:]
    assert imaging.views[0].xz.shape == (SHAPE[0], SHAPE[2])
    assert imaging.views[0].yz.shape == SHAPE[:2]


def test_frames_and_clusters_can_be_left_out(movie_file, learned):
    """A slice of frames counts from its own first one; other clusters keep their number."""
    with perrin.open_stack(movie_file[0]) as stack:
        part = perrin.analyze_stack(stack, **learned, refine=None, frames=(2, 7), exclude=[0])
    assert [c.cluster for c in part.clusters] == [1]
    assert part.settings["first_frame"] == 2
    assert part.imaging.frames["frame"].tolist() == list(range(2, 7))
    assert part.clusters[0].motion.fitted.size == 5
    assert set(part.imaging.features["cluster"]) == {0, 1}
    with perrin.open_stack(movie_file[0]) as stack:
        with pytest.raises(ValueError, match=r"exclude: there is no cluster 7; found \[0, 1\]"):
            perrin.analyze_stack(stack, **learned, refine=None, frames=(0, 3), exclude=[7])
        with pytest.raises(ValueError, match="frames 40:50 hold none of the stack's, 0 to 7"):
            perrin.analyze_stack(stack, **SEARCH, frames=(40, 50))
        with pytest.raises(perrin.TooFewFramesError, match="one frame shows no motion"):
            perrin.analyze_stack(stack, **SEARCH, frames=(3, 4))


def test_a_run_folder_is_whole_and_reads_back(tmp_path, movie_file, known, stated, capsys):
    """The command line writes what the function returns; a finished run is not overwritten."""
    assert run(movie_file[0], *stated, "-o", tmp_path / "run") == 0
    assert "Traceback" not in capsys.readouterr().err
    again = perrin.load_run(tmp_path / "run")
    assert_identical(again, known)
    names = {p.name for p in (tmp_path / "run").iterdir()}
    wanted = {"summary.json", "results.csv", "tracks.parquet", "motion.parquet", "curves.csv"}
    assert wanted | {"figures", "report.html", "run.json", "features.parquet"} <= names
    assert not [n for n in names if n.startswith(".")]
    motion = pd.read_parquet(tmp_path / "run" / "motion.parquet")
    assert motion["frame"].tolist() == 2 * list(range(FEW))
    settings = json.loads((tmp_path / "run" / "run.json").read_text())
    assert settings["arguments"]["diameter"] == DIAMETER
    assert len(settings["input"]["sha256"]) == 64

    assert run(movie_file[0], *OPTIONS, "-o", tmp_path / "run") == 2
    error = capsys.readouterr().err
    assert "exists" in error
    assert error.count("\n") == 1


@pytest.fixture
def counted(monkeypatch):
    """Record the numbers of the frames in which spheres are located."""
    numbers = []
    locate_in = Method.locate_in
    monkeypatch.setattr(
        Method, "locate_in", lambda m, s, i: (numbers.append(i), locate_in(m, s, i))[1]
    )
    return numbers


class KilledAtSecondPart(PartWriter):
    """Write parts of one frame, and kill the process after the second."""

    parts = 0

    def flush(self):
        super().flush()
        self.parts += 1
        if self.parts == 2:
            os.kill(os.getpid(), signal.SIGKILL)


def run_and_be_killed(path, settings, folder):
    """Run in another process until it is killed."""
    stages.PartWriter = lambda folder: KilledAtSecondPart(folder, seconds=0.0)
    with perrin.open_stack(path) as stack:
        perrin.analyze_stack(stack, **settings, frames=(0, FEW), keep=folder)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork and kill")
def test_a_killed_run_resumes_and_gives_the_same(tmp_path, movie_file, known, learned, counted):
    """After kill -9 only unfinished frames are done again; every bit is the same."""
    folder = tmp_path / "run"
    arguments = (movie_file[0], learned, folder)
    process = multiprocessing.get_context("fork").Process(target=run_and_be_killed, args=arguments)
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGKILL
    finished = {int(e["frame"]) for e in read_parts(folder / "located")[1]}
    assert len(finished) == 2
    with perrin.open_stack(movie_file[0]) as stack:
        report = perrin.analyze_stack(stack, **learned, frames=(0, FEW), keep=folder)
    assert sorted(counted) == sorted(set(range(FEW)) - finished)
    assert_identical(report, known)


def test_a_full_disk_is_reported_and_the_run_resumes(
    tmp_path, movie_file, known, learned, stated, monkeypatch, capsys
):
    """Parts written before remain; one line names the remedy; the second call ends the work."""
    monkeypatch.setattr(stages, "PartWriter", lambda folder: PartWriter(folder, seconds=0.0))
    sync, written = os.fsync, []

    def full(handle):
        written.append(handle)
        if len(written) > 7:
            raise OSError(28, "No space left on device", "somewhere")
        sync(handle)

    folder = tmp_path / "run"
    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", full)
        assert run(movie_file[0], *stated, "-o", folder) == 2
    error = capsys.readouterr().err
    assert "No space left on device" in error
    assert "the same command resumes" in error
    kept = len(list((folder / "located").glob("part-*")))
    assert 0 < kept < FEW
    assert not list((folder / "located").glob(".*"))
    with perrin.open_stack(movie_file[0]) as stack:
        report = perrin.analyze_stack(stack, **learned, frames=(0, FEW), keep=folder)
    assert_identical(report, known)


def test_options_objects_are_the_same_as_keywords(movie_file):
    """Every field in its object, and as a keyword: the same report, and the same refusals."""
    keywords = {
        "percentile": 94.0, "minmass": 50.0, "border": False, "noise": "residual", "exposure": 0.1,
        "drift": True, "keep_jumps": True, "viscosity": 1e-3, "temperature": 295.0,
    }  # fmt: skip
    asked = SEARCH | {"refine": None}
    seen = []
    objects = {
        "spots": Spots(percentile=94.0, minmass=50.0, border=False),
        "experiment": Experiment(
            noise=Noise("residual", exposure=0.1, drift=True),
            keep_jumps=True,
            viscosity=1e-3,
            temperature=295.0,
        ),
        "work": Work(progress=lambda *state: seen.append(state)),
    }
    with perrin.open_stack(movie_file[0]) as whole:
        stack = copied(whole, range(3))
        report = perrin.analyze_stack(stack, **asked, **keywords)
        assert_identical(perrin.analyze_stack(stack, **asked, **objects), report)
        assert report.settings["arguments"]["drift"] is True
        assert (3, 3, "locating spheres") in seen
        assert list(dict.fromkeys(title for *_, title in seen))[:8] == [
            "taking the file's SHA-256", "learning mass cut and optics", "locating spheres",
            "linking the spheres", "identifying the particles", "finding the clusters",
            "fitting clusters", "estimating D_R and D_T",
        ]  # fmt: skip
        for name, value in (keywords | {"workers": 0, "keep": None}).items():
            with pytest.raises(ValueError, match=rf"^{name}: stated .*; state it once"):
                perrin.analyze_stack(stack, **asked, **objects, **{name: value})
        wrong = Experiment(dt=9.0, sigma=0.1, diameter=1.0, viscosity=1e-3, temperature=295.0)
        with pytest.raises(ValueError, match=r"dt is that of .*; .*sigma.*; .*the diameter is"):
            perrin.analyze_stack(stack, **asked, experiment=wrong)
        with pytest.raises(
            TypeError, match="keyword 'exposur'; the nearest known one is 'exposure'"
        ):
            perrin.analyze_stack(stack, **asked, exposur=0.1)


def test_work_is_checked_when_it_is_made():
    """All faults in one message."""
    with pytest.raises(ValueError, match=r"workers: expected a whole number >= 0.*; scheduler: ex"):
        Work(workers=-1, scheduler="node")
    with pytest.raises(ValueError, match="workers: expected processes of this machine"):
        Work(workers=2, scheduler="tcp://node7:8786")


def test_parts_of_other_settings_or_input_are_refused(tmp_path, movie_file, learned):
    """They are named; nothing is mixed; overwriting starts anew."""
    with perrin.open_stack(movie_file[0]) as whole:
        stack = copied(whole, range(3))
    short = {"refine": None, "minmass": learned["minmass"], "keep": tmp_path / "run"}
    perrin.analyze_stack(stack, **SEARCH, **short)
    with pytest.raises(ValueError, match=r"percentile 95.0 there, 90.0 now; choose another"):
        perrin.analyze_stack(stack, **SEARCH, **short, percentile=90.0)
    anew = perrin.analyze_stack(stack, **SEARCH, **short, percentile=90.0, anew=True)
    assert anew.settings["arguments"]["percentile"] == 90.0
    mirrored = np.stack([frame[:, ::-1] for frame in stack])
    other = perrin.open_stack(mirrored, voxel=VOXEL, dt=DT)
    with pytest.raises(ValueError, match=r"another run: sha256 '.*' there, '.*' now"):
        perrin.analyze_stack(other, **SEARCH, **short, percentile=90.0)


def test_parts_of_another_channel_are_refused_those_of_a_moved_file_taken(
    tmp_path, counted, learned
):
    """The file is the same to the last bit, what is seen of it is not; its name does not matter."""
    import tifffile

    movie, _ = rendered(n_frames=3)
    both = np.stack([np.stack([f, f[:, ::-1]], axis=1)[..., :32, :32] for f in movie])
    path = tmp_path / "two.ome.tif"
    tifffile.imwrite(path, both, ome=True, metadata={"axes": "TZCYX"})
    opened = {"voxel": VOXEL, "dt": DT}
    asked = SEARCH | {"refine": None, "minmass": learned["minmass"], "keep": tmp_path / "run"}
    with perrin.open_stack(path, channel=0, **opened) as stack:
        first = perrin.analyze_stack(stack, **asked)
    with (
        perrin.open_stack(path, channel=1, **opened) as stack,
        pytest.raises(ValueError, match="channel 0 there, 1 now"),
    ):
        perrin.analyze_stack(stack, **asked)
    moved = path.rename(tmp_path / "elsewhere.ome.tif")
    counted.clear()
    with perrin.open_stack(moved, channel=0, **opened) as stack:
        assert_identical(perrin.analyze_stack(stack, **asked), first)
    assert counted == []


def test_all_faults_are_in_one_message_before_any_work(movie_file, counted):
    """Arguments are checked together, before the first frame is read."""
    wrong = {"size": 1, "noise": "loud", "exposure": 2.0, "viscosity": -1.0, "percentile": 100.0}
    with perrin.open_stack(movie_file[0]) as stack, pytest.raises(ValueError, match=r".") as caught:
        perrin.analyze_stack(stack, **SEARCH, **wrong, workers=2, scheduler="tcp://127.0.0.1:9")
    for name in (*wrong, "workers"):
        assert f"{name}: expected" in str(caught.value)
    assert counted == []


def test_uneven_times_are_those_of_the_stack(tmp_path, movie_file, learned):
    """A microscope that waits now and then: every step has its own duration."""
    with perrin.open_stack(movie_file[0]) as whole:
        stack = copied(whole, range(FRAMES))
    times = stack.times + np.array([0, 0, 0, 5, 5, 9, 9, 9]) * DT + 100.0
    uneven = replace(stack, times=times)
    report = perrin.analyze_stack(uneven, **learned, refine=None, frames=(1, None))
    for result in report.clusters:
        np.testing.assert_allclose(result.motion.time, times[1:] - times[1], rtol=1e-12)
    table = motion_table(report)
    assert table["frame"].tolist() == list(range(FRAMES - 1))
    assert any("run from 0.73 to 4.38 s: these times are" in text for text in report.notes)
    # Pairs are at the times between the seven frames.
    apart = np.unique(np.round(np.subtract.outer(times[1:], times[1:]) / DT)).astype(int)
    curve = report.clusters[0].msd
    np.testing.assert_allclose(curve.lagtime[curve.n_pairs > 0], DT * apart[apart > 0])
    perrin.write_run(report, tmp_path / "run")
    assert perrin.load_run(tmp_path / "run").to_dict() == report.to_dict()
    np.testing.assert_array_equal(stack_frames(report, report.clusters[0].motion), range(1, 8))


def copied(stack, frames):
    """Return a movie in memory: some frames of another, with one of its clusters."""
    movie = np.stack([stack.frame(i)[:, :32, :32] for i in frames])
    return perrin.open_stack(movie, voxel=stack.voxel, dt=DT)


def test_one_image_written_many_times_shows_no_motion(movie_file, learned, counted):
    """Before any sphere is looked for; where one voxel of one frame differs it is a movie."""
    with perrin.open_stack(movie_file[0]) as stack:
        still = copied(stack, [2] * 7)
        with pytest.raises(perrin.TooFewFramesError, match="all 7 frames are exactly the same ima"):
            perrin.analyze_stack(still, **learned)
        assert counted == []
        moving = copied(stack, [2] * 6 + [3])
        with pytest.raises(perrin.TooFewFramesError, match=r"5 of 7 frames repeat .* 2 different"):
            perrin.analyze_stack(moving, **learned)


def test_frames_that_repeat_another_are_missing_frames(movie_file, learned):
    """D is that of the movie without them: a copy is no measurement of a body at rest."""
    order = [0, 1, 1, 2, 3, 3, 0, 4]
    with perrin.open_stack(movie_file[0]) as stack:
        copies = perrin.analyze_stack(copied(stack, order), **learned, refine=None)
        whole = copied(stack, [0, 1, 5, 2])
        apart = perrin.analyze_stack(whole, **learned, refine=None)
    (message,) = [text for text in copies.warnings if "repeat" in text]
    assert message == (
        "3 of 8 frames repeat an earlier frame exactly, voxel by voxel (first: frame 2, as frame "
        "1): they are no measurements and are treated as missing: frames 2, 5 to 6"
    )
    assert not [text for text in apart.warnings if "repeat" in text]
    assert copies.imaging.frames["copy_of"].tolist() == [-1, -1, 1, -1, -1, 4, 0, -1]
    assert sorted(set(copies.imaging.features["frame"])) == [0, 1, 3, 4, 7]
    for result in copies.clusters:
        assert result.motion.fitted.tolist() == [0, 1, 3, 4, 7]


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"diameter": 2450.0, "contact": 2450.0}, "diameter 2450 um does not fit into the stack"),
        ({"diameter": 10.0, "contact": 10.0}, "diameter 10 um does not fit into the stack: the st"),
        ({"contact": 2450.0}, "contact 2450 um is longer than the stack's diagonal"),
        ({"diameter": 1e-3}, "diameter 0.001 um is less than half a voxel"),
        (
            {"optics": perrin.Optics(2450.0, (0.4, 0.15), CameraNoise(3.0, 4.0))},
            "optics: diameter 2450 um does not fit into the stack",
        ),
    ],
)
@pytest.mark.parametrize("find", [perrin.analyze_stack, perrin.locate])
def test_lengths_in_another_unit_are_refused(movie_file, counted, find, changed, message):
    """In one message with the stack's extent, before anything is read or allocated."""
    with (
        perrin.open_stack(movie_file[0]) as stack,
        pytest.raises(ValueError, match=message) as failed,
    ):
        find(stack, **SEARCH | changed)
    sizes = "the stack is 7.8 x 12 x 12 um (z, y, x), its voxels are 0.3 x 0.25 x 0.25 um"
    assert sizes in str(failed.value)
    assert counted == []


def test_a_movie_without_a_fault_has_no_warning_of_its_images(whole):
    """A run of images adds to that of its tracks no warnings, only notes."""
    words = ("mass", "saturated", "bright", "depth", "refined", "pair", "missing", "scan", "step ")
    found = [text for text in whole.warnings if any(word in text for word in words)]
    assert found == []


def test_clusters_of_all_sizes_are_measured_each_kind_by_itself():
    """A trimer and a bipyramid have templates and pooled values of their own; size= selects."""
    bodies = [perrin.Cluster.touching(3, DIAMETER), perrin.Cluster.touching(5, DIAMETER)]
    truth = [
        perrin.simulate_motion(b, D_R=5e-3, D_T=0.01, dt=DT, n_frames=3, rng=k)
        for k, b in enumerate(bodies)
    ]
    movie = perrin.render_stack(
        truth,
        centers=CENTERS,
        shape=(30, 54, 54),
        rng=1,
        **SCENE,
    )
    frames = np.stack(list(movie))
    movie = perrin.open_stack(frames, voxel=VOXEL, dt=DT)
    by_default = perrin.analyze_stack(movie, **SEARCH, refine=None)
    assert [len(c.motion.template) for c in by_default.clusters] == [3, 5]
    assert [(kind.size, kind.clusters) for kind in by_default.kinds] == [(3, (1,)), (5, (0,))]
    assert by_default.pooled is None
    report = perrin.analyze_stack(movie, **SEARCH, refine=None, size=3)
    (only,) = report.clusters
    assert len(only.motion.template) == 3
    assert np.linalg.norm(only.motion.center[0] - CENTERS[0]) < 0.5
    assert report.pooled is not None
    assert "clusters of other sizes are left out: 1 of 5" in " ".join(report.notes)
    message = " ".join(report.warnings)
    assert "two clusters within" not in message
    assert "refused" not in message
    with pytest.raises(perrin.DegenerateClusterError, match="no cluster of 4 spheres; found: 1 of"):
        perrin.analyze_stack(movie, **SEARCH, refine=None, size=4)


def test_voxels_without_a_number_make_a_frame_unreadable(movie_file, learned):
    """A NaN is neither bright nor dark; the frame is a gap and a warning gives the reason."""
    with perrin.open_stack(movie_file[0]) as stack:
        frames = np.stack(list(copied(stack, range(5)))).astype(np.float32)
    frames[3, 2, 5, 7] = np.nan
    movie = perrin.open_stack(frames, voxel=VOXEL, dt=DT)
    report = perrin.analyze_stack(movie, **learned, refine=None)
    assert report.clusters[0].motion.fitted.tolist() == [0, 1, 2, 4]
    assert any("frame 3 has 1 voxels without a number" in text for text in report.warnings)


def test_a_movie_of_pairs_gives_rods(learned):
    """Pairs have a direction and no pose to fit; the run still answers."""
    body = perrin.Cluster.touching(2, DIAMETER)
    truth = perrin.simulate_motion(body, D_R=0.02, D_T=0.02, dt=DT, n_frames=FEW, rng=3)
    movie = perrin.render_stack(
        truth,
        centers=[CENTERS[0]],
        shape=(27, 32, 32),
        rng=1,
        **SCENE,
    )
    report = perrin.analyze_stack(movie, **SEARCH, optics=learned["optics"])
    assert report.clusters == ()
    (rod,) = report.rods
    off = rod.motion.center - truth.center - CENTERS[0]
    assert np.abs(off - off.mean(axis=0)).max() < 0.02  # 4 nm a sphere


def test_a_movie_in_the_plane_is_measured(tmp_path):
    """Triangles of bright discs are measured with the image of a sphere that the movie shows."""
    body = perrin.Cluster([[0.0, 0.0], [1.2, 0.0], [0.3, 1.1]])
    truth = perrin.simulate_motion(body, D_R=0.01, D_T=0.005, dt=1.0, n_frames=7, rng=4)
    places = truth.positions() + 3.6
    grid = 0.1 * np.arange(72)
    near = [np.exp(-0.5 * ((grid - places[..., k, None]) / 0.15) ** 2) for k in (1, 0)]
    light = np.einsum("tny,tnx->tyx", *near) * 150 + 10
    movie = np.random.default_rng(1).poisson(light).astype(np.uint16)
    stack = perrin.open_stack(movie, voxel=(0.1, 0.1), dt=1.0)
    report = perrin.analyze_stack(stack, diameter=0.6, contact=1.15)
    (result,) = report.clusters
    assert result.motion.template.shape == (3, 2)
    turned = result.motion.rotation @ np.swapaxes(result.motion.rotation[:1], 1, 2)
    true = truth.rotation @ np.swapaxes(truth.rotation[:1], 1, 2)
    angle = [np.arctan2(r[:, 1, 0], r[:, 0, 0]) for r in (turned, true)]
    assert np.abs(angle[0] - angle[1]).max() < 0.03  # 10 nm on 0.7 um
    assert report.imaging.radial is not None
    perrin.write_run(report, tmp_path / "run")
    assert_identical(perrin.load_run(tmp_path / "run"), report)
    assert (tmp_path / "run" / "quality.html").is_file()


def test_a_damaged_part_is_computed_again(tmp_path):
    """A truncated part counts as missing, and is removed."""
    open_parts(tmp_path, {"a": 1})
    with PartWriter(tmp_path, seconds=0.0) as writer:
        for k in range(3):
            writer.add(pd.DataFrame({"frame": [k], "x": [k / 3]}), {"frame": k})
    victim = sorted(tmp_path.glob("part-*"))[1]
    victim.write_bytes(victim.read_bytes()[:100])
    table, entries, damaged = read_parts(tmp_path)
    assert table["frame"].tolist() == [0, 2]
    assert [e["frame"] for e in entries] == [0, 2]
    assert damaged == [victim.name]
    assert not victim.exists()


def test_a_frame_that_cannot_be_read_is_reported_and_skipped(tmp_path, movie_file, learned):
    """A file of a sequence that was cut short loses its frame only, which is a gap."""
    import tifffile

    with perrin.open_stack(movie_file[0]) as stack:
        for i, frame in enumerate(copied(stack, range(5))):
            tifffile.imwrite(tmp_path / f"t{i}.tif", frame)
    victim = tmp_path / "t3.tif"
    victim.write_bytes(victim.read_bytes()[:20_000])
    asked = SEARCH | {"refine": None, "minmass": learned["minmass"]}
    with perrin.open_stack(tmp_path, voxel=VOXEL, dt=DT) as stack:
        report = perrin.analyze_stack(stack, **asked)
        table = report.imaging.frames
        assert table.loc[table["fault"] != "", "frame"].tolist() == [3]
        for result in report.clusters:
            assert result.motion.fitted.tolist() == [0, 1, 2, 4]
        message = [text for text in report.warnings if "1 of 5 frames cannot be read" in text]
        assert "frame 3" in message[0]
        assert "t3.tif" in message[0]
        with pytest.warns(perrin.PrecisionWarning, match="1 of 2 frames are left out: .*t3"):
            found = perrin.locate(stack, **asked, frames=[3, 4])
    assert sorted(found["frame"].unique()) == [4]


def test_many_workers_give_what_one_gives(movie_file, request):
    """Two processes of this machine: every bit is the same. With --long only."""
    pytest.importorskip("distributed")
    if not request.config.getoption("--long"):
        pytest.skip("starts two processes, with --long only")
    conventional = SEARCH | {"refine": None, "frames": (0, 5)}
    with perrin.open_stack(movie_file[0]) as stack:
        alone = perrin.analyze_stack(stack, **conventional)
        assert_identical(perrin.analyze_stack(stack, **conventional, workers=2), alone)


@pytest.fixture
def cluster(tmp_path, request):
    """Start a Dask scheduler and two workers; give address and workers. With --long only."""
    pytest.importorskip("distributed")
    if not request.config.getoption("--long"):
        pytest.skip("starts three processes, with --long only")
    file = tmp_path / "scheduler.json"
    logs = open(tmp_path / "log", "w")  # noqa: SIM115 (closed below)
    flags = {"stdout": logs, "stderr": logs}
    local = ["--host", "127.0.0.1"]
    start = [sys.executable, "-m", "distributed.cli.dask_scheduler", *local, "--port", "0"]
    processes = [subprocess.Popen([*start, "--scheduler-file", file, "--no-dashboard"], **flags)]
    while not file.exists():
        assert processes[0].poll() is None, (tmp_path / "log").read_text()
        time.sleep(0.05)
    address = json.loads(file.read_text())["address"]
    worker = [sys.executable, "-m", "distributed.cli.dask_worker", address, "--no-nanny"]
    worker += ["--nthreads", "1", "--no-dashboard", "--local-directory", str(tmp_path), *local]
    processes += [subprocess.Popen(worker, **flags) for _ in range(2)]
    yield address, processes[1:]
    for process in processes[::-1]:
        process.kill()
        process.wait()
    logs.close()


def test_the_workers_of_a_scheduler_do_the_work():
    """A scheduler in this process with one worker: all results, from a few items at once."""
    distributed = pytest.importorskip("distributed")
    numbers = np.arange(11.0).tolist()
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address="127.0.0.1:0"
    ) as cluster:
        done = list(work_through(math.exp, numbers, scheduler=cluster.scheduler_address))
    assert sorted(done) == list(map(math.exp, numbers))


def test_a_dask_cluster_that_loses_a_worker_gives_the_same(movie_file, known, learned, cluster):
    """One of two workers is killed after the first result; every bit is that of the serial run."""
    address, workers = cluster
    victim = workers[0]

    def kill_at_first_result(done, total, title):
        if title == "locating spheres" and 0 < done < total and victim.poll() is None:
            victim.send_signal(signal.SIGKILL)
            victim.wait()

    with perrin.open_stack(movie_file[0]) as stack:
        report = perrin.analyze_stack(
            stack, **learned, frames=(0, FEW), scheduler=address, progress=kill_at_first_result
        )
    assert victim.wait() == -signal.SIGKILL
    assert_identical(report, known)


def test_the_page_is_right(request):
    """Every option in docs/run.md exists; with --long its example prints the same."""
    from click.testing import CliRunner

    page = Path(__file__).resolve().parents[1] / "docs" / "run.md"
    if request.config.getoption("--long"):
        result = doctest.testfile(str(page), module_relative=False)
        assert result.attempted > 0
        assert result.failed == 0
    wide = {"COLUMNS": "200", "TERMINAL_WIDTH": "200"}
    offered = CliRunner().invoke(command_line, ["run", "--help"], env=wide).output
    named = set(re.findall(r"(?<![\w-])--[a-z][a-z-]+", page.read_text())) - {"--help"}
    assert len(named) > 12
    assert [option for option in sorted(named) if option not in offered] == []


@pytest.mark.parametrize(
    ("options", "status", "message"),
    [
        ([], 2, "no voxel size along z, y, x: pass --voxel z,y,x in um; no times of its"),
        (["--voxel", "0.25,0.2,0.2"], 2, "no times of its 3 frames: pass --dt in s"),
        (["--voxel", "0.25,0.2,0.2", "--dt", "0.7", "--optics", "2.45"], 2, "--optics: expected"),
        (["--voxel", "0.25,0.2,0.2", "--dt", "0.7"], 1, "no spheres to learn the optics from"),
        (["--voxel", "0.25,0.2,0.2", "--dt", "0.7", "--refine", "best"], 2, "--refine: expected"),
        (
            ["--voxel", "0.25,0.2,0.2", "--dt", "0.7", "--exclude", "a"],
            2,
            "--exclude: expected num",
        ),
        (["--voxel", "0.25,0.2,0.2", "--dt", "0.7", "--refine", "none"], 1, "no particles"),
    ],
)
def test_a_movie_without_spheres_or_scale_is_refused_in_one_line(
    tmp_path, capsys, options, status, message
):
    """A bare TIFF without a sphere: the message names what is missing or wrong."""
    import tifffile

    path = tmp_path / "bare.tif"
    tifffile.imwrite(path, np.full((3, 16, 32, 32), 7, dtype=np.uint8), metadata={"axes": "TZYX"})
    with pytest.raises(SystemExit) as stopped:
        command_line(["run", str(path), *OPTIONS, "-o", str(tmp_path / "run"), *options])
    error = capsys.readouterr().err
    assert stopped.value.code == status
    assert f"perrin: {path}: {message}" in error or f"perrin: {message}" in error
    assert "Traceback" not in error
    assert "the same command resumes" not in error


def test_missing_workers_are_reported(tmp_path, monkeypatch, movie_file):
    """Without dask the command to install it; without a scheduler, its address."""
    monkeypatch.setitem(sys.modules, "distributed", None)
    with perrin.open_stack(movie_file[0]) as stack:
        with pytest.raises(ModuleNotFoundError, match=r"pip install 'perrin\[cluster\]'"):
            perrin.analyze_stack(stack, **SEARCH, workers=2, keep=tmp_path / "run")
        assert not (tmp_path / "run").exists()
        monkeypatch.undo()
        pytest.importorskip("distributed")
        monkeypatch.setattr(workers, "_TIMEOUT", 0.3)
        elsewhere = SEARCH | {"refine": None, "keep": tmp_path / "run"}
        with pytest.raises(OSError, match=r"tcp://127.0.0.1:9"):
            perrin.analyze_stack(stack, **elsewhere, scheduler="tcp://127.0.0.1:9")
        with pytest.raises(ValueError, match="expected an address like tcp://node7:8786, got 'no'"):
            perrin.analyze_stack(stack, **elsewhere, scheduler="no")
        assert not (tmp_path / "run").exists()


def test_a_file_that_a_worker_cannot_open_is_an_error(tmp_path, movie_file):
    """Where the whole file is missing every frame would count as damaged."""
    path = tmp_path / "movie.ome.tif"
    path.write_bytes(movie_file[0].read_bytes())
    with perrin.open_stack(path) as stack:
        sent = pickle.dumps(stack)
    path.unlink()
    with pytest.raises(OSError, match=r"movie.ome.tif cannot be opened here") as failed:
        pickle.loads(sent).frame(0)
    assert not isinstance(failed.value, perrin.FrameError)


def test_steps_over_half_a_contact_are_refused(learned):
    """A cluster that moves to and fro by 0.6 contact distances: labels cannot be assigned."""
    body = perrin.Cluster.touching(4, DIAMETER).positions
    leap = np.where(np.arange(4) % 2, 0.3, -0.3)[:, None] * [DIAMETER, 0.0, 0.0]
    wild = perrin.render_stack(
        body + leap[:, None] + [5.0, 4.0, 4.0],
        shape=(27, 32, 40),
        dt=DT,
        rng=1,
        **SCENE,
    )
    with pytest.raises(perrin.IdentityError, match=r"1.47 um is over half of the contact distance"):
        perrin.analyze_stack(wild, **learned)


def test_a_folder_is_finished_when_run_json_is_there(tmp_path):
    """Writing that fails leaves parts and no run.json; what a killed one left goes away."""
    (tmp_path / "located").mkdir()
    (tmp_path / ".99999.part").mkdir()
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures" / "old.png").write_text("old")

    def write(text, fault=None):
        with filled_folder(tmp_path) as stage:
            (stage / "figures").mkdir()
            for name in ("run.json", "summary.json", "figures/new.png"):
                (stage / name).write_text(text)
            if fault is not None:
                raise fault

    with pytest.raises(OSError, match="full"):
        write("first", OSError("full"))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["figures", "located"]
    check_resumable(tmp_path, parts="located")
    write("second")
    names = sorted(p.name for p in tmp_path.iterdir())
    assert names == ["figures", "located", "run.json", "summary.json"]
    assert [p.name for p in (tmp_path / "figures").iterdir()] == ["new.png"]
    with pytest.raises(FileExistsError):
        check_resumable(tmp_path, parts="located")
    check_resumable(tmp_path, parts="located", overwrite=True)
