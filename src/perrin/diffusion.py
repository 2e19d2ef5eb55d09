"""How fast it diffuses: D_R and D_T from the steps of one motion or of many."""

from __future__ import annotations

import warnings as python_warnings
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from perrin._arrays import PrecisionWarning, TooFewFramesError
from perrin.likelihood import Likelihood, Peak, Track
from perrin.moments import Moments, covariance_estimate, trace_estimate
from perrin.motion import RigidMotion
from perrin.scatter import excess_scatter
from perrin.steps import Quantity, Steps, choice_faults, steps_of

if TYPE_CHECKING:
    from collections.abc import Sequence

Method = Literal["mle", "cve", "trace"]
UNITS = {"rotation": "rad^2/s", "translation": "um^2/s"}
_CHI2 = {0.68: 0.9889, 0.95: 3.8415}  # quantiles of chi-squared with one degree of freedom
NORMAL = {0.68: 0.9945, 0.95: 1.9600}

# Below ten times its resolution floor a D_R is not resolved.
_RESOLVED = 10.0

# Where an estimate needs a word: angular step 4 D_R dt, signal-to-noise ratio, number of steps.
_COARSE, _NOISY, _FEW = 0.2, 0.2, 30
# In the plane angles add up exactly; only whole turns within a step (4 D_R dt = 2) go wrong.
_COARSE_IN_PLANE = 2.0


@dataclass(frozen=True)
class Found:
    """What an estimator found, before it is judged."""

    value: float
    ci68: tuple[float, float]
    ci95: tuple[float, float]
    offset: float
    offset_stderr: float
    drift: tuple[tuple[float, ...], ...] | None = None
    drift_stderr: tuple[tuple[float, ...], ...] | None = None
    p_same: float | None = None
    stderr: float | None = None  # half the width of ci68 unless given


@dataclass(frozen=True)
class DiffusionEstimate:
    """A diffusion coefficient with what it rests on.

    Attributes
    ----------
    value : float
        D_R in rad^2/s or D_T in um^2/s.
    ci68, ci95 : tuple of float
        Confidence intervals; an end that the data do not bound is 0 or inf.
    stderr : float
        Half the width of the 68 % interval.
    offset : float
        Variance of one orientation (rad^2) or centre coordinate (um^2) from noise, mean over axes;
        negative where motion blur outweighs the noise.
    offset_stderr : float
        Its standard error; NaN where it lies on the edge of what is possible.
    resolution_floor : float or None
        The D_R that a motionless cluster would read; None for D_T.
    resolved : bool
        Whether the value stands clear of that floor and of 0; if not, read it as an upper limit.
    unit, method : str
    n_frames : int
        Frames with a pose, of all motions.
    snr : float
        D dt/s, s the noise variance of one orientation or centre coordinate that the rigid-fit
        residuals predict (or the stated sigma); inf without noise, NaN where it is not known.
    dt : float
        Time between the frames that exist, s: the median step, mean over motions.
    noise : str
        How the noise was known: "joint", "residual", or the sigma in um.
    exposure : float or None
        The open fraction of dt as stated; None for unknown.
    drift, drift_stderr : tuple of tuple of float, or None
        Where it was left free, the mean velocity of every motion along x, y, z, um/s; for D_R the
        mean spin about the lab's x, y, z, rad/s (in the plane one number).
    p_same : float or None
        Pooled motions: how probable it is that equal coefficients scatter as much as these do
        (likelihood ratio); None for one motion and for other methods than "mle".
    warnings : tuple of str
        What should be known before the number is used.
    """

    value: float
    ci68: tuple[float, float]
    ci95: tuple[float, float]
    stderr: float
    offset: float
    offset_stderr: float
    resolution_floor: float | None
    resolved: bool
    unit: str
    method: str
    n_frames: int
    snr: float
    dt: float = np.nan
    noise: str = "joint"
    exposure: float | None = None
    drift: tuple[tuple[float, ...], ...] | None = None
    drift_stderr: tuple[tuple[float, ...], ...] | None = None
    p_same: float | None = None
    warnings: tuple[str, ...] = ()

    @classmethod
    def judged(
        cls,
        found: Found,
        *,
        quantity: Literal["rotation", "translation"],
        method: str,
        n_frames: int,
        dt: float,
        noise_variance: float,
        resolution_floor: float | None = None,
        noise: str = "joint",
        exposure: float | None = None,
        warnings: tuple[str, ...] = (),
    ) -> DiffusionEstimate:
        """Make an estimate of what an estimator found; the one place where snr and resolved arise.

        Parameters
        ----------
        found : Found
        quantity, method, n_frames, dt, resolution_floor, noise, exposure, warnings
            As in the attributes.
        noise_variance : float
            Of one orientation (rad^2) or centre coordinate (um^2); NaN where it is not known.
        """
        if np.isnan(noise_variance):
            snr = np.nan
        else:
            snr = found.value * dt / noise_variance if noise_variance > 0 else np.inf
        half_width = (found.ci68[1] - found.ci68[0]) / 2
        floor = _RESOLVED * (resolution_floor or 0.0)
        return cls(
            value=found.value,
            ci68=found.ci68,
            ci95=found.ci95,
            stderr=half_width if found.stderr is None else found.stderr,
            offset=found.offset,
            offset_stderr=found.offset_stderr,
            resolution_floor=resolution_floor,
            resolved=bool(found.ci95[0] > 0 and found.value > floor),
            unit=UNITS[quantity],
            method=method,
            n_frames=n_frames,
            snr=float(snr),
            dt=dt,
            noise=noise,
            exposure=exposure,
            drift=found.drift,
            drift_stderr=found.drift_stderr,
            p_same=found.p_same,
            warnings=warnings,
        )

    @classmethod
    def absent(
        cls, *, quantity: Literal["rotation", "translation"], n_frames: int, reason: str
    ) -> DiffusionEstimate:
        """Return the estimate of a coefficient that the data cannot show, all numbers NaN."""
        nothing = (np.nan, np.nan)
        found = Found(np.nan, nothing, nothing, np.nan, np.nan)
        return cls.judged(
            found,
            quantity=quantity,
            method="none",
            n_frames=n_frames,
            dt=np.nan,
            noise_variance=np.nan,
            warnings=(reason,),
        )

    @property
    def absent_because(self) -> str | None:
        """Why the data cannot show the coefficient at all; None where there is a value."""
        return self.warnings[0].partition(":")[0] if np.isnan(self.value) else None

    def __str__(self) -> str:
        name = "D_R" if self.unit == UNITS["rotation"] else "D_T"
        if self.absent_because is not None:
            return f"{name}: none ({self.absent_because})"
        how = self.method if self.noise == "joint" else f"{self.method}, {self.noise} noise"
        taken = "mean spin" if name == "D_R" else "drift"
        how += f", {taken} removed" if self.drift else ""
        tail = f"{self.unit} [{how}, {self.n_frames} frames]"
        if not self.resolved and self.ci95[1] > 0:
            return f"{name} < {self.ci95[1]:.2g} {tail}, 95 % limit"
        return f"{name} = {with_error(self.value, self.stderr)} {tail}"

    def __float__(self) -> float:
        return self.value


def with_error(value: float, stderr: float) -> str:
    """Write a value with its standard error in the last digits: 0.0047(5).

    Examples
    --------
    >>> with_error(0.00471, 0.00052), with_error(38.5, 12.0), with_error(0.0385, 0.0019)
    ('0.0047(5)', '38(12)', '0.0385(19)')
    """
    if not (np.isfinite(stderr) and stderr > 0):
        return f"{value:.3g}"
    exponent = int(np.floor(np.log10(stderr)))
    # Two digits of an error below 20, one above: the last digit then says 5 to 50 %.
    digits = -exponent + (1 if round(stderr / 10**exponent, 1) < 2 else 0)
    shown = round(stderr * 10.0**digits)
    if digits <= 0:
        return f"{round(value, digits):.0f}({shown * 10**-digits})"
    return f"{value:.{digits}f}({shown})"


def estimate_diffusion(
    motion: RigidMotion | Sequence[RigidMotion],
    *,
    quantity: Quantity = "rotation",
    method: Method = "mle",
    noise: Literal["joint", "residual"] | float = "joint",
    exposure: float | None = None,
    drift: bool = False,
) -> DiffusionEstimate:
    """Estimate D_R or D_T from the steps of a motion, noise included.

    Parameters
    ----------
    motion : RigidMotion or sequence of RigidMotion
        Several are pooled: one D, each with its own noise.
    quantity : {"rotation", "translation"}
        D_R from body-frame rotation vectors, or D_T from the centre. For an anisotropic body the
        value is the mean over the three axes (trace/3), and the interval is that of the mean.
    method : {"mle", "cve", "trace"}
        Maximum likelihood (at the statistical limit); the covariance-based estimator in closed
        form, good at a signal-to-noise ratio above 1; or, for D_R, the mean cosine of the step
        angle, exact for coarse sampling (4 D_R dt > 0.2).
    noise : {"joint", "residual"} or float
        "joint" estimates the noise offset along with D. "residual" takes what the rigid-fit
        residuals say of it, up to three times fewer frames for the same error, but only right if
        all particles of a frame are seen at the same instant. A number is the localisation error
        sigma, um (rms over axes).
    exposure : float, optional
        Open fraction of dt, 0 to 1. Unknown (None) leaves the joint offset free, negative too, as
        motion blur makes it; with the noise given it is taken as 0.
    drift : bool
        Leave a mean velocity along each axis free (flow, sedimentation), for D_R a mean spin about
        each lab axis; the result states it. The likelihood is then the restricted one.

    Returns
    -------
    DiffusionEstimate
        With profile-likelihood intervals ("mle"), or the value's normal ones.

    Raises
    ------
    TooFewFramesError
        Fewer than 3 frames with a pose, or no step.
    ValueError
        For unknown or inconsistent choices, all in one message, or motions of 2 and 3 dimensions
        together.

    Warns
    -----
    PrecisionWarning
        4 D_R dt > 0.2 (rotation vectors read low), a signal-to-noise ratio under 0.2, fewer than
        30 steps.

    Notes
    -----
    Steps over a time t between frames k and k + 1 have variance 2 D t + o_k + o_{k+1} and
    neighbours covariance -o_{k+1}: a tridiagonal likelihood, linear in the number of frames, in
    which a gap is one longer step. o_k is the noise of the frame less b D, b = exposure dt/3. In
    the joint mode o_k = o + e_k; the offset o, one for each motion, is free above -D t/2, and e_k
    is by how much the noise predicted from the rigid-fit residuals exceeds that of the best known
    frame and axis (particles missing, a body with unequal axes). docs/theory/estimators.md tells
    which estimator fails when.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=3)
    >>> print(estimate_diffusion(truth))
    D_R = 0.0050(4) rad^2/s [mle, 300 frames]
    """
    motions = [motion] if isinstance(motion, RigidMotion) else list(motion)
    _check(motions, quantity=quantity, method=method, noise=noise, exposure=exposure, drift=drift)
    steps = [_steps(i if len(motions) > 1 else None, m, quantity) for i, m in enumerate(motions)]
    if method == "mle":
        tracks = [track_of(s, noise=noise, exposure=exposure, drift=drift) for s in steps]
        found = by_likelihood(tracks)
    elif method == "cve":
        found = _by_moments(
            covariance_estimate([track_of(s, noise=noise, exposure=exposure) for s in steps])
        )
    else:
        given = None if noise == "joint" else [_orientation_noise(s, noise) for s in steps]
        blur = (exposure or 0.0) * motions[0].dt / 3
        found = _by_moments(trace_estimate(motions, noise=given, blur=blur))
    return _judged(
        found, motions, steps, quantity=quantity, method=method, noise=noise, exposure=exposure
    )


def by_likelihood(tracks: Sequence[Track]) -> Found:
    """Maximise the likelihood; intervals from its profile, widened by unequal axes."""
    likelihood = Likelihood.of(tracks)
    if not likelihood.scale[0] > 0:
        return Found(0.0, (0.0, 0.0), (0.0, 0.0), 0.0, np.nan)
    best = likelihood.best()
    value = float(best.D[0])
    wider = excess_scatter(tracks, value, best.theta)
    ci68, ci95 = (likelihood.interval(best, wider * _CHI2[level]) for level in (0.68, 0.95))
    offsets, offset_stderr = likelihood.offsets(best)
    drift, drift_stderr = _steady(likelihood, best) if tracks[0].drift else (None, None)
    p_same = _probability_same(likelihood, best) if len(tracks) > 1 else None
    return Found(
        value, ci68, ci95, float(offsets.mean()), offset_stderr, drift, drift_stderr, p_same
    )


def _steady(likelihood: Likelihood, best: Peak) -> tuple[tuple[tuple[float, ...], ...], ...]:
    """Return the steady motion of every track and its standard errors."""
    mean, information = likelihood.steady_motion(best)
    errors = np.sqrt(np.diagonal(np.linalg.inv(information), axis1=1, axis2=2))
    return tuple(map(tuple, mean.tolist())), tuple(map(tuple, errors.tolist()))


def _probability_same(likelihood: Likelihood, best: Peak) -> float:
    """Return the p-value of equal D by the likelihood ratio."""
    from scipy.special import chdtrc

    gain = float(likelihood.apart().best().value.sum() - best.value[0])
    return float(chdtrc(len(likelihood.tracks) - 1, max(2 * gain, 0.0)))


def _by_moments(moments: Moments) -> Found:
    """Give a closed-form estimate its normal intervals."""
    value, stderr = moments.value, moments.stderr
    ci68, ci95 = (
        (float(value - z * stderr), float(value + z * stderr)) for z in (NORMAL[0.68], NORMAL[0.95])
    )
    return Found(float(value), ci68, ci95, moments.offset, moments.offset_stderr)


def track_of(
    steps: Steps, *, noise: str | float, exposure: float | None, drift: bool = False
) -> Track:
    """Return the steps with what is known of their noise; blur takes b D from its variance."""
    if noise == "joint":
        # An unknown exposure may blur up to the limit at which steps stop being possible at all.
        blur = steps.duration.min() / 2 if exposure is None else exposure * steps.dt / 3
        return Track.free(steps, blur=float(blur), drift=drift)
    blur = (exposure or 0.0) * steps.dt / 3
    if noise == "residual":
        return Track.informed(steps, blur=blur, drift=drift)
    return Track.fixed(steps, sigma=float(noise), blur=blur, drift=drift)


def _orientation_noise(steps: Steps, noise: str | float) -> float:
    sigma = steps.sigma if noise == "residual" else float(noise)
    return sigma**2 * steps.complete


def _judged(
    found: Found,
    motions: Sequence[RigidMotion],
    steps: Sequence[Steps],
    *,
    quantity: Quantity,
    method: str,
    noise: str | float,
    exposure: float | None,
) -> DiffusionEstimate:
    """Judge what was found: floor, resolution, signal-to-noise ratio, warnings."""
    floor = None
    if quantity == "rotation":
        floor = float(np.mean([m.resolution_floor for m in motions]))
    estimate = DiffusionEstimate.judged(
        found,
        quantity=quantity,
        method=method,
        n_frames=sum(m.fitted.size for m in motions),
        dt=float(np.mean([m.usual_interval for m in motions])),
        noise_variance=_spread(motions, steps, noise),
        resolution_floor=floor,
        noise=noise if isinstance(noise, str) else f"{noise:g} um",
        exposure=exposure,
    )
    limits = _limits(estimate, steps, quantity=quantity)
    for text in limits:
        python_warnings.warn(text, PrecisionWarning, stacklevel=3)
    return replace(estimate, warnings=limits)


def _spread(motions: Sequence[RigidMotion], steps: Sequence[Steps], noise: str | float) -> float:
    """Return the noise variance of one orientation or centre coordinate, mean over frames, axes."""
    squares = [float(np.mean(m.noise**2)) if isinstance(noise, str) else noise**2 for m in motions]
    means = [0.5 * float(np.mean(s.before) + np.mean(s.after)) for s in steps]
    return float(np.mean(np.multiply(squares, means)))


def _limits(
    estimate: DiffusionEstimate, steps: Sequence[Steps], *, quantity: str
) -> tuple[str, ...]:
    """State where the estimate leaves the conditions under which it is exact."""
    limits = []
    count = sum(len(s.duration) for s in steps)
    if count < _FEW:
        limits.append(f"{count} steps, fewer than {_FEW}: the interval is approximate")
    if estimate.snr < _NOISY:
        limits.append(
            f"signal-to-noise ratio {estimate.snr:.2g} under {_NOISY}: the noise is far larger "
            "than a step; sample less often"
        )
    if quantity == "rotation" and estimate.method != "trace":
        durations = np.concatenate([s.duration for s in steps])
        # A step counts as the square of the share of diffusion in its variance.
        snr = max(estimate.snr, 0.0) * durations / estimate.dt
        share = np.divide(snr, snr + 1, out=np.ones_like(snr), where=np.isfinite(snr))
        weight = share**2
        usual = float(np.average(durations, weights=weight)) if weight.any() else estimate.dt
        limits += _coarse(estimate.value * usual, planar=steps[0].size.shape[1] == 1)
    return tuple(limits)


def _coarse(step: float, *, planar: bool) -> list[str]:
    """Say where steps are so long that rotation vectors read low; `step` is D_R dt."""
    if planar:
        if 4 * step <= _COARSE_IN_PLANE:
            return []
        return [f"4 D_R dt = {4 * step:.2g} over {_COARSE_IN_PLANE}: whole turns between frames"]
    if 4 * step <= _COARSE:
        return []
    return [
        f"4 D_R dt = {4 * step:.2g} over {_COARSE}: rotation vectors between frames read D_R low "
        f'by about {100 * step / 6:.1f} %; method="trace" is exact at any step length'
    ]


def _steps(number: int | None, motion: RigidMotion, quantity: Quantity) -> Steps:
    try:
        return steps_of(motion, quantity)
    except TooFewFramesError as error:
        where = "" if number is None else f"motion {number}: "
        raise TooFewFramesError(f"{where}{error}", error.n_frames) from None


def _check(
    motions: Sequence[RigidMotion],
    *,
    quantity: str,
    method: str,
    noise: object,
    exposure: object,
    drift: bool,
) -> None:
    """Refuse what is not offered or does not go together, all in one message."""
    faults = choice_faults(quantity=quantity, noise=noise, exposure=exposure)
    if method not in get_args(Method):
        offered = " or ".join(map(repr, get_args(Method)))
        faults.append(f"method: expected {offered}, got {method!r}")
    if method == "trace" and quantity == "translation":
        faults.append('method="trace" is for quantity="rotation"')
    if drift and method != "mle":
        faults.append('drift=True needs method="mle"')
    if len({m.template.shape[1] for m in motions}) != 1:
        faults.append("motion: expected one or more motions, all in 2 or all in 3 dimensions")
    if faults:
        raise ValueError("; ".join(faults))
