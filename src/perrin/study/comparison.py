"""Two conditions compared: the ratio of their means, its p and its size."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from perrin._arrays import refuse, to_plain
from perrin._display import Shown
from perrin._text import number_text

if TYPE_CHECKING:
    from collections.abc import Mapping
    from typing import Self

    from perrin.study.random_effects import PopulationMean


@dataclass(frozen=True, repr=False)
class Comparison(Shown):
    """The ratio of the means of two conditions.

    Attributes
    ----------
    ratio : float
        Mean of the second condition over that of the first.
    ci95 : tuple of float
        95 % interval of the ratio.
    p : float
        Probability that equal means differ at least as much as these do, two-sided.
    dof : float
        Degrees of freedom of the test (Welch, Satterthwaite).
    effect_size : float or None
        Difference of the means of ln D in standard deviations of single clusters, between clusters
        and movies together; None where neither condition shows a spread.
    """

    ratio: float
    ci95: tuple[float, float]
    p: float
    dof: float
    effect_size: float | None

    @property
    def text(self) -> str:
        """One sentence: the ratio, its interval, p and the effect size."""
        low, high = map(number_text, self.ci95)
        size = "" if self.effect_size is None else f", effect size {self.effect_size:.2g}"
        differ = "the means differ" if self.p < 0.05 else "no difference is found"
        ratio = number_text(self.ratio)
        return f"ratio {ratio} (95 % {low} to {high}), p = {self.p:.2g}{size}: {differ}"

    def __str__(self) -> str:
        return self.text

    def to_dict(self) -> dict[str, Any]:
        """Return the comparison for JSON."""
        entry: dict[str, Any] = to_plain(asdict(self))
        return entry

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> Self:
        """Return the comparison that `to_dict` wrote.

        Parameters
        ----------
        entry : mapping
        """
        low, high = entry["ci95"]
        ends = (0.0 if low is None else low, np.inf if high is None else high)
        return cls(**{**entry, "ci95": ends})


def compare_conditions(first: PopulationMean, second: PopulationMean) -> Comparison:
    """Compare the means of a coefficient under two conditions.

    Parameters
    ----------
    first, second : PopulationMean
        Means of independent movies, each of more than one cluster.

    Returns
    -------
    Comparison

    Raises
    ------
    ValueError
        If a mean is that of one cluster, or has no finite error.

    Notes
    -----
    The difference of ln D has the variances of both means, and the degrees of freedom of Welch
    (Biometrika 34, 28, 1947). Where a condition has one movie, its interval does not contain the
    spread between movies, and nor does the comparison.

    Examples
    --------
    >>> from perrin.study import Coefficient, population_mean
    >>> def mean(values):
    ...     return population_mean(
    ...         [Coefficient(v, (0.95 * v, 1.05 * v), (0.9 * v, 1.1 * v)) for v in values]
    ...     )
    >>> compare_conditions(mean([1.0, 1.1, 0.9, 1.05]), mean([2.0, 2.1, 1.9])).p < 0.001
    True
    """
    from scipy.special import stdtr, stdtrit

    both = (first, second)
    refuse(
        f"{name}: expected a mean of more than one cluster with a finite error, got {one}"
        for name, one in zip(("first", "second"), both, strict=True)
        if not (one.dof > 0 and 0 < one.log_stderr < np.inf)
    )
    variances = np.array([one.log_stderr**2 for one in both])
    variance = float(variances.sum())
    dof = float(variance**2 / np.sum(variances**2 / [one.dof for one in both]))
    apart = float(np.log(second.value / first.value))
    t = apart / np.sqrt(variance)
    half = float(stdtrit(dof, 0.975)) * np.sqrt(variance)
    inner = np.sqrt(
        np.mean([(one.spread_clusters or 0) ** 2 + (one.spread_movies or 0) ** 2 for one in both])
    )
    return Comparison(
        ratio=float(np.exp(apart)),
        ci95=(float(np.exp(apart - half)), float(np.exp(apart + half))),
        p=float(2 * stdtr(dof, -abs(t))),
        dof=dof,
        effect_size=float(apart / inner) if inner > 0 else None,
    )
