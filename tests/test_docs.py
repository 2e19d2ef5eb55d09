"""The examples of the conventions, tutorial and theory pages run, and print what is shown."""

import doctest
import re
from pathlib import Path

import pytest

DOCS = Path(__file__).resolve().parents[1] / "docs"
PAGES = [DOCS / "conventions.md", DOCS / "tables.md", DOCS / "dense.md", DOCS / "figures.md"]
PAGES += sorted((DOCS / "theory").glob("*.md"))
BOX = re.compile(r"```python\n(.*?)```\n(?:\n?```(?:text)?\n(.*?)```\n)?", re.DOTALL)

# Pages whose numbers are compared with --long only: each takes over 10 s.
SLOW = ("dense", "estimators")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_pages_print_what_they_show(page, capsys, repeats, tmp_path, monkeypatch):
    """A page has doctests, or code whose output follows in a box or as comments.

    In the quick form a slow page has a tenth of its repeats, or fewer and shorter tracks, and is
    only run.
    """
    monkeypatch.chdir(tmp_path)
    text, names = page.read_text(encoding="utf-8"), {}
    if page.stem in repeats(SLOW, ()):
        text = re.sub(r"\brange\((\d+)0\)", r"range(\1)", text)
        text = text.replace("n_frames = 1000\n", "n_frames = 200\n").replace("size=6", "size=4")
        for example in doctest.DocTestParser().get_examples(text):
            exec(compile(example.source, page.name, "single"), names)
        for code, _ in BOX.findall(text) if ">>>" not in text else ():
            exec(compile(code, page.name, "exec"), names)
        assert len(names) > 20
        return
    if ">>>" in text:
        result = doctest.testfile(str(page), module_relative=False)
        assert result.attempted > 0
        assert result.failed == 0, capsys.readouterr().out
        return
    boxes = BOX.findall(text)
    assert boxes
    for code, box in boxes:
        exec(compile(code, page.name, "exec"), names)
        promised = box.splitlines() if box else re.findall(r"^# (.*)$", code, re.MULTILINE)
        assert capsys.readouterr().out.splitlines() == promised
