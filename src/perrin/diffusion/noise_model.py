"""Options of the noise that an estimator assumes: fitted, from residuals, or known."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from perrin._arrays import (
    PlainOptions,
    flag_fault,
    number_fault,
    numpy_to_python,
    refuse,
    stated_twice,
)


@dataclass(frozen=True)
class Noise(PlainOptions):
    """Assumptions on the measurement noise in an estimate of a diffusion coefficient.

    Parameters
    ----------
    model : "joint", "residual" or float
        "joint": the noise is fitted together with D. "residual": it is taken from the residuals
        of the rigid fits, which is right only where all particles of a frame are recorded at the
        same instant. A number is the known localisation error of one coordinate, um.
    exposure : float, optional
        Open fraction of the time between frames, 0 to 1; None where it is unknown.
    drift : bool
        Whether a steady velocity or spin is subtracted, one degree of freedom per axis.

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
        refuse(noise_faults(self.model, self.exposure, drift=self.drift))
        numpy_to_python(self)

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
            If a value is out of its range, or stated both in `noise` and as a keyword.

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
    ['exposure: stated in noise= and as a keyword; state it once']
    """  # noqa: E501 (what Python prints)
    if isinstance(noise, Noise):
        given = {"exposure": exposure is not None, "drift": drift}
        return [stated_twice(name, "noise") for name, stated in given.items() if stated]
    faults = []
    if (
        noise not in ("joint", "residual")
        if isinstance(noise, str)
        else number_fault("noise", noise, least=0)
    ):
        faults.append(f"noise: expected 'joint', 'residual' or sigma in um, got {noise!r}")
    if exposure is not None and number_fault("exposure", exposure, least=0, most=1):
        faults.append(f"exposure: expected a fraction of dt, 0 to 1, got {exposure!r}")
    return faults + flag_fault("drift", drift)
