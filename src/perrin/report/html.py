"""HTML pages that need no other file: templates, and pictures as data URLs."""

from __future__ import annotations

import base64
import re
from datetime import datetime
from functools import lru_cache
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jinja2 import Environment, FunctionLoader, StrictUndefined
from markupsafe import Markup, escape

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping


def render_page(template: str, **values: Any) -> str:  # noqa: ANN401 (values of any type)
    """Fill a template of the package.

    Parameters
    ----------
    template : str
        Name without suffix.
    **values
        Values of the template's variables. The template escapes them, because labels and paths
        are text of users.

    Returns
    -------
    str
    """
    return _environment().get_template(template).render(**values)


def write_page(path: Path, html: str) -> None:
    """Write a page in UTF-8.

    Parts of file names that are not UTF-8 become numbers of characters, which browsers show as
    unknown.

    Parameters
    ----------
    path : Path
        File that is written.
    html : str
    """
    path.write_text(html, encoding="utf-8", errors="xmlcharrefreplace")


def render_part(template: str, macro: str, *values: Any) -> str:  # noqa: ANN401 (values of any type)
    """Fill one macro of a template of the package.

    Parameters
    ----------
    template, macro : str
    *values
        Arguments of the macro, escaped by it.

    Returns
    -------
    str
    """
    return str(getattr(_environment().get_template(template).module, macro)(*values))


@lru_cache(maxsize=1)
def _environment() -> Environment:
    """Return the package's templates, compiled once."""
    folder = files("perrin.report") / "templates"
    environment = Environment(
        loader=FunctionLoader(
            lambda name: (folder / f"{name}.html.jinja").read_text(encoding="utf-8")
        ),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["symbols"] = symbols
    return environment


def symbols(text: str) -> Markup:
    """Escape a text, and set the indices and units of its coefficients.

    Parameters
    ----------
    text : str
        Text of results or of a user: "D_R +- 1 um^2/s".

    Returns
    -------
    markupsafe.Markup

    Examples
    --------
    >>> print(symbols("D_T < 2 um^2/s"))
    <i>D</i><sub>T</sub> &lt; 2 µm²/s
    """
    marked = re.sub(r"\bum\b", "µm", str(escape(text))).replace("^2", "²")
    marked = marked.replace("_inf", "_∞").replace("+-", "±").replace("Phi²", "Φ²")
    marked = re.sub(r"\bsigma_(xy|[xyz])\b", r"σ<sub>\1</sub>", marked)
    marked = re.sub(r"\bsigma\b", "σ", marked)
    for letter, index in (("R", "R"), ("T", "T"), ("perp", "⊥")):
        marked = re.sub(rf"\bD_{letter}\b", f"<i>D</i><sub>{index}</sub>", marked)
    return Markup(marked)


def inline_pictures(figures: Iterable[Path]) -> dict[str, str]:
    """Return the PNGs among some files as data URLs.

    Parameters
    ----------
    figures : iterable of Path

    Returns
    -------
    dict
        Data URL of each PNG, by its file name without suffix.
    """
    start = "data:image/png;base64,"
    return {
        f.stem: start + base64.b64encode(f.read_bytes()).decode("ascii")
        for f in figures
        if f.suffix == ".png"
    }


def captioned(
    pictures: Mapping[str, str], stem: str, kind: str, caption: tuple[str, str, str]
) -> dict[str, str] | None:
    """Return what a template needs of a picture, or None if it was not drawn.

    Parameters
    ----------
    pictures : mapping
        Data URLs of `inline_pictures`.
    stem : str
        File name of the picture without suffix.
    kind : str
        Kind of the picture, its class in the page.
    caption : tuple of str
        Title, what it shows, and what to look for.

    Returns
    -------
    dict or None
    """
    if stem not in pictures:
        return None
    title, shows, look_for = caption
    return {
        "source": pictures[stem],
        "kind": kind,
        "title": title,
        "shows": shows,
        "look_for": look_for,
    }


def byline(settings: Mapping[str, Any]) -> dict[str, str]:
    """Return the name of a run's input and the date of the run as text.

    Parameters
    ----------
    settings : mapping
        `Report.settings`.

    Returns
    -------
    dict
        "input_name" and "date".

    Examples
    --------
    >>> byline({"input": {"path": "data/tracks.csv"}})
    {'input_name': 'tracks.csv', 'date': 'no date'}
    """
    path, created = settings.get("input", {}).get("path"), settings.get("created")
    return {
        "input_name": Path(path).name if path else "table in memory",
        "date": f"{datetime.fromisoformat(created):%Y-%m-%d %H:%M} UTC" if created else "no date",
    }
