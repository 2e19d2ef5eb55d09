"""Track tables: which particle is which, and which particles form a cluster."""

from perrin.tracks.bonds import Pairs, frames_of, rigid_groups
from perrin.tracks.clock import Clock, evenly_spaced, frame_stride, read_clock
from perrin.tracks.clusters import (
    cluster_positions,
    each_cluster,
    find_clusters,
    identify,
    positions_table,
)
from perrin.tracks.column_names import Spelling, recognise_columns, seconds, unit_faults
from perrin.tracks.files import check_tracks, read_spheres, read_tracks, write_tracks
from perrin.tracks.gdf import gdf_bytes, parse_gdf
from perrin.tracks.identity import Identity, settle_identity
from perrin.tracks.linking import link_clusters, touching_groups
from perrin.tracks.screening import (
    Screened,
    centre_removed,
    distance_notes,
    far_points,
    far_sentence,
    has_trackpy_columns,
    screen_rows,
)
from perrin.tracks.writing import written_whole

__all__ = [
    "Clock",
    "Identity",
    "Pairs",
    "Screened",
    "Spelling",
    "centre_removed",
    "check_tracks",
    "cluster_positions",
    "distance_notes",
    "each_cluster",
    "evenly_spaced",
    "far_points",
    "far_sentence",
    "find_clusters",
    "frame_stride",
    "frames_of",
    "gdf_bytes",
    "has_trackpy_columns",
    "identify",
    "link_clusters",
    "parse_gdf",
    "positions_table",
    "read_clock",
    "read_spheres",
    "read_tracks",
    "recognise_columns",
    "rigid_groups",
    "screen_rows",
    "seconds",
    "settle_identity",
    "touching_groups",
    "unit_faults",
    "write_tracks",
    "written_whole",
]
