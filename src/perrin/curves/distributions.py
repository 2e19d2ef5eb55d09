"""Distributions of displacements: the van Hove functions."""

from __future__ import annotations

from dataclasses import dataclass
from math import erf
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike

from perrin._arrays import Floats, frozen
from perrin.curves.displacement import _pairs_apart, _turned, _walk
from perrin.curves.pairs import first_look
from perrin.errors import TooFewFramesError

if TYPE_CHECKING:
    import pandas as pd

    from perrin.motion.rigid_motion import RigidMotion


_ORDERS = 100  # of Hermite polynomials, beyond which the error of a bin is bounded from above


@dataclass(frozen=True, eq=False)
class VanHove:
    """How displacements or rotations over one lag time are distributed, beside a Gaussian.

    Attributes
    ----------
    lagtime : float
        Mean over the pairs, s.
    edges : ndarray, shape (B + 1,)
        Of the bins, rad or um.
    density : ndarray, shape (B,)
        Probability per rad or um, all components of all pairs together.
    stderr : ndarray, shape (B,)
        What `density` would scatter by if the motion were Gaussian, overlapping pairs counted as
        what they are.
    gaussian : ndarray, shape (B,)
        The Gaussian of the same mean square, averaged over each bin.
    alpha2 : float
        Non-Gaussian parameter <x^4>/(3 <x^2>^2) - 1, freed from its bias in short tracks.
    alpha2_stderr : float
        What `alpha2` would scatter by about 0 if the motion were Gaussian.
    n_pairs : int
        Pairs of frames.
    quantity : {"rotation", "translation"}
    unit : str
        Of the edges.
    """

    lagtime: float
    edges: Floats
    density: Floats
    stderr: Floats
    gaussian: Floats
    alpha2: float
    alpha2_stderr: float
    n_pairs: int
    quantity: str
    unit: str

    def __post_init__(self) -> None:
        frozen(self.edges, self.density, self.stderr, self.gaussian)

    def to_frame(self) -> pd.DataFrame:
        """Return a table with a row per bin."""
        import pandas as pd

        return pd.DataFrame(
            {
                "low": self.edges[:-1],
                "high": self.edges[1:],
                "density": self.density,
                "stderr": self.stderr,
                "gaussian": self.gaussian,
            }
        )


def van_hove(
    motion: RigidMotion,
    *,
    lag: float,
    quantity: Literal["rotation", "translation"] = "rotation",
    bins: int | ArrayLike = 31,
) -> VanHove:
    """Return the distribution of rotations or displacements over one lag time (van Hove).

    Parameters
    ----------
    motion : RigidMotion
    lag : float
        s, a whole number of frames; pairs within a tenth of dt of it are used.
    quantity : {"rotation", "translation"}
        Rotations are differences of the unbounded `RigidMotion.accumulated_rotation`, not the
        rotation vectors between both frames, which end at pi. Components along all lab axes are
        taken together.
    bins : int or array_like, shape (B + 1,)
        Number of equal bins from the lowest to the highest value, symmetric about 0, or their edges
        (rad or um); values beyond given edges lower the density's integral.

    Returns
    -------
    VanHove

    Raises
    ------
    ValueError
        For a lag off the grid of frames, bad bins or quantity, or a body that does not move.
    TooFewFramesError
        If no two frames are that lag apart.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.0), D_R=1e-3, dt=1.0, n_frames=20000, rng=0)
    >>> result = van_hove(truth, lag=10.0)
    >>> abs(result.alpha2) < 3 * result.alpha2_stderr
    True
    """
    walk = _walk(motion, lag=lag, quantity=quantity)
    first, last = _pairs_apart(motion, lag)
    if not len(first):
        raise TooFewFramesError(f"no two frames of one piece are {lag:g} s apart", 0)
    x = walk[last] - walk[first]
    square = float(np.mean(x * x))
    if square == 0:
        raise ValueError("nothing moves: a distribution at rest has no width")
    edges = _bin_edges(bins, reach=float(np.abs(x).max()))
    shared = _shared(motion, walk, lag, pairs=len(x)) / x.shape[1]
    expected, spread = _gaussian_bins(edges / np.sqrt(square), shared)
    width = np.diff(edges)
    return VanHove(
        lagtime=float(np.mean(motion.time[last] - motion.time[first])),
        edges=edges,
        density=np.histogram(x, edges)[0] / (x.size * width),
        stderr=spread / width,
        gaussian=expected / width,
        alpha2=float(np.mean(x**4) / (3 * square**2) - 1 + 2 * shared[1]),
        alpha2_stderr=float(np.sqrt(8 / 3 * shared[3])),
        n_pairs=len(x),
        quantity=quantity,
        unit="rad" if quantity == "rotation" else "um",
    )


def _bin_edges(bins: int | ArrayLike, *, reach: float) -> Floats:
    """Return the edges asked for, or so many equal bins out to `reach` on both sides."""
    if np.ndim(bins) == 0:
        count = int(np.asarray(bins))
        if count < 1:
            raise ValueError(f"bins: expected at least 1, got {bins!r}")
        return np.linspace(-reach, reach, count + 1)
    edges = np.array(bins, dtype=np.float64)
    if edges.ndim != 1 or edges.size < 2 or not np.all(np.diff(edges) > 0):
        raise ValueError("bins: expected a number, or rising edges, at least two of them")
    return edges


def _shared(motion: RigidMotion, walk: Floats, lag: float, *, pairs: int) -> Floats:
    """Return for k = 1.._ORDERS the mean over all pairs of displacements of correlation^k.

    It is the variance of the mean of the kth normalised Hermite polynomial of one component, if
    the motion is Gaussian.
    """
    curve = _turned(motion, walk[:, None], dof=1)
    step = curve.step or motion.dt
    steps = round(lag / step)
    d, s = first_look(curve.lagtime / step, curve.value / 2, curve.n_pairs)
    apart = np.arange(steps + 1.0)
    correlation = d * (steps - apart)
    correlation[0] += s
    correlation[-1] -= s / 2
    correlation /= d * steps + s
    count = np.maximum(1 - apart / pairs, 0) * np.where(apart > 0, 2, 1) / pairs
    return np.array([count @ correlation**k for k in range(1, _ORDERS + 1)])


def _gaussian_bins(z: Floats, shared: Floats) -> tuple[Floats, Floats]:
    """Return what part of a unit Gaussian lies in each bin, and the error of counting it.

    The variance of a count is the sum of its squared Hermite coefficients, each over how often
    that order was seen independently (Mehler); the orders left out count as the last one.
    """
    below = np.array([erf(edge / np.sqrt(2)) for edge in z]) / 2
    part = np.diff(below)
    last, this = np.zeros_like(z), np.exp(-z * z / 2) / np.sqrt(2 * np.pi)
    variance, rest = np.zeros_like(part), part * (1 - part)
    for k, times in enumerate(shared, start=1):
        coefficient = np.diff(this) ** 2 / k
        variance, rest = variance + coefficient * times, rest - coefficient
        last, this = this, (z * this - np.sqrt(k - 1) * last) / np.sqrt(k)
    return part, np.sqrt(variance + np.maximum(rest, 0.0) * shared[-1])
