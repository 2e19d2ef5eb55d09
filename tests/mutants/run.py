"""Change the source in small ways and count the changes that no test notices.

``python tests/mutants/run.py --only steps --count 100`` takes a random choice, with a fixed seed,
of the changes in changes.py, runs the tests of targets.toml on each in a process of its own until
one fails, and lists the changes with which all of them pass. A change whose tests take three times
as long as without it counts as noticed. The program is not started anew for every change, as by
cosmic-ray, which takes most of the time.

Survivors that cannot change a result, or change only speed, are in explained.toml with the reason.
The status is 1 where a target has 10 % or more survivors that are not explained there.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import importlib.abc
import importlib.util
import os
import signal
import sys
import tempfile
import time
import tomllib
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
sys.path.insert(0, str(HERE))

from changes import changed, sample

_LIMIT = 0.1  # of the changes may survive
_LOADED_ONCE = (
    "numpy", "scipy.linalg", "scipy.optimize", "scipy.stats", "scipy.spatial", "scipy.special",
    "scipy.interpolate", "scipy.ndimage", "pandas", "pytest", "hypothesis",
)  # fmt: skip


class Changed(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Imports one module from a tree instead of its file."""

    def __init__(self, name: str, path: Path, tree: ast.Module) -> None:
        self.name, self.path, self.tree = name, path, tree

    def find_spec(self, name, path, target=None):
        """Return the specification of the module, and nothing for all others."""
        if name == self.name:
            return importlib.util.spec_from_file_location(name, self.path, loader=self)
        return None

    def exec_module(self, module) -> None:
        """Execute the changed module."""
        exec(compile(self.tree, self.path, "exec"), module.__dict__)

    def create_module(self, spec) -> None:
        """Leave the module to the import system."""


def passes(module: str, tree: ast.Module, tests: list[str], *, limit: float) -> tuple[bool, float]:
    """Run tests with a changed module in another process: whether all pass, and the time in s."""
    start = time.monotonic()
    child = os.fork()
    if child == 0:
        os.setsid()
        quiet = os.open(os.devnull, os.O_RDWR)
        for stream in (0, 1, 2):
            os.dup2(quiet, stream)
        name = "perrin." + module.removesuffix(".py").replace("/", ".")
        sys.meta_path.insert(0, Changed(name, ROOT / "src" / "perrin" / module, tree))
        status = 3
        try:
            import pytest

            # Assertions need no explanation here, so that pytest does not rewrite them; to collect
            # garbage for its warnings takes longer than many tests.
            plugins = ("cacheprovider", "xdist", "unraisableexception")
            options = ["-x", "-q", "--assert=plain", *(f"-pno:{name}" for name in plugins)]
            status = int(pytest.main([*options, "--doctest-modules", *tests]))
        finally:
            os._exit(status)
    status = None
    while status is None:
        time.sleep(0.02)
        done, how = os.waitpid(child, os.WNOHANG)
        if done:
            status = os.waitstatus_to_exitcode(how)
        elif time.monotonic() - start > limit:
            os.killpg(child, signal.SIGKILL)
            os.waitpid(child, 0)
            status = -int(signal.SIGKILL)
    return status == 0, time.monotonic() - start


def explained_changes() -> set[str]:
    """Return the texts of all changes in explained.toml, with their modules."""
    reasons = tomllib.loads((HERE / "explained.toml").read_text(encoding="utf-8"))["explained"]
    return {f"{one['module']}: {change}" for one in reasons for change in one["changes"]}


def survivors_of(module: str, tests: list[str], *, count: int, seed: int, verbose: bool):
    """Return how many changes of a module were tried, are not noticed, and are not explained."""
    source = (ROOT / "src" / "perrin" / module).read_text(encoding="utf-8")
    fine, usual = passes(module, ast.parse(source), tests, limit=3600)
    if not fine:
        raise SystemExit(f"{module}: its tests fail without a change; nothing can be measured")
    print(f"{module}: the tests take {usual:.0f} s", flush=True)
    chosen = sample(source, count, seed=seed)
    explained, lines = explained_changes(), source.splitlines()
    surviving = unexplained = 0
    for number, change in enumerate(chosen, 1):
        survives, took = passes(module, changed(source, change), tests, limit=3 * usual + 10)
        text = (
            f"{change.where} | {lines[change.line - 1].strip()} | {change.before} -> {change.after}"
        )
        known = survives and f"{module}: {text}" in explained
        surviving += survives
        unexplained += survives and not known
        if survives or verbose:
            word = "is explained" if known else "survives" if survives else "is noticed"
            print(f"  {number}/{len(chosen)} {word} ({took:.0f} s) {text}", flush=True)
    return len(chosen), surviving, unexplained


def main() -> int:
    """Read the options, load the libraries and return the status of the measurement."""
    targets = tomllib.loads((HERE / "targets.toml").read_text(encoding="utf-8"))
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default=",".join(targets), help="targets, with commas between")
    parser.add_argument("--count", type=int, default=100, help="changes of each target")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--verbose", action="store_true", help="print noticed changes too")
    options = parser.parse_args()
    os.chdir(ROOT)
    os.environ["OMP_NUM_THREADS"] = "1"
    os.environ["PYTHONPATH"] = str(ROOT / "src")
    sys.path.insert(0, str(ROOT / "src"))
    for name in _LOADED_ONCE:
        importlib.import_module(name)
    with tempfile.TemporaryDirectory() as compiled:
        # All modules but the changed one are compiled once, by the first run.
        sys.pycache_prefix, sys.dont_write_bytecode = compiled, False
        return measure(targets, options)


def measure(targets: dict[str, dict[str, list[str]]], options: argparse.Namespace) -> int:
    """Measure the chosen targets, print a line for each, and return the status."""
    lines, too_many = [], False
    for name in options.only.split(","):
        target = targets[name]
        counts = [0, 0, 0]
        for module in target["modules"]:
            tests = [f"src/perrin/{module}", *(f"tests/{test}" for test in target["tests"])]
            share = -(-options.count // len(target["modules"]))
            of_module = survivors_of(
                module, tests, count=share, seed=options.seed, verbose=options.verbose
            )
            counts = [a + b for a, b in zip(counts, of_module, strict=True)]
        tried, surviving, rest = counts
        too_many |= rest >= _LIMIT * tried
        lines.append(f"| {name} | {tried} | {surviving} | {rest} | {rest / tried:.1%} |")
    head = "\n| target | changes | survive | not explained | share |\n|---|---|---|---|---|"
    print(head, *lines, sep="\n")
    return int(too_many)


if __name__ == "__main__":
    sys.exit(main())
