"""Old path of `perrin.tracks.files`; it is removed in the next release."""

import warnings

from perrin.tracks.files import *  # noqa: F403
from perrin.tracks.formats import SUFFIXES  # noqa: F401

warnings.warn(
    "perrin.files has moved to perrin.tracks.files; the old path is removed in the next release",
    DeprecationWarning,
    stacklevel=2,
)
