"""How much wider unequal axes make the error of one D for all of them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from perrin._arrays import Floats
    from perrin.likelihood import Track


def excess_scatter(tracks: Sequence[Track], D: float, theta: Floats) -> float:
    """Return the factor by which unequal axes raise the variance of their common D.

    The likelihood of one D for all axes finds the mean over axes (trace/3) whatever the tensor is,
    for the deviations of the axes cancel in its score. They do not cancel in the score's variance,
    which in sine mode k is sum_ab Lambda_ab^2 over A lambda^2 times that of equal axes. The
    deviations of D and of the noise are fitted to the cross powers of the axes, and what chance
    alone puts there is taken off: equal axes give 1 on average.

    Parameters
    ----------
    tracks : sequence of Track
        Of one quantity.
    D : float
    theta : ndarray, shape (G,)
        Noise of each track, as the likelihood found it.

    Returns
    -------
    float
        At least 1.
    """
    parts = [_excess(track, D, float(t)) for track, t in zip(tracks, theta, strict=True)]
    excess, scale = np.sum(parts, axis=0)
    return 1.0 + max(0.0, float(excess / scale)) if scale > 0 else 1.0


def _excess(track: Track, D: float, theta: float) -> tuple[float, float]:
    """Return sums over modes of the squared deviations, chance taken off, and of their scale."""
    count, axes = track.steps.size.shape
    if axes == 1 or count < 5:
        return 0.0, 0.0
    c = 1 - np.cos(np.pi * np.arange(1, count + 1) / (count + 1))
    weight, known = (
        np.mean([pair[0].mean(axis=0), pair[1].mean(axis=0)], axis=0)
        for pair in (track.weight, track.known)
    )
    noise = theta * weight + known
    # Uneven steps are taken as even ones of their mean duration: only a width depends on it.
    by_D, by_noise = 2 * (track.steps.duration.mean() - track.blur * c), 2 * c
    eigen = by_D * D + by_noise * noise.mean()
    if not np.all(eigen > 0):
        return 0.0, 0.0
    rows = np.stack([by_D, by_noise])
    seen = _cross_powers(track.steps.size) - by_noise[:, None, None] * np.diag(noise - noise.mean())
    seen -= np.trace(seen, axis1=1, axis2=2)[:, None, None] / axes * np.eye(axes)
    fisher = np.linalg.inv((rows / eigen) @ (rows / eigen).T)
    found = np.einsum("kab,pk->pab", seen, fisher @ (rows / eigen**2))
    deviation = np.einsum("pab,pk->kab", found, rows)
    chance = (axes - 1) * (axes + 2) * np.einsum("pk,pq,qk->k", rows, fisher, rows)
    score = _score(track, theta, by_D, by_noise * weight.mean(), eigen)
    excess = np.sum(score**2 * (np.sum(deviation**2, axis=(1, 2)) - chance))
    return float(excess), float(axes * np.sum((score * eigen) ** 2))


def _cross_powers(size: Floats) -> Floats:
    """Return the products of the axes' sine transforms, (M, A, A)."""
    from scipy.fft import dst

    modes = dst(size, type=1, norm="ortho", axis=0)
    return np.asarray(modes[:, :, None] * modes[:, None, :])


def _score(track: Track, theta: float, by_D: Floats, by_theta: Floats, eigen: Floats) -> Floats:
    """Return the weights of the modes in the score of D with theta profiled out."""
    if np.isinf(track.freedom):
        return by_D / eigen**2
    axes = track.steps.size.shape[1]
    known = track.freedom / (axes * theta**2) if theta > 0 else 0.0
    shared = np.sum(by_D * by_theta / eigen**2) / (np.sum((by_theta / eigen) ** 2) + known)
    return np.asarray((by_D - shared * by_theta) / eigen**2)
