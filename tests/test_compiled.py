"""The compiled kernels against their numpy twins, and a build without a compiler."""

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from perrin.compiled import compiled_kernels, kernels_in_use, loading
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
