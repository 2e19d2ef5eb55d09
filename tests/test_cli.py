"""The command line as a user meets it: what it prints, writes, and with which status it ends."""

from __future__ import annotations

import contextlib
import io
import json
import math
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import pytest

import perrin
from command_line import command_line
from left_out import make_figures_without_rendering
from perrin.cli.app import analyze
from perrin.cli.tables import kinds_table, show_report, terms_of


class Outcome(NamedTuple):
    returncode: int
    stdout: str
    stderr: str


def run(*arguments: object, cwd: Path) -> Outcome:
    """Call the command line in this process: the same code as a command, without its start."""
    out, err = io.StringIO(), io.StringIO()
    with (
        contextlib.chdir(cwd),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        pytest.raises(SystemExit) as end,
    ):
        command_line([str(a) for a in arguments])
    return Outcome(end.value.code, out.getvalue(), err.getvalue())


def command(*arguments: object, cwd: Path) -> Outcome:
    """Run the command as a process of its own."""
    words = [sys.executable, "-m", "perrin.cli", *map(str, arguments)]
    environment = os.environ | {"COLUMNS": "100", "NO_COLOR": "1"}
    result = subprocess.run(words, cwd=cwd, env=environment, capture_output=True, text=True)
    return Outcome(result.returncode, result.stdout, result.stderr)


def refused(result: Outcome, status: int, *words: str) -> None:
    """One clear line on stderr, the right status, no traceback."""
    assert result.returncode == status, result.stderr
    assert result.stderr.count("\n") == 1, result.stderr
    assert result.stderr.startswith("perrin: ")
    for word in words:
        assert word in result.stderr


@pytest.fixture(scope="module")
def table() -> pd.DataFrame:
    """Return tracks of 19 steps: from 20 on an analysis takes twice the time for its verdicts."""
    rng = np.random.default_rng(8)
    truth = perrin.simulate_motion(
        perrin.Cluster.touching(4, 2.45), D_R=5e-3, D_T=0.04, dt=0.73, n_frames=20, rng=rng
    )
    return perrin.positions_table(perrin.add_noise(truth.positions(), sigma=0.03, rng=rng))


@pytest.fixture
def csv(table: pd.DataFrame, tmp_path: Path) -> Path:
    path = tmp_path / "tracks.csv"
    perrin.write_tracks(table, path)
    return path


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory, repeats) -> tuple[Path, str]:
    """Run the demo; the quick form makes its figures, but does not render them."""
    folder = tmp_path_factory.mktemp("demo")
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("COLUMNS", "100")
        if not repeats(0, 1):
            make_figures_without_rendering(patched)
        result = run("demo", cwd=folder)
    assert result.returncode == 0, result.stderr
    return folder / "perrin-demo", result.stdout


@pytest.fixture(autouse=True)
def no_progress(monkeypatch: pytest.MonkeyPatch) -> None:
    """Write no lines on progress, which depend on how busy the machine is."""
    monkeypatch.setattr("perrin.cli.progress._SHORT", math.inf)


@pytest.fixture
def no_figures(monkeypatch: pytest.MonkeyPatch, no_tensors: None) -> None:
    """Write run folders without pictures and tensors, which take most of the time of a run."""
    monkeypatch.setattr("perrin.report.write.save_figures", lambda *_, **__: [])


@pytest.fixture(scope="module")
def answer(table: pd.DataFrame) -> perrin.Report:
    return perrin.analyze(table, dt=0.73)


def test_demo_gives_the_planted_values_back(demo):
    """The demo's 95 % intervals hold the planted D_R and D_T; sigma is 34 nm within 5 %.

    Planted are the predicted values, so that the pulls are those of chance.
    """
    (cluster,) = json.loads((demo[0] / "summary.json").read_text())["clusters"]
    assert cluster["D_R"]["ci95"][0] < 6.727e-3 < cluster["D_R"]["ci95"][1]
    assert cluster["D_T"]["ci95"][0] < 4.535e-2 < cluster["D_T"]["ci95"][1]
    assert cluster["sigma"] == pytest.approx(math.sqrt((2 * 0.03**2 + 0.04**2) / 3), rel=0.05)
    assert cluster["phi2"]["predicted"] == pytest.approx(7.55e-4, rel=0.1)
    assert cluster["n_frames"] == 300
    assert cluster["warnings"] == []
    for name, planted in (("D_R", 6.727e-3), ("D_T", 4.535e-2)):
        compared = cluster["prediction"][name]
        assert compared["predicted"] == pytest.approx(planted, rel=1e-3)
        assert abs(compared["pull"]) < 2


def test_demo_prints_a_short_table(demo):
    """Coefficients, sigma, noise floor, sizes and predictions with pulls are on the screen."""
    for words in (
        "D_R (rad^2/s)", "D_T (um^2/s)", "68 %", "95 %", "sigma (nm)", "Phi^2", "sphere*, both",
        "viscosity (mPa s)", "0.00672", "0.0453", "pull -", "Planted in the simulation",
    ):  # fmt: skip
        assert words in demo[1]
    assert len(demo[1].splitlines()) < 29


def test_demo_writes_a_whole_run_folder(demo):
    """Every file that a run folder promises is there, and no unfinished file."""
    names = {p.name for p in demo[0].iterdir()}
    assert names == {
        "summary.json", "tracks.parquet", "motion.parquet", "curves.csv", "figures",
        "report.html", "run.json", "run.toml", "demo-tracks.csv", "results.csv", "checksums.json",
    }  # fmt: skip
    assert list((demo[0] / "figures").glob("*.png"))
    assert [p.name for p in demo[0].parent.iterdir()] == ["perrin-demo"]


def test_summary_has_the_promised_form(demo):
    """summary.json has the keys of the contract, plain numbers, and null for the unknown."""
    text = (demo[0] / "summary.json").read_text()
    assert "NaN" not in text
    assert "Infinity" not in text
    summary = json.loads(text)
    assert set(summary) == {"clusters", "pooled", "kinds", "singles", "warnings", "notes"}
    assert {"D_R", "D_T", "p_same"} <= set(summary["pooled"])
    (cluster,) = summary["clusters"]
    assert {
        "cluster", "n_particles", "n_frames", "D_R", "D_T", "sigma", "sigma_xyz", "phi2", "snr",
        "tensor", "sizes", "warnings", "notes",
    } <= set(cluster)  # fmt: skip
    estimate = {"value", "ci68", "ci95", "stderr", "unit", "method", "resolved"}
    assert estimate <= set(cluster["D_R"])
    assert (cluster["D_R"]["unit"], cluster["D_T"]["unit"]) == ("rad^2/s", "um^2/s")
    for key in ("sphere_T", "sphere_R", "cluster_T", "cluster_R"):
        assert set(cluster["sizes"][key]) == {"value", "stderr"}
    assert cluster["size_factor"] == "exact"
    for key in ("D_R", "D_T"):
        compared = cluster["prediction"][key]
        assert compared["measured"] == cluster[key]["value"]
        pull = (compared["measured"] - compared["predicted"]) / cluster[key]["stderr"]
        assert compared["pull"] == pytest.approx(pull)
    run_record = json.loads((demo[0] / "run.json").read_text())
    assert len(run_record["input"]["sha256"]) == 64
    assert run_record["arguments"]["dt"] == 0.73


def test_tables_of_the_run_agree_with_the_package(demo):
    """Motion, curves and tracks read back agree with the summary."""
    report = perrin.load_run(demo[0])
    assert report.to_dict() == json.loads((demo[0] / "summary.json").read_text())
    curves = pd.read_csv(demo[0] / "curves.csv")
    msad = curves[curves["quantity"] == "msad"]
    np.testing.assert_allclose(msad["value"], perrin.msad(report.clusters[0].motion).value)
    again = perrin.estimate_diffusion(report.clusters[0].motion)
    assert again.value == pytest.approx(report.clusters[0].D_R.value, rel=1e-9)
    assert list(report.tracks) == ["frame", "particle", "x", "y", "z", "cluster"]


def contents(folder: Path) -> dict[str, bytes]:
    """Return every file below a folder."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.mark.usefixtures("no_tensors", "no_verdicts")
def test_demo_replaces_only_its_own(demo, csv, tmp_path, monkeypatch):
    """The demo can be repeated; a folder that holds anything else stays as it is.

    Anything else: another file, a run of another command, or the demo's run with a file added.
    """
    place = tmp_path / "perrin-demo"
    place.mkdir()
    (place / "thesis.txt").write_text("precious")
    refused(run("demo", cwd=tmp_path), 2, "perrin-demo", "not overwritten", "run.json")
    assert contents(place) == {"thesis.txt": b"precious"}

    (place / "thesis.txt").unlink()
    place.rmdir()
    with monkeypatch.context() as patched:
        patched.setattr("perrin.report.write.save_figures", lambda *_, **__: [])
        assert run("analyze", csv, "--dt", 0.73, "-o", place, cwd=tmp_path).returncode == 0
    before = contents(place)
    refused(run("demo", cwd=tmp_path), 2, "perrin-demo", "not overwritten")
    assert contents(place) == before

    shutil.rmtree(place)
    shutil.copytree(demo[0], place)
    for added in ("thesis.txt", "figures/mine.png"):
        (place / added).write_text("precious")
        refused(run("demo", cwd=tmp_path), 2, "perrin-demo", added, "not overwritten")
        assert (place / added).read_text() == "precious"
        (place / added).unlink()
    (place / "report.html").write_text("of an earlier version")
    shutil.rmtree(place / "figures")
    figures = demo[0] / "figures"
    monkeypatch.setattr(
        "perrin.report.write.save_figures",
        lambda report, to, **_: [shutil.copy(p, to) for p in sorted(figures.iterdir())] and [],
    )
    result = run("demo", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert set(contents(place)) == set(contents(demo[0]))
    assert b"earlier version" not in (place / "report.html").read_bytes()


@pytest.mark.usefixtures("no_figures", "no_verdicts")
def test_demo_with_a_folder_overwrites_nothing(demo, tmp_path):
    """With -o even the demo's own folder is refused, unless --overwrite; status 2, no work."""
    place = tmp_path / "perrin-demo"
    shutil.copytree(demo[0], place)
    before = contents(place)
    refused(run("demo", "-o", place, cwd=tmp_path), 2, "exists", "--overwrite")
    assert contents(place) == before
    assert run("demo", "-o", place, "--overwrite", cwd=tmp_path).returncode == 0


WRITERS = {
    "simulate": (
        "simulate", "trimer", "--radius", 1, "--d-r", 0.01, "--dt", 1, "--frames", 3, "-o", "t.csv",
    ),
    "convert": ("convert", "source.csv", "t.csv"),
    "predict": (
        "predict", "dimer", "--diameter", 2, "--viscosity", 1e-3, "--temperature", 300, "-o",
        "t.csv",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", WRITERS)
def test_no_command_overwrites_a_file(table, tmp_path, monkeypatch, name):
    """Without --overwrite an existing file stays, nothing is computed; with it, it is replaced."""
    perrin.write_tracks(table, tmp_path / "source.csv")
    target = tmp_path / "t.csv"
    target.write_text("precious")
    for function in ("simulate_motion", "read_tracks", "cluster_mobility"):
        with monkeypatch.context() as patched:
            patched.setattr(perrin, function, None, raising=False)
            refused(run(*WRITERS[name], cwd=tmp_path), 2, "t.csv exists", "--overwrite")
    assert target.read_text() == "precious"
    result = run(*WRITERS[name], "--overwrite", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert target.read_text() != "precious"
    target.unlink()
    target.mkdir()
    refused(run(*WRITERS[name], "--overwrite", cwd=tmp_path), 2, "t.csv", "folder")


@pytest.mark.parametrize("name", ["simulate", "convert"])
def test_a_table_of_unknown_kind_is_refused_first(tmp_path, name):
    """The suffix of a table to write is checked before the table is made."""
    words = ["t.doc" if word == "t.csv" else word for word in WRITERS[name]]
    # The first one as a process of its own.
    refused((command if name == "simulate" else run)(*words, cwd=tmp_path), 2, "t.doc", ".parquet")
    assert not list(tmp_path.iterdir())


def test_every_command_that_writes_can_be_refused(csv, tmp_path):
    """Analyze, paper and run check the place of the output first."""
    place = tmp_path / "taken"
    place.mkdir()
    (place / "thesis.txt").write_text("precious")
    for words in (
        ("analyze", "nowhere.csv", "--dt", 1),
        ("paper",),
        ("run", "nowhere.tif", "--diameter", 1, "--contact", 1),
    ):
        refused(run(*words, "-o", place, cwd=tmp_path), 2, "taken exists", "--overwrite")
        again = run(*words, "-o", place, "--overwrite", cwd=tmp_path)
        refused(again, 2, "taken", "not overwritten")
    assert contents(place) == {"thesis.txt": b"precious"}


def test_columns_of_other_spellings_are_noted(table, tmp_path):
    """Convert reads Frame and x (um), writes our names, and states what it recognised."""
    spelt = table.rename(columns={"frame": "Frame", "x": "x (um)", "particle": "Particle ID"})
    spelt.to_csv(tmp_path / "spelt.csv", index=False)
    result = run("convert", "spelt.csv", "plain.csv", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "note: columns recognised: 'Frame' as frame, 'Particle ID' as particle" in result.stdout
    pd.testing.assert_frame_equal(perrin.read_tracks(tmp_path / "plain.csv"), table)


@pytest.mark.parametrize(
    ("header", "words"),
    [
        ("t,particle,x,y,z", ("missing column frame", "--columns frame=...")),
        ("frame,particle,x (nm),y (nm),z (nm)", ("are in nm", "--scale 0.001")),
        ("frame,particle,X,x (um),y,z", ("x: 2 columns", "--columns x=X")),
    ],
)
def test_faults_of_a_table_name_options(tmp_path, header, words):
    """Messages of the library come in the words of the command line."""
    row = ",".join("1" for _ in header.split(","))
    (tmp_path / "t.csv").write_text(f"{header}\n{row}\n")
    result = run("analyze", "t.csv", "--dt", 1, "-o", "run", cwd=tmp_path)
    refused(result, 2, *words)
    assert "columns={" not in result.stderr


def report_of(whole: perrin.Report, count: int, **changes: object) -> perrin.Report:
    """Return a report of a number of like clusters, with remarks."""
    clusters = tuple(
        replace(
            whole.clusters[0],
            cluster=k,
            warnings=(f"{k + 2} of 60 frames have no pose",),
            notes=(f"{k + 3} rows without coordinates count as missing points",),
        )
        for k in range(count)
    )
    return replace(whole, clusters=clusters, **changes)


@pytest.mark.parametrize("count", [1, 10, 40])
def test_warnings_are_merged_and_notes_separate(answer, capsys, count):
    """One line for what all clusters share; warnings first, then the notes."""
    recognised = "columns recognised: 'Frame' as frame"
    lost = tuple(f"cluster {50 + k} was left out: {k} frames" for k in range(30))
    report = report_of(answer, count, warnings=lost, notes=(recognised,))
    show_report(report, Path("folder"), analyze)
    lines = [
        line for line in capsys.readouterr().out.splitlines() if line.startswith(("! ", "note"))
    ]
    where = "" if count == 1 else f"in all {count} clusters, for example cluster 0: "
    assert lines == [
        "! warning: cluster 50 was left out: 0 frames (and 29 more of this kind)",
        f"! warning: {where}2 of 60 frames have no pose",
        f"note: {recognised}",
        f"note: {where}3 rows without coordinates count as missing points",
    ]


@pytest.mark.usefixtures("no_figures")
def test_unlikely_units_are_one_line_each(csv, tmp_path):
    """A viscosity in mPa s, a sigma and a diameter in nm: a warning, in options, and a result."""
    thick = ("--viscosity", 2.18, "--temperature", 295)
    result = run("analyze", csv, "--dt", 0.73, *thick, "-o", "run", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert result.stdout.count("--viscosity: 2.18 Pa s") == 1
    assert result.stderr == ""
    (warning,) = json.loads((tmp_path / "run" / "summary.json").read_text())["warnings"]
    assert warning.startswith("viscosity: 2.18 Pa s is 2180 times that of water")
    result = run("predict", "dimer", "--diameter", 2450, *thick, cwd=tmp_path)
    assert result.returncode == 0
    assert result.stderr.splitlines() == [
        "warning: the diameter of a sphere, 2450 um, is outside 0.05 to 50 um; if it is in nm, it "
        "is 2.45 um",
        "warning: --viscosity: 2.18 Pa s is 2180 times that of water; if the value is in mPa s "
        "(cP), state 0.00218",
    ]
    plan = ("plan", "tetrahedron", "--d-r", "5e-3", "--diameter")
    for options, words in (
        ((2.45, "--sigma", 30), ("--sigma: 30 um", "R = 1.5 um", "state 0.03")),
        ((2450, "--sigma", 0.03), ("2450 um", "0.05 to 50 um", "2.45 um")),
    ):
        result = run(*plan, *options, cwd=tmp_path)
        assert result.returncode == 0
        assert result.stderr.count("\n") == 1
        assert result.stderr.startswith("warning: ")
        assert all(word in result.stderr for word in words)
    assert run(*plan, 2.45, "--sigma", 0.03, cwd=tmp_path).stderr == ""


@pytest.mark.usefixtures("no_figures")
@pytest.mark.parametrize("suffix", [".csv", ".csv.gz", ".parquet", ".gdf"])
def test_every_format_gives_the_same_answer(table, answer, tmp_path, suffix):
    """The same tracks in four formats give the same summary."""
    path = tmp_path / f"tracks{suffix}"
    whole = table.drop(columns="cluster") if suffix == ".gdf" else table
    perrin.write_tracks(whole, path)
    result = run("analyze", path, "--dt", 0.73, "-o", tmp_path / "run", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    (cluster,) = json.loads((tmp_path / "run" / "summary.json").read_text())["clusters"]
    expected = answer.clusters[0].D_R.value
    assert cluster["D_R"]["value"] == pytest.approx(expected, rel=1e-12)


@pytest.mark.usefixtures("no_figures")
def test_options_reach_the_analysis(csv, tmp_path):
    """Options do on the command line what the arguments do in Python."""
    options = ("--scale", "2,2,2", "--frames", "2:18", "--sigma", "0.06,0.06,0.06")
    options += ("--viscosity", "1e-3", "--temperature", "300", "--columns", "x=2,y=3,z=4")
    options += ("--diameter", "4.9")
    result = run("analyze", csv, "--dt", "0.5", *options, "-o", "run", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    expected = perrin.analyze(
        csv, dt=0.5, scale=2, frames=(2, 18), sigma=0.06, viscosity=1e-3, temperature=300,
        diameter=4.9,
    )  # fmt: skip
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary == json.loads(json.dumps(expected.to_dict()))


@pytest.mark.usefixtures("no_figures")
def test_noise_and_exposure_are_options(csv, tmp_path):
    """--noise, --exposure and --drift arrive; nonsense is refused by name."""
    more = ("--noise", "residual", "--exposure", "0.2", "--drift")
    result = run("analyze", csv, "--dt", "0.73", *more, "-o", "run", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    report = perrin.load_run(tmp_path / "run")
    D_R, D_T = report.clusters[0].D_R, report.clusters[0].D_T
    assert (D_R.noise, D_R.exposure) == ("residual", 0.2)
    assert len(D_R.drift[0]) == len(D_T.drift[0]) == 3
    for wrong in (("--noise", "loud"), ("--noise", "-1"), ("--exposure", "2")):
        refused(
            run("analyze", csv, "--dt", "0.73", *wrong, "-o", "b", cwd=tmp_path), 2, wrong[0][2:]
        )


@pytest.mark.usefixtures("no_figures")
def test_an_existing_folder_is_refused_without_overwrite(csv, tmp_path):
    """The same command twice ends with status 2, and with --overwrite it replaces the run."""
    words = ("analyze", csv, "--dt", 0.73, "-o", tmp_path / "run")
    assert run(*words, cwd=tmp_path).returncode == 0
    refused(run(*words, cwd=tmp_path), 2, "run", "exists", "--overwrite")
    assert run(*words, "--overwrite", cwd=tmp_path).returncode == 0
    assert {p.name for p in tmp_path.iterdir()} == {"tracks.csv", "run"}


def _spoiled(table: pd.DataFrame, column: str, value: object) -> pd.DataFrame:
    bad = table.astype({column: object}).copy()
    bad.loc[7, column] = value
    return bad


BAD_TABLES = {
    "missing column": (lambda t: t.drop(columns="frame"), 2, ("frame",)),
    "text in a number": (lambda t: _spoiled(t, "x", "lost"), 2, ("line 9", "lost", "x")),
    "duplicate": (lambda t: pd.concat([t, t.iloc[[3]]]), 2, ("line 82", "frame", "particle")),
    "inf": (lambda t: _spoiled(t, "y", "inf"), 2, ("line 9", "y", "inf")),
    "NaN frame": (lambda t: _spoiled(t, "frame", None), 2, ("line 9", "frame")),
    "NaN particle": (lambda t: _spoiled(t, "particle", None), 2, ("line 9", "particle")),
    "one frame": (lambda t: t[t["frame"] == 3], 1, ("1 frame",)),
    "one particle": (lambda t: t[t["particle"] < 1], 1, ("1 particle",)),
    "one place": (lambda t: t.assign(x=0.0, y=0.0, z=0.0), 1, ("one line",)),
    "no rows": (lambda t: t.iloc[:0], 2, ()),
}


@pytest.mark.parametrize("name", BAD_TABLES)
def test_bad_tables_get_one_line_and_no_folder(table, tmp_path, name):
    """Each bad table is refused with file, row and remedy, and leaves nothing behind."""
    spoil, status, words = BAD_TABLES[name]
    spoil(table).to_csv(tmp_path / "bad.csv", index=False)
    result = run("analyze", "bad.csv", "--dt", 0.73, "-o", "run", cwd=tmp_path)
    refused(result, status, *words)
    if status == 2:
        assert "bad.csv" in result.stderr
    assert [p.name for p in tmp_path.iterdir()] == ["bad.csv"]


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("empty.csv", b""),
        ("picture.csv", b"\x89PNG\r\n\x1a\n" + bytes(range(256)) * 9),
        ("prose.csv", b"Dear diary,\ntoday the cluster\nturned, twice, and then, once more\n"),
        ("wrong.parquet", b"not a parquet file at all"),
        ("wrong.gdf", b"GIF89a" + bytes(200)),
        ("tracks.xyz", b"1 2 3"),
    ],
)
def test_files_that_are_no_tables_are_refused(tmp_path, name, content):
    """An empty file, binary rubbish, prose and unknown kinds end with status 2 and the name."""
    (tmp_path / name).write_bytes(content)
    refused(run("analyze", name, "--dt", 1, "-o", "run", cwd=tmp_path), 2, name)
    assert not (tmp_path / "run").exists()


def test_a_gdf_cut_short_is_refused(table, tmp_path):
    """A .gdf that is shorter than its header states is no table."""
    path = tmp_path / "tracks.gdf"
    perrin.write_tracks(table.drop(columns="cluster"), path)
    path.write_bytes(path.read_bytes()[:-100])
    refused(run("analyze", path, "--dt", 1, "-o", "run", cwd=tmp_path), 2, "tracks.gdf", "short")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--dt", "0"), ("--dt:", "> 0")),
        (("--dt", "-1"), ("--dt:", "> 0")),
        (("--dt", "1", "--scale", "0"), ("--scale:",)),
        (("--dt", "1", "--scale", "big"), ("--scale", "big")),
        (("--dt", "1", "--frames", "9"), ("--frames", "A:B")),
        (("--dt", "1", "--columns", "x"), ("--columns",)),
        (("--dt", "1", "--contact", "-2"), ("--contact:",)),
        (("--dt", "1", "--viscosity", "1e-3"), ("temperature",)),
        (("--dt", "1", "--diameter", "2"), ("diameter", "viscosity", "temperature")),
    ],
)
def test_wrong_arguments_end_with_status_2(csv, tmp_path, options, words):
    """Each argument out of range is named, and no folder is made."""
    refused(run("analyze", csv, *options, "-o", "run", cwd=tmp_path), 2, *words)
    assert not (tmp_path / "run").exists()


def test_missing_input_and_unwritable_output(csv, tmp_path):
    """A missing file and an output below a file are named, status 2."""
    missing = run("analyze", "nowhere.csv", "--dt", 1, "-o", "run", cwd=tmp_path)
    refused(missing, 2, "nowhere.csv")
    below = tmp_path / "tracks.csv" / "run"
    refused(run("analyze", csv, "--dt", 1, "-o", below, cwd=tmp_path), 2, "tracks.csv")
    result = run("analyze", csv, cwd=tmp_path)
    assert result.returncode == 2
    assert "--dt" in result.stderr


def test_simulate_and_convert_close_the_circle(tmp_path):
    """A simulated table, converted to every format and back, is the same table."""
    options = ("--radius", 1.5, "--d-r", 5e-3, "--d-t", 0.04, "--sigma", "0.03,0.03,0.04")
    options += ("--frames", 20, "--dt", 0.7, "--seed", 5)
    first = tmp_path / "a.parquet"
    assert run("simulate", "tetrahedron", *options, "-o", first, cwd=tmp_path).returncode == 0
    again = tmp_path / "b.csv.gz"
    assert run("convert", first, again, cwd=tmp_path).returncode == 0
    pd.testing.assert_frame_equal(perrin.read_tracks(first), perrin.read_tracks(again))
    assert len(perrin.read_tracks(first)) == 80
    assert run("simulate", "trimer", *options, "-o", "c.gdf", cwd=tmp_path).returncode == 0
    refused(run("simulate", "cube", *options, "-o", "d.csv", cwd=tmp_path), 2, "cube", "trimer")


CONDITIONS = ("--viscosity", 2.18e-3, "--temperature", 295)


def test_predict_prints_and_saves_a_named_body(tmp_path):
    """The prediction of the paper's cluster: D_T 0.0453, D_R 6.73e-3, the same in the JSON file."""
    options = ("predict", "tetrahedron", "--diameter", 2.45, *CONDITIONS, "-o", "p.json")
    result = run(*options, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    for shown in ("tetrahedron", "0.0453", "0.00672", "1.784", "1.818"):
        assert shown in result.stdout
    entry = json.loads((tmp_path / "p.json").read_text())
    body = perrin.cluster_mobility(
        perrin.Cluster.touching(4, 2.45), radius=1.225, viscosity=2.18e-3, temperature=295.0
    )
    assert entry == body.to_dict()
    assert entry["D_T_mean_um2_per_s"] == pytest.approx(0.0453, abs=5e-5)
    assert entry["D_R_mean_rad2_per_s"] == pytest.approx(6.73e-3, abs=5e-6)
    refused(run(*options, cwd=tmp_path), 2, "p.json exists", "--overwrite")
    assert run(*options, "--overwrite", cwd=tmp_path).returncode == 0


def test_predict_reads_positions(tmp_path):
    """A file with radii, or without them and --diameter; without -o nothing is written."""
    (tmp_path / "a.csv").write_text("x,y,z,radius\n0,0,0,1\n0,0,2.5,1.5\n")
    result = run("predict", "--positions", "a.csv", *CONDITIONS, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "0.4603" in result.stdout  # the centre of diffusion of a 1:1.5 dimer
    (tmp_path / "b.csv").write_text("x,y,z\n0,0,0\n0,0,2.45\n")
    file = run("predict", "--positions", "b.csv", "--diameter", 2.45, *CONDITIONS, cwd=tmp_path)
    named = run("predict", "dimer", "--diameter", 2.45, *CONDITIONS, cwd=tmp_path)
    assert file.stdout.splitlines()[1:] == named.stdout.splitlines()[1:]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.csv", "b.csv"]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("tetrahedron",), ("--diameter",)),
        (("cube", "--diameter", 1), ("cube", "tetrahedron")),
        ((), ("tetrahedron", "--positions")),
        (("dimer", "--positions", "a.csv"), ("dimer", "a.csv")),
        (("--positions", "a.csv", "--diameter", 2), ("a.csv has one",)),
        (("--positions", "none.csv"), ("none.csv",)),
        (("--positions", "bad.csv"), ("column 'x'", "line 3", "column 'z' is missing", "colour")),
        (("--positions", "empty.csv"), ("no rows",)),
        (("tetrahedron", "--diameter", -1), ("--diameter -1.0",)),
        (("tetrahedron", "--diameter", 1, "--temperature", 22), ("--temperature:", "kelvin")),
        (("tetrahedron", "--diameter", 1, "-o", "nowhere/p.json"), ("nowhere",)),
    ],
)
def test_predict_refuses_in_one_line(tmp_path, options, words):
    """Status 2 and one line that names every fault."""
    (tmp_path / "a.csv").write_text("x,y,z,radius\n0,0,0,1\n0,0,2.5,1.5\n")
    (tmp_path / "bad.csv").write_text("x,y,colour\n0,0,red\nabc,0,blue\n")
    (tmp_path / "empty.csv").write_text("x,y,z,radius\n")
    refused(run("predict", *CONDITIONS, *options, cwd=tmp_path), 2, *words)


def test_predict_warns_when_the_accuracy_is_not_reached(tmp_path, monkeypatch):
    """A warning is one line in addition to the result."""
    monkeypatch.setattr("perrin.hydrodynamics.resistance._MOST_UNKNOWNS", 300)
    result = run("predict", "dimer", "--diameter", 2, *CONDITIONS, cwd=tmp_path)
    assert result.returncode == 0
    assert result.stderr.startswith("warning: degree 5 leaves a relative error of")
    assert result.stderr.count("\n") == 1
    assert "D_R" in result.stdout


PLAN = ("plan", "tetrahedron", "--diameter", 2.45, "--d-r", "4.93e-3", "--sigma", "0.03,0.03,0.04")


def test_plan_prints_what_the_package_returns(tmp_path):
    """Window, best dt, errors, frames for 10, 3 and 1 %, the paper's rules; no file unasked."""
    result = run(*PLAN, "--frames", 300, "--d-t", 0.0385, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    plan = perrin.plan_sampling(
        perrin.Cluster.touching(4, 2.45),
        D_R=4.93e-3, sigma=(0.03, 0.03, 0.04), n_frames=300, D_T=0.0385,
    )  # fmt: skip
    counts = [str(plan.frames_for(r)) for r in (0.1, 0.03, 0.01)]
    for words in (
        "300 frames every 0.766 s", "8.3 %", "5.0 %", "0.191 to 5.07 s", "0.0383 to 50.7 s",
        "needed for 10 %", "needed for 1 %", *counts, *plan.reasons,
    ):  # fmt: skip
        assert words in result.stdout
    assert not list(tmp_path.iterdir())


def test_plan_takes_either_size_and_every_budget(tmp_path):
    """A radius makes the same body; time and photons reach the plan."""
    by_radius = [x if x != "--diameter" else "--radius" for x in PLAN]
    by_radius[by_radius.index(2.45)] = 2.45 * math.sqrt(3 / 8)
    assert run(*by_radius, cwd=tmp_path).stdout == run(*PLAN, cwd=tmp_path).stdout
    assert "no optimum" in run(*PLAN, "--time", 220, cwd=tmp_path).stdout
    light = run(*PLAN, "--time", 220, "--frames", 300, "--photons", cwd=tmp_path)
    assert "Limited photons" in light.stdout


def test_plan_draws_and_never_overwrites_silently(tmp_path, monkeypatch):
    """The picture has the format of its suffix; one that exists stays, unless --overwrite."""
    # Without its layout, which takes half of the time; the second picture is empty.
    monkeypatch.setattr("matplotlib.layout_engine.ConstrainedLayoutEngine.execute", lambda *_: None)
    assert run(*PLAN, "-o", "a.svg", cwd=tmp_path).returncode == 0
    assert (tmp_path / "a.svg").read_bytes().startswith(b"<?xml")
    monkeypatch.setattr("perrin.plot.results.plot_plan", lambda *_, **__: None)
    (tmp_path / "a.png").write_text("precious")
    refused(run(*PLAN, "-o", "a.png", cwd=tmp_path), 2, "a.png", "exists", "--overwrite")
    assert (tmp_path / "a.png").read_text() == "precious"
    assert run(*PLAN, "-o", "a.png", "--overwrite", cwd=tmp_path).returncode == 0
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--radius", "1"), ("--radius", "--diameter")),
        (("--frames", "2"), ("--frames:",)),
        (
            ("--time", "-3", "--photons"),
            ("--time: ", "-3.0", "--photons: expected --frames and --time"),
        ),
        (("--d-t", "-1"), ("--d-t:",)),
        (("--sigma", "a"), ("--sigma",)),
        (("--sigma", "0"), ("sigma", "more than 0")),
        (("--d-r", "0"), ("--d-r: ", "got 0.0")),
        (("-o", "plan.doc"), ("plan.doc", ".png")),
        (("-o", "nowhere/plan.png"), ("nowhere",)),
    ],
)
def test_plan_refuses_in_one_line(tmp_path, options, words):
    """Each wrong option is named, status 2."""
    refused(run(*PLAN, *options, cwd=tmp_path), 2, *words)
    assert not list(tmp_path.iterdir())


def test_plan_knows_its_shapes(tmp_path):
    """An unknown shape and a missing size are refused together."""
    result = run("plan", "cube", "--d-r", 1, "--sigma", 1, cwd=tmp_path)
    refused(result, 2, "cube", "trimer", "--diameter")


def test_help_and_version():
    """The help names every command; the version is the package's."""
    result = command("--help", cwd=Path.cwd())
    for name in ("demo", "analyze", "simulate", "plan", "predict", "convert"):
        assert name in result.stdout
    assert run("--version", cwd=Path.cwd()).stdout.strip() == perrin.__version__


@pytest.mark.usefixtures("no_figures")
def test_names_with_square_brackets_are_printed_as_they_are(csv, tmp_path):
    """A cluster called a[/]b is no markup of the terminal's library."""
    table = perrin.read_tracks(csv)
    perrin.write_tracks(table.assign(cluster="a[/]b [bold]"), tmp_path / "named.csv")
    result = run("analyze", "named.csv", "--dt", "0.73", "-o", "run", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "cluster a[/]b [bold]:" in result.stdout


# ---- formats, configuration, machine-readable output --------------------------------------------


def test_the_demo_leaves_a_table_that_the_next_command_takes(demo):
    """The README's command reads demo-tracks.csv, which holds all digits of the demo's input."""
    readme = (Path(__file__).resolve().parents[1] / "README.md").read_text(encoding="utf-8")
    assert "perrin analyze perrin-demo/demo-tracks.csv --dt 0.73 -o my-run" in readme
    read = perrin.read_tracks(demo[0] / "demo-tracks.csv")
    used = pd.read_parquet(demo[0] / "tracks.parquet")
    pd.testing.assert_frame_equal(read[list(used)], used, check_exact=True)
    assert "dt = 0.73\n" in (demo[0] / "run.toml").read_text()


def test_bodies_have_the_same_names_everywhere(tmp_path):
    """Every name, and a file of positions, is a body of plan, predict and simulate."""
    from perrin.cli.options import SHAPES, body_of

    for shape, count in SHAPES.items():
        for size in ({"radius": 1.5, "diameter": None}, {"radius": None, "diameter": 2.0}):
            body = body_of(shape, positions=None, **size)
            assert len(body.positions) == count
            if size["radius"] is not None:
                np.testing.assert_allclose(body.R, 1.5)
    positions = perrin.Cluster.tetrahedron(1.5).positions
    pd.DataFrame(positions, columns=["x", "y", "z"]).to_csv(tmp_path / "body.csv", index=False)
    options = ("--d-r", 0.005, "--sigma", 0.03)
    named = ("tetrahedron", "--radius", 1.5)
    plans, tables = [], []
    for k, body in enumerate((("--positions", "body.csv"), named)):
        result = run("plan", *body, *options, "--frames", 300, "--json", cwd=tmp_path)
        plans.append(json.loads(result.stdout))
        movie = ("--dt", 0.7, "--frames", 5, "-o", f"{k}.csv")
        assert run("simulate", *body, *options, *movie, cwd=tmp_path).returncode == 0
        tables.append(perrin.read_tracks(tmp_path / f"{k}.csv"))
    assert plans[0]["dt_best"] == pytest.approx(plans[1]["dt_best"])
    assert plans[0]["dt_rigid"] == pytest.approx(plans[1]["dt_rigid"])
    pd.testing.assert_frame_equal(*tables)
    both = run("plan", "trimer", "--positions", "body.csv", *options, cwd=tmp_path)
    refused(both, 2, "--positions: states the body")


def test_a_configuration_repeats_a_run(csv, tmp_path, no_figures):
    """run.toml holds the options that were stated; the command line outranks it."""
    stated = ("--scale", "0.5,0.5,0.5", "--frames", "0:18", "--drift", "--sigma", "0.03")
    first = run("analyze", csv, "--dt", 0.73, *stated, "-o", "one", "--json", cwd=tmp_path)
    assert first.returncode == 0, first.stderr
    assert 'command = "analyze"\n' in (tmp_path / "one" / "run.toml").read_text()
    again = run("analyze", "--config", "one/run.toml", "--json", cwd=tmp_path)
    assert again.returncode == 0, again.stderr
    assert json.loads(again.stdout) == json.loads(first.stdout)
    assert (tmp_path / "one-2" / "run.toml").read_bytes() == (
        tmp_path / "one" / "run.toml"
    ).read_bytes()
    half = run("analyze", "--config", "one/run.toml", "--frames", "0:15", "-o", "half", "--json",
               cwd=tmp_path)  # fmt: skip
    assert json.loads(half.stdout)["clusters"][0]["n_frames"] == 15


def test_a_configuration_takes_lists_and_refuses_what_is_no_option(csv, tmp_path, no_figures):
    """Lists and tables of TOML are what one types; a misspelt name is a fault, not ignored."""
    text = (
        'tracks = "tracks.csv"\ndt = 0.73\nscale = [1, 1.0, 1]\nkeep_jumps = true\n'
        'columns = {x = "x", particle = 1}\n'
    )
    (tmp_path / "a.toml").write_text(text)
    result = run("analyze", "--config", "a.toml", "-o", "r", "--quiet", cwd=tmp_path)
    assert (result.returncode, result.stdout, result.stderr) == (0, "", "")
    arguments = json.loads((tmp_path / "r" / "run.json").read_text())["arguments"]
    assert arguments["keep_jumps"] is True
    assert arguments["columns"] == {"x": "x", "particle": 1}
    for content, words in (
        ("dt = 0.73\nsgima = 1\n", "unknown: sgima"),
        ('command = "run"\n', "is of the command run"),
        ("dt = \n", "Invalid value"),
    ):
        (tmp_path / "b.toml").write_text(content)
        result = run("analyze", "--config", "b.toml", cwd=tmp_path)
        assert result.returncode == 2
        assert words in " ".join(result.stderr.split())


def test_json_and_quiet_print_nothing_else(csv, tmp_path, no_figures):
    """--json prints summary.json to the byte, --quiet nothing, plan and predict their results."""
    result = run("analyze", csv, "--dt", 0.73, "-o", "r", "--json", cwd=tmp_path)
    assert result.stdout == (tmp_path / "r" / "summary.json").read_text()
    body = ("tetrahedron", "--diameter", 2.45)
    fluid = ("--viscosity", 1e-3, "--temperature", 298)
    found = json.loads(run("predict", *body, *fluid, "--json", cwd=tmp_path).stdout)
    assert found["temperature_K"] == 298
    noise = ("--d-r", 0.005, "--sigma", 0.03, "--frames", 300)
    assert json.loads(run("plan", *body, *noise, "--json", cwd=tmp_path).stdout)["n_frames"] == 300


def test_a_table_without_ids_is_identified(table, tmp_path, no_figures):
    """--contact and --size find the particles: the answer is that of the labelled table."""
    raw = table[["frame", "x", "y", "z"]].sample(frac=1, random_state=1)
    raw.to_csv(tmp_path / "raw.csv", index=False)
    known = run("analyze", "raw.csv", "--dt", 0.73, "--contact", 2.45, "--size", 4, "-o", "r",
                "--json", cwd=tmp_path)  # fmt: skip
    assert known.returncode == 0, known.stderr
    (cluster,) = json.loads(known.stdout)["clusters"]
    labelled = perrin.analyze(table, dt=0.73).clusters[0]
    assert cluster["D_R"]["value"] == pytest.approx(labelled.D_R.value, rel=1e-6)
    alone = run("analyze", "raw.csv", "--dt", 0.73, "-o", "s", cwd=tmp_path)
    refused(alone, 2, "missing column particle", "--contact", "--size")
    perrin.write_tracks(table, tmp_path / "t.csv")
    both = run("analyze", "t.csv", "--dt", 0.73, "--contact", 2.45, "--size", 4, "-o", "s",
               cwd=tmp_path)  # fmt: skip
    refused(both, 2, "--size: finds the particles of a table without ids")


def test_times_in_place_of_frames_are_checked_against_dt(table, tmp_path, no_figures):
    """--columns time=t numbers the frames; a dt that contradicts the times is refused."""
    late = table.assign(t=(0.73 * table["frame"]).round(3)).drop(columns="frame")
    late.to_csv(tmp_path / "t.csv", index=False)
    words = ("analyze", "t.csv", "--columns", "time=t")
    right = run(*words, "--dt", 0.73, "-o", "r", "--json", cwd=tmp_path)
    assert right.returncode == 0, right.stderr
    value = json.loads(right.stdout)["clusters"][0]["D_R"]["value"]
    assert value == pytest.approx(perrin.analyze(table, dt=0.73).clusters[0].D_R.value, rel=1e-3)
    refused(run(*words, "--dt", 0.5, "-o", "s", cwd=tmp_path), 2, "contradicts dt = 0.5")


@pytest.mark.parametrize("suffix", [".csv.gz", ".parquet", ".gdf", ".xyz", ".napari.csv"])
def test_convert_and_back_is_the_same_table(table, tmp_path, suffix):
    """Each format that is written gives the table back; what it cannot hold is named."""
    perrin.write_tracks(table, tmp_path / "t.csv")
    drop = () if suffix in (".csv.gz", ".parquet", ".xyz") else ("--drop", "cluster")
    if drop:
        refused(run("convert", "t.csv", f"u{suffix}", cwd=tmp_path), 2, "cannot hold", "cluster")
    assert run("convert", "t.csv", f"u{suffix}", *drop, cwd=tmp_path).returncode == 0
    assert run("convert", f"u{suffix}", "v.csv", cwd=tmp_path).returncode == 0
    back = perrin.read_tracks(tmp_path / "v.csv")
    expected = table.drop(columns="cluster") if drop else table
    keys = ["frame", "particle"]
    pd.testing.assert_frame_equal(
        back.sort_values(keys, ignore_index=True), expected.sort_values(keys, ignore_index=True)
    )


def test_an_interruption_says_what_is_kept(csv, tmp_path, monkeypatch):
    """Ctrl-C ends with status 130 and a sentence; no folder appears."""

    def stop(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("perrin.analyze", stop)
    result = run("analyze", csv, "--dt", 0.73, "-o", "r", cwd=tmp_path)
    assert result.returncode == 130
    assert result.stderr == "Stopped: nothing is written, and what was there is kept.\n"
    assert not (tmp_path / "r").exists()


def test_the_doctor_measures_a_simulated_cluster(tmp_path):
    """Versions, readers, font and self-test are listed; a missing required package is a failure."""
    result = run("doctor", cwd=tmp_path)
    assert result.returncode == 0, result.stdout
    for words in ("ok  numpy: ", "font of figures", "self-test, planted 0.005: D_R = ", "(.gsd)"):
        assert words in result.stdout
    assert "BAD" not in result.stdout


def test_progress_in_a_log_is_a_line_for_each_tenth():
    """Of 40 clusters in 10 s a log gets at most ten lines of each task, none in the first 2 s."""
    from perrin.cli.progress import progress_lines

    stream, now = io.StringIO(), iter(np.arange(0, 100, 0.25))
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("perrin.cli.progress._SHORT", 2.0)
        show = progress_lines(stream, clock=lambda: float(next(now)))
        for done in range(41):
            show(done, 40, "fitting clusters")
        show(0, 0, "writing the report")
    lines = stream.getvalue().splitlines()
    assert lines[0] == "fitting clusters: 20 % (8 of 40), 2 s"
    assert [line.split(":")[1].split("%")[0] for line in lines[1:-1]] == [
        f" {10 * k} " for k in range(3, 11)
    ]
    assert lines[-1].startswith("writing the report, ")


def test_progress_in_a_log_is_never_silent_for_minutes():
    """Of 2000 frames of 20 s, a tenth of which takes an hour, a log gets a line a minute."""
    from perrin.cli.progress import progress_lines

    stream, now = io.StringIO(), iter(range(0, 100_000, 20))
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("perrin.cli.progress._SHORT", 2.0)
        show = progress_lines(stream, clock=lambda: float(next(now)))
        for done in range(201):
            show(done, 2000, "locating spheres")
    seconds = [int(line.split()[-2]) for line in stream.getvalue().splitlines()]
    assert seconds == [20, *range(80, 4001, 60), 4000]


def test_kinds_of_bodies_are_rows_of_one_table():
    """Size, symmetry and number, then its coefficients; limits and what is not pooled in words."""
    from types import SimpleNamespace

    from rich.console import Console

    truth = perrin.simulate_motion(
        perrin.Cluster.tetrahedron(1.5), D_R=5e-3, D_T=0.04, dt=0.7, n_frames=50, rng=1
    )
    known = perrin.estimate_diffusion(truth)
    limit = replace(known, resolved=False, ci95=(0.0, 0.02))
    kinds = [
        SimpleNamespace(size=4, point_group="T_d", clusters=(0, 1), coefficients=[("D_R", known)]),
        SimpleNamespace(size=5, point_group="D_3h", clusters=(2,), coefficients=[]),
    ]
    singles = SimpleNamespace(n_tracks=7, D_T=limit)
    report = SimpleNamespace(clusters=(), kinds=kinds, singles=singles)
    console = Console(record=True, width=120)
    console.print(kinds_table(report))
    text = console.export_text()
    for words in (
        r"4 T_d +2 +D_R \(rad",
        "5 D_3h +1 +not rigid: not pooled",
        "7 tracks +D_T.*< 0.02",
    ):
        assert re.search(words, text), (words, text)
    assert terms_of(report)[-1].startswith("T_d, D_3h")
