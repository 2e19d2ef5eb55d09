"""Distributions of displacements and rotations over one lag time: the van Hove functions."""

from __future__ import annotations

from dataclasses import dataclass, fields
from math import erf
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from perrin._arrays import Floats, choice_fault, from_plain, frozen, refuse, to_plain
from perrin.curves.displacement import angle_curve
from perrin.curves.grids import GRID_TOLERANCE
from perrin.curves.standard_errors import two_lag_fit
from perrin.errors import TooFewFramesError

if TYPE_CHECKING:
    import pandas as pd

    from perrin.motion.rigid_motion import RigidMotion

_HERMITE_ORDERS = 100  # beyond which the error of a bin is bounded from above


@dataclass(frozen=True, eq=False)
class VanHove:
    """Distribution of displacements or rotations over one lag time, compared with a Gaussian.

    Attributes
    ----------
    lagtime : float
        Mean time between the frames of the pairs, s.
    edges : ndarray, shape (B + 1,)
        Edges of the bins, rad or um.
    density : ndarray, shape (B,)
        Probability per rad or um, all components of all pairs together.
    stderr : ndarray, shape (B,)
        Standard error of the density for Gaussian motion; it accounts for overlapping pairs.
    gaussian : ndarray, shape (B,)
        Gaussian of the same mean square, averaged over each bin.
    alpha2 : float
        Non-Gaussian parameter <x^4>/(3 <x^2>^2) - 1, corrected for its bias in short tracks.
    alpha2_stderr : float
        Standard error of the non-Gaussian parameter about 0 for Gaussian motion.
    n_pairs : int
        Number of pairs of frames.
    quantity : {"rotation", "translation"}
        Whether rotations or displacements were measured.
    unit : str
        Unit of the edges: "rad" or "um".
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

    def to_dict(self) -> dict[str, Any]:
        """Return the distribution for JSON: lists for arrays, None for what is not finite.

        Returns
        -------
        dict
            An entry per attribute.

        Examples
        --------
        >>> from perrin import Cluster, simulate_motion
        >>> truth = simulate_motion(Cluster.tetrahedron(1.0), D_R=1e-3, dt=1.0, n_frames=50, rng=0)
        >>> van_hove(truth, lag=10.0, bins=[-0.1, 0.0, 0.1]).to_dict()["edges"]
        [-0.1, 0.0, 0.1]
        """
        return {field.name: to_plain(getattr(self, field.name)) for field in fields(self)}

    @classmethod
    def from_dict(cls, entry: dict[str, Any]) -> VanHove:
        """Return the distribution that `to_dict` wrote.

        Parameters
        ----------
        entry : dict
            As `to_dict` returns it, also after a round trip through JSON.

        Returns
        -------
        VanHove

        Examples
        --------
        >>> from perrin import Cluster, simulate_motion
        >>> truth = simulate_motion(Cluster.tetrahedron(1.0), D_R=1e-3, dt=1.0, n_frames=50, rng=0)
        >>> VanHove.from_dict(van_hove(truth, lag=10.0).to_dict()).n_pairs
        40
        """
        arrays = ("edges", "density", "stderr", "gaussian")
        return cls(**(entry | {name: from_plain(entry[name]) for name in arrays}))


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
        Positions and orientations against time.
    lag : float
        Lag time, s, a whole number of frames; pairs within a tenth of dt of it are used.
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
    faults = choice_fault("quantity", quantity, ("rotation", "translation"))
    dt, span = motion.dt, motion.time[-1] - motion.time[0]
    steps = round(lag / dt)
    if abs(steps * dt - lag) > 1e-3 * dt or not 1 <= steps <= span / dt + GRID_TOLERANCE:
        faults.append(f"lag: expected a multiple of dt = {dt:g} s up to {span:g} s, got {lag!r}")
    edges = None if np.ndim(bins) == 0 else np.array(bins, dtype=np.float64)
    if edges is None and int(np.asarray(bins)) < 1:
        faults.append(f"bins: expected at least 1, got {bins!r}")
    if edges is not None and (edges.ndim != 1 or edges.size < 2 or not np.all(np.diff(edges) > 0)):
        faults.append("bins: expected a number, or rising edges, at least two of them")
    refuse(faults)

    rows = motion.fitted
    time = motion.time[rows]
    low, high = (time + lag + sign * GRID_TOLERANCE * dt for sign in (-1, 1))
    partner = np.searchsorted(time, low)
    there = np.flatnonzero(partner < np.searchsorted(time, high, side="right"))
    first, last = rows[there], rows[partner[there]]
    same = motion.piece[first] == motion.piece[last]
    first, last = first[same], last[same]
    if not len(first):
        raise TooFewFramesError(f"no two frames of one piece are {lag:g} s apart", 0)

    walk = motion.accumulated_rotation() if quantity == "rotation" else motion.center
    x = walk[last] - walk[first]
    square = float(np.mean(x * x))
    if square == 0:
        raise ValueError(
            "the body does not move: the distribution of its displacements has no width"
        )
    if edges is None:
        reach = float(np.abs(x).max())
        edges = np.linspace(-reach, reach, int(np.asarray(bins)) + 1)
    powers = mean_correlation_powers(motion, walk, lag, pairs=len(x)) / x.shape[1]
    expected, spread = gaussian_bins(edges / np.sqrt(square), powers)
    width = np.diff(edges)
    return VanHove(
        lagtime=float(np.mean(motion.time[last] - motion.time[first])),
        edges=edges,
        density=np.histogram(x, edges)[0] / (x.size * width),
        stderr=spread / width,
        gaussian=expected / width,
        alpha2=float(np.mean(x**4) / (3 * square**2) - 1 + 2 * powers[1]),
        alpha2_stderr=float(np.sqrt(8 / 3 * powers[3])),
        n_pairs=len(x),
        quantity=quantity,
        unit="rad" if quantity == "rotation" else "um",
    )


def mean_correlation_powers(motion: RigidMotion, walk: Floats, lag: float, *, pairs: int) -> Floats:
    """Return for k = 1..100 the mean of correlation^k over all pairs of displacements.

    It is the variance of the mean of the kth normalised Hermite polynomial of one component, if
    the motion is Gaussian.

    Parameters
    ----------
    motion : RigidMotion
        Motion that the walk belongs to.
    walk : ndarray, shape (T, c)
        Centre (um) or accumulated rotation (rad) of the body.
    lag : float
        Lag time of the displacements, s.
    pairs : int
        Number of displacements.

    Returns
    -------
    ndarray, shape (100,)

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(
    ...     Cluster.tetrahedron(1.5), D_R=5e-3, D_T=0.04, dt=0.7, n_frames=300, rng=3
    ... )
    >>> powers = mean_correlation_powers(truth, truth.center, 0.7, pairs=299)
    >>> bool(abs(299 * powers[99] - 1) < 0.01)  # they share no time
    True
    """
    curve = angle_curve(motion, walk[:, None], dof=1)
    step = curve.step or motion.dt
    steps = round(lag / step)
    d, s = two_lag_fit(curve.lagtime / step, curve.value / 2, curve.n_pairs)
    apart = np.arange(steps + 1.0)
    correlation = d * (steps - apart)
    correlation[0] += s
    correlation[-1] -= s / 2
    correlation /= d * steps + s
    count = np.maximum(1 - apart / pairs, 0) * np.where(apart > 0, 2, 1) / pairs
    return np.array([count @ correlation**k for k in range(1, _HERMITE_ORDERS + 1)])


def gaussian_bins(z: Floats, powers: Floats) -> tuple[Floats, Floats]:
    """Return the part of a unit Gaussian in each bin, and the error of counting it.

    The variance of a count is the sum of its squared Hermite coefficients, each times the variance
    of the mean of that polynomial (Mehler); the orders left out have the variance of the last one.

    Parameters
    ----------
    z : ndarray, shape (B + 1,)
        Edges of the bins in standard deviations.
    powers : ndarray, shape (K,)
        Variance of the mean of each normalised Hermite polynomial, from `mean_correlation_powers`.

    Returns
    -------
    part, stderr : ndarray, shape (B,)

    Examples
    --------
    >>> part, stderr = gaussian_bins(np.array([-1.0, 1.0]), np.full(100, 1 / 500))
    >>> float(part[0].round(3)), float(stderr[0].round(4))  # the root of p (1 - p)/500
    (0.683, 0.0208)
    """
    below = np.array([erf(edge / np.sqrt(2)) for edge in z]) / 2
    part = np.diff(below)
    last, this = np.zeros_like(z), np.exp(-z * z / 2) / np.sqrt(2 * np.pi)
    variance, rest = np.zeros_like(part), part * (1 - part)
    for k, power in enumerate(powers, start=1):
        coefficient = np.diff(this) ** 2 / k
        variance, rest = variance + coefficient * power, rest - coefficient
        last, this = this, (z * this - np.sqrt(k - 1) * last) / np.sqrt(k)
    return part, np.sqrt(variance + np.maximum(rest, 0.0) * powers[-1])
