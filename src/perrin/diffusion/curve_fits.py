"""D from a curve: straight lines and generalised least squares, with their true errors."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.polynomial.polynomial import polyval

from perrin._text import with_error
from perrin.curves.grids import GRID_TOLERANCE
from perrin.curves.standard_errors import covariance_polynomials, displacement_counts
from perrin.diffusion.estimate import NORMAL, UNITS, DiffusionEstimate, Found
from perrin.errors import PrecisionWarning

if TYPE_CHECKING:
    from collections.abc import Iterator

    from perrin._arrays import Floats, Ints
    from perrin.curves.displacement import LagCurve

# The paper's window, 3 s to 22 s of a run of 220 s, as fractions of the duration.
_PAPER_WINDOW = (3 / 220, 22 / 220)

# The information on D in a curve at lag n falls as exp(-k n), cosh k = 1 + SNR: six decay lengths
# leave out less than 0.3 % of the variance.
_DECAY_LENGTHS = 6.0

_MOST_GLS_LAGS = 600  # in generalised least squares; beyond, spaced geometrically

# Motion blur lowers the offset at most to -D dt/3 (a shutter that never closes).
_FULL_BLUR = -1 / 3

# No window is so long that even without noise the error would be more than this part of D: the
# interval would have no upper end.
_LARGEST_ERROR = 0.4

_MOST_GLS_ROUNDS = 100

# A warning states that a slope is not D_R where the steps show it with this many standard errors (a
# chance well below 1 % for an isotropic body of 60 frames, whose ratio has longer tails than a
# Gaussian), and where the difference is above this part of the slope's own error (below, a 95 %
# interval still covers 94 %).
_RATIO_SIGNIFICANCE, _RATIO_RELEVANCE = 4.0, 0.25


def fit_line(
    curve: LagCurve, *, lag_range: Literal["best", "paper"] | tuple[float, float] = "best"
) -> DiffusionEstimate:
    """Fit a straight line with a free offset to a curve (Hunter 2011, Eqs. 20, 22 and 24).

    Parameters
    ----------
    curve : LagCurve
        Curve of `msd`, `msad`, `msad_vector` or `msad_axes`.
    lag_range : {"best", "paper"} or tuple of float
        "best": the lags 1 to m steps whose slope has the smallest expected error at the D and the
        noise estimated from the curve. "paper": 3/220 to 1/10 of the duration, the paper's 3 s
        to 22 s of 220 s, whose spread is a quarter of D however long the run. A tuple: first and
        last lag time used, s, both included.

    Returns
    -------
    DiffusionEstimate
        The slope over 2 dof. Its error is that of the procedure on Brownian motion, correlations
        between overlapping pairs included (it does not follow from the scatter about the line);
        exact for complete tracks and pieces, in the mean for frames missing at random, an
        approximation for curves without drift. For the MSAD of several directions it is up to 10 %
        too large. Where times are uneven, or frames have long holes, the lags within stretches of
        frames on a grid are used. ``n_frames`` counts the frames that those stretches span.

    Raises
    ------
    ValueError
        If a range holds fewer than 3 lags with data ("best": the curve fewer than 2), or lags
        that join stretches; if the curve is a correlation, or no times lie on a grid.

    Warns
    -----
    PrecisionWarning
        If the directions of an MSAD weigh the axes unequally and the steps show that the body
        turns unequally about them: the slope is then not D_R. The text is in ``warnings``.

    Notes
    -----
    The best window is found by iteration: D and offset of one window give the expected error of
    all others. After Michalet, Phys. Rev. E 82, 041914 (2010), with the exact variance.

    Examples
    --------
    >>> from perrin import Cluster, msad, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=3)
    >>> print(fit_line(msad(truth)))
    D_R = 0.0050(4) rad^2/s [line, 300 frames]
    >>> print(fit_line(msad(truth), lag_range="paper"))
    D_R = 0.0068(18) rad^2/s [line, 300 frames]
    """
    lags = GridLags.of(curve)
    if lag_range == "best":
        use = best_window(lags.longest_window())
        return _curve_estimate(curve, use, line_weights(use.steps), method="line")
    step = lags.step
    if isinstance(lag_range, str):
        if lag_range != "paper":
            raise ValueError(
                f'lag_range: expected "best", "paper" or two lag times (s), got {lag_range!r}'
            )
        duration = float(lags.n_frames) * step
        lag_range = (_PAPER_WINDOW[0] * duration, _PAPER_WINDOW[1] * duration)
    low, high = lag_range
    inside = (curve.lagtime > low - 1e-6 * step) & (curve.lagtime < high + 1e-6 * step)
    use = lags.take(np.flatnonzero(inside[lags.index]))
    if use.size < 3:
        longest = lags.stretches[-1][0]
        raise ValueError(
            f"lag_range: {low:g} to {high:g} s holds {use.size} lags with data, at least 3 are "
            f"needed; the curve runs from {step:g} to {step * longest:g} s"
        )
    across = np.isfinite(curve.value)
    across[lags.index] = False
    if np.any(inside & across):
        first = curve.lagtime[across].min(initial=np.inf)
        on_grid = curve.lagtime[lags.index]
        raise ValueError(
            f"lag_range: {np.sum(inside & across)} of the lags from {low:g} to {high:g} s join "
            "frames across holes or uneven times, whose errors are not known here; lags up to "
            f"{on_grid[on_grid < first].max(initial=0.0):g} s do not"
        )
    return _curve_estimate(curve, use, line_weights(use.steps), method="line")


def fit_gls(curve: LagCurve) -> DiffusionEstimate:
    """Fit D and the noise offset to a curve by generalised least squares.

    The covariance of the curve at different lags is the exact one of Brownian motion with
    localisation noise, at the D and offset found, iterated. Of the lags 1, 2, ... those are used
    that hold information on D: 2 + 6/k of them, where cosh k = 1 + SNR (4 at SNR 50, 22 at 0.05),
    which loses less than 0.3 % of the variance. Below an SNR of 0.01 the curve holds less
    information than the steps: `estimate_diffusion` then has a smaller error.

    Parameters
    ----------
    curve : LagCurve
        Curve of `msd`, `msad`, `msad_vector` or `msad_axes`.

    Returns
    -------
    DiffusionEstimate
        Its error is that of the procedure, as for `fit_line`.

    Raises
    ------
    ValueError
        If fewer than 2 lags have data, the curve is a correlation, or no times lie on a grid.

    Warns
    -----
    PrecisionWarning
        As `fit_line`.

    Notes
    -----
    After Bullerjahn, von Bülow and Hummer, J. Chem. Phys. 153, 024116 (2020).

    Examples
    --------
    >>> from perrin import Cluster, msad, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=3)
    >>> print(fit_gls(msad(truth)))
    D_R = 0.0050(4) rad^2/s [gls, 300 frames]
    """
    good = GridLags.of(curve).longest_window()
    use = best_window(good)
    longest = float(use.steps[-1])
    weights = line_weights(use.steps)
    D, s = use.brownian_line(weights)
    for _ in range(_MOST_GLS_ROUNDS):
        before = D, s
        rate = np.arccosh(abs(1 + D / s)) if s else np.inf
        reach = 2 + np.ceil(_DECAY_LENGTHS / rate) if rate else np.inf
        count = int(min(max(reach, np.searchsorted(good.steps, longest) + 1), good.size))
        if count <= _MOST_GLS_LAGS:
            use = good.take(slice(count))
        else:
            spaced = np.rint(np.geomspace(1, count, _MOST_GLS_LAGS)).astype(np.int64)
            use = good.take(np.unique(spaced) - 1)
        longest = float(use.steps[-1])
        weights = gls_weights(use, D=D, s=s)
        D, s = use.brownian_line(weights)
        if np.allclose(before, (D, s), rtol=1e-10, atol=1e-10 * D):
            break
    return _curve_estimate(curve, use, weights, method="gls")


@dataclass(frozen=True, eq=False)
class GridLags:
    """Lags of a curve within stretches of frames on a grid of times.

    Attributes
    ----------
    index : ndarray of int, shape (L,)
        Elements of the curve's lag axis.
    steps : ndarray, shape (L,)
        Lags in steps of the grid.
    value : ndarray, shape (L,)
        Values of the curve.
    complete : ndarray, shape (L,)
        Number of displacements that fit into the stretches.
    present : ndarray, shape (L,)
        Fraction of the frames that is present: the root of that of the displacements.
    stretches : tuple of (int, int)
        Steps from first to last frame, and the number of such stretches, in rising order.
    step : float
        Time between places of the grid, s.
    dof : int
        Number of angles or coordinates that diffuse.
    n_walks : float
        Number of independent one-dimensional walks that were averaged.
    """

    index: Ints
    steps: Floats
    value: Floats
    complete: Floats
    present: Floats
    stretches: tuple[tuple[int, int], ...]
    step: float
    dof: int
    n_walks: float

    @classmethod
    def of(cls, curve: LagCurve) -> GridLags:
        """Return the lags of a curve that have data and lie within stretches on a grid.

        Parameters
        ----------
        curve : LagCurve
            MSD or MSAD.

        Returns
        -------
        GridLags

        Raises
        ------
        ValueError
            If there are fewer than two such lags, or the curve is a correlation.
        """
        if curve.quantity not in UNITS:
            raise ValueError("curve: expected an MSD or MSAD; a correlation is not a straight line")
        step = float(curve.lagtime[0]) if curve.step is None else curve.step
        blocks = np.array(curve.blocks or (len(curve.lagtime),), dtype=np.int64)
        n = curve.lagtime / step
        whole = np.maximum(np.rint(n), 1.0)
        data = np.isfinite(curve.value)
        inside = data & (np.abs(n - whole) <= GRID_TOLERANCE) & (whole <= blocks.max())
        use = np.flatnonzero(inside)
        # Where most stretches are single frames, the pairs on a grid hold little of the track.
        isolated = blocks.sum() < blocks.size
        if data.sum() < 2:
            raise ValueError(
                f"curve: a slope needs at least 2 lags with data, this one has {data.sum()}"
            )
        if use.size < 2 or isolated:
            raise ValueError(
                "curve: the frames lie on no compact grid of times (uneven times or long holes): "
                f"{use.size} of {data.sum()} lags are within the {blocks.size} stretches of even "
                "frames; a slope with a known error needs 2 lags, and stretches of 2 frames or "
                "more on average. estimate_diffusion takes the times as they are"
            )
        exact = np.abs(n - whole) < 1e-6
        complete = displacement_counts(blocks, whole[use])
        translation = curve.quantity == "translation"
        walkers = curve.n_walks / curve.components.shape[1] if translation else 1.0
        kinds = zip(*np.unique(blocks, return_counts=True), strict=True)
        return cls(
            index=use,
            steps=np.where(exact, whole, n)[use],
            value=curve.value[use],
            complete=complete,
            present=np.sqrt(np.minimum(curve.n_pairs[use] / (complete * walkers), 1.0)),
            stretches=tuple((int(length), int(times)) for length, times in kinds),
            step=step,
            dof=curve.dof,
            n_walks=curve.n_walks,
        )

    @property
    def size(self) -> int:
        """Number of lags."""
        return self.index.size

    @property
    def n_frames(self) -> int:
        """Number of frames that the stretches span."""
        return sum((length + 1) * times for length, times in self.stretches)

    def take(self, which: slice | Ints) -> GridLags:
        """Return some of the lags."""
        names = ("index", "steps", "value", "complete", "present")
        return replace(self, **{name: getattr(self, name)[which] for name in names})

    def longest_window(self) -> GridLags:
        """Return the lags up to the longest window whose slope still holds information on D.

        Its error without noise is 40 % of D; that error grows with the window.
        """
        low, high = 2, self.size
        while low < high:
            middle = (low + high + 1) // 2
            if self.take(slice(middle)).slope_variance(D=1.0, s=0.0) > _LARGEST_ERROR**2:
                high = middle - 1
            else:
                low = middle
        return self.take(slice(low))

    def line(self, weights: Floats) -> tuple[float, float]:
        """Return D per step and the offset: the weights (2, L) times the curve, over 2 dof."""
        D, s = weights @ self.value / (2 * self.dof)
        return float(D), float(s)

    def brownian_line(self, weights: Floats) -> tuple[float, float]:
        """Return the D and offset of `line` within the limits of a noisy Brownian walk."""
        D, s = self.line(weights)
        D = max(D, 0.0)
        return D, max(s, _FULL_BLUR * D)

    def shares(self) -> Iterator[tuple[int, Floats]]:
        """Yield the steps of each kind of stretch and its part of the pairs at the lags it has.

        The part is that of one stretch, times the root of the number of such stretches, which are
        independent.
        """
        for length, times in self.stretches:
            lags = int(np.searchsorted(self.steps, length + GRID_TOLERANCE, side="right"))
            if lags:
                pairs = length + 1 - self.steps[:lags]
                yield length, pairs / self.complete[:lags] * np.sqrt(times)

    def variance(self, weights: Floats, *, D: float, s: float) -> float:
        """Return the variance of weights (L,) times the curve over 2 dof, at a D and an offset."""
        total = 0.0
        for length, share in self.shares():
            k = share.size
            total += weighted_variance(
                weights[:k] * share / 2, self.steps[:k], length, present=self.present[:k], D=D, s=s
            )
        return total / self.n_walks

    def slope_variance(self, *, D: float, s: float) -> float:
        """Return the variance of the slope of a straight line through all lags."""
        return self.variance(line_weights(self.steps)[0], D=D, s=s)


def best_window(lags: GridLags) -> GridLags:
    """Return the lags 1..m whose slope has the smallest expected error: a fixed point.

    Parameters
    ----------
    lags : GridLags
        Lags to choose from.

    Returns
    -------
    GridLags

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=3)
    >>> from perrin import msad
    >>> best_window(GridLags.of(msad(truth)).longest_window()).size < 10
    True
    """
    sizes = np.unique(np.rint(np.geomspace(2, lags.size, 200)).astype(np.int64))
    tried: list[int] = []
    size = min(4, lags.size)
    while size not in tried:
        tried.append(size)
        window = lags.take(slice(size))
        D, s = window.brownian_line(line_weights(window.steps))
        lowest = np.inf
        for m in sizes:  # the variance falls to its minimum and rises from there
            variance = lags.take(slice(m)).slope_variance(D=D, s=s)
            if variance > lowest:
                break
            lowest, size = variance, int(m)
    # Of windows that alternate the longest is least sensitive to the noise.
    return lags.take(slice(max(tried[tried.index(size) :])))


def line_weights(steps: Floats) -> Floats:
    """Return the weights (2, L) with which a curve gives slope and level of least squares.

    Parameters
    ----------
    steps : ndarray, shape (L,)
        Lags in steps.

    Returns
    -------
    ndarray, shape (2, L)

    Examples
    --------
    >>> line_weights(np.array([1.0, 2.0, 3.0])) @ [5.0, 7.0, 9.0]  # 2 n + 3
    array([2., 3.])
    """
    mean = steps.mean()
    slope = (steps - mean) / np.sum((steps - mean) ** 2)
    return np.stack([slope, 1 / steps.size - slope * mean])


def gls_weights(lags: GridLags, *, D: float, s: float) -> Floats:
    """Return the weights (2, L) of slope and level of generalised least squares.

    Parameters
    ----------
    lags : GridLags
        Lags of the fit.
    D, s : float
        D per step and offset at which the covariance of the lags is calculated.

    Returns
    -------
    ndarray, shape (2, L)

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=3)
    >>> from perrin import msad
    >>> lags = GridLags.of(msad(truth)).take(slice(4))
    >>> weights = gls_weights(lags, D=3.5e-3, s=1e-3)
    >>> bool(abs(weights[0] @ lags.steps - 1) < 1e-9)
    True
    """
    if D == s == 0:  # without motion all weights are equally good
        return line_weights(lags.steps)
    design = np.stack([lags.steps, np.ones(lags.size)], axis=1)
    covariance = np.zeros((lags.size, lags.size))
    for length, share in lags.shares():
        k = share.size
        part = msd_covariance(lags.steps[:k], length, present=lags.present[:k], D=D, s=s)
        covariance[:k, :k] += part * np.multiply.outer(share, share)
    solved = np.linalg.solve(covariance, design)
    return np.asarray(np.linalg.solve(design.T @ solved, solved.T))


def _curve_estimate(
    curve: LagCurve, use: GridLags, weights: Floats, *, method: str
) -> DiffusionEstimate:
    """Return the estimate with given weights, its error, and a warning if the slope is not D_R."""
    dt = use.step
    value, offset = use.line(weights)
    D, s = use.brownian_line(weights)
    slope, level = (use.variance(w, D=D, s=s) for w in weights)
    stderr = float(np.sqrt(slope))
    parts = tuple(use.variance(weights[0], D=d, s=e) for d, e in ((1, 0), (1, 1), (0, 1)))
    low68, high68 = slope_interval(value, parts, D=D, s=s, z=NORMAL[0.68])
    low95, high95 = slope_interval(value, parts, D=D, s=s, z=NORMAL[0.95])
    unequal: tuple[str, ...] = ()
    if curve.ratio is not None:
        ratio, error = curve.ratio
        bias = abs(ratio - 1)
        if bias >= _RATIO_SIGNIFICANCE * error and bias * value >= _RATIO_RELEVANCE * stderr:
            unequal = (
                "the slope is the mean over the directions averaged, which weigh the body's axes "
                f"unequally: {with_error(ratio, error)} times the mean over all axes, as the steps "
                "show. It equals D_R only for an isotropic body (estimate_diffusion and "
                "msad_vector give D_R, diffusion_tensor and msad_axes the values of single axes)",
            )
            warnings.warn(unequal[0], PrecisionWarning, stacklevel=3)
    found = Found(
        value=value / dt,
        ci68=(low68 / dt, high68 / dt),
        ci95=(low95 / dt, high95 / dt),
        offset=offset,
        offset_stderr=float(np.sqrt(level)),
        stderr=stderr / dt,
    )
    return DiffusionEstimate.judged(
        found,
        quantity="translation" if curve.quantity == "translation" else "rotation",
        method=method,
        n_frames=use.n_frames,
        dt=dt,
        noise_variance=curve.noise,
        resolution_floor=curve.resolution_floor,
        warnings=unequal,
    )


def slope_interval(
    value: float, parts: tuple[float, ...], *, D: float, s: float, z: float
) -> tuple[float, float]:
    """Return the D from which `value` is at most z of their own standard errors away.

    The variance is a D^2 + b D s + c s^2, so that the ends are roots of a quadratic: a large D
    scatters more than a small one, and the interval reaches further up than down. Below D = 0 the
    variance is that of the noise alone.

    Parameters
    ----------
    value : float
        The estimate.
    parts : tuple of float
        Variance of the estimate at (D, s) = (1, 0), (1, 1) and (0, 1): a, a + b + c and c.
    D, s : float
        Estimated D per step and offset; a negative offset is proportional to D.
    z : float
        Half-width of the interval in standard errors.

    Returns
    -------
    low, high : float
        The upper end is inf where the data do not bound it.

    Examples
    --------
    >>> low, high = slope_interval(1.0, (0.0, 0.04, 0.04), D=1.0, s=0.5, z=2.0)  # error 0.2 s
    >>> round(low, 9), round(high, 9)
    (0.8, 1.2)
    """
    a, b, c = parts[0], parts[1] - parts[0] - parts[2], parts[2]
    if s < 0:  # blur is proportional to D, and the variance to D^2
        a, b, c, s = a + b * s / D + c * (s / D) ** 2, 0.0, 0.0, 0.0
    rest = z * s * np.sqrt(c)
    low, high = value - rest, value + rest
    square, half, level = 1 - z * z * a, value + z * z * b * s / 2, low * high
    root = np.sqrt(max(half * half - square * level, 0.0))
    if high > 0:
        high = (half + root) / square if square > 0 else np.inf
    if low > 0:
        low = level / (half + root)
    return float(low), float(high)


def msd_covariance(lags: Floats, steps: int, *, present: Floats, D: float, s: float) -> Floats:
    """Return the covariance of the MSD of a one-dimensional noisy Brownian walk at all lags.

    Parameters
    ----------
    lags : ndarray, shape (L,)
        Lags in steps, rising.
    steps : int
        Steps of the walk.
    present : ndarray, shape (L,)
        Fraction of the frames that is present.
    D, s : float
        D per step and noise variance of a coordinate.

    Returns
    -------
    ndarray, shape (L, L)

    Examples
    --------
    >>> msd_covariance(np.array([1.0]), 10, present=np.ones(1), D=0.5, s=0.0)  # 2/10
    array([[0.2]])
    """
    pairs = steps + 1 - lags
    near, far, same = covariance_polynomials(lags, steps, present=present, D=D, s=s)
    short, longest = np.meshgrid(lags, pairs)
    below, above = (polyval(short, part[..., None], tensor=False) for part in (near, far))
    sums = np.where(short <= longest, below, above)
    lower = 2 * np.tril(sums + np.diag(same)) / pairs[:, None] / pairs
    return np.asarray(lower + np.tril(lower, -1).T)


def weighted_variance(
    weights: Floats, lags: Floats, steps: int, *, present: Floats, D: float, s: float
) -> float:
    """Return weights . covariance . weights without the matrix of `msd_covariance`.

    The double sum over lags a <= b of polynomials in a becomes one over b of cumulative sums.

    Parameters
    ----------
    weights : ndarray, shape (L,)
        Weights of the MSD at the lags.
    lags, steps, present, D, s
        As in `msd_covariance`.

    Returns
    -------
    float

    Examples
    --------
    >>> one = np.ones(1)
    >>> round(weighted_variance(one, one, 10, present=one, D=0.5, s=0.0), 9)
    0.2
    """
    b, pairs = lags, steps + 1 - lags
    near, far, same = covariance_polynomials(b, steps, present=present, D=D, s=s)
    w = weights / pairs
    sums = np.cumsum(w * b ** np.arange(5)[:, None], axis=1)
    sums = np.concatenate([np.zeros((5, 1)), sums], axis=1)
    split = np.minimum(np.arange(b.size) + 1, np.searchsorted(b, pairs, side="right"))
    shorter = np.sum(near * sums[:, split] + far * (sums[:, 1:] - sums[:, split]), axis=0)
    own = np.where(b <= pairs, *(polyval(b, part, tensor=False) for part in (near, far)))
    return float(2 * w @ (2 * shorter + w * (same - own)))
