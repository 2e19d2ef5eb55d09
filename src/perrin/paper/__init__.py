"""Hunter et al. 2011 reproduced from the public functions."""

from perrin.paper.claims import (
    Claim,
    Item,
    Study,
    claims_page,
    statistical,
    write_claims,
    write_item,
)
from perrin.paper.experiment import conclusion, figure_5, table_1
from perrin.paper.method import (
    challis,
    figure_1,
    localisation,
    product,
    random_rotations,
    simulation,
    unit,
)
from perrin.paper.noise import bodies, constancy, figure_3, figure_4, sampling
from perrin.paper.orientations import appendix, axes, correlation, figure_2, figure_6
from perrin.paper.remake import reproduce

__all__ = [
    "Claim",
    "Item",
    "Study",
    "appendix",
    "axes",
    "bodies",
    "challis",
    "claims_page",
    "conclusion",
    "constancy",
    "correlation",
    "figure_1",
    "figure_2",
    "figure_3",
    "figure_4",
    "figure_5",
    "figure_6",
    "localisation",
    "product",
    "random_rotations",
    "reproduce",
    "sampling",
    "simulation",
    "statistical",
    "table_1",
    "unit",
    "write_claims",
    "write_item",
]
