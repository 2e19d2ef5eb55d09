"""Rods: direction and its diffusion are measured, the two ends are identified."""

from __future__ import annotations

import json
from dataclasses import fields

import numpy as np
import pytest

import perrin
from perrin.diffusion.steps import direction_steps
from perrin.motion.rods import RodMotion

D_PERP, DT = 0.01, 0.5


def rod(seed, *, places=(0.0, 2.0), n_frames=300, sigma=0.03, D_perp=D_PERP):
    """Return noisy positions of particles on a line, turning fast about it, and the truth."""
    rng = np.random.default_rng(seed)
    body = perrin.Cluster.from_positions([[0.0, 0.0, z] for z in places])
    truth = perrin.simulate_motion(
        body, D_R=(D_perp, D_perp, 0.3), D_T=0.03, dt=DT, n_frames=n_frames, rng=rng
    )
    return perrin.add_noise(truth.positions(), sigma=sigma, rng=rng), truth


@pytest.mark.parametrize("places", [(0.0, 2.0), (0.0, 1.0, 2.0), (0.0, 1.5, 4.0, 5.0)])
def test_direction_centre_and_noise_come_back(places):
    """The direction errs by its stated variance, and sigma is the planted one (4 sd each)."""
    x, truth = rod(1, places=places)
    motion = perrin.track_direction(x, dt=DT)
    across = motion.direction - truth.rotation[:, :, 2]
    expected = 2 * motion.variance.mean()  # two angles; relative sd of the mean 1/sqrt(300)
    assert (across**2).sum(axis=1).mean() == pytest.approx(expected, rel=4 / np.sqrt(300))
    off = ((motion.center - truth.center) ** 2).mean()
    assert off == pytest.approx(motion.center_variance.mean(), rel=4 * np.sqrt(2 / 900))
    freedom = 300 * (3 * len(places) - 5)
    assert motion.sigma == pytest.approx(0.03, rel=4 / np.sqrt(2 * freedom))
    np.testing.assert_allclose(motion.places, np.array(places) - np.mean(places), atol=0.01)


def test_d_perp_comes_back_with_its_intervals(repeats):
    """20 dumbbells (quick: 8): mean within 3 errors, at most 4 (3) beyond their 95 % interval."""
    count = repeats(8, 20)
    motions = [perrin.track_direction(rod(s)[0], dt=DT) for s in range(count)]
    for quantity, planted in (("direction", D_PERP), ("translation", 0.03)):
        found = [perrin.estimate_rod(m, quantity=quantity) for m in motions]
        mean = np.mean([e.value for e in found])
        assert abs(mean - planted) < 3 * np.mean([e.stderr for e in found]) / np.sqrt(count)
        outside = sum(not e.ci95[0] < planted < e.ci95[1] for e in found)
        # 5 or more of 20, or 4 or more of 8, at 5 % each: probability 0.003 and 0.0004.
        assert outside <= repeats(3, 4)


def test_the_turn_about_the_own_axis_does_not_enter():
    """The steps of a still direction are noise only, however the particles' frame turns."""
    x, _ = rod(2, D_perp=0.0, sigma=0.0)
    steps = direction_steps(perrin.track_direction(x, dt=DT))
    np.testing.assert_allclose(steps.vectors, 0.0, atol=1e-7)


def test_steps_of_a_known_path():
    """Along a great circle every step is the same angle in the same one of the two axes."""
    angle = 0.1 * np.arange(20)
    u = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    x = np.stack([-u, u], axis=1) + np.arange(20)[:, None, None]
    steps = direction_steps(perrin.track_direction(x, dt=1.0))
    np.testing.assert_allclose(np.linalg.norm(steps.vectors, axis=1), 0.1)
    np.testing.assert_allclose(
        steps.vectors, np.broadcast_to(steps.vectors[0], (19, 2)), atol=1e-12
    )


def test_exchanged_ends_are_corrected():
    """Labels that are exchanged for good are reported and corrected; the direction is the same."""
    x, _ = rod(3)
    mixed = x.copy()
    for k in (50, 51, 200):
        mixed[k:] = mixed[k:, ::-1].copy()
    right, found = (perrin.track_direction(y, dt=DT) for y in (x, mixed))
    assert found.swaps.tolist() == [50, 51, 200]
    np.testing.assert_allclose(found.direction, right.direction, atol=1e-3)


def test_right_labels_of_the_ends_are_kept_and_uncertain_ends_cut():
    """Fast turning: labels are kept; without labels the track is cut at uncertain ends."""
    x, truth = rod(4, D_perp=1.0)
    motion = perrin.track_direction(x, dt=DT)
    assert (np.einsum("ti,ti->t", motion.direction, truth.rotation[:, :, 2]) > 0).all()
    assert not motion.swaps.size
    assert perrin.track_direction(x, dt=DT, labelled=False).piece[-1] > 50


def test_a_chain_with_different_ends_keeps_its_labels():
    """Unequal spacings: half turns are real."""
    x, _ = rod(5, places=(0.0, 1.0, 4.0))
    x[100:] = 2 * x[100:101].mean(axis=1, keepdims=True) - x[100:]
    motion = perrin.track_direction(x, dt=DT)
    assert not motion.swaps.size
    assert motion.direction[99] @ motion.direction[100] < -0.9


def test_missing_particles_and_frames():
    """Two of three fix a direction, with more noise; one does not, with the reason."""
    x, _ = rod(6, places=(0.0, 1.0, 3.0))
    x[10, 0] = np.nan
    x[20, :2] = np.nan
    motion = perrin.track_direction(x, dt=DT)
    assert motion.n_present[10] == 2
    assert motion.variance[10] > motion.variance[11]
    assert motion.reason[20] == "1 of 3 particles, 2 needed"
    assert np.isnan(motion.direction[20]).all()


def test_particles_off_a_line_are_refused():
    """A triangle, particles in one place, a plane, a lone frame."""
    x, _ = rod(7, places=(0.0, 1.0, 2.0))
    bent = x.copy()
    bent[:, 1, 0] += 1.5
    with pytest.raises(perrin.DegenerateClusterError, match="no line"):
        perrin.track_direction(bent, dt=DT)
    with pytest.raises(perrin.DegenerateClusterError, match="one place"):
        perrin.track_direction(np.zeros((5, 2, 3)), dt=DT)
    with pytest.raises(perrin.TooFewFramesError, match="1 frames"):
        perrin.track_direction(x[:1], dt=DT)
    with pytest.raises(ValueError, match=r"expected \(T, n, 3\)"):
        perrin.track_direction(x[..., :2], dt=DT)
    with pytest.raises(perrin.TooFewFramesError, match="too few steps"):
        perrin.estimate_rod(perrin.track_direction(x[:2], dt=DT))


def test_a_rod_survives_json():
    """to_dict, through JSON, and from_dict give back the same bits; NaN is null."""
    x, _ = rod(8, n_frames=30)
    x[5] = np.nan
    motion = perrin.track_direction(x, dt=DT)
    text = json.dumps(motion.to_dict(), allow_nan=False)
    back = RodMotion.from_dict(json.loads(text))
    for field in fields(RodMotion):
        a, b = getattr(back, field.name), getattr(motion, field.name)
        if isinstance(b, np.ndarray):
            assert a.dtype == b.dtype
            np.testing.assert_array_equal(a, b, err_msg=field.name)
        else:
            assert a == b, field.name


def test_a_rod_survives_a_table():
    """to_frame and from_frame give the same motion back."""
    x, _ = rod(8, n_frames=30)
    x[5] = np.nan
    motion = perrin.track_direction(x, dt=DT)
    again = RodMotion.from_frame(motion.to_frame())
    for name in ("time", "center", "direction", "variance", "piece", "places", "swaps"):
        np.testing.assert_array_equal(getattr(again, name), getattr(motion, name))
    assert again.reason == motion.reason
    with pytest.raises(ValueError, match="not made by to_frame"):
        RodMotion.from_frame(motion.to_frame().drop(columns="u_x"))


def test_a_single_long_turn_of_a_quiet_rod_is_judged_by_its_own_size():
    """Turned by 100 degrees the labels are kept, by 160 an exchange and a turn by 20 is found."""
    for degrees, swaps in ((100, []), (160, [20])):
        angle = np.deg2rad(degrees)
        ends = np.outer([-1.0, 1.0], [1.0, 0.0, 0.0])
        turned = np.outer([-1.0, 1.0], [np.cos(angle), np.sin(angle), 0.0])
        x = np.concatenate([np.stack([ends] * 20), np.stack([turned] * 20)])
        x = x + 0.01 * np.random.default_rng(degrees).normal(size=x.shape)
        motion = perrin.track_direction(x, dt=DT)
        assert motion.swaps.tolist() == swaps
        assert not motion.piece.any()
