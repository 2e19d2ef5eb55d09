"""Run folders with pictures and self-contained HTML pages."""

from perrin.report.html import byline, captioned, inline_pictures, render_page
from perrin.report.imaging_page import render_quality
from perrin.report.page import render_html
from perrin.report.write import complete_run, write_run

__all__ = [
    "byline",
    "captioned",
    "complete_run",
    "inline_pictures",
    "render_html",
    "render_page",
    "render_quality",
    "write_run",
]
