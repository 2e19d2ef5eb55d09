"""Tests for steps that Brownian motion cannot make: jumps, and a steady velocity or spin."""

from __future__ import annotations

import warnings as python_warnings
from dataclasses import asdict, dataclass, fields, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from perrin._arrays import from_plain, frozen, to_plain
from perrin.diffusion.estimators import estimate_diffusion
from perrin.diffusion.likelihood import Likelihood
from perrin.diffusion.step_kernels import covariance_bands
from perrin.diffusion.steps import NoisySteps, steps_of
from perrin.errors import PrecisionWarning, TooFewFramesError
from perrin.geometry.rotations import exp_map

if TYPE_CHECKING:
    from collections.abc import Sequence

    from perrin._arrays import Bools, Floats, Ints
    from perrin.diffusion.estimate import DiffusionEstimate
    from perrin.motion.rigid_motion import RigidMotion

# A jump is a step that has this probability, at most, in the whole of a Brownian track.
JUMP_LEVEL = 1e-6

# More jumps than this share of the steps (and more than one) are another kind of motion.
MOST_JUMPS = 0.01

# Candidates are steps beyond this level, judged by a scale that up to half of the steps cannot
# change; they are then tested against the diffusion of all other steps.
_CANDIDATE_LEVEL = 1e-3

_FEWEST_STEPS = 8  # no scale of the steps is known from fewer

_MOST_CANDIDATE_ROUNDS = 10  # of finding candidates and estimating the diffusion of all other steps

# Above this p-value, at the D that contains the steady motion, no fit without it is made: it would
# change D, and with it p, by a few parts in N.
_CLEARLY_STILL = 0.05

# A displaced frame is attributed to localisation up to this multiple of the variance that its own
# residual explains; beyond it the body itself was elsewhere for one frame.
_BADLY_MEASURED = 100.0

# More jumps of the stage than one in this number of steps (and more than one) are another motion.
_STAGE_STEPS_PER_JUMP = 10

_MEDIAN_SQUARE = 0.4549  # median of chi-squared with one degree of freedom

# Bodies move alike unless their displacements differ by more than at this level.
_MOVE_ALIKE = 1e-4

# A variance multiplied by this takes a step out of the prediction of the others.
_LEFT_OUT = 1e6


@dataclass(frozen=True, eq=False)
class Jumps:
    """Steps of one motion that Brownian motion cannot make.

    Attributes
    ----------
    rows : ndarray of int, shape (K,)
        Rows of the motion at which these steps end.
    size : ndarray, shape (K, d) or (K, 3)
        Displacements of the centre along lab axes, um, or rotation vectors in body axes, rad
        ((K, 1) in the plane).
    p : ndarray, shape (K,)
        Probability of a step at least as long anywhere in a Brownian track.
    n_steps : int
        Number of steps of the motion.
    """

    rows: Ints
    size: Floats
    p: Floats
    n_steps: int

    def __post_init__(self) -> None:
        frozen(self.rows, self.size, self.p)

    @property
    def many(self) -> bool:
        """Whether there are more than 1 % of such steps: then they are another kind of motion."""
        return len(self.rows) > max(1, round(MOST_JUMPS * self.n_steps))

    @property
    def length(self) -> Floats:
        """Length of each jump, um or rad, shape (K,)."""
        return np.asarray(np.linalg.norm(self.size, axis=1))

    def to_dict(self) -> dict[str, Any]:
        """Return the jumps for JSON."""
        plain: dict[str, Any] = to_plain({f.name: getattr(self, f.name) for f in fields(self)})
        return plain

    @classmethod
    def from_dict(cls, entry: dict[str, Any]) -> Jumps:
        """Return the jumps that `to_dict` wrote."""
        rows = from_plain(entry["rows"], dtype=np.int64)
        size = from_plain(entry["size"]).reshape(len(rows), -1 if len(rows) else 0)
        return cls(rows, size, from_plain(entry["p"]), entry["n_steps"])


@dataclass(frozen=True)
class SteadyMotion:
    """A mean velocity or spin, and the test against a body without one.

    Attributes
    ----------
    value : tuple of float
        Mean velocity or spin along the lab axes, um/s or rad/s.
    stderr : tuple of float
        Standard errors of the value.
    p : float
        Probability of at least this value in a body that only diffuses (F test).
    """

    value: tuple[float, ...]
    stderr: tuple[float, ...]
    p: float

    def to_dict(self) -> dict[str, Any]:
        """Return the motion and its test for JSON."""
        plain: dict[str, Any] = to_plain(asdict(self))
        return plain

    @classmethod
    def from_dict(cls, entry: dict[str, Any]) -> SteadyMotion:
        """Return the motion and its test that `to_dict` wrote."""
        value, stderr = (tuple(from_plain(entry[name]).tolist()) for name in ("value", "stderr"))
        return cls(value, stderr, np.nan if entry["p"] is None else entry["p"])


def find_jumps(motion: RigidMotion, estimate: DiffusionEstimate) -> Jumps:
    """Find the steps that Brownian motion cannot make.

    Parameters
    ----------
    motion : RigidMotion
    estimate : DiffusionEstimate
        D of this motion by maximum likelihood, whose settings (quantity, noise, exposure, drift)
        hold for the test.

    Returns
    -------
    Jumps
        Steps of family-wise p < 1e-6; a frame measured badly, which makes two opposite steps, is
        no jump.

    Notes
    -----
    The residual of each step given all others, z = (C^-1 y) / (C^-1)_jj over the root of its
    variance 1/(C^-1)_jj, is chi-squared with d degrees of freedom in z M^-1 z, M the mean of
    z z^T, which also takes up unequal axes. A first M comes from the half of the steps with the
    smallest z, so that one jump does not mask another; the final one from all steps that are no
    candidates, with D and noise fitted to them, and the p-value is that of Hotelling's T^2.
    Candidates are left out of the prediction of their neighbours. A displaced frame has the
    residual of a step and its successor with opposite signs; where that one is larger, and the
    residual of the rigid fit can explain it, the frame was measured badly.

    Examples
    --------
    >>> from dataclasses import replace
    >>> from perrin import Cluster, estimate_diffusion, simulate_motion
    >>> from perrin.diffusion.step_tests import find_jumps
    >>> truth = simulate_motion(
    ...     Cluster.tetrahedron(1.5), D_R=5e-3, D_T=0.02, dt=0.7, n_frames=100, rng=3
    ... )
    >>> center = truth.center.copy()
    >>> center[40:] += [3.0, 0.0, 0.0]
    >>> moved = replace(truth, center=center)
    >>> jumps = find_jumps(moved, estimate_diffusion(moved, quantity="translation"))
    >>> jumps.rows.tolist(), jumps.many
    ([40], False)
    """
    from scipy.special import fdtrc

    start, stop = motion.steps()
    if estimate.quantity == "rotation":
        size = motion.step_vectors()[stop - 1]
    else:
        size = motion.center[stop] - motion.center[start]
    none = Jumps(stop[:0], size[:0], np.empty(0), len(stop))
    if len(stop) < _FEWEST_STEPS or not estimate.value > 0:
        return none
    likely = np.zeros(len(stop), dtype=np.bool_)
    without_jumps = estimate
    for _ in range(_MOST_CANDIDATE_ROUNDS):
        more = _jump_candidates(
            leave_one_out_residuals(motion, without_jumps, without=likely), likely
        )
        if not more.any() or 2 * np.count_nonzero(likely | more) > len(stop):
            break
        likely |= more
        try:
            without_jumps = _estimated_alike(cut_at(motion, stop[likely]), estimate)
        except TooFewFramesError:
            return none
    if not likely.any():
        return none
    residuals = leave_one_out_residuals(motion, without_jumps, without=likely).step
    z, others = residuals[likely], residuals[~likely]
    count, d = others.shape
    # The residuals of a body at rest are a slow wave, of which one track has few periods: M may
    # then be small by chance. It is not taken smaller than 1, its value where the fit is right.
    square = np.sum((z @ _inverse_root(others.T @ others / count, least=1.0)) ** 2, axis=1)
    freedom = count - d + 1  # of Hotelling's T^2
    p = fdtrc(d, freedom, square * freedom / (d * count))
    p = np.minimum(len(residuals) * p, 1.0)
    found = np.flatnonzero(likely)[p < JUMP_LEVEL]
    return Jumps(stop[found], size[found], p[p < JUMP_LEVEL], len(stop))


@dataclass(frozen=True, eq=False)
class StageJumps:
    """Steps that all bodies make together: the stage or the camera moved.

    Attributes
    ----------
    frames : ndarray of int, shape (K,)
        Frames in which these steps end.
    size, stderr : ndarray, shape (K, d)
        Common displacements along the lab axes, um, and their standard errors, which the diffusion
        of the bodies causes.
    p : ndarray, shape (K,)
        Probability of at least this common displacement anywhere in the movie.
    bodies : ndarray of int, shape (K,)
        Number of bodies that moved together.
    """

    frames: Ints
    size: Floats
    stderr: Floats
    p: Floats
    bodies: Ints

    def __post_init__(self) -> None:
        frozen(self.frames, self.size, self.stderr, self.p, self.bodies)

    def rows(self, frames: Ints) -> Ints:
        """Return the rows of a motion, by its frames (T,), at which the step with a jump ends."""
        row = np.unique(np.searchsorted(frames, self.frames))
        return np.asarray(row[(row > 0) & (row < len(frames))])

    def to_dict(self) -> dict[str, Any]:
        """Return the jumps for JSON."""
        plain: dict[str, Any] = to_plain({f.name: getattr(self, f.name) for f in fields(self)})
        return plain

    @classmethod
    def from_dict(cls, entry: dict[str, Any]) -> StageJumps:
        """Return the jumps that `to_dict` wrote."""
        frames, bodies = (from_plain(entry[k], dtype=np.int64) for k in ("frames", "bodies"))
        size, error = (
            from_plain(entry[name]).reshape(len(frames), -1 if len(frames) else 0)
            for name in ("size", "stderr")
        )
        return cls(frames, size, error, from_plain(entry["p"]), bodies)


def find_stage_jumps(motions: Sequence[RigidMotion], frames: Sequence[Ints]) -> StageJumps:
    """Find the steps that all bodies of a movie make together.

    Parameters
    ----------
    motions : sequence of RigidMotion
        Motions of two or more bodies.
    frames : sequence of ndarray of int
        Frame of each row of each motion.

    Returns
    -------
    StageJumps
        Common displacements of family-wise p < 1e-6. More than a tenth of the steps of a movie are
        no jumps but another common motion, and none is returned.

    Notes
    -----
    The mean displacement m of the bodies between two frames, weighted with the inverse variances of
    their steps along every axis, is compared with those of all other frames by an F test of d and
    d (G - 1) degrees of freedom, with the mean of the others subtracted, so that a steady drift is
    no jump. The deviations of the bodies from m must be those of their other steps (p > 1e-4):
    otherwise one of them moved, and not the stage.

    Examples
    --------
    >>> from dataclasses import replace
    >>> from perrin import Cluster, simulate_motion
    >>> motions = [
    ...     simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, D_T=0.02, dt=0.7, n_frames=30, rng=k)
    ...     for k in range(4)
    ... ]
    >>> jump = np.where(np.arange(30) < 12, 0.0, 1.2)[:, None] * [1.0, 0.0, 0.0]
    >>> moved = [replace(m, center=m.center + jump) for m in motions]
    >>> find_stage_jumps(moved, [np.arange(30)] * 4).frames.tolist()
    [12]
    """
    from scipy.special import chdtrc, fdtrc

    d = motions[0].center.shape[1] if motions else 3
    none = StageJumps(
        np.empty(0, np.int64), np.empty((0, d)), np.empty((0, d)), np.empty(0), np.empty(0, np.int64)
    )
    table = _steps_between_frames(motions, frames)
    if table is None:
        return none
    ends, steps, gap = table  # steps (B, G, d), NaN where a body has none
    scaled = steps / np.sqrt(gap)[:, None]
    known = np.isfinite(scaled).all(axis=2)
    several = known.sum(axis=0) >= 2
    usual = np.ones(len(ends), dtype=np.bool_)
    most = max(1, len(ends) // _STAGE_STEPS_PER_JUMP)
    while True:
        others = scaled[:, usual]
        if usual.sum() < _FEWEST_STEPS or np.isfinite(others[..., 0]).sum(axis=1).min() < 3:
            return none
        center = np.nanmedian(others, axis=1, keepdims=True)
        # A first scale that half of the steps cannot change; then that of all usual steps.
        if usual.all():
            square = np.nanmedian((others - center) ** 2, axis=1) / _MEDIAN_SQUARE
        else:
            square = np.nanmean((others - center) ** 2, axis=1)
        weight = np.where(known[..., None], 1 / np.maximum(square, 1e-300)[:, None], 0.0)
        total = weight.sum(axis=0)
        mean = np.nansum(weight * (scaled - center), axis=0) / np.maximum(total, 1e-300)
        common = (mean**2 * total).sum(axis=1)
        level = 1.0 if usual.all() else float(common[usual & several].mean()) / d
        largest = int(np.argmax(np.where(several & usual, common, 0.0)))
        if not chdtrc(d, common[largest] / max(level, 1.0)) < _CANDIDATE_LEVEL:
            break
        usual[largest] = False
        if np.count_nonzero(~usual) > 2 * most + 1:
            return none
    found = several & ~usual
    if not found.any():
        return none
    apart = np.nansum(weight * (scaled - center - mean) ** 2, axis=(0, 2))
    freedom = d * (known.sum(axis=0) - 1)
    scatter = apart[usual & several].sum() / freedom[usual & several].sum()
    p = fdtrc(d, d * max(int((usual & several).sum()) - 1, 1), common / d / level)
    p = np.minimum(p * len(ends), 1.0)
    found &= (p < JUMP_LEVEL) & (chdtrc(freedom, apart / scatter) > _MOVE_ALIKE)
    if np.count_nonzero(found) > most:
        return none
    root = np.sqrt(gap)[:, None]
    error = np.sqrt(level / np.maximum(total, 1e-300)) * root
    return StageJumps(
        ends[found], (mean * root)[found], error[found], p[found], known.sum(axis=0)[found]
    )


def _steps_between_frames(
    motions: Sequence[RigidMotion], frames: Sequence[Ints]
) -> tuple[Ints, Floats, Floats] | None:
    """Return the steps of several bodies between successive frames.

    Returns
    -------
    ends : ndarray of int, shape (G,)
        Frames in which the steps end.
    steps : ndarray, shape (B, G, d)
        Displacements, um; NaN where a body has no such step.
    duration : ndarray, shape (G,)
        Durations of the steps over the shortest one.

    None is returned for fewer than two bodies.
    """
    if len(motions) < 2:
        return None
    seen = np.unique(np.concatenate([f[m.fitted] for m, f in zip(motions, frames, strict=True)]))
    if len(seen) < 2:
        return None
    x = np.full((len(motions), len(seen), motions[0].center.shape[1]), np.nan)
    time = np.full(len(seen), np.nan)
    for k, (motion, frame) in enumerate(zip(motions, frames, strict=True)):
        place = np.searchsorted(seen, frame[motion.fitted])
        x[k, place], time[place] = motion.center[motion.fitted], motion.time[motion.fitted]
    duration = np.diff(time)
    return seen[1:], np.diff(x, axis=1), duration / duration.min()


def cut_at(motion: RigidMotion, rows: Ints) -> RigidMotion:
    """Return the motion with a new piece at each of the rows, so that no step ends there.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=5, rng=3)
    >>> cut_at(truth, np.array([2])).steps()[1].tolist()
    [1, 3, 4]
    """
    begins = np.zeros(len(motion.time), dtype=np.int64)
    begins[rows] = 1
    return replace(motion, piece=motion.piece + np.cumsum(begins))


def without_spin(motion: RigidMotion, spin: Sequence[float]) -> RigidMotion:
    """Return the motion as seen from axes that turn with a steady spin about the lab's axes.

    Parameters
    ----------
    motion : RigidMotion
    spin : sequence of float
        Angular velocity about x, y, z, rad/s; in the plane one number.

    Examples
    --------
    >>> from perrin import Cluster, estimate_diffusion, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=100, rng=3)
    >>> turning = without_spin(truth, [0, 0, -0.2])
    >>> round(estimate_diffusion(turning, drift=True).drift[0][2], 1)
    0.2
    """
    rotation = exp_map(-np.outer(motion.time - motion.time[0], spin)) @ motion.rotation
    return replace(motion, rotation=rotation)


def steady_motion(motion: RigidMotion, estimate: DiffusionEstimate) -> SteadyMotion:
    """Test for a mean velocity of the centre or a mean spin in the lab frame.

    Parameters
    ----------
    motion : RigidMotion
    estimate : DiffusionEstimate
        D of this motion, with the mean motion left in; its settings hold for the test.

    Returns
    -------
    SteadyMotion

    Notes
    -----
    The steady motion is found by generalised least squares of the steps on X_k = Q_k^T tau_k (Q_k
    the rotation to the lab; the identity for the centre) with the covariance of diffusion and noise
    fitted together with it. The information over d is F(d, nu) with nu = 2 / (relative variance of
    D).

    Examples
    --------
    >>> from dataclasses import replace
    >>> from perrin import Cluster, estimate_diffusion, simulate_motion
    >>> from perrin.diffusion.step_tests import steady_motion
    >>> truth = simulate_motion(
    ...     Cluster.tetrahedron(1.5), D_R=5e-3, D_T=0.02, dt=0.7, n_frames=100, rng=3
    ... )
    >>> flow = replace(truth, center=truth.center + truth.time[:, None] * [1.0, 0.0, 0.0])
    >>> found = steady_motion(flow, estimate_diffusion(flow, quantity="translation"))
    >>> found.p < 1e-6, abs(found.value[0] - 1) < 4 * found.stderr[0]
    (True, True)
    """
    found = _steady_motion_at(motion, estimate)
    if found.p > _CLEARLY_STILL or not estimate.value > 0:
        return found
    return _steady_motion_at(motion, _estimated_alike(motion, estimate, drift=True))


def offset_gain(motion: RigidMotion, estimate: DiffusionEstimate, *, sigma: float) -> float:
    """Return twice the log-likelihood that the noise offset, left free, gains over a known noise.

    Parameters
    ----------
    motion : RigidMotion
    estimate : DiffusionEstimate
        D of this motion with noise "joint"; its other settings hold.
    sigma : float
        Localisation error, um (rms over axes).

    Returns
    -------
    float
        Chi-squared with one degree of freedom if sigma is right: the offset's own standard error
        is too small where motion blur makes it negative and few steps bound it.

    Examples
    --------
    >>> from perrin import Cluster, add_noise, estimate_diffusion, simulate_motion, track_rotation
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=1e-3, dt=0.7, n_frames=100, rng=3)
    >>> motion = track_rotation(add_noise(truth.positions(), sigma=0.03, rng=4), dt=0.7)
    >>> estimate = estimate_diffusion(motion)
    >>> [round(offset_gain(motion, estimate, sigma=s)) for s in (0.03, 0.06)]
    [0, 23]
    """
    steps = steps_of(motion, estimate.quantity)
    settings = estimate.settings
    free = NoisySteps.of(steps, settings)
    known = NoisySteps.of(steps, replace(settings, model=float(sigma)))
    # The estimate is the maximum of the likelihood with the noise left free.
    at_estimate = np.array([estimate.value]), np.array([_theta(free, estimate)])
    best = Likelihood.of([free]).sums(*at_estimate).value[0]
    return max(2 * float(best - Likelihood.of([known]).best().value[0]), 0.0)


def persistence_gain(
    motion: RigidMotion, estimate: DiffusionEstimate, *, drift: bool = False
) -> float:
    """Return twice the log-likelihood gained by steps that are smoother than with motion blur.

    Parameters
    ----------
    motion : RigidMotion
    estimate : DiffusionEstimate
        D of this motion with noise "joint"; its settings hold.
    drift : bool
        Whether to leave a steady motion free where the estimate did not.

    Returns
    -------
    float
        Chi-squared with one degree of freedom at most in Brownian motion: a shutter that is open
        all the time lowers the noise offset to -D dt/3, smoothing the tracks below that. 0 where
        the offset is above, or the noise not free.

    Examples
    --------
    >>> import numpy as np
    >>> from perrin import Cluster, add_noise, estimate_diffusion, simulate_motion, track_rotation
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=200, rng=3)
    >>> x = add_noise(truth.positions(), sigma=0.03, rng=4)
    >>> smooth = np.stack([x[:-2], x[1:-1], x[2:]]).mean(axis=0)
    >>> [
    ...     persistence_gain(m, estimate_diffusion(m)) > 20
    ...     for m in (track_rotation(x, dt=0.7), track_rotation(smooth, dt=0.7))
    ... ]
    [False, True]
    """
    limit = -estimate.value * motion.usual_interval / 3
    if estimate.noise != "joint" or not estimate.value > 0 or estimate.offset >= limit:
        return 0.0
    steps = steps_of(motion, estimate.quantity)
    taken = drift or estimate.drift is not None
    free, blurred = (
        NoisySteps.free(steps, blur=float(steps.duration.min()) * share, drift=taken)
        for share in (1 / 2, 1 / 3)
    )
    values = [float(Likelihood.of([track]).best().value[0]) for track in (free, blurred)]
    return max(2 * (values[0] - values[1]), 0.0)


def _steady_motion_at(motion: RigidMotion, estimate: DiffusionEstimate) -> SteadyMotion:
    """Return the generalised least-squares steady motion at the D and noise of an estimate."""
    from scipy.special import fdtrc

    steps = steps_of(motion, estimate.quantity)
    track = NoisySteps.of(steps, replace(estimate.settings, drift=True))
    likelihood = Likelihood.of([track])
    D = max(estimate.value, 1e-12 * float(likelihood.scale[0]))
    means, informations = likelihood.steady_motion(D, np.array([_theta(track, estimate)]))
    mean, information = means[0], informations[0]
    count, d = len(steps.duration), len(mean)
    square = float(mean @ information @ mean) * (count - 1) / count
    freedom = 2 * (estimate.value / estimate.stderr) ** 2 if estimate.stderr > 0 else np.inf
    p = float(fdtrc(d, min(max(freedom, 1.0), 1e9), square / d))
    error = np.sqrt(np.diagonal(np.linalg.inv(information)))
    return SteadyMotion(tuple(mean.tolist()), tuple(error.tolist()), p)


class StepResiduals(NamedTuple):
    """Standardised residuals of steps, and of frames that two steps share.

    Attributes
    ----------
    step : ndarray, shape (S, A)
        Standardised difference of each step from its prediction from all others.
    length : ndarray, shape (S, A)
        Each step over its standard deviation.
    frame : ndarray, shape (S - 1, A)
        Standardised displacement of the frame between two steps from its prediction.
    linked : ndarray of bool, shape (S - 1,)
        Whether the two steps share that frame.
    measured_badly : ndarray of bool, shape (S - 1,)
        Whether localisation, by the frame's own rigid-fit residual, explains its displacement.
    """

    step: Floats
    length: Floats
    frame: Floats
    linked: Bools
    measured_badly: Bools


def leave_one_out_residuals(
    motion: RigidMotion, estimate: DiffusionEstimate, *, without: Bools
) -> StepResiduals:
    """Return the residual of each step given all others but those `without`, standardised.

    An estimate with drift was fitted without them as well.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=3)
    >>> from perrin import estimate_diffusion
    >>> none = np.zeros(299, dtype=bool)
    >>> residuals = leave_one_out_residuals(truth, estimate_diffusion(truth), without=none)
    >>> bool(abs(residuals.step.std() - 1) < 0.1)
    True
    """
    from scipy.linalg.lapack import dpttrf, dpttrs

    track = NoisySteps.of(steps_of(motion, estimate.quantity), estimate.settings)
    s = track.steps
    y, linked = s.vectors, s.linked[:-1]
    if estimate.drift is not None and without.any():
        y = s.without_steady_motion(kept=~without)[0].vectors
    diagonal, off_diagonal = covariance_bands(
        estimate.value,
        _theta(track, estimate),
        s.duration[:, None],
        s.linked[:, None],
        blur=track.blur,
        weight=track.weight,
        known=track.known,
    )
    step, frame = np.empty_like(y), np.zeros((len(y) - 1, y.shape[1]))
    for axis in range(y.shape[1]):
        extra = _LEFT_OUT * diagonal[:, axis] * without
        a, b = diagonal[:, axis] + extra, off_diagonal[:, axis]
        d, lower, bad = dpttrf(a, b)
        up, _, bad_up = dpttrf(a[::-1], b[::-1])
        if bad or bad_up:
            none = np.zeros_like(y)
            return StepResiduals(none, none, frame, linked, linked)
        z, _ = dpttrs(d, lower, y[:, axis])
        inverse = 1 / (d + up[::-1] - a)
        corner = -lower * inverse[1:]
        step[:, axis] = z / inverse / np.sqrt(1 / inverse - extra)
        variance = inverse[:-1] + inverse[1:] - 2 * corner
        frame[:, axis] = (z[:-1] - z[1:]) / np.sqrt(variance)
    displacement = 0.25 * np.sum((y[:-1] - y[1:]) ** 2, axis=1)
    residual = motion.residual[s.stop[:-1]]
    usual = float(np.nanmedian(motion.residual))
    worse = np.maximum(residual / usual, 1.0) ** 2 if usual > 0 else np.ones_like(residual)
    expected = motion.sigma**2 * s.variances[1][:-1].sum(axis=1) * worse
    badly = np.asarray(displacement <= _BADLY_MEASURED * expected)
    return StepResiduals(step, y / np.sqrt(diagonal), frame, linked, badly)


def _jump_candidates(residuals: StepResiduals, known: Bools) -> Bools:
    """Return further steps that differ from the bulk and are not due to one displaced frame."""
    from scipy.special import chdtri

    count = len(known)
    displaced = np.where(
        residuals.linked & residuals.measured_badly,
        _robust_square(residuals.frame, residuals.step),
        0.0,
    )
    around = np.maximum(np.append(displaced, 0.0), np.append(0.0, displaced))
    # The first and the last frame of a piece belong to one step only: a jump there isolates one
    # frame, and a badly measured frame explains it as well.
    inside = np.append(False, residuals.linked) & np.append(residuals.linked, False)
    limit = chdtri(residuals.step.shape[1], _CANDIDATE_LEVEL / count)
    given_others = _robust_square(residuals.step, residuals.step)
    # Jumps back and forth resemble noise once the noise is fitted to them: the length alone.
    alone = np.where(around == 0, _robust_square(residuals.length, residuals.length), 0.0)
    # A jump distorts the prediction of its neighbours: the largest of them is taken first.
    largest = np.maximum(np.append(given_others[1:], 0.0), np.append(0.0, given_others[:-1]))
    likely = (given_others > limit) & (given_others > around) & (given_others > largest)
    return np.asarray((likely | (alone > limit)) & inside & ~known)


def _robust_square(z: Floats, bulk: Floats) -> Floats:
    """Return z^T M^-1 z with M from the half of `bulk` that is shortest, scaled to chi-squared."""
    from scipy.special import chdtri

    power = np.sum(bulk**2 / np.maximum(np.median(bulk**2, axis=0), 1e-300), axis=1)
    short = bulk[power <= np.median(power)]
    root = _inverse_root(short.T @ short / len(short))
    median = float(np.median(np.sum((bulk @ root) ** 2, axis=1)))
    if not median > 0:
        return np.zeros(len(z))
    return np.asarray(np.sum((z @ root) ** 2, axis=1) * chdtri(z.shape[1], 0.5) / median)


def _inverse_root(a: Floats, *, least: float = 0.0) -> Floats:
    """Return A^(-1/2) of a covariance with eigenvalues of `least` or more.

    Axes without any motion are left out.
    """
    values, axes = np.linalg.eigh(a)
    moves = values > 1e-12 * max(float(values[-1]), 1e-300)
    return np.asarray(axes[:, moves] / np.sqrt(np.maximum(values[moves], least)))


def _theta(track: NoisySteps, estimate: DiffusionEstimate) -> float:
    """Return the free part of the noise: the offset is theta + level - blur D."""
    if np.isinf(track.freedom):
        return 0.0
    return max(estimate.offset - track.level + track.blur * estimate.value, 0.0)


def _estimated_alike(
    motion: RigidMotion, like: DiffusionEstimate, *, drift: bool = False
) -> DiffusionEstimate:
    """Estimate a motion with the settings of another estimate."""
    settings = replace(like.settings, drift=drift or like.drift is not None)
    with python_warnings.catch_warnings():
        python_warnings.simplefilter("ignore", PrecisionWarning)
        return estimate_diffusion(motion, quantity=like.quantity, noise=settings)
