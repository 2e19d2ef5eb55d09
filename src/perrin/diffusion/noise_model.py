"""Which noise an estimator assumes: fitted, from residuals, or known; and steps with that noise."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from perrin._arrays import refuse

if TYPE_CHECKING:
    from perrin._arrays import Floats
    from perrin.diffusion.steps import Steps


@dataclass(frozen=True)
class Noise:
    """What is assumed of the measurement noise under a diffusion coefficient.

    Parameters
    ----------
    model : "joint", "residual" or float
        "joint": the noise is fitted together with D. "residual": it is taken from the residuals
        of the rigid fits, which is right only where all particles of a frame are seen at once. A
        number is the known localisation error of one coordinate, um.
    exposure : float, optional
        Open fraction of the time between frames, 0 to 1; None where it is unknown.
    drift : bool
        Subtract a steady velocity or spin, which costs one degree of freedom an axis.

    Raises
    ------
    ValueError
        If a value is out of its range; all faults in one message.

    Examples
    --------
    >>> Noise(0.02, exposure=0.5)
    Noise(model=0.02, exposure=0.5, drift=False)
    """

    model: Literal["joint", "residual"] | float = "joint"
    exposure: float | None = None
    drift: bool = False

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        refuse(noise_faults(self.model, self.exposure))

    @property
    def text(self) -> str:
        """The model in words: "joint", "residual", or the localisation error with its unit."""
        return self.model if isinstance(self.model, str) else f"{self.model:g} um"

    @classmethod
    def of(cls, noise: object, *, exposure: float | None = None, drift: bool = False) -> Noise:
        """Return the options of an estimator that takes them together or as three keywords.

        Parameters
        ----------
        noise : Noise, or "joint", "residual" or float
        exposure : float, optional
        drift : bool

        Raises
        ------
        ValueError
            If a value is out of its range, or stated both in `noise` and by its own keyword.

        Examples
        --------
        >>> Noise.of(0.02, exposure=0.5) == Noise.of(Noise(0.02, exposure=0.5))
        True
        """
        refuse(noise_faults(noise, exposure, drift=drift))
        return noise if isinstance(noise, Noise) else cls(noise, exposure, drift)  # type: ignore[arg-type]


def noise_faults(noise: object, exposure: object, *, drift: object = False) -> list[str]:
    """Return one line for each of these options that is out of its range or stated twice.

    Examples
    --------
    >>> noise_faults("loud", 1.5)
    ["noise: expected 'joint', 'residual' or sigma in um, got 'loud'", 'exposure: expected a fraction of dt, 0 to 1, got 1.5']
    >>> noise_faults(Noise(exposure=0.5), 0.5)
    ['exposure: stated both in noise = Noise(...) and as exposure; state it once']
    """  # noqa: E501 (what Python prints)
    if isinstance(noise, Noise):
        given = {"exposure": exposure is not None, "drift": drift}
        return [
            f"{name}: stated both in noise = Noise(...) and as {name}; state it once"
            for name, stated in given.items()
            if stated
        ]
    faults = []
    offered = noise in ("joint", "residual") if isinstance(noise, str) else _between(noise, np.inf)
    if not offered:
        faults.append(f"noise: expected 'joint', 'residual' or sigma in um, got {noise!r}")
    if exposure is not None and not _between(exposure, 1.0):
        faults.append(f"exposure: expected a fraction of dt, 0 to 1, got {exposure!r}")
    return faults


def _between(value: Any, most: float) -> bool:  # noqa: ANN401 (a user's argument)
    """Return whether a value is one finite number from 0 to `most`."""
    try:
        number = np.nan if isinstance(value, str) else float(value)
    except (TypeError, ValueError):
        return False
    return bool(np.isfinite(number) and 0 <= number <= most)


@dataclass(frozen=True, eq=False)
class NoisySteps:
    """The steps of one motion with what is known of their noise, for a single D.

    The noise variance of a frame is s = weight theta + known, and its offset s - b D where motion
    blur takes b D from it. Only the diagonal of the noise covariances is used.

    Attributes
    ----------
    steps : Steps
        Steps along axes in which the noise is diagonal, without their steady motion where that is
        free.
    weight : tuple of ndarray, shape (S, A)
        Noise variance of the frames before and after each step, per unit of theta.
    known : tuple of ndarray, shape (S, A)
        Known part of these variances.
    blur : float
        b of the offset s - b D, s.
    theta : float
        Value of a fixed theta, or the estimate of a free one from the residuals.
    freedom : float
        Degrees of freedom of that estimate: 0 where there is none, inf where theta is fixed.
    level : float
        Mean of `known` over the frames that show the most particles.
    drift : bool
        Whether a steady velocity or spin is free.
    steady : ndarray, shape (p,)
        Least-squares steady motion that was subtracted; zeros without drift.
    """

    steps: Steps
    weight: tuple[Floats, Floats]
    known: tuple[Floats, Floats]
    blur: float
    theta: float
    freedom: float
    level: float
    drift: bool = False
    steady: Floats = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def of(cls, steps: Steps, noise: Noise) -> NoisySteps:
        """Return the steps with the noise that the options state; blur takes b D from it."""
        if noise.model == "joint":
            # An unknown exposure may blur up to the limit at which steps stop being possible.
            unknown = noise.exposure is None
            blur = steps.duration.min() / 2 if unknown else (noise.exposure or 0.0) * steps.dt / 3
            return cls.free(steps, blur=float(blur), drift=noise.drift)
        blur = (noise.exposure or 0.0) * steps.dt / 3
        if noise.model == "residual":
            return cls.from_residuals(steps, blur=blur, drift=noise.drift)
        return cls.fixed(steps, sigma=float(noise.model), blur=blur, drift=noise.drift)

    @classmethod
    def free(cls, steps: Steps, *, blur: float, drift: bool) -> NoisySteps:
        """Leave the offset free; known is by how much a frame exceeds the least noisy one."""
        noise = [steps.sigma**2 * n for n in steps.variances]
        least = min(float(n.min()) for n in noise)
        one = np.ones_like(noise[0])
        known = noise[0] - least, noise[1] - least
        level = steps.sigma**2 * steps.complete - least
        steps, steady = _subtracted(steps, drift=drift)
        return cls(steps, (one, one), known, blur, 0.0, 0.0, level, drift, steady)

    @classmethod
    def from_residuals(cls, steps: Steps, *, blur: float, drift: bool) -> NoisySteps:
        """Estimate theta from the rigid-fit residuals, with their degrees of freedom."""
        theta = steps.sigma**2 * steps.complete
        if theta == 0:
            return cls.fixed(steps, sigma=0.0, blur=blur, drift=drift)
        before, after = steps.variances
        weight = before / steps.complete, after / steps.complete
        none = np.zeros_like(before)
        freedom = float(steps.freedom)
        steps, steady = _subtracted(steps, drift=drift)
        return cls(steps, weight, (none, none), blur, theta, freedom, 0.0, drift, steady)

    @classmethod
    def fixed(cls, steps: Steps, *, sigma: float, blur: float, drift: bool) -> NoisySteps:
        """Take the localisation error sigma (um) as known."""
        before, after = steps.variances
        known = sigma**2 * before, sigma**2 * after
        none = np.zeros_like(before)
        level = sigma**2 * steps.complete
        steps, steady = _subtracted(steps, drift=drift)
        return cls(steps, (none, none), known, blur, 0.0, np.inf, level, drift, steady)


def _subtracted(steps: Steps, *, drift: bool) -> tuple[Steps, Floats]:
    """Return the steps without their steady motion, and that motion; unchanged without drift."""
    return steps.without_steady_motion() if drift else (steps, np.zeros(steps.steady.shape[2]))
