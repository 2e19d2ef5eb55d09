"""Diffusion tensors of rotation, of translation, and of both with their coupling, in body axes."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from itertools import permutations
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from perrin._arrays import choice_fault, refuse
from perrin.diffusion.estimate import UNITS
from perrin.diffusion.noise_model import Noise, noise_faults
from perrin.diffusion.steps import Quantity, body_steps
from perrin.diffusion.tensor_likelihood import (
    Maximum,
    NoisyVectors,
    axial,
    maximise,
    spread,
    squares,
)
from perrin.diffusion.tensor_results import (
    EQUAL_AXES_ERROR,
    NO_ERRORS,
    SYMMETRIC_ELEMENTS,
    CoupledTensor,
    DiffusionTensor,
)
from perrin.errors import PrecisionWarning, TooFewFramesError
from perrin.geometry.rigid import diffusion_center, shifted
from perrin.geometry.rotations import kabsch
from perrin.geometry.shapes import pair_distances
from perrin.geometry.symmetry import point_group, schoenflies, symmetry_elements
from perrin.motion.rigid_motion import RigidMotion

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike

    from perrin._arrays import Floats, Ints
    from perrin.diffusion.steps import Steps

# Noise below this variance, relative to a step's, is rounding: that of simulated truth.
_NOISELESS = 1e-8


def diffusion_tensor(
    motion: RigidMotion | Sequence[RigidMotion],
    *,
    quantity: Quantity = "rotation",
    noise: Literal["joint", "residual"] | float | Noise = "joint",
    exposure: float | None = None,
    symmetry: str | None = None,
) -> DiffusionTensor:
    """Estimate the 3 x 3 tensor of rotation or translation in body axes by maximum likelihood.

    Parameters
    ----------
    motion : RigidMotion or sequence of RigidMotion
        Motion in three dimensions. Several motions of like bodies, with their particles in the same
        order, are pooled: they share one tensor, and each has its own noise. Their templates are
        turned onto the first.
    quantity : {"rotation", "translation"}
        Tensor of rotation, from body-frame rotation vectors, or of translation, from the centre's
        displacements in the axes that the body has half way through each step; a drift of the
        sample is not subtracted.
    noise : {"joint", "residual"}, float or Noise
        "joint": the noise is predicted from the template but for one amplitude, which is estimated
        along with D. "residual": that amplitude is measured by the residuals of the rigid fit
        (right only if all particles of a frame are recorded at the same instant). A number: the
        localisation error of one coordinate, um. A `Noise` holds the exposure as well.
    exposure : float, optional
        Open fraction of dt, 0 to 1: motion blur is exposure/6. Unknown (None) leaves the blur of
        the joint fit free, between none and the largest possible; with the noise given it is taken
        as 0.
    symmetry : str, optional
        Schoenflies symbol of the point group that the tensor shares. Default: that of the template
        within its error. "C_1" gives the tensor no symmetry. Another symbol is searched for with
        growing tolerance, as real clusters of unequal spheres need.

    Returns
    -------
    DiffusionTensor
        The p-values are those of the fit without symmetry: they also test whether the data agree
        with a symmetry that makes values equal.

    Raises
    ------
    ValueError
        For planar motions, unknown choices, bodies that differ, a symmetry that the template has
        not, or steps without enough information.
    TooFewFramesError
        If there are fewer than 12 steps in all, or fewer than 2 of a motion.

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
    faults = [*choice_fault("quantity", quantity, get_args(Quantity))]
    faults += noise_faults(noise, exposure)
    if isinstance(noise, Noise) and noise.drift:
        faults.append("noise: a drift is not subtracted from a tensor; leave drift out of it")
    _refuse_motions(motions, faults, needed=12)
    turns = template_alignments(motions)
    symbol, basis = imposed_symmetry(motions[0], symmetry)
    steps = [body_steps(m, quantity, turn) for m, turn in zip(motions, turns, strict=True)]
    data = ScaledTracks.of(steps, Noise.of(noise, exposure=exposure))
    free = data.fit(symmetric_basis(3))
    isotropic = data.fit(np.eye(3)[None] / 3**0.5, near=free)
    p_isotropic, p_axial = data.p_values(free, isotropic)
    known = {6: free, 1: isotropic}  # by the number of tensors that span what the symmetry allows
    best = known[len(basis)] if len(basis) in known else data.fit(basis, near=free)
    tensor = data.in_units(best.D)
    covariance = data.covariance(best, basis, SYMMETRIC_ELEMENTS)
    if np.isnan(covariance).any():
        warnings.warn(f"diffusion_tensor: {NO_ERRORS}", PrecisionWarning, stacklevel=2)
    values, axes = np.linalg.eigh(tensor)
    values = np.maximum(values, 0.0)  # the tensor is a square: below 0 is rounding
    axes = axes * np.sign(np.linalg.det(axes))
    return DiffusionTensor(
        tensor=tensor,
        principal_values=values,
        axes=axes,
        stderr=np.sqrt([element_variance(covariance, a, a) for a in axes.T]),
        p_isotropic=p_isotropic,
        p_axial=p_axial,
        covariance=covariance,
        axis_errors=axis_errors(values, axes, covariance),
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
        Motion in three dimensions.
    point : {"diffusion", "centroid"} or array_like, shape (3,)
        Point whose translation is described: the centre of diffusion (where the coupling is
        symmetric), the centre of the template, or a point of the body in template axes, um.

    Returns
    -------
    CoupledTensor

    Raises
    ------
    ValueError
        For planar motions, an unknown point, or steps without enough information.
    TooFewFramesError
        If there are fewer than 50 steps.

    Warns
    -----
    PrecisionWarning
        If a value lies on its edge, 0; errors are then NaN.

    Notes
    -----
    The steps are the SE(3) logarithms of g_k^-1 g_{k+1}, in the likelihood of `diffusion_tensor`
    with noise of its own for centre and orientation (uncorrelated, as they are at the centroid for
    equal localisation errors along all axes and all particles present) and blur unknown. From the
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
    _refuse_motions([motion], [], needed=50)
    named = isinstance(point, str) and point in ("diffusion", "centroid")
    place = np.zeros(3) if named else np.array([] if isinstance(point, str) else point, dtype=float)
    if place.shape != (3,) or not np.isfinite(place).all():
        raise ValueError(
            f"point: expected 'diffusion', 'centroid' or 3 numbers (body axes, um), got {point!r}"
        )
    at_center = isinstance(point, str) and point == "diffusion"
    data = ScaledTracks.of([body_steps(motion, "both", np.eye(3))], Noise())
    basis = symmetric_basis(6)
    best = data.fit(basis)
    elements = [(i, j) for i in range(6) for j in range(i + 1)]
    tensor, covariance = data.in_units(best.D), data.covariance(best, basis, elements)
    if np.isnan(covariance).any():
        warnings.warn(f"coupled_tensor: {NO_ERRORS}", PrecisionWarning, stacklevel=2)

    def moved(tensor: Floats) -> Floats:
        return shifted(tensor, diffusion_center(tensor) if at_center else place)

    # Standard errors after the move, by central differences in the elements.
    rows, columns = np.tril_indices(6)
    slopes = []
    for i, j, h in zip(rows, columns, 1e-3 * np.sqrt(np.diag(covariance)), strict=True):
        change = np.zeros((6, 6))
        change[i, j] = change[j, i] = h
        slopes.append((moved(tensor + change) - moved(tensor - change)) / (2 * h))
    variance = np.einsum("kab,kl,lab->ab", slopes, covariance, slopes)
    where = diffusion_center(tensor) if at_center else place
    return CoupledTensor(
        tensor=shifted(tensor, where),
        stderr=np.sqrt(np.maximum(variance, 0.0)),
        point=where,
        n_frames=int(motion.fitted.size),
    )


def axes_like(axes: Floats, reference: Floats) -> Ints:
    """Return the order of the columns of `axes` in which each is nearest to the reference's.

    It numbers axes that are sorted by their own values like those of another tensor of the same
    body: "axis 1" is then the same axis of the body.

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


def _refuse_motions(motions: Sequence[RigidMotion], faults: list[str], *, needed: int) -> None:
    """Refuse planar motions and other faults, all at once, and motions with too few steps."""
    if not motions or any(m.dimension != 3 for m in motions):
        faults.append(
            "motion: expected one or more motions in three dimensions; in the plane there is one "
            "angle and no tensor; use estimate_diffusion"
        )
    refuse(faults)
    counts = [len(m.steps()[0]) for m in motions]
    if sum(counts) < needed or min(counts) < 2:
        raise TooFewFramesError(
            f"{sum(counts)} steps between poses, {min(counts)} in the shortest motion: a tensor "
            f"needs {needed} in all and 2 of every motion",
            sum(m.fitted.size for m in motions),
        )


def template_alignments(motions: Sequence[RigidMotion]) -> list[Floats]:
    """Return the rotations that turn the templates onto the first; refuse bodies that differ.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=3)
    >>> len(template_alignments([truth, truth]))
    2
    """
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


def imposed_symmetry(motion: RigidMotion, wanted: str | None) -> tuple[str, Floats]:
    """Return the point group to impose and a basis (m, 3, 3) of the tensors that have it.

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=3)
    >>> symbol, basis = imposed_symmetry(truth, None)
    >>> symbol, len(basis)
    ('T_d', 1)
    """
    if wanted == "C_1":
        return "C_1", symmetric_basis(3)
    tolerance = motion.template_error
    elements = motion.symmetry_elements
    if wanted is None and elements is not None:
        return schoenflies(elements), invariant_basis(elements)
    seen = []
    gap = pair_distances(motion.template).min()
    while tolerance <= 0.3 * gap:
        symbol = point_group(motion.template, tolerance=tolerance)
        if symbol == wanted:
            return symbol, invariant_basis(symmetry_elements(motion.template, tolerance))
        seen.append(symbol)
        tolerance *= 1.3
    raise ValueError(
        f"symmetry: the template is not {wanted!r} within 0.3 of its closest distance; it is "
        f"{' or '.join(dict.fromkeys(seen)) or 'too noisy to decide'} (C_1 imposes no symmetry)"
    )


def symmetric_basis(b: int) -> Floats:
    """Return a basis of the symmetric matrices, orthonormal, (b (b + 1) / 2, b, b).

    Examples
    --------
    >>> basis = symmetric_basis(3)
    >>> bool(np.allclose(np.einsum("mij,nij->mn", basis, basis), np.eye(6)))
    True
    """
    unit = np.eye(b)
    pairs = zip(*np.tril_indices(b), strict=True)
    return np.array(
        [
            (np.outer(unit[i], unit[j]) + np.outer(unit[j], unit[i])) / (2 if i == j else 2**0.5)
            for i, j in pairs
        ]
    )


def invariant_basis(elements: Floats) -> Floats:
    """Return an orthonormal basis of the symmetric matrices that are invariant under a point group.

    Examples
    --------
    >>> len(invariant_basis(np.array([np.eye(3), np.diag([-1.0, -1.0, 1.0])])))
    4
    """
    basis = symmetric_basis(3)
    mapped = np.einsum("gij,mjk,glk->mil", elements, basis, elements) / len(elements)
    share, mix = np.linalg.eigh(np.einsum("mij,nij->mn", basis, mapped))
    invariant: Floats = np.einsum("mn,mij->nij", mix[:, share > 0.5], basis)
    return invariant


@dataclass(frozen=True, eq=False)
class ScaledTracks:
    """Steps of several motions in units of their own size, so that all numbers are of order 1.

    Attributes
    ----------
    tracks : list of NoisyVectors
        Steps of every motion and what is known of their noise.
    scale : ndarray, shape (b,)
        Unit of each component of a step: a length, um, or an angle, rad.
    time : float
        Unit of time, s.
    """

    tracks: list[NoisyVectors]
    scale: Floats
    time: float

    @classmethod
    def of(cls, steps: Sequence[Steps], noise: Noise) -> ScaledTracks:
        """Scale the steps of every motion by their common size, and add what is known of the noise.

        The unit of a component is the root mean square of its triple, and an amplitude of 1 is
        noise as large as a step.
        """
        vectors = np.concatenate([s.vectors for s in steps])
        triple = np.sqrt((vectors.reshape(len(vectors), -1, 3) ** 2).mean(axis=(0, 2)))
        if not triple.all():
            raise ValueError("the body does not move at all: there is no tensor to estimate")
        scale = np.repeat(triple, 3)
        time = float(np.mean([s.dt for s in steps]))
        unknown = noise.exposure is None and noise.model == "joint"
        B = None if unknown else (noise.exposure or 0.0) / 6
        tracks = []
        for one in steps:
            shapes = one.noise / np.outer(scale, scale)
            size = np.nanmean(np.trace(shapes, axis1=2, axis2=3), axis=1) / 3
            scaled = replace(
                one,
                vectors=one.vectors / scale,
                duration=one.duration / time,
                noise=shapes / size[:, None, None, None],
                dt=one.dt / time,
            )
            if noise.model == "joint":
                # Neighbours' covariance is minus the noise; a little more keeps the start inside.
                square = -np.trace(neighbour_products(scaled)) / max(scaled.linked.sum(), 1)
                square = square / scaled.vectors.shape[1]
                theta, freedom = np.full(len(size), max(float(square), 0.0) + 0.05), 0.0
            elif noise.model == "residual":
                theta = one.sigma**2 * size
                freedom = float(one.freedom) if theta.min() > _NOISELESS else np.inf
            else:
                theta, freedom = float(noise.model) ** 2 * size, np.inf
            tracks.append(NoisyVectors(scaled, theta, freedom, B))
        if len({np.isinf(track.freedom) for track in tracks}) > 1:
            raise ValueError(
                "noise='residual': some motions show no noise at all (simulated truth) and others "
                "do; pool these two kinds separately"
            )
        return cls(tracks, scale, time)

    def fit(self, basis: Floats, near: Maximum | None = None) -> Maximum:
        """Return the best tensor >= 0 in the span of a basis.

        Without a maximum to start from, D comes from the covariance of steps and of neighbours,
        kept positive.
        """
        if near is None:
            duration = sum(float(t.steps.duration.sum()) for t in self.tracks)
            products = [t.steps.vectors.T @ t.steps.vectors for t in self.tracks]
            now = np.sum(products, axis=0) / duration
            neighbour = (
                np.sum([neighbour_products(t.steps) for t in self.tracks], axis=0) / duration
            )
            values, axes = np.linalg.eigh(0.5 * now + neighbour)
            D = (axes * np.maximum(values, 0.05 * np.trace(now) / len(now))) @ axes.T
            own = np.array([t.start() for t in self.tracks])
        else:
            D, own = near.D, near.own
        values, axes = np.linalg.eigh(D)
        root = (axes * np.sqrt(np.maximum(values, 1e-3 * values[-1]))) @ axes.T
        q = np.einsum("mij,ij->m", basis, root)
        return maximise(self.tracks, squares(basis), q, own)

    def fit_axial(self, near: Maximum) -> Maximum:
        """Return the best tensor with two values equal, about any axis."""
        values, axes = np.linalg.eigh(near.D)
        values = np.maximum(values, 1e-3 * values[-1])
        found = []
        for k, others in ((0, [1, 2]), (2, [0, 1])):
            q = np.array([values[others].mean(), values[k], 0.0, 0.0]) ** [0.5, 0.5, 1, 1]
            found.append(maximise(self.tracks, axial(axes[:, k]), q, near.own))
        return max(found, key=lambda m: m.value)

    def p_values(self, free: Maximum, isotropic: Maximum) -> tuple[float, float]:
        """Return the p-values of isotropy and of axial symmetry from likelihood ratios."""
        from scipy.special import chdtrc

        p_isotropic, p_axial = (
            float(chdtrc(freedom, max(2 * (free.value - restricted.value), 0.0)))
            for freedom, restricted in ((5, isotropic), (2, self.fit_axial(free)))
        )
        return p_isotropic, p_axial

    def in_units(self, D: Floats) -> Floats:
        """Return a tensor in um, rad and s."""
        out: Floats = D * np.outer(self.scale, self.scale) / self.time
        return out

    def covariance(
        self, best: Maximum, basis: Floats, elements: Sequence[tuple[int, int]]
    ) -> Floats:
        """Return the covariance of elements of D in um, rad and s; NaN where it is not known."""
        directions, errors = spread(self.tracks, best, basis)
        slopes = np.array([[self.in_units(e)[i, j] for e in directions] for i, j in elements])
        covariance: Floats = slopes @ errors @ slopes.T
        return covariance

    def mean_noise(self, best: Maximum) -> Floats:
        """Return the noise of one frame less blur in um and rad, mean over motions."""
        pairs = zip(self.tracks, best.own, strict=True)
        noise = np.mean([t.noise(best.D, own) for t, own in pairs], axis=0)
        out: Floats = noise * np.outer(self.scale, self.scale)
        return out


def neighbour_products(steps: Steps) -> Floats:
    """Return the summed products of neighbouring steps that share a frame, symmetric, (b, b).

    Examples
    --------
    >>> from perrin import Cluster, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=30, rng=3)
    >>> neighbour_products(body_steps(truth, "rotation", np.eye(3))).shape
    (3, 3)
    """
    product = (steps.vectors[:-1] * steps.linked[:-1, None]).T @ steps.vectors[1:]
    return np.asarray(0.5 * (product + product.T))


def element_variance(covariance: Floats, a: Floats, b: Floats) -> float:
    """Return the variance of a.D.b from the covariance of the elements of D.

    Examples
    --------
    >>> element_variance(np.diag([1.0, 2, 3, 4, 5, 6]), np.eye(3)[0], np.eye(3)[1])
    4.0
    """
    weight = np.array(
        [a[i] * b[j] + (a[j] * b[i] if i != j else 0.0) for i, j in SYMMETRIC_ELEMENTS]
    )
    return float(weight @ covariance @ weight)


def axis_errors(values: Floats, axes: Floats, covariance: Floats) -> Floats:
    """Return the angle, in degrees, by which one standard error of D_ab turns axes a and b.

    The angle is half the one whose tangent is 2 D_ab/(D_a - D_b).

    Examples
    --------
    >>> axis_errors(np.array([1.0, 2, 4]), np.eye(3), 0.01 * np.eye(6)).round(1)
    array([[0. , 5.7, 1.9],
           [5.7, 0. , 2.9],
           [1.9, 2.9, 0. ]])
    """
    errors = np.zeros((3, 3))
    rounding = 1e-9 * values[2]
    for a, b in ((0, 1), (0, 2), (1, 2)):
        variance = element_variance(covariance, axes[:, a], axes[:, b])
        apart = values[b] - values[a]
        off = np.sqrt(variance) if not variance < rounding**2 else 0.0
        angle = (
            EQUAL_AXES_ERROR if apart <= rounding else np.degrees(0.5 * np.arctan2(2 * off, apart))
        )
        errors[a, b] = errors[b, a] = angle
    return errors
