"""Distributions of displacements and rotations over one lag time: the van Hove functions."""

from __future__ import annotations

from dataclasses import dataclass, fields
from math import erf
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from perrin._arrays import Floats, choice_fault, from_plain, frozen, refuse, to_plain
from perrin._display import Shown
from perrin.curves.displacement import angle_curve
from perrin.curves.gaussianity import brownian_angle_time, without_noise
from perrin.curves.grids import GRID_TOLERANCE
from perrin.curves.noise_offsets import center_offset, correction_fault, orientation_offsets
from perrin.curves.pairs import pairs_apart
from perrin.curves.standard_errors import two_lag_fit
from perrin.errors import TooFewFramesError
from perrin.geometry.rotations import log_map
from perrin.motion.simulate import heat_kernel_angles

if TYPE_CHECKING:
    import pandas as pd

    from perrin.motion.rigid_motion import RigidMotion

_HERMITE_ORDERS = 100  # beyond which the error of a bin is bounded from above


@dataclass(frozen=True, eq=False, repr=False)
class VanHove(Shown):
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
        Gaussian of the same mean square, averaged over each bin; for the angle that of the length
        of a Gaussian vector (Maxwell).
    alpha2 : float
        Non-Gaussian parameter <x^4>/(3 <x^2>^2) - 1, for the angle 3 <x^4>/(5 <x^2>^2) - 1,
        corrected for its bias in short tracks and for noise.
    alpha2_stderr : float
        Standard error of the non-Gaussian parameter about its Brownian value, for Brownian motion.
    n_pairs : int
        Number of pairs of frames.
    quantity : {"rotation", "translation", "angle"}
        Whether rotations, displacements or angles of rotations were measured.
    unit : str
        Unit of the edges: "rad" or "um".
    brownian : ndarray, shape (B,)
        Law of Brownian motion of the same mean square, noise included, averaged over each bin: the
        heat kernel on SO(3) for the angle, else the Gaussian.
    alpha2_brownian : float
        Non-Gaussian parameter of Brownian motion without noise: `brownian_alpha2` for the angle,
        else 0.
    alpha2_measured : float
        Non-Gaussian parameter of the noisy motion.
    noise : float
        Noise variance of one axis of one frame that alpha2 is corrected for, rad^2 or um^2.
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
    brownian: Floats
    alpha2_brownian: float
    alpha2_measured: float
    noise: float

    def __post_init__(self) -> None:
        frozen(self.edges, self.density, self.stderr, self.gaussian, self.brownian)

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
                "brownian": self.brownian,
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
        arrays = ("edges", "density", "stderr", "gaussian", "brownian")
        read = entry | {name: from_plain(entry[name]) for name in arrays}
        read["alpha2"] = np.nan if entry["alpha2"] is None else entry["alpha2"]
        read["alpha2_stderr"] = np.inf if entry["alpha2_stderr"] is None else entry["alpha2_stderr"]
        return cls(**read)


def van_hove(
    motion: RigidMotion,
    *,
    lag: float,
    quantity: Literal["rotation", "translation", "angle"] = "rotation",
    bins: int | ArrayLike = 31,
    noise: Literal["residual", "joint"] | float | None = "residual",
) -> VanHove:
    """Return the distribution of rotations or displacements over one lag time (van Hove).

    Parameters
    ----------
    motion : RigidMotion
        Positions and orientations against time.
    lag : float
        Lag time, s, a whole number of frames; pairs within a tenth of dt of it are used.
    quantity : {"rotation", "translation", "angle"}
        Rotations are differences of the unbounded `RigidMotion.accumulated_rotation`, not the
        rotation vectors between both frames, which end at pi; their law is Gaussian for Brownian
        motion. The angle is that of the rotation between both frames, 0 to pi, whose law is the
        heat kernel on SO(3); in the plane it is the rotation. Components along all lab axes are
        taken together.
    bins : int or array_like, shape (B + 1,)
        Number of equal bins from the lowest to the highest value, symmetric about 0, or their edges
        (rad or um); values beyond given edges lower the density's integral. The bins of the angle
        begin at 0.
    noise : "residual", "joint", float or None
        Noise that alpha2 is corrected for, as in `non_gaussian`: Gaussian noise makes every
        distribution more Gaussian. The densities are those that were measured.

    Returns
    -------
    VanHove

    Raises
    ------
    ValueError
        For a lag off the grid of frames, bad bins, quantity or noise, or a body that does not move.
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
    faults = choice_fault("quantity", quantity, ("rotation", "translation", "angle"))
    faults += correction_fault(noise)
    dt, span = motion.dt, motion.time[-1] - motion.time[0]
    steps = round(lag / dt)
    if abs(steps * dt - lag) > 1e-3 * dt or not 1 <= steps <= span / dt + GRID_TOLERANCE:
        faults.append(f"lag: expected a multiple of dt = {dt:g} s up to {span:g} s, got {lag!r}")
    edges = None if np.ndim(bins) == 0 else np.array(bins, dtype=np.float64)
    refuse(faults + bins_fault(bins))

    rows = motion.fitted
    first, last = pairs_apart(motion.time[rows] / dt, motion.piece[rows], lag / dt)
    first, last = rows[first], rows[last]
    if not len(first):
        raise TooFewFramesError(f"no two frames of one piece are {lag:g} s apart", 0)
    if quantity == "translation":
        walk, offset = motion.center, center_offset(motion, noise)
    else:
        walk = motion.accumulated_rotation()
        covariance = orientation_offsets(motion, noise)[rows].mean(axis=0)
        offset = float(np.trace(covariance)) / len(covariance)
    angles = quantity == "angle" and motion.dimension == 3
    x = walk[last] - walk[first]
    if angles:
        turned = np.swapaxes(motion.rotation[first], -1, -2) @ motion.rotation[last]
        x = np.linalg.norm(log_map(turned), axis=-1, keepdims=True)
    axes = walk.shape[1] if angles else 1
    square = float(np.mean(x * x)) / axes
    if square == 0:
        raise ValueError(
            "the body does not move: the distribution of its displacements has no width"
        )
    if edges is None:
        reach = float(np.abs(x).max())
        edges = np.linspace(0.0 if angles else -reach, reach, int(np.asarray(bins)) + 1)
    powers = mean_correlation_powers(motion, walk, lag, pairs=len(x)) / walk.shape[1]
    heat = float(brownian_angle_time(3 * square)) if angles else 0.5 * square
    expected, spread = (radial_bins if angles else gaussian_bins)(edges / np.sqrt(square), powers)
    width, brownian = np.diff(edges), expected
    if angles:
        brownian = np.diff(np.interp(edges, *heat_kernel_angles(heat), left=0.0, right=1.0))
    # The mean of r^4 over that of a Gaussian vector of `axes` components.
    raw = float(np.mean(x**4) * axes / ((axes + 2) * (axes * square) ** 2) - 1 + 2 * powers[1])
    alpha2, law, gain = np.nan, np.nan, np.inf
    if heat > offset:
        corrected, law = without_noise(raw, heat, offset=offset, curved=angles)
        alpha2 = float(corrected)
        gain = (heat / (heat - offset)) ** 2
    return VanHove(
        lagtime=float(np.mean(motion.time[last] - motion.time[first])),
        edges=edges,
        density=np.histogram(x, edges)[0] / (x.size * width),
        stderr=spread / width,
        gaussian=expected / width,
        alpha2=alpha2,
        alpha2_stderr=float(np.sqrt(8 / (axes + 2) * powers[3])) * gain,
        n_pairs=len(x),
        quantity="angle" if angles else quantity.replace("angle", "rotation"),
        unit="um" if quantity == "translation" else "rad",
        brownian=brownian / width,
        alpha2_brownian=law,
        alpha2_measured=raw,
        noise=offset,
    )


def bins_fault(bins: int | ArrayLike) -> list[str]:
    """Return one line where bins are neither a number of them nor rising edges, or no line.

    Examples
    --------
    >>> bins_fault(31), bins_fault([0.0, 0.5, 0.2])
    ([], ['bins: expected a number, or rising edges, at least two of them'])
    """
    if np.ndim(bins) == 0:
        return [] if int(np.asarray(bins)) >= 1 else [f"bins: expected at least 1, got {bins!r}"]
    edges = np.asarray(bins, dtype=np.float64)
    if edges.ndim == 1 and edges.size > 1 and np.all(np.diff(edges) > 0):
        return []
    return ["bins: expected a number, or rising edges, at least two of them"]


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


def radial_bins(r: Floats, powers: Floats) -> tuple[Floats, Floats]:
    """Return the part of the lengths of unit Gaussian vectors in each bin, and its error.

    As `gaussian_bins`, with Laguerre polynomials of r^2/2: two vectors whose components have the
    correlation c contribute c^(2k) to the k-th.

    Parameters
    ----------
    r : ndarray, shape (B + 1,)
        Edges of the bins in standard deviations of one of the three components; negative ones are
        taken as 0.
    powers : ndarray, shape (K,)
        Third parts of the means of the powers of the correlation.

    Returns
    -------
    part, stderr : ndarray, shape (B,)

    Examples
    --------
    >>> part, stderr = radial_bins(np.array([0.0, 1.0]), np.full(100, 1 / 1500))
    >>> float(part[0].round(4)), float(stderr[0].round(4))  # the root of p (1 - p)/500
    (0.1987, 0.0178)
    """
    edge = np.maximum(r, 0.0)
    below = np.array([erf(x / np.sqrt(2)) for x in edge])
    part = np.diff(below - np.sqrt(2 / np.pi) * edge * np.exp(-edge * edge / 2))
    # The integral of L_k^(1/2) over its weight is that weight times L_(k-1)^(3/2) x/k.
    x = edge * edge / 2
    weight = x**1.5 * np.exp(-x) * 2 / np.sqrt(np.pi)
    last, this = np.zeros_like(x), np.ones_like(x)
    variance, rest, norm = np.zeros_like(part), part * (1 - part), 1.0
    orders = len(powers) // 2
    for k in range(1, orders + 1):
        norm *= (k + 0.5) / k  # the mean square of L_k^(1/2)
        coefficient = np.diff(weight * this / k) ** 2 / norm
        variance, rest = variance + coefficient * 3 * powers[2 * k - 1], rest - coefficient
        last, this = this, ((2 * k + 0.5 - x) * this - (k + 0.5) * last) / k
    return part, np.sqrt(variance + np.maximum(rest, 0.0) * 3 * powers[-1])
