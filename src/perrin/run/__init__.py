"""From a track table to a Report, and the folder that holds it."""

from perrin.run.experiment import Conditions, check_arguments, told_conditions
from perrin.run.folders import check_place, check_resumable, filled_folder, staged_folder
from perrin.run.measure import Remarks, measure_table
from perrin.run.predictions import (
    Body,
    Compared,
    Prediction,
    Shape,
    are_unequal,
    compare_body,
    compare_rod,
    find_sizes,
    is_known,
    solve_bodies,
)
from perrin.run.remarks import Remark, condensed, grouped, merged
from perrin.run.results import (
    ClusterResult,
    Pooled,
    Report,
    RodResult,
    curve_table,
    floor_factor,
    load_run,
    motion_table,
    perp_text,
    predicted_noise,
    write_data,
)
from perrin.run.tables import analyze

__all__ = [
    "Body",
    "ClusterResult",
    "Compared",
    "Conditions",
    "Pooled",
    "Prediction",
    "Remark",
    "Remarks",
    "Report",
    "RodResult",
    "Shape",
    "analyze",
    "are_unequal",
    "check_arguments",
    "check_place",
    "check_resumable",
    "compare_body",
    "compare_rod",
    "condensed",
    "curve_table",
    "filled_folder",
    "find_sizes",
    "floor_factor",
    "grouped",
    "is_known",
    "load_run",
    "measure_table",
    "merged",
    "motion_table",
    "perp_text",
    "predicted_noise",
    "solve_bodies",
    "staged_folder",
    "told_conditions",
    "write_data",
]
