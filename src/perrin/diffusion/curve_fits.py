"""D from a curve: straight lines and generalised least squares, with the error they have."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.polynomial.polynomial import polyval

from perrin._text import with_error
from perrin.curves.pairs import NEAR, overlap_sums, places
from perrin.diffusion.estimate import NORMAL, UNITS, DiffusionEstimate, Found
from perrin.errors import PrecisionWarning

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from perrin._arrays import Floats, Ints
    from perrin.curves.displacement import LagCurve


# The paper's window, 3 s to 22 s of a run of 220 s, as fractions of the duration.
_PAPER = (3 / 220, 22 / 220)


# What a curve tells of D at lag n falls as exp(-k n), cosh k = 1 + SNR: six decay lengths leave
# out less than 0.3 % of the variance.
_DECAY_LENGTHS = 6.0


_MOST_LAGS = 600  # in generalised least squares; beyond, spaced geometrically


# Motion blur lowers the offset at most to -D dt/3 (a shutter that never closes).
_FULL_BLUR = -1 / 3


# No window is so long that even without noise the error would be more than this part of D: the
# interval would have no upper end.
_LONGEST = 0.4


_ROUNDS = 100


# A slope is stated not to be D_R where the steps show it with this many standard errors (a chance
# well below 1 % for an isotropic body of 60 frames, whose ratio has longer tails than a Gaussian),
# and where the difference is above this part of the slope's own error (below, a 95 % interval still
# covers 94 %).
_SURE, _MATTERS = 4.0, 0.25


def fit_line(
    curve: LagCurve, *, lag_range: Literal["best", "paper"] | tuple[float, float] = "best"
) -> DiffusionEstimate:
    """Fit a straight line with a free offset to a curve (Hunter 2011, Eqs. 20, 22 and 24).

    Parameters
    ----------
    curve : LagCurve
        From `msad`, `msd` and their kin.
    lag_range : {"best", "paper"} or tuple of float
        "best": the lags 1 to m steps whose slope has the smallest expected error at the D and the
        noise that the curve itself shows. "paper": 3/220 to 1/10 of the duration, the paper's 3 s
        to 22 s of 220 s, whose spread is a quarter of D however long the run. A tuple: first and
        last lag time used, s, both included.

    Returns
    -------
    DiffusionEstimate
        The slope over 2 dof. Its error is that of the procedure on Brownian motion, correlations
        between overlapping pairs included (the scatter about the line says nothing about it);
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
        If the directions of an MSAD weigh the axes unequally and the steps show that the body does
        not turn alike about them: the slope is then not D_R. The text is in ``warnings``.

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
    lags = _grid_lags(curve)
    best = lag_range == "best"
    use = (
        _best_window(curve, _useful_lags(curve, lags)) if best else _window(curve, lags, lag_range)
    )
    return _estimate(curve, use, _line_weights(use.n), method="line")


def fit_gls(curve: LagCurve) -> DiffusionEstimate:
    """Fit D and the noise offset to a curve by generalised least squares.

    The covariance of the curve at different lags is the exact one of Brownian motion with
    localisation noise, at the D and offset found, iterated. Of the lags 1, 2, ... as many are
    used as tell about D: 2 + 6/k, where cosh k = 1 + SNR (4 at SNR 50, 22 at 0.05), which loses
    less than 0.3 % of the variance. Below an SNR of 0.01 the curve itself holds less than the
    steps: `estimate_diffusion` then does better.

    Parameters
    ----------
    curve : LagCurve
        From `msad`, `msd` and their kin.

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
    good = _useful_lags(curve, _grid_lags(curve))
    use = _best_window(curve, good)
    weights = _line_weights(use.n)
    D, s = _model(curve, use, weights)
    for _ in range(_ROUNDS):
        before = D, s
        use = _informative_lags(good, D=D, s=s, least=float(use.n[-1]))
        weights = _gls_weights(use, D=D, s=s)
        D, s = _model(curve, use, weights)
        if np.allclose(before, (D, s), rtol=1e-10, atol=1e-10 * D):
            break
    return _estimate(curve, use, weights, method="gls")


@dataclass(frozen=True, eq=False)
class _Lags:
    """Lags of a curve within stretches of frames on a grid of times.

    Attributes
    ----------
    index : ndarray of int, shape (L,)
        Elements of the curve's lag axis.
    n : ndarray, shape (L,)
        Steps of the grid.
    whole : ndarray, shape (L,)
        Displacements that fit into the stretches.
    seen : ndarray, shape (L,)
        The part of the frames that is there: the root of that of the displacements.
    stretches : tuple of (int, int)
        Steps from first to last frame, and how many such stretches there are.
    """

    index: Ints
    n: Floats
    whole: Floats
    seen: Floats
    stretches: tuple[tuple[int, int], ...]

    @property
    def size(self) -> int:
        """Number of lags."""
        return self.index.size

    def take(self, which: slice | Ints) -> _Lags:
        """Return some of the lags."""
        return _Lags(
            self.index[which], self.n[which], self.whole[which], self.seen[which], self.stretches
        )

    def shares(self) -> Iterator[tuple[int, Floats]]:
        """Yield the steps of each kind of stretch and its part of the pairs at the lags it has.

        The part is that of one stretch, times the root of the number of such stretches, which are
        independent.
        """
        for length, times in self.stretches:
            inside = int(np.searchsorted(self.n, length + NEAR, side="right"))
            if inside:
                yield length, (length + 1 - self.n[:inside]) / self.whole[:inside] * np.sqrt(times)


def _step(curve: LagCurve) -> float:
    """Return the step of the grid of times, s."""
    return float(curve.lagtime[0]) if curve.step is None else curve.step


def _blocks(curve: LagCurve) -> Ints:
    """Return the steps from first to last frame of each stretch of frames on a grid."""
    return np.array(curve.blocks or (len(curve.lagtime),), dtype=np.int64)


def _grid_lags(curve: LagCurve) -> _Lags:
    """Return the lags with data within stretches of frames on a grid; refuse fewer than two."""
    if curve.quantity not in UNITS:
        raise ValueError("curve: expected an MSD or MSAD; a correlation is no straight line")
    n = curve.lagtime / _step(curve)
    whole = np.maximum(np.rint(n), 1.0)
    data = np.isfinite(curve.value)
    inside = data & (np.abs(n - whole) <= NEAR) & (whole <= _blocks(curve).max())
    use = np.flatnonzero(inside)
    blocks = _blocks(curve)
    # Where most frames stand alone, the pairs on a grid hold little of what the track does.
    alone = blocks.sum() < blocks.size
    if use.size < 2 or alone:
        if data.sum() >= 2:
            raise ValueError(
                "curve: the frames lie on no compact grid of times (uneven times or long holes): "
                f"{use.size} of {data.sum()} lags are within the {blocks.size} stretches of even "
                "frames; a slope with a known error needs 2 lags, and stretches of 2 frames or "
                "more on average. estimate_diffusion takes the times as they are"
            )
        raise ValueError(
            f"curve: a slope needs at least 2 lags with data, this one has {data.sum()}"
        )
    exact = np.abs(n - whole) < 1e-6
    fitting = places(blocks, whole[use])
    walkers = curve.n_walks / curve.components.shape[1] if curve.quantity == "translation" else 1.0
    kinds = zip(*np.unique(blocks, return_counts=True), strict=True)
    return _Lags(
        index=use,
        n=np.where(exact, whole, n)[use],
        whole=fitting,
        seen=np.sqrt(np.minimum(curve.n_pairs[use] / (fitting * walkers), 1.0)),
        stretches=tuple((int(length), int(times)) for length, times in kinds),
    )


def _window(curve: LagCurve, lags: _Lags, lag_range: str | tuple[float, float]) -> _Lags:
    """Return the lags with data in a range of lag times."""
    step, blocks = _step(curve), _blocks(curve)
    if isinstance(lag_range, str):
        if lag_range != "paper":
            raise ValueError(
                f'lag_range: expected "best", "paper" or two lag times (s), got {lag_range!r}'
            )
        duration = float(np.sum(blocks + 1)) * step
        lag_range = (_PAPER[0] * duration, _PAPER[1] * duration)
    low, high = lag_range
    inside = (curve.lagtime > low - 1e-6 * step) & (curve.lagtime < high + 1e-6 * step)
    use = lags.take(np.flatnonzero(inside[lags.index]))
    if use.size < 3:
        raise ValueError(
            f"lag_range: {low:g} to {high:g} s holds {use.size} lags with data, at least 3 are "
            f"needed; the curve runs from {step:g} to {step * blocks.max():g} s"
        )
    across = np.count_nonzero(inside & np.isfinite(curve.value)) - use.size
    if across:
        raise ValueError(
            f"lag_range: {across} of the lags from {low:g} to {high:g} s join frames across holes "
            f"or uneven times, whose errors are not known here; lags up to "
            f"{_contiguous(curve, lags):g} s do not"
        )
    return use


def _contiguous(curve: LagCurve, lags: _Lags) -> float:
    """Return the longest lag time below which every lag with data lies on the grid, s."""
    across = np.isfinite(curve.value)
    across[lags.index] = False
    first = curve.lagtime[across].min(initial=np.inf)
    return float(curve.lagtime[lags.index][curve.lagtime[lags.index] < first].max(initial=0.0))


def _best_window(curve: LagCurve, good: _Lags) -> _Lags:
    """Return the lags 1..m whose slope has the smallest expected error: a fixed point."""
    sizes = np.unique(np.rint(np.geomspace(2, good.size, 200)).astype(np.int64))
    tried: list[int] = []
    size = min(4, good.size)
    while size not in tried:
        tried.append(size)
        D, s = _model(curve, good.take(slice(size)), _line_weights(good.n[:size]))
        errors = (_line_variance(curve, good.take(slice(m)), D=D, s=s) for m in sizes)
        size = int(sizes[_first_minimum(errors)])
    # Nothing distinguishes windows that alternate; the longest is least sensitive to the noise.
    return good.take(slice(max(tried[tried.index(size) :])))


def _useful_lags(curve: LagCurve, good: _Lags) -> _Lags:
    """Return the lags up to the longest window that still says something of D."""
    low, high = 2, good.size
    while low < high:  # bisection: the error of a noise-free slope grows with its window
        middle = (low + high + 1) // 2
        if _line_variance(curve, good.take(slice(middle)), D=1.0, s=0.0) > _LONGEST**2:
            high = middle - 1
        else:
            low = middle
    return good.take(slice(low))


def _first_minimum(values: Iterable[float]) -> int:
    """Return where a sequence that falls and then rises has its minimum."""
    last, place = np.inf, -1
    for value in values:
        if value > last:
            break
        last, place = value, place + 1
    return place


def _informative_lags(good: _Lags, *, D: float, s: float, least: float) -> _Lags:
    """Return the lags that hold information on D, one at least; of very many a geometric part."""
    rate = np.arccosh(abs(1 + D / s)) if s else np.inf
    reach = 2 + np.ceil(_DECAY_LENGTHS / rate) if rate else np.inf
    count = int(min(max(reach, np.searchsorted(good.n, least) + 1), good.size))
    if count <= _MOST_LAGS:
        return good.take(slice(count))
    spaced = np.rint(np.geomspace(1, count, _MOST_LAGS)).astype(np.int64)
    return good.take(np.unique(spaced) - 1)


def _line_weights(n: Floats) -> Floats:
    """Return the weights (2, lags) that make slope and level of a line of least squares."""
    slope = (n - n.mean()) / np.sum((n - n.mean()) ** 2)
    return np.stack([slope, 1 / n.size - slope * n.mean()])


def _gls_weights(use: _Lags, *, D: float, s: float) -> Floats:
    """Return the weights (2, lags) that make slope and level of generalised least squares."""
    if D == s == 0:  # nothing moves: all weights are as good
        return _line_weights(use.n)
    design = np.stack([use.n, np.ones(use.size)], axis=1)
    covariance = np.zeros((use.size, use.size))
    for length, share in use.shares():
        inside = slice(share.size)
        part = _covariance(use.n[inside], length, seen=use.seen[inside], D=D, s=s)
        covariance[inside, inside] += part * np.multiply.outer(share, share)
    solved = np.linalg.solve(covariance, design)
    return np.asarray(np.linalg.solve(design.T @ solved, solved.T))


def _solution(curve: LagCurve, use: _Lags, weights: Floats) -> tuple[float, float]:
    """Return D per step and the offset that the weights make of the curve."""
    D, s = weights @ curve.value[use.index] / (2 * curve.dof)
    return float(D), float(s)


def _model(curve: LagCurve, use: _Lags, weights: Floats) -> tuple[float, float]:
    """Return the D and offset to calculate errors with: such as a noisy Brownian walk can have."""
    D, s = _solution(curve, use, weights)
    D = max(D, 0.0)
    return D, max(s, _FULL_BLUR * D)


def _variance(curve: LagCurve, use: _Lags, slope: Floats, *, D: float, s: float) -> float:
    """Return the variance of D per step as the weights make it of the curve."""
    variance = 0.0
    for length, share in use.shares():
        k = share.size
        weights = slope[:k] * share / 2
        variance += _quadratic_variance(weights, use.n[:k], length, seen=use.seen[:k], D=D, s=s)
    return variance / curve.n_walks


def _line_variance(curve: LagCurve, use: _Lags, *, D: float, s: float) -> float:
    """Return the variance of the slope of a straight line, per lag."""
    return _variance(curve, use, _line_weights(use.n)[0], D=D, s=s)


def _axis_warning(curve: LagCurve, *, value: float, stderr: float) -> tuple[str, ...]:
    """Say where a slope is the mean over directions that weigh the body's axes unequally."""
    if curve.ratio is None:
        return ()
    ratio, error = curve.ratio
    bias = abs(ratio - 1)
    if bias < _SURE * error or bias * value < _MATTERS * stderr:
        return ()
    return (
        "the slope is the mean over the directions averaged, which weigh the body's axes "
        f"unequally: {with_error(ratio, error)} times the mean over all axes, as the steps show. "
        "It equals D_R only for an isotropic body (estimate_diffusion and msad_vector give D_R, "
        "diffusion_tensor and msad_axes the values of single axes)",
    )


def _estimate(curve: LagCurve, use: _Lags, weights: Floats, *, method: str) -> DiffusionEstimate:
    """Return what the weights make of the curve, with the error of doing so."""
    dt = _step(curve)
    value, offset = _solution(curve, use, weights)
    D, s = _model(curve, use, weights)
    slope, level = (_variance(curve, use, w, D=D, s=s) for w in weights)
    parts = tuple(_variance(curve, use, weights[0], D=d, s=e) for d, e in ((1, 0), (1, 1), (0, 1)))
    ci68, ci95 = (_interval(value, parts, D=D, s=s, z=NORMAL[p], dt=dt) for p in (0.68, 0.95))
    unequal = _axis_warning(curve, value=value, stderr=float(np.sqrt(slope)))
    for text in unequal:
        warnings.warn(text, PrecisionWarning, stacklevel=3)
    found = Found(
        value=value / dt,
        ci68=ci68,
        ci95=ci95,
        offset=offset,
        offset_stderr=float(np.sqrt(level)),
        stderr=float(np.sqrt(slope)) / dt,
    )
    return DiffusionEstimate.judged(
        found,
        quantity="translation" if curve.quantity == "translation" else "rotation",
        method=method,
        n_frames=int(np.sum(_blocks(curve) + 1)),
        dt=dt,
        noise_variance=curve.noise,
        resolution_floor=curve.resolution_floor,
        warnings=unequal,
    )


def _interval(
    value: float, parts: tuple[float, ...], *, D: float, s: float, z: float, dt: float
) -> tuple[float, float]:
    """Return the D from which `value` is at most z of their own standard errors away.

    The variance is a D^2 + b D s + c s^2, so that the ends are roots of a quadratic: a large D
    scatters more than a small one, and the interval reaches further up than down. Below D = 0 the
    variance is that of the noise alone.
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
    return float(low) / dt, float(high) / dt


def _covariance(lags: Floats, steps: int, *, seen: Floats, D: float, s: float) -> Floats:
    """Return the covariance (L, L) of the MSD of a one-dimensional noisy Brownian walk at lags."""
    pairs = steps + 1 - lags
    near, far, itself = overlap_sums(lags, steps, seen=seen, D=D, s=s)
    short, whole = np.meshgrid(lags, pairs)
    sums = np.where(short <= whole, _at(near[..., None], short), _at(far[..., None], short))
    lower = 2 * np.tril(sums + np.diag(itself)) / pairs[:, None] / pairs
    return np.asarray(lower + np.tril(lower, -1).T)


def _quadratic_variance(
    weights: Floats, lags: Floats, steps: int, *, seen: Floats, D: float, s: float
) -> float:
    """Return weights . covariance . weights without the matrix.

    The double sum over lags a <= b of polynomials in a becomes one over b of cumulative sums.
    """
    b, pairs = lags, steps + 1 - lags
    near, far, itself = overlap_sums(b, steps, seen=seen, D=D, s=s)
    w = weights / pairs
    sums = np.cumsum(w * b ** np.arange(5)[:, None], axis=1)
    sums = np.concatenate([np.zeros((5, 1)), sums], axis=1)
    split = np.minimum(np.arange(b.size) + 1, np.searchsorted(b, pairs, side="right"))
    shorter = np.sum(near * sums[:, split] + far * (sums[:, 1:] - sums[:, split]), axis=0)
    own = np.where(b <= pairs, _at(near, b), _at(far, b))
    return float(2 * w @ (2 * shorter + w * (itself - own)))


def _at(coefficients: Floats, x: Floats) -> Floats:
    """Return the polynomials whose coefficients run along the first axis, each at its own x."""
    return np.asarray(polyval(x, coefficients, tensor=False))
