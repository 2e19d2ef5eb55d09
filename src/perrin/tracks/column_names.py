"""Which column of a track table is which: other spellings of names, and units in names."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

from perrin._text import listed

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

COLUMNS = ("frame", "particle", "x", "y", "z", "cluster", "time")

# Spellings are compared without regard to case, blanks, underscores and units.
_OURS_BY_SPELLING = {
    **{name: name for name in COLUMNS},
    "framenumber": "frame",
    "particleid": "particle",
    "trackid": "particle",
    "clusterid": "cluster",
}

_UNIT_UM: dict[str, float | None] = {
    **dict.fromkeys(("um", "\u03bcm", "micron", "microns"), 1.0),
    **dict.fromkeys((f"micromet{end}" for end in ("er", "re", "ers", "res")), 1.0),
    **dict.fromkeys(("nm", "nanometer", "nanometre", "nanometers", "nanometres"), 1e-3),
    **dict.fromkeys(("mm", "millimeter", "millimetre", "millimeters", "millimetres"), 1e3),
    **dict.fromkeys(("cm", "centimeter", "centimetre", "centimeters", "centimetres"), 1e4),
    **dict.fromkeys(("m", "meter", "metre", "meters", "metres"), 1e6),
    **dict.fromkeys(("a", "\u00e5", "angstrom", "angstroms"), 1e-4),
    # The size of a pixel is not in its name.
    **dict.fromkeys(("px", "pix", "pixel", "pixels", "voxel", "voxels"), None),
}

_UNIT_SECONDS = {
    **dict.fromkeys(("s", "sec", "second", "seconds"), 1.0),
    **dict.fromkeys(("ms", "msec", "millisecond", "milliseconds"), 1e-3),
    **dict.fromkeys(("us", "\u03bcs"), 1e-6),
    **dict.fromkeys(("min", "minute", "minutes"), 60.0),
    **dict.fromkeys(("h", "hour", "hours"), 3600.0),
}

_UNITS_OF: dict[str, Mapping[str, float | None]] = {
    "x": _UNIT_UM,
    "y": _UNIT_UM,
    "z": _UNIT_UM,
    "time": _UNIT_SECONDS,
}

# A unit at the end of a name: in brackets, or one of these after an underscore, as in x_um.
_IN_BRACKETS = re.compile(r"(.*?)[\s_]*(?:\(([^()]*)\)|\[([^\[\]]*)\])")

_AFTER_UNDERSCORE = re.compile(r"(.*)_(um|\u03bcm|nm|mm|px|pixels?|s|ms)")

_SCALE_ROUNDING = 1e-6  # relative difference of two scales that are the same


@dataclass(frozen=True)
class Spelling:
    """Columns of a table that are ours in another spelling, and the units in their names.

    Attributes
    ----------
    renamed : mapping of str to str
        Our name for each name in the table.
    units : mapping of str to (str, str)
        Name in the table and its unit, for our names of coordinates and the time.
    notes : tuple of str
        Sentences on the columns that were recognised, left out or converted.
    faults : tuple of str
        Sentences on columns that could be the same one of ours.
    """

    renamed: Mapping[str, str]
    units: Mapping[str, tuple[str, str]]
    notes: tuple[str, ...] = ()
    faults: tuple[str, ...] = ()


def recognise_columns(
    names: Iterable[object], *, taken: Mapping[str, str | None] | None = None
) -> Spelling:
    """Return which columns are ours but for case, blanks, underscores and a unit at the end.

    Parameters
    ----------
    names : iterable
        Names of the columns; those that are no text are none of ours.
    taken : mapping, optional
        Names in the table of the columns, not among `names`, to which our names are already given;
        None where that name does not count.

    Returns
    -------
    Spelling
        A column with exactly our name has it; only for the other names are spellings compared. Of
        two candidates none is chosen, that is a fault.

    Examples
    --------
    >>> spelling = recognise_columns(["Frame", "Particle ID", "x (um)", "y_um", "mass"])
    >>> spelling.renamed
    {'Frame': 'frame', 'Particle ID': 'particle', 'x (um)': 'x', 'y_um': 'y'}
    >>> recognise_columns(["X", "x (px)"]).faults[0].partition(";")[0]
    "x: 2 columns could be it, 'X', 'x (px)'"
    """
    given, taken = list(names), taken or {}
    renamed, units, left, faults = {}, _units_of(taken), [], []
    for ours, found in _other_spellings(given).items():
        if ours in taken:
            continue
        if ours in given:
            left += found
        elif len(found) > 1:
            faults.append(
                f"{ours}: {len(found)} columns could be it, {listed(map(repr, found))}; choose "
                f"one, for example columns={{'{ours}': {found[0]!r}}}"
            )
        else:
            renamed[found[0]] = ours
            units |= _units_of({ours: found[0]})
    notes = []
    if renamed:
        pairs = listed(f"{theirs!r} as {ours}" for theirs, ours in renamed.items())
        notes.append(f"columns recognised: {pairs}")
    if left:
        notes.append(
            f"columns left out, because others have exactly our names: {listed(map(repr, left))}"
        )
    if seconds(units) != 1:
        name, unit = units["time"]
        notes.append(f"column {name!r} is converted from {unit} to s")
    return Spelling(renamed, units, tuple(notes), tuple(faults))


def ours_of(names: Iterable[object]) -> dict[str, str]:
    """Return our name for each of the names that is ours in any spelling.

    Examples
    --------
    >>> ours_of(["Frame", "x", "mass"])
    {'Frame': 'frame', 'x': 'x'}
    """
    found = {}
    for name in names:
        if isinstance(name, str):
            base, unit = _base_and_unit(name)
            ours = _OURS_BY_SPELLING.get(base)
            if ours is not None and (not unit or unit in _UNITS_OF.get(ours, {})):
                found[name] = ours
    return found


def stated_units(
    units: Mapping[str, tuple[str, str]],
) -> tuple[dict[str, tuple[str, str]], list[str]]:
    """Return the units that a format states, spelled as in the names of columns, and faults.

    Parameters
    ----------
    units : mapping
        For each of our names the file's name of the column and the unit.

    Returns
    -------
    units : dict
        As in `Spelling`.
    faults : list of str
        Units that are unknown.

    Examples
    --------
    >>> stated_units({"x": ("POSITION_X", "Micron")})[0]
    {'x': ('POSITION_X (micron)', 'micron')}
    """
    known, faults = {}, []
    for ours, (name, unit) in units.items():
        simple = unit.strip().casefold()
        if simple in _UNITS_OF.get(ours, {}):
            known[ours] = f"{name} ({simple})", simple
        elif simple and ours in _UNITS_OF:
            faults.append(f"{ours}: the unit {unit!r} of the file is unknown")
    return known, faults


def unit_faults(units: Mapping[str, tuple[str, str]], scale: Mapping[str, float]) -> list[str]:
    """Return where units in the names of columns contradict the scale of their axes.

    Parameters
    ----------
    units : mapping
        As in `Spelling`.
    scale : mapping of str to float
        Micrometres per unit of the coordinates, for every axis.

    Returns
    -------
    list of str

    Examples
    --------
    >>> unit_faults({"x": ("x (nm)", "nm")}, {"x": 1e-3, "y": 1e-3})
    []
    >>> unit_faults({"x": ("x (um)", "um")}, {"x": 0.1, "y": 0.1})[0].partition(";")[0]
    "scale: 'x (um)' is in um, but the scale is 0.1 um per unit"
    """
    stated = {axis: _UNIT_UM[units[axis][1]] for axis in scale if axis in units}
    # 1 for all axes is the default; together with other sizes a pixel of 1 um was stated.
    given = any(value != 1 for value in scale.values())
    unknown = [axis for axis, um in stated.items() if um is None and not given]
    wrong = [
        axis
        for axis, um in stated.items()
        if um is not None and abs(scale[axis] / um - 1) > _SCALE_ROUNDING
    ]
    faults = []
    if unknown:
        faults.append(
            f"{_contradiction(unknown, units, scale)}; state scale as the size of a pixel in um, "
            "or one number per axis"
        )
    if wrong:
        right = [stated.get(axis) or value for axis, value in scale.items()]
        one = len(set(right)) == 1
        shown = f"{right[0]:g}" if one else f"({', '.join(f'{um:g}' for um in right)})"
        faults.append(
            f"{_contradiction(wrong, units, scale)}; state scale={shown}, or correct the names of "
            "the columns"
        )
    return faults


def seconds(units: Mapping[str, tuple[str, str]]) -> float:
    """Return the seconds in a unit of the column ``time``, 1 where its name states none.

    Examples
    --------
    >>> seconds({"time": ("time (ms)", "ms")}), seconds({})
    (0.001, 1.0)
    """
    return _UNIT_SECONDS[units["time"][1]] if "time" in units else 1.0


def _other_spellings(names: list[object]) -> dict[str, list[str]]:
    """Return, for each of our names, the columns with it in another spelling."""
    found: dict[str, list[str]] = {}
    for name in names:
        if not isinstance(name, str):
            continue
        base, unit = _base_and_unit(name)
        ours = _OURS_BY_SPELLING.get(base)
        if ours is not None and name != ours and (not unit or unit in _UNITS_OF.get(ours, {})):
            found.setdefault(ours, []).append(name)
    return found


def _base_and_unit(name: str) -> tuple[str, str]:
    """Return a name without its unit, simplified for comparison, and the unit.

    What is no unit of length or time stays in the name, which is then none of ours.
    """
    base, unit = name.strip().casefold(), ""
    found = _IN_BRACKETS.fullmatch(base) or _AFTER_UNDERSCORE.fullmatch(base)
    if found:
        ending = next(part for part in found.groups()[1:] if part is not None).strip()
        if ending in _UNIT_UM or ending in _UNIT_SECONDS:
            base, unit = found[1], ending
    return re.sub(r"[\s_]+", "", base), unit


def _units_of(taken: Mapping[str, str | None]) -> dict[str, tuple[str, str]]:
    """Return the units that the names of columns given to ours state."""
    stated = {}
    for ours, name in taken.items():
        unit = _base_and_unit(name)[1] if name is not None else ""
        if name is not None and unit in _UNITS_OF.get(ours, {}):
            stated[ours] = name, unit
    return stated


def _contradiction(
    axes: list[str], units: Mapping[str, tuple[str, str]], scale: Mapping[str, float]
) -> str:
    """State the units in the names of columns and the scales that contradict them."""
    names = listed(repr(units[axis][0]) for axis in axes)
    kinds = listed(dict.fromkeys(units[axis][1] for axis in axes))
    given = listed(dict.fromkeys(f"{scale[axis]:g}" for axis in axes))
    verb = "is" if len(axes) == 1 else "are"
    return f"scale: {names} {verb} in {kinds}, but the scale is {given} um per unit"
