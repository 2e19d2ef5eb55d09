"""The profile of the likelihood, part by part: slopes by differences, errors by dense algebra."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.fft import dst
from scipy.optimize import minimize_scalar

from brownian_motions import brownian_motion
from perrin.diffusion import Likelihood, NoisySteps, steps_of
from perrin.diffusion.likelihood import (
    ProfilePoint,
    excess_scatter,
    excess_scatter_of_each,
    log_slope_ratio,
    newton_trial,
    ratio_bend,
)

SIGMA = 0.05
MODES = {
    "joint": lambda s: NoisySteps.free(s, blur=s.duration.min() / 2, drift=False),
    "residual": lambda s: NoisySteps.from_residuals(s, blur=0.1, drift=False),
    "known": lambda s: NoisySteps.fixed(s, sigma=0.04, blur=0.2, drift=False),
}


def track(mode, *, seed=1, n_frames=24, uneven=False, D=4e-3, noise=SIGMA**2 / 4):
    """Return the steps of a centre with noise; some frames are noisier where times are uneven."""
    rng = np.random.default_rng(seed)
    time = np.cumsum(rng.uniform(0.7, 1.6, n_frames)) if uneven else np.arange(float(n_frames))
    motion = brownian_motion(seed, time, D_T=D, center_noise=noise)
    each = rng.uniform(1, 1.5, n_frames) if uneven else np.ones(n_frames)
    motion = replace(
        motion, sigma=SIGMA, noise=np.full(3, SIGMA), center_variance=SIGMA**2 / 4 * each
    )
    return MODES[mode](steps_of(motion, "translation"))


POOLS = {
    "even": lambda: [track("joint")],
    "uneven": lambda: [track("joint", uneven=True)],
    "residual": lambda: [track("residual", seed=2)],
    "mixed": lambda: [track("joint"), track("joint", uneven=True), track("known", seed=3)],
}


@pytest.mark.parametrize("name", POOLS)
def test_slopes_of_the_profile_are_its_differences(name):
    """Value by a scalar search; slope, curvature, bend and the slope of theta by differences."""
    likelihood = Likelihood.of(POOLS[name]())
    D = 0.6 * likelihood.scale
    h = 1e-4
    point = likelihood.profile(D, tolerance=1e-9)
    less, more = (likelihood.profile(D * (1 + k * h), tolerance=1e-9) for k in (-1, 1))
    total = 0.0
    for one, theta in zip(likelihood.tracks, point.theta, strict=True):
        alone = Likelihood.of([one])
        if np.isinf(one.freedom):
            total += alone.sums(D, np.array([one.theta])).value[0]
            continue
        found = minimize_scalar(
            lambda t, alone=alone: -alone.sums(D, np.exp([t])).value[0],
            bracket=(np.log(theta) - 1, np.log(theta) + 1), tol=1e-12,
        )  # fmt: skip
        total -= found.fun
        assert np.log(theta) == pytest.approx(found.x, abs=1e-5)
    assert point.value[0] == pytest.approx(total, rel=1e-12)
    step = 2 * h * D
    for slope, part in (
        ("slope", "value"), ("curvature", "slope"), ("bend", "log_ratio"), ("theta_slope", "theta")
    ):  # fmt: skip
        expected = (getattr(more, part) - getattr(less, part)) / step
        np.testing.assert_allclose(getattr(point, slope), expected, rtol=1e-5, atol=1e-9)
    # A coarse search leaves an error of the order of the square of its last step.
    coarse = likelihood.profile(D, tolerance=0.03)
    assert coarse.value[0] == pytest.approx(total, abs=1e-2)
    # Several D at once are as each alone.
    both = likelihood.profile(np.stack([D, 2 * D]), tolerance=1e-9)
    for rows, alone in zip(both, point, strict=True):
        np.testing.assert_allclose(rows[0], alone, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("name", ["even", "mixed"])
def test_the_error_of_the_offset_is_that_of_the_dense_information(name):
    """Of the mean over the motions, from second differences of the value in D and all theta."""
    tracks = POOLS[name]()
    likelihood = Likelihood.of(tracks)
    best = likelihood.best()
    free = np.array([np.isfinite(t.freedom) for t in tracks])
    at = np.append(best.D, best.theta[free])

    def value(x):
        theta = best.theta.copy()
        theta[free] = x[1:]
        return likelihood.sums(x[:1], theta).value.sum()

    steps = 1e-3 * at
    hessian = np.empty((len(at), len(at)))
    for i in range(len(at)):
        for j in range(len(at)):
            corners = [
                a * b * value(at + a * steps * (np.arange(len(at)) == i)
                              + b * steps * (np.arange(len(at)) == j))
                for a in (1, -1) for b in (1, -1)
            ]  # fmt: skip
            hessian[i, j] = sum(corners) / (4 * steps[i] * steps[j])
    covariance = np.linalg.inv(-hessian)
    weights = np.append(-np.mean([t.blur for t in tracks]), np.full(free.sum(), 1 / len(tracks)))
    offset, stderr = likelihood.offsets(best)
    level = np.mean([t.level for t in tracks])
    assert offset[0] == pytest.approx(weights @ at + level, rel=1e-9)
    assert stderr[0] == pytest.approx(np.sqrt(weights @ covariance @ weights), rel=1e-3)


def test_offsets_at_an_edge_have_no_error():
    """A theta of 0, or a D of 0."""
    steps = track("joint", noise=0.0, D=0.05, seed=6).steps
    likelihood = Likelihood.of([NoisySteps.free(steps, blur=0.0, drift=False)])
    best = likelihood.best()
    assert best.theta[0] < 1e-3 * likelihood.mean_square[0]
    assert np.isnan(likelihood.offsets(best)[1]).all()
    still = Likelihood.of([track("joint", D=0.0)])
    zero = still.profile(np.zeros(1))
    assert np.isnan(still.offsets(zero)[1]).all()
    assert still.offsets(zero)[0][0] == pytest.approx(zero.theta[0] + still.tracks[0].level)


def test_a_D_of_each_motion_has_its_own_interval():
    """Apart, all maxima and ends of intervals are those of each motion alone."""
    tracks = [track("joint"), track("joint", uneven=True, seed=4), track("joint", D=1e-5, seed=5)]
    together = Likelihood.of(tracks).apart()
    best = together.best()
    drops = np.array([[1.0, 0.5, 2.0], [3.84, 3.0, 5.0]])
    ends = together.intervals(best, drops)
    offset, error = together.offsets(best)
    for k, one in enumerate(tracks):
        alone = Likelihood.of([one])
        own = alone.best()
        assert best.D[k] == pytest.approx(own.D[0], rel=1e-8)
        for end, expected in zip(ends, alone.intervals(own, drops[:, [k]]), strict=True):
            np.testing.assert_allclose(end[:, k], expected[:, 0], rtol=1e-6)
        for found, expected in zip((offset, error), alone.offsets(own), strict=True):
            assert found[k] == pytest.approx(expected[0], rel=1e-5, nan_ok=True)
        size = one.steps.vectors
        assert together.mean_square[k] == pytest.approx(np.mean(size**2))
        scale = np.sum(size**2) / (6 * np.sum(one.steps.duration))
        assert together.scale[k] == pytest.approx(scale)
        # Both ends have fallen by half of the drop.
        for row in range(2):
            for end in (ends[0][row, k], ends[1][row, k]):
                if end > 0:
                    fall = own.value[0] - alone.profile(np.array([end]), tolerance=1e-9).value[0]
                    assert 2 * fall == pytest.approx(drops[row, k], rel=1e-5)
    joined = Likelihood.of(tracks)
    moved = sum(np.sum(t.steps.vectors**2) for t in tracks)
    spent = sum(6 * np.sum(t.steps.duration) for t in tracks)
    assert joined.scale[0] == pytest.approx(moved / spent)
    rest = replace(tracks[0], steps=replace(tracks[0].steps, vectors=np.zeros((23, 3))))
    least = Likelihood.of([tracks[0], rest]).mean_square
    assert least[1] == pytest.approx(1e-24 * least[0])


@pytest.mark.parametrize(
    ("n_frames", "seed", "still"),
    [(5, 18, True), (5, 242, True), (5, 491, True), (5, 338, False), (6, 132, False)],
)
def test_the_highest_of_several_maxima_counts(n_frames, seed, still):
    """Short tracks whose profile falls from D = 0 and has a maximum elsewhere, lower or higher."""
    likelihood = Likelihood.of([track("joint", seed=seed, n_frames=n_frames, D=1e-4)])
    D = np.append(0, np.geomspace(1e-3, 30, 60))[:, None] * likelihood.scale
    value = likelihood.profile(D, tolerance=1e-7).value[:, 0]
    inside = (value[1:-1] > value[:-2]) & (value[1:-1] > value[2:])
    assert value[1] < value[0]
    assert inside.sum() == 1
    best = likelihood.best()
    assert (best.D[0] == 0) == still
    assert best.value[0] >= value.max() - 1e-9


@pytest.mark.parametrize("name", POOLS)
def test_the_slope_at_the_maximum_is_zero(name):
    """To a millionth of a standard error, D in units of itself; ends of intervals to 1e-6."""
    likelihood = Likelihood.of(POOLS[name]())
    best = likelihood.best()
    at = likelihood.profile(best.D, tolerance=1e-10)
    assert abs(at.slope[0] / np.sqrt(-at.curvature[0])) < 1e-6
    drops = np.array([[1.0], [3.84], [20.0]])
    for ends in likelihood.intervals(best, drops):
        for end, drop in zip(ends[:, 0], drops[:, 0], strict=True):
            fall = 2 * (
                best.value[0] - likelihood.profile(np.array([end]), tolerance=1e-9).value[0]
            )
            assert fall == pytest.approx(drop, rel=1e-6) or (end == 0 and fall < drop)


def test_another_unit_of_length_changes_D_and_its_interval_by_its_square():
    """Also where D is far above 1."""
    one = track("joint")
    other = replace(
        one, steps=replace(one.steps, vectors=1e3 * one.steps.vectors, sigma=1e3 * SIGMA)
    )
    found = []
    for steps in (one, other):
        likelihood = Likelihood.of([steps])
        best = likelihood.best()
        low, high = likelihood.intervals(best, np.array([[1.0], [3.84]]))
        found.append(np.concatenate([best.D, best.theta, low[:, 0], high[:, 0]]))
    np.testing.assert_allclose(found[1], 1e6 * found[0], rtol=1e-6)


def test_a_maximum_and_its_interval_take_few_evaluations(monkeypatch):
    """Of 15 tracks with noise from far below the steps to far above, free or known: 30 on average.

    Slower steps of the search would find the same maxima.
    """
    calls = []
    sums = Likelihood.sums
    monkeypatch.setattr(Likelihood, "sums", lambda *a, **k: calls.append(1) or sums(*a, **k))
    for k, noise in enumerate(np.geomspace(1e-5, 0.1, 15)):
        for mode in ("joint", "known"):
            likelihood = Likelihood.of([track(mode, seed=k, noise=noise)])
            likelihood.intervals(likelihood.best(), np.array([[1.0], [3.84]]))
    assert len(calls) < 30 * 30


def test_a_point_predicts_theta_by_a_power_of_D():
    """The power that its slope has there, from -3 to 3; no prediction from an edge."""
    none = np.zeros(1)

    def predicted(theta, slope, D, other):
        point = ProfilePoint(
            np.array([D]), none, none, none, none, none, np.array([theta]), np.array([slope])
        )
        return float(point.theta_at(np.array([other]))[0])

    assert predicted(0.2, -0.1, 2.0, 3.0) == pytest.approx(0.2 * 1.5**-1)
    assert predicted(0.2, 0.2, 2.0, 3.0) == pytest.approx(0.2 * 1.5**2)
    assert predicted(0.2, 9.0, 2.0, 3.0) == pytest.approx(0.2 * 1.5**3)
    assert predicted(0.2, -9.0, 2.0, 3.0) == pytest.approx(0.2 * 1.5**-3)
    assert predicted(0.0, -9.0, 2.0, 3.0) == 0
    assert predicted(0.2, -0.1, 0.0, 3.0) == predicted(0.2, -0.1, 2.0, 0.0) == 0.2


def test_ratios_of_slopes_and_trials_of_newton_steps():
    """The logarithm is bounded; a step that leaves its bracket is halved; the edge is an answer."""
    one, zero, tiny = np.array([2.0]), np.zeros(1), np.array([1e-301])
    assert log_slope_ratio(one, 2 * one) == pytest.approx(-np.log(2))
    assert log_slope_ratio(one, zero) == pytest.approx(60)
    assert log_slope_ratio(zero, one) == pytest.approx(-60)
    assert ratio_bend(one, 4 * one, one, one) == pytest.approx(1 - 1 / 4)
    assert ratio_bend(zero, one, one, one) == ratio_bend(one, zero, one, one) == 0

    def trial(*numbers):
        return float(newton_trial(*(np.array([float(x)]) for x in numbers))[0])

    assert trial(1, 2, -4, 0, 9) == 1.5
    assert trial(1, 2, -4, 1.5, 9) == 1.5
    assert trial(1, 2, -4, 0, 1.5) == 1.5
    assert trial(1, 2, -4, 0, 1.4) == 0.7
    assert trial(1, 2, -4, 1.6, 9) == pytest.approx(5.3)
    assert trial(1, 2, 4, 0, 9) == 4.5
    # Below the lowest theta of all, the edge itself.
    assert trial(-29, -8, -2, -30, 5) == -30
    assert trial(-29, -8, -2, -29.5, 5) == pytest.approx(-12.25)
    assert tiny < 1e-300


def scatter_by_definition(one, D, theta):
    """Return excess and scale: the deviations of the axes fitted to the cross powers of modes."""
    y = one.steps.vectors
    count, axes = y.shape
    c = 1 - np.cos(np.pi * np.arange(1, count + 1) / (count + 1))
    weight, known = ((pair[0].mean(0) + pair[1].mean(0)) / 2 for pair in (one.weight, one.known))
    noise = weight * theta + known
    rows = np.stack([2 * (one.steps.duration.mean() - one.blur * c), 2 * c])
    eigen = rows[0] * D + rows[1] * noise.mean()
    m = dst(y, type=1, norm="ortho", axis=0)
    inverse = np.linalg.inv((rows / eigen) @ (rows / eigen).T)
    deviation = np.empty((2, axes, axes))
    for a in range(axes):
        for b in range(axes):
            power = m[:, a] * m[:, b] - (a == b) * rows[1] * (noise[a] - noise.mean())
            deviation[:, a, b] = np.linalg.lstsq((rows / eigen).T, power / eigen, rcond=None)[0]
    deviation -= np.trace(deviation, axis1=1, axis2=2)[:, None, None] / axes * np.eye(axes)
    by_theta = 2 * c * (weight.mean() if np.isfinite(one.freedom) else 0.0)
    prior = one.freedom / axes / theta**2 if np.isfinite(one.freedom) and theta > 0 else 0.0
    power = np.sum((by_theta / eigen) ** 2) + prior
    shared = np.sum(rows[0] * by_theta / eigen**2) / power if power > 0 else 0.0
    score = (rows[0] - shared * by_theta) / eigen**2
    excess = scale = 0.0
    for k in range(count):
        own = np.einsum("q,qab->ab", rows[:, k], deviation)
        chance = (axes - 1) * (axes + 2) * rows[:, k] @ inverse @ rows[:, k]
        excess += score[k] ** 2 * (np.sum(own**2) - chance)
        scale += axes * (score[k] * eigen[k]) ** 2
    return excess, scale


@pytest.mark.parametrize("mode", MODES)
def test_the_scatter_of_unequal_axes_is_that_of_the_deviations_in_modes(mode):
    """Of each motion and of several; at least 1, and 1 for few steps and for one axis."""
    tracks = []
    for k, n_frames in enumerate((40, 40, 25)):
        one = track(mode, seed=k, n_frames=n_frames, uneven=k == 1)
        steps = one.steps
        stretched = replace(steps, vectors=steps.vectors * [2.0, 1.0, 0.5])
        noise = [
            (pair[0] * [1, 1.1, 1.2], pair[1] * [1, 1, 1.3]) for pair in (one.weight, one.known)
        ]
        tracks.append(replace(one, steps=stretched, weight=noise[0], known=noise[1]))
    D, theta = np.array([5e-3, 7e-3, 6e-3]), np.array([4e-4, 6e-4, 0.0])
    parts = np.array([scatter_by_definition(*one) for one in zip(tracks, D, theta, strict=True)])
    each = excess_scatter_of_each(tracks, D, theta)
    np.testing.assert_allclose(each, 1 + np.maximum(parts[:, 0] / parts[:, 1], 0), rtol=1e-9)
    assert each.max() > 1.2
    parts = np.array(
        [scatter_by_definition(one, 5e-3, t) for one, t in zip(tracks, theta, strict=True)]
    )
    expected = 1 + parts[:, 0].sum() / parts[:, 1].sum()
    assert excess_scatter(tracks, 5e-3, theta) == pytest.approx(expected, rel=1e-9)
    few = replace(tracks[0].steps, vectors=tracks[0].steps.vectors[:4], duration=np.ones(4))
    assert excess_scatter([replace(tracks[0], steps=few)], 5e-3, theta[:1]) == 1
    # A covariance that is not positive has none.
    assert excess_scatter_of_each(tracks[:1], -np.ones(1), -np.ones(1))[0] == 1
