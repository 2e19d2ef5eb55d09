"""Which noise an estimator assumes: fitted, from residuals, or known."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from perrin._arrays import refuse
from perrin.diffusion.steps import Quantity


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
        refuse(choice_faults(quantity="rotation", noise=self.model, exposure=self.exposure))


def choice_faults(*, quantity: object, noise: object, exposure: object) -> list[str]:
    """Say which choices of an estimate from steps are not on offer."""
    faults = []
    if quantity not in get_args(Quantity):
        offered = " or ".join(map(repr, get_args(Quantity)))
        faults.append(f"quantity: expected {offered}, got {quantity!r}")
    if not (noise in ("joint", "residual") if isinstance(noise, str) else _within(noise, np.inf)):
        faults.append(f"noise: expected 'joint', 'residual' or sigma in um, got {noise!r}")
    if exposure is not None and not _within(exposure, 1.0):
        faults.append(f"exposure: expected a fraction of dt, 0 to 1, got {exposure!r}")
    return faults


def _within(value: Any, most: float) -> bool:  # noqa: ANN401 (a user's argument)
    """Return whether a value is one finite number from 0 to `most`."""
    try:
        number = np.nan if isinstance(value, str) else float(value)
    except (TypeError, ValueError):
        return False
    return bool(np.isfinite(number) and 0 <= number <= most)
