"""What a cluster's shape implies: sizes from its D, and the D that spheres of a known size have."""

from __future__ import annotations

import warnings
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from perrin.diffusion.tensors import axes_like
from perrin.errors import PrecisionWarning, UnitWarning
from perrin.geometry.symmetry import matching_rotation
from perrin.hydrodynamics.mobility import Mobility, Principal, cluster_mobility
from perrin.hydrodynamics.sizes import (
    Size,
    neighbour_distance,
    size_and_viscosity,
    size_from_rotation,
    size_from_translation,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from perrin._arrays import Floats, Ints
    from perrin.diffusion.estimate import DiffusionEstimate
    from perrin.diffusion.tensor_results import DiffusionTensor


# Shapes are alike if particles differ by less than this many standard errors; one in 10^5 is missed
# and costs a solution, nothing else.
_ALIKE = 5.0


# Distances (relative) that no diffusion coefficient can tell apart, for tables without noise.
_SAME = 1e-4


# Principal values closer than this (relative) cannot be told apart in a track of 10^4 frames.
_UNEQUAL = 0.02


# Spheres that would overlap, or stand apart, by more than the spread of any batch of particles.
_OVERLAP, _APART = 1.1, 1.5


# From here on a diameter is no property of these particles but a wrong unit.
_ABSURD = 2.0


@dataclass(frozen=True)
class Compared:
    """A predicted coefficient beside the measured one.

    Attributes
    ----------
    predicted, measured : float
        um^2/s or rad^2/s.
    stderr : float
        Standard error of the measured value; NaN where that is an upper limit only.

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
        return {name: x if np.isfinite(x) else None for name, x in numbers.items()}

    @classmethod
    def from_dict(cls, entry: dict[str, float | None]) -> Compared:
        """Read back what `to_dict` wrote."""
        known = (entry[name] for name in ("predicted", "measured", "stderr"))
        return cls(*(np.nan if x is None else x for x in known))


@dataclass(frozen=True)
class Prediction:
    """How equal spheres of a stated diameter would diffuse at the places measured.

    Attributes
    ----------
    diameter : float
        Of one sphere, as stated, um.
    error : float
        Relative error of the predicted values for exactly this body and these conditions. Errors of
        diameter, viscosity and temperature are in no pull.
    D_T : Compared
        A third of the trace, about the centre of diffusion, in an unbounded fluid.
    D_R : Compared or None
        A third of the trace; None for a rod.
    D_perp : Compared or None
        Of a rod's direction; None for a body.
    principal_D_T, principal_D_R : tuple of Compared
        Predicted principal values, rising, and what was measured along their axes; empty where the
        body is nearly isotropic or no tensor was measured.
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
        told = (f"{name} {c.predicted:.4g} (pull {c.pull:+.1f})" for name, c in pairs if c)
        return f"predicted for spheres of {self.diameter:.4g} um: {', '.join(told)}"

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
    """Places (n, d) of the particles of a body, um, and the standard error of a coordinate."""

    positions: Floats
    error: float


@dataclass(frozen=True, eq=False)
class Body:
    """How spheres at a shape's places move, or the reason why that is not known.

    Attributes
    ----------
    mobility : Mobility or None
    reason : str
        Why there is none.
    told : tuple of str
        What should be known of it.
    """

    mobility: Mobility | None
    reason: str = ""
    told: tuple[str, ...] = ()


class _Solved(NamedTuple):
    """A shape with its sorted pair distances, and the body it makes."""

    shape: Shape
    distances: Floats
    body: Body

    def turned_onto(self, shape: Shape, distances: Floats) -> Body | None:
        """Return the body in the axes of a shape that is alike within errors; None if it is not."""
        if len(distances) != len(self.distances):
            return None
        error = float(np.hypot(shape.error, self.shape.error))
        tolerance = max(_ALIKE * error, _SAME * float(distances.mean()))
        # A quick look: two particles move a distance by twice the tolerance at most.
        if np.abs(distances - self.distances).max() > 2 * tolerance:
            return None
        if np.linalg.norm(shape.positions - self.shape.positions, axis=1).max() <= tolerance:
            return self.body
        if self.body.mobility is None or shape.positions.shape[1] != 3:
            return self.body
        turn = matching_rotation(self.shape.positions, shape.positions, tolerance=tolerance)
        if turn is None:
            return None
        return replace(self.body, mobility=_turned(self.body.mobility, turn))


def solve_bodies(
    shapes: Sequence[Shape], *, diameter: float | None, viscosity: float, temperature: float
) -> list[Body]:
    """Return a body for each shape; shapes alike within their errors share one solution.

    Parameters
    ----------
    shapes : sequence of Shape
    diameter : float or None
        Of one sphere, um; None for spheres that touch.
    viscosity, temperature : float
        Pa s, K.

    Returns
    -------
    list of Body

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
    solved: list[_Solved] = []
    bodies = []
    for shape in shapes:
        distances = _sorted_distances(shape.positions)
        shared = (known.turned_onto(shape, distances) for known in solved)
        body = next((one for one in shared if one is not None), None)
        if body is None:
            body = _solve(shape.positions, diameter, viscosity, temperature)
            solved.append(_Solved(shape, distances, body))
        bodies.append(body)
    return bodies


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
        Of the shape, at any size.
    D_T, D_R : DiffusionEstimate
    viscosity : float or None
        Pa s.
    temperature : float
        K.

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
    """Put what a mobility predicts beside what was measured on a body.

    Parameters
    ----------
    mobility : Mobility
        In the axes of the motion's template.
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
    T, R = (_ordered(principal, axes_like(principal.axes, reference)) for principal in (T, R))
    return Prediction(
        diameter=mobility.sphere_diameter,
        error=mobility.error,
        D_T=_beside(float(T.values.mean()), D_T),
        D_R=_beside(float(R.values.mean()), D_R),
        principal_D_T=_principal(T, tensor_T),
        principal_D_R=_principal(R, tensor_R),
    )


def compare_rod(
    mobility: Mobility, *, D_T: DiffusionEstimate, D_perp: DiffusionEstimate
) -> Prediction:
    """Put what a mobility predicts beside what was measured on a rod.

    Parameters
    ----------
    mobility : Mobility
        Of spheres on a line, which turn fastest about it.
    D_T, D_perp : DiffusionEstimate

    Returns
    -------
    Prediction
    """
    return Prediction(
        diameter=mobility.sphere_diameter,
        error=mobility.error,
        D_T=_beside(float(np.trace(mobility.D_T)) / 3, D_T),
        D_perp=_beside(float(mobility.principal_D_R.values[:2].mean()), D_perp),
    )


def are_unequal(principal_values: Floats) -> bool:
    """Return whether principal values differ by more than any track could show."""
    return bool(np.ptp(principal_values) > _UNEQUAL * principal_values.mean())


def _beside(predicted: float, estimate: DiffusionEstimate) -> Compared:
    error = estimate.stderr if is_known(estimate) else float("nan")
    return Compared(predicted, estimate.value, error)


def _ordered(principal: Principal, order: Ints) -> Principal:
    return Principal(principal.values[order], principal.axes[:, order])


def _principal(values: Principal, tensor: DiffusionTensor | None) -> tuple[Compared, ...]:
    """Compare along the predicted axes where the body has unequal ones and a tensor was measured.

    Sorted measured values would be of other axes wherever errors exchange two of them.
    """
    if tensor is None or not are_unequal(values.values):
        return ()
    x, y, z = values.axes
    # What the elements xx, yy, zz, xy, xz, yz weigh in a value along an axis.
    weight = np.stack([x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z], axis=1)
    measured = np.einsum("ik,ij,jk->k", values.axes, tensor.tensor, values.axes)
    variance = np.einsum("ke,ef,kf->k", weight, tensor.covariance, weight)
    rows = zip(values.values, measured, np.sqrt(variance), strict=True)
    return tuple(Compared(*map(float, row)) for row in rows)


def _turned(mobility: Mobility, rotation: Floats) -> Mobility:
    """Return the same body turned about the origin."""
    both = np.kron(np.eye(2), rotation)
    return replace(
        mobility,
        D=both @ mobility.D @ both.T,
        center=rotation @ mobility.center,
        centers=mobility.centers @ rotation.T,
    )


def _sorted_distances(positions: Floats) -> Floats:
    first, second = np.triu_indices(len(positions), 1)
    return np.sort(np.linalg.norm(positions[first] - positions[second], axis=1))


def _solve(positions: Floats, diameter: float | None, viscosity: float, temperature: float) -> Body:
    """Solve for one shape; what cannot be solved, or not well, is told."""
    if positions.shape[1] != 3:
        return Body(None, "they follow from motion in three dimensions")
    distance = neighbour_distance(positions)
    ratio = 1.0 if diameter is None else diameter / distance
    if ratio > _ABSURD:
        return Body(
            None,
            f"neighbours are {distance:.3g} um apart, which spheres of {diameter:g} um cannot be; "
            "correct the diameter (um) or the scale",
        )
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
        return Body(None, f"cluster_mobility refuses this shape: {error}")
    told = [f"predicted flow: {w.message}" for w in caught]
    if ratio > _OVERLAP or ratio < 1 / _APART:
        would = "would overlap" if ratio > 1 else "do not touch"
        told.append(
            f"neighbours are {distance:.3g} um apart, where spheres of {diameter:g} um {would}; "
            "check the diameter and the scale"
        )
    return Body(mobility, told=tuple(told))
