"""Fits of a rigid body to all frames return the planted motion with its stated errors."""

import json
from dataclasses import fields, replace

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import perrin
from brownian_motions import all_tracked
from perrin import (
    Cluster,
    DegenerateClusterError,
    RigidMotion,
    TooFewFramesError,
    add_noise,
    kabsch,
    simulate_motion,
    track_rotation,
)
from perrin.geometry.rotations import exp_map, log_map
from perrin.motion.residuals import body_residuals

TETRA = Cluster.tetrahedron(1.5)
TRIMER = Cluster.trimer(1.5)
BIPYRAMID = Cluster.touching(5, 2.45)
PAIR = Cluster.from_positions([[-1.0, 0.0], [1.0, 0.0]])
FLAT = Cluster.from_positions([[0.0, 0.0], [2.0, 0.1], [0.5, 1.2], [-0.7, 0.9]])
LINE = Cluster.from_positions(np.outer([0.0, 1.0, 2.5, 4.0], [1.0, 2.0, 3.0]))
# Its first three particles lie nearly on a line; all five do not.
WITH_A_LINE = Cluster.from_positions(
    [[-1.0, 0, 0], [0, 0.002, 0], [1.0, 0, 0], [0, 1.0, 0.5], [0, -0.5, 1.0]]
)
BODIES = {"tetrahedron": TETRA, "trimer": TRIMER, "bipyramid": BIPYRAMID}
FLATS = {"2-D pair": PAIR, "2-D four": FLAT}

laws = settings(max_examples=3, deadline=None, derandomize=True)


def simulated(cluster, n_frames=120, seed=0, sigma=0.0, D_R=2e-2, D_T=0.05):
    """Return the true motion and noisy positions of a diffusing cluster."""
    truth = simulate_motion(cluster, D_R=D_R, D_T=D_T, dt=0.5, n_frames=n_frames, rng=seed)
    return truth, add_noise(truth.positions(), sigma=sigma, rng=seed + 10_000)


def with_holes(positions, fraction=0.2, gap=(40, 47), seed=1):
    """Return a copy without some particles, and without any in the frames of the gap."""
    x = positions.copy()
    x[np.random.default_rng(seed).random(x.shape[:2]) < fraction] = np.nan
    x[slice(*gap)] = np.nan
    return x


def spinning(omega, n_frames, dt=0.1, cluster=BIPYRAMID):
    """Return the noise-free positions of a cluster that turns with a constant omega (rad/s)."""
    rotation = exp_map(np.multiply.outer(np.arange(n_frames) * dt, omega))
    return np.einsum("tij,nj->tni", rotation, cluster.positions)


def assert_same_motion(got, expected, atol=1e-9):
    """Compare all arrays of two motions, NaN equal to NaN."""
    for field in fields(RigidMotion):
        a, b = getattr(got, field.name), getattr(expected, field.name)
        if field.name == "reason" or b is None:
            assert a == b
        else:
            np.testing.assert_allclose(a, b, rtol=1e-9, atol=atol, err_msg=field.name)


def assert_is_the_truth(motion, truth, positions, atol=1e-12):
    """Compare a noise-free fit with the planted motion in the gauge of its first pose."""
    rows = motion.fitted
    gauge = truth.rotation[rows[0]]
    relative = truth.rotation[rows] @ gauge.T
    np.testing.assert_allclose(motion.rotation[rows], relative, rtol=0, atol=atol)
    np.testing.assert_allclose(motion.center[rows], truth.center[rows], rtol=0, atol=atol)
    np.testing.assert_allclose(motion.template, truth.template @ gauge.T, rtol=0, atol=atol)
    np.testing.assert_allclose(motion.positions()[rows], truth.positions()[rows], atol=atol)
    # A product of rotations has no residual before its first step.
    np.testing.assert_allclose(motion.residual[rows[1:]], 0, atol=atol)
    assert motion.sigma < atol
    np.testing.assert_array_equal(motion.n_present, (~np.isnan(positions).any(axis=2)).sum(axis=1))


def orientation_errors(motion, truth):
    """Return log(Q^T Q-hat) in true body axes, and the stated covariance in the same axes.

    The template is aligned to the true one first: a turn common to all frames is gauge.
    """
    gauge = kabsch(motion.template, truth.template)
    rows = motion.fitted
    error = np.swapaxes(truth.rotation[rows], 1, 2) @ motion.rotation[rows] @ gauge
    covariance = motion.covariance[rows]
    if len(gauge) == 3:
        covariance = gauge.T @ covariance @ gauge
    return log_map(error), covariance


# ---- the truth comes back -----------------------------------------------------------------------


@pytest.mark.parametrize("reference", ["template", "previous"])
@pytest.mark.parametrize("name", BODIES | FLATS)
def test_noise_free_data_give_the_truth(name, reference):
    """Rotations, centres and template of a clean track are the planted ones to 1e-12."""
    truth, x = simulated((BODIES | FLATS)[name])
    motion = track_rotation(x, dt=0.5, reference=reference)
    assert motion.fitted.size == 120
    assert set(motion.reason) == {""}
    assert_is_the_truth(motion, truth, x)
    np.testing.assert_array_equal(motion.time, truth.time)


@pytest.mark.parametrize("name", ["tetrahedron", "bipyramid", "2-D four"])
def test_missing_particles_and_frames_do_not_change_the_poses(name):
    """With 20 % of the particles and 7 frames missing, every remaining pose is the planted one."""
    truth, x = simulated((BODIES | FLATS)[name], seed=3)
    x = with_holes(x)
    motion = track_rotation(x, dt=0.5)
    assert_is_the_truth(motion, truth, x)
    enough = (~np.isnan(x).any(axis=2)).sum(axis=1) >= x.shape[2]
    np.testing.assert_array_equal(motion.fitted, np.flatnonzero(enough))


def test_no_complete_frame_is_needed():
    """A template whose particles are never all present at once is still the whole body."""
    truth, x = simulated(BIPYRAMID, seed=4)
    for k in range(len(x)):
        x[k, k % 5] = np.nan
    motion = track_rotation(x, dt=0.5)
    assert_is_the_truth(motion, truth, x)
    assert motion.fitted.size == len(x)


@pytest.mark.parametrize("name", ["trimer", "2-D pair"])
def test_small_bodies_lose_incomplete_frames(name):
    """Where every particle is needed, incomplete frames are refused and the others are right."""
    truth, x = simulated((BODIES | FLATS)[name], seed=5)
    x = with_holes(x)
    motion = track_rotation(x, dt=0.5)
    assert_is_the_truth(motion, truth, x)
    complete = ~np.isnan(x).any(axis=(1, 2))
    np.testing.assert_array_equal(motion.fitted, np.flatnonzero(complete))


def test_the_product_of_rotations_crosses_gaps():
    """Eq. 13 without noise equals the fit to the template, gap and partial frames included."""
    truth, x = simulated(BIPYRAMID, seed=6)
    x[40:47] = np.nan
    x[::9, 2] = np.nan
    chain = track_rotation(x, dt=0.5, reference="previous")
    assert_is_the_truth(chain, truth, x)
    template = track_rotation(x, dt=0.5)
    np.testing.assert_allclose(chain.rotation, template.rotation, atol=1e-12)
    np.testing.assert_allclose(chain.center, template.center, atol=1e-12)


def test_a_frame_that_cannot_be_chained_is_left_out():
    """Of two frames that share fewer than 3 particles the second is left out of the chain."""
    truth, x = simulated(BIPYRAMID, seed=7)
    x[50, :2] = np.nan
    x[51, 3:] = np.nan
    x[52, :2] = np.nan
    x[80, 2:4] = np.nan
    x[81:84, :2] = np.nan
    motion = track_rotation(x, dt=0.5, reference="previous")
    assert np.flatnonzero(np.isnan(motion.center[:, 0])).tolist() == [51, 81, 82, 83]
    assert all(motion.reason[k] for k in (51, 81, 82, 83))
    assert_is_the_truth(motion, truth, x)


def test_a_long_chain_with_missing_particles(repeats):
    """20 000 frames with 5 % of the particles missing are chained in rounds, not one by one."""
    truth, x = simulated(BIPYRAMID, n_frames=repeats(3000, 20_000), seed=8, D_R=1e-3)
    x = with_holes(x, fraction=0.05, gap=(0, 0))
    motion = track_rotation(x, dt=0.5, reference="previous")
    rows = motion.fitted
    assert rows.size > 0.98 * len(x)
    gauge = truth.rotation[rows[0]]
    np.testing.assert_allclose(motion.rotation[rows], truth.rotation[rows] @ gauge.T, atol=1e-10)


def test_the_first_pose_is_the_identity():
    """The gauge: R is exactly 1 at the first fitted frame, not at frame 0 if that is missing."""
    _, x = simulated(TETRA, sigma=0.03, seed=9)
    x[:3, :2] = np.nan
    for reference in ("template", "previous"):
        motion = track_rotation(x, dt=0.5, reference=reference)
        assert motion.fitted[0] == 3
        assert np.isnan(motion.rotation[:3]).all()
        np.testing.assert_array_equal(motion.rotation[3], np.eye(3))
        np.testing.assert_allclose(motion.template.mean(0), 0, atol=1e-13)


def test_rotations_are_proper_and_orthogonal():
    """Every fitted R is orthogonal with det 1 to 1e-12, chained a thousand times or not."""
    _, x = simulated(TETRA, n_frames=1000, sigma=0.1, seed=10)
    for reference in ("template", "previous"):
        r = track_rotation(x, dt=0.5, reference=reference).rotation
        unit = np.broadcast_to(np.eye(3), r.shape)
        np.testing.assert_allclose(r @ np.swapaxes(r, 1, 2), unit, atol=1e-12)
        np.testing.assert_allclose(np.linalg.det(r), 1, atol=1e-12)


# ---- equivariance -------------------------------------------------------------------------------


@pytest.mark.parametrize("reference", ["template", "previous"])
@laws
@given(seed=st.integers(0, 10**6))
def test_a_turned_laboratory(reference, seed):
    """Turn the data by A: R becomes A R A^T, centre and template turn, residuals stay."""
    _, x = simulated(BIPYRAMID, n_frames=30, sigma=0.05, seed=seed % 1000)
    x = with_holes(x, fraction=0.05, gap=(20, 24))
    a = Rotation.random(random_state=seed).as_matrix()
    one = track_rotation(x, dt=0.5, reference=reference)
    expected = replace(
        one,
        center=one.center @ a.T,
        rotation=a @ one.rotation @ a.T,
        template=one.template @ a.T,
        covariance=a @ one.covariance @ a.T,
    )
    assert_same_motion(track_rotation(x @ a.T, dt=0.5, reference=reference), expected)


@pytest.mark.parametrize("reference", ["template", "previous"])
@laws
@given(seed=st.integers(0, 10**6), unit=st.sampled_from([1e-6, 1e-3, 25.4, 1e6]))
def test_a_shift_a_permutation_and_another_unit(reference, seed, unit):
    """Shift: the centre shifts. Permute: the template permutes. Rescale: all lengths scale."""
    _, x = simulated(TETRA, n_frames=30, sigma=0.05, seed=seed % 1000)
    x[20:25] = np.nan
    rng = np.random.default_rng(seed)
    one = track_rotation(x, dt=0.5, reference=reference)
    shift, order = rng.normal(size=3) * 10, rng.permutation(4)
    moved = track_rotation(x + shift, dt=0.5, reference=reference)
    assert_same_motion(moved, replace(one, center=one.center + shift))
    shuffled = track_rotation(x[:, order], dt=0.5, reference=reference)
    assert_same_motion(shuffled, replace(one, template=one.template[order]))
    scaled = replace(
        one,
        center=one.center * unit,
        template=one.template * unit,
        residual=one.residual * unit,
        center_variance=one.center_variance * unit**2,
        sigma=one.sigma * unit,
        noise=one.noise * unit,
    )
    got = track_rotation(x * unit, dt=0.5, reference=reference)
    assert_same_motion(got, scaled, atol=1e-9 * min(1.0, unit**2))


@pytest.mark.parametrize("reference", ["template", "previous"])
@pytest.mark.parametrize("name", ["tetrahedron", "trimer", "2-D four"])
def test_time_reversal(name, reference):
    """Run backwards the same poses appear in reverse, in the gauge of the last one."""
    _, x = simulated((BODIES | FLATS)[name], sigma=0.05, seed=11)
    x[30:33] = np.nan
    one = track_rotation(x, dt=0.5, reference=reference)
    back = track_rotation(x[::-1], dt=0.5, reference=reference)
    last = one.rotation[-1]
    np.testing.assert_allclose(back.rotation, one.rotation[::-1] @ last.T, atol=1e-9)
    np.testing.assert_allclose(back.template, one.template @ last.T, atol=1e-9)
    assert back.sigma == pytest.approx(one.sigma, rel=1e-9)
    forward = log_map(np.swapaxes(one.rotation[:-1], 1, 2) @ one.rotation[1:])
    backward = log_map(np.swapaxes(back.rotation[:-1], 1, 2) @ back.rotation[1:])
    turn = last if len(last) == 3 else np.eye(1)
    np.testing.assert_allclose(backward[::-1], -forward @ turn.T, atol=1e-9)


def test_a_far_origin_changes_nothing_but_the_centre():
    """At an offset of 1e6 um the poses are the same within the rounding of the coordinates."""
    _, x = simulated(TETRA, sigma=0.03, seed=12)
    near, far = track_rotation(x, dt=0.5), track_rotation(x + 1e6, dt=0.5)
    np.testing.assert_allclose(far.rotation, near.rotation, atol=1e-8)
    np.testing.assert_allclose(far.center - 1e6, near.center, atol=1e-8)
    assert far.sigma == pytest.approx(near.sigma, rel=1e-6)


# ---- the stated errors --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("cluster", "fraction"),
    [(TRIMER, 0), (TETRA, 0), (BIPYRAMID, 0), (TETRA, 0.2), (BIPYRAMID, 0.2), (FLAT, 0.2)],
)
def test_sigma_has_the_error_of_its_degrees_of_freedom(cluster, fraction, repeats):
    """Over 40 tracks (quick: 8) sigma is unbiased and scatters by sigma sqrt(2/dof)/2.

    Mean within 4 standard errors, standard deviation within 4 of its own, 1/sqrt(2 tracks).
    """
    n, d = cluster.positions.shape
    tracks, score = [], []
    for seed in range(repeats(8, 40)):
        _, x = simulated(cluster, n_frames=repeats(20, 100), sigma=0.03, seed=seed)
        tracks.append(with_holes(x, fraction, gap=(0, 0), seed=seed))
    for motion in all_tracked(tracks, dt=0.5):
        lost = 6 if d == 3 else 3
        dof = np.sum(d * motion.n_present[motion.fitted] - lost) - (d * n - lost)
        score.append((motion.sigma / 0.03 - 1) / (np.sqrt(2 / dof) / 2))
    assert abs(np.mean(score)) < 4 / np.sqrt(len(score))
    assert abs(np.std(score) - 1) < 4 / np.sqrt(2 * len(score))


def test_sigma_of_the_shortest_tracks(repeats):
    """The template takes degrees of freedom: sigma^2 of 1000 (80) two-frame tracks, 4 errors."""
    count = repeats(80, 1000)
    truth = simulate_motion(TETRA, D_R=0.1, dt=1.0, n_frames=2, rng=1).positions()
    tracks = [add_noise(truth, sigma=0.03, rng=seed) for seed in range(count)]
    sigma2 = [motion.sigma**2 for motion in all_tracked(tracks)]
    assert np.mean(sigma2) / 0.03**2 == pytest.approx(1, abs=4 * np.sqrt(2 / 6 / count) + 0.003)


def test_the_product_measures_the_same_sigma():
    """The residuals of successive steps give sigma within 4 of their errors."""
    _, x = simulated(TETRA, n_frames=4000, sigma=0.03, seed=13)
    motion = track_rotation(x, dt=0.5, reference="previous")
    # Neighbouring steps share a frame: half of the steps' degrees of freedom is a safe count.
    assert motion.sigma == pytest.approx(0.03, rel=4 * np.sqrt(2 / (6 * 2000)) / 2)


@pytest.mark.parametrize("name", ["tetrahedron", "trimer", "bipyramid", "2-D four"])
@pytest.mark.parametrize("fraction", [0.0, 0.2])
@pytest.mark.parametrize("known", [False, True])
def test_poses_have_the_stated_errors(name, fraction, known, repeats):
    """Errors of orientation and centre against the truth have the stated (co)variances.

    Mean squared Mahalanobis distance and squared scaled centre error within 4 Monte-Carlo errors
    (and 1 % for second order in sigma/R), complete and partial frames apart; with `known` the
    sigmas differ between axes and are given.
    """
    cluster = (BODIES | FLATS)[name]
    n, d = cluster.positions.shape
    sigma = np.array([0.02, 0.03, 0.06][:d]) if known else 0.03
    truth, x = simulated(cluster, n_frames=repeats(500, 6000), sigma=sigma, seed=14)
    x = with_holes(x, fraction)
    motion = track_rotation(x, dt=0.5, sigma=sigma if known else None)
    error, covariance = orientation_errors(motion, truth)
    rows = motion.fitted
    distance = np.einsum("ta,tab,tb->t", error, np.linalg.inv(covariance), error)
    drift = motion.center[rows] - truth.center[rows]
    scaled = np.mean(drift**2, axis=1) / motion.center_variance[rows]
    complete = motion.n_present[rows] == n
    for group in (complete, ~complete):
        if group.sum() < 100:
            continue
        for sample, expected in ((distance[group], error.shape[1]), (scaled[group], 1.0)):
            if known and sample is scaled and not group[0]:
                continue
            spread = sample.std() / np.sqrt(len(sample))
            assert abs(sample.mean() - expected) < 4 * spread + 0.01 * expected


def test_the_covariance_has_the_right_axes(repeats):
    """For a trimer the scatter about each body axis is the stated one, 4.5 Monte-Carlo errors."""
    truth, x = simulated(TRIMER, n_frames=repeats(4000, 10_000), sigma=0.03, seed=15)
    error, covariance = orientation_errors(track_rotation(x, dt=0.5), truth)
    stated = covariance.mean(0)
    scatter = error.T @ error / len(error)
    diagonal = np.diag(stated)
    spread = np.sqrt((np.outer(diagonal, diagonal) + stated**2) / len(error))
    assert np.all(
        np.abs(scatter - stated) < 4.5 * spread + 0.01 * np.sqrt(np.outer(diagonal, diagonal))
    )
    np.testing.assert_allclose(diagonal / diagonal[2], [2, 2, 1], rtol=0.05)


def test_a_known_sigma_serves_the_covariance_only():
    """Poses and measured sigma stay; the covariance scales with the square of the given sigma."""
    _, x = simulated(TETRA, sigma=0.03, seed=16)
    free, known = track_rotation(x, dt=0.5), track_rotation(x, dt=0.5, sigma=0.06)
    ratio = (0.06 / free.sigma) ** 2
    expected = replace(
        free,
        covariance=free.covariance * ratio,
        center_variance=free.center_variance * ratio,
        noise=np.full(3, 0.06),
    )
    assert_same_motion(known, expected, atol=1e-12)


def test_residuals_are_the_distances_to_the_fitted_body():
    """`residual` is the rms distance of the particles to `positions()`, also by body_residuals."""
    _, x = simulated(BIPYRAMID, sigma=0.05, seed=17)
    x = with_holes(x, 0.1)
    motion = track_rotation(x, dt=0.5)
    away = np.linalg.norm(x - motion.positions(), axis=2)
    rows = motion.fitted
    np.testing.assert_allclose(
        motion.residual[rows], np.sqrt(np.nanmean(away[rows] ** 2, axis=1)), rtol=1e-9
    )
    body = np.linalg.norm(body_residuals(motion, x), axis=2)
    np.testing.assert_allclose(body, away, atol=1e-12)


def test_the_product_of_rotations_drifts_and_the_template_fit_does_not(repeats):
    """Orientation errors of a still tetrahedron at sigma/R = 0.05, rms over 150 (quick: 20) tracks.

    Product after 1 and 1000 steps: 4.4 and 6.5 degrees; template: sqrt(2) times 3.0 degrees
    between any two frames. Tolerances are 4 Monte-Carlo errors, 4/sqrt(2 * 3 * tracks), of each.
    """
    tracks, last = repeats(20, 150), {"template": repeats(100, 1000), "previous": 1000}
    still = np.broadcast_to(TETRA.positions, (1001, 4, 3))
    angle = {"template": [], "previous": []}
    for seed in range(tracks):
        x = add_noise(still, sigma=0.05 * 1.5, rng=seed)
        for reference, found in angle.items():
            end = last[reference]
            r = track_rotation(x[: end + 1], dt=1.0, reference=reference).rotation
            found.append(np.linalg.norm(log_map(r[[1, end]]), axis=1))
    rms = {k: np.rad2deg(np.sqrt(np.mean(np.square(v), axis=0))) for k, v in angle.items()}
    tolerance = 4 / np.sqrt(2 * 3 * tracks)
    np.testing.assert_allclose(rms["template"], 3.0 * 2**0.5, rtol=tolerance + 0.02)
    np.testing.assert_allclose(rms["previous"], [4.3, 6.5], rtol=tolerance)
    assert rms["previous"][1] > 1.25 * rms["template"][1]


def test_one_step_of_a_still_tetrahedron():
    """At sigma/R = 0.02 two frames differ by 1.72 degrees rms, each from the shape by 1.22."""
    x = add_noise(np.broadcast_to(TETRA.positions, (6001, 4, 3)), sigma=0.03, rng=18)
    motion = track_rotation(x, dt=1.0)
    step = np.rad2deg(np.sqrt(np.mean(np.sum(motion.step_vectors() ** 2, axis=1))))
    assert step == pytest.approx(1.72, rel=4 / np.sqrt(2 * 3 * 3000))
    mean = Rotation.from_matrix(motion.rotation.copy()).mean().as_matrix()
    away = np.rad2deg(np.sqrt(np.mean(np.sum(log_map(mean.T @ motion.rotation) ** 2, axis=1))))
    assert away == pytest.approx(1.215, rel=4 / np.sqrt(2 * 3 * 6000))
    claimed = np.rad2deg(np.sqrt(np.trace(motion.covariance[0])))
    assert claimed == pytest.approx(1.215, rel=0.02)


# ---- refusals -----------------------------------------------------------------------------------


def test_refused_frames_have_their_reason():
    """Each missing pose has its reason, each pose an empty one, and all its numbers are NaN."""
    _, x = simulated(WITH_A_LINE, sigma=0.02, seed=19)
    x[3] = np.nan
    x[5, 1:] = np.nan
    x[7, 2:] = np.nan
    x[9, 3:] = np.nan
    motion = track_rotation(x, dt=0.5)
    assert motion.reason[3] == "no particles"
    assert motion.reason[5] == "1 of 5 particles, 3 needed"
    assert motion.reason[7] == "2 of 5 particles, 3 needed"
    assert "3 particles present lie too near one line" in motion.reason[9]
    lost = [3, 5, 7, 9]
    assert [k for k, reason in enumerate(motion.reason) if reason] == lost
    np.testing.assert_array_equal(np.delete(np.arange(120), lost), motion.fitted)
    for name in ("center", "rotation", "residual", "covariance", "center_variance"):
        value = getattr(motion, name)
        assert np.isnan(value[lost]).all()
        assert np.isfinite(value[motion.fitted]).all()
    np.testing.assert_array_equal(motion.n_present[lost], [0, 1, 2, 3])


def test_a_frame_exactly_on_a_line_is_refused_with_its_reason():
    """Three particles exactly on a line, or all in one place, fix no rotation in that frame."""
    _, x = simulated(BIPYRAMID, seed=20)
    x[4] = LINE.positions[[0, 1, 2, 3, 3]]
    x[6] = 1.0
    motion = track_rotation(x, dt=0.5)
    for k in (4, 6):
        assert "do not fix a rotation" in motion.reason[k]
        assert np.isnan(motion.rotation[k]).all()


@pytest.mark.parametrize("reference", ["template", "previous"])
@pytest.mark.parametrize("offset", [0.0, 1e6])
@pytest.mark.parametrize("sigma", [0.0, 1e-3, 0.05])
def test_collinear_clusters_are_refused(reference, offset, sigma, repeats):
    """Particles on one line, with noise or without, near or far, are no rotating body in 3-D."""
    for seed in range(repeats(1, 3)):
        _, x = simulated(LINE, n_frames=repeats(15, 60), sigma=sigma, seed=seed)
        with pytest.raises(DegenerateClusterError, match="one line"):
            track_rotation(x + offset, dt=0.5, reference=reference)


@pytest.mark.parametrize("reference", ["template", "previous"])
def test_clusters_without_an_orientation_are_refused(reference):
    """Two particles in space, one in the plane, and all in one place: DegenerateClusterError."""

    def track(x):
        return track_rotation(x, dt=0.5, reference=reference)

    _, x = simulated(TETRA, sigma=0.03)
    with pytest.raises(DegenerateClusterError, match="2 particles") as caught:
        track(x[:, :2])
    assert caught.value.indices == (2,)
    with pytest.raises(DegenerateClusterError, match="1 particle:"):
        track(x[:, :1, :2])
    with pytest.raises(DegenerateClusterError):
        track(np.ones((10, 4, 3)))
    with pytest.raises(DegenerateClusterError):
        track(add_noise(np.ones((50, 4, 3)), sigma=0.1, rng=1))


@pytest.mark.parametrize("reference", ["template", "previous"])
def test_too_few_frames(reference):
    """One frame, or one frame with a pose, is TooFewFramesError with the count."""
    _, x = simulated(TETRA, sigma=0.03)
    alone = x.copy()
    alone[1:, :2] = np.nan
    for bad in (x[:1], alone):
        with pytest.raises(TooFewFramesError, match="1 frame with a pose") as caught:
            track_rotation(bad, dt=0.5, reference=reference)
        assert caught.value.n_frames == 1
    assert track_rotation(x[:2], dt=0.5, reference=reference).fitted.size == 2


def test_invalid_positions_are_refused():
    """A particle that is never present, inf, no frames, wrong shapes: ValueErrors that name it."""
    _, x = simulated(TETRA, sigma=0.03)
    never, infinite = x.copy(), x.copy()
    never[:, 2] = np.nan
    infinite[7, 1, 0] = -np.inf
    for bad, word in (
        (never, r"particles \[2\] are missing in every frame"),
        (infinite, "infinite coordinate at row 7, particle 1"),
        (np.full_like(x, np.nan), "missing in every frame"),
        (x[:0], "missing in every frame"),
        (x[0], "shape"),
        (x[..., :1], "shape"),
    ):
        with pytest.raises(ValueError, match=word):
            track_rotation(bad, dt=0.5)


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"dt": 0.0}, "dt"),
        ({"dt": -1.0}, "dt"),
        ({"dt": np.nan}, "dt"),
        ({"reference": "first"}, "reference"),
        ({"frames": range(5)}, r"frames: expected 120 numbers .* shape \(5,\)"),
        ({"frames": [*range(119), 118]}, "frames: expected finite, rising numbers.* row 119"),
        ({"times": [*range(119), np.nan]}, "times: .* row 119"),
        ({"times": [0.0] * 120}, "times: .* row 1"),
        ({"frames": range(120), "times": range(120)}, "one of them"),
        ({"sigma": -0.1}, "sigma"),
        ({"sigma": [0.1, 0.1]}, "sigma"),
    ],
)
def test_invalid_options_are_refused(options, word):
    """Bad dt, clocks, references and sigmas are named in one line."""
    _, x = simulated(TETRA, sigma=0.03)
    with pytest.raises(ValueError, match=word) as caught:
        track_rotation(x, **({"dt": 0.5} | options))
    assert "\n" not in str(caught.value)


def test_times_of_the_rows():
    """Time is frame number times dt, or `times`; neither changes a pose."""
    _, x = simulated(TETRA, sigma=0.03)
    plain = track_rotation(x, dt=0.5)
    frames = 7 + np.cumsum(np.random.default_rng(1).integers(1, 4, 120))
    by_frame = track_rotation(x, dt=0.5, frames=frames)
    np.testing.assert_array_equal(by_frame.time, frames * 0.5)
    times = np.linspace(0, 1, 120) ** 2
    by_time = track_rotation(x, dt=0.5, times=times)
    np.testing.assert_array_equal(by_time.time, times)
    assert times.flags.writeable
    for other in (by_frame, by_time):
        np.testing.assert_array_equal(other.rotation, plain.rotation)


# ---- directions and the unbounded angle ---------------------------------------------------------


def test_orientations_are_unit_vectors_that_turn_with_the_body():
    """p(t) = R(t) p0 / |p0| (Eq. 17), for one direction or several, NaN in missing frames."""
    _, x = simulated(BIPYRAMID, sigma=0.05, seed=21)
    x[10:15] = np.nan
    motion = track_rotation(x, dt=0.5)
    p0 = np.random.default_rng(2).normal(size=(7, 3)) * 100
    p = motion.orientation(p0)
    assert p.shape == (120, 7, 3)
    rows = motion.fitted
    np.testing.assert_allclose(np.linalg.norm(p[rows], axis=-1), 1, rtol=1e-14)
    assert np.isnan(p[10:15]).all()
    unit = p0 / np.linalg.norm(p0, axis=1, keepdims=True)
    np.testing.assert_allclose(p[rows[0]], unit, atol=1e-15)
    for k in range(7):
        np.testing.assert_allclose(motion.orientation(p0[k]), p[:, k], atol=1e-15)
    np.testing.assert_allclose(motion.orientation(motion.template)[rows, 0], p_of(motion, rows))


def p_of(motion, rows):
    """Return the direction from the centre to the first particle of the fitted body."""
    arm = motion.positions()[rows, 0] - motion.center[rows]
    return arm / np.linalg.norm(arm, axis=1, keepdims=True)


@pytest.mark.parametrize("p0", [[0, 0, 0], [1, 0], [[1, 0, 0], [0, 0, 0]], [np.nan, 0, 1], 1.0])
def test_invalid_directions_are_refused(p0):
    """Zero, misshapen or missing directions are refused by both functions."""
    motion = track_rotation(spinning([0, 0, 1.0], 10), dt=0.1)
    for function in (motion.orientation, motion.rotational_displacement):
        with pytest.raises(ValueError, match="p0"):
            function(p0)


@pytest.mark.parametrize("rate", [3.0, -20.0])
def test_a_constant_turn_is_unbounded(rate):
    """Omega along z, p across: phi = (0, 0, omega t), many turns on, in steps of up to 2 rad."""
    motion = track_rotation(spinning([0, 0, rate], 500) + 1e3, dt=0.1)
    phi = motion.rotational_displacement([[1.0, 0, 0], [0.3, -0.7, 0]])
    expected = np.zeros((500, 2, 3))
    expected[:, :, 2] = rate * 0.1 * np.arange(500)[:, None]
    np.testing.assert_allclose(phi, expected, rtol=0, atol=1e-8)
    assert np.abs(phi).max() > 20 * np.pi
    np.testing.assert_allclose(motion.rotational_displacement([0, 0, 1.0]), 0, atol=1e-12)


@pytest.mark.parametrize("step", [1e-3, 0.5, 3.0])
def test_a_step_is_the_angle_of_the_direction(step):
    """Eq. 32: a step has the angle arccos(sin^2 theta cos dphi + cos^2 theta) of p itself."""
    theta = 0.6
    motion = track_rotation(spinning([0, 0, step], 5, dt=1.0), dt=1.0)
    phi = motion.rotational_displacement([np.sin(theta), 0, np.cos(theta)])
    expected = 2 * np.arcsin(np.sin(theta) * np.sin(step / 2))
    np.testing.assert_allclose(np.linalg.norm(np.diff(phi, axis=0), axis=1), expected, rtol=1e-9)
    cosine = np.sin(theta) ** 2 * np.cos(step) + np.cos(theta) ** 2
    assert np.cos(expected) == pytest.approx(cosine, rel=1e-12)


def test_small_steps_show_sine_squared_and_two_thirds():
    """Along omega phi grows by sin^2(theta) omega t; over a tetrahedron's directions, 2/3."""
    turns = 3
    motion = track_rotation(spinning([0, 0, 2 * np.pi], turns * 1000 + 1, dt=1e-3), dt=1e-3)
    for theta in (0.2, 0.9, np.pi / 2):
        phi = motion.rotational_displacement([np.sin(theta), 0, np.cos(theta)])[-1]
        expected = [0, 0, np.sin(theta) ** 2 * 2 * np.pi * turns]
        np.testing.assert_allclose(phi, expected, rtol=1e-4, atol=1e-6)
    four = motion.rotational_displacement(
        TETRA.positions @ Rotation.random(random_state=3).as_matrix()
    )
    assert four[-1, :, 2].mean() == pytest.approx(2 / 3 * 2 * np.pi * turns, rel=1e-4)
    squares = np.sum(np.diff(four, axis=0) ** 2, axis=-1).mean()
    assert squares == pytest.approx(2 / 3 * (2 * np.pi * 1e-3) ** 2, rel=1e-4)


def test_the_plane_has_one_signed_unbounded_angle():
    """In 2-D phi is one number, the same for every direction, beyond any number of turns."""
    angle = np.cumsum(np.random.default_rng(4).normal(0.5, 0.8, 300))
    x = np.einsum("tij,nj->tni", exp_map(angle[:, None]), FLAT.positions)
    motion = track_rotation(x, dt=0.1)
    phi = motion.rotational_displacement([[1.0, 0.0], [0.3, 0.4]])
    assert phi.shape == (300, 2, 1)
    expected = np.broadcast_to((angle - angle[0])[:, None], (300, 2))
    np.testing.assert_allclose(phi[..., 0], expected, atol=1e-10)
    assert phi.max() > 2 * 2 * np.pi
    np.testing.assert_allclose(motion.step_vectors()[:, 0], np.diff(angle), atol=1e-12)


def test_a_gap_is_crossed_by_the_direct_rotation():
    """Over missing frames phi takes the one shortest turn, and step_vectors one longer step."""
    x = spinning([0, 0, 4.0], 50)
    x[20:24] = np.nan
    x[30:43] = np.nan
    motion = track_rotation(x, dt=0.1)
    phi = motion.rotational_displacement([1.0, 0, 0])[:, 2]
    assert phi[24] - phi[19] == pytest.approx(2.0, rel=1e-12)
    assert phi[43] - phi[29] == pytest.approx(5.6 - 2 * np.pi, rel=1e-12)
    assert np.isnan(phi[20:24]).all()
    assert np.isnan(phi[30:43]).all()
    vectors = motion.step_vectors()
    assert vectors.shape == (49, 3)
    np.testing.assert_allclose(vectors[23], [0, 0, 2.0], atol=1e-12)
    assert np.isnan(vectors[19:23]).all()
    start, stop = motion.steps()
    assert (stop - start).tolist().count(5) == 1
    assert (stop - start).tolist().count(14) == 1


def test_a_new_piece_starts_at_zero():
    """Phi begins anew in every piece, no step joins two, and a gap inside a piece is crossed."""
    x = spinning([0, 0, 4.0], 50)
    x[10:12] = np.nan
    x[29:31] = np.nan
    cut = replace(track_rotation(x, dt=0.1), piece=np.repeat([0, 1], [30, 20]))
    phi = cut.rotational_displacement([[1.0, 0, 0], [0, 1.0, 0]])[:, :, 2]
    expected = 0.4 * np.arange(50.0)
    expected[31:] -= expected[31]
    expected[[10, 11, 29, 30]] = np.nan
    np.testing.assert_allclose(phi, np.repeat(expected[:, None], 2, axis=1), atol=1e-12)
    start, stop = cut.steps()
    assert not np.any((start < 30) & (stop >= 30))
    assert np.isnan(cut.step_vectors()[30]).all()
    assert len(start) == 50 - 4 - 2


@pytest.mark.parametrize("axis", [[0, 0, 1.0], [0.36, 0.48, 0.8], [0.6, -0.8, 0]])
def test_a_step_of_exactly_pi(axis):
    """Half a turn: phi has length pi along the axis for p across it, and steps of Eq. 32 else."""
    axis = np.array(axis)
    half = 2 * np.outer(axis, axis) - np.eye(3)
    x = np.stack([BIPYRAMID.positions, BIPYRAMID.positions @ half.T])
    motion = track_rotation(x, dt=1.0)
    across = np.cross(axis, [1.0, 2.0, 3.0])
    along = np.cross(axis, across)
    phi = motion.rotational_displacement([across, along, axis])[1]
    np.testing.assert_allclose(np.linalg.norm(phi, axis=1), [np.pi, np.pi, 0], atol=1e-7)
    for k in range(2):
        np.testing.assert_allclose(np.abs(phi[k] @ axis), np.pi, rtol=1e-9)
    tilted = across / np.linalg.norm(across) + axis
    angle = np.linalg.norm(motion.rotational_displacement(tilted)[1])
    assert angle == pytest.approx(np.pi / 2, rel=1e-9)


def test_step_vectors_are_in_body_axes():
    """R_{k+1} = R_k exp(theta_k), in space and across missing frames."""
    _, x = simulated(TETRA, sigma=0.03, seed=22)
    x[30:35] = np.nan
    motion = track_rotation(x, dt=0.5)
    start, stop = motion.steps()
    theta = motion.step_vectors()[stop - 1]
    np.testing.assert_allclose(
        motion.rotation[start] @ exp_map(theta), motion.rotation[stop], atol=1e-13
    )
    assert np.isfinite(motion.step_vectors()).all(axis=1).sum() == len(start)


# ---- the summed rotation vectors ----------------------------------------------------------------


@pytest.mark.parametrize("omega", [[0, 0, 4.0], [2.0, -1.0, 0.5], [-25.0, 0, 0]])
def test_rotation_vectors_of_a_steady_turn_add_up(omega):
    """At constant omega the sum is omega t, many turns on, along x too."""
    motion = track_rotation(spinning(omega, 300), dt=0.1)
    expected = np.outer(np.arange(300) * 0.1, omega)
    np.testing.assert_allclose(motion.accumulated_rotation(), expected, rtol=0, atol=1e-9)


def test_summed_rotation_vectors_are_scipys():
    """Row by row the sum of the lab-frame rotvecs R_{k+1} R_k^T, the body's turned into the lab."""
    motion = track_rotation(simulated(TETRA, sigma=0.03, seed=31)[1], dt=0.5)
    rotation, _ = motion.as_scipy()
    expected = np.cumsum((rotation[1:] * rotation[:-1].inv()).as_rotvec(), axis=0)
    walk = motion.accumulated_rotation()
    assert walk.shape == (120, 3)
    np.testing.assert_array_equal(walk[0], 0)
    np.testing.assert_allclose(walk[1:], expected, rtol=0, atol=1e-12)
    lab = np.einsum("tij,tj->ti", motion.rotation[:-1], motion.step_vectors())
    np.testing.assert_allclose(np.diff(walk, axis=0), lab, rtol=0, atol=1e-12)


def test_summed_rotation_vectors_cross_gaps_and_restart_in_pieces():
    """A gap is the one direct turn between its ends; missing frames are NaN; pieces begin at 0."""
    x = spinning([0, 0, 4.0], 50)
    x[10:12] = np.nan
    x[20:33] = np.nan
    x[39:41] = np.nan
    cut = replace(track_rotation(x, dt=0.1), piece=np.repeat([0, 1], [40, 10]))
    expected = 0.4 * np.arange(50.0)
    expected[33:] -= 2 * np.pi
    expected[41:] -= expected[41]
    expected[[10, 11, *range(20, 33), 39, 40]] = np.nan
    walk = cut.accumulated_rotation()
    np.testing.assert_allclose(walk[:, 2], expected, rtol=0, atol=1e-11)
    np.testing.assert_allclose(walk[cut.fitted, :2], 0, atol=1e-12)


def test_summed_rotation_in_the_plane_is_the_angle():
    """In 2-D the sum is the unbounded angle of any direction, one signed number."""
    angle = np.cumsum(np.random.default_rng(32).normal(0.5, 0.8, 300))
    x = np.einsum("tij,nj->tni", exp_map(angle[:, None]), FLAT.positions)
    x[100:103] = np.nan
    motion = track_rotation(x, dt=0.1)
    walk = motion.accumulated_rotation()
    assert walk.shape == (300, 1)
    np.testing.assert_allclose(walk, motion.rotational_displacement([1.0, 0.0]), atol=1e-12)


def test_summed_rotation_follows_the_lab():
    """Turn, shift and rescale the lab: the vectors turn with it; body labels do not matter."""
    _, x = simulated(TETRA, sigma=0.03, seed=33)
    q = Rotation.random(random_state=4).as_matrix()
    walk = track_rotation(x, dt=0.5).accumulated_rotation()
    other = track_rotation(40.0 * x @ q.T + [5.0, 6.0, 7.0], dt=0.5).accumulated_rotation()
    np.testing.assert_allclose(other, walk @ q.T, rtol=0, atol=1e-9)
    shuffled = track_rotation(x[:, [2, 0, 3, 1]], dt=0.5).accumulated_rotation()
    np.testing.assert_allclose(shuffled, walk, rtol=0, atol=1e-9)


# ---- in and out ---------------------------------------------------------------------------------


def measured(cluster):
    """Return a noisy motion with missing frames, reasons and two pieces, in odd units."""
    _, x = simulated(cluster, sigma=0.03, seed=23)
    x[10:13] = np.nan
    x[15, 1:] = np.nan
    return replace(track_rotation(x + 1 / 3, dt=0.7), piece=np.repeat([0, 1], 60))


@pytest.mark.parametrize("cluster", [TETRA, FLAT])
@pytest.mark.parametrize("through", ["memory", "parquet"])
def test_tables_keep_every_bit(cluster, through, tmp_path):
    """to_frame, then from_frame, also through a Parquet file, gives back the same bits."""
    motion = measured(cluster)
    table = motion.to_frame()
    assert len(table) == len(motion.time)
    if through == "parquet":
        table.to_parquet(tmp_path / "motion.parquet")
        table = pd.read_parquet(tmp_path / "motion.parquet")
    back = RigidMotion.from_frame(table)
    for field in fields(RigidMotion):
        a, b = getattr(back, field.name), getattr(motion, field.name)
        if isinstance(b, np.ndarray):
            assert a.dtype == b.dtype
            np.testing.assert_array_equal(a, b, err_msg=field.name)
        else:
            assert a == b, field.name


@pytest.mark.parametrize("cluster", [TETRA, FLAT])
def test_a_motion_survives_json(cluster):
    """to_dict, through JSON, and from_dict give back the same bits; NaN is null."""
    motion = measured(cluster)
    text = json.dumps(motion.to_dict(), allow_nan=False)
    back = RigidMotion.from_dict(json.loads(text))
    for field in fields(RigidMotion):
        a, b = getattr(back, field.name), getattr(motion, field.name)
        if isinstance(b, np.ndarray):
            assert a.dtype == b.dtype
            assert not a.flags.writeable
            np.testing.assert_array_equal(a, b, err_msg=field.name)
        else:
            assert a == b, field.name


def test_other_tables_are_refused():
    """A table without its attrs or a column is refused by name."""
    table = measured(TETRA).to_frame()
    table.attrs = {}
    with pytest.raises(ValueError, match="template"):
        RigidMotion.from_frame(table)
    whole = measured(TETRA).to_frame()
    for column in ("r_xx", "cov_yz", "piece", "reason", "z"):
        lacking = whole.drop(columns=column)
        lacking.attrs = whole.attrs
        with pytest.raises(ValueError, match=column):
            RigidMotion.from_frame(lacking)


def test_scipy_gets_the_fitted_frames():
    """as_scipy gives the same matrices and the indices of their frames; the plane is refused."""
    motion = measured(TETRA)
    rotation, rows = motion.as_scipy()
    np.testing.assert_array_equal(rows, motion.fitted)
    np.testing.assert_allclose(rotation.as_matrix(), motion.rotation[rows], atol=1e-14)
    v = np.array([1.0, 2.0, 3.0])
    np.testing.assert_allclose(rotation.apply(v), motion.rotation[rows] @ v, atol=1e-13)
    with pytest.raises(ValueError, match="plane"):
        measured(FLAT).as_scipy()


def test_results_are_read_only():
    """No array of a motion can be written to, and none is the caller's own."""
    _, x = simulated(TETRA, sigma=0.03)
    before, times = x.copy(), np.arange(120.0)
    motion = track_rotation(x, dt=0.5, times=times)
    np.testing.assert_array_equal(x, before)
    assert x.flags.writeable
    assert times.flags.writeable
    for field in fields(RigidMotion):
        value = getattr(motion, field.name)
        if isinstance(value, np.ndarray):
            with pytest.raises(ValueError, match="read-only"):
                value[0] = 0
    with pytest.raises(AttributeError):
        motion.dt = 1.0


def test_the_text_of_a_motion():
    """The repr has the body, the frames with a pose, dt and sigma; R is the mean distance."""
    motion = measured(TETRA)
    assert "n=4, d=3, 116 of 120 frames, dt=0.7 s" in repr(motion)
    assert pytest.approx(1.5, rel=0.01) == motion.R


@pytest.mark.parametrize(("ratio", "gain"), [(1.0, 1.0), (2.0, 0.70), (3.0, 0.42)])
def test_weights_lower_the_error_where_sigma_differs_by_axis(ratio, gain, repeats):
    """Tetrahedra, sigma_z = ratio sigma_xy: the variance of R falls as predicted, and is stated."""
    truth = perrin.simulate_motion(
        perrin.Cluster.tetrahedron(1.5), D_R=0.02, dt=1.0, n_frames=repeats(1500, 3000), rng=1
    )
    sigma = np.array([0.02, 0.02, 0.02 * ratio])
    x = perrin.add_noise(truth.positions(), sigma=sigma, rng=2)
    errors = {}
    for weights in ("equal", "sigma"):
        motion = perrin.track_rotation(x, dt=1.0, sigma=sigma, weights=weights)
        gauge = perrin.kabsch(truth.template, motion.template)
        off = log_map(np.swapaxes(truth.rotation, 1, 2) @ motion.rotation @ gauge.T)
        errors[weights] = ((off - off.mean(axis=0)) ** 2).sum(axis=1).mean()
        stated = np.trace(motion.covariance, axis1=1, axis2=2).mean()
        # 9000 (quick: 4500) squares: relative sd 1.5 (2.1) % of the mean, more where they are
        # unequal.
        assert errors[weights] == pytest.approx(stated, rel=0.06)
    assert errors["sigma"] / errors["equal"] == pytest.approx(gain, rel=0.04)


def test_a_particle_without_weight_does_not_count():
    """A huge sigma for one particle is as if it were missing; equal sigmas are equal weights."""
    truth = perrin.simulate_motion(
        perrin.Cluster.tetrahedron(1.5), D_R=0.01, dt=1.0, n_frames=40, rng=3
    )
    x = perrin.add_noise(truth.positions(), sigma=0.02, rng=4)
    plain = perrin.track_rotation(x, dt=1.0)
    same = perrin.track_rotation(x, dt=1.0, sigma=0.02, weights="sigma")
    np.testing.assert_allclose(same.rotation, plain.rotation, atol=1e-9)
    sigma = np.full((4, 1), 0.02)
    sigma[3] = 1e6
    heavy = perrin.track_rotation(x, dt=1.0, sigma=sigma, weights="sigma")
    turn = perrin.kabsch(x[:, :3], heavy.template[:3])
    np.testing.assert_allclose(heavy.rotation, turn, atol=1e-6)


def test_weights_in_the_plane():
    """One angle: the same laws."""
    flat = perrin.Cluster.from_positions([[0, 0], [2, 0], [1, 1.7]])
    truth = perrin.simulate_motion(flat, D_R=0.02, dt=1.0, n_frames=2000, rng=5)
    x = perrin.add_noise(truth.positions(), sigma=(0.02, 0.06), rng=6)
    motion = perrin.track_rotation(x, dt=1.0, sigma=(0.02, 0.06), weights="sigma")
    off = log_map(np.swapaxes(truth.rotation, 1, 2) @ motion.rotation)
    stated = motion.covariance.mean()
    assert np.var(off) == pytest.approx(stated, rel=4 * np.sqrt(2 / 2000))


def test_weights_need_a_sigma():
    """Bad combinations are refused with a message."""
    x = np.random.default_rng(0).normal(size=(5, 4, 3))
    with pytest.raises(ValueError, match=r'weights="sigma" needs sigma'):
        perrin.track_rotation(x, dt=1.0, weights="sigma")
    with pytest.raises(ValueError, match="finite numbers > 0"):
        perrin.track_rotation(x, dt=1.0, sigma=0.0, weights="sigma")
    with pytest.raises(ValueError, match="'equal' or 'sigma'"):
        perrin.track_rotation(x, dt=1.0, weights="other")


def test_no_step_joins_two_pieces():
    """The pieces of `piece` are those of the motion, with either reference."""
    truth = perrin.simulate_motion(
        perrin.Cluster.tetrahedron(1.5), D_R=0.01, dt=1.0, n_frames=20, rng=7
    )
    piece = np.repeat([0, 1], 10)
    for reference in ("template", "previous"):
        motion = perrin.track_rotation(truth.positions(), dt=1.0, reference=reference, piece=piece)
        start, _ = motion.steps()
        assert 9 not in start
        assert start.size == 18
    with pytest.raises(ValueError, match="piece: expected 20 whole numbers"):
        perrin.track_rotation(truth.positions(), dt=1.0, piece=piece[1:])


def _tumbling(body, seed):
    truth = simulate_motion(body, D_R=0.02, D_T=0.04, dt=0.73, n_frames=200, rng=seed)
    return add_noise(truth.positions(), sigma=0.03, rng=seed + 1)


@pytest.mark.parametrize("unit", [0.01, 0.1, 6.0, 100.0])
def test_a_z_in_another_unit_is_named_with_its_factor(unit):
    """Z in plane numbers or pixels: the refusal gives the factor that makes distances constant."""
    x = _tumbling(Cluster.touching(5, 2.45), 1) * [1.0, 1.0, unit]
    with pytest.raises(DegenerateClusterError, match="z is in another unit") as caught:
        track_rotation(x, dt=0.73)
    factor = float(str(caught.value).split("multiplied by ")[1].split()[0])
    # Noise of 0.03 on 2.45 um biases the factor by 1e-3; three digits are printed.
    assert factor == pytest.approx(1 / unit, rel=0.02)
    assert "line" not in str(caught.value)


def test_two_bodies_under_one_number_are_not_called_a_line():
    """Two pairs that diffuse apart: the pair whose distance changes is named."""
    x = _tumbling(Cluster.tetrahedron(1.5), 3)
    rng = np.random.default_rng(4)
    x[:, 2:] += np.cumsum(rng.normal(size=(200, 1, 3)) * 0.6, axis=0)
    with pytest.raises(DegenerateClusterError, match="more than one body under this number"):
        track_rotation(x, dt=0.73)


def test_a_line_is_stated_with_length_width_and_error():
    """Particles on a line within the noise: the numbers that decide are in the message."""
    x = np.zeros((200, 4, 3)) + np.arange(4)[None, :, None] * [2.0, 0, 0]
    x += np.random.default_rng(5).normal(size=x.shape) * 0.03
    with pytest.raises(DegenerateClusterError, match=r"one line .* length 2\.2.* error 0\.0") as e:
        track_rotation(x, dt=0.73)
    assert "rigid body" not in str(e.value)
