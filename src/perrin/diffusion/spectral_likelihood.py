"""The likelihood of steps with memory, as a function of the shape of their spectrum.

Along each axis the steps have covariance D V + o E: V the covariance of a motion with D = 1 and a
frame time of 1, which depends on one shape parameter (the exponent of fractional motion, the
logarithm of the relaxation rate of confined motion); E the covariance of differences of unit noise.
Both are diagonal in the sine modes of even steps, to an error that is not measurable, and exactly
in generalised eigenvectors of uneven ones. D and o of every axis are maximised over.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Protocol, get_args

import numpy as np

from perrin._arrays import choice_fault, refuse
from perrin.diffusion.estimate import CHI2
from perrin.diffusion.noise_model import Noise, noise_faults
from perrin.diffusion.step_kernels import difference_eigenvalues
from perrin.diffusion.step_spectra import sine_spectrum, step_autocovariance, step_covariance
from perrin.diffusion.steps import Quantity
from perrin.motion.rigid_motion import RigidMotion

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Sequence

    from perrin._arrays import Bools, Floats
    from perrin.diffusion.steps import Steps

    class MeanSquare(Protocol):
        """Mean square displacement along one axis for D = 1 and a frame time of 1."""

        def __call__(self, lag: Floats, shape: Floats | float) -> Floats:
            """Return it at lags in frames for shapes of its curve, broadcast against each other."""


# Uneven steps are diagonalised in blocks of this many, whose correlation is left out.
_LONGEST_BLOCK = 250

# Lowest logarithm of the ratio of noise to D, and of D to the mean square step; distance of the
# trial values, less than the width of any maximum.
_LEAST_LOG_RATIO, _LOG_STEP = -12.0, 0.8

# Numbers that are computed at once, which stay in the processor's cache; factors of a product whose
# logarithm is taken.
_NUMBERS_TOGETHER, _FACTORS = 150_000, 8

# Steps are even if their durations are one frame time to this.
_EVEN_FRAMES = 1e-6

# The steps along an axis whose mean square is this much smaller than another one's are rounding.
_LEAST_STEP_RATIO = 1e-24

# Change of the shape parameter for the derivative of the spectrum.
_SHAPE_STEP = 1e-4

# The maximum is found to this difference of the shape parameter.
_SHAPE_TOLERANCE = 1e-9

# The ends of an interval are found to this share of a standard error.
_ROOT_TOLERANCE = 1e-8


class StepBlock(NamedTuple):
    """Steps that follow each other without a break.

    Attributes
    ----------
    vectors : ndarray, shape (S, A)
        Components of the steps along the axes.
    time : ndarray, shape (S + 1,)
        Times of the frames, in frame times.
    even : bool
        Whether all steps are equally long.
    """

    vectors: Floats
    time: Floats
    even: bool


class StepModes(NamedTuple):
    """Steps in coordinates in which their covariance D V + o E is diagonal, for S shapes.

    Attributes
    ----------
    values : ndarray, shape (S, A, K) or (1, A, K)
        Coordinates of each axis; their squares have the mean D spectrum + o noise.
    spectrum : ndarray, shape (S, K)
        Diagonal of V.
    noise : ndarray, shape (K,)
        Diagonal of E.
    slope : ndarray, shape (S, K)
        Diagonal of the derivative V' of V in the shape parameter.
    slope_form : callable
        Quadratic form of V' for coordinates (S, A, K), by shape and axis.
    """

    values: Floats
    spectrum: Floats
    noise: Floats
    slope: Floats
    slope_form: Callable[[Floats], Floats]


class ScaleFit(NamedTuple):
    """D and o of every axis at the maximum of the likelihood for each shape.

    Attributes
    ----------
    value : ndarray, shape (..., A)
        Log-likelihood of each axis, but for a constant.
    D, offset : ndarray, shape (..., A)
        Per frame.
    variance : ndarray, shape (..., A)
        Variance of ln D for this shape, from the expected information.
    """

    value: Floats
    D: Floats
    offset: Floats
    variance: Floats


class ShapePoint(NamedTuple):
    """The profile likelihood at one shape.

    Attributes
    ----------
    shape, value, slope : float
        Shape parameter, log-likelihood but for a constant, and its derivative.
    D : float
        Mean over axes and motions, weighted by the number of steps.
    variance : float
        Variance of ln D for this shape.
    offset : float
        Noise offset, mean likewise.
    """

    shape: float
    value: float
    slope: float
    D: float
    variance: float
    offset: float


@dataclass(frozen=True, eq=False)
class ShapeLikelihood:
    """The likelihood of the shape of a spectrum, D and o of every axis profiled out.

    Attributes
    ----------
    motions : tuple of tuple of StepBlock
        Blocks of every motion; its axes have one D and one o in all of them.
    mean_square : callable
        Mean square displacement for D = 1 as a function of lag in frames and shape parameter.
    known : tuple of (ndarray or None)
        Known offset of every axis of each motion; None where it is free.
    n_axes : int
        Axes along which each motion is known, with those along which it rests.
    blurred : bool
        Whether `mean_square` contains the motion blur, so that a free offset is not negative.
    """

    motions: tuple[tuple[StepBlock, ...], ...]
    mean_square: MeanSquare
    known: tuple[Floats | None, ...]
    n_axes: int
    blurred: bool = False

    @classmethod
    def of(cls, tracks: Sequence[Steps], noise: Noise, mean_square: MeanSquare) -> ShapeLikelihood:
        """Return the likelihood of the steps of some motions along their own axes.

        Noise that differs between frames enters as its mean, which leaves the mean square of every
        mode as it is, and so the estimate unbiased.

        Parameters
        ----------
        tracks : sequence of Steps
        noise : Noise
        mean_square : callable
            Mean square displacement, with the blur of the stated exposure.
        """
        known: list[Floats | None] = []
        blocks = []
        for steps in tracks:
            square = np.mean(steps.vectors**2, axis=0)
            moving = square > _LEAST_STEP_RATIO * max(square.max(), np.finfo(float).tiny)
            if not moving.any():
                raise ValueError("motion: all steps are 0; expected a body that moves")
            blocks.append(step_blocks(steps, moving))
            if noise.model == "joint":
                known.append(None)
                continue
            sigma = steps.sigma if noise.model == "residual" else float(noise.model)
            mean = 0.5 * np.sum([x.mean(axis=0) for x in steps.variances], axis=0)
            known.append(sigma**2 * mean[moving])
        return cls(
            tuple(blocks),
            mean_square,
            tuple(known),
            n_axes=tracks[0].vectors.shape[1],
            blurred=noise.exposure is not None,
        )

    @property
    def longest(self) -> int:
        """Frames of the longest block."""
        return max(int(b.time[-1] - b.time[0]) for blocks in self.motions for b in blocks)

    @property
    def n_steps(self) -> int:
        """Number of steps."""
        return sum(len(b.vectors) for blocks in self.motions for b in blocks)

    def at(self, shape: float) -> ShapePoint:
        """Return the profile likelihood at one shape."""
        return self.at_each(np.array([shape]))[0]

    def at_each(self, shapes: Floats) -> list[ShapePoint]:
        """Return the profile likelihood at several shapes."""
        numbers = max(sum(len(b.vectors) for b in blocks) for blocks in self.motions)
        at_once = max(1, _NUMBERS_TOGETHER // (numbers * len(log_ratios(numbers))))
        points = []
        for low in range(0, len(shapes), at_once):
            some = shapes[low : low + at_once]
            value, slope, D, offset, variance = np.zeros((5, len(some)))
            for blocks, known in zip(self.motions, self.known, strict=True):
                modes = [step_modes(block, self.mean_square, some) for block in blocks]
                values = np.concatenate(
                    [np.broadcast_to(m.values, (len(some), *m.values.shape[1:])) for m in modes],
                    axis=2,
                )
                spectrum = np.concatenate([m.spectrum for m in modes], axis=1)
                noise = np.concatenate([m.noise for m in modes])
                if known is None:
                    least = 0.0 if self.blurred else None
                    fit = fit_scales(values, spectrum, noise, least_offset=least)
                else:
                    fit = fit_scales_known_noise(values, spectrum, noise, known)
                value += fit.value.sum(axis=1)
                for one in modes:
                    slope += shape_slope(one, fit)
                weight = len(noise) / self.n_steps / self.n_axes
                D += weight * fit.D.sum(axis=1)
                offset += weight * fit.offset.sum(axis=1)
                variance += weight**2 * np.sum(fit.D**2 * fit.variance, axis=1)
            spread = np.divide(variance, D**2, out=np.full(len(some), np.inf), where=D != 0)
            rows = zip(some, value, slope, D, spread, offset, strict=True)
            points += [ShapePoint(*map(float, row)) for row in rows]
        return points

    def best(self, shapes: Floats) -> tuple[ShapePoint, list[ShapePoint]]:
        """Return the highest maximum over a range of shapes, and the points at `shapes`.

        Parameters
        ----------
        shapes : ndarray
            Trial values in rising order, nearer to each other than the width of a maximum.
        """
        points = self.at_each(shapes)
        top = max(range(len(points)), key=lambda i: points[i].value)
        best = points[top]
        side = top + (1 if best.slope > 0 else -1)
        if 0 <= side < len(points) and points[side].slope * best.slope < 0:
            old, peak = points[side], best
            low, high = sorted((old.shape, peak.shape))
            for _ in range(60):
                low, high = (peak.shape, high) if peak.slope > 0 else (low, peak.shape)
                run, rise = peak.shape - old.shape, peak.slope - old.slope
                shape = peak.shape - peak.slope * run / rise if rise else np.inf
                shape = shape if low < shape < high else 0.5 * (low + high)
                if abs(shape - peak.shape) < _SHAPE_TOLERANCE:
                    break
                old, peak = peak, self.at(shape)
            best = max(best, peak, key=lambda point: point.value)
        return best, points

    def crossings(
        self, best: ShapePoint, points: list[ShapePoint], drops: Sequence[float]
    ) -> list[tuple[ShapePoint | None, ShapePoint | None]]:
        """Return the outermost points at which twice the value has fallen by each of some drops.

        Parameters
        ----------
        best, points
            Result of `best`.
        drops : sequence of float
            Quantiles of chi-squared with one degree of freedom.

        Returns
        -------
        list of tuple
            Lower and upper point for every drop; None where there is none.
        """
        searches = [crossing(best, points, drop, side) for drop in drops for side in (-1, 1)]
        ends: list[ShapePoint | None] = [None] * len(searches)
        wanted: dict[int, float] = {}
        seen: dict[int, ShapePoint | None] = dict.fromkeys(range(len(searches)))
        while seen:
            for k, point in seen.items():
                try:
                    wanted[k] = next(searches[k]) if point is None else searches[k].send(point)
                except StopIteration as stop:
                    ends[k] = stop.value
                    wanted.pop(k, None)
            found = self.at_each(np.array(list(wanted.values())))
            seen = dict(zip(wanted, found, strict=True))
        return list(zip(ends[::2], ends[1::2], strict=True))

    def intervals(
        self, best: ShapePoint, points: list[ShapePoint]
    ) -> dict[float, tuple[ShapePoint | None, ShapePoint | None]]:
        """Return the ends of the 68 % and the 95 % interval; None where the data set no bound."""
        ends = self.crossings(best, points, [*CHI2.values()])
        return dict(zip(CHI2, ends, strict=True))

    def scale_slope(self, best: ShapePoint, reach: float) -> float:
        """Return the slope of ln D in the shape parameter along the maximum of the likelihood."""
        low, high = self.at(best.shape - reach), self.at(best.shape + reach)
        if not (low.D > 0 and high.D > 0):
            return np.nan
        return float(np.log(high.D / low.D) / (2 * reach))


def crossing(
    best: ShapePoint, points: list[ShapePoint], drop: float, side: int
) -> Generator[float, ShapePoint, ShapePoint | None]:
    """Search for the outermost point at which twice the value has fallen by a drop.

    Parameters
    ----------
    best, points
        Result of `ShapeLikelihood.best`.
    drop : float
        Quantile of chi-squared with one degree of freedom.
    side : {-1, 1}
        Towards smaller or larger shapes.

    Yields
    ------
    float
        Shape whose point is sent back.

    Returns
    -------
    ShapePoint or None
        None where the value does not fall as far.

    Examples
    --------
    >>> top, low = ShapePoint(0.0, 0.0, 0.0, 1, 0, 0), ShapePoint(-1.0, -2.0, 4.0, 1, 0, 0)
    >>> search = crossing(top, [low], 1.0, -1)  # twice the value falls as 4 times the square
    >>> next(search)
    -0.5
    """
    # The root of twice the fall of the value is nearly straight in the shape parameter.
    bound = float(np.sqrt(drop))

    def root(point: ShapePoint) -> float:
        return float(np.sqrt(max(2 * (best.value - point.value), np.finfo(float).tiny)))

    outward = sorted(
        [best, *(p for p in points if side * (p.shape - best.shape) > 0)],
        key=lambda p: side * p.shape,
    )
    last = max(i for i, p in enumerate(outward) if root(p) <= bound)
    if last == len(outward) - 1:
        return None
    inside, outside = outward[last], outward[last + 1]
    low, high = inside.shape, outside.shape
    share = (bound - root(inside)) / (root(outside) - root(inside))
    point = yield low + share * (high - low)
    for _ in range(60):
        rest = bound - root(point)
        if abs(rest) <= _ROOT_TOLERANCE:
            break
        low, high = (point.shape, high) if rest > 0 else (low, point.shape)
        # The slope of the root is minus that of the value over the root.
        step = -rest * root(point) / point.slope if point.slope else np.inf
        within = min(low, high) < point.shape + step < max(low, high)
        point = yield point.shape + step if within else 0.5 * (low + high)
    return point


def step_blocks(steps: Steps, moving: Bools) -> tuple[StepBlock, ...]:
    """Return the steps of a motion in blocks: its pieces, and parts of long uneven ones.

    Parameters
    ----------
    steps : Steps
    moving : ndarray of bool, shape (A,)
        Axes that are taken.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> from perrin.diffusion import steps_of
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=100, rng=3)
    >>> blocks = step_blocks(steps_of(truth, "rotation"), np.array([True, True, False]))
    >>> [(b.vectors.shape, b.even) for b in blocks]
    [((99, 2), True)]
    """
    length = steps.duration / steps.dt
    blocks = []
    for rows in np.split(np.arange(len(length)), 1 + np.flatnonzero(~steps.linked[:-1])):
        even = bool(np.all(np.abs(length[rows] - 1) <= _EVEN_FRAMES))
        parts = 1 if even else -(-len(rows) // _LONGEST_BLOCK)
        for part in np.array_split(rows, parts):
            time = np.append(0.0, np.cumsum(length[part]))
            blocks.append(StepBlock(steps.vectors[part][:, moving], time, even))
    return tuple(blocks)


def step_modes(block: StepBlock, mean_square: MeanSquare, shapes: Floats) -> StepModes:
    """Return the steps of a block in coordinates in which their covariance is diagonal.

    Even steps are taken to their sine modes; uneven ones to the generalised eigenvectors of V and
    E, in which E is the identity.

    Examples
    --------
    >>> from perrin.diffusion import fractional_mean_square
    >>> block = StepBlock(np.ones((4, 1)), np.arange(5.0), even=False)
    >>> exact = step_modes(block, fractional_mean_square, np.ones(1))
    >>> sine = step_modes(block._replace(even=True), fractional_mean_square, np.ones(1))
    >>> bool(np.allclose(np.sort(sine.spectrum / sine.noise), exact.spectrum))
    True
    """
    from scipy.fft import dst
    from scipy.linalg import eigh

    around = shapes + np.array([[0.0], [-_SHAPE_STEP], [_SHAPE_STEP]])
    count = len(block.vectors)
    if block.even:
        square = mean_square(block.time, around[..., None])
        spectrum, less, more = sine_spectrum(step_autocovariance(square))
        values = dst(block.vectors.T, type=1, norm="ortho", axis=1)[None]
        slope = (more - less) / (2 * _SHAPE_STEP)
        noise = 2 * difference_eigenvalues(count)
        return StepModes(
            values, spectrum, noise, slope, lambda x: np.einsum("sak,sk->sa", x**2, slope)
        )

    def covariance(shape: float) -> Floats:
        return step_covariance(block.time, lambda lag: mean_square(lag, shape))

    difference = 2 * np.eye(count) - np.eye(count, k=1) - np.eye(count, k=-1)
    spectra, turns, slopes = [], [], []
    for three in around.T:
        middle, less, more = map(covariance, three.tolist())
        variances, axes = eigh(middle, difference)
        spectra.append(variances)
        turns.append(axes)
        slopes.append((more - less) / (2 * _SHAPE_STEP) @ axes)
    axes, turned = np.stack(turns), np.stack(slopes)
    return StepModes(
        values=np.swapaxes(np.swapaxes(axes, 1, 2) @ block.vectors, 1, 2),
        spectrum=np.stack(spectra),
        noise=np.ones(count),
        slope=np.einsum("sik,sik->sk", axes, turned),
        slope_form=lambda x: np.einsum(
            "sai,sai->sa", x @ np.swapaxes(axes, 1, 2), x @ np.swapaxes(turned, 1, 2)
        ),
    )


def log_ratios(count: int) -> Floats:
    """Return the logarithms of the ratio of noise to D between which `count` coordinates decide.

    They are nearer to each other than the width of a maximum of the likelihood.

    Examples
    --------
    >>> log_ratios(300).round(1)[[0, 1, -1]]
    array([-12. , -11.2,  15.2])
    """
    return np.arange(_LEAST_LOG_RATIO, 2 * np.log(count) + 4, _LOG_STEP)


def log_sums(x: Floats) -> Floats:
    """Return the sums of the logarithms of positive numbers, 1e-38 to 1e38, along the last axis.

    Logarithms are taken of products of eight numbers, which take less time.

    Examples
    --------
    >>> log_sums(np.full((2, 9), 2.0)) / np.log(2.0)
    array([9., 9.])
    """
    count = x.shape[-1] // _FACTORS
    whole = x[..., : count * _FACTORS].reshape(*x.shape[:-1], _FACTORS, count)
    products, rest = whole.prod(axis=-2), x[..., count * _FACTORS :]
    return np.asarray(np.log(products).sum(axis=-1) + np.log(rest).sum(axis=-1))


def fit_scales(
    values: Floats, spectrum: Floats, noise: Floats, *, least_offset: float | None = None
) -> ScaleFit:
    """Return the D and o of every axis at which coordinates of variance D spectrum + o noise fit.

    With o = D h + t, h the lowest ratio at which all variances are positive, the likelihood is
    maximised in ln(t/D), D by itself. It may have several maxima in short tracks: all of its range
    is searched, then the highest maximum is found by Newton steps.

    Parameters
    ----------
    values : ndarray, shape (..., A, K)
    spectrum : ndarray, shape (..., K)
    noise : ndarray, shape (K,)
    least_offset : float, optional
        Lowest ratio h of o to D; by default where the first variance reaches 0.

    Examples
    --------
    >>> noise = 2 * difference_eigenvalues(400)
    >>> values = np.sqrt(0.5 * 2 + 0.1 * noise)[None] * np.random.default_rng(3).normal(size=400)
    >>> fit = fit_scales(values, np.full(400, 2.0), noise)
    >>> bool(abs(np.log(fit.D[0] / 0.5)) < 3 * np.sqrt(fit.variance[0]))
    True
    """
    count, shape = spectrum.shape[-1], values.shape[:-1]
    least = -np.min(spectrum / noise, axis=-1) if least_offset is None else np.array(least_offset)
    rest = np.maximum(spectrum + least[..., None] * noise, 0.0)[..., None, :]
    power = np.maximum(values**2, np.finfo(float).tiny)
    trial = log_ratios(count)
    variance = rest + np.exp(trial)[:, None] * noise
    mean = power @ np.swapaxes(1 / variance, -1, -2) / count
    height = -0.5 * (log_sums(variance)[..., None, :] + count * np.log(mean))

    def score(u: Floats) -> tuple[Floats, Floats]:
        scaled = np.exp(u).reshape(*shape, 1) * noise
        variance = rest + scaled
        share, weight = scaled / variance, power / variance
        shared = weight * share
        t0, t1 = weight.sum(axis=-1), shared.sum(axis=-1)
        t2 = np.einsum("...k,...k->...", shared, share)
        s1, s2 = share.sum(axis=-1), np.einsum("...k,...k->...", share, share)
        bend = s1 - s2 - count * ((t1 - 2 * t2) / t0 + (t1 / t0) ** 2)
        return (-0.5 * (s1 - count * t1 / t0)).ravel(), (-0.5 * bend).ravel()

    heights = height.reshape(-1, len(trial)).T
    u = highest_maxima(score, np.broadcast_to(trial[:, None], heights.shape), heights)
    ratio = np.exp(u).reshape(shape)
    variance = rest + ratio[..., None] * noise
    D = np.mean(power / variance, axis=-1)
    value = -0.5 * (log_sums(variance) + count * np.log(D) + count)
    by_D, by_offset = spectrum[..., None, :] / variance, noise / variance
    shared = np.sum(by_D * by_offset, axis=-1) ** 2 / np.sum(by_offset**2, axis=-1)
    with np.errstate(divide="ignore"):
        spread = 2 / np.maximum(np.sum(by_D**2, axis=-1) - shared, 0.0)
    return ScaleFit(value, D, D * (ratio + least[..., None]), spread)


def highest_maxima(
    score: Callable[[Floats], tuple[Floats, Floats]], trial: Floats, height: Floats
) -> Floats:
    """Return where some functions of one variable each have their highest maximum, (A,).

    Parameters
    ----------
    score : callable
        First and second derivative of every function, (A,) each, at the arguments (A,).
    trial, height : ndarray, shape (M, A)
        Arguments in rising order, nearer to each other than the width of a maximum, and values.

    Examples
    --------
    >>> trial = np.linspace(-3.0, 3.0, 7)[:, None]
    >>> highest_maxima(lambda x: (0.3 - x, -np.ones(1)), trial, -((trial - 0.3) ** 2))
    array([0.3])
    """
    top, column = np.argmax(height, axis=0), np.arange(height.shape[1])
    low = trial[np.maximum(top - 1, 0), column]
    high = trial[np.minimum(top + 1, len(trial) - 1), column]
    x = trial[top, column]
    for _ in range(40):
        slope, bend = score(x)
        rising = slope > 0
        low, high = np.where(rising, x, low), np.where(rising, high, x)
        newton = x - np.divide(slope, bend, out=np.full_like(x, np.inf), where=bend < 0)
        target = np.where((newton >= low) & (newton <= high), newton, 0.5 * (low + high))
        moved = np.abs(target - x).max()
        x = target
        # The error of the next Newton step is of the order of the square of this.
        if moved < 1e-6:
            break
    return np.asarray(x)


def fit_scales_known_noise(
    values: Floats, spectrum: Floats, noise: Floats, offset: Floats
) -> ScaleFit:
    """Return the D of every axis at which coordinates of variance D spectrum + o noise fit.

    Parameters
    ----------
    values : ndarray, shape (..., A, K)
    spectrum : ndarray, shape (..., K)
    noise : ndarray, shape (K,)
    offset : ndarray, shape (A,)
        Known o of every axis, >= 0.

    Examples
    --------
    >>> fit_scales_known_noise(np.ones((1, 5)), np.full(5, 2.0), np.ones(5), np.zeros(1)).D
    array([0.5])
    """
    power, shape = np.maximum(values**2, np.finfo(float).tiny), values.shape[:-1]
    known, spectrum = offset[:, None] * noise, spectrum[..., None, :]
    v = np.log(np.mean(power / spectrum, axis=-1))
    trial = v + np.arange(_LEAST_LOG_RATIO, 1.5, _LOG_STEP).reshape(-1, *[1] * v.ndim)
    variance = np.exp(trial)[..., None] * spectrum + known
    height = -0.5 * (log_sums(variance) + np.sum(power / variance, axis=-1))

    def score(v: Floats) -> tuple[Floats, Floats]:
        scaled = np.exp(v).reshape(*shape, 1) * spectrum
        variance = scaled + known
        share, weight = scaled / variance, power / variance
        slope, turn = share * (1 - weight), share**2 * weight
        bend = np.sum((1 - share) * slope + turn, axis=-1)
        return -0.5 * slope.sum(axis=-1).ravel(), -0.5 * bend.ravel()

    best = highest_maxima(score, *(x.reshape(len(x), -1) for x in (trial, height)))
    D = np.exp(best).reshape(shape)
    variance = D[..., None] * spectrum + known
    value = -0.5 * (log_sums(variance) + np.sum(power / variance, axis=-1))
    information = np.sum((D[..., None] * spectrum / variance) ** 2, axis=-1)
    return ScaleFit(value, D, np.broadcast_to(offset, shape), 2 / information)


def shape_slope(modes: StepModes, fit: ScaleFit) -> Floats:
    """Return the derivatives of the log-likelihood in the shape parameter, (S,).

    D and o are at their maximum for each of the S shapes.

    Examples
    --------
    >>> ones = np.ones((1, 3))
    >>> modes = StepModes(ones[None], 2 * ones, ones[0], ones, lambda x: x.sum(axis=2))
    >>> half = np.full((1, 1), 0.5)
    >>> shape_slope(modes, ScaleFit(half, half, 0 * half, half))
    array([0.])
    """
    variance = fit.D[..., None] * modes.spectrum[:, None] + fit.offset[..., None] * modes.noise
    mean = ((1 / variance) @ modes.slope[..., None])[..., 0]
    form = modes.slope_form(modes.values / variance)
    return np.asarray(0.5 * np.sum(fit.D * (form - mean), axis=1))


def motions_and_noise(
    motion: RigidMotion | Sequence[RigidMotion],
    quantity: Quantity,
    noise: object,
    exposure: float | None,
) -> tuple[list[RigidMotion], Noise]:
    """Return the motions and the options of the noise of a fit, or raise one error for all faults.

    Raises
    ------
    ValueError
        For unknown or inconsistent choices, or motions of 2 and 3 dimensions together.

    Examples
    --------
    >>> motions_and_noise([], "speed", "joint", None)
    Traceback (most recent call last):
    ValueError: quantity: expected 'rotation' or 'translation', got 'speed'; motion: expected one or more motions, all in 2 or all in 3 dimensions
    """  # noqa: E501 (what Python prints)
    motions = [motion] if isinstance(motion, RigidMotion) else list(motion)
    faults = [
        *choice_fault("quantity", quantity, get_args(Quantity)),
        *noise_faults(noise, exposure),
    ]
    if isinstance(noise, Noise) and noise.drift:
        faults.append(
            "noise: expected drift=False; a steady motion is fitted by estimate_diffusion"
        )
    if len({m.dimension for m in motions}) != 1:
        faults.append("motion: expected one or more motions, all in 2 or all in 3 dimensions")
    refuse(faults)
    return motions, Noise.of(noise, exposure=exposure)
