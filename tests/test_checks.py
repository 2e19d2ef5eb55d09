"""Every message about a movie comes where its reason is planted, and not where it is not."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from scipy.stats import t

import perrin
from perrin.geometry.rotations import exp_map
from perrin.images import CameraNoise, Optics
from perrin.images.optics.clipping import saturated_share
from perrin.images.spheres.spots import mass_cut
from perrin.movie import checks
from perrin.movie.bodies import group_sizes
from perrin.run.results import BodyKind

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
        "particle": np.tile(np.arange(4), n_frames),
    }
    rows |= {axis: np.tile(x[:, k], n_frames) for k, axis in enumerate("xyz")}
    return pd.DataFrame(rows | columns)


def frames(n=10, **columns):
    """Return the table of frames: all read, four spheres in each."""
    rows = {"frame": np.arange(n), "spheres": 4, "spots": 9, "level": 5.0, "saturated": 0.0}
    return pd.DataFrame(rows | {"fault": "", "copy_of": -1} | columns)


NOTHING = checks.Findings()


def warned(findings):
    """Return the only warning; there is no note."""
    (text,) = findings.warnings
    assert findings.notes == ()
    return text


def noted(findings):
    """Return the only note; there is no warning."""
    (text,) = findings.notes
    assert findings.warnings == ()
    return text


def motion(D_R=5e-3, D_T=0.0, dt=DT, n_frames=200, sigma=0.0, contact=CONTACT):
    body = perrin.Cluster.touching(4, contact)
    truth = perrin.simulate_motion(body, D_R=D_R, D_T=D_T, dt=dt, n_frames=n_frames, rng=1)
    noisy = perrin.add_noise(truth.positions(), sigma=sigma, rng=2)
    return perrin.track_rotation(noisy, dt=dt)


def test_frames_are_named_in_runs():
    assert checks.frame_runs_text([4]) == "frame 4"
    assert checks.frame_runs_text([9, 3, 4, 5]) == "frames 3 to 5, 9"
    assert checks.frame_runs_text(list(range(0, 60, 2))).endswith("18 and 20 more")
    apart = [k for k in range(60) if k % 3]  # runs of two: ten numbers are five runs
    assert checks.frame_runs_text(apart).endswith("13 to 14 and 30 more")


def test_unreadable_frames_are_named():
    assert checks.unreadable_frames(frames()) == NOTHING
    fault = [""] * 7 + ["movie.tif: frame 7 cannot be read: gone"] * 3
    text = warned(checks.unreadable_frames(frames(fault=fault)))
    assert text.startswith("3 of 10 frames cannot be read and are left out: frames 7 to 9 (")
    assert "gone" in text


def test_frames_that_repeat_another_are_named():
    assert checks.repeated_frames(frames()) == NOTHING
    text = warned(checks.repeated_frames(frames(copy_of=[-1, -1, 1, 1, -1, -1, -1, 0, -1, -1])))
    assert text.startswith("3 of 10 frames repeat an earlier frame exactly, voxel by voxel (first:")
    assert "(first: frame 2, as frame 1)" in text
    assert text.endswith("frames 2 to 3, 7")


def test_frames_without_particles_are_named():
    """A frame that could not be read is not one in which nothing passed the cut."""
    assert checks.empty_frames(frames(), minmass=50.0) == NOTHING
    spheres, fault = [4] * 6 + [0] * 4, [""] * 8 + ["gone"] * 2
    text = warned(checks.empty_frames(frames(spheres=spheres, fault=fault), minmass=50.0))
    assert text.startswith("no particles passed the mass cut (50) in 2 of 8 frames: frames 6 to")


def test_a_mass_histogram_without_a_gap_is_reported():
    with pytest.warns(perrin.PrecisionWarning, match="400 spots found have no clear gap.*minmass"):
        assert mass_cut(np.geomspace(10, 1000, 400)) == 0.0


def test_saturated_voxels_are_reported():
    assert checks.saturated_frames(frames()) == NOTHING
    text = warned(checks.saturated_frames(frames(saturated=[0.0] * 4 + [0.002] * 5 + [np.nan])))
    assert "saturated voxels: up to 0.2 % of a frame" in text
    assert "5 of 10 frames" in text


SCENES = {
    "counts": lambda rng, light: rng.poisson(light),
    "gain and read noise": lambda rng, light: np.rint(
        3 * rng.poisson(light) + rng.normal(20, 2, light.shape)
    ),
    "gain alone": lambda rng, light: 7 * rng.poisson(light),
    "half a grey level a photon": lambda rng, light: rng.poisson(light) // 2,
    "numbers with a point": lambda rng, light: rng.poisson(light) + rng.normal(0, 1, light.shape),
    "bright": lambda rng, light: rng.poisson(300 * light),
}


def scene(rng, shape=(12, 40, 40)):
    """Return light: an uneven background and three balls."""
    z, y, x = np.indices(shape)
    light = 2 + 0.1 * x
    for center in ((6, 10, 10), (5, 25, 30), (7, 30, 12)):
        r = np.sqrt((z - center[0]) ** 2 + (y - center[1]) ** 2 + (x - center[2]) ** 2)
        light = light + rng.uniform(20, 40) / (1 + np.exp((r - 5) / 0.6))
    return light


@pytest.mark.parametrize("name", SCENES)
def test_only_clipped_voxels_count_as_saturated(name, repeats):
    """No clean frame of 20 or 50 is saturated; where 2 % of the voxels are clipped every one is.

    The level of one frame is 1e-6.
    """
    rng = np.random.default_rng(1)
    for _ in range(repeats(20, 50)):
        clean = SCENES[name](rng, scene(rng))
        assert saturated_share(clean) == 0.0
        clipped = np.minimum(clean, np.quantile(clean, 0.98))
        share = np.mean(clipped == clipped.max())
        assert saturated_share(clipped) == share > 0.01


def test_the_end_of_an_integer_type_is_saturation():
    """Also where the light falls off so steeply that clipping piles nothing up; not one voxel."""
    data = np.random.default_rng(2).geometric(0.7, 50_000).clip(0, 6).astype(np.uint8)
    assert saturated_share(data) == 0.0
    lifted = data + np.uint8(255 - data.max())
    assert saturated_share(lifted) == np.mean(lifted == 255) > 0
    few = np.where(np.arange(data.size) < 5, np.uint8(255), data)
    assert saturated_share(few) == 0.0
    assert saturated_share(np.full((4, 5, 6), 7)) == 0.0


def test_bleaching_is_reported():
    fading = np.repeat(np.linspace(1.0, 0.7, 10), 4)
    assert checks.bleached(table()) == NOTHING
    own = np.tile([0.99, 1.0, 1.01, 1.0], 10) ** np.repeat(np.arange(10), 4)
    text = warned(checks.bleached(table(mass=1000 * fading * own)))
    assert "brightness fell by 30 +- 3 % from the first tenth of the movie to the last" in text
    assert checks.bleached(table(mass=1000 / fading)) == NOTHING
    # What belongs to no cluster, and spheres that come and go, do not change the number.
    stray = table(mass=1000 * fading).assign(cluster=-1, mass=np.geomspace(1, 1e6, 40))
    both = pd.concat([table(mass=1000 * fading), stray])
    assert checks.bleaching(both).value == pytest.approx(-0.3, rel=1e-9)


def test_bleaching_is_measured_within_its_error(repeats):
    """Planted fall of 30 %, spheres whose brightness wanders by 5 %: 95 % intervals hold it.

    The share of 30 or 150 movies is within 2.4 standard errors; no clean movie warns.
    """
    rng = np.random.default_rng(3)
    inside, count = 0, repeats(30, 150)
    for _ in range(count):
        wander = np.exp(0.05 * rng.normal(size=(20, 4)).cumsum(axis=0) / np.sqrt(20))
        still = table(20, mass=(1000 * rng.uniform(0.5, 2, 4) * wander).ravel())
        assert checks.bleached(still) == NOTHING
        fall = np.linspace(0, np.log(0.7), 20)
        faded = still.assign(mass=still["mass"] * np.repeat(np.exp(fall), 4))
        found = checks.bleaching(faded)
        # The tenths are two frames: their middles are 18 of 19 intervals apart.
        planted = 0.7 ** (18 / 19) - 1
        inside += abs(found.value - planted) < t.isf(0.025, found.freedom) * found.stderr
    assert abs(inside / count - 0.95) < 2.4 * np.sqrt(0.05 * 0.95 / count)


def test_brightness_that_changes_with_depth_is_reported():
    """A spread of the spheres' own brightness is no change with depth."""
    rng = np.random.default_rng(1)
    z, own = rng.uniform(0, 16, 400), 1 + 0.08 * rng.normal(size=400)
    spheres = pd.DataFrame({"frame": np.repeat(np.arange(10), 40), "z": z, "mass": 1000 * own})
    assert checks.depth_dimming(spheres) == NOTHING
    deep = spheres.assign(mass=1000 * own * (1 - 0.3 * z / 16))
    assert "amplitude changes with depth, by -3" in warned(checks.depth_dimming(deep))
    # The same spheres in every frame are not more spheres.
    still = spheres.assign(z=np.tile(z[:40], 10), mass=1000 * np.tile(own[:40], 10))
    assert checks.depth_dimming(still) == NOTHING


def test_few_spheres_of_uneven_brightness_show_no_depth(repeats):
    """Spheres that differ by 15 %: at most 1 % of 40 or 100 tetrahedra (+ 2 errors)."""
    rng = np.random.default_rng(2)
    false, count = 0, repeats(40, 100)
    for _ in range(count):
        own = np.tile(rng.normal(1000, 150, 4), 10)
        false += checks.depth_dimming(table(mass=own)) != NOTHING
    assert false <= 0.01 * count + 2 * np.sqrt(0.01 * count)


def test_fits_that_failed_are_counted_by_reason():
    """Up to 1 % of failed fits cause a note, more a warning."""
    reason = ["", "did not settle"] * 18 + ["moved over half a radius"] * 4
    assert checks.unrefined_spheres(table()) == NOTHING
    assert checks.unrefined_spheres(table(reason="")) == NOTHING
    text = warned(checks.unrefined_spheres(table(reason=reason)))
    assert text.startswith("22 of 40 places are as found, not refined (18 x did not settle; 4 x")
    one = table(30, reason=[*[""] * 119, "did not settle"])
    assert noted(checks.unrefined_spheres(one)).startswith("1 of 120 places")
    assert checks.unsettled_poses(0, 40) == NOTHING
    assert noted(checks.unsettled_poses(1, 120)).startswith(
        "1 of 120 fits of poses did not converge"
    )
    assert warned(checks.unsettled_poses(2, 120)).startswith(
        "2 of 120 fits of poses did not converge"
    )


@pytest.mark.parametrize(
    ("refine", "advice"), [(None, "centroid bias of touching spheres; run refinement"),
                           ("model", "the contact distance, the voxel size or the diameter")],
)  # fmt: skip
def test_a_wrong_pair_distance_is_reported(refine, advice):
    """Within 3 % nothing is reported; locate alone reads 11 % too much."""
    x = table()
    ask = {"contact": CONTACT, "refine": refine, "axes": ["x", "y", "z"]}
    assert checks.pair_distance_bias(x, **ask) == NOTHING
    for factor, differs in ((1.02, False), (1.11, True), (0.9, True)):
        wide = x.assign(**{a: 5 + factor * (x[a] - 5) for a in "xyz"})
        found = checks.pair_distance_bias(wide, **ask)
        assert bool(found.warnings) == differs
        if differs:
            assert f"expected 2.45 ({100 * (factor - 1):+.1f} +- " in warned(found)
            assert warned(found).endswith(advice) or f"%): {advice}" in warned(found)
    assert checks.pair_distance_bias(x.assign(cluster=-1), **ask) == NOTHING


def test_the_mean_pair_distance_knows_its_error(repeats):
    """Errors of 60 nm that last over all frames: over 30 or 100 tetrahedra they scatter as stated.

    The stated error has five degrees of freedom, which widen its quotients by 1.3.
    """
    rng = np.random.default_rng(5)
    off = []
    for _ in range(repeats(30, 100)):
        x = table(3)
        for axis in "xyz":
            x[axis] += np.tile(rng.normal(0, 0.06, 4), 3) + rng.normal(0, 0.02, 12)
        mean, error = checks.mean_pair_distance(x, contact=CONTACT, axes=["x", "y", "z"])
        # Errors across a pair lengthen it by their square over its length.
        off.append((mean - CONTACT - 2 * (0.06**2 + 0.02**2) / CONTACT) / error)
    # The scatter of 30 is known to 13 %.
    assert 0.8 < np.std(off) < 1.5


def turned_tetrahedra(rng, *, bodies=4, frames=3, z_scale=1.0, constant=0.0):
    """Return touching tetrahedra in random directions; their spheres have constant errors."""
    tables, body = [], perrin.Cluster.touching(4, CONTACT)
    for k in range(bodies):
        motion = perrin.simulate_motion(body, D_R=5e-3, dt=DT, n_frames=frames, rng=rng)
        x = motion.positions() @ exp_map(rng.normal(size=3) * 2).T
        x = x + rng.normal(0, constant, x.shape[1:]) + 20.0 * k
        x[..., 2] *= z_scale
        rows = perrin.positions_table(x).assign(cluster=k)
        tables.append(rows.assign(particle=rows["particle"] + 4 * k))
    return pd.concat(tables, ignore_index=True)


def test_distances_along_z_are_compared_with_those_across(repeats):
    """A z step that is 2 % too short is noted; steps as stated with constant errors are not."""
    rng, ask = np.random.default_rng(8), {"contact": CONTACT, "axes": ["x", "y", "z"]}
    note = noted(checks.distances_by_direction(turned_tetrahedra(rng, z_scale=0.98), **ask))
    assert note.startswith("distances along z: touching spheres above each other read 2 +- ")
    assert "nearer" in note
    planar = turned_tetrahedra(rng, z_scale=0.98).drop(columns="z")
    assert checks.distances_by_direction(planar, contact=CONTACT, axes=["x", "y"]) == NOTHING
    false = [
        checks.distances_by_direction(turned_tetrahedra(rng, constant=0.02), **ask) != NOTHING
        for _ in range(repeats(6, 400))
    ]
    # The level of the test is 1 % on its bound, on either side.
    assert np.mean(false) <= 0.05


def test_residuals_above_the_noise_are_noted():
    """A mean chi-squared of 1.04 is noted; one of 1.02 is not, nor are images of smoothed noise."""
    rng, optics = np.random.default_rng(3), Optics(2.45, (0.4, 0.15), CameraNoise(3.0, 4.0))
    fits = table().assign(refined=True, chi2=1.04 + 0.015 * rng.normal(size=40))
    assert noted(checks.image_misfit(fits, optics)).startswith("image misfit: the residuals of")
    assert checks.image_misfit(fits.assign(chi2=fits["chi2"] - 0.02), optics) == NOTHING
    assert checks.image_misfit(fits.assign(refined=False), optics) == NOTHING
    smooth = replace(optics, noise=CameraNoise(3.0, 4.0, neighbours=((1.0, 0.3), (0.3, 0.0))))
    assert checks.image_misfit(fits, smooth) == checks.image_misfit(fits, None) == NOTHING


def test_clusters_with_other_numbers_of_spheres_are_reported():
    """Fewer, none, and more, as where two clusters meet."""
    x = table(20)
    four = dict.fromkeys(range(40), 4)
    assert checks.missing_spheres(x, sizes=four, contact=CONTACT, frames=np.arange(20)) == NOTHING
    lost = x.drop(index=[4 * k for k in range(3, 15)])  # one sphere in 12 frames
    lost = lost[~lost["frame"].isin([1, 5])]  # frame 5 could not be read
    meeting = lost.assign(together=np.where(lost["frame"] >= 18, 8, lost["together"]))
    found = checks.missing_spheres(
        meeting, sizes=four, contact=CONTACT, frames=np.delete(np.arange(26), 5)
    )
    # Of 19 frames of 4 spheres one lacks 4, and 11 lack one.
    assert warned(found) == (
        "20 % of the spheres are missing, 4 expected in each of 1 clusters; cluster 0: 3 found in "
        "11 frames, none placed in 1 frame, 8 found in 2 frames (two clusters within 3.2 um), lost "
        "after frame 19"
    )
    one = checks.missing_spheres(x.drop(index=8), sizes=four, contact=CONTACT, frames=np.arange(20))
    assert noted(one).startswith("1.2 % of the spheres are missing")
    many = pd.concat([x.drop(index=8).assign(cluster=k) for k in range(40)])
    text = noted(checks.missing_spheres(many, sizes=four, contact=CONTACT, frames=np.arange(20)))
    assert text.endswith("cluster 9: 3 found in 1 frame; and 30 more")


def test_the_shape_of_a_part_of_a_larger_cluster_is_noted():
    """A trimer beside tetrahedra may be one with an undyed sphere; tetrahedra alone are none."""
    shapes = {0: 4, 1: 4, 2: 3}
    results = [
        SimpleNamespace(
            cluster=c,
            motion=SimpleNamespace(template=perrin.Cluster.touching(n, CONTACT).positions),
        )
        for c, n in shapes.items()
    ]
    whole = BodyKind(4, "T_d", (0, 1))
    part = BodyKind(3, "D_3h", (2,))
    assert checks.partial_bodies(results[:2], [whole]) == NOTHING
    text = noted(checks.partial_bodies(results, [part, whole]))
    assert "cluster 2 (3 particles, D_3h) in those of 4 particles, T_d" in text


def test_groups_of_touching_spheres_are_counted():
    """Two tetrahedra that touch are eight spheres; turned or moved they are the same."""
    x = perrin.Cluster.touching(4, CONTACT).positions
    turn = exp_map([0.3, 0.5, -0.2])
    apart = np.array([[0.0, 0.0, 0.0], 2 * (x[0] - x[1]), [30.0, 0.0, 0.0]])
    near = (x + apart[:, None]).reshape(-1, 3) @ turn.T
    spheres = pd.DataFrame(near, columns=["x", "y", "z"]).assign(frame=3)
    found = group_sizes(spheres, contact=CONTACT, axes=["x", "y", "z"])
    np.testing.assert_array_equal(found, [8] * 8 + [4] * 4)


def test_clusters_at_the_border_are_noted():
    four = dict.fromkeys(range(40), 4)
    assert checks.clusters_near_border(table(), margin=1.5, sizes=four) == NOTHING
    near = table(border=np.where(np.arange(40) // 4 >= 7, 1.0, 5.0))
    text = noted(checks.clusters_near_border(near.drop(index=[30, 34]), margin=1.5, sizes=four))
    assert text == (
        "centre within d/2 + 2 sigma (1.5 um) of the border, cluster 0 in frames 7 to 9; in part, "
        "with spheres out of view, in frames 7 to 8"
    )
    many = pd.concat([near.assign(cluster=k) for k in range(40)])
    text = noted(checks.clusters_near_border(many, margin=1.5, sizes=four))
    assert "40 of 40 clusters (0, 1, 2, 3, 4, 5, 6, 7, 8, 9 and 30 more)" in text


def test_long_steps_are_reported_and_longer_ones_refused():
    """A quarter of the contact distance warns, a half refuses; both name a dt that is safe."""
    slow, quick, wild = motion(D_T=0.01), motion(D_T=0.15), motion(D_T=0.5)
    over = [checks.step_length(m, contact=CONTACT) for m in (slow, quick, wild)]
    # Six D_T dt of the centre, and what the rotation adds.
    least = [np.sqrt(6 * D * DT) / CONTACT for D in (0.01, 0.15, 0.5)]
    assert all(a > b for a, b in zip(over, least, strict=True))
    assert checks.long_steps(slow, contact=CONTACT) is None
    assert (
        "over a quarter of the contact distance 2.45 um: identities are unsafe at dt = 0.73"
        in checks.long_steps(quick, contact=CONTACT).text
    )
    assert checks.refusal(quick, contact=CONTACT) == ""
    assert "is over half of the contact distance 2.45 um" in checks.refusal(wild, contact=CONTACT)
    # In other units of length and time the same is reported.
    big = motion(D_T=0.15 * 100, contact=10 * CONTACT)
    assert checks.step_length(big, contact=10 * CONTACT) == pytest.approx(over[1], rel=1e-9)


def test_steps_on_the_bound_are_reported_at_the_level():
    """1 % of Gaussian steps whose true rms is the bound: of 4000, 0.4 to 1.6 % (4 errors)."""
    rng = np.random.default_rng(6)
    rms = np.sqrt((rng.normal(size=(4000, 21)) ** 2).mean(axis=1))
    share = np.mean([checks.exceeds_rms(r, 1.0, freedom=21) for r in rms])
    assert 0.004 < share < 0.016


def test_sampling_too_slow_and_too_fast_is_reported():
    good = motion()
    assert checks.slow_sampling(good) is None
    assert checks.fast_sampling(good, phi2=1e-5) is None
    slow = checks.slow_sampling(motion(D_R=0.1)).text
    assert "sampling too slow, D_R biased low" in slow
    rms = float(slow.split("per frame ")[1].split(" +- ")[0])
    assert rms == pytest.approx(np.sqrt(6 * 0.1 * DT), rel=0.1)  # 200 steps: 4 %; turns fold back
    fast = motion(dt=0.01, sigma=0.03)
    phi2 = perrin.noise_floor(perrin.Cluster.touching(4, CONTACT), sigma=0.03).phi2
    assert "sampling too fast" in checks.fast_sampling(fast, phi2=phi2).text


def test_a_gap_is_not_a_step():
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


def test_what_shows_no_change_has_no_text():
    """One height, one frame, spheres that touch none: None; errors as stated: no finding."""
    rows = table()
    assert checks.depth_change(rows.assign(z=1.0)) is None
    assert checks.bleaching(rows[rows["particle"] == 0].iloc[:1]) is None
    far = rows.assign(x=100.0 * rows["particle"])
    assert checks.distance_error(far, contact=CONTACT, axes=["x", "y", "z"]) is None
    nothing = checks.Findings()
    assert nothing + nothing == nothing
    with pytest.raises(TypeError):
        nothing + 1
