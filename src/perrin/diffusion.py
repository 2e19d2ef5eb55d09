"""How fast it diffuses: D_R and D_T from the steps by likelihood."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Literal

import numpy as np

from perrin._arrays import Bools, Floats, Ints, TooFewFramesError
from perrin.motion import RigidMotion

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

Quantity = Literal["rotation", "translation"]
UNITS = {"rotation": "rad^2/s", "translation": "um^2/s"}
_CHI2 = {0.68: 0.9889, 0.95: 3.8415}  # quantiles of chi-squared with one degree of freedom

# Lowest and highest logarithmic distance of an offset to its least value, in units of the mean
# square step. Without diffusion a long track needs an offset far above that.
_EDGE, _TOP = -30.0, 60.0

# A group of steps this much smaller (mean square) than another one's does not move at all.
_REST = 1e-24

# Adding noisy body-frame steps turns noise into diffusion at second order: a motionless tetrahedron
# reads D = 0.04 (sigma/R)^4/dt. Below ten times that a D_R is not resolved.
_FLOOR = 0.04
_RESOLVED = 10.0


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
        D dt/s, s the noise variance predicted from the rigid-fit residuals; inf without noise.
    dt : float
        Time between frames, s, mean over the motions; NaN where there was none to tell.
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

    def __str__(self) -> str:
        name = "D_R" if self.unit == UNITS["rotation"] else "D_T"
        tail = f"{self.unit} [{self.method}, {self.n_frames} frames]"
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
    method: Literal["mle"] = "mle",
    noise: Literal["joint"] = "joint",
) -> DiffusionEstimate:
    """Estimate D_R or D_T from the steps of a motion by maximum likelihood, noise included.

    Parameters
    ----------
    motion : RigidMotion or sequence of RigidMotion
        Several are pooled: one D, each with its own noise.
    quantity : {"rotation", "translation"}
        D_R from body-frame rotation vectors, or D_T from the centre. For an anisotropic body the
        value is the mean over the three axes (trace/3).
    method : {"mle"}
        Maximum likelihood.
    noise : {"joint"}
        The noise offset is estimated along with D. It may be negative, as under motion blur.

    Returns
    -------
    DiffusionEstimate
        With profile-likelihood intervals.

    Raises
    ------
    TooFewFramesError
        Fewer than 3 frames with a pose, or no step.
    ValueError
        For an unknown quantity, method or noise, or motions of 2 and 3 dimensions together.

    Notes
    -----
    Steps over a time t between frames k and k + 1 have variance 2 D t + o_k + o_{k+1} and
    neighbours covariance -o_{k+1}: a tridiagonal likelihood, linear in the number of frames, in
    which a gap is one longer step. o_k = o + e_k; the offset o, one for each motion, is free, and
    e_k is by how much the noise predicted from the rigid-fit residuals exceeds that of the best
    known frame and axis (particles missing, a body with unequal axes).

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=3)
    >>> print(estimate_diffusion(truth))
    D_R = 0.0050(4) rad^2/s [mle, 300 frames]
    """
    motions = [motion] if isinstance(motion, RigidMotion) else list(motion)
    _check_choices(motions, quantity=quantity, method=method, noise=noise)
    likelihood = _Likelihood.of(motions, quantity=quantity)
    value = likelihood.best_value()
    ci68, ci95 = (likelihood.interval(value, _CHI2[level]) for level in (0.68, 0.95))
    offset, offset_stderr = likelihood.offset_at(value)
    spread, floor = _predicted_spread(motions, quantity), None
    if quantity == "rotation":
        floor = float(np.mean([_FLOOR * (m.sigma / m.R) ** 4 / m.dt for m in motions]))
    dt = float(np.mean([m.dt for m in motions]))
    return DiffusionEstimate(
        value=value,
        ci68=ci68,
        ci95=ci95,
        stderr=(ci68[1] - ci68[0]) / 2,
        offset=offset,
        offset_stderr=offset_stderr,
        resolution_floor=floor,
        resolved=bool(ci95[0] > 0 and value > _RESOLVED * (floor or 0.0)),
        unit=UNITS[quantity],
        method=method,
        n_frames=sum(m.fitted.size for m in motions),
        snr=value * dt / spread if spread > 0 else np.inf,
        dt=dt,
    )


def _check_choices(
    motions: Sequence[RigidMotion], *, quantity: str, method: str, noise: str
) -> None:
    """Refuse what is not offered, and motions that cannot be pooled or are too short."""
    faults = [
        f"{name}: expected {' or '.join(map(repr, offered))}, got {got!r}"
        for name, got, offered in (
            ("quantity", quantity, tuple(UNITS)),
            ("method", method, ("mle",)),
            ("noise", noise, ("joint",)),
        )
        if got not in offered
    ]
    if len({m.template.shape[1] for m in motions}) != 1:
        faults.append("motion: expected one or more motions, all in 2 or all in 3 dimensions")
    if faults:
        raise ValueError("; ".join(faults))
    for i, m in enumerate(motions):
        if len(m.steps()[0]) < 2:
            raise TooFewFramesError(
                f"motion {i} has {m.fitted.size} frames with a pose in too few steps: at least 3 "
                "in a row (gaps allowed) are needed to tell diffusion from noise",
                int(m.fitted.size),
            )


def _predicted_spread(motions: Sequence[RigidMotion], quantity: str) -> float:
    """Return the noise variance of one orientation or centre coordinate, mean over axes."""

    def spread(m: RigidMotion) -> float:
        if quantity == "translation":
            return float(np.nanmean(m.center_variance))
        c = m.covariance[m.fitted]
        return float(np.trace(c, axis1=1, axis2=2).mean() / c.shape[-1])

    return float(np.mean([spread(m) for m in motions]))


@dataclass(frozen=True, eq=False)
class _Likelihood:
    """The Gaussian likelihood of all steps, stacked to one tridiagonal system.

    Step i has variance 2 D tau + 2 o + e0 + e1 and covariance -(o + e1) with step i + 1 where the
    two share a frame (`linked`); o is the noise offset of the step's `group`, e0 and e1 the known
    excess of its two frames, `level` the mean excess of a group's complete frames.
    """

    y: Floats
    tau: Floats
    e0: Floats
    e1: Floats
    linked: Floats
    group: Ints
    level: Floats

    @classmethod
    def of(cls, motions: Sequence[RigidMotion], *, quantity: str) -> _Likelihood:
        """Stack the steps of every axis of every motion; the axes of a motion share its offset."""
        parts: list[tuple[Floats, Floats, Floats, Floats, Floats]] = []
        groups: list[int] = []
        levels: list[float] = []
        for number, m in enumerate(motions):
            start, stop = m.steps()
            y, excess = _rotation_steps(m) if quantity == "rotation" else _translation_steps(m)
            tau = m.time[stop] - m.time[start]
            linked = np.append(start[1:] == stop[:-1], False).astype(np.float64)
            for axis in range(y.shape[1]):
                parts.append((y[:, axis], tau, excess[start, axis], excess[stop, axis], linked))
                groups.append(number)
            levels.append(float(np.nanmean(excess[_complete(m)])))
        group = np.repeat(np.array(groups), [len(part[0]) for part in parts])
        y_all, tau_all, e0, e1, linked_all = (np.concatenate(c) for c in zip(*parts, strict=True))
        return cls(y_all, tau_all, e0, e1, linked_all, group, np.array(levels))

    @cached_property
    def _starts(self) -> Ints:
        return np.flatnonzero(np.diff(self.group, prepend=-1))

    @cached_property
    def _power(self) -> Floats:
        """Mean square step of each group: the scale of its noise offset."""
        power = self._per_group(self.y**2) / self._per_group(np.ones_like(self.y))
        floor: Floats = np.maximum(power, _REST * power.max())
        return floor

    @cached_property
    def _scale(self) -> float:
        """Return the D that would explain all the motion without noise: the scale of D."""
        return float(np.sum(self.y**2) / np.sum(2 * self.tau))

    @cached_property
    def _least(self) -> Floats:
        """Return the least offset over D of each group, the blur of a shutter that never closes."""
        return -0.5 * np.minimum.reduceat(self.tau, self._starts)

    def _per_group(self, x: Floats) -> Floats:
        total: Floats = np.add.reduceat(x, self._starts)
        return total

    def _evaluate(self, D: float, offset: Floats) -> tuple[float, float, Floats, Floats]:
        """Return the log-likelihood, its slope in D, its slopes in the offsets, and their tilts.

        A slope is half of z.A.z - tr(C^-1 A), with C the covariance, A its slope and z = C^-1 y;
        the tilt is the logarithm of the ratio of the two. The inverse of a tridiagonal matrix has
        the diagonal 1/(d + d' - a), with d and d' the pivots of the elimination from above and from
        below, and Z_{i,i+1} = -l_i Z_{i+1,i+1}.
        """
        from scipy.linalg.lapack import dpttrf, dpttrs

        o = offset[self.group]
        a = 2 * (D * self.tau + o) + (self.e0 + self.e1)
        b = -((o + self.e1) * self.linked)[:-1]
        d, lower, bad = dpttrf(a, b)
        up, _, bad_up = dpttrf(a[::-1], b[::-1])
        if bad or bad_up:
            return -np.inf, np.nan, np.full(len(offset), np.nan), np.full(len(offset), _TOP)
        z, _ = dpttrs(d, lower, self.y)
        inverse, square = 1 / (d + up[::-1] - a), z * z
        up_hill = self._per_group(square - self.linked * np.append(z[:-1] * z[1:], 0.0))
        down_hill = self._per_group(inverse + self.linked * np.append(lower * inverse[1:], 0.0))
        value = -0.5 * float(np.sum(np.log(d)) + self.y @ z)
        slope = float(self.tau @ (square - inverse))
        tilt = np.log(np.maximum(up_hill / down_hill, np.exp(-_TOP)))  # nothing moves: downhill
        return value, slope, up_hill - down_hill, tilt

    def ridge(
        self, D: float, guess: Floats | None = None, tolerance: float = 1e-12
    ) -> tuple[float, float, Floats]:
        """Maximise over the offsets at one D: return value, slope along the ridge, offsets.

        Each offset is the root of its own tilt, all groups at once, by secant steps inside a
        shrinking bracket; their coordinate t is the logarithm of the distance to the least value,
        near which the likelihood falls off a cliff. Logarithms make the secant nearly straight.
        """
        least, power = self._least * D, self._power
        low, high = np.full(len(power), _EDGE), np.full(len(power), _TOP)
        start = 0.5 * power if guess is None else guess
        old = np.log(np.maximum((start - least) / power, 1e-6))
        old_tilt = self._evaluate(D, least + power * np.exp(old))[3]
        t = np.clip(old + np.copysign(1e-3, old_tilt), low, high)
        for _ in range(100):
            offset = least + power * np.exp(t)
            value, slope_D, slopes, tilt = self._evaluate(D, offset)
            low, high = np.where(tilt > 0, t, low), np.where(tilt > 0, high, t)
            target = _secant(t, tilt, old, old_tilt, low, high)
            moves = np.minimum(np.abs(target - t), np.abs(t - old))
            done = (moves <= tolerance) | (high <= _EDGE)
            if done.all():
                break
            old, old_tilt, t = t, tilt, np.where(done, t, target)
        # At its edge an offset moves by `least` times the change of D; at a root that is no matter.
        edge = np.where(t < _EDGE + 1, self._least * slopes, 0.0)
        return value, slope_D + float(edge.sum()), offset

    def _follower(self, tolerance: float) -> Callable[[float], tuple[float, float, Floats]]:
        """Return `ridge` as a function of D that starts from where its last two calls ended."""
        trail: list[tuple[float, Floats]] = []
        known: dict[float, tuple[float, float, Floats]] = {}

        def follow(D: float) -> tuple[float, float, Floats]:
            if D in known:
                return known[D]
            guess = trail[-1][1] if trail else None
            if len(trail) > 1 and trail[-1][0] != trail[-2][0]:
                (D0, o0), (D1, o1) = trail[-2:]
                guess = o1 + (o1 - o0) * (D - D1) / (D1 - D0)
            found = self.ridge(D, guess, tolerance)
            trail.append((D, found[2]))
            known[D] = found
            return found

        return follow

    def best_value(self) -> float:
        """Return the D of greatest likelihood: the highest root of the slope along the ridge, or 0.

        Short tracks can have several roots, so the whole range is searched.
        """
        from scipy.optimize import brentq

        if self._scale == 0:
            return 0.0
        follow = self._follower(1e-11)
        D = [0.0, *(self._scale * 4.0 ** np.arange(-7, 1)).tolist()]
        while follow(D[-1])[1] > 0:
            D.append(2 * D[-1])
        slopes = [follow(x)[1] for x in D]
        peaks = [0.0] if slopes[0] <= 0 else []
        for low, high, before, after in zip(D, D[1:], slopes, slopes[1:], strict=False):
            if before > 0 >= after:
                root = brentq(lambda x: follow(x)[1], low, high, xtol=1e-14 * high, rtol=1e-13)
                peaks.append(float(root))
        return max(peaks, key=lambda x: follow(x)[0])

    def interval(self, value: float, drop: float) -> tuple[float, float]:
        """Return where twice the profile log-likelihood has fallen by `drop`; 0 if it never has."""
        if self._scale == 0:
            return 0.0, 0.0
        # The height is flat in the offset on the ridge: half the digits of t give all of its own.
        follow = self._follower(1e-6)
        top = follow(value)[0]

        def height(D: float) -> tuple[float, float]:
            level, slope, _ = follow(D)
            return level - top + drop / 2, slope

        near = 0.02 * value if value else self._scale / len(self.y)
        curvature = -height(value + near)[1] / near
        reach = np.sqrt(drop / curvature) if curvature > 0 else near
        high = _crossing(height, inside=value, start=value + reach, outside=np.inf)
        if value == 0 or height(0.0)[0] > 0:
            return 0.0, high
        return _crossing(height, inside=value, start=value - reach, outside=0.0), high

    def offset_at(self, value: float) -> tuple[float, float]:
        """Return the mean noise offset and its standard error from the observed information.

        The information is arrow-shaped (one D, an offset for each group); it comes from central
        differences of the slopes.
        """
        if self._scale == 0:
            return 0.0, np.nan
        offset = self.ridge(value)[2]
        mean = float(np.mean(offset + self.level))
        if value == 0 or np.any(offset - self._least * value <= 1e-3 * self._power):
            return mean, np.nan
        step_o, step_D = 1e-4 * self._power, 1e-4 * value
        more, less = (self._evaluate(value, offset + k * step_o) for k in (1, -1))
        h_oo = (less[2] - more[2]) / (2 * step_o)
        more, less = (self._evaluate(value + k * step_D, offset) for k in (1, -1))
        h_DD, h_Do = (less[1] - more[1]) / (2 * step_D), (less[2] - more[2]) / (2 * step_D)
        left = h_DD - float(np.sum(h_Do**2 / h_oo))
        if left <= 0 or np.any(h_oo <= 0):
            return mean, np.nan
        variance = np.sum(1 / h_oo) / len(offset) ** 2 + np.mean(h_Do / h_oo) ** 2 / left
        return mean, float(np.sqrt(variance))


def _secant(
    t: Floats, slope: Floats, old: Floats, old_slope: Floats, low: Floats, high: Floats
) -> Floats:
    """Return the next trial: the secant step, or the middle of the bracket where that leaves it."""
    rise, run = slope - old_slope, t - old
    step = np.divide(slope * run, rise, out=np.full_like(t, np.nan), where=rise != 0)
    target = np.where(rise * run < 0, t - step, np.nan)
    inside = (target > low) & (target < high)
    # Falling slopes that never cross zero lead down to the edge, which is then the answer.
    target = np.where((target <= low) & (low <= _EDGE), _EDGE, target)
    return np.where(inside | (target == _EDGE), target, 0.5 * (low + high))


def _crossing(
    height: Callable[[float], tuple[float, float]], *, inside: float, start: float, outside: float
) -> float:
    """Return where a height falls through zero between `inside` (> 0) and `outside` (< 0).

    Newton steps, halved into the bracket, or doubled away from `inside` while there is no bracket.
    """
    x = start if min(inside, outside) < start < max(inside, outside) else (inside + outside) / 2
    for _ in range(200):
        value, slope = height(x)
        inside, outside = (x, outside) if value > 0 else (inside, x)
        middle = 2 * x if outside == np.inf else (inside + outside) / 2
        newton = x - value / slope if slope else np.nan
        within = min(inside, outside) < newton < max(inside, outside)
        old, x = x, newton if within else middle
        if abs(x - old) <= 1e-11 * abs(x):
            break
    return float(x)


def _rotation_steps(motion: RigidMotion) -> tuple[Floats, Floats]:
    """Return body-frame rotation vectors along principal axes, and the excess noise of each frame.

    The excess (T, axes) is over the least noisy frame and axis. The axes are those in which the
    covariance of the orientation is diagonal, so that one number an axis describes it.
    """
    _, stop = motion.steps()
    c = motion.covariance
    axes = np.linalg.eigh(np.nanmean(c[_complete(motion)], axis=0))[1]
    noise = np.einsum("ji,tjk,ki->ti", axes, c, axes)
    return motion.step_vectors()[stop - 1] @ axes, noise - np.nanmin(noise)


def _translation_steps(motion: RigidMotion) -> tuple[Floats, Floats]:
    """Return displacements of the centre, and the excess noise of each frame over the least one."""
    start, stop = motion.steps()
    y = motion.center[stop] - motion.center[start]
    noise = motion.center_variance - np.nanmin(motion.center_variance)
    return y, np.repeat(noise[:, None], y.shape[1], axis=1)


def _complete(motion: RigidMotion) -> Bools:
    """Return the fitted frames that show the most particles."""
    fitted = np.isfinite(motion.center[:, 0])
    complete: Bools = fitted & (motion.n_present == motion.n_present[fitted].max())
    return complete
