"""Sphinx settings; `make docs` builds into docs/_build/html, and a warning is an error."""

import os
import sys
from importlib.metadata import version as installed_version
from pathlib import Path

import sphinx.ext.autosummary

sys.path.insert(0, str(Path(__file__).parent / "_extensions"))
from figure_texts import described_figures

for threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(threads, "1")  # scripts of the gallery are small: threads only wait

project = "perrin"
author = "The perrin developers"
copyright = "2026, The perrin developers"
release = version = installed_version("perrin")

extensions = [
    "myst_parser",
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.mathjax",
    "sphinx_copybutton",
    "sphinx_design",
    "sphinx_gallery.gen_gallery",
    "reference_pages",
    "glossary_links",
    "local_mathjax",
]
exclude_patterns = ["_build", "gallery_scripts", "_extensions", "tutorials/examples/index.rst"]
smartquotes = False  # options begin with two hyphens
highlight_language = "none"  # a block without a language is output
suppress_warnings = ["config.cache"]  # the settings of the gallery hold a class

myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3

autosummary_generate = True
# A first sentence does not end after these.
sphinx.ext.autosummary.WELL_KNOWN_ABBREVIATIONS += ("Eq.", "Eqs.", "Fig.", " .")
autodoc_typehints = "none"  # the docstrings carry types with shapes
autodoc_member_order = "groupwise"
default_role = "py:obj"  # names in single backticks are links where they have a page
toc_object_entries_show_parents = "hide"
numpydoc_show_class_members = False

sphinx_gallery_conf = {
    "examples_dirs": ["gallery_scripts", "../examples"],
    "gallery_dirs": ["gallery", "tutorials/examples"],
    "filename_pattern": r"\.py$",
    "ignore_pattern": "make_demo_table",
    "within_subsection_order": "FileNameSortKey",
    "copyfile_regex": r".*\.ipynb",
    "backreferences_dir": "reference/backreferences",
    "doc_module": ("perrin",),
    "download_all_examples": False,
    "show_memory": False,
    "show_signature": False,
    "write_computation_times": False,
    "min_reported_time": 1e9,
    "plot_gallery": True,
    "thumbnail_size": (480, 336),
    "image_scrapers": (described_figures,),
    "remove_config_comments": True,
}

copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True

templates_path = ["_templates"]
html_static_path = ["_static"]
html_css_files = ["perrin.css"]
html_theme = "pydata_sphinx_theme"
html_title = "perrin"
html_logo = html_favicon = "_static/perrin.svg"
html_show_sourcelink = False
html_copy_source = False
html_theme_options = {
    "logo": {"text": "perrin"},
    "header_links_before_dropdown": 8,
    "navbar_align": "left",
    "navbar_end": ["theme-switcher"],
    "show_toc_level": 2,
    "navigation_with_keys": False,
    "back_to_top_button": True,
    "footer_start": ["copyright"],
    "footer_end": [],
    "pygments_light_style": "a11y-high-contrast-light",
    "pygments_dark_style": "a11y-high-contrast-dark",
}
html_sidebars = {"index": [], "glossary": []}
