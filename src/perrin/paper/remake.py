"""Reproduction of Hunter et al. 2011: every equation, figure and table."""

from __future__ import annotations

from typing import TYPE_CHECKING

from perrin import __version__
from perrin.paper.claims import Study, write_claims, write_item
from perrin.paper.experiment import conclusion, figure_5, table_1
from perrin.paper.method import challis, figure_1, localisation, product, simulation
from perrin.paper.noise import bodies, constancy, figure_3, figure_4, sampling
from perrin.paper.orientations import appendix, axes, correlation, figure_2, figure_6
from perrin.run.folders import staged_folder
from perrin.tracks.writing import write_json

if TYPE_CHECKING:
    import os
    from collections.abc import Callable

    from perrin.paper.claims import Claim, Item


# The items in the order of the paper.
ITEMS: tuple[Callable[[Study], Item], ...] = (
    figure_1, challis, product, localisation, simulation, figure_2, axes, correlation,
    figure_3, figure_4, bodies, constancy, sampling, figure_5, table_1, conclusion, appendix,
    figure_6,
)  # fmt: skip

_HEADING = """# The paper, claim by claim

G. L. Hunter, K. V. Edmond, M. T. Elsesser and E. R. Weeks, "Tracking rotational diffusion of
colloidal clusters", Optics Express 19, 17189 (2011), reproduced by `perrin paper`. Every number
under "measured" is a result of that run. A claim holds if it differs from the expected number by no
more than the tolerance. Statistical tolerances are three standard errors: of more than a
hundred claims one may fail by chance with another seed."""


def reproduce(
    folder: str | os.PathLike[str],
    *,
    seed: int = 2011,
    planted_error: float = 0.0,
    overwrite: bool = False,
    progress: Callable[[int, int, str], None] | None = None,
) -> tuple[Claim, ...]:
    """Reproduce the paper and write the results to a folder, complete or not at all.

    Parameters
    ----------
    folder : path
        Place of a PNG, PDF and CSV file for each item, ``claims.json``, ``claims.md`` and
        ``run.json``.
    seed : int
        Seed of all random numbers; items draw independently of each other.
    planted_error : float
        Relative error of every simulated D_R while the expected values stay the same, to test
        whether the claims detect it.
    overwrite : bool
        Replace a folder that an earlier run has written.
    progress : callable, optional
        Called with the number of finished items, their total, and the title of the last one.

    Returns
    -------
    tuple of Claim
        In the order of the paper.

    Raises
    ------
    FileExistsError
        If the folder exists and `overwrite` is not set, or is not one that perrin wrote.
    """
    study = Study(seed=seed, planted_error=planted_error)
    items: list[Item] = []
    with staged_folder(folder, overwrite=overwrite) as stage:
        for number, make in enumerate(ITEMS, start=1):
            items.append(make(study))
            write_item(items[-1], stage)
            if progress is not None:
                progress(number, len(ITEMS), items[-1].title)
        write_claims(items, stage, heading=_HEADING)
        settings = {"made": "paper", "perrin": __version__, "seed": seed,
                    "planted_error": planted_error}  # fmt: skip
        write_json(stage / "run.json", settings)
    return tuple(claim for item in items for claim in item.claims)
