"""Diffusion coefficients D_R and D_T from the steps of one motion or of several."""

from __future__ import annotations

import warnings as python_warnings
from dataclasses import replace
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from perrin._arrays import choice_fault, refuse
from perrin.diffusion.estimate import CHI2, DiffusionEstimate, Found
from perrin.diffusion.likelihood import Likelihood, excess_scatter, excess_scatter_of_each
from perrin.diffusion.moments import covariance_estimate, trace_estimate
from perrin.diffusion.noise_model import Noise, noise_faults
from perrin.diffusion.steps import (
    NoisySteps,
    Quantity,
    Steps,
    groups_alike,
    pooled_steps,
    steps_of_each,
)
from perrin.errors import PrecisionWarning, TooFewFramesError
from perrin.motion.rigid_motion import RigidMotion

if TYPE_CHECKING:
    from collections.abc import Sequence

    from perrin._arrays import Floats
    from perrin.diffusion.likelihood import ProfilePoint

Method = Literal["mle", "cve", "trace"]

# Beyond these an estimate warns: angular step 4 D_R dt, signal-to-noise ratio, number of steps. In
# the plane angles add up exactly; only whole turns within a step (4 D_R dt = 2) are lost.
_COARSE_STEP, _COARSE_STEP_IN_PLANE, _LOW_SNR, _FEW_STEPS = 0.2, 2.0, 0.2, 30

# Beyond this the mean of the square of rotation vectors, which end at pi, says little of D_R.
_LOST_TURNS = 1.0

# About this many steps are evaluated at once: more gain no time, and take memory.
_STEPS_TOGETHER = 60_000

_NO_MOTION = Found(0.0, (0.0, 0.0), (0.0, 0.0), 0.0, np.nan)


def estimate_diffusion(
    motion: RigidMotion | Sequence[RigidMotion],
    *,
    quantity: Quantity = "rotation",
    method: Method = "mle",
    noise: Literal["joint", "residual"] | float | Noise = "joint",
    exposure: float | None = None,
    drift: bool = False,
) -> DiffusionEstimate:
    """Estimate D_R or D_T from the steps of a motion, noise included.

    Parameters
    ----------
    motion : RigidMotion or sequence of RigidMotion
        Motion; several motions are pooled: they share one D, and each has its own noise.
    quantity : {"rotation", "translation"}
        D_R from body-frame rotation vectors, or D_T from the centre. For an anisotropic body the
        value is the mean over the three axes (trace/3), and the interval is that of the mean.
    method : {"mle", "cve", "trace"}
        Maximum likelihood (at the statistical limit); the covariance-based estimator in closed
        form, good at a signal-to-noise ratio above 1; or, for D_R, the mean cosine of the step
        angle, exact for coarse sampling (4 D_R dt > 0.2).
    noise : {"joint", "residual"}, float or Noise
        "joint" estimates the noise offset along with D. "residual" takes it from the rigid-fit
        residuals: up to three times fewer frames for the same error, but only right if all
        particles of a frame are recorded at the same instant. A number is the localisation error
        sigma, um (rms over axes). A `Noise` holds exposure and drift as well, which are then not
        stated by their own keywords.
    exposure : float, optional
        Open fraction of dt, 0 to 1. Unknown (None) leaves the joint offset free, negative too, as
        motion blur makes it; with the noise given it is taken as 0.
    drift : bool
        Leave a mean velocity along each axis free (flow, sedimentation), for D_R a mean spin about
        each lab axis; it is part of the result. The likelihood is then the restricted one.

    Returns
    -------
    DiffusionEstimate
        Estimate with profile-likelihood intervals ("mle"), or those of a normal distribution.

    Raises
    ------
    TooFewFramesError
        If there are fewer than 3 frames with a pose, or no step.
    ValueError
        For unknown or inconsistent choices, all in one message, or motions of 2 and 3 dimensions
        together.

    Warns
    -----
    PrecisionWarning
        If 4 D_R dt > 0.2 (D_R from rotation vectors is then too low), the signal-to-noise ratio is
        under 0.2, or there are fewer than 30 steps.

    Notes
    -----
    Steps over a time t between frames k and k + 1 have variance 2 D t + o_k + o_{k+1} and
    neighbours covariance -o_{k+1}: a tridiagonal likelihood, linear in the number of frames, in
    which a gap is one longer step. o_k is the noise of the frame less b D, b = exposure dt/3. In
    the joint mode o_k = o + e_k; the offset o, one for each motion, is free above -D t/2, and e_k
    is by how much the noise predicted from the rigid-fit residuals exceeds that of the best known
    frame and axis (particles missing, a body with unequal axes). docs/theory/estimators.md compares
    the conditions of the estimators.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=3)
    >>> print(estimate_diffusion(truth))
    D_R = 0.0050(4) rad^2/s [mle, 300 frames]
    """
    motions = [motion] if isinstance(motion, RigidMotion) else list(motion)
    stated_drift = noise.drift if isinstance(noise, Noise) else drift
    faults = [
        *choice_fault("quantity", quantity, get_args(Quantity)),
        *noise_faults(noise, exposure, drift=drift),
        *choice_fault("method", method, get_args(Method)),
    ]
    if method == "trace" and quantity == "translation":
        faults.append('method="trace" is for quantity="rotation"')
    if stated_drift and method != "mle":
        faults.append('drift=True needs method="mle"')
    if len({m.dimension for m in motions}) != 1:
        faults.append("motion: expected one or more motions, all in 2 or all in 3 dimensions")
    refuse(faults)
    settings = Noise.of(noise, exposure=exposure, drift=drift)
    steps = pooled_steps(motions, quantity)
    found = _found(motions, steps, method, settings)
    estimate = _judged(motions, steps, found, quantity=quantity, method=method, settings=settings)
    for text in estimate.warnings:
        python_warnings.warn(text, PrecisionWarning, stacklevel=2)
    return estimate


def estimate_each(
    motions: Sequence[RigidMotion], *, quantity: Quantity, noise: Noise
) -> list[DiffusionEstimate | TooFewFramesError]:
    """Estimate a D of its own for each motion, as `estimate_diffusion`, all of them together.

    Parameters
    ----------
    motions : sequence of RigidMotion
    quantity : {"rotation", "translation"}
    noise : Noise

    Returns
    -------
    list of DiffusionEstimate or TooFewFramesError
        The error that `estimate_diffusion` raises, where there is no estimate.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=3)
    >>> print(*estimate_each([truth, truth], quantity="rotation", noise=Noise()), sep="; ")
    D_R = 0.0050(4) rad^2/s [mle, 300 frames]; D_R = 0.0050(4) rad^2/s [mle, 300 frames]
    """
    steps = steps_of_each(motions, quantity)
    tracks = [NoisySteps.of(s, noise) for s in steps if isinstance(s, Steps)]
    found = iter(likelihood_of_each(tracks))
    return [
        s
        if isinstance(s, TooFewFramesError)
        else _judged([m], [s], next(found), quantity=quantity, method="mle", settings=noise)
        for m, s in zip(motions, steps, strict=True)
    ]


def estimate_pooled(
    motions: Sequence[RigidMotion],
    each: Sequence[DiffusionEstimate],
    *,
    quantity: Quantity,
    noise: Noise,
) -> DiffusionEstimate:
    """Estimate one D for several motions, as `estimate_diffusion`, from the D of each of them.

    Parameters
    ----------
    motions : sequence of RigidMotion
    each : sequence of DiffusionEstimate
        Estimate of every motion alone, with the same noise: the maxima that the test of a common D
        compares.
    quantity : {"rotation", "translation"}
    noise : Noise

    Returns
    -------
    DiffusionEstimate

    Raises
    ------
    TooFewFramesError
        As in `estimate_diffusion`.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> motions = [
    ...     simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=seed)
    ...     for seed in (3, 4)
    ... ]
    >>> each = estimate_each(motions, quantity="rotation", noise=Noise())
    >>> print(estimate_pooled(motions, each, quantity="rotation", noise=Noise()))
    D_R = 0.0054(3) rad^2/s [mle, 600 frames]
    """
    steps = pooled_steps(motions, quantity)
    tracks = [NoisySteps.of(s, noise) for s in steps]
    apart = 0.0
    for rows in together(tracks):
        some = [tracks[k] for k in rows]
        D = np.array([each[k].value for k in rows])
        theta = np.array([tracks[k].theta_at(each[k].value, each[k].offset) for k in rows])
        apart += float(Likelihood.of(some).apart().sums(D, theta).value.sum())
    found = by_likelihood(tracks, apart=apart)
    return _judged(motions, steps, found, quantity=quantity, method="mle", settings=noise)


def _judged(
    motions: Sequence[RigidMotion],
    steps: Sequence[Steps],
    found: Found,
    *,
    quantity: Quantity,
    method: Method,
    settings: Noise,
) -> DiffusionEstimate:
    """Return the estimate of some motions, with what limits its precision."""
    # The noise of one orientation or centre coordinate, mean over frames, axes and motions.
    model = settings.model
    squares = [
        float(m.noise @ m.noise) / len(m.noise) if isinstance(model, str) else model**2
        for m in motions
    ]
    means, count = [s.mean_variance for s in steps], len(motions)
    estimate = DiffusionEstimate.judged(
        found,
        quantity=quantity,
        method=method,
        n_frames=sum(m.fitted.size for m in motions),
        dt=sum(m.usual_interval for m in motions) / count,
        noise_variance=sum(a * b for a, b in zip(squares, means, strict=True)) / count,
        resolution_floor=sum(m.resolution_floor for m in motions) / count
        if quantity == "rotation"
        else None,
        noise=settings,
    )
    return replace(estimate, warnings=precision_limits(estimate, steps))


def _found(
    motions: Sequence[RigidMotion], steps: Sequence[Steps], method: Method, settings: Noise
) -> Found:
    """Return the value of one method with its intervals."""
    if method == "trace":
        blur = (settings.exposure or 0.0) * motions[0].dt / 3
        if settings.model == "joint":
            return Found.normal(*trace_estimate(motions, noise=None, blur=blur))
        sigma = [s.sigma if isinstance(settings.model, str) else settings.model for s in steps]
        given = [one**2 * s.complete for one, s in zip(sigma, steps, strict=True)]
        return Found.normal(*trace_estimate(motions, noise=given, blur=blur))
    tracks = [NoisySteps.of(s, settings) for s in steps]
    if method == "cve":
        return Found.normal(*covariance_estimate(tracks))
    return by_likelihood(tracks)


def by_likelihood(tracks: Sequence[NoisySteps], *, apart: float | None = None) -> Found:
    """Return the maximum of the likelihood, with intervals from its profile.

    Axes that diffuse unequally widen the intervals.

    Parameters
    ----------
    tracks : sequence of NoisySteps
        Steps of every motion, all of one quantity.
    apart : float, optional
        Sum of the greatest log-likelihoods of the motions, each with a D of its own, where that is
        known.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=3)
    >>> from perrin.diffusion import Noise, NoisySteps, steps_of
    >>> found = by_likelihood([NoisySteps.of(steps_of(truth, "rotation"), Noise())])
    >>> found.ci95[0] < 5e-3 < found.ci95[1]
    True
    """
    from scipy.special import chdtrc

    likelihood = Likelihood.of(tracks)
    if not likelihood.scale[0] > 0:
        return _NO_MOTION
    best = likelihood.best()
    wider = np.array([excess_scatter(tracks, float(best.D[0]), best.theta)])
    found = _found_of_units(likelihood, best, wider)[0]
    if tracks[0].drift:
        mean, information = likelihood.steady_motion(found.value, best.theta)
        errors = np.sqrt(np.diagonal(np.linalg.inv(information), axis1=1, axis2=2))
        drift, drift_stderr = (tuple(map(tuple, x.tolist())) for x in (mean, errors))
        found = replace(found, drift=drift, drift_stderr=drift_stderr)
    if len(tracks) > 1:
        highest = likelihood.apart().best().value.sum() if apart is None else apart
        gain = float(highest - best.value[0])
        found = replace(found, p_same=float(chdtrc(len(tracks) - 1, max(2 * gain, 0.0))))
    return found


def likelihood_of_each(tracks: Sequence[NoisySteps]) -> list[Found]:
    """Return the maximum of the likelihood of each motion alone, as `by_likelihood`, all at once.

    Parameters
    ----------
    tracks : sequence of NoisySteps

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> from perrin.diffusion import Noise, NoisySteps, steps_of
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=3)
    >>> track = NoisySteps.of(steps_of(truth, "rotation"), Noise())
    >>> [one.ci95[0] < 5e-3 < one.ci95[1] for one in likelihood_of_each([track, track])]
    [True, True]
    """
    found: list[Found | None] = [None] * len(tracks)
    moving = [i for i, t in enumerate(tracks) if np.any(t.steps.vectors)]
    for rows in together([tracks[i] for i in moving]):
        numbers = [moving[k] for k in rows]
        some = [tracks[i] for i in numbers]
        likelihood = Likelihood.of(some).apart()
        best = likelihood.best()
        wider = excess_scatter_of_each(some, best.D, best.theta)
        units = _found_of_units(likelihood, best, wider)
        if some[0].drift:
            mean, information = likelihood.steady_motion(best.D, best.theta)
            errors = np.sqrt(np.diagonal(np.linalg.inv(information), axis1=1, axis2=2))
            units = [
                replace(one, drift=(tuple(own),), drift_stderr=(tuple(error),))
                for one, own, error in zip(units, mean.tolist(), errors.tolist(), strict=True)
            ]
        for i, one in zip(numbers, units, strict=True):
            found[i] = one
    return [_NO_MOTION if f is None else f for f in found]


def together(tracks: Sequence[NoisySteps]) -> list[list[int]]:
    """Return the numbers of tracks in groups whose likelihoods are evaluated at once.

    Even steps are evaluated in their sine modes, which is fastest for equally many of them.

    Parameters
    ----------
    tracks : sequence of NoisySteps

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> from perrin.diffusion import Noise, NoisySteps, steps_of
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=3)
    >>> track = NoisySteps.of(steps_of(truth, "rotation"), Noise())
    >>> together([track, track])
    [[0, 1]]
    """
    keys = []
    for track in tracks:
        even = track.steps.even
        keys.append((even, len(track.steps.duration) if even else 0, track.drift))
    sizes = [len(track.steps.duration) for track in tracks]
    return groups_alike(keys, sizes, most=_STEPS_TOGETHER)


def _found_of_units(likelihood: Likelihood, best: ProfilePoint, wider: Floats) -> list[Found]:
    """Return the D of every unit with its intervals, `wider` in square, and its offset."""
    levels = np.array([CHI2[level] for level in (0.68, 0.95)])
    low, high = likelihood.intervals(best, levels[:, None] * wider)
    offset, offset_stderr = likelihood.offsets(best)
    return [
        Found(float(D), tuple(ci68), tuple(ci95), float(mean), float(error))
        for D, ci68, ci95, mean, error in zip(
            best.D,
            np.transpose([low[0], high[0]]).tolist(),
            np.transpose([low[1], high[1]]).tolist(),
            offset,
            offset_stderr,
            strict=True,
        )
    ]


def precision_limits(estimate: DiffusionEstimate, steps: Sequence[Steps]) -> tuple[str, ...]:
    """Return one line for each condition of an exact estimate that is not fulfilled.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> from perrin.diffusion import steps_of
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=3)
    >>> precision_limits(estimate_diffusion(truth), [steps_of(truth, "rotation")])
    ()
    """
    limits = []
    count = sum(len(s.duration) for s in steps)
    if count < _FEW_STEPS:
        limits.append(f"{count} steps, fewer than {_FEW_STEPS}: the interval is approximate")
    if estimate.snr < _LOW_SNR:
        limits.append(
            f"signal-to-noise ratio {estimate.snr:.2g} under {_LOW_SNR}: the noise is far larger "
            "than a step; sample less often"
        )
    if estimate.quantity != "rotation" or estimate.method == "trace":
        return tuple(limits)
    durations = np.concatenate([s.duration for s in steps])
    # A step counts as the square of the share of diffusion in its variance.
    snr = max(estimate.snr, 0.0) * durations / estimate.dt
    share = np.divide(snr, snr + 1, out=np.ones_like(snr), where=np.isfinite(snr))
    weight = share**2
    total = float(weight.sum())
    usual = float(weight @ durations) / total if total > 0 else estimate.dt
    step = estimate.value * usual
    planar = steps[0].vectors.shape[1] == 1
    if planar and 4 * step > _COARSE_STEP_IN_PLANE:
        limits.append(
            f"4 D_R dt = {4 * step:.2g} over {_COARSE_STEP_IN_PLANE}: whole turns between frames"
        )
    elif not planar and 4 * step > _LOST_TURNS:
        limits.append(
            f"4 D_R dt = {4 * step:.2g} over {_COARSE_STEP}: rotation vectors between frames do "
            "not follow turns as large as these, and D_R is a lower limit; sample faster"
        )
    elif not planar and 4 * step > _COARSE_STEP:
        limits.append(
            f"4 D_R dt = {4 * step:.2g} over {_COARSE_STEP}: rotation vectors between frames read "
            f'D_R low by about {100 * step / 6:.1f} %; method="trace" is exact at any step length'
        )
    return tuple(limits)
