"""The mean of ln D over clusters within movies, with the spread between clusters and movies."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from perrin._arrays import frozen, refuse, to_plain
from perrin._display import Shown
from perrin._text import number_text, percent
from perrin.diffusion.estimate import CHI2, NORMAL
from perrin.study.profiles import Coefficient, log_likelihoods

if TYPE_CHECKING:
    from collections.abc import Hashable, Mapping, Sequence
    from typing import Self

    from perrin._arrays import Floats, Ints
    from perrin.study.profiles import Interval

Scope = Literal["movies", "clusters", "cluster"]

# Steps of the grid of ln D in standard errors of the most precise cluster, and its largest number
# of points; a cluster that is more precise than 1.5 steps is taken as if it had this error.
_STEPS_PER_ERROR, _MOST_GRID_POINTS, _LEAST_ERROR = 2.5, 400, 1.5

# Spreads at which the likelihood is tabulated: 0, and up to twice the scatter of the estimates.
_SPREADS, _SMALLEST_SPREAD, _LAST_SPREAD = 9, 0.07, 2.0
_FINE = 81  # spreads to which the table is interpolated

_TABULATED_ROOT = 6.0  # signed root up to which the likelihood of a mean is tabulated


@dataclass(frozen=True, eq=False)
class MovieLikelihoods:
    """Log-likelihood of the mean ln D of each movie, the spread between its clusters included.

    Attributes
    ----------
    log_D : ndarray, shape (G,)
        Values of ln D, evenly spaced.
    log_likelihood : ndarray, shape (J, G)
        Log-likelihood of each movie at these values.
    """

    log_D: Floats
    log_likelihood: Floats

    def __post_init__(self) -> None:
        frozen(self.log_D, self.log_likelihood)

    def widened(self, spread: float) -> Floats:
        """Return the log-likelihoods of a mean about which the movies have a normal spread.

        Parameters
        ----------
        spread : float
            Standard deviation of ln D between movies.

        Returns
        -------
        ndarray, shape (J, G)
        """
        return smoothed(self.log_likelihood, spread, step=float(self.log_D[1] - self.log_D[0]))


@dataclass(frozen=True, eq=False, repr=False)
class PopulationMean(Shown):
    """The mean of a coefficient over a population, and how much its members differ.

    The mean is that of ln D: `value` is the geometric mean, the median of the population.

    Attributes
    ----------
    value : float
        Geometric mean.
    ci68, ci95 : tuple of float
        Confidence intervals of the mean.
    log_stderr : float
        Standard error of the mean of ln D, before the factor of Student's t.
    dof : int
        Degrees of freedom of the interval: one less than the movies, or than the clusters of one
        movie; 0 for one cluster.
    scope : {"movies", "clusters", "cluster"}
        What the interval is about: the mean over all movies that could be taken ("movies"); that of
        the clusters under the conditions of the one movie there is ("clusters"); or the one
        cluster that there is ("cluster").
    spread_clusters : float or None
        Standard deviation of ln D between the clusters of a movie, without the errors of the
        estimates; None for one cluster. Where each movie has one cluster it is that between
        movies and clusters together.
    spread_clusters_ci95 : tuple of float, or None
        Its 95 % interval.
    spread_movies : float or None
        Standard deviation of ln D between movies beyond that between clusters; None where it cannot
        be separated.
    spread_movies_ci95 : tuple of float, or None
        Its 95 % interval.
    n_clusters, n_movies : int
        Number of clusters and of movies.
    dispersion : float
        Mean square of the normalised deviations of the movies (or clusters) from the mean, 1 on
        average; the intervals are scaled by it.
    unit : str
        Unit of the value.
    movies : MovieLikelihoods or None
        The likelihood of each movie, for fits to several conditions; not part of `to_dict`.
    """

    value: float
    ci68: tuple[float, float]
    ci95: tuple[float, float]
    log_stderr: float
    dof: int
    scope: Scope
    spread_clusters: float | None
    spread_clusters_ci95: tuple[float, float] | None
    spread_movies: float | None
    spread_movies_ci95: tuple[float, float] | None
    n_clusters: int
    n_movies: int
    dispersion: float
    unit: str = ""
    movies: MovieLikelihoods | None = None

    @property
    def text(self) -> str:
        """One sentence: the mean, what it is about, and the spreads."""
        shown = number_text(self.value, self.value * (self.ci68[1] / self.ci68[0] - 1) / 2)
        interval = f"95 % {number_text(self.ci95[0])} to {number_text(self.ci95[1])}"
        about = {
            "movies": f"mean of {self.n_movies} movies with {self.n_clusters} clusters",
            "clusters": f"mean of the {self.n_clusters} clusters of one movie: the interval holds "
            "for this movie, the spread between movies is not known",
            "cluster": "one cluster: the interval holds for this cluster",
        }[self.scope]
        spreads = [
            f"spread between {name} {percent(one) if one else '0 %'}"
            for name, one in (("clusters", self.spread_clusters), ("movies", self.spread_movies))
            if one is not None
        ]
        return "; ".join([f"{shown} {self.unit}".strip() + f" ({interval})", about, *spreads])

    def __str__(self) -> str:
        return self.text

    def __float__(self) -> float:
        return self.value

    def to_dict(self) -> dict[str, Any]:
        """Return the mean for JSON, without the likelihoods of the movies."""
        return {f.name: to_plain(getattr(self, f.name)) for f in fields(self) if f.name != "movies"}

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> Self:
        """Return the mean that `to_dict` wrote.

        Parameters
        ----------
        entry : mapping
        """
        read: dict[str, Any] = {
            k: tuple(np.inf if end is None else end for end in v) if isinstance(v, list) else v
            for k, v in entry.items()
        }
        return cls(**read)


def population_mean(
    coefficients: Sequence[Interval],
    *,
    movies: Sequence[Hashable] | None = None,
    unit: str = "",
) -> PopulationMean:
    """Return the mean of a coefficient over clusters within movies, with an interval that covers.

    Parameters
    ----------
    coefficients : sequence of DiffusionEstimate or Coefficient
        Estimate of each cluster, of one quantity and one kind of bodies.
    movies : sequence, optional
        Movie of each cluster: any names; default: all in one movie.
    unit : str
        Unit of the value.

    Returns
    -------
    PopulationMean

    Raises
    ------
    ValueError
        If there is no cluster, `movies` has another length, or a likelihood is not known.

    Notes
    -----
    ln D of cluster i in movie j is m + b_j + a_ij, a and b normal with the spreads between clusters
    and between movies. Each cluster has its own likelihood (`log_likelihoods`), so that short
    tracks, whose likelihoods are skewed, count as what they are. On a grid of ln D the likelihoods
    of the clusters are convolved with the law of a, multiplied within each movie, convolved with
    the law of b, and multiplied. The spreads have the greatest likelihood that is integrated over m
    (restricted likelihood: Patterson & Thompson, Biometrika 58, 545, 1971); their intervals are
    those of its ratio with Bartlett's factor for normal samples.

    The mean has the greatest likelihood with the upper end of the 68 % interval of the spread
    between movies (of that between clusters for one movie): the spread is uncertain, and weights
    that are too unequal make intervals too short. The interval is that of the likelihood
    ratio over the dispersion phi, with Student's t of k - 1 degrees of freedom, k the number of
    movies: phi is the sum of the deviances of the movies over k - 1. For normal likelihoods this
    is the interval of Hartung & Knapp (Stat. Med. 20, 3875, 2001), whose coverage does not depend
    on the estimated spread. docs/theory/populations.md derives it and measures the coverage.

    Examples
    --------
    >>> values = [1.0, 1.2, 0.9, 1.1, 1.3, 0.8]
    >>> clusters = [Coefficient(v, (0.9 * v, 1.1 * v), (0.81 * v, 1.22 * v)) for v in values]
    >>> mean = population_mean(clusters, movies=["a", "a", "b", "b", "c", "c"])
    >>> mean.scope, mean.dof, mean.ci95[0] < 1.03 < mean.ci95[1]
    ('movies', 2, True)
    """
    members = [Coefficient.of(one) for one in coefficients]
    names = ["one movie"] * len(members) if movies is None else list(movies)
    faults = [] if members else ["coefficients: expected one cluster or more, got none"]
    if len(names) != len(members):
        faults.append(
            f"movies: expected one name for each of {len(members)} clusters, got {len(names)}"
        )
    refuse(faults)
    known = {name: k for k, name in enumerate(dict.fromkeys(names))}
    movie = np.array([known[name] for name in names], dtype=np.int64)
    if len(members) == 1:
        return _one_cluster(members[0], unit)
    log_D, rows, most_spread = _tabulated(members, units=max(int(movie.max()) + 1, 2))
    nested = 1 < len(known) < len(members)
    units = len(known) if len(known) > 1 else len(members)
    level = _Levels(log_D, rows, movie if nested else None)
    clusters, between = level.spreads(most_spread)
    by_unit = (
        level.units(clusters.high68, 0.0)
        if between is None
        else level.units(clusters.value, between.high68)
    )
    centre, log_stderr, dispersion, ends = _mean_interval(log_D, by_unit, dof=units - 1)
    by_movie = smoothed(rows, clusters.value, step=float(log_D[1] - log_D[0]))
    return PopulationMean(
        value=float(np.exp(centre)),
        ci68=ends[0],
        ci95=ends[1],
        log_stderr=log_stderr,
        dof=units - 1,
        scope="movies" if len(known) > 1 else "clusters",
        spread_clusters=clusters.value,
        spread_clusters_ci95=clusters.ci95,
        spread_movies=None if between is None else between.value,
        spread_movies_ci95=None if between is None else between.ci95,
        n_clusters=len(members),
        n_movies=len(known),
        dispersion=dispersion,
        unit=unit,
        movies=MovieLikelihoods(log_D, _movie_sums(by_movie, movie)),
    )


def smoothed(log_likelihood: Floats, spread: float, *, step: float) -> Floats:
    """Return log-likelihoods of a mean, about which their own ln D has a normal spread.

    Parameters
    ----------
    log_likelihood : ndarray, shape (N, G)
        Log-likelihoods of ln D on an even grid.
    spread : float
        Standard deviation of ln D.
    step : float
        Step of the grid.

    Returns
    -------
    ndarray, shape (N, G)

    Notes
    -----
    A spread below one step is the discrete Gaussian exp(-t) I_n(t), t = (spread/step)^2, whose
    variance is exact (Lindeberg, IEEE Trans. Pattern Anal. 12, 234, 1990).

    Examples
    --------
    >>> x = np.linspace(-7, 9, 161)
    >>> wide = smoothed(-0.5 * x[None] ** 2, 1.0, step=0.1)  # variance 1 + 1
    >>> bool(abs(wide[0, 90] - wide[0, 70] + 2.0**2 / 4) < 1e-6)
    True
    """
    from scipy.special import ive

    if spread == 0:
        return log_likelihood
    count, t = log_likelihood.shape[1], (spread / step) ** 2
    distance = np.arange(count)
    if t >= 1:
        weight = np.exp(-(distance**2) / (2 * t)) / np.sqrt(2 * np.pi * t)
    else:
        weight = np.where(distance < 16, ive(np.minimum(distance, 16), t), 0.0)
    both_sides = np.concatenate([weight[:0:-1], weight])
    kernel = np.ascontiguousarray(np.lib.stride_tricks.sliding_window_view(both_sides, count)[::-1])
    top = log_likelihood.max(axis=1, keepdims=True)
    mixed = np.exp(log_likelihood - top) @ kernel
    return np.asarray(np.log(np.maximum(mixed, 1e-300)) + top)


@dataclass(frozen=True, eq=False)
class _Levels:
    """Clusters, perhaps in movies, and the restricted likelihood of their spreads."""

    log_D: Floats
    rows: Floats  # (N, G) log-likelihoods of the clusters
    movie: Ints | None  # None: one level

    def units(self, cluster_spread: float, movie_spread: float) -> Floats:
        """Return the log-likelihoods of the mean from each movie, or from each cluster."""
        step = float(self.log_D[1] - self.log_D[0])
        wide = smoothed(self.rows, cluster_spread, step=step)
        if self.movie is None:
            return wide
        return smoothed(_movie_sums(wide, self.movie), movie_spread, step=step)

    def spreads(self, most_spread: float) -> tuple[_Spread, _Spread | None]:
        """Return the spread between clusters, and that between movies where there are movies."""
        from scipy.interpolate import RectBivariateSpline

        step = float(self.log_D[1] - self.log_D[0])
        nodes = most_spread * np.geomspace(_SMALLEST_SPREAD, 1.0, _SPREADS - 1)
        nodes = np.concatenate([[0.0], nodes])
        n = len(self.rows)
        if self.movie is None:
            table = [_integrated(smoothed(self.rows, s, step=step)) for s in nodes]
            return _peak(nodes, np.array(table), dof=n - 1), None
        k = int(self.movie.max()) + 1
        grid = np.empty((_SPREADS, _SPREADS))
        for i, s in enumerate(nodes):
            within = _movie_sums(smoothed(self.rows, s, step=step), self.movie)
            grid[i] = [_integrated(smoothed(within, b, step=step)) for b in nodes]
        # Between the nodes by cubic splines; far below the maximum they would only add waves.
        index = np.arange(_SPREADS)
        spline = RectBivariateSpline(index, index, np.maximum(grid, grid.max() - 40))
        between = np.linspace(0, _SPREADS - 1, _FINE)
        fine = spline(between, between)
        return (
            _peak(nodes, fine.max(axis=1), dof=n - k),
            _peak(nodes, fine.max(axis=0), dof=k - 1),
        )


@dataclass(frozen=True)
class _Spread:
    """A spread of ln D, its 95 % interval, and the upper end of its 68 % interval on the grid."""

    value: float
    ci95: tuple[float, float]
    high68: float


def _movie_sums(rows: Floats, movie: Ints) -> Floats:
    """Return the sums of the rows of each movie."""
    total = np.zeros((int(movie.max()) + 1, rows.shape[1]))
    np.add.at(total, movie, rows)
    return total


def _tabulated(members: Sequence[Coefficient], *, units: int) -> tuple[Floats, Floats, float]:
    """Return a grid of ln D, the log-likelihoods of all clusters on it, and the largest spread."""
    high = np.log([one.ci68[1] for one in members])
    far = np.log([one.ci95[1] for one in members])
    centre = np.array([np.log(one.value) if one.value > 0 else np.nan for one in members])
    # An unresolved cluster has no centre: its likelihood falls off at the upper end alone.
    error = np.where(np.isnan(centre), far - high, (far - centre) / NORMAL[0.95])
    error = np.maximum(error, 1e-6)
    place = np.where(np.isnan(centre), high - 2 * error, centre)
    most = _LAST_SPREAD * max(float(np.std(place, ddof=1)), float(np.sqrt(np.mean(error**2))))
    margin = 4 * most / np.sqrt(units)
    low, top = (place - 4.5 * error).min() - margin, (place + 4.5 * error).max() + margin
    step = max(error.min() / _STEPS_PER_ERROR, (top - low) / _MOST_GRID_POINTS)
    log_D = np.arange(low, top + step, step)
    rows = log_likelihoods(members, log_D)
    rows *= (np.minimum(1.0, error / (_LEAST_ERROR * step)) ** 2)[:, None]
    return log_D, rows, most


def _integrated(units: Floats) -> float:
    """Return the logarithm of the likelihood that is integrated over the mean."""
    total = units.sum(axis=0)
    top = float(total.max())
    return top + float(np.log(np.exp(total - top).sum()))


def _peak(nodes: Floats, profile: Floats, *, dof: int) -> _Spread:
    """Return the spread of greatest likelihood with its intervals.

    The profile is at the nodes, or evenly between them. Beyond the last node it falls by `dof` for
    each unit of the logarithm of the spread, as that of any scale.
    """
    from scipy.interpolate import CubicSpline
    from scipy.special import psi

    index = np.linspace(0, _SPREADS - 1, _FINE)
    if profile.size == _SPREADS:
        clipped = np.maximum(profile, profile.max() - 40)
        profile = CubicSpline(np.arange(_SPREADS), clipped)(index)
    # Between nodes in geometric progression the index is a logarithm.
    spreads = nodes[1] * (nodes[-1] / nodes[1]) ** ((index - 1) / (_SPREADS - 2))
    spreads = np.where(index > 1, spreads, nodes[1] * index)
    best = int(np.argmax(profile))
    # Mean of the likelihood ratio of the scale of a normal sample (Bartlett).
    bartlett = dof * (np.log(dof / 2) - psi(dof / 2))

    def ends(share: float) -> tuple[float, float]:
        level = float(profile[best]) - CHI2[share] / 2 * bartlett
        above = np.flatnonzero(profile >= level)
        low = 0.0 if above[0] == 0 else float(spreads[above[0]])
        if above[-1] == _FINE - 1:
            return low, float(spreads[-1] * np.exp((profile[-1] - level) / dof))
        return low, float(spreads[above[-1]])

    high68 = min(ends(0.68)[1], float(spreads[-1]))
    return _Spread(float(spreads[best]), ends(0.95), high68)


def _mean_interval(
    log_D: Floats, units: Floats, *, dof: int
) -> tuple[float, float, float, tuple[tuple[float, float], tuple[float, float]]]:
    """Return the mean of ln D, its standard error, the dispersion and the intervals of D."""
    from scipy.special import stdtrit

    step = float(log_D[1] - log_D[0])
    total = units.sum(axis=0)
    (peak,), (top,) = _vertices(total[None])
    centre = float(log_D[0] + step * peak)
    # The units at the mean, by parabolas through the three points about it.
    i = int(np.clip(np.rint(peak), 1, units.shape[1] - 2))
    left, here, right = units[:, i - 1], units[:, i], units[:, i + 1]
    offset = peak - i
    at_mean = here + offset * ((right - left) / 2 + offset * (left - 2 * here + right) / 2)
    deviance = 2 * np.sum(_vertices(units)[1] - at_mean)
    dispersion = max(float(deviance / dof), 1e-12)
    root = np.sign(log_D - centre) * np.sqrt(np.maximum(2 * (top - total), 0.0))
    near = np.abs(root) <= _TABULATED_ROOT
    x, r = log_D[near], np.maximum.accumulate(root[near])

    def place(wanted: float) -> float:
        # Beyond the grid the root is a straight line: the likelihood is normal in ln D.
        if wanted < r[0]:
            return float(x[0] + (wanted - r[0]) * (x[0] - centre) / r[0])
        if wanted > r[-1]:
            return float(x[-1] + (wanted - r[-1]) * (x[-1] - centre) / r[-1])
        return float(np.interp(wanted, r, x))

    scale = np.sqrt(dispersion)
    low68, high68, low95, high95 = (
        float(np.exp(place(sign * scale * stdtrit(dof, 0.5 + share / 2))))
        for share in (0.68, 0.95)
        for sign in (-1, 1)
    )
    log_stderr = (place(scale) - place(-scale)) / 2
    return centre, log_stderr, dispersion, ((low68, high68), (low95, high95))


def _vertices(rows: Floats) -> tuple[Floats, Floats]:
    """Return the places (in steps) and heights of the maxima of rows, by parabolas through them."""
    middle = np.clip(np.argmax(rows, axis=1), 1, rows.shape[1] - 2)
    left, here, right = (
        np.take_along_axis(rows, (middle + d)[:, None], 1)[:, 0] for d in (-1, 0, 1)
    )
    bend, slope = left - 2 * here + right, (right - left) / 2
    offset = np.where(bend < 0, np.clip(-slope / np.where(bend < 0, bend, 1.0), -1, 1), 0.0)
    return middle + offset, here + offset * (slope + offset * bend / 2)


def _one_cluster(one: Coefficient, unit: str) -> PopulationMean:
    """Return the value of one cluster as that of a population of which nothing else is known."""
    refuse(
        [f"coefficients: the one cluster has no likelihood: {one.absent_because}"]
        if one.absent_because
        else []
    )
    log_D, movies = np.array([0.0, 1.0]), None
    width = np.log(one.ci68[1]) - np.log(one.ci68[0]) if one.ci68[0] > 0 else np.inf
    if np.isfinite(width):
        centre, step = np.log(one.value), width / 2 / _STEPS_PER_ERROR
        log_D = centre + step * np.arange(-20, 21)
        movies = MovieLikelihoods(log_D, log_likelihoods([one], log_D))
    return PopulationMean(
        value=one.value,
        ci68=one.ci68,
        ci95=one.ci95,
        log_stderr=float(width / 2 / NORMAL[0.68]),
        dof=0,
        scope="cluster",
        spread_clusters=None,
        spread_clusters_ci95=None,
        spread_movies=None,
        spread_movies_ci95=None,
        n_clusters=1,
        n_movies=1,
        dispersion=1.0,
        unit=unit,
        movies=movies,
    )
