"""Every error and warning class of perrin."""

from __future__ import annotations


class DegenerateClusterError(ValueError):
    """Too few particles, or collinear ones: the orientation has no unique answer.

    Attributes
    ----------
    indices : tuple of int
        The offending rows (frames), or the particles' count where one number says it all.
    collinear : bool
        Whether the particles lie on one line within the noise: they may still have a direction.
    """

    def __init__(
        self, message: str, indices: tuple[int, ...] = (), *, collinear: bool = False
    ) -> None:
        super().__init__(message)
        self.indices = indices
        self.collinear = collinear


class TooFewFramesError(ValueError):
    """Too few frames with a pose to answer the question.

    Attributes
    ----------
    n_frames : int
        The frames that were there.
    """

    def __init__(self, message: str, n_frames: int = 0) -> None:
        super().__init__(message)
        self.n_frames = n_frames


class TrackTableError(ValueError):
    """A track table that cannot be read as one; the message lists every fault found.

    Attributes
    ----------
    faults : tuple of str
        One line per fault.
    """

    def __init__(self, message: str, faults: tuple[str, ...] = ()) -> None:
        super().__init__(message)
        self.faults = faults


class NoSpheresError(ValueError):
    """The images show no spheres that could be measured in the way that was asked for."""


class IdentityError(ValueError):
    """Which particle is which cannot be told: frames are too far apart."""


class FrameError(ValueError):
    """One frame of a stack cannot be read; the others may be.

    Attributes
    ----------
    frame : int
        Which frame, from 0.
    source : str
        The file.
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
    """The number is right but says less than it seems to."""


class UnitWarning(PrecisionWarning):
    """A number is possible, but usual only in another unit."""


class IdentityWarning(UserWarning):
    """Which particle is which, or what belongs together, was assumed and not measured."""


class PartsError(ValueError):
    """The parts of another run stand in the folder."""
