"""Fractional Brownian motion: the exponent of the mean square displacement, with its error."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from perrin._arrays import to_plain
from perrin._display import Shown
from perrin._text import with_error
from perrin.diffusion.spectral_likelihood import ShapeLikelihood, ShapePoint, motions_and_noise
from perrin.diffusion.step_spectra import fractional_mean_square
from perrin.diffusion.steps import Quantity, principal_steps_of_each

if TYPE_CHECKING:
    from collections.abc import Sequence

    from perrin._arrays import Floats
    from perrin.diffusion.noise_model import Noise
    from perrin.motion.rigid_motion import RigidMotion

# Trial exponents; their distance is below the width of a maximum.
_EXPONENTS = np.linspace(0.02, 1.98, 9)

# Above this rms turn of one axis per frame, rad, memory in the lab and in the body are different.
_SMALL_TURN = 0.1


@dataclass(frozen=True, repr=False)
class AnomalousEstimate(Shown):
    """Fractional Brownian motion fitted to steps: mean square displacement 2 d D_alpha t^alpha.

    Attributes
    ----------
    alpha : float
        Exponent: 1 for diffusion, below 1 for subdiffusion, above 1 for superdiffusion.
    ci68, ci95 : tuple of float
        Confidence intervals of alpha; an end that the data do not bound is 0 or 2.
    stderr : float
        Half the width of the 68 % interval.
    D_alpha, D_alpha_stderr : float
        Generalised diffusion coefficient, mean over the d axes, in `unit`, and its standard error.
        It is the displacement at 1 s, which may be far from the times of the data, and is then
        strongly correlated with alpha.
    best_lag : float
        Time at which the mean square displacement has the least relative error, s; one frame time
        to the length of the track.
    msd_at_best_lag, msd_at_best_lag_stderr : float
        Mean square displacement of all d axes over that time, rad^2 or um^2, and its standard
        error.
    offset : float
        Variance of one orientation (rad^2) or centre coordinate (um^2) from noise, mean over axes;
        negative where motion blur outweighs the noise.
    unit : str
        Unit of D_alpha: "rad^2/s^alpha" or "um^2/s^alpha".
    n_frames : int
        Frames with a pose, of all motions.
    n_axes : int
        Axes d: 3 for rotation and translation in space, 1 and 2 in the plane.
    dt : float
        Time between frames, s.
    quantity : {"rotation", "translation"}
    frame : {"body", "lab"}
        Axes in which the steps are stationary: those of the body or of the lab. They give the same
        for turns under 0.1 rad a frame; the likelier is taken for larger ones.
    noise : "joint", "residual" or float
        Model of the noise: fitted, from the residuals of the rigid fits, or the known localisation
        error, um.
    exposure : float or None
        Open fraction of dt as stated; None for unknown.
    log_likelihood_gain : float
        Maximum of the log-likelihood less that of Brownian motion with the same noise, >= 0.
    method : str
        "mle".
    """

    alpha: float
    stderr: float
    ci68: tuple[float, float]
    ci95: tuple[float, float]
    D_alpha: float
    D_alpha_stderr: float
    best_lag: float
    msd_at_best_lag: float
    msd_at_best_lag_stderr: float
    offset: float
    unit: str
    n_frames: int
    n_axes: int
    dt: float
    quantity: Quantity
    frame: Literal["body", "lab"]
    noise: Literal["joint", "residual"] | float
    exposure: float | None
    log_likelihood_gain: float
    method: str = "mle"

    def to_dict(self) -> dict[str, Any]:
        """Return the estimate for JSON; a number that is not finite is None."""
        entry: dict[str, Any] = to_plain(asdict(self))
        return entry

    @classmethod
    def from_dict(cls, entry: dict[str, Any]) -> AnomalousEstimate:
        """Return the estimate that `to_dict` wrote."""
        read = {
            name: np.inf if value is None and name != "exposure" else value
            for name, value in entry.items()
        }
        return cls(**read | {name: tuple(entry[name]) for name in ("ci68", "ci95")})

    def __str__(self) -> str:
        length = self.unit.partition("/")[0]
        tail = f"[{self.n_frames} frames]"
        if self.ci95 == (0.0, 2.0):
            return f"alpha: not bounded {tail}"
        msd = with_error(self.msd_at_best_lag, self.msd_at_best_lag_stderr)
        return (
            f"alpha = {with_error(self.alpha, self.stderr)}, MSD({self.best_lag:.3g} s) = {msd} "
            f"{length} {tail}"
        )


def fit_anomalous(
    motion: RigidMotion | Sequence[RigidMotion],
    *,
    quantity: Quantity = "rotation",
    noise: Literal["joint", "residual"] | float | Noise = "joint",
    exposure: float | None = None,
) -> AnomalousEstimate:
    """Fit fractional Brownian motion, mean square displacement 2 d D_alpha t^alpha, to a motion.

    Parameters
    ----------
    motion : RigidMotion or sequence of RigidMotion
        Motion; several motions share one alpha, and each has its own D and noise.
    quantity : {"rotation", "translation"}
    noise : {"joint", "residual"}, float or Noise
        "joint" fits the noise along with alpha. "residual" takes it from the rigid-fit residuals,
        which needs two to four times fewer frames for the same error, but is only right if all
        particles of a frame are recorded at the same instant and the exposure is stated. A number
        is the localisation error sigma, um (rms over axes).
    exposure : float, optional
        Open fraction of dt, 0 to 1. Unknown (None) leaves the joint offset free, negative too, as
        motion blur makes it; with the noise given it is taken as 0.

    Returns
    -------
    AnomalousEstimate

    Raises
    ------
    TooFewFramesError
        If there are fewer than two steps.
    ValueError
        For unknown or inconsistent choices, all in one message; for a body that does not move.

    Notes
    -----
    Along each axis the steps have covariance D V(alpha) + o E: V that of fractional Gaussian noise
    (Mandelbrot and Van Ness 1968), E that of differences of noise. Its diagonal in the sine
    modes of the steps is exact; the likelihood of the modes is maximised over alpha, and over D and
    o of each axis, o down to the limit at which a variance would reach 0. Intervals are those of
    the profile likelihood. Tracks with gaps have the exact likelihood of their longer steps.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=3)
    >>> found = fit_anomalous(truth)
    >>> found.ci95[0] < 1.0 < found.ci95[1]
    True
    """
    motions, settings = motions_and_noise(motion, quantity, noise, exposure)
    return anomalous_estimate(find_exponent(motions, quantity, settings), motions)


class ExponentPeak(NamedTuple):
    """The most likely exponent of some motions, before its intervals.

    Attributes
    ----------
    likelihood : ShapeLikelihood
        Likelihood of the exponent.
    best : ShapePoint
        Its maximum.
    points : list of ShapePoint
        Trial exponents.
    gain : float
        Logarithm of the likelihood at the maximum over that of Brownian motion.
    quantity : {"rotation", "translation"}
    frame : {"body", "lab"}
        Axes along which the steps remember each other.
    settings : Noise
    """

    likelihood: ShapeLikelihood
    best: ShapePoint
    points: list[ShapePoint]
    gain: float
    quantity: Quantity
    frame: Literal["body", "lab"]
    settings: Noise


def find_exponent(
    motions: Sequence[RigidMotion], quantity: Quantity, settings: Noise
) -> ExponentPeak:
    """Return the most likely exponent of fractional Brownian motion.

    Parameters
    ----------
    motions : sequence of RigidMotion
    quantity : {"rotation", "translation"}
    settings : Noise

    Returns
    -------
    ExponentPeak

    Examples
    --------
    >>> from perrin import Cluster, Noise, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=99, rng=3)
    >>> 0.5 < find_exponent([truth], "rotation", Noise()).best.shape < 1.5
    True
    """

    def mean_square(lag: Floats, shape: Floats | float) -> Floats:
        return fractional_mean_square(lag, shape, exposure=settings.exposure or 0.0)

    frames: list[Literal["body", "lab"]] = ["lab" if quantity == "translation" else "body"]
    tracks = [principal_steps_of_each(motions, quantity)]
    turns = max(float(np.sqrt(np.mean(s.vectors**2))) for s in tracks[0])
    if quantity == "rotation" and motions[0].dimension == 3 and turns > _SMALL_TURN:
        frames.append("lab")
        tracks.append(principal_steps_of_each(motions, quantity, frame="lab"))
    choices = [ShapeLikelihood.of(steps, settings, mean_square) for steps in tracks]
    found = [likelihood.best(_EXPONENTS) for likelihood in choices]
    brownian = max(likelihood.at(1.0).value for likelihood in choices)
    i = max(range(len(found)), key=lambda i: found[i][0].value)
    best, points = found[i]
    gain = max(best.value - brownian, 0.0)
    return ExponentPeak(choices[i], best, points, gain, quantity, frames[i], settings)


def anomalous_estimate(peak: ExponentPeak, motions: Sequence[RigidMotion]) -> AnomalousEstimate:
    """Return the estimate with its intervals from the most likely exponent of some motions.

    Examples
    --------
    >>> from perrin import Cluster, Noise, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=99, rng=3)
    >>> anomalous_estimate(find_exponent([truth], "rotation", Noise()), [truth]).n_frames
    99
    """
    likelihood, best, points, gain, quantity, frame, settings = peak
    ends = likelihood.intervals(best, points)
    ci68, ci95 = (
        (low.shape if low else 0.0, high.shape if high else 2.0)
        for low, high in (ends[0.68], ends[0.95])
    )
    stderr = 0.5 * (ci68[1] - ci68[0])
    # ln D changes by `bend` per unit of alpha: at a lag of exp(-bend) frames this has no effect.
    bend = likelihood.scale_slope(best, 0.01)
    log_lag = float(np.clip(-bend, 0.0, np.log(likelihood.longest)))
    log_error = float(np.sqrt(best.variance + ((bend + log_lag) * stderr) ** 2))
    dt = float(np.mean([m.dt for m in motions]))
    D_alpha = best.D / dt**best.shape
    n_axes = likelihood.n_axes
    msd = 2 * n_axes * best.D * float(np.exp(best.shape * log_lag))
    log_error_at_1_s = float(np.sqrt(best.variance + ((bend - np.log(dt)) * stderr) ** 2))
    return AnomalousEstimate(
        alpha=best.shape,
        stderr=stderr,
        ci68=ci68,
        ci95=ci95,
        D_alpha=D_alpha,
        D_alpha_stderr=D_alpha * log_error_at_1_s,
        best_lag=dt * float(np.exp(log_lag)),
        msd_at_best_lag=msd,
        msd_at_best_lag_stderr=msd * log_error,
        offset=best.offset,
        unit="rad^2/s^alpha" if quantity == "rotation" else "um^2/s^alpha",
        n_frames=sum(m.fitted.size for m in motions),
        n_axes=n_axes,
        dt=dt,
        quantity=quantity,
        frame=frame,
        noise=settings.model,
        exposure=settings.exposure,
        log_likelihood_gain=gain,
    )
