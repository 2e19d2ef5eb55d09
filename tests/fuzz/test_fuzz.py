"""Every damaged file that ever broke a reader is refused in order; more with ``-m fuzz``."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

import reading

SEEDS = sorted((HERE / "seeds").glob("*.json"))


@pytest.mark.parametrize("seed", SEEDS, ids=lambda path: path.stem)
def test_what_once_broke_a_reader_is_refused(seed, tmp_path):
    """In one line that names the file, by an error of perrin."""
    path = tmp_path / seed.stem.partition("-")[2]
    reading.put(reading.seed_content(seed), path)
    assert reading.verdict(path) == ""


@pytest.mark.fuzz
@pytest.mark.parametrize("kind", ["tiffs", "stacks", "tables", "folders"])
def test_damaged_files_are_refused(kind, tmp_path, record_property):
    """Others with another FUZZ_FIRST in the environment, the number of the first damage."""
    import run
    from corpus import write_corpus

    made = write_corpus(tmp_path, [kind])
    first = int(os.environ.get("FUZZ_FIRST", "0"))
    faults, total, _ = run.fuzz(tmp_path, list(made), first, 15.0)
    record_property("damaged", total)
    assert not faults, "\n".join(f"{name}, damage {n}: {text}" for name, n, text in faults[:5])
