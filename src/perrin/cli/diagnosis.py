"""What an installation has: versions, optional readers, fonts, and a short test of itself."""

from __future__ import annotations

import os
import platform
import time
from typing import NamedTuple

_REQUIRED = (
    "numpy", "scipy", "pandas", "pyarrow", "matplotlib", "typer", "rich", "jinja2",
)  # fmt: skip

# What each optional package reads or does, and the extra that installs it.
_OPTIONAL = {
    "python-calamine": ("spreadsheets (.xlsx, .xls, .ods)", "tables"),
    "c3d": ("motion capture (.c3d)", "tables"),
    "gsd": ("simulations (.gsd)", "tables"),
    "tifffile": ("image stacks (.tif)", "images"),
    "imagecodecs": ("compressed images", "images"),
    "trackpy": ("finding spheres in stacks", "images"),
    "numba": ("fast refinement of trackpy", "images"),
    "threadpoolctl": ("one thread a frame", "images"),
    "liffile": ("Leica (.lif)", "lif"),
    "nd2": ("Nikon (.nd2)", "nd2"),
    "czifile": ("Zeiss (.czi)", "czi"),
    "oiffile": ("Olympus (.oif, .oib)", "oif"),
    "h5py": ("Imaris (.ims), HDF5", "ims"),
    "zarr": ("OME-Zarr", "zarr"),
    "dask": ("runs on several machines", "cluster"),
}

# Planted in the test; its estimates lie within five standard errors except once in a million.
_PLANTED_D_R, _PLANTED_D_T, _ERRORS = 5e-3, 4e-2, 5.0


class Check(NamedTuple):
    """One line of the diagnosis.

    Attributes
    ----------
    subject : str
    state : str
        What was found.
    good : bool or None
        Whether it is as it should be; None for what is optional and absent.
    """

    subject: str
    state: str
    good: bool | None = True


def installed() -> list[Check]:
    """Return the versions of Python, perrin and the packages it needs, and what is compiled.

    Examples
    --------
    >>> [check.subject for check in installed()][:2]
    ['python', 'perrin']
    """
    import perrin
    from perrin.compiled import compiled_kernels, kernels_in_use
    from perrin.run.measure import library_version

    system = f"{platform.python_version()}, {platform.system()} {platform.machine()}"
    cores = f"{os.cpu_count()} processors"
    found = [Check("python", f"{system}, {cores}"), Check("perrin", perrin.__version__)]
    for name in _REQUIRED:
        version = library_version(name)
        found.append(Check(name, version or "is missing", version is not None))
    good = None if compiled_kernels() is None else True
    return [*found, Check("compiled kernels", kernels_in_use(), good)]


def optional_readers() -> list[Check]:
    """Return the optional packages, with their version or the command that installs them.

    Examples
    --------
    >>> all(check.good is not False for check in optional_readers())
    True
    """
    from perrin.run.measure import library_version

    found = []
    for name, (purpose, extra) in _OPTIONAL.items():
        version = library_version(name)
        state = version or f"not installed: pip install 'perrin[{extra}]'"
        found.append(Check(f"{name}, {purpose}", state, True if version else None))
    return found


def figure_font() -> Check:
    """Return the font that figures get.

    Examples
    --------
    >>> figure_font().subject
    'font of figures'
    """
    from perrin.plot.figure_style import font_in_use

    font = font_in_use()
    return Check("font of figures", font or "none is found", font is not None)


def self_test() -> list[Check]:
    """Measure a simulated tetrahedron, and return whether the planted values come back.

    Returns
    -------
    list of Check
        One for each coefficient, and the time.

    Examples
    --------
    >>> all(check.good for check in self_test())
    True
    """
    import perrin

    start = time.monotonic()
    truth = perrin.simulate_motion(
        perrin.Cluster.touching(4, 2.45),
        D_R=_PLANTED_D_R,
        D_T=_PLANTED_D_T,
        dt=0.7,
        n_frames=200,
        rng=1,
    )
    positions = perrin.add_noise(truth.positions(), sigma=0.03, rng=2)
    motion = perrin.track_rotation(positions, dt=0.7)
    checks = []
    for found, planted in (
        (perrin.estimate_diffusion(motion), _PLANTED_D_R),
        (perrin.estimate_diffusion(motion, quantity="translation"), _PLANTED_D_T),
    ):
        good = abs(found.value - planted) < _ERRORS * found.stderr
        checks.append(Check(f"self-test, planted {planted:g}", str(found), good))
    return [*checks, Check("self-test, time", f"{time.monotonic() - start:.1f} s")]
