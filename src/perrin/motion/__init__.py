"""How a body moves: its position and orientation in every frame."""

from perrin.motion.floor import NoiseFloor, floor_of, floor_range, noise_floor
from perrin.motion.residuals import (
    AxisNoise,
    Residuals,
    Slope,
    Stretch,
    autocorrelation,
    axis_noise,
    body_residuals,
    fit_projector,
    lag_one_autocorrelation,
    lagged_products,
    measure_scan,
    measure_stretch,
    regress,
    sample_residuals,
)
from perrin.motion.rigid_motion import RigidMotion, threshold_displacement
from perrin.motion.rigidity import Quality, judge_quality
from perrin.motion.rods import RodMotion, track_direction
from perrin.motion.simulate import add_noise, simulate_motion
from perrin.motion.tracking import remove_rotation, track_rotation

__all__ = [
    "AxisNoise",
    "NoiseFloor",
    "Quality",
    "Residuals",
    "RigidMotion",
    "RodMotion",
    "Slope",
    "Stretch",
    "add_noise",
    "autocorrelation",
    "axis_noise",
    "body_residuals",
    "fit_projector",
    "floor_of",
    "floor_range",
    "judge_quality",
    "lag_one_autocorrelation",
    "lagged_products",
    "measure_scan",
    "measure_stretch",
    "noise_floor",
    "regress",
    "remove_rotation",
    "sample_residuals",
    "simulate_motion",
    "threshold_displacement",
    "track_direction",
    "track_rotation",
]
