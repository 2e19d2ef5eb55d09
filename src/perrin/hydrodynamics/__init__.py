"""Hydrodynamics of rigid bodies of spheres: resistance, mobility, walls, gravity, sizes."""

from perrin.hydrodynamics.mobility import (
    Mobility,
    Principal,
    apparent_translation,
    cluster_mobility,
    condition_faults,
)
from perrin.hydrodynamics.resistance import (
    Resistance,
    converge_resistance,
    even_directions,
    exposed_surface,
    flow_forces,
    lamb_flows,
    solid_harmonics,
    solve_resistance,
)
from perrin.hydrodynamics.sizes import (
    HasStandardError,
    Size,
    neighbour_distance,
    shape_mobility,
    size_and_viscosity,
    size_from_rotation,
    size_from_translation,
)
from perrin.hydrodynamics.surroundings import (
    WallFactor,
    gravitational_height,
    settling_velocity,
    wall_diffusion,
    wall_factor,
    water_viscosity,
)
from perrin.hydrodynamics.units import length_remarks, viscosity_remarks

__all__ = [
    "HasStandardError",
    "Mobility",
    "Principal",
    "Resistance",
    "Size",
    "WallFactor",
    "apparent_translation",
    "cluster_mobility",
    "condition_faults",
    "converge_resistance",
    "even_directions",
    "exposed_surface",
    "flow_forces",
    "gravitational_height",
    "lamb_flows",
    "length_remarks",
    "neighbour_distance",
    "settling_velocity",
    "shape_mobility",
    "size_and_viscosity",
    "size_from_rotation",
    "size_from_translation",
    "solid_harmonics",
    "solve_resistance",
    "viscosity_remarks",
    "wall_diffusion",
    "wall_factor",
    "water_viscosity",
]
