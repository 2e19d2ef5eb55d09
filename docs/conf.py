"""Sphinx settings; `make docs` builds into docs/_build/html."""

from importlib.metadata import version as installed_version

project = "perrin"
author = "The perrin developers"
copyright = "2026, The perrin developers"
release = version = installed_version("perrin")

extensions = [
    "myst_parser",
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.mathjax",
    "sphinx.ext.viewcode",
]
myst_enable_extensions = ["dollarmath"]
numpydoc_show_class_members = False
autodoc_typehints = "none"  # the docstrings carry types with shapes
exclude_patterns = ["_build"]
html_theme = "alabaster"
