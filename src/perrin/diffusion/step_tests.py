"""Tests for steps that Brownian motion cannot make: jumps, and a steady velocity or spin."""

from __future__ import annotations

import warnings as python_warnings
from dataclasses import asdict, dataclass, fields, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from perrin._arrays import from_plain, frozen, to_plain
from perrin.diffusion.estimators import estimate_diffusion, estimate_each, together
from perrin.diffusion.likelihood import Likelihood
from perrin.diffusion.step_kernels import covariance_bands
from perrin.diffusion.steps import NoisySteps, groups_alike, steps_of
from perrin.errors import PrecisionWarning, TooFewFramesError
from perrin.geometry.rotations import exp_map
from perrin.geometry.shapes import squared_lengths
from perrin.motion.residuals import median_present

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
# change D, and with it p, by a few parts in N. If only p below some level matter, the cube root of
# that level is enough: of 955 tracks of 14 to 301 frames whose p fell below 1e-3 to 1e-7 it was at
# most a third of that before.
_CLEARLY_STILL = 0.05

# A displaced frame is attributed to localisation up to this multiple of the variance that its own
# residual explains; beyond it the body itself was elsewhere for one frame.
_BADLY_MEASURED = 100.0

# A jump of the stage is a common step that has this probability, at most, in the whole movie.
STAGE_LEVEL = 1e-4

# More jumps of the stage than one in this number of steps (and more than one) are another motion.
_STAGE_STEPS_PER_JUMP = 10

_MEDIAN_SQUARE = 0.4549  # median of chi-squared with one degree of freedom

# Bodies move alike unless their displacements differ by more than at this level.
_MOVE_ALIKE = 1e-4

_MOST_STEPS = 20_000  # steps that are tested at once; more do not stay in the processor's cache

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
        residuals = leave_one_out_residuals([motion], [without_jumps], without=likely[None])
        more = _jump_candidates(residuals, likely[None])[0]
        if not more.any() or 2 * np.count_nonzero(likely | more) > len(stop):
            break
        likely |= more
        settings = replace(estimate.settings, drift=estimate.drift is not None)
        with python_warnings.catch_warnings():
            python_warnings.simplefilter("ignore", PrecisionWarning)
            try:
                without_jumps = estimate_diffusion(
                    cut_at(motion, stop[likely]), quantity=estimate.quantity, noise=settings
                )
            except TooFewFramesError:
                return none
    if not likely.any():
        return none
    step = leave_one_out_residuals([motion], [without_jumps], without=likely[None]).step[0]
    z, others = step[likely], step[~likely]
    count, d = others.shape
    # The residuals of a body at rest are a slow wave, of which one track has few periods: M may
    # then be small by chance. It is not taken smaller than 1, its value where the fit is right.
    square = np.sum((z @ _inverse_root(others.T @ others / count, least=1.0)) ** 2, axis=1)
    freedom = count - d + 1  # of Hotelling's T^2
    p = fdtrc(d, freedom, square * freedom / (d * count))
    p = np.minimum(len(step) * p, 1.0)
    found = np.flatnonzero(likely)[p < JUMP_LEVEL]
    return Jumps(stop[found], size[found], p[p < JUMP_LEVEL], len(stop))


def find_jumps_of_each(
    motions: Sequence[RigidMotion], estimates: Sequence[DiffusionEstimate]
) -> list[Jumps]:
    """Find the steps of several motions that Brownian motion cannot make, as `find_jumps`.

    Motions with equally many steps are searched for candidates together.

    Parameters
    ----------
    motions : sequence of RigidMotion
    estimates : sequence of DiffusionEstimate
        D of every motion.

    Returns
    -------
    list of Jumps

    Examples
    --------
    >>> from perrin import Cluster, estimate_diffusion, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=100, rng=3)
    >>> jumps = find_jumps_of_each([truth] * 2, [estimate_diffusion(truth)] * 2)
    >>> [one.rows.size for one in jumps]
    [0, 0]
    """
    suspected = np.zeros(len(motions), dtype=np.bool_)
    counts = [len(motion.steps()[0]) for motion in motions]
    keys = [(count, motion.dimension) for count, motion in zip(counts, motions, strict=True)]
    testable = [n >= _FEWEST_STEPS and e.value > 0 for n, e in zip(counts, estimates, strict=True)]
    tested = np.flatnonzero(testable).tolist()
    for rows in groups_alike(
        [keys[k] for k in tested], [counts[k] for k in tested], most=_MOST_STEPS
    ):
        bodies = [tested[row] for row in rows]
        none = np.zeros((len(bodies), counts[bodies[0]]), dtype=np.bool_)
        residuals = leave_one_out_residuals(
            [motions[k] for k in bodies], [estimates[k] for k in bodies], without=none
        )
        suspected[bodies] = _jump_candidates(residuals, none).any(axis=1)
    found = []
    for motion, estimate, likely in zip(motions, estimates, suspected, strict=True):
        if likely:
            found.append(find_jumps(motion, estimate))
            continue
        stop = motion.steps()[1]
        axes = motion.covariance.shape[-1] if estimate.quantity == "rotation" else motion.dimension
        found.append(Jumps(stop[:0], np.empty((0, axes)), np.empty(0), len(stop)))
    return found


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
        Common displacements of family-wise p < 1e-4. More than a tenth of the steps of a movie are
        no jumps but another common motion, and none is returned.

    Notes
    -----
    The mean displacement m of the bodies between two frames, weighted with the inverse variances of
    their steps along every axis, is compared with those of all G other frames by an F test of d and
    d (G - 1) / 2 degrees of freedom. The median step of every body is subtracted, so that a steady
    drift is no jump. The deviations of the bodies from m must be those of their other steps
    (p > 1e-4): otherwise one of them moved, and not the stage.

    Examples
    --------
    >>> from dataclasses import replace
    >>> from perrin import Cluster, simulate_motion
    >>> body, given = Cluster.tetrahedron(1.5), {"D_R": 5e-3, "D_T": 0.02, "dt": 0.7}
    >>> motions = [simulate_motion(body, n_frames=30, rng=k, **given) for k in range(4)]
    >>> jump = np.where(np.arange(30) < 12, 0.0, 1.2)[:, None] * [1.0, 0.0, 0.0]
    >>> moved = [replace(m, center=m.center + jump) for m in motions]
    >>> find_stage_jumps(moved, [np.arange(30)] * 4).frames.tolist()
    [12]
    """
    from scipy.special import chdtrc, fdtrc

    d = motions[0].center.shape[1] if motions else 3
    none = StageJumps(
        np.empty(0, np.int64),
        np.empty((0, d)),
        np.empty((0, d)),
        np.empty(0),
        np.empty(0, np.int64),
    )
    table = _steps_between_frames(motions, frames)
    if table is None:
        return none
    ends, steps, gap = table  # steps (B, G, d), NaN where a body has none
    scaled = steps / np.sqrt(gap)[:, None]
    known: Bools = np.asarray(np.isfinite(scaled).all(axis=2))
    several: Bools = np.asarray(known.sum(axis=0) >= 2)
    usual: Bools = np.ones(len(ends), dtype=np.bool_)
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
    # Half of the degrees of freedom, because candidates were selected from these steps.
    p = fdtrc(d, d * max(int((usual & several).sum()) - 1, 1) / 2, common / d / max(level, 1.0))
    p = np.minimum(p * len(ends), 1.0)
    found &= (p < STAGE_LEVEL) & (chdtrc(freedom, apart / scatter) > _MOVE_ALIKE)
    if np.count_nonzero(found) > most:
        return none
    root = np.sqrt(gap)[:, None]
    error = np.sqrt(max(level, 1.0) / np.maximum(total, 1e-300)) * root
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
    if not len(rows):
        return motion
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
    return steady_motion_of_each([motion], [estimate])[0]


def steady_motion_of_each(
    motions: Sequence[RigidMotion],
    estimates: Sequence[DiffusionEstimate],
    *,
    level: float = 1.0,
) -> list[SteadyMotion]:
    """Test several motions for a mean velocity or spin, as `steady_motion`, all of them together.

    Parameters
    ----------
    motions : sequence of RigidMotion
    estimates : sequence of DiffusionEstimate
        D of every motion, all of one quantity and with the same settings.
    level : float
        Larger p-values need not be exact.

    Returns
    -------
    list of SteadyMotion

    Examples
    --------
    >>> from perrin import Cluster, estimate_diffusion, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=100, rng=3)
    >>> first, second = steady_motion_of_each([truth] * 2, [estimate_diffusion(truth)] * 2)
    >>> first.p == second.p
    True
    """
    found = _steady_motions_at(motions, estimates)
    moving = [
        k
        for k, (one, estimate) in enumerate(zip(found, estimates, strict=True))
        if not one.p > min(_CLEARLY_STILL, np.cbrt(level)) and estimate.value > 0
    ]
    if moving:
        some = [motions[k] for k in moving]
        settings = replace(estimates[moving[0]].settings, drift=True)
        again = estimate_each(some, quantity=estimates[moving[0]].quantity, noise=settings)
        free = []
        for taken in again:
            if isinstance(taken, TooFewFramesError):
                raise taken
            free.append(taken)
        for k, without in zip(moving, _steady_motions_at(some, free), strict=True):
            found[k] = without
    return found


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
    return offset_gain_of_each([motion], [estimate], sigma=[sigma])[0]


def offset_gain_of_each(
    motions: Sequence[RigidMotion],
    estimates: Sequence[DiffusionEstimate],
    *,
    sigma: Sequence[float],
) -> list[float]:
    """Return the gains of a free noise offset for several motions, as `offset_gain`.

    Parameters
    ----------
    motions : sequence of RigidMotion
    estimates : sequence of DiffusionEstimate
        D of every motion with noise "joint".
    sigma : sequence of float
        Localisation error of each, um (rms over axes).

    Returns
    -------
    list of float

    Examples
    --------
    >>> from perrin import Cluster, add_noise, estimate_diffusion, simulate_motion, track_rotation
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=1e-3, dt=0.7, n_frames=100, rng=3)
    >>> motion = track_rotation(add_noise(truth.positions(), sigma=0.03, rng=4), dt=0.7)
    >>> found = estimate_diffusion(motion)
    >>> [round(x) for x in offset_gain_of_each([motion] * 2, [found] * 2, sigma=[0.03, 0.06])]
    [0, 23]
    """
    gains = np.zeros(len(motions))
    steps = [steps_of(m, e.quantity) for m, e in zip(motions, estimates, strict=True)]
    free = [NoisySteps.of(s, e.settings) for s, e in zip(steps, estimates, strict=True)]
    known = [
        NoisySteps.of(s, replace(e.settings, model=float(own)))
        for s, e, own in zip(steps, estimates, sigma, strict=True)
    ]
    for rows in together(free):
        own = [estimates[k] for k in rows]
        theta = np.array(
            [free[k].theta_at(e.value, e.offset) for k, e in zip(rows, own, strict=True)]
        )
        # The estimate is the maximum of the likelihood with the noise left free.
        best = Likelihood.of([free[k] for k in rows]).apart()
        highest = best.sums(np.array([e.value for e in own]), theta).value
        fixed = Likelihood.of([known[k] for k in rows]).apart().best().value
        gains[rows] = np.maximum(2 * (highest - fixed), 0.0)
    return [float(gain) for gain in gains]


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


def _steady_motions_at(
    motions: Sequence[RigidMotion], estimates: Sequence[DiffusionEstimate]
) -> list[SteadyMotion]:
    """Return the generalised least-squares steady motion at the D and noise of each estimate."""
    from scipy.special import fdtrc

    tracks = [
        NoisySteps.of(steps_of(m, e.quantity), replace(e.settings, drift=True))
        for m, e in zip(motions, estimates, strict=True)
    ]
    found: dict[int, SteadyMotion] = {}
    for rows in together(tracks):
        some, own = [tracks[k] for k in rows], [estimates[k] for k in rows]
        likelihood = Likelihood.of(some).apart()
        value = np.array([e.value for e in own])
        theta = np.array([t.theta_at(e.value, e.offset) for t, e in zip(some, own, strict=True)])
        D = np.maximum(value, 1e-12 * likelihood.scale)
        means, informations = likelihood.steady_motion(D, theta)
        counts, d = np.array([len(t.steps.duration) for t in some]), means.shape[1]
        square = np.einsum("gp,gpq,gq->g", means, informations, means) * (counts - 1) / counts
        stderr = np.array([e.stderr for e in own])
        freedom = 2 * np.divide(value, stderr, out=np.full(len(own), np.inf), where=stderr > 0) ** 2
        p = fdtrc(d, np.clip(freedom, 1.0, 1e9), square / d)
        inverse = np.linalg.inv(informations)
        # A body at rest has variances of 0, within rounding.
        errors = np.sqrt(np.maximum(np.diagonal(inverse, axis1=1, axis2=2), 0.0))
        parts = zip(rows, means.tolist(), errors.tolist(), p.tolist(), strict=True)
        found |= {k: SteadyMotion(tuple(m), tuple(error), chance) for k, m, error, chance in parts}
    return [found[k] for k in range(len(motions))]


class StepResiduals(NamedTuple):
    """Standardised residuals of the S steps of B motions, and of frames that two steps share.

    Attributes
    ----------
    step : ndarray, shape (B, S, A)
        Standardised difference of each step from its prediction from all others.
    length : ndarray, shape (B, S, A)
        Each step over its standard deviation.
    frame : ndarray, shape (B, S - 1, A)
        Standardised displacement of the frame between two steps from its prediction.
    linked : ndarray of bool, shape (B, S - 1)
        Whether the two steps share that frame.
    measured_badly : ndarray of bool, shape (B, S - 1)
        Whether localisation, by the frame's own rigid-fit residual, explains its displacement.
    """

    step: Floats
    length: Floats
    frame: Floats
    linked: Bools
    measured_badly: Bools


def leave_one_out_residuals(
    motions: Sequence[RigidMotion], estimates: Sequence[DiffusionEstimate], *, without: Bools
) -> StepResiduals:
    """Return the residual of each step given all others but those `without`, standardised.

    The motions have equally many steps, S. An estimate with drift was fitted without the steps
    `without` (B, S) as well.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=3)
    >>> from perrin import estimate_diffusion
    >>> none = np.zeros((1, 299), dtype=bool)
    >>> residuals = leave_one_out_residuals([truth], [estimate_diffusion(truth)], without=none)
    >>> bool(abs(residuals.step.std() - 1) < 0.1)
    True
    """
    from scipy.linalg.lapack import dpttrf, dpttrs

    tracks = [
        NoisySteps.of(steps_of(m, e.quantity), e.settings)
        for m, e in zip(motions, estimates, strict=True)
    ]
    y = np.stack(
        [
            t.steps.without_steady_motion(kept=~omitted)[0].vectors
            if e.drift is not None and omitted.any()
            else t.steps.vectors
            for t, e, omitted in zip(tracks, estimates, without, strict=True)
        ]
    )
    linked = np.stack([t.steps.linked for t in tracks])
    shape = (len(tracks), y.shape[2], y.shape[1])

    def along_rows(x: Floats | Bools) -> Floats:
        """Return numbers of every step (B, S, A) as rows, one axis of one motion after another."""
        rows = np.swapaxes(np.broadcast_to(x, y.shape), 1, 2)
        return np.ascontiguousarray(rows, dtype=np.float64).ravel()

    def of_ends(pairs: Sequence[tuple[Floats, Floats]]) -> tuple[Floats, Floats]:
        before, after = (along_rows(np.stack(part)) for part in zip(*pairs, strict=True))
        return before, after

    def of_motion(numbers: Sequence[float]) -> Floats:
        return along_rows(np.array(numbers)[:, None, None])

    def by_step(rows: Floats) -> Floats:
        return np.ascontiguousarray(np.swapaxes(rows.reshape(shape), 1, 2))

    diagonal, off_diagonal = covariance_bands(
        of_motion([e.value for e in estimates]),
        of_motion([t.theta_at(e.value, e.offset) for t, e in zip(tracks, estimates, strict=True)]),
        along_rows(np.stack([t.steps.duration for t in tracks])[..., None]),
        along_rows(linked[..., None]),
        blur=of_motion([t.blur for t in tracks]),
        weight=of_ends([t.weight for t in tracks]),
        known=of_ends([t.known for t in tracks]),
    )
    extra = _LEFT_OUT * diagonal * along_rows(without[..., None])
    a, b = diagonal + extra, off_diagonal
    d, lower, bad = dpttrf(a, b)
    up, _, bad_up = dpttrf(a[::-1], b[::-1])
    if (bad or bad_up) and len(tracks) > 1:
        # One of the motions has no positive definite covariance.
        singly = [
            leave_one_out_residuals([m], [e], without=omitted[None])
            for m, e, omitted in zip(motions, estimates, without, strict=True)
        ]
        return StepResiduals(*(np.concatenate(parts) for parts in zip(*singly, strict=True)))
    pairs = linked[:, :-1]
    if bad or bad_up:
        return StepResiduals(0 * y, 0 * y, 0 * y[:, 1:], pairs, pairs)
    z, _ = dpttrs(d, lower, along_rows(y))
    inverse = 1 / (d + up[::-1] - a)
    corner = np.append(-lower * inverse[1:], 0.0)
    step = by_step(z / inverse / np.sqrt(1 / inverse - extra))
    z, inverse, corner = by_step(z), by_step(inverse), by_step(corner)
    variance = inverse[:, :-1] + inverse[:, 1:] - 2 * corner[:, :-1]
    frame = (z[:, :-1] - z[:, 1:]) / np.sqrt(variance)
    displacement = 0.25 * np.sum((y[:, :-1] - y[:, 1:]) ** 2, axis=2)
    pairs_of = list(zip(motions, tracks, strict=True))
    residual = np.stack([m.residual[t.steps.stop[:-1]] for m, t in pairs_of])
    usual = np.array([median_present(m.residual) for m in motions])[:, None]
    worse = np.divide(residual, usual, out=np.ones_like(residual), where=usual > 0)
    worse = np.where(usual > 0, np.maximum(worse, 1.0) ** 2, 1.0)
    noise = [m.sigma**2 * t.steps.variances[1][:-1].sum(axis=1) for m, t in pairs_of]
    badly = np.asarray(displacement <= _BADLY_MEASURED * np.stack(noise) * worse)
    return StepResiduals(step, y / np.sqrt(by_step(diagonal)), frame, pairs, badly)


def _jump_candidates(residuals: StepResiduals, known: Bools) -> Bools:
    """Return further steps (B, S) unlike the bulk that are not due to one displaced frame."""
    from scipy.special import chdtri

    count, root = known.shape[1], _robust_root(residuals.step)
    displaced = np.where(
        residuals.linked & residuals.measured_badly, squared_lengths(residuals.frame @ root), 0.0
    )

    def before(x: Floats) -> Floats:
        return np.asarray(np.pad(x, ((0, 0), (1, 0))), dtype=np.float64)

    def after(x: Floats) -> Floats:
        return np.asarray(np.pad(x, ((0, 0), (0, 1))), dtype=np.float64)

    around = np.maximum(after(displaced), before(displaced))
    # The first and the last frame of a piece belong to one step only: a jump there isolates one
    # frame, and a badly measured frame explains it as well.
    pairs = residuals.linked.astype(np.float64)
    inside = (before(pairs) > 0) & (after(pairs) > 0)
    limit = chdtri(residuals.step.shape[2], _CANDIDATE_LEVEL / count)
    given_others = squared_lengths(residuals.step @ root)
    # Jumps back and forth resemble noise once the noise is fitted to them: the length alone.
    own = squared_lengths(residuals.length @ _robust_root(residuals.length))
    alone = np.where(around == 0, own, 0.0)
    # A jump distorts the prediction of its neighbours: the largest of them is taken first.
    largest = np.maximum(after(given_others[:, 1:]), before(given_others[:, :-1]))
    likely = (given_others > limit) & (given_others > around) & (given_others > largest)
    return np.asarray((likely | (alone > limit)) & inside & ~known)


def _robust_root(bulk: Floats) -> Floats:
    """Return roots of M^-1 (B, A, A), M from the shorter half of `bulk` (B, K, A).

    A vector times the root has the squared length of chi-squared for vectors like the bulk.
    """
    from scipy.special import chdtri

    typical = np.median(bulk**2, axis=1, keepdims=True)
    power = squared_lengths(bulk / np.sqrt(np.maximum(typical, 1e-300)))
    short = power <= np.median(power, axis=1, keepdims=True)
    half = np.where(short[..., None], bulk, 0.0)
    mean = np.swapaxes(half, 1, 2) @ half / short.sum(axis=1)[:, None, None]
    root = _inverse_root(mean)
    median = np.median(squared_lengths(bulk @ root), axis=1)
    usual = chdtri(bulk.shape[2], 0.5)
    scale = np.divide(usual, median, out=np.zeros_like(median), where=median > 0)
    return np.asarray(root * np.sqrt(scale)[:, None, None])


def _inverse_root(a: Floats, *, least: float = 0.0) -> Floats:
    """Return A^(-1/2) of covariances (..., A, A) with eigenvalues of `least` or more.

    Axes without any motion are 0.
    """
    values, axes = np.linalg.eigh(a)
    # Below 1e-200 the inverse would overflow where a body at rest moves in one frame.
    moves = values > np.maximum(1e-12 * values[..., -1:], 1e-200)
    root = np.sqrt(np.maximum(np.where(moves, values, 1.0), least))
    return np.asarray(axes * np.where(moves, 1 / root, 0.0)[..., None, :])
