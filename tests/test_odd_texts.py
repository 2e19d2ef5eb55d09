"""Labels and names of any characters: no markup, no codes of a terminal, no formulas, no loss."""

from __future__ import annotations

import os
import sys

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import perrin
from command_line import command_line
from perrin._text import printable
from perrin.cli.messages import escape
from perrin.tracks.cells import guarded_cell, unguarded_cell

ODD = [
    "[/]", "[/x]", "[bold", "[link=http://a]b", "a\x1b[31mred\x1b[0m",
    "\x1b]0;title\x07", "back\\", "=1+1", "\u202eabc", "@SUM(A1)",
]  # fmt: skip
# Controls, letters of two scripts, signs without width, of direction and of line ends, private and
# unassigned ones, tags and pictures; the table of all of Unicode takes hypothesis 2 s to make.
CHARACTERS = "".join(
    map(
        chr,
        [
            *range(0x250), *range(0x5D0, 0x620), *range(0x2000, 0x2070), *range(0x3000, 0x3010),
            *range(0xE000, 0xE008), *range(0xFDD0, 0xFDD8), *range(0xFE00, 0xFE10),
            *range(0xFEFF, 0xFF10), *range(0xFFF0, 0x10000), *range(0x1F600, 0x1F610),
            *range(0xE0000, 0xE0080), 0x10FFFF,
        ],
    )
)  # fmt: skip


def labelled(labels, n_frames=12):
    """Return tracks of one cluster of three particles for every label."""
    rows = []
    body = perrin.Cluster.touching(3, 2.45)
    for k, label in enumerate(labels):
        motion = perrin.simulate_motion(body, D_R=5e-3, D_T=0.04, dt=0.7, n_frames=n_frames, rng=k)
        places = perrin.add_noise(motion.positions(), sigma=0.02, rng=k) + 20.0 * k
        frame, particle = np.indices(places.shape[:2])
        columns = dict(zip("xyz", places.reshape(-1, 3).T, strict=True))
        ids = {"frame": frame.ravel(), "particle": particle.ravel() + 10 * k, "cluster": label}
        rows.append(pd.DataFrame({**ids, **columns}))
    return pd.concat(rows, ignore_index=True)


@pytest.fixture
def undrawn(monkeypatch):
    """Write no figures: their texts are tested with the plots."""
    monkeypatch.setattr("perrin.report.write.save_figures", lambda *_, **__: [])


@pytest.mark.usefixtures("no_tensors")
@pytest.mark.parametrize("part", [ODD[:5], ODD[5:10]])
def test_labels_are_printed_as_they_are(tmp_path, capsys, undrawn, part):
    """In the table of the terminal, in warnings and in notes; no code reaches the terminal."""
    table = labelled(part)
    perrin.write_tracks(table, tmp_path / "tracks.csv")
    arguments = ["analyze", tmp_path / "tracks.csv", "--dt", 0.7, "-o", tmp_path / "run"]
    with pytest.raises(SystemExit) as stopped:
        command_line(list(map(str, arguments)))
    out, err = capsys.readouterr()
    assert not stopped.value.code
    assert not set(out + err) & set(map(chr, [*range(10), *range(11, 32), 0x202E]))
    for label in part:
        assert f"cluster {printable(label)}: " in out
    report = perrin.load_run(tmp_path / "run")
    assert sorted(c.label for c in report.clusters) == sorted(part)
    cells = pd.read_csv(tmp_path / "run" / "results.csv", keep_default_na=False)["label"]
    assert not [cell for cell in cells if cell.startswith(("=", "+", "-", "@"))]


def test_a_name_that_is_no_utf8_is_printed(tmp_path, capsys):
    """The byte is written as Python writes it, in the error too."""
    place = os.fsdecode(os.fsencode(tmp_path) + b"/t\xff\n.csv")
    for command in (["analyze", place, "--dt", "0.7", "-o", str(tmp_path / "run")],):
        with pytest.raises(SystemExit) as stopped:
            command_line(command)
        assert stopped.value.code == 2
        error = capsys.readouterr().err
        assert "t\\udcff" in error
        error.encode()


@settings(max_examples=30, deadline=None)
@given(st.text(CHARACTERS, max_size=12))
def test_every_text_is_harmless_on_a_terminal(text):
    """Rich prints an escaped text as it is; printable texts are unchanged."""
    from io import StringIO

    from rich.console import Console

    shown = printable(text)
    assert all(c == "\n" or c.isprintable() for c in shown)
    assert shown == text or not text.replace("\n", "").isprintable()
    out = StringIO()
    Console(file=out, highlight=False, width=1000).print(
        f"[dim]a[/] {escape(text)}", style="dim", soft_wrap=True, end=""
    )
    assert out.getvalue() == f"a {shown}"


@settings(max_examples=60, deadline=None)
@given(st.text(alphabet="'=+-@ab1.e\t |", max_size=8) | st.text(CHARACTERS, max_size=8))
def test_guarded_cells_come_back_and_are_no_formulas(text):
    """Different texts stay different; numbers stay numbers."""
    cell = guarded_cell(text)
    assert unguarded_cell(cell) == text
    if cell.lstrip()[:1] in tuple("=+-@"):
        float(cell)


def test_labels_come_back_from_a_csv_file(tmp_path):
    """Labels that a spreadsheet would compute are written behind an apostrophe."""
    table = labelled(["=1+1", "'=1+1", "@a", "plain"], n_frames=2)
    perrin.write_tracks(table, tmp_path / "t.csv")
    text = (tmp_path / "t.csv").read_text()
    assert ",'=1+1" in text.replace('"', "") or ",'=1+1," in text
    assert perrin.read_tracks(tmp_path / "t.csv")["cluster"].tolist() == table["cluster"].tolist()
    # A foreign file with both spellings has two clusters.
    foreign = text.replace("''=1+1", "=1+1")
    (tmp_path / "t.csv").write_text(foreign)
    assert set(perrin.read_tracks(tmp_path / "t.csv")["cluster"]) == {
        "=1+1",
        "'=1+1",
        "'@a",
        "plain",
    }


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
def test_signals_stop_once_in_order(monkeypatch):
    """The first signal raises, the second has its default effect; an ignored one stays ignored."""
    import signal

    from perrin.cli.messages import StoppedError, stop_in_order

    kept = {each: signal.getsignal(each) for each in (signal.SIGINT, signal.SIGTERM)}
    try:
        stop_in_order()
        with pytest.raises(StoppedError) as stopped:
            signal.raise_signal(signal.SIGTERM)
        assert stopped.value.number == signal.SIGTERM
        assert signal.getsignal(signal.SIGINT) is signal.SIG_DFL
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        stop_in_order()
        signal.raise_signal(signal.SIGINT)
    finally:
        for each, handler in kept.items():
            signal.signal(each, handler)
