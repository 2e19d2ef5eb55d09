"""Run folders with figures, and HTML pages that need no other file."""

from perrin.report.citations import folder_links, methods_paragraph, software_bibtex
from perrin.report.embedding import packed, page_script, plotly_script, source_hash
from perrin.report.figure_data import body_picture, cluster_data, grouped_tracks
from perrin.report.html import (
    byline,
    captioned,
    inline_pictures,
    render_page,
    render_part,
    symbols,
    write_page,
)
from perrin.report.imaging_page import (
    brightness_facts,
    fit_facts,
    optics_facts,
    render_imaging_quality,
    rigid_body_facts,
)
from perrin.report.overview import kind_rows, overview_data, overview_row, pooled_texts, remark_rows
from perrin.report.page import render_html
from perrin.report.result_texts import (
    body_texts,
    cluster_texts,
    coefficient_texts,
    estimate_texts,
    named_coefficients,
    noise_facts,
    prediction_texts,
    rod_texts,
    tensor_texts,
)
from perrin.report.write import complete_run, run_folder, write_run

__all__ = [
    "body_picture",
    "body_texts",
    "brightness_facts",
    "byline",
    "captioned",
    "cluster_data",
    "cluster_texts",
    "coefficient_texts",
    "complete_run",
    "estimate_texts",
    "fit_facts",
    "folder_links",
    "grouped_tracks",
    "inline_pictures",
    "kind_rows",
    "methods_paragraph",
    "named_coefficients",
    "noise_facts",
    "optics_facts",
    "overview_data",
    "overview_row",
    "packed",
    "page_script",
    "plotly_script",
    "pooled_texts",
    "prediction_texts",
    "remark_rows",
    "render_html",
    "render_imaging_quality",
    "render_page",
    "render_part",
    "rigid_body_facts",
    "rod_texts",
    "run_folder",
    "software_bibtex",
    "source_hash",
    "symbols",
    "tensor_texts",
    "write_page",
    "write_run",
]
