"""The pages of the documentation: links, texts of figures, commands, terms."""

import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from perrin.cli.app import app

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
WRITTEN = sorted(
    path
    for path in DOCS.rglob("*.md")
    if "_build" not in path.parts and path.name != "command-line.md"
)
PAGES = [ROOT / "README.md", *WRITTEN]
SCRIPTS = sorted((DOCS / "gallery_scripts").glob("*.py")) + sorted(ROOT.glob("examples/0*.py"))
LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)\s]+)\)")
FENCE = re.compile(r"^```.*?^```", re.DOTALL | re.MULTILINE)
# Pages and pictures that the build makes, and what they are made from.
MADE = {
    r"tutorials/examples/(.+)\.rst": "../examples/{}.py",
    r"gallery/images/sphx_glr_(.+)_\d{3}\.png": "gallery_scripts/{}.py",
    r"gallery/(?!images|index)(.+)\.rst": "gallery_scripts/{}.py",
    r"gallery/index": "gallery_scripts/GALLERY_HEADER.rst",
    r"reference/python/\w+(?:\.rst)?": "_extensions/reference_pages.py",
    r"reference/command-line(?:\.md)?": "_extensions/reference_pages.py",
}


def page_id(path):
    return path.relative_to(ROOT).as_posix()


def source_of(target):
    """Return the file that a target inside docs is, or is made from; None for none."""
    if target.is_file():
        return target
    name = target.relative_to(DOCS).as_posix() if target.is_relative_to(DOCS) else ""
    for pattern, source in MADE.items():
        found = re.fullmatch(pattern, name)
        if found:
            return (DOCS / source.format(*found.groups())).resolve()
    return target.with_suffix(".md") if target.with_suffix(".md").is_file() else None


def anchors(path):
    """Return the anchors of the headings of a page, as GitHub makes them."""
    text = FENCE.sub("", path.read_text(encoding="utf-8"))
    titles = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", PAGES, ids=page_id)
def test_links_lead_to_a_page_and_figures_have_a_text(page):
    """Links to pages, headings and pictures exist, outside ones are https, pictures have a text."""
    text = FENCE.sub("", page.read_text(encoding="utf-8"))
    for picture, label, target in LINK.findall(text):
        assert label.strip() or not picture, f"no text for the picture {target}"
        if "://" in target or target.startswith("mailto:"):
            assert target.startswith("https://"), target
            continue
        name, _, anchor = target.partition("#")
        place = (page.parent / name).resolve() if name else page
        source = source_of(place)
        assert source is not None, f"{target} leads nowhere"
        assert source.is_file(), f"{target} is made from {source}, which does not exist"
        if anchor and source.suffix == ".md":
            assert anchor in anchors(source), f"{target}: no such heading"
    for block in re.findall(r"```\{(?:image|figure)\}.*?```", page.read_text("utf-8"), re.DOTALL):
        assert re.search(r"^:alt: .{20}", block, re.MULTILINE), f"no text for the picture: {block}"


def test_every_page_is_in_the_table_of_contents():
    """Each page is named by a toctree, so that a reader can reach it from the front page."""
    named = set()
    for page in WRITTEN:
        text = page.read_text(encoding="utf-8")
        for block in re.findall(r"```\{toctree\}\n(.*?)```", text, re.DOTALL):
            for line in block.splitlines():
                if line and not line.startswith(":"):
                    named.add((page.parent / line).resolve())
    left = [page_id(p) for p in WRITTEN if p.with_suffix("") not in named and p.stem != "index"]
    assert left == []


@pytest.mark.parametrize("script", SCRIPTS, ids=page_id)
def test_scripts_have_a_title_and_links_that_exist(script):
    """A script begins with a title and a sentence; the pages that it names exist."""
    text = script.read_text(encoding="utf-8")
    assert re.match(r'"""\n(.+)\n=+\n\n\S', text)
    # A tutorial states the text of every figure; a gallery's script has one, its first paragraph.
    if "examples" in script.parts:
        stated = re.findall(r'^# sphinx_gallery_alt = ".{20,}"\nplt\.show', text, re.MULTILINE)
        assert len(stated) == text.count("plt.show()")
    folder = DOCS / "tutorials" / "examples" if "examples" in script.parts else DOCS / "gallery"
    for target in re.findall(r":doc:`(?:[^`<]*<)?([^`>]+)>?`", text):
        place = DOCS / target[1:] if target.startswith("/") else folder / target
        sources = (place.with_suffix(".md"), ROOT / "examples" / f"{place.name}.py")
        assert any(source.is_file() for source in sources), target


def test_the_gallery_has_twenty_pictures():
    assert len(list((DOCS / "gallery_scripts").glob("*.py"))) == 20


def test_terms_of_the_glossary_are_sorted_and_single():
    """No term is listed twice, and the first terms of the entries are in alphabetical order."""
    text = (DOCS / "reference" / "glossary.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"^:::\{glossary\}\n(.*?)^:::", text, re.DOTALL | re.MULTILINE)
    entries = [entry.split("\n  ")[0].splitlines() for entry in block.strip().split("\n\n")]
    terms = [term for entry in entries for term in entry]
    assert len(set(terms)) == len(terms)
    first = [entry[0].lower() for entry in entries]
    assert first == sorted(first)


def test_the_examples_are_copied(tmp_path):
    """`perrin examples` copies scripts and notebooks, and replaces nothing without being asked."""
    target = str(tmp_path / "copied")
    assert CliRunner().invoke(app, ["examples", target]).exit_code == 0
    copied = {path.name: path.read_bytes() for path in (tmp_path / "copied").iterdir()}
    own = {path.name: path.read_bytes() for path in (ROOT / "examples").glob("0*")}
    assert copied == own
    assert len(own) == 9
    (tmp_path / "copied" / "01_own_table.py").write_text("mine")
    refused = CliRunner().invoke(app, ["examples", target])
    assert refused.exit_code != 0
    assert (tmp_path / "copied" / "01_own_table.py").read_text() == "mine"
    assert CliRunner().invoke(app, ["examples", target, "--overwrite"]).exit_code == 0
    assert (tmp_path / "copied" / "01_own_table.py").read_bytes() == own["01_own_table.py"]
