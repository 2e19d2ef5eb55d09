"""The compiled kernels against their numpy twins, and a build without a compiler."""

import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from perrin import Cluster, Noise, simulate_motion, track_rotation
from perrin.compiled import compiled_kernels, kernels_in_use, loading
from perrin.diffusion import (
    NoisySteps,
    SineModes,
    SwitchingSteps,
    mode_sums,
    steps_of,
    switching,
    tensor_modes,
)
from perrin.geometry import rotations
from perrin.images.optics import ball_image, sphere_image
from test_rotations import hard_cases

ROOT = Path(__file__).resolve().parents[1]

compiled = pytest.mark.skipif(
    compiled_kernels() is None, reason="perrin was built without compiled kernels"
)


@pytest.fixture
def both_ways(monkeypatch):
    """Return a function that fits rotations with the kernel and with its numpy twin."""

    def fit(*sets, **options):
        found = rotations.fit_rotations(*sets, **options)
        with monkeypatch.context() as patch:
            patch.setattr(rotations, "compiled_kernels", lambda: None)
            return found, rotations.fit_rotations(*sets, **options)

    return fit


def assert_equal(kernel, twin):
    """Check that the same rows are unique, and that rotations agree to 1e-12."""
    np.testing.assert_array_equal(kernel[1], twin[1])
    np.testing.assert_allclose(kernel[0], twin[0], rtol=0, atol=1e-12)


@compiled
def test_rotations_equal_those_of_numpy_in_hard_cases(both_ways):
    """Planes, mirror images, half turns, extreme units, and sets 1e6 away from the origin."""
    for _, points, reference in hard_cases(60):
        assert_equal(*both_ways(points, reference))
        far = 1e6 * np.abs(points).max()
        kernel, twin = both_ways(points + far, reference)
        assert_equal(kernel, twin)


@compiled
def test_rotations_equal_those_of_numpy_where_particles_are_absent(both_ways):
    """Weights, coordinates that are missing, rows with too few particles, one set for all rows."""
    rng = np.random.default_rng(3)
    body, weights = rng.normal(size=(7, 3)), rng.uniform(0, 2, (203, 7))
    points = body + 0.1 * rng.normal(size=(203, 7, 3))
    assert_equal(*both_ways(points, body, weights=weights))
    assert_equal(*both_ways(body, points, weights=weights[0]))
    points[rng.random(points.shape) < 0.1] = np.nan
    assert_equal(*both_ways(points, body, weights=weights))
    points[5, 2:], points[6, :, 1] = np.nan, np.nan
    kernel, twin = both_ways(points, body)
    assert_equal(kernel, twin)
    assert not kernel[1][[5, 6]].any()
    assert_equal(*both_ways(points.reshape(7, 29, 7, 3), body))
    assert_equal(*both_ways(points[:0], body))


@compiled
def test_rotations_of_lines_and_points_are_not_unique(both_ways):
    """The kernel leaves rows that it cannot decide to the singular value decomposition."""
    line = np.outer([0.0, 1.0, 2.5, 4.0], [1.0, 2.0, 3.0])
    points = np.stack([line, np.zeros((4, 3)), line @ np.diag([-1.0, 1.0, 1.0])])
    kernel, twin = both_ways(points, line)
    assert_equal(kernel, twin)
    assert not kernel[1].any()
    with pytest.raises(ValueError, match="infinite coordinate"):
        rotations.fit_rotations(np.where(points == 0, np.inf, points), line)


@compiled
@pytest.mark.parametrize("spread", [0.0, 0.06])
def test_images_of_spheres_equal_those_of_numpy(monkeypatch, spread):
    """Inside the window, cut by its border and beyond it, for equal and for unequal diameters."""
    image = sphere_image(diameter=2.0, psf=(0.4, 0.15), voxel=(0.25, 0.2, 0.2), spread=spread)
    rng = np.random.default_rng(8)
    mask = rng.random((19, 23, 29)) < 0.6
    centers = rng.uniform(-1, 6, (12, 3))
    centers[:2] = [[2.0, 2.0, 2.0], [40.0, -40.0, 2.0]]
    sizes = rng.normal(scale=spread, size=12)
    kernel = image.on_voxels(mask, centers, sizes, centers[:, 0])
    monkeypatch.setattr(ball_image, "compiled_kernels", lambda: None)
    twin = image.on_voxels(mask, centers, sizes, centers[:, 0])
    assert np.abs(twin).max(axis=(1, 2))[1:].tolist().count(0.0) >= 1
    np.testing.assert_allclose(kernel, twin, rtol=0, atol=1e-12)


@compiled
@pytest.mark.parametrize("axes", [1, 2, 3])
@pytest.mark.parametrize("modes", [1, 5, 130, 1027])
def test_sums_over_modes_equal_those_of_numpy(monkeypatch, axes, modes):
    """With and without second derivatives, of a set for each point and of one set for all.

    512 modes are a block of the kernel. A point whose variances are not positive says so by the
    least of them; its other sums mean nothing.
    """
    rng = np.random.default_rng(axes)
    y, turn = rng.normal(size=(5, axes, modes)), rng.normal(size=(5, axes, axes))
    share, weight = rng.uniform(0.01, 1.2, (5, axes)), np.linspace(0.0, 4.0, modes)
    share[0, 0], share[4, 0] = -0.1, np.nan
    for own in (y, y[:1]):
        for curved in (False, True):
            kernel = mode_sums(own, turn, share, weight, curved=curved)
            with monkeypatch.context() as patch:
                patch.setattr(tensor_modes, "compiled_kernels", lambda: None)
                twin = mode_sums(own, turn, share, weight, curved=curved)
            assert kernel[0, 2] == pytest.approx(twin[0, 2], rel=1e-12)
            assert np.isnan(kernel[4, 2])
            assert np.isnan(twin[4, 2])
            kernel, twin = kernel[:4], twin[:4]
            scale = np.abs(twin[1:]).max(axis=1, keepdims=True)
            np.testing.assert_allclose(kernel[1:] / scale, twin[1:] / scale, rtol=0, atol=1e-12)


@compiled
@pytest.mark.parametrize("axes", [1, 2, 3])
def test_curvatures_equal_those_of_numpy(monkeypatch, axes):
    """Of symmetric slopes, of sums that are symmetric in two axes as those over modes are."""
    rng = np.random.default_rng(axes)
    turn = rng.normal(size=(4, axes, axes))
    same, after = rng.normal(size=(2, 4, 5, axes, axes))
    same, after = same + np.swapaxes(same, 2, 3), after + np.swapaxes(after, 2, 3)
    weight = np.linspace(0.0, 4.0, 20)
    sums = mode_sums(
        rng.normal(size=(4, axes, 20)), turn, rng.uniform(0.1, 1, (4, axes)), weight, curved=True
    )[:, 3 + 2 * axes**2 :]
    power = sums[:, : 3 * axes**3].reshape(4, axes, axes, 3, axes)
    trace = sums[:, 3 * axes**3 :].reshape(4, axes, 3, axes)
    kernel = tensor_modes.information(turn, same, after, power, trace)
    monkeypatch.setattr(tensor_modes, "compiled_kernels", lambda: None)
    twin = tensor_modes.information(turn, same, after, power, trace)
    np.testing.assert_allclose(kernel, twin, rtol=0, atol=1e-12 * np.abs(twin).max())


@compiled
def test_spectra_of_steps_equal_those_of_numpy():
    """Of several motions at several points, down to the least variance, and of unequal axes."""
    rng = np.random.default_rng(4)
    motions = [
        simulate_motion(Cluster.tetrahedron(1.5), D_R=5e-3, dt=0.7, n_frames=150, rng=seed)
        for seed in range(4)
    ]
    modes = SineModes.of(
        [NoisySteps.of(steps_of(m, "rotation"), Noise()) for m in motions], [*range(4)]
    )
    mixed = replace(modes, count=np.tile([1.0, 2.0], modes.count.size // 2))
    for one in (modes, mixed):
        D, theta = 5e-3 * rng.uniform(0.1, 3, (2, 3, 4)), 1e-3 * rng.uniform(0, 2, (2, 3, 4))
        D[0, 0], theta[0, 0] = 0.0, 0.0
        D[1, 2, 3] = np.nan
        pairs = zip(one.sums(D, theta), one.sums_of_numpy(D, theta), strict=True)
        for kernel, twin in pairs:
            np.testing.assert_allclose(kernel, twin, rtol=1e-12)


@compiled
@pytest.mark.parametrize("quantity", ["rotation", "translation"])
@pytest.mark.parametrize("exposure", [None, 0.5])
def test_two_states_equal_those_of_numpy(monkeypatch, quantity, exposure):
    """With gaps, unequal noise of frames and axes, noise from residuals and unknown noise.

    The track is longer than the block after which logarithms are taken, and one of the points that
    are filtered at once is not a number.
    """
    rng = np.random.default_rng(5)
    truth = simulate_motion(
        Cluster.from_positions([[0, 0, 0], [3, 0, 0], [0, 1, 0], [0, 0, 1.5]]),
        D_R=5e-3, D_T=0.02, dt=0.7, n_frames=700, rng=7,
    )  # fmt: skip
    positions = truth.positions() + 0.05 * rng.normal(size=(700, 4, 3))
    positions[rng.random(700) < 0.1] = np.nan
    positions[20:40, 0] = np.nan
    motion = track_rotation(positions, dt=0.7)
    points = np.log(
        [[2e-3, 8e-3, 0.1, 0.2, 1e-3], [1e-3, 0.5, 3.0, 1e-3, 1e-9], [np.nan] * 5,
         [1e-9, 1e-3, 1e-6, 1e3, 1e-5], [5e-3, 5e-3, 1.0, 1.0, 1e-4]]
    )  # fmt: skip
    for model in ("joint", "residual"):
        noise = Noise(model=model, exposure=exposure)
        track = NoisySteps.of(steps_of(motion, quantity), noise)
        steps = SwitchingSteps.of(track, motion.time, exposed=(exposure or 0.0) * 0.7 / 3)
        kernel = steps.filtered(points)
        with monkeypatch.context() as patch:
            patch.setattr(switching, "compiled_kernels", lambda: None)
            twin = steps.filtered(points)
        assert np.isnan(kernel[0]).tolist() == [False, False, True, False, False]
        np.testing.assert_allclose(kernel[0], twin[0], rtol=1e-12)
        np.testing.assert_allclose(kernel[1], twin[1], rtol=1e-9, atol=1e-12)


@compiled
def test_the_kernels_refuse_arrays_that_do_not_fit():
    """A wrong number of rows or type is an error, not a read beyond the array."""
    kernels = compiled_kernels()
    points, rotation, certain = np.zeros((5, 4, 3)), np.empty((5, 3, 3)), np.empty(5, np.bool_)
    for wrong in ((points[:3], points), (points, points[0, :3]), (points[0, 0], points)):
        with pytest.raises(ValueError, match="expected points"):
            kernels.wahba(*wrong, rotation, certain, None)
    with pytest.raises(ValueError, match="expected points"):
        kernels.wahba(points, points, rotation[:4], certain, None)
    with pytest.raises(TypeError, match="float64"):
        kernels.wahba(points.astype(np.float32), points, rotation, certain, None)
    with pytest.raises((BufferError, ValueError)):
        kernels.wahba(points[:, ::2], points[:, ::2], rotation, certain, None)
    mask, three, table = np.ones((3, 4, 5), np.bool_), np.ones(3), np.zeros((1, 9, 9))
    for out in (np.empty((1, 4, 59)), np.empty((2, 4, 60)), np.empty((1, 3, 60))):
        with pytest.raises(ValueError, match="expected mask"):
            kernels.spots(mask, three[None], three, three, three[:2], table, out)
    with pytest.raises(TypeError, match="5 arrays"):
        kernels.mode_sums(three, three)
    y, turn, share, weight = np.ones((2, 3, 7)), np.ones((2, 3, 3)), np.ones((2, 3)), np.ones(7)
    short = np.ones((2, 3, 6))
    for modes, w, n in (
        (short, weight, 21),
        (y, weight[:6], 21),
        (y, weight, 22),
        (y[0], weight, 21),
    ):
        with pytest.raises(ValueError, match="expected modes"):
            kernels.mode_sums(modes, turn, share, w, np.ones((2, n)))
    slopes, power, trace = np.ones((2, 4, 3, 3)), np.ones((2, 3, 3, 3, 3)), np.ones((2, 3, 3, 3))
    for wrong in ((turn[:1], slopes, power, trace, 4), (turn, slopes[:, :3], power, trace, 4),
                  (turn, slopes, power[:1], trace, 4), (turn, slopes, power, trace[:1], 4),
                  (turn, slopes, power, trace, 3)):  # fmt: skip
        with pytest.raises(ValueError, match="expected axes"):
            kernels.curvatures(*map(np.ascontiguousarray, (wrong[0], slopes, *wrong[1:4])),
                               np.ones((2, wrong[4], 4)))  # fmt: skip
    rows, place = np.ones((2, 7)), np.ones((1, 2))
    for sums in (np.ones((1, 2, 10)), np.ones((2, 2, 11)), np.ones((1, 3, 11))):
        with pytest.raises(ValueError, match="expected power"):
            kernels.spectrum_sums(rows, rows, rows, rows, rows, place, place, sums)
    clock, sizes, points = np.ones((3, 7)), np.ones(3), np.ones((2, 5))
    for vectors, noise, pairs in (
        (np.ones((7, 2)), np.ones((4, 7, 3)), np.ones((7, 2, 2))),
        (np.ones((7, 3)), np.ones((4, 6, 3)), np.ones((7, 2, 2))),
        (np.ones((7, 3)), np.ones((4, 7, 3)), np.ones((6, 2, 2))),
    ):
        with pytest.raises(ValueError, match="expected vectors"):
            kernels.two_states(vectors, noise, clock, sizes, np.ones(2), points, pairs, np.ones(2))


def test_the_environment_chooses_numpy(monkeypatch):
    """PERRIN_COMPILED=0 takes the twin, and the diagnosis says so."""
    monkeypatch.setenv("PERRIN_COMPILED", "0")
    loading.compiled_kernels.cache_clear()
    try:
        assert compiled_kernels() is None
        assert kernels_in_use().endswith("PERRIN_COMPILED=0 is in the environment")
    finally:
        monkeypatch.undo()
        loading.compiled_kernels.cache_clear()


def test_a_build_without_a_compiler_says_so_in_one_line(tmp_path, monkeypatch):
    """It succeeds without kernels, and older ones do not remain."""
    folder = tmp_path / "src" / "perrin" / "compiled"
    folder.mkdir(parents=True)
    shutil.copy(ROOT / "src" / "perrin" / "compiled" / "kernels.c", folder)
    shutil.copy(ROOT / "hatch_build.py", tmp_path)
    (folder / "kernels.abi3.so").write_bytes(b"older")
    monkeypatch.setenv("CC", "false")
    done = subprocess.run(
        [sys.executable, tmp_path / "hatch_build.py"], capture_output=True, text=True, check=True
    )
    (line,) = done.stdout.splitlines()
    assert line.startswith("perrin is built without compiled kernels, numpy does their work: ")
    assert [path.name for path in folder.iterdir()] == ["kernels.c"]
