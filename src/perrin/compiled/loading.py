"""Whether the compiled kernels are used.

They are optional: where perrin was built without a compiler, or where ``PERRIN_COMPILED=0`` is in
the environment, numpy does the same work and returns the same numbers to rounding.
"""

from __future__ import annotations

import os
from functools import cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from types import ModuleType

# The environment variable that is 0 where the kernels are not to be used.
SWITCH = "PERRIN_COMPILED"


@cache
def compiled_kernels() -> ModuleType | None:
    """Return the module of the compiled kernels, or None where numpy does their work.

    The environment variable ``PERRIN_COMPILED`` is read once in a process.

    Examples
    --------
    >>> kernels = compiled_kernels()
    >>> kernels is None or hasattr(kernels, "wahba")
    True
    """
    if os.environ.get(SWITCH, "1") == "0":
        return None
    try:
        from perrin.compiled import kernels
    except ImportError:
        return None
    return kernels


def kernels_in_use() -> str:
    """Return in words whether the compiled kernels are in use, and why not.

    Examples
    --------
    >>> kernels_in_use().split(",")[0] in ("in use", "not in use")
    True
    """
    if compiled_kernels() is not None:
        return "in use"
    if os.environ.get(SWITCH, "1") == "0":
        return f"not in use, numpy does their work: {SWITCH}=0 is in the environment"
    return "not in use, numpy does their work: perrin was built without a C compiler or the headers"
