"""Diffusion tensors: the likelihood is exact, laws hold, planted tensors come back."""

import dataclasses
import json
from itertools import permutations

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from brownian_motions import all_tracked
from perrin import (
    Cluster,
    PrecisionWarning,
    TooFewFramesError,
    add_noise,
    coupled_tensor,
    cramer_rao,
    diffusion_tensor,
    kabsch,
    noise_floor,
    simulate_motion,
    track_rotation,
)
from perrin.diffusion import (
    effective_modes,
    element_variances,
    tensor_likelihood,
    tensor_of_each,
)
from perrin.diffusion.noise_model import Noise
from perrin.diffusion.steps import Steps, body_steps
from perrin.diffusion.tensor_batches import SeparateTensors, maximise_each
from perrin.diffusion.tensor_likelihood import (
    ArrowHessian,
    Maximum,
    NoisyVectors,
    PooledLikelihood,
    axial,
    maximise,
    spread,
    squares,
)
from perrin.diffusion.tensor_modes import ChainTrack, FewModesTrack
from perrin.diffusion.tensor_results import SYMMETRIC_ELEMENTS
from perrin.diffusion.tensors import ScaledTracks, axes_like, symmetric_basis
from perrin.geometry.rigid import diffusion_center, shifted
from perrin.geometry.rotations import exp_map, skew

SLANT = exp_map(np.array([0.4, -0.7, 0.3]))
BODY = Cluster.from_positions(np.random.default_rng(5).normal(size=(6, 3)))
SIGMA = 0.03 * BODY.R
NOISE = float(np.trace(noise_floor(BODY, sigma=SIGMA).covariance)) / 3


def planted(ratio=(1, 1.5, 3), snr=9.0):
    """Return the tensor with this ratio of values along slanted axes, and this mean SNR."""
    values = np.array(ratio) / np.mean(ratio) * snr * NOISE
    return SLANT @ np.diag(values) @ SLANT.T


def cloud(seed, n_frames=300, tensor=None, missing=0.0, **how):
    """Return noisy positions (T, 6, 3) of the body."""
    rng = np.random.default_rng([seed, 11])
    tensor = planted(**how) if tensor is None else tensor
    truth = simulate_motion(BODY, D_R=tensor, D_T=0.02, dt=1.0, n_frames=n_frames, rng=rng)
    x = add_noise(truth.positions(), sigma=SIGMA, rng=rng)
    x[1:-1][rng.random(n_frames - 2) < missing] = np.nan
    return x


def tracked(seed, **what):
    return track_rotation(cloud(seed, **what), dt=1.0)


def in_body(motion, tensor):
    """Return a tensor given in the axes of BODY in those of the motion's template."""
    turn = kabsch(motion.template, BODY.positions)
    return turn @ tensor @ turn.T


def spd(rng, b):
    a = rng.normal(size=(b, b))
    return a @ a.T / b + 0.3 * np.eye(b)


def steps_of(seed, b=3, r=1, count=9, *, even=False, pieces=False):
    """Return random steps: even ones, or with gaps, frames of different noise and two pieces."""
    rng = np.random.default_rng(seed)
    start = np.arange(count)
    if pieces:
        start[count // 2 + 1 :] += 1  # one frame more: these steps do not share it
    noise = np.array([[spd(rng, b) for _ in range(start[-1] + 2)] for _ in range(r)])
    duration = rng.integers(1, 4, count) * 0.7
    if even:
        noise[:] = noise[:, :1]
        duration[:] = 0.7
    return made(rng.normal(size=(count, b)), duration, start, noise, dt=0.7)


def made(vectors, duration, start, noise, *, dt):
    """Return steps between neighbouring frames with this noise."""
    return Steps(vectors, duration, start, start + 1, noise, dt=dt, sigma=1.0, freedom=0)


def noisy(steps, B=0.0):
    """Return steps with noise amplitudes to be guessed."""
    return NoisyVectors(steps, np.ones(len(steps.noise)), 0.0, B)


def dense_value(steps, D, theta, B):
    """Return the log-density of the steps from their covariance written out."""
    count, b = steps.vectors.shape
    first = np.tensordot(theta, steps.before, 1) - 2 * B * steps.dt * D
    last = np.tensordot(theta, steps.after, 1) - 2 * B * steps.dt * D
    cov = np.zeros((count, b, count, b))
    for i in range(count):
        cov[i, :, i] = 2 * D * steps.duration[i] + first[i] + last[i]
        if steps.linked[i]:
            cov[i, :, i + 1] = cov[i + 1, :, i] = -last[i]
    normal = multivariate_normal(np.zeros(count * b), cov.reshape(count * b, -1))
    return normal.logpdf(steps.vectors.ravel()) + 0.5 * count * b * np.log(2 * np.pi)


# ---- the likelihood -----------------------------------------------------------------------------


@pytest.mark.parametrize(("b", "r"), [(3, 1), (6, 2)])
@pytest.mark.parametrize("how", [{"even": True}, {}, {"pieces": True}])
def test_the_likelihood_is_the_normal_density(b, r, how):
    """Either kernel equals the dense normal density; on even steps they equal one another."""
    steps = steps_of(1, b, r, **how)
    rng = np.random.default_rng(2)
    D, theta, B = spd(rng, b), rng.uniform(0.2, 0.5, r), 0.1
    found = noisy(steps).by_bands(D, theta, B)
    assert found.value == pytest.approx(dense_value(steps, D, theta, B), abs=1e-10)
    assert steps.even == bool(how.get("even"))
    if steps.even:
        quick = noisy(steps).by_modes(D[None], theta[None], np.array([B]))
        for one, other in zip(quick, found, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("r", [1, 2])
def test_chains_along_common_axes_are_the_blocks(r):
    """Where frames are equally noisy both kernels agree in value, slopes and information."""
    steps = steps_of(1, 3, r, pieces=True)
    same = np.broadcast_to(steps.noise[:, :1], steps.noise.shape).copy()
    source = noisy(dataclasses.replace(steps, noise=same))
    rng = np.random.default_rng(2)
    D, theta, B = spd(rng, 3), rng.uniform(0.2, 0.5, r), 0.1
    blocks, chains = source.by_bands(D, theta, B), source.chain_track.at(D, theta, B)
    for one, other in zip(source.chain_track.slopes(D, B, chains), blocks, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-10, atol=1e-10)
    E = np.stack([spd(rng, 3), spd(rng, 3)])
    np.testing.assert_allclose(
        source.chain_track.curvatures(E, D, B, chains),
        source.band_curvatures(E, D, theta, B),
        rtol=1e-10,
        atol=1e-10,
    )
    assert noisy(steps).chain_track is None


@pytest.mark.parametrize(("b", "r"), [(3, 1), (6, 2)])
def test_few_modes_are_the_chains_of_equally_noisy_frames(b, r):
    """Values and slopes are those of chains, curvatures the differences of their slopes."""
    steps = steps_of(1, b, r, count=40, pieces=True)
    same = np.broadcast_to(steps.noise[:, :1], steps.noise.shape).copy()
    source = noisy(dataclasses.replace(steps, noise=same))
    rng = np.random.default_rng(2)
    D, theta, B = spd(rng, b), rng.uniform(0.2, 0.5, r), np.array([0.1])
    few = FewModesTrack.of(steps, same[:, 0], None, window=(-2.0, 3.0))
    modes = few.diagonal(D[None], theta[None], B)
    assert few.exact(modes.places)
    chains = source.chain_track
    expected = chains.slopes(D, 0.1, chains.at(D, theta, 0.1))
    for one, other in zip(few.slopes(D[None], B, modes), expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9)
    E, h = np.stack([spd(rng, b), spd(rng, b)]), 1e-5
    found = few.curvatures(E[None], D[None], B, modes)[0]

    def slopes(change, dtheta=0.0):
        at = chains.slopes(D + change, 0.1, chains.at(D + change, theta + dtheta, 0.1))
        return np.append(np.sum(at.D * E, axis=(1, 2)), at.theta)

    for i, to in enumerate(E):
        bend = (slopes(-h * to) - slopes(h * to)) / (2 * h)
        np.testing.assert_allclose(found[i, : 2 + r], bend, rtol=1e-5, atol=1e-5)
    bend = (slopes(0 * D, -h) - slopes(0 * D, h)) / (2 * h)
    np.testing.assert_allclose(found[2 : 2 + r, : 2 + r].sum(axis=0), bend, rtol=1e-5, atol=1e-5)


def test_a_long_track_with_gaps_takes_few_eliminations(monkeypatch):
    """Tensor, errors and both tests of any body, isotropic ones too, take at most 40 passes."""
    nodes, node = [], effective_modes.ratio_node

    def counted(*steps, **options):
        nodes.append(1)
        return node(*steps, **options)

    points, slopes = [], PooledLikelihood.slopes_at
    monkeypatch.setattr(effective_modes, "ratio_node", counted)
    monkeypatch.setattr(
        PooledLikelihood, "slopes_at", lambda s, p: (points.extend(p), slopes(s, p))[1]
    )
    monkeypatch.setattr(NoisyVectors, "by_bands", None)
    monkeypatch.setattr(ChainTrack, "at", None)
    for ratio in ((1, 1, 1), (1, 1.5, 3)):
        motion = tracked(3, n_frames=1500, ratio=ratio, missing=0.1)
        nodes.clear()
        points.clear()
        diffusion_tensor(motion, symmetry="C_1")
        assert len(nodes) <= 40
        assert len(points) <= 150  # sums over a hundred modes


@pytest.mark.parametrize("options", [{}, {"noise": "residual"}, {"noise": SIGMA, "exposure": 0.5}])
def test_the_tensor_of_a_long_track_is_that_of_its_chains(options, monkeypatch):
    """Values, errors and p-values of few modes and of eliminations at every point agree."""
    motion = tracked(3, n_frames=1200, missing=0.1)
    found = diffusion_tensor(motion, **options)
    monkeypatch.setattr(tensor_likelihood, "LEAST_STEPS", 10**9)
    expected = diffusion_tensor(motion, **options)
    np.testing.assert_allclose(found.tensor, expected.tensor, rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(found.stderr, expected.stderr, rtol=1e-6)
    assert found.p_axial == pytest.approx(expected.p_axial, rel=1e-6)
    np.testing.assert_allclose(found.offset, expected.offset, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("how", [{"even": True}, {"pieces": True}])
def test_the_slopes_are_those_of_the_likelihood(how):
    """Derivatives by D, by the noise and by the blur equal central differences."""
    steps = steps_of(3, r=2, **how)
    rng = np.random.default_rng(4)
    D, theta, B, h = spd(rng, 3), np.array([0.3, 0.4]), 0.1, 1e-6
    found = noisy(steps).by_tensor(D[None], theta[None], np.array([B]))
    to = spd(rng, 3)

    def rise(dD=0.0, dtheta=0.0, dB=0.0):
        s = np.array([h, -h])
        points = D + np.multiply.outer(s, dD + 0 * D), theta + s[:, None] * dtheta, B + s * dB
        ends = noisy(steps).by_tensor(*points).value
        return (ends[0] - ends[1]) / (2 * h)

    assert np.sum(found.D * to) == pytest.approx(rise(dD=to), rel=1e-6, abs=1e-6)
    for k in range(2):
        assert found.theta[0, k] == pytest.approx(rise(dtheta=np.eye(2)[k]), rel=1e-6, abs=1e-6)
    assert pytest.approx(rise(dB=1.0), rel=1e-6, abs=1e-6) == found.B[0]


def test_a_covariance_that_is_not_positive_has_no_likelihood():
    """Outside the positive definite both kernels give minus infinity, and only there."""
    for how in ({"even": True}, {}):
        D = np.stack([-np.eye(3), np.diag([1.0, 1, -0.1]), np.eye(3)])
        value = noisy(steps_of(1, **how)).by_tensor(D, np.full((3, 1), 0.1), np.zeros(3)).value
        assert np.isneginf(value).tolist() == [True, True, False]


@pytest.mark.parametrize("weight", [0.0, 50.0, np.inf])
@pytest.mark.parametrize("B", [None, 0.1])
def test_the_slopes_of_a_source_and_of_a_family(weight, B):
    """With squares, angles and a measured amplitude the chain of derivatives holds."""
    source = NoisyVectors(steps_of(5, r=2, even=True), np.array([0.3, 0.2]), weight, B)
    own, q, h = source.start() + 0.1, np.array([0.6, 0.9, 0.2, -0.1]), 1e-6
    family = axial(SLANT[:, 0])

    def value(p):
        return source.slopes(family(p[:4])[0][None], p[None, 4:])[0][0]

    _, by_D, by_own = source.slopes(family(q)[0][None], own[None])
    slopes = np.append(np.einsum("ab,kab->k", by_D[0], family(q)[1]), by_own[0])
    p = np.append(q, own)
    for k, step in enumerate(h * np.eye(len(p))):
        rise = (value(p + step) - value(p - step)) / (2 * h)
        assert slopes[k] == pytest.approx(rise, rel=1e-5, abs=1e-6)


@pytest.mark.parametrize("weight", [0.0, 50.0, np.inf])
@pytest.mark.parametrize("B", [None, 0.1])
@pytest.mark.parametrize("name", ["axial", "squares"])
def test_the_hessian_of_even_steps(name, weight, B):
    """It equals central differences of the slopes, to 1e-7, in both families of tensors."""
    source = NoisyVectors(steps_of(5, r=2, even=True), np.array([0.3, 0.2]), weight, B)
    own = source.start() + 0.1
    family, q = {
        "axial": (axial(SLANT[:, 0]), np.array([0.6, 0.9, 0.2, -0.1])),
        "squares": (squares(symmetric_basis(3)), np.array([0.6, 0.1, 0.9, 0.2, -0.1, 0.4])),
    }[name]
    pooled, p, h = (
        PooledLikelihood([source], family, len(q), (1, len(own))),
        np.append(q, own),
        1e-5,
    )
    ends = [pooled.slopes(p - h * e)[1] - pooled.slopes(p + h * e)[1] for e in np.eye(len(p))]
    expected = np.array(ends) / (2 * h)
    found = pooled.curvatures(p)
    mixed = found.mixed[0]
    hessian = np.block([[found.shared, mixed], [mixed.T, found.own[0]]])
    np.testing.assert_allclose(hessian, expected, atol=1e-7 * np.abs(expected).max())


def test_a_newton_step_is_that_of_the_inverse_hessian():
    """Several motions with noise of their own share D; negative curvatures are turned positive."""
    rng = np.random.default_rng(6)
    shared, own = rng.normal(size=(5, 4, 4)), rng.normal(size=(5, 3, 2, 2))
    shared, own = (x + np.swapaxes(x, -1, -2) for x in (shared, own))
    hessian = ArrowHessian(shared, rng.normal(size=(5, 3, 4, 2)), own)
    of_D, of_noise = rng.normal(size=(5, 4)), rng.normal(size=(5, 3, 2))
    slopes = np.concatenate([of_D, of_noise.reshape(5, -1)], axis=1)
    expected = (hessian.inverse() @ slopes[..., None])[..., 0]
    step = hessian.step(of_D, of_noise)
    found = np.concatenate([step[0], step[1].reshape(5, -1)], axis=1)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def test_the_maximum_and_its_spread_without_noise():
    """Known absent noise: the best D is the mean square over 2 tau, its errors those of Wishart."""
    rng = np.random.default_rng(6)
    y = rng.normal(size=(400, 3)) @ np.diag([1.0, 1.5, 2.0])
    zero = np.zeros((1, 401, 3, 3))
    steps = made(y, np.full(400, 0.5), np.arange(400), zero, dt=0.5)
    source = NoisyVectors(steps, np.zeros(1), np.inf, 0.0)
    basis = np.array([np.diag(e) for e in np.eye(3)])
    best = maximise([source], squares(basis), np.ones(3), np.zeros((1, 0)))
    expected = (y * y).mean(axis=0)
    np.testing.assert_allclose(np.diag(best.D), expected, rtol=1e-8)
    directions, covariance = spread([source], best, basis)
    slopes = np.array([np.diag(e) for e in directions]).T
    sd = np.sqrt(np.diag(slopes @ covariance @ slopes.T))
    np.testing.assert_allclose(sd / expected, np.sqrt(2 / 400), rtol=1e-5)


# ---- laws ---------------------------------------------------------------------------------------


def same(found, expected, tensor):
    """Assert that a result has this tensor and otherwise the same numbers, to 1e-6 of its size."""
    size = np.trace(expected.tensor)
    np.testing.assert_allclose(found.tensor, tensor, atol=1e-6 * size)
    np.testing.assert_allclose(found.stderr, expected.stderr, rtol=1e-4)
    assert found.p_axial == pytest.approx(expected.p_axial, rel=1e-4)
    assert found.p_isotropic == pytest.approx(expected.p_isotropic, rel=1e-4)


def test_laws(repeats):
    """Turn and shift the lab, permute, reverse time, change units: the answer follows."""
    cases = (("rotation", 0.1), ("translation", 0.0), ("rotation", 0.0), ("translation", 0.1))
    for quantity, missing in cases[: repeats(2, 4)]:
        laws_hold(quantity, missing)


def laws_hold(quantity, missing):
    """Assert the laws with this share of the frames missing."""
    x = cloud(1, missing=missing, n_frames=50)
    motion = track_rotation(x, dt=1.0)
    found = diffusion_tensor(motion, quantity=quantity)
    turn = exp_map(np.array([1.0, -0.5, 2.0]))
    other = diffusion_tensor(track_rotation(x @ turn.T + 7, dt=1.0), quantity=quantity)
    same(other, found, turn @ found.tensor @ turn.T)
    other = diffusion_tensor(track_rotation(x[:, ::-1], dt=1.0), quantity=quantity)
    same(other, found, found.tensor)
    back = track_rotation(x[::-1], dt=1.0)
    first = kabsch(back.template, motion.template)
    same(diffusion_tensor(back, quantity=quantity), found, first @ found.tensor @ first.T)
    power = 1e-6 if quantity == "translation" else 1.0
    units = diffusion_tensor(track_rotation(1e-3 * x, dt=60.0), quantity=quantity)
    scaled = dataclasses.replace(found, tensor=found.tensor * power / 60)
    scaled = dataclasses.replace(scaled, stderr=found.stderr * power / 60)
    same(units, scaled, scaled.tensor)


def test_answers_repeat_from_anywhere():
    """The maximum does not depend on the start of the search, to 1e-7 of the value."""
    steps = steps_of(8, count=300, even=True)
    y = np.random.default_rng(1).normal(size=(301, 3)) * 0.3
    y = np.diff(y, axis=0) + np.random.default_rng(2).normal(size=(300, 3)) * [1, 1.2, 2]
    steps = dataclasses.replace(steps, vectors=y)
    source = NoisyVectors(steps, np.array([0.1]), 0.0, None)
    basis = np.array([np.diag(e) for e in np.eye(3)])
    found = [
        maximise([source], squares(basis), np.array(q), np.array([[t, 0.6]])).D
        for q, t in (((1, 1, 1), 0.3), ((0.5, 2, 0.7), 0.05), ((3, 3, 3), 1.0))
    ]
    for other in found[1:]:
        np.testing.assert_allclose(other, found[0], atol=1e-7 * np.trace(found[0]))


def test_symmetry_is_that_of_the_template_or_as_stated():
    """A trimer's tensor is axial, a tetrahedron's isotropic, an irregular body's anything."""
    for cluster, symbol, rank in (
        (Cluster.trimer(1.4), "D_3h", 2),
        (Cluster.tetrahedron(1.5), "T_d", 1),
        (BODY, "C_1", 3),
    ):
        truth = simulate_motion(cluster, D_R=5e-3, dt=1.0, n_frames=200, rng=1)
        motion = track_rotation(add_noise(truth.positions(), sigma=0.03, rng=2), dt=1.0)
        found = diffusion_tensor(motion)
        assert found.symmetry == symbol
        distinct = 1 + (np.diff(found.principal_values) > 1e-9 * found.mean).sum()
        assert distinct == rank
        loose = diffusion_tensor(motion, symmetry="C_1")
        assert (np.diff(loose.principal_values) > 1e-6 * loose.mean).all()
        assert found.p_isotropic == pytest.approx(loose.p_isotropic)
        if rank == 2:
            normal = np.linalg.svd(motion.template)[2][2]
            assert abs(normal @ found.axes[:, found.resolved_axes]) == pytest.approx(1, abs=1e-4)
            assert "equal by symmetry D_3h" in str(found)
    with pytest.raises(ValueError, match=r"not 'T_d'.*it is C_1"):
        diffusion_tensor(motion, symmetry="T_d")


def test_unequal_spheres_take_the_symmetry_that_is_stated():
    """A tetrahedron with spheres 3 % off is C_1 by default and T_d where that is stated."""
    off = np.random.default_rng(3).normal(size=(4, 3)) * 0.07
    cluster = Cluster.from_positions(Cluster.touching(4, 2.45).positions + off)
    truth = simulate_motion(cluster, D_R=5e-3, dt=1.0, n_frames=300, rng=1)
    motion = track_rotation(add_noise(truth.positions(), sigma=0.03, rng=2), dt=1.0)
    assert diffusion_tensor(motion).symmetry == "C_1"
    stated = diffusion_tensor(motion, symmetry="T_d")
    np.testing.assert_allclose(stated.tensor, stated.mean * np.eye(3), atol=1e-12)


def test_pools_share_the_tensor_and_keep_their_own_axes():
    """Two halves pooled give nearly the whole; bodies turned in the lab are turned back."""
    x = cloud(3, n_frames=600)
    whole = diffusion_tensor(track_rotation(x, dt=1.0))
    turn = exp_map(np.array([2.0, 1.0, -1.0]))
    parts = [track_rotation(x[:300], dt=1.0), track_rotation(x[300:] @ turn.T, dt=1.0)]
    pooled = diffusion_tensor(parts)
    assert np.abs(pooled.tensor - whole.tensor).max() < 0.5 * whole.stderr.max()
    np.testing.assert_allclose(pooled.stderr, whole.stderr, rtol=0.3)
    assert pooled.n_frames == 600
    twice = diffusion_tensor([parts[0], parts[0]])
    once = diffusion_tensor(parts[0])
    np.testing.assert_allclose(twice.tensor, once.tensor, atol=1e-6 * once.mean)
    np.testing.assert_allclose(twice.stderr, once.stderr / 2**0.5, rtol=1e-4)


def test_pools_refuse_other_bodies():
    """Another number of particles, or other places, is refused with the numbers."""
    one = tracked(1, n_frames=50)
    relabelled = track_rotation(cloud(1, n_frames=50)[:, [1, 0, 2, 3, 4, 5]], dt=1.0)
    with pytest.raises(ValueError, match=r"motion 1: its particles lie .* um .*other labels"):
        diffusion_tensor([one, relabelled])
    four = track_rotation(cloud(1, n_frames=50)[:, :4], dt=1.0)
    with pytest.raises(ValueError, match="motion 1 has 4 particles and the first 6"):
        diffusion_tensor([one, four])


# ---- planted truth ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def runs(repeats):
    """Return values, errors and p-values along the true axes: default and residual noise."""
    motions = all_tracked(cloud(seed) for seed in range(repeats(10, 40)))
    out, truth = {}, planted()
    for name, noise in (("joint", Noise()), ("residual", Noise("residual", exposure=0.0))):
        out[name] = []
        for motion, found in zip(motions, tensor_of_each(motions, noise=noise), strict=True):
            values, axes = np.linalg.eigh(in_body(motion, truth))
            along = np.array([found.along(axis) for axis in axes.T])
            p = (found.p_isotropic, found.p_axial)
            out[name].append([*(along[:, 0] / values), *(along[:, 1] / values), *p])
    return {name: np.array(rows) for name, rows in out.items()}


def test_planted_values_come_back_within_their_errors(runs):
    """Along the true axes z-scores have mean 0 and spread 1 within 3 standard errors.

    The default may be off by 0.45 of its error: unknown blur cannot be less than none.
    """
    for name, bias in (("joint", 0.45), ("residual", 0.0)):
        z = (runs[name][:, :3] - 1) / runs[name][:, 3:6]
        assert np.all(np.abs(z.mean(axis=0)) < bias + 3 / len(z) ** 0.5)
        assert abs(z.std() - 1) < 3 / (2 * z.size) ** 0.5 + 0.06


def test_known_noise_reaches_the_bound_of_one_axis(runs):
    """The spread is that of the Cramer-Rao bound of each axis, 9.0 % at N = 300, SNR 9."""
    covariance = SLANT.T @ noise_floor(BODY, sigma=SIGMA).covariance @ SLANT
    values = np.diag(SLANT.T @ planted() @ SLANT)
    bound = [
        cramer_rao(n_frames=300, snr=snr, axes=1, noise="known")
        for snr in values / np.diag(covariance)
    ]
    spread_found = runs["residual"][:, :3].std(axis=0)
    assert np.all(spread_found < (1 + 3 / (2 * len(runs["residual"])) ** 0.5) * np.array(bound))
    np.testing.assert_allclose(runs["residual"][:, 3:6].mean(axis=0), bound, rtol=0.08)


def test_anisotropy_is_detected(runs):
    """1:1.5:3 is never taken for isotropic at N = 300, and seldom for axial."""
    p = runs["joint"][:, 6:]
    assert p[:, 0].max() < 1e-3
    assert (p[:, 1] < 0.05).mean() > 0.5


def test_isotropy_is_rejected_no_more_often_than_stated(repeats):
    """At the 5 % level at most 8 % of tracks of an isotropic body (benchmarks/tensors.py: 7 %).

    More than 5 rejections of 20 tracks, or 10 of 60, would have probability 1e-3 at 7 %.
    """
    count = repeats(20, 60)
    tracks = (cloud(seed, ratio=(1, 1, 1), n_frames=150) for seed in range(count))
    p = [found.p_isotropic for found in tensor_of_each(all_tracked(tracks), noise=Noise())]
    assert np.sum(np.array(p) < 0.05) <= repeats(5, 10)
    assert abs(np.median(p) - 0.5) < 1.5 / count**0.5 + 0.05


def test_missing_frames_and_blur_do_not_bias_the_mean(repeats):
    """10 % of frames missing, or a shutter open all the time: the mean D is right to 4 errors.

    Ignored, blur would lower the mean by 20 % and gaps would raise it by 10 %. Gaps change D of a
    track by 2.4 % (one standard error).
    """
    count, mean, tracks = repeats(3, 12), np.trace(planted()) / 3, []
    for seed in range(count):
        tracks.append(cloud(seed, n_frames=400))
        lost = np.random.default_rng([seed, 12]).random(398) < 0.1
        tracks.append(np.where(np.pad(lost, 1)[:, None, None], np.nan, tracks[-1]))
    motions = all_tracked(tracks)
    whole, gapped = (
        np.array([found.mean for found in tensor_of_each(motions[k::2], noise=Noise())])
        for k in (0, 1)
    )
    assert np.mean(gapped) == pytest.approx(mean, rel=4 * 0.07 / count**0.5)
    assert np.mean(gapped / whole) == pytest.approx(1, abs=3.5 * 0.024 / count**0.5)
    count, tracks = repeats(4, 8), []
    for seed in range(count):
        truth = simulate_motion(BODY, D_R=planted(), dt=0.1, n_frames=6000, rng=seed)
        x = truth.positions().reshape(600, 10, 6, 3).mean(axis=1)
        tracks.append(add_noise(x, sigma=SIGMA, rng=seed))
    motions = all_tracked(tracks)
    blurred = [found.mean for found in tensor_of_each(motions, noise=Noise())]
    assert np.mean(blurred) == pytest.approx(mean, rel=4 * 0.06 / count**0.5)
    for motion in motions[: repeats(1, 8)]:
        assert diffusion_tensor(motion, exposure=1.0).mean == pytest.approx(mean, rel=0.25)


def test_translation_of_an_anisotropic_body():
    """Centres planted to move along and across a turning body give its tensor back."""
    rng = np.random.default_rng(4)
    truth = simulate_motion(BODY, D_R=planted(), dt=0.1, n_frames=30001, rng=rng)
    planted_t = SLANT @ np.diag([0.01, 0.015, 0.03]) @ SLANT.T
    jumps = rng.normal(size=(30000, 3)) @ np.linalg.cholesky(2 * planted_t * 0.1).T
    lab = np.einsum("tij,tj->ti", truth.rotation[:-1], jumps)
    x = truth.positions()
    x[1:] += np.cumsum(lab, axis=0)[:, None]
    motion = track_rotation(add_noise(x[::10], sigma=SIGMA, rng=rng), dt=1.0)
    found = diffusion_tensor(motion, quantity="translation")
    tensor = in_body(motion, planted_t)
    values, axes = np.linalg.eigh(tensor)
    for value, axis in zip(values, axes.T, strict=True):
        measured, error = found.along(axis)
        assert abs(measured - value) < 4 * error
        assert error / value < 0.08
    assert found.unit == "um^2/s"


def test_the_statement_about_the_axes():
    """Near-degenerate values: the plane. Isotropic: the mean. Well apart: three axes."""
    near = diffusion_tensor(tracked(1, ratio=(1, 1.05, 3)))
    assert "values 1 and 2 cannot be distinguished: the plane" in str(near)
    assert near.resolved_axes.tolist() == [False, False, True]
    even = diffusion_tensor(tracked(3, ratio=(1, 1, 1)), symmetry="C_1")
    assert even.p_isotropic > 0.05
    assert "read D_R, the mean, not the three sorted values" in str(even)
    assert not even.resolved_axes.any()
    motion = tracked(1, ratio=(1, 3, 9), n_frames=1000)
    wide = diffusion_tensor(motion)
    assert wide.resolved_axes.all()
    assert "axes known to" in str(wide)
    truth = np.linalg.eigh(in_body(motion, planted((1, 3, 9))))
    off = np.degrees(np.arccos(np.abs(np.sum(wide.axes * truth[1], axis=0))))
    assert np.all(off < 4 * wide.axis_errors.max(axis=1))
    assert np.linalg.det(wide.axes) == pytest.approx(1)


# ---- coupling -----------------------------------------------------------------------------------


def coupled_walk(tensor, *, n_frames, substeps, rng):
    """Return rotations and positions of a body whose body-frame velocities have this tensor."""
    root = np.linalg.cholesky(2 * tensor / substeps)
    R, x = np.eye(3), np.zeros(3)
    rotations, places = [R], [x]
    noise = rng.normal(size=(n_frames - 1, substeps, 6)) @ root.T
    turns = exp_map(noise[..., 3:])
    middle = exp_map(0.5 * noise[..., 3:])
    jumps = np.einsum("fsij,fsj->fsi", middle, noise[..., :3])
    for turn, jump in zip(turns, jumps, strict=True):
        for one, move in zip(turn, jump, strict=True):
            x = x + R @ move
            R = R @ one
        rotations.append(R)
        places.append(x)
    return np.array(rotations), np.array(places)


@pytest.fixture(scope="module")
def coupled():
    """Return a motion from a planted coupled walk of BODY, the tensor, a short part with gaps."""
    rng = np.random.default_rng(8)
    tensor = np.zeros((6, 6))
    tensor[:3, :3] = SLANT @ np.diag([0.01, 0.012, 0.02]) @ SLANT.T
    tensor[3:, 3:] = planted(snr=9)
    tensor[3:, 3:] *= 4e-3 / np.trace(tensor[3:, 3:]) * 3
    tensor[:3, 3:] = np.array([[1.0, 2, -1], [0.5, -1, 1], [2, 0, 1.5]]) * 8e-4
    tensor[3:, :3] = tensor[:3, 3:].T
    R, x = coupled_walk(tensor, n_frames=4000, substeps=4, rng=rng)
    points = np.einsum("tij,nj->tni", R, BODY.positions) + x[:, None]
    points = add_noise(points, sigma=SIGMA, rng=rng)
    motion = track_rotation(points, dt=1.0)
    both = np.kron(np.eye(2), kabsch(motion.template, BODY.positions))
    points[1::10] = np.nan
    return motion, both @ tensor @ both.T, track_rotation(points[:400], dt=1.0)


@pytest.fixture(scope="module")
def at_centroid(coupled):
    """Return the coupled tensor of the whole motion at the centroid."""
    return coupled_tensor(coupled[0], point="centroid")


def test_the_coupled_tensor_is_at_the_highest_of_several_maxima():
    """Of this short track the first search alone ends 0.19 below the highest maximum."""
    body = Cluster.from_positions([[0, 0, 0], [1, 0, 0], [0, 1.3, 0], [0.2, 0.3, 1.7]])
    truth = simulate_motion(body, D_R=[3e-3, 5e-3, 9e-3], D_T=0.03, dt=0.7, n_frames=60, rng=16)
    motion = track_rotation(add_noise(truth.positions(), sigma=0.1, rng=16), dt=0.7)
    data = ScaledTracks.of([body_steps(motion, "both", np.eye(3))], Noise())
    basis, (D, own) = symmetric_basis(6), data.start()
    starts = [(D, own), (np.diag(np.diag(D)), own), (D, 0.3 * own), (2 * D, 0.6 * own)]
    values = [data.fit(basis, near=Maximum(0.0, *start)).value for start in starts]
    assert max(values) > values[0] + 0.1
    found = data.fit_coupled(basis)
    assert found.value > max(values) - 1e-6
    tensor = coupled_tensor(motion, point="centroid").tensor
    np.testing.assert_allclose(tensor, data.in_units(found.D), rtol=1e-9)


def test_a_planted_coupled_tensor_comes_back(coupled, at_centroid):
    """All 21 elements at the centroid: rms z between 0.6 and 1.5 (1 +- 3/sqrt(2 21))."""
    (_, tensor, gapped), found = coupled, at_centroid
    z = ((found.tensor - tensor) / found.stderr)[np.tril_indices(6)]
    assert 0.6 < np.sqrt(np.mean(z**2)) < 1.5
    assert np.abs(z).max() < 4
    # The coupling is seen, and no noise is left in the diagonals (2 to 14 % if it were).
    assert np.abs(found.D_C / found.stderr[:3, 3:]).max() > 5
    short = coupled_tensor(gapped, point="centroid")
    assert np.abs((short.tensor - tensor) / short.stderr).max() < 4
    assert short.n_frames == 360
    np.testing.assert_array_equal(found.point, 0)
    np.testing.assert_array_equal(found.D_T, found.tensor[:3, :3])
    np.testing.assert_array_equal(found.D_R, found.tensor[3:, 3:])


def test_the_centre_of_diffusion(coupled, at_centroid):
    """There the coupling is symmetric; the planted centre comes back, and points agree."""
    motion, tensor, _ = coupled
    found = coupled_tensor(motion)
    np.testing.assert_allclose(found.D_C, found.D_C.T, atol=1e-12 * np.abs(found.tensor).max())
    expected = diffusion_center(tensor)
    assert np.linalg.norm(expected) > 0.05
    assert np.linalg.norm(found.point - expected) < 0.35 * np.linalg.norm(expected)
    z = (found.tensor - shifted(tensor, expected)) / found.stderr
    assert np.abs(z).max() < 4
    there = coupled_tensor(motion, point=found.point)
    np.testing.assert_allclose(there.tensor, shifted(at_centroid.tensor, found.point), rtol=1e-10)
    np.testing.assert_allclose(there.tensor, found.tensor, rtol=1e-10, atol=1e-15)


def test_the_variance_of_an_element_along_any_directions():
    """It is that of a linear function of the six elements."""
    rng = np.random.default_rng(1)
    root, axes = rng.normal(size=(6, 6)), exp_map(np.array([0.3, -0.5, 0.2]))
    found = element_variances(root @ root.T, axes)
    units = np.zeros((6, 3, 3))
    for unit, (i, j) in zip(units, SYMMETRIC_ELEMENTS, strict=True):
        unit[i, j] = unit[j, i] = 1.0
    weight = axes.T @ units @ axes
    np.testing.assert_allclose(
        found, np.einsum("iab,ij,jab->ab", weight, root @ root.T, weight), rtol=1e-12
    )


def test_moving_the_point():
    """Formulas of the shift, block by block; there and back; the centre found from anywhere."""
    rng = np.random.default_rng(3)
    tensor, r = spd(rng, 6), np.array([0.3, -1.0, 0.5])
    moved, k = shifted(tensor, r), skew(r)
    D_T, D_C, D_R = tensor[:3, :3], tensor[:3, 3:], tensor[3:, 3:]
    np.testing.assert_allclose(moved[3:, 3:], D_R)
    np.testing.assert_allclose(moved[:3, 3:], D_C - k @ D_R)
    np.testing.assert_allclose(moved[:3, :3], D_T - k @ D_C.T + D_C @ k - k @ D_R @ k)
    np.testing.assert_allclose(shifted(moved, -r), tensor, atol=1e-14)
    center = diffusion_center(tensor)
    np.testing.assert_allclose(diffusion_center(moved), center - r, atol=1e-13)
    symmetric = shifted(tensor, center)[:3, 3:]
    np.testing.assert_allclose(symmetric, symmetric.T, atol=1e-14)


def test_the_search_takes_few_passes(monkeypatch, repeats):
    """A tensor with errors and p-values: under 130 passes over the steps."""
    passes = []
    slopes = NoisyVectors.by_tensor

    def counted(self, D, theta, B):
        passes.extend(D)
        return slopes(self, D, theta, B)

    monkeypatch.setattr(NoisyVectors, "by_tensor", counted)
    for seed in range(repeats(2, 3)):
        motion = tracked(seed)
        passes.clear()
        diffusion_tensor(motion)
        assert len(passes) < 130


# ---- refusals -----------------------------------------------------------------------------------


def test_motions_without_a_tensor_are_refused():
    """All faults at once; planar motions; too few steps; a body at rest."""
    motion = tracked(1, n_frames=60)
    with pytest.raises(ValueError, match=r"quantity: .*; noise: .*; exposure: "):
        diffusion_tensor(motion, quantity="heat", noise="none", exposure=1.5)
    with pytest.raises(ValueError, match=r"noise: .*got -0\.1"):
        diffusion_tensor(motion, noise=-0.1)
    flat = simulate_motion(
        Cluster.from_positions([[0, 0], [2, 0]]), D_R=0.1, dt=1, n_frames=30, rng=1
    )
    for estimate in (diffusion_tensor, coupled_tensor):
        with pytest.raises(ValueError, match="in the plane there is one angle and no tensor"):
            estimate(flat)
    with pytest.raises(ValueError, match="expected one or more motions"):
        diffusion_tensor([])
    with pytest.raises(TooFewFramesError, match=r"9 steps between poses.*12 in all"):
        diffusion_tensor(tracked(1, n_frames=10))
    with pytest.raises(TooFewFramesError, match="needs 50 in all"):
        coupled_tensor(tracked(1, n_frames=40))
    with pytest.raises(TooFewFramesError, match=r"1 in the shortest motion.*2 of every motion"):
        diffusion_tensor([motion, tracked(1, n_frames=2)])
    truth = simulate_motion(BODY, D_R=planted(), dt=1.0, n_frames=60, rng=1)
    with pytest.raises(ValueError, match="pool these two kinds separately"):
        diffusion_tensor([motion, truth], noise="residual")
    with pytest.raises(ValueError, match="point: expected"):
        coupled_tensor(motion, point="middle")
    still = simulate_motion(BODY, D_R=0.0, dt=1.0, n_frames=30, rng=1)
    with pytest.raises(ValueError, match="does not move at all"):
        diffusion_tensor(still)
    with pytest.raises(ValueError, match="direction: expected 3 numbers"):
        diffusion_tensor(motion).along([0, 0, 0])


@pytest.fixture(scope="module")
def on_the_edge():
    """Return tensors of noise far larger than the motion, of which warnings are checked."""
    with pytest.warns(PrecisionWarning, match="a value lies on its edge"):
        found = diffusion_tensor(tracked(2, n_frames=40, snr=1e-4))
    with pytest.warns(PrecisionWarning, match="coupled_tensor: no errors"):
        return found, coupled_tensor(tracked(2, n_frames=60, snr=1e-4), point="centroid")


def test_a_value_on_its_edge_is_warned_of(on_the_edge):
    """Noise far larger than the motion: a value of 0, errors NaN, and a warning."""
    found, coupled = on_the_edge
    assert found.principal_values[0] < 1e-6 * found.principal_values[2]
    assert "no errors are known" in str(found)
    assert np.isnan(coupled.stderr).all()


def test_steps_that_share_no_frame():
    """Pieces of one step each do not determine the noise; a stated noise is subtracted."""
    motion = tracked(4, n_frames=300)
    apart = dataclasses.replace(motion, piece=np.arange(300) // 2)
    found = diffusion_tensor(apart, noise=SIGMA, exposure=0.0)
    assert abs(found.mean - np.trace(planted()) / 3) < 4 * found.mean_stderr
    joint = diffusion_tensor(apart)
    assert joint.mean_stderr > found.mean_stderr


def test_truth_without_noise_is_measured_with_every_option():
    """Simulated truth (sigma 0, covariance 0) and its rounding give the planted tensor."""
    truth = simulate_motion(BODY, D_R=planted(), D_T=0.02, dt=1.0, n_frames=1000, rng=1)
    values, axes = np.linalg.eigh(planted())
    for motion in (truth, track_rotation(truth.positions(), dt=1.0)):
        for how in ({}, {"noise": "residual"}, {"noise": "residual", "exposure": 0.0}):
            found = diffusion_tensor(motion, **how)
            for value, axis in zip(values, axes.T, strict=True):
                measured, error = found.along(axis)
                assert abs(measured - value) < 4 * error


def test_results_cannot_be_changed():
    """Arrays of results are read-only."""
    found = diffusion_tensor(tracked(1, n_frames=60))
    for array in (found.tensor, found.axes, found.stderr, found.covariance, found.offset):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0


def test_tensors_come_back_from_json(on_the_edge):
    """Every field survives to_dict, JSON and from_dict; errors that are not known are null."""
    motion = tracked(1, n_frames=60)
    found = [diffusion_tensor(motion), on_the_edge[0], coupled_tensor(motion), on_the_edge[1]]
    for tensor in found:
        back = type(tensor).from_dict(json.loads(json.dumps(tensor.to_dict())))
        for field in dataclasses.fields(tensor):
            np.testing.assert_equal(getattr(back, field.name), getattr(tensor, field.name))
    assert found[1].to_dict()["stderr"] == [None] * 3


def test_a_tensor_takes_the_options_of_the_noise():
    """A Noise is the two keywords; stated twice, or with a drift, it is refused."""
    motion = tracked(1, n_frames=60)
    one = diffusion_tensor(motion, noise=Noise("residual", exposure=0.5))
    two = diffusion_tensor(motion, noise="residual", exposure=0.5)
    np.testing.assert_array_equal(one.tensor, two.tensor)
    with pytest.raises(ValueError, match="exposure: stated in noise="):
        diffusion_tensor(motion, noise=Noise(exposure=0.5), exposure=0.5)
    with pytest.raises(ValueError, match="a drift is not subtracted from a tensor"):
        diffusion_tensor(motion, noise=Noise(drift=True))


# ---- names of axes, means over axes -------------------------------------------------------------


def test_a_weighted_mean_is_that_of_the_directions():
    """One direction, all axes and a mixture: tr(D W)/tr W, errors as for `along` and the mean."""
    body = Cluster.from_positions([[0, 0, 0], [3, 0, 0], [0, 2, 0], [0, 0, 1]])
    truth = simulate_motion(body, D_R=[1e-3, 2e-3, 6e-3], dt=1.0, n_frames=400, rng=1)
    found = diffusion_tensor(truth)
    p = np.array([1.0, -2.0, 0.5])
    assert found.weighted(np.outer(p, p)) == pytest.approx(found.along(p), rel=1e-12)
    assert found.weighted(3 * np.eye(3)) == pytest.approx(
        (found.mean, found.mean_stderr), rel=1e-12
    )
    W = np.diag([1.0, 0.5, 0.5])
    assert found.weighted(W)[0] == pytest.approx(np.trace(found.tensor @ W) / 2, rel=1e-12)
    for bad in (np.zeros((3, 3)), np.eye(2), np.full((3, 3), np.nan)):
        with pytest.raises(ValueError, match="weights: expected"):
            found.weighted(bad)


def test_the_summary_has_no_second_mean():
    """`summary` is the text without the mean, so that only one mean is shown together with D_R."""
    truth = simulate_motion(Cluster.tetrahedron(1.0), D_R=1e-3, dt=1.0, n_frames=100, rng=1)
    found = diffusion_tensor(truth)
    assert str(found).count("\nmean ") == 1
    assert "\nmean " not in found.summary
    head, tail = str(found).split("\nmean ")
    assert found.summary == head + "\n" + tail.partition(", ")[2]
    assert found.statement == "the values are equal by symmetry T_d: read D_R, the mean"


def test_axes_are_named_as_those_of_a_reference():
    """Any order and signs of the columns are undone; small turns do not matter."""
    rng = np.random.default_rng(2)
    for order in permutations(range(3)):
        reference = exp_map(rng.normal(size=3))
        turned = reference @ exp_map(0.2 * rng.normal(size=3))
        shuffled = (turned * [1, -1, -1])[:, order]
        np.testing.assert_array_equal(np.array(order)[axes_like(shuffled, reference)], range(3))


def test_the_highest_likelihood_does_not_depend_on_the_noise_a_search_begins_with():
    """Noise and blur are hardly told apart where D is nearly the same along all axes."""
    body, data = Cluster.tetrahedron(1.5), []
    for seed in range(8):
        truth = simulate_motion(body, D_R=5e-3, D_T=0.02, dt=0.7, n_frames=250, rng=seed)
        motion = track_rotation(add_noise(truth.positions(), sigma=0.03, rng=1), dt=0.7)
        data.append(ScaledTracks.of([body_steps(motion, "translation", np.eye(3))], Noise()))
    each = SeparateTensors.of([one.tracks[0] for one in data])
    family, q = squares(symmetric_basis(3)), np.tile([0.5, 0.5, 0.5, 0, 0, 0], (len(data), 1))
    size, values = np.array([one.start()[1][0, 0] for one in data]), []
    for amplitude, angle in [(0.3, 0.05), (1.0, 0.6), (3.0, 1.5)]:
        own = np.column_stack([amplitude * size, np.full(len(data), angle)])
        values.append([one.value for one in maximise_each(each, family, q, own)])
    np.testing.assert_allclose(values[1:], [values[0]] * 2, atol=1e-6)
