"""Closed-form estimates of D from steps: exact means and errors, and costs of sparse frames."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from perrin import Cluster, Noise, estimate_diffusion, simulate_motion, track_rotation
from perrin.diffusion.moments import covariance_estimate, step_cosines, trace_estimate
from perrin.diffusion.steps import NoisySteps, Steps

D, SIGMA, FREEDOM = 0.02, 0.3, 1


def covariance(steps, variance, *, D, blur=0.0):
    """Return the covariance of the steps of one axis; variance (T,) is the noise of the frames."""
    variance = variance - blur * D
    shared = np.where(steps.linked[:-1], variance[steps.stop[:-1]], 0.0)
    own = 2 * D * steps.duration + variance[steps.start] + variance[steps.stop]
    return np.diag(own) - np.diag(shared, 1) - np.diag(shared, -1)


def exact_steps(start, stop, noise, *, offset=None, blur=0.0):
    """Return steps whose second moments, over as many axes as steps, are those of the model."""
    start, stop = np.array(start), np.array(stop)
    n, frames = len(start), np.arange(stop[-1] + 1)
    noise = np.array(noise)[frames]
    steps = Steps(
        vectors=np.zeros((n, n)), duration=0.5 * (stop - start), start=start, stop=stop,
        noise=(noise[:, None, None] * np.eye(n))[None], dt=0.5, sigma=SIGMA, freedom=FREEDOM,
        complete=float(noise[:2].mean()),
    )  # fmt: skip
    variance = SIGMA**2 * noise
    if offset is not None:  # the least noisy frame has this offset, the others exceed it
        variance = offset + variance - variance[[*start, *stop]].min()
    roots = np.linalg.cholesky(covariance(steps, variance, D=D, blur=blur))
    return replace(steps, vectors=np.sqrt(n) * roots), variance


NOISE_OF_FRAMES = [0.30, 0.34, 0.2, 0.5, 0.3, 0.3, 0.45, 0.3]
GAPS = [([0, 1, 3, 4, 5], [1, 3, 4, 5, 7]), ([0, 1, 4, 5], [1, 2, 5, 6])]
MODELS = {
    "free": (Noise(), {"offset": 0.011}),
    "free, exposed": (Noise(exposure=0.9), {"offset": 0.011}),
    "measured": (Noise("residual"), {}),
    "measured, exposed": (Noise("residual", exposure=0.9), {"blur": 0.15}),
    "known": (Noise(SIGMA), {}),
}


@pytest.mark.parametrize("name", MODELS)
def test_exact_second_moments_give_the_exact_D_and_the_error_of_quadratic_forms(name):
    """With gaps, uneven noise and two tracks: D to rounding; errors from dense matrices.

    The variance of y^T Q y is 2 tr QCQC for Gaussian y; noise of residuals adds 2/f of its square.
    """
    noise, planted = MODELS[name]
    made = [exact_steps(*gaps, NOISE_OF_FRAMES, **planted) for gaps in GAPS]
    tracks = [NoisySteps.of(steps, noise) for steps, _ in made]
    found = covariance_estimate(tracks)
    assert found.value == pytest.approx(D, rel=1e-12)
    blur, free = planted.get("blur", 0.0), "offset" in planted
    total, variance, of_offset, offsets = 0.0, 0.0, 0.0, []
    for (steps, noisy), track in zip(made, tracks, strict=True):
        n, links = len(steps.start), steps.linked[:-1]
        C = covariance(steps, noisy, D=D, blur=blur)
        off = np.diag(links, 1).astype(float) + np.diag(links, -1)
        Q = np.eye(n) + (n / links.sum() * off if free else 0)
        variance += n * 2 * np.trace(Q @ C @ Q @ C)
        total += 2 * n * np.sum(steps.duration - blur)
        if free:
            product = off / (2 * n * links.sum())
            of_offset += n * 2 * np.trace(product @ C @ product @ C)
            offsets.append(planted["offset"] + track.level)
        else:
            offsets.append(SIGMA**2 * steps.complete - blur * D)
        if noise.model == "residual":
            both = SIGMA**2 * n * (steps.variances[0][:, 0] + steps.variances[1][:, 0]).sum()
            variance += 2 / FREEDOM * both**2
            of_offset += 2 / FREEDOM * (SIGMA**2 * steps.complete) ** 2
    assert found.stderr == pytest.approx(np.sqrt(variance) / total, rel=1e-12)
    assert found.offset == pytest.approx(np.mean(offsets), rel=1e-9)
    assert found.offset_stderr == pytest.approx(np.sqrt(of_offset) / 2, rel=1e-9, abs=1e-15)


def test_steps_that_share_no_frame_have_no_offset():
    """D is the mean square over twice the time, as if there were no noise."""
    steps, _ = exact_steps([0, 2, 4], [1, 3, 5], np.zeros(6))
    found = covariance_estimate([NoisySteps.of(steps, Noise())])
    assert found.value == pytest.approx(D, rel=1e-12)
    assert found.offset == found.offset_stderr == 0


@pytest.mark.parametrize("d", [2, 3])
def test_mean_cosines_of_planted_turns(d):
    """D and its error are those of the mean of tr(R)/d, of turns by one dt and by two.

    <cos> = exp(-D t) in the plane, <(1 + 2 cos)/3> = exp(-2 D t) in space. The error is that of
    a sum of (m - c)/(m N), which are correlated up to two frames apart.
    """
    turns = 0.07 * np.array([1, 2, 3, 5, 7, 9, 10])
    angle, zero = np.append(0, np.cumsum(turns)), np.zeros(8)
    c, s = np.cos(angle), np.sin(angle)
    rotation = np.array([[c, -s, zero], [s, c, zero], [zero, zero, zero + 1]])[:d, :d]
    body = np.array([[1, 0, 1], [0, 1, -1], [-1, 0, 1], [0, -1.0, -1]])[:, :d]
    places = np.einsum("ijt,nj->tni", rotation, body)
    motion = track_rotation(places, dt=0.5, frames=np.arange(10, 18))
    one, two = np.cos(turns), np.cos(turns[:-1] + turns[1:])
    if d == 3:
        one, two = (1 + 2 * one) / 3, (1 + 2 * two) / 3
    np.testing.assert_allclose(step_cosines(motion, 1), [*one, *3 * [np.nan]], rtol=1e-9)
    np.testing.assert_allclose(step_cosines(motion, 2)[:6], two, rtol=1e-9)
    f1, f2 = -np.log(one.mean()), -np.log(two.mean())
    v1 = np.append((one.mean() - one) / (7 * one.mean()), 0.0)
    v2 = np.append((two.mean() - two) / (6 * two.mean()), [0, 0])

    def error(v):
        near = np.abs(np.subtract.outer(np.arange(8), np.arange(8))) <= 2
        return np.sqrt(v @ near @ v)

    rate = d - 1
    known = trace_estimate([motion], noise=[0.004], blur=0.1)
    assert known.value == pytest.approx((f1 / rate - 0.004) / 0.4, rel=1e-9)
    assert known.stderr == pytest.approx(error(v1) / (rate * 0.4), rel=1e-9)
    assert known.offset == pytest.approx(0.004 - 0.1 * known.value, rel=1e-9)
    twice = trace_estimate([motion, motion], noise=[0.003, 0.005], blur=0.1)
    assert twice.value == pytest.approx(known.value, rel=1e-9)
    assert twice.stderr == pytest.approx(known.stderr / np.sqrt(2), rel=1e-9)
    free = trace_estimate([motion], noise=None, blur=0.0)
    assert free.value == pytest.approx((f2 - f1) / (rate * 0.5), rel=1e-9)
    assert free.offset == pytest.approx((2 * f1 - f2) / rate, rel=1e-9)
    assert free.stderr == pytest.approx(error(v2 - v1) / (rate * 0.5), rel=1e-9)
    assert free.offset_stderr == pytest.approx(error(2 * v1 - v2) / rate, rel=1e-9)


def test_a_long_gap_takes_no_memory_in_the_mean_cosine():
    """Frames 0 to 99 and 10^8 on: the estimate is that with a gap of 10 frames, under 2 MB."""
    x = simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=200, rng=1).positions()
    frame = np.arange(200)
    near, far = (
        track_rotation(x, dt=0.7, frames=frame + hole * (frame >= 100)) for hole in (10, 10**8)
    )
    tracemalloc.start()
    found = estimate_diffusion(far, method="trace")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    expected = estimate_diffusion(near, method="trace")
    assert peak < 2e6
    np.testing.assert_allclose(
        [found.value, found.stderr, found.offset],
        [expected.value, expected.stderr, expected.offset],
        rtol=1e-6,
    )
