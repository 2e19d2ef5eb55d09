"""The doors of the house: what an import costs, who imports whom, that the README is true."""

from __future__ import annotations

import ast
import re
import runpy
import subprocess
import sys
import time
from pathlib import Path

import pandas as pd
import pytest

import perrin

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "src" / "perrin"

# The house, top to bottom: a room imports only rooms above it.
ROOMS = [
    "_text",
    "_units",
    "_arrays",
    "clock",
    "rotations",
    "shapes",
    "noise",
    "motion",
    "identity",
    "rods",
    "bonds",
    "linking",
    "screening",
    "grouping",
    "residuals",
    "quality",
    "pairs",
    "lagged",
    "quaternions",
    "steps",
    "likelihood",
    "scatter",
    "moments",
    "diffusion",
    "step_tests",
    "rod_diffusion",
    "curve_fits",
    "tensor_likelihood",
    "tensors",
    "bounds",
    "sampling",
    "resistance",
    "mobility",
    "hydrodynamics",
    "predictions",
    "surroundings",
    "simulate",
    "gdf",
    "column_names",
    "files",
    "remarks",
    "images.contents",
    "images.tiff",
    "images.vendors",
    "images.stacks",
    "images.render",
    "images.sphere_image",
    "images.image_fit",
    "images.crowd_light",
    "images.crowd",
    "images.conventional",
    "images.features",
    "images.optics",
    "images.locate",
    "images.poses",
    "images.parts",
    "images.workers",
    "images.stages",
    "images.bodies",
    "images.checks",
    "images.imaging",
    "results",
    "analysis",
    "images.run",
    "plot",
    "plot_images",
    "pages",
    "quality_page",
    "report",
    "claims",
    "paper_method",
    "paper_noise",
    "paper_orientations",
    "paper_experiment",
    "paper",
    "options",
    "cli",
]
LAZY = ("pandas", "scipy", "matplotlib", "pyarrow", "jinja2", "typer", "rich", "trackpy", "numba")
LAZY += ("tifffile", "liffile", "nd2", "pylibCZIrw", "h5py", "zarr")


def loaded_after(statement: str) -> set[str]:
    code = f"{statement}\nimport sys\nprint(*sys.modules)"
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    return set(result.stdout.split())


def test_import_is_light():
    """`import perrin` and all numerical names load numpy alone.

    `import perrin` is under 250 modules; all names together add under 45 to numpy's own (which are
    173 to 217) and our rooms.
    """
    assert len(loaded_after("import perrin")) < 250
    names = [n for n in perrin.__all__ if n != "write_run"]
    modules = loaded_after(f"from perrin import {', '.join(names)}")
    more = modules - loaded_after("import numpy")
    assert sum(not m.startswith("perrin") for m in more) < 45
    assert modules.isdisjoint(LAZY)


def test_public_names_are_the_ones_listed():
    """Every name in __all__ loads, its room is the one listed, and no other name is invented."""
    assert sorted(n for names in perrin._ROOMS.values() for n in names) == sorted(perrin.__all__)
    for room, names in perrin._ROOMS.items():
        for name in names:
            assert getattr(perrin, name).__module__ == f"perrin.{room}"
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = perrin.nonsense


def imports_of(path: Path) -> set[str]:
    """Return every module that a file imports, anywhere in it."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module)
    return found


def room_of(path: Path) -> str:
    """Return the name of a file's room: "files", or "images.stacks" in the wing of images."""
    return ".".join(path.relative_to(SOURCE).with_suffix("").parts)


def test_rooms_import_only_rooms_above_them():
    """The import rule of ARCHITECTURE.md, and that every room is on the list."""
    assert {room_of(p) for p in SOURCE.rglob("*.py") if p.stem != "__init__"} == set(ROOMS)
    for place, room in enumerate(ROOMS):
        modules = imports_of(SOURCE / f"{room.replace('.', '/')}.py")
        used = {m.removeprefix("perrin.") for m in modules if m.startswith("perrin.")}
        assert used <= set(ROOMS[:place]), room


def test_only_the_rooms_of_pictures_import_matplotlib():
    """Pictures stand at the door: no other room knows matplotlib."""
    sources = SOURCE.rglob("*.py")
    users = {room_of(p) for p in sources if any("matplotlib" in m for m in imports_of(p))}
    assert users == {"plot", "plot_images"}


def test_help_answers_at_once():
    """`perrin --help` takes under 0.4 s (the best of five: the machine may be busy).

    As the installed command runs it, from the compiled module.
    """
    durations = []
    command = [sys.executable, "-c", "from perrin.cli import main; main()", "--help"]
    for _ in range(5):
        start = time.perf_counter()
        subprocess.run(command, capture_output=True, check=True)
        durations.append(time.perf_counter() - start)
    assert min(durations) < 0.4


def test_the_readme_code_runs(tmp_path, monkeypatch, capsys):
    """The README's Python example runs as it stands and prints what it says."""
    monkeypatch.chdir(tmp_path)
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    exec(compile(code, "README.md", "exec"), {})
    printed = capsys.readouterr().out
    promised = re.findall(r"^# (D_[RT] = .*)$", code, re.MULTILINE)
    assert promised
    for line in promised:
        assert line in printed


def test_the_demo_table_is_remade_by_its_recipe():
    """The embedded table is what examples/make_demo_table.py makes, to the last digit."""
    remade = runpy.run_path(str(ROOT / "examples" / "make_demo_table.py"))["demo_table"]()
    embedded = perrin.read_tracks(SOURCE / "data" / "demo_tracks.csv.gz")
    pd.testing.assert_frame_equal(embedded, remade[list(embedded)], check_exact=True)
