"""Spots of TrackMate: its csv tables, its project files (XML) and its exported tracks (XML)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from perrin.errors import table_error
from perrin.tracks.delimited import Layout, delimited_table, first_lines
from perrin.tracks.raw_tables import RawTable, tracked_rows, without_flat_z

if TYPE_CHECKING:
    from collections.abc import Sequence

_TRACKMATE_NAMES = {
    "frame": "FRAME",
    "particle": "TRACK_ID",
    "x": "POSITION_X",
    "y": "POSITION_Y",
    "z": "POSITION_Z",
    "time": "POSITION_T",
}

# Lines after the header that repeat it in words and state units.
_MOST_EXTRA_LINES = 3


def is_trackmate(lines: Sequence[str]) -> bool:
    """Return whether a text begins like a table of spots of TrackMate.

    Examples
    --------
    >>> is_trackmate(["LABEL,ID,TRACK_ID,QUALITY,POSITION_X,POSITION_Y,FRAME"])
    True
    """
    return {"POSITION_X", "POSITION_Y", "FRAME"} <= set(Layout().fields(lines[0]))


def trackmate_table(text: bytes, source: str) -> RawTable:
    r"""Return a table of spots, without the lines that repeat the header and state units.

    Parameters
    ----------
    text : bytes
        UTF-8.
    source : str
        The file's name, for messages.

    Returns
    -------
    RawTable
        Spots of no track are left out, and counted in a note.

    Raises
    ------
    TrackTableError
        If the lines are no table.

    Examples
    --------
    >>> text = b"TRACK_ID,POSITION_X,POSITION_Y,FRAME\nTrack ID,X,Y,Frame\nTrack ID,X,Y,Frame\n"
    >>> raw = trackmate_table(text + b",(micron),(micron),\n3,1.5,2.5,0\n", "spots.csv")
    >>> len(raw.table), raw.units["x"], raw.columns["particle"]
    (1, 'micron', 'TRACK_ID')
    """
    lines = first_lines(text)
    names = Layout().fields(lines[0])
    extra = 0
    for line in lines[1 : 1 + _MOST_EXTRA_LINES]:
        # The first row has a number where the header says FRAME.
        entry = dict(zip(names, Layout().fields(line), strict=False)).get("FRAME", "")
        if entry.replace(".", "", 1).isdecimal():
            break
        extra += 1
    units = {}
    if extra:
        stated = dict(zip(names, Layout().fields(lines[extra]), strict=False))
        units = {
            ours: stated[name].strip("()")
            for ours, name in _TRACKMATE_NAMES.items()
            if stated.get(name, "").startswith("(")
        }
    table = delimited_table(text, Layout(), source, header=0, skipped=extra, names=names)
    found = {ours: name for ours, name in _TRACKMATE_NAMES.items() if name in table}
    if "particle" in found:
        table, notes = tracked_rows(table, found["particle"])
    else:
        notes = ()
    kind = "a table of spots of TrackMate"
    if extra:
        kind += f" ({extra} lines after the header are no rows)"
    return _spots(RawTable(table, kind, found, units, notes, word="line", first=2))


def parse_trackmate_xml(data: bytes, source: str) -> RawTable:
    """Return the spots of a TrackMate project, or of its "Export tracks to XML file".

    Parameters
    ----------
    data : bytes
    source : str
        The file's name, for messages.

    Returns
    -------
    RawTable
        Spots of the tracks that pass the filters of the project; others are counted in a note.

    Raises
    ------
    TrackTableError
        If this is no such file. A document type with entities is refused.

    Examples
    --------
    >>> data = b'''<Tracks spaceUnits="micron" frameInterval="0.5" timeUnits="sec"><particle>
    ... <detection t="0" x="1.5" y="2.5" z="0.0"/></particle></Tracks>'''
    >>> parse_trackmate_xml(data, "t.xml").table.columns.tolist()
    ['TRACK_ID', 'FRAME', 'POSITION_X', 'POSITION_Y', 'POSITION_Z', 'POSITION_T']
    """
    from xml.parsers import expat

    import pandas as pd

    contents = _SpotsInFile()
    parser = expat.ParserCreate()

    def refuse_entities(*_: object) -> None:
        raise table_error(source, "XML with a document type (DOCTYPE), which no tracker writes")

    parser.StartDoctypeDeclHandler = refuse_entities
    parser.StartElementHandler = contents.start
    parser.EndElementHandler = contents.end
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise table_error(source, f"not a whole XML file: {error}") from None
    if contents.root not in ("TrackMate", "Tracks"):
        raise table_error(
            source, f"XML with the root {contents.root!r}; expected a file of TrackMate"
        )
    spots = contents.spots
    notes: tuple[str, ...] = ()
    if contents.root == "TrackMate":
        tracked = [
            {**spot, "TRACK_ID": contents.track_of[spot["ID"]]}
            for spot in spots
            if contents.track_of.get(spot.get("ID", "")) in contents.kept
        ]
        if len(tracked) < len(spots):
            notes = (
                f"left out: {len(spots) - len(tracked)} of {len(spots)} spots that belong to no "
                "track, or to none that passes the filters",
            )
        spots = tracked
    wanted = ("TRACK_ID", "FRAME", "POSITION_X", "POSITION_Y", "POSITION_Z", "POSITION_T")
    table = pd.DataFrame([{name: spot.get(name) for name in wanted} for spot in spots])
    table = table.apply(pd.to_numeric, errors="coerce").dropna(axis="columns", how="all")
    found = {ours: name for ours, name in _TRACKMATE_NAMES.items() if name in table}
    units = {axis: contents.length_unit for axis in "xyz" if contents.length_unit}
    if contents.time_unit:
        units["time"] = contents.time_unit
    kind = "a project of TrackMate" if contents.root == "TrackMate" else "tracks of TrackMate"
    return _spots(RawTable(table, kind, found, units, notes))


class _SpotsInFile:
    """Spots and tracks of a file of TrackMate, collected while it is read."""

    def __init__(self) -> None:
        self.root, self.length_unit, self.time_unit = "", "", ""
        self.spots: list[dict[str, Any]] = []
        self.track_of: dict[str, int] = {}
        self.kept: set[int] = set()
        self._interval, self._track, self._filtered = 0.0, -1, False

    def start(self, name: str, attributes: dict[str, str]) -> None:
        """Take what an element states."""
        self.root = self.root or name
        take = getattr(self, f"_take_{name.lower()}", None)
        if take is not None:
            take(attributes)

    def end(self, name: str) -> None:
        """Leave the list of filtered tracks."""
        if name == "FilteredTracks":
            self._filtered = False

    def _take_model(self, attributes: dict[str, str]) -> None:
        self.length_unit = attributes.get("spatialunits", "")
        self.time_unit = attributes.get("timeunits", "")

    def _take_spot(self, attributes: dict[str, str]) -> None:
        self.spots.append(dict(attributes))

    def _take_track(self, attributes: dict[str, str]) -> None:
        self._track = int(attributes.get("TRACK_ID", -1))

    def _take_edge(self, attributes: dict[str, str]) -> None:
        for end in ("SPOT_SOURCE_ID", "SPOT_TARGET_ID"):
            if end in attributes:
                self.track_of[attributes[end]] = self._track

    def _take_filteredtracks(self, _: dict[str, str]) -> None:
        self._filtered = True

    def _take_trackid(self, attributes: dict[str, str]) -> None:
        if self._filtered:
            self.kept.add(int(attributes.get("TRACK_ID", -1)))

    def _take_tracks(self, attributes: dict[str, str]) -> None:
        self.length_unit = attributes.get("spaceUnits", "")
        self.time_unit = attributes.get("timeUnits", "")
        self._interval = float(attributes.get("frameInterval", "nan"))

    def _take_particle(self, _: dict[str, str]) -> None:
        self._track += 1

    def _take_detection(self, attributes: dict[str, str]) -> None:
        frame = float(attributes.get("t", "nan"))
        self.spots.append(
            {f"POSITION_{axis.upper()}": attributes.get(axis) for axis in "xyz"}
            | {"TRACK_ID": self._track, "FRAME": frame, "POSITION_T": frame * self._interval}
        )


def _spots(raw: RawTable) -> RawTable:
    """Return the table without z where it is 0, and without times that are frame numbers."""
    columns = without_flat_z(raw.columns, raw.table)
    units = dict(raw.units)
    if units.get("time", "").startswith("frame"):
        columns.pop("time", None)
    units = {ours: unit for ours, unit in units.items() if ours in columns}
    flat = "z" in raw.columns and "z" not in columns
    notes = (*raw.notes, "z is 0 throughout: read as two dimensions") if flat else raw.notes
    return RawTable(raw.table, raw.kind, columns, units, notes, word=raw.word, first=raw.first)
