"""The first use of a term of the glossary on a page becomes a link to the glossary."""

import re
from functools import cache
from pathlib import Path

from docutils import nodes
from sphinx import addnodes
from sphinx.transforms import SphinxTransform

GLOSSARY = "reference/glossary"
# Terms that are also common words: a link would often explain something else.
COMMON = {"R", "cage", "interval", "note", "piece", "pooled", "rod", "sigma", "warning"}
# No links inside these: titles, code, links, definitions of signatures, captions of figures.
CLOSED = (
    nodes.title,
    nodes.literal,
    nodes.literal_block,
    nodes.doctest_block,
    nodes.reference,
    nodes.math,
    nodes.math_block,
    nodes.caption,
    nodes.image,
    nodes.raw,
    nodes.rubric,
    nodes.field_name,
    nodes.term,
    nodes.comment,
    addnodes.pending_xref,
    addnodes.download_reference,
    addnodes.desc_signature,
    addnodes.toctree,
)


@cache
def entries(path):
    """Return the first term of the entry of every term: synonyms have one entry."""
    text = Path(path).read_text(encoding="utf-8")
    (block,) = re.findall(r"^:::\{glossary\}\n(.*?)^:::", text, re.DOTALL | re.MULTILINE)
    first, found = None, {}
    for line in block.splitlines():
        if not line or line.startswith(" "):
            first = None
        else:
            first = first or line.strip()
            found[line.strip()] = first
    return found


@cache
def pattern(path):
    """Return the expression that finds any of the terms, the longest first."""
    longest = sorted(set(entries(path)) - COMMON, key=len, reverse=True)
    return re.compile(r"(?<![\w-])(" + "|".join(map(re.escape, longest)) + r")(?![\w-])")


class GlossaryLinks(SphinxTransform):
    """Replace the first use of every term by a reference."""

    default_priority = 650

    def apply(self, **_):
        """Change the page's text; reference pages of single names keep theirs."""
        page = self.env.docname
        if page.startswith(("reference/", "gallery/index")) or page == "index":
            return
        path = self.env.doc2path(GLOSSARY)
        if not Path(path).is_file():
            return
        used = set()
        for text in list(self.document.findall(nodes.Text)):
            if not in_closed(text):
                link_terms(text, path, used, page)


def in_closed(text):
    """Return whether a text is inside one of the nodes without links."""
    node = text.parent
    while node is not None:
        if isinstance(node, CLOSED):
            return True
        node = node.parent
    return False


def link_terms(text, path, used, page):
    """Replace the terms in a text whose entries of the glossary are not in `used`."""
    content, parts, end = text.astext(), [], 0
    for found in pattern(path).finditer(content):
        term = found[1]
        entry = entries(path)[term]
        if entry in used:
            continue
        used.add(entry)
        parts.append(nodes.Text(content[end : found.start()]))
        link = addnodes.pending_xref(
            "", nodes.inline("", term), refdomain="std", reftype="term", reftarget=term,
            refexplicit=True, refwarn=True, refdoc=page,
        )  # fmt: skip
        parts.append(link)
        end = found.end()
    if parts:
        text.parent.replace(text, [*parts, nodes.Text(content[end:])])


def setup(app):
    """Register the transform."""
    app.add_transform(GlossaryLinks)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
