"""Tables of finished frames, written in parts, so that an interrupted run can be resumed."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from perrin.errors import PartsError
from perrin.tracks.checksums import checksum, read_sealed, write_sealed
from perrin.tracks.writing import written_whole

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path
    from typing import Self

    import pandas as pd


_SETTINGS = "settings.json"
_PART_SECONDS = 2.0  # between two parts; at most this much work is lost in a power cut


def open_parts(folder: Path, settings: Mapping[str, Any]) -> set[str]:
    """Make a folder of parts, or check that the one there belongs to the same run.

    Parameters
    ----------
    folder : Path
    settings : mapping
        All settings that the parts depend on; values that JSON can hold.

    Returns
    -------
    set of str
        Names of the parts in the folder.

    Raises
    ------
    PartsError
        If its parts have other settings; the message names those that differ.
    DamagedFileError
        If the list of their settings is damaged, so that nothing is known about them.
    """
    folder.mkdir(parents=True, exist_ok=True)
    place = folder / _SETTINGS
    plain = json.loads(json.dumps(settings))
    if place.exists():
        there = read_sealed(place)
        different = [
            f"{name} {there.get(name)!r} there, {plain.get(name)!r} now"
            for name in sorted({*there, *plain})
            if there.get(name) != plain.get(name)
        ]
        if different:
            raise PartsError(f"{folder} holds the parts of another run: {'; '.join(different)}")
    else:
        write_sealed(place, plain)
    return {p.name for p in folder.glob("part-*.parquet")}


def read_parts(folder: Path) -> tuple[pd.DataFrame, list[dict[str, Any]], list[str]]:
    """Read every part.

    Parameters
    ----------
    folder : Path

    Returns
    -------
    table : pandas.DataFrame
        The rows of all parts, those of a frame once.
    entries : list of dict
        The entry of each frame, as given to `PartWriter.add`.
    damaged : list of str
        Names of parts without the checksum in their name, or of another version; they were removed,
        so that their frames are processed again.

    Raises
    ------
    OSError
        If a part cannot be read from the disk; it is kept.
    """
    import io

    import pandas as pd

    tables, entries, damaged = [], [], []
    seen: set[int] = set()
    for path in sorted(folder.glob("part-*.parquet")):
        data = path.read_bytes()
        if path.stem.rpartition("-")[2] != checksum(data):
            path.unlink()
            damaged.append(path.name)
            continue
        table = pd.read_parquet(io.BytesIO(data))
        added = [e for e in table.attrs["entries"] if e["frame"] not in seen]
        fresh = {int(e["frame"]) for e in added}
        seen |= fresh
        entries += added
        table.attrs = {}
        tables.append(table[table["frame"].isin(fresh)])
    # The columns of empty tables have no types.
    filled = [t for t in tables if len(t)] or tables[:1] or [pd.DataFrame()]
    return pd.concat(filled, ignore_index=True), entries, damaged


@dataclass
class PartWriter:
    """A context manager that collects finished frames and writes them every few seconds.

    At the end, also after an exception, the frames collected since then are written.

    Parameters
    ----------
    folder : Path
        Folder of the parts.
    seconds : float
        Least time between two parts, s.
    """

    folder: Path
    seconds: float = _PART_SECONDS
    _tables: list[pd.DataFrame] = field(default_factory=list)
    _entries: list[dict[str, Any]] = field(default_factory=list)
    _written: float = field(default_factory=time.monotonic)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.flush()

    def add(self, table: pd.DataFrame, entry: dict[str, Any]) -> None:
        """Keep the rows of one frame.

        Parameters
        ----------
        table : pandas.DataFrame
        entry : dict
            Other values of the frame, with ``frame``.
        """
        self._tables.append(table)
        self._entries.append(entry)
        if time.monotonic() - self._written >= self.seconds:
            self.flush()

    def flush(self) -> None:
        """Write the collected frames as one part, with its checksum in its name.

        An incomplete part never appears.

        Raises
        ------
        OSError
            If it cannot be written, as on a full disk; parts written before remain valid.
        """
        import io

        import pandas as pd

        if not self._entries:
            return
        tables = [t for t in self._tables if len(t)] or self._tables[:1]
        part = pd.concat(tables, ignore_index=True)
        part.attrs = {"entries": self._entries}
        first = min(int(e["frame"]) for e in self._entries)
        buffer = io.BytesIO()
        part.to_parquet(buffer, index=False)
        data = buffer.getvalue()
        place = self.folder / f"part-{first:07d}-{checksum(data)}.parquet"
        with written_whole(place) as unfinished:
            unfinished.write_bytes(data)
        self._tables, self._entries = [], []
        self._written = time.monotonic()
