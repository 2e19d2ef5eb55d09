"""D_R and D_T: estimates follow every law, planted values come back, intervals cover."""

import dataclasses
import functools
import json
import warnings

import numpy as np
import pytest

from brownian_motions import all_tracked
from perrin import (
    Cluster,
    DiffusionEstimate,
    PrecisionWarning,
    RigidMotion,
    TooFewFramesError,
    add_noise,
    estimate_diffusion,
    kabsch,
    noise_floor,
    simulate_motion,
    track_rotation,
)
from perrin._text import with_error
from perrin.diffusion import estimate_each
from perrin.diffusion.estimate import Found
from perrin.diffusion.likelihood import Likelihood
from perrin.diffusion.noise_model import Noise
from perrin.diffusion.steps import NoisySteps, steps_of

TETRAHEDRON = Cluster.tetrahedron(1.5)
SIGMA = 0.03  # sigma/R = 0.02
S_R, S_T = 0.375 * 0.02**2, SIGMA**2 / 4  # noise variance of an orientation, of a centre coordinate
QUANTITIES = ("rotation", "translation")


def planted(quantity, snr=20.0, dt=1.0):
    """Return the D whose signal-to-noise ratio D dt/s is snr for a tetrahedron."""
    return snr * (S_R if quantity == "rotation" else S_T) / dt


def cloud(seed, n_frames=300, snr=20.0, cluster=TETRAHEDRON, substeps=1, sigma=SIGMA, dt=1.0):
    """Return noisy positions (T, n, 3) of a Brownian cluster; substeps are averaged, as blur."""
    rng = np.random.default_rng([seed, 7])
    truth = simulate_motion(
        cluster,
        D_R=planted("rotation", snr, dt),
        D_T=planted("translation", snr, dt),
        dt=dt / substeps,
        n_frames=n_frames * substeps,
        rng=rng,
    )
    x = truth.positions().reshape(n_frames, substeps, *cluster.positions.shape).mean(axis=1)
    return add_noise(x, sigma=sigma, rng=rng)


def lossy(seed, frames=0.0, particles=0.0, **what):
    """Return positions with whole frames and single particles missing, ends complete."""
    x, rng = cloud(seed, **what), np.random.default_rng([seed, 8])
    lost = rng.random(x.shape[:2]) < particles
    lost[rng.random(len(x)) < frames] = True
    lost[[0, -1]] = False
    x[lost] = np.nan
    return x


def tracked(x, **how):
    return track_rotation(x, dt=how.pop("dt", 1.0), **how)


def all_estimated(motions, quantity="rotation", *, method="mle", noise="joint", **more):
    """Return the estimate of every motion; those of likelihood together, as each would be alone."""
    if method == "mle":
        return estimate_each(motions, quantity=quantity, noise=Noise(noise, **more))
    how = {"quantity": quantity, "method": method, "noise": noise}
    return [estimate_diffusion(m, **how, **more) for m in motions]


def numbers(estimate):
    """Return value, intervals and offset as one array."""
    return np.array([estimate.value, *estimate.ci68, *estimate.ci95, estimate.stderr])


def assert_sane(estimate):
    """Every number is finite and the intervals are nested about the value."""
    assert np.isfinite([*numbers(estimate), estimate.offset]).all(), estimate
    (low95, high95), (low68, high68) = estimate.ci95, estimate.ci68
    assert 0 <= low95 <= low68 <= estimate.value <= high68 <= high95, estimate
    assert not np.isnan(estimate.snr)
    assert str(estimate).startswith("D_")


def standard_error(values):
    return np.std(values, ddof=1) / np.sqrt(len(values))


def least_cover(count, level=0.95, errors=3):
    """Return the share of intervals at a level, less this many Monte-Carlo errors."""
    return level - errors * np.sqrt(level * (1 - level) / count)


def sd_error(count, errors=3):
    """Return the relative Monte-Carlo error of a standard deviation, this many times."""
    return errors / np.sqrt(2 * count)


@pytest.fixture
def passes(monkeypatch):
    """Return a list that grows by one item with every evaluation of the likelihood."""
    found, evaluate = [], Likelihood.sums

    def counted(self, D, theta, **options):
        found.append(1)
        return evaluate(self, D, theta, **options)

    monkeypatch.setattr(Likelihood, "sums", counted)
    return found


# ---- laws ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module", params=["complete", "lossy"])
def positions(request):
    """Return positions of one track, complete or with frames and particles missing."""
    if request.param == "complete":
        return cloud(11, n_frames=60, sigma=(0.03, 0.03, 0.06))
    return lossy(12, frames=0.15, particles=0.04, n_frames=60, cluster=Cluster.touching(5, 2.45))


@pytest.fixture(scope="module")
def measured(positions):
    """Return D_R and D_T of these positions."""
    motion = tracked(positions)
    return {q: estimate_diffusion(motion, quantity=q) for q in QUANTITIES}


def renumbered(x):
    """Return the same table with the first frame 977, missing frames left out."""
    rows = np.flatnonzero(np.isfinite(x).any(axis=(1, 2)))
    return track_rotation(x[rows], dt=1.0, frames=rows + 977)


TURN = kabsch(*np.random.default_rng(5).normal(size=(2, 5, 3)))
SAME = {
    "rotated": lambda x: tracked(x @ TURN.T),
    "translated": lambda x: tracked(x + np.array([1e3, -2e3, 5e2])),
    "permuted": lambda x: tracked(x[:, np.random.default_rng(1).permutation(x.shape[1])]),
    "reversed": lambda x: tracked(x[::-1]),
    "renumbered": renumbered,
    "mirrored": lambda x: tracked(x * [1, 1, -1]),
}


@pytest.mark.parametrize("change", SAME)
def test_the_answer_does_not_depend_on_axes_labels_and_origin(positions, measured, change):
    """Turned, moved, relabelled, mirrored, backwards or renumbered: the same numbers to 1e-9."""
    motion = SAME[change](positions)
    for quantity in QUANTITIES:
        before, after = measured[quantity], estimate_diffusion(motion, quantity=quantity)
        assert np.allclose(numbers(after), numbers(before), rtol=1e-9, atol=0), quantity
        assert after.offset == pytest.approx(before.offset, rel=1e-7, abs=1e-9 * before.value)
        assert after.snr == pytest.approx(before.snr, rel=1e-9)
        assert after.n_frames == before.n_frames


def test_the_length_unit_scales_D_T_and_leaves_D_R(positions, measured, repeats):
    """Metres, millimetres or nanometres for microns: D_R the same, D_T by the square, to 1e-9."""
    for unit in (1e-6, 1e9, 1e-3, 1e3)[: repeats(2, 4)]:
        motion = tracked(positions * unit)
        for quantity, factor in (("rotation", 1.0), ("translation", unit**2)):
            before = measured[quantity]
            after = estimate_diffusion(motion, quantity=quantity)
            assert np.allclose(numbers(after), numbers(before) * factor, rtol=1e-9, atol=0), unit
            assert after.offset == pytest.approx(before.offset * factor, rel=1e-7)
            assert after.resolved == before.resolved


@pytest.mark.parametrize("quantity", QUANTITIES)
def test_the_time_unit_scales_D(positions, measured, quantity, repeats):
    """D is per time: the same frames dt apart instead of 1 s have D/dt and the same offset."""
    before = measured[quantity]
    for dt in (1e-9, 60.0, 1e9, 1e-3)[: repeats(2, 4)]:
        after = estimate_diffusion(tracked(positions, dt=dt), quantity=quantity)
        assert np.allclose(numbers(after) * dt, numbers(before), rtol=1e-9, atol=0), dt
        assert after.offset == pytest.approx(before.offset, rel=1e-7, abs=1e-9 * before.value)
        assert after.snr == pytest.approx(before.snr, rel=1e-9)


@pytest.mark.parametrize("quantity", QUANTITIES)
def test_times_and_frames_are_equivalent(positions, quantity):
    """Times of the rows instead of frame numbers give the same answer."""
    a = estimate_diffusion(tracked(positions, dt=0.7), quantity=quantity)
    times = 100 + 0.7 * np.arange(len(positions))
    b = estimate_diffusion(tracked(positions, dt=0.7, times=times), quantity=quantity)
    assert np.allclose(numbers(b), numbers(a), rtol=1e-9)


@pytest.mark.parametrize("quantity", QUANTITIES)
def test_the_order_of_pooled_motions_does_not_matter(quantity):
    """Three motions pooled in any order give the same numbers to 1e-9."""
    motions = [tracked(lossy(s, frames=0.1, n_frames=40, snr=4.0 + s)) for s in range(3)]
    before = estimate_diffusion(motions, quantity=quantity)
    for order in ((2, 0, 1), (1, 0, 2)):
        after = estimate_diffusion([motions[i] for i in order], quantity=quantity)
        assert np.allclose(numbers(after), numbers(before), rtol=1e-9)
    alone, single = (estimate_diffusion(m, quantity=quantity) for m in (motions[0], motions[:1]))
    assert np.array_equal(numbers(alone), numbers(single))


@pytest.mark.parametrize("quantity", QUANTITIES)
def test_a_copy_pooled_with_itself_only_narrows_the_interval(quantity):
    """Twice the same track: the same value to 1e-9, and 1/sqrt(2) of the error within 3 %."""
    motion = tracked(cloud(3))
    once = estimate_diffusion(motion, quantity=quantity)
    twice = estimate_diffusion([motion, motion], quantity=quantity)
    assert twice.value == pytest.approx(once.value, rel=1e-9)
    assert twice.stderr == pytest.approx(once.stderr / np.sqrt(2), rel=0.03)


@pytest.mark.parametrize("quantity", QUANTITIES)
def test_a_cut_loses_only_the_step_between(quantity):
    """Two pieces are two motions pooled with one noise: all steps but the one between them.

    The likelihood of the cut track is the dense one without that step; a jump across the cut is
    not seen at all.
    """
    motion = tracked(cloud(5, n_frames=120))
    piece = np.repeat([0, 1], [50, 70])
    whole, cut = (steps_of(m, quantity) for m in (motion, dataclasses.replace(motion, piece=piece)))
    assert len(whole.vectors) - len(cut.vectors) == 1
    assert np.flatnonzero(~whole.linked).tolist() == [118]
    assert np.flatnonzero(~cut.linked).tolist() == [48, 117]
    steady = dataclasses.replace(motion, piece=piece)
    turned = np.where(piece[:, None, None] == 1, TURN @ motion.rotation, motion.rotation)
    moved = dataclasses.replace(
        steady, center=motion.center + 100.0 * piece[:, None], rotation=turned
    )
    a, b = (estimate_diffusion(m, quantity=quantity) for m in (steady, moved))
    assert np.allclose(numbers(b), numbers(a), rtol=1e-9)


# ---- planted truths: a smoke test of coverage ---------------------------------------------------


@pytest.fixture(scope="module")
def standard(repeats):
    """Return 30 or 200 tracks (N = 300, SNR 20, sigma/R = 0.02) and their D_R and D_T."""
    motions = all_tracked(cloud(1000 + seed) for seed in range(repeats(30, 200)))
    found = {q: all_estimated(motions, q) for q in QUANTITIES}
    return motions, found


@pytest.mark.parametrize("quantity", QUANTITIES)
def test_intervals_cover(standard, quantity):
    """95 % intervals hold the truth in 95 % of the tracks, 68 % intervals in 68 %.

    Within 2.6 and 3 Monte-Carlo errors: of 200 tracks in >= 91 %, and in 58 to 78 %.
    """
    truth, found = planted(quantity), standard[1][quantity]
    wide = np.mean([e.ci95[0] < truth < e.ci95[1] for e in found])
    narrow = np.mean([e.ci68[0] < truth < e.ci68[1] for e in found])
    print(f"{quantity}: coverage {narrow:.3f} / {wide:.3f}")
    assert wide >= least_cover(len(found), errors=2.6)
    assert abs(narrow - 0.68) <= 0.68 - least_cover(len(found), 0.68)


@pytest.mark.parametrize("quantity", QUANTITIES)
def test_errors_reach_the_cramer_rao_bound(standard, quantity):
    """The rms error is 8.3 % (joint bound, N = 300, SNR 20) within 3 Monte-Carlo errors.

    (value - truth)/stderr has an rms of 1 within 3 (4 above); the mean is within 3 standard errors.
    Of 200 tracks one Monte-Carlo error of an rms is 5 %.
    """
    truth, found = planted(quantity), standard[1][quantity]
    values = np.array([e.value for e in found]) / truth
    pull = np.array([(e.value - truth) / e.stderr for e in found])
    rms = np.sqrt(np.mean((values - 1) ** 2))
    print(f"{quantity}: rms/bound {rms / 0.083:.3f}, rms pull {np.sqrt(np.mean(pull**2)):.3f}")
    assert rms == pytest.approx(0.083, rel=sd_error(len(found)))
    assert -sd_error(len(found)) <= np.sqrt(np.mean(pull**2)) - 1 <= sd_error(len(found), 4)
    assert abs(values.mean() - 1) < 3 * standard_error(values)


@pytest.mark.parametrize("quantity", QUANTITIES)
def test_offsets_scatter_about_the_planted_noise(standard, quantity):
    """(offset - planted)/offset_stderr has mean 0 and sd 1 within 3 Monte-Carlo errors.

    Planted is s = 3 Phi^2/12 of noise_floor, or sigma^2/n; at SNR 20 the spread is mostly D's.
    """
    floor = noise_floor(TETRAHEDRON, sigma=SIGMA)
    s = np.trace(floor.covariance) / 3 if quantity == "rotation" else SIGMA**2 / 4
    assert s == pytest.approx(S_R if quantity == "rotation" else S_T, rel=1e-12)
    found = standard[1][quantity]
    z = np.array([(e.offset - s) / e.offset_stderr for e in found])
    print(f"{quantity}: offset z {z.mean():.3f} +- {z.std():.3f}")
    assert abs(z.mean()) < 3 / np.sqrt(len(z))
    assert abs(z.std() - 1) < sd_error(len(z))


@pytest.fixture(scope="module")
def noisy(repeats):
    """Return tracks at a signal-to-noise ratio of 0.3."""
    return all_tracked(cloud(s, snr=0.3) for s in range(repeats(12, 40)))


@pytest.mark.parametrize("quantity", QUANTITIES)
def test_noisy_offsets_equal_the_floor(quantity, noisy):
    """At SNR 0.3 noise dominates: the offset is the planted floor within 3 standard errors, sd 1.

    The sd of the z-scores is 1 within 3 errors (34 % of 40 tracks).
    """
    found = all_estimated(noisy, quantity)
    s = S_R if quantity == "rotation" else S_T
    offsets = np.array([e.offset for e in found])
    z = (offsets - s) / [e.offset_stderr for e in found]
    assert abs(offsets.mean() - s) < 3 * standard_error(offsets)
    assert abs(z.std(ddof=1) - 1) < sd_error(len(z) - 1)


@pytest.mark.parametrize("quantity", QUANTITIES)
def test_five_pooled_tracks_have_their_common_error(standard, quantity):
    """5 tracks pooled: 1/sqrt(5) of the error within 10 %; 6 (20) pools cover 5 (16) times."""
    motions, found = standard
    truth = planted(quantity)
    count = min(len(motions) // 5, 20)
    starts = 5 * np.arange(count)
    pools = [estimate_diffusion(motions[i : i + 5], quantity=quantity) for i in starts]
    single = np.mean([e.stderr for e in found[quantity]])
    assert np.mean([e.stderr for e in pools]) == pytest.approx(single / np.sqrt(5), rel=0.1)
    assert np.mean([e.ci95[0] < truth < e.ci95[1] for e in pools]) >= least_cover(count)
    values = np.array([e.value for e in pools])
    assert abs(values.mean() - truth) < 3 * standard_error(values)
    assert all(e.n_frames == 1500 for e in pools)


# ---- planted truths: gaps, missing particles, blur, bodies, the plane ---------------------------


def check_unbiased(motions, truths=None):
    """Check that D_R and D_T are within 3 standard errors of the truth, and intervals cover."""
    every, least = {}, min(least_cover(len(motions)), 0.85)
    for quantity in QUANTITIES:
        truth = (truths or {}).get(quantity, planted(quantity))
        found = all_estimated(motions, quantity)
        values = np.array([e.value for e in found]) / truth
        assert abs(values.mean() - 1) < 3 * standard_error(values), (quantity, values.mean())
        assert np.mean([e.ci95[0] < truth < e.ci95[1] for e in found]) >= least, quantity
        every[quantity] = found
    return every


def test_missing_frames_do_not_bias(repeats):
    """30 % of the frames missing: the mean of the tracks is the truth within 3 standard errors.

    A gap taken for one step would add 45 %, 45 standard errors of 100 tracks and 9 of 8 short ones.
    """
    check_unbiased(
        all_tracked(
            lossy(s, frames=0.3, snr=5.0, n_frames=repeats(150, 300))
            for s in range(repeats(8, 100))
        ),
        {q: planted(q, 5.0) for q in QUANTITIES},
    )


@pytest.mark.parametrize("blur", [1, 8])
def test_missing_particles_do_not_bias(blur, repeats):
    """15 % of the particles of a bipyramid missing, with and without blur: D is unbiased.

    Its noise differs by axis and frame, blur does not: taken for one another they cost 20 %.
    """
    cluster = Cluster.touching(5, 2.45)
    check_unbiased(
        all_tracked(
            lossy(s, particles=0.15, cluster=cluster, substeps=blur) for s in range(repeats(5, 30))
        )
    )


@pytest.mark.parametrize(
    "cluster", [TETRAHEDRON, Cluster.trimer(1.5)], ids=["tetrahedron", "trimer"]
)
def test_blur_makes_negative_offsets_and_no_bias(cluster, repeats):
    """A shutter that never closes: the offset is s - D dt/3 < 0 and D is unbiased."""
    count = repeats(6, 30)
    motions = all_tracked(cloud(s, cluster=cluster, substeps=8, snr=50.0) for s in range(count))
    every = check_unbiased(motions, {q: planted(q, 50.0) for q in QUANTITIES})
    for quantity, found in every.items():
        offsets = [e.offset / planted(quantity, 50.0) for e in found]
        # Of 8 substeps the blur is (1 - 1/8^2)/3 of D dt; the trimer has 4/3 of the noise.
        expected = -(1 - 1 / 64) / 3 + 0.02
        assert np.mean(offsets) == pytest.approx(expected, abs=3 * standard_error(offsets) + 0.01)


def test_noise_that_differs_by_axis_is_distinguished_from_blur(repeats):
    """A slender body with 7 times the noise about its long axis, blurred: D_R is still unbiased."""
    body = Cluster.from_positions(
        [[-1.5, 0.3, 0], [-0.5, -0.3, 0.3], [0.5, 0.3, -0.3], [1.5, -0.3, 0]]
    )
    check_unbiased(all_tracked(cloud(s, cluster=body, substeps=8) for s in range(repeats(6, 30))))


def test_poor_z_does_not_bias_D_T(repeats):
    """With sigma_z = 4 sigma_xy D_T is unbiased and covers, however the laboratory is turned."""
    motions = all_tracked(
        cloud(s, sigma=(0.03, 0.03, 0.12), snr=2.0) @ TURN.T for s in range(repeats(12, 60))
    )
    truth = planted("translation", 2.0)
    found = all_estimated(motions, "translation")
    values = np.array([e.value for e in found]) / truth
    assert abs(values.mean() - 1) < 3 * standard_error(values)
    assert np.mean([e.ci95[0] < truth < e.ci95[1] for e in found]) >= least_cover(len(found))


def test_in_the_plane_one_angle_and_two_coordinates(repeats):
    """2-D: D_R with 2 D t and D_T with 4 D t come back; rms error sqrt(6/N), sqrt(6/2N).

    The known limits of joint estimates within 3 Monte-Carlo errors (34 % of 40 tracks).
    """
    flat, tracks = Cluster.from_positions([[0, 0], [2, 0], [1, 1.6]]), []
    truth, frames = {"rotation": 4e-3, "translation": 0.03}, repeats(150, 300)
    for seed in range(repeats(12, 40)):
        m = simulate_motion(flat, D_R=4e-3, D_T=0.03, dt=1.0, n_frames=frames, rng=seed)
        tracks.append(add_noise(m.positions(), sigma=0.02, rng=900 + seed))
    every = check_unbiased(all_tracked(tracks), truth)
    for quantity, angles in (("rotation", 1), ("translation", 2)):
        values = np.array([e.value for e in every[quantity]])
        rms = np.sqrt(np.mean((values / truth[quantity] - 1) ** 2))
        assert rms == pytest.approx(np.sqrt(6 / (frames * angles)), rel=sd_error(len(values)))


def test_an_anisotropic_body_has_a_third_of_the_trace(repeats):
    """D = (1, 1, 10)e-3 rad^2/s: the mean value is 4e-3, and the stated error is the scatter.

    Unequal axes scatter sqrt(34/16 x 3)/sqrt(3) = 1.46 times as widely as equal ones: the stated
    error of an isotropic body would be 32 % low, beyond three Monte-Carlo errors (30 % of 50
    tracks, 17 % of 150), and its interval would cover 0.50 instead of 0.68.
    """
    tensor = kabsch(*np.random.default_rng(5).normal(size=(2, 5, 3)))
    tensor = tensor @ np.diag([1e-3, 1e-3, 10e-3]) @ tensor.T
    tracks = []
    for seed in range(repeats(50, 150)):
        frames = repeats(100, 300)
        m = simulate_motion(TETRAHEDRON, D_R=tensor, dt=1.0, n_frames=frames, rng=seed)
        tracks.append(add_noise(m.positions(), sigma=SIGMA, rng=500 + seed))
    found = all_estimated(all_tracked(tracks))
    values = np.array([e.value for e in found])
    # The longest axis turns by 4 D dt = 0.04: rotation vectors read the mean low by 0.1 %.
    assert abs(values.mean() - 4e-3) < 3 * standard_error(values)
    assert np.mean([e.stderr for e in found]) == pytest.approx(
        values.std(), rel=sd_error(len(found))
    )
    cover = np.mean([e.ci68[0] < 4e-3 < e.ci68[1] for e in found])
    assert cover > least_cover(len(found), 0.68)


def test_uneven_times_are_taken_as_they_are(repeats):
    """Frames at random times: D is unbiased, where equal steps would not be."""
    motions, frames = [], repeats(300, 600)
    for seed in range(repeats(8, 40)):
        keep = np.flatnonzero(np.random.default_rng(seed).random(frames) < 0.4)
        x = cloud(seed, n_frames=frames)[keep]
        motions.append(tracked(x, times=keep.astype(float)))
    check_unbiased(motions)


def test_a_motionless_cluster_gets_an_upper_limit(repeats):
    """D = 0 with noise: not resolved, an upper limit in print; one in 20 may exclude 0 for D_T.

    For D_R adding noisy steps reads up to 0.04 (sigma/R)^4/dt: an interval that excludes 0 lies
    below ten such floors.
    """
    beyond, count = 0, repeats(8, 30)
    motions = all_tracked(cloud(seed, snr=0.0) for seed in range(count))
    spins, drifts = (all_estimated(motions, q) for q in QUANTITIES)
    for seed in range(count):
        spin, drift = spins[seed], drifts[seed]
        assert spin.resolution_floor == pytest.approx(0.04 * 0.02**4, rel=0.2)
        assert spin.ci95[0] == 0 or spin.value < 10 * spin.resolution_floor
        assert not spin.resolved
        assert "<" in str(spin)
        assert "95 % limit" in str(spin)
        assert f"{spin.ci95[1]:.2g}" in str(spin)
        assert spin.ci95[1] < 0.01 * S_R
        assert drift.resolution_floor is None
        assert drift.resolved == (drift.ci95[0] > 0)
        beyond += drift.resolved
    assert beyond <= repeats(2, 4)


# ---- what is known of the noise -----------------------------------------------------------------


def relative(motions, truth, **how):
    """Return the mean of D over the truth, its standard error, the spread, and the 95 % cover."""
    found = all_estimated(motions, **how)
    values = np.array([e.value for e in found]) / truth
    cover = np.mean([e.ci95[0] < truth < e.ci95[1] for e in found])
    return values.mean(), standard_error(values), values.std(), cover


@pytest.mark.parametrize("method", ["mle", "cve"])
@pytest.mark.parametrize("noise", ["residual", SIGMA])
def test_known_noise_saves_two_thirds_of_the_frames(standard, method, noise):
    """At SNR 20 the spread falls from 8.3 % to the bound of 4.9 %, and the interval covers.

    Within three Monte-Carlo errors: 15 % of the spread of 200 tracks, and a cover of 0.90.
    """
    truth = planted("rotation")
    mean, error, spread, cover = relative(standard[0], truth, method=method, noise=noise)
    assert abs(mean - 1) < 3 * error
    assert spread == pytest.approx(0.049, rel=sd_error(len(standard[0])) + 0.02)
    assert cover > least_cover(len(standard[0]))


def test_a_wrong_sigma_moves_D_the_other_way(repeats):
    """Noise held 10 % too high lowers D at SNR 1: d ln D/d ln s = -0.5, so by 10 %."""
    motions = all_tracked(cloud(s, snr=1.0) for s in range(repeats(10, 60)))
    right, high = (relative(motions, planted("rotation", 1.0), noise=k * SIGMA) for k in (1, 1.1))
    assert high[0] - right[0] == pytest.approx(-0.10, abs=0.02)


def test_stated_exposure_undoes_the_blur(repeats):
    """A shutter open all the time, noise from the residuals: -26 % if unstated, right if stated.

    Stated to the joint estimate it changes only the range of the noise offset.
    """
    frames, substeps = repeats(150, 300), repeats(10, 20)
    motions = all_tracked(
        cloud(s, frames, substeps=substeps, snr=5.0) for s in range(repeats(10, 40))
    )
    truth = planted("rotation", 5.0)
    unstated = relative(motions, truth, noise="residual")
    stated = relative(motions, truth, noise="residual", exposure=1.0)
    joint = relative(motions, truth, exposure=1.0)
    assert unstated[0] == pytest.approx(0.74, abs=repeats(0.07, 0.03))
    assert abs(stated[0] - 1) < 3 * stated[1]
    assert abs(joint[0] - 1) < 3 * joint[1]
    assert stated[2] < joint[2]


def test_exposure_zero_keeps_the_offset_above_zero(standard, repeats):
    """Frozen frames cannot have negative noise; unknown exposure may, in some of 60 tracks.

    In the quick form only the 10 tracks with the lowest offsets are estimated again.
    """
    offsets = np.array([e.offset for e in standard[1]["translation"][:60]])
    lowest = np.argsort(offsets)[: repeats(10, 60)]
    kept = all_estimated([standard[0][i] for i in lowest], "translation", exposure=0.0)
    assert min(offsets) < 0 <= min(e.offset for e in kept)


def test_covariances_agree_with_the_likelihood_where_they_should(standard):
    """At SNR 20 CVE is as good as likelihood: equal spread within 15 %, its interval covers."""
    truth = planted("rotation")
    mean, error, spread, cover = relative(standard[0], truth, method="cve")
    assert abs(mean - 1) < 3 * error
    likelihood = np.std([e.value / truth for e in standard[1]["rotation"]])
    assert spread == pytest.approx(likelihood, rel=0.15)
    assert cover > least_cover(len(standard[0]))


@pytest.fixture(scope="module")
def gapped(repeats):
    """Return tracks with 30 % of frames and 3 % of particles missing at SNR 2."""
    return all_tracked(
        lossy(s, frames=0.3, particles=0.03, snr=2.0) for s in range(repeats(12, 100))
    )


@pytest.mark.parametrize("noise", ["joint", "residual"])
def test_covariances_take_gaps_partial_frames_and_low_signal(noise, gapped):
    """CVE with 30 % of frames and 3 % of particles missing at SNR 2: unbiased, and it covers."""
    mean, error, _, cover = relative(
        gapped, planted("rotation", 2.0), method="cve", noise=noise, exposure=0.0
    )
    assert abs(mean - 1) < 3 * error
    assert cover > least_cover(len(gapped))


@pytest.fixture(scope="module")
def coarse(repeats):
    """Return tracks with D_R dt = 0.5."""
    tracks = []
    for seed in range(repeats(16, 30)):
        m = simulate_motion(TETRAHEDRON, D_R=0.5, dt=1.0, n_frames=400, rng=seed)
        tracks.append(add_noise(m.positions(), sigma=SIGMA, rng=900 + seed))
    return all_tracked(tracks)


@pytest.mark.parametrize("noise", ["joint", "residual"])
def test_mean_cosines_are_exact_at_any_step(noise, coarse):
    """At D_R dt = 0.5 likelihood is 10 % low (heat kernel: 0.9015), the mean cosine is right."""
    tracks = coarse
    mean, error, spread, cover = relative(tracks, 0.5, method="trace", noise=noise)
    assert abs(mean - 1) < 3 * error
    assert cover > least_cover(len(tracks))
    stated = [estimate_diffusion(m, method="trace", noise=noise).stderr for m in tracks[:5]]
    assert np.mean(stated) / 0.5 == pytest.approx(spread, rel=sd_error(len(tracks)))
    biased, biased_error, *_ = relative(tracks, 0.5, noise=noise)
    assert abs(biased - 0.9015) < 3 * biased_error


def test_mean_cosines_take_gaps_and_the_plane():
    """Only pairs exactly one and two frames apart count; in the plane <cos> = exp(-D t)."""
    x = lossy(5, frames=0.3, n_frames=3000)
    found = estimate_diffusion(tracked(x), method="trace")
    assert abs(found.value - planted("rotation")) < 3 * found.stderr
    flat = Cluster.from_positions([[0, 0], [2, 0], [1, 1.6]])
    truth = simulate_motion(flat, D_R=0.3, dt=1.0, n_frames=4000, rng=2)
    found = estimate_diffusion(truth, method="trace", noise=0.0)
    assert abs(found.value - 0.3) < 3 * found.stderr
    assert found.stderr < 0.02


def test_a_lost_orientation_is_an_error():
    """Steps so long that the mean cosine is not positive have no D_R."""
    truth = simulate_motion(TETRAHEDRON, D_R=30.0, dt=1.0, n_frames=40, rng=3)
    with pytest.raises(ValueError, match="orientation is lost between frames"):
        estimate_diffusion(truth, method="trace")


def test_drift_is_subtracted_and_reported(repeats):
    """A flow of 5 rms steps a frame: D_T is unbiased with drift, and the velocity is reported.

    Without drift D_T would be 25 times too large.
    """
    flow = np.array([0.9, -0.3, 1.2]) * 5 * np.sqrt(2 * planted("translation"))
    frames = repeats(150, 300)
    time = np.arange(frames)[:, None, None]
    motions = all_tracked(cloud(s, frames) + flow * time for s in range(repeats(8, 60)))
    truth = planted("translation")
    mean, error, _, cover = relative(motions, truth, quantity="translation", drift=True)
    assert abs(mean - 1) < 3 * error
    assert cover > least_cover(len(motions))
    found = estimate_diffusion(motions[0], quantity="translation", drift=True)
    z = (np.array(found.drift[0]) - flow) / np.array(found.drift_stderr[0])
    assert np.all(np.abs(z) < 3.5)
    assert "drift removed" in str(found)
    assert estimate_diffusion(motions[0], quantity="translation").value > 10 * truth


def test_drift_by_reversal_and_time_unit():
    """Time reversal changes the sign of the drift, dt divides it; D_T stays and is divided."""
    x = cloud(3)
    kept = estimate_diffusion(tracked(x), quantity="translation", drift=True)
    back = estimate_diffusion(tracked(x[::-1]), quantity="translation", drift=True)
    slow = estimate_diffusion(tracked(x, dt=60.0), quantity="translation", drift=True)
    assert back.value == pytest.approx(kept.value, rel=1e-7)
    assert np.allclose(back.drift, -np.array(kept.drift), rtol=1e-6)
    assert slow.value == pytest.approx(kept.value / 60, rel=1e-9)
    assert np.allclose(slow.drift, np.array(kept.drift) / 60, rtol=1e-9)


def test_the_probability_that_pooled_motions_agree(repeats):
    """p_same is uniform for equal D (pools of 3 or 5; Kolmogorov 1 %), tiny for D that differ."""
    count, size = repeats(10, 40), repeats(3, 5)
    motions = all_tracked(cloud(2000 + s, n_frames=repeats(50, 100)) for s in range(size * count))
    pools = [motions[size * k : size * (k + 1)] for k in range(count)]
    p = np.sort([estimate_diffusion(pool).p_same for pool in pools])
    ranks = np.arange(1, count + 1) / count
    assert max(np.max(ranks - p), np.max(p - ranks + 1 / count)) < 1.63 / np.sqrt(count)
    fast = [tracked(cloud(s, n_frames=300, snr=40.0)) for s in range(3)]
    assert estimate_diffusion([*motions[:3], *fast]).p_same < 1e-4
    assert estimate_diffusion(motions[0]).p_same is None


@pytest.mark.parametrize(
    ("frames", "snr", "step", "word"),
    [(31, 20.0, 0.02, None), (30, 20.0, 0.02, "29 steps"), (900, 0.4, 0.02, None),
     (900, 0.1, 0.02, "signal-to-noise"), (900, 500.0, 0.17, None), (900, 500.0, 0.23, "trace")],
)  # fmt: skip
def test_warnings_appear_beyond_their_thresholds_only(frames, snr, step, word):
    """Few steps, low SNR and coarse sampling are each warned of beyond their threshold only.

    The planted values keep the estimate on its side of the threshold (seed fixed): SNR 0.2,
    4 D_R dt = 0.2, 30 steps.
    """
    D = step / 4
    sigma = np.sqrt(D / snr / 0.375) * 1.5
    truth = simulate_motion(TETRAHEDRON, D_R=D, D_T=1e-4, dt=1.0, n_frames=frames, rng=12)
    motion = tracked(add_noise(truth.positions(), sigma=sigma, rng=13))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = estimate_diffusion(motion)
    assert [str(w.message) for w in caught] == list(found.warnings)
    assert all(issubclass(w.category, PrecisionWarning) for w in caught)
    if word is None:
        assert found.warnings == ()
    else:
        assert len(found.warnings) == 1
        assert word in found.warnings[0]


def test_the_trace_needs_no_warning_for_coarse_steps():
    """The mean cosine is exact there, and gives no warning."""
    truth = simulate_motion(TETRAHEDRON, D_R=0.1, dt=1.0, n_frames=300, rng=1)
    assert estimate_diffusion(truth, method="trace").warnings == ()


def test_turning_in_the_plane_has_no_finite_step_bias():
    """Angles about one axis add up: in the plane 4 D_R dt = 0.4 gives no warning; 2.4 does."""
    flat = Cluster.from_positions([[0, 0], [2, 0], [1, 1.6]])
    for D, warned in ((0.1, False), (0.6, True)):
        truth = simulate_motion(flat, D_R=D, dt=1.0, n_frames=3000, rng=4)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = estimate_diffusion(truth)
        assert bool(found.warnings) is warned
        if not warned:
            assert abs(found.value - D) < 3 * found.stderr


# ---- the solver on extreme input ----------------------------------------------------------------


@pytest.mark.parametrize("n_frames", [3, 4, 5, 8])
@pytest.mark.parametrize("snr", [0.01, 20.0])
def test_a_handful_of_frames_gives_finite_nested_intervals(n_frames, snr, repeats):
    """3, 4, 5 or 8 frames, 2 or 10 tracks each: finite, nested; most cannot exclude 0."""
    for seed in range(repeats(2, 10)):
        motion = tracked(cloud(seed, n_frames=n_frames, snr=snr))
        for quantity in QUANTITIES:
            assert_sane(estimate_diffusion(motion, quantity=quantity))


@functools.cache
def extreme(kind):
    """Return a motion that is difficult for a solver."""
    x, rng = cloud(21, n_frames=150), np.random.default_rng(0)
    row = np.arange(150)[:, None, None]
    half = np.where(row < 75, x.mean(axis=1, keepdims=True), 0)
    pi_turn = np.where(row < 75, x, (x - half) * [-1, -1, 1])
    still = simulate_motion(TETRAHEDRON, D_R=0.0, dt=1.0, n_frames=50, rng=0)
    truth = simulate_motion(TETRAHEDRON, D_R=5e-3, D_T=0.04, dt=0.7, n_frames=100, rng=0)
    tiny = cloud(22, n_frames=150, snr=1e6, sigma=SIGMA * 1e-3) * 1e-9
    return {
        "snr 1e-4": lambda: tracked(cloud(23, snr=1e-4)),
        "snr 1e6, nm in m": lambda: tracked(tiny),
        "dt 1e-12": lambda: tracked(x, dt=1e-12),
        "truth": lambda: truth,
        "truth fitted": lambda: tracked(truth.positions()),
        "at rest": lambda: still,
        "at rest, fitted": lambda: tracked(still.positions()),
        "drift": lambda: tracked(x + 100.0 * row),
        "ballistic": lambda: tracked(TETRAHEDRON.positions + 0.1 * np.arange(100)[:, None, None]),
        "to and fro": lambda: tracked(
            TETRAHEDRON.positions + 0.1 * (np.arange(100) % 2)[:, None, None]
        ),
        "one jump": lambda: tracked(np.where(row < 75, x, x + 1e6)),
        "one spike": lambda: tracked(np.where(row == 75, x + 1e6, x)),
        "half turn": lambda: tracked(pi_turn),
        "tumbling": lambda: tracked(cloud(24, snr=2e4)),
        "coarse pixels": lambda: tracked(np.round(x / 0.5) * 0.5),
        "far away": lambda: tracked(x + 1e9),
        "a gap of 1e6": lambda: tracked(x, frames=np.r_[:75, 10**6 : 10**6 + 75]),
        "12 decades": lambda: tracked(x, times=np.cumsum(10 ** rng.uniform(-6, 6, 150))),
        "half blind": lambda: tracked(lossy(25, frames=0.5, particles=0.1)),
    }[kind]()


KINDS = [
    "snr 1e-4", "snr 1e6, nm in m", "dt 1e-12", "truth", "truth fitted", "at rest",
    "at rest, fitted", "drift", "ballistic", "to and fro", "one jump", "one spike", "half turn",
    "tumbling", "coarse pixels", "far away", "a gap of 1e6", "12 decades", "half blind",
]  # fmt: skip


@pytest.mark.parametrize("quantity", QUANTITIES)
@pytest.mark.parametrize("kind", KINDS)
def test_strange_motions_get_finite_answers(kind, quantity, passes):
    """Finite numbers, nested intervals, no warning, and at most 120 passes over the steps."""
    motion = extreme(kind)
    assert_sane(estimate_diffusion(motion, quantity=quantity))
    assert len(passes) < 120


@pytest.mark.parametrize("quantity", QUANTITIES)
def test_random_strange_motions(quantity, repeats):
    """Random mixtures of few frames, odd units, SNR 1e-3 to 1e6 and body: finite and nested."""
    rng = np.random.default_rng(99)
    bodies = [TETRAHEDRON, Cluster.trimer(1.0), Cluster.touching(5, 2.45), Cluster.touching(7, 2.0)]
    for seed in range(repeats(10, 40)):
        snr, unit = 10 ** rng.uniform(-3, 6), 10.0 ** rng.integers(-9, 9)
        sigma = min(SIGMA, SIGMA * np.sqrt(2e3 / snr))
        x = cloud(seed, n_frames=int(rng.choice([3, 4, 6, 12, 60])), cluster=bodies[seed % 4],
                  snr=min(snr, 2e3), sigma=sigma)  # fmt: skip
        assert_sane(
            estimate_diffusion(tracked(x * unit, dt=10 ** rng.uniform(-6, 3)), quantity=quantity)
        )


def test_a_body_at_rest_has_D_zero():
    """A body that never moves has D = 0 with an empty interval, and is not resolved."""
    still = simulate_motion(TETRAHEDRON, D_R=5e-3, D_T=0.0, dt=1.0, n_frames=100, rng=0)
    found = estimate_diffusion(still, quantity="translation")
    assert (found.value, found.ci68, found.ci95) == (0.0, (0.0, 0.0), (0.0, 0.0))
    assert not found.resolved
    assert estimate_diffusion(still).resolved


def test_a_pool_with_a_body_at_rest_is_finite(repeats):
    """One body that never moves gives D = 0 with certainty, and so does the pool."""
    still = simulate_motion(TETRAHEDRON, D_R=0.0, dt=1.0, n_frames=20, rng=0)
    for quantity in QUANTITIES[repeats(1, 0) :]:
        found = estimate_diffusion([tracked(cloud(1, n_frames=20)), still], quantity=quantity)
        assert_sane(found)
        assert not found.resolved


def test_an_axis_at_rest_counts_in_the_mean():
    """A planar track in a table with a constant z has 2/3 of the plane's D_T: trace/3, exactly."""
    flat = Cluster.from_positions([[0, 0], [2, 0], [1, 1.6]])
    truth = simulate_motion(flat, D_R=4e-3, D_T=0.03, dt=1.0, n_frames=200, rng=3)
    x = add_noise(truth.positions(), sigma=0.02, rng=4)
    deep = np.concatenate([x, np.full_like(x[..., :1], 7.3)], axis=2)
    plane, space = (estimate_diffusion(tracked(y), quantity="translation") for y in (x, deep))
    assert space.value == pytest.approx(2 / 3 * plane.value, rel=1e-9)


def test_a_long_track_is_solved_from_any_guess():
    """1e5 frames: the best offset at the true D is found from the one at D = 0, and is the noise.

    Without diffusion a long diffusive track needs an offset far above the step; a search begun
    there once crept, and ended in a wrong D. The noise comes back within 4 standard errors (D
    known: that is 0.2 % of D, measured).
    """
    truth = simulate_motion(TETRAHEDRON, D_R=0.0, D_T=4.5e-3, dt=1.0, n_frames=100_000, rng=1)
    noise = np.random.default_rng(2).normal(scale=0.015, size=truth.center.shape)
    motion = dataclasses.replace(truth, center=truth.center + noise)
    steps = steps_of(motion, "translation")
    likelihood = Likelihood.of([NoisySteps.free(steps, blur=0.0, drift=False)])
    start = likelihood.profile(np.zeros(1))
    assert start.theta > 100 * np.mean(steps.vectors**2)
    D = np.array([4.5e-3])
    found, fresh = likelihood.profile(D, start.theta).theta, likelihood.profile(D).theta
    assert found == pytest.approx(fresh, rel=1e-8)
    assert found == pytest.approx(0.015**2, abs=4 * 0.002 * 4.5e-3)


# ---- refusals -----------------------------------------------------------------------------------


def test_too_few_frames_are_refused():
    """Two poses, or three in pieces of two and one, cannot separate diffusion from noise."""
    two = tracked(cloud(1, n_frames=2))
    with pytest.raises(TooFewFramesError, match="2 frames") as caught:
        estimate_diffusion(two)
    assert caught.value.n_frames == 2
    pieces = dataclasses.replace(tracked(cloud(1, n_frames=3)), piece=np.array([0, 0, 1]))
    with pytest.raises(TooFewFramesError):
        estimate_diffusion(pieces, quantity="translation")
    with pytest.raises(TooFewFramesError, match="motion 1"):
        estimate_diffusion([tracked(cloud(1, n_frames=9)), two])


def test_all_faults_come_in_one_message():
    """Unknown quantity, method and noise are named together, with what is offered."""
    motion = tracked(cloud(1, n_frames=9))
    with pytest.raises(ValueError, match="quantity") as caught:
        estimate_diffusion(motion, quantity="spin", method="magic", noise="loud")
    for word in ("spin", "magic", "loud", "rotation", "translation", "mle", "cve", "joint"):
        assert word in str(caught.value)


@pytest.mark.parametrize(
    ("wrong", "word"),
    [
        ({"noise": -0.1}, "noise"),
        ({"noise": np.nan}, "noise"),
        ({"exposure": 1.2}, "exposure"),
        ({"exposure": "half"}, "exposure"),
        ({"exposure": "0.5"}, "exposure"),
        ({"drift": True, "method": "trace"}, "drift"),
        ({"drift": True, "quantity": "translation", "method": "cve"}, "drift"),
        ({"method": "trace", "quantity": "translation"}, "trace"),
    ],
)
def test_invalid_choices_are_refused(wrong, word):
    """Negative noise, an exposure over 1, a drift of D_R: refused by name."""
    with pytest.raises(ValueError, match=word):
        estimate_diffusion(tracked(cloud(1, n_frames=9)), **wrong)


def test_two_and_three_dimensions_do_not_pool():
    """Motions of the plane and of space, or none at all, are refused."""
    flat = Cluster.from_positions([[0, 0], [2, 0], [1, 1.6]])
    plane = simulate_motion(flat, D_R=4e-3, D_T=0.03, dt=1.0, n_frames=20, rng=3)
    with pytest.raises(ValueError, match="all in 2 or all in 3 dimensions"):
        estimate_diffusion([plane, tracked(cloud(1, n_frames=20))])
    with pytest.raises(ValueError, match="one or more motions"):
        estimate_diffusion([])


# ---- options and results as JSON ----------------------------------------------------------------


@pytest.mark.parametrize(
    "options",
    [Noise(), Noise("residual", exposure=0.5), Noise(0.03, drift=True), Noise(exposure=0.0)],
    ids=str,
)
def test_a_noise_is_its_three_keywords(options):
    """Noise, exposure and drift stated together give the estimate that the keywords give."""
    motion = tracked(cloud(1, n_frames=60))
    together = estimate_diffusion(motion, noise=options)
    apart = estimate_diffusion(
        motion, noise=options.model, exposure=options.exposure, drift=options.drift
    )
    assert together == apart
    assert together.settings == options


def test_a_noise_and_its_keywords_together_are_refused():
    """An option stated twice is named; the faults of a Noise are those of the keywords."""
    motion = tracked(cloud(1, n_frames=60))
    with pytest.raises(ValueError, match=r"exposure: stated in noise=.*; drift: stated in noise="):
        estimate_diffusion(motion, noise=Noise(exposure=0.5), exposure=0.5, drift=True)
    with pytest.raises(ValueError, match='drift=True needs method="mle"'):
        estimate_diffusion(motion, noise=Noise(drift=True), method="cve")
    with pytest.raises(ValueError, match=r"noise: .*loud.*; exposure: .*1.5"):
        Noise("loud", exposure=1.5)


def estimates():
    """Return estimates of every kind: pooled, with drift, without bound, absent, at rest."""
    motion = tracked(cloud(1, n_frames=60))
    still = simulate_motion(TETRAHEDRON, D_R=0.0, dt=1.0, n_frames=20, rng=0)
    return {
        "joint": estimate_diffusion(motion),
        "sigma": estimate_diffusion(motion, noise=0.03, exposure=0.5),
        "residual": estimate_diffusion(motion, noise="residual"),
        "drift": estimate_diffusion(motion, quantity="translation", drift=True),
        "pooled": estimate_diffusion([motion, tracked(cloud(2, n_frames=60))]),
        "trace": estimate_diffusion(motion, method="trace"),
        "three frames": estimate_diffusion(tracked(cloud(1, n_frames=3))),
        "at rest": estimate_diffusion(still),
        "without noise": estimate_diffusion(
            simulate_motion(TETRAHEDRON, D_R=5e-3, dt=1.0, n_frames=60, rng=0)
        ),
        "absent": DiffusionEstimate.absent(quantity="rotation", n_frames=3, reason="why: so"),
        "curve": DiffusionEstimate.judged(
            Found.normal(1e-3, 1e-4, 0.0, 1e-5),
            quantity="rotation",
            method="line",
            n_frames=9,
            dt=1.0,
            noise_variance=np.nan,
        ),
    }


@pytest.mark.filterwarnings("ignore::perrin.PrecisionWarning")
def test_an_estimate_comes_back_from_json():
    """Every field of an estimate survives to_dict, JSON and from_dict, whatever is unknown."""
    for name, estimate in estimates().items():
        back = DiffusionEstimate.from_dict(json.loads(json.dumps(estimate.to_dict())))
        for field in dataclasses.fields(estimate):
            np.testing.assert_equal(
                getattr(back, field.name), getattr(estimate, field.name), err_msg=name
            )
        assert str(back) == str(estimate)


# ---- print and speed ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "stderr", "text"),
    [
        (0.00471, 0.00052, "0.0047(5)"),
        (0.0385, 0.0019, "0.0385(19)"),
        (0.0386, 0.0021, "0.039(2)"),
        (38.5, 12.0, "38(12)"),
        (1234.0, 320.0, "1200(300)"),
        (0.001, 9.96e-5, "0.00100(10)"),
        (0.001, 9.4e-5, "0.00100(9)"),
        (0.001, 1.96e-4, "0.0010(2)"),
        (0.001, 1.94e-4, "0.00100(19)"),
        (-0.0047, 0.0005, "-0.0047(5)"),
        (0.0, 0.0005, "0.0000(5)"),
        (5.0, 0.96, "5.0(10)"),
        (12345.0, 96.0, "12340(100)"),
        (0.0047, 0.0, "0.0047"),
        (0.0, 0.0, "0"),
        (0.00471234, np.inf, "0.00471"),
        (0.00471234, np.nan, "0.00471"),
        (-1.5, -1.0, "-1.5"),
    ],
)
def test_with_error(value, stderr, text):
    """The error is in brackets, in units of the last digit; without one there is only the value."""
    assert with_error(value, stderr) == text


def test_an_estimate_prints_and_converts():
    """str() gives name, value with error, unit, method and frames; float() the value."""
    motion = tracked(cloud(4))
    for quantity, head, unit in (("rotation", "D_R", "rad^2/s"), ("translation", "D_T", "um^2/s")):
        found = estimate_diffusion(motion, quantity=quantity)
        expected = f"{head} = {with_error(found.value, found.stderr)} {unit} [mle, 300 frames]"
        assert str(found) == expected
        assert float(found) == found.value
        assert found.stderr == pytest.approx((found.ci68[1] - found.ci68[0]) / 2)
        with pytest.raises(dataclasses.FrozenInstanceError):
            found.value = 1.0


def test_missing_frames_are_not_counted():
    """n_frames is the number of frames with a pose."""
    x = lossy(3, frames=0.3)
    motion = tracked(x)
    assert isinstance(motion, RigidMotion)
    assert estimate_diffusion(motion).n_frames == motion.fitted.size < 300


@pytest.mark.parametrize("quantity", QUANTITIES)
def test_an_estimate_takes_few_passes(standard, quantity, passes, repeats):
    """An estimate with both intervals takes under 40 passes over the steps."""
    for motion in standard[0][: repeats(4, 8)]:
        passes.clear()
        estimate_diffusion(motion, quantity=quantity)
        assert len(passes) < 40
