"""Motion of a body: its position and orientation in every frame, their errors, its rigidity."""

from perrin.motion.degenerate import distance_change, no_orientation, no_rotation
from perrin.motion.floor import (
    NoiseFloor,
    floor_of,
    floor_range,
    noise_floor,
)
from perrin.motion.procrustes import (
    PoseFit,
    chain_steps,
    fit_chain,
    fit_template,
    fit_weighted,
    pose_errors,
    step_residuals,
)
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
from perrin.motion.rigid_motion import (
    RigidMotion,
    threshold_displacement,
    threshold_references,
)
from perrin.motion.rigidity import (
    BondDrift,
    Quality,
    bond_drift,
    judge_quality,
    misplaced_detections,
)
from perrin.motion.rods import (
    RodMotion,
    track_direction,
)
from perrin.motion.simulate import (
    add_noise,
    heat_kernel_angles,
    simulate_motion,
)
from perrin.motion.tracking import (
    remove_rotation,
    template_motion,
    track_rotation,
)

__all__ = [
    "AxisNoise",
    "BondDrift",
    "NoiseFloor",
    "PoseFit",
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
    "bond_drift",
    "chain_steps",
    "distance_change",
    "fit_chain",
    "fit_projector",
    "fit_template",
    "fit_weighted",
    "floor_of",
    "floor_range",
    "heat_kernel_angles",
    "judge_quality",
    "lag_one_autocorrelation",
    "lagged_products",
    "measure_scan",
    "measure_stretch",
    "misplaced_detections",
    "no_orientation",
    "no_rotation",
    "noise_floor",
    "pose_errors",
    "regress",
    "remove_rotation",
    "sample_residuals",
    "simulate_motion",
    "step_residuals",
    "template_motion",
    "threshold_displacement",
    "threshold_references",
    "track_direction",
    "track_rotation",
]
