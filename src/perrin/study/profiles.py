"""Likelihoods of ln D of single clusters, from the intervals that their estimates state."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from perrin._arrays import refuse
from perrin.diffusion.estimate import NORMAL

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from perrin._arrays import Floats


# Signed roots of the likelihood ratio at the ends of the intervals and at the value.
_ROOTS = np.array([-NORMAL[0.95], -NORMAL[0.68], 0.0, NORMAL[0.68], NORMAL[0.95]])

_FAR = 40.0  # signed root up to which a likelihood is continued: exp(-800) is 0


class Interval(Protocol):
    """A value with intervals: a `DiffusionEstimate`, or another result with these attributes."""

    @property
    def value(self) -> float:
        """Value."""

    @property
    def ci68(self) -> tuple[float, float]:
        """68 % interval."""

    @property
    def ci95(self) -> tuple[float, float]:
        """95 % interval."""


@dataclass(frozen=True)
class Coefficient:
    """A positive coefficient of one cluster, with the intervals of its likelihood.

    Attributes
    ----------
    value : float
        D_R in rad^2/s, D_T in um^2/s, or their ratio in um^2; 0 where only a limit is known.
    ci68, ci95 : tuple of float
        Confidence intervals; a lower end is 0 where the data do not bound it.

    Examples
    --------
    >>> Coefficient(5e-3, (4.6e-3, 5.4e-3), (4.2e-3, 5.9e-3)).value
    0.005
    """

    value: float
    ci68: tuple[float, float]
    ci95: tuple[float, float]

    @classmethod
    def of(cls, estimate: Interval) -> Coefficient:
        """Return the coefficient of an estimate; ends below 0 become 0.

        Parameters
        ----------
        estimate : DiffusionEstimate or similar
        """
        low68, high68 = estimate.ci68
        low95, high95 = estimate.ci95
        return cls(
            max(float(estimate.value), 0.0),
            (max(float(low68), 0.0), float(high68)),
            (max(float(low95), 0.0), float(high95)),
        )

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> Coefficient:
        """Return the coefficient that an entry of a file states.

        Parameters
        ----------
        entry : mapping
            "value", "ci68" and "ci95"; None for what is not known, and for an end without bound.

        Examples
        --------
        >>> Coefficient.from_dict({"value": 2.0, "ci68": [1.0, 3.0], "ci95": [None, 4.0]}).ci95
        (0.0, 4.0)
        """

        def ends(pair: Sequence[float | None]) -> tuple[float, float]:
            low, high = pair
            if low is None and high is None:
                return np.nan, np.nan
            return 0.0 if low is None else low, np.inf if high is None else high

        value = np.nan if entry["value"] is None else float(entry["value"])
        return cls.of(cls(value, ends(entry["ci68"]), ends(entry["ci95"])))

    @property
    def absent_because(self) -> str | None:
        """Why the likelihood is not known; None where it is."""
        if np.isnan(self.value):
            return "no value"
        if not np.isfinite(self.ci95[1]):
            return "the interval has no upper end"
        ends = (self.ci95[0], self.ci68[0], self.value, self.ci68[1], self.ci95[1])
        if not (np.all(np.diff(ends) >= 0) and ends[-1] > ends[2] and ends[3] > ends[2]):
            return "the intervals do not contain the value"
        return None


def ratio_of(numerator: Interval, denominator: Interval) -> Coefficient:
    """Return the ratio of two independent coefficients with its intervals.

    The distances from the value to the ends of both logarithms add in squares, those upwards of
    one with those downwards of the other (method of variance estimates recovery: Donner & Zou,
    Stat. Methods Med. Res. 21, 347, 2012). The errors of D_T of the centre and of D_R are
    independent.

    Parameters
    ----------
    numerator, denominator : DiffusionEstimate or Coefficient
        Both with a positive value.

    Returns
    -------
    Coefficient
        NaN where one of the two has no positive value.

    Examples
    --------
    >>> one = Coefficient(2.0, (1.8, 2.2), (1.6, 2.5))
    >>> ratio_of(one, one).value
    1.0
    """
    top, bottom = Coefficient.of(numerator), Coefficient.of(denominator)
    if not (top.value > 0 and bottom.value > 0):
        return Coefficient(np.nan, (np.nan, np.nan), (np.nan, np.nan))
    centre = np.log(top.value) - np.log(bottom.value)
    ends = []
    with np.errstate(divide="ignore"):
        for a, b in ((top.ci68, bottom.ci68), (top.ci95, bottom.ci95)):
            (up_low, up_high), (down_low, down_high) = (
                np.abs(np.log(np.array(pair)) - np.log(one.value))
                for pair, one in ((a, top), (b, bottom))
            )
            ends.append(
                (centre - np.hypot(up_low, down_high), centre + np.hypot(up_high, down_low))
            )
    ci68, ci95 = ((float(np.exp(low)), float(np.exp(high))) for low, high in ends)
    return Coefficient(float(np.exp(centre)), ci68, ci95)


def log_likelihoods(coefficients: Sequence[Coefficient], log_D: Floats) -> Floats:
    """Return the log-likelihood of each cluster at given values of ln D, at most 0.

    The signed root of the likelihood ratio, r(ln D) with the log-likelihood -r^2/2, is known at the
    ends of the 68 % and 95 % intervals and at the value: there it is -1.96, -0.99, 0, 0.99, 1.96.
    Between them a monotone cubic (PCHIP) in r is inverted; outside r is a straight line. A
    likelihood that does not vanish at D = 0 (a lower end of 0) is normal in D on the lower side.

    Parameters
    ----------
    coefficients : sequence of Coefficient
        Each with a known likelihood (`Coefficient.absent_because` is None).
    log_D : ndarray, shape (G,)
        Values of ln D, increasing.

    Returns
    -------
    ndarray, shape (N, G)

    Raises
    ------
    ValueError
        If the likelihood of a coefficient is not known.

    Examples
    --------
    >>> one = Coefficient(1.0, (0.9, 1.1), (0.8, 1.2))
    >>> log_likelihoods([one], np.log([0.8, 1.0, 1.2])).round(2) + 0
    array([[-1.92,  0.  , -1.92]])
    """
    from scipy.interpolate import PchipInterpolator

    refuse(
        f"coefficient {k}: expected a likelihood that is known, got {one}: {one.absent_because}"
        for k, one in enumerate(coefficients)
        if one.absent_because
    )
    out = np.empty((len(coefficients), log_D.size))
    inner = np.linspace(_ROOTS[0], _ROOTS[-1], 33)
    roots = np.concatenate([[-_FAR], inner, [_FAR]])
    bounded = [k for k, one in enumerate(coefficients) if one.ci95[0] > 0 and one.value > 0]
    if bounded:
        ends = np.array(
            [
                (one.ci95[0], one.ci68[0], one.value, one.ci68[1], one.ci95[1])
                for one in (coefficients[k] for k in bounded)
            ]
        )
        # Ends that coincide (rounded input) would make r(ln D) vertical.
        places = np.maximum.accumulate(np.log(ends) + 1e-12 * np.arange(5), axis=1)
        curve = PchipInterpolator(_ROOTS, places.T)(inner).T
        low = (places[:, 1] - places[:, 0]) / (_ROOTS[1] - _ROOTS[0])
        high = (places[:, 4] - places[:, 3]) / (_ROOTS[4] - _ROOTS[3])
        reach = _FAR - _ROOTS[-1]
        line = np.column_stack([curve[:, 0] - reach * low, curve, curve[:, -1] + reach * high])
        for k, row in zip(bounded, line, strict=True):
            out[k] = -0.5 * np.interp(log_D, row, roots) ** 2
    for k in set(range(len(coefficients))) - set(bounded):
        out[k] = _limit_log_likelihood(coefficients[k], log_D)
    return out


def _limit_log_likelihood(one: Coefficient, log_D: Floats) -> Floats:
    """Return the log-likelihood of a coefficient that may be 0."""
    D = np.exp(log_D)
    if one.value == 0:
        return np.asarray(-0.5 * (NORMAL[0.95] * D / one.ci95[1]) ** 2)
    if one.ci68[0] > 0:
        lower = (one.value - one.ci68[0]) / NORMAL[0.68]
    else:
        # The 68 % interval contains 0 too: the likelihood falls by less than half a unit.
        lower = max(one.ci68[1] - one.value, one.value) / NORMAL[0.68]
    upper = np.interp(
        log_D,
        np.log([one.value, one.ci68[1], one.ci95[1]]),
        _ROOTS[2:],
    )
    slope = (_ROOTS[4] - _ROOTS[3]) / (np.log(one.ci95[1]) - np.log(one.ci68[1]))
    upper += np.maximum(log_D - np.log(one.ci95[1]), 0.0) * slope
    return np.asarray(-0.5 * np.where(one.value > D, (one.value - D) / lower, upper) ** 2)
