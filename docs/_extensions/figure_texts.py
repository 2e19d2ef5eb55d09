"""Texts of the figures that scripts draw, for readers who do not see them."""

import re
from pathlib import Path

from sphinx_gallery.scrapers import matplotlib_scraper

STATED = re.compile(r'^# sphinx_gallery_alt = "(.+)"$', re.MULTILINE)


def described_figures(block, block_vars, gallery_conf):
    """Return the figures of a block of code with their texts.

    A comment ``# sphinx_gallery_alt = "..."`` in the block is the text, one for each figure;
    without it the text is the first paragraph of the script, which describes its only figure.
    """
    rst = matplotlib_scraper(block, block_vars, gallery_conf)
    texts = iter(STATED.findall(block[1]) or [introduction(Path(block_vars["src_file"]))])
    return re.sub(r"(:alt:) .*", lambda found: f"{found[1]} {next(texts)}", rst)


def introduction(script):
    """Return the first paragraph below the title of a script, as plain text."""
    paragraph = script.read_text(encoding="utf-8").split("\n\n")[1]
    return re.sub(r":\w+:|[`*]|^\"\"\"", "", " ".join(paragraph.split())).strip(' "')
