"""Many motions at once give what each of them gives alone."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from perrin import (
    Cluster,
    Confined,
    Noise,
    Spin,
    Switching,
    add_noise,
    analyze,
    diffusion_tensor,
    estimate_diffusion,
    fit_switching,
    simulate_motion,
    track_rotation,
)
from perrin.diffusion import (
    axis_model,
    axis_models,
    brownian_tests,
    brownian_tests_of_each,
    estimate_each,
    estimate_pooled,
    fit_switching_each,
    judge_each,
    judge_motion,
    judge_together,
    principal_steps,
    principal_steps_of_each,
    steps_of,
    steps_of_each,
    tensor_of_each,
)
from perrin.errors import TooFewFramesError
from perrin.run import verdicts

IRREGULAR = Cluster.from_positions([[0, 0, 0], [3, 0, 0], [0, 2, 0], [0, 0, 1]])
TETRAHEDRON = Cluster.tetrahedron(1.5)


def tracked(body, n_frames, seed, *, gaps=(), dynamics=None):
    """Return the motion of a body that was tracked with noise."""
    truth = simulate_motion(
        body, D_R=5e-3, D_T=0.02, dt=0.7, n_frames=n_frames, dynamics=dynamics, rng=seed
    )
    x = add_noise(truth.positions(), sigma=0.03, rng=seed + 100)
    x[list(gaps)] = np.nan
    return track_rotation(x, dt=0.7)


@pytest.fixture(scope="module")
def motions():
    """Bodies of two shapes and two lengths, and one with gaps."""
    return [
        tracked(TETRAHEDRON, 210, 1),
        tracked(IRREGULAR, 210, 2),
        tracked(TETRAHEDRON, 210, 3),
        tracked(TETRAHEDRON, 60, 5, gaps=(7, 50, 51)),
    ]


@pytest.mark.filterwarnings("ignore::perrin.errors.PrecisionWarning")
@pytest.mark.parametrize(
    "noise", [Noise(), Noise("residual"), Noise(0.03, exposure=0.5), Noise(drift=True)], ids=str
)
@pytest.mark.parametrize("quantity", ["rotation", "translation"])
def test_coefficients(motions, quantity, noise):
    """Values, intervals and offsets are those of single estimates, to 1e-9."""
    for one, motion in zip(
        estimate_each(motions, quantity=quantity, noise=noise), motions, strict=True
    ):
        alone = estimate_diffusion(motion, quantity=quantity, noise=noise)
        for name in ("value", "ci68", "ci95", "offset", "offset_stderr", "drift"):
            expected = getattr(alone, name)
            if expected is not None:
                np.testing.assert_allclose(getattr(one, name), expected, rtol=1e-9, atol=1e-15)
        assert one.warnings == alone.warnings


@pytest.mark.parametrize("noise", [Noise(), Noise("residual")], ids=str)
def test_tensors(motions, noise):
    """Tensors, errors and p-values are those of single fits, to 1e-8."""
    for one, motion in zip(tensor_of_each(motions, noise=noise), motions, strict=True):
        alone = diffusion_tensor(motion, noise=noise)
        np.testing.assert_allclose(one.tensor, alone.tensor, rtol=1e-8, atol=1e-12)
        np.testing.assert_allclose(one.stderr, alone.stderr, rtol=1e-7)
        assert one.p_isotropic == pytest.approx(alone.p_isotropic, rel=1e-7)
        assert one.p_axial == pytest.approx(alone.p_axial, rel=1e-7)
        assert one.symmetry == alone.symmetry


@pytest.mark.parametrize("frame", ["body", "lab", "mean"])
@pytest.mark.parametrize("quantity", ["rotation", "translation"])
def test_steps(motions, quantity, frame):
    """Steps, their noise and steady motion are those of each motion alone, to rounding."""
    copies = [replace(motion) for motion in motions]  # no steps are known of them
    plain = steps_of_each(copies, quantity)
    turned = principal_steps_of_each(copies, quantity, frame=frame)
    for motion, *together in zip(motions, plain, turned, strict=True):
        own = replace(motion)
        alone = steps_of(own, quantity), principal_steps(own, quantity, frame=frame)
        for one, expected in zip(together, alone, strict=True):
            for name in ("vectors", "duration", "noise", "steady"):
                found, wanted = getattr(one, name), getattr(expected, name)
                np.testing.assert_allclose(found, wanted, rtol=1e-12, atol=1e-15)
            assert one.complete == pytest.approx(expected.complete, rel=1e-12)
            assert (one.freedom, one.even) == (expected.freedom, expected.even)


@pytest.mark.parametrize("quantity", ["rotation", "translation"])
def test_tests_against_diffusion(motions, quantity):
    """p-values are those of single tests, to 1e-9."""
    each = axis_models(motions[:3], quantity, Noise())
    for (_, y), motion in zip(each, motions, strict=False):
        np.testing.assert_allclose(y, axis_model(motion, quantity, Noise())[1], rtol=1e-12)
    for one, alone in zip(brownian_tests_of_each(each), each, strict=True):
        expected = brownian_tests(*alone)
        assert one.p == pytest.approx(expected.p, rel=1e-9)
        np.testing.assert_allclose(one.u, expected.u, rtol=1e-9)
        assert one.ranked == expected.ranked


@pytest.mark.filterwarnings("ignore::perrin.errors.PrecisionWarning")
def test_verdicts_of_parts():
    """Motions that are judged in two parts have the verdicts, alone and together, of one call."""
    dynamics = (Spin(0.1), None, Spin(0.2), Confined(4.0), Spin(0.1), Switching(20.0, 40.0))
    some = [tracked(TETRAHEDRON, 210, k, dynamics=one) for k, one in enumerate(dynamics)]
    parts = [
        one
        for part in (some[:2], some[2:])
        for one in judge_each(part, quantity="rotation", noise=Noise())
    ]
    together = judge_together(some, parts, noise=Noise())
    for one, motion in [
        *zip((part.verdict for part in parts), some, strict=True),
        (together, some),
    ]:
        expected = judge_motion(motion)
        assert one.p == pytest.approx(expected.p, rel=1e-9)
        for name in ("kind", "frames", "n_frames", "text"):
            assert getattr(one, name) == getattr(expected, name)
    assert together.kind == "spin"
    assert [one.kind for one in together.each][1:4] == ["diffusion", "spin", "confined"]


def test_motions_that_cannot_be_judged_leave_the_others_together(motions, monkeypatch):
    """One of 20 frames and one at rest have no verdict; the others are judged in one call."""
    seen = []

    def counted(some, **options):
        seen.append(len(some))
        return judge_each(some, **options)

    monkeypatch.setattr(verdicts, "judge_each", counted)
    short = tracked(TETRAHEDRON, 20, 6)
    still = replace(motions[0], center=np.zeros_like(motions[0].center))
    some = [motions[0], short, still, motions[2]]
    judged = verdicts.judge_alone(some, quantity="translation", noise=Noise())
    assert [one is None for one in judged] == [False, True, True, False]
    assert seen == [2]
    alone = judge_each([motions[2]], quantity="translation", noise=Noise())[0]
    assert judged[3].verdict.text == alone.verdict.text
    assert verdicts.judge_pool(some, judged, noise=Noise()).n_frames == 420
    assert verdicts.judge_pool(some[1:], judged[1:], noise=Noise()) is judged[3].verdict


def test_a_motion_without_an_estimate_does_not_stop_the_others(motions):
    """Its place holds the error that it raises alone."""
    short = tracked(TETRAHEDRON, 2, 6)
    first, second = estimate_each([short, motions[0]], quantity="rotation", noise=Noise())
    assert isinstance(first, TooFewFramesError)
    assert second.value > 0
    error, tensor = tensor_of_each([short, motions[0]], noise=Noise())
    assert isinstance(error, TooFewFramesError)
    assert tensor.n_frames == 210


def rows_of(cluster, body, n_frames, *, seed, first=0, gaps=0.0, swapped=None, stretch=1.0):
    """Return the rows of one cluster, perhaps with gaps, exchanged labels or a stretched z."""
    rng = np.random.default_rng(seed)
    truth = simulate_motion(body, D_R=5e-3, D_T=0.02, dt=0.7, n_frames=n_frames, rng=rng)
    x = add_noise(truth.positions(), sigma=0.03, rng=rng) * [1.0, 1.0, stretch] + 20.0 * cluster
    if swapped is not None:
        x[swapped:, [0, 1]] = x[swapped:, [1, 0]]
    frame, particle = np.nonzero(rng.random(x.shape[:2]) >= gaps)
    columns = {"frame": frame + first, "particle": particle + 10 * cluster, "cluster": cluster}
    return pd.DataFrame(columns | dict(zip("xyz", x[frame, particle].T, strict=True)))


@pytest.fixture(scope="module")
def unlike_clusters():
    """Tables of bodies of several shapes, with gaps, exchanged labels and other lengths."""
    return [
        rows_of(0, TETRAHEDRON, 210, seed=2, gaps=0.05),
        rows_of(1, IRREGULAR, 210, seed=3, swapped=40),
        rows_of(2, TETRAHEDRON, 210, seed=4, stretch=1.2),
        rows_of(3, TETRAHEDRON, 20, seed=5, first=6, gaps=0.1),
        rows_of(4, Cluster.touching(5, 2.0), 20, seed=6, gaps=0.03),
    ]


def numbers_of(result):
    """Return all numbers of a cluster's fit and of its coefficients, by name."""
    motion, quality = result.motion, result.quality.to_dict()
    numbers = {
        name: getattr(motion, name)
        for name in ("rotation", "center", "covariance", "center_variance", "residual", "template")
    }
    numbers |= {name: value for name, value in quality.items() if isinstance(value, int | float)}
    numbers |= {"sigma_xyz": quality["sigma_xyz"] or np.nan, "sigma": motion.sigma}
    for name, D in (("D_R", result.D_R), ("D_T", result.D_T)):
        numbers |= {f"{name} {key}": getattr(D, key) for key in ("value", "ci68", "ci95", "offset")}
    for quantity, verdict in result.verdicts.items():
        numbers |= {f"{quantity} {test}": p for test, p in (verdict.p if verdict else {}).items()}
    return numbers


@pytest.mark.usefixtures("no_tensors", "no_verdicts")
def test_a_table_of_unlike_clusters_is_each_of_them_alone(unlike_clusters):
    """Fits, quality and coefficients are those of tables of one cluster, to 1e-9.

    Tensors are compared in `test_tensors`, p-values in `test_tests_against_diffusion` (and with
    --long here).
    """
    together = analyze(pd.concat(unlike_clusters, ignore_index=True), dt=0.7)
    found = {one.cluster: one for one in together.clusters}
    assert sorted(found) == list(range(5))
    for number, table in enumerate(unlike_clusters):
        alone = analyze(table, dt=0.7).clusters[0]
        one = found[number]
        assert one.quality.symmetry == alone.quality.symmetry
        assert one.quality.reasons == alone.quality.reasons
        assert one.quality.swaps == alone.quality.swaps
        assert one.motion.reason == alone.motion.reason
        expected = numbers_of(alone)
        for name, value in numbers_of(one).items():
            np.testing.assert_allclose(
                value, expected[name], rtol=1e-9, atol=1e-12, err_msg=f"cluster {number}: {name}"
            )
    assert found[1].quality.swaps == (40,)
    assert found[2].quality.z_scale == pytest.approx(1.2, abs=0.05)


def test_two_states_of_several_motions_are_those_of_each_alone():
    """Coefficients, rates and state probabilities are those of single fits, to 1e-9."""
    motions = [
        tracked(TETRAHEDRON, n_frames, seed, dynamics=Switching(10, dwell=20.0))
        for n_frames, seed in ((90, 1), (90, 2), (70, 3))
    ]
    found = fit_switching_each([[m] for m in motions], quantity="rotation", noise=Noise())
    for one, motion in zip(found, motions, strict=True):
        alone = fit_switching(motion)
        for name in ("D_slow", "D_fast", "dwell_slow", "dwell_fast"):
            expected = getattr(alone, name)
            assert getattr(one, name).value == pytest.approx(expected.value, rel=1e-9)
        np.testing.assert_allclose(one.probability[0], alone.probability[0], rtol=1e-8, atol=1e-12)


@pytest.mark.filterwarnings("ignore::perrin.errors.PrecisionWarning")
def test_pooling_from_the_estimates_of_each_is_pooling(motions):
    """The pooled D and the test of a common D are those of `estimate_diffusion`, to 1e-9."""
    each = estimate_each(motions, quantity="rotation", noise=Noise())
    one = estimate_pooled(motions, each, quantity="rotation", noise=Noise())
    alone = estimate_diffusion(motions)
    assert one.value == pytest.approx(alone.value, rel=1e-9)
    assert one.p_same == pytest.approx(alone.p_same, rel=1e-8)
