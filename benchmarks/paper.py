"""Reproduces Hunter et al. 2011 and checks that every claim is in its recorded state.

Usage: OMP_NUM_THREADS=1 python benchmarks/paper.py [-o FOLDER]

Runs `perrin.paper.reproduce` with the default seed, prints one row for each section of the paper,
and compares every claim with two records: the list FAILING of the claims that do not hold, in this
file, and the table of docs/paper.md. Exits with status 1 if any claim differs from its record. With
-o the figures, tables and claims are kept in FOLDER. Takes 1.5 minutes of processor time.
"""

from __future__ import annotations

import argparse
import re
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from perrin.paper.remake import reproduce

if TYPE_CHECKING:
    from collections.abc import Iterable

    from perrin.paper.claims import Claim

PAGE = Path(__file__).resolve().parents[1] / "docs" / "paper.md"

# The claims that do not hold at the default seed, by the beginning of their text.
FAILING = (
    "n = 5 is accurately the simulated pentahedron",
    "the product reconstructs the entire trajectory",
    "p across the long axis measures the motion about that axis",
    "Phi^2 over 6 sigma^2/(n R^2), pentahedron, all directions",
    "MSAD less Phi^2 is 4 D_R dt: worst deviation in standard errors at seven lags from 1 to 100, "
    "product, sigma = 100 nm, tetrahedron, D_R = 0.0001",
    "MSAD less Phi^2 is 4 D_R dt: worst deviation in standard errors at seven lags from 1 to 100, "
    "product, sigma = 100 nm, pentahedron, D_R = 0.0001",
    "Phi^2 over 6 sigma^2/(n R^2), 3 touching spheres, all directions",
    "Phi^2 over 6 sigma^2/(n R^2), 5 touching spheres, all directions",
    "MSADs of stationary clusters are constant over time",
    "particles are identified up to 4 D_R dt = 1",
    "relative error of D_R (printed",
    "relative error of D_T (printed",
    "least squares over all particles explains",
    "error of d_",
    "1 - dphi^2 approximates cos(dphi)",
)


def table_rows(page: str) -> list[list[str]]:
    """Return the claims of a Markdown page: text, source and whether they hold."""
    rows = []
    for line in page.splitlines():
        cells = re.split(r"(?<!\\)\|", line)[1:-1]
        if len(cells) == 6 and cells[0].strip() not in ("claim", "---"):
            rows.append([cells[k].strip() for k in (0, 1, 5)])
    return rows


def numbers_of(source: str, kind: str) -> set[int]:
    """Return the numbers that a source names: 'Eqs. 21-23' is 21, 22, 23."""
    found: set[int] = set()
    for first, last in re.findall(kind + r" (\d+)(?:-(\d+))?", source):
        found |= set(range(int(first), int(last or first) + 1))
    return found


def differences(claims: Iterable[Claim], page: str, kept: str) -> list[str]:
    """Return one line for every difference between the claims and their records.

    `page` is claims.md of the reproduction, `kept` the page of the documentation.
    """
    claims = list(claims)
    texts = [claim.claim for claim in claims]
    lines = [f"made twice: {text}" for text in sorted(set(texts)) if texts.count(text) > 1]
    for claim in claims:
        expected = not claim.claim.startswith(FAILING)
        if claim.holds != expected:
            state = "holds" if claim.holds else "does not hold"
            lines.append(f"{state}, recorded otherwise: {claim.claim} ({claim.measured:.4g})")
        if not claim.holds and not re.search(r"\d.*\.$", claim.remark):
            lines.append(f"does not hold and has no remark with a number: {claim.claim}")
    lines += [f"recorded but not made: {text}" for text in FAILING
              if not any(claim.startswith(text) for claim in texts)]  # fmt: skip
    for kind, numbers in ((r"Eqs?\.", range(1, 36)), (r"Figs?\.", range(1, 7)), ("Table", (1,))):
        named = set().union(*(numbers_of(claim.source, kind) for claim in claims))
        if named != set(numbers):
            lines.append(f"sources of {kind}: {sorted(named ^ set(numbers))} differ")
    if table_rows(page) != table_rows(kept):
        lines.append("docs/paper.md differs: copy claims.md of `perrin paper` to it")
    return lines


def main() -> int:
    """Run the reproduction and print the table and the differences."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("-o", "--output", type=Path, help="folder for the results")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        folder = options.output or Path(place) / "paper"
        claims = reproduce(
            folder,
            overwrite=True,
            progress=lambda done, total, title: print(f"{done} of {total}: {title}", flush=True),
        )
        page = (folder / "claims.md").read_text(encoding="utf-8")
    place_of = re.compile(r"(section [\d.]+|appendix)$")
    sources = dict.fromkeys("".join(place_of.findall(claim.source)) for claim in claims)
    print("hold | fail | largest deviation over tolerance of those that hold | source")
    for source in sources:
        part = [c for c in claims if c.source.endswith(source)]
        held = [c for c in part if c.holds]
        ratios = [abs(c.measured - c.expected) / c.tolerance for c in held if c.tolerance > 0]
        worst = max(ratios, default=0.0)
        print(f"{len(held):4d} | {len(part) - len(held):4d} | {worst:.2f} | {source}")
    lines = differences(claims, page, PAGE.read_text(encoding="utf-8"))
    print(f"{len(claims)} claims, {sum(c.holds for c in claims)} hold, {len(lines)} differences")
    print("\n".join(lines))
    return 1 if lines else 0


if __name__ == "__main__":
    sys.exit(main())
