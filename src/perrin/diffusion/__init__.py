"""How fast a body diffuses: coefficients, tensors, their errors, and tests of the steps."""

from perrin.diffusion.bounds import cramer_rao, whole
from perrin.diffusion.curve_fits import (
    GridLags,
    best_window,
    fit_gls,
    fit_line,
    gls_weights,
    line_weights,
    msd_covariance,
    slope_interval,
    weighted_variance,
)
from perrin.diffusion.estimate import DiffusionEstimate, Found, bare_text, value_text
from perrin.diffusion.estimators import by_likelihood, estimate_diffusion, track_of
from perrin.diffusion.likelihood import Likelihood, Peak, excess_scatter
from perrin.diffusion.moments import Moments, covariance_estimate, trace_estimate
from perrin.diffusion.noise_model import Noise, choice_faults
from perrin.diffusion.rods import estimate_rod
from perrin.diffusion.sampling import SamplingPlan, SamplingVerdict, judge_sampling, plan_sampling
from perrin.diffusion.step_kernels import Sums, Track, covariance_bands
from perrin.diffusion.step_tests import (
    Jumps,
    SteadyMotion,
    cut_at,
    find_jumps,
    offset_gain,
    persistence_gain,
    steady_motion,
    without_spin,
)
from perrin.diffusion.steps import (
    Steps,
    Walk,
    center_steps,
    direction_steps,
    residual_freedom,
    steps_of,
    unit_center_variance,
    unit_covariance,
)
from perrin.diffusion.tensor_likelihood import (
    Arrow,
    Maximum,
    Slopes,
    Source,
    VectorSteps,
    axial,
    maximise,
    spread,
    squares,
)
from perrin.diffusion.tensor_results import CoupledTensor, DiffusionTensor
from perrin.diffusion.tensors import axes_like, coupled_tensor, diffusion_tensor

__all__ = [
    "Arrow",
    "CoupledTensor",
    "DiffusionEstimate",
    "DiffusionTensor",
    "Found",
    "GridLags",
    "Jumps",
    "Likelihood",
    "Maximum",
    "Moments",
    "Noise",
    "Peak",
    "SamplingPlan",
    "SamplingVerdict",
    "Slopes",
    "Source",
    "SteadyMotion",
    "Steps",
    "Sums",
    "Track",
    "VectorSteps",
    "Walk",
    "axes_like",
    "axial",
    "bare_text",
    "best_window",
    "by_likelihood",
    "center_steps",
    "choice_faults",
    "coupled_tensor",
    "covariance_bands",
    "covariance_estimate",
    "cramer_rao",
    "cut_at",
    "diffusion_tensor",
    "direction_steps",
    "estimate_diffusion",
    "estimate_rod",
    "excess_scatter",
    "find_jumps",
    "fit_gls",
    "fit_line",
    "gls_weights",
    "judge_sampling",
    "line_weights",
    "maximise",
    "msd_covariance",
    "offset_gain",
    "persistence_gain",
    "plan_sampling",
    "residual_freedom",
    "slope_interval",
    "spread",
    "squares",
    "steady_motion",
    "steps_of",
    "trace_estimate",
    "track_of",
    "unit_center_variance",
    "unit_covariance",
    "value_text",
    "weighted_variance",
    "whole",
    "without_spin",
]
