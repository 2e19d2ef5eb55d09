"""What a run folder holds repeats the run: run.toml, the command, the Python lines."""

from __future__ import annotations

import inspect
import json
import shlex
from contextlib import nullcontext
from dataclasses import asdict, replace

import numpy as np
import pandas as pd
import pytest

import perrin
from perrin.cli import app as commands
from perrin.cli.options import read_optics
from perrin.images.optics.ball_image import PsfTail
from perrin.images.optics.optics import CameraNoise, Optics
from perrin.run import repetition
from test_cli import run

pytestmark = pytest.mark.usefixtures("no_pictures")


def table(**more: object) -> pd.DataFrame:
    """Return a tetrahedron, its centre moving, in frames from 5 on, with times that are uneven."""
    rng = np.random.default_rng(4)
    body = perrin.Cluster.touching(4, 2.45)
    truth = perrin.simulate_motion(body, D_R=0.02, D_T=0.04, dt=0.5, n_frames=24, rng=rng)
    found = perrin.positions_table(perrin.add_noise(truth.positions(), sigma=0.03, rng=rng))
    pause = np.where(found["frame"] >= 12, 4.0, 0.0)
    found["time"] = 0.5 * found["frame"] + pause
    return found.assign(frame=found["frame"] + 5, **more)


@pytest.fixture(scope="module")
def report() -> perrin.Report:
    return perrin.analyze(
        table(), dt=0.5, frames=(8, 26), noise="residual", sigma=(0.03, 0.03, 0.04), drift=True,
        scale=0.9, viscosity=1e-3, temperature=295.0, diameter=2.2,
    )  # fmt: skip


# Arguments of analyze on which results do not depend, and the object that states others.
HOW = ("experiment", "progress", "workers", "scheduler")


def test_defaults_are_those_of_analyze_and_of_the_commands():
    """An argument that differs from its default is stated in run.toml: none is forgotten."""
    known = inspect.signature(perrin.analyze).parameters
    defaults = {n: p.default for n, p in known.items() if p.default is not inspect.Parameter.empty}
    assert {n: defaults[n] for n in defaults if n not in HOW} == repetition.TABLE_DEFAULTS
    for command, names in (
        (commands.analyze, set(repetition.TABLE_DEFAULTS)),
        (commands.run, {*repetition.MOVIE_DEFAULTS, *repetition.OPENING}),
    ):
        options = set(inspect.signature(command).parameters)
        ours = {"tracks", "stack", "output", "config", "as_json", "quiet", "overwrite"}
        assert options - ours - {"workers", "scheduler", "psf", "bead_diameter"} == names


def test_a_table_in_memory_is_repeated_from_the_folder(report, tmp_path):
    """A folder that Python saved repeats its numbers from its own tracks, wherever it lies."""
    report.save(tmp_path / "saved")
    (tmp_path / "saved").rename(tmp_path / "moved")
    text = (tmp_path / "moved" / "run.toml").read_text()
    assert text.splitlines()[:3] == ['command = "analyze"', 'tracks = "tracks.parquet"', "dt = 0.5"]
    options = ("analyze", "--config", "moved/run.toml", "--json", "-o", "again")
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("perrin.report.write.save_figures", lambda *_, **__: [])
        result = run(*options, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    again, first = json.loads(result.stdout), report.to_dict()
    for one, other in zip(again["clusters"], first["clusters"], strict=True):
        for name in ("D_R", "D_T", "sigma", "phi2", "tensor", "sizes", "prediction", "motion"):
            # The texts of a motion name the table's own frames.
            assert str(one[name]) == str(other[name]) or name == "motion"


@pytest.mark.usefixtures("no_tensors")
@pytest.mark.usefixtures("no_tensors", "no_verdicts")
def test_text_labels_of_clusters_are_those_of_the_repeated_run(tmp_path, monkeypatch):
    """The tracks of a folder keep the labels by number, and a part of them as well."""
    monkeypatch.setattr("perrin.report.write.save_figures", lambda *_, **__: [])
    # Fewer than 20 steps are not judged; the first ten have equal times.
    apart = [table(cluster=name)[:44] for name in ("knee", "b 2", "foot")]
    for k, one in enumerate(apart):
        one[["particle", "x"]] += [10 * k, 20.0 * k]
    first = perrin.analyze(pd.concat(apart, ignore_index=True), dt=0.5)
    first.save(tmp_path / "run")
    again = perrin.analyze(tmp_path / "run" / "tracks.parquet", dt=0.5)
    assert {c.cluster: c.label for c in again.clusters} == {0: "b 2", 1: "foot", 2: "knee"}
    assert [c.D_R.value for c in again.clusters] == [c.D_R.value for c in first.clusters]
    loaded = perrin.load_run(tmp_path / "run")
    some = perrin.analyze(loaded.tracks.query("cluster != 1"), dt=0.5)
    assert [c.name for c in some.clusters] == ["b 2", "knee"]


def test_saving_and_writing_give_the_same_data(report, tmp_path, monkeypatch):
    """`Report.save` and `write_run` write the same bytes; the latter adds page and figures."""
    monkeypatch.setattr("perrin.report.write.save_figures", lambda *_, **__: [])
    report.save(tmp_path / "a")
    perrin.write_run(report, tmp_path / "b")
    names = {path.name for path in (tmp_path / "a").iterdir()}
    assert names == {
        "summary.json", "results.csv", "curves.csv", "run.json", "run.toml", "tracks.parquet",
        "motion.parquet", "checksums.json",
    }  # fmt: skip
    for name in names - {"checksums.json"}:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    assert {path.name for path in (tmp_path / "b").iterdir()} - names == {"report.html", "figures"}
    assert perrin.load_run(tmp_path / "a") == report


OPTICS = Optics(2.45, (0.5, 0.2), CameraNoise(3.0, 1.5), tail=PsfTail(0.1, (1.0, 0.6)), spread=0.05)

MOVIE = {
    "dt": 0.73, "sigma": None, "viscosity": 2e-3, "temperature": 295.0, "diameter": 2.4,
    "noise": 0.03, "exposure": 0.5, "drift": True, "keep_jumps": False, "model": "confined",
    "channel": [0, 2], "planes": 20, "image": "second, series", "shape": [40, 20, 64, 64],
    "voxel": [0.3, 0.1, 0.1], "first_frame": 0, "last_frame": 29, "contact": 2.5, "dark": True,
    "percentile": 90.0, "minmass": 12.0, "border": False, "crowds": True, "circles": False,
    "refine": None, "optics": OPTICS.to_dict(), "size": [3, 4], "exclude": [7],
    "stated_voxel": [0.3, 0.1, 0.1], "stated_dt": 0.73,
}  # fmt: skip


@pytest.fixture
def movie(report: perrin.Report, tmp_path) -> perrin.Report:
    (tmp_path / "my movie.tif").write_bytes(b"")
    settings = {"arguments": MOVIE, "input": {"path": str(tmp_path / "my movie.tif")}}
    return replace(report, imaging=object(), settings=settings)


def test_a_movie_is_opened_and_measured_with_the_same_arguments(movie, tmp_path, monkeypatch):
    """run.toml, the command and the Python lines call both functions with what was stated."""
    calls: list[dict] = []

    class Opened(nullcontext):
        pass

    def open_stack(path, **given):
        calls.append({"path": str(path)} | given)
        return Opened()

    def analyze_stack(stack, **given):
        calls.append(given)
        raise ValueError("seen")

    monkeypatch.setattr(perrin, "open_stack", open_stack, raising=False)
    monkeypatch.setattr(perrin, "analyze_stack", analyze_stack, raising=False)
    (tmp_path / "run.toml").write_text(repetition.config_text(movie.settings))
    words = shlex.split(repetition.command_line(movie.settings))
    for arguments in (["run", "--config", "run.toml", "-o", "x"], words[1:]):
        assert "seen" in run(*arguments, cwd=tmp_path).stderr
    with pytest.raises(ValueError, match="seen"):
        exec(repetition.python_lines(movie.settings), {})
    opening = {"voxel": [0.3, 0.1, 0.1], "dt": 0.73, "planes": 20, "channel": [0, 2]}
    opening |= {"image": "second, series", "path": movie.settings["input"]["path"]}
    for given in calls[::2]:
        assert {k: v for k, v in given.items() if v is not None} == opening
    asked = {k: v for k, v in MOVIE.items() if k in repetition.MOVIE_DEFAULTS and v is not None}
    asked |= {"frames": (0, 30), "refine": None}
    for given in calls[1::2]:
        found = {k: v for k, v in given.items() if k in asked}
        optics = found.pop("optics")
        assert replace(optics, stderr=OPTICS.stderr) == OPTICS
        assert found == {k: v for k, v in asked.items() if k in given and k != "optics"}
        assert given.get("keep_jumps", False) is False


def test_a_movie_in_memory_is_repeated_from_its_tracks(movie):
    """run.toml says that it measures the positions; it has no options of images."""
    settings = movie.settings | {"input": {"path": None}}
    lines = repetition.config_text(settings).splitlines()
    assert lines[0].startswith("# The movie was in memory")
    assert lines[1:3] == ['command = "analyze"', 'tracks = "tracks.parquet"']
    keys = {line.split(" = ")[0] for line in lines[3:]}
    assert keys == {"dt", "viscosity", "temperature", "noise", "exposure", "drift", "model"}


def test_channels_of_several_kinds_are_opened_one_by_one(movie):
    """Each kind of sphere has its channel, or a sum of channels."""
    arguments = MOVIE | {"other_channels": [{"path": "my movie.tif", "channel": 1}]}
    found = replace(movie, settings=movie.settings | {"arguments": arguments})
    assert 'channel = "0,2:1"' in repetition.config_text(found.settings)
    assert "channel=kind) for kind in ([0, 2], 1)]" in repetition.python_lines(found.settings)


def test_a_measured_point_spread_is_asked_for_again(movie):
    """Its stack of beads is not known any more: the command names one, Python its values."""
    spread = perrin.PointSpread(((0.8, (0.4, 0.15)), (0.2, (0.9, 0.4))))
    settings = movie.settings | {"arguments": MOVIE | {"optics": None, "psf": asdict(spread)}}
    assert 'psf = "beads.tif"' in repetition.config_text(settings)
    assert "--psf beads.tif" in repetition.command_line(settings)
    stated = repetition.python_lines(settings).split("psf=")[1].split("})")[0] + "})"
    assert eval(stated) == spread


@pytest.mark.parametrize("text", ["2.4,.5,.2,3,1,.05", "2.4,.5,.2,3,1,.1,1,.6,.05"])
def test_the_spread_of_diameters_is_the_last_number_of_optics(text):
    assert read_optics(text).spread == 0.05
