"""Studies: many movies under several conditions, and one answer for each condition."""

from perrin.study.comparison import Comparison, compare_conditions
from perrin.study.conditions import (
    ClusterValue,
    ConditionMean,
    cluster_name,
    cluster_values,
    condition_means,
    condition_text,
)
from perrin.study.figures import plot_conditions, save_study_figures
from perrin.study.influence import Influence, leave_one_out
from perrin.study.ledger import Entry, is_current, read_entries, settings_of, stamp_of, write_entry
from perrin.study.manifest import (
    Exclusion,
    Manifest,
    StudyMovie,
    key_lines,
    manifest_dict,
    manifest_from,
    manifest_text,
    read_manifest,
    source_of,
)
from perrin.study.mixture import RunKind, study_kinds
from perrin.study.page import (
    ordered_conditions,
    render_samples,
    render_study,
    study_methods,
    warning_matrix,
)
from perrin.study.planning import StudyPlan, expected_half_width, plan_study
from perrin.study.profiles import Coefficient, Interval, log_likelihoods, ratio_of
from perrin.study.random_effects import MovieLikelihoods, PopulationMean, population_mean, smoothed
from perrin.study.running import Task, measure_all, measure_movie, unfinished
from perrin.study.studies import Study, duration_text
from perrin.study.study_results import StudyResult
from perrin.study.tables import movie_table, study_table
from perrin.study.trends import Trend, fit_power_law, fit_trend, law_values
from perrin.study.writing import write_results

__all__ = [
    "ClusterValue",
    "Coefficient",
    "Comparison",
    "ConditionMean",
    "Entry",
    "Exclusion",
    "Influence",
    "Interval",
    "Manifest",
    "MovieLikelihoods",
    "PopulationMean",
    "RunKind",
    "Study",
    "StudyMovie",
    "StudyPlan",
    "StudyResult",
    "Task",
    "Trend",
    "cluster_name",
    "cluster_values",
    "compare_conditions",
    "condition_means",
    "condition_text",
    "duration_text",
    "expected_half_width",
    "fit_power_law",
    "fit_trend",
    "is_current",
    "key_lines",
    "law_values",
    "leave_one_out",
    "log_likelihoods",
    "manifest_dict",
    "manifest_from",
    "manifest_text",
    "measure_all",
    "measure_movie",
    "movie_table",
    "ordered_conditions",
    "plan_study",
    "plot_conditions",
    "population_mean",
    "ratio_of",
    "read_entries",
    "read_manifest",
    "render_samples",
    "render_study",
    "save_study_figures",
    "settings_of",
    "smoothed",
    "source_of",
    "stamp_of",
    "study_kinds",
    "study_methods",
    "study_table",
    "unfinished",
    "warning_matrix",
    "write_entry",
    "write_results",
]
