"""Texts of numbers, units, lists and frames."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterable


def listed(items: Iterable[object], *, most: int = 10) -> str:
    """Return items separated by commas, at most `most` of them, and the number of the others.

    Parameters
    ----------
    items : iterable
    most : int
        The largest number of items that are written out.

    Returns
    -------
    str

    Examples
    --------
    >>> listed(["a", "b"]), listed(range(300), most=3)
    ('a, b', '0, 1, 2 and 297 more')
    """
    texts = [str(item) for item in items]
    more = f" and {len(texts) - most} more" if len(texts) > most else ""
    return ", ".join(texts[:most]) + more


def frames_text(frames: Iterable[int], *, most: int = 10) -> str:
    """Return frame numbers for a sentence, at most `most` of them.

    Parameters
    ----------
    frames : iterable of int
    most : int
        The largest number of frames that are written out.

    Returns
    -------
    str

    Examples
    --------
    >>> frames_text([7]), frames_text([3, 8, 9], most=2)
    ('frame 7', 'frames 3, 8 and 1 more')
    """
    numbers = [int(frame) for frame in frames]
    return f"frame{'s' if len(numbers) != 1 else ''} {listed(numbers, most=most)}"


def counted(count: int, noun: str, verb: str = "") -> str:
    """Write a number of things with the plural that it needs, and the verb of these things.

    Parameters
    ----------
    count : int
    noun : str
        Singular whose plural ends in s.
    verb : str
        Of the plural: "have", "are", "belong".

    Examples
    --------
    >>> counted(1, "row"), counted(0, "row"), counted(1, "row", "have"), counted(1, "row", "belong")
    ('1 row', '0 rows', '1 row has', '1 row belongs')
    """
    one = count == 1
    singular = {"have": "has", "are": "is", "pass": "passes"}.get(verb, f"{verb}s" if verb else "")
    return f"{count} {noun}{'' if one else 's'} {singular if one else verb}".rstrip()


def with_error(value: float, stderr: float) -> str:
    """Write a value with its standard error in the last digits: 0.0047(5).

    Examples
    --------
    >>> with_error(0.00471, 0.00052), with_error(38.5, 12.0), with_error(0.0385, 0.0019)
    ('0.0047(5)', '38(12)', '0.0385(19)')
    """
    if not (np.isfinite(stderr) and stderr > 0):
        return f"{value:.3g}"
    exponent = int(np.floor(np.log10(stderr)))
    # Two digits for 10 to 19, one otherwise: rounding then changes the error by less than 25 %.
    digits = -exponent + (1 if round(stderr / 10**exponent, 1) < 2 else 0)
    shown = round(stderr * 10.0**digits)
    if digits <= 0:
        return f"{round(value, digits):.0f}({shown * 10**-digits})"
    return f"{value:.{digits}f}({shown})"


def number_text(value: float, stderr: float = np.nan, *, digits: int = 3) -> str:
    """Write a number, with its standard error in the last digits, and a power of ten if needed.

    Parameters
    ----------
    value : float
    stderr : float, optional
        NaN or 0: the value alone.
    digits : int
        Significant digits of a value alone.

    Returns
    -------
    str

    Examples
    --------
    >>> number_text(0.00471, 0.00052), number_text(4.71e-7, 5.2e-8), number_text(-1840.0)
    ('0.0047(5)', '4.7(5) × 10⁻⁷', '−1840')
    """
    known = bool(np.isfinite(stderr)) and stderr > 0
    if not np.isfinite(value) or (value == 0 and not known):
        return f"{value:g}"
    power = power_of(max(abs(value), stderr) if known else value)
    shown = value / 10.0**power
    text = with_error(shown, stderr / 10.0**power) if known else significant(shown, digits)
    return (f"{text} × {ten_to(power)}" if power else text).replace("-", "−")


def significant(value: float, digits: int) -> str:
    """Write a number with `digits` significant digits and no exponent: 1840, not 1.84e+03."""
    text = np.format_float_positional(
        value, precision=digits, fractional=False, unique=False, trim="k"
    )
    return text.rstrip(".")


def power_of(value: float) -> int:
    """Return the power of ten to write after a value; 0 for values from 0.001 to 100000."""
    if not np.isfinite(value) or value == 0 or 1e-3 <= abs(value) < 1e5:
        return 0
    return int(np.floor(np.log10(abs(value))))


def ten_to(power: int) -> str:
    """Write a power of ten with raised digits."""
    return "10" + str(power).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))


def unit_text(ascii_unit: str) -> str:
    """Return a unit in typographic form: um^2/s becomes µm²/s."""
    return ascii_unit.replace("um", "µm").replace("^2", "²")


def shortened(name: str, *, most: int = 24) -> str:
    """Return a user's name for a cluster, shortened where it is too long for a figure."""
    return name if len(name) <= most else name[: most - 1] + "…"


def ordinal(n: int) -> str:
    """Return an ordinal number: 1st, 2nd, 3rd, 4th, 11th, 21st."""
    ending = "th" if n % 100 in (11, 12, 13) else {1: "st", 2: "nd", 3: "rd"}.get(n % 10, "th")
    return f"{n}{ending}"


def short(value: float) -> str:
    """Write a number with two digits, and no exponent where it is large."""
    return f"{value:.2g}" if value < 99.5 else f"{value:.0f}"


def percent(share: float) -> str:
    """Write a share in percent with two digits: 8.3 %, 23 %, 0.45 %."""
    return f"{100 * share:#.2g} %".replace(". %", " %")


def scaled_text(text: str, power: int) -> str:
    """Append a power of ten to a number, or to an interval in brackets.

    Examples
    --------
    >>> scaled_text("4.7", -7), scaled_text("3.9 to 5.7", -7), scaled_text("4.7", 0)
    ('4.7 × 10⁻⁷', '(3.9 to 5.7) × 10⁻⁷', '4.7')
    """
    if not power:
        return text
    return f"({text}) × {ten_to(power)}" if " " in text else f"{text} × {ten_to(power)}"


def interval_text(ends: tuple[float, float], *, power: int = 0) -> str:
    """Write an interval with two digits of its half width, and a power of ten.

    Parameters
    ----------
    ends : tuple of float
        The upper end may be infinite.
    power : int
        Power of ten that is taken out of both ends.

    Returns
    -------
    str

    Examples
    --------
    >>> interval_text((0.00434, 0.00601)), interval_text((2.0, np.inf))
    ('0.00434 to 0.00601', 'above 2.0')
    """
    low, high = (end / 10.0**power for end in ends)
    if not np.isfinite(high):
        return f"above {scaled_text(significant(low, 2), power)}" if low > 0 else "not bounded"
    half = (high - low) / 2
    decimals = max(1 - int(np.floor(np.log10(half))), 0) if half > 0 else 2
    # An end that is exactly 0 has no decimals.
    first = f"{low:.{decimals}f}" if low else "0"
    return scaled_text(f"{first} to {high:.{decimals}f}", power)


def length_text(um: float) -> str:
    """Write a length given in um, in nm below 10 um.

    Examples
    --------
    >>> length_text(0.0341), length_text(12.5), length_text(float("nan"))
    ('34.1 nm', '12.5 µm', 'unknown')
    """
    if not np.isfinite(um):
        return "unknown"
    return f"{number_text(1e3 * um)} nm" if um < 10 else f"{number_text(um)} µm"


def signed_text(value: float) -> str:
    """Write a number with its sign and one decimal.

    Examples
    --------
    >>> signed_text(-4.12), signed_text(0.3)
    ('−4.1', '+0.3')
    """
    return f"{value:+.1f}".replace("-", "−")


def printable(text: object) -> str:
    r"""Return a text in which no character controls a terminal or reverses the reading direction.

    Line ends stay. Others are written as in Python: an escape code of a terminal as ``\x1b``, a
    byte of a file's name that is no UTF-8 as ``\udcff``.

    Parameters
    ----------
    text : object

    Returns
    -------
    str

    Examples
    --------
    >>> printable("a\x1b[31m µm\n")
    'a\\x1b[31m µm\n'
    """
    return "".join(
        c if c == "\n" or c.isprintable() else c.encode("unicode_escape").decode()
        for c in str(text)
    )
