"""Old path of `perrin.tracks.clusters`; it is removed in the next release."""

import warnings

from perrin.tracks.clusters import *  # noqa: F403
from perrin.tracks.groups import TOUCHING_REACH as REACH  # noqa: F401

warnings.warn(
    "perrin.grouping has moved to perrin.tracks.clusters; "
    "the old path is removed in the next release",
    DeprecationWarning,
    stacklevel=2,
)
