"""Options of a simulated motion that is not free Brownian motion, and the random laws they need."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from perrin._arrays import PlainOptions, number_fault, numpy_to_python, refuse
from perrin.geometry.rotations import exp_map

if TYPE_CHECKING:
    from perrin._arrays import Bools, Floats


@dataclass(frozen=True)
class Fractional(PlainOptions):
    """Fractional Brownian motion: mean squares grow as t^alpha.

    The coefficients hold at one frame: the mean square per axis at a lag of m frames is
    2 D dt m^alpha. Increments are exact fractional Gaussian noise; those of a rotation are rotation
    vectors in the lab frame, where the memory of a surrounding medium is.

    Parameters
    ----------
    alpha : float
        Exponent, above 0 and below 2; subdiffusion below 1, superdiffusion above.

    Raises
    ------
    ValueError
        If alpha is out of its range.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> body = Cluster.tetrahedron(1.5)
    >>> slow = simulate_motion(
    ...     body, D_R=1e-3, dt=1.0, n_frames=9, dynamics=Fractional(0.5), rng=1
    ... )
    >>> slow.rotation.shape
    (9, 3, 3)
    """

    alpha: float

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        refuse(number_fault("alpha", self.alpha, above=0, below=2))
        numpy_to_python(self)


@dataclass(frozen=True)
class Confined(PlainOptions):
    """Rotation about a mean orientation and translation about a mean place, in a harmonic cage.

    The coefficients are those at short times. The rotation vector from the mean orientation and the
    displacement from the mean place are Ornstein-Uhlenbeck processes; their variance per axis is
    D relaxation_time. A D_R tensor is in the axes that the body has at its mean orientation.

    Parameters
    ----------
    relaxation_time : float
        Time in which the memory of a displacement decays to 1/e, s.

    Raises
    ------
    ValueError
        If the time is not positive.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> caged = simulate_motion(
    ...     Cluster.tetrahedron(1.5),
    ...     D_R=2e-3,
    ...     D_T=0.04,
    ...     dt=1.0,
    ...     n_frames=5000,
    ...     dynamics=Confined(5.0),
    ...     rng=1,
    ... )
    >>> bool(np.allclose(caged.center.var(axis=0), 0.04 * 5.0, rtol=0.2))
    True
    """

    relaxation_time: float

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        refuse(number_fault("relaxation_time", self.relaxation_time, above=0, unit="s"))
        numpy_to_python(self)


@dataclass(frozen=True)
class Spin(PlainOptions):
    """A steady spin about axes of the lab, in addition to Brownian rotation.

    Each step is R(t + dt) = exp(rate dt) R(t) exp(w) with the Brownian rotation vector w of the
    body; translation is Brownian.

    Parameters
    ----------
    rate : float or sequence of 3 floats
        Angular velocity, rad/s, along the lab axes; one number is about z, the only one in the
        plane. It is stored as three numbers.

    Raises
    ------
    ValueError
        Unless the rate is one finite number or three.

    Examples
    --------
    >>> Spin(0.2)
    Spin(rate=(0.0, 0.0, 0.2))
    """

    rate: tuple[float, float, float] | float

    def __post_init__(self) -> None:
        """Refuse values out of range; store three numbers."""
        values = np.ravel(np.asarray(self.rate, dtype=object)).tolist()
        shape = np.shape(self.rate)
        if shape not in ((), (3,)) or any(number_fault("rate", value) for value in values):
            raise ValueError(
                f"rate: expected one finite number (about z) or 3 (lab axes), in rad/s, "
                f"got {self.rate!r}"
            )
        components = [0.0, 0.0, *values][-3:]
        object.__setattr__(self, "rate", tuple(float(value) for value in components))


@dataclass(frozen=True)
class Switching(PlainOptions):
    """Brownian motion whose coefficients switch between a slow and a fast state.

    Rotation and translation switch together. The two states are equally probable, and the given
    coefficients are the mean of the slow and the fast one. The state at the beginning of a step
    holds for the whole step: a Markov process in continuous time, seen at the frames.

    Parameters
    ----------
    ratio : float
        D_fast/D_slow, at least 1.
    dwell : float
        Mean time in a state before it changes, s; the same for both.

    Raises
    ------
    ValueError
        If a value is out of its range; all faults in one message.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> uneven = simulate_motion(
    ...     Cluster.tetrahedron(1.5),
    ...     D_R=1e-3,
    ...     dt=1.0,
    ...     n_frames=9,
    ...     dynamics=Switching(10, dwell=20),
    ...     rng=1,
    ... )
    >>> uneven.rotation.shape
    (9, 3, 3)
    """

    ratio: float
    dwell: float

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        refuse(
            number_fault("ratio", self.ratio, least=1)
            + number_fault("dwell", self.dwell, above=0, unit="s")
        )
        numpy_to_python(self)


@dataclass(frozen=True)
class Hopping(PlainOptions):
    """Rotation by sudden turns, in addition to Brownian or confined motion.

    At random times the body turns by one angle about a random axis; in d dimensions of rotation (3,
    or 1 in the plane) the turns add angle^2/(2 d interval) to the D_R of the motion between them:
    angle^2/(6 interval) in space. With a relaxation time the motion between the turns is that of
    `Confined`, and a turn moves the mean orientation; the body stays at its mean place. Without
    one, rotation and translation between the turns are Brownian.

    Parameters
    ----------
    angle : float
        Angle of every turn, rad, above 0 and up to pi.
    interval : float
        Mean time between turns, s; they are a Poisson process.
    relaxation_time : float, optional
        Relaxation time of the cage, s; None for no cage.

    Raises
    ------
    ValueError
        If a value is out of its range; all faults in one message.

    Examples
    --------
    A cage of 0.1 rad per axis, D_R relaxation_time = 0.01, which turns every 100 s:

    >>> from perrin import Cluster, simulate_motion
    >>> hopping = simulate_motion(
    ...     Cluster.tetrahedron(1.5),
    ...     D_R=2e-3,
    ...     dt=1.0,
    ...     n_frames=9,
    ...     dynamics=Hopping(0.8, 100.0, relaxation_time=5.0),
    ...     rng=1,
    ... )
    >>> hopping.rotation.shape
    (9, 3, 3)
    """

    angle: float
    interval: float
    relaxation_time: float | None = None

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        faults = number_fault("angle", self.angle, above=0, most=np.pi, unit="rad")
        faults += number_fault("interval", self.interval, above=0, unit="s")
        if self.relaxation_time is not None:
            faults += number_fault("relaxation_time", self.relaxation_time, above=0, unit="s")
        refuse(faults)
        numpy_to_python(self)


Dynamics: TypeAlias = Fractional | Confined | Spin | Switching | Hopping


def fractional_noise(
    alpha: float, shape: tuple[int, int], *, generator: np.random.Generator
) -> Floats:
    """Return independent columns of fractional Gaussian noise of unit variance.

    Parameters
    ----------
    alpha : float
        The mean square of a sum of m values is m^alpha.
    shape : tuple of int
        Number of values, number of columns.
    generator : numpy.random.Generator

    Returns
    -------
    ndarray, shape `shape`

    Notes
    -----
    The covariance, ((m + 1)^alpha + |m - 1|^alpha - 2 m^alpha)/2 at a distance of m, is embedded in
    a circulant matrix, whose eigenvalues are a Fourier transform and are never negative for this
    law (Davies and Harte, Biometrika 74, 95 (1987)): the noise is exact.

    Examples
    --------
    >>> x = fractional_noise(0.5, (2000, 50), generator=np.random.default_rng(1))
    >>> np.mean(x**2).round(1), np.mean(x[1:] * x[:-1]).round(1)  # (2^0.5 - 2)/2 = -0.29
    (np.float64(1.0), np.float64(-0.3))
    """
    count, columns = shape
    if count == 0:
        return np.zeros(shape)
    lag = np.arange(count + 1, dtype=np.float64)
    covariance = 0.5 * ((lag + 1) ** alpha + np.abs(lag - 1) ** alpha - 2 * lag**alpha)
    circulant = np.concatenate([covariance, covariance[-2:0:-1]])
    eigenvalues = np.maximum(np.fft.fft(circulant).real, 0.0)  # negative by rounding only
    normal = generator.normal(size=(2, len(circulant), columns))
    spectrum = np.sqrt(eigenvalues / len(circulant))[:, None] * (normal[0] + 1j * normal[1])
    return np.ascontiguousarray(np.fft.fft(spectrum, axis=0).real[:count])


def relaxing_coordinates(
    decay: float, shape: tuple[int, int], *, generator: np.random.Generator
) -> Floats:
    """Return independent columns of a stationary Ornstein-Uhlenbeck process of unit variance.

    Parameters
    ----------
    decay : float
        Dt/relaxation time: the correlation of neighbouring values is exp(-decay).
    shape : tuple of int
        Number of values, number of columns.
    generator : numpy.random.Generator

    Returns
    -------
    ndarray, shape `shape`

    Examples
    --------
    >>> x = relaxing_coordinates(0.5, (2000, 50), generator=np.random.default_rng(1))
    >>> np.mean(x**2).round(1), np.mean(x[1:] * x[:-1]).round(1)  # exp(-0.5) = 0.61
    (np.float64(1.0), np.float64(0.6))
    """
    x = generator.normal(size=shape)
    kept, added = np.exp(-decay), np.sqrt(-np.expm1(-2 * decay))
    for i in range(1, len(x)):
        x[i] = kept * x[i - 1] + added * x[i]
    return x


def fast_states(rate: float, count: int, *, generator: np.random.Generator) -> Bools:
    """Return which steps begin in the fast one of two equally probable states.

    Parameters
    ----------
    rate : float
        dt/mean dwell time.
    count : int
        Number of steps.
    generator : numpy.random.Generator

    Returns
    -------
    ndarray of bool, shape (count,)

    Notes
    -----
    A process that leaves its state at a rate r is found in the other one a time t later with
    probability (1 - exp(-2 r t))/2.

    Examples
    --------
    >>> fast = fast_states(0.1, 10000, generator=np.random.default_rng(1))
    >>> bool(abs(fast.mean() - 0.5) < 0.05)
    True
    """
    changed = generator.random(count) < -0.5 * np.expm1(-2 * rate)
    first = generator.random() < 0.5
    return np.asarray((np.cumsum(changed) % 2 == 1) ^ first)


def hops(
    angle: float, mean: float, shape: tuple[int, int], *, generator: np.random.Generator
) -> Floats:
    """Return the rotation by sudden turns about random axes in every step.

    Parameters
    ----------
    angle : float
        Angle of every turn, rad.
    mean : float
        Mean number of turns in a step; it is a Poisson number.
    shape : tuple of int
        Number of steps, and 3 for rotations in space or 1 in the plane.
    generator : numpy.random.Generator

    Returns
    -------
    ndarray, shape (count, 3, 3) or (count, 2, 2)

    Examples
    --------
    >>> turn = hops(0.5, 0.1, (1000, 3), generator=np.random.default_rng(1))
    >>> angle = np.arccos(np.clip((np.trace(turn, axis1=1, axis2=2) - 1) / 2, -1, 1))
    >>> bool(np.isclose(np.median(angle[angle > 0]), 0.5))
    True
    """
    count, angles = shape
    number = generator.poisson(mean, size=count)
    turn = np.array(exp_map(np.zeros(shape)))
    for i in range(int(number.max(initial=0))):
        rows = np.flatnonzero(number > i)
        axis = generator.normal(size=(len(rows), angles))
        axis /= np.linalg.norm(axis, axis=1, keepdims=True)
        turn[rows] = turn[rows] @ exp_map(angle * axis)
    return turn
