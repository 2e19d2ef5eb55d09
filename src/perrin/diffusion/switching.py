"""Brownian steps whose D switches between two states: a hidden Markov model with shared noise."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from perrin._arrays import choice_fault, finite_or_none, from_plain, frozen, refuse, to_plain
from perrin._display import Shown
from perrin._text import with_error
from perrin.compiled.loading import compiled_kernels
from perrin.diffusion.estimate import NORMAL, UNITS
from perrin.diffusion.likelihood import Likelihood
from perrin.diffusion.noise_model import Noise, noise_faults
from perrin.diffusion.step_kernels import equal_columns
from perrin.diffusion.steps import NoisySteps, Quantity, Steps, pooled_steps, principal_steps
from perrin.errors import TooFewFramesError
from perrin.motion.rigid_motion import RigidMotion

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Mapping, Sequence
    from types import ModuleType
    from typing import TypeAlias

    from perrin._arrays import Bools, Floats, Ints

    # Points at which motions are to be filtered, and what filtering them gives.
    _Requests: TypeAlias = list[tuple["SwitchingSteps", Floats]]
    _Answers: TypeAlias = list[tuple[Floats, Floats]]
    _Search: TypeAlias = Generator[_Requests, _Answers, "SwitchingEstimate"]

# Fewer steps cannot show two states: an alternation of a few dwell times needs this many.
_FEWEST_SWITCHING_STEPS = 20

# Parameters of two states in excess of those of one D: a second D and two rates.
_MORE_PARAMETERS = 3

# Half the distance of the points, in logarithms of the parameters, whose values give slopes and
# curvatures: the error of a slope is of the order of its square.
_DIFFERENCE = 3e-3

# Axes are scaled to equal D where the least is above this part of the mean.
_LEAST_RATIO = 0.2

# Beyond this T^2 the axes of D are unequal: chi-squared at 1 %, for the five numbers by which a
# tensor differs from a multiple of unity, because the axes are chosen by the data.
_UNEQUAL_AXES_TEST = 15.09

_NEWTON_ROUNDS = 60

# Points at which motions are filtered at once; more do not stay in the processor's cache.
_MOST_POINTS = 700

# The search ends where the next step would raise the log-likelihood by less than this.
_CONVERGED = 1e-10

# The best of these is the start: D_slow and D_fast over the mean D, dwell time over the time
# between frames, and the noise over that of one D.
_START_SLOW = (0.1, 0.25, 0.4, 0.7)
_START_FAST = (1.3, 1.8, 2.5)
_START_DWELL = (4.0, 15.0, 60.0)
_START_NOISE = (0.3, 1.0)


@dataclass(frozen=True)
class Parameter:
    """A fitted parameter with its intervals.

    Attributes
    ----------
    value : float
        Most likely value.
    ci68, ci95 : tuple of float
        Confidence intervals; an end that the data do not bound is 0 or inf.
    unit : str
        Unit of the value.
    """

    value: float
    ci68: tuple[float, float]
    ci95: tuple[float, float]
    unit: str

    @classmethod
    def log_normal(cls, value: float, error: float, unit: str) -> Parameter:
        """Return a positive value whose logarithm has this standard error.

        Parameters
        ----------
        value : float
        error : float
            Standard error of the logarithm; NaN or inf where the data do not bound the value.
        unit : str
        """
        ends = []
        for level in (0.68, 0.95):
            reach = NORMAL[level] * error
            # Beyond e^10 an end is no bound.
            known = np.isfinite(reach) and reach < 10
            ends.append(
                (float(value * np.exp(-reach)), float(value * np.exp(reach)))
                if known
                else (0.0, np.inf)
            )
        return cls(float(value), ends[0], ends[1], unit)

    @property
    def stderr(self) -> float:
        """Half the width of the 68 % interval."""
        return (self.ci68[1] - self.ci68[0]) / 2

    def to_dict(self) -> dict[str, Any]:
        """Return the parameter for JSON; an end without bound is None."""
        return {
            "value": finite_or_none(self.value),
            "ci68": to_plain(self.ci68),
            "ci95": to_plain(self.ci95),
            "unit": self.unit,
        }

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> Parameter:
        """Return the parameter that `to_dict` wrote."""
        ends = [
            (float(low), np.inf if high is None else float(high))
            for low, high in (entry["ci68"], entry["ci95"])
        ]
        return cls(float(entry["value"]), ends[0], ends[1], entry["unit"])

    def __str__(self) -> str:
        if not np.isfinite(self.stderr):
            return f"{self.value:.2g} (not bounded) {self.unit}"
        return f"{with_error(self.value, self.stderr)} {self.unit}"

    def __float__(self) -> float:
        return self.value


@dataclass(frozen=True, eq=False, repr=False)
class SwitchingEstimate(Shown):
    """Two diffusion coefficients between which a motion switches, and the state of every step.

    Attributes
    ----------
    D_slow, D_fast : Parameter
        Diffusion coefficients of the two states, rad^2/s or um^2/s.
    D_mean : Parameter
        Mean over the two states, weighted with their probabilities; its interval contains the
        random number of dwells, and is wider than that of one D in `estimate_diffusion`.
    dwell_slow, dwell_fast : Parameter
        Mean time in a state before it changes, s.
    states : tuple of ndarray of int, shape (T,)
        For every motion the more probable state of the step that ends at each row: 0 slow, 1 fast,
        -1 where no step ends.
    probability : tuple of ndarray, shape (T,)
        Probability of the fast state for the same steps; NaN where no step ends.
    log_likelihood_gain : float
        Logarithm of the likelihood of two states over that of one D.
    bic_gain : float
        The gain less 1.5 ln(number of steps), the penalty of three more parameters (Bayesian
        information criterion); above 0 two states are the better description.
    n_frames : int
        Frames with a pose, of all motions.
    unit : str
        Unit of the coefficients, "rad^2/s" or "um^2/s".
    """

    D_slow: Parameter
    D_fast: Parameter
    D_mean: Parameter
    dwell_slow: Parameter
    dwell_fast: Parameter
    states: tuple[Ints, ...]
    probability: tuple[Floats, ...]
    log_likelihood_gain: float
    bic_gain: float
    n_frames: int
    unit: str

    def __post_init__(self) -> None:
        frozen(*self.states, *self.probability)

    @property
    def dwell(self) -> tuple[float, float]:
        """Mean dwell times in the slow and in the fast state, s."""
        return self.dwell_slow.value, self.dwell_fast.value

    @property
    def two_states(self) -> bool:
        """Whether two states are the better description of the steps (bic_gain > 0)."""
        return self.bic_gain > 0

    def to_dict(self) -> dict[str, Any]:
        """Return the estimate for JSON."""
        plain: dict[str, Any] = to_plain({f.name: getattr(self, f.name) for f in fields(self)})
        return plain

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> SwitchingEstimate:
        """Return the estimate that `to_dict` wrote."""
        read = dict(entry)
        for name in ("D_slow", "D_fast", "D_mean", "dwell_slow", "dwell_fast"):
            read[name] = Parameter.from_dict(entry[name])
        read["states"] = tuple(from_plain(row, dtype=np.int64) for row in entry["states"])
        read["probability"] = tuple(from_plain(row) for row in entry["probability"])
        return cls(**read)

    def __str__(self) -> str:
        name = "D_R" if self.unit == UNITS["rotation"] else "D_T"
        if not self.two_states:
            return f"{name}: two states are no better than one [{self.n_frames} frames]"
        return (
            f"{name} switches between {self.D_slow} and {self.D_fast}, mean dwell "
            f"{self.dwell_slow} and {self.dwell_fast} [{self.n_frames} frames]"
        )


@dataclass(frozen=True, eq=False)
class SwitchingSteps:
    """The steps of one motion for a model of two states, in the order of time.

    Given the states, a step is y = w + n_after - n_before: the displacement w of the body, of
    variance 2 D tau per axis, and the errors n of its two frames, which it shares with its
    neighbours. An error is localisation of variance s, and the distance from the body to the mean
    place of the body during the exposure, f dt, that ends at the frame: the error has the variance
    s + 2 b D with b = f dt/3, w + n_after the variance 2 D tau - 4 b D + s, and their covariance is
    s - b D (Berglund 2010, for each D). Where the exposure is unknown, s - b D is one number o.

    Attributes
    ----------
    track : NoisySteps
        Steps with what is known of their noise: s or o is weight theta + known, less blur D_slow
        where the exposure is unknown.
    elapsed : ndarray, shape (S,)
        Time from the beginning of the step before to that of each step, s; 0 for the first.
    follows : ndarray of bool, shape (S,)
        Whether a step begins with the frame in which the one before ended.
    exposed : float
        b = exposure dt/3 where the exposure is stated, else 0, s.
    """

    track: NoisySteps
    elapsed: Floats
    follows: Bools
    exposed: float

    @classmethod
    def of(cls, track: NoisySteps, time: Floats, *, exposed: float) -> SwitchingSteps:
        """Return the steps of a motion whose rows have these times (T,)."""
        start = time[track.steps.start]
        elapsed = np.diff(start, prepend=start[0])
        return cls(track, elapsed, np.append(False, track.steps.linked[:-1]), exposed)

    @cached_property
    def free(self) -> bool:
        """Whether the noise parameter theta is fitted."""
        return not np.isinf(self.track.freedom)

    @cached_property
    def equal_axes(self) -> list[Ints]:
        """Axes in groups that have the same noise in every frame."""
        return equal_columns(np.concatenate([*self.track.weight, *self.track.known]))

    def filtered(self, points: Floats) -> tuple[Floats, Floats]:
        """Return the log-likelihood at some points, and weights of pairs of states at the first.

        Parameters
        ----------
        points : ndarray, shape (P, 5)
            Logarithms of D_slow, D_fast, the rates of leaving the slow and the fast state (1/s),
            and theta.

        Returns
        -------
        value : ndarray, shape (P,)
        pairs : ndarray, shape (S, 2, 2)
            For every step, by the states before and after it, the probability of the change times
            the density of the step, relative to the largest of the four densities.

        Notes
        -----
        Given a state sequence the noise of the last frame is normal, with a mean and a variance
        that a Kalman filter carries from step to step. One such pair is kept for each of the two
        present states: the four combinations of last and present state are merged to two with the
        mean and variance of their mixture (second-order generalised pseudo-Bayes; Bar-Shalom and
        Li, Estimation and Tracking, section 11.6). Without noise this is the exact hidden Markov
        model; with equal D it is the exact Brownian likelihood.
        """
        return filtered_each([(self, points)])[0]

    def expansion(self, point: Floats) -> tuple[float, Floats, Floats]:
        """Return the log-likelihood at a point (5,) with its slopes (5,) and curvatures (5, 5)."""
        return expanded_about(self.filtered(around(point))[0])

    def fast_probability(self, point: Floats) -> Floats:
        """Return the probability of the fast state of every step, given all steps, (S,)."""
        return smoothed(self.filtered(point[None])[1], point[2:4])

    @cached_property
    def of_groups(self) -> tuple[Floats, Floats, Floats, Floats, Floats]:
        """Vectors, noise, clock, sizes and blur, as the compiled kernel reads them."""
        track, firsts = self.track, [axes[0] for axes in self.equal_axes]
        noise = [part[end][:, firsts] for end in (0, 1) for part in (track.weight, track.known)]
        return (
            np.ascontiguousarray(track.steps.vectors[:, np.concatenate(self.equal_axes)]),
            np.array(noise),
            np.array([track.steps.duration, self.elapsed, self.follows]),
            np.array([float(len(axes)) for axes in self.equal_axes]),
            np.array([self.exposed, track.blur - self.exposed]),
        )

    def filtered_by(self, kernels: ModuleType, points: Floats) -> tuple[Floats, Floats]:
        """Return what `filtered` does, computed by the compiled kernels."""
        place = np.exp(points)
        if not self.free:
            place[:, 4] = self.track.theta
        value, pairs = np.empty(len(points)), np.empty((len(self.elapsed), 2, 2))
        kernels.two_states(*self.of_groups, place, pairs, value)
        if self.free and self.track.freedom:
            value -= 0.5 * self.track.freedom * (points[:, 4] + self.track.theta / place[:, 4])
        return value, pairs


def filtered_each(
    requests: Sequence[tuple[SwitchingSteps, Floats]],
) -> list[tuple[Floats, Floats]]:
    """Filter several motions, each at points of its own, as `SwitchingSteps.filtered`.

    Without compiled kernels motions with equally many steps are filtered together.

    Parameters
    ----------
    requests : sequence of tuple
        Steps of each motion, and its points (P, 5).

    Returns
    -------
    list of tuple
        Log-likelihoods (P,) of each, and weights (S, 2, 2) at its first point.

    Examples
    --------
    >>> from perrin import Cluster, Noise, simulate_motion
    >>> from perrin.diffusion import steps_of
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=30, rng=3)
    >>> track = NoisySteps.of(steps_of(truth, "rotation"), Noise())
    >>> steps = SwitchingSteps.of(track, truth.time, exposed=0.0)
    >>> point = np.log([[2e-3, 8e-3, 0.1, 0.1, 1e-9]])
    >>> one, two = filtered_each([(steps, point), (steps, point)])
    >>> one[0] == two[0]
    array([ True])
    """
    kernels = compiled_kernels()
    if kernels is not None and all(len(s.track.steps.vectors[0]) <= 3 for s, _ in requests):
        return [steps.filtered_by(kernels, points) for steps, points in requests]
    alike: dict[tuple[int, ...], list[list[int]]] = {}
    for k, (steps, points) in enumerate(requests):
        sizes = [len(axes) for axes in steps.equal_axes]
        groups = alike.setdefault((len(steps.elapsed), *sizes), [[]])
        filled = sum(len(requests[i][1]) for i in groups[-1])
        if groups[-1] and filled + len(points) > _MOST_POINTS:
            groups.append([])
        groups[-1].append(k)
    found: dict[int, tuple[Floats, Floats]] = {}
    for groups in alike.values():
        for rows in groups:
            value, pairs = _filtered_together([requests[k] for k in rows])
            ends = np.cumsum([len(requests[k][1]) for k in rows])
            for k, high in zip(rows, ends.tolist(), strict=True):
                own = slice(high - len(requests[k][1]), high)
                found[k] = value[own], pairs[..., own.start].copy()
    return [found[k] for k in range(len(requests))]


def _filtered_together(requests: Sequence[tuple[SwitchingSteps, Floats]]) -> tuple[Floats, Floats]:
    """Filter motions with equally many steps and axes at all points, one after the other."""
    groups = requests[0][0].equal_axes
    sizes = np.array([len(axes) for axes in groups])
    firsts = np.cumsum([0, *sizes[:-1]])
    group_of = np.repeat(np.arange(len(groups)), sizes) if len(groups) > 1 else slice(None)
    count = sizes[:, None, None].astype(np.float64)
    points = np.concatenate([own for _, own in requests])
    counts = [len(own) for _, own in requests]

    def by_point(part: Callable[[SwitchingSteps], Floats | Bools]) -> Floats:
        """Return what belongs to each motion (...) for every point, (..., P)."""
        each = np.stack([np.asarray(part(steps), np.float64) for steps, _ in requests], axis=-1)
        return np.repeat(each, counts, axis=-1)

    # Axes: steps, groups of axes, state before, state, points.
    D, rate = np.exp(points[:, :2].T), np.exp(points[:, 2:4].T)
    free = by_point(lambda s: np.array(s.free)) > 0
    theta = np.where(free, np.exp(points[:, 4]), by_point(lambda s: np.array(s.track.theta)))
    exposed = by_point(lambda s: np.array(s.exposed))
    common_blur = by_point(lambda s: np.array(s.track.blur)) - exposed

    def noise_of(end: int) -> Floats:
        """Return the noise variance of the first or last frame of each step, by group of axes."""
        weight = by_point(lambda s: s.track.weight[end][:, [own[0] for own in s.equal_axes]])
        known = by_point(lambda s: s.track.known[end][:, [own[0] for own in s.equal_axes]])
        return np.asarray(theta * weight + known - common_blur * D[0])

    before, after = noise_of(0), noise_of(1)
    blur = exposed * D
    spread = 2 * D * by_point(lambda s: s.track.steps.duration)[:, None] - 4 * blur
    leaving = rate / rate.sum(axis=0)
    elapsed = by_point(lambda s: s.elapsed)[:, None]
    leaving = leaving * -np.expm1(-rate.sum(axis=0) * elapsed)
    (to_fast, to_slow), (slow, fast) = leaving.swapaxes(0, 1), (1 - leaving).swapaxes(0, 1)
    transition = np.stack([np.stack([slow, to_fast], 1), np.stack([to_slow, fast], 1)], 1)
    probability = rate[::-1] / rate.sum(axis=0)
    vectors = by_point(lambda s: s.track.steps.vectors[:, np.concatenate(s.equal_axes)])[:, :, None]
    follows = np.asarray(by_point(lambda s: s.follows) > 0)
    tops, totals, pairs = np.empty((len(vectors), len(points))), [], transition
    mean = np.zeros((vectors.shape[1], 2, len(points)))
    variance = np.zeros((len(groups), 2, len(points)))

    def by_group(x: Floats) -> Floats:
        """Sum over the axes of each group."""
        if len(groups) == 1:
            return np.asarray(x.sum(axis=0, keepdims=True))
        return np.asarray(np.add.reduceat(x, firsts, axis=0))

    all_follow = np.asarray(follows.all(axis=1)).tolist()
    for j, y in enumerate(vectors):
        if not all_follow[j]:
            start = before[j][:, None] + 2 * blur
            mean, variance = np.where(follows[j], mean, 0.0), np.where(follows[j], variance, start)
        noise = after[j][:, None, None]
        surprise = y + mean
        square = by_group(surprise * surprise)
        total = np.maximum(variance[:, :, None] + (spread[j] + noise), 1e-100)
        deviance = count[..., None] * np.log(total) + square[:, :, None] / total
        log_density = -0.5 * np.add.reduce(deviance, axis=0)
        tops[j] = np.maximum.reduce(log_density, axis=(0, 1))
        pairs[j] *= np.exp(log_density - tops[j])
        joint = probability[:, None] * pairs[j] + 1e-300
        both = joint[0] + joint[1]
        totals.append(both[0] + both[1])
        probability = both / totals[-1]
        shared = noise - blur
        gain = shared / total
        share = joint / both * gain
        mean = np.add.reduce(share[group_of] * surprise[:, :, None], axis=1)
        second = np.add.reduce(share * gain * square[:, :, None], axis=1)
        second -= by_group(mean * mean)
        variance = noise[:, 0] + 2 * blur - shared[:, 0] * np.add.reduce(share, axis=1)
        variance += second / count
    value = np.sum(tops, axis=0) + np.sum(np.log(totals), axis=0)
    freedom = np.where(free, by_point(lambda s: np.array(s.track.freedom if s.free else 0.0)), 0.0)
    if freedom.any():
        prior = by_point(lambda s: np.array(s.track.theta)) / theta
        value -= 0.5 * freedom * (np.log(theta) + prior)
    return value, pairs


def around(point: Floats) -> Floats:
    """Return a point (5,) and those from which its slopes and curvatures follow, (31, 5).

    Examples
    --------
    >>> around(np.zeros(5)).shape
    (31, 5)
    """
    unit = _DIFFERENCE * np.eye(5)
    first, second = np.triu_indices(5, k=1)
    across = unit[first] + unit[second]
    moves = np.concatenate([np.zeros((1, 5)), unit, -unit, across, -across])
    return np.asarray(point + moves)


def expanded_about(value: Floats) -> tuple[float, Floats, Floats]:
    """Return value, slopes (5,) and curvatures (5, 5) from the values (31,) at `around`.

    Examples
    --------
    >>> value, slope, _ = expanded_about(around(np.array([3.0, 0, 0, 0, 0])).sum(axis=1))
    >>> value, slope.round(9).tolist()
    (3.0, [1.0, 1.0, 1.0, 1.0, 1.0])
    """
    first, second = np.triu_indices(5, k=1)
    center, up, down = value[0], value[1:6], value[6:11]
    bent = up + down - 2 * center
    curvature = np.diag(bent)
    both = 0.5 * (value[11:21] + value[21:31] - 2 * center - bent[first] - bent[second])
    curvature[first, second] = curvature[second, first] = both
    return float(center), (up - down) / (2 * _DIFFERENCE), curvature / _DIFFERENCE**2


def smoothed(pairs: Floats, log_rate: Floats) -> Floats:
    """Return the probability of the fast state of every step, given all steps.

    Parameters
    ----------
    pairs : ndarray, shape (S, 2, 2)
        Weights of the pairs of states, as `SwitchingSteps.filtered` returns them.
    log_rate : ndarray, shape (2,)
        Logarithms of the rates of leaving the slow and the fast state, 1/s.

    Returns
    -------
    ndarray, shape (S,)

    Examples
    --------
    >>> smoothed(np.ones((3, 2, 2)), np.zeros(2))
    array([0.5, 0.5, 0.5])
    """
    rate = np.exp(log_rate)
    forward, backward = rate[::-1] / rate.sum(), np.ones(2)
    seen = np.empty((len(pairs), 2))
    for j, pair in enumerate(pairs):
        forward = forward @ pair
        forward = forward / forward.sum()
        seen[j] = forward
    fast = np.empty(len(pairs))
    for j in range(len(pairs) - 1, -1, -1):
        both = seen[j] * backward
        fast[j] = both[1] / both.sum()
        backward = pairs[j] @ backward
        backward = backward / backward.sum()
    return fast


def equalised_steps(motion: RigidMotion, quantity: Quantity) -> Steps:
    """Return steps along the axes of D, scaled so that every axis has the mean D of all.

    The noise is scaled alike. Unequal axes would widen the law of the lengths of the steps, as two
    states do. Translation, and rotation in the plane, are left as they are, and so is a rotation
    whose axes are not significantly unequal (p > 1 % by their scatter), or whose noise-corrected D
    along one axis is below a fifth of the mean: the ratio is then not known.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> body = Cluster.pentahedron(1.5)
    >>> truth = simulate_motion(body, D_R=[1e-3, 1e-3, 4e-3], dt=0.5, n_frames=3000, rng=3)
    >>> square = np.mean(equalised_steps(truth, "rotation").vectors ** 2, axis=0)
    >>> bool(np.ptp(square) < 0.1 * square.mean())
    True
    """
    steps = principal_steps(motion, quantity)
    if quantity == "translation" or motion.dimension == 2:
        return steps
    y, linked = steps.vectors, steps.linked[:-1]
    squares = 0.5 * y**2
    squares[:-1][linked] += (y[:-1] * y[1:])[linked]
    D = squares.mean(axis=0)
    if not D.min() > _LEAST_RATIO * D.mean():
        return steps
    apart = (squares - squares.mean(axis=1, keepdims=True))[:, 1:]
    mean = apart.mean(axis=0)
    if len(y) * mean @ np.linalg.solve(np.cov(apart.T), mean) < _UNEQUAL_AXES_TEST:
        return steps
    ratio = D / D.mean()
    noise = steps.noise / ratio[:, None]
    complete = steps.complete * float(np.mean(1 / ratio))
    return replace(steps, vectors=y / np.sqrt(ratio), noise=noise, complete=complete)


def fit_switching(
    motion: RigidMotion | Sequence[RigidMotion],
    *,
    quantity: Quantity = "rotation",
    noise: Literal["joint", "residual"] | float | Noise = "joint",
    exposure: float | None = None,
) -> SwitchingEstimate:
    """Fit two diffusion coefficients between which a motion switches at random times.

    Parameters
    ----------
    motion : RigidMotion or sequence of RigidMotion
        Motion; several motions share the coefficients and rates, and each has its own noise.
    quantity : {"rotation", "translation"}
        Body-frame rotation vectors, or displacements of the centre.
    noise : {"joint", "residual"}, float or Noise
        As in `estimate_diffusion`; a `Noise` with drift is refused.
    exposure : float, optional
        Open fraction f of dt, 0 to 1. Where it is unknown (None) the joint noise may be negative,
        but is the same in both states. Motion blur is larger in the fast one: D_fast then is low by
        the fraction f/3 (1 - D_slow/D_fast), so state the exposure of a long one.

    Returns
    -------
    SwitchingEstimate

    Raises
    ------
    TooFewFramesError
        If there are fewer than 20 steps, or a motion has fewer than two.
    ValueError
        For unknown or inconsistent choices, all in one message; if motions of 2 and 3 dimensions
        are given together; if nothing moves.

    Notes
    -----
    A step has the state that the body has at its beginning; the state is a Markov process in
    continuous time, so that a gap, or a cut, is a longer time in which it may change. The
    likelihood contains the noise that neighbouring steps share, and is maximised by Newton's method
    from the best point of a grid. Intervals come from its curvature in the logarithms of all
    parameters, noise included. D is the mean over axes in each state: the rotation of an
    anisotropic body is scaled to equal axes first, so that the ratio of the axes is the same in
    both states.

    Examples
    --------
    >>> from perrin import Cluster, Switching, simulate_motion
    >>> truth = simulate_motion(
    ...     Cluster.tetrahedron(1.5),
    ...     D_R=1e-3,
    ...     dt=1.0,
    ...     n_frames=200,
    ...     dynamics=Switching(10, dwell=20.0),
    ...     rng=3,
    ... )
    >>> found = fit_switching(truth)
    >>> found.two_states, found.D_slow.ci95[0] < 1e-3 * 2 / 11 < found.D_slow.ci95[1]
    (True, True)
    """
    motions = [motion] if isinstance(motion, RigidMotion) else list(motion)
    faults = [
        *choice_fault("quantity", quantity, get_args(Quantity)),
        *noise_faults(noise, exposure),
    ]
    if isinstance(noise, Noise) and noise.drift:
        faults.append("noise: expected no drift; subtract a steady motion first")
    if len({m.dimension for m in motions}) != 1:
        faults.append("motion: expected one or more motions, all in 2 or all in 3 dimensions")
    refuse(faults)
    settings = Noise.of(noise, exposure=exposure)
    found = fit_switching_each([motions], quantity=quantity, noise=settings)[0]
    if isinstance(found, ValueError):
        raise found
    return found


def fit_switching_each(
    pools: Sequence[Sequence[RigidMotion]], *, quantity: Quantity, noise: Noise
) -> list[SwitchingEstimate | ValueError]:
    """Fit two states to several pools of motions, each alone, as `fit_switching`; all together.

    Parameters
    ----------
    pools : sequence of sequence of RigidMotion
        Motions that share their coefficients and rates.
    quantity : {"rotation", "translation"}
    noise : Noise

    Returns
    -------
    list of SwitchingEstimate or ValueError
        The error that `fit_switching` raises, where there is no fit.

    Examples
    --------
    >>> from perrin import Cluster, Noise, Switching, simulate_motion
    >>> truth = simulate_motion(
    ...     Cluster.tetrahedron(1.5),
    ...     D_R=1e-3,
    ...     dt=1.0,
    ...     n_frames=100,
    ...     dynamics=Switching(10, dwell=20.0),
    ...     rng=3,
    ... )
    >>> one, two = fit_switching_each([[truth], [truth]], quantity="rotation", noise=Noise())
    >>> one.D_fast.value == two.D_fast.value
    True
    """
    searches: dict[int, _Search] = {}
    found: dict[int, SwitchingEstimate | ValueError] = {}
    asked: dict[int, _Requests] = {}
    # All searches take their steps at the same time, so that the motions are filtered together.
    for k, motions in enumerate(pools):
        searches[k] = _two_states(motions, quantity, noise)
        try:
            asked[k] = next(searches[k])
        except ValueError as error:
            found[k] = error
    while asked:
        answers = iter(filtered_each([one for requests in asked.values() for one in requests]))
        after = {}
        for k, requests in asked.items():
            try:
                after[k] = searches[k].send([next(answers) for _ in requests])
            except StopIteration as end:
                found[k] = end.value
        asked = after
    return [found[k] for k in range(len(pools))]


def _two_states(motions: Sequence[RigidMotion], quantity: Quantity, settings: Noise) -> _Search:
    """Search for the two states of a pool of motions; the estimate is what the search returns."""
    pooled_steps(motions, quantity)  # names the motion that has too few steps
    tracks = [NoisySteps.of(equalised_steps(m, quantity), settings) for m in motions]
    count = sum(len(t.steps.duration) for t in tracks)
    if count < _FEWEST_SWITCHING_STEPS:
        raise TooFewFramesError(
            f"{count} steps: two states need at least {_FEWEST_SWITCHING_STEPS}",
            sum(m.fitted.size for m in motions),
        )
    likelihood = Likelihood.of(tracks)
    one = likelihood.best() if likelihood.scale[0] > 0 else None
    if one is None or not one.D[0] > 0:
        raise ValueError("motion: the steps are all noise, D = 0; they show no two states")
    steps = [
        SwitchingSteps.of(t, m.time, exposed=(settings.exposure or 0.0) * t.steps.dt / 3)
        for t, m in zip(tracks, motions, strict=True)
    ]
    least = 1e-6 * likelihood.mean_square
    log_theta = np.log(np.maximum(one.theta, least))
    found = yield from _most_likely(steps, float(one.D[0]), log_theta)
    shared, value, covariance, pairs_of_each = found
    states, probability = [], []
    for track, m, pairs in zip(steps, motions, pairs_of_each, strict=True):
        fast = np.full(len(m.time), np.nan)
        fast[track.track.steps.stop] = smoothed(pairs, shared[2:])
        probability.append(fast)
        states.append(np.where(np.isnan(fast), -1, fast > 0.5).astype(np.int64))
    gain = value - float(one.value[0])
    errors = np.sqrt(np.diag(covariance)[:4])
    D_slow, D_fast, leave_slow, leave_fast = np.exp(shared)
    # D_mean = (k_fast D_slow + k_slow D_fast)/(k_slow + k_fast), and the slopes of its logarithm.
    p_fast = leave_slow / (leave_slow + leave_fast)
    mean = (1 - p_fast) * D_slow + p_fast * D_fast
    tilt = p_fast * (1 - p_fast) * (D_fast - D_slow)
    slopes = np.array([(1 - p_fast) * D_slow, p_fast * D_fast, tilt, -tilt]) / mean
    mean_error = float(np.sqrt(slopes @ covariance[:4, :4] @ slopes))
    unit = UNITS[quantity]
    return SwitchingEstimate(
        D_slow=Parameter.log_normal(D_slow, errors[0], unit),
        D_fast=Parameter.log_normal(D_fast, errors[1], unit),
        D_mean=Parameter.log_normal(mean, mean_error, unit),
        dwell_slow=Parameter.log_normal(1 / leave_slow, errors[2], "s"),
        dwell_fast=Parameter.log_normal(1 / leave_fast, errors[3], "s"),
        states=tuple(states),
        probability=tuple(probability),
        log_likelihood_gain=gain,
        bic_gain=gain - 0.5 * _MORE_PARAMETERS * float(np.log(count)),
        n_frames=sum(m.fitted.size for m in motions),
        unit=unit,
    )


def _most_likely(
    steps: Sequence[SwitchingSteps], D: float, log_theta: Floats
) -> Generator[_Requests, _Answers, tuple[Floats, float, Floats, list[Floats]]]:
    """Search for the most likely parameters: shared (4,), value, covariance, weights of states.

    The points at which the likelihood is needed are yielded. `D` and `log_theta` (G,) are those of
    one D; the parameters are logarithms, and the covariance is that of all of them, noise included,
    NaN where the data do not bound a parameter. The weights are those of every motion.
    """
    dt = float(np.median(np.concatenate([s.track.steps.duration for s in steps])))
    grid = np.array(
        [
            (slow * D, fast * D, 1 / (dwell * dt), 1 / (dwell * dt), less)
            for slow in _START_SLOW
            for fast in _START_FAST
            for dwell in _START_DWELL
            for less in _START_NOISE
        ]
    )
    moved = np.log(grid)
    trials = [moved + np.array([0, 0, 0, 0, own]) for own in log_theta]
    filtered = yield list(zip(steps, trials, strict=True))
    height = np.sum([values for values, _ in filtered], axis=0)
    best = moved[np.argmax(height)]
    x = np.concatenate([best[:4], best[4] + log_theta])
    longest = max(float(s.elapsed.sum()) for s in steps) + dt
    slowest, quickest = np.log(0.1 / longest), np.log(3.0 / dt)
    fixed = np.array([False] * 4 + [not s.free for s in steps])

    def expanded(
        x: Floats,
    ) -> Generator[_Requests, _Answers, tuple[float, Floats, Floats, list[Floats]]]:
        value, slope, curvature = 0.0, np.zeros(len(x)), np.zeros((len(x), len(x)))
        every = [np.array([0, 1, 2, 3, 4 + g]) for g in range(len(steps))]
        filtered = yield [(s, around(x[rows])) for s, rows in zip(steps, every, strict=True)]
        for rows, (values, _) in zip(every, filtered, strict=True):
            part = expanded_about(values)
            value += part[0]
            slope[rows] += part[1]
            curvature[np.ix_(rows, rows)] += part[2]
        weights = [pairs for _, pairs in filtered]  # at the point itself
        return value, np.where(fixed, 0.0, slope), curvature, weights

    here, damping = (yield from expanded(x)), 1e-3
    for _ in range(_NEWTON_ROUNDS):
        value, slope, curvature, weights = here
        free = ~fixed
        # A rate at the end of its range stays there unless the slope leads away from it.
        free[2:4] &= ~((x[2:4] <= slowest) & (slope[2:4] < 0))
        free[2:4] &= ~((x[2:4] >= quickest) & (slope[2:4] > 0))
        kept = np.ix_(free, free)
        scale = np.diag(np.abs(np.diag(curvature)[free]) + 1e-6)
        values, axes = np.linalg.eigh(-curvature[kept] + damping * scale)
        step = np.zeros(len(x))
        step[free] = axes @ ((axes.T @ slope[free]) / np.maximum(np.abs(values), 1e-3))
        step *= min(1.0, 1.0 / max(float(np.abs(step).max()), 1e-300))
        if slope @ step < _CONVERGED:
            break
        trial = x + step
        trial[2:4] = np.clip(trial[2:4], slowest, quickest)
        there = -np.inf, slope, curvature, weights
        if trial[0] <= trial[1]:
            there = yield from expanded(trial)
        if there[0] >= value:
            x, here, damping = trial, there, damping / 10
        else:
            damping *= 10
    information = -here[2][np.ix_(~fixed, ~fixed)]
    covariance = np.zeros((len(x), len(x)))
    try:
        inverse = np.linalg.inv(information)
    except np.linalg.LinAlgError:
        inverse = np.full_like(information, np.nan)
    inverse[np.diag(inverse) <= 0] = np.nan
    covariance[np.ix_(~fixed, ~fixed)] = inverse
    return x[:4], here[0], covariance, here[3]
