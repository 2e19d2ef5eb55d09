"""Compile the kernels of `perrin.compiled` when perrin is built, if there is a compiler.

Without one (or without the headers of Python) the build succeeds, says so in one line, and perrin
uses numpy instead. ``python hatch_build.py`` compiles them in place, for a source tree.
"""

from __future__ import annotations

import sys
import sysconfig
import tempfile
from pathlib import Path
from shutil import copyfile
from textwrap import shorten
from typing import Any

try:
    from hatchling.builders.hooks.plugin.interface import BuildHookInterface
except ModuleNotFoundError:  # run as a program, without the build backend
    BuildHookInterface = object

FOLDER = Path("src") / "perrin" / "compiled"


def compile_kernels(root: Path) -> Path:
    """Compile kernels.c beside itself, for the stable ABI, and return the file.

    Raises
    ------
    Exception
        Of setuptools, if there is no compiler, or if it fails.
    """
    from setuptools import Distribution, Extension
    from setuptools.command.build_ext import build_ext

    folder = root / FOLDER
    # Contracted multiplications would round differently on different machines.
    gnu = ["-O3", "-fno-math-errno", "-ffp-contract=off", "-Wno-psabi"]
    options = [] if sys.platform == "win32" else gnu
    extension = Extension(
        "kernels", [str(folder / "kernels.c")], extra_compile_args=options, py_limited_api=True
    )
    command = build_ext(Distribution({"name": "kernels", "ext_modules": [extension]}))
    with tempfile.TemporaryDirectory() as scratch:
        command.build_lib, command.build_temp = scratch, scratch
        command.ensure_finalized()
        command.run()
        built = Path(command.get_ext_fullpath("kernels"))
        return Path(copyfile(built, folder / built.name))


def kernels_or_reason(root: Path) -> tuple[Path | None, str]:
    """Return the compiled kernels, or None and why there are none; older ones are removed."""
    for suffix in ("so", "pyd"):
        for old in (root / FOLDER).glob(f"kernels*.{suffix}"):
            old.unlink()
    try:
        return compile_kernels(root), ""
    except Exception as fault:  # whatever a compiler does wrong, perrin works without it
        return None, shorten(str(fault), 100)


def in_words(reason: str) -> str:
    """Return the line that is printed where there are no kernels."""
    return f"perrin is built without compiled kernels, numpy does their work: {reason}"


class CompiledKernels(BuildHookInterface):
    """The build hook of hatchling."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:  # noqa: ARG002
        """Compile the kernels and mark the wheel as one for this platform."""
        built, reason = kernels_or_reason(Path(self.root))
        if built is None:
            self.app.display_warning(in_words(reason))
            return
        build_data["artifacts"].append(f"/{(FOLDER / built.name).as_posix()}")
        build_data["pure_python"] = False
        platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
        build_data["tag"] = f"cp311-abi3-{platform}"


if __name__ == "__main__":
    built, reason = kernels_or_reason(Path(__file__).resolve().parent)
    print(built or in_words(reason))
