"""How it diffuses in each direction: tensors of rotation, translation and both, in body axes."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from itertools import permutations
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from perrin.diffusion.estimate import UNITS
from perrin.diffusion.noise_model import choice_faults
from perrin.diffusion.steps import residual_freedom, unit_center_variance, unit_covariance
from perrin.diffusion.tensor_likelihood import (
    Maximum,
    Source,
    VectorSteps,
    axial,
    maximise,
    spread,
    squares,
)
from perrin.diffusion.tensor_results import (
    _ELEMENTS,
    _EQUAL,
    _NO_ERRORS,
    CoupledTensor,
    DiffusionTensor,
)
from perrin.errors import PrecisionWarning, TooFewFramesError
from perrin.geometry.rigid import diffusion_center, shifted
from perrin.geometry.rotations import exp_map, kabsch
from perrin.geometry.symmetry import point_group, schoenflies, symmetry_elements
from perrin.motion.rigid_motion import RigidMotion

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike

    from perrin._arrays import Floats, Ints
    from perrin.diffusion.steps import Quantity


# Noise this far below a step (variance) is none: simulated truth, whose residuals are rounding.
_NOISELESS = 1e-8


def diffusion_tensor(
    motion: RigidMotion | Sequence[RigidMotion],
    *,
    quantity: Quantity = "rotation",
    noise: Literal["joint", "residual"] | float = "joint",
    exposure: float | None = None,
    symmetry: str | None = None,
) -> DiffusionTensor:
    """Estimate the 3 x 3 tensor of rotation or translation in body axes by maximum likelihood.

    Parameters
    ----------
    motion : RigidMotion or sequence of RigidMotion
        In three dimensions. Several of like bodies, particles in the same order, are pooled: one
        tensor, each with its own noise; their templates are turned onto the first.
    quantity : {"rotation", "translation"}
        From body-frame rotation vectors, or from the centre's displacements in the axes that the
        body has half way through each step; a drift of the sample is not taken off.
    noise : {"joint", "residual"} or float
        "joint": the noise is predicted from the template but for one amplitude, which is estimated
        along with D. "residual": that amplitude is measured by the residuals of the rigid fit
        (right only if all particles of a frame are seen at the same instant). A number: the
        localisation error of one coordinate, um.
    exposure : float, optional
        Open fraction of dt, 0 to 1: motion blur is exposure/6. Unknown (None) leaves the blur of
        the joint fit free, between none and the largest possible; with the noise given it is taken
        as 0.
    symmetry : str, optional
        Schoenflies symbol of the point group that the tensor shares. Default: that of the template
        within its error. "C_1" gives the tensor no symmetry. Another symbol is looked for with
        growing tolerance, as real clusters of unequal spheres need.

    Returns
    -------
    DiffusionTensor
        The p-values are those of the fit without symmetry: they also say whether the data agree
        with a symmetry that makes values equal.

    Raises
    ------
    ValueError
        For planar motions, unknown choices, bodies that differ, a symmetry that the template has
        not, or steps that hold too little.
    TooFewFramesError
        Fewer than 12 steps in all, or fewer than 2 of a motion.

    Warns
    -----
    PrecisionWarning
        If a value lies on its edge, 0; errors are then NaN.

    Notes
    -----
    Steps of length t have covariance 2 D t + O + O' and -O' with the next one, O = s C - 2 B dt D
    with C the covariance of a pose and B the blur (a block tridiagonal likelihood; a gap is one
    longer step). Errors are from the observed information with noise and blur left free.

    Examples
    --------
    >>> from perrin import Cluster, add_noise, simulate_motion, track_rotation
    >>> body = Cluster.from_positions([[0, 0, 0], [3, 0, 0], [0, 2, 0], [0, 0, 1]])
    >>> truth = simulate_motion(body, D_R=[1e-3, 2e-3, 6e-3], dt=1.0, n_frames=1000, rng=1)
    >>> x = add_noise(truth.positions(), sigma=0.02, rng=2)
    >>> print(diffusion_tensor(track_rotation(x, dt=1.0)))
    D_R = 0.00100(8), 0.00208(13), 0.0058(4) rad^2/s [1000 frames, symmetry C_1]
    mean 0.00297(15), isotropic: p < 1e-6, axial: p < 1e-6
    axes known to 3, 3, 2 degrees
    """
    motions = [motion] if isinstance(motion, RigidMotion) else list(motion)
    _check_choices(motions, quantity=quantity, noise=noise, exposure=exposure)
    turns = _alignments(motions)
    symbol, basis = _symmetry(motions[0], symmetry)
    vectors = [_vectors(m, quantity, turn) for m, turn in zip(motions, turns, strict=True)]
    data = _collected(motions, vectors, noise=noise, exposure=exposure)
    free = data.fit(_symmetric_basis(3))
    p_isotropic, p_axial = _tests(data, free)
    best = free if len(basis) == 6 else data.fit(basis, near=free)
    tensor = data.in_units(best.D)
    covariance = data.covariance(best, basis, _ELEMENTS)
    if np.isnan(covariance).any():
        warnings.warn(f"diffusion_tensor: {_NO_ERRORS}", PrecisionWarning, stacklevel=2)
    values, axes = np.linalg.eigh(tensor)
    values = np.maximum(values, 0.0)  # the tensor is a square: below 0 is rounding
    axes = axes * np.sign(np.linalg.det(axes))
    return DiffusionTensor(
        tensor=tensor,
        principal_values=values,
        axes=axes,
        stderr=np.sqrt([_variance(covariance, a, a) for a in axes.T]),
        p_isotropic=p_isotropic,
        p_axial=p_axial,
        covariance=covariance,
        axis_errors=_axis_errors(values, axes, covariance),
        symmetry=symbol,
        offset=data.mean_noise(best),
        quantity=quantity,
        unit=UNITS[quantity],
        n_frames=sum(m.fitted.size for m in motions),
    )


def coupled_tensor(
    motion: RigidMotion, *, point: Literal["diffusion", "centroid"] | ArrayLike = "diffusion"
) -> CoupledTensor:
    """Estimate the 6 x 6 tensor of translation, rotation and their coupling in body axes.

    Parameters
    ----------
    motion : RigidMotion
        In three dimensions.
    point : {"diffusion", "centroid"} or array_like, shape (3,)
        Whose translation: the centre of diffusion (where the coupling is symmetric), the centre
        of the template, or a point of the body in template axes, um.

    Returns
    -------
    CoupledTensor

    Raises
    ------
    ValueError
        For planar motions, an unknown point, or steps that hold too little.
    TooFewFramesError
        Fewer than 50 steps.

    Warns
    -----
    PrecisionWarning
        If a value lies on its edge, 0; errors are then NaN.

    Notes
    -----
    The steps are the SE(3) logarithms of g_k^-1 g_{k+1}, in the likelihood of `diffusion_tensor`
    with noise of its own for centre and orientation (uncorrelated, as they are at the centroid for
    localisation errors alike in all axes and all particles seen) and blur unknown. From the
    centroid to a point r of the body, with the coupling C of row translation and column rotation
    and [r] u = r x u:
    D_R' = D_R, C' = C - [r] D_R, D_T' = D_T - [r] C^T + C [r] - [r] D_R [r]. The coupling is
    symmetric at the r that solves (tr(D_R) - D_R) r = v, where C - C^T = [v].

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(
    ...     Cluster.tetrahedron(1.5), D_R=5e-3, D_T=0.04, dt=0.7, n_frames=2000, rng=1
    ... )
    >>> coupled = coupled_tensor(truth, point="centroid")
    >>> bool(abs(coupled.D_C / coupled.stderr[:3, 3:]).max() < 4)
    True
    """
    _check_choices([motion], quantity="rotation", noise="joint", exposure=None, needed=50)
    place = _place(point)
    data = _collected([motion], [_screws(motion)], noise="joint", exposure=None)
    basis = _symmetric_basis(6)
    best = data.fit(basis)
    elements = [(i, j) for i in range(6) for j in range(i + 1)]
    tensor, covariance = data.in_units(best.D), data.covariance(best, basis, elements)
    if np.isnan(covariance).any():
        warnings.warn(f"coupled_tensor: {_NO_ERRORS}", PrecisionWarning, stacklevel=2)
    where = diffusion_center(tensor) if place is None else place
    return CoupledTensor(
        tensor=shifted(tensor, where),
        stderr=_shifted_errors(tensor, covariance, place),
        point=where,
        n_frames=int(motion.fitted.size),
    )


def axes_like(axes: Floats, reference: Floats) -> Ints:
    """Return the order of the columns of `axes` in which each lies nearest to the reference's.

    Axes sorted by their own values are named by it as those of another tensor of the same body:
    "axis 1" is then the same axis of the body.

    Parameters
    ----------
    axes, reference : ndarray, shape (3, 3)
        Unit axes as columns; their signs do not matter.

    Examples
    --------
    >>> axes_like(np.eye(3)[:, [2, 0, 1]], np.eye(3))
    array([1, 2, 0])
    """
    overlap = (reference.T @ axes) ** 2
    orders = list(permutations(range(3)))
    best = max(orders, key=lambda order: float(overlap[range(3), order].sum()))
    return np.array(best, dtype=np.int64)


def _check_choices(
    motions: Sequence[RigidMotion],
    *,
    quantity: str,
    noise: str | float,
    exposure: float | None,
    needed: int = 12,
) -> None:
    """Refuse what is not offered, all faults at once, and motions that are too short."""
    faults = choice_faults(quantity=quantity, noise=noise, exposure=exposure)
    if not motions or any(m.template.shape[1] != 3 for m in motions):
        faults.append(
            "motion: expected one or more motions in three dimensions; in the plane there is one "
            "angle and no tensor, see estimate_diffusion"
        )
    if faults:
        raise ValueError("; ".join(faults))
    counts = [len(m.steps()[0]) for m in motions]
    if sum(counts) < needed or min(counts) < 2:
        raise TooFewFramesError(
            f"{sum(counts)} steps between poses, {min(counts)} in the shortest motion: a tensor "
            f"needs {needed} in all and 2 of every motion",
            sum(m.fitted.size for m in motions),
        )


def _place(point: Literal["diffusion", "centroid"] | ArrayLike) -> Floats | None:
    """Return the point asked for in body axes; None for the centre of diffusion."""
    if isinstance(point, str) and point in ("diffusion", "centroid"):
        return None if point == "diffusion" else np.zeros(3)
    place = np.array(point, dtype=np.float64) if not isinstance(point, str) else np.empty(0)
    if place.shape != (3,) or not np.isfinite(place).all():
        raise ValueError(
            f"point: expected 'diffusion', 'centroid' or 3 numbers (body axes, um), got {point!r}"
        )
    return place


def _alignments(motions: Sequence[RigidMotion]) -> list[Floats]:
    """Return the rotations that turn the templates onto the first; refuse bodies that differ."""
    first = motions[0]
    turns = []
    for number, m in enumerate(motions):
        if m.template.shape != first.template.shape:
            raise ValueError(
                f"motion {number} has {len(m.template)} particles and the first "
                f"{len(first.template)}: a common tensor needs like bodies"
            )
        turn = kabsch(first.template, m.template) if number else np.eye(3)
        apart = first.template - m.template @ turn.T
        rms = float(np.sqrt((apart * apart).sum(axis=1).mean()))
        allowed = 3 * max(first.sigma, m.sigma) + 1e-6 * first.R
        if not rms <= allowed:
            raise ValueError(
                f"motion {number}: its particles lie {rms:.3g} um (rms) from those of the first "
                f"body, more than {allowed:.3g} um (3 sigma): another body, or other labels"
            )
        turns.append(turn)
    return turns


def _symmetry(motion: RigidMotion, wanted: str | None) -> tuple[str, Floats]:
    """Return the point group to impose and a basis (m, 3, 3) of the tensors that have it."""
    if wanted == "C_1":
        return "C_1", _symmetric_basis(3)
    tolerance = motion.template_error
    if wanted is None:
        elements = symmetry_elements(motion.template, tolerance)
        return schoenflies(elements), _invariant_basis(elements)
    seen = []
    first, second = np.triu_indices(len(motion.template), 1)
    gap = np.linalg.norm(motion.template[first] - motion.template[second], axis=1).min()
    while tolerance <= 0.3 * gap:
        symbol = point_group(motion.template, tolerance=tolerance)
        if symbol == wanted:
            return symbol, _invariant_basis(symmetry_elements(motion.template, tolerance))
        seen.append(symbol)
        tolerance *= 1.3
    raise ValueError(
        f"symmetry: the template is not {wanted!r} within 0.3 of its closest distance; it is "
        f"{' or '.join(dict.fromkeys(seen)) or 'too noisy to tell'} (C_1 asks for no symmetry)"
    )


def _symmetric_basis(b: int) -> Floats:
    """Return a basis of the symmetric matrices, orthonormal, (b (b + 1) / 2, b, b)."""
    unit = np.eye(b)
    pairs = zip(*np.tril_indices(b), strict=True)
    return np.array(
        [
            (np.outer(unit[i], unit[j]) + np.outer(unit[j], unit[i])) / (2 if i == j else 2**0.5)
            for i, j in pairs
        ]
    )


def _invariant_basis(elements: Floats) -> Floats:
    """Return an orthonormal basis of the symmetric matrices that a point group leaves alone."""
    basis = _symmetric_basis(3)
    mapped = np.einsum("gij,mjk,glk->mil", elements, basis, elements) / len(elements)
    share, mix = np.linalg.eigh(np.einsum("mij,nij->mn", basis, mapped))
    invariant: Floats = np.einsum("mn,mij->nij", mix[:, share > 0.5], basis)
    return invariant


class _Vectors(NamedTuple):
    """Steps (S, b) in body axes and the shapes (r, T, b, b) of the noise of every frame.

    The shapes are for a localisation error of 1 um.
    """

    y: Floats
    shapes: Floats


def _vectors(motion: RigidMotion, quantity: Quantity, turn: Floats) -> _Vectors:
    """Return the steps of a motion and their noise in the axes of the first template."""
    start, stop = motion.steps()
    theta = motion.step_vectors()[stop - 1]
    if quantity == "rotation":
        shape = turn @ unit_covariance(motion) @ turn.T
        return _Vectors(theta @ turn.T, shape[None])
    middle = motion.rotation[start] @ exp_map(0.5 * theta)
    jump = np.einsum("sji,sj->si", middle, motion.center[stop] - motion.center[start])
    return _Vectors(jump @ turn.T, _center_shape(motion)[None])


def _center_shape(motion: RigidMotion) -> Floats:
    """Return the covariance of every centre for a localisation error of 1 um, (T, 3, 3)."""
    return np.asarray(unit_center_variance(motion)[:, None, None] * np.eye(3))


def _screws(motion: RigidMotion) -> _Vectors:
    """Return SE(3) logarithms, translation first, and the noise of centre and orientation.

    The translation is V^-1 R_k^T (x_{k+1} - x_k) with
    V^-1 = 1 - [w]/2 + (1 - (a/2) cot(a/2)) [w]^2/a^2 for the rotation vector w of angle a.
    """
    start, stop = motion.steps()
    w = motion.step_vectors()[stop - 1]
    jump = np.einsum(
        "sji,sj->si", motion.rotation[start], motion.center[stop] - motion.center[start]
    )
    half = 0.5 * np.linalg.norm(w, axis=1)
    # (1 - h cot h) / (2h)^2 -> 1/12 (1 + h^2/15) at small h, where the quotient loses its digits.
    small = half < 1e-3
    h = np.where(small, 1.0, half)
    factor = np.where(small, (1 + half**2 / 15) / 12, (1 - h / np.tan(h)) / (4 * h * h))
    once = np.cross(w, jump)
    u = jump - 0.5 * once + factor[:, None] * np.cross(w, once)
    shapes = np.zeros((2, len(motion.time), 6, 6))
    shapes[0, :, :3, :3] = _center_shape(motion)
    shapes[1, :, 3:, 3:] = unit_covariance(motion)
    return _Vectors(np.concatenate([u, w], axis=1), shapes)


@dataclass(frozen=True, eq=False)
class _Data:
    """Steps of all motions in units of their own size, so that all numbers are of order 1.

    Attributes
    ----------
    sources : list of Source
    scale : ndarray, shape (b,)
        Unit of each component of a step.
    time : float
        Unit of time, s.
    """

    sources: list[Source]
    scale: Floats
    time: float

    def fit(self, basis: Floats, near: Maximum | None = None) -> Maximum:
        """Return the best tensor >= 0 in the span of a basis."""
        D = self._first_guess() if near is None else near.D
        own = np.array([s.start() for s in self.sources]) if near is None else near.own
        values, axes = np.linalg.eigh(D)
        root = (axes * np.sqrt(np.maximum(values, 1e-3 * values[-1]))) @ axes.T
        q = np.einsum("mij,ij->m", basis, root)
        return maximise(self.sources, squares(basis), q, own)

    def fit_axial(self, near: Maximum) -> Maximum:
        """Return the best tensor with two values equal, about any axis."""
        values, axes = np.linalg.eigh(near.D)
        values = np.maximum(values, 1e-3 * values[-1])
        found = []
        for k, others in ((0, [1, 2]), (2, [0, 1])):
            q = np.array([values[others].mean(), values[k], 0.0, 0.0]) ** [0.5, 0.5, 1, 1]
            found.append(maximise(self.sources, axial(axes[:, k]), q, near.own))
        return max(found, key=lambda m: m.value)

    def _first_guess(self) -> Floats:
        """Return D from the covariance of steps and of neighbours, kept positive."""
        duration = sum(float(s.steps.tau.sum()) for s in self.sources)
        now = np.sum([s.steps.y.T @ s.steps.y for s in self.sources], axis=0) / duration
        beside = np.sum([_neighbours(s.steps) for s in self.sources], axis=0) / duration
        values, axes = np.linalg.eigh(0.5 * now + beside)
        floor = 0.05 * np.trace(now) / len(now)
        guess: Floats = (axes * np.maximum(values, floor)) @ axes.T
        return guess

    def in_units(self, D: Floats) -> Floats:
        """Return a tensor in um, rad and s."""
        out: Floats = D * np.outer(self.scale, self.scale) / self.time
        return out

    def covariance(
        self, best: Maximum, basis: Floats, elements: Sequence[tuple[int, int]]
    ) -> Floats:
        """Return the covariance of elements of D in um, rad and s; NaN where it is not known."""
        directions, errors = spread(self.sources, best, basis)
        slopes = np.array([[self.in_units(e)[i, j] for e in directions] for i, j in elements])
        covariance: Floats = slopes @ errors @ slopes.T
        return covariance

    def mean_noise(self, best: Maximum) -> Floats:
        """Return the noise of one frame less blur in um and rad, mean over motions."""
        pairs = zip(self.sources, best.own, strict=True)
        noise = np.mean([s.noise(best.D, own) for s, own in pairs], axis=0)
        out: Floats = noise * np.outer(self.scale, self.scale)
        return out


def _neighbours(steps: VectorSteps) -> Floats:
    """Return the summed products of neighbouring steps, symmetric."""
    product = (steps.y[:-1] * steps.linked[:-1, None]).T @ steps.y[1:]
    return 0.5 * (product + product.T)


def _collected(
    motions: Sequence[RigidMotion],
    vectors: Sequence[_Vectors],
    *,
    noise: str | float,
    exposure: float | None,
) -> _Data:
    """Bring the steps of all motions to their own units, and say what is known of their noise."""
    y = np.concatenate([v.y for v in vectors])
    scale = _scale(y)
    time = float(np.mean([m.dt for m in motions]))
    unknown = exposure is None and noise == "joint"
    B = None if unknown else (exposure or 0.0) / 6
    sources = []
    for m, v in zip(motions, vectors, strict=True):
        shapes = v.shapes / np.outer(scale, scale)
        # An amplitude of 1 is then noise as large as a step, in the three components it has.
        size = np.nanmean(np.trace(shapes, axis1=2, axis2=3), axis=1) / 3
        start, stop = m.steps()
        shapes = shapes / size[:, None, None, None]
        steps = VectorSteps(
            y=v.y / scale,
            tau=(m.time[stop] - m.time[start]) / time,
            begin=shapes[:, start],
            end=shapes[:, stop],
            linked=np.append(start[1:] == stop[:-1], False),
            dt=m.dt / time,
        )
        theta, weight = _known_noise(m, steps, noise=noise, size=size)
        sources.append(Source(steps, theta, weight, B))
    if len({np.isinf(source.weight) for source in sources}) > 1:
        raise ValueError(
            "noise='residual': some motions show no noise at all (simulated truth) and others do; "
            "pool them apart"
        )
    return _Data(sources, scale, time)


def _scale(y: Floats) -> Floats:
    """Return the root mean square component of each triple of a step."""
    triple = np.sqrt((y.reshape(len(y), -1, 3) ** 2).mean(axis=(0, 2)))
    if not triple.all():
        raise ValueError("the body does not move at all: there is no tensor to estimate")
    return np.repeat(triple, 3)


def _known_noise(
    motion: RigidMotion, steps: VectorSteps, *, noise: str | float, size: Floats
) -> tuple[Floats, float]:
    """Return the noise amplitudes and the degrees of freedom that they are known with."""
    if noise == "joint":
        # The neighbours' covariance is minus the noise; a little more keeps the start inside.
        square = -np.trace(_neighbours(steps)) / max(steps.linked.sum(), 1)
        square = square / steps.y.shape[1]
        return np.full(len(size), max(float(square), 0.0) + 0.05), 0.0
    if noise == "residual":
        theta = motion.sigma**2 * size
        return theta, float(residual_freedom(motion)) if theta.min() > _NOISELESS else np.inf
    return float(noise) ** 2 * size, np.inf


def _tests(data: _Data, free: Maximum) -> tuple[float, float]:
    """Return the p-values of isotropy and of axial symmetry from likelihood ratios."""
    from scipy.special import chdtrc

    def p_value(restricted: Maximum, freedom: int) -> float:
        return float(chdtrc(freedom, max(2 * (free.value - restricted.value), 0.0)))

    isotropic = data.fit(np.eye(3)[None] / 3**0.5, near=free)
    return p_value(isotropic, 5), p_value(data.fit_axial(free), 2)


def _variance(covariance: Floats, a: Floats, b: Floats) -> float:
    """Return the variance of a.D.b from the covariance of the elements of D."""
    weight = np.array([a[i] * b[j] + (a[j] * b[i] if i != j else 0.0) for i, j in _ELEMENTS])
    return float(weight @ covariance @ weight)


def _axis_errors(values: Floats, axes: Floats, covariance: Floats) -> Floats:
    """Return by how many degrees one standard error of D_ab turns axes a and b.

    The angle is half the one whose tangent is 2 D_ab/(D_a - D_b).
    """
    errors = np.zeros((3, 3))
    rounding = 1e-9 * values[2]
    for a, b in ((0, 1), (0, 2), (1, 2)):
        variance = _variance(covariance, axes[:, a], axes[:, b])
        apart = values[b] - values[a]
        off = np.sqrt(variance) if not variance < rounding**2 else 0.0
        angle = _EQUAL if apart <= rounding else np.degrees(0.5 * np.arctan2(2 * off, apart))
        errors[a, b] = errors[b, a] = angle
    return errors


def _shifted_errors(tensor: Floats, covariance: Floats, place: Floats | None) -> Floats:
    """Return the standard errors (6, 6) after the move, by central differences in the elements."""
    lower = np.tril_indices(6)
    sd = np.sqrt(np.diag(covariance))

    def moved(element: int, change: float) -> Floats:
        other = tensor.copy()
        i, j = lower[0][element], lower[1][element]
        other[i, j] += change
        other[j, i] = other[i, j]
        return shifted(other, diffusion_center(other) if place is None else place)

    slopes = np.array([(moved(k, h) - moved(k, -h)) / (2 * h) for k, h in enumerate(1e-3 * sd)])
    variance = np.einsum("kab,kl,lab->ab", slopes, covariance, slopes)
    errors: Floats = np.sqrt(np.maximum(variance, 0.0))
    return errors
