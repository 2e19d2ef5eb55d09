"""Claims of the paper: how they are judged and written, and that they detect planted errors.

The recorded states of all claims are checked by benchmarks/paper.py and, with --long, here.
"""

from __future__ import annotations

import functools
import json
import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from left_out import make_figures_without_rendering
from perrin.paper import remake
from perrin.paper.claims import Claim, Study, claims_page, statistical
from perrin.paper.experiment import conclusion, table_1
from perrin.paper.method import challis, localisation, simulation
from perrin.paper.noise import sampling
from perrin.paper.orientations import appendix, axes, correlation, figure_2, figure_6
from perrin.plot import figure_style as style

ROOT = Path(__file__).resolve().parents[1]
QUICK_ITEMS = (localisation, table_1, appendix)


@functools.cache
def claims_of(make, study):
    """Return the claims of an item, made once for each study."""
    return make(study).claims


@pytest.fixture(scope="module")
def benchmark():
    return runpy.run_path(str(ROOT / "benchmarks" / "paper.py"))


@pytest.fixture(scope="module")
def run(tmp_path_factory, request):
    """Return the folder and the claims of a reproduction: three items, or with --long all."""
    folder, seen = tmp_path_factory.mktemp("paper") / "run", []
    with pytest.MonkeyPatch.context() as patch:
        if not request.config.getoption("--long"):
            patch.setattr(remake, "ITEMS", QUICK_ITEMS)
            patch.setattr(style, "DPI", 60)
            # The fonts of PDF files take half of the time; tests of plots write them.
            draw = Figure.savefig
            patch.setattr(
                Figure,
                "savefig",
                lambda figure, to, **how: (
                    to.write_bytes(bytes(5001)) if to.suffix == ".pdf" else draw(figure, to, **how)
                ),
            )
        total = len(remake.ITEMS)
        claims = remake.reproduce(folder, progress=lambda done, all_, _: seen.append((done, all_)))
    assert seen == [(i, total) for i in range(1, total + 1)]
    return folder, claims, total


def test_every_claim_is_in_its_recorded_state(run, benchmark, request):
    """At the default seed exactly the recorded claims do not hold, each with a remark.

    In the quick form the page of the documentation has the claims of the quick items, in order.
    """
    folder, claims, _ = run
    page = (folder / "claims.md").read_text(encoding="utf-8")
    kept = (ROOT / "docs" / "paper.md").read_text(encoding="utf-8")
    if request.config.getoption("--long"):
        assert benchmark["differences"](claims, page, kept) == []
        return
    for claim in claims:
        assert claim.holds == (not claim.claim.startswith(benchmark["FAILING"])), claim
        assert claim.holds or claim.remark.endswith(".")
    rows, all_rows = benchmark["table_rows"](page), benchmark["table_rows"](kept)
    assert len(rows) == len(claims)
    assert [row for row in all_rows if row in rows] == rows


def test_the_documentation_has_the_recorded_states(benchmark):
    """In docs/paper.md the claims with "no" are those of the list, and no claim is repeated."""
    rows = benchmark["table_rows"]((ROOT / "docs" / "paper.md").read_text(encoding="utf-8"))
    assert len({row[0] for row in rows}) == len(rows) > 100
    for text, _, holds in rows:
        failing = text.replace(r"\|", "|").startswith(benchmark["FAILING"])
        assert holds == ("**no**" if failing else "yes"), text


def test_differences_from_the_record_are_reported(run, benchmark):
    """A claim in the opposite state, a repeated and a missing one are each named."""
    folder, claims, _ = run
    page = (folder / "claims.md").read_text(encoding="utf-8")
    known = benchmark["differences"](claims, page, page)
    turned = replace(claims[0], measured=claims[0].expected + 2 * claims[0].tolerance + 1)
    changed = benchmark["differences"]((turned, *claims[1:], claims[-1]), page, page + "| a |" * 6)
    assert f"made twice: {claims[-1].claim}" in changed
    assert any(line.startswith("does not hold, recorded otherwise") for line in changed)
    assert len(changed) > len(known)


def test_numbers_of_a_source(benchmark):
    assert benchmark["numbers_of"]("Eqs. 21-23, Fig. 4", r"Eqs?\.") == {21, 22, 23}
    assert benchmark["numbers_of"]("Eqs. 21-23, Fig. 4", r"Figs?\.") == {4}


def test_files(run):
    """Every item has a picture, its PDF and its data; claims.json has the returned claims."""
    folder, claims, total = run
    stems = {p.stem for p in folder.glob("*.png")}
    assert {"table1", "localisation", "appendix"} <= stems
    assert len(stems) == total
    for stem in stems:
        assert (folder / f"{stem}.png").stat().st_size > 3000
        assert (folder / f"{stem}.pdf").stat().st_size > 5000
        table = pd.read_csv(folder / f"{stem}.csv")
        assert len(table) >= 4
        assert table.notna().all(axis=None)
    entries = json.loads((folder / "claims.json").read_text())
    assert [Claim.from_dict(entry) for entry in entries] == list(claims)
    assert json.loads((folder / "run.json").read_text())["seed"] == 2011


def test_the_readable_page(run):
    """claims.md has every claim, and the remark of those that do not hold."""
    folder, claims, _ = run
    text = (folder / "claims.md").read_text()
    for c in claims:
        assert c.claim.replace("|", r"\|") in text
        assert c.holds or c.remark in text
    assert f"{len(claims)} claims, {sum(c.holds for c in claims)} hold." in text


def test_a_claim_without_a_remark_has_its_numbers_on_the_page():
    item = replace(localisation(Study()), claims=(Claim("a | b", "Eq. 1", 1.0, 1.5, 0.25),))
    page = claims_page([item], heading="# Claims")
    assert "- a | b (Eq. 1): 1.5 was measured, 1 ± 0.25 expected." in page
    assert r"| a \| b | Eq. 1 | 1 | 1.5 | 0.25 | **no** |" in page


def test_an_existing_folder_is_not_overwritten_without_request(run):
    folder, _, _ = run
    before = (folder / "claims.json").read_bytes()
    with pytest.raises(FileExistsError, match="exists"):
        remake.reproduce(folder)
    assert (folder / "claims.json").read_bytes() == before


def test_a_failed_run_leaves_nothing(tmp_path, monkeypatch):
    def broken(done, total, title):
        raise RuntimeError("stopped")

    monkeypatch.setattr(remake, "ITEMS", (localisation,))
    make_figures_without_rendering(monkeypatch)
    with pytest.raises(RuntimeError, match="stopped"):
        remake.reproduce(tmp_path / "run", progress=broken)
    assert list(tmp_path.iterdir()) == []


def test_every_item_of_the_paper_is_made():
    """The items are all functions of the paper's modules that take a study."""
    names = [make.__name__ for make in remake.ITEMS]
    assert len(set(names)) == len(names) == 18
    assert {*(f"figure_{k}" for k in range(1, 7)), "table_1", "appendix"} <= set(names)


def test_a_planted_error_is_noticed(repeats):
    """An error of every simulated D_R makes claims fail that hold otherwise: 5 % at least five.

    In the quick form, with a fifth of the repeats of two items, 15 % makes at least three fail.
    """
    makers = repeats((simulation, correlation), (simulation, axes, correlation, sampling, figure_6))
    seed, error, scale, least = repeats((0, 0.15, 0.2, 3), (2011, 0.05, 1.0, 5))
    held, failed = (
        {c.claim for make in makers for c in claims_of(make, study) if c.holds is state}
        for study, state in (
            (Study(seed=seed, scale=scale), True),
            (Study(seed=seed, scale=scale, planted_error=error), False),
        )
    )
    assert len(failed & held) >= least


def test_exact_claims_hold_at_every_seed(repeats):
    """Equations on noise-free data have no statistical tolerance."""
    for seed in range(repeats(1, 3)):
        study = Study(seed=seed)
        for make in repeats(
            (challis, appendix, figure_2), (challis, appendix, figure_2, conclusion)
        ):
            for c in make(study).claims:
                if "standard errors" not in c.basis and not c.remark:
                    assert c.holds, (seed, c)


def test_statistical_claims_have_no_bias_and_correct_errors(repeats):
    """Over seeds the deviations of 3-sigma claims scatter as their standard errors state."""
    makers = repeats((simulation, correlation), (simulation, figure_2, axes, correlation, figure_6))
    seeds, scale = repeats((3, 0.2), (4, 0.25))
    z: dict[str, list[float]] = {}
    for seed in range(seeds):
        for make in makers:
            for c in claims_of(make, Study(seed=seed, scale=scale)):
                # The worst of several curves is no single normal deviate.
                if c.basis == "3 standard errors" and not c.remark and "worst" not in c.claim:
                    z.setdefault(c.claim, []).append(3 * (c.measured - c.expected) / c.tolerance)
    values = np.array(list(z.values()))
    assert values.size > repeats(14, 40)
    # A normal deviate is beyond 3 once in 370, and errors from 10 repeats have heavier tails.
    assert np.sum(np.abs(values) > 3) <= repeats(1, 3)
    low, high = repeats((0.4, 1.7), (0.75, 1.3))
    assert low < np.sqrt(np.mean(values**2)) < high
    assert np.all(np.abs(values.mean(axis=1)) < 4 / np.sqrt(seeds))


def test_items_do_not_depend_on_each_other():
    """An item alone draws the same numbers as after others; another seed draws others."""
    one, again, other = (challis(Study(seed=s)).table["svd"].tolist() for s in (1, 1, 2))
    assert one == again != other


def test_a_claim_is_judged_by_its_tolerance():
    assert Claim("a", "Eq. 1", 1.0, 1.1, 0.2).holds
    assert not Claim("a", "Eq. 1", 1.0, 1.3, 0.2).holds
    assert not Claim("a", "Eq. 1", 1.0, float("nan"), 0.2).holds
    assert statistical("a", "Eq. 1", expected=0.0, measured=0.0, stderr=0.1).tolerance == (
        pytest.approx(0.3)
    )
