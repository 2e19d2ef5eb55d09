"""Relaxation times and stretched exponents of orientation correlations, and their ratio."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from perrin._arrays import refuse, to_plain
from perrin._display import Shown
from perrin._text import with_error
from perrin.curves.correlation_errors import (
    correlation_covariance,
    frames_present,
    product_weights,
)
from perrin.curves.displacement import LagCurve
from perrin.diffusion.estimate import NORMAL
from perrin.errors import TooFewFramesError

if TYPE_CHECKING:
    from perrin._arrays import Floats

# The fit ends where the correlation has fallen to this part of its first value, or at this part of
# the longest stretch of frames: fits of Brownian rotation to longer lags have larger errors.
_LAST_VALUE, _LAST_LAG = 0.4, 0.25

_RELAXATION_LAGS = 12  # evenly spaced lags of the fit: those between them vary with them


@dataclass(frozen=True, repr=False)
class RelaxationEstimate(Shown):
    """Relaxation time of an orientation correlation, its stretched exponent, and their errors.

    Attributes
    ----------
    tau : float
        Relaxation time of an exponential with free amplitude, s: 1/(l(l + 1) D_R) for diffusion.
    stderr : float
        Standard error of tau, s.
    ci68, ci95 : tuple of float
        Confidence intervals of tau, s, symmetric in its logarithm.
    amplitude : float
        Value of the exponential at lag 0: below 1 from noise, or from faster motion.
    amplitude_stderr : float
        Standard error of the amplitude.
    beta : float
        Exponent of a stretched exponential exp(-(t/tau)^beta), whose own tau is free: 1 for
        diffusion.
    beta_stderr : float
        Standard error of beta for diffusion.
    beta_ci68, beta_ci95 : tuple of float
        Confidence intervals of beta.
    ratio : float or None
        tau_1/tau_2 of both degrees, 3 for diffusion; None without a second curve.
    ratio_stderr : float or None
        Standard error of the ratio; both curves come from one track and vary together.
    ratio_ci68, ratio_ci95 : tuple of float, or None
        Confidence intervals of the ratio.
    degree : int
        Degree l of the first curve, to which tau, amplitude and beta belong.
    lag_range : tuple of float
        First and last lag of the fit, s.
    relaxations : float
        Duration of the track over tau. Below about 10 tau is known to no better than 25 %.
    unit : str
        Unit of tau: "s".
    """

    tau: float
    stderr: float
    ci68: tuple[float, float]
    ci95: tuple[float, float]
    amplitude: float
    amplitude_stderr: float
    beta: float
    beta_stderr: float
    beta_ci68: tuple[float, float]
    beta_ci95: tuple[float, float]
    ratio: float | None
    ratio_stderr: float | None
    ratio_ci68: tuple[float, float] | None
    ratio_ci95: tuple[float, float] | None
    degree: int
    lag_range: tuple[float, float]
    relaxations: float
    unit: str = "s"

    @property
    def beta_limit(self) -> float:
        """The beta of diffusion less two standard errors: only a beta below it means something."""
        return 1 - 2 * self.beta_stderr

    @property
    def stretched(self) -> bool:
        """Whether beta is below its limit, so that the decay is slower than an exponential."""
        return self.beta < self.beta_limit

    @property
    def text(self) -> str:
        """Relaxation time, exponent with its limit, and ratio, in one sentence."""
        verdict = "stretched" if self.stretched else "consistent with an exponential"
        words = (
            f"tau_{self.degree} = {with_error(self.tau, self.stderr)} s, beta = "
            f"{with_error(self.beta, self.beta_stderr)}: {verdict} "
            f"(stretched below {self.beta_limit:.2f})"
        )
        if self.ratio is None or self.ratio_stderr is None:
            return words
        return f"{words}; tau_1/tau_2 = {with_error(self.ratio, self.ratio_stderr)}, diffusion: 3"

    def __str__(self) -> str:
        return self.text

    def to_dict(self) -> dict[str, Any]:
        """Return the estimate for JSON: None for numbers that are not finite."""
        return {field.name: to_plain(getattr(self, field.name)) for field in fields(self)}

    @classmethod
    def from_dict(cls, entry: dict[str, Any]) -> RelaxationEstimate:
        """Return the estimate that `to_dict` wrote."""
        read = dict(entry)
        for name in ("ci68", "ci95", "beta_ci68", "beta_ci95", "ratio_ci68", "ratio_ci95"):
            if entry[name] is not None:
                low, high = entry[name]
                read[name] = (low, np.inf if high is None else high)
        read["lag_range"] = tuple(entry["lag_range"])
        for name in ("stderr", "amplitude_stderr", "beta_stderr"):
            read[name] = np.inf if entry[name] is None else entry[name]
        return cls(**read)


class Decay(NamedTuple):
    """Lags of a correlation that are fitted, the fit, and how it responds to the correlation.

    Attributes
    ----------
    lag : ndarray, shape (n,)
        Lags in steps.
    present : ndarray, shape (n,)
        Fraction of the frames that is present at each lag.
    blocks : tuple of int
        Steps of each stretch of frames.
    values : ndarray, shape (p,)
        Amplitude, logarithm of tau in steps and, of a stretched exponential, beta.
    response : ndarray, shape (p, n)
        Change of the values with the correlation at each lag.
    """

    lag: Floats
    present: Floats
    blocks: tuple[int, ...]
    values: Floats
    response: Floats


def fit_relaxation(curve: LagCurve, second: LagCurve | None = None) -> RelaxationEstimate:
    """Fit an exponential and a stretched exponential to an orientation correlation.

    Least squares over evenly spaced lags, up to the lag where the correlation has fallen to 40 % of
    its first value, or to a quarter of the track. The amplitude is always free: noise multiplies
    the correlation, and motion faster than a frame (rattling in a cage) does so as well, so that a
    curve forced through 1 has a tau that is too short.

    Parameters
    ----------
    curve : LagCurve
        Curve of `orientation_correlation`, corrected for noise or not.
    second : LagCurve, optional
        Curve of the same motion and directions with the other degree; tau_1/tau_2 is then compared
        with 3. Reorientation by large angles gives a ratio near 1.

    Returns
    -------
    RelaxationEstimate

    Raises
    ------
    ValueError
        If a curve is no orientation correlation, or the second has the same degree, other lags or
        other directions.
    TooFewFramesError
        If fewer than four lags are left for the fit, or the correlation does not fall.

    Notes
    -----
    Values of the correlation at neighbouring lags vary together, so that the scatter about the fit
    says nothing about its error. The errors are those of the fit for the sampling covariance of a
    Brownian rotor with the fitted tau, of the same frames: sd(tau_l)/tau_l is about
    sqrt(c tau_l/T) with c = 0.5 to 0.9. The covariance is exact for an isotropic rotor, and for the
    axis of a symmetric top.

    Examples
    --------
    >>> from perrin import Cluster, orientation_correlation, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.0), D_R=1e-2, dt=1.0, n_frames=4000, rng=0)
    >>> found = fit_relaxation(*(orientation_correlation(truth, degree=l) for l in (1, 2)))
    >>> found.ci95[0] < 50 < found.ci95[1], found.ratio_ci95[0] < 3 < found.ratio_ci95[1]
    (True, True)
    """
    curves = [curve] if second is None else [curve, second]
    refuse(relaxation_faults(curves))
    plain = [fit_decay(c, stretched=False) for c in curves]
    stretched = fit_decay(curve, stretched=True)
    directions = np.asarray(curve.directions)
    degrees = [_degree(c) for c in curves]

    def covariance(a: int, b: int, fits: list[Decay], *, rotor: int) -> Floats:
        """Return the covariance of the values of two fits, for the rotor that one curve shows."""
        one, other = fits[a], fits[b]
        both = (degrees[a], degrees[b])
        amplitude, log_tau = plain[rotor].values
        rate = 2 * curves[rotor].dof
        sampling = correlation_covariance(
            (one.lag, other.lag), degrees=both, weights=product_weights(directions, degrees=both),
            blocks=one.blocks, present=(one.present, other.present),
            D=float(np.exp(-log_tau)) / rate, s=-float(np.log(min(amplitude, 1.0))) / rate,
        )  # fmt: skip
        return np.asarray(one.response @ sampling @ other.response.T)

    own = covariance(0, 0, plain, rotor=0)
    exponent = covariance(0, 0, [stretched], rotor=0)
    step = float(curve.step or curve.lagtime[0])
    tau, relative = step * float(np.exp(plain[0].values[1])), float(np.sqrt(own[1, 1]))
    beta, error = float(stretched.values[2]), float(np.sqrt(exponent[2, 2]))
    ratio = spread = None
    if second is not None:
        sign = 1 if degrees[0] == 1 else -1
        ratio = float(np.exp(sign * (plain[0].values[1] - plain[1].values[1])))
        better = degrees.index(2)  # its tau has the smaller error
        one, both, two = (
            float(covariance(*pair, plain, rotor=better)[1, 1]) for pair in ((0, 0), (0, 1), (1, 1))
        )
        variance = one + two - 2 * both
        spread = float(np.sqrt(max(variance, 0.0)))
    return RelaxationEstimate(
        tau=tau,
        stderr=tau * relative,
        ci68=log_interval(tau, relative, level=0.68),
        ci95=log_interval(tau, relative, level=0.95),
        amplitude=float(plain[0].values[0]),
        amplitude_stderr=float(np.sqrt(own[0, 0])),
        beta=beta,
        beta_stderr=error,
        beta_ci68=(beta - NORMAL[0.68] * error, beta + NORMAL[0.68] * error),
        beta_ci95=(beta - NORMAL[0.95] * error, beta + NORMAL[0.95] * error),
        ratio=ratio,
        ratio_stderr=None if ratio is None or spread is None else ratio * spread,
        ratio_ci68=None
        if ratio is None or spread is None
        else log_interval(ratio, spread, level=0.68),
        ratio_ci95=None
        if ratio is None or spread is None
        else log_interval(ratio, spread, level=0.95),
        degree=degrees[0],
        lag_range=(step * float(plain[0].lag[0]), step * float(plain[0].lag[-1])),
        relaxations=step * sum(plain[0].blocks) / tau,
    )


def log_interval(value: float, relative: float, *, level: float) -> tuple[float, float]:
    """Return the interval of a positive value whose logarithm is normally distributed.

    Examples
    --------
    >>> low, high = log_interval(2.0, 0.1, level=0.95)
    >>> round(low, 2), round(high, 2)
    (1.64, 2.43)
    """
    with np.errstate(over="ignore"):
        factor = np.exp(NORMAL[level] * relative)
    return float(value / factor), float(value * factor)


def relaxation_faults(curves: list[LagCurve]) -> list[str]:
    """Return a line for every reason why correlations cannot be fitted, or not together.

    Examples
    --------
    >>> from perrin import Cluster, msad, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.0), D_R=1e-2, dt=1.0, n_frames=40, rng=0)
    >>> relaxation_faults([msad(truth)])
    ['curve: expected a curve of orientation_correlation, got LagCurve(MSAD, 39 lags, dof=2, rad^2)']
    """  # noqa: E501 (what Python prints)
    faults = [
        f"{name}: expected a curve of orientation_correlation, got {c!r}"
        for name, c in zip(("curve", "second"), curves, strict=False)
        if not (
            isinstance(c, LagCurve) and c.quantity == "orientation" and c.directions is not None
        )
    ]
    if faults or len(curves) == 1:
        return faults
    first, second = curves
    if first.dof == second.dof:
        faults.append(f"second: expected the other degree, got {_degree(second)} twice")
    if not np.array_equal(first.lagtime, second.lagtime):
        faults.append("second: expected a curve of the same motion, got other lags")
    if not np.array_equal(np.asarray(first.directions), np.asarray(second.directions)):
        faults.append("second: expected the same directions as in the first curve")
    return faults


def _degree(curve: LagCurve) -> int:
    """Return the degree of a correlation: dof is half of l(l + 1)."""
    return 1 if curve.dof == 1 else 2


def fit_decay(curve: LagCurve, *, stretched: bool) -> Decay:
    """Fit an exponential, or a stretched one, of free amplitude to a correlation.

    Parameters
    ----------
    curve : LagCurve
        Correlation of orientations.
    stretched : bool
        Whether the exponent beta is fitted.

    Returns
    -------
    Decay

    Raises
    ------
    TooFewFramesError
        If fewer than four lags are left, or the correlation does not fall.

    Examples
    --------
    >>> from perrin import Cluster, orientation_correlation, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.0), D_R=1e-2, dt=1.0, n_frames=4000, rng=0)
    >>> fit_decay(orientation_correlation(truth), stretched=True).values.shape
    (3,)
    """
    from scipy.optimize import least_squares

    step = float(curve.step or curve.lagtime[0])
    good = np.flatnonzero(np.isfinite(curve.value))
    lag, value = curve.lagtime[good] / step, curve.value[good]
    blocks, present = frames_present(lag, curve.n_pairs[good], curve.blocks)
    end = int(np.searchsorted(lag, _LAST_LAG * max(blocks), side="right"))
    below = np.flatnonzero(value <= _LAST_VALUE * max(value[0], 0.0))
    end = min(end, int(below[0])) if below.size else end
    use = np.unique(np.linspace(0, max(end - 1, 0), _RELAXATION_LAGS).astype(int))
    if len(use) < 4:
        raise TooFewFramesError(
            f"the correlation has {len(use)} lags before it has decayed; 4 are needed: record "
            "faster, or longer",
            len(use),
        )
    x, y = lag[use], value[use]

    def model(values: Floats) -> Floats:
        beta = values[2] if stretched else 1.0
        return np.asarray(values[0] * np.exp(-((x / np.exp(values[1])) ** beta)))

    start = [max(float(y[0]), 0.1), np.log(x[-1] / 2)] + [1.0] * stretched
    longest = np.log(1e4 * lag[-1])
    bounds = ([0.0, np.log(1e-2)], [2.0, longest])
    if stretched:
        bounds = ([*bounds[0], 0.05], [*bounds[1], 5.0])
    fit = least_squares(lambda v: model(v) - y, start, bounds=bounds, x_scale="jac", xtol=1e-12)
    if not stretched and fit.x[1] > longest - 1:
        raise TooFewFramesError(
            f"the correlation does not fall within {step * x[-1]:.3g} s: record longer", len(use)
        )
    return Decay(x, present[use], blocks, fit.x, np.linalg.pinv(fit.jac))
