"""Old path of `perrin.tracks.identity`; it is removed in the next release."""

import warnings

from perrin.tracks.identity import *  # noqa: F403

warnings.warn(
    "perrin.identity has moved to perrin.tracks.identity; "
    "the old path is removed in the next release",
    DeprecationWarning,
    stacklevel=2,
)
