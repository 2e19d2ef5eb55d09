"""Every error and warning class of perrin."""

from __future__ import annotations


class DegenerateClusterError(ValueError):
    """Fewer than three particles, or collinear ones: the orientation is not unique.

    Attributes
    ----------
    indices : tuple of int
        Rows (frames) without a unique orientation, or the number of particles where no row has one.
    collinear : bool
        Whether the particles lie on one line within the noise; a line still has a direction.
    """

    def __init__(
        self, message: str, indices: tuple[int, ...] = (), *, collinear: bool = False
    ) -> None:
        super().__init__(message)
        self.indices = indices
        self.collinear = collinear


class TooFewFramesError(ValueError):
    """Fewer frames with a pose than the estimate needs.

    Attributes
    ----------
    n_frames : int
        Number of frames with a pose.
    """

    def __init__(self, message: str, n_frames: int = 0) -> None:
        super().__init__(message)
        self.n_frames = n_frames


class TrackTableError(ValueError):
    """A table that is no track table; the message lists every fault.

    Attributes
    ----------
    faults : tuple of str
        One line for each fault.
    """

    def __init__(self, message: str, faults: tuple[str, ...] = ()) -> None:
        super().__init__(message)
        self.faults = faults


class NoSpheresError(ValueError):
    """The images show no spheres that can be measured with the given arguments."""


class IdentityError(ValueError):
    """The labels of particles cannot be determined: the frames are too far apart."""


class FrameError(ValueError):
    """One frame of a stack cannot be read; the other frames may be readable.

    Attributes
    ----------
    frame : int
        Number of the frame, counted from 0.
    source : str
        Path of the file.
    """

    def __init__(self, message: str, frame: int = 0, source: str = "") -> None:
        super().__init__(message)
        self.frame = frame
        self.source = source


def table_error(source: str, *faults: str) -> TrackTableError:
    """Return the error that lists all faults of one table."""
    if len(faults) == 1:
        return TrackTableError(f"{source}: {faults[0]}", faults)
    lines = "".join(f"\n  - {fault}" for fault in faults)
    return TrackTableError(f"{source}: {len(faults)} faults in this track table{lines}", faults)


class PrecisionWarning(UserWarning):
    """A number is correct, but less precise or less general than it seems."""


class UnitWarning(PrecisionWarning):
    """A number is possible, but it is usual only in another unit."""


class IdentityWarning(UserWarning):
    """Labels of particles, or their grouping into clusters, were corrected or assumed."""


class PartsError(ValueError):
    """The folder holds the unfinished parts of another run."""


class ManifestError(ValueError):
    """A manifest of a study with faults; the message lists all of them with their lines."""


class FolderInUseError(OSError):
    """Another process is writing into the folder."""


class DamagedFileError(ValueError):
    """A file of a run folder is not what was written there.

    Attributes
    ----------
    file : str
        Path of the file.
    """

    def __init__(self, message: str, file: str = "") -> None:
        super().__init__(message)
        self.file = file
