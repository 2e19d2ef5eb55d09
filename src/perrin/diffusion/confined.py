"""Confined motion: relaxation time, size of the cage and short-time D, with their intervals."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from perrin._arrays import to_plain
from perrin._display import Shown
from perrin._text import interval_text, with_error
from perrin.diffusion.estimate import NORMAL, UNITS
from perrin.diffusion.spectral_likelihood import ShapeLikelihood, motions_and_noise
from perrin.diffusion.step_spectra import confined_mean_square
from perrin.diffusion.steps import (
    Quantity,
    orientation_about_mean,
    principal_steps_of_each,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from perrin._arrays import Floats
    from perrin.diffusion.noise_model import Noise
    from perrin.diffusion.spectral_likelihood import ShapePoint
    from perrin.motion.rigid_motion import RigidMotion

# Trial rates: from this share of one over the length of the track to this rate per frame, in about
# this distance of their logarithms.
_LEAST_LENGTHS, _MOST_RATE, _LOG_DISTANCE = 0.05, 10.0, 1.2

# A rate of this over the length of the track is free diffusion.
_NO_RATE = 1e-9

# Relaxation times that a track must last for a closed interval of the cage.
_LEAST_RELAXATIONS = 6.0

# Up to this rms angle about the mean orientation, rad, rotation vectors are taken from it: cages
# come back within 5 %, with added body steps 43 % too large at 0.5 rad and 86 % at 0.7 rad.
_SMALL_CAGE = 0.7


@dataclass(frozen=True, repr=False)
class ConfinedEstimate(Shown):
    """Motion in a harmonic well (Ornstein-Uhlenbeck process) fitted to steps.

    A cage that relaxes within about one frame (relaxation time under dt) adds white noise to the
    positions: it is then part of the noise offset, and only noise from the residuals tells both
    apart.

    Attributes
    ----------
    relaxation_time : float
        Time in which the mean place decays to the centre by a factor e, s; inf for free diffusion.
    relaxation_time_ci68, relaxation_time_ci95 : tuple of float
        Confidence intervals, s; an end that the data do not bound is 0 or inf.
    cage, cage_ci68, cage_ci95 : float, tuple of float
        Rms distance from the centre along one axis, rad or um, and its intervals; the upper end is
        inf where the track is shorter than six relaxation times or free diffusion is not excluded.
    D_short, D_short_ci68, D_short_ci95 : float, tuple of float
        Diffusion coefficient at times well below the relaxation time, mean over axes, in `unit`,
        and its intervals. The long-time coefficient is 0.
    offset : float
        Variance of one orientation (rad^2) or centre coordinate (um^2) from noise, mean over axes;
        negative where motion blur outweighs the noise.
    unit : str
        Unit of D_short: "rad^2/s" or "um^2/s".
    n_frames : int
        Frames with a pose, of all motions.
    n_axes : int
        Axes: 3 for rotation and translation in space, 1 and 2 in the plane.
    dt : float
        Time between frames, s.
    quantity : {"rotation", "translation"}
    frame : {"mean", "body", "lab"}
        Rotation: vectors from the mean orientation ("mean") where they show a cage, else body steps
        ("body"). Translation: "lab".
    noise : "joint", "residual" or float
        Model of the noise: fitted, from the residuals of the rigid fits, or the known localisation
        error, um.
    exposure : float or None
        Open fraction of dt as stated; None for unknown.
    log_likelihood_gain : float
        Maximum of the log-likelihood less that of Brownian motion with the same noise, >= 0.
    method : str
        "mle".
    warnings : tuple of str
        Conditions of the estimate that are not fulfilled.
    """

    relaxation_time: float
    relaxation_time_ci68: tuple[float, float]
    relaxation_time_ci95: tuple[float, float]
    cage: float
    cage_ci68: tuple[float, float]
    cage_ci95: tuple[float, float]
    D_short: float
    D_short_ci68: tuple[float, float]
    D_short_ci95: tuple[float, float]
    offset: float
    unit: str
    n_frames: int
    n_axes: int
    dt: float
    quantity: Quantity
    frame: Literal["mean", "body", "lab"]
    noise: Literal["joint", "residual"] | float
    exposure: float | None
    log_likelihood_gain: float
    method: str = "mle"
    warnings: tuple[str, ...] = ()

    @property
    def resolved(self) -> bool:
        """Whether the 95 % interval of the cage is closed; if not, its lower end is a limit."""
        return bool(np.isfinite(self.cage_ci95[1]))

    def to_dict(self) -> dict[str, Any]:
        """Return the estimate for JSON; a number that is not finite is None."""
        entry: dict[str, Any] = to_plain(asdict(self))
        return entry

    @classmethod
    def from_dict(cls, entry: dict[str, Any]) -> ConfinedEstimate:
        """Return the estimate that `to_dict` wrote."""
        read = dict(entry) | {"warnings": tuple(entry["warnings"])}
        for name, value in entry.items():
            if name in ("relaxation_time", "cage") and value is None:
                read[name] = np.inf
            elif "_ci" in name:
                read[name] = tuple(np.inf if end is None else end for end in value)
        return cls(**read)

    def __str__(self) -> str:
        length = self.unit.partition("^")[0]
        tail = f"[{self.n_frames} frames]"
        if not self.resolved:
            return f"cage, if any, larger than {self.cage_ci95[0]:.2g} {length} {tail}, 95 % limit"
        half = [0.5 * (high - low) for low, high in (self.cage_ci68, self.D_short_ci68)]
        return (
            f"cage = {with_error(self.cage, half[0])} {length}, relaxation time "
            f"{interval_text(self.relaxation_time_ci68)} s, short-time D = "
            f"{with_error(self.D_short, half[1])} {self.unit} {tail}"
        )


def fit_confined(
    motion: RigidMotion | Sequence[RigidMotion],
    *,
    quantity: Quantity = "rotation",
    noise: Literal["joint", "residual"] | float | Noise = "joint",
    exposure: float | None = None,
) -> ConfinedEstimate:
    """Fit motion in a harmonic well, an Ornstein-Uhlenbeck process, to a motion.

    Parameters
    ----------
    motion : RigidMotion or sequence of RigidMotion
        Motion; several motions share one relaxation time, and each has its own D and noise.
    quantity : {"rotation", "translation"}
    noise : {"joint", "residual"}, float or Noise
        "joint" fits the noise along with the relaxation time. "residual" takes it from the
        rigid-fit residuals, right if all particles of a frame are recorded at the same instant. A
        number is the localisation error sigma, um (rms over axes).
    exposure : float, optional
        Open fraction of dt, 0 to 1. Unknown (None) leaves the joint offset free, negative too, as
        motion blur makes it; with the noise given it is taken as 0.

    Returns
    -------
    ConfinedEstimate

    Raises
    ------
    TooFewFramesError
        If there are fewer than two steps.
    ValueError
        For unknown or inconsistent choices, all in one message; for a body that does not move.

    Notes
    -----
    Along each axis the place relaxes at a rate k to a centre, with variance D/k and mean square
    displacement 2 D (1 - exp(-k t))/k (Uhlenbeck and Ornstein 1930). The likelihood of the sine
    modes of the steps is maximised over k, and over D and the noise of each axis. A cage is found
    where the track lasts about six relaxation times or more. A rotation is taken as the vector from
    the mean orientation where its rms is under 0.7 rad along each axis and a cage is found.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=3)
    >>> fit_confined(truth).resolved
    False
    """
    motions, settings = motions_and_noise(motion, quantity, noise, exposure)
    return confined_estimate(find_cage(motions, quantity, settings), motions)


class CagePeak(NamedTuple):
    """The most likely relaxation rate of some motions, before its intervals.

    Attributes
    ----------
    likelihood : ShapeLikelihood
        Likelihood of the logarithm of the rate, per frame time.
    best : ShapePoint
        Its maximum; that of free diffusion where no cage is likelier.
    points : list of ShapePoint
        Trial rates.
    free : ShapePoint
        Free diffusion.
    quantity : {"rotation", "translation"}
    frame : {"mean", "body", "lab"}
        Attribute `frame` of the estimate.
    settings : Noise
    """

    likelihood: ShapeLikelihood
    best: ShapePoint
    points: list[ShapePoint]
    free: ShapePoint
    quantity: Quantity
    frame: Literal["mean", "body", "lab"]
    settings: Noise

    @property
    def gain(self) -> float:
        """Logarithm of the likelihood at the maximum over that of free diffusion."""
        return max(self.best.value - self.free.value, 0.0)

    @property
    def seen(self) -> bool:
        """Whether the track is long enough to show the relaxation."""
        return bool(self.likelihood.n_steps * np.exp(self.best.shape) >= _LEAST_RELAXATIONS)


def find_cage(motions: Sequence[RigidMotion], quantity: Quantity, settings: Noise) -> CagePeak:
    """Return the most likely relaxation rate, in the frame that `fit_confined` takes.

    Parameters
    ----------
    motions : sequence of RigidMotion
    quantity : {"rotation", "translation"}
    settings : Noise

    Returns
    -------
    CagePeak

    Examples
    --------
    >>> from perrin import Cluster, Noise, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=3)
    >>> find_cage([truth], "rotation", Noise()).frame
    'body'
    """
    if quantity == "translation":
        return find_cage_in(motions, quantity, settings, frame="lab")
    if motions[0].dimension == 3:
        rms = [np.sqrt(np.nanmean(orientation_about_mean(m) ** 2)) for m in motions]
        if max(rms) <= _SMALL_CAGE:
            peak = find_cage_in(motions, quantity, settings, frame="mean")
            if peak.seen and confined_estimate(peak, motions).resolved:
                return peak
    return find_cage_in(motions, quantity, settings, frame="body")


def find_cage_in(
    motions: Sequence[RigidMotion],
    quantity: Quantity,
    settings: Noise,
    *,
    frame: Literal["mean", "body", "lab"],
) -> CagePeak:
    """Return the most likely relaxation rate of steps in one frame.

    Parameters
    ----------
    motions : sequence of RigidMotion
    quantity : {"rotation", "translation"}
    settings : Noise
    frame : {"mean", "body", "lab"}
        Attribute `frame` of the estimate.

    Returns
    -------
    CagePeak

    Examples
    --------
    >>> from perrin import Cluster, Noise, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=3)
    >>> find_cage_in([truth], "rotation", Noise(), frame="mean").gain < 3
    True
    """

    def mean_square(lag: Floats, shape: Floats | float) -> Floats:
        return confined_mean_square(lag, np.exp(shape), exposure=settings.exposure or 0.0)

    about: Literal["body", "mean"] = "mean" if frame == "mean" else "body"
    tracks = principal_steps_of_each(motions, quantity, frame=about)
    likelihood = ShapeLikelihood.of(tracks, settings, mean_square)
    slowest, fastest = np.log(_LEAST_LENGTHS / likelihood.longest), np.log(_MOST_RATE)
    count = 1 + int(np.ceil((fastest - slowest) / _LOG_DISTANCE))
    best, points = likelihood.best(np.linspace(slowest, fastest, count))
    free = likelihood.at(float(np.log(_NO_RATE / likelihood.longest)))
    best = best if best.value > free.value else free
    return CagePeak(likelihood, best, points, free, quantity, frame, settings)


def confined_estimate(peak: CagePeak, motions: Sequence[RigidMotion]) -> ConfinedEstimate:
    """Return the estimate with its intervals from the most likely relaxation rate.

    Examples
    --------
    >>> from perrin import Cluster, Noise, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=3)
    >>> confined_estimate(find_cage([truth], "rotation", Noise()), [truth]).resolved
    False
    """
    likelihood, best, points, free, quantity, frame, settings = peak
    intervals = likelihood.intervals(best, points)
    caged, free = best is not free, free._replace(shape=-np.inf)
    best = best if caged else free
    dt = float(np.mean([m.dt for m in motions]))
    rate = float(np.exp(best.shape))
    seen = caged and peak.seen
    times, cages, coefficients = {}, {}, {}
    for level, (low, high) in intervals.items():
        low = low if seen and low else free
        times[level] = (
            dt * float(np.exp(-high.shape)) if high else 0.0,
            dt * float(np.exp(-low.shape)),
        )
        half = NORMAL[level] * np.sqrt(best.variance)
        last = high or points[-1]
        cages[level] = _joined(
            (cage_size(last) if high else 0.0, cage_size(best), cage_size(low)), 0.5 * half
        )
        along = sorted(point.D for point in (low, best, last))
        coefficients[level] = _joined((along[0] / dt, best.D / dt, along[2] / dt), half)
    limits = []
    if rate >= 1:
        limits.append(
            f"relaxation time {dt / rate:.2g} s under the frame time: the cage cannot be "
            'distinguished from noise; state the noise (noise="residual" or a number)'
        )
    turning = quantity == "rotation" and motions[0].dimension == 3
    if turning and seen and cage_size(best) > _SMALL_CAGE:
        limits.append(
            f"cage wider than {_SMALL_CAGE} rad: rotation vectors do not add up in it, and the "
            "relaxation time and the cage are not those of the body"
        )
    return ConfinedEstimate(
        relaxation_time=dt / rate if rate else np.inf,
        relaxation_time_ci68=times[0.68],
        relaxation_time_ci95=times[0.95],
        cage=cage_size(best),
        cage_ci68=cages[0.68],
        cage_ci95=cages[0.95],
        D_short=best.D / dt,
        D_short_ci68=coefficients[0.68],
        D_short_ci95=coefficients[0.95],
        offset=best.offset,
        unit=UNITS[quantity],
        n_frames=sum(m.fitted.size for m in motions),
        n_axes=likelihood.n_axes,
        dt=dt,
        quantity=quantity,
        frame=frame,
        noise=settings.model,
        exposure=settings.exposure,
        log_likelihood_gain=peak.gain,
        warnings=tuple(limits),
    )


def cage_size(point: ShapePoint) -> float:
    """Return the rms distance from the centre along one axis, sqrt(D/rate); inf without a cage.

    Examples
    --------
    >>> from perrin.diffusion import ShapePoint
    >>> round(cage_size(ShapePoint(np.log(0.5), 0.0, 0.0, 0.02, 0.1, 0.0)), 6)
    0.2
    """
    return float(np.sqrt(point.D) * np.exp(-0.5 * point.shape))


def _joined(ends: tuple[float, float, float], half_width: float) -> tuple[float, float]:
    """Return an interval of a positive number from two independent sources of error.

    `ends` are the lower end, the value and the upper end from the first, `half_width` that of the
    logarithm from the second; they add in quadrature on each side.
    """
    low, value, high = ends
    below = np.hypot(np.log(value / low), half_width) if 0 < low < value < np.inf else half_width
    above = np.hypot(np.log(high / value), half_width) if value < high < np.inf else half_width
    with np.errstate(over="ignore"):
        return (
            float((value if np.isfinite(value) else low) * np.exp(-below)) if low > 0 else 0.0,
            float(value * np.exp(above)) if np.isfinite(high) else np.inf,
        )
