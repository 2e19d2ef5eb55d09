"""Formulas without a network: MathJax comes from a package and lies in one file of the site."""

import shutil
from importlib.metadata import files
from pathlib import Path

NAME = "mathjax/tex-svg.js"  # draws formulas as SVG, so it loads no fonts


def copy_mathjax(app):
    """Copy the file from the package sphinx-mathjax-offline, which holds MathJax 3."""
    if app.builder.format != "html":
        return
    (source,) = [file for file in files("sphinx-mathjax-offline") if file.match(f"*/{NAME}")]
    target = Path(app.outdir, "_static", NAME)
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source.locate(), target)


def setup(app):
    """Register the copy, and the path of the script."""
    app.connect("builder-inited", copy_mathjax)
    app.config.mathjax_path = NAME
    return {"parallel_read_safe": True, "parallel_write_safe": True}
