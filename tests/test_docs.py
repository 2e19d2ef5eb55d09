"""The boxes of the theory pages run, and print what the pages say."""

import doctest
import re
from pathlib import Path

import pytest

PAGES = sorted((Path(__file__).resolve().parents[1] / "docs" / "theory").glob("*.md"))
BOX = re.compile(r"```python\n(.*?)```\n(?:\n?```(?:text)?\n(.*?)```\n)?", re.DOTALL)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_theory_pages_print_what_they_say(page, capsys):
    """Boxes are examples with a prompt, or code whose output follows in a box or as comments."""
    text = page.read_text(encoding="utf-8")
    if ">>>" in text:
        result = doctest.testfile(str(page), module_relative=False)
        assert result.attempted > 0
        assert result.failed == 0, capsys.readouterr().out
        return
    boxes = BOX.findall(text)
    assert boxes
    names: dict[str, object] = {}
    for code, box in boxes:
        exec(compile(code, page.name, "exec"), names)
        promised = box.splitlines() if box else re.findall(r"^# (.*)$", code, re.MULTILINE)
        assert capsys.readouterr().out.splitlines() == promised
