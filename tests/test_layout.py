"""The layout of the package: what an import loads, which subpackage imports which, the README."""

from __future__ import annotations

import importlib
import re
import runpy
import subprocess
import sys
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path
from types import ModuleType

import pandas as pd
import pytest

import perrin

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "src" / "perrin"

# A subpackage imports only subpackages of the lines above its own.
SUBPACKAGES = [
    {"compiled"},
    {"geometry"},
    {"hydrodynamics"},
    {"motion"},
    {"tracks", "curves"},
    {"diffusion"},
    {"images"},
    {"run"},
    {"movie"},
    {"plot"},
    {"report"},
    {"paper"},
    {"study"},
    {"cli"},
]
FLAT = {"_arrays", "_display", "_text", "errors"}
OLD_PATHS = {
    "rotations": "geometry.rotations",
    "shapes": "geometry.shapes",
    "files": "tracks.files",
    "identity": "tracks.identity",
    "grouping": "tracks.clusters",
}
LAZY = ("pandas", "scipy", "matplotlib", "pyarrow", "jinja2", "typer", "rich", "trackpy", "numba")
LAZY += ("tifffile", "liffile", "nd2", "czifile", "oiffile", "h5py", "zarr", "imagecodecs")


def loaded_after(*statements: str) -> list[set[str]]:
    """Return the modules loaded after each statement of one process."""
    code = "import sys\n" + "\n".join(f"{one}\nprint(*sys.modules)" for one in statements)
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    return [set(line.split()) for line in result.stdout.splitlines()]


def test_import_loads_numpy_alone():
    """`import perrin` and all its numerical names load numpy, no other package, nothing compiled.

    `import perrin` is under 250 modules; all names together add under 45 to numpy's own (which are
    173 to 217) and those of perrin.
    """
    drawing = (*perrin._FACES["report"], *perrin._FACES["study"])
    names = [n for n in perrin.__all__ if n not in drawing]
    alone, modules = loaded_after("import perrin", f"from perrin import {', '.join(names)}")
    assert len(alone) < 250
    (of_numpy,) = loaded_after("import numpy")
    more = modules - of_numpy
    assert sum(not m.startswith("perrin") for m in more) < 45
    assert modules.isdisjoint(LAZY)
    assert "perrin.compiled.kernels" not in modules


def test_help_loads_no_numerical_package():
    """`perrin --help` imports the parser of its options, and no numpy, pandas or matplotlib."""
    (modules,) = loaded_after("sys.argv = ['perrin']; from perrin.cli import main")
    assert modules.isdisjoint(set(LAZY) - {"typer", "rich"})
    assert len(modules) < 450


def test_public_names_are_the_ones_listed():
    """The table, __all__ and the typing block agree, and each name is its subpackage's too."""
    assert sorted(n for names in perrin._FACES.values() for n in names) == sorted(perrin.__all__)
    assert dir(perrin) == sorted(perrin.__all__)
    block = re.findall(
        r"    from perrin\.(\w+) import (?:\(([^)]*)\)|(.*))", (SOURCE / "__init__.py").read_text()
    )
    typed = {face: set(re.findall(r"\w+", many or few)) for face, many, few in block}
    assert typed == {face: set(names) for face, names in perrin._FACES.items() if names}
    for face, names in perrin._FACES.items():
        module = importlib.import_module(f"perrin.{face}")
        for name in names:
            assert getattr(perrin, name) is getattr(module, name)
            assert name in getattr(module, "__all__", names)
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = perrin.nonsense


def test_every_subpackage_is_an_attribute():
    """After `import perrin` alone, `perrin.plot` and the others are imported when first used."""
    for name in sorted(set().union(*SUBPACKAGES)):
        assert perrin.__getattr__(name) is importlib.import_module(f"perrin.{name}")
    # One that imports no other shows in a process of its own that nothing had to import it before.
    before, after = loaded_after("import perrin", "perrin.geometry")
    assert "perrin.geometry" not in before
    assert "perrin.geometry" in after


def test_names_survive_the_import_of_every_module():
    """No module has the name of a public name: importing it would replace the function."""
    modules = [f"perrin.{module_of(p)}" for p in SOURCES if module_of(p) not in OLD_PATHS]
    for module in modules:
        importlib.import_module(module)
    for face, names in perrin._FACES.items():
        for name in names:
            for owner in (perrin, importlib.import_module(f"perrin.{face}")):
                assert not isinstance(getattr(owner, name), ModuleType)


@pytest.mark.parametrize(("old", "new"), OLD_PATHS.items())
def test_old_paths_work_and_warn(old, new):
    """A module that users may have imported by its old path gives the same objects, and warns."""
    sys.modules.pop(f"perrin.{old}", None)
    with pytest.warns(DeprecationWarning, match=rf"perrin\.{old} has moved to perrin\.{new}"):
        module = importlib.import_module(f"perrin.{old}")
    here = importlib.import_module(f"perrin.{new}")
    for name, value in vars(here).items():
        if getattr(value, "__module__", None) == here.__name__ and not name.startswith("_"):
            assert getattr(module, name) is value


@cache
def imports_of(path: Path) -> set[str]:
    """Return every module that a file imports, anywhere in it."""
    statement = r"^ *(?:from|import) +([\w.]+)"
    # The program of another process, which is text here, imports the module that holds it.
    return set(re.findall(statement, path.read_text(), re.MULTILINE)) - {
        f"perrin.{module_of(path)}"
    }


def module_of(path: Path) -> str:
    """Return the name of a file's module: "tracks.files"."""
    return ".".join(path.relative_to(SOURCE).with_suffix("").parts)


SOURCES = [p for p in SOURCE.rglob("*.py") if p.stem not in ("__init__", "__main__")]


def test_subpackages_import_only_those_above_them():
    """The import rule of ARCHITECTURE.md; and only the listed modules lie outside a subpackage."""
    assert {module_of(p) for p in SOURCES if p.parent == SOURCE} == FLAT | set(OLD_PATHS)
    level = {name: number for number, line in enumerate(SUBPACKAGES) for name in line}
    for path in SOURCES:
        subpackage, *inside = module_of(path).split(".")
        for module in imports_of(path):
            used = module.split(".")[1] if module.startswith("perrin.") else subpackage
            if inside and used not in FLAT:
                assert used == subpackage or level[used] < level[subpackage], path
            elif subpackage in FLAT:
                assert used in FLAT, path


def test_architecture_names_every_module():
    """The tree of ARCHITECTURE.md holds every module of the package."""
    tree = (ROOT / "ARCHITECTURE.md").read_text().split("```")[1]
    named = set(re.findall(r"(\w+)\.py", tree))
    modules = {p.stem for p in SOURCES if module_of(p) not in OLD_PATHS}
    assert modules == named - {"__init__"}


def test_imports_have_no_cycle():
    """The modules can be sorted so that each imports only modules before it."""
    names = {f"perrin.{module_of(p)}": p for p in SOURCES}
    TopologicalSorter({name: imports_of(p) & set(names) for name, p in names.items()}).prepare()


def test_only_plot_imports_matplotlib():
    """No other subpackage imports matplotlib, but to annotate a figure."""
    for path in SOURCES:
        imported = {m for m in imports_of(path) if m.startswith("matplotlib")}
        if not module_of(path).startswith("plot."):
            assert imported <= {"matplotlib.figure", "matplotlib.axes"}, path


def test_the_readme_code_runs(tmp_path, monkeypatch, capsys):
    """The README's Python example runs unchanged and prints the output on the page."""
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
