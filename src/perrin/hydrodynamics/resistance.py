"""Resistance of a rigid body of spheres in a viscous fluid, from Lamb's solutions."""

from __future__ import annotations

import warnings
from dataclasses import asdict, dataclass
from functools import lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from perrin._arrays import Floats, from_plain, frozen, to_plain
from perrin.errors import PrecisionWarning
from perrin.geometry.rotations import skew

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from typing import Self

    from numpy.typing import NDArray

# Surface points of a sphere over a third of its unknowns. At 2 the error from the points is below
# that from the degree, for touching spheres; at 3 the error is a tenth smaller.
_OVERSAMPLING = 2.0

# Exposed fraction of a sphere below which the density of its points does not increase further.
_LEAST_EXPOSED = 0.05

_PROBES = 2000  # points from which the exposed fraction of a sphere is computed

# Added to normal equations with a unit diagonal. Flows about spheres that overlap deeply are nearly
# equal; this shifts the forces by less than 1e-7 and keeps the factorisation positive.
_RIDGE = 1e-13

# Error over the change from two degrees below. The change is at least 1.8 times the remaining error
# for equal spheres and 0.6 times for radii 1:10 (benchmarks/mobility.py), so that the estimate is
# above a third of the error.
_ERROR_PER_CHANGE = 0.75

# Error over the antisymmetric part, which is a third or less of the error from the surface points
# of overlapping spheres.
_ERROR_PER_ASYMMETRY = 3.0

# Degrees in the order in which they are tried. Equal touching spheres converge at 7.
_DEGREES = (5, 7, *range(8, 42, 2))

# Largest number of unknowns of a solution of increasing degree: a minute and half a gigabyte.
_MOST_UNKNOWNS = 7000

_LARGEST_BLOCK = 4_000_000  # flow components of the surface points that are held at once


@dataclass(frozen=True, eq=False)
class Resistance:
    """Forces and torques on a rigid body that moves in a fluid of viscosity 1.

    Attributes
    ----------
    matrix : ndarray, shape (6, 6)
        (force, torque) = matrix (velocity, angular velocity) about the origin, symmetrised.
    degree : int
        Highest degree of the harmonics.
    asymmetry : float
        Antisymmetric part before symmetrisation, relative: reciprocity makes it 0.
    change : float
        Largest relative change of the resistance, over all directions of motion, from the solution
        two degrees lower (from degree 1 for degree 2, from degree 2 for degree 1).
    residual : float
        Root mean square residual velocity on the surface, relative, of the worst of six motions.
    """

    matrix: Floats
    degree: int
    asymmetry: float
    change: float
    residual: float

    def __post_init__(self) -> None:
        frozen(self.matrix)

    @property
    def error(self) -> float:
        """Estimated relative error of the resistance in its worst direction of motion."""
        rounding = float(np.finfo(np.float64).eps)
        by_asymmetry = _ERROR_PER_ASYMMETRY * self.asymmetry
        return max(_ERROR_PER_CHANGE * self.change, by_asymmetry, rounding)

    def to_dict(self) -> dict[str, Any]:
        """Return the solution for JSON: plain numbers and lists."""
        return {**to_plain(asdict(self)), "error": self.error}

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> Self:
        """Return the solution that `to_dict` wrote.

        Parameters
        ----------
        entry : mapping
        """
        known = {name: entry[name] for name in ("degree", "asymmetry", "change", "residual")}
        return cls(matrix=from_plain(entry["matrix"]), **known)


@dataclass(frozen=True, eq=False)
class _FlowFit:
    """One least-squares solution: its raw 6x6 resistance and the rms of the residual velocity."""

    raw: Floats
    residual: float

    @property
    def matrix(self) -> Floats:
        """Symmetric part of the raw resistance."""
        return 0.5 * (self.raw + self.raw.T)


def solve_resistance(centers: Floats, radii: Floats, *, degree: int) -> Resistance:
    """Solve for the resistance with harmonics up to `degree`, and estimate its error.

    Parameters
    ----------
    centers : ndarray, shape (n, 3)
    radii : ndarray, shape (n,)
        Spheres may touch or overlap.
    degree : int
        Highest degree of the harmonics, at least 1.

    Returns
    -------
    Resistance
        In powers of the unit of length: force L, torque L^3.

    Examples
    --------
    >>> sphere = solve_resistance(np.zeros((1, 3)), np.ones(1), degree=2)
    >>> (np.diag(sphere.matrix) / np.pi).round(6)
    array([6., 6., 6., 8., 8., 8.])
    """
    # No degree is lower than 1, whose error is the change to degree 2.
    spheres = _as_bytes(centers), _as_bytes(radii)
    other = _fit_flows(*spheres, max(degree - 2, 1) if degree > 1 else 2)
    return _with_error_estimate(_fit_flows(*spheres, degree), other, degree)


def converge_resistance(centers: Floats, radii: Floats, *, accuracy: float) -> Resistance:
    """Solve with increasing degree from 5 on until the error estimate is under `accuracy`.

    Parameters
    ----------
    centers, radii
        As in `solve_resistance`.
    accuracy : float
        Required relative error of the resistance.

    Returns
    -------
    Resistance

    Raises
    ------
    ValueError
        If there are too many spheres for degree 5.

    Warns
    -----
    PrecisionWarning
        If `accuracy` is not reached at the largest number of unknowns.

    Examples
    --------
    >>> found = converge_resistance(np.zeros((1, 3)), np.ones(1), accuracy=1e-6)
    >>> bool(abs(found.matrix[0, 0] / (6 * np.pi) - 1) < 1e-6)  # Stokes
    True
    """
    lowest = _DEGREES[0]
    most = _MOST_UNKNOWNS // _unknowns(lowest)
    if len(centers) > most:
        raise ValueError(
            f"centers: {len(centers)} spheres; an error estimate is possible for up to {most}; "
            f"state a degree (1 to {lowest - 1}) for more"
        )
    spheres = _as_bytes(centers), _as_bytes(radii)
    solved = {lowest - 2: _fit_flows(*spheres, lowest - 2)}
    for degree, further in pairwise(_DEGREES):
        for needed in (degree - 2, degree):
            if needed not in solved:
                solved[needed] = _fit_flows(*spheres, needed)
        result = _with_error_estimate(solved[degree], solved[degree - 2], degree)
        if result.error <= accuracy:
            return result
        if _unknowns(further) * len(centers) > _MOST_UNKNOWNS:
            break
    warnings.warn(
        f"degree {degree} leaves a relative error of {result.error:.1e}, above {accuracy:.1e}; "
        "state a higher degree if that matters",
        PrecisionWarning,
        stacklevel=3,
    )
    return result


def _unknowns(degree: int) -> int:
    """Return the number of flows about one sphere: three kinds, all orders up to `degree`."""
    return 3 * degree * (degree + 2)


def _with_error_estimate(solution: _FlowFit, other: _FlowFit, degree: int) -> Resistance:
    """Return a solution with its asymmetry and its change from another degree.

    Both are relative to the dissipation of a motion, so that they depend on no unit and on no point
    of reference.
    """
    from scipy.linalg import eigh

    matrix = solution.matrix
    whiten = np.linalg.inv(np.linalg.cholesky(matrix))
    odd = whiten @ (0.5 * (solution.raw - solution.raw.T)) @ whiten.T
    ratio = eigh(other.matrix, matrix, eigvals_only=True)
    return Resistance(
        matrix=matrix,
        degree=degree,
        asymmetry=float(np.linalg.norm(odd, 2)),
        change=float(np.abs(ratio - 1).max()),
        residual=solution.residual,
    )


def _as_bytes(values: Floats) -> bytes:
    """Return numbers as a key, from which `_fit_flows` reads them."""
    return np.asarray(values, dtype=np.float64).tobytes()


@lru_cache(maxsize=64)
def _fit_flows(centers_bytes: bytes, radii_bytes: bytes, degree: int) -> _FlowFit:
    """Fit the flows about all spheres to rigid motion on the surface and sum their forces.

    The flows are nearly orthogonal, so that normal equations are as accurate as a QR factorisation,
    and several times faster. A body that is asked for again, for another quantity or another fluid,
    is not solved again.
    """
    from scipy.linalg import cho_factor, cho_solve

    centers, radii = np.frombuffer(centers_bytes).reshape(-1, 3), np.frombuffer(radii_bytes)
    on_surface, weights, spheres = [], [], []
    for i, (center, radius) in enumerate(zip(centers, radii, strict=True)):
        fraction = _exposed(i, centers, radii, _PROBES)[1]
        if fraction == 0:
            continue
        wanted = _OVERSAMPLING * _unknowns(degree) / 3
        count = int(np.ceil(wanted / max(fraction, _LEAST_EXPOSED)))
        exposed = _exposed(i, centers, radii, count)[0]
        on_surface.append(exposed)
        weights.append(np.full(len(exposed), 1 / count))
        spheres.append((center, radius))
    points, weight = np.concatenate(on_surface), np.concatenate(weights)

    # Products of all flows with each other and with six rigid motions, block by block of points.
    size = _unknowns(degree) * len(spheres)
    normal, right, power = np.zeros((size, size)), np.zeros((size, 6)), np.zeros(6)
    step = max(1, _LARGEST_BLOCK // (3 * size))
    for start in range(0, len(points), step):
        block = slice(start, start + step)
        x, root = points[block], np.sqrt(weight[block])
        flow = np.concatenate([lamb_flows((x - c) / a, degree) for c, a in spheres])
        flow = (flow * root).reshape(size, -1)
        translations = np.broadcast_to(np.eye(3)[:, :, None], (3, 3, len(x)))
        # The columns of -[r]x are e_k x r.
        rotations = np.moveaxis(-skew(x), 0, -1).swapaxes(0, 1)
        motion = (np.concatenate([translations, rotations]) * root).reshape(6, -1).T
        normal += flow @ flow.T
        right += flow @ motion
        power += np.sum(motion**2, axis=0)

    scale = 1 / np.sqrt(np.diag(normal))
    normal *= scale[:, None]
    normal *= scale
    normal[np.diag_indices(len(normal))] += _RIDGE
    right *= scale[:, None]
    factor = cho_factor(normal, lower=True, overwrite_a=True, check_finite=False)
    strength = cho_solve(factor, right, check_finite=False)
    # Rounding may give a residual of -1e-16 for an exact fit, such as that of one sphere.
    residual = np.maximum(1 - np.sum(right * strength, axis=0) / power, 0.0)
    raw = flow_forces(spheres, degree) @ (scale[:, None] * strength)
    frozen(raw)
    return _FlowFit(raw, float(np.sqrt(residual.max())))


def _exposed(i: int, centers: Floats, radii: Floats, count: int) -> tuple[Floats, float]:
    """Return the points of sphere i, of `count` even ones, outside all others, and their share."""
    points = centers[i] + radii[i] * even_directions(count)
    outside = np.ones(count, dtype=np.bool_)
    near = np.linalg.norm(centers - centers[i], axis=1) < radii + radii[i]
    near[i] = False
    for center, radius in zip(centers[near], radii[near], strict=True):
        outside &= np.sum((points - center) ** 2, axis=1) >= radius**2 * (1 - 1e-9)
    return points[outside], float(outside.mean())


def exposed_surface(centers: Floats, radii: Floats, *, count: int) -> Iterator[tuple[int, Floats]]:
    """Yield the number of every sphere and its points on the outer surface of the body.

    Parameters
    ----------
    centers : ndarray, shape (n, 3)
    radii : ndarray, shape (n,)
    count : int
        Number of even points on a whole sphere.

    Yields
    ------
    i : int
    points : ndarray, shape (m, 3)

    Examples
    --------
    >>> pair = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    >>> [len(points) for _, points in exposed_surface(pair, np.ones(2), count=100)]
    [75, 75]
    """
    for i in range(len(centers)):
        yield i, _exposed(i, centers, radii, count)[0]


def even_directions(count: int) -> Floats:
    """Return `count` nearly even directions: the golden-angle spiral, equal steps in z.

    Examples
    --------
    >>> even_directions(2).round(3)
    array([[ 0.314, -0.807,  0.5  ],
           [-0.777,  0.383, -0.5  ]])
    """
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    angle = np.pi * (1 + np.sqrt(5)) * k
    ring = np.sqrt(1 - z**2)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1)


def lamb_flows(x: Floats, degree: int) -> Floats:
    """Return Lamb's flows outside a unit sphere.

    Parameters
    ----------
    x : ndarray, shape (P, 3)
        Points outside the sphere, in its radii from its centre.
    degree : int
        Highest degree of the harmonics.

    Returns
    -------
    ndarray, shape (3 degree (degree + 2), 3, P)

    Notes
    -----
    With a solid harmonic J of degree -(n + 1) they are a flow with pressure J,
    (n + 1)/(n(2n - 1)) r J - (n - 2)/(2n(2n - 1)) r^2 grad J, the potential flow grad J, and the
    toroidal flow grad J x r (Lamb, Hydrodynamics, art. 336; Happel and Brenner, section 3-2).

    Examples
    --------
    >>> lamb_flows(np.array([[0.0, 0.0, 2.0]]), 1)[0, :, 0]  # of a force along z: 1/r
    array([0. , 0. , 0.5])
    """
    pairs = [(n, m) for n in range(1, degree + 1) for m in range(n + 1)]
    n, m = np.array(pairs, dtype=np.int64).T
    harmonic = solid_harmonics(x, degree + 1)
    J = harmonic[n, m]
    # (d/dx + i d/dy) J, (d/dx - i d/dy) J and d/dz J are harmonics of the next degree.
    up, along = -harmonic[n + 1, m + 1], -harmonic[n + 1, m]
    down = np.where((m > 0)[:, None], harmonic[n + 1, np.abs(m - 1)], up.conj())
    gradient = np.stack([0.5 * (up + down), -0.5j * (up - down), along], axis=1)
    r2 = np.sum(x**2, axis=1)
    radial = ((n + 1) / (n * (2 * n - 1)))[:, None] * J
    inward = ((n - 2) / (2 * n * (2 * n - 1)))[:, None] * r2
    pressure = radial[:, None] * x.T - inward[:, None] * gradient
    toroidal = np.cross(gradient, x.T[None], axis=1)
    flow = np.concatenate([pressure, gradient, toroidal])
    return np.concatenate([flow.real, flow.imag[np.tile(m, 3) > 0]])


def solid_harmonics(x: Floats, degree: int) -> NDArray[np.complex128]:
    """Return the irregular solid harmonics (n - m)! P_n^m(cos theta) exp(i m phi)/r^(n + 1).

    In this norm, and without the sign (-1)^m, derivatives are harmonics without factors.

    Parameters
    ----------
    x : ndarray, shape (P, 3)
    degree : int

    Returns
    -------
    ndarray, shape (degree + 1, degree + 1, P)
        The harmonic of degree n and order m; zero for m > n.

    Examples
    --------
    >>> solid_harmonics(np.array([[0.0, 0.0, 2.0]]), 2)[:, 0, 0].real
    array([0.5 , 0.25, 0.25])
    """
    r2 = np.sum(x**2, axis=1)
    sideways, upward = (x[:, 0] + 1j * x[:, 1]) / r2, x[:, 2] / r2
    value = np.zeros((degree + 1, degree + 1, len(x)), dtype=np.complex128)
    value[0, 0] = 1 / np.sqrt(r2)
    for n in range(1, degree + 1):
        value[n, n] = (2 * n - 1) * sideways * value[n - 1, n - 1]
        value[n, :n] = (2 * n - 1) * upward * value[n - 1, :n]
        if n > 1:
            m = np.arange(n)[:, None]
            value[n, :n] -= ((n - 1) ** 2 - m**2) / r2 * value[n - 2, :n]
    return value


def flow_forces(spheres: list[tuple[Floats, float]], degree: int) -> Floats:
    """Return the force and the torque about the origin of each of Lamb's flows.

    The force of a flow with pressure x/r^3 about a sphere of radius a is 4 pi a, the torque of the
    toroidal flow of x/r^3 is 8 pi a^2; those of all other flows are zero.

    Parameters
    ----------
    spheres : list of (center, radius)
    degree : int

    Returns
    -------
    ndarray, shape (6, 3 degree (degree + 2) len(spheres))
        The flows of each sphere in the order of `lamb_flows`.

    Examples
    --------
    >>> flow_forces([(np.zeros(3), 1.0)], 1)[2].round(3)
    array([12.566,  0.   ,  0.   ,  0.   ,  0.   ,  0.   ,  0.   ,  0.   ,
            0.   ])
    """
    whole = degree * (degree + 3) // 2  # complex harmonics, whose real parts come first
    part = degree * (degree + 1) // 2  # those with an imaginary part
    # Indices of the real and imaginary part of order 1 and of order 0: the x, y and z directions.
    pressure = np.array([1, 3 * whole, 0])
    toroidal = np.array([2 * whole + 1, 3 * whole + 2 * part, 2 * whole])
    width = _unknowns(degree)
    force = np.zeros((6, width * len(spheres)))
    for j, (center, radius) in enumerate(spheres):
        force[:3, j * width + pressure] = 4 * np.pi * radius * np.eye(3)
        force[3:, j * width + pressure] = 4 * np.pi * radius * skew(center)
        force[3:, j * width + toroidal] = 8 * np.pi * radius**2 * np.eye(3)
    return force
