"""perrin: measure how rigid clusters of colloidal particles diffuse and turn.

Positions (T, n, d) become a `RigidMotion`, which makes every `LagCurve` and
`DiffusionEstimate`; tables, files, pictures and the command line stand at the doors.
Units: um, s, rad, K, Pa s.

Each name is loaded from its room when it is first asked for, so that `import perrin` and the
command line's help cost next to nothing.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from perrin._arrays import (
        DegenerateClusterError,
        FrameError,
        IdentityError,
        IdentityWarning,
        NoSpheresError,
        PrecisionWarning,
        TooFewFramesError,
        TrackTableError,
        UnitWarning,
    )
    from perrin.analysis import analyze
    from perrin.bounds import cramer_rao
    from perrin.curve_fits import fit_gls, fit_line
    from perrin.diffusion import DiffusionEstimate, estimate_diffusion
    from perrin.files import read_tracks, write_tracks
    from perrin.grouping import cluster_positions, find_clusters, identify, positions_table
    from perrin.hydrodynamics import (
        Size,
        size_and_viscosity,
        size_from_rotation,
        size_from_translation,
    )
    from perrin.identity import Identity, settle_identity
    from perrin.images.locate import locate
    from perrin.images.optics import Optics
    from perrin.images.poses import fit_pose
    from perrin.images.render import render_stack
    from perrin.images.run import analyze_stack
    from perrin.images.stacks import Stack, open_stack, write_stack
    from perrin.lagged import (
        LagCurve,
        VanHove,
        msad,
        msad_axes,
        msad_vector,
        msd,
        orientation_correlation,
        van_hove,
    )
    from perrin.mobility import Mobility, apparent_translation, cluster_mobility
    from perrin.motion import RigidMotion, remove_rotation, threshold_displacement, track_rotation
    from perrin.noise import NoiseFloor, noise_floor
    from perrin.predictions import Compared, Prediction
    from perrin.quality import Quality, judge_quality
    from perrin.quaternions import QuaternionCovariance, quaternion_covariance
    from perrin.report import write_run
    from perrin.results import ClusterResult, Report, RodResult, load_run
    from perrin.rod_diffusion import estimate_rod
    from perrin.rods import RodMotion, track_direction
    from perrin.rotations import Similarity, axis_angle, kabsch, similarity
    from perrin.sampling import SamplingPlan, SamplingVerdict, judge_sampling, plan_sampling
    from perrin.shapes import Cluster, point_group, rotation_group
    from perrin.simulate import add_noise, simulate_motion
    from perrin.surroundings import (
        WallFactor,
        gravitational_height,
        settling_velocity,
        wall_diffusion,
        wall_factor,
        water_viscosity,
    )
    from perrin.tensors import CoupledTensor, DiffusionTensor, coupled_tensor, diffusion_tensor

__version__ = "0.1.0"

__all__ = [
    "Cluster",
    "ClusterResult",
    "Compared",
    "CoupledTensor",
    "DegenerateClusterError",
    "DiffusionEstimate",
    "DiffusionTensor",
    "FrameError",
    "Identity",
    "IdentityError",
    "IdentityWarning",
    "LagCurve",
    "Mobility",
    "NoSpheresError",
    "NoiseFloor",
    "Optics",
    "PrecisionWarning",
    "Prediction",
    "Quality",
    "QuaternionCovariance",
    "Report",
    "RigidMotion",
    "RodMotion",
    "RodResult",
    "SamplingPlan",
    "SamplingVerdict",
    "Similarity",
    "Size",
    "Stack",
    "TooFewFramesError",
    "TrackTableError",
    "UnitWarning",
    "VanHove",
    "WallFactor",
    "add_noise",
    "analyze",
    "analyze_stack",
    "apparent_translation",
    "axis_angle",
    "cluster_mobility",
    "cluster_positions",
    "coupled_tensor",
    "cramer_rao",
    "diffusion_tensor",
    "estimate_diffusion",
    "estimate_rod",
    "find_clusters",
    "fit_gls",
    "fit_line",
    "fit_pose",
    "gravitational_height",
    "identify",
    "judge_quality",
    "judge_sampling",
    "kabsch",
    "load_run",
    "locate",
    "msad",
    "msad_axes",
    "msad_vector",
    "msd",
    "noise_floor",
    "open_stack",
    "orientation_correlation",
    "plan_sampling",
    "point_group",
    "positions_table",
    "quaternion_covariance",
    "read_tracks",
    "remove_rotation",
    "render_stack",
    "rotation_group",
    "settle_identity",
    "settling_velocity",
    "similarity",
    "simulate_motion",
    "size_and_viscosity",
    "size_from_rotation",
    "size_from_translation",
    "threshold_displacement",
    "track_direction",
    "track_rotation",
    "van_hove",
    "wall_diffusion",
    "wall_factor",
    "water_viscosity",
    "write_run",
    "write_stack",
    "write_tracks",
]

# Which room a name is in, rooms in the order of the house.
_ROOMS = {
    "_arrays": (
        "DegenerateClusterError",
        "FrameError",
        "IdentityError",
        "IdentityWarning",
        "NoSpheresError",
        "PrecisionWarning",
        "TooFewFramesError",
        "TrackTableError",
        "UnitWarning",
    ),
    "rotations": ("Similarity", "axis_angle", "kabsch", "similarity"),
    "shapes": ("Cluster", "point_group", "rotation_group"),
    "noise": ("NoiseFloor", "noise_floor"),
    "motion": ("RigidMotion", "remove_rotation", "threshold_displacement", "track_rotation"),
    "identity": ("Identity", "settle_identity"),
    "rods": ("RodMotion", "track_direction"),
    "grouping": ("cluster_positions", "find_clusters", "identify", "positions_table"),
    "quality": ("Quality", "judge_quality"),
    "lagged": (
        "LagCurve",
        "VanHove",
        "msad",
        "msad_axes",
        "msad_vector",
        "msd",
        "orientation_correlation",
        "van_hove",
    ),
    "quaternions": ("QuaternionCovariance", "quaternion_covariance"),
    "diffusion": ("DiffusionEstimate", "estimate_diffusion"),
    "rod_diffusion": ("estimate_rod",),
    "curve_fits": ("fit_gls", "fit_line"),
    "tensors": ("CoupledTensor", "DiffusionTensor", "coupled_tensor", "diffusion_tensor"),
    "bounds": ("cramer_rao",),
    "sampling": ("SamplingPlan", "SamplingVerdict", "judge_sampling", "plan_sampling"),
    "mobility": ("Mobility", "apparent_translation", "cluster_mobility"),
    "hydrodynamics": (
        "Size",
        "size_and_viscosity",
        "size_from_rotation",
        "size_from_translation",
    ),
    "predictions": ("Compared", "Prediction"),
    "surroundings": (
        "WallFactor",
        "gravitational_height",
        "settling_velocity",
        "wall_diffusion",
        "wall_factor",
        "water_viscosity",
    ),
    "simulate": ("add_noise", "simulate_motion"),
    "files": ("read_tracks", "write_tracks"),
    "images.stacks": ("Stack", "open_stack", "write_stack"),
    "images.render": ("render_stack",),
    "images.optics": ("Optics",),
    "images.locate": ("locate",),
    "images.poses": ("fit_pose",),
    "images.run": ("analyze_stack",),
    "results": ("ClusterResult", "Report", "RodResult", "load_run"),
    "analysis": ("analyze",),
    "report": ("write_run",),
}


def __getattr__(name: str) -> Any:  # noqa: ANN401 (a module's attributes have any type)
    """Load a public name from its room."""
    from importlib import import_module

    for room, names in _ROOMS.items():
        if name in names:
            value = getattr(import_module(f"perrin.{room}"), name)
            globals()[name] = value
            return value
    raise AttributeError(f"module 'perrin' has no attribute {name!r}")


def __dir__() -> list[str]:
    """List the public names, loaded or not."""
    return sorted([*globals(), *__all__])
