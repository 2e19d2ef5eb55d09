"""The command line without pictures, which says when it begins: ``python drive.py run ...``."""

import os
import sys
from pathlib import Path

import perrin.report.write as pages
import perrin.study.writing as study_pages
from perrin.cli.app import main


def no_figures(_, folder, **__):
    """Make the folder of the figures."""
    Path(folder).mkdir(exist_ok=True)
    return []


def without_pictures():
    """Let runs write their data, and pages without content."""
    pages.save_figures = pages.save_image_figures = no_figures
    pages.render_html = pages.render_imaging_quality = lambda *_, **__: "<html></html>"
    study_pages.save_study_figures, study_pages.render_study = no_figures, pages.render_html


if __name__ == "__main__":
    without_pictures()
    if "READY" in os.environ:
        Path(os.environ["READY"]).touch()
    sys.argv[0] = "perrin"
    main()
