"""Rendered movies have the intended shapes, intensities, losses, motion and noise."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import erf

from perrin import Cluster, render_stack, simulate_motion
from perrin.images.optics import Camera, Light, Scan, render
from perrin.images.optics.render import blurred_ball

VOXEL, PSF, BALL = (0.25, 0.2, 0.2), (0.4, 0.15, 0.15), 2.45
SHAPE = (32, 28, 30)
MIDDLE = [3.01, 2.77, 4.03]
BARE = {
    "voxel": VOXEL,
    "psf": PSF,
    "diameter": BALL,
    "shape": SHAPE,
    "background": 0.0,
    "noise": False,
    "dtype": "float64",
    "rng": 1,
}


def sampled_ball(points, radius, psf, step):
    """Sum a ball cut into columns along z, exact in z, over a fine grid in x and y."""
    n = np.arange(-radius + step / 2, radius, step)
    y, x = (a.ravel() for a in np.meshgrid(n, n, indexing="ij"))
    inside = y**2 + x**2 < radius**2
    y, x = y[inside], x[inside]
    half = np.sqrt(radius**2 - y**2 - x**2)
    values = []
    for pz, py, px in points:
        across = np.exp(-0.5 * (((px - x) / psf[2]) ** 2 + ((py - y) / psf[1]) ** 2))
        root = np.sqrt(2) * psf[0]
        along = 0.5 * (erf((pz + half) / root) - erf((pz - half) / root))
        values.append((across * along).sum() * step**2 / (2 * np.pi * psf[1] * psf[2]))
    return np.array(values)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"diameter": 2450.0}, "a sphere of 2450 um is larger than the stack, which is"),
        ({"psf": (1e-4, 1e-4, 1e-4)}, "a point spread of 0.0001 um is too narrow for a sphere of"),
    ],
)
def test_spheres_in_another_unit_are_refused(changed, message):
    """They are refused before their image is tabulated, which would take terabytes."""
    with pytest.raises(ValueError, match=message):
        render_stack([[MIDDLE]], **{**BARE, **changed})


@pytest.mark.parametrize(
    ("radius", "psf"),
    [
        (1.225, (0.4, 0.15, 0.15)),
        (0.6, (0.4, 0.15, 0.15)),
        (0.6, (0.3, 0.12, 0.2)),
        (0.1, (0.3, 0.2, 0.2)),
        (1.225, (0.2, 0.2, 0.2)),
    ],
)
def test_a_sphere_is_exact(radius, psf):
    """It equals a sum of columns 5 nm wide, whose own error is at most 3e-4 of the peak."""
    rng = np.random.default_rng(2)
    offsets = tuple(rng.uniform(-1, 1, 2) * (radius + 2 * s) for s in psf)
    z, y, x = offsets
    image = blurred_ball(
        (z, np.tile(y, (2, 1)), np.tile(x, (2, 1))), radius=radius, psf=np.array(psf)
    )
    points = np.stack(np.meshgrid(*offsets, indexing="ij"), axis=-1).reshape(-1, 3)
    wanted = sampled_ball(points, radius, psf, 0.005)
    peak = sampled_ball([(0, 0, 0)], radius, psf, 0.005)
    np.testing.assert_allclose(image.ravel(), wanted, atol=5e-4 * peak.item())


def test_intensity_is_conserved_and_centred_on_the_sphere():
    """The sum is the volume of the ball, the centroid its centre, the maximum as stated."""
    frame = render_stack([[MIDDLE]], photons=40.0, **BARE).frame(0)
    one = np.zeros((1, 1))
    peak = blurred_ball((one[0], one, one), radius=BALL / 2, psf=np.array(PSF)).item()
    volume = np.pi / 6 * BALL**3 / np.prod(VOXEL)
    # The voxel grid is a trapezoidal rule: exact to exp(-2 pi^2 sigma^2 / h^2) = 2e-5 in x and y;
    # tails are cut at 5 sigma.
    assert frame.sum() == pytest.approx(40 / peak * volume, rel=1e-5)
    centre = [
        (np.arange(n) * h * frame.sum(axis=tuple({0, 1, 2} - {a}))).sum() / frame.sum()
        for a, (n, h) in enumerate(zip(SHAPE, VOXEL, strict=True))
    ]
    np.testing.assert_allclose(centre[::-1], MIDDLE, atol=1e-5)
    centred = render_stack([[[3.0, 2.8, 4.0]]], **BARE).frame(0)
    assert centred[16, 14, 15] == pytest.approx(40.0, rel=1e-12)


def test_spheres_add_and_turn_with_their_body():
    """A cluster is the sum of its spheres, wherever its origin is."""
    truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=0.1, D_T=0.1, dt=1, n_frames=3, rng=1)
    body = render_stack(truth, centers=[MIDDLE], **BARE)
    spheres = [render_stack(truth.positions()[:, [n]] + MIDDLE, dt=1, **BARE) for n in range(4)]
    for i in range(3):
        np.testing.assert_allclose(
            body.frame(i), sum(s.frame(i) for s in spheres), atol=1e-9, rtol=1e-9
        )
    # A border through a sphere leaves the inner part unchanged.
    cut = render_stack([[MIDDLE]], **{**BARE, "shape": (20, 12, 14)}).frame(0)
    whole = render_stack([[MIDDLE]], **BARE).frame(0)
    np.testing.assert_allclose(cut, whole[:20, :12, :14], atol=1e-12)
    outside = render_stack([[[-50.0, 2.0, 2.0]]], **BARE).frame(0)
    assert outside.max() == 0


def test_core_is_a_smaller_ball():
    core = render_stack([[MIDDLE]], core=1.2, **BARE).frame(0)
    ball = render_stack([[MIDDLE]], **{**BARE, "diameter": 1.2}).frame(0)
    np.testing.assert_array_equal(core, ball)


def test_bleaching_depth_and_background():
    """30 % lost in the last frame, 15 % in the last plane, a background with a gradient."""
    points = [[[3.0, 2.8, 4.0]]] * 5
    plain = render_stack(points, dt=1, **BARE).frame(0)
    faded = render_stack(points, dt=1, bleaching=0.3, depth_loss=0.15, **BARE)
    depth = 0.85 ** (np.arange(32) / 31)[:, None, None]
    for i in range(5):
        np.testing.assert_allclose(faded.frame(i), plain * depth * 0.7 ** (i / 4), atol=1e-12)
    sloping = {**BARE, "background": 3.0, "gradient": (0.1, -0.2, 0.3)}
    background = render_stack(points, dt=1, **sloping).frame(0) - plain
    assert background.mean() == pytest.approx(3.0, rel=1e-12)
    slopes = [np.diff(background, axis=a) / VOXEL[a] for a in range(3)]
    for slope, wanted in zip(slopes, (0.1, -0.2, 0.3), strict=True):
        np.testing.assert_allclose(slope, wanted, atol=1e-11)


def test_planes_are_recorded_one_after_another():
    """Plane k of a scanned sphere is plane k of a still one where it was at that moment."""
    path = np.array([[MIDDLE], [[4.0, 3.0, 4.5]]])
    scanned = render_stack(path, dt=1.0, plane_time=0.02, times=[0.1], **BARE)
    assert scanned.plane_time == 0.02
    for k in (12, 16, 20):
        part = 0.1 + 0.02 * k
        still = render_stack([path[0] + part * (path[1] - path[0])], **BARE).frame(0)
        np.testing.assert_allclose(
            scanned.frame(0)[k], still[k], atol=4e-5
        )  # tails are cut at 5 sigma


def test_blur_is_the_mean_over_the_exposure():
    """A sphere that moves evenly is blurred as by the erf of the path; turns are the shortest."""
    path = np.array([[MIDDLE], [np.add(MIDDLE, [0.8, 0.0, 0.0])]])
    blurred = render_stack(path, dt=1.0, times=[0.0], exposure=1.0, substeps=16, **BARE).frame(0)
    moments = [path[0] + u * (path[1] - path[0]) for u in (np.arange(25) + 0.5) / 25]
    mean = np.mean([render_stack([m], **BARE).frame(0) for m in moments], axis=0)
    # Midpoints h = 0.05 um apart: h^2 f'' / 24, with f'' at most 40 photons / sigma^2.
    np.testing.assert_allclose(blurred, mean, atol=40 * 0.05**2 / 0.15**2 / 12)
    still = render_stack(path, dt=1.0, times=[0.0], **BARE).frame(0)
    assert np.abs(blurred - still).max() > 5


def test_turns_between_frames_are_the_shortest():
    """Half-way in time between two orientations the body has made half the rotation."""
    truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=0.2, D_T=0.0, dt=1, n_frames=2, rng=3)
    from perrin.geometry.rotations import exp_map, log_map

    half = exp_map(0.5 * log_map(truth.rotation[1])) @ truth.rotation[0]
    turned = truth.template @ half.T + MIDDLE
    between = render_stack(truth, centers=[MIDDLE], times=[0.5], **BARE).frame(0)
    np.testing.assert_allclose(between, render_stack([turned], **BARE).frame(0), atol=1e-9)


def test_camera_statistics():
    """Mean gain * photons + offset; variance gain^2 * photons + read noise^2 + rounding."""
    stack = render_stack(
        np.full((1, 1, 3), np.nan), voxel=VOXEL, psf=PSF, diameter=BALL, shape=(40, 80, 80),
        background=5.0, gain=3.0, offset=100.0, read_noise=2.0, rng=4,
    )  # fmt: skip
    counts = stack.frame(0).astype(float)
    n = counts.size
    variance = 9 * 5 + 4 + 1 / 12
    assert counts.mean() == pytest.approx(115, abs=4 * np.sqrt(variance / n))
    # Excess kurtosis of the Poisson part: under 0.2, so var(s^2) < 2.2 variance^2 / n.
    assert counts.var() == pytest.approx(variance, abs=4 * variance * np.sqrt(2.2 / n))
    bright = render_stack([[[3.0, 2.8, 4.0]]], **{**BARE, "dtype": "uint8"}, gain=10).frame(0)
    assert (bright.dtype, bright.max()) == (np.uint8, 255)


def test_frames_depend_on_the_seed_alone():
    """Frame i is the same in any order and in any process; another seed gives another movie."""
    import pickle

    args = {**BARE, "noise": True, "dtype": "uint16", "drop": 0.3, "spread": 0.1}
    points = np.tile(np.array([[MIDDLE]]), (4, 1, 1))
    one, two = (render_stack(points, dt=1, **args) for _ in range(2))
    forward = [one.frame(i) for i in range(4)]
    sent = pickle.loads(pickle.dumps(two))
    for i in (3, 1, 0, 2):
        np.testing.assert_array_equal(two.frame(i), forward[i])
        np.testing.assert_array_equal(sent.frame(i), forward[i])
    other = render_stack(points, dt=1, **{**args, "rng": 2})
    assert any((other.frame(i) != forward[i]).any() for i in range(4))


def test_dropped_and_missing_particles():
    """About a third of the spheres is dark in each frame; a NaN is not drawn, its neighbour is."""
    points = np.array([[[1.0 + 2.0 * i, 2.0, 4.0] for i in range(60)]] * 5)
    wide = {**BARE, "shape": (17, 20, 620), "diameter": 1.0}
    stack = render_stack(points, dt=1, drop=1 / 3, **wide)
    centre = 5 + 10 * np.arange(60)
    seen = np.array([stack.frame(i)[16, 10, centre] > 20 for i in range(5)])
    assert seen.mean() == pytest.approx(2 / 3, abs=4 * np.sqrt(2 / 9 / seen.size))
    points[1, 3] = np.nan
    bright = [render_stack(points, dt=1, **wide).frame(i)[16, 10, centre] > 20 for i in range(3)]
    assert [np.flatnonzero(~row).tolist() for row in bright] == [[], [3], []]


def test_brightness_spreads_as_stated():
    points = np.array([[[1.0 + 2.0 * i, 2.0, 4.0] for i in range(200)]])
    frame = render_stack(
        points, spread=0.1, photons=40.0, **{**BARE, "shape": (17, 20, 2020), "diameter": 1.0}
    ).frame(0)
    peaks = frame[16, 10, 5 + 10 * np.arange(200)]
    assert peaks.mean() == pytest.approx(40, abs=4 * 4 / np.sqrt(200))
    assert peaks.std() == pytest.approx(4, rel=4 / np.sqrt(400))


@pytest.mark.filterwarnings("ignore:The inplace keyword")  # trackpy with pandas 3
def test_trackpy_finds_isolated_spheres_where_they_were_planted():
    """At 100 photons a centroid in a mask that contains ball and PSF is near the noise floor.

    The floor is 2.2 nm in x and y and 3.0 nm in z (Fisher information of this image model); 18
    spheres know an rms to 17 %.
    """
    trackpy = pytest.importorskip("trackpy")
    rng = np.random.default_rng(5)
    grid = np.stack(np.meshgrid([3, 8, 13], [3, 8, 13], [4, 9]), axis=-1).reshape(-1, 3)
    planted = grid + rng.uniform(-0.1, 0.1, grid.shape)
    stack = render_stack(
        planted[None], voxel=VOXEL, psf=PSF, diameter=BALL, shape=(52, 80, 80), photons=100.0,
        background=2.0, gain=3.0, read_noise=2.0, rng=6,
    )  # fmt: skip
    found = trackpy.locate(
        stack.frame(0), (15, 17, 17), separation=(8, 9, 9), percentile=95, characterize=False
    )
    found = found[found["mass"] > 0.5 * found["mass"].max()]
    places = found[["x", "y", "z"]].to_numpy() * np.array(VOXEL[::-1])
    nearest = np.linalg.norm(places[:, None] - planted, axis=2).argmin(axis=1)
    assert sorted(nearest) == list(range(18))
    error = places - planted[nearest]
    rms = np.sqrt((error**2).mean(axis=0))
    assert np.all(rms < 1.6 * np.array([0.0022, 0.0022, 0.0030]))


def test_the_work_of_a_frame_follows_its_spheres(monkeypatch):
    """Voxels are computed around the spheres alone, however large the field is."""
    drawn = []

    def counted(offsets, **shape):
        image = blurred_ball(offsets, **shape)
        drawn.append(image.size)
        return image

    truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=0, D_T=0, dt=0.7, n_frames=1, rng=1)
    monkeypatch.setattr(render, "blurred_ball", counted)
    frames = {**BARE, "shape": (64, 160, 160)}
    stack = render_stack(truth, centers=[[8, 8, 8.0]], **frames)
    drawn.clear()
    stack.frame(0)
    reach = BALL / 2 + 5 * np.array(PSF)
    assert len(drawn) == 4
    assert max(drawn) <= np.prod(2 * reach / VOXEL + 1)


def test_options_are_stated_in_objects_or_as_keywords():
    """Both ways give the same pixels; both at once, and unknown keywords, are refused."""
    light = {"photons": 55.0, "spread": 0.1, "gradient": (0.1, 0.0, 0.2), "bleaching": 0.2}
    scan = {"plane_time": 0.002, "exposure": 0.1, "substeps": 3}
    camera = {"gain": 3.0, "offset": 10.0, "read_noise": 2.0, "dtype": "float32"}
    path = np.array([[MIDDLE], [np.add(MIDDLE, 0.3)], [MIDDLE]])
    fixed = {"voxel": VOXEL, "psf": PSF, "diameter": BALL, "shape": SHAPE, "rng": 3, "dt": 1.0}
    one = render_stack(
        path, light=Light(**light), scan=Scan(**scan), camera=Camera(**camera), **fixed
    )
    other = render_stack(path, **light, **scan, **camera, **fixed)
    np.testing.assert_array_equal(one.frame(1), other.frame(1))
    assert (one.plane_time, one.dtype) == (other.plane_time, other.dtype) == (0.002, np.float32)
    with pytest.raises(ValueError, match=r"photons: stated in light=.*gain: stated in camera="):
        render_stack(path, light=Light(), photons=3.0, camera=Camera(), gain=2.0, **fixed)
    with pytest.raises(ValueError, match=r"scan: expected Scan\(\.\.\.\), got 0.1"):
        render_stack(path, scan=0.1, **fixed)
    with pytest.raises(TypeError, match=r"unknown keyword 'photon'; the nearest .* 'photons'"):
        render_stack(path, photon=3.0, **fixed)


@pytest.mark.parametrize(
    "options",
    [
        Light(photons=12.5, gradient=np.array([0.1, 0.0, -0.2])),
        Scan(plane_time=0.01, substeps=3),
        Camera(noise=False, dtype="uint8"),
    ],
)
def test_options_survive_json(options):
    """What `from_dict` reads from the JSON of `to_dict` equals the original."""
    assert type(options).from_dict(json.loads(json.dumps(options.to_dict()))) == options


def test_the_variance_model_of_the_camera_is_its_variance():
    """Grey levels of equal voxels vary by gain times the mean plus floor, four standard errors."""
    camera = Camera(gain=3.0, offset=100.0, read_noise=2.0, dtype="float64")
    photons, rng = np.full(40000, 9.0), np.random.default_rng(4)
    grey, model = camera.grey_levels(photons, rng), camera.variance_model()
    variance = 1 / model.weight(np.full(1, 100.0 + 3.0 * 9.0))[0]
    assert variance == 9 * 9 + 4
    assert grey.var() == pytest.approx(variance, rel=4 * np.sqrt(2.2 / photons.size))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"voxel": (0.2, 0.2)}, "voxel: expected three lengths"),
        ({"psf": (0.0, 0.2, 0.2), "diameter": -1}, "psf: .*diameter: expected a finite number > 0"),
        ({"shape": (0, 5, 5)}, "shape: expected three whole numbers"),
        ({"voxel": (-1, 1, 1), "gain": 0, "substeps": 0}, "substeps: .*gain: .*voxel: "),
        ({"gradient": (1, 2)}, "gradient: expected three finite numbers"),
        ({"dtype": "int8"}, "dtype: expected 'uint8', 'uint16'"),
        ({"bleaching": 1.0, "photons": -1}, "photons: .*>= 0.*bleaching: .*< 1"),
        ({"core": 3.0}, "core: 3.0 um is more than diameter"),
        ({"gradient": (1, 0, 0)}, "gradient takes the background down to"),
        ({"times": [0.0, 5.0]}, "times: frames of 0 s from 0 to 5 s are not within"),
        ({"times": [1.0, 0.0]}, "growing"),
        ({"exposure": 9.0}, "a frame takes 9 s, longer than the motion"),
        ({"centers": [0, 0, 0]}, r"centers: expected shape \(1, 3\)"),
        ({"dt": None}, "positions: expected"),
    ],
)
def test_bad_values_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        render_stack(np.tile(MIDDLE, (3, 1, 1)), **{**BARE, "dt": 1.0, **change})


def test_motions_must_share_their_times():
    truth = simulate_motion(Cluster.tetrahedron(1.5), D_R=0.1, D_T=0.1, dt=1, n_frames=3, rng=1)
    late = replace(truth, time=truth.time + 1)
    with pytest.raises(ValueError, match="same times"):
        render_stack([truth, late], **BARE)
    with pytest.raises(ValueError, match="own times"):
        render_stack(truth, dt=1.0, **BARE)
