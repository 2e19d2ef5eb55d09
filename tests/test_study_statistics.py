"""Random effects, trends, comparisons and influence: laws, planted values, coverage."""

from __future__ import annotations

import json
import runpy
from pathlib import Path

import numpy as np
import pytest

from perrin import Cluster
from perrin.study import (
    Coefficient,
    Comparison,
    Influence,
    PopulationMean,
    RunKind,
    StudyPlan,
    Trend,
    compare_conditions,
    expected_half_width,
    fit_power_law,
    fit_trend,
    law_values,
    leave_one_out,
    log_likelihoods,
    plan_study,
    population_mean,
    ratio_of,
    smoothed,
    study_kinds,
)

BENCHMARK = runpy.run_path(
    str(Path(__file__).parents[1] / "benchmarks" / "study_coverage.py"), run_name="coverage"
)
exact_coefficient = BENCHMARK["exact_coefficient"]


def drawn(rng, *, movies, clusters, spread=(0.2, 0.1), centre=1.0, steps=100):
    """Return coefficients of a population, and the movie of each."""
    shift = rng.normal(0, spread[1], movies)
    movie = np.repeat(np.arange(movies), clusters)
    D = centre * np.exp(shift[movie] + rng.normal(0, spread[0], movie.size))
    return [exact_coefficient(one, steps, rng) for one in D], movie.tolist()


def scaled(one, factor):
    return Coefficient(
        factor * one.value,
        tuple(factor * end for end in one.ci68),
        tuple(factor * end for end in one.ci95),
    )


def test_the_profile_passes_through_the_ends_of_the_intervals():
    """At the ends of the intervals the log-likelihood has fallen by half a quantile of chi2."""
    one = exact_coefficient(2.0, 20, np.random.default_rng(1))
    ends = np.log([one.ci95[0], one.ci68[0], one.value, one.ci68[1], one.ci95[1]])
    fallen = log_likelihoods([one], ends)[0]
    np.testing.assert_allclose(fallen, [-1.9208, -0.4945, 0, -0.4945, -1.9208], atol=1e-4)


@pytest.mark.parametrize("steps", [10, 100])
def test_the_profile_is_the_exact_likelihood_between_its_points(steps):
    """The likelihood of 3N normal steps is -(3N/2)(u + exp(-u) - 1), u = ln D - ln D-hat."""
    one = exact_coefficient(1.0, steps, np.random.default_rng(2))
    u = np.linspace(-2.5, 2.5, 41) / np.sqrt(1.5 * steps)
    exact = -1.5 * steps * (u + np.exp(-u) - 1)
    found = log_likelihoods([one], np.log(one.value) + u)[0]
    # The straight lines beyond 1.96 are the largest difference.
    np.testing.assert_allclose(found, exact, atol=0.2)


def test_a_limit_has_a_likelihood_that_does_not_vanish_at_zero():
    limits = [
        Coefficient(0.0, (0.0, 0.4), (0.0, 0.8)),
        Coefficient(0.3, (0.0, 0.7), (0.0, 1.0)),
        Coefficient(0.3, (0.1, 0.5), (0.0, 0.8)),
    ]
    rows = log_likelihoods(limits, np.linspace(-12, 3, 200))
    assert np.all(rows[:, 0] > -3)
    assert np.all(np.diff(rows[:, -54:], axis=1) < 0)


def test_what_has_no_likelihood_is_refused():
    with pytest.raises(ValueError, match=r"coefficient 1: .*no upper end"):
        log_likelihoods(
            [Coefficient(1, (0.9, 1.1), (0.8, 1.2)), Coefficient(1, (0.5, 3), (0.2, np.inf))],
            np.zeros(2),
        )


def test_a_ratio_is_inverted_with_its_parts():
    rng = np.random.default_rng(3)
    a, b = exact_coefficient(2.0, 30, rng), exact_coefficient(5.0, 80, rng)
    up, down = ratio_of(a, b), ratio_of(b, a)
    assert up.value == pytest.approx(1 / down.value)
    assert up.ci95[0] == pytest.approx(1 / down.ci95[1])
    assert up.ci95[0] < a.value / b.value < up.ci95[1]


def test_the_mean_follows_units_and_order():
    """A factor of all values is one of the mean; the order of clusters does not matter."""
    coefficients, movies = drawn(np.random.default_rng(4), movies=4, clusters=5)
    plain = population_mean(coefficients, movies=movies)
    other = population_mean([scaled(one, 1e-3) for one in coefficients], movies=movies)
    assert other.value == pytest.approx(1e-3 * plain.value, rel=1e-6)
    assert other.spread_clusters == pytest.approx(plain.spread_clusters)
    order = np.random.default_rng(5).permutation(len(movies))
    mixed = population_mean(
        [coefficients[i] for i in order], movies=[f"m{movies[i]}" for i in order]
    )
    assert mixed.ci95 == pytest.approx(plain.ci95, rel=1e-9)


def test_normal_clusters_of_equal_movies_have_the_interval_of_student():
    """Long tracks and equal movies: the interval is that of t for the means of the movies."""
    from scipy.stats import t

    rng = np.random.default_rng(6)
    coefficients, movies = drawn(rng, movies=5, clusters=4, spread=(0.3, 0.3), steps=4000)
    mean = population_mean(coefficients, movies=movies)
    each = np.log([one.value for one in coefficients]).reshape(5, 4).mean(axis=1)
    half = t.ppf(0.975, 4) * each.std(ddof=1) / np.sqrt(5)
    assert np.log(mean.value) == pytest.approx(each.mean(), abs=0.01 * half)
    assert np.log(mean.ci95[1] / mean.ci95[0]) / 2 == pytest.approx(half, rel=0.02)


def test_one_movie_and_one_cluster_say_what_their_interval_is_about():
    coefficients, _ = drawn(np.random.default_rng(7), movies=1, clusters=6)
    assert "for this movie" in population_mean(coefficients).text
    alone = population_mean(coefficients[:1])
    assert alone.scope == "cluster"
    assert alone.ci95 == coefficients[0].ci95
    with pytest.raises(ValueError, match="got none"):
        population_mean([])
    with pytest.raises(ValueError, match="expected one name for each of 6 clusters, got 2"):
        population_mean(coefficients, movies=["a", "b"])


@pytest.mark.parametrize(
    ("design", "spread"),
    [((2, (1, 5)), (0.2, 0.2)), ((5, (1, 3)), (0.5, 0.5)), ((10, (1, 9)), (0.0, 0.0))],
)
def test_intervals_of_means_cover(design, spread, repeats):
    """95 % intervals cover at least 0.93, from 5 movies on at most 0.97, within 3 errors.

    benchmarks/study_coverage.py --quick, a part of .ci/run, does it with 40 repeats of every
    design.
    """
    if design[0] != 5 and not repeats(0, 1):
        pytest.skip("with --long only")
    count = repeats(12, 1000)
    found = BENCHMARK["covered"](design, spread, repeats=count, rng=np.random.default_rng(8))
    error = np.sqrt(0.95 * 0.05 / count)
    most = 0.97 if design[0] >= 5 else 1.0
    assert 0.93 - 3 * error <= found["ci95"] <= most + 3 * error
    assert found["spread_clusters"] >= 0.93 - 3 * error


def test_a_smoothed_likelihood_keeps_its_mean_and_adds_its_variance():
    """Narrow spreads too, below the step of the grid."""
    x = np.linspace(-7, 9, 321)
    for spread in (0.02, 0.2, 1.0):
        law = np.exp(smoothed(-0.5 * x[None] ** 2, spread, step=0.05))[0]
        law /= law.sum()
        assert law @ x == pytest.approx(0, abs=1e-4)
        assert law @ x**2 == pytest.approx(1 + spread**2, rel=1e-4)


def means_of(values, rng, *, movies=3, spread=(0.1, 0.1)):
    found = []
    for value in values:
        some, movie = drawn(rng, movies=movies, clusters=3, centre=value, spread=spread)
        found.append(population_mean(some, movies=movie))
    return found


@pytest.mark.parametrize(
    ("law", "planted"),
    [
        ("inverse", {"A": 2.0}),
        ("power", {"A": 2.0, "exponent": -0.7}),
        ("exponential", {"A": 2.0, "rate": -0.4}),
    ],
)
def test_a_planted_law_lies_in_the_intervals(law, planted):
    """99.9 % of fits have their parameters within twice the 95 % interval."""
    x = np.array([0.5, 1.0, 2.0, 4.0])
    means = means_of(law_values(law, x, planted), np.random.default_rng(9))
    trend = fit_trend(means, x, law=law)
    assert trend.dof == 12 - len(planted)
    for name, value in planted.items():
        low, high = trend.ci95[name]
        assert low - (high - low) / 2 < value < high + (high - low) / 2
    again = Trend.from_dict(json.loads(json.dumps(trend.to_dict())))
    assert again.to_dict() == trend.to_dict()


def test_a_function_of_the_user_gives_what_the_named_law_gives():
    x = np.array([0.5, 1.0, 2.0, 4.0])
    means = means_of(2.0 * x**-0.7, np.random.default_rng(10), movies=2)
    named = fit_trend(means, x, law="power")
    own = fit_trend(means, x, law=lambda x, A, n: A * x**n, start={"A": 1.0, "n": -1.0})
    assert own.parameters["A"] == pytest.approx(named.parameters["A"], rel=1e-4)
    assert own.parameters["n"] == pytest.approx(named.parameters["exponent"], rel=1e-4)
    assert own.ci95["n"] == pytest.approx(named.ci95["exponent"], rel=1e-2)
    # Units of x change A alone.
    other = fit_trend(means, 1e3 * x, law="power")
    assert other.parameters["exponent"] == pytest.approx(named.parameters["exponent"], rel=1e-5)


def test_a_law_that_does_not_hold_has_a_spread_and_a_small_p():
    x = np.array([0.5, 1.0, 2.0, 4.0])
    means = means_of(np.exp(x), np.random.default_rng(11), spread=(0.05, 0.0))
    trend = fit_trend(means, x, law="power")
    assert trend.p < 1e-6
    assert trend.spread > 0.1
    assert "leaves a scatter" in trend.text


def test_faults_of_a_trend_are_listed_together():
    means = means_of([1.0, 2.0], np.random.default_rng(12))
    with pytest.raises(ValueError, match=r"x: expected a finite number.*law: expected 'constant'"):
        fit_trend(means, [1.0], law="line")
    with pytest.raises(ValueError, match="numbers > 0"):
        fit_trend(means, [0.0, 1.0], law="power")


def test_what_no_law_can_be_fitted_to_is_named():
    means = means_of([1.0, 2.0], np.random.default_rng(12))
    with pytest.raises(ValueError, match="start: expected a value for every parameter"):
        fit_trend(means, [1.0, 2.0], law=lambda x, a: a * x)
    with pytest.raises(ValueError, match="start: expected parameters at which the law is above 0"):
        fit_trend(means, [1.0, 2.0], law=lambda x, a: a * x, start={"a": -1.0})
    with pytest.raises(ValueError, match="at least two different conditions"):
        fit_trend(means, [2.0, 2.0], law="power")
    with pytest.raises(ValueError, match="as many means of both, three or more, got 2 and 1"):
        fit_power_law(means, means[:1])
    read = type(means[0]).from_dict(means[0].to_dict())
    with pytest.raises(ValueError, match="condition 0 has no likelihoods of movies"):
        fit_trend([read, means[1]], [1.0, 2.0], law="power")


def test_the_exponent_of_decoupling_comes_back():
    rng = np.random.default_rng(13)
    D_R = np.array([1e-3, 4e-3, 1e-2, 3e-2])
    slow = fit_power_law(means_of(D_R, rng), means_of(5 * D_R**0.7, rng))
    low, high = slow.ci95["exponent"]
    assert low - 0.1 < 0.7 < high + 0.1
    assert slow.stderr["exponent"] < 0.15


def test_a_comparison_is_the_same_from_both_sides():
    first, second = means_of([1.0, 1.6], np.random.default_rng(14), movies=4)
    one, other = compare_conditions(first, second), compare_conditions(second, first)
    assert one.ratio == pytest.approx(1 / other.ratio)
    assert one.p == pytest.approx(other.p)
    assert one.ci95[0] == pytest.approx(1 / other.ci95[1])
    assert (one.p < 0.05) == (not one.ci95[0] <= 1 <= one.ci95[1])
    assert Comparison.from_dict(one.to_dict()) == one


def test_a_planted_outlier_is_named_and_others_are_not():
    rng = np.random.default_rng(15)
    coefficients, movies = drawn(rng, movies=4, clusters=5, spread=(0.1, 0.05))
    assert not any(one.outlying for one in leave_one_out(coefficients, movies=movies))
    coefficients[7] = scaled(coefficients[7], 4.0)
    found = leave_one_out(coefficients, movies=movies)
    assert [one.index for one in found if one.outlying] == [7]
    assert found[7].change < -0.02
    assert Influence.from_dict(found[7].to_dict()) == found[7]
    far = [scaled(c, 5.0) if m == 2 else c for c, m in zip(coefficients, movies, strict=True)]
    movie = leave_one_out(far, movies=movies, kind="movie")
    assert max(movie, key=lambda one: abs(one.deviation)).index == 2


def test_shapes_of_all_runs_are_named_alike():
    """Noise hides the symmetry of some; two shapes of one size have two names."""
    rng = np.random.default_rng(16)
    tetrahedron = Cluster.touching(4, 2.0).positions
    square = np.array([[0, 0, 0], [2.0, 0, 0], [0, 2, 0], [2, 2, 0]])
    kinds = [
        RunKind(4, "T_d", tetrahedron, 3),
        RunKind(4, "C_1", tetrahedron + rng.normal(0, 0.02, (4, 3))),
        RunKind(4, "C_1", square),
        RunKind(3, "D_3h", tetrahedron[:3]),
    ]
    names = study_kinds(kinds)
    assert names[0] == names[1] == "4 particles, T_d"
    assert names[2] == "4 particles, C_1"
    assert names[3] == "3 particles, D_3h"


def test_plans_reach_the_wanted_error():
    plan = plan_study(0.15, n_clusters=8, spread_clusters=0.25, spread_movies=0.1)
    assert plan.half_width <= 0.15
    assert plan.half_width == pytest.approx(
        expected_half_width(
            n_movies=plan.n_movies, n_clusters=8, cluster_error=plan.cluster_error,
            spread_clusters=0.25, spread_movies=0.1,
        )
    )  # fmt: skip
    wider = plan_study(0.3, n_clusters=8, spread_clusters=0.25, spread_movies=0.1)
    assert wider.n_movies * wider.n_frames < plan.n_movies * plan.n_frames
    assert StudyPlan.from_dict(json.loads(json.dumps(plan.to_dict()))) == plan
    with pytest.raises(ValueError, match=r"half_width.*; spread_clusters"):
        plan_study(0.0, n_clusters=8, spread_clusters=-1)
    with pytest.raises(ValueError, match="not reached"):
        plan_study(0.01, n_clusters=2, spread_clusters=0.2, spread_movies=0.5)


def test_a_mean_survives_json():
    coefficients, movies = drawn(np.random.default_rng(17), movies=2, clusters=2)
    mean = population_mean(coefficients, movies=movies, unit="rad^2/s")
    again = PopulationMean.from_dict(json.loads(json.dumps(mean.to_dict())))
    assert again.to_dict() == mean.to_dict()
    assert again.movies is None
