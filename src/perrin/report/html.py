"""Pages of HTML that need no other file: their templates, and pictures put into their text."""

from __future__ import annotations

import base64
from datetime import datetime
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jinja2 import Environment, FunctionLoader, StrictUndefined

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping


def render_page(template: str, **values: Any) -> str:  # noqa: ANN401 (whatever templates show)
    """Fill a template of the package.

    Parameters
    ----------
    template : str
        "report" or "quality".
    **values
        What the template shows. Text of users (labels, paths) goes through the template alone,
        which escapes it.

    Returns
    -------
    str
    """
    environment = Environment(
        loader=FunctionLoader(_source),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(**values)


def inline_pictures(figures: Iterable[Path]) -> dict[str, str]:
    """Return the PNGs among some files as data URLs, by their names without suffix."""
    return {f.stem: _inline(f) for f in figures if f.suffix == ".png"}


def captioned(
    pictures: Mapping[str, str], stem: str, kind: str, caption: tuple[str, str, str]
) -> dict[str, str] | None:
    """Return a picture with its title, what it shows and what to look for; None if not drawn."""
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
    """Return the name of a run's input and the date of the run, in words."""
    path, created = settings.get("input", {}).get("path"), settings.get("created")
    return {
        "input_name": Path(path).name if path else "table in memory",
        "date": f"{datetime.fromisoformat(created):%Y-%m-%d %H:%M} UTC" if created else "no date",
    }


def _source(name: str) -> str:
    return (files("perrin.report") / f"templates/{name}.html.jinja").read_text(encoding="utf-8")


def _inline(file: Path) -> str:
    return "data:image/png;base64," + base64.b64encode(file.read_bytes()).decode("ascii")
