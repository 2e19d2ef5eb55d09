"""Trajectories of simulations: GSD files, and selections of MDAnalysis."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import numpy as np

from perrin.errors import TrackTableError, table_error
from perrin.tracks.raw_tables import RawTable

if TYPE_CHECKING:
    import pandas as pd

    from perrin._arrays import Floats, Ints

_NO_BODY = 2**32 - 1  # in files of HOOMD: particles of no rigid body


_NUMBER = "particles/N"


def parse_gsd(data: bytes, source: str) -> RawTable:
    """Return the particles of a GSD file of HOOMD; needs the package gsd.

    Parameters
    ----------
    data : bytes
    source : str
        The file's name, for messages.

    Returns
    -------
    RawTable
        Positions are unwrapped with the images of the periodic box; bodies are clusters.

    Raises
    ------
    TrackTableError
        If this is no GSD file with particles.
    ImportError
        If the package is not installed.
    """
    try:
        import gsd.hoomd
        import gsd.pygsd
    except ImportError:
        raise ImportError(f"{source}: GSD needs gsd: pip install 'perrin[tables]'") from None

    try:
        file = gsd.pygsd.GSDFile(io.BytesIO(data))
        # Particles without positions of their own are at 0: the file need not hold them.
        stated = [
            int(file.read_chunk(frame=i, name=_NUMBER)[0])
            for i in range(file.nframes)
            if file.chunk_exists(frame=i, name=_NUMBER)
        ]
        if max(stated, default=0) > len(data):
            raise table_error(source, f"not a GSD file: it states {max(stated)} particles")
        frames = list(gsd.hoomd.HOOMDTrajectory(file))
    except TrackTableError:
        raise
    except (RuntimeError, OSError, ValueError) as error:
        raise table_error(source, f"not a GSD file that can be read ({error})") from None
    if not sum(frame.particles.N for frame in frames):
        raise table_error(source, "a GSD file without particles")
    axes = 2 if frames[0].configuration.dimensions == 2 else 3
    x = []
    for frame in frames:
        position = np.asarray(frame.particles.position, dtype=np.float64)
        image, box = frame.particles.image, frame.configuration.box
        if image is not None and box is not None:
            # The periods that particles have crossed, along the edges of HOOMD's box.
            lx, ly, lz, xy, xz, yz = (float(side) for side in box)
            edges = np.array([[lx, 0, 0], [xy * ly, ly, 0], [xz * lz, yz * lz, lz]])
            position = position + np.asarray(image, dtype=np.float64) @ edges
        x.append(position)
    table = _long_table([np.arange(frame.particles.N) for frame in frames], x, axes)
    bodies = np.concatenate([np.asarray(frame.particles.body) for frame in frames])
    own = (bodies != _NO_BODY) & (bodies >= 0)
    if own.any():
        table["cluster"] = np.where(own, bodies.astype(np.int64), -1)
    notes = ("the unit of length is that of the simulation: state its size in um with scale",)
    return RawTable(
        table, f"GSD, {len(frames)} frames", {name: name for name in table}, notes=notes
    )


def is_selection(thing: object) -> bool:
    """Return whether this is a Universe or a group of atoms of MDAnalysis.

    Examples
    --------
    >>> is_selection([1.0, 2.0])
    False
    """
    return hasattr(thing, "universe") and hasattr(thing, "atoms")


def selection_table(selection: Any) -> pd.DataFrame:  # noqa: ANN401 (a class of another package)
    """Return the positions of a Universe or a group of atoms of MDAnalysis in all frames.

    Parameters
    ----------
    selection : MDAnalysis.Universe or MDAnalysis.AtomGroup
        Positions must be unwrapped.

    Returns
    -------
    pandas.DataFrame
        Columns frame, particle (index of the atom), cluster (its residue, where there are
        several), x, y, z in the unit of the Universe (Angstrom, where the file states one).

    Examples
    --------
    >>> from types import SimpleNamespace
    >>> atoms = SimpleNamespace(indices=[4], resindices=[0], positions=[[1.0, 2.0, 3.0]])
    >>> atoms.universe = SimpleNamespace(trajectory=[None, None])
    >>> atoms.atoms = atoms
    >>> selection_table(atoms)
       frame  particle    x    y    z
    0      0         4  1.0  2.0  3.0
    1      1         4  1.0  2.0  3.0
    """
    atoms = selection.atoms
    x = [
        np.array(atoms.positions, dtype=np.float64) for _ in selection.universe.trajectory
    ]  # the group follows the trajectory
    table = _long_table([np.asarray(atoms.indices)] * len(x), x, 3)
    residues = np.asarray(atoms.resindices)
    if len(np.unique(residues)) > 1:
        table["cluster"] = np.tile(residues, len(x))
    return table


def _long_table(ids: list[Ints], x: list[Floats], axes: int) -> pd.DataFrame:
    """Return frames of particles as one table."""
    import pandas as pd

    count = [len(one) for one in ids]
    columns = {"frame": np.repeat(np.arange(len(ids)), count), "particle": np.concatenate(ids)}
    return pd.DataFrame(columns | dict(zip("xyz"[:axes], np.concatenate(x).T, strict=False)))
