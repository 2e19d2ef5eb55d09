"""The D of long times of caged and hopping motion."""

from dataclasses import replace

import numpy as np
import pytest

from dense_motions import TETRA, caged
from perrin import LongTimeEstimate, TooFewFramesError, long_time_diffusion, simulate_motion

HOP_D = 0.8**2 / 600


def free(seed=1, n_frames=600, dt=1.0):
    return simulate_motion(TETRA, D_R=2e-3, D_T=0.04, dt=dt, n_frames=n_frames, rng=seed)


def test_a_cage_without_hops_has_an_upper_limit(repeats):
    """The threshold rule finds no diffusion where added steps show about 0.09 L^4 a frame."""
    rng = np.random.default_rng(5)
    motions = [caged(2000, rng) for _ in range(repeats(3, 40))]
    found = [long_time_diffusion(m) for m in motions]
    assert not any(f.resolved for f in found)
    assert all(0.5 < f.threshold < 0.7 for f in found)
    # The short-time D of the cage is L^2/5 = 2e-3 a frame.
    assert all(0 <= f.ci95[1] < 2e-4 for f in found)
    assert "< " in str(found[0])
    assert "95 % limit" in str(found[0])
    added = long_time_diffusion(motions, threshold=0)
    assert added.resolved
    assert abs(added.value - 0.09e-4) < 3 * added.stderr + 1e-6
    assert added.method == "added steps"


def test_hops_come_back_within_their_error(repeats):
    """Pooled tracks with hops of 0.8 rad: the planted D, whatever the rule; 1/sqrt(hops) bounds."""
    rng = np.random.default_rng(6)
    count = repeats(10, 60)
    motions = [caged(1500, rng, hop=0.8) for _ in range(count)]
    for threshold in (None, 0.0, 0.5):
        pooled = long_time_diffusion(motions, threshold=threshold)
        assert abs(pooled.value - HOP_D) < 3 * pooled.stderr
        assert pooled.stderr / pooled.value > 1 / np.sqrt(15 * count)
    single = [long_time_diffusion(m) for m in motions]
    inside = np.mean([f.ci95[0] <= HOP_D <= f.ci95[1] for f in single])
    assert inside >= 0.92 - 3 * np.sqrt(0.05 / count)
    assert pooled.offset == pytest.approx(0.01, rel=2)


def test_free_diffusion_has_one_d():
    """Where there is no cage, long and short times agree, for rotation and translation."""
    motion = free(n_frames=3000)
    for quantity, D in (("rotation", 2e-3), ("translation", 0.04)):
        found = long_time_diffusion(motion, quantity=quantity)
        assert found.ci95[0] < D < found.ci95[1]
        assert found.threshold == 0
        low, high = found.lag_range
        assert high == 4 * low
        assert 2999 // 60 <= low <= 2999 // 24


@pytest.mark.parametrize("quantity", ["rotation", "translation"])
def test_units_and_the_direction_of_time(quantity):
    """Twice the time between frames halves D; three times the length is nine times D_T."""
    motion = free()
    found = long_time_diffusion(motion, quantity=quantity, threshold=0)
    slow = replace(motion, time=2 * motion.time, dt=2.0, center=3 * motion.center)
    other = long_time_diffusion(slow, quantity=quantity, threshold=0)
    scale = 4.5 if quantity == "translation" else 0.5
    np.testing.assert_allclose(other.ci68, scale * np.array(found.ci68), rtol=1e-9)
    assert other.value == pytest.approx(scale * found.value, rel=1e-9)
    assert other.stderr == pytest.approx(scale * found.stderr, rel=1e-9)
    assert other.lag_range == pytest.approx([2 * t for t in found.lag_range])
    back = replace(motion, rotation=motion.rotation[::-1], center=motion.center[::-1])
    reverse = long_time_diffusion(back, quantity=quantity, threshold=0)
    assert reverse.value == pytest.approx(found.value, rel=1e-9)
    assert reverse.stderr == pytest.approx(found.stderr, rel=1e-6)


def test_a_pool_of_copies_has_the_value_of_one():
    """Four copies: the same slope, half the error; holes and pieces keep their frames apart."""
    motion = free()
    one, four = long_time_diffusion(motion), long_time_diffusion([motion] * 4)
    assert four.lag_range == one.lag_range
    assert four.value == pytest.approx(one.value, rel=1e-9)
    assert four.stderr == pytest.approx(one.stderr / 2, rel=1e-6)
    assert four.n_frames == 4 * one.n_frames
    assert LongTimeEstimate.from_dict(one.to_dict()) == one


def test_faults_are_named_together():
    """Quantity, threshold and times between frames in one message; short tracks are refused."""
    motion, slow = free(n_frames=30), free(n_frames=30, dt=2.0)
    with pytest.raises(ValueError, match=r"quantity: expected .*dt = 1 to 2 s.*threshold: "):
        long_time_diffusion([motion, slow], quantity="spin", threshold=4.0)
    with pytest.raises(ValueError, match="threshold: for rotation only"):
        long_time_diffusion(motion, quantity="translation", threshold=0.5)
    with pytest.raises(ValueError, match="expected one or more motions"):
        long_time_diffusion([])
    with pytest.raises(ValueError, match="at least 24 steps, the longest has 19"):
        long_time_diffusion(free(n_frames=20))
    with pytest.raises(ValueError, match="no translation at all"):
        long_time_diffusion(caged(100, np.random.default_rng(1)), quantity="translation")
    with pytest.raises(TooFewFramesError):
        long_time_diffusion(free(n_frames=1))
