"""Repeated remarks become one line; lists in messages are short."""

from __future__ import annotations

import pytest

from perrin._text import frames_text, listed
from perrin.run.remarks import condensed, grouped, merged


def poses(k: int) -> str:
    """Return the text about frames without a pose, as the analysis writes it."""
    if k % 3 == 0:
        return f"frames without a pose: {k + 2} of 300 ({k + 2} x 2 of 4 particles, 3 needed)"
    few, none = "1 x 1 of 4 particles, 3 needed", f"{k} x 2 of 4 particles, 3 needed"
    return f"frames without a pose: {k + 1} of 300 ({few}; {none})"


def test_texts_that_differ_in_numbers_are_one_line():
    """38 of 40 clusters with other numbers, lists and names: one line with the counts."""
    texts = {str(k): [poses(k)] if k < 38 else [] for k in range(40)}
    (line,) = merged(texts)
    assert line.startswith("in 38 of 40 clusters (0, 1, 2, 3, 4, 5, 6, 7, 8, 9 and 28 more), for ")
    assert line.endswith(f"for example cluster 0: {poses(0)}")
    (remark,) = grouped(texts)
    assert remark.names == tuple(str(k) for k in range(38))
    assert (remark.total, remark.same) == (40, False)


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ("labels exchanged at frame 7", "labels exchanged at frames 3, 9, 27"),
        ("cut at frames 1, 2 and 40 more", "cut at frame 5"),
        ("1 row is missing", "12 rows are missing"),
        ("1 frame has no pose", "3 frames have no pose"),
        ("D_T is 0.0186(15) um^2/s", "D_T is 3e-05 um^2/s"),
        ("cluster a was left out", "cluster b was left out"),
    ],
)
def test_lists_plurals_and_names_do_not_distinguish(first, second):
    """The same statement about one and about several frames, rows or clusters is one kind."""
    assert len(merged({"a": [first], "b": [second]})) == 1
    assert condensed([first, second]) == [f"{first} (and 1 more of this kind)"]


def test_other_words_are_other_lines():
    """Texts with other words are not merged, and nothing is lost: every text is in one remark."""
    texts = {"a": ["no size from D_R: a limit", "5 rows"], "b": ["no size from D_T: a limit"]}
    assert merged(texts) == [
        "cluster a: no size from D_R: a limit",
        "cluster a: 5 rows",
        "cluster b: no size from D_T: a limit",
    ]
    repeated = {"a": ["cut at frame 3", "cut at frame 9"], "b": ["cut at frame 3"]}
    first, second = grouped(repeated)
    assert (first.names, first.same) == (("a", "b"), True)
    assert (second.names, second.text) == (("a",), "cut at frame 9")


def test_equal_texts_name_no_example():
    """The same numbers everywhere need no example; one cluster alone needs no name."""
    assert merged({"a": ["5 rows"], "b": ["5 rows"]}) == ["in all 2 clusters: 5 rows"]
    assert merged({"a": ["5 rows"]}) == ["5 rows"]
    assert merged({}) == []


def test_lists_are_capped():
    """At most ten items and the number of the rest, however long the list."""
    assert frames_text(range(10)) == "frames 0, 1, 2, 3, 4, 5, 6, 7, 8, 9"
    assert frames_text(range(5000)) == "frames 0, 1, 2, 3, 4, 5, 6, 7, 8, 9 and 4990 more"
    assert frames_text([3]) == "frame 3"
    assert listed([]) == ""
    assert listed("abc", most=2) == "a, b and 1 more"
