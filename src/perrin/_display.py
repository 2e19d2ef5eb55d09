"""One-line representations of results, and tables of them in notebooks."""

from __future__ import annotations

from dataclasses import fields
from html import escape
from typing import Any

import numpy as np

_SHOWN_ITEMS = 4  # longer sequences are shown by their length
_LONGEST_LINE = 240  # letters of a representation


class Shown:
    """Representation in one line, table in a notebook, and format, for result classes.

    A class that defines ``__str__`` is represented by it, others by their fields. With a format
    specification a result that converts to float is written as that number.

    Examples
    --------
    >>> from perrin import Compared
    >>> Compared(predicted=6.73e-3, measured=4.93e-3, stderr=0.49e-3)
    Compared(predicted=0.00673, measured=0.00493, stderr=0.00049)
    """

    def __repr__(self) -> str:
        kind = type(self)
        if kind.__str__ is object.__str__:
            parts = [f"{name}={text}" for name, text in self._shown_fields()]
            inside = ", ".join(parts)
        else:
            inside = str(self).split("\n", maxsplit=1)[0]
        if len(inside) > _LONGEST_LINE:
            inside = inside[:_LONGEST_LINE].rpartition(" ")[0] + " …"
        return f"{kind.__name__}({inside})"

    def __format__(self, spec: str) -> str:
        return format(float(self), spec) if spec else str(self)  # type: ignore[arg-type]

    def _repr_html_(self) -> str:
        """Return a table of the fields for a notebook."""
        rows = "".join(
            f"<tr><th style='text-align:left'>{escape(name)}</th>"
            f"<td style='text-align:left'>{escape(text)}</td></tr>"
            for name, text in self._shown_fields()
        )
        title = escape(type(self).__name__)
        if type(self).__str__ is not object.__str__:
            title += f": {escape(str(self))}"
        return f"<table><caption style='text-align:left'>{title}</caption>{rows}</table>"

    def _shown_fields(self) -> list[tuple[str, str]]:
        """Return names and short texts of the fields that have a value."""
        named = [(f.name, getattr(self, f.name)) for f in fields(self)]  # type: ignore[arg-type]
        return [(name, _short_text(value)) for name, value in named if value is not None]


def _short_text(value: Any) -> str:  # noqa: ANN401 (values of any type)
    """Write a number in four digits, an array as its shape, a long sequence as its length."""
    if isinstance(value, np.ndarray):
        short = value.size <= _SHOWN_ITEMS and value.ndim == 1
        return _short_text(value.tolist()) if short else f"array of shape {value.shape}"
    if isinstance(value, float | np.floating):
        return f"{float(value):.4g}"
    if isinstance(value, dict):
        if len(value) > 2 * _SHOWN_ITEMS:
            return f"{len(value)} entries"
        return "{" + ", ".join(f"{k}: {_short_text(x)}" for k, x in value.items()) + "}"
    if isinstance(value, tuple | list):
        # Last values of a named tuple that are the usual ones are not shown.
        usual = getattr(value, "_field_defaults", {})
        names = list(getattr(value, "_fields", ()))
        while names and names[-1] in usual and value[len(names) - 1] == usual[names[-1]]:
            value = value[: len(names) - 1]
            names.pop()
        if len(value) > _SHOWN_ITEMS:
            return f"{len(value)} items"
        return f"({', '.join(map(_short_text, value))})"
    return str(value)
