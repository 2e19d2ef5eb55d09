"""Values that are possible, but usual only in another unit."""

from __future__ import annotations

# Pa s. Water at 293 K has 1.0 mPa s, 90 % glycerol 0.2 Pa s, pure glycerol, the most viscous of the
# common solvents, 1.4 Pa s. A value in mPa s given as Pa s is 0.5 or more in every solvent.
_HIGHEST_VISCOSITY, _WATER_VISCOSITY = 0.5, 1e-3

# um. Spheres that a microscope resolves and that diffuse measurably have 0.2 to 10 um.
_SMALLEST_LENGTH, _LARGEST_LENGTH = 0.05, 50.0


def viscosity_remarks(viscosity: float | None) -> list[str]:
    """Return one line where a viscosity is so large that it may be in mPa s (cP).

    Parameters
    ----------
    viscosity : float or None
        Viscosity, Pa s.

    Returns
    -------
    list of str
        Empty, or one line.

    Examples
    --------
    >>> viscosity_remarks(2.18e-3)
    []
    >>> viscosity_remarks(2.18)[0]
    'viscosity: 2.18 Pa s is 2180 times that of water; if the value is in mPa s (cP), state 0.00218'
    """
    if viscosity is None or not viscosity > _HIGHEST_VISCOSITY:
        return []
    return [
        f"viscosity: {viscosity:.4g} Pa s is {viscosity / _WATER_VISCOSITY:.4g} times that of "
        f"water; if the value is in mPa s (cP), state {1e-3 * viscosity:.4g}"
    ]


def length_remarks(name: str, length: float) -> list[str]:
    """Return one line where a length of a cluster is so small or large that its unit may be wrong.

    Parameters
    ----------
    name : str
        Name of the length, as the subject of a sentence.
    length : float
        Length, um.

    Returns
    -------
    list of str
        Empty, or one line.

    Examples
    --------
    >>> length_remarks("the diameter", 2.45)
    []
    >>> length_remarks("the diameter", 2450.0)[0]
    'the diameter, 2450 um, is outside 0.05 to 50 um; if it is in nm, it is 2.45 um'
    """
    if _SMALLEST_LENGTH <= length <= _LARGEST_LENGTH:
        return []
    remark = f"{name}, {length:.4g} um, is outside {_SMALLEST_LENGTH:g} to {_LARGEST_LENGTH:g} um"
    factor, unit = (1e-3, "nm") if length > _LARGEST_LENGTH else (1e3, "mm")
    converted = factor * length
    if _SMALLEST_LENGTH <= converted <= _LARGEST_LENGTH:
        remark += f"; if it is in {unit}, it is {converted:.4g} um"
    return [remark]
