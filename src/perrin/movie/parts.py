"""Which frames of a run are done: tables kept piece by piece, so that a run can go on."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from perrin.errors import PartsError
from perrin.tracks.writing import written_whole

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path
    from typing import Self

    import pandas as pd


_SETTINGS = "settings.json"


_SECONDS = 2.0  # between two parts: the most work that a power cut takes


def open_parts(folder: Path, settings: Mapping[str, Any]) -> set[str]:
    """Make a folder of parts, or check that the one there belongs to the same run.

    Parameters
    ----------
    folder : Path
    settings : mapping
        What the parts depend on; plain values as JSON holds them.

    Returns
    -------
    set of str
        The names of the parts that stand there.

    Raises
    ------
    PartsError
        If its parts are of other settings; the message names those that differ.
    """
    folder.mkdir(parents=True, exist_ok=True)
    place = folder / _SETTINGS
    plain = json.loads(json.dumps(settings))
    if place.exists():
        there = json.loads(place.read_text(encoding="utf-8"))
        told = [
            f"{name} {there.get(name)!r} there, {plain.get(name)!r} now"
            for name in sorted({*there, *plain})
            if there.get(name) != plain.get(name)
        ]
        if told:
            raise PartsError(f"{folder} holds the parts of another run: {'; '.join(told)}")
    else:
        with written_whole(place) as beside:
            beside.write_text(json.dumps(plain, indent=2), encoding="utf-8")
    return {p.name for p in folder.glob("part-*.parquet")}


def read_parts(folder: Path) -> tuple[pd.DataFrame, list[dict[str, Any]], list[str]]:
    """Read every part.

    Returns
    -------
    table : DataFrame
        The rows of all parts, those of an item once.
    entries : list of dict
        What `PartWriter.add` was told of each item.
    damaged : list of str
        Parts that cannot be read; they were removed, for their items have to be done again.
    """
    import pandas as pd

    tables, entries, damaged = [], [], []
    seen: set[int] = set()
    for path in sorted(folder.glob("part-*.parquet")):
        try:
            table = pd.read_parquet(path)
        # A file that a failing disk left behind raises whatever its decoder does.
        except Exception:
            path.unlink()
            damaged.append(path.name)
            continue
        told = [e for e in table.attrs["entries"] if e["frame"] not in seen]
        fresh = {int(e["frame"]) for e in told}
        seen |= fresh
        entries += told
        table.attrs = {}
        tables.append(table[table["frame"].isin(fresh)])
    # Empty tables have no types to add.
    filled = [t for t in tables if len(t)] or tables[:1] or [pd.DataFrame()]
    return pd.concat(filled, ignore_index=True), entries, damaged


@dataclass
class PartWriter:
    """Collects finished frames and writes them every few seconds, and at the end.

    A context manager: what was collected is written even when the work is interrupted.
    """

    folder: Path
    seconds: float = _SECONDS
    _tables: list[pd.DataFrame] = field(default_factory=list)
    _entries: list[dict[str, Any]] = field(default_factory=list)
    _written: float = field(default_factory=time.monotonic)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.flush()

    def add(self, table: pd.DataFrame, entry: dict[str, Any]) -> None:
        """Keep the rows of one frame, and what else is to be remembered of it (``frame`` in it)."""
        self._tables.append(table)
        self._entries.append(entry)
        if time.monotonic() - self._written >= self.seconds:
            self.flush()

    def flush(self) -> None:
        """Write what was collected as one part, which appears whole or not at all.

        Raises
        ------
        OSError
            Where it cannot be written, as on a full disk; parts written before stay good.
        """
        import uuid

        import pandas as pd

        if not self._entries:
            return
        tables = [t for t in self._tables if len(t)] or self._tables[:1]
        part = pd.concat(tables, ignore_index=True)
        part.attrs = {"entries": self._entries}
        first = min(int(e["frame"]) for e in self._entries)
        place = self.folder / f"part-{first:07d}-{uuid.uuid4().hex[:8]}.parquet"
        with written_whole(place) as beside:
            part.to_parquet(beside, index=False)
        self._tables, self._entries = [], []
        self._written = time.monotonic()
