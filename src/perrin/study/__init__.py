"""Studies: many movies under several conditions, and one answer for each condition."""

from perrin.study.comparison import Comparison, compare_conditions
from perrin.study.influence import Influence, leave_one_out
from perrin.study.mixture import RunKind, study_kinds
from perrin.study.planning import StudyPlan, expected_half_width, plan_study
from perrin.study.profiles import Coefficient, Interval, log_likelihoods, ratio_of
from perrin.study.random_effects import MovieLikelihoods, PopulationMean, population_mean, smoothed
from perrin.study.trends import Trend, fit_power_law, fit_trend, law_values

__all__ = [
    "Coefficient",
    "Comparison",
    "Influence",
    "Interval",
    "MovieLikelihoods",
    "PopulationMean",
    "RunKind",
    "StudyPlan",
    "Trend",
    "compare_conditions",
    "expected_half_width",
    "fit_power_law",
    "fit_trend",
    "law_values",
    "leave_one_out",
    "log_likelihoods",
    "plan_study",
    "population_mean",
    "ratio_of",
    "smoothed",
    "study_kinds",
]
