"""Run folders with figures, and HTML pages that need no other file."""

from perrin.report.html import byline, captioned, inline_pictures, render_page
from perrin.report.imaging_page import (
    brightness_facts,
    fit_facts,
    optics_facts,
    render_imaging_quality,
    rigid_body_facts,
)
from perrin.report.page import noise_facts, render_html
from perrin.report.write import complete_run, write_run

__all__ = [
    "brightness_facts",
    "byline",
    "captioned",
    "complete_run",
    "fit_facts",
    "inline_pictures",
    "noise_facts",
    "optics_facts",
    "render_html",
    "render_imaging_quality",
    "render_page",
    "rigid_body_facts",
    "write_run",
]
