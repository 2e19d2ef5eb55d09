"""Kinds of bodies that occur in several runs: the same number of particles and the same shape."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from perrin._arrays import frozen
from perrin.run.kinds import shape_numbers, usual_symmetry

if TYPE_CHECKING:
    from collections.abc import Sequence

    from perrin._arrays import Floats


@dataclass(frozen=True, eq=False)
class RunKind:
    """A kind of bodies of one run.

    Attributes
    ----------
    size : int
        Number of particles.
    point_group : str
        Schoenflies symbol that most of the clusters have.
    template : ndarray, shape (n, d)
        Positions of the particles of one of the bodies, um, or in diameters of a sphere where that
        is known.
    count : int
        Number of clusters.
    """

    size: int
    point_group: str
    template: Floats
    count: int = 1

    def __post_init__(self) -> None:
        frozen(self.template)


def study_kinds(kinds: Sequence[RunKind]) -> list[str]:
    """Return the name of the kind of bodies to which each kind of a run belongs in the study.

    Sizes and shapes are compared over all runs as `Report.kinds` compares them within one, so that
    dimers, trimers and tetrahedra of a mixture are never averaged. The symmetry in the name is that
    of most clusters: noise may hide the symmetry of some.

    Parameters
    ----------
    kinds : sequence of RunKind

    Returns
    -------
    list of str
        Names such as "4 particles, T_d"; two shapes with the same name are numbered.

    Examples
    --------
    >>> from perrin import Cluster
    >>> found = [
    ...     RunKind(n, group, Cluster.touching(n, 2.0).positions)
    ...     for n, group in ((4, "T_d"), (3, "D_3h"), (4, "C_1"))
    ... ]
    >>> study_kinds(found)
    ['4 particles, T_d', '3 particles, D_3h', '4 particles, T_d']
    """
    numbers = shape_numbers([one.template for one in kinds])
    names: dict[int, str] = {}
    for number in dict.fromkeys(int(k) for k in np.sort(numbers)):
        same = [kind for kind, k in zip(kinds, numbers, strict=True) if k == number]
        groups = [kind.point_group for kind in same for _ in range(kind.count)]
        names[number] = f"{same[0].size} particles, {usual_symmetry(groups)}"
    twice = {name for name in names.values() if list(names.values()).count(name) > 1}
    seen: dict[str, int] = {}
    for number, name in names.items():
        if name in twice:
            seen[name] = seen.get(name, 0) + 1
            names[number] = f"{name}, shape {seen[name]}"
    return [names[int(k)] for k in numbers]
