"""A coefficient against the condition: fits to the movies of all conditions."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np

from perrin._arrays import choice_fault, from_plain, frozen, refuse, to_plain
from perrin._display import Shown
from perrin._text import number_text

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from typing import Self

    from numpy.typing import ArrayLike

    from perrin._arrays import Floats
    from perrin.study.random_effects import PopulationMean

    Law: TypeAlias = Callable[..., ArrayLike]

LawName = Literal["constant", "proportional", "inverse", "power", "exponential"]

# The parameters of each law, D = law(x, *parameters), and whether x must be above 0. All laws are
# linear in ln D: ln D = ln A + exponent ln x, or ln D = ln A + rate x.
LAWS: dict[str, tuple[tuple[str, ...], bool]] = {
    "constant": (("A",), False),
    "proportional": (("A",), True),
    "inverse": (("A",), True),
    "power": (("A", "exponent"), True),
    "exponential": (("A", "rate"), False),
}
_NARROWEST, _WIDEST = 1e-3, 3.0  # of ln D between movies

# Signed roots at which the likelihood of a movie is known, and how far they are continued.
_KNOWN_ROOT, _CONTINUED_ROOT = 5.0, 40.0
_MOVIE_ROOTS = np.concatenate(
    [[-_CONTINUED_ROOT], np.linspace(-_KNOWN_ROOT, _KNOWN_ROOT, 81), [_CONTINUED_ROOT]]
)


@dataclass(frozen=True, eq=False, repr=False)
class Trend(Shown):
    """A law of a coefficient against the condition, fitted to the movies.

    Attributes
    ----------
    law : str
        Name of the law; "own function" for a function of the user.
    parameters : dict of float
        Values of the parameters.
    stderr : dict of float
        Their standard errors, without the factor of Student's t.
    ci95 : dict of tuple of float
        Their 95 % intervals.
    spread : float
        Standard deviation of ln D between movies about the law, without the errors of the
        movies.
    dof : int
        Number of movies less that of parameters.
    p : float
        Probability that movies which follow the law scatter about it at least as much as these do,
        if nothing but the errors of their means (spread between clusters included) scatters.
    x : ndarray, shape (J,)
        Condition of each movie.
    residuals : ndarray, shape (J,)
        Normalised deviation of each movie from the law: signed root of its deviance, about standard
        normal.
    log_deviations : ndarray, shape (J,)
        ln of the mean of each movie over the law.
    """

    law: str
    parameters: dict[str, float]
    stderr: dict[str, float]
    ci95: dict[str, tuple[float, float]]
    spread: float
    dof: int
    p: float
    x: Floats
    residuals: Floats
    log_deviations: Floats

    def __post_init__(self) -> None:
        frozen(self.x, self.residuals, self.log_deviations)

    @property
    def text(self) -> str:
        """One sentence: the parameters and whether the law describes the movies."""
        values = ", ".join(
            f"{name} = {number_text(value, self.stderr[name])}"
            for name, value in self.parameters.items()
        )
        fits = "describes the movies" if self.p >= 0.05 else "leaves a scatter between the movies"
        return f"{self.law}: {values}; the law {fits} (p = {self.p:.2g}, {len(self.x)} movies)"

    def __str__(self) -> str:
        return self.text

    def to_dict(self) -> dict[str, Any]:
        """Return the trend for JSON."""
        return {field.name: to_plain(getattr(self, field.name)) for field in fields(self)}

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> Self:
        """Return the trend that `to_dict` wrote.

        Parameters
        ----------
        entry : mapping
        """
        read = dict(entry)
        for name in ("x", "residuals", "log_deviations"):
            read[name] = from_plain(read[name])
        for name in ("parameters", "stderr"):
            read[name] = {k: np.inf if v is None else v for k, v in read[name].items()}
        read["ci95"] = {
            k: tuple(
                sign * np.inf if end is None else end
                for sign, end in zip((-1, 1), ends, strict=True)
            )
            for k, ends in entry["ci95"].items()
        }
        return cls(**read)


def law_values(law: str, x: ArrayLike, parameters: Mapping[str, float]) -> Floats:
    """Return the values of a law.

    Parameters
    ----------
    law : {"constant", "proportional", "inverse", "power", "exponential"}
        A; A x; A/x; A x^exponent; A exp(rate x).
    x : array_like
    parameters : mapping
        Values of the parameters by name.

    Returns
    -------
    ndarray

    Examples
    --------
    >>> law_values("inverse", [1.0, 2.0], {"A": 3.0})
    array([3. , 1.5])
    """
    at = np.asarray(x, dtype=np.float64)
    power = {"proportional": 1.0, "inverse": -1.0}.get(law, parameters.get("exponent", 0.0))
    rise = np.exp(parameters.get("rate", 0.0) * at)
    return np.asarray(parameters["A"] * rise * (at**power if power else 1.0))


def fit_trend(
    means: Sequence[PopulationMean],
    x: ArrayLike,
    *,
    law: LawName | Law = "power",
    start: Mapping[str, float] | None = None,
) -> Trend:
    """Fit a law to a coefficient against the condition, with the likelihood of every movie.

    Parameters
    ----------
    means : sequence of PopulationMean
        Mean under each condition, from `population_mean`; its movies enter one by one.
    x : array_like, shape (C,)
        Value of the condition: viscosity (Pa s), volume fraction, temperature (K), ...
    law : {"constant", "proportional", "inverse", "power", "exponential"} or callable
        A; A x; A/x (D against 1/viscosity through the origin); A x^exponent; A exp(rate x). A
        function ``law(x, a, b, ...)`` returns D.
    start : mapping, optional
        Parameters of a function at which the fit begins, by name, in the order of its arguments.

    Returns
    -------
    Trend

    Raises
    ------
    ValueError
        If there are no more movies than parameters, a condition is not finite or not above 0
        where the law needs it, a mean has no likelihoods, or a function has no `start` or no
        positive value there.

    Notes
    -----
    The likelihood of the mean ln D of a movie contains the spread between its clusters. About the
    law the movies have one normal spread, found where the sum of their squared normalised
    deviations is the number of degrees of freedom, J - p (Paule & Mandel, J. Res. Natl. Bur. Stand.
    87, 377, 1982), and 0 where the sum is lower. Intervals are those of the likelihood ratio over
    the mean squared deviation, with Student's t of J - p degrees of freedom. Nothing is logged,
    weighted or smoothed by the user: D is positive, and its errors are those of ln D.

    Examples
    --------
    >>> from perrin.study import Coefficient, population_mean
    >>> eta = [1e-3, 2e-3, 4e-3, 8e-3]
    >>> values = [1.02e-2, 0.49e-2, 0.255e-2, 0.123e-2]
    >>> means = [
    ...     population_mean([Coefficient(v, (0.95 * v, 1.05 * v), (0.9 * v, 1.1 * v))])
    ...     for v in values
    ... ]
    >>> trend = fit_trend(means, eta, law="inverse")
    >>> trend.ci95["A"][0] < 1e-5 < trend.ci95["A"][1]
    True
    """
    from scipy.special import gammaincc

    at = np.atleast_1d(np.asarray(x, dtype=np.float64))
    names, logarithm = _checked_law(means, at, law, start)
    movies = [one.movies for one in means if one.movies is not None]
    condition = np.repeat(at, [len(one.log_likelihood) for one in movies])
    centres = np.concatenate([one.log_D[one.log_likelihood.argmax(axis=1)] for one in movies])
    count = len(condition)
    refuse(
        [f"means: expected more movies than parameters ({len(names)}), got {count}"]
        if count <= len(names)
        else []
    )
    dof = count - len(names)
    if callable(law):
        first = np.array([dict(start or {})[name] for name in names], dtype=np.float64)
    else:
        # The laws are linear in their parameters: least squares of ln D without weights.
        base = logarithm(condition, *np.zeros(len(names)))
        units = np.eye(len(names))
        design = np.stack([logarithm(condition, *one) - base for one in units], axis=1)
        line, _, rank, _ = np.linalg.lstsq(design, centres - base, rcond=None)
        first = np.asarray(line, dtype=np.float64)
        refuse(
            [f"x: expected at least two different conditions for the law {law!r}"]
            if rank < len(names)
            else []
        )

    @lru_cache(maxsize=1)
    def lines(spread: float) -> Floats:
        return np.array(
            [_root_places(one.log_D, row) for one in movies for row in one.widened(spread)]
        )

    def fit(spread: float, fixed: tuple[int, float] | None, at_first: Floats) -> _Fit:
        return _least_deviance(lines(spread), condition, logarithm, at_first, fixed)

    without = fit(0.0, None, first)
    spread = _paule_mandel_spread(lambda s: fit(s, None, without.parameters).deviance - dof)
    best = without if spread == 0 else fit(spread, None, without.parameters)
    ends, errors = [], []

    def rise(k: int, value: float) -> float:
        return fit(spread, (k, value), best.parameters).deviance - best.deviance

    dispersion = max(best.deviance / dof, 1e-12)
    for k in range(len(names)):
        error = float(np.sqrt(best.covariance[k, k] * dispersion))
        value = float(best.parameters[k])
        ends.append(_likelihood_ends(partial(rise, k), value, error, dispersion, dof=dof))
        errors.append(error)
    predicted = logarithm(condition, *best.parameters)
    convert = np.exp if not callable(law) else None
    parameters, stderr, ci95 = {}, {}, {}
    for k, name in enumerate(names):
        value = float(best.parameters[k])
        if convert is not None and name == "A":
            value = float(np.exp(value))
            errors[k] *= value
            ends[k] = (float(np.exp(ends[k][0])), float(np.exp(ends[k][1])))
        parameters[name], stderr[name], ci95[name] = value, errors[k], ends[k]
    return Trend(
        law=law if isinstance(law, str) else "own function",
        parameters=parameters,
        stderr=stderr,
        ci95=ci95,
        spread=spread,
        dof=dof,
        p=float(gammaincc(dof / 2, without.deviance / 2)),
        x=condition,
        residuals=best.roots,
        log_deviations=centres - predicted,
    )


def fit_power_law(D_R: Sequence[PopulationMean], D_T: Sequence[PopulationMean]) -> Trend:
    """Fit D_T = A D_R^exponent to the means of both under several conditions.

    Both coefficients have errors; the line in ln D_T against ln D_R is that of York (Can. J. Phys.
    44, 1079, 1966). An exponent of 1 is that of a simple fluid, below 1 translation is slowed
    less than rotation.

    Parameters
    ----------
    D_R, D_T : sequence of PopulationMean
        Means under the same conditions in the same order, at least three.

    Returns
    -------
    Trend
        `x` is the mean D_R of each condition.

    Raises
    ------
    ValueError
        If the lists differ in length or have fewer than three means, or an error is not finite.

    Notes
    -----
    The squared deviations (ln D_T - ln A - exponent ln D_R)^2/(e_T^2 + exponent^2 e_R^2) are
    minimal; the intervals are those of the squared deviations over their mean, with Student's t of
    C - 2 degrees of freedom. Clusters that differ in size move both means of a condition together,
    so that the errors are correlated; that makes the stated intervals wider than needed where the
    exponent is positive.

    Examples
    --------
    >>> from perrin.study import Coefficient, population_mean
    >>> def mean(v):
    ...     return population_mean([Coefficient(v, (0.96 * v, 1.04 * v), (0.92 * v, 1.08 * v))])
    >>> rates = [1e-3, 3e-3, 1e-2, 2e-2]
    >>> found = fit_power_law([mean(d) for d in rates], [mean(5 * d**0.8) for d in rates])
    >>> round(found.parameters["exponent"], 3)
    0.8
    """
    from scipy.special import gammaincc

    faults = []
    if len(D_R) != len(D_T) or len(D_R) < 3:
        faults.append(
            f"D_R, D_T: expected as many means of both, three or more, got {len(D_R)} and "
            f"{len(D_T)}"
        )
    faults += [
        f"{name}: expected positive means with finite errors, got {one}"
        for name, many in (("D_R", D_R), ("D_T", D_T))
        for one in many
        if not (one.value > 0 and 0 < one.log_stderr < np.inf)
    ]
    refuse(faults)
    x, y = (np.log([one.value for one in many]) for many in (D_R, D_T))
    ex, ey = (np.array([one.log_stderr for one in many]) for many in (D_R, D_T))
    dof = len(x) - 2

    def roots(parameters: Floats) -> Floats:
        a, b = parameters
        return np.asarray((y - a - b * x) / np.sqrt(ey**2 + (b * ex) ** 2))

    from scipy.optimize import least_squares

    slope = np.polyfit(x, y, 1)[::-1]

    def rise(k: int, value: float) -> float:
        def rest(free: Floats) -> Floats:
            return roots(np.insert(free, k, value))

        return 2 * float(least_squares(rest, np.delete(best.x, k), xtol=1e-12).cost) - deviance

    best = least_squares(roots, slope, xtol=1e-12)
    deviance = 2 * float(best.cost)
    dispersion = max(deviance / dof, 1e-12)
    errors = np.sqrt(np.diag(np.linalg.pinv(best.jac.T @ best.jac)) * dispersion)
    found = [
        _likelihood_ends(partial(rise, k), float(best.x[k]), float(errors[k]), dispersion, dof=dof)
        for k in (0, 1)
    ]
    A = float(np.exp(best.x[0]))
    return Trend(
        law="power",
        parameters={"A": A, "exponent": float(best.x[1])},
        stderr={"A": A * float(errors[0]), "exponent": float(errors[1])},
        ci95={
            "A": (float(np.exp(found[0][0])), float(np.exp(found[0][1]))),
            "exponent": (found[1][0], found[1][1]),
        },
        spread=0.0,
        dof=dof,
        p=float(gammaincc(dof / 2, deviance / 2)),
        x=np.exp(x),
        residuals=roots(best.x),
        log_deviations=y - best.x[0] - best.x[1] * x,
    )


def _root_places(log_D: Floats, row: Floats) -> Floats:
    """Return ln D of a movie at the signed roots `_MOVIE_ROOTS` of its deviance.

    Beyond the known roots they are straight lines in ln D.
    """
    i = min(max(int(np.argmax(row)), 1), row.size - 2)
    bend, slope = row[i - 1] - 2 * row[i] + row[i + 1], (row[i + 1] - row[i - 1]) / 2
    offset = float(np.clip(-slope / bend, -1, 1)) if bend < 0 else 0.0
    centre, top = log_D[i] + offset * float(log_D[1] - log_D[0]), row[i] + offset * slope / 2
    root = np.sign(log_D - centre) * np.sqrt(np.maximum(2 * (top - row), 0.0))
    keep = np.abs(root) < _KNOWN_ROOT
    x, r = log_D[keep], np.maximum.accumulate(root[keep])
    low = x[0] - _CONTINUED_ROOT * (centre - x[0]) / max(-r[0], 0.2)
    high = x[-1] + _CONTINUED_ROOT * (x[-1] - centre) / max(r[-1], 0.2)
    roots = np.concatenate([[r[0] - _CONTINUED_ROOT], r, [r[-1] + _CONTINUED_ROOT]])
    places = np.interp(_MOVIE_ROOTS, roots, np.concatenate([[low], x, [high]]))
    return np.asarray(places, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class _Fit:
    """Parameters of least deviance."""

    parameters: Floats
    deviance: float
    roots: Floats
    covariance: Floats


def _checked_law(
    means: Sequence[PopulationMean],
    x: Floats,
    law: LawName | Law,
    start: Mapping[str, float] | None,
) -> tuple[tuple[str, ...], Callable[..., Floats]]:
    """Return the parameters and the logarithm of a law, or refuse the arguments."""
    faults = []
    if x.shape != (len(means),) or not np.isfinite(x).all():
        faults.append(f"x: expected a finite number for each of {len(means)} means, got {x}")
    faults += [
        f"means: the mean of condition {k} has no likelihoods of movies (it was read from a "
        "file, or its only cluster has no lower limit)"
        for k, one in enumerate(means)
        if one.movies is None
    ]
    if callable(law):
        if not start:
            faults.append("start: expected a value for every parameter of the function")
        refuse(faults)
        names = tuple(start or {})

        def own(at: Floats, *values: float) -> Floats:
            with np.errstate(all="ignore"):
                D = np.asarray(law(at, *values), dtype=np.float64)
                return np.where(D > 0, np.log(np.where(D > 0, D, 1.0)), -1e3)

        if np.any(own(x, *(start or {}).values()) == -1e3):
            refuse([f"start: expected parameters at which the law is above 0, got {start}"])
        return names, own
    faults += choice_fault("law", law, LAWS)
    if law in LAWS and LAWS[law][1] and not np.all(x > 0):
        faults.append(f"x: expected numbers > 0 for the law {law!r}, got {x}")
    refuse(faults)

    def linear(at: Floats, log_A: float, second: float = 0.0) -> Floats:
        power = {"proportional": 1.0, "inverse": -1.0, "power": second}.get(law, 0.0)
        grown = second * at if law == "exponential" else 0.0
        return np.asarray(log_A + grown + (power * np.log(at) if LAWS[law][1] else 0.0 * at))

    return LAWS[law][0], linear


def _least_deviance(
    places: Floats,
    x: Floats,
    logarithm: Callable[..., Floats],
    first: Floats,
    fixed: tuple[int, float] | None,
) -> _Fit:
    """Return the parameters of least deviance, one of them perhaps fixed."""
    from scipy.optimize import least_squares

    def whole(free: Floats) -> Floats:
        return free if fixed is None else np.insert(free, fixed[0], fixed[1])

    def roots(free: Floats) -> Floats:
        # The signed root of each movie at its own ln D, between the places of `_MOVIE_ROOTS`.
        log_D = logarithm(x, *whole(free))
        row = np.arange(len(places))
        k = np.clip(np.sum(places < log_D[:, None], axis=1), 1, _MOVIE_ROOTS.size - 1)
        left, right = places[row, k - 1], places[row, k]
        share = (log_D - left) / np.maximum(right - left, 1e-12)
        return np.asarray(_MOVIE_ROOTS[k - 1] + share * (_MOVIE_ROOTS[k] - _MOVIE_ROOTS[k - 1]))

    free = first if fixed is None else np.delete(first, fixed[0])
    if free.size == 0:
        values = roots(free)
        return _Fit(whole(free), float(values @ values), -values, np.empty((0, 0)))
    found = least_squares(
        roots, free, x_scale=np.maximum(np.abs(free), 0.1), ftol=1e-14, xtol=1e-12
    )
    covariance = np.linalg.pinv(found.jac.T @ found.jac)
    return _Fit(whole(found.x), 2 * float(found.cost), -found.fun, covariance)


def _paule_mandel_spread(excess: Callable[[float], float]) -> float:
    """Return the spread at which the excess of the deviance is 0; 0 where there is none."""
    from scipy.optimize import brentq

    if excess(0.0) <= 0:
        return 0.0
    if excess(_NARROWEST) <= 0:
        return _NARROWEST
    if excess(_WIDEST) >= 0:
        return _WIDEST
    return float(brentq(excess, _NARROWEST, _WIDEST, xtol=1e-10))


def _likelihood_ends(
    rise: Callable[[float], float], value: float, error: float, dispersion: float, *, dof: int
) -> tuple[float, float]:
    """Return the ends of the 95 % interval of a parameter."""
    from scipy.optimize import brentq
    from scipy.special import stdtrit

    t = float(stdtrit(dof, 0.975))
    level = t * t * dispersion

    def end(sign: float) -> float:
        inner, step = 0.0, max(1.1 * t * error, 1e-9 * max(abs(value), 1e-3))
        first = step
        while rise(value + sign * step) < level:
            inner, step = step, 2 * step
            if step > 1e6 * first:
                return sign * np.inf
        found = brentq(lambda s: rise(value + sign * s) - level, inner, step, xtol=1e-4 * step)
        return value + sign * float(found)

    return end(-1.0), end(1.0)
