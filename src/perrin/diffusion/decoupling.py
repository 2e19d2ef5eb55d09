"""Whether translation and rotation are fast at the same times, and in the same clusters."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from perrin._arrays import refuse, to_plain
from perrin._display import Shown
from perrin._text import number_text, with_error
from perrin.diffusion.estimate import NORMAL, UNITS, DiffusionEstimate
from perrin.diffusion.likelihood import Likelihood
from perrin.diffusion.noise_model import Noise
from perrin.diffusion.step_kernels import covariance_bands
from perrin.diffusion.steps import NoisySteps, pooled_steps
from perrin.errors import TooFewFramesError
from perrin.motion.rigid_motion import RigidMotion

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from typing import Self

    from perrin._arrays import Floats
    from perrin.diffusion.long_time import LongTimeEstimate
    from perrin.hydrodynamics.mobility import Mobility

# Slow changes of mobility correlate neighbouring ranks over this many steps.
_MOST_RANK_LAGS = 60

# Fewer steps have no rank correlation with a known error, and fewer clusters no corrected one
# whose error is small against 1.
_LEAST_RANKED, _FEW_CLUSTERS = 20, 30


@dataclass(frozen=True, repr=False)
class MobilityCorrelation(Shown):
    """Rank correlation of the squared steps of translation and rotation.

    Attributes
    ----------
    value : float
        Spearman's rho: 0 for free diffusion, positive where both are fast at the same times.
    stderr : float
        Standard error of the value where the two are independent.
    ci68, ci95 : tuple of float
        Confidence intervals, within -1 and 1.
    p : float
        Probability that independent steps have a rho of at least this size, two-sided.
    n_steps : int
        Number of steps, of all motions.
    variance_factor : float
        Factor by which intermittent motion raises the variance above that of independent steps.
    """

    value: float
    stderr: float
    ci68: tuple[float, float]
    ci95: tuple[float, float]
    p: float
    n_steps: int
    variance_factor: float

    @property
    def text(self) -> str:
        """One sentence: the correlation, its p and what it means."""
        found = f"rho = {with_error(self.value, self.stderr)}, p = {self.p:.2g}"
        tail = f"[{self.n_steps} steps]"
        if self.p >= 0.05:
            return f"no correlation of translation and rotation in time: {found} {tail}"
        how = "at the same times" if self.value > 0 else "at different times"
        return f"translation and rotation are fast {how}: {found} {tail}"

    def __str__(self) -> str:
        return self.text

    def to_dict(self) -> dict[str, Any]:
        """Return the correlation for JSON."""
        entry: dict[str, Any] = to_plain(asdict(self))
        return entry

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> Self:
        """Return the correlation that `to_dict` wrote.

        Parameters
        ----------
        entry : mapping
        """
        read: Self = _from_entry(cls, entry)
        return read


@dataclass(frozen=True, repr=False)
class CoefficientCorrelation(Shown):
    """Correlation of ln D_T and ln D_R over clusters.

    Attributes
    ----------
    value : float or None
        Correlation of the true coefficients: the measured one over `attenuation`. It may exceed 1
        by its error. None where the clusters differ too little to know it.
    stderr : float or None
        Standard error of the value, with that of the attenuation; None without a value.
    ci95 : tuple of float, or None
        95 % interval of the value; None without a value.
    measured : float
        Correlation of the estimates, lowered by their errors.
    measured_stderr : float
        Its standard error.
    p : float
        Probability that independent coefficients have a measured correlation of at least this
        size, two-sided.
    attenuation : float or None
        Factor by which the errors of the estimates lower the correlation; None without a value.
    spread_T, spread_R : float
        Standard deviation of ln D_T and ln D_R between clusters, without the errors of the
        estimates; 0 where the errors explain all of it.
    n_clusters : int
        Number of clusters.
    reason : str
        Why there is no value, or a remark on it; empty where there is none.
    """

    value: float | None
    stderr: float | None
    ci95: tuple[float, float] | None
    measured: float
    measured_stderr: float
    p: float
    attenuation: float | None
    spread_T: float
    spread_R: float
    n_clusters: int
    reason: str

    @property
    def text(self) -> str:
        """One sentence: the correlation and its p, or why it is not known."""
        found = f"measured {with_error(self.measured, self.measured_stderr)}, p = {self.p:.2g}"
        tail = f"[{self.n_clusters} clusters]"
        if self.value is None or self.stderr is None:
            return f"correlation of ln D_T and ln D_R not known ({self.reason}): {found} {tail}"
        more = f"; {self.reason}" if self.reason else ""
        shown = with_error(self.value, self.stderr)
        return f"correlation of ln D_T and ln D_R = {shown}: {found}{more} {tail}"

    def __str__(self) -> str:
        return self.text

    def to_dict(self) -> dict[str, Any]:
        """Return the correlation for JSON."""
        entry: dict[str, Any] = to_plain(asdict(self))
        return entry

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> Self:
        """Return the correlation that `to_dict` wrote.

        Parameters
        ----------
        entry : mapping
        """
        read: Self = _from_entry(cls, entry)
        return read


@dataclass(frozen=True, repr=False)
class DecouplingRatio(Shown):
    """D_T/D_R of a cluster over that of the same body in a dilute simple fluid.

    Attributes
    ----------
    value : float
        The ratio: 1 where both obey the same viscosity, above 1 where rotation is slowed more.
    stderr : float
        Standard error of the value.
    ci68, ci95 : tuple of float
        Confidence intervals of a log-normal distribution.
    p : float
        Probability that a ratio of 1 is measured at least this far from 1, two-sided.
    dilute : float
        D_T/D_R of the dilute body, um^2.
    """

    value: float
    stderr: float
    ci68: tuple[float, float]
    ci95: tuple[float, float]
    p: float
    dilute: float

    @property
    def text(self) -> str:
        """One sentence: the ratio, its p and what it means."""
        found = f"{number_text(self.value, self.stderr)} times that of the dilute body"
        words = "no decoupling is found"
        if self.p < 0.05:
            slower = "rotation" if self.value > 1 else "translation"
            words = f"{slower} is slowed more"
        return f"D_T/D_R is {found}, p = {self.p:.2g}: {words}"

    def __str__(self) -> str:
        return self.text

    def __float__(self) -> float:
        return self.value

    def to_dict(self) -> dict[str, Any]:
        """Return the ratio for JSON."""
        entry: dict[str, Any] = to_plain(asdict(self))
        return entry

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> Self:
        """Return the ratio that `to_dict` wrote.

        Parameters
        ----------
        entry : mapping
        """
        read: Self = _from_entry(cls, entry)
        return read


def _from_entry(kind: type[Any], entry: Mapping[str, Any]) -> Any:  # noqa: ANN401 (any result)
    """Return the result of a type from its dictionary; pairs become tuples."""
    read = {field.name: entry[field.name] for field in fields(kind)}
    return kind(**{name: tuple(x) if isinstance(x, list) else x for name, x in read.items()})


def translation_rotation_correlation(
    motion: RigidMotion | Sequence[RigidMotion],
) -> MobilityCorrelation:
    """Return the correlation of translational and rotational mobility in time.

    Where the surroundings of a cluster change, both kinds of steps are long at the same times. The
    ranks of the squared prediction errors of both are correlated: a step less its prediction from
    the steps before, with the D and the noise fitted to each, in standard deviations.

    Parameters
    ----------
    motion : RigidMotion or sequence of RigidMotion
        Motion; of several motions the correlations are averaged, weighted by their steps.

    Returns
    -------
    MobilityCorrelation

    Raises
    ------
    TooFewFramesError
        If a motion has fewer than 20 steps.
    ValueError
        If a motion does not move or does not rotate.

    Notes
    -----
    Two series that are each intermittent, but independent of each other, have a rank correlation
    whose variance is 1/(N - 1) times 1 + 2 sum_l (1 - l/N) a_l b_l, a_l and b_l the
    autocorrelations of their ranks (Bartlett, J. R. Stat. Soc. 98, 536, 1935); the sum runs to 60
    steps, at most a quarter of all. Without the factor 22 to 25 % of independent pairs are called
    correlated at the 5 % level. A gap counts as one step.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(
    ...     Cluster.tetrahedron(1.5), D_R=5e-3, D_T=0.04, dt=0.7, n_frames=300, rng=3
    ... )
    >>> translation_rotation_correlation(truth).p > 0.05
    True
    """
    from scipy.special import erfc

    motions = [motion] if isinstance(motion, RigidMotion) else list(motion)
    pairs = zip(
        *(pooled_steps(motions, quantity) for quantity in ("translation", "rotation")), strict=True
    )
    rho, variance, count = [], [], []
    for number, both in enumerate(pairs):
        n = len(both[0].duration)
        if n < _LEAST_RANKED:
            raise TooFewFramesError(
                f"motion {number}: {n} steps; a rank correlation needs {_LEAST_RANKED}", n + 1
            )
        ranks = []
        for steps, name in zip(both, ("translation", "rotation"), strict=True):
            if not steps.vectors.any():
                raise ValueError(f"motion {number}: no {name}, so that there is no correlation")
            errors = prediction_errors(NoisySteps.of(steps, Noise()))
            rank = np.argsort(np.argsort(np.sum(errors**2, axis=1), kind="stable"))
            centred = rank - rank.mean()
            ranks.append(centred / np.sqrt(centred @ centred))
        a, b = ranks
        lags = np.arange(1, min(_MOST_RANK_LAGS, n // 4) + 1)
        both_kept = np.array([(a[:-k] @ a[k:]) * (b[:-k] @ b[k:]) for k in lags])
        factor = 1 + 2 * float((1 - lags / n) @ both_kept)
        rho.append(float(a @ b))
        variance.append(max(factor, 1 / n) / (n - 1))
        count.append(n)
    weight = np.array(count) / sum(count)
    value, stderr = float(weight @ rho), float(np.sqrt(weight**2 @ variance))
    plain = float(np.sqrt(weight**2 @ (1 / (np.array(count) - 1.0))))
    # Fisher's transform keeps the ends within -1 and 1.
    ci68, ci95 = (
        (float(np.tanh(np.arctanh(value) - reach)), float(np.tanh(np.arctanh(value) + reach)))
        for reach in (NORMAL[0.68] * stderr, NORMAL[0.95] * stderr)
    )
    p = float(erfc(abs(value) / stderr / np.sqrt(2)))
    return MobilityCorrelation(value, stderr, ci68, ci95, p, sum(count), (stderr / plain) ** 2)


def prediction_errors(track: NoisySteps) -> Floats:
    """Return each step less its prediction from the steps before it, in standard deviations.

    D and the noise are those of greatest likelihood. Under the model the errors are independent
    standard normal numbers, however the frames are spaced.

    Parameters
    ----------
    track : NoisySteps

    Returns
    -------
    ndarray, shape (S, c)

    Notes
    -----
    With the covariance C = L V L^T of the steps y of one axis, V diagonal, they are
    V^(-1/2) L^-1 y.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> from perrin.diffusion import steps_of
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=3)
    >>> errors = prediction_errors(NoisySteps.of(steps_of(truth, "rotation"), Noise()))
    >>> bool(abs(errors.std() - 1) < 0.05)
    True
    """
    from scipy.linalg import solve_banded
    from scipy.linalg.lapack import dpttrf

    best = Likelihood.of([track]).best()
    steps = track.steps
    diagonal, off_diagonal = covariance_bands(
        float(best.D[0]),
        float(best.theta[0]),
        steps.duration[:, None],
        steps.linked[:, None],
        blur=track.blur,
        weight=track.weight,
        known=track.known,
    )
    errors = np.empty_like(steps.vectors)
    for axis, y in enumerate(steps.vectors.T):
        pivots, lower, singular = dpttrf(diagonal[:, axis], off_diagonal[:, axis])
        if singular:  # only where the noise estimate lies on the edge of its range
            errors[:, axis] = y / np.sqrt(diagonal[:, axis])
            continue
        bands = np.stack([np.ones_like(pivots), np.append(lower, 0.0)])
        errors[:, axis] = solve_banded((1, 0), bands, y) / np.sqrt(pivots)
    return errors


def diffusion_correlation(
    D_T: Sequence[DiffusionEstimate], D_R: Sequence[DiffusionEstimate]
) -> CoefficientCorrelation:
    """Return the correlation of ln D_T and ln D_R over clusters, corrected for their errors.

    Errors of the estimates lower a correlation by (V_T V_R)^(1/2), V = v/(v + e^2) with the
    variance v of ln D between clusters and the mean squared relative error e^2 of D (attenuation,
    Spearman 1904). The measured correlation is divided by it where v is above e^2 for both;
    elsewhere the quotient is noise. The errors of D_T at the centroid and of D_R are independent.

    Parameters
    ----------
    D_T, D_R : sequence of DiffusionEstimate
        Estimates of translation and rotation of the same clusters, in the same order; 30 or more
        are advised. Test first whether the clusters differ at all (`DiffusionEstimate.p_same`).

    Returns
    -------
    CoefficientCorrelation

    Raises
    ------
    ValueError
        If the lists differ in length or have fewer than 4 estimates, or an estimate is of the
        other quantity or has no positive value and finite error.

    Examples
    --------
    >>> from perrin import Cluster, estimate_diffusion, simulate_motion
    >>> bodies = [
    ...     simulate_motion(
    ...         Cluster.tetrahedron(1.5), D_R=D, D_T=8 * D, dt=1.0, n_frames=200, rng=number
    ...     )
    ...     for number, D in enumerate([1e-3, 2e-3, 4e-3, 8e-3, 16e-3])
    ... ]
    >>> found = diffusion_correlation(
    ...     [estimate_diffusion(body, quantity="translation") for body in bodies],
    ...     [estimate_diffusion(body, quantity="rotation") for body in bodies],
    ... )
    >>> found.value is not None and found.value > 0.95
    True
    """
    from scipy.special import stdtr

    n = len(D_T)
    faults = []
    if n != len(D_R) or n < 4:
        faults.append(
            "D_T, D_R: expected lists of the same length, 4 clusters or more, got "
            f"{n} and {len(D_R)}"
        )
    for name, unit, estimates in (
        ("D_T", UNITS["translation"], D_T),
        ("D_R", UNITS["rotation"], D_R),
    ):
        faults += [
            f"{name}[{i}]: expected a positive value ({unit}) with a finite error, got {one}; "
            "leave the cluster out of both lists"
            for i, one in enumerate(estimates)
            if not (one.unit == unit and one.value > 0 and 0 < one.stderr < np.inf)
        ]
    refuse(faults)
    total, error = np.empty(2), np.empty(2)
    logs = np.empty((2, n))
    for row, estimates in enumerate((D_T, D_R)):
        logs[row] = np.log([one.value for one in estimates])
        error[row] = sum((one.stderr / one.value) ** 2 for one in estimates) / n
        total[row] = logs[row].var(ddof=1)
    spread = total - error
    apart = logs - logs.mean(axis=1, keepdims=True)
    measured = float(apart[0] @ apart[1] / np.sqrt(np.prod(total)) / (n - 1))
    measured_stderr = float((1 - measured**2) / np.sqrt(n - 1))
    t = measured * np.sqrt((n - 2) / max(1 - measured**2, 1e-300))
    known: tuple[float | None, float | None, tuple[float, float] | None, float | None]
    known, reason = (None, None, None, None), ""
    flat = [name for name, v, e in zip(("D_T", "D_R"), spread, error, strict=True) if v <= e]
    if flat:
        reason = f"the errors of {' and '.join(flat)} are as large as the spread between clusters"
    else:
        attenuation = float(np.sqrt(np.prod(spread / total)))
        value = measured / attenuation
        # The variances of ln D have the relative error (2/(n - 1))^(1/2).
        of_spread = 0.5 * np.sqrt(2 / (n - 1)) * float(np.linalg.norm(error / spread))
        stderr = float(np.hypot(measured_stderr / attenuation, value * of_spread))
        inside = np.clip(measured, -1 + 1e-12, 1 - 1e-12)
        wider = stderr * attenuation / max(measured_stderr, 1e-300)
        low, high = (
            value + wider * (np.tanh(np.arctanh(inside) + z / np.sqrt(n - 3)) / attenuation - value)
            for z in (-NORMAL[0.95], NORMAL[0.95])
        )
        known = value, stderr, (float(low), float(high)), attenuation
        if n < _FEW_CLUSTERS:
            reason = f"fewer than {_FEW_CLUSTERS} clusters"
    value_, stderr_, ci95, attenuation_ = known
    return CoefficientCorrelation(
        value=value_,
        stderr=stderr_,
        ci95=ci95,
        measured=measured,
        measured_stderr=measured_stderr,
        p=float(2 * stdtr(n - 2, -abs(t))),
        attenuation=attenuation_,
        spread_T=float(np.sqrt(max(spread[0], 0.0))),
        spread_R=float(np.sqrt(max(spread[1], 0.0))),
        n_clusters=n,
        reason=reason,
    )


def decoupling_ratio(
    D_T: DiffusionEstimate | LongTimeEstimate,
    D_R: DiffusionEstimate | LongTimeEstimate,
    *,
    mobility: Mobility,
) -> DecouplingRatio:
    """Return D_T/D_R over that of the same body in a dilute simple fluid.

    In a simple fluid D_T/D_R depends on the shape alone: viscosity and temperature cancel. Near a
    glass transition rotation and translation may be slowed unequally.

    Parameters
    ----------
    D_T, D_R : DiffusionEstimate or LongTimeEstimate
        Measured coefficients of one cluster or of pooled clusters, means over the axes.
    mobility : Mobility
        Prediction of `cluster_mobility` for the body, at any viscosity and temperature.

    Returns
    -------
    DecouplingRatio

    Raises
    ------
    ValueError
        If a coefficient is of the other quantity or has no positive value and finite error.

    Notes
    -----
    The errors of D_T and D_R are independent at the centroid, so that their relative errors add in
    squares; ln(D_T/D_R) is taken as normal. The dilute values are thirds of the traces of the
    tensors about the centre of diffusion.

    Examples
    --------
    >>> from perrin import Cluster, cluster_mobility, estimate_diffusion, simulate_motion
    >>> body = cluster_mobility(
    ...     Cluster.touching(4, 2.45), radius=1.225, viscosity=2.18e-3, temperature=295
    ... )
    >>> motion = simulate_motion(body, dt=0.7, n_frames=900, rng=1)
    >>> D_T, D_R = (estimate_diffusion(motion, quantity=q) for q in ("translation", "rotation"))
    >>> ratio = decoupling_ratio(D_T, D_R, mobility=body)
    >>> ratio.ci95[0] < 1 < ratio.ci95[1]
    True
    """
    from scipy.special import erfc

    refuse(
        f"{name}: expected a positive value ({unit}) with a finite error, got {one}"
        for name, unit, one in (("D_T", UNITS["translation"], D_T), ("D_R", UNITS["rotation"], D_R))
        if not (one.unit == unit and one.value > 0 and 0 <= one.stderr < np.inf)
    )
    dilute = float(np.trace(mobility.D_T) / np.trace(mobility.D_R))
    value = D_T.value / D_R.value / dilute
    relative = float(np.hypot(D_T.stderr / D_T.value, D_R.stderr / D_R.value))
    ci68, ci95 = (
        (float(value * np.exp(-z * relative)), float(value * np.exp(z * relative)))
        for z in (NORMAL[0.68], NORMAL[0.95])
    )
    apart = abs(np.log(value)) / relative if relative > 0 else np.inf
    p = float(erfc(apart / np.sqrt(2)))
    return DecouplingRatio(value, value * relative, ci68, ci95, p, dilute)
