"""Simulated motion of rigid clusters with known coefficients, and localisation noise."""

from __future__ import annotations

from functools import lru_cache, partial
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike

from perrin._arrays import (
    Floats,
    as_positions,
    as_sigma,
    choice_fault,
    frozen,
    number_fault,
    refuse,
    require_positive,
)
from perrin.geometry.rotations import cumulative_product, exp_map, successive_product
from perrin.hydrodynamics.mobility import Mobility
from perrin.motion.dynamics import (
    Confined,
    Dynamics,
    Fractional,
    Hopping,
    Spin,
    Switching,
    fast_states,
    fractional_noise,
    hops,
    relaxing_coordinates,
)
from perrin.motion.rigid_motion import RigidMotion

if TYPE_CHECKING:
    from perrin.geometry.shapes import Cluster

# Largest D dt of one substep of an anisotropic rotor: Gaussian rotation vectors are exact to first
# order in D dt, and the remaining error of E[R] at this step is about 1e-6.
_SUBSTEP = 0.002


def simulate_motion(
    cluster: Cluster | Mobility,
    *,
    D_R: ArrayLike | None = None,
    D_T: float = 0.0,
    dt: float,
    n_frames: int,
    scheme: Literal["brownian", "euler"] = "brownian",
    dynamics: Dynamics | None = None,
    rng: np.random.Generator | int,
) -> RigidMotion:
    """Simulate Brownian rotation and translation of a rigid cluster, or another motion of it.

    Parameters
    ----------
    cluster : Cluster or Mobility
        The body. A `Mobility` diffuses by its own 6x6 tensor, anisotropic and coupled, about its
        centre of diffusion.
    D_R : float or array_like, shape (3,) or (3, 3)
        Rotational diffusion coefficient, rad^2/s; three values or a tensor are in body axes. Needed
        with a `Cluster`; neither D_R nor D_T is given with a `Mobility`.
    D_T : float
        Translational diffusion coefficient, um^2/s.
    dt : float
        Time between frames, s.
    n_frames : int
        Number of frames, including frame 0, which is at the origin and not rotated.
    scheme : {"brownian", "euler"}
        "brownian" has the exact step law at any D_R dt for one D_R (angles from the heat kernel on
        SO(3)), and substeps with D dt <= 0.002 for a tensor. "euler" is the paper's: R_x R_y R_z
        with three Gaussian angles (Hunter 2011, Eq. 16), for one D_R only.
    dynamics : Fractional, Confined, Spin, Switching or Hopping, optional
        Another motion than free Brownian motion, of a `Cluster` with the "brownian" scheme. Its
        class states what D_R and D_T then are. `Fractional` is for one D_R only.
    rng : numpy.random.Generator or int
        Source of random numbers, or a seed.

    Returns
    -------
    RigidMotion
        The truth, with sigma = 0; ``.positions()`` gives the particles.

    Raises
    ------
    ValueError
        If a value is out of range, a tensor is not positive semidefinite or is given with "euler"
        or `Fractional`, coefficients or dynamics are given with a `Mobility`, or dynamics with
        "euler".

    Examples
    --------
    >>> from perrin import Cluster
    >>> truth = simulate_motion(
    ...     Cluster.tetrahedron(1.5), D_R=5e-3, D_T=0.04, dt=0.7, n_frames=100, rng=1
    ... )
    >>> truth.positions().shape
    (100, 4, 3)
    """
    require_positive(dt=dt, n_frames=n_frames)
    if n_frames != int(n_frames):
        raise ValueError(f"n_frames: expected a whole number, got {n_frames!r}")
    faults = choice_fault("scheme", scheme, ("brownian", "euler"))
    if dynamics is not None:
        if not isinstance(dynamics, Dynamics):
            faults.append(
                "dynamics: expected Fractional, Confined, Spin, Switching or Hopping, or None, "
                f"got {dynamics!r}"
            )
        if scheme == "euler":
            faults.append('scheme="euler" (Eq. 16) is for Brownian rotation; leave dynamics out')
    refuse(faults)
    generator, n = np.random.default_rng(rng), int(n_frames)
    if isinstance(cluster, Mobility):
        if D_R is not None or D_T != 0 or scheme != "brownian" or dynamics is not None:
            raise ValueError(
                'a Mobility has its own D_R, D_T, scheme ("brownian") and free dynamics; leave '
                "them out"
            )
        template = cluster.centers - cluster.centroid
        center, rotation = _coupled_walk(cluster, n - 1, dt=dt, generator=generator)
    else:
        if D_R is None:
            raise ValueError("D_R: needed with a Cluster (rad^2/s); only a Mobility has its own")
        refuse(number_fault("D_T", D_T, least=0, unit="um^2/s"))
        template = cluster.positions.copy()
        d = template.shape[1]
        D = _rotation_tensor(D_R, d) * dt
        if dynamics is None:
            rotation = _free_rotations(D, n - 1, scheme=scheme, generator=generator)
            center = _summed(generator.normal(scale=np.sqrt(2 * D_T * dt), size=(n - 1, d)))
        else:
            center, rotation = _planted_walk(
                dynamics, D, D_T * dt, d=d, count=n - 1, dt=float(dt), generator=generator
            )
    angles = 3 if template.shape[1] == 3 else 1
    return RigidMotion(
        time=np.arange(n, dtype=np.float64) * float(dt),
        center=center,
        rotation=rotation,
        residual=np.zeros(n),
        n_present=np.full(n, len(template)),
        covariance=np.zeros((n, angles, angles)),
        center_variance=np.zeros(n),
        piece=np.zeros(n, dtype=np.int64),
        reason=("",) * n,
        template=template,
        sigma=0.0,
        noise=np.zeros(template.shape[1]),
        dt=float(dt),
    )


def add_noise(positions: ArrayLike, *, sigma: ArrayLike, rng: np.random.Generator | int) -> Floats:
    """Add Gaussian localisation errors to particle positions.

    Parameters
    ----------
    positions : array_like, shape (T, n, d)
        Particle positions, um.
    sigma : float or array_like, shape (d,)
        Standard deviation of one coordinate, um; one number or one per axis.
    rng : numpy.random.Generator or int
        Source of random numbers, or a seed.

    Returns
    -------
    ndarray, shape (T, n, d)

    Examples
    --------
    >>> noisy = add_noise([[[0.0, 0.0, 0.0]]] * 10000, sigma=(0.03, 0.03, 0.04), rng=1)
    >>> noisy.std(axis=0).round(2)
    array([[0.03, 0.03, 0.04]])
    """
    x = as_positions(positions)
    s = as_sigma(sigma, x.shape[2])
    return x + np.random.default_rng(rng).normal(size=x.shape) * s


def _coupled_walk(
    body: Mobility, count: int, *, dt: float, generator: np.random.Generator
) -> tuple[Floats, Floats]:
    """Return centroids and orientations that diffuse by a 6x6 tensor, count + 1 of them.

    A substep is a screw in body axes with Gaussian displacement and turn about the centre of
    diffusion, where the coupling is symmetric and no drift arises; half of its turn comes before
    its displacement.
    """
    substeps = int(np.ceil(np.linalg.eigvalsh(body.D_R)[-1] * dt / _SUBSTEP))
    root = np.linalg.cholesky(2 * body.D * dt / substeps)
    turn, shift = np.broadcast_to(np.eye(3), (count, 3, 3)), np.zeros((count, 3, 1))
    for _ in range(substeps):
        screw = generator.normal(size=(count, 6)) @ root.T
        halfway = turn @ exp_map(0.5 * screw[:, 3:])
        shift = shift + halfway @ screw[:, :3, None]
        turn = turn @ exp_map(screw[:, 3:])
    rotation = cumulative_product(turn)
    path = np.concatenate([np.zeros((1, 3)), np.cumsum((rotation[:-1] @ shift)[..., 0], axis=0)])
    arm = body.centroid - body.center
    return path + rotation @ arm - arm, rotation


def _rotation_tensor(D_R: ArrayLike, d: int) -> Floats:
    """Return D_R as a matrix, (3, 3) in space and (1, 1) in the plane."""
    value = np.asarray(D_R, dtype=np.float64)
    angles = 3 if d == 3 else 1
    if value.ndim == 0:
        value = np.diag(np.full(angles, value))
    elif value.shape == (angles,):
        value = np.diag(value)
    if value.shape != (angles, angles) or not np.isfinite(value).all():
        raise ValueError(
            f"D_R: expected a finite number, {angles} values or a ({angles}, {angles}) tensor in "
            f"body axes (rad^2/s), got {D_R!r}"
        )
    lowest = float(np.linalg.eigvalsh(value)[0])
    if not np.allclose(value, value.T) or lowest < -1e-12 * float(np.abs(value).max()):
        raise ValueError(f"D_R: expected a symmetric tensor without negative values, got {D_R!r}")
    return value


def _free_rotations(
    D: Floats, count: int, *, scheme: str, generator: np.random.Generator
) -> Floats:
    """Return count + 1 orientations, the first one the identity; D is the tensor times dt."""
    if scheme == "brownian":
        return cumulative_product(_free_steps(D, count, generator=generator))
    if len(D) != 3 or not _isotropic(D):
        raise ValueError('scheme="euler" (Eq. 16) is for one D_R in three dimensions only')
    # R_x(alpha) R_y(beta) R_z(gamma) with Gaussian angles of variance 2 D.
    angles = generator.normal(scale=np.sqrt(2 * float(D[0, 0])), size=(count, 3))
    x, y, z = (exp_map(angles[:, i, None] * np.eye(3)[i]) for i in range(3))
    return successive_product(np.asarray(x @ y @ z))


def _isotropic(D: Floats) -> bool:
    """Return whether a tensor is one number in all directions."""
    return np.allclose(D, D[0, 0] * np.eye(len(D)), rtol=0.0, atol=1e-12 * np.trace(D))


def _free_steps(D: Floats, count: int, *, generator: np.random.Generator) -> Floats:
    """Return the body-frame rotations of count Brownian steps; D is the tensor times dt."""
    if len(D) == 1 or float(np.trace(D)) == 0:
        normal = generator.normal(size=(count, len(D)))
        return exp_map(normal * np.sqrt(2 * D[0, 0]))
    if _isotropic(D):
        # Angles from the heat kernel, about uniform axes.
        angle, cdf = heat_kernel_angles(float(D[0, 0]))
        drawn = np.interp(generator.random(count), cdf, angle)
        axis = generator.normal(size=(count, 3))
        axis /= np.linalg.norm(axis, axis=1, keepdims=True)
        return exp_map(axis * drawn[:, None])
    # Gaussian body-frame rotation vectors, each short enough to be exact.
    substeps = int(np.ceil(np.linalg.eigvalsh(D)[-1] / _SUBSTEP))
    root = _root(2 * D / substeps)
    step = np.broadcast_to(np.eye(3), (count, 3, 3))
    for _ in range(substeps):
        step = step @ exp_map(generator.normal(size=(count, 3)) @ root.T)
    return step


def _root(covariance: Floats) -> Floats:
    """Return a square root A of a positive semidefinite matrix, A A^T."""
    values, axes = np.linalg.eigh(covariance)
    return np.asarray(axes * np.sqrt(np.maximum(values, 0.0)))


def _summed(displacements: Floats) -> Floats:
    """Return the path of these displacements from the origin."""
    return np.concatenate([np.zeros((1, displacements.shape[1])), np.cumsum(displacements, axis=0)])


def _planted_walk(
    dynamics: Dynamics,
    D: Floats,
    D_T: float,
    *,
    d: int,
    count: int,
    dt: float,
    generator: np.random.Generator,
) -> tuple[Floats, Floats]:
    """Return count + 1 centres and orientations; D and D_T are the coefficients times dt."""
    match dynamics:
        case Fractional():
            if not _isotropic(D):
                raise ValueError(
                    "D_R: Fractional has its memory in the lab frame and needs one D_R, not a "
                    "tensor"
                )
            noise = partial(fractional_noise, dynamics.alpha, generator=generator)
            vectors = np.sqrt(2 * D[0, 0]) * noise((count, len(D)))
            jumps = np.sqrt(2 * D_T) * noise((count, d))
            return _summed(jumps), successive_product(exp_map(vectors))
        case Switching():
            # Brownian steps of two sizes.
            fast = fast_states(dt / dynamics.dwell, count, generator=generator)
            shares = 2 / (1 + dynamics.ratio), 2 * dynamics.ratio / (1 + dynamics.ratio)
            slow, quick = (_free_steps(share * D, count, generator=generator) for share in shares)
            rotation = cumulative_product(np.where(fast[:, None, None], quick, slow))
            scale = np.sqrt(2 * D_T * np.where(fast, shares[1], shares[0]))
            return _summed(scale[:, None] * generator.normal(size=(count, d))), rotation
        case Confined():
            still = np.broadcast_to(exp_map(np.zeros(len(D))), (count + 1, d, d))
            return _caged_walk(dt / dynamics.relaxation_time, still, D, D_T, generator)
        case Hopping():
            mean, shape = dt / dynamics.interval, (count, len(D))
            turns = hops(dynamics.angle, mean, shape, generator=generator)
            if dynamics.relaxation_time is not None:
                decay = dt / dynamics.relaxation_time
                return _caged_walk(decay, cumulative_product(turns), D, D_T, generator)
            rotation = cumulative_product(_free_steps(D, count, generator=generator) @ turns)
        case Spin():
            rate = np.asarray(dynamics.rate)
            if len(D) == 1 and rate[:2].any():
                raise ValueError(f"rate: expected a spin about z in the plane, got {dynamics!r}")
            turn = exp_map(np.arange(count + 1)[:, None] * dt * rate[-len(D) :])
            rotation = turn @ _free_rotations(D, count, scheme="brownian", generator=generator)
    return _summed(generator.normal(scale=np.sqrt(2 * D_T), size=(count, d))), rotation


def _caged_walk(
    decay: float, mean: Floats, D: Floats, D_T: float, generator: np.random.Generator
) -> tuple[Floats, Floats]:
    """Return centres about one place, and orientations about mean ones.

    Frame 0 is at the origin and not rotated, wherever in its cage the body begins.
    """
    count, d = len(mean), mean.shape[-1]
    swing = exp_map(
        relaxing_coordinates(decay, (count, len(D)), generator=generator) @ _root(D / decay).T
    )
    rotation = np.swapaxes(swing[0], -1, -2) @ mean @ swing
    rotation[0] = np.eye(d)
    place = relaxing_coordinates(decay, (count, d), generator=generator)
    return np.sqrt(D_T / decay) * (place - place[0]), rotation


@lru_cache(maxsize=8)
def heat_kernel_angles(D: float) -> tuple[Floats, Floats]:
    """Return rotation angles and their cumulative probability under the heat kernel on SO(3).

    Parameters
    ----------
    D : float
        D_R t, rad^2.

    Returns
    -------
    angle : ndarray, shape (20001,)
        Rotation angles, rad.
    cdf : ndarray, shape (20001,)

    Notes
    -----
    The density is proportional to sin(a/2) sum_n (-1)^n (a + 2 pi n) exp(-(a + 2 pi n)^2 / 4D), the
    character series sum (2l + 1) exp(-l(l+1)D) sin((l + 1/2)a) sin(a/2) summed over images
    (Poisson). Images converge fast for small D, the series for large D; at D = 1 either is exact.

    Examples
    --------
    >>> angle, cdf = heat_kernel_angles(50.0)  # uniform rotations: (a - sin a)/pi
    >>> bool(np.allclose(cdf, (angle - np.sin(angle)) / np.pi, atol=1e-6))
    True
    """
    angle = np.linspace(0.0, min(np.pi, 14 * np.sqrt(2 * D)), 20001)
    if D < 1:
        n = np.arange(-3, 4)[:, None]
        image = angle + 2 * np.pi * n
        wave = np.sum((-1.0) ** n * image * np.exp(-(image**2) / (4 * D)), axis=0)
    else:
        degree = np.arange(8)[:, None]
        weight = (2 * degree + 1) * np.exp(-degree * (degree + 1) * D)
        wave = np.sum(weight * np.sin((degree + 0.5) * angle), axis=0)
    density = np.maximum(wave * np.sin(angle / 2), 0.0)
    sums = np.concatenate([[0.0], np.cumsum(density[1:] + density[:-1])])
    cdf = sums / sums[-1]
    frozen(angle, cdf)
    return angle, cdf
