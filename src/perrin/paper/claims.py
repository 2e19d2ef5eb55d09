"""What a claim is, how it is judged, and how claims, figures and tables are written to a folder."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING
from zlib import crc32

import numpy as np

from perrin.plot.style import new_figure, save_figure
from perrin.run.folders import write_json

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    import pandas as pd
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Claim:
    """One statement with a number, beside the number found.

    Attributes
    ----------
    claim : str
        The statement, with the unit of its number.
    source : str
        Section, equation, figure or table of the paper: "Eqs. 1-4, section 2.1".
    expected, measured, tolerance : float
    basis : str
        Where the tolerance comes from.
    remark : str
        One sentence for the case that the claim does not hold.

    Examples
    --------
    >>> Claim("det R", "Eq. 4", expected=1.0, measured=1.0 + 1e-15, tolerance=1e-12).holds
    True
    """

    claim: str
    source: str
    expected: float
    measured: float
    tolerance: float
    basis: str = ""
    remark: str = ""

    @property
    def holds(self) -> bool:
        """Whether measured and expected differ by no more than the tolerance."""
        return bool(abs(self.measured - self.expected) <= self.tolerance)

    def to_dict(self) -> dict[str, str | float | bool]:
        """Return the claim's line in ``claims.json``."""
        return {
            "claim": self.claim,
            "source": self.source,
            "expected": float(self.expected),
            "measured": float(self.measured),
            "tolerance": float(self.tolerance),
            "holds": self.holds,
        }


def statistical(
    claim: str, source: str, *, expected: float, measured: float, stderr: float, remark: str = ""
) -> Claim:
    """Return a claim that may be off by three standard errors.

    Parameters
    ----------
    claim, source, expected, measured, remark
        As in `Claim`.
    stderr : float
        Standard error of `measured`.

    Returns
    -------
    Claim
    """
    basis = "3 standard errors"
    return Claim(claim, source, expected, measured, 3 * stderr, basis, remark)


@dataclass(frozen=True, eq=False)
class Item:
    """One figure with its data and the claims that rest on it.

    Attributes
    ----------
    name : str
        Stem of its files.
    section : str
        Where in the paper it belongs, as a heading.
    title, text : str
        What it shows; what was done.
    table : pandas.DataFrame
        The data.
    draw : callable
        Draws the data on an empty figure.
    claims : tuple of Claim
    size : tuple of float
        Width and height of the figure, inches.
    """

    name: str
    section: str
    title: str
    text: str
    table: pd.DataFrame
    draw: Callable[[Figure], None]
    claims: tuple[Claim, ...]
    size: tuple[float, float] = (10.0, 4.4)


@dataclass(frozen=True)
class Study:
    """What a run of the paper depends on.

    Attributes
    ----------
    seed : int
        Of all random numbers.
    planted_error : float
        Relative error put on every D_R that is simulated, while the expected values stay: a claim
        that is worth its name must notice.
    scale : float
        Multiplies the number of repeats, for short runs.
    """

    seed: int = 2011
    planted_error: float = 0.0
    scale: float = 1.0

    def rng(self, name: str) -> np.random.Generator:
        """Return random numbers of an item's own, whatever other items drew."""
        key = (crc32(name.encode()),)
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=key))

    def planted(self, D_R: float) -> float:
        """Return the D_R to simulate where `D_R` (rad^2/s) is expected."""
        return D_R * (1 + self.planted_error)

    def repeats(self, full: int) -> int:
        """Return how many repeats to make where a full run makes `full`."""
        return max(8, round(full * self.scale))


def write_item(item: Item, folder: Path) -> None:
    """Write an item's figure (PNG and PDF) and its data (CSV).

    Parameters
    ----------
    item : Item
    folder : Path
        Exists.
    """
    figure = new_figure(*item.size)
    item.draw(figure)
    save_figure(figure, folder / item.name)
    item.table.to_csv(folder / f"{item.name}.csv", index=False)


def write_claims(items: Sequence[Item], folder: Path, *, heading: str) -> None:
    """Write ``claims.json`` and the readable ``claims.md``.

    Parameters
    ----------
    items : sequence of Item
        In the order of the paper.
    folder : Path
        Exists.
    heading : str
        First lines of ``claims.md``.
    """
    claims = [claim.to_dict() for item in items for claim in item.claims]
    write_json(folder / "claims.json", claims)
    (folder / "claims.md").write_text(claims_page(items, heading=heading), encoding="utf-8")


def claims_page(items: Sequence[Item], *, heading: str) -> str:
    """Return the claims as a Markdown page: what does not hold first, then section by section.

    Parameters
    ----------
    items : sequence of Item
    heading : str

    Returns
    -------
    str
    """
    claims = [claim for item in items for claim in item.claims]
    failed = [claim for claim in claims if not claim.holds]
    lines = [heading, "", f"{len(claims)} claims, {len(claims) - len(failed)} hold.", ""]
    if failed:
        lines += ["## What does not hold", ""]
        lines += [f"- {c.claim} ({c.source}): {_verdict(c)}" for c in failed]
        lines += [""]
    section = ""
    for item in items:
        if item.section != section:
            section = item.section
            lines += [f"## {section}", ""]
        lines += [f"### {item.title}", "", item.text, ""]
        lines += [f"Figure `{item.name}.png`, `{item.name}.pdf`; data `{item.name}.csv`.", ""]
        lines += _claim_table(item.claims)
    return "\n".join(lines).rstrip() + "\n"


def _verdict(claim: Claim) -> str:
    return claim.remark or (
        f"{_number(claim.measured)} was measured, {_number(claim.expected)} ± "
        f"{_number(claim.tolerance)} expected."
    )


def _claim_table(claims: Sequence[Claim]) -> list[str]:
    """Return a Markdown table; a bar in a cell would end it."""
    lines = ["| claim | source | expected | measured | tolerance | holds |"]
    lines += ["|---|---|---|---|---|---|"]
    for c in claims:
        allowed = _number(c.tolerance) + (f" ({c.basis})" if c.basis else "")
        numbers = [_number(c.expected), _number(c.measured), allowed]
        cells = [c.claim, c.source, *numbers, "yes" if c.holds else "**no**"]
        lines.append("| " + " | ".join(cell.replace("|", r"\|") for cell in cells) + " |")
    return [*lines, ""]


def _number(value: float) -> str:
    return f"{value:.4g}"
