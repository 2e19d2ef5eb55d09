"""Old path of `perrin.tracks.clusters`; it is removed in the next release."""

import warnings

from perrin.tracks.clusters import *  # noqa: F403

warnings.warn(
    "perrin.grouping has moved to perrin.tracks.clusters; "
    "the old path is removed in the next release",
    DeprecationWarning,
    stacklevel=2,
)
