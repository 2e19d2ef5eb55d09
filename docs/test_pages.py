"""The code of the README, of the pages and of the notebooks runs, and prints what is shown.

`make doctests` runs it; it is no part of the suite in `tests`.
"""

import doctest
import json
import re
import shlex
from pathlib import Path

import pytest
from typer.testing import CliRunner

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", DOCS / "conventions.md", DOCS / "tables.md", DOCS / "dense.md"]
PAGES += [DOCS / "stacks.md", DOCS / "index.md", DOCS / "reference" / "files.md"]
for folder in ("start", "howto", "theory", "tutorials", "coming-from"):
    PAGES += sorted((DOCS / folder).glob("*.md"))
PAGES = [page for page in PAGES if re.search(r"^```(python|sh)$", page.read_text("utf-8"), re.M)]
NOTEBOOKS = sorted((ROOT / "examples").glob("*.ipynb"))
BOX = re.compile(r"^```(python|sh)\n(.*?)^```\n(?:\n?```(?:text)?\n(.*?)^```\n)?", re.DOTALL | re.M)

# Pages whose numbers are compared with --long only: each takes over 10 s.
SLOW = ("dense", "estimators", "curves")
# Beginnings of commands that install or start something, or need a network or a cluster.
NOT_RUN = ("pip", "python", ".venv/bin/pip", "make", "git", "cd", "sleep", "kill", "napari")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: f"{page.parent.name}-{page.stem}")
def test_pages_print_what_they_show(page, capsys, request, tmp_path, monkeypatch):
    """A page has doctests, or blocks of code whose output follows in a box or as comments.

    Without --long a slow page has a tenth of its repeats, or fewer and shorter tracks, and is only
    run.
    """
    monkeypatch.chdir(tmp_path)
    text, names = page.read_text(encoding="utf-8"), {}
    slow = page.stem in SLOW and not request.config.getoption("--long", default=False)
    if slow:
        text = re.sub(r"\brange\((\d+)0\)", r"range(\1)", text)
        text = text.replace("n_frames = 1000\n", "n_frames = 200\n").replace("size=6", "size=4")
    if ">>>" in text:
        if slow:
            for example in doctest.DocTestParser().get_examples(text):
                exec(compile(example.source, page.name, "single"), names)
            return
        result = doctest.testfile(str(page), module_relative=False)
        assert result.attempted > 0
        assert result.failed == 0, capsys.readouterr().out
        return
    blocks = BOX.findall(text)
    commands = "".join(code for language, code, _ in blocks if language == "sh")
    if "perrin-demo/" in text and "perrin demo" not in commands and "make demo" not in commands:
        run_command("perrin demo --quiet")
    for language, code, box in blocks:
        if language == "sh":
            run_block(code)
            capsys.readouterr()
            continue
        exec(compile(code, page.name, "exec"), names)
        promised = box.splitlines() if box else re.findall(r"^# (.*)$", code, re.MULTILINE)
        printed = capsys.readouterr().out.splitlines()
        assert slow or printed == promised


def run_block(code):
    """Run the lines of a block for a shell that are commands of perrin and need nothing else."""
    for line in code.replace("\\\n", " ").splitlines():
        command = line.split("  #")[0].strip().removeprefix(".venv/bin/")
        if not command or command.startswith(("#", *NOT_RUN)):
            if command.startswith("make demo"):
                run_command("perrin demo --quiet")
            continue
        assert command.startswith("perrin "), f"not a command that is known: {line}"
        # Lines with a scheduler have a test below.
        if "--scheduler" not in command and not missing_file(command):
            run_command(re.sub(r"--workers \d+", "--workers 2", command))


def missing_file(command):
    """Return whether a command takes a file of the reader, which is not here."""
    words = shlex.split(command)
    takes_file = words[1] in ("analyze", "run", "convert") and "--config" not in words
    return takes_file and not Path(words[2]).exists()


def run_command(command):
    """Run a command of perrin in this process."""
    from perrin.cli.app import app

    result = CliRunner().invoke(app, shlex.split(command)[1:])
    assert result.exit_code == 0, f"{command}\n{result.output}\n{result.exception!r}"


@pytest.fixture(scope="module")
def address():
    """Start a scheduler with one worker, a process of its own, as on another machine."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, host="127.0.0.1", dashboard_address="127.0.0.1:0"
    ) as cluster:
        yield cluster.scheduler_address


def test_lines_with_a_scheduler_run(address, tmp_path, monkeypatch):
    """Every command with --scheduler in the pages, on a small movie and a study of one table."""
    from perrin import (
        Cluster,
        add_noise,
        positions_table,
        render_stack,
        simulate_motion,
        write_stack,
    )

    monkeypatch.chdir(tmp_path)
    commands = {
        re.sub(r'--scheduler ("[^"]*"|\S+)', f"--scheduler {address}", line)
        for page in sorted(DOCS.rglob("*.md"))
        if "_build" not in page.parts
        for _, code, _ in BOX.findall(page.read_text(encoding="utf-8"))
        for line in code.replace("\\\n", " ").splitlines()
        if "--scheduler" in line
    }
    assert {command.split(" -o ")[0] for command in commands} == {
        "perrin run /shared/movie.ome.tif --diameter 2.45 --contact 2.45",
        "perrin study run study.toml",
    }
    body = Cluster.touching(3, diameter=2.45)
    truth = simulate_motion(body, D_R=5e-3, D_T=0.004, dt=0.73, n_frames=205, rng=1)
    movie = render_stack(
        truth.positions()[:3], dt=0.73, centers=[(4.0, 4.0, 4.4)], voxel=(0.4, 0.3, 0.3),
        shape=(22, 28, 28), diameter=2.45, psf=(0.4, 0.15, 0.15), photons=40, rng=1,
    )  # fmt: skip
    write_stack(movie, "movie.ome.tif")
    noisy = add_noise(truth.positions(), sigma=0.03, rng=2)
    positions_table(noisy).to_csv("a.csv", index=False)
    Path("study.toml").write_text(
        'reports = false\n[defaults]\ndt = 0.73\n[[sample]]\nfiles = ["a.csv"]\n', encoding="utf-8"
    )
    # Figures are drawn by the command itself, not by the workers, and take a third of the time.
    for name in ("save_figures", "save_image_figures"):
        monkeypatch.setattr(f"perrin.report.write.{name}", lambda *_, **__: [])
    for command in sorted(commands):
        run_command(command.replace("/shared/", ""))
    assert Path("my-run", "report.html").is_file()
    assert Path("STUDY", "study.html").is_file()


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda notebook: notebook.stem)
def test_notebooks_run_from_top_to_bottom(notebook, tmp_path, monkeypatch):
    """Every cell of code runs, in order, in an empty folder."""
    import matplotlib as mpl

    mpl.use("agg")
    monkeypatch.chdir(tmp_path)
    names = {}
    for cell in json.loads(notebook.read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), notebook.name, "exec"), names)
    assert len(names) > 5


def test_the_page_on_studies_runs(tmp_path, monkeypatch, capsys):
    """Its commands and its Python lines run on the manifest of the page, with two workers.

    The files are tables of one tetrahedron each, without figures and pages.
    """
    from perrin import Cluster, Study, add_noise, positions_table, simulate_motion

    monkeypatch.chdir(tmp_path)
    text = (DOCS / "study.md").read_text(encoding="utf-8")
    for k, name in enumerate(("monday/a.csv", "monday/b.csv", "tuesday/c.csv", "data/a.csv")):
        Path(name).parent.mkdir(exist_ok=True)
        body = Cluster.touching(4, 2.45)
        truth = simulate_motion(body, D_R=8e-3, D_T=0.03, dt=0.73, n_frames=40, rng=k)
        table = positions_table(add_noise(truth.positions(), sigma=0.03, rng=k + 10))
        table.assign(cluster=3).to_csv(name, index=False)
    blocks = re.findall(r"^```(sh|toml|python)\n(.*?)^```", text, re.DOTALL | re.M)
    assert [language for language, _ in blocks] == ["sh", "toml", "sh", "python", "python"]
    new, manifest, run, python, plan = (code for _, code in blocks)
    run_block(new.replace("data/*.csv", "data/a.csv"))
    assert [m.sample for m in Study.from_toml("study.toml").manifest.movies] == ["a"]
    Path("study.toml").write_text("reports = false\n" + manifest, encoding="utf-8")
    run_block(run)
    assert Path("STUDY/study.html").is_file()
    names = {"__name__": "__main__"}
    capsys.readouterr()
    exec(compile(python.replace("workers=8", "workers=0"), "study.md", "exec"), names)
    # The cluster of the second sample is excluded.
    assert set(names["table"]["sample"].dropna()) == {"dilute", "dense"}
    assert "D_R" in capsys.readouterr().out
    exec(compile(plan, "study.md", "exec"), {})
