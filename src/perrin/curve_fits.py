"""What D a curve shows: straight lines and generalised least squares, with the error they have."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.polynomial.polynomial import polyval

from perrin.diffusion import NORMAL, UNITS, DiffusionEstimate, Found
from perrin.lagged import overlap_sums

if TYPE_CHECKING:
    from collections.abc import Iterable

    from perrin._arrays import Floats, Ints
    from perrin.lagged import LagCurve

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


def fit_line(
    curve: LagCurve, *, lag_range: Literal["best", "paper"] | tuple[float, float] = "best"
) -> DiffusionEstimate:
    """Fit a straight line with a free offset to a curve (Hunter 2011, Eqs. 20, 22 and 24).

    Parameters
    ----------
    curve : LagCurve
        From `msad`, `msd` and their kin.
    lag_range : {"best", "paper"} or tuple of float
        "best": the lags 1 to m whose slope has the smallest expected error at the D and the noise
        that the curve itself shows. "paper": 3/220 to 1/10 of the duration, the paper's 3 s to
        22 s of 220 s, whose spread is a quarter of D however long the run. A tuple: first and last
        lag time used, s, both included.

    Returns
    -------
    DiffusionEstimate
        The slope over 2 dof. Its error is that of the procedure on Brownian motion, correlations
        between overlapping pairs included (the scatter about the line says nothing about it);
        exact for complete tracks, in the mean for frames missing at random, an approximation for
        pieces and for curves without drift. For the MSAD of several directions it is up to 10 %
        too large. ``n_frames`` counts the frames that the curve spans.

    Raises
    ------
    ValueError
        If a range holds fewer than 3 lags with data ("best": the curve fewer than 2), or the curve
        is a correlation.

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
    _require_line(curve)
    best = lag_range == "best"
    use = _best_window(curve, _useful_lags(curve)) if best else _window(curve, lag_range)
    return _estimate(curve, use, _line_weights(use), method="line")


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
        Its error is that of the procedure, as for `fit_line`. ``n_frames`` counts the frames that
        the curve spans.

    Raises
    ------
    ValueError
        If fewer than 2 lags have data, or the curve is a correlation.

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
    _require_line(curve)
    good = _useful_lags(curve)
    use = _best_window(curve, good)
    weights = _line_weights(use)
    D, s = _model(curve, use, weights)
    for _ in range(_ROUNDS):
        before = D, s
        use = _telling_lags(good, D=D, s=s, least=use[-1])
        weights = _gls_weights(curve, use, D=D, s=s)
        D, s = _model(curve, use, weights)
        if np.allclose(before, (D, s), rtol=1e-10, atol=1e-10 * D):
            break
    return _estimate(curve, use, weights, method="gls")


def _require_line(curve: LagCurve) -> None:
    """Refuse a curve without a slope: a correlation, or fewer than two lags."""
    if curve.quantity not in UNITS:
        raise ValueError("curve: expected an MSD or MSAD; a correlation is no straight line")
    count = np.count_nonzero(np.isfinite(curve.value))
    if count < 2:
        raise ValueError(f"curve: a slope needs at least 2 lags with data, this one has {count}")


def _window(curve: LagCurve, lag_range: str | tuple[float, float]) -> Ints:
    """Return the indices of the lags with data in a range of lag times."""
    dt, duration = float(curve.lagtime[0]), float(curve.lagtime[-1])
    if isinstance(lag_range, str):
        if lag_range != "paper":
            raise ValueError(
                f'lag_range: expected "best", "paper" or two lag times (s), got {lag_range!r}'
            )
        lag_range = (_PAPER[0] * (duration + dt), _PAPER[1] * (duration + dt))
    low, high = lag_range
    inside = (curve.lagtime > low - 1e-6 * dt) & (curve.lagtime < high + 1e-6 * dt)
    use = np.flatnonzero(inside & np.isfinite(curve.value))
    if use.size < 3:
        raise ValueError(
            f"lag_range: {low:g} to {high:g} s holds {use.size} lags with data, at least 3 are "
            f"needed; the curve runs from {dt:g} to {duration:g} s"
        )
    return use


def _best_window(curve: LagCurve, good: Ints) -> Ints:
    """Return the lags 1..m whose slope has the smallest expected error: a fixed point."""
    sizes = np.unique(np.rint(np.geomspace(2, good.size, 200)).astype(np.int64))
    tried: list[int] = []
    size = min(4, good.size)
    while size not in tried:
        tried.append(size)
        D, s = _model(curve, good[:size], _line_weights(good[:size]))
        errors = (_line_variance(curve, good[:m], D=D, s=s) for m in sizes)
        size = int(sizes[_first_minimum(errors)])
    # Windows that take turns are told apart by nothing; the longest keeps the noise at bay.
    return good[: max(tried[tried.index(size) :])]


def _useful_lags(curve: LagCurve) -> Ints:
    """Return the lags with data, up to the longest window that still says something of D."""
    good = np.flatnonzero(np.isfinite(curve.value))
    low, high = 2, good.size
    while low < high:  # bisection: the error of a noise-free slope grows with its window
        middle = (low + high + 1) // 2
        if _line_variance(curve, good[:middle], D=1.0, s=0.0) > _LONGEST**2:
            high = middle - 1
        else:
            low = middle
    return good[:low]


def _first_minimum(values: Iterable[float]) -> int:
    """Return where a sequence that falls and then rises has its minimum."""
    last, place = np.inf, -1
    for value in values:
        if value > last:
            break
        last, place = value, place + 1
    return place


def _telling_lags(good: Ints, *, D: float, s: float, least: np.int64) -> Ints:
    """Return the lags that tell about D, one at least; of very many, a geometric selection."""
    rate = np.arccosh(abs(1 + D / s)) if s else np.inf
    reach = 2 + np.ceil(_DECAY_LENGTHS / rate) if rate else np.inf
    count = int(min(max(reach, np.searchsorted(good, least) + 1), good.size))
    if count <= _MOST_LAGS:
        return good[:count]
    return good[np.unique(np.rint(np.geomspace(1, count, _MOST_LAGS)).astype(np.int64)) - 1]


def _line_weights(use: Ints) -> Floats:
    """Return the weights (2, lags) that make slope and level of a line of least squares."""
    n = use + 1.0
    slope = (n - n.mean()) / np.sum((n - n.mean()) ** 2)
    return np.stack([slope, 1 / n.size - slope * n.mean()])


def _gls_weights(curve: LagCurve, use: Ints, *, D: float, s: float) -> Floats:
    """Return the weights (2, lags) that make slope and level of generalised least squares."""
    if D == s == 0:  # nothing moves: all weights are as good
        return _line_weights(use)
    design = np.stack([use + np.float64(1), np.ones(use.size)], axis=1)
    covariance = _covariance(use, len(curve.lagtime), seen=_seen(curve, use), D=D, s=s)
    solved = np.linalg.solve(covariance, design)
    return np.asarray(np.linalg.solve(design.T @ solved, solved.T))


def _solution(curve: LagCurve, use: Ints, weights: Floats) -> tuple[float, float]:
    """Return D dt and the offset that the weights make of the curve."""
    D, s = weights @ curve.value[use] / (2 * curve.dof)
    return float(D), float(s)


def _model(curve: LagCurve, use: Ints, weights: Floats) -> tuple[float, float]:
    """Return the D dt and offset to reckon errors with: such as a noisy Brownian walk can have."""
    D, s = _solution(curve, use, weights)
    D = max(D, 0.0)
    return D, max(s, _FULL_BLUR * D)


def _seen(curve: LagCurve, use: Ints) -> Floats:
    """Return the part of the frames that is there, at each lag the root of that of the pairs."""
    walkers = curve.n_walks / curve.components.shape[1] if curve.quantity == "translation" else 1.0
    return np.asarray(np.sqrt(curve.n_pairs[use] / ((len(curve.lagtime) - use) * walkers)))


def _variance(curve: LagCurve, use: Ints, slope: Floats, *, D: float, s: float) -> float:
    """Return the variance of D dt as the weights make it of the curve."""
    weights, steps = slope / 2, len(curve.lagtime)
    variance = _quadratic_variance(weights, use, steps, seen=_seen(curve, use), D=D, s=s)
    return variance / curve.n_walks


def _line_variance(curve: LagCurve, use: Ints, *, D: float, s: float) -> float:
    """Return the variance of the slope of a straight line, per lag."""
    return _variance(curve, use, _line_weights(use)[0], D=D, s=s)


def _estimate(curve: LagCurve, use: Ints, weights: Floats, *, method: str) -> DiffusionEstimate:
    """Return what the weights make of the curve, with the error of doing so."""
    dt = float(curve.lagtime[0])
    value, offset = _solution(curve, use, weights)
    D, s = _model(curve, use, weights)
    slope, level = (_variance(curve, use, w, D=D, s=s) for w in weights)
    parts = tuple(_variance(curve, use, weights[0], D=d, s=e) for d, e in ((1, 0), (1, 1), (0, 1)))
    ci68, ci95 = (_interval(value, parts, D=D, s=s, z=NORMAL[p], dt=dt) for p in (0.68, 0.95))
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
        n_frames=len(curve.lagtime) + 1,
        dt=dt,
        noise_variance=curve.noise,
        resolution_floor=curve.resolution_floor,
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


def _covariance(use: Ints, steps: int, *, seen: Floats, D: float, s: float) -> Floats:
    """Return the covariance (L, L) of the MSD of a one-dimensional noisy Brownian walk at lags."""
    lags = use + np.float64(1)
    pairs = steps + 1 - lags
    near, far, itself = overlap_sums(lags, steps, seen=seen, D=D, s=s)
    short, whole = np.meshgrid(lags, pairs)
    sums = np.where(short <= whole, _at(near[..., None], short), _at(far[..., None], short))
    lower = 2 * np.tril(sums + np.diag(itself)) / pairs[:, None] / pairs
    return np.asarray(lower + np.tril(lower, -1).T)


def _quadratic_variance(
    weights: Floats, use: Ints, steps: int, *, seen: Floats, D: float, s: float
) -> float:
    """Return weights . covariance . weights without the matrix.

    The double sum over lags a <= b of polynomials in a becomes one over b of cumulative sums.
    """
    b = use + np.float64(1)
    pairs = steps + 1 - b
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
