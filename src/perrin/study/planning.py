"""How many movies, clusters and frames a study needs for a wanted error."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from perrin._arrays import number_fault, refuse, to_plain
from perrin._display import Shown
from perrin._text import percent
from perrin.diffusion.bounds import cramer_rao

if TYPE_CHECKING:
    from collections.abc import Mapping
    from typing import Self

_MOST_MOVIES = 200
_LONGEST_MOVIE = 100_000
_SHORTEST_MOVIE = 20

# Numbers of movies that are planned beside the recommended one.
_OFFERED = (3, 4, 5, 6, 8, 10, 15, 20, 30, 50, 100, 200)


@dataclass(frozen=True, repr=False)
class StudyPlan(Shown):
    """Recommended numbers of movies and frames for the mean of a coefficient.

    Attributes
    ----------
    n_movies : int
        Number of movies under each condition.
    n_clusters : int
        Number of clusters in each movie.
    n_frames : int
        Number of frames of each movie.
    half_width : float
        Expected half width of the 95 % interval over the mean.
    cluster_error : float
        Expected standard error of one cluster over its D.
    choices : tuple of tuple
        Movies, frames of each, and expected half width of all plans that reach the wanted error.
    reasons : tuple of str
        Sentences that explain the plan.
    """

    n_movies: int
    n_clusters: int
    n_frames: int
    half_width: float
    cluster_error: float
    choices: tuple[tuple[int, int, float], ...]
    reasons: tuple[str, ...]

    def __str__(self) -> str:
        head = (
            f"{self.n_movies} movies with {self.n_clusters} clusters and {self.n_frames} frames: "
            f"the mean to {percent(self.half_width)} (95 %)"
        )
        return "\n- ".join((head, *self.reasons))

    def to_dict(self) -> dict[str, Any]:
        """Return the plan for JSON."""
        return {name: to_plain(getattr(self, name)) for name in self.__dataclass_fields__}

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> Self:
        """Return the plan that `to_dict` wrote.

        Parameters
        ----------
        entry : mapping
        """
        choices = tuple((int(j), int(n), float(w)) for j, n, w in entry["choices"])
        return cls(**{**entry, "choices": choices, "reasons": tuple(entry["reasons"])})


def expected_half_width(
    *,
    n_movies: int,
    n_clusters: int,
    cluster_error: float,
    spread_clusters: float,
    spread_movies: float = 0.0,
) -> float:
    """Return the expected half width of the 95 % interval of a mean, relative to it.

    Parameters
    ----------
    n_movies : int
        Number of movies, at least 2.
    n_clusters : int
        Number of clusters in each.
    cluster_error : float
        Standard error of one cluster over its D.
    spread_clusters, spread_movies : float
        Standard deviations of ln D between the clusters of a movie and between movies.

    Returns
    -------
    float

    Notes
    -----
    Student's t of J - 1 degrees of freedom times (s_m^2/J + (s_c^2 + e^2)/(J n))^(1/2).

    Examples
    --------
    >>> round(
    ...     expected_half_width(
    ...         n_movies=5, n_clusters=10, cluster_error=0.1, spread_clusters=0.2
    ...     ), 3
    ... )
    0.088
    """
    from scipy.special import stdtrit

    inner = (spread_clusters**2 + cluster_error**2) / n_clusters
    return float(stdtrit(n_movies - 1, 0.975) * np.sqrt((spread_movies**2 + inner) / n_movies))


def plan_study(
    half_width: float,
    *,
    n_clusters: int,
    spread_clusters: float,
    spread_movies: float = 0.0,
    snr: float = 20.0,
    axes: int = 3,
    most_frames: int | None = None,
) -> StudyPlan:
    """Recommend the numbers of movies and frames for the mean of a coefficient.

    `plan_sampling` finds the time between frames for one cluster; this function finds how many of
    such movies a condition needs when the clusters differ.

    Parameters
    ----------
    half_width : float
        Wanted half width of the 95 % interval over the mean: 0.1 for 10 %.
    n_clusters : int
        Number of clusters that a movie contains.
    spread_clusters, spread_movies : float
        Standard deviations of ln D between clusters and between movies, from a first study
        (`PopulationMean`) or a guess.
    snr : float
        Signal-to-noise ratio D dt/s of one step; 20 is that of `plan_sampling`.
    axes : int
        Axes that share D: 3 in space; in the plane 1 for D_R and 2 for D_T.
    most_frames : int, optional
        Largest number of frames of a movie.

    Returns
    -------
    StudyPlan
        The plan with the fewest frames of all movies together.

    Raises
    ------
    ValueError
        For numbers out of range, or if no number of movies up to 200 reaches the wanted error.

    Examples
    --------
    >>> plan = plan_study(0.1, n_clusters=10, spread_clusters=0.2, spread_movies=0.05)
    >>> plan.n_movies, plan.half_width <= 0.1
    (10, True)
    """
    faults = [
        *number_fault("half_width", half_width, above=0, below=1),
        *number_fault("n_clusters", n_clusters, least=1, whole=True),
        *number_fault("spread_clusters", spread_clusters, least=0),
        *number_fault("spread_movies", spread_movies, least=0),
        *number_fault("snr", snr, above=0),
        *number_fault("axes", axes, least=1, most=3, whole=True),
    ]
    if most_frames is not None:
        faults += number_fault("most_frames", most_frames, least=_SHORTEST_MOVIE, whole=True)
    refuse(faults)
    frames = np.unique(
        np.geomspace(_SHORTEST_MOVIE, most_frames or _LONGEST_MOVIE, 120).round().astype(int)
    )
    # Numbers of numpy in single precision would be computed with in single precision.
    half_width, snr = float(half_width), float(snr)
    spread_clusters, spread_movies = float(spread_clusters), float(spread_movies)
    errors = np.array([cramer_rao(n_frames=int(n), snr=snr, axes=axes) for n in frames])
    choices = []
    for movies in range(2, _MOST_MOVIES + 1):
        widths = np.array(
            [
                expected_half_width(
                    n_movies=movies,
                    n_clusters=n_clusters,
                    cluster_error=float(error),
                    spread_clusters=spread_clusters,
                    spread_movies=spread_movies,
                )
                for error in (errors[0], errors[-1])
            ]
        )
        if widths[-1] > half_width:
            continue
        for n, error in zip(frames, errors, strict=True):
            width = expected_half_width(
                n_movies=movies,
                n_clusters=n_clusters,
                cluster_error=float(error),
                spread_clusters=spread_clusters,
                spread_movies=spread_movies,
            )
            if width <= half_width:
                choices.append((movies, int(n), width))
                break
        if widths[0] <= half_width:  # more movies need no more frames than the fewest
            break
    if not choices:
        refuse(
            [
                f"half_width: {percent(half_width)} is not reached with {_MOST_MOVIES} movies of "
                f"{n_clusters} clusters and a spread of {percent(spread_movies)} between movies: "
                "state a larger one"
            ]
        )
    best = min(choices, key=lambda one: (one[0] * one[1], one[0]))
    error = float(errors[np.searchsorted(frames, best[1])])
    between = spread_movies**2 * n_clusters
    parts = {
        "the spread between movies": between,
        "the spread between clusters": spread_clusters**2,
        "the errors of the clusters": error**2,
    }
    largest = max(parts, key=lambda name: parts[name])
    remedy = {
        "the spread between movies": "only more movies reduce it",
        "the spread between clusters": "more clusters or movies reduce it, longer movies do not",
        "the errors of the clusters": "longer movies reduce it as well",
    }[largest]
    fewest = choices[0]
    return StudyPlan(
        n_movies=best[0],
        n_clusters=n_clusters,
        n_frames=best[1],
        half_width=best[2],
        cluster_error=error,
        choices=tuple(one for one in choices if one in (best, fewest) or one[0] in _OFFERED),
        reasons=(
            f"One cluster of {best[1]} frames has an error of {percent(error)}; clusters differ by "
            f"{percent(spread_clusters)}."
            if spread_clusters
            else f"One cluster of {best[1]} frames has an error of {percent(error)}.",
            f"Most of the variance of the mean is {largest}: {remedy}.",
            f"The fewest movies are {fewest[0]}, with {fewest[1]} frames each.",
        ),
    )
