"""Positions of spheres by trackpy: its locate, and its least-squares refinement."""

from __future__ import annotations

import warnings
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from perrin.tracks.groups import TOUCHING_REACH

if TYPE_CHECKING:
    from collections.abc import Iterator

    from perrin._arrays import Floats


# Fraction of a disc's size that is flat; the rest decays as a Gaussian.
_FLAT_FRACTION = 0.7


class Features(NamedTuple):
    """Spots of one frame.

    Attributes
    ----------
    centers : ndarray, shape (n, 3)
        Positions (z, y, x), um.
    mass : ndarray, shape (n,)
        Integrated brightness, grey levels.
    """

    centers: Floats
    mass: Floats


def find_features(
    frame: Floats,
    *,
    diameter: float,
    contact: float,
    voxel: tuple[float, float, float],
    dark: bool,
    percentile: float,
    border: bool,
) -> Features:
    """Find the local maxima of one frame, spheres and noise alike, with trackpy.

    Parameters
    ----------
    frame : ndarray, shape (nz, ny, nx)
        Grey levels.
    diameter : float
        Diameter of the fluorescent sphere, um.
    contact : float
        Centre distance of touching spheres, um.
    voxel : tuple of float
        Voxel size (z, y, x), um; a z of NaN means that the frame is one plane, whose spots have
        z = 0.
    dark : bool
        Spheres are darker than their surroundings.
    percentile : float
        Percentile of the grey levels below which a voxel is not the centre of a spot.
    border : bool
        Spheres that the border of the frame cuts are found too, if their centre is inside.

    Returns
    -------
    Features

    Raises
    ------
    ModuleNotFoundError
        If trackpy is not installed.

    Notes
    -----
    The separation is 0.7 of the contact distance: trackpy's own default, over a diameter, loses
    touching spheres. `characterize` is off, because with it trackpy 0.7 returns rows of NaN and the
    errors of other rows wherever voxels are not cubes.
    """
    trackpy = _trackpy()
    frame, step = _of_plane(frame, voxel)
    # The blur enlarges the image of a core; the mask of touching spheres may not be enlarged.
    size = np.ceil(diameter / step).astype(int) + (2 if diameter < 0.8 * contact else 0)
    size += 1 - size % 2
    padding = size // 2 + 3 if border else np.zeros_like(size)
    # trackpy's own inversion is deprecated.
    bright = frame.max() - frame if dark else frame
    with _quiet():
        found = trackpy.locate(
            np.pad(bright, [(p, p) for p in padding], mode="edge"),
            tuple(int(s) for s in size),
            separation=tuple(0.7 * contact / step),
            percentile=percentile,
            minmass=0,
            characterize=False,
        )
    centers = found[list("zyx"[-len(step) :])].to_numpy(dtype=np.float64) - padding
    inside = np.all((centers >= 0) & (centers <= np.array(frame.shape) - 1), axis=1)
    mass = found["mass"].to_numpy(dtype=np.float64)[inside]
    return Features(_in_space(centers[inside] * step), mass)


def refine_by_trackpy(
    frame: Floats,
    centers: Floats,
    *,
    diameter: float,
    contact: float,
    voxel: tuple[float, float, float],
) -> Floats:
    """Refine positions by trackpy's disc model, groups of touching spheres together.

    Parameters
    ----------
    frame : ndarray, shape (nz, ny, nx)
        Grey levels.
    centers : ndarray, shape (n, 3)
        Positions (z, y, x), um.
    diameter : float
        Diameter of the fluorescent sphere, um.
    contact : float
        Centre distance of touching spheres, um.
    voxel : tuple of float
        Voxel size (z, y, x), um; a z of NaN means that the frame is one plane.

    Returns
    -------
    ndarray, shape (n, 3)
        Positions (z, y, x), um; where trackpy's fit fails, the position is the one given.

    Notes
    -----
    Discs have half their height at the surface of the sphere; their size is fixed, as is trackpy's
    default. Groups are chains of distances up to 1.3 contacts, because the positions found first
    are a tenth too far apart.
    """
    import pandas as pd

    trackpy = _trackpy()
    if not len(centers):
        return centers
    frame, step = _of_plane(frame, voxel)
    axes, places = list("zyx"[-len(step) :]), centers[:, -len(step) :] / step
    mask = np.ceil(diameter / step).astype(int) + 2
    mask += 1 - mask % 2
    # A disc of size s is at half its height where r = s (edge + (1 - edge) sqrt(2 log 2 / 3)).
    half = _FLAT_FRACTION + (1 - _FLAT_FRACTION) * np.sqrt(2 * np.log(2) / 3)
    size = diameter / 2 / half / step
    table = pd.DataFrame(places, columns=axes)
    table["frame"] = 0
    # trackpy knows one size where the mask is as wide along all axes.
    sizes = ["size"] if len(set(mask)) == 1 else [f"size_{axis}" for axis in axes]
    known = dict(zip(sizes, size, strict=False))
    middle = np.rint(places).astype(int)
    table["signal"] = frame[tuple(middle.T)] - np.percentile(frame, 50)
    with _quiet():
        refined = trackpy.refine_leastsq(
            table,
            _OneFrame(frame),
            tuple(int(m) for m in mask),
            separation=tuple(TOUCHING_REACH * contact / step),
            fit_function="disc",
            param_val={
                "disc_size": _FLAT_FRACTION,
                "background": float(np.percentile(frame, 50)),
                **known,
            },
        )
    return _in_space(refined[axes].to_numpy(dtype=np.float64) * step)


def _of_plane(frame: Floats, voxel: tuple[float, float, float]) -> tuple[Floats, Floats]:
    """Return frame and voxel size, without the z axis for a frame of one plane."""
    step = np.array(voxel)
    return (frame[0], step[1:]) if np.isnan(step[0]) else (frame, step)


def _in_space(centers: Floats) -> Floats:
    """Return centres (n, 3): those of a plane have z = 0."""
    return np.pad(centers, [(0, 0), (3 - centers.shape[1], 0)])


@dataclass(frozen=True)
class _OneFrame:
    """A reader of one frame, with the methods that trackpy needs."""

    image: Floats

    @property
    def frame_shape(self) -> tuple[int, ...]:
        return self.image.shape

    def __getitem__(self, _: int) -> Floats:
        return self.image


def _trackpy() -> Any:  # noqa: ANN401 (a module without types)
    try:
        import trackpy
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "spheres are first found by trackpy, which is not installed: "
            "pip install 'perrin[images]'"
        ) from error
    return trackpy


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress trackpy's warnings about pandas and its log messages, which a user cannot act on."""
    import logging

    logger = logging.getLogger("trackpy")
    level = logger.level
    logger.setLevel(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            warnings.simplefilter("ignore", FutureWarning)
            # A frame without a spot is a valid result: a table without rows.
            warnings.simplefilter("ignore", UserWarning)
            yield
    finally:
        logger.setLevel(level)
