"""Checks of the arrays and numbers that users pass, and their conversion to and from JSON."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, MutableSequence
from dataclasses import fields
from typing import Any, Self, TypeAlias, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats: TypeAlias = NDArray[np.float64]
Ints: TypeAlias = NDArray[np.int64]
Bools: TypeAlias = NDArray[np.bool_]
Options = TypeVar("Options")
Scalar = TypeVar("Scalar", bound=np.generic)


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
    if not np.isfinite(x.sum()) and np.isinf(x).any():
        t, i, _ = np.argwhere(np.isinf(x))[0]
        raise ValueError(
            f"{name}: infinite coordinate at row {t}, particle {i}; use NaN for a missing point"
        )
    return x


def complete(numbers: Floats) -> bool:
    """Return whether none of the numbers is NaN: the smallest of them would be."""
    return not np.isnan(numbers.min(initial=0.0))


def present(points: Floats) -> Bools:
    """Return which points (..., d) are present, those without a NaN: shape (...)."""
    if complete(points):
        return np.ones(points.shape[:-1], dtype=np.bool_)
    missing = np.isnan(points[..., 0])
    for axis in range(1, points.shape[-1]):
        missing |= np.isnan(points[..., axis])
    return np.asarray(~missing, dtype=np.bool_)


def stored_once(rows: Floats) -> Floats:
    """Return an array (N, ...) whose rows are all the same as a view of one row.

    Thousands of motions are in memory together, and most have equally noisy frames.

    Examples
    --------
    >>> stored_once(np.ones((4, 2))).strides[0], stored_once(np.arange(4.0)).strides[0]
    (0, 8)
    """
    if len(rows) < 2 or rows.strides[0] == 0 or not np.array_equal(rows[1:], rows[:-1]):
        return rows
    return repeated(rows[0].copy(), len(rows))


def repeated(row: NDArray[Scalar], count: int) -> NDArray[Scalar]:
    """Return an array (count, ...) whose rows are all a view of one row.

    It is numpy.broadcast_to of one more axis, which takes ten times as long.

    Examples
    --------
    >>> repeated(np.array([1.0, 2.0]), 2)
    array([[1., 2.],
           [1., 2.]])
    """
    row = np.asarray(row, order="C")
    strides = (0, *row.strides)
    rows: NDArray[Scalar] = np.ndarray((count, *row.shape), row.dtype, row, strides=strides)
    rows.setflags(write=False)
    return rows


def distinct(rows: Floats) -> Floats:
    """Return the rows of an array (N, ...), one of them where they are stored once.

    Examples
    --------
    >>> distinct(np.broadcast_to(2.0, (5, 3))).shape, distinct(np.ones((5, 3))).shape
    ((1, 3), (5, 3))
    """
    return rows[:1] if rows.strides[0] == 0 else rows


def expanded(rows: Floats, count: int) -> Floats:
    """Return `count` rows from all of them or from the one that `distinct` leaves.

    Examples
    --------
    >>> expanded(np.array([[1.0]]), 2).ravel(), expanded(np.array([[1.0], [2.0]]), 2).ravel()
    (array([1., 1.]), array([1., 2.]))
    """
    return repeated(rows[0], count) if len(rows) == 1 else rows


def mean_row(rows: Floats) -> Floats:
    """Return the mean row of an array (N, ...); the one row where they are stored once.

    Examples
    --------
    >>> mean_row(np.broadcast_to(2.0, (5, 2))), mean_row(np.array([[1.0], [2.0]]))
    (array([2., 2.]), array([1.5]))
    """
    return rows[0] if rows.strides[0] == 0 else np.asarray(rows.mean(axis=0))


def count_present(seen: Bools) -> Ints:
    """Return how many points of each set (..., n) are present: shape (...).

    Examples
    --------
    >>> count_present(np.array([[True, True], [False, True]]))
    array([2, 1])
    """
    if seen.all():  # a sum over a short axis takes longer
        return np.full(seen.shape[:-1], seen.shape[-1], dtype=np.int64)
    return np.asarray(seen.sum(axis=-1))


def as_sigma(sigma: ArrayLike, dimensions: int) -> Floats:
    """Return a localisation error as one number per axis, shape (d,).

    Raises
    ------
    ValueError
        Unless it is one number, or one per axis, none of them negative or infinite.
    """
    refuse(sigma_fault(sigma, dimensions))
    return np.broadcast_to(np.asarray(sigma, dtype=np.float64), (dimensions,)).copy()


def sigma_fault(sigma: ArrayLike, dimensions: int) -> list[str]:
    """Return one line where a localisation error is neither one number >= 0 nor one per axis.

    Examples
    --------
    >>> sigma_fault([0.02, 0.02, 0.05], 3), sigma_fault(0.02, 3)
    ([], [])
    >>> sigma_fault(-0.02, 3)
    ['sigma: expected one number >= 0 or 3 of them (one per axis), in um, got -0.02']
    """
    sound = np.shape(sigma) in ((), (dimensions,)) and not any(
        number_fault("sigma", value, least=0) for value in np.ravel(sigma).tolist()
    )
    if sound:
        return []
    return [
        f"sigma: expected one number >= 0 or {dimensions} of them (one per axis), in um, "
        f"got {sigma!r}"
    ]


def require_positive(**values: float) -> None:
    """Raise one ValueError that lists every keyword whose value is not a positive number."""
    bad = [
        f"{name} = {value!r}"
        for name, value in values.items()
        if not (np.ndim(value) == 0 and 0 < value < np.inf)
    ]
    if bad:
        raise ValueError("expected a finite number > 0: " + ", ".join(bad))


def number_fault(
    name: str,
    value: object,
    *,
    above: float | None = None,
    least: float | None = None,
    below: float | None = None,
    most: float | None = None,
    whole: bool = False,
    unit: str = "",
) -> list[str]:
    """Return one line where a value is not a finite number of a range, or no line.

    Parameters
    ----------
    name : str
        The argument's name, with which the line begins.
    value : object
        Value that the user passed.
    above, least, below, most : float, optional
        Bounds: value > above, value >= least, value < below, value <= most.
    whole : bool
        Only integers are accepted.
    unit : str
        Unit named in the line.

    Returns
    -------
    list of str
        Empty, or one line.

    Examples
    --------
    >>> number_fault("dt", 2.0, above=0, unit="s")
    []
    >>> number_fault("dt", -2.0, above=0, unit="s")
    ['dt: expected a finite number > 0 (s), got -2.0']
    >>> number_fault("n_frames", 2.5, least=3, whole=True)
    ['n_frames: expected a whole number >= 3, got 2.5']
    """
    kinds = (int, np.integer) if whole else (int, float, np.integer, np.floating)
    sound = (
        isinstance(value, kinds)
        and not isinstance(value, bool)
        and bool(np.isfinite(value))
        and (above is None or value > above)
        and (least is None or value >= least)
        and (below is None or value < below)
        and (most is None or value <= most)
    )
    if sound:
        return []
    bounds = {">": above, ">=": least, "<": below, "<=": most}
    wanted = " and ".join(
        f"{sign} {bound:g}" for sign, bound in bounds.items() if bound is not None
    )
    kind = "a whole number" if whole else "a finite number"
    text = " ".join(part for part in (kind, wanted, f"({unit})" if unit else "") if part)
    return [f"{name}: expected {text}, got {value!r}"]


def choice_fault(name: str, value: object, offered: Iterable[object]) -> list[str]:
    """Return one line where a value is none of those offered, or no line.

    Examples
    --------
    >>> choice_fault("method", "fast", ("mle", "cve"))
    ["method: expected 'mle' or 'cve', got 'fast'"]
    """
    offered = list(offered)
    if any(
        value is choice or (type(value) is type(choice) and value == choice) for choice in offered
    ):
        return []
    *first, last = map(repr, offered)
    words = f"{', '.join(first)} or {last}" if first else last
    return [f"{name}: expected {words}, got {value!r}"]


def flag_fault(name: str, value: object) -> list[str]:
    """Return one line where a value is neither True nor False, or no line.

    Examples
    --------
    >>> flag_fault("drift", np.True_), flag_fault("drift", "no")
    ([], ["drift: expected True or False, got 'no'"])
    """
    if isinstance(value, bool | np.bool_):
        return []
    return [f"{name}: expected True or False, got {value!r}"]


def numpy_to_python(options: object) -> None:
    """Replace NumPy scalars in the fields of a frozen dataclass by Python's numbers.

    Examples
    --------
    >>> from dataclasses import dataclass
    >>> @dataclass(frozen=True)
    ... class Scan:
    ...     exposure: float
    ...     def __post_init__(self):
    ...         numpy_to_python(self)
    >>> Scan(np.float32(0.5))
    Scan(exposure=0.5)
    """
    for field in fields(options):  # type: ignore[arg-type]
        value = getattr(options, field.name)
        if isinstance(value, np.floating):
            object.__setattr__(options, field.name, float(value))
        elif isinstance(value, np.generic):
            object.__setattr__(options, field.name, value.item())


class PlainOptions:
    """Base of the options objects whose fields are all values that JSON holds.

    Examples
    --------
    >>> from dataclasses import dataclass
    >>> @dataclass(frozen=True)
    ... class Scan(PlainOptions):
    ...     exposure: float = 0.0
    >>> Scan.from_dict(Scan(exposure=0.5).to_dict())
    Scan(exposure=0.5)
    """

    def to_dict(self) -> dict[str, Any]:
        """Return the options as values that JSON holds."""
        return {field.name: to_plain(getattr(self, field.name)) for field in fields(self)}  # type: ignore[arg-type]

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> Self:
        """Return the options that `to_dict` wrote.

        Parameters
        ----------
        entry : mapping
            The dictionary of `to_dict`.

        Returns
        -------
        options
            An object of the class.
        """
        return cls(**entry)


def refuse(faults: Iterable[str], *, error: type[ValueError] = ValueError) -> None:
    """Raise one error that lists all faults, if there are any."""
    lines = list(faults)
    if lines:
        raise error("; ".join(lines))


def options_from(
    kind: type[Options],
    given: Options | None,
    settings: Mapping[str, object],
    *,
    name: str,
    faults: MutableSequence[str],
) -> Options:
    """Return the options of a function: an object, or one made from single keywords.

    Parameters
    ----------
    kind : type
        The dataclass of the options.
    given : object of that type or None
        The object that the user passed.
    settings : mapping
        Single keywords that the user passed; those that are no fields of `kind` are ignored.
    name : str
        The argument in which the object is passed.
    faults : list of str
        Receives the faults: a value out of range, or an option stated in both ways.

    Returns
    -------
    object of type `kind`
        The defaults where there are faults.

    Examples
    --------
    >>> from dataclasses import dataclass
    >>> @dataclass(frozen=True, kw_only=True)
    ... class Scan:
    ...     exposure: float = 0.0
    >>> faults = []
    >>> options_from(Scan, None, {"exposure": 0.1}, name="scan", faults=faults), faults
    (Scan(exposure=0.1), [])
    >>> _ = options_from(Scan, Scan(), {"exposure": 0.1}, name="scan", faults=faults)
    >>> faults
    ['exposure: stated in scan= and as a keyword; state it once']
    """
    names = [field.name for field in fields(kind)]  # type: ignore[arg-type]
    own = {key: value for key, value in settings.items() if key in names}
    if given is not None:
        faults.extend(stated_twice(key, name) for key in own)
        if not isinstance(given, kind):
            faults.append(f"{name}: expected {kind.__name__}(...), got {given!r}")
            return kind()
        return given
    try:
        return kind(**own)
    except ValueError as fault:
        faults.append(str(fault))
        return kind()


def stated_twice(key: str, name: str) -> str:
    """Return the fault of a value that is stated in an options object and as a keyword.

    Parameters
    ----------
    key : str
        Name of the value.
    name : str
        The argument in which the object is passed.

    Examples
    --------
    >>> stated_twice("exposure", "noise")
    'exposure: stated in noise= and as a keyword; state it once'
    """
    return f"{key}: stated in {name}= and as a keyword; state it once"


def refuse_unknown(function: str, settings: Iterable[str], known: Iterable[str]) -> None:
    """Raise a TypeError that names a keyword which a function does not have, and a similar one.

    Examples
    --------
    >>> refuse_unknown("render_stack", ["photon"], ["photons", "gain"])
    Traceback (most recent call last):
    TypeError: render_stack: unknown keyword 'photon'; the nearest known one is 'photons'
    """
    from difflib import get_close_matches

    known = list(known)
    lines = []
    for key in settings:
        if key not in known:
            nearest = get_close_matches(key, known, n=1)
            hint = f"; the nearest known one is {nearest[0]!r}" if nearest else ""
            lines.append(f"unknown keyword {key!r}{hint}")
    if lines:
        raise TypeError(f"{function}: " + "; ".join(lines))


def finite_or_none(value: float) -> float | None:
    """Return a number that JSON can hold; None where it is infinite or missing.

    Examples
    --------
    >>> finite_or_none(2.0), finite_or_none(float("inf"))
    (2.0, None)
    """
    return float(value) if np.isfinite(value) else None


def to_plain(value: Any) -> Any:  # noqa: ANN401 (whatever a result holds)
    """Return a value for JSON: lists for arrays, None for numbers that are not finite.

    Objects that have a method ``to_dict`` are converted by it.

    Examples
    --------
    >>> to_plain({"value": np.array([1.0, np.nan]), "n": np.int64(3), "pair": (1, "a")})
    {'value': [1.0, None], 'n': 3, 'pair': [1, 'a']}
    """
    if hasattr(value, "to_dict"):
        return value.to_dict()
    if isinstance(value, np.ndarray):
        return to_plain(value.tolist())
    if isinstance(value, np.generic):
        return to_plain(float(value) if isinstance(value, np.floating) else value.item())
    if isinstance(value, float):
        return finite_or_none(value)
    if isinstance(value, Mapping):
        return {key: to_plain(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [to_plain(inner) for inner in value]
    return value


def from_plain(value: Any, *, dtype: type = np.float64) -> NDArray[Any]:  # noqa: ANN401
    """Return the array that `to_plain` wrote, read-only; None becomes NaN.

    Examples
    --------
    >>> from_plain([1.0, None])
    array([ 1., nan])
    """
    array: NDArray[Any] = np.array(value, dtype=np.float64).astype(dtype)
    frozen(array)
    return array


def frozen(*arrays: NDArray[Any]) -> None:
    """Make the arrays of a result read-only."""
    for array in arrays:
        array.setflags(write=False)
