"""Results of the imaging part of a run: the spheres of its frames, and their images."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from perrin._arrays import from_plain, to_plain
from perrin.images.optics.optics import Optics
from perrin.images.optics.radial_image import RadialImage
from perrin.tracks.checksums import CheckedFiles, refusing_damage
from perrin.tracks.writing import write_json, write_parquet

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    import pandas as pd

    from perrin._arrays import Floats


@dataclass(frozen=True, eq=False)
class View:
    """Projections of one frame along its three axes: the brightest voxel of each line of voxels.

    For dark spheres the darkest voxel. A 2-D frame has only `xy`; the others have one row.

    Attributes
    ----------
    frame : int
        Number of the frame in the stack.
    xy, xz, yz : ndarray, shapes (y, x), (z, x), (z, y)
        Grey levels.

    Examples
    --------
    >>> view = View(7, np.ones((4, 5)), np.ones((3, 5)), np.ones((3, 4)))
    >>> View.from_dict(view.to_dict()).xz.shape
    (3, 5)
    """

    frame: int
    xy: Floats
    xz: Floats
    yz: Floats

    def to_dict(self) -> dict[str, Any]:
        """Return the projections as values that JSON holds."""
        return {name: to_plain(getattr(self, name)) for name in ("frame", *_SIDES)}

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> View:
        """Return the projections that `to_dict` wrote, as float64.

        Parameters
        ----------
        entry : mapping
            The dictionary of `to_dict`.

        Returns
        -------
        View
        """
        return cls(entry["frame"], *(from_plain(entry[side]) for side in _SIDES))


_SIDES = ("xy", "xz", "yz")


@dataclass(frozen=True, eq=False)
class Imaging:
    """Results of the imaging part of a run.

    Attributes
    ----------
    features : pandas.DataFrame
        One row per sphere: ``frame`` (of the stack), ``x, y, z`` (um), ``mass``, the other columns
        of `locate`, and ``cluster, particle, piece`` (cluster -1: no cluster); ``kind``, the number
        of the channel, where each channel shows one kind of sphere.
    frames : pandas.DataFrame
        One row per frame used: ``frame``, ``time`` (s), ``spots`` (before the mass cut),
        ``spheres``, ``level`` (median grey level), ``saturated`` (fraction of voxels clipped at the
        highest grey level), ``fault`` (why it could not be read, or ""), ``copy_of`` (the earlier
        frame that it repeats exactly, or -1; such a frame has no features).
    spots : pandas.DataFrame
        ``frame, mass`` of all spots, noise included, in a few frames all over the movie; masses
        of other channels are scaled to the mass cut of the first.
    views : tuple of View
        Projections of a few frames all over the movie.
    optics : Optics or None
        Size, point spread and noise of the image of a sphere; None without refinement by the model.
    minmass : float
        The mass cut; 0 where no spot is cut.
    voxel : tuple of float
        Voxel size (z, y, x), um; z is NaN for a 2-D movie.
    diameter : float
        Diameter of the fluorescent sphere in the search, um.
    contact : float
        Centre distance of touching spheres in the search, um.
    dark : bool
        Spheres are darker than their surroundings.
    refine : str or None
        How positions were refined, as in `locate`.
    radial : RadialImage or None
        The image of a sphere of a 2-D movie; None without refinement by the model.
    distance_error : float or None
        Relative error of the distances in a body that is the same in all frames: the deviation of
        touching spheres from `contact`, or the error of their mean where that is larger; None where
        no spheres of a cluster touch.
    other_optics : tuple of Optics
        `optics` of the other channels, where each channel shows one kind of sphere.
    channel_offsets : tuple of tuple of float
        Shift (x, y, z) of each of the other channels against the first, um, which is subtracted in
        `features`; an empty tuple where it is not measured.
    """

    features: pd.DataFrame
    frames: pd.DataFrame
    spots: pd.DataFrame
    views: tuple[View, ...]
    optics: Optics | None
    minmass: float
    voxel: tuple[float, float, float]
    diameter: float
    contact: float
    dark: bool
    refine: str | None
    radial: RadialImage | None = None
    distance_error: float | None = None
    other_optics: tuple[Optics, ...] = ()
    channel_offsets: tuple[tuple[float, ...], ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return everything as values that JSON holds: tables as lists by column."""
        entry: dict[str, Any] = {
            name: {column: to_plain(getattr(self, name)[column].tolist()) for column in columns}
            for name, columns in ((table, getattr(self, table).columns) for table in _TABLES)
        }
        return entry | {"views": [view.to_dict() for view in self.views]} | self.settings()

    @classmethod
    def from_dict(cls, entry: Mapping[str, Any]) -> Imaging:
        """Return the imaging results that `to_dict` wrote.

        Parameters
        ----------
        entry : mapping
            The dictionary of `to_dict`.

        Returns
        -------
        Imaging
        """
        import pandas as pd

        tables = {name: pd.DataFrame(entry[name]) for name in _TABLES}
        for table in tables.values():
            # JSON has no NaN: a number that is missing is null.
            for column in table.columns[table.isna().any()]:
                table[column] = table[column].astype(np.float64)
        views = tuple(View.from_dict(view) for view in entry["views"])
        return cls(**tables, views=views, **_settings_from(entry))

    def settings(self) -> dict[str, Any]:
        """Return all but tables and views as values that JSON holds: the file imaging.json."""
        entry = {name: to_plain(getattr(self, name)) for name in _IMAGING_SETTINGS}
        entry["other_optics"] = [optics.to_dict() for optics in self.other_optics]
        entry["channel_offsets"] = [list(offset) for offset in self.channel_offsets]
        # What only some movies have is not written for others.
        for name in ("radial", "distance_error", "other_optics", "channel_offsets"):
            if not getattr(self, name):
                del entry[name]
        return entry


_TABLES = ("features", "frames", "spots")

_IMAGING_SETTINGS = tuple(
    field.name for field in fields(Imaging) if field.name not in (*_TABLES, "views")
)


def _settings_from(entry: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields that `Imaging.settings` wrote."""
    optics, radial, voxel = entry["optics"], entry.get("radial"), entry["voxel"]
    z, y, x = (np.nan if size is None else float(size) for size in voxel)
    return {name: entry.get(name) for name in _IMAGING_SETTINGS} | {
        "optics": None if optics is None else Optics.from_dict(optics),
        "radial": None if radial is None else RadialImage.from_dict(radial),
        "other_optics": tuple(Optics.from_dict(one) for one in entry.get("other_optics", ())),
        "channel_offsets": tuple(tuple(shift) for shift in entry.get("channel_offsets", ())),
        "voxel": (z, y, x),
    }


def write_imaging(imaging: Imaging, folder: Path) -> None:
    """Write features.parquet, frames.parquet, spots.parquet, views.npz and imaging.json.

    Parameters
    ----------
    imaging : Imaging
        The results.
    folder : Path
        An existing folder.
    """
    for name in _TABLES:
        write_parquet(folder / f"{name}.parquet", getattr(imaging, name))
    views = {f"{v.frame}-{side}": getattr(v, side) for v in imaging.views for side in _SIDES}
    np.savez_compressed(folder / "views.npz", **views)
    write_json(folder / "imaging.json", imaging.settings())


def read_imaging(folder: Path) -> Imaging:
    """Read the files that `write_imaging` wrote.

    Parameters
    ----------
    folder : Path
        The folder.

    Returns
    -------
    Imaging

    Raises
    ------
    FileNotFoundError
        If a file is missing.
    DamagedFileError
        If one of them is damaged.
    """
    files = CheckedFiles.of(folder)
    entry, stored = files.json("imaging.json"), files.arrays("views.npz")
    tables = {name: files.table(f"{name}.parquet") for name in _TABLES}
    with refusing_damage(folder):
        frames = sorted({int(name.partition("-")[0]) for name in stored})
        views = tuple(View(k, *(stored[f"{k}-{side}"] for side in _SIDES)) for k in frames)
        return Imaging(**tables, views=views, **_settings_from(entry))
