"""Which noise an estimator assumes: fitted, from residuals, or known."""

from __future__ import annotations

from typing import Any, get_args

import numpy as np

from perrin.diffusion.steps import Quantity


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
