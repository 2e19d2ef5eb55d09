"""Sizes that follow from measured coefficients, and coefficients predicted for known spheres."""

from __future__ import annotations

import warnings
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from perrin._arrays import finite_or_none
from perrin._display import Shown
from perrin.diffusion.tensors import axes_like
from perrin.errors import PrecisionWarning, UnitWarning
from perrin.geometry.shapes import pair_distances
from perrin.geometry.symmetry import matching_rotation
from perrin.hydrodynamics.mobility import Mobility, cluster_mobility
from perrin.hydrodynamics.sizes import (
    Size,
    neighbour_distance,
    size_and_viscosity,
    size_from_rotation,
    size_from_translation,
)
from perrin.run.remarks import flow_warnings, unfit_diameter_text

if TYPE_CHECKING:
    from collections.abc import Sequence

    from perrin._arrays import Floats
    from perrin.diffusion.estimate import DiffusionEstimate
    from perrin.diffusion.tensor_results import DiffusionTensor


# Two shapes are the same if particles differ by less than this number of standard errors. One pair
# in 10^5 is missed, which costs a further solution and changes no result.
_SHAPE_ERRORS = 5.0

# Relative differences of distances that no diffusion coefficient shows, for tables without noise.
_SHAPE_ROUNDING = 1e-4

# Principal values closer than this (relative) cannot be distinguished in a track of 10^4 frames.
_UNEQUAL_AXES = 0.02

# A diameter over this multiple of the distance of neighbours, or under the distance by this factor,
# is farther off than the spread of any batch of particles.
_OVERLAPPING, _SEPARATE = 1.1, 1.5

# A diameter over this multiple of the distance of neighbours is in another unit.
_IMPOSSIBLE = 2.0


@dataclass(frozen=True, repr=False)
class Compared(Shown):
    """A predicted coefficient and the measured one.

    Attributes
    ----------
    predicted, measured : float
        Predicted and measured coefficient, um^2/s or rad^2/s.
    stderr : float
        Standard error of the measured coefficient; NaN where that is an upper limit only.

    Examples
    --------
    >>> round(Compared(predicted=6.73e-3, measured=4.93e-3, stderr=0.49e-3).pull, 1)
    -3.7
    """

    predicted: float
    measured: float
    stderr: float

    @property
    def pull(self) -> float:
        """(measured - predicted)/stderr; NaN without a standard error."""
        if not (np.isfinite(self.stderr) and self.stderr > 0):
            return float("nan")
        return (self.measured - self.predicted) / self.stderr

    def to_dict(self) -> dict[str, float | None]:
        """Return the four numbers for JSON, None for the unknown."""
        numbers = asdict(self) | {"pull": self.pull}
        return {name: finite_or_none(x) for name, x in numbers.items()}

    @classmethod
    def from_dict(cls, entry: dict[str, float | None]) -> Compared:
        """Read back what `to_dict` wrote."""
        known = (entry[name] for name in ("predicted", "measured", "stderr"))
        return cls(*(np.nan if x is None else x for x in known))


@dataclass(frozen=True, repr=False)
class Prediction(Shown):
    """How equal spheres of a stated diameter would diffuse at the places measured.

    Attributes
    ----------
    diameter : float
        Stated sphere diameter, um.
    error : float
        Relative numerical error of the predicted values. The pulls contain no errors of the
        diameter, the viscosity and the temperature.
    D_T : Compared
        Translational coefficient: a third of the trace, about the centre of diffusion, in an
        unbounded fluid.
    D_R : Compared or None
        Rotational coefficient: a third of the trace; None for a rod.
    D_perp : Compared or None
        Coefficient of a rod's direction; None for a body.
    principal_D_T, principal_D_R : tuple of Compared
        Predicted principal values, rising, and the values measured along their axes; empty where
        the body is nearly isotropic or no tensor was measured.
    """

    diameter: float
    error: float
    D_T: Compared
    D_R: Compared | None = None
    D_perp: Compared | None = None
    principal_D_T: tuple[Compared, ...] = ()
    principal_D_R: tuple[Compared, ...] = ()

    def __str__(self) -> str:
        pairs = (("D_T", self.D_T), ("D_R", self.D_R), ("D_perp", self.D_perp))
        shown = (f"{name} {c.predicted:.4g} (pull {c.pull:+.1f})" for name, c in pairs if c)
        return f"predicted for spheres of {self.diameter:.4g} um: {', '.join(shown)}"

    def to_dict(self) -> dict[str, Any]:
        """Return the prediction for JSON."""
        single = {name: getattr(self, name) for name in ("D_T", "D_R", "D_perp")}
        several = {name: getattr(self, name) for name in ("principal_D_T", "principal_D_R")}
        return (
            {"diameter": self.diameter, "error": self.error}
            | {name: c and c.to_dict() for name, c in single.items()}
            | {name: [c.to_dict() for c in values] for name, values in several.items()}
        )

    @classmethod
    def from_dict(cls, entry: dict[str, Any]) -> Prediction:
        """Read back what `to_dict` wrote."""
        read = dict(entry)
        for name in ("D_T", "D_R", "D_perp"):
            read[name] = entry[name] and Compared.from_dict(entry[name])
        for name in ("principal_D_T", "principal_D_R"):
            read[name] = tuple(map(Compared.from_dict, entry[name]))
        return cls(**read)


class Shape(NamedTuple):
    """Places of the particles of a body.

    Attributes
    ----------
    positions : ndarray, shape (n, d)
        Particle positions in body axes, um.
    error : float
        Standard error of one coordinate, um.
    """

    positions: Floats
    error: float


@dataclass(frozen=True, eq=False)
class ShapeMobility:
    """The mobility of spheres at the places of a shape, or the reason why it is not known.

    Attributes
    ----------
    mobility : Mobility or None
        Mobility in the axes of the shape.
    reason : str
        Why there is no mobility; empty where there is one.
    warnings : tuple of str
        Reasons to doubt the mobility.
    """

    mobility: Mobility | None
    reason: str = ""
    warnings: tuple[str, ...] = ()

    def turned_onto(self, shape: Shape, known: Shape) -> ShapeMobility | None:
        """Return this solution of `known` in the axes of a shape that is the same within errors.

        Returns None if the shapes differ.
        """
        if len(shape.positions) != len(known.positions):
            return None
        distances, others = (np.sort(pair_distances(x.positions)) for x in (shape, known))
        error = float(np.hypot(shape.error, known.error))
        tolerance = max(_SHAPE_ERRORS * error, _SHAPE_ROUNDING * float(distances.mean()))
        # Two particles change their distance by twice the tolerance at most.
        if np.abs(distances - others).max() > 2 * tolerance:
            return None
        if np.linalg.norm(shape.positions - known.positions, axis=1).max() <= tolerance:
            return self
        if self.mobility is None or shape.positions.shape[1] != 3:
            return self
        turn = matching_rotation(known.positions, shape.positions, tolerance=tolerance)
        if turn is None:
            return None
        both = np.kron(np.eye(2), turn)
        turned = replace(
            self.mobility,
            D=both @ self.mobility.D @ both.T,
            center=turn @ self.mobility.center,
            centers=self.mobility.centers @ turn.T,
        )
        return replace(self, mobility=turned)


def solve_bodies(
    shapes: Sequence[Shape], *, diameter: float | None, viscosity: float, temperature: float
) -> list[ShapeMobility]:
    """Return the mobility of each shape; shapes that are the same within errors are solved once.

    Parameters
    ----------
    shapes : sequence of Shape
    diameter : float or None
        Sphere diameter, um; None for spheres that touch.
    viscosity, temperature : float
        Viscosity, Pa s, and temperature, K.

    Returns
    -------
    list of ShapeMobility

    Notes
    -----
    Neither labels nor orientations matter: a shared solution is turned into the axes of each shape.

    Examples
    --------
    >>> from perrin.geometry.shapes import Cluster
    >>> x = Cluster.touching(4, 2.45).positions
    >>> one, other = solve_bodies(
    ...     [Shape(x, 1e-3), Shape(x[::-1], 1e-3)], diameter=None, viscosity=1e-3, temperature=300
    ... )
    >>> one.mobility.error == other.mobility.error, round(one.mobility.diameter_factor_R, 3)
    (True, 1.818)
    """
    solved: list[tuple[Shape, ShapeMobility]] = []
    found = []
    for shape in shapes:
        shared = (solution.turned_onto(shape, known) for known, solution in solved)
        body = next((one for one in shared if one is not None), None)
        if body is None:
            body = solve_shape(
                shape.positions, diameter=diameter, viscosity=viscosity, temperature=temperature
            )
            solved.append((shape, body))
        found.append(body)
    return found


def solve_shape(
    positions: Floats, *, diameter: float | None, viscosity: float, temperature: float
) -> ShapeMobility:
    """Solve for the flow around equal spheres at measured places.

    Parameters
    ----------
    positions : ndarray, shape (n, d)
        Particle positions in body axes, um.
    diameter : float or None
        Sphere diameter, um; None for spheres that touch.
    viscosity, temperature : float
        Viscosity, Pa s, and temperature, K.

    Returns
    -------
    ShapeMobility
        With the reason where the flow cannot be solved.
    """
    if positions.shape[1] != 3:
        return ShapeMobility(None, "they follow from motion in three dimensions")
    distance = neighbour_distance(positions)
    ratio = 1.0 if diameter is None else diameter / distance
    if diameter is not None and ratio > _IMPOSSIBLE:
        return ShapeMobility(None, unfit_diameter_text(distance, diameter, impossible=True))
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", PrecisionWarning)
            # A viscosity in another unit concerns the whole table, not each of its shapes.
            warnings.simplefilter("ignore", UnitWarning)
            mobility = cluster_mobility(
                positions,
                radius=ratio * distance / 2,
                viscosity=viscosity,
                temperature=temperature,
            )
    except (ValueError, np.linalg.LinAlgError) as error:
        return ShapeMobility(None, f"cluster_mobility refuses this shape: {error}")
    remarks = flow_warnings(w.message for w in caught)
    if diameter is not None and (ratio > _OVERLAPPING or ratio < 1 / _SEPARATE):
        remarks.append(unfit_diameter_text(distance, diameter, impossible=False))
    return ShapeMobility(mobility, warnings=tuple(remarks))


def find_sizes(
    mobility: Mobility,
    *,
    D_T: DiffusionEstimate,
    D_R: DiffusionEstimate,
    viscosity: float | None,
    temperature: float,
) -> dict[str, Size]:
    """Return the sizes that resolved coefficients imply for equal spheres of this shape.

    Parameters
    ----------
    mobility : Mobility
        Mobility of the shape, at any size.
    D_T, D_R : DiffusionEstimate
    viscosity : float or None
        Viscosity, Pa s.
    temperature : float
        Temperature, K.

    Returns
    -------
    dict of Size
        "translation" and "rotation" where the viscosity is known, and "both", which needs none.
    """
    sizes: dict[str, Size] = {}
    has_T, has_R = is_known(D_T), is_known(D_R)
    if viscosity is not None:
        known: dict[str, Any] = {
            "cluster": mobility,
            "viscosity": viscosity,
            "temperature": temperature,
        }
        with warnings.catch_warnings():
            # A viscosity in another unit concerns the whole table, not each of its clusters.
            warnings.simplefilter("ignore", UnitWarning)
            if has_T:
                sizes["translation"] = size_from_translation(D_T, **known)
            if has_R:
                sizes["rotation"] = size_from_rotation(D_R, **known)
    if has_T and has_R:
        sizes["both"] = size_and_viscosity(D_T, D_R, cluster=mobility, temperature=temperature)
    return sizes


def is_known(estimate: DiffusionEstimate) -> bool:
    """Return whether a coefficient has a value and an error, and is no upper limit."""
    return estimate.resolved and bool(np.isfinite(estimate.stderr))


def compare_body(
    mobility: Mobility,
    *,
    D_T: DiffusionEstimate,
    D_R: DiffusionEstimate,
    tensor_T: DiffusionTensor | None = None,
    tensor_R: DiffusionTensor | None = None,
) -> Prediction:
    """Compare what a mobility predicts with what was measured on a body.

    Parameters
    ----------
    mobility : Mobility
        Mobility in the axes of the motion's template.
    D_T, D_R : DiffusionEstimate
    tensor_T, tensor_R : DiffusionTensor, optional

    Returns
    -------
    Prediction
    """
    T, R = mobility.principal_D_T, mobility.principal_D_R
    # "Axis 1" is the same axis of the body in every table: that of the measured tensor of rotation
    # where its axes are known, else the one about which the body should turn slowest.
    known = tensor_R is not None and bool(tensor_R.resolved_axes.all())
    reference = tensor_R.axes if known and tensor_R is not None else R.axes
    order_T, order_R = axes_like(T.axes, reference), axes_like(R.axes, reference)
    return Prediction(
        diameter=mobility.sphere_diameter,
        error=mobility.error,
        D_T=compare_value(float(T.values[order_T].mean()), D_T),
        D_R=compare_value(float(R.values[order_R].mean()), D_R),
        principal_D_T=compare_axes(T.values[order_T], T.axes[:, order_T], tensor_T),
        principal_D_R=compare_axes(R.values[order_R], R.axes[:, order_R], tensor_R),
    )


def compare_rod(
    mobility: Mobility, *, D_T: DiffusionEstimate, D_perp: DiffusionEstimate
) -> Prediction:
    """Compare what a mobility predicts with what was measured on a rod.

    Parameters
    ----------
    mobility : Mobility
        Mobility of spheres on a line, which turn fastest about it.
    D_T, D_perp : DiffusionEstimate

    Returns
    -------
    Prediction
    """
    return Prediction(
        diameter=mobility.sphere_diameter,
        error=mobility.error,
        D_T=compare_value(float(np.trace(mobility.D_T)) / 3, D_T),
        D_perp=compare_value(float(mobility.principal_D_R.values[:2].mean()), D_perp),
    )


def compare_value(predicted: float, estimate: DiffusionEstimate) -> Compared:
    """Compare a predicted coefficient with an estimate, whose upper limit has no error."""
    error = estimate.stderr if is_known(estimate) else float("nan")
    return Compared(predicted, estimate.value, error)


def compare_axes(
    predicted: Floats, axes: Floats, tensor: DiffusionTensor | None
) -> tuple[Compared, ...]:
    """Compare predicted principal values with a measured tensor along the predicted axes.

    Sorted measured values would be of other axes wherever errors exchange two of them.

    Parameters
    ----------
    predicted : ndarray, shape (3,)
        Predicted principal values.
    axes : ndarray, shape (3, 3)
        Their axes as columns, in body axes.
    tensor : DiffusionTensor or None
        The measured tensor.

    Returns
    -------
    tuple of Compared
        Empty where the body is nearly isotropic or no tensor was measured.
    """
    if tensor is None or not are_unequal(predicted):
        return ()
    x, y, z = axes
    # Weights of the elements xx, yy, zz, xy, xz, yz in a value along an axis.
    weight = np.stack([x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z], axis=1)
    measured = np.einsum("ik,ij,jk->k", axes, tensor.tensor, axes)
    variance = np.einsum("ke,ef,kf->k", weight, tensor.covariance, weight)
    rows = zip(predicted, measured, np.sqrt(variance), strict=True)
    return tuple(Compared(*map(float, row)) for row in rows)


def are_unequal(principal_values: Floats) -> bool:
    """Return whether principal values differ by more than 2 % of their mean."""
    return bool(np.ptp(principal_values) > _UNEQUAL_AXES * principal_values.mean())
