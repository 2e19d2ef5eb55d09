"""Every message about a movie comes where its reason is planted, and not where it is not."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

import perrin
from perrin.images import checks
from perrin.images.bodies import group_sizes
from perrin.images.features import mass_cut
from perrin.rotations import exp_map

CONTACT, DT = 2.45, 0.73


def table(n_frames=10, **columns):
    """Return one tetrahedron in every frame, spheres of cluster 0."""
    x = perrin.Cluster.touching(4, CONTACT).positions + 5.0
    rows = {
        "frame": np.repeat(np.arange(n_frames), 4),
        "mass": 1000.0,
        "cluster": 0,
        "border": 5.0,
        "together": 4,
    }
    rows |= {axis: np.tile(x[:, k], n_frames) for k, axis in enumerate("xyz")}
    return pd.DataFrame(rows | columns)


def frames(n=10, **columns):
    """Return the table of frames: all read, four spheres in each."""
    rows = {"frame": np.arange(n), "spheres": 4, "spots": 9, "level": 5.0, "saturated": 1e-7}
    return pd.DataFrame(rows | {"fault": ""} | columns)


def motion(D_R=5e-3, D_T=0.0, dt=DT, n_frames=200, sigma=0.0, contact=CONTACT):
    body = perrin.Cluster.touching(4, contact)
    truth = perrin.simulate_motion(body, D_R=D_R, D_T=D_T, dt=dt, n_frames=n_frames, rng=1)
    noisy = perrin.add_noise(truth.positions(), sigma=sigma, rng=2)
    return perrin.track_rotation(noisy, dt=dt)


def test_frames_are_named_in_runs():
    assert checks.at([4]) == "frame 4"
    assert checks.at([9, 3, 4, 5]) == "frames 3 to 5, 9"
    assert checks.at(list(range(0, 60, 2))).endswith("18 and 20 more")


def test_unreadable_frames_are_named():
    assert checks.unreadable(frames()) == []
    fault = [""] * 7 + ["movie.tif: frame 7 cannot be read: gone"] * 3
    told = checks.unreadable(frames(fault=fault))
    assert told[0].startswith("3 of 10 frames cannot be read and are left out: frames 7 to 9 (")
    assert "gone" in told[0]


def test_frames_without_particles_are_named():
    """A frame that could not be read is not one in which nothing passed the cut."""
    assert checks.empty(frames(), minmass=50.0) == []
    spheres, fault = [4] * 6 + [0] * 4, [""] * 8 + ["gone"] * 2
    told = checks.empty(frames(spheres=spheres, fault=fault), minmass=50.0)
    assert told[0].startswith("no particles passed the mass cut (50) in 2 of 8 frames: frames 6 to")


def test_a_mass_histogram_without_a_gap_is_told():
    with pytest.warns(perrin.PrecisionWarning, match="400 spots found have no clear gap.*minmass"):
        assert mass_cut(np.geomspace(10, 1000, 400)) == 0.0


def test_saturated_voxels_are_told():
    """A noise peak is alone at the top of its frame; a share of the voxels there is not noise."""
    assert checks.saturated(frames(), voxels=10**6) == []
    assert checks.saturated(frames(saturated=2e-5), voxels=10**5) == []  # two voxels
    told = checks.saturated(frames(saturated=[1e-7] * 4 + [0.002] * 6), voxels=10**6)
    assert "saturated voxels: up to 0.2 % of a frame" in told[0]
    assert "6 of 10 frames" in told[0]


def test_bleaching_is_told():
    fading = np.repeat(np.linspace(1.0, 0.7, 10), 4)
    assert checks.faded(table()) == []
    assert (
        "brightness fell by 30 % over the movie (bleaching)"
        in checks.faded(table(mass=1000 * fading))[0]
    )
    assert checks.faded(table(mass=1000 / fading)) == []


def test_brightness_that_changes_with_depth_is_told():
    """A spread of the spheres' own brightness is no change with depth."""
    rng = np.random.default_rng(1)
    z, own = rng.uniform(0, 16, 400), 1 + 0.08 * rng.normal(size=400)
    spheres = pd.DataFrame({"frame": np.repeat(np.arange(10), 40), "z": z, "mass": 1000 * own})
    assert checks.dimmed_with_depth(spheres) == []
    deep = spheres.assign(mass=1000 * own * (1 - 0.3 * z / 16))
    assert "amplitude changes with depth, by about -3" in checks.dimmed_with_depth(deep)[0]
    # The same spheres in every frame are not more spheres.
    still = spheres.assign(z=np.tile(z[:40], 10), mass=1000 * np.tile(own[:40], 10))
    assert checks.dimmed_with_depth(still) == []


def test_fits_that_failed_are_counted_by_reason():
    reason = ["", "did not settle"] * 18 + ["moved over half a radius"] * 4
    assert checks.unrefined(table()) == []
    assert checks.unrefined(table(reason="")) == []
    told = checks.unrefined(table(reason=reason))
    assert told[0].startswith("22 of 40 places are as found, not refined (18 x did not settle; 4 x")


@pytest.mark.parametrize(
    ("refine", "advice"), [(None, "centroid bias of touching balls; run refinement"),
                           ("model", "the contact distance, the voxel size or the diameter")],
)  # fmt: skip
def test_a_wrong_pair_distance_is_told(refine, advice):
    """Within 3 % nothing is said; locate alone reads 11 % too much."""
    x = table()
    ask = {"contact": CONTACT, "refine": refine, "axes": ["x", "y", "z"]}
    assert checks.pair_distance(x, **ask) == []
    for factor, told in ((1.02, False), (1.11, True), (0.9, True)):
        wide = x.assign(**{a: 5 + factor * (x[a] - 5) for a in "xyz"})
        said = checks.pair_distance(wide, **ask)
        assert bool(said) == told
        if told:
            assert f"expected 2.45 ({100 * (factor - 1):+.0f} %): {advice}" in said[0]
    assert checks.pair_distance(x.assign(cluster=-1), **ask) == []


def test_clusters_with_other_numbers_of_spheres_are_told():
    """Fewer, none, and more, as where two clusters meet."""
    x = table(20)
    assert checks.counts(x, size=4, contact=CONTACT, frames=np.arange(20)) == []
    lost = x.drop(index=[4 * k for k in range(3, 15)])  # one sphere in 12 frames
    lost = lost[~lost["frame"].isin([1, 5])]  # frame 5 could not be read
    meeting = lost.assign(together=np.where(lost["frame"] >= 18, 8, lost["together"]))
    told = checks.counts(meeting, size=4, contact=CONTACT, frames=np.delete(np.arange(26), 5))
    assert told == [
        "cluster 0: 4 expected, 3 found in 11 frames, none placed in 1 frame, 8 found in 2 frames "
        "(two clusters within 3.2 um), lost after frame 19"
    ]


def test_groups_of_touching_spheres_are_counted():
    """Two tetrahedra that touch are eight spheres; turned or moved they are the same."""
    x = perrin.Cluster.touching(4, CONTACT).positions
    turn = exp_map([0.3, 0.5, -0.2])
    apart = np.array([[0.0, 0.0, 0.0], 2 * (x[0] - x[1]), [30.0, 0.0, 0.0]])
    near = (x + apart[:, None]).reshape(-1, 3) @ turn.T
    spheres = pd.DataFrame(near, columns=["x", "y", "z"]).assign(frame=3)
    found = group_sizes(spheres, contact=CONTACT, axes=["x", "y", "z"])
    np.testing.assert_array_equal(found, [8] * 8 + [4] * 4)


def test_clusters_at_the_border_are_told():
    assert checks.at_border(table(), margin=1.5, dropped={}) == []
    near = table(border=np.where(np.arange(40) // 4 >= 7, 1.0, 5.0))
    told = checks.at_border(near, margin=1.5, dropped={0: np.array([12, 13])})
    assert told == [
        "cluster 0: centre within d/2 + 2 sigma (1.5 um) of the border in frames 7 to 9, 12 to 13; "
        "frames dropped, as spheres are out of view: 12 to 13"
    ]


def test_a_slow_scan_is_told():
    """Only where the time per plane is known and the cluster moves more than sigma meanwhile."""
    still = motion(sigma=0.03)
    ask = {"height": 0.25, "diameter": CONTACT}
    told = checks.scan_blur(still, D_T=0.04, plane_time=0.73 / 64, **ask)
    planes = (2 * still.R + CONTACT) / 0.25
    blur = np.sqrt(2 * 0.04 * planes * 0.73 / 64)
    assert f"{planes:.0f} planes" in told[0]
    assert f"motion blur about {1e3 * blur:.0f} nm > sigma {1e3 * still.sigma:.0f} nm" in told[0]
    assert checks.scan_blur(still, D_T=0.04, plane_time=None, **ask) == []
    assert checks.scan_blur(still, D_T=0.04, plane_time=1e-5, **ask) == []


def test_long_steps_are_told_and_longer_ones_refused():
    """A quarter of the contact distance warns, a half refuses; both name a dt that is safe."""
    slow, quick, wild = motion(D_T=0.01), motion(D_T=0.15), motion(D_T=0.5)
    over = [checks.step_length(m, contact=CONTACT) for m in (slow, quick, wild)]
    # Six D_T dt of the centre, and what the rotation adds.
    least = [np.sqrt(6 * D * DT) / CONTACT for D in (0.01, 0.15, 0.5)]
    assert all(a > b for a, b in zip(over, least, strict=True))
    assert checks.long_steps(slow, contact=CONTACT) == []
    assert (
        "over a quarter of the contact distance 2.45 um: identities are unsafe at dt = 0.73"
        in (checks.long_steps(quick, contact=CONTACT)[0])
    )
    assert checks.refused(quick, contact=CONTACT) == ""
    assert "is over half of the contact distance 2.45 um" in checks.refused(wild, contact=CONTACT)
    # In other units of length and time the same is said.
    big = motion(D_T=0.15 * 100, contact=10 * CONTACT)
    assert checks.step_length(big, contact=10 * CONTACT) == pytest.approx(over[1], rel=1e-9)


def test_sampling_too_slow_and_too_fast_is_told():
    good = motion()
    assert checks.sampling(good, phi2=1e-5) == []
    slow = checks.sampling(motion(D_R=0.1), phi2=1e-5)
    assert "sampling too slow, D_R biased low" in slow[0]
    rms = float(slow[0].split("per frame ")[1].split(" rad")[0])
    assert rms == pytest.approx(np.sqrt(6 * 0.1 * DT), rel=0.1)  # 200 steps: 4 %; turns fold back
    fast = motion(dt=0.01, sigma=0.03)
    phi2 = perrin.noise_floor(perrin.Cluster.touching(4, CONTACT), sigma=0.03).phi2
    assert "sampling too fast" in checks.sampling(fast, phi2=phi2)[0]


def test_a_gap_is_no_long_step():
    """A frame that is missing joins no step; a cut neither."""
    whole = motion(D_T=0.05)
    x = whole.positions()
    gap = x.copy()
    gap[50:60] = np.nan
    gap[60:] += 5.0
    with_gap = perrin.track_rotation(gap, dt=DT)
    assert checks.step_length(with_gap, contact=CONTACT) < 1.1 * checks.step_length(
        whole, contact=CONTACT
    )
