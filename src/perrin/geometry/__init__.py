"""Where points are and how they are turned: rotations, shapes, symmetry, rigid bodies."""

from perrin.geometry.rigid import (
    center_variance,
    degrees_of_freedom,
    diffusion_center,
    inertia_tensor,
    orientation_covariance,
    pose_slopes,
    shifted,
)
from perrin.geometry.rotations import (
    Similarity,
    axis_angle,
    cumulative_product,
    exp_map,
    fit_rotations,
    kabsch,
    log_map,
    similarity,
    skew,
    successive_product,
)
from perrin.geometry.shapes import Cluster, is_tetrahedron, pair_distances
from perrin.geometry.symmetry import (
    matching_rotation,
    point_group,
    rotation_group,
    schoenflies,
    symmetry_elements,
)

__all__ = [
    "Cluster",
    "Similarity",
    "axis_angle",
    "center_variance",
    "cumulative_product",
    "degrees_of_freedom",
    "diffusion_center",
    "exp_map",
    "fit_rotations",
    "inertia_tensor",
    "is_tetrahedron",
    "kabsch",
    "log_map",
    "matching_rotation",
    "orientation_covariance",
    "pair_distances",
    "point_group",
    "pose_slopes",
    "rotation_group",
    "schoenflies",
    "shifted",
    "similarity",
    "skew",
    "successive_product",
    "symmetry_elements",
]
