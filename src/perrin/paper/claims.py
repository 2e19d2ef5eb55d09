"""Claims of the paper: how they are judged, and how figures and tables are written."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any
from zlib import crc32

import numpy as np

from perrin.plot.figure_style import new_figure, palette, save_figure
from perrin.tracks.writing import write_json

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    import pandas as pd
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Claim:
    """One statement of the paper with its number, and the number that was measured.

    Attributes
    ----------
    claim : str
        The statement, with the unit of its number.
    source : str
        Section, equation, figure or table of the paper: "Eqs. 1-4, section 2.1".
    expected : float
        Number that the paper states or its theory predicts.
    measured : float
        Number that the reproduction found.
    tolerance : float
        Largest difference at which the claim still holds.
    basis : str
        Reason for the tolerance: "rounding", "3 standard errors", "2 %".
    remark : str
        One sentence that explains why the claim does not hold; shown only then.

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
        """Return the claim's entry in ``claims.json``.

        Returns
        -------
        dict
            The attributes, and whether the claim "holds".
        """
        return {
            "claim": self.claim,
            "source": self.source,
            "expected": float(self.expected),
            "measured": float(self.measured),
            "tolerance": float(self.tolerance),
            "holds": self.holds,
            "basis": self.basis,
            "remark": self.remark,
        }

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> Claim:
        """Return the claim that `to_dict` wrote.

        Parameters
        ----------
        entry : mapping
            One entry of ``claims.json``.

        Returns
        -------
        Claim

        Examples
        --------
        >>> claim = Claim("det R", "Eq. 4", expected=1.0, measured=1.1, tolerance=0.2)
        >>> Claim.from_dict(claim.to_dict()) == claim
        True
        """
        return cls(**{key: value for key, value in entry.items() if key != "holds"})


def statistical(
    claim: str, source: str, *, expected: float, measured: float, stderr: float, remark: str = ""
) -> Claim:
    """Return a claim whose tolerance is three standard errors.

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
    """One figure or table of the paper, its data, and the claims that it tests.

    Attributes
    ----------
    name : str
        Name of its files without suffix.
    section : str
        Heading: number and title of the section of the paper.
    title : str
        Heading: what the figure shows.
    text : str
        How the data were made.
    table : pandas.DataFrame
        Data of the figure, written as CSV.
    draw : callable
        Function that draws the data on an empty figure.
    claims : tuple of Claim
        Claims that the data test.
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
    """Settings of a reproduction of the paper.

    Attributes
    ----------
    seed : int
        Seed of all random numbers.
    planted_error : float
        Relative error of every simulated D_R while the expected values stay the same. It tests
        whether the claims detect such an error.
    scale : float
        Factor of the numbers of repeats; below 1 for short runs.
    """

    seed: int = 2011
    planted_error: float = 0.0
    scale: float = 1.0

    def rng(self, name: str) -> np.random.Generator:
        """Return the random-number generator of an item, independent of those of other items."""
        key = (crc32(name.encode()),)
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=key))

    def planted(self, D_R: float) -> float:
        """Return the D_R to simulate where `D_R` (rad^2/s) is expected."""
        return D_R * (1 + self.planted_error)

    def repeats(self, full: int) -> int:
        """Return the number of repeats, `full` times `scale` but at least 8."""
        return max(8, round(full * self.scale))


def write_item(item: Item, folder: Path) -> None:
    """Write an item's figure (PNG and PDF) and its data (CSV).

    Parameters
    ----------
    item : Item
    folder : Path
        An existing folder.
    """
    with palette():
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
        An existing folder.
    heading : str
        First lines of ``claims.md``.
    """
    claims = [claim.to_dict() for item in items for claim in item.claims]
    write_json(folder / "claims.json", claims)
    (folder / "claims.md").write_text(claims_page(items, heading=heading), encoding="utf-8")


def claims_page(items: Sequence[Item], *, heading: str) -> str:
    """Return the claims as a Markdown page: those that do not hold first, then by section.

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
        lines += ["## Claims that do not hold", ""]
        for c in failed:
            expected = f"{c.expected:.4g} ± {c.tolerance:.4g}"
            measured = f"{c.measured:.4g} was measured, {expected} expected."
            lines += [f"- {c.claim} ({c.source}): {c.remark or measured}"]
        lines += [""]
    section = ""
    for item in items:
        if item.section != section:
            section = item.section
            lines += [f"## {section}", ""]
        lines += [f"### {item.title}", "", item.text, ""]
        lines += [f"Figure `{item.name}.png`, `{item.name}.pdf`; data `{item.name}.csv`.", ""]
        lines += ["| claim | source | expected | measured | tolerance | holds |"]
        lines += ["|---|---|---|---|---|---|"]
        for c in item.claims:
            allowed = f"{c.tolerance:.4g}" + (f" ({c.basis})" if c.basis else "")
            cells = [c.claim, c.source, f"{c.expected:.4g}", f"{c.measured:.4g}", allowed]
            cells += ["yes" if c.holds else "**no**"]
            # A bar in a cell would end it.
            lines += ["| " + " | ".join(cell.replace("|", r"\|") for cell in cells) + " |"]
        lines += [""]
    return "\n".join(lines).rstrip() + "\n"
