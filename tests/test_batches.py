"""Many motions at once give what each of them gives alone."""

import numpy as np
import pytest

from perrin import (
    Cluster,
    Noise,
    add_noise,
    diffusion_tensor,
    estimate_diffusion,
    simulate_motion,
    track_rotation,
)
from perrin.diffusion import (
    axis_model,
    brownian_tests,
    brownian_tests_of_each,
    estimate_each,
    tensor_of_each,
)
from perrin.errors import TooFewFramesError

IRREGULAR = Cluster.from_positions([[0, 0, 0], [3, 0, 0], [0, 2, 0], [0, 0, 1]])
TETRAHEDRON = Cluster.tetrahedron(1.5)


def tracked(body, n_frames, seed, *, gaps=()):
    """Return the motion of a body that was tracked with noise."""
    truth = simulate_motion(body, D_R=5e-3, D_T=0.02, dt=0.7, n_frames=n_frames, rng=seed)
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
        tracked(IRREGULAR, 120, 4),
        tracked(TETRAHEDRON, 120, 5, gaps=(7, 50, 51)),
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


@pytest.mark.parametrize("quantity", ["rotation", "translation"])
def test_tests_against_diffusion(motions, quantity):
    """p-values are those of single tests, to 1e-9."""
    each = [axis_model(motion, quantity, Noise()) for motion in motions[:3]]
    for one, alone in zip(brownian_tests_of_each(each), each, strict=True):
        expected = brownian_tests(*alone)
        assert one.p == pytest.approx(expected.p, rel=1e-9)
        np.testing.assert_allclose(one.u, expected.u, rtol=1e-9)
        assert one.ranked == expected.ranked


def test_a_motion_without_an_estimate_does_not_stop_the_others(motions):
    """Its place holds the error that it raises alone."""
    short = tracked(TETRAHEDRON, 2, 6)
    first, second = estimate_each([short, motions[0]], quantity="rotation", noise=Noise())
    assert isinstance(first, TooFewFramesError)
    assert second.value > 0
    error, tensor = tensor_of_each([short, motions[0]], noise=Noise())
    assert isinstance(error, TooFewFramesError)
    assert tensor.n_frames == 210
