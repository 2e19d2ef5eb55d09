"""Studies: the manifest, what is measured again, failures, locks, tables and the page."""

from __future__ import annotations

import json
import os
import re
import sys
import threading

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

import perrin
from left_out import make_figures_without_rendering
from perrin.cli.app import app
from perrin.errors import FolderInUseError, ManifestError
from perrin.run.lock import locked
from perrin.study import (
    Entry,
    Manifest,
    Study,
    StudyMovie,
    StudyResult,
    Task,
    cluster_values,
    condition_means,
    key_lines,
    manifest_text,
    measure_all,
    measure_movie,
    movie_table,
    read_manifest,
    render_samples,
    render_study,
    running,
    warning_matrix,
    writing,
)


def write_table(path, *, seed, D=5e-3, clusters=2, frames=20):
    """Write the table of a movie with tetrahedra."""
    rng = np.random.default_rng(seed)
    body, parts = perrin.Cluster.touching(4, 2.45), []
    for number in range(clusters):
        truth = perrin.simulate_motion(body, D_R=D, D_T=8 * D, dt=0.7, n_frames=frames, rng=rng)
        x = perrin.add_noise(truth.positions() + 20 * number, sigma=0.03, rng=rng)
        table = perrin.positions_table(x)
        parts.append(table.assign(cluster=number, particle=table["particle"] + 10 * number))
    pd.concat(parts).to_csv(path, index=False)


def write_study(folder, *, movies, more=""):
    """Write a manifest: a sample for each condition, from lists of files by phi."""
    lines = ['conditions = ["phi"]', "reports = false", "[defaults]", "dt = 0.7"]
    for phi, files in movies.items():
        lines += ["[[sample]]", f'label = "phi {phi}"', f"files = {json.dumps(files)}"]
        lines += [f"phi = {phi}", more]
    (folder / "study.toml").write_text("\n".join(lines), encoding="utf-8")
    return folder / "study.toml"


@pytest.fixture(scope="module")
def finished(tmp_path_factory, repeats):
    """Run a study of three tables, one of them unreadable, once.

    The quick form makes its figures, but does not render them.
    """
    folder = tmp_path_factory.mktemp("study")
    write_table(folder / "a.csv", seed=1)
    write_table(folder / "b.csv", seed=2, D=2e-3, clusters=1)
    (folder / "bad.csv").write_text("frame,particle\n1,1\n")
    manifest = write_study(folder, movies={0.1: ["a.csv", "bad.csv"], 0.4: ["b.csv"]})
    with pytest.MonkeyPatch.context() as patched:
        if not repeats(0, 1):
            make_figures_without_rendering(patched)
        result = Study.from_toml(manifest).run(folder / "STUDY")
    return folder, result


def test_all_faults_of_a_manifest_are_listed_with_their_lines(tmp_path):
    (tmp_path / "a.csv").write_text("frame,particle,x,y,z\n")
    text = """title = "x"
conditions = ["phi"]
law = "line"
nonsense = 1
[defaults]
dt = -1
[[sample]]
files = ["a.csv", "none.csv"]
phi = true
voxel = 3
[[sample]]
label = "a"
files = ["movie.tif"]
exclude = [{ cluster = 1 }]
"""
    path = tmp_path / "study.toml"
    path.write_text(text)
    (tmp_path / "movie.tif").write_bytes(b"")
    with pytest.raises(ManifestError) as caught:
        read_manifest(path)
    message = str(caught.value)
    for line, words in [
        (3, "law: expected"), (4, "unknown 'nonsense'"), (6, "defaults: dt: expected"),
        (8, "files: none.csv does not exist"), (9, "phi: expected a number"),
        (10, "voxel: is no option of a table"), (11, "condition 'phi' is not stated"),
        (12, "label 'a' is that of another sample"), (13, "diameter: needed"),
        (13, "contact: needed"), (14, "exclude: expected entries"),
    ]:  # fmt: skip
        assert re.search(rf"line {line}: {re.escape(words)}", message), (line, words, message)
    path.write_text("a = [")
    with pytest.raises(ManifestError, match="no TOML"):
        read_manifest(path)


@pytest.mark.parametrize(
    ("head", "sample", "words"),
    [
        ("conditions = 3", "", "conditions: expected names, got 3"),
        ('conditions = ["dt"]', "", "conditions: 'dt' is an option; choose another name"),
        ('average = ["odd"]', "", "average: expected some of"),
        ("reports = 1", "", "reports: expected"),
        ("[defaults]\nodd = 1", "", "defaults: unknown 'odd'; expected"),
        ("", "odd = 1", "unknown 'odd'; expected"),
        ("", "[sample.conditions]\npsi = 1", "condition 'psi' is not in the list"),
        ("", 'exclude = [{ file = "b.csv", cluster = 1, reason = "wall" }]', "b.csv is none of"),
        ("", "dt = 0", "dt: expected a finite number > 0"),
        ("", "drift = 1", "drift: expected"),
        ("", "columns = 3", "columns: expected a table such as"),
        ("", "frames = [1]", "frames: expected the first frame and the first that is not used"),
    ],
)
def test_a_fault_of_a_manifest_is_named(tmp_path, head, sample, words):
    (tmp_path / "a.csv").write_text("frame,particle,x,y,z\n")
    text = f'{head}\n[[sample]]\nfiles = ["a.csv"]\n{sample}\n'
    (tmp_path / "study.toml").write_text(text)
    with pytest.raises(ManifestError, match=re.escape(words)):
        read_manifest(tmp_path / "study.toml")


def test_a_manifest_without_samples_or_files_is_refused(tmp_path):
    for text, words in (
        ("conditions = []", "expected at least one [[sample]]"),
        ("[[sample]]\nfiles = []", "files: expected one or more paths in brackets, got []"),
        ('[[sample]]\nfiles = ["*.csv"]', "*.csv"),
    ):
        (tmp_path / "study.toml").write_text(text)
        with pytest.raises(ManifestError, match=re.escape(words)):
            read_manifest(tmp_path / "study.toml")


def test_lines_are_those_of_keys_in_all_kinds_of_tables():
    text = '# c\na = """\n"""\n[defaults]\n"dt" = 1\n[[sample]]\nx = [\n 1,\n]\n'
    text += "[sample.conditions]\nphi = 1\n[[sample]]\nx = 2\n"
    lines = key_lines(text)
    assert lines["defaults", "dt"] == 5
    assert lines["sample", "0", "conditions", "phi"] == 11
    assert lines["sample", "1", "x"] == 13


def test_a_new_manifest_is_read_back(tmp_path):
    for name in ("a.csv", "b.ome.tif"):
        (tmp_path / name).write_text("")
    files = [tmp_path / "a.csv", tmp_path / "b.ome.tif"]
    (tmp_path / "study.toml").write_text(manifest_text(files, folder=tmp_path))
    manifest = read_manifest(tmp_path / "study.toml")
    assert [m.source for m in manifest.movies] == ["table", "movie"]
    assert [m.sample for m in manifest.movies] == ["a", "b"]
    assert all(m.conditions == {"phi": 0.0} for m in manifest.movies)


@pytest.mark.skipif(sys.platform != "linux", reason="names of files are UTF-8 elsewhere")
def test_a_name_that_is_no_utf8_is_found_again(tmp_path):
    name = os.fsdecode(b"m\xfcnster[1].csv")
    (tmp_path / name).write_text("frame,particle\n")
    text = manifest_text([str(tmp_path / name)], folder=tmp_path)
    (tmp_path / "study.toml").write_text(text, encoding="utf-8")
    manifest = read_manifest(tmp_path / "study.toml")
    (movie,) = manifest.movies
    assert movie.path == str(tmp_path / name)
    entry = measure_movie(Task(movie, str(tmp_path / "STUDY")))
    (row,) = movie_table(manifest, {movie.name: entry}).to_dict("records")
    assert row["path"].endswith("m\\udcfcnster[1].csv")
    assert "missing columns x, y" in row["reason"]
    row["reason"].encode("utf-8")


def test_results_are_tidy_and_a_failure_is_a_row(finished):
    folder, result = finished
    assert [e.reason.partition(": ")[2][:15] for e in result.failed] == ["missing columns"]
    table = pd.read_csv(folder / "STUDY" / "results.csv")
    packed = pd.read_parquet(folder / "STUDY" / "results.parquet")
    # A cell without a value is NaN in one table and None in the other.
    one, other = (
        t.drop(columns="averaged").astype(object).where(t.drop(columns="averaged").notna(), None)
        for t in (table, packed)
    )
    pd.testing.assert_frame_equal(one, other, check_dtype=False)
    clusters = table[table["of"] == "cluster"]
    assert set(clusters["quantity"]) == {"D_R", "D_T", "D_T/D_R"}
    assert len(clusters) == 3 * 3
    means = table[(table["of"] == "condition") & (table["quantity"] == "D_R")]
    assert sorted(means["phi"]) == [0.1, 0.4]
    movies = pd.read_csv(folder / "STUDY" / "movies.csv")
    assert sorted(movies["status"]) == ["done", "done", "failed"]
    provenance = json.loads((folder / "STUDY" / "provenance.json").read_text())
    assert {len(h) for h in provenance["inputs"].values() if h} == {64}


def test_every_movie_is_an_ordinary_run_with_the_same_numbers(finished):
    folder, result = finished
    one = next(m for m in result.manifest.movies if m.path.endswith("a.csv"))
    run = perrin.load_run(folder / "STUDY" / "runs" / one.name)
    assert run == perrin.load_run(folder / "STUDY" / "runs" / one.name)
    alone = perrin.analyze(folder / "a.csv", dt=0.7)
    assert alone.to_dict() == run.to_dict()
    values = {v.cluster: v.coefficient.value for v in result.values
              if v.movie == one and v.quantity == "D_T"}  # fmt: skip
    assert values == {c.cluster: c.D_T.value for c in run.clusters}


@pytest.fixture(scope="module")
def known(tmp_path_factory):
    """Return the report of one short table."""
    path = tmp_path_factory.mktemp("known") / "one.csv"
    write_table(path, seed=2, D=2e-3, clusters=1, frames=15)
    return perrin.analyze(path, dt=0.7)


@pytest.fixture
def quick(known, monkeypatch):
    """Measure any table that can be read as a known one, and draw nothing."""

    def analyze(path, **_):
        perrin.read_tracks(path)
        return known

    monkeypatch.setattr(running, "analyze", analyze)
    monkeypatch.setattr(writing, "render_study", lambda result: f"{len(result.values)} values")
    monkeypatch.setattr(writing, "save_study_figures", lambda *_: [])


def test_only_what_is_new_or_changed_is_measured(tmp_path, quick):
    """Another movie, another option, another input: the other runs are not touched."""
    folder = tmp_path
    for number, name in enumerate(("a.csv", "b.csv")):
        write_table(folder / name, seed=number, clusters=1, frames=3)
    (folder / "bad.csv").write_text("frame,particle\n1,1\n")
    write_study(folder, movies={0.1: ["a.csv", "bad.csv"], 0.4: ["b.csv"]})
    Study.from_toml(folder / "study.toml").run(folder / "STUDY")

    def times():
        return {p.parent.name: p.stat().st_mtime_ns for p in folder.glob("STUDY/runs/*/run.json")}

    first, page = times(), (folder / "STUDY" / "study.html").stat().st_mtime_ns
    Study.from_toml(folder / "study.toml").run(folder / "STUDY")
    assert times() == first
    assert (folder / "STUDY" / "study.html").stat().st_mtime_ns == page
    write_table(folder / "c.csv", seed=3, clusters=1, frames=3)
    write_study(folder, movies={0.1: ["a.csv", "bad.csv"], 0.4: ["b.csv", "c.csv"]})
    result = Study.from_toml(folder / "study.toml").run(folder / "STUDY")
    assert {k: v for k, v in times().items() if k in first} == first
    assert len(result.failed) == 1
    # The failed table is replaced by a good one, and b by another.
    write_table(folder / "bad.csv", seed=4, clusters=1, frames=3)
    write_table(folder / "b.csv", seed=5, clusters=1, frames=4)
    result = Study.from_toml(folder / "study.toml").run(folder / "STUDY")
    assert not result.failed
    changed = {k for k, v in times().items() if first.get(k) not in (None, v)}
    assert [name.startswith("phi_0.4-b") for name in changed] == [True]
    # A conclusion of the manifest alone, an exclusion, measures nothing.
    before = times()
    write_study(
        folder,
        movies={0.1: ["a.csv"], 0.4: ["b.csv", "c.csv"]},
        more='exclude = [{ cluster = 0, reason = "at the wall" }]',
    )
    result = Study.from_toml(folder / "study.toml").run(folder / "STUDY")
    assert times() == before
    assert {v.apart_because for v in result.values if v.cluster == 0} == {"excluded: at the wall"}
    assert StudyResult.load(folder / "STUDY").to_dict() == result.to_dict()


def test_a_second_study_in_one_folder_is_refused(finished, tmp_path):
    """While another thread holds the folder; and a folder that holds something else."""
    study, place = Study.from_toml(finished[0] / "study.toml"), finished[0] / "STUDY"
    held, done = threading.Event(), threading.Event()

    def hold():
        with locked(place):
            held.set()
            done.wait(10)

    other = threading.Thread(target=hold)
    other.start()
    held.wait(10)
    try:
        with pytest.raises(FolderInUseError):
            study.run(place)
    finally:
        done.set()
        other.join()
    (tmp_path / "photo.jpg").write_bytes(b"")
    with pytest.raises(FileExistsError, match="no folder of a study"):
        study.run(tmp_path)


def entries_of(values, *, verdict="diffusion", rigid=True, warnings=()):
    """Return an entry with one tetrahedron for each value."""
    template = perrin.Cluster.touching(4, 1.0).positions.tolist()
    ends = {"ci68": (0.9, 1.1), "ci95": (0.8, 1.25)}
    clusters = []
    for number, value in enumerate(values):
        one = {
            "symbol": "D_R", "value": value, "stderr": 0.1 * value, "unit": "", "resolved": True,
            "verdict": verdict, "predicted": 2.0,
            **{k: [e * value for e in pair] for k, pair in ends.items()},
        }  # fmt: skip
        clusters.append(
            {"cluster": number, "label": None, "kind": 0, "rigid": rigid, "frames": 9,
             "warnings": list(warnings), "D_R": one, "D_T": {**one, "symbol": "D_T"}}
        )  # fmt: skip
    kind = {"size": 4, "point_group": "T_d", "count": len(values), "template": template}
    return {"clusters": tuple(clusters), "kinds": (kind,)}


def test_what_is_not_diffusion_is_apart_and_never_averaged():
    movies = tuple(StudyMovie(name, name, "table", name) for name in "abc")
    entries = {
        "a": Entry("a", "done", **entries_of([1.0, 1.1])),
        "b": Entry("b", "done", **entries_of([9.0], verdict="confined")),
        "c": Entry("c", "done", **entries_of([7.0], rigid=False)),
    }
    manifest = Manifest(movies)
    values = cluster_values(manifest, entries)
    mean = condition_means(manifest, values)[0]
    assert mean.mean.n_clusters == 2
    assert mean.apart == {"motion: confined": 1, "not rigid": 1}
    allowed = Manifest(movies, average=("diffusion", "confined"))
    assert condition_means(allowed, cluster_values(allowed, entries))[0].mean.n_clusters == 3


def test_replicates_count_as_one_movie():
    entries = {name: Entry(name, "done", **entries_of([1.0, 1.2])) for name in "abcd"}
    alone = Manifest(tuple(StudyMovie(n, n, "table", n) for n in "abcd"))
    two = Manifest(tuple(StudyMovie(n, n, "table", n, replicate=str(n < "c")) for n in "abcd"))
    found = [condition_means(m, cluster_values(m, entries))[0].mean.dof for m in (alone, two)]
    assert found == [3, 1]


@pytest.fixture(scope="module")
def large(tmp_path_factory):
    """Return a study of 160 movies under three conditions, whose names hold marks of HTML."""
    movies = tuple(
        StudyMovie(f"m{k}-<b>", f"{k}.csv", "table", "<script>", {"phi": 0.1 * (k % 3)})
        for k in range(160)
    )
    texts = ["step 3 to 4: a jump of 2.5 um", "step 7 to 8: a jump of 3 um", f"{'other'} fault"]
    entries = {
        m.name: Entry(m.name, "done", **entries_of([1.0 + 0.01 * (k % 7)], warnings=texts[: k % 4]))
        for k, m in enumerate(movies)
    }
    manifest = Manifest(movies, title="<i>Study</i>", conditions=("phi",), law="exponential")
    return StudyResult(manifest, tmp_path_factory.mktemp("large"), entries)


def test_the_page_of_hundreds_of_movies_escapes_and_loads_nothing(large):
    html = render_study(large)
    assert len(html) < 4e6
    assert "default-src 'none'" in html
    assert "&lt;i&gt;Study&lt;/i&gt;" in html
    body = re.sub(r"<script.*?</script>", "", html, flags=re.DOTALL)
    assert "<b>" not in body
    assert "<script>" not in body
    assert not re.search(r"""(?:src|href)=["']?(?:https?:)?//""", body)
    assert body.count("runs/m") == 160


def test_a_page_of_a_sample_lists_its_movies_clusters_and_warnings(large):
    """Every movie links to its run, every warning is named with its cluster; texts are escaped."""
    (page,) = render_samples(large)
    body = page.split("<body", 1)[1] if "<body" in page else page.split("</style>", 1)[1]
    assert "<script>" not in body
    assert "m3-<b>" not in body
    done = [e for e in large.entries.values() if e.status == "done"]
    assert body.count("../runs/m") == len(done)
    assert body.count("a jump of") == 40 * (1 + 2 + 2)
    study = render_study(large)
    assert study.count('href="samples/1.html"') == len(large.entries)


def test_a_sample_has_its_own_clusters_and_an_interval_without_an_end_is_worded(tmp_path):
    """A page for each sample, in the order of the manifest; no "inf" on a page."""
    movies = tuple(StudyMovie(name, name, "table", name) for name in "ba")
    entries = {
        "b": Entry("b", "done", **entries_of([1.0, 1.1])),
        "a": Entry("a", "done", **entries_of([7.0], verdict="confined")),
    }
    (open_cluster,) = entries["a"].clusters
    open_cluster["D_R"]["ci95"][1] = np.inf
    first, second = render_samples(StudyResult(Manifest(movies), tmp_path, entries))
    assert "<h1>b</h1>" in first
    assert [first.count(f"b, cluster {k}") for k in (0, 1)] == [1, 1]
    assert "a, cluster" not in first
    assert "7.00 (above 5.60)" in second
    assert "motion: confined" in second
    assert "inf" not in second.split("</style>", 1)[1]


def test_warnings_that_differ_in_numbers_are_one_column(large):
    matrix = warning_matrix(large)
    assert len(matrix["kinds"]) == 2
    assert len(matrix["rows"]) == 120
    assert sum(sum(counts) + other for _, counts, other in matrix["rows"]) == 40 * (1 + 2 + 3)


def test_conditions_are_sorted_and_compared_with_the_first(large):
    found = [one.conditions["phi"] for one in large.means if one.quantity == "D_R"]
    assert found == sorted(found)
    assert {a.conditions["phi"] for a, _, _ in large.comparisons} == {0.0}
    assert large.trends["4 particles, T_d: D_R"].ci95["rate"][0] < 0
    ratio = next(one for one in large.means if one.quantity == "D_T/D_R")
    assert large.decoupling(ratio) == pytest.approx(1.0, rel=1e-4)


def test_the_commands_write_run_and_report(tmp_path, monkeypatch, quick):
    monkeypatch.chdir(tmp_path)
    write_table(tmp_path / "a.csv", seed=6, clusters=1, frames=3)
    run = CliRunner().invoke
    assert run(app, ["study", "new", "a.csv"]).exit_code == 0
    refused = run(app, ["study", "new", "a.csv"])
    assert refused.exit_code == 2
    assert "exists" in refused.output
    text = (tmp_path / "study.toml").read_text().replace("dt = 1.0", "dt = 0.7")
    (tmp_path / "study.toml").write_text("reports = false\n" + text)
    done = run(app, ["study", "run", "study.toml", "-o", "STUDY"])
    assert done.exit_code == 0, done.output
    assert "1 of 1 movies measured" in done.output
    again = run(app, ["study", "report", "STUDY", "--json"])
    assert json.loads(again.output)["movies"] == 1
    assert run(app, ["study", "report", "a.csv"]).exit_code == 2
    planned = run(
        app,
        ["study", "plan", "--half-width", "0.1", "--clusters", "10", "--spread-clusters", "0.2"],
    )
    assert "movies with 10 clusters" in planned.output


def test_workers_of_a_scheduler_give_the_same_results(tmp_path, quick):
    """Two workers measure three tables; the tables of both studies are equal to the last bit."""
    distributed = pytest.importorskip("distributed")
    names = [f"{number}.csv" for number in range(3)]
    for number, name in enumerate(names):
        write_table(tmp_path / name, seed=number, clusters=1, frames=3)
    (tmp_path / "bad.csv").write_text("frame,particle\n1,1\n")
    study = Study.from_toml(write_study(tmp_path, movies={0.1: [*names, "bad.csv"]}))
    study.run(tmp_path / "here")
    shown = []
    with distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        processes=False,
        protocol="tcp",
        dashboard_address="127.0.0.1:0",
    ) as cluster:
        study.run(
            tmp_path / "there",
            scheduler=cluster.scheduler_address,
            progress=lambda done, total, _: shown.append((done, total)),
        )
    first, second = ((tmp_path / p / "results.csv").read_bytes() for p in ("here", "there"))
    assert first == second
    assert shown[:5] == [(k, 4) for k in range(5)]
    assert "4/4" in (tmp_path / "there" / "study.log").read_text()


TOGETHER = threading.Barrier(3)


def measured_by_three(task):
    """Return an entry once three workers measure at the same time."""
    TOGETHER.wait(20)
    return Entry(task.movie.name, "done")


def test_workers_that_join_later_get_movies(tmp_path, monkeypatch):
    distributed = pytest.importorskip("distributed")
    monkeypatch.setattr(running, "measure_movie", measured_by_three)
    monkeypatch.setattr(running, "_SECONDS_BETWEEN_COUNTS", 0.0)
    movies = [StudyMovie(str(k), f"{k}.csv", "table", "s") for k in range(6)]
    with distributed.LocalCluster(
        n_workers=1,
        threads_per_worker=1,
        processes=False,
        protocol="tcp",
        dashboard_address="127.0.0.1:0",
    ) as cluster:
        found = measure_all(movies, tmp_path, scheduler=cluster.scheduler_address)
        cluster.scale(3)
        assert {entry.name for entry in found} == {movie.name for movie in movies}
