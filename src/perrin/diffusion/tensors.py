"""Diffusion tensors of rotation, of translation, and of both with their coupling, in body axes."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from functools import cache
from itertools import permutations
from typing import TYPE_CHECKING, Literal, NamedTuple, get_args

import numpy as np

from perrin._arrays import choice_fault, frozen, refuse
from perrin.diffusion.effective_modes import WINDOW
from perrin.diffusion.estimate import UNITS
from perrin.diffusion.noise_model import Noise, noise_faults
from perrin.diffusion.steps import Quantity, body_steps, groups_alike
from perrin.diffusion.tensor_batches import (
    SeparateTensors,
    batch_key,
    maximise_each,
    spread_each,
)
from perrin.diffusion.tensor_likelihood import (
    Maximum,
    NoisyVectors,
    axial,
    maximise,
    spread,
    squares,
)
from perrin.diffusion.tensor_modes import FewModesTrack
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
from perrin.geometry.symmetry import point_group, symmetry_elements
from perrin.motion.rigid_motion import RigidMotion

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike

    from perrin._arrays import Floats, Ints
    from perrin.diffusion.steps import Steps

# Noise below this variance, relative to a step's, is rounding: that of simulated truth.
_NOISELESS = 1e-8

# About this many step components are evaluated at once: more gain no time, and take memory.
_MOST_TENSORS_AT_ONCE = 200_000

# Beyond this log ratio of noise to motion one of the two is as good as none.
_FARTHEST = 20.0

_ISOTROPIC = np.eye(3)[None] / 3**0.5


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
    settings = Noise.of(noise, exposure=exposure)
    data, symbol, basis = _prepared(motions, quantity, settings, symmetry)
    fit = tensor_fits([data], [basis])[0]
    if isinstance(fit, ValueError):
        raise fit
    tensor = _tensor_of(fit, data, motions, quantity, symbol)
    if np.isnan(tensor.covariance).any():
        warnings.warn(f"diffusion_tensor: {NO_ERRORS}", PrecisionWarning, stacklevel=2)
    return tensor


def tensor_of_each(
    motions: Sequence[RigidMotion], *, quantity: Quantity = "rotation", noise: Noise
) -> list[DiffusionTensor | ValueError]:
    """Estimate a tensor of its own for each motion, as `diffusion_tensor`, all of them together.

    Parameters
    ----------
    motions : sequence of RigidMotion
    quantity : {"rotation", "translation"}
    noise : Noise

    Returns
    -------
    list of DiffusionTensor or ValueError
        The error that `diffusion_tensor` raises, where there is no tensor.

    Examples
    --------
    >>> from perrin import Cluster, Noise, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=3)
    >>> [str(one)[:10] for one in tensor_of_each([truth, truth], noise=Noise())]
    ['D_R = 0.00', 'D_R = 0.00']
    """
    found: list[DiffusionTensor | ValueError] = []
    prepared = []
    for one in motions:
        try:
            _refuse_motions([one], [], needed=12)
            prepared.append((len(found), *_prepared([one], quantity, noise, None)))
            found.append(ValueError("no tensor"))
        except ValueError as error:
            found.append(error)
    fits = tensor_fits([data for _, data, _, _ in prepared], [basis for *_, basis in prepared])
    for (i, data, symbol, _), fit in zip(prepared, fits, strict=True):
        if isinstance(fit, ValueError):
            found[i] = fit
        else:
            found[i] = _tensor_of(fit, data, [motions[i]], quantity, symbol)
    return found


def _prepared(
    motions: Sequence[RigidMotion], quantity: Quantity, noise: Noise, symmetry: str | None
) -> tuple[ScaledTracks, str, Floats]:
    """Return the scaled steps, the point group to impose and a basis of the tensors that have it.

    The motions share one tensor.
    """
    turns = template_alignments(motions)
    symbol, basis = imposed_symmetry(motions[0], symmetry)
    steps = [body_steps(m, quantity, turn) for m, turn in zip(motions, turns, strict=True)]
    return ScaledTracks.of(steps, noise), symbol, basis


def _tensor_of(
    fit: TensorFit,
    data: ScaledTracks,
    motions: Sequence[RigidMotion],
    quantity: Quantity,
    symbol: str,
) -> DiffusionTensor:
    """Return the tensor of some motions in um, rad and s, with its axes and errors."""
    tensor = data.in_units(fit.best.D)
    values, axes = np.linalg.eigh(tensor)
    values = np.maximum(values, 0.0)  # the tensor is a square: below 0 is rounding
    axes = axes * np.sign(np.linalg.det(axes))
    return DiffusionTensor(
        tensor=tensor,
        principal_values=values,
        axes=axes,
        stderr=np.sqrt(element_variances(fit.covariance, axes).diagonal()),
        p_isotropic=fit.p_isotropic,
        p_axial=fit.p_axial,
        covariance=fit.covariance,
        axis_errors=axis_errors(values, axes, fit.covariance),
        symmetry=symbol,
        offset=data.mean_noise(fit.best),
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
    best = data.fit_coupled(basis)
    while (closer := data.reaching([best])) is not None:
        data = closer
        best = data.fit_coupled(basis)
    elements = [(i, j) for i in range(6) for j in range(i + 1)]
    tensor = data.in_units(best.D)
    covariance = data.covariance(spread(data.tracks, best, basis), elements)
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
        return motion.point_group, invariant_basis(elements)
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


@cache
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
    basis = np.array(
        [
            (np.outer(unit[i], unit[j]) + np.outer(unit[j], unit[i])) / (2 if i == j else 2**0.5)
            for i, j in pairs
        ]
    )
    frozen(basis)
    return basis


def invariant_basis(elements: Floats) -> Floats:
    """Return an orthonormal basis of the symmetric matrices that are invariant under a point group.

    Examples
    --------
    >>> len(invariant_basis(np.array([np.eye(3), np.diag([-1.0, -1.0, 1.0])])))
    4
    """
    basis = symmetric_basis(3)
    flat, rows = basis.reshape(len(basis), 9), elements.reshape(-1, 9)
    # The mean of R_ij R_lk maps B_jk to the mean of (R B R^T)_il.
    mean = (rows.T @ rows / len(rows)).reshape(3, 3, 3, 3).transpose(1, 3, 0, 2).reshape(9, 9)
    share, mix = np.linalg.eigh(flat @ mean @ flat.T)
    return np.asarray((mix[:, share > 0.5].T @ flat).reshape(-1, 3, 3))


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
            # Noise that is stored once for all frames is scaled once.
            alike = one.noise.strides[1] == 0
            shapes = (one.noise[:, :1] if alike else one.noise) / np.outer(scale, scale)
            traces = np.trace(shapes, axis1=2, axis2=3)
            size = (traces[:, 0] if alike else np.nanmean(traces, axis=1)) / 3
            shapes = np.broadcast_to(shapes / size[:, None, None, None], one.noise.shape)
            scaled = replace(
                one,
                vectors=one.vectors / scale,
                duration=one.duration / time,
                noise=shapes,
                dt=one.dt / time,
            )
            if noise.model == "joint":
                # Neighbours' covariance is minus the noise; a little more keeps the start inside.
                square = -np.trace(scaled.neighbour_products) / max(scaled.linked.sum(), 1)
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

    def start(self) -> tuple[Floats, Floats]:
        """Return a D > 0 from the covariance of steps and of neighbours, and the noise (G, c)."""
        duration = sum(t.steps.total_duration for t in self.tracks)
        products = [t.steps.vectors.T @ t.steps.vectors for t in self.tracks]
        now = np.sum(products, axis=0) / duration
        neighbour = np.sum([t.steps.neighbour_products for t in self.tracks], axis=0) / duration
        values, axes = np.linalg.eigh(0.5 * now + neighbour)
        D = (axes * np.maximum(values, 0.05 * np.trace(now) / len(now))) @ axes.T
        return D, np.array([t.start() for t in self.tracks])

    def fit(self, basis: Floats, near: Maximum | None = None) -> Maximum:
        """Return the best tensor >= 0 in the span of a basis, near another maximum if given."""
        D, own = self.start() if near is None else (near.D, near.own)
        return maximise(self.tracks, squares(basis), root_parameters(D, basis), own)

    def fit_coupled(self, basis: Floats) -> Maximum:
        """Return the best tensor (6, 6) >= 0, of searches from two places.

        The likelihood of short noisy tracks has several maxima. The second search begins with equal
        axes and without coupling.
        """
        D, own = self.start()
        level = np.repeat(np.diag(D).reshape(2, 3).mean(axis=1), 3)
        found: list[Maximum] = []
        faults: list[ValueError] = []
        for near in (None, Maximum(-np.inf, np.diag(level), own)):
            try:
                found.append(self.fit(basis, near))
            except ValueError as fault:
                faults.append(fault)
        if not found:
            raise faults[0]
        return max(found, key=lambda m: m.value)

    def fit_axial(self, near: Maximum) -> Maximum:
        """Return the best tensor with two values equal, about any axis."""
        found = [
            maximise(self.tracks, axial(axis), q, near.own, near=True)
            for axis, q in axial_starts(near.D)
        ]
        return max(found, key=lambda m: m.value)

    def reaching(self, maxima: Sequence[Maximum]) -> ScaledTracks | None:
        """Return the tracks with few modes that are exact at these maxima; None if they all are."""
        tracks, exact = [], True
        for k, track in enumerate(self.tracks):
            places = [track.places(m.D, m.own[k]) for m in maxima]
            known = [one for one in places if one is not None]
            if not known:
                tracks.append(track)
                continue
            low, high = float(np.min(known)), float(np.max(known))
            few = track.mode_track
            if isinstance(few, FewModesTrack) and few.exact(np.stack(known)):
                tracks.append(track)
                continue
            exact = False
            window = (max(low, -_FARTHEST) - WINDOW, min(high, _FARTHEST) + WINDOW)
            tracks.append(replace(track, window=() if track.window is not None else window))
        return None if exact else replace(self, tracks=tracks)

    def in_units(self, D: Floats) -> Floats:
        """Return a tensor in um, rad and s."""
        out: Floats = D * np.outer(self.scale, self.scale) / self.time
        return out

    def covariance(
        self, spread: tuple[Floats, Floats], elements: Sequence[tuple[int, int]]
    ) -> Floats:
        """Return the covariance of elements of D in um, rad and s, from that along directions."""
        directions, errors = spread
        rows, columns = np.transpose(elements)
        slopes = self.in_units(directions)[:, rows, columns].T
        return np.asarray(slopes @ errors @ slopes.T)

    def mean_noise(self, best: Maximum) -> Floats:
        """Return the noise of one frame less blur in um and rad, mean over motions."""
        pairs = zip(self.tracks, best.own, strict=True)
        noise = sum(t.noise(best.D, own) for t, own in pairs) / len(self.tracks)
        out: Floats = noise * np.outer(self.scale, self.scale)
        return out


class TensorFit(NamedTuple):
    """The tensor of some motions in scaled units, with its error and two tests.

    Attributes
    ----------
    best : Maximum
        Most likely tensor of the symmetry that is imposed.
    covariance : ndarray, shape (6, 6)
        Covariance of its elements in um, rad and s.
    p_isotropic, p_axial : float
        p-values of isotropy and of axial symmetry, from likelihood ratios.
    """

    best: Maximum
    covariance: Floats
    p_isotropic: float
    p_axial: float

    @classmethod
    def tested(
        cls,
        data: ScaledTracks,
        best: Maximum,
        spread: tuple[Floats, Floats],
        *,
        free: Maximum,
        isotropic: Maximum,
        axial: Maximum,
    ) -> TensorFit:
        """Return a fit with the p-values of likelihood ratios."""
        from scipy.special import chdtrc

        p_isotropic, p_axial = (
            float(chdtrc(freedom, max(2 * (free.value - restricted.value), 0.0)))
            for freedom, restricted in ((5, isotropic), (2, axial))
        )
        return cls(best, data.covariance(spread, SYMMETRIC_ELEMENTS), p_isotropic, p_axial)


def tensor_fits(
    data: Sequence[ScaledTracks], bases: Sequence[Floats]
) -> list[TensorFit | ValueError]:
    """Fit a tensor to each of some sets of tracks: those of one track with even steps together.

    Parameters
    ----------
    data : sequence of ScaledTracks
    bases : sequence of ndarray, shape (m, 3, 3)
        Bases of the tensors of the symmetry that is imposed on each.

    Returns
    -------
    list of TensorFit or ValueError
        The error where no search converges.

    Examples
    --------
    >>> from perrin import Cluster, Noise, simulate_motion
    >>> truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=300, rng=3)
    >>> data = ScaledTracks.of([body_steps(truth, "rotation", np.eye(3))], Noise())
    >>> tensor_fits([data], [np.eye(3)[None] / 3**0.5])[0].p_isotropic > 0.05
    True
    """
    found: list[TensorFit | None] = [None] * len(data)
    even = [i for i, one in enumerate(data) if len(one.tracks) == 1 and one.tracks[0].steps.even]
    tracks = [data[i].tracks[0] for i in even]
    sizes = [track.steps.vectors.size for track in tracks]
    keys = [batch_key(track) for track in tracks]
    for rows in groups_alike(keys, sizes, most=_MOST_TENSORS_AT_ONCE):
        some = [even[k] for k in rows]
        fits = _even_fits([data[i] for i in some], [bases[i] for i in some])
        for i, even_fit in zip(some, fits, strict=True):
            found[i] = even_fit
    fits_of_all: list[TensorFit | ValueError] = []
    for one, basis, fit in zip(data, bases, found, strict=True):
        try:
            fits_of_all.append(_one_fit(one, basis) if fit is None else fit)
        except ValueError as error:
            fits_of_all.append(error)
    return fits_of_all


def _one_fit(data: ScaledTracks, basis: Floats) -> TensorFit:
    """Fit a tensor to one set of tracks."""
    free = data.fit(symmetric_basis(3))
    isotropic = data.fit(_ISOTROPIC, near=free)
    known = {6: free, 1: isotropic}  # by the number of tensors that span what the symmetry allows
    best = known[len(basis)] if len(basis) in known else data.fit(basis, near=free)
    # An isotropic tensor is axial as well: the higher of two searches counts.
    axially = max(data.fit_axial(free), isotropic, key=lambda m: m.value)
    closer = data.reaching([free, isotropic, best, axially])
    if closer is not None:
        return _one_fit(closer, basis)
    spreads = spread(data.tracks, best, basis)
    return TensorFit.tested(data, best, spreads, free=free, isotropic=isotropic, axial=axially)


def _even_fits(data: Sequence[ScaledTracks], bases: Sequence[Floats]) -> list[TensorFit | None]:
    """Fit tensors to single tracks with even steps; None where a search does not converge."""
    each = SeparateTensors.of([one.tracks[0] for one in data])
    every = np.arange(len(data))

    def fitted(rows: Ints, basis: Floats, D: Floats, own: Floats) -> list[Maximum | None]:
        q = root_parameters(D, basis)
        return maximise_each(each.rows(rows), squares(basis), q, own)

    starts = [one.start() for one in data]
    D, own = np.stack([D for D, _ in starts]), np.concatenate([own for _, own in starts])
    free = fitted(every, symmetric_basis(3), D, own)
    # Where that did not converge the others are not needed.
    kept = np.array([i for i in every if free[i] is not None], dtype=np.int64)
    peaks = [one for one in free if one is not None]
    found: list[TensorFit | None] = [None] * len(data)
    if not peaks:
        return found
    D, own = np.stack([one.D for one in peaks]), np.concatenate([one.own for one in peaks])
    isotropic = fitted(kept, _ISOTROPIC, D, own)
    pairs = [pair for one in D for pair in axial_starts(one)]
    about = axial(np.stack([axis for axis, _ in pairs]))
    q = np.stack([q for _, q in pairs])
    own_of_pairs = np.repeat(own, 2, axis=0)
    tilted = maximise_each(each.rows(np.repeat(kept, 2)), about, q, own_of_pairs, near=True)
    sizes = np.array([len(bases[i]) for i in kept])
    for size in np.unique(sizes):
        where = np.flatnonzero(sizes == size)
        basis = np.stack([bases[i] for i in kept[where]])
        if size in (1, 6):
            best = [(isotropic if size == 1 else peaks)[k] for k in where]
        else:
            best = fitted(kept[where], basis, D[where], own[where])
        where = where[[one is not None for one in best]]
        if not where.size:
            continue
        known = [one for one in best if one is not None]
        basis = np.stack([bases[i] for i in kept[where]])
        spreads = spread_each(each.rows(kept[where]), known, basis)
        for k, one, directions, errors in zip(where, known, *spreads, strict=True):
            sphere, first, last = isotropic[k], *tilted[2 * k : 2 * k + 2]
            if sphere is None or first is None or last is None:
                continue
            found[kept[k]] = TensorFit.tested(
                data[kept[k]],
                one,
                (directions, errors),
                free=peaks[k],
                isotropic=sphere,
                axial=max(first, last, sphere, key=lambda m: m.value),
            )
    return found


def root_parameters(D: Floats, basis: Floats) -> Floats:
    """Return the parameters q (..., m) of a basis for which (sum q_j E_j)^2 is near D (..., b, b).

    Examples
    --------
    >>> root_parameters(4 * np.eye(3), np.eye(3)[None] / 3).round(9)
    array([2.])
    """
    values, axes = np.linalg.eigh(D)
    roots = np.sqrt(np.maximum(values, 1e-3 * values[..., -1:]))
    root = (axes * roots[..., None, :]) @ np.swapaxes(axes, -1, -2)
    return np.asarray(np.einsum("...mij,...ij->...m", basis, root))


def axial_starts(D: Floats) -> list[tuple[Floats, Floats]]:
    """Return two axes and the parameters of `axial` from which to search for the best tensor.

    Examples
    --------
    >>> [q.round(9).tolist() for _, q in axial_starts(np.diag([1.0, 4.0, 4.0]))]
    [[2.0, 1.0, 0.0, 0.0], [1.58113883, 2.0, 0.0, 0.0]]
    """
    values, axes = np.linalg.eigh(D)
    values = np.maximum(values, 1e-3 * values[-1])
    return [
        (
            axes[:, k],
            np.array([values[others].mean(), values[k], 0.0, 0.0]) ** [0.5, 0.5, 1, 1],
        )
        for k, others in ((0, [1, 2]), (2, [0, 1]))
    ]


def element_variances(covariance: Floats, axes: Floats) -> Floats:
    """Return the variances (3, 3) of a.D.b for three directions, from that of the elements of D.

    Parameters
    ----------
    covariance : ndarray, shape (6, 6)
        Covariance of the elements xx, yy, zz, xy, xz, yz.
    axes : ndarray, shape (3, 3)
        Directions as columns.

    Examples
    --------
    >>> element_variances(np.diag([1.0, 2, 3, 4, 5, 6]), np.eye(3))
    array([[1., 4., 5.],
           [4., 2., 6.],
           [5., 6., 3.]])
    """
    rows, columns = np.transpose(SYMMETRIC_ELEMENTS)
    products = axes[rows, :, None] * axes[columns, None, :]
    weight = np.where(
        (rows != columns)[:, None, None], products + products.swapaxes(1, 2), products
    )
    return np.asarray(np.einsum("iab,iab->ab", weight, np.tensordot(covariance, weight, 1)))


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
    variances = element_variances(covariance, axes)
    for a, b in ((0, 1), (0, 2), (1, 2)):
        variance, apart = float(variances[a, b]), float(values[b] - values[a])
        off = np.sqrt(variance) if not variance < rounding**2 else 0.0
        angle = (
            EQUAL_AXES_ERROR if apart <= rounding else np.degrees(0.5 * np.arctan2(2 * off, apart))
        )
        errors[a, b] = errors[b, a] = angle
    return errors
