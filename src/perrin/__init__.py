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
        IdentityWarning,
        PrecisionWarning,
        TooFewFramesError,
        TrackTableError,
    )
    from perrin.analysis import analyze
    from perrin.bounds import cramer_rao
    from perrin.curve_fits import fit_line
    from perrin.diffusion import DiffusionEstimate, estimate_diffusion
    from perrin.files import read_tracks, write_tracks
    from perrin.grouping import cluster_positions, find_clusters, positions_table
    from perrin.hydrodynamics import (
        Size,
        size_and_viscosity,
        size_from_rotation,
        size_from_translation,
    )
    from perrin.lagged import LagCurve, msad, msad_vector, msd, orientation_correlation
    from perrin.mobility import Mobility, apparent_translation, cluster_mobility
    from perrin.motion import RigidMotion, remove_rotation, track_rotation
    from perrin.noise import NoiseFloor, noise_floor
    from perrin.report import write_run
    from perrin.results import ClusterResult, Report, load_run
    from perrin.rotations import Similarity, axis_angle, kabsch, similarity
    from perrin.shapes import Cluster
    from perrin.simulate import add_noise, simulate_motion
    from perrin.surroundings import (
        WallFactor,
        gravitational_height,
        settling_velocity,
        wall_diffusion,
        wall_factor,
        water_viscosity,
    )

__version__ = "0.1.0"

__all__ = [
    "Cluster",
    "ClusterResult",
    "DegenerateClusterError",
    "DiffusionEstimate",
    "IdentityWarning",
    "LagCurve",
    "Mobility",
    "NoiseFloor",
    "PrecisionWarning",
    "Report",
    "RigidMotion",
    "Similarity",
    "Size",
    "TooFewFramesError",
    "TrackTableError",
    "WallFactor",
    "add_noise",
    "analyze",
    "apparent_translation",
    "axis_angle",
    "cluster_mobility",
    "cluster_positions",
    "cramer_rao",
    "estimate_diffusion",
    "find_clusters",
    "fit_line",
    "gravitational_height",
    "kabsch",
    "load_run",
    "msad",
    "msad_vector",
    "msd",
    "noise_floor",
    "orientation_correlation",
    "positions_table",
    "read_tracks",
    "remove_rotation",
    "settling_velocity",
    "similarity",
    "simulate_motion",
    "size_and_viscosity",
    "size_from_rotation",
    "size_from_translation",
    "track_rotation",
    "wall_diffusion",
    "wall_factor",
    "water_viscosity",
    "write_run",
    "write_tracks",
]

# Which room a name is in, rooms in the order of the house.
_ROOMS = {
    "_arrays": (
        "DegenerateClusterError",
        "IdentityWarning",
        "PrecisionWarning",
        "TooFewFramesError",
        "TrackTableError",
    ),
    "rotations": ("Similarity", "axis_angle", "kabsch", "similarity"),
    "shapes": ("Cluster",),
    "noise": ("NoiseFloor", "noise_floor"),
    "motion": ("RigidMotion", "remove_rotation", "track_rotation"),
    "grouping": ("cluster_positions", "find_clusters", "positions_table"),
    "lagged": ("LagCurve", "msad", "msad_vector", "msd", "orientation_correlation"),
    "diffusion": ("DiffusionEstimate", "estimate_diffusion"),
    "curve_fits": ("fit_line",),
    "bounds": ("cramer_rao",),
    "mobility": ("Mobility", "apparent_translation", "cluster_mobility"),
    "hydrodynamics": (
        "Size",
        "size_and_viscosity",
        "size_from_rotation",
        "size_from_translation",
    ),
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
    "results": ("ClusterResult", "Report", "load_run"),
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
