"""How fast it diffuses: D_R and D_T from the steps of one motion or of many."""

from __future__ import annotations

import warnings as python_warnings
from dataclasses import replace
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from perrin.diffusion.estimate import _CHI2, NORMAL, DiffusionEstimate, Found
from perrin.diffusion.likelihood import Likelihood, Peak, excess_scatter
from perrin.diffusion.moments import Moments, covariance_estimate, trace_estimate
from perrin.diffusion.noise_model import choice_faults
from perrin.diffusion.step_kernels import Track
from perrin.diffusion.steps import Quantity, Steps, steps_of
from perrin.errors import PrecisionWarning, TooFewFramesError
from perrin.motion.rigid_motion import RigidMotion

if TYPE_CHECKING:
    from collections.abc import Sequence


Method = Literal["mle", "cve", "trace"]


# Where an estimate needs a word: angular step 4 D_R dt, signal-to-noise ratio, number of steps.
_COARSE, _NOISY, _FEW = 0.2, 0.2, 30


# In the plane angles add up exactly; only whole turns within a step (4 D_R dt = 2) go wrong.
_COARSE_IN_PLANE = 2.0


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
