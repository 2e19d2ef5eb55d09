"""How likely steps are: vectors of any length, one tensor D, noise shared by neighbours."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from perrin._arrays import Bools, Floats, frozen

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from typing import TypeAlias

    # D (b, b) and its slopes (m, b, b) by the m parameters of a family of tensors.
    Family: TypeAlias = Callable[[Floats], tuple[Floats, Floats]]


# Frames are alike, and the quick kernel serves, if times and noise agree to this.
_ALIKE = 1e-9


# The largest blur: all motion seen in the first and last instant of a frame (1/6: open shutter).
_MOST_BLUR = 0.25


# Where D and noise have the same shape only noise less blur is determined; then this slope of the
# log-likelihood chooses the answer with the least blur. It weighs 0.025 in all.
_LEAST_BLUR = 0.1


# A search has settled where another step would gain this much: 5e-9 standard errors. Under the
# second figure rounding hides a gain, and steps are taken on trust.
_SETTLED, _HIDDEN = 1e-17, 1e-9


# Step of numerical derivatives, in scaled units where all parameters are of order 1.
_NUDGE = 1e-5


class Slopes(NamedTuple):
    """A log-likelihood and its derivatives by D (b, b), by the noise amplitudes (r,) and by B."""

    value: float
    D: Floats
    theta: Floats
    B: float


@dataclass(frozen=True, eq=False)
class VectorSteps:
    """The steps of one motion, each a vector of b numbers.

    Step i over the time tau_i has covariance 2 D tau_i + O_i + O_{i+1}, and -O_{i+1} with step
    i + 1 where the two share a frame; O_k = sum_j theta_j C_jk - 2 B dt D is the noise of frame k,
    less the blur of its exposure.

    Attributes
    ----------
    y : ndarray, shape (S, b)
    tau : ndarray, shape (S,)
        s.
    begin, end : ndarray, shape (r, S, b, b)
        Noise shapes C_j of the first and the last frame of each step.
    linked : ndarray of bool, shape (S,)
        Whether a step ends in the frame where the next one begins; False for the last.
    dt : float
        The time between frames that the blur refers to, s.
    """

    y: Floats
    tau: Floats
    begin: Floats
    end: Floats
    linked: Bools
    dt: float

    def __post_init__(self) -> None:
        frozen(self.y, self.tau, self.begin, self.end, self.linked)

    @cached_property
    def even(self) -> bool:
        """Whether all steps are alike and linked, so that a sine transform separates them."""
        uneven = max(np.ptp(self.begin, axis=1).max(), np.abs(self.end - self.begin).max())
        size = max(float(np.abs(self.begin).max()), np.finfo(np.float64).tiny)
        return bool(
            self.linked[:-1].all()
            and np.ptp(self.tau) <= _ALIKE * self.tau[0]
            and uneven <= _ALIKE * size
        )

    @cached_property
    def _spectrum(self) -> tuple[Floats, Floats]:
        """Return the sine transform of the steps and the weight 2 (1 - cos) of the noise in it."""
        from scipy.fft import dst

        count = len(self.y)
        weight = 2 * (1 - np.cos(np.pi * np.arange(1, count + 1) / (count + 1)))
        return dst(self.y, type=1, norm="ortho", axis=0), weight

    def slopes(self, D: Floats, theta: Floats, B: float) -> Slopes:
        """Return the log-likelihood and its derivatives; -inf where it is not defined."""
        return self.by_sines(D, theta, B) if self.even else self.by_bands(D, theta, B)

    def by_sines(self, D: Floats, theta: Floats, B: float) -> Slopes:
        """Evaluate even steps: mode k of the sine transform has covariance 2 D tau + w_k O.

        All modes are diagonal in the axes that diagonalise D against 2 D tau + 2 O.
        """
        z, w = self._spectrum
        shapes, tau = self.begin[:, 0], float(self.tau[0])
        noise = np.tensordot(theta, shapes, 1) - 2 * B * self.dt * D
        middle = 2 * tau * D + 2 * noise
        try:
            root = np.linalg.inv(np.linalg.cholesky(middle))
        except np.linalg.LinAlgError:
            return _nowhere(D, theta)
        share, turn = np.linalg.eigh(root @ (2 * tau * D) @ root.T)
        axes = root.T @ turn
        power = share + 0.5 * w[:, None] * (1 - share)
        if not power.min() > 0:
            return _nowhere(D, theta)
        u = z @ axes
        q = u / power
        inverse = 1 / power
        plain = axes @ (q.T @ q - np.diag(inverse.sum(0))) @ axes.T
        weighted = axes @ (q.T @ (w[:, None] * q) - np.diag(w @ inverse)) @ axes.T
        log_det = np.log(power).sum() - 2 * len(z) * np.log(np.diag(root)).sum()
        value = -0.5 * (log_det + np.sum(u * q))
        by_theta = 0.5 * np.einsum("jab,ab->j", shapes, weighted)
        return self._assembled(value, tau * plain, weighted, by_theta, D, B)

    def by_bands(self, D: Floats, theta: Floats, B: float) -> Slopes:
        """Evaluate any steps by banded Cholesky factors of their covariance.

        With P and Q the pivot blocks of the elimination from above and from below and A the
        diagonal blocks, the diagonal blocks of the inverse are (P + Q - A)^-1; those beside them
        are -P^-1 times the block beside A times the next diagonal one.
        """
        from scipy.linalg.lapack import dpbtrs

        blur = 2 * B * self.dt * D
        first = np.tensordot(theta, self.begin, 1) - blur
        last = np.tensordot(theta, self.end, 1) - blur
        diagonal = 2 * D * self.tau[:, None, None] + first + last
        beside = -last[:-1] * self.linked[:-1, None, None]
        down, pivots, log_det = _factor(diagonal, beside)
        _, up_pivots, log_up = _factor(diagonal[::-1], beside[::-1])
        if not np.isfinite(log_det + log_up):
            return _nowhere(D, theta)
        solved, _ = dpbtrs(down, self.y.reshape(-1), lower=1)
        z = solved.reshape(self.y.shape)
        inverse = _inverses(pivots + up_pivots[::-1] - diagonal)
        across = -_inverses(pivots[:-1]) @ (beside @ inverse[1:])
        same = z[:, :, None] * z[:, None, :] - inverse
        next_one = (z[:-1, :, None] * z[1:, None, :] - across) * self.linked[:-1, None, None]
        value = -0.5 * (log_det + np.sum(self.y * z))
        weighted = 2 * same.sum(0) - next_one.sum(0) - next_one.sum(0).T
        by_theta = 0.5 * np.einsum("jsab,sab->j", self.begin + self.end, same)
        by_theta -= np.einsum("jsab,sab->j", self.end[:, :-1], next_one)
        return self._assembled(value, np.tensordot(self.tau, same, 1), weighted, by_theta, D, B)

    def _assembled(
        self, value: float, timed: Floats, weighted: Floats, by_theta: Floats, D: Floats, B: float
    ) -> Slopes:
        """Return the slopes from the sums over steps that belong to 2 D tau and to O."""
        by_B = -self.dt * float(np.sum(weighted * D))
        return Slopes(float(value), timed - B * self.dt * weighted, by_theta, by_B)


def _nowhere(D: Floats, theta: Floats) -> Slopes:
    """Return what stands where a covariance is not positive definite."""
    return Slopes(-np.inf, np.full_like(D, np.nan), np.full_like(theta, np.nan), np.nan)


def _factor(diagonal: Floats, beside: Floats) -> tuple[Floats, Floats, float]:
    """Return the banded Cholesky factor of a block tridiagonal matrix, its pivots and log det."""
    from scipy.linalg.lapack import dpbtrf

    count, b, _ = diagonal.shape
    band = np.zeros((count, b, 2 * b))
    for j in range(b):
        band[:, j, : b - j] = diagonal[:, j:, j]
        band[:-1, j, b - j : 2 * b - j] = beside[:, :, j]
    factor, bad = dpbtrf(band.reshape(-1, 2 * b).T, lower=1, overwrite_ab=1)
    if bad:
        return factor, diagonal, np.inf
    columns = factor.T.reshape(count, b, 2 * b)
    lower = np.zeros_like(diagonal)
    for j in range(b):
        lower[:, j:, j] = columns[:, j, : b - j]
    return factor, lower @ np.swapaxes(lower, 1, 2), 2 * float(np.log(factor[0]).sum())


def _inverses(a: Floats) -> Floats:
    """Return the inverses of symmetric matrices (S, b, b), by cofactors where b = 3: quicker."""
    if a.shape[1] != 3:
        return np.asarray(np.linalg.inv(a))
    i, j = np.array([1, 2, 0]), np.array([2, 0, 1])
    cofactor = a[:, i][:, :, i] * a[:, j][:, :, j] - a[:, i][:, :, j] * a[:, j][:, :, i]
    determinant = np.einsum("sb,sb->s", a[:, 0], cofactor[:, 0])
    inverse: Floats = cofactor / determinant[:, None, None]
    return inverse


@dataclass(frozen=True, eq=False)
class Source:
    """The steps of one motion, and what is known of their noise beforehand.

    Attributes
    ----------
    steps : VectorSteps
    theta : ndarray, shape (r,)
        Noise amplitudes: known, measured, or a first guess.
    weight : float
        Degrees of freedom of that measurement; 0 for a guess, inf where they are known.
    B : float or None
        Blur coefficient, exposure/6; None unknown.
    """

    steps: VectorSteps
    theta: Floats
    weight: float
    B: float | None

    def start(self) -> Floats:
        """Return the free parameters of the noise to start from: square roots, then an angle."""
        amplitudes = np.sqrt(self.theta) if np.isfinite(self.weight) else np.empty(0)
        return np.append(amplitudes, [0.6] if self.B is None else [])

    def slopes(self, D: Floats, own: Floats) -> tuple[float, Floats, Floats]:
        """Return log-likelihood, its slopes by D, and by the free parameters of the noise.

        Amplitudes are squares and B = sin^2 / 4, so that no edge needs watching.
        """
        free = np.isfinite(self.weight)
        roots, angle = (own[: len(self.theta)] if free else np.empty(0)), own[-1:]
        theta = roots**2 if free else self.theta
        B = _MOST_BLUR * float(np.sin(angle[0])) ** 2 if self.B is None else self.B
        value, by_D, by_theta, by_B = self.steps.slopes(D, theta, B)
        out = []
        if free:
            if self.weight:
                ratio = self.theta / theta
                value -= 0.5 * self.weight * float(np.sum(ratio - np.log(ratio)))
                by_theta = by_theta - 0.5 * self.weight * (1 - ratio) / theta
            out.append(2 * roots * by_theta)
        if self.B is None:
            value -= _LEAST_BLUR * B
            out.append((by_B - _LEAST_BLUR) * _MOST_BLUR * np.sin(2 * angle))
        return value, by_D, np.concatenate([np.empty(0), *out])

    def noise(self, D: Floats, own: Floats) -> Floats:
        """Return the mean noise O of a frame, (b, b), blur taken off."""
        free = np.isfinite(self.weight)
        theta = own[: len(self.theta)] ** 2 if free else self.theta
        B = _MOST_BLUR * float(np.sin(own[-1])) ** 2 if self.B is None else self.B
        shape = 0.5 * (self.steps.begin + self.steps.end).mean(axis=1)
        offset: Floats = np.tensordot(theta, shape, 1) - 2 * B * self.steps.dt * D
        return offset


def squares(basis: Floats) -> Family:
    """Return the family D = L^2 with L = sum q_j E_j: all tensors >= 0 that share a symmetry.

    The basis (m, b, b) spans the symmetric matrices that the symmetry leaves alone; with L also
    L^2 is left alone.
    """

    def family(q: Floats) -> tuple[Floats, Floats]:
        root = np.tensordot(q, basis, 1)
        slope = basis @ root
        return root @ root, slope + np.swapaxes(slope, 1, 2)

    return family


def axial(axis: Floats) -> Family:
    """Return the tensors a^2 across and c^2 along an axis that may tilt away from this one.

    The parameters are a, c and the tilt along the two directions across.
    """
    across = np.linalg.svd(axis[None])[2][1:]

    def family(q: Floats) -> tuple[Floats, Floats]:
        v = axis + q[2:] @ across
        u = v / np.linalg.norm(v)
        along = np.outer(u, u)
        tilt = (across - np.outer(across @ u, u)) / np.linalg.norm(v)
        turned = np.einsum("ka,b->kab", tilt, u)
        span = q[1] ** 2 - q[0] ** 2
        slopes = [2 * q[0] * (np.eye(3) - along), 2 * q[1] * along]
        slopes += list(span * (turned + np.swapaxes(turned, 1, 2)))
        return q[0] ** 2 * (np.eye(3) - along) + q[1] ** 2 * along, np.array(slopes)

    return family


class Maximum(NamedTuple):
    """The greatest likelihood of a family: value, D (b, b), free noise parameters (G, c)."""

    value: float
    D: Floats
    own: Floats


def maximise(sources: Sequence[Source], family: Family, q: Floats, own: Floats) -> Maximum:
    """Return the maximum over a family of D, common to all, and over the noise of each source.

    A quasi-Newton search (BFGS) from a true Hessian, which is taken anew where the search stands
    still or has not settled after many steps. It ends at a root of the slopes.
    """
    problem = _Problem(sources, family, len(q), own.shape)
    p = np.concatenate([q, own.ravel()])
    value, slope = problem.slopes(p)
    for _ in range(20):
        inverse = problem.arrow(p).inverse()
        for _ in range(30):
            step = inverse @ slope
            gain = 0.5 * float(slope @ step)
            if gain <= _SETTLED:
                return Maximum(value, *problem.parts(p))
            trial = problem.climbed(p, value, step, gain)
            if trial is None:
                break
            new, new_value, new_slope = trial
            inverse = _updated(inverse, new - p, slope - new_slope)
            p, value, slope = new, new_value, new_slope
    if gain <= _HIDDEN:
        return Maximum(value, *problem.parts(p))
    raise ValueError(
        f"the likelihood of these {sum(len(s.steps.y) for s in sources)} steps has no maximum that "
        "a search settles at: they hold too little about diffusion and noise; take longer tracks"
    )


def spread(sources: Sequence[Source], best: Maximum, basis: Floats) -> tuple[Floats, Floats]:
    """Return directions of D (m, b, b) and the covariance (m, m) of the error along them.

    From the observed information, the noise left free. The directions F E_j F, with F the root of
    D, are of the size of D itself: its small values may be thousands of times below the others. The
    covariance is NaN where the information is not positive.
    """
    values, axes = np.linalg.eigh(best.D)
    root = (axes * np.sqrt(np.maximum(values, 1e-4 * values[-1]))) @ axes.T
    directions = root @ basis @ root

    def family(q: Floats) -> tuple[Floats, Floats]:
        return best.D + np.tensordot(q, directions, 1), directions

    problem = _Problem(sources, family, len(basis), best.own.shape)
    known = problem.arrow(np.append(np.zeros(len(basis)), best.own)).information()
    if not (np.isfinite(known).all() and np.linalg.eigvalsh(known)[0] > 0):
        return directions, np.full_like(known, np.nan)
    return directions, np.asarray(np.linalg.inv(known))


@dataclass(frozen=True, eq=False)
class _Problem:
    """A likelihood as a function of one list of numbers: those of the family, then the noise's."""

    sources: Sequence[Source]
    family: Family
    m: int
    shape: tuple[int, ...]

    def parts(self, p: Floats) -> tuple[Floats, Floats]:
        """Return D and the noise parameters (G, c)."""
        return self.family(p[: self.m])[0], p[self.m :].reshape(self.shape)

    def slopes(self, p: Floats) -> tuple[float, Floats]:
        """Return the log-likelihood and its slopes."""
        D, jacobian = self.family(p[: self.m])
        own = p[self.m :].reshape(self.shape)
        found = [s.slopes(D, o) for s, o in zip(self.sources, own, strict=True)]
        by_q = np.einsum("ab,kab->k", np.sum([part[1] for part in found], axis=0), jacobian)
        return sum(part[0] for part in found), np.concatenate([by_q, *(f[2] for f in found)])

    def climbed(
        self, p: Floats, value: float, step: Floats, gain: float
    ) -> tuple[Floats, float, Floats] | None:
        """Go along a step, shortened until the likelihood rises; None if it never does."""
        for part in 0.4 ** np.arange(16):
            new_value, slope = self.slopes(p + part * step)
            rises = new_value > value + 1e-3 * part * gain
            if rises or (gain <= _HIDDEN and np.isfinite(new_value)):
                return p + part * step, new_value, slope
        return None

    def arrow(self, p: Floats) -> Arrow:
        """Return minus the Hessian by central differences.

        The noise of one source leaves the slopes of the others alone, so all move at once.
        """
        count, c = self.shape
        shared, mixed = np.empty((self.m, self.m)), np.empty((count, self.m, c))
        for k in range(self.m):
            change = self._change(p, np.eye(len(p))[k])
            shared[k], mixed[:, k] = change[: self.m], change[self.m :].reshape(self.shape)
        own = np.empty((count, c, c))
        for k in range(c):
            toward = np.append(np.zeros(self.m), np.tile(np.eye(c)[k], count))
            own[:, k] = self._change(p, toward)[self.m :].reshape(self.shape)
        return Arrow(0.5 * (shared + shared.T), mixed, 0.5 * (own + np.swapaxes(own, 1, 2)))

    def _change(self, p: Floats, toward: Floats) -> Floats:
        """Return minus the derivative of the slopes along a direction."""
        ahead, behind = (self.slopes(p + h * toward)[1] for h in (_NUDGE, -_NUDGE))
        change: Floats = (behind - ahead) / (2 * _NUDGE)
        return change


@dataclass(frozen=True, eq=False)
class Arrow:
    """Minus a Hessian whose sources meet in D alone: (m, m), (G, m, c) and (G, c, c) blocks."""

    shared: Floats
    mixed: Floats
    own: Floats

    def inverse(self) -> Floats:
        """Return the inverse (m + Gc, m + Gc), its negative curvatures turned positive."""
        count, m, c = self.mixed.shape
        own = _positive_inverse(self.own)
        lever = self.mixed @ own
        shared = _positive_inverse(self.shared - np.einsum("gmc,gnc->mn", lever, self.mixed))
        tail = -np.swapaxes(lever, 1, 2).reshape(count * c, m)
        inverse = np.empty((m + count * c,) * 2)
        inverse[:m, :m] = shared
        inverse[m:, :m] = tail @ shared
        inverse[:m, m:] = inverse[m:, :m].T
        inverse[m:, m:] = tail @ shared @ tail.T
        for g in range(count):
            rows = slice(m + g * c, m + (g + 1) * c)
            inverse[rows, rows] += own[g]
        return inverse

    def information(self) -> Floats:
        """Return the information on what is shared, the noise of every source left free."""
        solved = np.linalg.solve(self.own, np.swapaxes(self.mixed, 1, 2))
        information: Floats = self.shared - np.einsum("gmc,gcn->mn", self.mixed, solved)
        return information


def _positive_inverse(a: Floats) -> Floats:
    """Return the inverse of symmetric matrices (..., c, c) with the sizes of their eigenvalues."""
    values, vectors = np.linalg.eigh(a)
    size = np.abs(values)
    size = np.maximum(size, 1e-9 * size.max(axis=-1, keepdims=True, initial=1e-300))
    inverse: Floats = (vectors / size[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    return inverse


def _updated(inverse: Floats, step: Floats, fall: Floats) -> Floats:
    """Return the BFGS update of an inverse Hessian; as it is where the curvature is not positive.

    `fall` is by how much the slopes fell along the step.
    """
    along = float(step @ fall)
    if not along > 1e-14 * float(np.linalg.norm(step) * np.linalg.norm(fall)):
        return inverse
    pull = inverse @ fall
    cross = np.outer(pull, step)
    new: Floats = inverse - (cross + cross.T) / along
    return new + np.outer(step, step) * ((1 + fall @ pull / along) / along)
