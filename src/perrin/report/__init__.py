"""Run folders with figures, and HTML pages that need no other file."""

from perrin.report.citations import folder_links, methods_paragraph, software_bibtex
from perrin.report.embedding import packed, page_script, plotly_script, source_hash
from perrin.report.figure_data import body_picture, cluster_data, grouped_tracks
from perrin.report.html import byline, captioned, inline_pictures, render_page, render_part
from perrin.report.imaging_page import (
    brightness_facts,
    fit_facts,
    optics_facts,
    render_imaging_quality,
    rigid_body_facts,
)
from perrin.report.page import noise_facts, render_html
from perrin.report.write import complete_run, run_folder, write_run

__all__ = [
    "body_picture",
    "brightness_facts",
    "byline",
    "captioned",
    "cluster_data",
    "complete_run",
    "fit_facts",
    "folder_links",
    "grouped_tracks",
    "inline_pictures",
    "methods_paragraph",
    "noise_facts",
    "optics_facts",
    "packed",
    "page_script",
    "plotly_script",
    "render_html",
    "render_imaging_quality",
    "render_page",
    "render_part",
    "rigid_body_facts",
    "run_folder",
    "software_bibtex",
    "source_hash",
    "write_run",
]
