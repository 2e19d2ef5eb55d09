"""The doorway of every array: types, shape checks, and the errors and warnings of the house."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats: TypeAlias = NDArray[np.float64]


Ints: TypeAlias = NDArray[np.int64]


Bools: TypeAlias = NDArray[np.bool_]


def as_positions(positions: ArrayLike, *, name: str = "positions") -> Floats:
    """Return `positions` as float64 of shape (T, n, d), d 2 or 3; NaN marks a missing point.

    Raises
    ------
    ValueError
        For another shape, or for an infinite coordinate (its index is named).
    """
    x = np.asarray(positions, dtype=np.float64)
    if x.ndim != 3 or x.shape[2] not in (2, 3):
        raise ValueError(
            f"{name}: expected shape (T, n, d) with d = 2 or 3 (frames, particles, "
            f"coordinates), got {x.shape}"
        )
    if np.isinf(x).any():
        t, i, _ = np.argwhere(np.isinf(x))[0]
        raise ValueError(
            f"{name}: infinite coordinate at row {t}, particle {i}; use NaN for a missing point"
        )
    return x


def present(points: Floats) -> Bools:
    """Return which points (..., d) are there: those without a NaN, shape (...)."""
    return np.asarray(~np.isnan(points).any(axis=-1), dtype=np.bool_)


def as_sigma(sigma: ArrayLike, dimensions: int) -> Floats:
    """Return a localisation error as one number per axis, shape (d,).

    Raises
    ------
    ValueError
        Unless it is one number, or one per axis, none of them negative or infinite.
    """
    s = np.asarray(sigma, dtype=np.float64)
    if s.shape not in ((), (dimensions,)) or not np.all(np.isfinite(s)) or np.any(s < 0):
        raise ValueError(
            f"sigma: expected one number >= 0 or {dimensions} of them (one per axis), in um, "
            f"got {sigma!r}"
        )
    return np.broadcast_to(s, (dimensions,)).copy()


def require_positive(**values: float) -> None:
    """Raise one ValueError that lists every keyword whose value is not a positive number."""
    bad = [
        f"{name} = {value!r}"
        for name, value in values.items()
        if not (np.ndim(value) == 0 and np.isfinite(value) and value > 0)
    ]
    if bad:
        raise ValueError("expected a finite number > 0: " + ", ".join(bad))


def frozen(*arrays: NDArray[Any]) -> None:
    """Make the arrays of a result read-only, so that a result cannot change after the fact."""
    for array in arrays:
        array.setflags(write=False)
