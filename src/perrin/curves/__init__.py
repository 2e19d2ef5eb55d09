"""Mean squares, correlations and distributions against lag time."""

from perrin.curves.correlation import (
    QuaternionCovariance,
    orientation_correlation,
    quaternion_covariance,
)
from perrin.curves.displacement import (
    LagCurve,
    direction_weights,
    msad,
    msad_axes,
    msad_vector,
    msd,
    weighs_alike,
)
from perrin.curves.distributions import VanHove, van_hove
from perrin.curves.pairs import (
    Frames,
    Kernel,
    PairSums,
    Products,
    Singles,
    Squares,
    fast_size,
    first_look,
    overlap_sums,
    pair_sums,
    place_frames,
    places,
    relative_error,
)

__all__ = [
    "Frames",
    "Kernel",
    "LagCurve",
    "PairSums",
    "Products",
    "QuaternionCovariance",
    "Singles",
    "Squares",
    "VanHove",
    "direction_weights",
    "fast_size",
    "first_look",
    "msad",
    "msad_axes",
    "msad_vector",
    "msd",
    "orientation_correlation",
    "overlap_sums",
    "pair_sums",
    "place_frames",
    "places",
    "quaternion_covariance",
    "relative_error",
    "van_hove",
    "weighs_alike",
]
