"""D from averages over steps in closed form: the covariance estimator and the mean cosine."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from perrin._arrays import Floats, Ints
    from perrin.diffusion.steps import NoisySteps
    from perrin.motion.rigid_motion import RigidMotion


class Moments(NamedTuple):
    """A value of D and the noise offset, with their standard errors.

    Attributes
    ----------
    value : float
        D in um^2/s or rad^2/s.
    stderr : float
        Standard error of D.
    offset : float
        Noise variance of one centre coordinate (um^2) or orientation (rad^2) less motion blur.
    offset_stderr : float
        Standard error of the offset; NaN where it is not known.
    """

    value: float
    stderr: float
    offset: float
    offset_stderr: float


class _QuadraticForm(NamedTuple):
    """A quadratic form in the steps of each axis: its value, and weights of squares and products.

    Products are those of neighbouring steps, which share a frame.
    """

    value: float
    square: float
    cross: float


def covariance_estimate(tracks: Sequence[NoisySteps]) -> Moments:
    """Estimate D from mean squares and products of neighbouring steps.

    With the noise free, D = <y^2>/2t + <y y'>/t (Vestergaard, Blainey and Flyvbjerg 2014): the
    negative correlation that the shared frame gives two steps subtracts the noise. With the noise
    given, D = (<y^2> - 2 s)/2t. Gaps enter with their durations.

    The errors are those of a quadratic form in Gaussian steps with the covariance found.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=3)
    >>> from perrin.diffusion import Noise, NoisySteps, steps_of
    >>> found = covariance_estimate([NoisySteps.of(steps_of(truth, "rotation"), Noise())])
    >>> bool(abs(found.value - 5e-3) < 3 * found.stderr)
    True
    """
    free = tracks[0].freedom == 0
    total = 2 * sum(
        t.steps.vectors.shape[1] * float(np.sum(t.steps.duration - (0 if free else t.blur)))
        for t in tracks
    )
    # The form of each track whose mean is D times twice the time spent, all axes together.
    forms = []
    for track in tracks:
        squares = float(np.sum(track.steps.vectors**2))
        known = sum(float(k.sum()) for k in track.known)
        if free:
            linked = track.steps.linked[:-1]
            share = len(track.steps.vectors) / max(int(linked.sum()), 1)
            known -= 2 * share * _known_at_links(track)
            products = 2 * share * _neighbour_products(track)
            forms.append(_QuadraticForm(squares + products - known, 1.0, share))
        else:
            known += sum(float(w.sum()) for w in track.weight) * track.theta
            forms.append(_QuadraticForm(squares - known, 1.0, 0.0))
    value = sum(form.value for form in forms) / total
    variance, offset_variance, offsets = 0.0, 0.0, []
    for track, form in zip(tracks, forms, strict=True):
        if free:
            pairs = int(track.steps.linked[:-1].sum()) * track.steps.vectors.shape[1]
            pairs = max(pairs, 1)
            offset = -(_neighbour_products(track) + _known_at_links(track)) / pairs
            product = _QuadraticForm(offset, 0.0, 0.5 / pairs)
            offset_variance += _form_variance(track, product, value, offset)
        else:
            offset = track.theta - track.blur * value
        offsets.append(offset + track.level)
        variance += _form_variance(track, form, value, offset)
        if 0 < track.freedom < np.inf:
            noise = sum(float(w.sum()) for w in track.weight) * track.theta
            variance += 2 / track.freedom * noise**2
            offset_variance += 2 / track.freedom * track.theta**2
    return Moments(
        value,
        float(np.sqrt(variance)) / total,
        float(np.mean(offsets)),
        float(np.sqrt(offset_variance)) / len(tracks),
    )


def _known_at_links(track: NoisySteps) -> float:
    """Return the known noise variance of the frames that two steps share, summed."""
    return float(track.known[1][:-1][track.steps.linked[:-1]].sum())


def _neighbour_products(track: NoisySteps) -> float:
    """Return the products of neighbouring steps that share a frame, summed over steps and axes."""
    y = track.steps.vectors
    return float(np.sum((y[:-1] * y[1:])[track.steps.linked[:-1]]))


def _form_variance(track: NoisySteps, form: _QuadraticForm, D: float, offset: float) -> float:
    """Return the variance of a form, 2 tr (QC)^2 for every axis, with both matrices banded."""
    s = track.steps
    linked = s.linked[:-1, None]
    first, last = (
        (w * offset if track.freedom == 0 else w * track.theta - track.blur * D) + k
        for w, k in zip(track.weight, track.known, strict=True)
    )
    a = 2 * max(D, 0.0) * s.duration[:, None] + first + last
    b = -last[:-1] * linked
    q, r = form.square, form.cross * linked
    none = np.zeros((1, a.shape[1]))
    rb = np.concatenate([none, r * b]) + np.concatenate([r * b, none])
    diagonal = q * a + rb
    upper = q * b + r * a[1:]
    lower = q * b + r * a[:-1]
    # Second off-diagonal: Q_{i,i+1} C_{i+1,i+2}, and its transpose.
    far = (r[:-1] * b[1:]) * (r[1:] * b[:-1])
    return 2 * float(np.sum(diagonal**2) + 2 * np.sum(upper * lower) + 2 * np.sum(far))


def trace_estimate(
    motions: Sequence[RigidMotion], *, noise: Sequence[float] | None, blur: float
) -> Moments:
    """Estimate D_R from mean cosines of the step angle, exact at any step length.

    For Brownian rotation <tr R_k^T R_{k+1}>/3 = exp(-2 D t) whatever D t is (in the plane
    <cos> = exp(-D t)). Noise adds 2 s (s in the plane) to the exponent: with the noise free it is
    subtracted as the difference between two steps and one.

    Parameters
    ----------
    motions : sequence of RigidMotion
        Motions with one common dt; only pairs exactly one or two dt apart are used.
    noise : sequence of float, optional
        Orientation variance of each motion, rad^2; None leaves it free.
    blur : float
        b of the offset s - b D, s.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=3)
    >>> found = trace_estimate([truth], noise=None, blur=0.0)
    >>> bool(abs(found.value - 5e-3) < 3 * found.stderr)
    True
    """
    dt = motions[0].dt
    if any(abs(m.dt - dt) > 1e-9 * dt for m in motions):
        raise ValueError('method="trace" needs one dt for all motions')
    lags = [step_cosines(m, lag) for m in motions for lag in (1, 2)]
    one, two = np.concatenate(lags[0::2]), np.concatenate(lags[1::2])
    rate = 1.0 if motions[0].template.shape[1] == 2 else 2.0
    if not np.isfinite(one).any() or not np.isfinite(two).any():
        raise ValueError('method="trace" needs frames one and two dt apart')
    f1, v1 = _cosine_exponent(one)
    f2, v2 = _cosine_exponent(two)
    if noise is None:
        value = (f2 - f1) / (rate * dt)
        return Moments(
            value,
            _correlated_error(v2 - v1) / (rate * dt),
            (2 * f1 - f2) / rate,
            _correlated_error(2 * v1 - v2) / rate,
        )
    s = float(np.mean(noise))
    value = (f1 / rate - s) / (dt - blur)
    return Moments(value, _correlated_error(v1) / (rate * (dt - blur)), s - blur * value, np.nan)


def step_cosines(motion: RigidMotion, lag: int) -> Floats:
    """Return tr(R^T R')/d of every frame and the one `lag` dt later; NaN where there is none.

    Two empty rows at the end keep the frames of different motions apart; longer gaps between
    frames are cut to two empty rows, so that absent frames need no memory.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=1e-9, dt=0.7, n_frames=4, rng=3)
    >>> step_cosines(truth, 2).round(3)
    array([ 1.,  1., nan, nan, nan, nan])
    """
    rows = motion.fitted
    slot: Ints = np.rint((motion.time[rows] - motion.time[rows[0]]) / motion.dt).astype(np.int64)
    exact = np.abs(motion.time[rows] - motion.time[rows[0]] - slot * motion.dt) < 1e-3 * motion.dt
    used = slot[exact]
    place = np.append(0, np.cumsum(np.minimum(np.diff(used), 3)))
    where = np.full(int(place[-1]) + 3, -1)
    where[place] = rows[exact]
    first, last = where[:-lag], where[lag:]
    both = (first >= 0) & (last >= 0) & (motion.piece[first] == motion.piece[last])
    found = np.full(len(where), np.nan)
    product = motion.rotation[first[both]] * motion.rotation[last[both]]
    found[: len(both)][both] = product.sum(axis=(1, 2)) / motion.template.shape[1]
    return found


def _cosine_exponent(cosine: Floats) -> tuple[float, Floats]:
    """Return -log of the mean cosine, and the contribution of every pair to its error."""
    here = np.isfinite(cosine)
    mean, spread = float(cosine[here].mean()), float(cosine[here].std())
    if mean <= 3 * spread / np.sqrt(here.sum()):
        raise ValueError(
            "the steps are so long that the orientation is lost between frames (mean cosine "
            f"{mean:.2g} of {here.sum()} steps, not clear of 0): D_R cannot be determined from "
            "them; sample more often"
        )
    return -np.log(mean), np.where(here, (mean - cosine) / (mean * here.sum()), 0.0)


def _correlated_error(influence: Floats) -> float:
    """Return the standard error of a sum of terms that are correlated up to two frames apart."""
    own = float(influence @ influence)
    total = own + 2 * sum(float(influence[:-k] @ influence[k:]) for k in (1, 2))
    return float(np.sqrt(total if total > 0 else own))
