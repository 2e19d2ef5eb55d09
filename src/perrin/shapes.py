"""Old path of `perrin.geometry.shapes`; it is removed in the next release."""

import warnings

from perrin.geometry.shapes import *  # noqa: F403
from perrin.geometry.symmetry import *  # noqa: F403

warnings.warn(
    "perrin.shapes has moved to perrin.geometry.shapes; "
    "the old path is removed in the next release",
    DeprecationWarning,
    stacklevel=2,
)
