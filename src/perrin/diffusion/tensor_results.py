"""DiffusionTensor and CoupledTensor: measured diffusion tensors with their errors."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from perrin._arrays import Bools, Floats, finite_or_none, frozen
from perrin._text import with_error

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from perrin.diffusion.steps import Quantity


# Elements of a symmetric matrix in the order of `DiffusionTensor.covariance`.
_ELEMENTS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


# An axis that an error of one standard deviation turns by more than this (degrees) is not known.
_KNOWN_AXIS = 20.0


# The error in degrees of the axes of equal values: any direction of their plane will do.
_EQUAL = 45.0


_NO_ERRORS = "no errors are known: a value lies on its edge, 0; take longer tracks or longer steps"


# Values are told apart at this level.
_LEVEL = 0.05


_TENSOR_ARRAYS = (
    "tensor", "principal_values", "axes", "stderr", "covariance", "axis_errors", "offset",
)  # fmt: skip


def _tensor_dict(tensor: DiffusionTensor) -> dict[str, Any]:
    """Return a tensor for JSON; unknown errors as None. Column a of axes is axis a."""
    entry = {f.name: getattr(tensor, f.name) for f in fields(tensor)}
    for name in _TENSOR_ARRAYS:
        array = entry[name].astype(object)
        array[~np.isfinite(entry[name])] = None
        entry[name] = array.tolist()
    for name in ("p_isotropic", "p_axial"):
        entry[name] = finite_or_none(entry[name])
    return entry


def _tensor_from(entry: dict[str, Any]) -> DiffusionTensor:
    """Read back what `_tensor_dict` wrote."""
    read = dict(entry)
    for name in _TENSOR_ARRAYS:
        read[name] = np.array(entry[name], dtype=np.float64)
    for name in ("p_isotropic", "p_axial"):
        read[name] = np.nan if entry[name] is None else entry[name]
    return DiffusionTensor(**read)


@dataclass(frozen=True, eq=False)
class DiffusionTensor:
    """A diffusion tensor in body axes: those of the (first) motion's template.

    Attributes
    ----------
    tensor : ndarray, shape (3, 3)
        rad^2/s or um^2/s.
    principal_values : ndarray, shape (3,)
        Rising: axis 1 is the one about (or along) which the body diffuses slowest, as in
        `Mobility`, in predictions and in `msad_axes`. Sorted values of an isotropic body differ by
        their errors alone: read them with `p_isotropic`, `p_axial` and `resolved_axes`.
    axes : ndarray, shape (3, 3)
        Column a is the body axis of principal value a; right-handed.
    stderr : ndarray, shape (3,)
        Standard errors of the principal values.
    p_isotropic : float
        Probability of data this anisotropic if all three values were equal (likelihood ratio,
        chi-squared with 5 degrees of freedom).
    p_axial : float
        The same if two values were equal, about any axis (2 degrees of freedom).
    covariance : ndarray, shape (6, 6)
        Of the elements xx, yy, zz, xy, xz, yz.
    axis_errors : ndarray, shape (3, 3)
        How far, in degrees, one standard error turns axes a and b in their common plane; 45 where
        symmetry makes their values equal, 0 where it fixes the axes.
    symmetry : str
        The point group whose symmetry the tensor was given; "C_1" for none.
    offset : ndarray, shape (3, 3)
        Noise of one frame less blur, rad^2 or um^2, body axes, mean over frames and motions.
    quantity : {"rotation", "translation"}
    unit : str
    n_frames : int
        Frames with a pose, of all motions.
    """

    tensor: Floats
    principal_values: Floats
    axes: Floats
    stderr: Floats
    p_isotropic: float
    p_axial: float
    covariance: Floats
    axis_errors: Floats
    symmetry: str
    offset: Floats
    quantity: Quantity
    unit: str
    n_frames: int

    def __post_init__(self) -> None:
        frozen(self.tensor, self.principal_values, self.axes, self.stderr, self.covariance)
        frozen(self.axis_errors, self.offset)

    @property
    def mean(self) -> float:
        """A third of the trace."""
        return float(np.trace(self.tensor)) / 3

    @property
    def mean_stderr(self) -> float:
        """Standard error of the mean."""
        return float(np.sqrt(self.covariance[:3, :3].sum())) / 3

    @property
    def resolved_axes(self) -> Bools:
        """Which axes (3,) are known.

        Those that symmetry fixes, and those whose values the tests tell apart (p < 0.05) and whose
        errors are below 20 degrees in both planes that they lie in. Errors alone would not do:
        sorted values keep a distance that makes the axes of an isotropic body look known.
        """
        known = self.axis_errors < _KNOWN_AXIS if self.p_isotropic < _LEVEL else np.eye(3) > 0
        near = 0 if np.diff(self.principal_values).argmin() == 0 else 1
        if self.p_axial >= _LEVEL:
            known[near, near + 1] = known[near + 1, near] = False
        return np.asarray((known | (self.axis_errors == 0)).all(axis=1))

    def along(self, direction: ArrayLike) -> tuple[float, float]:
        """Return the coefficient along, or about, a body direction, and its standard error.

        Free of the bias of sorted values: the direction is chosen beforehand.

        Parameters
        ----------
        direction : array_like, shape (3,)
            Body axes, any length but zero.
        """
        p = np.asarray(direction, dtype=np.float64)
        if p.shape != (3,) or not 0 < np.linalg.norm(p) < np.inf:
            raise ValueError(f"direction: expected 3 numbers, not all zero, got {direction!r}")
        p = p / np.linalg.norm(p)
        return self.weighted(np.outer(p, p))

    def weighted(self, weights: ArrayLike) -> tuple[float, float]:
        """Return the mean tr(D W)/tr W of the coefficients, and its standard error.

        Parameters
        ----------
        weights : array_like, shape (3, 3)
            Symmetric, body axes, with a positive trace: p p^T for one direction, the identity for
            the mean of all axes, ``LagCurve.weights`` for what a curve grows by.
        """
        w = np.asarray(weights, dtype=np.float64)
        if w.shape != (3, 3) or not 0 < np.trace(w) < np.inf:
            raise ValueError(f"weights: expected (3, 3) with a positive trace, got {weights!r}")
        w = w / np.trace(w)
        row = np.array([w[i, j] * (1 + (i != j)) for i, j in _ELEMENTS])
        value = float(np.einsum("ij,ij->", w, self.tensor))
        return value, float(np.sqrt(row @ self.covariance @ row))

    def __str__(self) -> str:
        first, *rest = self.summary.split("\n")
        mean = f"mean {with_error(self.mean, self.mean_stderr)}"
        return "\n".join([first, f"{mean}, {rest[0]}", *rest[1:]])

    @property
    def summary(self) -> str:
        """What `str` gives without the mean, for use beside the D of `estimate_diffusion`."""
        name = "D_R" if self.quantity == "rotation" else "D_T"
        pairs = zip(self.principal_values, self.stderr, strict=True)
        values = ", ".join(with_error(value, stderr) for value, stderr in pairs)
        return (
            f"{name} = {values} {self.unit} [{self.n_frames} frames, symmetry {self.symmetry}]\n"
            f"isotropic: {_probability(self.p_isotropic)}, axial: {_probability(self.p_axial)}\n"
            f"{self.statement}"
        )

    @property
    def statement(self) -> str:
        """Which axes are known, in words; where two cannot be told apart, the plane."""
        if np.isnan(self.stderr).any():
            return _NO_ERRORS
        known = np.flatnonzero(self.resolved_axes)
        worst = self.axis_errors.max(axis=1)
        equal = (self.axis_errors == _EQUAL).any() and self.symmetry != "C_1"
        if known.size == 3:
            return "axes known to " + ", ".join(f"{w:.0f}" for w in worst) + " degrees"
        if known.size == 1:
            a, b = (k + 1 for k in range(3) if k != known[0])
            why = f"are equal by symmetry {self.symmetry}" if equal else "cannot be told apart"
            return (
                f"values {a} and {b} {why}: the plane of their axes is known, not the axes; its "
                f"normal, axis {known[0] + 1}, to {worst[known[0]]:.0f} degrees"
            )
        if equal:
            return f"the values are equal by symmetry {self.symmetry}: read {self._mean_name}"
        return f"the axes cannot be told apart: read {self._mean_name}, not the three sorted values"

    @property
    def _mean_name(self) -> str:
        """The mean over axes, by the name it has beside a tensor."""
        return "D_R, the mean" if self.quantity == "rotation" else "D_T, the mean"


def _probability(p: float) -> str:
    return f"p = {p:.2g}" if p >= 1e-6 else "p < 1e-6"


@dataclass(frozen=True, eq=False)
class CoupledTensor:
    """The 6 x 6 tensor of translation, rotation and their coupling, in body axes.

    Attributes
    ----------
    tensor : ndarray, shape (6, 6)
        Translation first: um^2/s, um rad/s, rad^2/s.
    stderr : ndarray, shape (6, 6)
        Standard errors of the elements; where the point was estimated, its error included.
    point : ndarray, shape (3,)
        The point of the body whose translation this is, from the centre of the template, um.
    n_frames : int
        Frames with a pose.
    """

    tensor: Floats
    stderr: Floats
    point: Floats
    n_frames: int

    def __post_init__(self) -> None:
        frozen(self.tensor, self.stderr, self.point)

    @property
    def D_T(self) -> Floats:
        """Translation, (3, 3), um^2/s."""
        return self.tensor[:3, :3]

    @property
    def D_R(self) -> Floats:
        """Rotation, (3, 3), rad^2/s; the same for every point."""
        return self.tensor[3:, 3:]

    @property
    def D_C(self) -> Floats:
        """Coupling, (3, 3), um rad/s: row the translation, column the rotation."""
        return self.tensor[:3, 3:]
