"""The likelihood of steps is the normal density, and its maximum is found."""

import dataclasses

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from perrin import Cluster, add_noise, simulate_motion, track_rotation
from perrin.diffusion import effective_modes
from perrin.diffusion.effective_modes import FewModes, NoiseProfile
from perrin.diffusion.estimators import by_likelihood
from perrin.diffusion.likelihood import Likelihood
from perrin.diffusion.noise_model import Noise
from perrin.diffusion.step_kernels import SineModes, TridiagonalCovariance
from perrin.diffusion.steps import NoisySteps, steps_of

QUANTITIES = ("rotation", "translation")
SIGMA = 0.03
TETRAHEDRON = Cluster.tetrahedron(1.5)


def cloud(seed, n_frames=14, cluster=TETRAHEDRON, frames=0.0, particles=0.0, times=None):
    """Return the tracked motion of a noisy Brownian cluster, ends complete."""
    rng = np.random.default_rng([seed, 7])
    truth = simulate_motion(cluster, D_R=3e-3, D_T=4e-3, dt=1.0, n_frames=n_frames, rng=rng)
    x = add_noise(truth.positions(), sigma=SIGMA, rng=rng)
    lost = rng.random(x.shape[:2]) < particles
    lost[rng.random(len(x)) < frames] = True
    lost[[0, -1]] = False
    x[lost] = np.nan
    return track_rotation(x, dt=1.0, times=times)


def cases():
    """Return lists of motions: even, gapped, with partial frames, uneven, pooled, planar."""
    even = cloud(1)
    partial = cloud(3, n_frames=20, particles=0.12, cluster=Cluster.touching(5, 2.45))
    uneven = cloud(4, times=np.cumsum(np.random.default_rng(4).uniform(0.5, 2, 14)))
    flat = Cluster.from_positions([[0, 0], [2, 0], [1, 1.6]])
    return {
        "even": [even],
        "trimer": [cloud(8, cluster=Cluster.trimer(1.5))],
        "gapped": [cloud(2, n_frames=24, frames=0.4)],
        "partial": [partial],
        "uneven": [uneven],
        "pieces": [dataclasses.replace(even, piece=np.repeat([0, 1], 7))],
        "pooled": [partial, even, uneven],
        "plane": [cloud(5, cluster=flat)],
    }


CASES = cases()
MODES = {
    "joint": lambda s: NoisySteps.free(s, blur=s.duration.min() / 2, drift=False),
    "exposed": lambda s: NoisySteps.free(s, blur=0.8 * s.dt / 3, drift=False),
    "residual": lambda s: NoisySteps.from_residuals(s, blur=0.1, drift=False),
    "known": lambda s: NoisySteps.fixed(s, sigma=0.04, blur=0.2, drift=False),
}


def built(case, quantity, mode):
    tracks = [MODES[mode](steps_of(m, quantity)) for m in CASES[case]]
    return Likelihood.of(tracks)


def frame_noise(motion, quantity):
    """Return the noise variance of every frame along every axis, per um^2, from the definition."""
    square = SIGMA**2 if motion.noise[0] == 0 else motion.noise[0] ** 2
    if quantity == "translation":
        return np.repeat(motion.center_variance[:, None], motion.center.shape[1], axis=1) / square
    c = motion.covariance / square
    full = motion.n_present == motion.n_present[motion.fitted].max()
    values, axes = np.linalg.eigh(np.nanmean(c[full], axis=0))
    noise = np.einsum("ji,tjk,ki->ti", axes, c, axes)
    alike = [[0]]
    for i in range(1, len(values)):  # axes within 2 % of the one before are taken as equal
        near = values[i] - values[i - 1] <= 0.02 * values[i]
        alike = [*alike[:-1], [*alike[-1], i]] if near else [*alike, [i]]
    for group in alike:
        for t in np.flatnonzero(full):
            noise[t, group] = np.mean(noise[t, group])
    return noise


def dense_covariance(motion, quantity, D, theta, mode):
    """Return the covariance of all steps: S (noise - b D) S^T + 2 D tau, axis after axis."""
    start, stop = motion.steps()
    tau = motion.time[stop] - motion.time[start]
    noise = frame_noise(motion, quantity)
    if mode in ("joint", "exposed"):
        excess = motion.sigma**2 * noise
        noise = theta + excess - np.nanmin(excess)
        blur = tau.min() / 2 if mode == "joint" else 0.8 * motion.dt / 3
    elif mode == "residual":
        full = motion.n_present == motion.n_present[motion.fitted].max()
        noise, blur = theta * noise / np.nanmean(noise[full]), 0.1
    else:
        noise, blur = 0.04**2 * noise, 0.2
    blocks = []
    for axis in noise.T:
        take = np.zeros((len(start), len(motion.time)))
        take[np.arange(len(start)), start] = -1
        take[np.arange(len(start)), stop] = 1
        blocks.append((take * np.nan_to_num(axis - blur * D)) @ take.T + np.diag(2 * D * tau))
    return blocks


def dense_value(case, quantity, mode, likelihood, D, theta):
    """Return the log-density of all steps, and of the residuals, without the constants."""
    total = 0.0
    for motion, track, t in zip(CASES[case], likelihood.tracks, theta, strict=True):
        y = track.steps.vectors
        for column, block in zip(y.T, dense_covariance(motion, quantity, D, t, mode), strict=True):
            total += multivariate_normal(cov=block).logpdf(column)
            total += 0.5 * len(column) * np.log(2 * np.pi)
        if mode == "residual":
            ratio = track.theta / t
            total -= 0.5 * track.freedom * (np.log(t) + ratio)
    return total


def points(likelihood):
    """Return D and theta of every group, small and large against the signal."""
    count = len(likelihood.tracks)
    for size in (0.1, 3.0):
        D = 0.5 * likelihood.scale
        yield D, size * D[0] * (1 + 0.1 * np.arange(count))


@pytest.mark.parametrize("quantity", QUANTITIES)
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("case", CASES)
def test_the_value_is_the_dense_normal_density(case, mode, quantity):
    """It equals a dense multivariate normal log-density to 1e-9, whatever the noise mode."""
    likelihood = built(case, quantity, mode)
    for D, theta in points(likelihood):
        expected = dense_value(case, quantity, mode, likelihood, float(D[0]), theta)
        value = float(likelihood.sums(D, theta).value.sum())
        assert value == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("quantity", QUANTITIES)
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("case", CASES)
def test_the_slopes_are_finite_differences(case, mode, quantity):
    """Rise less fall in D and in every theta equals central differences of the value, to 1e-5."""
    likelihood = built(case, quantity, mode)
    for D, theta in points(likelihood):
        sums, step = likelihood.sums(D, theta), 1e-5
        more, less = (likelihood.sums(D * (1 + k * step), theta).value.sum() for k in (1, -1))
        slope = float((sums.rise_D - sums.fall_D).sum() * D[0])
        assert slope == pytest.approx((more - less) / (2 * step), rel=1e-5, abs=1e-4)
        more, less = (likelihood.sums(D, theta * (1 + k * step)).value for k in (1, -1))
        slopes = (sums.rise - sums.fall) * theta
        assert slopes == pytest.approx((more - less) / (2 * step), rel=1e-5, abs=1e-4)


@pytest.mark.parametrize("drift", [False, True])
@pytest.mark.parametrize("case", ["even", "gapped", "partial", "pooled"])
def test_the_curvatures_are_finite_differences(case, drift):
    """Rises and falls change in D and in theta as their own slopes say, to 1e-5, drift or not.

    Many D and theta at once give what each gives alone.
    """
    steps = [steps_of(m, "rotation") for m in CASES[case]]
    likelihood = Likelihood.of([NoisySteps.free(s, blur=0.2, drift=drift) for s in steps])
    for D, theta in points(likelihood):
        sums, h = likelihood.sums(D, theta), 1e-5
        D_ends = np.stack([D * (1 + h), D * (1 - h)])
        by_D = likelihood.sums(D_ends, np.stack([theta, theta]))
        by_theta = likelihood.sums(np.stack([D, D]), np.stack([theta * (1 + h), theta * (1 - h)]))
        for batch, single in zip(by_D, likelihood.sums(D_ends[1], theta), strict=True):
            assert batch[1] == pytest.approx(single, rel=1e-12)
        for name in ("rise", "fall"):
            first, second = f"{name}_D", name
            found = [getattr(sums, f"{name}_{which}") for which in ("DD", "Do", "Do", "oo")]
            pairs = ((by_D, first, D), (by_D, second, D), (by_theta, first, theta))
            for bend, (ends, part, x) in zip(
                found, (*pairs, (by_theta, second, theta)), strict=True
            ):
                more, less = getattr(ends, part)
                assert bend == pytest.approx((more - less) / (2 * h * x), rel=1e-5)


@pytest.mark.parametrize("quantity", QUANTITIES)
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("case", ["even", "trimer", "plane"])
def test_both_kernels_agree(case, mode, quantity):
    """Sine transform and tridiagonal elimination give the same value and slopes to 1e-10."""
    tracks = built(case, quantity, mode).tracks
    D, theta = np.array([2e-3]), np.array([3e-4])
    one, two = (
        kernel.of(tracks, [0]).sums(D, theta) for kernel in (SineModes, TridiagonalCovariance)
    )
    for a, b in zip(one, two, strict=True):
        assert a == pytest.approx(b, rel=1e-10)


@pytest.mark.parametrize("case", ["even", "gapped", "partial", "uneven", "pooled"])
def test_a_free_mean_velocity_is_the_restricted_likelihood(case):
    """With drift the value is the density of all contrasts that no mean velocity can change.

    The constant between a density of contrasts and the restricted likelihood, ln(tau.tau)/2 for
    each axis, is added; dense QR finds the contrasts.
    """
    steps = [steps_of(m, "translation") for m in CASES[case]]
    likelihood = Likelihood.of([NoisySteps.free(s, blur=0.2, drift=True) for s in steps])
    plain = Likelihood.of([NoisySteps.free(s, blur=0.2, drift=False) for s in steps])
    for D, theta in points(likelihood):
        expected = 0.0
        for motion, track, t in zip(CASES[case], likelihood.tracks, theta, strict=True):
            tau = track.steps.duration
            contrasts = np.linalg.qr(tau[:, None], mode="complete")[0][:, 1:]
            noise = motion.sigma**2 * frame_noise(motion, "translation")
            noise = t + noise - np.nanmin(noise) - 0.2 * D[0]
            start, stop = motion.steps()
            take = np.zeros((len(start), len(motion.time)))
            take[np.arange(len(start)), start], take[np.arange(len(start)), stop] = -1, 1
            for y, axis in zip(track.steps.vectors.T, noise.T, strict=True):
                C = (take * np.nan_to_num(axis)) @ take.T + np.diag(2 * D[0] * tau)
                small = contrasts.T @ C @ contrasts
                expected += multivariate_normal(cov=small).logpdf(contrasts.T @ y)
                expected += 0.5 * (len(y) - 1) * np.log(2 * np.pi) - 0.5 * np.log(tau @ tau)
        value = float(likelihood.sums(D, theta).value.sum())
        assert value == pytest.approx(expected, rel=1e-9)
        assert value != pytest.approx(float(plain.sums(D, theta).value.sum()), rel=1e-6)
        step, sums = 1e-5, likelihood.sums(D, theta)
        more, less = (likelihood.sums(D * (1 + k * step), theta).value.sum() for k in (1, -1))
        slope = float((sums.rise_D - sums.fall_D).sum() * D[0])
        assert slope == pytest.approx((more - less) / (2 * step), rel=1e-5, abs=1e-4)
        more, less = (likelihood.sums(D, theta * (1 + k * step)).value for k in (1, -1))
        slopes = (sums.rise - sums.fall) * theta
        assert slopes == pytest.approx((more - less) / (2 * step), rel=1e-5, abs=1e-4)


def copies(likelihood, count=60):
    """Return every track `count` times, to try as many theta at once."""
    return [Likelihood.of([track] * count) for track in likelihood.tracks]


def brute(many, D):
    """Return the profile log-likelihood by brute force: every theta by itself, grid on grid."""
    total = 0.0
    for same in many:
        scale, count = float(np.mean(same.tracks[0].steps.vectors ** 2)), len(same.tracks)
        grid = np.geomspace(1e-9, 1e3, count)
        for _ in range(4):
            values = same.sums(np.array([D]), scale * grid).value
            k = int(np.argmax(values))
            grid = np.geomspace(grid[max(k - 1, 0)], grid[min(k + 1, count - 1)], count)
        total += float(max(values))
    return total


@pytest.mark.parametrize("mode", ["joint", "exposed", "residual"])
@pytest.mark.parametrize(("seed", "n_frames"), [(1, 60), (2, 25), (3, 5), (0, 8)])
def test_maximum_and_intervals_are_those_of_a_brute_force_profile(mode, seed, n_frames, repeats):
    """The value is the maximum of a profile on a grid; interval ends are 0.99/2 and 3.84/2 below.

    With 5 and 8 frames the profile can have several maxima: the highest counts.
    """
    motion = cloud(seed, n_frames=n_frames)
    likelihood = Likelihood.of([MODES[mode](steps_of(motion, "rotation"))])
    best = likelihood.best()
    many = copies(likelihood)
    top = brute(many, best.D[0])
    assert best.value[0] == pytest.approx(top, abs=1e-4)
    grid = likelihood.scale[0] * np.geomspace(1e-4, 10, repeats(15, 40))
    assert max(brute(many, D) for D in grid) <= top + 1e-6
    for drop in (0.98894, 3.84146):
        low, high = (float(end[0, 0]) for end in likelihood.intervals(best, np.array([[drop]])))
        assert brute(many, high) == pytest.approx(top - drop / 2, abs=1e-4)
        if low > 0:
            assert brute(many, low) == pytest.approx(top - drop / 2, abs=1e-4)
        else:
            assert brute(many, 1e-9 * likelihood.scale[0]) >= top - drop / 2 - 1e-3


def test_apart_finds_the_maximum_of_every_motion():
    """A D for every group gives what each motion gives alone, to 1e-9."""
    steps = [steps_of(m, "rotation") for m in (cloud(i, n_frames=60) for i in range(4))]
    tracks = [MODES["joint"](s) for s in steps] + [
        MODES["joint"](steps_of(CASES["gapped"][0], "rotation"))
    ]
    together = Likelihood.of(tracks).apart().best()
    for i, track in enumerate(tracks):
        alone = Likelihood.of([track]).best()
        assert together.D[i] == pytest.approx(alone.D[0], rel=1e-9)
        assert together.value[i] == pytest.approx(alone.value[0], rel=1e-9)


@pytest.mark.parametrize("quantity", ["rotation", "translation"])
def test_the_restricted_likelihood_is_the_same_in_sine_modes_and_in_bands(quantity):
    """With a free steady motion both kernels agree in value and in all slopes."""
    truth = simulate_motion(
        Cluster.tetrahedron(1.5), D_R=5e-3, D_T=0.02, dt=0.7, n_frames=40, rng=3
    )
    track = NoisySteps.of(steps_of(truth, quantity), Noise(drift=True))
    D, theta = np.array([2e-3, 6e-3])[:, None], np.array([1e-3, 4e-4])[:, None]
    modes, bands = (kernel.of([track], [0]) for kernel in (SineModes, TridiagonalCovariance))
    found, expected = modes.sums(D, theta), bands.sums(D, theta)
    np.testing.assert_allclose(np.diff(found.value[:, 0]), np.diff(expected.value[:, 0]), rtol=1e-9)
    for one, other in zip(found[1:], expected[1:], strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-8)
    for one, other in zip(
        modes.steady_motion(D[0], theta[0]), bands.steady_motion(D[0], theta[0]), strict=True
    ):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(
    ("body", "quantity"),
    [("tetrahedron", "rotation"), ("trimer", "rotation"), ("trimer", "translation")],
)
def test_few_modes_are_the_likelihood_of_a_long_track_with_gaps(body, quantity, mode, monkeypatch):
    """Value, slopes and bends are those of an elimination: to 1e-9 near the estimate of moments.

    So are D and its intervals, without one elimination of all steps beyond those of the nodes.
    """
    cluster = {"tetrahedron": TETRAHEDRON, "trimer": Cluster.trimer(1.5)}[body]
    track = MODES[mode](steps_of(cloud(6, 1500, cluster, frames=0.2), quantity))
    few = FewModes.of([track], [NoiseProfile.of(track)], [0])
    D, theta = np.array([2e-3, 3e-3, 4e-3])[:, None], np.array([2e-4, 3e-4, 4e-4])[:, None]
    for one, other in zip(few.sums(D, theta), few.bands.sums(D, theta), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12 * np.abs(other).max())
    monkeypatch.setattr(effective_modes, "LEAST_STEPS", 10**9)
    expected = by_likelihood([track])
    monkeypatch.undo()
    monkeypatch.setattr(TridiagonalCovariance, "sums", None)
    found = by_likelihood([track])
    for one, other in ((found.value, expected.value), (found.offset, expected.offset)):
        assert one == pytest.approx(other, rel=1e-9, abs=1e-14)
    assert found.ci68 == pytest.approx(expected.ci68, rel=1e-9)
    assert found.ci95 == pytest.approx(expected.ci95, rel=1e-9)


def test_a_long_track_takes_few_eliminations(monkeypatch):
    """Estimate and intervals of any long track take at most 30 eliminations of its steps."""
    motion = cloud(6, 1500, frames=0.2)
    nodes, node = [], effective_modes.ratio_node

    def counted(*steps, **options):
        nodes.append(1)
        return node(*steps, **options)

    monkeypatch.setattr(effective_modes, "ratio_node", counted)
    by_likelihood([NoisySteps.of(steps_of(motion, "rotation"), Noise())])
    assert 10 < len(nodes) <= 30


def test_noise_that_differs_between_frames_has_no_profile():
    """Frames with a particle missing are noisier: their steps are not made into few modes."""
    motion = cloud(6, 1200, Cluster.touching(5, 2.45), particles=0.02)
    track = NoisySteps.of(steps_of(motion, "translation"), Noise())
    assert NoiseProfile.of(track) is None


@pytest.mark.parametrize(("D", "sigma"), [(1e-6, 0.05), (1e-2, 0.003)])
@pytest.mark.parametrize("noise", ["joint", "residual"])
def test_few_modes_serve_any_signal_to_noise_ratio(D, sigma, noise, monkeypatch):
    """From a body that hardly moves to noise far below a step, the result is that of bands."""
    rng = np.random.default_rng(1)
    truth = simulate_motion(TETRAHEDRON, D_R=D, D_T=D, dt=1.0, n_frames=1500, rng=rng)
    x = add_noise(truth.positions(), sigma=sigma, rng=rng)
    x[1:-1][rng.random(1498) < 0.2] = np.nan
    steps = steps_of(track_rotation(x, dt=1.0), "rotation")
    found = by_likelihood([NoisySteps.of(steps, Noise(noise))])
    monkeypatch.setattr(effective_modes, "LEAST_STEPS", 10**9)
    expected = by_likelihood([NoisySteps.of(steps, Noise(noise))])
    for one, other in ((found.value, expected.value), (found.offset, expected.offset)):
        assert one == pytest.approx(other, rel=1e-9, abs=1e-14)
    assert found.ci95 == pytest.approx(expected.ci95, rel=1e-9)
