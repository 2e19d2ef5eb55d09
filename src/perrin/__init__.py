"""perrin: measure how rigid clusters of colloidal particles diffuse and turn.

Positions (T, n, d) become a `RigidMotion`, which makes every `LagCurve` and
`DiffusionEstimate`; tables, files, images, pictures and the command line are the boundary.
Units: um, s, rad, K, Pa s.

Each name is imported from its subpackage when it is first used, so that `import perrin` imports no
other package.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from perrin.curves import (
        LagCurve,
        QuaternionCovariance,
        VanHove,
        msad,
        msad_axes,
        msad_vector,
        msd,
        orientation_correlation,
        quaternion_covariance,
        van_hove,
    )
    from perrin.diffusion import (
        CoupledTensor,
        DiffusionEstimate,
        DiffusionTensor,
        SamplingPlan,
        SamplingVerdict,
        coupled_tensor,
        cramer_rao,
        diffusion_tensor,
        estimate_diffusion,
        estimate_rod,
        fit_gls,
        fit_line,
        judge_sampling,
        plan_sampling,
    )
    from perrin.errors import (
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
    from perrin.geometry import (
        Cluster,
        Similarity,
        axis_angle,
        kabsch,
        point_group,
        rotation_group,
        similarity,
    )
    from perrin.hydrodynamics import (
        Mobility,
        Size,
        WallFactor,
        apparent_translation,
        cluster_mobility,
        gravitational_height,
        settling_velocity,
        size_and_viscosity,
        size_from_rotation,
        size_from_translation,
        wall_diffusion,
        wall_factor,
        water_viscosity,
    )
    from perrin.images import Optics, Stack, fit_pose, locate, open_stack, render_stack, write_stack
    from perrin.motion import (
        NoiseFloor,
        Quality,
        RigidMotion,
        RodMotion,
        add_noise,
        judge_quality,
        noise_floor,
        remove_rotation,
        simulate_motion,
        threshold_displacement,
        track_direction,
        track_rotation,
    )
    from perrin.movie import analyze_stack
    from perrin.report import write_run
    from perrin.run import ClusterResult, Compared, Prediction, Report, RodResult, analyze, load_run
    from perrin.tracks import (
        Identity,
        cluster_positions,
        find_clusters,
        identify,
        positions_table,
        read_tracks,
        settle_identity,
        write_tracks,
    )

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

# The public names of every subpackage.
_FACES = {
    "errors": (
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
    "geometry": (
        "Cluster",
        "Similarity",
        "axis_angle",
        "kabsch",
        "point_group",
        "rotation_group",
        "similarity",
    ),
    "hydrodynamics": (
        "Mobility",
        "Size",
        "WallFactor",
        "apparent_translation",
        "cluster_mobility",
        "gravitational_height",
        "settling_velocity",
        "size_and_viscosity",
        "size_from_rotation",
        "size_from_translation",
        "wall_diffusion",
        "wall_factor",
        "water_viscosity",
    ),
    "motion": (
        "NoiseFloor",
        "Quality",
        "RigidMotion",
        "RodMotion",
        "add_noise",
        "judge_quality",
        "noise_floor",
        "remove_rotation",
        "simulate_motion",
        "threshold_displacement",
        "track_direction",
        "track_rotation",
    ),
    "tracks": (
        "Identity",
        "cluster_positions",
        "find_clusters",
        "identify",
        "positions_table",
        "read_tracks",
        "settle_identity",
        "write_tracks",
    ),
    "curves": (
        "LagCurve",
        "QuaternionCovariance",
        "VanHove",
        "msad",
        "msad_axes",
        "msad_vector",
        "msd",
        "orientation_correlation",
        "quaternion_covariance",
        "van_hove",
    ),
    "diffusion": (
        "CoupledTensor",
        "DiffusionEstimate",
        "DiffusionTensor",
        "SamplingPlan",
        "SamplingVerdict",
        "coupled_tensor",
        "cramer_rao",
        "diffusion_tensor",
        "estimate_diffusion",
        "estimate_rod",
        "fit_gls",
        "fit_line",
        "judge_sampling",
        "plan_sampling",
    ),
    "images": (
        "Optics",
        "Stack",
        "fit_pose",
        "locate",
        "open_stack",
        "render_stack",
        "write_stack",
    ),
    "run": (
        "ClusterResult",
        "Compared",
        "Prediction",
        "Report",
        "RodResult",
        "analyze",
        "load_run",
    ),
    "movie": ("analyze_stack",),
    "report": ("write_run",),
}


def __getattr__(name: str) -> Any:  # noqa: ANN401 (a module's attributes have any type)
    """Import a public name or a subpackage when it is first used."""
    from importlib import import_module

    if name in _FACES:
        return import_module(f"perrin.{name}")
    for subpackage, names in _FACES.items():
        if name in names:
            value = getattr(import_module(f"perrin.{subpackage}"), name)
            globals()[name] = value
            return value
    raise AttributeError(f"module 'perrin' has no attribute {name!r}")


def __dir__() -> list[str]:
    """List the public names, imported or not."""
    return sorted(__all__)
