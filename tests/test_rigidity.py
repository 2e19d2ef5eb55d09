"""Rigidity of a fitted body: noise of each axis, stretched z, sequential scans, broken bonds."""

from __future__ import annotations

import json

import numpy as np
import pytest

import perrin
from perrin.motion.residuals import expected_squares, fit_projector, lag_one_autocorrelation


def judged(x, **options):
    return perrin.judge_quality(perrin.track_rotation(x, dt=0.73), x, **options)


def noisy(seed, *, body=4, D_R=4.9e-3, n_frames=300, sigma=(0.03, 0.03, 0.04)):
    truth = perrin.simulate_motion(
        perrin.Cluster.touching(body, 2.45), D_R=D_R, D_T=0.04, dt=0.73, n_frames=n_frames, rng=seed
    )
    return perrin.add_noise(truth.positions(), sigma=sigma, rng=seed + 1000)


@pytest.mark.parametrize("body", [3, 4, 6])
def test_a_good_cluster_has_no_warning(body, repeats):
    """Rigid, equal scales, simultaneous particles: no warning on 5 (quick: 2) clusters each."""
    for seed in range(repeats(2, 5)):
        assert judged(noisy(seed, body=body)).warnings == ()


@pytest.mark.parametrize("sigma", [(0.03, 0.03, 0.03), (0.02, 0.04, 0.06)])
def test_sigma_per_axis_comes_back(sigma, repeats):
    """The planted errors, to 4 times the spread that the projector predicts (9 % at most)."""
    count = repeats(3, 6)
    found = np.mean([judged(noisy(s, sigma=sigma)).sigma_xyz for s in range(count)], axis=0)
    np.testing.assert_allclose(found, sigma, rtol=4 * 0.09 / np.sqrt(count))


def test_a_trimer_that_hardly_turns_has_no_sigma_per_axis():
    """Its residuals lie in its plane, whose orientation hardly changes."""
    assert judged(noisy(1, body=3, D_R=1e-5)).sigma_xyz is None
    assert judged(noisy(1, body=3, D_R=0.02)).sigma_xyz is not None


def test_a_stretched_z_is_measured():
    """3 % come back within 3 standard errors and are reported; without a stretch the scale is 1."""
    x = noisy(2)
    stretched, plain = judged(x * [1.0, 1.0, 1.03]), judged(x)
    assert abs(stretched.z_scale - 1.03) < 3 * stretched.z_scale_stderr
    assert abs(plain.z_scale - 1.0) < 3 * plain.z_scale_stderr
    assert any("z scale" in w for w in stretched.warnings)


def test_a_sequential_scan_is_suspected():
    """Particles recorded as a plane sweeps 12 um a frame: the delay with height is measured."""
    sub, n = 30, 200
    truth = perrin.simulate_motion(
        perrin.Cluster.touching(4, 2.45),
        D_R=4.9e-3,
        D_T=0.0385,
        dt=0.73 / sub,
        n_frames=n * sub,
        rng=3,
    )
    p = truth.positions().reshape(n, sub, 4, 3)
    plane = p[:, :1, :, 2].mean(axis=2) - 6 + 12 * np.arange(sub) / sub
    met = np.abs(p[..., 2] - plane[..., None]).argmin(axis=1)
    x = np.take_along_axis(p, met[:, None, :, None], axis=1)[:, 0]
    x = perrin.add_noise(x, sigma=(0.03, 0.03, 0.04), rng=4)
    for known in (None, (0.05, 0.05, 0.067)):
        quality = judged(x, sigma=known)
        assert any(w.startswith("scan:") for w in quality.warnings)
        # 12 um in 0.73 s; the velocity between three frames dilutes that of the sweep itself.
        assert 0.2 * 0.73 / 12 < quality.scan_delay < 2 * 0.73 / 12
    again = judged(x[:, :, :] * [1, 1, -1.0])
    assert again.scan_delay == pytest.approx(-quality.scan_delay, rel=1e-6)


def test_a_breaking_bond_is_named():
    """One particle creeps away: the pair, the two distances, and no longer rigid."""
    x = noisy(5)
    x[:, 3] += np.linspace(0, 2, 300)[:, None] * [0.4, 0.4, 0.4]
    quality = judged(x)
    assert not quality.rigid
    assert 3 in quality.drifting_pair
    assert any("a bond breaks" in r for r in quality.reasons)


def test_smooth_errors_alone_are_not_softness():
    """Residuals of 1.5 % of R that are smooth in time, as real cameras make, pass as rigid."""
    x = noisy(6, sigma=0.0)
    rng = np.random.default_rng(6)
    error = np.zeros(x.shape)
    for k in range(1, len(x)):
        error[k] = 0.95 * error[k - 1] + rng.normal(size=x.shape[1:])
    quality = judged(x + 0.015 * 1.5 * error / error.std())
    assert quality.autocorrelation > 0.8
    assert quality.rigid


def test_a_stated_sigma_decides():
    """Twice the stated sigma is the limit."""
    x = noisy(7)
    assert judged(x, sigma=0.03).rigid
    assert not judged(x, sigma=0.01).rigid
    assert judged(x, sigma=0.03).residual_over_sigma == pytest.approx(1.12, abs=0.1)


@pytest.mark.parametrize("seed", range(2))
def test_labels_and_axes_of_the_lab_do_not_matter(seed):
    """Particles renamed, the lab turned about z: the same verdict."""
    x = noisy(seed + 20, n_frames=150)
    base = judged(x)
    c, s = np.cos(0.7), np.sin(0.7)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    for other in (x[:, [2, 0, 3, 1]], x @ turn.T + 100.0):
        again = judged(other)
        for name in ("residual_over_R", "z_scale", "scan_blur", "autocorrelation"):
            # Noise that by chance differs between x and y is not diagonal in turned axes; the
            # scale is corrected for it at second order, under 1e-4.
            rel = {"scan_blur": 1e-3, "z_scale": 1e-4}.get(name, 1e-6)
            assert getattr(again, name) == pytest.approx(getattr(base, name), rel=rel)


def test_bodies_in_the_plane_are_judged_too():
    """In two dimensions there is no scale of z; the noise of each axis is measured."""
    flat = perrin.Cluster.from_positions([[0, 0], [2, 0], [1, 1.7]])
    truth = perrin.simulate_motion(flat, D_R=0.02, D_T=0.03, dt=1.0, n_frames=300, rng=1)
    quality = judged(perrin.add_noise(truth.positions(), sigma=(0.02, 0.04), rng=2))
    assert quality.z_scale is None
    np.testing.assert_allclose(quality.sigma_xyz, (0.02, 0.04), rtol=0.25)


def test_quality_survives_json():
    """to_dict and from_dict are inverse."""
    quality = judged(noisy(8), swaps=(4, 9))
    text = json.dumps(quality.to_dict(), allow_nan=False)
    assert perrin.Quality.from_dict(json.loads(text)) == quality


@pytest.mark.parametrize(
    ("cluster", "symbol"),
    [
        (perrin.Cluster.tetrahedron(1.5), "T_d"),
        (perrin.Cluster.touching(5, 2.45), "D_3h"),
        (perrin.Cluster.touching(6, 2.45), "O_h"),
        (perrin.Cluster.from_positions([[0, 0, 0], [3, 0, 0], [0, 2, 0], [0, 0, 1]]), "C_1"),
        (perrin.Cluster.from_positions([[0, 0], [2, 0], [1, 3**0.5]]), "D_3h"),
        (perrin.Cluster.from_positions([[0, 0], [2, 0]]), "D_inf_h"),
    ],
)
def test_the_symmetry_of_a_noisy_shape_is_found(cluster, symbol):
    """The point group from the measured shape, in space and in the plane, whatever the labels."""
    rng = np.random.default_rng(3)
    truth = perrin.simulate_motion(cluster, D_R=5e-3, dt=1.0, n_frames=100, rng=rng)
    x = perrin.add_noise(truth.positions(), sigma=0.03, rng=rng)
    for order in (slice(None), rng.permutation(len(cluster.positions))):
        motion = perrin.track_rotation(x[:, order], dt=1.0)
        assert perrin.judge_quality(motion, x[:, order]).symmetry == symbol


def stuck(seed, *, ratio=3.0, n_frames=300):
    """Return a tetrahedron that does not move, sigma_z a multiple of sigma_xy."""
    body = perrin.Cluster.tetrahedron(1.5).positions
    rng = np.random.default_rng(seed)
    return body + rng.normal(size=(n_frames, 4, 3)) * [0.02, 0.02, 0.02 * ratio]


def test_a_body_that_does_not_turn_has_no_scale_of_z(repeats):
    """Noise of the fitted orientation is not taken for a stretch, whatever sigma_z."""
    for seed in range(repeats(3, 10)):
        quality = judged(stuck(seed))
        assert quality.warnings == ()
        assert quality.z_scale is None


@pytest.mark.parametrize("D_R", [0.005, 0.02])
def test_every_stretch_is_found_and_returned(D_R, repeats):
    """100 frames: from 3 % on z is reported, its scale is right within the error over repeats."""
    for scale in (1.03, 0.9, 1.2, 1.05, 1.1)[: repeats(3, 5)]:
        stretch_is_returned(scale, D_R, count=repeats(1, 10))


def stretch_is_returned(scale, D_R, *, count):
    """Assert the stretch of so many clusters."""
    found = [
        judged(noisy(s, D_R=D_R, n_frames=100, sigma=0.03) * [1.0, 1.0, scale])
        for s in range(count)
    ]
    named = [any("z scale" in w for w in q.warnings) for q in found]
    assert sum(named) >= max(count - 1, 1)
    pull = [(q.z_scale - scale) / q.z_scale_stderr for q in found]
    assert abs(np.mean(pull)) < 3.5 / np.sqrt(count)
    # A wrong height does not make the body soft.
    assert all(q.rigid for q in found)


@pytest.mark.parametrize("ratio", [1.0, 3.0])
@pytest.mark.parametrize("body", [3, 4])
def test_worse_noise_along_z_is_no_stretch_and_no_scan(body, ratio, repeats):
    """The pulls of scale and delay have mean 0 and unit spread with unequal noise of the axes."""
    found = [
        judged(noisy(s, body=body, n_frames=150, sigma=(0.03, 0.03, 0.03 * ratio)))
        for s in range(100, 100 + repeats(4, 20))
    ]
    assert all(q.warnings == () for q in found)
    scale = [(q.z_scale - 1) / q.z_scale_stderr for q in found if q.z_scale is not None]
    delay = [q.scan_delay / q.scan_delay_stderr for q in found]
    for pull in (scale, delay):
        # Four standard errors of mean and spread of normal numbers, and 0.3 of third order.
        assert abs(np.mean(pull)) < 4 / np.sqrt(len(pull)) + 0.3
        assert np.std(pull) < 1 + 4 / np.sqrt(2 * len(pull))


def test_the_ratio_of_the_noise_is_a_note_unless_another_was_stated():
    """sigma_z three times sigma_xy: a note with its error; a warning where 1 is stated."""
    x = noisy(31, sigma=(0.03, 0.03, 0.09))
    quality = judged(x)
    assert quality.warnings == ()
    assert any("sigma_z is" in n and "+-" in n for n in quality.notes)
    assert abs(quality.scan_blur - 3) < 4 * quality.scan_blur_stderr
    assert judged(x, sigma_ratio=(1, 1, 3)).warnings == ()
    assert any(w.startswith("noise along z") for w in judged(x, sigma_ratio=(1, 1, 1)).warnings)


def soft_arm(seed, *, amplitude, memory, n_frames=300):
    """Return a tetrahedron whose last particle swings about its place (memory in frames)."""
    rng = np.random.default_rng(seed)
    truth = perrin.simulate_motion(
        perrin.Cluster.tetrahedron(1.5), D_R=5e-3, D_T=0.04, dt=0.73, n_frames=n_frames, rng=rng
    )
    rho, swing = np.exp(-1 / memory), np.zeros((n_frames, 2))
    swing[0] = rng.normal(size=2)
    for k in range(1, n_frames):
        swing[k] = rho * swing[k - 1] + np.sqrt(1 - rho**2) * rng.normal(size=2)
    across = np.linalg.svd(truth.template[3:])[2][1:]
    body = np.repeat(truth.template[None], n_frames, axis=0)
    body[:, 3] += amplitude * 1.5 / np.sqrt(2) * swing @ across
    x = np.einsum("tij,tnj->tni", truth.rotation, body) + truth.center[:, None]
    return perrin.add_noise(x, sigma=0.03, rng=rng)


@pytest.mark.parametrize("memory", [5, 50])
def test_a_soft_arm_is_not_rigid(memory, repeats):
    """A fifth of R: found also where the detections that show it were left out of the fit."""
    found = []
    for seed in range(repeats(2, 6)):
        x = soft_arm(seed, amplitude=0.2, memory=memory)
        kept = x.copy()
        motion = perrin.track_rotation(x, dt=0.73)
        off = np.linalg.norm(x[:, 3] - motion.positions()[:, 3], axis=1)
        kept[off > np.quantile(off, 0.87), 3] = np.nan
        quality = perrin.judge_quality(perrin.track_rotation(kept, dt=0.73), kept, detections=x)
        found.append(not quality.rigid)
    assert sum(found) >= len(found) - 1


@pytest.mark.parametrize("fault", ["bad frames", "outliers"])
def test_bad_frames_and_outliers_do_not_make_a_body_soft(fault, repeats):
    """3 % of frames at six times the noise, or 1 % of detections far off: rigid, and a note."""
    for seed in range(repeats(2, 6)):
        x, rng = noisy(seed + 60, sigma=0.03), np.random.default_rng(seed)
        if fault == "bad frames":
            bad = rng.random(len(x)) < 0.03
            x[bad] += 0.18 * rng.normal(size=(bad.sum(), 4, 3))
        else:
            bad = rng.random(x.shape[:2]) < 0.01
            x[bad] += 3.0 * rng.normal(size=(bad.sum(), 3))
        quality = judged(x)
        assert quality.rigid
        assert any("fit the common shape badly" in n for n in quality.notes)
        assert quality.misfits > 0


def test_old_run_folders_are_read():
    """A summary without the newer fields: they are empty."""
    entry = judged(noisy(8)).to_dict()
    for name in ("notes", "scan_blur_stderr", "scan_delay", "scan_delay_stderr", "misfits"):
        del entry[name]
    old = perrin.Quality.from_dict(entry)
    assert old.notes == ()
    assert old.scan_delay is None


def test_autocorrelation_of_a_known_series():
    """An AR(1) series gives its coefficient back; gaps are not bridged."""
    rng = np.random.default_rng(0)
    x = np.zeros((5000, 4, 3))
    for k in range(1, len(x)):
        x[k] = 0.8 * x[k - 1] + rng.normal(size=(4, 3))
    assert lag_one_autocorrelation(x).value == pytest.approx(0.8, abs=0.02)
    x[::2] = np.nan
    assert np.isnan(lag_one_autocorrelation(x).value)


@pytest.mark.parametrize("d", [2, 3])
def test_expected_squares_are_those_of_noise_along_one_axis(d):
    """Squares along axis a of what a fit leaves of unit noise along axis b, one axis at a time."""
    rng = np.random.default_rng(d)
    shape = rng.normal(size=(5, d))
    keeps = fit_projector(shape - shape.mean(axis=0))
    rotation = perrin.geometry.exp_map(rng.normal(size=(7, 3 if d == 3 else 1)))
    found = expected_squares(rotation, keeps)
    for k, r in enumerate(rotation):
        blocks = np.einsum("ai,nmij,bj->abnm", r, keeps, r)  # of the projector, in lab axes
        np.testing.assert_allclose(found[k], (blocks**2).sum(axis=(2, 3)), atol=1e-12)
