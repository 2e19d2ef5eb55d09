"""Clusters and movies that do not belong to the others, and what each changes."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from perrin._arrays import to_plain
from perrin._display import Shown
from perrin._text import percent
from perrin.diffusion.estimate import NORMAL
from perrin.study.profiles import Coefficient
from perrin.study.random_effects import population_mean

if TYPE_CHECKING:
    from collections.abc import Hashable, Mapping, Sequence
    from typing import Self

    from perrin._arrays import Floats
    from perrin.study.profiles import Interval
    from perrin.study.random_effects import PopulationMean

# Members whose deviation is computed with the spreads of the others: those that deviate most, by
# more than this many standard deviations with the spreads of all. An outlier raises these spreads,
# but among three members it still deviates by 1.1.
_CANDIDATES, _SUSPECT = 3, 1.1

_OUTLYING = 0.05  # probability that any member of a population without outliers is called outlying


@dataclass(frozen=True, repr=False)
class Influence(Shown):
    """How far a cluster or a movie lies from the others, and how it changes their mean.

    Attributes
    ----------
    kind : {"cluster", "movie"}
    index : int
        Number of the cluster, or of the movie in order of appearance, from 0.
    change : float
        Relative change of the mean when it is left out.
    change_in_errors : float
        That change in standard errors of the mean of all.
    deviation : float
        Distance of ln D from the mean of the others, in standard deviations of a new member: its
        own error, the spreads and the error of the mean together.
    p : float
        Probability that any of as many members lies at least as far from the others (Holm).
    outlying : bool
        Whether p is below 0.05.
    """

    kind: Literal["cluster", "movie"]
    index: int
    change: float
    change_in_errors: float
    deviation: float
    p: float
    outlying: bool

    @property
    def text(self) -> str:
        """One sentence: deviation, p and change of the mean."""
        far = "an outlier" if self.outlying else "within the scatter of the others"
        return (
            f"{self.kind} {self.index}: {far} ({self.deviation:+.1f} standard deviations, p = "
            f"{self.p:.2g}); without it the mean changes by {percent(self.change)}"
        )

    def __str__(self) -> str:
        return self.text

    def to_dict(self) -> dict[str, Any]:
        """Return the influence for JSON."""
        entry: dict[str, Any] = to_plain(asdict(self))
        return entry

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> Self:
        """Return the influence that `to_dict` wrote.

        Parameters
        ----------
        entry : mapping
        """
        return cls(**entry)


def leave_one_out(
    coefficients: Sequence[Interval],
    *,
    movies: Sequence[Hashable] | None = None,
    kind: Literal["cluster", "movie"] = "cluster",
    mean: PopulationMean | None = None,
) -> list[Influence]:
    """Return the influence of every cluster, or of every movie, on the mean of a population.

    Parameters
    ----------
    coefficients, movies
        As in `population_mean`.
    kind : {"cluster", "movie"}
        What is left out.
    mean : PopulationMean, optional
        Mean of all, where it is known.

    Returns
    -------
    list of Influence
        In the order of the clusters (or of the movies' first clusters); empty where fewer than
        three are there, for then the others cannot show which one is wrong.

    Notes
    -----
    Means without one member are weighted means of ln D with the spreads of all; for the three
    members that deviate most the spreads are estimated without them, as an outlier raises the
    spread that would hide it. Probabilities are those of Student's t, corrected for the
    number of members (Holm, Scand. J. Stat. 6, 65, 1979).

    Examples
    --------
    >>> values = [1.0, 1.1, 0.9, 1.05, 0.95, 1.02, 3.0]
    >>> clusters = [Coefficient(v, (0.95 * v, 1.05 * v), (0.9 * v, 1.1 * v)) for v in values]
    >>> [one.index for one in leave_one_out(clusters) if one.outlying]
    [6]
    """
    from scipy.special import ndtri, stdtr

    members = [Coefficient.of(one) for one in coefficients]
    names = ["one movie"] * len(members) if movies is None else list(movies)
    if kind == "movie":
        groups = [[i for i, n in enumerate(names) if n == name] for name in dict.fromkeys(names)]
    else:
        groups = [[i] for i in range(len(members))]
    if len(groups) < 3:
        return []
    whole = population_mean(members, movies=names) if mean is None else mean
    by_movie = kind == "movie"
    centre, variance = _log_moments(members, names, whole, by_movie=by_movie)
    weight = 1 / variance
    total, load = float(weight @ centre), float(weight.sum())
    others = (total - weight * centre) / (load - weight)
    change = others - total / load
    spread = np.sqrt(variance + 1 / (load - weight))
    deviation = (centre - others) / spread
    dof = np.full(len(groups), float(max(len(groups) - 2, 1)))
    far = np.argsort(-np.abs(deviation))[:_CANDIDATES]
    # Half of the populations of this size have such a deviation somewhere, at least.
    usual = float(-ndtri((1 - 0.5 ** (1 / len(groups))) / 2))
    for k in far[np.abs(deviation[far]) > max(_SUSPECT, usual - 0.5)]:
        rest = [i for j, group in enumerate(groups) if j != k for i in group]
        without = population_mean([members[i] for i in rest], movies=[names[i] for i in rest])
        left_out = [members[i] for i in groups[k]]
        _, (own,) = _log_moments(left_out, ["one"] * len(left_out), without, by_movie=by_movie)
        deviation[k] = (centre[k] - np.log(without.value)) / np.sqrt(own + without.log_stderr**2)
        change[k] = np.log(without.value / whole.value)
        dof[k] = max(without.dof, 1) if by_movie else max(len(rest) - 1, 1)
    p = _holm(2 * stdtr(dof, -np.abs(deviation)))
    return [
        Influence(
            kind=kind,
            index=k,
            change=float(np.expm1(change[k])),
            change_in_errors=float(change[k] / whole.log_stderr),
            deviation=float(deviation[k]),
            p=float(p[k]),
            outlying=bool(p[k] < _OUTLYING),
        )
        for k in range(len(groups))
    ]


def _log_moments(
    members: Sequence[Coefficient],
    names: Sequence[Hashable],
    population: PopulationMean,
    *,
    by_movie: bool,
) -> tuple[Floats, Floats]:
    """Return ln D of every cluster or movie, and its variance with the spreads of a population."""
    # Half the upper limit stands for an absent value.
    value = np.array([one.value if one.value > 0 else one.ci95[1] / 2 for one in members])
    centre, high = np.log(value), np.array([one.ci95[1] for one in members])
    inner = (np.log(high / value) / NORMAL[0.95]) ** 2 + (population.spread_clusters or 0.0) ** 2
    between = (population.spread_movies or 0.0) ** 2
    if not by_movie:
        return centre, inner + between
    known = list(dict.fromkeys(names))
    movie = np.array([known.index(name) for name in names])
    weight = np.bincount(movie, 1 / inner)
    return np.bincount(movie, centre / inner) / weight, 1 / weight + between


def _holm(p: Floats) -> Floats:
    """Return probabilities that hold for the largest of many deviations (Holm)."""
    order = np.argsort(p)
    raised = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
    out = np.empty_like(p)
    out[order] = np.minimum(raised, 1.0)
    return out
