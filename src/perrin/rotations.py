"""Old path of `perrin.geometry.rotations`; it is removed in the next release."""

import warnings

from perrin.geometry.rotations import *  # noqa: F403

warnings.warn(
    "perrin.rotations has moved to perrin.geometry.rotations; "
    "the old path is removed in the next release",
    DeprecationWarning,
    stacklevel=2,
)
