"""Where points are and how they are turned: rotations, shapes, symmetry, rigid bodies."""

from perrin.geometry.rigid import (
    center_variance,
    degrees_of_freedom,
    diffusion_center,
    orientation_covariance,
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
    unit_quaternion,
)
from perrin.geometry.shapes import Cluster, is_tetrahedron, pair_distances
from perrin.geometry.symmetry import (
    matching_rotation,
    point_group,
    rotation_group,
    schoenflies,
    symmetry_elements,
)
from perrin.geometry.wahba import (
    certified_rotation,
    characteristic_root,
    dispersion,
    planar_rotation,
    spatial_rotation,
    svd_rotation,
)

__all__ = [
    "Cluster",
    "Similarity",
    "axis_angle",
    "center_variance",
    "certified_rotation",
    "characteristic_root",
    "cumulative_product",
    "degrees_of_freedom",
    "diffusion_center",
    "dispersion",
    "exp_map",
    "fit_rotations",
    "is_tetrahedron",
    "kabsch",
    "log_map",
    "matching_rotation",
    "orientation_covariance",
    "pair_distances",
    "planar_rotation",
    "point_group",
    "rotation_group",
    "schoenflies",
    "shifted",
    "similarity",
    "skew",
    "spatial_rotation",
    "successive_product",
    "svd_rotation",
    "symmetry_elements",
    "unit_quaternion",
]
