"""Storage and loss modulus of the surroundings, from the motion of a cluster (microrheology)."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args

import numpy as np

from perrin._arrays import choice_fault, from_plain, frozen, refuse, to_plain
from perrin._display import Shown
from perrin._text import number_text
from perrin.curves.displacement import LagCurve, msad_vector, msd
from perrin.diffusion.curve_fits import GridLags
from perrin.diffusion.steps import Quantity
from perrin.geometry.shapes import Cluster
from perrin.hydrodynamics.mobility import BOLTZMANN, Mobility, condition_faults
from perrin.hydrodynamics.sizes import shape_mobility

if TYPE_CHECKING:
    from collections.abc import Mapping
    from typing import Self

    import pandas as pd
    from numpy.typing import ArrayLike

    from perrin._arrays import Bools, Floats
    from perrin.motion.rigid_motion import RigidMotion

# Longer lags have errors above 20 % of a modulus.
_LONGEST_LAG = 10

# Ratio of neighbouring lags: closer ones hold no further information.
_LAG_RATIO = 1.25

# Width of the Gaussian window in ln t in which the power law is local, and its reach in widths.
_WINDOW_WIDTH, _WINDOW_REACH = 0.7, 2.5

# Where a power law is rejected at this level, the offset is fitted to half the range of lags; it
# needs this many lags.
_REJECTED, _FEWEST_LAGS = 0.05, 5

# Exponents that a power law of a mean square may have.
_LEAST_EXPONENT, _MOST_EXPONENT = 0.02, 1.98

# A modulus is stated as reliable where its 68 % interval is within this factor on either side.
_RELIABLE_FACTOR = 1.5

# Points of each of two normal variables whose joint quantiles give the bands.
_QUANTILE_POINTS = 41

# The covariance is that of the fit before, until its parameters change by less than this.
_STEADY_FIT, _MOST_ROUNDS = 1e-4, 20

# Added to variances, relative: covariances of a mean square near exponent 2 are almost singular.
_LAG_RIDGE = 1e-9

_ARRAYS = (
    "frequency", "modulus", "exponent", "storage", "loss", "modulus_ci68", "exponent_ci68",
    "storage_ci68", "loss_ci68",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Moduli(Shown):
    """Complex shear modulus against frequency, with its bands.

    Attributes
    ----------
    frequency : ndarray, shape (F,)
        Angular frequency 1/t of the lag time t, rad/s, rising.
    modulus : ndarray, shape (F,)
        Magnitude of the complex modulus, Pa.
    exponent : ndarray, shape (F,)
        Slope alpha of ln(mean square) against ln t: 1 in a viscous fluid, 0 in an elastic solid.
    storage, loss : ndarray, shape (F,)
        Storage modulus G' and loss modulus G'', Pa. G' is negative where alpha exceeds 1.
    modulus_ci68, exponent_ci68, storage_ci68, loss_ci68 : ndarray, shape (F, 2)
        68 % bands.
    reliable : ndarray of bool, shape (F,)
        Whether the modulus is known within a factor of 1.5 (68 %).
    offset : float
        Variance of one orientation (rad^2) or coordinate (um^2) from noise that was subtracted.
    offset_stderr : float
        Standard error of the offset; 0 where it was taken from the residuals.
    quantity : {"rotation", "translation"}
        Motion from which the moduli follow.
    n_frames : int
        Number of frames that the curve spans.
    unit : str
        Unit of the moduli: "Pa".
    """

    frequency: Floats
    modulus: Floats
    exponent: Floats
    storage: Floats
    loss: Floats
    modulus_ci68: Floats
    exponent_ci68: Floats
    storage_ci68: Floats
    loss_ci68: Floats
    reliable: Bools
    offset: float
    offset_stderr: float
    quantity: str
    n_frames: int
    unit: str = "Pa"

    def __post_init__(self) -> None:
        frozen(*(getattr(self, name) for name in _ARRAYS), self.reliable)

    @property
    def text(self) -> str:
        """One sentence: the range of frequencies in which the moduli are known, and the modulus."""
        start = f"moduli from {self.quantity}, {self.n_frames} frames"
        if not self.reliable.any():
            return f"{start}: at no frequency known within a factor of {_RELIABLE_FACTOR:g}"
        known = self.frequency[self.reliable]
        low, high = (self.modulus[self.reliable][i] for i in (0, -1))
        return (
            f"{start}: known within a factor of {_RELIABLE_FACTOR:g} from {known[0]:.3g} to "
            f"{known[-1]:.3g} rad/s; |G*| is {number_text(low)} Pa to {number_text(high)} Pa"
        )

    def __str__(self) -> str:
        return self.text

    def __repr__(self) -> str:
        return f"Moduli({len(self.frequency)} frequencies, {self.quantity}, {self.unit})"

    def to_frame(self) -> pd.DataFrame:
        """Return a table with a row per frequency; ends of bands in columns _low and _high."""
        import pandas as pd

        columns: dict[str, object] = {"frequency": self.frequency}
        for name in ("modulus", "exponent", "storage", "loss"):
            low, high = getattr(self, f"{name}_ci68").T
            columns |= {name: getattr(self, name), f"{name}_low": low, f"{name}_high": high}
        return pd.DataFrame(columns | {"reliable": self.reliable})

    def to_dict(self) -> dict[str, Any]:
        """Return the moduli for JSON: lists for arrays, None for NaN."""
        return {field.name: to_plain(getattr(self, field.name)) for field in fields(self)}

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> Self:
        """Return the moduli that `to_dict` wrote.

        Parameters
        ----------
        entry : mapping
        """
        arrays = {name: from_plain(entry[name]) for name in _ARRAYS}
        arrays |= {"reliable": from_plain(entry["reliable"], dtype=np.bool_)}
        return cls(**(dict(entry) | arrays))


def viscoelastic_moduli(
    motion_or_curve: RigidMotion | LagCurve,
    *,
    cluster: Cluster | Mobility | ArrayLike,
    temperature: float,
    quantity: Quantity | None = None,
    noise: Literal["joint", "residual"] = "joint",
) -> Moduli:
    """Return storage and loss modulus by the generalised Stokes-Einstein relation.

    Parameters
    ----------
    motion_or_curve : RigidMotion or LagCurve
        A motion, or a curve of `msd`, `msad` or `msad_vector`.
    cluster : Cluster, Mobility or array_like, shape (n, 3)
        The body, whose friction per viscosity is that of `cluster_mobility`: equal spheres of
        ``cluster.diameter``, or without one, touching spheres; a `Mobility` may have any spheres.
    temperature : float
        Temperature, K.
    quantity : {"rotation", "translation"}, optional
        Which of its two motions is used; for a motion by default rotation (`msad_vector`). A
        curve has its own.
    noise : {"joint", "residual"}
        "joint": the offset of the mean square is fitted together with a power law. "residual": it
        is that which the rigid-fit residuals predict, which is right where all particles of a
        frame are recorded at the same instant and the exposure is short; the error of ``|G*|`` at
        short lags is then five times smaller.

    Returns
    -------
    Moduli

    Raises
    ------
    ValueError
        For an unknown choice or one that contradicts the curve, a temperature that is not in
        kelvin, a single sphere without a diameter, residual noise that is not known, a body that
        does not move, or a curve with fewer than 5 lags of data up to a tenth of its length.

    Notes
    -----
    With the local power law MSD ~ t^alpha after Mason, Rheol. Acta 39, 371 (2000), at 1/t:
    ``|G*|`` = 2 d kT/(f MSD(t) Gamma(1 + alpha)), G' = ``|G*|`` cos(pi alpha/2) and G'' =
    ``|G*|`` sin(pi alpha/2), with the mean square over d axes and the friction per viscosity f of
    that motion: 6 pi a for the translation of a sphere, 8 pi a^3 for its rotation.

    The offset 2 d o is subtracted first; without that, noise reads as elasticity at short lags. It
    is fitted by generalised least squares with the exact covariance of a noisy power law, over
    the lags up to a tenth of the track, or, where they follow no power law (p < 5 %), over the
    shortest half, quarter, ... of them in logarithm of lag time that do. alpha and the mean square
    at t come from a straight line in logarithms within about a factor of 2 about t (Gaussian
    weights, width 0.7). The bands hold the errors of both and their covariance.

    Inertia, compressibility, slip, and a cluster that is not large compared with the particles of
    its surroundings are outside the relation.

    Examples
    --------
    >>> from perrin import cluster_mobility, simulate_motion
    >>> body = cluster_mobility(
    ...     Cluster.touching(4, 2.45), radius=1.225, viscosity=2.18e-3, temperature=295
    ... )
    >>> motion = simulate_motion(body, dt=0.7, n_frames=2000, rng=3)
    >>> moduli = viscoelastic_moduli(motion, cluster=body, temperature=295)
    >>> viscosity = moduli.loss[-1] / moduli.frequency[-1]
    >>> bool(abs(viscosity / 2.18e-3 - 1) < 0.1)
    True
    """
    from scipy.special import gamma, ndtri

    faults = condition_faults(temperature=temperature)
    faults += choice_fault("quantity", quantity, (None, *get_args(Quantity)))
    faults += choice_fault("noise", noise, ("joint", "residual"))
    curve = motion_or_curve if isinstance(motion_or_curve, LagCurve) else None
    if curve is not None and quantity not in (None, curve.quantity):
        faults.append(f"quantity: the curve is one of {curve.quantity}, got {quantity!r}")
    single = isinstance(cluster, Cluster) and len(cluster.positions) == 1
    if single and cluster.diameter is None:  # type: ignore[union-attr]
        faults.append("cluster: a single sphere needs its diameter, um")
    refuse(faults)
    if isinstance(motion_or_curve, LagCurve):
        curve = motion_or_curve
    else:
        turning = quantity != "translation"
        curve = msad_vector(motion_or_curve) if turning else msd(motion_or_curve)
    if noise == "residual" and not np.isfinite(curve.noise):
        raise ValueError('noise: "residual" needs a curve of a motion; this one has no residuals')
    if not np.nanmax(curve.value) > 0:
        raise ValueError("motion_or_curve: the body does not move, so that there is no modulus")
    lags = GridLags.of(curve)
    longest = max(2 * int(lags.stretches[-1][0]) // _LONGEST_LAG, 1)
    spaced = np.rint(np.geomspace(1, longest, 1 + int(np.log(longest) / np.log(_LAG_RATIO))))
    lags = lags.take(np.flatnonzero(np.isin(np.rint(lags.steps), spaced)))
    fit = _offset_fit(lags, known=curve.noise if noise == "residual" else None)
    logs, error = _local_power_laws(lags, fit)
    body = shape_mobility(cluster)
    friction = 3 * np.pi * body.diameter_T
    if curve.quantity == "rotation":
        friction = np.pi * body.diameter_R**3
    # kT over um^3 is 1e18 Pa.
    unit = BOLTZMANN * temperature * 1e18 / friction
    quantiles = ndtri((np.arange(_QUANTILE_POINTS) + 0.5) / _QUANTILE_POINTS)
    grid = np.stack(np.meshgrid(quantiles, quantiles), axis=-1).reshape(-1, 2)
    draws = logs[:, None] + np.einsum("jab,gb->jga", error, grid)
    bands, values = {}, {}
    for drawn in (False, True):
        log, alpha = (draws if drawn else logs[:, None]).transpose(2, 0, 1)
        modulus = unit * np.exp(-log) / gamma(1 + np.clip(alpha, -0.5, 3.0))
        found = {
            "modulus": modulus,
            "exponent": alpha,
            "storage": modulus * np.cos(np.pi / 2 * alpha),
            "loss": modulus * np.sin(np.pi / 2 * alpha),
        }
        for name, x in found.items():
            if drawn:
                bands[name] = np.quantile(x[::-1], (0.16, 0.84), axis=1).T
            else:
                values[name] = x[::-1, 0].copy()
    low, high = bands["modulus"].T
    factor = np.sqrt(high / low)
    return Moduli(
        frequency=1 / (lags.step * lags.steps[: len(logs)])[::-1],
        **values,
        **{f"{name}_ci68": band for name, band in bands.items()},
        reliable=np.asarray(factor < _RELIABLE_FACTOR),
        offset=fit.offset,
        offset_stderr=fit.offset_stderr,
        quantity=curve.quantity,
        n_frames=lags.n_frames,
    )


class _OffsetFit(NamedTuple):
    """A power law with an offset, y = D n^alpha + o, fitted to half a one-dimensional MSD.

    Attributes
    ----------
    D, alpha, offset : float
        Its parameters, n in steps.
    offset_stderr : float
        Standard error of the offset.
    weights : ndarray, shape (L,)
        Weights with which the curve gives the offset, to first order.
    chi2 : float
        Squared distance of the curve from the power law in its own errors.
    """

    D: float
    alpha: float
    offset: float
    offset_stderr: float
    weights: Floats
    chi2: float


def _structure(fit: _OffsetFit, length: int) -> Floats:
    """Return the half MSD of a noisy power law at 0, 1, ... length steps.

    An offset below about -(1 - alpha/2) D has no motion: the spectrum of its steps would be
    negative at the highest frequency. It is limited to nine tenths of that.
    """
    least = -0.9 * (1 - fit.alpha / 2) * fit.D
    half = fit.D * np.arange(length + 1.0) ** fit.alpha + max(fit.offset, least)
    half[0] = 0.0
    return half


def _offset_fit(lags: GridLags, *, known: float | None) -> _OffsetFit:
    """Fit a power law with an offset to the longest range of short lags that follows one."""
    from scipy.special import chdtrc

    count = int(np.searchsorted(lags.steps, lags.stretches[-1][0] / _LONGEST_LAG + 0.5))
    if count < _FEWEST_LAGS:
        raise ValueError(
            f"motion_or_curve: {count} lags with data up to a tenth of the track of "
            f"{lags.stretches[-1][0]} steps; at least {_FEWEST_LAGS} are needed"
        )
    while True:
        fit = _power_law(lags.take(slice(count)), known=known)
        freedom = count - (3 if known is None else 2)
        if count // 2 < _FEWEST_LAGS or chdtrc(freedom, fit.chi2) > _REJECTED:
            weights = np.append(fit.weights, np.zeros(lags.size - count))
            return fit._replace(weights=weights)
        count //= 2


def _power_law(lags: GridLags, *, known: float | None) -> _OffsetFit:
    """Fit y = D n^alpha + o by generalised least squares, the covariance that of the fit."""
    from scipy.optimize import minimize_scalar

    n, y = lags.steps, lags.value / (2 * lags.dof)
    length = int(lags.stretches[-1][0])
    fit = _OffsetFit(y[0], 0.5, 0.0, 0.0, np.zeros(n.size), 0.0)
    exponents = np.linspace(_LEAST_EXPONENT, _MOST_EXPONENT, 50)
    for _ in range(_MOST_ROUNDS):
        before = fit
        covariance = curve_covariance(lags, _structure(fit, length))
        full = np.linalg.inv(
            np.linalg.cholesky(covariance + _LAG_RIDGE * np.diag(np.diag(covariance)))
        )
        # The offset is linear: its best value at any exponent is projected out.
        level = full @ np.ones_like(n)
        level *= (known is None) / np.linalg.norm(level)
        root = full - np.outer(level, level @ full)
        target = root @ (y - (known or 0.0))

        def amplitude(alpha: Floats, root: Floats = root, target: Floats = target) -> Floats:
            """Return the squared distance and D of the best power law of every exponent."""
            power = root @ n[:, None] ** alpha
            square = np.sum(power**2, axis=0)
            D = target @ power / square
            distance = np.where(D > 0, target @ target - D**2 * square, np.inf)
            return np.stack([distance, D])

        best = int(np.argmin(amplitude(exponents)[0]))
        ends = exponents[max(best - 1, 0)], exponents[min(best + 1, len(exponents) - 1)]
        found = minimize_scalar(
            lambda a, f=amplitude: f(np.array([a]))[0, 0],
            bounds=ends,
            method="bounded",
            options={"xatol": 1e-9},
        )
        alpha = float(found.x)
        chi2, D = (float(x) for x in amplitude(np.array([alpha]))[:, 0])
        columns = [n**alpha, D * np.log(n) * n**alpha]
        weights, stderr, offset = np.zeros(n.size), 0.0, known
        if offset is None:
            ones = full @ np.ones_like(n)
            offset = float(ones @ (full @ (y - D * n**alpha)) / (ones @ ones))
            columns.append(np.ones_like(n))
            inverse = np.linalg.pinv(full @ np.stack(columns, axis=1))
            weights = inverse[-1] @ full
            stderr = float(np.linalg.norm(inverse[-1]))
        fit = _OffsetFit(D, alpha, offset, stderr, weights, chi2)
        if abs(alpha - before.alpha) < _STEADY_FIT and abs(D - before.D) < _STEADY_FIT * D:
            break
    return fit


def _local_power_laws(lags: GridLags, fit: _OffsetFit) -> tuple[Floats, Floats]:
    """Return (ln y, alpha) of the mean square without noise about every lag, and their errors.

    Returns
    -------
    logs : ndarray, shape (F, 2)
        NaN where the noise leaves nothing.
    root : ndarray, shape (F, 2, 2)
        Square root of their covariance.
    """
    y = lags.value / (2 * lags.dof) - fit.offset
    good = y > 0
    covariance = curve_covariance(lags, _structure(fit, int(lags.stretches[-1][0])))
    corrected = np.eye(lags.size) - fit.weights
    scale = corrected / np.where(good, y, 1.0)[:, None]
    relative = scale @ covariance @ scale.T
    log_lag, log_y = np.log(lags.steps), np.log(np.where(good, y, 1.0))
    reported = int(np.searchsorted(lags.steps, lags.stretches[-1][0] / _LONGEST_LAG + 0.5))
    logs, root = np.full((reported, 2), np.nan), np.full((reported, 2, 2), np.nan)
    for j in range(reported):
        apart = log_lag - log_lag[j]
        near = good & (np.abs(apart) <= _WINDOW_REACH * _WINDOW_WIDTH)
        if not good[j] or near.sum() < 3:
            continue
        weight = near * np.exp(-0.5 * (apart / _WINDOW_WIDTH) ** 2) / np.diag(relative)
        design = np.stack([np.ones_like(apart), apart], axis=1)
        line = np.linalg.solve((design.T * weight) @ design, design.T * weight)
        logs[j] = line @ log_y
        errors = line @ relative @ line.T
        root[j] = np.linalg.cholesky(errors + _LAG_RIDGE * np.diag(np.diag(errors)))
    return logs, root


def curve_covariance(lags: GridLags, structure: Floats) -> Floats:
    """Return the covariance of half the one-dimensional MSD at all lags, for Gaussian motion.

    Parameters
    ----------
    lags : GridLags
        Lags, in whole steps.
    structure : ndarray, shape (N + 1,)
        Expected half MSD at 0, 1, ... steps, noise included; 0 at 0. It reaches to the steps of
        the longest stretch.

    Returns
    -------
    ndarray, shape (L, L)

    Notes
    -----
    Displacements over n and m steps that begin k steps apart have the covariance
    c = s(k + n) + s(k - m) - s(k) - s(k + n - m) with the half MSD s, and the means of their
    squares 2 sum c^2 over all pairs (Isserlis). Where a fraction q of the frames is present, a
    pair that shares one frame weighs 1/q more, one that shares both 1/q^2.

    Examples
    --------
    >>> from perrin import msd
    >>> walk = np.random.default_rng(1).normal(size=(11, 1, 2)).cumsum(axis=0)
    >>> lags = GridLags.of(msd(walk, dt=1.0)).take(slice(1))
    >>> curve_covariance(lags, 0.5 * np.arange(11.0)).round(9)  # 2/10 of the MSD, over 4 and 2
    array([[0.025]])
    """
    steps = np.rint(lags.steps).astype(np.int64)
    total = np.zeros((lags.size, lags.size))
    for length, times in lags.stretches:
        inside = np.flatnonzero(steps <= length)
        around = np.concatenate([structure[length:0:-1], structure[: length + 1]])
        for i in inside:
            for j in inside[: np.searchsorted(inside, i) + 1]:
                n, m = int(steps[i]), int(steps[j])
                pairs_n, pairs_m = length + 1 - n, length + 1 - m
                k = np.arange(1 - pairs_m, pairs_n)
                at = k + length
                c = around[at + n] + around[at - m] - around[at] - around[at + n - m]
                starts = np.minimum(np.minimum(pairs_n - k, pairs_m + k), min(pairs_n, pairs_m))
                q = np.sqrt(lags.present[i] * lags.present[j])
                if q < 1:
                    for common in (k == 0, k == m - n, k == m, k == -n):
                        starts = np.where(common, starts / q, starts)
                value = 0.5 * times * float(starts @ (c * c))
                total[i, j] += value / (lags.complete[i] * lags.complete[j])
    total += np.tril(total, -1).T
    return total / lags.n_walks
