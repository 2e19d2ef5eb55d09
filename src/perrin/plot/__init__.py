"""Pictures of results and of images; the only subpackage that imports matplotlib."""

from perrin.plot.imaging import (
    imaging_of,
    least_turn,
    least_turns,
    plot_found,
    plot_health,
    plot_masses,
    plot_misfit,
    plot_rigidity,
    plot_step_angles,
    plot_tracks,
    save_image_figures,
)
from perrin.plot.results import (
    plot_cluster,
    plot_forest,
    plot_lag_curve,
    plot_orientations,
    plot_plan,
    plot_presence,
    plot_residual,
    plot_van_hove,
    save_figures,
)
from perrin.plot.style import legend_above, new_figure, save_figure

__all__ = [
    "imaging_of",
    "least_turn",
    "least_turns",
    "legend_above",
    "new_figure",
    "plot_cluster",
    "plot_forest",
    "plot_found",
    "plot_health",
    "plot_lag_curve",
    "plot_masses",
    "plot_misfit",
    "plot_orientations",
    "plot_plan",
    "plot_presence",
    "plot_residual",
    "plot_rigidity",
    "plot_step_angles",
    "plot_tracks",
    "plot_van_hove",
    "save_figure",
    "save_figures",
    "save_image_figures",
]
