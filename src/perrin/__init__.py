"""perrin: measure how rigid clusters of colloidal particles diffuse and turn.

Positions (T, n, d) become a `RigidMotion`; a `RigidMotion` makes `LagCurve`s and
`DiffusionEstimate`s; tables, files, pictures and the command line stand at the doors.
Units: um, s, rad, K, Pa s.
"""

from perrin._arrays import (
    DegenerateClusterError,
    IdentityWarning,
    PrecisionWarning,
    TooFewFramesError,
    TrackTableError,
)
from perrin.diffusion import DiffusionEstimate, estimate_diffusion, fit_line
from perrin.files import read_tracks, write_tracks
from perrin.grouping import cluster_positions, find_clusters
from perrin.lagged import LagCurve, msad, msd
from perrin.motion import RigidMotion, track_rotation
from perrin.noise import NoiseFloor, noise_floor
from perrin.rotations import kabsch
from perrin.shapes import Cluster
from perrin.simulate import add_noise, simulate_motion

__version__ = "0.1.0"

__all__ = [
    "Cluster",
    "DegenerateClusterError",
    "DiffusionEstimate",
    "IdentityWarning",
    "LagCurve",
    "NoiseFloor",
    "PrecisionWarning",
    "RigidMotion",
    "TooFewFramesError",
    "TrackTableError",
    "add_noise",
    "cluster_positions",
    "estimate_diffusion",
    "find_clusters",
    "fit_line",
    "kabsch",
    "msad",
    "msd",
    "noise_floor",
    "read_tracks",
    "simulate_motion",
    "track_rotation",
    "write_tracks",
]
