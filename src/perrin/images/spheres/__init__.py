"""Where the spheres and clusters of a stack are."""

from perrin.images.spheres.by_trackpy import Features, find_features, refine_by_trackpy
from perrin.images.spheres.localisation import (
    Found,
    Method,
    Sampled,
    Search,
    StackLike,
    check_search,
    choose_method,
    fit_optics,
    found_table,
    frame_digest,
    is_flat,
    locate,
    sample_frames,
)
from perrin.images.spheres.poses import Pose, fit_pose, pose_in, start_of, with_poses
from perrin.images.spheres.spots import at_contact, groups_and_crowds, mass_cut, touching_together

__all__ = [
    "Features",
    "Found",
    "Method",
    "Pose",
    "Sampled",
    "Search",
    "StackLike",
    "at_contact",
    "check_search",
    "choose_method",
    "find_features",
    "fit_optics",
    "fit_pose",
    "found_table",
    "frame_digest",
    "groups_and_crowds",
    "is_flat",
    "locate",
    "mass_cut",
    "pose_in",
    "refine_by_trackpy",
    "sample_frames",
    "start_of",
    "touching_together",
    "with_poses",
]
