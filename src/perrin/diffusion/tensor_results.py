"""DiffusionTensor and CoupledTensor: measured diffusion tensors with their errors."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from perrin._arrays import Bools, Floats, from_plain, frozen, to_plain
from perrin._display import Shown
from perrin._text import with_error

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from perrin.diffusion.steps import Quantity

# Elements of a symmetric matrix in the order of `DiffusionTensor.covariance`.
SYMMETRIC_ELEMENTS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))

# An axis that an error of one standard deviation turns by more than this (degrees) is not known.
_KNOWN_AXIS = 20.0

# The error in degrees of the axes of equal values: no direction in their plane is distinguished.
EQUAL_AXES_ERROR = 45.0

NO_ERRORS = "no errors are known: a value lies on its edge, 0; take longer tracks or longer steps"

# Values are distinguished at this level.
_ISOTROPY_LEVEL = 0.05


@dataclass(frozen=True, eq=False, repr=False)
class DiffusionTensor(Shown):
    """A diffusion tensor in body axes: those of the (first) motion's template.

    Attributes
    ----------
    tensor : ndarray, shape (3, 3)
        Diffusion tensor, rad^2/s or um^2/s.
    principal_values : ndarray, shape (3,)
        Principal values in rising order: axis 1 is the one about (or along) which the body diffuses
        slowest, as in `Mobility`, in predictions and in `msad_axes`. Sorted values of an isotropic
        body differ by their errors alone: read them with `p_isotropic`, `p_axial` and
        `resolved_axes`.
    axes : ndarray, shape (3, 3)
        Column a is the body axis of principal value a; right-handed.
    stderr : ndarray, shape (3,)
        Standard errors of the principal values.
    p_isotropic : float
        Probability of data this anisotropic if all three values were equal (likelihood ratio,
        chi-squared with 5 degrees of freedom).
    p_axial : float
        Probability of data this far from axial symmetry if two values were equal, about any axis
        (2 degrees of freedom).
    covariance : ndarray, shape (6, 6)
        Covariance of the elements xx, yy, zz, xy, xz, yz.
    axis_errors : ndarray, shape (3, 3)
        Angle, in degrees, by which one standard error turns axes a and b in their common plane; 45
        where symmetry makes their values equal, 0 where it fixes the axes.
    symmetry : str
        Point group whose symmetry was imposed on the tensor; "C_1" for none.
    offset : ndarray, shape (3, 3)
        Noise covariance of one frame less blur, rad^2 or um^2, body axes, mean over frames and
        motions.
    quantity : {"rotation", "translation"}
        Motion that the tensor describes.
    unit : str
        Unit of the tensor: "rad^2/s" or "um^2/s".
    n_frames : int
        Number of frames with a pose, of all motions.
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
        """Mean over the axes, a third of the trace."""
        return float(np.trace(self.tensor)) / 3

    @property
    def mean_stderr(self) -> float:
        """Standard error of the mean."""
        return float(np.sqrt(self.covariance[:3, :3].sum())) / 3

    @property
    def resolved_axes(self) -> Bools:
        """Whether each axis is known, shape (3,).

        Known are axes that symmetry fixes, and those whose values the tests distinguish (p < 0.05)
        and whose errors are below 20 degrees in both planes that they lie in. Errors alone are not
        enough: sorted values differ, so that the axes of an isotropic body would seem known.
        """
        known = (
            self.axis_errors < _KNOWN_AXIS if self.p_isotropic < _ISOTROPY_LEVEL else np.eye(3) > 0
        )
        near = 0 if np.diff(self.principal_values).argmin() == 0 else 1
        if self.p_axial >= _ISOTROPY_LEVEL:
            known[near, near + 1] = known[near + 1, near] = False
        return np.asarray((known | (self.axis_errors == 0)).all(axis=1))

    def along(self, direction: ArrayLike) -> tuple[float, float]:
        """Return the coefficient along, or about, a body direction, and its standard error.

        The result has no bias of sorted values, because the direction is chosen beforehand.

        Parameters
        ----------
        direction : array_like, shape (3,)
            Direction in body axes, of any length but zero.
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
            Symmetric weights in body axes with a positive trace: p p^T for one direction, the
            identity for the mean of all axes, ``LagCurve.weights`` for the slope of a curve.
        """
        w = np.asarray(weights, dtype=np.float64)
        if w.shape != (3, 3) or not 0 < np.trace(w) < np.inf:
            raise ValueError(f"weights: expected (3, 3) with a positive trace, got {weights!r}")
        w = w / np.trace(w)
        row = np.array([w[i, j] * (1 + (i != j)) for i, j in SYMMETRIC_ELEMENTS])
        value = float(np.einsum("ij,ij->", w, self.tensor))
        return value, float(np.sqrt(row @ self.covariance @ row))

    def __str__(self) -> str:
        first, *rest = self.summary.split("\n")
        mean = f"mean {with_error(self.mean, self.mean_stderr)}"
        return "\n".join([first, f"{mean}, {rest[0]}", *rest[1:]])

    @property
    def summary(self) -> str:
        """Text of `str` without the mean, which `estimate_diffusion` gives as D."""
        name = "D_R" if self.quantity == "rotation" else "D_T"
        pairs = zip(self.principal_values, self.stderr, strict=True)
        values = ", ".join(with_error(value, stderr) for value, stderr in pairs)
        isotropic, axial = (
            f"p = {p:.2g}" if p >= 1e-6 else "p < 1e-6" for p in (self.p_isotropic, self.p_axial)
        )
        return (
            f"{name} = {values} {self.unit} [{self.n_frames} frames, symmetry {self.symmetry}]\n"
            f"isotropic: {isotropic}, axial: {axial}\n"
            f"{self.statement}"
        )

    @property
    def statement(self) -> str:
        """Text on which axes are known; where two values are not distinguished, the plane."""
        if np.isnan(self.stderr).any():
            return NO_ERRORS
        known = np.flatnonzero(self.resolved_axes)
        worst = self.axis_errors.max(axis=1)
        equal = (self.axis_errors == EQUAL_AXES_ERROR).any() and self.symmetry != "C_1"
        if known.size == 3:
            return "axes known to " + ", ".join(f"{w:.0f}" for w in worst) + " degrees"
        if known.size == 1:
            a, b = (k + 1 for k in range(3) if k != known[0])
            why = f"are equal by symmetry {self.symmetry}" if equal else "cannot be distinguished"
            return (
                f"values {a} and {b} {why}: the plane of their axes is known, not the axes; its "
                f"normal, axis {known[0] + 1}, to {worst[known[0]]:.0f} degrees"
            )
        mean = "D_R, the mean" if self.quantity == "rotation" else "D_T, the mean"
        if equal:
            return f"the values are equal by symmetry {self.symmetry}: read {mean}"
        return f"the axes cannot be distinguished: read {mean}, not the three sorted values"

    def to_dict(self) -> dict[str, Any]:
        """Return the tensor for JSON; unknown errors are None."""
        plain: dict[str, Any] = to_plain({f.name: getattr(self, f.name) for f in fields(self)})
        return plain

    @classmethod
    def from_dict(cls, entry: dict[str, Any]) -> DiffusionTensor:
        """Return the tensor that `to_dict` wrote."""
        read: dict[str, Any] = {
            k: from_plain(v) if isinstance(v, list) else v for k, v in entry.items()
        }
        for name in ("p_isotropic", "p_axial"):
            read[name] = np.nan if entry[name] is None else entry[name]
        return cls(**read)


@dataclass(frozen=True, eq=False, repr=False)
class CoupledTensor(Shown):
    """The 6 x 6 tensor of translation, rotation and their coupling, in body axes.

    Attributes
    ----------
    tensor : ndarray, shape (6, 6)
        Diffusion tensor, translation first: um^2/s, um rad/s, rad^2/s.
    stderr : ndarray, shape (6, 6)
        Standard errors of the elements, with the error of the point where it was estimated.
    point : ndarray, shape (3,)
        Point of the body whose translation is described, from the centre of the template, um.
    n_frames : int
        Number of frames with a pose.
    """

    tensor: Floats
    stderr: Floats
    point: Floats
    n_frames: int

    def __post_init__(self) -> None:
        frozen(self.tensor, self.stderr, self.point)

    @property
    def D_T(self) -> Floats:
        """Translational block of the tensor, (3, 3), um^2/s."""
        return self.tensor[:3, :3]

    @property
    def D_R(self) -> Floats:
        """Rotational block of the tensor, (3, 3), rad^2/s; the same for every point."""
        return self.tensor[3:, 3:]

    @property
    def D_C(self) -> Floats:
        """Coupling block, (3, 3), um rad/s: row the translation, column the rotation."""
        return self.tensor[:3, 3:]

    def to_dict(self) -> dict[str, Any]:
        """Return the tensor for JSON; unknown errors are None."""
        plain: dict[str, Any] = to_plain({f.name: getattr(self, f.name) for f in fields(self)})
        return plain

    @classmethod
    def from_dict(cls, entry: dict[str, Any]) -> CoupledTensor:
        """Return the tensor that `to_dict` wrote."""
        read: dict[str, Any] = {
            k: from_plain(v) if isinstance(v, list) else v for k, v in entry.items()
        }
        return cls(**read)
