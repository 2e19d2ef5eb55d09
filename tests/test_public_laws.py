"""Every public function follows the laws of its arguments: a table of functions against changes.

A change of the laboratory turns, shifts and reverses the positions, names the particles anew and
takes other units of length and time, all at once. Functions whose laws have tests of their own are
named with those.
"""

from __future__ import annotations

import functools
import inspect
from pathlib import Path

import numpy as np
import pytest

import perrin
from perrin.geometry.rotations import exp_map

HERE = Path(__file__).parent
DT, DIAMETER = 0.7, 2.45
BODY = perrin.Cluster.touching(5, DIAMETER)


@functools.cache
def places(missing=True):
    """Return noisy positions of five spheres, (T, 5, 3), with a frame and a position missing."""
    motion = perrin.simulate_motion(BODY, D_R=0.02, D_T=0.04, dt=DT, n_frames=64, rng=1)
    found = perrin.add_noise(motion.positions(), sigma=0.02, rng=2)
    if missing:
        found[20] = np.nan
        found[40, 2] = np.nan
    return found


# ---- functions, as lists of numbers with their powers of the units of length and time -----------


def curve(found, length=0):
    """Return the numbers of a curve."""
    return [
        (found.lagtime, 0, 1),
        (found.value, length, 0),
        (found.stderr, length, 0),
        (found.n_pairs, 0, 0),
    ]


def estimate(found, length=0):
    """Return the numbers of a diffusion coefficient."""
    return [(found.value, length, -1), (found.stderr, length, -1), (found.ci95, length, -1)]


def size_of(x):
    """Return the rms distance of the particles from their centre, in the first frame."""
    return np.sqrt(np.mean(np.sum(np.square(x[0] - x[0].mean(axis=0)), axis=1)))


def pose_numbers(m):
    return [
        (m.sigma, 1, 0),
        (m.R, 1, 0),
        (m.dt, 0, 1),
        (np.sort(np.linalg.norm(m.template, axis=1)), 1, 0),
    ]


def coupled(m):
    found = perrin.coupled_tensor(m).tensor
    translation, rotation = (np.linalg.eigvalsh(t) for t in (found[:3, :3], found[3:, 3:]))
    return [(translation, 2, -1), (rotation, 0, -1), (np.linalg.norm(found[:3, 3:]), 1, -1)]


def switching(m):
    found = perrin.fit_switching(m)
    return [(found.D_mean.value, 0, -1), (found.bic_gain, 0, 0)]


def anomalous(m):
    found = perrin.fit_anomalous(m)
    return [(found.alpha, 0, 0), (found.msd_at_best_lag, 0, 0), (found.best_lag, 0, 1)]


def confined(m):
    found = perrin.fit_confined(m)
    return [(found.D_short, 0, -1), (found.offset, 0, 0), (found.log_likelihood_gain, 0, 0)]


def verdict(m):
    found = perrin.judge_motion(m)
    return [([p for p in found.p.values() if p is not None], 0, 0), (found.p_family, 0, 0)]


def distribution(m):
    found = perrin.van_hove(m, lag=3 * m.dt, quantity="angle")
    return [(found.edges, 0, 0), (found.density, 0, 0), (found.alpha2, 0, 0)]


def moduli(m):
    found = perrin.viscoelastic_moduli(perrin.msad(m), cluster=BODY, temperature=295.0)
    return [(found.frequency, 0, -1), (found.exponent, 0, 0), (found.modulus, 0, 0)]


def relaxation(m):
    found = perrin.fit_relaxation(perrin.orientation_correlation(m))
    return [(found.tau, 0, 1), (found.beta, 0, 0), (found.ci95, 0, 1)]


def quaternions(m):
    found = perrin.quaternion_covariance(m, n_lags=5)
    return [(np.linalg.eigvalsh(found.covariance), 0, 0), (found.lagtime, 0, 1)]


def threshold(m):
    found = perrin.threshold_displacement(m, threshold=0.5)
    return [(np.linalg.norm(found[m.fitted], axis=1), 0, 0)]


OF_MOTION = {
    "track_rotation": pose_numbers,
    "estimate_diffusion": lambda m: estimate(perrin.estimate_diffusion(m)),
    "diffusion_tensor": lambda m: [(perrin.diffusion_tensor(m).principal_values, 0, -1)],
    "coupled_tensor": coupled,
    "fit_switching": switching,
    "fit_anomalous": anomalous,
    "fit_confined": confined,
    "judge_motion": verdict,
    "judge_sampling": lambda m: [
        (perrin.judge_sampling(perrin.estimate_diffusion(m)).snr, 0, 0),
    ],
    "long_time_diffusion": lambda m: estimate(perrin.long_time_diffusion(m)),
    "msd": lambda m: curve(perrin.msd(m), 2),
    "msad": lambda m: curve(perrin.msad(m)),
    "msad_axes": lambda m: [n for axis in perrin.msad_axes(m) for n in curve(axis)],
    "msad_vector": lambda m: curve(perrin.msad_vector(m)),
    "threshold_displacement": threshold,
    "fit_line": lambda m: estimate(
        perrin.fit_line(perrin.msad(m), lag_range=(3 * m.dt, 12 * m.dt))
    ),
    "fit_gls": lambda m: estimate(perrin.fit_gls(perrin.msad(m))),
    "fit_relaxation": relaxation,
    "orientation_correlation": lambda m: curve(perrin.orientation_correlation(m)),
    "quaternion_covariance": quaternions,
    "non_gaussian": lambda m: [(perrin.non_gaussian(m).value, 0, 0)],
    "van_hove": distribution,
    "translation_rotation_correlation": lambda m: [
        (perrin.translation_rotation_correlation(m).value, 0, 0)
    ],
    "viscoelastic_moduli": moduli,
}

# These depend on the velocity of the whole body; the others are about its rotation alone.
WITH_TRANSLATION = {"coupled_tensor", "msd", "translation_rotation_correlation"}
# The state of a step is that at its beginning; a prediction is from the past; a reference moves
# forward; trends, and the blocks of a jackknife, count from the first frame.
WITH_A_DIRECTION_OF_TIME = {
    "fit_switching", "translation_rotation_correlation", "threshold_displacement", "judge_motion",
    "non_gaussian",
}  # fmt: skip


def rod(x, dt):
    """Return the numbers of the two particles farthest from each other."""
    apart = np.linalg.norm(x[0][:, None] - x[0], axis=2)
    found = perrin.track_direction(x[:, list(np.unravel_index(apart.argmax(), apart.shape))], dt=dt)
    return [
        *estimate(perrin.estimate_rod(found)),
        *estimate(perrin.estimate_rod(found, quantity="translation"), 2),
    ]


def quality(x, dt):
    found = perrin.judge_quality(perrin.track_rotation(x, dt=dt), x)
    return [(found.residual_over_R, 0, 0), (found.rigid, 0, 0), (found.fraction, 0, 0)]


def bulk(x, dt):
    rest, motion = perrin.remove_rotation(x, dt=dt)
    return [
        (np.sort(np.linalg.norm(rest, axis=-1), axis=None), 1, 0),
        *estimate(perrin.estimate_diffusion(motion)),
    ]


def identity(x, dt):
    found = perrin.settle_identity(x, times=dt * np.arange(len(x)))
    return [(found.swaps.size, 0, 0), (found.piece.max(), 0, 0), (found.unsettled.size, 0, 0)]


def clusters(x, dt):
    """Return what is found of two bodies side by side."""
    both = np.concatenate([x, x[:, ::-1] + 10 * size_of(x)], axis=1)
    table = perrin.positions_table(both)
    found = perrin.find_clusters(table, contact=1.8 * size_of(x), size=5)
    numbers = [found["cluster"].nunique()]
    for name in found["cluster"].unique():
        alone, frames = perrin.cluster_positions(found, cluster=name)
        numbers += [*alone.shape, frames.size]
    return [(numbers, 0, 0)]


OF_POSITIONS = {
    "judge_quality": quality,
    "remove_rotation": bulk,
    "track_direction": rod,
    "estimate_rod": rod,
    "settle_identity": identity,
    "find_clusters": clusters,
    "cluster_positions": clusters,
    "positions_table": clusters,
    "noise_floor": lambda x, dt: [(perrin.noise_floor(x[0], sigma=0.01 * size_of(x)).phi2, 0, 0)],
    "point_group": lambda x, dt: [
        (list(perrin.point_group(x[0], tolerance=0.1 * size_of(x)).encode()), 0, 0)
    ],
    "rotation_group": lambda x, dt: [
        (len(perrin.rotation_group(x[0], tolerance=0.1 * size_of(x))), 0, 0)
    ],
}
# The detections of one frame at a time, named by the first.
WITH_A_DIRECTION_OF_TIME |= {"noise_floor"}

# ---- the laws -----------------------------------------------------------------------------------


def same(found, known, *, length=1.0, time=1.0, rel=1e-6):
    """Compare numbers with those of before, in other units."""
    for (value, *powers), (before, p, q) in zip(found, known, strict=True):
        assert powers == [p, q]
        expected = np.asarray(before, dtype=float) * length**p * time**q
        least = rel * np.nanmax(np.abs(expected), initial=0)
        np.testing.assert_allclose(value, expected, rtol=rel, atol=least)


ALL_AT_ONCE = {
    "turn": (0.4, -1.2, 2.0), "shift": (30.0, -7.0, 12.0), "velocity": (0.3, -0.5, 1.1),
    "order": [3, 0, 4, 2, 1], "length": 25.4, "time": 60.0, "backwards": True,
}  # fmt: skip
SMALL_UNITS = {"turn": (-3.0, 0.1, 0.0), "order": [4, 1, 0, 2, 3], "length": 1e-3, "time": 1e-3}


def changed(x, change, *, name):
    """Return positions after a change of the laboratory that a function does not notice."""
    if "velocity" in change and name in OF_MOTION.keys() - WITH_TRANSLATION:
        x = x + np.arange(len(x))[:, None, None] * DT * np.array(change["velocity"])
    if change.get("backwards", False) and name not in WITH_A_DIRECTION_OF_TIME:
        x = x[::-1]
    x = x @ exp_map(np.array(change.get("turn", (0, 0, 0)))).T + change.get("shift", (0, 0, 0))
    return x[:, change.get("order", range(5))] * change.get("length", 1.0)


def numbers(name, x, dt):
    """Return the numbers of a function at some positions."""
    if name in OF_MOTION:
        return OF_MOTION[name](perrin.track_rotation(x, dt=dt))
    return OF_POSITIONS[name](x, dt)


@functools.cache
def before(name):
    return numbers(name, places(), DT)


@pytest.mark.parametrize("name", [*OF_MOTION, *OF_POSITIONS])
def test_turns_shifts_velocities_labels_units_and_time_reversal(name, repeats):
    """The numbers stay, or change by the powers of the units that they have."""
    for change in (ALL_AT_ONCE, SMALL_UNITS)[: repeats(1, 2)]:
        found = numbers(name, changed(places(), change, name=name), DT * change["time"])
        same(found, before(name), length=change["length"], time=change["time"], rel=1e-6)


@pytest.mark.parametrize("name", OF_MOTION)
def test_a_gap_is_a_frame_without_numbers(name):
    """A frame that is not there, and one of NaN, are the same."""
    x = places()
    rows = np.flatnonzero(np.isfinite(x).any(axis=(1, 2)))
    without = perrin.track_rotation(x[rows], dt=DT, frames=rows)
    same(OF_MOTION[name](without), before(name), rel=1e-6)


@pytest.mark.parametrize("name", ["track_rotation", *OF_POSITIONS])
def test_single_precision_and_whole_numbers_are_read_as_they_are(name):
    """The numbers are those of the same positions in double precision."""
    single = places(missing=False).astype(np.float32)
    whole = np.rint(1e4 * single).astype(np.int64)
    for x in (single, whole):
        given_type = numbers(name, x, 1)
        same(given_type, numbers(name, x.astype(np.float64), 1.0), rel=1e-5)


# Where the laws of the other functions are: a planted truth, units, turns, or the way back.
ELSEWHERE = {
    "add_noise": "test_simulate.py::test_noise_has_its_sigma_on_every_axis",
    "analyze": "test_edges.py::test_units_of_any_size",
    "analyze_stack": "test_plane.py::test_a_planar_movie_ends_in_a_report",
    "apparent_translation": "test_mobility.py::test_moved_and_relabelled_bodies",
    "axis_angle": "test_rotations.py::test_axis_and_angle_follow_the_lab",
    "brownian_alpha2": "test_gaussianity.py::test_moments_are_those_of_the_simulated_angles",
    "cluster_mobility": "test_mobility.py::test_units",
    "compare_conditions": "test_study_statistics.py::test_a_comparison_is_the_same_from_both_sides",
    "cramer_rao": "test_bounds.py::test_the_bound_is_the_inverse_of_a_dense_fisher_matrix",
    "decoupling_ratio": "test_decoupling.py",
    "diffusion_correlation": "test_decoupling.py",
    "fit_pose": "test_locate.py",
    "fit_power_law": "test_study_statistics.py::test_the_exponent_of_decoupling_comes_back",
    "fit_trend": "test_study_statistics.py::test_a_planted_law_lies_in_the_intervals",
    "gravitational_height": "test_surroundings.py::test_gravity",
    "identify": "test_linking.py",
    "kabsch": "test_rotations.py::test_kabsch_follows_turns_shifts_permutations_and_units",
    "leave_one_out": "test_study_statistics.py::test_a_planted_outlier_is_named_and_others_are_not",
    "load_run": "test_results.py",
    "locate": "test_locate.py::test_the_fit_follows_shifts_mirrors_units_and_negatives",
    "measure_point_spread": "test_point_spread.py",
    "napari_layers": "test_napari.py::test_points_lie_at_fixed_places_of_the_drawn_axes",
    "open_stack": "test_stacks.py::test_written_stack_reads_back_exactly",
    "plan_sampling": "test_sampling.py::test_units_rescale_the_plan",
    "plan_study": "test_study_statistics.py::test_plans_reach_the_wanted_error",
    "population_mean": "test_study_statistics.py::test_the_mean_follows_units_and_order",
    "read_tracks": "test_files.py::test_a_table_reads_back_bit_identical",
    "render_stack": "test_render.py::test_spheres_add_and_turn_with_their_body",
    "settling_velocity": "test_surroundings.py::test_a_stokes_sphere_settles",
    "similarity": "test_rotations.py::test_similarity_follows_the_axes_and_units_of_both_sets",
    "simulate_motion": "test_simulate.py::test_tensors_are_in_body_axes",
    "size_and_viscosity": "test_hydrodynamics.py::test_planted_sizes_come_back",
    "size_from_rotation": "test_hydrodynamics.py::test_planted_sizes_come_back",
    "size_from_translation": "test_hydrodynamics.py::test_planted_sizes_come_back",
    "wall_diffusion": "test_surroundings.py::test_the_signature_of_a_wall",
    "wall_factor": "test_surroundings.py::test_the_walls_effect_fades",
    "water_viscosity": "test_surroundings.py::test_water",
    "write_run": "test_results.py",
    "write_stack": "test_stacks.py::test_written_stack_reads_back_exactly",
    "write_tracks": "test_files.py::test_csv_keeps_every_bit_of_any_float",
}


def test_every_public_function_has_laws():
    """It is in the tables above, or named with a test that exists and calls it."""
    functions = {n for n in perrin.__all__ if inspect.isfunction(getattr(perrin, n))}
    assert {*OF_MOTION, *OF_POSITIONS, *ELSEWHERE} == functions
    for name, place in ELSEWHERE.items():
        file, _, test = place.partition("::")
        text = (HERE / file).read_text(encoding="utf-8")
        assert f"def {test}(" in text or not test, place
        assert name in text, place
